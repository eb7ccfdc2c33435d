"""Reflection that is not Lambertian (docs/explanation): lobes by slices, mirrors and BRDFs by rays."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from . import sources
from .arrays import Quantity, labelled
from .backends.base import Backend
from .backends.numpy.luminance import gradient
from .constants import STEEP
from .directions import Azimuths, Hemicube
from .errors import bad
from .light import lattice
from .light.interreflection import Glossy
from .light.propagation import Lobe
from .light.slices import Slices
from .reflectance import BRDF, Mirror, Phong, frames, mirror_directions
from .scene import Scene, check_scene
from .sources.solids import Dome

# Gauss-Legendre nodes between horizon and zenith, of a BRDF under a sky: of every other azimuth each, so that
# their difference shows lobes that fall between elevations. Chosen: lobes of exponents up to 80 err by 0.1 %
# on a slope, of 100 by 0.3 and of 150 by 1.7 %; with 16 alone of 300 by 4.9 % without a difference
BRDF_ELEVATIONS = 16, 13
BRDF_RAYS = 12  # rays across a lamp or window, of a BRDF; its square in all
BRDF_BATCH = 2**18  # directions that a BRDF function is given at a time
NORMAL = Quantity("normal", "1", "unit normal of the surface")


def lobe_of(scene: Scene, lost: float = 1e-4) -> Lobe | None:
    """The lobe of a scene's reflectance, cut where a share ``lost`` of its light lies outside; or None."""
    surface = scene.reflectance
    if not (isinstance(surface, Phong) and np.any(surface.specular)):
        return None
    rim = surface.rim(lost)
    return Lobe(surface.table(rim), rim, surface.spread)


def has_mirror(scene: Scene) -> bool:
    return isinstance(scene.reflectance, Mirror) and bool(np.any(scene.reflectance.specular))


def tilts(scene: Scene) -> np.ndarray:
    """dz/dx and dz/dy (2, rows, cols) float32, as the kernels have them; 0 where masked."""
    depth, step = scene.lattice
    out = np.zeros((2, depth.size), np.float32)
    with np.errstate(invalid="ignore"):
        periodic = int(scene.sides == "periodic")
        gradient(depth, out, *scene.shape, depth.size, 0.5 / step, 1 / step, periodic)
    return out.reshape(2, *scene.shape)


def normals(scene: Scene) -> np.ndarray:
    """The surface's unit normals, with which images are shaded: (rows, cols, 3) float32.

    N = (dz/dx, dz/dy, -1) / |.|, z the depth: towards the viewer's side, where z is negative. x grows with
    columns, y with rows; for a DataArray x grows to the east and y to the south, whatever the order of its
    rows. Slopes are central differences, one-sided beside the border and masked nodes, and go round a map
    that repeats. Masked nodes are nan. A map on a GPU is copied to the host.

    Raises InputError for what is no scene, or a lazy one.

    Returns
    -------
    (rows, cols, 3) float32 [1]
        A NumPy array; a DataArray with the dimension ``component`` (x, y, z), if the scene was made from one.

    ``(1 + sl.normals(scene) * (1, -1, -1)) / 2`` is a normal map's RGB: x right, y up, z to the viewer.

    Examples
    --------
    >>> sl.normals(sl.Scene(1.0 * np.mgrid[:3, :3][1]))[1, 1].round(3)
    array([ 0.707,  0.   , -0.707], dtype=float32)
    """
    check_scene(scene)
    valid = scene.valid
    along = tilts(scene) * np.asarray(scene.axes, np.float32)[:, None, None]
    normal = np.stack([*along, np.full(scene.shape, -1, np.float32)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[~valid] = np.nan
    result: Any = labelled(normal, scene.labels, NORMAL, "component")
    if scene.labels is not None:
        result = result.assign_coords(component=["x", "y", "z"])
    unit: np.ndarray = result
    return unit


def suns(
    scene: Scene, engine: Backend, lobe: Lobe, L: np.ndarray, flux: np.ndarray, max_distance: float | None
) -> np.ndarray:
    """Reflection by a lobe, not normalised, of light from K directions of a sky: (rows, cols) float32.

    L (K, 3): unit vectors; ``flux`` (K,): brightness x solid angle of each.
    """
    rays, total = _Rays(scene, engine, max_distance), np.zeros(scene.shape)
    gx, gy = tilts(scene).astype(float)
    mirror, scale = mirror_directions(gx, gy), 1 / np.sqrt(gx**2 + gy**2 + 1)
    for some in np.array_split(np.arange(len(L)), -(-len(L) // 8)):
        directions = np.broadcast_to(L[some], (*scene.shape, len(some), 3))
        lit = rays.free(directions, np.full(directions.shape[:-1], np.inf))
        for n, k in enumerate(some):
            away = ((mirror - L[k]) ** 2).sum(-1) / 2
            weight = np.interp(away, np.linspace(0, lobe.rim, len(lobe.table)), lobe.table, right=0.0)
            cosine = np.maximum(0.0, (gx * L[k, 0] + gy * L[k, 1] - L[k, 2]) * scale)
            total += flux[k] * lit[..., n] * weight * cosine
    return total.astype(np.float32)


def mirrored(
    scene: Scene, greys: Sequence[sources.Source], engine: Backend, max_distance: float | None
) -> tuple[list[np.ndarray], np.ndarray]:
    """Radiance of the source along the mirror direction of every node, 0 where ground is in the way.

    (rows, cols) float32 for each of the grey sources, which differ in brightness alone, and the nodes whose
    mirror shows the source, (rows, cols) bool.
    """
    L = mirror_directions(*tilts(scene).astype(float))
    ends = _meets(scene, greys[0], L[:, :, None])[..., 0]
    if scene.sides == "periodic":  # no source stands among ground that repeats
        white = Glossy(engine, scene, scene.valid[None].astype(np.float32), max_distance)
        lit = (L[..., 2] <= 0) & ~np.isnan(ends) & scene.valid & (white.in_mirrors()[0] < 0.5)
    else:
        lit = _Rays(scene, engine, max_distance).free(L[:, :, None], ends[..., None])[..., 0]
    out = []
    for grey in greys:
        image = np.zeros(scene.shape, np.float32)
        image[lit] = sources.radiance(grey, L[lit])
        out.append(image)
    return out, lit


# Light that reaches the nodes, a part at a time: L (rows, cols, n, 3) unit vectors, weights (rows, cols, n)
# [sr], 0 where the source is not visible; 1 or -1 of two halves that each are an image, 0 without these
Parts = Iterator[tuple[np.ndarray, np.ndarray, int]]


def by_brdf(scene: Scene, greys: Sequence[sources.Source], parts: Parts) -> np.ndarray:
    """Radiance of a BRDF under all parts of the light, their irradiance, and half the difference of the
    radiances by two halves of them: (3, greys, rows, cols) float32.
    """
    reflect = _Reflection(scene)
    images = np.zeros((3, len(greys), *scene.shape))
    for L, weights, half in parts:
        both = reflect(greys, L, weights)
        images[:2] += both
        images[2] += half * both[0]
    return images.astype(np.float32)


def through_solid(scene: Scene, source: sources.Source, engine: Backend, max_distance: float | None) -> Parts:
    """Rays to a lamp or window, spread evenly over its solid angle or area."""
    rays = _Rays(scene, engine, max_distance)
    u = (np.arange(BRDF_RAYS) + 0.5) / BRDF_RAYS
    for a, half in zip(u, itertools.cycle((1, -1, -1, 1))):  # halves that have the same middle
        L, ends, weights = _aim(scene, source, a, u)
        yield L, np.where(rays.free(L, ends) & (weights > 0), weights, 0.0), half


def above_horizons(scene: Scene, planes: Iterable[tuple[np.ndarray, np.ndarray]], sectors: Azimuths) -> Parts:
    """Directions between the horizons and the zenith, azimuth by azimuth.

    ``planes`` yields (numbers of azimuths (n,), their horizons' slopes (n, rows, cols)), a few at a time.
    """
    rules = [np.polynomial.legendre.leggauss(count) for count in BRDF_ELEVATIONS]
    gx, gy = tilts(scene).astype(float)
    for numbers, slopes in planes:
        for number, slope in zip(numbers, slopes):
            node, weight = rules[number % 2]
            c, s = np.cos(sectors.angles[number]), np.sin(sectors.angles[number])
            plane = -(gx * c + gy * s)  # slope of the tangent plane; light comes from above the level, too
            low = np.arctan(np.maximum(np.maximum(slope, plane), 0.0))[..., None]
            half = (np.pi / 2 - low) / 2
            e = low + half * (1 + node)
            L = np.stack([np.cos(e) * c, np.cos(e) * s, -np.sin(e)], -1)
            yield L, half * weight * np.cos(e) * sectors.widths[number], 1 - 2 * int(number % 2)


def of_lattice(bits: np.ndarray, cube: Hemicube) -> Parts:
    """The directions of a hemicube that ``bits`` (rows, cols, words) has visible."""
    for some in np.array_split(np.arange(len(cube)), -(-len(cube) // 16)):
        lit = np.stack([bits[..., d // 32] >> np.uint32(d % 32) & np.uint32(1) for d in some], -1)
        L = np.broadcast_to(cube.directions[some], (*bits.shape[:2], len(some), 3))
        yield L, lit * cube.solid_angles[some], 0


class _Reflection:
    """Sums of f B cos(theta_i) x weight, the reflection integral, and of B cos(theta_i) x weight, the
    irradiance, in every node's frame.
    """

    def __init__(self, scene: Scene):
        assert isinstance(scene.reflectance, BRDF), "only a BRDF is integrated direction by direction"
        self.surface = scene.reflectance
        self.tilts = tilts(scene).astype(float)
        self.frames = frames(*self.tilts)
        # of a DataArray x of the frames is to the east and y to the south, in any order of rows and columns
        self.frames = self.frames * np.array([*scene.axes, 1.0])[:, None]
        self.outgoing = self.frames @ [0.0, 0.0, -1.0]

    def __call__(self, greys: Sequence[sources.Source], L: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """L (rows, cols, n, 3), weights (rows, cols, n) [sr] -> both sums (2, greys, rows, cols)."""
        out = np.zeros((2, len(greys), *L.shape[:2]))
        rows, cols, n = weights.shape
        for some in np.array_split(np.arange(rows), -(-rows * cols * n // BRDF_BATCH)):
            incoming = np.einsum("rcij,rcnj->rcni", self.frames[some], L[some])
            outgoing = np.broadcast_to(self.outgoing[some, :, None], incoming.shape)
            received = np.maximum(0.0, incoming[..., 2]) * weights[some]
            f, lit = self.surface.brdf(incoming, outgoing), received > 0
            for n, grey in enumerate(greys):
                light = np.zeros(received.shape)
                light[lit] = sources.radiance(grey, L[some][lit]) * received[lit]
                out[:, n, some] = (f * light).sum(-1), light.sum(-1)
        return out


class _Rays:
    """Rays from the nodes of a scene."""

    def __init__(self, scene: Scene, engine: Backend, max_distance: float | None):
        self.scene = scene
        self.slices = Slices(scene.on(engine), scene.sides, Dome())
        self.slices.coarsen()
        self.reach = np.inf if max_distance is None else max_distance / scene.spacing

    def free(self, L: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Whether rays along L (rows, cols, n, 3) reach ``ends`` (rows, cols, n) [unit of spacing].

        They do where the end is not nan, the ray rises above the level, and nothing is in the way.
        """
        scene, (rows, cols) = self.scene, self.scene.shape
        depth = scene.depth.astype(float)[..., None] / scene.spacing
        ends = ends / scene.spacing
        flat = np.hypot(L[..., 0], L[..., 1])
        up = -L[..., 2]
        lit = (up >= 0) & ~np.isnan(ends) & scene.valid[..., None]
        with np.errstate(divide="ignore", invalid="ignore"):
            if scene.sides == "dark":  # where the ray leaves the box through z = 0, or meets the source in it
                to = np.fmin(ends, depth / up)
                y, x = np.mgrid[:rows, :cols]
                for axis, at, count in ((0, x, cols), (1, y, rows)):
                    place = at[..., None] + np.where(L[..., axis] == 0, 0.0, to * L[..., axis])
                    lit &= (place >= -0.5) & (place < count - 0.5)
            tangent = np.where(flat > up / STEEP, up / flat, STEEP)
            c, s = np.where(flat > 0, L[..., 0] / flat, 1.0), np.where(flat > 0, L[..., 1] / flat, 0.0)
        along = np.where(flat > 0, ends * np.maximum(flat, 1e-30), np.inf)
        reach = np.where(lit, np.minimum(along, self.reach), 1e-6)
        ways = np.stack([c, s, tangent, np.minimum(reach, 1e30)], 2).astype(np.float32)
        arrived: np.ndarray = lit & self.slices.rays(ways)
        return arrived


def _nodes(scene: Scene) -> np.ndarray:
    """Positions of the nodes (rows, cols, 3) [unit of spacing]."""
    y, x = np.mgrid[: scene.shape[0], : scene.shape[1]]
    return np.stack([x * scene.spacing, y * scene.spacing, scene.depth.astype(float)], -1)


def _meets(scene: Scene, source: sources.Source, L: np.ndarray) -> np.ndarray:
    """Distance along L (rows, cols, n, 3) at which rays from the nodes meet the source [unit of spacing].

    It is inf for the sky, and nan where they miss the source.
    """
    if isinstance(source, sources.Sky):
        return np.full(L.shape[:-1], np.inf)
    origin = _nodes(scene)[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(source, sources.Window):
            return _meets_window(scene, source, origin, L)
        if source.center is not None and source.radius is not None:
            return _meets_sphere(np.array(source.center), source.radius, origin, L)
        if source.corner is not None and source.edges is not None:
            u, v = map(np.array, source.edges)
            return _meets_rectangle(np.array(source.corner), u, v, origin, L)
    raise bad("a mirror under a lamp given as a volume", "a lamp of any shape", "a sphere, or a rectangle")


def _meets_sphere(center: np.ndarray, radius: float, origin: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Distance along L from ``origin`` to a sphere, 0 from within it, nan where L misses it."""
    to = center - origin
    b, q = (to * L).sum(-1), (to * to).sum(-1) - radius**2
    root = b * b - q
    return np.where(q <= 0, 0.0, np.where((b > 0) & (root >= 0), b - np.sqrt(root), np.nan))


def _meets_rectangle(
    corner: np.ndarray, u: np.ndarray, v: np.ndarray, origin: np.ndarray, L: np.ndarray
) -> np.ndarray:
    """Distance along L from ``origin`` to a rectangle with edges u and v, nan where L misses it."""
    normal = np.cross(u, v)
    t = ((corner - origin) @ normal) / (L @ normal)
    past = origin + t[..., None] * L - corner
    inside = [(0 <= past @ edge) & (past @ edge < edge @ edge) for edge in (u, v)]
    return np.where(inside[0] & inside[1] & (t > 0), t, np.nan)


def _meets_window(scene: Scene, window: sources.Window, origin: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Distance along L from ``origin`` to z = 0, nan where the ray does not pass the window."""
    t = origin[..., 2] / -L[..., 2]
    places = (origin[..., axis] + np.where(L[..., axis] == 0, 0.0, t * L[..., axis]) for axis in (0, 1))
    # of masked nodes and level rays, which are out all the same, places are no numbers
    through = lattice.passes(scene, window, *(place / scene.spacing for place in places))
    return np.where(through & (L[..., 2] < 0), t, np.nan)


def _aim(
    scene: Scene, source: sources.Source, a: float, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays to a lamp or window, row ``a`` of a square of them: L (rows, cols, n, 3), ends, weights [sr].

    ``a`` and ``u`` (n,) are 0..1. Ends are distances [unit of spacing], (rows, cols, n), as weights are.
    """
    origin = _nodes(scene)
    if isinstance(source, sources.Lamp) and source.center is not None and source.radius is not None:
        L, weights = _aim_at_sphere(np.array(source.center), source.radius, origin, a, u)
        return L, _meets(scene, source, L), weights
    if isinstance(source, sources.Lamp):
        assert source.corner is not None and source.edges is not None, "volumes are rendered by the lattice"
        first, second = map(np.array, source.edges)
        return _aim_at_rectangle(np.array(source.corner), first, second, origin, a, u)
    assert isinstance(source, sources.Window), "a sky is integrated above horizons"
    assert source.x is not None and source.y is not None, "apertures are rendered by the lattice"
    (x0, x1), (y0, y1) = source.x, source.y
    if scene.sides == "dark":  # the walls hide the rest
        x0, x1 = np.clip((x0, x1), *(np.array([-0.5, scene.shape[1] - 0.5]) * scene.spacing))
        y0, y1 = np.clip((y0, y1), *(np.array([-0.5, scene.shape[0] - 0.5]) * scene.spacing))
    first, second = np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0.0])
    return _aim_at_rectangle(np.array([x0, y0, 0.0]), first, second, origin, a, u)


def _aim_at_sphere(
    center: np.ndarray, radius: float, origin: np.ndarray, a: float, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """L and weights of rays uniform in the cone that a sphere subtends; see :func:`_aim`."""
    to = center - origin
    far = np.linalg.norm(to, axis=-1, keepdims=True)
    inside = far[..., 0] <= radius
    axis = np.where(inside[..., None], [0.0, 0.0, -1.0], to / np.where(far > 0, far, 1.0))
    e = np.cross(axis, np.where(np.abs(axis[..., :1]) < 0.5, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    e /= np.linalg.norm(e, axis=-1, keepdims=True)
    f = np.cross(axis, e)
    q = np.minimum(1.0, (radius / np.where(far > 0, far, 1.0)) ** 2)[..., 0]
    cap = np.where(inside, 1.0, q / (1 + np.sqrt(1 - q)))  # 1 - cos of the cone's half angle
    lost = (a * cap)[..., None, None]
    sine = np.sqrt(lost * (2 - lost))
    turn = 2 * np.pi * (u + a)[:, None]  # rings turned against each other
    L = (1 - lost) * axis[:, :, None] + sine * (np.cos(turn) * e[:, :, None] + np.sin(turn) * f[:, :, None])
    weights = np.broadcast_to((2 * np.pi * cap / len(u) ** 2)[..., None], L.shape[:-1])
    return L, weights


def _aim_at_rectangle(
    corner: np.ndarray, first: np.ndarray, second: np.ndarray, origin: np.ndarray, a: float, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L, ends and weights of rays uniform in the solid angle of a rectangle; see :func:`_aim`.

    With the foot of the perpendicular, d long, at (0, 0), domega = dphi dh for x = d tan(phi), y = h sqrt(d^2
    + x^2 + y^2): even steps of both are even steps of solid angle, and nothing is singular close by.
    """
    width, length = np.linalg.norm(first), np.linalg.norm(second)
    if width * length == 0:  # a dark box leaves nothing of it
        nothing = np.zeros((*origin.shape[:2], len(u)))
        return np.broadcast_to([0.0, 0.0, -1.0], (*nothing.shape, 3)), nothing + 1, nothing
    ex, ey = first / width, second / length
    to, ez = corner - origin, np.cross(ex, ey)
    x, y, d = to @ ex, to @ ey, to @ ez
    near = np.where(d == 0, 1.0, np.abs(d))  # from its own plane it is a line
    left, right = np.arctan2(x, near), np.arctan2(x + width, near)
    x = (near * np.tan(left + a * (right - left)))[..., None]
    away = np.hypot(near[..., None], x)
    low, high = (end / np.hypot(away, end) for end in (y[..., None], y[..., None] + length))
    h = low + u * (high - low)
    y = h * away / np.sqrt(1 - h * h)
    far = np.hypot(away, y)
    L = (x[..., None] * ex + y[..., None] * ey + d[..., None, None] * ez) / far[..., None]
    return L, far, np.where(d == 0, 0.0, right - left)[..., None] * (high - low) / len(u) ** 2
