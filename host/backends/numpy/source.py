"""The kernels of `source` in NumPy: twin of opencl/source.cl and warp_kernels/source.py."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np

from ...constants import APERTURE, BALL, DARK, OPEN, PERIODIC, RECTANGLE, SKY, VOLUME

Values = Any  # one per node, or one for all


def _within(w: np.ndarray, k: int, low: float, high: float, period: float, sides: int) -> Values:
    if sides != PERIODIC:
        return (k * low <= w) & (w < k * high)
    v, lap = w - k * low, k * period
    return v - np.floor(v / lap) * lap < k * (high - low)


def _leaves_box(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, i: int, j: int, climb: float, rows: int, cols: int
) -> Values:
    u, v = 2 * (x * climb + i * z), 2 * (y * climb + j * z)
    return (-climb <= u) & (u < (2 * cols - 1) * climb) & (-climb <= v) & (v < (2 * rows - 1) * climb)


def _meets_plane(
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    i: int,
    j: int,
    k: int,
    numbers: np.ndarray,
    flags: np.ndarray,
    rows: int,
    cols: int,
    kind: int,
    sides: int,
    step: float,
) -> np.ndarray:
    if k == 0:
        return np.full(z.shape, kind == SKY and sides != DARK)
    climb = k * step
    on = _leaves_box(x, y, z, i, j, climb, rows, cols) if sides == DARK else np.ones(z.shape, bool)
    u, v = x * climb + i * z, y * climb + j * z
    if kind == RECTANGLE:
        x0, x1, y0, y1 = numbers
        on &= _within(u, k, x0, x1, cols * step, sides) & _within(v, k, y0, y1, rows * step, sides)
    if kind == APERTURE:
        col, row = np.floor((2 * u + climb) / (2 * climb)), np.floor((2 * v + climb) / (2 * climb))
        if sides == PERIODIC:
            col, row = col - np.floor(col / cols) * cols, row - np.floor(row / rows) * rows
        on &= (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        on[on] = flags[0][row[on].astype(int), col[on].astype(int)] != 0
    return on


class Lamp(NamedTuple):
    """A ball, or a volume of nodes, and the map and the direction (i, j, k) in which nodes look for it."""

    depth: np.ndarray
    i: int
    j: int
    k: int
    crossings: np.ndarray
    numbers: np.ndarray
    flags: np.ndarray
    kind: int
    sides: int
    step: float

    def inside(self, x: np.ndarray, y: np.ndarray) -> Values:
        rows, cols = self.depth.shape
        return (x >= 0) & (x < cols) & (y >= 0) & (y < rows)

    def ground(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        rows, cols = self.depth.shape
        return np.asarray(self.depth[np.clip(y, 0, rows - 1), np.clip(x, 0, cols - 1)].astype(float))


def _starts(
    lamp: Lamp, x: np.ndarray, y: np.ndarray, z: np.ndarray, level: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lit at once, still on the way, when each ray meets a ball)."""
    rows, cols = lamp.depth.shape
    lit = np.zeros(z.shape, bool)
    if lamp.kind == BALL:
        hit = _meets_ball(x, y, z, lamp.i, lamp.j, lamp.k, lamp.numbers, lamp.step)
        going = hit >= 0
        if lamp.sides == DARK:
            climb = lamp.k * lamp.step
            px, py = x + hit * lamp.i, y + hit * lamp.j
            inside = (px >= -0.5) & (px < cols - 0.5) & (py >= -0.5) & (py < rows - 0.5)
            out_first = z <= hit * climb if lamp.k else np.zeros(z.shape, bool)
            leaves = _leaves_box(x, y, z, lamp.i, lamp.j, climb, rows, cols)
            going &= np.where(out_first, leaves, inside)
        return lit, going, hit
    inside = level < len(lamp.flags)
    lit[inside] = lamp.flags[level[inside], y[inside], x[inside]] != 0
    return lit, ~lit, np.full(z.shape, np.inf)


def _in_volume(lamp: Lamp, x: np.ndarray, y: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Whether nodes (x, y, n) are on the map and in the volume."""
    there: np.ndarray = (n >= 0) & (n < len(lamp.flags)) & lamp.inside(x, y)
    there[there] = lamp.flags[n[there], y[there], x[there]] != 0
    return there


def _meets_lamp(lamp: Lamp, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether the rays of nodes x, y, z (flat) meet the lamp; all go forward together until decided."""
    rows, cols = lamp.depth.shape
    is_ball, level_ray, last = lamp.kind == BALL, lamp.k == 0, len(lamp.crossings) - 1
    climb = lamp.k * lamp.step
    level = np.rint(z / lamp.step).astype(np.int64)
    lit, going, hit = _starts(lamp, x, y, z, level)
    if is_ball and not (lamp.i or lamp.j):  # straight up nothing is in the way, however deep the node lies
        lit |= going
        return lit
    who = np.flatnonzero(going)
    crossings = enumerate(itertools.cycle(lamp.crossings.tolist()))
    for number, (to_x, to_y, next_x, next_y, near_weight, far_weight, moment, parts) in crossings:
        t, c = divmod(number, last + 1)
        when = t * parts + moment
        if is_ball:
            arrived = when >= hit[who] * parts
            lit[who[arrived]] = True
            who = who[~arrived]
        over = z[who] * parts - when * climb
        gone = over < (0.0 if is_ball else -0.5 * lamp.step * parts)
        cx, cy = x[who] + t * lamp.i + to_x, y[who] + t * lamp.j + to_y
        ex, ey = cx + next_x, cy + next_y
        if lamp.sides == PERIODIC:
            cx, ex, cy, ey = cx % cols, ex % cols, cy % rows, ey % rows
        near_in, far_in = lamp.inside(cx, cy), lamp.inside(ex, ey)
        if c == last:
            gone |= ~near_in & ~far_in
        lit[who[gone]] = is_ball
        near = lamp.ground(cx, cy)
        far = near if far_weight == 0 else lamp.ground(ex, ey)
        known = near_in & (far_in | (far_weight == 0)) & np.isfinite(near) & np.isfinite(far)
        ground = near_weight * np.where(known, near, 0) + far_weight * np.where(known, far, 0)
        blocked = known & ~gone & (ground < over)
        if lamp.kind == VOLUME:
            # of two nodes as near, that farther along the ray: else a lamp is off to one side
            ahead = lamp.i * next_x + lamp.j * next_y > 0
            nx, ny = (ex, ey) if 2 * far_weight > parts or ahead and 2 * far_weight == parts else (cx, cy)
            n = (2 * (level[who] * parts - when * lamp.k) + parts) // (2 * parts)
            there = ~gone & ~blocked & _in_volume(lamp, nx, ny, n)
            lit[who[there]] = True
            gone |= there
        if level_ray and c == last:
            gone |= (cx == x[who]) & (cy == y[who])  # a level ray on a map that repeats has come round
        who = who[~gone & ~blocked]
        if not len(who):
            break
    return lit


def _meets_ball(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, i: int, j: int, k: int, numbers: np.ndarray, step: float
) -> np.ndarray:
    lx, ly, lz = i * step, j * step, -(k * step)
    dx, dy, dz = numbers[0] - x * step, numbers[1] - y * step, numbers[2] - z
    a, b = lx * lx + ly * ly + lz * lz, dx * lx + dy * ly + dz * lz
    q = dx * dx + dy * dy + dz * dz - numbers[3] * numbers[3]
    cx, cy, cz = ly * dz - lz * dy, lz * dx - lx * dz, lx * dy - ly * dx
    root = a * (numbers[3] * numbers[3]) - (cx * cx + cy * cy + cz * cz)
    meets = (b > 0) & (root >= 0)
    return np.where(q <= 0, 0.0, np.where(meets, (b - np.sqrt(np.where(meets, root, 0))) / a, -1.0))


def clip(
    depth: np.ndarray,
    steps: np.ndarray,
    crossings: np.ndarray,
    spans: np.ndarray,
    numbers: np.ndarray,
    flags: np.ndarray,
    planes: np.ndarray,
    rows: int,
    cols: int,
    room: int,
    layers: int,
    kind: int,
    sides: int,
    step: float,
    n_walks: int,
    BITS: int,
) -> None:
    y, x = np.nonzero(np.isfinite(depth))
    z = depth[y, x].astype(float)
    for w in range(n_walks):
        plane = planes[w, : depth.size].reshape(depth.shape)
        lit = plane[y, x]
        for b, (i, j, k, _) in enumerate(steps[w].tolist()):
            bit = np.uint8(1 << b)
            if kind in (BALL, VOLUME):
                # nothing at all is in the way
                clear = (lit & bit != 0) & (kind == BALL and sides == OPEN)
                on = np.empty(len(z), bool)
                on[clear] = _meets_ball(x[clear], y[clear], z[clear], i, j, k, numbers, step) >= 0
                rest = ~clear
                way = crossings[spans[w, 0] : spans[w].sum()]
                lamp = Lamp(depth, i, j, k, way, numbers, flags, kind, sides, step)
                on[rest] = _meets_lamp(lamp, x[rest], y[rest], z[rest])
            else:
                on = (lit & bit != 0) & _meets_plane(
                    x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, step
                )
            lit = np.where(on, lit | bit, lit & ~bit)
        plane[y, x] = lit


def enter(
    steps: np.ndarray,
    numbers: np.ndarray,
    flags: np.ndarray,
    field: np.ndarray,
    rows: int,
    cols: int,
    reach: int,
    n_words: int,
    n_directions: int,
    kind: int,
    sides: int,
) -> None:
    y, x = (v - reach for v in np.mgrid[: rows + 2 * reach, : cols + 2 * reach])
    rim = (x < 0) | (x >= cols) | (y < 0) | (y >= rows)
    for layer in range(len(field)):
        n = layer - reach
        where = rim if n >= 0 else np.ones_like(rim)
        z = np.full(x.shape, float(n))
        words = np.zeros((n_words, *x.shape), np.uint32)
        if not (n >= 0 and sides == DARK):
            for d, (i, j, k, _) in enumerate(steps.tolist()):
                words[d // 32] |= _meets_plane(
                    x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, 1.0
                ).astype(np.uint32) << np.uint32(d % 32)
        field[layer][:, where] = words[:, where]


def beam(
    depth: np.ndarray,
    steps: np.ndarray,
    crossings: np.ndarray,
    spans: np.ndarray,
    numbers: np.ndarray,
    flags: np.ndarray,
    field: np.ndarray,
    rows: int,
    cols: int,
    layers: int,
    kind: int,
    sides: int,
    n_words: int,
    n_directions: int,
    field_layers: int,
) -> None:
    for n in range(field_layers):
        y, x = np.nonzero(n <= depth)
        z = np.full(x.shape, float(n))
        field[n] = 0
        for d, (i, j, k, _) in enumerate(steps.tolist()):
            way = crossings[spans[d, 0] : spans[d].sum()]
            lamp = Lamp(depth, i, j, k, way, numbers, flags, kind, sides, 1.0)
            on = _meets_lamp(lamp, x, y, z)
            field[n, d // 32, y, x] |= on.astype(np.uint32) << np.uint32(d % 32)
