/* What sweeps need besides: slopes of a padded map, a map turned, and sums as irradiance. Twin of warp_kernels/ground.py. */
#include "lanes.h"
#define NONE -1e30f

/* tilt: d depth/dx and d depth/dy of a padded map, by central differences; one-sided at the border and beside masked
nodes, 0 where alone or masked.

  heights  (room)     float  [spacing]  as for sweep
  tilts    (2, room)  float  [1]        out

Work-item (x, y) owns one node. */
float difference(__global const float *heights, int here, int low, int high)
{
  low = heights[low] <= NONE ? here : low;
  high = heights[high] <= NONE ? here : high;
  return (heights[low] - heights[high]) * (low == here || high == here ? 1.0f : 0.5f);
}

__kernel void tilt(__global const float *heights, __global float *tilts, int rows, int cols, int margin, int room)
{
  const int x = get_global_id(0), y = get_global_id(1), stride = cols + 2 * margin, p = (y + margin) * stride + margin + x;
  if (x >= cols || y >= rows)
    return;
  const int known = heights[p] > NONE;
  tilts[p] = known ? difference(heights, p, p - (x > 0), p + (x < cols - 1)) : 0.0f;
  tilts[room + p] = known ? difference(heights, p, p - (y > 0 ? stride : 0), p + (y < rows - 1 ? stride : 0)) : 0.0f;
}

/* turn: a map (rows, cols) and the same turned, (cols, rows). Work-item (x, y) owns one node of the turned map. */
__kernel void turn(__global const float *map, __global float *turned, int rows, int cols)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x < rows && y < cols)
    turned[y * rows + x] = map[x * cols + y];
}

/* gather: the sums of both maps, (rows, cols) and (cols, rows), as irradiance [unit]. Work-item (x, y) owns one node. */
__kernel void gather(__global const int *sum, __global const int *turned, __global float *irradiance, int rows, int cols,
                     float unit)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x < cols && y < rows)
    irradiance[y * cols + x] = (float)(sum[y * cols + x] + turned[x * rows + y]) * unit;
}
