"""Horizons of ground far from a tile, from overviews of the whole map: twin of opencl/far.cl."""

from __future__ import annotations

import numpy as np

from ... import constants

NONE, HIGHEST_MASKED = np.float32(constants.NONE), np.float32(constants.HIGHEST_MASKED)
ONE, HALF = np.float32(1), np.float32(0.5)


def _overview(
    cells: np.ndarray, level: np.ndarray, x0: np.ndarray, y0: np.ndarray, x: np.float32, y: np.float32
) -> np.ndarray:
    """Heights of a level at the points (x, y) nodes from nodes (x0, y0)."""
    offset, first_row, first_col, rows, cols, f = (int(part) for part in level[:6])
    size = 1 << f
    reciprocal, half_cell = ONE / np.float32(size), HALF * np.float32(size - 1)
    u = ((x0 & (size - 1)).astype(np.float32) - half_cell + x) * reciprocal
    v = ((y0 & (size - 1)).astype(np.float32) - half_cell + y) * reciprocal
    left, upper = np.floor(u), np.floor(v)
    b, a = u - left, v - upper
    q, r = (x0 >> f) + left.astype(np.int32) - first_col, (y0 >> f) + upper.astype(np.int32) - first_row
    q0, q1 = np.clip(q, 0, cols - 1), np.clip(q + 1, 0, cols - 1)
    r0, r1 = np.clip(r, 0, rows - 1), np.clip(r + 1, 0, rows - 1)
    window = cells[offset : offset + rows * cols].reshape(rows, cols)
    h00, h01, h10, h11 = window[r0, q0], window[r0, q1], window[r1, q0], window[r1, q1]
    high, low = h00 + b * (h01 - h00), h10 + b * (h11 - h10)
    whole = np.minimum(np.minimum(h00, h01), np.minimum(h10, h11)) > HIGHEST_MASKED
    between: np.ndarray = high + a * (low - high)
    if whole.all():
        return between
    corners = [(h00, (ONE - a) * (ONE - b)), (h01, (ONE - a) * b), (h10, a * (ONE - b)), (h11, a * b)]
    (g00, w00), (g01, w01), (g10, w10), (g11, w11) = (
        (h, np.where(h > HIGHEST_MASKED, weight, np.float32(0))) for h, weight in corners
    )
    every = w00 + w01 + w10 + w11
    part = (w00 * g00 + w01 * g01 + w10 * g10 + w11 * g11) / every
    return np.where(whole, between, np.where(every > 0, part, NONE))


def march(
    cells: np.ndarray,
    levels: np.ndarray,
    steps: np.ndarray,
    level_of: np.ndarray,
    azimuths: np.ndarray,
    own: np.ndarray,
    at_row: np.ndarray,
    at_col: np.ndarray,
    lines: np.ndarray,
    n_steps: int,
    count: int,
    nodes: int,
    rows: int,
    cols: int,
    highest: float,
    drop: float,
    periodic: int,
) -> None:
    top, fall = np.float32(highest), np.float32(drop)
    y0, x0, heights = at_row, at_col, own
    for k, (dx, dy) in enumerate(azimuths):
        best, inverse = np.full(len(heights), NONE), np.zeros(len(heights), np.float32)
        left = np.arange(len(heights))  # nodes whose rays go on
        for (distance, reciprocal), level in zip(steps, level_of):
            x, y = dx * distance, dy * distance
            going = (top - heights[left]) * reciprocal > best[left]
            if not periodic:
                u, v = x0[left], y0[left]
                going &= (x >= (-u).astype(np.float32)) & (x <= (cols - 1 - u).astype(np.float32))
                going &= (y >= (-v).astype(np.float32)) & (y <= (rows - 1 - v).astype(np.float32))
            left = left[going]
            if not left.size:
                break
            ground = _overview(cells, levels[level], x0[left], y0[left], x, y)
            slope = np.where(
                ground > HIGHEST_MASKED, (ground - heights[left]) * reciprocal - fall * distance, NONE
            )
            higher = slope > best[left]
            best[left[higher]], inverse[left[higher]] = slope[higher], reciprocal
        lines[0, k] = np.where(best > HIGHEST_MASKED, best + heights * inverse, NONE)
        lines[1, k] = inverse


def _between(low: np.ndarray, high: np.ndarray, part: np.ndarray, linearly: np.ndarray) -> np.ndarray:
    """Between two values, linearly; or the nearer one."""
    return np.where(linearly, low + part * (high - low), np.where(part < HALF, low, high))


def interpolate(
    lines: np.ndarray,
    heights: np.ndarray,
    planes: np.ndarray,
    count: int,
    nodes: int,
    spread: int,
    rows: int,
    cols: int,
    margin: int,
    stride_along: int,
    stride_across: int,
    before_along: int,
    before_across: int,
    along: int,
    across: int,
    last_along: int,
    last_across: int,
    run: int,
) -> None:
    inner = np.s_[before_across : before_across + across, before_along : before_along + along]
    own = heights.reshape(rows + 2 * margin, -1)[margin:-margin, margin:-margin][inner]
    v, u = np.arange(across)[:, None], np.arange(along)
    r, q = v // spread, u // spread
    down, to_right = (
        np.minimum(spread, last - n * spread) for last, n in ((last_across, r), (last_along, q))
    )
    a = (v - r * spread).astype(np.float32) / np.maximum(down, 1).astype(np.float32)
    part = ONE / np.maximum(to_right, 1).astype(np.float32)
    b = (u - q * spread).astype(np.float32) * part
    steps = np.array([0, stride_across, stride_along, stride_across + stride_along])
    corners = r * stride_across + q * stride_along + steps[:, None, None]  # (4, across, along)
    for k, plane in enumerate(planes.reshape(count, rows, cols)):
        ends = lines[:, k][:, corners]  # of slopes, and of inverse distances
        whole = ends[0].min(0) > HIGHEST_MASKED
        left, right = (_between(ends[:, n], ends[:, n + 1], a, whole) for n in (0, 2))
        slope, inverse = _between(left, right, b, whole)
        plane[...] = NONE
        plane[inner] = np.where(own > HIGHEST_MASKED, slope - own * inverse, NONE)
