"""Horizons, and the light of a sky above them, in NumPy: twin of opencl/horizon.cl.

Float32 and int32 operations in the order of the OpenCL kernels, a product and its sum rounded one after the
other, so that slopes are the same bits as on a CPU. A step for one node there is one for the whole map
here, and a step for one line is one for all lines of an azimuth; only the ladder goes from row to row. Steps
are numbered as in opencl/horizon.cl.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ... import constants
from ...constants import ANGLES, DARK, LADDER, PERIODIC, SLOPES, TABLE, UNSEEN

NONE, HIGHEST_MASKED = np.float32(constants.NONE), np.float32(constants.HIGHEST_MASKED)
ONE, HALF, HALF_PI = np.float32(1), np.float32(0.5), np.float32(constants.HALF_PI)

Values = Any  # one per node, or one for all
WARM_UP = 2**18  # rays and rows at once: 2 MB of int64, chosen to stay in the cache


def sweep(
    heights: np.ndarray,
    tilts: np.ndarray,
    azimuths: np.ndarray,
    ways: np.ndarray,
    near_at: np.ndarray,
    near_weight: np.ndarray,
    table: np.ndarray,
    slopes: np.ndarray,
    sum: np.ndarray,
    steps: tuple[int, ...],
    rises: tuple[int, ...],
    falling_steps: tuple[int, ...],
    falling_rises: tuple[int, ...],
    first: int,
    group: int,
    rows: int,
    cols: int,
    margin: int,
    room: int,
    knots: int,
    bits: int,
    lowest: float,
    height_scale: float,
    falling_scale: float,
    known: int,
    backward: int,
    top: int,
    bottom: int,
    left: int,
    right: int,
    *,
    NEAR: int,
    SIDES: int,
    WHAT: int,
    FALLS: int,
    BLOCKS: int,
) -> None:
    """``group`` is how devices share out the lines; here all lines go together, azimuth by azimuth."""
    shared = bits, np.float32(lowest)
    rising = Ladder(np.array(steps, np.int32), np.array(rises, np.int32), *shared, np.float32(height_scale))
    falling = rising._replace(
        steps=np.array(falling_steps, np.int32),
        rises=np.array(falling_rises, np.int32),
        height_scale=np.float32(falling_scale),
    )
    # without slopes light is summed, azimuth by azimuth
    for plane in range(len(slopes) if slopes.ndim == 2 else 1):
        a = first + plane
        asked = (top, bottom, left, right)
        rays = Rays(heights, azimuths[a], ways[a], rows, cols, asked, margin, NEAR, SIDES, BLOCKS)
        lower, upper, highest, falls = _ladder(rays, rising, bool(BLOCKS and backward))
        if FALLS:
            below = _ladder(rays, falling, bool(BLOCKS and backward))
            lower, upper = np.where(falls, below[:2], (lower, upper))
        far = _far(rays, lower, upper, highest if FALLS else None)
        slope = np.fmax(far, _near(rays, near_at[a], near_weight[a])) * azimuths[a, 3]
        if SIDES == DARK:
            slope = np.maximum(slope, _wall(rays, azimuths[a, 3]))
        if WHAT == SLOPES or known:
            out = slopes[plane : plane + 1].reshape(rows, cols)[:: rays.towards][rays.asked]
            slope = np.maximum(slope, out) if known else slope
        if WHAT == SLOPES:
            out[...] = np.where(slope < np.float32(-1e20), -np.inf, slope)
        else:
            if WHAT == ANGLES:
                light = _angle(slope, azimuths[a, 4])
            else:
                light = _light(rays, tilts, slope, azimuths[a], table[a] if WHAT == TABLE else None, knots)
            out = sum[ways[a, 5]].reshape(rows, cols)[:: rays.towards][rays.asked]
            out += (light + HALF).astype(np.int32)


class Ladder(NamedTuple):
    """The slopes of the ladder, as heights per row and from the first, and how heights are quantized."""

    steps: np.ndarray
    rises: np.ndarray
    bits: int
    lowest: np.float32
    height_scale: np.float32

    def quantized(self, ground: np.ndarray) -> np.ndarray:
        whole: np.ndarray = np.maximum(ground - self.lowest, np.float32(0)) * self.height_scale
        return whole.astype(np.int32) << self.bits


class Rays:
    """The rays of one azimuth, from u rows on and column x: row y of the map, element p of heights.

    ``asked``: of the nodes whose rays these are the first row and the last's next, and columns likewise;
    kept as rows u and columns.
    """

    def __init__(
        self,
        heights: np.ndarray,
        azimuth: np.ndarray,
        way: np.ndarray,
        rows: int,
        cols: int,
        asked: tuple[int, int, int, int],
        margin: int,
        NEAR: int,
        SIDES: int,
        BLOCKS: int,
    ) -> None:
        self.heights, self.rows, self.cols, self.margin = heights, rows, cols, margin
        self.shear, self.reciprocal, self.reach = azimuth[0], azimuth[5], azimuth[6]
        self.steepness = abs(self.shear)
        self.towards, self.near_rows, self.near_columns, self.warm, self.window = (int(v) for v in way[:5])
        self.periodic, self.oblique = SIDES == PERIODIC, bool(self.reciprocal < 1e8)
        self.stride, self.nearest, self.blocks = cols + 2 * margin, NEAR, BLOCKS
        top, bottom, left, right = asked
        first, self.end = (top, bottom) if self.towards > 0 else (rows - bottom, rows - top)
        self.asked = slice(first, self.end), slice(left, right)
        self.u = np.arange(first, self.end, dtype=np.int32)[:, None]
        self.x = np.arange(left, right, dtype=np.int32)
        self.y = self.u if self.towards > 0 else rows - 1 - self.u
        self.p = (self.y + margin) * self.stride + margin + self.x
        self.own = heights[self.p]

    def place(self, x: np.ndarray, y: np.ndarray) -> Values:
        if self.periodic:
            x, y = x % self.cols, y % self.rows
        return (y + self.margin) * self.stride + self.margin + x

    def rise(self, at: np.ndarray, beyond: int, weight: Any, distance: Any) -> np.ndarray:
        """Slope from every node to its ray's crossing between elements ``at`` and ``at + beyond``."""
        a, b = self.heights[at], self.heights[at + beyond]
        slope: np.ndarray = (weight * (b - a) + (a - self.own)) * (ONE / distance)
        return slope

    def on_row(self, t: np.ndarray) -> np.ndarray:
        """The crossing with the row t rows on; nan for t = 0, which fmax drops."""
        distance = t.astype(np.float32)
        across = self.shear * distance
        n = np.floor(across)
        at = self.place(self.x + n.astype(np.int32), self.y - self.towards * t)
        slope = self.rise(at, 1, across - n, distance)
        return np.where(distance <= self.reach, slope, NONE) if self.blocks else slope

    def on_column(self, m: np.ndarray) -> np.ndarray:
        """The crossing with the column m columns on, if it is within reach."""
        distance = m.astype(np.float32) * self.reciprocal
        n = distance.astype(np.int32)
        before = n if self.periodic else np.minimum(n, self.u + 1)
        at = self.place(self.x + m if self.shear > 0 else self.x - m, self.y - self.towards * before)
        slope = self.rise(at, -self.towards * self.stride, distance - n.astype(np.float32), distance)
        return np.where(distance <= self.reach, slope, NONE) if self.blocks else slope


def _near(rays: Rays, near_at: np.ndarray, near_weight: np.ndarray) -> np.ndarray:
    """4. every near crossing"""
    near_at = near_at[:, 0] - rays.towards * rays.stride * near_at[:, 1]
    on_rows, on_columns = np.full((2, *rays.p.shape), NONE)
    for e in range(rays.near_rows if rays.blocks else rays.nearest):
        on_rows = np.fmax(on_rows, rays.rise(rays.p + near_at[e], 1, near_weight[e], np.float32(e + 1)))
    for e in range(rays.near_columns):
        at, weight = rays.p + near_at[rays.nearest + e], near_weight[rays.nearest + e]
        slope = rays.rise(at, -rays.towards * rays.stride, weight, np.float32(e + 1))
        on_columns = np.fmax(on_columns, slope)
    slopes: np.ndarray = np.fmax(on_rows, on_columns * np.maximum(rays.steepness, np.float32(1e-6)))
    return slopes


def _far(rays: Rays, lower: np.ndarray, upper: np.ndarray, highest: np.ndarray | None) -> np.ndarray:
    """6. and 7. the crossings at the distances that the ladder gives, and the column crossings beside them"""
    u, x, cols, reciprocal = rays.u, rays.x, rays.cols, rays.reciprocal
    # 6. both on the node's own ray, no farther than the map or the window goes
    last = np.broadcast_to(np.minimum(u + rays.warm, rays.window), rays.p.shape)
    if not rays.periodic and rays.oblique:
        to_side = (cols - 1 - x if rays.shear > 0 else x).astype(np.float32) * reciprocal
        before = to_side < np.minimum(u, rays.window).astype(np.float32)
        last = np.where(before, to_side.astype(np.int32), last)
    last = np.maximum(last, 1)
    t1, t2 = np.maximum(np.minimum(lower, last), 1), np.maximum(np.minimum(upper, last), 1)
    far: np.ndarray = np.fmax(rays.on_row(t1), rays.on_row(t2))
    if highest is not None:
        far = np.fmax(far, rays.on_row(np.maximum(np.minimum(highest, last), 1)))
    # 7. and the column crossings beside them: the nearer one's before, the farther one's behind
    if rays.oblique:
        m = (rays.steepness * t1.astype(np.float32)).astype(np.int32)
        far = np.fmax(far, np.fmax(rays.on_column(np.maximum(m, 1)), rays.on_column(m + 1)))
    if rays.blocks:  # downhill the end of the window is the horizon
        far = np.fmax(far, rays.on_row(last))
        if rays.oblique:
            end = np.minimum(rays.reach, (u + rays.warm).astype(np.float32))
            m = (rays.steepness * end).astype(np.int32)
            m = m if rays.periodic else np.minimum(m, cols - 1 - x if rays.shear > 0 else x)
            far = np.fmax(far, rays.on_column(np.maximum(m, 1)))
    return far


def _wall(rays: Rays, rows_per_spacing: np.float32) -> np.ndarray:
    """The slope to the top, at height 0, of a wall half a node outside the map."""
    to_side = 2 * (rays.cols - rays.x) - 1 if rays.shear > 0 else 2 * rays.x + 1
    wall = to_side.astype(np.float32) * (HALF * rays.reciprocal)
    slope: np.ndarray = -rays.own * rows_per_spacing / np.minimum(wall, rays.u.astype(np.float32) + HALF)
    return slope


def _light(
    rays: Rays,
    tilts: np.ndarray,
    slope: np.ndarray,
    azimuth: np.ndarray,
    table: np.ndarray | None,
    knots: int,
) -> np.ndarray:
    """8. the light between the horizon or the tangent plane and the zenith; no table: of a uniform sky"""
    cosine, sine, width = azimuth[1], azimuth[2], azimuth[4]
    gx, gy = tilts[0][rays.p], tilts[1][rays.p]
    along = gx * cosine + gy * sine
    limit = np.maximum(np.maximum(slope, -along), np.float32(0))
    if table is None:
        c2 = ONE / (limit * limit + ONE)
        c1 = HALF * (HALF_PI - np.arctan(limit) - limit * c2)
        c2 = c2 * HALF
    else:
        at = limit * (ONE / (limit + ONE)) * np.float32(knots - 1)
        knot = np.minimum(at.astype(np.int32), knots - 2)
        part, entry = at - knot.astype(np.float32), table[knot]
        c1, c2 = part * entry[..., 2] + entry[..., 0], part * entry[..., 3] + entry[..., 1]
    light: np.ndarray = (along * c1 + c2) * (width * (ONE / np.sqrt(gx * gx + (gy * gy + ONE))))
    return light


def _angle(slope: np.ndarray, width: np.float32) -> np.ndarray:
    """8. the angle from the zenith to the horizon, times the width; without ground the horizon is level"""
    angle: np.ndarray = width * (
        HALF_PI - np.arctan(np.where(slope < np.float32(-1e20), np.float32(0), slope))
    )
    return angle


def _lines(rays: Rays, backward: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1. the lines that pass the map, and from which row to which each is on the map"""
    cols = rays.cols
    overhang = 0 if rays.periodic else int(abs(rays.shear) * np.float32(rays.rows)) + 1
    origin = -overhang if rays.shear < 0 else 0
    line = np.arange(origin, cols + (overhang if rays.shear > 0 else 0), dtype=np.int32)
    start, stop = np.full_like(line, -rays.warm), np.full_like(line, rays.end)
    if not rays.periodic and rays.oblique:
        enters, leaves = (line - cols, line + 1) if rays.shear > 0 else (-line - 1, cols - line)
        start = np.maximum(np.floor(enters.astype(np.float32) * rays.reciprocal).astype(np.int32), 0)
        stop = np.minimum((leaves.astype(np.float32) * rays.reciprocal).astype(np.int32) + 2, rays.end)
    if backward:
        warm, window = rays.warm, rays.window
        start, stop = start - (start + warm) % window, stop + window - 1 - (stop - 1 + warm) % window
    return line, start, stop


def _rows_of(rays: Rays, ladder: Ladder, line: np.ndarray, comes: np.ndarray, comes_at: int) -> np.ndarray:
    """3. rows that come in (n, 1), where the lines cross them: quantized, with that distance"""
    grid = rays.heights.reshape(rays.rows + 2 * rays.margin, rays.cols + 2 * rays.margin)
    across = -rays.shear * comes.astype(np.float32)
    column = np.floor(across)
    at = line + column.astype(np.int32)
    # beyond the margin there is no ground
    at = at % rays.cols if rays.periodic else np.clip(at, -2, rays.cols)
    row = comes % rays.rows if rays.towards > 0 else (rays.rows - 1 - comes) % rays.rows
    a, b = grid[rays.margin + row, rays.margin + at], grid[rays.margin + row, rays.margin + at + 1]
    ground = np.where(a == NONE, b, np.where(b == NONE, a, a + (across - column) * (b - a)))
    return np.where(ground < np.float32(-1e20), np.int32(UNSEEN), ladder.quantized(ground) | comes_at)


def _climbed(rays: Rays, ladder: Ladder, line: np.ndarray, steps: np.ndarray, comes_at: int) -> np.ndarray:
    """3. the rays before the first row that is asked for, of a map that repeats: many rows at once"""
    above, steps = np.full((LADDER, len(line)), UNSEEN, np.int64), steps.astype(np.int64)
    first, many = rays.asked[0].start, max(WARM_UP // above.size, 1)
    for i in range(-rays.warm, first, many):
        u = np.arange(i, min(i + many, first))[:, None]
        seen = _rows_of(rays, ladder, line, u - comes_at, comes_at)
        climbed = seen + steps[:, None] * (u[-1] - u)
        above = np.maximum(above + steps * len(u), climbed.max(axis=1))
    return above.astype(np.int32)


def _ladder(rays: Rays, ladder: Ladder, backward: bool) -> tuple[np.ndarray, ...]:
    """Distances [rows] of the crossings of the two steps of the ladder between which each node lies.

    Of that of the first step, too, and whether the node lies below it: nothing stands above a ray of that
    slope.
    """
    rows, cols, x, warm, window = rays.rows, rays.cols, rays.x, rays.warm, rays.window
    first, here = rays.asked[0].start, np.arange(len(x))
    line, start, stop = _lines(rays, backward)
    level = ladder.quantized(rays.own)

    # 2. nothing visible yet
    above = np.full((LADDER, len(line)), UNSEEN, np.int32)
    steps, rises = (ladder.steps if backward else -ladder.steps)[:, None], ladder.rises[:, None]
    mask = (1 << ladder.bits) - 1
    comes_at = window if backward else rays.nearest + 1
    lower, upper, highest = np.empty((3, *rays.p.shape), np.int32)
    falls = np.empty(rays.p.shape, bool)
    begin = start.min()
    if rays.periodic and not rays.blocks:
        above, begin = _climbed(rays, ladder, line, steps, comes_at), first
    for i in range(begin, stop.max()):
        u, into = i, 1
        if rays.blocks:
            into = (i + warm) % window
            u = i - 2 * into + window - 1 if backward else i
        # 3. the row that comes in; then every ray climbs (or, backward, falls) by one row
        if into == 0:
            above[...] = UNSEEN
        comes = u - comes_at
        seen = np.full(len(line), UNSEEN, np.int32)
        if (rays.periodic or 0 <= comes < rows) and (not rays.blocks or backward or into > rays.nearest):
            seen = _rows_of(rays, ladder, line, np.array([[comes]]), comes_at)[0]
        going = (start <= i) & (i < stop)
        above = np.where(going, np.maximum(above + steps, seen), above)
        if not first <= u < rays.end:
            continue
        # 5. the two steps of the ladder between which each node lies, by bisection; above[s] is rises[s] too
        # high
        of = x - int(np.floor(HALF - rays.shear * np.float32(u)))
        heard = above[:, of % cols if rays.periodic else of - line[0]]
        test = heard >= level[u - first] + rises
        highest[u - first], falls[u - first] = heard[0] & mask, ~test[0]
        s = np.zeros(len(x), np.int32)
        for half in (8, 4, 2, 1):
            s += half * test[s + half, here]
        lower[u - first] = heard[s, here] & mask
        upper[u - first] = heard[np.minimum(s + 1, LADDER - 1), here] & mask
    return lower, upper, highest, falls
