/* The sum of brightness x cosine x solid angle over the visible directions (Eq. 3).

gradient: dz/dx and dz/dy by central differences, one-sided beside masked nodes and, unless the map repeats,
at the border; 0 where alone.

  depth   (rows, cols)  float [length]  +inf where masked
  slopes  (2, room)     float [1]       out: dz/dx, dz/dy; room: pixels rounded up for whole vectors
  half, one             float [1/length]  1 / (2 step) and 1 / step
  periodic              int               1 where the map repeats

Work-item (x, y) owns one node. Twin of warp_kernels/luminance.py. */
#include "lanes.h"

float difference(__global const float *depth, size_t here, size_t low, size_t high, float half_, float one)
{
  if (isinf(depth[low]))
    low = here;
  if (isinf(depth[high]))
    high = here;
  const float rise = depth[high] - depth[low];
  return low == here && high == here ? 0.0f : rise * (low == here || high == here ? one : half_);
}

/* Node i of a line of n, which may lie one beyond its ends. */
int on_line(int i, int n, int periodic)
{
  return periodic ? (i + n) % n : clamp(i, 0, n - 1);
}

__kernel void gradient(__global const float *depth, __global float *slopes, int rows, int cols, int room,
                       float half_, float one, int periodic)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x >= cols || y >= rows)
    return;
  const size_t p = (size_t)y * cols + x, row = (size_t)y * cols;
  const int known = !isinf(depth[p]);
  const int left = on_line(x - 1, cols, periodic), right = on_line(x + 1, cols, periodic),
            over = on_line(y - 1, rows, periodic), under = on_line(y + 1, rows, periodic);
  slopes[p] = known ? difference(depth, p, row + left, row + right, half_, one) : 0.0f;
  slopes[room + p] =
      known ? difference(depth, p, (size_t)over * cols + x, (size_t)under * cols + x, half_, one) : 0.0f;
}

/* luminance: irradiance += sum over set bits of max(0, N . moment) x brightness; the moments come multiplied
by it.

  planes      (walks, room)       uchar
  slopes      (2, room)           float
  moments     (walks, BITS, 4)    float  [sr x brightness]  x, y, z, 0
  irradiance  (room)              float  in, out: the sum x |(dz/dx, dz/dy, -1)|, and after the last group the
                                         sum itself

Work-item g owns pixels LANES g to LANES g + LANES - 1. Order of summation: walks, within a walk
elevations. */
__kernel void luminance(__global const uchars *planes, __global const floats *slopes,
                        __global const float4 *moments, __global floats *irradiance, int pixels, int room,
                        int n_walks, int is_first, int is_last)
{
  const size_t g = get_global_id(0), groups = room / LANES;
  if (g >= groups)
    return;
  const floats gx = slopes[g], gy = slopes[groups + g];
  floats sum = 0;
  if (!is_first)
    sum = irradiance[g];
  for (int w = 0; w < n_walks; ++w) {
    const ints lit = TO_INTS(planes[w * groups + g]);
    for (int b = 0; b < BITS; ++b) {
      const float4 moment = moments[BITS * w + b];
      const floats cosine = gx * moment.x + gy * moment.y - moment.z;
      sum += (lit & (1 << b)) != 0 && cosine > 0 ? cosine : (floats)0;
    }
  }
  if (is_last)
    sum /= sqrt(gx * gx + gy * gy + 1);
  irradiance[g] = sum;
}
