"""Light between surfaces: whether render(tolerance=...) keeps its word for all light, and what that costs.

    python performance/interreflection.py [--out DIR] [--sizes 96 256] [--surfaces hills,...] [--backend NAME]
    python performance/interreflection.py --cliffs | --first | --lobes [--backend NAME]

Some 20 minutes on two idle cores. On eight surfaces, at albedo 0.8, under a uniform sky, a gradient, a sky
with a sun and a spherical lamp, images within 1 % and 0.3 % are compared at 300 nodes with exact light: that
of the source by exact rays, that between surfaces by exact strips over every crossing of 180 azimuths, of a
solution that 64 azimuths at every node have made (one more exact bounce makes that as exact as the strips).

Writes interreflection.csv: error (RMS, largest, bias; over the mean), the share that is left out without it,
its estimate, and processor time beside that of direct light; and interreflection.png, one scene at three
albedos without and with it.

Three options print instead what constants are made from. --cliffs: how large the error of rounds without
regard for cliffs is on plains with houses. --first: how large the error of the first level is on the eight
surfaces, over the light between surfaces. --lobes: how large the error of the ground in lobes is by the
number of rays, on the eight surfaces under the uniform and the sunny sky, and how long it takes.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from record import write_rows

import skylamp as sl
from skylamp import interreflection
from skylamp.backends import select
from skylamp.interreflection import sky_share
from skylamp.light.finite import solid_of
from skylamp.light.interreflection import LOBE_ERRORS, Bounces, Glossy, Round
from skylamp.light.propagation import Lobe
from skylamp.samples import Samples
from skylamp.sources.solids import upright

ALBEDO, NODES, AZIMUTHS, TOLERANCES = 0.8, 300, 180, (0.01, 0.003)
FINE = (Round(8, 2, 8, 0.25),) * 8 + (Round(64, 1, 64, 0.05),) * 6
SUN = np.array([0.5, 0.3, -0.81]) / np.linalg.norm([0.5, 0.3, 0.81])


def spectrum(size, slope, filtered, seed):
    """A random surface of an rms slope; ``filtered`` (frequency [1 / node]) -> amplitude."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    frequency[0, 0] = np.inf
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * filtered(frequency), (size, size))
    z *= slope / np.sqrt(sum(np.mean(np.diff(z, axis=a) ** 2) for a in (0, 1)))
    return z.max() - z


def smooth(size, slope, wave, seed):
    return spectrum(size, slope, lambda f: np.exp(-((np.where(np.isinf(f), 1, f) * wave) ** 2)), seed)


def bowl(size):
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    r, angle = np.hypot(x, y), math.radians(55)
    rim = 0.42 * size
    radius = rim / math.sin(angle)
    return np.where(r < rim, np.sqrt(np.maximum(radius**2 - r * r, 0)) - radius * math.cos(angle), 0.0)


def valley(size):
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    half = 0.3 * size
    return 1.1 * (half - np.minimum(np.abs(0.9 * x + 0.436 * y), half))


def trench(size):
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return np.where(np.abs(x + 0.2 * y) < 7, 14.0, 0.0)


def houses(size):
    rng, height, step = np.random.default_rng(11), np.zeros((size, size)), 18
    for y in range(0, size, step):
        for x in range(0, size, step):
            wide, long = rng.integers(8, 14, 2)
            down, right = rng.integers(1, 4, 2)
            height[y + down : y + down + long, x + right : x + right + wide] = rng.uniform(5, 24)
    return height.max() - height


def folds(size):
    y, x = np.mgrid[:size, :size]
    return 22 * np.sin(x / 9 + 1.3 * np.sin(y / 14)) ** 2


SURFACES = {
    "hills": lambda n: smooth(n, 0.35, 10, 21),
    "fractal": lambda n: spectrum(n, 0.8, lambda f: f**-2.0, 22),
    "mountain": lambda n: smooth(n, 1.0, 7, 23),
    "bowl": bowl,
    "valley": valley,
    "trench": trench,
    "houses": houses,
    "folds": folds,
}


def sources(size):
    return {
        "uniform": sl.Sky(),
        "gradient": sl.Sky(lambda L: (1 - 2 * L[..., 2]) / 3 * (1 + 0.5 * L[..., 0])),
        "sunny": sl.Sky(lambda L: 0.3 + 12 * np.exp(60 * (L @ SUN - 1))),
        "lamp": sl.Lamp((0.35 * size, 0.4 * size, -0.35 * size), 0.06 * size),
    }


def truth(scene, source, engine):
    """(samples, direct light there, all light there), exactly."""
    samples = Samples(engine, scene, NODES)
    solid = None if isinstance(source, sl.Sky) else upright(solid_of(scene, source))
    direct = samples.exact(source, solid)
    image = sl.render(
        scene,
        source,
        "horizon",
        backend=engine.name,
        quantity="irradiance",
        azimuths=256,
        interreflection=False,
    ).image
    found = Bounces(engine, scene, samples, [image], [ALBEDO], sky_share(scene, engine, 1e-4))
    found.run(FINE)
    light, _ = found.at_samples(AZIMUTHS)
    return samples, direct, direct + light[0]


def timed(work):
    """(result, processor nanoseconds) of the second of two calls."""
    work()
    start = time.process_time()
    found = work()
    return found, 1e9 * (time.process_time() - start)


def measure(name, size, kind, engine):
    """Rows of the table for a surface and a source."""
    scene = sl.Scene(SURFACES[name](size).astype(np.float32), albedo=ALBEDO)
    source = sources(size)[kind]
    samples, direct, exact = truth(scene, source, engine)
    mean = lambda values: float(np.mean(values))
    rms = lambda values: math.sqrt(mean(values**2))
    for tolerance in TOLERANCES:
        ask = lambda t=tolerance, **more: sl.render(
            scene, source, tolerance=t, backend=engine.name, quantity="irradiance", **more
        )
        out, both = timed(ask)
        _, alone = timed(lambda ask=ask: ask(interreflection=False))
        off = samples.of(out.image) - exact
        record = out.interreflection
        yield {
            "surface": name,
            "size": size,
            "source": kind,
            "tolerance": tolerance,
            "error": rms(off) / mean(exact),
            "largest": float(np.abs(off).max()) / mean(exact),
            "bias": mean(off) / mean(exact),
            "estimated error": record.error,
            "left out": rms(exact - direct) / mean(exact),
            "estimated share over the true one": out.plan.interreflection
            * mean(direct)
            / rms(exact - direct),
            "rounds": record.rounds,
            "azimuths": record.azimuths,
            "stride": record.stride,
            "direct [ns per node]": alone / size**2,
            "added over direct": (both - alone) / alone,
            "warned": any("light between" in text for text in out.warnings),
        }


def picture(path, backend):
    """One scene at three albedos, without and with."""
    figure, axes = plt.subplots(2, 3, figsize=(9, 6.2), constrained_layout=True)
    for column, albedo in zip(axes.T, (0.2, 0.5, 0.8)):
        scene = sl.Scene(folds(160), albedo=albedo)
        out = sl.render(scene, sl.Sky(), backend=backend, parts=True, interreflection=True)
        for axis, image, title in zip(column, (out.direct, out.image), ("direct light", "all light")):
            axis.imshow(image, cmap="gray", vmin=0, vmax=albedo)
            axis.set(xticks=[], yticks=[], title=f"albedo {albedo:g}: {title}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def error_and_share(scene, source, engine, levels):
    """Estimated error of the first ``levels`` without regard for cliffs, and the light between surfaces."""
    light = sl.render(
        scene,
        source,
        "horizon",
        backend=engine.name,
        quantity="irradiance",
        azimuths=128 if isinstance(source, sl.Sky) else None,
        interreflection=False,
    )
    kept = {name: getattr(interreflection, name) for name in ("FINE_ROUNDS", "CLIFF_SHARE", "FIRST_LEVEL")}
    interreflection.FINE_ROUNDS, interreflection.CLIFF_SHARE = kept["FINE_ROUNDS"][:levels], math.inf
    interreflection.FIRST_LEVEL = math.inf  # all begin with the first
    try:
        record = interreflection.included(scene, engine, [light.image], 1e-5, "").record
    finally:
        for name, value in kept.items():
            setattr(interreflection, name, value)
    return record.error, record.share


def cliffs(engine):
    """Errors of rounds up to 16 azimuths at every node without regard for cliffs, on plains with houses."""
    levels = 1 + next(n for n, this in enumerate(interreflection.FINE_ROUNDS) if this[:2] == (16, 1))
    for count in (1, 4, 16, 64):
        rng, height = np.random.default_rng(count), np.zeros((160, 160))
        for _ in range(count):
            y, x = rng.integers(0, 148, 2)
            long, wide = rng.integers(4, 12, 2)
            height[y : y + long, x : x + wide] += 12
        scene = sl.Scene.from_height(height, albedo=ALBEDO)
        error, _ = error_and_share(scene, sl.Sky(), engine, levels)
        seen = Samples(engine, scene, NODES).cliffs
        ratio = error / math.sqrt(seen)
        print(f"{count:3d} houses: share of cliffs {seen:.1e}, error {error:.2%}, over its root {ratio:.3f}")


def first_level(engine, sizes):
    """Errors of the first level over the light between surfaces, on all surfaces at two albedos."""
    ratios = []
    for name, size, albedo in itertools.product(SURFACES, sizes, (0.3, ALBEDO)):
        scene = sl.Scene(SURFACES[name](size), albedo=albedo)
        for kind, source in sources(size).items():
            error, share = error_and_share(scene, source, engine, 1)
            ratios.append(error / share)
            print(
                f"{name:9s}{size:5d} {kind:9s} albedo {albedo}: {ratios[-1]:.3f} of {share:.3f}", flush=True
            )
    least, median, most = np.quantile(ratios, (0, 0.5, 1))
    print(f"{len(ratios)} images: least {least:.3f}, median {median:.3f}, most {most:.3f}")


def lobes(engine, sizes):
    """RMS error of ground in lobes, of a specular albedo of 1, over the mean radiance of the ground."""
    counts, exact = (*LOBE_ERRORS, 2 * max(LOBE_ERRORS)), 4 * max(LOBE_ERRORS)
    errors, seconds = {}, {}
    for name, size, kind in itertools.product(SURFACES, sizes, ("uniform", "sunny")):
        scene = sl.Scene(SURFACES[name](size).astype(np.float32), albedo=ALBEDO)
        light = sl.render(scene, sources(size)[kind], backend=engine.name).image
        ground = Glossy(engine, scene, light[None], None)
        for exponent in (1, 5, 20, 100, 1000):
            phong = sl.Phong(0, 1, exponent)
            rim = phong.rim(1e-4)
            lobe = Lobe(phong.table(rim), rim, phong.spread)
            truth = ground.by_lobe(lobe, exact) * phong.norm
            for count in counts:
                ground.by_lobe(lobe, count)
                start = time.process_time()
                off = ground.by_lobe(lobe, count) * phong.norm - truth
                seconds.setdefault(count, []).append((time.process_time() - start) / size**2)
                errors.setdefault((count, exponent), []).append(
                    math.sqrt(np.mean(off.astype(float) ** 2)) / float(light.mean())
                )
    for count in counts:
        found = [errors[count, exponent] for exponent in (1, 5, 20, 100, 1000)]
        by_exponent = "  ".join(f"{math.sqrt(np.mean(np.square(v))):.4f} ({max(v):.4f})" for v in found)
        print(
            f"{count:3d} x {count}: {by_exponent}; {1e6 * np.mean(seconds[count]):.1f} us a node", flush=True
        )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", default=".", type=Path)
    parser.add_argument("--sizes", nargs="+", type=int, default=[96, 256])
    parser.add_argument("--surfaces", default=",".join(SURFACES))
    parser.add_argument("--sources", default="uniform,gradient,sunny,lamp")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--cliffs", action="store_true")
    parser.add_argument("--first", action="store_true")
    parser.add_argument("--lobes", action="store_true")
    arguments = parser.parse_args()
    engine, rows = select(arguments.backend), []
    if arguments.cliffs:
        cliffs(engine)
        return
    if arguments.first:
        first_level(engine, arguments.sizes)
        return
    if arguments.lobes:
        lobes(engine, arguments.sizes[:1])
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    for size in arguments.sizes:
        for name in arguments.surfaces.split(","):
            for kind in arguments.sources.split(","):
                for row in measure(name, size, kind, engine):
                    rows.append(row)
                    print(
                        f"{name:9s}{size:5d} {kind:9s} {row['tolerance']:g}: error {row['error']:.2%}"
                        f" (estimated {row['estimated error']:.2%}), largest {row['largest']:.1%}, bias"
                        f" {row['bias']:+.2%}; left out {row['left out']:.1%}, its estimate over the truth"
                        f" {row['estimated share over the true one']:.2f}; {row['rounds']} rounds,"
                        f" {row['azimuths']} @ {row['stride']}; time added over direct"
                        f" {row['added over direct']:.1f}{'  (warned)' if row['warned'] else ''}",
                        flush=True,
                    )
    write_rows(arguments.out / "interreflection.csv", rows, backend=arguments.backend)
    picture(arguments.out / "interreflection.png", arguments.backend)


if __name__ == "__main__":
    main()
