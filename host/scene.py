"""Scene: a depth map with its spacing, albedo, mask and sides. It is checked here, once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .arrays import Labels, host_array, labels_of, on_device
from .backends.resident import Resident, find
from .checks import at, one_of, positive_number, real_array
from .constants import SIDES
from .errors import bad
from .reflectance import Lambertian, Reflectance, fit

ALBEDO = 0.8
STEEPEST = 1e15  # spacings of depth, so that squares of slopes stay in float32


@dataclass(frozen=True, eq=False)
class Scene:
    """A surface seen from above: depth map, spacing, albedo, mask and what stands at the sides.

    Arrays may be NumPy's, or have ``__array__``, ``__dlpack__`` or ``__cuda_array_interface__``. They are
    copied; the caller's are never changed. A depth (or height) that is an xarray.DataArray is remembered as
    ``labels``, and what has the scene's rows and columns comes back as one: with its dimensions, coordinates,
    name and attributes. A float32 depth or height without a mask that lies on a GPU (or in a Warp array)
    stays there: skies by horizons, horizons, sky-view factor and openness on that device's backend, which
    ``auto`` takes then, never bring it to the host.

    Parameters
    ----------
    depth : (rows, cols) real array [length]
        Distance of the surface from the viewer's plane z = 0; larger is farther. Not negative.
    spacing : float [length]
        Distance between neighbouring nodes along rows and columns, in the unit of ``depth``.
    albedo : float, (rows, cols) array, or RGB as (3,) or (rows, cols, 3)
        Diffuse (directional-hemispheric) reflectance, 0 to 1.
    mask : (rows, cols) bool array, optional
        True where data are valid. Nodes that are not valid neither block light nor are lit.
    sides : "open", "dark" or "periodic"
        ``open``: a ray that leaves sideways goes on unblocked. ``dark``: the map stands in a black box
        whose walls, half a node outside the outermost nodes, reach up to z = 0. ``periodic``: the map
        repeats.
    reflectance : Lambertian, Phong, Mirror or BRDF, in place of ``albedo``
        What the surface makes of its light; ``albedo`` is then its diffuse part.

    Raises
    ------
    InputError
        For an array of wrong shape or type, an empty one, NaN or infinity where the mask says valid,
        negative depth, an albedo outside 0 to 1, a spacing that is not positive, unknown sides, or a
        reflectance that gives more than it gets.
    """

    depth: np.ndarray
    spacing: float = 1.0
    albedo: float | np.ndarray = ALBEDO
    mask: np.ndarray | None = None
    sides: str = "open"
    reflectance: Reflectance | None = None
    _values: np.ndarray = field(init=False, repr=False)
    _step: float = field(init=False, repr=False)
    labels: Labels | None = field(init=False, repr=False, default=None)
    # the depth on a device of Warp's, if it was given there
    resident: Resident | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        _set(self, labels=labels_of(self.depth))
        if self.mask is None and (found := resident_map(self.depth)) is not None:
            self._keep(found)
            return
        depth = real_array(self.depth, "depth")
        _set(self, spacing=positive_number(self.spacing, "spacing"))
        one_of(self.sides, tuple(SIDES), "sides")
        _set(self, mask=_mask(self.mask, depth.shape))
        valid = np.ones(depth.shape, bool) if self.mask is None else self.mask
        if not valid.any():
            raise bad("mask: no valid node", "False everywhere", "at least one True")
        broken = valid & ~np.isfinite(depth)
        if broken.any():
            raise bad(
                f"depth: {broken.sum()} values are NaN or infinite, first {at(broken)}",
                depth[broken][0],
                "finite depth wherever the mask is True",
                "Pass mask=numpy.isfinite(depth) to leave them out.",
            )
        low = valid & (depth < 0)
        if low.any():
            raise bad(
                f"depth: negative {at(low)}",
                depth[low][0],
                "depth >= 0 (0 is the viewer's plane)",
                "For terrain heights use Scene.from_height.",
            )
        depth[~valid] = np.nan
        with np.errstate(over="ignore"):
            depth = depth.astype(np.float32)
        if np.isinf(depth).any():
            raise bad(
                f"depth: too large for float32 {at(np.isinf(depth))}", "more than 3.4e38", "a smaller unit"
            )
        if depth[valid].max() / self.spacing > STEEPEST:
            raise bad(
                "depth: too deep for its spacing",
                f"{depth[valid].max()} at spacing {self.spacing}",
                f"at most {STEEPEST:g} spacings",
                "Give both in one unit.",
            )
        surface = _reflectance(self.albedo, self.reflectance, depth.shape, valid)
        values, step = _lattice(np.where(valid, depth, np.float32(np.inf)), self.spacing)
        _set(self, depth=depth, reflectance=surface, albedo=surface.albedo, _values=values, _step=step)
        for array in (self.depth, self.mask, values):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False

    def _keep(self, found: Resident) -> None:
        """Keep a depth map on its device; the host's copies are made on first use."""
        _set(self, spacing=positive_number(self.spacing, "spacing"))
        one_of(self.sides, tuple(SIDES), "sides")
        if found.broken:
            raise bad(
                f"depth: {found.broken} values are NaN or infinite",
                f"a map on {found.backend.name}",
                "finite depth",
                "Bring it to the host and pass mask=numpy.isfinite(depth) to leave them out.",
            )
        if found.least < 0:
            raise bad(
                "depth: negative",
                found.least,
                "depth >= 0 (0 is the viewer's plane)",
                "For terrain heights use Scene.from_height.",
            )
        if found.most / self.spacing > STEEPEST:
            raise bad(
                "depth: too deep for its spacing",
                f"{found.most} at spacing {self.spacing}",
                f"at most {STEEPEST:g} spacings",
                "Give both in one unit.",
            )
        surface = _reflectance(self.albedo, self.reflectance, found.shape, np.ones(found.shape, bool))
        _set(self, reflectance=surface, albedo=surface.albedo, resident=found)
        object.__delattr__(self, "depth")

    def __getattr__(self, name: str) -> Any:
        """The host's copies of a depth map on a device, downloaded when they are first asked for."""
        resident: Resident | None = self.__dict__.get("resident")
        if name not in ("depth", "_values", "_step") or resident is None:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        depth = resident.download()
        values, step = _lattice(depth, self.spacing)
        _set(self, depth=depth, _values=values, _step=step)
        depth.flags.writeable = values.flags.writeable = False
        return self.__dict__[name]

    @classmethod
    def from_height(
        cls,
        height: Any,
        spacing: float = 1.0,
        albedo: float | np.ndarray = ALBEDO,
        mask: np.ndarray | None = None,
        sides: str = "open",
        reflectance: Reflectance | None = None,
    ) -> Scene:
        """A scene from terrain height [length]: depth = max(valid height) - height.

        ``height``: (rows, cols); the other arguments and errors as for :class:`Scene`.
        """
        labels = labels_of(height)
        if mask is None and (found := resident_map(height, height=True)) is not None:
            resident: Any = found
            return cls(resident, spacing, albedo, None, sides, reflectance)
        height = real_array(height, "height")
        mask = _mask(mask, height.shape)
        valid = np.ones(height.shape, bool) if mask is None else mask
        broken = valid & ~np.isfinite(height)
        if broken.any():
            raise bad(
                f"height: {broken.sum()} values are NaN or infinite, first {at(broken)}",
                height[broken][0],
                "finite height wherever the mask is True",
                "Pass mask=numpy.isfinite(height) to leave them out.",
            )
        top = height[valid].max() if valid.any() else 0.0
        scene = cls(np.where(valid, top - height, np.nan), spacing, albedo, mask, sides, reflectance)
        _set(scene, labels=labels)
        return scene

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.depth.shape if self.resident is None else self.resident.shape

    @property
    def valid(self) -> np.ndarray:
        """(rows, cols) bool: where data are valid."""
        return np.ones(self.shape, bool) if self.mask is None else self.mask

    def lattice(self) -> tuple[np.ndarray, float]:
        """What the lattice methods compare: (values, step).

        Depth itself and the spacing, in float32; where every depth is a whole number of layers, the layers
        and 1, which is the same comparison without any rounding. Masked nodes are +inf: they never block.
        """
        return self._values, self._step

    def layers(self) -> tuple[np.ndarray, float]:
        """Depth rounded to layers, rint(depth / spacing), and the step 1, for the field and for carving."""
        return np.rint(self._values.astype(np.float64) / self._step).astype(np.float32), 1.0


def resident_map(values: Any, height: bool = False) -> Resident | None:
    """``values`` as a Resident where they lie on a device of Warp's as float32, else None."""
    if isinstance(values, (np.ndarray, list, int, float)):
        return None
    if isinstance(values, Resident):
        return values
    try:
        found = on_device(values)
    except Exception:  # real_array meets the same, and says so
        return None
    return None if found is None else find(found, height)


def is_scene(scene: object) -> None:
    """InputError unless ``scene`` is a Scene."""
    if not isinstance(scene, Scene):
        raise bad("scene", type(scene).__name__, "a skylamp.Scene")


def _set(scene: Scene, **values: object) -> None:
    """Sets fields of a frozen scene while it is made."""
    for name, value in values.items():
        object.__setattr__(scene, name, value)


def _mask(mask: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """A copy of a mask, checked."""
    if mask is None:
        return None
    try:
        mask = host_array(mask)
    except Exception as error:
        raise bad("mask: not an array", str(error), f"bool, shape {shape}") from None
    if mask.dtype != bool or mask.shape != shape:
        raise bad(
            "mask: wrong type or shape", f"dtype {mask.dtype}, shape {mask.shape}", f"bool, shape {shape}"
        )
    return np.array(mask)


def _reflectance(
    albedo: float | np.ndarray, given: Any, shape: tuple[int, int], valid: np.ndarray
) -> Reflectance:
    """The reflectance of a scene, from one of its two arguments, checked."""
    if given is None:
        given = Lambertian(albedo)
    elif not isinstance(given, Reflectance):
        raise bad("reflectance", type(given).__name__, "Lambertian, Phong, Mirror or BRDF")
    elif not np.array_equal(albedo, ALBEDO):
        raise bad(
            "scene: albedo and reflectance",
            "both",
            "one of them",
            "The diffuse albedo is an argument of the reflectance.",
        )
    surface: Reflectance = given
    fit(surface, shape, valid)
    return surface


def _lattice(depth: np.ndarray, spacing: float) -> tuple[np.ndarray, float]:
    """What :meth:`Scene.lattice` gives."""
    # Whole layers compare exactly as integers; dividing anything else by the spacing would flip bits.
    with np.errstate(invalid="ignore"):
        layers = np.rint(depth.astype(np.float64) / spacing)
        whole = (layers * spacing).astype(np.float32) == depth
    if whole.all() and layers[np.isfinite(layers)].max() < 2**20:
        return layers.astype(np.float32), 1.0
    return depth, spacing
