"""Ground far from a tile: overviews of the whole map, and the horizons that tiles take from them."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arrays import by_bands
from ..backends.base import Array, Backend
from ..backends.resident import Resident
from ..checks import positive_number
from ..constants import ENDLESS, HIGHEST_MASKED, NONE
from ..errors import bad

# how far from a cell's mean to its maximum its height lies; measured (performance/scale.py): with means alone
# crests are lost, with maxima alone valleys close
TOWARDS_MAXIMUM = np.float32(0.4)
# the halo over the distance of nodes whose far horizons are marched; measured (performance/scale.py): at 2
# errors are 1.5 to 2 times as large, at 8 0.6 to 0.8 times, for a quarter and four times the work
SPARSE = 4
# difference in height [spacings] of neighbouring nodes that is called a cliff: two crossings are too few
# behind it (host/backends/numpy/horizon.py)
CLIFF = 4.0
# among cliffs every DENSER-th of that: share of neighbours that are steeper than CLIFF spacings apart, from
# which on. Measured (performance/scale.py --exact): houses, 0.03 of whose neighbours are, have 0.0027 RMS
# against exact rays in place of 0.0035; mountains have none, so half or twice the share is the same. So too
# under suns: of six pairs of map and sun the error is then 0.3 to 0.7 times as large (0.4 to 1.8 %), for a
# tenth more time; with 2 it is 0.5 to 0.7 times, with 8 0.2 to 0.6 for up to 1.9 times the time
DENSER, CLIFFS = 4, 0.003
# halos beyond a tile up to which overviews are its neighbours'; chosen: at 4 the levels that every tile is
# given have four times as many cells, at 16 neighbours give four times as many
NEIGHBOURS = 8


@dataclass(frozen=True)
class Tiling:
    """How maps beyond one device are cut, counted from the map's first node, whatever their chunks are.

    Parameters
    ----------
    tile : int
        Nodes along a side of a tile; a multiple of ``halo``.
    halo : int
        Nodes of the map around each tile that are swept with it; ground farther away is taken from overviews.
        A power of two.
    rule : int
        Cells of an overview between the nearest ground that it stands for and the tile's node: level f, cells
        of 2^f nodes, serves distances from rule 2^f to rule 2^(f + 1) nodes. A power of two, at most halo.
    earth : float [unit of spacing], optional
        Radius of the Earth, if ground farther than the halo shall sink with its curvature, less the
        refraction of the air: 0.87 distance^2 / (2 radius). Within the halo ground is taken as flat.

    Raises
    ------
    InputError

    Examples
    --------
    >>> heights = 9.0 * np.random.default_rng(0).random((96, 96))
    >>> small = sl.Tiling(tile=64, halo=16, rule=8)
    >>> sl.sky_view_factor(sl.Scene.from_height(heights), azimuths=8, tiling=small).shape
    (96, 96)
    """

    tile: int = 8192
    halo: int = 128
    rule: int = 32
    earth: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("halo", SPARSE), ("rule", 4)):
            value = getattr(self, name)
            if not isinstance(value, (int, np.integer)) or value < least or value & (value - 1):
                raise bad(f"Tiling: {name}", repr(value), f"a power of two, at least {least}")
            object.__setattr__(self, name, int(value))  # NumPy's integers have no bit_length
        if self.rule > self.halo:
            raise bad("Tiling: rule", self.rule, f"at most halo, {self.halo}")
        if not isinstance(self.tile, (int, np.integer)) or self.tile < self.halo or self.tile % self.halo:
            raise bad("Tiling: tile", repr(self.tile), f"a multiple of halo, {self.halo}")
        object.__setattr__(self, "tile", int(self.tile))
        if self.tile % (1 << self.top):  # else cells of overviews would lie across tiles
            raise bad("Tiling: tile", self.tile, f"a multiple of {1 << self.top}, or a rule of at least 8")
        if self.earth is not None:
            positive_number(self.earth, "Tiling: earth")

    @property
    def first(self) -> int:
        """The first level that is looked at, which serves distance ``halo``."""
        return (self.halo // self.rule).bit_length() - 1

    @property
    def top(self) -> int:
        """The first level that is one array for the whole map; below, tiles are given parts."""
        return self.first + (min(NEIGHBOURS, self.tile // self.halo)).bit_length() - 1

    @property
    def reach(self) -> int:
        """Nodes beyond a tile up to which levels below ``top`` are looked at."""
        return self.rule << self.top if self.top > self.first else 0

    @property
    def spread(self) -> int:
        """Nodes between those whose far horizons are marched; fewer among cliffs and under suns, see
        :func:`spread_of`.
        """
        return self.halo // SPARSE

    @property
    def least(self) -> int:
        """Nodes along a side of the smallest tile; the rest of a map belongs to the tile before it."""
        return max(self.halo, self.reach)

    def starts(self, nodes: int) -> list[int]:
        """First nodes of all tiles along an axis of so many nodes."""
        return list(range(0, max(1, nodes - self.least + 1), self.tile))


class LevelPart(NamedTuple):
    """A part of a level: heights (rows, cols), nan without data; its first cell; nodes along one."""

    heights: np.ndarray
    row: int
    col: int
    size: int


class Far(NamedTuple):
    """The part of a map that the light of one tile depends on.

    ``shape`` of the map; ``at``: row and column of the tile's first node; ``tile``: its rows and columns;
    ``before``: rows and columns of the swept window before it; ``spread``:
    nodes between those that are marched, ``own``: heights float32 of the nodes that
    :func:`marched_nodes` lists; ``levels``: from ``tiling.first`` on, heights likewise in spacings as the
    window has them; ``farthest`` [nodes] ground to be seen; ``periodic``: the map repeats; ``drop``
    [1 / spacing]: by how much ground sinks with distance^2, or rises where negative; ``whole``: all of the
    window is lit, what lies around the tile by near ground alone.
    """

    tiling: Tiling
    shape: tuple[int, int]
    at: tuple[int, int]
    tile: tuple[int, int]
    before: tuple[int, int]
    spread: int
    own: np.ndarray
    levels: list[LevelPart]
    farthest: float
    periodic: bool = False
    drop: float = 0.0
    whole: bool = False

    def asked(self, shape: tuple[int, int]) -> tuple[int, int, int, int]:
        """First row of a swept window whose light is asked for and the last's next; columns likewise."""
        (top, left), (rows, cols) = ((0, 0), shape) if self.whole else (self.before, self.tile)
        return top, top + rows, left, left + cols


def coarser(low: np.ndarray, times: int = 1) -> np.ndarray:
    """Means and maxima (2, rows, cols) of blocks of 2 x 2 cells, ``times`` over.

    Cells without data, nan, have no part in either; blocks at the last row and column may be smaller.
    """
    for _ in range(times):
        if any(n % 2 for n in low.shape[1:]):
            low = np.pad(low, [(0, 0), *((0, n % 2) for n in low.shape[1:])], constant_values=np.nan)
        a, b, c, d = low[:, ::2, ::2], low[:, ::2, 1::2], low[:, 1::2, ::2], low[:, 1::2, 1::2]
        low = np.empty(a.shape, low.dtype)
        mean, most, other = low[0], low[1], c[0] + d[0]
        np.multiply(np.add(np.add(a[0], b[0], out=mean), other, out=mean), np.float32(0.25), out=mean)
        np.fmax(np.fmax(a[1], b[1], out=most), np.fmax(c[1], d[1], out=other), out=most)
        gaps = np.isnan(mean)
        if gaps.any():
            parts = np.stack([part[0][gaps] for part in (a, b, c, d)])
            count = np.isfinite(parts).sum(0, dtype=np.float32)
            sums = np.where(np.isfinite(parts), parts, np.float32(0))
            with np.errstate(invalid="ignore"):
                mean[gaps] = ((sums[0] + sums[1]) + (sums[2] + sums[3])) / count
    return low


def from_heights(heights: np.ndarray) -> np.ndarray:
    """Level 0 for :func:`coarser`: heights (rows, cols) [length], nan or infinite without data.

    Float64 stays, as heights far above zero need it; other types become float32.
    """
    values = heights if heights.dtype == np.float64 else heights.astype(np.float32, copy=False)
    if any(by_bands(lambda rows: bool(np.isinf(values[rows]).any()), values.shape)):
        values = np.where(np.isinf(values), values.dtype.type(np.nan), values)
    return np.broadcast_to(values, (2, *values.shape))


def mixed(low: np.ndarray) -> np.ndarray:
    """Heights of cells from their means and maxima."""
    heights: np.ndarray = low[0] + TOWARDS_MAXIMUM * (low[1] - low[0])
    return heights


class Top(NamedTuple):
    """The levels from ``tiling.top`` on, whole maps (rows, cols) [length]; the range."""

    levels: list[np.ndarray]
    lowest: float
    highest: float


def top_of(low: np.ndarray) -> Top:
    """From means and maxima (2, rows, cols) of the whole map at ``tiling.top``."""
    levels, lowest = [mixed(low)], float(np.nanmin(low[0], initial=math.inf))
    highest = float(np.nanmax(low[1], initial=-math.inf))
    while max(low.shape[1:]) > 1:
        low = coarser(low)
        levels.append(mixed(low))
    return Top(levels, lowest, highest)


def around(
    tiling: Tiling,
    begin: tuple[int, int],
    at: tuple[int, int],
    tile: tuple[int, int],
    low: np.ndarray,
    top: Top,
    periodic: bool,
) -> list[LevelPart]:
    """All levels about a tile, [length], in as small windows as are looked at.

    ``low``: means and maxima at level ``tiling.first`` from node ``begin`` on, of the tile and up to
    ``tiling.reach`` nodes around; not needed where that is 0.
    """
    levels = []
    for level in range(tiling.first, tiling.top + len(top.levels)):
        size = 1 << level
        room = 2 * tiling.rule + 2  # cells that rays pass in a level, and the next for interpolation
        if level < tiling.top:
            levels.append(LevelPart(mixed(low), begin[0] // size, begin[1] // size, size))
            low = coarser(low)
            continue
        heights = top.levels[level - tiling.top]
        picks = []
        for first, count, cells in zip(at, tile, heights.shape):
            pick = np.arange(first // size - room, (first + count - 1) // size + room + 1)
            picks.append(pick if periodic else pick[(pick >= 0) & (pick < cells)])
        window = heights[np.ix_(*(pick % cells for pick, cells in zip(picks, heights.shape)))]
        levels.append(LevelPart(window, int(picks[0][0]), int(picks[1][0]), size))
    return levels


def spread_of(tiling: Tiling, heights: np.ndarray, spacing: float, suns: bool = False) -> int:
    """Nodes between those of a tile whose far horizons are marched; ``heights`` of the tile.

    ``suns``: shadows have edges.
    """

    def counts(rows: slice) -> tuple[int, int]:
        """Pairs of neighbours with data, and those that are steep, in or below these rows."""
        below = heights[rows.start : rows.stop + 1]
        known = cliffs = 0
        for step in (np.diff(below, axis=0), np.diff(heights[rows], axis=1)):
            known += int(np.count_nonzero(np.isfinite(step)))
            cliffs += int(np.count_nonzero(np.abs(step, out=step) > CLIFF * spacing))
        return known, cliffs

    count, cliffs = np.sum(by_bands(counts, heights.shape), 0)
    return max(1, tiling.spread // DENSER) if suns or cliffs > CLIFFS * count else tiling.spread


def marched_nodes(
    spread: int, shape: tuple[int, int], at: tuple[int, int], tile: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the map whose nodes' far horizons a tile interpolates."""
    rows, cols = (
        np.minimum(first + np.arange(0, count + spread, spread), most - 1)
        for first, count, most in zip(at, tile, shape)
    )
    return rows, cols


def marched(there: Resident, far: Far) -> Marched:
    """Far horizons of a tile whose window lies on a device; made once, for the audit and all sweeps."""
    key = "far", id(far)  # which lives as long as what is made of it
    if key not in there.derived:
        there.derived[key] = Marched(there.backend, far)
    made: Marched = there.derived[key]
    return made


class Marched:
    """Far horizons of a tile on a device."""

    def __init__(self, backend: Backend, far: Far):
        self.backend, self.far = backend, far
        rows, cols = marched_nodes(far.spread, far.shape, far.at, far.tile)
        self.nodes = far.own.shape
        table, level_of = self._steps()
        described, offset = np.zeros((len(far.levels), 8), np.int32), 0
        for line, level in zip(described, far.levels):
            line[:6] = offset, level.row, level.col, *level.heights.shape, level.size.bit_length() - 1
            offset += level.heights.size
        cells = np.concatenate([level.heights.ravel() for level in far.levels])
        np.nan_to_num(cells, copy=False, nan=NONE)
        # ground that rises with distance may stand above any horizon
        self.highest = ENDLESS if far.drop < 0 else float(max(cells.max(), far.own.max()))
        upload = backend.upload
        self.tables = [upload(cells, constant=True), upload(described), upload(table), upload(level_of)]
        self.steps = len(level_of)
        self.places = far.own.ravel(), np.repeat(rows, len(cols)), np.tile(cols, len(rows))

    def _steps(self) -> tuple[np.ndarray, np.ndarray]:
        """Distances of the samples [nodes] and their reciprocals (steps, 2), and the level of each."""
        far, steps, levels = self.far, [], []
        end = far.farthest if far.periodic else min(far.farthest, math.hypot(*far.shape))
        distance, level = far.tiling.halo, 0
        while distance <= end:
            while level + 1 < len(far.levels) and distance >= far.tiling.rule * far.levels[level + 1].size:
                level += 1
            steps.append((distance, 1 / distance))
            levels.append(level)
            distance += far.levels[level].size
        return np.array(steps, np.float32).reshape(-1, 2), np.array(levels, np.int32)

    def planes(
        self,
        shape: tuple[int, int],
        margin: int,
        heights: Array,
        angles: np.ndarray,
        turned: bool,
        room: Array | None = None,
    ) -> Array:
        """Slopes (azimuths, rows x cols) float32 on the device, of the window as it lies or turned.

        ``shape`` and ``heights``, padded by ``margin``, are those of the window as it is swept. ``room``: of
        the result, where there is one of this shape.
        """
        backend, far, count = self.backend, self.far, len(angles)
        rows, cols = shape
        lines = self._march(angles, *self.own)
        planes = room
        if room is None or room.shape != (count, rows * cols):
            planes = backend.empty((count, rows * cols), np.float32)
        last = [most - 1 - first for most, first in zip(far.shape, far.at)]
        across_then_along = (self.nodes[1], 1), far.before, far.tile, last
        places = [pair[:: 1 if turned else -1] for pair in across_then_along]  # along first
        run = 1 if backend.nodes_per_item == 1 else cols  # on a CPU a row a work-item
        dim = -(-cols // run), rows, count
        size = count, math.prod(self.nodes), far.spread, rows, cols, margin
        ends = *(n for pair in places for n in pair), run
        backend.launch("far", "interpolate", dim, lines, heights, planes, *size, *ends)
        return planes

    def seen_from(
        self, rows: np.ndarray, cols: np.ndarray, own: np.ndarray, angles: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(slopes, distances [nodes]) of far horizons (azimuths, nodes) at some nodes, as `interpolate` has
        them.

        ``rows``, ``cols``: from the tile's first node; ``own``: heights [spacing].
        """
        far, count = self.far, len(angles)
        at, weights = [], []
        for places, most, first in zip((rows, cols), far.shape, far.at):
            low = places // far.spread
            step = np.minimum(far.spread, most - 1 - first - low * far.spread)
            at.append(low)
            weights.append(np.where(step > 0, (places - low * far.spread) / np.maximum(step, 1), 0))
        (r, c), (a, b) = at, weights
        corners = np.concatenate([(r + i) * self.nodes[1] + c + j for i in (0, 1) for j in (0, 1)])
        some = self._uploaded(*(values[corners] for values in self.places))
        lines = self.backend.download(self._march(angles, *some)).astype(np.float64)
        h00, h01, h10, h11 = corners = np.moveaxis(lines.reshape(2, count, 4, len(r)), 2, 0)
        whole = corners[:, 0].min(0) > HIGHEST_MASKED
        nearest = np.where(a >= 0.5, np.where(b >= 0.5, h11, h10), np.where(b >= 0.5, h01, h00))
        upper, lower = h00 * (1 - b) + h01 * b, h10 * (1 - b) + h11 * b
        slope, inverse = np.where(whole, upper * (1 - a) + lower * a, nearest)
        with np.errstate(divide="ignore"):
            return slope - own * inverse, 1 / inverse

    @functools.cached_property
    def own(self) -> list[Array]:
        """Heights, rows and columns of the tile's nodes on the device."""
        return self._uploaded(*self.places)

    def _uploaded(self, own: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> list[Array]:
        """What the kernel `march` must know of some nodes."""
        upload = self.backend.upload
        return [upload(own), upload(rows.astype(np.int32)), upload(cols.astype(np.int32))]

    def _march(self, angles: np.ndarray, own: Array, rows: Array, cols: Array) -> Array:
        """Far horizons of some nodes by the kernel `march`: (2, azimuths, nodes) float32 on the device."""
        backend, far, count, nodes = self.backend, self.far, len(angles), own.shape[0]
        lines = backend.empty((2, count, nodes), np.float32)
        ways = np.stack([np.cos(angles), np.sin(angles)], 1)
        # a ray along the border stays on the map
        ways = backend.table(np.where(np.abs(ways) < 1e-9, 0, ways).astype(np.float32))
        maps = *self.tables, ways, own, rows, cols, lines
        size = self.steps, count, nodes, *far.shape, self.highest, far.drop, int(far.periodic)
        backend.launch("far", "march", (-(-nodes // backend.lanes), count), *maps, *size)
        return lines


def scaled(heights: np.ndarray, base: float, spacing: float) -> np.ndarray:
    """(heights - base) / spacing, float32, rounded once each."""
    return (heights - base).astype(np.float32) / np.float32(spacing)
