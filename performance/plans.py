"""Whether plans keep their word: the error and time of render(tolerance=...), by scene, source, tolerance.

    python performance/plans.py --out docs [--size 192] [--backend opencl]
    python performance/plans.py --out docs --times --size 1024 --name plans_times

Errors are against exact rays at nodes that no choice has seen: relative RMS (docs/explanation) and the 99.9th
percentile. With --times fewer pairs, whose time, of a scene that was not rendered before, is compared with
that of the cheapest setting that would have kept both promises, found by trying all (half an hour). Prints a
table and writes plans.csv, or what --name says.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import record

import skylamp as sl
from skylamp import sources
from skylamp.backends import select
from skylamp.io import files as io
from skylamp.light.finite import solid_of
from skylamp.light.lattice import lacking
from skylamp.refinement import DEFAULT_TAIL
from skylamp.samples import Samples
from skylamp.sources.solids import upright

TOLERANCES = (0.03, 0.01, 0.003)
NODES = 600  # at which an image is judged
SETTINGS = {
    "horizon": (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256),
    "slices": (8, 16, 32, 64, 128),
    "lattice": (5, 7, 9, 17, 33),
}


def fractal(size, slope, power, seed=1):
    """Depth (size, size) of this rms slope, from filtered noise."""
    frequency = np.hypot(*np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = 1
    z = np.fft.irfft2(
        np.fft.rfft2(np.random.default_rng(seed).standard_normal((size, size))) / frequency**power,
        s=(size, size),
    )
    z *= slope / np.sqrt(sum(np.mean(np.diff(z, axis=a) ** 2) for a in (0, 1)))
    return z - z.min()


def urban(size, seed=2):
    """Flat ground with houses of many heights on a grid of streets."""
    rng = np.random.default_rng(seed)
    depth = np.full((size, size), 40.0)
    for row in range(3, size - 10, 15):
        for col in range(3, size - 10, 15):
            if rng.random() < 0.75:
                depth[row : row + rng.integers(7, 12), col : col + rng.integers(7, 12)] = 40 - rng.integers(
                    4, 40
                )
    return depth


def scenes(size) -> dict[str, sl.Scene]:
    y, x = np.mgrid[:size, :size].astype(float)
    middle = (size - 1) / 2
    away = np.hypot(x - middle, y - middle)
    folds = 4 + 10 * np.sin(x / 9 + 1.2 * np.sin(y / 15)) ** 2
    rough = fractal(size, 1.0, 2.0)
    mask = np.ones((size, size), bool)
    mask[size // 5 : size // 3, size // 4 : size // 2] = mask[-size // 6 :, : size // 7] = False
    height, spacing = io.terrain()
    part = height[:size, :size]
    return {
        "flat": sl.Scene(np.full((size, size), 5.0)),
        "ramp": sl.Scene(0.6 * x + 0.3 * y),
        "dome": sl.Scene(0.002 * away**2),
        "rough": sl.Scene(rough),
        "smooth": sl.Scene(fractal(size, 0.5, 2.5, 3)),
        "gentle": sl.Scene(fractal(size, 0.08, 2.5, 4)),
        "very rough": sl.Scene(fractal(size, 2.0, 1.6, 5)),
        "urban": sl.Scene(urban(size)),
        "terrain": sl.Scene.from_height(part, spacing),
        "terrain x 4": sl.Scene.from_height(4 * part, spacing),
        "dark folds": sl.Scene(folds + 8, sides="dark"),
        "dark rough": sl.Scene(rough + 10, sides="dark"),
        "periodic folds": sl.Scene(np.tile(folds[:, :size], 1), sides="periodic"),
        "periodic rough": sl.Scene(rough, sides="periodic"),
        "holes": sl.Scene(np.where(mask, rough, np.nan), mask=mask),
        "bowl": sl.Scene(40 - np.minimum(40, 0.012 * away**2)),
        "trench": sl.Scene(np.where(np.abs(x - middle) < 6, 25.0, 0.0) + 0.01 * y),
        "cliff": sl.Scene(np.where(x < size / 3, 0.0, 30.0) + 0.1 * rough),
        "tiny": sl.Scene(rough[:20, :26]),
        "spikes": sl.Scene(np.where(np.random.default_rng(6).random((size, size)) < 0.004, 0.0, 12.0)),
    }


def sun(degrees, elevation, azimuth, share):
    """A uniform sky and a disc of this radius that gives ``share`` of the level irradiance."""
    e, a, r = np.radians((elevation, azimuth, degrees))
    axis = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])
    brightness = share / (1 - share) * np.pi / (np.pi * np.sin(r) ** 2 * np.sin(e))
    return lambda L: 1 + brightness * (L @ axis >= np.cos(r))


def lobe(power, elevation, azimuth, height):
    e, a = np.radians((elevation, azimuth))
    axis = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])
    return lambda L: 1 + height * np.maximum(0, L @ axis) ** power


def lights(size, depth) -> dict[str, sources.Source]:
    """Sources over a map, ``depth`` the median depth of it [spacings], lengths in spacings."""
    panorama = np.random.default_rng(7).uniform(0.2, 2, (16, 32)) ** 2
    return {
        "uniform": sl.Sky(),
        "overcast": sl.Sky(sl.cie_overcast()),
        "glow": sl.Sky(lobe(6, 30, 40, 5)),
        "soft sun": sl.Sky(sun(4, 40, 115, 0.6)),
        "sun": sl.Sky(sun(0.27, 35, 200, 0.7)),
        "panorama": sl.Sky(sl.environment_map(panorama)),
        "high lamp": sl.Lamp((0.6 * size, 0.4 * size, -0.8 * size), 0.05 * size),
        "low lamp": sl.Lamp((0.3 * size, 0.7 * size, -0.15 * size), 0.04 * size),
        "side lamp": sl.Lamp((-0.5 * size, 0.2 * size, -0.3 * size), 0.06 * size),
        "small lamp": sl.Lamp((0.5 * size, 0.5 * size, -0.4 * size), 0.5),
        "spot": sl.Lamp(
            (0.5 * size, 0.6 * size, -0.5 * size),
            0.03 * size,
            brightness=sl.cosine_power(8, axis=(0.2, -0.1, 1)),
        ),
        "panel": sl.Lamp(
            corner=(0.3 * size, 0.3 * size, -0.2 * size), edges=((0.3 * size, 0, 0), (0, 0.2 * size, 0.0))
        ),
        "window": sl.Window(x=(0.3 * size, 0.6 * size), y=(0.25 * size, 0.7 * size)),
        "narrow window": sl.Window(
            x=(0.45 * size, 0.5 * size), y=(0.1 * size, 0.9 * size), brightness=sl.cie_overcast()
        ),
    }


SKIES = ("uniform", "overcast", "glow", "soft sun", "sun", "panorama")
PAIRS = [
    *[
        (scene, "uniform")
        for scene in (
            "flat",
            "ramp",
            "dome",
            "rough",
            "smooth",
            "gentle",
            "very rough",
            "urban",
            "terrain",
            "terrain x 4",
            "dark folds",
            "dark rough",
            "periodic folds",
            "periodic rough",
            "holes",
            "bowl",
            "trench",
            "cliff",
            "tiny",
            "spikes",
        )
    ],
    *[
        (scene, "overcast")
        for scene in ("flat", "rough", "urban", "dark folds", "periodic rough", "terrain x 4")
    ],
    *[
        (scene, light)
        for scene in ("rough", "smooth", "urban", "terrain x 4")
        for light in ("glow", "soft sun", "sun", "panorama")
    ],
    *[
        (scene, light)
        for scene in ("rough", "urban", "terrain x 4")
        for light in ("high lamp", "low lamp", "side lamp", "small lamp", "spot", "panel", "window")
    ],
    ("flat", "high lamp"),
    ("flat", "panel"),
    ("flat", "window"),
    ("dome", "spot"),
    ("smooth", "narrow window"),
    ("dark folds", "high lamp"),
    ("dark rough", "window"),
    ("holes", "low lamp"),
    ("holes", "sun"),
    ("dark folds", "sun"),
    ("tiny", "small lamp"),
    ("cliff", "side lamp"),
    ("trench", "window"),
    ("spikes", "high lamp"),
    ("bowl", "low lamp"),
    ("gentle", "sun"),
]


TIMED = [
    ("flat", "uniform"),
    ("rough", "uniform"),
    ("smooth", "uniform"),
    ("gentle", "uniform"),
    ("urban", "uniform"),
    ("dark folds", "uniform"),
    ("periodic rough", "uniform"),
    ("holes", "uniform"),
    ("bowl", "uniform"),
    ("spikes", "uniform"),
    ("rough", "overcast"),
    ("smooth", "panorama"),
    ("rough", "sun"),
    ("urban", "sun"),
    ("rough", "low lamp"),
    ("urban", "high lamp"),
    ("smooth", "spot"),
    ("rough", "panel"),
    ("urban", "window"),
]


def in_length(source, spacing):
    """The source with its lengths in the unit of ``spacing``."""
    scale = lambda v: tuple(spacing * np.asarray(v, float))
    if isinstance(source, sl.Window):
        return sl.Window(x=scale(source.x), y=scale(source.y), brightness=source.brightness)
    if isinstance(source, sl.Lamp) and source.center is not None:
        return sl.Lamp(scale(source.center), spacing * source.radius, source.brightness)
    if isinstance(source, sl.Lamp):
        return sl.Lamp(
            corner=scale(source.corner), edges=tuple(map(scale, source.edges)), brightness=source.brightness
        )
    return source


def pair(scene: str, light: str, size: int) -> tuple[sl.Scene, sources.Source]:
    made = scenes(size)[scene]
    return made, in_length(lights(min(made.shape), 0)[light], made.spacing)


def truth(scene, source, backend, nodes: int = NODES) -> tuple[Samples, np.ndarray]:
    """Nodes, other than those that choose, and their irradiance by many exact rays."""
    samples = Samples(select(backend), scene, nodes, first=100_003)
    solid = None if isinstance(source, sl.Sky) else upright(solid_of(scene, source))
    if solid is None and not isinstance(source, sl.Sky):
        return samples, np.zeros(len(samples))
    return samples, samples.exact(source, solid)


def relative_errors(samples, image, exact, least=0.0) -> tuple[float, float]:
    """(RMS, 99.9th percentile) of an image's error at the samples, over the mean lit irradiance.

    ``least``: what the mean counts as at least.
    """
    lit = exact[exact > 0]
    mean = lit.mean() if lit.size else 1.0
    wrong = np.abs(samples.of(np.asarray(image)) - exact) / max(mean, least)
    return float(np.sqrt(np.mean(wrong**2))), float(np.sort(wrong)[math.ceil(0.999 * len(wrong)) - 1])


def side_by_side(*works, runs=3):
    """Least seconds of each render, run in turns."""
    return [min(taken) for taken in zip(*([work().seconds for work in works] for _ in range(runs)))]


def kinds_of(scene, source) -> list[str]:
    """Methods that can represent the pair, cheapest first."""
    if lacking(scene, source):
        return ["lattice"]
    if not isinstance(source, sl.Sky):
        return ["unoccluded", "slices"]
    brightness = sources.distribution_of(source)
    has_disc = brightness is not None and brightness.disc() is not None  # of the sun, which no lattice takes
    if has_disc and scene.sides == "periodic":
        return []  # no method takes it that is asked for by name
    return ["unoccluded", "horizon"] if has_disc else ["unoccluded", "horizon", "lattice"]


def tried(scene, source, samples, exact, backend, longest) -> list:
    """(seconds, error, render) of every setting; the error is the larger of RMS and tail / DEFAULT_TAIL.

    Of a kind, until one is within the tightest tolerance, or slower than ``longest`` or than one that is.
    """
    found, tight = [], longest
    for kind in kinds_of(scene, source):
        for units in SETTINGS.get(kind, (0,)):
            options = {
                "unoccluded": {"method": "unoccluded"},
                "lattice": {"method": "lattice", "hemicube": units, "filled": True},
            }.get(kind, {"method": "horizon", "azimuths": units})
            work = lambda options=options: sl.render(
                replace(scene), source, quantity="irradiance", backend=backend, **options
            )
            rms, tail = relative_errors(samples, work().image, exact)
            error = max(rms, tail / DEFAULT_TAIL)
            (seconds,) = side_by_side(work, runs=1)
            found.append((seconds, error, work))
            tight = min(tight, seconds) if error <= TOLERANCES[-1] else tight
            if error <= TOLERANCES[-1] or seconds > tight:
                break
    return found


def cheapest(others, tolerance, work) -> dict[str, float]:
    """Seconds of ``work`` and of the cheapest setting tried that is within the tolerance; their ratio."""
    fine = [other for other in others if other[1] <= tolerance]
    if fine:
        seconds, least = side_by_side(work, min(fine, key=lambda other: other[0])[2])
    else:
        (seconds,), least = side_by_side(work), np.nan
    return {"seconds": seconds, "cheapest": least, "ratio": seconds / least}


def run(scene_name, light, size, backend, times, tolerances=TOLERANCES):
    """Rows of one pair, a tolerance each."""
    scene, source = pair(scene_name, light, size)
    samples, exact = truth(scene, source, backend)
    ours = [
        lambda t=t: sl.render(
            replace(scene), source, tolerance=t, quantity="irradiance", backend=backend, interreflection=False
        )
        for t in tolerances
    ]
    if times:
        longest = 2 * max(work().seconds for work in ours)
        others = tried(scene, source, samples, exact, backend, longest)
    rows = []
    for tolerance, work in zip(tolerances, ours):
        out = work()
        error, tail = relative_errors(samples, out.image, exact)
        row = {
            "scene": scene_name,
            "source": light,
            "size": scene.shape[0],
            "tolerance": tolerance,
            "error": error,
            "over": error / tolerance,
            "tail": tail / tolerance / 10,
            "planned": out.plan.error,
            "measured": out.plan.measured,
            "method": out.plan.method,
            "units": out.plan.azimuths or out.plan.hemicube,
            "warned": len(out.warnings),
        }
        if times:
            row["planning"] = min(work().plan.planning_seconds for _ in range(2))
            row |= cheapest(others, tolerance, work)
        rows.append(row)
    return rows


def print_row(row) -> None:
    """A row on one line, marked where it is beyond its tolerance."""
    shown = " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values())
    print(shown + ("  MISS" if row["over"] > 1 else ""), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--times", action="store_true")
    parser.add_argument("--only", default="", help="scenes or sources, comma-separated")
    parser.add_argument("--name", default="plans")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for scene, light in TIMED if args.times else PAIRS:
        if args.only and not {scene, light} & set(args.only.split(",")):
            continue
        rows += run(scene, light, args.size, args.backend, args.times)
        for row in rows[-len(TOLERANCES) :]:
            print_row(row)
        record.write_rows(args.out / f"{args.name}.csv", rows, backend=args.backend)  # what is done so far
    for tolerance in TOLERANCES:
        some = [row for row in rows if row["tolerance"] == tolerance]
        text = (
            f"{tolerance}: {sum(r['over'] <= 1 for r in some)} of {len(some)} within, worst"
            f" {max(r['over'] for r in some):.2f} tolerances; tail: {sum(r['tail'] <= 1 for r in some)}"
            " within"
        )
        if args.times:
            text += (
                f"; time over the cheapest: median {np.nanmedian([r['ratio'] for r in some]):.2f}, most"
                f" {np.nanmax([r['ratio'] for r in some]):.2f}"
            )
            text += (
                "; planning above 20 % of the render and 50 ms:"
                f" {sum(r['planning'] > max(0.05, 0.2 * (r['seconds'] - r['planning'])) for r in some)}"
            )
        print(text)


if __name__ == "__main__":
    main()
