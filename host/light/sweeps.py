"""Launch sequence of sweeps, for horizons and for the light of a sky above them, and the kernels' tables."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..arrays import by_bands, scratch
from ..backends import select
from ..backends.base import Array, Backend, reserve, reserve_map
from ..backends.resident import DeviceImage, Resident
from ..backends.staging import fetch
from ..checks import positive_number
from ..constants import ANGLES, LADDER, LEAST_SEARCHED_SLOPE, SIDES, SLOPES, TABLE, UNIFORM
from ..errors import CapacityError, bad
from ..scene import Scene, check_scene
from .far import Far, marched

# rows within which every crossing is tested; FINE_NEAR_ROWS from MANY_AZIMUTHS on, where the sum over all
# azimuths is that exact
NEAR_ROWS, FINE_NEAR_ROWS, MANY_AZIMUTHS = 6, 12, 128
# [spacing], height of masked nodes: not above NONE, and finite, since kernels interpolate and 0 x inf is NaN
MASKED_HEIGHT = -2e30
MOST_DISTANCE_BITS = 24  # of a ladder's integers; six are left for heights then
ENDLESS_WINDOW = 1 << 30  # [rows], a window longer than any line
# of a device that the sweeps of a tile take [byte], so that a tile of 8192 x 8192 nodes and the driver are
# within 3 GB; of that, arrays of a map: the map, padded, turned, its two tilts and a sum
TILE_BYTES, TILE_ARRAYS = 24 * 10**8, 6
NODE_BYTES, TILT_BYTES = 36, 8  # that sweeps take for a node on a device, and of these, one array of tilts
# [byte] of horizon slopes on a device at a time; chosen: eight azimuths of 4096 x 4096 nodes, which occupy a
# GPU
MOST_PLANES = 2**30
PROBED_NODES = 1024  # nodes from which the steepest rise and fall are searched for


class Ground(NamedTuple):
    """A map on a device for sweeps, and how far they look [spacing]."""

    map: Resident
    sides: str
    reach: float = math.inf


class Rays(NamedTuple):
    """Azimuths [rad], their widths [rad], and the number of the sum to which each adds; each (K,).

    Without ``numbers`` there is one sum.
    """

    angles: np.ndarray
    widths: np.ndarray
    numbers: np.ndarray | None = None

    @property
    def sums(self) -> np.ndarray:
        """The number of the sum of every azimuth."""
        return np.zeros(len(self.angles), int) if self.numbers is None else self.numbers


class Half(NamedTuple):
    """One of the two maps, as it lies or turned, with the azimuths that go from row to row in it.

    Azimuths are in order of their windows.
    """

    turned: bool
    rows: int
    cols: int
    numbers: np.ndarray  # of its azimuths
    windows: np.ndarray
    warm: int
    shears: np.ndarray
    tables: list[Array]  # on the device: azimuths, ways, near_at, near_weight
    heights: Array
    tilts: Array
    brightness: Array
    asked: tuple[int, ...]  # see opencl/horizon.cl


class Sweeps:
    """A map on a device, to be swept; ``light`` and ``slopes`` may be repeated."""

    rays: Rays
    what: int
    knots: int
    scales: list[float]  # of every sum
    halves: list[Half]

    def __init__(
        self,
        backend: Backend,
        ground: Ground,
        rays: Rays | None = None,
        table: np.ndarray | None = None,
        near: int | None = None,
        level: bool = False,
        far: Far | None = None,
        angles: bool = False,
    ):
        """``table`` (K, knots, 4) float32: brightness, see opencl/horizon.cl; by default uniform, 1.

        ``level``: light falls on a level element at every node, not on the surface. Without ``rays``,
        ``set_azimuths`` gives them, and the arrays that all sets of azimuths share are computed once.
        ``far``: the map is a tile of a larger one, with ground around it; slopes are known from there.
        ``angles``: the sums are those of angles from the zenith to the horizon [rad] in place of light.
        """
        self.level, self.angles, self.kept = level or angles, angles, rays is None
        self.map_turned, self.tilted = False, [False, False]  # which of these arrays have been computed
        self.backend, self.sides, self.reach = backend, ground.sides, ground.reach
        rows, cols = self.shape = ground.map.shape
        many = rays is not None and len(rays.angles) >= MANY_AZIMUTHS
        self.near = near or (FINE_NEAR_ROWS if many else NEAR_ROWS)
        self.margin = self.near + backend.lanes + 3
        self.room = (rows + 2 * self.margin) * (cols + 2 * self.margin)
        reserve_map(backend, self.room, NODE_BYTES * self.room, TILT_BYTES * self.room)
        every, first = max(1, math.isqrt(rows * cols // PROBED_NODES)), self.near + 1
        self.map = here = ground.map
        m = self.margin
        self.lowest, highest = here.heights_range
        self.heights = here.heights(m, m, m, m, MASKED_HEIGHT, self.sides == "periodic")
        probed = "steepest", self.sides, m
        if probed not in here.derived:
            here.derived[probed] = _steepest(here.probe(self.heights, m, every, first))
        self.steepest = here.derived[probed]
        self.relief = highest - self.lowest
        self.far = None if far is None else marched(here, far)
        self.asked = (0, rows, 0, cols) if far is None else far.asked(self.shape)
        self.turned = backend.empty((self.room,), np.float32)
        level_ground = 0 if level else None  # else the kernel `tilt` writes them
        # on a GPU both maps are swept at the same time, but for tiles, which are short of memory
        separate = 2 if backend.lines > 1 and far is None or self.kept else 1
        tilts = [backend.empty((2, self.room), np.float32, level_ground) for _ in range(separate)]
        self.tilts = tilts[0], tilts[-1]
        self.nothing = backend.empty((4,), np.float32)
        if rays is not None:
            self.set_azimuths(rays, table)

    def set_azimuths(self, rays: Rays, table: np.ndarray | None = None) -> None:
        """Set the azimuths and the brightness of the next sweeps."""
        self.rays = rays
        self.what, self.knots = (UNIFORM, 2) if table is None else (TABLE, table.shape[1])
        self.what = ANGLES if self.angles else self.what
        self.scales = _fixed_point_scales(rays, table, np.pi if self.angles else 1.0)
        self.halves = [self._half(turned, table) for turned in (False, True)]

    def correct(self, table: np.ndarray, image: Array) -> None:
        """Multiply an image on the device by the value of ``table`` for every node's normal.

        ``table`` (side, side) float32, see the kernel ``correct``. ``light`` comes before it and computes the
        tilts.
        """
        rows, cols = self.shape
        given = self.backend.table(table)
        maps, size = (self.tilts[0], given, image), (rows, cols, self.margin, self.room, len(table))
        self.backend.launch("ground", "correct", (cols, rows), *maps, *size)
        self.backend.finish()  # the table may be freed

    def light(self, total: Array, turned: Array, *images: Array) -> None:
        """Irradiance float32 [brightness x sr] of every sum into a device array.

        ``total`` and ``turned`` (sums, rows x cols) int32 hold the sums of the two maps.
        """
        backend = self.backend
        self._turn()
        backend.fill(total, 0)
        backend.fill(turned, 0)
        with backend.overlapped() if self.far is None else contextlib.nullcontext():
            self._light_of(self.halves[1], turned)
        self._light_of(self.halves[0], total)
        backend.join()
        self._gather(total, turned, *images)

    def _gather(self, total: Array, turned: Array, *images: Array) -> None:
        rows, cols = self.shape
        for n, (image, scale) in enumerate(zip(images, self.scales)):
            size = rows, cols, n, 1 / scale
            self.backend.launch("ground", "gather", (cols, rows), total, turned, image, *size)

    def _light_of(self, half: Half, sums: Array) -> None:
        backend, around = self.backend, 2 * self.margin
        if not self.level and not self.tilted[half.turned]:
            dim, size = (
                (half.cols + around, half.rows + around),
                (half.rows, half.cols, self.margin, self.room),
            )
            backend.launch(
                "ground", "tilt", dim, half.heights, half.tilts, *size, int(self.sides == "periodic")
            )
        self.tilted[half.turned] = self.kept
        slopes = None  # the next azimuths' slopes where these are: the launches come one after another
        for first, count in _batches(half, _at_once(self)):
            slopes, known = _far_slopes(self, half, first, count, slopes)
            if half.windows[first] < ENDLESS_WINDOW:
                if not known:
                    slopes = backend.empty((count, half.rows * half.cols), np.float32)
                self._sweep(half, first, count, SLOPES, known, True, slopes, sums, self.angles)
                known = True
            self._sweep(half, first, count, self.what, known, False, slopes, sums, self.angles)

    def image(self) -> DeviceImage:
        """Irradiance (rows, cols) float32 [brightness x sr] on the device."""
        pixels = math.prod(self.shape)
        total, turned = (self.backend.empty((1, pixels), np.int32) for _ in range(2))
        image = self.backend.empty((pixels,), np.float32)
        self.light(total, turned, image)
        return DeviceImage(self.backend, image, self.shape, held=self)

    def irradiance(self) -> np.ndarray:
        """Irradiance (rows, cols) float32 [brightness x sr]; arrays are released, and it is the last call."""
        backend, size = self.backend, (1, math.prod(self.shape))
        if backend.lines > 1 and self.far is None:
            return np.asarray(self.image())
        turned = backend.empty(size, np.int32, 0)
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
        out = scratch((len(self.rays.angles), *self.shape))
        for half, numbers, planes in self._planes():
            if self.backend.shares:  # half of the planes are turned back here, on all cores
                for number, plane in zip(numbers, _fetched(self, half, numbers, planes)):
                    by_bands(functools.partial(_copy_rows, out[number], plane), self.shape)
                continue
            if half.turned:
                size, turned = (half.rows, half.cols, len(numbers)), planes
                planes = self.backend.empty(turned.shape, np.float32)
                self.backend.launch("ground", "turn", size, turned, planes, *size)
            fetch(self.backend, planes, [out[number] for number in numbers])
        return out

    def device_slopes(self) -> DeviceImage:
        """Horizon slopes (K, rows, cols) float32 on the device, nan where the map is masked."""
        backend, (rows, cols), count = self.backend, self.shape, len(self.rays.angles)
        reserve(backend, 4 * count * rows * cols, f"{count} horizons", "Ask for fewer azimuths.")
        planes = backend.empty((count, rows * cols), np.float32)
        for half, numbers, slopes in self._planes():
            given = backend.table(numbers.astype(np.int32))
            size = rows, cols, len(numbers), int(half.turned)
            dim = cols, rows, len(numbers)
            backend.launch("ground", "place", dim, slopes, self.map.depth, given, planes, *size)
            backend.finish()  # the slopes may be freed
        return DeviceImage(backend, planes, (count, rows, cols))

    def planes(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield (numbers of azimuths, their horizon slopes (n, rows, cols) float32), a few at a time."""
        for half, numbers, planes in self._planes():
            yield numbers, _fetched(self, half, numbers, planes)

    def _planes(self) -> Iterator[tuple[Half, np.ndarray, Array]]:
        """Yield (half, numbers of azimuths, their horizon slopes on the device), a few at a time."""
        backend = self.backend
        rows, cols = self.shape
        # of 4 bytes, in both halves, and each turned back
        most = max(1, int(min(backend.memory // 4, MOST_PLANES) // (16 * rows * cols)))
        self._turn()
        natural, turned = ([(half, *batch) for batch in _batches(half, most)] for half in self.halves)
        for one, other in itertools.zip_longest(natural, turned):
            # on a GPU both maps are swept at the same time, but for tiles, which are short of memory
            with backend.overlapped() if self.far is None else contextlib.nullcontext():
                beside = other and _slopes_of(self, *other)
            found = one and _slopes_of(self, *one)
            backend.join()
            yield from (batch for batch in (found, beside) if batch)

    def _turn(self) -> None:
        if self.map_turned:
            return
        self.map_turned = self.kept
        rows, cols = (n + 2 * self.margin for n in self.shape)
        self.backend.launch("ground", "turn", (rows, cols, 1), self.heights, self.turned, rows, cols, 1)

    def _sweep(
        self,
        half: Half,
        first: int,
        count: int,
        what: int,
        known: bool,
        backward: bool,
        slopes: Array,
        sums: Array,
        falls: bool,
    ) -> None:
        """``known``, ``backward``: see opencl/horizon.cl; ``falls``: slopes below the level are searched."""
        backend = self.backend
        comes_at = int(half.windows[first]) if backward else self.near + 1
        span = half.rows + half.warm + self.near + 2
        bits, rising_scale, *rising = ladder(self.steepest[0], self.relief, span, comes_at)
        _, falling_scale, *falling = ladder(self.steepest[1], self.relief, span, comes_at)
        overhang = (
            0
            if self.sides == "periodic"
            else math.ceil(np.abs(half.shears[first : first + count]).max() * half.rows) + 1
        )
        lines = backend.lanes * backend.strips * backend.lines
        groups = -(-(half.cols + overhang) // lines)
        maps = half.heights, half.tilts, *half.tables, half.brightness, slopes, sums, *rising, *falling
        size = first, backend.lines, half.rows, half.cols, self.margin, self.room, self.knots, bits
        scales = self.lowest, rising_scale, falling_scale
        named: dict[str, Any] = dict(NEAR=self.near, SIDES=SIDES[self.sides], WHAT=what, FALLS=int(falls))
        named["BLOCKS"] = int(half.windows[first] < ENDLESS_WINDOW)
        dim, given = (backend.lines, count, groups), (*maps, *size, *scales, int(known), int(backward))
        backend.launch("horizon", "sweep", dim, *given, *half.asked, group=backend.lines, **named)

    def _half(self, turned: bool, table: np.ndarray | None) -> Half:
        keep = self.backend.table
        rows, cols = self.shape[:: -1 if turned else 1]
        warm, endless = 0, float(rows + cols)
        if self.sides == "periodic":
            endless = max(rows, self.relief / LEAST_SEARCHED_SLOPE)
            warm = math.ceil(min(self.reach + 1, endless))
            _check_search(self.backend, self.relief, warm, len(_numbers_of(self.rays.angles, turned)))
        angles, widths = (part.astype(float).tobytes() for part in self.rays[:2])
        sums = self.rays.sums.astype(int).tobytes()
        numbers, windows, shears, tables = _shear_tables(
            angles, widths, sums, tuple(self.scales), turned, self.near, self.reach, endless, warm
        )
        if table is not None and len(numbers):
            brightness = keep(np.ascontiguousarray(table[numbers], np.float32))
        else:
            brightness = self.nothing
        return Half(
            turned,
            rows,
            cols,
            numbers,
            windows,
            warm,
            shears,
            [keep(array) for array in tables] if len(numbers) else [],
            self.turned if turned else self.heights,
            self.tilts[turned],
            brightness,
            self.asked[-2:] + self.asked[:2] if turned else self.asked,
        )


def _fixed_point_scales(rays: Rays, table: np.ndarray | None, most_of_all: float) -> list[float]:
    """Fixed-point steps per unit of irradiance, of every sum: no sum exceeds 2^30.

    ``most_of_all``: what an azimuth adds at most per radian, where no table says it.
    """
    most = np.full(len(rays.widths), most_of_all)
    if table is not None:
        most = np.hypot(table[:, 0, 0], table[:, 0, 1])
    of_sums = (rays.sums == n for n in range(rays.sums.max(initial=0) + 1))
    # within float32 also under a black sky
    return [2.0**30 / max(float(most[some] @ rays.widths[some]), 1e-20) for some in of_sums]


def _numbers_of(angles: np.ndarray, turned: bool) -> np.ndarray:
    """Of the azimuths that go from row to row in the map as it lies, or in the turned one."""
    return np.flatnonzero((np.abs(np.cos(angles)) > np.abs(np.sin(angles))) == turned)


@functools.lru_cache(32)  # 64 azimuths: 30 kB, which take longer to make than a small map to sweep
def _shear_tables(
    angles: bytes,
    widths: bytes,
    sums: bytes,
    scales: tuple[float, ...],
    turned: bool,
    near: int,
    reach: float,
    endless: float,
    warm: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """(numbers, windows and shears of a map's azimuths, the kernel's azimuths, ways, near_at, near_weight).

    ``angles``, ``widths``, ``sums``: of all azimuths, see ``Rays``. ``scales``: of the fixed-point sums.
    ``reach`` [spacing]: from ``endless`` rows on a window is endless.
    """
    cosine, sine = np.cos(np.frombuffer(angles)), np.sin(np.frombuffer(angles))
    numbers = _numbers_of(np.frombuffer(angles), turned)
    across, along = (sine, cosine) if turned else (cosine, sine)
    reaches = np.maximum(reach * np.abs(along[numbers]), 1e-3)
    windows = np.where(reaches < endless, np.maximum(reaches, 1), ENDLESS_WINDOW).astype(np.int64)
    order = np.argsort(windows, kind="stable")
    numbers, windows, reaches = numbers[order], windows[order], reaches[order]
    columns = near - 1  # as in opencl/horizon.cl
    a, b = across[numbers], along[numbers]
    shears = _whole_shears(a / np.abs(b))
    steepness = np.abs(shears)
    flat = steepness == 0
    inverse = np.where(flat, 1e9, 1 / np.where(flat, 1, steepness))
    within = np.minimum(near, reaches)
    near_columns = np.minimum(columns, np.floor(within * steepness + 1e-9)).astype(int)
    near_rows = np.floor(within + 1e-9)
    azimuths, ways = np.zeros((len(numbers), 8)), np.zeros((len(numbers), 8), np.int32)
    of_sums = np.frombuffer(sums, int)[numbers]
    scaled = np.frombuffer(widths)[numbers] * np.array(scales)[of_sums]
    azimuths[:, :7] = np.stack([shears, a, b, np.abs(b), scaled, inverse, np.minimum(reaches, 1e30)], 1)
    warms = np.full(len(numbers), warm)
    ways[:, :6] = np.stack([np.where(b < 0, 1, -1), near_rows, near_columns, warms, windows, of_sums], 1)
    near_at = np.zeros((len(numbers), near + columns, 2), np.int32)
    near_weight = np.zeros((len(numbers), near + columns))
    rows = np.arange(1, near + 1) * shears[:, None]
    near_at[:, :near, 0], near_at[:, :near, 1] = np.floor(rows), np.arange(1, near + 1)
    near_weight[:, :near] = rows - np.floor(rows)
    e = np.arange(1, columns + 1)
    used = e <= near_columns[:, None]
    down = np.where(used, e / np.where(flat, 1, steepness)[:, None], 0)
    near_at[:, near:, 0] = np.where(used, np.copysign(e, shears[:, None]), 0)
    near_at[:, near:, 1], near_weight[:, near:] = np.floor(down), down - np.floor(down)
    tables = azimuths.astype(np.float32), ways, near_at, near_weight.astype(np.float32)
    return numbers, windows, shears, tables


def _fetched(sweeps: Sweeps, half: Half, numbers: np.ndarray, planes: Array) -> np.ndarray:
    """Planes of a half as (n, rows, cols), on the host."""
    slopes = sweeps.backend.download(planes).reshape(len(numbers), half.rows, half.cols)
    return slopes.transpose(0, 2, 1) if half.turned else slopes


def _copy_rows(to: np.ndarray, values: np.ndarray, rows: slice) -> None:
    np.copyto(to[rows], values[rows])


def _batches(half: Half, most: int) -> Iterator[tuple[int, int]]:
    """(first, count) of azimuths that are swept together: those of one window, at most ``most``."""
    first = 0
    while first < len(half.numbers):
        windows = half.windows[first : first + most]
        count = int((windows == windows[0]).sum())
        yield first, count
        first += count


def _at_once(sweeps: Sweeps) -> int:
    """Azimuths whose light is swept together."""
    if sweeps.backend.lines == 1:
        return 1
    if sweeps.far is None:
        return ENDLESS_WINDOW
    return max(1, TILE_BYTES // (4 * math.prod(sweeps.shape)) - TILE_ARRAYS)


def _far_slopes(
    sweeps: Sweeps, half: Half, first: int, count: int, room: Array | None = None
) -> tuple[Array, bool]:
    """(Slopes (count, rows x cols) float32 of ground far from a tile, True), or (nothing, False).

    ``room``: for the slopes, if its shape is theirs.
    """
    if sweeps.far is None:
        return sweeps.nothing, False
    angles = sweeps.rays.angles[half.numbers[first : first + count]]
    shape = half.rows, half.cols
    return sweeps.far.planes(shape, sweeps.margin, half.heights, angles, half.turned, room), True


def _slopes_of(sweeps: Sweeps, half: Half, first: int, count: int) -> tuple[Half, np.ndarray, Array]:
    """(half, numbers of some of its azimuths, their horizon slopes on the device)."""
    planes, known = _far_slopes(sweeps, half, first, count)
    if not known:
        planes = sweeps.backend.empty((count, half.rows * half.cols), np.float32)
    for backward in (True, False) if half.windows[first] < ENDLESS_WINDOW else (False,):
        sweeps._sweep(half, first, count, SLOPES, known, backward, planes, sweeps.nothing, True)
        known = True
    return half, half.numbers[first : first + count], planes


def _whole_shears(shears: np.ndarray) -> np.ndarray:
    """0 or +-1 where rounding alone makes a difference."""
    rounded = np.where(np.abs(shears) < 1e-8, 0.0, shears)
    whole: np.ndarray = np.where(np.abs(np.abs(rounded) - 1) < 1e-12, np.copysign(1.0, rounded), rounded)
    return whole


@functools.lru_cache(64)  # it is the same for all azimuths of a window
def ladder(
    steepest: float, relief: float, span: int, comes_at: int
) -> tuple[int, float, tuple[int, ...], tuple[int, ...]]:
    """(bits, height_scale, steps, rises): slopes from level to ``steepest`` [per row], denser near level.

    An integer holds a height above a ray in units of 1 / height_scale, and in its ``bits`` lowest bits a
    distance up to ``span`` rows. Raises CapacityError where that leaves no room for heights.
    """
    bits = max(1, math.ceil(math.log2(max(span, comes_at) + 2)))
    if bits > MOST_DISTANCE_BITS:
        raise CapacityError(
            f"A relief of {relief:.3g} on a map that repeats must be followed over {max(span, comes_at):,}"
            f" rows, at most {2**MOST_DISTANCE_BITS:,}; give depth and spacing in one unit, or max_distance."
        )
    slopes = np.tan(np.linspace(0, 1, LADDER) ** 1.5 * math.atan(steepest))
    slopes = slopes if steepest > 0 else slopes[::-1]
    high = relief + abs(steepest) * (comes_at if steepest > 0 else max(span, comes_at))
    height_scale = (2.0 ** (30 - bits) - 2 * LADDER) / max(high, 1e-6)
    steps = (np.rint(slopes * height_scale).astype(np.int64) << bits) - 1
    return bits, height_scale, tuple(steps.tolist()), tuple(((steps + 1) * comes_at).tolist())


def _check_search(backend: Backend, relief: float, rows: int, azimuths: int) -> None:
    """CapacityError where a sweep over a map that repeats would follow its relief for too many rows."""
    if rows * azimuths > backend.most_searched_rows:
        raise CapacityError(
            f"A relief of {relief:.3g} on a map that repeats must be followed over {rows:,} rows in"
            f" {azimuths} azimuths; {backend.name} takes {backend.most_searched_rows // azimuths:,} at most."
            " Choose a compiled backend, or give max_distance, or, if the relief is too large, depth and"
            " spacing in one unit."
        )


def _steepest(best: np.ndarray) -> tuple[float, float]:
    """Slopes [per row] of the steepest rise and fall to ground that is not near, of 99.9 % of the nodes."""
    best = best[np.isfinite(best)].astype(np.float64)
    if not best.size:
        return 0.1, -0.1
    fall, rise = np.quantile(best, (0.001, 0.999)).tolist()
    return max(0.1, 1.1 * rise), min(-0.1, 1.1 * fall)


def engine_of(scene: Scene, backend: str) -> Backend:
    """The backend of this name; ``auto`` stays on the GPU on which the scene's depth lies."""
    check_scene(scene)
    there = scene.resident
    if there is not None and there.backend.name.startswith("warp:cuda") and str(backend) == "auto":
        return there.backend
    return select(backend)


def ground_of(scene: Scene, max_distance: float | None, engine: Backend) -> Ground:
    """The map for sweeps on ``engine``, and how far they look."""
    reach = np.inf if max_distance is None else positive_number(max_distance, "max_distance") / scene.spacing
    if reach < 1:
        raise bad("max_distance", max_distance, f"at least one spacing, {scene.spacing:g}")
    return Ground(scene.on(engine), scene.sides, reach)
