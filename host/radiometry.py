"""Closed forms of radiometry: solid angle of a rectangle, Lambert's moment of a polygon, moment of a disc cut by a plane."""

import numpy as np


def rectangle_solid_angle(u0, u1, v0, v1, distance):
    """Solid angle [sr] of the rectangle u0 <= u <= u1, v0 <= v <= v1 in a plane at ``distance`` from the eye.

    The foot of the perpendicular is (u, v) = (0, 0). Arguments broadcast; lengths in one unit.
    """

    def corner(u, v):
        return np.arctan2(u * v, distance * np.sqrt(u * u + v * v + distance * distance))

    return corner(u1, v1) - corner(u0, v1) - corner(u1, v0) + corner(u0, v0)


def polygon_moment(corners):
    """Integral of L dOmega [sr] over flat polygons seen from the origin, L the unit vector towards the polygon.

    ``corners``: (..., n, 3), in either sense of rotation; returns (..., 3). Lambert's formula: half the sum over the
    edges of the edge's angle times the unit normal of the plane through edge and eye. For a surface element of unit
    normal N, with the polygon wholly above its tangent plane, N . moment / pi is the polygon's view factor.
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


def disc_moment(axis, sine, above=None):
    """Integral of L dOmega [sr] over a disc of directions, such as a sphere covers: the cone about the unit vector ``axis``.

    ``sine`` of the cone's half angle, below 1: radius / distance of a sphere's centre. ``above``: unit normal of a plane
    through the eye; only the part on its side counts (a half-set sphere, the penumbra of a straight edge). axis and above
    (..., 3), sine (...); returns (..., 3). Half the integral of L x dL round the rim: the circle's arc, and the plane's.
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
    arc = np.arccos(np.clip(-height * cosine / np.maximum(width * sine, 1e-300), -1, 1))  # half of what is left of the circle
    chord = 2 * np.arcsin(np.clip(sine * np.sin(arc), -1, 1))  # the plane's arc between its two ends
    return arc * sine**2 * axis - cosine * sine * np.sin(arc) * towards + chord / 2 * above
