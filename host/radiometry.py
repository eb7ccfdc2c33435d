"""Closed forms of radiometry: solid angle of a rectangle, Lambert's moment of a polygon."""

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
