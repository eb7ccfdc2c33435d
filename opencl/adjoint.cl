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
  table    (n, knots, 4)            float  integrals of B cos^2 and of B sin cos over elevation from tangent
                                           / (1 + tangent) = i / (knots - 1) to the zenith, and what to add
                                           up to the next knot; knots 0: brightness 1, closed form
  sides                             0 open, 1 dark, 2 periodic

All arithmetic is +, -, x, / and sqrt, correctly rounded and in one order, so that every backend finds the
same bits. Twin of warp_kernels/adjoint.py. */
#include "lanes.h"
#include "strips.h"
#include "links.h"

#if LANES == 1
#define TO_FLOATS convert_float
#define COUNT 0
#define ALL(v) (v)
#define LANE(v, l) (v)
#else
#define TO_FLOATS JOIN(convert_float, LANES)
#define COUNT (ints)(0, 1, 2, 3, 4, 5, 6, 7)
#define ALL(v) all(v)
#define LANE(v, l) (v)[l]
#endif
#define MORE(a, b) ((a) > (b) ? (a) : (b))
#define LESS(a, b) ((a) < (b) ? (a) : (b))

/* Light between the slope T and the zenith: integrals of B sin cos (c1) and of B cos^2 (c2), and their
   derivative by T. */
typedef struct { floats c1, c2, d1, d2; } Above;

Above above(floats t, __global const float *table, int row, int next, float share, int knots)
{
  const floats square = 1 + t * t, cosine = 1 / square;
  Above sky;
  if (knots == 0) {
    sky.c1 = 0.5f * cosine;
    sky.c2 = 0.5f * (HALF_PI - arctan(t) - t * cosine);
    sky.d1 = -t * cosine * cosine;
    sky.d2 = -cosine * cosine;
    return sky;
  }
  const floats diamond = t / (1 + t), place = diamond * (knots - 1);
  const floats per = (1 - diamond) / (1 + t) * (knots - 1);
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
          const int e = link_at(p + l, links[l]++, count);
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
        const int e = link_at(p, links++, count);
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

/* Derivatives of `below`: by the plane's slope, with the sign reversed, and by the slope. */
float below_by_plane(float s) { return arctan(s) + s / (1 + s * s); }

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
        by_plane -= mean * (below_by_plane(rises) - below_by_plane(slope));
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
    by_plane += m * (below_by_plane(end) - below_by_plane(plane));
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
