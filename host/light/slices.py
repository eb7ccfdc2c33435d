"""Launch sequence of azimuth slices: light of finite sources, through a few slices per node.

The same slices sum the reflection of such a source, or of the sky, by a lobe about the mirror direction.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from ..backends.base import Array, reserve_map
from ..backends.resident import Resident
from ..constants import ENDLESS, NONE, SLICES
from ..sources import Source, number_of, radiance
from ..sources.solids import Ball, Dome, Quad
from .propagation import Lobe

MOST = 32  # of a source that surrounds a node, by default
WALLED = 2  # times as many where a wall cuts the source
CELL_LEVELS = 9  # cells of 2 to 512 nodes
BRIGHTNESS_SIDE = 512  # samples of the brightness across the sky
LOBE_POINTS, LOBE_VARIES = 10, 14  # samples of a lobe along a chord within its rim; where brightness varies
# slices of a lobe: least, where the zenith lies within it, and through a lamp
LOBE_LEAST, LOBE_ROUND, LOBE_MOST = 16, 32, 256
# cells of a table of brightness in two half widths of a lobe, and along its side at least. Chosen: on level
# ground under CIE skies lobes of exponents 1 to 1000 err by 0.3 % at most; with half of the side by 0.9 %,
# with a quarter of it and half of the cells by 3.7 %. With twice the cells a light of 5 degrees errs by 11 %
# in a lobe of exponent 100, in place of 3.3 %, with half by 32 %
LOBE_CELLS, LOBE_SIDE = 16, 64
LOBE_APART = 1.1  # half widths of a lobe between two slices of a lamp
LOBE_SAMPLES = 2048  # samples across the sky that a lobe's means are made of
SUNNY, SUNS = 4.0, 64  # times the mean brightness from which on light is a sun's; rays to suns
# apparent width [rad] of a source that is widened: of its light a square over 12 is lost, 3e-7, and float32
# holds its width to 5e-5; derived
THIN = 2e-3
# radius of a ball over its distance, below which it is enlarged: at 4e-6 slices in float32 err 2e-7, at 4e-7
# 6e-4, and at 4e-8 most nodes are black. So near, in nodes along rows and columns, the nearest node is looked
# for, and of its distance an enlarged ball has this share at most; chosen: light errs by its square
SMALL_BALL, NEAR_BALL, SMALL_SHARE = 1e-5, 8, 0.01
# along each side of the map, over which the median distance of a source is taken. Chosen: half and twice give
# four random pairs the same errors (performance/constants.py --seed 18)
MEDIAN_NODES = 32
# slope below which the ground of a map that repeats is not looked for. Chosen: with half of it the light of a
# sun 0.1 degrees high changes by 0.03 % (RMS over its mean), with 2.5 times by 2 %, that of suns 0.3 to 0.8
# degrees high not at all, in the same time
LOWEST_SUN = 0.002
MOST_SEARCHED = 2**24  # [spacing], how far rays look there at most: float32 holds no crossings farther away
# cells of azimuth and of the sine of elevation of a brightness, 8 bytes each: 0.35 degrees round the horizon,
# and 0.16 at an elevation of 85
CHORD_AZIMUTHS, CHORD_KNOTS = 1024, 4097


def stereographic_brightness(source: Source, side: int = BRIGHTNESS_SIDE) -> float | np.ndarray:
    """A source's brightness as Slices takes it for a lobe: a number where it is uniform, else (side, side).

    Row j, column i: the direction whose stereographic projection x / (1 - z), y / (1 - z) is 2 i / (side - 1)
    - 1 and 2 j / (side - 1) - 1; beyond the level, that of the level below it.
    """
    if not callable(source.brightness):
        return number_of(source)
    v, u = np.meshgrid(*(np.linspace(-1, 1, side),) * 2, indexing="ij")
    over = np.maximum(1.0, np.hypot(u, v))
    u, v = u / over, v / over
    square = u * u + v * v
    parts = []
    for some in (slice(first, first + BRIGHTNESS_SIDE) for first in range(0, side, BRIGHTNESS_SIDE)):
        along = np.stack([2 * u[some], 2 * v[some], np.minimum(square[some] - 1, 0)], -1)
        parts.append(radiance(source, along / (1 + square[some])[..., None]))
    values = np.concatenate(parts)
    return float(values.flat[0]) if np.ptp(values) == 0 else values


def blurred(
    source: Source, spread: float, fineness: int = 1
) -> tuple[float | np.ndarray, np.ndarray, np.ndarray]:
    """A source's brightness as a lobe of this half width [rad] takes it, in cells ``fineness`` times as fine.

    (number or table, suns (K, 3), their flux (K,)). The table holds means over cells of a quarter of a half
    width or less, so that little falls between the lobe's samples. Brightness beyond SUNNY times the mean is
    not in it, or beyond more where it is in more than SUNS places as a lobe sees them, half a half width
    across; it is given as a unit vector with brightness x solid angle for each of these.
    """
    suns: tuple[np.ndarray, np.ndarray] = np.zeros((0, 3)), np.zeros(0)
    fine = stereographic_brightness(source, LOBE_SAMPLES)
    if not isinstance(fine, np.ndarray):
        return fine, *suns
    u = np.linspace(-1, 1, LOBE_SAMPLES)
    square = u * u + u[:, None] ** 2
    angle = np.where(square <= 1, (2 * (u[1] - u[0]) / (1 + square)) ** 2, 0.0)  # of the plane's cells
    limit, count = SUNNY * float((fine * angle).sum() / angle.sum()) / 4, SUNS + 1
    block = max(0, math.floor(math.log2(spread * LOBE_SAMPLES / 8)))  # half a half width, at the zenith
    while count > SUNS:
        limit *= 4
        y, x = np.nonzero((fine > limit) & (square <= 1))
        which = np.unique((y >> block) * LOBE_SAMPLES + (x >> block), return_inverse=True)[1]
        count = which.max(initial=-1) + 1
    if count:
        flux = (fine[y, x] - limit) * angle[y, x]
        L = np.stack([2 * u[x], 2 * u[y], square[y, x] - 1], -1) / (1 + square[y, x, None])
        total = np.bincount(which, flux)
        middle = np.stack([np.bincount(which, flux * part) for part in L.T], -1)
        units: np.ndarray = middle / np.linalg.norm(middle, axis=1, keepdims=True)
        suns = units, total
        fine = np.minimum(fine, limit)
    side = min(fineness * max(math.ceil(LOBE_CELLS / spread), LOBE_SIDE), LOBE_SAMPLES // 2)
    share = np.arange(LOBE_SAMPLES) * ((side - 1) / (LOBE_SAMPLES - 1))
    first = np.minimum(share.astype(int), side - 2)
    blend = np.zeros((side, LOBE_SAMPLES))
    blend[first, np.arange(LOBE_SAMPLES)] = 1 - (share - first)
    blend[first + 1, np.arange(LOBE_SAMPLES)] = share - first
    blend /= blend.sum(1, keepdims=True)
    return blend @ fine @ blend.T, *suns


class Slices:
    """The light of a ball or a quadrangle over a map, all arrays on the device; ``run`` may be repeated."""

    def __init__(
        self,
        there: Resident,
        sides: str,
        solid: Ball | Quad | Dome,
        brightness: float | np.ndarray = 1.0,
        most: int = MOST,
        lobe: Lobe | None = None,
        shift: float = 0.5,
        copied: int = 0,
        fineness: float = 1,
    ):
        """``there``: the map; ``solid`` is in its unit, in which the spacing is ``there.step``.

        ``brightness``: a number; else the result of :func:`stereographic_brightness` with a lobe, and of
        ``Integrals.chords`` without one. ``most``: slices of a source that surrounds a
        node, a multiple of 8; one that looks small has a quarter of them, half if it is a quadrangle, but at
        least 8, and others a number between. ``lobe``: light is weighted by it, and its width gives the
        number of slices. A Dome has a lobe. ``shift``: where in its step every slice of a ball lies, 0..1;
        the slices of 0 lie between those of 0.5. ``copied``: nodes beside a map that repeats, each way, on
        which it goes on, for :meth:`sectors` alone. ``fineness``: times the slices of a lobe, and its samples
        in each where brightness varies.
        """
        rows, cols = self.shape = there.shape[0] + copied, there.shape[1] + copied
        count = rows * cols
        self.there, backend = there, there.backend
        self.backend, self.solid, self.step = backend, solid, there.step
        self.levels = min(max(round(math.log2(cols)) - 2, 1), CELL_LEVELS)
        self.width = -(-cols >> self.levels) << self.levels
        cells = (rows + 1) // 2
        images = 2 if isinstance(solid, Ball) else 1
        padded = (rows + 2) * (cols + 1)
        reserve_map(backend, count, 4 * (padded + cells * self.width + images * count), 4 * padded)
        lowest, self.highest = there.heights_range
        relief = max(1.0, self.highest - lowest)
        self.farthest = min(relief / LOWEST_SUN, MOST_SEARCHED) if copied else ENDLESS  # rays look [spacing]
        self.heights = there.heights(1, 1, copied, copied + 2, periodic=copied > 0)
        self.tops = backend.empty((cells, self.width), np.float32)
        self.image, self.coarsened = backend.empty(there.shape, np.float32), False
        if isinstance(solid, Ball):  # light of the even slices minus that of the odd ones
            self.alternating = backend.empty((rows, cols), np.float32)
        self.lobe, self.dark, self.walls, self.coarse = lobe, sides == "dark", sides == "dark", 0.0
        self.fineness = fineness
        if isinstance(solid, Dome):
            self.least, self.most = self._times_fineness(LOBE_LEAST), self._times_fineness(LOBE_ROUND)
        else:
            self._count_slices(solid, lowest, most)
        self._upload_tables(brightness, shift)

    def _count_slices(self, solid: Ball | Quad, lowest: float, most: int) -> None:
        """Set the least and largest number of slices per node."""
        rows, cols = self.shape
        center, radius, extent = self._place(solid)
        away = np.maximum(
            0,
            np.maximum(
                [0 - center[0], 0 - center[1], lowest - center[2]],
                [center[0] - (cols - 1), center[1] - (rows - 1), center[2] - self.highest],
            ),
        )
        apparent = radius / max(float(np.linalg.norm(away)), radius)
        below, above = extent[0] < -0.5 - 1e-6, extent[1] > np.array([cols, rows]) - 0.5 + 1e-6
        self.walls = self.walls and bool(below.any() or above.any())
        walled = WALLED if self.walls else 1
        if self.lobe is None:
            self.most = most * walled
            self.least = max(self.most // (4 if isinstance(solid, Ball) else 2) // SLICES, 1) * SLICES
            return
        resolved = math.ceil(2 * math.pi / (LOBE_APART * self.lobe.spread * SLICES)) * SLICES
        self.most = self._times_fineness(min(max(resolved, most), LOBE_MOST)) * walled
        self.least = self._times_fineness(LOBE_LEAST)
        turn = apparent * (0.318 + 0.182 * apparent**2)
        self.coarse = 2 * math.pi * turn / (self.least + turn * (self.most - self.least)) / self.lobe.spread

    def _times_fineness(self, slices: int) -> int:
        return math.ceil(self.fineness * slices / SLICES) * SLICES

    def _upload_tables(self, brightness: float | np.ndarray, shift: float) -> None:
        backend, lobe = self.backend, self.lobe
        values = np.asarray(brightness)
        varies = values.ndim > 0
        self.factor = 1.0 if varies else float(values)
        sky: Any = [[1.0, 1.0]] * 2  # a lobe weights a brightness, if only 1
        chords = np.zeros((1, 1, 2))
        self.side, self.turns, self.knots = 2, 0, 0
        if varies and lobe is not None:
            sky, self.side = values, len(values)
        elif varies:
            chords, (self.turns, self.knots, _) = values, values.shape
        self.sky = backend.table(np.asarray(sky, np.float32))
        points = round(LOBE_VARIES * self.fineness) if varies else LOBE_POINTS
        self.n_points = points if lobe is not None else 0
        self.points = backend.table(_on_unit(max(self.n_points, 1)))
        self.chords = backend.table(np.asarray(chords, np.float32))
        self.quadrature = backend.table(
            _quad_quadrature(self.most) if isinstance(self.solid, Quad) else ball_quadrature(self.most, shift)
        )
        self.table = backend.table(np.zeros(2, np.float32) if lobe is None else lobe.table)

    def _place(self, solid: Ball | Quad) -> tuple[np.ndarray, float, tuple[np.ndarray, np.ndarray]]:
        """(centre, radius of a sphere round the source, extent over the map as lowest and highest (x, y)).

        In spacings; heights third.
        """
        if isinstance(solid, Ball):
            self.center: np.ndarray = np.array(solid.center) / self.step * (1, 1, -1)
            self.radius = solid.radius / self.step
            return self.center, self.radius, (self.center[:2] - self.radius, self.center[:2] + self.radius)
        corners: np.ndarray = np.asarray(solid.corners, float) / self.step * (1, 1, -1)
        middle = corners.mean(0)
        normal = np.cross(corners[2] - corners[0], corners[3] - corners[1])
        # upwards, which decides for nodes in its own plane
        normal *= (1 if normal[2] >= 0 else -1) / np.linalg.norm(normal)
        self.corners = self.backend.table(
            np.concatenate([corners - middle, [middle, normal]]).astype(np.float32)
        )
        radius = np.linalg.norm(corners - middle, axis=1).max()
        return middle, radius, (corners[:, :2].min(0), corners[:, :2].max(0))

    def coarsen(self) -> None:
        """The highest ground of all cells, computed once."""
        if self.coarsened:
            return
        self.coarsened = True
        rows, cols = self.shape
        for level in range(1, self.levels + 1):
            dim = self.width >> level, ((rows - 1) >> level) + 1
            size = rows, cols, self.width, level
            self.backend.launch("slices", "coarser", dim, self.heights, self.tops, *size)

    def run(self) -> None:
        rows, cols = self.shape
        self.coarsen()
        n_lobe, rim = (len(self.lobe.table), self.lobe.rim) if self.lobe is not None else (0, 1.0)
        lit = self.sky, self.points, self.table
        size = rows, cols, self.width, self.levels, self.least, self.most, self.side, self.n_points, n_lobe
        chords, last = (self.turns, self.knots), (int(self.walls), rim, self.highest)
        given: tuple[Any, ...]
        tables: tuple[Array, ...] = self.quadrature, *lit, self.chords
        if isinstance(self.solid, Dome):
            reach = min(self.solid.reach / self.step, -float(NONE))
            kernel, given = "gloss", (self.quadrature, *lit, self.image, *size, *last, reach)
        elif isinstance(self.solid, Ball):
            images, ball = (self.image, self.alternating), (*map(float, self.center), float(self.radius))
            kernel, given = "ball", (*tables, *images, *size, *chords, *last, *ball)
        else:
            kernel, given = "quad", (self.corners, *tables, self.image, *size, *chords, *last)
        maps, dim = (self.heights, self.tops), (cols, rows)
        self.backend.launch("slices", kernel, dim, *maps, *given, self.factor, squares=True)

    def rays(self, ways: np.ndarray) -> np.ndarray:
        """Whether the ground occludes no part of rays: (rows, cols, count) bool.

        ``ways`` (rows, cols, 4, count) float32: azimuth's cosine and sine, tangent of the elevation, and
        distance [spacing] up to which ground occludes. ``coarsen`` or ``run`` comes before it.
        """
        rows, cols = self.shape
        count = ways.shape[-1]
        lanes = self.backend.lanes if count % self.backend.lanes == 0 else 1
        # named, so that they exist until the download
        given, seen = self.backend.upload(ways), self.backend.empty((rows, cols, count), np.float32)
        size = rows, cols, self.width, self.levels, count, self.highest
        maps = self.heights, self.tops, given, seen
        self.backend.launch("slices", "rays", (cols, rows), *maps, *size, lanes=lanes, squares=True)
        visible: np.ndarray = self.backend.download(seen) > 0
        return visible

    def sectors(
        self,
        ways: np.ndarray,
        table: np.ndarray,
        window: tuple[float, float, float, float] | None = None,
        other: Array = None,
        to_other: np.ndarray | None = None,
    ) -> None:
        """Add the light of a sky's bright spots, above exact horizons; the image holds light already.

        ``ways`` (5, K): azimuth's cosine and sine, width [rad], diamond angle of elevation at which the
        sector's table begins, and knots per unit of it. ``table`` (K, knots, 4): integrals of B cos^2 and B
        sin cos from each knot on, and their differences to the next. ``window`` (x0, x1, y0, y1) [spacing]:
        in the plane z = 0, through which the light comes. ``to_other`` (K,): 1 for sectors whose light is
        added to the image ``other``.
        """
        rows, cols = self.shape
        self.coarsen()
        used, knots = table.shape[:2]
        count = -(-used // SLICES) * SLICES  # the rest are at the zenith and have no width
        sectors, tables = np.zeros((6, count), np.float32), np.zeros((count, knots, 4), np.float32)
        sectors[3:5] = [[1], [1e9]]
        sectors[:5, :used], tables[:used] = ways, table
        if to_other is not None:
            sectors[5, :used] = to_other
        given = [self.backend.upload(array) for array in (sectors, tables)]  # held until the kernel is done
        ends = (-ENDLESS, ENDLESS) * 2 if window is None else tuple(map(float, window))
        maps = self.heights, self.tops, *given, self.image, self.image if other is None else other
        size = rows, cols, self.width, self.levels, count, knots, int(self.dark), *self.there.shape
        last, dim = (self.highest, self.farthest, *ends), self.there.shape[::-1]
        self.backend.launch("slices", "sectors", dim, *maps, *size, *last, squares=True)
        self.backend.finish()

    def download(self) -> np.ndarray:
        """The irradiance (rows, cols) float32, 0 where masked."""
        return self.backend.download(self.image)


@functools.cache
def _on_unit(count: int) -> np.ndarray:
    """Gauss-Legendre nodes and weights on 0..1: (count, 2) float32."""
    node, weight = np.polynomial.legendre.leggauss(count)
    table = np.stack([(1 + node) / 2, weight / 2], 1).astype(np.float32)
    table.flags.writeable = False
    return table


def ball_quadrature(most: int, shift: float) -> np.ndarray:
    """(most / SLICES, 4, most) float32, as the kernel ``ball`` reads it.

    ``shift``: where in its step a slice lies.
    """
    table = np.zeros((most // SLICES, 4, most), np.float32)
    for block in range(most // SLICES):
        count = SLICES * (block + 1)
        share = (np.arange(count) + shift) / count
        theta, azimuth = np.pi * (share - 0.5), 2 * np.pi * share
        table[block, :, :count] = np.sin(theta), np.cos(theta), np.sin(azimuth), np.cos(azimuth)
    return table


@functools.cache
def _quad_quadrature(most: int) -> np.ndarray:
    """(most, most, 2) float32, as the kernel ``quad`` reads it.

    All Gauss-Legendre rules at once, by Newton's method on Legendre polynomials.
    """
    table = np.zeros((most, most, 2), np.float32)
    for n in np.array_split(np.arange(1, most + 1)[:, None], -(-most // 64)):  # rules of similar size
        k = np.arange(int(n[-1, 0]))
        used = k < n
        # Tricomi's approximation, to 1e-4 of the distance between nodes but for n below 4
        x = -(1 - (n - 1) / (8.0 * n**3)) * np.where(used, np.cos(np.pi * (k + 0.75) / (n + 0.5)), 0.0)
        for _ in range(3):
            before, value, last = np.ones_like(x), x, np.ones_like(x)  # P_0, P_1; P_(n-1)
            polynomial = np.where(n == 1, value, 0.0)
            for degree in range(2, len(k) + 1):
                before, value = value, ((2 * degree - 1) * x * value - (degree - 1) * before) / degree
                if degree >= n[0, 0]:
                    at = degree - n[0, 0]
                    polynomial[at], last[at] = value[at], before[at]
            slope = np.where(used, n * (last - x * polynomial) / (1 - x * x), 1.0)
            x = np.where(used, x - polynomial / slope, 0.0)
        weight = np.where(used, 2 / ((1 - x * x) * slope**2), 0.0)
        table[n[:, 0] - 1, : len(k)] = np.stack([x, weight], -1)
    table.flags.writeable = False
    return table


def outline(window: Quad, step: float) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 [spacing] of a window."""
    (x0, y0, _), (x1, y1, _) = (
        of(np.asarray(window.corners, float) / step, axis=0).tolist() for of in (np.min, np.max)
    )
    return x0, x1, y0, y1


def _distances(place: np.ndarray, there: Resident, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """From a place to those of some nodes that are valid [unit of depth]."""
    depth = there.pick(y * there.shape[1] + x)
    away = np.sqrt(
        (x * there.step - place[0]) ** 2 + (y * there.step - place[1]) ** 2 + (depth - place[2]) ** 2
    )
    known: np.ndarray = away[np.isfinite(away)]
    return known


def _median_distance(place: np.ndarray, there: Resident) -> float:
    """Of some MEDIAN_NODES nodes along each side from a place [unit of depth]; 0 without a valid one."""
    y, x = np.mgrid[tuple(slice(0, n, max(1, n // MEDIAN_NODES)) for n in there.shape)]
    known = _distances(place, there, y, x)
    return float(np.median(known)) if known.size else 0.0


def _enlarged(ball: Ball, there: Resident) -> Ball:
    """A ball that float32 holds at most nodes, still small for those nearest to it."""
    center, ends = np.asarray(ball.center, float), np.array(there.shape[::-1]) - 1
    far = np.maximum(abs(center - [0, 0, there.least]), abs(center - [*(ends * there.step), there.most]))
    if ball.radius >= SMALL_BALL * np.linalg.norm(far):
        return ball  # at every node; without a look at them
    middle = np.clip(np.rint(center[:2] / there.step), 0, ends).astype(int)
    x, y = (np.arange(max(0, m - NEAR_BALL), min(n, m + NEAR_BALL) + 1) for m, n in zip(middle, ends))
    near = _distances(center, there, *np.meshgrid(y, x, indexing="ij"))
    most = SMALL_SHARE * near.min() if near.size else math.inf
    return ball._replace(radius=max(ball.radius, min(SMALL_BALL * _median_distance(center, there), most)))


def widened(solid: Ball | Quad, there: Resident) -> tuple[Ball | Quad, float]:
    """(A solid whose thin sides are widened to what float32 can resolve, factor of its light).

    Across so little, light is in proportion to the width. ``solid`` is in the unit of the map.
    """
    if isinstance(solid, Ball):
        ball = _enlarged(solid, there)
        return ball, (solid.radius / ball.radius) ** 2
    corners = np.asarray(solid.corners, float)
    middle = corners.mean(0)
    least = THIN * _median_distance(middle, there)
    edges, scale = [corners[1] - corners[0], corners[3] - corners[0]], 1.0
    for n, edge in enumerate(edges):
        length = float(np.linalg.norm(edge))
        if length < least:
            edges[n], scale = edge * (least / length), scale * length / least
    if scale == 1.0:
        return solid, 1.0
    corner = middle - (edges[0] + edges[1]) / 2
    return Quad(np.array([corner, corner + edges[0], corner + edges[0] + edges[1], corner + edges[1]])), scale
