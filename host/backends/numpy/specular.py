"""The kernels of `specular` in NumPy: names, arguments and bits as in opencl/specular.cl and
warp_kernels/specular.py.
"""

from __future__ import annotations

import numpy as np


def _gloss(gx, gy, L, lobe, rim, where):
    """What |(dz/dx, dz/dy, -1)| x max(0, N.L) x lobe is for one direction: (pixels among ``where`` in which
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


def specular(planes, slopes, directions, lobe, radiance, room, n_walks, n_lobe, is_first, is_last, rim, BITS):
    gx, gy = slopes
    total = np.zeros(room, np.float32) if is_first else radiance[:room]
    for w in range(n_walks):
        for b, L in enumerate(directions[w]):
            n, light = _gloss(gx, gy, L, lobe, rim, np.flatnonzero(planes[w] >> np.uint8(b) & np.uint8(1)))
            total[n] += L[3] * light
    radiance[:room] = total / np.sqrt(gx * gx + gy * gy + np.float32(1)) if is_last else total


def bound(slopes, directions, lobe, radiance, room, n, n_lobe, rim):
    gx, gy = slopes
    total = np.zeros(room, np.float32)
    for L in directions:
        n, light = _gloss(gx, gy, L, lobe, rim, np.arange(room))
        total[n] += L[3] * light
    radiance[:room] /= np.maximum(total / np.sqrt(gx * gx + gy * gy + np.float32(1)), np.float32(1))
