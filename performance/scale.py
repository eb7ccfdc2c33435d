"""What tiles add to the error of a whole map, how much memory they take, and how fast large maps go.

    python performance/scale.py --out docs                            # the table of errors
    python performance/scale.py --exact                               # houses, against exact rays
    python performance/scale.py --cities                              # error and audit among houses
    python performance/scale.py --between                             # light between surfaces
    python performance/scale.py --memory 8192                         # bytes of a process and of its GPU
    python performance/scale.py --processor 16384 --tile 8192         # processor time a node, and memory
    python performance/scale.py --big 65536 --tile 4096 --workers 4   # time of a map that is generated lazily

Errors are those of tiles against the same call on the whole map, which has the sweeps' own error besides.
Maps are made from fixed seeds; the table takes ten minutes with --size 2048 --tile 512 on two cores that
others share, and four times as long with the usual ones. --big reduces the sky-view factor of generated hills
to its mean, so that no disk is measured, leaves the start of the workers out, and prints a line of JSON, with
the peak of memory of a worker.
"""

import argparse
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import threading
import time
import warnings
import weakref
from pathlib import Path

import numpy as np
import record

import skylamp as sl
from skylamp import oracle, scale
from skylamp.backends import select
from skylamp.io import files as io
from skylamp.light import far

AZIMUTHS, SLOPE_AZIMUTHS = 16, 4  # of sky-view factors, and of horizons
COLUMNS = "map", "tiles", "rms", "max", "p999", "bias", "seams", "inside", "horizon_rms"


def mountains(size, relief, roughness=1.85, seed=1):
    """Fractal heights [nodes] float32; the spectrum falls off with frequency^roughness."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    frequency[0, 0] = 1
    waves = rng.normal(size=(2, *frequency.shape))
    spectrum = (waves[0] + 1j * waves[1]) * frequency**-roughness
    spectrum[0, 0] = 0
    heights = np.fft.irfft2(spectrum, s=(size, size))
    return (relief * (heights - heights.min()) / np.ptp(heights)).astype(np.float32)


def terrain(size):
    """The Jacksboro fault [nodes], mirrored until it fills the map, its finest cells interpolated."""
    heights, spacing = io.terrain()
    heights = np.asarray(heights, np.float64) / spacing
    times = 4
    at = [np.arange(times * (n - 1) + 1) / times for n in heights.shape]
    for axis, where in enumerate(at):
        low = np.minimum(where.astype(int), heights.shape[axis] - 2)
        a, b = np.take(heights, low, axis), np.take(heights, low + 1, axis)
        part = (where - low)[:, None] if axis == 0 else where - low
        heights = a + part * (b - a)
    heights = times * heights
    rows, cols = (-(-size // n) for n in heights.shape)
    band = np.concatenate([heights[:, :: (-1) ** n] for n in range(cols)], 1)
    whole = np.concatenate([band[:: (-1) ** n] for n in range(rows)], 0)
    return whole[:size, :size].astype(np.float32)


def houses(size, seed=2, area=1200, low=6, high=25, towers=0.03, tower_low=60, tower_high=120):
    """A city on a slope [nodes]: a block an ``area``, of 12 to 40 nodes and ``low`` to ``high`` high, and a
    tower now and then.
    """
    rng = np.random.default_rng(seed)
    heights = np.add.outer(np.zeros(size), 0.01 * np.arange(size))
    for _ in range(size * size // area):
        row, col = rng.integers(0, size, 2)
        rows, cols = rng.integers(12, 40, 2)
        is_low = rng.random() < 1 - towers
        top = rng.uniform(low, high) if is_low else rng.uniform(tower_low, tower_high)
        part = heights[row : row + rows, col : col + cols]
        np.maximum(part, part.min() + top, out=part)
    return heights.astype(np.float32)


def maps(size):
    high = mountains(size, 103)
    yield "mountains", high
    yield "rough mountains", mountains(size, 103, 1.7)
    yield "terrain", terrain(size)
    yield "coast", np.maximum(high - np.median(high), 0)
    yield "houses", houses(size)


def tilings(tile):
    """(name, tiling, whether far ground counts)."""
    for halo in (128, 256):
        yield f"halo {halo} alone", sl.Tiling(tile, halo), False
    yield "halo 128, rule 32", sl.Tiling(tile), True
    yield "halo 128, rule 64", sl.Tiling(tile, 128, 64), True
    yield "halo 64, rule 32", sl.Tiling(tile, 64, 32), True


def errors(name, heights, tile, backend):
    """Rows of the table for one map."""
    scene = sl.Scene.from_height(heights)
    options = dict(azimuths=AZIMUTHS, backend=backend)
    few = dict(options, azimuths=SLOPE_AZIMUTHS)
    whole, slopes = sl.sky_view_factor(scene, **options), sl.horizons(scene, **few)
    variants = [
        (text, tiling, counts, far.TOWARDS_MAXIMUM, far.SPARSE) for text, tiling, counts in tilings(tile)
    ]
    usual = sl.Tiling(tile)
    variants += [(f"means + {share:g} (maxima - means)", usual, True, share, far.SPARSE) for share in (0, 1)]
    variants += [
        (f"marched every {128 // sparse} nodes", usual, True, far.TOWARDS_MAXIMUM, sparse)
        for sparse in (2, 8)
    ]
    kept = far.TOWARDS_MAXIMUM, far.SPARSE
    for text, tiling, counts, share, sparse in variants:
        far.TOWARDS_MAXIMUM, far.SPARSE = np.float32(share), sparse
        reach = dict() if counts else dict(max_distance=float(tiling.halo))
        error = sl.sky_view_factor(scene, tiling=tiling, **options, **reach) - whole
        apart = np.arctan(sl.horizons(scene, tiling=tiling, **few, **reach)) - np.arctan(slopes)
        far.TOWARDS_MAXIMUM, far.SPARSE = kept
        jumps = np.abs(np.diff(error, axis=1)).mean(0)
        seams = np.arange(tile, heights.shape[1], tile) - 1
        row = (
            rms(error),
            np.abs(error).max(),
            np.quantile(np.abs(error), 0.999),
            error.mean(),
            jumps[seams].mean(),
            jumps[seams - tile // 2].mean(),
            rms(apart[np.isfinite(slopes)]),
        )
        print(f"{name:16} {text:32}", *(f"{value:9.5f}" for value in row), flush=True)
        yield dict(zip(COLUMNS, (name, text, *(f"{value:.6f}" for value in row))))


def exact(size, tile, backend):
    """Errors of houses at 600 nodes against exact rays in the same azimuths, of level elements."""
    heights, rng = houses(size), np.random.default_rng(0)
    scene, nodes = sl.Scene.from_height(heights), rng.integers(0, size, (2, 600))
    angles = sl.Azimuths(AZIMUTHS).angles
    slopes = oracle.horizons((heights.max() - heights).astype(float), 1.0, angles, nodes=nodes)
    truth = (1 / (1 + np.maximum(slopes, 0) ** 2)).mean(0)
    options = dict(azimuths=AZIMUTHS, backend=backend)
    for text, more in (
        ("whole map", {}),
        ("halo 128", dict(tiling=sl.Tiling(tile))),
        ("halo 256, rule 64", dict(tiling=sl.Tiling(tile, 256, 64))),
        ("halo 128 alone", dict(tiling=sl.Tiling(tile), max_distance=128.0)),
    ):
        found = sl.sky_view_factor(scene, "horizontal", **options, **more)[*nodes]
        print(
            f"houses, {text:20} RMS {rms(found - truth):.5f}, bias {(found - truth).mean():+.5f}", flush=True
        )


# of cities: area [node^2] that has a block; heights of blocks; share and heights of towers [nodes]
CITIES = {
    "city": (1200, 6, 25, 0.03, 60, 120),
    "few blocks": (8000, 6, 25, 0.03, 60, 120),
    "fewer": (30000, 6, 25, 0.1, 60, 120),
    "low": (1200, 5, 9, 0, 0, 1),
    "low, few": (8000, 5, 12, 0, 0, 1),
    "towers": (1200, 20, 60, 0.3, 60, 250),
    "skyline": (600, 30, 100, 0.3, 150, 400),
}


def cities(size, tile, backend):
    """Added RMS error of sky-view factors of level elements, and what the audit of every tile says."""
    scale.WORTH_SAYING = 0.0
    options = dict(definition="horizontal", azimuths=AZIMUTHS, backend=backend)
    grounds = {name: houses(size, 5, *args) for name, args in CITIES.items()}
    grounds |= {name: heights for name, heights in maps(size) if name != "houses"}
    for name, heights in grounds.items():
        scene = sl.Scene.from_height(heights)
        whole = sl.sky_view_factor(scene, **options)
        for tiling in (sl.Tiling(tile), sl.Tiling(tile, 256, 64)):
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                error = rms(sl.sky_view_factor(scene, tiling=tiling, **options) - whole)
            told = [float(str(warning.message).split()[5]) for warning in said]
            print(f"{name:16} halo {tiling.halo}: RMS {error:.5f}, audit {rms(told):.5f}", flush=True)


def between(size, tile, backend):
    """RMS error that tiles add to all light under a uniform sky, albedo 0.8, over its mean."""
    options = dict(azimuths=AZIMUTHS, backend=backend, quantity="irradiance")
    for name, heights in maps(size):
        scene, sky = sl.Scene.from_height(heights), sl.Sky()
        images = [sl.render(scene, sky, interreflection=among, **options).image for among in (False, True)]
        mean = images[1].mean()
        for tiling in (sl.Tiling(tile), sl.Tiling(tile, 256, 64)):
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                found = sl.render(scene, sky, interreflection=True, tiling=tiling, **options).image
            print(
                f"{name:16} halo {tiling.halo}:",
                f"light between surfaces {rms(images[1] - images[0]) / mean:.4f},",
                f"error of tiles {rms(found - images[1]) / mean:.5f}",
                *{str(warning.message) for warning in said},
                flush=True,
            )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


class GpuMemory(threading.Thread):
    """Peak of the memory taken of the first GPU [byte], as nvidia-smi tells every 20 ms; 0 where it is not.

    All processes' is counted, so that no other should run there.
    """

    def __init__(self):
        super().__init__(daemon=True)
        self.peak, self.now, self.smi = 0, 0, None
        if shutil.which("nvidia-smi"):
            asked = "--query-gpu=memory.used", "--format=csv,noheader,nounits", "-i", "0", "--loop-ms=20"
            self.smi = subprocess.Popen(["nvidia-smi", *asked], stdout=subprocess.PIPE, text=True)
            self.start()

    def run(self):
        for line in self.smi.stdout:
            self.now = 2**20 * int(line)
            self.peak = max(self.peak, self.now)

    def settled(self):
        """What is taken once the last calls have shown."""
        time.sleep(1 if self.smi else 0)
        return self.now

    def stop(self):
        if self.smi:
            self.smi.terminate()
            self.smi.wait()


class HostMemory(threading.Thread):
    """Peak of this process [byte] without the arrays of a backend whose device is the host, every 5 ms.

    ``device``: peak of these arrays; 0 on a GPU, which has them in memory of its own.
    """

    def __init__(self, engine):
        super().__init__(daemon=True)
        self.peak, self.now, self.device, self.ended = 0, 0, 0, False
        if engine.shares:
            engine.empty, engine.upload = map(self.counted, (engine.empty, engine.upload))
        self.start()

    def counted(self, make):
        def made(*args, constant=False, **options):
            found = make(*args, **options, **({"constant": True} if constant else {}))
            if not constant:  # else it is the host's own array
                self.add(found.nbytes)
                weakref.finalize(found, self.add, -found.nbytes)
            return found

        return made

    def add(self, count):
        self.now += count
        self.device = max(self.device, self.now)

    def run(self):
        while not self.ended:
            held = self.now
            resident = os.sysconf("SC_PAGE_SIZE") * int(Path("/proc/self/statm").read_text().split()[1])
            self.peak = max(self.peak, resident - max(held, self.now))
            time.sleep(0.005)

    def stop(self):
        self.ended = True
        self.join()


def memory(tile, backend, azimuths, what):
    """A line of JSON: peaks of this process, and of its GPU, for a tile with others all around [byte].

    ``what``: "svf", "openness" or "render" (a clear sky with a sun). host: beyond what the process took
    before, and beyond the tile's window and its result; device: beyond what was taken before the process used
    it, of which ``driver`` is what one small map takes. Where the device is the host, device is its arrays,
    host the rest, and together (which need not peak at the same time) what both take.
    """
    gpu = GpuMemory()
    idle = gpu.settled()
    sky = sl.Sky(sl.cie_clear((135.0, 35.0), direct=4.0))
    works = {
        "svf": sl.sky_view_factor,
        "openness": sl.openness,
        "render": lambda scene, **options: sl.render(scene, sky, **options).image,
    }
    options = dict(backend=backend, azimuths=azimuths)
    small = sl.Scene.from_height(mountains(256, 20))
    works[what](small, tiling=sl.Tiling(128, 16, 8), **options)
    before, driver = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, gpu.settled() - idle
    side = 3 * tile
    dask_array = __import__("dask.array").array
    heights = dask_array.map_blocks(
        lambda block_info=None: np.add.outer(
            *(np.sin(np.arange(*ends) / 50, dtype=np.float32) for ends in block_info[None]["array-location"])
        ),
        chunks=dask_array.core.normalize_chunks(tile, (side, side)),
        dtype=np.float32,
        meta=np.empty((0, 0), np.float32),
    )
    tiling = sl.Tiling(tile)
    found = works[what](sl.Scene.from_height(heights), tiling=tiling, **options)
    host = HostMemory(select(backend))
    found[tile : 2 * tile, tile : 2 * tile].sum().compute(scheduler="sync")
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    data = 4 * (tile + 2 * tiling.halo) ** 2 + 4 * tile**2
    host.stop()
    gpu.stop()
    told = {"tile": tile, "what": what, "backend": select(backend).name, "azimuths": azimuths}
    told |= {"process": peak, "before": before, "host": host.peak - before - data}
    told |= {"together": peak - before - data, "device": host.device or gpu.peak - idle, "driver": driver}
    print(json.dumps(told))


def hills(block_info=None):
    """A block of hills without end, from its place alone.

    A sum of plane waves, sin(u + v) = sin u cos v + cos u sin v: a product of two thin matrices, so that
    making the map takes little of the time that is measured.
    """
    waves = []
    for axis, (first, last) in enumerate(block_info[None]["array-location"]):
        at = np.arange(first, last)[:, None]
        lengths = np.array([3001.0, 1213.0, 557.0, 211.0, 83.0, 31.0])
        turn = 1.7 * np.arange(6)
        phase = 2 * np.pi * at * (np.sin(turn) if axis == 0 else np.cos(turn)) / lengths
        parts = np.sin(phase), np.cos(phase)
        waves.append(
            np.concatenate(parts if axis == 0 else parts[::-1], 1) * np.sqrt(np.tile(lengths / 60, 2))
        )
    return (waves[0].astype(np.float32) @ waves[1].T.astype(np.float32)).astype(np.float32, copy=False)


def lazy_view(side, tile, azimuths, backend):
    """The mean sky-view factor of generated hills, which is not computed yet."""
    dask_array = __import__("dask.array").array
    chunks = dask_array.core.normalize_chunks(tile, (side, side))
    heights = dask_array.map_blocks(hills, chunks=chunks, dtype=np.float32, meta=np.empty((0, 0), np.float32))
    scene = sl.Scene.from_height(heights)
    return sl.sky_view_factor(scene, azimuths=azimuths, backend=backend, tiling=sl.Tiling(tile)).mean()


def processor(side, tile, azimuths, backend):
    """Processor time a node, user and system, of a map in tiles and of a whole one of 2048 x 2048 nodes.

    The smaller one is computed before and after, three times each; the least counts. Dask's threads, as many
    as there are cores.
    """

    def nanoseconds(nodes, cut):
        start = time.process_time()
        lazy_view(nodes, cut, azimuths, backend).compute()
        return 1e9 * (time.process_time() - start) / nodes**2

    lazy_view(512, 256, azimuths, backend).compute()  # compiles
    whole = [nanoseconds(2048, 2048) for _ in range(3)]
    tiles = nanoseconds(side, tile)
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    least = min(whole + [nanoseconds(2048, 2048) for _ in range(3)])
    told = {"side": side, "tile": tile, "azimuths": azimuths, "backend": select(backend).name}
    told |= {"nanoseconds_a_node": round(tiles, 1), "of_2048": round(least, 1)}
    print(json.dumps(told | {"ratio": round(tiles / least, 3), "process": peak}))


def big(side, tile, workers, azimuths, backend):
    """Time of a lazy map of side x side nodes, reduced to its mean."""
    from distributed import Client, LocalCluster

    options = dict(threads_per_worker=2, processes=True, dashboard_address=None)
    with LocalCluster(n_workers=workers, **options) as cluster, Client(cluster) as client:
        client.wait_for_workers(workers)
        client.register_plugin(sl.devices())
        for size in (2 * tile, side):  # the first compiles, and starts the devices
            mean = lazy_view(size, tile, azimuths, backend)
            start = time.perf_counter()
            value = float(mean.compute())
            seconds = time.perf_counter() - start
        told = {"side": side, "tile": tile, "workers": workers, "azimuths": azimuths, "mean": value}
        told |= {"seconds": round(seconds, 2), "nodes_per_second": round(side * side / seconds)}
        told["worker_bytes"] = max(
            client.run(lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss).values()
        )
        told["devices"] = list(client.run(lambda: select(backend).name).values())
        print(json.dumps(told), flush=True)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="folder of scale.csv")
    parser.add_argument("--size", type=int, default=4096, help="nodes along a side of the maps of the table")
    parser.add_argument("--tile", type=int, default=1024)
    parser.add_argument("--maps", default="", help="some of them, with commas between")
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--cities", action="store_true")
    parser.add_argument("--between", action="store_true")
    parser.add_argument("--memory", type=int, metavar="TILE")
    parser.add_argument("--what", default="svf", choices=("svf", "openness", "render"), help="of --memory")
    parser.add_argument("--big", type=int, metavar="SIDE")
    parser.add_argument("--processor", type=int, metavar="SIDE")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--azimuths", type=int, default=64)
    parser.add_argument("--backend", default="auto")
    given = parser.parse_args()
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
    if given.memory:
        memory(given.memory, given.backend, given.azimuths, given.what)
    elif given.cities or given.between:
        (cities if given.cities else between)(given.size, given.tile, given.backend)
    elif given.exact:
        exact(given.size, given.tile, given.backend)
    elif given.processor:
        processor(given.processor, given.tile, given.azimuths, given.backend)
    elif given.big:
        big(given.big, given.tile, given.workers, given.azimuths, given.backend)
    else:
        print(f"{platform.machine()}, {os.cpu_count()} cores, Python {sys.version.split()[0]}, {given.size}")
        wanted = given.maps.split(",") if given.maps else []
        rows = []
        for name, heights in maps(given.size):
            if not wanted or name in wanted:
                rows += errors(name, heights, given.tile, given.backend)
        if given.out:
            record.write_rows(given.out / "scale.csv", rows, backend=given.backend)


if __name__ == "__main__":
    main()
