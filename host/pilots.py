"""Pilot nodes: a few hundred nodes of a scene whose light is found by exact rays, for plans to be measured against.

Lengths are in spacings, heights grow towards the viewer. A slope is the tangent of an elevation. Rays test every crossing
with a grid line (kernel ``pilot``); what follows is NumPy, on (rays of a node, nodes).
"""

from __future__ import annotations

import copy
import math
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from . import sources
from .backends.base import Backend, scratch
from .backends.slices import Ball, Quad
from .directions import Azimuths
from .scene import Scene

COUNT = 256  # pilot nodes
NONE = np.float32(-1e30)  # height where masked
FAINT = 0.005  # slope below which ground of a map that repeats is not looked for
EVENLY = 0.8191725133961645, 0.6710436067037893, 0.5497004779019703  # steps of a low-discrepancy sequence in three dimensions
STEEP = 1e6
GAUSS = 6  # points of brightness along a chord
CLIFF = 4.0  # spacings that neighbouring nodes may lie apart before the slope is more than the grid holds
WIDE = 16  # blocks across a map whose highest nodes may hide something from a pilot
CLOSE = 4  # nodes round a pilot that may
FEW, MANY = 12, 96  # pilots that are asked first, and then, whether anything is hidden
OTHER = 4  # of so many pilots one is asked how much of the sky it sees, where the sky is not the source
PLAINLY = 4.0  # times what may be hidden from which on few need be asked
_known: WeakKeyDictionary[Scene, dict[tuple[int, bool], Pilots]] = WeakKeyDictionary()
RARE = 3.0  # times the median relief of blocks from which on one is rare
COMMON = 0.25  # share of the map from which on what is rare is met often enough


class Pilots:
    """Nodes spread over the valid part of a map by a low-discrepancy sequence, from its number ``first`` on; the same for the same scene.

    With ``rare``, where a few blocks have far more relief than the others (a trench in a plain), as many nodes again
    among these; ``weights`` (nodes,) are then the nodes' shares of the map, else None.
    """

    def __init__(self, scene: Scene, count: int = COUNT, first: int = 1, rare: bool = False):
        self.shape = self.rows, self.cols = scene.shape
        self.mask, self.sides, (self.values, self.step) = scene.mask, scene.sides, scene.lattice()
        self.x, self.y = _spread(scene, count, first)
        self.common, self.weights = len(self.x), None
        if rare and len(self.x) == count:  # else these are all there are
            self._look_closer(count)
        self._on = {}
        self._settle()

    def _settle(self):
        self.own = self.height(self.y, self.x)
        self.gx, self.gy = (self._gradient(axis) for axis in (1, 0))
        self.length = np.sqrt(1 + self.gx**2 + self.gy**2)
        self._slopes, self._lost, self._seen = {}, {}, {}

    def moved(self, x: np.ndarray, y: np.ndarray, weights: np.ndarray | None = None) -> Pilots:
        """Other nodes of the same map."""
        other = copy.copy(self)
        other.x, other.y, other.weights, other.common = x, y, weights, len(x)
        other._settle()
        return other

    @classmethod
    def of(cls, scene: Scene, count: int, rare: bool = False) -> Pilots:
        """The same object again, with the horizons that were found, as long as the scene lives: it never changes."""
        known = _known.setdefault(scene, {})
        if (count, rare) not in known:
            known[count, rare] = cls(scene, count, rare=rare)
        return known[count, rare]

    def put_away(self) -> None:
        """Copies of the map go; what was found stays."""
        self.__dict__.pop("heights", None)
        self._on.clear()

    def height(self, row, col) -> np.ndarray:
        """Of some nodes; NONE where masked."""
        return np.maximum(self.values[row, col] / np.float32(-self.step), NONE)

    @cached_property
    def heights(self) -> np.ndarray:
        """Of all nodes, once rays must be followed."""
        heights = np.divide(self.values, np.float32(-self.step), out=scratch(self.shape))
        return heights if self.mask is None else np.maximum(heights, NONE, out=heights)

    @cached_property
    def tops(self) -> np.ndarray:
        """The highest node of every block of 2^shift x 2^shift nodes, and of the row and column after."""
        return np.maximum(self._pooled(self.values, np.minimum) / np.float32(-self.step), NONE)

    @cached_property
    def highest(self) -> float:
        return float(self.tops.max())

    @property
    def deepest(self) -> float:
        """Of the pilots."""
        return float(self.own.min())

    def __len__(self) -> int:
        return len(self.x)

    @cached_property
    def steep(self) -> float:
        """Share of neighbouring nodes that lie more than CLIFF spacings apart, along some 128 rows and columns; none beside masked ones."""
        with np.errstate(invalid="ignore"):  # two masked nodes
            steps = [np.diff(self.values[:: max(1, self.rows // 128)], axis=1), np.diff(np.ascontiguousarray(self.values[:, :: max(1, self.cols // 128)]), axis=0)]
        cliffs = 0
        for step in steps:
            far = np.abs(step, out=step) > CLIFF * self.step
            cliffs += np.count_nonzero(far if self.mask is None else far & (step < np.inf))
        return cliffs / max(1, sum(step.size for step in steps))

    def _look_closer(self, count):
        """Adds nodes where blocks are rare, and weights."""
        size, (down, across), mask = 1 << self.shift, self.tops.shape, self.mask
        relief = self.tops - self._pooled(self.values if mask is None else np.where(mask, self.values, -np.inf), np.maximum) / np.float32(-self.step)
        rare = relief > RARE * np.median(relief[relief >= 0])
        rare |= np.roll(rare, 1, 0)  # relief reaches into the row and the column after a block
        rare |= np.roll(rare, 1, 1)
        high, wide = (np.minimum(size, length - size * np.arange(n)) for length, n in ((self.rows, down), (self.cols, across)))
        row, col = np.nonzero(rare)
        nodes = np.cumsum(high[row] * wide[col])
        if not rare.any() or nodes[-1] > COMMON * self.values.size:
            return
        which, *inside = (0.5 + np.outer(EVENLY, np.arange(count))) % 1
        block = np.searchsorted(nodes, which * nodes[-1], "right")
        x, y = ((size * n[block] + part * length[n[block]]).astype(int) for n, part, length in zip((col, row), inside, (wide, high)))
        share = nodes[-1] / self.values.size
        if mask is not None:
            x, y = x[mask[y, x]], y[mask[y, x]]
            share = np.count_nonzero(mask & rare.repeat(size, 0).repeat(size, 1)[: self.rows, : self.cols]) / np.count_nonzero(mask)
        self.x, self.y = np.concatenate([self.x, x]), np.concatenate([self.y, y])
        here = rare[self.y // size, self.x // size]
        self.weights = np.where(here, share / max(1, here.sum()), (1 - share) / max(1, (~here).sum()))

    @property
    def relief(self) -> float:
        return self.highest - self.deepest

    @property
    def periodic(self) -> bool:
        return self.sides == "periodic"

    def _gradient(self, axis):
        """d depth / d axis at the pilots: central differences, one-sided at the border and beside masked nodes."""
        length = self.shape[axis]
        found = []
        for by in (-1, 1):
            at = (self.y, self.x + by) if axis else (self.y + by, self.x)
            inside = (at[axis] >= 0) & (at[axis] < length)
            there = self.height(*(np.clip(v, 0, n - 1) for v, n in zip(at, self.shape)))
            inside &= there > NONE
            found.append((np.where(inside, there, self.own), inside))
        (low, has_low), (high, has_high) = found
        return ((low - high) / np.maximum(1, has_low.astype(int) + has_high)).astype(np.float64)

    # -- rays ----------------------------------------------------------------------------------------------------------------

    @cached_property
    def shift(self) -> int:
        return 5 if min(self.shape) >= 512 else 4 if min(self.shape) >= 64 else 3

    def _pooled(self, found, of):
        """The least or largest of every block, and of the row and column after it."""
        size = 1 << self.shift
        for _ in range(2):
            full, rest = divmod(len(found), size)
            pooled = np.empty((full + (rest > 0), found.shape[1]), np.float32)
            of.reduce(found[: full * size].reshape(full, size, found.shape[1]), axis=1, out=pooled[:full])
            if rest:
                of.reduce(found[full * size :], axis=0, out=pooled[full])
            after = found[size::size]
            of(pooled[: len(after)], after, out=pooled[: len(after)])
            if self.periodic:
                of(pooled[-1], found[0], out=pooled[-1])
            found = np.ascontiguousarray(pooled.T)
        return found

    def slopes(self, engine: Backend, cosine, sine, least, along=0.0, up=0.0, limit=1.0, reach: float = math.inf, node=np.s_[:]) -> np.ndarray:
        """Horizon slopes, from ``least`` on, along azimuths that broadcast with the nodes, all or those of ``node``: (n, nodes) float64."""
        held = self._on.get(engine.name)
        if held is None:
            held = self._on[engine.name] = engine.upload(self.heights), engine.upload(self.tops)
        x, y = self.x[node], self.y[node]
        shape = np.broadcast_shapes(np.shape(cosine), np.shape(least), (1, len(x)))
        rays = np.empty((*shape, 8), np.float32)
        for n, value in enumerate((x, y, cosine, sine, least, along, up, limit)):
            rays[..., n] = value
        count = rays.size // 8
        if not count:
            return np.zeros(shape)
        given, found = engine.upload(rays.reshape(-1, 8)), engine.empty((count,), np.float32)  # both held until the kernel is done
        far = self.relief / FAINT if self.periodic else math.hypot(self.rows, self.cols)
        engine.launch("pilot", "pilot", (count,), *held, given, found, count, self.rows, self.cols, self.tops.shape[1],
                      self.shift, int(self.periodic), self.highest, float(min(reach, far) + 1e-3), lanes=1)
        return engine.download(found).reshape(shape).astype(float)

    def plane(self, cosine, sine):
        """Slope of the tangent plane."""
        return -(self.gx * cosine + self.gy * sine)

    def wall(self, cosine, sine):
        """Distance of the wall of a dark box."""
        with np.errstate(divide="ignore", invalid="ignore"):
            out = [np.where(a > 1e-9, (n - 0.5 - at) / a, np.where(a < -1e-9, (-0.5 - at) / a, np.inf))
                   for a, n, at in ((cosine, self.cols, self.x), (sine, self.rows, self.y))]
        return np.minimum(*out)

    def least(self, cosine, sine) -> np.ndarray:
        """What hides the sky whatever the ground: the level, the tangent plane, and the wall of a dark box."""
        least = np.maximum(FAINT if self.periodic else 0.0, self.plane(cosine, sine))
        if self.sides == "dark":
            least = np.maximum(least, -self.own / self.wall(cosine, sine))
        return least

    # -- skies ---------------------------------------------------------------------------------------------------------------

    def horizons(self, engine: Backend, azimuths: np.ndarray, reach: float = math.inf) -> np.ndarray:
        """(azimuths, nodes)."""
        asked = engine.name, azimuths.tobytes(), reach
        if asked not in self._slopes:
            cosine, sine = np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]
            self._slopes[asked] = self.slopes(engine, cosine, sine, self.least(cosine, sine), reach=reach)
        return self._slopes[asked]

    def sky_seen(self, engine: Backend) -> np.ndarray:
        """Irradiance of a uniform sky of brightness 1 at every OTHERth node, to see what else light may do: (nodes,)."""
        azimuths = 2 * np.pi * (np.arange(16) + 0.5) / 16
        if engine.name not in self._seen:
            few = self.moved(self.x[::OTHER], self.y[::OTHER])
            self._seen[engine.name] = few.ring(azimuths, few.horizons(engine, azimuths)).mean(0) * 2 * np.pi
        return self._seen[engine.name]

    def ring(self, azimuths: np.ndarray, slopes: np.ndarray, table: np.ndarray | None = None) -> np.ndarray:
        """Irradiance per radian of azimuth above ``slopes``, of brightness 1 or by ``table`` (azimuths, knots, >= 2): (azimuths, nodes)."""
        return ring(self.gx, self.gy, azimuths, slopes, table)

    def suns(self, engine: Backend, spots: sources.Spots, spans: tuple[int, ...] = (1,)) -> list[np.ndarray]:
        """Irradiance (nodes,) by a sky's bright spots, in sectors that are unions of so many."""
        cosine, sine = np.cos(spots.angles)[:, None], np.sin(spots.angles)[:, None]
        slopes = self.slopes(engine, cosine, sine, np.maximum(self.least(cosine, sine), spots.first / math.sqrt(max(1 - spots.first**2, 1e-12))))
        of = lambda some, slopes: some.widths @ ring(self.gx, self.gy, some.angles, slopes, some.table, some.first, some.last)
        return [of(spots.fewer(span), slopes[span // 2 :: span]) for span in spans]

    def exact(self, engine: Backend, source: sources.Source, solid: Ball | Quad | None = None) -> np.ndarray:
        """Irradiance by far more rays than any plan would take, to judge plans by: 720 azimuths or 1440 placed, or 256 slices through ``solid``."""
        if solid is not None:
            return self.through_slices(engine, solid, source.brightness, 256)
        varies = callable(source.brightness)
        profile = sources.azimuth_profile(source) if varies else None
        sectors = Azimuths(720) if profile is None else Azimuths.placed(1440, profile)
        total = np.zeros(len(self))
        for some in np.array_split(np.arange(len(sectors)), 8):
            angles, widths = sectors.angles[some], sectors.widths[some]
            table = sources.fine_table(source, angles, widths, 2049) if varies else None
            total += widths @ self.ring(angles, self.horizons(engine, angles), table)
        return total if varies else total * float(source.brightness)

    # -- what hides anything at all, without a kernel ------------------------------------------------------------------------

    @cached_property
    def _highest(self):
        """The highest node of every block, (2, blocks) x and y, and the blocks' size."""
        down, across = (-(-n // max(1, -(-n // WIDE))) for n in (self.rows, self.cols))
        high, wide = -(-self.rows // down), -(-self.cols // across)
        room = np.full((down, across * wide), np.inf, np.float32)
        full = self.rows // high
        room[:full, : self.cols] = self.values[: full * high].reshape(full, high, self.cols).min(1)
        room[full:, : self.cols] = self.values[full * high :].min(0, initial=np.inf)
        x = room.reshape(down, across, wide).argmin(2) + np.arange(across) * wide
        rows = np.minimum(np.arange(down)[:, None] * high + np.arange(high), self.rows - 1)
        y = rows[:, 0, None] + self.values[rows[:, None], x[..., None]].argmin(2)
        return np.stack([x.ravel(), y.ravel()]).astype(np.int32), max(high, wide)

    @cached_property
    def _grid(self):
        """As ``_highest``, but the middle of every block."""
        x, y = ((np.arange(WIDE) + 0.5) * n // WIDE for n in (self.cols, self.rows))
        return np.stack([np.tile(x, WIDE), y.repeat(WIDE)]).astype(np.int32), -(-max(self.rows, self.cols) // WIDE)

    def _peaks(self, count, among):
        """Distances (x, y), distance and slope of nodes that may hide something from ``count`` pilots or somewhat more: (nodes, candidates)."""
        peaks, size = among
        near = np.indices((2 * CLOSE + 1,) * 2, np.int32).reshape(2, -1) - CLOSE
        some = np.arange(0, self.common, max(1, self.common // count))
        if count == MANY:
            some = np.append(some, np.arange(self.common, len(self)))
        here = np.stack([self.x[some], self.y[some]]).astype(np.int32)[:, :, None]
        to = np.concatenate([peaks[:, None] - here, np.broadcast_to(near[:, None], (2, here.shape[1], near.shape[1]))], 2)
        if self.periodic:
            lap = np.array([self.cols, self.rows], np.int32)[:, None, None]
            to = (to + lap // 2) % lap - lap // 2
        x, y = here + to
        if self.periodic:
            x, y = x % self.cols, y % self.rows
        inside = (x >= 0) & (x < self.cols) & (y >= 0) & (y < self.rows) & to.any(0)
        dx, dy = to.astype(np.float32)
        distance = np.where(inside, np.sqrt(dx * dx + dy * dy), np.float32(np.inf))
        slope = (self.height(np.clip(y, 0, self.rows - 1), np.clip(x, 0, self.cols - 1)) - self.own[some, None]) / distance
        return some, dx, dy, distance, np.where(inside, slope, -np.inf), size

    def sky_lost(self, limit: float) -> float:
        """RMS share of a uniform sky's light that ground or walls take from a node, from the highest nodes around some; an estimate, on
        the high side where little is hidden; from few nodes where these tell of far more than ``limit``."""
        few = self._sky_lost(FEW, "_highest")
        return few if few > PLAINLY * limit else self._sky_lost(MANY, "_highest")

    def sky_lost_at_a_glance(self) -> float:
        """The same from a few hundred nodes of the map; as a rule there is more."""
        return self._sky_lost(FEW, "_grid")

    def _sky_lost(self, count, among):
        if (count, among) in self._lost:
            return self._lost[count, among]
        some, dx, dy, distance, slope, _ = self._peaks(count, getattr(self, among))
        sectors = 16
        azimuths = 2 * np.pi * (np.arange(sectors) + 0.5) / sectors
        gx, gy = self.gx[some], self.gy[some]
        plane = np.maximum(0, -(gx.astype(np.float32)[:, None] * dx + gy.astype(np.float32)[:, None] * dy) / distance)
        slope = np.maximum(slope, plane)
        number = (np.arctan2(dy, dx) * np.float32(sectors / (2 * np.pi)) + sectors).astype(int) % sectors
        tangent = np.zeros((sectors, len(slope)), np.float32)  # of the angle above the tangent plane
        np.maximum.at(tangent.ravel(), (number * len(slope) + np.arange(len(slope))[:, None]).ravel(), ((slope - plane) / (1 + slope * plane)).ravel())
        angle = np.arctan(tangent)
        angle = np.maximum(angle, np.maximum(np.roll(angle, 1, 0), np.roll(angle, -1, 0)))  # what stands in a sector may reach into the next
        plane = np.maximum(0, -(gx * np.cos(azimuths)[:, None] + gy * np.sin(azimuths)[:, None]))
        hidden = np.tan(np.minimum(np.arctan(plane) + angle, 1.57))
        if self.sides == "dark":
            hidden = np.maximum(hidden, (-self.own / self.wall(np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]))[:, some])
        free, left = (ring(gx, gy, azimuths, s).mean(0) for s in (plane, hidden))
        weights = None if self.weights is None else self.weights[some]
        lost = self._lost[count, among] = float(np.sqrt(np.average((free - left) ** 2, weights=weights)) / np.average(free, weights=weights))
        return lost

    def clear(self, solid: Ball | Quad) -> bool:
        """Whether all of the source rises above the level, and nothing that could stand between it and a pilot rises above its lowest ray
        and the pilot's tangent plane."""
        return all(self._clear(solid, count) for count in (FEW, MANY))

    def _clear(self, solid, count):
        some, dx, dy, distance, slope, block = self._peaks(count, self._highest)
        here = np.stack([self.x, self.y, self.own]).astype(float)[:, some]
        if isinstance(solid, Ball):
            to = np.array(solid.center)[:, None] - here
            flat, far = np.hypot(to[0], to[1]), np.sqrt((to**2).sum(0))
            if (far <= solid.radius).any() or (to[2] < solid.radius).any():
                return False
            lowest, end = np.tan(np.arcsin(to[2] / far) - np.arcsin(solid.radius / far)), flat + solid.radius
            aside = np.where(flat > solid.radius, np.arcsin(np.minimum(1, solid.radius / np.maximum(flat, 1e-9))), np.pi)
        else:
            corners = np.asarray(solid.corners, float)[:, :, None] - here
            to = corners.mean(0)
            if (corners[:, 2] <= 0).any():
                return False
            end = np.hypot(corners[:, 0], corners[:, 1]).max(0)
            lowest = corners[:, 2].min(0) / np.maximum(end, 1e-9)
            size = np.hypot(*(corners - to)[:, :2].swapaxes(0, 1)).max(0)
            flat = np.hypot(to[0], to[1])
            aside = np.where(flat > size, np.arcsin(np.minimum(1, size / np.maximum(flat, 1e-9))), np.pi)
        turned = np.abs((np.arctan2(dy, dx) - np.arctan2(to[1], to[0])[:, None] + np.pi) % (2 * np.pi) - np.pi)
        towards = (turned <= aside[:, None] + np.minimum(np.pi, 1.5 * block / distance)) & (distance < end[:, None] + block)
        gx, gy = self.gx[some][:, None], self.gy[some][:, None]
        plane = -(gx * dx + gy * dy) / distance + 1e-3 * np.hypot(gx, gy)
        return not (towards & (slope > lowest[:, None]) & (slope > plane)).any()

    # -- lamps and windows ---------------------------------------------------------------------------------------------------

    def turn(self, solid: Ball | Quad) -> np.ndarray:
        """Share of the circle of azimuths that a source takes up, as kernels reckon it: (nodes,)."""
        if isinstance(solid, Ball):
            to = np.array(solid.center)[:, None] - np.stack([self.x, self.y, self.own])
            flat = np.maximum(np.hypot(to[0], to[1]), 1e-9)
            widest = solid.radius / flat
            return np.where(widest >= 1, 1.0, widest * (0.318 + 0.182 * np.minimum(1, widest) ** 2))
        return _outline(self, solid)[-1].sum(0) / (2 * np.pi)

    def through_slices(self, engine: Backend, solid: Ball | Quad, brightness, count: int, occluded: bool = True) -> np.ndarray:
        """Irradiance through ``count`` azimuth slices of a source, (nodes,) float64; solid in spacings, heights third."""
        cosine, sine, share, low, high, along, up, limit = (_ball if isinstance(solid, Ball) else _quad)(self, solid, count)
        least = np.clip(np.maximum(low, self.plane(cosine, sine)), 0, STEEP)
        if self.sides == "dark":
            wall = self.wall(cosine, sine)
            with np.errstate(divide="ignore", invalid="ignore"):
                beyond = wall * (along + np.maximum(low, 0) * up) < limit  # the source stands behind the wall: only what rises above its top
            least = np.where(beyond, np.maximum(least, -self.own / wall), least)
        shows = (low < high) & (least < high)
        slope = np.where(shows, least, STEEP)
        if occluded:
            n, node = np.nonzero(shows)
            pick = lambda v: np.broadcast_to(v, shows.shape)[n, node]
            slope[n, node] = self.slopes(engine, pick(cosine), pick(sine), least[n, node], pick(along), pick(up), pick(limit), node=node).ravel()
        low, high = np.arctan(np.maximum(slope, low)), np.arctan(np.minimum(high, STEEP))
        tilt = self.gx * cosine + self.gy * sine
        if callable(brightness):
            half = np.maximum(0, high - low)[..., None] / 2
            point, weight = np.polynomial.legendre.leggauss(GAUSS)
            e = low[..., None] + half * (1 + point)
            light = half * weight * np.cos(e) * np.maximum(0, tilt[..., None] * np.cos(e) + np.sin(e))
            light = (light * brightness(sources.directions_of(np.arctan2(sine, cosine)[..., None], np.sin(e)))).sum(-1)
        else:  # the integral of that; no ray lies below the tangent plane
            up_to = lambda e: tilt * (e + np.sin(2 * e) / 2) + np.sin(e) ** 2
            light = brightness * np.where(low < high, up_to(high) - up_to(low), 0) / 2
        return (share * light).sum(0) / self.length


def ring(gx, gy, azimuths, slopes, table=None, first=0.0, last=1.0):
    """Irradiance per radian of azimuth of elements of slope (gx, gy) (nodes,) above ``slopes`` (azimuths, nodes); ``table``
    from the sine ``first`` of elevation to ``last``."""
    length = np.sqrt(1 + gx**2 + gy**2)
    along = (gx * np.cos(azimuths)[:, None] + gy * np.sin(azimuths)[:, None]) / length
    up = 1 / length
    secant = 1 / (1 + slopes**2)
    if table is None:
        return along * (np.pi / 2 - np.arctan(slopes) - slopes * secant) / 2 + up * secant / 2
    at = np.clip((slopes * np.sqrt(secant) - first) / (last - first), 0, 1) * (table.shape[1] - 1)
    low = np.minimum(at.astype(int), table.shape[1] - 2)
    part = at - low
    row = np.arange(len(table))[:, None]
    value = lambda k: (1 - part) * table[row, low, k] + part * table[row, low + 1, k]
    return along * value(0) + up * value(1)


def _spread(scene, count, first):
    """(columns, rows) of nodes; all valid ones if they are few."""
    rows, cols = scene.shape
    if scene.mask is None and rows * cols > 2 * count:
        n = np.arange(first, first + count)
        return (np.floor((0.5 + 0.7548776662466927 * n) % 1 * cols).astype(int), np.floor((0.5 + 0.5698402909980532 * n) % 1 * rows).astype(int))
    if scene.mask is not None:
        n = np.arange(first, first + 8 * count)
        x, y = np.floor((0.5 + 0.7548776662466927 * n) % 1 * cols).astype(int), np.floor((0.5 + 0.5698402909980532 * n) % 1 * rows).astype(int)
        good = np.flatnonzero(scene.mask[y, x])[:count]
        if len(good) == count:
            return x[good], y[good]
    valid = np.flatnonzero(scene.valid.ravel())
    valid = valid[np.unique(np.linspace(0, len(valid) - 1, count).astype(int))] if len(valid) > 2 * count else valid
    return valid % cols, valid // cols


def _ball(pilots, ball, count):
    """Slices through a ball, as the kernel ``ball`` places them: (count, nodes) each."""
    x0, y0, z0 = ball.center
    dx, dy, dz = x0 - pilots.x, y0 - pilots.y, z0 - pilots.own.astype(float)
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
        share = ((np.arange(count) + 0.5) / count)[:, None]
        theta = np.pi * (share - 0.5)
        sin_d = np.where(all_round, np.sin(2 * np.pi * share), widest * np.sin(theta))
        cos_d = np.where(all_round, np.cos(2 * np.pi * share), np.sqrt(np.maximum(0, 1 - sin_d**2)))
        half = np.where(all_round, np.sqrt(np.maximum(0, sin_a**2 - (cos_e * sin_d) ** 2)), sin_a * np.cos(theta))
        share = np.where(all_round, 2 * np.pi / count, widest * np.pi / count * np.cos(theta) / np.maximum(cos_d, 1e-30))
        in_plane = cos_e * cos_d
        low_c, low_s = in_plane * cos_a + sin_e * half, sin_e * cos_a - in_plane * half
        high_c, high_s = in_plane * cos_a - sin_e * half, sin_e * cos_a + in_plane * half
        low = np.where(low_c > 0, low_s / low_c, np.where(low_s > 0, STEEP, -STEEP))
        high = np.where(high_c > 0, high_s / high_c, np.where(sin_e > 0, STEEP, -STEEP))
    low, high = np.where(inside, -STEEP, low), np.where(inside, STEEP, np.minimum(high, STEEP))
    high = np.where(inside | (dz + ball.radius > 0), high, -STEEP)
    return ux * cos_d - uy * sin_d, uy * cos_d + ux * sin_d, share, low, high, flat * cos_d, dz, beyond


def _quad(pilots, quad, count):
    """Slices through a quadrangle: Gauss-Legendre in each sector between the azimuths of neighbouring corners."""
    to, within, base, edges, widths = _outline(pilots, quad)
    corners = np.asarray(quad.corners, float)
    normal = np.cross(corners[2] - corners[0], corners[3] - corners[1])
    normal /= np.linalg.norm(normal)
    apart = np.einsum("i,in->n", normal, to.mean(0))
    sense = np.where(apart < 0, -1.0, 1.0)
    per = -(-count // 4)
    point, weight = np.polynomial.legendre.leggauss(per)
    half = widths[:, None] / 2
    phi = (base + edges[:, None] + half * (1 + point[:, None])).reshape(4 * per, -1)
    share = (half * weight[:, None]).reshape(4 * per, -1)
    cosine, sine = np.cos(phi), np.sin(phi)
    found, hits = [], 0
    for i in range(4):
        a, b = to[i], to[(i + 1) % 4]
        side_a, side_b = cosine * a[1] - sine * a[0], cosine * b[1] - sine * b[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            f = side_a / (side_a - side_b)
            r = cosine * (a[0] + f * (b[0] - a[0])) + sine * (a[1] + f * (b[1] - a[1]))
            slope = (a[2] + f * (b[2] - a[2])) / np.maximum(r, 1e-10)
        crosses = (np.sign(side_a) != np.sign(side_b)) & (r > -1e-9)  # also an edge overhead
        found.append(np.where(crosses, slope, np.nan))
        hits = hits + crosses
    low, high = np.fmin.reduce(found), np.fmax.reduce(found)
    above = sense * normal[2] > 0  # the node looks at it from below
    low, high = np.where(within & ~above, -STEEP, low), np.where(within & above, STEEP, high)
    low, high = (np.where((hits > 0) & (apart != 0), np.clip(v, -STEEP, STEEP), -STEEP) for v in (low, high))
    return cosine, sine, share, low, high, sense * (normal[0] * cosine + normal[1] * sine), sense * normal[2], sense * apart


def _outline(pilots, quad):
    """Corners (4, 3, nodes) from every node, whether the zenith lies within, and the sectors between their azimuths: base (nodes,),
    where they begin (4, nodes) and how wide they are."""
    to = np.asarray(quad.corners, float)[:, :, None] - np.stack([pilots.x, pilots.y, pilots.own]).astype(float)
    turn = [to[i, 0] * to[(i + 1) % 4, 1] - to[i, 1] * to[(i + 1) % 4, 0] for i in range(4)]
    within = (np.min(turn, 0) > 0) | (np.max(turn, 0) < 0)
    middle = to.mean(0)
    base = np.where(within, 0, np.arctan2(middle[1], middle[0]))
    offset = np.sort((np.arctan2(to[:, 1], to[:, 0]) - base + np.pi) % (2 * np.pi) - np.pi, 0)
    return to, within, base, offset, np.diff(np.concatenate([offset, np.where(within, offset[:1] + 2 * np.pi, offset[3:])]), axis=0)
