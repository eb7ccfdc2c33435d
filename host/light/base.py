"""The protocol of a light method: a value, an estimate of its error, and a step that makes both better.

A method computes light and contains no decision; the loop in refinement.py decides and computes no light.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..backends.base import Array, Backend
from ..backends.resident import DeviceImage
from ..scene import Scene

if TYPE_CHECKING:
    from ..samples import Samples


# least rows of a column that are summed in float32 before they are in float64, and most such sums of a
# column, since the host fetches them: with 64 in place of 16, 5 MB of a map of 4096 x 4096 nodes, an image
# within 1 % took 23.5 ms on an H200 in place of 19.6
SUMMED_ROWS, MOST_SUMS = 64, 16


class Estimate(NamedTuple):
    """Of the half difference: RMS over the image's mean, and share of nodes beyond a limit.

    mean: of the image, over the nodes that it lights, in the irradiance's unit.
    """

    rms: float
    tail_share: float
    mean: float


class Later:
    """An image that is made when it is called; pickled as the image."""

    def __init__(self, work: Callable[[], np.ndarray]):
        self.work = work

    def __call__(self) -> np.ndarray:
        return self.work()

    def __reduce__(self) -> tuple[type[Later], tuple[Callable[[], np.ndarray]]]:
        return Later, (partial(np.asarray, self()),)


class LightMethod(ABC):
    """Irradiance of one grey source on one map by one method.

    ``units``: azimuths, slices, points, rays or the size of the hemicube that the image is made of;
    ``unit_name``: which of these, in the plan's words. An image is the mean of two halves, images that share
    no ray, or the better of two images, where the method can have that; half their difference, the half
    difference, then estimates its error at every node.
    """

    units: int
    unit_name: str

    @property
    def amount(self) -> str:
        """The units in words, as a plan prints them."""
        return f"{self.units} {self.unit_name}"

    @abstractmethod
    def refine(self) -> None:
        """Improve the image by more azimuths, slices or directions, added to the present ones if possible."""

    @abstractmethod
    def irradiance(self) -> np.ndarray:
        """(rows, cols) float32 [brightness x sr]; undefined where masked."""

    def device_image(self) -> DeviceImage | None:
        """The irradiance, in the memory of the method, which ends with it; None where the host makes it."""
        return None

    def at(self, samples: Samples) -> np.ndarray:
        """The irradiance at samples, (nodes,) float64."""
        return samples.of(self.irradiance())

    def half_difference_at(self, samples: Samples) -> np.ndarray | None:
        """:meth:`half_difference` at samples, (nodes,) float64."""
        difference = self.half_difference()
        return None if difference is None else samples.of(difference())

    def half_difference(self) -> Later | None:
        """Of the two images, (rows, cols) float32 in the irradiance's unit.

        It is downloaded when it is called. None where there is one image only.
        """
        return None

    def estimate(self, limit: float) -> Estimate | None:
        """Of :meth:`half_difference`; ``limit`` in the irradiance's unit."""
        return None


def estimated(
    image: np.ndarray, half_difference: np.ndarray, mask: np.ndarray | None, limit: float
) -> Estimate:
    """The estimate by an image and its half difference (rows, cols) on the host; ``limit`` in their unit."""
    if mask is not None:
        image, half_difference = image[mask], half_difference[mask]
    lit = image > 0
    mean = float(image.sum(dtype=np.float64)) / lit.sum() if lit.any() else 1e-30
    rms = math.sqrt(float(np.square(half_difference, dtype=np.float64).mean()))
    beyond = np.count_nonzero(np.abs(half_difference) > limit)
    return Estimate(rms / mean, beyond / half_difference.size, mean)


class HostImage(LightMethod):
    """A light method that makes its ``image`` (rows, cols) float32 on the host.

    ``_half_difference``: half its difference from a coarser image, or None.
    """

    scene: Scene
    image: np.ndarray
    _half_difference: np.ndarray | None = None

    def irradiance(self) -> np.ndarray:
        return self.image

    def half_difference(self) -> Later | None:
        image = self._half_difference
        return None if image is None else Later(lambda: image)

    def estimate(self, limit: float) -> Estimate | None:
        difference = self._half_difference
        return None if difference is None else estimated(self.image, difference, self.scene.mask, limit)


def judged(
    engine: Backend,
    shape: tuple[int, int],
    heights: Array,
    margin: int,
    image: Array,
    half_difference: Array,
    limit: float,
) -> Estimate:
    """The estimate by an image and its half difference (rows x cols) on a device; ``limit`` in their unit,
    in which is the mean.

    ``heights``: with ``margin`` nodes on all sides; masked heights mark nodes that do not count.
    """
    rows, cols = shape
    block = max(SUMMED_ROWS, -(-rows // MOST_SUMS))
    blocks = -(-rows // block)
    sums = engine.empty((5, blocks, cols), np.float32)
    maps, size = (heights, image, half_difference, sums), (rows, cols, margin, block)
    engine.launch("ground", "judge", (cols, blocks), *maps, *size, float(limit))
    light, square, valid, lit, beyond = engine.download(sums).reshape(5, -1).sum(1, dtype=np.float64).tolist()
    mean = light / lit if lit and light > 0 else 1e-30
    return Estimate(math.sqrt(square / valid) / mean, beyond / valid, mean)
