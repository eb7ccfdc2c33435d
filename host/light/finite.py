"""Balls, rectangles and windows through azimuth slices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .. import sources
from ..backends.base import Array, Backend
from ..scene import Scene
from ..sources.integrals import Integrals, chords
from ..sources.solids import Ball, Dome, Quad, upright
from . import unoccluded
from .base import Estimate, LightMethod
from .slices import CHORD_AZIMUTHS, CHORD_KNOTS, Slices, ball_nodes, outline, widened

# where in its step a slice of a ball lies; at 1/2 and 0 even and odd slices are mirror images, and their
# difference does not show half of the error
SHIFT = 0.25
RAYS = 4, 16, 64  # to a small lamp, along which its brightness is taken


class Sliced(LightMethod):
    """``solid`` [unit of depth] in ``units`` slices where it surrounds a node, fewer where it looks small.

    ``rays``: the brightness is the mean along so many rays from every node to the lamp; else its integral
    along the chord of each slice, and the small bright parts of what is visible through a window have
    azimuths of their own. The slices of a ball are two images that share none; refining puts as many slices
    between them. Those of a quadrangle are Gauss-Legendre nodes: rules of different size share none.
    """

    def __init__(
        self,
        engine: Backend,
        scene: Scene,
        source: sources.Source,
        solid: Ball | Quad,
        units: int,
        rays: int = 0,
        sky: Integrals | None = None,
    ):
        self.engine, self.scene, self.units, self.rays = engine, scene, units, rays
        self.there = scene.on(engine)
        self.step = self.there.step
        self.solid, self.scale = widened(solid, self.there)
        self.source, self.sky = source, sky
        self.factor = None
        self.brightness: Any = 1.0 if rays else source.brightness
        if sky is not None and not rays:
            self.brightness = chords(sky, CHORD_AZIMUTHS, CHORD_KNOTS)
        if rays:
            self.factor = self._factor()
        self.shifts = [SHIFT]
        self._run()

    def _factor(self) -> np.ndarray:
        """The mean brightness of the source from every node (rows, cols) float32, by rays."""
        solid = upright(self.solid, self.step)
        light, uniform = (
            unoccluded.image(self.scene, solid, brightness, self.rays)
            for brightness in (self.source.brightness, 1.0)
        )
        factor: np.ndarray = np.divide(
            light, uniform, out=np.zeros(self.scene.shape, np.float32), where=uniform > 0
        )
        return factor

    def _run(self) -> None:
        slices = Slices(
            self.there,
            self.scene.sides,
            self.solid,
            self.brightness,
            self.units,
            shift=SHIFT,
        )
        slices.run()
        self.slices, self.mean = slices, slices.image
        self.difference: Array = slices.alternating if isinstance(self.solid, Ball) else None
        self.suns: Array = None
        if self.sky is not None and self.sky.suns:
            assert isinstance(self.solid, Quad), "small bright parts are seen through windows"
            found = [sun.sectors(max(8, self.units)) for sun in self.sky.suns]
            bright = Slices(self.there, self.scene.sides, Dome())
            bright.clear()
            ways, tables = zip(*found)
            bright.sectors(np.concatenate(ways, 1), np.concatenate(tables, 0), outline(self.solid, self.step))
            self.suns = bright.image

    def refine(self) -> None:
        """Of a ball, the slices between the present ones; of a quadrangle, twice as many slices."""
        if not isinstance(self.solid, Ball):
            self.units *= 2
            self._run()
            return
        between = [(shift + 0.5 / len(self.shifts)) % 1 for shift in self.shifts]
        slices, first = self.slices, None
        for n, shift in enumerate(between):
            slices.nodes = self.engine.table(ball_nodes(slices.most, shift))
            slices.image = self.engine.empty(self.scene.shape, np.float32)
            slices.run()
            first = slices.image if first is None else self._mean(first, slices.image, n)
        self.shifts += between
        self.units *= 2
        self.difference = first
        self.engine.launch(
            "ground",
            "halves",
            (math.prod(self.scene.shape),),
            self.mean,
            self.difference,
            math.prod(self.scene.shape),
        )

    def _mean(self, image: Array, other: Array, count: int) -> Array:
        """``image``, the mean of ``count`` images, updated with one more."""
        values = self.engine.download(image) * (count / (count + 1)) + self.engine.download(other) / (
            count + 1
        )
        return self.engine.upload(values.astype(np.float32))

    def irradiance(self) -> np.ndarray:
        image = self._scaled(self.mean)
        if self.sky is not None:
            image = np.maximum(image, 0)  # a difference of sums may round to less
        return (
            image
            if self.suns is None
            else image + np.float32(self.scale) * self.engine.download(self.suns).reshape(image.shape)
        )

    def half(self) -> np.ndarray | None:
        return None if self.difference is None else self._scaled(self.difference)

    def _scaled(self, image: Array) -> np.ndarray:
        found: np.ndarray = self.engine.download(image).reshape(self.scene.shape)
        if self.factor is not None:
            found = found * self.factor
        return found if self.scale == 1.0 else found * np.float32(self.scale)

    def estimate(self, limit: float) -> Estimate | None:
        if self.difference is None:
            return None
        image, half = self.irradiance(), np.abs(self._scaled(self.difference))
        if self.scene.mask is not None:
            image, half = image[self.scene.mask], half[self.scene.mask]
        lit = image > 0
        mean = float(image.sum(dtype=np.float64)) / lit.sum() if lit.any() else 1e-30
        return Estimate(
            math.sqrt(float(np.square(half, dtype=np.float64).mean())) / mean,
            np.count_nonzero(half > limit) / half.size,
        )
