"""The kernels of `adjoint` in NumPy, on all nodes at a time: twin of opencl/adjoint.cl."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ... import constants
from ...constants import DARK, LINK_BLOCK, OPEN, PERIODIC
from .interreflection import _arctan, _below

f32 = np.float32
Values = Any  # one per node, or one for all
Ways = tuple[Any, ...]  # (c, s, columns, rise, rows, run) of a slice, numbers or one per node
NONE, STEEP, ROUNDING = map(f32, (constants.NONE, constants.STEEP, constants.ROUNDING))
PARALLEL, LEAST_SEARCHED_SLOPE = f32(constants.PARALLEL), f32(constants.LEAST_SEARCHED_SLOPE)
PI, HALF_PI, TWO_PI = map(f32, (constants.PI, constants.HALF_PI, constants.TWO_PI))
ZERO, HALF, ONE = f32(0), f32(0.5), f32(1)


def _above(
    t: np.ndarray, table: np.ndarray, row: Any, after: Any, share: Any, knots: int
) -> tuple[np.ndarray, ...]:
    """c1, c2, d1, d2 (opencl/adjoint.cl): integrals of B sin cos and of B cos^2 over the elevations above
    slopes t, and their derivatives by t. ``row``, ``after``, ``share``: numbers, or one per node.
    """
    square = 1 + t * t
    cosine = 1 / square
    if knots == 0:
        return (
            f32(0.5) * cosine,
            f32(0.5) * (HALF_PI - _arctan(t) - t * cosine),
            -t * cosine * cosine,
            -cosine * cosine,
        )
    diamond = t / (1 + t)
    place = diamond * f32(knots - 1)
    per = (1 - diamond) / (1 + t) * f32(knots - 1)
    knot = np.minimum(place.astype(np.int32), knots - 2)
    part = place - knot.astype(f32)
    v = table[row, knot]
    if np.ndim(share):
        v = np.where((share > 0)[:, None], v + share[:, None] * (table[after, knot] - v), v)
    return v[:, 1] + part * v[:, 3], v[:, 0] + part * v[:, 2], v[:, 3] * per, v[:, 2] * per


def _over(a: Any, b: Any) -> np.ndarray:
    """a / b in float32, 0 where b is 0."""
    return np.where(b != 0, a / np.where(b != 0, b, f32(1)), f32(0)).astype(f32)


def _horizon(
    heights: np.ndarray,
    ways: Ways,
    x: np.ndarray,
    y: np.ndarray,
    own: np.ndarray,
    best: np.ndarray,
    top: np.float32,
    reach: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    sides: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Slope and crossing number for nodes (n,); ``ways``: (c, s, columns, rise, rows, run), numbers or one
    per node.
    """
    c, s, columns, rise, per_column, run = (np.broadcast_to(part, own.shape) for part in ways)
    padded = heights.reshape(rows, cols + 2 * margin)
    best, number = best.copy(), np.zeros(own.shape, np.int32)
    for on_rows, length, shear in ((True, rise, columns), (False, run, per_column)):
        is_forward = (s if on_rows else c) > 0
        place, size = (y, rows) if on_rows else (x, cols)
        last = np.where(is_forward, size - 1 - place, place)
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
                & ~((top - own[left]) * (ROUNDING * closeness) <= best[left])
            )
            left, closeness = left[going], closeness[going]
            across = f32(n) * shear[left]
            low = np.floor(across)
            share, low = across - low, low.astype(np.int32)
            step = np.where(is_forward[left], n, -n)
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
            left, closeness, share = left[there], closeness[there], share[there]
            column, row, over = column[there], row[there], over[there]
            a = padded[row, margin + column]
            b = padded[over, margin + column + on_rows]
            slope = (a + share * (b - a) - own[left]) * closeness
            higher = slope > best[left]
            best[left[higher]] = slope[higher]
            number[left[higher]] = n if on_rows else -n
    return best, number


def _wall(ways: Ways, x: np.ndarray, y: np.ndarray, rows: int, cols: int) -> np.ndarray:
    c, s, _, rise, _, run = ways
    to_x = np.where(c > 0, f32(cols) - HALF - x.astype(f32), x.astype(f32) + HALF)
    to_y = np.where(s > 0, f32(rows) - HALF - y.astype(f32), y.astype(f32) + HALF)
    return np.minimum(
        np.where(c != 0, to_x / run, f32(1e30)), np.where(s != 0, to_y / rise, f32(1e30))
    ).astype(f32)


def _ways(c: Any, s: Any) -> Ways:
    c, s = (np.where(np.abs(part) > PARALLEL, part, f32(0)) for part in (c, s))
    across, along = np.abs(c), np.abs(s)
    return c, s, _over(c, along), along, _over(s, across), across


def _note(
    links: tuple[np.ndarray, ...],
    some: np.ndarray,
    ways: Ways,
    number: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    rows: int,
    cols: int,
    sides: int,
    per_slope: np.ndarray,
    inverse: np.ndarray,
) -> Values:
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
    whole, share = -pull * inverse[some], place - low.astype(f32)
    e = some // LINK_BLOCK, held[some], some % LINK_BLOCK
    first[e] = row * cols + column
    second[e] = np.where(on_row, row * cols + (column + 1) % cols, (row + 1) % rows * cols + column)
    near[e], far[e] = whole - whole * share, whole * share
    held[some] += 1
    return pull


def _adjacent(i: np.ndarray, n: int, sides: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes before and after nodes i of a line of n, and 1 over their distance."""
    before, after = ((i + step) % n if sides == PERIODIC else np.clip(i + step, 0, n - 1) for step in (-1, 1))
    within = (i > 0) & (i < n - 1) | (sides == PERIODIC)
    return before, after, np.where(within, f32(0.5), f32(1))


def surface(
    z: np.ndarray,
    heights: np.ndarray,
    tilts: np.ndarray,
    top: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    sides: int,
) -> None:
    z = z.reshape(rows, cols)
    padded = heights.reshape(rows, cols + 2 * margin)
    padded[:, margin : margin + cols] = -z
    if sides == PERIODIC:
        padded[:] = -z[:, np.arange(-margin, cols + margin) % cols]
    for out, v in ((tilts[0].reshape(rows, cols), z), (tilts[1].reshape(rows, cols).T, z.T)):
        before, after, half = _adjacent(np.arange(v.shape[1]), v.shape[1], sides)
        out[...] = (v[:, after] - v[:, before]) * half


def tiles(z: np.ndarray, tiles: np.ndarray, top: np.ndarray, rows: int, cols: int) -> None:
    high = np.float32(-z.min())
    tiles[:] = high  # the same in every tile: here nothing is skipped by them
    bits = high.view(np.int32)
    top[0] = bits ^ 0x7FFFFFFF if bits < 0 else bits


def _highest(top: np.ndarray) -> Values:
    return (top[:1] ^ 0x7FFFFFFF if top[0] < 0 else top[:1]).view(np.float32)[0]


def _nodes(heights: np.ndarray, rows: int, cols: int, margin: int) -> tuple[np.ndarray, ...]:
    """Columns, rows and heights of all nodes, flat."""
    y, x = (v.ravel() for v in np.indices((rows, cols)))
    return x, y, heights.reshape(rows, cols + 2 * margin)[:, margin : margin + cols].ravel()


def _finish(
    light: np.ndarray,
    gx: np.ndarray,
    gy: np.ndarray,
    inverse: np.ndarray,
    total: np.ndarray,
    by_own: np.ndarray,
    by_x: np.ndarray,
    by_y: np.ndarray,
) -> None:
    drop = total * inverse * inverse * inverse
    light[:] = total * inverse, by_own * inverse, by_x * inverse - drop * gx, by_y * inverse - drop * gy


def _limits(
    azimuth: np.ndarray,
    own: np.ndarray,
    gx: np.ndarray,
    gy: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    rows: int,
    cols: int,
    sides: int,
) -> tuple[Ways, np.ndarray, np.ndarray, Any]:
    """(way, slope along it, its limit without the ground, derivative of that by the own depth).

    The derivative is 0 unless the wall is the limit.
    """
    c, s, _, _ = azimuth
    ways = _ways(c, s)
    tilt = gx * c + gy * s
    slope = np.maximum(-tilt, f32(0))
    by_wall: Values = f32(0)
    if sides == DARK:
        closeness = 1 / _wall(ways, x, y, rows, cols)
        wall = -own * closeness
        by_wall = np.where(wall > slope, closeness, f32(0))
        slope = np.maximum(wall, slope)
    return ways, tilt, slope, by_wall


def horizons(
    heights: np.ndarray,
    tilts: np.ndarray,
    tiles: np.ndarray,
    top: np.ndarray,
    azimuths: np.ndarray,
    numbers: np.ndarray,
    slopes: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    count: int,
    sides: int,
    ways: int,
) -> None:
    x, y, own = _nodes(heights, rows, cols, margin)
    reach = np.full(own.shape, 1e30, f32)
    for k in range(count):
        way, _, slope, _ = _limits(azimuths[k], own, tilts[0], tilts[1], x, y, rows, cols, sides)
        least = np.maximum(slope, LEAST_SEARCHED_SLOPE) if sides == PERIODIC else slope
        slopes[k, : own.size], numbers[k, : own.size] = _horizon(
            heights, way, x, y, own, least, _highest(top), reach, rows, cols, margin, sides
        )


def sky(
    heights: np.ndarray,
    tilts: np.ndarray,
    top: np.ndarray,
    numbers: np.ndarray,
    slopes: np.ndarray,
    azimuths: np.ndarray,
    table: np.ndarray,
    light: np.ndarray,
    held: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    count: int,
    knots: int,
    sides: int,
) -> None:
    x, y, own = _nodes(heights, rows, cols, margin)
    gx, gy = tilts
    total, by_own, by_x, by_y = np.zeros((4, own.size), f32)
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
        links = held, first, second, near, far
        by[some] = _note(links, some, ways, number, x, y, rows, cols, sides, per_slope, inverse)
        by_own += by
        by_x += width * c * c2
        by_y += width * s * c2
    _finish(light, gx, gy, inverse, total, by_own, by_x, by_y)


class LampSlices(NamedTuple):
    """One slice of a lamp per node, and the slopes between which the lamp stands in it.

    Each field is a number or one per node. ``low_by`` and ``high_by`` are derivatives by the own depth.
    Ground counts as far as ``reach``; the lamp ends at ``end``.
    """

    c: np.ndarray
    s: np.ndarray
    width: np.ndarray
    low: np.ndarray
    high: np.ndarray
    low_by: np.ndarray
    high_by: np.ndarray
    reach: np.ndarray
    end: np.ndarray


def _ball_slices(
    node: np.ndarray, frames: np.ndarray, solid: np.ndarray, own: np.ndarray, count: int
) -> LampSlices:
    """The slices of a ball; ``node``: sine and cosine of a midpoint of -pi/2..pi/2, and of one all round."""
    sine, cosine, c, s = node
    ux, uy, extent, _ = frames.T
    radius, rise = solid[3], solid[2] - own
    beyond = extent * extent + rise * rise - radius * radius
    around = extent <= radius
    offset = extent * (s * ux - c * uy)
    along, half = extent * (c * ux + s * uy), np.sqrt(np.maximum(radius * radius - offset * offset, f32(0)))
    sin_d = radius / extent * sine
    cos_d = np.sqrt((1 - sin_d) * (1 + sin_d))
    c, s = np.where(around, c, ux * cos_d - uy * sin_d), np.where(around, s, uy * cos_d + ux * sin_d)
    width = np.where(around, TWO_PI / f32(count), radius / extent * cosine * (PI / f32(count)) / cos_d)
    along, half = np.where(around, along, extent * cos_d), np.where(around, half, radius * cosine)
    inside = beyond <= 0
    tangent, square = np.sqrt(beyond), along * along + rise * rise
    low_c, low_s = along * tangent + rise * half, rise * tangent - along * half
    high_c, high_s = along * tangent - rise * half, rise * tangent + along * half
    low = np.where(low_c > 0, low_s / low_c, np.where(low_s > 0, STEEP, -STEEP))
    high = np.where(high_c > 0, high_s / high_c, np.where(rise > 0, STEEP, -STEEP))
    low_by = np.where(~inside & (low_c > 0), square / (low_c * tangent), f32(0))
    high_by = np.where(~inside & (high_c > 0), square / (high_c * tangent), f32(0))
    low, high = np.where(inside, -STEEP, low), np.where(inside, STEEP, high)
    return LampSlices(c, s, width, low, high, low_by, high_by, np.maximum(along, half), along + half)


def _quadrangle_slices(
    k: int,
    node: np.ndarray,
    frames: np.ndarray,
    solid: np.ndarray,
    own: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    count: int,
) -> LampSlices:
    """The slices number ``k`` of a quadrangle with the corners ``solid``; ``node`` as for a ball."""
    ux, uy, extent, _ = frames.T
    t = extent * (f32(2 * k + 1) / f32(count) - 1)
    scale = 1 / (1 + t * t)
    cos_d, sin_d, aside = (1 - t * t) * scale, 2 * t * scale, extent > 0
    c = np.where(aside, ux * cos_d - uy * sin_d, node[2])
    s = np.where(aside, uy * cos_d + ux * sin_d, node[3])
    width = np.where(aside, 4 * extent / f32(count) * scale, TWO_PI / f32(count))
    zero = np.zeros(own.shape, f32)
    least, most, least_by, most_by, reach = zero + STEEP, zero - STEEP, zero, zero, zero
    met = np.zeros(own.shape, int)
    for i in range(4):
        j = (i + 1) % 4
        (px, py, pz), (qx, qy, qz) = solid[3 * i : 3 * i + 3], solid[3 * j : 3 * j + 3]
        ax, ay = px - x.astype(f32), py - y.astype(f32)
        bx, by = qx - x.astype(f32), qy - y.astype(f32)
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
    most, most_by = np.where(zenith, STEEP, most), np.where(zenith, f32(0), most_by)
    some = met > 0
    low, high = np.where(some, least, f32(1)), np.where(some, most, f32(0))
    low_by, high_by = np.where(some, least_by, f32(0)), np.where(some, most_by, f32(0))
    return LampSlices(c, s, width, low, high, low_by, high_by, reach, reach)


def _lower_limit(
    slices: LampSlices,
    ways: Ways,
    tilt: np.ndarray,
    own: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    rows: int,
    cols: int,
    sides: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The slope that limits a lamp from below without the ground, and its derivative by the own depth."""
    slope, by_limit = np.maximum(-tilt, f32(0)), np.zeros(own.shape, f32)
    if sides == DARK:
        wall = _wall(ways, x, y, rows, cols)
        closeness = 1 / wall
        limits = (slices.end > wall) & (-own * closeness > slope)
        slope, by_limit = np.where(limits, -own * closeness, slope), np.where(limits, closeness, by_limit)
    limits = slices.low > slope
    return np.where(limits, slices.low, slope), np.where(limits, slices.low_by, by_limit)


def _table_rows(c: np.ndarray, s: np.ndarray, n_rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(row, row after it, share of the latter) of a table that is even in the diamond angle of (c, s)."""
    down, left = s < 0, c < 0
    diamond = np.where(
        ~down,
        np.where(~left, s / (c + s), 1 - c / (s - c)),
        np.where(left, 2 - s / (-c - s), 3 + c / (c - s)),
    )
    place = f32(0.25) * diamond * f32(n_rows)
    row = np.minimum(place.astype(np.int32), n_rows - 1)
    return row, np.where(row + 1 < n_rows, row + 1, 0), place - row.astype(f32)


def lamp(
    heights: np.ndarray,
    tilts: np.ndarray,
    tiles: np.ndarray,
    top: np.ndarray,
    frames: np.ndarray,
    quadrature: np.ndarray,
    solid: np.ndarray,
    table: np.ndarray,
    light: np.ndarray,
    held: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    count: int,
    knots: int,
    n_rows: int,
    ball: int,
    sides: int,
) -> None:
    x, y, own = _nodes(heights, rows, cols, margin)
    gx, gy = tilts
    total, by_own, by_x, by_y = np.zeros((4, own.size), f32)
    inverse = 1 / np.sqrt(1 + gx * gx + gy * gy)
    held[:] = 0
    for k in range(count):
        # 1. the slice, and the slopes between which the source stands in it
        if ball:
            slices = _ball_slices(quadrature[k], frames, solid, own, count)
        else:
            slices = _quadrangle_slices(k, quadrature[k], frames, solid, own, x, y, count)
        c, s, width, high = slices.c, slices.s, slices.width, slices.high

        # 2. its lower limits
        ways = _ways(c, s)
        tilt = gx * c + gy * s
        slope, by_limit = _lower_limit(slices, ways, tilt, own, x, y, rows, cols, sides)
        on = np.flatnonzero(slope < high)
        number = np.zeros(own.shape, np.int32)
        way = tuple(np.broadcast_to(part, own.shape)[on] for part in ways)
        reach = np.broadcast_to(slices.reach, own.shape)[on]
        slope[on], number[on] = _horizon(
            heights, way, x[on], y[on], own[on], slope[on], _highest(top), reach, rows, cols, margin, OPEN
        )

        # 3. the light between
        lit = slope < high
        number = np.where(lit, number, 0)
        place = _table_rows(c, s, n_rows)
        c1, c2, d1, d2 = _above(np.where(lit, slope, f32(0)), table, *place, knots)
        per_slope = width * (d1 + tilt * d2)
        cut = lit & (high < STEEP)
        o1, o2, e1, e2 = _above(np.where(cut, high, f32(0)), table, *place, knots)
        c1, c2 = np.where(cut, c1 - o1, c1), np.where(cut, c2 - o2, c2)
        by_own = np.where(cut, by_own - width * (e1 + tilt * e2) * slices.high_by, by_own)
        by = per_slope * by_limit
        some = np.flatnonzero(number)
        links = held, first, second, near, far
        by[some] = _note(links, some, ways, number, x, y, rows, cols, OPEN, per_slope, inverse)
        total = np.where(lit, total + width * (c1 + tilt * c2), total)
        by_own = np.where(lit, by_own + by, by_own)
        by_x = np.where(lit, by_x + width * c * c2, by_x)
        by_y = np.where(lit, by_y + width * s * c2, by_y)
    _finish(light, gx, gy, inverse, total, by_own, by_x, by_y)


def _links(held: np.ndarray, *arrays: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """The nodes that have a k-th link, and the arrays' values of it, for every k."""
    for k in range(held.max()):
        some = np.flatnonzero(held > k)
        yield some, *(array[some // LINK_BLOCK, k, some % LINK_BLOCK] for array in arrays)


Beside = tuple[np.ndarray, ...]  # of crossings: first and second node, share of the second, 1 / distance


class _Made:
    """Links of nodes while they are made: arrays first, second, near, far; ``made`` (pixels,) how many there
    are, ``most`` how many there may be.
    """

    def __init__(self, held: np.ndarray, *arrays: np.ndarray):
        self.arrays, self.made, self.most = arrays, np.zeros_like(held), 0

    def copy(self, held: np.ndarray, part: np.ndarray, *arrays: np.ndarray) -> None:
        """Those of another image, times ``part`` (pixels,)."""
        for some, i, j, one, other in _links(held, *arrays):
            self._put(some, i, j, part[some] * one, part[some] * other)

    def add(self, some: np.ndarray, at: Beside, part: np.ndarray) -> None:
        """Of the nodes ``some`` to the two nodes of a crossing, ``part`` the derivative by its height; the
        last one takes it in where no more may be.
        """
        first, second, share = (values[some] for values in at[:3])
        other = part[some] * share
        one = part[some] - other
        free = self.made[some] < self.most
        self._put(some[free], first[free], second[free], -one[free], -other[free])
        full = some[~free]
        last = full // LINK_BLOCK, self.made[full] - 1, full % LINK_BLOCK
        self.arrays[2][last] -= one[~free]
        self.arrays[3][last] -= other[~free]

    def _put(self, some: np.ndarray, *values: np.ndarray) -> None:
        at = some // LINK_BLOCK, self.made[some], some % LINK_BLOCK
        for array, value in zip(self.arrays, values):
            array[at] = value
        self.made[some] += 1


def _below_by_plane(s: np.ndarray) -> np.ndarray:
    total: np.ndarray = _arctan(s) + s / (ONE + s * s)
    return total


def _below_by(s: np.ndarray, plane: np.ndarray) -> np.ndarray:
    q = ONE / (ONE + s * s)
    by: np.ndarray = 2 * q * q * (s - plane)
    return by


class _VisibleStrips:
    """Derivatives of the strips visible from all nodes, azimuth by azimuth; steps as in opencl/adjoint.cl."""

    def __init__(self, z: np.ndarray, sent: np.ndarray, m: np.ndarray, per: np.ndarray, links: _Made):
        self.z, self.sent, self.m, self.per, self.links = z, sent, m, per, links
        self.by_own, self.by_x, self.by_y = (np.zeros_like(z) for _ in range(3))

    def begin(self, plane: np.ndarray) -> None:
        none, own = np.zeros_like(self.z), np.arange(len(self.z))
        self.plane, self.slope, self.past = plane, plane, _below(plane, plane)
        self.before, self.by_plane, self.by_top = none, none.copy(), none.copy()
        self.was: Beside = (own, own, none, none)
        self.top: Beside = self.was
        self.was_distance = ZERO

    def meet(self, at: Beside, distance: np.float32, going: np.ndarray) -> None:
        first, second, weight, closeness = at
        a = -self.z[first]
        stands = a + weight * (-self.z[second] - a) + self.z
        rises, slope, plane = stands * closeness, self.slope, self.plane
        seen = going & (rises > slope)
        # 3.2 the strip that it opens
        low, high = self.before - slope * self.was_distance, stands - slope * distance
        whole, here = high - low, _below(rises, plane)
        begins = (low < 0) & (whole > 0) & (self.was_distance > 0)
        between = begins & (-low < whole)
        part = np.where(between, _over(-low, whole), begins.astype(f32))
        near_light, far_light = (
            self.sent[i] + share * (self.sent[j] - self.sent[i]) for i, j, share in (self.was[:3], at[:3])
        )
        mean = HALF * (near_light * (1 - part) + far_light * (1 + part))
        bends = HALF * (here - self.past) * (far_light - near_light)
        by_part = np.where(between, _over(bends, whole * whole), ZERO)
        by_slope = by_part * (high * self.was_distance - low * distance) - mean * _below_by(slope, plane)
        hides = seen & between
        self.links.add(np.flatnonzero(hides), self.was, self.per * -by_part * high)
        self.by_own[hides] -= (by_part * high)[hides]
        self.by_plane[seen] -= (mean * (_below_by_plane(rises) - _below_by_plane(slope)))[seen]
        topped = seen & (self.top[3] > 0)
        self.by_top[topped] += (by_slope * self.top[3])[topped]
        self.close(topped)
        self.by_plane[seen & ~topped] += by_slope[seen & ~topped]
        self.by_top = np.where(seen, mean * _below_by(rises, plane) * closeness + by_part * low, self.by_top)
        self.top = tuple(np.where(seen, new, old) for new, old in zip(at, self.top))
        self.past, self.slope = np.where(seen, here, self.past), np.where(seen, rises, slope)
        self.before, self.was, self.was_distance = stands, at, distance

    def close(self, topped: np.ndarray) -> None:
        """A link of these nodes to the highest crossing so far."""
        self.links.add(np.flatnonzero(topped), self.top, self.per * self.by_top)
        self.by_own[topped] += self.by_top[topped]

    def end(self, cosine: np.float32, sine: np.float32, sides: int, closeness: Any) -> None:
        """3.3 all that is not sky; ``closeness`` (pixels,): 1 / distance of the wall."""
        end = self.slope if sides == PERIODIC else np.maximum(self.slope, ZERO)
        if sides == DARK:
            wall = self.z * closeness
            by = self.m * _below_by(wall, self.plane) * closeness
            self.by_own -= np.where(wall > end, by, ZERO)
            end = np.maximum(wall, end)
        self.by_plane += self.m * (_below_by_plane(end) - _below_by_plane(self.plane))
        topped = self.top[3] > 0
        by_end = self.m * _below_by(end, self.plane) * self.top[3]
        self.by_top = np.where(end == self.slope, self.by_top - by_end, self.by_top)
        self.close(topped)
        self.by_x -= cosine * self.by_plane
        self.by_y -= sine * self.by_plane


def _nodes_of_crossing(
    u: np.ndarray, v: np.ndarray, on_columns: bool, rows: int, cols: int, sides: int
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """The two nodes beside crossings at or after columns u and rows v, and whether both are on the map."""
    u_next, v_next = (u, v + 1) if on_columns else (u + 1, v)
    there = (u >= 0) & (v >= 0) & (u_next < cols) & (v_next < rows) | (sides == PERIODIC)
    return (v % rows * cols + u % cols, v_next % rows * cols + u_next % cols), there


def add_ground(
    light: np.ndarray,
    held: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    sky_light: np.ndarray,
    sky_held: np.ndarray,
    sky_first: np.ndarray,
    sky_second: np.ndarray,
    sky_near: np.ndarray,
    sky_far: np.ndarray,
    z: np.ndarray,
    tilts: np.ndarray,
    sums: np.ndarray,
    radiance: np.ndarray,
    ways: np.ndarray,
    places: np.ndarray,
    crossings: np.ndarray,
    all_light: np.ndarray,
    all_held: np.ndarray,
    all_first: np.ndarray,
    all_second: np.ndarray,
    all_near: np.ndarray,
    all_far: np.ndarray,
    number: int,
    images: int,
    rows: int,
    cols: int,
    width: int,
    shift: int,
    azimuths: int,
    steps: int,
    count: int,
    sky_count: int,
    room: int,
    is_sky: int,
    sides: int,
) -> None:
    # 1. the mean radiance
    pixels = rows * cols
    y, x = (index.ravel() for index in np.indices((rows, cols)))
    sums = sums.reshape(images + 1, rows, 1 << shift, width)[:, y, x % (1 << shift), x >> shift]
    left = PI - sky_light[0]
    m, per = _over(sums[number], sums[images]), _over(left, sums[images])
    # 2. links of the direct light, and of U
    links = _Made(all_held, all_first, all_second, all_near, all_far)
    links.copy(held, 1 - m if is_sky else np.ones_like(m), first, second, near, far)
    if not is_sky:
        links.copy(sky_held, -m, sky_first, sky_second, sky_near, sky_far)
    # 3. those of the strips
    strips = _VisibleStrips(z, radiance.reshape(images, pixels)[number], m, per, links)
    places, crossings = places.reshape(azimuths, steps, 2), crossings.reshape(azimuths, steps, 3)
    for k, (cosine, sine, on_columns, _) in enumerate(ways.reshape(azimuths, 4)):
        strips.begin(-(tilts[0] * cosine + tilts[1] * sine))
        links.most = room - (azimuths - 1 - k)
        going = sums[images] > 0
        for (dx, dy), (weight, distance, closeness) in zip(places[k].tolist(), crossings[k]):
            # 3.1 the crossing, if it is on the map, and if any ground there could be seen
            nodes, there = _nodes_of_crossing(x + dx, y + dy, on_columns > 0, rows, cols, sides)
            going &= there & (z > strips.slope * distance)
            if not going.any():
                break
            strips.meet((*nodes, weight + 0 * z, closeness + 0 * z), distance, going)
        walls = _wall(_ways(cosine, sine), x, y, rows, cols) if sides == DARK else ONE
        strips.end(cosine, sine, sides, ONE / walls)
    all_held[:] = links.made
    all_light[0] = light[0] + left * m
    for row, by in ((1, strips.by_own), (2, strips.by_x), (3, strips.by_y)):
        all_light[row] = light[row] - m * sky_light[row] + per * by
