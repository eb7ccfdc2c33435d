"""checks(): every backend against closed forms, brute force and itself. selftest(): against every other."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any, TypeVar

import numpy as np

from .. import io, oracle
from ..backends import backends, select
from ..directions import Hemicube
from ..errors import SkylampError
from ..horizon import horizons, sky_view_factor
from ..inverse.recover import recover
from ..light.far import Tiling
from ..rendering import render
from ..scene import Scene
from ..sources import Lamp, Sky, Source
from ..sources.brightness import cosine_power
from ..sources.cie import cie_clear
from ..visibility import visibility

TEST_AREA = slice(120, 168), slice(150, 214)  # of the sample terrain: 48 x 64 nodes
Result = TypeVar("Result")
STEEPER = 3.0  # heights are multiplied by this, so that a good part of the ground is in shadow


@dataclass(frozen=True)
class Case:
    """One quantity: its name, how a backend computes it, and the difference allowed (0: equal bytes)."""

    name: str
    make: Callable[[str], np.ndarray]
    allowed: float


@dataclass(frozen=True)
class Comparison:
    """Two backends on one case, with their largest difference or the error of the one that failed.

    The difference is relative to the case's largest value; for bits it is the share of words that differ.
    """

    case: str
    one: str
    other: str
    difference: float | None
    allowed: float
    error: str = ""

    @property
    def passed(self) -> bool:
        return self.difference is not None and self.difference <= self.allowed  # NaN does not pass


@dataclass(frozen=True)
class Check:
    """One check of one backend: its figure, and the bound that it must keep; or the error that it met."""

    name: str
    backend: str
    figure: float | None
    bound: float
    error: str = ""

    @property
    def passed(self) -> bool:
        return self.figure is not None and self.figure <= self.bound  # NaN does not pass


# the check, the function of its figure on a backend, and its bound: three to ten times measured figures, but
# for bits
CHECKS: dict[str, tuple[Callable[[str], float], float]] = {}


def _check(name: str, bound: float) -> Callable[[Callable[[str], float]], Callable[[str], float]]:
    def kept(made: Callable[[str], float]) -> Callable[[str], float]:
        CHECKS[name] = made, bound
        return made

    return kept


def _waves(size: int) -> np.ndarray:
    """Depth (size, size): two waves of height 2, 16 nodes long, and back at the border."""
    wave = np.cos(np.pi / 8 * np.arange(size))
    depth: np.ndarray = 2 + 2 * wave[:, None] * wave
    return depth


def _direct(scene: Scene, source: Source, backend: str, **options: Any) -> np.ndarray:
    made = render(scene, source, backend=backend, quantity="irradiance", interreflection=False, **options)
    image: np.ndarray = made.image
    return image.astype(float)


@_check("plane under a sky, closed form", 1e-5)
def _plane(backend: str) -> float:
    """pi (1 + cos a) / 2 of a plane of slope 1/2."""
    scene = Scene(0.5 * np.arange(24.0) * np.ones((24, 1)))
    image = _direct(scene, Sky(), backend, method="horizon", azimuths=32)
    return float(abs(image / (np.pi * (1 + 1 / np.sqrt(1.25)) / 2) - 1).max())


@_check("floor of a trench, closed form", 0.002)
def _trench(backend: str) -> float:
    """The sky-view factor is the sine of the angle between the zenith and the walls' edges."""
    wall = np.where(abs(np.arange(48) - 24) < 8, 6.0, 0.0)  # 6 deep, edges 8 from the middle
    factor = sky_view_factor(Scene(wall * np.ones((8, 1)), sides="periodic"), azimuths=64, backend=backend)
    return float(abs(factor[:, 24] - 8 / np.hypot(8, 6)).max())


@_check("ball above level ground, closed form", 1e-4)
def _ball(backend: str) -> float:
    """pi (radius / distance)^2 cos."""
    y, x = np.indices((24, 24))
    image = _direct(Scene(np.zeros(x.shape)), Lamp((12, 12, -40), 4), backend, method="horizon")
    away = (x - 12) ** 2 + (y - 12) ** 2 + 40**2
    return float(abs(image / (np.pi * 4**2 * 40 / away**1.5) - 1).max())


@_check("visibility bits, brute force", 0.0)
def _bits(backend: str) -> float:
    """The share of directions that differ from a test of every crossing with a grid line."""
    depth, cube = np.rint(np.random.default_rng(0).random((13, 18)) * 16) / 4, Hemicube(5)
    bits = visibility(Scene(depth, sides="periodic"), Sky(), cube, backend, filled=True)
    return float(np.mean(cube.unpack(bits) != oracle.filled_visibility(depth, 1.0, cube.steps, "periodic")))


@_check("white furnace", 0.001)
def _furnace(backend: str) -> float:
    """White ground under a white sky is white everywhere."""
    scene = Scene(_waves(32), albedo=1.0, sides="periodic")
    image = render(scene, Sky(), backend=backend, tolerance=0.01, interreflection=True).image
    return float(abs(np.asarray(image) - 1).max())


@_check("seam of tiles", 0.05)
def _seam(backend: str) -> float:
    """Sky-view factors in tiles of 16 with 8 nodes around them, far ground in blocks; and of the whole."""
    scene = Scene(_waves(32))
    whole = sky_view_factor(scene, azimuths=16, backend=backend)
    return float(abs(_in_tiles(scene, backend) - whole).max())


@_check("depth from an image [nodes, RMS]", 0.1)
def _recovered(backend: str) -> float:
    depth = 1 + _waves(8)
    image = render(
        Scene(depth, sides="dark"), Sky(), backend=backend, tolerance=0.01, interreflection=False
    ).image
    recovered = recover(image, Sky(), 0.8, "dark", layers=8, interreflection=False, backend=backend)
    return float(np.sqrt(np.mean((recovered.depth - depth) ** 2)))


@_check("no light below 0 [share of the mean]", 0.0)
def _dark(backend: str) -> float:
    """In a deep box with dark sides under a narrow beam, in few azimuths."""
    box = Scene(np.random.default_rng(1).random((6, 7)) * 30, sides="dark")
    image = _direct(box, Sky(cosine_power(12, (0.9, 0.2, 0.4))), backend, method="horizon", azimuths=8)
    return float(max(0.0, -image.min() / image.mean()))


def checks(progress: Callable[[int, int], None] | None = None) -> list[Check]:
    """Every check on every available backend. A backend that raises fails that check."""
    names = [info.name for info in backends() if info.available]
    results: list[Check] = []
    for name in names:
        for what, (made, bound) in CHECKS.items():
            figure, failure = _attempted(made, name)
            results.append(Check(what, name, figure, bound, failure))
            if progress:
                progress(len(results), len(names) * len(CHECKS))
    return results


def _attempted(made: Callable[[str], Result], name: str) -> tuple[Result | None, str]:
    """(what a backend gives, ""), or (None, its error)."""
    try:
        return made(select(name).name), ""
    except (SkylampError, RuntimeError, MemoryError) as error:
        return None, f"{name}: {' '.join(str(error).split())}"


def cases() -> list[Case]:
    """One of each kind of kernel: visibility, lattice, horizons, skies, slices, light between surfaces."""
    height, spacing = io.terrain()
    scene = Scene.from_height(STEEPER * height[TEST_AREA], spacing)
    box = Scene.from_height(STEEPER * height[TEST_AREA], spacing, sides="dark")
    x, y = (spacing * (n // 2) for n in scene.shape[::-1])
    lamp = Lamp(center=(x, y, -8 * spacing), radius=3 * spacing)
    clear = Sky(cie_clear((135.0, 35.0)))
    bits = partial(visibility, scene, Sky())
    bits_filled = partial(visibility, box, lamp, filled=True)
    return [
        Case("visibility bits", lambda name: bits(backend=name), 0.0),
        Case("visibility bits, filled, lamp", lambda name: bits_filled(backend=name), 0.0),
        Case("sky, lattice", _irradiance(scene, Sky(), method="lattice"), 1e-5),
        Case("horizons", lambda name: horizons(scene, azimuths=16, backend=name), 1e-5),
        Case("sky-view factor in tiles", partial(_in_tiles, scene), 1e-5),
        Case("clear sky, horizons", _irradiance(box, clear, azimuths=32), 1e-5),
        Case("lamp, slices", _irradiance(scene, lamp, method="horizon"), 1e-5),
        Case("light between surfaces", _irradiance(scene, Sky(), azimuths=16, interreflection=True), 1e-5),
    ]


def _irradiance(scene: Scene, source: Source, **options: Any) -> Callable[[str], np.ndarray]:
    return lambda name: render(scene, source, backend=name, quantity="irradiance", **options).image


def _in_tiles(scene: Scene, backend: str) -> np.ndarray:
    """Sky-view factors in tiles of 16 nodes, without the warning of what far ground adds to their error."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Tiles:")
        tiling = Tiling(tile=16, halo=8, rule=4)
        return sky_view_factor(scene, azimuths=16, backend=backend, tiling=tiling)


def selftest(progress: Callable[[int, int], None] | None = None) -> list[Comparison]:
    """Every pair of available backends on every case. A backend that raises fails all of its pairs."""
    names = [info.name for info in backends() if info.available]
    compared = []
    todo = cases()
    for done, case in enumerate(todo):
        made = {name: _attempted(case.make, name) for name in names}
        for one, other in combinations(names, 2):
            (a, failure), (b, other_failure) = made[one], made[other]
            apart = None if a is None or b is None else difference(a, b)
            compared.append(Comparison(case.name, one, other, apart, case.allowed, failure or other_failure))
        if progress:
            progress(done + 1, len(todo))
    return compared


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """The share of words that differ, or the largest difference over the largest value.

    Infinite where only one is finite, or where types differ.
    """
    if one.dtype != other.dtype or one.shape != other.shape:
        return float("inf")
    if one.dtype.kind == "u":
        return float(np.mean(one != other))
    known = np.isfinite(one)
    if not np.array_equal(one[~known], other[~known], equal_nan=True) or not known.any():
        return float("inf")
    return float(
        np.abs(one[known].astype(float) - other[known]).max()
        / max(np.abs(one[known]).max(), np.abs(other[known]).max(), 1e-30)
    )
