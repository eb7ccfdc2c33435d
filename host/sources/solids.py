"""Shapes of sources in the unit of depth, as kernels see them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


class Ball(NamedTuple):
    """A sphere: centre (x, y, z) and radius [unit of depth]."""

    center: tuple[float, float, float]
    radius: float


class Quad(NamedTuple):
    """A flat, convex quadrangle that shines from both faces: its corners (4, 3) in turn, (x, y, z) [unit of
    depth].
    """

    corners: np.ndarray


class Dome(NamedTuple):
    """The sky, seen in a mirror: ground farther away than reach [unit of depth] does not count."""

    reach: float = math.inf


def rectangle(corner, edge_u, edge_v) -> Quad:
    """The rectangle, or parallelogram, with these edges at ``corner``."""
    corner, u, v = (np.asarray(vector, float) for vector in (corner, edge_u, edge_v))
    return Quad(np.array([corner, corner + u, corner + u + v, corner + v]))


def aperture(x, y, shape: tuple[int, int], step: float, sides: str) -> Quad | None:
    """The window x[0]..x[1], y[0]..y[1] in the plane z = 0, or what a dark box leaves of it; None where that
    is nothing.
    """
    (x0, x1), (y0, y1) = x, y
    if sides == "dark":
        rows, cols = shape
        x0, x1 = np.clip((x0, x1), -0.5 * step, (cols - 0.5) * step)
        y0, y1 = np.clip((y0, y1), -0.5 * step, (rows - 0.5) * step)
    return rectangle((x0, y0, 0.0), (x1 - x0, 0.0, 0.0), (0.0, y1 - y0, 0.0)) if x0 < x1 and y0 < y1 else None
