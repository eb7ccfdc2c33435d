"""What render() gives: the image, made of the irradiances of every colour, and the estimated error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from . import sources
from .arrays import Quantity, by_bands, labelled, multiply, scratch, short_repr
from .backends.resident import DeviceImage
from .interreflection import Interreflection
from .planning.plan import Plan
from .refinement import Refined
from .scene import Scene

# of DataArrays; their unit is that of the source's brightness, or of brightness x sr
IMAGES = {
    "radiance": Quantity("radiance", None, "radiance, in the unit of the source's brightness"),
    "irradiance": Quantity("irradiance", None, "irradiance, in the unit of the source's brightness times sr"),
}
ERRORS = {name: Quantity(f"{name}_error", None, f"estimated error of the {name}") for name in IMAGES}
# nodes to each side of a node over which the error map is a mean: halves estimate regions, not single nodes
ERROR_MAP_RADIUS = 4
# error map over that mean: 90, 98 and 99 % of the nodes of 53 random pairs (performance/refinement.py) are
# within one, two and three times it
ERROR_MAP_FACTOR = np.float32(2)

Irradiance = np.ndarray | DeviceImage  # (rows, cols) float32 [brightness x sr]


@dataclass(frozen=True, eq=False)
class Rendering:
    """What render() gives.

    image (rows, cols) float32, or (rows, cols, 3) in colour, nan where masked, an xarray.DataArray if the
    scene was made from one, a DeviceImage if its map lies on a GPU; plan; backend (its name); seconds of the
    call without compiling, compile_seconds; warnings (one sentence each). interreflection: the decision
    about the light between surfaces. direct, reflected: with ``parts=True``, the image by direct light alone
    (ground in mirrors is black), and the rest of it; a tolerance is a share of the mean of both together.

    Examples
    --------
    >>> done = sl.render(sl.Scene(np.zeros((3, 3)), albedo=0.5), sl.Sky(), parts=True)
    >>> done.image.shape, done.warnings, bool(done.reflected.any())
    ((3, 3), [], False)
    """

    image: np.ndarray
    plan: Plan
    backend: str
    seconds: float
    compile_seconds: float
    warnings: list[str] = field(default_factory=list)
    _parts: tuple[tuple[Refined, float], ...] = field(default=(), repr=False)
    _scene: Scene | None = field(default=None, repr=False)
    _quantity: str = field(default="radiance", repr=False)
    interreflection: Interreflection | None = None
    direct: np.ndarray | None = field(default=None, repr=False)
    reflected: np.ndarray | None = field(default=None, repr=False)
    _between: tuple[float, ...] = field(default=(0.0,), repr=False)

    __repr__ = short_repr

    @cached_property
    def error(self) -> np.ndarray | None:
        """Estimated error of every node, in the unit and shape of image, nan where masked.

        None where no tolerance was asked, infinite where it is not known (a lamp given as a volume). The root
        mean square, over 9 x 9 nodes, of half the difference of the image's two halves, times the ratio of
        the error to it, and besides what is common to both halves.
        It shows regions, not nodes: on random scenes 93, 98 and 99 % of the nodes had an error below one, two
        and three times the estimate (docs/refinement.csv). The error of the light between surfaces is added,
        one number for all nodes. The light of lobes and mirrors is not included.
        """
        scene = self._scene
        if scene is None:
            return None
        with np.errstate(invalid="ignore"):
            errors = [
                np.hypot(np.float32(factor) * _error_map(result, scene), np.float32(between))
                for (result, factor), between in zip(self._parts, self._between)
            ]
            image = image_of(scene, errors, [], self._quantity)
        if self.image.ndim > image.ndim:  # a coloured ground alone colours an irradiance
            image = np.repeat(image[..., None], 3, -1)
        # a black source, or ground of albedo 0, times an error that is not bounded: 0 x inf is nan
        unknown = np.isnan(image)
        if scene.mask is not None:
            unknown[~scene.mask] = False
        image[unknown] = 0
        result: np.ndarray = labelled(image, scene.labels, ERRORS[self._quantity])
        return result

    def _times(self, scale: float) -> Rendering:
        """This in light of ``scale`` times the brightness."""
        if scale == 1:
            return self
        return replace(
            self,
            image=_scaled_result(self.image, scale),
            direct=_scaled_result(self.direct, scale),
            reflected=_scaled_result(self.reflected, scale),
            _parts=tuple((part, factor * scale) for part, factor in self._parts),
            _between=tuple(error * scale for error in self._between),
        )


def image_of(
    scene: Scene, irradiances: list[np.ndarray], reflected: list[np.ndarray], quantity: str
) -> np.ndarray:
    """The image of a quantity, made in place of the irradiances; the lists have one array per colour."""
    colours = _radiances(scene, irradiances, reflected) if quantity == "radiance" else irradiances
    image = colours[0] if len(colours) == 1 else np.stack(colours, -1)
    np.maximum(image, 0, out=image)  # differences of sums round to less than 0
    if scene.mask is not None:
        image[~scene.mask] = np.nan
    return image


def _radiances(scene: Scene, irradiances: list[np.ndarray], reflected: list[np.ndarray]) -> list[np.ndarray]:
    """albedo E / pi + specular albedo x what else is reflected, per colour; made in place of E."""
    names = "albedo", "specular"
    albedo, specular = (np.asarray(getattr(scene.reflectance, name, 1.0), np.float32) for name in names)
    in_colour = is_in_colour(albedo) or is_in_colour(specular)
    count = max(len(irradiances), len(reflected), 3 if in_colour else 0)
    images = []
    for n in range(count):
        image = np.zeros((), np.float32)
        if irradiances:
            image = _channel(irradiances, n, count)
            multiply(image, _share(albedo, n) * np.float32(1 / np.pi))
        if reflected:
            image = image + _share(specular, n) * _channel(reflected, n, count)
        images.append(image)
    return images


def _channel(colours: list[np.ndarray], n: int, count: int) -> np.ndarray:
    """Channel ``n`` of ``count``; a copy where one array serves several channels."""
    colour = colours[n % len(colours)]
    shared = count > len(colours) or sum(other is colour for other in colours) > 1
    return colour.copy() if shared else colour


def _share(share: np.ndarray, n: int) -> np.ndarray:
    """Channel ``n`` of an albedo."""
    return share[..., n] if is_in_colour(share) else share


def is_in_colour(share: np.ndarray) -> bool:
    return share.ndim in (1, 3)


def numbers_of(greys: Sequence[sources.Source]) -> list[float] | None:
    """Brightnesses where all are numbers, so that colours differ by a factor alone; else None."""
    if any(callable(grey.brightness) for grey in greys):
        return None
    return [sources.number_of(grey) for grey in greys]


def per_colour(greys: Sequence[sources.Source], work: Callable[[sources.Source], Irradiance]) -> list[Any]:
    """``work`` (source) for every colour; where colours differ by a factor alone, once, times that factor."""
    factors = numbers_of(greys)
    if factors is None:
        return [work(grey) for grey in greys]
    one = work(replace(greys[0], brightness=1.0))
    return [scaled(one, factor) for factor in factors]


def on_host(images: Sequence[Irradiance]) -> list[np.ndarray]:
    return [np.asarray(image) for image in images]


def scaled(image: Irradiance, factor: float) -> Irradiance:
    if factor == 1:
        return image
    if isinstance(image, DeviceImage):  # a copy, as on the host: the image is used again
        copied = image.copy()
        copied.scale(factor)
        return copied
    product = scratch(image.shape)
    by_bands(lambda rows: np.multiply(image[rows], np.float32(factor), out=product[rows]), image.shape)
    return product


def _scaled_result(image: Any, scale: float) -> Any:
    """A result times a number: an array of any kind that render() gives, or None."""
    if image is None or isinstance(image, DeviceImage):
        return image if image is None else scaled(image, scale)
    product = image * np.float32(scale)
    return product if isinstance(image, np.ndarray) else image.copy(data=product.data)


def _error_map(result: Refined, scene: Scene) -> np.ndarray:
    """Estimated error (rows, cols) float32 of a refined irradiance."""
    if result.half_difference is None:
        return np.full(scene.shape, result.common_error, np.float32)
    square, count = (
        np.where(scene.valid, result.half_difference().astype(float) ** 2, 0),
        scene.valid.astype(float),
    )
    for axis in (0, 1):
        square, count = (_box_sums(values, axis) for values in (square, count))
    differing = result.error_ratio**2 * square / np.maximum(count, 1)
    error = np.sqrt(differing + result.common_error**2).astype(np.float32)
    return np.asarray(ERROR_MAP_FACTOR * error)


def _box_sums(values: np.ndarray, axis: int) -> np.ndarray:
    """Sums over up to 2 ERROR_MAP_RADIUS + 1 neighbours along an axis."""
    ends = np.concatenate([np.zeros_like(np.take(values, [0], axis)), np.cumsum(values, axis)], axis)
    at = np.arange(values.shape[axis])
    high, low = np.minimum(at + ERROR_MAP_RADIUS + 1, len(at)), np.maximum(at - ERROR_MAP_RADIUS, 0)
    sums: np.ndarray = np.take(ends, high, axis) - np.take(ends, low, axis)
    return sums
