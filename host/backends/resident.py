"""Depth maps that lie on a backend's device already: checked, padded and probed there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .base import Array, Backend
from .registry import select


class Resident(NamedTuple):
    """A depth map on a device: the device's backend, depth (rows x cols) float32 there, and its range."""

    backend: Backend
    depth: Array
    shape: tuple[int, int]
    least: float
    most: float
    broken: int  # values that are not finite

    def download(self) -> np.ndarray:
        """The map (rows, cols) on the host."""
        return self.backend.download(self.depth).reshape(self.shape)

    def padded(self, margin: int, step: float, sides: str, outside: float) -> Array:
        """Heights [spacing] with a margin, as sweeps take them, on the device."""
        rows, cols = self.shape
        size = cols + 2 * margin, rows + 2 * margin
        heights = self.backend.empty((size[0] * size[1],), np.float32)
        self.backend.launch(
            "resident",
            "pad",
            size,
            self.depth,
            heights,
            rows,
            cols,
            margin,
            float(step),
            float(outside),
            int(sides == "periodic"),
        )
        return heights

    def probe(self, heights: Array, margin: int, every: int, first: int) -> np.ndarray:
        """Steepest slopes (8, samples) from every ``every``-th node to ground at least ``first`` rows away.

        -inf where no ground lies.
        """
        rows, cols = self.shape
        across = -(-cols // every)
        count = across * -(-rows // every)
        best = self.backend.empty((8, count), np.float32)
        self.backend.launch(
            "resident", "probe", (count, 8), heights, best, rows, cols, margin, every, across, count, first
        )
        return self.backend.download(best)


def adopt(backend: Backend, values: Array, shape: tuple[int, int], height: bool = False) -> Resident:
    """A copy, on the same device, of device array ``values`` (rows x cols) float32 [length].

    The values are depth, or heights, which are turned into depth.
    """
    rows, cols = shape
    least, most, broken = _survey(backend, values, rows, cols)
    depth = backend.empty((rows * cols,), np.float32)
    backend.launch(
        "resident",
        "take",
        (rows * cols,),
        values,
        depth,
        most if height else 0.0,
        -1.0 if height else 1.0,
        rows * cols,
    )
    backend.finish()  # the caller's array may go
    if height:
        least, most = 0.0, float(np.float32(most) - np.float32(least))
    return Resident(backend, depth, (rows, cols), least, most, broken)


def find(values: Array, height: bool = False) -> Resident | None:
    """A Warp array as a Resident of its device's backend if it is a contiguous float32 map (rows, cols).

    None of any other array, which the host must convert first.
    """
    if values.dtype.__name__ != "float32" or values.ndim != 2 or not values.size or not values.is_contiguous:
        return None
    return adopt(select(f"warp:{values.device.alias}"), values.flatten(), values.shape, height)


def _survey(backend: Backend, values: Array, rows: int, cols: int) -> tuple[float, float, int]:
    found = backend.empty((3, cols), np.float32)
    backend.launch("resident", "survey", (cols,), values, found, rows, cols)
    low, high, broken = backend.download(found).reshape(3, cols)
    return float(low.min()), float(high.max()), int(broken.sum(dtype=np.float64))
