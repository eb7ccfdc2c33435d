/* Horizons of ground far from a tile, from overviews of the whole map. Twin of warp_kernels/far.py. */
#pragma OPENCL FP_CONTRACT OFF

/* floor and clamp, inline also where builtins are calls */
int down(float v)
{
  const int n = (int)v;
  return v < (float)n ? n - 1 : n;
}
int within(int n, int count) { return n < 0 ? 0 : n < count ? n : count - 1; }

/* Height of a level at the point (x, y) nodes from node (x0, y0): bilinear between the centres of four cells,
   on the map's border that of the border's cells. Cells without data have no
   weight; NONE where all lack them. */
float overview(__global const float *cells, __global const int *levels, int number, int x0, int y0, float x,
               float y)
{
  __global const int *level = levels + 8 * number;
  const int rows = level[3], cols = level[4], f = level[5], size = 1 << f;
  const float reciprocal = 1.0f / (float)size, half_cell = 0.5f * (float)(size - 1);
  const float u = ((float)(x0 & (size - 1)) - half_cell + x) * reciprocal,
              v = ((float)(y0 & (size - 1)) - half_cell + y) * reciprocal;
  const int left = down(u), upper = down(v);
  const int q = (x0 >> f) + left - level[2], r = (y0 >> f) + upper - level[1];
  const float b = u - (float)left, a = v - (float)upper;
  const int q0 = within(q, cols), q1 = within(q + 1, cols);
  const int r0 = within(r, rows), r1 = within(r + 1, rows);
  __global const float *window = cells + level[0];
  const float h00 = window[r0 * cols + q0], h01 = window[r0 * cols + q1];
  const float h10 = window[r1 * cols + q0], h11 = window[r1 * cols + q1];
  if (h00 > HIGHEST_MASKED && h01 > HIGHEST_MASKED && h10 > HIGHEST_MASKED && h11 > HIGHEST_MASKED) {
    const float high = h00 + b * (h01 - h00), low = h10 + b * (h11 - h10);
    return high + a * (low - high);
  }
  const float w00 = h00 > HIGHEST_MASKED ? (1 - a) * (1 - b) : 0;
  const float w01 = h01 > HIGHEST_MASKED ? (1 - a) * b : 0;
  const float w10 = h10 > HIGHEST_MASKED ? a * (1 - b) : 0;
  const float w11 = h11 > HIGHEST_MASKED ? a * b : 0;
  const float all = w00 + w01 + w10 + w11;
  return all > 0 ? (w00 * h00 + w01 * h01 + w10 * h10 + w11 * h11) / all : NONE;
}

/* march: the far horizon at some nodes, as a line in the height it is seen from: slope = found[0] - height x
found[1]. Of all samples of the overviews along the azimuth's ray it is the one that stands highest,
(sample - own height) / distance - drop x distance.

  cells     (total)             float  [spacing]  windows of all levels, one after another; NONE without data
  levels    (levels, 8)         int    offset into cells; the window's first row and column, in cells of the
                                       map; its rows; its columns; f: cells have 2^f nodes along a side; 0, 0
  steps     (n_steps, 2)        float  [spacing], [1 / spacing]  distance of every sample, growing, and its
                                       reciprocal
  level_of  (n_steps)           int    which level it is taken from
  azimuths  (count, 2)          float  cosine and sine, towards +x (columns) and +y (rows)
  own       (n_rows x n_cols)   float  [spacing]  the nodes' heights
  at_row    (n_rows)            int    their rows in the map, not negative
  at_col    (n_cols)            int    their columns
  found     (2, count, n_rows x n_cols) float  out: slope seen from height 0, and 1 / distance; NONE and 0
                                       where there is no far ground
  highest   no ground is higher: what cannot stand above the horizon is not looked at
  drop      [1 / spacing]  by how much ground falls off with distance^2, the Earth being round

rows, cols: of the map, at whose border rays end unless it repeats (periodic). Work-item (p, k) owns node p of
azimuth k. */
__kernel void march(__global const float *cells, __global const int *levels, __global const float *steps,
                    __global const int *level_of, __global const float *azimuths, __global const float *own,
                    __global const int *at_row, __global const int *at_col, __global float *found,
                    int n_steps, int count, int n_rows, int n_cols, int rows, int cols, float highest,
                    float drop, int periodic)
{
  const int p = get_global_id(0), k = get_global_id(1), nodes = n_rows * n_cols;
  if (p >= nodes)
    return;
  const int x0 = at_col[p % n_cols], y0 = at_row[p / n_cols];
  const float dx = azimuths[2 * k], dy = azimuths[2 * k + 1], h = own[p];
  const float first_x = (float)-x0, last_x = (float)(cols - 1 - x0), first_y = (float)-y0,
              last_y = (float)(rows - 1 - y0);
  float best = NONE, inverse = 0;
  for (int s = 0; s < n_steps; ++s) {
    const float distance = steps[2 * s], reciprocal = steps[2 * s + 1];
    const float x = dx * distance, y = dy * distance;
    if ((highest - h) * reciprocal <= best ||
        (!periodic && (x < first_x || x > last_x || y < first_y || y > last_y)))
      break;
    const float ground = overview(cells, levels, level_of[s], x0, y0, x, y);
    const float slope = ground > HIGHEST_MASKED ? (ground - h) * reciprocal - drop * distance : NONE;
    if (slope > best) {
      best = slope;
      inverse = reciprocal;
    }
  }
  found[(size_t)k * nodes + p] = best > HIGHEST_MASKED ? best + h * inverse : NONE;
  found[((size_t)count + k) * nodes + p] = inverse;
}

/* interpolate: far horizons at every node of a map that is seen as sweeps see it, from four nodes of `march`
about it, seen from the node's own height.

  found    (2, count, nodes)      float  as march leaves it, nodes every `spread` rows and columns of a tile
  heights  (room)                 float  [spacing]  the padded map, (rows + 2 margin, cols + 2 margin)
  planes   (count, rows x cols)   float  out: slopes; NONE outside the tile and where there is no far ground

Along is the direction of x, across that of y. stride_along, stride_across: between neighbours in `found`.
before_along, before_across: nodes of the map before the tile's first. along, across: nodes of the tile.
last_along, last_across: the whole map's last node, from the tile's first, where the nodes of `found` end too.
Work-item (i, y, k) owns nodes i run .. (i + 1) run - 1 of row y, azimuth k. */
__kernel void interpolate(__global const float *restrict found, __global const float *restrict heights,
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
    __global const float *corner = found + (size_t)k * nodes + r * stride_across + q * stride_along;
    const float slope_left = corner[0] + a * (corner[stride_across] - corner[0]);
    const float slope_right = corner[stride_along] +
                              a * (corner[stride_along + stride_across] - corner[stride_along]);
    corner += (size_t)count * nodes;
    const float inverse_left = corner[0] + a * (corner[stride_across] - corner[0]);
    const float inverse_right = corner[stride_along] +
                                a * (corner[stride_along + stride_across] - corner[stride_along]);
    const float part = to_right > 0 ? 1.0f / (float)to_right : 0.0f;
    for (; x < stop; ++x) {
      const float b = (float)(x - first) * part;
      const float slope = slope_left + b * (slope_right - slope_left);
      const float inverse = inverse_left + b * (inverse_right - inverse_left);
      plane[x] = own[x] > HIGHEST_MASKED ? slope - own[x] * inverse : NONE;
    }
  }
}
