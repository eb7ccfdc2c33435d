"""Scene: a depth map with its spacing, albedo, mask and sides. All validation of a scene happens here, once."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .errors import InputError, bad

SIDES = ("open", "dark", "periodic")
ALBEDO = 0.8
STEEPEST = 1e15  # spacings of depth, so that squares of slopes stay in float32


def real_array(values, what: str, ndim: int | None = 2) -> np.ndarray:
    """``values`` as a real float64 array of ``ndim`` axes, not empty; never a view that a caller could see change."""
    if isinstance(values, np.ma.MaskedArray):
        raise bad(f"{what}: a numpy masked array", "mask inside the array", "plain arrays", "Pass array.data and mask=~numpy.ma.getmaskarray(array).")
    try:
        array = np.asarray(values)
    except Exception as error:
        raise InputError(f"{what}: not an array ({error}); allowed: a real array.") from error
    if array.dtype.kind not in "iuf":
        raise bad(f"{what}: wrong type", f"dtype {array.dtype}", "real numbers (integer or floating)")
    if ndim is not None and array.ndim != ndim:
        raise bad(f"{what}: wrong shape", array.shape, f"{ndim} axes" + (" (rows, cols)" if ndim == 2 else ""))
    if array.size == 0:
        raise bad(f"{what}: empty array", f"shape {array.shape}", "at least one element")
    return array.astype(np.float64)


def one_of(value, allowed: tuple[str, ...], what: str) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise bad(what, repr(value), " | ".join(allowed))


def positive_number(value, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise bad(f"{what}: not a number", repr(value), "a finite number > 0") from None
    if not (np.isfinite(number) and number > 0):
        raise bad(what, number, "a finite number > 0")
    return number


def at(index) -> str:
    """Where the first true element of a boolean array is, for messages."""
    return f"at (row, col) = {tuple(int(i) for i in np.argwhere(index)[0])}"


@dataclass(frozen=True, eq=False)
class Scene:
    """A surface seen from above: depth map, spacing, albedo, mask and what stands at the sides.

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
        whose walls, half a node outside the outermost nodes, reach up to z = 0. ``periodic``: the map repeats.
    reflectance : Lambertian, Phong, Mirror or BRDF, in place of ``albedo``
        What the surface makes of its light; ``albedo`` is then its diffuse part.

    Raises
    ------
    InputError
        For an array of wrong shape or type, an empty one, NaN or infinity where the mask says valid,
        negative depth, an albedo outside 0 to 1, a spacing that is not positive, unknown sides, or a reflectance that
        gives more than it gets.

    The arrays given are copied; the caller's are never changed.
    """

    depth: np.ndarray
    spacing: float = 1.0
    albedo: float | np.ndarray = ALBEDO
    mask: np.ndarray | None = None
    sides: str = "open"
    reflectance: Reflectance | None = None
    _values: np.ndarray = field(init=False, repr=False)
    _step: float = field(init=False, repr=False)

    def __post_init__(self):
        put = lambda name, value: object.__setattr__(self, name, value)
        depth = real_array(self.depth, "depth")
        put("spacing", positive_number(self.spacing, "spacing"))
        one_of(self.sides, SIDES, "sides")
        put("mask", _mask(self.mask, depth.shape))
        valid = np.ones(depth.shape, bool) if self.mask is None else self.mask
        if not valid.any():
            raise bad("mask: no valid node", "False everywhere", "at least one True")
        broken = valid & ~np.isfinite(depth)
        if broken.any():
            raise bad(f"depth: {broken.sum()} values are NaN or infinite, first {at(broken)}", depth[broken][0],
                      "finite depth wherever the mask is True", "Pass mask=numpy.isfinite(depth) to leave them out.")
        low = valid & (depth < 0)
        if low.any():
            raise bad(f"depth: negative {at(low)}", depth[low][0], "depth >= 0 (0 is the viewer's plane)",
                      "For terrain heights use Scene.from_height.")
        depth[~valid] = np.nan
        with np.errstate(over="ignore"):
            depth = depth.astype(np.float32)
        if np.isinf(depth).any():
            raise bad(f"depth: too large for float32 {at(np.isinf(depth))}", "more than 3.4e38", "a smaller unit")
        if depth[valid].max() / self.spacing > STEEPEST:
            raise bad("depth: too deep for its spacing", f"{depth[valid].max()} at spacing {self.spacing}", f"at most {STEEPEST:g} spacings", "Give both in one unit.")
        put("depth", depth)
        put("reflectance", _reflectance(self.albedo, self.reflectance, depth.shape, valid))
        put("albedo", self.reflectance.albedo)
        values, step = _lattice(np.where(valid, depth, np.float32(np.inf)), self.spacing)
        put("_values", values)
        put("_step", step)
        for array in (self.depth, self.mask, values):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False

    @classmethod
    def from_height(cls, height, spacing=1.0, albedo=ALBEDO, mask=None, sides="open", reflectance=None) -> Scene:
        """A scene from terrain height [length]: depth = max(valid height) - height.

        ``height``: (rows, cols); the other arguments and errors as for :class:`Scene`.
        """
        height = real_array(height, "height")
        valid = np.ones(height.shape, bool) if mask is None else _mask(mask, height.shape)
        broken = valid & ~np.isfinite(height)
        if broken.any():
            raise bad(f"height: {broken.sum()} values are NaN or infinite, first {at(broken)}", height[broken][0],
                      "finite height wherever the mask is True", "Pass mask=numpy.isfinite(height) to leave them out.")
        top = height[valid].max() if valid.any() else 0.0
        return cls(np.where(valid, top - height, np.nan), spacing, albedo, mask, sides, reflectance)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.depth.shape

    @property
    def valid(self) -> np.ndarray:
        """(rows, cols) bool: where data are valid."""
        return np.ones(self.shape, bool) if self.mask is None else self.mask

    def lattice(self) -> tuple[np.ndarray, float]:
        """What the lattice methods compare: (values, step).

        Depth itself and the spacing, in float32; where every depth is a whole number of layers, the layers and 1,
        which is the same comparison without any rounding. Masked nodes are +inf: they never block.
        """
        return self._values, self._step

    def layers(self) -> tuple[np.ndarray, float]:
        """Depth rounded to layers, rint(depth / spacing), and the step 1, as the field and carving use them."""
        return np.rint(self._values.astype(np.float64) / self._step).astype(np.float32), 1.0


def is_scene(scene) -> None:
    if not isinstance(scene, Scene):
        raise bad("scene", type(scene).__name__, "a skylamp.Scene")


def _mask(mask, shape):
    if mask is None:
        return None
    try:
        mask = np.asarray(mask)
    except ValueError as error:
        raise bad("mask: not an array", str(error), f"bool, shape {shape}") from None
    if mask.dtype != bool or mask.shape != shape:
        raise bad("mask: wrong type or shape", f"dtype {mask.dtype}, shape {mask.shape}", f"bool, shape {shape}")
    return mask.copy()


def _reflectance(albedo, given, shape, valid):
    from . import reflectance as materials  # which checks its arrays by real_array

    if given is None:
        given = materials.Lambertian(albedo)
    elif not isinstance(given, materials.Reflectance):
        raise bad("reflectance", type(given).__name__, "Lambertian, Phong, Mirror or BRDF")
    elif not np.array_equal(albedo, ALBEDO):
        raise bad("scene: albedo and reflectance", "both", "one of them", "The diffuse albedo is an argument of the reflectance.")
    materials.fit(given, shape, valid)
    return given


def _lattice(depth, spacing):
    # Whole layers compare exactly as integers; dividing anything else by the spacing would flip bits.
    with np.errstate(invalid="ignore"):
        layers = np.rint(depth.astype(np.float64) / spacing)
        whole = (layers * spacing).astype(np.float32) == depth
    if whole.all() and layers[np.isfinite(layers)].max() < 2**20:
        return layers.astype(np.float32), 1.0
    return depth, spacing
