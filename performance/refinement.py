"""Whether render(tolerance=...) keeps its word, and whether it knows by how much it errs: fresh random pairs
of scene and source every run.

    python performance/refinement.py --out docs [--pairs 150] [--size 192] [--seed N] [--only N] [--backend
    opencl] [--times]

Nothing can be tuned to these: the seed comes from the operating system unless given, and is printed. Truth is
brute force that shares no table with the library: exact rays at NODES nodes that no choice has seen, AZIMUTHS
evenly, and more through everything narrow; every source is made here, of a smooth part that is evaluated
densely along the elevation and of features (suns, lights, glows) that are known by where they stand and
integrated each within its own bounds, in closed form where it is evenly bright. Of some pairs truth is found
twice, the second time twice as densely; the difference is its error. Writes refinement.csv, with machine,
versions, seed and date in its first line, and refinement.png. With --times also the time over that of the
cheapest setting that would have done, found by trying all, in turns.
"""

import argparse
import csv
import os
import platform
import re
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from plans import TOLERANCES, fractal, in_length, off, side_by_side, tried

import skylamp as sl
from skylamp import sources
from skylamp.backends import select
from skylamp.refinement import solid_of, upright
from skylamp.samples import Samples
from skylamp.sources.cie import SUN_RADIUS, towards

NODES = 400
AZIMUTHS, CELLS, WITHIN = (
    1440,
    1024,
    4,
)  # of the smooth part of a sky: azimuths, cells of elevation, places of azimuth at which brightness is taken
NARROW, NARROW_CELLS = 192, 256  # of a feature
SLICES, POINTS = 1024, 64  # of a lamp or window
COLOURS = {
    "unoccluded": "#009E73",
    "horizon": "#0072B2",
    "slices": "#E69F00",
    "lattice": "#CC79A7",
}  # Okabe and Ito
along_up = lambda e: (
    e / 2 + np.sin(2 * e) / 4,
    np.sin(e) ** 2 / 2,
)  # integrals of cos^2 and of sin cos from level


# -- brightness ----------------------------------------------------------------------------------------------


@dataclass
class Feature:
    """What a sky holds within ``radius`` [rad] of ``axis``: a number where it is evenly bright, else a
    function.
    """

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
    return sources.directions_of(azimuth, np.sin(elevation))


def suns(rng, most=10):
    """A uniform or overcast sky with discs that give most of the light, some low, some at the zenith."""
    count, share = int(rng.integers(1, most + 1)), rng.uniform(0.3, 0.9)
    features = []
    for _ in range(count):
        elevation = np.radians(rng.choice([rng.uniform(1, 90), rng.uniform(0.5, 12), 90], p=[0.7, 0.2, 0.1]))
        radius = np.radians(np.exp(rng.uniform(*np.log([0.1, 5]))))
        features.append(
            Feature(
                axis_of(rng.uniform(0, 2 * np.pi), elevation),
                radius,
                share
                / (1 - share)
                * rng.uniform(0.3, 1)
                / count
                / (np.sin(radius) ** 2 * max(0.1, np.sin(elevation))),
            )
        )
    smooth = 1.0 if rng.random() < 0.6 else sl.cie_overcast()
    text = " ".join(f"{np.degrees(f.radius):.2g}@{np.degrees(np.arcsin(-f.axis[2])):.2g}" for f in features)
    return Light(
        f"{count} suns (radius@elevation) {text} share {share:.2f} over"
        f" {'1' if smooth == 1.0 else 'overcast'}",
        smooth,
        tuple(features),
    )


def panorama(rng, lights=False):
    """An environment map of noise, or an even one with small lights, one pixel each, interpolated."""
    rows = int(rng.choice([16, 32, 64, 128]))
    base = (
        rng.gamma(rng.uniform(0.3, 2), size=(rows, 2 * rows))
        if not lights
        else np.full((rows, 2 * rows), 0.2)
    )
    if not lights:
        return Light(f"panorama {rows}", sl.environment_map(base), given=sl.environment_map(base))
    image, features = base.copy(), []
    for _ in range(int(rng.integers(1, 9))):
        row, col = int(rows * rng.uniform(0.06, 0.49)), int(rng.integers(2 * rows))
        one = np.zeros_like(base)
        one[row, col] = rng.uniform(0.3, 1) * 40 * (rows / 16) ** 2
        image += one
        features.append(
            Feature(
                axis_of((col + 0.5) * np.pi / rows, np.pi / 2 - (row + 0.5) * np.pi / rows),
                1.5 * np.pi / rows,
                sl.environment_map(one),
            )
        )
    return Light(
        f"map {rows} with {len(features)} lights",
        sl.environment_map(base),
        tuple(features),
        given=sl.environment_map(image),
    )


def stripes(rng):
    """Meridians, sharp or soft."""
    count, turn, sharp = int(rng.integers(2, 19)), rng.uniform(0, 2 * np.pi), rng.choice([1.0, 5.0, 1e9])
    return Light(
        f"{count} stripes sharpness {sharp:g}",
        lambda L: 0.05 + np.clip(0.5 + sharp * np.sin(count * np.arctan2(L[..., 1], L[..., 0]) + turn), 0, 1),
    )


def glow(rng):
    """A lobe cos^k on an even sky."""
    power, axis = (
        float(np.exp(rng.uniform(*np.log([2, 900])))),
        axis_of(rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(3, 90))),
    )
    height = rng.uniform(0.2, 3) * power
    lobe = lambda L: height * np.maximum(0, L @ axis) ** power
    text = f"glow cos^{power:.3g} height {height:.3g} at {np.degrees(np.arcsin(-axis[2])):.2g}"
    return (
        Light(text, 1.0, (Feature(axis, 6.5 / np.sqrt(power), lobe),))
        if power > 60
        else Light(text, lambda L: 1 + lobe(L))
    )


def band(rng):
    """A sharp bright band above the horizon."""
    low = np.radians(rng.choice([0, rng.uniform(0, 40)]))
    high = low + np.radians(np.exp(rng.uniform(*np.log([1, 20]))))
    light = rng.uniform(1, 20) / (high - low)
    return Light(
        f"band {np.degrees(low):.2g}..{np.degrees(high):.2g} x {light:.3g}", 1.0, bands=((low, high, light),)
    )


def cie(rng):
    """A CIE sky with the sun's disc."""
    sun, kind = (rng.uniform(0, 360), rng.uniform(2, 88)), int(rng.choice([7, 9, 12, 13, 15]))
    sky = sl.cie_sky(kind, sun, horizontal=1.0, direct=rng.uniform(0.3, 6))
    disc = Feature(
        towards(*sun), np.radians(SUN_RADIUS), sky.direct / (np.pi * np.sin(np.radians(SUN_RADIUS)) ** 2)
    )
    return Light(
        f"cie {kind} sun at {sun[1]:.2g} direct {sky.direct:.2g}",
        replace(sky, direct=0.0),
        (disc,),
        given=sky,
    )


def spot(rng):
    power, axis = float(np.exp(rng.uniform(0, np.log(900)))), (*rng.normal(0, 0.4, 2), 1.0)
    function = sl.cosine_power(power, axis)
    return Light(f"cos^{power:.3g}", function, given=function)


def even(rng):
    return Light("even", float(rng.uniform(0.2, 4)))


# -- sources and scenes, lengths in spacings -----------------------------------------------------------------


def sky(rng, size):
    light = rng.choice(
        [suns, lambda rng: panorama(rng, True), panorama, stripes, glow, band, cie],
        p=[0.25, 0.2, 0.1, 0.1, 0.15, 0.1, 0.1],
    )(rng)
    named = light.given is None and light.features and rng.random() < 0.3
    return (
        f"sky: {light.text}{', named' * bool(named)}",
        sl.Sky(light.brightness, suns=[tuple(f.axis) for f in light.features] if named else ()),
        light,
    )


def ball(rng, size):
    light = rng.choice([even, spot, stripes, panorama], p=[0.3, 0.4, 0.15, 0.15])(rng)
    away = np.exp(rng.uniform(*np.log([0.1, 4]))) * size
    turn, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(8, 90))
    center = size * rng.uniform(0.2, 0.8, 2) + away * np.cos(tilt) * np.array([np.cos(turn), np.sin(turn)])
    height = away * np.sin(tilt)
    radius = height * np.exp(rng.uniform(*np.log([0.003, 0.9])))
    return (
        (
            f"lamp: at {center[0] / size:.2f} {center[1] / size:.2f} {height / size:.2f} radius"
            f" {radius / size:.2g} {light.text}"
        ),
        sl.Lamp(
            (*center, -height),
            radius,
            light.brightness if light.given or callable(light.smooth) else light.smooth,
        ),
        light,
    )


def panel(rng, size):
    """A rectangle or a tube, level, upright or aslant."""
    light = rng.choice([even, spot, panorama], p=[0.5, 0.4, 0.1])(rng)
    long = size * np.exp(rng.uniform(*np.log([0.05, 1])))
    wide = long * rng.choice([rng.uniform(0.2, 1), 10 ** rng.uniform(-5, -1)])
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.5 else np.eye(3)
    one, other = long * frame[0], wide * frame[1]
    middle = np.array(
        [
            *size * rng.uniform(0.1, 0.9, 2),
            -size * np.exp(rng.uniform(*np.log([0.05, 1]))) - abs(one[2]) / 2 - abs(other[2]) / 2,
        ]
    )
    return (
        f"panel: {long / size:.2g} x {wide:.2g} spacings {light.text}",
        sl.Lamp(
            corner=tuple(middle - (one + other) / 2),
            edges=(tuple(one), tuple(other)),
            brightness=light.brightness if light.given or callable(light.smooth) else light.smooth,
        ),
        light,
    )


def window(rng, size):
    """A window or a slit, with a sun, lights or an even sky behind it."""
    light = rng.choice(
        [even, lambda rng: suns(rng, 3), lambda rng: panorama(rng, True), panorama], p=[0.3, 0.3, 0.2, 0.2]
    )(rng)
    low, wide = size * rng.uniform(0.05, 0.5, 2), size * rng.uniform(0.05, 0.5, 2)
    if rng.random() < 0.3:
        wide[rng.integers(2)] = 10 ** rng.uniform(-5, 0.5)
    return (
        f"window: {wide[0]:.2g} x {wide[1]:.2g} spacings {light.text}",
        sl.Window(
            x=(low[0], low[0] + wide[0]),
            y=(low[1], low[1] + wide[1]),
            brightness=(
                light.brightness if light.features or light.given or callable(light.smooth) else light.smooth
            ),
        ),
        light,
    )


def height(rng, n):
    """(what, heights (n, n) [spacing])."""
    y, x = np.mgrid[:n, :n].astype(float)
    rough = lambda slope, power: -fractal(n, slope, power, int(rng.integers(2**31)))
    what, z = (
        rng.choice(
            [
                "houses",
                "maze",
                "craters",
                "dunes",
                "ridges",
                "terraces",
                "steps",
                "spikes",
                "trench",
                "valleys",
                "coast",
                "fractal",
                "fractal",
                "plain",
            ]
        ),
        np.zeros((n, n)),
    )
    if what in ("houses", "steps"):
        for _ in range(int(rng.integers(5, 80))):
            i, j, w, h = *rng.integers(0, n, 2), *rng.integers(3, 25, 2)
            z[i : i + h, j : j + w] = rng.uniform(2, 25) + (z[i : i + h, j : j + w] if what == "steps" else 0)
    elif what == "maze":
        cell = int(rng.integers(3, 9))
        z = np.kron(rng.random((n // cell + 1,) * 2) < rng.uniform(0.2, 0.6), np.ones((cell, cell)))[
            :n, :n
        ] * rng.uniform(1, 20)
    elif what == "craters":
        for _ in range(int(rng.integers(2, 30))):
            r, deep = rng.uniform(4, n / 5), rng.uniform(0.1, 0.5)
            q = np.hypot(x - rng.uniform(0, n), y - rng.uniform(0, n)) / r
            z += deep * r * (np.minimum(0, q**2 - 1) + 0.4 * np.exp(-((q - 1) ** 2) * 20))
    elif what == "dunes":
        at = (
            (
                x * np.cos(t := rng.uniform(0, np.pi))
                + y * np.sin(t)
                + rng.uniform(2, 8) * np.sin(y / rng.uniform(8, 30))
            )
            / rng.uniform(6, 30)
            % 1
        )
        z = rng.uniform(2, 12) * np.where(at < 0.75, at / 0.75, (1 - at) / 0.25)
    elif what == "ridges":
        z = -np.abs(2 * (f := rough(rng.uniform(0.2, 2), rng.uniform(1.8, 2.6))) - 2 * np.median(f))
    elif what == "terraces":
        z = (step := rng.uniform(1, 10)) * np.floor(rough(rng.uniform(0.2, 1), 2.4) / step)
    elif what == "spikes":
        z = np.where(rng.random((n, n)) < 10 ** rng.uniform(-3.5, -1.5), rng.uniform(2, 25), 0)
    elif what == "trench":
        z = (
            -np.where(np.abs(x - rng.uniform(0.2, 0.8) * n) < rng.uniform(1, 6), rng.uniform(3, 30), 0)
            + rng.uniform(-0.05, 0.05) * y
        )
    elif what == "valleys":
        z = rng.uniform(3, 20) * np.abs(np.sin(x / rng.uniform(6, 30) + np.sin(y / rng.uniform(15, 40))))
    elif what == "coast":
        f = rough(rng.uniform(0.1, 1.5), rng.uniform(1.8, 2.6))
        z = np.maximum(f, np.quantile(f, rng.uniform(0.2, 0.9)))
    elif what == "fractal":
        z = rough(10 ** rng.uniform(-2, 0.4), rng.uniform(1.5, 3))
    else:
        z = rng.uniform(-0.5, 0.5) * x + rng.uniform(-0.5, 0.5) * y
    return what, z


def scene(rng, n, sides, gap):
    what, z = height(rng, n)
    mask = None
    if rng.random() < 0.15:
        mask = np.ones((n, n), bool)
        for _ in range(4):
            i, j, h, w = *rng.integers(0, n, 2), *rng.integers(2, n // 3, 2)
            mask[i : i + h, j : j + w] = False
    spacing = 1.0 if rng.random() < 0.7 else float(10 ** rng.uniform(-3, 3))
    depth = spacing * (z.max() - z + gap)
    return what, sl.Scene(
        depth if mask is None else np.where(mask, depth, np.nan), spacing, mask=mask, sides=sides
    )


def pair(seed, number, size) -> tuple[str, sl.Scene, str, sources.Source, Light]:
    """Pair ``number`` of a seed, by itself."""
    rng = np.random.default_rng([seed, number])
    make = rng.choice([sky, ball, panel, window], p=[0.55, 0.2, 0.1, 0.15])
    inner = make is not sky  # what a lamp outside a dark box lights, truth does not know
    sides = (
        str(rng.choice(["open", "periodic", "dark"], p=[0.7, 0.15, 0.15]))
        if make is sky
        else "dark"
        if make is window and rng.random() < 0.15
        else "open"
    )
    what, ground = scene(rng, size, sides, rng.uniform(0.2, 0.3 * size) if inner or sides == "dark" else 0.0)
    text, source, light = make(rng, size)
    return what, ground, text, in_length(source, ground.spacing), light


# -- truth ---------------------------------------------------------------------------------------------------


def cap(azimuth, elevation, radius, count):
    """Slices through a disc of the sky (nodes,): azimuth, its width, lowest and highest elevation (count,
    nodes).
    """
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
    """Elevations (lowest, highest) between which the sky shows at the nodes; what is named by ``before``
    stands in front.
    """
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    least = np.maximum(
        np.tan(np.clip(low, 0, 1.57079)),
        samples.free(cosine, sine) if not before else np.maximum(0, samples.plane(cosine, sine)),
    )
    slope = samples.slopes(
        cosine, sine, np.broadcast_to(least, np.broadcast_shapes(least.shape, cosine.shape)), **before
    )
    return np.arctan(np.where(slope <= least.astype(np.float32), least, slope)), high


def through(samples, bounds, azimuth, low, high):
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


def part_of_sky(samples, light, azimuth, width, low, high, cells, bounds=None, within=1):
    """Irradiance (nodes,) of what ``light`` holds between elevations low and high (K,) at azimuths (K,)."""
    total = np.zeros(len(samples))
    for some in np.array_split(np.arange(len(azimuth)), max(1, len(azimuth) // 360)):
        a, w, l, h = (v[some, None] for v in (azimuth, width, low, high))
        begin, end = through(samples, bounds, a, *visible(samples, a, l, h))
        begin, end = np.clip(begin, l, h), np.clip(end, l, h)
        tilt = (samples.gx * np.cos(a) + samples.gy * np.sin(a)) / samples.length
        if not callable(light):
            c, s = (v - u for u, v in zip(along_up(begin), along_up(end)))
        else:
            edges = l + (h - l) * np.arange(cells + 1) / cells
            middle = (edges[:, 1:] + edges[:, :-1]) / 2
            values = (
                sum(
                    light(sources.directions_of(a + w * ((n + 0.5) / within - 0.5), np.sin(middle)))
                    for n in range(within)
                )
                / within
            )
            sums = [
                np.concatenate([np.zeros((len(a), 1)), np.cumsum(values * np.diff(e), 1)], 1)
                for e in along_up(edges)
            ]

            def until(e):
                at = np.clip((e - l) / np.maximum(h - l, 1e-12) * cells, 0, cells)
                cell, row = np.minimum(at.astype(int), cells - 1), np.arange(len(a))[:, None]
                return [
                    v[row, cell] + values[row, cell] * (to - begun[row, cell])
                    for v, to, begun in zip(sums, along_up(e), along_up(edges))
                ]

            c, s = (v - u for u, v in zip(until(begin), until(end)))
        shows = begin < end
        total += (w * np.where(shows, tilt * c + s / samples.length, 0)).sum(0) * (
            1.0 if callable(light) else light
        )
    return total


def of_features(samples, light, density, bounds=None):
    """What discs, glows and bands give."""
    total = np.zeros(len(samples))
    turn = 2 * np.pi * (np.arange(AZIMUTHS * density) + 0.31) / (AZIMUTHS * density)
    for low, high, value in light.bands:
        total += part_of_sky(
            samples,
            value,
            turn,
            np.full(len(turn), 2 * np.pi / len(turn)),
            np.full(len(turn), low),
            np.full(len(turn), high),
            1,
            bounds,
        )
    for f in light.features:
        elevation, round_zenith = np.arcsin(-f.axis[2]), np.arcsin(-f.axis[2]) + f.radius >= np.pi / 2
        found = cap(
            np.arctan2(f.axis[1], f.axis[0]),
            elevation,
            f.radius,
            NARROW * density * (4 if round_zenith else 1),
        )
        azimuth, width, low, high = (np.broadcast_to(v, found[0].shape)[:, 0] for v in found)
        total += part_of_sky(
            samples,
            f.light,
            azimuth,
            width,
            np.clip(low, 0, np.pi / 2),
            np.clip(high, 0, np.pi / 2),
            NARROW_CELLS * density,
            bounds,
        )
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
    share, per = (np.arange(count // 4)[:, None] + 0.5) / (count // 4), count // 4
    share, weight = (
        0.5 - 0.5 * np.cos(np.pi * share),
        np.pi / 2 * np.sin(np.pi * share) / per,
    )  # dense at the corners
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
    azimuth, width, low, high, before = (of_quad if hasattr(solid, "corners") else of_ball)(
        samples, solid, SLICES * density
    )
    total, points = np.zeros(len(samples)), POINTS * density if callable(light) else 1
    for some in np.array_split(np.arange(len(azimuth)), 8 * density):
        a, w, l, h = (v[some] for v in (azimuth, width, low, high))
        begin, end = visible(
            samples, a, l, h, **{k: np.broadcast_to(v, azimuth.shape)[some] for k, v in before.items()}
        )
        n, node = np.nonzero(begin < end)
        a, w, begin, end = (v[n, node] for v in (a, w, begin, end))
        tilt = (samples.gx[node] * np.cos(a) + samples.gy[node] * np.sin(a)) / samples.length[node]
        for p in range(points):
            edge = begin + (end - begin) * p / points, begin + (end - begin) * (p + 1) / points
            c, s = (v - u for u, v in zip(*map(along_up, edge)))
            value = (
                light(sources.directions_of(a, np.sin((edge[0] + edge[1]) / 2))) if callable(light) else light
            )
            total += np.bincount(node, w * value * (tilt * c + s / samples.length[node]), len(total))
    return total


def truth(samples, scene, source, light, density=1):
    """Irradiance (nodes,), see above."""
    if isinstance(source, sl.Sky):
        count = AZIMUTHS * density
        turn = 2 * np.pi * (np.arange(count) + 0.31) / count
        return of_features(samples, light, density) + part_of_sky(
            samples,
            light.smooth,
            turn,
            np.full(count, 2 * np.pi / count),
            np.zeros(count),
            np.full(count, np.pi / 2),
            CELLS * density,
            within=WITHIN,
        )
    solid = upright(solid_of(scene, source, 1 / scene.spacing, 1.0))
    bounds = (
        (*np.array(source.x) / scene.spacing, *np.array(source.y) / scene.spacing)
        if isinstance(source, sl.Window)
        else None
    )
    return through_solid(samples, solid, light.smooth, density) + (
        of_features(samples, light, density, bounds) if light.features else 0
    )


# -- measuring -----------------------------------------------------------------------------------------------


def measure(seed, number, size, backend, times, twice):
    """Rows of one pair, a tolerance each."""
    what, ground, text, source, light = pair(seed, number, size)
    samples = Samples(select(backend), ground, NODES, first=100_003)
    exact = truth(samples, ground, source, light)
    mean = exact[exact > 0].mean() if (exact > 0).any() else 1.0
    finer = (
        float(np.sqrt(np.mean((truth(samples, ground, source, light, 2) - exact) ** 2)) / mean)
        if twice
        else np.nan
    )
    work = lambda t: sl.render(replace(ground), source, tolerance=t, quantity="irradiance", backend=backend)
    rows, fine = [], []
    if times:
        others = tried(ground, source, samples, exact, backend, 2 * max(work(t).seconds for t in TOLERANCES))
    for tolerance in TOLERANCES:
        out = work(tolerance)
        error, tail = off(samples, out.image, exact)
        said = [
            float(v) for text in out.warnings for v in re.findall(r"estimated to be ([\d.e+-]+|inf) %", text)
        ]
        wrong = np.abs(samples.of(np.asarray(out.image)) - exact) / np.maximum(
            samples.of(np.asarray(out.error)), 1e-30
        )
        row = {
            "pair": number,
            "scene": what,
            "sides": ground.sides,
            "masked": ground.mask is not None,
            "spacing": ground.spacing,
            "source": text,
            "size": size,
            "tolerance": tolerance,
            "error": error,
            "over": error / tolerance,
            "estimate": out.plan.error,
            "measured": out.plan.measured,
            "tail": tail / tolerance / 10,
            "method": out.plan.method,
            "units": out.plan.azimuths or out.plan.hemicube,
            "steps": len(out.plan.steps),
            "warned": bool(said),
            "said": max(said, default=np.nan) / 100,
            **{f"within {k}": float(np.mean(wrong <= k)) for k in (1, 2, 3)},
            "truth": finer,
        }
        if times:
            fine = [other for other in others if other[1] <= tolerance]
            row["seconds"], row["cheapest"] = (
                side_by_side(lambda: work(tolerance), min(fine, key=lambda other: other[0])[2])
                if fine
                else (*side_by_side(lambda: work(tolerance)), np.nan)
            )
            row["ratio"] = row["seconds"] / row["cheapest"]
        rows.append(row)
    return rows


def summary(rows):
    """What the figures come to, line by line."""
    quantiles = lambda values, *q: (
        " ".join(f"{v:.2f}" for v in np.nanquantile(np.array(values, float), q)) if len(values) else "none"
    )
    for tolerance in TOLERANCES:
        over = np.array([r["over"] for r in rows if r["tolerance"] == tolerance])
        warned = np.array([r["warned"] for r in rows if r["tolerance"] == tolerance])
        yield (
            f"{tolerance}: {np.mean(over <= 1):.1%} of {len(over)} within, {np.sum(warned)} warned; worst"
            f" {over.max():.2f}; beyond 1.5 without a warning {np.sum((over > 1.5) & ~warned)}, beyond 3"
            f" {np.sum(over > 3)}"
        )
    for name, some in (
        ("all", rows),
        *((m, [r for r in rows if r["method"] == m]) for m in ("unoccluded", "horizon", "lattice")),
    ):
        ratio = [
            r["error"] / r["estimate"]
            for r in some
            if r["estimate"] and max(r["error"], r["estimate"]) > r["tolerance"] / 10
        ]  # below, neither matters
        yield (
            f"truth over estimate, {name} ({len(ratio)}): 5th, median, 95th percentile"
            f" {quantiles(ratio, 0.05, 0.5, 0.95)}"
        )
    yield "nodes within 1, 2, 3 times the error map: " + ", ".join(
        f"{np.mean([r[f'within {k}'] for r in rows]):.1%} (worst pair"
        f" {min(r[f'within {k}'] for r in rows):.1%})"
        for k in (1, 2, 3)
    )
    yield (
        "truth's own error: median, most"
        f" {quantiles([r['truth'] / r['tolerance'] for r in rows if np.isfinite(r['truth'])], 0.5, 1)}"
        " tolerances"
    )
    if "ratio" in rows[0]:
        yield (
            "time over the cheapest: median, 90th percentile, most"
            f" {quantiles([r['ratio'] for r in rows], 0.5, 0.9, 1)}"
        )


def draw(rows, file):
    """Estimate against truth."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 5.6), layout="constrained")
    ends = np.array([1e-6, 0.3])
    axes.fill_between(ends, 0.5 * ends, 3 * ends, color="#000000", alpha=0.08, lw=0)
    axes.plot(ends, ends, color="#000000", lw=0.8)
    kind = lambda r: (
        "slices" if r["method"] == "horizon" and not r["source"].startswith("sky") else r["method"]
    )
    for name, colour in COLOURS.items():
        some = [r for r in rows if kind(r) == name and r["estimate"]]
        if some:
            axes.loglog(
                [r["estimate"] for r in some],
                [max(r["error"], 1e-6) for r in some],
                "o",
                ms=3.5,
                mew=0,
                alpha=0.8,
                color=colour,
                label=f"{name} ({len(some)})",
            )
    axes.set(
        xlabel="estimated relative RMS error",
        ylabel="true relative RMS error",
        xlim=ends,
        ylim=ends,
        xscale="log",
        yscale="log",
        aspect="equal",
    )
    axes.legend(frameon=False, loc="upper left", title="grey: 0.5 to 3 times the estimate")
    figure.savefig(file, dpi=160)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--pairs", type=int, default=150)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(4), "little"))
    parser.add_argument("--only", type=int, help="one pair of the seed, by its number")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--times", action="store_true")
    args = parser.parse_args()
    about = (
        f"# {time.strftime('%Y-%m-%d')}, seed {args.seed}, {args.pairs} pairs, size {args.size}, backend"
        f" {args.backend}; {platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python"
        f" {platform.python_version()}, NumPy {np.__version__}"
    )
    print(about, flush=True)
    rows, failed = [], 0
    for number in range(args.pairs) if args.only is None else [args.only]:
        try:
            rows += measure(args.seed, number, args.size, args.backend, args.times, number % 10 == 0)
        except Exception:  # a pair that raises is a finding of its own
            failed += 1
            print(
                f"pair {number} raised:",
                *pair(args.seed, number, args.size)[::2][:2],
                traceback.format_exc(),
                flush=True,
            )
            continue
        for r in rows[-len(TOLERANCES) :]:
            print(
                " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in r.values())
                + ("  MISS" if r["over"] > 1 else ""),
                flush=True,
            )
        with open(args.out / "refinement.csv", "w", newline="") as file:
            file.write(about + "\n")
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    print(*summary(rows), f"raised: {failed}", sep="\n")
    draw(rows, args.out / "refinement.png")


if __name__ == "__main__":
    main()
