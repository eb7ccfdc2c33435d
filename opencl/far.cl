/* Horizons of ground far from a tile, from overviews of the whole map. Twin of warp_kernels/far.py. */
#include "lanes.h"
#if LANES == 1
#define TO_FLOATS convert_float
#define ALL(tests) (tests)
#define ANY(tests) (tests)
#else
#define TO_FLOATS JOIN(convert_float, LANES)
#define ALL(tests) all(tests)
#define ANY(tests) any(tests)
#endif

/* floor and clamp, inline also where builtins are calls */
ints down(floats v)
{
  const ints n = TO_INTS(v);
  return n + WHERE(v < TO_FLOATS(n));
}
ints within(ints n, int count) { return min(max(n, 0), count - 1); }

/* Cells at some places. */
floats taken(__global const float *cells, ints at)
{
#if LANES == 1
  return cells[at];
#else
  int places[LANES];
  float values[LANES];
  STORE(at, 0, places);
  for (int l = 0; l < LANES; ++l)
    values[l] = cells[places[l]];
  return LOAD(0, values);
#endif
}

/* Height of a level at the points (x, y) nodes from nodes (x0, y0): bilinear between the centres of four
   cells, on the map's border that of the border's cells. Cells without data have no weight; NONE where all
   lack them. */
floats overview(__global const float *cells, __global const int *level, ints x0, ints y0, float x, float y)
{
  const int rows = level[3], cols = level[4], f = level[5], size = 1 << f;
  const float reciprocal = 1.0f / (float)size, half_cell = 0.5f * (float)(size - 1);
  const floats u = (TO_FLOATS(x0 & (size - 1)) - half_cell + x) * reciprocal,
               v = (TO_FLOATS(y0 & (size - 1)) - half_cell + y) * reciprocal;
  const ints left = down(u), upper = down(v);
  const ints q = (x0 >> f) + left - level[2], r = (y0 >> f) + upper - level[1];
  const floats b = u - TO_FLOATS(left), a = v - TO_FLOATS(upper);
  const ints q0 = within(q, cols), q1 = within(q + 1, cols);
  const ints r0 = within(r, rows) * cols, r1 = within(r + 1, rows) * cols;
  __global const float *window = cells + level[0];
  const floats h00 = taken(window, r0 + q0), h01 = taken(window, r0 + q1);
  const floats h10 = taken(window, r1 + q0), h11 = taken(window, r1 + q1);
  const ints there_00 = WHERE(h00 > HIGHEST_MASKED), there_01 = WHERE(h01 > HIGHEST_MASKED);
  const ints there_10 = WHERE(h10 > HIGHEST_MASKED), there_11 = WHERE(h11 > HIGHEST_MASKED);
  const ints whole = there_00 & there_01 & there_10 & there_11;
  const floats high = h00 + b * (h01 - h00), low = h10 + b * (h11 - h10);
  const floats between = high + a * (low - high);
  if (ALL(whole))
    return between;
  const floats w00 = there_00 ? (1 - a) * (1 - b) : 0;
  const floats w01 = there_01 ? (1 - a) * b : 0;
  const floats w10 = there_10 ? a * (1 - b) : 0;
  const floats w11 = there_11 ? a * b : 0;
  const floats every = w00 + w01 + w10 + w11;
  const floats part = (w00 * h00 + w01 * h01 + w10 * h10 + w11 * h11) / every;
  return whole ? between : every > 0 ? part : NONE;
}

/* march: the far horizon at some nodes, as a line in the node's height: slope = lines[0] - height x
lines[1]. Of all samples of the overviews along the azimuth's ray it is the one that stands highest,
(sample - own height) / distance - drop x distance.

  cells     (total)             float  [spacing]  windows of all levels, one after another; NONE without data
  levels    (levels, 8)         int    offset into cells; the window's first row and column, in cells of the
                                       map; its rows; its columns; f: cells have 2^f nodes along a side; 0, 0
  steps     (n_steps, 2)        float  [spacing], [1 / spacing]  distance of every sample, growing, and its
                                       reciprocal
  level_of  (n_steps)           int    which level it is taken from
  azimuths  (count, 2)          float  cosine and sine, towards +x (columns) and +y (rows)
  own       (nodes)             float  [spacing]  the nodes' heights
  at_row    (nodes)             int    their rows in the map, not negative
  at_col    (nodes)             int    their columns
  lines     (2, count, nodes)   float  out: slope seen from height 0, and 1 / distance; NONE and 0 where there
                                       is no far ground
  highest   no ground is higher: what cannot stand above the horizon is not looked at
  drop      [1 / spacing]  by how much ground falls off with distance^2, the Earth being round

rows, cols: of the map, at whose border rays end unless it repeats (periodic). Work-item (p, k) owns LANES
nodes from p LANES on of azimuth k. */
__kernel void march(__global const float *cells, __global const int *levels, __global const float *steps,
                    __global const int *level_of, __global const float *azimuths, __global const float *own,
                    __global const int *at_row, __global const int *at_col, __global float *lines,
                    int n_steps, int count, int nodes, int rows, int cols, float highest, float drop,
                    int periodic)
{
  const int p = get_global_id(0) * LANES, k = get_global_id(1);
  if (p >= nodes)
    return;
  int places[2][LANES];
  float heights[LANES];
  for (int l = 0; l < LANES; ++l) { /* lanes beyond the last node repeat it */
    const int node = min(p + l, nodes - 1);
    places[0][l] = at_col[node];
    places[1][l] = at_row[node];
    heights[l] = own[node];
  }
  const ints x0 = LOAD(0, places[0]), y0 = LOAD(0, places[1]);
  const floats h = LOAD(0, heights);
  const float dx = azimuths[2 * k], dy = azimuths[2 * k + 1];
  const floats first_x = TO_FLOATS(-x0), last_x = TO_FLOATS(cols - 1 - x0), first_y = TO_FLOATS(-y0),
               last_y = TO_FLOATS(rows - 1 - y0);
  floats best = NONE, inverse = 0;
  ints goes_on = -1;
  for (int s = 0; s < n_steps; ++s) {
    const float distance = steps[2 * s], reciprocal = steps[2 * s + 1];
    const float x = dx * distance, y = dy * distance;
    goes_on &= WHERE((highest - h) * reciprocal > best);
    if (!periodic)
      goes_on &= WHERE(first_x <= x) & WHERE(last_x >= x) & WHERE(first_y <= y) & WHERE(last_y >= y);
    if (!ANY(goes_on))
      break;
    const floats ground = overview(cells, levels + 8 * level_of[s], x0, y0, x, y);
    const floats slope = (ground - h) * reciprocal - drop * distance;
    const ints higher = goes_on & WHERE(ground > HIGHEST_MASKED) & WHERE(slope > best);
    best = higher ? slope : best;
    inverse = higher ? reciprocal : inverse;
  }
  const floats seen = best > HIGHEST_MASKED ? best + h * inverse : NONE;
  float out[2][LANES];
  STORE(seen, 0, out[0]);
  STORE(inverse, 0, out[1]);
  for (int l = 0; l < LANES && p + l < nodes; ++l) {
    lines[(size_t)k * nodes + p + l] = out[0][l];
    lines[((size_t)count + k) * nodes + p + l] = out[1][l];
  }
}

/* Between two values, linearly; or the nearer one. */
float between(float low, float high, float part, int linearly)
{
  return linearly ? low + part * (high - low) : part < 0.5f ? low : high;
}

/* interpolate: far horizons at every node of a map in the order of sweeps, from four nodes of `march` around
it, for the node's own height. Where one of them sees no far ground, as its ray leaves the map before, the
nearest one's.

  lines     (2, count, nodes)      float  as march leaves it, nodes every `spread` rows and columns of a tile
  heights  (room)                 float  [spacing]  the padded map, (rows + 2 margin, cols + 2 margin)
  planes   (count, rows x cols)   float  out: slopes; NONE outside the tile and where there is no far ground

Along is the direction of x, across that of y. stride_along, stride_across: between neighbours in `lines`.
before_along, before_across: nodes of the map before the tile's first. along, across: nodes of the tile.
last_along, last_across: the whole map's last node, from the tile's first, where the nodes of `lines` end too.
Work-item (i, y, k) owns nodes i run .. (i + 1) run - 1 of row y, azimuth k. */
__kernel void interpolate(__global const float *restrict lines, __global const float *restrict heights,
                          __global float *restrict planes, int count, int nodes, int spread, int rows,
                          int cols, int margin, int stride_along, int stride_across, int before_along,
                          int before_across, int along, int across, int last_along, int last_across, int run)
{
  const int y = get_global_id(1), k = get_global_id(2), v = y - before_across;
  if (y >= rows || k >= count)
    return;
  __global const float *restrict own = heights + (y + margin) * (cols + 2 * margin) + margin;
  __global float *restrict plane = planes + ((size_t)k * rows + y) * cols;
  const int r = v / spread, down = min(spread, last_across - r * spread);
  const float a = down > 0 ? (float)(v - r * spread) / (float)down : 0.0f;
  int x = (int)get_global_id(0) * run;
  const int end = min(x + run, cols);
  while (x < end) {
    if (v < 0 || v >= across || x < before_along || x >= before_along + along) {
      plane[x] = NONE;
      ++x;
      continue;
    }
    const int q = (x - before_along) / spread, first = before_along + q * spread,
              to_right = min(spread, last_along - q * spread);
    const int stop = min(end, min(first + spread, before_along + along));
    __global const float *corner = lines + (size_t)k * nodes + r * stride_across + q * stride_along;
    const int both = stride_along + stride_across;
    const int whole = min(min(corner[0], corner[stride_along]), min(corner[stride_across], corner[both])) >
                      HIGHEST_MASKED;
    const float slope_left = between(corner[0], corner[stride_across], a, whole);
    const float slope_right = between(corner[stride_along], corner[both], a, whole);
    corner += (size_t)count * nodes;
    const float inverse_left = between(corner[0], corner[stride_across], a, whole);
    const float inverse_right = between(corner[stride_along], corner[both], a, whole);
    const float part = to_right > 0 ? 1.0f / (float)to_right : 0.0f;
    for (; x < stop; ++x) {
      const float b = (float)(x - first) * part;
      const float slope = between(slope_left, slope_right, b, whole);
      const float inverse = between(inverse_left, inverse_right, b, whole);
      plane[x] = own[x] > HIGHEST_MASKED ? slope - own[x] * inverse : NONE;
    }
  }
}
