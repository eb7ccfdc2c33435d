"""max_seconds: a call that is given too few ends with one error, with enough it gives what it always does."""

import functools

import numpy as np
import pytest
from compare import assert_bits_equal

import skylamp as sl
from skylamp.backends import base, select

SCENE = sl.Scene(np.random.default_rng(0).random((12, 17)) * 4)
LAMP = sl.Lamp((5.0, 6.0, -9.0), 3.0)
CALLS = {
    "render": lambda **more: sl.render(SCENE, sl.Sky(), **more).image,
    "render in tiles": lambda **more: sl.render(SCENE, sl.Sky(), tiling=sl.Tiling(8, 8, 4), **more).image,
    "slices": lambda **more: sl.render(SCENE, LAMP, method="horizon", **more).image,
    "lattice": lambda **more: sl.render(SCENE, LAMP, hemicube=5, **more).image,
    "horizons": lambda **more: sl.horizons(SCENE, 4, **more),
    "sky_view_factor": lambda **more: sl.sky_view_factor(SCENE, azimuths=4, **more),
    "openness": lambda **more: sl.openness(SCENE, 4, **more),
    "visibility": lambda **more: sl.visibility(SCENE, LAMP, 5, **more),
    "recover by carving": lambda **more: (
        sl.recover(
            SCENE.depth[:6, :6] + 1, sl.Sky(8.0), 0.5, "dark", layers=4, hemicube=3, method="paper", **more
        ).depth
    ),
    "visibility_field": lambda **more: sl.visibility_field(SCENE, LAMP, 3, **more).words,
}


@pytest.mark.parametrize("name", CALLS)
def test_too_few_seconds_are_an_error_that_names_them(fast, name):
    """It says how far the call came; the next call is as always."""
    with pytest.raises(sl.OutOfTimeError, match="max_seconds=1e-09 are over after .* steps") as caught:
        CALLS[name](backend=fast, max_seconds=1e-9)
    assert isinstance(caught.value, TimeoutError) and isinstance(caught.value, sl.SkylampError)
    expected = CALLS[name](backend=fast)
    assert_bits_equal(np.array(CALLS[name](backend=fast, max_seconds=600)), np.array(expected))


def test_time_runs_out_between_launches(fast, monkeypatch):
    """Not only at the first: a clock that goes on by a second a look stops a call in the middle."""
    ticks = iter(range(10**6))
    monkeypatch.setattr(base.time, "perf_counter", lambda: float(next(ticks)))
    with pytest.raises(sl.OutOfTimeError, match="after [1-9] steps"):
        sl.visibility_field(SCENE, LAMP, 3, backend=fast, max_seconds=3)


def test_time_runs_out_between_evaluations_of_brightness(fast, monkeypatch):
    """A function of a second a call: tables of it were made to the end, 8 s of a limit of 1."""
    calls = []

    def slow(L):
        calls.append(len(L))
        return 1 + np.sign(np.sin(400 * L[..., 0] * L[..., 1]))

    monkeypatch.setattr(base.time, "perf_counter", lambda: float(len(calls)))
    with pytest.raises(sl.OutOfTimeError):
        sl.render(SCENE, sl.Sky(slow), backend=fast, max_seconds=5)
    assert len(calls) <= 7  # one of them before the limit begins


def test_a_call_with_a_limit_waits_for_every_launch(fast, monkeypatch):
    """All launches were queued at once, so that the time passed, unseen, in the last transfer."""
    engine, happened = select(fast), []
    for name in ("launch", "finish"):
        own = getattr(type(engine), name).__wrapped__

        def noted(self, *args, own=own, name=name, **more):
            happened.append(name)
            return own(self, *args, **more)

        monkeypatch.setattr(type(engine), name, base._locked(functools.wraps(own)(noted)))
    sl.horizons(SCENE, 4, fast, max_seconds=600)
    launches = [n for n, name in enumerate(happened) if name == "launch"]
    assert len(launches) > 2 and all(happened[n + 1] == "finish" for n in launches)


@pytest.mark.parametrize("seconds", [0, -1, np.nan, "soon"])
def test_seconds_that_are_none(fast, seconds):
    with pytest.raises(sl.InputError, match="max_seconds"):
        sl.horizons(SCENE, 4, fast, max_seconds=seconds)


def test_a_lazy_map_has_no_seconds(fast):
    """Its work is done after the call."""
    dask = pytest.importorskip("dask.array")
    scene = sl.Scene.from_height(dask.zeros((40, 40), chunks=20))
    with pytest.raises(sl.InputError, match="lazy"):
        sl.sky_view_factor(scene, backend=fast, max_seconds=5)
