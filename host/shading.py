"""What surfaces that are not Lambertian make of their light: lobes through slices, mirrors and BRDFs ray by
ray (MODEL.md, 6).
"""

from __future__ import annotations

import numpy as np

from . import sources
from .backends.base import Backend
from .backends.numpy.luminance import gradient
from .errors import bad
from .light.propagation import Lobe
from .light.slices import Slices
from .reflectance import BRDF, Mirror, Phong, frames, mirror_directions
from .scene import Scene
from .sources.solids import Dome

ELEVATIONS = 12  # Gauss-Legendre nodes between horizon and zenith, of a BRDF under a sky
ACROSS = 12  # rays across a lamp or window, of a BRDF; its square in all
STEEP = 1e6  # tangent of the zenith, as in slices
AT_ONCE = 2**18  # directions that a BRDF function is given at a time


def lobe_of(scene: Scene, lost: float = 1e-4) -> Lobe | None:
    """The lobe of a scene whose reflectance has one that shows, but for a share ``lost`` of its light at its
    rim.
    """
    surface = scene.reflectance
    if not (isinstance(surface, Phong) and np.any(surface.specular)):
        return None
    rim = surface.rim(lost)
    return Lobe(surface.table(rim), rim, surface.spread)


def has_mirror(scene: Scene) -> bool:
    return isinstance(scene.reflectance, Mirror) and bool(np.any(scene.reflectance.specular))


def tilts(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """dz/dx and dz/dy (rows, cols) float32, as the kernels have them; 0 where masked."""
    depth, step = scene.lattice()
    out = np.zeros((2, depth.size), np.float32)
    with np.errstate(invalid="ignore"):
        gradient(depth, out, *scene.shape, depth.size, 0.5 / step, 1 / step)
    return out.reshape(2, *scene.shape)


def suns(
    scene: Scene, engine: Backend, lobe: Lobe, L: np.ndarray, flux: np.ndarray, max_distance: float | None
) -> np.ndarray:
    """What a lobe, not normalised, makes of light from a few directions L (K, 3) of a sky, ``flux`` (K,)
    each: (rows, cols) float32.
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
            total += (
                flux[k]
                * lit[..., n]
                * weight
                * np.maximum(0.0, (gx * L[k, 0] + gy * L[k, 1] - L[k, 2]) * scale)
            )
    return total.astype(np.float32)


def mirrored(scene: Scene, greys: list, engine: Backend, max_distance: float | None) -> list[np.ndarray]:
    """Radiance along the mirror direction of every node, (rows, cols) float32 for each grey source of one
    place; 0 where ground is in the way.
    """
    if scene.sides == "periodic":
        raise bad(
            "a mirror with sides='periodic'",
            "rays that would go on over a map that repeats",
            "sides='open' or 'dark', or Phong with a large exponent",
        )
    L = mirror_directions(*tilts(scene).astype(float))
    ends = _meets(scene, greys[0], L[:, :, None])[..., 0]
    lit = _Rays(scene, engine, max_distance).free(L[:, :, None], ends[..., None])[..., 0]
    out = []
    for grey in greys:
        image = np.zeros(scene.shape, np.float32)
        image[lit] = sources.radiance(grey, L[lit])
        out.append(image)
    return out


def by_brdf(scene: Scene, greys: list, engine: Backend, max_distance: float | None) -> list[np.ndarray]:
    """Radiance of a BRDF under a lamp or window, by rays spread evenly over its solid angle or area."""
    rays, surface = _Rays(scene, engine, max_distance), scene.reflectance
    images = [np.zeros(scene.shape) for _ in greys]
    shade = _Shade(scene)
    u = (np.arange(ACROSS) + 0.5) / ACROSS
    for a in u:
        L, ends, weights = _aim(scene, greys[0], a, u)
        lit = rays.free(L, ends) & (weights > 0)
        for image, light in zip(images, shade(surface, greys, L, np.where(lit, weights, 0.0))):
            image += light
    return [image.astype(np.float32) for image in images]


def by_brdf_under_sky(scene: Scene, greys: list, planes, sectors) -> list[np.ndarray]:
    """The same under a sky, above the horizons that ``planes`` yields: (numbers of azimuths, slopes (n, rows,
    cols)) at a time.
    """
    surface, shade = scene.reflectance, _Shade(scene)
    images = [np.zeros(scene.shape) for _ in greys]
    node, weight = np.polynomial.legendre.leggauss(ELEVATIONS)
    gx, gy = shade.tilts
    for numbers, slopes in planes:
        for number, slope in zip(numbers, slopes):
            c, s = np.cos(sectors.angles[number]), np.sin(sectors.angles[number])
            low = np.arctan(np.maximum(np.maximum(slope, -(gx * c + gy * s)), 0.0))[
                ..., None
            ]  # the tangent plane, the level
            half = (np.pi / 2 - low) / 2
            e = low + half * (1 + node)
            L = np.stack([np.cos(e) * c, np.cos(e) * s, -np.sin(e)], -1)
            for image, light in zip(
                images, shade(surface, greys, L, half * weight * np.cos(e) * sectors.widths[number])
            ):
                image += light
    return [image.astype(np.float32) for image in images]


def by_brdf_on_lattice(scene: Scene, greys: list, bits: np.ndarray, cube) -> list[np.ndarray]:
    """The same for the directions of a hemicube that ``bits`` (rows, cols, words) says are visible."""
    surface, shade = scene.reflectance, _Shade(scene)
    images = [np.zeros(scene.shape) for _ in greys]
    for some in np.array_split(np.arange(len(cube)), -(-len(cube) // 16)):
        lit = np.stack([bits[..., d // 32] >> np.uint32(d % 32) & np.uint32(1) for d in some], -1)
        L = np.broadcast_to(cube.directions[some], (*scene.shape, len(some), 3))
        for image, light in zip(images, shade(surface, greys, L, lit * cube.solid_angles[some])):
            image += light
    return [image.astype(np.float32) for image in images]


class _Shade:
    """Sums f B cos(theta_i) x weight over directions, for every node in its own frame."""

    def __init__(self, scene: Scene):
        self.tilts = tilts(scene).astype(float)
        self.frames = frames(*self.tilts)
        self.outgoing = self.frames @ [0.0, 0.0, -1.0]

    def __call__(self, surface: BRDF, greys: list, L: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
        """L (rows, cols, n, 3), weights (rows, cols, n) [sr] -> (rows, cols) for each grey source."""
        out = [np.zeros(L.shape[:2]) for _ in greys]
        rows, cols, n = weights.shape
        for some in np.array_split(np.arange(rows), -(-rows * cols * n // AT_ONCE)):
            incoming = np.einsum("rcij,rcnj->rcni", self.frames[some], L[some])
            cosine = np.maximum(0.0, incoming[..., 2])
            f = (
                surface.brdf(incoming, np.broadcast_to(self.outgoing[some, :, None], incoming.shape))
                * cosine
                * weights[some]
            )
            shows = f > 0
            for image, grey in zip(out, greys):
                light = np.zeros(f.shape)
                light[shows] = sources.radiance(grey, L[some][shows])
                image[some] = (f * light).sum(-1)
        return out


class _Rays:
    """Rays from the nodes of a scene."""

    def __init__(self, scene: Scene, engine: Backend, max_distance: float | None):
        self.scene = scene
        depth, step = scene.lattice()
        self.slices = Slices(engine, depth, step, scene.sides, Dome())
        self.slices.coarsen()
        self.reach = np.inf if max_distance is None else max_distance / scene.spacing

    def free(self, L: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Whether rays along L (rows, cols, n, 3) come to ``ends`` (rows, cols, n) [unit of spacing]: not
        nan, above the level, nothing in the way.
        """
        scene, (rows, cols) = self.scene, self.scene.shape
        depth = scene.depth.astype(float)[..., None] / scene.spacing
        ends = ends / scene.spacing
        flat = np.hypot(L[..., 0], L[..., 1])
        up = -L[..., 2]
        lit = (up >= 0) & ~np.isnan(ends) & scene.valid[..., None]
        with np.errstate(divide="ignore", invalid="ignore"):
            if (
                scene.sides == "dark"
            ):  # where the ray leaves the box through z = 0, or meets the source inside it
                to = np.fmin(ends, depth / up)
                y, x = np.mgrid[:rows, :cols]
                for axis, at, count in ((0, x, cols), (1, y, rows)):
                    place = at[..., None] + np.where(L[..., axis] == 0, 0.0, to * L[..., axis])
                    lit &= (place >= -0.5) & (place < count - 0.5)
            tangent = np.where(flat > up / STEEP, up / flat, STEEP)
            c, s = np.where(flat > 0, L[..., 0] / flat, 1.0), np.where(flat > 0, L[..., 1] / flat, 0.0)
        reach = np.where(
            lit, np.minimum(np.where(flat > 0, ends * np.maximum(flat, 1e-30), np.inf), self.reach), 1e-6
        )
        return lit & self.slices.rays(
            np.stack([c, s, tangent, np.minimum(reach, 1e30)], 2).astype(np.float32)
        )


def _places(scene: Scene) -> np.ndarray:
    y, x = np.mgrid[: scene.shape[0], : scene.shape[1]]
    return np.stack([x * scene.spacing, y * scene.spacing, scene.depth.astype(float)], -1)


def _meets(scene: Scene, source, L: np.ndarray) -> np.ndarray:
    """How far along L (rows, cols, n, 3) rays from the nodes meet the source [unit of spacing], inf for the
    sky, nan where they miss it.
    """
    if isinstance(source, sources.Sky):
        return np.full(L.shape[:-1], np.inf)
    origin = _places(scene)[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(source, sources.Lamp) and source.volume is not None:
            raise bad(
                "a mirror under a lamp given as a volume", "a lamp of any shape", "a sphere, or a rectangle"
            )
        if isinstance(source, sources.Lamp) and source.corner is None:
            to = np.array(source.center) - origin
            b, q = (to * L).sum(-1), (to * to).sum(-1) - source.radius**2
            root = b * b - q
            return np.where(q <= 0, 0.0, np.where((b > 0) & (root >= 0), b - np.sqrt(root), np.nan))
        if isinstance(source, sources.Lamp):
            corner, (u, v) = np.array(source.corner), map(np.array, source.edges)
            normal = np.cross(u, v)
            t = ((corner - origin) @ normal) / (L @ normal)
            past = origin + t[..., None] * L - corner
            inside = [(0 <= past @ edge) & (past @ edge < edge @ edge) for edge in (u, v)]
            return np.where(inside[0] & inside[1] & (t > 0), t, np.nan)
        t = origin[..., 2] / -L[..., 2]
        x, y = (origin[..., axis] + np.where(L[..., axis] == 0, 0.0, t * L[..., axis]) for axis in (0, 1))
        if source.aperture is None:
            through = (source.x[0] <= x) & (x < source.x[1]) & (source.y[0] <= y) & (y < source.y[1])
        else:
            col, row = (
                np.floor(np.nan_to_num(v / scene.spacing + 0.5, nan=-1, posinf=-1, neginf=-1)).astype(int)
                for v in (x, y)
            )
            rows, cols = scene.shape
            through = (0 <= col) & (col < cols) & (0 <= row) & (row < rows)
            through &= source.aperture[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
        return np.where(through & (L[..., 2] < 0), t, np.nan)


def _aim(scene: Scene, source, a: float, u: np.ndarray):
    """Rays to a lamp or window, one row of a square of them: L (rows, cols, n, 3), ends, weights [sr]."""
    origin = _places(scene)
    if isinstance(source, sources.Lamp) and source.corner is None:
        to = np.array(source.center) - origin
        far = np.linalg.norm(to, axis=-1, keepdims=True)
        inside = far[..., 0] <= source.radius
        axis = np.where(inside[..., None], [0.0, 0.0, -1.0], to / np.where(far > 0, far, 1.0))
        e = np.cross(axis, np.where(np.abs(axis[..., :1]) < 0.5, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
        e /= np.linalg.norm(e, axis=-1, keepdims=True)
        f = np.cross(axis, e)
        q = np.minimum(1.0, (source.radius / np.where(far > 0, far, 1.0)) ** 2)[..., 0]
        cap = np.where(inside, 1.0, q / (1 + np.sqrt(1 - q)))  # 1 - cos of the cone's half angle
        lost = (a * cap)[..., None, None]
        sine = np.sqrt(lost * (2 - lost))
        turn = 2 * np.pi * (u + a)[:, None]  # rings turned against each other
        L = (1 - lost) * axis[:, :, None] + sine * (
            np.cos(turn) * e[:, :, None] + np.sin(turn) * f[:, :, None]
        )
        return (
            L,
            _meets(scene, source, L),
            np.broadcast_to((2 * np.pi * cap / len(u) ** 2)[..., None], L.shape[:-1]),
        )
    if isinstance(source, sources.Window):
        (x0, x1), (y0, y1) = source.x, source.y
        if scene.sides == "dark":  # the walls hide the rest
            x0, x1 = np.clip((x0, x1), *(np.array([-0.5, scene.shape[1] - 0.5]) * scene.spacing))
            y0, y1 = np.clip((y0, y1), *(np.array([-0.5, scene.shape[0] - 0.5]) * scene.spacing))
        corner, edges = np.array([x0, y0, 0.0]), (np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0.0]))
    else:
        corner, edges = np.array(source.corner), tuple(map(np.array, source.edges))
    # With the foot of the perpendicular, d long, at (0, 0), domega = dphi dh for x = d tan(phi), y = h
    # sqrt(d^2 + x^2 + y^2): even steps of both are even steps of solid angle, and nothing is singular close
    # by.
    (width, ex), (length, ey) = ((np.linalg.norm(edge), edge / np.linalg.norm(edge)) for edge in edges)
    to, ez = corner - origin, np.cross(ex, ey)
    x, y, d = to @ ex, to @ ey, to @ ez
    near = np.where(d == 0, 1.0, np.abs(d))  # from its own plane it is a line
    first, last = np.arctan2(x, near), np.arctan2(x + width, near)
    x = (near * np.tan(first + a * (last - first)))[..., None]
    away = np.hypot(near[..., None], x)
    low, high = (end / np.hypot(away, end) for end in (y[..., None], y[..., None] + length))
    h = low + u * (high - low)
    y = h * away / np.sqrt(1 - h * h)
    far = np.hypot(away, y)
    L = (x[..., None] * ex + y[..., None] * ey + d[..., None, None] * ez) / far[..., None]
    return L, far, np.where(d == 0, 0.0, last - first)[..., None] * (high - low) / len(u) ** 2
