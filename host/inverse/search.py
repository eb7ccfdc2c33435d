"""The search for the surface that explains the images: the stages of recover(method="robust") between its
checks and its confidence, in order.

Different starts are right in different places: where none of their surfaces is good, a mosaic takes each
place from the one that is best there. Large images begin on a grid that sees their relief. They begin on the
coarsest grid, as small ones do, only if their relief is too strong to be found from there.

With light between surfaces, starts from flat surfaces often end in a wrong surface. That search goes on from
the answer by direct light.

What remains wrong is often one peak that is taken for a pit, or a ridge for a furrow. So the relief of the
answer is mirrored, at two sizes, and is another start.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .descent import Solution, bounced
from .multigrid import FROM_COARSER, Multigrid
from .pyramid import SMALL, Pyramid, on_coarser_grid, residuals_of, without, without_gaps
from .resampling import blurred, halved_depth

FLATS = 40  # flat surfaces between the bounds that are compared
TIED = 1e-4  # of the objective: flat surfaces that differ by less explain the images alike
# [nodes] of the standard deviation of relief by which it is seen whether a relief and its mirror image look
# alike; and the least ratio of what they have in common to what they differ by. Measured at 18 images of six
# surfaces: 1.2 to 3.2 under a uniform sky, 3.5 to 8.3 overcast, 0.15 to 0.31 under a wide sun, 0.02 to 0.08
# under a sky that is brighter on one side
SLIGHT, EVEN = 0.05, 0.6
# [nodes] of the standard deviation of the reliefs that the search starts from under such a sky. Chosen: the
# mean correlation with 24 surfaces of 32 x 32, sides open, is 0.66, and 0.69 with 24 others; with half of
# these 0.49 and 0.72, with twice 0.64 and 0.73, with 0.25 alone 0.42
RELIEFS = 0.5, 2.0, -1.0
LEAST_CONTRAST = (
    1e-6  # standard deviation [unit of the pyramid's images] below which float32 makes an image even
)
LOST = 100.0  # times the objective of a good surface: above it strong relief is looked for
FOUND = 16.0  # times the objective of a good surface: below it that search ends
# depths of the flat surfaces that the search for strong relief starts from, as shares of that of the best
SHALLOW_STARTS = (1.0, 0.85, 0.7, 0.5, 0.35)
BETTER = 0.5  # share of the objective below which another start is believed instead of the first
CLEARLY = 0.9  # the same when answers are compared, where one is expected
CONFINED = (0.9, 0.75)  # quantiles of the first answer's depth that bound the other answers
ALIKE = 0.05  # rms distance [nodes] below which two surfaces are one answer
FOLLOWED = 8.0  # times the first answer's objective on a coarser grid: other starts above it are given up
# blurs of the surfaces round which relief is mirrored, standard deviations of 2 and 4 nodes, and the most
# rounds of it. Chosen: of 45 images (tests/surfaces.py, 32 x 32, sky, sun and lamp) two have a smaller RMSE
# with these blurs, one with half or twice as wide ones, and none a larger one
MIRRORED, MIRROR_ROUNDS = (3, 12), 3
LEAST_MISFIT = 1e-12  # of a neighbourhood, where the weights of a mosaic would divide by zero
RIVAL = 6.0  # times the objective of the answer: other surfaces above it are no rivals
# in which light between surfaces is taken from the images: before and after a mosaic, and after refinement to
# the finest grid
ROUNDS, FINEST_ROUNDS = 4, 1
# most rivals of the answer by direct light that are starts too, and the objective, times that of a good
# surface, above which they are. Chosen: of an egg-crate (32 x 32, sky) it is 3.5 in right answers and 6.6 to
# 7.8 in those that are 1.9 to 2.4 nodes off; in ripples and folds (64 x 64), which stay wrong, 4 to 9
OTHER_DIRECT, POOR = 2, 4.0


class OutOfTime(Exception):
    """The time limit max_seconds has passed."""


class Rival(NamedTuple):
    """Another answer: its difference from the one that is given (rows, cols) [nodes of its grid], and its
    weight, 1 if it explains the images as well.
    """

    difference: np.ndarray
    weight: float


class Search:
    """The state of the search from stage to stage.

    share: of the way between the bounds of depth, where the best flat surface lies. even: whether light tells
    no flat surface from another, nor slight relief from its mirror image. answers: on grid
    ``level``; the first is believed unless another one is clearly better. begun: the surface that it began
    with, and that surface's grid. rivals: of the answer, on grid ``comparing``. ``direct``: the search by
    direct light that this one, with light between surfaces, goes on from.
    """

    def __init__(self, multigrid: Multigrid, direct: Search | None = None):
        pyramid = multigrid.pyramid
        self.multigrid, self.pyramid, self.direct = multigrid, pyramid, direct
        self.comparing = 0 if pyramid.is_small(0) else pyramid.start
        self.level = max(self.comparing, pyramid.start - 1)
        self.share = 0.5
        self.even: bool = direct is not None and direct.even
        self.begun = self.flat(self.share, pyramid.start), pyramid.start
        self.answers: list[Solution] = []
        self.rivals: list[Rival] = [] if direct is None else direct.rivals.copy()

    def run(self) -> None:
        """All stages. Leaves the answer, and what was best on the way, in ``pyramid.best``.

        Raises OutOfTime.
        """
        for stage in STAGES if self.direct is None else STAGES_BETWEEN:
            stage(self)
            self.check_time()

    def check_time(self) -> None:
        """Raises OutOfTime; the best surface so far may be of a coarser grid."""
        if self.pyramid.stop():
            raise OutOfTime

    def rivals_of(self, level: int, z: np.ndarray) -> list[Rival]:
        """The rivals of the answer z on grid ``level``, which may be that of a search that was cut short.

        Where flat surfaces are stationary, many reliefs look alike: one as strong as the answer's that has
        nothing in common with it is a rival too.
        """
        if not self.even:
            return self.rivals
        apart = math.sqrt(2) * float(z.std()) * 2.0 ** (level - self.comparing)
        return [*self.rivals, Rival(np.full(self.pyramid.shape(self.comparing), apart), 1.0)]

    def flat(self, share: float, level: int) -> np.ndarray:
        """The flat surface at this share of the way between the bounds."""
        low, high = self.pyramid.bounds[level]
        z: np.ndarray = low + share * (high - low)
        return z


def start_flat(search: Search) -> None:
    """From the flat surface that explains the images best on the coarsest grid; from the middle of the bounds
    if all explain them alike, as they do under skies unless the sides are dark.
    """
    pyramid, coarsest = search.pyramid, search.pyramid.coarsest
    problem, shares, values = pyramid.problem(coarsest), _shares(pyramid), list[float]()
    # from the middle on: where time ends on the way, the best so far is none at the bounds
    shares = shares[np.argsort(np.abs(shares - 0.5), kind="stable")]
    for share in shares:
        values.append(problem.value(search.flat(share, coarsest), 0))
        if pyramid.stop():
            break
    if np.ptp(values) <= TIED * min(values):
        search.even = _is_even(search)
    else:
        search.share = float(shares[np.argmin(values)])
    search.begun = search.flat(search.share, pyramid.start), pyramid.start
    if not search.even:
        search.answers = [search.multigrid.solve(*search.begun, search.level)]


def _shares(pyramid: Pyramid) -> np.ndarray:
    """Of the way between the bounds, where flat surfaces are compared: evenly, and, where these lie deeper
    than the image is wide, as many above them at even ratios.
    """
    (low, high), even = pyramid.bounds[0], (np.arange(FLATS) + 0.5) / FLATS
    wide, deep = max(pyramid.shape(0)), float(np.mean(high - low))
    if even[0] * deep <= wide:
        return even
    return np.concatenate([np.geomspace(wide / (2 * FLATS * deep), even[0], FLATS, endpoint=False), even])


def _is_even(search: Search) -> bool:
    """Whether slight relief and its mirror image look alike: flat surfaces are then stationary points."""
    problem, flat = search.pyramid.problem(search.pyramid.start), search.begun[0]
    relief = SLIGHT * _darkness(search)
    up, level, down = (problem.irradiances(flat + part) for part in (-relief, 0 * relief, relief))
    odd = sum(float(np.var(u - d, dtype=np.float64)) for u, d in zip(up, down))
    even = sum(float(np.var(u - 2 * f + d, dtype=np.float64)) for u, f, d in zip(up, level, down))
    return even > EVEN**2 * odd


def _darkness(search: Search) -> np.ndarray:
    """How dark the images are, where the search begins: mean 0, standard deviation 1, or 0 of even images."""
    dark = np.zeros(search.pyramid.shape(search.pyramid.start))
    for image in search.pyramid.seen[search.pyramid.start]:
        dark -= (image - image.mean()) / max(float(image.std()), LEAST_CONTRAST)
    dark /= max(float(dark.std()), LEAST_CONTRAST)
    return dark


def start_relief(search: Search) -> None:
    """From reliefs that are deeper, or higher, where the images are darker, if flat surfaces are stationary:
    the best of these answers is the first.
    """
    if not search.even:
        return
    (flat, grid), dark = search.begun, _darkness(search)
    tried: list[tuple[Solution, np.ndarray]] = []
    for height in RELIEFS:
        start = np.clip(flat + height * dark, *search.pyramid.bounds[grid])
        # the first is the answer so far
        tried.append((search.multigrid.solve(start, grid, search.level, accept=not tried), start))
        search.check_time()
    tried.sort(key=lambda one: one[0].objective)
    search.answers, search.begun = [answer for answer, _ in tried], (tried[0][1], grid)
    search.pyramid.accept(search.level, search.answers[0].depth)


def start_stronger(search: Search) -> None:
    """From shallower flat surfaces on the coarsest grid, if the first answer is far from the images.

    Strong relief shades itself so much that the flat surface nearest to the images is far too deep to start
    from.
    """
    pyramid, coarsest, first = search.pyramid, search.pyramid.coarsest, search.answers[0]
    if first.objective <= LOST * pyramid.good_objective(search.level):
        return
    levels = range(search.level, coarsest)
    cheap = next((n for n in levels if pyramid.images[n][0].size <= SMALL**2), coarsest)
    tried = []
    for part in SHALLOW_STARTS:
        flat = search.flat(part * search.share, coarsest)
        tried.append((search.multigrid.solve(flat, coarsest, cheap, accept=False), flat))
        search.check_time()
        if tried[-1][0].objective < FOUND * pyramid.good_objective(cheap):
            break
    best, flat = min(tried, key=lambda one: one[0].objective)
    if search.level < cheap:
        best = search.multigrid.refine(best.depth, cheap, search.level, accept=False)
    if best.objective < BETTER * first.objective:
        pyramid.accept(search.level, best.depth)
        search.answers, search.begun = [best], (flat, coarsest)


def start_direct(search: Search) -> None:
    """From the answer by direct light, round by round: what the present surface sends to itself is taken from
    the images, and direct light explains the rest. The surface of each round is a start with all light; the
    best of these answers is the answer. What rivals the answer by direct light also rivals this one.
    """
    direct, level = search.direct, search.level
    assert direct is not None and direct.pyramid.best is not None, "there is no answer by direct light"
    grid, z = direct.pyramid.best
    z = halved_depth(z, level - grid)
    first = _after_rounds(search, direct, level, z, [], ROUNDS)
    best = _after_rounds(search, direct, level, first.depth, [first], ROUNDS)
    for rival in sorted(direct.rivals, key=lambda one: -one.weight)[:OTHER_DIRECT]:
        if best.objective <= POOR * search.pyramid.good_objective(level):
            break
        difference = halved_depth(rival.difference, level - direct.comparing)
        best = _after_rounds(search, direct, level, z + difference, [best], ROUNDS)
    search.pyramid.accept(level, best.depth)
    if search.comparing < level:
        best = search.multigrid.refine(best.depth, level, search.comparing)
        rounds = ROUNDS if search.comparing else FINEST_ROUNDS
        best = _after_rounds(search, direct, search.comparing, best.depth, [best], rounds)
    search.answers, search.level = [best], search.comparing


def _after_rounds(
    search: Search, direct: Search, level: int, z: np.ndarray, answers: list[Solution], rounds: int
) -> Solution:
    """The best of these answers, of those after each round from z, and of the mosaic of all that differ.
    Rounds end with an answer that was found before.
    """
    answers, again = list(answers), False
    while rounds and not again:
        direct.pyramid.set_prior(level, on_coarser_grid(z))
        with without(direct.pyramid, bounced(search.pyramid.problem(level), z), level):
            z = direct.multigrid.settle(level, z).depth
        search.pyramid.set_prior(level, on_coarser_grid(z))
        answer = search.multigrid.settle(level, z)
        search.check_time()
        rounds, again = rounds - 1, _is_among(answers, answer)
        answers.append(answer)
    if len(answers) > 1 + again:
        answers.append(_of_mosaic(search, level, answers))
    return _best(answers)


def start_filled(search: Search) -> None:
    """From the answer to the images with their gaps filled, if they have gaps: this answer is the first then.
    Otherwise ground that no image shows may hide light from what they show, and be anything.
    """
    pyramid = search.pyramid
    if pyramid.has_gaps:
        filled = Multigrid(without_gaps(pyramid), search.multigrid.several)
        z = filled.solve(*search.begun, search.level, accept=False).depth
        search.answers.insert(0, search.multigrid.relax(search.level, z, ()))
        pyramid.accept(search.level, search.answers[0].depth)


def start_shallower(search: Search) -> None:
    """From the same surface, with depth bounded by a quantile of the first answer's, in turn by each of
    CONFINED: the shallower answer, where there are several.
    """
    for share in CONFINED:
        other = _confined(search, float(np.quantile(search.answers[0].depth, share)))
        search.check_time()
        if not _is_among(search.answers, other):
            search.answers.append(other)


def _confined(search: Search, deepest: float) -> Solution:
    """With no depth beyond ``deepest`` [nodes of the answers' grid] until the end."""
    pyramid, level = search.pyramid, search.level
    with pyramid.no_deeper_than(deepest, level):
        z = search.multigrid.solve(*search.begun, level, accept=False).depth
    return Solution(z, math.inf) if pyramid.stop() else search.multigrid.relax(level, z, ())


def join(search: Search) -> None:
    """From the mosaic of all answers, if there are several and none is good: another answer.

    The mosaic takes each place from the answer whose image is best round it.
    """
    if len(search.answers) > 1:
        if _best(search.answers).objective > search.pyramid.good_objective(search.level):
            search.answers.append(_of_mosaic(search, search.level, search.answers))


def _of_mosaic(search: Search, level: int, answers: list[Solution]) -> Solution:
    pyramid = search.pyramid
    misfits = []
    for answer in answers:
        squares = residuals_of(pyramid, level, answer.depth) ** 2
        misfits.append(blurred(np.sum(squares, 0), 2) + LEAST_MISFIT)
    least = np.min(misfits, 0)
    shares = [blurred((least / misfit) ** 2) for misfit in misfits]
    mosaic = np.sum([share * answer.depth for share, answer in zip(shares, answers)], 0) / np.sum(shares, 0)
    pyramid.set_prior(level, on_coarser_grid(mosaic))
    return search.multigrid.relax(level, mosaic, FROM_COARSER)


def compare(search: Search) -> None:
    """Brings the answers to the grid where they are compared, but for those above FOLLOWED; joins them."""
    level, (first, *others) = search.level, search.answers
    if search.comparing == level:
        return
    refine, search.level = search.multigrid.refine, search.comparing
    followed = FOLLOWED * max(first.objective, search.pyramid.good_objective(level))
    search.answers = [refine(first.depth, level, search.level)]
    for other in others:
        search.check_time()
        if other.objective < followed:
            search.answers.append(refine(other.depth, level, search.level, accept=False))
    search.check_time()  # an answer that was cut is of a coarser grid
    join(search)


def start_mirrored(search: Search) -> None:
    """From the best answer with its relief mirrored, concave for convex: again while that explains the images
    clearly better.
    """
    for _ in range(MIRROR_ROUNDS):
        best = _best(search.answers)
        for times in MIRRORED:
            start = 2 * blurred(best.depth, times) - best.depth
            search.pyramid.set_prior(search.level, on_coarser_grid(start))
            search.answers.append(search.multigrid.settle(search.level, start))
            search.check_time()
        join(search)
        if _best(search.answers).objective > CLEARLY * best.objective:
            break


def choose(search: Search) -> None:
    """The first answer, unless another one explains the images clearly better; the rest are its rivals."""
    first, best = search.answers[0], _best(search.answers)
    # whether a lower objective may be of a wrong answer
    doubted = search.multigrid.several or search.pyramid.has_gaps
    answer = best if best.objective < (BETTER if doubted else CLEARLY) * first.objective else first
    power = 1 if search.multigrid.several else 2
    search.rivals += [
        Rival(other.depth - answer.depth, min(1, answer.objective / other.objective) ** power)
        for other in search.answers
        if other is not answer and other.objective < RIVAL * answer.objective
    ]
    search.answers = [answer]


def polish(search: Search) -> None:
    """Solves for the answer on its grid to the last accuracy."""
    search.answers = [search.multigrid.polish(search.level, search.answers[0].depth)]


def refine(search: Search) -> None:
    """Brings the answer to the finest grid."""
    if search.level:
        search.answers = [search.multigrid.refine(search.answers[0].depth, search.level, 0)]
        search.level = 0


STAGES: tuple[Callable[[Search], None], ...] = (
    start_flat,
    start_relief,
    start_stronger,
    start_filled,
    start_shallower,
    join,
    compare,
    start_mirrored,
    choose,
    polish,
    refine,
)
STAGES_BETWEEN: tuple[Callable[[Search], None], ...] = (start_direct, start_mirrored, choose, polish, refine)


def _best(answers: list[Solution]) -> Solution:
    return min(answers, key=lambda answer: answer.objective)


def _is_among(answers: list[Solution], other: Solution) -> bool:
    """Whether it is about the surface of one of these answers."""
    return any(np.sqrt(np.mean((other.depth - answer.depth) ** 2)) <= ALIKE for answer in answers)
