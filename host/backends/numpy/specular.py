"""The kernels of `specular` in NumPy: twin of opencl/specular.cl and warp_kernels/specular.py."""

from __future__ import annotations

import numpy as np


def _gloss(
    gx: np.ndarray, gy: np.ndarray, L: np.ndarray, lobe: np.ndarray, rim: float, where: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """|(dz/dx, dz/dy, -1)| x max(0, N.L) x lobe for one direction: (pixels among ``where`` in which
    it shows, values).
    """
    gx, gy = gx[where], gy[where]
    twice = np.float32(2) / (gx * gx + gy * gy + np.float32(1))
    cosine = gx * L[0] + gy * L[1] - L[2]
    x, y, z = L[0] - twice * gx, L[1] - twice * gy, L[2] - (np.float32(1) - twice)
    at = (x * x + y * y + z * z) * (np.float32(0.5) * np.float32(len(lobe) - 1) / np.float32(rim))
    shows = (cosine > 0) & (at < len(lobe) - 1)
    at = at[shows]
    i = at.astype(np.int32)
    return where[shows], cosine[shows] * (lobe[i] + (at - i.astype(np.float32)) * (lobe[i + 1] - lobe[i]))


def specular(
    planes: np.ndarray,
    slopes: np.ndarray,
    directions: np.ndarray,
    lobe: np.ndarray,
    radiance: np.ndarray,
    room: int,
    n_walks: int,
    n_lobe: int,
    is_first: int,
    is_last: int,
    rim: float,
    BITS: int,
) -> None:
    gx, gy = slopes
    total = np.zeros(room, np.float32) if is_first else radiance[:room]
    for w in range(n_walks):
        for b, L in enumerate(directions[w]):
            n, light = _gloss(gx, gy, L, lobe, rim, np.flatnonzero(planes[w] >> np.uint8(b) & np.uint8(1)))
            total[n] += L[3] * light
    radiance[:room] = total / np.sqrt(gx * gx + gy * gy + np.float32(1)) if is_last else total


def bound(
    slopes: np.ndarray,
    directions: np.ndarray,
    lobe: np.ndarray,
    radiance: np.ndarray,
    room: int,
    n: int,
    n_lobe: int,
    rim: float,
) -> None:
    gx, gy = slopes
    total = np.zeros(room, np.float32)
    for L in directions:
        where, light = _gloss(gx, gy, L, lobe, rim, np.arange(room))
        total[where] += L[3] * light
    radiance[:room] /= np.maximum(total / np.sqrt(gx * gx + gy * gy + np.float32(1)), np.float32(1))
