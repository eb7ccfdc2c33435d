"""The kernels in NumPy: a file a stem, same names, arguments and bits as in Warp and OpenCL, on whole rows at
a time.
"""

from __future__ import annotations

import importlib

import numpy as np

from ..base import Backend, available_memory


class NumpyBackend(Backend):
    """NumPy on one thread. Device arrays are NumPy arrays."""

    name = "numpy"
    device = "NumPy, 1 thread"

    @property
    def memory(self) -> int:
        return available_memory() // 2

    def upload(self, array):
        return np.array(array, order="C")

    def put(self, array, values):
        array[...] = values

    def empty(self, shape, dtype, fill=None):
        return np.empty(shape, dtype) if fill is None else np.full(shape, fill, dtype)

    def fill(self, array, value):
        array[...] = value

    def download(self, array):
        return array.copy()

    def view(self, array, shape):
        return array.reshape(-1)[: np.prod(shape)].reshape(shape)

    def launch(self, stem, kernel, dim, *args, lanes=None, group=None, **constants):
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # masked nodes are +inf
            getattr(importlib.import_module(f".{stem}", __package__), kernel)(*args, **constants)

    def finish(self):
        """NumPy is done when it returns."""
