/* Surface visibility that tests every crossing of a ray with a grid line of either axis, not only the lattice
nodes.

scan_filled: as scan, and between a node and the next one towards the source the depths of the crossings,
linear between two nodes, lower the ceiling too. All depths are multiplied by the walk's `parts`, so that
whole layers stay exact.

  maps, walks, lap, planes, map_rows, map_cols, room, lap_lines, periodic  as in scan
  rise       (walks, BITS)  float  [length x parts] per step
  crossings  (n, 8)         int    x, y of a node, x, y to the next node on that line, the weights of both,
                                   when, parts
  climbs     (n, BITS)      float  [length x parts] what the ray climbs until the crossing
  spans      (walks, 2)     int    first crossing of a walk and how many; the last is the lattice node itself

A crossing with a masked end, or off the map, does not block. Work-item (g, w) owns LANES adjacent lines of
walk w. Twin of warp_kernels/filled.py. */
#include "lanes.h"

/* Depth of a node; +inf off a map that does not repeat. */
float depth_at(__global const float *depth, int x, int y, int rows, int cols, int periodic)
{
  if (periodic) {
    x = (x % cols + cols) % cols;
    y = (y % rows + rows) % rows;
  }
  return x < 0 || x >= cols || y < 0 || y >= rows ? INFINITY : depth[(size_t)y * cols + x];
}

__kernel void scan_filled(__global const float *maps, __global const int *walks, __global const float *rise,
                          __global const float *lap, __global const int *crossings,
                          __global const float *climbs, __global const int *spans, __global uchar *planes,
                          int map_rows, int map_cols, int room, int lap_lines, int periodic)
{
  const int w = get_global_id(1), turned = walks[8 * w + 6];
  const int rows = turned ? map_cols : map_rows, cols = turned ? map_rows : map_cols;
  __global const float *depth = maps + (turned ? room : 0);
  const int i = walks[8 * w], j = walks[8 * w + 1], warm = walks[8 * w + 2], stride = abs(j);
  const float parts = walks[8 * w + 5];
  __global uchar *plane = planes + (size_t)walks[8 * w + 7] * room;

  /* 1. which lines */
  const int groups = (cols + LANES - 1) / LANES;
  const int residue = get_global_id(0) / groups, lane = (get_global_id(0) % groups) * LANES;
  if (residue >= min(stride, rows))
    return;
  const int count = (rows - residue + stride - 1) / stride;
  int x = (lane + walks[8 * w + 3]) % cols;
  int y = ((j > 0 ? rows - 1 - residue : residue) + walks[8 * w + 4]) % rows;
  const int turn_x = i > 0 ? cols : -cols, down = j % rows, turn_y = j > 0 ? rows : -rows;

  /* 2. nothing above yet, or the whole cycle */
  floats ceiling[BITS];
  for (int b = 0; b < BITS; ++b)
    ceiling[b] = MAXFLOAT;
  if (periodic && rise[BITS * w] == 0)
    for (int l = 0; l < LANES; ++l)
      ((float *)ceiling)[l] = lap[(size_t)w * lap_lines + residue * cols + min(lane + l, cols - 1)];

  for (int u = -warm; u < count; ++u) {
    /* 3. lanes that have just entered the map have open sky beyond it */
    const int in_step = lane + LANES <= cols && x <= cols - LANES;
    if (!periodic && (!in_step || x + i < 0 || x + LANES - 1 + i >= cols))
      for (int l = 0; l < LANES; ++l) {
        const int from = (x + l) % cols + i;
        if (from < 0 || from >= cols)
          for (int b = 0; b < BITS; ++b)
            ((float *)&ceiling[b])[l] = MAXFLOAT;
      }
    /* 4. the crossings between this node and the next one towards the source */
    for (int c = spans[2 * w]; c < spans[2 * w] + spans[2 * w + 1] - 1; ++c) {
      __global const int *at = crossings + 8 * c;
      const float w_far = at[5];
      floats ground;
      const int nx = x + at[0], ny = y + at[1], fx = nx + at[2], fy = ny + at[3];
      if (in_step && min(nx, fx) >= 0 && max(nx, fx) <= cols - LANES && ny >= 0 && fy < rows) {
        const floats near = LOAD((size_t)ny * cols + nx, depth), far = LOAD((size_t)fy * cols + fx, depth);
        ground = near < INFINITY && far < INFINITY ? parts * near + w_far * (far - near) : (floats)INFINITY;
      } else
        for (int l = 0; l < LANES; ++l) {
          const float near = depth_at(depth, (x + l) % cols + at[0], ny, rows, cols, periodic);
          const float far = depth_at(depth, (x + l) % cols + at[0] + at[2], fy, rows, cols, periodic);
          ((float *)&ground)[l] =
              near < INFINITY && far < INFINITY ? parts * near + w_far * (far - near) : INFINITY;
        }
      for (int b = 0; b < BITS; ++b) {
        const floats limit = ground + climbs[BITS * c + b];
        ceiling[b] = limit < ceiling[b] ? limit : ceiling[b];
      }
    }
    /* 5. the bits of this node, and the ceiling of the next */
    const int at = y * cols;
    floats z;
    if (in_step)
      z = LOAD(at + x, depth);
    else
      for (int l = 0; l < LANES; ++l)
        ((float *)&z)[l] = depth[at + (x + l) % cols];
    z *= parts;
    ints lit = 0;
    for (int b = 0; b < BITS; ++b) {
      lit |= WHERE(z <= ceiling[b]) & (1 << b);
      ceiling[b] = (z < ceiling[b] ? z : ceiling[b]) + rise[BITS * w + b];
    }
    if (u >= 0) {
      const uchars bytes = TO_UCHARS(lit);
      if (in_step)
        STORE(bytes, at + x, plane);
      else
        for (int l = 0; l < LANES && lane + l < cols; ++l)
          plane[at + (x + l) % cols] = ((uchar *)&bytes)[l];
    }
    x -= i;
    x += (uint)x >= (uint)cols ? turn_x : 0;
    y -= down;
    y += (uint)y >= (uint)rows ? turn_y : 0;
  }
}
