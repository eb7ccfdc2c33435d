"""Brightness: functions of the direction, checked and made.

Brightness (radiance [W m^-2 sr^-1], luminance [cd m^-2]) depends on the ray's direction alone. This is the
unit vector L = (x, y, z) from a point towards the source, z <= 0 on the viewer's side (Langer and Zucker,
section 4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import real_array
from ..errors import bad

WIDE_POWER, NARROW_POWER = 64, 1e5  # of spots that are wider than 12 degrees, and narrower than 0.4
BRIGHTEST = 1e30  # so that sums stay in float32
# greatest values of functions that are taken as they are, so that squares stay in float32; others are scaled
# by a power of two, which is exact
LEAST_UNIT, MOST_UNIT = 2.0**-40, 2.0**40

BrightnessFunction = Callable[[np.ndarray], np.ndarray]
Brightness = float | tuple[float, float, float] | BrightnessFunction


def uniform(brightness: float = 1.0) -> BrightnessFunction:
    """The same brightness in every direction.

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns the same brightness (...) for all.
    """
    value = brightness_number(brightness)
    return _with_peaks(lambda L: np.full(np.shape(L)[:-1], value))


def cosine_power(
    power: float, axis: Sequence[float] = (0.0, 0.0, 1.0), brightness: float = 1.0
) -> BrightnessFunction:
    """A spotlight: brightness x max(0, -L . axis)^power.

    ``axis``: the direction in which it shines; it need not be a unit vector.

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns their brightness (...) [unit of ``brightness``].
    """
    along = np.array(numbers(axis, 3, "cosine_power: axis", "(x, y, z)"))
    if not along.any():
        raise bad("cosine_power: axis", along.tolist(), "three finite numbers, not all zero")
    if isinstance(power, str) or not (np.isfinite(power) and power >= 0):
        raise bad("cosine_power: power", repr(power), "a finite number >= 0")
    unit, value = along / np.linalg.norm(along), brightness_number(brightness)

    def spot(L: np.ndarray) -> np.ndarray:
        light: np.ndarray = value * np.maximum(0.0, -(np.asarray(L) @ unit)) ** power
        return light

    return (
        _with_peaks(spot)
        if power <= WIDE_POWER
        else spot
        if power <= NARROW_POWER
        else _with_peaks(spot, -unit)
    )


def cie_overcast(zenith: float = 1.0) -> BrightnessFunction:
    """CIE standard overcast sky: zenith x (1 + 2 sin(elevation)) / 3 (ISO 15469, Moon and Spencer 1942).

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns their brightness (...) [unit of ``zenith``].
    """
    value = brightness_number(zenith)
    return _with_peaks(lambda L: value * (1.0 - 2.0 * np.asarray(L)[..., 2]) / 3.0)


def _with_peaks(function: BrightnessFunction, *peaks: np.ndarray) -> BrightnessFunction:
    """``function`` with the attribute ``peaks``, the directions of all its features narrower than a degree.

    Integration searches for no others.
    """
    vars(function)["peaks"] = peaks
    return function


def environment_map(array: Any) -> BrightnessFunction:
    """Brightness from an equirectangular map, interpolated bilinearly between pixel centres.

    ``array``: (rows, cols), or RGB (rows, cols, 3). Row 0 is the zenith, the last row the nadir; column 0 is
    towards +x, and azimuth grows towards +y.

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns brightness (...), or (..., 3) in colour [unit of ``array``].
    """
    image = real_array(array, "environment_map", None)
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] != 3):
        raise bad("environment_map: wrong shape", image.shape, "2 axes (rows, cols), or RGB (rows, cols, 3)")
    if not np.isfinite(image).all() or image.min() < 0:
        raise bad(
            "environment_map: values",
            f"{np.nanmin(image)} to {np.nanmax(image)}, finite: {np.isfinite(image).all()}",
            "finite, >= 0",
        )
    rows, cols = image.shape[:2]
    pixels = np.pad(image, ((0, 0), (0, 1), *((0, 0),) * (image.ndim - 2)), mode="wrap").reshape(
        rows * (cols + 1), *image.shape[2:]
    )

    def brightness(L: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(np.asarray(L, float), -1, 0)
        row = np.arccos(np.clip(-z, -1, 1)) / np.pi * rows - 0.5
        col = np.arctan2(y, x) / (2 * np.pi) * cols - 0.5
        r, c = np.floor(row), np.floor(col)
        fr, fc = (w.reshape(w.shape + (1,) * (image.ndim - 2)) for w in (row - r, col - c))
        left = np.where(c < 0, c + cols, c).astype(int)
        high, low = (np.clip(r + s, 0, rows - 1).astype(int) * (cols + 1) + left for s in (0, 1))
        light: np.ndarray = (1 - fr) * ((1 - fc) * pixels[high] + fc * pixels[high + 1]) + fr * (
            (1 - fc) * pixels[low] + fc * pixels[low + 1]
        )
        return light

    vars(brightness).update(pixels=(rows, cols), image=image)
    return brightness


@dataclass(frozen=True)
class Channel:
    """One channel of an RGB brightness function."""

    function: BrightnessFunction
    number: int

    @property
    def image(self) -> np.ndarray | None:
        """One channel of an environment map."""
        image: np.ndarray | None = getattr(self.function, "image", None)
        return None if image is None else image[..., self.number]

    @property
    def peaks(self) -> Any:
        return getattr(self.function, "peaks", None)

    def __call__(self, directions: np.ndarray) -> np.ndarray:
        values = np.asarray(self.function(directions))
        if values.shape != directions.shape:
            raise bad(
                "brightness function: wrong result",
                f"shape {values.shape} for directions {directions.shape}",
                f"RGB of shape {directions.shape}, as before",
            )
        return values[..., self.number]


@dataclass(frozen=True)
class Scaled:
    """A brightness function times a number."""

    function: BrightnessFunction
    factor: float

    def __getattr__(self, name: str) -> Any:
        """What integration knows of some functions; absent where the function lacks it."""
        if name not in ("image", "peaks", "pixels"):
            raise AttributeError(name)
        value: Any = getattr(self.function, name)
        return value * self.factor if name == "image" and value is not None else value

    def __call__(self, directions: np.ndarray) -> np.ndarray:
        return np.asarray(self.function(directions)) * self.factor


def directions_of(azimuth: Any, sine: Any) -> np.ndarray:
    """Unit vectors (..., 3) of azimuths [rad] and sines of elevation, which broadcast."""
    azimuth, sine = np.asarray(azimuth, float), np.asarray(sine, float)
    cosine = np.sqrt(np.maximum(0.0, 1 - sine**2))
    found = np.empty((*np.broadcast_shapes(azimuth.shape, sine.shape), 3))
    found[..., 0], found[..., 1], found[..., 2] = cosine * np.cos(azimuth), cosine * np.sin(azimuth), -sine
    return found


def brightness_number(value: Any) -> float:
    """A grey brightness, checked."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise bad(
            "brightness",
            repr(value),
            "a number, RGB as three numbers, or a function of unit vectors (..., 3) -> (...)",
        ) from None
    if not 0 <= number <= BRIGHTEST:
        raise bad("brightness", number, f"finite, >= 0, at most {BRIGHTEST:g}")
    return number


def checked(value: Any) -> Any:
    """A number, three numbers or a function, checked."""
    if callable(value):
        return value
    if np.ndim(value) == 1 and np.size(value) == 3:
        return tuple(map(brightness_number, value))
    brightness_number(value)
    return value


def numbers(values: Any, count: int, what: str, form: str) -> tuple[float, ...]:
    """``count`` finite numbers, checked; ``what`` and ``form`` are for the error."""
    allowed = f"{('one', 'two', 'three')[count - 1]} finite number{'s' * (count > 1)} {form}"
    try:
        found = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        raise bad(what, repr(values), allowed) from None
    if len(found) != count or not np.isfinite(found).all():
        raise bad(what, found, allowed)
    return found
