"""A lamp or window through azimuth slices, as many as every node sees it in."""

from __future__ import annotations

import math

import numpy as np

from .. import sources
from ..backends.base import Backend
from ..backends.slices import Ball, Dome, Quad, Slices, _ball_nodes
from ..brightness import Integrals, chords
from ..scene import Scene
from . import unoccluded
from .base import Estimate, LightMethod

THIN = 2e-3  # apparent width [rad] of what is widened: of its light a square over 12 is lost, 3e-7, and float32 holds its width to 5e-5; derived
SHIFT = 0.25  # where in its step a slice of a ball stands; at 1/2 and 0 even and odd slices are mirror images, and their difference is blind to half of the error
TURNS, KNOTS = 1024, 4097  # cells of azimuth and of the sine of elevation of a brightness, 8 bytes each: 0.35 degrees round the horizon, and 0.16 at an elevation of 85
RAYS = 4, 16, 64  # to a small lamp, along which its brightness is taken


class Sliced(LightMethod):
    """``solid`` [unit of depth] in ``units`` slices where it stands all round, fewer where it looks small.

    ``rays``: the brightness is the mean along so many rays to the lamp, of every node; else what every slice's chord holds, integrated, and the small
    bright parts of what is seen through a window have azimuths of their own. The slices of a ball are two images that share none; to refine
    puts as many slices between them. Those of a quadrangle stand by Gauss and Legendre: other numbers share none.
    """

    def __init__(self, engine: Backend, scene: Scene, source: sources.Source, solid: Ball | Quad, units: int, rays: int = 0, sky: Integrals | None = None):
        self.engine, self.scene, self.units, self.rays = engine, scene, units, rays
        self.depth, self.step = scene.lattice()
        self.solid, self.scale = widened(solid, self.depth, self.step)
        self.source, self.sky = source, sky
        self.factor = None
        self.brightness = 1.0 if rays else source.brightness if sky is None else chords(sky, TURNS, KNOTS)
        if rays:
            upright = solid._replace(center=(*np.array(self.solid.center) / self.step * (1, 1, -1),), radius=self.solid.radius / self.step) if isinstance(solid, Ball) else Quad(np.asarray(self.solid.corners) / self.step * (1, 1, -1))
            light = [unoccluded.image(scene, upright, brightness, rays) for brightness in (source.brightness, 1.0)]
            self.factor = np.divide(*light, out=np.zeros(scene.shape, np.float32), where=light[1] > 0)
        self.levels = [SHIFT]
        self._run()

    def _run(self):
        slices = Slices(self.engine, self.depth, self.step, self.scene.sides, self.solid, self.brightness, self.units, shift=SHIFT)
        slices.run()
        self.slices, self.mean, self.difference = slices, slices.image, slices.alternating if isinstance(self.solid, Ball) else None
        self.suns = None
        if self.sky is not None and self.sky.suns:
            found = [sun.sectors(max(8, self.units)) for sun in self.sky.suns]
            bright = Slices(self.engine, self.depth, self.step, self.scene.sides, Dome())
            bright.clear()
            bright.sectors(*(np.concatenate(parts, axis) for parts, axis in zip(zip(*found), (1, 0))), outline(self.solid, self.step))
            self.suns = bright.image

    def refine(self) -> None:
        """The slices of a ball that stand between; of a quadrangle twice as many."""
        if not isinstance(self.solid, Ball):
            self.units *= 2
            self._run()
            return
        between = [(shift + 0.5 / len(self.levels)) % 1 for shift in self.levels]
        slices, first = self.slices, None
        for n, shift in enumerate(between):
            slices.nodes = self.engine.upload(_ball_nodes(slices.most, shift))
            slices.image = self.engine.empty(self.scene.shape, np.float32)
            slices.run()
            first = slices.image if first is None else self._mean(first, slices.image, n)
        self.levels += between
        self.units *= 2
        self.difference = first
        self.engine.launch("ground", "halves", (math.prod(self.scene.shape),), self.mean, self.difference, math.prod(self.scene.shape))

    def _mean(self, image, other, count):
        """The mean of ``count`` images, in ``image``, and one more."""
        values = self.engine.download(image) * (count / (count + 1)) + self.engine.download(other) / (count + 1)
        return self.engine.upload(values.astype(np.float32))

    def irradiance(self) -> np.ndarray:
        image = self._scaled(self.mean)
        if self.sky is not None:
            image = np.maximum(image, 0)  # a difference of sums may round to less
        return image if self.suns is None else image + np.float32(self.scale) * self.engine.download(self.suns).reshape(image.shape)

    def half(self) -> np.ndarray | None:
        return None if self.difference is None else self._scaled(self.difference)

    def _scaled(self, image):
        found = self.engine.download(image).reshape(self.scene.shape)
        if self.factor is not None:
            found = found * self.factor
        return found if self.scale == 1.0 else found * np.float32(self.scale)

    def estimate(self, limit: float) -> Estimate | None:
        if self.difference is None:
            return None
        image, half = (values if self.scene.mask is None else values[self.scene.mask] for values in (self.irradiance(), np.abs(self.half())))
        lit = image > 0
        mean = float(image.sum(dtype=np.float64)) / lit.sum() if lit.any() else 1e-30
        return Estimate(math.sqrt(float(np.square(half, dtype=np.float64).mean())) / mean, np.count_nonzero(half > limit) / half.size)


def outline(window: Quad, step: float) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 [spacing] of a window."""
    (x0, y0, _), (x1, y1, _) = (of(np.asarray(window.corners, float) / step, axis=0).tolist() for of in (np.min, np.max))
    return x0, x1, y0, y1


def widened(solid: Ball | Quad, depth: np.ndarray, step: float) -> tuple[Ball | Quad, float]:
    """A quadrangle whose thin sides are widened to what float32 can hold as the ground sees it, and what its light must be multiplied by: across so little,
    light is in proportion to the width. ``depth`` (rows, cols) in a unit in which the spacing is ``step``."""
    if isinstance(solid, Ball):
        return solid, 1.0
    corners = np.asarray(solid.corners, float)
    rows, cols = depth.shape
    middle, finite = corners.mean(0), depth[:: max(1, rows // 32), :: max(1, cols // 32)]
    y, x = np.mgrid[0 : rows : max(1, rows // 32), 0 : cols : max(1, cols // 32)] * step
    away = np.sqrt((x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (finite - middle[2]) ** 2)
    least = THIN * float(np.median(away[np.isfinite(away)], axis=None)) if np.isfinite(away).any() else 0.0
    edges, scale = [corners[1] - corners[0], corners[3] - corners[0]], 1.0
    for n, edge in enumerate(edges):
        length = float(np.linalg.norm(edge))
        if length < least:
            edges[n], scale = edge * (least / length), scale * length / least
    if scale == 1.0:
        return solid, 1.0
    corner = middle - (edges[0] + edges[1]) / 2
    return Quad(np.array([corner, corner + edges[0], corner + edges[0] + edges[1], corner + edges[1]])), scale
