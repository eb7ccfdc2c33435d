"""Arrays of other libraries in, and what xarray's carry with them out again."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Hashable
from typing import Any, NamedTuple

import numpy as np


class Labels(NamedTuple):
    """What an xarray.DataArray has besides its values."""

    dims: tuple[Hashable, ...]
    coords: dict[Hashable, Any]
    name: Hashable
    attrs: dict[Any, Any]


ON_CUDA = 2, 13  # DLPack's kDLCUDA and kDLCUDAManaged


def on_device(values: Any) -> Any:
    """A Warp array on the memory of ``values``; None unless that is a Warp array or lies on a GPU.

    On a GPU lie arrays of PyTorch, CuPy, JAX and Numba.
    """
    warp: Any = sys.modules.get("warp")
    if warp is not None and isinstance(values, warp.array):
        return values
    dlpack = hasattr(values, "__dlpack__") and hasattr(values, "__dlpack_device__")
    if isinstance(values, np.ndarray) or not (
        hasattr(values, "__cuda_array_interface__") or (dlpack and values.__dlpack_device__()[0] in ON_CUDA)
    ):
        return None
    warp = importlib.import_module("warp")
    if dlpack:
        return warp.from_dlpack(values)
    told = values.__cuda_array_interface__
    warp.synchronize()  # whoever wrote it may have done so on a stream of its own
    return warp.array(
        ptr=told["data"][0],
        dtype=warp.dtype_from_numpy(np.dtype(told["typestr"])),
        shape=told["shape"],
        strides=told.get("strides"),
        device="cuda",
    )


def host_array(values: Any) -> np.ndarray:
    """``values`` as a NumPy array, without a copy where that can be; a GPU's are brought over by Warp.

    Takes what numpy.asarray takes, and whatever has ``__dlpack__`` or ``__cuda_array_interface__``. Raises
    what those raise.
    """
    if isinstance(values, np.ndarray):
        return values
    found = on_device(values)
    if found is not None:
        return np.asarray(found.numpy())
    if hasattr(values, "__dlpack__") and not hasattr(values, "__array__"):
        return np.from_dlpack(values)
    return np.asarray(values)


def labels_of(values: Any) -> Labels | None:
    """The labels of an xarray.DataArray, None of anything else; xarray is not imported for it."""
    xarray: Any = sys.modules.get("xarray")
    if xarray is None or not isinstance(values, xarray.DataArray):
        return None
    return Labels(
        values.dims,
        {name: coordinate.copy() for name, coordinate in values.coords.items()},
        values.name,
        dict(values.attrs),
    )


def labelled(array: np.ndarray | None, labels: Labels | None, **leading: Any) -> Any:
    """``array`` as an xarray.DataArray with ``labels``, or as it is where there are none.

    ``leading``: axes before theirs, with coordinates.
    """
    if labels is None or array is None:
        return array
    import xarray

    return xarray.DataArray(
        array, {**leading, **labels.coords}, (*leading, *labels.dims), labels.name, labels.attrs
    )
