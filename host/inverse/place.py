"""Lights whose images tell little or nothing of the depth of the surface as a whole."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..sources import Lamp, Sky, Source, Window
from .pyramid import Pyramid

# share by which the heights of two lamps differ at least, and sizes of the map over the distance from where
# the lines of two skies meet: else no lines meet
LEAST_DIFFERENCE = 1e-6
# of how the light of two skies changes with slopes, below which their images change alike; chosen: float32
# leaves some 1e-6, a sun at an elevation of 45 degrees beside an even sky has 1
SKIES_ALIKE = 1e-3
LEAST_MOVED = 1e-9  # share of the most on a line, so that what is divided by it stays finite


class Shading(NamedTuple):
    """How light on level ground changes with the slopes there: by their product with at - per_height (x, y),
    as a share of the light, at the place (x, y) [nodes].

    lamp: the middle (x, y, z) of a small lamp, then ``per_height`` is 1 / (its height above the ground); None
    for light that is the same everywhere, with 0. cosines: of the lamp's own upright normal, 1 of a window, 0
    of a sphere.
    """

    per_height: float
    at: np.ndarray
    lamp: np.ndarray | None = None
    cosines: int = 0

    def integral(self, centre: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Of (1 + cosines) / (h s) - (3 + cosines) h / (s d^2) over the distance s from ``centre`` (2,) to
        places x (2, rows, cols), where the lamp is h high and d away.
        """
        if self.lamp is None:
            return np.zeros(x.shape[1:])
        height, foot = 1 / self.per_height, self.lamp[:2]
        from_centre, from_foot = x - _column(centre), x - _column(foot)
        away, distance = np.hypot(*from_centre), np.sqrt(np.sum(from_foot**2, 0) + height**2)
        passed, at_centre = (np.sum(from_centre / away * to, 0) for to in (from_foot, _column(centre - foot)))
        least = np.sqrt(np.maximum(distance**2 - passed**2, height**2))  # of the line from the lamp
        whole = np.log(away / distance) - at_centre / least * np.arctan(passed / least)
        square = float(np.sum((centre - foot) ** 2)) + height**2
        first = (1 + self.cosines) * self.per_height * np.log(away)
        integral: np.ndarray = first - (3 + self.cosines) * height / square * whole
        return integral


def _column(vector: np.ndarray) -> np.ndarray:
    return vector[:, None, None]


@dataclass(frozen=True, eq=False)
class FreePlace:
    """That images leave the depth of level ground open along lines which meet in ``centre`` (x, y) [nodes],
    ``beside`` [nodes] the map; see :func:`free_place`.
    """

    one: Shading
    other: Shading
    centre: np.ndarray
    beside: float

    def lines(self, shape: tuple[int, int], scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """How far (rows, cols) the surface moves, over the most along the same line, while the images stay
        the same, and the number (rows, cols) of the line, which is a node wide at most: at the nodes of a
        grid ``scale`` times as coarse as the finest.
        """
        logarithm, away = self.solution(shape, scale)
        ahead = away.mean((1, 2)) / np.hypot(*away.mean((1, 2)))
        angle = np.arctan2(ahead[0] * away[1] - ahead[1] * away[0], ahead[0] * away[0] + ahead[1] * away[1])
        line = np.rint((angle - angle.min()) * np.hypot(*away).max() / scale).astype(int)
        return np.maximum(np.exp(logarithm - most_of(line, logarithm)), LEAST_MOVED), line

    def solution(self, shape: tuple[int, int], scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """The logarithm (rows, cols) of e of :func:`free_place`, but for a number on each line, and the
        distance (2, rows, cols) [nodes] from the centre.
        """
        y, x = ((np.arange(n) + 0.5) * scale - 0.5 for n in shape)
        places = np.stack(np.meshgrid(x, y))
        both = self.one.integral(self.centre, places) - self.other.integral(self.centre, places)
        away = places - _column(self.centre)
        if self.one.lamp is None and self.other.lamp is None:
            return np.zeros(shape), away
        return both / (self.one.per_height - self.other.per_height), away


def most_of(group: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The greatest of the values (rows, cols) with the same number in ``group``."""
    most = np.full(int(group.max()) + 1, -np.inf)
    np.maximum.at(most, group, values)
    greatest: np.ndarray = most[group]
    return greatest


def free_place(pyramid: Pyramid, ground: float) -> FreePlace | None:
    """What lights leave open of level ground at the depth ``ground`` [nodes], see :func:`place_by_lights`;
    None if nothing, or if walls tell it.
    """
    return None if walls_tell(pyramid) else place_by_lights(pyramid, ground)


def walls_tell(pyramid: Pyramid) -> bool:
    """Whether walls tell the place of a surface under skies, and a lamp at most."""
    return pyramid.sides != "open" and sum(not isinstance(light, Sky) for light in pyramid.sources) < 2


def place_by_lights(pyramid: Pyramid, ground: float) -> FreePlace | None:
    """What one lamp or window, or two lights over an albedo that is not known, leave open of level ground at
    the depth ``ground`` [nodes], but for what walls tell; None if nothing, and for other lights.

    A small lamp at the height h above the ground, and at the horizontal distance r from it, casts
    E = (h - r . grad h) / (r^2 + h^2)^(3/2), but for a factor near 1 at gentle slopes; a sky over open ground
    casts some F (1 + f . grad h) everywhere. So the image of a lamp, or the ratio of two images, is a
    differential equation of first order for h along lines through one point: the lamp's foot, or where the
    line through both lamps, or from a lamp in the mean direction of the sky's light, meets the ground; of two
    skies the lines are parallel. If the point lies on the map the solution is unique. Else there is one for
    every height at the map's border. To first order their difference e at the distance s from the point obeys

        e' / e = 1 / s - 3 (h_1 / d_1^2 - h_2 / d_2^2) / (s (1 / h_1 - 1 / h_2)),

    h and d the lamps' heights and distances from the place; of a sky, h / d^2 and 1 / h are 0. For one lamp
    e is in proportion to (r^2 + h^2)^(3/2) / r^2. A window, whose own normal is upright, casts h / d times as
    much, which makes 4 of 3 and adds 1 / h to what is divided by s.
    """
    lights = pyramid.sources
    is_sky = len(lights) == 1 and isinstance(lights[0], Sky)
    if is_sky or len(lights) != 2 - pyramid.albedo_known:
        return None
    found = [_shading(pyramid, number, ground) for number in range(len(lights))]
    one, other = (*found, Shading(0.0, np.zeros(2)))[:2]  # of one lamp, as if even light were the other
    if one is None or other is None:
        return None
    if one.per_height == other.per_height == 0:
        if (apart := float(np.hypot(*(one.at - other.at)))) < SKIES_ALIKE:
            return None
        one = one._replace(per_height=LEAST_DIFFERENCE * apart / max(pyramid.shape(0)))
    elif abs(one.per_height - other.per_height) < LEAST_DIFFERENCE * one.per_height:
        grown = 1 + 2 * LEAST_DIFFERENCE
        one = one._replace(per_height=grown * one.per_height, at=grown * one.at)
    centre = (one.at - other.at) / (one.per_height - other.per_height)
    beside = math.hypot(*(max(-at, at - (n - 1), 0.0) for at, n in zip(centre, pyramid.shape(0)[::-1])))
    return FreePlace(one, other, centre, beside) if beside else None


def _shading(pyramid: Pyramid, number: int, ground: float) -> Shading | None:
    """Of a lamp or window above the ground, by its middle, or of a sky that lights it; None of others."""
    light, level = pyramid.sources[number], pyramid.coarsest
    if isinstance(light, Sky):
        level_ground = np.full(pyramid.shape(level), ground / 2**level)
        irradiance, by_x, by_y = pyramid.problem(level).irradiances(level_ground, [0, 2, 3])[number]
        total = irradiance.sum()
        return Shading(0.0, np.array([by_x.sum(), by_y.sum()]) / total) if total > 0 else None
    middle = _middle(light)
    if middle is None or ground <= middle[2]:
        return None
    per_height = 1 / (ground - middle[2])
    return Shading(per_height, per_height * middle[:2], middle, int(isinstance(light, Window)))


def _middle(light: Source) -> np.ndarray | None:
    """(x, y, z) of a sphere or rectangle; None of other shapes."""
    if isinstance(light, Window) and light.x is not None and light.y is not None:
        return np.array([sum(light.x) / 2, sum(light.y) / 2, 0.0])
    if not isinstance(light, Lamp):
        return None
    if light.corner is not None and light.edges is not None:
        return np.asarray(light.corner + np.sum(light.edges, 0) / 2)
    return None if light.center is None else np.array(light.center)
