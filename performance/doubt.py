"""Whether recover()'s standard deviation is worth its name: sparsification error and calibration. Writes
OUT/doubt.csv and OUT/doubt.png.

    python performance/doubt.py [--backend NAME] [--cache FOLDER] [--only WORD] [--drawn N | --painted]
                                [--out FOLDER]

Fifteen surfaces of tests/surfaces.py (the five and the ten) under a sky, a sky with a sun, a lamp, a
spotlight, and under spotlight and sky together; noise of 1 and 3 % of the image's maximum and 8 bits, each
surface under a light that changes from row to row; terrain; some of 96 nodes. What was recovered is kept in
the cache, so that a run goes on where it ended. All takes about half an hour on two quiet cores.

AUSE, the area under the sparsification error (Ilg and others 2018): pixels are left out, the most doubtful
first, and the RMSE of the rest is compared with that of the best order; the mean difference over all shares,
as a share of the RMSE. 0 is the best order. Errors that are all of one size in expectation have some 0.5, by
whatever order.

With --drawn N: instead of these, N surfaces that are drawn at random from eight families, under the sun, the
lamp and the spotlight; OUT/doubt_drawn.csv. With --painted: the fifteen surfaces, 32 nodes a side, painted in
squares: their albedo given, under one light ("mapped"), and not given, under two and three lights; without
noise and with 1 %; OUT/doubt_painted.csv.

Constants of host/inverse/confidence.py were chosen with the surfaces of half 0; half 1 are the others. Those
of by_other_answers were chosen with the drawn surfaces 0 to 15 and with regard to both halves; CREASE_WEIGHT
and CORRECTED_WEIGHT with these and all fifteen surfaces, and with regard to 16 to 47. 48 and beyond were
drawn afterwards.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import itertools
import math
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import surfaces
from surfaces import ALBEDO, OTHERS, SURFACES, pair, rms, source_of

import skylamp as sl
from skylamp.inverse.pyramid import NORMAL_QUARTILE

LIGHTS = ("sky", "sun", "lamp", "spot", "spot+sky")
NOISES = ("noise 1", "noise 3", "8 bits")
MAPPED = "mapped sky", "mapped lamp"
PAINTED = *MAPPED, "painted sky+lamp", "painted sky+sun", "painted sky+lamp+spot"
PAINT, PAINTED_SQUARE = (0.3, 0.7), 4  # two albedos; [nodes]
NAMES = (*SURFACES, *OTHERS)
FAR, NEAR = 5, 2  # nodes: what is called wrong, and what right
SHARES = 50  # of pixels that are left out
CONFIDENCES = 0.0, 0.1, 0.3, 0.5, 0.7, 0.9, math.inf  # between which it is told what share is right


def cases() -> list[tuple[int, str, str, str]]:
    """(size, surface, light, noise)."""
    found = [(64, name, light, "0") for light in LIGHTS for name in NAMES]
    for row, name in enumerate(NAMES):
        for column, noise in enumerate(NOISES):
            light = LIGHTS[(row + 2 * column + row // 5) % 5]
            if light != "spot" or row % 3 == 0:  # those take longest
                found.append((64, name, light, noise))
    found += [(96, f"terrain x{heights}", light, "0") for heights in (1, 4) for light in LIGHTS[:3]]
    found += [(96, f"terrain x2 {at}", "sky", "0") for at in ("200 150", "60 220", "120 20")]
    large = ("egg-crate", "sky"), ("fractal", "spot"), ("folds", "sky"), ("cone", "sun")
    return found + [(96, name, light, "0") for name, light in large]


def drawn_cases(count: int) -> list[tuple[int, str, str, str]]:
    surfaces.OTHERS.update({f"drawn {seed}": drawn(seed) for seed in range(count)})
    return [(64, f"drawn {seed}", light, "0") for light in LIGHTS[1:4] for seed in range(count)]


def painted_cases() -> list[tuple[int, str, str, str]]:
    return list(itertools.product((32,), NAMES, PAINTED, ("0", "noise 1")))


def drawn(seed: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Depth of a surface at x, y, 0 to 64: folds, bumps and pits, ripples, facets, a fractal, scarps, an
    egg-crate or a dome.
    """
    r = np.random.default_rng(1000 + seed)
    u, turn = r.uniform, 2 * np.pi
    angle, relief = u(0, turn), u(10, 22)

    def along(x: np.ndarray, y: np.ndarray, a: float = angle) -> tuple[np.ndarray, np.ndarray]:
        return x * np.cos(a) + y * np.sin(a), y * np.cos(a) - x * np.sin(a)

    def folds() -> Callable:
        length, bend, width = u(7, 12), u(0.5, 1.5), u(10, 20)
        wave = lambda s, t: np.sin(s / length + bend * np.sin(t / width))
        return lambda x, y: relief * wave(*along(x, y)) ** 2

    def bumps() -> Callable:
        count = r.integers(3, 8)
        each = [(u(8, 56), u(8, 56), u(4, 11), u(0.5, 1) * relief * r.choice([-1, 1])) for _ in range(count)]
        return lambda x, y: sum(
            h * np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * w * w)) for a, b, w, h in each
        )

    def ripples() -> Callable:
        a, b, length, phase, oval = u(15, 49), u(15, 49), u(10, 24), u(0, 6), u(0.6, 1.4)
        return lambda x, y: relief / 2 * np.cos(turn * np.hypot(x - a, (y - b) * oval) / length + phase)

    def facets() -> Callable:
        planes = [(u(-0.7, 0.7), u(-0.7, 0.7), u(0, 8)) for _ in range(r.integers(3, 7))]
        sign = r.choice([-1, 1])
        return lambda x, y: sign * np.max([p * (x - 32) + q * (y - 32) + o for p, q, o in planes], 0)

    def fractal() -> Callable:
        waves = [(w, u(0, 6.3), u(0, 6.3)) for w in range(1, 24) for _ in range(3)]
        power = u(1.4, 2)
        return lambda x, y: (
            0.35
            * relief
            * sum(w**-power * np.cos(turn * w * along(x, y, a)[0] / 90 + phase) for w, a, phase in waves)
        )

    def scarps() -> Callable:
        each = [(u(0, 6.3), u(-15, 15), u(2, 5), u(0.3, 0.6) * relief, u(4, 8), u(8, 14)) for _ in range(2)]
        step = lambda s, t, o, w, h, bend, width: h * np.tanh((s - o + bend * np.sin(t / width)) / w)
        return lambda x, y: sum(
            step(along(x - 32, y - 32, a)[0], along(x, y, a)[1], *rest) for a, *rest in each
        )

    def crate() -> Callable:
        one, other, phase = u(22, 40), u(22, 40), u(0, 6.3)
        wave = lambda s, t: np.sin(turn * s / one + phase) * np.sin(turn * t / other)
        return lambda x, y: relief / 2 * wave(*along(x, y))

    def dome() -> Callable:
        a, b, radius, oval, sign = u(22, 42), u(22, 42), u(18, 32), u(0.7, 1.4), r.choice([-1, 1])
        power = u(0.5, 2)
        return lambda x, y: (
            sign * relief * np.maximum(1 - ((x - a) ** 2 + oval * (y - b) ** 2) / radius**2, 0) ** power
        )

    families = (folds, bumps, ripples, facets, fractal, scarps, crate, dome)
    return families[seed % len(families)]()


def half_of(surface: str) -> int:
    """0 or 1: every other surface; of the terrain, the steep one and one of three places; of those that are
    drawn, 16 and beyond.
    """
    if surface.startswith("drawn"):
        return int(int(surface.split()[1]) >= 16)
    if surface in NAMES:
        return NAMES.index(surface) % 2
    return int("x4" in surface or "200" in surface)


def problem(size: int, surface: str, light: str, noise: str) -> tuple[np.ndarray, list, list, int]:
    """(true depth, images, sources, layers)."""
    if light in PAINTED:
        return painted(size, surface, light.split()[1].split("+"), noise)
    kinds = light.split("+")
    if surface.startswith("terrain"):
        _, heights, *at = surface.split()
        depth = surfaces.terrain(size, int(heights[1:]), *map(int, at))
        lights = [surfaces.lamp_over(size) if kind == "lamp" else source_of(kind) for kind in kinds]
        images = [surfaces.image_of(depth, source) for source in lights]
        return depth, images, lights, math.ceil(1.2 * depth.max())
    images = [disturbed(pair(surface, kind, size)[1], noise) for kind in kinds]
    return pair(surface, kinds[0], size)[0], images, [source_of(kind, size) for kind in kinds], size


def paint(size: int) -> np.ndarray:
    """Albedo of squares."""
    return np.choose(np.indices((size, size)).sum(0) // PAINTED_SQUARE % 2, PAINT)


def painted(size: int, surface: str, kinds: list[str], noise: str) -> tuple[np.ndarray, list, list, int]:
    images = [pair(surface, kind, size)[1] * paint(size) / ALBEDO for kind in kinds]
    if noise != "0":
        images = [disturbed(image, noise, seed) for seed, image in enumerate(images)]
    return pair(surface, kinds[0], size)[0], images, [source_of(kind, size) for kind in kinds], size


def disturbed(image: np.ndarray, noise: str, seed: int = 5) -> np.ndarray:
    if noise == "8 bits":
        return np.rint(image / image.max() * 255) / 255 * image.max()
    sigma = float(noise.split()[-1]) / 100 * image.max()
    return np.maximum(image + sigma * np.random.default_rng(seed).normal(size=image.shape), 0)


def recovered(case: tuple[int, str, str, str], backend: str, cache: Path) -> dict[str, np.ndarray]:
    """truth, depth, std, confidence, seconds of a case."""
    kept = cache / ("_".join(map(str, case)).replace(" ", "-") + ".npz")
    if not kept.exists():
        truth, images, lights, layers = problem(*case)
        albedo = paint(case[0]) if case[2] in MAPPED else None if case[2] in PAINTED else ALBEDO
        found = sl.recover(
            images, lights, albedo, "dark", layers=layers, backend=backend, interreflection=False
        )
        np.savez(
            kept,
            truth=truth,
            depth=found.depth,
            std=found.std,
            confidence=found.confidence,
            seconds=found.seconds,
        )
    with np.load(kept) as arrays:
        return dict(arrays)


def remaining(error: np.ndarray, order: np.ndarray) -> np.ndarray:
    """(SHARES,) RMSE of what is left when the first of ``order`` are left out."""
    squares = np.square(error.ravel()[order])[::-1]
    means = (np.cumsum(squares) / np.arange(1, squares.size + 1))[::-1]
    return np.sqrt(means[(np.arange(SHARES) * squares.size) // SHARES])


def curves(error: np.ndarray, doubt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same by doubt and by the error itself, over the RMSE."""
    by = (np.argsort(-values.ravel(), kind="stable") for values in (doubt, np.abs(error)))
    one, other = (remaining(error, order) / max(rms(error), 1e-30) for order in by)
    return one, other


def ause(error: np.ndarray, doubt: np.ndarray) -> float:
    one, other = curves(error, doubt)
    return float(np.mean(one - other))


def marked(sure: np.ndarray, where: np.ndarray) -> float | None:
    return float(np.mean(sure[where] < 0.5)) if where.any() else None


def row_of(case: tuple[int, str, str, str], found: dict[str, np.ndarray]) -> dict:
    error = found["depth"].astype(float) - found["truth"]
    off, std = np.abs(error), found["std"]
    row = dict(zip(("size", "surface", "light", "noise"), case), half=half_of(case[1]), rmse=rms(error))
    row |= {f"within {n}": float(np.mean(off < n * std)) for n in (1, 2, 3)}
    row |= {"ause": ause(error, std), "far": float(np.mean(off > FAR))}
    row["far, marked"] = marked(found["confidence"], off > FAR)
    row["near, marked"] = marked(found["confidence"], off < NEAR)
    return row


def summary(rows: list[dict], chosen: dict[str, dict[str, np.ndarray]]) -> list[str]:
    groups = {
        "all": rows,
        "half 0": [r for r in rows if not r["half"]],
        "half 1": [r for r in rows if r["half"]],
    }
    groups |= {light: [r for r in rows if r["light"] == light] for light in (*LIGHTS, *PAINTED)}
    groups |= {"terrain": [r for r in rows if "terrain" in r["surface"]]}
    groups |= {"noise": [r for r in rows if r["noise"] != "0"]}
    names = [n for n in rows[0] if n.startswith(("within", "ause", "far,", "near,"))]
    lines = ["means over cases: " + ", ".join(names)]
    for name, group in groups.items():
        if not group:
            continue
        values = ([r[n] for r in group if r.get(n) is not None] for n in names)
        lines.append(
            f"{name:9s} {len(group):3d} " + " ".join(f"{np.mean(v):.3f}" if v else "-" for v in values)
        )
    pool = {
        key: np.concatenate([np.ravel(one[key]) for one in chosen.values()])
        for key in ("depth", "truth", "std", "confidence")
    }
    error = pool["depth"] - pool["truth"]
    lines.append(f"all pixels in one order: AUSE {ause(error, pool['std']):.3f}")
    return [*lines, *by_surface(chosen), *by_confidence(np.abs(error), pool["std"], pool["confidence"])]


def by_surface(chosen: dict[str, dict[str, np.ndarray]]) -> list[str]:
    """Of all cases of a surface, the shares of its wrong and of its right pixels that are marked."""
    lines = []
    for surface in dict.fromkeys(name.split("_")[1] for name in chosen):
        group = [one for name, one in chosen.items() if name.split("_")[1] == surface]
        off = np.concatenate([np.ravel(np.abs(one["depth"] - one["truth"])) for one in group])
        sure = np.concatenate([np.ravel(one["confidence"]) for one in group])
        if (wrong := int((off > FAR).sum())) > 0:
            shares = marked(sure, off > FAR), marked(sure, off < NEAR) or 0.0
            lines.append(f"{surface}: of {wrong} wrong {shares[0]:.3f} marked, of the right {shares[1]:.3f}")
    return lines


def by_confidence(off: np.ndarray, std: np.ndarray, sure: np.ndarray) -> list[str]:
    """Share of depths that are right, by confidence. The largest right error follows from it and from std."""
    right = off < NORMAL_QUARTILE * std / np.sqrt(1 / np.clip(sure, 1e-9, 1 - 1e-9) - 1)
    lines = []
    for low, high in itertools.pairwise(CONFIDENCES):
        within = (sure >= low) & (sure < high)
        if within.any():
            share, shown = within.mean(), right[within].mean()
            lines.append(f"confidence {low:g} to {high:g}: {share:.3f} of all, {shown:.3f} right")
    return lines


def picture(chosen: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Left: sparsification of all pixels in one order. Right: share of truths within so many standard
    deviations, by light.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    error = np.concatenate([np.ravel(one["depth"] - one["truth"]) for one in chosen.values()])
    shares = np.arange(SHARES) / SHARES
    by, best = curves(error, np.concatenate([np.ravel(one["std"]) for one in chosen.values()]))
    left.plot(shares, by, label="standard deviation")
    left.plot(shares, best, "k--", label="error itself")
    left.set(xlabel="share of pixels left out", ylabel="RMSE of the rest / RMSE", title="Sparsification")
    left.legend()
    at = np.linspace(0, 4, 81)
    for light in LIGHTS:
        group = [one for name, one in chosen.items() if name.split("_")[2] == light]
        if group:
            z = np.sort(
                np.concatenate([np.ravel(np.abs(one["depth"] - one["truth"]) / one["std"]) for one in group])
            )
            right.plot(at, np.searchsorted(z, at) / z.size, label=light)
    right.plot(at, [math.erf(x / math.sqrt(2)) for x in at], "k--", label="normal")
    right.set(xlabel="standard deviations", ylabel="share of truths within", title="Calibration")
    right.legend()
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--cache", default="build/doubt", help="folder of what was recovered")
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--drawn", type=int, default=0, help="this many surfaces drawn at random instead")
    parser.add_argument("--painted", action="store_true", help="surfaces whose albedo is not given instead")
    parser.add_argument("--out", default="docs")
    options = parser.parse_args()
    cache, out = Path(options.cache), Path(options.out)
    cache.mkdir(parents=True, exist_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    rows, chosen = [], {}
    others = drawn_cases(options.drawn) if options.drawn else painted_cases() if options.painted else []
    for case in others or cases():
        name = "_".join(map(str, case))
        if options.only in name:
            chosen[name] = recovered(case, options.backend, cache)
            rows.append(row_of(case, chosen[name]))
            print(name, rows[-1], flush=True)
    if not rows:
        raise SystemExit(f"--only {options.only}: no case has this in its name")
    names = list(dict.fromkeys(name for row in rows for name in row))
    kind = "_drawn" if options.drawn else "_painted" if options.painted else ""
    with (out / f"doubt{kind}.csv").open("w", newline="") as file:
        machine = f"{platform.machine()}, {os.cpu_count()} cores, {options.backend}"
        versions = f"Python {platform.python_version()}, NumPy {np.__version__}"
        file.write(f"# {machine}, {versions}, {datetime.date.today()}\n")
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        shown = lambda value: f"{value:.4g}" if isinstance(value, float) else value
        writer.writerows({name: shown(value) for name, value in row.items()} for row in rows)
    if not others:
        picture(chosen, out / "doubt.png")
    print("\n".join(summary(rows, chosen)))


if __name__ == "__main__":
    main()
