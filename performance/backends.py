"""Backends side by side in one run: scan + luminance over all directions of M = 9, and a field.

    python performance/backends.py --out docs [--size 1024] [--field 256] [--backends numpy,warp:cpu,opencl]

Times are medians over repeated runs with input and output resident on the device; compiling is apart; the
time of the whole sl.render call on NumPy arrays stands beside them. Writes backends.json and, with
matplotlib, backends.png.
"""

import argparse
import json
import platform
import statistics
import time
from pathlib import Path

import numpy as np

import skylamp as sl
from skylamp.backends import select
from skylamp.light import lattice
from skylamp.light.propagation import FieldByLayers, LatticeLight, LatticeMap

HEMICUBE = 9


def rough_ground(size: int, slope: float = 1.0, seed: int = 1) -> np.ndarray:
    """Fractal depth (size, size), spectrum 1 / f^2, scaled to this rms slope."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = 1
    z = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) / frequency**2, s=(size, size))
    rms = np.sqrt(sum(np.mean(np.diff(z, axis=a) ** 2) for a in (0, 1)))
    z *= slope / rms
    return (z - z.min()).astype(np.float32)


def median_seconds(engine, work, budget: float) -> tuple[float, float, float]:
    """(median, least, most) seconds of ``work`` with the device idle before and after, after one warm-up."""
    work()
    engine.finish()
    times = []
    while len(times) < 3 or (sum(times) < budget and len(times) < 50):
        start = time.perf_counter()
        work()
        engine.finish()
        times.append(time.perf_counter() - start)
    return statistics.median(times), min(times), max(times)


def measure(name: str, scene: sl.Scene, field_size: int, budget: float) -> dict:
    engine = select(name)
    cube = sl.Hemicube(HEMICUBE)
    problem = lattice.problem_of(engine, scene, sl.Sky(), cube, False)
    surface = LatticeMap(engine, problem)
    light = LatticeLight(surface, cube.moments)
    tests = scene.depth.size * len(cube)
    row = {"backend": engine.name, "device": engine.device, "nodes": scene.depth.size}
    for label, work in (
        ("scan", lambda: [surface.scan(n) for n in range(len(surface.groups))]),
        ("scan + luminance", light.run),
        ("filled scan + luminance", None),
    ):
        if work is None:
            work = LatticeLight(LatticeMap(engine, problem._replace(filled=True)), cube.moments).run
        compiled = engine.compile_seconds
        seconds, low, high = median_seconds(engine, work, budget)
        row[label] = {
            "seconds": seconds,
            "min": low,
            "max": high,
            "tests per second": tests / seconds,
            "compile": engine.compile_seconds - compiled,
        }
    start = time.perf_counter()
    out = sl.render(scene, sl.Sky(), "lattice", backend=engine.name)
    row["whole call"] = {"seconds": time.perf_counter() - start}
    row["checksum"] = int(out.image.view(np.uint32).sum(dtype=np.uint64))
    if field_size:
        y, x = np.mgrid[:field_size, :field_size]
        bumps = np.rint((field_size - 1) * (0.75 + 0.25 * np.sin(x / 9) * np.cos(y / 11)))
        deep = sl.Scene(bumps)
        run = FieldByLayers(engine, lattice.problem_of(engine, deep, sl.Sky(), cube, False), field_size).run
        seconds, low, high = median_seconds(engine, run, budget)
        row["field"] = {
            "seconds": seconds,
            "min": low,
            "max": high,
            "tests per second": field_size**3 * len(cube) / seconds,
        }
    return row


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for the table and the chart")
    parser.add_argument("--size", type=int, default=1024, help="rows and columns of the map")
    parser.add_argument("--field", type=int, default=256, help="nodes on a side of the field; 0: none")
    parser.add_argument(
        "--backends", default="", help="names, comma-separated; all that are available unless given"
    )
    parser.add_argument("--budget", type=float, default=3.0, help="seconds of repetition for each time")
    args = parser.parse_args()
    names = args.backends.split(",") if args.backends else [b.name for b in sl.backends() if b.available]
    scene = sl.Scene(rough_ground(args.size))
    rows = []
    for name in names:
        rows.append(measure(name, scene, args.field, args.budget))
        print(line(rows[-1]), flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    facts = {
        "size": args.size,
        "field": args.field,
        "hemicube": HEMICUBE,
        "machine": platform.platform(),
        "skylamp": sl.__version__,
        "rows": rows,
    }
    (args.out / "backends.json").write_text(json.dumps(facts, indent=1) + "\n")
    chart(rows, args.out / "backends.png", args.size)


HEAD = (
    "| backend | device | scan, tests/s | scan + luminance, tests/s | ms | filled, ms | field, ms | whole"
    " call, ms | compile, s |\n|---|---|---|---|---|---|---|---|---|\n"
)


def line(row: dict) -> str:
    ms = lambda key: f"{1e3 * row[key]['seconds']:.3g}" if key in row else "-"
    compiled = sum(row[key]["compile"] for key in ("scan", "scan + luminance", "filled scan + luminance"))
    return (
        f"| {row['backend']} | {row['device']} | {row['scan']['tests per second']:.2e} |"
        f" {row['scan + luminance']['tests per second']:.2e} | {ms('scan + luminance')} |"
        f" {ms('filled scan + luminance')} | {ms('field')} | {ms('whole call')} | {compiled:.1f} |"
    )


def chart(rows: list[dict], path: Path, size: int) -> None:
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        return
    figure, axes = plt.subplots(figsize=(7, 0.5 + 0.9 * len(rows)), layout="constrained")
    labels = [f"{row['backend']}\n{row['device'][:34]}" for row in rows]
    for offset, key in ((-0.2, "scan"), (0.2, "scan + luminance")):
        values = [row[key]["tests per second"] for row in rows]
        bars = axes.barh([n + offset for n in range(len(rows))], values, 0.38, label=key)
        axes.bar_label(bars, [f"{v:.1e}" for v in values], padding=3, fontsize=8)
    every = [row[key]["tests per second"] for row in rows for key in ("scan", "scan + luminance")]
    axes.set(
        xscale="log",
        xlim=(min(every) / 10, max(every) * 4),
        xlabel="direction tests per second",
        title=f"{size} x {size} nodes, all 209 directions of M = {HEMICUBE}",
    )
    axes.set_yticks(range(len(rows)), labels, fontsize=8)
    axes.invert_yaxis()
    axes.legend(
        fontsize=8,
        loc="upper left",
        bbox_to_anchor=(0, -0.35 if len(rows) < 3 else -0.2),
        ncols=2,
        frameon=False,
    )
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
