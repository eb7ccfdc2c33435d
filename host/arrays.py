"""Arrays of other libraries in, and what xarray's carry with them out again."""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np


class Labels(NamedTuple):
    """What an xarray.DataArray has besides its values."""

    dims: tuple
    coords: dict
    name: object
    attrs: dict


def host_array(values) -> np.ndarray:
    """``values`` as a NumPy array, without a copy where that can be; a GPU's are brought over by Warp.

    Takes what numpy.asarray takes, and whatever has ``__dlpack__`` or ``__cuda_array_interface__`` (PyTorch, CuPy, JAX,
    Warp). Raises what those raise.
    """
    if isinstance(values, np.ndarray):
        return values
    if hasattr(values, "__cuda_array_interface__"):
        import warp

        return (values if isinstance(values, warp.array) else warp.from_dlpack(values) if hasattr(values, "__dlpack__") else warp.array(values)).numpy()
    if hasattr(values, "__dlpack__") and not hasattr(values, "__array__"):
        return np.from_dlpack(values)
    return np.asarray(values)


def labels_of(values) -> Labels | None:
    """The labels of an xarray.DataArray, None of anything else; xarray is not imported for it."""
    xarray = sys.modules.get("xarray")
    if xarray is None or not isinstance(values, xarray.DataArray):
        return None
    return Labels(values.dims, {name: coordinate.copy() for name, coordinate in values.coords.items()}, values.name, dict(values.attrs))


def labelled(array: np.ndarray, labels: Labels | None, **leading):
    """``array`` as an xarray.DataArray with ``labels``, or as it is where there are none; ``leading``: axes before theirs, with coordinates."""
    if labels is None:
        return array
    import xarray

    return xarray.DataArray(array, {**leading, **labels.coords}, (*leading, *labels.dims), labels.name, labels.attrs)
