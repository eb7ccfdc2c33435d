/* What sweeps need besides: slopes of a padded map, a map turned, and sums as irradiance. Twin of warp_kernels/ground.py. */
#include "lanes.h"
#define NONE -1e30f

/* tilt: d depth/dx and d depth/dy of a padded map, by central differences; one-sided at the border and beside masked
nodes, 0 where alone or masked.

  heights  (room)     float  [spacing]  as for sweep
  tilts    (2, room)  float  [1]        out

Work-item (x, y) owns one element of the padded map; where the map repeats, so do the slopes. */
float difference(__global const float *heights, int here, int low, int high)
{
  low = heights[low] <= NONE ? here : low;
  high = heights[high] <= NONE ? here : high;
  return (heights[low] - heights[high]) * (low == here || high == here ? 1.0f : 0.5f);
}

__kernel void tilt(__global const float *heights, __global float *tilts, int rows, int cols, int margin, int room, int periodic)
{
  const int stride = cols + 2 * margin;
  int x = (int)get_global_id(0) - margin, y = (int)get_global_id(1) - margin;
  const int at = (y + margin) * stride + x + margin;
  if (x >= cols + margin || y >= rows + margin)
    return;
  if (periodic) {
    x = (x % cols + cols) % cols;
    y = (y % rows + rows) % rows;
  }
  const int p = (y + margin) * stride + margin + x, known = x >= 0 && x < cols && y >= 0 && y < rows && heights[p] > NONE;
  tilts[at] = known ? difference(heights, p, p - (x > 0), p + (x < cols - 1)) : 0.0f;
  tilts[room + at] = known ? difference(heights, p, p - (y > 0 ? stride : 0), p + (y < rows - 1 ? stride : 0)) : 0.0f;
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
