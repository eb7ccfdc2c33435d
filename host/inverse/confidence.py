"""Standard deviation and confidence of the recovered depth, and other depths that explain a pixel.

The variance of depth is a sum of parts: image noise, errors of the model, creases among them, and the squared
distances to other surfaces that explain the images about as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..sources import Lamp, Sky, Window
from .albedo import PRIOR_WEIGHT
from .creases import errors_at_creases
from .finer_model import Refit, refit_of
from .multigrid import CLOSE, ITERATIONS, STEPS, Multigrid
from .place import FreePlace, free_place, most_of, place_by_lights, walls_tell
from .posterior import posterior_deviation, posterior_samples, shift_by
from .pyramid import (
    MODEL_ERROR,
    NEAREST,
    NORMAL_QUARTILE,
    SMALL,
    Pyramid,
    lit,
    noise_at,
    on_coarser_grid,
    residuals_of,
)
from .resampling import blurred, distance_from, doubled, halved, halved_depth
from .search import Rival

# an error of depth up to this share of the range of depths, and at least so many nodes, counts as right; the
# confidence is a cautious estimate of the probability of that. It is below 0.5 where the standard deviation
# is above 1.48 times this error
RIGHT, LEAST_RIGHT = 1 / 64, 1.0
APART = 0.05  # least distance of a candidate from the depth, as a share of the range of depths
CANDIDATES = 2  # most other depths of a pixel
PROBE = 0.01  # noise of the posterior's probes [unit of the pyramid's images]; the posterior is linear in it
# errors of the model count as noise, besides MODEL_ERROR so many times the misfit beyond the image's noise;
# performance/doubt.py
MISFIT_WEIGHT = 2.3
# times that under one window or rectangular lamp, whose edges cast light that changes within a node. Of six
# smooth surfaces under three windows and two lamps 63 to 84 % of the true depths are then within 1 std and 88
# to 99 % within 2, with 1 36 to 53 and 65 to 88 %, with 5 80 to 96 and 95 to 99 %
EDGED = 3.0
# weights of the distances to three other surfaces: that of a finer model, those of the search, and that with
# a more even albedo; the first two by performance/doubt.py
FINER_WEIGHT, RIVAL_WEIGHT, UNEVEN_WEIGHT = 1.2, 1.0, 1.4
# that of the distance to the surface of a finer model where that is the answer, and that of the distance by
# which creases move depth. By performance/doubt.py 88, 98 and 99 % of the true depths are then within 1, 2
# and 3 std; with half of the first 87, 97 and 99 %, and fewer than 9 of 10 within 2 on a smooth surface; with
# twice 91, 98 and 99 %. With half of the second 83, 93 and 97 instead of 86, 95 and 98 % on drawn surfaces
# (16 to 47); with twice 89, 96 and 98 %, but of the other surfaces' pixels that are right within 2 nodes 18
# instead of 14 % are marked
CORRECTED_WEIGHT, CREASE_WEIGHT = 0.5, 0.5
# surfaces that are refitted from disturbed ones; weight of the rms of their distances; rms of the
# disturbances over the range of depths, under a sky and under a lamp or window. By performance/doubt.py
# --drawn 16 under a sun, with half the weight 63 instead of 80 % of the pixels that are off by more than 5
# nodes are marked; with a weight of 2.5, 13 instead of 9 % of those that are right within 2
DISTURBED, DISTURBED_WEIGHT, UNDER_SKY, UNDER_LAMP = 4, 2.0, 1 / 32, 0.3
SHALLOWER = 0.1  # quantile of depth that bounds a shallower answer at first
EVEN_WEIGHT = 10.0  # factor on the weight of an even albedo, to see how depth depends on it
LEAST_STD = 2e-3  # [nodes of the answer's grid] that float32 and the last step leave, about
SHIFTS = 33  # of the surface as a whole, up and down
UNTRUSTED = 0.5  # confidence below which a pixel is not trusted: more likely wrong than right


@dataclass(frozen=True, eq=False)
class Judged:
    """The surface that is judged: z (rows, cols) [nodes of its grid] on grid ``level``, where it has at most
    SMALL nodes a side.

    misfit (rows, cols): mean squares of model - images around every node of the answer. rivals: other
    answers, on this grid. refit: the surface by a finer model. place: what lamps leave open of the depth of
    the whole.
    """

    multigrid: Multigrid
    level: int
    z: np.ndarray
    misfit: np.ndarray
    rivals: list[Rival]
    refit: Refit
    place: FreePlace | None

    @property
    def share(self) -> float:
        """Of the way from z to the surface by the finer model, where the answer lies: 0 on a coarser grid,
        which does not have the relief of the finest.
        """
        return 0.0 if self.level else self.refit.share

    @property
    def pyramid(self) -> Pyramid:
        return self.multigrid.pyramid


class Judgement(NamedTuple):
    """std (rows, cols), the posterior standard deviation of depth, and others (n, rows, cols), other depths
    [nodes], on the finest grid. refit: the surface by a finer model, of the finest grid, or None; share: of
    the way there from the surface that is judged, where the answer lies. place: what lamps leave open of the
    depth of the whole.
    """

    std: np.ndarray
    others: np.ndarray
    refit: Refit | None
    share: float
    place: FreePlace | None


def judgement_of(
    multigrid: Multigrid, level: int, z: np.ndarray, rivals: list[Rival], rivals_at: int, depth_range: float
) -> Judgement:
    """The judgement on the surface z of grid ``level`` whose rivals are of grid ``rivals_at``.

    An albedo that was not known is taken for known on the way, after the parts that it has a share in.
    """
    pyramid = multigrid.pyramid
    place = free_place(pyramid, float(np.mean(z)) * 2**level)
    misfit = blurred(np.mean(residuals_of(pyramid, level, z) ** 2, axis=0))
    small, grid = z, level
    while max(small.shape) > SMALL and grid < pyramid.coarsest:
        small, misfit, grid = halved_depth(small), halved(misfit), grid + 1
    rivals = [Rival(halved_depth(off, grid - rivals_at), weight) for off, weight in rivals]
    variance = np.full(small.shape, (LEAST_STD / 2 ** (grid - level)) ** 2)
    if not pyramid.albedo_known:
        variance = variance + by_even_albedo(pyramid, grid, small) + by_walls(pyramid, grid, small)
    variance = variance + by_noise(pyramid, grid, small, misfit)
    if not pyramid.albedo_known:
        pyramid.fix_albedo(level, z)
    refit = refit_of(pyramid, grid, small)
    judged = Judged(multigrid, grid, small, misfit, rivals, refit, place)
    std = np.sqrt(sum((part(judged) for part in PARTS), variance))
    low, high = pyramid.bounds[grid]
    std = np.minimum(std, unknown_from(small, low, high))
    others = other_depths(pyramid, grid, small, APART * depth_range)
    for finer in range(grid - 1, -1, -1):
        rows, cols = pyramid.shape(finer)
        std = 2 * doubled(std, (rows, cols))
        others = others.repeat(2, 1).repeat(2, 2)[:, :rows, :cols]
    return Judgement(std, others, None if grid else refit, judged.share, place)


def unknown_from(z: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Deviation from z of a depth of which only its bounds are known (rows, cols)."""
    room = np.maximum(high - low, np.finfo(float).tiny)
    deviation: np.ndarray = np.sqrt(((high - z) ** 3 + (z - low) ** 3) / (3 * room))
    return deviation


def unjudged(low: np.ndarray, high: np.ndarray) -> Judgement:
    """The judgement where nothing is known: any depth between the bounds (rows, cols) is as likely."""
    return Judgement((high - low) / math.sqrt(12), np.full((CANDIDATES, *low.shape), np.nan), None, 0.0, None)


def confidence_of(std: np.ndarray, depth_range: float) -> np.ndarray:
    """A cautious estimate of the probability that depth is right, 0 to 1, from its standard deviation
    (rows, cols) [nodes].

    Right is within RIGHT of the range of depths [nodes], or within LEAST_RIGHT if that is more. It is
    1 / (1 + t^2), t the standard deviation over that of probability 1/2, if errors are normal. More depths
    are right: where it is 0.5 to 0.7, 89 % (performance/doubt.py).
    """
    half = max(RIGHT * depth_range, LEAST_RIGHT) / NORMAL_QUARTILE
    return 1 / (1 + (std / half) ** 2)


def by_noise(pyramid: Pyramid, level: int, z: np.ndarray, misfit: np.ndarray) -> np.ndarray:
    """Variance by noise, also of the albedo, where it is not known. A misfit of the images beyond their noise
    counts as noise; it is the mean of squares (rows, cols) around every node.
    """
    problem = pyramid.problem(level)
    per_noise = posterior_deviation(problem, z, pyramid.smoothness(level), PROBE) / PROBE
    problem.set_targets(pyramid.images[level])
    noise = noise_at(pyramid, level) ** 2
    beyond = MISFIT_WEIGHT**2 * np.maximum(misfit - noise, 0)
    return per_noise**2 * (noise + beyond + model_error(pyramid) ** 2)


def model_error(pyramid: Pyramid) -> float:
    """Errors of the model that count as noise [unit of the pyramid's images]."""
    light = pyramid.sources[0]
    is_edged = isinstance(light, Window) or isinstance(light, Lamp) and light.corner is not None
    return MODEL_ERROR * (EDGED if is_edged and len(pyramid.sources) == 1 else 1.0)


def by_finer_model(judged: Judged) -> np.ndarray:
    """Squared distance to the surface of a finer model: less of it where the answer lies there."""
    left = FINER_WEIGHT * (1 - judged.share), CORRECTED_WEIGHT * judged.share
    return (left[0] ** 2 + left[1] ** 2) * blurred((judged.refit.depth - judged.z) ** 2)


def by_creases(judged: Judged) -> np.ndarray:
    """Squared distance by which errors of the model at creases may move depth."""
    pyramid, level = judged.pyramid, judged.level
    answer = judged.z + judged.share * (judged.refit.depth - judged.z)
    problem = pyramid.problem(level)
    errors = errors_at_creases(problem, answer, pyramid.sides == "periodic")
    moved = shift_by(problem, answer, pyramid.smoothness(level), errors)
    problem.set_targets(pyramid.images[level])
    low, high = pyramid.bounds[level]  # depth cannot lie farther away than these are apart
    return CREASE_WEIGHT**2 * blurred(np.minimum(np.abs(moved), high - low) ** 2)


def by_place(judged: Judged) -> np.ndarray:
    """Variance of the place of the surface as a whole, where images tell little or nothing of it: every place
    that the bounds of depth allow is as likely.
    """
    pyramid, z = judged.pyramid, judged.z
    if judged.place is not None:
        moved, line = judged.place.lines(z.shape, 2.0**judged.level)
    elif pyramid.sides != "dark" and all(isinstance(light, Sky) for light in pyramid.sources):
        moved, line = np.ones(z.shape), np.zeros(z.shape, int)  # skies tell nothing of it, unless walls do
    else:
        return np.zeros(z.shape)
    low, high = pyramid.bounds[judged.level]
    up, down = (
        np.minimum(0, most_of(line, (low - z) / moved)),
        np.maximum(0, -most_of(line, (z - high) / moved)),
    )
    return blurred(moved**2 * (up**2 + up * down + down**2) / 3)


def by_gaps(judged: Judged) -> np.ndarray:
    """Squared distance by which depth may leave its smooth continuation where no image shows light, in gaps
    and in the dark: what the mean curvature of the rest makes of the distance to it, at most the relief of
    the whole. And, since few pixels tell neither, the deviation of any depth between the bounds, over the
    number of pixels that count.
    """
    known, z = lit(judged.pyramid, judged.level), judged.z
    if known.all() or not known.any():
        return np.zeros(z.shape)
    low, high = judged.pyramid.bounds[judged.level]
    untold = float(np.mean(high - low)) / math.sqrt(12) / int(known.sum())
    away = distance_from(known)
    bends = np.diff(z, 2, axis=0)[known[1:-1]], np.diff(z, 2, axis=1)[known[:, 1:-1]]
    curvature = math.sqrt(float(np.mean(np.concatenate(bends) ** 2))) if sum(map(len, bends)) else 0.0
    apart: np.ndarray = np.minimum(curvature * away**2 / 2, math.sqrt(2) * float(z.std()))
    return apart**2 + untold**2


def by_rivals(judged: Judged) -> np.ndarray:
    """Squared distance to the other surfaces of the search, each times its weight."""
    squares = ((weight * blurred(np.abs(off))) ** 2 for off, weight in judged.rivals)
    return RIVAL_WEIGHT**2 * sum(squares, np.zeros(judged.z.shape))


def by_other_answers(judged: Judged) -> np.ndarray:
    """Squared distance to other surfaces that explain the image about as well around a pixel.

    One image may have several where its light changes with direction.
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
        likeness = likeness_of(pyramid, level, misfit, other)
        variance: np.ndarray = likeness * blurred(np.abs(other - own)) ** 2
        return variance

    starts = disturbed(pyramid, level, own, UNDER_LAMP if multigrid.several else UNDER_SKY)
    variance = DISTURBED_WEIGHT**2 / DISTURBED * np.sum([variance_of(start) for start in starts], 0)
    if multigrid.several:
        variance = variance + variance_of(shallower(multigrid, level, own))
    apart: np.ndarray = 2 * doubled(np.sqrt(variance), judged.z.shape)
    return apart**2


# besides noise, and what an albedo that is not known leaves open
PARTS: tuple[Callable[[Judged], np.ndarray], ...] = (
    by_place,
    by_gaps,
    by_finer_model,
    by_creases,
    by_rivals,
    by_other_answers,
)


def by_even_albedo(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray:
    """Squared distance to the surface of a more even albedo, where the albedo is not known; of three images
    and more, which fix depth and albedo, as far as it explains them as well.
    """
    albedo, misfit = pyramid.problem(level).albedo, misfit_around(pyramid, level, z)
    assert albedo is not None, "the albedo is not known"
    albedo.set_prior(pyramid.expected_albedo, EVEN_WEIGHT * PRIOR_WEIGHT)
    other = from_start(pyramid, level, z, z)
    albedo.set_prior(pyramid.expected_albedo)
    likeness = likeness_of(pyramid, level, misfit, other) if len(pyramid.sources) > 2 else 1.0
    variance: np.ndarray = UNEVEN_WEIGHT**2 * likeness * blurred(np.abs(other - z)) ** 2
    return variance


def by_walls(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray:
    """Squared distance to the surfaces that are found from starts half-way to the bounds of depth, as far as
    they explain the images as well: where the albedo is not known, and walls alone tell how deep the surface
    lies.
    """
    ground = float(np.mean(z)) * 2**level
    if pyramid.sides != "dark" or not walls_tell(pyramid) or place_by_lights(pyramid, ground) is None:
        return np.zeros(z.shape)
    misfit = misfit_around(pyramid, level, z)

    def variance_of(bound: np.ndarray) -> np.ndarray:
        other = from_start(pyramid, level, (z + bound) / 2, z)
        variance: np.ndarray = likeness_of(pyramid, level, misfit, other) * blurred(np.abs(other - z)) ** 2
        return variance

    low, high = map(variance_of, pyramid.bounds[level])
    larger: np.ndarray = np.maximum(low, high)
    return larger


def from_start(pyramid: Pyramid, level: int, start: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The surface (rows, cols) that is found on this grid alone; its prior is the answer z."""
    pyramid.set_prior(level, on_coarser_grid(z))
    problem, smoothness = pyramid.problem(level), pyramid.smoothness(level)
    return problem.run(start, smoothness, STEPS, ITERATIONS, *CLOSE, pyramid.stop).depth


def likeness_of(pyramid: Pyramid, level: int, misfit: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How well another surface explains the images around a node (rows, cols), at most 1: that of the answer,
    whose ``misfit`` there is given.
    """
    likeness: np.ndarray = np.minimum(1, misfit / misfit_around(pyramid, level, other))
    return likeness


def refitted(multigrid: Multigrid, level: int, start: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The answer on this grid from ``start``; its prior is the answer z, on the next coarser grid."""
    multigrid.pyramid.set_prior(level, on_coarser_grid(z))
    return multigrid.relax(level, start, ()).depth


def misfit_around(pyramid: Pyramid, level: int, z: np.ndarray) -> np.ndarray:
    """Mean squares of model - image around every node, plus those of noise and of the least model error."""
    squares = np.mean(residuals_of(pyramid, level, z) ** 2, axis=0)
    least: float = model_error(pyramid) ** 2 + noise_at(pyramid, level) ** 2
    return blurred(squares, 3) + least


def disturbed(pyramid: Pyramid, level: int, z: np.ndarray, share: float) -> list[np.ndarray]:
    """Surfaces that differ from z by samples of its posterior, their rms this share of the range of depths.

    They differ most where the image constrains depth least.
    """
    problem, (low, high) = pyramid.problem(level), pyramid.bounds[level]
    samples = list(posterior_samples(problem, z, pyramid.smoothness(level), PROBE, DISTURBED))
    problem.set_targets(pyramid.images[level])
    rms = share * float(np.mean(high - low))
    return [z + rms / math.sqrt(float(np.mean(sample**2)) + LEAST_STD**2) * sample for sample in samples]


def shallower(multigrid: Multigrid, level: int, z: np.ndarray) -> np.ndarray:
    """A surface on this grid, solved from the coarsest grid on with depth bounded by a low quantile of z.

    Under a spotlight, pixels far from its axis have two depths, and a search from smooth surfaces leads to
    the deeper one.
    """
    pyramid = multigrid.pyramid
    with pyramid.no_deeper_than(float(np.quantile(z, SHALLOWER)), level):
        low, high = pyramid.bounds[pyramid.coarsest]
        return multigrid.solve((low + high) / 2, pyramid.coarsest, level, accept=False).depth


def other_depths(pyramid: Pyramid, level: int, z: np.ndarray, apart: float) -> np.ndarray:
    """Depths (CANDIDATES, rows, cols) [nodes of the finest grid], at least so far from z, at which a pixel
    has its values, of all images in the same step, while the surface goes up or down as a whole; nan where
    there is none.
    """
    problem, images, (low, high) = pyramid.problem(level), pyramid.images[level], pyramid.bounds[level]
    shifts = np.linspace(float((low - z).min()), float((high - z).max()), SHIFTS)
    off = [np.stack(problem.irradiances(np.maximum(z + shift, NEAREST))) - images for shift in shifts]
    shifts, misfits = shifts * 2**level, np.stack(off, axis=1)  # (images, SHIFTS, rows, cols)
    crosses = ((misfits[:, :-1] > 0) != (misfits[:, 1:] > 0)).all(0)
    share = (misfits[:, :-1] / np.where(crosses, misfits[:, :-1] - misfits[:, 1:], 1)).mean(0)
    shift = shifts[:-1, None, None] + share * (shifts[1] - shifts[0])
    own, low, high = (depth * 2**level for depth in (z, low, high))
    valid = crosses & (np.abs(shift) > apart) & (own + shift >= low) & (own + shift <= high)
    order = np.argsort(~valid, axis=0, kind="stable")[:CANDIDATES]
    return np.take_along_axis(np.where(valid, own + shift, np.nan), order, 0)
