"""Launch sequence of the light between surfaces: rounds of gathering, and exact strips at some nodes."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..backends.base import Array, Backend, reserve
from ..backends.resident import DeviceImage
from ..constants import NONE, SIDES
from ..errors import CapacityError
from ..samples import SAMPLED_SLOPE, Samples, picked, samples_of
from ..scene import Scene
from .horizon import OFFSET
from .propagation import Lobe

GROUP = 64  # work-items of a group of kernels that own a node each: PoCL runs a group in one loop
Values = Any  # numbers or arrays
# RMS error of ground in wide lobes of specular albedo 1, over the mean radiance of the ground, by the number
# of azimuths across the lobe and of rays in each; half width [rad] of lobes down to which it is so large.
# From there on it falls about as the root of the width (performance/interreflection.py --lobes)
LOBE_ERRORS = {4: 0.077, 6: 0.042, 8: 0.028, 12: 0.016, 16: 0.011, 24: 0.0073, 32: 0.0053, 64: 0.0022}
WIDE_LOBE = 0.41
FINE_PROFILE = 4096  # knots of half a lobe's profile; chosen
PLANE_SHIFT = 2  # columns 2^PLANE_SHIFT apart are neighbours in planes: the widest stride of receivers


class Round(NamedTuple):
    """One gather: azimuths, stride of the receivers, crossings met one by one, growth of steps past them."""

    azimuths: int
    stride: int
    near: int
    growth: float


class Planes:
    """How maps of a shape lie in planes, as the kernels read them, and the steps of rays over them.

    ``relief`` [spacing]: of a map that repeats; the distance of visible ground follows from it.
    """

    def __init__(self, engine: Backend, shape: tuple[int, int], sides: str, lights: int, relief: float):
        self.engine, self.sides, self.shape, self.lights = engine, sides, shape, lights
        rows, cols = shape
        # along an axis; on a map that repeats, to where its relief makes a slope of SAMPLED_SLOPE
        self.far = max(rows, cols, relief / SAMPLED_SLOPE if sides == "periodic" else 0)
        self.shift = PLANE_SHIFT
        if sides == "periodic":  # planes repeat only if the columns are shared out evenly
            self.shift = min(PLANE_SHIFT, (cols & -cols).bit_length() - 1)
        self.margin = engine.lanes + 1
        self.across = -(-cols // (1 << self.shift))
        self.width = -(-self.across // engine.lanes) * engine.lanes  # in whole vectors
        self.plane_map = (1 << self.shift) * (rows + 2) * (self.across + 2 * self.margin)
        if lights * max(self.plane_map, rows * cols) >= 2**31:
            raise CapacityError(f"A map of {rows * cols:,} nodes in {lights} colours: cut it into tiles.")
        reserve(
            engine,
            4 * (1 + 4 * lights) * self.plane_map,
            f"Light between {rows} x {cols} nodes",
            "Cut it into tiles.",
            4 * (1 + lights) * self.plane_map,
        )
        self.heights = engine.empty((self.plane_map,), np.float32)
        self.light = engine.empty((lights * self.plane_map,), np.float32)

    @property
    def _layout(self) -> tuple[int, ...]:
        return *self.shape, self.across, self.margin, self.shift

    def _spread(
        self,
        maps: Array,
        albedo: Array,
        planes: Array,
        count: int,
        varies: bool,
        scale: float,
        outside: float,
    ) -> None:
        dim = self.across + 2 * self.margin, self.shape[0] + 2, count
        size = count, *self._layout, int(self.sides == "periodic"), int(varies)
        self.engine.launch(
            "interreflection", "spread", dim, maps, albedo, planes, *size, scale, outside, group=GROUP
        )

    def _tables(self, this: Round) -> list[Array]:
        """The :func:`crossing_tables` of the kernels, on the device."""
        return [self.engine.table(table) for table in crossing_tables(this, self.far)]

    def _gather_receivers(
        self, azimuths: int, tables: Sequence[Array], sums: Array, grid: tuple[int, ...], highest: float
    ) -> None:
        """Sums over the strips of receivers; ``grid``: their stride, phases and width."""
        stride, phases, width = grid
        dim = width // self.engine.lanes, phases, -(-self.shape[0] // stride)
        maps = self.heights, self.light, *tables, sums
        size = azimuths, tables[1].shape[1], *self._layout, SIDES[self.sides], *grid
        self.engine.launch("interreflection", "gather", dim, *maps, *size, highest, LIGHTS=self.lights)


class Strips(Planes):
    """Strips of ground visible from every node of a surface, for ground of known radiance.

    ``radiances`` (lights, rows, cols): of the ground; ``sums`` on the device: over the strips, of shares x
    radiance for every light, and of shares, as the kernel gather lays them out in rows of ``width``. Surfaces
    have depths of 0 at least; ``relief`` [spacing] at most.
    """

    def __init__(self, engine: Backend, sides: str, radiances: np.ndarray, relief: float, rays: Round):
        super().__init__(engine, radiances.shape[1:], sides, len(radiances), relief)
        self.azimuths = rays.azimuths
        self.one, ones = (engine.upload(np.ones(count, np.float32)) for count in (1, self.lights))
        self.tables = self._tables(rays)
        self.steps = self.tables[1].shape[1]
        self.sums = engine.empty(
            ((self.lights + 1) * self.shape[0] * (1 << self.shift) * self.width,), np.float32
        )
        given = engine.upload(radiances.astype(np.float32).ravel())
        self._spread(given, ones, self.light, self.lights, False, 1.0, 0.0)
        engine.finish()

    def find(self, z: Array) -> None:
        """Of the surface of depths z (rows x cols) on the device."""
        self._spread(z, self.one, self.heights, 1, False, -1.0, NONE)
        self._gather_receivers(self.azimuths, self.tables, self.sums, (1, 1 << self.shift, self.width), 0.0)


class Glossy(Planes):
    """Ground of known radiance, (lights, rows, cols) float32 and 0 where masked, as a glossy scene shows it.

    Ground farther away than ``max_distance`` [unit of spacing] is not shown.
    """

    def __init__(self, engine: Backend, scene: Scene, radiances: np.ndarray, max_distance: float | None):
        self.samples = samples_of(engine, scene)
        super().__init__(engine, scene.shape, scene.sides, len(radiances), self.samples.relief)
        reach = math.sqrt(2) * self.far
        self.reach = reach if max_distance is None else min(reach, max_distance / scene.spacing)
        one, ones = (engine.table(np.ones(count, np.float32)) for count in (1, self.lights))
        given = engine.upload(radiances.astype(np.float32, copy=False).ravel())
        self._spread(self.samples.heights, one, self.heights, 1, False, 1.0, NONE)
        self._spread(given, ones, self.light, self.lights, False, 1.0, 0.0)
        self.image = engine.empty((radiances.size,), np.float32)
        engine.finish()  # what was given may be freed

    def within(self, lobe: Lobe, error: float) -> np.ndarray:
        """:meth:`by_lobe`, by the fewest rays whose RMS error, times the lobe's norm, is no more than a share
        ``error`` of the mean radiance of the ground.
        """
        scale = math.sqrt(min(1.0, lobe.spread / WIDE_LOBE))
        fewest = (count for count, found in LOBE_ERRORS.items() if scale * found <= error)
        return self.by_lobe(lobe, next(fewest, max(LOBE_ERRORS)))

    def by_lobe(self, lobe: Lobe, count: int) -> np.ndarray:
        """Integrals of radiance x lobe x N.L over the ground, (lights, rows, cols) float32.

        By ``count`` azimuths across the lobe, and as many rays in each.
        """
        spots = np.tile(_spots(lobe, count), (2, 1))
        return self._shown(lobe.table, lobe.rim, spots, count)

    def in_mirrors(self) -> np.ndarray:
        """Radiance of ground along mirror directions, (lights, rows, cols) float32; 0 where none is met."""
        return self._shown(np.ones(2, np.float32), 0.0, np.zeros((2, 2), np.float32), 1)

    def _shown(self, lobe: np.ndarray, rim: float, spots: np.ndarray, slices: int) -> np.ndarray:
        dim, samples = (self.across, 1 << self.shift, self.shape[0]), self.samples
        maps = (
            self.heights,
            self.light,
            self.engine.table(lobe),
            self.engine.table(spots),
            samples.tops,
            self.image,
        )
        size = *self._layout, SIDES[self.sides], samples.shift, samples.tops.shape[2]
        last = slices, len(spots) - slices, len(lobe), rim, samples.highest, self.reach
        how: dict[str, Any] = dict(lanes=1, group=GROUP, LIGHTS=self.lights)
        self.engine.launch("interreflection", "glossy", dim, *maps, *size, *last, **how)
        return self.engine.download(self.image).reshape(self.lights, *self.shape)


def _spots(lobe: Lobe, count: int) -> np.ndarray:
    """Places from -1 to 1 across a lobe, and their widths: (count, 2) float32.

    They are as dense as the cube root of the lobe's profile, which is best for midpoints where the curvature
    of what is summed is in proportion to the profile.
    """
    rim = math.acos(1 - lobe.rim)
    angles = np.linspace(0, rim, FINE_PROFILE)
    profile = np.interp(1 - np.cos(angles), np.linspace(0, lobe.rim, len(lobe.table)), lobe.table)
    density = np.cbrt(np.concatenate([profile[:0:-1], profile]))
    places = np.concatenate([-angles[:0:-1], angles]) / rim
    sums = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(places))])
    at = np.interp((np.arange(count) + 0.5) / count * sums[-1], sums, places)
    widths = sums[-1] / count / np.interp(at, places, density)
    return np.stack([at, widths], -1).astype(np.float32)


class Bounces(Planes):
    """Irradiance of a scene by direct light and by all light between its surfaces, made better by rounds.

    ``direct``: irradiance (rows, cols) float32 of each light, one or one per colour; ``albedo`` of each, a
    number or (rows, cols); ``sky`` (rows, cols) float32: cosine-weighted share of the sky at every node.
    One light may be a DeviceImage, which is used in place, and so may ``sky``.
    """

    def __init__(
        self,
        engine: Backend,
        scene: Scene,
        samples: Samples,
        direct: Sequence[np.ndarray | DeviceImage],
        albedo: Sequence[Values],
        sky: np.ndarray | DeviceImage,
    ):
        super().__init__(engine, scene.shape, scene.sides, len(direct), samples.relief)
        self.samples, self.valid, self.highest = samples, scene.mask, samples.highest
        self.varies = any(np.ndim(share) for share in albedo)
        self.albedo = engine.table(
            np.stack([np.broadcast_to(share, scene.shape if self.varies else ()) for share in albedo])
            .astype(np.float32, copy=False)
            .ravel()
        )
        one = engine.table(np.ones(1, np.float32))
        self._spread(samples.heights, one, self.heights, 1, False, 1.0, NONE)
        self.sky = _uploaded(engine, [sky])
        light, pixels = direct[0], math.prod(scene.shape)
        if isinstance(light, DeviceImage):
            if self.valid is not None:
                light.shade(scene.on(engine), 1.0, 1.0)  # nan, which `begin` makes 0
        elif self.valid is not None:
            direct = [np.where(self.valid, light, 0) for light in direct]
        self.direct = _uploaded(engine, direct)
        self.total = engine.empty((self.lights * pixels,), np.float32)
        maps, size = (self.direct, self.albedo, self.sky, self.total), (self.lights, pixels, int(self.varies))
        engine.launch("interreflection", "begin", (pixels, self.lights), *maps, *size, group=GROUP)

    def _send(self) -> None:
        """The radiance of the ground by the present irradiance."""
        self._spread(self.total, self.albedo, self.light, self.lights, self.varies, 1 / math.pi, 0.0)

    def run(self, rounds: Sequence[Round]) -> None:
        """One gather after another, each by the light that the one before has found."""
        for this in rounds:
            self._send()
            self._gather(this)

    def _gather(self, this: Round) -> None:
        engine, (rows, cols) = self.engine, self.shape
        tables = self._tables(this)
        common = (*self._layout, SIDES[self.sides])
        if this.stride > 1:
            phases, lines = max(1, (1 << self.shift) // this.stride), -(-rows // this.stride)
            sums = engine.empty(((self.lights + 1) * lines * phases * self.width,), np.float32)
            grid = this.stride, phases, self.width
            self._gather_receivers(this.azimuths, tables, sums, grid, self.highest)
            dim = -(-cols // min(this.stride, 1 << self.shift)), rows
            given = self.heights, sums, self.direct, self.sky, self.total, *common, *grid
            engine.launch("interreflection", "fill", dim, *given, group=GROUP, LIGHTS=self.lights)
        if this.stride == 1 or self.valid is not None:
            nodes = self.width // engine.lanes, 1 << self.shift, rows
            maps = self.heights, self.light, *tables, self.direct, self.sky, self.total
            size = this.azimuths, tables[1].shape[1], *common, int(this.stride == 1), self.highest
            engine.launch("interreflection", "gather_nodes", nodes, *maps, *size, LIGHTS=self.lights)
        engine.finish()  # sums may be freed

    def irradiance(self) -> list[np.ndarray]:
        """(rows, cols) float32 [brightness x sr] of each light; 0 where masked."""
        return list(self.engine.download(self.total).reshape(self.lights, *self.shape))

    def device_image(self) -> DeviceImage:
        """:meth:`irradiance` of one light, where it lies."""
        return DeviceImage(self.engine, self.total, self.shape)

    def total_at_samples(self) -> np.ndarray:
        """The present irradiance of each light at the samples, (lights, nodes) float64."""
        return np.stack([picked(self.samples, self.total, n) for n in range(self.lights)]).astype(float)

    def at_samples(self, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
        """(light, sky) at the samples by exact strips: (lights, nodes) [brightness x sr], (nodes,).

        Light that the ground sends with its present brightness, over every crossing in so many azimuths, and
        the share of sky.
        """
        self._send()
        samples, engine = self.samples, self.engine
        angles = 2 * np.pi * (np.arange(azimuths) + OFFSET) / azimuths
        rays = np.empty((azimuths, len(samples), 4), np.float32)
        rays[..., 0], rays[..., 1] = samples.x, samples.y
        rays[..., 2], rays[..., 3] = np.cos(angles)[:, None], np.sin(angles)[:, None]
        count = azimuths * len(samples)
        given = engine.upload(rays.reshape(-1, 4))
        partial = engine.empty(((self.lights + 2) * count,), np.float32)
        maps = self.heights, self.light, samples.tops, given, partial
        size = count, *self._layout, SIDES[self.sides], samples.shift, samples.tops.shape[2]
        last = self.highest, math.sqrt(2) * self.far
        engine.launch("interreflection", "strips", (count,), *maps, *size, *last, lanes=1, LIGHTS=self.lights)
        sums = engine.download(partial).reshape(self.lights + 2, azimuths, -1).mean(1, dtype=np.float64)
        return np.pi * sums[: self.lights], sums[-1]


def _uploaded(engine: Backend, images: Sequence[np.ndarray | DeviceImage]) -> Array:
    """Images (rows, cols) one after another on the device: a DeviceImage itself, or float32 copies."""
    first = images[0]
    if isinstance(first, DeviceImage):
        return first.values
    return engine.upload(
        (first if len(images) == 1 else np.stack(images)).astype(np.float32, copy=False).ravel()
    )


@functools.lru_cache(32)  # rounds follow one another in the same azimuths, and so do calls
def crossing_tables(this: Round, far: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(ways, places, crossings) of the kernels, up to ``far`` along an azimuth's major axis."""
    angles = 2 * np.pi * (np.arange(this.azimuths) + OFFSET) / this.azimuths
    across, along = np.cos(angles), np.sin(angles)
    by_columns = np.abs(across) >= np.abs(along)
    major = np.where(by_columns, across, along)
    minor = np.where(by_columns, along, across)
    step = np.array(steps(this.near, this.growth, far))
    aside = np.outer(minor / np.abs(major), step)
    low = np.floor(aside + 1e-9)
    straight = np.sign(major)[:, None] * step
    places = np.where(by_columns[:, None, None], np.stack([straight, low], -1), np.stack([low, straight], -1))
    distance = step / np.abs(major)[:, None]
    crossings = np.stack([np.maximum(aside - low, 0), distance, 1 / distance], -1)
    ways = np.stack([across, along, by_columns, np.zeros(len(angles))], -1)
    return ways.astype(np.float32), places.astype(np.int32), crossings.astype(np.float32)


def steps(near: int, growth: float, far: float) -> list[int]:
    """Steps along an azimuth's major axis up to ``far``: one by one up to ``near``, then growing."""
    strides, step = [], 1
    while step <= far:
        strides.append(step)
        step += max(1, round(growth * step)) if step >= near else 1
    return strides
