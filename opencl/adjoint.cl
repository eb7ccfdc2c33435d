/* Irradiance of a depth map and its derivatives, for the inverse problem (docs/explanation).

E = (1 + |grad z|^2)^(-1/2) sum over slices of width x [C1(T) + s C2(T)], s = e . grad z, C1 and C2 the
integrals of B sin cos and of B cos^2 above the slope T: the largest of the level, the tangent plane, the
wall, the source's own lower edge and the horizon. The horizon is the largest (height - own height) / distance
over every crossing of the slice with a row or a column of the grid; where it is the limit, dE/dT goes to the
two nodes beside that crossing, over its distance. Where the tangent plane is the limit the integrand is 0 and
so is the derivative.

Lengths are in spacings. z is depth, heights are -z. `pixels` is rows x cols.

  heights  (rows, cols + 2 margin)  float  -z; in the margins -1e30, or the other side of a map that repeats
  tilts    (2, pixels)              float  dz/dx, dz/dy by central differences, one-sided at the border unless
                                           the map repeats
  tiles    (down x across)          float  the greatest height of every TILE x TILE nodes
  top      (1)                      int    that of all, as ordered() gives it
  numbers  (count, room)            int    under a sky: number of the crossing that is the horizon (horizons);
                                           0 where the ground is no limit; room = pixels + PIXEL_PADDING
  slopes   (count, room)            float  and the slope to it
  light    (4, pixels)              float  out: E; dE by own depth, by dz/dx, by dz/dy
  held     (pixels)                 int    out: slices of a node that another node limits, or two: its links
  first, second                     int    out: these nodes; (pixels / LINK_BLOCK, count, LINK_BLOCK): node by
                                           node, their links
  near, far                         float  out: dE by the depth of the first, of the second; likewise
  table    (n, knots, 4)            float  integrals of B cos^2 and of B sin cos from sin(elevation) = i /
                                           (knots - 1) to the zenith, and what to add up to the next knot;
                                           knots 0: brightness 1, closed form
  sides                             0 open, 1 dark, 2 periodic

All arithmetic is +, -, x, / and sqrt, correctly rounded and in one order, so that every backend finds the
same bits. Twin of warp_kernels/adjoint.py. */
#include "lanes.h"
#include "strips.h"
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#define LINK(p, k) (((p) / LINK_BLOCK * count + (k)) * LINK_BLOCK + (p) % LINK_BLOCK)

#if LANES == 1
#define TO_FLOATS convert_float
#define COUNT 0
#define ALL(v) (v)
#define READ(offset, pointer) (pointer)[offset]
#define READ_INTS READ
#define LANE(v, l) (v)
#else
#define TO_FLOATS JOIN(convert_float, LANES)
#define COUNT (ints)(0, 1, 2, 3, 4, 5, 6, 7)
#define ALL(v) all(v)
/* PoCL calls its vector builtins; these go inline */
typedef struct __attribute__((packed)) { floats v; } loose_floats;
typedef struct __attribute__((packed)) { ints v; } loose_ints;
#define READ(offset, pointer) (((__global const loose_floats *)((pointer) + (offset)))->v)
#define READ_INTS(offset, pointer) (((__global const loose_ints *)((pointer) + (offset)))->v)
#define LANE(v, l) (v)[l]
#endif
#define MORE(a, b) ((a) > (b) ? (a) : (b))
#define LESS(a, b) ((a) < (b) ? (a) : (b))

/* Arc tangent of v >= 0 to 2e-7, by a polynomial fitted for least maximum error. */
floats arc_tangent(floats v)
{
  const floats r = v > 1 ? 1 / v : v, q = r * r;
  floats p = ARC_TANGENT_0;
  p = p * q + ARC_TANGENT_1;
  p = p * q + ARC_TANGENT_2;
  p = p * q + ARC_TANGENT_3;
  p = p * q + ARC_TANGENT_4;
  p = p * q + ARC_TANGENT_5;
  p = p * q + ARC_TANGENT_6;
  p = p * q + ARC_TANGENT_7;
  return v > 1 ? HALF_PI - p * r : p * r;
}

/* Light between the slope T and the zenith: integrals of B sin cos (c1) and of B cos^2 (c2), and their
   derivative by T. */
typedef struct { floats c1, c2, d1, d2; } Above;

Above above(floats t, __global const float *table, int row, int next, float share, int knots)
{
  const floats square = 1 + t * t, cosine = 1 / square;
  Above sky;
  if (knots == 0) {
    sky.c1 = 0.5f * cosine;
    sky.c2 = 0.5f * (HALF_PI - arc_tangent(t) - t * cosine);
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

/* A slice: the azimuth's cosine and sine, columns per row and rows per column, and their reciprocal
   inner_products. */
typedef struct { float c, s, columns, rise, rows, run; } Way;

Way way_of(float c, float s)
{
  c = fabs(c) > PARALLEL ? c : 0;
  s = fabs(s) > PARALLEL ? s : 0;
  const float across = fabs(c), along = fabs(s);
  const Way way = {c, s, along > 0 ? c / along : 0, along, across > 0 ? s / across : 0, across};
  return way;
}

/* The highest ground in the tiles that hold columns left..right of rows over..under, what is off the map left
   out. */
float highest_in(__global const float *tiles, int left, int right, int over, int under, int rows, int cols)
{
  const int across = (cols - 1) / TILE + 1;
  float high = NONE;
  for (int j = max(over, 0) / TILE; j <= min(under, rows - 1) / TILE; ++j)
    for (int i = max(left, 0) / TILE; i <= min(right, cols - 1) / TILE; ++i)
      high = MORE(tiles[j * across + i], high);
  return high;
}

/* Raises `best`, which is not below 0, to the horizon of the LANES nodes from (x, y) on, as far as `reach`,
   and gives the number of its crossing: n rows on, or -n columns on; 0 where nothing stands above `best`.
   TILE crossings at a time are left out where no ground near them is high enough. */
ints horizon(__global const float *heights, __global const float *tiles, Way way, int x, int y, floats own,
             floats *best, float top, float reach, int rows, int cols, int margin, int sides)
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
      if (ALL((top - own) * (ROUNDING * closeness) <= *best))
        break;
      if (sides != PERIODIC && fabs(way.columns) <= 2) {
        const int last = x + (int)floor((n + TILE - 1) * way.columns), end = y + up * (n + TILE - 1);
        const float high = highest_in(tiles, min(column, last), max(column, last) + LANES, min(row, end),
                                      max(row, end), rows, cols);
        if (ALL((high - own) * (ROUNDING * closeness) <= *best)) {
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
  const int n_columns = way.c == 0          ? 0
                        : sides == PERIODIC ? 1 << 20
                        : way.c > 0         ? cols - 1 - x
                                            : x + LANES - 1;
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
      if (ALL((top - own) * (ROUNDING * closeness) <= *best))
        break;
      if (sides != PERIODIC && fabs(way.rows) <= 2) {
        const int last = column + on * (TILE - 1), end = y + (int)floor((n + TILE - 1) * way.rows);
        const float high = highest_in(tiles, min(column, last), max(column, last) + LANES - 1, min(row, end),
                                      max(row, end) + 1, rows, cols);
        if (ALL((high - own) * (ROUNDING * closeness) <= *best)) {
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

/* The nodes beside crossing `number` of the nodes from (x, y) on, the second one's weight, 1 / distance. */
typedef struct { ints first, second; floats share, closeness; } Crossing;

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
  const ints next_column = column + 1 < cols ? column + 1 : 0, next_row = row + 1 < rows ? row + 1 : 0;
  Crossing at;
  at.first = row * cols + column;
  at.second = on_row ? row * cols + next_column : next_row * cols + column;
  at.share = place - TO_FLOATS(low);
  at.closeness = number == 0
                        ? (floats)0
                        : (on_row ? (floats)way.rise : (floats)way.run) / (number == 0 ? (floats)1 : count);
  return at;
}

/* A float as a whole number of the same order, and back. */
int ordered(float v)
{
  const int bits = as_int(v);
  return bits < 0 ? bits ^ 0x7fffffff : bits;
}

float unordered(int bits)
{
  return as_float(bits < 0 ? bits ^ 0x7fffffff : bits);
}

/* Node i of a line of n, which may lie one beyond its ends. */
int on_line(int i, int n, int sides)
{
  return sides == PERIODIC ? (i + n) % n : clamp(i, 0, n - 1);
}

/* 1 over the distance of the nodes on both sides of node i of n, or of it and its one neighbour. */
float half_within(int i, int n, int sides)
{
  return sides == PERIODIC || (i > 0 && i < n - 1) ? 0.5f : 1.0f;
}

/* Central difference of v along a line of n nodes, `step` apart in memory, about node i of it. */
float rise_at(__global const float *v, int i, int n, int step, int sides)
{
  return (v[on_line(i + 1, n, sides) * step] - v[on_line(i - 1, n, sides) * step]) * half_within(i, n, sides);
}

/* surface: heights and tilts of the depths z (pixels), and a top for tiles to raise. Work-item (x, y) owns a
   node. */
__kernel void surface(__global const float *z, __global float *heights, __global float *tilts,
                      __global int *top, int rows, int cols, int margin, int sides)
{
  const int x = get_global_id(0), y = get_global_id(1), stride = cols + 2 * margin, p = y * cols + x;
  if (x >= cols) /* a group may reach beyond what is asked for; so below */
    return;
  const float h = -z[p];
  if (p == 0)
    top[0] = ordered(NONE);
  const int q = y * stride + margin + x;
  heights[q] = h;
  if (sides == PERIODIC) {
    for (int to = x + cols; to < cols + margin; to += cols)
      heights[y * stride + margin + to] = h;
    for (int to = x - cols; to >= -margin; to -= cols)
      heights[y * stride + margin + to] = h;
  }
  tilts[p] = rise_at(z + y * cols, x, cols, 1, sides);
  tilts[rows * cols + p] = rise_at(z + x, y, rows, cols, sides);
}

/* tiles: the greatest height of every TILE x TILE nodes, and of all. Work-item (i, j) owns a tile. */
__kernel void tiles(__global const float *z, __global float *tiles, __global int *top, int rows, int cols)
{
  const int i = get_global_id(0), j = get_global_id(1), across = (cols - 1) / TILE + 1;
  if (i >= across)
    return;
  float high = NONE;
  for (int y = j * TILE; y < min(j * TILE + TILE, rows); ++y)
    for (int x = i * TILE; x < min(i * TILE + TILE, cols); ++x)
      high = MORE(-z[y * cols + x], high);
  tiles[j * across + i] = high;
  atomic_max(top, ordered(high));
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

/* LANES nodes of row y from x on: height (none is above those that are not there), dz/dx, dz/dy. */
typedef struct { floats own, gx, gy; } Nodes;

Nodes nodes_at(__global const float *heights, __global const float *tilts, float highest, int x, int y,
               int rows, int cols, int margin)
{
  const int pixels = rows * cols, p = y * cols + x;
  const floats own = READ(y * (cols + 2 * margin) + margin + x, heights);
  const ints here = WHERE(x + COUNT < cols);
  Nodes nodes;
  nodes.own = here ? own : highest;
#if LANES == 1
  nodes.gx = tilts[p];
  nodes.gy = tilts[pixels + p];
#else
  nodes.gx = nodes.gy = 0;
  for (int l = 0; l < min(cols - x, LANES); ++l)
    nodes.gx[l] = tilts[p + l], nodes.gy[l] = tilts[pixels + p + l];
#endif
  return nodes;
}

/* The limit of a slice of a sky without the ground: the level, the tangent plane or the wall, then with
   its derivative. */
typedef struct { floats slope, by_wall; } Limit;

Limit limit_of(Way way, Nodes nodes, int x, int y, int rows, int cols, int sides)
{
  const floats s = nodes.gx * way.c + nodes.gy * way.s;
  Limit limit = {MORE(-s, 0), 0};
  if (sides == DARK) {
    const floats closeness = 1 / wall_of(way, x, y, rows, cols), wall = -nodes.own * closeness;
    limit.by_wall = wall > limit.slope ? closeness : 0;
    limit.slope = MORE(wall, limit.slope);
  }
  return limit;
}

/* horizons: the horizon of every slice under a sky: its crossing's number (as horizon gives it) and its
   slope. azimuths (count, 4): cosine, sine, width, 0. Work-item (g, y, a) owns LANES nodes of row y, and
   `ways` azimuths. */
__kernel void horizons(__global const float *restrict heights, __global const float *restrict tilts,
                       __global const float *restrict tiles, __global const int *restrict top,
                       __global const float *restrict azimuths, __global int *restrict numbers,
                       __global float *restrict slopes, int rows, int cols, int margin, int count, int sides,
                       int ways)
{
  const int x = get_global_id(0) * LANES, y = get_global_id(1), from = get_global_id(2) * ways;
  if (x >= cols)
    return;
  const float highest = unordered(top[0]);
  const Nodes nodes = nodes_at(heights, tilts, highest, x, y, rows, cols, margin);
  for (int k = from; k < min(count, from + ways); ++k) {
    const Way way = way_of(azimuths[4 * k], azimuths[4 * k + 1]);
    const floats least = limit_of(way, nodes, x, y, rows, cols, sides).slope;
    floats slope = sides == PERIODIC ? MORE(least, LEAST_SEARCHED_SLOPE) : least;
    const ints number =
        horizon(heights, tiles, way, x, y, nodes.own, &slope, highest, 1e30f, rows, cols, margin, sides);
    put_ints(numbers + k * (rows * cols + PIXEL_PADDING) + y * cols + x, number, cols - x);
    put_floats(slopes + k * (rows * cols + PIXEL_PADDING) + y * cols + x, slope, cols - x);
  }
}

/* sky: E and its derivatives under a sky, after horizons. table: one row per azimuth. Work-item (g, y) owns
   LANES nodes of row y. Order of summation: azimuths. */
__kernel void sky(__global const float *restrict heights, __global const float *restrict tilts,
                  __global const int *restrict top, __global const int *restrict numbers,
                  __global const float *restrict slopes, __global const float *restrict azimuths,
                  __global const float *restrict table, __global float *restrict light,
                  __global int *restrict held, __global int *restrict first, __global int *restrict second,
                  __global float *restrict near, __global float *restrict far, int rows, int cols, int margin,
                  int count, int knots, int sides)
{
  const int x = get_global_id(0) * LANES, y = get_global_id(1), pixels = rows * cols, p = y * cols + x,
            left = min(cols - x, LANES);
  if (x >= cols)
    return;
  const Nodes nodes = nodes_at(heights, tilts, unordered(top[0]), x, y, rows, cols, margin);
  const ints here = WHERE(x + COUNT < cols);
  const floats gx = nodes.gx, gy = nodes.gy, inverse = 1 / sqrt(1 + gx * gx + gy * gy);
  floats sum = 0, by_own = 0, by_x = 0, by_y = 0;
  int links[LANES];
  for (int l = 0; l < LANES; ++l)
    links[l] = 0;
  for (int k = 0; k < count; ++k) {
    const Way way = way_of(azimuths[4 * k], azimuths[4 * k + 1]);
    const float width = azimuths[4 * k + 2];
    const floats s = gx * way.c + gy * way.s;
    const Limit limit = limit_of(way, nodes, x, y, rows, cols, sides);
    const ints number = here ? READ_INTS(k * (pixels + PIXEL_PADDING) + p, numbers) : 0;
    const floats tangent = READ(k * (pixels + PIXEL_PADDING) + p, slopes),
                 slope = number != 0 ? tangent : limit.slope;
    const Above sky = above(slope, table, k, k, 0, knots);
    const floats per_slope = width * (sky.d1 + s * sky.d2);
    sum += width * (sky.c1 + s * sky.c2);
    by_x += width * way.c * sky.c2;
    by_y += width * way.s * sky.c2;
    if (ALL(number == 0))
      by_own += per_slope * limit.by_wall;
    else {
      const Crossing crossing = crossing_of(way, number, x, y, rows, cols, sides);
      const floats pull = per_slope * crossing.closeness, all_ = -pull * inverse,
                   other = all_ * crossing.share, one = all_ - other;
      by_own += number == 0 ? per_slope * limit.by_wall : pull;
      for (int l = 0; l < left; ++l)
        if (LANE(number, l) != 0) {
          const int e = LINK(p + l, links[l]++);
          first[e] = LANE(crossing.first, l);
          second[e] = LANE(crossing.second, l);
          near[e] = LANE(one, l);
          far[e] = LANE(other, l);
        }
    }
  }
  const floats drop = sum * inverse * inverse * inverse;
  put_floats(light + p, sum * inverse, left);
  put_floats(light + pixels + p, by_own * inverse, left);
  put_floats(light + 2 * pixels + p, by_x * inverse - drop * gx, left);
  put_floats(light + 3 * pixels + p, by_y * inverse - drop * gy, left);
  for (int l = 0; l < left; ++l)
    held[p + l] = links[l];
}

#if LANES == 1
/* lamp: the same for a finite source, through slices within it as every node sees it. A ball, `solid` its
   centre (x, y, height) and radius; or a flat, convex quadrangle, `solid` its four corners in turn.

   frames  (pixels, 4)  float  cosine and sine of the azimuth of the source's middle; ball: distance to the
                               centre along the ground; quadrangle: tangent of a quarter of the angle it takes
                               up, 0 where it stands all round
   quadrature  (count, 4)  float  sine and cosine of midpoints of -pi/2..pi/2, cosine and sine of midpoints
                               all round
   n_rows  rows of table, evenly in the diamond angle (c, s) -> s / (|c| + |s|), -1..1 over the half c > 0 and
           on
   Work-item (x, y) owns a node. Order of summation: slices. */
__kernel void lamp(__global const float *heights, __global const float *tilts, __global const float *tiles,
                   __global const int *top, __global const float *frames,
                   __global const float *quadrature, __global const float *solid, __global const float *table,
                   __global float *light,
                   __global int *held, __global int *first, __global int *second, __global float *near,
                   __global float *far, int rows, int cols, int margin, int count, int knots, int n_rows,
                   int ball, int sides)
{
  const int x = get_global_id(0), y = get_global_id(1), pixels = rows * cols, p = y * cols + x;
  if (x >= cols)
    return;
  const float own = heights[y * (cols + 2 * margin) + margin + x], gx = tilts[p], gy = tilts[pixels + p];
  const float ux = frames[4 * p], uy = frames[4 * p + 1], extent = frames[4 * p + 2],
              inverse = 1 / sqrt(1 + gx * gx + gy * gy);
  float sum = 0, by_own = 0, by_x = 0, by_y = 0;
  int links = 0;
  for (int k = 0; k < count; ++k) {
    /* 1. the slice, and the slopes between which the source stands in it, with their derivatives by the own
       depth */
    float c = quadrature[4 * k + 2], s = quadrature[4 * k + 3], width = TWO_PI / count;
    /* ground counts as far as reach; the source's end */
    float low = 1, high = 0, low_by = 0, high_by = 0, reach = 0, end = 0;
    if (ball) {
      const float radius = solid[3], rise = solid[2] - own,
                  beyond = extent * extent + rise * rise - radius * radius;
      float along, half_;
      if (extent <= radius) {
        const float offset = extent * (s * ux - c * uy);
        along = extent * (c * ux + s * uy);
        half_ = sqrt(MORE(radius * radius - offset * offset, 0));
      } else {
        const float sin_d = radius / extent * quadrature[4 * k], cos_d = sqrt((1 - sin_d) * (1 + sin_d));
        c = ux * cos_d - uy * sin_d;
        s = uy * cos_d + ux * sin_d;
        width = radius / extent * quadrature[4 * k + 1] * (PI / count) / cos_d;
        along = extent * cos_d;
        half_ = radius * quadrature[4 * k + 1];
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
        /* of half the angle from the middle */
        const float t = extent * ((2 * k + 1.0f) / count - 1), scale = 1 / (1 + t * t);
        const float cos_d = (1 - t * t) * scale, sin_d = 2 * t * scale;
        c = ux * cos_d - uy * sin_d;
        s = uy * cos_d + ux * sin_d;
        width = 4 * extent / count * scale;
      }
      float least = STEEP, most = -STEEP, least_by = 0, most_by = 0;
      int met = 0;
      for (int i = 0; i < 4; ++i) {
        const int j = (i + 1) & 3;
        const float ax = solid[3 * i] - x, ay = solid[3 * i + 1] - y, bx = solid[3 * j] - x,
                    by = solid[3 * j + 1] - y;
        const float from = c * ay - s * ax, to = c * by - s * bx;
        if ((from <= 0) == (to <= 0))
          continue;
        const float share = from / (from - to),
                    r = c * (ax + share * (bx - ax)) + s * (ay + share * (by - ay));
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
      number =
          horizon(heights, tiles, way, x, y, own, &slope, unordered(top[0]), reach, rows, cols, margin, OPEN);

    /* 3. the light between */
    if (slope < high) {
      const float diamond =
          s >= 0 ? (c >= 0 ? s / (c + s) : 1 - c / (s - c)) : (c < 0 ? 2 - s / (-c - s) : 3 + c / (c - s));
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
      sum += width * (lit.c1 + tilt * lit.c2);
      by_x += width * c * lit.c2;
      by_y += width * s * lit.c2;
      if (number == 0)
        by_own += per_slope * by_limit;
      else {
        const Crossing crossing = crossing_of(way, number, x, y, rows, cols, OPEN);
        const float pull = per_slope * crossing.closeness, all_ = -pull * inverse,
                    other = all_ * crossing.share;
        const int e = LINK(p, links++);
        by_own += pull;
        first[e] = crossing.first;
        second[e] = crossing.second;
        near[e] = all_ - other;
        far[e] = other;
      }
    }
  }
  const float drop = sum * inverse * inverse * inverse;
  light[p] = sum * inverse;
  light[pixels + p] = by_own * inverse;
  light[2 * pixels + p] = by_x * inverse - drop * gx;
  light[3 * pixels + p] = by_y * inverse - drop * gy;
  held[p] = links;
}
#endif

int link_at(int p, int k, int count)
{
  return (p / LINK_BLOCK * count + k) * LINK_BLOCK + p % LINK_BLOCK;
}

#if LANES == 1
/* Links of a node while they are made: how many there are, how many there may be, and room for those of a
   node. */
typedef struct {
  __global int *first, *second;
  __global float *near, *far;
  int p, made, most, room;
} Made;

/* A link to the two nodes of a crossing, `part` the derivative by its height; the last one takes it in where
   no more may be. */
void add_link(Made *links, Crossing at, float part)
{
  const float other = part * at.share, one = part - other;
  if (links->made < links->most) {
    const int e = link_at(links->p, links->made++, links->room);
    links->first[e] = at.first;
    links->second[e] = at.second;
    links->near[e] = -one;
    links->far[e] = -other;
  } else {
    const int e = link_at(links->p, links->made - 1, links->room);
    links->near[e] -= one;
    links->far[e] -= other;
  }
}

/* Copies `held` links of node p of another image, with room for `count`, times `part`. */
void copy_links(Made *links, int held, __global const int *first, __global const int *second,
                __global const float *near, __global const float *far, int count, float part)
{
  for (int k = 0; k < held; ++k) {
    const int from = link_at(links->p, k, count), to = link_at(links->p, links->made++, links->room);
    links->first[to] = first[from];
    links->second[to] = second[from];
    links->near[to] = part * near[from];
    links->far[to] = part * far[from];
  }
}

/* Derivative of `below` by the plane's slope, with the sign turned; and by the slope. */
float turn(float s) { return arctan(s) + s / (1 + s * s); }

float below_by(float s, float plane)
{
  const float q = 1 / (1 + s * s);
  return 2 * q * q * (s - plane);
}

/* add_ground: light and links of an image with the light that ground sends. Ground of mean radiance m fills
   what is not sky: E + (pi - U) m, U the irradiance by a sky of brightness 1. m = num / den, sums over the
   strips of visible ground, of shares x radiance and of shares (opencl/interreflection.cl); the radiance is
   given. A strip's share depends on the slopes to its two ends, and its light on where it begins behind
   nearer ground: every strip gives links to the crossings that bound it.

  z                     (pixels)        float  depth
  sky_light .. sky_far  as light .. far, of the sky of brightness 1; is_sky: this is the image's own source
  sums                                  float  num of every image and den, by `gather` at every node
  radiance              (images, pixels)  float  of the ground; this is image `number`
  ways, places, crossings               as in opencl/interreflection.cl, `azimuths` of `steps` crossings
  all_light .. all_far                  out: as light .. far, with room for `room` links of a node: its own,
                                        the sky's and one at least for every azimuth

Work-item p owns node p. */
__kernel void add_ground(__global const float *light, __global const int *held, __global const int *first,
                         __global const int *second, __global const float *near, __global const float *far,
                         __global const float *sky_light, __global const int *sky_held,
                         __global const int *sky_first, __global const int *sky_second,
                         __global const float *sky_near, __global const float *sky_far,
                         __global const float *z, __global const float *tilts, __global const float *sums,
                         __global const float *radiance, __global const float *ways,
                         __global const int *places, __global const float *crossings,
                         __global float *all_light, __global int *all_held, __global int *all_first,
                         __global int *all_second, __global float *all_near, __global float *all_far,
                         int number, int images, int rows, int cols, int width, int shift, int azimuths,
                         int steps, int count, int sky_count, int room, int is_sky, int sides)
{
  const int p = get_global_id(0), pixels = rows * cols, x = p % cols, y = p / cols;
  if (p >= pixels)
    return;
  /* 1. the mean radiance */
  const int phases = 1 << shift, place = (y * phases + x % phases) * width + x / phases,
            all_places = rows * phases * width;
  const float den = sums[images * all_places + place], left = PI - sky_light[p];
  const float m = den > 0 ? sums[number * all_places + place] / den : 0, per = den > 0 ? left / den : 0;
  /* 2. links of the direct light, and of U */
  Made links = {all_first, all_second, all_near, all_far, p, 0, 0, room};
  copy_links(&links, held[p], first, second, near, far, count, is_sky ? 1 - m : 1);
  if (!is_sky)
    copy_links(&links, sky_held[p], sky_first, sky_second, sky_near, sky_far, sky_count, -m);
  /* 3. those of the strips */
  __global const float *sent = radiance + number * pixels;
  const float gx = tilts[p], gy = tilts[pixels + p];
  float by_own = 0, by_x = 0, by_y = 0;
  for (int k = 0; k < (den > 0 ? azimuths : 0); ++k) {
    const float cosine = ways[4 * k], sine = ways[4 * k + 1], plane = -(gx * cosine + gy * sine);
    const int on_columns = ways[4 * k + 2] > 0;
    float slope = plane, past = below(plane, plane), before = 0, was_distance = 0, by_plane = 0, by_top = 0;
    Crossing was = {p, p, 0, 0}, top = was;
    links.most = room - (azimuths - 1 - k); /* one at least for each azimuth that follows */
    for (int j = k * steps; j < (k + 1) * steps; ++j) {
      /* 3.1 the crossing, if it is on the map, and if any ground there could be seen */
      const float weight = crossings[3 * j], distance = crossings[3 * j + 1];
      int u = x + places[2 * j], v = y + places[2 * j + 1], u_next = on_columns ? u : u + 1,
          v_next = on_columns ? v + 1 : v;
      if (sides == PERIODIC) {
        u = (u % cols + cols) % cols;
        v = (v % rows + rows) % rows;
        u_next = (u_next % cols + cols) % cols;
        v_next = (v_next % rows + rows) % rows;
      } else if (u < 0 || v < 0 || u_next >= cols || v_next >= rows)
        break;
      if (!(z[p] > slope * distance))
        break;
      const Crossing at = {v * cols + u, v_next * cols + u_next, weight, crossings[3 * j + 2]};
      const float a = -z[at.first], stands = a + weight * (-z[at.second] - a) + z[p],
                  rises = stands * at.closeness;
      /* 3.2 the strip that it opens, and its derivatives by the crossing, by what bounds it below, and by the
         crossing before */
      if (rises > slope) {
        const float low = before - slope * was_distance, high = stands - slope * distance, whole = high - low,
                    here = below(rises, plane);
        const int begins = low < 0 && whole > 0 && was_distance > 0, is_between = begins && -low < whole;
        const float part = is_between ? -low / whole : begins ? 1.0f : 0.0f;
        const float near_light = sent[was.first] + was.share * (sent[was.second] - sent[was.first]),
                    far_light = sent[at.first] + weight * (sent[at.second] - sent[at.first]),
                    mean = 0.5f * (near_light * (1 - part) + far_light * (1 + part));
        const float by_part =
            is_between ? 0.5f * (here - past) * (far_light - near_light) / (whole * whole) : 0.0f;
        const float by_slope =
            by_part * (high * was_distance - low * distance) - mean * below_by(slope, plane);
        if (is_between) {
          add_link(&links, was, per * -by_part * high);
          by_own -= by_part * high;
        }
        by_plane -= mean * (turn(rises) - turn(slope));
        if (top.closeness > 0) {
          by_top += by_slope * top.closeness;
          add_link(&links, top, per * by_top);
          by_own += by_top;
        } else
          by_plane += by_slope;
        by_top = mean * below_by(rises, plane) * at.closeness + by_part * low;
        top = at;
        past = here;
        slope = rises;
      }
      before = stands;
      was = at;
      was_distance = distance;
    }
    /* 3.3 all that is not sky */
    float end = sides == PERIODIC ? slope : MORE(slope, 0.0f);
    if (sides == DARK) {
      const float closeness = 1 / wall_of(way_of(cosine, sine), x, y, rows, cols), wall = z[p] * closeness;
      if (wall > end)
        by_own -= m * below_by(wall, plane) * closeness;
      end = MORE(wall, end);
    }
    by_plane += m * (turn(end) - turn(plane));
    if (top.closeness > 0) {
      if (end == slope)
        by_top -= m * below_by(end, plane) * top.closeness;
      add_link(&links, top, per * by_top);
      by_own += by_top;
    }
    by_x -= cosine * by_plane;
    by_y -= sine * by_plane;
  }
  all_held[p] = links.made;
  all_light[p] = light[p] + left * m;
  all_light[pixels + p] = light[pixels + p] - m * sky_light[pixels + p] + per * by_own;
  all_light[2 * pixels + p] = light[2 * pixels + p] - m * sky_light[2 * pixels + p] + per * by_x;
  all_light[3 * pixels + p] = light[3 * pixels + p] - m * sky_light[3 * pixels + p] + per * by_y;
}
#endif

/* An image's derivative J by depth: rows of it are applied to a change of depths, and added up. */
typedef struct {
  __global const float *light;
  __global const int *held, *first, *second;
  __global const float *near, *far;
  int count, sides;
} Links;

/* Row p of J times v: by how much E changes there. */
float change_at(Links links, __global const float *v, int rows, int cols, int p)
{
  const int pixels = rows * cols, x = p % cols, y = p / cols, count = links.count, sides = links.sides;
  float sum = links.light[pixels + p] * v[p];
  if (cols > 1)
    sum += links.light[2 * pixels + p] * rise_at(v + y * cols, x, cols, 1, sides);
  if (rows > 1)
    sum += links.light[3 * pixels + p] * rise_at(v + x, y, rows, cols, sides);
  for (int k = 0; k < links.held[p]; ++k) {
    const int e = LINK(p, k);
    sum += links.near[e] * v[links.first[e]] + links.far[e] * v[links.second[e]];
  }
  return sum;
}

void add(__global long *sum, long value, int exclusive)
{
  if (exclusive)
    *sum += value;
  else if (value != 0)
    atom_add(sum, value);
}

/* sum += row p of J times u, in whole numbers, so that no order of summation matters; its elements squared if
   asked for. */
void spread_at(Links links, __global long *sum, float u, int squared, int rows, int cols, int p,
               int exclusive)
{
  const int pixels = rows * cols, x = p % cols, y = p / cols, count = links.count, sides = links.sides;
#define SPREAD(to, part)                                                                                     \
  {                                                                                                          \
    const float part_ = part;                                                                                \
    add(sum + (to), convert_long_rtz((squared ? part_ * part_ : part_) * u), exclusive);                     \
  }
  SPREAD(p, links.light[pixels + p])
  if (cols > 1) {
    const float part = links.light[2 * pixels + p] * half_within(x, cols, sides);
    SPREAD(y * cols + on_line(x + 1, cols, sides), part)
    SPREAD(y * cols + on_line(x - 1, cols, sides), -part)
  }
  if (rows > 1) {
    const float part = links.light[3 * pixels + p] * half_within(y, rows, sides);
    SPREAD(on_line(y + 1, rows, sides) * cols + x, part)
    SPREAD(on_line(y - 1, rows, sides) * cols + x, -part)
  }
  for (int k = 0; k < links.held[p]; ++k) {
    const int e = LINK(p, k);
    SPREAD(links.first[e], links.near[e])
    SPREAD(links.second[e], links.far[e])
  }
}

/* albedo_sums: over and under, what an image adds to those of its pixels' albedo, over / under: the one
   with which all images are nearest to their targets, gain that of albedo 1. The first sets them. */
__kernel void albedo_sums(__global const float *light, __global const float *gain,
                          __global const float *target, __global float *over, __global float *under,
                          int is_first, int pixels)
{
  const int p = get_global_id(0);
  if (p >= pixels)
    return;
  const float e = gain[p] * light[p];
  over[p] = (is_first ? 0 : over[p]) + e * target[p];
  under[p] = (is_first ? 0 : under[p]) + e * e;
}

/* albedo_gain: the gain with that albedo. */
__kernel void albedo_gain(__global const float *over, __global const float *under,
                          __global const float *gain, __global float *out, int pixels)
{
  const int p = get_global_id(0);
  if (p < pixels)
    out[p] = over[p] / under[p] * gain[p];
}

/* misfit: in part (blocks) the sums of (gain E - target)^2. Work-item g of this, of bending and of descent
   owns NODES_PER_SUM nodes and adds them in order. */
__kernel void misfit(__global const float *light, __global const float *gain, __global const float *target,
                     __global double *part, int block, int pixels)
{
  const int g = get_global_id(0);
  if (g * NODES_PER_SUM >= pixels)
    return;
  double square = 0;
  for (int p = g * NODES_PER_SUM; p < min(pixels, g * NODES_PER_SUM + NODES_PER_SUM); ++p) {
    const float r = gain[p] * light[p] - target[p];
    square += (double)r * (double)r;
  }
  part[block + g] = square;
}

/* Second difference of v along a line of n nodes, `step` apart in memory, about node i of it; 0 at the
   ends. */
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

/* bending: in part (blocks), from `block` on as above, the sums of squared second differences of z - rest
   along rows and columns. */
__kernel void bending(__global const float *z, __global const float *rest, __global double *part, int block,
                      int rows, int cols)
{
  const int g = get_global_id(0), pixels = rows * cols;
  if (g * NODES_PER_SUM >= pixels)
    return;
  double sum = 0;
  for (int p = g * NODES_PER_SUM; p < min(pixels, g * NODES_PER_SUM + NODES_PER_SUM); ++p) {
    const float a = bend(z + p, p % cols, cols, 1) - bend(rest + p, p % cols, cols, 1);
    const float b = bend(z + p, p / cols, rows, cols) - bend(rest + p, p / cols, rows, cols);
    sum += (double)a * (double)a + (double)b * (double)b;
  }
  part[block + g] = sum;
}

/* gradient: sum += quanta transpose(J) gain (gain E - target), and squares += fine x the diagonal of
   transpose(J) gain^2 J, or what it is where no two links of a node lead to the same one. Sums are in fixed
   point: `quanta` is how many integers make 1, `quantum` the value of one. Work-item g of this and of all
   below owns `per_item` nodes; if there is more than one copy of the sums, it adds to a copy of
   its own: sum and squares (copies, pixels). */
__kernel void gradient(__global const float *restrict light, __global const int *restrict held,
                       __global const int *restrict first, __global const int *restrict second,
                       __global const float *restrict near, __global const float *restrict far,
                       __global const float *restrict gain, __global const float *restrict target,
                       __global long *sum, __global long *squares, float quanta, float fine, int rows,
                       int cols, int count, int sides, int per_item, int copies)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  const size_t own = copies > 1 ? (size_t)g * rows * cols : 0;
  for (int p = g * per_item; p < min(rows * cols, g * per_item + per_item); ++p) {
    spread_at(links, sum + own, gain[p] * (gain[p] * light[p] - target[p]) * quanta, 0, rows, cols, p,
              copies > 1);
    spread_at(links, squares + own, gain[p] * gain[p] * fine, 1, rows, cols, p, copies > 1);
  }
}

/* The sum for node i over all copies; they are 0 then. */
long taken(__global long *sum, int i, int pixels, int copies)
{
  long all_ = 0;
  for (int t = 0; t < copies; ++t) {
    all_ += sum[(size_t)t * pixels + i];
    sum[(size_t)t * pixels + i] = 0;
  }
  return all_;
}

/* descent: the descent direction r = -(sum quantum + lambda unbend (z - rest)), 0 where a bound holds z
   (free 0); scale = squares fine + least; x = p = s = sum = squares = 0 for conjugate gradients. */
__kernel void descent(__global const float *z, __global const float *rest, __global const float *low,
                      __global const float *high, __global long *sum, __global long *squares,
                      __global float *scale, __global float *r, __global float *x, __global float *p,
                      __global float *s, __global float *is_free, float quantum, float fine, float least,
                      float lambda_, int rows, int cols, int per_item, int copies)
{
  const int g = get_global_id(0), pixels = rows * cols;
  for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i) {
    const float smooth = (unbend(z + i, i % cols, cols, 1) + unbend(z + i, i / cols, rows, cols))
                         - (unbend(rest + i, i % cols, cols, 1) + unbend(rest + i, i / cols, rows, cols));
    const float steepest = -(convert_float(taken(sum, i, pixels, copies)) * quantum + lambda_ * smooth);
    const float moves = (z[i] <= low[i] && steepest < 0) || (z[i] >= high[i] && steepest > 0) ? 0 : 1;
    scale[i] = convert_float(taken(squares, i, pixels, copies)) * fine + least;
    is_free[i] = moves;
    r[i] = moves * steepest;
    x[i] = 0;
    p[i] = 0;
    s[i] = 0;
  }
}

/* The preconditioner: v = r / scale, and the same on grids COARSENING and COARSENING^2 times as coarse,
   brought up by linear interpolation (Bramble, Pasciak and Xu 1990); r is brought down by its transpose. */

/* Node j of a coarse line of n: its share in node COARSENING j - 2 + a of the fine one. */
float hat(int a, int j, int n)
{
  return (a < 4 ? j == 0 : j == n - 1) ? 1 : (a < 4 ? 2 * a + 1 : 15 - 2 * a) * 0.125f;
}

/* Node (x, y) of the restriction to a coarse grid from one of rows x cols. */
float restricted(__global const float *fine, int rows, int cols, int x, int y)
{
  const int n_rows = (rows - 1) / COARSENING + 1, n_cols = (cols - 1) / COARSENING + 1;
  const int a_0 = max(0, 2 - COARSENING * x), a_1 = min(2 * COARSENING, cols + 2 - COARSENING * x),
            b_0 = max(0, 2 - COARSENING * y), b_1 = min(2 * COARSENING, rows + 2 - COARSENING * y);
  fine += (COARSENING * y - 2) * cols + COARSENING * x - 2;
  float sum = 0;
#if LANES == 8
  if (a_1 - a_0 == LANES) {
    floats columns = 0;
    for (int b = b_0; b < b_1; ++b)
      columns += hat(b, y, n_rows) * READ(b * cols, fine);
    for (int a = 0; a < LANES; ++a)
      sum += hat(a, x, n_cols) * columns[a];
    return sum;
  }
#endif
  for (int a = a_0; a < a_1; ++a) {
    float column = 0;
    for (int b = b_0; b < b_1; ++b)
      column += hat(b, y, n_rows) * fine[b * cols + a];
    sum += hat(a, x, n_cols) * column;
  }
  return sum;
}

/* restriction: to = times the restriction of `fine`; over `scale`, if asked to divide. */
__kernel void restriction(__global const float *fine, __global const float *scale, __global float *to,
                          float times, int divides, int rows, int cols)
{
  const int x = get_global_id(0), y = get_global_id(1), n_rows = (rows - 1) / COARSENING + 1,
            n_cols = (cols - 1) / COARSENING + 1;
  if (x >= n_cols || y >= n_rows)
    return;
  const float sum = times * restricted(fine, rows, cols, x, y);
  to[y * n_cols + x] = divides ? sum / scale[y * n_cols + x] : sum;
}

/* v = free (r / scale + the prolongation of a coarse grid), for the nodes of row y that lie in its node
   x. */
void prolong_at(__global const float *r, __global const float *scale, __global const float *is_free,
                __global const float *coarse, __global float *v, int rows, int cols, int x, int y)
{
  const int n_rows = (rows - 1) / COARSENING + 1, n_cols = (cols - 1) / COARSENING + 1, k = y % COARSENING,
            i = y * cols + COARSENING * x;
  const float share = (k < 2 ? 3 - 2 * k : 2 * k - 3) * 0.125f, own = 1 - share;
  const int row = y / COARSENING, other = clamp(k < 2 ? row - 1 : row + 1, 0, n_rows - 1);
  __global const float *here = coarse + row * n_cols, *neighbour = coarse + other * n_cols;
  const int left = max(x - 1, 0), right = min(x + 1, n_cols - 1);
  const float a = own * here[left] + share * neighbour[left], b = own * here[x] + share * neighbour[x],
              c = own * here[right] + share * neighbour[right];
  const float4 raised = (float4)(0.625f * b + 0.375f * a, 0.875f * b + 0.125f * a, 0.875f * b + 0.125f * c,
                                 0.625f * b + 0.375f * c);
  for (int l = 0; l < min(COARSENING, cols - COARSENING * x); ++l)
    v[i + l] = is_free[i + l] * (r[i + l] / scale[i + l] + raised[l]);
}

__kernel void prolongation(__global const float *r, __global const float *scale,
                           __global const float *is_free, __global const float *coarse, __global float *v,
                           int rows, int cols)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x * COARSENING < cols && y < rows)
    prolong_at(r, scale, is_free, coarse, v, rows, cols, x, y);
}

/* inner_products: in part (2, blocks) the sums of v v and of r v. */
__kernel void inner_products(__global const float *r, __global const float *v, __global double *part,
                             int pixels)
{
  const int g = get_global_id(0), blocks = (pixels - 1) / NODES_PER_SUM + 1;
  if (g >= blocks)
    return;
  double square = 0, product = 0;
  for (int i = g * NODES_PER_SUM; i < min(pixels, g * NODES_PER_SUM + NODES_PER_SUM); ++i) {
    square += (double)v[i] * (double)v[i];
    product += (double)r[i] * (double)v[i];
  }
  part[g] = square;
  part[blocks + g] = product;
}

/* The state of conjugate gradients (double): iterations left, 0 once it has stopped; units of the scattered
   sum and of r v, v w and v v, from the last ones' size; alpha, 0 before the first step; the first r v; what
   the quadratic model has gained; and what was asked for: lambda, damping, share of the first r v at which to
   stop. Two of them take turns, and so do the totals (3, SUM_SLOTS) of r v, v w and v v. */

/* product: sum += quanta transpose(J) gain^2 J v. */
void product_at(Links links, __global const float *gain, __global const float *v, __global long *sum,
                float quanta, int rows, int cols, int p, int exclusive)
{
  spread_at(links, sum, gain[p] * gain[p] * change_at(links, v, rows, cols, p) * quanta, 0, rows, cols, p,
            exclusive);
}

__kernel void product(__global const float *restrict light, __global const int *restrict held,
                      __global const int *restrict first, __global const int *restrict second,
                      __global const float *restrict near, __global const float *restrict far,
                      __global const float *restrict gain, __global const float *restrict v,
                      __global long *sum, __global const double *state, int rows, int cols, int count,
                      int sides,
                      int per_item, int copies)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  const size_t own = copies > 1 ? (size_t)g * rows * cols : 0;
  if (state[LEFT] > 0)
    for (int p = g * per_item; p < min(rows * cols, g * per_item + per_item); ++p)
      product_at(links, gain, v, sum + own, (float)state[SCATTERED], rows, cols, p, copies > 1);
}

/* albedo_change: in (or added to) share, the part of the change of the pixels' albedo by v from one image:
   bright gain J v, bright = the image at albedo 1. */
__kernel void albedo_change(__global const float *restrict light, __global const int *restrict held,
                            __global const int *restrict first, __global const int *restrict second,
                            __global const float *restrict near, __global const float *restrict far,
                            __global const float *restrict gain, __global const float *restrict bare,
                            __global const float *restrict v, __global float *restrict share,
                            __global const double *state, int rows, int cols, int count, int sides,
                            int is_first, int per_item)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  if (state[LEFT] > 0)
    for (int p = g * per_item; p < min(rows * cols, g * per_item + per_item); ++p)
      share[p] =
          (is_first ? 0 : share[p]) + bare[p] * light[p] * (gain[p] * change_at(links, v, rows, cols, p));
}

/* reduced_product: as product, less what a change of the albedo makes up for. */
__kernel void reduced_product(__global const float *restrict light, __global const int *restrict held,
                              __global const int *restrict first, __global const int *restrict second,
                              __global const float *restrict near, __global const float *restrict far,
                              __global const float *restrict gain, __global const float *restrict bare,
                              __global const float *restrict share, __global const float *restrict under,
                              __global const float *restrict v, __global long *sum,
                              __global const double *state, int rows, int cols, int count, int sides,
                              int per_item, int copies)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  const size_t own = copies > 1 ? (size_t)g * rows * cols : 0;
  if (state[LEFT] > 0)
    for (int p = g * per_item; p < min(rows * cols, g * per_item + per_item); ++p) {
      const float left =
          gain[p] * change_at(links, v, rows, cols, p) - bare[p] * light[p] * (share[p] / under[p]);
      spread_at(links, sum + own, gain[p] * left * (float)state[SCATTERED], 0, rows, cols, p, copies > 1);
    }
}

/* normal_product: w = free (sum quantum + lambda unbend v + damping scale v), the normal equations' matrix
   times v; sum = 0; and what the node adds to r v, v w and v v. */
long3 normal_product_at(__global const float *r, __global const float *v, __global const float *scale,
                        __global const float *is_free, __global long *sum, __global float *w, float quantum,
                        float lambda_, float damping, double by_product, double by_square, int rows,
                        int cols, int copies, int i)
{
  const float smooth = unbend(v + i, i % cols, cols, 1) + unbend(v + i, i / cols, rows, cols);
  w[i] = is_free[i] * (convert_float(taken(sum, i, rows * cols, copies)) * quantum + lambda_ * smooth +
                       damping * scale[i] * v[i]);
  const double product = (double)r[i] * (double)v[i], curvature = (double)v[i] * (double)w[i],
               square = (double)v[i] * (double)v[i];
  return (long3)(convert_long_rtz(product * by_product), convert_long_rtz(curvature * by_product),
                 convert_long_rtz(square * by_square));
}

__kernel void normal_product(__global const float *r, __global const float *v, __global const float *scale,
                             __global const float *is_free, __global long *sum, __global float *w,
                             __global long *totals, __global const double *state, int rows, int cols,
                             int per_item, int copies)
{
  const int g = get_global_id(0), pixels = rows * cols;
  if (g * per_item >= pixels || state[LEFT] <= 0)
    return;
  const float quantum = 1 / state[SCATTERED], lambda_ = state[LAMBDA], damping = state[DAMPING];
  long3 part = 0;
  for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i)
    part += normal_product_at(r, v, scale, is_free, sum, w, quantum, lambda_, damping, state[UNIT_RV],
                              state[UNIT_VV], rows, cols, copies, i);
  atom_add(totals + g % SUM_SLOTS, part.x);
  atom_add(totals + SUM_SLOTS + g % SUM_SLOTS, part.y);
  atom_add(totals + 2 * SUM_SLOTS + g % SUM_SLOTS, part.z);
}

/* The state after an iteration with these totals, whether it takes a step, and beta. */
typedef struct { double next[STATE]; double beta; int takes_step; } Iteration;

Iteration iteration_of(__global const double *state, long3 total, double fixed_, double exact)
{
  Iteration iteration;
  for (int i = 0; i < STATE; ++i)
    iteration.next[i] = state[i];
  const double product = total.x / state[UNIT_RV], square = total.z / state[UNIT_VV];
  double curvature = total.y / state[UNIT_RV];
  iteration.beta = 0;
  if (state[ALPHA] != 0) {
    iteration.beta = product / state[PRODUCT];
    curvature -= iteration.beta * product / state[ALPHA];
  } else
    iteration.next[START] = product;
  iteration.takes_step = product > state[STOP_RATIO] * iteration.next[START] && curvature > 0;
  if (iteration.takes_step) {
    iteration.next[LEFT] = state[LEFT] - 1;
    iteration.next[SCATTERED] = fixed_ / sqrt(square);
    iteration.next[UNIT_RV] = exact / product;
    iteration.next[UNIT_VV] = exact / square;
    iteration.next[PRODUCT] = product;
    iteration.next[ALPHA] = product / curvature;
    iteration.next[GAIN] = state[GAIN] + 0.5 * iteration.next[ALPHA] * product;
  } else
    iteration.next[LEFT] = 0;
  return iteration;
}

/* conjugate_step: a step of conjugate gradients with one sum (Chronopoulos and Gear 1989): p = v + beta p,
   s = w + beta s, x += alpha p, r -= alpha s. */
void conjugate_step_at(__global const float *v, __global const float *w, __global float *r,
                       __global float *x, __global float *p, __global float *s, float alpha, float beta,
                       int i)
{
  p[i] = v[i] + beta * p[i];
  s[i] = w[i] + beta * s[i];
  x[i] += alpha * p[i];
  r[i] -= alpha * s[i];
}

__kernel void conjugate_step(__global const float *v, __global const float *w, __global float *r,
                             __global float *x, __global float *p, __global float *s,
                             __global const long *totals, __global long *next_totals,
                             __global const double *state, __global double *next, double fixed_,
                             double exact, int pixels, int per_item)
{
  const int g = get_global_id(0);
  if (g * per_item >= pixels || (g > 0 && state[LEFT] <= 0))
    return;
  long3 total = 0;
  for (int i = 0; i < SUM_SLOTS; ++i)
    total += (long3)(totals[i], totals[SUM_SLOTS + i], totals[2 * SUM_SLOTS + i]);
  const Iteration iteration = iteration_of(state, total, fixed_, exact);
  if (g == 0) {
    for (int i = 0; i < STATE; ++i)
      next[i] = state[LEFT] > 0 ? iteration.next[i] : state[i];
    for (int i = 0; i < 3 * SUM_SLOTS; ++i)
      next_totals[i] = 0;
  }
  if (state[LEFT] > 0 && iteration.takes_step)
    for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i)
      conjugate_step_at(v, w, r, x, p, s, (float)iteration.next[ALPHA], (float)iteration.beta, i);
}

/* start: the state and the totals before the first iteration; square and product: v v and r v. One
   work-item. */
__kernel void start(__global double *state, __global long *totals, double square, double product,
                    double lambda_, double damping, double least, double fixed_, double exact, int most)
{
  if (get_global_id(0) > 0)
    return;
  for (int i = 0; i < 3 * SUM_SLOTS; ++i)
    totals[i] = 0;
  for (int i = 0; i < STATE; ++i)
    state[i] = 0;
  state[LEFT] = most;
  state[SCATTERED] = fixed_ / sqrt(square);
  state[UNIT_RV] = exact / product;
  state[UNIT_VV] = exact / square;
  state[LAMBDA] = lambda_;
  state[DAMPING] = damping;
  state[STOP_RATIO] = least;
}

/* solve: product, normal_product, conjugate_step, restriction and prolongation until they stop, by one
   work-item: on a small grid a CPU takes longer to start a kernel than to run it. 4 and 16: of the coarse
   grids. */
__kernel void solve(__global const float *restrict light, __global const int *restrict held,
                    __global const int *restrict first, __global const int *restrict second,
                    __global const float *restrict near, __global const float *restrict far,
                    __global const float *restrict gain, __global const float *restrict scale,
                    __global const float *restrict scale_4, __global const float *restrict scale_16,
                    __global const float *restrict is_free, __global const float *restrict is_free_4,
                    __global long *restrict sum, __global float *restrict r, __global float *restrict r_4,
                    __global float *restrict v, __global float *restrict v_4, __global float *restrict v_16,
                    __global float *restrict w, __global float *restrict x, __global float *restrict p,
                    __global float *restrict s, __global double *restrict state, double fixed_, double exact,
                    int rows, int cols, int count, int sides)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int pixels = rows * cols, rows_4 = (rows - 1) / COARSENING + 1, cols_4 = (cols - 1) / COARSENING + 1;
  const int rows_16 = (rows_4 - 1) / COARSENING + 1, cols_16 = (cols_4 - 1) / COARSENING + 1;
  if (get_global_id(0) > 0)
    return;
  while (state[LEFT] > 0) {
    const float quanta = state[SCATTERED], quantum = 1 / state[SCATTERED], lambda_ = state[LAMBDA],
                damping = state[DAMPING];
    const double by_product = state[UNIT_RV], by_square = state[UNIT_VV];
    long3 total = 0;
    for (int i = 0; i < pixels; ++i)
      product_at(links, gain, v, sum, quanta, rows, cols, i, 1);
    for (int i = 0; i < pixels; ++i)
      total += normal_product_at(r, v, scale, is_free, sum, w, quantum, lambda_, damping, by_product,
                                 by_square, rows, cols, 1, i);
    const Iteration iteration = iteration_of(state, total, fixed_, exact);
    for (int i = 0; i < STATE; ++i)
      state[i] = iteration.next[i];
    if (!iteration.takes_step)
      return;
    for (int i = 0; i < pixels; ++i)
      conjugate_step_at(v, w, r, x, p, s, (float)iteration.next[ALPHA], (float)iteration.beta, i);
    for (int y = 0; y < rows_4; ++y)
      for (int x = 0; x < cols_4; ++x)
        r_4[y * cols_4 + x] = restricted(r, rows, cols, x, y);
    for (int y = 0; y < rows_16; ++y)
      for (int x = 0; x < cols_16; ++x)
        v_16[y * cols_16 + x] = restricted(r_4, rows_4, cols_4, x, y) / scale_16[y * cols_16 + x];
    for (int y = 0; y < rows_4; ++y)
      for (int x = 0; x < cols_16; ++x)
        prolong_at(r_4, scale_4, is_free_4, v_16, v_4, rows_4, cols_4, x, y);
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < cols_4; ++x)
        prolong_at(r, scale, is_free, v_4, v, rows, cols, x, y);
  }
}

/* bounded_step: to = z + x, within its bounds. */
__kernel void bounded_step(__global const float *z, __global const float *x, __global const float *low,
                           __global const float *high, __global float *to, int pixels, int per_item)
{
  const int g = get_global_id(0);
  for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i)
    to[i] = LESS(MORE(z[i] + x[i], low[i]), high[i]);
}
