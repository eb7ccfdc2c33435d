"""The protocol of a light method: a value, an estimate of its error, and a step that makes both better.

A method computes and never decides; the loop that drives it (refinement.py) decides and never computes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np


class Estimate(NamedTuple):
    """Of half the difference of two images, over the image's mean: RMS, and share of nodes beyond a limit."""

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
        """Improve the image by more azimuths, slices or directions, added to the present ones if possible."""

    @abstractmethod
    def irradiance(self) -> np.ndarray:
        """(rows, cols) float32 [brightness x sr]; undefined where masked."""

    def half(self) -> np.ndarray | None:
        """Half the difference of the two images, (rows, cols) float32 in the irradiance's unit.

        None where there is one image only.
        """
        return None

    def estimate(self, limit: float) -> Estimate | None:
        """Of :meth:`half`; ``limit`` in the irradiance's unit."""
        return None
