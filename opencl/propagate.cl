/* The paper's forward algorithm: the visibility field of a layer from the layers above it.

  depth  (rows, cols)  float [layers]  +inf where masked
  field  (layers + reach, words, rows + 2 reach, cols + 2 reach) uint
         packed bits of the nodes and of a rim around them; layer n stands at n + reach; 0 below the surface
  reach  m, the longest step; words: uints per node

reaches: k = 0 rays stay in their layer, so all layers share one walk in order from the source's side: a level
ray from (x, y, n) gets out iff n <= level(x, y) = the least depth on its way.

  ways    (ways, 2)           int    i, j
  lap     (ways, lap_lines)   float  periodic: the least depth of a line's cycle
  levels  (ways, rows, cols)  float  out

Work-item (line, w) owns one lattice line. Twin of warp_kernels/propagate.py. */
#include "lanes.h"

__kernel void reaches(__global const float *depth, __global const int *ways, __global const float *lap,
                      __global float *levels, int rows, int cols, int lap_lines, int periodic)
{
  const int line = get_global_id(0), w = get_global_id(1);
  const int i = ways[2 * w], j = ways[2 * w + 1];
  /* along rows where the stride has no part in columns */
  const int across = j ? cols : rows, along = j ? rows : cols, stride = abs(j ? j : i);
  const int residue = line / across, lane = line % across;
  if (residue >= min(stride, along))
    return;
  const int start = (j ? j : i) > 0 ? along - 1 - residue : residue;
  int x = j ? lane : start, y = j ? start : lane;
  float level = periodic ? lap[(size_t)w * lap_lines + line] : INFINITY;
  for (int u = residue; u < along; u += stride) {
    if (!periodic && (x + i < 0 || x + i >= cols))
      level = INFINITY;
    levels[((size_t)w * rows + y) * cols + x] = level;
    const float z = depth[(size_t)y * cols + x];
    level = z < level ? z : level;
    x = ((x - i) % cols + cols) % cols;
    y = ((y - j) % rows + rows) % rows;
  }
}

/* propagate: L in V(x) iff x + L in F and L in V(x + L); the first n_level directions have k = 0 and are read
off `levels`.

  offsets  (directions, 2)  int  k, and j x (cols + 2 reach) + i: from a node to the one its ray comes from

Work-item (g, y, word) owns LANES nodes of row y, 32 directions. */
__kernel void propagate(__global const float *depth, __global const float *levels,
                        __global const int *offsets, __global uint *field, int rows, int cols, int reach,
                        int n_words, int n_directions, int n_level, int layer)
{
  const int x = min((int)get_global_id(0) * LANES, max(cols - LANES, 0)), y = get_global_id(1),
            word = get_global_id(2);
  if (get_global_id(0) * LANES >= cols || y >= rows)
    return;
  const size_t width = cols + 2 * reach, slice = width * (rows + 2 * reach);
  const size_t node = (y + reach) * width + x + reach;
  const size_t here = ((size_t)(layer + reach) * n_words + word) * slice + node;
  const size_t above = slice * n_words;
  uints lit = 0;
  for (int b = 0; b < min(32, n_directions - 32 * word); ++b) {
    const int d = 32 * word + b;
    const uint bit = 1u << b;
    if (d < n_level)
      lit |= as_uints(WHERE(LOAD(((size_t)d * rows + y) * cols + x, levels) >= (float)layer)) & bit;
    else
      lit |= LOAD(here - above * offsets[2 * d] + offsets[2 * d + 1], field) & bit;
  }
  STORE(lit & as_uints(WHERE(LOAD((size_t)y * cols + x, depth) >= (float)layer)), here, field);
}

/* wrap: where the map repeats, the rim of layer n is the other side of the map. Work-item (X, Y, word) owns a
   rim node. */
__kernel void wrap(__global uint *field, int rows, int cols, int reach, int n_words, int layer)
{
  const int X = get_global_id(0), Y = get_global_id(1), word = get_global_id(2);
  const int width = cols + 2 * reach, height = rows + 2 * reach;
  const int x = X - reach, y = Y - reach;
  if (X >= width || Y >= height || (x >= 0 && x < cols && y >= 0 && y < rows))
    return;
  const size_t slice = ((size_t)(layer + reach) * n_words + word) * height;
  const int from_x = (x % cols + cols) % cols, from_y = (y % rows + rows) % rows;
  field[(slice + Y) * width + X] = field[(slice + from_y + reach) * width + from_x + reach];
}
