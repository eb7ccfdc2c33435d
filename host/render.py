"""render(): a scene and a source to an image (Eq. 3), and what reflectances other than Lambertian add to it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from . import shading, skies, sources
from .arrays import labelled
from .backends import select
from .backends.base import Backend, Problem
from .backends.horizon import FINE, Rays, Sweeps
from .backends.slices import MOST, SLICES, Ball, Dome, Slices, aperture, blurred, brightness_of, rectangle
from .directions import Azimuths, Hemicube
from .errors import bad
from .horizon import engine_of, ground_of
from .reflectance import BRDF
from .scene import Scene, is_scene, one_of, positive_number

METHODS = ("auto", "lattice", "horizon")
QUANTITIES = ("radiance", "irradiance")
# RMS error of E / pi of the filled lattice under a uniform sky on rough ground (rms slope 1): performance/lattice_error.py
LATTICE_ERROR = {5: 0.0376, 7: 0.0188, 9: 0.0119, 17: 0.0039, 33: 0.0012}
# the same for horizons, by number of azimuths: performance/horizon.py
HORIZON_ERROR = {8: 0.0138, 12: 0.0080, 16: 0.0052, 24: 0.0029, 32: 0.0019, 48: 0.0012, 64: 0.0008, 96: 0.0006, 128: 0.0003}
FAR = 1e5  # extents of the map at which the sun stands: a hundred-thousandth of a radian across it
COARSE = 1.2  # half widths of a lobe between directions, from which on its sum may be too large by 1 in a thousand
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
           weights: str = "moment", azimuths: int | Azimuths | None = None, max_distance: float | None = None) -> Rendering:
    """The image of ``scene`` under ``source``, seen orthographically along +z (Langer and Zucker, Eq. 3).

    In colour, (rows, cols, 3), where the source's brightness or the scene's reflectance is; each channel is what a grey
    render of it gives, bit for bit. To rho E / pi comes what the scene's reflectance adds: the integral of
    f B cos(theta_i) over the visible directions, f a lobe or any BRDF, or what an ideal mirror shows.

    Parameters
    ----------
    scene, source : Scene; Sky, Lamp or Window
    method : "auto", "lattice" or "horizon"
        ``lattice``: the paper's directions on a hemicube (9 unless given). ``horizon``: the source above the horizon of
        every node in a number of azimuths (64 unless given; for lamps and windows, slices through the source as every
        node sees it). ``auto``: horizons, with the fewest azimuths whose measured error on rough ground is within
        ``tolerance``; where they cannot be had (lamps given as volumes, windows given as apertures, lamps, windows
        and lobes over a map that repeats), the filled lattice with the smallest hemicube of that kind.
    tolerance : float
        RMS error of E / pi under a uniform sky of brightness 1 that ``auto`` may make. A lamp or a bright spot smaller
        than the spacing of the directions is not covered by it, nor is a lobe that is narrower; a warning says so.
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
    tolerance = positive_number(tolerance, "tolerance")
    lattice = hemicube is not None or filled is not None or weights != "moment"
    horizon = azimuths is not None or max_distance is not None
    if horizon and (lattice or method == "lattice"):
        raise bad("render: arguments of two methods", "azimuths or max_distance with the lattice's", "azimuths and max_distance with method='horizon'; hemicube, filled and weights with 'lattice'")
    if method == "horizon" and lattice:
        raise bad("method 'horizon' with hemicube, filled or weights", "both", "azimuths and max_distance")
    lacking = _no_horizon(scene, source, quantity)
    if lacking and (method == "horizon" or horizon):
        raise bad("method 'horizon'", lacking, "a sky, a rectangular window, or a lamp given by its centre and radius, the last two with sides='open' or 'dark'", "Use method='lattice'.")
    if method == "horizon" or (method == "auto" and not lattice and not lacking):
        return _labelled(scene, _by_horizons(scene, source, method, tolerance, engine_of(scene, backend), quantity, azimuths, max_distance))
    plan = _plan(method, tolerance, hemicube, filled)
    cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(plan.hemicube)
    engine, greys = select(backend), sources.channels(source)
    found = warnings_of(scene, source, cube, plan.filled)
    problem = lattice_problem(scene, source, cube, plan.filled)
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

    def work():
        if _is_brdf(scene, quantity):
            return [], shading.by_brdf_on_lattice(scene, greys, engine.visibility(problem), cube)
        irradiances, shown = engine.light(problem, moments * brightness[..., None], lobe, shares, whole)
        return irradiances, shown + _mirrored(scene, greys, engine, quantity, None)

    (irradiances, shown), seconds, compiling = timed(engine, work)
    return _labelled(scene, Rendering(_image(scene, irradiances, shown, quantity), plan, engine.name, seconds, compiling, found))


def _labelled(scene: Scene, done: Rendering) -> Rendering:
    """With an image that has the coordinates of the scene's DataArray, if it was made from one."""
    return done if scene.labels is None else replace(done, image=labelled(done.image, scene.labels))


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


def _no_horizon(scene: Scene, source: sources.Source, quantity: str) -> str:
    """Why horizons cannot render this, or nothing."""
    if scene.sides == "periodic" and quantity == "radiance" and shading.lobe_of(scene):
        return "a lobe over a map that repeats"
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
    greys, found = sources.channels(source), []
    if not isinstance(source, sources.Sky):
        return _by_slices(scene, source, greys, engine, quantity, azimuths if given else None, max_distance)
    ground, lobe = ground_of(scene, max_distance, engine), shading.lobe_of(scene) if quantity == "radiance" else None
    sun = _sun_of(scene, source, max_distance)
    if sun is not None:
        reason += "; the sun's disc by slices"

    def irradiance(grey):
        placed, table = sectors, None
        if callable(grey.brightness):
            grey = _without_disc(grey)
            profile = sources.azimuth_profile(grey)
            if profile is not None and not isinstance(azimuths, Azimuths):
                placed = Azimuths.placed(len(sectors), profile)
            table = sources.elevation_table(grey, placed.angles, placed.widths, 256 if profile is None else 1024)
        image = Sweeps(engine, ground, Rays(placed.angles, placed.widths), table).irradiance()
        if sun is not None:
            image += _by_slices(scene, sun, [sun], engine, "irradiance", None, None).image
        return image

    def gloss(grey):
        depth, step = scene.lattice()
        reach = np.inf if max_distance is None else max_distance * (step / scene.spacing)
        table, suns, flux = blurred(_without_disc(grey), lobe.spread)
        if sun is not None:
            suns, flux = np.concatenate([suns.reshape(-1, 3), [skies.towards(*source.brightness.sun)]]), np.append(flux, source.brightness.direct)
        slices = Slices(engine, depth, step, scene.sides, Dome(reach), table, lobe=lobe)
        slices.run()
        image = slices.download()
        if len(suns):
            image += shading.suns(scene, engine, lobe, suns, flux, max_distance)
        return image * np.float32(scene.reflectance.norm)

    def work():
        if _is_brdf(scene, quantity):
            return [], shading.by_brdf_under_sky(scene, greys, Sweeps(engine, ground, Rays(sectors.angles, sectors.widths), near=FINE).planes(), sectors)
        irradiances = _each(greys, irradiance) if _is_dull(scene, quantity) else []
        return irradiances, _each(greys, gloss) if lobe else _mirrored(scene, greys, engine, quantity, max_distance)

    (irradiances, shown), seconds, compiling = timed(engine, work)
    return Rendering(_image(scene, irradiances, shown, quantity), Plan("horizon", None, None, reason, len(sectors)), engine.name, seconds, compiling, found)


def _sun_of(scene, source, max_distance) -> sources.Lamp | None:
    """The disc of a sky's sun, as a lamp so far away that it stands in one direction for the whole map."""
    if not getattr(source.brightness, "direct", 0):
        return None
    if scene.sides == "periodic" or max_distance is not None:
        raise bad("a sky with the sun's disc (direct)", f"sides={scene.sides!r}, max_distance={max_distance}", "sides 'open' or 'dark' and the whole map")
    if isinstance(scene.reflectance, BRDF) or shading.has_mirror(scene):
        raise bad("a sky with the sun's disc (direct)", type(scene.reflectance).__name__, "Lambertian or Phong", "Give the sun as a Lamp of its own.")
    extent = max(max(scene.shape) * scene.spacing, float(scene.depth[scene.valid].max()))
    return source.brightness.disc(FAR * extent)


def _without_disc(sky):
    return sources.Sky(replace(sky.brightness, direct=0.0)) if getattr(sky.brightness, "direct", 0) else sky


def _by_slices(scene, source, greys, engine, quantity, azimuths, max_distance) -> Rendering:
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
    lobe, found = shading.lobe_of(scene) if quantity == "radiance" else None, []

    def light(grey, lobe=None):
        if solid is None:  # a window outside the box
            return np.zeros(scene.shape, np.float32)
        brightness = brightness_of(grey)
        slices = Slices(engine, depth, step, scene.sides, solid, brightness, most, lobe)
        slices.run()
        image = slices.download()
        if lobe:
            image *= np.float32(scene.reflectance.norm)
            if slices.coarse > COARSE:
                found[:] = [_narrow(lobe, slices.coarse * lobe.spread, "a smaller lamp, or Mirror")]
                np.minimum(image, np.float32(np.max(brightness)), out=image)  # no lobe shows more than there is
        return image

    def work():
        if _is_brdf(scene, quantity):
            return [], shading.by_brdf(scene, greys, engine, max_distance)
        irradiances = _each(greys, light) if _is_dull(scene, quantity) else []
        return irradiances, _each(greys, lambda grey: light(grey, lobe)) if lobe else _mirrored(scene, greys, engine, quantity, max_distance)

    (irradiances, shown), seconds, compiling = timed(engine, work)
    return Rendering(_image(scene, irradiances, shown, quantity), plan, engine.name, seconds, compiling, found)


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
