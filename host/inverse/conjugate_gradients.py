"""A Gauss-Newton step on a device: conjugate gradients for the normal equations.

(J^T J + lambda D^T D + damping) step = -gradient. The products J v and J^T u are gathers and scatters along
the horizons that the last evaluation found: no ray is followed twice. What is scattered, and what decides the
length of an iteration's step, is added in fixed point; other sums are taken block by block in one order, and
kernels use correctly rounded arithmetic alone, so every backend takes the same steps. The state stays on the
device: iterations are started some at a time, and do nothing once it says stop.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..constants import COARSENING, GAIN, LEFT, LINK_BLOCK, STATE, SUM_SLOTS
from .albedo import AlbedoFit
from .forward import DeviceArray, Image, Launcher

# a coarse node's curvature over the sum of its nodes' diagonal; of the next: as measured, curvature falls as
# the width to -1.5
BROAD, BROADER = 0.075, 0.125
FIXED = 2.0**36  # of fixed point, over the length of the vector that is multiplied
FINE = 2.0**30  # of the diagonal's fixed point
EXACT = 2.0**44  # of that of r v, v w and v v, over what they were before
LEAST_CURVATURE = 1e-7  # in the diagonal, so that a node that no image tells of has one
SECOND_DIFFERENCES = 12  # diagonal of D^T D: 1 + 4 + 1 along rows and along columns


class Depths(NamedTuple):
    """Depth maps (pixels,) float32 on the device: of the surface and of a trial; the prior; the bounds."""

    z: list[DeviceArray]
    rest: DeviceArray
    low: DeviceArray
    high: DeviceArray


class ConjugateGradients:
    """Solves for steps x of one grid, from depths at which the images were evaluated.

    The preconditioner is the diagonal, and the same on two coarser grids.
    """

    def __init__(self, launcher: Launcher, images: list[Image], albedo: AlbedoFit | None, depths: Depths):
        backend, pixels = launcher.backend, launcher.pixels
        self.backend, self.shape, self.pixels = backend, launcher.shape, pixels
        self.launcher, self.images, self.albedo, self.depths = launcher, images, albedo, depths
        # of the grid and of those that precondition
        self.shapes = [tuple(-(-size // COARSENING**times) for size in self.shape) for times in range(3)]
        sizes = [rows * cols for rows, cols in self.shapes]
        self.w, self.p, self.s, self.x = (backend.empty((pixels,), np.float32) for _ in range(4))
        self.v, self.scale = ([backend.empty((size,), np.float32) for size in sizes] for _ in range(2))
        self.r, self.free = (
            [backend.empty((size,), np.float32, fill) for size in sizes[:-1]] for fill in (None, 1)
        )
        self.sum, self.squares = (
            backend.empty((launcher.partial_sums, pixels), np.int64, 0) for _ in range(2)
        )
        self.inner_products = backend.empty((2, launcher.blocks), np.float64)
        self.states, self.totals = [
            [backend.empty(shape, dtype) for _ in range(2)]
            for shape, dtype in (((STATE,), np.float64), ((3, SUM_SLOTS), np.int64))
        ]
        # nodes of a work-item that scatters, and work-items
        blocks = -(-pixels // (LINK_BLOCK * launcher.partial_sums))
        self.scattered = launcher.nodes_per_item if launcher.partial_sums == 1 else LINK_BLOCK * blocks
        self.scatterers = (-(-pixels // self.scattered),)

    def gradient(self, side: int, misfit: float, smoothness: float) -> tuple[float, float]:
        """Readies a step: r = -gradient, v = r preconditioned; gives v v and r v.

        ``misfit``: sum of squares over all images, which scales the fixed point.
        """
        quanta = FIXED / max(1e-12, math.sqrt(misfit))
        for image in self.images:
            self._scatter(
                "gradient",
                *(*image.links[side], image.gains[side], image.target),
                *(self.sum, self.squares, quanta, FINE, *self.shape, image.count, image.sides),
            )
        z, rest, low, high = self.depths
        self.launcher.launch(
            "descent",
            *(z[side], rest, low, high, self.sum, self.squares, self.scale[0]),
            *(self.r[0], self.x, self.p, self.s, self.free[0]),
            *(1 / quanta, 1 / FINE, SECOND_DIFFERENCES * smoothness + LEAST_CURVATURE, smoothness),
            *(*self.shape, self.launcher.nodes_per_item, self.launcher.partial_sums),
        )
        self.launcher.repeat(self._start, 0)  # the same for both sides
        square, product = self.backend.download(self.inner_products).sum(1).tolist()
        return square, product

    def solve(
        self, side: int, misfit: float, smoothness: float, damping: float, most: int, tolerance: float
    ) -> float:
        """A step x after at most so many iterations; what the quadratic model gains by it."""
        square, product = self.gradient(side, misfit, smoothness)
        if not product > 0:
            return 0.0
        state = self.states[0]
        self.launcher.launch(
            "start",
            *(state, self.totals[0], square, product, smoothness, damping, tolerance**2, FIXED, EXACT, most),
            dim=(1,),
        )
        room = self.pixels * self.images[0].count
        if len(self.images) == 1 and room <= self.backend.single_item_links:
            return self._solve_by_one(side, state)
        left, gain = float(most), 0.0
        while left > 0:
            self.launcher.repeat(self._two_iterations, side, self.backend.iterations_ahead)
            left, gain = self.backend.download(state)[[LEFT, GAIN]].tolist()
        return gain

    def _solve_by_one(self, side: int, state: DeviceArray) -> float:
        """All iterations by one work-item, where launches would take longer."""
        (image,) = self.images
        self.launcher.launch(
            "solve",
            *(*image.links[side], image.gains[side], *self.scale, *self.free, self.sum),
            *(*self.r, *self.v, self.w, self.x, self.p, self.s, state, FIXED, EXACT),
            *(*self.shape, image.count, image.sides),
            dim=(1,),
        )
        return float(self.backend.download(state)[GAIN])

    def _two_iterations(self, side: int) -> None:
        """From one state to the other and back."""
        for now, then in ((0, 1), (1, 0)):
            self.multiply(side, self.states[now])
            self.launcher.launch(
                "normal_product",
                *(self.r[0], self.v[0], self.scale[0], self.free[0], self.sum, self.w),
                *(self.totals[now], self.states[now]),
                *(*self.shape, self.launcher.nodes_per_item, self.launcher.partial_sums),
            )
            self.launcher.launch(
                "conjugate_step",
                *(self.v[0], self.w, self.r[0], self.x, self.p, self.s),
                *(self.totals[now], self.totals[then], self.states[now], self.states[then]),
                *(FIXED, EXACT, self.pixels, self.launcher.nodes_per_item),
            )
            self._precondition()

    def multiply(self, side: int, state: DeviceArray) -> None:
        """sum += quanta transpose(J) gain^2 J v, over all images; less what the albedo that is best makes up
        for, if it is not known (Kaufman 1975).
        """
        rest = self.v[0], self.sum, state, *self.shape
        if self.albedo is None:
            for image in self.images:
                self._scatter(
                    "product", *image.links[side], image.gains[side], *rest, image.count, image.sides
                )
            return
        shared, under = self.albedo.shared, self.albedo.unders[side]
        for number, image in enumerate(self.images):
            gains = image.gains[side], image.gain
            self.launcher.launch(
                "albedo_change",
                *(*image.links[side], *gains, self.v[0], shared, state),
                *(*self.shape, image.count, image.sides, number == 0, self.launcher.nodes_per_item),
            )
        for image in self.images:
            gains = image.gains[side], image.gain
            self._scatter(
                "reduced_product", *image.links[side], *gains, shared, under, *rest, image.count, image.sides
            )

    def _scatter(self, kernel: str, *args: Any) -> None:
        self.launcher.launch(kernel, *args, self.scattered, self.launcher.partial_sums, dim=self.scatterers)

    def _start(self, side: int) -> None:
        """The scales of the coarser grids, and the first v with v v and r v."""
        self._restrict(0, self.scale[0], self.scale[1], BROAD)
        self._restrict(1, self.scale[1], self.scale[2], BROADER)
        self._precondition()
        blocks = (self.launcher.blocks,)
        self.launcher.launch(
            "inner_products", self.r[0], self.v[0], self.inner_products, self.pixels, dim=blocks
        )

    def _restrict(
        self, level: int, fine: DeviceArray, to: DeviceArray, times: float = 1.0, over: DeviceArray = None
    ) -> None:
        """to = times the restriction of a grid to the next, over ``over`` if given."""
        rows, cols = self.shapes[level + 1]
        divisor = to if over is None else over
        self.launcher.launch(
            "restriction", fine, divisor, to, times, over is not None, *self.shapes[level], dim=(cols, rows)
        )

    def _precondition(self) -> None:
        """v = r / scale, and the same on the coarser grids."""
        self._restrict(0, self.r[0], self.r[1])
        self._restrict(1, self.r[1], self.v[2], over=self.scale[2])
        for level in (1, 0):
            self.launcher.launch(
                "prolongation",
                *(self.r[level], self.scale[level], self.free[level], self.v[level + 1], self.v[level]),
                *self.shapes[level],
                # a work-item does what lies in one coarse node of a row
                dim=(self.shapes[level + 1][1], self.shapes[level][0]),
            )
