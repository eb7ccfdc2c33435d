"""Reflectance of surfaces (docs/explanation; the notes on radiometry).

A BRDF f [sr^-1] is the ratio of outgoing radiance to incident irradiance. Here directions are unit vectors
(..., 3) in the surface's own frame: z along the normal, x along the map's columns and y along its rows (of a
DataArray, to the east and to the south), both within the surface; :class:`BRDF` has the formulas. A
reflectance is energy-bounded if its directional-hemispheric reflectance, the integral of f cos(theta_o), is
at most 1 for every incoming direction, and reciprocal (Helmholtz) if f(incoming, outgoing) = f(outgoing,
incoming).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import labels_of
from .checks import at, number_or_nan, real_array
from .errors import bad
from .radiometry import directional_hemispheric

BOUND = 1e-3  # by which a reflectance may seem to give more than it gets: the numeric integral's own error
MOST_EXPONENT = 1e5  # a lobe half a degree wide; beyond it a mirror
LOBE_KNOTS = 2048  # of a lobe's table


@dataclass(frozen=True, eq=False)
class Lambertian:
    """The same radiance to every side, f = albedo / pi: reciprocal, and bounded for an albedo from 0 to 1.

    ``albedo``: number; (rows, cols); RGB as (3,) or (rows, cols, 3).

    Examples
    --------
    >>> scene = sl.Scene(np.zeros((3, 3)), reflectance=sl.Lambertian(0.25))
    >>> round(float(sl.render(scene, sl.Sky()).image[1, 1]), 3)
    0.25
    """

    albedo: float | np.ndarray = 0.8

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", {"albedo": labels_of(self.albedo)})
        object.__setattr__(self, "albedo", share(self.albedo, "albedo"))

    def brdf(self, incoming: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """f [sr^-1]: (..., 3), (..., 3) -> (...); the albedo must be a number."""
        return _above(incoming, outgoing) * (_number(self.albedo, "albedo") / np.pi)


@dataclass(frozen=True, eq=False)
class Phong:
    """Lambertian and a lobe about the mirror direction.

    Images with light between surfaces show in the lobe the ground that it sees, by that ground's albedo E /
    pi; images of direct light show none. Other ground is lit by the Lambertian part alone.

    L = albedo E / pi + specular (n + 2) / (2 pi) x the integral of B cos^n(angle to the mirror direction)
    cos(theta_i) domega.

    Parameters
    ----------
    albedo, specular : number; (rows, cols); RGB as (3,) or (rows, cols, 3)
        Diffuse and specular albedo, each >= 0, their sum at most 1: then it is bounded, since the lobe is
        normalised for light along the normal and gives less from elsewhere. It is reciprocal.
    exponent : float, 0 to 1e5
        n: the larger, the narrower the lobe. cos^n falls to 1 / sqrt(e) 1 / sqrt(n + 1) rad from its middle.

    Examples
    --------
    >>> glossy = sl.Phong(albedo=0.3, specular=0.2, exponent=50)
    >>> image = sl.render(sl.Scene(np.zeros((3, 3)), reflectance=glossy), sl.Sky()).image
    >>> round(float(image[1, 1]), 2)
    0.5
    """

    albedo: float | np.ndarray = 0.5
    specular: float | np.ndarray = 0.3
    exponent: float = 20.0

    def __post_init__(self) -> None:
        _shares(self)
        exponent = number_or_nan(self.exponent)
        if not 0 <= exponent <= MOST_EXPONENT:
            raise bad(
                "Phong: exponent",
                repr(self.exponent),
                f"a number from 0 to {MOST_EXPONENT:g}",
                "For a narrower lobe use Mirror.",
            )
        object.__setattr__(self, "exponent", exponent)

    @property
    def norm(self) -> float:
        """(n + 2) / (2 pi) [sr^-1]."""
        return (self.exponent + 2) / (2 * np.pi)

    @property
    def spread(self) -> float:
        """Half width of the lobe [rad], in which cos^n falls to about 1 / sqrt(e)."""
        return float(1 / np.sqrt(self.exponent + 1))

    def rim(self, lost: float) -> float:
        """1 - cosine of the angle from the mirror direction that holds all but a share ``lost`` of light."""
        return float(1 - lost ** (1 / (self.exponent + 1)))

    def table(self, rim: float) -> np.ndarray:
        """cos^n, (2048,) float32, by even steps of 1 - cos from 0 to ``rim``, as kernels read it."""
        return ((1 - np.linspace(0, rim, LOBE_KNOTS)) ** self.exponent).astype(np.float32)

    def brdf(self, incoming: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """f [sr^-1]: (..., 3), (..., 3) -> (...); the albedos must be numbers."""
        incoming, outgoing = np.asarray(incoming, float), np.asarray(outgoing, float)
        # of the angle to the mirror direction
        cosine: np.ndarray = np.maximum(0.0, (incoming * outgoing * [-1, -1, 1]).sum(-1))
        lobe = _number(self.specular, "specular") * self.norm * cosine**self.exponent * (cosine > 0)
        return _above(incoming, outgoing) * (_number(self.albedo, "albedo") / np.pi + lobe)


@dataclass(frozen=True, eq=False)
class Mirror:
    """Ideal mirror: a pixel shows ``specular`` x the radiance along its mirror direction.

    Besides there is a Lambertian part. Where ground is in the way, images with light between surfaces show
    that ground's albedo E / pi, not what it mirrors itself; images of direct light show none. Other ground
    is lit by the Lambertian part alone.

    Its f is no function but a delta; as a mapping of rays it is reciprocal, and bounded for albedo + specular
    <= 1.

    Examples
    --------
    >>> scene = sl.Scene(np.zeros((3, 3)), reflectance=sl.Mirror(0.9))
    >>> round(float(sl.render(scene, sl.Sky(2.0)).image[1, 1]), 3)
    1.8
    """

    specular: float | np.ndarray = 1.0
    albedo: float | np.ndarray = 0.0

    def __post_init__(self) -> None:
        _shares(self)


@dataclass(frozen=True, eq=False)
class BRDF:
    """Any reflectance, given as a function f(incoming, outgoing) [sr^-1] of two arrays (..., 3) -> (...).

    Both are unit vectors from the surface, to where light comes from and to where it goes, in the frame of
    the node's own surface: z along its normal on the viewer's side, so z > 0 above the surface (a brightness
    function gets z <= 0 there); x along the tangent (1, 0, dz/dx), to increasing columns; y along (-p q, 1 +
    p^2, q) for p = dz/dx and q = dz/dy of the depth z, to increasing rows, at right angles to both. Of a
    DataArray x is turned to the east and y to the south: reversed where columns run west, or rows north. What
    f gives for z <= 0 counts as 0. A render's outgoing direction is that to the viewer, (-p / sqrt(1 + p^2),
    -q / sqrt((1 + p^2) (1 + p^2 + q^2)), 1 / sqrt(1 + p^2 + q^2)).

    Its directional-hemispheric reflectance is integrated numerically for incoming directions all over the
    hemisphere; an InputError gives the direction for which it exceeds 1, and the excess. ``largest`` is the
    largest value of f. ``asymmetry``: the largest |f(i, o) - f(o, i)| over the largest f, near 0 where f is
    reciprocal.

    Examples
    --------
    >>> matt = sl.BRDF(lambda incoming, outgoing: np.full(incoming.shape[:-1], 0.5 / np.pi))
    >>> scene = sl.Scene(np.zeros((3, 3)), reflectance=matt)
    >>> round(float(sl.render(scene, sl.Sky()).image[1, 1]), 2)  # of an albedo of 0.5 under a sky of 1
    0.5
    """

    function: Callable[[np.ndarray, np.ndarray], np.ndarray]
    largest: float = field(init=False)
    asymmetry: float = field(init=False)
    albedo = 0.0  # there is no Lambertian part

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise bad(
                "BRDF", type(self.function).__name__, "a function of two arrays of unit vectors (..., 3)"
            )
        elevations = np.radians([0, 10, 20, 30, 40, 50, 60, 70, 80, 85])  # from the zenith
        theta, phi = (
            v.ravel() for v in np.meshgrid(elevations, 2 * np.pi * (np.arange(8) + 0.25) / 8, indexing="ij")
        )
        incoming = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
        reflected = directional_hemispheric(self.brdf, incoming)
        worst = int(reflected.argmax())
        if reflected[worst] > 1 + BOUND:
            raise bad(
                "BRDF: gives more than it gets",
                f"a directional-hemispheric reflectance of {reflected[worst]:.4g} for light from"
                f" {incoming[worst].round(3).tolist()}",
                "at most 1 for every incoming direction",
                f"Divide it by {reflected[worst]:.4g} or more.",
            )
        a, b = incoming[:, None], incoming[None]
        shape = (len(incoming),) * 2 + (3,)
        values = self.brdf(np.broadcast_to(a, shape), np.broadcast_to(b, shape))
        asymmetry = float(np.abs(values - values.T).max() / max(values.max(), 1e-300))
        object.__setattr__(self, "largest", float(reflected[worst]))
        object.__setattr__(self, "asymmetry", asymmetry)

    def brdf(self, incoming: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """f [sr^-1], checked: (..., 3), (..., 3) -> (...); 0 where a direction lies below the surface."""
        incoming, outgoing = np.broadcast_arrays(np.asarray(incoming, float), np.asarray(outgoing, float))
        values = np.asarray(self.function(incoming.copy(), outgoing.copy()))
        if values.dtype.kind not in "iuf" or values.shape not in ((), incoming.shape[:-1]):
            raise bad(
                "BRDF function: wrong result",
                f"dtype {values.dtype}, shape {values.shape} for directions {incoming.shape}",
                f"real numbers of shape {incoming.shape[:-1]}",
            )
        values = np.where(_above(incoming, outgoing), values, 0.0)
        wrong = ~((values >= 0) & np.isfinite(values))
        if wrong.any():
            raise bad(
                "BRDF function",
                f"{values[wrong][0]} for {incoming[wrong][0].round(3).tolist()} to"
                f" {outgoing[wrong][0].round(3).tolist()}",
                "finite values >= 0",
            )
        return values


Reflectance = Lambertian | Phong | Mirror | BRDF


def grooves(white: float = 0.9, black: float = 0.0, steepness: float = 45.0) -> BRDF:
    """A reflectance that varies sharply: fine triangular grooves along y.

    Their faces are white on one side and black on the other.

    The white faces look towards -x and the black ones towards +x, each ``steepness`` [degrees] from level and
    Lambertian with the given albedo; light from face to face is left out. A face is lit, and visible,
    from its upper edge down to where the opposite edge hides it, so f is reciprocal.

    Returns
    -------
    BRDF
        In 1/sr, for ``Scene(..., reflectance=...)``.

    Examples
    --------
    >>> scene = sl.Scene(np.zeros((3, 3)), reflectance=sl.grooves(white=0.9))
    >>> left, right = (sl.Lamp((x, 1, -50), 5) for x in (-60, 60))
    >>> bool(sl.render(scene, left).image[1, 1] > 5 * sl.render(scene, right).image[1, 1])
    True
    """
    white = _number(share(white, "grooves: white"), "white")
    black = _number(share(black, "grooves: black"), "black")
    if not 0 < number_or_nan(steepness) < 90:
        raise bad("grooves: steepness", repr(steepness), "between 0 and 90 degrees")
    return BRDF(partial(_groove_brdf, white=white, black=black, slope=np.radians(float(steepness))))


def _groove_brdf(
    incoming: np.ndarray, outgoing: np.ndarray, white: float, black: float, slope: float
) -> np.ndarray:
    """f [1/sr] of :func:`grooves`; ``slope`` of their faces [rad]."""
    total: np.ndarray = np.zeros(())
    for albedo, way in ((white, [1, 1, 1]), (black, [-1, 1, 1])):
        (a, lit), (b, seen) = (_shown_face(w * way, np.tan(slope)) for w in (incoming, outgoing))
        # half of the level area lies under each face, which is larger by 1 / cos and whose two cosines
        # are cos x a, cos x b
        half = albedo / np.pi * 0.5 * np.cos(slope)
        total = total + half * a * b * np.minimum(lit, seen)
    total /= np.maximum(incoming[..., 2], 1e-12) * np.maximum(outgoing[..., 2], 1e-12)
    return total


def _shown_face(w: np.ndarray, rise: float) -> tuple[np.ndarray, np.ndarray]:
    """Cosine to the white face's normal over cos(steepness), and the share of the face that w meets."""
    x, z = w[..., 0], np.maximum(w[..., 2], 1e-12)
    facing = np.maximum(0.0, z - rise * x)
    return facing, np.where(x < 0, np.minimum(1.0, 2 * z / (rise * np.abs(x) + z)), 1.0)


def phong_printed(
    irradiance: ArrayLike,
    radiance: ArrayLike,
    offset: ArrayLike,
    albedo: float = 0.5,
    specular: float = 0.3,
    exponent: float = 20.0,
) -> np.ndarray:
    """The Phong model as lecture notes and textbooks print it: albedo E + specular L cos^n(offset).

    ``irradiance`` E, ``radiance`` L of the source in the mirror direction, ``offset`` [rad] from there to the
    viewer; they broadcast. The result is neither a radiance nor bounded: it lacks the 1 / pi of a Lambertian
    surface, so that an albedo above 1 / pi gives more than it gets, and its lobe is not normalised. For
    comparison with such sources; :class:`Phong` is what scenes take.

    Example: ``phong_printed(np.pi, 0.0, 0.0, albedo=1.0)`` is pi, where white ground shows 1.
    """
    lobe = np.maximum(0.0, np.cos(np.asarray(offset))) ** exponent
    sent: np.ndarray = albedo * np.asarray(irradiance) + specular * np.asarray(radiance) * lobe
    return sent


def mirror_directions(tilt_x: np.ndarray, tilt_y: np.ndarray) -> np.ndarray:
    """Where a viewer along (0, 0, 1) looks by way of the surface: unit vectors (..., 3) from dz/dx and dz/dy.

    R = 2 (N.V) N - V with V = (0, 0, -1) towards the viewer; R_z > 0, below the level, where the surface is
    steeper than 45 degrees.
    """
    square = 1 + tilt_x * tilt_x + tilt_y * tilt_y
    return np.stack([2 * tilt_x / square, 2 * tilt_y / square, 1 - 2 / square], -1)


def frames(tilt_x: np.ndarray, tilt_y: np.ndarray) -> np.ndarray:
    """The surface's axes in the map's coordinates, (..., 3, 3): rows x (along columns), y, normal."""
    level = -np.ones_like(tilt_x)
    normal = np.stack([tilt_x, tilt_y, level], -1) / np.sqrt(1 + tilt_x**2 + tilt_y**2)[..., None]
    along = (
        np.stack([np.ones_like(tilt_x), np.zeros_like(tilt_x), tilt_x], -1)
        / np.sqrt(1 + tilt_x**2)[..., None]
    )
    return np.stack([along, np.cross(along, normal), normal], -2)


def share(values: Any, what: str) -> float | np.ndarray:
    """A reflectance from 0 to 1: a float, or float32 (rows, cols), (3,) or (rows, cols, 3)."""
    array = real_array(values, what, None)
    if (
        array.ndim > 3
        or (array.ndim == 1 and array.shape != (3,))
        or (array.ndim == 3 and array.shape[2] != 3)
    ):
        raise bad(
            f"{what}: wrong shape", array.shape, "a number, (rows, cols), or RGB as (3,) or (rows, cols, 3)"
        )
    if not array.ndim:
        if not 0 <= array <= 1:
            raise bad(f"{what}: out of range", float(array), "finite, 0 to 1")
        return float(array)
    array = array.astype(np.float32)
    array.flags.writeable = False
    return array


def fitted(reflectance: Reflectance, shape: tuple[int, int], mask: np.ndarray | None) -> Reflectance:
    """``reflectance`` for a scene of this shape: the same, but with shares of 0 for what is no share where
    masked. InputError unless its maps fit and are bounded where valid.
    """
    total: np.ndarray = np.zeros(())
    blanked: dict[str, Any] = {}
    for name in ("albedo", "specular"):
        values = np.asarray(getattr(reflectance, name, 0.0), float)
        if values.ndim >= 2 and values.shape[:2] != shape:
            allowed = f"a number, an array of shape {shape}, or RGB as (3,) or {(*shape, 3)}"
            raise bad(f"{name}: wrong shape", values.shape, allowed)
        wrong = ~((values >= 0) & (values <= 1))
        if values.ndim >= 2 and mask is not None:
            valid = mask if values.ndim == 2 else mask[..., None]
            if (wrong & ~valid).any():
                values = blanked[name] = np.where(valid, values, 0.0)
            wrong &= valid
        if wrong.any():
            where = f" {at(wrong)}" if values.ndim >= 2 else ""
            raise bad(f"{name}: out of range{where}", values[wrong].flat[0], "finite, 0 to 1")
        total = total + (values if values.ndim in (0, 1, 3) else values[..., None])
    bounded(np.where(mask[..., None], total, 0.0) if total.ndim == 3 and mask is not None else total)
    return replace(reflectance, **blanked) if blanked else reflectance


def bounded(total: float | np.ndarray) -> None:
    """InputError where the sum of albedo and specular passes 1."""
    worst = float(np.max(total))
    if worst > 1 + 1e-6:
        got = f"{worst:.6g}, {worst - 1:.3g} too much"
        raise bad("albedo + specular: gives more than it gets", got, "a sum of at most 1")


def _shares(reflectance: Phong | Mirror) -> None:
    values, names = [], ("albedo", "specular")
    # of maps that are DataArrays, which must lie on the scene's
    object.__setattr__(reflectance, "labels", {name: labels_of(getattr(reflectance, name)) for name in names})
    for name in names:
        value = share(getattr(reflectance, name), f"{type(reflectance).__name__}: {name}")
        object.__setattr__(reflectance, name, value)
        values.append(np.asarray(value, float))
    if all(v.ndim < 2 for v in values):  # maps are checked in their scene, where the mask is known
        if not all((v >= 0).all() and (v <= 1).all() for v in values):
            raise bad("albedo, specular: out of range", [v.tolist() for v in values], "finite, 0 to 1")
        bounded(values[0] + values[1])


def _number(value: float | np.ndarray, what: str) -> float:
    if np.ndim(value):
        raise bad(f"brdf: {what} is a map or a colour", np.shape(value), "a number")
    return float(value)


def _above(incoming: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Whether both directions lie above the surface."""
    above: np.ndarray = (np.asarray(incoming)[..., 2] > 0) & (np.asarray(outgoing)[..., 2] > 0)
    return above
