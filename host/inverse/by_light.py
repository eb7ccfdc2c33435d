"""Which images are of the same light, and their means: two of them tell no more than one."""

from __future__ import annotations

import functools
import math
from dataclasses import fields, is_dataclass, replace
from types import MethodType
from typing import Any, NamedTuple

import numpy as np

from .. import sources
from ..sources.brightness import Distribution
from . import diagnostics

# images of the same light whose means differ by more than this share were exposed differently; chosen: 1 %
# of noise changes means of 32 x 32 pixels by 0.03 %
SAME_EXPOSURE = 0.01


class Merged(NamedTuple):
    """An image (rows, cols) for every light, where it is known, its name in messages, and warnings on merged
    images.
    """

    images: list[np.ndarray]
    known: list[np.ndarray]
    lights: list[sources.Source]
    names: list[str]
    warnings: list[str]


def by_light(images: list[np.ndarray], lights: list[sources.Source], known: list[np.ndarray]) -> Merged:
    """Images of the same light become their mean, of those that are known at a pixel. Brightnesses that are
    numbers may differ. Images are 0 where they are not known.
    """
    first: list[int] = []  # image of the same light
    for n, light in enumerate(lights):
        first.append(next((m for m in range(n) if _is_same(lights[m], light)), n))
    merged = Merged([], [], [], [], [])
    for m in sorted(set(first)):
        alike = [n for n, other in enumerate(first) if other == m]
        if len(alike) == 1:
            image, where, light, name = images[m], known[m], lights[m], f"image {m + 1}"
        else:
            listed = f"{', '.join(str(n + 1) for n in alike[:-1])} and {alike[-1] + 1}"
            light, name = lights[m], f"mean of images {listed}"
            numbers = [sources.number_of(lights[n]) for n in alike]
            brightness = float(np.mean(numbers))
            # of a pixel: the brightnesses of the images that know it, over the mean brightness of all
            total = np.sum([number * known[n] for number, n in zip(numbers, alike)], axis=0) / brightness
            where, by_all = total > 0, np.all([known[n] for n in alike], axis=0)
            image = np.sum([images[n] for n in alike], axis=0) / np.where(where, total, 1)
            units = [float(images[n][by_all].sum()) / number for number, n in zip(numbers, alike)]
            if max(units) > (1 + SAME_EXPOSURE) * min(units):
                ratio = max(units) / min(units) if min(units) else math.inf
                merged.warnings.append(diagnostics.of_exposures(listed, ratio))
            if not callable(light.brightness):
                light = replace(light, brightness=brightness)
        merged.images.append(image)
        merged.known.append(where)
        merged.lights.append(light)
        merged.names.append(name)
    return merged


def _is_same(one: sources.Source, other: sources.Source) -> bool:
    """Whether two sources differ at most by a factor, as far as their fields tell."""
    if type(one) is not type(other) or callable(one.brightness) != callable(other.brightness):
        return False
    names = [field.name for field in fields(one) if field.name != "brightness" or callable(one.brightness)]
    return all(_is_equal(getattr(one, name), getattr(other, name)) for name in names)


def _is_equal(one: Any, other: Any) -> bool:
    """Whether two values are the same, or made alike; functions of a user's are the same or not."""
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(_is_equal, one, other))
    if isinstance(one, functools.partial):
        given = [(part.func, part.args, sorted(part.keywords.items())) for part in (one, other)]
        return _is_equal(*given)
    if isinstance(one, Distribution) and is_dataclass(one):
        return all(_is_equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    return isinstance(one, (int, float, str, MethodType)) and bool(one == other)
