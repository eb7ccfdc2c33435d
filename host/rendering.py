"""render(): a scene and a source to an image (Eq. 3)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from . import shading, sources
from .arrays import Quantity, by_bands, labelled, multiply, scratch
from .backends.base import Backend
from .backends.resident import DeviceImage
from .checks import one_of, positive_number
from .constants import SLICES
from .directions import Azimuths, Hemicube
from .errors import bad
from .interreflection import (
    Interreflection,
    albedos,
    check_choice,
    included,
    is_needed,
    local_sums,
    reason,
    share_of,
)
from .light import lattice, propagation, unoccluded
from .light.far import Far, Tiling
from .light.horizon import FINE_KNOTS, with_bright_parts
from .light.propagation import Lobe
from .light.slices import CHORD_AZIMUTHS, CHORD_KNOTS, MOST, Slices, blurred, brightness_of, widened
from .light.sweeps import FINE_NEAR_ROWS, Ground, Rays, Sweeps, engine_of, ground_of
from .refinement import Plan, Refined, refined, solid_of
from .reflectance import BRDF, Phong
from .scale import Audit, decided, fits, holds, limited, over_area, tiled, warn
from .scene import Scene, is_scene
from .sources.integrals import chords, integrals
from .sources.solids import Dome, upright

RENDER_METHODS = ("auto", "lattice", "horizon", "unoccluded")
QUANTITIES = ("radiance", "irradiance")
# of DataArrays; their unit is that of the source's brightness, or of brightness x sr
IMAGES = {
    "radiance": Quantity("radiance", None, "radiance, in the unit of the source's brightness"),
    "irradiance": Quantity("irradiance", None, "irradiance, in the unit of the source's brightness times sr"),
}
ERRORS = {name: Quantity(f"{name}_error", None, f"estimated error of the {name}") for name in QUANTITIES}
DEFAULT_AZIMUTHS = 64  # of method "horizon", unless given
DEFAULT_HEMICUBE = 9  # of the hemicube of method "lattice", unless given
SUN_DISTANCE = 1e5  # extents of the map at which the sun stands: a hundred-thousandth of a radian across it
# nodes to each side of a node over which the error map is a mean: halves estimate regions, not single nodes
ERROR_MAP_RADIUS = 4
# error map over that mean: 90, 98 and 99 % of the nodes of 53 random pairs (performance/refinement.py) are
# within one, two and three times it
ERROR_MAP_FACTOR = np.float32(2)
# half widths of a lobe between directions, from which on its sum may be too large by 1 in a thousand
COARSE_LOBE = 1.2
# azimuths of a small part of a sky on a map in tiles; chosen: with 8 the error is 0.06 %, cliffs apart
PART_SECTORS = 16
# azimuths in which windows of tiles estimate the light between surfaces, with an error of 0.003 in the share
# of sky; and the part of a window at each of its sides that is left out, since ground beyond is missing;
# chosen
WINDOW_AZIMUTHS, WINDOW_EDGE = 16, 8
# relative RMS error that 64 azimuths keep to: 0.0004 of E / pi on rough ground (performance/refinement.py)
LEAST_TILED_TOLERANCE = 0.002
REPEATED_LOBE = "a lobe over a map that repeats"

Result = TypeVar("Result")
Irradiance = np.ndarray | DeviceImage  # (rows, cols) float32 [brightness x sr]


@dataclass(frozen=True, eq=False)
class Rendering:
    """What render() gives.

    image (rows, cols) float32, or (rows, cols, 3) in colour, nan where masked, an xarray.DataArray if the
    scene was made from one, a DeviceImage if its map lies on a GPU; plan; backend (its name); seconds of the
    call without compiling, compile_seconds; warnings (one sentence each). interreflection: the decision
    about the light between surfaces. direct, reflected: with ``parts=True``, the image by direct light alone,
    and the rest of it.
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
    interreflection: Interreflection | None = None
    direct: np.ndarray | None = field(default=None, repr=False)
    reflected: np.ndarray | None = field(default=None, repr=False)
    _between: tuple[float, ...] = field(default=(0.0,), repr=False)

    @cached_property
    def error(self) -> np.ndarray | None:
        """Estimated error of every node, in the unit and shape of image, nan where masked.

        None where no tolerance was asked. The root mean square, over 9 x 9 nodes, of half the difference of
        the image's two halves, times the share of it that is error, and besides what both halves share. It
        shows regions, not nodes: on random scenes 82, 93 and 96 % of the nodes had an error below one, two
        and three times the estimate. The error of the light between surfaces is added, one number for all
        nodes. The light of lobes and mirrors is not included.
        """
        scene = self._scene
        if scene is None:
            return None
        errors = [
            np.hypot(np.float32(factor) * _error_map(result, scene), np.float32(between))
            for (result, factor), between in zip(self._parts, self._between)
        ]
        with np.errstate(invalid="ignore"):
            image = _image(scene, errors, [], self._quantity)
        # ground of albedo 0 reflects none of an irradiance whose error is not bounded, where 0 x inf is nan
        unknown = np.isnan(image)
        if scene.mask is not None:
            unknown[~scene.mask] = False
        image[unknown] = 0
        result: np.ndarray = labelled(image, scene.labels, ERRORS[self._quantity])
        return result

    def _times(self, unit: float) -> Rendering:
        """This in light of ``unit`` times the brightness."""
        if unit == 1:
            return self
        return replace(
            self,
            image=_in_unit(self.image, unit),
            direct=_in_unit(self.direct, unit),
            reflected=_in_unit(self.reflected, unit),
            _parts=tuple((part, factor * unit) for part, factor in self._parts),
            _between=tuple(error * unit for error in self._between),
        )


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
    interreflection: bool | str = "auto",
    parts: bool = False,
    tiling: Tiling | None = None,
    max_seconds: float | None = None,
) -> Rendering:
    """The image of ``scene`` under ``source``, seen orthographically along +z (Langer and Zucker, Eq. 3).

    Returns a Rendering, or raises InputError, BackendError, CapacityError or OutOfTimeError. In colour,
    (rows, cols, 3), where brightness or reflectance is; each channel equals its grey render bit for bit. To
    rho E / pi comes the integral of f B cos(theta_i) over the visible directions, f a lobe or any BRDF, or
    the brightness in a mirror.

    Parameters
    ----------
    scene, source : Scene; Sky, Lamp or Window
    method : "auto", "lattice", "horizon" or "unoccluded"
        ``auto``: begun with :func:`skylamp.plan` and refined until the estimate of its error, over all
        nodes, and exact rays at some hundred samples are within ``tolerance``. ``lattice``: the paper's
        directions on a hemicube (9 unless given). ``horizon``: the source above the horizon of every node in
        a number of azimuths (64 unless given; for lamps and windows, slices through the source as every node
        sees it). ``unoccluded``: closed forms from the normals, as if ground hid nothing but what lies below
        each node's own tangent plane; the brightness of a lamp or window is that towards its middle.
    tolerance, tail : float
        Of ``auto``: RMS error over the mean irradiance of lit nodes (at least 1e-6 of what the source gives
        if as bright all round: a beam may miss); bound of the 99.9th percentile, ten tolerances unless given.
    backend : str
        See :func:`skylamp.backends`.
    quantity : "radiance" or "irradiance"
        Radiance [unit of brightness], or irradiance E [unit of brightness x sr], whatever the reflectance.
    hemicube : odd int or Hemicube, M of the lattice
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
    interreflection : "auto", True or False
        Light between surfaces, to any number of bounces. ``auto``: where a tolerance chooses the method it is
        included if it is more than a third of the tolerance (in tiles, by windows of all), which then holds
        for all light; methods asked for are of direct light. Lobes and mirrors reflect direct light.
    parts : bool
        Give ``direct`` and ``reflected`` besides.
    tiling : Tiling
        Tile by tile, as lazy scenes, which give lazy images, and maps beyond the device's memory: see
        :func:`skylamp.horizons`. Skies alone, in 64 azimuths unless given, suns in their own; no refinement.
    max_seconds : float
        OutOfTimeError once they are over, compiling apart; looked at before each launch. Not of lazy scenes.

    Examples
    --------
    >>> out = render(Scene(depth), Sky(), tolerance=0.003)
    >>> print(out.plan, out.error.max())
    """
    asked = method, tolerance, quantity, hemicube, filled, weights, azimuths, max_distance, tail
    options = _Options(*asked, interreflection, parts)
    options.check(scene, source)
    engine = engine_of(scene, backend)
    source, unit = sources.in_range(sources.on_axes(source, scene.axes))
    with limited(max_seconds, "render", scene, backend):
        if options.goes_in_tiles(scene, source, engine, tiling):
            return _in_tiles(scene, source, options, engine, backend, tiling)._times(unit)
        return _Renderer(scene, source, engine, options).render()._times(unit)


def _in_tiles(
    scene: Scene,
    source: sources.Source,
    options: _Options,
    engine: Backend,
    backend: str,
    tiling: Tiling | None,
) -> Rendering:
    """A sky or a lamp on a map in tiles: lazy, if the scene is."""
    leading = [3] if _in_colour_in_tiles(scene, source, options) else []
    warnings: list[str] = []
    between, why = _between_in_tiles(scene, source, options)
    share: float | None = None

    def light() -> Any:
        nonlocal between, why, share
        if isinstance(source, sources.Lamp):
            area = _lit_area(scene, source, options.max_distance)
            lamp = LampImage(source, replace(options, max_distance=None), backend, bool(leading))
            image = over_area(lamp, scene, *area, *leading)
        else:
            work = _tile_image(scene, source, options, backend, between)
            if between is None and scene.lazy is None:
                work = decided(work, scene, tiling, options.max_distance, work.audit)
                between, share = work.between, work.share
                why = reason(share, work.tolerance)
            image = tiled(work, scene, tiling, options.max_distance, work.audit, *leading, between=between)
        if not leading:
            return image
        return image.transpose(1, 2, 0) if scene.lazy is not None else np.moveaxis(image, 0, -1)

    image, seconds, compiling = timed(engine, light)
    count: int | None = len(_sectors(options.azimuths))
    how = "a map in tiles is not refined"
    if isinstance(source, sources.Lamp):
        count, how = None, "the part of the map within reach of the lamp is rendered at once"
        why = "as in every image" if options.interreflection else "as asked"
        between = options.interreflection is not False
        warnings = _beyond_reach(source, options.max_distance)
    plan = Plan("horizon", None, None, how, count, options.max_distance)
    return Rendering(
        labelled(image, scene.labels, IMAGES[options.quantity]),
        plan,
        engine.name,
        seconds,
        compiling,
        warnings,
        _quantity=options.quantity,
        interreflection=Interreflection(between, why, share),
    )


def _between_in_tiles(scene: Scene, source: sources.Source, options: _Options) -> tuple[bool | None, str]:
    """(Whether tiles have light between surfaces, None where the whole map decides; why)."""
    if options.interreflection is False:
        return False, "as asked"
    if not (np.ndim(scene.albedo) or scene.albedo):
        return False, "the surface has no diffuse albedo"
    if options.interreflection is True:
        return True, "as asked, in every tile for itself"
    if not options.planned(scene, source):
        return False, "the method that was asked for is of direct light"
    return None, "if windows of all tiles have more of it than a third of the tolerance"


def _in_colour_in_tiles(scene: Scene, source: sources.Source, options: _Options) -> bool:
    """Whether images of tiles are in colour."""
    coloured = np.ndim(scene.albedo) in (1, 3)
    between, _ = _between_in_tiles(scene, source, options)
    may_bounce = between is not False or isinstance(source, sources.Lamp)
    return len(sources.channels(source)) > 1 or coloured and (options.quantity == "radiance" or may_bounce)


def _lit_area(scene: Scene, lamp: sources.Lamp, reach: float | None) -> tuple[slice, slice]:
    """Rows and columns of the nodes that a lamp of some reach [unit of spacing] lights."""
    assert lamp.center is not None, "checked"
    ends = []
    for at, nodes in zip(lamp.center[1::-1], scene.shape):
        first, last = (0, nodes) if reach is None else (at - reach, at + reach)
        if reach is not None:
            first, last = (math.ceil(first / scene.spacing), math.floor(last / scene.spacing) + 1)
        ends.append(slice(min(max(first, 0), nodes), max(0, min(last, nodes))))
    return ends[0], ends[1]


def _beyond_reach(lamp: sources.Lamp, reach: float | None) -> list[str]:
    """A warning with the light that is left out beyond a lamp's reach."""
    if reach is None or lamp.radius is None:
        return []
    return [
        f"Reach: nodes more than {reach:g} from the lamp along rows or columns get none of its light; that"
        f" would be an irradiance of up to {math.pi * min(1.0, lamp.radius / reach) ** 2:.2g} times its"
        " brightness."
    ]


@dataclass(frozen=True)
class LampImage:
    """The image of the part of a map that a lamp lights, as :func:`skylamp.scale.over_area` asks for it."""

    lamp: sources.Lamp
    options: _Options
    backend: str
    in_colour: bool

    def __call__(self, scene: Scene, row: int, col: int, below: float) -> np.ndarray:
        """(rows, cols) float32, or (3, rows, cols) in colour.

        ``row``, ``col``: of the scene's first node in the map; ``below``: depth [length] of its plane z = 0.
        """
        assert self.lamp.center is not None, "checked"
        x, y, z = self.lamp.center
        center = x - col * scene.spacing, y - row * scene.spacing, z - below
        lamp = replace(self.lamp, center=center)
        engine = engine_of(scene, self.backend)
        lamp_in_range, unit = sources.in_range(lamp)
        done = _Renderer(scene, lamp_in_range, engine, self.options).render()._times(unit)
        for text in done.warnings:
            warn(text)
        image = np.asarray(done.image)
        if not self.in_colour:
            return image
        return np.broadcast_to(image, (3, *image.shape)) if image.ndim == 2 else np.moveaxis(image, -1, 0)


@dataclass(frozen=True)
class TileImage:
    """The image of a tile under a sky, as :func:`skylamp.scale.tiled` asks for it.

    rays, and tables of brightness, of every colour; factors of the colours that differ by these alone, of
    which there is one ray and no table. in_colour: the image is (3, rows, cols). between: with the light
    between surfaces, within ``tolerance``, or None where the whole map decides by ``fewer``: the same lights
    in fewer azimuths. The light is ``unit`` times that of the tables.
    """

    lights: tuple[tuple[Rays, np.ndarray | None], ...]
    factors: tuple[float, ...] | None
    quantity: str
    in_colour: bool
    backend: str
    tolerance: float
    between: bool | None
    unit: float
    colours: int
    fewer: tuple[tuple[Rays, np.ndarray | None], ...]
    share: float | None = None  # estimate of the light between surfaces

    @property
    def audit(self) -> Audit:
        """Within which tolerance far ground must be taken."""
        return Audit(self.backend, self.tolerance)

    def __call__(
        self, scene: Scene, max_distance: float | None, far: Far | None, part: slice = slice(None)
    ) -> np.ndarray:
        """(rows, cols) float32, or ``part`` of the colours (3, rows, cols); nan where masked."""
        engine = engine_of(scene, self.backend)
        with engine.lock:
            ground = ground_of(scene, max_distance, engine)
            light = self._swept(engine, ground, self.lights, far)
            if self.between:
                sky = _share_of_sky(engine, ground, DEFAULT_AZIMUTHS, far)
                both = included(scene, engine, light, self.tolerance, "as asked", sky=sky, beyond=True)
                light = _on_host(both.irradiances)
                for text in both.warnings:
                    warn(text)
        if self.unit != 1:
            light = [image * np.float32(self.unit) for image in light]
        image = _image(scene, light, [], self.quantity)
        return np.moveaxis(image, -1, 0)[part] if self.in_colour else image

    def _swept(
        self,
        engine: Backend,
        ground: Ground,
        lights: tuple[tuple[Rays, np.ndarray | None], ...],
        far: Far | None,
    ) -> list[np.ndarray]:
        """Direct irradiance of every colour of the source."""
        light = [Sweeps(engine, ground, rays, table, far=far).irradiance(last=True) for rays, table in lights]
        if self.factors is None:
            return light
        return [light[0] * np.float32(factor) for factor in self.factors]

    def sums(self, scene: Scene) -> np.ndarray:
        """Sums from which the light between surfaces is estimated, (colours, 3); nodes at the border are
        left out, since ground beyond the window is missing."""
        engine, edge = engine_of(scene, self.backend), [n // WINDOW_EDGE for n in scene.shape]
        with engine.lock:
            ground = ground_of(scene, None, engine)
            light = self._swept(engine, ground, self.fewer, None)
            sky = _share_of_sky(engine, ground, len(self.fewer[0][0].angles), None)
        inner = np.zeros(scene.shape, bool)
        inner[edge[0] : scene.shape[0] - edge[0], edge[1] : scene.shape[1] - edge[1]] = True
        inner &= scene.valid
        shares, count = albedos(scene), self.colours
        return np.stack(
            [
                local_sums(
                    light[n % len(light)][inner],
                    sky[inner],
                    shares[n % len(shares)][inner]
                    if np.ndim(shares[n % len(shares)])
                    else shares[n % len(shares)],
                )
                for n in range(count)
            ]
        )

    def decided(self, sums: np.ndarray, possible: bool) -> TileImage:
        """This image with or without light between surfaces; a warning where it counts and cannot be."""
        share = share_of(sums)
        needed = is_needed(share, self.tolerance)
        if needed and not possible:
            warn(
                f"Tolerance: light between surfaces is left out, since it needs open sides and tiles of at"
                f" least two halos; it is about {100 * share:.2g} % of the direct light (RMS over the mean),"
                f" more than a third of the {100 * self.tolerance:.2g} % asked for."
            )
        return replace(self, between=bool(needed and possible), share=share)


def _share_of_sky(engine: Backend, ground: Ground, azimuths: int, far: Far | None) -> np.ndarray:
    """Share of sky that every node of a tile sees, cosine-weighted, (rows, cols) float32."""
    sectors = Azimuths(azimuths)
    rays = Rays(sectors.angles, sectors.widths)
    return Sweeps(engine, ground, rays, far=far).irradiance(last=True) * np.float32(1 / np.pi)


def tile_image(scene: Scene, source: sources.Source, backend: str, **asked: Any) -> TileImage:
    """The image of a tile of a lazy scene; ``asked``: quantity and other options of :func:`render`.

    Raises InputError for what is not rendered in tiles.
    """
    options = _Options(**asked)
    options.check(scene, source)
    refused = options.refused_in_tiles(scene, source, None)
    if refused:
        raise bad("render: a map in tiles", *refused)
    return _tile_image(scene, source, options, backend, _between_in_tiles(scene, source, options)[0])


def _tile_image(
    scene: Scene, source: sources.Source, options: _Options, backend: str, between: bool | None
) -> TileImage:
    source, unit = sources.in_range(source)
    greys, sectors = sources.channels(source), _sectors(options.azimuths)
    factors = _numbers(greys)
    skies = [grey for grey in greys if isinstance(grey, sources.Sky)][: None if factors is None else 1]
    return TileImage(
        tuple(_rays_of(sky, sectors) for sky in skies),
        None if factors is None else tuple(factors),
        options.quantity,
        _in_colour_in_tiles(scene, source, options),
        backend,
        float(options.tolerance),
        between,
        unit,
        max(len(greys), 3 if np.ndim(scene.albedo) in (1, 3) else 1),
        tuple(_rays_of(sky, Azimuths(WINDOW_AZIMUTHS)) for sky in skies),
    )


def _rays_of(sky: sources.Sky, sectors: Azimuths) -> tuple[Rays, np.ndarray | None]:
    """Azimuths and the table of a sky's brightness, its small bright parts in azimuths of their own."""
    rays = Rays(sectors.angles, sectors.widths)
    if not callable(sky.brightness):
        return rays, None
    light = integrals(sky)
    table = light.table(sectors.angles, sectors.widths, FINE_KNOTS)
    suns = [sun.sectors(PART_SECTORS) for sun in light.bright_parts]
    return with_bright_parts(rays, table, suns) if suns else (rays, table)


@dataclass(frozen=True)
class _Options:
    """What :func:`render` was asked for, but for scene, source and backend."""

    method: str = "auto"
    tolerance: float = 0.01
    quantity: str = "radiance"
    hemicube: int | Hemicube | None = None
    filled: bool | None = None
    weights: str = "moment"
    azimuths: int | Azimuths | None = None
    max_distance: float | None = None
    tail: float | None = None
    interreflection: bool | str = "auto"
    parts: bool = False

    @property
    def lattice(self) -> bool:
        """Whether arguments of the lattice are given."""
        return self.hemicube is not None or self.filled is not None or self.weights != "moment"

    @property
    def horizon(self) -> bool:
        """Whether arguments of horizons are given."""
        return self.azimuths is not None or self.max_distance is not None

    def lobe(self, scene: Scene) -> Lobe | None:
        return shading.lobe_of(scene) if self.quantity == "radiance" else None

    def brdf(self, scene: Scene) -> bool:
        return self.quantity == "radiance" and isinstance(scene.reflectance, BRDF)

    def mirror(self, scene: Scene) -> bool:
        return self.quantity == "radiance" and shading.has_mirror(scene)

    def shines(self, scene: Scene) -> bool:
        """Whether there is more to show than rho E / pi."""
        return self.lobe(scene) is not None or self.brdf(scene) or self.mirror(scene)

    def needs_irradiance(self, scene: Scene) -> bool:
        """Whether irradiance is asked for, or reflected: a surface that only shines needs none."""
        if self.quantity == "irradiance" or bool(np.any(scene.albedo)):
            return True
        return not (shading.lobe_of(scene) or shading.has_mirror(scene))

    def missing(self, scene: Scene, source: sources.Source) -> str:
        """Why horizons, slices and closed forms cannot render this, or nothing."""
        if scene.sides == "periodic" and self.lobe(scene):
            return REPEATED_LOBE
        return lattice.lacking(scene, source)

    def planned(self, scene: Scene, source: sources.Source) -> bool:
        """Whether the method is chosen, and refined until it is within the tolerance."""
        asked = self.method != "auto" or self.lattice or self.horizon
        return not asked and self.missing(scene, source) != REPEATED_LOBE

    def check(self, scene: Scene, source: sources.Source) -> None:
        """InputError unless all arguments go together."""
        is_scene(scene)
        one_of(self.method, RENDER_METHODS, "method")
        one_of(self.quantity, QUANTITIES, "quantity")
        one_of(self.weights, ("moment", "printed"), "weights")
        if not isinstance(self.filled, (bool, type(None))):
            raise bad("filled", repr(self.filled), "True, False or None")
        if not isinstance(source, sources.Source):
            raise bad("source", type(source).__name__, "Sky, Lamp or Window")
        positive_number(self.tolerance, "tolerance")
        check_choice(self.interreflection)
        if not isinstance(self.parts, bool):
            raise bad("parts", repr(self.parts), "True or False")
        self._check_method()
        missing = self.missing(scene, source)
        if missing and (self.method in ("horizon", "unoccluded") or self.horizon):
            raise bad(
                f"method '{'horizon' if self.horizon else self.method}'",
                missing,
                "a sky, a rectangular window, or a lamp given by its centre and radius, the last two with"
                " sides='open' or 'dark'",
                "Use method='lattice'.",
            )
        if self.method == "unoccluded" and self.shines(scene):
            raise bad("method 'unoccluded'", type(scene.reflectance).__name__, "a Lambertian surface")
        if self.tail is not None and not self.planned(scene, source):
            raise bad("tail", self.tail, "a bound for method='auto' without arguments of a method")

    def goes_in_tiles(
        self, scene: Scene, source: sources.Source, engine: Backend, tiling: Tiling | None
    ) -> bool:
        """Whether tiles are asked for, which may be an InputError, or are needed and possible."""
        asked = scene.lazy is not None or tiling is not None
        if not asked and fits(scene, engine):
            return False
        refused = self.refused_in_tiles(scene, source, engine)
        if asked and refused:
            raise bad("render: a map in tiles", *refused)
        return refused is None

    def refused_in_tiles(
        self, scene: Scene, source: sources.Source, engine: Backend | None
    ) -> tuple[str, str] | None:
        """The first thing that is not rendered in tiles, and what is allowed; None where there is none.

        ``engine``: renders the part that a lamp lights at once; None where lamps are not allowed.
        """
        if self.parts:
            return "parts", "all light, or interreflection=False and direct light"
        if isinstance(source, sources.Lamp) and engine is not None:
            return self._refused_lamp(scene, source, engine)
        refused = [
            (
                not isinstance(source, sources.Sky),
                "a lamp or a window",
                "a Sky, whose light comes from afar; ground before a window may be in any tile",
            ),
            (
                self.lattice or self.method not in ("auto", "horizon"),
                "the lattice or closed forms",
                "horizons",
            ),
            (self.shines(scene), "a lobe or a mirror", "a Lambertian surface, or quantity='irradiance'"),
            (self.tail is not None, "a tail", "as many azimuths as asked: nothing is refined"),
            (
                self.azimuths is None and float(self.tolerance) < LEAST_TILED_TOLERANCE,
                f"a tolerance of {self.tolerance:g}",
                f"at least {LEAST_TILED_TOLERANCE}, or azimuths: nothing is refined",
            ),
        ]
        return next(((what, allowed) for is_so, what, allowed in refused if is_so), None)

    def _refused_lamp(self, scene: Scene, lamp: sources.Lamp, engine: Backend) -> tuple[str, str] | None:
        """Why the nodes that a lamp lights cannot be rendered at once, and what can."""
        if lamp.center is None:
            return "a lamp without a centre", "a sphere, by its center and radius"
        if scene.sides != "open":
            return f"a lamp with sides {scene.sides!r}", "sides 'open'"
        rows, cols = (area.stop - area.start for area in _lit_area(scene, lamp, self.max_distance))
        if rows < 1 or cols < 1:
            return "a lamp beyond whose reach the whole map lies", "a larger max_distance"
        if not holds(rows * cols, engine):
            return (
                f"a lamp that lights {rows} x {cols} nodes, which are rendered at once",
                "max_distance, its reach: nodes farther away get none of its light",
            )
        return None

    def _check_method(self) -> None:
        """InputError where arguments of another method are given."""
        if self.horizon and (self.lattice or self.method == "lattice"):
            raise bad(
                "render: arguments of two methods",
                "azimuths or max_distance with the lattice's",
                "azimuths and max_distance with method='horizon'; hemicube, filled and weights with"
                " 'lattice'",
            )
        if self.method == "horizon" and self.lattice:
            raise bad(
                "method 'horizon' with hemicube, filled or weights", "both", "azimuths and max_distance"
            )
        if self.method == "unoccluded" and (self.lattice or self.horizon):
            raise bad(
                "method 'unoccluded' with arguments of another",
                "both",
                "neither azimuths and max_distance nor hemicube, filled and weights",
            )


class _Renderer:
    """One call of :func:`render`, with its plans, warnings and refined irradiances."""

    def __init__(self, scene: Scene, source: sources.Source, engine: Backend, options: _Options):
        self.scene, self.source, self.engine, self.options = scene, source, engine, options
        self.greys = sources.channels(source)
        self.lobe, self.planned = options.lobe(scene), options.planned(scene, source)
        missing, shines = options.missing(scene, source), options.shines(scene)
        self.by_lattice = (
            options.lattice or options.method == "lattice" or bool(missing and (not self.planned or shines))
        )
        no_disc = options.lattice or missing or self.planned and not shines
        self.sun = None if no_disc else _sun_of(scene, source, options.max_distance)
        # an image of one channel, rho E / pi alone, is made on the device; with arguments of a method on a
        # GPU alone: on a CPU the memory of its arrays is freed as they are done with
        grey = len(self.greys) == 1 and np.ndim(scene.albedo) in (0, 2) and not shines
        self.on_device = grey and not options.parts and (self.planned or not engine.shares)
        self.stays = scene.stays_on(engine) and self.on_device  # it is left where the map was given
        self.plans: list[Plan] = []
        self.warnings: list[str] = []
        self.parts: list[tuple[Refined, float]] = []  # refined irradiances, times factors
        self.interreflection: Interreflection | None = None
        self.between: list[float] = []  # error of the light between surfaces, of every part

    def render(self) -> Rendering:
        """All of it, timed."""
        (direct, irradiances, shine), seconds, compiling = timed(self.engine, self._all_light)
        scene, quantity = self.scene, self.options.quantity
        first = rest = None
        if self.options.parts:
            first = _image(scene, [light.copy() for light in _on_host(direct)], shine, quantity)
        image = self._image(irradiances, shine)
        if first is not None:
            if image.ndim > first.ndim:  # a coloured ground alone colours an irradiance
                first = np.repeat(first[..., None], image.shape[-1], -1)
            first, rest = (
                labelled(values, scene.labels, IMAGES[quantity]) for values in (first, image - first)
            )
        return Rendering(
            labelled(image, scene.labels, IMAGES[quantity]),
            self.plans[0],
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
            light.shade(scene.on(engine), *share)
            return light if self.stays else np.asarray(light)
        image = _image(scene, _on_host(irradiances), shine, quantity)
        if not self.stays or image.ndim > 2:
            return image
        return DeviceImage(engine, engine.upload(image.reshape(-1)), scene.shape)

    def _all_light(self) -> tuple[list[Irradiance], list[Irradiance], list[np.ndarray]]:
        """Direct irradiances, irradiances of all light, and what else is reflected: an array per colour."""
        direct, shine = self._light()
        why = _left_out(self.scene, self.options, self.plans if self.planned else None)
        if why or not direct:
            why = why or "there is no Lambertian reflection to show"
            self.interreflection = Interreflection(False, why, _share_between(self.plans))
            self.between = [0.0] * len(direct)
            coloured = (
                self.planned and self.options.interreflection == "auto" and _has_coloured_albedo(self.scene)
            )
            return direct, list(direct) * (3 if coloured and len(direct) == 1 else 1), shine
        known = direct if self.on_device else _on_host(direct)
        return list(known), list(_interreflected(self, known)), shine

    def _light(self) -> tuple[list[Any], list[np.ndarray]]:
        """Irradiances, and the radiance that is reflected besides rho E / pi: one array per colour each."""
        if self.by_lattice:
            return self._lattice()
        if self.options.brdf(self.scene):
            return [], self._brdf()
        irradiances = self._irradiances() if self.options.needs_irradiance(self.scene) else []
        if not self.plans:
            self._plan_as_asked()
        if self.sun is not None and not self.planned:
            self.plans[0] = replace(self.plans[0], reason=f"{self.plans[0].reason}; the sun's disc by itself")
        if self.lobe:
            lobe_of = self._sky_lobe if isinstance(self.source, sources.Sky) else self._solid_lobe
            return irradiances, _per_colour(self.greys, lobe_of)
        return irradiances, self._mirrored(self.options.max_distance)

    def _irradiances(self) -> list[Irradiance]:
        if self.planned:
            return self._within_tolerance()
        options = self.options
        irradiances = _per_colour(
            [sources.without_disc(grey) for grey in self.greys],
            lambda grey: self._as_asked(grey, options.azimuths),
        )
        if self.sun is not None:
            # the azimuths that were asked for are the sky's
            irradiances = [
                np.asarray(irradiances[0]) + np.asarray(self._as_asked(self.sun, None)),
                *irradiances[1:],
            ]
        return irradiances

    def _within_tolerance(self) -> list[Irradiance]:
        """Irradiances of all colours; where they differ by a factor alone, of one and times that factor."""
        factors, options = _numbers(self.greys), self.options
        tolerance = float(options.tolerance)
        for n, grey in enumerate(self.greys):
            if factors is None or n == 0:
                source = grey if factors is None else replace(grey, brightness=1.0)
                how = tolerance, self.engine, options.tail, options.interreflection, self.on_device
                result = refined(self.scene, source, *how)
            self.parts.append((result, 1.0 if factors is None else factors[n]))
            self.plans.append(result.plan)
            self.warnings.extend(text for text in result.warnings if text not in self.warnings)
        return [_times(result.irradiance, factor) for result, factor in self.parts]

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
        return _by_slices(scene, grey, engine, plan, self.on_device)

    def _plan_as_asked(self) -> Plan:
        options = self.options
        self.plans.append(_plan_of(self.scene, self.greys[0], options.azimuths, options.max_distance))
        return self.plans[-1]

    def _brdf(self) -> list[np.ndarray]:
        """Radiance of a BRDF."""
        scene, options = self.scene, self.options
        self._plan_as_asked()
        if not isinstance(self.source, sources.Sky):
            rays = shading.through_solid(scene, self.greys[0], self.engine, options.max_distance)
            return shading.by_brdf(scene, self.greys, rays)
        sectors = _sectors(options.azimuths)
        ground = ground_of(scene, options.max_distance, self.engine)
        sweeps = Sweeps(self.engine, ground, Rays(sectors.angles, sectors.widths), near=FINE_NEAR_ROWS)
        parts = shading.above_horizons(scene, sweeps.planes(), sectors)
        return shading.by_brdf(scene, self.greys, parts)

    def _sky_lobe(self, grey: sources.Source) -> np.ndarray:
        assert self.lobe is not None, "called for surfaces with a lobe"
        return _lobe_of_sky(self.scene, grey, self.engine, self.lobe, self.options.max_distance)

    def _solid_lobe(self, grey: sources.Source) -> np.ndarray:
        assert self.lobe is not None, "called for surfaces with a lobe"
        most = _plan_of(self.scene, grey, self.options.azimuths, None).azimuths
        assert most is not None, "a plan of slices says how many"
        return _lobe_of_solid(self.scene, grey, self.engine, self.lobe, most, self.warnings)

    def _mirrored(self, max_distance: float | None) -> list[np.ndarray]:
        if not self.options.mirror(self.scene):
            return []
        return shading.mirrored(self.scene, self.greys, self.engine, max_distance)

    def _lattice(self) -> tuple[list[Any], list[np.ndarray]]:
        """:meth:`_light` over the directions of a hemicube."""
        options, scene, source = self.options, self.scene, self.source
        plan = _lattice_plan(options)
        self.plans.append(plan)
        if isinstance(options.hemicube, Hemicube):
            cube = options.hemicube
        else:
            assert plan.hemicube is not None, "a plan of the lattice has a hemicube"
            cube = Hemicube(plan.hemicube)
        # checks that the source fits
        problem = lattice.problem_of(self.engine, scene, source, cube, bool(plan.filled))
        self.warnings.extend(lattice.warnings_of(problem, scene, source, cube))
        brightness = np.stack([sources.radiance(grey, cube.directions) for grey in self.greys])
        lobe, shares, whole = (
            shading.lobe_of(scene, 1e-6) if options.quantity == "radiance" else None,
            None,
            None,
        )
        if lobe:
            angles = cube.solid_angles * _norm(scene)
            shares, whole = (
                np.concatenate([np.broadcast_to(cube.directions, (*share.shape, 3)), share[..., None]], -1)
                for share in (brightness * angles, angles)
            )
            spacing = np.sqrt(2 * np.pi / len(cube))
            if spacing <= COARSE_LOBE * lobe.spread:
                whole = None  # the sum is exact enough
            else:
                self.warnings.append(_narrow_lobe(lobe, spacing, "method='horizon' or a larger hemicube"))
        if options.brdf(scene):
            bits = propagation.visibility(self.engine, problem)
            return [], shading.by_brdf(scene, self.greys, shading.of_lattice(bits, cube))
        moments = (
            cube.moments if options.weights == "moment" else cube.directions * cube.solid_angles[:, None]
        )
        irradiances, reflected = propagation.light(
            self.engine, problem, moments * brightness[..., None], lobe, shares, whole, self.on_device
        )
        return irradiances, reflected + self._mirrored(None)


# -- light between surfaces


def _interreflected(call: _Renderer, direct: Sequence[Irradiance]) -> Sequence[Irradiance]:
    """Irradiances of all light; where colours differ by a factor alone, of one and times that factor."""
    scene, options, factors = call.scene, call.options, _numbers(call.greys)
    tolerance = float(options.tolerance)
    brightest = 0 if factors is None else int(np.argmax(factors))
    alike = factors is not None and factors[brightest] > 0 and np.ndim(scene.albedo) in (0, 2)
    sky: Irradiance | None = None
    lights = direct
    if alike and factors is not None:  # that of brightness 1, as it is for a grey source
        unit = np.float32(factors[brightest])
        lights = [call.parts[0][0].irradiance if call.parts else np.asarray(direct[brightest]) / unit]
    whole_sky = isinstance(call.source, sources.Sky) and options.max_distance is None
    if alike and factors is not None and whole_sky and not call.by_lattice:
        sky = _times(lights[0], 1 / np.pi)
    error = max((plan.error or 0.0 for plan in call.plans), default=0.0)
    why = "as asked"
    if options.interreflection == "auto":
        why = reason(_share_between(call.plans), tolerance)
    both = included(scene, call.engine, lights, tolerance, why, error, sky)
    call.interreflection = both.record
    call.warnings.extend(both.warnings)
    if call.planned:
        call.plans[0] = replace(call.plans[0], error=both.record.error)
    if not alike or factors is None:
        call.between = [max(both.errors)] if len(direct) == 1 else both.errors
        return both.irradiances
    call.between = [factor * both.errors[0] for factor in factors]
    return [_times(both.irradiances[0], factor) for factor in factors]


def _left_out(scene: Scene, options: _Options, plans: list[Plan] | None) -> str:
    """Why light between surfaces is left out, or nothing. ``plans``: None where the method was asked for."""
    if options.interreflection is False:
        return "as asked"
    if not np.any(scene.albedo):
        return "the surface has no diffuse albedo"
    if options.interreflection is True:
        return ""
    if plans is None:
        return "the method that was asked for is of direct light"
    share, tolerance = _share_between(plans), float(options.tolerance)
    needed = share is None or is_needed(share, tolerance)
    return "" if needed else reason(share, tolerance)


def _has_coloured_albedo(scene: Scene) -> bool:
    """Whether light between surfaces, included or not, is in colour."""
    return _in_colour(np.asarray(scene.albedo))


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
        return Plan("horizon", None, None, "as asked", len(_sectors(azimuths)), max_distance)
    if max_distance is not None or isinstance(azimuths, Azimuths):
        raise bad(
            "method 'horizon' with a lamp or window",
            "max_distance, or azimuths of the caller's",
            "azimuths as a whole number: slices of a source that stands all round",
        )
    most = MOST if azimuths is None else -(-len(Azimuths(azimuths)) // SLICES) * SLICES
    why = "slices through the source as every node sees it, fewer where it looks small"
    return Plan("horizon", None, None, why, most)


def _sectors(azimuths: int | Azimuths | None) -> Azimuths:
    """Sectors of azimuth, as asked."""
    if isinstance(azimuths, Azimuths):
        return azimuths
    return Azimuths(DEFAULT_AZIMUTHS if azimuths is None else azimuths)


def _unoccluded(scene: Scene, source: sources.Source) -> np.ndarray:
    """Closed forms: (rows, cols) float32."""
    if isinstance(source, sources.Sky):
        varies = callable(source.brightness)
        image = unoccluded.sky(scene, integrals(source) if varies else _number(source))
    else:
        solid = upright(solid_of(scene, source, 1 / scene.spacing, 1.0))
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
    sectors, table = _sectors(azimuths), None
    if callable(sky.brightness):
        if not isinstance(azimuths, Azimuths) and (profile := sources.azimuth_profile(sky)) is not None:
            sectors = Azimuths.placed(len(sectors), profile)
        table = integrals(sky, np.inf).table(sectors.angles, sectors.widths, 1025)
    ground, rays = ground_of(scene, max_distance, engine), Rays(sectors.angles, sectors.widths)
    sweeps = Sweeps(engine, ground, rays, table)
    image: Irradiance = sweeps.image() if on_device else sweeps.irradiance(last=True)
    return image if table is not None else _times(image, _number(sky))


def _by_slices(
    scene: Scene, source: sources.Lamp | sources.Window, engine: Backend, plan: Plan, on_device: bool
) -> Irradiance:
    """A lamp or window in as many slices as planned: (rows, cols) float32; ``on_device``: a DeviceImage."""
    assert plan.azimuths is not None, "a plan of slices says how many"
    brightness = (
        chords(integrals(sources.Sky(source.brightness), np.inf, True), CHORD_AZIMUTHS, CHORD_KNOTS)
        if callable(source.brightness)
        else _number(source)
    )
    slices, scale = _slices(scene, source, engine, plan.azimuths, brightness)
    if slices is None:
        return np.zeros(scene.shape, np.float32)
    slices.run()
    if on_device:
        irradiance = DeviceImage(engine, slices.image, scene.shape)
        irradiance.scale(scale, 0.0)  # a difference of sums may round to less than 0
        return irradiance
    image = slices.download()
    if callable(source.brightness):
        by_bands(lambda rows: np.maximum(image[rows], 0, out=image[rows]), image.shape)
    return _times(image, scale)


def _slices(
    scene: Scene,
    source: sources.Lamp | sources.Window,
    engine: Backend,
    most: int,
    brightness: float | np.ndarray,
    lobe: Lobe | None = None,
) -> tuple[Slices | None, float]:
    """Slices placed within a lamp or window as every node sees it, and the factor of their light.

    None for a window outside a dark box.
    """
    there = scene.on(engine)
    solid = solid_of(scene, source, there.step / scene.spacing, there.step)
    if solid is None:
        return None, 1.0
    solid, scale = widened(solid, there)
    return Slices(there, scene.sides, solid, brightness, most, lobe), scale


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


def _lobe_of_sky(
    scene: Scene,
    grey: sources.Source,
    engine: Backend,
    lobe: Lobe,
    max_distance: float | None,
) -> np.ndarray:
    """A sky reflected by a lobe: (rows, cols) float32."""
    there = scene.on(engine)
    reach = np.inf if max_distance is None else max_distance * (there.step / scene.spacing)
    table, suns, flux = blurred(sources.without_disc(grey), lobe.spread)
    brightness = sources.distribution_of(grey)
    if brightness is not None and (disc := brightness.disc()) is not None:
        suns = np.concatenate([suns.reshape(-1, 3), [disc.direction]])
        flux = np.append(flux, disc.irradiance)
    slices = Slices(there, scene.sides, Dome(reach), table, lobe=lobe)
    slices.run()
    image = slices.download()
    if len(suns):
        image += shading.suns(scene, engine, lobe, suns, flux, max_distance)
    return image * np.float32(_norm(scene))


def _lobe_of_solid(
    scene: Scene, grey: sources.Source, engine: Backend, lobe: Lobe, most: int, warnings: list[str]
) -> np.ndarray:
    """A lamp or window reflected by a lobe: (rows, cols) float32; a warning where slices are too coarse."""
    assert not isinstance(grey, sources.Sky), "a sky has no slices through a solid"
    brightness = brightness_of(grey)
    slices, scale = _slices(scene, grey, engine, most, brightness, lobe)
    if slices is None:
        return np.zeros(scene.shape, np.float32)
    slices.run()
    image = slices.download() * np.float32(_norm(scene) * scale)
    if slices.coarse > COARSE_LOBE:
        text = _narrow_lobe(lobe, slices.coarse * lobe.spread, "a smaller lamp, or Mirror")
        warnings.extend([text] if text not in warnings else [])
        np.minimum(image, np.float32(np.max(brightness)), out=image)  # no lobe shows more than there is
    return image


def _norm(scene: Scene) -> float:
    assert isinstance(scene.reflectance, Phong), "Phong alone has a lobe"
    return scene.reflectance.norm


def _narrow_lobe(lobe: Lobe, apart: float, fix: str) -> str:
    return (
        f"Narrow lobe: it is {np.degrees(lobe.spread):.1f} degrees wide and the directions are up to"
        f" {np.degrees(apart):.1f} degrees apart, so highlights break up into dots or are missing; use {fix}."
    )


# -- colours, images and error maps


def _number(source: sources.Source) -> float:
    """The brightness of a grey source whose brightness is a number."""
    value: Any = source.brightness
    return float(value)


def _numbers(greys: Sequence[sources.Source]) -> list[float] | None:
    """Brightnesses where all are numbers, so that colours differ by a factor alone; else None."""
    return None if any(callable(grey.brightness) for grey in greys) else [_number(grey) for grey in greys]


def _on_host(images: Sequence[Irradiance]) -> list[np.ndarray]:
    return [np.asarray(image) for image in images]


def _times(image: Irradiance, factor: float) -> Irradiance:
    if factor == 1:
        return image
    if isinstance(image, DeviceImage):  # a copy, as on the host: the image is used again
        times = image.copy()
        times.scale(factor)
        return times
    product = scratch(image.shape)
    by_bands(lambda rows: np.multiply(image[rows], np.float32(factor), out=product[rows]), image.shape)
    return product


def _in_unit(image: Any, unit: float) -> Any:
    """A result times a number: an array of any kind that render() gives, or None."""
    if image is None or isinstance(image, DeviceImage):
        return image if image is None else _times(image, unit)
    times = image * np.float32(unit)
    return times if isinstance(image, np.ndarray) else image.copy(data=times.data)


def _per_colour(greys: Sequence[sources.Source], work: Callable[[sources.Source], Irradiance]) -> list[Any]:
    """``work`` (source) for every colour; where colours differ by a factor alone, once, times that factor."""
    factors = _numbers(greys)
    if factors is None:
        return [work(grey) for grey in greys]
    one = work(replace(greys[0], brightness=1.0))
    return [_times(one, factor) for factor in factors]


def _image(
    scene: Scene, irradiances: list[np.ndarray], reflected: list[np.ndarray], quantity: str
) -> np.ndarray:
    """The image of a quantity, made in place of the irradiances; the lists have one array per colour."""
    colours = _radiances(scene, irradiances, reflected) if quantity == "radiance" else irradiances
    image = colours[0] if len(colours) == 1 else np.stack(colours, -1)
    if scene.mask is not None:
        image[~scene.mask] = np.nan
    return image


def _radiances(scene: Scene, irradiances: list[np.ndarray], reflected: list[np.ndarray]) -> list[np.ndarray]:
    """albedo E / pi + specular albedo x what else is reflected, per colour; made in place of E."""
    albedo, specular = (
        np.asarray(getattr(scene.reflectance, name, 1.0), np.float32) for name in ("albedo", "specular")
    )
    in_colour = [share for share in (albedo, specular) if _in_colour(share)]
    count = max(len(irradiances), len(reflected), 3 if in_colour else 0)
    images = []
    for n in range(count):
        image = np.zeros((), np.float32)
        if irradiances:
            image = _channel(irradiances, n, count)
            multiply(image, _share(albedo, n) * np.float32(1 / np.pi))
        if reflected:
            image = image + _share(specular, n) * _channel(reflected, n, count)
        images.append(image)
    return images


def _channel(colours: list[np.ndarray], n: int, count: int) -> np.ndarray:
    """Channel ``n`` of ``count``; a copy where one array serves several channels."""
    colour = colours[n % len(colours)]
    shared = count > len(colours) or sum(other is colour for other in colours) > 1
    return colour.copy() if shared else colour


def _share(share: np.ndarray, n: int) -> np.ndarray:
    """Channel ``n`` of an albedo."""
    return share[..., n] if _in_colour(share) else share


def _in_colour(share: np.ndarray) -> bool:
    return share.ndim in (1, 3)


def _error_map(result: Refined, scene: Scene) -> np.ndarray:
    """Estimated error (rows, cols) float32 of a refined irradiance."""
    if result.half is None:
        return np.full(scene.shape, result.floor, np.float32)
    square, count = np.where(scene.valid, result.half().astype(float) ** 2, 0), scene.valid.astype(float)
    for axis in (0, 1):
        square, count = (_box_sums(values, axis) for values in (square, count))
    error = np.sqrt(result.share**2 * square / np.maximum(count, 1) + result.floor**2).astype(np.float32)
    return np.asarray(ERROR_MAP_FACTOR * error)


def _box_sums(values: np.ndarray, axis: int) -> np.ndarray:
    """Sums over up to 2 ERROR_MAP_RADIUS + 1 neighbours along an axis."""
    ends = np.concatenate([np.zeros_like(np.take(values, [0], axis)), np.cumsum(values, axis)], axis)
    at = np.arange(values.shape[axis])
    high, low = np.minimum(at + ERROR_MAP_RADIUS + 1, len(at)), np.maximum(at - ERROR_MAP_RADIUS, 0)
    sums: np.ndarray = np.take(ends, high, axis) - np.take(ends, low, axis)
    return sums


def timed(engine: Backend, work: Callable[[], Result]) -> tuple[Result, float, float]:
    """(result, seconds without compiling, seconds of compiling) of ``work``, once the engine is free."""
    with engine.lock:
        compiled, start = engine.compile_seconds, time.perf_counter()
        result = work()
        compiling = engine.compile_seconds - compiled
        return result, time.perf_counter() - start - compiling, compiling


def _lattice_plan(options: _Options) -> Plan:
    """The lattice as asked; by "auto" without its arguments, a size whose error was measured to be small."""
    size = options.hemicube.size if isinstance(options.hemicube, Hemicube) else options.hemicube
    filled = options.filled is not False if options.method == "auto" else bool(options.filled)
    if options.method == "auto" and not options.lattice:
        errors = lattice.HEMICUBE_ERRORS
        size = next((m for m, error in errors.items() if error <= float(options.tolerance)), max(errors))
        return Plan("lattice", size, filled, f"RMS error {errors[size]} of E / pi on rough ground")
    return Plan("lattice", DEFAULT_HEMICUBE if size is None else size, filled, "as asked")
