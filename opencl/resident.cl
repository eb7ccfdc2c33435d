/* A depth map that lies on a device: copied, surveyed, padded and probed there. Twin of
   warp_kernels/resident.py. */
#pragma OPENCL FP_CONTRACT OFF

/* adopt: depth = top + sign x value: a copy (0, 1), or the depth of heights (highest, -1).

  values, depth  (count)  float  [length]   nan for a value of +inf
  mask           (count)  uchar  where it is 0 the depth is +inf; read if masked is not 0

Work-item p owns one node. */
__kernel void adopt(__global const float *values, __global const uchar *mask, __global float *depth,
                    float top, float sign, int masked, int count)
{
  const int p = get_global_id(0);
  if (p >= count)
    return;
  const float value = values[p];
  depth[p] = masked && !mask[p] ? INFINITY : value == INFINITY ? NAN : top + sign * value;
}

/* survey: properties of a map over each column of some rows. +inf is masked.

  values  (rows x cols)      float  [length]
  stats   (8, blocks, cols)  float  out: the smallest and the largest value; numbers of values that are -inf
                                    or nan, and of those that are no whole number of steps; sums of the
                                    squares of differences [length^2] to the neighbour at the right and below,
                                    where neither is masked; and how many these are; blocks = ceil(rows /
                                    block)
  step                      double [length]

Work-item (x, b) owns column x of rows b block .. min((b + 1) block, rows) - 1, summed in this order. */
__kernel void survey(__global const float *values, __global float *stats, int rows, int cols, int block,
                     double step)
{
  const int x = get_global_id(0), b = get_global_id(1), blocks = (rows + block - 1) / block;
  if (x >= cols || b >= blocks)
    return;
  float low = MAXFLOAT, high = -MAXFLOAT, across = 0, down = 0;
  int broken = 0, fractional = 0, pairs_across = 0, pairs_down = 0;
  for (int y = b * block; y < min((b + 1) * block, rows); ++y) {
    const float z = values[y * cols + x];
    if (z == INFINITY)
      continue;
    if (!isfinite(z)) {
      broken += 1;
      continue;
    }
    low = fmin(low, z);
    high = fmax(high, z);
    fractional += (float)(rint(z / step) * step) != z;
    const float right = x + 1 < cols ? values[y * cols + x + 1] : INFINITY,
                below = y + 1 < rows ? values[y * cols + cols + x] : INFINITY;
    if (isfinite(right)) {
      across += (right - z) * (right - z);
      pairs_across += 1;
    }
    if (isfinite(below)) {
      down += (below - z) * (below - z);
      pairs_down += 1;
    }
  }
  const int at = b * cols + x, all = blocks * cols;
  stats[at] = low;
  stats[all + at] = high;
  stats[2 * all + at] = (float)broken;
  stats[3 * all + at] = (float)fractional;
  stats[4 * all + at] = across;
  stats[5 * all + at] = down;
  stats[6 * all + at] = (float)pairs_across;
  stats[7 * all + at] = (float)pairs_down;
}

/* layers: depth in whole steps, in place.

  depth  (count)  float   [length] in, [step] out
  step            double  [length]

Work-item p owns one node. */
__kernel void layers(__global float *depth, double step, int count)
{
  const int p = get_global_id(0);
  if (p < count)
    depth[p] = (float)rint(depth[p] / step);
}

/* heights: -depth / step with margins round the map: the map again where it repeats, else NONE.

  depth    (rows x cols)      float  [length]   +inf where masked
  heights  (height x width)   float  [spacing]  out; masked where masked

The map begins in column left of row above. Work-item (x, y) owns one element. */
__kernel void heights(__global const float *depth, __global float *heights, int rows, int cols, int left,
                      int above, int width, int height, float step, float masked, int periodic)
{
  const int column = get_global_id(0), row = get_global_id(1);
  if (column >= width || row >= height)
    return;
  int x = column - left, y = row - above;
  if (periodic) {
    x = (x % cols + cols) % cols;
    y = (y % rows + rows) % rows;
  }
  float value = NONE;
  if (x >= 0 && x < cols && y >= 0 && y < rows) {
    const float z = depth[y * cols + x];
    value = z == INFINITY ? masked : -z / step;
  }
  heights[row * width + column] = value;
}

/* shade: image = max(image, least) x (albedo x factor), nan where masked.

  image   (count)       float  in and out
  depth   (count)       float  [length]  +inf where masked
  albedo  (count or 1)  float  [1]       of every node if varies, else of all

Work-item p owns one node. */
__kernel void shade(__global float *image, __global const float *depth, __global const float *albedo,
                    int varies, float factor, float least, int count)
{
  const int p = get_global_id(0);
  if (p >= count)
    return;
  const float share = albedo[varies ? p : 0] * factor;
  image[p] = depth[p] == INFINITY ? NAN : fmax(image[p], least) * share;
}

/* probe: the steepest slope to ground in eight directions from every `every`-th node, at growing distances
from first on; -inf where none lies, or the node is masked.

  heights  (room)      float  [spacing]  as for sweep
  best     (8, count)  float  [1]        out

Work-item (sample, direction) owns one slope; samples run along rows, across of them in each. */
__kernel void probe(__global const float *heights, __global float *best, int rows, int cols, int margin,
                    int every, int across, int count, int first)
{
  const int sample = get_global_id(0), way = get_global_id(1);
  if (sample >= count || way >= 8)
    return;
  const int i = way == 0 || way == 1 || way == 7 ? 1 : way == 2 || way == 6 ? 0 : -1;
  const int j = way >= 1 && way <= 3 ? 1 : way == 0 || way == 4 ? 0 : -1;
  const int x = sample % across * every, y = sample / across * every, stride = cols + 2 * margin;
  const float own = heights[(y + margin) * stride + margin + x];
  float steepest = -INFINITY;
  if (own <= HIGHEST_MASKED) {
    best[way * count + sample] = steepest;
    return;
  }
  for (int distance = first; distance < max(rows, cols); distance = distance * 5 / 4 + 1) {
    const int u = x + i * distance, v = y + j * distance;
    if (u >= 0 && u < cols && v >= 0 && v < rows) {
      const float there = heights[(v + margin) * stride + margin + u];
      if (there > HIGHEST_MASKED)
        steepest = fmax(steepest, (there - own) / (float)distance);
    }
  }
  best[way * count + sample] = steepest;
}
