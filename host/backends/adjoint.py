"""Depth from irradiance on a device: the forward model with its derivatives, and Gauss-Newton on it (MODEL.md, 5.2).

The normal equations of a step, (J^T J + lambda D^T D + damping) step = -gradient, are solved by conjugate gradients, whose
products J v and J^T u are gathers and scatters along the horizons that the last evaluation found: no ray is followed
twice. What is scattered is added in fixed point, sums are taken block by block in one order, and kernels use correctly
rounded arithmetic alone, so every backend takes the same steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..errors import CapacityError
from .base import SIDES, Backend

DAMPING = 1e-4  # of the first step, in the diagonal's unit
SETTLED = 3e-3  # share of the objective below which a step is the last
BLOCK = 64  # nodes that a work-item of a sum owns; as in opencl/adjoint.cl
TILE = 8  # nodes across the squares whose highest point is known; as there
MARGIN = 16
NONE = -1e30
FIXED = 2.0**36  # of fixed point, over the length of the vector that is multiplied
WIDEST, TALLEST = 65536, 16384


class Light(NamedTuple):
    """A source as the kernels take it, lengths in nodes of this grid.

    azimuths (count, 4): of a sky; nodes (count, 4), frames (pixels, 4), solid: of a lamp or window. table: its brightness,
    (n, knots, 4), or None for 1 everywhere. ball: whether the solid is one.
    """

    table: np.ndarray | None
    azimuths: np.ndarray | None = None
    nodes: np.ndarray | None = None
    frames: np.ndarray | None = None
    solid: np.ndarray | None = None
    ball: bool = False

    @property
    def count(self) -> int:
        return len(self.azimuths if self.nodes is None else self.nodes)


class Image:
    """One image of the surface on the device: what a source makes of a depth map, and how that changes with it."""

    def __init__(self, backend: Backend, light: Light, shape: tuple[int, int], sides: str, gain: np.ndarray, target: np.ndarray):
        self.backend, self.shape, self.sides, self.count = backend, shape, SIDES[sides], light.count
        pixels = shape[0] * shape[1]
        backend.reserve(pixels * (12 * self.count + 60), f"Recovering {pixels:,} nodes along {self.count} azimuths", "Recover a smaller image.")
        put = lambda array: backend.upload(np.ascontiguousarray(array, np.float32))
        self.is_sky, self.is_ball = light.azimuths is not None, int(light.ball)
        self.ways = put(light.azimuths if self.is_sky else light.nodes)
        self.table = put(np.zeros((1, 4)) if light.table is None else light.table)
        self.knots, self.rows_of_table = (0, 1) if light.table is None else light.table.shape[1::-1]
        if not self.is_sky:
            self.frames, self.solid = put(light.frames), put(light.solid)
        self.gain = put(np.broadcast_to(gain, shape).ravel())
        self.target = put(target.ravel())
        self.light = backend.empty((5, pixels), np.float32)
        self.pulls, self.shares = (backend.empty((self.count, pixels), np.float32) for _ in range(2))
        self.at = backend.empty((self.count, pixels), np.int32)

    def evaluate(self, *surface) -> None:
        """Irradiance and its derivatives at a surface."""
        rows, cols = self.shape
        out = (self.light, self.pulls, self.at, self.shares, rows, cols, MARGIN, self.count)
        if self.is_sky:
            lanes = self.backend.lanes
            self.backend.launch("adjoint", "sky", (-(-cols // lanes), rows), *surface, self.ways, self.table, *out, self.knots, self.sides)
        else:
            self.backend.launch("adjoint", "lamp", (cols, rows), *surface, self.frames, self.ways, self.solid, self.table, *out,
                                self.knots, self.rows_of_table, self.is_ball, self.sides, lanes=1)

    def products(self) -> tuple:
        return self.light, self.pulls, self.at, self.shares


class Descent:
    """The least-squares problem of one grid: images of one surface, bounds of its depth, smoothness."""

    def __init__(self, backend: Backend, shape: tuple[int, int], sides: str, images: list[tuple[Light, np.ndarray, np.ndarray]], low, high):
        rows, cols = shape
        if rows > TALLEST or cols > WIDEST:
            raise CapacityError(f"An image of {rows} x {cols} pixels; at most {TALLEST} x {WIDEST}, since crossings are kept in 32 bits. Cut it into tiles.")
        self.backend, self.shape, self.pixels, self.sides = backend, shape, rows * cols, SIDES[sides]
        self.images = [Image(backend, light, shape, sides, gain, target) for light, gain, target in images]
        self.heights = backend.empty((rows * (cols + 2 * MARGIN),), np.float32, NONE)
        self.tilts, self.top = backend.empty((2, self.pixels), np.float32), backend.empty((1 + rows,), np.float32)
        self.tiles = backend.empty((-(-rows // TILE) * -(-cols // TILE),), np.float32)
        self.z, self.trial, self.r, self.v, self.w, self.p, self.s, self.x, self.u, self.free, self.scale = (backend.empty((self.pixels,), np.float32) for _ in range(11))
        self.low, self.high = (backend.upload(np.broadcast_to(np.asarray(bound, np.float32), shape).ravel()) for bound in (low, high))
        self.sum = backend.empty((self.pixels,), np.int64, 0)
        self.blocks = -(-self.pixels // BLOCK)
        self.gained = backend.empty((1,), np.float64, 0)
        self.parts = {n: backend.empty((self.blocks, n), np.float64) for n in (1, 3)}

    def _launch(self, kernel, *args, dim=None, **more):
        self.backend.launch("adjoint", kernel, dim or (self.blocks,), *args, **more)

    def _total(self, n) -> np.ndarray:
        return self.backend.download(self.parts[n]).reshape(-1, n).sum(0)

    def evaluate(self, z, smoothness: float) -> float:
        """The objective at the depths z on the device; the derivatives there are kept."""
        rows, cols = self.shape
        self._launch("surface", z, self.heights, self.tilts, rows, cols, MARGIN, self.sides, dim=(cols, rows))
        down, across = -(-rows // TILE), -(-cols // TILE)
        self._launch("tiles", z, self.tiles, rows, cols, dim=(across, down))
        self._launch("highest", self.tiles, self.top, rows, cols, 0, dim=(down,))
        self._launch("highest", self.tiles, self.top, rows, cols, 1, dim=(1,))
        self.misfits = []
        for image in self.images:
            image.evaluate(self.heights, self.tilts, self.tiles, self.top)
            self._launch("misfit", image.light, image.gain, image.target, self.u, self.parts[3], self.pixels)
            self.misfits.append(self._total(3))
        self._launch("bending", z, self.parts[1], rows, cols)
        return 0.5 * (sum(m[0] for m in self.misfits) + smoothness * float(self._total(1)[0]))

    def value(self, z: np.ndarray, smoothness: float) -> float:
        """The objective at depths (rows, cols)."""
        return self.evaluate(self.backend.upload(np.asarray(z, np.float32).ravel()), smoothness)

    def irradiances(self, z: np.ndarray) -> list[np.ndarray]:
        """gain E of every image at depths (rows, cols)."""
        self.value(z, 0.0)
        get = self.backend.download
        return [(get(image.gain) * get(image.light).reshape(5, -1)[0]).reshape(self.shape) for image in self.images]

    def aim(self, targets: list[np.ndarray]) -> None:
        """Other targets from here on."""
        for image, target in zip(self.images, targets):
            image.target = self.backend.upload(np.asarray(target, np.float32).ravel())

    def step(self, z: np.ndarray, smoothness: float) -> np.ndarray:
        """The first Gauss-Newton step from depths (rows, cols), which were evaluated last, without a penalty on z itself."""
        self.solve(self.backend.upload(np.asarray(z, np.float32).ravel()), smoothness, 1e-6, 60, 1e-2)
        return self.backend.download(self.x).reshape(self.shape)

    def _pull(self, image, u, unit):
        self._launch("pull", *image.products(), u, self.sum, unit, *self.shape, image.count, dim=(-(-self.pixels // self.backend.lanes),))

    def gradient(self, z, smoothness: float) -> float:
        """Readies a step from z, which must have been evaluated last: r = -gradient, v = r / scale; the length of v."""
        rows, cols = self.shape
        unit = FIXED / max(1e-12, math.sqrt(sum(m[0] for m in self.misfits)))
        for number, image in enumerate(self.images):
            self._launch("misfit", image.light, image.gain, image.target, self.u, self.parts[3], self.pixels)
            self._pull(image, self.u, unit)
            self._launch("diagonal", image.light, image.gain, self.scale, rows, cols, 12 * smoothness + 1e-7, int(number == 0), dim=(cols, rows))
        self._launch("begin", z, self.low, self.high, self.scale, self.sum, self.r, self.v, self.x, self.p, self.s, self.free, self.parts[1], 1 / unit,
                     smoothness, rows, cols)
        return math.sqrt(float(self._total(1)[0]))

    def solve(self, z, smoothness: float, damping: float, most: int, tolerance: float) -> float:
        """Conjugate gradients for a step x from z; what the quadratic model gains by it."""
        rows, cols = self.shape
        length, gain, start, before, alpha = self.gradient(z, smoothness), 0.0, None, None, 0.0
        if length > 0 and len(self.images) == 1 and self.pixels <= self.backend.alone:
            image = self.images[0]
            self._launch("solve", *image.products(), image.gain, self.scale, self.free, self.sum, self.r, self.v, self.w, self.x, self.p, self.s, self.u,
                         self.parts[3], self.gained, length, FIXED, smoothness, damping, tolerance**2, most, rows, cols, image.count, dim=(1,))
            return float(self.backend.download(self.gained)[0])
        for _ in range(most if length > 0 else 0):
            unit = FIXED / length
            for image in self.images:
                self._launch("push", *image.products(), image.gain, self.v, self.u, rows, cols, image.count, dim=(-(-self.pixels // self.backend.lanes),))
                self._pull(image, self.u, unit)
            self._launch("curve", self.r, self.v, self.scale, self.free, self.sum, self.w, self.parts[3], 1 / unit, smoothness, damping, rows, cols)
            product, curvature, square = (float(part) for part in self._total(3))
            start = product if start is None else start
            beta = 0.0 if before is None else product / before
            curvature -= 0.0 if before is None else beta * product / alpha
            if not (product > tolerance**2 * start and curvature > 0):
                break
            alpha, before, length = product / curvature, product, math.sqrt(square)
            self._launch("go", self.scale, self.w, self.r, self.v, self.x, self.p, self.s, alpha, beta, self.pixels)
            gain += 0.5 * alpha * product
        return gain

    def run(self, start: np.ndarray, smoothness: float, steps: int, most: int, tolerance: float = 0.1, settled: float = SETTLED,
            stop: Callable[[], bool] | None = None, damping: float = DAMPING) -> tuple[np.ndarray, float]:
        """Depth (rows, cols) float32 after at most ``steps`` Gauss-Newton steps from ``start``, and the objective there."""
        self.z, value = self.backend.upload(np.asarray(start, np.float32).ravel()), None
        best = self.evaluate(self.z, smoothness)
        self.steps = 0
        for _ in range(steps):
            self.steps += 1
            gain = self.solve(self.z, smoothness, damping, most, tolerance)
            self._launch("move", self.z, self.x, self.low, self.high, self.trial, self.pixels)
            value = self.evaluate(self.trial, smoothness)
            ratio = (best - value) / max(gain, 1e-300)
            if value < best:
                small = best - value < settled * best
                self.z, self.trial, best = self.trial, self.z, value
                damping = max(damping * (0.3 if ratio > 0.5 else 1 if ratio > 0.2 else 3), 1e-6)
                if small:
                    break
            else:
                damping *= 4
                self.evaluate(self.z, smoothness)
                if damping > 1e4:
                    break
            if stop and stop():
                break
        self.damping = damping
        return self.backend.download(self.z).reshape(self.shape), best
