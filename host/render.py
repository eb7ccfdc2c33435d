"""render(): a scene and a source to an image (Eq. 3)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from . import sources, unoccluded
from .backends import select
from .backends.base import Backend, Problem
from .backends.horizon import Rays, Sweeps
from .backends.slices import MOST, SLICES, Slices, brightness_of
from .directions import Azimuths, Hemicube
from .errors import bad
from .horizon import ground_of
from .plan import PLACED_GRID, Plan, Setting, errors, lacking, solid_of, upright, work
from .scene import Scene, is_scene, one_of, positive_number

METHODS = ("auto", "lattice", "horizon", "unoccluded")
QUANTITIES = ("radiance", "irradiance")
LEAK_SLOPE = 0.7  # rms slope from which the unfilled step leaks from M = 7 on (README, Limits)
SPREAD = 1.25  # tolerances that the bound from the pilots' spread may reach
RETRIES = 2  # finer settings that are tried where the image is off at the pilots


@dataclass(frozen=True, eq=False)
class Rendering:
    """What render() gives.

    image (rows, cols) float32, nan where masked; plan; backend (its name); seconds of the call without compiling,
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
           weights: str = "moment", azimuths: int | Azimuths | None = None, max_distance: float | None = None, tail: float | None = None) -> Rendering:
    """The image of ``scene`` under ``source``, seen orthographically along +z (Langer and Zucker, Eq. 3).

    Parameters
    ----------
    scene, source : Scene; Sky, Lamp or Window
    method : "auto", "lattice", "horizon" or "unoccluded"
        ``auto``: the cheapest that is within ``tolerance``, as :func:`skylamp.plan` finds it; the image is then compared with
        exact rays at the plan's pilot nodes, and computed again, finer, where it is off by more. ``lattice``: the paper's
        directions on a hemicube (9 unless given). ``horizon``: the source above the horizon of every node in a number of
        azimuths (64 unless given; for lamps and windows, slices through the source as every node sees it).
        ``unoccluded``: closed forms from the normals, as if ground hid nothing but what lies below each node's own tangent
        plane; the brightness of a lamp or window is that towards its middle.
    tolerance, tail : float
        Of ``auto``: relative RMS error, that over all valid nodes divided by the mean over the lit ones, and a bound on the
        99.9th percentile of the relative error, ten tolerances unless given.
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
    if method == "unoccluded" and (lattice or horizon):
        raise bad("method 'unoccluded' with arguments of another", "both", "neither azimuths and max_distance nor hemicube, filled and weights")
    missing = lacking(scene, source)
    if missing and (method in ("horizon", "unoccluded") or horizon):
        raise bad(f"method '{'horizon' if horizon else method}'", missing, "a sky, a rectangular window, or a lamp given by its centre and radius, the last two with sides='open' or 'dark'", "Use method='lattice'.")
    engine = select(backend)
    if method == "auto" and not lattice and not horizon:
        return _planned(scene, source, tolerance, tail, engine, quantity)
    if tail is not None:
        raise bad("tail", tail, "a bound for method='auto' without arguments of a method")
    if not lattice and method != "lattice":
        setting, plan = _asked(scene, source, method, azimuths, max_distance)
        irradiance, seconds, compiling = _run(scene, source, engine, setting)
        return Rendering(_image(scene, irradiance, quantity), plan, engine.name, seconds, compiling)
    plan = _lattice_plan(hemicube, filled, method)
    cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(plan.hemicube)
    irradiance, seconds, compiling = _by_lattice(scene, source, engine, cube, plan.filled, weights)
    return Rendering(_image(scene, irradiance, quantity), plan, engine.name, seconds, compiling, warnings_of(scene, source, cube, plan.filled))


def _planned(scene, source, tolerance, tail, engine, quantity) -> Rendering:
    """As the plan has it, and finer where the image proves to be off at the pilots."""
    (made,), planning_seconds, compiling = timed(engine, lambda: (work(scene, source, tolerance, engine, tail),))
    plan, total, warnings = made.plan, planning_seconds, []
    nodes = made.pilots.y, made.pilots.x
    for tried, setting in enumerate(made.settings):
        irradiance, seconds, compiled = _run(scene, source, engine, setting)
        total, compiling = total + seconds, compiling + compiled
        if made.exact is None:
            break
        found = irradiance[nodes].astype(float)
        error, bound, _ = errors(found, made.exact)
        if (error <= max(tolerance, setting.bound) and bound <= SPREAD * max(tolerance, setting.bound)) or tried >= RETRIES:
            break
    if made.exact is not None:
        if setting.method == "lattice":
            plan = replace(plan, hemicube=setting.units, measured=error)
        else:
            plan = replace(plan, azimuths=setting.units if setting.method != "unoccluded" else None, measured=error)
        if error > tolerance:
            warnings.append(f"Tolerance: the image is off by {100 * error:.2g} % (RMS over the mean) at {len(made.pilots)} pilot nodes, more than the {100 * tolerance:.2g} % asked for"
                            + (f"; {plan.reason}." if not setting.error <= tolerance else "."))
    if setting.method == "lattice":
        warnings += warnings_of(scene, source, Hemicube(setting.units), True)
    return Rendering(_image(scene, irradiance, quantity), plan, engine.name, total, compiling, warnings)


def _run(scene, source, engine, setting: Setting) -> tuple[np.ndarray, float, float]:
    """(irradiance (rows, cols) float32, seconds without compiling, seconds of compiling) by one setting."""
    if setting.method == "lattice":
        return _by_lattice(scene, source, engine, Hemicube(setting.units), True, "moment")
    way = {"unoccluded": _unoccluded, "slices": _by_slices, "horizon": _by_horizons}[setting.method]
    (irradiance,), seconds, compiling = timed(engine, lambda: (way(scene, source, engine, setting),))
    return irradiance, seconds, compiling


def _image(scene: Scene, irradiance: np.ndarray, quantity: str) -> np.ndarray:
    """What was asked for, made of irradiance in place."""
    if quantity == "radiance":
        irradiance *= np.asarray(scene.albedo, np.float32) * np.float32(1 / np.pi)
    if scene.mask is not None:
        irradiance[~scene.mask] = np.nan
    return irradiance


def _asked(scene, source, method, azimuths, max_distance) -> tuple[Setting, Plan]:
    """What the caller asked for."""
    if getattr(source, "corner", None) is None:
        sources.geometry(source, scene, 1.0)  # checks that they fit
    if method == "unoccluded":
        return Setting("unoccluded", scale=source.brightness, table=_sky_table(source)), Plan("unoccluded", None, None, "as asked")
    if not isinstance(source, sources.Sky):
        if max_distance is not None or isinstance(azimuths, Azimuths):
            raise bad("method 'horizon' with a lamp or window", "max_distance, or azimuths of the caller's", "azimuths as a whole number: slices of a source that stands all round")
        most = MOST if azimuths is None else -(-len(Azimuths(azimuths)) // SLICES) * SLICES
        return Setting("slices", most), Plan("horizon", None, None, "slices through the source as every node sees it, fewer where it looks small", most)
    sectors = azimuths if isinstance(azimuths, Azimuths) else Azimuths(64 if azimuths is None else azimuths)
    table, scale = None, 1.0
    if callable(source.brightness):
        profile = sources.azimuth_profile(source)
        if profile is not None and not isinstance(azimuths, Azimuths):
            sectors = Azimuths.placed(len(sectors), profile)
        table = lambda: sources.elevation_table(source, sectors.angles, sectors.widths, 256 if profile is None else 1024)
    else:
        scale = float(source.brightness)
    return Setting("horizon", len(sectors), sectors=sectors, table=table, scale=scale, max_distance=max_distance), Plan("horizon", None, None, "as asked", len(sectors), max_distance)


def _sky_table(source):
    """What makes the table of a sky's brightness where nothing hides it; None for a number, and for what is no sky."""
    if not isinstance(source, sources.Sky) or not callable(source.brightness):
        return None
    profile = sources.azimuth_profile(source)
    sectors = Azimuths(unoccluded.AZIMUTHS) if profile is None else Azimuths.placed(PLACED_GRID, profile)
    return lambda: (sources.fine_table(source, sectors.angles, sectors.widths), sectors)


def _by_horizons(scene, source, engine, setting):
    table = None if setting.table is None else setting.table()
    sweeps = Sweeps(engine, ground_of(scene, setting.max_distance), Rays(setting.sectors.angles, setting.sectors.widths), table, setting.near)
    irradiance = sweeps.irradiance()
    if setting.scale != 1.0:
        irradiance *= np.float32(setting.scale)
    return irradiance


def _by_slices(scene, source, engine, setting):
    """A lamp or window, through azimuth slices placed within it as every node sees it."""
    depth, step = scene.lattice()
    solid = solid_of(scene, source, step / scene.spacing, step)
    if solid is None:  # a window outside the box
        return np.zeros(scene.shape, np.float32)
    slices = Slices(engine, depth, step, scene.sides, solid, brightness_of(source), setting.units)
    slices.run()
    return slices.download()


def _unoccluded(scene, source, engine, setting):
    if isinstance(source, sources.Sky):
        if setting.table is None:
            return unoccluded.sky(scene, setting.scale)
        table, sectors = setting.table()
        return unoccluded.sky(scene, None, table, sectors.angles, sectors.widths)
    solid = upright(solid_of(scene, source, 1 / scene.spacing, 1.0))
    return np.zeros(scene.shape, np.float32) if solid is None else unoccluded.image(scene, solid, source.brightness, max(1, setting.units))


def _by_lattice(scene, source, engine, cube, filled, weights):
    problem = lattice_problem(scene, source, cube, filled)
    brightness = sources.radiance(source, cube.directions)
    moments = cube.moments if weights == "moment" else cube.directions * cube.solid_angles[:, None]
    (irradiance,), seconds, compiling = timed(engine, lambda: (engine.irradiance(problem, moments * brightness[:, None]),))
    return irradiance, seconds, compiling


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


def _lattice_plan(hemicube, filled, method) -> Plan:
    given = hemicube.size if isinstance(hemicube, Hemicube) else hemicube
    filled = filled is not False if method == "auto" else bool(filled)
    return Plan("lattice", 9 if given is None else given, filled, "as asked")


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
