"""Sources: sky (converging), lamp and window (diverging), their geometry, and their radiance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from .. import deadline
from ..arrays import Labels, host_array, labels_of, lies_on
from ..constants import APERTURE, BALL, RECTANGLE, SKY, VOLUME
from ..errors import CapacityError, InputError, bad
from ..scene import Scene, depth_at
from .brightness import (
    BRIGHTEST,
    LEAST_UNIT,
    MOST_UNIT,
    Brightness,
    Channel,
    Distribution,
    Mirrored,
    checked,
    directions_of,
    distribution,
    numbers,
)

# of a ray that goes from node to node up to a volume; chosen: some minutes for 209 directions in NumPy, and
# time is in proportion
MOST_STEPS_UP = 2**16
# azimuths, and elevations, in which the size of a brightness is sampled. Chosen; half and twice give the same
# image, since scaling by a power of two is exact, unless light between the samples is 2^40 times brighter
BRIGHTNESS_PROBES = 12
LEAST_CLIMB = 1e-4  # [rad] between directions on the way to the top of a narrow spot; chosen


@dataclass(frozen=True)
class Sky:
    """The sky: rays arrive from every direction of the hemisphere.

    Parameters
    ----------
    brightness : number; RGB as three; or a function of unit vectors (..., 3) to (...), or to RGB (..., 3)
        A function is integrated: features of at least 0.2 degrees are found in any direction, and all pixels
        of an environment map. The attribute ``peaks`` of a function may hold the directions of all its
        features that are narrower than a degree, as ``suns`` does; others are then not searched for, and ()
        means that there are none.
    suns : unit vectors (x, y, z), optional
        Directions towards all features of ``brightness`` that are narrower than a degree. They may then be as
        small as 1e-4 degrees, and no others are searched for.

    Raises
    ------
    InputError
        For another brightness, or suns that are no vectors towards the viewer's side (z <= 0).

    Examples
    --------
    >>> sky = sl.Sky(lambda L: 1 + 1e7 * (L[..., 2] < -0.9999999), suns=[(0, 0, -1)])
    """

    brightness: Brightness = 1.0
    suns: Sequence[Sequence[float]] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "brightness", checked(self.brightness))
        try:
            suns = tuple(numbers(sun, 3, "sky: suns", "(x, y, z)") for sun in self.suns)
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
    ``edges``, two vectors at right angles from it; or any shape, ``volume`` (layers,
    rows, cols) bool on the lattice, True where the node (layer, row, col) shines.

    Directions towards a source are level or go upwards. Ground that is higher than a part of the lamp sees it
    below its level; :func:`render` leaves that light out, with a warning that says how much it is.

    Examples
    --------
    >>> ball = sl.Lamp(center=(16, 16, -8), radius=2, brightness=10)
    >>> panel = sl.Lamp(corner=(4, 4, -8), edges=((24, 0, 0), (0, 3, 0)))
    >>> E = sl.render(sl.Scene(np.zeros((33, 33))), ball, quantity="irradiance").image
    >>> round(float(E[16, 16] / np.pi), 3)  # below it, B (radius / distance)^2
    0.625
    """

    center: Sequence[float] | None = None
    radius: float | None = None
    brightness: Brightness = 1.0
    volume: np.ndarray | None = None
    corner: Sequence[float] | None = None
    edges: Sequence[Sequence[float]] | None = None
    # of a volume that was a DataArray; it stays where the lamp is replaced by one of another brightness
    _labels: Labels | None = field(default=None, repr=False, kw_only=True)

    def __post_init__(self) -> None:
        names = "center", "radius", "volume", "corner", "edges"
        given = [name for name in names if getattr(self, name) is not None]
        if given not in (["center", "radius"], ["volume"], ["corner", "edges"]):
            raise bad(
                "lamp",
                " and ".join(given) or "no shape",
                "center and radius (a sphere), corner and edges (a rectangle), or volume alone",
            )
        if self.corner is not None:
            object.__setattr__(self, "corner", numbers(self.corner, 3, "lamp corner", "(x, y, z)"))
            try:
                one, other = self.edges  # type: ignore[misc]  # may be anything here, None too
            except (TypeError, ValueError):
                raise bad("lamp edges", repr(self.edges), "two vectors (x, y, z)") from None
            u, v = (numbers(edge, 3, "lamp edge", "(x, y, z)") for edge in (one, other))
            lengths = np.linalg.norm(u), np.linalg.norm(v)
            if not min(lengths) > 0 or abs(np.dot(u, v)) > 1e-6 * lengths[0] * lengths[1]:
                raise bad("lamp edges", (u, v), "two vectors that are not zero and at right angles")
            if any(np.array_equal(np.add(self.corner, edge), self.corner) for edge in (u, v)):
                raise bad(
                    "lamp edges", (u, v), f"no shorter than float64 resolves at the corner {self.corner}"
                )
            object.__setattr__(self, "edges", (u, v))
        elif self.volume is not None:
            object.__setattr__(self, "_labels", labels_of(self.volume) or self._labels)
            object.__setattr__(self, "volume", _flags(self.volume, "lamp volume", 3, "(layers, rows, cols)"))
        else:
            object.__setattr__(self, "center", numbers(self.center, 3, "lamp center", "(x, y, z)"))
            radius = numbers([self.radius], 1, "lamp radius", "> 0")[0]
            if radius <= 0:
                raise bad("lamp radius", radius, "a finite number > 0")
            object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "brightness", checked(self.brightness))


@dataclass(frozen=True, eq=False)
class Window:
    """An aperture in the plane z = 0: rays through it inherit the brightness of the sky behind it.

    Either a rectangle, ``x`` = (x0, x1) and ``y`` = (y0, y1) [unit of spacing], half-open; or ``aperture``
    (rows, cols) bool, True where node's pixel is open. The surface lies behind the plane: at a node in it
    (depth 0) the light of a rectangle is not defined. Over a map that repeats, the window repeats with it.

    Examples
    --------
    >>> slit = sl.Window(x=(4, 28), y=(15, 17), brightness=5.0)
    >>> E = sl.render(sl.Scene(np.full((33, 33), 4.0), sides="dark"), slit, quantity="irradiance").image
    >>> bool(E[16, 16] > E[2, 16])
    True
    """

    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None
    brightness: Brightness = 1.0
    aperture: np.ndarray | None = None
    _labels: Labels | None = field(default=None, repr=False, kw_only=True)  # as those of a lamp

    def __post_init__(self) -> None:
        if (self.aperture is None) == (self.x is None or self.y is None) or (
            self.aperture is not None and (self.x, self.y) != (None, None)
        ):
            raise bad(
                "window",
                f"x={self.x}, y={self.y}, aperture {'given' if self.aperture is not None else 'not given'}",
                "x and y (a rectangle), or aperture alone",
            )
        if self.aperture is not None:
            object.__setattr__(self, "_labels", labels_of(self.aperture) or self._labels)
            object.__setattr__(self, "aperture", _flags(self.aperture, "window aperture", 2, "(rows, cols)"))
        else:
            for name in "xy":
                low, high = numbers(getattr(self, name), 2, f"window {name}", "(low, high)")
                if not low < high:
                    raise bad(f"window {name}", (low, high), "low < high")
                object.__setattr__(self, name, (low, high))
        object.__setattr__(self, "brightness", checked(self.brightness))


Source = Sky | Lamp | Window


class Geometry(NamedTuple):
    """The place of a source in the form for backends: plain numbers in the unit of the compared depths.

    kind: SKY, RECTANGLE, APERTURE, BALL or VOLUME. numbers (4,) float64: x0, x1, y0, y1 of a rectangle or
    x, y, z, radius of a ball. flags: uint8 aperture (1, rows, cols) or volume (layers, rows, cols).
    """

    kind: int
    numbers: np.ndarray
    flags: np.ndarray

    @property
    def is_lamp(self) -> bool:
        return self.kind in (BALL, VOLUME)


def geometry(source: Source, scene: Scene, step: float) -> Geometry:
    """The geometry of ``source`` over ``scene``, lengths scaled so that the spacing is ``step``.

    Raises InputError where they do not fit.
    """
    nothing, no_numbers = np.zeros((1, 1, 1), np.uint8), np.zeros(4)
    if isinstance(source, Sky):
        return Geometry(SKY, no_numbers, nothing)
    if isinstance(source, Window):
        if source.aperture is None:
            assert source.x is not None and source.y is not None, "a window without aperture is a rectangle"
            return Geometry(RECTANGLE, np.array([*source.x, *source.y]) * step / scene.spacing, nothing)
        lies_on(scene.labels, source._labels, "window aperture")
        if source.aperture.shape != scene.shape:
            raise bad("window aperture: wrong shape", source.aperture.shape, f"the scene's {scene.shape}")
        return Geometry(APERTURE, no_numbers, source.aperture[None].view(np.uint8))
    if not isinstance(source, Lamp):
        raise bad("source", type(source).__name__, "Sky, Lamp or Window")
    if source.volume is not None:
        lies_on(scene.labels, source._labels, "lamp volume")
        return Geometry(VOLUME, no_numbers, _volume(source.volume, scene))
    if scene.sides == "periodic":
        raise bad(
            "lamp sphere or rectangle with sides='periodic'",
            "a lamp that stands once over a map that repeats",
            "sides='open' or 'dark', or a lamp given as a volume, which repeats with the map",
        )
    if source.corner is not None:
        raise bad(
            "method 'lattice' with a rectangular lamp",
            "a lamp given by corner and edges",
            "a sphere or a volume",
            "Use method='horizon'.",
        )
    assert source.center is not None and source.radius is not None, "any other lamp is a sphere"
    x, y, z = source.center
    col, row = (int(np.floor(v / scene.spacing + 0.5)) for v in (x, y))
    on_map = 0 <= row < scene.shape[0] and 0 <= col < scene.shape[1]
    if on_map and z > (depth := depth_at(scene, row, col)):
        raise bad(
            "lamp below the surface",
            f"center z = {z} at (row, col) = ({row}, {col})",
            f"z <= {depth}, the depth of the surface there",
        )
    return Geometry(BALL, np.array([x, y, z, source.radius]) * step / scene.spacing, nothing)


def _volume(volume: np.ndarray, scene: Scene) -> np.ndarray:
    """The nodes of a volume in free space, (layers, rows, cols) uint8, checked."""
    if volume.shape[1:] != scene.shape:
        raise bad(
            "lamp volume: wrong shape",
            volume.shape,
            f"(layers, rows, cols) with the scene's rows and cols {scene.shape}",
        )
    if scene.deepest > MOST_STEPS_UP * scene.spacing:
        raise CapacityError(
            f"A lamp volume over ground {scene.deepest / scene.spacing:.3g} spacings deep: rays would take"
            f" more than {MOST_STEPS_UP:,} steps up to it. Subtract the least depth, or give a sphere."
        )
    free = np.arange(len(volume))[:, None, None] <= scene.layers()[0]
    if not (volume & free).any():
        raise bad(
            "lamp volume: no node of it lies in free space",
            f"{volume.sum()} nodes",
            "at least one True node at or above the surface",
        )
    return (volume & free).view(np.uint8)


def channels(source: Source) -> list[Source]:
    """The source itself if its brightness is grey, else three grey ones: red, green, blue."""
    brightness = source.brightness
    if isinstance(brightness, tuple):
        return [replace(source, brightness=value) for value in brightness]
    if not callable(brightness):
        return [source]
    probe = directions_of(np.array([0.3, 2.0]), np.array([0.2, 0.9]))
    if np.shape(distribution(brightness)(probe.copy())) != (2, 3):
        return [source]
    return [replace(source, brightness=Channel(distribution(brightness), number)) for number in range(3)]


def distribution_of(source: Source) -> Distribution | None:
    """The brightness of ``source`` where it depends on the direction, None where it is a number or RGB."""
    return distribution(source.brightness) if callable(source.brightness) else None


def narrow_features(source: Source) -> tuple[tuple[float, ...], ...] | None:
    """Directions (x, y, z) of all features of its brightness below a degree; None where none are named.

    () where the brightness has none.
    """
    brightness = distribution_of(source)
    narrow = None if brightness is None else brightness.narrow()
    suns = tuple(map(_unit, source.suns)) if isinstance(source, Sky) else ()
    return None if narrow is None and not suns else (*suns, *(narrow or ()))


def _unit(vector: Sequence[float]) -> tuple[float, float, float]:
    """A vector that is not zero, 1 long."""
    most = max(map(abs, vector))
    x, y, z = (v / most for v in vector)
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


def in_range(source: Source) -> tuple[Source, float]:
    """A source whose brightness is far from the limits of float32, and the number that its light is to be
    multiplied by: a power of two, 1 where the brightness is a number or its greatest value is moderate.

    Functions are sampled in BRIGHTNESS_PROBES azimuths and elevations, and towards their narrow features.
    """
    brightness = distribution_of(source)
    if brightness is None:
        return source, 1.0
    steps = np.arange(BRIGHTNESS_PROBES) / BRIGHTNESS_PROBES
    azimuths, sines = 2 * np.pi * steps, steps + 0.5 / BRIGHTNESS_PROBES
    narrow = np.reshape(narrow_features(source) or (), (-1, 3))
    around = directions_of(azimuths[:, None], sines).reshape(-1, 3)
    probes = np.concatenate([around, narrow])
    values = np.asarray(brightness(probes.copy()))
    if values.dtype.kind not in "iuf" or values.shape != probes.shape[:1]:
        return source, 1.0  # radiance() raises the error
    values = values.astype(float)
    values = np.where((values >= 0) & (values <= BRIGHTEST), values, 0)
    most = float(values.max())
    if 0 < most < LEAST_UNIT:
        most = _summit(brightness, probes[np.argmax(values)], most)
    if most == 0 or LEAST_UNIT <= most <= MOST_UNIT:
        return source, 1.0
    scale = 2.0 ** max(math.floor(math.log2(most)), -1000)  # 1 / scale is finite
    return replace(source, brightness=brightness.scaled(1 / scale)), scale


def _summit(brightness: Distribution, at: np.ndarray, most: float) -> float:
    """The brightness at the top of the hill on whose slope ``at`` lies, with brightness ``most``.

    A narrow spot may stand between the probes of :func:`in_range`, which then lie on its foot.
    """
    step = 1 / BRIGHTNESS_PROBES
    while step > LEAST_CLIMB and most < LEAST_UNIT:
        around = at + step * np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
        around[:, 2] = np.minimum(around[:, 2], 0)
        around /= np.linalg.norm(around, axis=-1, keepdims=True)
        values = np.nan_to_num(np.asarray(brightness(around), float), posinf=0.0)
        best = int(np.argmax(values))
        if values[best] > most:
            at, most = around[best], float(values[best])
        else:
            step /= 2
    return most


def on_axes(source: Source, axes: tuple[float, float]) -> Source:
    """A sky, or the sky behind a window, in the axes of a map; lamps stand in these.

    ``axes``: 1 where columns run east and rows south, -1 where they run west and north.
    """
    brightness = distribution_of(source)
    if axes == (1.0, 1.0) or isinstance(source, Lamp):
        return source
    turned = source if brightness is None else replace(source, brightness=Mirrored(brightness, axes))
    if isinstance(turned, Sky):
        turned = replace(turned, suns=tuple((x * axes[0], y * axes[1], z) for x, y, z in turned.suns))
    return turned


def without_disc(source: Source) -> Source:
    """A sky without its sun's disc; anything else as it is."""
    brightness = distribution_of(source)
    if not isinstance(source, Sky) or brightness is None or brightness.disc() is None:
        return source
    return replace(source, brightness=brightness.without_disc())


def number_of(source: Source) -> float:
    """The brightness of a grey source if that is a number, 1 if it is a function of direction."""
    value: Any = source.brightness
    return 1.0 if callable(value) else float(value)


def check_source(source: object) -> None:
    """InputError unless it is a Source."""
    if not isinstance(source, Source):
        fix = "A function of direction is a brightness: sl.Sky(brightness)." if callable(source) else ""
        raise bad("source", type(source).__name__, "Sky, Lamp or Window", fix)


def radiance(source: Source, directions: np.ndarray) -> np.ndarray:
    """The source's grey brightness along unit vectors (..., 3): (...) float64.

    Raises InputError where it is not finite or negative.
    """
    check_source(source)
    deadline.check()
    brightness: Any = source.brightness
    if isinstance(brightness, tuple):
        raise bad(
            "brightness",
            f"RGB {brightness}",
            "one number, or a function to one number per direction",
            "Only render takes colour.",
        )
    if not callable(brightness):
        return np.full(directions.shape[:-1], float(brightness))
    function = distribution(brightness)
    if function.disc() is not None:  # so narrow that samples would miss it, or overrate it
        raise bad(
            "brightness: a sky with the sun's disc (direct)",
            "a method, source or sides without it",
            "render of a Sky by default, or by 'horizon' or 'unoccluded' on sides 'open' or 'dark'",
            "Leave direct out.",
        )
    values = np.asarray(function(directions.copy()))
    if values.dtype.kind not in "iuf" or values.shape not in ((), directions.shape[:-1]):
        raise bad(
            "brightness function: wrong result",
            f"dtype {values.dtype}, shape {values.shape} for directions {directions.shape}",
            f"real numbers of shape {directions.shape[:-1]}",
            "Only render takes colour." if values.shape == (*directions.shape[:-1], 3) else "",
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


def _flags(values: Any, what: str, ndim: int, form: str) -> np.ndarray:
    try:
        array = host_array(values)
    except Exception as error:
        raise bad(what, str(error), f"bool {form}, not empty") from None
    if array.dtype != bool or array.ndim != ndim or array.size == 0:
        raise bad(what, f"dtype {array.dtype}, shape {array.shape}", f"bool {form}, not empty")
    if not array.any():
        raise InputError(f"{what}: no element is True, so nothing shines.")
    flags = np.ascontiguousarray(array).copy()
    flags.flags.writeable = False
    return flags
