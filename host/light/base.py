"""The protocol of a light method: a value, an estimate of its error, and a step that makes both better.

A method computes and never decides; the loop that drives it (refinement.py) decides and never computes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np


class Estimate(NamedTuple):
    """What half the difference of two halves is, over the image's mean: its RMS, and the share of nodes at
    which it passes a limit.
    """

    rms: float
    beyond: float


class LightMethod(ABC):
    """Irradiance of one grey source on one map by one method.

    ``units``: azimuths, slices or the size of the hemicube that the image is made of. An image is the mean of
    two that share no ray, where the method can have that; half their difference then estimates its error at
    every node.
    """

    units: int

    @abstractmethod
    def refine(self) -> None:
        """Make the image better: more azimuths, slices or directions, beside those that are there where the
        method can.
        """

    @abstractmethod
    def irradiance(self) -> np.ndarray:
        """(rows, cols) float32 [brightness x sr]; no number that means anything where masked."""

    def half(self) -> np.ndarray | None:
        """Half the difference of the two images, (rows, cols) float32 in the irradiance's unit; None where
        there are not two.
        """
        return None

    def estimate(self, limit: float) -> Estimate | None:
        """Of :meth:`half`; ``limit`` in the irradiance's unit."""
        return None
