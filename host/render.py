"""render(): a scene and a source to an image (Eq. 3)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from . import shading, skies, sources, unoccluded
from .arrays import labelled
from .backends.base import Backend, Problem
from .backends.horizon import FINE, Rays, Sweeps
from .backends.slices import MOST, SLICES, Dome, Slices, blurred, brightness_of
from .directions import Azimuths, Hemicube
from .errors import bad
from .horizon import engine_of, ground_of
from .plan import LATTICE_ERROR, PLACED_GRID, Plan, Setting, between_surfaces, errors, lacking, solid_of, upright, work
from .reflectance import BRDF
from .scene import Scene, is_scene, one_of, positive_number

METHODS = ("auto", "lattice", "horizon", "unoccluded")
QUANTITIES = ("radiance", "irradiance")
# RMS error of E / pi by number of azimuths, uniform sky, rough ground (rms slope 1): performance/horizon.py
HORIZON_ERROR = {8: 0.0138, 12: 0.0080, 16: 0.0052, 24: 0.0029, 32: 0.0019, 48: 0.0012, 64: 0.0008, 96: 0.0006, 128: 0.0003}
FAR = 1e5  # extents of the map at which the sun stands: a hundred-thousandth of a radian across it
COARSE = 1.2  # half widths of a lobe between directions, from which on its sum may be too large by 1 in a thousand
LEAK_SLOPE = 0.7  # rms slope from which the unfilled step leaks from M = 7 on (README, Limits)
SPREAD = 1.25  # tolerances that the bound from the pilots' spread may reach
RETRIES = 2  # finer settings that are tried where the image is off at the pilots
REPEATED_LOBE = "a lobe over a map that repeats"


@dataclass(frozen=True, eq=False)
class Rendering:
    """What render() gives.

    image (rows, cols) float32, or (rows, cols, 3) in colour, nan where masked, an xarray.DataArray if the scene was made from one;
    plan; backend (its name); seconds of the call without compiling,
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

    In colour, (rows, cols, 3), where the source's brightness or the scene's reflectance is; each channel is what a grey
    render of it gives, bit for bit. To rho E / pi comes what the scene's reflectance adds: the integral of
    f B cos(theta_i) over the visible directions, f a lobe or any BRDF, or what an ideal mirror shows.

    Parameters
    ----------
    scene, source : Scene; Sky, Lamp or Window
    method : "auto", "lattice", "horizon" or "unoccluded"
        ``auto``: the cheapest that is within ``tolerance``, as :func:`skylamp.plan` finds it; the image is then compared with
        exact rays at the plan's pilot nodes, and computed again, finer, where it is off by more. Where a setting that does on any
        ground takes less time than to choose one, that is taken, and not compared. ``lattice``: the paper's
        directions on a hemicube (9 unless given). ``horizon``: the source above the horizon of every node in a number of
        azimuths (64 unless given; for lamps and windows, slices through the source as every node sees it).
        ``unoccluded``: closed forms from the normals, as if ground hid nothing but what lies below each node's own tangent
        plane; the brightness of a lamp or window is that towards its middle.
    tolerance, tail : float
        Of ``auto``: relative RMS error of the irradiance, that over all valid nodes divided by the mean over the lit ones, and a bound on the
        99.9th percentile of the relative error, ten tolerances unless given.
    backend : str
        See :func:`skylamp.backends`.
    quantity : "radiance" or "irradiance"
        Radiance [unit of brightness], or irradiance E [unit of brightness x sr], whatever the reflectance.
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
    if not isinstance(source, sources.Source):
        raise bad("source", type(source).__name__, "Sky, Lamp or Window")
    tolerance = positive_number(tolerance, "tolerance")
    lattice = hemicube is not None or filled is not None or weights != "moment"
    horizon = azimuths is not None or max_distance is not None
    if horizon and (lattice or method == "lattice"):
        raise bad("render: arguments of two methods", "azimuths or max_distance with the lattice's", "azimuths and max_distance with method='horizon'; hemicube, filled and weights with 'lattice'")
    if method == "horizon" and lattice:
        raise bad("method 'horizon' with hemicube, filled or weights", "both", "azimuths and max_distance")
    if method == "unoccluded" and (lattice or horizon):
        raise bad("method 'unoccluded' with arguments of another", "both", "neither azimuths and max_distance nor hemicube, filled and weights")
    missing, lobe = lacking(scene, source), shading.lobe_of(scene) if quantity == "radiance" else None
    if scene.sides == "periodic" and lobe:
        missing = REPEATED_LOBE
    if missing and (method in ("horizon", "unoccluded") or horizon):
        raise bad(f"method '{'horizon' if horizon else method}'", missing, "a sky, a rectangular window, or a lamp given by its centre and radius, the last two with sides='open' or 'dark'", "Use method='lattice'.")
    shines = lobe or _is_brdf(scene, quantity) or quantity == "radiance" and shading.has_mirror(scene)
    if method == "unoccluded" and shines:
        raise bad("method 'unoccluded'", type(scene.reflectance).__name__, "a Lambertian surface")
    planned = method == "auto" and not lattice and not horizon and missing != REPEATED_LOBE
    if tail is not None and not planned:
        raise bad("tail", tail, "a bound for method='auto' without arguments of a method")
    engine, greys = engine_of(scene, backend), sources.channels(source)
    sun = None if lattice or missing else _sun_of(scene, source, max_distance)
    plans, warnings = [], []

    def irradiance(grey, azimuths=azimuths):
        image, plan, found = _planned(scene, grey, tolerance, tail, engine) if planned else _asked(scene, grey, engine, method, azimuths, max_distance)
        plans.append(plan)
        warnings.extend(text for text in found if text not in warnings)
        return image

    def light():
        if lattice or method == "lattice" or missing and (not planned or shines):
            plans.append(_lattice_plan(hemicube, filled, method, tolerance if not lattice else None))
            plan = plans[0]
            cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(plan.hemicube)
            return _by_lattice(scene, source, greys, engine, cube, plan.filled, weights, quantity, warnings)
        if _is_brdf(scene, quantity):
            plans.append(_plan_of(scene, greys[0], azimuths, max_distance)[1])
            if not isinstance(source, sources.Sky):
                return [], shading.by_brdf(scene, greys, engine, max_distance)
            sectors = azimuths if isinstance(azimuths, Azimuths) else Azimuths(azimuths or 64)
            return [], shading.by_brdf_under_sky(scene, greys, Sweeps(engine, ground_of(scene, max_distance, engine), Rays(sectors.angles, sectors.widths), near=FINE).planes(), sectors)
        irradiances = _each([sources.without_disc(grey) for grey in greys], irradiance) if _is_dull(scene, quantity) else []
        if irradiances and sun is not None:
            irradiances[0] += irradiance(sun, None)  # the azimuths that were asked for are the sky's
        if not plans:
            plans.append(_plan_of(scene, greys[0], azimuths, max_distance)[1])
        if sun is not None:
            plans[0] = replace(plans[0], reason=f"{plans[0].reason}; the sun's disc by itself")
        if lobe and isinstance(source, sources.Sky):
            return irradiances, _each(greys, lambda grey: _gloss(scene, grey, engine, lobe, sun is not None, max_distance))
        if lobe:
            return irradiances, _each(greys, lambda grey: _lamp_lobe(scene, grey, engine, lobe, azimuths, warnings))
        return irradiances, _mirrored(scene, greys, engine, quantity, max_distance)

    (irradiances, shown), seconds, compiling = timed(engine, light)
    image = labelled(_image(scene, irradiances, shown, quantity), scene.labels)
    return Rendering(image, plans[0], engine.name, seconds, compiling, warnings)


def _planned(scene, source, tolerance, tail, engine) -> tuple[np.ndarray, Plan, list[str]]:
    """(irradiance, plan, warnings) as the plan has it, and finer where the image proves to be off at the pilots."""
    if scene.resident is not None and isinstance(source, sources.Sky) and scene.resident.backend is engine:
        fitting = [k for k, error in HORIZON_ERROR.items() if error <= tolerance] or [max(HORIZON_ERROR)]
        image, plan, found = _asked(scene, source, engine, "horizon", fitting[0], None)
        return image, replace(plan, reason=f"RMS error {HORIZON_ERROR[fitting[0]]} of E / pi on rough ground; the map stays on its device"), found
    made = work(scene, source, tolerance, engine, tail, hurry=True)
    plan = made.plan
    nodes = made.pilots.y, made.pilots.x
    for tried, setting in enumerate(made.settings):
        warnings = []
        irradiance = _run(scene, source, engine, setting, warnings)
        found = irradiance[nodes].astype(float)
        if made.glanced and found.any():
            uniform = found / setting.scale if made.uniform is None else made.uniform
            plan = replace(plan, beyond=(*between_surfaces(scene, uniform, found, tolerance), *plan.beyond))
        if made.exact is None:
            break
        error, bound, _ = errors(found, made.exact, made.pilots.weights)
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
    return irradiance, plan, warnings


def _asked(scene, source, engine, method, azimuths, max_distance) -> tuple[np.ndarray, Plan, list[str]]:
    """(irradiance, plan, warnings) as the caller asked for it."""
    if method == "unoccluded":
        setting, plan = Setting("unoccluded", scale=source.brightness, table=_sky_table(source)), Plan("unoccluded", None, None, "as asked")
    else:
        setting, plan = _plan_of(scene, source, azimuths, max_distance)
    warnings = []
    return _run(scene, source, engine, setting, warnings), plan, warnings


def _run(scene, source, engine, setting: Setting, found: list[str]) -> np.ndarray:
    """Irradiance (rows, cols) float32 of a grey source by one setting; warnings go into ``found``."""
    if setting.method == "lattice":
        return _by_lattice(scene, source, [source], engine, Hemicube(setting.units), True, "moment", "irradiance", found)[0][0]
    way = {"unoccluded": _unoccluded, "slices": _by_slices, "horizon": _by_horizons}[setting.method]
    return way(scene, source, engine, setting).astype(np.float32, copy=False)


def _plan_of(scene, source, azimuths, max_distance) -> tuple[Setting, Plan]:
    """Horizons or slices, as many as the caller asked for."""
    if getattr(source, "corner", None) is None:
        sources.geometry(source, scene, 1.0)  # checks that they fit
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
    sweeps = Sweeps(engine, ground_of(scene, setting.max_distance, engine), Rays(setting.sectors.angles, setting.sectors.widths), table, setting.near)
    irradiance = sweeps.irradiance(last=True)
    if setting.scale != 1.0:
        irradiance *= np.float32(setting.scale)
    if setting.suns is not None:
        irradiance += by_sectors(scene, engine, setting.suns)
    return irradiance


def by_sectors(scene, engine, spots: sources.Spots) -> np.ndarray:
    """Irradiance (rows, cols) float32 by the bright spots of a sky, every crossing tested."""
    slices = Slices(engine, *scene.lattice(), scene.sides, Dome())
    slices.sectors(spots)
    return slices.download()


def _slices(scene, source, engine, most, brightness, lobe=None) -> Slices | None:
    """Azimuth slices placed within a lamp or window as every node sees it; None for a window outside the box."""
    depth, step = scene.lattice()
    solid = solid_of(scene, source, step / scene.spacing, step)
    return None if solid is None else Slices(engine, depth, step, scene.sides, solid, brightness, most, lobe)


def _by_slices(scene, source, engine, setting):
    slices = _slices(scene, source, engine, setting.units, brightness_of(source))
    if slices is None:
        return np.zeros(scene.shape, np.float32)
    slices.run()
    return slices.download()


def _unoccluded(scene, source, engine, setting):
    if isinstance(source, sources.Sky):
        table, sectors = (None, None) if setting.table is None else setting.table()
        image = unoccluded.sky(scene, setting.scale) if table is None else unoccluded.sky(scene, None, table, sectors.angles, sectors.widths)
        suns = setting.suns
        return image if suns is None else image + unoccluded.sky(scene, None, suns.table, suns.angles, suns.widths, suns.first, suns.last)
    solid = upright(solid_of(scene, source, 1 / scene.spacing, 1.0))
    return np.zeros(scene.shape, np.float32) if solid is None else unoccluded.image(scene, solid, source.brightness, max(1, setting.units))


def _by_lattice(scene, source, greys, engine, cube, filled, weights, quantity, found) -> tuple[list, list]:
    """(irradiances, what the surface shows besides) over the directions of a hemicube; warnings go into ``found``."""
    found += warnings_of(scene, source, cube, filled)
    problem = lattice_problem(scene, source, cube, filled)
    brightness = np.stack([sources.radiance(grey, cube.directions) for grey in greys])
    moments = cube.moments if weights == "moment" else cube.directions * cube.solid_angles[:, None]
    lobe, shares, whole = shading.lobe_of(scene, 1e-6) if quantity == "radiance" else None, None, None
    if lobe:
        angles = cube.solid_angles * scene.reflectance.norm
        shares, whole = (np.concatenate([np.broadcast_to(cube.directions, (*share.shape, 3)), share[..., None]], -1) for share in (brightness * angles, angles))
        spacing = np.sqrt(2 * np.pi / len(cube))
        if spacing <= COARSE * lobe.spread:
            whole = None  # the sum is exact enough
        else:
            found.append(_narrow(lobe, spacing, "method='horizon' or a larger hemicube"))
    if _is_brdf(scene, quantity):
        return [], shading.by_brdf_on_lattice(scene, greys, engine.visibility(problem), cube)
    irradiances, shown = engine.light(problem, moments * brightness[..., None], lobe, shares, whole)
    return irradiances, shown + _mirrored(scene, greys, engine, quantity, None)


def _gloss(scene, grey, engine, lobe, has_sun, max_distance):
    """What a lobe makes of a sky: (rows, cols) float32."""
    depth, step = scene.lattice()
    reach = np.inf if max_distance is None else max_distance * (step / scene.spacing)
    table, suns, flux = blurred(sources.without_disc(grey), lobe.spread)
    if has_sun:
        suns, flux = np.concatenate([suns.reshape(-1, 3), [skies.towards(*grey.brightness.sun)]]), np.append(flux, grey.brightness.direct)
    slices = Slices(engine, depth, step, scene.sides, Dome(reach), table, lobe=lobe)
    slices.run()
    image = slices.download()
    if len(suns):
        image += shading.suns(scene, engine, lobe, suns, flux, max_distance)
    return image * np.float32(scene.reflectance.norm)


def _lamp_lobe(scene, grey, engine, lobe, azimuths, found):
    """What a lobe makes of a lamp or window: (rows, cols) float32."""
    brightness = brightness_of(grey)
    slices = _slices(scene, grey, engine, _plan_of(scene, grey, azimuths, None)[0].units, brightness, lobe)
    if slices is None:
        return np.zeros(scene.shape, np.float32)
    slices.run()
    image = slices.download() * np.float32(scene.reflectance.norm)
    if slices.coarse > COARSE:
        text = _narrow(lobe, slices.coarse * lobe.spread, "a smaller lamp, or Mirror")
        found.extend([text] if text not in found else [])
        np.minimum(image, np.float32(np.max(brightness)), out=image)  # no lobe shows more than there is
    return image


def _image(scene: Scene, irradiances: list[np.ndarray], shown: list[np.ndarray], quantity: str) -> np.ndarray:
    """What was asked for, made in place of irradiance and, per unit of specular albedo, of what the surface shows besides; a list has one array per colour."""
    if quantity == "radiance":
        albedo, specular = (np.asarray(getattr(scene.reflectance, name, 1.0), np.float32) for name in ("albedo", "specular"))
        count = max([len(irradiances), len(shown), *(3 for share in (albedo, specular) if _in_colour(share))])
        of = lambda arrays, n: arrays[n % len(arrays)].copy() if count > len(arrays) else arrays[n]
        channels = []
        for n in range(count):
            pick = lambda share: share[..., n] if _in_colour(share) else share
            image = 0
            if irradiances:
                image = of(irradiances, n)
                image *= pick(albedo) * np.float32(1 / np.pi)
            if shown:
                image = image + pick(specular) * of(shown, n)
            channels.append(image)
        irradiances = channels
    image = irradiances[0] if len(irradiances) == 1 else np.stack(irradiances, -1)
    if scene.mask is not None:
        image[~scene.mask] = np.nan
    return image


def _in_colour(share: np.ndarray) -> bool:
    return share.ndim in (1, 3)


def _is_brdf(scene: Scene, quantity: str) -> bool:
    return quantity == "radiance" and isinstance(scene.reflectance, BRDF)


def _mirrored(scene, greys, engine, quantity, max_distance) -> list[np.ndarray]:
    return shading.mirrored(scene, greys, engine, max_distance) if quantity == "radiance" and shading.has_mirror(scene) else []


def _is_dull(scene: Scene, quantity: str) -> bool:
    """Whether irradiance is asked for, or reflected: a surface that only shines needs none."""
    return quantity == "irradiance" or np.any(scene.albedo) or not (shading.lobe_of(scene) or shading.has_mirror(scene))


def _narrow(lobe, apart: float, fix: str) -> str:
    return (f"Narrow lobe: it is {np.degrees(lobe.spread):.1f} degrees wide and the directions stand up to {np.degrees(apart):.1f} degrees apart, "
            f"so highlights break up into dots or are lost; use {fix}.")


def _each(greys: list, work: Callable) -> list[np.ndarray]:
    """``work`` (source) for every colour; where colours differ by a factor alone, once, and times that factor."""
    if any(callable(grey.brightness) for grey in greys):
        return [work(grey) for grey in greys]
    one = work(replace(greys[0], brightness=1.0))
    return [one if grey.brightness == 1 else one * np.float32(grey.brightness) for grey in greys]


def _sun_of(scene, source, max_distance) -> sources.Lamp | None:
    """The disc of a sky's sun, as a lamp so far away that it stands in one direction for the whole map."""
    if not isinstance(source, sources.Sky) or not getattr(source.brightness, "direct", 0):
        return None
    if scene.sides == "periodic" or max_distance is not None:
        raise bad("a sky with the sun's disc (direct)", f"sides={scene.sides!r}, max_distance={max_distance}", "sides 'open' or 'dark' and the whole map")
    if isinstance(scene.reflectance, BRDF) or shading.has_mirror(scene):
        raise bad("a sky with the sun's disc (direct)", type(scene.reflectance).__name__, "Lambertian or Phong", "Give the sun as a Lamp of its own.")
    extent = max(max(scene.shape) * scene.spacing, float(scene.depth[scene.valid].max()))
    return source.brightness.disc(FAR * extent)


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


def _lattice_plan(hemicube, filled, method, tolerance) -> Plan:
    given = hemicube.size if isinstance(hemicube, Hemicube) else hemicube
    filled = filled is not False if method == "auto" else bool(filled)
    if method == "auto" and given is None and tolerance is not None:
        given = next((m for m, error in LATTICE_ERROR.items() if error <= tolerance), max(LATTICE_ERROR))
        return Plan("lattice", given, filled, f"RMS error {LATTICE_ERROR[given]} of E / pi on rough ground")
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
