"""Surface visibility by the suffix maximum along lattice lines: propagation's own bits, N times cheaper.

Twin of opencl/scan.cl.
"""

import functools

import warp as wp

from skylamp.constants import COPY_SIDE, NO_CEILING, PATCH_X, PATCH_Y

from . import AHEAD, GROUP, OPTIONS

wp.set_module_options(OPTIONS)

depths = wp.types.vector(AHEAD, wp.float32)
fours = wp.types.vector(4, wp.uint32)


@functools.cache
def scan(BITS: int):
    """Walks every lattice line of one azimuth (i, j) from the source's side and carries, for each of BITS
    elevations, the depth that the ray there must not exceed: ceiling <- min(ceiling, depth) + k step; a node
    is lit iff depth <= ceiling. A line that leaves the map goes on at its other side, as a new line (open,
    dark) or as itself (periodic).

      maps    (2, room)           float32 [length]  depth (rows, cols) and the same turned, (cols, rows); +inf
                                                    where masked: blocks nothing, never lit; room: pixels,
                                                    rounded up for whole vectors
      walks   (walks, 8)          int32             i, j (not 0, and |i| less than the map is wide), warm-up
                                                    steps, their x and y offset, parts, which map, which
                                                    plane; those of the turned map are the turned ones
      rise    (walks, BITS)       float32 [length]  k step, what the ray climbs per step
      lap     (walks, lap_lines)  float32 [length]  periodic: first ceiling of the k = 0 ray, the least depth
                                                    of its cycle
      planes  (planes, room)      uint8             out: bit b is set where the walk's b-th elevation is lit
      map_rows, map_cols, room, lap_lines, periodic (0 or 1)

    Thread (w, line) owns one line of walk w; AHEAD depths are fetched before they are used. No sums, only min
    and + in the order of the line: every bit is exact.
    """
    floats = wp.types.vector(BITS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS, launch_bounds=GROUP)
    def scan(
        maps: wp.array2d[wp.float32],
        walks: wp.array2d[wp.int32],
        rise: wp.array2d[wp.float32],
        lap: wp.array2d[wp.float32],
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

        # 1. which line: side by side across the map, one set per residue of the stride
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

        # 2. nothing above yet; where the map repeats, a level ray starts with its whole cycle above it
        ceiling = floats()
        climb = floats()
        for b in range(BITS):
            ceiling[b] = NO_CEILING
            climb[b] = rise[w, b]
        if periodic != 0 and climb[0] == 0.0:
            ceiling[0] = lap[w, line]

        # 3. from x_low on, for x_span nodes, the line has not just entered the map
        x_low = wp.int32(0)
        x_span = cols
        if periodic == 0:
            x_low = wp.max(0, -i)
            x_span = cols - wp.abs(i)
        next = -(i + down * cols)
        for u in range(-warm, count, AHEAD):
            at = y * cols + x
            last_x = x - (AHEAD - 1) * i
            last_y = y - (AHEAD - 1) * down
            inside = (
                wp.uint32(x - x_low) < wp.uint32(x_span)
                and wp.uint32(last_x - x_low) < wp.uint32(x_span)
                and wp.uint32(last_y) < wp.uint32(rows)
            )
            if inside and u >= 0 and u + AHEAD <= count:
                # 4. a stretch of AHEAD nodes inside the map; an unsigned index spares Warp its test for
                # negative ones
                z = depths()
                for a in range(AHEAD):
                    z[a] = maps[turned, wp.uint32(at + a * next)]
                for a in range(AHEAD):
                    lit = wp.int32(0)
                    for b in range(BITS):
                        if z[a] <= ceiling[b]:
                            lit |= 1 << b
                        ceiling[b] = wp.min(z[a], ceiling[b]) + climb[b]
                    planes[plane, wp.uint32(at + a * next)] = wp.uint8(lit)
                x = last_x - i
                if wp.uint32(x) >= wp.uint32(cols):
                    x += turn_x
                y = last_y - down
                if wp.uint32(y) >= wp.uint32(rows):
                    y += turn_y
            else:
                for a in range(u, wp.min(u + AHEAD, count)):
                    # 5. near a side: a line whose next node towards the source lies outside the map has open
                    # sky there
                    if periodic == 0 and wp.uint32(x + i) >= wp.uint32(cols):
                        for b in range(BITS):
                            ceiling[b] = NO_CEILING
                    here = maps[turned, y * cols + x]
                    bits = wp.int32(0)
                    for b in range(BITS):
                        if here <= ceiling[b]:
                            bits |= 1 << b
                        ceiling[b] = wp.min(here, ceiling[b]) + climb[b]
                    if a >= 0:
                        planes[plane, y * cols + x] = wp.uint8(bits)
                    x -= i
                    if wp.uint32(x) >= wp.uint32(cols):
                        x += turn_x
                    y -= down
                    if wp.uint32(y) >= wp.uint32(rows):
                        y += turn_y

    return scan


@wp.func
def block_x(g: wp.int32, cols: wp.int32):
    patches = (cols + PATCH_X * COPY_SIDE - 1) // (PATCH_X * COPY_SIDE)
    patch = g // (PATCH_X * PATCH_Y)
    return ((patch % patches) * PATCH_X + g % PATCH_X) * COPY_SIDE


@wp.func
def block_y(g: wp.int32, cols: wp.int32):
    patches = (cols + PATCH_X * COPY_SIDE - 1) // (PATCH_X * COPY_SIDE)
    patch = g // (PATCH_X * PATCH_Y)
    return ((patch // patches) * PATCH_Y + g // PATCH_X % PATCH_Y) * COPY_SIDE


@wp.kernel
def turn_map(maps: wp.array2d[wp.float32], rows: wp.int32, cols: wp.int32, room: wp.int32):
    """The second of `maps`, (cols, rows), from the first, (rows, cols), so that walks along rows become walks
    along columns.

    Thread g owns COPY_SIDE x COPY_SIDE nodes; 32 neighbours own a patch of 8 x 4 such blocks, so that both
    sides of the copy stay within few cache lines.
    """
    g = wp.tid()
    x0 = block_x(g, cols)
    y0 = block_y(g, cols)
    for y in range(y0, wp.min(y0 + COPY_SIDE, rows)):
        for x in range(x0, wp.min(x0 + COPY_SIDE, cols)):
            maps[1, x * rows + y] = maps[0, y * cols + x]


@wp.kernel
def turn_planes(
    planes: wp.array2d[wp.uint8], pairs: wp.array2d[wp.int32], rows: wp.int32, cols: wp.int32, room: wp.int32
):
    """Planes of the turned map, (cols, rows), to planes of the map; the pairs (from, to) are given. Thread
    (w, g) as in turn_map.
    """
    w, g = wp.tid()
    turned = pairs[w, 0]
    plane = pairs[w, 1]
    x0 = block_x(g, cols)
    y0 = block_y(g, cols)
    for x in range(x0, wp.min(x0 + COPY_SIDE, cols)):
        for y in range(y0, wp.min(y0 + COPY_SIDE, rows)):
            planes[plane, y * cols + x] = planes[turned, x * rows + y]


@wp.kernel
def turn_planes_by_fours(
    planes: wp.array2d[wp.uint32], pairs: wp.array2d[wp.int32], rows: wp.int32, cols: wp.int32, room: wp.int32
):
    """The same where rows and cols are multiples of 4, with four bytes to a uint32."""
    w, g = wp.tid()
    turned = pairs[w, 0]
    plane = pairs[w, 1]
    x0 = block_x(g, cols)
    y0 = block_y(g, cols)
    if x0 >= cols or y0 >= rows:
        return
    column = fours()
    for x in range(4):
        column[x] = planes[turned, ((x0 + x) * rows + y0) // 4]
    for y in range(4):
        row = wp.uint32(0)
        for x in range(4):
            row |= ((column[x] >> wp.uint32(8 * y)) & wp.uint32(255)) << wp.uint32(8 * x)
        planes[plane, ((y0 + y) * cols + x0) // 4] = row


@functools.cache
def pack(BITS: int):
    """Planes of some walks -> packed visibility bits, direction d in bit d % 32 of word d // 32.

      planes  (walks, room)      uint8
      order   (walks, BITS)      int32   the direction of each bit
      words   (pixels, n_words)  uint32  in, out: bits are added, so walks may come in groups

    Thread p owns pixel p.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def pack(
        planes: wp.array2d[wp.uint8],
        order: wp.array2d[wp.int32],
        words: wp.array3d[wp.uint32],
        pixels: wp.int32,
        room: wp.int32,
        n_words: wp.int32,
        n_walks: wp.int32,
    ):
        p = wp.tid()
        cols = words.shape[1]
        y = p // cols
        x = p - y * cols
        for w in range(n_walks):
            lit = wp.uint32(planes[w, p])
            for b in range(BITS):
                d = order[w, b]
                words[y, x, d // 32] = words[y, x, d // 32] | (
                    ((lit >> wp.uint32(b)) & wp.uint32(1)) << wp.uint32(d % 32)
                )

    return pack
