"""Radiometry: the quantities of light, and closed forms of its transfer between patches.

Equations follow the textbook definitions of radiometry. Lengths may be in any one unit; radiance L is
in W m^-2 sr^-1, or cd m^-2 where light is weighted by the eye.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .errors import bad

Values = Any  # a number or an array; arguments of one function broadcast
Radiance = Callable[[np.ndarray], np.ndarray]  # of unit vectors (n, 3)

EFFICACY = 683.0  # lm/W of monochromatic light of 540 THz, by the definition of the candela (SI)


def foreshortening(normal: ArrayLike, direction: ArrayLike) -> Values:
    """cos(theta) between unit vectors ``normal`` and ``direction`` (..., 3), 0 from behind.

    It is the share of its area that a patch shows.
    """
    return np.maximum(0.0, (np.asarray(normal, float) * direction).sum(-1))


def planar_angle(length: Values, cosine: Values, distance: Values) -> Values:
    """Angle [rad] that a short segment of a curve takes up in the plane: dphi = dl cos(theta) / r.

    ``cosine``: of the angle between the segment's normal and the line of sight. Arguments broadcast.
    """
    return np.asarray(length) * cosine / np.asarray(distance, float)


def curve_angle(points: ArrayLike) -> Values:
    """Angle [rad] that an open curve of straight segments sweeps as seen from the origin.

    ``points`` (..., n, 2). Signed by the sense of rotation; a closed curve round the origin gives 2 pi if its
    first point is repeated.
    """
    a = np.asarray(points, float)
    a, b = a[..., :-1, :], a[..., 1:, :]
    return np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1)).sum(-1)


def patch_solid_angle(area: Values, cosine: Values, distance: Values) -> Values:
    """Solid angle [sr] of a small patch, domega = dA cos(theta) / r^2.

    ``cosine``: of the angle between its normal and the line of sight.
    """
    return np.asarray(area) * cosine / np.square(np.asarray(distance, float))


def polygon_solid_angle(corners: ArrayLike) -> Values:
    """Solid angle [sr] of convex flat polygons (..., n, 3) seen from the origin, not from within their plane.

    The polygon is cut into triangles from its first corner; each by tan(omega / 2) = a.(b x c) / (abc + ...)
    (Van Oosterom and Strackee 1983).
    """
    corners = np.asarray(corners, float)
    unit = corners / np.linalg.norm(corners, axis=-1, keepdims=True)
    a, b, c = unit[..., :1, :], unit[..., 1:-1, :], unit[..., 2:, :]
    volume = (a * np.cross(b, c)).sum(-1)
    half = np.arctan2(volume, 1 + (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1))
    return np.abs(2 * half.sum(-1))


def transfer(
    radiance: Values, cosine_1: Values, area_1: Values, cosine_2: Values, area_2: Values, distance: Values
) -> Values:
    """Power [W] from patch 1 to patch 2: d3E = L cos(theta_1) cos(theta_2) dA_1 dA_2 / r^2 per unit of time.

    ``radiance``: of patch 1 towards patch 2. Radiance is constant along a ray, so patch 2 receives the same
    L, and what leaves is what arrives: the formula is the same with the patches exchanged. Arguments
    broadcast; small patches.
    """
    return np.asarray(radiance) * cosine_1 * area_1 * patch_solid_angle(area_2, cosine_2, distance)


def radiance_of_transfer(
    power: Values, cosine_1: Values, area_1: Values, cosine_2: Values, area_2: Values, distance: Values
) -> Values:
    """The radiance [W m^-2 sr^-1] of a ray that carries ``power`` between two small patches.

    The inverse of :func:`transfer`. Seen from either end it is the same: radiance is invariant along a ray
    through empty space.
    """
    return np.asarray(power) / (np.asarray(cosine_1) * area_1 * patch_solid_angle(area_2, cosine_2, distance))


def hemisphere(azimuths: int = 64, elevations: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (n, 3) about the normal (0, 0, 1), and weights [sr] (n,) of cos(theta) domega.

    The weights sum to pi. Even azimuths and Gauss-Legendre nodes in sin^2(theta): exact for polynomials in it
    of degree 2 ``elevations`` - 1.
    """
    node, weight = np.polynomial.legendre.leggauss(elevations)
    sine = np.sqrt((1 + node) / 2)
    azimuth = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    flat = sine[:, None, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    up = np.broadcast_to(np.sqrt(1 - sine**2)[:, None, None], (elevations, azimuths, 1))
    return np.concatenate([flat, up], -1).reshape(-1, 3), np.repeat(weight * np.pi / (2 * azimuths), azimuths)


def irradiance(radiance: Radiance, azimuths: int = 64, elevations: int = 32) -> Values:
    """Irradiance E [W m^-2]: the integral of L cos(theta) over the hemisphere about (0, 0, 1).

    ``radiance``: a function of unit vectors (n, 3) to (n,) or (n, channels). For radiance that leaves, this
    is the radiosity (:func:`radiosity`): the two integrals are one.
    """
    directions, weights = hemisphere(azimuths, elevations)
    return np.tensordot(weights, radiance(directions), 1)


def radiosity(radiance: Values | Radiance) -> Values:
    """Radiosity B [W m^-2], the power that leaves a surface per area.

    ``radiance``: number or array, the same in all directions: B = pi x radiance. Or a function of unit
    vectors, which is integrated over the exit hemisphere.
    """
    return irradiance(radiance) if callable(radiance) else np.pi * np.asarray(radiance)


def radiance_of_radiosity(radiosity: Values) -> Values:
    """Radiance [W m^-2 sr^-1] of a surface that looks the same from everywhere: B / pi."""
    return np.asarray(radiosity) * np.float64(1 / np.pi)


def directional_hemispheric(
    brdf: Callable[[np.ndarray, np.ndarray], np.ndarray],
    incoming: ArrayLike,
    azimuths: int = 128,
    elevations: int = 64,
) -> np.ndarray:
    """Directional-hemispheric reflectance: the share of light from ``incoming`` that is reflected.

    rho_dh = integral of f(incoming, outgoing) cos(theta_o) domega_o over the exit hemisphere. ``brdf``:
    function [sr^-1] of two arrays of unit vectors (..., 3) about (0, 0, 1) that broadcast, (...) out.
    ``incoming`` (..., 3); returns (...).
    """
    incoming = np.asarray(incoming, float)
    directions, weights = hemisphere(azimuths, elevations)
    flat = incoming.reshape(-1, 3)
    return np.array(
        [brdf(np.broadcast_to(one, directions.shape), directions) @ weights for one in flat]
    ).reshape(incoming.shape[:-1])


# -- photometric units


def lumens(watts: Values, efficiency: Values = 1.0) -> Values:
    """Luminous flux [lm] of a radiant flux [W]: 683 lm/W x ``efficiency``.

    ``efficiency``: the mean of the eye's V(lambda) over the spectrum, 1 at 555 nm. By area the same turns
    W m^-2 into lux, by area and solid angle W m^-2 sr^-1 into cd m^-2.
    """
    return EFFICACY * np.asarray(watts) * _efficiency(efficiency)


def watts(lumens: Values, efficiency: Values = 1.0) -> Values:
    """Radiant flux [W] of a luminous flux [lm]; also lux to W m^-2, cd m^-2 to W m^-2 sr^-1.

    See :func:`lumens`.
    """
    return np.asarray(lumens) / (EFFICACY * _efficiency(efficiency))


def intensity(radiance: Values, area: Values, cosine: Values = 1.0) -> Values:
    """Intensity I [W sr^-1, cd] of a small flat source: radiance x foreshortened area.

    A sphere shows pi R^2 to every side.
    """
    return np.asarray(radiance) * area * cosine


def point_irradiance(intensity: Values, cosine: Values, distance: Values) -> Values:
    """Irradiance E [W m^-2, lx] of a point source: I cos(theta) / r^2, r from its centre."""
    return np.asarray(intensity) * patch_solid_angle(1.0, cosine, distance)


def point_error(size: Values, distance: Values, shape: str = "disc") -> Values:
    """Relative error of :func:`point_irradiance` for a source of radius ``size``, seen face on.

    The source is wholly above the horizon. shape "disc": (R / r)^2, since a Lambertian disc gives
    pi L R^2 / (r^2 + R^2). "sphere": 0, since pi L (R / r)^2 is exact at any distance; a sphere needs a size
    for its penumbra only, sin(half angle) = R / r. The rule of thumb "five times its diameter" leaves a disc
    1 %.
    """
    if shape not in ("disc", "sphere"):
        raise bad("point_error: shape", repr(shape), "disc | sphere")
    ratio = np.asarray(size) / np.asarray(distance, float)
    if not (ratio >= 0).all():
        raise bad("point_error: size / distance", ratio, ">= 0")
    return ratio**2 if shape == "disc" else np.zeros_like(ratio)


def point_distance(size: Values, tolerance: Values) -> Values:
    """Least distance at which a disc is a point within a relative ``tolerance``: size / sqrt(tolerance)."""
    return np.asarray(size) / np.sqrt(np.asarray(tolerance, float))


def _efficiency(value: Values) -> Values:
    value = np.asarray(value, float)
    if not ((value > 0) & (value <= 1)).all():
        raise bad("luminous efficiency", value, "0 to 1, 1 for monochromatic light of 555 nm")
    return value


# -- closed forms over finite sources


def rectangle_solid_angle(u0: Values, u1: Values, v0: Values, v1: Values, distance: Values) -> Values:
    """Solid angle [sr] of the rectangle u0 <= u <= u1, v0 <= v <= v1 in a plane at ``distance`` from the eye.

    The foot of the perpendicular is (u, v) = (0, 0). Arguments broadcast; lengths in one unit.
    """
    u0, u1, v0, v1, distance = (np.asarray(value, float) for value in (u0, u1, v0, v1, distance))

    def corner(u: Values, v: Values) -> Values:
        return np.arctan2(u * v, distance * np.sqrt(u * u + v * v + distance * distance))

    return corner(u1, v1) - corner(u0, v1) - corner(u1, v0) + corner(u0, v0)


def polygon_moment(corners: ArrayLike) -> Values:
    """Integral of L dOmega [sr] over flat polygons seen from the origin, L towards the polygon.

    ``corners``: (..., n, 3), in either sense of rotation; returns (..., 3). Lambert's formula: half the sum
    over the edges of the edge's angle times the unit normal of the plane through edge and eye. For a surface
    element of unit normal N, with the polygon wholly above its tangent plane, N . moment / pi is the
    polygon's view factor.
    """
    a = np.asarray(corners, float)
    b = np.roll(a, -1, axis=-2)
    cross = np.cross(a, b)
    sine = np.linalg.norm(cross, axis=-1)
    angle = np.arctan2(sine, (a * b).sum(-1))
    normal = cross / np.where(sine > 0, sine, 1)[..., None]
    moment = 0.5 * (angle[..., None] * normal).sum(-2)
    towards = (moment * a.mean(-2)).sum(-1, keepdims=True)
    return np.where(towards < 0, -moment, moment)


def disc_moment(axis: ArrayLike, sine: ArrayLike, above: ArrayLike | None = None) -> Values:
    """Integral of L dOmega [sr] over a disc of directions: the cone about the unit vector ``axis``.

    ``sine`` of the cone's half angle, below 1: radius / distance of a sphere's centre. ``above``: unit normal
    of a plane through the eye; only the part on its side counts (a half-set sphere, the penumbra of a
    straight edge). axis and above (..., 3), sine (...); returns (..., 3). Half the integral of L x dL round
    the rim: the circle's arc, and the plane's.
    """
    axis, sine = np.asarray(axis, float), np.asarray(sine, float)[..., None]
    if above is None:
        return np.pi * sine**2 * axis
    above = np.asarray(above, float)
    cosine = np.sqrt(1 - sine**2)
    height = (axis * above).sum(-1, keepdims=True)
    towards = above - height * axis  # across the axis, to the side that counts
    width = np.linalg.norm(towards, axis=-1, keepdims=True)
    towards = towards / np.where(width > 0, width, 1)
    # half of the rest of the circle
    arc = np.arccos(np.clip(-height * cosine / np.maximum(width * sine, 1e-300), -1, 1))
    chord = 2 * np.arcsin(np.clip(sine * np.sin(arc), -1, 1))  # the plane's arc between its two ends
    return arc * sine**2 * axis - cosine * sine * np.sin(arc) * towards + chord / 2 * above
