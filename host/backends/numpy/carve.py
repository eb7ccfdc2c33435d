"""The kernels of `carve` in NumPy: twin of opencl/carve.cl and warp_kernels/carve.py."""

from __future__ import annotations

import numpy as np


def carve(
    planes: np.ndarray,
    weights: np.ndarray,
    light: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    side: np.ndarray,
    depth: np.ndarray,
    active: np.ndarray,
    pixels: int,
    room: int,
    n_walks: int,
    is_first: int,
    is_last: int,
    layer: int,
    by_sign: int,
    BITS: int,
) -> None:
    depth = depth.reshape(pixels)
    here = np.flatnonzero(depth == layer)
    total = np.zeros(len(here), np.int32) if is_first else light[here]
    for w in range(n_walks):
        lit = planes[w, here]
        for b, weight in enumerate(weights[w]):
            total += np.where(lit >> np.uint8(b) & np.uint8(1), weight, np.int32(0))
    light[here] = total
    if not is_last:
        return
    if layer == 0:
        side[here] = total > high[here]
    stops = (low[here] <= total) & (total <= high[here])
    if by_sign:
        stops |= (total > high[here]) != side[here]
    depth[here[~stops]] = layer + 1
    active[0] += np.count_nonzero(~stops)
