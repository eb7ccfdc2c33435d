"""Planning for lamps and windows: a closed form where nothing hides them, else slices or points of a line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from .. import sources
from ..arrays import by_bands
from ..directions import Hemicube
from ..light import line, unoccluded
from ..light.base import LightMethod
from ..light.finite import MOST_RAY_EVALUATIONS, RAYS, Sliced, most_rays, solid_of
from ..light.slices import outline, widened
from ..light.unoccluded import ClosedForm
from ..radiometry import point_error
from ..samples import CHORD_POINTS, Errors, Samples
from ..sources.integrals import BrightPart, Integrals, integrals, without
from ..sources.solids import Ball, Quad, upright
from .base import JUDGE_SHARE, TABLES_ERROR, Planner, UnitsPlanner, uniform_light
from .plan import Choice, percent

# numbers of slices that an image may begin with: of a source that stands all round a node, and of a
# quadrangle, whose four sectors share them; refining doubles them
BALL_SLICES, QUAD_SLICES = (8, 16, 32, 64), (32, 64)
# points along a thin source; and the apparent width [rad], 0.3 degrees, below which a source is computed as a
# line. That neglects how brightness varies across it: its curvature times the squared width over 24. Chosen;
# with half and twice the median and the largest error of 16 panels, windows and lamps at 1 % stay the same
LINE_COUNTS, LINE_WIDTH = (32, 64, 128, 256, 512), 5e-3
JUDGING_SLICES = 4  # times the slices of an image: those of the exact light that judges it
# largest azimuth [rad] that a small bright part behind a window may span: slices, which are placed within the
# window, resolve wider ones
WINDOWED_PART = math.radians(5)
# sectors of a small bright part behind a window in the exact light, where the window shows the whole part;
# multiplied by the part's width over the window's where that is larger; and their largest number. They are
# odd, so that they are no multiple of the numbers that they judge
JUDGING_SECTORS, MOST_JUDGING_SECTORS = 127, 1021
# apparent radius [rad] of a lamp below which rays sample its brightness: six cells of a table of brightness
NARROW_RADIUS = 0.02
# least mean irradiance to which errors are relative, as a share of the mean light of the same source if it
# were unoccluded and everywhere as bright as in its brightest direction; chosen: a thousandth of what an
# 8-bit image shows under the beam itself; with half and twice the errors of 15 lamps and windows at 1 % stay
# the same
DARK = 1e-6
POINT_SHARE = 0.1  # share of the tolerance: largest error as a point of a lamp that a plan calls a point


class HiddenWindowPlanner(Planner):
    """A window of which a dark box, or its distance, leaves nothing."""

    def choose(self) -> None:
        self.exact, self.expected = np.zeros(len(self.samples)), Errors(0.0, 0.0, 0.0)

    def make(self) -> LightMethod:
        return ClosedForm(self.scene, np.zeros(self.scene.shape, np.float32))

    def choices(self) -> Iterator[Choice]:
        yield Choice("window", "nothing to see", "a dark box, or its distance, leaves nothing of it")


class SlicePlanner(UnitsPlanner):
    """Lamps and windows of simple shape: a closed form where every node looks at all of it, else slices."""

    sample_count = 256  # shadows are sharper than a sky's, and rays cost more
    solid: Ball | Quad  # [spacings], heights third
    sky: Integrals | None = None  # of a brightness that varies
    rays = 0  # along which the brightness of slices is taken, 0: along their chords
    points = 0  # rays of the closed form
    is_thin = False  # its light is taken along the line through its middle
    bright: float | np.ndarray = 0.0  # light of small bright parts behind a window
    smooth: sources.Brightness  # brightness without these
    lights: tuple[line.Light, ...] = ()  # of a thin source
    by_slices: dict[
        tuple[int, int], np.ndarray
    ]  # light at the samples by numbers of slices and points of each
    exact: np.ndarray

    def choose(self) -> None:
        brightness = self.source.brightness
        self._place()
        self.is_thin = _looks_thin(self)
        if callable(brightness):
            if self.is_thin or isinstance(self.source, sources.Window):
                self._integrate_sky()
            most = sources.radiance(sources.Sky(brightness), Hemicube(9).directions).max()
            self.samples.least = DARK * float(self._unoccluded(1, float(most)).mean())
        self.uniform = uniform_light(self.samples)
        if self.sky is not None and self.sky.bright_parts and not self.is_thin:
            self.bright = self.scale * sum(
                self.samples.sectors(
                    *spot.sectors(_judging_sectors(spot, self.outline, self.samples)), self.outline
                )
                for spot in self.sky.bright_parts
            )
            brightness = partial(without, self.source.brightness, self.sky.bright_parts)
        self.smooth, self.by_slices = brightness, {}
        if self.is_thin:
            self.lights = line.lights_of(self.source.brightness, self.sky.bright_parts if self.sky else ())
        else:
            self.judge_by(JUDGING_SLICES * BALL_SLICES[0])
            if self._fits_closed_form():
                return
        self._take_slices()

    def _take_slices(self) -> None:
        """Choose slices, and how brightness is taken: along few rays to a small lamp, else along chords."""
        self.method_class = Sliced
        counts = LINE_COUNTS if self.is_thin else BALL_SLICES if isinstance(self.solid, Ball) else QUAD_SLICES
        if callable(self.source.brightness) and not self.is_thin:
            if self.is_small:
                self.rays = RAYS[0]
            elif self.sky is None:
                self.sky = integrals(sources.Sky(self.source.brightness), math.inf, True)
            self.tables = 0.0 if self.rays else TABLES_ERROR
        self.choose_units((JUDGING_SLICES * count, [count]) for count in counts)

    def judge_by(self, units: int) -> None:
        # half of the points along chords too: they meet a brightness's edges by chance
        coarse, self.exact = self._through(units // 2, CHORD_POINTS // 2), self._through(units, CHORD_POINTS)
        self.exact_error = JUDGE_SHARE * self.samples.errors(coarse, self.exact).rms

    def light_of(self, units: int) -> np.ndarray:
        # of a quadrangle that looks small the kernel takes half of the slices
        halved = isinstance(self.solid, Quad) and not self.is_thin
        return self._through(units // 2 if halved else units, CHORD_POINTS)

    def _through(self, count: int, points: int) -> np.ndarray:
        """Light at the samples through ``count`` slices, and that of small bright parts; or along a line."""
        if self.is_thin or not callable(self.smooth):
            points = 0
        if (count, points) not in self.by_slices:
            if self.is_thin:
                assert isinstance(self.solid, Quad), "balls are not thin"
                light = line.at_samples(self.samples, self.solid, self.lights, count)
            else:
                light = (
                    self.samples.through_slices(self.solid, self.smooth, count, points=points) + self.bright
                )
            self.by_slices[count, points] = light
        return self.by_slices[count, points]

    def _place(self) -> None:
        """The solid, its middle, the radius of a sphere round it, and the mean apparent radius [rad]."""
        scene, samples = self.scene, self.samples
        solid = upright(solid_of(scene, self.source, 1 / scene.spacing, 1.0))
        assert solid is not None, "HiddenWindowPlanner takes a window of which nothing is left"
        self.solid = solid
        if isinstance(self.solid, Ball):
            self.middle, self.radius = np.array(self.solid.center), self.solid.radius
        else:
            corners = np.asarray(self.solid.corners, float)
            self.middle = corners.mean(0)
            self.radius = float(np.linalg.norm(corners - self.middle, axis=1).max())
        away = self.middle[:, None] - np.stack([samples.x, samples.y, samples.own])
        distance = np.maximum(np.sqrt((away**2).sum(0)), 1e-9)
        self.apparent = float(np.arcsin(np.minimum(1, self.radius / distance)).mean())
        self.is_small = isinstance(self.source, sources.Lamp) and self.apparent < NARROW_RADIUS

    def _integrate_sky(self) -> None:
        """Integrals of the brightness, and unless it is thin the window's outline for small bright parts."""
        self.sky = integrals(sources.Sky(self.source.brightness), self.tolerance, True, WINDOWED_PART)
        if self.is_thin:
            return
        there = self.scene.on(self.engine)
        window = solid_of(self.scene, self.source, there.step / self.scene.spacing, there.step)
        assert isinstance(window, Quad), "a window of which something is left is a quadrangle"
        wide, self.scale = widened(window, there)
        assert isinstance(wide, Quad), "widening keeps the kind of solid"
        self.outline = outline(wide, there.step)

    def _unoccluded(self, points: int, brightness: sources.Brightness | None = None) -> np.ndarray:
        """Light at the samples in closed form, its brightness along ``points`` rays."""
        at = self.samples
        return unoccluded.lamp(
            at.gx,
            at.gy,
            at.x,
            at.y,
            at.own.astype(float),
            self.solid,
            self.source.brightness if brightness is None else brightness,
            points,
        ).astype(float)

    def _fits_closed_form(self) -> bool:
        """Whether every node sees all of the source, also over the walls of a dark box."""
        if self.scene.sides == "dark":
            corners = (
                [self.middle - self.radius, self.middle + self.radius]
                if isinstance(self.solid, Ball)
                else self.solid.corners
            )
            low, high = np.min(corners, 0)[:2], np.max(corners, 0)[:2]
            if not ((low >= -0.5).all() and (high <= np.array(self.scene.shape[::-1]) - 0.5).all()):
                return False
        most = most_rays(self.scene) if callable(self.source.brightness) else 0
        for points in (1, *(rays for rays in RAYS if rays <= most)):
            errors = self.samples.errors(self._unoccluded(points), self.exact)
            if self.fits(errors) and self._faces_source():
                self.expected, self.points = errors, points
                return True
        return False

    def _faces_source(self) -> bool:
        """Whether every node's tangent plane lies below all of the source: the samples' first, then all."""
        at, radius = self.samples, self.radius if isinstance(self.solid, Ball) else 0.0
        x, y, z = self.middle[:, None] - np.stack([at.x, at.y, at.own])
        if self.scene.mask is not None or not unoccluded.above_plane(at.gx, at.gy, x, y, z, radius).all():
            return False
        across, down = (np.arange(n, dtype=np.float32) for n in self.scene.shape[::-1])
        points = np.asarray([self.middle] if isinstance(self.solid, Ball) else self.solid.corners, np.float32)

        def face(rows: slice) -> bool:
            gx, gy = unoccluded.gradients(self.scene, rows)
            deep = self.scene.depth[rows] / np.float32(self.scene.spacing)
            return all(
                unoccluded.above_plane(
                    gx, gy, x - across, y - down[rows, None], z + deep, np.float32(radius)
                ).all()
                for x, y, z in points
            )

        return all(by_bands(face, self.scene.shape))

    def make(self) -> LightMethod:
        scene, source = self.scene, self.source
        if self.closed:
            counts = (self.points, self.points // 4) if self.points > 1 else (1,)
            images = (unoccluded.image(scene, self.solid, source.brightness, n) for n in counts)
            return ClosedForm(scene, *images)
        step = scene.on(self.engine).step
        solid = solid_of(scene, source, step / scene.spacing, step)
        assert solid is not None, "HiddenWindowPlanner takes a window of which nothing is left"
        sky = None if self.rays else self.sky
        return Sliced(self.engine, scene, source, solid, self.units, self.rays, sky, self.lights)

    def refine(self, is_shared: bool) -> bool:
        if self.closed:
            self.points *= 4
            if self.points > most_rays(self.scene):
                self._take_slices()
        elif isinstance(self.method, Sliced) and 2 * self.method.ray_count > MOST_RAY_EVALUATIONS:
            return False
        else:
            return super().refine(is_shared)
        self.method = self.make()
        return True

    def choices(self) -> Iterator[Choice]:
        closed, source = self.closed, self.source
        yield Choice(
            "occlusion",
            "none" if closed else "by ground",
            "every node looks at all of the source" if closed else "ground may stand before the source",
        )
        off = float(point_error(np.sin(self.apparent), 1.0))
        taken, why = (
            f"{self.units} {'points' if self.is_thin else 'slices'}",
            f"its angular radius is {np.degrees(self.apparent):.2g} degrees on average",
        )
        if self.is_thin:
            why += "; it is a line to every node"
        if closed:
            shape = "a sphere, closed form" if isinstance(self.solid, Ball) else "a polygon, closed form"
            taken = "a point" if off <= POINT_SHARE * self.tolerance else shape
            why += f"; as a point, a disc of that size has an error of {percent(off)}"
        yield Choice("lamp" if isinstance(source, sources.Lamp) else "window", taken, why)
        rays = self.points if closed else self.rays
        if not callable(source.brightness):
            yield Choice("brightness", "constant", "it is a number")
        elif self.is_thin:
            yield Choice("brightness", f"along {self.units} rays", "one to every point")
        elif rays:
            yield Choice("brightness", f"along {rays} rays", "it varies little across the source")
        else:
            yield Choice("brightness", "along every chord", "integrated")
        if not closed and callable(source.brightness) and self.sky is not None and self.sky.bright_parts:
            why = "seen through the window in azimuths of their own"
            if self.is_thin:
                why = "points of the line within each, besides those along all of it"
            yield Choice("bright parts", f"{len(self.sky.bright_parts)}", why)
        yield Choice("search radius", "up to the source", "what lies behind it hides nothing")


def _looks_thin(planner: SlicePlanner) -> bool:
    """Whether the source is so thin that a line has its light, and the map on the host and small enough."""
    scene, samples = planner.scene, planner.samples
    walled = isinstance(planner.source, sources.Lamp) and scene.sides == "dark"
    if isinstance(planner.solid, Ball) or walled or scene.resident is not None:
        return False
    away = planner.middle[:, None] - np.stack([samples.x, samples.y, samples.own])
    distance = float(np.median(np.sqrt((away**2).sum(0))))
    few = LINE_COUNTS[2] * math.prod(scene.shape) <= MOST_RAY_EVALUATIONS
    return few and line.line_of(planner.solid).width < LINE_WIDTH * distance


def _judging_sectors(spot: BrightPart, outline: tuple[float, float, float, float], samples: Samples) -> int:
    """By how many sectors a small bright part behind a window of this ``outline`` [spacings] is judged."""
    (_, _, up), sine = spot.cone
    x0, x1, y0, y1 = outline
    across = 2 * sine * float(np.median(np.maximum(0, -samples.own))) / max(up, sine)
    times = math.ceil(across / min(x1 - x0, y1 - y0))
    return int(min(JUDGING_SECTORS * times | 1, MOST_JUDGING_SECTORS))
