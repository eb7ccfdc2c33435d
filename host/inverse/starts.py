"""Starting surfaces: flat ones, shallower ones, and mosaics of what they lead to.

Different starts are right in different places: if none of their surfaces is good, a mosaic takes each place
from the one that is best there. Large images begin on a grid that sees their relief. They begin on the
coarsest grid, as small ones do, only if their relief is too strong to be found from there.
"""

from __future__ import annotations

import math

import numpy as np

from .descent import Solution
from .multigrid import FROM_COARSER, FROM_STIFF, START_STEPS, Multigrid
from .pyramid import SMALL, on_coarser_grid
from .resampling import blurred

FLATS = 40  # flat surfaces between the bounds that are compared
SHADING_GAINS, GAIN_STEP = (0.9, 0.8, 0.65), 0.05  # tried for what a coarse grid does not see; about the best
BETTER = 0.5  # share of the objective below which another start is believed instead of the first
FOUND = 16.0  # times the objective of a good surface, below which strong relief is found
# for strong relief: shares of the depth of the best flat surface, and shading gains
SHALLOW_STARTS = ((1, 0.5), (1, 1), (0.7, 0.8), (0.35, 0.8))
CONFINED = (0.9, 0.75)  # shares of the pixels whose depth the first answer leaves to the others
ALIKE = 0.05  # nodes (rms) between surfaces that are one answer
LEAST_RANGE = 0.5  # nodes between the bounds of depth
LEAST_MISFIT = 1e-12  # of a neighbourhood, where the weights of a mosaic would divide by zero


class OutOfTime(Exception):
    """max_seconds are over."""


class Starts:
    """Finds surfaces from several starts, on grid ``last``: where they are sorted out."""

    def __init__(self, multigrid: Multigrid, last: int):
        self.multigrid, self.pyramid, self.last = multigrid, multigrid.pyramid, last

    def check_time(self) -> None:
        """Raises OutOfTime; what was found until then may be of a coarser grid."""
        if self.pyramid.stop():
            raise OutOfTime

    def nearest_flat(self) -> float:
        """The share of the way between the bounds of the flat surface that explains the images best on the
        coarsest grid.
        """
        problem = self.pyramid.problem(self.pyramid.coarsest)
        shares, (low, high) = (np.arange(FLATS) + 0.5) / FLATS, self.pyramid.bounds[self.pyramid.coarsest]
        return float(shares[np.argmin([problem.value(low + share * (high - low), 0) for share in shares])])

    def flat(self, share: float, level: int) -> np.ndarray:
        low, high = self.pyramid.bounds[level]
        z: np.ndarray = low + share * (high - low)
        return z

    def find_shading_gain(self, z: np.ndarray) -> None:
        """Looks for the gain that lets the coarsest grid explain the images best, starting from z, and
        divides the targets of all coarse grids by theirs.

        A box of nodes whose fine relief shades itself is darker than its mean surface; without a gain, coarse
        grids would go deeper for it. A gain other than 1 is believed if the objective falls below BETTER of
        that without.
        """
        coarsest = self.pyramid.coarsest
        if not coarsest or not self.pyramid.albedo_known:  # then the albedo makes up for it
            return
        problem, images = self.pyramid.problem(coarsest), self.pyramid.images[coarsest]

        def reached(gain: float) -> float:
            problem.set_targets([image / gain for image in images])
            return self.multigrid.relax(coarsest, z, FROM_STIFF, START_STEPS).objective

        values = {gain: reached(gain) for gain in (1.0, *SHADING_GAINS)}
        best = min(values, key=lambda gain: values[gain])
        if best < 1:
            values |= {gain: reached(gain) for gain in (best - GAIN_STEP, best + GAIN_STEP)}
            best = min(values, key=lambda gain: values[gain])
        self.pyramid.set_shading_gain(best if values[best] < BETTER * values[1.0] else 1.0, 0)

    def around(self, first: Solution, begun: np.ndarray, level: int) -> list[Solution]:
        """This answer, which began with that surface on that grid; shallower answers that begin there; and
        the mosaic of all.
        """
        answers = [first]
        for share in CONFINED:
            other = self.confined(float(np.quantile(first.depth, share)), begun, level)
            self.check_time()
            if all(_distance(other.depth, answer.depth) > ALIKE for answer in answers):
                answers.append(other)
        self.add_mosaic(self.last, answers)
        return answers

    def confined(self, deepest: float, z: np.ndarray, start: int) -> Solution:
        """From z on grid ``start``, with no depth beyond ``deepest`` [nodes of grid ``last``] until the end:
        the shallow answer, where there are several.
        """
        free = self.pyramid.bounds
        shallow = [
            (low, np.clip(deepest * 2.0 ** (self.last - level), low + LEAST_RANGE, high))
            for level, (low, high) in enumerate(free)
        ]
        self.pyramid.set_bounds(shallow)
        try:
            z = self.multigrid.solve(z, start, self.last, accept=False).depth
        finally:
            self.pyramid.set_bounds(free)
        return Solution(z, math.inf) if self.pyramid.stop() else self.multigrid.relax(self.last, z, ())

    def strong_relief(self, share: float) -> tuple[np.ndarray, Solution]:
        """A flat surface of the coarsest grid from which strong relief is found, and what it leads to.

        Strong relief shades itself so much that the flat surface nearest to the images, ``share`` of the way
        between the bounds, is far too deep to start from; so shallower ones are tried, and shading gains,
        which stay as they were of the best.
        """
        pyramid, last, coarsest = self.pyramid, self.last, self.pyramid.coarsest
        levels = range(last, coarsest)
        compared = next((n for n in levels if pyramid.images[n][0].size <= SMALL**2), coarsest)
        tried = []
        for part, gain in dict.fromkeys(
            (part, gain if compared < coarsest else 1) for part, gain in SHALLOW_STARTS
        ):  # no grid, no gain
            pyramid.set_shading_gain(gain, compared)
            flat = self.flat(part * share, coarsest)
            found = self.multigrid.solve(flat, coarsest, compared, accept=False)
            tried.append((found, gain, flat))
            if pyramid.stop() or found.objective < FOUND * pyramid.good_objective(compared):
                break
        found, gain, flat = min(tried, key=lambda one: one[0].objective)
        pyramid.set_shading_gain(gain, compared)
        if last < compared:
            found = self.multigrid.refine(found.depth, compared, last, accept=False)
        return flat, found

    def add_mosaic(self, level: int, answers: list[Solution]) -> None:
        """Adds the mosaic of these surfaces, if there are several and none is good."""
        best = min(answer.objective for answer in answers)
        if len(answers) > 1 and best > self.pyramid.good_objective(level):
            answers.append(self.mosaic(level, [answer.depth for answer in answers]))

    def mosaic(self, level: int, surfaces: list[np.ndarray]) -> Solution:
        """From a surface that takes each place from the one of these whose image is best round it."""
        problem, images = self.pyramid.problem(level), self.pyramid.images[level]
        misfits = []
        for z in surfaces:
            squares = [(light - target) ** 2 for light, target in zip(problem.irradiances(z), images)]
            misfits.append(blurred(blurred(np.sum(squares, 0))) + LEAST_MISFIT)
        least = np.min(misfits, 0)
        shares = [blurred((least / misfit) ** 2) for misfit in misfits]
        joined = np.sum([share * z for share, z in zip(shares, surfaces)], 0) / np.sum(shares, 0)
        self.pyramid.set_prior(level, on_coarser_grid(joined))
        return self.multigrid.relax(level, joined, FROM_COARSER)


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    """Nodes (rms)."""
    return math.sqrt(np.mean((one - other) ** 2))
