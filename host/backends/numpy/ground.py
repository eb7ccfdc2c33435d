"""Horizons, and the light of a sky above them, in NumPy: twins of opencl/horizon.cl and opencl/ground.cl.

Float32 and int32 operations in the order of the OpenCL kernels, a product and its sum rounded one after the
other, so that slopes are the same bits as on a CPU. What is done for one node there is done for the whole map
here, and what is done for one line for all lines of an azimuth; only the ladder goes from row to row. Steps
are numbered as in opencl/horizon.cl.
"""

from __future__ import annotations

import numpy as np

from ... import constants

NONE, MASKED = np.float32(constants.NONE), np.float32(constants.MASKED)
ONE, HALF = np.float32(1), np.float32(0.5)


def _difference(z):
    """d depth/dx of padded heights: of nodes (rows, cols) with one more all around."""
    here, low, high = z[1:-1, 1:-1], z[1:-1, :-2].copy(), z[1:-1, 2:].copy()
    low[:, 0], high[:, -1] = here[:, 0], here[:, -1]  # one-sided at the border, also where the map repeats
    alone, last = low <= NONE, high <= NONE
    alone[:, 0] = last[:, -1] = True
    rise = np.where(low <= NONE, here, low) - np.where(high <= NONE, here, high)
    return np.where(here > NONE, rise * np.where(alone | last, ONE, HALF), np.float32(0))


def tilt(heights, tilts, rows, cols, margin, room, periodic):
    inner = heights.reshape(rows + 2 * margin, cols + 2 * margin)[
        margin - 1 : 1 - margin, margin - 1 : 1 - margin
    ]
    for out, slope in zip(tilts, (_difference(inner), _difference(inner.T).T)):
        out.reshape(rows + 2 * margin, cols + 2 * margin)[...] = np.pad(
            slope, margin, "wrap" if periodic else "constant"
        )


def turn(map, turned, rows, cols):
    turned.reshape(cols, rows)[...] = map.reshape(rows, cols).T


def gather(sum, turned, irradiance, rows, cols, unit):
    light = (sum.reshape(rows, cols) + turned.reshape(cols, rows).T).astype(np.float32) * np.float32(unit)
    irradiance.view(np.float32).reshape(rows, cols)[...] = light  # the same memory as ``sum``


def correct(tilts, table, irradiance, rows, cols, margin, room, side, unit):
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
    irradiance.view(np.float32).reshape(rows, cols)[...] += np.float32(unit) * (low + along * (high - low))


def halves(a, b, count):
    a, b = (image.view(np.float32).reshape(-1)[:count] for image in (a, b))
    a[...], b[...] = (a + b) * HALF, (b - a) * HALF


def judge(heights, image, half_, found, rows, cols, margin, block, limit):
    blocks = -(-rows // block)
    image, half_ = (values.view(np.float32).reshape(rows, cols) for values in (image, half_))
    known = (
        heights.reshape(rows + 2 * margin, cols + 2 * margin)[margin : margin + rows, margin : margin + cols]
        > MASKED
    )
    found = found.reshape(5, blocks, cols)
    found[:] = 0
    for first in range(
        min(block, rows)
    ):  # the first rows of all blocks, then their second: each sum in the order of its rows
        rest = np.s_[first::block]
        some, here, apart = known[rest], image[rest], half_[rest]
        for sums, terms in zip(found, (here, apart * apart, ONE, here > 0, abs(apart) > np.float32(limit))):
            sums[: len(some)] += np.where(some, terms, np.float32(0))
