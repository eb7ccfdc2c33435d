"""The kernels in NumPy, a file per stem.

Names, arguments and visibility bits are those of Warp and OpenCL, and sums are theirs but for rounding. Each
kernel works on whole rows at a time.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from ..base import Array, Backend, available_memory


class NumpyBackend(Backend):
    """NumPy on one thread. Device arrays are NumPy arrays."""

    name = "numpy"
    device = "NumPy, 1 thread"
    shares = True
    # half a minute for both turns of a map, at 33 us a row (measured, 16 x 16 nodes)
    most_searched_rows = 2**19

    @property
    def memory(self) -> int:
        return available_memory() // 2

    def upload(self, array: np.ndarray, constant: bool = False) -> Array:
        return array if constant else np.array(array, order="C")

    def put(self, array: Array, values: np.ndarray) -> None:
        array[...] = values

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike, fill: float | None = None) -> Array:
        return np.empty(shape, dtype) if fill is None else np.full(shape, fill, dtype)

    def fill(self, array: Array, value: float) -> None:
        array[...] = value

    def download(self, array: Array) -> np.ndarray:
        return np.array(array)

    def view(self, array: Array, shape: tuple[int, ...]) -> Array:
        return array.reshape(-1)[: np.prod(shape)].reshape(shape)

    def launch(self, stem: str, kernel: str, dim: tuple[int, ...], *args: Any, **more: Any) -> None:
        # how work-items are grouped does not matter here
        constants = {name: value for name, value in more.items() if name not in ("lanes", "group", "squares")}
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # masked nodes are +inf
            getattr(importlib.import_module(f".{stem}", __package__), kernel)(*args, **constants)

    def finish(self) -> None:
        """NumPy is done when it returns."""
