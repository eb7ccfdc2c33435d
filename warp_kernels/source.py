"""Where the source shines from: dark walls, windows and lamps, by geometry, in double precision.

  depth      (rows, cols)          float32 [length]  +inf where masked
  steps      (walks, BITS, 4)      int32             i, j, k, direction number
  crossings  (n, 8)                int32             where a ray meets grid lines within one step, in order:
                                                     x, y of a node, x, y to the next node on that line, the
                                                     weights of both, when (per STEP_PARTS), parts
  spans      (walks, 2)            int32             first crossing of a walk and how many; the last one is
                                                     the lattice node itself
  numbers    (4)                   float64 [length]  x0, x1, y0, y1 of a rectangle, or x, y, z, radius of a
                                                     ball
  flags      (layers, rows, cols)  uint8             aperture (one layer) or volume
  kind                             int32             0 sky, 1 rectangle, 2 aperture, 3 ball, 4 volume
                                                     (skylamp.sources)
  sides                            int32             0 open, 1 dark, 2 periodic
  step                             float64 [length]  the spacing in the unit of depth

Every formula is one rounding per operation, so every device decides alike. Twin of opencl/source.cl.
"""

import functools

import warp as wp

from skylamp.constants import APERTURE, BALL, DARK, OPEN, PERIODIC, RECTANGLE, SKY, VOLUME

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def wrapped(value: wp.float64, period: wp.float64):
    return value - wp.floor(value / period) * period


@wp.func
def within(
    w: wp.float64, k: wp.float64, low: wp.float64, high: wp.float64, period: wp.float64, sides: wp.int32
):
    """Whether low <= w / k < high, multiplied out; where the map repeats, for some image of it."""
    if sides != PERIODIC:
        return k * low <= w and w < k * high
    return wrapped(w - k * low, k * period) < k * (high - low)


@wp.func
def leaves_box(
    x: wp.int32,
    y: wp.int32,
    z: wp.float64,
    i: wp.int32,
    j: wp.int32,
    climb: wp.float64,
    rows: wp.int32,
    cols: wp.int32,
):
    """Whether a ray through (x, y, z) crosses z = 0 inside the box of the map."""
    u = wp.float64(2.0) * (wp.float64(x) * climb + wp.float64(i) * z)
    v = wp.float64(2.0) * (wp.float64(y) * climb + wp.float64(j) * z)
    return (
        -climb <= u
        and u < wp.float64(2 * cols - 1) * climb
        and -climb <= v
        and v < wp.float64(2 * rows - 1) * climb
    )


@wp.func
def meets_plane(
    x: wp.int32,
    y: wp.int32,
    z: wp.float64,
    i: wp.int32,
    j: wp.int32,
    k: wp.int32,
    numbers: wp.array[wp.float64],
    flags: wp.array3d[wp.uint8],
    rows: wp.int32,
    cols: wp.int32,
    kind: wp.int32,
    sides: wp.int32,
    step: wp.float64,
):
    """Whether a free ray through (x, y, z) along (i, j, -k) comes from the sky or through the window."""
    if k == 0:
        return kind == SKY and sides != DARK
    climb = wp.float64(k) * step
    if sides == DARK:
        if not leaves_box(x, y, z, i, j, climb, rows, cols):
            return False
    u = wp.float64(x) * climb + wp.float64(i) * z
    v = wp.float64(y) * climb + wp.float64(j) * z
    if kind == RECTANGLE:
        k64 = wp.float64(k)
        return within(u, k64, numbers[0], numbers[1], wp.float64(cols) * step, sides) and within(
            v, k64, numbers[2], numbers[3], wp.float64(rows) * step, sides
        )
    if kind == APERTURE:
        two = wp.float64(2.0)
        col = wp.floor((two * u + climb) / (two * climb))
        row = wp.floor((two * v + climb) / (two * climb))
        if sides == PERIODIC:
            col = wrapped(col, wp.float64(cols))
            row = wrapped(row, wp.float64(rows))
        if (
            col < wp.float64(0.0)
            or col >= wp.float64(cols)
            or row < wp.float64(0.0)
            or row >= wp.float64(rows)
        ):
            return False
        return flags[0, wp.int32(row), wp.int32(col)] != wp.uint8(0)
    return True


@wp.func
def meets_ball(
    x: wp.int32,
    y: wp.int32,
    z: wp.float64,
    i: wp.int32,
    j: wp.int32,
    k: wp.int32,
    numbers: wp.array[wp.float64],
    step: wp.float64,
):
    """The step count at which a ray from (x, y, z) along (i, j, -k) first meets the closed ball; -1 if it
    does not. The discriminant b^2 - a (d.d - r^2) is a r^2 - |l x d|^2, which keeps its digits from far away.
    """
    lx = wp.float64(i) * step
    ly = wp.float64(j) * step
    lz = -(wp.float64(k) * step)
    dx = numbers[0] - wp.float64(x) * step
    dy = numbers[1] - wp.float64(y) * step
    dz = numbers[2] - z
    a = lx * lx + ly * ly + lz * lz
    b = dx * lx + dy * ly + dz * lz
    q = dx * dx + dy * dy + dz * dz - numbers[3] * numbers[3]
    if q <= wp.float64(0.0):
        return wp.float64(0.0)
    cx = ly * dz - lz * dy
    cy = lz * dx - lx * dz
    cz = lx * dy - ly * dx
    root = a * (numbers[3] * numbers[3]) - (cx * cx + cy * cy + cz * cz)
    if b > wp.float64(0.0) and root >= wp.float64(0.0):
        return (b - wp.sqrt(root)) / a
    return wp.float64(-1.0)


@wp.func
def wrapped_index(index: wp.int64, period: wp.int32):
    p = wp.int64(period)
    return wp.int32((index % p + p) % p)


@wp.func
def on_map(x: wp.int64, y: wp.int64, rows: wp.int32, cols: wp.int32):
    return x >= wp.int64(0) and x < wp.int64(cols) and y >= wp.int64(0) and y < wp.int64(rows)


@wp.func
def meets_lamp(
    depth: wp.array2d[wp.float32],
    x: wp.int32,
    y: wp.int32,
    z: wp.float64,
    i: wp.int32,
    j: wp.int32,
    k: wp.int32,
    crossings: wp.array2d[wp.int32],
    first: wp.int32,
    n_crossings: wp.int32,
    numbers: wp.array[wp.float64],
    flags: wp.array3d[wp.uint8],
    rows: wp.int32,
    cols: wp.int32,
    layers: wp.int32,
    kind: wp.int32,
    sides: wp.int32,
    step: wp.float64,
):
    """Whether the lamp is visible from (x, y, z) along the step: the ray meets it, and neither ground nor
    wall comes before.
    """
    hit = wp.float64(wp.inf)
    climb = wp.float64(k) * step
    level = wp.int64(wp.rint(z / step))
    if kind == BALL:
        hit = meets_ball(x, y, z, i, j, k, numbers, step)
        if hit < wp.float64(0.0):
            return False
        if sides == DARK:
            if k > 0 and z <= hit * climb:
                if not leaves_box(x, y, z, i, j, climb, rows, cols):
                    return False
            else:
                px = wp.float64(x) + hit * wp.float64(i)
                py = wp.float64(y) + hit * wp.float64(j)
                half = wp.float64(0.5)
                if px < -half or px >= wp.float64(cols) - half or py < -half or py >= wp.float64(rows) - half:
                    return False
        if i == 0 and j == 0:
            return True  # straight up nothing is in the way, however deep the node lies
    else:
        if level < wp.int64(layers):
            if flags[wp.int32(level), y, x] != wp.uint8(0):
                return True
    t = wp.int64(0)
    while True:
        for c in range(first, first + n_crossings):
            parts = wp.float64(crossings[c, 7])
            when = wp.float64(t) * parts + wp.float64(crossings[c, 6])
            if kind == BALL and when >= hit * parts:
                return True
            over = z * parts - when * climb  # the ray's depth x parts
            if kind == BALL:
                if over < wp.float64(0.0):
                    return True
            else:
                if over < wp.float64(-0.5) * step * parts:
                    return False
            cx = wp.int64(x) + t * wp.int64(i) + wp.int64(crossings[c, 0])
            cy = wp.int64(y) + t * wp.int64(j) + wp.int64(crossings[c, 1])
            ex = cx + wp.int64(crossings[c, 2])
            ey = cy + wp.int64(crossings[c, 3])
            if sides == PERIODIC:
                cx = wp.int64(wrapped_index(cx, cols))
                cy = wp.int64(wrapped_index(cy, rows))
                ex = wp.int64(wrapped_index(ex, cols))
                ey = wp.int64(wrapped_index(ey, rows))
            near_in = on_map(cx, cy, rows, cols)
            far_in = on_map(ex, ey, rows, cols)
            if not near_in and not far_in and c == first + n_crossings - 1:
                return kind == BALL  # past the side of the map nothing stands in the way
            if near_in and (crossings[c, 5] == 0 or far_in):
                near = depth[wp.int32(cy), wp.int32(cx)]
                far = near
                if crossings[c, 5] != 0:
                    far = depth[wp.int32(ey), wp.int32(ex)]
                if near < wp.inf and far < wp.inf:
                    if (
                        wp.float64(crossings[c, 4]) * wp.float64(near)
                        + wp.float64(crossings[c, 5]) * wp.float64(far)
                        < over
                    ):
                        return False
            if kind == VOLUME:
                # of two nodes as near, that farther along the ray: else a lamp is off to one side
                nx = cx
                ny = cy
                ahead = i * crossings[c, 2] + j * crossings[c, 3] > 0
                if 2 * crossings[c, 5] > crossings[c, 7] or (
                    ahead and 2 * crossings[c, 5] == crossings[c, 7]
                ):
                    nx = ex
                    ny = ey
                two = wp.float64(2.0)
                n = wp.int64(
                    wp.floor(
                        (two * (wp.float64(level) * parts - when * wp.float64(k)) + parts) / (two * parts)
                    )
                )
                if n >= wp.int64(0) and n < wp.int64(layers) and on_map(nx, ny, rows, cols):
                    if flags[wp.int32(n), wp.int32(ny), wp.int32(nx)] != wp.uint8(0):
                        return True
            if k == 0 and c == first + n_crossings - 1 and cx == wp.int64(x) and cy == wp.int64(y):
                return False  # a level ray on a map that repeats has come round
        t += wp.int64(1)


@functools.cache
def clip(BITS: int):
    """Clears the bits of surface nodes whose unblocked rays do not come from the sky, window or lamp, and
    with a lamp sets those that only something beyond the lamp blocks. planes (walks, room) uint8, in, out.
    Thread p owns pixel p.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def clip(
        depth: wp.array2d[wp.float32],
        steps: wp.array3d[wp.int32],
        crossings: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
        numbers: wp.array[wp.float64],
        flags: wp.array3d[wp.uint8],
        planes: wp.array2d[wp.uint8],
        rows: wp.int32,
        cols: wp.int32,
        room: wp.int32,
        layers: wp.int32,
        kind: wp.int32,
        sides: wp.int32,
        step: wp.float64,
        n_walks: wp.int32,
    ):
        p = wp.tid()
        y = p // cols
        x = p - y * cols
        if depth[y, x] == wp.inf:
            return
        z = wp.float64(depth[y, x])
        for w in range(n_walks):
            lit = wp.int32(planes[w, p])
            for b in range(wp.static(BITS)):
                i = steps[w, b, 0]
                j = steps[w, b, 1]
                k = steps[w, b, 2]
                was = (lit & (1 << b)) != 0
                on = wp.bool(False)
                if kind == BALL and was and sides == OPEN:
                    on = meets_ball(x, y, z, i, j, k, numbers, step) >= wp.float64(0.0)
                elif kind >= BALL:
                    on = meets_lamp(
                        depth,
                        x,
                        y,
                        z,
                        i,
                        j,
                        k,
                        crossings,
                        spans[w, 0],
                        spans[w, 1],
                        numbers,
                        flags,
                        rows,
                        cols,
                        layers,
                        kind,
                        sides,
                        step,
                    )
                elif was:
                    on = meets_plane(x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, step)
                if on:
                    lit |= 1 << b
                else:
                    lit &= ~(1 << b)
            planes[w, p] = wp.uint8(lit)

    return clip


@wp.kernel
def enter(
    steps: wp.array2d[wp.int32],
    numbers: wp.array[wp.float64],
    flags: wp.array3d[wp.uint8],
    field: wp.array4d[wp.uint32],
    rows: wp.int32,
    cols: wp.int32,
    reach: wp.int32,
    n_words: wp.int32,
    n_directions: wp.int32,
    kind: wp.int32,
    sides: wp.int32,
):
    """The field outside the volume. Nodes of layer n < 0, and of the rim of `reach` nodes around layer n >=
    0, get the bits of the rays that come from the sky or through the window; lamps do not use it.

      field  (layers + reach, words, rows + 2 reach, cols + 2 reach) uint32  out; layer n stands at n + reach

    Thread (n, Y, X) owns a node of the layer with its rim, for all directions.
    """
    layer, Y, X = wp.tid()
    x = X - reach
    y = Y - reach
    n = layer - reach
    if n >= 0 and x >= 0 and x < cols and y >= 0 and y < rows:
        return
    for word in range(n_words):
        lit = wp.uint32(0)
        if not (sides == DARK and n >= 0):
            for d in range(32 * word, wp.min(32 * word + 32, n_directions)):
                if meets_plane(
                    x,
                    y,
                    wp.float64(n),
                    steps[d, 0],
                    steps[d, 1],
                    steps[d, 2],
                    numbers,
                    flags,
                    rows,
                    cols,
                    kind,
                    sides,
                    wp.float64(1.0),
                ):
                    lit |= wp.uint32(1) << wp.uint32(d % 32)
        field[layer, word, Y, X] = lit


@wp.kernel
def beam(
    depth: wp.array2d[wp.float32],
    steps: wp.array2d[wp.int32],
    crossings: wp.array2d[wp.int32],
    spans: wp.array2d[wp.int32],
    numbers: wp.array[wp.float64],
    flags: wp.array3d[wp.uint8],
    field: wp.array4d[wp.uint32],
    rows: wp.int32,
    cols: wp.int32,
    layers: wp.int32,
    kind: wp.int32,
    sides: wp.int32,
    n_words: wp.int32,
    n_directions: wp.int32,
    field_layers: wp.int32,
):
    """The field of a lamp, node by node. field (layers, words, rows, cols) uint32, out. Thread (n, p) owns
    node p of layer n.
    """
    n, p = wp.tid()
    y = p // cols
    x = p - y * cols
    for word in range(n_words):
        lit = wp.uint32(0)
        if wp.float32(n) <= depth[y, x]:
            for d in range(32 * word, wp.min(32 * word + 32, n_directions)):
                if meets_lamp(
                    depth,
                    x,
                    y,
                    wp.float64(n),
                    steps[d, 0],
                    steps[d, 1],
                    steps[d, 2],
                    crossings,
                    spans[d, 0],
                    spans[d, 1],
                    numbers,
                    flags,
                    rows,
                    cols,
                    layers,
                    kind,
                    sides,
                    wp.float64(1.0),
                ):
                    lit |= wp.uint32(1) << wp.uint32(d % 32)
        field[n, word, y, x] = lit
