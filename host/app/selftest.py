"""selftest(): every backend on this machine beside every other, on one built-in case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..backends import backends, select
from ..errors import SkylampError
from ..horizon import horizons
from ..io import files as io
from ..rendering import render
from ..scene import Scene
from ..sources.cie import cie_clear
from ..sources.shapes import Lamp, Sky
from ..visibility import visibility

CROP = slice(120, 168), slice(150, 214)  # of the sample terrain: 48 x 64 nodes
STEEPER = 3.0  # heights are multiplied by this, so that a good part of the ground is in shadow


@dataclass(frozen=True)
class Case:
    """One quantity: what it is, how a backend makes it, and how far two backends may be apart (0: equal
    bytes).
    """

    name: str
    make: Callable[[str], np.ndarray]
    allowed: float


@dataclass(frozen=True)
class Comparison:
    """Two backends on one case: the largest difference, relative to the case's largest value (for bits, the
    share of words that differ), or the error of the one that failed.
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
    """Visibility bits, irradiance by the lattice and by horizons, horizons, and a lamp; one of each kind of
    kernel.
    """
    height, spacing = io.terrain()
    scene = Scene.from_height(STEEPER * height[CROP], spacing)
    box = Scene.from_height(STEEPER * height[CROP], spacing, sides="dark")
    x, y = (spacing * (n // 2) for n in scene.shape[::-1])
    lamp = Lamp(center=(x, y, -8 * spacing), radius=3 * spacing)
    clear = Sky(cie_clear((135.0, 35.0)))
    light = lambda *what, **how: lambda name: render(*what, backend=name, quantity="irradiance", **how).image
    return [
        Case("visibility bits", lambda name: visibility(scene, Sky(), backend=name), 0.0),
        Case(
            "visibility bits, filled, lamp",
            lambda name: visibility(box, lamp, backend=name, filled=True),
            0.0,
        ),
        Case("sky, lattice", light(scene, Sky(), method="lattice"), 1e-5),
        Case("horizons", lambda name: horizons(scene, azimuths=16, backend=name), 1e-5),
        Case("clear sky, horizons", light(box, clear, azimuths=32), 1e-5),
        Case("lamp, slices", light(scene, lamp, method="horizon"), 1e-5),
    ]


def selftest(progress: Callable[[int, int], None] | None = None) -> list[Comparison]:
    """Every pair of available backends on every case. A backend that raises does not pass any of its pairs."""
    names = [info.name for info in backends() if info.available]
    compared = []
    every = cases()
    for done, case in enumerate(every):
        found, failed = {}, {}
        for name in names:
            try:
                found[name] = case.make(select(name).name)
            except (SkylampError, RuntimeError, MemoryError) as error:
                failed[name] = f"{name}: {' '.join(str(error).split())}"
        for one, other in combinations(names, 2):
            error = failed.get(one) or failed.get(other) or ""
            compared.append(
                Comparison(
                    case.name,
                    one,
                    other,
                    None if error else difference(found[one], found[other]),
                    case.allowed,
                    error,
                )
            )
        if progress:
            progress(done + 1, len(every))
    return compared


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """The share of words that differ, or the largest difference over the largest value; infinite where only
    one is finite, or types differ.
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
