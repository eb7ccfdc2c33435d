/* Surface visibility by the suffix maximum along lattice lines: propagation's own bits, N times cheaper.

scan: walks every lattice line of one azimuth (i, j) from the source's side and carries, for each of BITS elevations,
the depth that the ray there must not exceed: ceiling <- min(ceiling, depth) + k step; a node is lit iff
depth <= ceiling. A line that leaves the map goes on at its other side, as a new line (open, dark) or as itself (periodic).

  depth   (rows, cols)        float  [length]  +inf where masked: blocks nothing, never lit
  walks   (walks, 8)          int    i, j, -i mod cols, -j mod rows, warm-up steps, their x and y offset, 0
  rise    (walks, BITS)       float  [length]  k step, what the ray climbs per step
  lap     (walks, lap_lines)  float  [length]  periodic: first ceiling of the k = 0 ray, the least depth of its cycle
  planes  (walks, rows, cols) uchar  out: bit b is set where the walk's b-th elevation is lit
  rows, cols, lap_lines, periodic (0 or 1)

Work-item (g, w) owns LANES adjacent lines of walk w; AHEAD depths are fetched before they are used.
No sums, only min and + in the order of the line: every bit is exact. Twin of warp_kernels/scan.py. */
#include "lanes.h"

__kernel void scan(__global const float *depth, __global const int *walks, __global const float *rise,
                   __global const float *lap, __global uchar *planes, int rows, int cols, int lap_lines, int periodic)
{
  const int w = get_global_id(1);
  const int i = walks[8 * w], j = walks[8 * w + 1];
  const int right = walks[8 * w + 2], down = walks[8 * w + 3], warm = walks[8 * w + 4];
  __global uchar *plane = planes + (size_t)w * rows * cols;

  /* 1. which lines: side by side across the map, one set per residue of the stride */
  const int across = j ? cols : rows, along = j ? rows : cols, stride = abs(j ? j : i);
  const int groups = (across + LANES - 1) / LANES;
  const int residue = get_global_id(0) / groups, lane = (get_global_id(0) % groups) * LANES;
  if (residue >= min(stride, along))
    return;
  const int count = (along - residue + stride - 1) / stride;
  const int start = (j ? j : i) > 0 ? along - 1 - residue : residue;
  int x = ((j ? lane : start) + walks[8 * w + 5]) % cols;
  int y = ((j ? start : lane) + walks[8 * w + 6]) % rows;

  /* 2. nothing above yet; where the map repeats, a level ray starts with its whole cycle above it */
  floats ceiling[BITS];
  float climb[BITS];
  for (int b = 0; b < BITS; ++b) {
    ceiling[b] = INFINITY;
    climb[b] = rise[BITS * w + b];
  }
  if (periodic && climb[0] == 0)
    for (int l = 0; l < LANES; ++l)
      ((float *)ceiling)[l] = lap[(size_t)w * lap_lines + residue * across + min(lane + l, across - 1)];

  /* 3. from x_low to x_high all lanes are neighbours in one row and none has just entered the map */
  const int x_low = periodic ? 0 : max(0, -i);
  const int x_high = cols - LANES - (periodic ? 0 : max(0, i));
  const int in_step = LANES == 1 || (j && lane + LANES <= across);
  for (int u = 0; u < warm + count; u += AHEAD) {
    floats z[AHEAD];
    int xs[AHEAD], ys[AHEAD];
    for (int a = 0; a < AHEAD; ++a) {
      xs[a] = x;
      ys[a] = y;
      if (u + a < warm + count) {
        if (in_step && x <= cols - LANES)
          z[a] = LOAD((size_t)y * cols + x, depth);
        else
          for (int l = 0; l < LANES; ++l)
            ((float *)&z[a])[l] = j ? depth[(size_t)y * cols + (x + l) % cols] : depth[(size_t)((y + l) % rows) * cols + x];
      }
      x += right;
      x -= x >= cols ? cols : 0;
      y += down;
      y -= y >= rows ? rows : 0;
    }
    for (int a = 0; a < AHEAD && u + a < warm + count; ++a) {
      const int xa = xs[a], ya = ys[a];
      /* 4. a lane whose next node towards the source lies outside the map has open sky there */
      if (xa < x_low || xa > x_high)
        for (int l = 0; l < LANES; ++l) {
          const int from = (j ? (xa + l) % cols : xa) + i;
          if (!periodic && (from < 0 || from >= cols))
            for (int b = 0; b < BITS; ++b)
              ((float *)&ceiling[b])[l] = INFINITY;
        }
      /* 5. the bits of this node, and the ceiling of the next */
      ints lit = 0;
      for (int b = 0; b < BITS; ++b) {
        lit |= WHERE(z[a] <= ceiling[b]) & (1 << b);
        ceiling[b] = (z[a] < ceiling[b] ? z[a] : ceiling[b]) + climb[b];
      }
      lit &= WHERE(z[a] < INFINITY);
      if (u + a < warm)
        continue;
      const uchars bytes = TO_UCHARS(lit);
      if (in_step && xa <= cols - LANES)
        STORE(bytes, (size_t)ya * cols + xa, plane);
      else
        for (int l = 0; l < LANES && lane + l < across; ++l)
          plane[j ? (size_t)ya * cols + (xa + l) % cols : (size_t)(ya + l) * cols + xa] = ((uchar *)&bytes)[l];
    }
  }
}

/* pack: planes of some walks -> packed visibility bits, direction d in bit d % 32 of word d // 32.

  planes  (walks, rows, cols)   uchar
  order   (walks, BITS)         int    the direction of each bit
  words   (rows, cols, n_words) uint   in, out: bits are added, so walks may come in groups

Work-item p owns pixel p. */
__kernel void pack(__global const uchar *planes, __global const int *order, __global uint *words, int pixels, int n_words,
                   int n_walks)
{
  const size_t p = get_global_id(0);
  if (p >= pixels)
    return;
  for (int w = 0; w < n_walks; ++w) {
    const uint lit = planes[(size_t)w * pixels + p];
    for (int b = 0; b < BITS; ++b) {
      const int d = order[BITS * w + b];
      words[p * n_words + d / 32] |= (lit >> b & 1u) << d % 32;
    }
  }
}
