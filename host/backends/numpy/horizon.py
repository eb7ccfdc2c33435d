"""Horizons, and the light of a sky above them, in NumPy: twins of opencl/horizon.cl and opencl/ground.cl.

Float32 and int32 operations in the order of the OpenCL kernels, a product and its sum rounded one after the
other, so that slopes are the same bits as on a CPU. What is done for one node there is done for the whole map
here, and what is done for one line for all lines of an azimuth; only the ladder goes from row to row. Steps
are numbered as in opencl/horizon.cl.
"""

from __future__ import annotations

import numpy as np

from ... import constants
from ...constants import DARK, PERIODIC, SLOPES, TABLE, UNIFORM, UNSEEN

NONE, MASKED = np.float32(constants.NONE), np.float32(constants.MASKED)
ONE, HALF, HALF_PI = np.float32(1), np.float32(0.5), np.float32(constants.HALF_PI)


def sweep(
    heights,
    tilts,
    azimuths,
    ways,
    near_at,
    near_weight,
    table,
    slopes,
    sum,
    steps,
    rises,
    first,
    group,
    rows,
    cols,
    margin,
    room,
    knots,
    bits,
    lowest,
    unit,
    known,
    backward,
    *,
    NEAR,
    SIDES,
    WHAT,
    BLOCKS,
):
    """``group`` is how devices share out the lines; here all lines go together, azimuth by azimuth."""
    for plane in range(
        len(slopes) if slopes.ndim == 2 else 1
    ):  # without slopes light is summed, azimuth by azimuth
        _sweep(
            heights,
            tilts,
            azimuths[first + plane],
            ways[first + plane],
            near_at[first + plane],
            near_weight[first + plane],
            None if WHAT != TABLE else table[first + plane],
            slopes[plane : plane + 1],
            sum,
            np.array(steps, np.int32),
            np.array(rises, np.int32),
            rows,
            cols,
            margin,
            room,
            knots,
            bits,
            np.float32(lowest),
            np.float32(unit),
            known,
            backward,
            NEAR,
            SIDES,
            WHAT,
            BLOCKS,
        )


def _sweep(
    heights,
    tilts,
    azimuth,
    way,
    near_at,
    near_weight,
    table,
    slopes,
    sum,
    steps,
    rises,
    rows,
    cols,
    margin,
    room,
    knots,
    bits,
    lowest,
    unit,
    known,
    backward,
    NEAR,
    SIDES,
    WHAT,
    BLOCKS,
):
    shear, cosine, sine, tangent, width, reciprocal, reach = azimuth[:7]
    towards, near_rows, near_columns, warm, window = (int(v) for v in way[:5])
    steepness = abs(shear)
    periodic, oblique = SIDES == PERIODIC, bool(reciprocal < 1e8)
    stride = cols + 2 * margin

    # all nodes: u rows from where rays go to, column x, row y of the map, element p of heights
    u, x = np.arange(rows, dtype=np.int32)[:, None], np.arange(cols, dtype=np.int32)
    y = u if towards > 0 else rows - 1 - u
    p = (y + margin) * stride + margin + x
    own = heights[p]

    def rise(at, beyond, weight, distance):
        """Slope from every node to its ray's crossing between elements ``at`` and ``at + beyond``."""
        a, b = heights[at], heights[at + beyond]
        return (weight * (b - a) + (a - own)) * (ONE / distance)

    def place(x, y):
        if periodic:
            x, y = x % cols, y % rows
        return (y + margin) * stride + margin + x

    def on_row(t):
        """The crossing with the row t rows on; nan for t = 0, which fmax drops."""
        distance = t.astype(np.float32)
        across = shear * distance
        n = np.floor(across)
        slope = rise(place(x + n.astype(np.int32), y - towards * t), 1, across - n, distance)
        return np.where(distance <= reach, slope, NONE) if BLOCKS else slope

    def on_column(m):
        """The crossing with the column m columns on, if it is within reach."""
        distance = m.astype(np.float32) * reciprocal
        n = distance.astype(np.int32)
        before = n if periodic else np.minimum(n, u + 1)
        slope = rise(
            place(x + m if shear > 0 else x - m, y - towards * before),
            -towards * stride,
            distance - n.astype(np.float32),
            distance,
        )
        return np.where(distance <= reach, slope, NONE) if BLOCKS else slope

    # 4. every near crossing
    near_at = near_at[:, 0] - towards * stride * near_at[:, 1]
    near, beside = np.full((2, rows, cols), NONE)
    for e in range(near_rows if BLOCKS else NEAR):
        near = np.fmax(near, rise(p + near_at[e], 1, near_weight[e], np.float32(e + 1)))
    for e in range(near_columns):
        beside = np.fmax(
            beside, rise(p + near_at[NEAR + e], -towards * stride, near_weight[NEAR + e], np.float32(e + 1))
        )
    near = np.fmax(near, beside * np.maximum(steepness, np.float32(1e-6)))

    # 3. and 5. distances of the two crossings that the ladder gives
    level = (np.maximum(own - lowest, np.float32(0)) * unit).astype(np.int32) << bits
    lower, upper = _ladder(
        heights,
        level,
        steps,
        rises,
        shear,
        reciprocal,
        towards,
        warm,
        window,
        rows,
        cols,
        margin,
        lowest,
        unit,
        bits,
        backward,
        NEAR,
        periodic,
        BLOCKS,
    )

    # 6. both on the node's own ray, no farther than the map or the window goes
    last = np.broadcast_to(np.minimum(u + warm, window), p.shape)
    if not periodic and oblique:
        room_beside = (cols - 1 - x if shear > 0 else x).astype(np.float32) * reciprocal
        last = np.where(
            room_beside < np.minimum(u, window).astype(np.float32), room_beside.astype(np.int32), last
        )
    last = np.maximum(last, 1)
    t1, t2 = np.maximum(np.minimum(lower, last), 1), np.maximum(np.minimum(upper, last), 1)
    far = np.fmax(on_row(t1), on_row(t2))
    # 7. and the column crossings beside them: the nearer one's before, the farther one's behind
    if oblique:
        m = (steepness * t1.astype(np.float32)).astype(np.int32)
        far = np.fmax(far, np.fmax(on_column(np.maximum(m, 1)), on_column(m + 1)))
    if BLOCKS:  # downhill the end of the window is the horizon
        far = np.fmax(far, on_row(last))
        if oblique:
            m = (steepness * np.minimum(reach, (u + warm).astype(np.float32))).astype(np.int32)
            m = m if periodic else np.minimum(m, cols - 1 - x if shear > 0 else x)
            far = np.fmax(far, on_column(np.maximum(m, 1)))

    slope = np.fmax(far, near) * tangent
    if SIDES == DARK:  # a wall half a node outside, up to height 0
        wall = (2 * (cols - x) - 1 if shear > 0 else 2 * x + 1).astype(np.float32) * (HALF * reciprocal)
        slope = np.maximum(slope, -own * tangent / np.minimum(wall, u.astype(np.float32) + HALF))
    if WHAT == SLOPES or BLOCKS:
        out = slopes.reshape(rows, cols)[::towards]
        slope = np.maximum(slope, out) if known else slope
    if WHAT == SLOPES:
        out[...] = np.where(slope < np.float32(-1e20), -np.inf, slope)
        return

    # 8. the light between the horizon, or the tangent plane, and the zenith
    gx, gy = tilts[0][p], tilts[1][p]
    along = gx * cosine + gy * sine
    limit = np.maximum(np.maximum(slope, -along), np.float32(0))
    if WHAT == UNIFORM:
        c2 = ONE / (limit * limit + ONE)
        c1 = HALF * (HALF_PI - np.arctan(limit) - limit * c2)
        c2 = c2 * HALF
    else:
        at = limit * (ONE / np.sqrt(limit * limit + ONE)) * np.float32(knots - 1)
        knot = np.minimum(at.astype(np.int32), knots - 2)
        part, entry = at - knot.astype(np.float32), table[knot]
        c1, c2 = part * entry[..., 2] + entry[..., 0], part * entry[..., 3] + entry[..., 1]
    light = (along * c1 + c2) * (width * (ONE / np.sqrt(gx * gx + (gy * gy + ONE))))
    sum.reshape(rows, cols)[::towards] += (light + HALF).astype(np.int32)


def _ladder(
    heights,
    level,
    steps,
    rises,
    shear,
    reciprocal,
    towards,
    warm,
    window,
    rows,
    cols,
    margin,
    lowest,
    unit,
    bits,
    backward,
    NEAR,
    periodic,
    BLOCKS,
):
    """Distances [rows] of the crossings that the ladder's two steps give between which a node lies; each
    (rows, cols).
    """
    grid = heights.reshape(rows + 2 * margin, cols + 2 * margin)
    x = np.arange(cols)
    backward = bool(BLOCKS and backward)

    # 1. lines, and from which row to which each is on the map
    overhang = 0 if periodic else int(abs(shear) * np.float32(rows)) + 1
    origin = -overhang if shear < 0 else 0
    line = np.arange(origin, cols + (overhang if shear > 0 else 0), dtype=np.int32)
    start, stop = np.full_like(line, -warm), np.full_like(line, rows)
    if not periodic and reciprocal < 1e8:
        enters, leaves = (line - cols, line + 1) if shear > 0 else (-line - 1, cols - line)
        start = np.maximum(np.floor(enters.astype(np.float32) * reciprocal).astype(np.int32), 0)
        stop = np.minimum((leaves.astype(np.float32) * reciprocal).astype(np.int32) + 2, rows)
    if backward:
        start, stop = start - (start + warm) % window, stop + window - 1 - (stop - 1 + warm) % window

    # 2. nothing seen yet
    above = np.full((16, len(line)), UNSEEN, np.int32)
    steps, rises, mask = (steps if backward else -steps)[:, None], rises[:, None], (1 << bits) - 1
    comes_at = window if backward else NEAR + 1
    lower, upper = np.empty((2, rows, cols), np.int32)
    for i in range(start.min(), stop.max()):
        u, into = i, 1
        if BLOCKS:
            into = (i + warm) % window
            u = i - 2 * into + window - 1 if backward else i
        # 3. the row that comes in, quantized; then every ray climbs (or, backward, falls) by one row
        if into == 0:
            above[...] = UNSEEN
        comes = u - comes_at
        seen = np.full(len(line), UNSEEN, np.int32)
        if (periodic or 0 <= comes < rows) and (not BLOCKS or backward or into > NEAR):
            across = -shear * np.float32(comes)
            column = np.floor(across)
            at = line + int(column)
            at = (
                at % cols if periodic else np.clip(at, -2, cols)
            )  # beyond that there is only what is not there
            ground = grid[margin + (comes % rows if towards > 0 else (rows - 1 - comes) % rows)]
            a, b = ground[margin + at], ground[margin + at + 1]
            ground = np.where(a == NONE, b, np.where(b == NONE, a, a + (across - column) * (b - a)))
            quantized = (np.maximum(ground - lowest, np.float32(0)) * unit).astype(
                np.int32
            ) << bits | comes_at
            seen = np.where(ground < np.float32(-1e20), seen, quantized)
        going = (start <= i) & (i < stop)
        above = np.where(going, np.maximum(above + steps, seen), above)
        if not 0 <= u < rows:
            continue
        # 5. the two steps of the ladder between which each node lies, by bisection; above[s] is rises[s] too
        # high
        of = x - int(np.floor(HALF - shear * np.float32(u)))
        heard = above[:, of % cols if periodic else of - origin]
        test = heard >= level[u] + rises
        s = np.zeros(cols, np.int32)
        for half in (8, 4, 2, 1):
            s += half * test[s + half, x]
        lower[u], upper[u] = heard[s, x] & mask, heard[np.minimum(s + 1, 15), x] & mask
    return lower, upper
