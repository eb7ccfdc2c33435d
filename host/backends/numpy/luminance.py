"""The kernels of `luminance` in NumPy: twin of opencl/luminance.cl and warp_kernels/luminance.py."""

from __future__ import annotations

import numpy as np


def gradient(
    depth: np.ndarray,
    slopes: np.ndarray,
    rows: int,
    cols: int,
    room: int,
    half: float,
    one: float,
    periodic: int,
) -> None:
    for out, z in (
        (slopes[0, : depth.size].reshape(depth.shape), depth),
        (slopes[1, : depth.size].reshape(depth.shape).T, depth.T),
    ):
        n = z.shape[1]
        places = [np.arange(n) + step for step in (-1, 1)]
        left, right = (at % n if periodic else np.clip(at, 0, n - 1) for at in places)
        low, high = z[:, left], z[:, right]
        first, last = (~np.isfinite(side) | (at == np.arange(n)) for side, at in ((low, left), (high, right)))
        rise = np.where(last, z, high) - np.where(first, z, low)
        scale = np.where(first | last, np.float32(one), np.float32(half))
        out[...] = np.where(np.isfinite(z) & ~(first & last), rise * scale, np.float32(0))


def luminance(
    planes: np.ndarray,
    slopes: np.ndarray,
    moments: np.ndarray,
    irradiance: np.ndarray,
    pixels: int,
    room: int,
    n_walks: int,
    is_first: int,
    is_last: int,
    BITS: int,
) -> None:
    gx, gy = slopes[0, :pixels], slopes[1, :pixels]
    total = np.zeros(pixels, np.float32) if is_first else irradiance[:pixels]
    for w in range(n_walks):
        lit = planes[w, :pixels]
        for b, (mx, my, mz, _) in enumerate(moments[w]):
            cosine = gx * mx + gy * my - mz
            shows = (lit >> np.uint8(b) & np.uint8(1)).astype(bool) & (cosine > 0)
            total += np.where(shows, cosine, np.float32(0))
    irradiance[:pixels] = total / np.sqrt(gx * gx + gy * gy + np.float32(1)) if is_last else total
