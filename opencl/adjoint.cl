/* Irradiance of a depth map and its derivatives, for the inverse problem (MODEL.md, 5.2).

E = (1 + |grad z|^2)^(-1/2) sum over slices of width x [C1(T) + s C2(T)], s = e . grad z, C1 and C2 the integrals of
B sin cos and of B cos^2 above the slope T: the largest of the level, the tangent plane, the wall, the source's own lower
edge and the horizon. The horizon is the largest (height - own height) / distance over every crossing of the slice with a
row or a column of the grid; where it is the limit, dE/dT goes to the two nodes beside that crossing, over its distance.
Where the tangent plane is the limit the integrand is 0 and so is the derivative.

Lengths are in spacings. z is depth, heights are -z. `pixels` is rows x cols.

  heights  (rows, cols + 2 margin)  float  -z; in the margins -1e30, or the other side of a map that repeats
  tilts    (2, pixels)              float  dz/dx, dz/dy by central differences, one-sided at the border
  tiles, top                        float  the greatest height of every TILE x TILE nodes, and of all
  light    (5, pixels)              float  out: E; dE by own depth, by dz/dx, by dz/dy; (1 + |grad z|^2)^(-1/2)
  pulls    (count, pixels)          float  out: width x dF/dT / distance of the node that limits a slice, without the root
  at       (count, pixels)          int    out: that crossing's first node, row << 16 | column, bit 30 set if the other is a
                                           row on, else a column on; -1: no node limits this slice
  shares   (count, pixels)          float  out: weight of the second node
  table    (n, knots, 4)            float  integrals of B cos^2 and of B sin cos from sin(elevation) = i / (knots - 1) to the
                                           zenith, and what to add up to the next knot; knots 0: brightness 1, closed form
  sides                             0 open, 1 dark, 2 periodic

All arithmetic is +, -, x, / and sqrt, correctly rounded and in one order, so that every backend finds the same bits.
Twin of warp_kernels/adjoint.py. */
#include "lanes.h"
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#define NONE -1e30f
#define STEEP 1e6f    /* as good as the zenith */
#define TILE 8
#define SLACK 1.00001f /* what is left out must be lower by more than roundings */
#define ALONG 1e-6f   /* closer to the grid is along it: n times -1e-9 would be a crossing all but on a node, and one of its two off the map */
#define LEVEL 0.01f   /* slope below which a map that repeats is not searched */
#define COLUMN (1 << 30)
#define BLOCK 64      /* nodes that a work-item of a sum owns */
enum { OPEN, DARK, PERIODIC };

#if LANES == 1
#define TO_FLOATS convert_float
#define COUNT 0
#define ALL(v) (v)
#define READ(offset, pointer) (pointer)[offset]
#define LANE(v, l) (v)
#else
#define TO_FLOATS JOIN(convert_float, LANES)
#define COUNT (ints)(0, 1, 2, 3, 4, 5, 6, 7)
#define ALL(v) all(v)
typedef struct __attribute__((packed)) { floats v; } loose_floats; /* PoCL calls its vector builtins; these go inline */
typedef struct __attribute__((packed)) { ints v; } loose_ints;
#define READ(offset, pointer) (((__global const loose_floats *)((pointer) + (offset)))->v)
#define LANE(v, l) (v)[l]
#endif
#define MORE(a, b) ((a) > (b) ? (a) : (b))
#define LESS(a, b) ((a) < (b) ? (a) : (b))

/* Arc tangent of v >= 0 to 2e-7, by a polynomial fitted for least maximum error. */
floats arc_tangent(floats v)
{
  const floats r = v > 1 ? 1 / v : v, q = r * r;
  floats p = -0.0040545627f;
  p = p * q + 0.021862943f;
  p = p * q - 0.055912301f;
  p = p * q + 0.096421957f;
  p = p * q - 0.13908629f;
  p = p * q + 0.19946566f;
  p = p * q - 0.33329859f;
  p = p * q + 0.99999934f;
  return v > 1 ? 1.57079633f - p * r : p * r;
}

/* Light between the slope T and the zenith: integrals of B sin cos (c1) and of B cos^2 (c2), and their derivative by T. */
typedef struct { floats c1, c2, d1, d2; } Above;

Above above(floats t, __global const float *table, int row, int next, float share, int knots)
{
  const floats square = 1 + t * t, cosine = 1 / square;
  Above sky;
  if (knots == 0) {
    sky.c1 = 0.5f * cosine;
    sky.c2 = 0.5f * (1.57079633f - arc_tangent(t) - t * cosine);
    sky.d1 = -t * cosine * cosine;
    sky.d2 = -cosine * cosine;
    return sky;
  }
  const floats root = sqrt(square), sine = t / root, place = sine * (knots - 1);
  const floats per = (knots - 1) / (square * root);
  ints knot = TO_INTS(place);
  knot = LESS(knot, knots - 2);
  const floats part = place - TO_FLOATS(knot);
#if LANES == 1
  const float4 one = vload4(row * knots + knot, table);
  float4 v = one;
  if (share > 0)
    v += share * (vload4(next * knots + knot, table) - one);
  sky.c2 = v.x + part * v.z;
  sky.c1 = v.y + part * v.w;
  sky.d2 = v.z * per;
  sky.d1 = v.w * per;
#else
  for (int l = 0; l < LANES; ++l) {
    const float4 v = vload4(row * knots + knot[l], table);
    sky.c2[l] = v.x + part[l] * v.z;
    sky.c1[l] = v.y + part[l] * v.w;
    sky.d2[l] = v.z * per[l];
    sky.d1[l] = v.w * per[l];
  }
#endif
  return sky;
}

/* A slice: the azimuth's cosine and sine, columns per row and rows per column, and their reciprocal lengths. */
typedef struct { float c, s, columns, rise, rows, run; } Way;

Way way_of(float c, float s)
{
  c = fabs(c) > ALONG ? c : 0;
  s = fabs(s) > ALONG ? s : 0;
  const float across = fabs(c), along = fabs(s);
  const Way way = {c, s, along > 0 ? c / along : 0, along, across > 0 ? s / across : 0, across};
  return way;
}

/* The highest ground in the tiles that hold columns left..right of rows over..under, what is off the map left out. */
float highest_in(__global const float *tiles, int left, int right, int over, int under, int rows, int cols)
{
  const int across = (cols - 1) / TILE + 1;
  float high = NONE;
  for (int j = max(over, 0) / TILE; j <= min(under, rows - 1) / TILE; ++j)
    for (int i = max(left, 0) / TILE; i <= min(right, cols - 1) / TILE; ++i)
      high = MORE(tiles[j * across + i], high);
  return high;
}

/* Raises `best`, which is not below 0, to the horizon of the LANES nodes from (x, y) on, as far as `reach`, and says by which
   crossing: n rows on, or -n columns on; 0 where nothing stands above `best`. TILE crossings at a time are left out where no
   ground near them is high enough. */
ints horizon(__global const float *heights, __global const float *tiles, Way way, int x, int y, floats own, floats *best, float top, float reach,
             int rows, int cols, int margin, int sides)
{
  const int stride = cols + 2 * margin, up = way.s > 0 ? 1 : -1, on = way.c > 0 ? 1 : -1;
  __global const float *map = heights + margin;
  ints number = 0;
  const int n_rows = way.s == 0 ? 0 : sides == PERIODIC ? 1 << 20 : way.s > 0 ? rows - 1 - y : y;
  for (int n = 1; n <= n_rows; ++n) {
    const float closeness = way.rise / n;
    if (reach * closeness < 1)
      break;
    const float across = n * way.columns, low = floor(across), share = across - low;
    int column = x + (int)low, row = y + up * n;
    if (sides == PERIODIC) {
      column = (column % cols + cols) % cols;
      row = (row % rows + rows) % rows;
    } else if (column >= cols || column + LANES < 0)
      break;
    if (n % TILE == 1) {
      if (ALL((top - own) * (SLACK * closeness) <= *best))
        break;
      if (sides != PERIODIC && fabs(way.columns) <= 2) {
        const int last = x + (int)floor((n + TILE - 1) * way.columns), end = y + up * (n + TILE - 1);
        const float high = highest_in(tiles, min(column, last), max(column, last) + LANES, min(row, end), max(row, end), rows, cols);
        if (ALL((high - own) * (SLACK * closeness) <= *best)) {
          n += TILE - 1;
          continue;
        }
      }
    }
    const floats a = READ(row * stride + column, map), b = READ(row * stride + column + 1, map);
    const floats slope = (a + share * (b - a) - own) * closeness;
    number = slope > *best ? (ints)n : number;
    *best = MORE(slope, *best);
  }
  const int n_columns = way.c == 0 ? 0 : sides == PERIODIC ? 1 << 20 : way.c > 0 ? cols - 1 - x : x + LANES - 1;
  for (int n = 1; n <= n_columns; ++n) {
    const float closeness = way.run / n;
    if (reach * closeness < 1)
      break;
    const float along = n * way.rows, low = floor(along), share = along - low;
    int column = x + on * n, row = y + (int)low, next = row + 1;
    if (sides == PERIODIC) {
      column = (column % cols + cols) % cols;
      row = (row % rows + rows) % rows;
      next = row + 1 < rows ? row + 1 : 0;
    } else if (row < 0 || row >= rows || (next >= rows && share > 0))
      break;
    else
      next = min(next, rows - 1);
    if (n % TILE == 1) {
      if (ALL((top - own) * (SLACK * closeness) <= *best))
        break;
      if (sides != PERIODIC && fabs(way.rows) <= 2) {
        const int last = column + on * (TILE - 1), end = y + (int)floor((n + TILE - 1) * way.rows);
        const float high = highest_in(tiles, min(column, last), max(column, last) + LANES - 1, min(row, end), max(row, end) + 1, rows, cols);
        if (ALL((high - own) * (SLACK * closeness) <= *best)) {
          n += TILE - 1;
          continue;
        }
      }
    }
    const floats a = READ(row * stride + column, map), b = READ(next * stride + column, map);
    const floats slope = (a + share * (b - a) - own) * closeness;
    number = slope > *best ? (ints)-n : number;
    *best = MORE(slope, *best);
  }
  return number;
}

/* Distance to the wall half a node outside the map. */
floats wall_of(Way way, int x, int y, int rows, int cols)
{
  floats wall = 1e30f;
  if (way.c != 0)
    wall = (way.c > 0 ? cols - 0.5f - TO_FLOATS(x + COUNT) : TO_FLOATS(x + COUNT) + 0.5f) / way.run;
  if (way.s != 0) {
    const floats other = (way.s > 0 ? rows - 0.5f - y : y + 0.5f) / way.rise;
    wall = LESS(wall, other);
  }
  return wall;
}

/* Where crossing `number` of the nodes from (x, y) on lies: as in `at`, the second node's weight, 1 / distance. */
typedef struct { ints at; floats share, closeness; } Crossing;

Crossing crossing_of(Way way, ints number, int x, int y, int rows, int cols, int sides)
{
  const ints on_row = WHERE(number > 0), n = on_row ? number : -number;
  const floats count = TO_FLOATS(n), place = count * (on_row ? (floats)way.columns : (floats)way.rows);
  ints low = TO_INTS(place);
  low -= place < TO_FLOATS(low) ? (ints)1 : (ints)0;
  const ints shift = way.s > 0 ? n : -n, across = way.c > 0 ? n : -n;
  ints column = x + COUNT + (on_row ? low : across), row = y + (on_row ? shift : low);
  if (sides == PERIODIC) {
    column = (column % cols + cols) % cols;
    row = (row % rows + rows) % rows;
  }
  Crossing found;
  found.share = place - TO_FLOATS(low);
  found.closeness = number == 0 ? (floats)0 : (on_row ? (floats)way.rise : (floats)way.run) / (number == 0 ? (floats)1 : count);
  found.at = number == 0 ? (ints)-1 : (row << 16) | column | (on_row ? (ints)0 : (ints)COLUMN);
  return found;
}

/* surface: heights and tilts of the depths z (pixels). Work-item (x, y) owns a node. */
__kernel void surface(__global const float *z, __global float *heights, __global float *tilts, int rows, int cols, int margin, int sides)
{
  const int x = get_global_id(0), y = get_global_id(1), stride = cols + 2 * margin, p = y * cols + x;
  if (x >= cols) /* a group may reach beyond what is asked for; so below */
    return;
  const float h = -z[p];
  const int q = y * stride + margin + x;
  heights[q] = h;
  if (sides == PERIODIC) {
    for (int to = x + cols; to < cols + margin; to += cols)
      heights[y * stride + margin + to] = h;
    for (int to = x - cols; to >= -margin; to -= cols)
      heights[y * stride + margin + to] = h;
  }
  const int left = max(x - 1, 0), right = min(x + 1, cols - 1), over = max(y - 1, 0), under = min(y + 1, rows - 1);
  tilts[p] = right > left ? (z[y * cols + right] - z[y * cols + left]) / (right - left) : 0;
  tilts[rows * cols + p] = under > over ? (z[under * cols + x] - z[over * cols + x]) / (under - over) : 0;
}

/* tiles: the greatest height of every TILE x TILE nodes. Work-item (i, j) owns a tile. */
__kernel void tiles(__global const float *z, __global float *tiles, int rows, int cols)
{
  const int i = get_global_id(0), j = get_global_id(1), across = (cols - 1) / TILE + 1;
  if (i >= across)
    return;
  float top = NONE;
  for (int y = j * TILE; y < min(j * TILE + TILE, rows); ++y)
    for (int x = i * TILE; x < min(i * TILE + TILE, cols); ++x)
      top = MORE(-z[y * cols + x], top);
  tiles[j * across + i] = top;
}

/* highest: the greatest height, top[0], by way of those of the rows of tiles: one work-item per row of tiles, then one for all. */
__kernel void highest(__global const float *tiles, __global float *top, int rows, int cols, int last)
{
  const int down = (rows - 1) / TILE + 1, across = (cols - 1) / TILE + 1, j = get_global_id(0);
  if (j >= (last ? 1 : down))
    return;
  float high = NONE;
  if (last) {
    for (int i = 0; i < down; ++i)
      high = MORE(top[1 + i], high);
    top[0] = high;
  } else {
    for (int i = 0; i < across; ++i)
      high = MORE(tiles[j * across + i], high);
    top[1 + j] = high;
  }
}

void put_floats(__global float *to, floats v, int left)
{
#if LANES == 1
  *to = v;
#else
  if (left >= LANES)
    ((__global loose_floats *)to)->v = v;
  else
    for (int l = 0; l < left; ++l)
      to[l] = v[l];
#endif
}

void put_ints(__global int *to, ints v, int left)
{
#if LANES == 1
  *to = v;
#else
  if (left >= LANES)
    ((__global loose_ints *)to)->v = v;
  else
    for (int l = 0; l < left; ++l)
      to[l] = v[l];
#endif
}

/* sky: E and its derivatives under a sky. azimuths (count, 4): cosine, sine, width, 0; table: one row per azimuth.
   Work-item (g, y) owns LANES nodes of row y. Order of summation: azimuths. */
__kernel void sky(__global const float *restrict heights, __global const float *restrict tilts, __global const float *restrict tiles, __global const float *restrict top,
                  __global const float *restrict azimuths, __global const float *restrict table, __global float *restrict light,
                  __global float *restrict pulls, __global int *restrict at, __global float *restrict shares, int rows, int cols,
                  int margin, int count, int knots, int sides)
{
  const int x = get_global_id(0) * LANES, y = get_global_id(1), pixels = rows * cols, p = y * cols + x, left = min(cols - x, LANES);
  if (x >= cols)
    return;
  floats own = READ(y * (cols + 2 * margin) + margin + x, heights), gx = 0, gy = 0;
  const float highest_ = top[0];
  const ints here = WHERE(x + COUNT < cols);
  own = here ? own : highest_;
#if LANES == 1
  gx = tilts[p], gy = tilts[pixels + p];
#else
  for (int l = 0; l < left; ++l)
    gx[l] = tilts[p + l], gy[l] = tilts[pixels + p + l];
#endif
  floats sum = 0, by_own = 0, by_x = 0, by_y = 0;
  for (int k = 0; k < count; ++k) {
    const Way way = way_of(azimuths[4 * k], azimuths[4 * k + 1]);
    const float width = azimuths[4 * k + 2];
    const floats s = gx * way.c + gy * way.s;
    floats slope = MORE(-s, 0), by_wall = 0;
    if (sides == DARK) {
      const floats closeness = 1 / wall_of(way, x, y, rows, cols), wall = -own * closeness;
      by_wall = wall > slope ? closeness : 0;
      slope = MORE(wall, slope);
    }
    floats found = sides == PERIODIC ? MORE(slope, LEVEL) : slope;
    const ints number = horizon(heights, tiles, way, x, y, own, &found, highest_, 1e30f, rows, cols, margin, sides);
    slope = number != 0 ? found : slope;
    const Above sky = above(slope, table, k, k, 0, knots);
    const int e = k * pixels + p;
    const floats per_slope = width * (sky.d1 + s * sky.d2);
    sum += width * (sky.c1 + s * sky.c2);
    by_x += width * way.c * sky.c2;
    by_y += width * way.s * sky.c2;
    if (ALL(number == 0)) {
      by_own += per_slope * by_wall;
      put_ints(at + e, -1, left);
    } else {
      const Crossing crossing = crossing_of(way, number, x, y, rows, cols, sides);
      const floats pull = per_slope * crossing.closeness;
      by_own += number == 0 ? per_slope * by_wall : pull;
      put_floats(pulls + e, pull, left);
      put_ints(at + e, crossing.at, left);
      put_floats(shares + e, crossing.share, left);
    }
  }
  const floats inverse = 1 / sqrt(1 + gx * gx + gy * gy), drop = sum * inverse * inverse * inverse;
  put_floats(light + p, sum * inverse, left);
  put_floats(light + pixels + p, by_own * inverse, left);
  put_floats(light + 2 * pixels + p, by_x * inverse - drop * gx, left);
  put_floats(light + 3 * pixels + p, by_y * inverse - drop * gy, left);
  put_floats(light + 4 * pixels + p, inverse, left);
}

#if LANES == 1
/* lamp: the same for a finite source, through slices within it as every node sees it. A ball, `solid` its centre (x, y,
   height) and radius; or a flat, convex quadrangle, `solid` its four corners in turn.

   frames  (pixels, 4)  float  cosine and sine of the azimuth of the source's middle; ball: distance to the centre along the
                               ground; quadrangle: tangent of a quarter of the angle it takes up, 0 where it stands all round
   nodes   (count, 4)   float  sine and cosine of midpoints of -pi/2..pi/2, cosine and sine of midpoints all round
   n_rows  rows of table, evenly in the diamond angle (c, s) -> s / (|c| + |s|), -1..1 over the half c > 0 and on
   Work-item (x, y) owns a node. Order of summation: slices. */
__kernel void lamp(__global const float *heights, __global const float *tilts, __global const float *tiles, __global const float *top, __global const float *frames,
                   __global const float *nodes, __global const float *solid, __global const float *table, __global float *light,
                   __global float *pulls, __global int *at, __global float *shares, int rows, int cols, int margin, int count,
                   int knots, int n_rows, int ball, int sides)
{
  const int x = get_global_id(0), y = get_global_id(1), pixels = rows * cols, p = y * cols + x;
  if (x >= cols)
    return;
  const float own = heights[y * (cols + 2 * margin) + margin + x], gx = tilts[p], gy = tilts[pixels + p];
  const float ux = frames[4 * p], uy = frames[4 * p + 1], extent = frames[4 * p + 2];
  float sum = 0, by_own = 0, by_x = 0, by_y = 0;
  for (int k = 0; k < count; ++k) {
    /* 1. the slice, and the slopes between which the source stands in it, with their derivatives by the own depth */
    float c = nodes[4 * k + 2], s = nodes[4 * k + 3], width = 6.28318531f / count;
    float low = 1, high = 0, low_by = 0, high_by = 0, reach = 0, end = 0; /* ground counts as far as reach; the source's end */
    if (ball) {
      const float radius = solid[3], rise = solid[2] - own, beyond = extent * extent + rise * rise - radius * radius;
      float along, half_;
      if (extent <= radius) {
        const float off = extent * (s * ux - c * uy);
        along = extent * (c * ux + s * uy);
        half_ = sqrt(MORE(radius * radius - off * off, 0));
      } else {
        const float off = radius / extent * nodes[4 * k], on = sqrt((1 - off) * (1 + off));
        c = ux * on - uy * off;
        s = uy * on + ux * off;
        width = radius / extent * nodes[4 * k + 1] * (3.14159265f / count) / on;
        along = extent * on;
        half_ = radius * nodes[4 * k + 1];
      }
      reach = MORE(along, half_);
      end = along + half_;
      if (beyond <= 0)
        low = -STEEP, high = STEEP;
      else {
        const float tangent = sqrt(beyond), square = along * along + rise * rise;
        const float low_c = along * tangent + rise * half_, low_s = rise * tangent - along * half_;
        const float high_c = along * tangent - rise * half_, high_s = rise * tangent + along * half_;
        low = low_c > 0 ? low_s / low_c : low_s > 0 ? STEEP : -STEEP;
        high = high_c > 0 ? high_s / high_c : rise > 0 ? STEEP : -STEEP;
        low_by = low_c > 0 ? square / (low_c * tangent) : 0;
        high_by = high_c > 0 ? square / (high_c * tangent) : 0;
      }
    } else {
      if (extent > 0) {
        const float t = extent * ((2 * k + 1.0f) / count - 1), scale = 1 / (1 + t * t); /* of half the angle from the middle */
        const float on = (1 - t * t) * scale, off = 2 * t * scale;
        c = ux * on - uy * off;
        s = uy * on + ux * off;
        width = 4 * extent / count * scale;
      }
      float least = STEEP, most = -STEEP, least_by = 0, most_by = 0;
      int met = 0;
      for (int i = 0; i < 4; ++i) {
        const int j = (i + 1) & 3;
        const float ax = solid[3 * i] - x, ay = solid[3 * i + 1] - y, bx = solid[3 * j] - x, by = solid[3 * j + 1] - y;
        const float from = c * ay - s * ax, to = c * by - s * bx;
        if ((from <= 0) == (to <= 0))
          continue;
        const float share = from / (from - to), r = c * (ax + share * (bx - ax)) + s * (ay + share * (by - ay));
        if (r <= 0)
          continue;
        const float slope = (solid[3 * i + 2] + share * (solid[3 * j + 2] - solid[3 * i + 2]) - own) / r;
        least_by = slope < least ? 1 / r : least_by;
        most_by = slope > most ? 1 / r : most_by;
        least = LESS(slope, least);
        most = MORE(slope, most);
        end = reach = MORE(r, reach);
        ++met;
      }
      if (met == 1 && least > 0) /* the zenith lies within it */
        most = STEEP, most_by = 0;
      if (met)
        low = least, high = most, low_by = least_by, high_by = most_by;
    }

    /* 2. what limits it from below */
    const Way way = way_of(c, s);
    const float tilt = gx * c + gy * s;
    float slope = MORE(-tilt, 0), by_limit = 0;
    if (sides == DARK) {
      const float wall = wall_of(way, x, y, rows, cols), closeness = 1 / wall;
      if (end > wall && -own * closeness > slope) {
        slope = -own * closeness;
        by_limit = closeness;
      }
    }
    if (low > slope) {
      slope = low;
      by_limit = low_by;
    }
    int number = 0;
    if (slope < high)
      number = horizon(heights, tiles, way, x, y, own, &slope, top[0], reach, rows, cols, margin, OPEN);

    /* 3. the light between */
    Crossing found = {-1, 0, 0};
    float pull = 0;
    if (slope < high) {
      const float diamond = s >= 0 ? (c >= 0 ? s / (c + s) : 1 - c / (s - c)) : (c < 0 ? 2 - s / (-c - s) : 3 + c / (c - s));
      const float place = 0.25f * diamond * n_rows;
      const int row = min((int)place, n_rows - 1), next = row + 1 < n_rows ? row + 1 : 0;
      Above lit = above(slope, table, row, next, place - row, knots);
      const float per_slope = width * (lit.d1 + tilt * lit.d2);
      if (high < STEEP) {
        const Above over = above(high, table, row, next, place - row, knots);
        lit.c1 -= over.c1;
        lit.c2 -= over.c2;
        by_own -= width * (over.d1 + tilt * over.d2) * high_by;
      }
      if (number != 0)
        found = crossing_of(way, number, x, y, rows, cols, OPEN);
      pull = per_slope * found.closeness;
      sum += width * (lit.c1 + tilt * lit.c2);
      by_own += number == 0 ? per_slope * by_limit : pull;
      by_x += width * c * lit.c2;
      by_y += width * s * lit.c2;
    }
    pulls[k * pixels + p] = pull;
    at[k * pixels + p] = found.at;
    shares[k * pixels + p] = found.share;
  }
  const float inverse = 1 / sqrt(1 + gx * gx + gy * gy), drop = sum * inverse * inverse * inverse;
  light[p] = sum * inverse;
  light[pixels + p] = by_own * inverse;
  light[2 * pixels + p] = by_x * inverse - drop * gx;
  light[3 * pixels + p] = by_y * inverse - drop * gy;
  light[4 * pixels + p] = inverse;
}
#endif

/* push: out = gain^2 J v, J the derivative of E by z, v a change of z. Work-item g owns LANES nodes. */
void push_lanes(__global const float *restrict light, __global const float *restrict pulls, __global const int *restrict at,
                __global const float *restrict shares, __global const float *restrict gain, __global const float *restrict v,
                __global float *restrict out, int rows, int cols, int count, int first)
{
  const int pixels = rows * cols, left = min(pixels - first, LANES);
  float sums[LANES];
  for (int l = 0; l < left; ++l)
    sums[l] = 0;
  for (int k = 0; k < count; ++k)
    for (int l = 0; l < left; ++l) {
      const int e = k * pixels + first + l, where = at[e];
      if (where < 0)
        continue;
      const int row = (where >> 16) & 0x3fff, column = where & 0xffff, on_row = (where & COLUMN) == 0;
      const int next_row = on_row ? row : row + 1 < rows ? row + 1 : 0, next_column = on_row ? (column + 1 < cols ? column + 1 : 0) : column;
      const float a = v[row * cols + column], b = v[next_row * cols + next_column];
      sums[l] += pulls[e] * (a + shares[e] * (b - a));
    }
  for (int l = 0; l < left; ++l) {
    const int p = first + l, x = p % cols, y = p / cols;
    const int before = max(x - 1, 0), after = min(x + 1, cols - 1), over = max(y - 1, 0), under = min(y + 1, rows - 1);
    const float dx = after > before ? (v[y * cols + after] - v[y * cols + before]) / (after - before) : 0;
    const float dy = under > over ? (v[under * cols + x] - v[over * cols + x]) / (under - over) : 0;
    const float change = light[pixels + p] * v[p] - light[4 * pixels + p] * sums[l] + light[2 * pixels + p] * dx + light[3 * pixels + p] * dy;
    out[p] = gain[p] * gain[p] * change;
  }
}

__kernel void push(__global const float *restrict light, __global const float *restrict pulls, __global const int *restrict at,
                   __global const float *restrict shares, __global const float *restrict gain, __global const float *restrict v,
                   __global float *restrict out, int rows, int cols, int count)
{
  push_lanes(light, pulls, at, shares, gain, v, out, rows, cols, count, get_global_id(0) * LANES);
}

void add(__global long *sum, float value, int alone)
{
  const long whole = convert_long_rtz(value);
  if (alone)
    *sum += whole;
  else if (whole != 0)
    atom_add(sum, whole);
}

/* pull: sum += unit transpose(J) u, in fixed point, so that no order of summation matters. Work-item g owns LANES nodes. */
void pull_lanes(__global const float *restrict light, __global const float *restrict pulls, __global const int *restrict at,
                __global const float *restrict shares, __global const float *restrict u, __global long *sum, float unit, int rows,
                int cols, int count, int first, int alone)
{
  const int pixels = rows * cols, left = min(pixels - first, LANES);
  for (int l = 0; l < left; ++l) {
    const int p = first + l, x = p % cols, y = p / cols;
    const float own = u[p] * unit;
    const int before = max(x - 1, 0), after = min(x + 1, cols - 1), over = max(y - 1, 0), under = min(y + 1, rows - 1);
    add(sum + p, own * light[pixels + p], alone);
    if (after > before) {
      const float part = own * light[2 * pixels + p] / (after - before);
      add(sum + y * cols + after, part, alone);
      add(sum + y * cols + before, -part, alone);
    }
    if (under > over) {
      const float part = own * light[3 * pixels + p] / (under - over);
      add(sum + under * cols + x, part, alone);
      add(sum + over * cols + x, -part, alone);
    }
  }
  for (int k = 0; k < count; ++k)
    for (int l = 0; l < left; ++l) {
      const int p = first + l, e = k * pixels + p, where = at[e];
      if (where < 0)
        continue;
      const int row = (where >> 16) & 0x3fff, column = where & 0xffff, on_row = (where & COLUMN) == 0;
      const int next_row = on_row ? row : row + 1 < rows ? row + 1 : 0, next_column = on_row ? (column + 1 < cols ? column + 1 : 0) : column;
      const float part = u[p] * unit * light[4 * pixels + p] * pulls[e];
      add(sum + row * cols + column, -(part - part * shares[e]), alone);
      add(sum + next_row * cols + next_column, -part * shares[e], alone);
    }
}

__kernel void pull(__global const float *restrict light, __global const float *restrict pulls, __global const int *restrict at,
                   __global const float *restrict shares, __global const float *restrict u, __global long *sum, float unit, int rows,
                   int cols, int count)
{
  pull_lanes(light, pulls, at, shares, u, sum, unit, rows, cols, count, get_global_id(0) * LANES, 0);
}

/* misfit: residual r = gain E - target, u = gain r, and in part (blocks, 3) the sums of r^2, (gain E)^2 and gain E target.
   Work-item g of this and of all below owns BLOCK nodes and adds them in order. */
__kernel void misfit(__global const float *light, __global const float *gain, __global const float *target, __global float *u,
                     __global double *part, int pixels)
{
  const int g = get_global_id(0);
  if (g * BLOCK >= pixels)
    return;
  double square = 0, bright = 0, both = 0;
  for (int p = g * BLOCK; p < min(pixels, g * BLOCK + BLOCK); ++p) {
    const float seen = gain[p] * light[p], r = seen - target[p];
    u[p] = gain[p] * r;
    square += (double)r * (double)r;
    bright += (double)seen * (double)seen;
    both += (double)seen * (double)target[p];
  }
  part[3 * g] = square;
  part[3 * g + 1] = bright;
  part[3 * g + 2] = both;
}

/* Second difference of v along a line of n nodes, `step` apart in memory, about node i of it; 0 at the ends. */
float bend(__global const float *v, int i, int n, int step)
{
  return i < 1 || i > n - 2 ? 0 : (v[-step] - v[0]) - (v[0] - v[step]);
}

/* The transpose of bend, of itself. */
float unbend(__global const float *v, int i, int n, int step)
{
  float sum = -2 * bend(v, i, n, step);
  if (i > 1)
    sum += bend(v - step, i - 1, n, step);
  if (i < n - 2)
    sum += bend(v + step, i + 1, n, step);
  return sum;
}

/* bending: in part (blocks) the sums of squared second differences along rows and columns. */
__kernel void bending(__global const float *z, __global double *part, int rows, int cols)
{
  const int g = get_global_id(0), pixels = rows * cols;
  if (g * BLOCK >= pixels)
    return;
  double sum = 0;
  for (int p = g * BLOCK; p < min(pixels, g * BLOCK + BLOCK); ++p) {
    const float a = bend(z + p, p % cols, cols, 1), b = bend(z + p, p / cols, rows, cols);
    sum += (double)a * (double)a + (double)b * (double)b;
  }
  part[g] = sum;
}

/* diagonal: adds the diagonal of transpose(J) gain^2 J, without the far nodes' part; is_first: to 12 lambda + least instead. */
__kernel void diagonal(__global const float *light, __global const float *gain, __global float *scale, int rows, int cols, float least,
                       int is_first)
{
  const int x = get_global_id(0), y = get_global_id(1), p = y * cols + x, pixels = rows * cols;
  if (x >= cols)
    return;
  const float own = gain[p] * light[pixels + p];
  float sum = own * own;
  for (int side = -1; side <= 1; side += 2) {
    if (x + side >= 0 && x + side < cols) {
      const float part = gain[p + side] * light[2 * pixels + p + side] * (x + side == 0 || x + side == cols - 1 ? 1.0f : 0.5f);
      sum += part * part;
    }
    if (y + side >= 0 && y + side < rows) {
      const float part = gain[p + side * cols] * light[3 * pixels + p + side * cols] * (y + side == 0 || y + side == rows - 1 ? 1.0f : 0.5f);
      sum += part * part;
    }
  }
  scale[p] = sum + (is_first ? least : scale[p]);
}

/* begin: the downhill direction r = -(sum unit + lambda unbend z), 0 where a bound holds z (free 0); v = r / scale, and
   x = p = s = sum = 0 for conjugate gradients. In part (blocks) v v. */
__kernel void begin(__global const float *z, __global const float *low, __global const float *high, __global const float *scale,
                    __global long *sum, __global float *r, __global float *v, __global float *x, __global float *p, __global float *s,
                    __global float *is_free, __global double *part, float unit, float lambda_, int rows, int cols)
{
  const int g = get_global_id(0), pixels = rows * cols;
  if (g * BLOCK >= pixels)
    return;
  double square = 0;
  for (int i = g * BLOCK; i < min(pixels, g * BLOCK + BLOCK); ++i) {
    const float smooth = unbend(z + i, i % cols, cols, 1) + unbend(z + i, i / cols, rows, cols);
    const float down = -(convert_float(sum[i]) * unit + lambda_ * smooth);
    const float moves = (z[i] <= low[i] && down < 0) || (z[i] >= high[i] && down > 0) ? 0 : 1;
    sum[i] = 0;
    is_free[i] = moves;
    r[i] = moves * down;
    v[i] = r[i] / scale[i];
    x[i] = 0;
    p[i] = 0;
    s[i] = 0;
    square += (double)v[i] * (double)v[i];
  }
  part[g] = square;
}

/* curve: w = free (sum unit + lambda unbend v + damping scale v), the normal equations' matrix times v; sum = 0.
   In part (blocks, 3) r v, v w and v v. */
void curve_block(__global const float *r, __global const float *v, __global const float *scale, __global const float *is_free, __global long *sum,
                 __global float *w, __global double *part, float unit, float lambda_, float damping, int rows, int cols, int g)
{
  const int pixels = rows * cols;
  if (g * BLOCK >= pixels)
    return;
  double product = 0, curvature = 0, square = 0;
  for (int i = g * BLOCK; i < min(pixels, g * BLOCK + BLOCK); ++i) {
    const float smooth = unbend(v + i, i % cols, cols, 1) + unbend(v + i, i / cols, rows, cols);
    w[i] = is_free[i] * (convert_float(sum[i]) * unit + lambda_ * smooth + damping * scale[i] * v[i]);
    sum[i] = 0;
    product += (double)r[i] * (double)v[i];
    curvature += (double)v[i] * (double)w[i];
    square += (double)v[i] * (double)v[i];
  }
  part[3 * g] = product;
  part[3 * g + 1] = curvature;
  part[3 * g + 2] = square;
}

__kernel void curve(__global const float *r, __global const float *v, __global const float *scale, __global const float *is_free, __global long *sum,
                    __global float *w, __global double *part, float unit, float lambda_, float damping, int rows, int cols)
{
  curve_block(r, v, scale, is_free, sum, w, part, unit, lambda_, damping, rows, cols, get_global_id(0));
}

/* go: a step of conjugate gradients with one sum (Chronopoulos and Gear 1989): p = v + beta p, s = w + beta s, x += alpha p,
   r -= alpha s, v = r / scale. */
void go_block(__global const float *scale, __global const float *w, __global float *r, __global float *v, __global float *x, __global float *p,
              __global float *s, float alpha, float beta, int pixels, int g)
{
  for (int i = g * BLOCK; i < min(pixels, g * BLOCK + BLOCK); ++i) {
    p[i] = v[i] + beta * p[i];
    s[i] = w[i] + beta * s[i];
    x[i] += alpha * p[i];
    r[i] -= alpha * s[i];
    v[i] = r[i] / scale[i];
  }
}

__kernel void go(__global const float *scale, __global const float *w, __global float *r, __global float *v, __global float *x, __global float *p,
                 __global float *s, float alpha, float beta, int pixels)
{
  go_block(scale, w, r, v, x, p, s, alpha, beta, pixels, get_global_id(0));
}

/* solve: all of conjugate gradients after begin, by one work-item: on a small grid a CPU takes longer to start a kernel than to
   run it. The same operations in the same order as the kernels above, and as Descent.solve between them. gained[0]: what the
   quadratic model gains. */
__kernel void solve(__global const float *restrict light, __global const float *restrict pulls, __global const int *restrict at,
                    __global const float *restrict shares, __global const float *restrict gain, __global const float *restrict scale,
                    __global const float *restrict is_free, __global long *restrict sum, __global float *restrict r, __global float *restrict v,
                    __global float *restrict w, __global float *restrict x, __global float *restrict p, __global float *restrict s,
                    __global float *restrict u, __global double *restrict part, __global double *restrict gained, double length,
                    double fixed_, float lambda_, float damping, double least, int most, int rows, int cols, int count)
{
  const int pixels = rows * cols, blocks = (pixels - 1) / BLOCK + 1;
  double start = 0, before = 0, alpha = 0, total = 0;
  if (get_global_id(0) > 0)
    return;
  for (int number = 0; number < most; ++number) {
    const double unit = fixed_ / length;
    for (int first = 0; first < pixels; first += LANES)
      push_lanes(light, pulls, at, shares, gain, v, u, rows, cols, count, first);
    for (int first = 0; first < pixels; first += LANES)
      pull_lanes(light, pulls, at, shares, u, sum, (float)unit, rows, cols, count, first, 1);
    double product = 0, curvature = 0, square = 0;
    for (int g = 0; g < blocks; ++g) {
      curve_block(r, v, scale, is_free, sum, w, part, (float)(1 / unit), lambda_, damping, rows, cols, g);
      product += part[3 * g];
      curvature += part[3 * g + 1];
      square += part[3 * g + 2];
    }
    if (number == 0)
      start = product;
    const double beta = number == 0 ? 0 : product / before;
    if (number > 0)
      curvature -= beta * product / alpha;
    if (!(product > least * start && curvature > 0))
      break;
    alpha = product / curvature;
    before = product;
    length = sqrt(square);
    for (int g = 0; g < blocks; ++g)
      go_block(scale, w, r, v, x, p, s, (float)alpha, (float)beta, pixels, g);
    total += 0.5 * alpha * product;
  }
  gained[0] = total;
}

/* move: to = z + x, within its bounds. */
__kernel void move(__global const float *z, __global const float *x, __global const float *low, __global const float *high, __global float *to,
                   int pixels)
{
  const int g = get_global_id(0);
  for (int i = g * BLOCK; i < min(pixels, g * BLOCK + BLOCK); ++i)
    to[i] = LESS(MORE(z[i] + x[i], low[i]), high[i]);
}
