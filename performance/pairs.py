"""Random pairs of scene and source, and their irradiance by brute force, for performance/refinement.py.

Every source is made of a smooth part and of features: suns, lights and glows whose places are known. Truth
takes exact rays at the samples and shares no table with the library. The smooth part is evaluated densely
along the elevation; each feature is integrated within its own bounds, in closed form where it is evenly
bright.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from plans import fractal, in_length

import skylamp as sl
from skylamp import sources
from skylamp.constants import STEEP
from skylamp.light.finite import solid_of
from skylamp.sources.cie import SUN_RADIUS, towards
from skylamp.sources.solids import upright

AZIMUTHS, CELLS = 1440, 1024  # of the smooth part of a sky; cells of elevation
WITHIN = 4  # places within an azimuth's width at which brightness is taken
NARROW, NARROW_CELLS = 192, 256  # azimuths and cells of elevation of a feature
SLICES, POINTS = 1024, 64  # of a lamp or window; points of a slice at which brightness is taken
# times as many for slits and tubes whose brightness varies: without, nodes that nearly lie below one are
# wrong by 0.2 to 4 % of the mean in all
THIN_DENSITY = 3
# share of its length to which a source is a line: slices were wrong at nodes that nearly lie below one, by
# up to 13 % of a node and 4 % of the mean in all
LINE_SHARE = 0.001
# strips across it, so that what a part of its width sees counts; points of each strip along its smooth part
# and within each feature. With twice as many of both two slits before suns change by 5e-6 and 1e-5 of the
# mean, a tube with a steep spot (cos^659) by 2e-4
LINE_STRIPS, LINE_POINTS = 8, 2048
LINE_RAYS = 2**18  # at a time


def primitives(e):
    """Integrals over elevation from level to ``e`` of cos^2 and of sin cos."""
    return e / 2 + np.sin(2 * e) / 4, np.sin(e) ** 2 / 2


# -- brightness ----------------------------------------------------------------------------------------------


@dataclass
class Feature:
    """What a sky holds within ``radius`` [rad] of ``axis``: a number if evenly bright, else a function."""

    axis: np.ndarray
    radius: float
    light: float | Callable

    def __call__(self, L):
        return self.light(L) if callable(self.light) else self.light * (L @ self.axis >= np.cos(self.radius))


@dataclass
class Light:
    """A brightness as truth knows it. ``given``: what skylamp is given, if not their sum."""

    text: str
    smooth: float | Callable
    features: tuple = ()
    bands: tuple = ()  # (from, to, brightness) [rad]: rings round the horizon
    given: object = None

    def __call__(self, L):
        e = np.arcsin(np.clip(-L[..., 2], -1, 1))
        light = self.smooth(L) if callable(self.smooth) else np.full(L.shape[:-1], self.smooth)
        return sum((b * ((low <= e) & (e < high)) for low, high, b in self.bands), light) + sum(
            f(L) for f in self.features
        )

    @property
    def brightness(self):
        return self if self.given is None else self.given


def axis_of(azimuth, elevation):
    """Unit vector towards this azimuth and elevation [rad]."""
    return sources.directions_of(azimuth, np.sin(elevation))


def suns(rng, most=10):
    """A uniform or overcast sky with discs that give most of the light, some low, some at the zenith."""
    count, share = int(rng.integers(1, most + 1)), rng.uniform(0.3, 0.9)
    features = []
    for _ in range(count):
        elevation = np.radians(rng.choice([rng.uniform(1, 90), rng.uniform(0.5, 12), 90], p=[0.7, 0.2, 0.1]))
        radius = np.radians(np.exp(rng.uniform(*np.log([0.1, 5]))))
        axis = axis_of(rng.uniform(0, 2 * np.pi), elevation)
        level = share / (1 - share) * rng.uniform(0.3, 1) / count  # its light on level ground, over the sky's
        features.append(Feature(axis, radius, level / (np.sin(radius) ** 2 * max(0.1, np.sin(elevation)))))
    smooth = 1.0 if rng.random() < 0.6 else sl.cie_overcast()
    text = " ".join(f"{np.degrees(f.radius):.2g}@{np.degrees(np.arcsin(-f.axis[2])):.2g}" for f in features)
    under = "1" if smooth == 1.0 else "overcast"
    text = f"{count} suns (radius@elevation) {text} share {share:.2f} over {under}"
    return Light(text, smooth, tuple(features))


def panorama(rng, lights=False):
    """An environment map of noise, or an even one with small lights, one pixel each, interpolated."""
    rows = int(rng.choice([16, 32, 64, 128]))
    if not lights:
        base = rng.gamma(rng.uniform(0.3, 2), size=(rows, 2 * rows))
        return Light(f"panorama {rows}", sl.environment_map(base), given=sl.environment_map(base))
    base = np.full((rows, 2 * rows), 0.2)
    image, features = base.copy(), []
    for _ in range(int(rng.integers(1, 9))):
        row, col = int(rows * rng.uniform(0.06, 0.49)), int(rng.integers(2 * rows))
        one = np.zeros_like(base)
        one[row, col] = rng.uniform(0.3, 1) * 40 * (rows / 16) ** 2
        image += one
        axis = axis_of((col + 0.5) * np.pi / rows, np.pi / 2 - (row + 0.5) * np.pi / rows)
        features.append(Feature(axis, 1.5 * np.pi / rows, sl.environment_map(one)))
    text, given = f"map {rows} with {len(features)} lights", sl.environment_map(image)
    return Light(text, sl.environment_map(base), tuple(features), given=given)


def stripes(rng):
    """Meridians, sharp or soft."""
    count, turn, sharp = int(rng.integers(2, 19)), rng.uniform(0, 2 * np.pi), rng.choice([1.0, 5.0, 1e9])
    wave = lambda L: np.sin(count * np.arctan2(L[..., 1], L[..., 0]) + turn)
    return Light(
        f"{count} stripes sharpness {sharp:g}", lambda L: 0.05 + np.clip(0.5 + sharp * wave(L), 0, 1)
    )


def glow(rng):
    """A lobe cos^k on an even sky."""
    power = float(np.exp(rng.uniform(*np.log([2, 900]))))
    axis = axis_of(rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(3, 90)))
    height = rng.uniform(0.2, 3) * power
    lobe = lambda L: height * np.maximum(0, L @ axis) ** power
    text = f"glow cos^{power:.3g} height {height:.3g} at {np.degrees(np.arcsin(-axis[2])):.2g}"
    if power > 60:
        return Light(text, 1.0, (Feature(axis, 6.5 / np.sqrt(power), lobe),))
    return Light(text, lambda L: 1 + lobe(L))


def band(rng):
    """A sharp bright band above the horizon."""
    low = np.radians(rng.choice([0, rng.uniform(0, 40)]))
    high = low + np.radians(np.exp(rng.uniform(*np.log([1, 20]))))
    light = rng.uniform(1, 20) / (high - low)
    text = f"band {np.degrees(low):.2g}..{np.degrees(high):.2g} x {light:.3g}"
    return Light(text, 1.0, bands=((low, high, light),))


def cie(rng):
    """A CIE sky with the sun's disc."""
    sun, kind = (rng.uniform(0, 360), rng.uniform(2, 88)), int(rng.choice([7, 9, 12, 13, 15]))
    sky = sl.cie_sky(kind, sun, horizontal=1.0, direct=rng.uniform(0.3, 6))
    radius = np.radians(SUN_RADIUS)
    disc = Feature(towards(*sun), radius, sky.direct / (np.pi * np.sin(radius) ** 2))
    text = f"cie {kind} sun at {sun[1]:.2g} direct {sky.direct:.2g}"
    return Light(text, replace(sky, direct=0.0), (disc,), given=sky)


def spot(rng):
    """A lobe cos^k about an axis near the vertical, as lamps have it."""
    power, axis = float(np.exp(rng.uniform(0, np.log(900)))), (*rng.normal(0, 0.4, 2), 1.0)
    function = sl.cosine_power(power, axis)
    return Light(f"cos^{power:.3g}", function, given=function)


def even(rng):
    """A number."""
    return Light("even", float(rng.uniform(0.2, 4)))


# -- sources and scenes, lengths in spacings -----------------------------------------------------------------


def sky(rng, size):
    """(text, source, light): a sky of any kind; of some the features are named."""
    light = rng.choice(
        [suns, lambda rng: panorama(rng, True), panorama, stripes, glow, band, cie],
        p=[0.25, 0.2, 0.1, 0.1, 0.15, 0.1, 0.1],
    )(rng)
    named = light.given is None and light.features and rng.random() < 0.3
    named_suns = [tuple(f.axis) for f in light.features] if named else ()
    return f"sky: {light.text}{', named' * bool(named)}", sl.Sky(light.brightness, suns=named_suns), light


def given_to(light):
    """The brightness that a lamp or window of this light is given: a number where it can be one."""
    return light.brightness if light.features or light.given or callable(light.smooth) else light.smooth


def ball(rng, size):
    """(text, source, light): a sphere, near or far, high or low."""
    light = rng.choice([even, spot, stripes, panorama], p=[0.3, 0.4, 0.15, 0.15])(rng)
    away = np.exp(rng.uniform(*np.log([0.1, 4]))) * size
    turn, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(8, 90))
    center = size * rng.uniform(0.2, 0.8, 2) + away * np.cos(tilt) * np.array([np.cos(turn), np.sin(turn)])
    height = away * np.sin(tilt)
    radius = height * np.exp(rng.uniform(*np.log([0.003, 0.9])))
    at = f"{center[0] / size:.2f} {center[1] / size:.2f} {height / size:.2f}"
    text = f"lamp: at {at} radius {radius / size:.2g} {light.text}"
    return text, sl.Lamp((*center, -height), radius, given_to(light)), light


def panel(rng, size):
    """(text, source, light): a rectangle or a tube, level, upright or aslant."""
    light = rng.choice([even, spot, panorama], p=[0.5, 0.4, 0.1])(rng)
    long = size * np.exp(rng.uniform(*np.log([0.05, 1])))
    wide = long * rng.choice([rng.uniform(0.2, 1), 10 ** rng.uniform(-5, -1)])
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.5 else np.eye(3)
    one, other = long * frame[0], wide * frame[1]
    across = size * rng.uniform(0.1, 0.9, 2)
    depth = -size * np.exp(rng.uniform(*np.log([0.05, 1]))) - abs(one[2]) / 2 - abs(other[2]) / 2
    lamp = sl.Lamp(
        corner=tuple(np.array([*across, depth]) - (one + other) / 2),
        edges=(tuple(one), tuple(other)),
        brightness=given_to(light),
    )
    return f"panel: {long / size:.2g} x {wide:.2g} spacings {light.text}", lamp, light


def window(rng, size):
    """(text, source, light): a window or a slit, with a sun, lights or an even sky behind it."""
    light = rng.choice(
        [even, lambda rng: suns(rng, 3), lambda rng: panorama(rng, True), panorama], p=[0.3, 0.3, 0.2, 0.2]
    )(rng)
    low, wide = size * rng.uniform(0.05, 0.5, 2), size * rng.uniform(0.05, 0.5, 2)
    if rng.random() < 0.3:
        wide[rng.integers(2)] = 10 ** rng.uniform(-5, 0.5)
    x, y = ((a, a + b) for a, b in zip(low, wide))
    opening = sl.Window(x=x, y=y, brightness=given_to(light))
    return f"window: {wide[0]:.2g} x {wide[1]:.2g} spacings {light.text}", opening, light


def filtered_noise(rng, n, slope, power):
    """Heights (n, n) of this rms slope."""
    return -fractal(n, slope, power, int(rng.integers(2**31)))


def houses(rng, n, x, y, heaped=False):
    """Boxes of many heights; ``heaped``: one on the other where they overlap."""
    z = np.zeros((n, n))
    for _ in range(int(rng.integers(5, 80))):
        i, j, w, h = *rng.integers(0, n, 2), *rng.integers(3, 25, 2)
        z[i : i + h, j : j + w] = rng.uniform(2, 25) + (z[i : i + h, j : j + w] if heaped else 0)
    return z


def steps(rng, n, x, y):
    return houses(rng, n, x, y, heaped=True)


def maze(rng, n, x, y):
    cell = int(rng.integers(3, 9))
    walls = rng.random((n // cell + 1,) * 2) < rng.uniform(0.2, 0.6)
    return np.kron(walls, np.ones((cell, cell)))[:n, :n] * rng.uniform(1, 20)


def craters(rng, n, x, y):
    z = np.zeros((n, n))
    for _ in range(int(rng.integers(2, 30))):
        r, deep = rng.uniform(4, n / 5), rng.uniform(0.1, 0.5)
        q = np.hypot(x - rng.uniform(0, n), y - rng.uniform(0, n)) / r
        z += deep * r * (np.minimum(0, q**2 - 1) + 0.4 * np.exp(-((q - 1) ** 2) * 20))
    return z


def dunes(rng, n, x, y):
    turn = rng.uniform(0, np.pi)
    bend = rng.uniform(2, 8) * np.sin(y / rng.uniform(8, 30))
    at = (x * np.cos(turn) + y * np.sin(turn) + bend) / rng.uniform(6, 30) % 1
    return rng.uniform(2, 12) * np.where(at < 0.75, at / 0.75, (1 - at) / 0.25)


def ridges(rng, n, x, y):
    f = filtered_noise(rng, n, rng.uniform(0.2, 2), rng.uniform(1.8, 2.6))
    return -np.abs(2 * f - 2 * np.median(f))


def terraces(rng, n, x, y):
    step = rng.uniform(1, 10)
    return step * np.floor(filtered_noise(rng, n, rng.uniform(0.2, 1), 2.4) / step)


def spikes(rng, n, x, y):
    return np.where(rng.random((n, n)) < 10 ** rng.uniform(-3.5, -1.5), rng.uniform(2, 25), 0)


def trench(rng, n, x, y):
    inside = np.abs(x - rng.uniform(0.2, 0.8) * n) < rng.uniform(1, 6)
    return -np.where(inside, rng.uniform(3, 30), 0) + rng.uniform(-0.05, 0.05) * y


def valleys(rng, n, x, y):
    return rng.uniform(3, 20) * np.abs(np.sin(x / rng.uniform(6, 30) + np.sin(y / rng.uniform(15, 40))))


def coast(rng, n, x, y):
    f = filtered_noise(rng, n, rng.uniform(0.1, 1.5), rng.uniform(1.8, 2.6))
    return np.maximum(f, np.quantile(f, rng.uniform(0.2, 0.9)))


def noise(rng, n, x, y):
    return filtered_noise(rng, n, 10 ** rng.uniform(-2, 0.4), rng.uniform(1.5, 3))


def plain(rng, n, x, y):
    return rng.uniform(-0.5, 0.5) * x + rng.uniform(-0.5, 0.5) * y


GROUNDS = {  # heights (n, n) [spacing] of a generator, a size and the nodes' x and y
    "houses": houses,
    "maze": maze,
    "craters": craters,
    "dunes": dunes,
    "ridges": ridges,
    "terraces": terraces,
    "steps": steps,
    "spikes": spikes,
    "trench": trench,
    "valleys": valleys,
    "coast": coast,
    "fractal": noise,
    "plain": plain,
}
DRAWN = [*list(GROUNDS)[:-1], "fractal", "plain"]  # fractals twice as often


def height(rng, n):
    """(what, heights (n, n) [spacing])."""
    y, x = np.mgrid[:n, :n].astype(float)
    what = rng.choice(DRAWN)
    return what, GROUNDS[what](rng, n, x, y)


def scene(rng, n, sides, gap):
    """(what, scene): its top ``gap`` spacings below the viewer's plane; some are masked, some scaled."""
    what, z = height(rng, n)
    mask = None
    if rng.random() < 0.15:
        mask = np.ones((n, n), bool)
        for _ in range(4):
            i, j, h, w = *rng.integers(0, n, 2), *rng.integers(2, n // 3, 2)
            mask[i : i + h, j : j + w] = False
    spacing = 1.0 if rng.random() < 0.7 else float(10 ** rng.uniform(-3, 3))
    depth = spacing * (z.max() - z + gap)
    depth = depth if mask is None else np.where(mask, depth, np.nan)
    return what, sl.Scene(depth, spacing, mask=mask, sides=sides)


def pair(seed, number, size) -> tuple[str, sl.Scene, str, sources.Source, Light]:
    """Pair ``number`` of a seed, by itself.

    Returns what the ground is in a word, the scene, what the source is in words, the source and its light.
    """
    rng = np.random.default_rng([seed, number])
    make = rng.choice([sky, ball, panel, window], p=[0.55, 0.2, 0.1, 0.15])
    inner = make is not sky  # what a lamp outside a dark box lights, truth does not know
    sides = "open"
    if make is sky:
        sides = str(rng.choice(["open", "periodic", "dark"], p=[0.7, 0.15, 0.15]))
    elif make is window and rng.random() < 0.15:
        sides = "dark"
    what, ground = scene(rng, size, sides, rng.uniform(0.2, 0.3 * size) if inner or sides == "dark" else 0.0)
    text, source, light = make(rng, size)
    return what, ground, text, in_length(source, ground.spacing), light


# -- truth ---------------------------------------------------------------------------------------------------


def cap(azimuth, elevation, radius, count):
    """Slices through a disc of the sky: azimuth, width, lowest and highest elevation, all (count, nodes)."""
    share = (np.arange(count)[:, None] + 0.5) / count
    all_round = radius >= np.pi / 2 - np.abs(elevation)
    widest = np.arcsin(np.minimum(1, np.sin(radius) / np.maximum(np.cos(elevation), 1e-300)))
    turn = np.where(all_round, 2 * np.pi * share, widest * np.sin(np.pi * (share - 0.5)))
    width = np.where(all_round, 2 * np.pi / count, widest * np.cos(np.pi * (share - 0.5)) * np.pi / count)
    a, b = np.cos(elevation) * np.cos(turn), np.sin(elevation)
    reach = np.cos(radius) / np.maximum(np.hypot(a, b), 1e-300)
    half = np.where(reach <= 1, np.arccos(np.clip(reach, -1, 1)), 0.0)
    middle = np.arctan2(b, a)
    return azimuth + turn, width, np.where(half > 0, middle - half, 2.0), np.minimum(middle + half, np.pi / 2)


def visible(samples, azimuth, low, high, **before):
    """Elevations (lowest, highest) between which the sky shows at the nodes; ``before``: up to a solid."""
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    free = samples.free(cosine, sine) if not before else np.maximum(0, samples.plane(cosine, sine))
    least = np.maximum(np.tan(np.clip(low, 0, 1.57079)), free)
    shape = np.broadcast_shapes(least.shape, cosine.shape)
    slope = samples.slopes(cosine, sine, np.broadcast_to(least, shape), **before)
    return np.arctan(np.where(slope <= least.astype(np.float32), least, slope)), high


def through_window(samples, bounds, azimuth, low, high):
    """Elevations cut by a window (x0, x1, y0, y1) in the plane z = 0."""
    if bounds is None:
        return low, high
    x0, x1, y0, y1 = bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [
            np.sort([(a - at) / way, (b - at) / way], 0)
            for a, b, at, way in ((x0, x1, samples.x, np.cos(azimuth)), (y0, y1, samples.y, np.sin(azimuth)))
        ]
        near, far = np.maximum(0, np.fmax(ends[0][0], ends[1][0])), np.fmin(ends[0][1], ends[1][1])
        shut = (near >= far) | (samples.own >= 0)
        return np.where(shut, 2.0, np.maximum(low, np.arctan2(-samples.own, far))), np.minimum(
            high, np.arctan2(-samples.own, near)
        )


def integrals_of(light, azimuth, width, low, high, cells, within):
    """Integrals of light cos^2 and light sin cos from ``low`` to any elevation, as a function of it.

    azimuth, width, low and high are (K, 1). Brightness is constant in each of ``cells`` cells of elevation:
    the mean of ``within`` places across the width.
    """
    edges = low + (high - low) * np.arange(cells + 1) / cells
    middle = np.sin((edges[:, 1:] + edges[:, :-1]) / 2)
    places = [azimuth + width * ((n + 0.5) / within - 0.5) for n in range(within)]
    values = sum(light(sources.directions_of(place, middle)) for place in places) / within
    begun = primitives(edges)
    zero, row = np.zeros((len(azimuth), 1)), np.arange(len(azimuth))[:, None]
    sums = [np.concatenate([zero, np.cumsum(values * np.diff(e), 1)], 1) for e in begun]

    def until(e):
        at = np.clip((e - low) / np.maximum(high - low, 1e-12) * cells, 0, cells)
        cell = np.minimum(at.astype(int), cells - 1)
        return [
            total[row, cell] + values[row, cell] * (to - start[row, cell])
            for total, to, start in zip(sums, primitives(e), begun)
        ]

    return until


def part_of_sky(samples, light, azimuth, width, low, high, cells, bounds=None, within=1):
    """Irradiance (nodes,) of what ``light`` holds between elevations low and high (K,) at azimuths (K,)."""
    total = np.zeros(len(samples))
    for some in np.array_split(np.arange(len(azimuth)), max(1, len(azimuth) // 360)):
        a, w, least, most = (v[some, None] for v in (azimuth, width, low, high))
        begin, end = through_window(samples, bounds, a, *visible(samples, a, least, most))
        begin, end = np.clip(begin, least, most), np.clip(end, least, most)
        tilt = (samples.gx * np.cos(a) + samples.gy * np.sin(a)) / samples.length
        until = integrals_of(light, a, w, least, most, cells, within) if callable(light) else primitives
        c, s = (v - u for u, v in zip(until(begin), until(end)))
        lit = w * np.where(begin < end, tilt * c + s / samples.length, 0)
        total += lit.sum(0) * (1.0 if callable(light) else light)
    return total


def of_features(samples, light, density, bounds=None):
    """What discs, glows and bands give."""
    total = np.zeros(len(samples))
    count = AZIMUTHS * density
    turn, step = 2 * np.pi * (np.arange(count) + 0.31) / count, np.full(count, 2 * np.pi / count)
    for low, high, value in light.bands:
        ends = np.full(count, low), np.full(count, high)
        total += part_of_sky(samples, value, turn, step, *ends, 1, bounds)
    for f in light.features:
        elevation = np.arcsin(-f.axis[2])
        round_zenith = elevation + f.radius >= np.pi / 2
        count = NARROW * density * (4 if round_zenith else 1)
        found = cap(np.arctan2(f.axis[1], f.axis[0]), elevation, f.radius, count)
        azimuth, width, low, high = (np.broadcast_to(v, found[0].shape)[:, 0] for v in found)
        ends = np.clip(low, 0, np.pi / 2), np.clip(high, 0, np.pi / 2)
        total += part_of_sky(samples, f.light, azimuth, width, *ends, NARROW_CELLS * density, bounds)
    return total


def of_ball(samples, solid, count):
    """Slices through a ball: as of :func:`cap`, and what stands before it."""
    to = [c - at for c, at in zip(solid.center, (samples.x, samples.y, samples.own.astype(float)))]
    flat = np.hypot(to[0], to[1])
    far = np.hypot(flat, to[2])
    azimuth = np.arctan2(to[1], to[0])
    found = cap(azimuth, np.arctan2(to[2], flat), np.arcsin(np.minimum(1, solid.radius / far)), count)
    return *found, {
        "along": flat * np.cos(found[0] - azimuth),
        "up": to[2],
        "limit": far**2 - solid.radius**2,
    }


def of_quad(samples, solid, count):
    """The same of a quadrangle, sector by sector between its corners' azimuths."""
    corners = np.asarray(solid.corners, float)
    to = corners[:, :, None] - np.stack([samples.x, samples.y, samples.own]).astype(float)
    turn = [to[i, 0] * to[(i + 1) % 4, 1] - to[i, 1] * to[(i + 1) % 4, 0] for i in range(4)]
    over = (np.min(turn, 0) > 0) | (np.max(turn, 0) < 0)
    base = np.where(over, 0, np.arctan2(to[:, 1].mean(0), to[:, 0].mean(0)))
    ends = np.sort((np.arctan2(to[:, 1], to[:, 0]) - base + np.pi) % (2 * np.pi) - np.pi, 0)
    ends = np.concatenate([ends, np.where(over, ends[:1] + 2 * np.pi, ends[3:])])
    per = count // 4
    even = np.pi * (np.arange(per)[:, None] + 0.5) / per
    share, weight = 0.5 - 0.5 * np.cos(even), np.pi / 2 * np.sin(even) / per  # dense at the corners
    azimuth = np.concatenate([base + ends[i] + (ends[i + 1] - ends[i]) * share for i in range(4)])
    width = np.concatenate([(ends[i + 1] - ends[i]) * weight for i in range(4)])
    c, s = np.cos(azimuth), np.sin(azimuth)
    found = []
    for i in range(4):
        a, b = to[i], to[(i + 1) % 4]
        aside = [c * v[1] - s * v[0] for v in (a, b)]
        with np.errstate(divide="ignore", invalid="ignore"):
            p = a[:, None] + aside[0] / (aside[0] - aside[1]) * (b - a)[:, None]
            away = c * p[0] + s * p[1]
            found.append(np.where((aside[0] * aside[1] <= 0) & (away > 0), np.arctan2(p[2], away), np.nan))
    low, high = np.fmin.reduce(found), np.fmax.reduce(found)
    rises = to[:, 2].mean(0) > 0
    low, high = np.where(over & ~rises, -np.pi / 2, low), np.where(over & rises, np.pi / 2, high)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    normal /= np.linalg.norm(normal)
    apart = np.einsum("i,in->n", normal, to.mean(0))
    sense = np.where(apart < 0, -1, 1)
    hit = np.isfinite(low) & np.isfinite(high)
    return (
        azimuth,
        width,
        np.where(hit, low, 2.0),
        np.where(hit, high, 1.0),
        {"along": sense * (normal[0] * c + normal[1] * s), "up": sense * normal[2], "limit": sense * apart},
    )


def through_solid(samples, solid, light, density):
    """Irradiance (nodes,) by a lamp or window: its chord in every slice, brightness at POINTS of it."""
    slices = of_quad if hasattr(solid, "corners") else of_ball
    azimuth, width, low, high, before = slices(samples, solid, SLICES * density)
    total, points = np.zeros(len(samples)), POINTS * density if callable(light) else 1
    for some in np.array_split(np.arange(len(azimuth)), 8 * density):
        a, w, least, most = (v[some] for v in (azimuth, width, low, high))
        limits = {k: np.broadcast_to(v, azimuth.shape)[some] for k, v in before.items()}
        begin, end = visible(samples, a, least, most, **limits)
        n, node = np.nonzero(begin < end)
        a, w, begin, end = (v[n, node] for v in (a, w, begin, end))
        tilt = (samples.gx[node] * np.cos(a) + samples.gy[node] * np.sin(a)) / samples.length[node]
        for p in range(points):
            edge = begin + (end - begin) * p / points, begin + (end - begin) * (p + 1) / points
            c, s = (v - u for u, v in zip(*map(primitives, edge)))
            value = light
            if callable(light):
                middle, half = (edge[0] + edge[1]) / 2, (edge[1] - edge[0]) / 2
                places = (np.sin(middle + sign * half / 3**0.5) for sign in (-1, 1))
                value = sum(light(sources.directions_of(a, sine)) for sine in places) / 2
            total += np.bincount(node, w * value * (tilt * c + s / samples.length[node]), len(total))
    return total


def is_thin(solid, share=0.02):
    """Whether a solid is a quadrangle that is far longer than wide."""
    if not hasattr(solid, "corners"):
        return False
    sides = [np.linalg.norm(solid.corners[n] - solid.corners[0]) for n in (1, 3)]
    return min(sides) < share * max(sides)


def chord_of(line, to, axis, radius):
    """Between which places on a line it lies within ``radius`` [rad] of ``axis``, (nodes,) each.

    ``line``: unit vector; ``to`` (3, nodes): to the place 0 on it. Nowhere: the first is not below the last.
    """
    along, own = line @ axis, axis @ to
    square, at = np.cos(radius) ** 2, line @ to
    a, b, c = along**2 - square, along * own - square * at, own**2 - square * (to**2).sum(0)
    root = b * b - a * c
    with np.errstate(invalid="ignore"):
        ends = np.sort([(-b - np.sqrt(root)) / a, (-b + np.sqrt(root)) / a], 0)
    if a > 0:  # the line runs into the disc
        return (ends[1], np.full_like(own, np.inf)) if along > 0 else (np.full_like(own, -np.inf), ends[0])
    met = (root > 0) & (own + along * ends.mean(0) > 0)
    return np.where(met, ends[0], 0.0), np.where(met, ends[1], 0.0)


def along_line(samples, begin, end, area, light, axis, radius, points, shift):
    """Irradiance (nodes,) by ``light`` within ``radius`` of ``axis`` through the line from begin to end.

    ``area``: vector, normal to the source, as long as the line's area over its length. One exact ray to each
    of ``points``, in even steps of the angle at the node, the first at ``shift`` [step].
    """
    length = np.linalg.norm(end - begin)
    line = (end - begin) / length
    to = begin[:, None] - np.stack([samples.x, samples.y, samples.own]).astype(float)
    first, last = np.zeros(len(samples)), np.full(len(samples), length)
    if axis is not None:
        first, last = (np.clip(v, 0, length) for v in chord_of(line, to, axis * (1, 1, -1), radius))
    foot = -(line @ to)
    away = np.maximum(np.sqrt(np.maximum(0, (to**2).sum(0) - foot**2)), 1e-9)
    first, last = np.arctan2(first - foot, away), np.arctan2(last - foot, away)
    lit, total = np.flatnonzero(last > first), np.zeros(len(samples))
    for some in np.array_split(np.arange(points), max(1, points * len(lit) // LINE_RAYS)):
        angle = first[lit] + (last - first)[lit] * (some[:, None] + shift) / points
        place = foot[lit] + away[lit] * np.tan(angle)
        way = to[:, None, lit] + line[:, None, None] * place
        reach = np.sqrt((way**2).sum(0))
        flat = np.maximum(np.hypot(way[0], way[1]), 1e-9)
        cosine = (samples.gx[lit] * way[0] + samples.gy[lit] * way[1] + way[2]) / samples.length[lit] / reach
        facing = np.abs(np.tensordot(area, way, 1)) / reach
        direction = np.stack([way[0], way[1], -np.maximum(way[2], 0)], -1) / reach[..., None]
        value = light(direction) if callable(light) else light
        value = value * np.maximum(0, cosine) * facing * (last - first)[lit] / points / away[lit]
        c, s, slope = way[0] / flat, way[1] / flat, way[2] / flat
        least = np.clip(slope * (1 - 1e-6), 0, STEEP)
        ground = samples.slopes(c, s, least, np.ones_like(c), 0.0, flat, node=lit)  # before the source
        clear = ground <= np.maximum(least, slope).astype(np.float32)
        total[lit] += np.where(clear & (way[2] > 0), value, 0.0).sum(0)
    return total


def through_line(samples, solid, light, density):
    """Irradiance (nodes,) by a slit or tube: strips of it, as lines, and what each feature is seen through.

    Rays that are even in azimuth, or the oracle's that are even along a slit, met a small light behind it too
    seldom: with 131,072 of the latter, three suns behind a slit were wrong by 0.6 % of the mean.
    """
    corners, count = np.asarray(solid.corners, float), LINE_STRIPS * density
    along, across = sorted([corners[1] - corners[0], corners[3] - corners[0]], key=np.linalg.norm)[::-1]
    area = np.cross(along, across) / np.linalg.norm(along) / count
    total = np.zeros(len(samples))
    for n in range(count):
        begin = corners[0] + across * (n + 0.5) / count
        lights = [(light.smooth, None, 0.0), *((f.light, f.axis, f.radius) for f in light.features)]
        for part in lights:
            shift = 0.6180339887498949 * (n + 1) % 1
            total += along_line(samples, begin, begin + along, area, *part, LINE_POINTS * density, shift)
    return total


def truth(samples, scene, source, light, density=1):
    """Irradiance (nodes,) of a pair at the samples; ``density``: times as many azimuths, slices and cells."""
    if isinstance(source, sl.Sky):
        count = AZIMUTHS * density
        azimuth, width = 2 * np.pi * (np.arange(count) + 0.31) / count, np.full(count, 2 * np.pi / count)
        low, high = np.zeros(count), np.full(count, np.pi / 2)
        smooth = part_of_sky(samples, light.smooth, azimuth, width, low, high, CELLS * density, within=WITHIN)
        return of_features(samples, light, density) + smooth
    solid = upright(solid_of(scene, source))
    if is_thin(solid, LINE_SHARE):
        return through_line(samples, solid, light, density)
    bounds = None
    if isinstance(source, sl.Window):
        bounds = (*np.array(source.x) / scene.spacing, *np.array(source.y) / scene.spacing)
    if callable(light.smooth) or light.features:
        density *= THIN_DENSITY if is_thin(solid) else 1
    total = through_solid(samples, solid, light.smooth, density)
    return total + of_features(samples, light, density, bounds) if light.features else total
