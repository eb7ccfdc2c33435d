/* Surface visibility by the suffix maximum along lattice lines: propagation's own bits, N times cheaper.

scan: walks every lattice line of one azimuth (i, j) from the source's side and carries, for each of BITS
elevations, the depth that the ray there must not exceed: ceiling <- min(ceiling, depth) + k step; a node is
lit iff depth <= ceiling. A line that leaves the map goes on at its other side, as a new line (open, dark) or
as itself (periodic).

  maps    (2, room)           float  [length]  depth (rows, cols) and the same turned, (cols, rows); +inf
                                               where masked: blocks nothing, never lit; room: pixels, rounded
                                               up for whole vectors
  walks   (walks, 8)          int    i, j (not 0, and |i| less than the map is wide), warm-up steps, their x
                                     and y offset, parts, which map, which plane; those of the turned map are
                                     the turned ones
  rise    (walks, BITS)       float  [length]  k step, what the ray climbs per step
  lap     (walks, lap_lines)  float  [length]  periodic: first ceiling of the k = 0 ray, the least depth of
                                               its cycle
  planes  (planes, room)      uchar  out: bit b is set where the walk's b-th elevation is lit
  map_rows, map_cols, room, lap_lines, periodic (0 or 1)

Work-item (g, w) owns LANES adjacent lines of walk w, side by side in x; AHEAD depths are fetched before
they are used. No sums, only min and + in the order of the line: every bit is exact. Twin of
warp_kernels/scan.py. */
#include "lanes.h"

#if LANES == 1
#define COLUMN(x, l) (x)
#else
#define COLUMN(x, l) (((x) + (l)) % cols)
#endif

/* The bits of a node of depth z; lowers the ceilings to it and raises them by one step. */
ints lit_bits(floats z, floats *ceiling, const float *climb)
{
  ints lit = 0;
  for (int b = 0; b < BITS; ++b) {
    lit |= WHERE(z <= ceiling[b]) & (1 << b);
    ceiling[b] = (z < ceiling[b] ? z : ceiling[b]) + climb[b];
  }
  return lit;
}

/* neighbouring lines share cache lines, so large groups are faster than many */
__attribute__((reqd_work_group_size(GROUP, 1, 1)))
__kernel void scan(__global const float *maps, __global const int *walks, __global const float *rise,
                   __global const float *lap, __global uchar *planes, int map_rows, int map_cols, int room,
                   int lap_lines, int periodic)
{
  const int w = get_global_id(1), turned = walks[8 * w + 6];
  const int rows = turned ? map_cols : map_rows, cols = turned ? map_rows : map_cols;
  __global const float *depth = maps + (turned ? room : 0);
  const int i = walks[8 * w], j = walks[8 * w + 1], warm = walks[8 * w + 2], stride = abs(j);
  __global uchar *plane = planes + (size_t)walks[8 * w + 7] * room;

  /* 1. which lines: side by side across the map, one set per residue of the stride */
  const int groups = (cols + LANES - 1) / LANES;
  const int residue = get_global_id(0) / groups, lane = (get_global_id(0) % groups) * LANES;
  if (residue >= min(stride, rows))
    return;
  const int count = (rows - residue + stride - 1) / stride;
  int x = (lane + walks[8 * w + 3]) % cols;
  int y = ((j > 0 ? rows - 1 - residue : residue) + walks[8 * w + 4]) % rows;
  const int turn_x = i > 0 ? cols : -cols, down = j % rows, turn_y = j > 0 ? rows : -rows;

  /* 2. nothing above yet; where the map repeats, a level ray starts with its whole cycle above it */
  floats ceiling[BITS];
  float climb[BITS];
  for (int b = 0; b < BITS; ++b) {
    ceiling[b] = MAXFLOAT; /* finite, so that a masked node never passes */
    climb[b] = rise[BITS * w + b];
  }
  if (periodic && climb[0] == 0)
    for (int l = 0; l < LANES; ++l)
      ((float *)ceiling)[l] = lap[(size_t)w * lap_lines + residue * cols + min(lane + l, cols - 1)];

  /* 3. from x_low on, for x_span nodes, all lanes are neighbours in one row and none has just entered the
     map */
  const int x_low = periodic ? 0 : max(0, -i);
  const int x_span = max(0, cols - LANES + 1 - (periodic ? 0 : (int)abs(i)));
  const int whole = lane + LANES <= cols, next = -(i + down * cols);
  for (int u = -warm; u < count; u += AHEAD) {
    const int at = y * cols + x, last_x = x - (AHEAD - 1) * i, last_y = y - (AHEAD - 1) * down;
    if (whole && (uint)(x - x_low) < (uint)x_span && (uint)(last_x - x_low) < (uint)x_span &&
        (uint)last_y < (uint)rows && u >= 0 && u + AHEAD <= count) {
      /* 4. a stretch of AHEAD nodes inside the map */
      floats z[AHEAD];
      for (int a = 0; a < AHEAD; ++a)
        z[a] = LOAD(at + a * next, depth);
      for (int a = 0; a < AHEAD; ++a) {
        const uchars lit = TO_UCHARS(lit_bits(z[a], ceiling, climb));
        STORE(lit, at + a * next, plane);
      }
      x = last_x - i;
      x += (uint)x >= (uint)cols ? turn_x : 0;
      y = last_y - down;
      y += (uint)y >= (uint)rows ? turn_y : 0;
    } else
      for (int a = u; a < min(u + AHEAD, count); ++a) {
        /* 5. near a side: a lane whose next node towards the source lies outside the map has open sky
           there */
        floats z;
        for (int l = 0; l < LANES; ++l) {
          const int xl = COLUMN(x, l);
          ((float *)&z)[l] = depth[y * cols + xl];
          if (!periodic && (uint)(xl + i) >= (uint)cols)
            for (int b = 0; b < BITS; ++b)
              ((float *)&ceiling[b])[l] = MAXFLOAT;
        }
        const uchars lit = TO_UCHARS(lit_bits(z, ceiling, climb));
        for (int l = 0; l < LANES && lane + l < cols && a >= 0; ++l)
          plane[y * cols + COLUMN(x, l)] = ((uchar *)&lit)[l];
        x -= i;
        x += (uint)x >= (uint)cols ? turn_x : 0;
        y -= down;
        y += (uint)y >= (uint)rows ? turn_y : 0;
      }
  }
}

/* turn_map: the second of `maps`, (cols, rows), from the first, (rows, cols), so that walks along rows become
walks along columns. turn_planes: planes of the turned map, (cols, rows), to planes of the map; the pairs
(from, to) are given.

Work-item (g, w) owns COPY_SIDE x COPY_SIDE nodes; 32 neighbours own a patch of 8 x 4 such blocks, so that
both sides of the copy stay within few cache lines. */

int block_x(int g, int cols)
{
  const int patches = (cols + PATCH_X * COPY_SIDE - 1) / (PATCH_X * COPY_SIDE),
            patch = g / (PATCH_X * PATCH_Y);
  return ((patch % patches) * PATCH_X + g % PATCH_X) * COPY_SIDE;
}

int block_y(int g, int cols)
{
  const int patches = (cols + PATCH_X * COPY_SIDE - 1) / (PATCH_X * COPY_SIDE),
            patch = g / (PATCH_X * PATCH_Y);
  return ((patch / patches) * PATCH_Y + g / PATCH_X % PATCH_Y) * COPY_SIDE;
}

__kernel void turn_map(__global float *maps, int rows, int cols, int room)
{
  const int x0 = block_x(get_global_id(0), cols), y0 = block_y(get_global_id(0), cols);
  for (int y = y0; y < min(y0 + COPY_SIDE, rows); ++y)
    for (int x = x0; x < min(x0 + COPY_SIDE, cols); ++x)
      maps[room + x * rows + y] = maps[y * cols + x];
}

__kernel void turn_planes(__global uchar *planes, __global const int *pairs, int rows, int cols, int room)
{
  const int x0 = block_x(get_global_id(0), cols), y0 = block_y(get_global_id(0), cols), w = get_global_id(1);
  __global const uchar *turned = planes + (size_t)pairs[2 * w] * room;
  __global uchar *plane = planes + (size_t)pairs[2 * w + 1] * room;
  for (int x = x0; x < min(x0 + COPY_SIDE, cols); ++x)
    for (int y = y0; y < min(y0 + COPY_SIDE, rows); ++y)
      plane[y * cols + x] = turned[x * rows + y];
}

/* turn_planes_by_fours: the same where rows and cols are multiples of 4, with four bytes to a uint. */
__kernel void turn_planes_by_fours(__global uint *planes, __global const int *pairs, int rows, int cols,
                                   int room)
{
  const int x0 = block_x(get_global_id(0), cols), y0 = block_y(get_global_id(0), cols), w = get_global_id(1);
  if (x0 >= cols || y0 >= rows)
    return;
  __global const uint *turned = planes + (size_t)pairs[2 * w] * (room / 4);
  __global uint *plane = planes + (size_t)pairs[2 * w + 1] * (room / 4);
  uint column[COPY_SIDE];
  for (int x = 0; x < COPY_SIDE; ++x)
    column[x] = turned[((x0 + x) * rows + y0) / 4];
  for (int y = 0; y < COPY_SIDE; ++y) {
    uint row = 0;
    for (int x = 0; x < COPY_SIDE; ++x)
      row |= (column[x] >> 8 * y & 255u) << 8 * x;
    plane[((y0 + y) * cols + x0) / 4] = row;
  }
}

/* pack: planes of some walks -> packed visibility bits, direction d in bit d % 32 of word d // 32.

  planes  (walks, room)        uchar
  order   (walks, BITS)        int    the direction of each bit
  words   (pixels, n_words)    uint   in, out: bits are added, so walks may come in groups

Work-item p owns pixel p. */
__kernel void pack(__global const uchar *planes, __global const int *order, __global uint *words, int pixels,
                   int room, int n_words, int n_walks)
{
  const size_t p = get_global_id(0);
  if (p >= pixels)
    return;
  for (int w = 0; w < n_walks; ++w) {
    const uint lit = planes[(size_t)w * room + p];
    for (int b = 0; b < BITS; ++b) {
      const int d = order[BITS * w + b];
      words[p * n_words + d / 32] |= (lit >> b & 1u) << d % 32;
    }
  }
}
