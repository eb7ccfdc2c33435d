"""The paper's forward algorithm: the visibility field of a layer from the layers above it. Twin of
opencl/propagate.cl.

depth  (rows, cols)  float32 [layers]  +inf where masked
field  (layers + reach, words, rows + 2 reach, cols + 2 reach) uint32
       packed bits of the nodes and of a rim around them; layer n stands at n + reach; 0 below the surface
reach  m, the longest step; words: uint32 per node
"""

import warp as wp

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def reaches(
    depth: wp.array2d[wp.float32],
    ways: wp.array2d[wp.int32],
    lap: wp.array2d[wp.float32],
    levels: wp.array3d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    lap_lines: wp.int32,
    periodic: wp.int32,
):
    """k = 0 rays stay in their layer, so all layers share one walk in order from the source's side: a level
    ray from (x, y, n) gets out iff n <= level(x, y) = the least depth on its way.

      ways    (ways, 2)           int32    i, j
      lap     (ways, lap_lines)   float32  periodic: the least depth of a line's cycle
      levels  (ways, rows, cols)  float32  out

    Thread (w, line) owns one lattice line.
    """
    w, line = wp.tid()
    i = ways[w, 0]
    j = ways[w, 1]
    # along rows where the stride has no part in columns
    across = rows
    along = cols
    stride = wp.abs(i)
    if j != 0:
        across = cols
        along = rows
        stride = wp.abs(j)
    residue = line // across
    lane = line - residue * across
    if residue >= wp.min(stride, along):
        return
    start = residue
    if i > 0 and j == 0 or j > 0:
        start = along - 1 - residue
    x = start
    y = lane
    if j != 0:
        x = lane
        y = start
    level = wp.float32(wp.inf)
    if periodic != 0:
        level = lap[w, line]
    for _u in range(residue, along, stride):
        if periodic == 0 and (x + i < 0 or x + i >= cols):
            level = wp.inf
        levels[w, y, x] = level
        level = wp.min(depth[y, x], level)
        x = ((x - i) % cols + cols) % cols
        y = ((y - j) % rows + rows) % rows


@wp.kernel
def propagate(
    depth: wp.array2d[wp.float32],
    levels: wp.array3d[wp.float32],
    offsets: wp.array2d[wp.int32],
    field: wp.array3d[wp.uint32],
    rows: wp.int32,
    cols: wp.int32,
    reach: wp.int32,
    n_words: wp.int32,
    n_directions: wp.int32,
    n_level: wp.int32,
    layer: wp.int32,
):
    """L in V(x) iff x + L in F and L in V(x + L); the first n_level directions have k = 0 and are read off
    `levels`.

      offsets  (directions, 2)  int32  k, and j x (cols + 2 reach) + i: from a node to the one its ray comes
                                       from

    Thread (word, y, x) owns one node, 32 directions.
    """
    word, y, x = wp.tid()
    node = (y + reach) * (cols + 2 * reach) + x + reach
    lit = wp.uint32(0)
    if depth[y, x] >= wp.float32(layer):
        for b in range(wp.min(32, n_directions - 32 * word)):
            d = 32 * word + b
            bit = wp.uint32(1) << wp.uint32(b)
            if d < n_level:
                if levels[d, y, x] >= wp.float32(layer):
                    lit |= bit
            else:
                lit |= field[layer + reach - offsets[d, 0], word, node + offsets[d, 1]] & bit
    field[layer + reach, word, node] = lit


@wp.kernel
def wrap(
    field: wp.array4d[wp.uint32],
    rows: wp.int32,
    cols: wp.int32,
    reach: wp.int32,
    n_words: wp.int32,
    layer: wp.int32,
):
    """Where the map repeats, the rim of layer n is the other side of the map. Thread (word, Y, X) owns a rim
    node.
    """
    word, Y, X = wp.tid()
    x = X - reach
    y = Y - reach
    if x >= 0 and x < cols and y >= 0 and y < rows:
        return
    from_x = (x % cols + cols) % cols
    from_y = (y % rows + rows) % rows
    field[layer + reach, word, Y, X] = field[layer + reach, word, from_y + reach, from_x + reach]
