"""Where images tell little or nothing of the depth of the surface as a whole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..sources import Lamp, Sky, Source
from .pyramid import Pyramid


def moved_alike(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray | None:
    """How far (rows, cols) z, on grid ``level``, may move at each node, over the most of all nodes, while the
    images stay the same; None if it may not.

    Skies tell nothing of the place, unless the sides are dark: the surface moves as a whole.

    A small lamp at the height h above the ground, and at the horizontal distance r from it, casts
    E = (h - r dh/dr) / (r^2 + h^2)^(3/2), but for a factor near 1 at gentle slopes. Along every line from the
    lamp's foot this is a differential equation for h. A foot within the map makes its solution unique; from a
    foot beside the map there is one for every height at the map's border. Of neighbouring solutions the
    difference d obeys r dd/dr = (1 - 3 h^2 / (r^2 + h^2)) d, so d is in proportion to (r^2 + h^2)^(3/2) / r^2
    where h changes slowly.
    """
    if pyramid.sides != "dark" and all(isinstance(light, Sky) for light in pyramid.sources):
        return np.ones(z.shape)
    middle = lamp_beside(pyramid.shape(0), pyramid.sides, pyramid.sources)
    if middle is None:
        return None
    rows, cols = (((np.arange(n) + 0.5) * 2**level - 0.5) for n in z.shape)
    square = (cols - middle[0]) ** 2 + (rows[:, None] - middle[1]) ** 2
    height = float(np.mean(z)) * 2**level - middle[2]
    moved: np.ndarray = (square + height**2) ** 1.5 / square
    return moved / float(moved.max())


def lamp_beside(shape: tuple[int, int], sides: str, lights: Sequence[Source]) -> np.ndarray | None:
    """The middle (3,) [nodes] of the one lamp, if its foot lies beside a map with open sides; else None.

    ``lights``: in nodes.
    """
    light = lights[0]
    if sides != "open" or len(lights) > 1 or not isinstance(light, Lamp):
        return None
    middle = light.center
    if light.corner is not None and light.edges is not None:
        middle = light.corner + np.sum(light.edges, 0) / 2
    return None if middle is None or not beyond_map(middle, shape) else np.asarray(middle, float)


def beyond_map(place: Any, shape: tuple[int, int]) -> float:
    """How far [nodes] a place (x, y, ...) lies beside the map; 0 above it."""
    return math.hypot(*(max(-at, at - (n - 1), 0.0) for at, n in zip(place, shape[::-1])))
