"""The directions of a filled lattice, for sources and sides that horizons cannot render."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from .. import sources
from ..backends.base import Backend
from ..directions import Hemicube
from ..samples import Samples
from ..scene import Scene
from ..sources.integrals import BrightPart, Integrals, antiderivatives, even, integrals, without
from . import propagation
from .base import HostImage
from .propagation import Problem

# RMS error of E / pi under a uniform sky on rough ground (rms slope 1), of the hemicubes that may be chosen:
# performance/lattice_error.py. The tables of a larger one take minutes
HEMICUBE_ERRORS = {5: 0.0376, 7: 0.0188, 9: 0.0119, 17: 0.0039, 33: 0.0012}
EXACT_WINDOW_AZIMUTHS, EXACT_WINDOW_ELEVATIONS = 96, 192  # directions of the exact light through a window
PART_AZIMUTHS = 32  # and azimuths, at most, of the horizons before a small bright part behind it
# parts of the sky, even in azimuth and in elevation, by which brightness is averaged over a direction's cell.
# Chosen: against twice as many of both the light of a direction is 0.04 to 0.06 % off (RMS over the mean)
# where brightness is smooth, 0.6 to 0.8 % where it has a step; with half 0.1 and 0.8 to 1.3 %
BRIGHTNESS_AZIMUTHS, BRIGHTNESS_ELEVATIONS = 1024, 256
# rms slope, of steps between neighbours, and hemicube from which on unfilled steps leak light. Chosen: on
# ground of slope 1 they do from M = 7 on, of slope 0.5 only from M = 33 on (performance/lattice_error.py)
LEAK_SLOPE, LEAK_SIZE = 0.7, 7
# relative error of level ground's light from which on directions miss features of a sky. Chosen: under CIE
# skies with the sun from 5 to 80 degrees high it is up to 8 % with M = 5, 2.3 % with 7 and 1.1 % with 9
MISSED_SKY = 0.03
# longest steps below which steps jump over parts of a volume. Chosen: balls of 5 to 15 nodes lose 18 % of
# their light or more below, up to 99 %, and 6 % at 4 steps (tests/test_render.py)
JUMPED = 2
# times the thickness of a volume from which on filled steps jump over parts of it. Chosen: plates of 5 x 5
# and 9 x 9 nodes that are 1 thick lose 1 % of their light or less at 8 times, 24 to 30 at 16 and 32 times;
# those that are 2 thick 8 to 10 at 8 and 16 times
JUMPED_FILLED = 8


def problem_of(
    engine: Backend, scene: Scene, source: sources.Source, cube: Hemicube, filled: bool
) -> Problem:
    """The arrays that a backend needs, from a scene and a source."""
    there = scene.on(engine)
    geometry = sources.geometry(source, scene, there.step)
    return Problem(there, there.step, scene.sides, cube.steps, geometry, filled)


class Lattice(HostImage):
    """``units``: the hemicube's size."""

    unit_name = "hemicube"

    @property
    def amount(self) -> str:
        return f"{self.unit_name} {self.units}"

    def __init__(
        self, engine: Backend, scene: Scene, source: sources.Source, units: int, sky: Integrals | None
    ):
        """``sky``: of the brightness of a window, if that varies."""
        self.engine, self.scene, self.source, self.units, self.sky = engine, scene, source, units, sky
        self.image = self._image()

    def _image(self) -> np.ndarray:
        cube = Hemicube(self.units)
        problem = problem_of(self.engine, self.scene, self.source, cube, True)
        moments = moments_of(self.source, cube, self.sky)
        image: np.ndarray = propagation.light(self.engine, problem, moments)[0][0]
        return image

    def refine(self) -> None:
        """The next larger hemicube: no direction is shared."""
        self.units = next(size for size in HEMICUBE_ERRORS if size > self.units)
        self.image = self._image()


def lacking(scene: Scene, source: sources.Source) -> str:
    """Why horizons and slices cannot render this, or nothing."""
    if isinstance(source, sources.Lamp) and source.volume is not None:
        return "a lamp given as a volume"
    if isinstance(source, sources.Window) and source.aperture is not None:
        return "a window given as an aperture"
    if scene.sides == "periodic" and not isinstance(source, sources.Sky):
        return "a lamp or window over a map that repeats"
    return ""


def moments_of(source: sources.Source, cube: Hemicube, sky: Integrals | None) -> np.ndarray:
    """Integrals of B L dOmega over the cells of all directions, (D, 3).

    By the brightness towards their middles, or by means of it over them, of a ``sky`` that varies, and all
    light of its small bright parts.
    """
    moments: np.ndarray
    if sky is None:
        moments = cube.moments * sources.radiance(source, cube.directions)[:, None]
        return moments
    azimuths = even(BRIGHTNESS_AZIMUTHS, 0.5)
    edges = np.linspace(0, np.pi / 2, BRIGHTNESS_ELEVATIONS + 1)
    begin, end = azimuths.angles - azimuths.widths / 2, azimuths.angles + azimuths.widths / 2
    light = -np.diff(sky.above(begin, end, np.sin(edges)), axis=2)
    one = np.diff(antiderivatives(edges))[:, None] * azimuths.widths[:, None]
    middle = (edges[:-1] + edges[1:]) / 2
    cell = _cells_of(cube, np.repeat(azimuths.angles, len(middle)), np.tile(middle, len(azimuths)))
    of_light, of_one = (np.bincount(cell, part.sum(0).ravel(), len(cube)) for part in (light, one))
    moments = cube.moments * (of_light / of_one)[:, None]
    for part in sky.bright_parts:
        azimuth, (along, up) = part.cells.azimuth, part.cells.moments
        cell = _cells_of(cube, azimuth, (part.cells.low + part.cells.high) / 2)
        for axis, values in enumerate((along * np.cos(azimuth), along * np.sin(azimuth), -up)):
            moments[:, axis] += np.bincount(cell, values, len(cube))
    return moments


def _cells_of(cube: Hemicube, azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """The numbers of the directions in whose cells others lie."""
    flat, m = np.cos(elevation), cube.reach
    L = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), -np.sin(elevation)], -1)
    steps = np.rint(L * (m / np.abs(L).max(-1, keepdims=True))).astype(int)
    number = np.zeros((m + 1, cube.size, cube.size), int)
    number[-cube.steps[:, 2], cube.steps[:, 1] + m, cube.steps[:, 0] + m] = np.arange(len(cube))
    cells: np.ndarray = number[-steps[..., 2], steps[..., 1] + m, steps[..., 0] + m]
    return cells


def through_window(
    samples: Samples, scene: Scene, source: sources.Window, sky: Integrals | None
) -> np.ndarray:
    """Irradiance at the samples through a window of any kind.

    By EXACT_WINDOW_AZIMUTHS x EXACT_WINDOW_ELEVATIONS directions; small bright parts of ``sky`` cell by cell.
    """
    parts = sky.bright_parts if sky is not None else ()
    azimuths = 2 * np.pi * (np.arange(EXACT_WINDOW_AZIMUTHS) + 0.5) / EXACT_WINDOW_AZIMUTHS
    total, deep = np.zeros(len(samples)), -samples.own.astype(float)
    e = (np.arange(EXACT_WINDOW_ELEVATIONS)[:, None] + 0.5) / EXACT_WINDOW_ELEVATIONS * np.pi / 2
    for azimuth, slope in zip(azimuths, samples.horizons(azimuths)):
        c, s = math.cos(azimuth), math.sin(azimuth)
        away = deep / np.tan(e)
        seen = passes(scene, source, samples.x + away * c, samples.y + away * s) & (np.tan(e) >= slope)
        light = without(source.brightness, parts, sources.directions_of(azimuth, np.sin(e)))
        along = (samples.gx * c + samples.gy * s) / samples.length
        total += (
            np.where(seen, light, 0)
            * np.cos(e)
            * np.maximum(0, along * np.cos(e) + np.sin(e) / samples.length)
        ).sum(0)
    total *= (np.pi / 2 / EXACT_WINDOW_ELEVATIONS) * (2 * np.pi / EXACT_WINDOW_AZIMUTHS)
    total += _parts_through(samples, scene, source, parts)
    return total


def _parts_through(
    samples: Samples, scene: Scene, source: sources.Window, parts: Iterable[BrightPart]
) -> np.ndarray:
    """Light of small bright parts at the samples through a window."""
    total, deep = np.zeros(len(samples)), -samples.own.astype(float)
    for part in parts:
        count = len(part.cells.azimuth)
        for some in np.array_split(np.arange(count), min(PART_AZIMUTHS, count)):
            cells = part.cells.pick(some)
            slope = samples.horizons(cells.azimuth.mean(keepdims=True))[0]
            azimuth, e = cells.azimuth[:, None], (cells.low + cells.high)[:, None] / 2
            c, s, away = np.cos(azimuth), np.sin(azimuth), deep / np.tan(e)
            seen = passes(scene, source, samples.x + away * c, samples.y + away * s) & (np.tan(e) >= slope)
            along, up = cells.moments
            light = (samples.gx * c + samples.gy * s) * along[:, None] + up[:, None]
            total += (seen * np.maximum(0, light)).sum(0) / samples.length
    return total


def passes(scene: Scene, source: sources.Window, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether rays that cross z = 0 at (x, y) [spacings] pass the window."""
    rows, cols = scene.shape
    inside = (x >= -0.5) & (x < cols - 0.5) & (y >= -0.5) & (y < rows - 0.5)
    if source.aperture is not None:
        col, row = np.floor(x + 0.5).astype(np.int64), np.floor(y + 0.5).astype(np.int64)
        there: np.ndarray = source.aperture[row % rows, col % cols]
        return there if scene.sides == "periodic" else inside & there
    assert source.x is not None and source.y is not None, "a window without aperture is a rectangle"
    passes: np.ndarray = inside if scene.sides == "dark" else np.ones(inside.shape, bool)
    for at, (low, high), period in ((x, source.x, cols), (y, source.y, rows)):
        low, high = low / scene.spacing, high / scene.spacing
        passes = passes & (
            np.mod(at - low, period) < high - low if scene.sides == "periodic" else (low <= at) & (at < high)
        )
    return passes


def at_samples(
    samples: Samples, scene: Scene, source: sources.Source, size: int, sky: Integrals | None
) -> np.ndarray:
    """The filled lattice's light at the samples.

    A direction is visible where it lies on or above the horizon of its azimuth.
    """
    cube = Hemicube(size)
    moments = moments_of(source, cube, sky)
    ways, number = np.unique(np.round(np.arctan2(cube.steps[:, 1], cube.steps[:, 0]), 9), return_inverse=True)
    slopes = samples.horizons(ways)
    flat = np.hypot(cube.steps[:, 0], cube.steps[:, 1])
    rise = -cube.steps[:, 2] / np.maximum(flat, 1e-9)
    normal = np.stack([samples.gx, samples.gy, -np.ones(len(samples))]) / samples.length
    planes = np.maximum(0, samples.plane(np.cos(ways)[:, None], np.sin(ways)[:, None]))
    total = np.zeros(len(samples))
    for some in np.array_split(np.arange(len(cube)), len(cube) // 512 + 1):
        seen = rise[some, None] * (1 + 1e-6) >= slopes[number[some]]
        # the tangent plane hides nothing: cells are cut by N.w
        seen |= slopes[number[some]] <= planes[number[some]]
        if isinstance(source, sources.Window):
            away = -samples.own / np.maximum(rise[some, None], 1e-9)
            horizontal = cube.steps[some, :2] / np.maximum(flat[some, None], 1e-9)
            seen &= passes(
                scene, source, samples.x + away * horizontal[:, :1], samples.y + away * horizontal[:, 1:]
            ) & (rise[some, None] > 0)
        total += (seen * np.maximum(0, moments[some] @ normal)).sum(0)
    return total


def warnings_of(problem: Problem, scene: Scene, source: sources.Source, cube: Hemicube) -> list[str]:
    """Known errors of the lattice for this scene and source, one sentence each."""
    small = _jumped(problem, source, cube) or _small_lamp(scene, source, cube)
    return [*_leak(problem, cube), *small, *_uneven_sky(source, cube)]


def _uneven_sky(source: sources.Source, cube: Hemicube) -> list[str]:
    """A warning where a sky's brightness towards the directions is not that of all the sky."""
    worst = 1.0
    for grey in sources.channels(source):
        if isinstance(grey, sources.Sky) and callable(grey.brightness):
            taken = -float(cube.moments[:, 2] @ sources.radiance(grey, cube.directions))
            level = integrals(grey, math.inf).level
            worst = max(
                worst,
                taken / level if level else math.inf if taken else 1.0,
                key=lambda times: abs(times - 1),
            )
    if abs(worst - 1) <= MISSED_SKY:
        return []
    return [
        f"Uneven sky: level ground gets {worst:.3g} times the light of the sky, whose narrow features lie"
        ' between the directions of the lattice, or in their middle; use method="auto".'
    ]


def _leak(problem: Problem, cube: Hemicube) -> list[str]:
    """A warning where unfilled steps jump over ridges."""
    if problem.filled or cube.size < LEAK_SIZE:
        return []
    surveyed = problem.depth.survey()
    square = (
        sum(total / max(1, count) for total, count in zip(surveyed.squares, surveyed.pairs)) / problem.step**2
    )
    if square > LEAK_SLOPE**2:
        return [
            f"Leak: the rms slope is {np.sqrt(square):.2f}, and steps of {cube.reach} nodes pass"
            " through ridges, so light leaks; use filled=True."
        ]
    return []


def _as_ball(scene: Scene, source: sources.Source) -> tuple[np.ndarray, float] | None:
    """(Middle, radius) of a sphere, or of one as large as a volume or as wide as a window; None of others."""
    volume, step = None, scene.spacing
    if isinstance(source, sources.Lamp) and source.volume is not None:
        volume = np.asarray(source.volume)
    elif isinstance(source, sources.Lamp) and source.center is not None and source.radius is not None:
        return np.array(source.center, float), source.radius
    elif isinstance(source, sources.Window) and source.aperture is not None:
        volume = source.aperture[None]
    elif isinstance(source, sources.Window) and source.x is not None and source.y is not None:
        sides = np.array([source.x, source.y], float)
        return np.append(sides.mean(1), 0.0), math.sqrt(float(np.prod(np.diff(sides, axis=1))) / math.pi)
    if volume is None or not volume.any():
        return None
    middle = step * np.argwhere(volume).mean(0)[::-1]
    count = int(volume.sum())
    flat = isinstance(source, sources.Window)
    return middle, step * (math.sqrt(count / math.pi) if flat else (3 * count / (4 * math.pi)) ** (1 / 3))


def _jumped(problem: Problem, source: sources.Source, cube: Hemicube) -> list[str]:
    """A warning where steps, which meet a volume at their ends, or filled ones at crossings, jump over it."""
    if cube.reach < 2 or not isinstance(source, sources.Lamp) or source.volume is None:
        return []
    nodes = np.argwhere(source.volume)
    narrow = int(np.ptp(nodes, axis=0).min()) + 1 if len(nodes) else cube.size
    if problem.filled and JUMPED_FILLED * narrow <= cube.reach:
        return [
            f"Small lamp: steep steps of up to {cube.reach} nodes pass a volume {narrow} nodes thick between"
            " two crossings; up to a third of its light is lost: use a smaller hemicube, or a thicker volume."
        ]
    if problem.filled or narrow >= JUMPED * cube.reach:
        return []
    return [
        f"Small lamp: steps of up to {cube.reach} nodes jump over parts of a volume {narrow} nodes wide,"
        " whose light is lost; use filled=True, or a smaller hemicube."
    ]


def _small_lamp(scene: Scene, source: sources.Source, cube: Hemicube) -> list[str]:
    """A warning where a lamp or window is narrower than the gaps between directions."""
    ball = _as_ball(scene, source)
    if ball is None:
        return []
    rows, cols = scene.shape
    (x, y, z), radius = ball
    right, low = (cols - 1) * scene.spacing, (rows - 1) * scene.spacing
    far = math.hypot(max(abs(x), abs(right - x)), max(abs(y), abs(low - y)), scene.deepest - z)
    spacing = np.sqrt(2 * np.pi / len(cube))
    apparent = 2 * np.arcsin(radius / far if radius < far else 1.0)  # far: 0 where the map is one node
    if apparent < 2 * spacing:
        what = "window" if isinstance(source, sources.Window) else "lamp"
        return [
            f"Small {what}: from the farthest ground it is {np.degrees(apparent):.1f} degrees wide and the"
            f" directions are {np.degrees(spacing):.1f} degrees apart, so few or no directions of some nodes"
            " meet it; use a larger hemicube."
        ]
    return []
