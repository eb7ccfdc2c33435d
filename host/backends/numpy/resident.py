"""A depth map that lies on a device, in NumPy: twin of opencl/resident.cl."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...constants import HIGHEST_MASKED, NO_CEILING, NONE

WAYS = (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)


def adopt(
    values: np.ndarray, mask: np.ndarray, depth: np.ndarray, top: float, sign: float, masked: int, count: int
) -> None:
    given = values.reshape(-1)[:count]
    converted = np.where(given == np.inf, np.float32(np.nan), np.float32(top) + np.float32(sign) * given)
    if masked:
        converted[mask.reshape(-1)[:count] == 0] = np.inf
    depth.reshape(-1)[:count] = converted


def survey(values: np.ndarray, stats: np.ndarray, rows: int, cols: int, block: int, step: float) -> None:
    values = values.reshape(-1)[: rows * cols].reshape(rows, cols)
    room = np.full((rows + 1, cols + 1), np.inf, np.float32)
    room[:-1, :-1] = values
    for b in range(-(-rows // block)):
        some = slice(b * block, min((b + 1) * block, rows))
        z = values[some]
        known = np.isfinite(z)
        stats[0, b] = np.where(known, z, NO_CEILING).min(0)
        stats[1, b] = np.where(known, z, -NO_CEILING).max(0)
        stats[2, b] = (~known & (z != np.inf)).sum(0)
        with np.errstate(invalid="ignore", over="ignore"):
            stats[3, b] = (known & ((np.rint(z.astype(float) / step) * step).astype(np.float32) != z)).sum(0)
            for n, there in enumerate((room[some, 1:], room[some.start + 1 : some.stop + 1, :-1])):
                pair = known & np.isfinite(there)
                # in the order of the rows, as the kernels add
                stats[4 + n, b] = np.cumsum(np.where(pair, (there - z) ** 2, 0), 0, np.float32)[-1]
                stats[6 + n, b] = pair.sum(0)


def layers(depth: np.ndarray, step: float, count: int) -> None:
    some = depth.reshape(-1)[:count]
    some[:] = np.rint(some.astype(float) / step)


def heights(
    depth: np.ndarray,
    heights: np.ndarray,
    rows: int,
    cols: int,
    left: int,
    above: int,
    width: int,
    height: int,
    step: float,
    masked: float,
    periodic: int,
) -> None:
    depth = depth.reshape(-1)[: rows * cols].reshape(rows, cols)
    ground = np.where(depth == np.inf, np.float32(masked), -depth / np.float32(step))
    margins = (above, height - rows - above), (left, width - cols - left)
    options: dict[str, Any] = {"mode": "wrap"} if periodic else {"constant_values": NONE}
    heights.reshape(-1)[: width * height] = np.pad(ground, margins, **options).ravel()


def shade(
    image: np.ndarray,
    depth: np.ndarray,
    albedo: np.ndarray,
    varies: int,
    factor: float,
    least: float,
    count: int,
) -> None:
    share = albedo.reshape(-1)[: count if varies else 1] * np.float32(factor)
    shaded = np.maximum(image.reshape(-1)[:count], np.float32(least)) * share
    image.reshape(-1)[:count] = np.where(depth.reshape(-1)[:count] == np.inf, np.float32(np.nan), shaded)


def probe(
    heights: np.ndarray,
    best: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    every: int,
    across: int,
    count: int,
    first: int,
) -> None:
    stride = cols + 2 * margin
    sample = np.arange(count)
    x, y = sample % across * every, sample // across * every
    own = heights[(y + margin) * stride + margin + x]
    best[:] = -np.inf
    distance = first
    while distance < max(rows, cols):
        for way, (i, j) in enumerate(WAYS):
            u, v = x + i * distance, y + j * distance
            inside = (u >= 0) & (u < cols) & (v >= 0) & (v < rows)
            there = heights[np.where(inside, (v + margin) * stride + margin + u, 0)]
            seen = inside & (there > HIGHEST_MASKED) & (own > HIGHEST_MASKED)
            best[way] = np.maximum(best[way], np.where(seen, (there - own) / np.float32(distance), -np.inf))
        distance = distance * 5 // 4 + 1
