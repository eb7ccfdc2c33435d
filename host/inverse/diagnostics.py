"""Warnings of recover(), and what decides on them: of images and lights before the search, of residuals,
limits and doubt after it. And whether a residual is noise or relief.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import sources
from ..scene import Scene
from ..sources.integrals import integrals
from .confidence import UNTRUSTED
from .place import FreePlace
from .pyramid import COARSEST, IMAGE_RMS, Pyramid, lit, share_of_images
from .resampling import distance_from

ILL_POSED = "{} sides under a sky are ill-posed: the image of a flat surface is the same at any depth."
# share and number of the pixels at the greatest or least depth allowed from which on there is a warning.
# Chosen: surfaces of 24 x 24 nodes whose deepest 0.7 to 3 % are beyond `layers` err by 0.7 to 1.8 nodes (RMS)
AT_LIMIT, LEAST_AT_LIMIT = 0.005, 3
# the same of pixels with an image's largest value, and times as many as have the next largest: in an image in
# steps these are about as many. Chosen: depths from images of which 5 % are clipped err by 0.4 nodes
CLIPPED_SHARE, LEAST_CLIPPED, CLIPPED_TIMES = 0.01, 3, 3
SAME_LIGHT = 1e-3  # relative difference up to which the largest value is that of level open ground; chosen
NO_TIME = (
    "Light between surfaces: it is left out, since the search ended before its turn; where the images contain"
    " it, depth is farther off than std says."
)
# residual over the image (RMS), besides that of noise, above which an image is called poorly explained.
# Measured by performance/recover.py --what suspected, 32 x 32: it is given in one of 30 recoveries with the
# right arguments, in 28 of 30 with half the albedo and 19 of 30 with open sides instead of dark ones. The
# residual alone is above it in 3, 28 and 20; above half of it in 4, 28 and 21, above twice in 0, 25 and 15
POORLY = 0.03
# the same, above which a warning says that light between surfaces is not fully explained: in
# performance/recover.py --what between 9 of 45 residuals are above it, with errors of depth of 0.2 to 3
# nodes, and of those below it 5 errors are above half a node
UNSETTLED = 0.0025
# an image is called too bright for the model if it is brighter by this share of its RMS at so many pixels; in
# the recoveries of POORLY in 1, 27 and 11 of 30. At so many pixels 2, 28 and 13 are brighter, at half as many
# 2, 28 and 14, at twice as many 0, 25 and 12
TOO_BRIGHT, TOO_MANY = 0.1, 0.02
UNLIT_MODEL = 0.01  # share of the image (RMS) below which a model has no light; chosen
# median of the albedo that is found from which on images are in another unit than brightness; chosen: light
# between surfaces, taken for direct light, makes a white surface seem brighter, but hardly three times
IN_ANOTHER_UNIT = 3.0
# standard deviations of noise by which a pixel may be brighter than the model; 0.3 of 10^6 normal ones are
DEVIATIONS = 5
# residual over the noise that was estimated, above which it is not noise; and above which it is not, if
# neighbouring residuals are correlated too, by so many standard deviations of the correlation in white noise.
# By performance/recover.py --what fine (332 images with 32, 64, 96 and 160 nodes a side): with noise that is
# even 0.8 to 1.2, as the root of brightness up to 1.4, as brightness up to 2.45, and where above 1.05 never
# correlated by more than 1.8; of 128 images of fine relief 1.06 to 2.9, and 3.4 to 25
NOISE_TIMES, RELIEF_TIMES, CORRELATED = 2.5, 1.05, 2.5
# noise over the image (RMS) from which on it may be fine relief; chosen: less hardly smooths. In those images
# it is 0.016 to 0.23, so that half gives the same answers, and twice all but 1
LEAST_TAKEN = 0.01
# grey levels of an image: steps of fewer are coarser than a quarter of the usual eps of carving, 0.02; chosen
FEWEST_COUNTS = 200
WHOLE = 1e-3  # share of the largest count by which counts may differ from whole numbers: three digits; chosen
EIGHT_BITS = 256
# side [nodes] of a rectangle below which std is too small. Chosen: of smooth surfaces under windows 0.5, 1,
# 2, 3, 4 and 6 nodes wide depth errs by 2.6, 1, 0.2, 0.2, 0.07 and 0.06 nodes (RMS), and 4, 9, 41, 26, 66 and
# 63 % lie within 1 std; under lamps 2 and 4 wide by 0.8 and 0.2 nodes, and 17 and 40 %
NARROW = 5
# share of ambiguous pixels from which on a warning says so; in the recoveries of POORLY in 2, 24 and 21
# of 30, from half of it in 5, 25 and 21, from twice in 2, 22 and 21
AMBIGUOUS = 0.005
# distance into a gap [side of the image, and node] from which on a warning calls it wide. Chosen: around gaps
# with a radius of 3, 6 and 10 nodes, of 64, in fifteen surfaces under a sky, 0, 0 and 2 answers are off by
# more than a node (RMS)
WIDE_GAP, LEAST_WIDE = 0.1, 3
BELOW = 0.01  # share of a lamp's light from below the level above which a warning says so; chosen
UNTOLD = 0.2  # share of untrusted pixels above which a warning says so; chosen
# part of the image's side that counts as border, and ratio of the variance of residuals there to that inside
# from which on the sides are suspected; chosen
RIM_PART, RIM_RATIO = 8, 2


def of_images(
    images: Sequence[np.ndarray],
    known: Sequence[np.ndarray],
    lights: Sequence[sources.Source],
    scene: Scene,
    deepest: float,
    albedo_given: bool = True,
) -> list[str]:
    """Warnings that follow from the images alone, where known; lights in nodes, ``deepest`` [nodes]."""
    warnings = of_place(scene.sides, lights)
    for image, where, light in zip(images, known, lights):
        warnings += of_largest(image[where], light, scene.albedo if albedo_given else None)
        bright = where & (image > 0)  # what is black has no steps
        values = np.unique(image[bright])
        if 2 < len(values) <= EIGHT_BITS < bright.sum():
            step = float(np.median(np.diff(values)))
            # along both axes: an image that is constant along one is no coarse one
            if all(_step_along(image, bright, axis) < step for axis in (0, 1)):
                warnings.append(
                    f"8-bit steps: the image has {len(values)} values, {step:.2g} apart, and most neighbours"
                    " differ by less; fine relief is lost in them."
                )
    for light in lights:
        if (width := _width_of(light)) < NARROW:
            warnings.append(
                f"Narrow source: a window or lamp {width:.2g} nodes wide casts light that changes within a"
                " node, which the model of the image lacks; depth is off by tenths of a node or more, and std"
                " may be far too small."
            )
        if isinstance(light, sources.Lamp) and light.center is not None and light.radius is not None:
            away = deepest - light.center[2]
            if light.radius / max(away, light.radius) < 0.5 / min(COARSEST, *scene.shape):  # half a node
                degrees = math.degrees(light.radius / away)
                warnings.append(
                    f"Small lamp: its apparent radius, {degrees:.2g} degrees from the greatest depth, is"
                    " below the resolution of the coarsest grid; its shadows are sharper than that grid has."
                )
    return warnings


def _step_along(image: np.ndarray, where: np.ndarray, axis: int) -> float:
    """Median difference of neighbours that both count; inf without any."""
    image, where = (np.moveaxis(array, axis, 0) for array in (image, where))
    steps = np.abs(np.diff(image, axis=0))[where[1:] & where[:-1]]
    return float(np.median(steps)) if steps.size else math.inf


def _width_of(light: sources.Source) -> float:
    """The smaller side [nodes] of a rectangle; inf of others."""
    if isinstance(light, sources.Window) and light.x is not None and light.y is not None:
        return min(light.x[1] - light.x[0], light.y[1] - light.y[0])
    if isinstance(light, sources.Lamp) and light.edges is not None:
        return min(math.hypot(*edge) for edge in light.edges)
    return math.inf


def of_largest(image: np.ndarray, light: sources.Source, albedo: Any) -> list[str]:
    """Warning that an image (pixels,) seems to be clipped: many pixels have its largest value, few the next.

    Level open ground under a sky may have it.
    """
    values, counts = np.unique(image, return_counts=True)
    many = counts[-1] >= max(LEAST_CLIPPED, CLIPPED_SHARE * image.size)
    if len(values) < 3 or not many or counts[-1] < CLIPPED_TIMES * counts[-2]:
        return []
    if isinstance(light, sources.Sky):
        if np.ndim(albedo) or albedo is None:
            return []
        level = integrals(light).level if callable(light.brightness) else math.pi * sources.number_of(light)
        if abs(values[-1] - float(albedo) * level / math.pi) <= SAME_LIGHT * values[-1]:
            return []
    return [
        f"Clipped: {counts[-1] / image.size:.0%} of the pixels have exactly the image's largest value, and"
        " depth is wrong around highlights that are cut off; std does not include that."
    ]


def of_limits(z: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[str]:
    """Warnings that many pixels lie at the greatest or the least depth that is allowed."""
    warnings = []
    for there, what, name in ((z >= high, "greatest", "layers= or far="), (z <= low, "least", "near=")):
        if there.sum() >= max(LEAST_AT_LIMIT, AT_LIMIT * z.size):
            warnings.append(
                f"Depth limit: {there.mean():.1%} of the pixels lie at the {what} depth that {name} allows."
                " If the surface goes on beyond it, depth around them is wrong, and std does not say so."
            )
    return warnings


def of_residual(pyramid: Pyramid, residual: np.ndarray, image: str = "image") -> list[str]:
    """Warnings that follow from the residual of an image, in the unit of the pyramid; ``image``: its name."""
    warnings = []
    rms = share_of_images(residual)
    too_bright = (residual < -TOO_BRIGHT * IMAGE_RMS) & (residual < -DEVIATIONS * pyramid.noise)
    if too_bright.mean() > TOO_MANY:
        why = "a larger albedo or brightness, or other sides, may be right."
        if residual.max() <= 0 and rms > 1 - UNLIT_MODEL:
            why = "no light of the source reaches the surface. Check where it is, and which way it shines."
        warnings.append(
            f"{image.capitalize()} brighter than the model can make it at {too_bright.mean():.0%} of the"
            f" pixels: {why}"
        )
    if rms > _by_noise(pyramid, POORLY, NOISE_TIMES) or _is_unlike_noise(pyramid, residual[None]):
        why = "; check sides, albedo and source; or the relief is finer than the resolution."
        if _worse_at_rim(residual):
            why = f", mostly near the border: check the sides (sides={pyramid.sides!r} was given)."
        off = f"{rms:.0%} of" if rms < 10 else f"{rms:.2g} times"
        warnings.append(f"Poorly explained: model and {image} differ by {off} the image (rms){why}")
    return warnings


def _by_noise(pyramid: Pyramid, rest: float, times: float) -> float:
    """Residual over the image (RMS) up to which so many times the noise, and the ``rest``, may raise it."""
    return math.hypot(rest, times * pyramid.noise / IMAGE_RMS)


def _is_unlike_noise(pyramid: Pyramid, residuals: np.ndarray) -> bool:
    """Whether residuals (n, rows, cols) are more than the noise of the images and POORLY, and neighbouring
    ones alike.
    """
    if share_of_images(residuals) <= _by_noise(pyramid, POORLY, RELIEF_TIMES):
        return False
    return correlation_of(residuals) > CORRELATED


def is_relief(pyramid: Pyramid, residuals: np.ndarray) -> bool:
    """Whether fine relief may have been taken for noise, and smoothed away, by what an answer leaves."""
    return pyramid.noise > LEAST_TAKEN * IMAGE_RMS and _is_unlike_noise(pyramid, residuals)


def correlation_of(residuals: np.ndarray) -> float:
    """Correlation of neighbours in residuals (n, rows, cols), over its standard deviation in white noise."""
    off = residuals - residuals.mean((1, 2), keepdims=True)
    pairs = np.concatenate([(off[:, 1:] * off[:, :-1]).ravel(), (off[:, :, 1:] * off[:, :, :-1]).ravel()])
    return float(pairs.mean() / np.mean(off**2) * math.sqrt(len(pairs)))


def of_ground(pyramid: Pyramid, residual: float) -> list[str]:
    """Warning that light between surfaces is not explained; residual: of all images, over their rms."""
    if not pyramid.interreflection or residual <= _by_noise(pyramid, UNSETTLED, NOISE_TIMES):
        return []
    return [
        f"Light between surfaces: model and image still differ by {residual:.1%} (rms). Its derivatives are"
        " approximate, and the error in deep bright places may be some layers; near= and far=, or a second"
        " image, reduce it."
    ]


def of_gaps(pyramid: Pyramid) -> list[str]:
    """Warning that gaps, and what is dark, are so wide that ground in them may hide light from others."""
    level = next((n for n in range(pyramid.coarsest) if pyramid.is_small(n)), pyramid.coarsest)
    away = 2**level * distance_from(lit(pyramid, level)).max()
    if away < max(WIDE_GAP * max(pyramid.shape(0)), LEAST_WIDE):
        return []
    return [
        f"Wide gap: no image counts, or shows light, within {away:.0f} nodes of some. Ground there may hide"
        " light from what the images show, so that depth around it is off too, and std may not say so."
    ]


def of_exposures(numbers: str, ratio: float) -> str:
    """Warning that the images of these numbers, of one light, differ in brightness by this factor."""
    return (
        f"Exposure: images {numbers} are of the same light, and the brightest is {ratio:.3g} times as bright"
        " as the darkest. Their mean is taken; divide them by their exposures. Of a coloured surface give one"
        " channel."
    )


def of_unit(albedo: float, with_ground: bool) -> list[str]:
    """Warning that light between surfaces cannot be known; ``albedo``: the median of that which was found."""
    if albedo <= IN_ANOTHER_UNIT:
        return []
    what = "is wrong" if with_ground else "is left out"
    return [
        f"Light between surfaces {what}: the albedo that was found is {albedo:.2g}, so the images are in"
        " another unit than the brightness of the sources. Divide them by their value of brightness 1."
    ]


def _worse_at_rim(residual: np.ndarray) -> bool:
    """Whether the mean square of a residual near the border is more than RIM_RATIO times that inside."""
    rim = np.ones(residual.shape, bool)
    edge = max(1, min(residual.shape) // RIM_PART)
    rim[edge:-edge, edge:-edge] = False
    if rim.all():
        return False
    return bool(np.mean(residual[rim] ** 2) > RIM_RATIO * np.mean(residual[~rim] ** 2))


def of_confidence(
    confidence: np.ndarray, ambiguous: np.ndarray, albedo_given: bool, place_is_known: bool = True
) -> list[str]:
    """Warnings that follow from the doubtful pixels; ``place_is_known``: whether of_place has none."""
    warnings = []
    if ambiguous.mean() >= AMBIGUOUS:
        warnings.append(
            f"Ambiguous: {ambiguous.mean():.1%} of the pixels fit several depths; give"
            " near= and far=, or a second image."
        )
    untold = (confidence < UNTRUSTED).mean()
    if not albedo_given and untold > UNTOLD:
        warnings.append(
            f"Depth depends on the albedo at {untold:.0%} of the pixels: these images hardly"
            " separate the two; add an image under a lamp, or give the albedo."
        )
    elif untold > UNTOLD and place_is_known and not warnings:
        warnings.append(
            f"Doubtful: the confidence of {untold:.0%} of the pixels is below {UNTRUSTED:g}. Give near= and"
            " far=, or an image under another light."
        )
    return warnings


def of_free_place(place: FreePlace | None, lights: Sequence[sources.Source]) -> list[str]:
    """A warning where lamps or windows leave the depth of the whole open."""
    if place is None:
        return []
    if len(lights) == 1:
        is_window = isinstance(lights[0], sources.Window)
        return [
            ("Window beside the map: " if is_window else "Lamp beside the map: ")
            + f"by {place.beside:.3g} nodes, so that surfaces which lie some nodes apart have nearly the same"
            " image; std and confidence include that."
        ]
    return [
        "Two lights over an unknown albedo: the line through both (a sky lies in the mean direction of its"
        " light) does not meet the map, so that surfaces which lie some nodes apart have nearly the same"
        " images; std and confidence include that."
    ]


def of_lamps_below(lost: float) -> list[str]:
    """A warning of light from below the level, this share of a lamp's (RMS over the mean)."""
    if lost <= BELOW:
        return []
    return [
        "Lamp below ground: the surface is higher than a part of the lamp, which it sees below its level. The"
        f" model leaves that light out, {lost:.1%} of all (RMS over the mean) where nothing occludes; images"
        " contain it, so depth is wrong there, and std does not say so."
    ]


def of_place(sides: str, lights: Sequence[sources.Source]) -> list[str]:
    """A warning where nothing tells how deep the surface as a whole lies."""
    is_known = sides == "dark" or not all(isinstance(light, sources.Sky) for light in lights)
    return [] if is_known else [ILL_POSED.format(sides.capitalize())]


def of_carving(
    image: np.ndarray, source: sources.Source, sides: str, drilled: np.ndarray, stop: str
) -> list[str]:
    """Warnings of the paper's method."""
    warnings = []
    if drilled.any():
        warnings.append(
            f"Drilled: {drilled.mean():.1%} of the columns never matched the image and were carved through to"
            " the back"
            + (
                "; columns that stop early shadow the rest. With stop='sign' fewer are drilled in most cases."
                if stop == "eps"
                else "; the image is darker there than the model at any depth."
            )
        )
    warnings += of_place(sides, [source])
    if count := count_of(image):
        warnings.append(
            f"Few counts: the image's values are multiples of {count:.2g} of its maximum, so changes of"
            " depth below one such step are lost."
        )
    return warnings


def count_of(image: np.ndarray) -> float:
    """The count of a coarsely quantized image, over its maximum; 0 if the values are no multiples of one."""
    steps = np.diff(np.unique(image))
    if not steps.size or steps.min() < 1 / FEWEST_COUNTS * image.max():
        return 0.0
    number = np.append(steps, image.max()) / steps.min()
    is_whole = np.abs(number - np.rint(number)).max() < WHOLE * number.max()
    return float(steps.min() / image.max()) if is_whole else 0.0
