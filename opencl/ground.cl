/* Kernels about a sweep: slopes of a padded map, a map turned, sums as irradiance, and their error.
Twin of warp_kernels/ground.py. */
#include "lanes.h"

/* tilt: d depth/dx and d depth/dy of a padded map, by central differences; one-sided beside what is no
ground: masked nodes, and the border of a map that does not repeat. 0 where alone or masked.

  heights  (room)     float  [spacing]  as for sweep
  tilts    (2, room)  float  [1]        out

Work-item (x, y) owns one element of the padded map; where the map repeats, so do the slopes. */
float difference(__global const float *heights, int here, int low, int high)
{
  low = heights[low] <= NONE ? here : low;
  high = heights[high] <= NONE ? here : high;
  return (heights[low] - heights[high]) * (low == here || high == here ? 1.0f : 0.5f);
}

__kernel void tilt(__global const float *heights, __global float *tilts, int rows, int cols, int margin,
                   int room, int periodic)
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
  const int p = (y + margin) * stride + margin + x,
            known = x >= 0 && x < cols && y >= 0 && y < rows && heights[p] > NONE;
  tilts[at] = known ? difference(heights, p, p - 1, p + 1) : 0.0f;
  tilts[room + at] = known ? difference(heights, p, p - stride, p + stride) : 0.0f;
}

/* turn: maps (count, rows, cols) and the same turned, (count, cols, rows). Work-item (x, y, n) owns one node
   of the turned map n. */
__kernel void turn(__global const float *maps, __global float *turned, int rows, int cols, int count)
{
  const int x = get_global_id(0), y = get_global_id(1), n = get_global_id(2), first = n * rows * cols;
  if (x < rows && y < cols && n < count)
    turned[first + y * rows + x] = maps[first + x * cols + y];
}

/* gather: sum n of each of both maps, (rows, cols) and (cols, rows), as irradiance, sum x quantum; a sum that
   rounding made negative as 0. Work-item (x, y) owns one node. */
__kernel void gather(__global const int *sum, __global const int *turned, __global float *irradiance,
                     int rows, int cols, int n, float quantum)
{
  const int x = get_global_id(0), y = get_global_id(1);
  const size_t before = (size_t)n * rows * cols;
  if (x < cols && y < rows)
    irradiance[y * cols + x] =
        (float)max(sum[before + y * cols + x] + turned[before + x * rows + y], 0) * quantum;
}

/* place: maps, each turned if `turned`, as layers of a stack; nan where masked.

  maps     (count, rows x cols)  float  [any]     those of the turned map are (count, cols x rows)
  depth    (rows x cols)         float  [length]  +inf where masked
  numbers  (count)               int              of the maps in the stack
  stack    (any, rows x cols)    float  [any]     out

Work-item (x, y, n) owns one node of map n. */
__kernel void place(__global const float *maps, __global const float *depth, __global const int *numbers,
                    __global float *stack, int rows, int cols, int count, int turned)
{
  const int x = get_global_id(0), y = get_global_id(1), n = get_global_id(2);
  if (x >= cols || y >= rows || n >= count)
    return;
  const size_t pixels = (size_t)rows * cols;
  const float value = maps[n * pixels + (turned ? x * rows + y : y * cols + x)];
  stack[numbers[n] * pixels + y * cols + x] = isinf(depth[y * cols + x]) ? NAN : value;
}

/* correct: irradiance *= table, by normal; not below 0, where a table of brightness that is linear between
its knots may leave some -1e-6 of a sky where almost nothing but the zenith is visible.


  tilts       (2, room)      float  [1]  gx and gy, as tilt makes them
  table       (side, side)   float  [1]  at v (row) and u (column), and bilinear between: u =
                                         (gx up / (1 + up) + 1) (side - 1) / 2, v so with gy,
                                         up = 1 / sqrt(1 + gx^2 + gy^2)
  irradiance  (rows x cols)  float  in and out

side >= 2. Work-item (x, y) owns one node; a masked one is as if level. */
__kernel void correct(__global const float *tilts, __global const float *table, __global float *irradiance,
                      int rows, int cols, int margin, int room, int side)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x >= cols || y >= rows)
    return;
  const int at = (y + margin) * (cols + 2 * margin) + margin + x;
  const float gx = tilts[at], gy = tilts[room + at], up = 1.0f / sqrt(1.0f + gx * gx + gy * gy);
  const float u = (gx * up / (1.0f + up) + 1.0f) * 0.5f * (float)(side - 1),
              v = (gy * up / (1.0f + up) + 1.0f) * 0.5f * (float)(side - 1);
  const int i = clamp((int)u, 0, side - 2), j = clamp((int)v, 0, side - 2);
  __global const float *cell = table + j * side + i;
  const float low = cell[0] + (u - i) * (cell[1] - cell[0]),
              high = cell[side] + (u - i) * (cell[side + 1] - cell[side]);
  irradiance[y * cols + x] = max(0.0f, irradiance[y * cols + x] * (low + (v - j) * (high - low)));
}

/* halves: of two images of the same light, in place, their mean and half their difference.

  a     (count)  float  in and out: (a + b) / 2, or (b - a) / 2 if b is kept
  b     (count)  float  in and out: (b - a) / 2, or b if it is kept
  keep  int      1 to keep b

Work-item p owns one node of both. */
__kernel void halves(__global float *a, __global float *b, int count, int keep)
{
  const int p = get_global_id(0);
  if (p >= count)
    return;
  const float first = a[p], second = b[p];
  a[p] = (keep ? second - first : first + second) * 0.5f;
  b[p] = keep ? second : (second - first) * 0.5f;
}

/* judge: sums for an estimate of the error, over the valid nodes of each column of a few rows.

  heights  (room)             float  [spacing]  as for sweep; a node is valid where > -1e29
  image    (rows x cols)      float
  half     (rows x cols)      float  [image]    half a difference, as halves makes it; half_ here, since half
                                                is a type
  sums     (5, blocks, cols)  float  out: sum of image, sum of half^2, and numbers of nodes that are valid,
                                     whose image is > 0, and whose |half| is > limit; blocks = ceil(rows /
                                     block)

Work-item (x, b) owns column x of rows b block .. min((b + 1) block, rows) - 1, summed in this order. */
__kernel void judge(__global const float *heights, __global const float *image, __global const float *half_,
                    __global float *sums, int rows, int cols, int margin, int block, float limit)
{
  const int x = get_global_id(0), b = get_global_id(1), blocks = (rows + block - 1) / block;
  if (x >= cols || b >= blocks)
    return;
  float light = 0, square = 0;
  int valid = 0, lit = 0, beyond = 0;
  for (int y = b * block; y < min((b + 1) * block, rows); ++y) {
    if (!(heights[(y + margin) * (cols + 2 * margin) + margin + x] > HIGHEST_MASKED))
      continue;
    const float here = image[y * cols + x], apart = half_[y * cols + x];
    light += here;
    square += apart * apart;
    valid += 1;
    lit += here > 0;
    beyond += fabs(apart) > limit;
  }
  const int at = b * cols + x, all = blocks * cols;
  sums[at] = light;
  sums[all + at] = square;
  sums[2 * all + at] = (float)valid;
  sums[3 * all + at] = (float)lit;
  sums[4 * all + at] = (float)beyond;
}
