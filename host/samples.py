"""Samples: some hundred nodes whose light is computed by exact rays, to choose methods and audit images.

Lengths are in spacings, heights grow towards the viewer. A slope is the tangent of an elevation. Rays test
every crossing with a grid line (kernel ``pilot``); the rest is NumPy, on (rays of a node, nodes).
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from . import sources
from .backends.base import Array, Backend
from .backends.resident import gather
from .constants import NONE, STEEP
from .light.far import CLIFF
from .scene import Scene
from .sources.integrals import R2_STEPS, Integrals, even
from .sources.solids import Ball, Quad

# nodes; chosen: their standard error of an RMS is some 1 / sqrt(2 x 384), 4 %, if errors are normal, and
# their rays take time in proportion
SAMPLE_COUNT = 384
# rays of samples on a periodic map end where its whole relief would rise at this slope: ground farther away
# hides at most 1.3e-5 of a uniform sky's E / pi
SAMPLED_SLOPE = 0.005
CHORD_POINTS = 48  # of brightness along a chord; chosen
# traced arrays (azimuths, nodes) that a scene keeps; chosen: slopes and light of four sets of azimuths, at
# most 12 MB
KEPT_TRACES = 8
# standard errors above the RMS at the samples: the bound on the RMS over all nodes. Chosen: one normal sample
# in 15 is larger. With half and twice all of 16 skies (64 x 64) are within 1 % as with it; the largest error,
# .91 of the tolerance, stays and becomes .68 (performance/constants.py)
SIGMAS = 1.5
# share of the tolerance that an estimate may take, of direct light or all; chosen: samples estimate an RMS to
# some 10 %, and with 0.95 one image in twelve at 0.3 % had an error of 1 to 1.4 tolerances
ESTIMATE_SHARE = 0.85


Values = Any  # numbers or arrays that broadcast


class Errors(NamedTuple):
    """Relative errors of a sample of nodes: RMS, a bound of the RMS over all nodes, and 99.9th percentile."""

    rms: float
    bound: float
    tail: float


def lit_mean(values: np.ndarray, weights: np.ndarray | None = None) -> float:
    """Mean where there is light, 0 where there is none."""
    lit = values > 0
    some = None if weights is None else weights[lit]
    return float(np.average(values[lit], weights=some)) if lit.any() else 0.0


def errors(image: np.ndarray, exact: np.ndarray, least: float = 0.0) -> Errors:
    """Errors of ``image`` relative to the mean of ``exact`` where it is positive, or to ``least`` if larger.

    The bound is the RMS plus SIGMAS standard errors, by the sample's own spread. The percentile is
    extrapolated from the largest tenth of the errors, whose excess is assumed to be exponential.
    """
    count, mean = len(exact), max(lit_mean(exact), least)
    if not mean > 0:
        return Errors(*(0.0 if not np.abs(image).max(initial=0) > 0 else math.inf,) * 3)
    off = np.sort(np.abs(image - exact)) / mean
    square = float(np.mean(off**2))
    bound = math.sqrt(square + SIGMAS * float(np.linalg.norm(off**2 - square)) / count)
    largest = off[math.ceil(0.9 * count) - 1 :]
    excess = largest - largest[0]
    tail = largest[0] + excess.sum() / max(1, np.count_nonzero(excess)) * math.log(100)
    return Errors(math.sqrt(square), bound, float(tail))


class Samples:
    """Nodes spread over the valid part of a map by a low-discrepancy sequence, from its element ``first`` on.

    They are the same for the same scene.
    """

    least = 0.0  # mean irradiance that errors are relative to at least
    traced: dict[tuple[str, bytes, float], np.ndarray]  # by kind, azimuths and search radius

    def __init__(self, engine: Backend, scene: Scene, count: int = SAMPLE_COUNT, first: int = 1):
        self.engine, self.sides, self.first = engine, scene.sides, first
        self.periodic = scene.sides == "periodic"
        self.rows, self.cols = rows, cols = scene.shape
        self.there, self.traced = scene.on(engine), {}
        self.shift = 5 if min(scene.shape) >= 512 else 4 if min(scene.shape) >= 64 else 3
        down, across = (((n - 1) >> self.shift) + 1 for n in (rows, cols))
        self.tops = engine.empty((3, down, across), np.float32)
        size = rows, cols, across, down, self.shift, int(self.periodic), CLIFF
        engine.launch("pilot", "pool", (across, down), self.heights, self.tops, *size, lanes=1)
        highest, lowest, cliffs = engine.download(self.tops).reshape(3, down, across)
        for axis in (0, 1):  # a step may run between blocks
            lowest = np.minimum(
                lowest, np.concatenate([np.delete(lowest, 0, axis), np.take(lowest, [-1], axis)], axis)
            )
        self.highest, self.relief = float(highest.max()), float(highest.max() - lowest.min())
        pairs = (
            rows * (cols - 1) + (rows - 1) * cols
            if scene.mask is None
            else int(
                (scene.mask[:, 1:] & scene.mask[:, :-1]).sum() + (scene.mask[1:] & scene.mask[:-1]).sum()
            )
        )
        self.cliffs = float(cliffs.sum(dtype=np.float64)) / max(1, pairs)
        self.set_nodes(*_sequence_nodes(scene, count, first))

    @functools.cached_property
    def heights(self) -> Array:
        """Those of the map [spacing], on the device."""
        return self.there.heights()

    def set_nodes(self, x: np.ndarray, y: np.ndarray) -> None:
        """Move the samples to these nodes."""
        self.x, self.y, self.traced = x, y, {}
        moved = []
        for i, j in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
            col, row = (x + i) % self.cols, (y + j) % self.rows
            on_map = self.periodic | ((col == x + i) & (row == y + j))
            moved.append(np.where(on_map, row * self.cols + col, -1))
        self.own, left, right, above, below = gather(self.engine, self.heights, np.stack(moved), float(NONE))
        self.gx, self.gy = (_slope(low, self.own, high) for low, high in ((left, right), (above, below)))
        self.length = np.sqrt(1 + self.gx**2 + self.gy**2)

    def __len__(self) -> int:
        return len(self.x)

    def of(self, image: np.ndarray) -> np.ndarray:
        """An image (rows, cols) at the samples, float64."""
        values: np.ndarray = image[self.y, self.x]
        return values.astype(float)

    def errors(self, image: np.ndarray, exact: np.ndarray) -> Errors:
        return errors(image, exact, self.least)

    def slopes(
        self,
        cosine: Values,
        sine: Values,
        least: Values,
        along: Values = 0.0,
        up: Values = 0.0,
        limit: Values = 1.0,
        reach: float = math.inf,
        node: Any = np.s_[:],
    ) -> np.ndarray:
        """Horizon slopes, at least ``least``: (n, nodes) float64.

        ``cosine``, ``sine``: of azimuths; with ``least`` >= 0, ``along``, ``up`` and ``limit`` numbers or
        arrays that broadcast to (n, nodes), the nodes all or those of index ``node``. ``reach`` [spacings]:
        nothing farther away is tested.

        ``along``, ``up``, ``limit``: ground hides a source only where it stands before it. A place at the
        horizontal distance t [spacings] from a node, t s higher, stands before it if and only if
        t (along + s up) < limit. Before a plane: the components of its unit normal along the azimuth and
        upwards, and the plane's distance from the node [spacings]. Before an edge at the horizontal distance
        r [spacings]: 1, 0, r. By default all ground does.
        """
        engine, x, y = self.engine, self.x[node], self.y[node]
        shape = np.broadcast_shapes(np.shape(cosine), np.shape(least), (1, len(x)))
        rays = np.empty((*shape, 8), np.float32)
        for n, value in enumerate((x, y, cosine, sine, least, along, up, limit)):
            rays[..., n] = value
        count = rays.size // 8
        if not count:
            return np.zeros(shape)
        # both held until the kernel is done
        given, slopes = engine.upload(rays.reshape(-1, 8)), engine.empty((count,), np.float32)
        far = self.relief / SAMPLED_SLOPE if self.periodic else math.hypot(self.rows, self.cols)
        across = ((self.cols - 1) >> self.shift) + 1
        maps, reach = (self.heights, self.tops, given, slopes), float(min(reach, far) + 1e-3)
        size = count, self.rows, self.cols, across, self.shift, int(self.periodic), self.highest, reach
        engine.launch("pilot", "pilot", (count,), *maps, *size, lanes=1)
        return engine.download(slopes).reshape(shape).astype(float)

    def plane(self, cosine: Values, sine: Values) -> np.ndarray:
        """Slope of the tangent plane."""
        slope: np.ndarray = -(self.gx * cosine + self.gy * sine)
        return slope

    def free(self, cosine: Values, sine: Values) -> np.ndarray:
        """Horizon slope without the ground: of the level, the tangent plane, and the wall of a dark box."""
        free: np.ndarray = np.maximum(least_slope(self, cosine, sine), self.plane(cosine, sine))
        return free

    def horizons(self, azimuths: np.ndarray, reach: float = math.inf) -> np.ndarray:
        """Horizon slopes (azimuths, nodes) float64, not to be changed."""
        cosine, sine = np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]
        return _kept(
            self,
            ("slopes", azimuths.tobytes(), reach),
            lambda: self.slopes(cosine, sine, self.free(cosine, sine), reach=reach),
        )

    def uniform(self, azimuths: np.ndarray, reach: float = math.inf) -> np.ndarray:
        """Irradiance per radian of azimuth of a sky of brightness 1: (azimuths, nodes), not to be changed."""
        return _kept(
            self,
            ("light", azimuths.tobytes(), reach),
            lambda: self.ring(azimuths, self.horizons(azimuths, reach)),
        )

    def ring(self, azimuths: np.ndarray, slopes: np.ndarray, table: np.ndarray | None = None) -> np.ndarray:
        """Irradiance per radian of azimuth above ``slopes``: (azimuths, nodes).

        Of brightness 1, or by ``table`` (azimuths, knots, 4), see :meth:`Integrals.table`.
        """
        return ring(self.gx, self.gy, azimuths, slopes, table)

    def sectors(
        self, ways: np.ndarray, table: np.ndarray, window: tuple[float, float, float, float] | None = None
    ) -> np.ndarray:
        """Irradiance (nodes,) by small bright parts of a sky.

        Arguments as of :meth:`skylamp.light.slices.Slices.sectors`.
        """
        cosine, sine, width, first, scale = (v[:, None].astype(float) for v in ways)
        low: np.ndarray = first / np.maximum(1 - first, 1e-6)
        high: Values = STEEP
        if window is not None:
            x0, x1, y0, y1 = window
            # 1e-30: a ray along a side meets it beyond any map, or never leaves it
            ways = np.where(np.stack([cosine, sine]) == 0, 1e-30, [cosine, sine])
            at, ends = np.stack([self.x, self.y])[:, None], np.reshape([x0, y0, x1, y1], (2, 2, 1, 1))
            sides = np.sort((ends - at) / ways, 0)
            near, far = np.maximum(0, sides[0].max(0)), sides[1].min(0)
            with np.errstate(divide="ignore", invalid="ignore"):
                passes = (near < far) & (self.own < 0)
                low = np.where(passes, np.maximum(low, np.clip(-self.own / far, 0, STEEP)), STEEP)
                high = np.where(passes, np.minimum(STEEP, -self.own / np.maximum(near, 1e-9)), STEEP)
        least = np.maximum(self.free(cosine, sine), low)
        slopes = self.slopes(cosine, sine, least)
        along, up = (self.gx * cosine + self.gy * sine) / self.length, 1 / self.length
        row = np.arange(len(table))[:, None]

        def above(slope: np.ndarray) -> Any:
            at = np.clip((slope / (1 + slope) - first) * scale, 0, table.shape[1] - 1)
            knot = np.minimum(at.astype(int), table.shape[1] - 2)
            c1, c2 = (table[row, knot, k] + (at - knot) * table[row, knot, k + 2] for k in (0, 1))
            return along * c1 + up * c2

        light = above(slopes) - (above(np.maximum(slopes, high)) if window is not None else 0)
        irradiance: np.ndarray = (width * light).sum(0)
        return irradiance

    def exact(self, source: sources.Source, solid: Ball | Quad | None = None) -> np.ndarray:
        """Irradiance by far more rays than any plan has, as a reference.

        720 azimuths and 120 sectors of every small bright part, or 256 slices through ``solid``.
        """
        if solid is not None:
            return self.through_slices(solid, source.brightness, 256)
        sky = Integrals(source) if callable(source.brightness) else None
        total, sectors = np.zeros(len(self)), even(720, 1 / 3)
        for some in np.array_split(np.arange(720), 8):
            angles, widths = sectors.angles[some], sectors.widths[some]
            total += widths @ self.ring(
                angles, self.horizons(angles), None if sky is None else sky.table(angles, widths, 1025)
            )
        if sky is not None:
            return total + sum(self.sectors(*spot.sectors(120)) for spot in sky.bright_parts)
        brightness = source.brightness
        assert not isinstance(brightness, tuple) and not callable(brightness), "of one channel"
        return total * float(brightness)

    def through_slices(
        self,
        solid: Ball | Quad,
        brightness: sources.Brightness,
        count: int,
        occluded: bool = True,
        points: int = CHORD_POINTS,
    ) -> np.ndarray:
        """Irradiance through ``count`` azimuth slices of a source, (nodes,) float64.

        ``solid``: in spacings, heights third; ``occluded``: by the ground, too; ``points`` of each slice at
        which a brightness that varies is taken.
        """
        slices = _ball(self, solid, count) if isinstance(solid, Ball) else _quad(self, solid, count)
        cosine, sine, width, lowest, highest, along, up, limit = slices
        least, left = np.clip(np.maximum(lowest, self.plane(cosine, sine)), 0, STEEP), highest
        walled = self.sides == "dark"
        if walled:
            least, left, top = _before_wall(self, solid, slices, least)
        shows = (lowest < highest) & (least < highest)
        slope = np.where(shows, least, STEEP)
        if occluded:
            n, node = np.nonzero(shows)
            c, s, at_least, a, u, bound = (
                np.broadcast_to(v, shows.shape)[n, node] for v in (cosine, sine, least, along, up, limit)
            )
            slope[n, node] = self.slopes(c, s, at_least, a, u, bound, node=node).ravel()
        tilt, light = self.gx * cosine + self.gy * sine, np.zeros(shows.shape)
        parts = [(slope, left)]
        if walled:
            parts.append((np.maximum(slope, top), np.where(left < highest, highest, -STEEP)))
        for first, last in parts:
            low, high = np.arctan(first), np.arctan(np.minimum(last, STEEP))
            if not callable(brightness):  # no ray lies below the tangent plane
                assert not isinstance(brightness, tuple), "channels are rendered one by one"
                at_low, at_high = (tilt * (e + np.sin(2 * e) / 2) + np.sin(e) ** 2 for e in (low, high))
                light += brightness * np.where(low < high, at_high - at_low, 0) / 2
                continue
            n, node = np.nonzero(low < high)
            azimuth, span = np.arctan2(sine, cosine)[n, node], (high - low)[n, node]
            for point in (np.arange(points) + 0.5) / points:
                e = low[n, node] + point * span
                seen = sources.directions_of(azimuth, np.maximum(np.sin(e), 0))
                cosines = np.cos(e) * np.maximum(0, tilt[n, node] * np.cos(e) + np.sin(e))
                light[n, node] += cosines * sources.radiance(sources.Sky(brightness), seen) * span / points
        irradiance: np.ndarray = (width * light).sum(0) / self.length
        return irradiance


def least_slope(samples: Samples, cosine: Values, sine: Values) -> Values:
    """Horizon slope without any ground: of the level, and of the wall of a dark box."""
    if samples.sides != "dark":
        return 0.0
    slope: np.ndarray = np.maximum(0.0, -samples.own / _wall(samples, cosine, sine))
    return slope


def samples_of(engine: Backend, scene: Scene, count: int = SAMPLE_COUNT) -> Samples:
    """Samples of a scene, which are kept with its map on the backend, as are the slopes that they traced."""
    there, key = scene.on(engine), ("samples", scene.sides, count)
    if key not in there.derived:
        made = there.derived[key] = Samples(engine, scene, count)
        del made.heights, made.there  # as large as the map; what keeps the samples
    samples: Samples = copy.copy(there.derived[key])
    samples.there = there
    return samples


def spread_more(samples: Samples, scene: Scene, count: int) -> Samples:
    """The samples with ``count`` nodes of which only the places are known: for :func:`picked` and
    :meth:`Samples.of` alone.
    """
    derived, key = samples.there.derived, ("nodes", samples.first, count)
    if key not in derived:
        derived[key] = _sequence_nodes(scene, count, samples.first)
    many = copy.copy(samples)
    many.x, many.y = derived[key]
    return many


def without_walls(samples: Samples) -> Samples:
    """The samples with open sides, for what ground alone hides: the walls of a dark box send no light."""
    opened = copy.copy(samples)
    opened.sides, opened.traced = "open" if samples.sides == "dark" else samples.sides, {}
    return opened


def picked(samples: Samples, images: Array, number: int = 0) -> np.ndarray:
    """Image ``number`` of some (rows, cols) float32 on the device at the samples, float32."""
    at = (number * samples.rows + samples.y) * samples.cols + samples.x
    return gather(samples.engine, images, at, math.nan)


def _kept(samples: Samples, key: tuple[str, bytes, float], made: Callable[[], np.ndarray]) -> np.ndarray:
    """The traced array of this key: the one that is kept, else what ``made`` returns."""
    traced = samples.traced
    if key not in traced:
        values = made()
        while len(traced) >= KEPT_TRACES:
            traced.pop(next(iter(traced)))
        traced[key] = values
    return traced[key]


def _wall(samples: Samples, cosine: Values, sine: Values) -> np.ndarray:
    """Distance of the wall of a dark box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = (
            np.where(a > 1e-9, (n - 0.5 - at) / a, np.where(a < -1e-9, (-0.5 - at) / a, np.inf))
            for a, n, at in ((cosine, samples.cols, samples.x), (sine, samples.rows, samples.y))
        )
    return np.minimum(x, y)


def _before_wall(
    samples: Samples, solid: Ball | Quad, slices: tuple[np.ndarray, ...], least: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the wall of a dark box leaves of ``slices`` through a source from the slopes ``least`` on.

    Visible are the slopes from the first result to the second, and those from the third, the wall's top, on.
    """
    cosine, sine, _, _, high, along, up, limit = slices
    wall = _wall(samples, cosine, sine)
    with np.errstate(divide="ignore", invalid="ignore"):
        top = -samples.own / wall
        if isinstance(solid, Ball):  # the wall cuts it between two slopes, or not at all
            flat = (solid.center[0] - samples.x) ** 2 + (solid.center[1] - samples.y) ** 2
            square: np.ndarray = solid.radius**2 - np.maximum(0, flat - along**2) - (wall - along) ** 2
            half = np.sqrt(np.maximum(0, square))
            cut = [np.where(square > 0, (up + side * half) / wall, np.inf) for side in (-1, 1)]
            nearer = [(limit > 0) & (wall * (along + slope * up) < limit) for slope in (least, high)]
            under, over = np.where(nearer[0], cut[0], -np.inf), np.where(nearer[1], cut[1], np.inf)
        else:
            up = np.where(up == 0, 1e-30, up)
            meets = (limit / wall - along) / up
            under, over = np.where(up > 0, meets, -np.inf), np.where(up > 0, np.inf, meets)
    return np.maximum(least, np.minimum(under, top)), np.where(over < top, np.minimum(high, over), high), top


def ring(
    gx: np.ndarray, gy: np.ndarray, azimuths: np.ndarray, slopes: np.ndarray, table: np.ndarray | None = None
) -> np.ndarray:
    """Irradiance per radian of azimuth of elements of slope (gx, gy) (nodes,) above ``slopes``.

    ``slopes`` and the result: (azimuths, nodes); ``table``: see :meth:`Samples.ring`.
    """
    length = np.sqrt(1 + gx**2 + gy**2)
    along: np.ndarray = (gx * np.cos(azimuths)[:, None] + gy * np.sin(azimuths)[:, None]) / length
    light: np.ndarray
    up, secant = 1 / length, 1 / (1 + slopes**2)
    if table is None:
        light = along * (np.pi / 2 - np.arctan(slopes) - slopes * secant) / 2 + up * secant / 2
        return light
    least = np.maximum(slopes, 0)
    at = least / (1 + least) * (table.shape[1] - 1)
    low = np.minimum(at.astype(int), table.shape[1] - 2)
    row = table.shape[1] * np.arange(len(table))[:, None]
    knots = table.reshape(-1, 4).take(row + low, axis=0)  # both integrals, and their steps
    values = [knots[..., k] + (at - low) * knots[..., k + 2] for k in (0, 1)]
    light = along * values[0] + up * values[1]
    return light


def _slope(low: np.ndarray, here: np.ndarray, high: np.ndarray) -> np.ndarray:
    """d depth between neighbours: central differences, one-sided beside what is no ground."""
    has_low, has_high = low > NONE, high > NONE
    slope: np.ndarray = (np.where(has_low, low, here) - np.where(has_high, high, here)) / np.maximum(
        1, has_low.astype(int) + has_high
    )
    return slope.astype(np.float64)


def _sequence_nodes(scene: Scene, count: int, first: int) -> tuple[np.ndarray, np.ndarray]:
    """(columns, rows) of nodes; all valid ones if they are few."""
    rows, cols = scene.shape

    def at(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = ((0.5 + step * n) % 1 for step in R2_STEPS)
        x, y = (np.floor(part * size).astype(int) for part, size in zip(parts, (cols, rows)))
        return x, y

    if scene.mask is None and rows * cols > 2 * count:
        return at(np.arange(first, first + count))
    if scene.mask is not None:
        x, y = at(np.arange(first, first + 8 * count))
        good = np.flatnonzero(scene.mask[y, x])[:count]
        if len(good) == count:
            return x[good], y[good]
    valid = np.arange(rows * cols) if scene.mask is None else np.flatnonzero(scene.mask)
    if len(valid) > 2 * count:
        valid = valid[np.linspace(0, len(valid) - 1, count).astype(int)]
    return valid % cols, valid // cols


def _ball(samples: Samples, ball: Ball, count: int) -> tuple[np.ndarray, ...]:
    """Slices through a ball, as the kernel ``ball`` places them: (count, nodes) each.

    Cosine and sine of their azimuths, their widths [rad], least and greatest slopes of the ball, and
    ``along``, ``up`` and ``limit`` of :meth:`Samples.slopes`, here of the plane of the circle where rays from
    the node touch the ball, all three times the distance of its centre: [spacings], [spacings], [spacings^2].
    """
    x0, y0, z0 = ball.center
    dx, dy, dz = x0 - samples.x, y0 - samples.y, z0 - samples.own.astype(float)
    flat = np.hypot(dx, dy)
    far = np.hypot(flat, dz)
    inside = far <= ball.radius
    with np.errstate(divide="ignore", invalid="ignore"):
        ux, uy = np.where(flat > 0, dx / flat, 1.0), np.where(flat > 0, dy / flat, 0.0)
        sin_e, cos_e = np.where(far > 0, dz / far, 1.0), np.where(far > 0, flat / far, 0.0)
        beyond = np.where(inside, 0, far**2 - ball.radius**2)
        sin_a = np.where(inside, 1.0, ball.radius / np.maximum(far, 1e-30))
        cos_a = np.sqrt(np.maximum(0, 1 - sin_a**2))
        all_round = sin_a >= cos_e
        widest = np.where(all_round, 1.0, sin_a / np.maximum(cos_e, 1e-30))
        part = ((np.arange(count) + 0.5) / count)[:, None]
        theta = np.pi * (part - 0.5)
        sin_d = np.where(all_round, np.sin(2 * np.pi * part), widest * np.sin(theta))
        cos_d = np.where(all_round, np.cos(2 * np.pi * part), np.sqrt(np.maximum(0, 1 - sin_d**2)))
        half_chord = np.where(
            all_round, np.sqrt(np.maximum(0, sin_a**2 - (cos_e * sin_d) ** 2)), sin_a * np.cos(theta)
        )
        width = np.where(
            all_round, 2 * np.pi / count, widest * np.pi / count * np.cos(theta) / np.maximum(cos_d, 1e-30)
        )
        in_plane = cos_e * cos_d
        low_c, low_s = in_plane * cos_a + sin_e * half_chord, sin_e * cos_a - in_plane * half_chord
        high_c, high_s = in_plane * cos_a - sin_e * half_chord, sin_e * cos_a + in_plane * half_chord
        low = np.where(low_c > 0, low_s / low_c, np.where(low_s > 0, STEEP, -STEEP))
        high = np.where(high_c > 0, high_s / high_c, np.where(sin_e > 0, STEEP, -STEEP))
    low, high = np.where(inside, -STEEP, low), np.where(inside, STEEP, np.minimum(high, STEEP))
    high = np.where(inside | (dz + ball.radius > 0), high, -STEEP)
    return ux * cos_d - uy * sin_d, uy * cos_d + ux * sin_d, width, low, high, flat * cos_d, dz, beyond


def _quad(samples: Samples, quad: Quad, count: int) -> tuple[np.ndarray, ...]:
    """Slices through a quadrangle, as of :func:`_ball`: (count, nodes) each.

    The plane of ``along``, ``up`` and ``limit`` is the quadrangle's. The azimuths are Gauss-Legendre nodes in
    each sector between the azimuths of neighbouring corners.
    """
    to, within, base, edges, widths = _outline(samples, quad)
    corners = np.asarray(quad.corners, float)
    normal = np.cross(corners[2] - corners[0], corners[3] - corners[1])
    normal /= np.linalg.norm(normal)
    apart = np.einsum("i,in->n", normal, to.mean(0))
    sense = np.where(apart < 0, -1.0, 1.0)
    per = -(-count // 4)
    point, weight = np.polynomial.legendre.leggauss(per)
    half_width = widths[:, None] / 2
    phi = (base + edges[:, None] + half_width * (1 + point[:, None])).reshape(4 * per, -1)
    width = (half_width * weight[:, None]).reshape(4 * per, -1)
    cosine, sine = np.cos(phi), np.sin(phi)
    crossings: list[np.ndarray] = []
    hits: Values = 0
    for i in range(4):
        a, b = to[i], to[(i + 1) % 4]
        side_a, side_b = cosine * a[1] - sine * a[0], cosine * b[1] - sine * b[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            f = side_a / (side_a - side_b)
            r = cosine * (a[0] + f * (b[0] - a[0])) + sine * (a[1] + f * (b[1] - a[1]))
            slope = (a[2] + f * (b[2] - a[2])) / np.maximum(r, 1e-10)
        crosses = (np.sign(side_a) != np.sign(side_b)) & (r > -1e-9)  # also an edge overhead
        crossings.append(np.where(crosses, slope, np.nan))
        hits = hits + crosses
    low, high = np.fmin.reduce(crossings), np.fmax.reduce(crossings)
    above = sense * normal[2] > 0  # the node lies below it
    low, high = np.where(within & ~above, -STEEP, low), np.where(within & above, STEEP, high)
    low, high = (np.where((hits > 0) & (apart != 0), np.clip(v, -STEEP, STEEP), -STEEP) for v in (low, high))
    return (
        cosine,
        sine,
        width,
        low,
        high,
        sense * (normal[0] * cosine + normal[1] * sine),
        sense * normal[2],
        sense * apart,
    )


def _outline(samples: Samples, quad: Quad) -> tuple[np.ndarray, ...]:
    """(corners, within, base, edges, widths) of a quadrangle from every node.

    Corners (4, 3, nodes); whether the zenith lies within (nodes,). Of the sectors between the corners'
    azimuths: the reference azimuth (nodes,), from it where they begin, and their widths, (4, nodes) each.
    """
    to = np.asarray(quad.corners, float)[:, :, None] - np.stack([samples.x, samples.y, samples.own]).astype(
        float
    )
    turn = [to[i, 0] * to[(i + 1) % 4, 1] - to[i, 1] * to[(i + 1) % 4, 0] for i in range(4)]
    within = (np.min(turn, 0) > 0) | (np.max(turn, 0) < 0)
    middle = to.mean(0)
    base = np.where(within, 0, np.arctan2(middle[1], middle[0]))
    offset = np.sort((np.arctan2(to[:, 1], to[:, 0]) - base + np.pi) % (2 * np.pi) - np.pi, 0)
    return (
        to,
        within,
        base,
        offset,
        np.diff(np.concatenate([offset, np.where(within, offset[:1] + 2 * np.pi, offset[3:])]), axis=0),
    )
