"""Maps brought to coarser and finer grids, and smoothed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view


def halved(values: np.ndarray) -> np.ndarray:
    """Means of 2 x 2; an odd side is first made even by its border."""
    rows, cols = values.shape
    values = np.pad(values, ((0, rows % 2), (0, cols % 2)), mode="edge")
    means: np.ndarray = values.reshape(values.shape[0] // 2, 2, values.shape[1] // 2, 2).mean((1, 3))
    return means


def filled(total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """total / weight where weight > 0; elsewhere what coarser grids have there (push-pull, Gortler et al.
    1996). At least one weight is > 0.
    """
    means: np.ndarray = total / np.where(weight > 0, weight, 1)
    if (weight > 0).all():
        return means
    around = doubled(filled(halved(total), halved(weight)), total.shape)
    return np.where(weight > 0, means, around)


def distance_from(known: np.ndarray) -> np.ndarray:
    """Nodes from every node to the nearest known one, (rows, cols) bool, to 12 % beyond some nodes: every
    second step may go along a diagonal.
    """
    near: Any = known
    distance, diagonally = np.zeros(known.shape), False
    while not near.all():
        distance += ~near
        around = sliding_window_view(np.pad(near, 1), (3, 3))
        cross = around[..., 1, :].any(-1) | around[..., 1].any(-1)
        near, diagonally = around.any((2, 3)) if diagonally else cross, not diagonally
    return distance


def halved_depth(z: np.ndarray, times: int = 1) -> np.ndarray:
    """A depth map [nodes] on the grid that is so many times coarser, in that grid's nodes."""
    for _ in range(times):
        z = halved(z) / 2
    return z


def doubled(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Linear interpolation to a grid twice as fine, of this shape."""
    for size in shape:
        at = (np.arange(size) + 0.5) / 2 - 0.5
        low = np.clip(np.floor(at).astype(int), 0, max(len(values) - 2, 0))
        share = (at - low)[:, None]
        values = (values[low] * (1 - share) + values[np.minimum(low + 1, len(values) - 1)] * share).T
    return values


def cubic(values: np.ndarray, times: int) -> np.ndarray:
    """Lagrange's cubic interpolation to a grid so many times as fine, straight on beyond the border."""
    for _ in range(2):
        size = len(values)
        at = (np.arange(times * size) + 0.5) / times - 0.5 + 2
        low = np.floor(at).astype(int)
        t = (at - low)[:, None]
        padded = np.pad(values, ((2, 2), (0, 0)), mode="reflect", reflect_type="odd")
        before, first, second, after = (padded[np.minimum(low + k, size + 3)] for k in (-1, 0, 1, 2))
        values = (
            -t * (t - 1) * (t - 2) / 6 * before
            + (t + 1) * (t - 1) * (t - 2) / 2 * first
            - (t + 1) * t * (t - 2) / 2 * second
            + (t + 1) * t * (t - 1) / 6 * after
        ).T
    return values


def blurred(values: np.ndarray, times: int = 1) -> np.ndarray:
    """Means of 3 x 3, twice, ``times`` times: a standard deviation of 1.15 nodes, times the root of that."""
    rows, cols = values.shape
    for _ in range(2 * times):
        padded = np.pad(values, 1, mode="edge")
        parts = (padded[i : i + rows, j : j + cols] for i in range(3) for j in range(3))
        values = sum(parts, np.zeros((rows, cols), values.dtype)) / 9
    return values
