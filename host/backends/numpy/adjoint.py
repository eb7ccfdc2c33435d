"""The kernels of adjoint.cl in NumPy: same names, arguments and bits, on all nodes at a time."""

from __future__ import annotations

import numpy as np

from ... import constants
from ...constants import (
    ALPHA,
    BESIDE,
    DAMPING,
    DARK,
    FOUR,
    GAIN,
    LAMBDA,
    LEAST,
    LEFT,
    OPEN,
    PERIODIC,
    PRODUCT,
    SCATTERED,
    START,
    SUMMED,
    UNIT_RV,
    UNIT_VV,
)

f32 = np.float32
NONE, STEEP, LEVEL, ALONG, SLACK, PI, HALF_PI, TWO_PI = map(
    f32,
    (
        constants.NONE,
        constants.STEEP,
        constants.LEVEL,
        constants.ALONG,
        constants.SLACK,
        constants.PI,
        constants.HALF_PI,
        constants.TWO_PI,
    ),
)
ARC_TANGENT = [f32(factor) for factor in constants.ARC_TANGENT]


def _arc_tangent(v):
    r = np.where(v > 1, 1 / v, v)
    q = r * r
    p = np.full_like(v, ARC_TANGENT[0])
    for factor in ARC_TANGENT[1:]:
        p = p * q + factor
    return np.where(v > 1, HALF_PI - p * r, p * r)


def _above(t, table, row, after, share, knots):
    """c1, c2, d1, d2 as there; row, after, share: numbers or one per node."""
    square = 1 + t * t
    cosine = 1 / square
    if knots == 0:
        return (
            f32(0.5) * cosine,
            f32(0.5) * (HALF_PI - _arc_tangent(t) - t * cosine),
            -t * cosine * cosine,
            -cosine * cosine,
        )
    root = np.sqrt(square)
    place = t / root * f32(knots - 1)
    per = f32(knots - 1) / (square * root)
    knot = np.minimum(place.astype(np.int32), knots - 2)
    part = place - knot.astype(f32)
    v = table[row, knot]
    if np.ndim(share):
        v = np.where((share > 0)[:, None], v + share[:, None] * (table[after, knot] - v), v)
    return v[:, 1] + part * v[:, 3], v[:, 0] + part * v[:, 2], v[:, 3] * per, v[:, 2] * per


def _over(a, b):
    """a / b in float32, 0 where b is 0."""
    return np.where(b != 0, a / np.where(b != 0, b, f32(1)), f32(0)).astype(f32)


def _horizon(heights, ways, x, y, own, best, top, reach, rows, cols, margin, sides):
    """Slope and crossing number for nodes (n,); ``ways``: (c, s, columns, rise, rows, run), numbers or one
    per node.
    """
    c, s, columns, rise, per_column, run = (np.broadcast_to(part, own.shape) for part in ways)
    padded = heights.reshape(rows, cols + 2 * margin)
    best, number = best.copy(), np.zeros(own.shape, np.int32)
    for on_rows, length, shear in ((True, rise, columns), (False, run, per_column)):
        ahead = (s if on_rows else c) > 0
        place, size = (y, rows) if on_rows else (x, cols)
        last = np.where(ahead, size - 1 - place, place)
        if sides == PERIODIC:
            last = np.full(own.shape, 1 << 20)
        last = np.where((s if on_rows else c) == 0, 0, last)
        left, n = np.flatnonzero(last > 0), 0
        while len(left):
            n += 1
            closeness = length[left] / f32(n)
            going = (
                (n <= last[left])
                & ~(reach[left] * closeness < 1)
                & ~((top - own[left]) * (SLACK * closeness) <= best[left])
            )
            left, closeness = left[going], closeness[going]
            across = f32(n) * shear[left]
            low = np.floor(across)
            share, low = across - low, low.astype(np.int32)
            step = np.where(ahead[left], n, -n)
            column, row = (x[left] + low, y[left] + step) if on_rows else (x[left] + step, y[left] + low)
            if sides == PERIODIC:
                column, row = column % cols, row % rows
            over = row if on_rows else row + 1
            if sides == PERIODIC:
                over = over % rows
                there = np.ones(len(left), bool)
            elif on_rows:
                there = (column < cols) & (column + 1 >= 0)
            else:
                there = (row >= 0) & (row < rows) & ~((over >= rows) & (share > 0))
                over = np.minimum(over, rows - 1)
            left, closeness, share, column, row, over = (
                v[there] for v in (left, closeness, share, column, row, over)
            )
            a = padded[row, margin + column]
            b = padded[over, margin + column + on_rows]
            slope = (a + share * (b - a) - own[left]) * closeness
            higher = slope > best[left]
            best[left[higher]] = slope[higher]
            number[left[higher]] = n if on_rows else -n
    return best, number


def _wall(ways, x, y, rows, cols):
    c, s, _, rise, _, run = ways
    half = f32(0.5)
    to_x = np.where(c > 0, f32(cols) - half - x.astype(f32), x.astype(f32) + half)
    to_y = np.where(s > 0, f32(rows) - half - y.astype(f32), y.astype(f32) + half)
    return np.minimum(
        np.where(c != 0, to_x / run, f32(1e30)), np.where(s != 0, to_y / rise, f32(1e30))
    ).astype(f32)


def _ways(c, s):
    c, s = (np.where(np.abs(part) > ALONG, part, f32(0)) for part in (c, s))
    across, along = np.abs(c), np.abs(s)
    return c, s, _over(c, along), along, _over(s, across), across


def _note(links, some, ways, number, x, y, rows, cols, sides, per_slope, inverse):
    """Notes the crossings ``number`` of the nodes ``some`` as links, and gives their pulls."""
    held, first, second, near, far = links
    c, s, columns, rise, per_column, run = (np.broadcast_to(way, held.shape)[some] for way in ways)
    number = number[some]
    on_row, n = number > 0, np.abs(number)
    count = n.astype(f32)
    place = count * np.where(on_row, columns, per_column)
    low = np.floor(place).astype(np.int32)
    column = x[some] + np.where(on_row, low, np.where(c > 0, n, -n))
    row = y[some] + np.where(on_row, np.where(s > 0, n, -n), low)
    if sides == PERIODIC:
        column, row = column % cols, row % rows
    pull = per_slope[some] * (np.where(on_row, rise, run) / count)
    whole, share, e = (
        -pull * inverse[some],
        place - low.astype(f32),
        (some // BESIDE, held[some], some % BESIDE),
    )
    first[e] = row * cols + column
    second[e] = np.where(on_row, row * cols + (column + 1) % cols, (row + 1) % rows * cols + column)
    near[e], far[e] = whole - whole * share, whole * share
    held[some] += 1
    return pull


def surface(z, heights, tilts, top, rows, cols, margin, sides):
    z = z.reshape(rows, cols)
    padded = heights.reshape(rows, cols + 2 * margin)
    padded[:, margin : margin + cols] = -z
    if sides == PERIODIC:
        padded[:] = -z[:, np.arange(-margin, cols + margin) % cols]
    for out, v in ((tilts[0].reshape(rows, cols), z), (tilts[1].reshape(rows, cols).T, z.T)):
        i = np.arange(v.shape[1])
        low, high = np.maximum(i - 1, 0), np.minimum(i + 1, v.shape[1] - 1)
        out[...] = (v[:, high] - v[:, low]) / np.maximum(high - low, 1).astype(f32)


def tiles(z, tiles, top, rows, cols):
    high = np.float32(-z.min())
    tiles[:] = high  # the same in every tile: here nothing is skipped by them
    bits = high.view(np.int32)
    top[0] = bits ^ 0x7FFFFFFF if bits < 0 else bits


def _highest(top):
    return (top[:1] ^ 0x7FFFFFFF if top[0] < 0 else top[:1]).view(np.float32)[0]


def _finish(light, gx, gy, inverse, total, by_own, by_x, by_y):
    drop = total * inverse * inverse * inverse
    light[:] = total * inverse, by_own * inverse, by_x * inverse - drop * gx, by_y * inverse - drop * gy


def _limits(azimuth, own, gx, gy, x, y, rows, cols, sides):
    """(way, slope along it, what limits it before the ground does, derivative of that by the own depth if it
    is the wall).
    """
    c, s, _, _ = azimuth
    ways = _ways(c, s)
    tilt = gx * c + gy * s
    slope, by_wall = np.maximum(-tilt, f32(0)), f32(0)
    if sides == DARK:
        closeness = 1 / _wall(ways, x, y, rows, cols)
        wall = -own * closeness
        by_wall = np.where(wall > slope, closeness, f32(0))
        slope = np.maximum(wall, slope)
    return ways, tilt, slope, by_wall


def look(heights, tilts, tiles, top, azimuths, numbers, slopes, rows, cols, margin, count, sides, ways):
    y, x = (v.ravel() for v in np.indices((rows, cols)))
    own = heights.reshape(rows, cols + 2 * margin)[:, margin : margin + cols].ravel()
    reach = np.full(own.shape, 1e30, f32)
    for k in range(count):
        way, _, slope, _ = _limits(azimuths[k], own, *tilts, x, y, rows, cols, sides)
        least = np.maximum(slope, LEVEL) if sides == PERIODIC else slope
        slopes[k, : own.size], numbers[k, : own.size] = _horizon(
            heights, way, x, y, own, least, _highest(top), reach, rows, cols, margin, sides
        )


def sky(
    heights,
    tilts,
    top,
    numbers,
    slopes,
    azimuths,
    table,
    light,
    held,
    first,
    second,
    near,
    far,
    rows,
    cols,
    margin,
    count,
    knots,
    sides,
):
    y, x = (v.ravel() for v in np.indices((rows, cols)))
    own = heights.reshape(rows, cols + 2 * margin)[:, margin : margin + cols].ravel()
    gx, gy = tilts
    total, by_own, by_x, by_y = (np.zeros(own.shape, f32) for _ in range(4))
    inverse = 1 / np.sqrt(1 + gx * gx + gy * gy)
    held[:] = 0
    for k in range(count):
        c, s, width, _ = azimuths[k]
        ways, tilt, slope, by_wall = _limits(azimuths[k], own, gx, gy, x, y, rows, cols, sides)
        number = numbers[k, : own.size]
        slope = np.where(number != 0, slopes[k, : own.size], slope)
        c1, c2, d1, d2 = _above(slope, table, k, k, 0, knots)
        per_slope = width * (d1 + tilt * d2)
        total += width * (c1 + tilt * c2)
        by = per_slope * by_wall
        some = np.flatnonzero(number)
        by[some] = _note(
            (held, first, second, near, far), some, ways, number, x, y, rows, cols, sides, per_slope, inverse
        )
        by_own += by
        by_x += width * c * c2
        by_y += width * s * c2
    _finish(light, gx, gy, inverse, total, by_own, by_x, by_y)


def lamp(
    heights,
    tilts,
    tiles,
    top,
    frames,
    nodes,
    solid,
    table,
    light,
    held,
    first,
    second,
    near,
    far,
    rows,
    cols,
    margin,
    count,
    knots,
    n_rows,
    ball,
    sides,
):
    y, x = (v.ravel() for v in np.indices((rows, cols)))
    own = heights.reshape(rows, cols + 2 * margin)[:, margin : margin + cols].ravel()
    gx, gy = tilts
    ux, uy, extent, _ = frames.T
    zero = np.zeros(own.shape, f32)
    total, by_own, by_x, by_y = (zero.copy() for _ in range(4))
    inverse = 1 / np.sqrt(1 + gx * gx + gy * gy)
    held[:] = 0
    for k in range(count):
        # 1. the slice, and the slopes between which the source stands in it, with their derivatives by the
        # own depth
        sine, cosine, c, s = nodes[k]
        width = TWO_PI / f32(count)
        if ball:
            radius, rise = solid[3], solid[2] - own
            beyond = extent * extent + rise * rise - radius * radius
            around = extent <= radius
            off = extent * (s * ux - c * uy)
            along, half = extent * (c * ux + s * uy), np.sqrt(np.maximum(radius * radius - off * off, f32(0)))
            off = radius / extent * sine
            on = np.sqrt((1 - off) * (1 + off))
            c, s = np.where(around, c, ux * on - uy * off), np.where(around, s, uy * on + ux * off)
            width = np.where(around, width, radius / extent * cosine * (PI / f32(count)) / on)
            along, half = np.where(around, along, extent * on), np.where(around, half, radius * cosine)
            reach, end = np.maximum(along, half), along + half
            inside = beyond <= 0
            tangent, square = np.sqrt(beyond), along * along + rise * rise
            low_c, low_s = along * tangent + rise * half, rise * tangent - along * half
            high_c, high_s = along * tangent - rise * half, rise * tangent + along * half
            low = np.where(
                inside, -STEEP, np.where(low_c > 0, low_s / low_c, np.where(low_s > 0, STEEP, -STEEP))
            )
            high = np.where(
                inside, STEEP, np.where(high_c > 0, high_s / high_c, np.where(rise > 0, STEEP, -STEEP))
            )
            low_by = np.where(~inside & (low_c > 0), square / (low_c * tangent), f32(0))
            high_by = np.where(~inside & (high_c > 0), square / (high_c * tangent), f32(0))
        else:
            t = extent * (f32(2 * k + 1) / f32(count) - 1)
            scale = 1 / (1 + t * t)
            on, off, aside = (1 - t * t) * scale, 2 * t * scale, extent > 0
            c, s = np.where(aside, ux * on - uy * off, c), np.where(aside, uy * on + ux * off, s)
            width = np.where(aside, 4 * extent / f32(count) * scale, width)
            least, most, least_by, most_by, reach = zero + STEEP, zero - STEEP, zero, zero, zero
            met = np.zeros(own.shape, int)
            for i in range(4):
                j = (i + 1) % 4
                (px, py, pz), (qx, qy, qz) = solid[3 * i : 3 * i + 3], solid[3 * j : 3 * j + 3]
                ax, ay, bx, by = (
                    px - x.astype(f32),
                    py - y.astype(f32),
                    qx - x.astype(f32),
                    qy - y.astype(f32),
                )
                start, stop = c * ay - s * ax, c * by - s * bx
                share = start / (start - stop)
                r = c * (ax + share * (bx - ax)) + s * (ay + share * (by - ay))
                meets = ((start <= 0) != (stop <= 0)) & (r > 0)
                slant = (pz + share * (qz - pz) - own) / r
                under, over = meets & (slant < least), meets & (slant > most)
                least, least_by = np.where(under, slant, least), np.where(under, 1 / r, least_by)
                most, most_by = np.where(over, slant, most), np.where(over, 1 / r, most_by)
                reach = np.where(meets, np.maximum(r, reach), reach)
                met += meets
            zenith = (met == 1) & (least > 0)
            most, most_by, end = np.where(zenith, STEEP, most), np.where(zenith, f32(0), most_by), reach
            some = met > 0
            low, high = np.where(some, least, f32(1)), np.where(some, most, f32(0))
            low_by, high_by = np.where(some, least_by, f32(0)), np.where(some, most_by, f32(0))

        # 2. what limits it from below
        ways = _ways(c, s)
        tilt = gx * c + gy * s
        slope, by_limit = np.maximum(-tilt, f32(0)), zero
        if sides == DARK:
            wall = _wall(ways, x, y, rows, cols)
            closeness = 1 / wall
            limits = (end > wall) & (-own * closeness > slope)
            slope, by_limit = np.where(limits, -own * closeness, slope), np.where(limits, closeness, by_limit)
        limits = low > slope
        slope, by_limit = np.where(limits, low, slope), np.where(limits, low_by, by_limit)
        on = np.flatnonzero(slope < high)
        number = np.zeros(own.shape, np.int32)
        slope[on], number[on] = _horizon(
            heights,
            tuple(np.broadcast_to(way, own.shape)[on] for way in ways),
            x[on],
            y[on],
            own[on],
            slope[on],
            _highest(top),
            np.broadcast_to(reach, own.shape)[on],
            rows,
            cols,
            margin,
            OPEN,
        )

        # 3. the light between
        lit = slope < high
        number = np.where(lit, number, 0)
        down, left = s < 0, c < 0
        diamond = np.where(
            ~down,
            np.where(~left, s / (c + s), 1 - c / (s - c)),
            np.where(left, 2 - s / (-c - s), 3 + c / (c - s)),
        )
        place = f32(0.25) * diamond * f32(n_rows)
        row = np.minimum(place.astype(np.int32), n_rows - 1)
        after = np.where(row + 1 < n_rows, row + 1, 0)
        share = place - row.astype(f32)
        c1, c2, d1, d2 = _above(np.where(lit, slope, f32(0)), table, row, after, share, knots)
        per_slope = width * (d1 + tilt * d2)
        cut = lit & (high < STEEP)
        o1, o2, e1, e2 = _above(np.where(cut, high, f32(0)), table, row, after, share, knots)
        c1, c2 = np.where(cut, c1 - o1, c1), np.where(cut, c2 - o2, c2)
        by_own = np.where(cut, by_own - width * (e1 + tilt * e2) * high_by, by_own)
        by = per_slope * by_limit
        some = np.flatnonzero(number)
        by[some] = _note(
            (held, first, second, near, far), some, ways, number, x, y, rows, cols, OPEN, per_slope, inverse
        )
        total = np.where(lit, total + width * (c1 + tilt * c2), total)
        by_own = np.where(lit, by_own + by, by_own)
        by_x = np.where(lit, by_x + width * c * c2, by_x)
        by_y = np.where(lit, by_y + width * s * c2, by_y)
    _finish(light, gx, gy, inverse, total, by_own, by_x, by_y)


def _neighbours(light, rows, cols):
    """For the derivatives along x and y: by them, node after, node before, 1 over their distance."""
    y, x = (v.ravel() for v in np.indices((rows, cols)))
    for by, i, size, step in ((light[2], x, cols, 1), (light[3], y, rows, cols)):
        if size > 1:
            here = y * cols + x
            yield (
                by,
                here + step * (i < size - 1),
                here - step * (i > 0),
                np.where((i > 0) & (i < size - 1), f32(0.5), f32(1)),
            )


def _links(held, *arrays):
    """The nodes that have a k-th link, and what the arrays tell of it, for every k."""
    for k in range(held.max()):
        some = np.flatnonzero(held > k)
        yield some, *(array[some // BESIDE, k, some % BESIDE] for array in arrays)


def _change(light, held, first, second, near, far, v, rows, cols):
    total = light[1] * v
    for by, after, before, half in _neighbours(light, rows, cols):
        total += by * ((v[after] - v[before]) * half)
    for some, one, two, by_one, by_two in _links(held, first, second, near, far):
        total[some] += by_one * v[one] + by_two * v[two]
    return total


def _spread(light, held, first, second, near, far, sum, u, squared, rows, cols):
    def add(to, part, u):
        np.add.at(sum, to, ((part * part if squared else part) * u).astype(np.int64))

    add(np.arange(rows * cols), light[1], u)
    for by, after, before, half in _neighbours(light, rows, cols):
        add(after, by * half, u)
        add(before, -(by * half), u)
    for some, one, two, by_one, by_two in _links(held, first, second, near, far):
        add(one, by_one, u[some])
        add(two, by_two, u[some])


def _by_blocks(values):
    """Sums of SUMMED values each, added one after another."""
    padded = np.zeros(-(-len(values) // SUMMED) * SUMMED)
    padded[: len(values)] = values
    return np.cumsum(padded.reshape(-1, SUMMED), 1)[:, -1]


def _put(part, block, values):
    sums = _by_blocks(values)
    part.reshape(-1)[block : block + len(sums)] = sums


def match(light, gain, target, over, under, is_first, pixels):
    e = gain * light[0]
    over[:] = (f32(0) if is_first else over) + e * target
    under[:] = (f32(0) if is_first else under) + e * e


def reflect(over, under, gain, out, pixels):
    out[:] = over / under * gain


def misfit(light, gain, target, part, block, pixels):
    _put(part, block, (gain * light[0] - target).astype(np.float64) ** 2)


def _bend(v):
    """Second differences along rows of v, 0 at the ends."""
    out = np.zeros_like(v)
    if v.shape[1] > 2:
        out[:, 1:-1] = (v[:, :-2] - v[:, 1:-1]) - (v[:, 1:-1] - v[:, 2:])
    return out


def _unbend(v, rows, cols):
    v, total = v.reshape(rows, cols), None
    for z in (v, v.T):
        bent = _bend(z)
        out = f32(-2) * bent
        out[:, 2:] += bent[:, 1:-1]
        out[:, :-2] += bent[:, 1:-1]
        total = out if total is None else total + out.T
    return total.ravel()


def bending(z, rest, part, block, rows, cols):
    z, rest = z.reshape(rows, cols), rest.reshape(rows, cols)
    a, b = (v.ravel().astype(np.float64) for v in (_bend(z) - _bend(rest), (_bend(z.T) - _bend(rest.T)).T))
    _put(part, block, a * a + b * b)


def downhill(
    light,
    held,
    first,
    second,
    near,
    far,
    gain,
    target,
    sum,
    squares,
    unit,
    fine,
    rows,
    cols,
    count,
    each,
    teams,
):
    links = light, held, first, second, near, far
    _spread(*links, sum[0], gain * (gain * light[0] - target) * f32(unit), False, rows, cols)
    _spread(*links, squares[0], gain * gain * f32(fine), True, rows, cols)


def begin(
    z,
    rest,
    low,
    high,
    sum,
    squares,
    scale,
    r,
    x,
    p,
    s,
    is_free,
    unit,
    fine,
    least,
    lambda_,
    rows,
    cols,
    each,
    teams,
):
    down = -(
        sum[0].astype(f32) * f32(unit) + f32(lambda_) * (_unbend(z, rows, cols) - _unbend(rest, rows, cols))
    )
    is_free[:] = ~(((z <= low) & (down < 0)) | ((z >= high) & (down > 0)))
    scale[:] = squares[0].astype(f32) * f32(fine) + f32(least)
    r[:] = is_free * down
    for array in (sum, squares, x, p, s):
        array[:] = 0


HAT = (2 * np.minimum(np.arange(2 * FOUR), 2 * FOUR - 1 - np.arange(2 * FOUR)) + 1).astype(f32) / f32(
    2 * FOUR
)


def _lowered(v):
    """Rows of v, brought down to a line of nodes FOUR times as coarse."""
    size, few = len(v), (len(v) - 1) // FOUR + 1
    total = np.zeros((few, *v.shape[1:]), f32)
    for a, share in enumerate(HAT):
        at = FOUR * np.arange(few) - 2 + a
        shares = np.full(few, share)
        shares[0 if a < FOUR else -1] = 1
        some = (at >= 0) & (at < size)
        total[some] += shares[some, None] * v[at[some]]
    return total


def down(fine, scale, to, times, divides, rows, cols):
    to[:] = f32(times) * _lowered(_lowered(fine.reshape(rows, cols)).T).T.ravel()
    if divides:
        to /= scale


def _raised(v, size):
    """Rows of v, brought up by linear interpolation to so many."""
    at, k = np.divmod(np.arange(size), FOUR)
    beside = np.clip(np.where(k < 2, at - 1, at + 1), 0, len(v) - 1)
    share = (np.where(k < 2, 3 - 2 * k, 2 * k - 3).astype(f32) / f32(2 * FOUR))[:, None]
    return (1 - share) * v[at] + share * v[beside]


def up(r, scale, is_free, coarse, v, rows, cols):
    v[:] = is_free * (
        r / scale + _raised(_raised(coarse.reshape((rows - 1) // FOUR + 1, -1), rows).T, cols).T.ravel()
    )


def lengths(r, v, part, pixels):
    a, b = (array.astype(np.float64) for array in (r, v))
    part.reshape(-1)[:] = np.concatenate([_by_blocks(b * b), _by_blocks(a * b)])


def product(light, held, first, second, near, far, gain, v, sum, state, rows, cols, count, each, teams):
    if state[LEFT] > 0:
        links = light, held, first, second, near, far
        _spread(
            *links,
            sum[0],
            gain * gain * _change(*links, v, rows, cols) * f32(state[SCATTERED]),
            False,
            rows,
            cols,
        )


def change(
    light, held, first, second, near, far, gain, bare, v, share, state, rows, cols, count, is_first, each
):
    if state[LEFT] > 0:
        own = bare * light[0] * (gain * _change(light, held, first, second, near, far, v, rows, cols))
        share[:] = own if is_first else share + own


def product_beside(
    light,
    held,
    first,
    second,
    near,
    far,
    gain,
    bare,
    share,
    under,
    v,
    sum,
    state,
    rows,
    cols,
    count,
    each,
    teams,
):
    if state[LEFT] > 0:
        links = light, held, first, second, near, far
        left = gain * _change(*links, v, rows, cols) - bare * light[0] * (share / under)
        _spread(*links, sum[0], gain * left * f32(state[SCATTERED]), False, rows, cols)


def curve(r, v, scale, is_free, sum, w, totals, state, rows, cols, each, teams):
    if state[LEFT] > 0:
        bent = f32(state[LAMBDA]) * _unbend(v, rows, cols)
        w[:] = is_free * (
            sum[0].astype(f32) * f32(1 / state[SCATTERED]) + bent + f32(state[DAMPING]) * scale * v
        )
        sum[:] = 0
        a, b, c = (array.astype(np.float64) for array in (r, v, w))
        for n, values in enumerate((a * b * state[UNIT_RV], b * c * state[UNIT_RV], b * b * state[UNIT_VV])):
            totals[n, 0] = values.astype(np.int64).sum()


def go(v, w, r, x, p, s, totals, next_totals, state, next, fixed, exact, pixels, each):
    next[:] = state
    if state[LEFT] <= 0:
        return
    next_totals[:] = 0
    product, curvature, square = totals[:, 0] / state[[UNIT_RV, UNIT_RV, UNIT_VV]]
    beta = 0.0
    if state[ALPHA] != 0:
        beta = product / state[PRODUCT]
        curvature -= beta * product / state[ALPHA]
    else:
        next[START] = product
    if not (product > state[LEAST] * next[START] and curvature > 0):
        next[LEFT] = 0
        return
    next[[LEFT, SCATTERED, UNIT_RV, UNIT_VV]] = (
        state[LEFT] - 1,
        fixed / np.sqrt(square),
        exact / product,
        exact / square,
    )
    next[[PRODUCT, ALPHA, GAIN]] = (
        product,
        product / curvature,
        state[GAIN] + 0.5 * (product / curvature) * product,
    )
    alpha, beta = f32(product / curvature), f32(beta)
    p[:] = v + beta * p
    s[:] = w + beta * s
    x += alpha * p
    r -= alpha * s


def ready(state, totals, square, product, lambda_, damping, least, fixed, exact, most):
    totals[:] = 0
    state[:] = (
        most,
        fixed / np.sqrt(square),
        exact / product,
        exact / square,
        0,
        0,
        0,
        0,
        lambda_,
        damping,
        least,
    )


def move(z, x, low, high, to, pixels, each):
    to[:] = np.minimum(np.maximum(z + x, low), high)
