"""Horizons of a surface, and the terrain attributes made of them: sky-view factor and openness."""

from __future__ import annotations

import numpy as np

from .arrays import labelled, multiply
from .backends.resident import DeviceImage
from .checks import one_of
from .directions import Azimuths
from .errors import bad
from .light.sweeps import FINE_NEAR_ROWS, Rays, Sweeps, engine_of, ground_of
from .scene import Scene, is_scene

DEFINITIONS = ("tilted", "horizontal", "solid_angle")
RUNGS = 1025  # of the tables that turn slopes into sums


def horizons(
    scene: Scene, azimuths: int | Azimuths = 64, backend: str = "auto", *, max_distance: float | None = None
) -> np.ndarray:
    """The horizon's slope, tangent of its elevation, at every node: (azimuths, rows, cols) float32.

    Azimuth a looks along 2 pi (a + 1/2) / azimuths [rad] from +x (columns) towards +y (rows). Slopes may be
    negative; they are -inf where no ground lies that way, and nan where the scene is masked. A scene made
    from an xarray.DataArray gives a DataArray with the coordinate ``azimuth`` [rad]; this holds for
    sky_view_factor and openness too. The surface is linear between neighbouring nodes along rows and along
    columns. ``max_distance`` [unit of spacing]: ground farther away does not count; the whole map does unless
    given (on a map that repeats, as far as its relief makes a slope of 0.01). With dark sides the wall counts
    as ground.

    Raises InputError, BackendError or CapacityError.
    """
    azimuths = as_azimuths(azimuths)
    engine = engine_of(scene, backend)
    with engine.lock:
        slopes = Sweeps(
            engine,
            ground_of(scene, max_distance, engine),
            Rays(azimuths.angles, azimuths.widths),
            near=FINE_NEAR_ROWS,
        ).slopes()
    if scene.mask is not None:
        slopes[:, ~scene.mask] = np.nan
    found: np.ndarray = labelled(slopes, scene.labels, azimuth=azimuths.angles)
    return found


def sky_view_factor(
    scene: Scene,
    definition: str = "tilted",
    azimuths: int | Azimuths = 64,
    backend: str = "auto",
    *,
    max_distance: float | None = None,
) -> np.ndarray:
    """Share of the sky that every node sees: (rows, cols) float32, 0 to 1, nan where the scene is masked.

    ``definition``, with h the horizon's elevation, not below 0:

    - "tilted": the cosine-weighted share of the tilted surface, E / (pi B) under a uniform sky, which ends at
      the tangent plane (Dozier and Frew 1990; topocalc, HORAYZON).
    - "horizontal": the same for a horizontal element at the node, mean of cos^2 h over azimuth.
    - "solid_angle": the share of the hemisphere's solid angle, 1 - mean of sin h (Zaksek, Ostir and Kokalj
      2011; RVT, xarray-spatial).

    Other arguments and errors as for :func:`horizons`.
    """
    one_of(definition, DEFINITIONS, "definition")
    sine = np.linspace(0, 1, RUNGS)
    share = {"tilted": None, "horizontal": (1 - sine**2) / 2, "solid_angle": 1 - sine}[definition]
    scale = 1 / np.pi if definition != "solid_angle" else 1 / (2 * np.pi)
    image = _sum(scene, share, azimuths, backend, max_distance, float(scale))
    found: np.ndarray = labelled(image, scene.labels)
    return found


def openness(
    scene: Scene,
    azimuths: int | Azimuths = 64,
    backend: str = "auto",
    *,
    negative: bool = False,
    max_distance: float | None = None,
) -> np.ndarray:
    """Topographic openness (Yokoyama, Shirasawa and Pike 2002) [rad].

    The mean over azimuth of the angle from the zenith to the horizon: (rows, cols) float32; more than pi / 2
    on peaks, nan where masked. ``negative``: of the surface turned upside down, the mean angle from the
    nadir. Where no ground lies along an azimuth the horizon counts as level. Other arguments and errors as
    for :func:`horizons`.
    """
    is_scene(scene)
    labels = scene.labels
    if not isinstance(negative, (bool, np.bool_)):
        raise bad("openness: negative", repr(negative), "True or False")
    if negative:
        scene = Scene.from_height(scene.depth, scene.spacing, mask=scene.mask, sides=scene.sides)
    azimuths = as_azimuths(azimuths)
    engine = engine_of(scene, backend)
    with engine.lock:
        rays = Rays(azimuths.angles, azimuths.widths)
        image = Sweeps(engine, ground_of(scene, max_distance, engine), rays, near=FINE_NEAR_ROWS).openness()
    if scene.mask is not None:
        image[~scene.mask] = np.nan
    found: np.ndarray = labelled(image, labels)
    return found


def as_azimuths(azimuths: int | Azimuths) -> Azimuths:
    return azimuths if isinstance(azimuths, Azimuths) else Azimuths(azimuths)


def _sum(
    scene: Scene,
    share: np.ndarray | None,
    azimuths: int | Azimuths,
    backend: str,
    max_distance: float | None,
    scale: float,
) -> np.ndarray | DeviceImage:
    """Sum over azimuths of ``share``, a function of the horizon's sine, on level elements, times ``scale``.

    None: light, the irradiance of a uniform sky of brightness 1 on the tilted surface.
    """
    azimuths = as_azimuths(azimuths)
    table = None
    if share is not None:
        table = np.zeros((len(azimuths), len(share), 4), np.float32)
        table[:, :, 1] = share
        table[:, :-1, 3] = np.diff(share)
    engine = engine_of(scene, backend)
    with engine.lock:
        rays = Rays(azimuths.angles, azimuths.widths)
        sweeps = Sweeps(engine, ground_of(scene, max_distance, engine), rays, table, level=share is not None)
        if scene.stays_on(engine):
            found = sweeps.image()
            found.shade(scene.on(engine), 1.0, scale)
            return found
        image = sweeps.irradiance(last=True)
    multiply(image, scale)
    if scene.mask is not None:
        image[~scene.mask] = np.nan
    return image
