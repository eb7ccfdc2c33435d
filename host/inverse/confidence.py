"""How far off the depth that was found may be, how far it is to be trusted, and which other depths explain a
pixel.

The variance of depth is a sum of parts: what noise leaves undecided, what the model does not represent, and
how far off the answers are that explain the images about as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .albedo import PRIOR_WEIGHT
from .descent import Descent
from .multigrid import CLOSE, ITERATIONS, STEPS, Multigrid
from .posterior import posterior_deviation, posterior_samples
from .pyramid import NORMAL_QUARTILE, SMALL, Pyramid, on_coarser_grid
from .resampling import blurred, cubic, doubled, halved, halved_depth
from .search import Rival

# of the range of depths, and nodes at least: an error up to this is right, and the confidence is about how
# likely that is. Below 0.5 the standard deviation is above 1.48 times this
RIGHT, LEAST_RIGHT = 1 / 64, 1.0
APART = 0.05  # of the range of depths, from which another depth is a candidate
CANDIDATES = 2  # other depths of a pixel, at most
PROBE = 0.01  # noise of the probes of the posterior, which is linear in it [unit of the pyramid's images]
# noise that the model's errors count as, at least [unit of the pyramid's images], and times what the misfit
# has beyond the image's noise
MODEL_ERROR, MISFIT_WEIGHT = 5e-4, 2.3
# of the distances to the answer of a finer model, to the answers of the search and to the one with a more
# even albedo. The first two, and the two above, as performance/doubt.py tells
FINER_WEIGHT, RIVAL_WEIGHT, UNEVEN_WEIGHT = 1.2, 1.0, 1.4
# answers that are refitted from disturbed ones, and the weight of the rms of their distances; rms of the
# disturbances, over the range of depths: under a sky, and under a lamp or window. performance/doubt.py
# --drawn 16 under a sun: of pixels off by more than 5 nodes, half the weight marks 63 instead of 80 %; of
# those right within 2, a weight of 2.5 marks 13 instead of 9 %
DISTURBED, DISTURBED_WEIGHT, UNDER_SKY, UNDER_LAMP = 4, 2.0, 1 / 32, 0.3
SHALLOWER = 0.1  # share of the pixels whose depth a shallower answer is first confined to
EVEN_WEIGHT = 10.0  # times as much an even albedo is expected, to tell what hangs on it
FINER, FINER_AZIMUTHS = 3, 64  # times as fine a grid, and azimuths, that tell how far off the model is
REFITS, REFIT_STEPS = 2, 4  # to it, and Gauss-Newton steps of each
LEAST_STD = 2e-3  # [nodes of the answer's grid] what float32 and the end of the steps leave, about
SHIFTS = 33  # by which the surface goes up and down as a whole
NEAREST = 1e-3  # depth [nodes] of a surface that would lie at the viewer's plane or before it


@dataclass(frozen=True, eq=False)
class Judged:
    """The surface that is judged: z (rows, cols) [nodes of its grid] on grid ``level``, where it has at most
    SMALL nodes a side.

    misfit (rows, cols): mean squares of model - first image around every node of the answer, which is
    ``coarser`` grids finer. rivals: other answers, on this grid.
    """

    multigrid: Multigrid
    level: int
    z: np.ndarray
    coarser: int
    misfit: np.ndarray
    rivals: list[Rival]

    @property
    def pyramid(self) -> Pyramid:
        return self.multigrid.pyramid


def deviation_of(
    multigrid: Multigrid, level: int, z: np.ndarray, rivals: list[Rival], rivals_at: int, depth_range: float
) -> tuple[np.ndarray, np.ndarray]:
    """(posterior standard deviation (rows, cols), other candidates (n, rows, cols)) [nodes] of depth, on the
    finest grid, for the surface z of grid ``level`` whose rivals are of grid ``rivals_at``.

    An albedo that was not known is taken for known on the way.
    """
    pyramid = multigrid.pyramid
    misfit = blurred((pyramid.problem(level).irradiances(z)[0] - pyramid.images[level][0]) ** 2)
    small, grid = z, level
    while max(small.shape) > SMALL and grid < pyramid.coarsest:
        small, misfit, grid = halved_depth(small), halved(misfit), grid + 1
    for _ in range(grid - rivals_at):
        rivals = [Rival(halved_depth(difference), weight) for difference, weight in rivals]
    judged = Judged(multigrid, grid, small, grid - level, misfit, rivals)
    variance = np.full(small.shape, (LEAST_STD / 2 ** (grid - level)) ** 2)
    if not pyramid.albedo_known:
        variance = variance + by_even_albedo(judged)
        pyramid.fix_albedo(level, z)
    std = np.sqrt(sum((part(judged) for part in PARTS), variance))
    others = other_depths(pyramid, grid, small, APART * depth_range)
    while grid:
        grid -= 1
        rows, cols = pyramid.shape(grid)
        std = 2 * doubled(std, (rows, cols))
        others = others.repeat(2, 1).repeat(2, 2)[:, :rows, :cols]
    return std, others


def confidence_of(std: np.ndarray, depth_range: float) -> np.ndarray:
    """About how likely it is that depth is right, 0 to 1, where this is its standard deviation (rows, cols)
    [nodes]: within RIGHT of the range [nodes] between the bounds, and at least LEAST_RIGHT.

    1 / (1 + t^2), t the std over what makes it 1/2. By this 69, 90 and 95 % of errors are within 1, 2 and 3
    std; 68, 95 and 99.7 % of normal ones are, and 79, 95 and 98 % in performance/doubt.py.
    """
    half = max(RIGHT * depth_range, LEAST_RIGHT) / NORMAL_QUARTILE
    confidence: np.ndarray = 1 / (1 + (std / half) ** 2)
    return confidence


def by_noise(judged: Judged) -> np.ndarray:
    """What noise leaves undecided; that the first image is explained worse than by its noise counts as more
    of it.
    """
    pyramid, level = judged.pyramid, judged.level
    unit = posterior_deviation(pyramid.problem(level), judged.z, pyramid.smoothness(level), PROBE) / PROBE
    pyramid.problem(level).set_targets(pyramid.images[level])
    noise = (pyramid.noise * 0.5**level) ** 2
    beyond = MISFIT_WEIGHT**2 * np.maximum(judged.misfit - noise, 0)
    variance: np.ndarray = unit**2 * (noise + beyond + MODEL_ERROR**2)
    return variance


def by_finer_model(judged: Judged) -> np.ndarray:
    """How far off the answer to a finer model would be."""
    off = finer_model_depth(judged.pyramid, judged.level, judged.z) - judged.z
    return FINER_WEIGHT**2 * blurred(off**2)


def by_rivals(judged: Judged) -> np.ndarray:
    """How far off the other answers of the search are."""
    return RIVAL_WEIGHT**2 * _apart(judged.rivals, judged.z.shape)


def by_other_answers(judged: Judged) -> np.ndarray:
    """How far off other answers are that explain the image about as well around a pixel, where one image may
    have several: where light changes with direction.
    """
    pyramid, level = judged.pyramid, judged.level + 1
    if (
        len(pyramid.sources) > 1
        or not callable(pyramid.sources[0].brightness)
        or level > pyramid.coarsest
        or pyramid.stop()
    ):
        return np.zeros(judged.z.shape)
    multigrid, z = judged.multigrid, halved_depth(judged.z)
    own = refitted(multigrid, level, z, z)
    misfit = misfit_around(pyramid, level, own)

    def variance_of(start: np.ndarray) -> np.ndarray:
        other = refitted(multigrid, level, start, own)
        likeness = np.minimum(1, misfit / misfit_around(pyramid, level, other))
        variance: np.ndarray = likeness * blurred(np.abs(other - own)) ** 2
        return variance

    starts = disturbed(pyramid, level, own, UNDER_LAMP if multigrid.several else UNDER_SKY)
    variance = DISTURBED_WEIGHT**2 / DISTURBED * np.sum([variance_of(start) for start in starts], 0)
    if multigrid.several:
        variance = variance + variance_of(shallower(multigrid, level, own))
    apart: np.ndarray = 2 * doubled(np.sqrt(variance), judged.z.shape)
    return apart**2


PARTS: tuple[Callable[[Judged], np.ndarray], ...] = (
    by_noise,
    by_finer_model,
    by_rivals,
    by_other_answers,
)


def _apart(rivals: list[Rival], shape: tuple[int, ...]) -> np.ndarray:
    """The sum of the squared distances to other answers, each times its weight."""
    return sum(((weight * blurred(np.abs(off))) ** 2 for off, weight in rivals), np.zeros(shape))


def by_even_albedo(judged: Judged) -> np.ndarray:
    """How far off a more even albedo, which is not known, would be."""
    off = even_albedo_depth(judged.pyramid, judged.level, judged.z) - judged.z
    variance: np.ndarray = (UNEVEN_WEIGHT * blurred(np.abs(off))) ** 2
    return variance


def refitted(multigrid: Multigrid, level: int, start: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The answer on this grid from ``start``; its prior is the answer z, on the next coarser grid."""
    multigrid.pyramid.set_prior(level, on_coarser_grid(z))
    return multigrid.relax(level, start, ()).depth


def misfit_around(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray:
    """Mean squares of model - image around every node, and of what they hold in any case."""
    squares = (pyramid.problem(level).irradiances(z)[0] - pyramid.images[level][0]) ** 2
    least: float = MODEL_ERROR**2 + (pyramid.noise * 0.5**level) ** 2
    return blurred(blurred(blurred(squares))) + least


def disturbed(pyramid: Pyramid, level: int, z: np.ndarray, share: float) -> list[np.ndarray]:
    """Surfaces that differ from z by samples of its posterior, scaled to an rms that is this share of the
    range of depths: most where the image tells least.
    """
    problem, (low, high) = pyramid.problem(level), pyramid.bounds[level]
    samples = list(posterior_samples(problem, z, pyramid.smoothness(level), PROBE, DISTURBED))
    problem.set_targets(pyramid.images[level])
    rms = share * float(np.mean(high - low))
    return [z + rms / math.sqrt(float(np.mean(sample**2)) + LEAST_STD**2) * sample for sample in samples]


def shallower(multigrid: Multigrid, level: int, z: np.ndarray) -> np.ndarray:
    """A surface on this grid that began shallower than z, within a closer bound of depth and from the
    coarsest grid: under a spotlight, pixels far from its axis have two depths, and the smooth surfaces that a
    search begins with lead to the deeper one.
    """
    pyramid = multigrid.pyramid
    with pyramid.no_deeper_than(float(np.quantile(z, SHALLOWER)), level):
        low, high = pyramid.bounds[pyramid.coarsest]
        return multigrid.solve((low + high) / 2, pyramid.coarsest, level, accept=False).depth


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
    middle, depth = slice(FINER // 2, None, FINER), z
    smoothness = pyramid.smoothness(level)
    pyramid.set_prior(level, on_coarser_grid(z))
    for _ in range(REFITS):
        fine = model.irradiances(np.maximum(FINER * cubic(depth, FINER), NEAREST))
        coarse = problem.irradiances(depth)
        problem.set_targets(
            [image + own - other[middle, middle] for image, own, other in zip(images, coarse, fine)]
        )
        depth = problem.run(depth, smoothness, REFIT_STEPS, ITERATIONS, *CLOSE, pyramid.stop).depth
    problem.set_targets(images)
    return depth


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
