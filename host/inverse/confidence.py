"""How far the depth that was found is to be trusted, and which other depths explain a pixel.

Each doubt is a map that counts 1 where it alone would halve the confidence; they add up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .albedo import PRIOR_WEIGHT
from .descent import Descent
from .multigrid import CLOSE, ITERATIONS, STEPS
from .pyramid import IMAGE_RMS, SMALL, Pyramid, on_coarser_grid
from .resampling import blurred, cubic, doubled, halved, halved_depth
from .search import Rival

# of the range of depths, and nodes at least: two answers this far apart are worth half the confidence
DOUBT, LEAST_DOUBT = 0.025, 1.0
APART = 2 * DOUBT  # of the range of depths, from which another depth is a candidate
CANDIDATES = 2  # other depths of a pixel, at most
POSTERIOR_WEIGHT = 4.0  # of the doubt that noise leaves, against that of another start
UNEVEN_WEIGHT = 1.4  # of the distance to the surface with a more even albedo, where it is not known
# of the squared distance to the surface of a finer model, which is about the same in nodes on every grid
FINER_WEIGHT = 9.0
POOR = 0.02  # share of the image's rms that model and image may differ by in a place that is to be believed
EVEN_WEIGHT = 10.0  # times as much an even albedo is expected, to tell what hangs on it
FINER, FINER_AZIMUTHS = 3, 64  # times as fine a grid, and azimuths, that tell how far off the model is
REFITS, REFIT_STEPS = 2, 4  # to it, and Gauss-Newton steps of each
MODEL_ERROR, PROBES = 0.01, 4  # share of the image's rms that the model may be wrong by; noises tried
SHIFTS = 33  # by which the surface goes up and down as a whole
NEAREST = 1e-3  # depth [nodes] of a surface that would lie at the viewer's plane or before it


@dataclass(frozen=True, eq=False)
class Judged:
    """The surface that is judged: z (rows, cols) [nodes of its grid] on grid ``level``, where it has at most
    SMALL nodes a side.

    limit: how far off [nodes of this grid] is worth half the confidence. coarser: how many grids this one is
    coarser than the answer's. misfit (rows, cols): mean squares of model - first image around every node of
    the answer. rivals: other answers, on this grid.
    """

    pyramid: Pyramid
    level: int
    z: np.ndarray
    limit: float
    coarser: int
    misfit: np.ndarray
    rivals: list[Rival]


def confidence_of(
    pyramid: Pyramid, level: int, z: np.ndarray, rivals: list[Rival], rivals_at: int, depth_range: float
) -> tuple[np.ndarray, np.ndarray]:
    """(confidence, other candidates (n, rows, cols) [nodes]), on the finest grid, for the surface z of grid
    ``level`` whose rivals are of grid ``rivals_at``.

    An albedo that was not known is taken for known on the way.
    """
    misfit = blurred((pyramid.problem(level).irradiances(z)[0] - pyramid.images[level][0]) ** 2)
    small, grid = z, level
    while max(small.shape) > SMALL and grid < pyramid.coarsest:
        small, misfit, grid = halved_depth(small), halved(misfit), grid + 1
    for _ in range(grid - rivals_at):
        rivals = [Rival(halved_depth(difference), weight) for difference, weight in rivals]
    limit = max(DOUBT * depth_range, LEAST_DOUBT) / 2**grid
    judged = Judged(pyramid, grid, small, limit, grid - level, misfit, rivals)
    total = np.zeros(small.shape)
    if not pyramid.albedo_known:
        total = total + by_even_albedo(judged)
        pyramid.fix_albedo(level, z)
    confidence = 1 / (1 + sum((doubt(judged) for doubt in DOUBTS), total))
    others = other_depths(pyramid, grid, small, APART * depth_range)
    while grid:
        grid -= 1
        rows, cols = pyramid.shape(grid)
        confidence = np.clip(doubled(confidence, (rows, cols)), 0, 1)
        others = others.repeat(2, 1).repeat(2, 2)[:, :rows, :cols]
    return confidence, others


def by_even_albedo(judged: Judged) -> np.ndarray:
    """How far off a more even albedo, which is not known, would be."""
    off = even_albedo_depth(judged.pyramid, judged.level, judged.z) - judged.z
    doubt: np.ndarray = (UNEVEN_WEIGHT * blurred(np.abs(off)) / judged.limit) ** 2
    return doubt


def by_rivals(judged: Judged) -> np.ndarray:
    """How far off the other answers are."""
    distances = (weight * blurred(np.abs(difference)) for difference, weight in judged.rivals)
    return sum(((off / judged.limit) ** 2 for off in distances), np.zeros(judged.z.shape))


def by_noise(judged: Judged) -> np.ndarray:
    """How far off noise could leave the surface. To the fourth power, since it is a bound: what is really off
    is ordered by the rest.
    """
    deviation = posterior_deviation(judged.pyramid, judged.level, judged.z)
    return (POSTERIOR_WEIGHT * deviation / judged.limit) ** 4


def by_finer_model(judged: Judged) -> np.ndarray:
    """How far off the answer to a finer model would be; that is about the same in nodes on every grid."""
    off = finer_model_depth(judged.pyramid, judged.level, judged.z) - judged.z
    return FINER_WEIGHT * blurred((off / 2**judged.coarser) ** 2) / judged.limit**2


def by_misfit(judged: Judged) -> np.ndarray:
    """How poorly the first image is explained, beyond its noise on the answer's grid."""
    noise = judged.pyramid.noise * 0.5 ** (judged.level - judged.coarser)
    doubt: np.ndarray = judged.misfit / (POOR * IMAGE_RMS + 3 * noise) ** 2
    return doubt


DOUBTS: tuple[Callable[[Judged], np.ndarray], ...] = (by_rivals, by_noise, by_finer_model, by_misfit)


def even_albedo_depth(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray:
    """What the depth would be if the albedo, which is not known, were held EVEN_WEIGHT times as fast to one
    that is the same everywhere.
    """
    problem = pyramid.problem(level)
    assert problem.albedo is not None, "the albedo is not known"
    problem.albedo.set_prior(pyramid.expected_albedo, EVEN_WEIGHT * PRIOR_WEIGHT)
    pyramid.set_prior(level, on_coarser_grid(z))
    other = problem.run(z, pyramid.smoothness(level), STEPS, ITERATIONS, *CLOSE, pyramid.stop)
    problem.albedo.set_prior(pyramid.expected_albedo)
    return other.depth


def finer_model_depth(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray:
    """What the depth would be if the images were of the smooth surface through the nodes of z, not of the
    nodes alone.

    A grid FINER times as fine, along more azimuths, tells by how much the model is off; the surface is
    fitted again with that put right.
    """
    problem, images = pyramid.problem(level), pyramid.images[level]
    rows, cols = z.shape
    shape = FINER * rows, FINER * cols
    repeated = np.repeat(np.repeat(pyramid.albedo[level], FINER, 0), FINER, 1)
    lights = pyramid.lights(shape, FINER * 0.5**level, FINER_AZIMUTHS)
    sent = pyramid.radiances(level)
    model = Descent(
        pyramid.engine,
        shape,
        pyramid.sides,
        [
            (light, repeated / (math.pi * scale), np.zeros(shape))
            for light, scale in zip(lights, pyramid.scales)
        ],
        np.zeros(shape),
        np.full(shape, FINER * pyramid.bounds[level][1].max()),
        radiances=sent and [np.maximum(cubic(image, FINER), 0) for image in sent],
    )
    middle, found = slice(FINER // 2, None, FINER), z
    smoothness = pyramid.smoothness(level)
    pyramid.set_prior(level, on_coarser_grid(z))
    for _ in range(REFITS):
        fine = model.irradiances(np.maximum(FINER * cubic(found, FINER), NEAREST))
        coarse = problem.irradiances(found)
        problem.set_targets(
            [image + own - other[middle, middle] for image, own, other in zip(images, coarse, fine)]
        )
        found = problem.run(found, smoothness, REFIT_STEPS, ITERATIONS, *CLOSE, pyramid.stop).depth
    problem.set_targets(images)
    return found


def posterior_deviation(pyramid: Pyramid, level: int, z: np.ndarray, seed: int = 0) -> np.ndarray:
    """Posterior standard deviation of depth at z by the linear model, in nodes of this grid: what noise as
    large as the image's own and MODEL_ERROR of the image's rms would make of it. z itself is the prior, so
    that noise alone moves it.
    """
    problem, rng = pyramid.problem(level), np.random.default_rng(seed)
    sigma = math.hypot(pyramid.noise * 0.5**level, MODEL_ERROR * IMAGE_RMS)
    total = np.zeros(z.shape)
    images = problem.irradiances(z)
    problem.set_prior(z)
    for _ in range(PROBES):
        problem.set_targets([image + sigma * rng.normal(size=z.shape) for image in images])
        problem.value(z, 0.0)
        total += problem.step(pyramid.smoothness(level), ITERATIONS, CLOSE[0]) ** 2
    problem.set_targets(pyramid.images[level])
    deviation: np.ndarray = np.sqrt(blurred(total / PROBES))
    return deviation


def other_depths(pyramid: Pyramid, level: int, z: np.ndarray, apart: float) -> np.ndarray:
    """Depths (CANDIDATES, rows, cols) [nodes of the finest grid], at least so far from z, at which a pixel
    has its value while the surface goes up or down as a whole; nan where there is none.
    """
    shifts, misfits = misfits_of_shifts(pyramid, level, z)
    crosses = (misfits[:-1] > 0) != (misfits[1:] > 0)
    share = misfits[:-1] / np.where(crosses, misfits[:-1] - misfits[1:], 1)
    shift = shifts[:-1, None, None] + share * (shifts[1] - shifts[0])
    own, low, high = z * 2**level, *(bound * 2**level for bound in pyramid.bounds[level])
    valid = crosses & (np.abs(shift) > apart) & (own + shift >= low) & (own + shift <= high)
    order = np.argsort(~valid, axis=0, kind="stable")[:CANDIDATES]
    return np.take_along_axis(np.where(valid, own + shift, np.nan), order, 0)


def misfits_of_shifts(pyramid: Pyramid, level: int, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Light of every pixel as its surface goes up and down as a whole: shifts (SHIFTS,) [nodes of the finest
    grid] and model - image of the first image (SHIFTS, rows, cols).
    """
    problem, target, (low, high) = pyramid.problem(level), pyramid.images[level][0], pyramid.bounds[level]
    shifts = np.linspace(float((low - z).min()), float((high - z).max()), SHIFTS)
    misfits = [problem.irradiances(np.maximum(z + shift, NEAREST))[0] - target for shift in shifts]
    return shifts * 2**level, np.stack(misfits)
