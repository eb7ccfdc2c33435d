"""Scene: a depth map with its spacing, albedo, mask and sides. It is checked here, once."""

from __future__ import annotations

import contextlib
import importlib
import math
import warnings
import weakref
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from .arrays import (
    LENGTH_TOLERANCE,
    Labels,
    as_promised,
    axes_of,
    by_bands,
    chunked,
    host_array,
    labels_of,
    lies_on,
    no_data_of,
    on_device,
    scratch,
    spacing_of,
)
from .backends import resident, select
from .backends.base import Array, Backend
from .backends.resident import Resident
from .checks import as_real, at, one_of, positive_number
from .constants import SIDES
from .errors import InputError, bad
from .reflectance import Lambertian, Reflectance, fitted

ALBEDO = 0.8
STEEPEST = 1e15  # spacings of depth, so that squares of slopes stay in float32
# by how much float32 may round depths [spacings] before they are counted from the least; chosen: light is off
# by as much, a tenth of a tolerance of 0.1 %, and depths of 1,700 spacings are rounded so
ROUNDED = 1e-4
# widths of a map that its relief may have without a warning. Chosen: 200 m of relief on 64 nodes of an arc
# second have 11,000, 8 km on 60 degrees 133, and no terrain in metres has 10
STEEPEST_MAP = 100
KEPT = 0.25  # share of a device's memory that maps of scenes may take between calls; chosen


@dataclass(frozen=True, eq=False)
class Scene:
    """A surface seen from above: depth map, spacing, albedo, mask and surroundings.

    Arrays may be NumPy's, or have ``__array__``, ``__dlpack__`` or ``__cuda_array_interface__``. They are
    copied; the caller's are never changed. A depth (or height) that is an xarray.DataArray is kept as
    ``labels``, and images, horizons and depths of the scene are DataArrays: with its dimensions, coordinates
    and other attributes, and a name and units of their own. Values that are not finite, or that its
    attributes ``_FillValue``, ``missing_value``, ``nodata`` and ``nodatavals`` or rioxarray's ``rio.nodata``
    name, are masked besides what ``mask`` leaves out. Where its y grows with the rows, or its x falls along
    them, skies and the azimuths of horizons are turned to it: north is where y grows, east where x does.
    Positions of lamps and windows are measured along columns and rows.

    A contiguous float32 depth or height that lies on a GPU stays there, on that device's backend, which
    ``auto`` takes then; a mask is uploaded once. Of other types, and on other backends, the
    host makes a copy first. So do lobes, mirrors, BRDFs, light between surfaces where a method is asked for,
    and brightness that is taken along rays. ``on`` gives the copy that a backend keeps, ``release`` frees it.

    Parameters
    ----------
    depth : (rows, cols) real array [length]
        Distance of the surface from the viewer's plane z = 0; larger is farther. Not negative.
    spacing : float [length]
        Distance between neighbouring nodes along rows and columns, in the unit of ``depth``. A warning where
        it is 1 and the coordinates of a DataArray have another one.
    albedo : float, (rows, cols) array, or RGB as (3,) or (rows, cols, 3)
        Diffuse (directional-hemispheric) reflectance, 0 to 1.
    mask : (rows, cols) bool array, optional
        True where data are valid. Nodes that are not valid neither block light nor are lit.
    sides : "open", "dark" or "periodic"
        ``open``: a ray that leaves sideways goes on unblocked. ``dark``: the map stands in a black box
        whose walls, half a node outside the outermost nodes, reach up to z = 0. ``periodic``: the map
        repeats.
    reflectance : Lambertian, Phong, Mirror or BRDF, in place of ``albedo``
        Reflectance of the surface; ``albedo`` is then its diffuse part.
    labels : Labels, optional
        Those of a DataArray, for a depth that is none: ``dataclasses.replace`` passes them on.

    Raises
    ------
    InputError
        For an array of wrong shape or type, an empty one, NaN or infinity where the mask is True,
        negative depth, an albedo outside 0 to 1, a spacing that is not positive, unknown sides, or a
        reflectance that is not energy-bounded.

    Examples
    --------
    >>> y, x = np.mgrid[:64, :64]
    >>> scene = sl.Scene(5 + np.sin(x / 4), spacing=2.0, albedo=0.5, sides="periodic")
    >>> terrain = sl.Scene.from_height(100 * np.sin(y / 9), spacing=30.0)
    >>> terrain.shape, round(float(terrain.depth.min()), 3)
    ((64, 64), 0.0)
    """

    depth: np.ndarray = field(repr=False)
    spacing: float = 1.0
    albedo: float | np.ndarray = ALBEDO
    mask: np.ndarray | None = None
    sides: str = "open"
    reflectance: Reflectance | None = None
    labels: Labels | None = field(repr=False, default=None, kw_only=True)
    # 1 where columns run east and rows south, -1 where they run west and north, by the labels
    axes: tuple[float, float] = field(init=False, repr=False, default=(1.0, 1.0))
    # heights [length] of a map that is not computed yet, a dask.array (rows, cols), nan where masked
    lazy: Any = field(init=False, repr=False, default=None)
    # the depth on a device of Warp's, if it was given there
    resident: Resident | None = field(init=False, repr=False, default=None)
    # values that the lattice methods compare, and their step: depth and the spacing, in float32; where every
    # depth is a whole number of layers, the layers and 1, which is the same comparison without any rounding.
    # Masked nodes are +inf: they never block. Made on first use
    lattice: tuple[np.ndarray, float] = field(init=False, repr=False)
    _range: tuple[float, float] = field(init=False, repr=False)  # least and greatest valid depth [length]
    # by how much float32 rounds the depths that were given, if more than ROUNDED and than it need [spacings]
    rounding: float = field(init=False, repr=False, default=0.0)
    _from_least: Scene | None = field(init=False, repr=False, default=None)  # see under_sky()

    def __post_init__(self) -> None:
        given, height = (self.depth.values, True) if isinstance(self.depth, _Heights) else (self.depth, False)
        what = "height" if height else "depth"
        own = labels_of(given)
        labels = own or self.labels
        _set(self, labels=labels, spacing=positive_number(self.spacing, "spacing"), axes=axes_of(labels))
        one_of(self.sides, tuple(SIDES), "sides")
        maps = getattr(self.reflectance, "labels", {})
        for name, beside in [("mask", self.mask), ("albedo", self.albedo), *maps.items()]:
            lies_on(labels, beside, name)
        if chunked(given) is not None:
            self._hold(chunked(given), height)
            return
        there = _on_device(given)
        values: Any = as_real(given, what) if there is None else None
        shape = there.shape if there is not None else values.shape
        if labels is not None and not labels.are_of(shape):
            raise bad("labels", "those of another map", f"coordinates of shape {shape}", "Pass labels=None.")
        if own is not None and not height:
            check_spacing(self.spacing, own)
        mask = mask_of(self.mask, shape)
        _set(self, mask=mask if there is not None else known_of(given, own, mask))
        if self.mask is not None and not self.mask.any():
            raise bad("mask: no valid node", "False everywhere", "at least one True")
        if values is None:
            self._keep(there, height)
        else:
            _set(self, **_checked(values, self.mask, what))
            for array in (self.depth, self.mask):
                if array is not None:
                    array.flags.writeable = False
        least, most = self._range
        if not height and least < 0:
            raise bad(
                "depth: negative" + ("" if values is None else f" {at(self.depth < 0)}"),
                least,
                "depth >= 0 (0 is the viewer's plane)",
                "For terrain heights use Scene.from_height.",
            )
        if most / self.spacing > STEEPEST:
            raise bad(
                "depth: too deep for its spacing",
                f"{most} at spacing {self.spacing}",
                f"at most {STEEPEST:g} spacings",
                "Give both in one unit.",
            )
        surface = _reflectance(self.albedo, self.reflectance, shape, self.mask)
        _set(self, reflectance=surface, albedo=surface.albedo)
        rounding = most * 2.0**-24 / self.spacing
        if not height and values is not None and rounding > ROUNDED:
            _count_from_least(self, values, rounding)

    def _hold(self, values: Any, height: bool) -> None:
        """Keep a dask.array; only its type and shape are looked at."""
        if not height:
            raise bad("depth: a lazy map", "a dask.array of depth", "heights", "Use Scene.from_height.")
        dask, shape = importlib.import_module("dask.array"), values.shape
        if values.dtype.kind not in "iuf" or len(shape) != 2 or not all(n > 0 for n in shape):
            raise bad("height", f"{values.dtype}, shape {shape}", "real numbers (rows, cols), of known size")
        values = as_promised(values, "height")
        values = values.astype(np.float32 if np.can_cast(values.dtype, np.float32) else np.float64)
        masks = [values != values.dtype.type(value) for value in no_data_of(self.labels)]
        if self.mask is not None:
            masks.append(mask_of(self.mask, shape, lazy=True))
        for mask in masks:
            values = dask.where(mask, values, values.dtype.type(np.nan))
        albedo = chunked(self.albedo)
        if albedo is None and np.ndim(self.albedo) > 1:  # where the map has no data it need not be an albedo
            albedo = dask.from_array(np.asarray(self.albedo), chunks=-1)
        if albedo is None:
            surface = _reflectance(self.albedo, self.reflectance, shape, None)
            albedo = surface.albedo
            if np.ndim(albedo) > 1:
                albedo = dask.from_array(albedo, chunks=-1)
        elif self.reflectance is not None or albedo.shape not in (shape, (*shape, 3)):
            raise bad(
                "albedo: a map of a lazy scene",
                f"shape {albedo.shape}" + ("" if self.reflectance is None else " and a reflectance"),
                f"shape {shape} or {(*shape, 3)}, without a reflectance",
            )
        else:
            surface, albedo = Lambertian(), as_promised(albedo, "albedo")
        _set(self, lazy=values, mask=None, reflectance=surface, albedo=albedo)
        object.__delattr__(self, "depth")

    def _keep(self, values: Array, height: bool) -> None:
        """Keep a map on its device; the host's copies are made when they are first asked for."""
        backend = select(f"warp:{values.device.alias}")
        with backend.lock:
            depth, surveyed = resident.adopt(backend, values.flatten(), values.shape, self.mask, height)
            if surveyed.broken:
                raise bad(
                    f"{'height' if height else 'depth'}: {surveyed.broken} values are NaN or infinite",
                    f"a map on {backend.name}",
                    "finite values wherever the mask is True",
                    "Pass a mask that is False there.",
                )
            kept = resident.in_layers(backend, depth, values.shape, self.spacing, surveyed)
        _set(self, resident=kept, _range=(surveyed.least, surveyed.most))
        object.__delattr__(self, "depth")

    def __getstate__(self) -> dict[str, Any]:
        """The fields, with the host's copy of a map that lies on a device."""
        if self.resident is not None:
            _ = self.depth
        return {name: value for name, value in vars(self).items() if name not in ("resident", "lattice")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def __getattr__(self, name: str) -> Any:
        """Values made on first use: those of the lattice, and the host's copies of a map on a device."""
        if name in ("depth", "lattice", "_range") and self.__dict__.get("lazy") is not None:
            raise bad(
                "a lazy map",
                f"a call that needs all of its {self.shape[0]} x {self.shape[1]} nodes",
                "horizons, sky_view_factor, openness and render, which are lazy too",
                "For other calls compute() it first.",
            )
        if name not in ("depth", "lattice") or "_range" not in self.__dict__:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        kept: Resident | None = self.__dict__.get("resident")
        if kept is None:
            values, step = _lattice(self.depth, self.mask, self.spacing, self._range[1])
        else:
            values, step = kept.download(), kept.step
            depth = values
            if step != self.spacing:
                depth = (values.astype(np.float64) * self.spacing).astype(np.float32)
            if self.mask is not None:
                depth = np.where(self.mask, depth, np.float32(np.nan))
            depth.flags.writeable = False
            _set(self, depth=depth)
        values.flags.writeable = False
        _set(self, lattice=(values, step))
        return self.__dict__[name]

    @classmethod
    def from_height(
        cls,
        height: Any,
        spacing: float | None = None,
        albedo: float | np.ndarray = ALBEDO,
        mask: np.ndarray | None = None,
        sides: str = "open",
        reflectance: Reflectance | None = None,
    ) -> Scene:
        """A scene from terrain height [length]: depth = max(valid height) - height.

        ``height``: (rows, cols); the other arguments and errors as for :class:`Scene`. The difference is
        taken in the type of ``height`` before it is rounded to float32, so heights far above zero keep their
        relief. ``spacing``: unless given, that of an xarray.DataArray's coordinates, which must be even,
        square and no degrees, in the unit of ``height``; without these, that of its reference system's
        transform (rioxarray), else 1.

        A dask.array, or a DataArray with Dask's chunks, makes a lazy scene: nan is where it has no data, and
        horizons, sky_view_factor, openness and render give lazy results of the same chunks. A map of its
        albedo may be lazy too, in chunks of its own; values outside 0 to 1 are found when it is computed.
        """
        heights: Any = _Heights(height)
        found = spacing_of(labels_of(height)) if spacing is None else spacing
        scene = cls(heights, found, albedo, mask, sides, reflectance)
        if spacing is None and scene.labels is not None and scene.lazy is None:
            _check_relief(scene)
        return scene

    def on(self, backend: Backend) -> Resident:
        """The values of ``lattice`` on a backend: uploaded once, and kept while the scene lives.

        A backend keeps the scenes that were used last, up to KEPT of its memory; :meth:`release` ends it.
        """
        if self.resident is not None and self.resident.backend is backend:
            return self.resident
        kept, key = backend.kept, id(self)
        if key in kept:
            kept.move_to_end(key)
            known: Resident = kept[key][0]
            return known
        values, step = self.lattice
        least, most = self._range if step == self.spacing else np.rint(np.array(self._range) / self.spacing)
        uploaded: Resident = resident.upload(backend, values, step, float(least), float(most))
        kept[key] = uploaded, weakref.finalize(self, kept.pop, key, None)
        while len(kept) > 1 and sum(there.nbytes for there, _ in list(kept.values())) > KEPT * backend.memory:
            kept.popitem(last=False)[1][1].detach()
        return uploaded

    def under_sky(self) -> Scene:
        """The scene as a sky lights it: depths far from zero are counted from the least one."""
        return self if self._from_least is None or self.sides == "dark" else self._from_least

    def stays_on(self, backend: Backend) -> bool:
        """Whether the map was given on this GPU, so that images stay there too."""
        return self.resident is not None and self.resident.backend is backend and not backend.shares

    def release(self, backend: str = "auto") -> None:
        """Free the copy of the map that a backend keeps; the next call uploads it again.

        The memory pool of a GPU gives back what it holds for later arrays.

        Raises BackendError.
        """
        engine = select(backend)
        if id(self) in engine.kept:
            engine.kept.pop(id(self))[1].detach()
        if self._from_least is not None:
            self._from_least.release(backend)
        engine.trim()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        held = self.lazy if self.lazy is not None else self.resident
        rows, cols = self.depth.shape if held is None else held.shape
        return rows, cols

    @property
    def deepest(self) -> float:
        """The greatest valid depth [length]."""
        return self._range[1]

    @property
    def valid(self) -> np.ndarray:
        """(rows, cols) bool: where data are valid. InputError of a lazy map."""
        if self.lazy is not None:
            raise bad("Scene.valid", "a lazy map", "a map in memory", "Compute its heights first.")
        return np.ones(self.shape, bool) if self.mask is None else self.mask

    def layers(self) -> tuple[np.ndarray, float]:
        """Depth rounded to layers, rint(depth / spacing), and the step 1, for the field and for carving."""
        values, step = self.lattice
        return np.rint(values.astype(np.float64) / step).astype(np.float32), 1.0


def depth_at(scene: Scene, row: int, col: int) -> np.float32:
    """Depth of one node [length]; a map on a device stays there. Not finite where masked."""
    if scene.resident is None:
        value: np.float32 = scene.depth[row, col]
        return value
    depth = scene.resident.pick(np.array([row * scene.shape[1] + col]))[0]
    return np.float32(depth * (scene.spacing / scene.resident.step))


class _Heights(NamedTuple):
    """Heights in place of depths, as :meth:`Scene.from_height` hands them over."""

    values: Any


def _on_device(values: Any) -> Array | None:
    """``values`` as a Warp array (rows, cols) where they lie on a device of Warp's as float32, else None.

    None too where they are not contiguous: the host converts them first.
    """
    if isinstance(values, (np.ndarray, list, int, float)):
        return None
    try:
        array = on_device(values)
    except Exception:  # as_real meets the same, and says so
        return None
    if array is None or array.dtype.__name__ != "float32" or array.ndim != 2:
        return None
    return array if array.size and array.is_contiguous else None


def _checked(values: np.ndarray, mask: np.ndarray | None, what: str) -> dict[str, Any]:
    """``depth``, a float32 copy of a host's map that is nan where masked, and ``_range`` of it [length].

    One pass finds the range, one copies; ``what`` is "depth" or "height". InputError for values that are no
    length.
    """
    least, most = _range_of(values, mask)
    if not (math.isfinite(least) and math.isfinite(most)):
        broken = ~np.isfinite(values) if mask is None else mask & ~np.isfinite(values)
        raise bad(
            f"{what}: {broken.sum()} values are NaN or infinite, first {at(broken)}",
            values[broken][0],
            f"finite {what} wherever the mask is True",
            "Pass mask=numpy.isfinite(depth) to leave them out.".replace("depth", what),
        )
    # of the map's own type where that is at least float32, so that what is rounded is the difference; whole
    # numbers of 64 bits are subtracted modulo 2^64, which is exact
    top: Any = None
    extreme = max(least, most, key=abs)
    whole = values.dtype.kind in "iu" and values.dtype.itemsize == 8
    if what == "height" and whole:
        top = np.uint64(most % 2**64)
        least, most = 0, np.uint64(most - least)
    elif what == "height":
        top = np.float32(most) if values.dtype == np.float32 else np.float64(most)
        with np.errstate(over="ignore"):
            least, most = 0.0, float(top - np.asarray(least, top.dtype))
    if most > float(np.finfo(np.float32).max):
        where = at(values == extreme)
        raise bad(f"{what}: too large for float32 {where}", extreme, "at most 3.4e38", "Use a smaller unit.")
    depth = scratch(values.shape)

    def copy(rows: slice) -> None:
        if top is None:
            np.copyto(depth[rows], values[rows], casting="unsafe")
        else:
            part = values[rows].astype(np.uint64, copy=False) if whole else values[rows]
            np.subtract(top, part, out=depth[rows], casting="same_kind")
        if mask is not None:
            depth[rows][~mask[rows]] = np.nan

    with np.errstate(over="ignore", invalid="ignore"):  # where masked
        by_bands(copy, values.shape)
    return {"depth": depth, "_range": (float(np.float32(least)), float(np.float32(most)))}


def _range_of(values: np.ndarray, mask: np.ndarray | None) -> tuple[Any, Any]:
    """Least and greatest valid value, int of whole numbers, else float; nan or infinite if one is."""

    def of(rows: slice) -> tuple[Any, Any] | None:
        some = values[rows] if mask is None else values[rows][mask[rows]]
        return (some.min().item(), some.max().item()) if some.size else None

    lows, highs = zip(*(ends for ends in by_bands(of, values.shape) if ends is not None))
    if values.dtype.kind in "iu":
        return min(lows), max(highs)
    return float(np.min(lows)), float(np.max(highs))


def check_scene(scene: object) -> None:
    """InputError unless ``scene`` is a Scene."""
    if not isinstance(scene, Scene):
        raise bad(
            "scene",
            type(scene).__name__,
            "a skylamp.Scene",
            "Of heights: Scene.from_height; of a Raster: its scene().",
        )


def _set(scene: Scene, **values: object) -> None:
    """Sets fields of a frozen scene while it is made."""
    for name, value in values.items():
        object.__setattr__(scene, name, value)


def _count_from_least(scene: Scene, values: np.ndarray, rounding: float) -> None:
    """Keep a scene of depths counted from the least, if they are smaller and float32 rounds ``values``."""
    least, most = _range_of(values, scene.mask)
    if np.can_cast(values.dtype, np.float32) or not 0 < most - least < least:
        return
    with np.errstate(invalid="ignore"):  # where masked
        near = replace(scene, depth=values - least)
    _set(scene, rounding=rounding, _from_least=near)


def mask_of(mask: Any, shape: tuple[int, ...], lazy: bool = False) -> Any:
    """A copy of a mask, checked; a dask.array stays one if ``lazy``."""
    if mask is None:
        return None
    lazy = lazy and chunked(mask) is not None
    try:
        mask = chunked(mask) if lazy else host_array(mask)
    except Exception as error:
        raise bad("mask: not an array", str(error), f"bool, shape {shape}") from None
    if mask.dtype != bool or mask.shape != shape:
        raise bad(
            "mask: wrong type or shape", f"dtype {mask.dtype}, shape {mask.shape}", f"bool, shape {shape}"
        )
    return as_promised(mask, "mask") if lazy else np.array(mask)


def known_of(given: Any, labels: Labels | None, mask: np.ndarray | None) -> np.ndarray | None:
    """A mask without the nodes at which a DataArray has no data; None where there is nothing to leave out."""
    no_data = no_data_of(labels)
    if labels is None or given.dtype.kind not in "iuf":
        return mask
    values = given.values
    known: np.ndarray = np.isfinite(values)
    for value in no_data:
        known &= values != (values.dtype.type(value) if values.dtype.kind == "f" else value)
    if known.all():
        return mask
    return known if mask is None else known & mask


def check_spacing(spacing: float, labels: Labels) -> None:
    """Warn where a spacing of 1, that of a scene which is given none, is not that of the coordinates."""
    if spacing != 1:
        return
    with contextlib.suppress(InputError):  # coordinates that are no lengths
        found = spacing_of(labels)
        if abs(found - 1) > LENGTH_TOLERANCE:
            warnings.warn(
                f"Spacing: 1 is taken, and the coordinates are {found:g} apart. Give spacing={found:g}, in"
                " the unit of depth.",
                stacklevel=2,  # one place, so that Python says it once
            )


def _check_relief(scene: Scene) -> None:
    """Warn where heights vary by far more than a map is wide, as where its coordinates are degrees."""
    wide = scene.spacing * max(scene.shape)
    if scene.deepest > STEEPEST_MAP * wide:
        warnings.warn(
            f"Spacing: heights vary by {scene.deepest:.3g} over a map that is {wide:.3g} wide by its"
            " coordinates. If these are degrees, reproject the map, or give spacing, in the unit of height.",
            stacklevel=3,
        )


def _reflectance(
    albedo: float | np.ndarray, given: Any, shape: tuple[int, int], mask: np.ndarray | None
) -> Reflectance:
    """The reflectance of a scene, from one of its two arguments, checked."""
    if given is None:
        given = Lambertian(albedo)
    elif not isinstance(given, Reflectance):
        raise bad("reflectance", type(given).__name__, "Lambertian, Phong, Mirror or BRDF")
    elif albedo is not given.albedo and not np.array_equal(albedo, ALBEDO):  # as where one field is replaced
        raise bad(
            "scene: albedo and reflectance",
            "both",
            "one of them",
            "The diffuse albedo is an argument of the reflectance. Where the albedo of a scene is replaced:"
            " reflectance=None beside it.",
        )
    return fitted(given, shape, mask)


def _lattice(
    depth: np.ndarray, mask: np.ndarray | None, spacing: float, most: float
) -> tuple[np.ndarray, float]:
    """What ``Scene.lattice`` holds."""

    def layers(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        whole = np.rint(depth[rows].astype(np.float64) / spacing)
        same: np.ndarray = (whole * spacing).astype(np.float32) == depth[rows]
        return whole, same if mask is None else same | ~mask[rows]

    # Whole layers compare exactly as integers; dividing anything else by the spacing would flip bits.
    in_layers = most / spacing < resident.LAYERS and bool(layers(slice(0, 1))[1].all())
    if in_layers and spacing != 1:
        in_layers = all(by_bands(lambda rows: bool(layers(rows)[1].all()), depth.shape))
    step = 1.0 if in_layers else spacing
    if mask is None and (spacing == 1 or not in_layers):
        return depth, step
    values = scratch(depth.shape)

    def copy(rows: slice) -> None:
        values[rows] = layers(rows)[0] if in_layers and spacing != 1 else depth[rows]
        if mask is not None:
            values[rows][~mask[rows]] = np.inf

    with np.errstate(invalid="ignore"):
        by_bands(copy, depth.shape)
    return values, step
