"""Depth by analysis and synthesis, coarse to fine: what recover(method="robust") does between its checks and
its answer.

On a pyramid of box-downsampled images Gauss-Newton (backends/adjoint.py) fits a surface to all images at
once. On every level the smoothness is let down in steps: a stiff surface has few ways to be wrong. Different
starts are right in different places: if none of their surfaces is good, each place is taken from the one that
is best there (mosaic). A coarse grid cannot see what a fine one can, and relief that it does not see darkens
the image. So large images begin at 128 nodes, and at 16 like small ones only if their relief is too strong to
be found from there; grids below that of starts get a gain for that shade; and large grids are solved by
cycles over all coarser ones (full approximation scheme): the coarse target is put right by what the two grids
say of the same surface, E_coarse(restricted z) - restricted E_fine(z), and the change found there is brought
up and kept if the fine objective falls. What of the smoothness stands for noise is of the difference to the
coarser grid's surface, which has less noise to take for relief.
"""

from __future__ import annotations

import functools
import logging
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .. import sources
from ..backends.base import Backend
from ..directions import Azimuths
from .descent import PULL, Descent, Light

log = logging.getLogger("skylamp")
EVENER = 10.0  # times as much as that is expected of an albedo that is not known, to tell what hangs on it
COARSEST = 16  # nodes on the shorter side of the coarsest grid
BRIGHT = 0.4  # rms to which images are scaled, so that smoothness means the same for all
AZIMUTHS = 24  # of a sky
FINER, MORE = 3, 64  # times as fine a grid, and azimuths, that tell how far off the model is
MARGIN = 0.5  # nodes between the bounds of depth, at least
SLICES = 24  # of a lamp or window
ROWS = 128  # of azimuths of a lamp's table of brightness
LEAST, FINEST = 1e-5, 1e-7  # smoothness for an image without noise; on a large grid, where relief is rough
STIFF = (1e-2, 1e-3, 1e-4)  # smoothness let down to it on the grid of starts
SOFTER = (1e-3, 1e-4)  # and on all others
STEPS, FIRST = 20, 30  # Gauss-Newton steps at one smoothness; on the grid of starts
MOST = 60  # conjugate gradients of a step
LOOSE, CLOSE, LAST = (
    (0.05, 5e-3),
    (0.02, 1e-3),
    (0.01, 2e-4),
)  # tolerance of conjugate gradients, and share of the objective below which a step is the last:
# on the way, where the way decides, and of the answer
BETTER = 0.5  # share of the objective below which another start is believed instead of the first
SMALL = 64  # grids on which this is cheap; larger ones are cycled
# nodes on the longer side of a large image's grid of starts, at most: relief that a coarser one does not see
# would mislead it
BEGIN = 128
SMOOTH, BOTTOM, CAREFUL = (
    (3, 30, 0.05),
    (8, 60, 0.03),
    1e-2,
)  # steps, conjugate gradients, tolerance of a cycle's grids and of its coarsest; first damping
CYCLES, LONGER, EASED, SLOW = (
    8,
    2,
    3e-4,
    0.01,
    # of a large grid; as many more under a sky, which tells less of depth; smoothness of the first; the fall of
    # the objective in one below which it is the last
)
LIGHTER, BETWEEN = (
    (
        0.9,
        0.8,
        0.65,
    ),
    0.05,
)  # gains tried for what a coarse grid does not see, and about the best of them
GOOD = 0.0025  # residual, as a share of the image, below which no other surface is looked for
LOST, FOUND = (
    100.0,
    16.0,
)  # times the objective of that, from which relief is looked for from elsewhere, and below which it is found
ELSEWHERE = (
    (1, 0.5),
    (1, 1),
    (0.7, 0.8),
    (0.35, 0.8),
)  # there: shares of the depth of the best flat surface, and gains
# residual on a coarse grid, over what its gain lacks to 1: shade of fine relief is not the same everywhere
SHADE = 0.35
# variance on half as fine a grid over that on a grid, of what relief leaves in second differences of the
# light
TEXTURE = 16.0
BEND, BEYOND = (
    0.1,
    0.03,
    # variance of second differences of a surface on the grid of starts, and of what a grid adds to a coarser one,
    # against which noise is weighed
)
FAITH, PROBES = (
    0.01,
    4,
)  # share of the image's rms that the model may be wrong by, and noises tried, to tell what is uncertain


class Level(NamedTuple):
    """What was reached on one grid: its shape, rms of model - image as a share of the image's rms, seconds
    since the start.
    """

    shape: tuple[int, int]
    residual: float
    seconds: float


def halved(values: np.ndarray) -> np.ndarray:
    """Means of 2 x 2; an odd side is first made even by its border."""
    rows, cols = values.shape
    values = np.pad(values, ((0, rows % 2), (0, cols % 2)), mode="edge")
    return values.reshape(values.shape[0] // 2, 2, values.shape[1] // 2, 2).mean((1, 3))


def doubled(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Linear interpolation to a grid twice as fine, of this shape."""
    for size in shape:
        at = (np.arange(size) + 0.5) / 2 - 0.5
        low = np.clip(np.floor(at).astype(int), 0, max(len(values) - 2, 0))
        share = (at - low)[:, None]
        values = (values[low] * (1 - share) + values[np.minimum(low + 1, len(values) - 1)] * share).T
    return values


def cubic(values: np.ndarray, times: int) -> np.ndarray:
    """Lagrange's cubic interpolation to a grid so many times as fine, straight on beyond the border."""
    for _ in range(2):
        size = len(values)
        at = (np.arange(times * size) + 0.5) / times - 0.5 + 2
        low = np.floor(at).astype(int)
        t = (at - low)[:, None]
        wide = np.pad(values, ((2, 2), (0, 0)), mode="reflect", reflect_type="odd")
        node = lambda k: wide[np.minimum(low + k, size + 3)]
        values = (
            -t * (t - 1) * (t - 2) / 6 * node(-1)
            + (t + 1) * (t - 1) * (t - 2) / 2 * node(0)
            - (t + 1) * t * (t - 2) / 2 * node(1)
            + (t + 1) * t * (t - 1) / 6 * node(2)
        ).T
    return values


def brightness_of(source: sources.Source, azimuths: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """(a sky's azimuths or None, the table of brightness or None for a number, which is part of the gains),
    as in Light: the same for every grid.
    """
    if isinstance(source, sources.Sky):
        sectors, table = Azimuths(azimuths), None
        if callable(source.brightness):
            profile = sources.azimuth_profile(source)
            sectors = sectors if profile is None else Azimuths.placed(azimuths, profile)
            table = sources.elevation_table(
                source, sectors.angles, sectors.widths, 256 if profile is None else 1024
            )
        angles = sectors.angles
        # what ought to be 0 is, so that rays along the grid stay on it
        ways = np.stack([np.cos(angles), np.sin(angles), sectors.widths, 0 * angles], 1)
        ways[np.abs(ways) < 1e-12] = 0
        return ways, table
    if not callable(source.brightness):
        return None, None
    place = 4 * np.arange(ROWS) / ROWS  # the diamond angle
    cosine = np.where(place < 2, 1 - place, place - 3)
    sine = np.where(place < 1, place, np.where(place < 3, 2 - place, place - 4))
    return None, sources.elevation_table(source, np.arctan2(sine, cosine), np.zeros(ROWS), ROWS)


def light_of(
    source: sources.Source,
    shape: tuple[int, int],
    scale: float,
    brightness: tuple[np.ndarray | None, np.ndarray | None],
) -> Light:
    """A source, with what brightness_of says of it, for a grid whose node i stands at (i + 1/2) / scale - 1/2
    nodes of the unit in which the source is given.
    """
    ways, table = brightness
    if isinstance(source, sources.Sky):
        return Light(table, azimuths=ways)
    share = (np.arange(SLICES) + 0.5) / SLICES
    theta, azimuth = np.pi * (share - 0.5), 2 * np.pi * share
    nodes = np.stack([np.sin(theta), np.cos(theta), np.cos(azimuth), np.sin(azimuth)], 1)
    put = lambda point: np.array(
        [(point[0] + 0.5) * scale - 0.5, (point[1] + 0.5) * scale - 0.5, -point[2] * scale]
    )
    y, x = np.indices(shape).astype(float)
    if isinstance(source, sources.Lamp) and source.center is not None:
        center = put(source.center)
        dx, dy = center[0] - x, center[1] - y
        flat = np.hypot(dx, dy)
        safe = np.where(flat > 0, flat, 1)
        frames = np.stack([np.where(flat > 0, dx / safe, 1), dy / safe, flat, 0 * flat], -1)
        return Light(
            table,
            nodes=nodes,
            frames=frames.reshape(-1, 4),
            solid=np.array([*center, source.radius * scale]),
            ball=True,
        )
    if isinstance(source, sources.Window):
        (x0, x1), (y0, y1) = source.x, source.y
        corners = [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)]
    else:
        corner, u, v = (np.array(part) for part in (source.corner, *source.edges))
        corners = [corner, corner + u, corner + u + v, corner + v]
    corners = np.array([put(corner) for corner in corners])
    to = corners[:, :2, None, None] - np.stack([x, y])
    middle = np.arctan2(*to.mean(0)[::-1])
    off = np.angle(np.exp(1j * (np.arctan2(to[:, 1], to[:, 0]) - middle)))
    turn = np.stack([to[i, 0] * to[(i + 1) % 4, 1] - to[i, 1] * to[(i + 1) % 4, 0] for i in range(4)])
    within = (turn >= 0).all(0) | (turn <= 0).all(0)
    middle = middle + (off.min(0) + off.max(0)) / 2
    frames = np.stack(
        [
            np.cos(middle),
            np.sin(middle),
            np.where(within, 0, np.tan((off.max(0) - off.min(0)) / 4)),
            0 * middle,
        ],
        -1,
    )
    return Light(table, nodes=nodes, frames=frames.reshape(-1, 4), solid=corners.ravel())


def noise_of(image: np.ndarray) -> float:
    """Standard deviation of white noise in an image: what a cross of second differences leaves (Immerkaer
    1996, with a median).

    Fine relief leaves something too, but TEXTURE times as much (variance) on a grid half as fine, where noise
    leaves the same for each of its means; so the two are told apart.
    """
    if min(image.shape) < 6:
        return 0.0
    second = lambda v: v[:-2] - 2 * v[1:-1] + v[2:]
    left = [float(np.median(np.abs(second(second(v).T)))) / (0.6745 * 6) for v in (image, 2 * halved(image))]
    return math.sqrt(max(0.0, TEXTURE * left[0] ** 2 - left[1] ** 2) / (TEXTURE - 1))


class Pyramid:
    """The problem on all grids. Lengths in nodes of the finest grid outside, in each grid's own inside.

    images (rows, cols) radiance; albedo a number or (rows, cols), or None: to be found; near, far (rows,
    cols) bounds. ``several``: whether there may be several answers; then all are followed closely, since the
    way decides which one is found. ``stop``: asked after every step whether to end; ``note``: told of every
    level that was reached.
    """

    def __init__(
        self,
        engine: Backend,
        images: list[np.ndarray],
        lights: list[sources.Source],
        albedo,
        sides: str,
        near: np.ndarray,
        far: np.ndarray,
        several: bool = False,
        stop: Callable[[], bool] = lambda: False,
        note: Callable[[Level], None] = lambda level: None,
    ):
        self.engine, self.sources, self.sides, self.stop, self.note = engine, lights, sides, stop, note
        self.pace = CLOSE if several else LOOSE
        self.began = time.perf_counter()
        self.units = [math.sqrt(float(np.mean(np.square(image)))) / BRIGHT for image in images]
        # where brightness is a number, models are of 1: light so many times as strong is a unit so many times
        # as small
        self.scales = [
            unit if callable(source.brightness) else unit / source.brightness
            for unit, source in zip(self.units, lights)
        ]
        self.images = [[image / unit for image, unit in zip(images, self.units)]]
        self.bounds = [(near, far)]
        self.albedo_known = albedo is not None
        self.albedo = [
            np.broadcast_to(np.asarray(albedo if self.albedo_known else 1.0, float), images[0].shape)
        ]  # if it is not known: what is expected
        while min(self.images[-1][0].shape) >= 2 * COARSEST:
            self.images.append([halved(image) for image in self.images[-1]])
            self.bounds.append(tuple(halved(bound) / 2 for bound in self.bounds[-1]))
            self.albedo.append(halved(self.albedo[-1]))
        self.seen = list(self.images)  # images as they are; those of coarse grids may get a gain
        self.top = len(self.images) - 1
        self.first = (
            self.top
            if self._cheap(0)
            else next(
                (level for level in range(1, self.top) if max(self.images[level][0].shape) <= BEGIN), self.top
            )
        )  # the grid of starts
        self.noise = math.sqrt(float(np.mean([noise_of(image) ** 2 for image in self.images[0]])))
        # by number, since a source may hold what cannot be hashed
        self.brightness = functools.cache(lambda number, azimuths: brightness_of(lights[number], azimuths))
        self.problems = {}
        self.gains = [1.0] * (self.top + 1)
        if not self.albedo_known:  # from here on as shares of what a flat surface would have
            self.usual = 0.0
            self._expect(self.top, sum(self.bounds[self.top]) / 2)
            self.albedo, self.usual = [self.usual * albedo for albedo in self.albedo], 1.0
            self.problems.clear()
        self.best = None  # (level, depth): the last surface that was accepted, whatever comes

    def _expect(self, level: int, z: np.ndarray) -> None:
        """Takes the median of the albedo at z for what is expected of it everywhere."""
        self.problem(level).value(z, 0.0)
        self.usual = float(np.median(self.problem(level).albedo()))
        for problem in self.problems.values():
            problem.expect(self.usual)

    def smoothness(self, level: int) -> float:
        """Weight of squared second differences: what noise and the shade of unseen relief leave on a grid
        against how much surfaces bend.
        """
        return self.least(level) + ((self.noise * 0.5**level) ** 2 + self.shade(level) ** 2) / (
            BEND if level >= self.first else BEYOND
        )

    def least(self, level: int) -> float:
        return LEAST if self._cheap(level) or level >= self.first else FINEST

    def good(self, level: int) -> float:
        """The objective below which another minimum is not looked for."""
        return (
            0.5
            * self.images[level][0].size
            * len(self.sources)
            * (GOOD * BRIGHT + self.shade(level) + self.noise * 0.5**level) ** 2
        )

    def shade(self, level: int) -> float:
        """rms by which the model is off on a coarse grid for relief that it does not see."""
        return SHADE * (1 - self.gains[level]) * BRIGHT

    def problem(self, level: int) -> Descent:
        if level not in self.problems:
            images, shape = self.images[level], self.images[level][0].shape
            self.problems[level] = Descent(
                self.engine,
                shape,
                self.sides,
                [
                    (light, self.albedo[level] / (math.pi * scale), image)
                    for light, scale, image in zip(
                        self._lights(shape, 0.5**level, AZIMUTHS), self.scales, images
                    )
                ],
                *self.bounds[level],
                self.albedo_known,
            )
            if not self.albedo_known:
                self.problems[level].expect(self.usual)
        return self.problems[level]

    def _lights(self, shape: tuple[int, int], scale: float, azimuths: int) -> list[Light]:
        """The sources for a grid, see light_of."""
        return [
            light_of(source, shape, scale, self.brightness(number, azimuths))
            for number, source in enumerate(self.sources)
        ]

    def flat(self, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
        """Depths of flat surfaces between the bounds, and how badly each explains the images on the coarsest
        grid.
        """
        problem = self.problem(self.top)
        share, (low, high) = (np.arange(count) + 0.5) / count, self.bounds[self.top]
        return share, np.array([problem.value(low + part * (high - low), 0) for part in share])

    def _ease(
        self, level: int, z: np.ndarray, stiff, steps: int = STEPS, pace: tuple[float, float] | None = None
    ) -> tuple[np.ndarray, float]:
        problem = self.problem(level)
        z = np.clip(z, *self.bounds[level])
        least = self.smoothness(level)
        for smoothness in (*(s for s in stiff if s > least), least):
            z, value = problem.run(z, smoothness, steps, MOST, *(pace or self.pace), self.stop)
        return z, value

    def polish(self, level: int, z: np.ndarray) -> tuple[np.ndarray, float]:
        """(depth, objective) of the surface that is the answer so far, worked out."""
        self._lean_on_itself(level, z)
        z, value = self._ease(level, z, (), pace=LAST)
        self.accept(level, z)
        return z, value

    def _cheap(self, level: int) -> bool:
        return max(self.images[level][0].shape) <= SMALL

    def lighten(self, z: np.ndarray) -> None:
        """Looks for the gain that lets the coarsest grid explain the images best, starting from z, and
        divides the targets of all coarse grids by theirs.

        A box of nodes whose fine relief shades itself is darker than its mean surface; without a gain, coarse
        grids would go deeper for it. A gain other than 1 is believed if the objective falls below BETTER of
        that without.
        """
        if not self.top or not self.albedo_known:  # then the albedo makes up for it
            return
        problem = self.problem(self.top)

        def reached(gain):
            problem.aim([image / gain for image in self.images[self.top]])
            return self._ease(self.top, z, STIFF, FIRST)[1]

        values = {1.0: reached(1.0)}
        values |= {gain: reached(gain) for gain in LIGHTER}
        best = min(values, key=values.get)
        if best < 1:
            values |= {gain: reached(gain) for gain in (best - BETWEEN, best + BETWEEN)}
            best = min(values, key=values.get)
        gain = best if values[best] < BETTER * values[1.0] else 1.0
        self.lift(gain, 0)

    def lift(self, gain: float, above: int) -> None:
        """Divides the targets of the grids coarser than grid ``above`` by a gain: the coarsest's by this,
        others' by less.
        """
        for level in range(above + 1, self.top + 1):
            self.gains[level] = 1 - (1 - gain) * (level - above) / (self.top - above)
            self.images[level] = [image / self.gains[level] for image in self.seen[level]]
            if level in self.problems:
                self.problems[level].aim(self.images[level])

    def _cycled(self, level: int, z: np.ndarray) -> tuple[np.ndarray, float]:
        """(depth, objective) on a large grid after cycles over all coarser ones (full approximation scheme),
        stiff at first.
        """
        least, value = self.smoothness(level), math.inf
        self.damping = {}
        cycles = CYCLES + LONGER * any(isinstance(source, sources.Sky) for source in self.sources)
        cycles = cycles if level == 0 else cycles // 2
        for count in range(cycles):
            smoothness = max(least, EASED * (least / EASED) ** (count / (cycles // 2)))
            before = value
            z, value = self._cycle(level, z, self.images[level], smoothness)
            if self.stop() or (count > cycles // 2 and value > (1 - SLOW) * before):
                break
        return z, value

    def _smooth(
        self, level: int, z: np.ndarray, target: list[np.ndarray], smoothness: float
    ) -> tuple[np.ndarray, float]:
        problem = self.problem(level)
        problem.aim(target)
        z, value = problem.run(
            np.clip(z, *self.bounds[level]),
            smoothness,
            *(SMOOTH if level < self.top else BOTTOM),
            1e-4,
            self.stop,
            self.damping.get(level, CAREFUL),
        )
        self.damping[level] = problem.damping
        return z, value

    def _cycle(
        self, level: int, z: np.ndarray, target: list[np.ndarray], smoothness: float
    ) -> tuple[np.ndarray, float]:
        """Smoothing, the same on the next coarser grid whose target is put right by what the two say of one
        surface, and smoothing again.
        """
        z, value = self._smooth(level, z, target, smoothness)
        if level == self.top or self.stop():
            return z, value
        light, small = self.problem(level).irradiances(z), halved(np.asarray(z, float)) / 2
        coarse = [halved(t) for t in target]
        self.problem(level + 1).aim(coarse)  # an albedo that is not known is that of the targets
        seen = self.problem(level + 1).irradiances(small)
        try:
            change = (
                self._cycle(
                    level + 1, small, [t + s - halved(l) for t, s, l in zip(coarse, seen, light)], smoothness
                )[0]
                - small
            )
        finally:
            self.problem(level + 1).aim(self.images[level + 1])
        tried, reached = self._smooth(level, z + 2 * doubled(change, z.shape), target, smoothness)
        return (tried, reached) if reached < value else (z, value)

    def begin(self, z: np.ndarray, start: int, last: int, keep: bool = True) -> tuple[np.ndarray, float]:
        """(depth, objective) on grid ``last`` from a surface on grid ``start`` that was not worked over.
        ``keep``: whether this is the answer so far.
        """
        z, value = self._ease(start, z, STIFF, FIRST)
        if keep:
            self.accept(start, z)
        return self.climb(z, start, last, keep) if last < start else (z, value)

    def elsewhere(self, share: float, last: int) -> tuple[np.ndarray, tuple[np.ndarray, float]]:
        """A flat surface of the coarsest grid from which strong relief is found, and (depth, objective) on
        grid ``last`` from there.

        Strong relief shades itself so much that the flat surface nearest to the images, ``share`` of the way
        between the bounds, is far too deep to start from; so shallower ones are tried, and gains, which stay
        as they were of the best.
        """
        sort = next(
            (level for level in range(last, self.top) if self.images[level][0].size <= SMALL**2), self.top
        )
        low, high = self.bounds[self.top]
        tried = []
        for part, gain in dict.fromkeys(
            (part, gain if sort < self.top else 1) for part, gain in ELSEWHERE
        ):  # no grid, no gain
            self.lift(gain, sort)
            flat = low + part * share * (high - low)
            z, value = self.begin(flat, self.top, sort, keep=False)
            tried.append((value, gain, flat, z))
            if self.stop() or value < FOUND * self.good(sort):
                break
        value, gain, flat, z = min(tried, key=lambda one: one[0])
        self.lift(gain, sort)
        return flat, self.climb(z, sort, last, keep=False) if last < sort else (z, value)

    def climb(self, z: np.ndarray, start: int, last: int, keep: bool = True) -> tuple[np.ndarray, float]:
        """(depth, objective) on grid ``last`` from a surface on the coarser grid ``start``."""
        value = math.inf
        for level in range(start - 1, last - 1, -1):
            if self.stop():
                break
            shape = self.images[level][0].shape
            z = 2 * cubic(z, 2)[: shape[0], : shape[1]]
            self._lean(level, z)  # a coarser grid has less noise to take for relief
            z, value = self._ease(level, z, SOFTER) if self._cheap(level) else self._cycled(level, z)
            if keep:
                self.accept(level, z)
        return z, value

    def confined(self, deepest: float, z: np.ndarray, start: int, last: int) -> tuple[np.ndarray, float]:
        """As begin, with no depth beyond ``deepest`` [nodes of grid ``last``] until the end: the shallow
        answer, where there are several.
        """
        free = self.bounds
        shallow = [
            (low, np.clip(deepest * 2.0 ** (last - level), low + MARGIN, high))
            for level, (low, high) in enumerate(free)
        ]
        self._bound(shallow)
        try:
            z, _ = self.begin(z, start, last, keep=False)
        finally:
            self._bound(free)
        return (z, math.inf) if self.stop() else self._ease(last, z, ())

    def mosaic(self, level: int, surfaces: list[np.ndarray]) -> tuple[np.ndarray, float]:
        """(depth, objective) from a surface that is everywhere the one of these that explains the images best
        in the neighbourhood.
        """
        off = [
            sum(
                (light - target) ** 2
                for light, target in zip(self.problem(level).irradiances(z), self.images[level])
            )
            for z in surfaces
        ]
        off = [blurred(blurred(square)) + 1e-12 for square in off]
        shares = [blurred((np.min(off, 0) / square) ** 2) for square in off]
        joined = sum(share * z for share, z in zip(shares, surfaces)) / sum(shares)
        self._lean_on_itself(level, joined)
        return self._ease(level, joined, SOFTER)

    def _lean(self, level: int, z: np.ndarray) -> None:
        """Lets what stands for noise in the smoothness be of the difference to z, and the rest of the whole
        surface.
        """
        self.problem(level).lean((1 - self.least(level) / self.smoothness(level)) * z)

    def _lean_on_itself(self, level: int, z: np.ndarray) -> None:
        """The same to what a coarser grid would hold of z."""
        self._lean(level, cubic(halved(np.asarray(z, float)), 2)[: z.shape[0], : z.shape[1]])

    def _bound(self, bounds) -> None:
        self.bounds = bounds
        for level, problem in self.problems.items():
            problem.bound(*bounds[level])

    def evener(self, level: int, z: np.ndarray) -> np.ndarray:
        """What the depth would be if the albedo, which is not known, were held EVENER times as fast to one
        that is the same everywhere.
        """
        problem = self.problem(level)
        problem.expect(self.usual, EVENER * PULL)
        self._lean_on_itself(level, z)
        other, _ = problem.run(z, self.smoothness(level), STEPS, MOST, *CLOSE, self.stop)
        problem.expect(self.usual)
        return other

    def settle(self, level: int, z: np.ndarray) -> None:
        """Takes the albedo that is best for z on this grid for known from here on, on all grids."""
        self.problem(level).value(z, 0.0)
        self.albedo_known, self.albedo[level] = True, self.albedo[level] * self.problem(level).albedo()
        for coarser in range(level + 1, self.top + 1):
            self.albedo[coarser] = halved(self.albedo[coarser - 1])
        for finer in range(level - 1, -1, -1):
            self.albedo[finer] = doubled(self.albedo[finer + 1], self.images[finer][0].shape)
        self.problems.clear()

    def finer(self, level: int, z: np.ndarray) -> np.ndarray:
        """What the depth would be if the images were of the smooth surface through the nodes of z, not of the
        nodes alone.

        A grid FINER times as fine, along more azimuths, tells by how much the model is off; the surface is
        fitted again with that put right.
        """
        problem, shape = self.problem(level), tuple(FINER * side for side in z.shape)
        repeated = np.repeat(np.repeat(self.albedo[level], FINER, 0), FINER, 1)
        model = Descent(
            self.engine,
            shape,
            self.sides,
            [
                (light, repeated / (math.pi * scale), np.zeros(shape))
                for light, scale in zip(self._lights(shape, FINER * 0.5**level, MORE), self.scales)
            ],
            np.zeros(shape),
            np.full(shape, np.inf),
        )
        middle, found = slice(FINER // 2, None, FINER), z
        self._lean_on_itself(level, z)
        for _ in range(2):
            fine = model.irradiances(np.maximum(FINER * cubic(found, FINER), 1e-3))
            problem.aim(
                [
                    image + own - other[middle, middle]
                    for image, own, other in zip(self.images[level], problem.irradiances(found), fine)
                ]
            )
            found, _ = problem.run(found, self.smoothness(level), 4, MOST, *CLOSE, self.stop)
        problem.aim(self.images[level])
        return found

    def accept(self, level: int, z: np.ndarray) -> None:
        """Takes z for the answer so far."""
        if self.best is None or self.best[0] >= level:
            self.best = level, z
        self.problem(level).value(z, self.smoothness(level))
        if not self.albedo_known:
            self._expect(level, z)
        reached = Level(z.shape, self.residual(level), time.perf_counter() - self.began)
        log.info(
            "%d x %d: residual %.2g of the image, %.1f s", *reached.shape, reached.residual, reached.seconds
        )
        self.note(reached)

    def residual(self, level: int) -> float:
        """rms of model - image, as a share of the image's, at the last surface that was evaluated there."""
        problem = self.problem(level)
        return math.sqrt(sum(problem.misfits) / (problem.pixels * len(problem.images))) / BRIGHT

    def doubt(self, level: int, z: np.ndarray, seed: int = 0) -> np.ndarray:
        """Standard deviation of depth at z by the linear model, in nodes of this grid: what noise as large as
        the image's own and FAITH of the image's rms would make of it.
        """
        problem, rng = self.problem(level), np.random.default_rng(seed)
        sigma = math.hypot(self.noise * 0.5**level, FAITH * BRIGHT)
        total = np.zeros(z.shape)
        images = problem.irradiances(z)
        for _ in range(PROBES):
            problem.aim([image + sigma * rng.normal(size=z.shape) for image in images])
            problem.value(z, 0.0)
            total += problem.step(self.smoothness(level), MOST, CLOSE[0]) ** 2
        problem.aim(self.images[level])
        return np.sqrt(blurred(total / PROBES))

    def column(self, level: int, z: np.ndarray, count: int = 33) -> tuple[np.ndarray, np.ndarray]:
        """Light of every pixel as its surface goes up and down as a whole: shifts (count,) [nodes of the
        finest grid] and model - image of the first image (count, rows, cols).
        """
        low, high = self.bounds[level]
        shifts = np.linspace(float((low - z).min()), float((high - z).max()), count)
        target = self.images[level][0]
        return shifts * 2**level, np.stack(
            [self.problem(level).irradiances(np.maximum(z + shift, 1e-3))[0] - target for shift in shifts]
        )


def blurred(values: np.ndarray) -> np.ndarray:
    """Means of 3 x 3, twice."""
    for _ in range(2):
        padded = np.pad(values, 1, mode="edge")
        values = (
            sum(padded[i : i + values.shape[0], j : j + values.shape[1]] for i in range(3) for j in range(3))
            / 9
        )
    return values
