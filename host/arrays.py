"""Arrays of other libraries in, and what xarray's carry with them out again."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import math
import mmap
import os
import re
import sys
import warnings
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import numpy as np

from .errors import bad


class Labels(NamedTuple):
    """The parts of an xarray.DataArray besides its values."""

    dims: tuple[Hashable, ...]
    coords: dict[Hashable, Any]
    attrs: dict[Any, Any]
    grid_mapping: Hashable = None  # the coordinate that holds the coordinate reference system, where told
    # positions along axes that have no coordinates, by the transform that the reference system tells
    places: dict[Hashable, Any] = {}  # noqa: RUF012  never changed

    def are_of(self, shape: tuple[int, ...]) -> bool:
        """Whether the coordinates fit a map of this shape."""
        sizes = dict(zip(self.dims, shape))
        return all(
            sizes.get(name, size) == size
            for coordinate in self.coords.values()
            for name, size in coordinate.sizes.items()
        )


class Quantity(NamedTuple):
    """The quantity that a map holds: its name, its unit (None: that of the source), and a description."""

    name: str
    units: str | None
    long_name: str


# attributes of a map that name values which stand for no data: CF conventions, GDAL, old xarray.open_rasterio
NO_DATA = "_FillValue", "missing_value", "nodata", "nodatavals"
# attributes of a map that describe its values, and so not those of a result (CF conventions, GDAL)
OF_VALUES = (
    *NO_DATA, "units", "long_name", "standard_name", "description", "scale_factor", "add_offset", "valid_min",
    "valid_max", "valid_range", "actual_range", "cell_methods",
)  # fmt: skip
ON_CUDA = 2, 13  # DLPack's kDLCUDA and kDLCUDAManaged
# elements that a thread takes at a time: 4 MiB of float32, some 0.2 ms; chosen: with a
# quarter of it starting the work takes as long as the work
BAND = 2**20

Result = TypeVar("Result")


@functools.cache
def threads() -> ThreadPoolExecutor:
    """Threads for passes over large arrays, as many as there are cores; NumPy releases its lock in them."""
    return ThreadPoolExecutor(os.cpu_count(), "skylamp")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=threads.cache_clear)  # a child has none of its parent's threads


def multiply(image: np.ndarray, factor: float | np.ndarray) -> None:
    """``image`` times a number, or a map of its rows and columns, in place; in float32, on all cores."""
    factor = np.asarray(factor, np.float32)

    def scale(rows: slice) -> None:
        np.multiply(image[rows], factor[rows] if factor.ndim > 1 else factor, out=image[rows])

    by_bands(scale, image.shape)


def scratch(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros, float32, whose memory the system gets back when they are dropped.

    malloc would keep some 30 MB of freed memory.
    """
    count = math.prod(shape)
    if count < BAND:
        return np.zeros(shape, np.float32)
    if hasattr(mmap, "MADV_HUGEPAGE"):  # to touch every small page first would take longer than to fill them
        room = mmap.mmap(-1, 4 * count, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        room.madvise(mmap.MADV_HUGEPAGE)
    else:
        room = mmap.mmap(-1, 4 * count)
    return np.frombuffer(room, np.float32, count).reshape(shape)


def by_bands(work: Callable[[slice], Result], shape: tuple[int, ...]) -> list[Result]:
    """``work`` (rows of a band) for all bands of an array, on all cores; the results in order."""
    rows = shape[0]
    width = max(1, BAND * rows // max(1, np.prod(shape, dtype=int)))
    bands = [slice(first, min(first + width, rows)) for first in range(0, rows, width)]
    return [work(bands[0])] if len(bands) == 1 else list(threads().map(work, bands))


def on_device(values: Any) -> Any:
    """A Warp array on the memory of ``values``; None unless that is a Warp array or lies on a GPU.

    On a GPU lie arrays of PyTorch, CuPy, JAX and Numba.
    """
    warp: Any = sys.modules.get("warp")
    # another thread may be importing it
    if warp is not None and isinstance(values, getattr(warp, "array", ())):
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
        return np.asarray(values)  # of a matrix the plain array
    exported = on_device(values)
    if exported is not None:
        return np.asarray(exported.numpy())
    if hasattr(values, "__dlpack__") and not hasattr(values, "__array__"):
        return np.from_dlpack(values)
    return np.asarray(values)


def chunked(values: Any) -> Any:
    """The dask.array that ``values`` is, or is an xarray.DataArray of; None of anything else.

    Dask is not imported for it.
    """
    dask: Any = sys.modules.get("dask.array")
    if dask is None:
        return None
    if labels_of(values) is not None and values.chunks is not None:
        values = values.data
    return values if isinstance(values, getattr(dask, "Array", ())) else None


def as_promised(values: Any, what: str) -> Any:
    """A dask.array whose blocks are InputErrors unless they have the shapes that its chunks promise."""
    return values.map_blocks(_promised, what, dtype=values.dtype, meta=values._meta)


def _promised(block: Any, what: str, block_info: Any) -> Any:
    chunk, shape = block_info[0]["chunk-location"], tuple(block_info[None]["chunk-shape"])
    if np.shape(block) != shape:
        raise bad(
            f"{what}: chunk {chunk} of a dask.array", f"shape {np.shape(block)}", f"{shape}, by its chunks"
        )
    return block


def labels_of(values: Any) -> Labels | None:
    """The labels of an xarray.DataArray, None of anything else; xarray is not imported for it."""
    xarray: Any = sys.modules.get("xarray")
    kind: Any = getattr(xarray, "DataArray", None)  # another thread may be importing it
    if kind is None or not isinstance(values, kind):
        return None
    coords = {name: coordinate.copy() for name, coordinate in values.coords.items()}
    attributes, grid_mapping = dict(values.attrs), values.encoding.get("grid_mapping")
    if "rioxarray" in sys.modules and not attributes.keys() & set(NO_DATA):
        # what rio.set_nodata keeps apart; rioxarray raises where the type of the map cannot hold it
        with contextlib.suppress(OverflowError, TypeError, ValueError):
            if (no_data := values.rio.nodata) is not None:
                attributes["nodata"] = no_data
    places = cells_along(values.dims[-2:], values.shape[-2:], _transform(coords))
    return Labels(values.dims, coords, attributes, grid_mapping, places)


def _transform(coords: Any) -> list[float]:
    """GDAL's six numbers of a grid, x of the first corner, and by column and row, then y; else none."""
    told = next((c.attrs["GeoTransform"] for c in coords.values() if "GeoTransform" in c.attrs), "")
    try:
        numbers = [float(word) for word in str(told).split()]
    except ValueError:
        return []
    return numbers if len(numbers) == 6 and all(map(math.isfinite, numbers)) else []


def cells_along(
    dims: Sequence[Hashable], shape: Sequence[int], transform: Sequence[float]
) -> dict[Hashable, Any]:
    """Middles of cells along rows and columns by GDAL's six numbers; none where these turn the grid."""
    if len(dims) != 2 or not transform or transform[2] or transform[4]:
        return {}
    x, across, _, y, _, down = transform
    ends = zip(dims, shape, (y, x), (down, across))
    xarray = sys.modules["xarray"]
    return {name: xarray.DataArray(at + step * (np.arange(n) + 0.5), dims=name) for name, n, at, step in ends}


def no_data_of(labels: Labels | None) -> list[float]:
    """Values that stand for no data, by the attributes of a DataArray; InputError if others need scaling.

    A file's attributes that xarray has applied are no longer among these (CF conventions).
    """
    if labels is None:
        return []
    scale, offset = labels.attrs.get("scale_factor", 1), labels.attrs.get("add_offset", 0)
    if not (np.all(scale == 1) and np.all(offset == 0)):
        raise bad(
            "a DataArray of heights",
            f"the attributes scale_factor {scale} and add_offset {offset}, not applied to its values",
            "heights",
            "Open it with mask_and_scale=True; where they are heights already, remove these attributes.",
        )
    numbers = []
    for name in NO_DATA:
        told = np.ravel(labels.attrs.get(name, ()))
        try:
            numbers += [float(value) for value in told] if told.dtype.kind in "iufU" else []
        except ValueError:
            raise bad(f"attribute {name!r} of a DataArray", repr(told[0]), "a number") from None
    return [number for number in numbers if not math.isnan(number)]


FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937  # [metre], by definition
METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("km", "kilometre", "kilometres", "kilometer", "kilometers"), 1000.0),
    **dict.fromkeys(("dm", "decimetre", "decimetres", "decimeter", "decimeters"), 0.1),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 0.001),
    **dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet", "[ft i]"), FOOT),
    **dict.fromkeys(
        ("us-ft", "ftus", "ft us", "foot us", "us foot", "us survey foot", "us survey feet", "[ft us]"),
        SURVEY_FOOT,
    ),
}
ANGLE = re.compile(r"°|deg|arc|rad|gon\b")  # in units of angle, as CF and others spell them
# names of coordinates
ANGLE_NAMES = ("lat", "lon", "latitude", "longitude", "grid_latitude", "grid_longitude")
# of the spacing, by which it may differ along an axis or between both: slopes have that error
LENGTH_TOLERANCE = 0.01


def metres_in(unit: str) -> float | None:
    """Metres of a unit of length, told alone or as the first word ("m above sea level"); None of others."""
    name = re.sub(r"[\s_]+", " ", unit.strip().lower())
    return METRES.get(name, METRES.get(name.split(" ")[0]))


def spacing_of(labels: Labels | None) -> float:
    """The distance of neighbouring nodes by the coordinates of an xarray.DataArray, or by the transform of
    its reference system (rioxarray's spatial_ref); 1 where there are neither.

    In the unit of height, where units of both are known; a warning where one is told and not known, and
    where only one is told and is not the metre. InputError for coordinates that are uneven, not square, or
    degrees.
    """
    if labels is None:
        return 1.0
    steps: list[np.ndarray] = []
    system = _units_of_system(labels)
    vertical = str(labels.attrs.get("units", "")).lower() or system[1]
    for name in labels.dims[-2:]:
        coordinate = _positions(labels, name)
        if coordinate is None:
            continue
        unit = str(coordinate.attrs.get("units", "")).lower() or system[0]
        names = {str(name).lower(), str(coordinate.attrs.get("standard_name", "")).lower()}
        here, high = metres_in(unit), metres_in(vertical)
        if ANGLE.search(f"{unit} {system[0]}") or not here and names & set(ANGLE_NAMES):
            raise bad(
                f"spacing by the coordinate {name!r}",
                "degrees",
                "lengths in the unit of height",
                "Reproject the map to a system in metres (dem.rio.reproject).",
            )
        if unknown := _unknown(unit, here, vertical, high) if not steps else "":
            warnings.warn(
                f"Unit of height: {unknown}; heights are taken as in the unit of the coordinates. Give both"
                " an attribute units that is known (m, km, dm, cm, mm, ft, us-ft), or the spacing in the unit"
                " of the heights.",
                stacklevel=2,  # one place, so that Python says it once
            )
        scale = here / high if here and high else 1.0
        steps.append(scale * np.abs(np.diff(coordinate.values.astype(np.float64))))
    curved = ", ".join(str(name) for name in labels.coords if _is_curved(labels, name))
    if not steps and (curved or _transform(labels.coords)):
        got = f"two-dimensional ones, {curved}" if curved else "the transform of the reference system"
        raise bad(
            "spacing by coordinates",
            f"{got}, of a turned or curved grid",
            "one coordinate along each axis",
            "Reproject the map (dem.rio.reproject).",
        )
    differences = np.concatenate([*steps, np.zeros(0)])
    if not differences.size:
        return 1.0
    if not differences.max() * (1 - LENGTH_TOLERANCE) <= differences.min() or not differences.min() > 0:
        raise bad(
            "spacing by coordinates",
            f"steps of {differences.min():g} to {differences.max():g}",
            "even steps, the same along both axes",
            "Resample the map to square cells.",
        )
    factors = factors_of(labels)
    if factors is not None and (text := stretched(factors.tissot_semiminor, factors.tissot_semimajor)):
        warnings.warn(text, stacklevel=2)
    return float(np.mean([step.mean() for step in steps if step.size]))


def _unknown(unit: str, here: float | None, vertical: str, high: float | None) -> str:
    """What is not known of the units of coordinates and heights, though it is needed; else nothing."""
    if unit == vertical:
        return ""
    unheard = [
        f"{name!r} is not known" for name, metres in ((unit, here), (vertical, high)) if name and not metres
    ]
    if unheard:
        return ", ".join(unheard)
    if not vertical:
        return f"none is told, and coordinates are in {unit}" if here != 1.0 else ""
    return f"it is {vertical}, and coordinates tell none" if not unit and high != 1.0 else ""


def _units_of_system(labels: Labels) -> tuple[str, str]:
    """Units of the coordinates and of heights by the reference system, each empty where it tells none."""
    wkt, system = _system(labels)
    if system is None:
        return ("degree" if wkt.startswith(("GEOGCS", "GEOGCRS")) else ""), ""
    units = [axis.unit_name.lower() for axis in system.axis_info if axis.unit_name]
    return units[0] if units else "", units[2] if len(units) > 2 else ""


def _system(labels: Labels) -> tuple[str, Any]:
    """The reference system that the coordinates tell, as text and, by pyproj, as its CRS or None."""
    wkt = next((str(c.attrs["crs_wkt"]) for c in labels.coords.values() if c.attrs.get("crs_wkt")), "")
    try:
        return wkt, importlib.import_module("pyproj").CRS(wkt) if wkt else None
    except (ImportError, RuntimeError):  # pyproj is not installed, or cannot read it
        return wkt, None


def factors_of(labels: Labels) -> Any:
    """The factors of the projection at the middle of a map, by pyproj; None where there is no projection."""
    system = _system(labels)[1]
    lines = [_positions(labels, name) for name in labels.dims[-2:]]
    if system is None or not system.is_projected or any(line is None for line in lines):
        return None
    pyproj = importlib.import_module("pyproj")
    to_degrees = pyproj.Transformer.from_crs(system, system.geodetic_crs, always_xy=True)
    place = to_degrees.transform(*(float(line.mean()) for line in lines[::-1]))
    return pyproj.Proj(system).get_factors(*place)


def stretched(least: float, most: float) -> str | None:
    """What to say of a map whose lengths are so many times those on the ground, in the directions where they
    are ``least`` and ``most``; None within 1 %.
    """
    if max(abs(least - 1), abs(most - 1)) <= LENGTH_TOLERANCE:
        return None
    mean = math.sqrt(least * most)
    is_even = most <= least * (1 + LENGTH_TOLERANCE)
    factor = f"{mean:.3g}" if is_even else f"{least:.3g} to {most:.3g}"
    return (
        f"Projection: lengths on this map are {factor} times those on the ground, so slopes and shadows"
        " are wrong. Warp it to a system that keeps lengths here, such as UTM"
        + (f", or divide the spacing by {factor}." if is_even else ".")
    )


# names of coordinates that run east, and CF's axis and standard names of such
ALONG_X = (
    "x", "xc", "lon", "rlon", "longitude", "grid_longitude", "easting", "projection_x_coordinate",
)  # fmt: skip


def axes_of(labels: Labels | None) -> tuple[float, float]:
    """1 where columns run east, and where rows run south, else -1: by coordinates, which grow east and north.

    (1, 1) where there are none. InputError where rows are x, or there are other axes.
    """
    if labels is None:
        return 1.0, 1.0
    if len(labels.dims) != 2:
        raise bad(
            "shape of a DataArray", labels.dims, "rows and columns", "Of several bands take one: dem[0]."
        )
    for name in labels.dims:
        coordinate = labels.coords.get(name)
        if coordinate is not None and coordinate.dtype.kind not in "iuf":
            raise bad(f"coordinate {name!r} of a map", f"dtype {coordinate.dtype}", "numbers: lengths")
    rows, cols = labels.dims
    attrs = getattr(labels.coords.get(rows), "attrs", {})
    if any(str(told).lower() in ALONG_X for told in (rows, attrs.get("axis"), attrs.get("standard_name"))):
        raise bad("dimensions of a DataArray", labels.dims, f"rows first, {(cols, rows)}", "Use transpose().")
    return (-1.0 if _grows(labels, cols) < 0 else 1.0), (-1.0 if _grows(labels, rows) > 0 else 1.0)


def lies_on(
    labels: Labels | None, values: Any, what: str, fix: str = "Use reindex_like(method='nearest')."
) -> None:
    """InputError where a DataArray that goes with a map has its axes exchanged, or other coordinates.

    ``values``: that, its labels, or anything that has none.
    """
    other = values if isinstance(values, Labels) else labels_of(values)
    if labels is None or other is None:
        return
    if other.dims[:2] == labels.dims[::-1]:
        raise bad(f"{what}: dimensions of a DataArray", other.dims, str(labels.dims), "Use transpose().")
    for name in labels.dims:
        lines = [_positions(given, name) for given in (labels, other)]
        if any(line is None or line.size < 2 for line in lines) or lines[0].size != lines[1].size:
            continue
        here, there = (line.values.astype(np.float64) for line in lines)
        if np.abs(there - here).max() > np.abs(np.diff(here)).max() / 2:
            got, allowed = (f"{line[0]:g} to {line[-1]:g}" for line in (there, here))
            raise bad(f"{what}: coordinate {name!r}", got, allowed, fix)


def _is_curved(labels: Labels, name: Hashable) -> bool:
    """Whether a coordinate tells a place for every node, not one along an axis."""
    coordinate = labels.coords[name]
    told = {str(name).lower(), str(coordinate.attrs.get("standard_name", "")).lower()}
    return coordinate.dims == labels.dims[-2:] and bool(told & {*ALONG_X, *ANGLE_NAMES})


def _grows(labels: Labels, name: Hashable) -> float:
    """Last coordinate less the first, 0 where there are none."""
    coordinate = _positions(labels, name)
    if coordinate is None or not coordinate.size:
        return 0.0
    first, last = coordinate.values[[0, -1]].tolist()
    return float(last - first)


def _positions(labels: Labels, name: Hashable) -> Any:
    """Positions along a dimension, by its coordinate or else the transform; None where there are none."""
    coordinate = labels.coords.get(name, labels.places.get(name))
    is_line = coordinate is not None and coordinate.ndim == 1 and coordinate.dtype.kind in "iuf"
    return coordinate if is_line else None


def labelled(
    array: Any, labels: Labels | None, quantity: Quantity, last: str = "channel", **leading: Any
) -> Any:
    """``array`` as an xarray.DataArray with the coordinates of ``labels``, or as it is where there are none.

    Name, units and description are those of ``quantity``; other attributes stay; nan is no data.
    ``leading``: axes before theirs, with coordinates. Colours are an axis ``last`` after theirs. InputError
    if that name is taken.
    """
    if labels is None or array is None:
        return array
    import xarray

    dims = *leading, *labels.dims
    if array.ndim > len(dims):
        dims = *dims, last
        if last in labels.dims or last in labels.coords:
            raise bad("names of a DataArray", last, "others: it is an axis of the result", "Rename it.")
    attrs = {key: value for key, value in labels.attrs.items() if key not in OF_VALUES}
    told = {"units": quantity.units, "long_name": quantity.long_name}
    attrs |= {key: value for key, value in told.items() if value is not None}
    result = xarray.DataArray(array, {**labels.coords, **leading}, dims, quantity.name, attrs)
    if array.dtype.kind == "f":
        result.encoding["_FillValue"] = np.nan  # which files then declare
    if labels.grid_mapping is not None:
        result.encoding["grid_mapping"] = labels.grid_mapping
    return result


def short_repr(record: Any) -> str:
    """That of a dataclass with arrays, which are told by their shape and type."""
    shown = {field.name: getattr(record, field.name) for field in dataclasses.fields(record) if field.repr}
    texts = (
        f"{name}={value.shape} {value.dtype}" if hasattr(value, "dtype") else f"{name}={value!r}"
        for name, value in shown.items()
    )
    return f"{type(record).__name__}({', '.join(texts)})"
