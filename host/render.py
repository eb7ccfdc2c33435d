"""render(): a scene and a source to an image (Eq. 3)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from . import sources
from .arrays import labelled
from .backends import select
from .backends.base import Backend, Problem
from .backends.horizon import Rays, Sweeps
from .backends.slices import MOST, SLICES, Ball, Slices, aperture, brightness_of, rectangle
from .directions import Azimuths, Hemicube
from .errors import bad
from .horizon import engine_of, ground_of
from .scene import Scene, is_scene, one_of, positive_number

METHODS = ("auto", "lattice", "horizon")
QUANTITIES = ("radiance", "irradiance")
# RMS error of E / pi of the filled lattice under a uniform sky on rough ground (rms slope 1): performance/lattice_error.py
LATTICE_ERROR = {5: 0.0376, 7: 0.0188, 9: 0.0119, 17: 0.0039, 33: 0.0012}
# the same for horizons, by number of azimuths: performance/horizon.py
HORIZON_ERROR = {8: 0.0138, 12: 0.0080, 16: 0.0052, 24: 0.0029, 32: 0.0019, 48: 0.0012, 64: 0.0008, 96: 0.0006, 128: 0.0003}
FAR = 1e5  # extents of the map at which the sun stands: a hundred-thousandth of a radian across it
LEAK_SLOPE = 0.7  # rms slope from which the unfilled step leaks from M = 7 on (README, Limits)


@dataclass(frozen=True)
class Plan:
    """The model that was used, and why."""

    method: str
    hemicube: int | None
    filled: bool | None
    reason: str
    azimuths: int | None = None

    def __str__(self) -> str:
        if self.method == "horizon":
            return f"horizon, {self.azimuths} azimuths: {self.reason}"
        return f"{self.method}, hemicube {self.hemicube}, {'filled' if self.filled else 'stride'}: {self.reason}"


@dataclass(frozen=True, eq=False)
class Rendering:
    """What render() gives.

    image (rows, cols) float32, nan where masked, an xarray.DataArray if the scene was made from one; plan; backend (its name); seconds of the call without compiling,
    compile_seconds; warnings (one sentence each).
    """

    image: np.ndarray
    plan: Plan
    backend: str
    seconds: float
    compile_seconds: float
    warnings: list[str] = field(default_factory=list)


def render(scene: Scene, source: sources.Source, method: str = "auto", tolerance: float = 0.01, backend: str = "auto",
           quantity: str = "radiance", *, hemicube: int | Hemicube | None = None, filled: bool | None = None,
           weights: str = "moment", azimuths: int | Azimuths | None = None, max_distance: float | None = None) -> Rendering:
    """The image of ``scene`` under ``source``, seen orthographically along +z (Langer and Zucker, Eq. 3).

    Parameters
    ----------
    scene, source : Scene; Sky, Lamp or Window
    method : "auto", "lattice" or "horizon"
        ``lattice``: the paper's directions on a hemicube (9 unless given). ``horizon``: the source above the horizon of
        every node in a number of azimuths (64 unless given; for lamps and windows, slices through the source as every
        node sees it). ``auto``: horizons, with the fewest azimuths whose measured error on rough ground is within
        ``tolerance``; where they cannot be had (lamps given as volumes, windows given as apertures, lamps and windows
        over a map that repeats), the filled lattice with the smallest hemicube of that kind.
    tolerance : float
        RMS error of E / pi under a uniform sky of brightness 1 that ``auto`` may make. A lamp or a bright spot smaller
        than the spacing of the directions is not covered by it; a warning says so.
    backend : str
        See :func:`skylamp.backends`.
    quantity : "radiance" or "irradiance"
        Radiance rho E / pi [unit of brightness], or irradiance E [unit of brightness x sr].
    hemicube : odd int or Hemicube
        M of the lattice.
    filled : bool
        Test every crossing of a ray with a grid line, not the lattice nodes alone (the paper's step).
    weights : "moment" or "printed"
        Each cell's integral of N.L dL (exact where the cell is wholly visible and above the tangent plane), or
        N.L of its node times its solid angle, as Eq. 3 is printed.
    azimuths : int or Azimuths
        Of horizons. Under a sky whose brightness is very uneven in azimuth, such as one with a sun, a number of azimuths
        is placed half evenly, half by brightness.
    max_distance : float [unit of spacing]
        Of horizons under a sky: ground farther away does not count; the whole map does unless given.

    Raises
    ------
    InputError, BackendError, CapacityError
    """
    is_scene(scene)
    one_of(method, METHODS, "method")
    one_of(quantity, QUANTITIES, "quantity")
    one_of(weights, ("moment", "printed"), "weights")
    if not isinstance(filled, (bool, type(None))):
        raise bad("filled", repr(filled), "True, False or None")
    tolerance = positive_number(tolerance, "tolerance")
    lattice = hemicube is not None or filled is not None or weights != "moment"
    horizon = azimuths is not None or max_distance is not None
    if horizon and (lattice or method == "lattice"):
        raise bad("render: arguments of two methods", "azimuths or max_distance with the lattice's", "azimuths and max_distance with method='horizon'; hemicube, filled and weights with 'lattice'")
    if method == "horizon" and lattice:
        raise bad("method 'horizon' with hemicube, filled or weights", "both", "azimuths and max_distance")
    lacking = _no_horizon(scene, source)
    if lacking and (method == "horizon" or horizon):
        raise bad("method 'horizon'", lacking, "a sky, a rectangular window, or a lamp given by its centre and radius, the last two with sides='open' or 'dark'", "Use method='lattice'.")
    if method == "horizon" or (method == "auto" and not lattice and not lacking):
        return _labelled(scene, _by_horizons(scene, source, method, tolerance, engine_of(scene, backend), quantity, azimuths, max_distance))
    plan = _plan(method, tolerance, hemicube, filled)
    cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(plan.hemicube)
    engine = select(backend)
    problem = lattice_problem(scene, source, cube, plan.filled)
    brightness = sources.radiance(source, cube.directions)
    moments = cube.moments if weights == "moment" else cube.directions * cube.solid_angles[:, None]
    (irradiance,), seconds, compiling = timed(engine, lambda: (engine.irradiance(problem, moments * brightness[:, None]),))
    return _labelled(scene, Rendering(_image(scene, irradiance, quantity), plan, engine.name, seconds, compiling, warnings_of(scene, source, cube, plan.filled)))


def _labelled(scene: Scene, done: Rendering) -> Rendering:
    """With an image that has the coordinates of the scene's DataArray, if it was made from one."""
    return done if scene.labels is None else replace(done, image=labelled(done.image, scene.labels))


def _image(scene: Scene, irradiance: np.ndarray, quantity: str) -> np.ndarray:
    """What was asked for, made of irradiance in place."""
    if quantity == "radiance":
        irradiance *= np.asarray(scene.albedo, np.float32) * np.float32(1 / np.pi)
    if scene.mask is not None:
        irradiance[~scene.mask] = np.nan
    return irradiance


def _no_horizon(scene: Scene, source: sources.Source) -> str:
    """Why horizons cannot render this, or nothing."""
    if isinstance(source, sources.Lamp) and source.volume is not None:
        return "a lamp given as a volume"
    if isinstance(source, sources.Window) and source.aperture is not None:
        return "a window given as an aperture"
    if scene.sides == "periodic" and not isinstance(source, sources.Sky):
        return "a lamp or window over a map that repeats"
    return ""


def _by_horizons(scene, source, method, tolerance, engine, quantity, azimuths, max_distance) -> Rendering:
    if getattr(source, "corner", None) is None:
        sources.geometry(source, scene, 1.0)  # checks that they fit
    fitting = [k for k, error in HORIZON_ERROR.items() if error <= tolerance] or [max(HORIZON_ERROR)]
    reason, given = "as asked", azimuths is not None
    if azimuths is None:
        azimuths = 64 if method == "horizon" else fitting[0]
        if method == "auto":
            reason = f"RMS error {HORIZON_ERROR[azimuths]} of E / pi on rough ground, {'within' if HORIZON_ERROR[azimuths] <= tolerance else 'the best there is for'} tolerance {tolerance}"
    sectors = azimuths if isinstance(azimuths, Azimuths) else Azimuths(azimuths)
    if not isinstance(source, sources.Sky):
        return _by_slices(scene, source, engine, quantity, azimuths if given else None, max_distance)
    table = None
    scale = 1.0
    sun = _sun_of(scene, source, max_distance)
    if sun is not None:
        source = sources.Sky(replace(source.brightness, direct=0.0))
    if callable(source.brightness):
        profile = sources.azimuth_profile(source)
        if profile is not None and not isinstance(azimuths, Azimuths):
            sectors = Azimuths.placed(len(sectors), profile)
        table = sources.elevation_table(source, sectors.angles, sectors.widths, 256 if profile is None else 1024)
    else:
        scale = float(source.brightness)
    sweeps = Sweeps(engine, ground_of(scene, max_distance, engine), Rays(sectors.angles, sectors.widths), table)
    (irradiance,), seconds, compiling = timed(engine, lambda: (sweeps.irradiance(),))
    if sun is not None:
        disc = _by_slices(scene, sun, engine, "irradiance", None, None)
        irradiance += disc.image
        seconds, compiling, reason = seconds + disc.seconds, compiling + disc.compile_seconds, f"{reason}; the sun's disc by slices"
    if scale != 1.0:
        irradiance *= np.float32(scale)
    return Rendering(_image(scene, irradiance, quantity), Plan("horizon", None, None, reason, len(sectors)), engine.name, seconds, compiling)


def _sun_of(scene, source, max_distance) -> sources.Lamp | None:
    """The disc of a sky's sun, as a lamp so far away that it stands in one direction for the whole map."""
    if not getattr(source.brightness, "direct", 0):
        return None
    if scene.sides == "periodic" or max_distance is not None:
        raise bad("a sky with the sun's disc (direct)", f"sides={scene.sides!r}, max_distance={max_distance}", "sides 'open' or 'dark' and the whole map")
    extent = max(max(scene.shape) * scene.spacing, float(scene.depth[scene.valid].max()))
    return source.brightness.disc(FAR * extent)


def _by_slices(scene, source, engine, quantity, azimuths, max_distance) -> Rendering:
    """A lamp or window, through azimuth slices placed within it as every node sees it."""
    if max_distance is not None or isinstance(azimuths, Azimuths):
        raise bad("method 'horizon' with a lamp or window", "max_distance, or azimuths of the caller's", "azimuths as a whole number: slices of a source that stands all round")
    most = MOST if azimuths is None else -(-len(Azimuths(azimuths)) // SLICES) * SLICES
    depth, step = scene.lattice()
    unit = step / scene.spacing
    if isinstance(source, sources.Window):
        solid = aperture(np.array(source.x) * unit, np.array(source.y) * unit, scene.shape, step, scene.sides)
    elif source.corner is not None:
        solid = rectangle(*(np.array(v) * unit for v in (source.corner, *source.edges)))
    else:
        solid = Ball(tuple(np.array(source.center) * unit), source.radius * unit)
    plan = Plan("horizon", None, None, "slices through the source as every node sees it, fewer where it looks small", most)
    if solid is None:  # a window outside the box
        return Rendering(_image(scene, np.zeros(scene.shape, np.float32), quantity), plan, engine.name, 0.0, 0.0)
    slices = Slices(engine, depth, step, scene.sides, solid, brightness_of(source), most)

    def work():
        slices.run()
        return (slices.download(),)

    (irradiance,), seconds, compiling = timed(engine, work)
    return Rendering(_image(scene, irradiance, quantity), plan, engine.name, seconds, compiling)


def lattice_problem(scene: Scene, source: sources.Source, cube: Hemicube, filled: bool) -> Problem:
    """The arrays that a backend needs, from a scene and a source."""
    is_scene(scene)
    values, step = scene.lattice()
    return Problem(values, step, scene.sides, cube.steps, sources.geometry(source, scene, step), filled)


def timed(engine: Backend, work: Callable[[], tuple]) -> tuple[tuple, float, float]:
    """(result, seconds without compiling, seconds of compiling) of ``work``."""
    compiled, start = engine.compile_seconds, time.perf_counter()
    result = work()
    compiling = engine.compile_seconds - compiled
    return result, time.perf_counter() - start - compiling, compiling


def _plan(method, tolerance, hemicube, filled) -> Plan:
    given = hemicube.size if isinstance(hemicube, Hemicube) else hemicube
    if method == "lattice":
        return Plan(method, 9 if given is None else given, bool(filled), "as asked")
    if given is not None:
        return Plan("lattice", given, filled is not False, f"hemicube {given} was asked for")
    fitting = [m for m, error in LATTICE_ERROR.items() if error <= tolerance]
    size = fitting[0] if fitting else max(LATTICE_ERROR)
    reason = f"RMS error {LATTICE_ERROR[size]} of E / pi on rough ground, {'within' if fitting else 'the best there is for'} tolerance {tolerance}"
    return Plan("lattice", size, filled is not False, reason)


def warnings_of(scene: Scene, source: sources.Source, cube: Hemicube, filled: bool) -> list[str]:
    """What the lattice is known to get wrong for this scene and source, one sentence each."""
    found = []
    depth = scene.depth[scene.valid].astype(float)
    if not filled and cube.size >= 7:
        z = np.where(scene.valid, scene.depth, np.nan).astype(float)
        slopes = [np.diff(z, axis=a) / scene.spacing for a in (0, 1) if z.shape[a] > 1]
        square = sum(np.nanmean(s**2) if np.isfinite(s).any() else 0.0 for s in slopes)
        if square > LEAK_SLOPE**2:
            found.append(f"Leak: the rms slope is {np.sqrt(square):.2f}, and steps of {cube.reach} nodes jump over ridges, so light leaks through; use filled=True.")
    if isinstance(source, sources.Lamp) and source.volume is None:
        rows, cols = scene.shape
        x, y, z = source.center
        far = np.sqrt((max(abs(x), abs((cols - 1) * scene.spacing - x))) ** 2 + max(abs(y), abs((rows - 1) * scene.spacing - y)) ** 2 + (depth.max() - z) ** 2)
        spacing = np.sqrt(2 * np.pi / len(cube))
        apparent = 2 * np.arcsin(min(1.0, source.radius / far))
        if apparent < 2 * spacing:
            found.append(f"Small lamp: from the farthest ground it is {np.degrees(apparent):.1f} degrees wide and the directions stand {np.degrees(spacing):.1f} "
                         "degrees apart, so some nodes see it in few directions or none; use a larger hemicube.")
    return found
