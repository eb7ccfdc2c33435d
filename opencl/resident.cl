/* A depth map that lies on the device already: checked, padded and probed there. Twin of
   warp_kernels/resident.py. */
#pragma OPENCL FP_CONTRACT OFF

/* take: depth = top + sign x value: a copy (0, 1), or the depth of heights (highest, -1).

  values, depth  (count)  float  [length]

Work-item p owns one node. */
__kernel void take(__global const float *values, __global float *depth, float top, float sign, int count)
{
  const int p = get_global_id(0);
  if (p < count)
    depth[p] = top + sign * values[p];
}

/* survey: per column the smallest and the largest value that is finite, and how many are not.

  values  (rows x cols)  float  [length]
  found   (3, cols)      float  out

Work-item x owns one column, from row 0 on. */
__kernel void survey(__global const float *values, __global float *found, int rows, int cols)
{
  const int x = get_global_id(0);
  if (x >= cols)
    return;
  float low = MAXFLOAT, high = -MAXFLOAT;
  int broken = 0;
  for (int y = 0; y < rows; y++) {
    const float z = values[y * cols + x];
    if (isfinite(z)) {
      low = fmin(low, z);
      high = fmax(high, z);
    } else
      broken++;
  }
  found[x] = low;
  found[cols + x] = high;
  found[2 * cols + x] = (float)broken;
}

/* pad: heights as sweep wants them, -depth / step with a margin round them: the map again where it repeats,
else outside.

  depth    (rows x cols)                          float  [length]
  heights  (rows + 2 margin) x (cols + 2 margin)  float  [spacing]  out

Work-item (x, y) owns one element of the padded map. */
__kernel void pad(__global const float *depth, __global float *heights, int rows, int cols, int margin,
                  float step, float outside, int periodic)
{
  const int column = get_global_id(0), row = get_global_id(1);
  int x = column - margin, y = row - margin;
  if (x >= cols + margin || y >= rows + margin)
    return;
  if (periodic) {
    x = (x % cols + cols) % cols;
    y = (y % rows + rows) % rows;
  }
  heights[row * (cols + 2 * margin) + column] =
      x >= 0 && x < cols && y >= 0 && y < rows ? -depth[y * cols + x] / step : outside;
}

/* probe: the steepest slope to ground in eight directions from every `every`-th node, at growing distances
from first on; -inf where none lies.

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
  for (int distance = first; distance < max(rows, cols); distance = distance * 5 / 4 + 1) {
    const int u = x + i * distance, v = y + j * distance;
    if (u >= 0 && u < cols && v >= 0 && v < rows)
      steepest = fmax(steepest, (heights[(v + margin) * stride + margin + u] - own) / (float)distance);
  }
  best[way * count + sample] = steepest;
}
