"""Surface visibility that tests every crossing of a ray with a grid line of either axis, not only the lattice
nodes.

Twin of opencl/filled.cl.
"""

import functools

import warp as wp

from skylamp.constants import NO_CEILING

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def depth_at(
    maps: wp.array2d[wp.float32],
    turned: wp.int32,
    x: wp.int32,
    y: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    periodic: wp.int32,
):
    """Depth of a node; +inf off a map that does not repeat."""
    cx = x
    cy = y
    if periodic != 0:
        cx = (x % cols + cols) % cols
        cy = (y % rows + rows) % rows
    if cx < 0 or cx >= cols or cy < 0 or cy >= rows:
        return wp.float32(wp.inf)
    return maps[turned, cy * cols + cx]


@functools.cache
def scan_filled(BITS: int):
    """As scan, and between a node and the next one towards the source the depths of the crossings, linear
    between two nodes, lower the ceiling too. All depths are multiplied by the walk's `parts`, so that whole
    layers stay exact.

      maps, walks, lap, planes, map_rows, map_cols, room, lap_lines, periodic  as in scan
      rise       (walks, BITS)  float32  [length x parts] per step
      crossings  (n, 8)         int32    x, y of a node, x, y to the next node on that line, the weights of
                                         both, when, parts
      climbs     (n, BITS)      float32  [length x parts] what the ray climbs until the crossing
      spans      (walks, 2)     int32    first crossing of a walk and how many; the last is the lattice node
                                         itself

    A crossing with a masked end, or off the map, does not block. Thread (w, line) owns one line of walk w.
    """
    floats = wp.types.vector(BITS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def scan_filled(
        maps: wp.array2d[wp.float32],
        walks: wp.array2d[wp.int32],
        rise: wp.array2d[wp.float32],
        lap: wp.array2d[wp.float32],
        crossings: wp.array2d[wp.int32],
        climbs: wp.array2d[wp.float32],
        spans: wp.array2d[wp.int32],
        planes: wp.array2d[wp.uint8],
        map_rows: wp.int32,
        map_cols: wp.int32,
        room: wp.int32,
        lap_lines: wp.int32,
        periodic: wp.int32,
    ):
        w, line = wp.tid()
        i = walks[w, 0]
        j = walks[w, 1]
        warm = walks[w, 2]
        turned = walks[w, 6]
        plane = walks[w, 7]
        rows = map_rows
        cols = map_cols
        if turned != 0:
            rows = map_cols
            cols = map_rows
        stride = wp.abs(j)
        parts = wp.float32(walks[w, 5])

        # 1. which line
        residue = line // cols
        lane = line - residue * cols
        if residue >= wp.min(stride, rows):
            return
        count = (rows - residue + stride - 1) // stride
        turn_x = -cols
        if i > 0:
            turn_x = cols
        y = residue
        turn_y = -rows
        if j > 0:
            y = rows - 1 - residue
            turn_y = rows
        x = (lane + walks[w, 3]) % cols
        y = (y + walks[w, 4]) % rows
        down = j % rows

        # 2. nothing above yet, or the whole cycle
        ceiling = floats()
        for b in range(BITS):
            ceiling[b] = NO_CEILING
        if periodic != 0 and rise[w, 0] == 0.0:
            ceiling[0] = lap[w, line]

        for u in range(-warm, count):
            # 3. a line that has just entered the map has open sky beyond it
            if periodic == 0 and (x + i < 0 or x + i >= cols):
                for b in range(BITS):
                    ceiling[b] = NO_CEILING
            # 4. the crossings between this node and the next one towards the source
            for c in range(spans[w, 0], spans[w, 0] + spans[w, 1] - 1):
                nx = x + crossings[c, 0]
                ny = y + crossings[c, 1]
                near = depth_at(maps, turned, nx, ny, rows, cols, periodic)
                far = depth_at(maps, turned, nx + crossings[c, 2], ny + crossings[c, 3], rows, cols, periodic)
                if near < wp.inf and far < wp.inf:
                    ground = parts * near + wp.float32(crossings[c, 5]) * (far - near)
                    for b in range(BITS):
                        ceiling[b] = wp.min(ground + climbs[c, b], ceiling[b])
            # 5. the bits of this node, and the ceiling of the next
            z = maps[turned, y * cols + x] * parts
            lit = wp.int32(0)
            for b in range(BITS):
                if z <= ceiling[b]:
                    lit |= 1 << b
                ceiling[b] = wp.min(z, ceiling[b]) + rise[w, b]
            if u >= 0:
                planes[plane, y * cols + x] = wp.uint8(lit)
            x -= i
            if wp.uint32(x) >= wp.uint32(cols):
                x += turn_x
            y -= down
            if wp.uint32(y) >= wp.uint32(rows):
                y += turn_y

    return scan_filled
