"""Light between surfaces in NumPy: twin of opencl/interreflection.cl, all receivers or all rays at once."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ... import constants
from ...constants import DARK, PERIODIC
from .ground import _slope_between

HIGHEST_MASKED = np.float32(constants.HIGHEST_MASKED)
PI, HALF_PI, ENDLESS = (np.float32(v) for v in (constants.PI, constants.HALF_PI, constants.ENDLESS))
ARC_TANGENT = np.array(constants.ARC_TANGENT, np.float32)
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)


def _arctan(v: np.ndarray) -> np.ndarray:
    a = np.abs(v)
    r = np.where(a > 1, ONE / np.where(a > 1, a, ONE), a)
    q = r * r
    p: Any = ARC_TANGENT[0]
    for factor in ARC_TANGENT[1:]:
        p = p * q + factor
    p = p * r
    p = np.where(a > 1, HALF_PI - p, p)
    angle: np.ndarray = np.where(v < 0, -p, p)
    return angle


def _below(slope: np.ndarray, plane: np.ndarray) -> np.ndarray:
    q = ONE / (slope * slope + ONE)
    shares: np.ndarray = -plane * (_arctan(slope) + slope * q) - q
    return shares


class _Layout(NamedTuple):
    """Where nodes lie in planes."""

    rows: int
    cols: int
    across: int
    margin: int
    shift: int

    @property
    def pitch(self) -> int:
        return self.across + 2 * self.margin

    @property
    def size(self) -> int:
        """Elements of a map."""
        return (1 << self.shift) * (self.rows + 2) * self.pitch

    def place(self, c: Any, r: Any) -> Any:
        phase = c & ((1 << self.shift) - 1)
        return (phase * (self.rows + 2) + r + 1) * self.pitch + self.margin + (c >> self.shift)

    def around(self, heights: np.ndarray, c: Any, r: Any) -> list[np.ndarray]:
        """Heights of nodes and of their neighbours at the left, at the right, above and beneath."""
        moves = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))
        return [heights[self.place(c + i, r + j)] for i, j in moves]


def _to_wall(at: np.ndarray, along: Any, count: int) -> np.ndarray:
    with np.errstate(divide="ignore"):
        way = np.where(along > 0, np.float32(count) - HALF - at, at + HALF)
        return np.where(np.abs(along) < np.float32(1e-6), ENDLESS, way * (ONE / np.abs(along)))


class _Strips:
    """Sums of the strips of nodes at columns c and rows y, (n,) each, in one azimuth after another."""

    def __init__(
        self,
        heights: np.ndarray,
        light: np.ndarray,
        layout: _Layout,
        sides: int,
        lights: int,
        c: np.ndarray,
        y: np.ndarray,
        highest: float,
    ):
        self.heights, self.light = heights, light.reshape(lights, -1)
        self.layout, self.sides, self.c, self.y = layout, sides, c, y
        own, left, right, above, beneath = layout.around(heights, c, y)
        self.gx, self.gy = _slope_between(left, own, right), _slope_between(above, own, beneath)
        self.own = np.where(own > HIGHEST_MASKED, own, np.float32(highest))
        self.num, self.den = np.zeros((lights, len(c)), np.float32), np.zeros(len(c), np.float32)

    def begin(self, cosine: Any, sine: Any) -> None:
        self.cosine, self.sine = cosine, sine
        self.plane = -(self.gx * cosine + self.gy * sine)
        self.start = self.past = _below(self.plane, self.plane)
        self.slope = self.plane
        at = self.layout.place(self.c, self.y)
        self.was: tuple[Any, ...] = ZERO, ZERO, at, at, ZERO

    def meet(
        self, at: np.ndarray, next: np.ndarray, weight: Any, distance: Any, rises_by: Any = None
    ) -> None:
        """Crossings at a distance; all (n,), at -1 where there is none."""
        before, was_distance, was, was_next, was_weight = self.was
        a = self.heights[at]
        stands = a + weight * (self.heights[next] - a) - self.own
        rises = stands / distance if rises_by is None else stands * rises_by
        seen = (at >= 0) & (rises > self.slope)
        low, high = before - self.slope * was_distance, stands - self.slope * distance
        # on a plane rounding alone may raise a crossing, and then high may be below 0, or below low
        past_near = seen & (low < 0) & (high > low) & (was_distance > 0)
        part = np.minimum(np.where(past_near, -low / np.where(past_near, high - low, ONE), ZERO), ONE)
        here = _below(rises, self.plane)
        share = np.where(seen, (here - self.past) * HALF, ZERO)
        for num, light in zip(self.num, self.light):
            near = light[was] + was_weight * (light[was_next] - light[was])
            far = light[at] + weight * (light[next] - light[at])
            num += share * (near * (ONE - part) + far * (ONE + part))
        self.past, self.slope = np.where(seen, here, self.past), np.where(seen, rises, self.slope)
        self.was = stands, distance, at, next, weight

    def end(self) -> None:
        """All that is not sky."""
        if self.sides != PERIODIC:
            self.slope = np.maximum(self.slope, ZERO)
        if self.sides == DARK:
            x, y = self.c.astype(np.float32), self.y.astype(np.float32)
            walls = _to_wall(x, self.cosine, self.layout.cols), _to_wall(y, self.sine, self.layout.rows)
            self.slope = np.maximum(self.slope, -self.own / np.minimum(*walls))
        self.sky = _below(self.slope, self.plane)
        self.den += self.sky - self.start


def _gathered(
    strips: _Strips, ways: np.ndarray, places: np.ndarray, crossings: np.ndarray, azimuths: int, count: int
) -> None:
    """All azimuths and crossings of the tables."""
    layout, phases = strips.layout, 1 << strips.layout.shift
    ways, places, crossings = (
        ways.reshape(-1, 4),
        places.reshape(-1, count, 2),
        crossings.reshape(-1, count, 3),
    )
    for k in range(azimuths):
        strips.begin(ways[k, 0], ways[k, 1])
        for (dx, dy), (weight, distance, per_distance) in zip(places[k].tolist(), crossings[k]):
            u, v = strips.c + dx, strips.y + dy
            if strips.sides == PERIODIC:
                u = (((u >> layout.shift) % layout.across) << layout.shift) + (u & (phases - 1))
                v = v % layout.rows
            else:  # crossings outside the map are moved to its corner, where there is no ground
                off = (v < -1) | (v >= layout.rows) | (u < 0) | (u >= phases * layout.across)
                if off.all():
                    break
                u, v = np.where(off, -1, u), np.where(off, -1, v)
            at = layout.place(u, v)
            next = at + layout.pitch if ways[k, 2] > 0 else layout.place(u + 1, v)
            strips.meet(at, next, weight, distance, per_distance)
        strips.end()


def spread(
    maps: np.ndarray,
    albedo: np.ndarray,
    planes: np.ndarray,
    n: int,
    rows: int,
    cols: int,
    across: int,
    margin: int,
    shift: int,
    periodic: int,
    varies: int,
    scale: float,
    outside: float,
) -> None:
    factor = albedo.reshape(n, rows, cols) if varies else albedo.reshape(n, 1, 1)
    c = np.arange(-margin << shift, (across + margin) << shift)
    r = np.arange(-1, rows + 1)
    padded = np.full((n, len(r), len(c)), outside, np.float32)
    on_map = np.ix_(np.arange(n), (r >= 0) & (r < rows), (c >= 0) & (c < cols))
    values = maps.reshape(n, rows, cols) * (factor * np.float32(scale))
    if periodic:
        padded[...] = values[:, (r % rows)[:, None], c % cols]
    else:
        padded[on_map] = values
    out = planes.reshape(n, 1 << shift, rows + 2, across + 2 * margin)
    out[...] = padded.reshape(n, rows + 2, -1, 1 << shift).transpose(0, 3, 1, 2)


def begin(
    direct: np.ndarray,
    albedo: np.ndarray,
    sky: np.ndarray,
    irradiance: np.ndarray,
    n: int,
    pixels: int,
    varies: int,
) -> None:
    light = direct.reshape(n, pixels)
    light[...] = np.where(light > 0, light, ZERO)
    escapes = np.fmax(ONE - albedo.reshape(n, -1) * (ONE - sky), np.float32(constants.LEAST_ESCAPE))
    irradiance.reshape(n, pixels)[...] = light / escapes


def gather(
    heights: np.ndarray,
    light: np.ndarray,
    ways: np.ndarray,
    places: np.ndarray,
    crossings: np.ndarray,
    sums: np.ndarray,
    azimuths: int,
    count: int,
    rows: int,
    cols: int,
    across: int,
    margin: int,
    shift: int,
    sides: int,
    stride: int,
    phases: int,
    width: int,
    highest: float,
    LIGHTS: int,
) -> None:
    layout, step = _Layout(rows, cols, across, margin, shift), min(stride, 1 << shift)
    row, phase, x = (index.ravel() for index in np.mgrid[: (rows + stride - 1) // stride, :phases, :across])
    c, y = (x << shift) + phase * step, row * stride
    receives = heights[layout.place(c, y)] > HIGHEST_MASKED
    strips = _Strips(heights, light, layout, sides, LIGHTS, c[receives], y[receives], highest)
    _gathered(strips, ways, places, crossings, azimuths, count)
    out = sums.reshape(LIGHTS + 1, -1, phases, width)
    out[:LIGHTS], out[LIGHTS] = 0, -1
    there = row[receives], phase[receives], x[receives]
    for target, values in zip(out, [*strips.num, strips.den]):
        target[there] = values


def fill(
    heights: np.ndarray,
    sums: np.ndarray,
    direct: np.ndarray,
    sky: np.ndarray,
    irradiance: np.ndarray,
    rows: int,
    cols: int,
    across: int,
    margin: int,
    shift: int,
    sides: int,
    stride: int,
    phases: int,
    width: int,
    LIGHTS: int,
) -> None:
    layout, step = _Layout(rows, cols, across, margin, shift), min(stride, 1 << shift)
    sums = sums.reshape(LIGHTS + 1, -1, phases, width)
    y, x = np.arange(rows), np.arange(cols)
    row, down = _between(y, stride, sides == PERIODIC)
    column, right = _between(x, step, sides == PERIODIC)
    num, den, whole = list[Any](), list[Any](), list[Any]()
    for col in column:
        c = col * step
        at = (c & ((1 << shift) - 1)) // step, c >> shift
        ends = [sums[(slice(None), r[:, None], *at)] for r in row]
        parts = ONE - down, down
        weights = [np.where(end[LIGHTS] < 0, ZERO, part[:, None]) for end, part in zip(ends, parts)]
        whole.append(weights[0] + weights[1])
        den.append(weights[0] * ends[0][LIGHTS] + weights[1] * ends[1][LIGHTS])
        num.append([weights[0] * a + weights[1] * b for a, b in zip(ends[0][:LIGHTS], ends[1][:LIGHTS])])
    left = ONE - right
    known, shares = whole[0] * left + whole[1] * right, den[0] * left + den[1] * right
    own = heights[layout.place(x[None], y[:, None])]
    for light in range(LIGHTS):
        mean = (num[0][light] * left + num[1][light] * right) / np.where(shares > 0, shares, ONE)
        mean = np.where(shares > 0, mean, ZERO)
        total = direct.reshape(LIGHTS, rows, cols)[light] + PI * (ONE - sky.reshape(rows, cols)) * mean
        total = np.where(known > 0, total, -ONE)
        irradiance.reshape(LIGHTS, rows, cols)[light] = np.where(own <= HIGHEST_MASKED, ZERO, total)


def _between(at: np.ndarray, apart: int, periodic: bool) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """(receivers before and after, weight of the latter) of nodes along an axis."""
    before = at // apart
    last = before == before[-1]
    past = (at - before * apart).astype(np.float32)
    span = np.float32(len(at) - before[-1] * apart)
    weight = np.where(last, past / span * np.float32(periodic), past / np.float32(apart))
    return (before, np.where(last, 0, before + 1)), weight


def gather_nodes(
    heights: np.ndarray,
    light: np.ndarray,
    ways: np.ndarray,
    places: np.ndarray,
    crossings: np.ndarray,
    direct: np.ndarray,
    sky: np.ndarray,
    irradiance: np.ndarray,
    azimuths: int,
    count: int,
    rows: int,
    cols: int,
    across: int,
    margin: int,
    shift: int,
    sides: int,
    every: int,
    highest: float,
    LIGHTS: int,
) -> None:
    layout = _Layout(rows, cols, across, margin, shift)
    first = irradiance.reshape(LIGHTS, rows, cols)[0]
    y, c = np.nonzero(np.ones_like(first) if every else first < 0)
    strips = _Strips(heights, light, layout, sides, LIGHTS, c, y, highest)
    _gathered(strips, ways, places, crossings, azimuths, count)
    own, p = heights[layout.place(c, y)], y * cols + c
    for light_of, num in zip(range(LIGHTS), strips.num):
        mean = np.where(strips.den > 0, num / np.where(strips.den > 0, strips.den, ONE), ZERO)
        estimate = direct.reshape(LIGHTS, -1)[light_of, p] + PI * (ONE - sky.ravel()[p]) * mean
        irradiance.reshape(LIGHTS, -1)[light_of, p] = np.where(own <= HIGHEST_MASKED, ZERO, estimate)


def strips(
    heights: np.ndarray,
    light: np.ndarray,
    tops: np.ndarray,
    rays: np.ndarray,
    sums: np.ndarray,
    n_rays: int,
    rows: int,
    cols: int,
    across: int,
    margin: int,
    shift: int,
    sides: int,
    block: int,
    blocks: int,
    highest: float,
    reach: float,
    LIGHTS: int,
) -> None:
    # rays meet every crossing: `tops` would make this faster, not different
    layout, rays, out = (
        _Layout(rows, cols, across, margin, shift),
        rays.reshape(-1, 4),
        sums.reshape(-1, n_rays),
    )
    for some in np.array_split(np.arange(n_rays), n_rays // 2**16 + 1):  # so that memory stays small
        x, y = (rays[some, k].astype(np.int64) for k in (0, 1))
        this = _Strips(heights, light, layout, sides, LIGHTS, x, y, highest)
        this.begin(rays[some, 2], rays[some, 3])
        _walk(this, np.float32(highest), np.float32(reach))
        this.end()
        up = ONE / np.sqrt(ONE + this.gx * this.gx + this.gy * this.gy)
        out[:LIGHTS, some], out[LIGHTS, some] = up * this.num, up * this.den
        out[LIGHTS + 1, some] = up * (-this.plane * HALF_PI - this.sky)


class _Crossing(NamedTuple):
    """Where rays cross a column or a row of nodes: between two places, which are -1 off the map."""

    at: Any
    next: Any
    weight: Any
    distance: Any


class _Rays:
    """Single rays, and the columns and rows that they have met."""

    def __init__(self, layout: _Layout, sides: int, c: np.ndarray, y: np.ndarray, cosine: Any, sine: Any):
        self.layout, self.sides, self.c, self.y, self.cosine, self.sine = layout, sides, c, y, cosine, sine
        with np.errstate(divide="ignore"):
            lengths = np.abs(cosine), np.abs(sine)
            self.per_column, self.per_row = (
                np.where(v > np.float32(1e-6), ONE / v, ENDLESS) for v in lengths
            )
        self.columns, self.lines = np.zeros(len(c), np.int64), np.zeros(len(c), np.int64)

    def cross(self, going: np.ndarray) -> _Crossing:
        """The next crossings of the rays that are ``going``, a mask that loses those that leave the map."""
        layout, cosine, sine = self.layout, self.cosine, self.sine
        columns, lines = self.columns + 1, self.lines + 1
        to_column, to_row = (
            columns.astype(np.float32) * self.per_column,
            lines.astype(np.float32) * self.per_row,
        )
        distance = np.minimum(to_column, to_row)
        on_column = to_column <= to_row
        x, y = self.c.astype(np.float32) + cosine * distance, self.y.astype(np.float32) + sine * distance
        at_line = np.where(on_column, y, x)
        low = np.floor(at_line).astype(np.int64)
        weight = at_line - low.astype(np.float32)
        at_next = weight > ONE - np.float32(1e-4)
        low, weight = low + at_next, np.where(at_next | (weight < np.float32(1e-4)), ZERO, weight)
        u = np.where(on_column, np.where(cosine > 0, self.c + columns, self.c - columns), low)
        v = np.where(on_column, low, np.where(sine > 0, self.y + lines, self.y - lines))
        self.columns, self.lines = self.columns + on_column, self.lines + ~on_column
        if self.sides == PERIODIC:
            u, v = u % layout.cols, v % layout.rows
        else:
            going &= (u >= 0) & (u < layout.cols) & (v >= 0) & (v < layout.rows)
            going &= (weight <= 0) | np.where(on_column, v + 1 < layout.rows, u + 1 < layout.cols)
            u, v = np.where(going, u, 0), np.where(going, v, 0)
        at = layout.place(u, v)
        next = np.where(on_column, at + layout.pitch, layout.place(u + 1, v))
        return _Crossing(np.where(going, at, -1), np.where(going, next, -1), weight, distance)


def _walk(this: _Strips, highest: np.float32, reach: np.float32) -> None:
    """Every crossing of single rays with a column or a row."""
    rays = _Rays(this.layout, this.sides, this.c, this.y, this.cosine, this.sine)
    going = np.ones(len(this.c), bool)
    while True:
        crossing = rays.cross(going)
        going &= (crossing.distance <= reach) & (highest - this.own > this.slope * crossing.distance)
        if not going.any():
            return
        at, next = (np.where(going, place, -1) for place in (crossing.at, crossing.next))
        this.meet(at, next, crossing.weight, crossing.distance)


def glossy(
    heights: np.ndarray,
    light: np.ndarray,
    lobe: np.ndarray,
    spots: np.ndarray,
    tops: np.ndarray,
    image: np.ndarray,
    rows: int,
    cols: int,
    across: int,
    margin: int,
    shift: int,
    sides: int,
    block: int,
    blocks: int,
    slices: int,
    rays: int,
    n_lobe: int,
    rim: float,
    highest: float,
    reach: float,
    LIGHTS: int,
) -> None:
    # rays meet every crossing: `tops` would make this faster, not different
    layout, out = _Layout(rows, cols, across, margin, shift), image.reshape(LIGHTS, -1)
    out[...] = 0
    y, x = (index.ravel() for index in np.mgrid[:rows, :cols])
    valid = np.flatnonzero(heights[layout.place(x, y)] > HIGHEST_MASKED)
    spots = spots.reshape(-1, 2)
    for some in np.array_split(valid, len(valid) // 2**16 + 1):  # so that memory stays small
        this = _Glossy(heights, light.reshape(LIGHTS, -1), layout, sides, x[some], y[some])
        this.lobe, this.rim, this.rays = lobe[:n_lobe], np.float32(rim), spots[slices : slices + rays]
        for place, width in spots[:slices]:
            this.add(place, width, np.float32(highest), np.float32(reach))
        out[:, some] = this.sums


class _Glossy:
    """What nodes at columns c and rows y, (n,) each, reflect of the ground, by one slice after another.

    ``rays`` (n, 2): places across the lobe, and their widths.
    """

    lobe: np.ndarray
    rim: np.float32
    rays: np.ndarray

    def __init__(
        self,
        heights: np.ndarray,
        light: np.ndarray,
        layout: _Layout,
        sides: int,
        c: np.ndarray,
        y: np.ndarray,
    ):
        self.heights, self.light, self.layout, self.sides = heights, light, layout, sides
        self.c, self.y, self.sums = c, y, np.zeros((len(light), len(c)), np.float32)
        self.own, left, right, above, beneath = layout.around(heights, c, y)
        # 1. the mirror direction, by sine and cosine of its elevation and azimuth
        self.gx, self.gy = _slope_between(left, self.own, right), _slope_between(above, self.own, beneath)
        self.square = ONE + self.gx * self.gx + self.gy * self.gy
        self.steep = np.sqrt(self.gx * self.gx + self.gy * self.gy)
        self.up, self.flat = 2 / self.square - ONE, 2 * self.steep / self.square

    def add(self, place: Any, width: Any, highest: Any, reach: Any) -> None:
        """One azimuth of the lobe, and the first ground along every ray in it."""
        rim, flat, up = self.rim, self.flat, self.up
        wide = np.sqrt(rim * (2 - rim))
        with np.errstate(divide="ignore", invalid="ignore"):
            half_turn = np.where(wide < flat, np.arcsin(np.minimum(wide / flat, ONE)), PI)
            angle, turn = half_turn * place, half_turn * width / np.sqrt(self.square)
            c, s, level = np.cos(angle), np.sin(angle), self.steep == 0
            cosine = np.where(level, c, (self.gx * c - self.gy * s) / self.steep)
            sine = np.where(level, s, (self.gy * c + self.gx * s) / self.steep)
            # 2. the elevations: 1 - cosine to R is aside + length (1 - cos(angle from the middle))
            along = flat * c
            length = np.sqrt(along * along + up * up)
            aside = flat * flat * s * s / (ONE + length)
            middle, plane = np.arctan2(up, along), -(self.gx * cosine + self.gy * sine)
            ratio = np.clip(np.nan_to_num((rim - aside) / (2 * length)), ZERO, ONE)
            in_plane = along / length, up / length
        spread = 2 * np.arcsin(np.sqrt(ratio))
        lowest, most = np.maximum(middle - spread, _arctan(plane)), np.minimum(middle + spread, HALF_PI)
        start = np.minimum(np.maximum(middle, lowest), most)
        from_cosine, from_sine = (
            np.where(start == middle, exact, turned(start))
            for exact, turned in zip(in_plane, (np.cos, np.sin))
        )
        below, above = np.tan(HALF * (start - lowest)), np.tan(HALF * (most - start))

        def aimed(ray: np.ndarray) -> tuple[np.ndarray, ...]:
            """Cosine, sine, slope and change of elevation of a ray, its slope a little less: ground that it
            misses by rounding is met.
            """
            spot = self.rays[np.minimum(ray, len(self.rays) - 1), 0]
            side = np.where(spot < 0, below, above)
            t = side * spot
            scale = ONE / (ONE + t * t)
            e, f = (ONE - t * t) * scale, 2 * t * scale
            cos, sin = from_cosine * e - from_sine * f, from_sine * e + from_cosine * f
            slope = sin / np.maximum(cos, ONE / np.float32(constants.STEEP))
            slope = slope - np.float32(constants.GRAZES) * (ONE + np.abs(slope))
            return cos, sin, slope, 2 * side * scale

        # 3. the first ground along each ray: lower ones meet it first
        ray, going = np.zeros(len(self.c), np.int64), (aside <= rim) & (most >= lowest)
        cos, sin, slope, per_place = aimed(ray)
        at = self.layout.place(self.c, self.y)
        was, before = _Crossing(at, at, ZERO, ZERO), np.zeros_like(self.own)
        walk = _Rays(self.layout, self.sides, self.c, self.y, cosine, sine)
        while going.any():
            here = walk.cross(going)
            going &= (here.distance <= reach) & (highest - self.own > slope * here.distance)
            stands = self._value(self.heights, here) - self.own
            rises = stands / here.distance
            meets = going & (rises > slope)
            while meets.any():
                low, high = before - slope * was.distance, stands - slope * here.distance
                past = (low < 0) & (high > low)
                part = np.minimum(np.where(past, -low / np.where(past, high - low, ONE), ZERO), ONE)
                part = np.where(was.distance > 0, part, HALF)
                weight: Any = ONE
                if rim > 0:
                    off = (sin * along - cos * up) / length
                    near = (cos * along + sin * up) / length
                    away = aside + length * off * off / (ONE + near)
                    weight = _lobe_at(self.lobe, away / rim) * np.maximum(sin - plane * cos, ZERO)
                    widths = self.rays[np.minimum(ray, len(self.rays) - 1), 1]
                    weight = weight * cos * per_place * widths * turn
                for sums, map in zip(self.sums, self.light):
                    seen = self._value(map, was) * (ONE - part) + self._value(map, here) * part
                    sums += np.where(meets, weight * seen, ZERO)
                ray = ray + meets
                going &= ray < len(self.rays)
                cos, sin, slope, per_place = aimed(ray)
                meets = going & meets & (rises > slope)
            was, before = here, stands

    @staticmethod
    def _value(map: np.ndarray, crossing: _Crossing) -> np.ndarray:
        near = map[crossing.at]
        value: np.ndarray = near + crossing.weight * (map[crossing.next] - near)
        return value


def _lobe_at(lobe: np.ndarray, part: np.ndarray) -> np.ndarray:
    at = np.minimum(part, ONE) * np.float32(len(lobe) - 1)
    i = np.clip(at.astype(np.int64), 0, len(lobe) - 2)
    weights: np.ndarray = lobe[i] + (at - i.astype(np.float32)) * (lobe[i + 1] - lobe[i])
    return weights
