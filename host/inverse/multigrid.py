"""Surfaces solved for on a grid, and brought from coarse grids to fine ones.

On every small grid the smoothness falls in steps (continuation): a stiff surface has few ways to be wrong.
Large grids are solved by cycles over all coarser ones (full approximation scheme). There the coarse target is
corrected by what the two grids say of the same surface, E_coarse(restricted z) - restricted E_fine(z). The
change found on the coarse grid is interpolated, and kept if the fine objective falls. The part of the
smoothness that stands for noise acts on the difference to the coarser grid's surface, which holds less noise.
"""

from __future__ import annotations

import math

import numpy as np

from .. import sources
from .descent import Solution
from .pyramid import Pyramid, on_coarser_grid
from .resampling import cubic, doubled, halved, halved_depth

FROM_STIFF = (1e-2, 1e-3, 1e-4)  # steps of smoothness before a grid's own, on the grid of starts
FROM_COARSER = (1e-3, 1e-4)  # the same on finer grids
STEPS, START_STEPS = 20, 30  # Gauss-Newton steps at one smoothness; on the grid of starts
ITERATIONS = 60  # conjugate gradients of a step
# tolerance of conjugate gradients, and share of the objective below which a step is the last: before the
# answer, the same where it decides which answer is reached, and of the answer
LOOSE, CLOSE, LAST = (0.05, 5e-3), (0.02, 1e-3), (0.01, 2e-4)
# of a cycle's grids and of its coarsest: steps, conjugate gradients, tolerance
SMOOTHING, COARSEST_SOLUTION = (3, 30, 0.05), (8, 60, 0.03)
CYCLE_DAMPING = 1e-2  # of the first step
CYCLE_SETTLED = 1e-4  # share of the objective below which a step of a cycle is the last
CYCLES, MORE_UNDER_SKIES = 8, 2  # of a large grid; as many more under a sky, which tells less of depth
CYCLE_SMOOTHNESS = 3e-4  # of the first cycle
SLOW = 0.01  # fall of the objective in a cycle below which it is the last

Continuation = tuple[float, ...]


class Multigrid:
    """Solves the problems of a pyramid. ``several``: whether there may be several answers; each step is then
    solved more accurately, since the path decides which answer is reached.
    """

    def __init__(self, pyramid: Pyramid, several: bool = False):
        self.pyramid, self.several = pyramid, several
        self.accuracy = CLOSE if several else LOOSE
        self.damping: dict[int, float] = {}  # of the cycles' last steps on each grid

    def relax(
        self,
        level: int,
        z: np.ndarray,
        continuation: Continuation,
        steps: int = STEPS,
        accuracy: tuple[float, float] | None = None,
    ) -> Solution:
        """From z on one grid, with those of these weights of smoothness above its own, then with its own."""
        problem = self.pyramid.problem(level)
        least = self.pyramid.smoothness(level)
        solution = Solution(np.clip(z, *self.pyramid.bounds[level]), math.inf)
        for smoothness in (*(s for s in continuation if s > least), least):
            solution = problem.run(
                solution.depth, smoothness, steps, ITERATIONS, *(accuracy or self.accuracy), self.pyramid.stop
            )
        return solution

    def polish(self, level: int, z: np.ndarray) -> Solution:
        """The surface that is the answer so far, worked out."""
        self.pyramid.set_prior(level, on_coarser_grid(z))
        solution = self.relax(level, z, (), accuracy=LAST)
        self.pyramid.accept(level, solution.depth)
        return solution

    def solve(self, z: np.ndarray, start: int, last: int, accept: bool = True) -> Solution:
        """On grid ``last``, from a surface on grid ``start`` that was not worked over. ``accept``: whether
        this is the answer so far.
        """
        solution = self.relax(start, z, FROM_STIFF, START_STEPS)
        if accept:
            self.pyramid.accept(start, solution.depth)
        return self.refine(solution.depth, start, last, accept) if last < start else solution

    def refine(self, z: np.ndarray, start: int, last: int, accept: bool = True) -> Solution:
        """On grid ``last``, from a surface on the coarser grid ``start``."""
        solution = Solution(z, math.inf)
        for level in range(start - 1, last - 1, -1):
            if self.pyramid.stop():
                break
            rows, cols = self.pyramid.shape(level)
            z = 2 * cubic(solution.depth, 2)[:rows, :cols]
            self.pyramid.set_prior(level, z)  # a coarser grid has less noise to take for relief
            solution = self.settle(level, z)
            if accept:
                self.pyramid.accept(level, solution.depth)
        return solution

    def settle(self, level: int, z: np.ndarray) -> Solution:
        """On one grid, from z, which is right on coarser grids about."""
        small = self.pyramid.is_small(level)
        return self.relax(level, z, FROM_COARSER) if small else self.cycles(level, z)

    def cycles(self, level: int, z: np.ndarray) -> Solution:
        """On a large grid by cycles over all coarser ones (full approximation scheme), stiff at first."""
        pyramid, solution = self.pyramid, Solution(z, math.inf)
        least = pyramid.smoothness(level)
        self.damping = {}
        count = CYCLES + MORE_UNDER_SKIES * any(isinstance(s, sources.Sky) for s in pyramid.sources)
        count = count if level == 0 else count // 2
        for number in range(count):
            smoothness = max(least, CYCLE_SMOOTHNESS * (least / CYCLE_SMOOTHNESS) ** (number / (count // 2)))
            before = solution.objective
            solution = self._cycle(level, solution.depth, pyramid.images[level], smoothness)
            if pyramid.stop() or (number > count // 2 and solution.objective > (1 - SLOW) * before):
                break
        return solution

    def _smooth(self, level: int, z: np.ndarray, target: list[np.ndarray], smoothness: float) -> Solution:
        problem = self.pyramid.problem(level)
        problem.set_targets(target)
        solution = problem.run(
            np.clip(z, *self.pyramid.bounds[level]),
            smoothness,
            *(SMOOTHING if level < self.pyramid.coarsest else COARSEST_SOLUTION),
            CYCLE_SETTLED,
            self.pyramid.stop,
            self.damping.get(level, CYCLE_DAMPING),
        )
        self.damping[level] = problem.damping
        return solution

    def _cycle(self, level: int, z: np.ndarray, target: list[np.ndarray], smoothness: float) -> Solution:
        """Smoothing, the same on the next coarser grid whose target is put right by what the two say of one
        surface, and smoothing again.
        """
        pyramid = self.pyramid
        first = self._smooth(level, z, target, smoothness)
        if level == pyramid.coarsest or pyramid.stop():
            return first
        coarser = pyramid.problem(level + 1)
        fine = pyramid.problem(level).irradiances(first.depth)
        restricted = halved_depth(np.asarray(first.depth, float))
        coarse_target = [halved(image) for image in target]
        try:
            coarser.set_targets(coarse_target)  # an albedo that is not known is that of the targets
            coarse = coarser.irradiances(restricted)
            corrected = [t + own - halved(light) for t, own, light in zip(coarse_target, coarse, fine)]
            change = self._cycle(level + 1, restricted, corrected, smoothness).depth - restricted
        finally:
            coarser.set_targets(pyramid.images[level + 1])
        second = self._smooth(level, first.depth + 2 * doubled(change, first.depth.shape), target, smoothness)
        return second if second.objective < first.objective else first
