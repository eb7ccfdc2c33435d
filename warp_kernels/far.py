"""Horizons of ground far from a tile, from overviews of the whole map. Twin of opencl/far.cl."""

import warp as wp

from skylamp.constants import HIGHEST_MASKED, NONE

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def overview(
    cells: wp.array[wp.float32],
    levels: wp.array2d[wp.int32],
    level: wp.int32,
    x0: wp.int32,
    y0: wp.int32,
    x: wp.float32,
    y: wp.float32,
):
    rows = levels[level, 3]
    cols = levels[level, 4]
    f = levels[level, 5]
    size = 1 << f
    one = wp.float32(1.0)
    reciprocal = one / wp.float32(size)
    half_cell = wp.float32(0.5) * wp.float32(size - 1)
    u = (wp.float32(x0 & (size - 1)) - half_cell + x) * reciprocal
    v = (wp.float32(y0 & (size - 1)) - half_cell + y) * reciprocal
    left = wp.floor(u)
    upper = wp.floor(v)
    b = u - left
    a = v - upper
    q = (x0 >> f) + wp.int32(left) - levels[level, 2]
    r = (y0 >> f) + wp.int32(upper) - levels[level, 1]
    q0 = wp.clamp(q, 0, cols - 1)
    q1 = wp.clamp(q + 1, 0, cols - 1)
    r0 = levels[level, 0] + wp.clamp(r, 0, rows - 1) * cols
    r1 = levels[level, 0] + wp.clamp(r + 1, 0, rows - 1) * cols
    h00 = cells[r0 + q0]
    h01 = cells[r0 + q1]
    h10 = cells[r1 + q0]
    h11 = cells[r1 + q1]
    if wp.min(wp.min(h00, h01), wp.min(h10, h11)) > HIGHEST_MASKED:
        high = h00 + b * (h01 - h00)
        low = h10 + b * (h11 - h10)
        return high + a * (low - high)
    zero = wp.float32(0.0)
    w00 = wp.where(h00 > HIGHEST_MASKED, (one - a) * (one - b), zero)
    w01 = wp.where(h01 > HIGHEST_MASKED, (one - a) * b, zero)
    w10 = wp.where(h10 > HIGHEST_MASKED, a * (one - b), zero)
    w11 = wp.where(h11 > HIGHEST_MASKED, a * b, zero)
    all = w00 + w01 + w10 + w11
    if all > zero:
        return (w00 * h00 + w01 * h01 + w10 * h10 + w11 * h11) / all
    return wp.float32(NONE)


@wp.kernel
def march(
    cells: wp.array[wp.float32],
    levels: wp.array2d[wp.int32],
    steps: wp.array2d[wp.float32],
    level_of: wp.array[wp.int32],
    azimuths: wp.array2d[wp.float32],
    own: wp.array[wp.float32],
    at_row: wp.array[wp.int32],
    at_col: wp.array[wp.int32],
    lines: wp.array3d[wp.float32],
    n_steps: wp.int32,
    count: wp.int32,
    nodes: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    highest: wp.float32,
    drop: wp.float32,
    periodic: wp.int32,
):
    """The far horizon at some nodes, as a line in the node's height: slope = lines[0] - height x
    lines[1]. Of all samples of the overviews along the azimuth's ray it is the one that stands highest,
    (sample - own height) / distance - drop x distance.

    Arguments as in opencl/far.cl. Thread (k, p) owns node p of azimuth k.
    """
    k, p = wp.tid()
    x0 = at_col[p]
    y0 = at_row[p]
    dx = azimuths[k, 0]
    dy = azimuths[k, 1]
    h = own[p]
    first_x = wp.float32(-x0)
    last_x = wp.float32(cols - 1 - x0)
    first_y = wp.float32(-y0)
    last_y = wp.float32(rows - 1 - y0)
    best = wp.float32(NONE)
    inverse = wp.float32(0.0)
    for s in range(n_steps):
        distance = steps[s, 0]
        reciprocal = steps[s, 1]
        x = dx * distance
        y = dy * distance
        if (highest - h) * reciprocal <= best:
            break
        if periodic == 0 and (x < first_x or x > last_x or y < first_y or y > last_y):
            break
        ground = overview(cells, levels, level_of[s], x0, y0, x, y)
        slope = wp.float32(NONE)
        if ground > HIGHEST_MASKED:
            slope = (ground - h) * reciprocal - drop * distance
        if slope > best:
            best = slope
            inverse = reciprocal
    if best > HIGHEST_MASKED:
        best = best + h * inverse
    else:
        best = wp.float32(NONE)
    lines[0, k, p] = best
    lines[1, k, p] = inverse


@wp.func
def between(low: wp.float32, high: wp.float32, part: wp.float32, linearly: wp.bool):
    """Between two values, linearly; or the nearer one."""
    if linearly:
        return low + part * (high - low)
    if part < wp.float32(0.5):
        return low
    return high


@wp.kernel
def interpolate(
    lines: wp.array3d[wp.float32],
    heights: wp.array[wp.float32],
    planes: wp.array2d[wp.float32],
    count: wp.int32,
    nodes: wp.int32,
    spread: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    stride_along: wp.int32,
    stride_across: wp.int32,
    before_along: wp.int32,
    before_across: wp.int32,
    along: wp.int32,
    across: wp.int32,
    last_along: wp.int32,
    last_across: wp.int32,
    run: wp.int32,
):
    """Far horizons at every node of a map in the order of sweeps, from four nodes of `march` around it, for
    the node's own height. Where one of them sees no far ground, the nearest one's.

    Arguments as in opencl/far.cl. Thread (k, y, i) owns nodes i run .. (i + 1) run - 1 of row y, azimuth k.
    """
    k, y, i = wp.tid()
    v = y - before_across
    zero = wp.float32(0.0)
    none = wp.float32(NONE)
    r = v / spread
    down = wp.min(spread, last_across - r * spread)
    a = zero
    if down > 0:
        a = wp.float32(v - r * spread) / wp.float32(down)
    row = (y + margin) * (cols + 2 * margin) + margin
    for x in range(i * run, wp.min((i + 1) * run, cols)):
        own = heights[row + x]
        slope = none
        if v >= 0 and v < across and x >= before_along and x < before_along + along and own > HIGHEST_MASKED:
            q = (x - before_along) / spread
            first = before_along + q * spread
            to_right = wp.min(spread, last_along - q * spread)
            corner = r * stride_across + q * stride_along
            right = corner + stride_along
            below = corner + stride_across
            other = right + stride_across
            whole = (
                wp.min(
                    wp.min(lines[0, k, corner], lines[0, k, right]),
                    wp.min(lines[0, k, below], lines[0, k, other]),
                )
                > HIGHEST_MASKED
            )
            part = zero
            if to_right > 0:
                part = wp.float32(1.0) / wp.float32(to_right)
            b = wp.float32(x - first) * part
            slope = between(
                between(lines[0, k, corner], lines[0, k, below], a, whole),
                between(lines[0, k, right], lines[0, k, other], a, whole),
                b,
                whole,
            )
            slope -= own * between(
                between(lines[1, k, corner], lines[1, k, below], a, whole),
                between(lines[1, k, right], lines[1, k, other], a, whole),
                b,
                whole,
            )
        planes[k, y * cols + x] = slope
