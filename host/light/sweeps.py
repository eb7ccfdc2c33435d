"""Sweeps for horizons, and for the light of a sky above them: the tables that kernels are handed, and their
sequence.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..backends import select
from ..backends.base import Backend, scratch
from ..backends.resident import Resident
from ..checks import positive_number
from ..constants import MOST_PIXELS, SIDES
from ..errors import CapacityError, bad
from ..scene import Scene, is_scene

# rows within which every crossing is tested; with 12 from MANY azimuths on, where the sum is that exact
NEAR = 6
FINE, MANY = 12, 128
LADDER = 16  # slopes of the ladder, as in opencl/horizon.cl
OUTSIDE, MASKED = np.float32(-1e30), np.float32(-2e30)  # heights where there is no ground
NEVER = 1 << 30  # a window that no line fills
SLOPES, UNIFORM, TABLE = range(3)  # what a sweep does with the horizon
BLOCK = 64  # rows of a column that are summed in float32 before they are in float64
PROBED = 1024  # nodes from which the steepest rise and fall are looked for
FAINTEST = 0.01  # slope below which ground of a map that repeats is not looked for: at most 5e-5 of E / pi


class Ground(NamedTuple):
    """A map as sweeps see it: heights (rows, cols) float32 in spacings above z = 0, -inf where masked; reach
    in spacings.

    Or a depth map that lies on the device, and ``step``, the spacing in its unit.
    """

    heights: np.ndarray | Resident
    sides: str
    reach: float = math.inf
    step: float = 1.0


class Rays(NamedTuple):
    """Azimuths [rad] and their widths [rad], each (K,)."""

    angles: np.ndarray
    widths: np.ndarray


class Half(NamedTuple):
    """One of the two maps, as it lies or turned, with the azimuths that go from row to row in it; sorted by
    window.
    """

    turned: bool
    rows: int
    cols: int
    numbers: np.ndarray  # of its azimuths
    windows: np.ndarray
    warm: int
    shears: np.ndarray
    tables: list  # on the device: azimuths, ways, near_at, near_weight
    heights: object
    tilts: object
    table: object


class Sweeps:
    """A map on a device, ready to be swept; ``light`` and ``slopes`` may be repeated (and timed)."""

    def __init__(
        self,
        backend: Backend,
        ground: Ground,
        rays: Rays | None = None,
        table: np.ndarray | None = None,
        near: int | None = None,
        level: bool = False,
    ):
        """``table`` (K, knots, 4) float32: brightness, see opencl/horizon.cl; uniform, of brightness 1,
        unless given. ``level``: light falls on a level element at every node, not on the surface. Without
        ``rays`` it waits for ``aim``, and what all aims share is made once and kept.
        """
        self.level, self.kept, self.made = level, rays is None, set()
        self.backend, self.ground = backend, ground._replace(heights=None)  # the device has the heights
        rows, cols = self.shape = ground.heights.shape
        if rows * cols > MOST_PIXELS:
            raise CapacityError(
                f"A map of {rows * cols:,} nodes; at most {MOST_PIXELS:,}, since kernels count nodes in 32"
                " bits. Cut it into tiles."
            )
        self.near = near or (FINE if rays is not None and len(rays.angles) >= MANY else NEAR)
        self.margin = self.near + backend.lanes + 3
        backend.reserve(
            32 * (rows + 2 * self.margin) * (cols + 2 * self.margin),
            f"A map of {rows} x {cols} nodes",
            "Cut it into tiles.",
        )
        self.room = (rows + 2 * self.margin) * (cols + 2 * self.margin)
        every, first = max(1, math.isqrt(rows * cols // PROBED)), self.near + 1
        if isinstance(ground.heights, Resident):
            here, step = ground.heights, np.float32(ground.step)
            self.lowest, highest = (float(-(np.float32(depth) / step)) for depth in (here.most, here.least))
            self.heights = here.padded(self.margin, ground.step, ground.sides, OUTSIDE)
            self.steepest = _steepest(here.probe(self.heights, self.margin, every, first))
        else:
            self.lowest, highest = float(ground.heights.min()), float(ground.heights.max())
            if self.lowest == -np.inf:  # masked somewhere
                self.lowest = float(ground.heights.min(where=ground.heights > -np.inf, initial=np.inf))
            self.heights = backend.upload(_padded(ground, self.margin))
            self.steepest = _steepest(_probe(ground.heights, every, first))
        self.relief = highest - self.lowest
        self.turned = backend.empty((self.room,), np.float32)
        level_ground = 0 if level else None  # else the kernel `tilt` writes them
        self.tilts = [
            backend.empty((2, self.room), np.float32, level_ground)
        ]  # on a GPU both maps are swept at the same time
        self.tilts.append(
            backend.empty((2, self.room), np.float32, level_ground)
            if backend.lines > 1 or self.kept
            else self.tilts[0]
        )
        self.nothing = backend.empty((4,), np.float32)
        if rays is not None:
            self.aim(rays, table)

    # -- what is asked of it

    def aim(self, rays: Rays, table: np.ndarray | None = None) -> None:
        """Sweep along other azimuths from now on, with other brightness."""
        self.rays, self.what, self.knots = (
            rays,
            UNIFORM if table is None else TABLE,
            2 if table is None else table.shape[1],
        )
        self.unit = self._unit(table)
        self.halves = [self._half(turned, table) for turned in (False, True)]

    def add_light(self, table: np.ndarray, image) -> None:
        """Add to an irradiance on the device what ``table`` (side, side) float32 [brightness x sr] has for
        every node's normal; see the kernel ``correct``. After ``light``, which leaves the tilts of the map as
        it lies.
        """
        rows, cols = self.shape
        given = self.backend.upload(table)
        self.backend.launch(
            "ground",
            "correct",
            (cols, rows),
            self.tilts[0],
            given,
            image,
            rows,
            cols,
            self.margin,
            self.room,
            len(table),
            1.0,
        )
        self.backend.finish()  # the table may go

    def judge(self, image, half, limit: float) -> tuple[float, float, int, int, int]:
        """(sum of an image, sum of the squares of half a difference, valid nodes, lit nodes, nodes where half
        the difference passes ``limit``).
        """
        rows, cols = self.shape
        blocks = -(-rows // BLOCK)
        found = self.backend.empty((5, blocks, cols), np.float32)
        self.backend.launch(
            "ground",
            "judge",
            (cols, blocks),
            self.heights,
            image,
            half,
            found,
            rows,
            cols,
            self.margin,
            BLOCK,
            float(limit),
        )
        light, square, *counts = self.backend.download(found).reshape(5, -1).sum(1, dtype=np.float64).tolist()
        return light, square, *map(int, counts)

    def light(self, total, turned, image=None) -> None:
        """Irradiance float32 [brightness x sr] into the device array ``image``, or into ``total``; both
        others (rows x cols) int32, for sums on the way.
        """
        backend = self.backend
        self._turn()
        backend.fill(total, 0)
        backend.fill(turned, 0)
        with backend.beside():
            self._light_of(self.halves[1], turned)
        self._light_of(self.halves[0], total)
        backend.join()
        self._gather(total, turned, total if image is None else image)

    def _gather(self, total, turned, image):
        rows, cols = self.shape
        self.backend.launch("ground", "gather", (cols, rows), total, turned, image, rows, cols, 1 / self.unit)

    def _light_of(self, half: Half, sums) -> None:
        backend, around = self.backend, 2 * self.margin
        if not self.level and half.turned not in self.made:
            backend.launch(
                "ground",
                "tilt",
                (half.cols + around, half.rows + around),
                half.heights,
                half.tilts,
                half.rows,
                half.cols,
                self.margin,
                self.room,
                int(self.ground.sides == "periodic"),
            )
        if self.kept:
            self.made.add(half.turned)
        for first, count in self._batches(half, 1 if backend.lines == 1 else NEVER):
            scratch = self.nothing
            if half.windows[first] < NEVER:
                scratch = backend.empty((count, half.rows * half.cols), np.float32)
                self._sweep(half, first, count, SLOPES, False, True, scratch, sums)
            self._sweep(half, first, count, self.what, half.windows[first] < NEVER, False, scratch, sums)

    def irradiance(self, last: bool = False) -> np.ndarray:
        """Irradiance (rows, cols) float32 [brightness x sr]. ``last``: nothing is asked afterwards, so what
        has been swept may go.
        """
        backend, size = self.backend, (math.prod(self.shape),)
        turned = backend.empty(size, np.int32, 0)
        if backend.lines > 1 or not last:
            total = backend.empty(size, np.int32, 0)
            self.light(total, turned)
            return backend.download(total).view(np.float32).reshape(self.shape)
        self._turn()
        self._light_of(self.halves.pop(), turned)
        backend.finish()
        self.turned = None
        total = backend.empty(size, np.int32, 0)
        self._light_of(self.halves.pop(), total)
        self._gather(total, turned, total)
        backend.finish()
        del self.heights, self.tilts, turned
        return backend.download(total).view(np.float32).reshape(self.shape)

    def slopes(self) -> np.ndarray:
        """Horizon slopes (K, rows, cols) float32."""
        out = np.empty((len(self.rays.angles), *self.shape), np.float32)
        for numbers, found in self.planes():
            out[numbers] = found
        return out

    def planes(self):
        """Yields (numbers of azimuths, their horizon slopes (n, rows, cols) float32), a few azimuths at a
        time.
        """
        backend = self.backend
        rows, cols = self.shape
        most = max(1, int(min(backend.memory // 4, 2**30) // (8 * rows * cols)))
        self._turn()
        for half in self.halves:
            for first, count in self._batches(half, most):
                planes = backend.empty((count, half.rows * half.cols), np.float32)
                known = False
                for falling in (False, True):
                    for backward in (True, False) if half.windows[first] < NEVER else (False,):
                        self._sweep(
                            half, first, count, SLOPES, known, backward, planes, self.nothing, falling
                        )
                        known = True
                found = backend.download(planes).reshape(count, half.rows, half.cols)
                yield half.numbers[first : first + count], found.transpose(0, 2, 1) if half.turned else found

    # -- how

    def _turn(self):
        if "map" in self.made:
            return
        if self.kept:
            self.made.add("map")
        rows, cols = (n + 2 * self.margin for n in self.shape)
        self.backend.launch("ground", "turn", (rows, cols), self.heights, self.turned, rows, cols)

    def _batches(self, half: Half, most: int):
        """(first, count) of azimuths that are swept together: those of one window, at most ``most``."""
        first = 0
        while first < len(half.numbers):
            count = min(most, int((half.windows[first:] == half.windows[first]).sum()))
            yield first, count
            first += count

    def _sweep(
        self,
        half: Half,
        first: int,
        count: int,
        what: int,
        known: bool,
        backward: bool,
        slopes,
        sums,
        falling=False,
    ):
        backend = self.backend
        comes_at = int(half.windows[first]) if backward else self.near + 1
        span = half.rows + half.warm + self.near + 2
        bits, unit, steps, rises = ladder(self.steepest[falling], self.relief, span, comes_at)
        overhang = (
            0
            if self.ground.sides == "periodic"
            else math.ceil(np.abs(half.shears[first : first + count]).max() * half.rows) + 1
        )
        lines = backend.lanes * backend.strips * backend.lines
        groups = -(-(half.cols + overhang) // lines)
        backend.launch(
            "horizon",
            "sweep",
            (backend.lines, count, groups),
            half.heights,
            half.tilts,
            *half.tables,
            half.table,
            slopes,
            sums,
            steps,
            rises,
            first,
            backend.lines,
            half.rows,
            half.cols,
            self.margin,
            self.room,
            self.knots,
            bits,
            self.lowest,
            unit,
            int(known),
            int(backward),
            group=backend.lines,
            NEAR=self.near,
            SIDES=SIDES[self.ground.sides],
            WHAT=what,
            BLOCKS=int(half.windows[first] < NEVER),
        )

    def _unit(self, table) -> float:
        """What one of irradiance counts in fixed point: no sum passes 2^30."""
        most = np.ones(len(self.rays.widths)) if table is None else np.hypot(table[:, 0, 0], table[:, 0, 1])
        return 2.0**30 / max(
            float(most @ self.rays.widths), 1e-20
        )  # what a float32 still holds under a black sky

    def _half(self, turned: bool, table) -> Half:
        ground, near, put = self.ground, self.near, self.backend.upload
        rows, cols = self.shape[:: -1 if turned else 1]
        cosine, sine = np.cos(self.rays.angles), np.sin(self.rays.angles)
        numbers = np.flatnonzero((np.abs(cosine) > np.abs(sine)) == turned)
        across, along = (sine, cosine) if turned else (cosine, sine)
        reach = np.maximum(ground.reach * np.abs(along[numbers]), 1e-3)
        windows = np.where(
            (reach < rows + cols) | ((ground.sides == "periodic") & np.isfinite(reach)),
            np.maximum(reach, 1),
            NEVER,
        ).astype(np.int64)
        order = np.argsort(windows, kind="stable")
        numbers, windows, reach = numbers[order], windows[order], reach[order]
        warm = 0
        if ground.sides == "periodic":
            warm = (
                math.ceil(max(rows, cols, self.relief / FAINTEST))
                if math.isinf(ground.reach)
                else math.ceil(ground.reach) + 1
            )
        azimuths, ways = np.zeros((len(numbers), 8)), np.zeros((len(numbers), 8), np.int32)
        columns = near - 1  # as in opencl/horizon.cl
        near_at, near_weight = (
            np.zeros((len(numbers), near + columns, 2), np.int32),
            np.zeros((len(numbers), near + columns)),
        )
        shears = np.zeros(len(numbers))
        for n, (k, far) in enumerate(zip(numbers, reach)):
            a, b = across[k], along[k]
            towards, shear = (1 if b < 0 else -1), a / abs(b)
            shear = (
                0.0
                if abs(shear) < 1e-8
                else math.copysign(1.0, shear)
                if abs(abs(shear) - 1) < 1e-12
                else shear
            )
            steepness, shears[n] = abs(shear), shear
            near_columns = min(columns, math.floor(min(near, far) * steepness + 1e-9))
            ways[n, :5] = towards, math.floor(min(near, far) + 1e-9), near_columns, warm, windows[n]
            azimuths[n, :7] = (
                shear,
                a,
                b,
                abs(b),
                self.rays.widths[k] * self.unit,
                1 / steepness if steepness else 1e9,
                min(far, 1e30),
            )
            for e in range(near):
                x = math.floor((e + 1) * shear)
                near_at[n, e], near_weight[n, e] = (x, e + 1), (e + 1) * shear - x
                if e < near_columns:
                    y = math.floor((e + 1) / steepness)
                    near_at[n, near + e], near_weight[n, near + e] = (
                        (math.copysign(e + 1, shear), y),
                        (e + 1) / steepness - y,
                    )
        near_weight = near_weight.astype(np.float32)
        tables = (
            [put(array) for array in (azimuths.astype(np.float32), ways, near_at, near_weight)]
            if len(numbers)
            else []
        )
        table = (
            self.nothing
            if table is None or not len(numbers)
            else put(np.ascontiguousarray(table[numbers], np.float32))
        )
        return Half(
            turned,
            rows,
            cols,
            numbers,
            windows,
            warm,
            shears,
            tables,
            self.turned if turned else self.heights,
            self.tilts[turned],
            table,
        )


def ladder(
    steepest: float, relief: float, span: int, comes_at: int
) -> tuple[int, float, list[int], list[int]]:
    """(bits, unit, steps, rises): slopes from level to ``steepest`` [per row], denser near level, in the
    kernels' integers.

    An integer holds a height above a ray in units of 1 / unit, and below it in ``bits`` bits a distance up to
    ``span`` rows.
    """
    bits = max(1, math.ceil(math.log2(max(span, comes_at) + 2)))
    slopes = np.tan(np.linspace(0, 1, LADDER) ** 1.5 * math.atan(steepest))
    slopes = slopes if steepest > 0 else slopes[::-1]
    high = relief + (steepest * comes_at if steepest > 0 else -steepest * span)
    unit = (2.0 ** (30 - bits) - 2 * LADDER) / max(high, 1e-6)
    steps = (np.rint(slopes * unit).astype(np.int64) << bits) - 1
    return bits, unit, steps.tolist(), ((steps + 1) * comes_at).tolist()


def _padded(ground: Ground, margin: int) -> np.ndarray:
    if ground.sides == "periodic":
        heights = np.pad(np.maximum(ground.heights, np.float32(MASKED)), margin, "wrap")
    else:
        heights = scratch(tuple(n + 2 * margin for n in ground.heights.shape))
        heights.fill(OUTSIDE)
        np.maximum(ground.heights, np.float32(MASKED), out=heights[margin:-margin, margin:-margin])
    return heights.ravel()


def _probe(heights: np.ndarray, every: int, distance: int) -> np.ndarray:
    """Steepest slopes (8, samples) to ground at ``distance`` and farther, from every ``every``-th node; -inf
    where none lies.
    """
    own = heights[::every, ::every]
    down, across = own.shape
    own = np.where(np.isfinite(own), own, np.inf)  # to masked ground all falls
    best = np.full((8, down, across), -np.inf)
    while distance < max(heights.shape):
        for found, (i, j) in zip(
            best, ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
        ):
            y, x = (
                -(min(0, move * distance) // every) for move in (j, i)
            )  # the first node whose neighbour lies on the map
            there = heights[y * every + j * distance :: every, x * every + i * distance :: every][
                : max(0, down - y), : max(0, across - x)
            ]
            some = np.s_[y : y + there.shape[0], x : x + there.shape[1]]
            found[some] = np.fmax(found[some], (there - own[some]) / distance)
        distance = distance * 5 // 4 + 1
    return best.reshape(8, -1)


def _steepest(best: np.ndarray) -> tuple[float, float]:
    """Slopes [per row] of the steepest rise and fall to ground that is not near, but for one node in a
    thousand.
    """
    best = best[np.isfinite(best)].astype(np.float64)
    if not best.size:
        return 0.1, -0.1
    return max(0.1, 1.1 * float(np.quantile(best, 0.999))), min(-0.1, 1.1 * float(np.quantile(best, 0.001)))


def engine_of(scene: Scene, backend: str) -> Backend:
    """The backend of this name; ``auto`` stays on the GPU on which the scene's depth lies."""
    is_scene(scene)
    there = scene.resident.backend.name if scene.resident is not None else ""
    return select(there if backend == "auto" and there.startswith("warp:cuda") else backend)


def ground_of(scene: Scene, max_distance: float | None, engine: Backend) -> Ground:
    """The map that sweeps on ``engine`` need, heights in spacings above the viewer's plane; where it lies
    there, it stays there.
    """
    reach = np.inf if max_distance is None else positive_number(max_distance, "max_distance") / scene.spacing
    if reach < 1:
        raise bad("max_distance", max_distance, f"at least one spacing, {scene.spacing:g}")
    if scene.resident is not None and scene.resident.backend is engine:
        return Ground(scene.resident, scene.sides, reach, scene.spacing)
    values, step = scene.lattice()
    return Ground(np.divide(values, np.float32(-step), out=scratch(values.shape)), scene.sides, reach)
