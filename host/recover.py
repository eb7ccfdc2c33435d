"""recover(): depth from one image, by the paper's inverse algorithm (Eq. 4)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from . import sources
from .backends import select
from .backends.base import Problem, Progress
from .directions import Hemicube
from .errors import bad
from .render import timed
from .scene import Scene, at, one_of, positive_number, real_array

METHODS = ("paper",)
STOPS = ("eps", "sign")
UNIT = 2**30  # the largest sum of weights, and so of light, in carving's whole numbers


@dataclass(frozen=True, eq=False)
class Recovery:
    """What recover() gives.

    depth (rows, cols) float32 [unit of spacing]; drilled (rows, cols) bool: columns that were carved through to the back
    without ever matching the image; backend (its name); seconds without compiling, compile_seconds; warnings.
    """

    depth: np.ndarray
    drilled: np.ndarray
    backend: str
    seconds: float
    compile_seconds: float
    warnings: list[str] = field(default_factory=list)


def recover(image, source: sources.Source, albedo=0.8, sides: str = "open", spacing: float = 1.0, layers: int = 64, hemicube: int | Hemicube = 9,
            method: str = "paper", eps: float = 0.02, stop: str = "eps", backend: str = "auto", *, progress: Progress | None = None) -> Recovery:
    """Depth from one image by carving (Langer and Zucker, section 6, inverse algorithm, Eq. 4).

    All columns start at depth 0 and go down a layer at a time while their luminance, with N.L replaced by 1/2, does not
    match the image. Luminance, image and eps are compared as whole numbers, so every backend decides alike.

    Parameters
    ----------
    image : (rows, cols) real array
        Radiance, in the unit of the source's brightness. Finite, >= 0.
    source, sides, spacing, albedo
        As in the scene that the image shows; ``albedo`` a number or (rows, cols), > 0. A lamp must lie above z = 0 or be
        given as a volume that starts at layer 0, since carving starts from a surface at z = 0.
    layers : int
        The lattice's depth; a column that comes to ``layers`` was drilled through.
    method : "paper"
    eps : float
        With stop="eps": a column stops where |B - I| <= eps x max(image).
    stop : "eps" or "sign"
        ``sign``: a column stops at the first layer where B equals I or has passed it; on most scenes this drills fewer columns.
    progress : callable, optional
        Called with (layers done, layers).

    Raises
    ------
    InputError, BackendError, CapacityError
    """
    image = real_array(image, "image")
    wrong = ~(np.isfinite(image) & (image >= 0))
    if wrong.any():
        raise bad(f"image: {wrong.sum()} values are negative, NaN or infinite, first {at(wrong)}", image[wrong][0], "finite radiance >= 0")
    if image.max() < np.finfo(np.float32).tiny:
        raise bad("image: black everywhere", f"maximum {image.max()}", "at least one lit pixel")
    one_of(method, METHODS, "method")
    one_of(stop, STOPS, "stop")
    if isinstance(layers, bool) or not isinstance(layers, (int, np.integer)) or not 1 <= layers < 2**20:
        raise bad("layers", repr(layers), "a whole number from 1 to 1048575")
    eps = positive_number(eps, "eps")
    cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(hemicube)
    start = Scene(np.zeros(image.shape), spacing, albedo, None, sides)
    if np.any(np.asarray(start.albedo) <= 0):
        raise bad("albedo", 0.0, "> 0: a black surface tells nothing of its depth")
    low, high, weights = carving_integers(image, start.albedo, sources.radiance(source, cube.directions), cube.solid_angles, eps if stop == "eps" else 0.0)
    engine = select(backend)
    # A ball must not lie below the surface that carving starts from; a volume may go down with it.
    deep = Scene(np.full(image.shape, float(layers) * spacing), spacing, albedo, None, sides)
    volume = isinstance(source, sources.Lamp) and source.volume is not None
    problem = Problem(np.zeros(image.shape, np.float32), 1.0, sides, cube.steps, sources.geometry(source, deep if volume else start, 1.0))
    (depth,), seconds, compiling = timed(engine, lambda: (engine.carve(problem, low, high, weights, int(layers), stop == "sign", progress),))
    drilled = depth >= layers
    warnings = []
    if drilled.any():
        warnings.append(f"Drilled: {drilled.mean():.1%} of the columns never matched the image and were carved through to the back"
                        + ("; one that stops early shadows the rest. stop='sign' often drills fewer." if stop == "eps" else "; the image is darker there than any depth explains."))
    if sides == "open" and isinstance(source, sources.Sky):
        warnings.append("Open sides under a sky are ill-posed: a flat surface explains a plane's image at any depth.")
    if step := _count(image):
        warnings.append(f"Few counts: the image's values are multiples of {step:.2g} of its maximum, so depth can be no finer than what changes it by that.")
    return Recovery((depth * spacing).astype(np.float32), drilled, engine.name, seconds, compiling, warnings)


COARSE = 1 / 200  # of the maximum: an image of fewer counts is coarser than the paper's eps


def _count(image) -> float:
    """The count of a coarsely quantized image, over its maximum; 0 where its values are no multiples of one."""
    steps = np.diff(np.unique(image))
    if not steps.size or steps.min() < COARSE * image.max():
        return 0.0
    number = np.append(steps, image.max()) / steps.min()
    return float(steps.min() / image.max()) if np.abs(number - np.rint(number)).max() < 1e-3 * number.max() else 0.0


def carving_integers(image, albedo, brightness, solid_angles, eps: float):
    """(low, high) (rows, cols) and weights (D,), int32: image - eps max(image), image + eps max(image) and B dOmega / (2 pi)
    of Eq. 4 in one unit. The albedo, which may be a map, divides the image instead of multiplying the weights."""
    target = image / np.asarray(albedo, float)
    slack = eps * image.max() / np.asarray(albedo, float)
    light = brightness * solid_angles / (2 * np.pi)
    unit = UNIT / max(light.sum(), np.max(target + slack))
    whole = lambda values: np.rint(np.broadcast_to(values * unit, np.shape(values))).astype(np.int64)
    middle, width = whole(target), np.broadcast_to(whole(slack), target.shape)
    return (middle - width).astype(np.int32), (middle + width).astype(np.int32), whole(light).astype(np.int32)
