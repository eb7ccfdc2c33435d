"""Whole calls beside their kernels: every public function x size x backend x where the map lies, in one run.

    python performance/whole_calls.py --out docs [--sizes 256,1024,4096] [--backends opencl,warp:cuda:0]
        [--inputs numpy,cupy] [--calls "lattice, M = 9"] [--repeats 7] [--memory]

A map of CuPy's is measured on warp:cuda alone, where it stays on the GPU.

Medians over repeated calls as a user makes them, compiled before. "new": the scene is made in the call, of an
array that the library has not seen; "known": the scene was rendered before. "kernels": the sum of the seconds
of every launch of the call, each with the device idle before and after, so it holds no transfer and no host
work, but some 10 microseconds a launch. "floor": the map to the device and the image back from and to memory
that the driver holds in place (CuPy), else one copy each. --memory: peaks of main memory and of the device
over what they were before the call. Writes whole_calls.csv and, with matplotlib, whole_calls.png.
"""

import argparse
import csv
import gc
import os
import platform
import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks.common import rough_ground

import skylamp as sl
from skylamp.backends import select

FIELDS = "call size backend input new known kernels floor launches host_peak device_peak".split()
TILE = 4096  # nodes of a side of the greatest map that is made by a Fourier transform; greater ones repeat it


class Call(NamedTuple):
    """A public call on a scene and a backend; ``most``: nodes of a side up to which it is measured."""

    work: Callable[[sl.Scene, str], Any]
    most: int = 16384


def _lamp(scene: sl.Scene) -> sl.Lamp:
    rows, cols = scene.shape
    return sl.Lamp(center=(cols / 2, rows / 2, -cols / 8), radius=cols / 16)


def _panorama() -> np.ndarray:
    """(512, 1024): patches of sky and a small sun."""
    image = 0.2 + 0.3 * np.random.default_rng(0).random((32, 64)).repeat(16, 0).repeat(16, 1)
    image[100:103, 170:173] = 5e3
    return image


PANORAMA = _panorama()
KEPT_MAP = sl.Sky(sl.environment_map(PANORAMA))
KEPT_FUNCTION = sl.Sky(lambda L: 1 + 5 * np.maximum(0, L @ np.array([0.6, 0.48, -0.64])) ** 8)


def _direct(scene: sl.Scene, sky: sl.Sky, name: str) -> sl.Rendering:
    return sl.render(scene, sky, backend=name, interreflection=False)


CALLS = {
    "Scene.from_height": Call(lambda scene, name: None),
    "horizons, 8 azimuths": Call(lambda scene, name: sl.horizons(scene, 8, name), 4096),
    "sky_view_factor, 64": Call(lambda scene, name: sl.sky_view_factor(scene, backend=name)),
    "openness, 64": Call(lambda scene, name: sl.openness(scene, backend=name), 4096),
    "render, 64 azimuths": Call(
        lambda scene, name: sl.render(scene, sl.Sky(), "horizon", backend=name, azimuths=64)
    ),
    "tolerance 0.01, direct": Call(
        lambda scene, name: sl.render(scene, sl.Sky(), backend=name, interreflection=False)
    ),
    "tolerance 0.01, all light": Call(lambda scene, name: sl.render(scene, sl.Sky(), backend=name), 4096),
    "environment map, new": Call(
        lambda scene, name: _direct(scene, sl.Sky(sl.environment_map(PANORAMA)), name), 4096
    ),
    "environment map, kept": Call(lambda scene, name: _direct(scene, KEPT_MAP, name), 4096),
    "function, kept": Call(lambda scene, name: _direct(scene, KEPT_FUNCTION, name), 4096),
    "lattice, M = 9": Call(
        lambda scene, name: sl.render(scene, sl.Sky(), "lattice", backend=name, hemicube=9), 8192
    ),
    "lamp": Call(lambda scene, name: sl.render(scene, _lamp(scene), "horizon", backend=name)),
    "lamp, tolerance 0.01": Call(
        lambda scene, name: sl.render(scene, _lamp(scene), backend=name, interreflection=False), 4096
    ),
    "visibility, M = 9": Call(lambda scene, name: sl.visibility(scene, sl.Sky(), 9, name), 4096),
}


def height(size: int) -> np.ndarray:
    """(size, size) float32, rough ground of rms slope 1."""
    tile = rough_ground(min(size, TILE))
    return np.ascontiguousarray(np.tile(tile, (-(-size // TILE),) * 2)[:size, :size]) if size > TILE else tile


def synchronized(found: Any) -> None:
    """Wait for a result that lies on a device."""
    image = getattr(found, "image", found)
    if hasattr(image, "__cuda_array_interface__"):
        import cupy

        cupy.cuda.Device().synchronize()


def median(work: Callable[[], Any], repeats: int) -> float:
    """Median seconds of ``work``, after one call that is not counted."""
    synchronized(work())
    seconds = []
    for _ in range(repeats):
        gc.collect()
        start = time.perf_counter()
        synchronized(work())
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def kernel_seconds(name: str, work: Callable[[], Any]) -> tuple[float, int]:
    """(seconds of all launches of ``work``, their number)."""
    engine, seconds = select(name), []
    launch = engine.launch

    def timed(*args: Any, **more: Any) -> None:
        engine.finish()
        start = time.perf_counter()
        launch(*args, **more)
        engine.finish()
        seconds.append(time.perf_counter() - start)

    work()
    engine.launch = timed  # type: ignore[method-assign]
    try:
        work()
    finally:
        del engine.launch
    return sum(seconds), len(seconds)


def floor_seconds(values: np.ndarray, repeats: int) -> float:
    """Seconds of one map to the device and one image back, at best."""
    try:
        import cupy
    except ImportError:
        room, back = np.empty_like(values), np.empty_like(values)
        return median(lambda: (np.copyto(room, values), np.copyto(back, room)), repeats)
    pinned = cupy.cuda.alloc_pinned_memory(values.nbytes)
    there = cupy.empty(values.shape, values.dtype)

    def both() -> None:
        there.data.copy_from_host(pinned.ptr, values.nbytes)
        there.data.copy_to_host(pinned.ptr, values.nbytes)

    return median(both, repeats)


def peaks(work: Callable[[], Any]) -> tuple[int, int]:
    """Bytes of main memory and of the GPU at most during ``work``, over what was taken before; 5 ms apart."""
    gc.collect()
    stop, most = threading.Event(), [0, 0]

    def used() -> tuple[int, int]:
        with open("/proc/self/statm") as pages:
            host = int(pages.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        try:
            import cupy

            free, total = cupy.cuda.runtime.memGetInfo()
        except ImportError:
            free = total = 0
        return host, total - free

    before = used()

    def watch() -> None:
        while not stop.is_set():
            most[:] = [max(a, b) for a, b in zip(most, used(), strict=True)]
            time.sleep(0.005)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        work()
    finally:
        stop.set()
        thread.join()
    return most[0] - before[0], most[1] - before[1]


def measure(call: str, size: int, name: str, where: str, repeats: int, memory: bool) -> dict[str, Any]:
    """One row of the table."""
    work, values = CALLS[call].work, height(size)
    given: Any = values
    if where == "cupy":
        import cupy

        given = cupy.asarray(values)

    def new() -> Any:
        return work(sl.Scene.from_height(given), name)

    row: dict[str, Any] = {"call": call, "size": size, "backend": name, "input": where}
    row["new"] = median(new, repeats)
    scene = sl.Scene.from_height(given)
    if call != "Scene.from_height":
        row["known"] = median(lambda: work(scene, name), repeats)
        row["kernels"], row["launches"] = kernel_seconds(name, lambda: work(scene, name))
    row["floor"] = floor_seconds(values, repeats) if where == "numpy" else 0.0
    if memory:
        row["host_peak"], row["device_peak"] = peaks(new)
    return row


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Whole calls, kernels and the transfer's floor over the size; a panel per call, a colour per backend."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    calls = [call for call in CALLS if any(row["call"] == call for row in rows)]
    columns = -(-(len(calls) + 1) // 2)  # one panel is the legend's
    figure, axes = plt.subplots(2, columns, figsize=(3.2 * columns, 6.4), sharey=True, squeeze=False)
    kinds = sorted({(row["backend"], row["input"]) for row in rows})
    sizes = sorted({row["size"] for row in rows})
    for axis, call in zip(axes.flat, calls):
        for colour, (name, where) in zip(("#0072b2", "#d55e00", "#009e73", "#cc79a7"), kinds):
            some = [row for row in rows if (row["call"], row["backend"], row["input"]) == (call, name, where)]
            at = [row["size"] for row in some]
            for field, style in (("new", "-o"), ("known", "--s"), ("kernels", ":^")):
                values = [1e3 * row.get(field, np.nan) for row in some]
                axis.plot(at, values, style, color=colour, markersize=3, label=f"{name}, {where}: {field}")
        floor = {row["size"]: 1e3 * row["floor"] for row in rows if row["call"] == call and row["floor"]}
        axis.plot(list(floor), list(floor.values()), color="0.5", label="transfer's floor")
        axis.set(title=call, xscale="log", yscale="log", xlabel="rows = columns")
        axis.set_xticks(sizes, map(str, sizes))
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("ms")
    for axis in axes.flat[len(calls) :]:
        axis.axis("off")
    axes.flat[-1].legend(*axes.flat[len(calls) - 1].get_legend_handles_labels(), loc="center", fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--sizes", default="256,1024")
    parser.add_argument("--backends", default="opencl")
    parser.add_argument("--inputs", default="numpy")
    parser.add_argument("--calls", action="append", choices=list(CALLS))
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--memory", action="store_true")
    args = parser.parse_args()
    rows = []
    cards = {name: select(name).device for name in args.backends.split(",")}
    print(f"{platform.machine()}, {os.cpu_count()} cores; {cards}; NumPy {np.__version__}")
    heads = "call", "size", "backend", "input", "new, ms", "known", "kernels", "floor"
    print("{:24} {:>5} {:12} {:6} {:>9} {:>9} {:>9} {:>8}".format(*heads))
    for size in map(int, args.sizes.split(",")):
        for call in args.calls or CALLS:
            for name in cards:
                for where in args.inputs.split(","):
                    if size > CALLS[call].most or (where == "cupy" and not name.startswith("warp:cuda")):
                        continue
                    row = measure(call, size, name, where, args.repeats, args.memory)
                    rows.append(row | {"device": cards[name], "cores": os.cpu_count()})
                    times = " ".join(f"{1e3 * row.get(f, np.nan):9.2f}" for f in ("new", "known", "kernels"))
                    print(f"{call:24} {size:5} {name:12} {where:6} {times} {1e3 * row['floor']:8.2f}", end="")
                    print(
                        *(f"{1e-6 * row[f]:9.0f} MB" for f in ("host_peak", "device_peak") if f in row),
                        flush=True,
                    )
    if args.out:
        args.out.mkdir(exist_ok=True)
        with open(args.out / "whole_calls.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, [*FIELDS, "device", "cores"], restval="")
            writer.writeheader()
            writer.writerows(rows)
        draw(rows, args.out / "whole_calls.png")


if __name__ == "__main__":
    main()
