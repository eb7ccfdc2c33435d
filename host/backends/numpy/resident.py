"""A depth map that lies on the device already, in NumPy: twin of opencl/resident.cl."""

from __future__ import annotations

import numpy as np

WAYS = (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)


def take(values: np.ndarray, depth: np.ndarray, top: float, sign: float, count: int) -> None:
    depth.reshape(-1)[:count] = np.float32(top) + np.float32(sign) * values.reshape(-1)[:count]


def survey(values: np.ndarray, found: np.ndarray, rows: int, cols: int) -> None:
    values = values.reshape(rows, cols)
    known, most = np.isfinite(values), np.finfo(np.float32).max
    found[0], found[1] = np.where(known, values, most).min(0), np.where(known, values, -most).max(0)
    found[2] = (~known).sum(0)


def pad(
    depth: np.ndarray,
    heights: np.ndarray,
    rows: int,
    cols: int,
    margin: int,
    step: float,
    outside: float,
    periodic: int,
) -> None:
    mode = {"mode": "wrap"} if periodic else {"constant_values": np.float32(outside)}
    heights[:] = np.pad(-depth.reshape(rows, cols) / np.float32(step), margin, **mode).ravel()


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
            best[way] = np.maximum(best[way], np.where(inside, (there - own) / np.float32(distance), -np.inf))
        distance = distance * 5 // 4 + 1
