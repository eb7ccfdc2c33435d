"""The oracle: the paper's two algorithms, step by step, in NumPy and float64. It is slow on purpose.

Nothing here shares code with the backends; it is tested against closed forms (tests/test_oracle.py), and the
kernels are tested against it. Depth is in whole layers n (masked nodes: -1 in ``surface``, and free space all
the way down), but for horizons and shadow rays, where it is a length (tests/test_oracle_horizons.py). The
step numbers (1) to (4) are those of the forward and inverse algorithms in Langer and Zucker, section 6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from .constants import APERTURE, BALL, RECTANGLE, SKY, VOLUME
from .sources import Geometry

Node = tuple[Sequence[int] | np.ndarray, Sequence[int] | np.ndarray]  # row indices, column indices
Vector = tuple[float, float, float]
Aim = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]

FAR = np.iinfo(np.int64).max // 4  # depth of a masked column: free space without end


def gradient(
    depth: np.ndarray, spacing: float, valid: np.ndarray, sides: str = "open"
) -> tuple[np.ndarray, np.ndarray]:
    """dz/dx and dz/dy at the nodes: central differences.

    They are one-sided beside masked nodes and at the border, but go round the border of a map that repeats.
    """

    def along_columns(z: np.ndarray, ok: np.ndarray) -> np.ndarray:
        out = np.zeros(z.shape)
        for row in range(z.shape[0]):
            for col in range(z.shape[1]):
                left, right = col - 1, col + 1  # may lie off the map
                if sides != "periodic":
                    left, right = max(left, 0), min(right, z.shape[1] - 1)
                left = left if ok[row, left % z.shape[1]] else col
                right = right if ok[row, right % z.shape[1]] else col
                if right > left and ok[row, col]:
                    rise = z[row, right % z.shape[1]] - z[row, left % z.shape[1]]
                    out[row, col] = rise / ((right - left) * spacing)
        return out

    z = np.where(valid, depth, 0.0).astype(float)
    return along_columns(z, valid), along_columns(z.T, valid.T).T


def normals(depth: np.ndarray, spacing: float, valid: np.ndarray, sides: str = "open") -> np.ndarray:
    """Unit normals (rows, cols, 3) = (dz/dx, dz/dy, -1) / |.|, towards the viewer's side."""
    gx, gy = gradient(depth, spacing, valid, sides)
    normal = np.stack([gx, gy, -np.ones_like(gx)], -1)
    unit: np.ndarray = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return unit


def meets_source(
    x: np.ndarray,
    y: np.ndarray,
    n: np.ndarray,
    step: Sequence[int] | np.ndarray,
    shape: tuple[int, int],
    sides: str,
    source: Geometry,
) -> np.ndarray:
    """Whether rays from nodes (x, y, n) that leave the volume along ``step`` unblocked meet the source.

    x, y, n: integer arrays; step (i, j, -k). The crossing with z = 0 is compared multiplied out by k, never
    divided.
    """
    i, j, k = int(step[0]), int(step[1]), -int(step[2])
    rows, cols = shape
    if source.kind == VOLUME:
        return np.zeros(x.shape, bool)
    if source.kind == BALL:
        return _hits_ball(x, y, n, (i, j, -k), source.numbers, math.inf, shape, sides)
    if k == 0:
        return np.full(x.shape, source.kind == SKY and sides != "dark")
    u, v = x * k + i * n, y * k + j * n
    lit = np.ones(x.shape, bool)
    if sides == "dark":
        lit &= (-k <= 2 * u) & (2 * u < (2 * cols - 1) * k) & (-k <= 2 * v) & (2 * v < (2 * rows - 1) * k)
    if source.kind == RECTANGLE:
        x0, x1, y0, y1 = source.numbers
        for w, low, high, period in ((u, x0, x1, cols), (v, y0, y1, rows)):
            if sides == "periodic":
                lit &= np.mod(w - k * low, period * k) < k * (high - low)
            else:
                lit &= (k * low <= w) & (w < k * high)
    if source.kind == APERTURE:
        col, row = (2 * u + k) // (2 * k), (2 * v + k) // (2 * k)
        if sides == "periodic":
            col, row = col % cols, row % rows
        inside = (0 <= col) & (col < cols) & (0 <= row) & (row < rows)
        lit &= inside & (source.flags[0][np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)] != 0)
    return lit


def _hits_ball(
    x: np.ndarray,
    y: np.ndarray,
    n: np.ndarray,
    step: Sequence[int],
    ball: np.ndarray,
    longest: float,
    shape: tuple[int, int],
    sides: str,
) -> np.ndarray:
    """Whether x + t step, 0 < t <= longest, meets the closed ball (before a wall, with dark sides)."""
    rows, cols = shape
    way = np.asarray(step, float)
    to = [c - p for c, p in zip(ball[:3], (x, y, n))]
    a = way @ way
    b = to[0] * way[0] + to[1] * way[1] + to[2] * way[2]
    q = to[0] ** 2 + to[1] ** 2 + to[2] ** 2 - ball[3] ** 2
    root = b * b - a * q
    hit: np.ndarray = (q <= 0) | ((b > 0) & (root >= 0))
    t = np.where(q <= 0, 0.0, (b - np.sqrt(np.maximum(root, 0))) / a)
    hit &= t <= longest
    if sides == "dark":
        k = -int(step[2])
        over = n <= t * k  # the ray crosses z = 0 before it meets the ball
        u, v = x * k + int(step[0]) * n, y * k + int(step[1]) * n
        through = (-k <= 2 * u) & (2 * u < (2 * cols - 1) * k) & (-k <= 2 * v) & (2 * v < (2 * rows - 1) * k)
        px, py = x + t * way[0], y + t * way[1]
        inside = (px >= -0.5) & (px < cols - 0.5) & (py >= -0.5) & (py < rows - 0.5)
        hit &= np.where(over & (k > 0), through, inside)
    return hit


def propagate(
    surface: np.ndarray,
    steps: np.ndarray,
    sides: str,
    source: Geometry,
    layers: int,
    free: Callable[[int], np.ndarray] | None = None,
) -> Iterator[tuple[int, np.ndarray]]:
    """The forward algorithm: yields (n, V), V (D, rows, cols) bool the visibility field, n = 0 .. layers - 1.

    ``surface``: (rows, cols) int, the depth z in layers, -1 where masked. ``free(n)`` replaces the test n <=
    z for carving, where free space F* grows while the layers go down; it is asked once per layer, in order.
    """
    rows, cols = surface.shape
    bottom = np.where(surface < 0, FAR, surface)
    free = free or (lambda n: n <= bottom)
    y, x = np.mgrid[:rows, :cols]
    kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    reach = int(np.abs(steps).max())
    for n in range(layers):  # (1) n := 0; repeat
        in_free = free(n)
        shining = np.zeros((rows, cols), bool)
        if source.kind == VOLUME and n < len(source.flags):
            shining = (source.flags[n] != 0) & in_free
        visible = np.zeros((len(steps), rows, cols), bool)
        here = x, y, np.full_like(x, n)
        for d, (i, j, up) in enumerate(steps):  # (2) for all L in H*
            i, j, k = int(i), int(j), -int(up)
            leaving = meets_source(*here, (i, j, -k), surface.shape, sides, source)
            near = np.zeros_like(leaving)
            if source.kind == BALL:
                near = _hits_ball(*here, (i, j, -k), source.numbers, 1.0, surface.shape, sides)
            if n - k < 0:  # the ray leaves through z < 0
                visible[d] = leaving
            elif k > 0:
                above_free, above = kept[n - k]
                visible[d] = _shifted(above[d] & above_free, i, j, sides, leaving)
            else:
                visible[d] = _in_layer(in_free, shining, near, i, j, sides, leaving, source)
            visible[d] |= near
        visible |= shining
        visible &= in_free  # (3) L in V(x) only for x in F
        kept[n] = (in_free, visible)
        kept.pop(n - reach, None)
        yield n, visible  # (4) n := n + 1


def _shifted(values: np.ndarray, i: int, j: int, sides: str, leaving: np.ndarray) -> np.ndarray:
    """values at x + l, or the value for a ray that leaves sideways."""
    rows, cols = values.shape
    y, x = np.mgrid[:rows, :cols]
    if sides == "periodic":
        return np.asarray(values[(y + j) % rows, (x + i) % cols])
    inside = (0 <= x + i) & (x + i < cols) & (0 <= y + j) & (y + j < rows)
    outside = leaving if sides == "open" else np.zeros_like(leaving)
    return np.where(inside, values[np.clip(y + j, 0, rows - 1), np.clip(x + i, 0, cols - 1)], outside)


def _in_layer(
    in_free: np.ndarray,
    shining: np.ndarray,
    near: np.ndarray,
    i: int,
    j: int,
    sides: str,
    leaving: np.ndarray,
    source: Geometry,
) -> np.ndarray:
    """k = 0: V(x) needs V(x + l) of the same layer, so nodes are taken in order from the source's side."""
    rows, cols = in_free.shape
    # lists, whose elements Python reads several times as fast as an array's
    free, shines, meets, leaves = (flags.tolist() for flags in (in_free, shining, near, leaving))
    lit = [[False] * cols for _ in range(rows)]
    if sides == "periodic":
        for row in range(rows):
            for col in range(cols):
                if not free[row][col]:
                    continue
                r, c = (row + j) % rows, (col + i) % cols
                while True:
                    if shines[r][c]:
                        lit[row][col] = True
                        break
                    if not free[r][c]:
                        break
                    if (r, c) == (row, col):  # once round: nothing in the way, and a sky all around
                        lit[row][col] = source.kind == SKY
                        break
                    r, c = (r + j) % rows, (c + i) % cols
        return np.array(lit)
    for row in range(rows)[:: -1 if j > 0 else 1]:
        for col in range(cols)[:: -1 if i > 0 else 1]:
            r, c = row + j, col + i
            if 0 <= r < rows and 0 <= c < cols:
                there = free[r][c] and lit[r][c] or shines[r][c]
            else:
                there = sides == "open" and leaves[row][col]
            lit[row][col] = free[row][col] and (there or meets[row][col])
    return np.array(lit)


def surface_visibility(surface: np.ndarray, steps: np.ndarray, sides: str, source: Geometry) -> np.ndarray:
    """V(x) at the surface's own nodes, (rows, cols, D) bool, by propagation down to the deepest of them."""
    out = np.zeros((*surface.shape, len(steps)), bool)
    for n, visible in propagate(surface, steps, sides, source, int(surface.max()) + 1):
        here = surface == n
        out[here] = visible[:, here].T
    return out


def filled_visibility(depth: np.ndarray, spacing: float, steps: np.ndarray, sides: str) -> np.ndarray:
    """Surface visibility under a sky by brute force, every crossing with a grid line: (rows, cols, D) bool.

    Along each direction every crossing of the ray's vertical plane with a row or a column is compared, until
    the map ends; heights between nodes are linear. Multiplied out, so that whole numbers are compared
    exactly.
    """
    rows, cols = depth.shape
    out = np.zeros((rows, cols, len(steps)), bool)
    y, x = np.mgrid[:rows, :cols]
    finite = np.isfinite(depth)
    relief = float(depth[finite].max())
    for d, (i, j, up) in enumerate(steps):
        i, j, k = int(i), int(j), -int(up)
        lit = finite.copy()
        crossings = {(a, abs(i)) for a in range(1, abs(i) + 1)} | {(b, abs(j)) for b in range(1, abs(j) + 1)}
        laps = max(rows, cols)
        if sides == "periodic":
            laps = math.lcm(cols // math.gcd(cols, i or cols), rows // math.gcd(rows, j or rows))
        if k:
            laps = min(laps, int(relief / (k * spacing)) + 2)
        for t in range(laps if (i or j) else 0):
            for a, q in crossings:  # at t + a / q steps; q x and q y are whole numbers there
                u, v = q * (x + t * i) + a * i, q * (y + t * j) + a * j
                c, fu = u // q, u % q
                r, fv = v // q, v % q
                on_column = bool((fu == 0).all())  # else the crossing lies on a row
                c2, r2 = (c, r + (fv > 0)) if on_column else (c + (fu > 0), r)
                weight = fv if on_column else fu
                if not (on_column or (fv == 0).all()):
                    raise AssertionError("a crossing lies on a row or on a column")
                if sides == "periodic":
                    c, r, c2, r2 = c % cols, r % rows, c2 % cols, r2 % rows
                inside = (c >= 0) & (c2 < cols) & (r >= 0) & (r2 < rows)
                near, after = (depth[row % rows, col % cols].astype(float) for row, col in ((r, c), (r2, c2)))
                far = np.where(weight == 0, near, after)
                known = inside & np.isfinite(near) & np.isfinite(far)
                ground = (q - weight) * np.where(known, near, 0) + weight * np.where(known, far, 0)
                ray = q * np.where(finite, depth, 0).astype(float) - (t * q + a) * k * spacing
                lit &= ~(known & (ground < ray))
        if sides == "dark":
            z = np.where(finite, depth, 0).astype(float)
            ks = k * spacing
            u, v = 2 * (x * ks + i * z), 2 * (y * ks + j * z)
            lit &= (k > 0) & (-ks <= u) & (u < (2 * cols - 1) * ks) & (-ks <= v) & (v < (2 * rows - 1) * ks)
        out[..., d] = lit
    return out


def luminance(
    visible: np.ndarray, normal: np.ndarray, brightness: np.ndarray, moments: np.ndarray
) -> np.ndarray:
    """Irradiance of Eq. 3, float64: sum over visible L of B(L) max(0, N . w_L); radiance: rho / pi times it.

    visible (rows, cols, D) bool; normal (rows, cols, 3); brightness (D,); moments (D, 3), L dL for the
    printed form.
    """
    cosine = np.maximum(0.0, normal @ moments.T)
    total: np.ndarray = (np.where(visible, cosine, 0.0) * brightness).sum(-1)
    return total


def carve(
    low: np.ndarray,
    high: np.ndarray,
    weights: np.ndarray,
    steps: np.ndarray,
    sides: str,
    source: Geometry,
    layers: int,
    stop: str = "eps",
) -> np.ndarray:
    """The inverse algorithm: depth in layers (rows, cols) int64, ``layers`` where it was drilled through.

    ``weights`` (D,) int: rho B dOmega / (2 pi) of Eq. 4; ``low``, ``high`` (rows, cols) int: image - eps,
    image + eps, all in one unit. stop "eps": at the first layer with low <= B <= high. "sign": at the first
    layer where B reaches the image or lies on its other side than at n = 0.
    """
    depth = np.zeros(low.shape, np.int64)  # (1) z*(x, y) := 0
    active = np.ones(low.shape, bool)
    side = None

    def free(n: int) -> np.ndarray:  # F*: columns carved down to n and beyond
        return depth >= n

    for n, visible in propagate(depth, steps, sides, source, layers, free):
        light = (visible * weights.astype(np.int64)[:, None, None]).sum(0)  # (2) Eq. 4
        if side is None:
            side = light > high
        matches = (low <= light) & (light <= high)
        if stop == "sign":
            matches |= (light > high) != side
        active &= ~matches
        depth[active] = n + 1  # (3) carve
        if not active.any():  # (4) until z* < n everywhere
            break
    return depth


# -- horizons and shadow rays: one surface, given by its grid lines

AT_A_NODE = 1e-9  # nodes; a crossing this near to a node is at the node, so that rounding loses no neighbour
# tangent; on a map that repeats, ground that may rise less than this above a node is not looked for
LEVEL_SLOPE = 0.002


def _split(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions on a grid line as (node at or below, weight of the next node), weight 0 where at a node."""
    low = np.floor(at + AT_A_NODE)
    weight = at - low
    return low.astype(np.int64), np.where(weight < AT_A_NODE, 0.0, weight)


def _between(
    surface: np.ndarray, column: np.ndarray, low: np.ndarray, weight: np.ndarray, sides: str
) -> np.ndarray:
    """Depth on grid line ``column`` between rows ``low`` and ``low`` + 1.

    It is nan where a node of weight > 0 is masked or off the map.
    """
    rows, cols = surface.shape
    high = low + (weight > 0)
    if sides == "periodic":
        column, low, high = column % cols, low % rows, high % rows
    inside = (0 <= column) & (column < cols) & (0 <= low) & (high < rows)
    column, low, high = np.where(inside, column, 0), np.where(inside, low, 0), np.where(inside, high, 0)
    near = surface[low, column]
    return np.where(inside, near + weight * (surface[high, column] - near), np.nan)


def horizons(
    depth: np.ndarray,
    spacing: float,
    azimuths: Sequence[float] | np.ndarray,
    sides: str = "open",
    max_distance: float | None = None,
    nodes: Node | None = None,
) -> np.ndarray:
    """Tangent of the horizon's elevation by brute force: (azimuths, rows, cols), or (azimuths, n) at nodes.

    depth (rows, cols) [length], not finite where masked; ``azimuths`` [rad] from +x (columns) towards +y
    (rows); ``nodes``: (row indices, column indices). Every crossing of the azimuth's vertical plane with a
    row or a column counts, up to ``max_distance`` [length]; of a map that repeats, to where its relief is
    LEVEL_SLOPE high, or one lap. Dark: at least depth / distance of the wall half a node outside. -inf: no
    ground that way; nan: masked node.
    """
    surface = np.where(np.isfinite(depth), depth, np.nan).astype(float)
    row, col = (np.ravel(index) for index in (np.indices(surface.shape) if nodes is None else nodes))
    z, top, bottom = surface[row, col], np.nanmin(surface), np.nanmax(surface)
    # in nodes; a crossing just there counts
    reach = math.inf if max_distance is None else max_distance / spacing * (1 + 1e-12)
    if sides != "periodic":
        reach = min(reach, math.hypot(*surface.shape))
    elif math.isinf(reach):
        reach = max(math.hypot(*surface.shape), (bottom - top) / (LEVEL_SLOPE * spacing))
    out = np.full((len(azimuths), len(row)), -np.inf)
    for slopes, azimuth in zip(out, azimuths):
        x, y = (0.0 if abs(part) < 1e-12 else part for part in (math.cos(azimuth), math.sin(azimuth)))
        wall = np.full(len(row), np.inf)
        # crossings with columns, and of the transposed map, which are those with rows
        for lines, own, across, a, b in ((surface, col, row, x, y), (surface.T, row, col, y, x)):
            if a == 0:
                continue
            length, width = lines.shape
            wall = np.minimum(wall, ((width - 0.5 - own) if a > 0 else (own + 0.5)) / abs(a))
            step = np.arange(1, int(reach * abs(a)) + 1)
            low, weight = _split(step * (b / abs(a)))
            if sides != "periodic":
                on_map = (step < width) & (abs(low) <= length)
                step, low, weight = step[on_map], low[on_map], weight[on_map]
            distance = step * (spacing / abs(a))
            offset = step if a > 0 else -step
            start = 0
            while start < len(step):
                # no ground is higher than top, so from here on the other nodes' horizons cannot rise
                left = np.flatnonzero(z - top > slopes * distance[start])
                stop = start + 1 + 2**16 // (len(left) + 1)
                part = slice(start, stop)
                ground = _between(
                    lines, own[left, None] + offset[part], across[left, None] + low[part], weight[part], sides
                )
                slope = (z[left, None] - ground) / distance[part]
                slopes[left] = np.fmax(slopes[left], np.fmax.reduce(slope, axis=1))
                start = stop
        if sides == "dark":
            slopes[:] = np.fmax(slopes, z / (wall * spacing))
        slopes[np.isnan(z)] = np.nan
    return out.reshape(-1, *surface.shape) if nodes is None else out


def overviews(height: np.ndarray, share: float) -> Iterator[np.ndarray]:
    """Level 0, 1, 2 ... of a map: cells of 2^f nodes along a side, nan where none has data.

    A cell's mean is that of the four cells it is made of, as far as they have data, its maximum likewise; the
    height is mean + share (maximum - mean). Cells at the last rows and columns may be smaller.
    """
    mean = high = np.asarray(height, float)
    while True:
        yield mean + share * (high - mean)
        if mean.shape == (1, 1):
            return
        quarters = []
        for values in (mean, high):
            room = np.pad(values, [(0, n % 2) for n in values.shape], constant_values=np.nan)
            quarters.append(np.stack([room[i::2, j::2] for i in (0, 1) for j in (0, 1)]))
        count = np.isfinite(quarters[0]).sum(0)
        with np.errstate(invalid="ignore"):
            mean = np.nansum(quarters[0], 0) / count
        high = np.where(count > 0, np.fmax.reduce(quarters[1]), np.nan)


def far_horizons(
    height: np.ndarray,
    azimuths: Sequence[float] | np.ndarray,
    halo: int,
    rule: int,
    spread: int,
    share: float,
    repeats: bool = False,
    farthest: float = math.inf,
    drop: float = 0.0,
) -> np.ndarray:
    """Tangent of the elevation of the horizon beyond ``halo`` nodes, from overviews: (azimuths, rows, cols).

    height (rows, cols) [nodes], nan where masked. From distance ``halo`` [nodes] on up to ``farthest`` there
    is a sample every 2^f nodes, f the level from rule 2^f nodes on, bilinear between the centres of its cells
    (on the border that of the border's cells), as far as they have data. Slopes are less by drop x distance.
    They are known at every ``spread``-th node and the last of each axis, as that of the sample that stands
    highest; nodes between them take all four, each moved to their own height, bilinearly, or the nearest of
    them where one has no ground so far away, -inf, as its ray leaves the map before. nan: masked. A node
    without data looks from the lowest height.
    """
    rows, cols = height.shape
    levels = list(overviews(height, share))
    row, col = (np.unique(np.append(np.arange(0, n, spread), n - 1)) for n in (rows, cols))
    y, x = (index.astype(float) for index in np.meshgrid(row, col, indexing="ij"))
    own = height[np.ix_(row, col)]
    own = np.where(np.isnan(own), np.nanmin(height), own)
    out = np.empty((len(azimuths), rows, cols))
    for slopes, azimuth in zip(out, azimuths):
        best, where = np.full(own.shape, -np.inf), np.full(own.shape, np.inf)
        sine, cosine = (0.0 if abs(part) < 1e-9 else part for part in (math.sin(azimuth), math.cos(azimuth)))
        distance = float(halo)
        while distance <= min(farthest, math.inf if repeats else math.hypot(rows, cols)):
            f = min(math.floor(math.log2(distance / rule)), len(levels) - 1)
            v, u = y + distance * sine, x + distance * cosine
            on_map = repeats | ((v >= 0) & (v <= rows - 1) & (u >= 0) & (u <= cols - 1))
            ground = _between_cells(levels[f], v, u, 2**f, repeats)
            slope = np.where(on_map, (ground - own) / distance - drop * distance, np.nan)
            higher = slope > best
            best, where = np.where(higher, slope, best), np.where(higher, distance, where)
            distance += 2**f
        slopes[:] = _moved(best, where, own, height, row, col)
    return out


def _between_cells(cells: np.ndarray, v: np.ndarray, u: np.ndarray, size: int, repeats: bool) -> np.ndarray:
    """Height at row v, column u [nodes]: bilinear between those cells' centres that have data."""
    total, weights = np.zeros(v.shape), np.zeros(v.shape)
    v, u = ((at - (size - 1) / 2) / size for at in (v, u))
    for i in (0, 1):
        for j in (0, 1):
            r, q = np.floor(v).astype(int) + i, np.floor(u).astype(int) + j
            weight = (1 - abs(v - r)) * (1 - abs(u - q))
            if repeats:
                r, q = r % cells.shape[0], q % cells.shape[1]
            here = cells[np.clip(r, 0, cells.shape[0] - 1), np.clip(q, 0, cells.shape[1] - 1)]
            total += np.where(np.isnan(here), 0, weight * here)
            weights += np.where(np.isnan(here), 0, weight)
    with np.errstate(invalid="ignore"):
        return total / weights


def _moved(
    slope: np.ndarray,
    distance: np.ndarray,
    own: np.ndarray,
    height: np.ndarray,
    row: np.ndarray,
    col: np.ndarray,
) -> np.ndarray:
    """Slopes at all nodes from those at rows ``row`` and columns ``col``, each moved to the node's height."""
    out = np.full(height.shape, np.nan)
    for (y, x), h in np.ndenumerate(height):
        if np.isnan(h):
            continue
        ends = []
        for at, known in ((y, row), (x, col)):
            low = int(np.searchsorted(known, at, "right")) - 1
            high = min(low + 1, len(known) - 1)
            part = (at - known[low]) / max(1, known[high] - known[low])
            ends.append([(low, 1 - part), (high, part)])
        corners = [(r, q, a * b) for r, a in ends[0] for q, b in ends[1]]
        if any(np.isneginf(slope[r, q]) for r, q, _ in corners):
            (r, _), (q, _) = (max(pair[::-1], key=lambda end: end[1]) for pair in ends)  # the nearest
            corners = [(r, q, 1.0)]
        out[y, x] = sum(
            part * (slope[r, q] + (own[r, q] - h) / distance[r, q]) for r, q, part in corners if part > 0
        )
    return out


# -- light between surfaces: strips of ground, the same surface


Crossing = tuple[float, tuple[int, int], tuple[int, int], float]


def _crossings(x: float, y: float, reach: float) -> list[Crossing]:
    """Crossings of an azimuth (x, y) with columns and rows, by distance [nodes], up to ``reach``.

    (distance, (dx, dy) of the node at or before the crossing on its line, (dx, dy) of the next, its weight).
    """
    crossings = []
    for a, b, on_row in ((x, y, False), (y, x, True)):
        if a == 0:
            continue
        step = np.arange(1, int(reach * abs(a)) + 1)
        low, weight = _split(step * (b / abs(a)))
        for n, before, part in zip(step if a > 0 else -step, low, weight):
            ends = [(int(n), int(before + at)) for at in (0, part > 0)]
            one, other = ((v, u) if on_row else (u, v) for u, v in ends)
            crossings.append((float(abs(n / a)), one, other, float(part)))
    crossings.sort()
    return crossings


def _above(along: np.ndarray, up: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Integral of N.L over the elevations from ``slope`` to the zenith, per radian of azimuth."""
    e = np.arctan(slope)
    light: np.ndarray = along * (np.pi / 2 - e - np.sin(e) * np.cos(e)) / 2 + up * np.cos(e) ** 2 / 2
    return light


def strips(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    azimuths: Sequence[float] | np.ndarray,
    sides: str = "open",
    nodes: Node | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the ground and of the sky that are visible from nodes: (shares (n, rows x cols), sky (n,)),
    float64.

    ``shares @ g`` is the irradiance over pi that ground of radiance g (rows x cols) sends; ``sky`` the same
    of a sky of radiance 1. Azimuths are even, each of its share of the circle. In each, every crossing with a
    column or a row is met in order of distance. One that stands higher, seen from the node, than the tangent
    plane and all before it opens a strip of elevations, whose N.L is integrated in closed form.

    - Along the stretch between two crossings the radiance is linear. A strip's is the mean of that at its far
      end, the crossing, and at its near end, where the line of sight over all ground before meets the
      stretch.
    - The first stretch bends from the tangent plane up to the first crossing, at a cliff as well: that
      strip's radiance is the mean of the node's own and the crossing's.
    - A masked node is bottomless: behind it the first strip has the crossing's radiance alone.
    - Below the level, past all ground, it is black (open, dark), as is the wall of a dark box. On a map that
      repeats, strips are followed as horizons are, and scaled so that they and the sky make 1.
    """
    rows, cols = valid.shape
    height = np.where(valid, -depth / spacing, -1e30)
    row, col = (np.ravel(index) for index in (np.indices(valid.shape) if nodes is None else nodes))
    own, normal, top = height[row, col], normals(depth, spacing, valid, sides)[row, col], height.max()
    reach = math.hypot(rows, cols)
    if sides == "periodic":
        reach = max(reach, (top - height[valid].min()) / LEVEL_SLOPE)
    shares, sky = np.zeros((len(row), rows * cols)), np.zeros(len(row))
    share = 2 / len(azimuths)
    for azimuth in azimuths:
        x, y = (0.0 if abs(part) < 1e-12 else part for part in (math.cos(azimuth), math.sin(azimuth)))
        along, up = normal[:, 0] * x + normal[:, 1] * y, -normal[:, 2]
        highest = -along / up
        before = (0.0, own, row * cols + col, row * cols + col, np.zeros(len(row)))
        for crossing in _crossings(x, y, reach):
            distance = crossing[0]
            if not (own + highest * distance < top).any():
                break
            here = (distance, *_ground(height, row, col, crossing, sides))
            slope = (here[1] - own) / distance
            seen = np.flatnonzero(slope > highest)
            weight = share * (_above(along, up, highest) - _above(along, up, slope))[seen]
            near, far = _ends(own, highest, before, here, seen)
            for part, (_, _, a, b, w) in ((near, before), (far, here)):
                shares[seen, a[seen]] += weight * part * (1 - w[seen])
                shares[seen, b[seen]] += weight * part * w[seen]
            highest, before = np.maximum(highest, slope), here
        if sides == "dark":
            across, down = (
                (n - 0.5 - at if a > 0 else at + 0.5) / abs(a) if a else np.full(len(row), np.inf)
                for a, at, n in ((x, col, cols), (y, row, rows))
            )
            highest = np.maximum(highest, -own / np.minimum(across, down))
        sky += share * _above(along, up, np.maximum(highest, 0))
    if sides == "periodic":
        shares *= ((1 - sky) / np.maximum(shares.sum(1), 1e-300))[:, None]
    known = valid[row, col]
    shares[~known], sky[~known] = 0, 0
    return shares, sky


Ground = tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # distance, height, nodes, weight


def _ground(
    height: np.ndarray, row: np.ndarray, col: np.ndarray, crossing: Crossing, sides: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Height of the ground at a crossing, the nodes before and after it and the weight of the latter, (n,).

    Off the map the ground is bottomless.
    """
    rows, cols = height.shape
    _, one, other, part = crossing
    ends, inside = [], np.ones(len(row), bool)
    for dx, dy in (one, other):
        u, v = col + dx, row + dy
        if sides != "periodic":
            inside &= (0 <= u) & (u < cols) & (0 <= v) & (v < rows)
        ends.append((v % rows) * cols + u % cols)
    a, b = ends
    ground = height.ravel()[a] + part * (height.ravel()[b] - height.ravel()[a])
    return np.where(inside, ground, -1e30), a, b, np.full(len(row), part)


def _ends(
    own: np.ndarray, highest: np.ndarray, before: Ground, here: Ground, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the crossings before and here in the radiance of the strips ``seen``."""
    past = np.zeros(len(seen))
    if before[0] > 0:
        low, high = ((end[1] - own - highest * end[0])[seen] for end in (before, here))
        crosses = (low < 0) & (high > low)  # on a plane rounding alone may raise a crossing
        past = np.minimum(1.0, np.where(crosses, -low / np.where(crosses, high - low, 1.0), 0.0))
    return (1 - past) / 2, (1 + past) / 2


def interreflection(direct: np.ndarray, albedo: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Irradiance of direct light and all light between surfaces: E = E_d + shares @ (albedo E), converged.

    All (rows x cols,), ``shares`` as from :func:`strips`; rounds until none changes a node by 1e-9 of the
    mean, or 1000.
    """
    total = direct.astype(float)
    for _ in range(1000):
        after: np.ndarray = direct + shares @ (albedo * total)
        if np.abs(after - total).max() <= 1e-9 * direct.mean():
            break
        total = after
    return after


def sky_irradiance(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    azimuths: Sequence[float] | np.ndarray,
    widths: Sequence[float] | np.ndarray,
    horizon: np.ndarray,
    brightness: Any = None,
    nodes: Node | None = None,
    sides: str = "open",
) -> np.ndarray:
    """Irradiance of a sky above ``horizon``, as from :func:`horizons`: (rows, cols), or (n,) at ``nodes``.

    ``widths`` [rad]: each azimuth's share of the circle. A uniform sky (None: 1, or a number) is integrated
    over elevation in closed form, a function of unit vectors (..., 3) at 200 Gauss-Legendre nodes between
    horizon and zenith.
    """
    row, col = (np.ravel(index) for index in (np.indices(valid.shape) if nodes is None else nodes))
    normal = normals(depth, spacing, valid, sides)[row, col]
    point, share = np.polynomial.legendre.leggauss(200)
    out = np.zeros(len(row))
    for azimuth, width, tangent in zip(azimuths, widths, np.reshape(horizon, (len(azimuths), -1))):
        along = normal[:, 0] * math.cos(azimuth) + normal[:, 1] * math.sin(azimuth)
        up = -normal[:, 2]
        # the horizon, the tangent plane, the level
        slope = np.maximum(0.0, np.maximum(tangent, -along / up))
        if not callable(brightness):
            out += width * (1.0 if brightness is None else brightness) * _above(along, up, slope)
            continue
        t = np.arctan(slope)
        for some in np.array_split(np.arange(len(row)), len(row) // 1000 + 1):  # so that memory stays small
            half = (np.pi / 2 - t[some, None]) / 2
            e = t[some, None] + half * (1 + point)
            L = np.stack([np.cos(e) * math.cos(azimuth), np.cos(e) * math.sin(azimuth), -np.sin(e)], -1)
            cosine = along[some, None] * np.cos(e) + up[some, None] * np.sin(e)
            out[some] += width * (half * share * brightness(L) * cosine * np.cos(e)).sum(1)
    out[~valid[row, col]] = np.nan
    return out.reshape(valid.shape) if nodes is None else out


def unblocked(
    depth: np.ndarray,
    spacing: float,
    row: int,
    col: int,
    directions: np.ndarray,
    ends: np.ndarray,
    sides: str = "open",
) -> np.ndarray:
    """Whether rays from node (row, col) along unit vectors (n, 3) meet no ground before ``ends``: (n,) bool.

    Every crossing with a column and with a row is looked at; blocked where the ground is strictly higher than
    the ray.
    """
    surface = np.where(np.isfinite(depth), depth, np.nan).astype(float)
    top = np.nanmin(surface)
    flat = np.where(abs(directions) < 1e-12, 0.0, directions)
    free = np.ones(len(directions), bool)
    for lines, own, across, axis in ((surface, col, row, 0), (surface.T, row, col, 1)):
        rays, step = np.flatnonzero(flat[:, axis]), 0
        while len(rays):
            step += 1
            a, b = flat[rays, axis], flat[rays, 1 - axis]
            t = step * spacing / abs(a)
            z = surface[row, col] + t * directions[rays, 2]
            line = own + np.where(a > 0, step, -step)
            low, weight = _split(across + step * (b / abs(a)))
            going = (t < ends[rays]) & (z > top) & free[rays]
            if sides != "periodic":
                going &= (0 <= line) & (line < lines.shape[1]) & (-1 <= low) & (low < lines.shape[0])
            rays, z, line, low, weight = rays[going], z[going], line[going], low[going], weight[going]
            free[rays] = ~(_between(lines, line, low, weight, sides) < z)  # nan: no ground
    return free


def lamp_irradiance(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    lamp: Any,
    nodes: Node,
    rays: int = 4096,
    seed: int = 0,
    sides: str = "open",
) -> np.ndarray:
    """Irradiance of a lamp at ``nodes`` (rows, columns) by stratified shadow rays: (n,) float64.

    ``lamp``: a sphere, anything with center, radius [length] and brightness, whose rays are uniform in the
    cone in which it is seen; or a rectangle (corner, edge_u, edge_v, brightness), its edges at right angles,
    which shines from both faces.
    """
    if isinstance(lamp, tuple):
        *rectangle, brightness = lamp
        aim: Aim = partial(_to_rectangle, *rectangle)
    else:
        brightness, aim = lamp.brightness, partial(_to_ball, lamp.center, lamp.radius)
    return _gather(depth, spacing, valid, nodes, rays, seed, sides, brightness, aim)


def window_irradiance(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    window: Any,
    nodes: Node,
    points: int = 4096,
    seed: int = 0,
    sides: str = "open",
) -> np.ndarray:
    """Irradiance at ``nodes`` of the sky behind a rectangle in z = 0, by shadow rays: (n,) float64.

    ``window``: anything with x = (x0, x1), y = (y0, y1) [length] and brightness. Over a map that repeats so
    does the window.
    """
    (x0, x1), (y0, y1) = window.x, window.y
    if sides == "dark":  # the box hides the rest: no ray need be spent on it
        x0, x1 = np.clip(window.x, -0.5 * spacing, (valid.shape[1] - 0.5) * spacing)
        y0, y1 = np.clip(window.y, -0.5 * spacing, (valid.shape[0] - 0.5) * spacing)
        if x0 == x1 or y0 == y1:
            return np.where(valid[tuple(nodes)], 0.0, np.nan)

    def aim(origin: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if sides != "periodic" and origin[2] > 0:
            return _to_rectangle(*_rectangle((x0, x1), (y0, y1)), origin, u, v)
        # every direction, and whether it passes: from the window's own plane the whole sky is visible or none
        L = _upwards(u, v)
        ends = origin[2] / -L[:, 2]
        through = np.ones(len(L), bool)
        for axis, low, high, count in ((0, x0, x1, valid.shape[1]), (1, y0, y1, valid.shape[0])):
            past = origin[axis] + ends * L[:, axis] - low
            if sides == "periodic":
                past = np.mod(past, count * spacing)
            through &= (0 <= past) & (past < high - low)
        return L, ends, np.where(through, 2 * np.pi, 0.0)

    return _gather(depth, spacing, valid, nodes, points, seed, sides, window.brightness, aim)


def specular(
    visible: np.ndarray,
    normal: np.ndarray,
    brightness: np.ndarray,
    directions: np.ndarray,
    solid_angles: np.ndarray,
    exponent: float,
) -> np.ndarray:
    """Radiance of Phong's lobe (docs/explanation) over the visible directions, float64.

    (n + 2) / (2 pi) x sum of B (R.L)^n N.L dL.

    visible (rows, cols, D) bool; normal (rows, cols, 3); R = 2 (N.V) N - V for V = (0, 0, -1).
    """
    lobe = np.maximum(0.0, _mirror_directions(normal) @ directions.T) ** exponent
    cosine = np.maximum(0.0, normal @ directions.T)
    total: np.ndarray = (visible * lobe * cosine * brightness * solid_angles).sum(-1)
    return (exponent + 2) / (2 * np.pi) * total


def lobe_radiance(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    source: Any,
    exponent: float,
    nodes: Node,
    rays: int = 4096,
    sides: str = "open",
    kind: str = "sky",
) -> np.ndarray:
    """The same by stratified shadow rays at ``nodes``: (n,) float64. ``kind``: "sky", "lamp" or "window".

    Under a sky rays are as dense as the lobe, cos^n about the mirror direction; towards lamps and windows as
    for irradiance.
    """
    mirror = _mirror_directions(normals(depth, spacing, valid, sides))
    sky = source.brightness if callable(source.brightness) else lambda L: source.brightness
    out = np.full(len(nodes[0]), np.nan)
    for node, (row, col) in enumerate(zip(*nodes)):

        def light(L: np.ndarray, R: np.ndarray = mirror[row, col]) -> np.ndarray:
            lobe: np.ndarray = np.maximum(0.0, L @ R) ** exponent
            radiance: np.ndarray = sky(L) * (exponent + 2) / (2 * np.pi) * lobe
            return radiance

        def about(
            origin: np.ndarray, u: np.ndarray, v: np.ndarray, R: np.ndarray = mirror[row, col]
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            cosine = (1 - u) ** (1 / (exponent + 1))
            L = _about(R, cosine, np.sqrt(1 - cosine**2), v)
            return L, np.full(len(u), np.inf), 2 * np.pi / ((exponent + 1) * cosine**exponent)

        aim: Aim = about
        if kind == "lamp":
            aim = partial(_to_ball, source.center, source.radius)
        elif kind == "window":
            aim = partial(_to_rectangle, *_rectangle(source.x, source.y))
        out[node] = _gather(depth, spacing, valid, ([row], [col]), rays, 0, sides, light, aim)[0]
    return out


def _mirror_directions(normal: np.ndarray) -> np.ndarray:
    """R = 2 (N.V) N - V for V = (0, 0, -1)."""
    directions: np.ndarray = -2 * normal[..., 2:] * normal - [0.0, 0.0, -1.0]
    return directions


def mirror_radiance(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    brightness: Callable[[np.ndarray], np.ndarray],
    nodes: Node,
    sides: str = "open",
    ground: np.ndarray | None = None,
) -> np.ndarray:
    """The sky in an ideal mirror at ``nodes``: (n,) float64, brightness(L) along the mirror direction.

    Where ground is in the way it is 0, or the radiance of that ground, given ``ground`` (rows, cols). A ray
    meets it as the far end of a strip of :func:`strips`, and its radiance is that on the same stretch.
    """
    R = _mirror_directions(normals(depth, spacing, valid, sides))
    mirrored = []
    for node in zip(*nodes):
        away, radiance = R[node], 0.0
        if away[2] <= 0 and unblocked(depth, spacing, *node, away[None], np.array([np.inf]), sides)[0]:
            radiance = brightness(away[None])[0]
        elif ground is not None:
            radiance = _met(np.where(valid, -depth / spacing, -1e30), ground, *node, away, sides)
        mirrored.append(radiance)
    return np.array(mirrored)


def lobe_ground(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    ground: np.ndarray,
    exponent: float,
    nodes: Node,
    rays: int = 1024,
    sides: str = "open",
) -> np.ndarray:
    """Ground of known radiance (rows, cols) in Phong's lobe at ``nodes``: (n,) float64.

    By stratified rays as dense as the lobe, each of which meets the ground as a mirror's does.
    """
    normal = normals(depth, spacing, valid, sides)
    mirror, height = _mirror_directions(normal), np.where(valid, -depth / spacing, -1e30)
    out = []
    for row, col in zip(*nodes):
        u, v = _stratified(rays, 0, row, col)
        cosine = (1 - u) ** (1 / (exponent + 1))
        L = _about(mirror[row, col], cosine, np.sqrt(1 - cosine**2), v)
        facing = L @ normal[row, col]
        met = [_met(height, ground, row, col, away, sides) if on > 0 else 0.0 for away, on in zip(L, facing)]
        out.append((exponent + 2) / (exponent + 1) * np.mean(np.maximum(0, facing) * met))
    return np.array(out)


def _met(
    height: np.ndarray, ground: np.ndarray, row: int, col: int, direction: np.ndarray, sides: str
) -> float:
    """Radiance of the ground that a ray from a node meets first, 0 where it meets none."""
    flat = math.hypot(direction[0], direction[1])
    if flat == 0:
        return 0.0
    x, y = (0.0 if abs(part) < 1e-12 else part / flat for part in direction[:2])
    before = (0.0, float(ground[row, col]))  # of the ground over the ray, and its radiance
    # a level ray over a map that repeats may pass several copies
    far = math.hypot(*height.shape) * (8 if sides == "periodic" else 1)
    for crossing in _crossings(x, y, far):
        if crossing[0] * direction[2] / flat < height[row, col] - height.max():
            break  # above all ground
        at, a, b, w = _ground(height, np.array([row]), np.array([col]), crossing, sides)
        over = float(at[0] - height[row, col] + crossing[0] * direction[2] / flat)
        radiance = float((1 - w[0]) * ground.ravel()[a[0]] + w[0] * ground.ravel()[b[0]])
        if over > 0:
            gap, last = before
            past = 0.5 if gap == 0 else gap / (gap - over)
            return last + past * (radiance - last)
        before = min(over, -1e-300), radiance
    return 0.0


def _gather(
    depth: np.ndarray,
    spacing: float,
    valid: np.ndarray,
    nodes: Node,
    rays: int,
    seed: int,
    sides: str,
    brightness: Any,
    aim: Aim,
) -> np.ndarray:
    """Mean of weight B max(0, N . L) over the rays that arrive.

    aim(origin, u, v) -> (L (n, 3), ends (n,), weights [sr]).
    """
    rows, cols = valid.shape
    normal = normals(depth, spacing, valid, sides)
    surface = np.where(valid, depth, np.nan).astype(float)
    out = np.full(len(nodes[0]), np.nan)
    for node, (row, col) in enumerate(zip(*nodes)):
        if not valid[row, col]:
            continue
        u, v = _stratified(rays, seed, row, col)
        origin = np.array([col * spacing, row * spacing, surface[row, col]])
        L, ends, weight = aim(origin, u, v)
        cosine = L @ normal[row, col]
        lit = (L[:, 2] <= 0) & (cosine > 0) & (weight > 0)
        if sides == "dark":  # where the ray leaves the box through z = 0, or meets the source inside it
            reach = np.minimum(ends, origin[2] / np.maximum(-L[:, 2], 1e-300))
            for axis, count in ((0, cols), (1, rows)):
                at = (origin[axis] + reach * L[:, axis]) / spacing
                lit &= (at >= -0.5) & (at < count - 0.5)
        lit[lit] = unblocked(surface, spacing, row, col, L[lit], ends[lit], sides)
        light = brightness(L) if callable(brightness) else brightness
        out[node] = np.where(lit, weight * cosine * light, 0.0).mean()
    return out


def _stratified(rays: int, seed: int, row: int, col: int) -> np.ndarray:
    """u and v over 0 to 1, (2, rays), a node's own whatever the other nodes are."""
    side = math.isqrt(rays)
    jitter = np.random.default_rng((seed, row, col)).random((2, side, side))
    return ((np.indices((side, side)) + jitter) / side).reshape(2, -1)


def _upwards(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Unit vectors uniform over the hemisphere L_z < 0, for u and v uniform over 0 to 1."""
    cosine = 1 - u
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(2 * np.pi * v), sine * np.sin(2 * np.pi * v), -cosine], -1)


def _about(axis: np.ndarray, cosine: np.ndarray, sine: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) at angles (cosine, sine) from an axis, turned about it by ``v`` of a turn."""
    e = np.cross(axis, np.eye(3)[np.argmin(abs(axis))])
    e /= np.linalg.norm(e)
    turn = 2 * np.pi * v
    x, y = sine * np.cos(turn), sine * np.sin(turn)
    L: np.ndarray = cosine[:, None] * axis + x[:, None] * e + y[:, None] * np.cross(axis, e)
    return L


def _to_ball(
    center: Sequence[float], radius: float, origin: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays uniform in the cone that touches the ball, and where they meet it; from inside: at once."""
    to = np.asarray(center, float) - origin
    far = np.linalg.norm(to)
    if far <= radius:
        return _upwards(u, v), np.zeros(len(u)), np.full(len(u), 2 * np.pi)
    axis = to / far
    q = (radius / far) ** 2
    cap = q / (1 + math.sqrt(1 - q))  # 1 - cos of the cone's half angle, without cancellation
    lost = u * cap  # 1 - cos of the ray's angle from the axis
    sine = np.sqrt(lost * (2 - lost))
    L = _about(axis, 1 - lost, sine, v)
    ends = far * (1 - lost) - np.sqrt(np.maximum(0.0, radius**2 - (far * sine) ** 2))
    return L, ends, np.full(len(u), 2 * np.pi * cap)


def _rectangle(x: Sequence[float], y: Sequence[float]) -> tuple[Vector, Vector, Vector]:
    """Corner and edges of a rectangle in z = 0."""
    return (x[0], y[0], 0.0), (x[1] - x[0], 0.0, 0.0), (0.0, y[1] - y[0], 0.0)


def _to_rectangle(
    corner: Sequence[float] | np.ndarray,
    edge_u: Sequence[float] | np.ndarray,
    edge_v: Sequence[float] | np.ndarray,
    origin: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays to a rectangle, weighted by solid angle; nothing from its own plane.

    With the foot of the perpendicular, d long, at (0, 0), dOmega = d dx dy / (d^2 + x^2 + y^2)^(3/2) = dphi
    dh for x = d tan(phi) and h = y / sqrt(d^2 + x^2 + y^2): phi and h are uniform, and nothing is singular
    close by.
    """
    corner, ex, ey = (np.asarray(vector, float) for vector in (corner, edge_u, edge_v))
    width, length = np.linalg.norm(ex), np.linalg.norm(ey)
    ex, ey = ex / width, ey / length
    ez = np.cross(ex, ey)
    x0, y0, d = (corner - origin) @ ex, (corner - origin) @ ey, (corner - origin) @ ez
    if d == 0:
        return np.tile(ez, (len(u), 1)), np.zeros(len(u)), np.zeros(len(u))
    first, last = np.arctan2(x0, abs(d)), np.arctan2(x0 + width, abs(d))
    x = abs(d) * np.tan(first + u * (last - first))
    away = np.hypot(d, x)
    low, high = y0 / np.hypot(away, y0), (y0 + length) / np.hypot(away, y0 + length)
    h = low + v * (high - low)
    y = h * away / np.sqrt(1 - h * h)
    ends = np.hypot(away, y)
    L = (x[:, None] * ex + y[:, None] * ey + d * ez) / ends[:, None]
    return L, ends, (last - first) * (high - low)
