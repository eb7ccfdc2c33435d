"""Sources: sky (converging), lamp and window (diverging), and the brightness that their rays carry.

Brightness (radiance [W m^-2 sr^-1], luminance [cd m^-2]) depends on the ray's direction alone: the unit
vector L = (x, y, z) from a point towards the source, z <= 0 on the viewer's side (Langer and Zucker, section
4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..arrays import host_array
from ..checks import real_array
from ..constants import APERTURE, BALL, RECTANGLE, SKY, VOLUME
from ..errors import InputError, bad

WIDE_POWER, NARROW_POWER = 64, 1e5  # of spots that are wider than 12 degrees, and narrower than 0.4
BRIGHTEST = 1e30  # so that sums stay in float32

Brightness = float | tuple[float, float, float] | Callable[[np.ndarray], np.ndarray]


def uniform(brightness: float = 1.0) -> Callable:
    """The same brightness in every direction."""
    value = _brightness_number(brightness)
    return _named(lambda L: np.full(np.shape(L)[:-1], value))


def cosine_power(power: float, axis=(0.0, 0.0, 1.0), brightness: float = 1.0) -> Callable:
    """A spotlight: brightness x max(0, -L . axis)^power, ``axis`` the direction in which it shines (need not
    be unit).
    """
    axis = np.array(_numbers(axis, 3, "cosine_power: axis", "(x, y, z)"))
    if not axis.any():
        raise bad("cosine_power: axis", axis.tolist(), "three finite numbers, not all zero")
    if isinstance(power, str) or not (np.isfinite(power) and power >= 0):
        raise bad("cosine_power: power", repr(power), "a finite number >= 0")
    axis, value = axis / np.linalg.norm(axis), _brightness_number(brightness)
    spot = lambda L: value * np.maximum(0.0, -(np.asarray(L) @ axis)) ** power
    return _named(spot) if power <= WIDE_POWER else spot if power <= NARROW_POWER else _named(spot, -axis)


def cie_overcast(zenith: float = 1.0) -> Callable:
    """CIE standard overcast sky: zenith x (1 + 2 sin(elevation)) / 3 (ISO 15469, Moon and Spencer 1942)."""
    value = _brightness_number(zenith)
    return _named(lambda L: value * (1.0 - 2.0 * np.asarray(L)[..., 2]) / 3.0)


def _named(function, *peaks):
    """``function`` with the directions of its features that are narrower than a degree: where it is
    integrated, none is looked for elsewhere.
    """
    function.peaks = peaks
    return function


def environment_map(array) -> Callable:
    """Brightness from an equirectangular map (rows, cols) or RGB (rows, cols, 3), interpolated bilinearly
    between pixel centres.

    Row 0 is the zenith, the last row the nadir; column 0 looks towards +x and azimuth grows towards +y.
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

    def brightness(L):
        x, y, z = np.moveaxis(np.asarray(L, float), -1, 0)
        row = np.arccos(np.clip(-z, -1, 1)) / np.pi * rows - 0.5
        col = np.arctan2(y, x) / (2 * np.pi) * cols - 0.5
        r, c = np.floor(row), np.floor(col)
        fr, fc = (w.reshape(w.shape + (1,) * (image.ndim - 2)) for w in (row - r, col - c))
        left = np.where(c < 0, c + cols, c).astype(int)
        high, low = (np.clip(r + s, 0, rows - 1).astype(int) * (cols + 1) + left for s in (0, 1))
        return (1 - fr) * ((1 - fc) * pixels[high] + fc * pixels[high + 1]) + fr * (
            (1 - fc) * pixels[low] + fc * pixels[low + 1]
        )

    brightness.pixels, brightness.image = (rows, cols), image
    return brightness


@dataclass(frozen=True)
class Sky:
    """The sky: rays arrive from every direction of the hemisphere.

    Parameters
    ----------
    brightness : number; RGB as three; or a function of unit vectors (..., 3) to (...), or to RGB (..., 3)
        A function is integrated: whatever is at least 0.2 degrees across is found, wherever it stands, and so
        is all of an environment map. A function may say where its narrow features stand by an attribute
        ``peaks``, as ``suns`` does.
    suns : unit vectors (x, y, z), optional
        Directions towards all features of ``brightness`` that are narrower than a degree. They may then be of
        any size, and none is looked for elsewhere.

    Raises
    ------
    InputError
        For another brightness, or suns that are no vectors towards the viewer's side (z <= 0).

    Examples
    --------
    >>> sky = Sky(lambda L: 1 + 1e7 * (L[..., 2] < -0.9999999), suns=[(0, 0, -1)])
    """

    brightness: Brightness = 1.0
    suns: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "brightness", _brightness(self.brightness))
        try:
            suns = tuple(_numbers(sun, 3, "sky: suns", "(x, y, z)") for sun in self.suns)
        except TypeError:
            raise bad("sky: suns", repr(self.suns), "a sequence of vectors (x, y, z) towards them") from None
        for sun in suns:
            if not sun[2] <= 0 or not any(sun):
                raise bad("sky: suns", sun, "a vector (x, y, z) towards the sun, not zero, with z <= 0")
        object.__setattr__(self, "suns", suns)


@dataclass(frozen=True, eq=False)
class Lamp:
    """A finite emitter near the surface.

    A sphere, ``center`` = (x, y, z) and ``radius`` [unit of spacing], x along columns, y along rows, z depth
    (z < 0: behind the viewer's plane); or a rectangle that shines to both sides, ``corner`` = (x, y, z) and
    ``edges``, two vectors at right angles from it (for method="horizon"); or any shape, ``volume`` (layers,
    rows, cols) bool on the lattice, True where the node (layer, row, col) shines.
    """

    center: tuple[float, float, float] | None = None
    radius: float | None = None
    brightness: Brightness = 1.0
    volume: np.ndarray | None = None
    corner: tuple[float, float, float] | None = None
    edges: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    def __post_init__(self):
        given = [
            name
            for name in ("center", "radius", "volume", "corner", "edges")
            if getattr(self, name) is not None
        ]
        if given not in (["center", "radius"], ["volume"], ["corner", "edges"]):
            raise bad(
                "lamp",
                " and ".join(given) or "no shape",
                "center and radius (a sphere), corner and edges (a rectangle), or volume alone",
            )
        if self.corner is not None:
            object.__setattr__(self, "corner", _numbers(self.corner, 3, "lamp corner", "(x, y, z)"))
            try:
                one, other = self.edges
            except (TypeError, ValueError):
                raise bad("lamp edges", repr(self.edges), "two vectors (x, y, z)") from None
            one, other = (_numbers(edge, 3, "lamp edge", "(x, y, z)") for edge in (one, other))
            lengths = np.linalg.norm(one), np.linalg.norm(other)
            if not min(lengths) > 0 or abs(np.dot(one, other)) > 1e-6 * lengths[0] * lengths[1]:
                raise bad("lamp edges", (one, other), "two vectors that are not zero and at right angles")
            object.__setattr__(self, "edges", (one, other))
        elif self.volume is not None:
            object.__setattr__(self, "volume", _flags(self.volume, "lamp volume", 3, "(layers, rows, cols)"))
        else:
            center = _numbers(self.center, 3, "lamp center", "(x, y, z)")
            radius = _numbers([self.radius], 1, "lamp radius", "> 0")[0]
            if radius <= 0:
                raise bad("lamp radius", radius, "a finite number > 0")
            object.__setattr__(self, "center", center)
            object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "brightness", _brightness(self.brightness))


@dataclass(frozen=True, eq=False)
class Window:
    """An aperture in the plane z = 0: rays through it inherit the brightness of the sky behind it.

    Either a rectangle, ``x`` = (x0, x1) and ``y`` = (y0, y1) [unit of spacing], half-open; or ``aperture``
    (rows, cols) bool, True where node's pixel is open.
    """

    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None
    brightness: Brightness = 1.0
    aperture: np.ndarray | None = None

    def __post_init__(self):
        if (self.aperture is None) == (self.x is None or self.y is None) or (
            self.aperture is not None and (self.x, self.y) != (None, None)
        ):
            raise bad(
                "window",
                f"x={self.x}, y={self.y}, aperture {'given' if self.aperture is not None else 'not given'}",
                "x and y (a rectangle), or aperture alone",
            )
        if self.aperture is not None:
            object.__setattr__(self, "aperture", _flags(self.aperture, "window aperture", 2, "(rows, cols)"))
        else:
            for name in "xy":
                low, high = _numbers(getattr(self, name), 2, f"window {name}", "(low, high)")
                if not low < high:
                    raise bad(f"window {name}", (low, high), "low < high")
                object.__setattr__(self, name, (low, high))
        object.__setattr__(self, "brightness", _brightness(self.brightness))


Source = Sky | Lamp | Window


class Geometry(NamedTuple):
    """Where a source shines from, as backends know it: plain numbers in the unit of the compared depths.

    kind: SKY, RECTANGLE, APERTURE, BALL or VOLUME. numbers (4,) float64: x0, x1, y0, y1 of a rectangle or
    x, y, z, radius of a ball. flags: uint8 aperture (1, rows, cols) or volume (layers, rows, cols).
    """

    kind: int
    numbers: np.ndarray
    flags: np.ndarray

    @property
    def is_lamp(self) -> bool:
        return self.kind in (BALL, VOLUME)


def geometry(source: Source, scene, step: float) -> Geometry:
    """The geometry of ``source`` over ``scene``, lengths scaled so that the spacing is ``step``; checks that
    they fit.
    """
    nothing, numbers = np.zeros((1, 1, 1), np.uint8), np.zeros(4)
    if isinstance(source, Sky):
        return Geometry(SKY, numbers, nothing)
    if isinstance(source, Window):
        if source.aperture is None:
            return Geometry(RECTANGLE, np.array([*source.x, *source.y]) * step / scene.spacing, nothing)
        if source.aperture.shape != scene.shape:
            raise bad("window aperture: wrong shape", source.aperture.shape, f"the scene's {scene.shape}")
        return Geometry(APERTURE, numbers, source.aperture[None].view(np.uint8))
    if not isinstance(source, Lamp):
        raise bad("source", type(source).__name__, "Sky, Lamp or Window")
    if source.volume is not None:
        if source.volume.shape[1:] != scene.shape:
            raise bad(
                "lamp volume: wrong shape",
                source.volume.shape,
                f"(layers, rows, cols) with the scene's rows and cols {scene.shape}",
            )
        free = np.arange(len(source.volume))[:, None, None] <= scene.layers()[0]
        if not (source.volume & free).any():
            raise bad(
                "lamp volume: no node of it lies in free space",
                f"{source.volume.sum()} nodes",
                "at least one True node at or above the surface",
            )
        return Geometry(VOLUME, numbers, (source.volume & free).view(np.uint8))
    if source.corner is not None:
        raise bad(
            "method 'lattice' with a rectangular lamp",
            "a lamp given by corner and edges",
            "a sphere or a volume",
            "Use method='horizon'.",
        )
    if scene.sides == "periodic":
        raise bad(
            "lamp sphere with sides='periodic'",
            "a lamp that stands once over a map that repeats",
            "sides='open' or 'dark', or a lamp given as a volume, which repeats with the map",
        )
    x, y, z = source.center
    col, row = (int(np.floor(v / scene.spacing + 0.5)) for v in (x, y))
    if 0 <= row < scene.shape[0] and 0 <= col < scene.shape[1] and z > scene.depth[row, col]:
        raise bad(
            "lamp below the surface",
            f"center z = {z} at (row, col) = ({row}, {col})",
            f"z <= {scene.depth[row, col]}, the depth of the surface there",
        )
    return Geometry(BALL, np.array([x, y, z, source.radius]) * step / scene.spacing, nothing)


def channels(source: Source) -> list[Source]:
    """The source itself if its brightness is grey, else three grey ones: red, green, blue."""
    brightness = source.brightness
    if isinstance(brightness, tuple):
        return [replace(source, brightness=value) for value in brightness]
    if not callable(brightness):
        return [source]
    probe = directions_of(np.array([0.3, 2.0]), np.array([0.2, 0.9]))
    if np.shape(brightness(probe.copy())) != (2, 3):
        return [source]
    return [replace(source, brightness=_Channel(brightness, number)) for number in range(3)]


@dataclass(frozen=True)
class _Channel:
    """One channel of an RGB brightness function."""

    function: Callable
    number: int

    @property
    def image(self):
        """One channel of an environment map."""
        image = getattr(self.function, "image", None)
        return None if image is None else image[..., self.number]

    @property
    def peaks(self):
        return getattr(self.function, "peaks", None)

    def __call__(self, directions):
        values = np.asarray(self.function(directions))
        if values.shape != directions.shape:
            raise bad(
                "brightness function: wrong result",
                f"shape {values.shape} for directions {directions.shape}",
                f"RGB of shape {directions.shape}, as before",
            )
        return values[..., self.number]


def without_disc(source: Source) -> Source:
    """A sky without its sun's disc; anything else as it is."""
    return (
        Sky(replace(source.brightness, direct=0.0))
        if isinstance(source, Sky) and getattr(source.brightness, "direct", 0)
        else source
    )


def radiance(source: Source, directions: np.ndarray) -> np.ndarray:
    """The source's grey brightness along unit vectors (..., 3) -> (...) float64; an InputError if it is not
    finite and >= 0.
    """
    if not isinstance(source, Source):
        raise bad("source", type(source).__name__, "Sky, Lamp or Window")
    brightness = source.brightness
    if isinstance(brightness, tuple):
        raise bad(
            "brightness",
            f"RGB {brightness}",
            "one number, or a function to one number per direction",
            "Only render takes colour.",
        )
    if not callable(brightness):
        return np.full(directions.shape[:-1], float(brightness))
    if getattr(
        brightness, "direct", 0
    ):  # half a degree wide: what looks in some directions would miss it, or overrate it
        raise bad(
            "brightness: a sky with the sun's disc (direct)",
            "a method, source or sides without it",
            "Sky with render's method 'horizon' and sides 'open' or 'dark'",
            "Leave direct out, or render with method='horizon'.",
        )
    values = np.asarray(brightness(directions.copy()))
    if values.dtype.kind not in "iuf" or values.shape not in ((), directions.shape[:-1]):
        raise bad(
            "brightness function: wrong result",
            f"dtype {values.dtype}, shape {values.shape} for directions {directions.shape}",
            f"real numbers of shape {directions.shape[:-1]}",
        )
    values = np.broadcast_to(values.astype(np.float64), directions.shape[:-1])
    if values.size and not (values.min() >= 0 and values.max() <= BRIGHTEST):  # so too with a NaN among them
        wrong = ~((values >= 0) & (values <= BRIGHTEST))
        raise bad(
            "brightness function",
            f"{values[wrong].flat[0]} for L = {directions[wrong][0].round(3).tolist()}",
            f"finite values >= 0, at most {BRIGHTEST:g}",
        )
    return values


PROFILE = (
    2048,
    192,
    # azimuths, elevations at which the light of a sky is looked at first; a sun half a degree wide gets two or
    # three
)
KNOTS = 1024  # of a table of brightness, evenly in the sine of the elevation
UNEVEN = 2.0  # brightest azimuth over the mean from which azimuths are placed by brightness
AT_ONCE = (
    2**13
    # directions whose brightness is asked for at a time: what stays in the cache is quicker, and calls take time
)


def directions_of(azimuth, sine) -> np.ndarray:
    """Unit vectors (..., 3) of azimuths [rad] and sines of elevation, which broadcast."""
    azimuth, sine = np.asarray(azimuth, float), np.asarray(sine, float)
    cosine = np.sqrt(np.maximum(0.0, 1 - sine**2))
    found = np.empty((*np.broadcast_shapes(azimuth.shape, sine.shape), 3))
    found[..., 0], found[..., 1], found[..., 2] = cosine * np.cos(azimuth), cosine * np.sin(azimuth), -sine
    return found


def looks(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Brightness at some 400,000 places of the sky, or four a pixel's side of a map that is coarser, evenly
    in azimuth and elevation, and the sines of these: (azimuths, elevations) each.
    """
    rows, cols = getattr(source.brightness, "pixels", PROFILE[::-1])
    azimuths, elevations = (min(most, max(most // 4, n)) for most, n in zip(PROFILE, (4 * cols, 2 * rows)))
    azimuth = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    shift = 0.6180339887498949 * np.arange(azimuths) % 1  # so that no small sun slips between rows of samples
    part, whole = (
        np.pi / 2 / elevations * a for a in (shift[:, None], np.arange(elevations))
    )  # of the elevation
    sine = np.cos(part) * np.sin(whole) + np.sin(part) * np.cos(whole)
    light = np.empty_like(sine)
    for some in np.array_split(np.arange(azimuths), -(-sine.size // AT_ONCE)):
        light[some] = radiance(source, directions_of(azimuth[some, None], sine[some]))
    return light, sine


def azimuth_profile(source: Source, seen: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray | None:
    """Light that comes from each of many even sectors of azimuth, (2048,); None where it hardly varies.
    ``seen``: what :func:`looks` gives.
    """
    light, sine = looks(source) if seen is None else seen
    profile = np.einsum("ae,ae->a", light, np.sqrt(1 - sine**2))
    if profile.max() <= UNEVEN * profile.mean():
        return None
    return np.maximum.reduce(
        [np.roll(profile, n) for n in range(-2, 3)]
    )  # the edge of a sun lies between samples


def elevation_table(
    source: Source,
    angles: np.ndarray,
    widths: np.ndarray,
    looks: int = 256,
    knots: int = KNOTS,
    points: int = 4,
) -> np.ndarray:
    """Brightness as sweeps take it, (K, knots, 4) float32: the integrals of B cos^2 and of B sin cos over
    elevation, from sin(elevation) = i / (knots - 1) to the zenith, averaged over each sector, and what to add
    up to the next knot.

    ``points`` of Gauss and Legendre between knots, and as many azimuths within a sector as make some
    ``looks`` in all.
    """
    within = max(1, -(-looks // len(angles)))
    azimuth = angles[:, None] + widths[:, None] * ((np.arange(within) + 0.5) / within - 0.5)
    nodes, weights = np.polynomial.legendre.leggauss(points)
    low = np.arange(knots - 1)[:, None]
    sine = ((low + (nodes + 1) / 2) / (knots - 1)).ravel()
    total = np.empty((len(angles), sine.size))
    for some in np.array_split(
        np.arange(len(angles)), min(len(angles), -(-azimuth.size * sine.size // AT_ONCE))
    ):
        total[some] = radiance(source, directions_of(azimuth[some, :, None], sine)).mean(1)
    total = total.reshape(len(angles), knots - 1, points) * weights / 2 / (knots - 1)
    sine = sine.reshape(knots - 1, points)
    parts = np.stack([(total * np.sqrt(1 - sine**2)).sum(-1), (total * sine).sum(-1)], -1)
    table = np.zeros((len(angles), knots, 4))
    table[:, :-1, :2] = np.cumsum(parts[:, ::-1], 1)[:, ::-1]
    table[:, :-1, 2:] = table[:, 1:, :2] - table[:, :-1, :2]
    return table.astype(np.float32)


def _brightness_number(value) -> float:
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


def _brightness(value):
    """A number, three numbers or a function, checked."""
    if callable(value):
        return value
    if np.ndim(value) == 1 and np.size(value) == 3:
        return tuple(map(_brightness_number, value))
    _brightness_number(value)
    return value


def _numbers(values, count, what, form) -> tuple[float, ...]:
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        raise bad(
            what,
            repr(values),
            f"{('one', 'two', 'three')[count - 1]} finite number{'s' * (count > 1)} {form}",
        ) from None
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise bad(
            what, numbers, f"{('one', 'two', 'three')[count - 1]} finite number{'s' * (count > 1)} {form}"
        )
    return numbers


def _flags(values, what, ndim, form) -> np.ndarray:
    try:
        array = host_array(values)
    except Exception as error:
        raise bad(what, str(error), f"bool {form}, not empty") from None
    if array.dtype != bool or array.ndim != ndim or array.size == 0:
        raise bad(what, f"dtype {array.dtype}, shape {array.shape}", f"bool {form}, not empty")
    if not array.any():
        raise InputError(f"{what}: no element is True, so nothing shines.")
    return np.ascontiguousarray(array).copy()
