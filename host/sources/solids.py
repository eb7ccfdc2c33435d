"""Shapes of sources in the unit of depth, in the form for kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, overload

import numpy as np

Vector = Sequence[float] | np.ndarray

# reach of a window beyond the map, over the larger of the map's extent and the window's other side. Chosen:
# the part cut off is 1e-4 of the light of a wall, of a window wide to both sides and of a strip alike (its
# square, and the root of it); a strip's slices have an error of 0.1 % with 300, of 14 % with 1000, by
# rounding
MOST_EXTENTS = 100.0


class Ball(NamedTuple):
    """A sphere: centre (x, y, z) and radius [unit of depth]."""

    center: tuple[float, float, float]
    radius: float


class Quad(NamedTuple):
    """A flat, convex quadrangle that shines from both faces.

    ``corners`` (4, 3): (x, y, z) [unit of depth], in turn.
    """

    corners: np.ndarray


class Dome(NamedTuple):
    """The sky as a mirror reflects it. Ground farther away than ``reach`` [unit of depth] does not occlude
    it.
    """

    reach: float = math.inf


@overload
def upright(solid: Ball | Quad, step: float = 1.0) -> Ball | Quad: ...
@overload
def upright(solid: Ball | Quad | None, step: float = 1.0) -> Ball | Quad | None: ...
def upright(solid: Ball | Quad | None, step: float = 1.0) -> Ball | Quad | None:
    """The shape with heights for depths, lengths in units of ``step`` [unit of depth]."""
    if solid is None:
        return None
    if isinstance(solid, Quad):
        return Quad(np.asarray(solid.corners, float) / step * (1, 1, -1))
    x, y, z = solid.center
    return Ball((x / step, y / step, -z / step), solid.radius / step)


def rectangle(corner: Vector, edge_u: Vector, edge_v: Vector) -> Quad:
    """The rectangle, or parallelogram, with these edges at ``corner``."""
    at, u, v = (np.asarray(vector, float) for vector in (corner, edge_u, edge_v))
    return Quad(np.array([at, at + u, at + u + v, at + v]))


def aperture(
    x: tuple[float, float],
    y: tuple[float, float],
    shape: tuple[int, int],
    step: float,
    sides: str,
    deepest: float,
) -> Quad | None:
    """The window x[0]..x[1], y[0]..y[1] in the plane z = 0, clipped by the walls of a dark box and where it
    is too far away to be resolved in float32.

    ``deepest``: the greatest depth. None where nothing is left.
    """
    extent = max(*shape, deepest / step) * step
    lengths = [min(high - low, MOST_EXTENTS * extent) for low, high in (x, y)]
    (x0, x1), (y0, y1) = (
        np.clip(ends, -reach, reach + extent)
        for ends, other in zip((x, y), reversed(lengths))
        for reach in [MOST_EXTENTS * max(extent, other)]
    )
    if sides == "dark":
        rows, cols = shape
        x0, x1 = np.clip((x0, x1), -0.5 * step, (cols - 0.5) * step)
        y0, y1 = np.clip((y0, y1), -0.5 * step, (rows - 0.5) * step)
    return rectangle((x0, y0, 0.0), (x1 - x0, 0.0, 0.0), (0.0, y1 - y0, 0.0)) if x0 < x1 and y0 < y1 else None
