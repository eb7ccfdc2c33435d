/* Horizons along single rays, exactly: what a plan is measured against; a map in blocks, for them; and values
picked.

pilot: the slope found is the largest (height - own height) / distance over every crossing of the ray's
vertical plane with a row or a column of the grid, from `least` >= 0 on. Square blocks whose highest node
stays below the line so far are left as a whole.

  heights  (rows, cols)   float  [spacing]  -1e30 where masked
  tops     (.., across)   float  [spacing]  highest node of every block of 2^shift x 2^shift nodes, and of the
                                            row and column after
  rays     (count, 8)     float  column, row, cosine and sine of the azimuth, least; along, up, limit: a point
                                 t away on the line with slope s is before the source iff
                                 t (along + s up) < limit
  slopes   (count)        float  out

reach [spacing]: the search radius. Work-item n owns a ray. Twin of warp_kernels/pilot.py. */
#include "lanes.h"

/* The steps after which a line that moves by `move` a step has left the block [low, high) it is in. */
int steps_out(float at, float move, int low, int high)
{
  if (move == 0)
    return 1 << 30;
  return (int)min(move > 0 ? (high - at) / move : (at - low) / -move, 1e9f) + 1;
}

__kernel void pilot(__global const float *heights, __global const float *tops, __global const float *rays,
                    __global float *slopes, int count, int rows, int cols, int across, int shift,
                    int periodic, float highest, float reach)
{
  const int number = get_global_id(0);
  if (number >= count)
    return;
  __global const float *ray = rays + 8 * number;
  const int x = (int)ray[0], y = (int)ray[1];
  const float along = ray[5], up = ray[6], limit = ray[7], own = heights[y * cols + x];
  float slope = ray[4];
  for (int by_rows = 0; by_rows < 2; ++by_rows) {
    /* crossings with columns, then with rows: node `at` of `length` along them, `from` of `width` aside */
    const float to = by_rows ? ray[3] : ray[2], aside = by_rows ? ray[2] : ray[3];
    if (fabs(to) < 1e-6f)
      continue;
    const int start = by_rows ? y : x, length = by_rows ? rows : cols, from = by_rows ? x : y,
              width = by_rows ? cols : rows;
    const int way = to > 0 ? 1 : -1;
    const float apart = 1 / fabs(to), move = aside * apart;
    int n = 1;
    while (true) {
      const float t = n * apart;
      if (t > reach || highest - own <= slope * t || !(t * (along + slope * up) < limit))
        break;
      /* 1. where the crossing lies */
      int at = start + way * n;
      float v = from + n * move;
      if (periodic) {
        at = (at % length + length) % length;
        v -= width * floor(v / width);
        v = v < width ? v : 0.0f;
      } else if (at < 0 || at >= length || v < -1e-4f || v > width - 1 + 1e-4f)
        break;
      const int low = min((int)max(v, 0.0f), width - 1);
      const float part = min(max(v - low, 0.0f), 1.0f);
      /* 2. its block, if that can hide nothing */
      const int block_at = at >> shift, block_low = low >> shift;
      const float top = tops[by_rows ? block_at * across + block_low : block_low * across + block_at];
      if (top - own <= slope * t) {
        const int left = way > 0 ? min((block_at + 1) << shift, length) - at : at - (block_at << shift) + 1;
        n += max(1, min(left, steps_out(v, move, block_low << shift, min((block_low + 1) << shift, width))));
        continue;
      }
      /* 3. or the ground there */
      const int next = low + 1 < width ? low + 1 : periodic ? 0 : low;
      const float near = heights[by_rows ? at * cols + low : low * cols + at],
                  far = heights[by_rows ? at * cols + next : next * cols + at];
      const float tangent = (near + part * (far - near) - own) / t;
      /* what reaches through the source's plane hides no more than is below */
      slope = max(slope, up > 0 ? min(tangent, (limit / t - along) / up) : tangent);
      ++n;
    }
  }
  slopes[number] = slope;
}

/* pool: of every square block of 2^shift x 2^shift nodes the highest node, with the row and the column after
it; the lowest node; and how many steps are cliffs.

  heights  (rows, cols)       float  [spacing]  <= -1e29 where masked
  pooled   (3, down, across)  float  [spacing], [spacing], [1]  out
    [0]  highest valid node of the block, of the row and the column after it and of the node where these meet:
         round the map where that is periodic, else as far as it goes; -1e30 if there is none
    [1]  lowest valid node of the block itself; 1e30 if there is none
    [2]  steps from a valid node of the block to its right and to its lower neighbour, valid and on the map
         (never round it), that rise or fall by more than cliff

Work-item (bx, by) owns one block; its nodes along rows, from its first on. */
__kernel void pool(__global const float *heights, __global float *pooled, int rows, int cols, int across,
                   int down, int shift, int periodic, float cliff)
{
  const int bx = get_global_id(0), by = get_global_id(1);
  if (bx >= across || by >= down)
    return;
  const int end_x = min((bx + 1) << shift, cols), end_y = min((by + 1) << shift, rows);
  float highest = NONE, lowest = -NONE;
  int cliffs = 0;
  for (int y = by << shift; y <= end_y; ++y) {
    if (y == rows && !periodic)
      break;
    const int row = (y < rows ? y : 0) * cols;
    for (int x = bx << shift; x <= end_x; ++x) {
      if (x == cols && !periodic)
        break;
      const float here = heights[row + (x < cols ? x : 0)];
      if (here <= HIGHEST_MASKED)
        continue;
      highest = max(highest, here);
      if (x == end_x || y == end_y)
        continue;
      lowest = min(lowest, here);
      const float right = x + 1 < cols ? heights[row + x + 1] : NONE,
                  below = y + 1 < rows ? heights[row + cols + x] : NONE;
      cliffs += (right > HIGHEST_MASKED && fabs(right - here) > cliff) +
                (below > HIGHEST_MASKED && fabs(below - here) > cliff);
    }
  }
  const int at = by * across + bx, blocks = down * across;
  pooled[at] = highest;
  pooled[blocks + at] = lowest;
  pooled[2 * blocks + at] = (float)cliffs;
}

/* pick: some values of an array.

  values   (count)    float
  at       (n_picked)  int    which; below 0 for none
  picked   (n_picked)  float  out; `missing` where there is none

Work-item n owns one that is picked. */
__kernel void pick(__global const float *values, __global const int *at, __global float *picked, int n_picked,
                   float missing)
{
  const int n = get_global_id(0);
  if (n < n_picked)
    picked[n] = at[n] >= 0 ? values[at[n]] : missing;
}
