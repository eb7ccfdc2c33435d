"""GeoTIFF in and out, with its coordinate reference system, transform and nodata value, by rasterio (extra
``geo``).

skylamp's grids are square and north is up (-y). Cells that are not square on the ground, such as cells of
degrees away from the equator, are resampled on request, else refused. A file whose rows go from south to
north is read from its last row to its first, and so what is written like it is north up.
"""

from __future__ import annotations

import contextlib
import math
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from ..arrays import Labels, cells_along, factors_of, labels_of, lies_on, metres_in, stretched
from ..checks import positive_number
from ..constants import MOST_FILE_PIXELS
from ..errors import bad, import_extra
from ..scene import Scene
from .files import numbers
from .paths import StrPath, destination, readable, reading, replacing, reserve

# share of its length by which a cell's other side may differ; slopes then have this relative error
MOST_OBLONG = 0.01
NORTHWARDS = 1e-3  # [degree] along which a meridian is straight; chosen, some 100 m
GEO_TAGS = (33550, 33922, 34264, 34735)  # pixel scale, tie points, transformation, keys


@dataclass(frozen=True, eq=False)
class Raster:
    """A GeoTIFF's one band and where on Earth it lies.

    values (rows, cols), in the file's own type; mask (rows, cols) bool, True where there are data; spacing:
    side of a cell in the unit of the values (metres, unless the band is in feet); crs and transform, of the
    cells' corners, as rasterio has them; nodata, the file's value or None; point: whether the file calls its
    values those of points, AREA_OR_POINT; unit: of the values, as the file tells it, in lower case; "" if it
    tells none.
    """

    values: np.ndarray = field(repr=False)
    mask: np.ndarray = field(repr=False)
    spacing: float
    crs: Any  # rasterio.crs.CRS
    transform: Any  # affine.Affine
    nodata: float | None
    point: bool = False
    unit: str = ""

    def scene(self, **options: Any) -> Scene:
        """The :class:`skylamp.Scene` of these heights.

        ``options``: albedo, sides, another spacing, or a mask of nodes to leave out besides those without
        data.
        """
        height, mask = np.where(self.mask, self.values, 0), options.pop("mask", None)
        if mask is None:
            mask = None if self.mask.all() else self.mask
        elif np.shape(mask) == self.mask.shape and np.asarray(mask).dtype == bool:  # a scene refuses others
            mask = self.mask & np.asarray(mask)
        return Scene.from_height(height, **{"spacing": self.spacing, "mask": mask, **options})


def is_geotiff(path: StrPath) -> bool:
    """Whether ``path`` is a TIFF with a georeference, by its tags, without rasterio."""
    path = readable(path)
    if path.suffix.lower() not in (".tif", ".tiff"):
        return False
    import tifffile

    with reading(path), tifffile.TiffFile(path) as file:
        return bool(len(file.pages)) and any(tag in file.pages[0].aspage().tags for tag in GEO_TAGS)


def read(path: StrPath, *, resample: bool = False, spacing: float | None = None) -> Raster:
    """The one band of a GeoTIFF with its georeference.

    Its cells must be square on the ground to 1 %, east to the right. Rows come from north to south, whatever
    their order in the file; the transform is that of these rows. In degrees, a cell's sides in metres follow
    from the ellipsoid at the middle latitude; they are not equally long. ``resample``: make cells square,
    with the shorter side, by bilinear interpolation; the coordinate reference system stays, the transform
    becomes that of the new cells. ``spacing``: another one than the file tells, in the unit of the values;
    nothing is then said of units and of lengths on the map.

    Raises InputError for a file that is missing, truncated, damaged, not a TIFF, without a georeference or
    with several bands, turned, not square, or so tall in latitude that a degree's length differs by more than
    2 % from that at the middle; or without rasterio.
    """
    path = readable(path)
    with _opened(path) as file:
        if file.width * file.height > MOST_FILE_PIXELS:
            raise bad(
                f"{path}: size",
                f"{file.height} x {file.width}",
                f"at most {MOST_FILE_PIXELS:,} cells",
                "Give --memory, or cut it into tiles.",
            )
        reserve(path, file.width * file.height * (np.dtype(file.dtypes[0]).itemsize + 1))
        values, mask = file.read(1), file.read_masks(1) > 0
        if values.dtype.kind == "f":
            mask &= np.isfinite(values)
        raster = _described(path, file, values, mask)
        raster = replace(raster, values=_scaled(file, raster.values))
    return _spaced(path, raster, resample, spacing)


def header(path: StrPath, *, spacing: float | None = None) -> Raster:
    """What :func:`read` gives of a file of any size, but for its values and mask, which take no memory here.

    Cells must be square.
    """
    path = readable(path)
    with _opened(path) as file:
        shape = file.height, file.width
        nothing = np.broadcast_to(np.zeros((), file.dtypes[0]), shape)
        raster = _described(path, file, nothing, np.broadcast_to(np.True_, shape))
    return _spaced(path, raster, None, spacing)


def convergence(dem: Any) -> float:
    """The meridian convergence at the middle of a map [degree]: its north, clockwise from true north.

    Subtract it from azimuths from true north, such as those of :func:`skylamp.sun_position`, or give it to
    :func:`skylamp.sky_over_time`. In a UTM zone it is at most some degrees, in systems of continents tens.

    ``dem``: the path of a GeoTIFF, a :class:`Raster`, or an xarray.DataArray with x, y and a coordinate
    reference system, as rioxarray gives it. 0.0 of a map in degrees or without a reference system. Raises
    InputError for anything else, or a file that is no GeoTIFF.

    Example: ``azimuth - geo.convergence("dem.tif")``
    """
    labels = labels_of(dem)
    if labels is not None:
        factors = factors_of(labels)
        return 0.0 if factors is None else float(factors.meridian_convergence)
    if isinstance(dem, Raster):
        crs, t, (rows, cols) = dem.crs, dem.transform, dem.values.shape
    elif isinstance(dem, (str, os.PathLike)):
        with _opened(readable(dem)) as file:
            crs, t, rows, cols = file.crs, file.transform, file.height, file.width
    else:
        raise bad("convergence", type(dem).__name__, "the path of a GeoTIFF, a Raster or a DataArray")
    if crs is None or not crs.is_projected:
        return 0.0
    transform, degrees = _rasterio("convergence").warp.transform, "EPSG:4326"
    try:
        (east,), (north,) = transform(crs, degrees, [t.c + t.a * cols / 2], [t.f + t.e * rows / 2])
        x, y = transform(degrees, crs, [east, east], [north - NORTHWARDS, min(north + NORTHWARDS, 90.0)])
    except Exception:  # of another celestial body; the class of the error is private to rasterio
        return 0.0
    return -math.degrees(math.atan2(x[1] - x[0], y[1] - y[0]))


def window(path: StrPath, rows: slice, cols: slice, dtype: DTypeLike = np.float32) -> np.ndarray:
    """Values (rows, cols) of a part of a GeoTIFF, nan without data; rows count as in :func:`read`."""
    path = readable(path)
    with _opened(path) as file:
        up = _south_up(file.transform)
        lines = (file.height - rows.stop, file.height - rows.start) if up else (rows.start, rows.stop)
        part = lines, (cols.start, cols.stop)
        values, mask = _scaled(file, file.read(1, window=part)), file.read_masks(1, window=part) > 0
    return np.where(mask, values, np.nan).astype(dtype)[:: -1 if up else 1]


def _south_up(transform: Any) -> bool:
    """Whether the first row lies in the south."""
    return bool(transform.e > 0 and not (transform.b or transform.d))


def _scaled(file: Any, values: np.ndarray) -> np.ndarray:
    """Values of the band by its scale and offset."""
    scale, offset = file.scales[0], file.offsets[0]
    return values if (scale, offset) == (1.0, 0.0) else values * np.float64(scale) + offset


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file by rasterio; it has one band."""
    rasterio = _rasterio(path)
    with reading(path, "GeoTIFF"), warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        # this driver alone: a .tif that is a VRT could name any file
        with rasterio.open(path, driver="GTiff") as file:
            if file.transform.is_identity and file.crs is None and not file.gcps[0]:
                raise bad(
                    f"{path}: no georeference", "a plain TIFF", "a GeoTIFF", "skylamp.io.read reads it."
                )
            if file.count != 1:
                raise bad(f"{path}: bands", file.count, "one band of heights, depths or values")
            yield file


def _described(path: Path, file: Any, values: np.ndarray, mask: np.ndarray) -> Raster:
    """The raster without its spacing, north up."""
    if values.dtype.kind not in "iuf":
        raise bad(f"{path}: wrong type", values.dtype, "real numbers (integer or floating)")
    point = file.tags().get("AREA_OR_POINT") == "Point"
    transform = file.transform
    if transform.is_identity:  # what rasterio gives of a file with control points and without a transform
        raise bad(
            f"{path}: no transform",
            "control points alone",
            "a transform from rows and columns to the ground",
            "Warp it first, by rio warp IN.tif OUT.tif --dst-crs EPSG:NNNN",
        )
    if _south_up(transform):
        values, mask = values[::-1], mask[::-1]
        t = transform
        transform = type(t)(t.a, 0, t.c, 0, -t.e, t.f + t.e * file.height)
    unit = (file.units[0] or "").strip().lower()
    return Raster(values, mask, 0.0, file.crs, transform, file.nodata, point, unit)


def _spaced(path: Path, raster: Raster, resample: bool | None, spacing: float | None) -> Raster:
    """The raster with its spacing; checked to be not turned, and to have square cells, or made so.

    ``resample``: None where that cannot be asked for.
    """
    t = raster.transform
    if t.b or t.d or t.a <= 0 or t.e >= 0:
        raise bad(
            f"{path}: turned grid",
            f"transform {tuple(t)[:6]}",
            "rows from west to east",
            "Warp it first, by rio warp IN.tif OUT.tif --dst-crs EPSG:NNNN",
        )
    east, north = _metres(path, raster)
    unit, vertical = raster.unit, metres_in(raster.unit)
    if vertical is None:
        cells = raster.crs is not None and raster.crs.is_projected and raster.crs.linear_units_factor
        if spacing is None and (unit or (cells and cells[1] != 1)):
            told = f"{unit!r} in {path} is not known" if unit else f"{path} tells none"
            between = f", and its cells are in {cells[0]}" if cells else ""
            warnings.warn(
                f"Unit of height: {told}{between}; heights are taken as in metres, unless a spacing in their"
                " unit is given.",
                stacklevel=2,  # one place, so that Python says it once
            )
        vertical = 1.0
    if abs(east / north - 1) > MOST_OBLONG:
        if not resample:
            raise bad(
                f"{path}: cells are not square",
                f"{east:.4g} m to the east by {north:.4g} m to the north",
                "square cells: skylamp's grids have one spacing",
                ("Warp it" if resample is None else "Pass resample=True (--resample), or warp it")
                + " to a metric system: rio warp IN.tif OUT.tif --dst-crs EPSG:NNNN",
            )
        raster = _squared(_rasterio(path), raster, east, north)
        east = north = min(east, north)
    if spacing is not None:
        return replace(raster, spacing=positive_number(spacing, "spacing"))
    if (text := stretched(*_stretch(path, raster))) is not None:
        warnings.warn(f"{path}: {text}", stacklevel=2)
    return replace(raster, spacing=float(np.sqrt(east * north) / vertical))


def write(path: StrPath, array: np.ndarray, like: Raster, *, unit: str = "") -> None:
    """Write ``array``, (rows, cols), (bands, rows, cols) or colours (rows, cols, 3), as a GeoTIFF with the
    georeference of ``like``, whole or not at all, in the array's own type.

    ``unit``: of the array, written to every band. Heights in feet need it, ``unit=like.unit``: :func:`read`
    takes heights without a unit as metres.

    The nodata value of a floating array is NaN, whatever that of ``like`` is, which a valid node may have;
    where ``like`` is masked and the array still has its value or its nodata value, it becomes NaN. A
    whole-number array keeps the nodata value of ``like`` if it fits its type. Raises InputError for another
    shape or type, a DataArray with other coordinates, or a path that cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".tif", ".tiff"):
        raise bad(f"{path}: unknown extension of a GeoTIFF", repr(path.suffix), ".tif .tiff")
    if not isinstance(unit, str):
        raise bad("unit", repr(unit), "text, such as 'm' or like.unit")
    if not isinstance(like, Raster):
        raise bad("like", type(like).__name__, "the Raster whose georeference it has, from skylamp.geo.read")
    destination(path)
    rasterio = _rasterio(path)
    _check_place(array, like, path)
    array = numbers(array, f"{path}: cannot write the array")
    array = array.astype(np.uint8) if array.dtype == bool else array
    if array.shape == (*like.values.shape, 3):
        array = np.moveaxis(array, -1, 0)
    fits = array.shape[-2:] == like.values.shape and array.ndim in (2, 3)
    if not fits or array.dtype == np.float16 or array.dtype.itemsize > 8:
        raise bad(
            f"{path}: cannot write the array",
            f"dtype {array.dtype}, shape {array.shape}",
            f"real numbers of shape {like.values.shape}, bands of it, or colours",
        )
    nodata = like.nodata
    if array.dtype.kind == "f":
        with np.errstate(over="ignore"):  # of what marks no data
            unset = array == like.values.astype(array.dtype)  # not what was computed there
        if nodata is not None:
            unset |= array == nodata
        array = np.where(~like.mask & unset, array.dtype.type(np.nan), array)
        nodata = np.nan
    elif nodata is not None:
        info = np.iinfo(array.dtype)
        fits = np.isfinite(nodata) and nodata == int(nodata) and info.min <= nodata <= info.max
        nodata = nodata if fits else None
    bands = array.reshape(-1, *array.shape[-2:])
    size = dict(zip(("count", "height", "width"), bands.shape))
    about = dict(dtype=array.dtype, crs=like.crs, transform=like.transform, nodata=nodata)
    with rasterio.MemoryFile() as memory:
        with memory.open(driver="GTiff", compress="deflate", bigtiff="if_safer", **size, **about) as file:
            file.update_tags(AREA_OR_POINT="Point" if like.point else "Area")
            file.write(bands)
            file.units = [unit] * len(bands)
        with replacing(path) as out:
            out.write(memory.getbuffer())


def _check_place(array: Any, like: Raster, path: Path) -> None:
    """InputError where a DataArray has other coordinates than the Raster whose georeference it gets."""
    labels = labels_of(array)
    if labels is None:
        return
    dims = labels.dims[:2] if array.shape == (*like.values.shape, 3) else labels.dims[-2:]
    own = Labels(dims, {}, {}, places=cells_along(dims, like.values.shape, like.transform.to_gdal()))
    fix = "Give the Raster of its own map; one whose rows run north, array.sortby('y', ascending=False)."
    lies_on(own, labels, f"{path}: cannot write the array", fix)


def _rasterio(path: Path | str) -> Any:
    modules = "rasterio", "rasterio.errors", "rasterio.warp"
    return import_extra(f"{path}: a GeoTIFF", "rasterio", "geo", *modules)[0]


def _metres(path: Path, raster: Raster) -> tuple[float, float]:
    """A cell's length to the east and to the north [metre]."""
    east, north = raster.transform.a, -raster.transform.e
    if raster.crs is None or not raster.crs.is_geographic:
        projected = raster.crs is not None and raster.crs.is_projected
        unit = raster.crs.linear_units_factor[1] if projected else 1.0
        return east * unit, north * unit
    top, bottom = (raster.transform.f + raster.transform.e * row for row in (0, len(raster.values)))
    if not (-90 <= bottom < top <= 90):
        raise bad(f"{path}: latitudes", f"{bottom} to {top}", "-90 to 90 degrees")
    lengths = [_degrees(latitude) for latitude in (bottom, (top + bottom) / 2, top)]
    if max(abs(e / lengths[1][0] - 1) for e, _ in lengths) > 2 * MOST_OBLONG:
        raise bad(
            f"{path}: cells in degrees that change their width",
            f"latitudes {bottom:.4g} to {top:.4g}",
            "a map so low that a degree's length is within 2 % of that at the middle latitude",
            "Warp it to a metric system, by rio warp IN.tif OUT.tif --dst-crs EPSG:NNNN",
        )
    return east * lengths[1][0], north * lengths[1][1]


def _stretch(path: Path, raster: Raster) -> tuple[float, float]:
    """Length on the map over that on the ground, at its middle, in the directions where it is least and most;
    1 if it is not known.
    """
    crs = raster.crs
    if crs is None or not crs.is_projected:
        return 1.0, 1.0
    rasterio = _rasterio(path)
    rows, cols = raster.values.shape
    t = raster.transform
    x, y = t.c + t.a * cols / 2, t.f + t.e * rows / 2
    step = 1000 / crs.linear_units_factor[1]  # a kilometre
    try:
        corners = [x, x + step, x], [y, y, y + step]
        longitudes, latitudes = map(np.array, rasterio.warp.transform(crs, "EPSG:4326", *corners))
    except Exception:  # of another celestial body; the class of the error is private to rasterio
        return 1.0, 1.0
    degrees = _degrees(latitudes.mean())
    east = (longitudes[1:] - longitudes[0] + 180) % 360 - 180  # a map may lie across 180 degrees
    ground = np.array([east * degrees[0], (latitudes[1:] - latitudes[0]) * degrees[1]]) / 1000
    most, least = np.linalg.svd(ground, compute_uv=False)
    return (1 / float(most), 1 / float(least)) if least > 0 else (1.0, 1.0)


def _degrees(latitude: float) -> tuple[float, float]:
    """Metres in a degree of longitude and of latitude, on the WGS 84 ellipsoid."""
    a, e2 = 6378137.0, 0.00669437999014
    s = 1 - e2 * np.sin(np.radians(latitude)) ** 2
    return np.pi / 180 * a * np.cos(np.radians(latitude)) / s**0.5, np.pi / 180 * a * (1 - e2) / s**1.5


def _squared(rasterio: Any, raster: Raster, east: float, north: float) -> Raster:
    """``raster`` in square cells of the shorter side; bilinear, and no data where a neighbour has none."""
    rows, cols = raster.values.shape
    t, side = raster.transform, min(east, north)
    shape = max(1, round(rows * north / side)), max(1, round(cols * east / side))
    transform = rasterio.Affine(t.a * cols / shape[1], 0, t.c, 0, t.e * rows / shape[0], t.f)
    plane = "EPSG:3857"  # any system will do
    warp = dict(src_transform=t, dst_transform=transform, src_crs=plane, dst_crs=plane)
    warp["resampling"] = rasterio.warp.Resampling.bilinear
    values, share = np.zeros(shape, np.float64), np.zeros(shape, np.float64)
    rasterio.warp.reproject(np.where(raster.mask, raster.values, 0).astype(np.float64), values, **warp)
    rasterio.warp.reproject(raster.mask.astype(np.float64), share, **warp)
    return replace(raster, values=values.astype(np.float32), mask=share > 1 - 1e-6, transform=transform)
