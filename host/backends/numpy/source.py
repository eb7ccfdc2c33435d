"""The kernels of `source` in NumPy: names, arguments and bits as in opencl/source.cl and
warp_kernels/source.py.
"""

from __future__ import annotations

import itertools

import numpy as np

from ...constants import APERTURE, BALL, DARK, OPEN, PERIODIC, RECTANGLE, SKY, VOLUME


def _within(w, k, low, high, period, sides):
    if sides != PERIODIC:
        return (k * low <= w) & (w < k * high)
    v, lap = w - k * low, k * period
    return v - np.floor(v / lap) * lap < k * (high - low)


def _leaves_box(x, y, z, i, j, climb, rows, cols):
    u, v = 2 * (x * climb + i * z), 2 * (y * climb + j * z)
    return (-climb <= u) & (u < (2 * cols - 1) * climb) & (-climb <= v) & (v < (2 * rows - 1) * climb)


def _meets_plane(x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, step):
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


def _meets_lamp(depth, x, y, z, i, j, k, crossings, numbers, flags, kind, sides, step):
    """x, y, z: flat arrays of nodes. All rays go forward together; those that are decided fall out of
    ``going``.
    """
    rows, cols = depth.shape
    layers = len(flags)
    climb = k * step
    level = np.rint(z / step).astype(np.int64)
    lit, going = np.zeros(z.shape, bool), np.ones(z.shape, bool)
    hit = np.full(z.shape, np.inf)
    if kind == BALL:
        hit = _meets_ball(x, y, z, i, j, k, numbers, step)
        going = hit >= 0
        if sides == DARK:
            px, py = x + hit * i, y + hit * j
            inside = (px >= -0.5) & (px < cols - 0.5) & (py >= -0.5) & (py < rows - 0.5)
            out_first = z <= hit * climb if k else np.zeros(z.shape, bool)
            going &= np.where(out_first, _leaves_box(x, y, z, i, j, climb, rows, cols), inside)
    else:
        inside = level < layers
        lit[inside] = flags[level[inside], y[inside], x[inside]] != 0
        going &= ~lit
    who = np.flatnonzero(going)
    for t in itertools.count():
        for c, (to_x, to_y, next_x, next_y, near_weight, far_weight, moment, parts) in enumerate(
            crossings.tolist()
        ):
            when = t * parts + moment
            if kind == BALL:
                arrived = when >= hit[who] * parts
                lit[who[arrived]] = True
                who = who[~arrived]
            over = z[who] * parts - when * climb
            gone = over < (0.0 if kind == BALL else -0.5 * step * parts)
            cx, cy = x[who] + t * i + to_x, y[who] + t * j + to_y
            ex, ey = cx + next_x, cy + next_y
            if sides == PERIODIC:
                cx, ex, cy, ey = cx % cols, ex % cols, cy % rows, ey % rows
            near_in = (cx >= 0) & (cx < cols) & (cy >= 0) & (cy < rows)
            far_in = (ex >= 0) & (ex < cols) & (ey >= 0) & (ey < rows)
            if c == len(crossings) - 1:
                gone |= ~near_in & ~far_in
            lit[who[gone]] = kind == BALL
            pick = lambda row, col: depth[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)].astype(float)
            near = pick(cy, cx)
            far = near if far_weight == 0 else pick(ey, ex)
            known = near_in & (far_in | (far_weight == 0)) & np.isfinite(near) & np.isfinite(far)
            blocked = (
                known
                & ~gone
                & (near_weight * np.where(known, near, 0) + far_weight * np.where(known, far, 0) < over)
            )
            if kind == VOLUME:
                nx, ny = (ex, ey) if 2 * far_weight >= parts else (cx, cy)
                n = (2 * (level[who] * parts - when * k) + parts) // (2 * parts)
                there = (
                    ~gone
                    & ~blocked
                    & (n >= 0)
                    & (n < layers)
                    & (nx >= 0)
                    & (nx < cols)
                    & (ny >= 0)
                    & (ny < rows)
                )
                there[there] = flags[n[there], ny[there], nx[there]] != 0
                lit[who[there]] = True
                gone |= there
            if k == 0 and c == len(crossings) - 1:
                gone |= (cx == x[who]) & (cy == y[who])  # a level ray on a map that repeats has come round
            who = who[~gone & ~blocked]
            if not len(who):
                return lit


def _meets_ball(x, y, z, i, j, k, numbers, step):
    lx, ly, lz = i * step, j * step, -(k * step)
    dx, dy, dz = numbers[0] - x * step, numbers[1] - y * step, numbers[2] - z
    a, b = lx * lx + ly * ly + lz * lz, dx * lx + dy * ly + dz * lz
    q = dx * dx + dy * dy + dz * dz - numbers[3] * numbers[3]
    root = b * b - a * q
    meets = (b > 0) & (root >= 0)
    return np.where(q <= 0, 0.0, np.where(meets, (b - np.sqrt(np.where(meets, root, 0))) / a, -1.0))


def clip(
    depth,
    steps,
    crossings,
    spans,
    numbers,
    flags,
    planes,
    rows,
    cols,
    room,
    layers,
    kind,
    sides,
    step,
    n_walks,
    BITS,
):
    y, x = np.nonzero(np.isfinite(depth))
    z = depth[y, x].astype(float)
    for w in range(n_walks):
        plane = planes[w, : depth.size].reshape(depth.shape)
        lit = plane[y, x]
        for b, (i, j, k, _) in enumerate(steps[w].tolist()):
            bit = np.uint8(1 << b)
            if kind in (BALL, VOLUME):
                clear = (
                    (lit & bit != 0) if kind == BALL and sides == OPEN else np.zeros(len(z), bool)
                )  # nothing at all is in the way
                on = np.empty(len(z), bool)
                on[clear] = _meets_ball(x[clear], y[clear], z[clear], i, j, k, numbers, step) >= 0
                rest = ~clear
                on[rest] = _meets_lamp(
                    depth,
                    x[rest],
                    y[rest],
                    z[rest],
                    i,
                    j,
                    k,
                    crossings[spans[w, 0] : spans[w].sum()],
                    numbers,
                    flags,
                    kind,
                    sides,
                    step,
                )
            else:
                on = (lit & bit != 0) & _meets_plane(
                    x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, step
                )
            lit = np.where(on, lit | bit, lit & ~bit)
        plane[y, x] = lit


def enter(steps, numbers, flags, field, rows, cols, reach, n_words, n_directions, kind, sides):
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
    depth,
    steps,
    crossings,
    spans,
    numbers,
    flags,
    field,
    rows,
    cols,
    layers,
    kind,
    sides,
    n_words,
    n_directions,
    field_layers,
):
    for n in range(field_layers):
        y, x = np.nonzero(n <= depth)
        z = np.full(x.shape, float(n))
        field[n] = 0
        for d, (i, j, k, _) in enumerate(steps.tolist()):
            on = _meets_lamp(
                depth,
                x,
                y,
                z,
                i,
                j,
                k,
                crossings[spans[d, 0] : spans[d].sum()],
                numbers,
                flags,
                kind,
                sides,
                1.0,
            )
            field[n, d // 32, y, x] |= on.astype(np.uint32) << np.uint32(d % 32)
