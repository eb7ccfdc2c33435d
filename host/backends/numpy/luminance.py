"""The kernels of `luminance` in NumPy: twin of opencl/luminance.cl and warp_kernels/luminance.py."""

from __future__ import annotations

import numpy as np


def gradient(
    depth: np.ndarray, slopes: np.ndarray, rows: int, cols: int, room: int, half: float, one: float
) -> None:
    for out, z in (
        (slopes[0, : depth.size].reshape(depth.shape), depth),
        (slopes[1, : depth.size].reshape(depth.shape).T, depth.T),
    ):
        known = np.isfinite(z)
        before, after = np.zeros_like(known), np.zeros_like(known)
        before[:, 1:], after[:, :-1] = known[:, :-1], known[:, 1:]
        low, high = z.copy(), z.copy()
        low[:, 1:] = np.where(before[:, 1:], z[:, :-1], z[:, 1:])
        high[:, :-1] = np.where(after[:, :-1], z[:, 1:], z[:, :-1])
        scale = np.where(before & after, np.float32(half), np.float32(one))
        out[...] = np.where(known & (before | after), (high - low) * scale, np.float32(0))


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
            total += np.where(
                (lit >> np.uint8(b) & np.uint8(1)).astype(bool) & (cosine > 0), cosine, np.float32(0)
            )
    irradiance[:pixels] = total / np.sqrt(gx * gx + gy * gy + np.float32(1)) if is_last else total
