"""Planning for skies: horizons in even azimuths, small bright parts in azimuths of their own."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ..constants import LEAST_SEARCHED_SLOPE
from ..errors import CapacityError
from ..light import unoccluded
from ..light.base import LightMethod
from ..light.horizon import Horizons, correction
from ..samples import Samples
from ..sources.integrals import BrightPart, Integrals, even, integrals, sector_multiples
from .base import EXACT_ERROR_RATIO, MOST_STEPS, TABLES_ERROR, UnitsPlanner
from .plan import Choice, percent

# numbers of azimuths that an image may begin with: powers of two, and 3/2 of them; refining doubles them
AZIMUTH_COUNTS = (4, 6, 8, 12, 16, 24, 32, 48)
EXACT_AZIMUTHS = (36, 72, 144, 288)  # azimuths of the exact light, which judges a sixth as many
# those of the exact light that judges a finished image, 1.5 times the image's at least: of light from a band
# near the level 288 had a larger error than an image of 768, which was 1.4 tolerances off without a warning
AUDIT_AZIMUTHS = (288, 576, 1152, 1536)
# the first of EXACT_AZIMUTHS on a device with memory of its own, which traces so many as fast as 36 (line
# "tolerance 0.01" of performance/whole_calls.py, H200: 31 ms, with 36 at first 34; 8.1 and 9.1 on 256 x 256)
GPU_EXACT_AZIMUTHS = 144
# least number of sectors of azimuth of all small bright parts together, in each half of an image with a
# tolerance of 1 % or more: in both as many as a CPU computes at a time. Where an upright edge divides a sun,
# the error is one over their number, and the samples may miss such nodes; so with a smaller tolerance there
# are as many times more, MOST_SECTORS at most. With 4 at 0.3 % images beside a wall were 2 tolerances off,
# with 8 they were 1.1
LEAST_SECTORS, MOST_SECTORS, LEAST_SECTORS_TOLERANCE = 4, 40, 0.01
# multiples of it that are tried in turn; and the multiple of an image's in the exact light: odd, so that its
# sectors have other borders
SECTOR_MULTIPLES, EXACT_SECTOR_MULTIPLE = (1, 3, 9), 3
# near rows, within which every crossing is tested: where the usual 6 do not suffice, and where 24 do not
CLIFF_NEAR_ROWS = 24, 96
# RMS error of sweeps with 6 near rows, over the square root of the share of neighbouring nodes that are
# cliffs; measured. With half and twice as many of 24 images are within 1 %, in 1.02 and 0.95 of the time
# (performance/constants.py --seed 23 --size 64)
BEHIND_CLIFFS = 0.028
# RMS error of the light of a swept sun, over that light: behind crests a few nodes are wrong, which samples
# miss. Measured: 98 % of 300 random pairs of ground and sun have less, 96 % half as much, and one .7, over
# spikes (performance/swept_suns.py). With a quarter and half 12 pairs take as long (constants.py)
SWEPT_SUN = 0.2


class SkyPlanner(UnitsPlanner):
    """Skies: horizons in even azimuths."""

    method_class = Horizons

    light: float | Integrals  # a brightness, or its integrals
    bright_parts: tuple[BrightPart, ...] = ()
    multiples: Sequence[int] = ()  # of each of them, times as many sectors
    by_sectors: dict[int, np.ndarray]  # their light at the samples by sectors of each, two halves
    near_rows: int | None = None
    sectors = exact_sectors = 0  # of azimuth, of every small bright part: of the image, of the exact light
    exact_parts = False  # whether small bright parts are above exact horizons, or swept
    exact_count = 0  # azimuths of the exact light
    exact_angles: np.ndarray  # these azimuths
    exact_slopes: np.ndarray  # exact horizons in them
    exact_uniform: np.ndarray  # light of brightness 1 above these, per radian
    open_light: np.ndarray  # that tangent planes alone leave
    exact_smooth: np.ndarray  # exact light without small bright parts, two halves
    exact: np.ndarray
    uniform: np.ndarray

    def choose(self) -> None:
        samples, self.by_sectors = self.samples, {0: np.zeros((2, len(self.samples)))}
        self._integrate()
        planes = even(unoccluded.INTEGRATED_AZIMUTHS, 0.5)
        if isinstance(self.light, Integrals):
            table = self.light.table(planes.angles, planes.widths)
            slopes = _open_slopes(samples, planes.angles)
            self.open_light = planes.widths @ samples.ring(planes.angles, slopes, table)
        else:
            self.open_light = np.pi / 2 * self.light * (1 + 1 / samples.length)
        grids = [grid for grid in EXACT_AZIMUTHS if self.engine.shares or grid >= GPU_EXACT_AZIMUTHS]
        self.set_exact_light(grids[0])
        self._choose_sectors()
        self._choose_exact_parts()
        judged = [0, *(grid // 6 for grid in grids)]
        self.choose_units(
            (grid, [n for n in AZIMUTH_COUNTS if low < n <= high])
            for grid, low, high in zip(grids, judged, judged[1:])
        )
        self._check_work()

    def _integrate(self) -> None:
        """Set the brightness: a number, or its integrals and its small bright parts."""
        brightness = self.source.brightness
        if not callable(brightness):
            self.light = float(brightness)
            return
        self.light = sky = integrals(self.source, self.tolerance)
        self.multiples = sector_multiples(sky.bright_parts)
        self.bright_parts, self.tables_error = sky.bright_parts, math.hypot(TABLES_ERROR, sky.error)

    def set_exact_light(self, units: int) -> None:
        """Exact light at the samples in so many azimuths, unless it is known in as many or more."""
        samples, width = self.samples, 2 * np.pi / units
        if units <= self.exact_count:
            return
        angles, at = width * np.arange(units), self.exact_count * np.arange(units)
        new = (at % units > 0) | (self.exact_count == 0)  # the others were traced before
        slopes, uniform = np.empty((2, units, len(samples)))
        slopes[new], uniform[new] = samples.horizons(angles[new]), samples.uniform(angles[new])
        if self.exact_count:
            known = at[~new] // units
            slopes[~new], uniform[~new] = self.exact_slopes[known], self.exact_uniform[known]
        self.exact_count, self.exact_angles = units, angles
        self.exact_slopes, self.exact_uniform = slopes, uniform
        self.uniform = self.exact_uniform.sum(0) * width
        self.exact_smooth = np.stack([self._light_in(np.arange(odd, units, 2), width) for odd in (0, 1)])
        self._add_bright_parts()

    def _add_bright_parts(self) -> None:
        """Set the exact light, that of even azimuths and that of small bright parts."""
        one, other = self.exact_smooth + self._bright_light(self.exact_sectors)
        self.exact = (one + other) / 2
        self.exact_error = EXACT_ERROR_RATIO * self.samples.errors(other, self.exact).rms

    def light_by(self, units: int) -> np.ndarray:
        nearest = self.exact_count * (3 * np.arange(units) + 1) // (3 * units)  # those of Horizons
        one, other = (self._light_in(nearest[odd::2], 2 * np.pi / units) for odd in (0, 1))
        light: np.ndarray = (one + other) / 2 + self._bright_light(self.sectors).mean(0)
        return light

    def _bright_light(self, sectors: int) -> np.ndarray:
        """Light of small bright parts at the samples by so many sectors of each, (2, nodes): two halves."""
        if sectors not in self.by_sectors:
            parts = list(zip(self.bright_parts, self.multiples))
            halves = [
                [spot.sectors(times * sectors, shifted) for spot, times in parts] for shifted in (False, True)
            ]
            self.by_sectors[sectors] = np.stack(
                [
                    self.samples.sectors(np.concatenate(ways, 1), np.concatenate(tables))
                    for ways, tables in (zip(*half) for half in halves)
                ]
            )
        return self.by_sectors[sectors]

    def _light_in(self, chosen: np.ndarray, window: float) -> np.ndarray:
        """Light in ``chosen`` azimuths of the grid, as a share of that above tangent planes; see Horizons.

        Brightness is averaged over ``window`` [rad] round each.
        """
        width = 2 * np.pi / len(chosen)
        if not isinstance(self.light, Integrals):
            uniform: np.ndarray = self.light * width * self.exact_uniform[chosen].sum(0)
            return uniform
        angles = self.exact_angles[chosen]
        table = self.light.table(angles, np.full(len(chosen), window))
        planes, light = (
            width * self.samples.ring(angles, slopes, table).sum(0)
            for slopes in (_open_slopes(self.samples, angles), self.exact_slopes[chosen])
        )
        total: np.ndarray = light * correction(self.open_light, planes)
        return total

    def _choose_sectors(self) -> None:
        """The fewest sectors of small bright parts whose light at the samples is that of many."""
        if not self.bright_parts:
            return
        least = LEAST_SECTORS * max(1.0, LEAST_SECTORS_TOLERANCE / self.tolerance)
        for times in SECTOR_MULTIPLES:
            self.sectors = times * math.ceil(min(least, MOST_SECTORS) / sum(self.multiples))
            self.exact_sectors = EXACT_SECTOR_MULTIPLE * self.sectors
            self._add_bright_parts()
            few, many = (self._bright_light(n).mean(0) for n in (self.sectors, self.exact_sectors))
            if self.fits(self.samples.errors(self.exact + few - many, self.exact)):
                break

    def _choose_exact_parts(self) -> None:
        """Whether small bright parts stand above exact horizons; the near rows of what is swept."""
        samples = self.samples
        share = samples.errors(self.exact - self._bright_light(self.exact_sectors).mean(0), self.exact).rms
        self.exact_parts = SWEPT_SUN * share > 0.5 * self.tolerance
        if BEHIND_CLIFFS * math.sqrt(samples.cliffs) > 0.5 * self.tolerance:
            self.near_rows = CLIFF_NEAR_ROWS[0]

    def _check_work(self) -> None:
        """CapacityError where the azimuths, with the search on a map that repeats, are too much work."""
        lap = self.samples.relief / LEAST_SEARCHED_SLOPE if self.scene.sides == "periodic" else 0.0
        steps = self.units * math.prod(self.scene.shape) * (1 + lap / min(self.scene.shape))
        if steps > MOST_STEPS:
            raise CapacityError(
                f"A tolerance of {self.tolerance:g} takes some {steps:.2g} nodes x azimuths here; at most"
                f" {MOST_STEPS:,}. Take a larger tolerance or a smaller map."
            )

    def _light_below(self, slope: float) -> float:
        """RMS over the mean of the light between the ground and ``slope`` at the samples."""
        if not isinstance(self.light, Integrals):
            return 0.0  # at most 5e-5, see LEAST_SEARCHED_SLOPE
        angles, slopes, width = self.exact_angles, self.exact_slopes, 2 * np.pi / self.exact_count
        table = self.light.table(angles, np.full(len(angles), width))
        ring = self.samples.ring
        below = ring(angles, slopes, table) - ring(angles, np.maximum(slopes, slope), table)
        return self.samples.errors(self.exact - width * below.sum(0), self.exact).rms

    def make(self, refined: Horizons | None = None) -> LightMethod:
        """The method, with as many azimuths and sectors as it had when it was ``refined``."""
        units, sectors = (refined.units, refined.sectors) if refined else (self.units, self.sectors)
        exactness = self.near_rows, self.exact_parts
        return Horizons(self.engine, self.scene, self.light, units, sectors, *exactness)

    def audit(self, method: LightMethod) -> float | None:
        if 3 * method.units > self.exact_count:
            self.set_exact_light(next(n for n in AUDIT_AZIMUTHS if 2 * n >= 3 * method.units))
        if isinstance(method, Horizons) and EXACT_SECTOR_MULTIPLE * method.sectors > self.exact_sectors:
            self.exact_sectors = EXACT_SECTOR_MULTIPLE * method.sectors
            self._add_bright_parts()
        return super().audit(method)

    def refine(self, is_mostly_common: bool) -> bool:
        if is_mostly_common:
            near = next((near for near in CLIFF_NEAR_ROWS if near > (self.near_rows or 0)), None)
            if near is not None:
                self.near_rows = near
                assert isinstance(self.method, Horizons), "make gives no other"
                self.method = self.make(self.method)
                return True
        if self.scene.sides == "periodic":
            times = self.method.units // self.units
            swept = 0 if self.exact_parts else len(self.bright_parts)
            added = times * (self.units + 2 * swept * self.sectors)
            if self.samples.relief / LEAST_SEARCHED_SLOPE * added > self.engine.most_searched_rows:
                return False  # the image stays, with its warning
        return super().refine(is_mostly_common)

    def choices(self) -> Iterator[Choice]:
        hidden = self.samples.errors(self.uniform, np.pi / 2 * (1 + 1 / self.samples.length)).rms
        yield Choice("occlusion", "by ground", f"ground takes {percent(hidden)} of the light (RMS)")
        if isinstance(self.light, Integrals):
            yield Choice("brightness", "a table per azimuth", f"integrated to {percent(self.light.error)}")
        else:
            yield Choice("brightness", "constant", "it is a number")
        if self.bright_parts:
            ways = [2 * times * self.sectors + 1 for times in self.multiples]
            taken = f"{ways[0]} azimuths each" if len(set(ways)) == 1 else f"{sum(ways)} azimuths"
            why = "small and bright: suns, lights and spots have azimuths of their own"
            if self.exact_parts:
                why += ", above exact horizons"
            yield Choice("bright parts", f"{len(self.bright_parts)}, {taken}", why)
        yield Choice(
            "azimuths", f"{self.units} evenly", "the fewest whose light at the samples is that of many"
        )
        why = "a sweep costs the same however far it looks"
        if self.scene.sides == "periodic":
            why = f"on a map that repeats, as far as its relief makes a slope of {LEAST_SEARCHED_SLOPE}"
            if (share := self._light_below(LEAST_SEARCHED_SLOPE)) > self.tolerance:
                why += f"; {percent(share)} of the light (RMS) comes from below, where no ground is searched"
        yield Choice("search radius", "whole map", why)
        if self.near_rows:
            yield Choice(
                "near rows", f"{self.near_rows}", "there are cliffs: every crossing so near is tested"
            )


def _open_slopes(samples: Samples, angles: np.ndarray) -> np.ndarray:
    """Horizon slopes at the samples of tangent planes and the level alone."""
    slopes: np.ndarray = np.maximum(0, samples.plane(np.cos(angles)[:, None], np.sin(angles)[:, None]))
    return slopes
