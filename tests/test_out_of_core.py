"""`skylamp horizon` and `render --memory`: a file of any size to a file, interrupted and resumed."""

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from compare import assert_bits_equal
from surfaces import rms
from test_scale import mountains

import skylamp as sl
from skylamp.app import cli, out_of_core
from skylamp.backends import select
from skylamp.errors import CapacityError, InputError
from skylamp.io import geotiff as geo

rasterio = pytest.importorskip("rasterio")
da = pytest.importorskip("dask.array")
dask = pytest.importorskip("dask")
zarr = pytest.importorskip("zarr")
distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.slow  # processes start, and import
NODATA, TILE = -9999.0, 256
MEMORY = ["--memory", "3GB", "--tile", str(TILE)]
NOTHING = out_of_core.Computation(None, None, {})
OPTIONS = ["--azimuths", "8", *MEMORY]


@pytest.fixture(scope="module")
def dem(tmp_path_factory):
    """(path, heights with nan) of a GeoTIFF of 30 m cells with a gap."""
    path, heights = tmp_path_factory.mktemp("dem") / "dem.tif", 30 * mountains(600, 768, 40)
    heights[100:300, 500:560] = NODATA
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=768,
        height=600,
        count=1,
        dtype="float32",
        crs="EPSG:32633",
        transform=rasterio.transform.from_origin(5e5, 5e6, 30, 30),
        nodata=NODATA,
    ) as file:
        file.write(heights, 1)
    return path, np.where(heights == NODATA, np.nan, heights)


def command(path, out, *more, of="horizon"):
    options = OPTIONS if of == "horizon" else MEMORY
    return [sys.executable, "-m", "skylamp", of, str(path), "--out", str(out), *options, *more]


def run(path, out, *more, of="horizon"):
    done = subprocess.run(command(path, out, *more, of=of), capture_output=True, text=True, timeout=500)
    return done.returncode, done.stderr


def refused(of, path, folder, capsys, more, code, what):
    """A command in this process ends with this code, says so, and leaves no file."""
    with pytest.raises(SystemExit) as ended:
        cli.main([of, str(path), "--out", str(folder / "o.tif"), *more])
    said = capsys.readouterr().err
    assert (ended.value.code, what in said) == (code, True), said
    assert os.listdir(folder) == []


def interrupted(told, scratch):
    """Exit code of a command that gets Ctrl-C, as its workers do, once a tile is done: it says what stays."""
    process, done = subprocess.Popen(told, stderr=subprocess.PIPE, text=True, start_new_session=True), 0
    for _ in range(3000):
        time.sleep(0.05)
        if process.poll() is not None or done:
            break
        done = len(list(scratch.glob("run-*/done/c/*")))
    os.killpg(process.pid, signal.SIGINT)
    said = [line for line in process.communicate(timeout=100)[1].splitlines() if line.strip()]
    assert done
    assert said[-1] == f"Interrupted: finished tiles are in {scratch}; --resume continues."
    assert not any("Traceback" in line for line in said), said
    return process.returncode


def lazily(heights, work=sl.sky_view_factor, **options):
    scene = sl.Scene.from_height(da.from_array(heights, chunks=300), 30.0)
    return work(scene, azimuths=8, tiling=sl.Tiling(TILE), **options).compute(scheduler="sync")


def test_a_file_is_computed_as_a_lazy_map_is(dem, tmp_path):
    """The bytes of Dask's arrays; georeference, gaps, blocks; nothing else is left. Two processes, a COG.

    The backend that "auto" took is named.
    """
    path, heights = dem
    for more, work, options in (
        ((), sl.sky_view_factor, {}),
        (
            ("--workers", "2", "--cog", "--what", "negative-openness", "--max-distance", "900"),
            sl.openness,
            dict(negative=True, max_distance=900.0),
        ),
    ):
        told = command(path, tmp_path / "out.tif", "--json", *more)
        done = subprocess.run(told, capture_output=True, text=True, timeout=500)
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout)
        assert (report["backend"], report["shape"]) == (select("auto").name, [600, 768])
        with rasterio.open(tmp_path / "out.tif") as file, rasterio.open(path) as given:
            found = file.read(1)
            assert (file.crs, file.transform, file.shape) == (given.crs, given.transform, given.shape)
            assert np.isnan(file.nodata) and file.profile["tiled"]
            assert bool(file.overviews(1)) == ("--cog" in more)
        assert np.array_equal(np.isnan(found), np.isnan(heights))
        assert_bits_equal(np.nan_to_num(found), np.nan_to_num(lazily(heights, work, **options)))
        assert sorted(os.listdir(tmp_path)) == ["out.tif"]


def test_json_holds_the_warnings_of_tiles(monkeypatch, capsys):
    """As of other commands; they were on stderr alone, where a log of many files does not see them."""

    def write(*given):
        warnings.warn("Tolerance: far ground", stacklevel=1)
        return (2, 3), "opencl:0:0"

    monkeypatch.setattr(out_of_core, "write_quantity", write)
    with pytest.warns(UserWarning, match="far ground"):
        cli._by_tiles(Path("in.tif"), "out.tif", None, None, True)
    assert json.loads(capsys.readouterr().out)["warnings"] == ["Tolerance: far ground"]


def test_an_interrupt_before_any_tile_promises_none(dem, tmp_path, monkeypatch, capsys):
    """There is nothing to resume, and no folder."""

    def interrupted(machines):
        raise KeyboardInterrupt

    monkeypatch.setattr(out_of_core, "workers_of", interrupted)
    machines = out_of_core.Machines("3GB", 1, None, TILE, False, False)
    quantity = out_of_core.horizon("openness", "tilted", 8, None, "numpy")
    with pytest.raises(KeyboardInterrupt):
        out_of_core.write_quantity(dem[0], str(tmp_path / "out.tif"), quantity, machines, None)
    assert not capsys.readouterr().err and not list(tmp_path.glob("out*"))


def test_heights_far_above_zero_keep_their_relief(tmp_path):
    """Float64 and int32 of a billion metres: what the relief alone gives in float32, near and far."""
    relief, found = np.rint(30 * mountains(600, 768, 40)).astype(float), {}
    options = dict(driver="GTiff", width=768, height=600, count=1, crs="EPSG:32633")
    options["transform"] = rasterio.transform.from_origin(5e5, 5e6, 30, 30)
    quantity = out_of_core.horizon("sky-view-factor", "tilted", 8, None, "auto")
    with distributed.LocalCluster(
        1, threads_per_worker=2, processes=False, dashboard_address=None
    ) as cluster:
        machines = out_of_core.Machines(None, 1, cluster.scheduler_address, TILE, False, False)
        for kind in ("float32", "float64", "int32"):
            path, out = tmp_path / "dem.tif", str(tmp_path / "out.tif")
            with rasterio.open(path, "w", dtype=kind, **options) as file:
                file.write((relief + (0 if kind == "float32" else 10**9)).astype(kind), 1)
            out_of_core.write_quantity(path, out, quantity, machines, None)
            with rasterio.open(out) as file:
                found[kind] = file.read(1)
    for kind in ("float64", "int32"):
        np.testing.assert_allclose(found[kind], found["float32"], rtol=0, atol=2e-6)


def test_tiles_write_what_one_map_writes(tmp_path, fast):
    """A file whose rows go north: transform, nodata tag and gaps are those of `skylamp render` at once."""
    heights = 30 * mountains(300, 384, 40)
    heights[100:150, 200:260] = NODATA
    path, whole, tiles = (tmp_path / name for name in ("dem.tif", "whole.tif", "tiles.tif"))
    options = dict(driver="GTiff", width=384, height=300, count=1, crs="EPSG:32633", dtype="float32")
    up = rasterio.Affine(30, 0, 5e5, 0, 30, 5e6)
    with rasterio.open(path, "w", transform=up, nodata=NODATA, **options) as file:
        file.write(heights[::-1], 1)
    sky, words = sl.Sky(sl.cie_clear((150.0, 30.0))), dict(method="horizon", interreflection=False)
    raster = geo.read(path)
    geo.write(whole, sl.render(raster.scene(), sky, backend=fast, azimuths=16, **words).image, raster)
    quantity = out_of_core.image(path, sl.Lambertian(0.8), sky, fast, {}, azimuths=16, **words)
    with distributed.LocalCluster(
        1, threads_per_worker=2, processes=False, dashboard_address=None
    ) as cluster:
        machines = out_of_core.Machines(None, 1, cluster.scheduler_address, 128, False, False)
        out_of_core.write_quantity(path, str(tiles), quantity, machines, None)
    with rasterio.open(whole) as a, rasterio.open(tiles) as b:
        assert a.transform == b.transform and b.transform.e == -30 and (a.crs, a.dtypes) == (b.crs, b.dtypes)
        assert np.isnan(a.nodata) and np.isnan(b.nodata)
        found, expected = b.read(1), a.read(1)
    assert np.array_equal(np.isnan(expected), heights == NODATA)
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.05 * np.nanmean(expected))


def test_a_second_run_of_one_output_is_refused(dem, tmp_path):
    """As long as the first lives, also stopped; once it is killed, the next run goes on from its scratch."""
    path, heights = dem
    out, scratch = tmp_path / "out.tif", tmp_path / "out.tif.scratch"
    first = subprocess.Popen(command(path, out), stderr=subprocess.DEVNULL)
    try:
        for _ in range(3000):
            time.sleep(0.02)
            if scratch.exists() or first.poll() is not None:
                break
        first.send_signal(signal.SIGSTOP)
        code, said = run(path, out, "--max-distance", "2000")
    finally:
        first.kill()
        first.wait()
    assert code == 3 and "another run" in said and "--debug" not in said
    code, said = run(path, out, "--resume")
    assert code == 0, said
    with rasterio.open(out) as file:
        assert_bits_equal(np.nan_to_num(file.read(1)), np.nan_to_num(lazily(heights)))
    assert os.listdir(tmp_path) == ["out.tif"]


def test_an_interrupted_image_goes_on(dem, tmp_path):
    """In colour under a sky with a sun. Ctrl-C keeps the scratch and writes no file; --resume, here by two
    processes, computes what is left, and gives the bytes of a lazy map. Other settings do not go on from it.
    """
    path, heights = dem
    out, scratch = tmp_path / "out.tif", tmp_path / "out.tif.scratch"
    told = ["--source", "clear", "--sun", "135,20", "--direct", "4", "--albedo", ".2,.5,.8"]
    told += ["--interreflection", "off"]  # tests/test_scale.py has it
    assert interrupted(command(path, out, *told, of="render"), scratch) != 0 and not out.exists()
    (held,) = scratch.glob("run-*")
    flags = zarr.open_group(held, mode="r")["done"][:]
    assert flags.any()
    first = held / "done" / "c" / str(int(flags.argmax()))
    written = first.stat().st_mtime_ns
    code, said = run(path, out, *told, "--quantity", "irradiance", "--resume", of="render")
    assert code == 3 and "--resume" in said
    assert first.stat().st_mtime_ns == written
    code, said = run(path, out, *told, "--resume", "--workers", "2", "--cog", of="render")
    assert code == 0, said
    scene = sl.Scene.from_height(da.from_array(heights, chunks=300), 30.0, albedo=np.array([0.2, 0.5, 0.8]))
    sky = sl.Sky(sl.cie_sky(12, (135.0, 20.0), direct=4.0))
    image = sl.render(scene, sky, tiling=sl.Tiling(TILE), interreflection=False).image.compute(
        scheduler="sync"
    )
    with rasterio.open(out) as file:
        assert_bits_equal(np.nan_to_num(file.read()), np.nan_to_num(image.transpose(2, 0, 1)))
        assert file.overviews(1) and file.crs.to_epsg() == 32633
    assert sorted(os.listdir(tmp_path)) == ["out.tif"]


def test_two_names_of_one_output_are_one_run(dem, tmp_path, capsys):
    """The file of one run took the name of the other's, exit code 0."""
    link, real = tmp_path / "link.tif", tmp_path / "real.tif"
    link.symlink_to(real)
    with out_of_core.locked(real.with_name("real.tif.scratch")), pytest.raises(SystemExit) as ended:
        cli.main(["horizon", str(dem[0]), "--out", str(link), *OPTIONS])
    assert ended.value.code == 3 and "another run" in capsys.readouterr().err


def test_a_file_that_changes_during_a_run_is_an_error(dem, tmp_path):
    """Its tiles were of two maps, exit code 0."""
    path = tmp_path / "in.tif"
    shutil.copy(dem[0], path)
    job = out_of_core.Job(
        path, out_of_core.state_of(path), tmp_path, SimpleNamespace(shape=(600, 768)), NOTHING
    )
    box = (0, 8), (0, 8)
    assert out_of_core._window(job, box, [0, 0]).shape == (8, 8)
    os.utime(path, (1, 1))
    with pytest.raises(InputError, match=r"in.tif: it has changed since the run began.*1970-01-01T00:00:01"):
        out_of_core._window(job, box, [0, 0])


def test_a_scratch_that_is_removed_is_said(dem, tmp_path, monkeypatch, capsys):
    """And nobody is sent to it."""
    client = SimpleNamespace(nthreads=lambda: {"a": 1}, run=lambda *_: {"a": "numpy"})
    monkeypatch.setattr(out_of_core, "workers_of", lambda _: contextlib.nullcontext(client))
    monkeypatch.setattr(out_of_core, "run", lambda job, *_: shutil.rmtree(job.scratch))
    with pytest.raises(SystemExit) as ended:
        cli.main(["horizon", str(dem[0]), "--out", str(tmp_path / "o.tif"), *OPTIONS])
    said = capsys.readouterr().err
    assert ended.value.code == 3 and "it was removed" in said and "--resume" not in said


@pytest.fixture
def machines():
    """A cluster of one worker in this process."""
    with distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=None) as cluster:
        yield out_of_core.Machines(None, 1, cluster.scheduler_address, TILE, False, False)


def test_a_scheduler_that_is_lost_is_one_error(machines):
    """Its futures are cancelled."""
    with pytest.raises(InputError, match="the connection to it was lost"), out_of_core.workers_of(machines):
        raise distributed.client.FutureCancelledError("compute", "scheduler-connection-lost")


def test_workers_that_do_not_compute_are_said(machines, monkeypatch, capsys):
    """Those whose memory is full pause, and no task ends."""
    monkeypatch.setattr(out_of_core, "WAIT", 0.1)
    with distributed.Client(machines.scheduler) as client:
        for status, times in (("running", 0), ("paused", 1)):
            told = {"workers": {"a": {"status": status}}}
            monkeypatch.setattr(client, "scheduler_info", lambda told=told, **_: told)
            futures = [client.submit(time.sleep, 0.6, pure=False)]
            assert list(out_of_core._finished(client, futures)) == futures
            assert capsys.readouterr().err.count("Waiting: none of 1 workers computes") == times


@pytest.mark.parametrize(
    ("more", "code", "what"),
    [
        (["--memory", "3GB", "--lamp", "0,0,0,9"], 3, "a task reads one tile"),
        (["--memory", "3GB", "--window", "0,9,0,9"], 3, "any tile on its way"),
        (["--memory", "3GB", "--specular", ".1"], 3, "over any tile"),
        (["--memory", "3GB", "--tolerance", ".1%"], 3, "tolerance"),
        (["--memory", "3GB", "--nodata", "0"], 2, "goes with"),
        (["--memory", "3GB", "--exposure", "1"], 2, "--exposure"),
        (["--cog"], 2, "--memory"),
    ],
)
def test_what_an_image_in_tiles_does_not_go_with(dem, tmp_path, capsys, more, code, what):
    """One error, before a worker is started."""
    refused("render", dem[0], tmp_path, capsys, more, code, what)


@pytest.mark.parametrize(
    ("more", "code", "what"),
    [
        (["--memory", "many"], 2, "bytes"),
        (["--memory", "0", "--tile", "256"], 2, "bytes"),
        (["--memory", "300MB", "--azimuths", "4"], 1, "memory"),
        (["--memory", "300MB", "--tile", "256"], 1, "one with --tile 256 needs at least"),
        (["--memory", "3GB", "--sides", "dark"], 2, "open sides"),
        (["--memory", "3GB", "--spacing", "-1"], 3, "spacing"),
        (["--memory", "3GB", "--what", "slopes"], 3, "openness"),
        (["--memory", "3GB", "--workers", "0"], 3, "workers"),
        (["--memory", "3GB", "--tile", "1000"], 3, "tile"),
        (["--resume"], 2, "--memory"),
    ],
)
def test_what_does_not_go_with_memory(dem, tmp_path, capsys, more, code, what):
    """One error, before a worker is started."""
    refused("horizon", dem[0], tmp_path, capsys, more, code, what)


def test_another_spacing_goes_with_memory(dem, tmp_path):
    """As of the whole map, which with its own spacing has other sky-view factors."""
    path, heights = dem
    scenes = (
        sl.Scene.from_height(np.nan_to_num(heights), spacing, mask=np.isfinite(heights))
        for spacing in (12.5, 30.0)
    )
    assert run(path, tmp_path / "svf.tif", "--spacing", "12.5")[0] == 0
    found = geo.read(tmp_path / "svf.tif").values
    known = np.isfinite(heights)
    near, far = (rms((found - sl.sky_view_factor(scene, azimuths=8))[known]) for scene in scenes)
    assert near < 1e-3 and far > 0.05


def test_a_damaged_file_is_one_error(dem, tmp_path):
    """That of a worker which meets it, as the file read at once gives it."""
    whole = dem[0].read_bytes()
    (tmp_path / "half.tif").write_bytes(whole[: len(whole) // 2])
    code, said = run(tmp_path / "half.tif", tmp_path / "out.tif")
    assert (
        code == 3 and "half.tif: cannot read" in said and "a whole GeoTIFF" in said and "--debug" not in said
    )


def test_workers_that_die_at_a_tile_are_said(dem, tmp_path, capsys):
    """With what may help; the scratch stays, and that is said."""

    def deadly(*_):
        os._exit(9)

    quantity = out_of_core.horizon("sky-view-factor", "tilted", 8, None, "auto")._replace(work=deadly)
    machines = out_of_core.Machines("3GB", 1, None, TILE, False, False)
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        with pytest.raises(CapacityError, match="--memory.*workers that computed a tile died.*--tile"):
            out_of_core.write_quantity(dem[0], str(tmp_path / "out.tif"), quantity, machines, None)
    assert os.listdir(tmp_path) == ["out.tif.scratch"]
    assert (
        f"Stopped: finished tiles are in {tmp_path / 'out.tif.scratch'}; --resume" in capsys.readouterr().err
    )


def test_a_cog_that_is_not_finished_leaves_nothing(dem, tmp_path, monkeypatch):
    """Neither the file that it would replace nor the plain one that it is made from."""
    from rasterio import shutil

    def interrupt(plain, *_, **__):
        assert Path(plain).exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "copy", interrupt)
    maps = zarr.array(np.zeros((1, 600, 768), np.float32), chunks=(1, 512, 512))
    with pytest.raises(KeyboardInterrupt):
        out_of_core.write(str(tmp_path / "out.tif"), maps, geo.header(dem[0]), True)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("cog", [False, True])
@pytest.mark.parametrize("most", [0.99, 0.6])
def test_a_full_disk_is_an_error_and_keeps_the_file_before(dem, tmp_path, cog, most):
    """As files of at most so many bytes: GDAL said so on stderr alone, and the tiles were gone."""
    maps = zarr.array(np.random.default_rng(0).random((1, 600, 768), np.float32), chunks=(1, 512, 512))
    out, header = tmp_path / "out.tif", geo.header(dem[0])
    out_of_core.write(str(out), maps, header, cog)
    before, (soft, hard) = out.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    told = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(most * len(before)), hard))
    try:
        with pytest.raises(OSError, match="out.tif: what was written cannot be read; the disk may be full"):
            out_of_core.write(str(out), maps, header, cog)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, told)
    assert os.listdir(tmp_path) == ["out.tif"] and out.read_bytes() == before


def test_what_a_killed_run_left_of_its_file_is_removed(dem, tmp_path):
    """By the next run; names were random, and such files stayed."""
    maps = zarr.array(np.zeros((1, 600, 768), np.float32), chunks=(1, 512, 512))
    for name in (".plain", "", ".ovr.tmp"):
        (tmp_path / f"out.tif.scratch.tmp{name}").write_bytes(b"left")
    out_of_core.write(str(tmp_path / "out.tif"), maps, geo.header(dem[0]), False)
    assert os.listdir(tmp_path) == ["out.tif"]


@pytest.mark.parametrize("workers", [1, 3])
def test_there_are_as_many_workers_as_asked(workers):
    """Each with its share of the memory, and two threads."""
    machines = out_of_core.Machines("6GB", workers, None, None, False, False)
    with out_of_core.workers_of(machines) as client:
        client.wait_for_workers(workers, timeout=100)
        found = client.scheduler_info(n_workers=-1)["workers"].values()
    assert [worker["nthreads"] for worker in found] == [2] * workers
    assert {worker["memory_limit"] for worker in found} == {6 * 10**9 // workers}


def test_tiles_fit_the_memory_of_a_worker():
    """The largest that does, and an error where none does."""
    assert out_of_core.tile_that_fits(8 * 10**9) == 8192
    assert out_of_core.tile_that_fits(3 * 10**9) == 4096
    with pytest.raises(CapacityError, match="memory"):
        out_of_core.tile_that_fits(10**8)


def test_a_warning_of_a_tile_is_one_line(dem, tmp_path):
    """Workers printed it too, with the place in the code that gives it."""
    sun = "--source", "clear", "--sun", "180,3", "--tile", "128", "-q"
    code, said = run(dem[0], tmp_path / "o.tif", *sun, of="render")
    lines = said.strip().splitlines()
    assert code == 0 and lines and all(line.startswith("skylamp: warning: ") for line in lines), said
    assert len(set(lines)) == len(lines)


def test_an_address_that_is_none_is_an_error():
    """It was Dask's own ValueError."""
    machines = out_of_core.Machines(None, 1, "garbage", TILE, False, False)
    with pytest.raises(InputError, match="--scheduler garbage: no scheduler answers there"):
        with out_of_core.workers_of(machines):
            pass


def test_a_cluster_without_workers_is_an_error(monkeypatch):
    """It waited for ever, without a word."""
    monkeypatch.setattr(out_of_core, "WAIT", 1)
    with distributed.LocalCluster(1, processes=False, dashboard_address=None) as cluster:
        cluster.scale(0)
        with distributed.Client(cluster) as client:
            while client.nthreads():
                time.sleep(0.01)
        machines = out_of_core.Machines(None, 1, cluster.scheduler_address, TILE, False, False)
        with pytest.raises(InputError, match="it has had no workers for 1 s"):
            with out_of_core.workers_of(machines):
                pass


@pytest.mark.slow
def test_workers_in_another_folder(dem, tmp_path, monkeypatch):
    """A relative output is that of the command, not of its workers; where these see no scratch, they say so.

    It was a TypeError.
    """
    quantity = out_of_core.horizon("sky-view-factor", "tilted", 8, None, "auto")
    with distributed.LocalCluster(1, threads_per_worker=2, processes=True, dashboard_address=None) as cluster:
        machines = out_of_core.Machines(None, 1, cluster.scheduler_address, TILE, False, False)
        monkeypatch.chdir(tmp_path)
        out_of_core.write_quantity(dem[0], "out.tif", quantity, machines, None)
        assert os.listdir(tmp_path) == ["out.tif"]
        with pytest.raises(InputError, match="one of the two"):
            out_of_core.write_quantity(dem[0], "o.tif", quantity, machines._replace(workers=3), None)
        monkeypatch.setattr(Path, "resolve", lambda path: path)
        with pytest.raises(InputError, match="a worker finds no o.tif.scratch"):
            out_of_core.write_quantity(dem[0], "o.tif", quantity, machines, None)
