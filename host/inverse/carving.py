"""The paper's method: columns are carved a layer at a time (Langer and Zucker, section 6, Eq. 4)."""

from __future__ import annotations

import numpy as np

from .. import sources
from ..backends.base import Backend
from ..backends.resident import upload
from ..directions import Hemicube
from ..light.propagation import Problem, Progress, carve
from ..scene import Scene

LARGEST_SUM = 2**30  # of weights, and so of light, in carving's whole numbers


def carved_layers(
    engine: Backend,
    image: np.ndarray,
    source: sources.Source,
    start: Scene,
    layers: int,
    cube: Hemicube,
    eps: float,
    stop: str,
    progress: Progress | None,
) -> np.ndarray:
    """Depth (rows, cols) in whole layers; ``layers`` where a column was drilled. ``start``: the scene at
    depth 0, with the image's spacing, albedo and sides.
    """
    low, high, weights = carving_integers(
        image,
        start.albedo,
        sources.radiance(source, cube.directions),
        cube.solid_angles,
        eps if stop == "eps" else 0.0,
    )
    # A ball must not lie below the surface that carving starts from; a volume may go down with it.
    scene = start
    if isinstance(source, sources.Lamp) and source.volume is not None:
        deepest = np.full(image.shape, float(layers) * start.spacing)
        scene = Scene(deepest, start.spacing, start.albedo, None, start.sides)
    flat = upload(engine, np.zeros(image.shape, np.float32), 1.0, 0.0, 0.0)
    problem = Problem(flat, 1.0, start.sides, cube.steps, sources.geometry(source, scene, 1.0))
    return carve(engine, problem, low, high, weights, layers, stop == "sign", progress)


def carving_integers(
    image: np.ndarray,
    albedo: float | np.ndarray,
    brightness: np.ndarray,
    solid_angles: np.ndarray,
    eps: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(low, high) (rows, cols) and weights (D,), int32: image - eps max(image), image + eps max(image) and B
    dOmega / (2 pi) of Eq. 4 in one unit. The albedo, which may be a map, divides the image instead of
    multiplying the weights.
    """
    target = image / np.asarray(albedo, float)
    slack = eps * image.max() / np.asarray(albedo, float)
    light = brightness * solid_angles / (2 * np.pi)
    scale = LARGEST_SUM / max(light.sum(), np.max(target + slack))

    def whole(values: np.ndarray) -> np.ndarray:
        integers: np.ndarray = np.rint(values * scale).astype(np.int64)
        return integers

    middle, width = whole(target), np.broadcast_to(whole(slack), target.shape)
    return (middle - width).astype(np.int32), (middle + width).astype(np.int32), whole(light).astype(np.int32)
