"""Planning for lamps and windows: a closed form where every node sees all of them, else slices; points of a
line where they are thin.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from functools import partial

import numpy as np

from .. import sources
from ..arrays import by_bands
from ..backends.base import Backend
from ..directions import Hemicube
from ..light import unoccluded
from ..light.base import LightMethod
from ..light.finite import (
    LAMP_SAMPLES,
    MOST_RAY_EVALUATIONS,
    RAY_COUNTS,
    WINDOWED_PART,
    Sliced,
    most_rays,
    solid_of,
)
from ..light.line import LineLight, LinePoints, at_samples, lights_of, line_of
from ..light.slices import outline, widened
from ..light.unoccluded import ClosedForm
from ..radiometry import point_error
from ..samples import CHORD_POINTS, Errors, Samples, samples_of
from ..scene import Scene
from ..sources.integrals import BrightPart, Integrals, integrals, without
from ..sources.solids import Ball, Quad, upright
from .base import EXACT_ERROR_RATIO, TABLES_ERROR, Planner, UnitsPlanner, uniform_light
from .plan import Choice, percent

# numbers of slices that an image may begin with: of a source that stands all round a node, and of a
# quadrangle, whose four sectors share them; refining doubles them
BALL_SLICES, QUAD_SLICES = (8, 16, 32, 64), (32, 64)
# points along a thin source; and the apparent width [rad], 0.3 degrees, below which a source is computed as a
# line. That neglects how brightness varies across it: its curvature times the squared width over 24. Chosen;
# with half and twice the median and the largest error of 16 panels, windows and lamps at 1 % stay the same.
# Two panels of less than a spacing, 512 x 512 at 1 %, take 2.4 and 1.7 s with 8 points at first, since their
# tail is refined, 2.3 and 1.6 s with 16, 3.2 and 3.1 s with 32 (performance/pairs.py, seed 7744, 9 and 7)
LINE_COUNTS, LINE_WIDTH = (16, 32, 64, 128, 256, 512), 5e-3
# the same at the node nearest to it [rad]. Derived: an evenly bright strip is a 24th of the square of this,
# or 4e-4, darker than a line
NEAREST_LINE_WIDTH = 0.1
LEAST_REACHED = 128  # points that every node of a map must have within MOST_RAY_EVALUATIONS; chosen
EXACT_SLICE_MULTIPLE = 4  # times the slices of an image: those of the exact light that judges it
# sectors of a small bright part behind a window in the exact light, where the window shows the whole part;
# multiplied by the part's width over the window's where that is larger; and their largest number. They are
# odd, so that they are no multiple of the numbers that they judge
EXACT_SECTORS, MOST_EXACT_SECTORS = 127, 1021
# apparent radius [rad] of a lamp below which rays sample its brightness: six cells of a table of brightness
NARROW_RADIUS = 0.02
# apparent radius [rad] of a source, 0.1 degrees, at the node nearest to it, to which its brightness is taken
# along one ray. Derived: of cos^p it is then p / 4 times the square of this too large in the middle of the
# spot, or 7e-4 for p = 900
ONE_RAY_RADIUS = math.radians(0.1)
# least mean irradiance to which errors are relative, as a share of the mean light of the same source if it
# were unoccluded and everywhere as bright as in its brightest direction; chosen: a thousandth of what an
# 8-bit image shows under the beam itself; with half and twice the errors of 15 lamps and windows at 1 % stay
# the same
LEAST_LIGHT = 1e-6
POINT_SHARE = 0.1  # share of the tolerance: largest error as a point of a lamp that a plan calls a point


class HiddenWindowPlanner(Planner):
    """A window of which a dark box, or its distance, leaves nothing."""

    def choose(self) -> None:
        self.exact, self.expected = np.zeros(len(self.samples)), Errors(0.0, 0.0, 0.0)

    def make(self) -> LightMethod:
        return ClosedForm(self.scene, np.zeros(self.scene.shape, np.float32))

    def choices(self) -> Iterator[Choice]:
        yield Choice("window", "nothing to see", "a dark box, or its distance, leaves nothing of it")


class FinitePlanner(UnitsPlanner):
    """A lamp or window of simple shape."""

    sample_count = LAMP_SAMPLES
    solid: Ball | Quad  # [spacings], heights third
    middle: np.ndarray  # of it
    radius: float  # of a sphere round it
    apparent: float  # mean apparent radius [rad] of that sphere
    sky: Integrals | None = None  # of a brightness that varies
    # in the plan's words, where a closed form does not serve: how small bright parts are taken, why units
    # serve, and how they take a brightness that varies, and why
    parts_taken: str
    why_units = ""
    brightness_by_units = "along every chord", "integrated"
    # rays from every node to the source along which a brightness that varies is taken, 0: by units
    rays_per_node = 0
    exact: np.ndarray

    def choose(self) -> None:
        samples, brightness = self.samples, self.source.brightness
        solid = upright(solid_of(self.scene, self.source))
        assert solid is not None, "HiddenWindowPlanner takes a window of which nothing is left"
        self.solid = solid
        if isinstance(self.solid, Ball):
            self.middle, self.radius = np.array(self.solid.center), self.solid.radius
        else:
            corners = np.asarray(self.solid.corners, float)
            self.middle = corners.mean(0)
            self.radius = float(np.linalg.norm(corners - self.middle, axis=1).max())
        distance = np.maximum(_distances(self.middle, samples), 1e-9)
        self.apparent = float(np.arcsin(np.minimum(1, self.radius / distance)).mean())
        if callable(brightness):
            most = sources.radiance(sources.Sky(brightness), Hemicube(9).directions).max()
            samples.least = LEAST_LIGHT * float(self._unoccluded(1, float(most)).mean())
        self.uniform = uniform_light(samples)
        self._prepare()
        if not self._fits_closed_form():
            self._choose_refinable()

    @abstractmethod
    def _prepare(self) -> None:
        """Set what the light at the samples needs, and exact light that a closed form is held against."""

    @abstractmethod
    def _choose_refinable(self) -> None:
        """Choose the method that serves where a closed form does not, and its units."""

    @abstractmethod
    def _make_refinable(self) -> LightMethod:
        """That method, which can be refined, with its first image."""

    def make(self) -> LightMethod:
        if not self.closed:
            return self._make_refinable()
        scene, brightness, rays = self.scene, self.source.brightness, self.rays_per_node
        fine, *coarse = (
            unoccluded.image(scene, self.solid, brightness, n)
            for n in ((rays, rays // 4) if rays > 1 else (1,))
        )
        return ClosedForm(scene, fine, coarse[0] if coarse else None, rays if callable(brightness) else 0)

    def refine(self, is_mostly_common: bool) -> bool:
        if not self.closed:
            return super().refine(is_mostly_common)
        self.rays_per_node *= 4
        if self.rays_per_node > most_rays(self.scene):
            self._choose_refinable()
        self.method = self.make()
        return True

    def _fits_closed_form(self) -> bool:
        """Whether every node sees all of the source, also over the walls of a dark box, and rays follow its
        brightness.
        """
        if self.sky is not None and self.sky.bright_parts:
            return False  # they may light few nodes, which rays and samples miss
        if self.scene.sides == "dark" and not _within_walls(self.scene, self.solid, self.middle, self.radius):
            return False
        varies = callable(self.source.brightness)
        if varies:
            if not self._faces_source():
                return False
            self._judge_by_rays(RAY_COUNTS[-1])
        most = most_rays(self.scene) if varies else 0
        for rays_per_node in (1, *(rays for rays in RAY_COUNTS if rays <= most)):
            if rays_per_node == RAY_COUNTS[-1]:
                self._judge_by_rays(4 * RAY_COUNTS[-1])
            errors = self.samples.errors(self._unoccluded(rays_per_node), self.exact)
            if not self.fits(errors):
                continue
            # one ray suffices where the source looks small from every node; else two numbers of rays tell the
            # error at all nodes, since the samples may lie beside the light
            if varies and rays_per_node == 1:
                if self.radius > ONE_RAY_RADIUS * _nearest(self.scene, self.middle, self.middle):
                    continue
            if not (varies or self._faces_source()):
                break
            self.expected, self.rays_per_node = errors, rays_per_node
            return True
        return False

    def _judge_by_rays(self, count: int) -> None:
        """Set the exact light by so many rays, which follow a steep brightness better than slices."""
        coarse, self.exact = self._unoccluded(count // 4), self._unoccluded(count)
        self.exact_error = EXACT_ERROR_RATIO * self.samples.errors(coarse, self.exact).rms

    def _faces_source(self) -> bool:
        """Whether all ground faces all of the source: the samples' tangent planes first, then every node."""
        at, radius = self.samples, self.radius if isinstance(self.solid, Ball) else 0.0
        x, y, z = self.middle[:, None] - np.stack([at.x, at.y, at.own])
        faced = at.gx * x + at.gy * y + z >= radius * at.length  # tangent planes hide no part of it
        if self.scene.mask is not None or not faced.all():
            return False
        places = np.array([self.middle] if isinstance(self.solid, Ball) else self.solid.corners)
        return all(by_bands(partial(unoccluded.faces, self.scene, places, radius), self.scene.shape))

    def _light_taken(self) -> tuple[str, str]:
        """How the light is taken, and why, in the plan's words."""
        if not self.closed:
            return f"{self.units} {self.method_class.unit_name}", self.why_units
        off = float(point_error(np.sin(self.apparent), 1.0))
        shape = "a sphere, closed form" if isinstance(self.solid, Ball) else "a polygon, closed form"
        taken = "a point" if off <= POINT_SHARE * self.tolerance else shape
        return taken, f"as a point, a disc of that size has an error of {percent(off)}"

    def _brightness_taken(self) -> tuple[str, str]:
        """How a brightness that varies is taken, and why, in the plan's words."""
        if not self.rays_per_node:
            taken, why = self.brightness_by_units
            return taken.format(self.units), why
        rays = "1 ray" if self.rays_per_node == 1 else f"{self.rays_per_node} rays"
        return f"along {rays}", "it varies little across the source"

    def _unoccluded(self, rays_per_node: int, brightness: sources.Brightness | None = None) -> np.ndarray:
        """Light at the samples in closed form, its brightness along so many rays from each."""
        at, solid = self.samples, self.solid
        brightness = self.source.brightness if brightness is None else brightness
        elements = at.gx, at.gy, at.x, at.y, at.own.astype(float)
        return unoccluded.lamp(*elements, solid, brightness, rays_per_node).astype(float)

    def choices(self) -> Iterator[Choice]:
        if self.closed:
            yield Choice("occlusion", "none", "every node looks at all of the source")
        else:
            yield Choice("occlusion", "by ground", "ground may stand before the source")
        taken, why = self._light_taken()
        why = f"its angular radius is {np.degrees(self.apparent):.2g} degrees on average; {why}".rstrip("; ")
        yield Choice("lamp" if isinstance(self.source, sources.Lamp) else "window", taken, why)
        varies = callable(self.source.brightness)
        yield Choice("brightness", *(self._brightness_taken() if varies else ("constant", "it is a number")))
        parts = self.sky.bright_parts if self.sky is not None and not self.closed else ()
        if parts:
            yield Choice("bright parts", f"{len(parts)}", self.parts_taken)
        yield Choice("search radius", "up to the source", "what lies behind it hides nothing")


def _within_walls(scene: Scene, solid: Ball | Quad, middle: np.ndarray, radius: float) -> bool:
    """Whether a source stands between the walls of a dark box, seen from above."""
    corners = [middle - radius, middle + radius] if isinstance(solid, Ball) else solid.corners
    low, high = np.min(corners, 0)[:2], np.max(corners, 0)[:2]
    return bool((low >= -0.5).all() and (high <= np.array(scene.shape[::-1]) - 0.5).all())


class SlicePlanner(FinitePlanner):
    """A closed form where every node looks at all of the source, else slices."""

    bright: float | np.ndarray = 0.0  # light of small bright parts behind a window
    smooth: sources.Brightness  # brightness without these
    by_slices: dict[tuple[int, int], np.ndarray]  # light at the samples by slices and points of each chord
    parts_taken = "seen through the window in azimuths of their own"

    def _prepare(self) -> None:
        self.smooth, self.by_slices = self.source.brightness, {}
        if callable(self.smooth) and isinstance(self.source, sources.Window):
            self._set_parts_apart()
        self.set_exact_light(EXACT_SLICE_MULTIPLE * BALL_SLICES[0])

    def _set_parts_apart(self) -> None:
        """Integrate the sky behind a window; the light of its small bright parts, and the rest."""
        there, source = self.scene.on(self.engine), self.source
        window = solid_of(self.scene, source, there.step)
        assert isinstance(window, Quad), "a window of which something is left is a quadrangle"
        wide, scale = widened(window, there)
        assert isinstance(wide, Quad), "widening keeps the kind of solid"
        seen = outline(wide, there.step)
        self.sky = integrals(sources.Sky(source.brightness), self.tolerance, True, WINDOWED_PART)
        if self.sky.bright_parts:
            self.smooth = partial(without, source.brightness, self.sky.bright_parts)
            self.bright = scale * sum(
                self.samples.sectors(*spot.sectors(_exact_sectors(spot, seen, self.samples)), seen)
                for spot in self.sky.bright_parts
            )

    def _choose_refinable(self) -> None:
        """Choose slices, and how brightness is taken: along few rays to a small lamp, else along chords."""
        self.method_class, self.rays_per_node = Sliced, 0
        if callable(self.source.brightness):
            if isinstance(self.source, sources.Lamp) and self.apparent < NARROW_RADIUS:
                self.rays_per_node = RAY_COUNTS[0]
            elif self.sky is None:
                self.sky = integrals(sources.Sky(self.source.brightness), math.inf, True)
            self.tables_error = 0.0 if self.rays_per_node else TABLES_ERROR
        counts = BALL_SLICES if isinstance(self.solid, Ball) else QUAD_SLICES
        self.choose_units((EXACT_SLICE_MULTIPLE * count, [count]) for count in counts)

    def set_exact_light(self, units: int) -> None:
        # half of the points along chords too: they meet a brightness's edges by chance
        coarse, self.exact = self._through(units // 2, CHORD_POINTS // 2), self._through(units, CHORD_POINTS)
        self.exact_error = EXACT_ERROR_RATIO * self.samples.errors(coarse, self.exact).rms

    def light_by(self, units: int) -> np.ndarray:
        # of a quadrangle that looks small the kernel takes half of the slices
        return self._through(units // 2 if isinstance(self.solid, Quad) else units, CHORD_POINTS)

    def _through(self, count: int, chord_points: int) -> np.ndarray:
        """Light at the samples through ``count`` slices, and that of small bright parts.

        A brightness that varies is taken at ``chord_points`` of the chord of every slice.
        """
        key = count, chord_points if callable(self.smooth) else 0
        if key not in self.by_slices:
            solid, scale = self.solid, 1.0
            if isinstance(solid, Ball):  # one that float32 holds, as the kernels have it
                there = self.scene.on(self.engine)
                whole = solid_of(self.scene, self.source, there.step)
                assert isinstance(whole, Ball), "it is in another unit"
                wide, scale = widened(whole, there)
                assert isinstance(wide, Ball), "widening keeps the kind of solid"
                solid = solid._replace(radius=wide.radius / there.step)
            through = self.samples.through_slices(solid, self.smooth, count, points=chord_points)
            self.by_slices[key] = scale * through + self.bright
        return self.by_slices[key]

    def _make_refinable(self) -> LightMethod:
        scene, source = self.scene, self.source
        step = scene.on(self.engine).step
        solid = solid_of(scene, source, step)
        assert solid is not None, "HiddenWindowPlanner takes a window of which nothing is left"
        sky = None if self.rays_per_node else self.sky
        return Sliced(self.engine, scene, source, solid, self.units, self.rays_per_node, sky)


class LinePlanner(FinitePlanner):
    """A thin source: a closed form, where every node looks at all of it and float32 holds its width; else
    points of the line through its middle.
    """

    lights: tuple[LineLight, ...]  # that its brightness is the sum of
    by_points: dict[int, np.ndarray]  # light at the samples by numbers of points
    parts_taken = "points of the line within each, besides those along all of it"
    why_units = "it is a line to every node"
    brightness_by_units = "along {} rays", "one to every point"

    def _prepare(self) -> None:
        self.by_points, brightness = {}, self.source.brightness
        if callable(brightness):
            self.sky = integrals(sources.Sky(brightness), self.tolerance, True)
        self.lights = lights_of(brightness, self.sky.bright_parts if self.sky else ())
        self.set_exact_light(EXACT_SLICE_MULTIPLE * LINE_COUNTS[0])

    def _choose_refinable(self) -> None:
        self.method_class, self.rays_per_node = LinePoints, 0
        self.choose_units((EXACT_SLICE_MULTIPLE * count, [count]) for count in LINE_COUNTS)

    def set_exact_light(self, units: int) -> None:
        self.exact = self.light_by(units)
        self.exact_error = EXACT_ERROR_RATIO * self.samples.errors(self.light_by(units // 2), self.exact).rms

    def light_by(self, units: int) -> np.ndarray:
        if units not in self.by_points:
            assert isinstance(self.solid, Quad), "balls are not thin"
            self.by_points[units] = at_samples(self.samples, self.solid, self.lights, units)
        return self.by_points[units]

    def _make_refinable(self) -> LightMethod:
        assert isinstance(self.solid, Quad), "balls are not thin"
        return LinePoints(self.engine, self.scene, self.solid, self.lights, self.units)

    def refine(self, is_mostly_common: bool) -> bool:
        rays = self.method.ray_count if isinstance(self.method, LinePoints) else 0
        return 2 * rays <= MOST_RAY_EVALUATIONS and super().refine(is_mostly_common)


def looks_thin(scene: Scene, source: sources.Lamp | sources.Window, engine: Backend) -> bool:
    """Whether a line renders it: it is thin, no lamp in a dark box, and the map small and on the host."""
    solid = upright(solid_of(scene, source))
    walled = isinstance(source, sources.Lamp) and scene.sides == "dark"
    if not isinstance(solid, Quad) or walled or scene.resident is not None:
        return False
    if LEAST_REACHED * math.prod(scene.shape) > MOST_RAY_EVALUATIONS:
        return False
    middle, line = np.asarray(solid.corners, float).mean(0), line_of(solid)
    distance = float(np.median(_distances(middle, samples_of(engine, scene, LAMP_SAMPLES))))
    if not line.width < LINE_WIDTH * distance:
        return False
    return line.width < NEAREST_LINE_WIDTH * _nearest(scene, line.begin, line.end)


def _nearest(scene: Scene, begin: np.ndarray, end: np.ndarray) -> float:
    """Distance from a line between two places (3,) to the node that is nearest to it, in spacings."""
    (x0, y0, z0), axis = begin.astype(np.float32), (end - begin).astype(np.float32)
    square = max(float(axis @ axis), 1e-30)
    across, down = (np.arange(n, dtype=np.float32) for n in scene.shape[::-1])

    def nearest(rows: slice) -> float:
        x, y, z = across - x0, down[rows, None] - y0, scene.depth[rows] / np.float32(-scene.spacing) - z0
        along = np.clip((x * axis[0] + y * axis[1] + z * axis[2]) / np.float32(square), 0, 1)
        away = (x - along * axis[0]) ** 2 + (y - along * axis[1]) ** 2 + (z - along * axis[2]) ** 2
        return float(np.fmin.reduce(away, axis=None))  # nan only where all is masked

    return math.sqrt(float(np.fmin.reduce(by_bands(nearest, scene.shape))))


def _distances(middle: np.ndarray, samples: Samples) -> np.ndarray:
    """From the samples to a place, both in spacings: (nodes,)."""
    away = middle[:, None] - np.stack([samples.x, samples.y, samples.own])
    distances: np.ndarray = np.sqrt((away**2).sum(0))
    return distances


def _exact_sectors(spot: BrightPart, outline: tuple[float, float, float, float], samples: Samples) -> int:
    """By how many sectors a small bright part behind a window of this ``outline`` [spacings] is judged."""
    (_, _, up), sine = spot.cone
    x0, x1, y0, y1 = outline
    across = 2 * sine * float(np.median(np.maximum(0, -samples.own))) / max(up, sine)
    times = math.ceil(across / min(x1 - x0, y1 - y0))
    return int(min(EXACT_SECTORS * times | 1, MOST_EXACT_SECTORS))
