"""The least-squares problem of one grid on a device, and Gauss-Newton on it (docs/explanation/inverse.md)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..backends.base import Backend
from ..light.interreflection import Round
from .albedo import AlbedoFit
from .conjugate_gradients import ConjugateGradients, Depths
from .forward import Image, Launcher, Surface
from .ground import GROUND_RAYS, STRIPS, GroundLight
from .lights import Light

FIRST_DAMPING = 1e-4  # damping of the first step, as a multiple of the diagonal
CONVERGED = 3e-3  # share of the objective below which a step is the last
# shares of the gain that the quadratic model predicts: above WELL damping falls, below BADLY it grows
WELL, BADLY = 0.5, 0.2
# factors of the damping for the next step: after a gain above WELL, below BADLY, and after none
EASED, TIGHTENED, REJECTED = 0.3, 3, 4
LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e4


class Solution(NamedTuple):
    """A surface (rows, cols) and the objective there."""

    depth: np.ndarray
    objective: float


class Descent:
    """The least-squares problem of one grid: images of one surface, bounds of its depth, smoothness.

    If the albedo is not known the gains stand for albedo 1, and every evaluation takes for each pixel the
    albedo that explains all images best there: the objective is that of the best albedo, and so is its
    gradient (variable projection).

    ``radiances``: what the ground sends to ground, of each image, with the rays that gather it and the links
    of a node in each of them that there is room for; None where that is left out.

    There are two sides, z[here] and a trial, each with the light and derivatives evaluated there: a trial
    that fails costs nothing that is known of z[here].
    """

    def __init__(
        self,
        backend: Backend,
        shape: tuple[int, int],
        sides: str,
        images: list[tuple[Light, np.ndarray, np.ndarray]],
        low: np.ndarray | float,
        high: np.ndarray | float,
        albedo_known: bool = True,
        radiances: list[np.ndarray] | None = None,
        rays: Round = GROUND_RAYS,
        strips: int = STRIPS,
    ):
        self.backend, self.shape = backend, shape
        self.launcher = Launcher(backend, shape)
        self.pixels = pixels = self.launcher.pixels
        self.images = [Image(backend, light, shape, sides, gain, target) for light, gain, target in images]
        self.albedo = None if albedo_known else AlbedoFit(self.launcher, self.images)
        self.surface = Surface(self.launcher, sides)
        self.ground = None
        if radiances is not None:
            relief = float(np.max(high) - np.min(low))
            self.ground = GroundLight(self.launcher, sides, self.images, radiances, relief, rays, strips)
        self.depths = Depths(
            [backend.empty((pixels,), np.float32) for _ in range(2)],
            backend.empty((pixels,), np.float32, 0),
            *(
                backend.upload(np.broadcast_to(np.asarray(bound, np.float32), shape).ravel())
                for bound in (low, high)
            ),
        )
        self.gradients = ConjugateGradients(self.launcher, self.images, self.albedo, self.depths)
        # sums by block: one row per image, then smoothness, then the albedo's prior
        self.parts = backend.empty((len(images) + 1 + (not albedo_known), self.launcher.blocks), np.float64)
        self.here = 0
        self._misfits: list[list[float]] = [[], []]
        # depths (rows, cols) float32 at z[here], if what an evaluation finds there is still at hand
        self._at: np.ndarray | None = None
        self.steps, self.damping = 0, FIRST_DAMPING  # of the last run

    @property
    def misfits(self) -> list[float]:
        """Of every image the sum of (gain E - target)^2, at z[here]."""
        return self._misfits[self.here]

    def _trace(self, side: int) -> None:
        """Follows all rays from z[side]."""
        self.surface.set_depth(self.depths.z[side])
        for image in self.images:
            image.evaluate(side, self.surface)
        if self.ground is not None:
            self.ground.add(side, self.surface, self.depths.z[side])
        self._compare(side)

    def _compare(self, side: int) -> None:
        """The objective at a side, for the present targets and prior, and the best albedo if not known."""
        count, blocks = len(self.images), self.launcher.blocks
        compared = [(image.links[side][0], image.gains[side], image.target) for image in self.images]
        rows = list(range(count))
        if self.albedo is not None:
            self.albedo.fit(side)
            compared.append((self.albedo.product, self.albedo.weight, self.albedo.expected))
            rows.append(count + 1)
        for row, (light, gain, target) in zip(rows, compared):
            sums = self.parts, row * blocks, self.pixels
            self.launcher.launch("misfit", light, gain, target, *sums, dim=(blocks,))
        rest = self.depths.rest, self.parts, count * blocks
        self.launcher.launch("bending", self.depths.z[side], *rest, *self.shape, dim=(blocks,))

    def _try(self, side: int) -> None:
        """Evaluates a trial step from the other side."""
        z, _, low, high = self.depths
        step = self.gradients.x
        self.launcher.launch(
            "bounded_step", z[1 - side], step, low, high, z[side], self.pixels, self.launcher.nodes_per_item
        )
        self._trace(side)

    def _evaluate(self, side: int, smoothness: float, work: Callable[[int], None]) -> float:
        """The objective at what ``work`` makes of z[side]; the derivatives there are kept."""
        self.launcher.repeat(work, side)
        sums = self.backend.download(self.parts).sum(1).tolist()
        count = len(self.images)
        self._misfits[side] = sums[:count]
        return float(0.5 * (sum(sums[:count]) + smoothness * sums[count] + sum(sums[count + 1 :])))

    def value(self, z: np.ndarray, smoothness: float) -> float:
        """The objective at depths (rows, cols)."""
        z = np.array(z, np.float32)
        if self._at is not None and np.array_equal(z, self._at):
            return self._evaluate(self.here, smoothness, self._compare)
        self._at = None  # also where the evaluation is interrupted
        self.backend.put(self.depths.z[self.here], z.ravel())
        value = self._evaluate(self.here, smoothness, self._trace)
        self._at = z
        return value

    def irradiances(self, z: np.ndarray, rows: int | list[int] = 0) -> list[np.ndarray]:
        """gain E of every image at depths (rows, cols). ``rows``: of the light in its links, E the first."""
        self.value(z, 0.0)
        get, shape = self.backend.download, (*np.shape(rows), *self.shape)
        return [
            (get(image.gains[self.here]) * get(image.links[self.here][0])[rows]).reshape(shape)
            for image in self.images
        ]

    def fitted_albedo(self, z: np.ndarray) -> np.ndarray:
        """(rows, cols) albedo at depths z (rows, cols), as a share of what the gains stand for; for an albedo
        that is not known.
        """
        assert self.albedo is not None, "the albedo is given"
        self.value(z, 0.0)
        return self.albedo.values().reshape(self.shape)

    def set_bounds(self, low: np.ndarray, high: np.ndarray) -> None:
        """Other bounds of depth from here on."""
        for array, values in ((self.depths.low, low), (self.depths.high, high)):
            self.backend.put(array, np.asarray(values, np.float32).ravel())

    def set_prior(self, z: np.ndarray) -> None:
        """From here on, smoothness is of what depth has beyond z (rows, cols); at first that is 0."""
        self.backend.put(self.depths.rest, np.asarray(z, np.float32).ravel())

    def set_targets(self, targets: list[np.ndarray]) -> None:
        """Other targets from here on."""
        for image, target in zip(self.images, targets):
            self.backend.put(image.target, np.asarray(target, np.float32).ravel())

    def solve(self, smoothness: float, damping: float, most: int, tolerance: float) -> float:
        """Conjugate gradients for a step from z[here]; what the quadratic model gains by it."""
        return self.gradients.solve(self.here, sum(self.misfits), smoothness, damping, most, tolerance)

    def step(self, smoothness: float, most: int, tolerance: float) -> np.ndarray:
        """The first Gauss-Newton step (rows, cols) from the depths that were evaluated last, without a
        penalty on depth itself.
        """
        self.solve(smoothness, LEAST_DAMPING, most, tolerance)
        return self.backend.download(self.gradients.x).reshape(self.shape)

    def run(
        self,
        start: np.ndarray,
        smoothness: float,
        steps: int,
        most: int,
        tolerance: float = 0.1,
        converged: float = CONVERGED,
        stop: Callable[[], bool] | None = None,
        damping: float = FIRST_DAMPING,
    ) -> Solution:
        """Depth (rows, cols) float32 after at most ``steps`` Gauss-Newton steps from ``start``, and the
        objective there.
        """
        best = self.value(start, smoothness)
        self.steps, self._at = 0, None
        for _ in range(steps):
            self.steps += 1
            gain = self.solve(smoothness, damping, most, tolerance)
            trial = 1 - self.here
            value = self._evaluate(trial, smoothness, self._try)
            ratio = (best - value) / max(gain, 1e-300)
            if value < best:
                last = best - value < converged * best
                self.here, best = trial, value
                factor = EASED if ratio > WELL else 1 if ratio > BADLY else TIGHTENED
                damping = max(damping * factor, LEAST_DAMPING)
            else:
                damping *= REJECTED
                last = damping > MOST_DAMPING
            if last or (stop and stop()):
                break
        self.damping = damping
        depth: np.ndarray = self.backend.download(self.depths.z[self.here]).reshape(self.shape)
        self._at = depth
        return Solution(depth.copy(), best)


def bounced(problem: Descent, z: np.ndarray) -> list[np.ndarray]:
    """gain (E - E_d) of every image at depths (rows, cols): the part that ground sends to ground."""
    problem.value(z, 0.0)
    get, here = problem.backend.download, problem.here

    def part(image: Image) -> np.ndarray:
        more = get(image.links[here][0])[0] - get(image.direct[here][0])[0]
        light: np.ndarray = (get(image.gains[here]) * more).reshape(problem.shape)
        return light

    return [part(image) for image in problem.images]
