"""Horizons of a surface, and the terrain attributes made of them: sky-view factor and openness."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from .arrays import Quantity, labelled, labels_of, multiply
from .backends.base import Backend, available_memory
from .backends.resident import DeviceImage
from .checks import one_of, positive_number
from .directions import Azimuths, angles_on
from .errors import CapacityError, bad
from .light.far import Far, Tiling
from .light.sweeps import FINE_NEAR_ROWS, Rays, Sweeps, engine_of, ground_of
from .render_options import sectors_of
from .samples import least_slope, samples_of
from .scale import limited, over_tiles
from .scene import Scene, check_scene
from .sources.tables import elevation_of

LARGE = 2**28  # [byte] below which free memory is not looked up; chosen: that takes .15 ms
SLOPE = Quantity("horizon_slope", "1", "tangent of the elevation of the horizon")
VIEW = {
    "tilted": Quantity("sky_view_factor", "1", "sky-view factor of the tilted surface, cosine-weighted"),
    "horizontal": Quantity(
        "sky_view_factor", "1", "sky-view factor of a horizontal element, cosine-weighted"
    ),
    "solid_angle": Quantity("sky_view_factor", "1", "visible share of the hemisphere's solid angle"),
}
OPENNESS = {
    False: Quantity("openness", "rad", "mean angle from the zenith to the horizon"),
    True: Quantity("negative_openness", "rad", "mean angle from the nadir to the horizon, seen from below"),
}
AZIMUTH_ATTRIBUTES = {"units": "rad", "long_name": "azimuth from east towards south"}
RUNGS = 1025  # of the tables that turn slopes into sums


def horizons(
    scene: Scene,
    azimuths: int | Azimuths = 64,
    backend: str = "auto",
    *,
    max_distance: float | None = None,
    tiling: Tiling | None = None,
    max_seconds: float | None = None,
) -> np.ndarray:
    """The horizon's slope, tangent of its elevation, at every node: (azimuths, rows, cols) float32.

    Azimuth a looks along 2 pi (a + 1/2) / azimuths [rad] from +x (columns) towards +y (rows). Slopes may be
    negative; they are -inf where no ground lies that way, and nan where the scene is masked. The surface is
    linear between neighbouring nodes along rows and along columns. ``max_distance`` [unit of spacing]: ground
    farther away does not count; the whole map does unless given (on a map that repeats, as far as its relief
    makes a slope of 0.01). With dark sides the wall counts as ground, at any distance.

    Within 12 rows (12 columns for azimuths nearer to a row), and so with a ``max_distance`` of 12 spacings,
    every crossing with a row or a column is met: slopes are exact but for rounding. Farther away the sweep
    looks up three crossings alone: the best for two slopes, and the one that stands highest
    (docs/explanation/methods.md). It may miss the highest;
    slopes are then too low, never too high. The RMS error is about 0.0002 rad on mountains and 0.002 on rough
    ground; a tower or cliff few nodes wide may be missed by single nodes altogether, in all its height.
    :func:`sky_view_factor` has 6 exact rows below 128 azimuths.

    A scene made from an xarray.DataArray gives a DataArray with the coordinate ``azimuth`` [rad], from east,
    where its x grows, towards south, where its y falls, whatever the order of its rows. A DataArray
    of heights may be given in place of a scene: the spacing is that of its coordinates, and nan are masked.
    Results have their own name, ``units`` and ``long_name``. This holds for sky_view_factor and openness too.

    A lazy scene gives a lazy array of the map's own chunks. It is computed in tiles, as is a map beyond the
    device's memory, and any map with a ``tiling``: ground beyond a tile's halo comes from overviews, which
    moves horizons by 0.002 rad and sky-view factors by 0.0002 RMS on mountains (docs/howto/large-maps.md).

    ``max_seconds``: OutOfTimeError once they are over, compiling apart; they are looked at before each launch
    of a kernel. Not of a lazy scene.

    Raises InputError, BackendError, CapacityError or OutOfTimeError.

    Returns
    -------
    (azimuths, rows, cols) float32 [tangent]
        A NumPy array, DataArray or lazy array, as the scene is; a DeviceImage where its map lies on a GPU.

    Examples
    --------
    >>> wall = np.zeros((3, 9))
    >>> wall[:, 6] = 2.0
    >>> east = sl.Azimuths(1, edges=(-np.pi, np.pi))  # along its middle, +x
    >>> sl.horizons(sl.Scene.from_height(wall), east)[0, 1, :6]
    array([0.33333334, 0.4       , 0.5       , 0.6666667 , 1.        ,
           2.        ], dtype=float32)
    """
    scene = _scene_of(scene)
    azimuths = sectors_of(azimuths)
    needed = 4 * azimuths.count * math.prod(scene.shape)
    if (
        scene.lazy is None
        and scene.resident is None
        and needed > LARGE
        and needed > (free := available_memory())
    ):
        raise CapacityError(f"Horizons take {needed:,} bytes; {free:,} are free. Ask for fewer azimuths.")
    work = partial(_slopes, azimuths=azimuths, backend=backend, axes=scene.axes)
    with limited(max_seconds, "horizons", scene, backend):
        mapped: Any = over_tiles(work, scene, tiling, max_distance, backend, SLOPE, azimuth=azimuths.angles)
    if scene.labels is not None:
        mapped.coords["azimuth"].attrs.update(AZIMUTH_ATTRIBUTES)
    slopes: np.ndarray = mapped
    return slopes


def horizon_at(
    scene: Scene, row: int, col: int, angles: np.ndarray, backend: str, max_distance: float | None
) -> np.ndarray:
    """The horizon's slope at one node, at least 0, by exact rays along ``angles`` [rad] of the map's axes:
    (azimuths,) float64.
    """
    scene, engine = scene.under_sky(), engine_of(scene, backend)
    reach = (
        math.inf if max_distance is None else positive_number(max_distance, "max_distance") / scene.spacing
    )
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    with engine.lock:
        samples = samples_of(engine, scene)
        samples.set_nodes(np.array([col]), np.array([row]))
        return samples.slopes(cosine, sine, least_slope(samples, cosine, sine), reach=reach)[:, 0]


def _slopes(
    scene: Scene,
    max_distance: float | None,
    far: Far | None,
    part: slice = slice(None),
    *,
    azimuths: Azimuths,
    backend: str,
    axes: tuple[float, float],
) -> Any:
    """Slopes of ``part`` of the azimuths, which a map with other ``axes`` has elsewhere, see ``Scene.axes``.

    Every azimuth's are the same whatever the others are.
    """
    engine = engine_of(scene, backend)
    with engine.lock:
        rays = Rays(angles_on(axes, azimuths.angles[part]), azimuths.widths[part])
        ground = ground_of(scene, max_distance, engine)
        sweeps = Sweeps(engine, ground, rays, near=FINE_NEAR_ROWS, far=far)
        if scene.stays_on(engine):
            return sweeps.device_slopes()
        slopes = sweeps.slopes()
    if scene.mask is not None:
        slopes[:, ~scene.mask] = np.nan
    return slopes


def sky_view_factor(
    scene: Scene,
    definition: str = "tilted",
    azimuths: int | Azimuths = 64,
    backend: str = "auto",
    *,
    max_distance: float | None = None,
    tiling: Tiling | None = None,
    max_seconds: float | None = None,
) -> np.ndarray:
    """Share of the sky visible from every node: (rows, cols) float32, 0 to 1, nan where the scene is masked.

    ``definition``, with h the horizon's elevation, not below 0:

    - "tilted": the cosine-weighted share of the tilted surface, E / (pi B) under a uniform sky, which ends at
      the tangent plane (Dozier and Frew 1990; topocalc, HORAYZON).
    - "horizontal": the same for a horizontal element at the node, mean of cos^2 h over azimuth.
    - "solid_angle": the share of the hemisphere's solid angle, 1 - mean of sin h (Zaksek, Ostir and Kokalj
      2011; RVT, xarray-spatial).

    Other arguments and errors as for :func:`horizons`.

    Returns
    -------
    (rows, cols) float32 [1]
        A NumPy array, DataArray or lazy array, as the scene is.

    Examples
    --------
    >>> pit = np.zeros((3, 3))
    >>> pit[1, 1] = -1.0  # eight neighbours one spacing above it
    >>> sl.sky_view_factor(sl.Scene.from_height(pit)).round(1)
    array([[1. , 0.9, 1. ],
           [0.9, 0.6, 0.9],
           [1. , 0.9, 1. ]], dtype=float32)
    """
    one_of(definition, tuple(VIEW), "definition")
    scene = _scene_of(scene)
    sectors = sectors_of(azimuths, scene.axes)
    work = partial(sky_view, definition=definition, azimuths=sectors, backend=backend)
    with limited(max_seconds, "sky_view_factor", scene, backend):
        factor: np.ndarray = over_tiles(work, scene, tiling, max_distance, backend, VIEW[definition])
    return factor


def sky_view(
    scene: Scene,
    max_distance: float | None,
    far: Far | None,
    *,
    definition: str,
    azimuths: Azimuths,
    backend: str,
) -> Any:
    """The sky-view factor, a sum over azimuths of a function of the horizon's elevation, or of light."""
    sine = np.sin(elevation_of(np.linspace(0, 1, RUNGS)))
    share = {"tilted": None, "horizontal": (1 - sine**2) / 2, "solid_angle": 1 - sine}[definition]
    table = None
    if share is not None:
        table = np.zeros((len(azimuths), len(share), 4), np.float32)
        table[:, :, 1] = share
        table[:, :-1, 3] = np.diff(share)
    engine = engine_of(scene, backend)
    with engine.lock:
        ground, rays = ground_of(scene, max_distance, engine), Rays(azimuths.angles, azimuths.widths)
        sweeps = Sweeps(engine, ground, rays, table, level=share is not None, far=far)
        return _sum_of(scene, engine, sweeps, 1 / (2 * np.pi) if definition == "solid_angle" else 1 / np.pi)


def _sum_of(scene: Scene, engine: Backend, sweeps: Sweeps, scale: float) -> Any:
    """The sum over all azimuths times ``scale``, (rows, cols) float32, nan where masked."""
    if scene.stays_on(engine):
        there = sweeps.image()
        there.shade(scene.on(engine), 1.0, scale)
        there.held = None
        return there
    image = sweeps.irradiance()
    multiply(image, scale)
    if scene.mask is not None:
        image[~scene.mask] = np.nan
    return image


def openness(
    scene: Scene,
    azimuths: int | Azimuths = 64,
    backend: str = "auto",
    *,
    negative: bool = False,
    max_distance: float | None = None,
    tiling: Tiling | None = None,
    max_seconds: float | None = None,
) -> np.ndarray:
    """Topographic openness (Yokoyama, Shirasawa and Pike 2002) [rad].

    The mean over azimuth of the angle from the zenith to the horizon: (rows, cols) float32; more than pi / 2
    on peaks, nan where masked. ``negative``: of the surface turned upside down, the mean angle from the
    nadir. Where no ground lies along an azimuth the horizon counts as level. Other arguments and errors as
    for :func:`horizons`.

    Returns
    -------
    (rows, cols) float32 [rad]
        A NumPy array, DataArray or lazy array, as the scene is.

    Examples
    --------
    >>> flat = sl.Scene.from_height(np.zeros((5, 5)))
    >>> round(float(sl.openness(flat, 8)[2, 2]), 4)
    1.5708
    """
    scene = _scene_of(scene)
    if not isinstance(negative, (bool, np.bool_)):
        raise bad("openness: negative", repr(negative), "True or False")
    if negative:
        turned = _upside_down(scene)
        scene = Scene.from_height(turned, scene.spacing, mask=scene.mask, sides=scene.sides)
    work = partial(
        mean_openness, azimuths=sectors_of(azimuths, scene.axes), backend=backend, upside_down=bool(negative)
    )
    with limited(max_seconds, "openness", scene, backend):
        angles: np.ndarray = over_tiles(work, scene, tiling, max_distance, backend, OPENNESS[bool(negative)])
    return angles


def mean_openness(
    scene: Scene,
    max_distance: float | None,
    far: Far | None,
    *,
    azimuths: Azimuths,
    backend: str,
    upside_down: bool = False,
) -> Any:
    """The mean angle from the zenith; ``upside_down``: from the nadir, of a map that is turned."""
    engine = engine_of(scene, backend)
    if far is not None and upside_down:  # what falls off with the Earth rises
        far = far._replace(drop=-far.drop)
    with engine.lock:
        ground, rays = ground_of(scene, max_distance, engine), Rays(azimuths.angles, azimuths.widths)
        sweeps = Sweeps(engine, ground, rays, near=FINE_NEAR_ROWS, far=far, angles=True)
        return _sum_of(scene, engine, sweeps, 1 / rays.widths.sum())


def _upside_down(scene: Scene) -> Any:
    """The depth of a map, as heights [length]: where the map lies, lazy and labelled as it is."""
    there = scene.resident
    if there is not None and not there.backend.shares:
        heights = DeviceImage(there.backend, there.depth, there.shape).copy()
        heights.scale(scene.spacing / there.step)
        return heights
    return labelled(scene.depth if scene.lazy is None else -scene.lazy, scene.labels, OPENNESS[True])


def _scene_of(given: Any) -> Scene:
    """The scene of an xarray.DataArray of heights; anything else is returned as it is."""
    scene = given if labels_of(given) is None else Scene.from_height(given)
    check_scene(scene)
    return scene.under_sky()
