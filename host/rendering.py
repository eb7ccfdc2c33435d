"""render(): a scene and a source to an image (Eq. 3)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from . import shading, sources
from .arrays import labelled
from .backends.base import Backend
from .checks import one_of, positive_number
from .directions import Azimuths, Hemicube
from .errors import bad
from .light import propagation, unoccluded
from .light.lattice import ERRORS, lacking
from .light.propagation import Problem
from .light.slices import KNOTS, MOST, SLICES, TURNS, Slices, blurred, brightness_of, widened
from .light.sweeps import FINE, Rays, Sweeps, engine_of, ground_of
from .refinement import Plan, Refined, refined, solid_of, upright
from .reflectance import BRDF
from .scene import Scene, is_scene
from .sources import cie as skies
from .sources.integrals import Integrals, chords
from .sources.solids import Dome

METHODS = ("auto", "lattice", "horizon", "unoccluded")
QUANTITIES = ("radiance", "irradiance")
FAR = 1e5  # extents of the map at which the sun stands: a hundred-thousandth of a radian across it
BOX = 4  # nodes round a node over which the error map is a mean: halves tell of regions, not of nodes
MAP = np.float32(
    1.25
    # what the error map is more than the RMS error; chosen: with it 84, 93 and 95 % of all nodes keep to one, two
    # and three times the map (performance/refinement.py)
)
COARSE = (
    1.2  # half widths of a lobe between directions, from which on its sum may be too large by 1 in a thousand
)
LEAK_SLOPE = 0.7  # rms slope from which the unfilled step leaks from M = 7 on (README, Limits)
REPEATED_LOBE = "a lobe over a map that repeats"


@dataclass(frozen=True, eq=False)
class Rendering:
    """What render() gives.

    image (rows, cols) float32, or (rows, cols, 3) in colour, nan where masked, an xarray.DataArray if the
    scene was made from one; plan; backend (its name); seconds of the call without compiling, compile_seconds;
    warnings (one sentence each). error: see there.
    """

    image: np.ndarray
    plan: Plan
    backend: str
    seconds: float
    compile_seconds: float
    warnings: list[str] = field(default_factory=list)
    _parts: tuple[tuple[Refined, float], ...] = field(default=(), repr=False)
    _scene: Scene | None = field(default=None, repr=False)
    _quantity: str = field(default="radiance", repr=False)

    @cached_property
    def error(self) -> np.ndarray | None:
        """Estimated error of every node, in the unit of image and of its shape, nan where masked; None where
        no tolerance was asked.

        The root mean square, over 9 x 9 nodes, of half the difference of the image's two halves, times the
        share of it that is error, and besides what both halves share. It shows regions, not nodes: of nodes,
        84, 93 and 95 % were within one, two and three times it on random scenes. What a lobe or a mirror adds
        has no part in it.
        """
        if not self._parts:
            return None
        spread = [np.float32(factor) * _spread(found, self._scene) for found, factor in self._parts]
        return labelled(_image(self._scene, spread, [], self._quantity), self._scene.labels)


def render(
    scene: Scene,
    source: sources.Source,
    method: str = "auto",
    tolerance: float = 0.01,
    backend: str = "auto",
    quantity: str = "radiance",
    *,
    hemicube: int | Hemicube | None = None,
    filled: bool | None = None,
    weights: str = "moment",
    azimuths: int | Azimuths | None = None,
    max_distance: float | None = None,
    tail: float | None = None,
) -> Rendering:
    """The image of ``scene`` under ``source``, seen orthographically along +z (Langer and Zucker, Eq. 3).

    In colour, (rows, cols, 3), where the source's brightness or the scene's reflectance is; each channel is
    what a grey render of it gives, bit for bit. To rho E / pi comes what the scene's reflectance adds: the
    integral of f B cos(theta_i) over the visible directions, f a lobe or any BRDF, or what an ideal mirror
    shows.

    Parameters
    ----------
    scene, source : Scene; Sky, Lamp or Window
    method : "auto", "lattice", "horizon" or "unoccluded"
        ``auto``: begun as :func:`skylamp.plan` says and refined until the estimate of its error, over all
        nodes, and exact rays at some hundred samples are within ``tolerance``. ``lattice``: the paper's
        directions on a hemicube (9 unless given). ``horizon``: the source above the horizon of every node in
        a number of azimuths (64 unless given; for lamps and windows, slices through the source as every node
        sees it). ``unoccluded``: closed forms from the normals, as if ground hid nothing but what lies below
        each node's own tangent plane; the brightness of a lamp or window is that towards its middle.
    tolerance, tail : float
        Of ``auto``: relative RMS error of the irradiance, that over all valid nodes divided by the mean over
        the lit ones, and a bound on the
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
        Each cell's integral of N.L dL (exact where the cell is wholly visible and above the tangent plane),
        or N.L of its node times its solid angle, as Eq. 3 is printed.
    azimuths : int or Azimuths
        Of horizons. Under a sky whose brightness is very uneven in azimuth, such as one with a sun, a number
        of azimuths is placed half evenly, half by brightness.
    max_distance : float [unit of spacing]
        Of horizons under a sky: ground farther away does not count; the whole map does unless given.

    Raises
    ------
    InputError, BackendError, CapacityError

    Examples
    --------
    >>> out = render(Scene(depth), Sky(), tolerance=0.003)
    >>> print(out.plan, out.error.max())
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
        raise bad(
            "render: arguments of two methods",
            "azimuths or max_distance with the lattice's",
            "azimuths and max_distance with method='horizon'; hemicube, filled and weights with 'lattice'",
        )
    if method == "horizon" and lattice:
        raise bad("method 'horizon' with hemicube, filled or weights", "both", "azimuths and max_distance")
    if method == "unoccluded" and (lattice or horizon):
        raise bad(
            "method 'unoccluded' with arguments of another",
            "both",
            "neither azimuths and max_distance nor hemicube, filled and weights",
        )
    missing, lobe = lacking(scene, source), shading.lobe_of(scene) if quantity == "radiance" else None
    if scene.sides == "periodic" and lobe:
        missing = REPEATED_LOBE
    if missing and (method in ("horizon", "unoccluded") or horizon):
        raise bad(
            f"method '{'horizon' if horizon else method}'",
            missing,
            "a sky, a rectangular window, or a lamp given by its centre and radius, the last two with"
            " sides='open' or 'dark'",
            "Use method='lattice'.",
        )
    shines = lobe or _is_brdf(scene, quantity) or quantity == "radiance" and shading.has_mirror(scene)
    if method == "unoccluded" and shines:
        raise bad("method 'unoccluded'", type(scene.reflectance).__name__, "a Lambertian surface")
    planned = method == "auto" and not lattice and not horizon and missing != REPEATED_LOBE
    if tail is not None and not planned:
        raise bad("tail", tail, "a bound for method='auto' without arguments of a method")
    engine, greys = engine_of(scene, backend), sources.channels(source)
    sun = None if lattice or missing or planned and not shines else _sun_of(scene, source, max_distance)
    plans, warnings, parts = [], [], []

    def within():
        """Irradiances of all colours; where they differ by a factor alone, of one and times that factor."""
        alike = not any(callable(grey.brightness) for grey in greys)
        for grey in greys:
            found = (
                parts[0][0]
                if alike and parts
                else refined(scene, replace(grey, brightness=1.0) if alike else grey, tolerance, engine, tail)
            )
            parts.append((found, float(grey.brightness) if alike else 1.0))
            plans.append(found.plan)
            warnings.extend(text for text in found.warnings if text not in warnings)
        return [
            found.irradiance if factor == 1.0 else found.irradiance * np.float32(factor)
            for found, factor in parts
        ]

    def irradiance(grey, azimuths=azimuths):
        image, plan = _asked(scene, grey, engine, method, azimuths, max_distance)
        plans.append(plan)
        return image

    def light():
        if lattice or method == "lattice" or missing and (not planned or shines):
            plans.append(_lattice_plan(hemicube, filled, method, tolerance if not lattice else None))
            plan = plans[0]
            cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(plan.hemicube)
            return _by_lattice(scene, source, greys, engine, cube, plan.filled, weights, quantity, warnings)
        if _is_brdf(scene, quantity):
            plans.append(_plan_of(scene, greys[0], azimuths, max_distance)[0])
            if not isinstance(source, sources.Sky):
                return [], shading.by_brdf(scene, greys, engine, max_distance)
            sectors = azimuths if isinstance(azimuths, Azimuths) else Azimuths(azimuths or 64)
            return [], shading.by_brdf_under_sky(
                scene,
                greys,
                Sweeps(
                    engine,
                    ground_of(scene, max_distance, engine),
                    Rays(sectors.angles, sectors.widths),
                    near=FINE,
                ).planes(),
                sectors,
            )
        irradiances = []
        if _is_dull(scene, quantity) and planned:
            irradiances = within()
        elif _is_dull(scene, quantity):
            irradiances = _each([sources.without_disc(grey) for grey in greys], irradiance)
        if irradiances and sun is not None and not planned:
            irradiances[0] += irradiance(sun, None)  # the azimuths that were asked for are the sky's
        if not plans:
            plans.append(_plan_of(scene, greys[0], azimuths, max_distance)[0])
        if sun is not None and not planned:
            plans[0] = replace(plans[0], reason=f"{plans[0].reason}; the sun's disc by itself")
        if lobe and isinstance(source, sources.Sky):
            return irradiances, _each(
                greys, lambda grey: _gloss(scene, grey, engine, lobe, sun is not None, max_distance)
            )
        if lobe:
            return irradiances, _each(
                greys, lambda grey: _lamp_lobe(scene, grey, engine, lobe, azimuths, warnings)
            )
        return irradiances, _mirrored(scene, greys, engine, quantity, max_distance)

    (irradiances, shown), seconds, compiling = timed(engine, light)
    image = labelled(_image(scene, irradiances, shown, quantity), scene.labels)
    return Rendering(
        image,
        plans[0],
        engine.name,
        seconds,
        compiling,
        warnings,
        tuple(parts),
        scene if parts else None,
        quantity,
    )


def _spread(found: Refined, scene: Scene) -> np.ndarray:
    """Estimated error (rows, cols) float32 of a refined irradiance."""
    if found.half is None:
        return np.full(scene.shape, found.floor, np.float32)
    square, count = np.where(scene.valid, found.half.astype(float) ** 2, 0), scene.valid.astype(float)
    for axis in (0, 1):
        square, count = (_boxes(values, axis) for values in (square, count))
    return MAP * np.sqrt(found.share**2 * square / np.maximum(count, 1) + found.floor**2).astype(np.float32)


def _boxes(values, axis):
    """Sums over up to 2 BOX + 1 neighbours along an axis."""
    ends = np.concatenate([np.zeros_like(np.take(values, [0], axis)), np.cumsum(values, axis)], axis)
    at = np.arange(values.shape[axis])
    return np.take(ends, np.minimum(at + BOX + 1, len(at)), axis) - np.take(
        ends, np.maximum(at - BOX, 0), axis
    )


def _asked(scene, source, engine, method, azimuths, max_distance) -> tuple[np.ndarray, Plan]:
    """(irradiance (rows, cols) float32, plan) of a grey source as the caller asked for it."""
    is_sky = isinstance(source, sources.Sky)
    if method == "unoccluded":
        if is_sky:
            image = unoccluded.sky(
                scene, Integrals(source) if callable(source.brightness) else float(source.brightness)
            )
        else:
            solid = upright(solid_of(scene, source, 1 / scene.spacing, 1.0))
            image = (
                np.zeros(scene.shape, np.float32)
                if solid is None
                else unoccluded.image(scene, solid, source.brightness)
            )
        return image.astype(np.float32, copy=False), Plan("unoccluded", None, None, "as asked")
    plan, sectors = _plan_of(scene, source, azimuths, max_distance)
    if is_sky:
        table = None
        if callable(source.brightness):
            profile = sources.azimuth_profile(source)
            if profile is not None and not isinstance(azimuths, Azimuths):
                sectors = Azimuths.placed(len(sectors), profile)
            table = Integrals(source, np.inf).table(sectors.angles, sectors.widths, 1025)
        image = Sweeps(
            engine, ground_of(scene, max_distance, engine), Rays(sectors.angles, sectors.widths), table
        ).irradiance(last=True)
        return (
            image if table is not None or source.brightness == 1 else image * np.float32(source.brightness)
        ), plan
    brightness = (
        chords(Integrals(sources.Sky(source.brightness), np.inf, True), TURNS, KNOTS)
        if callable(source.brightness)
        else float(source.brightness)
    )
    slices, scale = _slices(scene, source, engine, plan.azimuths, brightness)
    if slices is None:
        return np.zeros(scene.shape, np.float32), plan
    slices.run()
    return (
        np.maximum(slices.download(), 0) * np.float32(scale),
        plan,
    )  # a difference of sums of brightness may round to less


def _plan_of(scene, source, azimuths, max_distance) -> tuple[Plan, Azimuths | None]:
    """Horizons or slices, as many as the caller asked for."""
    if getattr(source, "corner", None) is None:
        sources.geometry(source, scene, 1.0)  # checks that they fit
    if not isinstance(source, sources.Sky):
        if max_distance is not None or isinstance(azimuths, Azimuths):
            raise bad(
                "method 'horizon' with a lamp or window",
                "max_distance, or azimuths of the caller's",
                "azimuths as a whole number: slices of a source that stands all round",
            )
        most = MOST if azimuths is None else -(-len(Azimuths(azimuths)) // SLICES) * SLICES
        return (
            Plan(
                "horizon",
                None,
                None,
                "slices through the source as every node sees it, fewer where it looks small",
                most,
            ),
            None,
        )
    sectors = azimuths if isinstance(azimuths, Azimuths) else Azimuths(64 if azimuths is None else azimuths)
    return Plan("horizon", None, None, "as asked", len(sectors), max_distance), sectors


def _slices(scene, source, engine, most, brightness, lobe=None) -> tuple[Slices | None, float]:
    """(azimuth slices placed within a lamp or window as every node sees it, what their light is to be
    multiplied by); None for a window outside the box.
    """
    depth, step = scene.lattice()
    solid = solid_of(scene, source, step / scene.spacing, step)
    if solid is None:
        return None, 1.0
    solid, scale = widened(solid, depth, step)
    return Slices(engine, depth, step, scene.sides, solid, brightness, most, lobe), scale


def _by_lattice(scene, source, greys, engine, cube, filled, weights, quantity, found) -> tuple[list, list]:
    """(irradiances, what the surface shows besides) over the directions of a hemicube; warnings go into
    ``found``.
    """
    problem = lattice_problem(scene, source, cube, filled)  # first: it checks that the source fits
    found += warnings_of(scene, source, cube, filled)
    brightness = np.stack([sources.radiance(grey, cube.directions) for grey in greys])
    moments = cube.moments if weights == "moment" else cube.directions * cube.solid_angles[:, None]
    lobe, shares, whole = shading.lobe_of(scene, 1e-6) if quantity == "radiance" else None, None, None
    if lobe:
        angles = cube.solid_angles * scene.reflectance.norm
        shares, whole = (
            np.concatenate([np.broadcast_to(cube.directions, (*share.shape, 3)), share[..., None]], -1)
            for share in (brightness * angles, angles)
        )
        spacing = np.sqrt(2 * np.pi / len(cube))
        if spacing <= COARSE * lobe.spread:
            whole = None  # the sum is exact enough
        else:
            found.append(_narrow(lobe, spacing, "method='horizon' or a larger hemicube"))
    if _is_brdf(scene, quantity):
        return [], shading.by_brdf_on_lattice(scene, greys, propagation.visibility(engine, problem), cube)
    irradiances, shown = propagation.light(
        engine, problem, moments * brightness[..., None], lobe, shares, whole
    )
    return irradiances, shown + _mirrored(scene, greys, engine, quantity, None)


def _gloss(scene, grey, engine, lobe, has_sun, max_distance):
    """What a lobe makes of a sky: (rows, cols) float32."""
    depth, step = scene.lattice()
    reach = np.inf if max_distance is None else max_distance * (step / scene.spacing)
    table, suns, flux = blurred(sources.without_disc(grey), lobe.spread)
    if has_sun:
        suns, flux = (
            np.concatenate([suns.reshape(-1, 3), [skies.towards(*grey.brightness.sun)]]),
            np.append(flux, grey.brightness.direct),
        )
    slices = Slices(engine, depth, step, scene.sides, Dome(reach), table, lobe=lobe)
    slices.run()
    image = slices.download()
    if len(suns):
        image += shading.suns(scene, engine, lobe, suns, flux, max_distance)
    return image * np.float32(scene.reflectance.norm)


def _lamp_lobe(scene, grey, engine, lobe, azimuths, found):
    """What a lobe makes of a lamp or window: (rows, cols) float32."""
    brightness = brightness_of(grey)
    slices, scale = _slices(
        scene, grey, engine, _plan_of(scene, grey, azimuths, None)[0].azimuths, brightness, lobe
    )
    if slices is None:
        return np.zeros(scene.shape, np.float32)
    slices.run()
    image = slices.download() * np.float32(scene.reflectance.norm * scale)
    if slices.coarse > COARSE:
        text = _narrow(lobe, slices.coarse * lobe.spread, "a smaller lamp, or Mirror")
        found.extend([text] if text not in found else [])
        np.minimum(image, np.float32(np.max(brightness)), out=image)  # no lobe shows more than there is
    return image


def _image(scene: Scene, irradiances: list[np.ndarray], shown: list[np.ndarray], quantity: str) -> np.ndarray:
    """What was asked for, made in place of irradiance and, per unit of specular albedo, of what the surface
    shows besides; a list has one array per colour.
    """
    if quantity == "radiance":
        albedo, specular = (
            np.asarray(getattr(scene.reflectance, name, 1.0), np.float32) for name in ("albedo", "specular")
        )
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
    return (
        shading.mirrored(scene, greys, engine, max_distance)
        if quantity == "radiance" and shading.has_mirror(scene)
        else []
    )


def _is_dull(scene: Scene, quantity: str) -> bool:
    """Whether irradiance is asked for, or reflected: a surface that only shines needs none."""
    return (
        quantity == "irradiance"
        or np.any(scene.albedo)
        or not (shading.lobe_of(scene) or shading.has_mirror(scene))
    )


def _narrow(lobe, apart: float, fix: str) -> str:
    return (
        f"Narrow lobe: it is {np.degrees(lobe.spread):.1f} degrees wide and the directions stand up to"
        f" {np.degrees(apart):.1f} degrees apart, so highlights break up into dots or are lost; use {fix}."
    )


def _each(greys: list, work: Callable) -> list[np.ndarray]:
    """``work`` (source) for every colour; where colours differ by a factor alone, once, and times that
    factor.
    """
    if any(callable(grey.brightness) for grey in greys):
        return [work(grey) for grey in greys]
    one = work(replace(greys[0], brightness=1.0))
    return [one if grey.brightness == 1 else one * np.float32(grey.brightness) for grey in greys]


def _sun_of(scene, source, max_distance) -> sources.Lamp | None:
    """The disc of a sky's sun, as a lamp so far away that it stands in one direction for the whole map."""
    if not isinstance(source, sources.Sky) or not getattr(source.brightness, "direct", 0):
        return None
    if scene.sides == "periodic" or max_distance is not None:
        raise bad(
            "a sky with the sun's disc (direct)",
            f"sides={scene.sides!r}, max_distance={max_distance}",
            "sides 'open' or 'dark' and the whole map",
        )
    if isinstance(scene.reflectance, BRDF) or shading.has_mirror(scene):
        raise bad(
            "a sky with the sun's disc (direct)",
            type(scene.reflectance).__name__,
            "Lambertian or Phong",
            "Give the sun as a Lamp of its own.",
        )
    extent = max(max(scene.shape) * scene.spacing, float(scene.depth[scene.valid].max()))
    return source.brightness.disc(FAR * extent)


def lattice_problem(scene: Scene, source: sources.Source, cube: Hemicube, filled: bool) -> Problem:
    """The arrays that a backend needs, from a scene and a source."""
    is_scene(scene)
    values, step = scene.lattice()
    return Problem(values, step, scene.sides, cube.steps, sources.geometry(source, scene, step), filled)


def timed(engine: Backend, work: Callable[[], tuple]) -> tuple[tuple, float, float]:
    """(result, seconds without compiling, seconds of compiling) of ``work``, once the engine is free."""
    with engine.lock:
        compiled, start = engine.compile_seconds, time.perf_counter()
        result = work()
        compiling = engine.compile_seconds - compiled
        return result, time.perf_counter() - start - compiling, compiling


def _lattice_plan(hemicube, filled, method, tolerance) -> Plan:
    given = hemicube.size if isinstance(hemicube, Hemicube) else hemicube
    filled = filled is not False if method == "auto" else bool(filled)
    if method == "auto" and given is None and tolerance is not None:
        given = next((m for m, error in ERRORS.items() if error <= tolerance), max(ERRORS))
        return Plan("lattice", given, filled, f"RMS error {ERRORS[given]} of E / pi on rough ground")
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
            found.append(
                f"Leak: the rms slope is {np.sqrt(square):.2f}, and steps of {cube.reach} nodes jump over"
                " ridges, so light leaks through; use filled=True."
            )
    if isinstance(source, sources.Lamp) and source.center is not None:
        rows, cols = scene.shape
        x, y, z = source.center
        far = np.sqrt(
            (max(abs(x), abs((cols - 1) * scene.spacing - x))) ** 2
            + max(abs(y), abs((rows - 1) * scene.spacing - y)) ** 2
            + (depth.max() - z) ** 2
        )
        spacing = np.sqrt(2 * np.pi / len(cube))
        apparent = 2 * np.arcsin(min(1.0, source.radius / far))
        if apparent < 2 * spacing:
            found.append(
                f"Small lamp: from the farthest ground it is {np.degrees(apparent):.1f} degrees wide and the"
                f" directions stand {np.degrees(spacing):.1f} degrees apart, so some nodes see it in few"
                " directions or none; use a larger hemicube."
            )
    return found
