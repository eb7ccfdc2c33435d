"""Kernels about a sweep, in NumPy: twin of opencl/ground.cl, in float32 operations of the same order."""

from __future__ import annotations

from typing import Any

import numpy as np

from ... import constants

HIGHEST_MASKED = np.float32(constants.HIGHEST_MASKED)
ONE, HALF = np.float32(1), np.float32(0.5)


def _slope_between(low: np.ndarray, here: np.ndarray, high: np.ndarray) -> np.ndarray:
    """d depth/dx by the heights of nodes and of both neighbours, one-sided where one of these is masked."""
    first, last = low <= HIGHEST_MASKED, high <= HIGHEST_MASKED
    rise = np.where(first, here, low) - np.where(last, here, high)
    return np.where(here > HIGHEST_MASKED, rise * np.where(first | last, ONE, HALF), np.float32(0))


def _difference(z: np.ndarray) -> np.ndarray:
    """d depth/dx of padded heights: of nodes (rows, cols) with one more all around."""
    return _slope_between(z[1:-1, :-2], z[1:-1, 1:-1], z[1:-1, 2:])


def tilt(
    heights: np.ndarray, tilts: np.ndarray, rows: int, cols: int, margin: int, room: int, periodic: int
) -> None:
    shape, some = (rows + 2 * margin, cols + 2 * margin), slice(margin - 1, 1 - margin)
    inner = heights.reshape(shape)[some, some]
    for out, slope in zip(tilts, (_difference(inner), _difference(inner.T).T)):
        out.reshape(shape)[...] = np.pad(slope, margin, "wrap" if periodic else "constant")


def turn(maps: np.ndarray, turned: np.ndarray, rows: int, cols: int, count: int) -> None:
    turned.reshape(count, cols, rows)[...] = maps.reshape(count, rows, cols).transpose(0, 2, 1)


def gather(
    sum: np.ndarray, turned: np.ndarray, irradiance: np.ndarray, rows: int, cols: int, n: int, quantum: float
) -> None:
    light = sum[n].reshape(rows, cols) + turned[n].reshape(cols, rows).T
    light = np.maximum(light, 0).astype(np.float32) * np.float32(quantum)
    irradiance.view(np.float32).reshape(rows, cols)[...] = light  # the same memory as ``sum``


def correct(
    tilts: np.ndarray,
    table: np.ndarray,
    irradiance: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    room: int,
    side: int,
) -> None:
    inner = np.s_[:, margin : margin + rows, margin : margin + cols]
    gx, gy = tilts.reshape(2, -1)[:, :room].reshape(2, rows + 2 * margin, cols + 2 * margin)[inner]
    up = ONE / np.sqrt(ONE + gx * gx + gy * gy)
    u, v = ((g * up / (ONE + up) + ONE) * HALF * np.float32(side - 1) for g in (gx, gy))
    i, j = (np.clip(w.astype(np.int32), 0, side - 2) for w in (u, v))
    across, along = u - i.astype(np.float32), v - j.astype(np.float32)
    table = table.reshape(side, side)
    low, high = (
        row[0] + across * (row[1] - row[0]) for row in ((table[k, i], table[k, i + 1]) for k in (j, j + 1))
    )
    image = irradiance.view(np.float32).reshape(rows, cols)
    np.maximum(np.float32(0), image * (low + along * (high - low)), out=image)


def place(
    maps: np.ndarray,
    depth: np.ndarray,
    numbers: np.ndarray,
    stack: np.ndarray,
    rows: int,
    cols: int,
    count: int,
    turned: int,
) -> None:
    values = maps.reshape(-1)[: count * rows * cols]
    values = (
        values.reshape(count, cols, rows).transpose(0, 2, 1) if turned else values.reshape(count, rows, cols)
    )
    masked = np.isinf(depth.reshape(-1)[: rows * cols].reshape(rows, cols))
    stack.reshape(-1, rows, cols)[numbers[:count]] = np.where(masked, np.float32(np.nan), values)


def halves(a: np.ndarray, b: np.ndarray, count: int, keep: int) -> None:
    a, b = (image.view(np.float32).reshape(-1)[:count] for image in (a, b))
    mean, half = (a + b) * HALF, (b - a) * HALF
    a[...], b[...] = (half, b) if keep else (mean, half)


def judge(
    heights: np.ndarray,
    image: np.ndarray,
    half: np.ndarray,
    sums: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    block: int,
    limit: float,
) -> None:
    blocks = -(-rows // block)
    image, half = (values.view(np.float32).reshape(rows, cols) for values in (image, half))
    padded = heights.reshape(rows + 2 * margin, cols + 2 * margin)
    known = padded[margin : margin + rows, margin : margin + cols] > HIGHEST_MASKED
    sums = sums.reshape(5, blocks, cols)
    sums[:] = 0
    # the first rows of all blocks, then their second: each sum in the order of its rows
    for first in range(min(block, rows)):
        rest = np.s_[first::block]
        some, here, apart = known[rest], image[rest], half[rest]
        counted: tuple[Any, ...] = ONE, here > 0, abs(apart) > np.float32(limit)
        for total, terms in zip(sums, (here, apart * apart, *counted)):
            total[: len(some)] += np.where(some, terms, np.float32(0))
