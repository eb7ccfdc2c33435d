"""pilot in NumPy: all rays at once, each at its own step; all blocks and picked values at once. Twin of
opencl/pilot.cl.
"""

from typing import Any

import numpy as np

from ... import constants

NONE, HIGHEST_MASKED = np.float32(constants.NONE), np.float32(constants.HIGHEST_MASKED)


def _steps_out(at: np.ndarray, move: np.ndarray, low: Any, high: Any) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(move > 0, (high - at) / move, (at - low) / -move)
    return np.where(move == 0, 2.0**30, np.minimum(out, 1e9)).astype(np.int64) + 1


def pilot(
    heights: np.ndarray,
    tops: np.ndarray,
    rays: np.ndarray,
    slopes: np.ndarray,
    count: int,
    rows: int,
    cols: int,
    across: int,
    shift: int,
    periodic: int,
    highest: float,
    reach: float,
) -> None:
    heights, tops = heights.reshape(-1), tops.reshape(-1)
    x, y = rays[:, 0].astype(np.int64), rays[:, 1].astype(np.int64)
    own, slope = heights[y * cols + x], rays[:, 4].copy()
    for by_rows in (0, 1):
        to, aside = (rays[:, 3], rays[:, 2]) if by_rows else (rays[:, 2], rays[:, 3])
        start, length, start_aside, width = (y, rows, x, cols) if by_rows else (x, cols, y, rows)
        left = np.flatnonzero(np.abs(to) >= 1e-6)
        way, apart = np.where(to > 0, 1, -1), 1 / np.maximum(np.abs(to), np.float32(1e-6))
        move, n = aside * apart, np.ones(len(rays), np.int64)
        while len(left):
            t = n[left] * apart[left]
            at = start[left] + way[left] * n[left]
            v = (start_aside[left] + n[left] * move[left]).astype(np.float32)
            going = (
                (t <= reach)
                & (highest - own[left] > slope[left] * t)
                & (t * (rays[left, 5] + slope[left] * rays[left, 6]) < rays[left, 7])
            )
            if periodic:
                at, v = at % length, np.mod(v, np.float32(width))
                v = np.where(v < width, v, np.float32(0))
            else:
                going &= (at >= 0) & (at < length) & (v >= -1e-4) & (v <= width - 1 + 1e-4)
            left, t, at, v = left[going], t[going], at[going], v[going]
            low = np.minimum(np.maximum(v, 0).astype(np.int64), width - 1)
            part = np.clip(v - low, 0, 1)
            block_at, block_low = at >> shift, low >> shift
            top = tops[block_at * across + block_low if by_rows else block_low * across + block_at]
            past = top - own[left] <= slope[left] * t
            inside = np.where(
                way[left] > 0, np.minimum(block_at + 1 << shift, length) - at, at - (block_at << shift) + 1
            )
            ends = block_low << shift, np.minimum(block_low + 1 << shift, width)
            jump = np.maximum(1, np.minimum(inside, _steps_out(v, move[left], *ends)))
            n[left] += np.where(past, jump, 1)
            here, at, low, t, part = left[~past], at[~past], low[~past], t[~past], part[~past]
            after = np.where(low + 1 < width, low + 1, 0 if periodic else low)
            near, far = (heights[at * cols + v if by_rows else v * cols + at] for v in (low, after))
            tangent = (near + part * (far - near) - own[here]) / t
            along, up, limit = rays[here, 5:].T
            with np.errstate(divide="ignore", invalid="ignore"):
                through = np.where(up > 0, (limit / t - along) / up, np.inf)
            slope[here] = np.maximum(slope[here], np.minimum(tangent, through))
    slopes[...] = slope


def pool(
    heights: np.ndarray,
    pooled: np.ndarray,
    rows: int,
    cols: int,
    across: int,
    down: int,
    shift: int,
    periodic: int,
    cliff: float,
) -> None:
    size, pooled = 1 << shift, pooled.reshape(3, down, across)
    heights = heights.reshape(rows, cols)
    known = heights > HIGHEST_MASKED
    heights = np.where(known, heights, NONE)
    top = np.full((down * size + 1, across * size + 1), NONE)
    top[:rows, :cols] = heights
    if periodic:
        top[: rows + 1, : cols + 1] = np.pad(heights, ((0, 1), (0, 1)), "wrap")
    for _ in range(2):  # blocks of rows, then of columns, each with the one after it
        top = np.maximum(top[:-1].reshape(-1, size, top.shape[1]).max(1), top[size::size]).T
    low = np.full((down * size, across * size), -NONE)
    low[:rows, :cols][known] = heights[known]
    cliffs = np.zeros(low.shape, np.float32)
    for steps, z, there in ((cliffs, heights, known), (cliffs.T, heights.T, known.T)):
        steep = there[1:] & there[:-1] & (abs(z[1:] - z[:-1]) > np.float32(cliff))
        steps[: len(z) - 1, : z.shape[1]] += steep
    blocks = down, size, across, size
    pooled[:] = top, low.reshape(blocks).min((1, 3)), cliffs.reshape(blocks).sum((1, 3))


def pick(values: np.ndarray, at: np.ndarray, picked: np.ndarray, n_picked: int, missing: float) -> None:
    at = at[:n_picked]
    picked[:n_picked] = np.where(at >= 0, values.reshape(-1)[np.maximum(at, 0)], np.float32(missing))
