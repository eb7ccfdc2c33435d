"""The oracle: the paper's two algorithms, step by step, in NumPy and float64. Slow on purpose and never tuned.

Nothing here shares code with the backends; it is tested against closed forms (tests/test_oracle.py), and the kernels
are tested against it. Depth is in whole layers n (masked nodes: -1 in ``surface``, and free space all the way down).
The step numbers (1) to (4) are those of the forward and inverse algorithms in Langer and Zucker, section 6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from .sources import APERTURE, BALL, RECTANGLE, SKY, VOLUME, Geometry

FAR = np.iinfo(np.int64).max // 4  # depth of a masked column: free space without end


def gradient(depth: np.ndarray, spacing: float, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """dz/dx and dz/dy at the nodes: central differences, one-sided at the border and beside masked nodes."""

    def along_columns(z, ok):
        out = np.zeros(z.shape)
        for row in range(z.shape[0]):
            for col in range(z.shape[1]):
                left = col - 1 if col > 0 and ok[row, col - 1] else col
                right = col + 1 if col + 1 < z.shape[1] and ok[row, col + 1] else col
                if right > left and ok[row, col]:
                    out[row, col] = (z[row, right] - z[row, left]) / ((right - left) * spacing)
        return out

    z = np.where(valid, depth, 0.0).astype(float)
    return along_columns(z, valid), along_columns(z.T, valid.T).T


def normals(depth: np.ndarray, spacing: float, valid: np.ndarray) -> np.ndarray:
    """Unit normals (rows, cols, 3) = (dz/dx, dz/dy, -1) / |.|, towards the viewer's side."""
    gx, gy = gradient(depth, spacing, valid)
    normal = np.stack([gx, gy, -np.ones_like(gx)], -1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def meets_source(x, y, n, step, shape, sides: str, source: Geometry) -> np.ndarray:
    """Whether rays from nodes (x, y, n), which leave the volume along ``step`` without meeting ground, meet the source.

    x, y, n: integer arrays; step (i, j, -k). The crossing with z = 0 is compared multiplied out by k, never divided.
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


def _hits_ball(x, y, n, step, ball, longest: float, shape, sides: str) -> np.ndarray:
    """Whether x + t step, 0 < t <= longest, meets the closed ball (before a wall, with dark sides)."""
    rows, cols = shape
    l = np.asarray(step, float)
    to = [c - p for c, p in zip(ball[:3], (x, y, n))]
    a = l @ l
    b = to[0] * l[0] + to[1] * l[1] + to[2] * l[2]
    q = to[0] ** 2 + to[1] ** 2 + to[2] ** 2 - ball[3] ** 2
    root = b * b - a * q
    hit = (q <= 0) | ((b > 0) & (root >= 0))
    t = np.where(q <= 0, 0.0, (b - np.sqrt(np.maximum(root, 0))) / a)
    hit &= t <= longest
    if sides == "dark":
        k = -int(step[2])
        over = n <= t * k  # the ray crosses z = 0 before it meets the ball
        u, v = x * k + int(step[0]) * n, y * k + int(step[1]) * n
        through = (-k <= 2 * u) & (2 * u < (2 * cols - 1) * k) & (-k <= 2 * v) & (2 * v < (2 * rows - 1) * k)
        px, py = x + t * l[0], y + t * l[1]
        inside = (px >= -0.5) & (px < cols - 0.5) & (py >= -0.5) & (py < rows - 0.5)
        hit &= np.where(over & (k > 0), through, inside)
    return hit


def propagate(surface: np.ndarray, steps: np.ndarray, sides: str, source: Geometry, layers: int,
              free: Callable[[int], np.ndarray] | None = None) -> Iterator[tuple[int, np.ndarray]]:
    """The forward algorithm: yields (n, V) for n = 0 .. layers - 1, V (D, rows, cols) bool, the visibility field.

    ``surface``: (rows, cols) int, the depth z in layers, -1 where masked. ``free(n)`` replaces the test n <= z for
    carving, where free space F* grows while the layers go down; it is asked once per layer, in order.
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
        for d, (i, j, up) in enumerate(steps):  # (2) for all L in H*
            i, j, k = int(i), int(j), -int(up)
            leaving = meets_source(x, y, np.full_like(x, n), (i, j, -k), surface.shape, sides, source)
            if source.kind == BALL:
                near = _hits_ball(x, y, np.full_like(x, n), (i, j, -k), source.numbers, 1.0, surface.shape, sides)
            else:
                near = np.zeros_like(leaving)
            if n - k < 0:  # the ray leaves through z < 0
                visible[d] = leaving
            elif k > 0:
                above_free, above = kept[n - k]
                visible[d] = _shifted(above[d] & above_free, i, j, sides, leaving, source)
            else:
                visible[d] = _in_layer(in_free, shining, near, i, j, sides, leaving, source)
            visible[d] |= near
        visible |= shining
        visible &= in_free  # (3) L in V(x) only for x in F
        kept[n] = (in_free, visible)
        kept.pop(n - reach, None)
        yield n, visible  # (4) n := n + 1


def _shifted(values, i, j, sides, leaving, source):
    """values at x + l, or what a ray that leaves sideways sees."""
    rows, cols = values.shape
    y, x = np.mgrid[:rows, :cols]
    if sides == "periodic":
        return values[(y + j) % rows, (x + i) % cols]
    inside = (0 <= x + i) & (x + i < cols) & (0 <= y + j) & (y + j < rows)
    outside = leaving if sides == "open" else np.zeros_like(leaving)
    return np.where(inside, values[np.clip(y + j, 0, rows - 1), np.clip(x + i, 0, cols - 1)], outside)


def _in_layer(in_free, shining, near, i, j, sides, leaving, source):
    """k = 0: V(x) needs V(x + l) of the same layer, so nodes are taken in order from the source's side."""
    rows, cols = in_free.shape
    if sides == "periodic":
        lit = np.zeros_like(in_free)
        for row in range(rows):
            for col in range(cols):
                if not in_free[row, col]:
                    continue
                r, c = (row + j) % rows, (col + i) % cols
                while True:
                    if shining[r, c]:
                        lit[row, col] = True
                        break
                    if not in_free[r, c]:
                        break
                    if (r, c) == (row, col):  # once round: nothing in the way, and a sky all around
                        lit[row, col] = source.kind == SKY
                        break
                    r, c = (r + j) % rows, (c + i) % cols
        return lit
    lit = np.zeros_like(in_free)
    for row in range(rows)[:: -1 if j > 0 else 1]:
        for col in range(cols)[:: -1 if i > 0 else 1]:
            r, c = row + j, col + i
            if 0 <= r < rows and 0 <= c < cols:
                lit[row, col] = (in_free[r, c] and lit[r, c]) or shining[r, c]
            else:
                lit[row, col] = leaving[row, col] if sides == "open" else False
            lit[row, col] |= near[row, col]
            lit[row, col] &= in_free[row, col]
    return lit


def surface_visibility(surface: np.ndarray, steps: np.ndarray, sides: str, source: Geometry) -> np.ndarray:
    """V(x) at the surface's own nodes: (rows, cols, D) bool, by propagation through all layers down to the deepest."""
    out = np.zeros((*surface.shape, len(steps)), bool)
    for n, visible in propagate(surface, steps, sides, source, int(surface.max()) + 1):
        here = surface == n
        out[here] = visible[:, here].T
    return out


def filled_visibility(depth: np.ndarray, spacing: float, steps: np.ndarray, sides: str) -> np.ndarray:
    """Surface visibility under a sky, testing every crossing with a grid line: (rows, cols, D) bool, by brute force.

    Along each direction every crossing of the ray's vertical plane with a row or a column is compared, until the map
    ends; heights between nodes are linear. Multiplied out, so that whole numbers are compared exactly.
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
        laps = math.lcm(cols // math.gcd(cols, i or cols), rows // math.gcd(rows, j or rows)) if sides == "periodic" else max(rows, cols)
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
                clip = lambda row, col: depth[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)].astype(float)
                near, far = clip(r, c), np.where(weight == 0, clip(r, c), clip(r2, c2))
                known = inside & np.isfinite(near) & np.isfinite(far)
                ground = np.where(known, (q - weight) * np.where(known, near, 0) + weight * np.where(known, far, 0), np.inf)
                ray = q * np.where(finite, depth, 0).astype(float) - (t * q + a) * k * spacing
                lit &= ~(known & (ground < ray))
        if sides == "dark":
            z = np.where(finite, depth, 0).astype(float)
            ks = k * spacing
            u, v = 2 * (x * ks + i * z), 2 * (y * ks + j * z)
            lit &= (k > 0) & (-ks <= u) & (u < (2 * cols - 1) * ks) & (-ks <= v) & (v < (2 * rows - 1) * ks)
        out[..., d] = lit
    return out


def luminance(visible: np.ndarray, normal: np.ndarray, brightness: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Irradiance of Eq. 3: sum over visible L of B(L) max(0, N . w_L), in float64; radiance is rho / pi times it.

    visible (rows, cols, D) bool; normal (rows, cols, 3); brightness (D,); moments (D, 3), L dL for the printed form.
    """
    cosine = np.maximum(0.0, normal @ moments.T)
    return (np.where(visible, cosine, 0.0) * brightness).sum(-1)


def carve(low: np.ndarray, high: np.ndarray, weights: np.ndarray, steps: np.ndarray, sides: str, source: Geometry,
          layers: int, stop: str = "eps") -> np.ndarray:
    """The inverse algorithm: depth in layers (rows, cols) int64; ``layers`` where a column was drilled through.

    ``weights`` (D,) int: rho B dOmega / (2 pi) of Eq. 4; ``low``, ``high`` (rows, cols) int: image - eps, image + eps,
    all in one unit. stop "eps": at the first layer with low <= B <= high. "sign": at the first layer where B reaches
    the image or lies on its other side than at n = 0.
    """
    depth = np.zeros(low.shape, np.int64)  # (1) z*(x, y) := 0
    active = np.ones(low.shape, bool)
    side = None

    def free(n):  # F*: columns carved down to n and beyond
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
