"""Brightness: functions of the direction, checked and made.

Brightness (radiance [W m^-2 sr^-1], luminance [cd m^-2]) depends on the ray's direction alone. This is the
unit vector L = (x, y, z) from a point towards the source, z <= 0 on the viewer's side (Langer and Zucker,
section 4).
"""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..arrays import host_array
from ..checks import number_or_nan, real_array
from ..errors import bad

WIDE_POWER, NARROW_POWER = 64, 1e5  # of spots that are wider than 12 degrees, and narrower than 0.4
# of a spot, 0.03 degrees wide. Measured: level ground straight below one of 1e6, 1e8, 1e9 and 1e11 has
# 1.0016, 1.008, 1.03 and 1.7 times its light
MOST_POWER = 1e7
BRIGHTEST = 1e30  # so that sums stay in float32
# greatest values of functions that are taken as they are, so that squares stay in float32; others are scaled
# by a power of two, which is exact
LEAST_UNIT, MOST_UNIT = 2.0**-40, 2.0**40

BrightnessFunction = Callable[[np.ndarray], np.ndarray]
Brightness = float | tuple[float, float, float] | BrightnessFunction
Directions = tuple[tuple[float, ...], ...]  # unit vectors (x, y, z)


class Disc(NamedTuple):
    """A sun's disc of uniform brightness."""

    direction: tuple[float, ...]  # unit vector (x, y, z) towards it
    irradiance: float  # of a surface that faces it [brightness x sr]
    radius: float  # [rad]

    @property
    def brightness(self) -> float:
        """B of irradiance = pi B sin^2(radius)."""
        return float(self.irradiance / (np.pi * np.sin(self.radius) ** 2))

    def points(self, count: int) -> np.ndarray:
        """Unit vectors (count, 3) spread evenly over the disc, along a spiral; its middle if it is one."""
        axis, place = np.array(self.direction), np.arange(count) + 0.5
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        across /= np.linalg.norm(across)
        out = math.sin(self.radius) * np.sqrt(place / count) * (count > 1)
        turn = np.pi * (1 + math.sqrt(5)) * place  # the golden angle
        sides = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * np.cross(axis, across)
        points: np.ndarray = np.sqrt(1 - out**2)[:, None] * axis + out[:, None] * sides
        return points


class Held(NamedTuple):
    """An object that brightness comes from; what of it that is; whether the object's values never change."""

    owner: Any
    part: tuple[Any, ...] = ()
    lasts: bool = True

    def of(self, *part: Any) -> Held:
        """A brightness that is made of this one."""
        return self._replace(part=(*self.part, *part))


class Distribution(ABC):
    """A brightness function with its properties that samples in some directions do not show.

    Code that integrates, scales or refuses a brightness uses these methods and no other attribute;
    :func:`distribution` makes one of any function. A disc is not part of the values.
    """

    @abstractmethod
    def __call__(self, L: np.ndarray) -> np.ndarray:
        """Brightness (...), or RGB (..., 3), along unit vectors (..., 3)."""

    def by_formula(self) -> bool:
        """Whether objects that are equal always have equal values, so that their tables may be kept.

        It must be hashable then.
        """
        return False

    def held_by(self) -> Held | None:
        """The object that this brightness comes from, with whose life its tables end; None: keep none."""
        return None

    def narrow(self) -> Directions | None:
        """Directions of all features narrower than a degree, () if there are none; None if not known.

        Where they are known, tables begin with cells of half a degree, else of 0.16 degrees.
        """
        return None

    def equirectangular(self) -> np.ndarray | None:
        """The map (rows, cols), or RGB (rows, cols, 3), of which the values are interpolated, if any."""
        return None

    def disc(self) -> Disc | None:
        """The sun's disc that ``render`` adds, if any."""
        return None

    def without_disc(self) -> Distribution:
        """The same function without a disc."""
        return self

    def scaled(self, factor: float) -> Distribution:
        """The same, ``factor`` times as bright. One with a disc overrides this: ``Scaled`` has none."""
        return Scaled(self, factor)


@dataclass(frozen=True)
class Function(Distribution):
    """Any function of directions, with the directions of its narrow features where they are known."""

    function: BrightnessFunction
    peaks: Directions | None = None

    def held_by(self) -> Held | None:
        return Held(self.function, lasts=False)

    def narrow(self) -> Directions | None:
        return self.peaks

    def __call__(self, L: np.ndarray) -> np.ndarray:
        made = self.function(L)
        try:
            return host_array(made)
        except Exception as error:
            raise bad("brightness function: wrong result", str(error), "an array of real numbers") from None


@dataclass(frozen=True)
class Formula(Distribution):
    """A function of directions and numbers alone, both hashable; ``peaks`` as those of :class:`Function`."""

    function: Callable[..., np.ndarray]
    numbers: tuple[Any, ...]
    peaks: Directions | None = None

    def by_formula(self) -> bool:
        return True

    def narrow(self) -> Directions | None:
        return self.peaks

    def __call__(self, L: np.ndarray) -> np.ndarray:
        return self.function(L, *self.numbers)


def distribution(function: BrightnessFunction) -> Distribution:
    """``function`` itself if it is a ``Distribution``, else with the directions of its ``peaks``."""
    if isinstance(function, Distribution):
        return function
    peaks = getattr(function, "peaks", None)
    return Function(function, None if peaks is None else tuple(tuple(map(float, peak)) for peak in peaks))


def uniform(brightness: float = 1.0) -> BrightnessFunction:
    """The same brightness in every direction.

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns the same brightness (...) for all.

    Examples
    --------
    >>> sl.uniform(0.5)(np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8]]))
    array([0.5, 0.5])
    """
    return Formula(_uniform, (brightness_number(brightness),), ())


def _uniform(L: np.ndarray, brightness: float) -> np.ndarray:
    return np.full(np.shape(L)[:-1], brightness)


def cosine_power(
    power: float, axis: Sequence[float] = (0.0, 0.0, 1.0), brightness: float = 1.0
) -> BrightnessFunction:
    """A spotlight: brightness x max(0, -L . axis)^power.

    ``power``: 0 to 1e7, of a spot 0.03 degrees wide. ``axis``: the direction in which it shines; it need not
    be a unit vector. Raises InputError.

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns their brightness (...) [unit of ``brightness``].

    Examples
    --------
    >>> spot = sl.Lamp(center=(8, 8, -20), radius=1, brightness=sl.cosine_power(60, axis=(0.2, 0, 1)))
    >>> image = sl.render(sl.Scene(np.zeros((17, 17))), spot).image
    >>> bool(image[8, 12] > image[8, 0])
    True
    """
    along = np.array(numbers(axis, 3, "cosine_power: axis", "(x, y, z)"))
    if not along.any():
        raise bad("cosine_power: axis", along.tolist(), "three finite numbers, not all zero")
    if isinstance(power, str) or not 0 <= number_or_nan(power) <= MOST_POWER:
        raise bad("cosine_power: power", repr(power), f"a finite number >= 0, at most {MOST_POWER:g}")
    if not 1e-100 < (largest := np.abs(along).max()) < 1e100:  # whose squares are no numbers
        along = along / largest
    unit, value = along / np.linalg.norm(along), brightness_number(brightness)
    peaks = () if power <= WIDE_POWER else None if power <= NARROW_POWER else (tuple((-unit).tolist()),)
    return Formula(_spot, (float(power), tuple(unit.tolist()), value), peaks)


def _spot(L: np.ndarray, power: float, axis: tuple[float, ...], brightness: float) -> np.ndarray:
    light: np.ndarray = brightness * np.maximum(0.0, -(np.asarray(L) @ np.array(axis))) ** power
    return light


def cie_overcast(zenith: float = 1.0) -> BrightnessFunction:
    """CIE standard overcast sky: zenith x (1 + 2 sin(elevation)) / 3 (ISO 15469, Moon and Spencer 1942).

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns their brightness (...) [unit of ``zenith``].

    Examples
    --------
    >>> sl.cie_overcast(3.0)(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    array([3., 1.])
    """
    return Formula(_overcast, (brightness_number(zenith),), ())


def _overcast(L: np.ndarray, zenith: float) -> np.ndarray:
    light: np.ndarray = zenith * np.maximum(0.0, 1.0 - 2.0 * np.asarray(L)[..., 2]) / 3.0
    return light


def environment_map(array: Any) -> BrightnessFunction:
    """Brightness from an equirectangular map, interpolated bilinearly between pixel centres.

    ``array``: (rows, cols), or RGB (rows, cols, 3). The upper edge of row 0 is the zenith, the lower edge of
    the last row the nadir; the left edge of column 0 is towards +x, and azimuth grows towards +y.

    Returns
    -------
    function
        Of unit vectors (..., 3); it returns brightness (...), or (..., 3) in colour [unit of ``array``].

    Examples
    --------
    >>> east = np.zeros((32, 64))
    >>> east[14:18, [0, -1]] = 100  # light from +x, near the level
    >>> sky = sl.Sky(sl.environment_map(east))
    >>> slope = sl.Scene(5 + 0.5 * np.mgrid[:8, :8][1])  # deeper with x: it looks there
    >>> bool(sl.render(slope, sky).image.min() > sl.render(sl.Scene(np.zeros((8, 8))), sky).image.max())
    True
    """
    image = real_array(array, "environment_map", None)
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] != 3):
        raise bad("environment_map: wrong shape", image.shape, "2 axes (rows, cols), or RGB (rows, cols, 3)")
    if not (image.min() >= 0 and image.max() <= BRIGHTEST):
        raise bad(
            "environment_map: values",
            f"{image.min()} to {image.max()}, finite: {np.isfinite(image).all()}",
            f"finite, >= 0, at most {BRIGHTEST:g}",
        )
    return EnvironmentMap(image)


@dataclass(frozen=True, eq=False)
class EnvironmentMap(Distribution):
    """A brightness function, made by :func:`environment_map`: (..., 3) unit vectors -> (...) or (..., 3)."""

    image: np.ndarray

    def __post_init__(self) -> None:
        self.image.flags.writeable = False

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.image.flags.writeable = False

    def held_by(self) -> Held | None:
        return Held(self)

    def equirectangular(self) -> np.ndarray:
        return self.image

    @cached_property
    def _pixels(self) -> np.ndarray:
        """The map, its first column once more behind the last, (rows x (cols + 1), ...)."""
        image = self.image
        around = np.pad(image, ((0, 0), (0, 1), *((0, 0),) * (image.ndim - 2)), mode="wrap")
        return around.reshape(-1, *image.shape[2:])

    def __call__(self, L: np.ndarray) -> np.ndarray:
        image, pixels = self.image, self._pixels
        rows, cols = image.shape[:2]
        x, y, z = np.moveaxis(np.asarray(L, float), -1, 0)
        row = np.arccos(np.clip(-z, -1, 1)) / np.pi * rows - 0.5
        col = np.arctan2(y + 0.0, x + 0.0) / (2 * np.pi) * cols - 0.5  # of -0.0 too, in the zenith
        r, c = np.floor(row), np.floor(col)
        fr, fc = (w.reshape(w.shape + (1,) * (image.ndim - 2)) for w in (row - r, col - c))
        left = np.where(c < 0, c + cols, c).astype(int)
        high, low = (np.clip(r + s, 0, rows - 1).astype(int) * (cols + 1) + left for s in (0, 1))
        upper, lower = ((1 - fc) * pixels[at] + fc * pixels[at + 1] for at in (high, low))
        light: np.ndarray = (1 - fr) * upper + fr * lower
        return light


@dataclass(frozen=True)
class _Derived(Distribution):
    """A brightness function made of another one and of the fields of the class."""

    function: Distribution

    def held_by(self) -> Held | None:
        held = self.function.held_by()
        return held and held.of(type(self), *(getattr(self, field.name) for field in fields(self)[1:]))

    def narrow(self) -> Directions | None:
        return self.function.narrow()


@dataclass(frozen=True)
class Channel(_Derived):
    """One channel of an RGB brightness function."""

    number: int

    def equirectangular(self) -> np.ndarray | None:
        image = self.function.equirectangular()
        return None if image is None else image[..., self.number]

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
class Scaled(_Derived):
    """A brightness function times a number."""

    factor: float

    def equirectangular(self) -> np.ndarray | None:
        image = self.function.equirectangular()
        return None if image is None else image * self.factor

    def __call__(self, directions: np.ndarray) -> np.ndarray:
        return np.asarray(self.function(directions)) * self.factor


@dataclass(frozen=True)
class Mirrored(_Derived):
    """A brightness function in the axes of a map whose columns or rows run the other way.

    ``axes``: 1 or -1 that x and y of a direction are multiplied by.
    """

    axes: tuple[float, float]

    def by_formula(self) -> bool:
        return self.function.by_formula()

    def _turned(self, L: Any) -> np.ndarray:
        return np.asarray(L, float) * (*self.axes, 1.0)

    def narrow(self) -> Directions | None:
        narrow = self.function.narrow()
        return None if narrow is None else tuple(tuple(self._turned(L).tolist()) for L in narrow)

    def equirectangular(self) -> np.ndarray | None:
        """None where no column of the map is the mirror of another: x turned, of an odd number."""
        image, (x, y) = self.function.equirectangular(), self.axes
        if image is None or x < 0 and image.shape[1] % 2:
            return None
        image = image if x * y > 0 else image[:, ::-1]
        return np.roll(image, image.shape[1] // 2, 1) if x < 0 else image

    def disc(self) -> Disc | None:
        disc = self.function.disc()
        return None if disc is None else disc._replace(direction=tuple(self._turned(disc.direction).tolist()))

    def without_disc(self) -> Distribution:
        return Mirrored(self.function.without_disc(), self.axes)

    def __call__(self, L: np.ndarray) -> np.ndarray:
        return self.function(self._turned(L))


def directions_of(azimuth: Any, sine: Any) -> np.ndarray:
    """Unit vectors (..., 3) of azimuths [rad] and sines of elevation, which broadcast."""
    azimuth, sine = np.asarray(azimuth, float), np.asarray(sine, float)
    cosine = np.sqrt(np.maximum(0.0, 1 - sine**2))
    directions = np.empty((*np.broadcast_shapes(azimuth.shape, sine.shape), 3))
    directions[..., 0], directions[..., 1] = cosine * np.cos(azimuth), cosine * np.sin(azimuth)
    directions[..., 2] = -sine
    return directions


def brightness_number(value: Any, name: str = "brightness") -> float:
    """A grey brightness or irradiance, checked; ``name``: of the argument."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise bad(
            name,
            repr(value),
            "a number, RGB as three numbers, or a function of unit vectors (..., 3) -> (...)",
        ) from None
    if not 0 <= number <= BRIGHTEST:
        raise bad(name, number, f"finite, >= 0, at most {BRIGHTEST:g}")
    return number


def checked(value: Any) -> Any:
    """A number, three numbers or a function, checked."""
    if callable(value):
        name = getattr(value, "__qualname__", "")
        if (
            inspect.isfunction(value)
            and str(value.__module__).startswith(__package__)
            and "<locals>" not in name
        ):
            # a function of this package returns a brightness, and is none
            raise bad("brightness", f"the function {name} itself", "what it returns", f"Call it: {name}().")
        return value
    try:
        is_colour = np.shape(value) == (3,)
    except ValueError:  # a ragged list
        is_colour = False
    if is_colour:
        return tuple(map(brightness_number, value))
    brightness_number(value)
    return value


def numbers(values: Any, count: int, what: str, form: str) -> tuple[float, ...]:
    """``count`` finite numbers, checked; ``what`` and ``form`` are for the error."""
    allowed = f"{('one', 'two', 'three')[count - 1]} finite number{'s' * (count > 1)} {form}"
    try:
        checked = tuple(float(v) for v in values)
    except (TypeError, ValueError, OverflowError, NotImplementedError):
        raise bad(what, repr(values), allowed) from None
    if len(checked) != count or not np.isfinite(checked).all():
        raise bad(what, checked, allowed)
    return checked
