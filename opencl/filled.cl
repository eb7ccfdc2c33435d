/* Surface visibility that tests every crossing of a ray with a grid line of either axis, not only the lattice nodes.

scan_filled: as scan, and between a node and the next one towards the source the depths of the crossings, linear between
two nodes, lower the ceiling too. All depths are multiplied by the walk's `parts`, so that whole layers stay exact.

  depth, lap, planes, rows, cols, lap_lines, periodic  as in scan
  walks      (walks, 8)     int    as in scan; the last entry is parts
  rise       (walks, BITS)  float  [length x parts] per step
  crossings  (n, 8)         int    x, y of a node, x, y to the next node on that line, the weights of both, when, parts
  climbs     (n, BITS)      float  [length x parts] what the ray climbs until the crossing
  spans      (walks, 2)     int    first crossing of a walk and how many; the last is the lattice node itself

A crossing with a masked end, or off the map, does not block. Work-item (g, w) owns LANES adjacent lines of walk w.
Twin of warp_kernels/filled.py. */
#include "lanes.h"

__kernel void scan_filled(__global const float *depth, __global const int *walks, __global const float *rise,
                          __global const float *lap, __global const int *crossings, __global const float *climbs,
                          __global const int *spans, __global uchar *planes, int rows, int cols, int lap_lines,
                          int periodic)
{
  const int w = get_global_id(1);
  const int i = walks[8 * w], j = walks[8 * w + 1];
  const int right = walks[8 * w + 2], down = walks[8 * w + 3], warm = walks[8 * w + 4];
  const float parts = walks[8 * w + 7];
  __global uchar *plane = planes + (size_t)w * rows * cols;

  /* 1. which lines */
  const int across = j ? cols : rows, along = j ? rows : cols, stride = abs(j ? j : i);
  const int groups = (across + LANES - 1) / LANES;
  const int residue = get_global_id(0) / groups, lane = (get_global_id(0) % groups) * LANES;
  if (residue >= min(stride, along))
    return;
  const int count = (along - residue + stride - 1) / stride;
  const int start = (j ? j : i) > 0 ? along - 1 - residue : residue;
  int x = ((j ? lane : start) + walks[8 * w + 5]) % cols;
  int y = ((j ? start : lane) + walks[8 * w + 6]) % rows;

  /* 2. nothing above yet, or the whole cycle */
  floats ceiling[BITS];
  for (int b = 0; b < BITS; ++b)
    ceiling[b] = INFINITY;
  if (periodic && rise[BITS * w] == 0)
    for (int l = 0; l < LANES; ++l)
      ((float *)ceiling)[l] = lap[(size_t)w * lap_lines + residue * across + min(lane + l, across - 1)];

  const int full = LANES == 1 || (j && lane + LANES <= across);
  for (int u = 0; u < warm + count; ++u) {
    /* 3. lanes that have just entered the map have open sky beyond it */
    const int in_step = full && x <= cols - LANES;
    if (!periodic && (!in_step || x + i < 0 || x + LANES - 1 + i >= cols))
      for (int l = 0; l < LANES; ++l) {
        const int from = (j ? (x + l) % cols : x) + i;
        if (from < 0 || from >= cols)
          for (int b = 0; b < BITS; ++b)
            ((float *)&ceiling[b])[l] = INFINITY;
      }
    /* 4. the crossings between this node and the next one towards the source */
    for (int c = spans[2 * w]; c < spans[2 * w] + spans[2 * w + 1] - 1; ++c) {
      __global const int *at = crossings + 8 * c;
      const float w_near = at[4], w_far = at[5];
      floats ground;
      const int cx = x + at[0], cy = y + at[1], ex = cx + at[2], ey = cy + at[3];
      if (in_step && min(cx, ex) >= 0 && max(cx, ex) <= cols - LANES && cy >= 0 && ey < rows) {
        const floats near = LOAD((size_t)cy * cols + cx, depth), far = LOAD((size_t)ey * cols + ex, depth);
        ground = near < INFINITY && far < INFINITY ? w_near * near + w_far * far : (floats)INFINITY;
      } else
        for (int l = 0; l < LANES; ++l) {
          int nx = (j ? (x + l) % cols : x) + at[0], ny = (j ? y : (y + l) % rows) + at[1];
          int fx = nx + at[2], fy = ny + at[3];
          float value = INFINITY;
          if (periodic) {
            nx = (nx % cols + cols) % cols;
            fx = (fx % cols + cols) % cols;
            ny = (ny % rows + rows) % rows;
            fy = (fy % rows + rows) % rows;
          }
          if (nx >= 0 && nx < cols && ny >= 0 && ny < rows && fx >= 0 && fx < cols && fy >= 0 && fy < rows) {
            const float near = depth[(size_t)ny * cols + nx], far = depth[(size_t)fy * cols + fx];
            if (near < INFINITY && far < INFINITY)
              value = w_near * near + w_far * far;
          }
          ((float *)&ground)[l] = value;
        }
      for (int b = 0; b < BITS; ++b) {
        const floats limit = ground + climbs[BITS * c + b];
        ceiling[b] = limit < ceiling[b] ? limit : ceiling[b];
      }
    }
    /* 5. the bits of this node, and the ceiling of the next */
    floats z;
    if (in_step)
      z = LOAD((size_t)y * cols + x, depth);
    else
      for (int l = 0; l < LANES; ++l)
        ((float *)&z)[l] = j ? depth[(size_t)y * cols + (x + l) % cols] : depth[(size_t)((y + l) % rows) * cols + x];
    z *= parts;
    ints lit = 0;
    for (int b = 0; b < BITS; ++b) {
      lit |= WHERE(z <= ceiling[b]) & (1 << b);
      ceiling[b] = (z < ceiling[b] ? z : ceiling[b]) + rise[BITS * w + b];
    }
    lit &= WHERE(z < INFINITY);
    if (u >= warm) {
      const uchars bytes = TO_UCHARS(lit);
      if (in_step)
        STORE(bytes, (size_t)y * cols + x, plane);
      else
        for (int l = 0; l < LANES && lane + l < across; ++l)
          plane[j ? (size_t)y * cols + (x + l) % cols : (size_t)(y + l) * cols + x] = ((uchar *)&bytes)[l];
    }
    x += right;
    x -= x >= cols ? cols : 0;
    y += down;
    y -= y >= rows ? rows : 0;
  }
}
