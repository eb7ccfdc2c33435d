"""Horizons: accuracy, speed, and what else there is, side by side, in one run.

    python performance/horizon.py --out docs [--size 1024] [--backends opencl] [--azimuths 8,16,32,64,128]
        [--sizes 512,1024,2048,4096] [--peers] [--lamps] [--memory]

Accuracy: E / pi under a uniform sky at a few hundred nodes against the oracle's horizons, every crossing with
a grid line, float64. Speed: medians over repeated runs with input and output resident on the device,
compiling apart, and the whole sl.render call on NumPy arrays beside them. Whole calls of the lattice and of
other packages (--peers, see peers.py) stand against whole calls of skylamp, on one map and against one
reference, each on the quantity that it claims; nodes near the border are left out there, since some packages
mirror the map. Lamps (--lamps) against shadow rays. Memory (--memory): peak of the render call in a process
of its own (Linux). The first backend does all but the speed, which is that of every one. Cores are those that
were busy with the work: fewer than there are, on a crowded machine. Prints its tables, and writes
horizon.json and, with matplotlib, horizon.png.
"""

import argparse
import ctypes
import json
import multiprocessing
import platform
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import peers

import skylamp as sl
from skylamp import oracle
from skylamp.backends import select
from skylamp.light.sweeps import Rays, Sweeps, ground_of

# rms slope, and the power by which amplitude falls with frequency
GROUNDS = {"rough": (1.0, 2.0), "smooth": (0.5, 2.5)}
USUAL = 64  # azimuths
CHOICE = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # azimuths that may beat a peer
BORDER = 100  # nodes that are left out beside peers, or an eighth of the map
MEMORY_SIZE = 2048


def ground(size: int, kind: str = "rough", seed: int = 1) -> np.ndarray:
    """Fractal depth (size, size) float32; the rough one is that of backends.py."""
    slope, power = GROUNDS[kind]
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = 1
    z = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) / frequency**power, s=(size, size))
    z *= slope / np.sqrt(sum(np.mean(np.diff(z, axis=a) ** 2) for a in (0, 1)))
    return (z - z.min()).astype(np.float32)


def some_nodes(size: int, count: int, border: int = 0):
    """(rows, cols) of random nodes."""
    return tuple(np.random.default_rng(0).integers(border, size - border, (2, count)))


def reference(depth: np.ndarray, nodes, azimuths: int) -> dict[str, np.ndarray]:
    """Exact sky-view factors at the nodes, by definition."""
    rays = sl.Azimuths(azimuths)
    horizon = oracle.horizons(depth, 1.0, rays.angles, nodes=nodes)
    tilted = (
        oracle.sky_irradiance(
            depth, 1.0, np.ones(depth.shape, bool), rays.angles, rays.widths, horizon, nodes=nodes
        )
        / np.pi
    )
    return {"tilted": tilted, "solid_angle": 1 - np.sin(np.arctan(np.maximum(horizon, 0))).mean(0)}


def errors(found: np.ndarray, exact: np.ndarray) -> dict[str, float]:
    off = found.astype(float) - exact
    return {"rms": float(np.sqrt(np.mean(off**2))), "bias": float(off.mean()), "max": float(abs(off).max())}


def time_of(work, budget: float, least: int = 1, finish=lambda: None) -> dict[str, float]:
    """Median seconds of ``work``, and the cores that were busy with it.

    At least ``least`` runs, and more within ``budget`` seconds.
    """
    times, spent = [], time.process_time()
    while len(times) < least or (sum(times) < budget and len(times) < 50):
        start = time.perf_counter()
        work()
        finish()
        times.append(time.perf_counter() - start)
    return {"seconds": statistics.median(times), "cores": (time.process_time() - spent) / sum(times)}


# -- what is measured ----------------------------------------------------------------------------------------


def accuracy(backend: str, azimuths: list[int], size: int, count: int) -> tuple[list[dict], dict[str, float]]:
    """Errors of E / pi by ground and number of azimuths; RMS error of the horizon [rad] by ground."""
    rows, angles = [], {}
    for kind in GROUNDS:
        depth, nodes = ground(size, kind), some_nodes(size, count)
        scene, exact = sl.Scene(depth), reference(depth, nodes, 2048)["tilted"]
        for number in azimuths:
            image = sl.render(
                scene, sl.Sky(), "horizon", backend=backend, quantity="irradiance", azimuths=number
            ).image
            rows.append(
                {
                    "ground": kind,
                    "azimuths": number,
                    "mean": float(exact.mean()),
                    **errors(image[nodes] / np.pi, exact),
                }
            )
        found = np.arctan(sl.horizons(scene, USUAL, backend)[:, *nodes])
        exact = np.arctan(oracle.horizons(depth, 1.0, sl.Azimuths(USUAL).angles, nodes=nodes))
        angles[kind] = errors(found, exact)["rms"]
    return rows, angles


def speed(backend: str, sizes: list[int], budget: float) -> list[dict]:
    engine, rays = select(backend), sl.Azimuths(USUAL)
    compiled, start = engine.compile_seconds, time.perf_counter()
    sl.render(sl.Scene(ground(64)), sl.Sky(), "horizon", backend=backend, azimuths=USUAL)
    compiled, first = engine.compile_seconds - compiled, time.perf_counter() - start
    rows = []
    for size in sizes:
        scene = sl.Scene(ground(size))
        sweeps = Sweeps(engine, ground_of(scene, None, engine), Rays(rays.angles, rays.widths))
        sums = [engine.empty((size * size,), np.int32, 0) for _ in range(2)]
        call = partial(sl.render, scene, sl.Sky(), "horizon", backend=backend, azimuths=USUAL)
        whole = time_of(call, budget)  # warms up, too
        light = time_of(partial(sweeps.light, *sums), budget, 3, engine.finish)
        rows.append(
            {
                "backend": engine.name,
                "device": engine.device,
                "size": size,
                "light": light,
                "whole": whole,
                "ns per horizon": 1e9 * light["seconds"] / size**2 / USUAL,
                "compile": compiled,
                "first call": first,
            }
        )
        rows[-1]["growth"] = rows[-1]["ns per horizon"] / rows[0]["ns per horizon"]
    return rows


class SideBySide:
    """One rough map, its reference, and whole calls of skylamp on it; what was measured once is kept."""

    def __init__(self, backend: str, size: int, count: int, budget: float):
        self.backend, self.budget, self.size = backend, budget, size
        self.depth, self.nodes = ground(size), some_nodes(size, count, min(BORDER, size // 8))
        self.exact = reference(self.depth, self.nodes, 720)
        self.scene, self.tiny = sl.Scene(self.depth), sl.Scene(ground(64))
        self.known = {}

    def measure(self, quantity: str, work) -> dict:
        work(self.tiny)  # compiles
        return {
            **time_of(lambda: work(self.scene), self.budget),
            **errors(work(self.scene)[self.nodes], self.exact[quantity]),
        }

    def horizons(self, quantity: str, azimuths: int) -> dict:
        if (quantity, azimuths) not in self.known:
            work = lambda scene: sl.sky_view_factor(scene, quantity, azimuths, self.backend)
            self.known[quantity, azimuths] = {
                "azimuths": azimuths,
                "quantity": quantity,
                **self.measure(quantity, work),
            }
        return self.known[quantity, azimuths]

    def lattice(self, hemicube: int, filled: bool) -> dict:
        render = lambda scene: (
            sl.render(
                scene,
                sl.Sky(),
                "lattice",
                backend=self.backend,
                quantity="irradiance",
                hemicube=hemicube,
                filled=filled,
            ).image
            / np.float32(np.pi)
        )
        return {
            "hemicube": hemicube,
            "filled": filled,
            "quantity": "tilted",
            **self.measure("tilted", render),
        }

    def peer(self, name: str, azimuths: int, radius: int | None) -> dict:
        """A peer's run, and the cheapest skylamp whose RMS error on the same quantity is not larger."""
        quantity = peers.PEERS[name][3]
        found, seconds, cores = peers.run(name, self.depth.max() - self.depth, self.nodes, azimuths, radius)
        row = {
            "peer": name,
            "version": peers.version(name),
            "quantity": quantity,
            "azimuths": azimuths,
            "radius": radius,
            "seconds": seconds,
            "cores": cores,
            **errors(found, self.exact[quantity]),
        }
        for number in CHOICE:
            ours = self.horizons(quantity, number)
            if ours["rms"] <= row["rms"]:
                return {**row, "skylamp": ours, "ratio": seconds / ours["seconds"]}
        return row


def lamps(backend: str, size: int, count: int, budget: float) -> list[dict]:
    """Spheres over rough ground: seconds of the call, and error relative to the mean lit irradiance."""
    depth, nodes = ground(size), some_nodes(size, count)
    scene, valid, middle = (
        sl.Scene(depth),
        np.ones(depth.shape, bool),
        np.array([size / 2, size / 2, depth.mean()]),
    )
    far = np.array([0.5, 0.3, -0.4]) * size  # from the middle
    spot = np.array([0.1, -0.2, -0.3]) * size
    sources = {
        "large, near": sl.Lamp((0.5 * size, 0.5 * size, -0.1 * size), 0.09 * size),
        "small, far": sl.Lamp(tuple(middle + far), np.linalg.norm(far) / 40),
        "spot cos^16": sl.Lamp(tuple(middle + spot), 0.02 * size, brightness=sl.cosine_power(16, -spot)),
    }
    rows = []
    for name, lamp in sources.items():
        work = partial(sl.render, scene, lamp, "horizon", backend=backend, quantity="irradiance")
        image = work().image[nodes]  # compiles
        exact = oracle.lamp_irradiance(depth, 1.0, valid, lamp, nodes, 4096)
        lit = exact[exact > 0]
        rows.append(
            {
                "lamp": name,
                "lit": len(lit) / count,
                **time_of(work, budget),
                **{key: value / lit.mean() for key, value in errors(image, exact).items()},
            }
        )
    return rows


def memory(backend: str, size: int) -> float:
    """Bytes per pixel of the render call at its peak, beyond what was there before and the image itself."""
    scene = sl.Scene(ground(size))
    sl.render(sl.Scene(ground(96)), sl.Sky(), "horizon", backend=backend)
    ctypes.CDLL(None).malloc_trim(0)  # what making the map took is given back,
    Path("/proc/self/clear_refs").write_text("5")  # and the peak starts anew
    before = _resident("VmRSS")
    sl.render(scene, sl.Sky(), "horizon", backend=backend)
    return (_resident("VmHWM") - before) / size**2 - 4


def _resident(key: str) -> int:
    """Bytes; not getrusage's, which a child process inherits."""
    return next(
        1024 * int(line.split()[1])
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith(key)
    )


# -- what is shown -------------------------------------------------------------------------------------------


def table(title: str, head: str, rows: list[list]) -> str:
    """A table in Markdown, printed too."""
    show = lambda v: (
        "-" if v is None else v if isinstance(v, str) else str(v) if isinstance(v, int) else f"{v:.3g}"
    )
    lines = [
        f"| {head} |",
        "|" + "---|" * (head.count("|") + 1),
        *("| " + " | ".join(map(show, row)) + " |" for row in rows),
    ]
    text = f"\n{title}\n\n" + "\n".join(lines) + "\n"
    print(text, flush=True)
    return text


def error_cells(row: dict) -> list[str]:
    return [f"{row['rms']:.5f}", f"{row['bias']:+.5f}", f"{row['max']:.4f}"]


def accuracy_table(rows: list[dict], angles: dict[str, float], size: int, count: int) -> str:
    cells = []
    for n, row in enumerate(rows):
        fall = rows[n - 1]["rms"] / row["rms"] if n and rows[n - 1]["ground"] == row["ground"] else None
        cells.append([row["ground"], row["azimuths"], *error_cells(row), fall])
    horizon = ", ".join(f"{kind} {rms:.5f} rad" for kind, rms in angles.items())
    title = (
        f"E / pi under a uniform sky, {size} x {size}, {count} nodes against 2048 exact azimuths. RMS error"
        f" of the horizon, {USUAL} azimuths: {horizon}."
    )
    return table(title, "ground | azimuths | RMS | bias | max | RMS falls by", cells)


def speed_table(rows: list[dict]) -> str:
    cells = [
        [
            row["backend"],
            row["device"][:34],
            row["size"],
            1e3 * row["light"]["seconds"],
            row["light"]["cores"],
            row["ns per horizon"],
            row["growth"],
            1e3 * row["whole"]["seconds"],
            row["compile"],
            row["first call"],
        ]
        for row in rows
    ]
    return table(
        f"Uniform sky, {USUAL} azimuths, rough ground",
        "backend | device | size | resident, ms | cores | ns per horizon | per pixel, over the first | whole"
        " call, ms | compile, s | first call, s",
        cells,
    )


def side_table(rows: list[dict], title: str) -> str:
    cells = [[label(row), row["quantity"], row["seconds"], row["cores"], *error_cells(row)] for row in rows]
    return table(title, "method | quantity | whole call, s | cores | RMS | bias | max", cells)


def peer_table(rows: list[dict]) -> str:
    cells = []
    for row in rows:
        ours = row.get("skylamp")
        beside = (
            [ours["azimuths"], ours["seconds"], ours["cores"], *error_cells(ours), row["ratio"]]
            if ours
            else ["none"] + [None] * 6
        )
        cells.append(
            [
                f"{row['peer']} {row['version']}",
                row["quantity"],
                row["azimuths"],
                row["radius"],
                row["seconds"],
                row["cores"],
                *error_cells(row),
                *beside,
            ]
        )
    return table(
        "Other packages, and the cheapest skylamp whose RMS error is not larger (whole calls)",
        "package | quantity | azimuths or rays | radius | s | cores | RMS | bias | max | skylamp: azimuths |"
        " s | cores | RMS | bias | max | times faster",
        cells,
    )


def label(row: dict) -> str:
    if "hemicube" in row:
        return f"{'filled lattice' if row['filled'] else 'stride'}, M = {row['hemicube']}"
    if "peer" in row:
        return f"{row['peer']}, {row['azimuths']}" + (f", radius {row['radius']}" if row["radius"] else "")
    return f"horizons, {row['azimuths']}"


def chart(path: Path, size: int, rows: list[dict], others: list[dict]) -> None:
    """Error against time per pixel, of skylamp's horizons and lattices and of the peers."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        return
    figure, axes = plt.subplots(figsize=(9, 6), layout="constrained")
    at = lambda row: (1e9 * row["seconds"] / size**2, row["rms"])
    draw_horizons(axes, at, [row for row in rows if "azimuths" in row])
    draw_lattices(axes, at, [row for row in rows if "hemicube" in row])
    draw_peers(axes, at, others)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="time per pixel of the whole call [ns]",
        ylabel="RMS error of the sky-view factor (tilted: E / pi)",
        title=f"Uniform sky, rough ground, {size} x {size} nodes; numbers are azimuths",
    )
    axes.margins(x=0.12)
    axes.grid(True, which="both", color="0.92")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    figure.savefig(path, dpi=120)


def annotate(axes, text: str, point, offset, colour: str, **options) -> None:
    axes.annotate(text, point, offset, textcoords="offset points", fontsize=8, color=colour, **options)


def draw_horizons(axes, at, rows: list[dict]) -> None:
    for quantity, style in (("tilted", "o-"), ("solid_angle", "o--")):
        line = sorted((row for row in rows if row["quantity"] == quantity), key=lambda row: row["azimuths"])
        if line:
            fill = "C0" if quantity == "tilted" else "white"
            name = f"skylamp, horizons, {quantity.replace('_', ' ')}"
            axes.plot(*zip(*map(at, line)), style, color="C0", markerfacecolor=fill, label=name)
        for row in line if quantity == "tilted" else ():
            annotate(axes, str(row["azimuths"]), at(row), (-5, -5), "C0", ha="right", va="top")


def draw_lattices(axes, at, rows: list[dict]) -> None:
    for filled, colour in ((True, "C1"), (False, "C2")):
        line = [row for row in rows if row["filled"] == filled]
        name = f"skylamp, {'filled lattice' if filled else 'the paper’s stride'}, tilted"
        axes.plot(*zip(*map(at, line)), "s-", color=colour, label=name)
        for row in line:
            annotate(axes, f"M = {row['hemicube']}", at(row), (6, 4 if filled else -10), colour)


def draw_peers(axes, at, rows: list[dict]) -> None:
    for n, name in enumerate(dict.fromkeys(row["peer"] for row in rows), 3):
        line, colour = [row for row in rows if row["peer"] == name], f"C{n}"
        quantity = line[0]["quantity"]
        fill = colour if quantity == "tilted" else "white"
        text = f"{name}, {quantity.replace('_', ' ')}"
        axes.plot(*zip(*map(at, line)), "D", color=colour, markerfacecolor=fill, label=text)
        for row in line:
            reach = f", radius {row['radius']}" if row["radius"] else " rays" if "embreex" in name else ""
            below = "rays" in reach
            annotate(
                axes, f"{row['azimuths']}{reach}", at(row), (0, -13 if below else 6), colour, ha="center"
            )


def arguments() -> argparse.Namespace:
    numbers = lambda text: [int(number) for number in text.split(",")]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("."), help="folder for the tables and the chart")
    add(
        "--size",
        type=int,
        default=1024,
        help="rows and columns of the map on which methods, peers and lamps stand side by side",
    )
    add("--backends", default="opencl", help="names, comma-separated")
    add("--azimuths", type=numbers, default="8,16,32,64,128", help="numbers of azimuths")
    add(
        "--sizes",
        type=numbers,
        default="512,1024,2048,4096",
        help="rows and columns of the maps whose speed is measured",
    )
    add("--exact", type=int, default=512, help="rows and columns of the maps whose accuracy is measured")
    add("--budget", type=float, default=3.0, help="seconds of repetition for each time")
    add("--peers", action="store_true", help="run what other packages there are")
    add("--lamps", action="store_true", help="spheres against shadow rays")
    add("--memory", action="store_true", help="peak memory of the call")
    return parser.parse_args()


def run_peers(side: SideBySide, missing: dict[str, str]) -> list[dict]:
    """Rows of the peers that are here; those that are not are named."""
    for name, why in missing.items():
        print(f"not run: {name} ({why})", flush=True)
    rows = []
    for name, azimuths, radius in peers.RUNS:
        if name not in missing:
            rows.append(side.peer(name, azimuths, radius))
            print(f"{label(rows[-1])}: {rows[-1]['seconds']:.3g} s", flush=True)
    return rows


def memory_table(backend: str, found: float) -> str:
    title = "Peak memory of the call beyond input and output"
    return table(title, "backend | size | bytes per pixel", [[backend, MEMORY_SIZE, f"{found:.1f}"]])


def lamp_table(rows: list[dict], size: int) -> str:
    cells = [[row["lamp"], row["lit"], row["seconds"], row["cores"], *error_cells(row)] for row in rows]
    title = (
        f"Lamps over rough ground, {size} x {size}, 150 nodes against 4096 shadow rays; errors over the mean"
        " lit irradiance"
    )
    return table(title, "lamp | nodes lit | whole call, s | cores | RMS | bias | max", cells)


def main() -> None:
    args = arguments()
    names = args.backends.split(",")
    facts = {"machine": platform.platform(), "skylamp": sl.__version__, "size": args.size, "text": ""}

    def put(key, value, text):
        facts[key] = value
        facts["text"] += text

    if args.memory:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as child:
            found = child.submit(memory, names[0], MEMORY_SIZE).result()
        put("memory", found, memory_table(names[0], found))
    rows = [row for name in names for row in speed(name, args.sizes, args.budget)]
    put("speed", rows, speed_table(rows))
    rows, angles = accuracy(names[0], args.azimuths, args.exact, 400)
    put("accuracy", rows, accuracy_table(rows, angles, args.exact, 400))
    facts["horizon"] = angles
    side = SideBySide(names[0], args.size, 1000, args.budget)
    quantities = ("tilted", "solid_angle")[: 1 + args.peers]
    rows = [side.horizons(quantity, number) for quantity in quantities for number in args.azimuths]
    rows += [side.lattice(hemicube, filled) for filled in (True, False) for hemicube in (9, 17)]
    title = f"One rough map, {args.size} x {args.size}, 1000 nodes against 720 exact azimuths (whole calls)"
    put("side by side", rows, side_table(rows, title))
    others = []
    if args.peers:
        facts["missing peers"] = peers.missing()
        others = run_peers(side, facts["missing peers"])
        put("peers", others, peer_table(others) if others else "")
    if args.lamps:
        rows = lamps(names[0], args.size, 150, args.budget)
        put("lamps", rows, lamp_table(rows, args.size))
    args.out.mkdir(parents=True, exist_ok=True)
    facts.pop("text")
    (args.out / "horizon.json").write_text(json.dumps(facts, indent=1) + "\n")
    lattices = [row for row in facts["side by side"] if "hemicube" in row]
    chart(args.out / "horizon.png", args.size, [*side.known.values(), *lattices], others)


if __name__ == "__main__":
    main()
