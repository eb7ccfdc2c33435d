"""Whatever stands around a call, it ends in a result, or in one clear error."""

import _thread
import multiprocessing
import pickle
import resource
import threading

import numpy as np
import pytest
from fuzz import environment

import skylamp as sl
from skylamp import io

RENDER = """
import numpy as np, skylamp as sl, hashlib
z = np.random.default_rng(0).random((16, 21)) * 4
out = sl.render(sl.Scene(z), sl.Sky(), tolerance=0.05, backend="{backend}")
print(hashlib.sha256(np.asarray(out.image).tobytes()).hexdigest())
"""
DEPTH = np.random.default_rng(0).random((16, 21)) * 4


def checksum(backend, **more):
    status, out, errors = environment.ran(RENDER.format(backend=backend), **more)
    assert status == 0, errors[-2000:]
    return out.split()[-1]


@pytest.mark.slow
def test_killed_writers_leave_no_half_file():
    """kill -9 at random moments: the file is the one before or the one after."""
    for suffix in (".npy", ".png", ".tif"):
        half, _ = environment.killed_writers(5, suffix)
        assert half == 0, suffix


@pytest.mark.parametrize("suffix", [".npy", ".png", ".tif"])
def test_a_half_file_is_told_from_a_whole_one(tmp_path, suffix):
    """Also where the writers are so fast that every round finds a file."""
    path = tmp_path / f"out{suffix}"
    for value in (1, 2):
        io.write(path, np.full((700, 900), value, np.uint8))
        assert environment.is_whole(path)
    path.write_bytes(path.read_bytes()[:200])
    assert not environment.is_whole(path)


@pytest.mark.slow
def test_threads_get_the_same_bytes(backend):
    """Eight at once, all kinds of calls."""
    assert environment.wrong_on_threads(backend, calls=8) == 0


@pytest.mark.slow
def test_two_writers_of_one_file(tmp_path):
    """One of them wins; the file is whole at any moment."""
    path = tmp_path / "a.npy"
    arrays = [np.full((300, 400), value, np.float32) for value in (1, 2)]
    io.write(path, arrays[0])
    writers = [threading.Thread(target=lambda a=a: [io.write(path, a) for _ in range(40)]) for a in arrays]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        assert np.ptp(io.read(path)) == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.npy"]


def test_a_full_disk_is_an_oserror_and_leaves_no_trace():
    """An older file stays as it was."""
    with environment.small_disk() as folder:
        if folder is None:
            pytest.skip("mounting a small disk is not allowed here")
        io.write(folder / "a.npy", np.ones((10, 10)))
        with pytest.raises(OSError, match="No space left"):
            io.write(folder / "a.npy", np.zeros((1000, 1000)))
        assert [entry.name for entry in folder.iterdir()] == ["a.npy"]
        assert (io.read(folder / "a.npy") == 1).all()


@pytest.mark.slow
def test_flags_of_python():
    """Warnings as errors with cold caches in the development mode; asserts and docstrings gone."""
    usual = checksum("opencl")
    cold = {"POCL_KERNEL_CACHE": "0", "PYTHONWARNINGS": ""}
    assert checksum("opencl", options=("-W", "error", "-X", "dev"), **cold) == usual
    assert checksum("opencl", options=("-OO",)) == usual


@pytest.mark.slow
def test_a_c_locale_and_no_home(tmp_path):
    """Caches that cannot be made are gone without."""
    nowhere = {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/proc/nowhere", "LC_ALL": "C", "LANG": "C"}
    assert checksum("numpy", **nowhere) == checksum("numpy")


@pytest.mark.slow
def test_four_processes_with_cold_caches(tmp_path):
    """All compile at once into one folder."""
    caches = {"POCL_CACHE_DIR": str(tmp_path / "pocl"), "XDG_CACHE_HOME": str(tmp_path)}
    (tmp_path / "pocl").mkdir()
    found = []
    threads = [threading.Thread(target=lambda: found.append(checksum("opencl", **caches))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [checksum("opencl")] * 4


def test_scenes_and_results_are_pickled(fast):
    """What comes back has the same bytes and renders to the same."""
    scene = sl.Scene(DEPTH, mask=DEPTH > 0.1)
    out = sl.render(scene, sl.Sky(), tolerance=0.1, backend=fast)
    again, there = pickle.loads(pickle.dumps((scene, out)))
    assert again.depth.tobytes() == scene.depth.tobytes()
    assert there.image.tobytes() == out.image.tobytes() and there.error.tobytes() == out.error.tobytes()
    image = sl.render(again, sl.Sky(), tolerance=0.1, backend=fast).image
    assert image.tobytes() == out.image.tobytes()


def _forked(queue, backend="numpy"):
    queue.put(sl.render(sl.Scene(DEPTH), sl.Sky(), azimuths=8, backend=backend).image.tobytes())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Python's own remark on fork with threads
def test_a_forked_child_renders():
    """After the parent has used its threads."""
    expected = sl.render(sl.Scene(DEPTH), sl.Sky(), azimuths=8, backend="numpy").image.tobytes()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_forked, args=(queue,))
    child.start()
    assert queue.get(timeout=60) == expected
    child.join(60)
    assert child.exitcode == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("backend", ["numpy", "warp:cpu"])
def test_a_child_forked_while_a_thread_renders(backend):
    """The thread holds the backend's lock, and is not there in the child, which hung."""
    large = sl.Scene(np.tile(DEPTH, (6, 6)))
    expected = sl.render(sl.Scene(DEPTH), sl.Sky(), azimuths=8, backend=backend).image.tobytes()
    done = threading.Event()

    def work():
        while not done.is_set():
            sl.render(large, sl.Sky(), azimuths=32, backend=backend)

    thread = threading.Thread(target=work)
    thread.start()
    context = multiprocessing.get_context("fork")
    try:
        for _ in range(4):
            queue = context.Queue()
            child = context.Process(target=_forked, args=(queue, backend))
            child.start()
            try:
                assert queue.get(timeout=60) == expected
            finally:
                child.kill()
                child.join()
    finally:
        done.set()
        thread.join()


FORK = """
import os, numpy as np, skylamp as sl
scene = sl.Scene(np.random.default_rng(0).random((16, 21)))
parent = sl.render(scene, sl.Sky(), azimuths=8, backend="opencl").image
child = os.fork()
if child:
    os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
out = sl.render(scene, sl.Sky(), azimuths=8)
assert out.backend in ("warp:cpu", "numpy"), out.backend
np.testing.assert_allclose(out.image, parent, rtol=1e-5)
try:
    sl.render(scene, sl.Sky(), backend="opencl")
except sl.BackendError as error:
    assert "before this process was forked" in str(error) and "spawn" in str(error)
    os._exit(0)
"""


@pytest.mark.slow
def test_a_child_forked_after_opencl_does_not_hang():
    """Drivers' threads are the parent's: they are not available in the child, and "auto" takes another."""
    status, _, errors = environment.ran(FORK)
    assert status == 0, errors[-2000:]


@pytest.mark.slow
def test_a_compiler_says_nothing(tmp_path):
    """With an empty cache, clang counts its remarks on stderr unless told not to."""
    status, _, errors = environment.ran(
        RENDER.format(backend="opencl"), POCL_CACHE_DIR=str(tmp_path), PYOPENCL_NO_CACHE="1"
    )
    assert status == 0 and "warning" not in errors.lower(), errors


@pytest.mark.slow
def test_many_renders_take_no_more_memory(backend):
    """Two hundred small ones after the first sixty: less than 5 MiB more."""
    rss = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    render = lambda n: sl.render(sl.Scene(DEPTH + n), sl.Sky(), azimuths=8, backend=backend)
    for n in range(60):
        render(n)
    before = rss()
    for n in range(200):
        render(n)
    assert rss() - before < 5 * 1024


LIMITED = """
import resource, numpy as np, skylamp as sl
from skylamp.backends import base
sl.render(sl.Scene(np.eye(4) + 1), sl.Sky(), azimuths=4, backend="numpy")
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 300 * 2**20,) * 2)
try:
    sl.visibility_field(sl.Scene(np.full((600, 600), 500.0)), sl.Sky(), 9, backend="numpy")
except MemoryError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.slow
def test_a_memory_limit_is_a_capacity_error():
    """As `ulimit -v` sets: an error of skylamp's own that names the bytes, no abort."""
    status, out, errors = environment.ran(LIMITED)
    assert status == 0, errors[-2000:]
    assert out.startswith("CapacityError"), out


@pytest.mark.slow
def test_stdout_that_is_closed(tmp_path):
    """`skylamp backends | head -0` ends without a traceback."""
    call = "sys.argv = ['skylamp', 'backends', '--json']; main()"
    code = f"import os, sys; os.close(1); from skylamp.app.cli import main; {call}"
    _, _, errors = environment.ran(code)
    assert "Traceback" not in errors, errors


@pytest.mark.slow
def test_ctrl_c_at_random_moments():
    """render stops within a second; the next call is as always."""
    work = lambda: (
        sl.render(sl.Scene(DEPTH), sl.Sky(sl.cie_overcast()), tolerance=0.02, backend="numpy").image
    )
    expected = work().tobytes()
    for delay in np.random.default_rng(1).uniform(0, 0.3, 12):
        timer = threading.Timer(delay, _thread.interrupt_main)
        try:
            timer.start()
            while timer.is_alive():
                work()
            timer.join()
        except KeyboardInterrupt:
            pass
        assert work().tobytes() == expected
