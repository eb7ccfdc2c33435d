"""The kernels in NumPy: same stems, names, arguments and bits as in Warp and OpenCL, on whole rows at a time."""

from __future__ import annotations

import importlib
import itertools
import os

import numpy as np

from ..sources import APERTURE, BALL, RECTANGLE, SKY, VOLUME
from .base import SIDES, Backend

# modules of the kernels that are not here
ELSEWHERE = {"adjoint": "numpy_adjoint", "horizon": "numpy_horizon", "ground": "numpy_horizon", "slices": "numpy_slices",
             "resident": "numpy_resident", "pilot": "numpy_pilot"}
NOTHING = np.finfo(np.float32).max  # ceiling where nothing stands above; finite, so that a masked node never passes


def available_memory() -> int:
    """Bytes of main memory that could be taken now, where the system tells; else a cautious 2 GiB."""
    try:
        with open("/proc/meminfo") as lines:
            return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names else 2**31


class NumpyBackend(Backend):
    """NumPy on one thread. Device arrays are NumPy arrays."""

    name = "numpy"
    device = "NumPy, 1 thread"

    @property
    def memory(self) -> int:
        return available_memory() // 2

    def upload(self, array):
        return np.array(array, order="C")

    def put(self, array, values):
        array[...] = values

    def empty(self, shape, dtype, fill=None):
        return np.empty(shape, dtype) if fill is None else np.full(shape, fill, dtype)

    def fill(self, array, value):
        array[...] = value

    def download(self, array):
        return array.copy()

    def view(self, array, shape):
        return array.reshape(-1)[: np.prod(shape)].reshape(shape)

    def launch(self, stem, kernel, dim, *args, lanes=None, group=None, **constants):
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # masked nodes are +inf
            if stem in ELSEWHERE:
                getattr(importlib.import_module(f".{ELSEWHERE[stem]}", __package__), kernel)(*args, **constants)
            else:
                globals()[kernel](*args)

    def finish(self):
        """NumPy is done when it returns."""


# -- scan ----------------------------------------------------------------------------------------------------------------


def _sweep(depth, i, j, warm, first_ceiling, periodic, lower, climb):
    """Yields (row, depths, ceilings) of the nodes of one walk (i, j), j not 0, row by row from the source's side.

    ``lower(ceiling, row)`` lowers the ceilings first.
    """
    rows, cols = depth.shape
    for residue in range(min(abs(j), rows)):
        ceiling = first_ceiling(residue * cols)
        for u in range(-warm, -(-(rows - residue) // abs(j))):
            row = (residue + u * abs(j)) % rows
            row = rows - 1 - row if j > 0 else row
            lower(ceiling, row)
            z = depth[row]
            if u >= 0:
                yield row, z, ceiling
            ceiling = np.minimum(ceiling, z) + climb
            # the next node of a line lies i columns back; what comes in from outside the map has open sky
            ceiling = np.roll(ceiling, -i, 1)
            if not periodic and i:
                ceiling[:, slice(-i, None) if i > 0 else slice(0, -i)] = NOTHING


def _scan_walk(maps, walk, climb, lap, planes, shape, periodic, lower=None):
    i, j, warm, _, _, parts, turned, plane = walk.tolist()
    depth = _map(maps, turned, shape)
    bits = len(climb)

    def first_ceiling(line):
        ceiling = np.full((bits, depth.shape[1]), NOTHING)
        if periodic and climb[0] == 0:
            ceiling[0] = np.roll(lap[line : line + depth.shape[1]], warm * i)  # the warm-up begins elsewhere on the cycle
        return ceiling

    out = planes[plane, : depth.size].reshape(depth.shape)
    weights = (1 << np.arange(bits, dtype=np.uint8))[:, None]
    scaled = depth * np.float32(parts) if lower else depth
    for row, z, ceiling in _sweep(scaled, i, j, warm, first_ceiling, periodic, lower or (lambda ceiling, row: None), climb[:, None]):
        out[row] = ((z <= ceiling) * weights).sum(0, dtype=np.uint8)


def _map(maps, turned, shape):
    shape = shape[::-1] if turned else shape
    return maps[turned, : shape[0] * shape[1]].reshape(shape)


def scan(maps, walks, rise, lap, planes, map_rows, map_cols, room, lap_lines, periodic):
    for w, walk in enumerate(walks):
        _scan_walk(maps, walk, rise[w], lap[w], planes, (map_rows, map_cols), periodic)


def scan_filled(maps, walks, rise, lap, crossings, climbs, spans, planes, map_rows, map_cols, room, lap_lines, periodic):
    for w, walk in enumerate(walks):
        begin, end = spans[w, 0], spans[w].sum() - 1
        depth = _map(maps, walk[6], (map_rows, map_cols))

        def lower(ceiling, row, begin=begin, end=end, depth=depth):
            for c in range(begin, end):
                np.minimum(ceiling, _ground(depth, crossings[c], row, periodic) + climbs[c][:, None], out=ceiling)

        _scan_walk(maps, walk, rise[w], lap[w], planes, (map_rows, map_cols), periodic, lower)


def turn_map(maps, rows, cols, room):
    _map(maps, 1, (rows, cols))[...] = _map(maps, 0, (rows, cols)).T


def turn_planes(planes, pairs, rows, cols, room):
    n = rows * cols
    for turned, plane in pairs:
        planes[plane, :n].reshape(rows, cols)[...] = planes[turned, :n].reshape(cols, rows).T


turn_planes_by_fours = turn_planes


def _ground(depth, crossing, row, periodic):
    """Depth x parts at a crossing next to every node of a row; +inf where it is unknown."""
    rows, cols = depth.shape
    x, y = np.arange(cols), np.full(cols, row)
    to_x, to_y, next_x, next_y, near_weight, far_weight = (int(v) for v in crossing[:6])
    values = []
    for px, py in ((x + to_x, y + to_y), (x + to_x + next_x, y + to_y + next_y)):
        if periodic:
            values.append(depth[py % rows, px % cols])
        else:
            inside = (px >= 0) & (px < cols) & (py >= 0) & (py < rows)
            values.append(np.where(inside, depth[np.clip(py, 0, rows - 1), np.clip(px, 0, cols - 1)], np.float32(np.inf)))
    near, far = values
    ground = np.float32(near_weight + far_weight) * near + np.float32(far_weight) * (far - near)
    return np.where((near < np.inf) & (far < np.inf), ground, np.float32(np.inf))


def pack(planes, order, words, pixels, room, n_words, n_walks):
    words = words.reshape(pixels, n_words)
    for w in range(n_walks):
        lit = planes[w, :pixels]
        for b, d in enumerate(order[w]):
            words[:, d // 32] |= (lit >> np.uint8(b) & np.uint8(1)).astype(np.uint32) << np.uint32(d % 32)


# -- luminance -----------------------------------------------------------------------------------------------------------


def gradient(depth, slopes, rows, cols, room, half, one):
    half, one = np.float32(half), np.float32(one)
    for out, z in ((slopes[0, : depth.size].reshape(depth.shape), depth), (slopes[1, : depth.size].reshape(depth.shape).T, depth.T)):
        known = np.isfinite(z)
        before, after = np.zeros_like(known), np.zeros_like(known)
        before[:, 1:], after[:, :-1] = known[:, :-1], known[:, 1:]
        low, high = z.copy(), z.copy()
        low[:, 1:] = np.where(before[:, 1:], z[:, :-1], z[:, 1:])
        high[:, :-1] = np.where(after[:, :-1], z[:, 1:], z[:, :-1])
        scale = np.where(before & after, half, one)
        out[...] = np.where(known & (before | after), (high - low) * scale, np.float32(0))


def luminance(planes, slopes, moments, irradiance, pixels, room, n_walks, is_first, is_last):
    gx, gy = slopes[0, :pixels], slopes[1, :pixels]
    total = np.zeros(pixels, np.float32) if is_first else irradiance[:pixels]
    for w in range(n_walks):
        lit = planes[w, :pixels]
        for b, (mx, my, mz, _) in enumerate(moments[w]):
            cosine = gx * mx + gy * my - mz
            total += np.where((lit >> np.uint8(b) & np.uint8(1)).astype(bool) & (cosine > 0), cosine, np.float32(0))
    irradiance[:pixels] = total / np.sqrt(gx * gx + gy * gy + np.float32(1)) if is_last else total


# -- specular ------------------------------------------------------------------------------------------------------------


def _gloss(gx, gy, L, lobe, rim, where):
    """What |(dz/dx, dz/dy, -1)| x max(0, N.L) x lobe is for one direction: (pixels among ``where`` in which it shows, values)."""
    gx, gy = gx[where], gy[where]
    twice = np.float32(2) / (gx * gx + gy * gy + np.float32(1))
    cosine = gx * L[0] + gy * L[1] - L[2]
    x, y, z = L[0] - twice * gx, L[1] - twice * gy, L[2] - (np.float32(1) - twice)
    at = (x * x + y * y + z * z) * (np.float32(0.5) * np.float32(len(lobe) - 1) / np.float32(rim))
    shows = (cosine > 0) & (at < len(lobe) - 1)
    at = at[shows]
    i = at.astype(np.int32)
    return where[shows], cosine[shows] * (lobe[i] + (at - i.astype(np.float32)) * (lobe[i + 1] - lobe[i]))


def specular(planes, slopes, directions, lobe, radiance, room, n_walks, n_lobe, is_first, is_last, rim):
    gx, gy = slopes
    total = np.zeros(room, np.float32) if is_first else radiance[:room]
    for w in range(n_walks):
        for b, L in enumerate(directions[w]):
            n, light = _gloss(gx, gy, L, lobe, rim, np.flatnonzero(planes[w] >> np.uint8(b) & np.uint8(1)))
            total[n] += L[3] * light
    radiance[:room] = total / np.sqrt(gx * gx + gy * gy + np.float32(1)) if is_last else total


def bound(slopes, directions, lobe, radiance, room, n, n_lobe, rim):
    gx, gy = slopes
    total = np.zeros(room, np.float32)
    for L in directions:
        n, light = _gloss(gx, gy, L, lobe, rim, np.arange(room))
        total[n] += L[3] * light
    radiance[:room] /= np.maximum(total / np.sqrt(gx * gx + gy * gy + np.float32(1)), np.float32(1))


# -- carve ---------------------------------------------------------------------------------------------------------------


def carve(planes, weights, light, low, high, side, depth, active, pixels, room, n_walks, is_first, is_last, layer, by_sign):
    depth = depth.reshape(pixels)
    here = np.flatnonzero(depth == layer)
    total = np.zeros(len(here), np.int32) if is_first else light[here]
    for w in range(n_walks):
        lit = planes[w, here]
        for b, weight in enumerate(weights[w]):
            total += np.where(lit >> np.uint8(b) & np.uint8(1), weight, np.int32(0))
    light[here] = total
    if not is_last:
        return
    if layer == 0:
        side[here] = total > high[here]
    stops = (low[here] <= total) & (total <= high[here])
    if by_sign:
        stops |= (total > high[here]) != side[here]
    depth[here[~stops]] = layer + 1
    active[0] += np.count_nonzero(~stops)


# -- source --------------------------------------------------------------------------------------------------------------


def _within(w, k, low, high, period, sides):
    if sides != SIDES["periodic"]:
        return (k * low <= w) & (w < k * high)
    v, lap = w - k * low, k * period
    return v - np.floor(v / lap) * lap < k * (high - low)


def _leaves_box(x, y, z, i, j, climb, rows, cols):
    u, v = 2 * (x * climb + i * z), 2 * (y * climb + j * z)
    return (-climb <= u) & (u < (2 * cols - 1) * climb) & (-climb <= v) & (v < (2 * rows - 1) * climb)


def _meets_plane(x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, step):
    if k == 0:
        return np.full(z.shape, kind == SKY and sides != SIDES["dark"])
    climb = k * step
    on = _leaves_box(x, y, z, i, j, climb, rows, cols) if sides == SIDES["dark"] else np.ones(z.shape, bool)
    u, v = x * climb + i * z, y * climb + j * z
    if kind == RECTANGLE:
        x0, x1, y0, y1 = numbers
        on &= _within(u, k, x0, x1, cols * step, sides) & _within(v, k, y0, y1, rows * step, sides)
    if kind == APERTURE:
        col, row = np.floor((2 * u + climb) / (2 * climb)), np.floor((2 * v + climb) / (2 * climb))
        if sides == SIDES["periodic"]:
            col, row = col - np.floor(col / cols) * cols, row - np.floor(row / rows) * rows
        on &= (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        on[on] = flags[0][row[on].astype(int), col[on].astype(int)] != 0
    return on


def _meets_lamp(depth, x, y, z, i, j, k, crossings, numbers, flags, kind, sides, step):
    """x, y, z: flat arrays of nodes. All rays go forward together; those that are decided fall out of ``going``."""
    rows, cols = depth.shape
    layers = len(flags)
    climb = k * step
    level = np.rint(z / step).astype(np.int64)
    lit, going = np.zeros(z.shape, bool), np.ones(z.shape, bool)
    hit = np.full(z.shape, np.inf)
    if kind == BALL:
        hit = _meets_ball(x, y, z, i, j, k, numbers, step)
        going = hit >= 0
        if sides == SIDES["dark"]:
            px, py = x + hit * i, y + hit * j
            inside = (px >= -0.5) & (px < cols - 0.5) & (py >= -0.5) & (py < rows - 0.5)
            out_first = z <= hit * climb if k else np.zeros(z.shape, bool)
            going &= np.where(out_first, _leaves_box(x, y, z, i, j, climb, rows, cols), inside)
    else:
        inside = level < layers
        lit[inside] = flags[level[inside], y[inside], x[inside]] != 0
        going &= ~lit
    who = np.flatnonzero(going)
    for t in itertools.count():
        for c, (to_x, to_y, next_x, next_y, near_weight, far_weight, moment, parts) in enumerate(crossings.tolist()):
            when = t * parts + moment
            if kind == BALL:
                arrived = when >= hit[who] * parts
                lit[who[arrived]] = True
                who = who[~arrived]
            over = z[who] * parts - when * climb
            gone = over < (0.0 if kind == BALL else -0.5 * step * parts)
            cx, cy = x[who] + t * i + to_x, y[who] + t * j + to_y
            ex, ey = cx + next_x, cy + next_y
            if sides == SIDES["periodic"]:
                cx, ex, cy, ey = cx % cols, ex % cols, cy % rows, ey % rows
            near_in = (cx >= 0) & (cx < cols) & (cy >= 0) & (cy < rows)
            far_in = (ex >= 0) & (ex < cols) & (ey >= 0) & (ey < rows)
            if c == len(crossings) - 1:
                gone |= ~near_in & ~far_in
            lit[who[gone]] = kind == BALL
            pick = lambda row, col: depth[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)].astype(float)
            near = pick(cy, cx)
            far = near if far_weight == 0 else pick(ey, ex)
            known = near_in & (far_in | (far_weight == 0)) & np.isfinite(near) & np.isfinite(far)
            blocked = known & ~gone & (near_weight * np.where(known, near, 0) + far_weight * np.where(known, far, 0) < over)
            if kind == VOLUME:
                nx, ny = (ex, ey) if 2 * far_weight >= parts else (cx, cy)
                n = (2 * (level[who] * parts - when * k) + parts) // (2 * parts)
                there = ~gone & ~blocked & (n >= 0) & (n < layers) & (nx >= 0) & (nx < cols) & (ny >= 0) & (ny < rows)
                there[there] = flags[n[there], ny[there], nx[there]] != 0
                lit[who[there]] = True
                gone |= there
            if k == 0 and c == len(crossings) - 1:
                gone |= (cx == x[who]) & (cy == y[who])  # a level ray on a map that repeats has come round
            who = who[~gone & ~blocked]
            if not len(who):
                return lit


def _meets_ball(x, y, z, i, j, k, numbers, step):
    lx, ly, lz = i * step, j * step, -(k * step)
    dx, dy, dz = numbers[0] - x * step, numbers[1] - y * step, numbers[2] - z
    a, b = lx * lx + ly * ly + lz * lz, dx * lx + dy * ly + dz * lz
    q = dx * dx + dy * dy + dz * dz - numbers[3] * numbers[3]
    root = b * b - a * q
    meets = (b > 0) & (root >= 0)
    return np.where(q <= 0, 0.0, np.where(meets, (b - np.sqrt(np.where(meets, root, 0))) / a, -1.0))


def clip(depth, steps, crossings, spans, numbers, flags, planes, rows, cols, room, layers, kind, sides, step, n_walks):
    y, x = np.nonzero(np.isfinite(depth))
    z = depth[y, x].astype(float)
    for w in range(n_walks):
        plane = planes[w, : depth.size].reshape(depth.shape)
        lit = plane[y, x]
        for b, (i, j, k, _) in enumerate(steps[w].tolist()):
            bit = np.uint8(1 << b)
            if kind in (BALL, VOLUME):
                clear = (lit & bit != 0) if kind == BALL and sides == SIDES["open"] else np.zeros(len(z), bool)  # nothing at all is in the way
                on = np.empty(len(z), bool)
                on[clear] = _meets_ball(x[clear], y[clear], z[clear], i, j, k, numbers, step) >= 0
                rest = ~clear
                on[rest] = _meets_lamp(depth, x[rest], y[rest], z[rest], i, j, k, crossings[spans[w, 0] : spans[w].sum()], numbers, flags, kind, sides, step)
            else:
                on = (lit & bit != 0) & _meets_plane(x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, step)
            lit = np.where(on, lit | bit, lit & ~bit)
        plane[y, x] = lit


def enter(steps, numbers, flags, field, rows, cols, reach, n_words, n_directions, kind, sides):
    y, x = (v - reach for v in np.mgrid[: rows + 2 * reach, : cols + 2 * reach])
    rim = (x < 0) | (x >= cols) | (y < 0) | (y >= rows)
    for layer in range(len(field)):
        n = layer - reach
        where = rim if n >= 0 else np.ones_like(rim)
        z = np.full(x.shape, float(n))
        words = np.zeros((n_words, *x.shape), np.uint32)
        if not (n >= 0 and sides == SIDES["dark"]):
            for d, (i, j, k, _) in enumerate(steps.tolist()):
                words[d // 32] |= _meets_plane(x, y, z, i, j, k, numbers, flags, rows, cols, kind, sides, 1.0).astype(np.uint32) << np.uint32(d % 32)
        field[layer][:, where] = words[:, where]


def beam(depth, steps, crossings, spans, numbers, flags, field, rows, cols, layers, kind, sides, n_words, n_directions, field_layers):
    for n in range(field_layers):
        y, x = np.nonzero(n <= depth)
        z = np.full(x.shape, float(n))
        field[n] = 0
        for d, (i, j, k, _) in enumerate(steps.tolist()):
            on = _meets_lamp(depth, x, y, z, i, j, k, crossings[spans[d, 0] : spans[d].sum()], numbers, flags, kind, sides, 1.0)
            field[n, d // 32, y, x] |= on.astype(np.uint32) << np.uint32(d % 32)


# -- propagate -----------------------------------------------------------------------------------------------------------


def reaches(depth, ways, lap, levels, rows, cols, lap_lines, periodic):
    nothing = np.zeros((1, 1), np.float32)
    for w, (i, j) in enumerate(ways.tolist()):
        z, out = (depth, levels[w]) if j else (depth.T, levels[w].T)
        i, j = (i, j) if j else (0, i)

        def first_ceiling(line, w=w, cols=z.shape[1]):
            return lap[w, None, line : line + cols].copy() if periodic else np.full((1, cols), np.inf, np.float32)

        for row, _, ceiling in _sweep(z, i, j, 0, first_ceiling, periodic, lambda ceiling, row: None, nothing):
            out[row] = ceiling[0]


def propagate(depth, levels, offsets, field, rows, cols, reach, n_words, n_directions, n_level, layer):
    here = field[layer + reach]
    width = cols + 2 * reach
    lit = np.zeros((n_words, rows, cols), np.uint32)
    for d, (k, offset) in enumerate(offsets.tolist()):
        word, bit = d // 32, np.uint32(1 << d % 32)
        if d < n_level:
            lit[word] |= np.where(levels[d] >= layer, bit, np.uint32(0))
        else:
            j = round(offset / width)
            i = offset - j * width
            lit[word] |= field[layer + reach - k, word, reach + j : reach + j + rows, reach + i : reach + i + cols] & bit
    here[:, reach : reach + rows, reach : reach + cols] = np.where(depth >= layer, lit, np.uint32(0))


def wrap(field, rows, cols, reach, n_words, layer):
    y, x = (np.arange(n + 2 * reach) - reach for n in (rows, cols))
    field[layer + reach] = field[layer + reach][:, (y % rows + reach)[:, None], (x % cols + reach)[None]]
