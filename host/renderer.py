"""One call of render(): the method, its irradiances, light between surfaces, lobes and mirrors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from . import shading, sources
from .arrays import by_bands, labelled
from .backends.base import Backend, timed
from .backends.resident import DeviceImage
from .constants import SLICES
from .directions import Azimuths, Hemicube
from .errors import bad
from .images import (
    IMAGES,
    Irradiance,
    Rendering,
    image_of,
    is_in_colour,
    numbers_of,
    on_host,
    per_colour,
    scaled,
)
from .interreflection import CHECKED, Interreflection, included, is_needed, reason, share_everywhere
from .light import lattice, propagation, unoccluded
from .light.finite import WINDOWED_PART, add_bright_parts, left_below, solid_of
from .light.interreflection import Glossy
from .light.propagation import Lobe
from .light.slices import (
    BRIGHTNESS_SIDE,
    CHORD_AZIMUTHS,
    CHORD_KNOTS,
    MOST,
    Slices,
    blurred,
    stereographic_brightness,
    widened,
)
from .light.sweeps import FINE_NEAR_ROWS, Rays, Sweeps, ground_of
from .planning.base import gap_below, lamp_below, undefined_light
from .planning.plan import Choice, Plan, percent
from .refinement import ASSUMED_ERROR_RATIO, Refined, refined
from .reflectance import BRDF, Phong
from .render_options import Options, sectors_of
from .samples import lit_mean
from .scene import Scene
from .sources.integrals import integrals
from .sources.solids import Dome, upright

DEFAULT_HEMICUBE = 9  # of the hemicube of method "lattice", unless given
SUN_DISTANCE = 1e5  # extents of the map at which the sun stands: a hundred-thousandth of a radian across it
# half widths of a lobe between directions, on average, up to which it is summed without a warning. Of lobes
# that nothing hides the sum then errs by up to 1.8 %; with half of it by 0.8 %, with twice by 80 % (hemicubes
# of 9 to 33, tests/test_reflectance.py)
COARSE_LOBE = 1.2
# times the slices of a lobe, tried in turn. Chosen: no two share slices, and smooth brightness is mostly done
# with 1 at 1 %. Exponents 5 to 600, errors [%] at 1 % and (.3 %) against 11 times: skies with a step, stripes
# or noise .2 to .4 (.07 to .14), by 1 .6 to 2.2; smooth skies .2 to .3 (.09 to .2); windows, spheres with a
# step or stripes .3 to .9 (.09 to .8, beyond .3 with a warning), by 1 .9 to 7.0 (performance/lobes.py)
LOBE_FINENESS = 0.5, 1, 3, 8
# of the tolerance that the first difference may be: two images may be alike by chance, above all of level
# ground, whose nodes have one error. Of 210 lobes (exponents 0 to 40, skies of noise) at .1 % 1.4 % are
# beyond it, 0 beyond three times; with 1 2.4 % and 1, with a half 1.9 % and 1, with a fifth .5 % and 0. At
# 1 % it takes 12 % more slices than 1 does, a half 9 and a fifth 15 % (performance/lobes.py --noise 14)
FIRST_SHARE = 1 / 3
LOBE_DISC_POINTS = 2  # of a sun's disc in a lobe, times the fineness; chosen
# of the tolerance that rays may take which look for ground in lobes; chosen: errors add by squares, and
# estimates of the other light take up to 0.85
LOBE_SHARE = 0.5


class Renderer:
    """One call of :func:`render`, with its plans, warnings and refined irradiances."""

    def __init__(self, scene: Scene, source: sources.Source, engine: Backend, options: Options):
        self.scene, self.source, self.engine, self.options = scene, source, engine, options
        self.greys = sources.channels(source)
        self.lobe, self.planned = options.lobe(scene), options.planned(scene, source)
        missing, shines = options.missing(scene, source), options.shines(scene)
        asked = options.lattice or options.method == "lattice"
        self.by_lattice = asked or bool(missing and (not self.planned or shines))
        no_disc = options.lattice or missing or self.planned and not shines
        self.sun = None if no_disc else _sun_of(scene, source, options.max_distance)
        # an image of one channel, rho E / pi alone, is made on the device; with arguments of a method on a
        # GPU alone: on a CPU the memory of its arrays is freed as they are done with
        grey = len(self.greys) == 1 and np.ndim(scene.albedo) in (0, 2) and not shines
        self.on_device = grey and not options.parts and (self.planned or not engine.shares)
        self.stays = scene.stays_on(engine) and self.on_device  # it is left where the map was given
        self.plans: list[Plan] = []
        self.warnings: list[str] = []
        if scene.rounding:
            self.warnings.append(
                f"Depths are rounded by {scene.rounding:.2g} spacings, as float32: subtract the same depth"
                " from the map and from the source; give a window as a rectangular lamp, corner= and edges=."
            )
        if options.chooses and missing and (self.lobe or options.brdf(scene) or not self.planned):
            what = "error of the specular lobe" if self.planned and self.lobe else "error"
            self.warnings.append(
                f"Tolerance: the {what} is not known, {missing} takes directions of the lattice, whatever the"
                " tolerance is."
            )
        self.parts: list[tuple[Refined, float]] = []  # refined irradiances, times factors
        self.unlit: np.ndarray | None = None  # (rows, cols) bool: mirrors that do not show the source
        self.interreflection: Interreflection | None = None
        self.share: float | None = None  # RMS of the light between surfaces over the mean of the direct light
        self.between: list[float] = []  # error of the light between surfaces, of every part

    def render(self) -> Rendering:
        """All of it, timed."""
        (direct, irradiances, shine, shown), seconds, compiling = timed(self.engine, self._all_light)
        scene, quantity = self.scene, self.options.quantity
        first = rest = None
        if self.options.parts:
            first = image_of(scene, [light.copy() for light in on_host(direct)], shine, quantity)
        image = self._image(irradiances, shown)
        if first is not None:
            if image.ndim > first.ndim:  # a coloured ground alone colours an irradiance
                first = np.repeat(first[..., None], image.shape[-1], -1)
            rest = image - first
        image, first, rest = (labelled(v, scene.labels, IMAGES[quantity]) for v in (image, first, rest))
        plan = self.plans[0] if self.plans[0].seconds is None else replace(self.plans[0], seconds=seconds)
        return Rendering(
            image,
            plan,
            self.engine.name,
            seconds,
            compiling,
            self.warnings,
            tuple((part._replace(irradiance=None), factor) for part, factor in self.parts),
            scene if self.parts else None,
            quantity,
            self.interreflection,
            first,
            rest,
            tuple(self.between),
        )

    def _image(self, irradiances: list[Irradiance], shine: list[np.ndarray]) -> np.ndarray | DeviceImage:
        """The image of the quantity that was asked for, where the irradiances lie, or the map if it stays."""
        scene, engine, quantity = self.scene, self.engine, self.options.quantity
        light = irradiances[0] if irradiances else None
        if isinstance(light, DeviceImage) and (self.stays or not np.ndim(scene.albedo)):
            share = (scene.albedo, 1 / np.pi) if quantity == "radiance" else (1.0, 1.0)
            light.shade(scene.on(engine), *share, least=0.0)  # differences of sums round to less than 0
            if not self.stays:
                return np.asarray(light)
            light.held = None
            return light
        image = image_of(scene, on_host(irradiances), shine, quantity)
        if not self.stays or image.ndim > 2:
            return image
        return DeviceImage(engine, engine.upload(image.reshape(-1)), scene.shape)

    def _all_light(self) -> tuple[list[Irradiance], list[Irradiance], list[np.ndarray], list[np.ndarray]]:
        """Direct irradiances, irradiances of all light, and what else is reflected of direct light and of all
        light: an array per colour each."""
        self.warnings += undefined_light(self.source, gap_below(self.scene, self.source, self.engine))
        direct, shine = self._light()
        self.warnings += _left_below(self)
        irradiances = self._with_bounces(direct)
        return direct, irradiances, shine, _with_ground(self, irradiances, shine)

    def _with_bounces(self, direct: list[Irradiance]) -> list[Irradiance]:
        """Irradiances of all light, or of direct light where the rest is left out."""
        self.share = _share_between(self.plans)
        why = _left_out(self, direct)
        if why or not direct:
            why = why or "there is no Lambertian reflection to show"
            self.interreflection = Interreflection(False, why, self.share)
            self.between = [0.0] * len(direct)
            # light between surfaces would be in colour, so this is too, whether it is included or not
            coloured = self.options.chooses and self.options.interreflection == "auto" and len(direct) == 1
            coloured = coloured and is_in_colour(np.asarray(self.scene.albedo))
            return list(direct) * (3 if coloured else 1)
        return list(_interreflected(self, direct if self.on_device else on_host(direct)))

    def _light(self) -> tuple[list[Any], list[np.ndarray]]:
        """Irradiances, and the radiance that is reflected besides rho E / pi: one array per colour each."""
        if self.by_lattice:
            return self._lattice()
        if self.options.brdf(self.scene):
            return [], self._brdf()
        irradiances = self._irradiances() if self.options.needs_irradiance(self.scene) else []
        if not self.plans and self.planned:
            ways = "slices until within the tolerance" if self.lobe else "one ray a node"
            self.plans.append(Plan("horizon", None, None, f"no matte share of light; reflected by {ways}"))
        elif not self.plans:
            self._plan_as_asked()
        if self.sun is not None and not self.planned:
            self.plans[0] = replace(self.plans[0], reason=f"{self.plans[0].reason}; the sun's disc by itself")
        if self.lobe:
            lobe_of = self._sky_lobe if isinstance(self.source, sources.Sky) else self._solid_lobe
            if not self.planned:
                return irradiances, per_colour(self.greys, lobe_of)
            return irradiances, _refined_lobes(self, lobe_of, irradiances)
        return irradiances, self._mirrored()

    def _irradiances(self) -> list[Irradiance]:
        if self.planned:
            return self._within_tolerance()
        options = self.options
        irradiances = per_colour(
            [sources.without_disc(grey) for grey in self.greys],
            lambda grey: self._as_asked(grey, options.azimuths),
        )
        if self.sun is not None:
            # the azimuths that were asked for are the sky's
            irradiances[0] = np.asarray(irradiances[0]) + np.asarray(self._as_asked(self.sun, None))
        return irradiances

    def _within_tolerance(self) -> list[Irradiance]:
        """Irradiances of all colours; where they differ by a factor alone, of one and times that factor."""
        factors, options = numbers_of(self.greys), self.options
        tolerance = float(options.tolerance)
        for n, grey in enumerate(self.greys):
            if factors is None or n == 0:
                source = grey if factors is None else replace(grey, brightness=1.0)
                how = tolerance, self.engine, options.tail, options.interreflection, self.on_device
                result = refined(self.scene, source, *how)
            self.parts.append((result, 1.0 if factors is None else factors[n]))
            self.plans.append(result.plan)
            self.warnings.extend(text for text in result.warnings if text not in self.warnings)
        return [scaled(result.irradiance, factor) for result, factor in self.parts]

    def _as_asked(self, grey: sources.Source, azimuths: int | Azimuths | None) -> Irradiance:
        """Irradiance (rows, cols) float32 of a grey source by the method and as many units as were asked."""
        scene, engine, max_distance = self.scene, self.engine, self.options.max_distance
        if self.options.method == "unoccluded":
            self.plans.append(Plan("unoccluded", None, None, "as asked"))
            return _unoccluded(scene, grey)
        plan = _plan_of(scene, grey, azimuths, max_distance)
        self.plans.append(plan)
        if isinstance(grey, sources.Sky):
            return _sky_above_horizons(scene, grey, engine, azimuths, max_distance, self.on_device)
        return _by_slices(scene, grey, engine, plan, self.on_device, float(self.options.tolerance))

    def _plan_as_asked(self) -> None:
        options = self.options
        self.plans.append(_plan_of(self.scene, self.greys[0], options.azimuths, options.max_distance))

    def _brdf(self) -> list[np.ndarray]:
        """Radiance of a BRDF, along rays whose number does not depend on the tolerance."""
        scene, options = self.scene, self.options
        self._plan_as_asked()
        if isinstance(self.source, sources.Sky):
            sectors = sectors_of(options.azimuths, scene.axes)
            ground = ground_of(scene, options.max_distance, self.engine)
            sweeps = Sweeps(self.engine, ground, Rays(sectors.angles, sectors.widths), near=FINE_NEAR_ROWS)
            parts = shading.above_horizons(scene, sweeps.planes(), sectors)
        else:
            parts = shading.through_solid(scene, self.greys[0], self.engine, options.max_distance)
        images, lights, differences = shading.by_brdf(scene, self.greys, parts)
        if options.chooses:
            self.warnings += _between_rays(self, images, differences)
            self.plans[0] = replace(self.plans[0], reason="a BRDF takes as many rays for every tolerance")
            self.warnings += _missed_by_rays(self, lights)
        return list(images)

    def _sky_lobe(self, grey: sources.Source, fineness: float = 1) -> np.ndarray:
        """A sky reflected by a lobe: (rows, cols) float32."""
        scene, engine, lobe, max_distance = self.scene, self.engine, self.lobe, self.options.max_distance
        assert lobe is not None, "called for surfaces with a lobe"
        there = scene.on(engine)
        reach = np.inf if max_distance is None else max_distance * (there.step / scene.spacing)
        table, suns, flux = blurred(sources.without_disc(grey), lobe.spread, math.ceil(fineness / 2))
        brightness = sources.distribution_of(grey)
        if brightness is not None and (disc := brightness.disc()) is not None:
            count = math.ceil(LOBE_DISC_POINTS * fineness)
            suns = np.concatenate([suns.reshape(-1, 3), disc.points(count)])
            flux = np.append(flux, np.full(count, disc.irradiance / count))
        slices = Slices(there, scene.sides, Dome(reach), table, lobe=lobe, fineness=fineness)
        slices.run()
        image = slices.download()
        if len(suns):
            image += shading.suns(scene, engine, lobe, suns, flux, max_distance)
        return image * np.float32(_phong(scene).norm)

    def _solid_lobe(self, grey: sources.Source, fineness: float = 1) -> np.ndarray:
        """A lamp or window reflected by a lobe: (rows, cols) float32; a warning if slices are too coarse."""
        scene, lobe = self.scene, self.lobe
        most = _plan_of(scene, grey, self.options.azimuths, None).azimuths
        assert lobe is not None and most is not None, "the surface has a lobe, the plan a number of slices"
        assert not isinstance(grey, sources.Sky), "a sky has no slices through a solid"
        # finer, as an edge between two samples lies anywhere between them
        brightness = stereographic_brightness(grey, int(BRIGHTNESS_SIDE * max(1, (fineness + 1) / 2)))
        slices, scale = _slices(scene, grey, self.engine, most, brightness, lobe, fineness)
        if slices is None:
            return np.zeros(scene.shape, np.float32)
        slices.run()
        image = slices.download() * np.float32(_phong(scene).norm * scale)
        warnings = _narrow_lobe(lobe, slices.coarse * lobe.spread, "a smaller lamp, or Mirror")
        if warnings:
            self.warnings.extend(text for text in warnings if text not in self.warnings)
            np.minimum(image, np.float32(np.max(brightness)), out=image)  # no lobe shows more than there is
        return image

    def _mirrored(self) -> list[np.ndarray]:
        if not self.options.mirror(self.scene):
            return []
        images, lit = shading.mirrored(self.scene, self.greys, self.engine, self.options.max_distance)
        self.unlit = ~lit
        return images

    def _lattice(self) -> tuple[list[Any], list[np.ndarray]]:
        """:meth:`_light` over the directions of a hemicube; its irradiances are refined if they may be."""
        options, scene, source = self.options, self.scene, self.source
        refines = self.planned and options.needs_irradiance(scene) and not options.brdf(scene)
        refined_light = self._within_tolerance() if refines else []
        plan = self.plans[0] if self.plans and self.plans[0].hemicube else lattice_plan(options)
        self.plans = self.plans or [plan]
        assert plan.hemicube is not None, "a plan of the lattice has a hemicube"
        cube = options.hemicube if isinstance(options.hemicube, Hemicube) else Hemicube(plan.hemicube)
        # checks that the source fits
        problem = lattice.problem_of(self.engine, scene, source, cube, bool(plan.filled))
        self.warnings.extend(lattice.warnings_of(problem, scene, source, cube))
        within = float(options.tolerance) if self.planned else None
        moments, brightness, L = map(np.stack, zip(*(_by_cells(grey, cube, within) for grey in self.greys)))
        lobe = shading.lobe_of(scene, 1e-6) if options.quantity == "radiance" else None
        shares = whole = None
        if lobe:
            angles = cube.solid_angles * _phong(scene).norm
            shares, whole = (
                np.concatenate([np.broadcast_to(ways, (*share.shape, 3)), share[..., None]], -1)
                for ways, share in ((L, brightness * angles), (cube.directions, angles))
            )
            apart = np.sqrt(2 * np.pi / len(cube))
            only = self.options.missing(scene, self.source)
            fix = "a larger hemicube" if only else "method='horizon' or a larger hemicube"
            warnings = _narrow_lobe(lobe, apart, fix)
            self.warnings.extend(warnings)
            whole = whole if warnings else None  # the sum is exact enough
        if options.brdf(scene):
            bits = propagation.visibility(self.engine, problem)
            images, lights, _ = shading.by_brdf(scene, self.greys, shading.of_lattice(bits, cube))
            if options.chooses:
                self.warnings += _missed_by_rays(self, lights)
            return [], list(images)
        if refined_light and lobe is None:
            return refined_light, self._mirrored()
        if options.weights == "printed":
            moments = cube.directions * cube.solid_angles[:, None] * brightness[..., None]
        irradiances, reflected = propagation.light(
            self.engine, problem, moments, lobe, shares, whole, self.on_device
        )
        return refined_light or irradiances, reflected + self._mirrored()


def _by_cells(
    grey: sources.Source, cube: Hemicube, tolerance: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every direction's cell: the integral of B L dOmega (D, 3), B (D,), and L (D, 3).

    B is that of the direction; with a ``tolerance`` its mean over the cell, and L that of the light, if it
    varies behind a window.
    """
    varies = isinstance(grey, sources.Window) and callable(grey.brightness)
    if tolerance is None or not varies:
        brightness = sources.radiance(grey, cube.directions)
        return cube.moments * brightness[:, None], brightness, cube.directions
    moments = lattice.moments_of(grey, cube, integrals(sources.Sky(grey.brightness), tolerance))
    length = np.linalg.norm(moments, axis=1)
    L = np.where(length[:, None] > 0, moments / np.maximum(length, 1e-300)[:, None], cube.directions)
    return moments, length / np.linalg.norm(cube.moments, axis=1), L


def _between_rays(call: Renderer, images: np.ndarray, differences: np.ndarray) -> list[str]:
    """A warning if half differences (greys, rows, cols) of the images by a BRDF are beyond the tolerance."""
    valid, tolerance, error = call.scene.valid, float(call.options.tolerance), 0.0
    for image, difference in zip(images, differences):
        if mean := lit_mean(image[valid]):
            rms = math.sqrt(float(np.mean(difference[valid] ** 2)))
            error = max(error, ASSUMED_ERROR_RATIO * rms / mean)
    if error <= tolerance:
        return []
    return [
        f"Tolerance: the estimated error of the BRDF's image is {100 * error:.3g} % of the mean (RMS), more"
        f" than the {100 * tolerance:.3g} % asked for: its lobes are narrow for as many rays."
    ]


def _missed_by_rays(call: Renderer, lights: np.ndarray) -> list[str]:
    """A warning if irradiances (greys, rows, cols) by the rays of a BRDF are not within the tolerance, by
    those of a matte surface.
    """
    scene, tolerance = call.scene, float(call.options.tolerance)
    factors, valid, error = numbers_of(call.greys), scene.valid, 0.0
    some = range(len(lights)) if factors is None else [int(np.argmax(factors))]  # they differ by a factor
    for grey, light in [(call.greys[n], lights[n]) for n in some]:
        exact = np.asarray(refined(scene, grey, tolerance, call.engine, None, False).irradiance)[valid]
        if exact.any():
            error = max(error, float(np.sqrt(np.mean((light[valid] - exact) ** 2)) / lit_mean(exact)))
    if error <= tolerance:
        return []
    return [
        f"Tolerance: the light along the rays of a BRDF is {100 * error:.3g} % off (RMS over the mean), more"
        f" than the {100 * tolerance:.3g} % asked for: what is narrow or partly hidden falls between them."
    ]


def _left_below(call: Renderer) -> list[str]:
    """A warning if ground sees a part of the lamp below its level, by more light than the tolerance."""
    lamp = call.source
    if not isinstance(lamp, sources.Lamp) or lamp.volume is not None:
        return []
    if any(plan.method == "unoccluded" for plan in call.plans):
        return []
    greys = [grey for grey in call.greys if isinstance(grey, sources.Lamp)]
    lost = max(left_below(call.scene, grey, call.engine) for grey in greys)
    return [lamp_below(lost)] if lost > float(call.options.tolerance) else []


# -- light between surfaces


def _interreflected(call: Renderer, direct: Sequence[Irradiance]) -> Sequence[Irradiance]:
    """Irradiances of all light; where colours differ by a factor alone, of one and times that factor."""
    scene, options, factors = call.scene, call.options, numbers_of(call.greys)
    tolerance = float(options.tolerance)
    brightest = 0 if factors is None else int(np.argmax(factors))
    alike = factors is not None and factors[brightest] > 0 and np.ndim(scene.albedo) in (0, 2)
    sky: Irradiance | None = None
    lights = direct
    if alike and factors is not None:  # that of brightness 1, as it is for a grey source
        most = np.float32(factors[brightest])
        lights = [call.parts[0][0].irradiance if call.parts else np.asarray(direct[brightest]) / most]
    if alike and factors is not None and _is_above_horizons(call):
        sky = scaled(lights[0], 1 / np.pi)
    error = max((plan.error or 0.0 for plan in call.plans), default=0.0)
    known = not call.planned or all(plan.error is not None for plan in call.plans)
    why = "as asked"
    if options.interreflection == "auto":
        why = reason(call.share, tolerance)
    bounds: dict[str, Any] = dict(tail=options.tail, max_distance=options.max_distance)
    both = included(scene, call.engine, lights, tolerance, why, error, sky, **bounds)
    call.interreflection = both.record if known else replace(both.record, error=None)
    call.warnings.extend(both.warnings)
    if call.planned and known:
        plan, all_light = call.plans[0], both.record.error or 0.0
        how = f"RMS over the mean, by exact strips at {CHECKED} nodes; the error above is of direct light"
        call.plans[0] = replace(
            plan,
            error=both.record.error,
            reason=f"{plan.reason}; of all light {all_light:.2g}",
            choices=(*plan.choices, Choice("error of all light", percent(all_light), how)),
        )
    if not alike or factors is None:
        call.between = [max(both.errors)] if len(direct) == 1 else both.errors
        return both.irradiances
    call.between = [factor * both.errors[0] for factor in factors]
    return [scaled(both.irradiances[0], factor) for factor in factors]


def _with_ground(
    call: Renderer, irradiances: Sequence[Irradiance], shine: list[np.ndarray]
) -> list[np.ndarray]:
    """What is reflected besides rho E / pi, with the ground that lobes and mirrors show."""
    scene, options = call.scene, call.options
    asked = options.interreflection is True or options.interreflection == "auto" and options.chooses
    unlit, lobe = call.unlit, call.lobe
    if not asked or not irradiances or unlit is None and lobe is None:
        return shine
    image = image_of(scene, [light.copy() for light in on_host(irradiances)], [], "radiance")
    radiances = np.moveaxis(np.nan_to_num(image).reshape(*scene.shape, -1), -1, 0)  # 0 where masked
    ground = Glossy(call.engine, scene, radiances, options.max_distance)
    if unlit is not None:
        shown = np.where(unlit, ground.in_mirrors(), np.float32(0))
    else:
        assert lobe is not None, "a surface that shows ground is a mirror or has a lobe"
        error = LOBE_SHARE * float(options.tolerance) / float(np.max(_phong(scene).specular))
        shown = ground.within(lobe, error) * np.float32(_phong(scene).norm)
    count = max(len(shine), len(shown))
    return [shine[n % len(shine)] + shown[n % len(shown)] for n in range(count)]


def _left_out(call: Renderer, direct: Sequence[Irradiance]) -> str:
    """Why light between surfaces is left out, or nothing."""
    scene, options, tolerance = call.scene, call.options, float(call.options.tolerance)
    if options.interreflection is False:
        return "as asked"
    if not np.any(scene.albedo):
        return "the surface has no diffuse albedo"
    if options.interreflection is True:
        return ""
    if not options.chooses:
        return "the method that was asked for is of direct light"
    if call.share is None or is_needed(call.share, tolerance):
        return ""
    factors = numbers_of(call.greys) if _is_above_horizons(call) else None
    call.share = max(call.share, share_everywhere(scene, call.engine, direct, factors))
    return "" if is_needed(call.share, tolerance) else reason(call.share, tolerance)


def _is_above_horizons(call: Renderer) -> bool:
    """Whether the direct light is that of a sky above horizons."""
    return isinstance(call.source, sources.Sky) and not call.by_lattice


def _share_between(plans: list[Plan]) -> float | None:
    """The largest estimate of the light between surfaces, None where one is not known."""
    shares = [plan.interreflection for plan in plans]
    known = [share for share in shares if share is not None]
    return max(known) if known and len(known) == len(shares) else None


# -- irradiance of a grey source, as asked


def _plan_of(
    scene: Scene, source: sources.Source, azimuths: int | Azimuths | None, max_distance: float | None
) -> Plan:
    """Horizons or slices, as many as the caller asked for, checked."""
    if not (isinstance(source, sources.Lamp) and source.corner is not None):
        sources.geometry(source, scene, 1.0)  # checks that they fit
    if isinstance(source, sources.Sky):
        return Plan("horizon", None, None, "as asked", len(sectors_of(azimuths)), max_distance)
    if max_distance is not None or isinstance(azimuths, Azimuths):
        raise bad(
            "method 'horizon' with a lamp or window",
            "max_distance, or azimuths of the caller's",
            "azimuths as a whole number: slices of a source that stands all round",
        )
    why = "slices through the source as every node sees it, fewer where it looks small"
    return Plan("horizon", None, None, why, slice_count(azimuths))


def slice_count(azimuths: int | Azimuths | None) -> int:
    """Slices through a lamp or window, at most, of as many azimuths as asked."""
    return MOST if azimuths is None else -(-len(sectors_of(azimuths)) // SLICES) * SLICES


def lattice_plan(options: Options) -> Plan:
    """The lattice as asked; by "auto" without its arguments, a size whose error was measured to be small."""
    size = options.hemicube.size if isinstance(options.hemicube, Hemicube) else options.hemicube
    filled = options.filled is not False if options.method == "auto" else bool(options.filled)
    if options.method == "auto" and not options.lattice:
        errors = lattice.HEMICUBE_ERRORS
        size = next((m for m, error in errors.items() if error <= float(options.tolerance)), max(errors))
        return Plan("lattice", size, filled, f"RMS error {errors[size]} of E / pi on rough ground")
    return Plan("lattice", DEFAULT_HEMICUBE if size is None else size, filled, "as asked")


def _unoccluded(scene: Scene, source: sources.Source) -> np.ndarray:
    """Closed forms: (rows, cols) float32."""
    if isinstance(source, sources.Sky):
        varies = callable(source.brightness)
        image = unoccluded.sky(scene, integrals(source) if varies else sources.number_of(source))
    else:
        solid = upright(solid_of(scene, source))
        if solid is None:
            return np.zeros(scene.shape, np.float32)
        image = unoccluded.image(scene, solid, source.brightness)
    return image.astype(np.float32, copy=False)


def _sky_above_horizons(
    scene: Scene,
    sky: sources.Sky,
    engine: Backend,
    azimuths: int | Azimuths | None,
    max_distance: float | None,
    on_device: bool,
) -> Irradiance:
    """A sky above the horizons of as many azimuths as asked: (rows, cols) float32.

    ``on_device``: a DeviceImage.
    """
    sectors, table = sectors_of(azimuths, scene.axes), None
    if callable(sky.brightness):
        if not isinstance(azimuths, Azimuths) and (profile := sources.azimuth_profile(sky)) is not None:
            sectors = Azimuths.placed(len(sectors), profile, scene.axes)
        table = integrals(sky, np.inf).table(sectors.angles, sectors.widths, 1025)
    ground, rays = ground_of(scene, max_distance, engine), Rays(sectors.angles, sectors.widths)
    sweeps = Sweeps(engine, ground, rays, table)
    image: Irradiance = sweeps.image() if on_device else sweeps.irradiance()
    return image if table is not None else scaled(image, sources.number_of(sky))


def _by_slices(
    scene: Scene,
    source: sources.Lamp | sources.Window,
    engine: Backend,
    plan: Plan,
    on_device: bool,
    tolerance: float,
) -> Irradiance:
    """A lamp or window in as many slices as planned: (rows, cols) float32; ``on_device``: a DeviceImage.

    ``tolerance``: of the light of small bright parts behind a window, which get sectors of their own.
    """
    assert plan.azimuths is not None, "a plan of slices says how many"
    brightness: float | np.ndarray = sources.number_of(source)
    sky = None
    if callable(source.brightness):
        apart = (tolerance, True, WINDOWED_PART) if isinstance(source, sources.Window) else (math.inf, True)
        sky = integrals(sources.Sky(source.brightness), *apart)
        brightness = sky.chords(CHORD_AZIMUTHS, CHORD_KNOTS)
    slices, scale = _slices(scene, source, engine, plan.azimuths, brightness)
    if slices is None:
        return np.zeros(scene.shape, np.float32)
    slices.run()
    if sky is not None:
        add_bright_parts(slices, sky, plan.azimuths)
    if on_device:
        irradiance = DeviceImage(engine, slices.image, scene.shape, held=slices)
        irradiance.scale(scale, 0.0)  # a difference of sums may round to less than 0
        return irradiance
    image = slices.download()
    by_bands(lambda rows: np.maximum(image[rows], 0, out=image[rows]), image.shape)
    return scaled(image, scale)


def _slices(
    scene: Scene,
    source: sources.Lamp | sources.Window,
    engine: Backend,
    most: int,
    brightness: float | np.ndarray,
    lobe: Lobe | None = None,
    fineness: float = 1,
) -> tuple[Slices | None, float]:
    """Slices placed within a lamp or window as every node sees it, and the factor of their light.

    None for a window outside a dark box.
    """
    there = scene.on(engine)
    solid = solid_of(scene, source, there.step)
    if solid is None:
        return None, 1.0
    solid, scale = widened(solid, there)
    return Slices(there, scene.sides, solid, brightness, most, lobe, fineness=fineness), scale


def _sun_of(scene: Scene, source: sources.Source, max_distance: float | None) -> sources.Lamp | None:
    """The disc of a sky's sun, as a lamp so far away that it stands in one direction for the whole map."""
    brightness = sources.distribution_of(source)
    if not isinstance(source, sources.Sky) or brightness is None or (disc := brightness.disc()) is None:
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
    extent = max(max(scene.shape) * scene.spacing, scene.deepest)
    distance = SUN_DISTANCE * extent
    x, y, z = distance * np.array(disc.direction)
    return sources.Lamp((x, y, z), distance * math.sin(disc.radius), disc.brightness)


# -- lobes


def _refined_lobes(
    call: Renderer, lobe_of: Callable[[sources.Source, float], np.ndarray], irradiances: list[Irradiance]
) -> list[np.ndarray]:
    """A source in a lobe: (rows, cols) float32 of every colour, each by as many slices as it takes."""
    scene, factors = call.scene, numbers_of(call.greys)
    matte = np.array([np.asarray(light)[scene.valid].mean() / np.pi for light in irradiances] or [0.0])
    matte, specular = np.broadcast_arrays(
        matte * _by_colour(scene.albedo, np.mean), _by_colour(_phong(scene).specular, np.max)
    )
    if factors is not None or len(call.greys) == 1:  # one image in all colours
        bright = specular * np.array(factors or [1.0])
        return per_colour(call.greys, lambda grey: _refined_lobe(call, grey, lobe_of, matte, bright))
    shares = (np.broadcast_to(part, 3)[:, None] for part in (matte, specular))
    return [_refined_lobe(call, grey, lobe_of, *parts) for grey, *parts in zip(call.greys, *shares)]


def _refined_lobe(
    call: Renderer,
    grey: sources.Source,
    lobe_of: Callable[[sources.Source, float], np.ndarray],
    matte: np.ndarray,
    specular: np.ndarray,
) -> np.ndarray:
    """A grey source in a lobe: (rows, cols) float32, by as many slices as the worst colour takes.

    Of the colours in which it is shown: ``matte``, the mean of the other light, and ``specular``, a factor.

    Each slice meets an edge, of brightness or of the ground, or misses it, so errors are as one over the
    number of slices, and those of two numbers that share none are independent: the finer image's is the RMS
    difference over sqrt(1 + r^2) for r times as many slices. The first two must be closer than that.
    """
    scene, tolerance = call.scene, float(call.options.tolerance)
    before, off, said = LOBE_FINENESS[0], math.inf, len(call.warnings)
    image = lobe_of(grey, before)
    for fineness in LOBE_FINENESS[1:]:
        del call.warnings[said:]  # of slices that finer ones take the place of
        coarse, image = image, lobe_of(grey, fineness)
        mean = np.maximum(matte + specular * float(image[scene.valid].mean()), 1e-300)
        rms = math.sqrt(float(np.mean((image - coarse)[scene.valid] ** 2))) / math.hypot(1, fineness / before)
        off = float(np.max(specular * rms / mean))
        if off <= (FIRST_SHARE * tolerance if fineness == LOBE_FINENESS[1] else tolerance):
            return image
        before = fineness
    call.warnings.append(
        f"Tolerance: the estimated error of the specular lobe is {100 * off:.3g} % of the mean (RMS), more"
        f" than the {100 * tolerance:.3g} % asked for."
    )
    return image


def _by_colour(values: float | np.ndarray, of: Callable[..., Any]) -> np.ndarray:
    """``of`` a quantity of the surface, of every colour if it is in colour: (1,) or (3,)."""
    in_colour = is_in_colour(np.asarray(values))
    return np.atleast_1d(of(np.reshape(values, (-1, 3)), axis=0) if in_colour else of(values))


def _phong(scene: Scene) -> Phong:
    assert isinstance(scene.reflectance, Phong), "Phong alone has a lobe"
    return scene.reflectance


def _narrow_lobe(lobe: Lobe, apart: float, fix: str) -> list[str]:
    """A warning where directions are ``apart`` [rad] by more than COARSE_LOBE half widths of the lobe."""
    if apart <= COARSE_LOBE * lobe.spread:
        return []
    return [
        f"Narrow lobe: it is {np.degrees(lobe.spread):.1f} degrees wide and the directions are up to"
        f" {np.degrees(apart):.1f} degrees apart, so highlights break up into dots or are missing; use {fix}."
    ]
