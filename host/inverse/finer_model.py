"""The surface again, by a model that is finer than the grid.

Where the search ends in the right surface, the error of the model limits depth: a grid knows the surface at
its nodes alone, and few azimuths. A grid three times as fine, on the smooth surface through the nodes, tells
by how much the model is off; the surface is fitted again with that put right (deferred correction).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..light.interreflection import Round
from .descent import Descent
from .multigrid import CLOSE, ITERATIONS
from .pyramid import NEAREST, Pyramid, noise_at, on_coarser_grid
from .resampling import cubic

FINER, FINER_AZIMUTHS = 3, 64  # refinement, azimuths
FINER_RAYS = Round(64, 1, 64, 0.03)  # of the light between surfaces
REFITS, REFIT_STEPS = 2, 4  # fits to the finer model, and Gauss-Newton steps of each
LEAST_VARIANCE = 1e-14  # of noise [unit of the pyramid's images, squared]: what float32 leaves


class Refit(NamedTuple):
    """Depth (rows, cols) [nodes of its grid] by the finer model.

    residuals (rows, cols): images by that model less the images, in the unit of the pyramid. share: variance
    of the model's error over the sum of that and of the noise, which the finer model takes for relief.
    """

    depth: np.ndarray
    residuals: list[np.ndarray]
    share: float


def refit_of(pyramid: Pyramid, level: int, z: np.ndarray) -> Refit:
    """What depth is on grid ``level`` if the images are of the smooth surface through its nodes.

    z: the depth if they are of the nodes alone. The albedo is known.
    """
    problem, images, model = pyramid.problem(level), pyramid.images[level], _finer_model(pyramid, level)
    middle = slice(FINER // 2, None, FINER)
    smoothness = pyramid.smoothness(level)
    pyramid.set_prior(level, on_coarser_grid(z))
    depth, targets = z, images
    for _ in range(REFITS):
        fine = model.irradiances(np.maximum(FINER * cubic(depth, FINER), NEAREST))
        coarse = problem.irradiances(depth)
        errors = [own - other[middle, middle] for own, other in zip(coarse, fine)]
        targets = [image + error for image, error in zip(images, errors)]
        problem.set_targets(targets)
        depth = problem.run(depth, smoothness, REFIT_STEPS, ITERATIONS, *CLOSE, pyramid.stop).depth
    residuals = [light - target for light, target in zip(problem.irradiances(depth), targets)]
    problem.set_targets(images)
    of_model = float(np.mean(np.square(errors, dtype=np.float64)))
    share = of_model / (of_model + noise_at(pyramid, level) ** 2 + LEAST_VARIANCE)
    return Refit(depth, residuals, share)


def _finer_model(pyramid: Pyramid, level: int) -> Descent:
    rows, cols = pyramid.shape(level)
    shape = FINER * rows, FINER * cols
    lights = pyramid.lights(shape, FINER * 0.5**level, FINER_AZIMUTHS)
    sent = pyramid.radiances(level)
    return Descent(
        pyramid.engine,
        shape,
        pyramid.sides,
        [
            (
                light,
                np.kron(pyramid.albedo[level] * weight / (math.pi * scale), np.ones((FINER, FINER))),
                np.zeros(shape),
            )
            for light, scale, weight in zip(lights, pyramid.scales, pyramid.weights[level])
        ],
        np.zeros(shape),
        np.full(shape, FINER * pyramid.bounds[level][1].max()),
        radiances=sent and [np.maximum(cubic(image, FINER), 0) for image in sent],
        rays=FINER_RAYS,
        strips=1,
    )
