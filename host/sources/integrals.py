"""Integrals of a sky's brightness over sectors of azimuth and bands of elevation; small bright parts apart.

The hemisphere is divided into cells about 0.15 degrees wide. A function is evaluated once in every cell.
Where its second difference is more than ROUGH_SHARE of the light, the cell is divided, adaptively. An
environment map is integrated pixel by pixel. Small bright parts (suns, lights, spots; any number) are found
from the cells and get azimuths of their own. All is float64 and on the host.
"""

from __future__ import annotations

import functools
import math
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from .. import sources
from ..directions import Azimuths
from ..locks import give_lock
from .tables import EVALUATION_BATCH, GOLDEN, diamond, diamond_azimuths, elevation_of, varying

# cells from the horizon to the zenith, and round the horizon: a disc of 0.1 degrees radius holds a sample
ROWS, COLS = 640, 2304
COARSE_ROWS, COARSE_COLS = 180, 576  # the same where narrow features are named: cells of half a degree
# [turn], steps of the low-discrepancy sequence R2: 1 / g and 1 / g^2 with g^3 = g + 1 (M. Roberts, 2018)
R2_STEPS = 0.7548776662466927, 0.5698402909980532
# second difference over the brightness from which a cell is not smooth; chosen above the 0.006 of cos^900.
# Half and twice give the same errors under skies with lights (performance/constants.py)
ROUGH = 0.05
# of all light: a cell with a larger second difference is divided. Level ground under ten suns then has an
# error of 2e-5 to 7e-5 (tests/test_integrals.py)
ROUGH_SHARE = 2e-6
# of all light: smaller second differences do not matter; a million cells make an error of 1e-6
NEGLIGIBLE = 1e-9
# samples along each side of a rough cell that is not divided; chosen: with 3, twenty stripes have an
# error of 2e-4, with 1 six times that
JITTERED = 5
CELL_PARTS = 4  # into which a cell is divided along each side
MOST_DIVISIONS = 9  # 0.15 degrees / 4^9 = 2e-6 degrees
# evaluations in divided cells, as many as in the first ones: those with the largest second differences are
# divided first, and `error` holds the rest
MOST_CELL_EVALUATIONS = 2**20
# relative error at which no cell is divided any more: a fifth of level ground's tolerance
CONVERGED_CELL = 2e-5
SHARPEST = 3.0  # ratio of the light of neighbouring cells from which on an edge lies between them
# The next four and DARK_GAP are chosen. Half and twice of each: the median error of four random pairs under
# skies with lights, .561 of the tolerance, becomes .557 and .588 with BRIGHT, .561 and .566 with INNER, and
# does not change with the others (performance/constants.py --only sources.integrals --seed 18 --size 64).
BRIGHT = 4.0  # times the median brightness from which on light may belong to a small part
LEAST_LEVEL = 1e-6  # of the brightest, from which on levels are tried where the sky is dark
FAINT_PARTS_SHARE = 0.1  # tolerances that small parts may give together and stay with the rest
WIDEST = math.pi / 6  # azimuth that a small part may span, 30 degrees: even azimuths resolve wider ones
INNER = 0.1  # share of a small part's light from which on far brighter cells in it form another
# cells along a pixel of a map from which on a bright one is not divided further. With 10 its extent errs by
# 0.3 %, with 5 by 2 %, with 20 by 0.06 % (tests/test_integrals.py)
LIGHT_CELLS = 16
# of tables that one sky's integrals keep besides: of light by normal 17 kB each, of 8 azimuths 4 or 130 kB,
# of chords up to 2 MB. Chosen: a call within a tolerance needs some 1 MB of them
KEPT_TABLE_BYTES = 2**23
# of tables of maps and functions, together; chosen: five maps of 2048 x 4096 pixels in grey
KEPT_BYTES = 2**28
SECTOR_CELL_PARTS = 16  # at most, that a cell is cut into for narrow sectors; 8 and 32 give the same errors
CUT_AT_ONCE = 2**13  # directions; chosen: what is held of so many, some 300 kB, stays in a core's cache
# [rad] of darkness between two small parts: parts nearer than that share azimuths
DARK_GAP = math.radians(1)
# elevation up to which the light above a place within a row of cells is its integral; above, a straight line,
# which misplaces 1 / (4 (2 n + 1)) of the light of row n. Derived: up to 1.7 % of one of ROWS, 5 % of one of
# COARSE_ROWS; with half and twice of it 2.8 and 0.9 %, 8 and 3 %
CURVED = math.radians(1)
MOST_SET = math.radians(1)  # below the horizon, of the middle of a named feature that is looked for; chosen
# of the tables of a sky and of a small part, evenly in the diamond angle of elevation; and of a sky whose
# light lies within less, or that holds small parts too: a knot is 0.06 to 0.11 degrees
SKY_KNOTS, PART_KNOTS, FINE_KNOTS = 257, 65, 1025
# tolerances that the light which SKY_KNOTS misplace may be of all light. Chosen: stairs under a ring of light
# 0.2 degrees wide, as high as they look, err by 0.26 % with 257 knots at a tolerance of 0.3 %, by 0.15 with
# 1025. Of smooth skies, stripes and environment maps it is 0.004 to 0.04, of that ring 36
MISPLACED_SHARE = 0.3
KNOT_SECTORS = 16  # of azimuth, in which that is looked for; chosen


class Cells(NamedTuple):
    """Parts of the sky, (n,) each.

    Azimuth and its width [rad], elevations [rad], brightness, and the number of the base cell.
    """

    azimuth: np.ndarray
    width: np.ndarray
    low: np.ndarray
    high: np.ndarray
    light: np.ndarray
    base: np.ndarray

    def pick(self, which: np.ndarray) -> Cells:
        return Cells(*(values[which] for values in self))

    @property
    def solid_angle(self) -> np.ndarray:
        angle: np.ndarray = self.width * (np.sin(self.high) - np.sin(self.low))
        return angle

    @property
    def are_needles(self) -> np.ndarray:
        """Which are less than half as wide as high, as round the zenith, where they are divided in height
        alone: else parts would be so narrow that a light lies in many of them and between their middles.
        """
        needles: np.ndarray = self.width * np.cos(self.low) < (self.high - self.low) / 2
        return needles

    @property
    def moments(self) -> np.ndarray:
        """Integrals of B cos^2 and of B sin cos over azimuth and elevation: (2, n)."""
        per_width = antiderivatives(self.high) - antiderivatives(self.low)
        moments: np.ndarray = self.light * self.width * per_width
        return moments


@dataclass(frozen=True, eq=False)
class BrightPart:
    """A small bright part of a sky: its cells in order of azimuth, which may run past 2 pi.

    Their light is the excess of brightness over ``limit``.
    """

    cells: Cells
    limit: float

    @cached_property
    def power(self) -> float:
        """Brightness x solid angle."""
        return float(self.cells.light @ self.cells.solid_angle)

    @cached_property
    def moment(self) -> np.ndarray:
        """Integral of B L dOmega, third component upwards: (3,)."""
        along, up = self.cells.moments
        return np.array([along @ np.cos(self.cells.azimuth), along @ np.sin(self.cells.azimuth), up.sum()])

    @cached_property
    def cone(self) -> tuple[np.ndarray, float]:
        """(Unit vector, third component upwards; sine of the radius of a disc round it that holds all)."""
        middle = self.moment / np.linalg.norm(self.moment)
        e, a = (self.cells.low + self.cells.high) / 2, self.cells.azimuth
        cosine = np.cos(e) * (middle[0] * np.cos(a) + middle[1] * np.sin(a)) + middle[2] * np.sin(e)
        half = np.hypot(self.cells.high - self.cells.low, self.cells.width * np.cos(self.cells.low)) / 2
        return middle, math.sin(min(math.pi / 2, float((np.arccos(np.minimum(1, cosine)) + half).max())))

    @cached_property
    def _rows(self) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """(Lowest and highest elevations of the rows of its cells, each cell's row)."""
        rows, row = np.unique(self.cells.low + 1j * self.cells.high, return_inverse=True)
        return (rows.real, rows.imag), row

    @cached_property
    def _kept_sectors(self) -> dict[tuple[int, bool], tuple[np.ndarray, np.ndarray]]:
        return {}

    @property
    def nbytes(self) -> int:
        """Of the sectors that are kept."""
        return sum(ways.nbytes + table.nbytes for ways, table in list(self._kept_sectors.values()))

    def sectors(self, count: int, shifted: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Its light in ``count`` sectors of azimuth that have equal shares of it; kept, not to be changed.

        ways (5, K) and table (K, PART_KNOTS, 4), as the kernel `sectors` takes them. ``shifted``: borders
        half a sector on, so that there are ``count`` + 1.
        """
        if (count, shifted) not in self._kept_sectors:
            self._kept_sectors[count, shifted] = self._in_sectors(count, shifted)
        return self._kept_sectors[count, shifted]

    def _in_sectors(self, count: int, shifted: bool) -> tuple[np.ndarray, np.ndarray]:
        cells, (ends, row) = self.cells, self._rows
        span = float(np.ptp(cells.azimuth)) + float(cells.width.max())
        # no cell wider than half a sector
        times = np.clip(np.ceil(2 * count * cells.width / span), 1, SECTOR_CELL_PARTS).astype(int)
        if times.max() > 1:
            part = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
            which, times = np.repeat(np.arange(len(times)), times), np.repeat(times, times)
            cells = cells.pick(which)
            cells = cells._replace(
                azimuth=cells.azimuth + cells.width * ((part + 0.5) / times - 0.5), width=cells.width / times
            )
            order = np.argsort(cells.azimuth, kind="stable")
            cells, row = cells.pick(order), row[which][order]
        lowest, highest = map(antiderivatives, ends)
        moments = cells.light * cells.width * (highest - lowest)[:, row]
        share = np.cumsum(moments.sum(0))
        share = (share - moments.sum(0) / 2) / share[-1] * count + (0.5 if shifted else 0.0)
        group = np.minimum(share.astype(int), count - (not shifted))
        begins = np.diff(group, prepend=-1) > 0
        edges, group = np.flatnonzero(begins), np.cumsum(begins) - 1
        first, last = float(diamond(cells.low.min())), float(diamond(cells.high.max()))
        low, high = (np.sin(ends)[:, None] for ends in ends)
        knots = np.sin(elevation_of(np.linspace(first, last, PART_KNOTS)))
        # share of a row above every knot
        ramp = np.clip((high - knots) / np.maximum(high - low, 1e-12), 0, 1)
        ramp[:, 0] = 1  # but for rounding
        shape = len(edges), len(low)
        by_row = (np.bincount(group * len(low) + row, moment, math.prod(shape)) for moment in moments)
        table = np.stack([light.reshape(shape) @ ramp for light in by_row])
        weight = moments.sum(0)
        angle = np.add.reduceat(weight * cells.azimuth, edges) / np.add.reduceat(weight, edges)
        ways = np.ones((5, len(edges)), np.float32)
        ways[0], ways[1] = np.cos(angle), np.sin(angle)
        ways[3], ways[4] = first, (PART_KNOTS - 1) / (last - first)
        return ways, _with_steps(table)


class Band(NamedTuple):
    """Rows of equally wide cells.

    Brightness (rows, n); azimuth of the first cell's middle in every row (rows,) [rad]; borders (rows + 1,)
    [rad] between rows.
    """

    light: np.ndarray
    start: np.ndarray
    borders: np.ndarray

    @property
    def width(self) -> float:
        return 2 * math.pi / float(self.light.shape[1])

    @property
    def solid_angle(self) -> np.ndarray:
        """Of a cell of every row: (rows, 1)."""
        angle: np.ndarray = self.width * np.diff(np.sin(self.borders))[:, None]
        return angle

    @property
    def moments(self) -> np.ndarray:
        """Integrals of B cos^2 and of B sin cos over every cell: (2, rows, n)."""
        moments: np.ndarray = self.light * (self.width * np.diff(antiderivatives(self.borders)))[..., None]
        return moments

    def cells(self, row: np.ndarray, col: np.ndarray, first: int) -> Cells:
        return Cells(
            self.start[row] + col * self.width,
            np.full(len(col), self.width),
            self.borders[row],
            self.borders[row + 1],
            self.light[row, col],
            first + row * self.light.shape[1] + col,
        )


Peaks = tuple[tuple[float, float], ...]  # (azimuth, elevation) [rad] of narrow features


@dataclass
class _Leaves:
    """Cells that are not divided any more.

    ``total``: light of all cells but those that may still be divided; ``variance``: of the error of it.
    """

    cells: list[Cells]
    total: float
    variance: float

    def add(self, cells: Cells, step: np.ndarray) -> None:
        """``step``: their second differences times solid angle. A border may lie anywhere in a cell."""
        self.cells.append(cells)
        self.variance += float(np.sum(step**2)) / 12
        self.total += float(cells.light @ cells.solid_angle)

    def light_with(self, cells: Cells) -> float:
        """All light, ``cells`` being those that may still be divided."""
        return max(self.total + float(cells.light @ cells.solid_angle), 1e-300)


class Integrals:
    """A grey sky, integrated.

    ``bright_parts``: the small ones, brightest first; ``level``: irradiance of open level ground [brightness
    x sr], these included, and ``rest`` without them; ``error``: estimate of its relative error.
    """

    def __init__(
        self,
        source: sources.Source,
        tolerance: float = 0.01,
        fine: bool = False,
        widest: float = WIDEST,
        bands: list[Band] | None = None,
    ):
        """``fine``: cells are small also where narrow features are named, for sources through which little of
        the sky is visible at a time. ``tolerance`` inf: no small bright parts. ``widest``: azimuth that one
        may span [rad]. ``bands``: of :func:`_bands`, if they are made already; they are changed.
        """
        function, peaks = _function_of(source), _peaks(source)
        image = varying(source).equirectangular()
        bands = _bands(source, fine) if bands is None else bands
        self._source = sources.Sky(function)
        self.looked_closer = False  # than at base cells
        sizes = np.array([0, *np.cumsum([band.light.size for band in bands])])
        total = sum(float((band.solid_angle * band.light).sum()) for band in bands)
        limit = BRIGHT * _median(bands)
        leaves, self.error = None, 0.0
        if image is None:
            leaves, self.error, total = self._divide(bands, sizes, total, peaks or ())
        elif 2 * len(bands[0].light) < LIGHT_CELLS * len(image) and not math.isinf(tolerance):
            leaves = self._divide_bright(bands[0], limit)
        moments = np.concatenate([band.moments.reshape(2, -1) for band in bands], 1)
        parts = np.split(moments, sizes[1:-1], 1)  # of each band
        divided = np.zeros(sizes[-1], bool)
        if leaves is not None:  # which replace the base cells that they divide
            divided[leaves.base] = True
            sums = [np.bincount(leaves.base, moment, sizes[-1]) for moment in leaves.moments]
            np.copyto(moments, sums, where=divided)
        self.level = float(sum(part[1].sum() for part in parts))
        bright = [] if leaves is None else [leaves.pick(leaves.light > limit)]
        for band, first in zip(bands, sizes):
            whole = ~divided[first : first + band.light.size].reshape(band.light.shape)
            row, col = np.nonzero((band.light > limit) & whole)
            bright.append(band.cells(row, col, first))
        bright_parts = [] if math.isinf(tolerance) else list(_bright_parts(_joined(bright), limit, widest))
        bright_parts.sort(key=lambda spot: -spot.power)
        left = np.cumsum([spot.power for spot in bright_parts][::-1])[::-1]
        least = FAINT_PARTS_SHARE * tolerance * total
        self.bright_parts = tuple(spot for spot, power in zip(bright_parts, left) if power > least)
        for spot in self.bright_parts:
            for values, moment in zip(moments, spot.cells.moments):
                np.subtract.at(values, spot.cells.base, moment)
        self.rest = float(sum(part[1].sum() for part in parts))
        self._edges = np.concatenate([[0.0], *(band.borders[1:] for band in bands)])
        self._sums = [_cumulative(part.reshape(2, *band.light.shape)) for part, band in zip(parts, bands)]
        small = [values for part in self.bright_parts for values in part.cells]
        self._nbytes = sum(part.nbytes for part in (*self._sums, *small))
        self._kept: dict[tuple[Any, ...], np.ndarray] = {}
        is_smooth = math.isinf(tolerance) or self._misplaced() <= MISPLACED_SHARE * tolerance
        self.knots = SKY_KNOTS if is_smooth else FINE_KNOTS
        del self._source  # whose life ends that of these tables

    def _misplaced(self) -> float:
        """The most light above any elevation that a table of SKY_KNOTS misplaces, over all light."""
        azimuths, knots = even(KNOT_SECTORS, 0.5), np.linspace(0, 1, FINE_KNOTS)
        ends = azimuths.angles - azimuths.widths / 2, azimuths.angles + azimuths.widths / 2
        light = self.above(*ends, np.sin(elevation_of(knots))).sum(1)
        every = (FINE_KNOTS - 1) // (SKY_KNOTS - 1)
        off = [np.abs(part - np.interp(knots, knots[::every], part[::every])).max() for part in light]
        return float(max(off) / max(light[:, 0].max(), 1e-300))

    def _radiance(self, azimuth: np.ndarray, sine: np.ndarray) -> np.ndarray:
        self.looked_closer |= azimuth.size > 0
        return sources.radiance(self._source, sources.directions_of(azimuth, sine))

    def _divide(
        self, bands: list[Band], sizes: np.ndarray, total: float, peaks: Peaks
    ) -> tuple[Cells, float, float]:
        """(leaves of the divided cells, relative error, all light).

        Cells are divided where the second difference of brightness is large.
        """
        total = max(total, 1e-300)
        cells, step, variance = self._rough_cells(bands, sizes, total, peaks)
        leaves = _Leaves([], total - float(cells.light @ cells.solid_angle), variance)
        evaluations, per_cell = MOST_CELL_EVALUATIONS, (CELL_PARTS + 2) ** 2
        for _ in range(MOST_DIVISIONS):
            error = math.sqrt(leaves.variance + float(np.sum(step**2)) / 12)
            converged = error <= CONVERGED_CELL * leaves.light_with(cells) and not peaks
            named = _near(cells, peaks)  # these are divided in any case: steps may not show a feature yet
            room = evaluations // per_cell
            if not len(step) or not (room or named.any()) or converged:
                break
            if len(step) - named.sum() > room:  # the largest steps first
                order = np.argsort(np.where(named, -np.inf, -step), kind="stable")
                first, rest = np.split(order, [named.sum() + room])
                leaves.add(self._leaf(cells.pick(rest), step[rest]), step[rest])
                cells, step, named = cells.pick(first), step[first], named[first]
            evaluations -= int(np.count_nonzero(~named)) * per_cell
            needles = cells.are_needles
            parts = [self._parts(cells.pick(~needles)), self._parts(cells.pick(needles), across=1)]
            cells, step = _joined(part for part, _ in parts), np.concatenate([step for _, step in parts])
            divide = (step > ROUGH_SHARE * leaves.light_with(cells)) | _near(cells, peaks)
            leaves.add(self._leaf(cells.pick(~divide), step[~divide]), step[~divide])
            cells, step = cells.pick(divide), step[divide]
        leaves.add(self._leaf(cells, step), step)
        return _joined(leaves.cells), math.sqrt(leaves.variance) / max(leaves.total, 1e-300), leaves.total

    def _divide_bright(self, band: Band, limit: float) -> Cells | None:
        """The parts of a map's cells that are or touch cells above ``limit``; None where these are too many.

        Edges of windows and shadows cut small lights, whose pixels a few cells of even brightness are not.
        """
        bright = np.pad(band.light > limit, 1)
        bright[:, [0, -1]] = bright[:, [-2, 1]]
        bright = bright[:, :-2] | bright[:, 1:-1] | bright[:, 2:]
        row, col = np.nonzero(bright[:-2] | bright[1:-1] | bright[2:])
        if not len(row) or len(row) * (CELL_PARTS + 2) ** 2 > MOST_CELL_EVALUATIONS:
            return None
        return self._parts(band.cells(row, col, 0), is_linear=True)[0]

    def _rough_cells(
        self, bands: list[Band], sizes: np.ndarray, total: float, peaks: Peaks
    ) -> tuple[Cells, np.ndarray, float]:
        """(base cells to be divided, their second differences, variance of the others).

        The brightness of the others becomes the mean over the cell: by its curvature where it is smooth, else
        by samples.
        """
        begin, corrections, variance = [], [], 0.0
        for n, band in enumerate(bands):
            light, angle = band.light, band.solid_angle
            step, correction = _band_steps(bands, n)
            step *= angle
            mark = (step > ROUGH_SHARE * total) | _near_base(band, peaks)
            row, col = np.nonzero(mark)
            begin.append((band.cells(row, col, sizes[n]), step[row, col]))
            rough = ~mark & (step > np.maximum(ROUGH * light * angle, NEGLIGIBLE * total))
            corrections.append(np.where(mark | rough, 0, correction))
            row, col = np.nonzero(rough)
            light[row, col] = self._jittered_mean(band.cells(row, col, sizes[n]), JITTERED)
            variance += float(np.sum(step[rough] ** 2)) / (12 * JITTERED**3)
        for band, correction in zip(bands, corrections):
            band.light[...] = np.maximum(0, band.light + correction)
        return _joined([cells for cells, _ in begin]), np.concatenate([step for _, step in begin]), variance

    def _parts(
        self, cells: Cells, is_linear: bool = False, across: int = CELL_PARTS
    ) -> tuple[Cells, np.ndarray]:
        """The CELL_PARTS x ``across`` parts of each cell, and their second differences times solid angle.

        ``is_linear``: the mean over a part is its middle by solid angle, as of a map's pixels, whose borders
        they share. That lies h^2 tan(elevation) / 12 below the middle of its height h.
        """
        # with a neighbour on every side
        place, places = ((np.arange(-1, count + 1) + 0.5) / count for count in (CELL_PARTS, across))
        azimuth = cells.azimuth[:, None] + cells.width[:, None] * (places - 0.5)
        low, height = cells.low[:, None], (cells.high - cells.low)[:, None]
        edges = low + height * (np.arange(CELL_PARTS + 1) / CELL_PARTS)
        elevation = np.clip(low + height * place, 0, math.pi / 2)
        if is_linear:
            height = height / CELL_PARTS
            elevation -= np.minimum(height**2 * np.tan(elevation) / 12, height / 6)
        sine = np.sin(elevation)
        sampled = np.empty((len(sine), CELL_PARTS + 2, across + 2))
        for some in np.array_split(np.arange(len(sine)), sampled.size // EVALUATION_BATCH + 1):
            sampled[some] = self._radiance(azimuth[some, None, :], sine[some, :, None])
        step, correction = _second_differences(sampled)
        light, azimuth = sampled[:, 1:-1, 1:-1], azimuth[:, 1:-1]
        light = np.where(is_linear | (step > ROUGH * light), light, np.maximum(0, light + correction))
        width, base = cells.width[:, None, None] / across, cells.base[:, None, None]
        values = azimuth[:, None, :], width, edges[:, :-1, None], edges[:, 1:, None], light, base
        parts = Cells(*(np.broadcast_to(part, light.shape).ravel() for part in values))
        return parts, step.ravel() * parts.solid_angle

    def _leaf(self, cells: Cells, step: np.ndarray) -> Cells:
        """Cells that are not divided any more."""
        rough = np.flatnonzero(step > ROUGH * cells.light * cells.solid_angle)
        cells.light[rough] = self._jittered_mean(cells.pick(rough))
        return cells

    def _jittered_mean(self, cells: Cells, samples: int = 1) -> np.ndarray:
        """Mean brightness at ``samples`` x ``samples`` places in every cell, jittered.

        An edge that runs along cells is then met at all places of it.
        """
        u, v = np.outer(R2_STEPS, np.arange(len(cells.light))) % 1
        total = np.zeros(len(u))
        for some in np.array_split(np.arange(len(u)), len(u) // EVALUATION_BATCH + 1):
            for i in range(samples):
                for j in range(samples):
                    azimuth = cells.azimuth[some] + ((u[some] + i) / samples - 0.5) * cells.width[some]
                    elevation = cells.low[some] + (v[some] + j) / samples * (cells.high - cells.low)[some]
                    total[some] += self._radiance(azimuth, np.sin(elevation))
        return total / samples**2

    def table(self, angles: np.ndarray, widths: np.ndarray, knots: int | None = None) -> np.ndarray:
        """Brightness as sweeps take it, without the suns: (K, knots, 4) float32.

        Integrals of B cos^2 and of B sin cos over elevation, from its diamond angle i / (knots - 1) to the
        zenith, averaged over the sectors round ``angles`` that are ``widths`` wide [rad], and their
        differences to the next knot. Kept, not to be changed.
        """
        count = knots or self.knots

        def make() -> np.ndarray:
            sines = np.sin(elevation_of(np.linspace(0, 1, count)))
            return _with_steps(self.above(angles - widths / 2, angles + widths / 2, sines) / widths[:, None])

        return self.once(("table", angles.tobytes(), widths.tobytes(), count), make)

    def above(
        self, begin: np.ndarray, end: np.ndarray, sines: np.ndarray, unbiased: bool = False
    ) -> np.ndarray:
        """Integrals of B cos^2, B sin cos above elevations and between azimuths: (2, K, elevations) float64.

        ``sines``: of the elevations.

        ``unbiased``: of sectors all round, the excess of interpolation between means of cells, where
        brightness is convex, is subtracted.
        """
        sums = self._sums
        if unbiased:  # of base cells: 1/24 by the mean, 1/24 since they are even
            cells = (_sharpened(np.diff(part, axis=0).transpose(1, 2, 0), 1 / 12) for part in sums)
            sums = [_cumulative(c) for c in cells]
        light = np.concatenate([_between(part, begin, end) for part in sums], 1)
        if unbiased:  # 1/24 by the mean, 1/12 by interpolation
            light = _sharpened(light / (end - begin), 1 / 8) * (end - begin)
        # from the zenith to the rows' lower edges
        down = np.concatenate([np.cumsum(light[:, ::-1], 1)[:, ::-1], np.zeros_like(light[:, :1])], 1)
        if unbiased:
            down[:, 1:-1] -= _gentle_steps(light[:, 1:], light[:, :-1]) / 12
        at = np.interp(sines, np.sin(self._edges), np.arange(len(self._edges)))
        low = np.minimum(at.astype(int), len(self._edges) - 2)
        # brightness is even within a row; near the horizon sin cos is not
        here, borders = antiderivatives(np.arcsin(np.clip(sines, 0, 1))), antiderivatives(self._edges)
        exact = (here - borders[:, low]) / (borders[:, low + 1] - borders[:, low])
        part = np.where(self._edges[low] < CURVED, exact, at - low)[..., None]
        above: np.ndarray = ((1 - part) * down[:, low] + part * down[:, low + 1]).swapaxes(1, 2)
        return above

    @property
    def nbytes(self) -> int:
        """Of all that is kept."""
        return self._nbytes + self._kept_bytes() + sum(spot.nbytes for spot in self.bright_parts)

    def _kept_bytes(self) -> int:
        return sum(table.nbytes for table in list(self._kept.values()))

    def once(self, key: tuple[Any, ...], make: Callable[[], np.ndarray]) -> np.ndarray:
        """What ``make`` gives, kept under ``key``, which says all that it depends on; not to be changed."""
        made = self._kept.get(key)
        if made is None:
            made = make()
            made.flags.writeable = False
            if made.nbytes > KEPT_TABLE_BYTES:
                return made
            self._kept[key] = made
            for oldest in list(self._kept):
                if self._kept_bytes() <= KEPT_TABLE_BYTES:
                    break
                self._kept.pop(oldest, None)
        return made

    def chords(self, turns: int, knots: int) -> np.ndarray:
        """The brightness of a lamp or window as slices take it, without small bright parts.

        The integrals of :meth:`above` per radian, over even cells of the diamond angle: (turns, knots, 2)
        float32; see opencl/slices.cl. Kept, not to be changed.
        """

        def make() -> np.ndarray:
            azimuth = np.append(diamond_azimuths(turns) % (2 * math.pi), 2 * math.pi)
            light = self.above(azimuth[:-1], azimuth[1:], np.linspace(0, 1, knots), True)
            per_radian = (light / np.diff(azimuth)[:, None]).transpose(1, 2, 0)
            return np.ascontiguousarray(per_radian, np.float32)

        return self.once(("chords", turns, knots), make)


# 1.3 MB each, besides KEPT_TABLE_BYTES at most, and 20 to 60 ms to make
_of_formulas = functools.lru_cache(16)(Integrals)


class _Kept:
    """Integrals of brightness that comes from an object, kept while that lives, the last used ones."""

    lock: threading.RLock

    def __init__(self) -> None:
        give_lock(self)
        self.of: OrderedDict[tuple[Any, ...], Integrals] = OrderedDict()
        self.owners: set[int] = set()

    def get(self, owner: Any, how: tuple[Any, ...]) -> Integrals | None:
        """``how``: hashable; all that they depend on besides ``owner``."""
        key = id(owner), *how
        with self.lock:
            if key in self.of:
                self.of.move_to_end(key)
            return self.of.get(key)

    def put(self, owner: Any, how: tuple[Any, ...], made: Integrals) -> None:
        with self.lock:
            if id(owner) not in self.owners:
                weakref.finalize(owner, self.forget, id(owner)).atexit = False
                self.owners.add(id(owner))
            self.of[id(owner), *how] = made
            while len(self.of) > 1 and sum(one.nbytes for one in list(self.of.values())) > KEPT_BYTES:
                self.of.popitem(last=False)

    def forget(self, owner: int) -> None:
        with self.lock:
            self.owners.discard(owner)
            for key in [key for key in self.of if key[0] == owner]:
                del self.of[key]


_of_objects = _Kept()


def integrals(
    source: sources.Source, tolerance: float = 0.01, fine: bool = False, widest: float = WIDEST
) -> Integrals:
    """The Integrals of a sky, nothing of which is to be changed; they are kept.

    Those of a function, which may depend on anything, are kept if they were made of its values in base cells
    alone. These are computed each time, a fifth of the work: where all are the same, so are the integrals.
    """
    brightness = varying(source)
    if brightness.by_formula():
        return _of_formulas(source, tolerance, fine, widest)
    held, named = brightness.held_by(), bool(_peaks(source))
    if held is None or not type(held.owner).__weakrefoffset__ or named and not held.lasts:
        return Integrals(source, tolerance, fine, widest)
    how: tuple[Any, ...] = tolerance, fine, widest, held.part
    bands: list[Band] | None = None
    if not held.lasts:
        bands = _bands(source, fine)
        how = *how, *(hash(band.light.tobytes()) for band in bands)
    kept = _of_objects.get(held.owner, how)
    if kept is None:
        kept = Integrals(source, tolerance, fine, widest, bands)
        if held.lasts or not kept.looked_closer:
            _of_objects.put(held.owner, how, kept)
    return kept


def sector_multiples(parts: Sequence[BrightPart]) -> list[int]:
    """How many times as many sectors each of some small bright parts has as one with little light.

    Derived: where errors are independent and in proportion to light over sectors, and sectors cost the same,
    no others as many have a smaller error than those in proportion to light to the power of 2/3.
    """
    powers = np.array([part.power for part in parts]) ** (2 / 3)
    return np.maximum(1, np.rint(len(powers) * powers / powers.sum())).astype(int).tolist() if parts else []


def without(brightness: sources.Brightness, parts: Sequence[BrightPart], L: np.ndarray) -> np.ndarray:
    """The brightness towards ``L`` (..., 3), cut within small bright parts at the level where they begin."""
    return cut(sources.radiance(sources.Sky(brightness), L), parts, L)


def cut(values: np.ndarray, parts: Sequence[BrightPart], L: np.ndarray) -> np.ndarray:
    """Brightness ``values`` (...) towards ``L`` (..., 3), cut as in :func:`without`."""
    flat, ways = values.flatten(), L.reshape(-1, 3)
    for first in range(0, len(flat), CUT_AT_ONCE):
        some = slice(first, first + CUT_AT_ONCE)
        x, y, z = np.ascontiguousarray(ways[some].T)
        here = flat[some]
        for part in parts:
            middle, sine = part.cone
            cosine = x * middle[0] + y * middle[1] - z * middle[2]
            within = np.flatnonzero(cosine > math.sqrt(1 - sine * sine))
            here[within] = np.minimum(here[within], part.limit)
    return flat.reshape(values.shape)


def _gentle_steps(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """other - one, 0 where one is more than SHARPEST times the other: an edge, which nothing sharpens."""
    gentle = np.maximum(one, other) <= SHARPEST * np.minimum(one, other)
    return np.where(gentle, other - one, 0.0)


def _sharpened(cells: np.ndarray, share: float) -> np.ndarray:
    """Cells (2, rows, K) all round less a share of their second differences, but for edges; sums stay."""
    steps = _gentle_steps(cells, np.roll(cells, -1, 2))
    sharp: np.ndarray = cells - share * (steps - np.roll(steps, 1, 2))
    return sharp


def even(count: int, offset: float) -> Azimuths:
    """``count`` even sectors; the azimuth of sector n is 2 pi (n + offset) / count."""
    return Azimuths(count, tuple(2 * math.pi * (np.arange(count + 1) + offset - 0.5) / count))


def _peaks(source: sources.Source) -> Peaks | None:
    """The narrow features that a sky names; None if it names none, () if it states that there are none."""
    named = sources.narrow_features(source)
    if named is None:
        return None
    return tuple(
        (math.atan2(y, x) % (2 * math.pi), max(0.0, math.atan2(-z, math.hypot(x, y))))
        for x, y, z in named
        if -z >= -MOST_SET * math.hypot(x, y)  # of one whose middle has set, a part may be up
    )


def _with_disc(sky: sources.Distribution, disc: sources.Disc) -> sources.BrightnessFunction:
    """The brightness of a sky with its sun's disc."""

    def brightness(L: np.ndarray) -> np.ndarray:
        inside = np.asarray(L, float) @ np.array(disc.direction) > np.cos(disc.radius)
        return sky(L) + np.where(inside, disc.brightness, 0.0)

    return brightness


def _function_of(source: sources.Source) -> Any:
    """The brightness with the sun's disc, which is part of the sky."""
    brightness = varying(source)
    disc = brightness.disc()
    return source.brightness if disc is None else _with_disc(brightness, disc)


def _bands(source: sources.Source, fine: bool) -> list[Band]:
    """The base cells of a sky; ``fine``: small ones, also where narrow features are named."""
    image = varying(source).equirectangular()
    if image is not None:
        return _of_map(image)
    return _of_function(_function_of(source), _peaks(source) is not None and not fine)


def _of_function(function: Any, named: bool) -> list[Band]:
    """Bands of rows from the horizon up, with half as many cells each time the circle is half as long."""
    count, around = (COARSE_ROWS, COARSE_COLS) if named else (ROWS, COLS)
    borders = np.linspace(0, math.pi / 2, count + 1)
    middle = (borders[1:] + borders[:-1]) / 2
    halvings = (around & -around).bit_length() - 2  # so many that 18 cells are round the zenith
    level = np.minimum(np.floor(-np.log2(np.cos(middle))).astype(int), halvings)
    bands, sky = [], sources.Sky(function)
    for n in range(halvings + 1):
        rows, cols = np.flatnonzero(level == n), around >> n
        # every row starts farther on, so that no border in azimuth runs along cells
        start, turned = 2 * math.pi / cols * (GOLDEN * rows % 1), 2 * math.pi / cols * np.arange(cols)
        out, sine = np.cos(middle[rows])[:, None], np.sin(middle[rows])[:, None]
        c, s, cosines, sines = np.cos(start)[:, None], np.sin(start)[:, None], np.cos(turned), np.sin(turned)
        light = np.empty((len(rows), cols))
        for some in np.array_split(np.arange(len(rows)), max(1, len(rows) * cols // EVALUATION_BATCH)):
            L = np.empty((len(some), cols, 3))
            L[..., 0] = out[some] * (c[some] * cosines - s[some] * sines)
            L[..., 1] = out[some] * (s[some] * cosines + c[some] * sines)
            L[..., 2] = -sine[some]
            light[some] = sources.radiance(sky, L)
        bands.append(Band(light, start, borders[rows[0] : rows[-1] + 2]))
    top = sources.radiance(sky, np.array([[0.0, 0.0, -1.0]]))  # a light in the zenith is met for sure
    np.maximum(bands[-1].light[-1], top[0], out=bands[-1].light[-1])
    lowest = bands[0].light[0]  # and one of which little is above the horizon
    azimuths = bands[0].start[0] + bands[0].width * np.arange(len(lowest))
    level = sources.radiance(sky, sources.directions_of(azimuths, np.zeros(len(lowest))))
    np.copyto(lowest, level, where=level > (1 + ROUGH) * lowest)
    return bands


def _of_map(image: np.ndarray) -> list[Band]:
    """The same of an equirectangular map (rows, cols): its pixels, divided where they are coarse."""
    rows, cols = image.shape
    finer = -(-ROWS // rows) if rows % 2 == 0 else 2 * -(-ROWS // (2 * rows))
    count, times = rows * finer // 2, -(-COLS // (2 * cols))
    upper = np.pad(image, ((1, 1), (0, 0)), mode="edge")[: -(-rows // 2) + 2]
    around = np.pad(_means_down(upper.T, finer, count)[:, ::-1], ((1, 1), (0, 0)), mode="wrap")
    light = np.ascontiguousarray(_cell_means(around.T, times))
    width = np.full(count, math.pi / (cols * times))
    return [Band(light, width, np.linspace(0, math.pi / 2, count + 1))]


def _means_down(values: np.ndarray, times: int, count: int) -> np.ndarray:
    """:func:`_cell_means` by solid angle, of ``count`` cells from the zenith down: (n, count).

    The middle of a cell of height h by solid angle lies h^2 tan(elevation) / 12 lower, as far as h / 6 at the
    zenith.
    """
    parts = 1 + times % 2  # halves, on which values are linear
    height = math.pi / 2 / (parts * count)
    middle = math.pi / 2 - height * (np.arange((values.shape[1] - 2) * parts * times) + 0.5)
    means = _cell_means(values, parts * times, height * np.tan(middle) / 12)[:, : parts * count]
    if parts == 1:
        return means
    weight = np.cos(middle[: parts * count])
    upper, lower = (means[:, n::2] * weight[n::2] for n in (0, 1))
    joined: np.ndarray = (upper + lower) / (weight[::2] + weight[1::2])
    return joined


def _cell_means(values: np.ndarray, times: int, moved: np.ndarray | None = None) -> np.ndarray:
    """Means over the cells that pixels (n, pixels + 2) are divided into, (n, pixels x times).

    Values are linear between the middles of pixels; the first pixel and the last are only neighbours. Where
    the number is odd, a cell in the middle of each pixel has a kink: its mean is not its middle. Where it is
    even, values at places ``moved`` (pixels x times,) [cell] onwards from the middles of cells.
    """
    before, own, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
    means = np.empty((*own.shape, times))
    for cell in range(times):
        past: Any = (cell + 0.5) / times - 0.5
        if 2 * cell + 1 == times:
            means[..., cell] = (1 - 1 / (4 * times)) * own + (before + after) / (8 * times)
            continue
        beyond = before if past < 0 else after
        if moved is not None:
            past = past + moved[cell::times] / times
        means[..., cell] = own + np.abs(past) * (beyond - own)
    return means.reshape(len(values), -1)


def _cumulative(cells: np.ndarray) -> np.ndarray:
    """Sums of (2, rows, cells) over azimuth before every cell and after the last: (cells + 1, 2, rows).

    Those of an azimuth lie together, since they are looked up together.
    """
    sums = np.zeros((cells.shape[2] + 1, *cells.shape[:2]))
    np.cumsum(cells.transpose(2, 0, 1), axis=0, out=sums[1:])
    return sums


def _between(sums: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Integrals (2, rows, K) between azimuths, which may lie beyond a turn.

    ``sums`` (cells + 1, 2, rows): cumulative over azimuth from 0.
    """
    cells = len(sums) - 1

    def until(azimuth: np.ndarray) -> Any:
        turns, at = np.divmod(np.asarray(azimuth) * (cells / (2 * math.pi)), cells)
        low = np.minimum(at.astype(int), cells - 1)
        below, (part, turns) = sums[low], (v[:, None, None] for v in (at - low, turns))
        return below + part * (sums[low + 1] - below) + turns * sums[-1]

    return np.moveaxis(until(end) - until(begin), 0, 2)


def antiderivatives(elevation: np.ndarray) -> np.ndarray:
    """Integrals of cos^2 and of sin cos from level: (2, ...)."""
    return np.stack([elevation / 2 + np.sin(2 * elevation) / 4, np.sin(elevation) ** 2 / 2])


def _median(bands: list[Band]) -> float:
    """Of brightness, by solid angle."""
    every = [max(1, band.light.shape[1] // 128) for band in bands]
    light = np.concatenate([band.light[:, ::n].ravel() for band, n in zip(bands, every)])
    counts = [band.light[:, ::n].shape[1] for band, n in zip(bands, every)]
    shares = zip(bands, every, counts)
    weight = np.concatenate([np.repeat(n * band.solid_angle, k, 1).ravel() for band, n, k in shares])
    order = np.argsort(light)
    return float(light[order][np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)])


def _second_differences(light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the inner cells of blocks (n, rows, cols): (n, rows - 2, cols - 2) each.

    The largest absolute second difference over rows, columns and diagonals, which is 0 on an even slope; and
    by how much the mean over a smooth cell exceeds its middle, from the curvature.
    """

    def moved(i: int, j: int) -> np.ndarray:
        return light[:, 1 + i : light.shape[1] - 1 + i, 1 + j : light.shape[2] - 1 + j]

    bent = [moved(-i, -j) - 2 * moved(0, 0) + moved(i, j) for i, j in ((0, 1), (1, 0), (1, 1), (1, -1))]
    return np.maximum.reduce([np.abs(values) for values in bent]), (bent[0] + bent[1]) / 24


def _band_steps(bands: list[Band], n: int) -> tuple[np.ndarray, np.ndarray]:
    """:func:`_second_differences` (rows, cols) of a band, its neighbours being the bands below and above."""
    band, light = bands[n], bands[n].light
    # a row of the band below has twice as many cells
    below = bands[n - 1].light[-1:].reshape(1, -1, 2).mean(2) if n else light[:1]
    above = bands[n + 1].light[:1].repeat(2, 1) if n + 1 < len(bands) else light[-1:]
    rows = np.concatenate([below, light, above])
    around = np.pad(rows, ((0, 0), (1, 1)), "wrap")
    step, correction = (values[0] for values in _second_differences(around[None]))
    # rows grow narrow towards the zenith: their lower half weighs more
    middle: np.ndarray = (band.borders[1:] + band.borders[:-1]) / 2
    correction = correction - (rows[2:] - rows[:-2]) * (np.tan(middle) * np.diff(band.borders) / 24)[:, None]
    return step, correction


def _near_base(band: Band, peaks: Peaks) -> np.ndarray:
    """Which cells of a band (rows, cols) hold a peak, or touch one that does: it may lie across borders."""
    is_near: np.ndarray = np.zeros(band.light.shape, bool)
    height = np.diff(band.borders)[:, None]
    middle: np.ndarray = (band.borders[1:, None] + band.borders[:-1, None]) / 2
    azimuths: np.ndarray = band.start[:, None] + np.arange(is_near.shape[1]) * band.width
    for azimuth, elevation in peaks:
        turned = np.abs(np.mod(azimuths - azimuth + math.pi, 2 * math.pi) - math.pi)
        size = np.maximum(band.width * np.cos(band.borders[:-1, None]), height)
        near = turned * math.cos(elevation) <= 1.5 * size
        is_near |= near & (np.abs(middle - elevation) <= 1.5 * height)
    return is_near


def _near(cells: Cells, peaks: Peaks) -> np.ndarray:
    """Which cells (n,) hold a peak, or touch one that does."""
    is_near = np.zeros(len(cells.light), bool)
    for azimuth, elevation in peaks:
        turned = np.abs((cells.azimuth - azimuth + math.pi) % (2 * math.pi) - math.pi)
        raised, height = np.abs((cells.low + cells.high) / 2 - elevation), cells.high - cells.low
        beside = turned <= 1.5 * cells.width
        beside |= cells.are_needles & (turned * math.cos(elevation) <= 1.5 * height)
        is_near |= beside & (raised <= 1.5 * height)
    return is_near


def _joined(groups: Iterable[Cells]) -> Cells:
    return Cells(*(np.concatenate(values) for values in zip(*groups)))


def _bright_parts(cells: Cells, limit: float, widest: float, depth: int = 12) -> Iterator[BrightPart]:
    """Groups of bright cells that span little azimuth, with their light above ``limit``.

    Wider groups are split at a higher limit.
    """
    for part in _groups(cells):
        spot = BrightPart(part._replace(light=part.light - limit), limit)
        is_narrow = part.azimuth[-1] - part.azimuth[0] + part.width.max() <= widest
        # or round the zenith; what is larger than such a disc needs no search for its radius
        small = part.solid_angle.sum() <= 2 * math.pi * (1 - math.cos(widest / 2))
        if is_narrow or small and (part.light > limit).any() and spot.cone[1] <= math.sin(widest / 2):
            yield from _nested(spot, part, widest)
        elif depth:
            limit_here = max(4 * limit, LEAST_LEVEL * float(part.light.max()))
            yield from _bright_parts(part.pick(part.light > limit_here), limit_here, widest, depth - 1)


def _nested(spot: BrightPart, cells: Cells, widest: float) -> Iterator[BrightPart]:
    """A sun; or, where far brighter and smaller parts lie in it (a disc in its aureole), the rest and these.

    The sectors of one sun are of one width.
    """
    power, extent, brightest = spot.power, _extent(cells), float(cells.light.max())
    limit = spot.limit
    while (limit := max(4 * limit, LEAST_LEVEL * brightest)) < brightest:
        inside = cells.light > limit
        if (cells.light - limit)[inside] @ cells.solid_angle[inside] < INNER * power:
            break
        inner = cells.pick(inside)
        if _extent(inner) <= 0.5 * extent or all(_extent(part) <= 0.5 * extent for part in _groups(inner)):
            yield BrightPart(cells._replace(light=np.minimum(cells.light, limit) - spot.limit), spot.limit)
            yield from _bright_parts(inner, limit, widest, 0)
            return
    yield spot


def _extent(cells: Cells) -> float:
    """About how wide they are [rad]; cells in order of azimuth."""
    low, span = float(cells.low.min()), float(np.ptp(cells.azimuth) + cells.width.max())
    return max(float(cells.high.max()) - low, span * math.cos(low))


def _groups(cells: Cells, axis: int = 0) -> Iterator[Cells]:
    """Cells split at gaps in azimuth, these at gaps in elevation, and so on.

    Each group is in order of azimuth, which may run past 2 pi.
    """
    if not len(cells.light):
        return
    if axis:
        order = np.argsort(cells.low, kind="stable")
        gaps, sizes = np.diff(cells.low[order]), (cells.high - cells.low)[order]
    else:
        azimuth = cells.azimuth % (2 * math.pi)
        order = np.argsort(azimuth, kind="stable")
        gaps = np.diff(azimuth[order], append=azimuth[order[0]] + 2 * math.pi)
        first = (int(gaps.argmax()) + 1) % len(order)  # the circle is opened at its largest gap
        order, gaps = np.roll(order, -first), np.roll(gaps, -first)[:-1]
        azimuth = azimuth[order]
        past = np.where(azimuth < azimuth[0], azimuth + 2 * math.pi, azimuth)
        cells = cells.pick(order)._replace(azimuth=past)
        order, sizes = np.arange(len(order)), cells.width
    wider = np.maximum(sizes[:-1], sizes[1:])  # round the zenith neighbours may be of very different widths
    cuts = np.flatnonzero(gaps > np.maximum(DARK_GAP, 2 * wider)) + 1
    if len(cuts):
        for part in np.split(order, cuts):
            yield from _groups(cells.pick(part), 1 - axis)
    elif axis:
        yield cells
    else:
        yield from _groups(cells, 1)


def _with_steps(values: np.ndarray) -> np.ndarray:
    """(2, K, knots) -> (K, knots, 4) float32: values, and their differences to the next knot."""
    table = np.zeros((*values.shape[1:], 4), np.float32)
    table[..., :2] = values.transpose(1, 2, 0)
    table[:, :-1, 2:] = np.diff(values, axis=2).transpose(1, 2, 0)
    return table
