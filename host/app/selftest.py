"""selftest(): every backend on this machine compared with every other, on built-in cases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from .. import io
from ..backends import backends, select
from ..errors import SkylampError
from ..horizon import horizons, sky_view_factor
from ..light.far import Tiling
from ..rendering import render
from ..scene import Scene
from ..sources import Lamp, Sky, Source
from ..sources.cie import cie_clear
from ..visibility import visibility

TEST_AREA = slice(120, 168), slice(150, 214)  # of the sample terrain: 48 x 64 nodes
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
        Case("sky-view factor in tiles", _in_tiles(scene), 1e-5),
        Case("clear sky, horizons", _irradiance(box, clear, azimuths=32), 1e-5),
        Case("lamp, slices", _irradiance(scene, lamp, method="horizon"), 1e-5),
        Case("light between surfaces", _irradiance(scene, Sky(), azimuths=16, interreflection=True), 1e-5),
    ]


def _irradiance(scene: Scene, source: Source, **options: Any) -> Callable[[str], np.ndarray]:
    return lambda name: render(scene, source, backend=name, quantity="irradiance", **options).image


def _in_tiles(scene: Scene) -> Callable[[str], np.ndarray]:
    tiling = Tiling(tile=16, halo=8, rule=4)
    return lambda name: sky_view_factor(scene, azimuths=16, backend=name, tiling=tiling)


def selftest(progress: Callable[[int, int], None] | None = None) -> list[Comparison]:
    """Every pair of available backends on every case. A backend that raises fails all of its pairs."""
    names = [info.name for info in backends() if info.available]
    compared = []
    todo = cases()
    for done, case in enumerate(todo):
        found: dict[str, np.ndarray] = {}
        failed: dict[str, str] = {}
        for name in names:
            try:
                found[name] = case.make(select(name).name)
            except (SkylampError, RuntimeError, MemoryError) as error:
                failed[name] = f"{name}: {' '.join(str(error).split())}"
        for one, other in combinations(names, 2):
            failure = failed.get(one) or failed.get(other) or ""
            compared.append(
                Comparison(
                    case.name,
                    one,
                    other,
                    None if failure else difference(found[one], found[other]),
                    case.allowed,
                    failure,
                )
            )
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
