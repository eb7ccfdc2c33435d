"""Surface visibility that tests every crossing of a ray with a grid line of either axis, not only the lattice nodes.

Twin of opencl/filled.cl.
"""

import functools

import warp as wp

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def depth_at(depth: wp.array2d[wp.float32], x: wp.int32, y: wp.int32, rows: wp.int32, cols: wp.int32, periodic: wp.int32):
    """Depth of a node; +inf off a map that does not repeat."""
    cx = x
    cy = y
    if periodic != 0:
        cx = (x % cols + cols) % cols
        cy = (y % rows + rows) % rows
    if cx < 0 or cx >= cols or cy < 0 or cy >= rows:
        return wp.float32(wp.inf)
    return depth[cy, cx]


@functools.cache
def scan_filled(BITS: int):
    """As scan, and between a node and the next one towards the source the depths of the crossings, linear between two
    nodes, lower the ceiling too. All depths are multiplied by the walk's `parts`, so that whole layers stay exact.

      depth, lap, planes, rows, cols, lap_lines, periodic  as in scan
      walks      (walks, 8)     int32    as in scan; the last entry is parts
      rise       (walks, BITS)  float32  [length x parts] per step
      crossings  (n, 8)         int32    x, y of a node, x, y to the next node on that line, the weights of both, when, parts
      climbs     (n, BITS)      float32  [length x parts] what the ray climbs until the crossing
      spans      (walks, 2)     int32    first crossing of a walk and how many; the last is the lattice node itself

    A crossing with a masked end, or off the map, does not block. Thread (w, line) owns one line of walk w.
    """
    floats = wp.types.vector(BITS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def scan_filled(
        depth: wp.array2d[wp.float32],
        walks: wp.array2d[wp.int32],
        rise: wp.array2d[wp.float32],
        lap: wp.array2d[wp.float32],
        crossings: wp.array2d[wp.int32],
        climbs: wp.array2d[wp.float32],
        spans: wp.array2d[wp.int32],
        planes: wp.array3d[wp.uint8],
        rows: wp.int32,
        cols: wp.int32,
        lap_lines: wp.int32,
        periodic: wp.int32,
    ):
        w, line = wp.tid()
        i = walks[w, 0]
        j = walks[w, 1]
        warm = walks[w, 4]
        parts = wp.float32(walks[w, 7])

        # 1. which line
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

        # 2. nothing above yet, or the whole cycle
        ceiling = floats()
        for b in range(BITS):
            ceiling[b] = wp.inf
        if periodic != 0 and rise[w, 0] == 0.0:
            ceiling[0] = lap[w, line]

        for u in range(warm + count):
            # 3. a line that has just entered the map has open sky beyond it
            if periodic == 0 and (x + i < 0 or x + i >= cols):
                for b in range(BITS):
                    ceiling[b] = wp.inf
            # 4. the crossings between this node and the next one towards the source
            for c in range(spans[w, 0], spans[w, 0] + spans[w, 1] - 1):
                cx = x + crossings[c, 0]
                cy = y + crossings[c, 1]
                near = depth_at(depth, cx, cy, rows, cols, periodic)
                far = depth_at(depth, cx + crossings[c, 2], cy + crossings[c, 3], rows, cols, periodic)
                if near < wp.inf and far < wp.inf:
                    ground = wp.float32(crossings[c, 4]) * near + wp.float32(crossings[c, 5]) * far
                    for b in range(BITS):
                        ceiling[b] = wp.min(ground + climbs[c, b], ceiling[b])
            # 5. the bits of this node, and the ceiling of the next
            z = depth[y, x] * parts
            lit = wp.int32(0)
            for b in range(BITS):
                if z <= ceiling[b]:
                    lit |= 1 << b
                ceiling[b] = wp.min(z, ceiling[b]) + rise[w, b]
            if z == wp.inf:
                lit = 0
            if u >= warm:
                planes[w, y, x] = wp.uint8(lit)
            x += walks[w, 2]
            if x >= cols:
                x -= cols
            y += walks[w, 3]
            if y >= rows:
                y -= rows

    return scan_filled
