"""Calls from threads give the bytes of calls one after another, whatever else runs on the same device."""

import functools
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import skylamp as sl
from skylamp.backends import registry, select

THREADS, ROUNDS = 8, 2


@pytest.fixture(autouse=True)
def in_turns():
    """Threads take turns far more often than they would."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def depth_of(number):
    """A map of its own for every thread, of its own size."""
    return np.random.default_rng(number).random((20 + number, 33 + 2 * number)) * (3 + number)


WORK = [
    lambda z, b: sl.render(sl.Scene(z), sl.Sky(), method="horizon", azimuths=16, backend=b).image,
    lambda z, b: (
        sl.render(
            sl.Scene(z, sides="dark"), sl.Sky(sl.cosine_power(z.shape[0])), azimuths=12, backend=b
        ).image
    ),
    lambda z, b: sl.render(sl.Scene(z), sl.Sky(), method="lattice", hemicube=5, backend=b).image,
    lambda z, b: (
        sl.render(sl.Scene(z), sl.Lamp((z.shape[1] / 2, 9, -6), 4), method="horizon", backend=b).image
    ),
    lambda z, b: (
        sl.render(sl.Scene(z[:12, :16]), sl.Lamp((z.shape[1] / 4, 6, -6), 4), tolerance=0.05, backend=b).image
    ),
    lambda z, b: sl.sky_view_factor(sl.Scene(z), azimuths=12, backend=b),
    lambda z, b: sl.visibility(sl.Scene(z), sl.Sky(), 5, b, filled=True),
    lambda z, b: (
        sl.recover(1 + z, sl.Sky(8.0), 0.5, "dark", layers=5, hemicube=5, method="paper", backend=b).depth
    ),
    lambda z, b: sl.horizons(sl.Scene(z), 6, b),
    lambda z, b: sl.openness(sl.Scene(z), 6, b),
    lambda z, b: sl.visibility_field(sl.Scene(np.rint(z)), sl.Sky(), 3, backend=b).words,
    lambda z, b: np.array(sl.plan(sl.Scene(z), sl.Sky(), 0.05, b).error),
]


def together(jobs):
    """What the jobs give, each on a thread, all let go at once."""
    start = threading.Barrier(len(jobs))

    def run(job):
        start.wait()
        return job()

    with ThreadPoolExecutor(len(jobs)) as pool:
        return [future.result() for future in [pool.submit(run, job) for job in jobs]]


@pytest.mark.slow
def test_threads_get_the_bytes_of_calls_one_by_one(backend):
    """Eight threads, each with maps and sources of its own, each going through all work from another end."""
    each = lambda number: [
        WORK[(number + n) % len(WORK)](depth_of(number), backend).tobytes() for n in range(len(WORK))
    ]
    each(0)  # compiled
    jobs = [functools.partial(each, number) for number in range(THREADS)]
    expected = [job() for job in jobs]
    for _ in range(1 if backend == "numpy" else ROUNDS):  # which takes several times as long
        assert together(jobs) == expected


@pytest.mark.slow
def test_the_same_work_on_threads(backend):
    """Eight threads at the same kernels on different maps."""
    jobs = [functools.partial(WORK[0], depth_of(number), backend) for number in range(THREADS)]
    expected = [job().tobytes() for job in jobs]
    for _ in range(2 * ROUNDS if backend == "numpy" else 5 * ROUNDS):
        assert [image.tobytes() for image in together(jobs)] == expected


@pytest.mark.slow
def test_recover_on_threads(fast):
    """What one recovery has recorded and holds on the device is not another's."""
    jobs = [functools.partial(WORK[0], depth_of(4), fast)]
    for number in (1, 2):
        image = sl.render(
            sl.Scene(depth_of(number)[:16, :16] + 3, sides="dark"), sl.Sky(), azimuths=24, backend=fast
        ).image
        jobs.append(
            lambda image=image: sl.recover(image, sl.Sky(), sides="dark", layers=16, backend=fast).depth
        )
    expected = [job().tobytes() for job in jobs]
    assert [found.tobytes() for found in together(jobs)] == expected


@pytest.mark.slow
def test_one_scene_on_all_backends_at_once():
    """They share what is remembered of a scene, and nothing else."""
    scene = sl.Scene(depth_of(5))
    names = [info.name for info in sl.backends() if info.available]
    jobs = [
        lambda name=name: sl.render(scene, sl.Sky(), tolerance=0.02, backend=name).image.tobytes()
        for name in names
    ]
    [job() for job in jobs]  # costs measured
    expected = [job() for job in jobs]
    for _ in range(ROUNDS):
        scene = sl.Scene(depth_of(5))
        assert together(jobs) == expected


@pytest.mark.slow
def test_maps_that_lie_on_a_device_on_threads():
    """Scenes of Warp arrays launch kernels before any call, and copy to the host for another backend."""
    import warp as wp

    def work(number):
        scene = sl.Scene.from_height(wp.array(depth_of(number).astype(np.float32), device="cpu"))
        return sl.sky_view_factor(scene, azimuths=8, backend=("warp:cpu", "numpy")[number % 2]).tobytes()

    jobs = [functools.partial(work, number) for number in range(THREADS)]
    expected = [job() for job in jobs]
    for _ in range(ROUNDS):
        assert together(jobs) == expected


@pytest.mark.parametrize("what", ["_probe", "_make"])
def test_threads_that_ask_first_get_one_backend(monkeypatch, what):
    """However long it takes to look for devices or to make a backend, it is done once."""
    made, usual = [], getattr(registry, what).__wrapped__

    def slow(*name):
        time.sleep(0.05)
        made.append(name)
        return usual(*name)

    monkeypatch.setattr(registry, what, functools.cache(slow))
    found = together([lambda: select("numpy")] * THREADS)
    assert len(made) == 1 and len({id(engine) for engine in found}) == 1


@pytest.mark.slow
def test_waiting_for_a_device_is_not_counted_and_others_are_free(backend):
    """A call waits while its device is taken and does not count the wait; another device's call runs on."""
    render = lambda name: sl.render(sl.Scene(depth_of(1)), sl.Sky(), azimuths=8, backend=name)
    other = "numpy" if backend != "numpy" else "warp:cpu"
    before = max(render(name).seconds for name in (backend, backend, other))
    with ThreadPoolExecutor(2) as pool:
        with select(backend).lock:
            waits = pool.submit(render, backend)
            pool.submit(render, other).result(60)
            time.sleep(0.5 + 2 * before)
            assert not waits.done()
        assert waits.result(60).seconds < 0.4 + before
