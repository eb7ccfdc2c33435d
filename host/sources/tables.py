"""A sky's brightness by azimuth, and as cumulative tables over elevation, from samples."""

from __future__ import annotations

import functools

import numpy as np

from .brightness import Distribution, directions_of
from .shapes import Source, distribution_of, radiance

# samples of a sky: a sun half a degree wide gets two or three
SAMPLE_AZIMUTHS, SAMPLE_ELEVATIONS = 2048, 192
TABLE_KNOTS = 1024  # of a table of brightness, evenly in the diamond angle of the elevation
TABLE_POINTS = 4  # of Gauss-Legendre quadrature between two knots
PLACED_FROM = 2.0  # brightest azimuth over the mean from which azimuths are placed by brightness
GOLDEN = 0.6180339887498949  # 1 / golden ratio: its multiples spread evenly over 0 to 1, modulo 1
# directions whose brightness is evaluated at a time: more would leave the cache, fewer need more calls
EVALUATION_BATCH = 2**13


def varying(source: Source) -> Distribution:
    """The brightness of a source, which depends on the direction."""
    brightness = distribution_of(source)
    assert brightness is not None, "its brightness varies"
    return brightness


def azimuth_profile(source: Source) -> np.ndarray | None:
    """Light that comes from each of many even sectors of azimuth, (2048,); None where it hardly varies.

    ``source``: a sky whose brightness depends on the direction.
    """
    return (_kept_profile if varying(source).by_formula() else _profile)(source)


def _profile(source: Source) -> np.ndarray | None:
    """From some 400,000 directions, evenly in azimuth and elevation; of a coarser environment map, four along
    each side of a pixel.
    """
    image = varying(source).equirectangular()
    rows, cols = (SAMPLE_ELEVATIONS, SAMPLE_AZIMUTHS) if image is None else image.shape[:2]
    azimuths, elevations = (
        min(most, max(most // 4, n))
        for most, n in zip((SAMPLE_AZIMUTHS, SAMPLE_ELEVATIONS), (4 * cols, 2 * rows))
    )
    azimuth = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    shift = GOLDEN * np.arange(azimuths) % 1  # so that no small sun slips between rows of samples
    # of the elevation
    part, whole = (np.pi / 2 / elevations * a for a in (shift[:, None], np.arange(elevations)))
    sine = np.cos(part) * np.sin(whole) + np.sin(part) * np.cos(whole)
    light = np.empty_like(sine)
    for some in np.array_split(np.arange(azimuths), -(-sine.size // EVALUATION_BATCH)):
        light[some] = radiance(source, directions_of(azimuth[some, None], sine[some]))
    profile = np.einsum("ae,ae->a", light, np.sqrt(1 - sine**2))
    if profile.max() <= PLACED_FROM * profile.mean():
        return None
    # the edge of a sun lies between samples
    widest: np.ndarray = np.maximum.reduce([np.roll(profile, n) for n in range(-2, 3)])
    return widest


_kept_profile = functools.lru_cache(16)(_profile)  # of skies whose values never change


def diamond(elevation: np.ndarray) -> np.ndarray:
    """The diamond angle of elevations [rad]: sine / (sine + cosine), 0 at the horizon and 1 at the zenith.

    It is tangent / (1 + tangent), which needs no root, and grows by 0.5 to 1 per radian, so that even steps
    of it resolve all elevations.
    """
    ratio: np.ndarray = np.sin(elevation) / (np.sin(elevation) + np.cos(elevation))
    return ratio


def diamond_azimuths(count: int) -> np.ndarray:
    """Azimuths (count,) [rad], -pi to pi, evenly in the diamond angle round the circle, from +x to +y."""
    place = 4 * np.arange(count) / count
    cosine = np.where(place < 2, 1 - place, place - 3)
    sine = np.where(place < 1, place, np.where(place < 3, 2 - place, place - 4))
    azimuths: np.ndarray = np.arctan2(sine, cosine)
    return azimuths


def elevation_of(at: np.ndarray) -> np.ndarray:
    """The elevations [rad] whose diamond angle is ``at``, 0..1."""
    elevation: np.ndarray = np.arctan2(at, 1 - at)
    return elevation


def elevation_table(
    source: Source, angles: np.ndarray, widths: np.ndarray, samples: int = 256, knots: int = TABLE_KNOTS
) -> np.ndarray:
    """Brightness as sweeps take it, (K, knots, 4) float32.

    The integrals of B cos^2 and of B sin cos over elevation, from the diamond angle i / (knots - 1) to the
    zenith, averaged over each sector, and their differences to the next knot. Within each sector as many
    azimuths as make some ``samples`` in all.
    """
    within = max(1, -(-samples // len(angles)))
    azimuth = angles[:, None] + widths[:, None] * ((np.arange(within) + 0.5) / within - 0.5)
    nodes, weights = np.polynomial.legendre.leggauss(TABLE_POINTS)
    low = np.arange(knots - 1)[:, None]
    at = (low + (nodes + 1) / 2) / (knots - 1)
    cosines, sines = np.cos(elevation_of(at)), np.sin(elevation_of(at))
    sine = sines.ravel()
    total = np.empty((len(angles), sine.size))
    for some in np.array_split(
        np.arange(len(angles)), min(len(angles), -(-azimuth.size * sine.size // EVALUATION_BATCH))
    ):
        total[some] = radiance(source, directions_of(azimuth[some, :, None], sine)).mean(1)
    per_knot = weights / 2 / (knots - 1) * (sines + cosines) ** 2  # of elevation [rad]
    light = total.reshape(len(angles), knots - 1, TABLE_POINTS) * per_knot
    parts = np.stack([(light * cosines**2).sum(-1), (light * sines * cosines).sum(-1)], -1)
    table = np.zeros((len(angles), knots, 4))
    table[:, :-1, :2] = np.cumsum(parts[:, ::-1], 1)[:, ::-1]
    table[:, :-1, 2:] = table[:, 1:, :2] - table[:, :-1, :2]
    return table.astype(np.float32)
