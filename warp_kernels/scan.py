"""Surface visibility by the suffix maximum along lattice lines: propagation's own bits, N times cheaper.

Twin of opencl/scan.cl.
"""

import functools

import warp as wp

from . import AHEAD, OPTIONS

ints = wp.types.vector(AHEAD, wp.int32)
depths = wp.types.vector(AHEAD, wp.float32)


@functools.cache
def scan(BITS: int):
    """Walks every lattice line of one azimuth (i, j) from the source's side and carries, for each of BITS elevations,
    the depth that the ray there must not exceed: ceiling <- min(ceiling, depth) + k step; a node is lit iff
    depth <= ceiling. A line that leaves the map goes on at its other side, as a new line (open, dark) or as itself (periodic).

      depth   (rows, cols)        float32  [length]  +inf where masked: blocks nothing, never lit
      walks   (walks, 8)          int32    i, j, -i mod cols, -j mod rows, warm-up steps, their x and y offset, parts
      rise    (walks, BITS)       float32  [length]  k step, what the ray climbs per step
      lap     (walks, lap_lines)  float32  [length]  periodic: first ceiling of the k = 0 ray, the least depth of its cycle
      planes  (walks, rows, cols) uint8    out: bit b is set where the walk's b-th elevation is lit
      rows, cols, lap_lines, periodic (0 or 1)

    Thread (w, line) owns one line of walk w; AHEAD depths are fetched before they are used.
    No sums, only min and + in the order of the line: every bit is exact.
    """
    floats = wp.types.vector(BITS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def scan(
        depth: wp.array2d[wp.float32],
        walks: wp.array2d[wp.int32],
        rise: wp.array2d[wp.float32],
        lap: wp.array2d[wp.float32],
        planes: wp.array3d[wp.uint8],
        rows: wp.int32,
        cols: wp.int32,
        lap_lines: wp.int32,
        periodic: wp.int32,
    ):
        w, line = wp.tid()
        i = walks[w, 0]
        j = walks[w, 1]
        right = walks[w, 2]
        down = walks[w, 3]
        warm = walks[w, 4]

        # 1. which line: side by side across the map, one set per residue of the stride
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
        count = (along - residue + stride - 1) // stride
        start = residue
        if i > 0 and j == 0 or j > 0:
            start = along - 1 - residue
        x = start
        y = lane
        if j != 0:
            x = lane
            y = start
        x = (x + walks[w, 5]) % cols
        y = (y + walks[w, 6]) % rows

        # 2. nothing above yet; where the map repeats, a level ray starts with its whole cycle above it
        ceiling = floats()
        climb = floats()
        for b in range(BITS):
            ceiling[b] = wp.inf
            climb[b] = rise[w, b]
        if periodic != 0 and climb[0] == 0.0:
            ceiling[0] = lap[w, line]

        # 3. from x_low to x_high the line has not just entered the map
        x_low = wp.int32(0)
        x_high = cols - 1
        if periodic == 0:
            x_low = wp.max(0, -i)
            x_high = cols - 1 - wp.max(0, i)
        for u in range(0, warm + count, AHEAD):
            z = depths()
            xs = ints()
            ys = ints()
            for a in range(AHEAD):
                xs[a] = x
                ys[a] = y
                if u + a < warm + count:
                    z[a] = depth[y, x]
                x += right
                if x >= cols:
                    x -= cols
                y += down
                if y >= rows:
                    y -= rows
            for a in range(AHEAD):
                if u + a < warm + count:
                    # 4. a line whose next node towards the source lies outside the map has open sky there
                    if xs[a] < x_low or xs[a] > x_high:
                        for b in range(BITS):
                            ceiling[b] = wp.inf
                    # 5. the bits of this node, and the ceiling of the next
                    lit = wp.int32(0)
                    for b in range(BITS):
                        if z[a] <= ceiling[b]:
                            lit |= 1 << b
                        ceiling[b] = wp.min(z[a], ceiling[b]) + climb[b]
                    if z[a] == wp.inf:
                        lit = 0
                    if u + a >= warm:
                        planes[w, ys[a], xs[a]] = wp.uint8(lit)

    return scan


@functools.cache
def pack(BITS: int):
    """Planes of some walks -> packed visibility bits, direction d in bit d % 32 of word d // 32.

      planes  (walks, rows, cols)   uint8
      order   (walks, BITS)         int32   the direction of each bit
      words   (rows, cols, n_words) uint32  in, out: bits are added, so walks may come in groups

    Thread p owns pixel p.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def pack(
        planes: wp.array3d[wp.uint8],
        order: wp.array2d[wp.int32],
        words: wp.array3d[wp.uint32],
        pixels: wp.int32,
        n_words: wp.int32,
        n_walks: wp.int32,
    ):
        p = wp.tid()
        cols = words.shape[1]
        y = p // cols
        x = p - y * cols
        for w in range(n_walks):
            lit = wp.uint32(planes[w, y, x])
            for b in range(BITS):
                d = order[w, b]
                words[y, x, d // 32] = words[y, x, d // 32] | (((lit >> wp.uint32(b)) & wp.uint32(1)) << wp.uint32(d % 32))

    return pack
