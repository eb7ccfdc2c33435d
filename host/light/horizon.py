"""A sky above horizons in even azimuths; its small bright parts in azimuths of their own."""

from __future__ import annotations

import math

import numpy as np

from ..backends.base import Array, Backend
from ..backends.resident import DeviceImage
from ..directions import Azimuths
from ..samples import Samples, picked
from ..scene import Scene
from ..sources.integrals import FINE_KNOTS, Integrals, even, sector_multiples
from ..sources.solids import Dome
from . import unoccluded
from .base import Estimate, Later, LightMethod, judged
from .slices import Slices
from .sweeps import Rays, Sweeps, ground_of

# of a sector: doubling turns it into 2/3 and back, so that no azimuth runs along a grid line; at 1/2 errors
# double there
OFFSET = 1 / 3
# of light by tangent planes over the same by some azimuths, where these receive almost none; chosen: 1.5, 4
# and no limit have the same errors within 2 %
MOST_CORRECTION = 2.0
# nodes that are copied beside a map that repeats, each way: rays that leave it go on from a copy, a period
# back, a millionth of their way before the border. That is up to 17 nodes (MOST_SEARCHED of light/slices.py),
# and rays never end that meet the same border again, so more than 20 are needed. Chosen: with 256 a sun takes
# as long, but for 1 ms on a map of 8 x 8
COPIED = 64


class Horizons(LightMethod):
    """``sky``: a brightness, or Integrals. ``count``: azimuths, even in number.

    ``sectors`` of every small bright part; ``near`` rows within which every crossing is tested.
    ``exact_parts``: small bright parts are above exact horizons, which behind crests a sweep's are not.

    Each of the two halves has half of the azimuths, every other one, and all light. A ratio estimator makes
    the light of so few: of the light that the tangent planes alone let through, which is known exactly, each
    node has the share that these azimuths receive. So it lies between none and all of that light.
    """

    unit_name = "azimuths"

    def __init__(
        self,
        engine: Backend,
        scene: Scene,
        sky: Integrals | float,
        count: int,
        sectors: int = 8,
        near: int | None = None,
        exact_parts: bool = False,
    ):
        self.engine, self.scene, self.sky, self.units, self.sectors = engine, scene, sky, count, sectors
        self.scale, parts = (1.0, sky.bright_parts) if isinstance(sky, Integrals) else (sky, ())
        size = (2, math.prod(scene.shape))
        self.sweeps = Sweeps(engine, ground_of(scene, None, engine), near=near)
        self.total, self.turned = (engine.empty(size, np.int32) for _ in range(2))
        self.parts, self.slices = list(zip(parts, sector_multiples(parts))), None
        if exact_parts and parts:
            self.slices = Slices(
                scene.on(engine), scene.sides, Dome(), copied=COPIED if scene.sides == "periodic" else 0
            )
        # light (side, side) by normal that the tangent planes alone leave
        self.exact = np.zeros(0)
        if isinstance(sky, Integrals):
            azimuths = unoccluded.INTEGRATED_AZIMUTHS
            self.exact = _by_normals(sky, even(azimuths, 0.5), 2 * math.pi / azimuths)
        self._half_difference: Array = None
        self.offset = OFFSET / 2
        self.mean, other = self._images(count // 2, 2 * math.pi / count, False, True)
        self._halve(other)

    def refine(self) -> None:
        """Add the azimuths between the present ones."""
        count, self.sectors = self.units, 2 * self.sectors
        self.units *= 2
        self._halve(*self._images(count, math.pi / count, True))

    def _halve(self, image: Array) -> None:
        """Average with ``image``, of the azimuths between the present ones."""
        self.offset = 2 * self.offset % 1
        count = math.prod(self.scene.shape)
        self.engine.launch("ground", "halves", (count,), self.mean, image, count, 0)
        self._half_difference = image

    def _images(self, count: int, window: float, *between: bool) -> list[Array]:
        """The light of ``count`` azimuths, brightness averaged over ``window`` round each, and of sectors.

        An image for each of ``between``: of the azimuths half a step on, or not. All are swept together: a
        GPU takes as long for some azimuths as for a few more.
        """
        grids = [even(count, self.offset + shifted / 2) for shifted in between]
        swept = self.parts if self.slices is None else []
        parts = [
            [spot.sectors(times * self.sectors, shifted) for spot, times in swept] for shifted in between
        ]
        images = [self.engine.empty(self.scene.shape, np.float32) for _ in between]
        self.sweeps.set_azimuths(*self._rays(grids, window, parts))
        self.sweeps.light(self.total, self.turned, *images)
        for azimuths, sectors, image in zip(grids, parts, images):
            if isinstance(self.sky, Integrals):
                planes = _by_normals(self.sky, azimuths, window)
                bright = np.zeros_like(planes)  # the suns' part of the image
                for spot in sectors:
                    angles, table = _as_azimuths(*spot)
                    bright += unoccluded.by_normals(table, angles, np.ones(len(angles)))
                self.sweeps.correct(correction(self.exact + bright, planes + bright), image)
        if self.slices is not None:
            self._add_exact(self.slices, images, between)
        return images

    def _add_exact(self, slices: Slices, images: list[Array], between: tuple[bool, ...]) -> None:
        """Add the light of the small parts that stand above exact horizons, at once to all images."""
        ways, tables, numbers = [], [], []
        for part, times in self.parts:  # its sectors next to each other: a CPU traces eight at once
            for number, shifted in enumerate(between):
                way, table = part.sectors(times * self.sectors, shifted)
                ways.append(way)
                tables.append(table)
                numbers += len(table) * [number]
        slices.image = images[0]
        slices.sectors(
            np.concatenate(ways, 1), np.concatenate(tables, 0), other=images[-1], to_other=np.array(numbers)
        )

    def _rays(
        self, grids: list[Azimuths], window: float, bright_parts: list[list[tuple[np.ndarray, np.ndarray]]]
    ) -> tuple[Rays, np.ndarray | None]:
        """The azimuths of all ``grids``, a sum each, with those of small bright parts that are swept; and
        their brightness.
        """
        rays, tables = [], []
        for azimuths, sectors in zip(grids, bright_parts):
            ray = Rays(azimuths.angles, azimuths.widths)
            if isinstance(self.sky, Integrals):
                knots = FINE_KNOTS if sectors else None
                table = self.sky.table(ray.angles, np.full(len(azimuths), window), knots)
                if sectors:
                    ray, table = with_bright_parts(ray, table, sectors)
                tables.append(table)
            rays.append(ray)
        angles, widths = (
            np.concatenate([getattr(one, name) for one in rays]) for name in ("angles", "widths")
        )
        numbers = np.repeat(np.arange(len(rays)), [len(one.angles) for one in rays])
        return Rays(angles, widths, numbers), np.concatenate(tables) if tables else None

    def irradiance(self) -> np.ndarray:
        return _scaled(self.engine.download(self.mean).reshape(self.scene.shape), self.scale)

    def device_image(self) -> DeviceImage:
        image = DeviceImage(self.engine, self.mean, self.scene.shape)
        if self.scale != 1:
            image.scale(self.scale)
        return image

    def at(self, samples: Samples) -> np.ndarray:
        return _scaled(picked(samples, self.mean), self.scale).astype(float)

    def half_difference_at(self, samples: Samples) -> np.ndarray:
        return _scaled(picked(samples, self._half_difference), self.scale).astype(float)

    def half_difference(self) -> Later:
        engine, image, shape, scale = self.engine, self._half_difference, self.scene.shape, self.scale
        return Later(lambda: _scaled(engine.download(image).reshape(shape), scale))

    def estimate(self, limit: float) -> Estimate:
        limit = limit / self.scale if self.scale else math.inf
        images = self.mean, self._half_difference
        heights, margin = self.sweeps.heights, self.sweeps.margin
        found = judged(self.engine, self.scene.shape, heights, margin, *images, limit)
        return found._replace(mean=found.mean * self.scale)


def _scaled(image: np.ndarray, scale: float) -> np.ndarray:
    return image if scale == 1.0 else image * np.float32(scale)


def correction(exact: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """The factor of the light of some azimuths: ``exact`` / ``planes``.

    All light that tangent planes alone let through, and what these azimuths make of it.
    """
    ratio: np.ndarray = np.divide(exact, planes, out=np.ones_like(exact), where=planes > 0)
    ratio = np.minimum(ratio, MOST_CORRECTION)
    return ratio


def _by_normals(sky: Integrals, azimuths: Azimuths, window: float) -> np.ndarray:
    """Light (side, side) by normal, over ``azimuths``, that the tangent planes leave.

    Brightness is averaged over ``window`` round each azimuth.
    """
    angles, widths = azimuths.angles, azimuths.widths

    def make() -> np.ndarray:
        return unoccluded.by_normals(sky.table(angles, np.full(len(angles), window)), angles, widths)

    return sky.once(("by normals", angles.tobytes(), widths.tobytes(), window), make)


def with_bright_parts(
    rays: Rays, table: np.ndarray, bright_parts: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[Rays, np.ndarray]:
    """Azimuths and their table (K, FINE_KNOTS, 4), and with them the sectors of small bright parts."""
    angles, parts = zip(*(_as_azimuths(*spot) for spot in bright_parts))
    widths = np.ones(sum(map(len, angles)))
    rays = Rays(np.concatenate([rays.angles, *angles]), np.concatenate([rays.widths, widths]))
    return rays, np.concatenate([table, *parts])


def _as_azimuths(ways: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(angles, table (K, FINE_KNOTS, 4)) for sweeps, of sectors of a small part."""
    cosine, sine, _, first, scale = ways.astype(float)
    knots = np.linspace(0, 1, FINE_KNOTS)  # diamond angles
    resampled = np.zeros((len(table), FINE_KNOTS, 4), np.float32)
    for n, part in enumerate(table):
        at = first[n] + np.arange(len(part)) / scale[n]
        for k in (0, 1):
            resampled[n, :, k] = np.interp(knots, at, part[:, k])
    resampled[:, :-1, 2:] = np.diff(resampled[:, :, :2], axis=1)
    return np.arctan2(sine, cosine), resampled
