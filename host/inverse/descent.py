"""Depth from irradiance on a device: the forward model with its derivatives, and Gauss-Newton on it
(MODEL.md, 5.2).

The normal equations of a step, (J^T J + lambda D^T D + damping) step = -gradient, are solved by conjugate
gradients, whose products J v and J^T u are gathers and scatters along the horizons that the last evaluation
found: no ray is followed twice. What is scattered, and what decides the length of an iteration's step, is
added in fixed point; other sums are taken block by block in one order, and kernels use correctly rounded
arithmetic alone, so every backend takes the same steps. The state of conjugate gradients stays on the device:
iterations are started some at a time, and do nothing once it says stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..backends.base import Backend
from ..constants import BESIDE, ROOM, SIDES, SUMMED
from ..errors import CapacityError

DAMPING = 1e-4  # of the first step, in the diagonal's unit
SETTLED = 3e-3  # share of the objective below which a step is the last
SLOTS = 32  # places that a sum of whole numbers is spread over; as in opencl/adjoint.cl
LEFT, GAIN, STATE = (
    0,
    7,
    11,
)  # in the state of conjugate gradients: iterations left, what was gained; its length; as there
TILE = 8  # nodes across the squares whose highest point is known; as there
# times as coarse is each of the two grids that precondition than the one before; as in opencl/adjoint.cl
FOUR = 4
BROAD, BROADER = (
    0.075,
    0.125,
    # a coarse node's curvature over the sum of its nodes' diagonal; of the next: as measured, curvature falls as
    # the width to -1.5
)
# weight of what is expected of an albedo that is not known: an albedo off by its own size counts as much as
# an image by this
PULL = 1e-3
MARGIN = 16
NONE = -1e30
FIXED = 2.0**36  # of fixed point, over the length of the vector that is multiplied
FINE = 2.0**30  # of the diagonal's fixed point
EXACT = 2.0**44  # of that of r v, v w and v v, over what they were before


class Light(NamedTuple):
    """A source as the kernels take it, lengths in nodes of this grid.

    azimuths (count, 4): of a sky; nodes (count, 4), frames (pixels, 4), solid: of a lamp or window. table:
    its brightness, (n, knots, 4), or None for 1 everywhere. ball: whether the solid is one.
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
    """One image of the surface on the device: what a source makes of a depth map, and how that changes with
    it.
    """

    def __init__(
        self,
        backend: Backend,
        light: Light,
        shape: tuple[int, int],
        sides: str,
        gain: np.ndarray,
        target: np.ndarray,
    ):
        self.backend, self.shape, self.sides, self.count = backend, shape, SIDES[sides], light.count
        pixels = shape[0] * shape[1]
        if (pixels + ROOM) * self.count >= 2**31:
            raise CapacityError(
                f"An image of {pixels:,} pixels along {self.count} azimuths: more than 2^31 links. Cut it"
                " into tiles."
            )
        backend.reserve(
            pixels * (40 * self.count + 80 + 16 * backend.teams),
            f"Recovering {pixels:,} nodes along {self.count} azimuths",
            "Recover a smaller image.",
        )
        put = lambda array: backend.upload(np.ascontiguousarray(array, np.float32))
        self.is_sky, self.is_ball = light.azimuths is not None, int(light.ball)
        self.ways = put(light.azimuths if self.is_sky else light.nodes)
        self.table = put(np.zeros((1, 4)) if light.table is None else light.table)
        self.knots, self.rows_of_table = (0, 1) if light.table is None else light.table.shape[1::-1]
        if self.is_sky:
            self.numbers, self.slopes = (
                backend.empty((self.count, pixels + ROOM), kind) for kind in (np.int32, np.float32)
            )
        else:
            self.frames, self.solid = put(light.frames), put(light.solid)
        self.gain = put(np.broadcast_to(gain, shape).ravel())
        self.gains = [self.gain] * 2  # with the albedo of the surface and of a trial
        self.target = put(target.ravel())
        room = -(-pixels // BESIDE), self.count, BESIDE
        # light, held, first, second, near, far: of the surface and of a trial
        shapes = (
            ((4, pixels), np.float32),
            ((pixels,), np.int32),
            (room, np.int32),
            (room, np.int32),
            (room, np.float32),
            (room, np.float32),
        )
        self.links = [tuple(backend.empty(*shape) for shape in shapes) for _ in range(2)]

    def evaluate(self, side: int, *surface) -> None:
        """Irradiance and its derivatives at a surface."""
        rows, cols = self.shape
        out = (*self.links[side], rows, cols, MARGIN, self.count)
        if self.is_sky:
            heights, tilts, tiles, top = surface
            each = self.count if self.backend.each > 1 else 1  # azimuths of a work-item
            across = -(-cols // self.backend.lanes)
            self.backend.launch(
                "adjoint",
                "look",
                (across, rows, -(-self.count // each)),
                *surface,
                self.ways,
                self.numbers,
                self.slopes,
                rows,
                cols,
                MARGIN,
                self.count,
                self.sides,
                each,
            )
            self.backend.launch(
                "adjoint",
                "sky",
                (across, rows),
                heights,
                tilts,
                top,
                self.numbers,
                self.slopes,
                self.ways,
                self.table,
                *out,
                self.knots,
                self.sides,
            )
        else:
            self.backend.launch(
                "adjoint",
                "lamp",
                (cols, rows),
                *surface,
                self.frames,
                self.ways,
                self.solid,
                self.table,
                *out,
                self.knots,
                self.rows_of_table,
                self.is_ball,
                self.sides,
                lanes=1,
            )


class Descent:
    """The least-squares problem of one grid: images of one surface, bounds of its depth, smoothness.

    If the albedo is not known the gains stand for albedo 1, and every evaluation takes for each pixel the
    albedo that explains all images best there: the objective is that of the best albedo, and so is its
    gradient (variable projection).

    There are two sides, z[here] and a trial, each with what an evaluation found there: nothing is lost where
    a trial fails.
    """

    def __init__(
        self,
        backend: Backend,
        shape: tuple[int, int],
        sides: str,
        images: list[tuple[Light, np.ndarray, np.ndarray]],
        low,
        high,
        albedo_known: bool = True,
    ):
        rows, cols = shape
        self.backend, self.shape, self.pixels, self.sides = backend, shape, rows * cols, SIDES[sides]
        self.images = [Image(backend, light, shape, sides, gain, target) for light, gain, target in images]
        self.albedo_known = albedo_known
        if not albedo_known:
            self.over, self.share, self.pull, self.usual, *self.unders = (
                backend.empty((self.pixels,), np.float32, PULL) for _ in range(6)
            )
            self.ones, self.found = (backend.empty((1, self.pixels), np.float32, 1) for _ in range(2))
            for image in self.images:
                image.gains = [backend.empty((self.pixels,), np.float32) for _ in range(2)]
        self.heights = backend.empty((rows * (cols + 2 * MARGIN),), np.float32, NONE)
        self.tilts, self.top = backend.empty((2, self.pixels), np.float32), backend.empty((1,), np.int32)
        self.tiles = backend.empty((-(-rows // TILE) * -(-cols // TILE),), np.float32)
        *self.z, self.w, self.p, self.s, self.x = (
            backend.empty((self.pixels,), np.float32) for _ in range(6)
        )
        self.shapes = [
            tuple(-(-size // FOUR**times) for size in shape) for times in range(3)
        ]  # of the grid and of those that precondition
        sizes = [down * across for down, across in self.shapes]
        self.v, self.scale = ([backend.empty((size,), np.float32) for size in sizes] for _ in range(2))
        self.r, self.free = (
            [backend.empty((size,), np.float32, fill) for size in sizes[:-1]] for fill in (None, 1)
        )
        self.rest = backend.empty((self.pixels,), np.float32, 0)
        self.low, self.high = (
            backend.upload(np.broadcast_to(np.asarray(bound, np.float32), shape).ravel())
            for bound in (low, high)
        )
        self.sum, self.squares = (backend.empty((backend.teams, self.pixels), np.int64, 0) for _ in range(2))
        self.blocks, self.each, self.teams = -(-self.pixels // SUMMED), backend.each, backend.teams
        self.of_team = self.each if self.teams == 1 else -(-self.pixels // self.teams)
        self.parts, self.lengths = (
            backend.empty((n, self.blocks), np.float64) for n in (len(images) + 1 + (not albedo_known), 2)
        )
        self.states, self.totals = [
            [backend.empty(shape, dtype) for _ in range(2)]
            for shape, dtype in (((STATE,), np.float64), ((3, SLOTS), np.int64))
        ]
        self.here, self._misfits, self._recorded = 0, [[], []], {}
        self._at = (
            None  # depths (rows, cols) float32 at z[here], if what an evaluation finds there is still at hand
        )

    def _launch(self, kernel, *args, dim=None, **more):
        self.backend.launch("adjoint", kernel, dim or (-(-self.pixels // self.each),), *args, **more)

    def _teams(self) -> tuple[int]:
        return (-(-self.pixels // self.of_team),)

    @property
    def misfits(self) -> list[float]:
        """Of every image the sum of (gain E - target)^2, at z[here]."""
        return self._misfits[self.here]

    def _again(self, work: Callable[[int], None], side: int, times: int = 1) -> None:
        """Does work(side), ``times`` times; from the second call on as the backend has recorded it."""
        key = work.__name__, side
        if key not in self._recorded:
            for _ in range(times):
                work(side)
            self._recorded[key] = None
            return
        if self._recorded[key] is None:
            self._recorded[key] = self.backend.record(lambda: work(side), times)
        self._recorded[key]()

    def _look(self, side: int) -> None:
        rows, cols = self.shape
        z = self.z[side]
        self._launch(
            "surface", z, self.heights, self.tilts, self.top, rows, cols, MARGIN, self.sides, dim=(cols, rows)
        )
        self._launch("tiles", z, self.tiles, self.top, rows, cols, dim=(-(-cols // TILE), -(-rows // TILE)))
        for image in self.images:
            image.evaluate(side, self.heights, self.tilts, self.tiles, self.top)
        self._weigh(side)

    def _weigh(self, side: int) -> None:
        """What an evaluation found, against the targets and the rest of now, with the albedo that is best
        there if it is not known.
        """
        if not self.albedo_known:
            # what is expected of the albedo counts as one more image, whose light is 1
            for light, gain, target, is_first in (
                (self.ones, self.pull, self.usual, True),
                *((image.links[side][0], image.gain, image.target, False) for image in self.images),
            ):
                self._launch(
                    "match",
                    light,
                    gain,
                    target,
                    self.over,
                    self.unders[side],
                    is_first,
                    self.pixels,
                    dim=(self.pixels,),
                )
            for gain, out in (
                (self.ones, self.found),
                *((image.gain, image.gains[side]) for image in self.images),
            ):
                self._launch(
                    "reflect", self.over, self.unders[side], gain, out, self.pixels, dim=(self.pixels,)
                )
            self._launch(
                "misfit",
                self.found,
                self.pull,
                self.usual,
                self.parts,
                (len(self.images) + 1) * self.blocks,
                self.pixels,
                dim=(self.blocks,),
            )
        for number, image in enumerate(self.images):
            self._launch(
                "misfit",
                image.links[side][0],
                image.gains[side],
                image.target,
                self.parts,
                number * self.blocks,
                self.pixels,
                dim=(self.blocks,),
            )
        self._launch(
            "bending",
            self.z[side],
            self.rest,
            self.parts,
            len(self.images) * self.blocks,
            *self.shape,
            dim=(self.blocks,),
        )

    def _try(self, side: int) -> None:
        self._launch(
            "move", self.z[1 - side], self.x, self.low, self.high, self.z[side], self.pixels, self.each
        )
        self._look(side)

    def evaluate(self, side: int, smoothness: float, work: Callable[[int], None] | None = None) -> float:
        """The objective at z[side], or what ``work`` makes of it; the derivatives there are kept."""
        self._again(work or self._look, side)
        sums = self.backend.download(self.parts).sum(1).tolist()
        count = len(self.images)
        self._misfits[side] = sums[:count]
        return 0.5 * (sum(sums[:count]) + smoothness * sums[count] + sum(sums[count + 1 :]))

    def value(self, z: np.ndarray, smoothness: float) -> float:
        """The objective at depths (rows, cols)."""
        z = np.array(z, np.float32)
        if self._at is not None and np.array_equal(z, self._at):
            return self.evaluate(self.here, smoothness, self._weigh)
        self._at = None  # whatever happens
        self.backend.put(self.z[self.here], z.ravel())
        value = self.evaluate(self.here, smoothness)
        self._at = z
        return value

    def irradiances(self, z: np.ndarray) -> list[np.ndarray]:
        """gain E of every image at depths (rows, cols)."""
        self.value(z, 0.0)
        get = self.backend.download
        return [
            (get(image.gains[self.here]) * get(image.links[self.here][0])[0]).reshape(self.shape)
            for image in self.images
        ]

    def expect(self, albedo: float, pull: float = PULL) -> None:
        """From here on, an albedo that is not known is expected to be about this share of what the gains
        stand for; at first 1.
        """
        self.backend.fill(self.pull, pull)
        self.backend.fill(self.usual, pull * albedo)

    def albedo(self) -> np.ndarray:
        """(rows, cols) albedo at the depths that were evaluated last, as a share of what the gains stand for."""
        image, get = self.images[0], self.backend.download
        return (get(image.gains[self.here]) / get(image.gain)).reshape(self.shape)

    def bound(self, low: np.ndarray, high: np.ndarray) -> None:
        """Other bounds of depth from here on."""
        for array, values in ((self.low, low), (self.high, high)):
            self.backend.put(array, np.asarray(values, np.float32).ravel())

    def lean(self, rest: np.ndarray) -> None:
        """From here on, smoothness is of what depth has beyond ``rest`` (rows, cols); at first that is 0."""
        self.backend.put(self.rest, np.asarray(rest, np.float32).ravel())

    def aim(self, targets: list[np.ndarray]) -> None:
        """Other targets from here on."""
        for image, target in zip(self.images, targets):
            self.backend.put(image.target, np.asarray(target, np.float32).ravel())

    def step(self, smoothness: float, most: int, tolerance: float) -> np.ndarray:
        """The first Gauss-Newton step (rows, cols) from the depths that were evaluated last, without a
        penalty on depth itself.
        """
        self.solve(smoothness, 1e-6, most, tolerance)
        return self.backend.download(self.x).reshape(self.shape)

    def gradient(self, smoothness: float) -> tuple[float, float]:
        """Readies a step from z[here], which must have been evaluated: r = -gradient, v = r preconditioned;
        gives v v and r v.
        """
        unit = FIXED / max(1e-12, math.sqrt(sum(self.misfits)))
        for image in self.images:
            self._launch(
                "downhill",
                *image.links[self.here],
                image.gains[self.here],
                image.target,
                self.sum,
                self.squares,
                unit,
                FINE,
                *self.shape,
                image.count,
                self.of_team,
                self.teams,
                dim=self._teams(),
            )
        self._launch(
            "begin",
            self.z[self.here],
            self.rest,
            self.low,
            self.high,
            self.sum,
            self.squares,
            self.scale[0],
            self.r[0],
            self.x,
            self.p,
            self.s,
            self.free[0],
            1 / unit,
            1 / FINE,
            12 * smoothness + 1e-7,
            smoothness,
            *self.shape,
            self.each,
            self.teams,
        )
        self._again(self._first, 0)  # the same for both sides
        return tuple(self.backend.download(self.lengths).sum(1).tolist())

    def _first(self, side: int) -> None:
        """The scales of the coarser grids, and the first v with its lengths."""
        self._down(0, self.scale[0], self.scale[1], BROAD)
        self._down(1, self.scale[1], self.scale[2], BROADER)
        self._precondition()
        self._launch("lengths", self.r[0], self.v[0], self.lengths, self.pixels, dim=(self.blocks,))

    def _down(self, level: int, fine, to, times: float = 1.0, over=None) -> None:
        """to = times what a grid brings down to the next, over ``over`` if given."""
        rows, cols = self.shapes[level + 1]
        self._launch(
            "down",
            fine,
            to if over is None else over,
            to,
            times,
            over is not None,
            *self.shapes[level],
            dim=(cols, rows),
        )

    def _precondition(self) -> None:
        """v = r / scale, and the same on the coarser grids."""
        self._down(0, self.r[0], self.r[1])
        self._down(1, self.r[1], self.v[2], over=self.scale[2])
        for level in (1, 0):
            dim = (
                self.shapes[level + 1][1],
                self.shapes[level][0],
            )  # a work-item does what lies in one coarse node of a row
            self._launch(
                "up",
                self.r[level],
                self.scale[level],
                self.free[level],
                self.v[level + 1],
                self.v[level],
                *self.shapes[level],
                dim=dim,
            )

    def solve(self, smoothness: float, damping: float, most: int, tolerance: float) -> float:
        """Conjugate gradients for a step x from z[here]; what the quadratic model gains by it."""
        square, product = self.gradient(smoothness)
        if not product > 0:
            return 0.0
        state = self.states[0]
        self._launch(
            "ready",
            state,
            self.totals[0],
            square,
            product,
            smoothness,
            damping,
            tolerance**2,
            FIXED,
            EXACT,
            most,
            dim=(1,),
        )
        if len(self.images) == 1 and self.pixels <= self.backend.alone:
            image = self.images[0]
            self._launch(
                "solve",
                *image.links[self.here],
                image.gains[self.here],
                *self.scale,
                *self.free,
                self.sum,
                *self.r,
                *self.v,
                self.w,
                self.x,
                self.p,
                self.s,
                state,
                FIXED,
                EXACT,
                *self.shape,
                image.count,
                dim=(1,),
            )
            return float(self.backend.download(state)[GAIN])
        left = most
        while left > 0:
            self._again(self._two_iterations, self.here, self.backend.ahead)
            left, gain = self.backend.download(state)[[LEFT, GAIN]].tolist()
        return gain

    def _product(self, side: int, state) -> None:
        """sum += unit transpose(J) gain^2 J v, over all images; less what the albedo that is best makes up
        for, if it is not known (Kaufman 1975).
        """
        rest = self.v[0], self.sum, state, *self.shape
        if self.albedo_known:
            for image in self.images:
                self._launch(
                    "product",
                    *image.links[side],
                    image.gains[side],
                    *rest,
                    image.count,
                    self.of_team,
                    self.teams,
                    dim=self._teams(),
                )
            return
        for number, image in enumerate(self.images):
            self._launch(
                "change",
                *image.links[side],
                image.gains[side],
                image.gain,
                self.v[0],
                self.share,
                state,
                *self.shape,
                image.count,
                number == 0,
                self.each,
            )
        for image in self.images:
            self._launch(
                "product_beside",
                *image.links[side],
                image.gains[side],
                image.gain,
                self.share,
                self.unders[side],
                *rest,
                image.count,
                self.of_team,
                self.teams,
                dim=self._teams(),
            )

    def _two_iterations(self, side: int) -> None:
        """Of conjugate gradients, from one state to the other and back."""
        for now, then in ((0, 1), (1, 0)):
            self._product(side, self.states[now])
            self._launch(
                "curve",
                self.r[0],
                self.v[0],
                self.scale[0],
                self.free[0],
                self.sum,
                self.w,
                self.totals[now],
                self.states[now],
                *self.shape,
                self.each,
                self.teams,
            )
            self._launch(
                "go",
                self.v[0],
                self.w,
                self.r[0],
                self.x,
                self.p,
                self.s,
                self.totals[now],
                self.totals[then],
                self.states[now],
                self.states[then],
                FIXED,
                EXACT,
                self.pixels,
                self.each,
            )
            self._precondition()

    def run(
        self,
        start: np.ndarray,
        smoothness: float,
        steps: int,
        most: int,
        tolerance: float = 0.1,
        settled: float = SETTLED,
        stop: Callable[[], bool] | None = None,
        damping: float = DAMPING,
    ) -> tuple[np.ndarray, float]:
        """Depth (rows, cols) float32 after at most ``steps`` Gauss-Newton steps from ``start``, and the
        objective there.
        """
        best = self.value(start, smoothness)
        self.steps, self._at = 0, None
        for _ in range(steps):
            self.steps += 1
            gain = self.solve(smoothness, damping, most, tolerance)
            trial = 1 - self.here
            value = self.evaluate(trial, smoothness, self._try)
            ratio = (best - value) / max(gain, 1e-300)
            if value < best:
                small = best - value < settled * best
                self.here, best = trial, value
                damping = max(damping * (0.3 if ratio > 0.5 else 1 if ratio > 0.2 else 3), 1e-6)
                if small:
                    break
            else:
                damping *= 4
                if damping > 1e4:
                    break
            if stop and stop():
                break
        self.damping = damping
        self._at = self.backend.download(self.z[self.here]).reshape(self.shape)
        return self._at.copy(), best
