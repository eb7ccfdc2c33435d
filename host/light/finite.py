"""Balls, rectangles and windows through azimuth slices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .. import sources
from ..backends.base import Array, Backend
from ..backends.resident import DeviceImage
from ..errors import bad
from ..samples import Samples, lit_mean, picked, samples_of
from ..scene import Scene
from ..sources.integrals import Integrals
from ..sources.solids import Ball, Quad, aperture, rectangle, upright
from . import unoccluded
from .base import Estimate, Later, LightMethod, estimated, judged
from .slices import CHORD_AZIMUTHS, CHORD_KNOTS, Slices, ball_quadrature, outline, widened

# where in its step a slice of a ball lies; at 1/2 and 0 even and odd slices are mirror images, and their
# difference does not show half of the error
SLICE_SHIFT = 0.25
RAY_COUNTS = 4, 16, 64, 256, 1024  # to a small lamp, along which its brightness is taken
LAMP_SAMPLES = 256  # nodes; chosen, fewer than of a sky: shadows are sharper, and rays cost more
# of RAY_COUNTS; with 16 and 256 the light from below the level of a slope, a hill and a panel changes by up
# to 7 and 1 % of itself
RAYS_BELOW = 64
MOST_RAY_EVALUATIONS = 2**25  # of a brightness for the sake of rays, some ten seconds
# share of a lamp's light that the ground takes from a node that is called partly hidden. Chosen: the light of
# other nodes is at most so much of itself wrong, where a part that is not of mean brightness is hidden; with
# half and twice the errors of three such lamps (64 x 64) stay the same
PARTLY = 1e-3
# of the mean brightness: where a quarter of the rays changes it by more, 16 times as many are taken, if such
# nodes are rare: the samples miss them. Chosen: a lamp right above a node, with the pole of its brightness
# there, changed by 6 % and was 29 % off
RAY_CHANGE, MOST_CHANGED = 0.02, 1 / 64
CHORDS_AT_ONCE = 2**18  # some 20 arrays of 8 bytes a chord
# extents of a map to which a rectangular lamp may reach: there a node is a quarter of float32's resolution
MOST_PANEL_EXTENTS = 2.0**22
MOST_BALL_EXTENTS = 2.0**40  # the same of a sphere, whose squares stay in float32; suns stand at 1e5
# largest azimuth [rad] that a small bright part behind a window may span: slices, which are placed within the
# window, resolve wider ones. Chosen: with half a sun of 4 degrees behind windows 1.1 spacings wide is up to
# 3.7 tolerances off at 0.3 %, without a word; with 3 times this one of 29 random windows is 1.1, and others
# are as they are
WINDOWED_PART = math.radians(10)


def solid_of(scene: Scene, source: sources.Lamp | sources.Window, step: float = 1.0) -> Ball | Quad | None:
    """The shape of a lamp or window, in lengths in which the spacing is ``step``.

    None for a window outside a dark box, or too far away to light anything.
    """
    scale = step / scene.spacing
    if isinstance(source, sources.Window):
        (x0, x1), (y0, y1) = np.array(source.x) * scale, np.array(source.y) * scale
        return aperture((x0, x1), (y0, y1), scene.shape, step, scene.sides, scene.deepest * scale)
    _check_reach(scene, source)
    if source.corner is not None and source.edges is not None:
        return rectangle(*(np.array(v) * scale for v in (source.corner, *source.edges)))
    assert source.center is not None and source.radius is not None, "the lattice alone renders a volume"
    x, y, z = np.array(source.center) * scale
    return Ball((x, y, z), source.radius * scale)


def _check_reach(scene: Scene, lamp: sources.Lamp) -> None:
    """InputError for a lamp so far away, or so large, that float32 cannot tell the nodes' views apart."""
    numbers: list[Any] = [lamp.center, lamp.radius]
    most = MOST_BALL_EXTENTS
    if lamp.corner is not None:
        numbers, most = [lamp.corner, lamp.edges], MOST_PANEL_EXTENTS
    far = max(float(np.abs(part).max()) for part in numbers if part is not None)
    extent = max(max(scene.shape) * scene.spacing, scene.deepest)
    if far > most * extent:
        raise bad(
            "lamp: of such size or so far away",
            f"{far:.3g} for a map of {extent:.3g}",
            f"{most:g} times the map's extent, which float32 resolves",
            "Give a Sky, or a Window.",
        )


def left_below(scene: Scene, lamp: sources.Lamp, engine: Backend) -> float:
    """Light of a grey sphere or rectangle that comes from below the nodes' level: RMS over the mean of all.

    Nodes that are higher than a part of a lamp see that part below their level; horizons, slices and the
    lattice leave it out, since L_z <= 0, and closed forms do not. At samples, as if no ground hid the lamp.
    """
    solid = upright(solid_of(scene, lamp))
    assert solid is not None, "a lamp is nowhere cut off"
    lowest = solid.center[2] - solid.radius if isinstance(solid, Ball) else np.min(solid.corners, axis=0)[2]
    if lowest >= 0 or lowest >= (samples := samples_of(engine, scene, LAMP_SAMPLES)).highest:
        return 0.0
    brightness = sources.Sky(lamp.brightness)

    def below(towards: np.ndarray) -> np.ndarray:  # where directions below the level are given as level
        return np.where(towards[..., 2] < 0, 0, sources.radiance(brightness, towards))

    places = samples.gx, samples.gy, samples.x, samples.y, samples.own.astype(float)
    lost = unoccluded.lamp(*places, solid, below, RAYS_BELOW).astype(float)
    mean = lit_mean(unoccluded.lamp(*places, solid, lamp.brightness, RAYS_BELOW))
    return math.sqrt(float(np.mean(lost**2))) / mean if mean else 0.0


def most_rays(scene: Scene) -> int:
    """Of RAY_COUNTS, the most that can be taken to every node."""
    nodes = math.prod(scene.shape)
    return max((rays for rays in RAY_COUNTS if rays * nodes <= MOST_RAY_EVALUATIONS), default=0)


def add_bright_parts(slices: Slices, sky: Integrals, units: int) -> None:
    """Add the light of small bright parts of the sky behind a window, in so many sectors of azimuth each."""
    if sky.bright_parts:
        assert isinstance(slices.solid, Quad), "small bright parts lie behind windows"
        ways, tables = zip(*(spot.sectors(units) for spot in sky.bright_parts))
        window = outline(slices.solid, slices.step)
        slices.sectors(np.concatenate(ways, 1), np.concatenate(tables, 0), window)


class Sliced(LightMethod):
    """``solid`` [unit of depth] in ``units`` slices where it surrounds a node, fewer where it looks small.

    ``rays``: the brightness is the mean along so many rays from every node to the lamp; else its integral
    along the chord of each slice, and the small bright parts of the sky behind a window have azimuths of
    their own. The slices of a ball are two images that share none; refining puts as many slices
    between them. Those of a quadrangle are Gauss-Legendre nodes: rules of different size share none, and the
    image is that of the larger of two. Where there are rays, the half difference includes the change that a
    quarter of them makes.
    """

    unit_name = "slices"

    def __init__(
        self,
        engine: Backend,
        scene: Scene,
        source: sources.Source,
        solid: Ball | Quad,
        units: int,
        rays: int,
        sky: Integrals | None,
    ):
        self.engine, self.scene, self.units, self.rays = engine, scene, units, rays
        self.there = scene.on(engine)
        self.step = self.there.step
        self.solid, self.scale = widened(solid, self.there)
        self.source, self.sky = source, sky
        self.factors: tuple[np.ndarray, np.ndarray] | None = None
        self.brightness: Any = 1.0 if rays else source.brightness
        if sky is not None and not rays:
            self.brightness = sky.chords(CHORD_AZIMUTHS, CHORD_KNOTS)
        self.shifts = [SLICE_SHIFT]
        if isinstance(self.solid, Ball):
            self.slices, self.mean = self._image(units)
            self._half_difference = self.slices.alternating
        else:
            self._compare(self._image(units // 2)[1])
        if rays:
            self._take_rays(rays)

    def _take_rays(self, rays: int) -> None:
        """Take the lamp's brightness along so many rays from every node."""
        solid, self.rays = upright(self.solid, self.step), rays
        self.uniform = unoccluded.image(self.scene, solid, 1.0)
        whole = (unoccluded.image(self.scene, solid, self.source.brightness, n) for n in (rays, rays // 4))
        self.means = [
            np.divide(light, self.uniform, out=np.zeros_like(light), where=self.uniform > 0)
            for light in whole
        ]
        many, few = self.means
        uneven = np.abs(many - few) > RAY_CHANGE * many
        self.is_partial = np.zeros(self.scene.shape, bool)
        if uneven.sum() <= MOST_CHANGED * uneven.size:
            self._take_chords(uneven, 16 * rays)
        self._take_chords()

    def _take_chords(self, nodes: np.ndarray | None = None, rays: int = 0) -> None:
        """Take the lamp's brightness along the visible parts of chords, by as many points as there are rays.

        At ``nodes`` (rows, cols), by as many as so many ``rays``; unless given, where the lamp is found to be
        partly hidden. Sets ``factors``: its mean brightness, and half the change that a quarter of the points
        makes, (rows, cols) float32 each.
        """
        if nodes is None:
            seen = self.engine.download(self.mean).reshape(self.scene.shape)
            nodes = (seen > 0) & (seen < (1 - PARTLY) * self.uniform) & ~self.is_partial
        self.is_partial |= nodes
        y, x = np.nonzero(nodes)
        samples, solid = samples_of(self.engine, self.scene), upright(self.solid, self.step)
        for mean, count in zip(self.means, (rays or self.rays, (rays or self.rays) // 4)):
            points = math.isqrt(count)  # of each chord
            # chosen: with half of them a test's lamp beside walls is off by 1.8 tolerances in place of 0.4
            chords = 4 * points
            for first in range(0, len(x), CHORDS_AT_ONCE // chords):
                some = slice(first, first + CHORDS_AT_ONCE // chords)
                samples.set_nodes(x[some], y[some])
                light, uniform = (
                    samples.through_slices(solid, brightness, chords, points=points)
                    for brightness in (self.source.brightness, 1.0)
                )
                at = y[some], x[some]
                mean[at] = np.divide(light, uniform, out=mean[at].astype(float), where=uniform > 0)
        self.factors = self.means[0], (self.means[0] - self.means[1]) / 2

    def _image(self, units: int) -> tuple[Slices, Array]:
        """The light through ``units`` slices, and of small bright parts in as many sectors."""
        slices = Slices(self.there, self.scene.sides, self.solid, self.brightness, units, shift=SLICE_SHIFT)
        slices.run()
        if self.sky is not None:
            add_bright_parts(slices, self.sky, units)
        return slices, slices.image

    def _compare(self, coarse: Array) -> None:
        """Set the image of ``units`` slices, and half its difference from ``coarse``."""
        self.mean, self._half_difference = self._image(self.units)[1], coarse
        self._halve(self._half_difference, self.mean, keep=True)

    def refine(self) -> None:
        """Of a ball, the slices between the present ones; of a quadrangle, twice as many.

        More rays in their place where the brightness along them errs more than the slices.
        """
        if self.factors and 4 * self.rays <= most_rays(self.scene):
            mean, difference = (self.engine.download(image) for image in (self.mean, self._half_difference))
            factor, change = (np.nan_to_num(values).ravel() for values in self.factors)
            if np.linalg.norm(mean.ravel() * change) > np.linalg.norm(difference.ravel() * factor):
                self._take_rays(4 * self.rays)
                return
        self._add_slices()
        if self.factors:
            self._take_chords()

    def _add_slices(self) -> None:
        if not isinstance(self.solid, Ball):
            self.units *= 2
            self._compare(self.mean)
            return
        between = [(shift + 0.5 / len(self.shifts)) % 1 for shift in self.shifts]
        slices, means = self.slices, []
        for n, shift in enumerate(between):
            slices.quadrature = self.engine.table(ball_quadrature(slices.most, shift))
            slices.image = self.engine.empty(self.scene.shape, np.float32)
            slices.run()
            means.append(slices.image)
            while n % 2:  # the mean of two images, of two such means, and so on
                self._halve(means[-2], means.pop())
                n //= 2
        self.shifts += between
        self.units *= 2
        (self._half_difference,) = means
        self._halve(self.mean, self._half_difference)

    def _halve(self, image: Array, other: Array, keep: bool = False) -> None:
        """Make ``image`` the mean and ``other`` half the difference; or keep ``other``, and half the
        difference in ``image``."""
        count = math.prod(self.scene.shape)
        self.engine.launch("ground", "halves", (count,), image, other, count, int(keep))

    def irradiance(self) -> np.ndarray:
        image = self.engine.download(self.mean).reshape(self.scene.shape)
        return self._scaled(image, self.factors and self.factors[0])

    def device_image(self) -> DeviceImage | None:
        if self.factors is not None:
            return None
        image = DeviceImage(self.engine, self.mean, self.scene.shape)
        image.scale(self.scale, 0.0)
        return image

    def at(self, samples: Samples) -> np.ndarray:
        factor = self.factors and self.factors[0][samples.y, samples.x]
        return self._scaled(picked(samples, self.mean), factor).astype(float)

    def _scaled(self, image: np.ndarray, factor: np.ndarray | None) -> np.ndarray:
        """In the irradiance's unit; a difference of sums may round to less than 0."""
        image = np.maximum(image, 0)
        image = image if factor is None else image * factor
        return image if self.scale == 1.0 else image * np.float32(self.scale)

    def half_difference_at(self, samples: Samples) -> np.ndarray | None:
        if self.factors is not None:
            return super().half_difference_at(samples)
        return picked(samples, self._half_difference).astype(float) * self.scale

    def half_difference(self) -> Later:
        engine, images, shape = self.engine, (self.mean, self._half_difference), self.scene.shape
        scale, factors = np.float32(self.scale), self.factors

        def work() -> np.ndarray:
            mean, difference = (engine.download(image).reshape(shape) * scale for image in images)
            return np.hypot(difference * factors[0], mean * factors[1]) if factors else difference

        return Later(work)

    def estimate(self, limit: float) -> Estimate | None:
        if not self.factors:
            images, heights = (self.mean, self._half_difference), self.there.heights()
            found = judged(self.engine, self.scene.shape, heights, 0, *images, limit / self.scale)
            return found._replace(mean=found.mean * self.scale)
        return estimated(self.irradiance(), self.half_difference()(), self.scene.mask, limit)
