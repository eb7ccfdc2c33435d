"""render() of maps in tiles: a sky tile by tile, a lamp on the part of the map within its reach."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from . import sources
from .arrays import labelled
from .backends.base import Backend, timed
from .directions import Azimuths
from .errors import bad
from .images import IMAGES, Rendering, image_of, numbers_of, on_host
from .interreflection import Interreflection, albedos, included, is_needed, local_sums, reason, share_of
from .light.far import Far, Tiling
from .light.horizon import with_bright_parts
from .light.sweeps import Ground, Rays, Sweeps, engine_of, ground_of
from .planning.plan import Plan
from .render_options import DEFAULT_AZIMUTHS, Options, sectors_of
from .renderer import Renderer, lattice_plan, slice_count
from .samples import Samples, lit_mean, ring
from .scale import (
    AUDITED,
    Audit,
    Lights,
    check_tiling,
    decided,
    holds,
    layout_of,
    over_area,
    seen_from_edge,
    tiled,
    warn,
    within_tile,
)
from .scene import Scene
from .sources.integrals import FINE_KNOTS, even, integrals

# azimuths of a small part of a sky on a map in tiles; chosen: with 8 the error is 0.06 %, cliffs apart
PART_SECTORS = 16
# rows within which every crossing on the way to such a part is tested. Chosen: on six maps of rough ground of
# 200 x 256 nodes with a sun 20 degrees high the RMS error is 1.9 to 3.1 % with 6, 0.3 to 1.2 % with 24, 0.2 %
# with 96 and with 200; a call takes 1.2, 1.3, 1.7 and 2.4 s for 1024 x 1024 nodes on two cores
PART_NEAR_ROWS = 96
# azimuths in which windows of tiles estimate the light between surfaces, with an error of 0.003 in the share
# of sky; and the part of a window at each of its sides that is left out, since ground beyond is missing;
# chosen
DECIDING_WINDOW_AZIMUTHS, WINDOW_EDGE = 16, 8
# azimuths, and sectors of each small bright part, of the exact light that an image in tiles is held against;
# chosen: with twice and four times as many the errors that ten tiles are said to have change by a tenth at
# most
JUDGING_AZIMUTHS, JUDGING_SECTORS = 72, 24
# relative RMS error that 64 azimuths keep to under even skies: 0.0004 of E / pi on rough ground
# (performance/refinement.py)
LEAST_TILED_TOLERANCE = 0.002
BETWEEN_NEEDS = "it needs open sides and tiles of at least two halos"
LOBES = (  # what is refused of them, what is allowed, and why
    "a lobe or a mirror",
    "a Lambertian surface, or quantity='irradiance'",
    "The ground or sky that it shows may be seen over any tile.",
)


def goes_in_tiles(
    options: Options, scene: Scene, source: sources.Source, engine: Backend, tiling: Tiling | None
) -> bool:
    """Whether tiles are asked for, which may be an InputError, or are needed and possible."""
    check_tiling(tiling)
    asked = scene.lazy is not None or tiling is not None
    if not asked and holds(*scene.shape, engine):
        return False
    refused = refused_in_tiles(options, scene, source, engine)
    if asked and refused:
        raise bad("render: a map in tiles", *refused)
    return refused is None


def refused_in_tiles(
    options: Options, scene: Scene, source: sources.Source, engine: Backend | None
) -> tuple[str, str, str] | None:
    """The first thing that is not rendered in tiles, what is allowed, and why; None where there is none.

    ``engine``: renders the part that a lamp lights at once; None where lamps are not allowed.
    """
    if options.parts:
        light = "all light, or interreflection=False and direct light"
        return "parts", light, "One image is made of a tile."
    if isinstance(source, sources.Lamp) and engine is not None:
        return _refused_lamp(options, scene, source, engine)
    unrefined = "Nothing is refined: azimuths of its own would set every tile apart from its neighbours."
    refused = [
        (isinstance(source, sources.Window), "a window", "a Sky", "Its light may cross any tile on its way."),
        (
            isinstance(source, sources.Lamp),
            "a lamp",
            "a Sky, or a lazy map",
            "All nodes that it lights are rendered at once, and a task reads one tile.",
        ),
        (
            options.lattice or options.method not in ("auto", "horizon"),
            "the lattice or closed forms",
            "horizons",
            "Of ground beyond its halo a tile knows horizons alone.",
        ),
        (options.shines(scene), *LOBES),
        (options.tail is not None, "a tail", "as many azimuths as asked", unrefined),
        (
            options.azimuths is None and float(options.tolerance) < LEAST_TILED_TOLERANCE,
            f"a tolerance of {options.tolerance:g}",
            f"at least {LEAST_TILED_TOLERANCE}, or azimuths",
            unrefined,
        ),
    ]
    return next(((what, allowed, why) for is_so, what, allowed, why in refused if is_so), None)


def _refused_lamp(
    options: Options, scene: Scene, lamp: sources.Lamp, engine: Backend
) -> tuple[str, str, str] | None:
    """What keeps the nodes that a lamp lights from being rendered at once, what does not, and why."""
    if lamp.center is None:
        sphere = "a sphere, by its center and radius"
        return "a lamp without a centre", sphere, "Its reach, max_distance, is counted from there."
    if scene.sides != "open":
        why = "What it lights is rendered as a map of its own, without the walls or copies beside the map."
        return f"a lamp with sides {scene.sides!r}", "sides 'open'", why
    if options.shines(scene):
        return LOBES
    rows, cols = (area.stop - area.start for area in _lit_area(scene, lamp, options.max_distance))
    if rows < 1 or cols < 1:
        far = "a lamp beyond whose reach the whole map lies"
        return far, "a larger max_distance", "Nodes beyond its reach get none of its light."
    if not holds(rows, cols, engine):
        return (
            f"a lamp that lights {rows} x {cols} nodes",
            "a smaller max_distance, its reach: nodes farther away get none of its light",
            "All are rendered at once, and so many do not fit.",
        )
    return None


def in_tiles(
    scene: Scene,
    source: sources.Source,
    options: Options,
    engine: Backend,
    backend: str,
    tiling: Tiling | None,
) -> Rendering:
    """A sky or a lamp on a map in tiles: lazy, if the scene is."""
    leading = [3] if _in_colour_in_tiles(scene, source, options) else []

    def light() -> tuple[Any, Plan, Interreflection, list[str]]:
        if isinstance(source, sources.Lamp):
            return _lamp_in_tiles(scene, source, options, backend, leading)
        return _sky_in_tiles(scene, source, options, backend, tiling, leading)

    (image, plan, interreflection, warnings), seconds, compiling = timed(engine, light)
    if leading:
        image = image.transpose(1, 2, 0) if scene.lazy is not None else np.moveaxis(image, 0, -1)
    return Rendering(
        labelled(image, scene.labels, IMAGES[options.quantity]),
        plan,
        engine.name,
        seconds,
        compiling,
        warnings,
        _quantity=options.quantity,
        interreflection=interreflection,
    )


def _sky_in_tiles(
    scene: Scene,
    source: sources.Source,
    options: Options,
    backend: str,
    tiling: Tiling | None,
    leading: list[int],
) -> tuple[Any, Plan, Interreflection, list[str]]:
    """Image, plan, light between surfaces and warnings of a sky, tile by tile."""
    between, why = _between_in_tiles(scene, source, options)
    work, share = _tile_image(scene, source, options, backend, between), None
    if between is None and scene.lazy is None:
        work = decided(work, scene, tiling, options.max_distance, work.audit)
        between, share = work.between, work.share
        why = reason(share, work.tolerance)
        if not between and is_needed(share or 0.0, work.tolerance):
            why = f"{BETWEEN_NEEDS}; {why}"
    image = tiled(work, scene, tiling, options.max_distance, work.audit, *leading, between=between)
    if between is None and not layout_of(scene, tiling, options.max_distance, work.audit, None).has_room:
        between, why = False, BETWEEN_NEEDS
    count = len(sectors_of(options.azimuths))
    plan = Plan("horizon", None, None, "a map in tiles is not refined", count, options.max_distance)
    return image, plan, Interreflection(between, why, share), []


def _lamp_in_tiles(
    scene: Scene, lamp: sources.Lamp, options: Options, backend: str, leading: list[int]
) -> tuple[Any, Plan, Interreflection, list[str]]:
    """Image, plan, light between surfaces and warnings of a lamp on the part of the map within its reach."""
    area = _lit_area(scene, lamp, options.max_distance)
    done: list[Rendering] = []
    whole_part = replace(options, max_distance=None)
    work = LampImage(lamp, whole_part, backend, bool(leading), done if scene.lazy is None else None)
    image = over_area(work, scene, *area, *leading)
    how = "the part of the map within reach of the lamp is rendered at once"
    between, why = _between_in_tiles(scene, lamp, options)
    plan, interreflection = _plan_of_lamp(whole_part, how), Interreflection(between, why)
    if done:
        plan = replace(done[0].plan, reason=f"{done[0].plan.reason}; {how}")
        interreflection = done[0].interreflection or interreflection
    plan = replace(plan, max_distance=options.max_distance)
    return image, plan, interreflection, _beyond_reach(lamp, options.max_distance)


def _plan_of_lamp(options: Options, how: str) -> Plan:
    """The plan of a lamp before its image is made; what "auto" refines to is not known then."""
    if options.lattice or options.method == "lattice":
        return replace(lattice_plan(options), reason=how)
    if options.method == "unoccluded":
        return Plan("unoccluded", None, None, how)
    return Plan("horizon", None, None, how, None if options.chooses else slice_count(options.azimuths))


def _between_in_tiles(scene: Scene, source: sources.Source, options: Options) -> tuple[bool | None, str]:
    """(Whether tiles have light between surfaces, None where the whole map decides; why)."""
    lit_at_once = isinstance(source, sources.Lamp)
    if options.interreflection is False:
        return False, "as asked"
    if not (np.ndim(scene.albedo) or scene.albedo):
        return False, "the surface has no diffuse albedo"
    if options.interreflection is True:
        return True, "as asked" if lit_at_once else "as asked, in every tile for itself"
    if not options.planned(scene, source):
        return False, "the method that was asked for is of direct light"
    where = "the part that the lamp lights has" if lit_at_once else "windows of all tiles have"
    return None, f"if {where} more of it than a third of the tolerance"


def _in_colour_in_tiles(scene: Scene, source: sources.Source, options: Options) -> bool:
    """Whether images of tiles are in colour."""
    coloured = np.ndim(scene.albedo) in (1, 3)
    between, _ = _between_in_tiles(scene, source, options)
    coloured = coloured and (options.quantity == "radiance" or between is not False)
    return len(sources.channels(source)) > 1 or coloured


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
        f"Reach: nodes more than {reach:g} from the lamp along rows or columns get none of its light, and"
        " those within get none that these would reflect; that would be a direct irradiance of up to"
        f" {math.pi * min(1.0, lamp.radius / reach) ** 2:.2g} times its brightness."
    ]


def colours_first(image: np.ndarray) -> np.ndarray:
    """(3, rows, cols) of an image (rows, cols, 3), or of one that is the same in all colours."""
    return np.broadcast_to(image, (3, *image.shape)) if image.ndim == 2 else np.moveaxis(image, -1, 0)


@dataclass(frozen=True)
class LampImage:
    """The image of the part of a map that a lamp lights, as :func:`skylamp.scale.over_area` asks for it."""

    lamp: sources.Lamp
    options: Options
    backend: str
    in_colour: bool
    done: list[Rendering] | None = None  # to which the part's rendering is added

    def __call__(self, scene: Scene, row: int, col: int, below: float) -> np.ndarray:
        """(rows, cols) float32, or (3, rows, cols) in colour.

        ``row``, ``col``: of the scene's first node in the map; ``below``: depth [length] of its plane z = 0.
        """
        assert self.lamp.center is not None, "checked"
        x, y, z = self.lamp.center
        center = x - col * scene.spacing, y - row * scene.spacing, z - below
        lamp = replace(self.lamp, center=center)
        engine = engine_of(scene, self.backend)
        lamp_in_range, scale = sources.in_range(lamp)
        done = Renderer(scene, lamp_in_range, engine, self.options).render()._times(scale)
        for text in done.warnings:
            warn(text)
        if self.done is not None:
            self.done.append(done)
        image = np.asarray(done.image)
        return colours_first(image) if self.in_colour else image


@dataclass(frozen=True)
class TileImage:
    """The image of a tile under a sky, as :func:`skylamp.scale.tiled` asks for it.

    rays, and tables of brightness, of every colour, the first ``even`` of all the sky, the others of its
    small bright parts; factors of the colours that differ by these alone, of which there is one ray and no
    table. in_colour: the image is (3, rows, cols). between: with the light between surfaces, within
    ``tolerance``, or None where the whole map decides by ``fewer``: the same lights in fewer azimuths. The
    light is ``scale`` times that of the tables. ``judging``: what its samples are held against.
    """

    lights: Lights
    even: int
    factors: tuple[float, ...] | None
    quantity: str
    in_colour: bool
    backend: str
    tolerance: float
    between: bool | None
    scale: float
    colours: int
    fewer: Lights
    judging: Lights  # in more azimuths, if the tolerance chose those of the image
    share: float | None = None  # estimate of the light between surfaces

    @property
    def audit(self) -> Audit:
        """Within which tolerance far ground must be taken."""
        suns = any(len(rays.angles) > self.even for rays, _ in self.lights)
        return Audit(self.backend, self.tolerance, self.fewer, suns)

    def __call__(
        self, scene: Scene, max_distance: float | None, far: Far | None, part: slice = slice(None)
    ) -> np.ndarray:
        """(rows, cols) float32, or ``part`` of the colours (3, rows, cols); nan where masked."""
        engine = engine_of(scene, self.backend)
        with engine.lock:
            ground = ground_of(scene, max_distance, engine)
            swept = _swept(engine, ground, self.lights, far, self.even)
            if part.start in (None, 0):  # else another task of this tile does
                self._judge(engine, scene, max_distance, far, swept)
            light = self._coloured(swept)
            if self.between:
                sky = _share_of_sky(engine, ground, DEFAULT_AZIMUTHS, far)
                both = included(scene, engine, light, self.tolerance, "as asked", sky=sky, is_part=True)
                light = on_host(both.irradiances)
                for text in both.warnings:
                    warn(text)
        if self.scale != 1:
            light = [image * np.float32(self.scale) for image in light]
        image = image_of(scene, light, [], self.quantity)
        return colours_first(image)[part] if self.in_colour else image

    def _coloured(self, light: list[np.ndarray]) -> list[np.ndarray]:
        """The light of every colour of the source."""
        if self.factors is None:
            return light
        return [light[0] * np.float32(factor) for factor in self.factors]

    def _judge(
        self,
        engine: Backend,
        scene: Scene,
        max_distance: float | None,
        far: Far | None,
        images: list[np.ndarray],
    ) -> None:
        """Warn where direct light at samples of the tile differs from that above exact horizons by more than
        the tolerance: tiles are not refined.
        """
        if not self.judging:
            return
        samples, share = Samples(engine, scene, AUDITED), 0.0
        inner = np.full(len(samples), True) if far is None else within_tile(samples, far)
        if not inner.any():
            return
        plane = samples.gx[inner], samples.gy[inner]
        for (rays, table), image in zip(self.judging, images):
            if far is None:
                reach = math.inf if max_distance is None else max_distance / scene.spacing
                slopes = samples.horizons(rays.angles, reach)
            else:
                slopes = seen_from_edge(samples, inner, scene, far, rays.angles)[1]
            exact = rays.widths @ ring(*plane, rays.angles, slopes, table)
            if mean := lit_mean(exact):
                off = math.sqrt(float(np.mean((samples.of(image)[inner] - exact) ** 2)))
                share = max(share, off / mean)
        if share > self.tolerance:
            warn(
                f"Tolerance: the sweeps of tiles, which are not refined, leave an error of about"
                f" {100 * share:.2g} % (RMS over the mean of a tile), more than the"
                f" {100 * self.tolerance:.2g} % asked for."
            )

    def sums(self, scene: Scene) -> np.ndarray:
        """Sums from which the light between surfaces is estimated, (colours, 3); nodes at the border are
        left out, since ground beyond the window is missing."""
        engine, edge = engine_of(scene, self.backend), [n // WINDOW_EDGE for n in scene.shape]
        with engine.lock:
            ground = ground_of(scene, None, engine)
            light = self._coloured(_swept(engine, ground, self.fewer, None))
            sky = _share_of_sky(engine, ground, len(self.fewer[0][0].angles), None)
        inner = np.zeros(scene.shape, bool)
        inner[edge[0] : scene.shape[0] - edge[0], edge[1] : scene.shape[1] - edge[1]] = True
        inner &= scene.valid
        shares = [share[inner] if np.ndim(share) else share for share in albedos(scene)]
        sums = [
            local_sums(light[n % len(light)][inner], sky[inner], shares[n % len(shares)])
            for n in range(self.colours)
        ]
        return np.stack(sums)

    def decided(self, sums: np.ndarray, possible: bool) -> TileImage:
        """This image with or without light between surfaces; a warning where it counts and cannot be."""
        share = share_of(sums)
        needed = is_needed(share, self.tolerance)
        if needed and not possible:
            warn(
                f"Tolerance: light between surfaces is left out, since {BETWEEN_NEEDS}; it is about"
                f" {100 * share:.2g} % of the direct light (RMS over the mean), more than a third of the"
                f" {100 * self.tolerance:.2g} % asked for."
            )
        return replace(self, between=bool(needed and possible), share=share)


def _swept(
    engine: Backend, ground: Ground, lights: Lights, far: Far | None, even: int | None = None
) -> list[np.ndarray]:
    """Direct irradiance of each of the lights; azimuths from ``even`` on have more near rows."""
    images = []
    for (angles, widths, _), table in lights:
        first = Rays(angles[:even], widths[:even])
        sky = None if table is None else table[:even]
        images.append(Sweeps(engine, ground, first, sky, far=far).irradiance())
        if table is not None and even is not None and len(angles) > even:
            others = Rays(angles[even:], widths[even:])
            near = PART_NEAR_ROWS
            images[-1] += Sweeps(engine, ground, others, table[even:], near, far=far).irradiance()
    return images


def _share_of_sky(engine: Backend, ground: Ground, azimuths: int, far: Far | None) -> np.ndarray:
    """Share of sky that every node of a tile sees, cosine-weighted, (rows, cols) float32."""
    sectors = Azimuths(azimuths)
    rays = Rays(sectors.angles, sectors.widths)
    return Sweeps(engine, ground, rays, far=far).irradiance() * np.float32(1 / np.pi)


def tile_image(scene: Scene, source: sources.Source, backend: str, **asked: Any) -> TileImage:
    """The image of a tile of a lazy scene; ``asked``: quantity and other options of :func:`render`.

    Raises InputError for what is not rendered in tiles.
    """
    options = Options(**asked)
    options.check(scene, source)
    refused = refused_in_tiles(options, scene, source, None)
    if refused:
        raise bad("render: a map in tiles", *refused)
    return _tile_image(scene, source, options, backend, _between_in_tiles(scene, source, options)[0])


def _tile_image(
    scene: Scene, source: sources.Source, options: Options, backend: str, between: bool | None
) -> TileImage:
    source, scale = sources.in_range(source)
    greys, sectors = sources.channels(source), sectors_of(options.azimuths, scene.axes)
    factors = numbers_of(greys)
    skies = [grey for grey in greys if isinstance(grey, sources.Sky)][: None if factors is None else 1]
    return TileImage(
        tuple(_rays_of(sky, sectors) for sky in skies),
        len(sectors),
        None if factors is None else tuple(factors),
        options.quantity,
        _in_colour_in_tiles(scene, source, options),
        backend,
        float(options.tolerance),
        between,
        scale,
        max(len(greys), 3 if np.ndim(scene.albedo) in (1, 3) else 1),
        tuple(_rays_of(sky, Azimuths(DECIDING_WINDOW_AZIMUTHS)) for sky in skies),
        ()
        if options.azimuths is not None
        else tuple(_rays_of(sky, even(JUDGING_AZIMUTHS, 1 / 3), JUDGING_SECTORS) for sky in skies),
    )


def _rays_of(
    sky: sources.Sky, sectors: Azimuths, of_each_part: int = PART_SECTORS
) -> tuple[Rays, np.ndarray | None]:
    """Azimuths and the table of a sky's brightness, its small bright parts in azimuths of their own."""
    rays = Rays(sectors.angles, sectors.widths)
    if not callable(sky.brightness):
        return rays, None
    light = integrals(sky)
    table = light.table(sectors.angles, sectors.widths, FINE_KNOTS)
    suns = [sun.sectors(of_each_part) for sun in light.bright_parts]
    return with_bright_parts(rays, table, suns) if suns else (rays, table)
