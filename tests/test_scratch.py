"""What `--memory` keeps beside its output, as killed processes and other versions leave it."""

import json
import os

import numpy as np
import pytest

from skylamp.app import out_of_core
from skylamp.errors import InputError
from skylamp.light.far import Tiling
from skylamp.scale import Audit, layout_of_map

zarr = pytest.importorskip("zarr")


@pytest.fixture
def job(tmp_path):
    """One of six tiles."""
    (tmp_path / "dem.tif").write_bytes(b"heights")
    quantity = out_of_core.horizon("sky-view-factor", "tilted", 8, None, "numpy")
    layout = layout_of_map(Tiling(32, 16, 8), (70, 100), 30.0, False, None, Audit("numpy"))
    path = tmp_path / "dem.tif"
    state = out_of_core.state_of(path)
    return out_of_core.Job(path, state, tmp_path / "out.tif.scratch", layout, quantity)


def names(group):
    return sorted(name for name, _ in group.arrays())


def test_a_scratch_goes_on_or_begins_anew(job):
    """With --resume what is done stays; without, nothing does."""
    group = out_of_core.scratch_of(job, resume=True)
    assert names(group) == ["done", "low", "low_done", "values"] and not group["done"][:].any()
    group["done"][3], group["values"][0, 5] = 1, 7
    kept = out_of_core.scratch_of(job, resume=True)
    assert kept["done"][:].tolist() == [0, 0, 0, 1, 0, 0] and (kept["values"][0, 5] == 7).all()
    fresh = out_of_core.scratch_of(job, resume=False)
    assert not fresh["done"][:].any() and np.isnan(fresh["values"][:]).all()


def test_late_tasks_of_an_interrupted_run_write_nothing_into_the_next(job):
    """A cluster goes on with tasks that run as their client stops: their tiles were in the next file."""
    late = out_of_core.scratch_of(job, resume=False)
    values, done = late["values"], late["done"]
    other = job._replace(quantity=out_of_core.horizon("sky-view-factor", "tilted", 12, None, "numpy"))
    fresh = out_of_core.scratch_of(other, resume=False)
    values[0, :32], done[0] = 7, 1
    assert not fresh["done"][:].any() and np.isnan(fresh["values"][:]).all()
    out_of_core.discard(job.scratch)
    values[0, :32], done[0] = 7, 1  # leaves a folder that is in nobody's way
    again = out_of_core.scratch_of(other, resume=False)
    assert not again["done"][:].any() and again.basename != late.basename
    assert out_of_core.scratch_of(other, resume=True).basename == again.basename


def test_a_scratch_of_an_earlier_form_is_known(job):
    """It had no runs: it begins anew, and --resume says why not; it was called another program's."""
    out_of_core.scratch_of(job, resume=False)
    group = zarr.open_group(job.scratch, mode="r+")
    settings = {**json.loads(group.attrs["settings"]), "form": 3}
    group = zarr.open_group(
        job.scratch, mode="w", attributes={"skylamp": "", "settings": json.dumps(settings)}
    )
    group.create_array("done", shape=(6,), dtype="uint8")
    now = out_of_core.SCRATCH_FORM
    with pytest.raises(InputError, match=f"--resume.*the scratch of form 3; allowed.*form {now}"):
        out_of_core.scratch_of(job, resume=True)
    assert names(out_of_core.scratch_of(job, resume=False)) == ["done", "low", "low_done", "values"]


def test_another_backend_does_not_go_on(job):
    """Its bytes may be others: "auto" is an OpenCL device here and a GPU there."""
    out_of_core.scratch_of(job._replace(backend="opencl:0:0"), resume=False)
    with pytest.raises(InputError, match="--resume.*opencl:0:0"):
        out_of_core.scratch_of(job._replace(backend="numpy"), resume=True)


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("left", ["nothing", "part of a file", "a group", "attributes", "some arrays"])
def test_a_run_that_was_killed_as_it_began_is_no_hindrance(job, left, resume):
    """At every step until all arrays are there, the next run has a whole scratch."""
    if left in ("nothing", "part of a file"):
        job.scratch.mkdir()
    if left == "part of a file":
        (job.scratch / "zarr.0123abcd.partial").write_text("{")
    if left == "a group":
        zarr.open_group(job.scratch, mode="w")
    if left in ("attributes", "some arrays"):
        out_of_core.scratch_of(job, resume=False)
        attributes = zarr.open_group(job.scratch, mode="r").attrs.asdict()
        out_of_core.discard(job.scratch)
        group = zarr.open_group(job.scratch, mode="w", attributes=attributes)
        if left == "some arrays":
            held = group.create_group(attributes["run"])
            held.create_array("low", shape=(2, 35, 50), chunks=(2, 16, 16), dtype="float32")
    group = out_of_core.scratch_of(job, resume)
    assert names(group) == ["done", "low", "low_done", "values"] and not group["done"][:].any()
    assert {"skylamp", "settings", "run"} <= zarr.open_group(job.scratch, mode="r").attrs.keys()


def test_the_attributes_of_a_scratch_are_written_at_once(job, monkeypatch):
    """There is no moment at which a group is there without them."""
    seen = []

    class Stopped(Exception):
        pass

    def stop(*_, **__):
        seen.append(json.loads((job.scratch / "zarr.json").read_text())["attributes"])
        raise Stopped

    monkeypatch.setattr(zarr.Group, "require_array", stop)
    with pytest.raises(Stopped):
        out_of_core.scratch_of(job, resume=False)
    assert {"skylamp", "settings"} <= seen[0].keys()


@pytest.mark.parametrize("folders", range(5))
def test_a_run_that_was_killed_as_it_ended_computes_again(job, monkeypatch, folders):
    """However many folders were removed by then: what is said to be done is there."""
    group = out_of_core.scratch_of(job, resume=False)
    for name in names(group):
        group[name][:] = 1
    remove, left = out_of_core.shutil.rmtree, iter(range(folders))

    def killed(path):
        next(left)
        remove(path)

    monkeypatch.setattr(out_of_core.shutil, "rmtree", killed)
    with pytest.raises(StopIteration):
        out_of_core.discard(job.scratch)
    kept = out_of_core.scratch_of(job, resume=True)
    for name, flags in (("low", "low_done"), ("values", "done")):
        assert (kept[name][:] == 1).all() or not kept[flags][:].any()
    assert kept["done"][:].all() == (folders == 0)


@pytest.mark.parametrize("other", ["form", "settings", "file"])
def test_a_scratch_of_something_else_is_refused_or_begins_anew(job, monkeypatch, other):
    """Arrays of another form, other settings, a file that has changed: the error has both."""
    out_of_core.scratch_of(job, resume=False)["done"][:] = 1
    if other == "form":
        monkeypatch.setattr(out_of_core, "SCRATCH_FORM", 99)
    elif other == "settings":
        quantity = out_of_core.horizon("sky-view-factor", "tilted", 12, None, "numpy")
        job = job._replace(quantity=quantity)
    else:
        job.file.write_bytes(b"other heights")
        job = job._replace(state=out_of_core.state_of(job.file))
    with pytest.raises(InputError, match="--resume.*the scratch of .*the same file and settings.*begin anew"):
        out_of_core.scratch_of(job, resume=True)
    assert not out_of_core.scratch_of(job, resume=False)["done"][:].any()


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("theirs", ["a file", "a folder", "a group", "an array", "attributes"])
def test_what_others_keep_under_its_name_stays(job, theirs, resume):
    """One error; nothing is removed."""
    if theirs == "a file":
        job.scratch.write_text("theirs")
    elif theirs == "a folder":
        job.scratch.mkdir()
        (job.scratch / "theirs.txt").write_text("theirs")
    elif theirs == "an array":
        zarr.create_array(job.scratch, shape=(3,), dtype="f4")
    else:
        attributes = {"skylamp": "of a version without settings"} if theirs == "attributes" else {}
        group = zarr.open_group(job.scratch, mode="w", attributes=attributes)
        if theirs == "a group":
            group.create_array("theirs", shape=(3,), dtype="f4")
    before = sorted(os.walk(job.scratch))
    with pytest.raises(InputError, match="something that skylamp did not write; allowed: a free name"):
        out_of_core.scratch_of(job, resume)
    assert job.scratch.exists() and sorted(os.walk(job.scratch)) == before


def test_two_runs_do_not_share_a_scratch(job):
    """The second is one error; when the first ends, it may."""
    with out_of_core.locked(job.scratch):
        with pytest.raises(InputError, match="out.tif.scratch.*another run.*one run at a time"):
            with out_of_core.locked(job.scratch):
                pass
        assert sorted(os.listdir(job.scratch.parent)) == ["dem.tif", "out.tif.scratch.lock"]
    assert os.listdir(job.scratch.parent) == ["dem.tif"]
    with out_of_core.locked(job.scratch):
        pass
