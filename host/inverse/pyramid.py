"""The problem of recover(method="robust") on all grids: images, bounds, albedo and smoothness of each.

Grids are box means of the images, coarser by factors of two.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import logging
import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .. import sources
from ..backends.base import Backend
from .descent import Descent
from .lights import Light, brightness_of, light_of
from .resampling import cubic, doubled, halved

log = logging.getLogger("skylamp")
COARSEST = 16  # nodes on the shorter side of the coarsest grid
# errors of the model [unit of the scaled images]: at least so much counts as noise, and a pixel with no more
# light is dark; performance/doubt.py
MODEL_ERROR = 5e-4
IMAGE_RMS = 0.4  # rms to which images are scaled, so that one smoothness fits all
AZIMUTHS = 24  # of a sky in the model
# smoothness [1 / spacing^2] for an image without noise; on a large grid, where relief is rough
LEAST_SMOOTHNESS, LEAST_ON_LARGE = 1e-5, 1e-7
SMALL = 64  # longer side [nodes] up to which grids are solved by continuation, larger ones by cycles
# longest side [nodes] of the grid on which the search in a large image starts: a coarser grid would not
# represent its relief
LARGEST_START = 128
GOOD_RESIDUAL = 0.0025  # residual, as a share of the image, below which no other surface is looked for
# variance of the light's second differences on the next coarser grid over that on a grid, as far as relief
# causes them
TEXTURE = 16.0
# prior variances that noise is weighed against: of second differences of a surface on the grid of starts, and
# of those of the detail that a grid adds to the next coarser one
PRIOR_VARIANCE, ADDED_VARIANCE = 0.1, 0.03
# weight of the prior of the albedo until the unit of the images is known: its square is a float32, and images
# may be 1e15 times as bright as albedo 1 makes them. Derived
UNIT_UNKNOWN = 1e-18
NEAREST = 1e-3  # depth [nodes] of a surface that would lie at the viewer's plane or before it
LEAST_RANGE = 0.5  # least distance [nodes] between the bounds of depth, when they are narrowed
NORMAL_QUARTILE = 0.6745  # median of the absolute value of a standard normal number
CROSS_NORM = 6  # root of the sum of squares of the cross of second differences


class Level(NamedTuple):
    """The result on one grid: its shape, the rms of model - image as a share of the image's, and the
    seconds since the start, without compiling.
    """

    shape: tuple[int, ...]
    residual: float
    seconds: float


def noise_of(image: np.ndarray, known: np.ndarray) -> float:
    """Standard deviation of white noise in an image: what a cross of second differences leaves (Immerkaer
    1996, with a median), where all nine pixels are known (rows, cols), on the coarser grid three quarters of
    each; 0 if none are.

    Fine relief contributes too, but its variance is TEXTURE times as large on the next coarser grid, where
    noise, scaled to that of one pixel, has the same variance. That separates the two.
    """
    if min(image.shape) < 6:
        return 0.0

    def second(v: np.ndarray) -> np.ndarray:
        return np.asarray(v[:-2] - 2 * v[1:-1] + v[2:])

    left = []
    for values, weight in ((image, known), (2 * halved(image), halved(known))):
        crosses = np.abs(second(second(values).T).T)[_surrounded(weight)]
        if not crosses.size:
            return 0.0
        left.append(float(np.median(crosses)) / (NORMAL_QUARTILE * CROSS_NORM))
    return math.sqrt(max(0.0, TEXTURE * left[0] ** 2 - left[1] ** 2) / (TEXTURE - 1))


def _surrounded(known: np.ndarray) -> np.ndarray:
    """(rows - 2, cols - 2) bool: where all nine pixels are known."""
    return np.asarray(sliding_window_view(known > 0.7, (3, 3)).all((2, 3)))


def noise_of_all(
    images: list[np.ndarray], known: list[np.ndarray], albedo: float | np.ndarray | None
) -> float:
    """RMS over images of the deviation of their noise; albedo None: to be found.

    Paint on the ground may look like noise. It does not change images over the albedo, where noise is
    1 / albedo times as large; nor, if the albedo is not known, the share q of an image in the mean T of all
    n, where it is sqrt((1 - q / n)^2 + (n - 1) (q / n)^2) / T times as large. So the images have no more of
    it than these tell.
    """
    noise, count = _rms_of(map(noise_of, images, known)), len(images)
    paint: np.ndarray = np.mean(images, axis=0) if albedo is None else np.asarray(albedo)
    if noise == 0 or np.ptp(paint) == 0:
        return noise
    lit = paint > MODEL_ERROR * float(paint.max())
    all_known = np.where(lit, np.min(known, axis=0), 0.0)
    if not all(_surrounded(grid).any() for grid in (all_known, halved(all_known))):
        return noise
    paint, found = np.where(lit, paint, 1.0), []
    for image in images:
        without, times = image / paint, 1 / paint
        if albedo is None:
            share = without / count
            times = times * np.sqrt((1 - share) ** 2 + (count - 1) * share**2)
        if (typical := float(np.median(times[all_known > 0]))) > 0:  # else this image alone has light
            found.append(noise_of(without, all_known) / typical)
    return min(noise, _rms_of(found)) if found else noise


def _rms_of(values: Iterable[float]) -> float:
    return math.sqrt(float(np.mean(np.square(list(values)))))


def share_of_images(residuals: np.ndarray) -> float:
    """The rms of residuals (n, rows, cols) in the unit of the pyramid, as a share of the images'."""
    return math.sqrt(float(np.mean(np.square(residuals)))) / IMAGE_RMS


def grid_of_starts(shapes: list[tuple[int, ...]]) -> int:
    """The level at which the search starts: of small images the coarsest, of others the first coarser one
    whose longer side has at most LARGEST_START nodes.
    """
    coarsest = len(shapes) - 1
    if max(shapes[0]) <= SMALL:
        return coarsest
    return next((level for level in range(1, coarsest) if max(shapes[level]) <= LARGEST_START), coarsest)


class Pyramid:
    """The problem on all grids. Lengths in nodes of the finest grid outside, in each grid's own inside.

    images (rows, cols) radiance; albedo a number or (rows, cols), or None: to be found; near, far (rows,
    cols) bounds; interreflection: whether ground lights ground; known (rows, cols) of every image: the pixels
    to explain, all if None; has_noise: whether images have noise, which is estimated. ``stop``: asked after
    every step whether to end; ``report``: called with every level that was reached; ``spent``: gives the
    seconds since the start.

    Of every grid: seen, the images; weights, the share of each of their pixels that is known; images, what is
    explained, seen times weights.
    """

    stop: Callable[[], bool] = staticmethod(lambda: False)
    report: Callable[[Level], None] = staticmethod(lambda level: None)
    spent: Callable[[], float] = staticmethod(lambda: 0.0)

    def __init__(
        self,
        engine: Backend,
        images: list[np.ndarray],
        lights: list[sources.Source],
        albedo: float | np.ndarray | None,
        sides: str,
        near: np.ndarray,
        far: np.ndarray,
        interreflection: bool = False,
        known: list[np.ndarray] | None = None,
        has_noise: bool = True,
    ):
        self.engine, self.sources, self.sides = engine, lights, sides
        self.interreflection = interreflection
        weights = [np.ones(image.shape) for image in images] if known is None else known
        explained = [image * weight for image, weight in zip(images, weights)]
        self.units = [math.sqrt(float(np.mean(np.square(image)))) / IMAGE_RMS for image in explained]
        # where brightness is a number, models are of 1: light so many times as strong is a unit so many times
        # as small
        self.scales = [unit / sources.number_of(source) for unit, source in zip(self.units, lights)]
        self.seen, self.images = (
            [[image / unit for image, unit in zip(all_of, self.units)]] for all_of in (images, explained)
        )
        self.weights = [[weight.astype(float) for weight in weights]]
        self.has_gaps = not all(np.all(weight) for weight in weights)
        self.bounds = [(near, far)]
        self.albedo_known = albedo is not None
        # if it is not known: what is expected
        self.albedo = [np.broadcast_to(np.asarray(1.0 if albedo is None else albedo, float), images[0].shape)]
        while min(self.images[-1][0].shape) >= 2 * COARSEST:
            for grids in (self.seen, self.images, self.weights):
                grids.append([halved(values) for values in grids[-1]])
            low, high = self.bounds[-1]
            self.bounds.append((halved(low) / 2, halved(high) / 2))
            self.albedo.append(halved(self.albedo[-1]))
        self.coarsest = len(self.images) - 1
        self.start = grid_of_starts([level[0].shape for level in self.images])
        self.noise = noise_of_all(self.seen[0], self.weights[0], albedo) if has_noise else 0.0
        # by number, since a source may hold what cannot be hashed
        self.brightness = functools.cache(lambda number, azimuths: brightness_of(lights[number], azimuths))
        self.problems: dict[int, Descent] = {}
        self.expected_albedo = 0.0
        if not self.albedo_known:  # from here on as shares of what a flat surface would have
            low, high = self.bounds[self.coarsest]
            flat = self.problem(self.coarsest)
            assert flat.albedo is not None, "the albedo is not known"
            flat.albedo.set_prior(0.0, UNIT_UNKNOWN)
            self._expect_albedo(self.coarsest, (low + high) / 2)
            self.albedo, self.expected_albedo = [self.expected_albedo * albedo for albedo in self.albedo], 1.0
            self.problems.clear()
        # (level, depth): the last surface that was accepted, whatever comes
        self.best: tuple[int, np.ndarray] | None = None

    def shape(self, level: int) -> tuple[int, int]:
        rows, cols = self.images[level][0].shape
        return rows, cols

    def is_small(self, level: int) -> bool:
        return max(self.shape(level)) <= SMALL

    def _expect_albedo(self, level: int, z: np.ndarray) -> None:
        """Expects the median of the albedo at z everywhere, from here on."""
        self.expected_albedo = float(np.median(self.problem(level).fitted_albedo(z)[shown(self, level)]))
        for problem in self.problems.values():
            assert problem.albedo is not None, "the albedo is not known"
            problem.albedo.set_prior(self.expected_albedo)

    def smoothness(self, level: int) -> float:
        """Weight of squared second differences: variance of noise on a grid over that of the prior."""
        variance = PRIOR_VARIANCE if level >= self.start else ADDED_VARIANCE
        return self.least_smoothness(level) + noise_at(self, level) ** 2 / variance

    def least_smoothness(self, level: int) -> float:
        return LEAST_SMOOTHNESS if self.is_small(level) or level >= self.start else LEAST_ON_LARGE

    def good_objective(self, level: int) -> float:
        """The objective below which another minimum is not looked for."""
        deviation = GOOD_RESIDUAL * IMAGE_RMS + noise_at(self, level)
        return float(0.5 * self.images[level][0].size * len(self.sources) * deviation**2)

    def problem(self, level: int) -> Descent:
        if level not in self.problems:
            lights = self.lights(self.shape(level), 0.5**level, AZIMUTHS)
            problem = Descent(
                self.engine,
                self.shape(level),
                self.sides,
                [
                    (light, self.albedo[level] * weight / (math.pi * scale), image)
                    for light, scale, image, weight in zip(
                        lights, self.scales, self.images[level], self.weights[level]
                    )
                ],
                *self.bounds[level],
                self.albedo_known,
                self.radiances(level),
            )
            if problem.albedo is not None:
                problem.albedo.set_prior(self.expected_albedo)
            self.problems[level] = problem
        return self.problems[level]

    def radiances(self, level: int) -> list[np.ndarray] | None:
        """What the ground sends to ground, in each model's unit; None where that is left out."""
        if not self.interreflection:
            return None
        return [image * scale for image, scale in zip(self.seen[level], self.scales)]

    def lights(self, shape: tuple[int, int], scale: float, azimuths: int) -> list[Light]:
        """The sources for a grid, see light_of."""
        return [
            light_of(source, shape, scale, self.brightness(number, azimuths))
            for number, source in enumerate(self.sources)
        ]

    def set_bounds(self, bounds: list[tuple[np.ndarray, np.ndarray]]) -> None:
        self.bounds = bounds
        for level, problem in self.problems.items():
            problem.set_bounds(*bounds[level])

    @contextlib.contextmanager
    def no_deeper_than(self, deepest: float, level: int) -> Iterator[None]:
        """Narrower bounds on all grids for a time: no depth beyond ``deepest`` [nodes of grid ``level``]."""
        free = self.bounds
        closer = (
            (low, np.clip(deepest * 2.0 ** (level - grid), low + LEAST_RANGE, high))
            for grid, (low, high) in enumerate(free)
        )
        self.set_bounds(list(closer))
        try:
            yield
        finally:
            self.set_bounds(free)

    def set_prior(self, level: int, z: np.ndarray) -> None:
        """Makes the part of the smoothness that stands for noise act on the difference to z. The rest still
        acts on the whole surface.
        """
        self.problem(level).set_prior((1 - self.least_smoothness(level) / self.smoothness(level)) * z)

    def fix_albedo(self, level: int, z: np.ndarray) -> None:
        """Takes the albedo that is best for z on this grid for known from here on, on all grids."""
        self.albedo[level] = self.albedo[level] * self.problem(level).fitted_albedo(z)
        self.albedo_known = True
        for coarser in range(level + 1, self.coarsest + 1):
            self.albedo[coarser] = halved(self.albedo[coarser - 1])
        for finer in range(level - 1, -1, -1):
            self.albedo[finer] = doubled(self.albedo[finer + 1], self.shape(finer))
        self.problems.clear()

    def accept(self, level: int, z: np.ndarray) -> None:
        """Takes z for the answer so far."""
        if self.best is None or self.best[0] >= level:
            self.best = level, z
        problem = self.problem(level)
        problem.value(z, self.smoothness(level))
        if not self.albedo_known:
            self._expect_albedo(level, z)
        misfit = sum(problem.misfits) / (problem.pixels * len(problem.images))
        residual = math.sqrt(misfit) / IMAGE_RMS
        reached = Level(z.shape, residual, self.spent())
        log.info(
            "%d x %d: residual %.2g of the image, %.1f s", *reached.shape, reached.residual, reached.seconds
        )
        self.report(reached)


def noise_at(pyramid: Pyramid, level: int) -> float:
    """Standard deviation of the noise of a pixel of a grid, the mean of pixels of the finest."""
    return float(pyramid.noise * 0.5**level)


def residuals_of(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray:
    """Models less images (n, rows, cols) of the surface z of a grid, in the unit of the pyramid."""
    off: np.ndarray = np.stack(pyramid.problem(level).irradiances(z)) - np.stack(pyramid.images[level])
    return off


def without_gaps(pyramid: Pyramid) -> Pyramid:
    """The problem of the images with their gaps filled."""
    filled = copy.copy(pyramid)
    filled.images, filled.problems = list(pyramid.seen), {}
    filled.weights = [[np.ones(weight.shape) for weight in level] for level in pyramid.weights]
    return filled


def shown(pyramid: Pyramid, level: int) -> np.ndarray:
    """(rows, cols) bool: nodes of a grid of which an image shows at least a part."""
    nodes: np.ndarray = np.max(pyramid.weights[level], axis=0) > 0
    return nodes


def lit(pyramid: Pyramid, level: int) -> np.ndarray:
    """(rows, cols) bool: nodes of a grid of which an image shows light, and not only that they are dark."""
    images = zip(pyramid.images[level], pyramid.weights[level])
    nodes: np.ndarray = np.any([(image > MODEL_ERROR) & (weight > 0) for image, weight in images], axis=0)
    return nodes


@contextlib.contextmanager
def without(pyramid: Pyramid, light: list[np.ndarray], level: int) -> Iterator[None]:
    """On grid ``level`` and coarser ones: images less this light, for a time."""
    whole = list(pyramid.images)
    rest = [np.maximum(own - part, 0) for own, part in zip(whole[level], light)]
    try:
        for grid in range(level, pyramid.coarsest + 1):
            _set_images(pyramid, grid, rest)
            rest = [halved(image) for image in rest]
        yield
    finally:
        for grid in range(level, pyramid.coarsest + 1):
            _set_images(pyramid, grid, whole[grid])


def _set_images(pyramid: Pyramid, level: int, images: list[np.ndarray]) -> None:
    pyramid.images[level] = images
    if level in pyramid.problems:
        pyramid.problems[level].set_targets(images)


def on_coarser_grid(z: np.ndarray) -> np.ndarray:
    """What the next coarser grid holds of z (rows, cols), on the grid of z."""
    return cubic(halved(np.asarray(z, float)), 2)[: z.shape[0], : z.shape[1]]
