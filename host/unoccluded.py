"""Light where nothing hides the source: closed forms from the surface's normals, without any kernel."""

from __future__ import annotations

import numpy as np

from . import sources
from .backends.slices import Ball, Quad
from .pilots import ring
from .scene import Scene

ACROSS = 65  # normals along an axis of the table of a sky's light
AZIMUTHS = 96
SHADE, STEPS = 0.02, 0.06  # share of nodes that may lie in shadow; steps a node that shadows are followed in all
ABOVE = 2.0  # spacings by which ground does for sure, since it is looked up at the nearest nodes


def gradients(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """d depth/dx and d depth/dy (rows, cols) float32: central differences, one-sided at the border and beside masked nodes."""
    z = scene.depth / np.float32(scene.spacing)
    if scene.mask is None:
        across = [np.gradient(z, axis=a) if z.shape[a] > 1 else np.zeros_like(z) for a in (1, 0)]
        return across[0], across[1]
    found = []
    for axis in (1, 0):
        room = np.pad(z, [(int(a == axis),) * 2 for a in (0, 1)], constant_values=np.nan)
        low, high = (np.take(room, np.arange(n, n + z.shape[axis]), axis) for n in (0, 2))
        steps = np.maximum(1, np.isfinite(low).astype(np.float32) + np.isfinite(high))
        found.append(np.nan_to_num((np.where(np.isfinite(high), high, z) - np.where(np.isfinite(low), low, z)) / steps))
    return found[0], found[1]


def sky(scene: Scene, brightness, table: np.ndarray | None = None, azimuths: np.ndarray | None = None, widths: np.ndarray | None = None, first: float = 0.0, last: float = 1.0) -> np.ndarray:
    """Irradiance (rows, cols) float32 of a sky of which the tangent plane and the level alone hide a part.

    A number: pi B (1 + cos a) / 2. Else by ``table`` (azimuths, knots, >= 2) from the sine ``first`` of elevation to ``last``, as
    from sources.elevation_table, for some thousand normals over the stereographic plane, and bilinearly between them.
    """
    gx, gy = gradients(scene)
    up = 1 / np.sqrt(1 + gx * gx + gy * gy)
    if table is None:
        return (1 + up) * np.float32(np.pi / 2 * brightness)
    side = np.linspace(-1, 1, ACROSS)
    u, v = (a.ravel() for a in np.meshgrid(side, side))
    over = np.maximum(1.0, np.hypot(u, v) * 1.001)
    u, v = u / over, v / over
    scale = 2 / (1 - u * u - v * v)  # slope = tangent of twice the angle
    light = np.zeros(len(u))
    for some in np.array_split(np.arange(len(u)), 8):
        sx, sy = u[some] * scale[some], v[some] * scale[some]
        least = np.maximum(0, -(sx * np.cos(azimuths)[:, None] + sy * np.sin(azimuths)[:, None]))
        light[some] = widths @ ring(sx, sy, azimuths, least, table, first, last)
    light = light.reshape(ACROSS, ACROSS).astype(np.float32)
    at = [(g * up / (1 + up) + 1) * np.float32((ACROSS - 1) / 2) for g in (gx, gy)]
    low = [np.minimum(a.astype(np.int32), ACROSS - 2) for a in at]
    p, q = (a - l for a, l in zip(at, low))
    i, j = low
    return (1 - q) * ((1 - p) * light[j, i] + p * light[j, i + 1]) + q * ((1 - p) * light[j + 1, i] + p * light[j + 1, i + 1])


def lamp(gx, gy, x, y, height, solid: Ball | Quad, brightness, points: int = 1) -> np.ndarray:
    """Irradiance of elements of slope (gx, gy) at (x, y, height) [spacings] under a ball or a quadrangle that nothing hides but their tangent plane.

    A ball: pi B (R / d)^2 cos where it stands wholly above the plane, and the closed form of the part above it (Howell, Menguc,
    Daun and Siegel 2020, factor B-43). A quadrangle: Lambert's polygon, none where it turns negative. A brightness that
    varies is taken along the ray to the source's middle, or with ``points`` 4 along four rays to it, each weighed by the light that
    it would bring (a rule of degree three). Arrays that broadcast; the level hides nothing.
    """
    middle = np.array(solid.center if isinstance(solid, Ball) else np.asarray(solid.corners).mean(0), np.float32)
    to = middle[0] - x, middle[1] - y, middle[2] - height
    up = 1 / np.sqrt(1 + gx * gx + gy * gy)
    square = to[0] ** 2 + to[1] ** 2 + to[2] ** 2
    far = np.sqrt(square)
    if isinstance(solid, Ball):
        cosine = (to[0] * gx + to[1] * gy + to[2]) * up / far
        ratio = np.float32(solid.radius) / far
        light = np.pi * ratio**2 * cosine
        cut = np.flatnonzero((np.abs(cosine) < ratio).ravel())
        light = np.where(cosine < 0, 0, light)
        if cut.size:
            c, r = (np.broadcast_to(v, light.shape).ravel()[cut].astype(float) for v in (cosine, ratio))
            h, sine = 1 / r, np.sqrt(np.maximum(1 - c * c, 1e-12))
            root = np.sqrt(np.maximum(h * h - 1, 0))
            part = 0.5 - np.arcsin(np.clip(root / (h * sine), -1, 1)) / np.pi + (c * np.arccos(np.clip(-root * c / sine, -1, 1)) - root * np.sqrt(np.maximum(0, 1 - (h * c) ** 2))) / (np.pi * h * h)
            light = light.ravel()
            light[cut] = np.pi * np.maximum(part, 0)
            light = light.reshape(far.shape)
    else:
        light = np.zeros(np.shape(far), np.float32)
        corners = np.asarray(solid.corners, np.float32)
        rays = [(c[0] - x, c[1] - y, c[2] - height) for c in corners]
        for a, b in zip(rays, rays[1:] + rays[:1]):
            edge = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            size = np.sqrt(edge[0] ** 2 + edge[1] ** 2 + edge[2] ** 2)
            angle = np.arctan2(size, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
            light += angle / np.maximum(size, 1e-30) * (edge[0] * gx + edge[1] * gy + edge[2])
        light = np.abs(light) * (up / 2)
    if callable(brightness):
        along = lambda way, size: sources.radiance(sources.Sky(brightness), np.stack(np.broadcast_arrays(way[0] / size, way[1] / size, np.minimum(-way[2] / size, 0)), -1))
        if points == 1:
            return (light * along(to, far)).astype(np.float32)
        total, whole = 0.0, 1e-30
        for way, weight in _four(solid, to, x, y, height):
            size = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
            weight = weight * np.maximum(0, (way[0] * gx + way[1] * gy + way[2]) / size)
            total, whole = total + weight * along(way, size), whole + weight
        return (light * (total / whole)).astype(np.float32)
    return (light * float(brightness)).astype(np.float32)


def _four(solid, to, x, y, height):
    """Four vectors to a source from (x, y, height), ``to`` that to its middle, and a weight for each."""
    if isinstance(solid, Quad):
        corners = np.asarray(solid.corners, np.float32)
        middle = corners.mean(0)
        normal = np.cross(corners[2] - corners[0], corners[3] - corners[1])
        for corner in middle + (corners - middle) / np.sqrt(np.float32(3)):
            way = corner[0] - x, corner[1] - y, corner[2] - height
            yield way, np.abs(way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2]) / (way[0] ** 2 + way[1] ** 2 + way[2] ** 2) ** 1.5
        return
    flat, far = np.sqrt(to[0] ** 2 + to[1] ** 2), np.sqrt(to[0] ** 2 + to[1] ** 2 + to[2] ** 2)
    c, s = to[0] / np.maximum(flat, 1e-9), to[1] / np.maximum(flat, 1e-9)
    out = np.minimum(np.float32(0.7071) * solid.radius / far, 0.99)  # sine of the angle from the middle, half of the disc's area within
    secant = 1 / np.sqrt(1 - out * out)
    for across, up in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        tangent = out * secant * far
        rise = -to[2] / far
        yield (to[0] + tangent * (-across * s + up * c * rise), to[1] + tangent * (across * c + up * s * rise), to[2] + tangent * up * flat / far), secant


def image(scene: Scene, solid: Ball | Quad, brightness, points: int = 1) -> np.ndarray:
    """(rows, cols) float32, see :func:`lamp`; lengths of ``solid`` in spacings, heights third."""
    gx, gy = gradients(scene)
    rows, cols = scene.shape
    x, y = np.arange(cols, dtype=np.float32), np.arange(rows, dtype=np.float32)[:, None]
    depth = scene.depth if scene.mask is None else np.nan_to_num(scene.depth)  # a brightness function is given no NaN
    return lamp(gx, gy, x, y, depth / np.float32(-scene.spacing), solid, brightness, points)


def shaded(scene: Scene, center: np.ndarray, radius: float, convex: bool) -> np.ndarray | None:
    """Nodes (2, count), row and column, from which ground may hide some of a ball round ``center`` [spacings, height third], by the
    normals of all nodes; None where these are many, or it would take long to find them.

    Ground that looks at all of the ball along a vertical plane through it never rises into a ray, so that only where some does not
    may a shadow begin: it is followed from the node before, away from the source, until ground rises above the ball's lowest ray (what is
    dark beyond has a crest of its own), and is widened by a node, since grid lines cross between nodes. Nothing is followed where the
    ground is ``convex`` as far as the caller knows, and nothing behind, away from the source, looks at the ball again.
    """
    gx, gy = gradients(scene)
    rows, cols = scene.shape
    x, y = np.float32(center[0]) - np.arange(cols, dtype=np.float32), (np.float32(center[1]) - np.arange(rows, dtype=np.float32))[:, None]
    up = np.float32(center[2]) + scene.depth / np.float32(scene.spacing)
    looks = x * gx + y * gy + up >= np.float32(radius) * np.sqrt(1 + gx * gx + gy * gy)
    if scene.mask is not None:
        looks |= ~scene.mask
    if looks.all() and scene.mask is None:
        return np.zeros((2, 0), int)
    left = STEPS * looks.size
    away = np.stack(np.divmod(np.flatnonzero(~looks), cols))
    if not convex and away.shape[1] > left:
        return None

    def behind(at, n):
        """The nodes so far from others, away from the source, which ones lie on the map, and the way towards the source."""
        way = np.stack([y[at[0], 0], x[at[1]]]) / np.maximum(np.hypot(x[at[1]], y[at[0], 0]), 1e-9)
        to = np.rint(at - n * way).astype(int)
        return to, (to >= 0).all(0) & (to[0] < rows) & (to[1] < cols), way

    to, there, _ = behind(away, 1)
    if convex and not looks[tuple(to[:, there])].any():
        return np.zeros((2, 0), int)
    crest = np.zeros((rows, cols), bool)  # nodes before one of these, towards the source, along a row, a column or both
    before = np.sign(np.stack([y[away[0], 0], x[away[1]]])).astype(int)
    for share in ((1, 1), (1, 0), (0, 1)):
        crest[tuple(np.clip(away + np.array(share)[:, None] * before, 0, [[rows - 1], [cols - 1]]))] = True
    crest &= looks
    if scene.mask is not None:  # ground may fall off into a hole, unseen
        crest |= _widened(~scene.mask)
        crest &= scene.mask
    crest = np.stack(np.divmod(np.flatnonzero(crest), cols))
    found, deepest = [away], np.fmax.reduce(up, axis=None)
    for n in range(1, rows + cols):
        at, there, way = behind(crest, n)
        crest, at, way = crest[:, there], at[:, there], way[:, there]
        left -= at.shape[1]
        if left < 0:
            return None
        own, here, at = up[tuple(crest)], up[tuple(at)], tuple(at)
        far = np.sqrt(x[at[1]] ** 2 + y[at[0], 0] ** 2 + here**2)
        ray = np.tan(np.maximum(np.arcsin(np.minimum(1, here / far)) - np.arcsin(np.minimum(1, np.float32(radius) / far)), 0))
        plane = -(gy[at] * way[0] + gx[at] * way[1])
        below = here - own
        found.append(np.stack(at)[:, below > n * np.maximum(ray, plane)])
        crest = crest[:, ~(below < n * ray - ABOVE) & (own + n * ray < deepest)]  # goes on where masked
        if not crest.size:
            break
    dark = np.zeros((rows, cols), bool)
    dark[tuple(np.concatenate(found, 1))] = True
    dark = _widened(dark) if scene.mask is None else _widened(dark) & scene.mask
    found = np.stack(np.divmod(np.flatnonzero(dark), cols))
    return found if found.shape[1] <= SHADE * looks.size else None


def _widened(nodes):
    """These (rows, cols) bool and those round them."""
    room = np.pad(nodes, 1)
    room = room[:-2] | room[1:-1] | room[2:]
    return room[:, :-2] | room[:, 1:-1] | room[:, 2:]
