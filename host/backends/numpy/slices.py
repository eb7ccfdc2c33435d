"""The kernels of `slices` in NumPy, on many slices at a time: twin of opencl/slices.cl."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ... import constants
from ...constants import SLICES
from .ground import _slope_between

F = np.float32
NONE, STEEP, ENDLESS = F(constants.NONE), F(constants.STEEP), F(constants.ENDLESS)
CHORD_TANGENT, TURN_BY_SINE, TURN_BY_TANGENT = (
    np.array(factors, F)
    for factors in (constants.CHORD_TANGENT, constants.TURN_BY_SINE, constants.TURN_BY_TANGENT)
)
SLICES_PER_BATCH = 2**15  # slices

Values = Any  # one per node, or one for all
Nodes = TypeVar("Nodes", "Disc", "Frame")
NodeArrays = tuple[
    np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray
]  # x, y, height, tilt_x, tilt_y, mirror_x, mirror_y, mirror_z


def coarser(heights: np.ndarray, tops: np.ndarray, rows: int, cols: int, width: int, level: int) -> None:
    wide, tall = width >> level, ((rows - 1) >> level) + 1
    out = tops[:tall, width - (width >> (level - 1)) :][:, :wide]
    out[...] = NONE
    if level == 1:
        fine = heights[: (rows + 2) * (cols + 1)].reshape(rows + 2, cols + 1)[1:-1, 1:]
        reach = 3
    else:
        fine = tops[: ((rows - 1) >> (level - 1)) + 1, width - (width >> (level - 2)) :][:, : 2 * wide]
        reach = 2
    for j in range(reach):
        for i in range(reach):
            part = fine[j::2, i::2]
            cells = out[: part.shape[0], : part.shape[1]]
            np.maximum(cells, part[: cells.shape[0], : cells.shape[1]], out=cells)


class Map(NamedTuple):
    """Arguments that all pixels share."""

    heights: np.ndarray
    tops: np.ndarray
    sky: np.ndarray
    points: np.ndarray
    lobe: np.ndarray
    chords: np.ndarray
    rim: np.float32
    highest: np.float32
    rows: int
    cols: int
    levels: int
    dark: int


class Pixels(NamedTuple):
    """Values that the slices of each pixel share, one column each; fields as in the other kernels."""

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    tilt_x: np.ndarray
    tilt_y: np.ndarray
    mirror_x: np.ndarray
    mirror_y: np.ndarray
    mirror_z: np.ndarray
    up: np.ndarray
    reach: np.ndarray
    radius: np.float32

    def of(self, which: np.ndarray) -> Pixels:
        return Pixels._make((*(value[which] for value in self[:10]), self.radius))


def _pixels(heights: np.ndarray, rows: int, cols: int) -> NodeArrays:
    """Of every node with ground, flat."""
    grid = heights[: (rows + 2) * (cols + 1)].reshape(rows + 2, cols + 1)
    y, x = np.nonzero(grid[1:-1, 1:] > NONE)
    here = (y + 1) * (cols + 1) + x + 1

    def pick(step: int) -> np.ndarray:
        there: np.ndarray = heights[here + step]
        return there

    tilt_x, tilt_y = (_slope_between(pick(-step), pick(0), pick(step)) for step in (1, cols + 1))
    twice = F(2) / (F(1) + tilt_x * tilt_x + tilt_y * tilt_y)
    mirror = twice * tilt_x, twice * tilt_y, twice - F(1)
    return x.astype(np.int32), y.astype(np.int32), pick(0), tilt_x, tilt_y, *mirror


def _under_source(pixels: Pixels, along: np.ndarray, aside: np.ndarray, t: np.ndarray) -> np.ndarray:
    if pixels.radius > 0:
        offset = t - along
        square = pixels.radius * pixels.radius - aside * aside - offset * offset
        return np.where(square > 0, (pixels.up - np.sqrt(np.maximum(square, F(0)))) / t, ENDLESS)
    return np.where(pixels.up > 0, (pixels.reach / t - along) / pixels.up, ENDLESS)


def _above_all(highest: np.float32, height: np.ndarray) -> np.ndarray:
    """By how much the highest ground is above a node, rounding included."""
    above: np.ndarray = highest - height + F(1e-6) * (np.abs(highest) + np.abs(height))
    return above


def _horizon(
    ground: Map,
    pixels: Pixels,
    c: np.ndarray,
    s: np.ndarray,
    slope: np.ndarray,
    high: np.ndarray,
    along: np.ndarray,
    aside: np.ndarray,
    begin: Values = 0.0,
) -> np.ndarray:
    """All arrays flat, one element per slice; pixels spread likewise."""
    stride, width = ground.cols + 1, ground.tops.shape[1]
    tops = ground.tops.ravel()
    tangent = slope.copy()
    per_x, per_y = np.where(c != 0, F(1) / c, ENDLESS), np.where(s != 0, F(1) / s, ENDLESS)
    on_x, on_y = (c >= 0).astype(np.int32), (s >= 0).astype(np.int32)
    end_x = np.where(
        c == 0, ENDLESS, np.where(c > 0, ground.cols - 1 - pixels.x, -pixels.x).astype(F) * per_x
    )
    end_y = np.where(
        s == 0, ENDLESS, np.where(s > 0, ground.rows - 1 - pixels.y, -pixels.y).astype(F) * per_y
    )
    # no farther than where the slice is above all ground
    above = _above_all(ground.highest, pixels.height)
    end = np.minimum(np.minimum(end_x, end_y), np.where(slope > 0, above / slope, ENDLESS))
    t = np.full(len(c), begin, F)
    who = np.flatnonzero((slope < high) & (t < end) & (t * (along + slope * pixels.up) < pixels.reach))
    state = [value[who] for value in (c, s, slope, high, along, aside, per_x, per_y, on_x, on_y, end)]
    here = pixels.of(who)
    level, t = np.zeros(len(who), np.int32), t[who]
    steps_x, steps_y = ((abs(way) * t).astype(np.int32) for way in state[:2])
    cell_x = here.x + np.where(state[8], steps_x, -1 - steps_x)
    cell_y = here.y + np.where(state[9], steps_y, -1 - steps_y)
    while len(who):
        c, s, slope, high, along, aside, per_x, per_y, on_x, on_y, end = state
        # 1. the way out of the cell
        large_x, large_y = cell_x >> level, cell_y >> level
        edge_x, edge_y = large_x + on_x, large_y + on_y
        line_x, line_y = edge_x << level, edge_y << level
        out_x, out_y = (line_x - here.x).astype(F) * per_x, (line_y - here.y).astype(F) * per_y
        by_x, single = out_x <= out_y, level == 0
        out = np.where(by_x, out_x, out_y)
        across = np.where(by_x, s, c) * out
        # 2. the ground there
        n = np.flatnonzero(single)
        corner_x, corner_y = np.where(by_x, line_x, cell_x)[n], np.where(by_x, cell_y, line_y)[n]
        low = (corner_y + 1) * stride + corner_x + 1
        past = np.where(by_x, cell_y - here.y, cell_x - here.x)[n]
        part = np.clip(across[n] - past.astype(F), F(0), F(1))
        a, b = ground.heights[low], ground.heights[low + np.where(by_x[n], stride, 1)]
        rise = a * (F(1) - part) + b * part - here.height[n]
        higher = (rise > slope[n] * out[n]) & (out[n] * (along[n] + slope[n] * here.up[n]) < here.reach[n])
        n = n[higher]
        slope[n] = np.maximum(
            slope[n], np.minimum(rise[higher] / out[n], _under_source(here.of(n), along[n], aside[n], out[n]))
        )
        # 3. or the top of a large cell against the line where it comes in
        at = np.where(single, 0, large_y * width + width - (width >> np.maximum(level - 1, 0)) + large_x)
        passes = single | (tops[at] - here.height <= slope * t)
        # 4. on, and up where a larger cell begins; or down
        first = (np.where(by_x, large_y, large_x) << level) - np.where(by_x, here.y, here.x)
        to = np.clip(np.floor(across).astype(np.int32), first, first + (1 << level) - 1)
        cell_x = np.where(passes, np.where(by_x, line_x - 1 + on_x, here.x + to), cell_x)
        cell_y = np.where(passes, np.where(by_x, here.y + to, line_y - 1 + on_y), cell_y)
        t = np.where(passes, out, t)
        begins = (np.where(by_x, edge_x, edge_y) & 1 == 0) & (level < ground.levels)
        level = level + np.where(passes, begins, -1).astype(np.int32)
        going = (slope < high) & (t < end) & (t * (along + slope * here.up) < here.reach)
        if not going.all():
            tangent[who] = slope
            who = who[going]
            state, here = [value[going] for value in state], here.of(going)
            cell_x, cell_y, level, t = cell_x[going], cell_y[going], level[going], t[going]
    return tangent


def _copy_of(node: np.ndarray, steps: np.ndarray, way: np.ndarray, size: int, period: int) -> np.ndarray:
    """The copy of a node on a map that repeats from which a slice has most of the map ahead."""
    copy: np.ndarray = node + period * np.where(
        way < 0, (size - 1 - node + steps) // period, -((node + steps) // period)
    )
    return copy


def _repeated_horizon(
    ground: Map,
    pixels: Pixels,
    periods: tuple[int, int],
    c: np.ndarray,
    s: np.ndarray,
    slope: np.ndarray,
    high: np.ndarray,
    along: np.ndarray,
) -> np.ndarray:
    """As :func:`_horizon`, over a map that repeats: a slice that leaves it goes on in a copy."""
    t, flat = np.zeros(len(c), F), np.zeros(len(c), F)
    above = _above_all(ground.highest, pixels.height)
    going = slope < high
    while going.any():
        steps_x, steps_y = ((abs(way) * t).astype(np.int32) for way in (c, s))
        x = _copy_of(pixels.x, steps_x, c, ground.cols, periods[1])
        y = _copy_of(pixels.y, steps_y, s, ground.rows, periods[0])
        copies = pixels._replace(x=x, y=y)
        slope = _horizon(ground, copies, c, s, slope, np.where(going, high, slope), along, flat, t)
        end_x = np.where(c < 0, x, ground.cols - 1 - x).astype(F) / np.maximum(abs(c), F(1e-30))
        end_y = np.where(s < 0, y, ground.rows - 1 - y).astype(F) / np.maximum(abs(s), F(1e-30))
        t = np.minimum(end_x, end_y) * F(1 - 1e-6)  # rounding passes over no crossing
        going &= (slope < high) & (t * slope < above) & (t * along < pixels.reach)
    return slope


def _in_lobe(
    ground: Map, pixels: Pixels, c: np.ndarray, s: np.ndarray, cosine: np.ndarray, sine: np.ndarray
) -> Values:
    x, y = cosine - (pixels.mirror_x * c + pixels.mirror_y * s), pixels.mirror_y * c - pixels.mirror_x * s
    z = sine - pixels.mirror_z
    most = F(len(ground.lobe) - 1)
    # 1 - cos is half of |L - R|^2
    at = np.minimum((x * x + y * y + z * z) * (F(0.5) * most / ground.rim), most)
    i = np.minimum(at.astype(np.int32), len(ground.lobe) - 2)
    first = ground.lobe[i]
    return first + (at - i.astype(F)) * (ground.lobe[i + 1] - first)


def _brightness_of(
    ground: Map,
    pixels: Pixels,
    c: np.ndarray,
    s: np.ndarray,
    tilt: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> Values:
    side = ground.sky.shape[1]
    sky, half, most = ground.sky.ravel(), F(0.5) * F(side - 1), side - 2
    low_c, high_c = F(1) / np.sqrt(low * low + F(1)), F(1) / np.sqrt(high * high + F(1))
    low_s, high_s = low * low_c, high * high_c
    total, everything = np.zeros_like(low), np.zeros_like(low)
    for f, weight in ground.points:
        cosine, sine = low_c + f * (high_c - low_c), low_s + f * (high_s - low_s)
        square = cosine * cosine + sine * sine
        from_zenith = half * cosine / (np.sqrt(square) + sine)
        u, v = half + from_zenith * c, half + from_zenith * s
        i, j = np.clip(u.astype(np.int32), 0, most), np.clip(v.astype(np.int32), 0, most)
        at = j * side + i
        p, q = u - i.astype(F), v - j.astype(F)
        near = sky[at] * (F(1) - p) + sky[at + 1] * p
        far = sky[at + side] * (F(1) - p) + sky[at + side + 1] * p
        share = weight / (square * square) * cosine * np.maximum(tilt * cosine + sine, F(0))
        length = np.sqrt(square)
        light = (near * (F(1) - q) + far * q) * _in_lobe(ground, pixels, c, s, cosine / length, sine / length)
        total += share * light
        everything += share
    return total / np.maximum(everything, F(1) / ENDLESS)


def _arctan(x: np.ndarray) -> Values:
    y = x * x
    total = np.full_like(x, CHORD_TANGENT[0])
    for factor in CHORD_TANGENT[1:]:
        total = total * y + factor
    return x * total


def _mean_cosine(a: np.ndarray, b: np.ndarray) -> Values:
    """Mean of the cosine over the sines between two near directions with cosines a and b.

    It is right to second order even at the zenith.
    """
    return (a * a + a * b + b * b) / np.maximum(F(1.5) * (a + b), F(1) / ENDLESS)


def _of_chords(
    chords: np.ndarray,
    c: np.ndarray,
    s: np.ndarray,
    tilt: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    by_cosine: np.ndarray,
    by_sine: np.ndarray,
) -> Values:
    turns, knots = chords.shape[:2]
    # 1. the cells of azimuth beside
    ratio = s / (np.abs(c) + np.abs(s))
    diamond = np.where(c < 0, F(2) - ratio, np.where(s < 0, F(4) + ratio, ratio))
    place = diamond * (F(0.25) * F(turns)) + F(0.5)
    after = np.minimum(place.astype(np.int32), turns)
    turn = (place - after.astype(F))[:, None]
    before, after = np.where(after > 0, after - 1, turns - 1), np.where(after < turns, after, 0)

    def blended(knot: np.ndarray) -> Values:
        return chords[before, knot] * (F(1) - turn) + chords[after, knot] * turn

    # 2. the knots below the ends
    steps = knots - 1
    low_c, high_c = F(steps) / np.sqrt(low * low + F(1)), F(steps) / np.sqrt(high * high + F(1))
    low_s, high_s = low * low_c, high * high_c
    i, j = (np.clip(sine.astype(np.int32), 0, steps - 1) for sine in (low_s, high_s))
    low_0, low_1, high_0, high_1 = (blended(knot) for knot in (i, i + 1, j, j + 1))

    def cosine_at(knot: np.ndarray) -> Values:
        return np.sqrt(((steps - knot) * (steps + knot)).astype(F))

    # 3. the even integrals: of both cells, and what of them lies below the ends
    def below(knot: np.ndarray, sine: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        by_sine = F(0.5) * (sine + knot.astype(F))
        return np.stack([_mean_cosine(cosine_at(knot), cosine), by_sine], -1)

    low_all, high_all = (below(knot, (knot + 1).astype(F), cosine_at(knot + 1)) for knot in (i, j))
    low_part, high_part = (
        (sine - knot.astype(F))[:, None] * below(knot, sine, cosine)
        for knot, sine, cosine in ((i, low_s, low_c), (j, high_s, high_c))
    )
    # 4. brightness there; in one cell or two neighbours the closed forms leave short chords all digits
    here, there = (low_0 - low_1) / low_all, (high_0 - high_1) / high_all
    few = here * (F(steps) * F(steps)) * np.stack([by_cosine, by_sine], -1) + (there - here) * high_part
    many = (low_1 - high_0) + here * (low_all - low_part) + there * high_part
    light = np.where((j <= i + 1)[:, None], few, many)
    return tilt * light[:, 0] + light[:, 1]


def _chord(
    ground: Map,
    pixels: Pixels,
    c: np.ndarray,
    s: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    rise: np.ndarray,
) -> np.ndarray:
    out = np.zeros_like(low)
    n = np.flatnonzero(low < high)
    pixels, c, s, low, high, rise = pixels.of(n), c[n], s[n], low[n], high[n], rise[n]
    tilt, product = pixels.tilt_x * c + pixels.tilt_y * s, low * high
    r = np.sqrt((low * low + F(1)) * (high * high + F(1)))
    sine = rise / r
    by_cosine = _arctan(rise / (r + F(1) + product)) + F(0.5) * ((F(1) - product) / r * sine)
    by_sine = F(0.5) * ((low + high) / r * sine)
    if ground.chords.shape[1]:
        out[n] = _of_chords(ground.chords, c, s, tilt, low, high, by_cosine, by_sine)
    else:
        light = _brightness_of(ground, pixels, c, s, tilt, low, high) if len(ground.points) else F(1)
        out[n] = light * (tilt * by_cosine + by_sine)
    return out


def _to_wall(ends: int, at: np.ndarray, along: Any) -> np.ndarray:
    way = np.where(along > 0, F(ends) - F(0.5) - at.astype(F), F(-0.5) - at.astype(F))
    return np.where(along == 0, ENDLESS, way / along)


def _to_rim(
    ground: Map,
    pixels: Pixels,
    c: np.ndarray,
    s: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    rise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    least, up = F(1) - ground.rim, pixels.mirror_z
    in_plane = pixels.mirror_x * c + pixels.mirror_y * s
    square = in_plane * in_plane + up * up - least * least
    half = np.sqrt(np.maximum(square, F(0)))  # of the chord: least is to it as cosine to sine
    low_c, low_s = in_plane * least + up * half, up * least - in_plane * half
    high_c, high_s = in_plane * least - up * half, up * least + in_plane * half
    other = np.where(up > 0, STEEP, -STEEP)
    start, stop = np.where(low_c > 0, low_s / low_c, other), np.where(high_c > 0, high_s / high_c, other)
    low, high = np.maximum(before, start), np.where(square > 0, np.minimum(after, stop), -STEEP)
    return low, high, np.where((start > before) | (stop < after), high - low, rise)


def _light(
    ground: Map,
    pixels: Pixels,
    c: np.ndarray,
    s: np.ndarray,
    along: np.ndarray,
    aside: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    rise: np.ndarray,
) -> np.ndarray:
    if len(ground.lobe):
        low, high, rise = _to_rim(ground, pixels, c, s, low, high, rise)
    # 1. the tangent plane and the level
    slope = np.clip(np.maximum(low, -(pixels.tilt_x * c + pixels.tilt_y * s)), F(0), STEEP)
    if not ground.dark:
        slope = _horizon(ground, pixels, c, s, slope, high, along, aside)
        return _chord(ground, pixels, c, s, slope, high, np.where(slope > low, high - slope, rise))
    # 2. the wall hides all ground beyond it: tangents up to `under`, and from `over` on, but none from its
    # top on
    wall = np.minimum(_to_wall(ground.cols, pixels.x, c), _to_wall(ground.rows, pixels.y, s))
    top = -pixels.height / wall
    if pixels.radius > 0:
        offset = wall - along
        square = pixels.radius * pixels.radius - aside * aside - offset * offset
        half = np.sqrt(np.maximum(square, F(0)))  # of where the wall cuts the ball

        def before(tangent: np.ndarray) -> Values:
            return (pixels.reach > 0) & (wall * (along + tangent * pixels.up) < pixels.reach)

        under = np.where(before(slope), np.where(square > 0, (pixels.up - half) / wall, ENDLESS), -ENDLESS)
        over = np.where(before(high) & (square > 0), (pixels.up + half) / wall, ENDLESS)
    else:
        up = np.where(pixels.up == 0, F(1) / ENDLESS, pixels.up)
        meets = (pixels.reach / wall - along) / up
        under = np.where(up > 0, ENDLESS if pixels.radius < 0 else meets, -ENDLESS)
        over = np.where(up > 0, ENDLESS, meets)
    slope = np.maximum(slope, np.minimum(under, top))
    split = over < top
    left = np.where(split, np.minimum(high, over), high)
    slope = _horizon(ground, pixels, c, s, slope, np.where(split & (high <= top), left, high), along, aside)
    total = _chord(
        ground, pixels, c, s, slope, left, np.where((slope > low) | (left < high), left - slope, rise)
    )
    above = np.maximum(slope, top)
    return total + np.where(split, _chord(ground, pixels, c, s, above, high, high - above), F(0))


def _sum(
    ground: Map,
    pixels: Pixels,
    blocks: np.ndarray,
    most: int,
    factor: float,
    irradiance: np.ndarray,
    slices_of: Callable[[np.ndarray, int], tuple[Any, ...]],
    alternating: np.ndarray | None = None,
) -> None:
    """Fill irradiance from slices_of(indices of pixels, their number of slices).

    That gives (share, along, aside, low, high, rise, c, s), (pixels, slices) or what broadcasts.
    """
    irradiance[...] = 0
    if alternating is not None:
        alternating[...] = 0
    for block in np.unique(blocks):
        some = np.flatnonzero(blocks == block)
        count = int(block) * SLICES
        for part in np.array_split(some, -(-len(some) * count // SLICES_PER_BATCH)):
            here = pixels.of(part)
            share, along, aside, low, high, rise, c, s = slices_of(part, count)
            shape = len(part), count
            light = _light(
                ground,
                here.of(np.repeat(np.arange(len(part)), count)),
                *(np.broadcast_to(value, shape).ravel() for value in (c, s, along, aside, low, high, rise)),
            )
            scale = np.sqrt(F(1) + here.tilt_x * here.tilt_x + here.tilt_y * here.tilt_y)
            light = share * light.reshape(shape)
            irradiance[here.y, here.x] = F(factor) * light.sum(1, dtype=F) / scale
            if alternating is not None:
                difference = (light[:, ::2] - light[:, 1::2]).sum(1, dtype=F)
                alternating[here.y, here.x] = F(factor) * difference / scale


def _columns(values: Nodes, part: np.ndarray) -> Nodes:
    """The nodes ``part`` of a tuple of arrays, as columns: a row per node, a column per slice."""
    return type(values)._make(value[part, None] for value in values)


def _turned(axes: Disc | Frame, cos_d: np.ndarray, sin_d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosine and sine of azimuths that lie an angle (cos_d, sin_d) beside the axes of the nodes."""
    return axes.ux * cos_d - axes.uy * sin_d, axes.uy * cos_d + axes.ux * sin_d


class Disc(NamedTuple):
    """The disc of directions that a ball covers, one element per node.

    Its middle: azimuth (ux, uy), elevation (sin_e, cos_e), distance along the ground. Its half angle (sin_a,
    cos_a). ``widest``: the sine of the greatest angle of azimuth beside the middle. Flags.
    """

    ux: np.ndarray
    uy: np.ndarray
    sin_e: np.ndarray
    cos_e: np.ndarray
    distance: np.ndarray
    sin_a: np.ndarray
    cos_a: np.ndarray
    widest: np.ndarray
    all_round: np.ndarray
    inside: np.ndarray
    seen: np.ndarray


def _within_disc(
    widest: np.ndarray, all_round: np.ndarray, quadrature: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of ``count`` slices of discs: cosine and sine from the middle, share, relative length of the chord."""
    step = F(np.pi) / F(count)
    row = quadrature[count // SLICES - 1, :, :count]
    sin_d = np.where(all_round, row[2], widest * row[0])
    cos_d = np.where(all_round, row[3], np.sqrt((F(1) - sin_d) * (F(1) + sin_d)))
    # the cosine is no less but where there is no chord
    narrow = widest * step * row[1] / np.maximum(cos_d, F(1e-6))
    return cos_d, sin_d, np.where(all_round, F(2) * step, narrow), row[1]


def _disc_slices(disc: Disc, quadrature: np.ndarray, part: np.ndarray, count: int) -> tuple[Any, ...]:
    """The slices that _sum adds: ``count`` of the discs of the nodes ``part``."""
    here = _columns(disc, part)
    cos_d, sin_d, share, chord = _within_disc(here.widest, here.all_round, quadrature, count)
    square = here.sin_a * here.sin_a - here.cos_e * here.cos_e * (sin_d * sin_d)
    half = np.where(here.all_round, np.sqrt(np.maximum(square, F(0))), here.sin_a * chord)
    in_plane = here.cos_e * cos_d
    square = in_plane * in_plane + here.sin_e * here.sin_e
    low_c, low_s = in_plane * here.cos_a + here.sin_e * half, here.sin_e * here.cos_a - in_plane * half
    high_c, high_s = in_plane * here.cos_a - here.sin_e * half, here.sin_e * here.cos_a + in_plane * half
    low = np.where(low_c > 0, low_s / low_c, np.where(low_s > 0, STEEP, -STEEP))
    high = np.where(high_c > 0, high_s / high_c, np.where(here.sin_e > 0, STEEP, -STEEP))
    low = np.where(here.inside, -STEEP, low)
    high = np.where(here.inside | (high > STEEP), STEEP, high)
    rise = np.where(
        (low_c > 0) & (high < STEEP), F(2) * here.cos_a * half * square / (low_c * high_c), high - low
    )
    high = np.where(here.seen, high, -STEEP)
    along, aside = here.distance * cos_d, here.distance * sin_d
    return share, along, aside, low, high, rise, *_turned(here, cos_d, sin_d)


def ball(
    heights: np.ndarray,
    tops: np.ndarray,
    quadrature: np.ndarray,
    sky: np.ndarray,
    points: np.ndarray,
    lobe: np.ndarray,
    chords: np.ndarray,
    irradiance: np.ndarray,
    alternating: np.ndarray,
    rows: int,
    cols: int,
    width: int,
    levels: int,
    least: int,
    most: int,
    side: int,
    n_points: int,
    n_lobe: int,
    n_turns: int,
    n_knots: int,
    dark: int,
    rim: float,
    highest: float,
    x0: float,
    y0: float,
    z0: float,
    radius: float,
    factor: float,
) -> None:
    radius_ = F(radius)
    nodes_with_ground = x, y, height, *_ = _pixels(heights, rows, cols)
    # 1. where the ball stands, and how many slices it is worth
    dx, dy, dz = F(x0) - x.astype(F), F(y0) - y.astype(F), F(z0) - height
    flat = np.sqrt(dx * dx + dy * dy)
    far = np.sqrt(flat * flat + dz * dz)
    inside = far <= radius_
    ux, uy = np.where(flat > 0, dx / flat, F(1)), np.where(flat > 0, dy / flat, F(0))
    sin_e, cos_e = np.where(far > 0, dz / far, F(1)), np.where(far > 0, flat / far, F(0))
    beyond = np.where(inside, F(0), (far - radius_) * (far + radius_))
    sin_a, cos_a = np.where(inside, F(1), radius_ / far), np.where(inside, F(0), np.sqrt(beyond) / far)
    all_round = sin_a >= cos_e
    widest = np.where(all_round, F(1), sin_a / cos_e)
    blocks = _blocks(np.where(all_round, F(1), _turn_by_sine(widest)), least, most)
    pixels = Pixels(*nodes_with_ground, dz, beyond, radius_)
    seen = inside | (dz + radius_ > 0)

    # 2. its slices
    disc = Disc(ux, uy, sin_e, cos_e, flat, sin_a, cos_a, widest, all_round, inside, seen)
    shown = points[:n_points], lobe[:n_lobe], chords[:n_turns, :n_knots], F(rim), F(highest)
    ground = Map(heights, tops, sky, *shown, rows, cols, levels, dark)
    slices_of = lambda part, count: _disc_slices(disc, quadrature, part, count)
    _sum(ground, pixels, blocks, most, factor, irradiance, slices_of, alternating)


def _sector_between(ax: np.ndarray, ay: np.ndarray, bx: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Azimuths between two directions: the bisector c, s, and the tangent of a quarter of the angle."""
    length_a = np.sqrt(ax * ax + ay * ay)
    product = length_a * np.sqrt(bx * bx + by * by)
    cosine, sine = ax * bx + ay * by, ax * by - ay * bx  # times product
    half = np.where(
        cosine < 0,
        (product - cosine) / np.maximum(sine, F(1e-7) * product),
        np.maximum(sine, F(0)) / (product + np.maximum(cosine, F(0))),
    )
    r = np.sqrt(F(1) + half * half)
    scale = F(1) / (r * length_a)
    return np.stack([(ax - ay * half) * scale, (ay + ax * half) * scale, half / (F(1) + r)])


def _turn_by_sine(sine: np.ndarray) -> Values:
    """About the share of the circle of an angle, by the sine of its half."""
    return sine * (TURN_BY_SINE[0] + TURN_BY_SINE[1] * sine * sine)


def _blocks(turn: np.ndarray, least: int, most: int) -> np.ndarray:
    """Blocks of slices that sources of so much of the circle are worth."""
    return np.minimum((least + (turn * F(most - least)).astype(np.int32)) // SLICES, most // SLICES)


def _turn_by_tangent(quarter: np.ndarray) -> Values:
    """About the share of the circle of an angle, by the tangent of its quarter; up to half the circle."""
    return quarter * (TURN_BY_TANGENT[0] - TURN_BY_TANGENT[1] * quarter * quarter)


class Outline(NamedTuple):
    """A quadrangle relative to the nodes, in the frame that points below its middle.

    One element per node, except ``up``. ``away``, ``ax``, ``ay`` (4, nodes): the corners from the middle
    along the frame, and from the node along and across it. ``up`` (4): above the middle.
    """

    away: np.ndarray
    ax: np.ndarray
    ay: np.ndarray
    up: np.ndarray
    left: np.ndarray
    within: np.ndarray


class Frame(NamedTuple):
    """Where the middle of a quadrangle stands, one element per node.

    Azimuth (ux, uy), distance along the ground, height. The plane's normal along the frame and across it,
    and upwards, turned away from the node by ``sense``. ``seen``: a face of it is visible from the node.
    """

    ux: np.ndarray
    uy: np.ndarray
    distance: np.ndarray
    dz: np.ndarray
    normal_x: np.ndarray
    normal_y: np.ndarray
    normal_z: np.ndarray
    sense: np.ndarray
    seen: np.ndarray


def _sectors_of(outline: Outline, right: np.ndarray) -> np.ndarray:
    """(4, 3, nodes): the sectors of azimuth between the corners, as _sector_between gives them."""
    within = outline.within
    back = right & within
    px, py = np.where(back, outline.ax[::-1], outline.ax), np.where(back, outline.ay[::-1], outline.ay)
    for i, j in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):
        swap = ~within & (px[i] * py[j] - py[i] * px[j] < 0)
        for p in (px, py):
            p[i], p[j] = np.where(swap, p[j], p[i]), np.where(swap, p[i], p[j])
    sectors = np.stack([_sector_between(px[k], py[k], px[(k + 1) % 4], py[(k + 1) % 4]) for k in range(4)])
    sectors[3, 2] = np.where(within, sectors[3, 2], F(0))
    return sectors


def _shared_out(sectors: np.ndarray, least: int, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(blocks of slices, (3, nodes) where sectors end among them, whether there is any) per node."""
    to = np.cumsum(_turn_by_tangent(sectors[:, 2]), 0, dtype=F)
    blocks = _blocks(to[3], least, most)
    narrow = F(1e-4) * to[3]  # a sector below that is left out
    # an eighth of the slices for every sector, the rest by width: below a slit narrow sectors have most light
    used = blocks * np.cumsum(np.concatenate([to[:1], to[1:] - to[:-1]]) > narrow, 0)
    more = np.where(to[3] > 0, (blocks * SLICES - used[3]).astype(F) / to[3], F(0))
    return blocks, used[:3] + (to[:3] * more + F(0.5)).astype(np.int32), to[3] > 0


def _sector_slices(
    sectors: np.ndarray, ends: np.ndarray, quadrature: np.ndarray, part: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(cosine, sine, share) of the slices of the nodes ``part``, about the frame's axis."""
    number = np.arange(count)[None]
    bounds = np.concatenate([np.zeros((1, len(part)), int), ends[:, part], np.full((1, len(part)), count)])
    which = (number[None] >= bounds[1:4, :, None]).sum(0)
    axis_c, axis_s, quarter = (np.take_along_axis(sectors[:, k, part].T, which, 1) for k in range(3))
    first = np.take_along_axis(bounds[:4].T, which, 1)
    many = np.take_along_axis(bounds[1:].T, which, 1) - first
    node, weight = np.moveaxis(quadrature[many - 1, number - first], -1, 0)
    tangent = quarter * node  # of half the angle from the bisector
    scale = F(1) / (F(1) + tangent * tangent)
    cos_t, sin_t = (F(1) - tangent * tangent) * scale, F(2) * tangent * scale
    cos_d, sin_d = axis_c * cos_t - axis_s * sin_t, axis_s * cos_t + axis_c * sin_t
    return cos_d, sin_d, F(2) * quarter * weight * scale


def _crossings(
    outline: Outline, part: np.ndarray, cos_d: np.ndarray, sin_d: np.ndarray
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Where slices cross the outline: (distance, height, whether they do) to the left, and to the right.

    Distance and height are from the middle.
    """
    shape = cos_d.shape
    left_r, left_z, right_r, right_z = (np.zeros(shape, F) for _ in range(4))
    has_left, has_right = np.zeros(shape, bool), np.zeros(shape, bool)
    away, ax, ay = (corners[:, part, None] for corners in outline[:3])
    side_of = [cos_d * ay[i] - sin_d * ax[i] for i in range(4)]
    r_of = [cos_d * away[i] + sin_d * ay[i] for i in range(4)]
    for i in range(4):
        j = (i + 1) % 4
        f = side_of[i] / (side_of[i] - side_of[j])
        r = r_of[i] + f * (r_of[j] - r_of[i])
        z = outline.up[i] + f * (outline.up[j] - outline.up[i])
        to_left, to_right = (side_of[i] <= 0) & (side_of[j] > 0), (side_of[j] <= 0) & (side_of[i] > 0)
        left_r, left_z = np.where(to_left, r, left_r), np.where(to_left, z, left_z)
        right_r, right_z = np.where(to_right, r, right_r), np.where(to_right, z, right_z)
        has_left |= to_left
        has_right |= to_right
    return (left_r, left_z, has_left), (right_r, right_z, has_right)


def _quadrangle_slices(
    outline: Outline,
    frame: Frame,
    sectors: np.ndarray,
    ends: np.ndarray,
    quadrature: np.ndarray,
    part: np.ndarray,
    count: int,
) -> tuple[Any, ...]:
    """The slices that _sum adds: ``count`` of the quadrangle at the nodes ``part``."""
    cos_d, sin_d, share = _sector_slices(sectors, ends, quadrature, part, count)
    (left_r, left_z, has_left), (right_r, right_z, has_right) = _crossings(outline, part, cos_d, sin_d)
    here = _columns(frame, part)
    within, left = outline.within[part, None], outline.left[part, None]
    in_plane, dz, over = here.distance * cos_d, here.dz, here.sense * here.normal_z > 0
    to_left, to_right = np.maximum(in_plane + left_r, F(1e-10)), np.maximum(in_plane + right_r, F(1e-10))
    steep_left, steep_right = (dz + left_z) / to_left, (dz + right_z) / to_right
    edge = np.where(left, steep_left, steep_right)
    wide = dz * (right_r - left_r) + in_plane * (left_z - right_z) + left_z * right_r - right_z * left_r
    low = np.where(wide > 0, steep_right, steep_left)
    low = np.where(within, np.where(over, np.minimum(edge, STEEP), -STEEP), low)
    high = np.where(wide > 0, steep_left, steep_right)
    high = np.where(within, np.where(over, STEEP, edge), high)
    rise = np.where(high < STEEP, np.abs(wide) / (to_left * to_right), STEEP - low)
    rise = np.where(within, high - low, rise)
    has = np.where(within, np.where(left, has_left, has_right), has_left & has_right)
    high = np.where(has & here.seen, np.minimum(high, STEEP), -STEEP)
    along = here.sense * (here.normal_x * cos_d + here.normal_y * sin_d)
    return np.where(here.seen, share, F(0)), along, F(0), low, high, rise, *_turned(here, cos_d, sin_d)


def quad(
    heights: np.ndarray,
    tops: np.ndarray,
    corners: np.ndarray,
    quadrature: np.ndarray,
    sky: np.ndarray,
    points: np.ndarray,
    lobe: np.ndarray,
    chords: np.ndarray,
    irradiance: np.ndarray,
    rows: int,
    cols: int,
    width: int,
    levels: int,
    least: int,
    most: int,
    side: int,
    n_points: int,
    n_lobe: int,
    n_turns: int,
    n_knots: int,
    dark: int,
    rim: float,
    highest: float,
    factor: float,
) -> None:
    nodes_with_ground = x, y, height, *_ = _pixels(heights, rows, cols)
    # 1. the corners, in the frame that points below the middle
    dx, dy, dz = corners[4, 0] - x.astype(F), corners[4, 1] - y.astype(F), corners[4, 2] - height
    flat = np.sqrt(dx * dx + dy * dy)
    ux, uy = np.where(flat > 0, dx / flat, F(1)), np.where(flat > 0, dy / flat, F(0))
    away = corners[:4, :1] * ux + corners[:4, 1:2] * uy  # from the middle
    ay = corners[:4, 1:2] * ux - corners[:4, :1] * uy
    up = corners[:4, 2]
    ax = flat + away
    ax[(ax == 0) & (ay == 0)] = 1e-6
    top = (dz + up[:, None]).max(0)
    turn = ax * (np.roll(ay, -1, 0) - ay) - ay * (np.roll(ax, -1, 0) - ax)
    left, right = (turn >= 0).all(0), (turn <= 0).all(0)
    within = left != right  # the zenith or the nadir lies in the quadrangle
    normal_x, normal_y = corners[5, 0] * ux + corners[5, 1] * uy, corners[5, 1] * ux - corners[5, 0] * uy
    apart = flat * normal_x + dz * corners[5, 2]
    sense = np.where(apart < 0, F(-1), F(1))
    pixels = Pixels(*nodes_with_ground, sense * corners[5, 2], sense * apart, F(0))
    outline = Outline(away, ax, ay, up, left, within)

    # 2. sectors, and how many slices they are worth
    sectors = _sectors_of(outline, right)
    blocks, ends, some = _shared_out(sectors, least, most)
    seen = some & (top >= 0) & (within | (apart != 0))  # from its own plane it is a line

    # 3. the slices
    normal_z = np.broadcast_to(corners[5, 2], flat.shape)
    frame = Frame(ux, uy, flat, dz, normal_x, normal_y, normal_z, sense, seen)
    shown = points[:n_points], lobe[:n_lobe], chords[:n_turns, :n_knots], F(rim), F(highest)
    ground = Map(heights, tops, sky, *shown, rows, cols, levels, dark)
    slices_of = lambda part, count: _quadrangle_slices(outline, frame, sectors, ends, quadrature, part, count)
    _sum(ground, pixels, blocks, most, factor, irradiance, slices_of)


def gloss(
    heights: np.ndarray,
    tops: np.ndarray,
    quadrature: np.ndarray,
    sky: np.ndarray,
    points: np.ndarray,
    lobe: np.ndarray,
    irradiance: np.ndarray,
    rows: int,
    cols: int,
    width: int,
    levels: int,
    least: int,
    most: int,
    side: int,
    n_points: int,
    n_lobe: int,
    dark: int,
    rim: float,
    highest: float,
    reach: float,
    factor: float,
) -> None:
    ground = _pixels(heights, rows, cols)
    mirror_x, mirror_y = ground[5:7]
    # 1. where the disc stands, and how many slices it is worth
    flat = np.sqrt(mirror_x * mirror_x + mirror_y * mirror_y)
    ux, uy = np.where(flat > 0, mirror_x / flat, F(1)), np.where(flat > 0, mirror_y / flat, F(0))
    sin_a = np.sqrt(F(rim) * (F(2) - F(rim)))
    all_round = sin_a >= flat
    widest = np.where(all_round, F(1), sin_a / flat)
    blocks = _blocks(np.where(all_round, F(1), _turn_by_sine(widest)), least, most)
    pixels = Pixels(*ground, np.zeros_like(flat), np.full_like(flat, reach), F(-1))

    # 2. its slices
    def slices_of(part: np.ndarray, count: int) -> tuple[Any, ...]:
        x, y, width, whole = (value[part, None] for value in (ux, uy, widest, all_round))
        cos_d, sin_d, share, _ = _within_disc(width, whole, quadrature, count)
        return share, F(1), F(0), -STEEP, STEEP, F(2) * STEEP, x * cos_d - y * sin_d, y * cos_d + x * sin_d

    shown = points[:n_points], lobe[:n_lobe], np.zeros((0, 0, 2), F), F(rim), F(highest)
    ground_map = Map(heights, tops, sky, *shown, rows, cols, levels, dark)
    _sum(ground_map, pixels, blocks, most, factor, irradiance, slices_of)


def _bare(heights: np.ndarray, tops: np.ndarray, highest: float, rows: int, cols: int, levels: int) -> Map:
    nothing = np.zeros(0, F)
    return Map(heights, tops, nothing, nothing, nothing, nothing, F(0), F(highest), rows, cols, levels, 0)


def rays(
    heights: np.ndarray,
    tops: np.ndarray,
    ways: np.ndarray,
    seen: np.ndarray,
    rows: int,
    cols: int,
    width: int,
    levels: int,
    count: int,
    highest: float,
) -> None:
    ground = _pixels(heights, rows, cols)
    y, x = ground[1], ground[0]
    # along a ray ground counts up to t / reach = 1
    pixels = Pixels(*ground, np.zeros(len(x), F), np.ones(len(x), F), F(-1))
    bare = _bare(heights, tops, highest, rows, cols, levels)
    for j in range(count):
        c, s, tangent, reach = (np.ascontiguousarray(ways[y, x, k, j]) for k in range(4))
        above = tangent + F(1e-6) * (F(1) + np.abs(tangent))  # so that one obstacle is enough
        slope = _horizon(bare, pixels, c, s, tangent, above, F(1) / reach, np.zeros_like(c))
        seen[y, x, j] = np.where(slope > tangent, F(0), F(1))


def _between(
    at: np.ndarray, low: np.float32, high: np.float32, along: np.float32
) -> tuple[np.ndarray, np.ndarray]:
    """The distances between which a way from ``at``, ``along`` its part there, is within low..high."""
    ends = (low - at.astype(F)) / along, (high - at.astype(F)) / along
    if along == 0:
        nowhere = np.where((low <= at) & (at < high), -ENDLESS, ENDLESS)
        return nowhere, -nowhere
    return ends if along > 0 else ends[::-1]


def _light_above(
    table: np.ndarray, first: np.float32, scale: np.float32, tangent: np.ndarray, tilt: np.ndarray
) -> Values:
    """The light of a sector above a tangent."""
    at = np.maximum((tangent / (tangent + F(1)) - first) * scale, F(0))
    knot = np.minimum(at.astype(np.int32), len(table) - 2)
    part = np.minimum(at - knot.astype(F), F(1))
    by_cosine, by_sine, more_cosine, more_sine = table[knot].T
    return tilt * (by_cosine + part * more_cosine) + (by_sine + part * more_sine)


def sectors(
    heights: np.ndarray,
    tops: np.ndarray,
    ways: np.ndarray,
    table: np.ndarray,
    irradiance: np.ndarray,
    other: np.ndarray,
    rows: int,
    cols: int,
    width: int,
    levels: int,
    count: int,
    knots: int,
    dark: int,
    image_rows: int,
    image_cols: int,
    highest: float,
    farthest: float,
    x0: float,
    x1: float,
    y0: float,
    y1: float,
) -> None:
    frame_x, frame_y = (F(x0), F(x1)), (F(y0), F(y1))
    every = x, y, *_ = _pixels(heights, rows, cols)
    # ground counts up to t x along = 1
    pixels = Pixels(*every, np.zeros(len(x), F), np.ones(len(x), F), F(-1))
    pixels, repeats = pixels.of((x < image_cols) & (y < image_rows)), image_cols < cols
    x, y, height, tilt_x, tilt_y = pixels[:5]
    framed = any(low > -ENDLESS or high < ENDLESS for low, high in (frame_x, frame_y))

    def flat(value: float | np.float32) -> np.ndarray:
        return np.full(len(x), value, F)

    totals, bare = np.zeros((2, len(x)), F), _bare(heights, tops, highest, rows, cols, levels)
    for j, (c, s, share, first, scale, to_other) in enumerate(ways.T):
        last = first + F(knots - 1) / scale
        low, high = (at / max(F(1) - at, F(1e-6)) for at in (first, last))
        # farther on, a ray is above all ground
        along = max(low, F(1e-6)) / np.maximum(F(highest) - height, F(1e-6))
        along = np.maximum(along, F(1) / F(farthest))
        tilt = tilt_x * c + tilt_y * s
        # 1. the tangent plane, the level, the wall, the window, and the ground
        slope, end = np.maximum(-tilt, low), flat(STEEP)
        if dark:
            slope = np.maximum(slope, -height / np.minimum(_to_wall(cols, x, c), _to_wall(rows, y, s)))
        if framed:
            by_x, by_y = _between(x, *frame_x, c), _between(y, *frame_y, s)
            near, far = np.maximum(np.maximum(by_x[0], by_y[0]), F(0)), np.minimum(by_x[1], by_y[1])
            passes = (near < far) & (height < 0)
            slope = np.where(passes, np.maximum(slope, -height / far), slope)
            end = np.where(passes, np.where(near > 0, np.minimum(-height / near, STEEP), STEEP), -STEEP)
        way = flat(c), flat(s)
        if repeats:
            periods = image_rows, image_cols
            slope = _repeated_horizon(bare, pixels, periods, *way, slope, flat(high), along)
        else:
            slope = _horizon(bare, pixels, *way, slope, np.minimum(high, end), along, flat(0))
        # 2. the light above it
        light = _light_above(table[j], first, scale, slope, tilt)
        if framed:
            past = np.where(end < STEEP, _light_above(table[j], first, scale, end, tilt), F(0))
            light = np.where(slope < end, light - past, F(0))
        totals[int(to_other)] += share * light
    for image, total in zip((irradiance, other), totals):
        image[y, x] += total / np.sqrt(F(1) + tilt_x * tilt_x + tilt_y * tilt_y)
