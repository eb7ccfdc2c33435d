"""A GeoTIFF of any size, tile by tile, to another: finished tiles are kept when a run is interrupted.

Tiles are computed by processes of dask.distributed; each reads its own window of the file. Overviews, tiles
and which of them are done lie in a Zarr group beside the output until that is written.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import errno
import glob
import hashlib
import importlib
import json
import logging
import secrets
import shutil
import signal
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import typer

import skylamp

from ..backends import select
from ..errors import CapacityError, InputError, bad, import_extra
from ..horizon import mean_openness, sky_view
from ..io import geotiff as geo
from ..io.paths import replacing_file
from ..light.far import Tiling, Top, coarser, from_heights, top_of
from ..reflectance import Reflectance
from ..render_options import sectors_of
from ..render_tiles import tile_image
from ..scale import Audit, Layout, around_tile, decided_by_sums, devices, layout_of_map, sums_of_tile, tile_of
from ..scene import ALBEDO, Scene
from ..sources import Source
from . import parsing

Progress = Callable[[int, int], None]

# that a process takes per node of a tile and its halo, and besides [byte]; measured: 57, 48 and 41 at the
# peak of tiles of 2048, 4096 and 8192 nodes on PoCL, whose device is the host (performance/scale.py
# --memory), and half as much again for the window that the other thread reads meanwhile
PER_NODE, BESIDES = 80, 6 * 10**8
TILES = 8192, 4096, 2048, 1024  # sides of tiles of which the largest is taken that fits
# the error where these options are combined with others
COMPATIBLE = (
    "a GeoTIFF of heights to a GeoTIFF, with open sides: it goes with --out, --spacing, --backend, --tile,"
    " --workers, --scheduler, --resume, --cog and {} only"
)
# of the page of Dask, which it makes unasked: of two runs at once, both have one without a warning
ANY_PORT = "127.0.0.1:0"
WAIT = 30  # [s] for a scheduler, and for a worker that computes; chosen: Dask's own default
POLL = 0.05  # [s] between looks for finished tiles, which take seconds; chosen
TIFF_BLOCK = 512  # [node], blocks of the GeoTIFF that is written
RUN = "run-"  # begin of the name of the arrays of a run in its scratch
# end of the name of the file that is being written: by it the next run, the only one by its lock, knows what
# a killed run has left
UNFINISHED = ".scratch.tmp"
SCRATCH_FORM = 5  # number of the scratch group's form: one more with every change of its arrays


class Machines(NamedTuple):
    """Where tiles are computed: the options of the command line for memory and workers."""

    memory: str | None
    workers: int
    scheduler: str | None
    tile: int | None
    resume: bool
    cog: bool

    @property
    def asked(self) -> bool:
        """Whether to compute tile by tile; BadParameter for options that require it."""
        if self.memory is not None or self.scheduler is not None:
            return True
        if self.tile is not None or self.resume or self.cog or self.workers != 1:
            raise typer.BadParameter(
                "--tile, --resume, --cog and --workers require it", param_hint="--memory"
            )
        return False

    @property
    def share(self) -> int | None:
        """Bytes of a worker, if they were given."""
        return None if self.memory is None else parsing.byte_count(self.memory) // self.workers

    @property
    def side(self) -> int:
        """Side of the tiles: as given, or the largest that fits."""
        if self.tile is not None:
            if self.share is not None and self.share < (least := memory_of(self.tile)):
                raise CapacityError(
                    f"--memory: {self.share:,} bytes a worker; one with --tile {self.tile} needs at least"
                    f" {least:,}."
                )
            return self.tile
        return TILES[0] if self.share is None else tile_that_fits(self.share)


def checked_output(compatible: str, out: str | None, others: Iterable[Any]) -> str:
    """The output's name; BadParameter unless it is given, and no option besides ``compatible`` ones."""
    if not out or any(other is not None and other is not False for other in others):
        raise typer.BadParameter(COMPATIBLE.format(compatible), param_hint="--memory")
    return out


class Computation(NamedTuple):
    """The quantity to compute, in how many bands; ``sign`` -1: of the surface upside down.

    ``settings``: the options in words; all that the bytes depend on besides the file and the tiles.
    """

    work: Any  # see scale.Work and scale.Undecided
    audit: Audit
    settings: dict[str, Any]
    max_distance: float | None = None
    sign: float = 1.0
    bands: int = 1
    albedo: Any = ALBEDO
    between: bool | None = False  # with light between surfaces; None: as all tiles decide
    spacing: float | None = None  # another one than the file's


class Job(NamedTuple):
    """A quantity of a file: all data that a task needs.

    ``state`` of the file as the run began, see state_of. ``dtype``: of heights and their overviews.
    ``backend``: the name of that of the workers, or of all theirs. ``run``: the name of its arrays in the
    scratch.
    """

    file: Path
    state: tuple[int, str]
    scratch: Path
    layout: Layout
    quantity: Computation
    dtype: str = "float32"
    backend: str = ""
    run: str = ""


def horizon(
    what: str,
    definition: str,
    azimuths: int,
    max_distance: float | None,
    backend: str,
    spacing: float | None = None,
) -> Computation:
    """One quantity of `skylamp horizon`."""
    options: dict[str, Any] = dict(azimuths=sectors_of(azimuths), backend=backend)
    works: dict[str, Any] = {
        "sky-view-factor": partial(sky_view, definition=definition, **options),
        "openness": partial(mean_openness, **options),
        "negative-openness": partial(mean_openness, upside_down=True, **options),
    }
    if what not in works:
        raise bad("--what of a map in tiles", repr(what), " | ".join(works))
    settings = dict(what=what, definition=definition, azimuths=azimuths, max_distance=max_distance)
    sign = -1.0 if what.startswith("neg") else 1.0
    return Computation(works[what], Audit(backend), settings, max_distance, sign, spacing=spacing)


def image(
    file: Path,
    surface: Reflectance,
    source: Source,
    backend: str,
    words: dict[str, Any],
    spacing: float | None = None,
    **options: Any,
) -> Computation:
    """The image of `skylamp render`.

    ``words``: how the command line describes surface and source; ``options`` of :func:`skylamp.render`.
    """
    dask_array = _imported("dask.array")
    header = geo.header(file, spacing=spacing)
    scene = Scene.from_height(
        dask_array.zeros(header.values.shape, chunks=-1, dtype=np.float32),
        header.spacing,
        reflectance=surface,
    )
    work = tile_image(scene, source, backend, **options)
    kind = words.get("source")
    if kind is not None and Path(kind).exists():  # an environment map
        words = {**words, "source": [str(Path(kind).resolve()), *state_of(Path(kind))]}
    settings = dict(words, **options)
    bands, between = 3 if work.in_colour else 1, work.between
    reach = options.get("max_distance")
    return Computation(
        work, work.audit, settings, reach, bands=bands, albedo=scene.albedo, between=between, spacing=spacing
    )


def state_of(file: Path) -> tuple[int, str]:
    """Bytes of a file, and when it was changed, UTC."""
    state = file.stat()
    return state.st_size, str(np.datetime64(state.st_mtime_ns, "ns"))


def write_quantity(
    file: Path, out: str, quantity: Computation, machines: Machines, progress: Progress | None
) -> tuple[tuple[int, ...], str]:
    """Compute one quantity of a GeoTIFF and write it.

    (Its shape, (rows, cols) or (bands, rows, cols); the backends of the workers.)
    """
    if not out.lower().endswith((".tif", ".tiff")):
        raise bad("--out of a map in tiles", repr(out), "a .tif")
    if machines.workers < 1:
        raise bad("--workers", machines.workers, "at least 1")
    if machines.workers > 1 and machines.scheduler is not None:
        raise bad("--workers with --scheduler", machines.workers, "one of the two", "A cluster has its own.")
    side = machines.side if machines.scheduler is None else None  # a CapacityError before any worker starts
    header, state = geo.header(file, spacing=quantity.spacing), state_of(file)
    written = Path(out).resolve()  # workers have another folder; of all links to it one run at a time
    scratch = written.with_name(written.name + ".scratch")
    dtype = "float32" if np.can_cast(header.values.dtype, np.float32) else "float64"
    begun = False
    with locked(scratch):
        try:
            with workers_of(machines) as client:
                layout = layout_of_map(
                    Tiling(side or machines._replace(workers=len(client.nthreads())).side),
                    header.values.shape,
                    header.spacing,
                    False,
                    quantity.max_distance,
                    quantity.audit,
                    quantity.between,
                )
                names = ", ".join(sorted(set(client.run(_backend_of, quantity.audit.backend).values())))
                job = Job(file.resolve(), state, scratch, layout, quantity, dtype, names)
                group, begun = scratch_of(job, machines.resume), True
                run(job._replace(run=group.basename), group, client, progress)
            if "values" not in group:
                raise InputError(f"{scratch}: it was removed while tiles were computed.")
            write(out, group["values"], header, machines.cog)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt) and scratch.exists():
                typer.echo(f"Interrupted: finished tiles are in {scratch}; --resume continues.", err=True)
            elif begun and scratch.exists():
                typer.echo(f"Stopped: finished tiles are in {scratch}; --resume continues.", err=True)
            raise
        discard(scratch)
    bands = () if quantity.bands == 1 else (quantity.bands,)
    return (*bands, *header.values.shape), names


def _backend_of(name: str) -> str:
    return select(name).name


def _imported(module: str) -> Any:
    """A module of the extra ``dask``."""
    return import_extra("A map in tiles", "dask.distributed, zarr and filelock", "dask", "zarr", module)[1]


def memory_of(tile: int) -> int:
    """Bytes of a worker whose tiles have so many nodes along a side."""
    return PER_NODE * (tile + 2 * Tiling().halo) ** 2 + BESIDES


def tile_that_fits(share: int) -> int:
    """Side of the largest tile that a worker of so many bytes can hold with its halo."""
    for tile in TILES:
        if memory_of(tile) <= share:
            return tile
    raise CapacityError(f"--memory: {share:,} bytes a worker; one needs at least {memory_of(TILES[-1]):,}.")


def run(job: Job, group: Any, client: Any, progress: Progress | None) -> None:
    """Compute all tiles that are not done yet into the scratch group."""
    layout = job.layout
    boxes = list(layout.boxes())
    overviews = layout.needs_overviews and not layout.single
    steps = 2 * len(boxes) if overviews or layout.undecided else len(boxes)
    done = int(np.count_nonzero(group["low_done"][:]) + np.count_nonzero(group["done"][:]))
    tell = (lambda n: progress(n, steps)) if progress else (lambda n: None)
    with warnings.catch_warnings():  # of tables of a sky, 10 to 30 MB, which each worker needs once
        warnings.filterwarnings("ignore", "Sending large graph")
        # results of tasks, which are computed again where a worker that held them dies
        there = client.submit(_same, job, pure=False)
    top: Any = None
    if steps > len(boxes):
        done = _each(client, _reduce, there, group["low_done"], done, tell)
        there = client.submit(_decided, there, pure=False)
    if overviews:
        top = client.submit(_top, there, pure=False)
    _each(client, _compute, there, group["done"], done, tell, top)


def _same(job: Job) -> Job:
    return job


def _decided(job: Job) -> Job:
    """The job once all tiles have decided whether light between surfaces counts."""
    if not job.layout.undecided:
        return job
    sums = _held(job, "r")["sums"][:].sum(0)
    work, layout = decided_by_sums(job.quantity.work, job.layout, sums)
    return job._replace(layout=layout, quantity=job.quantity._replace(work=work))


def _each(
    client: Any,
    task: Callable[..., None],
    job: Any,
    flags: Any,
    done: int,
    tell: Callable[[int], None],
    *more: Any,
) -> int:
    """Run ``task`` (job, number, ...) for every tile that has no flag; how many are done then."""
    left = np.flatnonzero(flags[:] == 0).tolist()
    futures = [client.submit(task, job, number, *more, pure=False) for number in left]
    tell(done)
    try:
        for future in _finished(client, futures):
            future.result()
            done += 1
            tell(done)
    except BaseException:
        client.cancel(futures)
        raise
    return done


def _finished(client: Any, futures: list[Any]) -> Iterator[Any]:
    """Futures as they end; it is said once where no worker is at work for long."""
    completed = importlib.import_module("distributed").as_completed(futures)
    said, since = False, time.monotonic()
    while not completed.is_empty():
        if batch := completed.next_batch(block=False):
            yield from batch
            since = time.monotonic()
            continue
        time.sleep(POLL)
        if not said and time.monotonic() - since > WAIT:
            workers = client.scheduler_info(n_workers=-1)["workers"].values()
            if said := all(worker["status"] != "running" for worker in workers):
                typer.echo(
                    f"Waiting: none of {len(workers)} workers computes, probably for lack of memory; Ctrl-C"
                    " keeps finished tiles.",
                    err=True,
                )


def _window(job: Job, box: Any, depths: list[int]) -> np.ndarray:
    rows, cols = (
        slice(max(0, first - depth), min(nodes, first + count + depth))
        for (first, count), depth, nodes in zip(box, depths, job.layout.shape)
    )
    try:
        heights = geo.window(job.file, rows, cols, job.dtype)
        if (state := state_of(job.file)) == job.state:
            return np.float32(job.quantity.sign) * heights
        text = f"{job.file}: it has changed since the run began, from {job.state} to {state} (bytes, UTC)."
    except InputError as error:
        text = str(error)
    raise InputError(text)  # here, since Dask cannot send what caused it, an error of rasterio's


def _reduce(job: Job, number: int) -> None:
    """Overviews of a tile at the first level that is looked at, and its part in what all tiles decide."""
    group, box = _held(job), list(job.layout.boxes())[number]
    first, window = job.layout.tiling.first, _window(job, box, [0, 0])
    if job.layout.undecided:
        work = job.quantity.work
        group["sums"][number] = sums_of_tile(work, job.layout.spacing, window, job.quantity.albedo)
    low = coarser(from_heights(window), first)
    row, col = (start >> first for start, _ in box)
    group["low"][:, row : row + low.shape[1], col : col + low.shape[2]] = low
    group["low_done"][number] = 1


def _compute(job: Job, number: int, top: Top | None) -> None:
    """The quantity itself."""
    group, layout = _held(job), job.layout
    box = list(layout.boxes())[number]
    low = None if top is None else around_tile(group["low"], layout, box)
    window, quantity = _window(job, box, layout.depths), job.quantity
    bands = quantity.bands
    part = None if bands == 1 else slice(0, bands)
    values = tile_of(quantity.work, layout, box, window, low, top, part, quantity.albedo)
    (row, rows), (col, cols) = box
    group["values"][:, row : row + rows, col : col + cols] = values.reshape(bands, rows, cols)
    group["done"][number] = 1


def _top(job: Job) -> Top:
    """The levels that all tiles use, from the overviews of all tiles."""
    tiling, low = job.layout.tiling, _held(job, "r")["low"]
    times = tiling.top - tiling.first
    rows = tiling.tile >> tiling.first
    return top_of(
        np.concatenate([coarser(low[:, r : r + rows], times) for r in range(0, low.shape[1], rows)], 1)
    )


# -- the scratch group


def scratch_of(job: Job, resume: bool) -> Any:
    """The Zarr group of a job: the one that was begun, with ``resume``, or a new one.

    A new one has a name of its own: on a cluster, tasks of a run that was interrupted go on until they have
    written their tiles, which are another run's.
    """
    size, changed = job.state
    told = dict(file=str(job.file), bytes=size, changed=changed, **job.quantity.settings)
    text = json.dumps(
        {
            **told,
            "backend": job.backend,  # by its name, since "auto" may be another on another machine
            "tiling": str(job.layout.tiling),
            "spacing": job.layout.spacing,
            "skylamp": skylamp.__version__,
            "form": SCRATCH_FORM,
        },
        sort_keys=True,
    )
    mark = hashlib.sha256(text.encode()).hexdigest()
    kept = _attributes(job.scratch)
    if resume and kept.get("skylamp", mark) != mark:
        before, now = json.loads(kept["settings"]), json.loads(text)
        names = sorted(name for name in before | now if before.get(name) != now.get(name))
        raise bad(
            f"--resume: {job.scratch}",
            "the scratch of " + ", ".join(f"{name} {before.get(name)!r}" for name in names),
            "the same file and settings, " + ", ".join(f"{name} {now.get(name)!r}" for name in names),
            "Run it without --resume to begin anew.",
        )
    if kept and not resume:
        discard(job.scratch)
    if not (kept and resume):  # one file holds these: a process that is killed leaves all of them or none
        zarr = importlib.import_module("zarr")
        kept = {"skylamp": mark, "settings": text, "run": RUN + secrets.token_hex(8)}
        zarr.open_group(job.scratch, mode="w", attributes=kept)
    group = _group(job.scratch, "r+").require_group(kept["run"])
    tiling, tiles = job.layout.tiling, len(list(job.layout.boxes()))
    cells, side = [-(-n // (1 << tiling.first)) for n in job.layout.shape], tiling.tile >> tiling.first
    nan, bands = float("nan"), job.quantity.bands
    group.require_array("low", shape=(2, *cells), chunks=(2, side, side), dtype=job.dtype, fill_value=nan)
    parts = bands, *(tiling.tile // 2,) * 2
    group.require_array(
        "values", shape=(bands, *job.layout.shape), chunks=parts, dtype="float32", fill_value=nan
    )
    if job.layout.undecided:
        colours = job.quantity.work.colours
        group.require_array("sums", shape=(tiles, colours, 3), chunks=(1, colours, 3), dtype="float64")
    for name in ("low_done", "done"):
        group.require_array(name, shape=(tiles,), chunks=(1,), dtype="uint8", fill_value=0)
    return group


@contextlib.contextmanager
def locked(scratch: Path) -> Iterator[None]:
    """Keep other runs out of a scratch group; InputError where one is in it.

    The lock is the operating system's, which frees it when the process ends, however that may be.
    """
    filelock = _imported("filelock")
    lock = filelock.FileLock(scratch.with_name(scratch.name + ".lock"))
    try:
        lock.acquire(blocking=False)
    except (filelock.Timeout, OSError) as error:
        if isinstance(error, filelock.Timeout) and Path(lock.lock_file).exists():
            allowed, advice = "one run at a time", "Wait for it."
            raise bad(f"--out: {scratch}", "a scratch that another run writes", allowed, advice) from None
        raise bad(f"--out: {scratch.parent}", f"no new file there ({error})", "one to write in") from None
    try:
        yield
    finally:
        with contextlib.suppress(PermissionError):  # on Windows, where the release removes it
            Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()


def _attributes(scratch: Path) -> dict[str, Any]:
    """Of a scratch group; none where it is not begun. InputError where anything else has its name."""
    if not scratch.exists():
        return {}
    group = _group(scratch, "r+") if scratch.is_dir() else None
    attributes = {} if group is None else group.attrs.asdict()
    if {"skylamp", "settings"} <= attributes.keys():
        return attributes
    names = [path.name for path in scratch.iterdir()] if scratch.is_dir() else ["a file"]
    # left by a process that was killed before the attributes were written, or by tasks that ended late
    empty = all(
        name.endswith(".partial") or name.startswith(RUN) or (name == "zarr.json" and group is not None)
        for name in names
    )
    if attributes or not empty:
        raise bad(f"{scratch}", "something that skylamp did not write", "a free name for scratch")
    return {}


def discard(scratch: Path) -> None:
    """Remove a scratch group: what is done first, its attributes last: what is left can be resumed."""
    for path in sorted(scratch.glob("*/*"), key=lambda path: not path.name.endswith("done")):
        if path.is_dir():
            _remove(path)
    _remove(scratch)


def _remove(folder: Path) -> None:
    """Remove a folder, but for what tasks of an interrupted run write into it at the same time."""
    try:
        shutil.rmtree(folder)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.ENOENT):
            raise


def _group(path: Path, mode: str) -> Any:
    zarr = importlib.import_module("zarr")
    try:
        return zarr.open_group(path, mode=mode)
    except (FileNotFoundError, ValueError, KeyError):
        return None


def _held(job: Job, mode: str = "r+") -> Any:
    """The scratch group in a task; InputError where the worker does not see it."""
    group = _group(job.scratch / job.run, mode)
    if group is None:
        raise InputError(
            f"--scheduler: a worker finds no {job.scratch}, where tiles are kept. Workers need the same files"
            " under the same names."
        )
    return group


# -- workers and the file that is written


@contextlib.contextmanager
def workers_of(machines: Machines) -> Iterator[Any]:
    """A client of a running scheduler, or of processes of this machine that share its memory."""
    distributed = _imported("distributed")
    CommClosedError = importlib.import_module("distributed.comm").CommClosedError
    with contextlib.ExitStack() as stack:
        at: Any = machines.scheduler
        if at is None:
            limit = "auto" if machines.share is None else machines.share
            options: dict[str, Any] = dict(threads_per_worker=2, processes=True)
            cluster = distributed.LocalCluster(
                n_workers=machines.workers,
                memory_limit=limit,
                silence_logs=50,
                dashboard_address=ANY_PORT,
                **options,
            )
            at = stack.enter_context(cluster)
        try:
            client = stack.enter_context(distributed.Client(at, timeout=WAIT))
        except (OSError, ValueError) as error:
            raise InputError(f"--scheduler {at}: no scheduler answers there ({error}).") from error
        try:
            client.wait_for_workers(1, timeout=WAIT)
        except TimeoutError:
            raise InputError(f"--scheduler {at}: it has had no workers for {WAIT} s.") from None
        # of a worker that died, whose tiles another one computes, and of a scheduler that did
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL + 1)
        try:
            client.register_plugin(devices())
            if machines.scheduler is None:
                client.run(_be_silent)
            yield client
        except (distributed.KilledWorker, CommClosedError) as error:
            more = "Give more of it, fewer --workers" if machines.scheduler is None else "Give them more"
            raise CapacityError(
                f"--memory: all workers that computed a tile died, probably for lack of memory. {more} or a"
                " smaller --tile."
            ) from error
        except concurrent.futures.CancelledError as error:
            raise InputError(f"--scheduler {at}: the connection to it was lost.") from error


def _be_silent() -> None:
    """In a worker: the client gives its warnings, once each, and ends it when it is interrupted itself."""
    warnings.formatwarning = lambda *_, **__: ""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def write(out: str, maps: Any, header: geo.Raster, cog: bool) -> None:
    """Write a Zarr array (bands, rows, cols) as a GeoTIFF, by blocks of rows.

    ``cog``: one for the cloud, with overviews. Raises OSError where the disk is full.
    """
    rasterio = importlib.import_module("rasterio")
    copy = importlib.import_module("rasterio.shutil").copy
    failures = rasterio.errors.RasterioError, importlib.import_module("rasterio._err").CPLE_BaseError
    with _none_left(out), replacing_file(out, UNFINISHED) as path:
        try:
            plain = path.with_name(path.name + ".plain") if cog else path
            _write_plain(plain, maps, header)
            if cog:
                options = dict(
                    compress="ZSTD", predictor="YES", bigtiff="IF_SAFER", overview_resampling="AVERAGE"
                )
                copy(plain, path, driver="COG", **options)
            _read_back(path)
        except failures as error:
            raise OSError(
                f"{out}: what was written cannot be read; the disk may be full ({error})"
            ) from error


@contextlib.contextmanager
def _none_left(out: str) -> Iterator[None]:
    """Remove what this run, or an earlier one that was killed, leaves of the file that becomes ``out``."""
    path = Path(out).resolve()

    def remove() -> None:
        for left in path.parent.glob(glob.escape(path.name + UNFINISHED) + "*"):
            left.unlink(missing_ok=True)

    remove()
    try:
        yield
    finally:
        remove()


def _write_plain(path: Path, maps: Any, header: geo.Raster) -> None:
    """Write a GeoTIFF without overviews."""
    rasterio = importlib.import_module("rasterio")
    bands, rows, cols = maps.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=cols,
        height=rows,
        count=bands,
        dtype="float32",
        crs=header.crs,
        transform=header.transform,
        nodata=np.nan,
        compress="zstd",
        predictor=3,
        tiled=True,
        blockxsize=TIFF_BLOCK,
        blockysize=TIFF_BLOCK,
        bigtiff="if_safer",
        num_threads="all_cpus",
    ) as file:
        file.update_tags(AREA_OR_POINT="Point" if header.point else "Area")
        step = maps.chunks[1]
        for row in range(0, rows, step):
            part = maps[:, row : row + step]
            file.write(part, window=((row, row + part.shape[1]), (0, cols)))


def _read_back(path: Path) -> None:
    """Read all blocks and overviews: neither GDAL's threads nor closing a file tell that the disk is full."""
    rasterio = importlib.import_module("rasterio")
    with rasterio.open(path) as file:
        levels = len(file.overviews(1))
    for level in ({}, *({"overview_level": level} for level in range(levels))):
        with rasterio.open(path, num_threads="all_cpus", **level) as file:
            for row in range(0, file.height, TIFF_BLOCK):
                file.read(window=((row, min(row + TIFF_BLOCK, file.height)), (0, file.width)))
