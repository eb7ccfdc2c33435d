/* Horizons along single rays, exactly: what a plan is measured against.

The slope found is the largest (height - own height) / distance over every crossing of the ray's vertical plane with a row
or a column of the grid, from `least` >= 0 on. Square blocks whose highest node stays below the line so far are left as a
whole.

  heights  (rows, cols)   float  [spacing]  -1e30 where masked
  tops     (.., across)   float  [spacing]  highest node of every block of 2^shift x 2^shift nodes, and of the row and column after
  rays     (count, 8)     float  column, row, cosine and sine of the azimuth, least; along, up, limit: a point t away with
                                 slope s stands before the source iff t (along + s up) < limit
  slopes   (count)        float  out

reach [spacing]: as far as is looked. Work-item n owns a ray. Twin of warp_kernels/pilot.py. */
#include "lanes.h"

/* The steps after which a line that moves by `move` a step has left the block [low, high) it is in. */
int steps_out(float at, float move, int low, int high)
{
  if (move == 0)
    return 1 << 30;
  return (int)min(move > 0 ? (high - at) / move : (at - low) / -move, 1e9f) + 1;
}

__kernel void pilot(__global const float *heights, __global const float *tops, __global const float *rays, __global float *slopes,
                    int count, int rows, int cols, int across, int shift, int periodic, float highest, float reach)
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
    const int start = by_rows ? y : x, length = by_rows ? rows : cols, from = by_rows ? x : y, width = by_rows ? cols : rows;
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
      const float near = heights[by_rows ? at * cols + low : low * cols + at], far = heights[by_rows ? at * cols + next : next * cols + at];
      const float tangent = (near + part * (far - near) - own) / t;
      if (tangent > slope && t * (along + tangent * up) < limit)
        slope = tangent;
      ++n;
    }
  }
  slopes[number] = slope;
}
