"""Light where nothing occludes the source: closed forms from the surface's normals, without any kernel."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from .. import sources
from ..arrays import by_bands, scratch
from ..samples import ring
from ..scene import Scene
from ..sources.integrals import Integrals, even
from ..sources.solids import Ball, Quad
from .base import HostImage

# normals along an axis of the table of a sky's light: a uniform sky's has an error of 2e-4 between them
# (step^2 / 8 x curvature), none at level ground
NORMALS_PER_AXIS = 65
LEAST_SQUARE = 1e-24  # [spacing^2] of a distance: a node in the plane of a source gets no light of it
INTEGRATED_AZIMUTHS = 96  # that tables are made of; chosen

Values = Any  # numbers or arrays that broadcast
Vector = tuple[Values, Values, Values]


class ClosedForm(HostImage):
    """An image in closed form, which has nothing to refine.

    ``units``: rays from every node along which a brightness that varies is taken, 0 of one that does not;
    ``coarse``: the same image by a quarter of these rays.
    """

    unit_name = "rays"

    def __init__(self, scene: Scene, image: np.ndarray, coarse: np.ndarray | None = None, units: int = 0):
        self.scene, self.image, self.units = scene, image, units
        if coarse is not None:
            self._half_difference = (image - coarse) / 2

    @property
    def amount(self) -> str:
        if self.units < 2:
            return "1 ray" if self.units else "a closed form"
        return super().amount

    def refine(self) -> None:
        """There is nothing finer."""


def gradients(scene: Scene, rows: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """d depth/dx and d depth/dy of some ``rows``, (n, cols) float32.

    Central differences, one-sided next to masked nodes and, unless the map repeats, at the border.
    """
    first, stop, _ = rows.indices(scene.shape[0])
    periodic = scene.sides == "periodic"
    if scene.mask is None and not periodic:
        above = min(first, 1)
        around = scene.depth[first - above : stop + 1] / np.float32(scene.spacing)
        across = [
            np.gradient(around, axis=a)[above : above + stop - first]
            if scene.shape[a] > 1
            else np.zeros((stop - first, scene.shape[1]), np.float32)
            for a in (1, 0)
        ]
        return across[0], across[1]
    at = np.arange(first - 1, stop + 1)
    around = scene.depth[at % scene.shape[0]] / np.float32(scene.spacing)
    if not periodic:
        around[(at < 0) | (at >= scene.shape[0])] = np.nan
    z, columns = around[1:-1], ((0, 0), (1, 1))
    wide = np.pad(z, columns, "wrap") if periodic else np.pad(z, columns, constant_values=np.nan)
    slopes = []
    for low, high in ((wide[:, :-2], wide[:, 2:]), (around[:-2], around[2:])):
        steps = np.maximum(1, np.isfinite(low).astype(np.float32) + np.isfinite(high))
        slopes.append(
            np.nan_to_num((np.where(np.isfinite(high), high, z) - np.where(np.isfinite(low), low, z)) / steps)
        )
    return slopes[0], slopes[1]


def by_normals(table: np.ndarray, azimuths: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """A sky's light by normal, (n, n) float32, n = NORMALS_PER_AXIS, where only the tangent plane and the
    level occlude.

    Row j, column i: the normal whose stereographic projection is 2 i / (n - 1) - 1 along x and so on, see the
    kernel ``correct``. ``table`` (azimuths, knots, 4) as sweeps take it, with the ``azimuths`` and
    ``widths`` of its sectors.
    """
    side = np.linspace(-1, 1, NORMALS_PER_AXIS)
    u, v = (a.ravel() for a in np.meshgrid(side, side))
    over = np.maximum(1.0, np.hypot(u, v) * 1.001)
    u, v = u / over, v / over
    scale = 2 / (1 - u * u - v * v)  # slope = tangent of twice the angle
    light = np.zeros(len(u))
    for some in np.array_split(np.arange(len(u)), 8):
        sx, sy = u[some] * scale[some], v[some] * scale[some]
        least = np.maximum(0, -(sx * np.cos(azimuths)[:, None] + sy * np.sin(azimuths)[:, None]))
        light[some] = widths @ ring(sx, sy, azimuths, least, table)
    return light.reshape(NORMALS_PER_AXIS, NORMALS_PER_AXIS).astype(np.float32)


def sky(scene: Scene, light: Integrals | float) -> np.ndarray:
    """Irradiance (rows, cols) float32 of a sky that the tangent plane and the level alone occlude.

    A number: pi B (1 + cos a) / 2. Else by :func:`by_normals`, bilinearly, and every small bright part as if
    it lay in one direction.
    """
    irradiance, table = scratch(scene.shape), np.zeros((0, 0))
    if isinstance(light, Integrals):
        sectors = even(INTEGRATED_AZIMUTHS, 0.5)
        table = by_normals(light.table(sectors.angles, sectors.widths), sectors.angles, sectors.widths)

    def band(rows: slice) -> None:
        gx, gy = gradients(scene, rows)
        if isinstance(light, Integrals):
            irradiance[rows] = _of_normals(gx, gy, table, light)
        else:
            irradiance[rows] = (1 + 1 / np.sqrt(1 + gx * gx + gy * gy)) * np.float32(np.pi / 2 * light)

    by_bands(band, scene.shape)
    return irradiance


def _of_normals(gx: np.ndarray, gy: np.ndarray, table: np.ndarray, light: Integrals) -> np.ndarray:
    """Irradiance of elements of these slopes, by a table of :func:`by_normals`, and by small bright parts."""
    up = 1 / np.sqrt(1 + gx * gx + gy * gy)
    at = [np.nan_to_num((g * up / (1 + up) + 1) * np.float32((NORMALS_PER_AXIS - 1) / 2)) for g in (gx, gy)]
    low = [np.minimum(a.astype(np.int32), NORMALS_PER_AXIS - 2) for a in at]
    p, q = (a - whole for a, whole in zip(at, low))
    i, j = low
    image: np.ndarray = (1 - q) * ((1 - p) * table[j, i] + p * table[j, i + 1]) + q * (
        (1 - p) * table[j + 1, i] + p * table[j + 1, i + 1]
    )
    for spot in light.bright_parts:
        x, y, z = spot.moment.astype(np.float32)
        image += np.maximum(0, gx * x + gy * y + z) * up
    return image


def faces(scene: Scene, places: np.ndarray, radius: float, rows: slice = slice(None)) -> bool:
    """Whether all ground of some ``rows`` faces balls of ``radius`` round ``places`` (n, 3) [spacings].

    Ground lies on the edges between neighbouring nodes, so each slope that it has at a node counts: a cliff
    is steeper than a central difference says. Where all rows face the balls, the ground occludes no part of
    them at any node: a ray to them would meet ground that turns away.
    """
    (left, right), (above, below) = _edge_slopes(scene, rows)
    deep = scene.depth[rows] / np.float32(scene.spacing)
    steepest = 1 + np.maximum(left * left, right * right) + np.maximum(above * above, below * below)
    least = np.float32(radius) * np.sqrt(steepest) if radius else 0
    across, down = (np.arange(n, dtype=np.float32) for n in scene.shape[::-1])

    def face(place: np.ndarray) -> bool:
        x, y, z = place[0] - across, place[1] - down[rows, None], place[2] + deep
        tilt = np.minimum(left * x, right * x) + np.minimum(above * y, below * y) + z
        return bool((tilt >= least).all())

    return all(map(face, np.asarray(places, np.float32)))


def _edge_slopes(scene: Scene, rows: slice) -> tuple[tuple[np.ndarray, ...], ...]:
    """d depth/dx to the left and to the right of nodes of some ``rows``, and d depth/dy above and below them,
    each (n, cols) float32; at a border that does not repeat, one of them twice. Of a map without a mask.
    """
    first, stop, _ = rows.indices(scene.shape[0])
    periodic = scene.sides == "periodic"
    at = np.arange(first - 1, stop + 1)
    around = scene.depth[at % scene.shape[0] if periodic else np.clip(at, 0, scene.shape[0] - 1)]
    around = around / np.float32(scene.spacing)
    wide = np.pad(around[1:-1], ((0, 0), (1, 1)), "wrap" if periodic else "edge")
    down, across = np.diff(around, axis=0), np.diff(wide, axis=1)
    if not periodic:
        if scene.shape[1] > 1:
            across[:, 0], across[:, -1] = across[:, 1], across[:, -2]
        if first == 0 and scene.shape[0] > 1:
            down[0] = down[1]
        if stop == scene.shape[0] and scene.shape[0] > 1:
            down[-1] = down[-2]
    return (across[:, :-1], across[:, 1:]), (down[:-1], down[1:])


def lamp(
    gx: Values,
    gy: Values,
    x: Values,
    y: Values,
    height: Values,
    solid: Ball | Quad,
    brightness: sources.Brightness,
    rays_per_node: int = 1,
) -> np.ndarray:
    """Irradiance of elements of slope (gx, gy) at (x, y, height) [spacings] under a ball or a quadrangle.

    The tangent planes of the elements alone occlude it; the level does not. A brightness that varies is taken
    along ``rays_per_node`` rays, 1 or a power of 4, each weighted by the light of its part of the source.
    Arrays that broadcast.
    """
    up = 1 / np.sqrt(1 + gx * gx + gy * gy)
    light: np.ndarray
    if isinstance(solid, Ball):
        center = np.array(solid.center, np.float32)
        to = _outside((center[0] - x, center[1] - y, center[2] - height), (gx * up, gy * up, up), solid)
        light, rays = _ball(gx, gy, to, up, solid), _rays_to_ball(solid, to, rays_per_node)
    else:
        light = _quadrangle(gx, gy, x, y, height, up, solid)
        rays = _rays_to_quadrangle(solid, x, y, height, rays_per_node)
    if not callable(brightness):
        assert not isinstance(brightness, tuple), "channels are rendered one by one"
        return (light * float(brightness)).astype(np.float32)
    total: Values = 0.0
    whole: Values = 1e-30
    for way, weight in rays:
        size = np.sqrt(np.maximum(way[0] ** 2 + way[1] ** 2 + way[2] ** 2, LEAST_SQUARE))
        if rays_per_node > 1:
            weight = weight * np.maximum(0, (way[0] * gx + way[1] * gy + way[2]) / size)
        direction = np.stack(
            np.broadcast_arrays(way[0] / size, way[1] / size, np.minimum(-way[2] / size, 0)), -1
        )
        total = total + weight * sources.radiance(sources.Sky(brightness), direction)
        whole = whole + weight
    image: np.ndarray = (light * (total / whole)).astype(np.float32)
    return image


def _outside(to: Vector, normal: Vector, ball: Ball) -> Vector:
    """``to``, the vectors to a ball's centre; for nodes within it one along their normals, since a ball that
    such a node touches from below fills its hemisphere too.
    """
    radius = np.float32(ball.radius)
    within = to[0] ** 2 + to[1] ** 2 + to[2] ** 2 < radius * radius
    if not np.any(within):
        return to
    x, y, z = (np.where(within, radius * own, other) for own, other in zip(normal, to))
    return x, y, z


def _ball(gx: Values, gy: Values, to: Vector, up: Values, ball: Ball) -> np.ndarray:
    """Irradiance by a ball of brightness 1, ``to`` the vectors to its centre; ``up`` the normals' z.

    pi (R / d)^2 cos where it lies wholly above the plane, else the closed form of the part above it (Howell,
    Menguc, Daun and Siegel 2020, factor B-43).
    """
    far = np.sqrt(to[0] ** 2 + to[1] ** 2 + to[2] ** 2)
    cosine = (to[0] * gx + to[1] * gy + to[2]) * up / far
    ratio = np.float32(ball.radius) / far
    light: np.ndarray = np.pi * ratio**2 * cosine
    cut = np.flatnonzero((np.abs(cosine) < ratio).ravel())
    light = np.where(cosine < 0, 0, light)
    if not cut.size:
        return light
    c, r = (np.broadcast_to(v, light.shape).ravel()[cut].astype(float) for v in (cosine, ratio))
    h, sine = 1 / r, np.sqrt(np.maximum(1 - c * c, 1e-12))
    root = np.sqrt(np.maximum(h * h - 1, 0))
    part = (
        0.5
        - np.arcsin(np.clip(root / (h * sine), -1, 1)) / np.pi
        + (c * np.arccos(np.clip(-root * c / sine, -1, 1)) - root * np.sqrt(np.maximum(0, 1 - (h * c) ** 2)))
        / (np.pi * h * h)
    )
    light = light.ravel()
    light[cut] = np.pi * np.maximum(part, 0)
    return light.reshape(far.shape)


def _quadrangle(
    gx: Values, gy: Values, x: Values, y: Values, height: Values, up: Values, quad: Quad
) -> np.ndarray:
    """Irradiance by a quadrangle of brightness 1, ``up`` the normals' z: Lambert's polygon."""
    light = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y), np.shape(height)), np.float32)
    # in units of the farthest corner, a power of two, so that squares of areas stay in float32
    unit = np.float32(2.0 ** -np.frexp(np.abs(quad.corners).max())[1])
    corners, x, y, height = np.asarray(quad.corners, np.float32) * unit, x * unit, y * unit, height * unit
    rays = [(c[0] - x, c[1] - y, c[2] - height) for c in corners]
    for a, b in zip(rays, rays[1:] + rays[:1]):
        light += _of_edge(a, b, (gx, gy, 1))
    whole: np.ndarray = np.abs(light) * (up / 2)
    above = [a[0] * gx + a[1] * gy + a[2] for a in rays]
    cut = np.flatnonzero((np.minimum.reduce(above) < 0).ravel())
    if cut.size:
        shape = whole.shape
        ends = [[np.broadcast_to(v, shape).ravel()[cut].astype(float) for v in ray] for ray in rays]
        normal = [np.broadcast_to(v, shape).ravel()[cut].astype(float) for v in (gx, gy, 1.0)]
        part = np.abs(_clipped(np.array(ends), np.array(normal)))
        flat = whole.ravel()
        flat[cut] = part * np.broadcast_to(up, shape).ravel()[cut] / 2
        whole = flat.reshape(shape)
    return whole


def _of_edge(a: Any, b: Any, normal: Any) -> Values:
    """A polygon's edge from a to b in Lambert's sum: twice the irradiance, times the length of ``normal``."""
    edge = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    size = np.sqrt(edge[0] ** 2 + edge[1] ** 2 + edge[2] ** 2)
    angle = np.arctan2(size, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
    light: Values = (
        angle / np.maximum(size, 1e-30) * (edge[0] * normal[0] + edge[1] * normal[1] + edge[2] * normal[2])
    )
    return light


def _clipped(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Lambert's sum (nodes,) over the part of quadrangles (4, 3, nodes) above planes through the origin.

    A convex polygon enters and leaves the half-space once; the edge between these places lies in the plane.
    """
    high = (corners * normal).sum(1)
    light = np.zeros(corners.shape[2])
    enters, leaves = np.zeros((2, 3, corners.shape[2]))
    for i in range(4):
        (a, b), (low, up) = corners[[i, (i + 1) % 4]], high[[i, (i + 1) % 4]]
        crosses = (low < 0) != (up < 0)
        meets = a + (b - a) * np.where(crosses, low / np.where(crosses, low - up, 1), 0)
        first, last = np.where(low < 0, meets, a), np.where(up < 0, meets, b)
        light += np.where((low < 0) & (up < 0), 0, _of_edge(first, last, normal))
        enters, leaves = (
            np.where(crosses & (low < 0), meets, enters),
            np.where(crosses & (up < 0), meets, leaves),
        )
    light += _of_edge(leaves, enters, normal)
    return light


def _rays_to_quadrangle(
    quad: Quad, x: Values, y: Values, height: Values, count: int
) -> Iterator[tuple[Vector, Values]]:
    """``count`` vectors to parts of a quadrangle from (x, y, height), and a weight for each."""
    corners = np.asarray(quad.corners, np.float32)
    edges = corners[1] - corners[0], corners[3] - corners[0]
    long, wide = (float(np.linalg.norm(edge)) for edge in edges)
    # cells as square as can be
    halvings = round(math.log2(count) / 2 + math.log2(max(long, 1e-30) / max(wide, 1e-30)) / 2)
    along = int(np.clip(2**halvings, 1, count))
    normal = np.cross(*edges)
    for u, u_weight in _gauss(along):
        for v, v_weight in _gauss(count // along):
            dx, dy, dz = (
                corners[0][n] + u * edges[0][n] + v * edges[1][n] - at for n, at in enumerate((x, y, height))
            )
            yield (
                (dx, dy, dz),
                np.float32(u_weight * v_weight)
                * np.abs(dx * normal[0] + dy * normal[1] + dz * normal[2])
                / np.maximum(dx**2 + dy**2 + dz**2, LEAST_SQUARE) ** 1.5,
            )


def _gauss(count: int) -> Iterator[tuple[np.float32, float]]:
    """Places from 0 to 1, and weights, of a Gauss-Legendre rule.

    Under a panel of one spacing, three above level ground, whose brightness is cos^20, an image by 16 rays
    has an RMS error of 4e-6; by rays to the middles of equal parts 6e-3, and 4e-4 by 256. Across an edge of
    brightness neither is better.
    """
    places, weights = np.polynomial.legendre.leggauss(count)
    return zip(((places + 1) / 2).astype(np.float32), (weights / 2).tolist())


def _rays_to_ball(ball: Ball, to: Vector, count: int) -> Iterator[tuple[Vector, Values]]:
    """The same to parts of a ball, ``to`` the vectors to its centre."""
    if count == 1:
        yield to, 1.0
        return
    flat, far = np.sqrt(to[0] ** 2 + to[1] ** 2), np.sqrt(to[0] ** 2 + to[1] ** 2 + to[2] ** 2)
    c, s, rise = to[0] / np.maximum(flat, 1e-9), to[1] / np.maximum(flat, 1e-9), -to[2] / far
    rings = max(1, round(math.sqrt(count) / 2))
    for number, (area, weight) in enumerate(_gauss(rings)):
        # sine of the angle from the middle, of a share of the disc's area
        out = np.minimum(np.sqrt(area) * np.float32(ball.radius) / far, 0.99)
        secant = 1 / np.sqrt(1 - out * out)
        tangent = out * secant * far
        for n in range(count // rings):
            angle = 2 * math.pi * (n + 0.5 * (number % 2)) / (count // rings)
            across, up = math.cos(angle), math.sin(angle)
            yield (
                (
                    to[0] + tangent * (-across * s + up * c * rise),
                    to[1] + tangent * (across * c + up * s * rise),
                    to[2] + tangent * up * flat / far,
                ),
                np.float32(weight) * secant,
            )


def image(
    scene: Scene, solid: Ball | Quad, brightness: sources.Brightness, rays_per_node: int = 1
) -> np.ndarray:
    """(rows, cols) float32, see :func:`lamp`; lengths of ``solid`` in spacings, heights third."""
    x, y = (np.arange(n, dtype=np.float32) for n in scene.shape[::-1])
    irradiance = scratch(scene.shape)

    def band(rows: slice) -> None:
        gx, gy = gradients(scene, rows)
        # a brightness function is given no NaN
        depth = scene.depth[rows] if scene.mask is None else np.nan_to_num(scene.depth[rows])
        height = depth / np.float32(-scene.spacing)
        irradiance[rows] = lamp(gx, gy, x, y[rows, None], height, solid, brightness, rays_per_node)

    if callable(brightness):  # the user's, which may not be called by several threads
        band(slice(None))
    else:
        by_bands(band, scene.shape)
    return irradiance
