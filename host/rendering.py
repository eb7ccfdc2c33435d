"""render(): a scene and a source to an image (Eq. 3)."""

from __future__ import annotations

from . import sources
from .directions import Azimuths, Hemicube
from .images import Rendering
from .light.far import Tiling
from .light.sweeps import engine_of
from .render_options import Options
from .render_tiles import goes_in_tiles, in_tiles
from .renderer import Renderer
from .scale import limited
from .scene import Scene


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
    (rows, cols, 3), where brightness or reflectance is; each channel equals its grey render, bit for bit by
    direct light, within the tolerance by all. To rho E / pi comes the integral of f B cos(theta_i) over the
    visible directions, f a lobe or any BRDF, or the brightness in a mirror.

    Parameters
    ----------
    scene, source : Scene; Sky, Lamp or Window
    method : "auto", "lattice", "horizon" or "unoccluded"
        ``auto``: begun with :func:`skylamp.plan` and refined until the estimate of its error, over all
        nodes, and exact rays at some hundred samples are within ``tolerance``. ``lattice``: the paper's
        directions on a hemicube (9 unless given). ``horizon``: the source above the horizon of every node in
        a number of azimuths (64 unless given; for lamps and windows, slices through the source as every node
        sees it). ``unoccluded``: closed forms, as if ground hid but what lies below a node's tangent plane;
        the brightness of a lamp or window is that towards its middle.
    tolerance, tail : float
        Of ``auto``, and of light between surfaces: RMS error over the mean irradiance of lit nodes (at least
        1e-6 of what the source gives if as bright all round); bound of the 99.9th percentile, 10 tolerances.
    backend : str
        See :func:`skylamp.backends`.
    quantity : "radiance" or "irradiance"
        Radiance [unit of brightness], or irradiance E [unit of brightness x sr], whatever the reflectance.
    hemicube : odd int or Hemicube, M of the lattice, in place of a tolerance
    filled : bool
        Test every crossing of a ray with a grid line; False (unless given, of "lattice"): at nodes alone.
    weights : "moment" or "printed"
        Each cell's integral of N.L dL (exact where the cell is wholly visible and above the tangent plane),
        or N.L of its node times its solid angle, as Eq. 3 is printed.
    azimuths : int or Azimuths
        Of horizons, in place of a tolerance: no error is estimated. Under a sky whose brightness is very
        uneven in azimuth, such as one with a sun, a number is placed half evenly, half by brightness.
    max_distance : float [unit of spacing]
        Of horizons under a sky, in place of a tolerance: ground, but no wall of a dark box, farther away does
        not count; the whole map does unless given. Of a lamp on tiles: its reach.
    interreflection : "auto", True or False
        Light between surfaces, to any number of bounces. ``auto``: where a tolerance chooses the method, if
        it is more than a third of that, which then holds for all light. Without it, mirrors show no ground.
    parts : bool
        Give ``direct`` and ``reflected`` besides.
    tiling : Tiling
        Tile by tile, as lazy scenes, which give lazy images, and maps beyond the device's memory: see
        :func:`skylamp.horizons`. Skies in 64 azimuths unless given, suns in their own; no refinement.
    max_seconds : float
        OutOfTimeError once they are over, compiling apart; looked at before each launch. Not of lazy scenes.

    Examples
    --------
    >>> image = sl.render(sl.Scene(np.zeros((3, 3)), albedo=0.5), sl.Sky(2.0)).image  # 1: albedo E / pi
    """
    asked = method, tolerance, quantity, hemicube, filled, weights, azimuths, max_distance, tail
    options = Options(*asked, interreflection, parts)
    options.check(scene, source)
    scene = scene.under_sky() if isinstance(source, sources.Sky) else scene
    engine = engine_of(scene, backend)
    source, scale = sources.in_range(sources.on_axes(source, scene.axes))
    with limited(max_seconds, "render", scene, backend):
        if goes_in_tiles(options, scene, source, engine, tiling):
            return in_tiles(scene, source, options, engine, backend, tiling)._times(scale)
        return Renderer(scene, source, engine, options).render()._times(scale)
