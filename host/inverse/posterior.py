"""Posterior of depth by the linear model: Gaussian, of the Gauss-Newton Hessian at a surface."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np

from .descent import Descent
from .multigrid import CLOSE, ITERATIONS
from .resampling import blurred

# samples of the posterior. The deviation of a pixel is known to 1 / sqrt(2 PROBES) of itself, which is 25 %,
# before means over neighbours are taken; four make it 35 %, sixteen 18 % in twice the time
PROBES = 8
SEED = 0  # of the probes: the same in every call
NULL = 1e-9  # share of the largest eigenvalue below which one is 0: planes do not bend


def posterior_deviation(
    problem: Descent, z: np.ndarray, smoothness: float, sigma: float, probes: int = PROBES
) -> np.ndarray:
    """Posterior standard deviation (rows, cols) of depth [nodes] at z: the root of the diagonal of sigma^2
    inverse(transpose(J) J + smoothness transpose(D) D), J the derivative of the images at z, D second
    differences; sigma the deviation of white noise [unit of the images].

    It is the rms of ``probes`` samples, averaged over neighbours (Papandreou and Yuille 2010). What they
    leave of ``problem``, see posterior_samples.
    """
    samples = posterior_samples(problem, z, smoothness, sigma, probes)
    deviation: np.ndarray = np.sqrt(
        blurred(sum((sample**2 for sample in samples), np.zeros(z.shape)) / probes)
    )
    return deviation


def posterior_samples(
    problem: Descent, z: np.ndarray, smoothness: float, sigma: float, probes: int
) -> Iterator[np.ndarray]:
    """Samples (rows, cols) [nodes] of the posterior of depth by the linear model, less z: answers of the
    linear least-squares problem whose images and prior are disturbed by their own noise.

    Nodes at a bound move inwards alone. z is the prior's mean, so that noise alone moves it; afterwards the
    targets of ``problem`` are those disturbed last, and so is its prior.
    """
    images, generator = problem.irradiances(z), np.random.default_rng(SEED)
    for _ in range(probes):
        *noises, prior = 2.0 * generator.integers(0, 2, (len(images) + 1, *z.shape)) - 1.0
        targets = [image + sigma * noise for image, noise in zip(images, noises)]
        yield _answer(problem, z, smoothness, targets, sigma / math.sqrt(smoothness) * prior_sample(prior))


def shift_by(problem: Descent, z: np.ndarray, smoothness: float, errors: list[np.ndarray]) -> np.ndarray:
    """How far errors of the images (rows, cols) [unit of the images] move depth (rows, cols) [nodes] at z,
    by the linear model. What is left of ``problem``: see posterior_samples.
    """
    targets = [image + error for image, error in zip(problem.irradiances(z), errors)]
    return _answer(problem, z, smoothness, targets, np.zeros(z.shape))


def _answer(
    problem: Descent, z: np.ndarray, smoothness: float, targets: list[np.ndarray], prior: np.ndarray
) -> np.ndarray:
    """The linear answer to ``targets``, less z, where the prior's mean is z + ``prior``."""
    problem.set_targets(targets)
    problem.set_prior(z + prior)
    problem.value(z, 0.0)
    return problem.step(smoothness, ITERATIONS, CLOSE[0])


def prior_sample(white: np.ndarray) -> np.ndarray:
    """A surface (rows, cols) whose covariance is the pseudo-inverse of transpose(D) D, where that of
    ``white`` is 1. D^T D is a sum of a matrix along rows and one along columns: their eigenvectors do.
    """
    (along_rows, rows), (along_cols, cols) = (_bending(size) for size in white.shape)
    stiffness = along_rows[:, None] + along_cols
    bends = stiffness > NULL * max(float(stiffness.max()), 1.0)
    sample: np.ndarray = rows @ np.where(bends, white / np.sqrt(np.where(bends, stiffness, 1)), 0) @ cols.T
    return sample


@functools.cache
def _bending(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and eigenvectors of transpose(D) D along a line of so many nodes."""
    second = np.diff(np.eye(size), 2, axis=0) if size > 2 else np.zeros((1, size))
    values, vectors = np.linalg.eigh(second.T @ second)
    return np.maximum(values, 0), vectors
