"""The search for the surface that explains the images, stage by stage: recover(method="robust") between its
checks and its answer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .descent import Solution
from .multigrid import Multigrid
from .starts import BETTER, Starts

# share of the objective below which another start's answer is taken, where one answer is expected
CLEARLY = 0.9
FOLLOWED = 8.0  # times the objective on a coarser grid up to which a start is followed
LOST = 100.0  # times the objective of a good surface, from which strong relief is looked for
RIVAL = 6.0  # times the objective up to which another start counts as an answer


class Rival(NamedTuple):
    """Another answer: its difference from the one that is given (rows, cols) [nodes of its grid], and its
    weight, 1 if it explains the images as well.
    """

    difference: np.ndarray
    weight: float


class Search:
    """Coarse to fine: starts are sorted out on grid ``sorting``, their answers compared on grid
    ``comparing``, and the best one is refined from there.
    """

    def __init__(self, multigrid: Multigrid, several: bool):
        pyramid = multigrid.pyramid
        self.multigrid, self.pyramid, self.several = multigrid, pyramid, several
        self.comparing = 0 if pyramid.is_small(0) else pyramid.start
        self.sorting = max(self.comparing, pyramid.start - 1)
        self.starts = Starts(multigrid, self.sorting)

    def run(self) -> list[Rival]:
        """Leaves the answer, and what was best on the way, in ``pyramid.best``; gives its rivals.

        Raises OutOfTime.
        """
        share = self.starts.nearest_flat()
        if self.pyramid.start == self.pyramid.coarsest:
            self.starts.find_shading_gain(self.starts.flat(share, self.pyramid.coarsest))
        answers = self._sorted_out(share)
        answers = self._compared(answers)
        answer = self._chosen(answers)
        rivals = self._rivals(answer, answers)
        answer = self.multigrid.polish(self.comparing, answer.depth)
        if self.comparing:
            self.multigrid.refine(answer.depth, self.comparing, 0)
        self.starts.check_time()
        return rivals

    def _sorted_out(self, share: float) -> list[Solution]:
        """The answers of the nearest flat surface and of starts around it; or those of a shallower surface,
        if the first ones are far from the images.
        """
        pyramid, starts = self.pyramid, self.starts
        flat = starts.flat(share, pyramid.start)
        answers = starts.around(self.multigrid.solve(flat, pyramid.start, self.sorting), flat, pyramid.start)
        best = _best(answers).objective
        if best > LOST * pyramid.good_objective(self.sorting):
            begun, strong = starts.strong_relief(share)
            starts.check_time()
            if strong.objective < BETTER * best:
                pyramid.accept(self.sorting, strong.depth)
                answers = starts.around(strong, begun, pyramid.coarsest)
        return answers

    def _compared(self, answers: list[Solution]) -> list[Solution]:
        """The answers on the grid where they are compared, but for hopeless ones."""
        first, *others = answers
        if self.comparing == self.sorting:
            self.starts.check_time()
            return answers
        refine = self.multigrid.refine
        followed = FOLLOWED * max(first.objective, self.pyramid.good_objective(self.sorting))
        found = [refine(first.depth, self.sorting, self.comparing)]
        self.starts.check_time()
        found += [
            refine(other.depth, self.sorting, self.comparing, accept=False)
            for other in others
            if other.objective < followed
        ]
        self.starts.check_time()
        self.starts.add_mosaic(self.comparing, found)
        return found

    def _chosen(self, answers: list[Solution]) -> Solution:
        """The first answer, unless another one explains the images clearly better."""
        first, best = answers[0], _best(answers)
        return best if best.objective < (BETTER if self.several else CLEARLY) * first.objective else first

    def _rivals(self, answer: Solution, answers: list[Solution]) -> list[Rival]:
        power = 1 if self.several else 2
        return [
            Rival(other.depth - answer.depth, min(1, answer.objective / other.objective) ** power)
            for other in answers
            if other is not answer and other.objective < RIVAL * answer.objective
        ]


def _best(answers: list[Solution]) -> Solution:
    return min(answers, key=lambda answer: answer.objective)
