"""The loop of refinement: promises kept, closed forms, refinements, the error map, every warning."""

import functools
import itertools
import json
import math
import os
import pickle
import re
import subprocess
import sys
import threading
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
from skylamp import arrays, oracle, refinement, sources
from skylamp.backends import select
from skylamp.light import horizon, unoccluded
from skylamp.light.base import Estimate
from skylamp.light.finite import solid_of
from skylamp.light.line import lights_of
from skylamp.planning import finite
from skylamp.planning.base import MOST_UNITS
from skylamp.planning.sky import SkyPlanner
from skylamp.radiometry import polygon_moment
from skylamp.samples import Errors, Samples, errors
from skylamp.sources.integrals import integrals
from skylamp.sources.solids import Ball, rectangle, upright

SIZE = 72
Y, X = np.mgrid[:SIZE, :SIZE].astype(float)
AWAY = np.hypot(X - 35.5, Y - 35.5)
ROUGH = scenes.rough(SIZE, SIZE, 1.0, 4)
HOUSES = np.where((X % 18 < 8) & (Y % 15 < 7), 20 - (X // 18 * 5 + Y // 15 * 3) % 17, 24.0)
HOLES = np.ones(ROUGH.shape, bool)
HOLES[20:30, 30:50] = HOLES[60:, :9] = False
SCENES = {
    "flat": sl.Scene(np.full((SIZE, SIZE), 5.0)),
    "ramp": sl.Scene(0.6 * X + 0.3 * Y),
    "dome": sl.Scene(0.004 * AWAY**2),
    "rough": sl.Scene(ROUGH),
    "houses": sl.Scene(HOUSES),
    "dark": sl.Scene(ROUGH + 6, sides="dark"),
    "periodic": sl.Scene(scenes.rough(SIZE, SIZE, 0.6, 9), sides="periodic"),
    "holes": sl.Scene(np.where(HOLES, ROUGH, np.nan), mask=HOLES),
    "metres": sl.Scene(30 * ROUGH, 30.0),
    "tiny": sl.Scene(ROUGH[:9, :13]),
}
GLOW = sl.Sky(lambda L: 1 + 5 * np.maximum(0, L @ np.array([0.6, 0.48, -0.64])) ** 6)
SUN = sl.Sky(
    lambda L: 1 + 600 * np.exp((L @ np.array([0.6, 0.48, -0.64]) - 1) / 0.001)
)  # some 3 degrees wide; smooth, for the oracle samples it
HIGH = sl.Lamp((40, 30, -60), 6)
LOW = sl.Lamp((20, 50, -6), 3, brightness=sl.cosine_power(2))
PANEL = sl.Lamp(corner=(20, 22, -15), edges=((18, 0, 0), (0, 12, 0)))
WINDOW = sl.Window(x=(20.3, 45.1), y=(12, 50.7))


def render(*args, **options):
    """Direct light alone: what is compared with here knows no other."""
    return sl.render(*args, **{"interreflection": False, **options})


def some_nodes(scene, count):
    valid = np.argwhere(scene.valid)
    return tuple(valid[np.random.default_rng(3).permutation(len(valid))[:count]].T)


def truth(scene, source, nodes):
    """By the oracle alone: [irradiance] at the nodes."""
    depth, valid = scene.depth.astype(float), scene.valid
    if isinstance(source, sl.Sky):
        profile = sources.azimuth_profile(source) if callable(source.brightness) else None
        rays = sl.Azimuths(256) if profile is None else sl.Azimuths.placed(512, profile)
        horizon = oracle.horizons(depth, scene.spacing, rays.angles, scene.sides, nodes=nodes)
        return oracle.sky_irradiance(
            np.nan_to_num(depth),
            scene.spacing,
            valid,
            rays.angles,
            rays.widths,
            horizon,
            source.brightness if callable(source.brightness) else None,
            nodes,
            scene.sides,
        )
    if isinstance(source, sl.Window):
        return oracle.window_irradiance(depth, scene.spacing, valid, source, nodes, 4096, sides=scene.sides)
    lamp = source if source.center is not None else (source.corner, *source.edges, source.brightness)
    return oracle.lamp_irradiance(depth, scene.spacing, valid, lamp, nodes, 4096, sides=scene.sides)


@pytest.fixture
def launched(monkeypatch, fast):
    """The stems of all kernels that are launched on the fast backend."""
    engine, stems = select(fast), []
    before = engine.launch
    monkeypatch.setattr(
        engine, "launch", lambda stem, *args, **more: (stems.append(stem), before(stem, *args, **more))[1]
    )
    return stems


def rms(image, exact, lit=None):
    """RMS of the difference over the mean of what is lit, nan left out."""
    there = np.isfinite(exact)
    exact, image = exact[there].astype(float), image[there].astype(float)
    return float(np.sqrt(np.mean((image - exact) ** 2)) / exact[exact > 0].mean())


def said(out):
    """By how much a rendering says that it is off, 0 if it says nothing."""
    return max(
        [
            float(re.search(r"estimated error is ([\d.e+-]+) %", w)[1]) / 100
            for w in out.warnings
            if w.startswith("Tolerance:")
        ],
        default=0.0,
    )


def irradiance(scene, source, fast, *args, **more):
    return render(scene, source, *args, backend=fast, quantity="irradiance", **more)


# -- promises


def named(value):
    """A test's name that is the same in every process."""
    return re.sub(r" at 0x\w+", "", str(value))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("rough", sl.Sky()),
        ("rough", GLOW),
        ("rough", SUN),
        ("houses", sl.Sky()),
        ("houses", SUN),
        ("houses", HIGH),
        ("dark", sl.Sky(sl.cie_overcast())),
        ("periodic", sl.Sky()),
        ("holes", LOW),
        ("metres", sl.Sky(2.0)),
        ("rough", WINDOW),
        ("rough", PANEL),
        ("dark", WINDOW),
        ("dome", GLOW),
        ("dome", HIGH),
        ("tiny", GLOW),
    ],
    ids=named,
)
def test_tolerances_are_kept(fast, name, source):
    """Against the oracle at nodes that no plan has seen; a plan's word and the audit agree."""
    scene = SCENES[name]
    nodes = some_nodes(scene, 150)
    exact = truth(scene, source, nodes) * (
        source.brightness if isinstance(source, sl.Sky) and not callable(source.brightness) else 1
    )
    for tolerance in (0.03, 0.006):
        out = render(scene, source, tolerance=tolerance, backend=fast, quantity="irradiance")
        error = errors(out.image[nodes].astype(float), exact).rms
        assert error <= 1.15 * tolerance, (tolerance, error, out.plan)
        assert out.plan.tolerance == tolerance and out.plan.tail == pytest.approx(10 * tolerance)
        assert out.plan.measured is None or out.plan.measured <= tolerance
        assert not any(w.startswith("Tolerance") for w in out.warnings)


def test_a_tighter_tolerance_or_tail_takes_more(fast):
    """More azimuths, a smaller error, and a reason that names it; a tail alone can ask for more."""
    plans = [sl.plan(SCENES["rough"], sl.Sky(), t, fast) for t in (0.0115, 0.004, 0.001)]
    assert (
        plans[0].azimuths < plans[1].azimuths < plans[2].azimuths
        and plans[0].error > plans[1].error > plans[2].error
    )
    assert all(p.error <= p.tolerance and p.error_tail <= p.tail for p in plans)
    assert sl.plan(SCENES["rough"], sl.Sky(), 0.0115, fast, tail=0.01).azimuths > plans[0].azimuths
    text = str(plans[1])
    assert (
        f"{plans[1].azimuths} evenly" in text
        and "precision" in text
        and "99.9th percentile" in text
        and plans[1].line.startswith("horizon, ")
    )
    assert {c.what for c in plans[1].choices} == {
        "occlusion",
        "brightness",
        "azimuths",
        "search radius",
        "method",
        "specular lobe",
        "interreflection",
        "precision",
        "error",
        "99.9th percentile",
    }
    assert (
        plans[1].seconds is None
        and plans[1].planning_seconds > 0
        and not plans[1].steps
        and plans[1].measured is None
    )


@pytest.mark.parametrize("elevation", [12, 70, 89.9])
def test_a_sun_of_its_real_size_brings_all_its_light(fast, elevation):
    """On open level ground, also near the zenith, where no azimuth stands out (houses: test_slices.py)."""
    e, r = np.radians((elevation, 0.2665))
    axis = np.array([np.cos(e) * np.cos(1.0), np.cos(e) * np.sin(1.0), -np.sin(e)])
    sun = sl.Sky(lambda L: 1 + 2e4 * (L @ axis >= np.cos(r)))
    image = render(SCENES["flat"], sun, tolerance=0.01, backend=fast, quantity="irradiance").image
    np.testing.assert_allclose(image, np.pi * (1 + 2e4 * np.sin(r) ** 2 * np.sin(e)), rtol=1e-4)


@pytest.mark.slow
def test_a_low_band_of_light_is_searched_as_far_as_it_needs(fast):
    """Ground of a map that repeats may hide a band where it hides little of an even sky."""
    scene = sl.Scene(10 * (1 + np.sin(2 * np.pi * X / SIZE * 4)), sides="periodic")
    band = sl.Sky(lambda L: 1 + 340 * (L[..., 2] > -0.045))
    fine = irradiance(scene, band, fast, "horizon", azimuths=256).image
    assert rms(irradiance(scene, band, fast, tolerance=0.03).image, fine) < 0.045


# -- no more model than the scene needs


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "source"),
    [("flat", HIGH), ("ramp", HIGH), ("dome", HIGH), ("flat", PANEL), ("flat", WINDOW), ("flat", LOW)],
    ids=named,
)
def test_what_nothing_hides_is_not_swept(fast, launched, name, source):
    """Lamps that stand clear of flat, slanted and convex ground: closed forms, and right."""
    scene = SCENES[name]
    out = render(scene, source, backend=fast, quantity="irradiance")
    assert (
        set(launched) <= {"pilot", "resident"} and out.plan.method == "unoccluded" and "none" in str(out.plan)
    )
    nodes = some_nodes(scene, 40)
    assert errors(out.image[nodes].astype(float), truth(scene, source, nodes)).rms < 0.01


def test_a_clear_lamp_over_gentle_ground_launches_nothing_that_looks_for_shadows(fast, launched):
    """Every node looks at the lamp, so nothing can hide it; under a sky ground is swept."""
    scene = sl.Scene(20 + scenes.rough(SIZE, SIZE, 0.08, 6, 2.2))
    assert render(scene, sl.Lamp((36, 36, -50), 4), tolerance=0.01, backend=fast).plan.method == "unoccluded"
    assert set(launched) <= {"pilot", "resident"}
    render(sl.Scene(ROUGH), sl.Sky(), backend=fast)
    assert set(launched) <= {"pilot", "resident", "ground", "horizon", "scan"} and "horizon" in launched


POLES = 60 + 0.02 * np.mgrid[:240, :240][0]
POLES[[60, 150, 40, 201], [60, 22, 170, 108]] -= 25.0  # thin, in a plain
HOLED = np.ones(POLES.shape, bool)
HOLED[50:64, 45:60] = HOLED[150:170, 23:40] = False  # beside two of them
MOUND = 80 - 30 * np.exp(-((np.mgrid[:240, :240] - np.array([60, 200])[:, None, None]) ** 2).sum(0) / 40)


@pytest.mark.parametrize(
    ("scene", "lamp"),
    [
        (sl.Scene(POLES), sl.Lamp((150, 90, -100), 12)),
        (sl.Scene(POLES), sl.Lamp((-60, 130, -60), 5)),
        (sl.Scene(np.where(HOLED, POLES, np.nan), mask=HOLED), sl.Lamp((150, 90, -100), 12)),
        (sl.Scene(MOUND), sl.Lamp((-60, 130, -60), 5)),
    ],
    ids=["above", "aside", "holes", "mound"],
)
def test_thin_shadows_are_not_overlooked(fast, scene, lamp):
    """Poles and a mound, whose shadows few samples meet: the RMS over all nodes is within tolerance."""
    fine = irradiance(scene, lamp, fast, "horizon", azimuths=256).image
    for tolerance in (0.03, 0.003):
        out = irradiance(scene, lamp, fast, tolerance=tolerance)
        assert rms(out.image, fine) <= tolerance and out.plan.method == "horizon"


def test_a_spotlight_over_holes_has_a_closed_form(fast):
    """Its brightness is asked in no direction from what is not there."""
    spot = sl.Lamp((36, 30, -60), 4, brightness=sl.cosine_power(6))
    whole, holed = (
        render(scene, spot, "unoccluded", backend=fast, quantity="irradiance").image
        for scene in (sl.Scene(0.1 * X + 20), sl.Scene(np.where(HOLES, 0.1 * X + 20, np.nan), mask=HOLES))
    )
    np.testing.assert_allclose(holed[HOLES], whole[HOLES], rtol=1e-4)
    assert np.isnan(holed[~HOLES]).all()


def test_a_spike_on_a_plain_is_not_overlooked(fast):
    """Flat ground with one tall node in each quarter is not taken for flat under a lamp at its side."""
    depth = np.full((SIZE, SIZE), 30.0)
    depth[18::36, 18::36] = 0
    assert sl.plan(sl.Scene(depth), sl.Lamp((-40, 36, 5), 3), backend=fast).method == "horizon"


@pytest.mark.slow
def test_a_trench_in_a_plain_is_not_overlooked(fast):
    """Under a sky, where few samples or none would lie in it."""
    y, x = np.mgrid[:600, :600].astype(float)
    trench = sl.Scene(np.where(np.abs(x - 300) < 4, 25.0, 0.0) + 0.01 * y)
    out = render(trench, sl.Sky(), tolerance=0.03, backend=fast, quantity="irradiance")
    assert out.plan.method == "horizon"
    nodes = np.full(200, 300), np.arange(200, 400)  # across it
    wrong = out.image[nodes] - truth(trench, sl.Sky(), nodes)
    assert np.sqrt(np.sum(wrong**2) / 600) < 0.03 * np.pi, "nothing is hidden farther away"


def test_a_bowl_in_a_plain_needs_few_azimuths(fast):
    """It hides next to nothing: the least number is within tolerance over all nodes, and known to be."""
    y, x = np.mgrid[:600, :600]
    scene = sl.Scene(20 - np.minimum(20, 0.02 * np.hypot(x - 300, y - 300) ** 2))
    out = irradiance(scene, sl.Sky(), fast, tolerance=0.01)
    error = rms(out.image, irradiance(scene, sl.Sky(), fast, azimuths=64).image)
    assert out.plan.azimuths == 4 and error < 0.01 and error < 2 * out.plan.error < 4 * error


def test_a_number_of_any_type_is_a_uniform_sky():
    """A brightness of NumPy's float32 is a number, and no table of a brightness that varies."""
    assert_bits_equal(unoccluded.sky(SCENES["ramp"], np.float32(2)), unoccluded.sky(SCENES["ramp"], 2.0))


@pytest.mark.parametrize("method", ["unoccluded", "horizon"])
def test_nodes_within_a_sphere_see_nothing_else(fast, method):
    """Wherever its centre is: pi B; and half of it where its middle plane is theirs (NaN, 6e6 before)."""
    scene = sl.Scene(np.full((15, 15), 10.0))
    away = np.hypot(*np.mgrid[-7:8, -7:8])
    for z in (9.0, 9.9, 9.999, 10.0):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            image = render(
                scene, sl.Lamp((7, 7, z), 2.02, 3.0), method, quantity="irradiance", backend=fast
            ).image
        inside = np.hypot(away, 10 - z) < 2.02
        np.testing.assert_allclose(image[inside], 3 * np.pi, rtol=1e-6)
        assert image[~inside].max() < 3 * np.pi * 0.6


def test_unoccluded_closed_forms(fast):
    """Asked for by name: a tilted plane's view factor, Lambert's polygon, balls cut by the tangent plane."""
    tilted = render(SCENES["ramp"], sl.Sky(2.0), "unoccluded", quantity="irradiance", backend=fast).image
    np.testing.assert_allclose(tilted, np.pi * (1 + 1 / np.sqrt(1.45)), rtol=1e-5)
    by_table = render(
        SCENES["ramp"], sl.Sky(sl.uniform(2.0)), "unoccluded", quantity="irradiance", backend=fast
    ).image
    np.testing.assert_allclose(by_table, tilted, rtol=3e-3)
    window = render(SCENES["flat"], WINDOW, "unoccluded", quantity="irradiance", backend=fast).image
    corners = np.stack(
        [
            np.stack([u - X, v - Y, np.full(X.shape, -5.0)], -1)
            for u, v in ((20.3, 12), (45.1, 12), (45.1, 50.7), (20.3, 50.7))
        ],
        -2,
    )
    np.testing.assert_allclose(window, -polygon_moment(corners)[..., 2], rtol=2e-3, atol=1e-4)
    samples = Samples(select(fast), SCENES["rough"], 200)
    ball = Ball((40.0, 30.0, 10.0), 8.0)
    found = unoccluded.lamp(
        samples.gx, samples.gy, samples.x, samples.y, samples.own.astype(float), ball, 1.0
    )
    wanted = samples.through_slices(ball, 1.0, 512, occluded=False)
    cut = (
        np.abs(
            found - np.pi * 64 / ((samples.x - 40) ** 2 + (samples.y - 30) ** 2 + (samples.own - 10.0) ** 2)
        )
        > 1e-6
    )
    np.testing.assert_allclose(found, wanted, atol=2e-3 * wanted.max())
    assert cut.any() and rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0)).corners.shape == (4, 3)


# -- suns


def within_cone(axis, radius, rings=12, spokes=24):
    """Directions (n, 3) evenly through a cone round a unit vector, and the solid angle of each."""
    cosine = 1 - (1 - np.cos(radius)) * (np.arange(rings) + 0.5)[:, None] / rings
    turn = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    u = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.7 else [0, 1.0, 0])
    u /= np.linalg.norm(u)
    off = np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * np.cross(axis, u)
    L = cosine[..., None] * axis + np.sqrt(1 - cosine**2)[..., None] * off
    return L.reshape(-1, 3), 2 * np.pi * (1 - np.cos(radius)) / (rings * spokes)


def towards(azimuth, elevation):
    a, e = np.radians((azimuth, elevation))
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])


def under(samples, base, discs):
    """Irradiance at samples of a uniform sky and discs (axis, radius, brightness), direction by direction."""
    azimuths = 2 * np.pi * (np.arange(720) + 0.5) / 720
    total = base * samples.ring(azimuths, samples.horizons(azimuths)).mean(0) * 2 * np.pi
    for axis, radius, light in discs:
        L, angle = within_cone(axis, radius)
        azimuth, e = np.arctan2(L[:, 1], L[:, 0]), np.arcsin(-L[:, 2])
        facing = (L[:, :1] * samples.gx + L[:, 1:2] * samples.gy - L[:, 2:]) / samples.length
        total += (
            light * angle * (np.maximum(0, facing) * (np.tan(e)[:, None] >= samples.horizons(azimuth))).sum(0)
        )
    return total


@pytest.mark.slow
def test_a_thin_ring_of_light_as_high_as_steps(fast):
    """0.2 degrees wide; knots of the tables were 0.35 apart, and the error 0.26 %."""
    scene = sl.Scene(24.0 - np.arange(40) // 5 * 3.0 * np.ones((40, 1)))
    low, high = np.radians((44.9, 45.1))
    ring = lambda L: np.where((-L[..., 2] >= np.sin(low)) & (-L[..., 2] < np.sin(high)), 30.0, 0.1)
    samples = Samples(select(fast), scene, 1600)
    angles = 2 * np.pi * (np.arange(2880) + 0.5) / 2880
    exact = np.zeros(len(samples))
    for azimuth, slope in zip(angles, np.arctan(np.concatenate(list(_horizons(samples, angles))))):
        tilt = samples.gx * np.cos(azimuth) + samples.gy * np.sin(azimuth)
        plane = np.arctan(-tilt)  # below it no light falls
        for light, begin, end in ((0.1, 0.0, np.pi / 2), (29.9, low, high)):
            first = np.minimum(end, np.maximum(np.maximum(slope, plane), begin))
            cosine, sine = ((v / 2 + np.sin(2 * v) / 4, np.sin(v) ** 2 / 2) for v in (first, end))
            exact += light * (tilt * (sine[0] - cosine[0]) + sine[1] - cosine[1])
    exact *= 2 * np.pi / len(angles) / samples.length
    out = irradiance(scene, sl.Sky(ring), fast, tolerance=0.003)
    assert errors(samples.of(out.image), exact).rms < 0.002


def _horizons(samples, azimuths):
    """Exact horizons, some azimuths at a time."""
    return (samples.horizons(some) for some in np.array_split(azimuths, 24))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rough", "houses"])
@pytest.mark.parametrize(
    "discs",
    [
        [(towards(18, 70), 0.27, 2.0), (towards(235, 26), 0.27, 2.0)],
        [(towards(100, 40), 2.0, 2.5), (towards(290, 12), 0.6, 3.0)],
        # fmt: skip
        [(towards(50 * n, 15 + 10 * n), 0.3, 0.8) for n in range(5)],
    ],
    ids=["two alike", "large and low", "five"],
)
def test_suns_over_ground_that_hides_them(fast, name, discs):
    """Against every direction of every disc, at nodes that no plan has seen, and a sky that is the rest."""
    discs = [(u, np.radians(r), flux / (np.pi * np.sin(np.radians(r)) ** 2)) for u, r, flux in discs]
    sky = sl.Sky(lambda L: 0.6 + sum(k * (L @ u > np.cos(r)) for u, r, k in discs))
    samples = Samples(select(fast), SCENES[name], 300, 100_003)
    exact = under(samples, 0.6, discs)
    for tolerance in (0.01, 0.003):
        out = irradiance(SCENES[name], sky, fast, tolerance=tolerance)
        assert (
            errors(samples.of(out.image), exact).rms <= 1.15 * max(tolerance, said(out))
            and said(out) <= 1.2 * tolerance
        ), out.plan.steps  # shadows of walls: a share that no azimuths mend


@pytest.mark.slow
@pytest.mark.parametrize("azimuth,elevation,tolerance", [(193.3632346, 5.2512849, 0.003), (300, 1, 0.01)])
def test_a_low_sun_behind_sharp_crests(fast, azimuth, elevation, tolerance):
    """Dunes without a cliff: a sweep lights a few of the nodes that no sun reaches, which the samples lie
    beside; the errors were 2.3 and 2.1 tolerances.
    """
    y, x = np.mgrid[:128, :128].astype(float)
    bend = 6.9205479 * np.sin(y / 13.6753382)
    at = (x * np.cos(0.26194167) + y * np.sin(0.26194167) + bend) / 20.7776247 % 1
    height = 8.0118527 * np.where(at < 0.75, at / 0.75, (1 - at) / 0.25)
    sky = sl.Sky(sl.cie_sky(7, (azimuth, elevation), direct=12.0))
    exact = irradiance(sl.Scene(height.max() - height), sky, fast, method="horizon", azimuths=256).image
    found = irradiance(sl.Scene(height.max() - height), sky, fast, tolerance=tolerance).image
    assert errors(found.ravel(), exact.ravel()).rms < tolerance


@pytest.mark.slow
def test_a_sun_beside_the_end_of_a_wall(fast):
    """An upright edge divides the disc, at few nodes, so that its sectors count: 1.9 tolerances off."""
    height = np.zeros((192, 192))
    height[:, 180:184] = 60 + 8 * np.random.default_rng(15).random((192, 1))
    disc = towards(7, 12), math.radians(0.27), 60 / (math.pi * math.sin(math.radians(0.27)) ** 2)
    scene = sl.Scene(height.max() - height)
    sky = sl.Sky(lambda L: 1 + disc[2] * (L @ disc[0] > math.cos(disc[1])))
    samples = Samples(select(fast), scene, 6000, 100_003)
    out = irradiance(scene, sky, fast, tolerance=0.003)
    assert errors(samples.of(out.image), under(samples, 1.0, [disc])).rms < 0.003


def test_more_near_rows_keep_what_was_refined(fast):
    """Azimuths and the sectors of suns; those were as at first, and the error 3 times as large."""
    sky = sl.Sky(lambda L: 1 + 2e4 * (L @ towards(7, 30) > math.cos(math.radians(0.3))))
    planner = refinement.choose(SCENES["houses"], sky, 0.003, select(fast))
    first = planner.begin()
    assert planner.refine(False) and planner.method is first
    kept, near = (first.units, first.sectors), planner.near_rows or 0
    assert planner.refine(True) and planner.method is not first and planner.near_rows > near
    assert (planner.method.units, planner.method.sectors) == kept == (2 * planner.units, 2 * planner.sectors)


@pytest.mark.slow
def test_what_judges_a_finished_image_has_more_azimuths(fast):
    """It had 288, and an image of 768 under a band of light was 1.4 tolerances off without a warning."""
    sky = sl.Sky(lambda L: np.where(-L[..., 2] < 0.03, 500.0, 1.0))
    planner = refinement.choose(SCENES["houses"], sky, 0.003, select(fast))
    method = planner.begin()
    while 2 * method.units <= MOST_UNITS:
        method.refine()
        planner.audit(method)
        assert planner.exact_count >= 1.5 * method.units
    assert method.units >= 768


def test_a_plan_names_light_from_below_the_lowest_slope_that_is_searched(fast):
    """A band of light near the level over a map that repeats: 1.5 tolerances off, and the plan was silent."""
    scene = replace(SCENES["rough"], sides="periodic")
    band = sl.Sky(lambda L: np.where(-L[..., 2] < 0.02, 800.0, 1.0))
    for sky, wanted in ((band, 1), (sl.Sky(), 0)):
        choices = sl.plan(scene, sky, 0.003, fast).choices
        (search,) = (choice for choice in choices if choice.what == "search radius")
        assert search.why.count("of the light (RMS) comes from below") == wanted


@pytest.mark.slow
def test_a_low_sun_in_its_glow_over_a_map_that_repeats(fast):
    """Both were swept: 4.3 tolerances. The glow reaches down to the level, and 64 periods are searched."""
    y, x = np.mgrid[:128, :128]
    at = (x + 3 * np.sin(2 * np.pi * y / 128)) / 32 % 1
    scene = sl.Scene(64 - 64 * np.where(at < 0.75, at / 0.75, (1 - at) / 0.25), sides="periodic")
    discs = [(towards(37, 4), math.radians(0.3), 8), (towards(40, 8), math.radians(9), 3)]
    discs = [(axis, radius, flux / (math.pi * math.sin(radius) ** 2)) for axis, radius, flux in discs]
    sky = sl.Sky(lambda L: 0.6 + sum(light * (L @ axis > math.cos(radius)) for axis, radius, light in discs))
    samples = Samples(select(fast), scene, 1000, 100_003)
    out = irradiance(scene, sky, fast, tolerance=0.01)
    assert errors(samples.of(out.image), under(samples, 0.6, discs)).rms < 0.01
    (parts,) = (choice for choice in out.plan.choices if choice.what == "bright parts")
    assert parts.why.endswith("of their own, above exact horizons")


@pytest.mark.slow
@pytest.mark.parametrize("azimuth", [1, 33, 183])
def test_a_sun_on_the_level_over_houses_that_repeat(fast, azimuth):
    """Its horizons lie 4,000 spacings away; it was swept, past whole houses: 7 to 15 % off without a word."""
    scene = sl.Scene(2 * HOUSES, sides="periodic")
    axis, radius = towards(azimuth, 0.7), math.radians(0.1)
    light = 8 / (math.pi * math.sin(radius) ** 2)
    sky = sl.Sky(lambda L: 0.6 + light * (L @ axis > math.cos(radius)))
    samples = Samples(select(fast), scene, 2500, 100_003)
    out = irradiance(scene, sky, fast, tolerance=0.01)
    assert errors(samples.of(out.image), under(samples, 0.6, [(axis, radius, light)])).rms < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rough", "houses"])
def test_the_light_that_judges_many_suns_is_exact(fast, name):
    """It had the image's own few sectors of each sun, and so did not see their error."""
    discs = [
        (towards(40 * n, 20 + 7 * n), math.radians(0.3 + 0.2 * (n % 3)), 3000 / (n + 3)) for n in range(9)
    ]
    sky = sl.Sky(lambda L: 0.3 + sum(k * (L @ u > np.cos(r)) for u, r, k in discs))
    planner = refinement.choose(SCENES[name], sky, 0.003, select(fast))
    exact = under(planner.samples, 0.3, discs)
    assert len(planner.bright_parts) == 9
    assert errors(planner.exact, exact).rms <= 5e-4
    image = planner.make().at(planner.samples)
    assert errors(image, exact).rms <= 1.5 * planner.expected.rms


# -- lamps and windows whose brightness varies


def through(samples, points, areas, normal, brightness):
    """Irradiance at samples by points (n, 3) [depth downwards] of a flat source above all ground."""
    azimuths = 2 * np.pi * np.arange(2880) / 2880
    slopes = np.concatenate([samples.horizons(some) for some in np.array_split(azimuths, 12)])
    found = []
    for n in range(len(samples)):
        to = points - np.array([samples.x[n], samples.y[n], -samples.own[n]], float)
        square = (to**2).sum(1)
        L = to / np.sqrt(square)[:, None]
        slope = -L[:, 2] / np.maximum(np.hypot(L[:, 0], L[:, 1]), 1e-9)
        row = np.rint(np.arctan2(L[:, 1], L[:, 0]) * 2880 / (2 * np.pi)).astype(int) % 2880
        facing = np.maximum(0, L @ np.array([samples.gx[n], samples.gy[n], -1]) / samples.length[n])
        light = brightness(L) if callable(brightness) else brightness
        found.append((light * facing * np.abs(L @ normal) / square * areas * (slope >= slopes[row, n])).sum())
    return np.array(found)


def sheet(corner, u, v, n, m):
    """(points, area of each, normal) of a rectangle."""
    a, b = (np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m
    points = np.array(corner) + a[:, None, None] * np.array(u) + b[:, None] * np.array(v)
    across = np.cross(u, v)
    return points.reshape(-1, 3), np.linalg.norm(across) / (n * m), across / np.linalg.norm(across)


SMALL = scenes.rough(48, 48, 0.8, 12) + 9
PANORAMA = np.random.default_rng(6).random((32, 64)) ** 4


def stripes(L):
    return ((8 * L[..., 0]) % 1 < 0.5) * 1.0


def test_what_lies_below_a_tangent_plane_lights_no_closed_form(fast):
    """Of panels and windows that tangent planes cut: light from below was subtracted, or taken for light."""
    ask = functools.partial(sl.render, quantity="irradiance", interreflection=False, backend=fast)
    flat = sl.Scene(np.full((12, 16), 10.0))
    panels = (sl.Lamp(corner=(8.5, 2, 2), edges=((0, 8, 0), (0, 0, z - 2.0))) for z in (10, 14, 30))
    first, *others = (ask(flat, panel, "unoccluded").image for panel in panels)
    for image in others:  # as if they ended at the ground
        np.testing.assert_allclose(image, first, rtol=1e-5)
    roof = sl.Scene(10 + 2 * np.abs(np.mgrid[:16, :16][1] - 7.5))
    east = sl.Lamp(corner=(20, 4, 20), edges=((0, 8, 0), (0, 0, 6)))
    assert not ask(roof, east, "unoccluded").image[:, :7].any()
    window = sl.Window(x=(12, 30), y=(0, 16))
    faces = [ask(roof, window, method).image[:, :7] for method in ("unoccluded", "horizon")]
    np.testing.assert_allclose(*faces, rtol=0.05)  # nothing else stands before it


def test_a_lamp_given_as_a_volume_tells_that_its_error_is_not_known(fast):
    """Rays step over a panel of one layer: dark below it, and the error was said to be 0."""
    volume = np.zeros((5, 33, 33), bool)
    volume[4, 12:21, 12:21] = True
    out = sl.render(sl.Scene(np.full((33, 33), 19.0)), sl.Lamp(volume=volume), backend=fast)
    (text,) = out.warnings
    assert (
        text.startswith("Tolerance: the error is not known")
        and "step over up to 8 nodes" in text
        and "lamp 1 thick" in text
    )
    assert np.isposinf(out.error).all()
    thick = sl.Lamp(volume=np.repeat(volume[4:], 9, 0))
    (text,) = sl.render(sl.Scene(np.full((33, 33), 19.0)), thick, backend=fast).warnings
    assert "not known" in text and "step over" not in text


@pytest.mark.slow
@pytest.mark.parametrize("ground", ["level", "rough"])
@pytest.mark.parametrize(
    "light",
    [
        sl.cosine_power(64, (0.2, 0.1, 1)),
        sl.cosine_power(300, (0.2, 0.1, 1)),
        sl.cosine_power(900, (0.1, 0.2, 1)),
        stripes,
        sl.environment_map(PANORAMA),
    ],
    ids=["cos^64", "cos^300", "cos^900", "stripes", "map"],
)
def test_windows_with_patterns(fast, ground, light):
    """Point by point over the window, and every warning names a number."""
    depth = SMALL if ground == "rough" else np.full((48, 48), 15.0)
    scene, samples = sl.Scene(depth), Samples(select(fast), sl.Scene(depth), 60, 100_003)
    exact = through(samples, *sheet((10, 8, 0), (25, 0, 0), (0, 30, 0), 200, 200), light)
    out = irradiance(scene, sl.Window((10, 35), (8, 38), light), fast, tolerance=0.01)
    error = errors(samples.of(out.image), exact).rms
    assert error <= 1.2 * max(0.01, said(out)), (error, out.plan.steps, out.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("power", [64, 300, 900])
@pytest.mark.parametrize("radius", [1.0, 5.0])
def test_spotlights_over_ground_that_hides_them(fast, power, radius):
    """Beams narrower and wider than the lamp, against shadow rays at all nodes that they reach."""
    scene = sl.Scene(SMALL)
    spot = sl.Lamp((20, 22, -30), radius, sl.cosine_power(power, (0.1, 0.05, 1)))
    free = irradiance(scene, spot, fast, "unoccluded").image
    nodes = np.nonzero(free > (1e-3 if radius == 1 else 1e-9) * free.max())
    pick = np.random.default_rng(2).permutation(len(nodes[0]))[:400]
    nodes = nodes[0][pick], nodes[1][pick]
    exact = oracle.lamp_irradiance(SMALL, 1.0, scene.valid, spot, nodes, 4096 if radius == 5 else 1024)
    out = irradiance(scene, spot, fast, tolerance=0.01)
    off = (
        np.sqrt(np.mean((out.image[nodes] - exact) ** 2)) / exact.mean()
    )  # where the beam is: the mean over all nodes is far less
    assert off <= 0.02 or said(out) and off <= said(out), (off, out.plan.steps, out.warnings)


def test_what_is_hidden_of_a_small_lamp_is_not_of_its_mean_brightness(fast):
    """A far lamp behind houses, dark below and bright above: half shadows hide the dark part first."""
    scene, radius = SCENES["houses"], 1000.0
    center = 1e5 * np.array([np.cos(0.3) * np.cos(0.4), np.cos(0.3) * np.sin(0.4), -np.sin(0.3)])
    lamp = sl.Lamp(tuple(center), radius, lambda L: np.clip(100 * (-L[..., 2] - np.sin(0.3)) + 1, 0, 2))
    samples = Samples(select(fast), scene, 400, 100_003)
    solid = Ball((*center[:2], -center[2]), radius)
    out = irradiance(scene, lamp, fast, tolerance=0.003)
    off = errors(samples.of(out.image), samples.exact(lamp, solid)).rms
    assert off <= 0.003 and not out.warnings, (off, out.plan.steps)


@pytest.mark.slow
@pytest.mark.parametrize("width", [3e-4, 1e-4, 2e-5])
@pytest.mark.parametrize("height", [1.0, 1e-22])
def test_a_spot_between_the_probes_of_a_brightness(fast, width, height):
    """They lie on its foot, 1e-46 of its height: scaled up by that, the height was refused as too bright."""
    sky = sl.Sky(lambda L: height * np.exp(-(1 + L[..., 2]) / width))
    image = irradiance(SCENES["flat"], sky, fast).image
    np.testing.assert_allclose(image, 2 * np.pi * width * (1 - width) * height, rtol=5e-3)


@pytest.mark.parametrize("wall", [(32, 36, 2.0), (31, 33, 5.0), (40, 43, -30.0)])
def test_ground_behind_a_tilted_panel_does_not_hide_it(backend, wall):
    """The exact rays took the panel's plane for the panel: warnings of 14 to 50 %, and 1,024 slices."""
    depth = np.full((64, 64), 30.0)
    depth[:, wall[0] : wall[1]] = wall[2]
    panel = sl.Lamp(corner=(25, 20, 29), edges=((5, 0, -10), (0, 24, 0)))
    out = irradiance(
        sl.Scene(depth - depth.min()), replace(panel, corner=(25, 20, 29 - depth.min())), backend
    )
    assert not out.warnings and out.plan.azimuths <= 128


@pytest.mark.slow
@pytest.mark.parametrize("brightness", [1.0, sl.cosine_power(3, (0.2, 0.1, 1))], ids=["even", "spot"])
@pytest.mark.parametrize("options", [{}, {"method": "horizon"}], ids=["auto", "horizon"])
def test_lamps_too_small_for_float32(backend, brightness, options):
    """Enlarged, with their light in proportion. At 1e-6 spacings most nodes were black."""
    scene = SCENES["houses"]
    images = []
    for radius in (1e-2, 1e-6, 1e-9):
        out = irradiance(scene, sl.Lamp((30, 28, -15), radius, brightness), backend, **options)
        assert not out.warnings
        images.append(out.image / radius**2)
    for image in images[1:]:
        assert errors(image.ravel(), images[0].ravel()).rms < 0.005


@pytest.mark.parametrize("place", [(30.1, 29.8), (30.2, 30.25)])
def test_a_small_lamp_right_above_a_node(fast, place):
    """The brightness has its pole there, which few rays miss: one node was 29 % off, and no sample saw it."""
    lamp = sl.Lamp((*place, -14.0), 0.34, lambda L: 1 + 0.9 * np.cos(3 * np.arctan2(L[..., 1], L[..., 0])))
    scene = SCENES["rough"]
    samples = Samples(select(fast), scene, 1)
    y, x = (some.ravel() for some in np.mgrid[28:33, 28:33])
    samples.set_nodes(x, y)
    solid = Ball((*place, 14.0), 0.34)
    exact = samples.through_slices(solid, lamp.brightness, 512, points=64)
    out = irradiance(scene, lamp, fast, tolerance=0.01)
    assert out.plan.method == "horizon"
    np.testing.assert_allclose(out.image[y, x], exact, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.27, 1, 3, 10])
def test_a_sun_through_a_window_lights_a_patch(fast, radius):
    """A level floor of a dark box: all of the disc well inside the patch, none of it outside."""
    s = np.array([0.4, 0.3, -0.866]) / np.linalg.norm([0.4, 0.3, -0.866])
    r = np.radians(radius)
    y, x = np.mgrid[:96, :96]
    image = (
        irradiance(
            sl.Scene(np.full((96, 96), 20.0), sides="dark"),
            sl.Window((30, 66), (30, 66), lambda L: (L @ s > np.cos(r)) / (np.pi * np.sin(r) ** 2)),
            fast,
        ).image
        / -s[2]
    )
    at_x, at_y, reach = x - 20 * s[0] / s[2], y - 20 * s[1] / s[2], 20 * np.tan(2 * r) / 0.75 + 1
    inside = (at_x > 30 + reach) & (at_x < 66 - reach) & (at_y > 30 + reach) & (at_y < 66 - reach)
    outside = (at_x < 30 - reach) | (at_x > 66 + reach) | (at_y < 30 - reach) | (at_y > 66 + reach)
    assert inside.sum() > 100 and outside.sum() > 1000
    assert np.sqrt(np.mean((image[inside] - 1) ** 2)) < 0.01  # as the tolerance is meant
    np.testing.assert_allclose(image[inside], 1, atol=0.05)  # half of what its tail allows
    assert np.abs(image[outside]).max() < 0.01


@pytest.mark.parametrize("ground", ["level", "rough"])
@pytest.mark.parametrize("kind", ["slit", "tube"])
def test_thin_sources(fast, ground, kind):
    """A slit 1e-4 spacings wide and a tube lamp as thin: their length in points, times their width."""
    depth = SMALL if ground == "rough" else np.full((48, 48), 15.0)
    samples = Samples(select(fast), sl.Scene(depth), 80, 100_003)
    corner, u, v = (
        ((12.0, 20.3, 0.0), (20.0, 0, 0), (0, 1e-4, 0))
        if kind == "slit"
        else ((12.0, 20.3, -3.0), (20.0, 0, 0), (0, 0.8e-4, 0.6e-4))
    )
    source = (
        sl.Window((12.0, 32.0), (20.3, 20.3001)) if kind == "slit" else sl.Lamp(corner=corner, edges=(u, v))
    )
    out = irradiance(sl.Scene(depth), source, fast)
    assert (
        errors(samples.of(out.image), through(samples, *sheet(corner, u, v, 4000, 1), 1.0)).rms <= 0.012
        and not out.warnings
    )
    if ground == "level" and kind == "slit":
        eyes = np.stack([samples.x, samples.y, -samples.own], -1).astype(float)
        corners = np.array([(12, 20.3, 0), (32, 20.3, 0), (32, 20.3001, 0), (12, 20.3001, 0)])
        exact = np.array([-polygon_moment(corners - eye)[2] for eye in eyes])
        np.testing.assert_allclose(samples.of(out.image), exact, rtol=0.01)


@pytest.mark.parametrize("width, closed", [(1e-2, True), (1e-4, False)])
def test_a_thin_panel_that_every_node_sees(fast, width, closed):
    """A closed form, but not where float32 does not hold its width: that is 1.4 % off."""
    scene, (corner, u, v) = (
        sl.Scene(np.full((48, 48), 15.0)),
        ((12.0, 20.3, -1.0), (20.0, 0, 0), (0, width, 0)),
    )
    out = irradiance(scene, sl.Lamp(corner=corner, edges=(u, v)), fast, tolerance=0.003)
    samples = Samples(select(fast), scene, 80, 100_003)
    exact = through(samples, *sheet(corner, u, v, 4000, 1), 1.0)
    assert (out.plan.method == "unoccluded") == closed and not out.warnings
    assert errors(samples.of(out.image), exact).rms <= 0.001


def test_a_wall_along_a_thin_panel_hides_half_of_its_width(fast):
    """A row of nodes lies in the penumbra, 0.01 spacings wide: the line of its middle is seen or not."""
    depth = np.full((64, 64), 14.0)
    depth[30:34] -= 2.197
    panel = sl.Lamp(corner=(10.0, 54.1, -14.755), edges=((44.0, 0, 0), (0, 0.15, 0)))
    out = irradiance(sl.Scene(depth), panel, fast)
    samples = Samples(select(fast), sl.Scene(depth), 1)
    samples.set_nodes(np.arange(64), np.full(64, 28))
    solid = upright(solid_of(sl.Scene(depth), panel))
    exact = samples.through_slices(solid, 1.0, 1024)
    clear = samples.through_slices(solid, 1.0, 1024, occluded=False)
    assert 0.3 < exact[32] / clear[32] < 0.7
    assert math.sqrt(np.mean((out.image[28] - exact) ** 2) / 64) <= 0.01 * out.image.mean()


@pytest.mark.slow
def test_a_beam_through_a_slit_that_every_node_sees(fast):
    """The sun's light falls on few nodes of a tilted plane, beside all samples that choose the method."""
    s, r = towards(70, 25), np.radians(0.3)
    light = lambda L: 1 + 1e5 * (L @ s > np.cos(r))
    depth = 10 + 0.21 * np.arange(128.0)[:, None] + np.zeros((128, 128))
    out = irradiance(sl.Scene(depth), sl.Window((64.985, 65.015), (40.0, 80.0), light), fast)
    x = np.arange(128) - depth * s[0] / s[2]
    samples = Samples(select(fast), sl.Scene(depth), 1)
    samples.set_nodes(*np.nonzero(np.abs(x - 65) < 0.2)[::-1])
    exact = through(samples, *sheet((64.985, 40.0, 0.0), (0, 40.0, 0), (0.03, 0, 0), 10_000, 8), light)
    lit = exact > 20 * np.median(out.image)
    assert 2 < lit.sum() < 20
    np.testing.assert_allclose(samples.of(out.image)[lit], exact[lit], rtol=0.1)


def test_a_spotlight_beside_all_samples(fast):
    """A panel so near to level ground that its light falls on some nodes of many, within 1 % of the peak."""
    corner, u, v = (50.3, 60.2, -3.0), (1.0, 0, 0), (0, 1.0, 0)
    light, scene = sl.cosine_power(100), sl.Scene(np.zeros((192, 192)))
    out = irradiance(scene, sl.Lamp(corner=corner, edges=(u, v), brightness=light), fast)
    samples = Samples(select(fast), scene, 1)
    samples.set_nodes(*(a.ravel() for a in np.meshgrid(np.arange(48, 54), np.arange(58, 64))))
    exact = through(samples, *sheet(corner, u, v, 100, 100), light)
    assert np.abs(samples.of(out.image) - exact).max() <= 0.01 * exact.max()


def test_a_mean_that_samples_do_not_know(fast):
    """The samples beside a spotlight get a small part of its light. Of errors relative to their mean 256 rays
    are the outcome.
    """
    lamp = sl.Lamp((59.82, 71.24, -3.0), 0.5, brightness=sl.cosine_power(20))
    out = irradiance(sl.Scene(np.zeros((192, 192))), lamp, fast, tolerance=0.005)
    assert [step.units for step in out.plan.steps] == [16, 64] and not out.warnings


@pytest.mark.slow
def test_a_plane_in_the_fringe_of_a_beam(fast):
    """Far from the beam its light falls off by half in a few spacings: slices had an error of 4 % of the
    mean, rays follow it.
    """
    y, x = np.mgrid[:128, :128]
    scene = sl.Scene(38 + 0.273 * x - 0.231 * y)
    lamp = sl.Lamp((92.7, 160.3, -44.6), 7.26, sl.cosine_power(395, (-0.281, -0.19, 0.941)))
    out = irradiance(scene, lamp, fast, tolerance=0.01)
    nodes = np.nonzero(out.image > 0.02 * out.image.max())
    exact = oracle.lamp_irradiance(scene.depth, 1.0, scene.valid, lamp, nodes, 65536)
    off = np.sqrt(np.sum((out.image[nodes] - exact) ** 2) / out.image.size) / out.image.mean(dtype=float)
    assert off <= 0.01 and not out.warnings


def test_a_sharp_ring_of_a_small_ball(fast):
    """Where 256 rays to it do not suffice, 1,024 do, not slices with few rays each."""
    scene = sl.Scene(np.full((48, 48), 35.0))
    ring = lambda L: 0.02 + ((-L[..., 2] > 0.6384) & (-L[..., 2] < 0.9653))
    lamp = sl.Lamp((34.79, 33.81, 13.39), 0.2566, ring)
    out = irradiance(scene, lamp, fast, tolerance=0.003)
    nodes = tuple(n.ravel() for n in np.mgrid[2:48:5, 2:48:5])
    exact = oracle.lamp_irradiance(scene.depth, 1.0, scene.valid, lamp, nodes, 16384)
    assert errors(out.image[nodes], exact).rms <= 0.003 and out.plan.method == "unoccluded"


def test_masked_bands_do_not_change_whether_a_slit_is_a_line(monkeypatch):
    """A large map is worked over in bands of rows, some of which may have no data."""
    monkeypatch.setattr(arrays, "BAND", 960)
    depth = np.full((96, 96), 30.0)
    mask = np.ones(depth.shape, bool)
    mask[:40] = False
    middle = np.array([48.0, 70.0, 0.0])
    for scene in (sl.Scene(depth), sl.Scene(depth, mask=mask)):
        assert finite._nearest(scene, middle, middle + (5.0, 0, 0)) == pytest.approx(30)


def test_a_pit_too_small_for_samples_is_dark_at_its_wall(fast):
    """Its wall is 5.3 spacings high between two nodes: by central differences all ground faces the lamp."""
    depth = np.full((64, 64), 20.0)
    depth[30:33, 32:36] = 25.3
    out = irradiance(sl.Scene(depth), sl.Lamp(center=(22.0, 31.0, -20.0), radius=0.1), fast)
    assert (out.image[30:33, 32] == 0).all() and (out.image[30:33, 33:36] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("width, points", [(0.1, (20_000, 32)), (1e-4, (120_000, 6))])
def test_a_slit_before_a_sun(fast, width, points):
    """The light of the sun falls on few nodes, through a small part of the slit."""
    s, r = towards(70, 55), np.radians(1)
    light = lambda L: 1 + 2e4 * (L @ s > np.cos(r))
    x, y = np.arange(48) - SMALL * s[0] / s[2], np.arange(48)[:, None] - SMALL * s[1] / s[2]
    near = (np.abs(x - 24) < 0.5) & (np.abs(y - 24) < 12)
    scene = sl.Scene(SMALL)
    out = irradiance(scene, sl.Window((24 - width / 2, 24 + width / 2), (13.0, 35.0), light), fast)
    samples = Samples(select(fast), scene, 1)
    samples.set_nodes(*np.nonzero(near)[::-1])
    slit = sheet((24 - width / 2, 13.0, 0.0), (0, 22.0, 0), (width, 0, 0), *points)
    exact = through(samples, *slit, light)
    assert (exact > 20 * np.median(out.image)).sum() > 4
    off = (samples.of(out.image) - exact) / out.image.mean()
    assert math.sqrt((off**2).sum() / out.image.size) <= 0.01, out.plan.steps
    assert not any("Tolerance" in text for text in out.warnings)  # few nodes have the light: they are a tail
    assert out.image[~near].max() < 20 * np.median(out.image)


@pytest.mark.slow
@pytest.mark.parametrize(
    "elevation, azimuth, width, count", [(90, 0, 4e-4, (40_000, 1)), (40, 200, 1.1, (3000, 24))]
)
def test_a_large_sun_through_a_narrow_window(fast, elevation, azimuth, width, count):
    """Level ground, by a sum over the window. The sun had no points and no azimuths of its own: 5.9 and 2.4
    tolerances off.
    """
    sun, edge = towards(azimuth, elevation), math.cos(math.radians(4))
    begin, end = (10.2, 31.7), (54.7, 31.7 + width)
    y, x = np.mgrid[:64, :64]
    along, across = (a + (np.arange(n) + 0.5) / n * (b - a) for a, b, n in zip(begin, end, count))
    exact = np.zeros(x.shape)
    for row, own in enumerate(exact):
        for part in across:
            square = (along - x[row, :, None]) ** 2 + (part - row) ** 2 + 900.0
            dot = ((along - x[row, :, None]) * sun[0] + (part - row) * sun[1] - 30 * sun[2]) / np.sqrt(square)
            own += (np.where(dot > edge, 601.0, 1.0) * 900 / square**2).sum(1)
    exact *= (end[0] - begin[0]) * width / math.prod(count)
    window = sl.Window(*zip(begin, end), brightness=lambda L: 1 + 600.0 * (L @ sun > edge))
    out = irradiance(sl.Scene(np.full(x.shape, 30.0)), window, fast, tolerance=0.003)
    assert errors(out.image.ravel(), exact.ravel()).rms < 0.003 and not out.warnings


def test_lights_of_a_thin_source_add_up():
    """Suns one in another and one apart; each is 0 outside its cone. Four alike take two cones' points."""
    rng = np.random.default_rng(5)
    suns = [(towards(40, 50), 4, 80.0), (towards(41, 51), 1, 900.0), (towards(-60, 30), 2, 300.0)]
    brightness = lambda L: 1 + sum(b * (L @ s > np.cos(np.radians(r))) for s, r, b in suns)
    lights = lights_of(brightness, integrals(sl.Sky(brightness), 0.01, True).bright_parts)
    assert len(lights) >= 3
    L = np.concatenate([s + 0.1 * rng.standard_normal((20_000, 3)) for s, _, _ in suns])
    L[:, 2] = np.minimum(L[:, 2], 0)
    L /= np.linalg.norm(L, axis=1)[:, None]
    whole = sum(light.brightness(L.reshape(100, -1, 3)) for light in lights)
    assert np.allclose(whole.ravel(), brightness(L), rtol=1e-12)
    for light in lights[1:]:
        outside = L @ (light.cone[0] * (1, 1, -1)) < math.sqrt(1 - light.cone[1] ** 2) - 1e-9
        assert outside.any() and not light.brightness(L)[outside].any() and light.brightness(L).any()
    turned = [(towards(a, 40), 1, 100.0) for a in (0, 90, 180, 270)]
    even = lambda L: 1 + sum(b * (L @ s > np.cos(np.radians(r))) for s, r, b in turned)
    alike = lights_of(even, integrals(sl.Sky(even), 0.01, True).bright_parts)[1:]
    assert len(alike) == 4 and sum(light.point_share for light in alike) == pytest.approx(2, rel=1e-3)


@pytest.mark.slow
def test_a_slit_before_a_sharp_map(fast):
    """Pixels of one degree and a half, which no table of chords holds that well, point by point."""
    light = sl.environment_map(np.random.default_rng(4).gamma(0.5, size=(128, 256)))
    scene, (corner, u, v) = sl.Scene(SMALL), ((12.2, 3.0, 0.0), (0, 26.0, 0), (5e-4, 0, 0))
    samples = Samples(select(fast), scene, 80, 100_003)
    out = irradiance(scene, sl.Window((12.2, 12.2005), (3.0, 29.0), light), fast)
    assert errors(samples.of(out.image), through(samples, *sheet(corner, u, v, 4000, 1), light)).rms <= 0.01
    assert not out.warnings and "line to every node" in str(out.plan)


@pytest.mark.parametrize("brightness", [1.0, sl.cie_overcast()], ids=["number", "function"])
def test_a_window_outside_a_dark_box_is_planned(fast, brightness):
    """Nothing of it is seen: the plan says so and the image is 0, also where its brightness is a function."""
    scene, window = SCENES["dark"], sl.Window((-20, -16), (2, 7), brightness)
    assert ("window", "nothing to see") in [
        (choice.what, choice.taken) for choice in sl.plan(scene, window, 0.01, fast).choices
    ]
    assert not irradiance(scene, window, fast, tolerance=0.01).image.any()


def test_a_window_over_a_map_that_repeats_returns(fast):
    """The largest hemicube, and a warning that says by how much it may be off."""
    scene = sl.Scene(10 + 3 * np.sin(2 * np.pi * np.mgrid[:8, :8][1] / 8), sides="periodic")
    out = render(scene, sl.Window((3, 6), (3, 6)), backend=fast)
    assert out.plan.method == "lattice" and out.plan.hemicube == 33 and np.isfinite(out.image).all()
    assert any(re.match(r"Tolerance:.*\d %", w) for w in out.warnings) and out.plan.steps[-1].units == 33


# -- the error of every node


@pytest.mark.parametrize("tolerance", [0.01, 0.003])
@pytest.mark.parametrize("seed", [4, 5])
def test_the_error_map_tells_the_error(fast, tolerance, seed):
    """On rough ground: enough nodes within one, two and three times it, and the two alike on the whole."""
    scene = sl.Scene(scenes.rough(SIZE, SIZE, 1.0, seed))
    out, fine = (
        irradiance(scene, sl.Sky(), fast, tolerance=tolerance),
        irradiance(scene, sl.Sky(), fast, "horizon", azimuths=512).image,
    )
    off = np.abs(out.image - fine)
    shares = [(off <= k * out.error).mean() for k in (1, 2, 3)]
    assert shares[0] >= 0.70 and shares[1] >= 0.93 and shares[2] >= 0.98, shares
    assert 0.3 < np.sqrt(np.mean(off**2)) / np.sqrt(np.mean(out.error.astype(float) ** 2)) < 1.3


@pytest.mark.parametrize("source", [HIGH, PANEL, WINDOW], ids=["ball", "panel", "window"])
def test_the_estimate_of_slices_is_the_error(fast, source):
    """Neither half of it nor three times: the samples tell what share of the difference is the error."""
    out = irradiance(SCENES["houses"], source, fast, tolerance=0.003)
    fine = irradiance(SCENES["houses"], source, fast, "horizon", azimuths=512).image
    assert 0.5 < rms(out.image, fine) / out.plan.error < 3


@pytest.mark.parametrize("source", [sl.Sky(), HIGH, WINDOW], ids=["sky", "ball", "window"])
def test_the_error_map_outlives_its_process(fast, source):
    """It lies on the device until it is asked for; a rendering that was pickled has the same."""
    out = irradiance(SCENES["houses"], source, fast, tolerance=0.01)
    again = pickle.loads(pickle.dumps(out))
    assert out.error.max() > 0
    np.testing.assert_array_equal(again.error, out.error)


def test_the_error_map_has_the_images_shape_and_unit(fast):
    """Radiance and irradiance, colour, masks; none where no tolerance was asked."""
    albedo = np.array([0.2, 0.4, 0.8])
    scene = sl.Scene(SCENES["holes"].depth, mask=HOLES, albedo=0.3)
    light, shine = (render(scene, sl.Sky(2.0), backend=fast, quantity=q) for q in ("irradiance", "radiance"))
    assert light.error.shape == light.image.shape and light.error.dtype == np.float32
    np.testing.assert_allclose(shine.error[HOLES], light.error[HOLES] * 0.3 / np.pi, rtol=1e-5)
    assert np.isnan(light.error[~HOLES]).all() and (light.error[HOLES] > 0).all()
    np.testing.assert_allclose(
        light.error[HOLES], 2 * irradiance(scene, sl.Sky(), fast).error[HOLES], rtol=1e-5
    )
    colour = render(
        sl.Scene(ROUGH, albedo=np.broadcast_to(albedo, (SIZE, SIZE, 3))),
        sl.Sky((1.0, 2.0, 3.0)),
        backend=fast,
    )
    grey = irradiance(SCENES["rough"], sl.Sky(), fast)
    assert colour.error.shape == colour.image.shape == (SIZE, SIZE, 3)
    np.testing.assert_allclose(colour.error, grey.error[..., None] * albedo * [1, 2, 3] / np.pi, rtol=1e-5)
    for how in ("auto", True):  # light between surfaces makes an irradiance coloured by its ground
        light = sl.render(
            sl.Scene(ROUGH, albedo=albedo), sl.Sky(), backend=fast, quantity="irradiance", interreflection=how
        )
        assert light.error.shape == light.image.shape == (SIZE, SIZE, 3)
    for more in (
        {"method": "horizon"},
        {"azimuths": 8},
        {"method": "lattice", "hemicube": 5},
        {"hemicube": 5},
        {"method": "unoccluded"},
    ):
        assert render(SCENES["rough"], sl.Sky(), backend=fast, **more).error is None
    assert render(SCENES["flat"], sl.Sky(), backend=fast).error.max() < 1e-3


# -- refinement


@pytest.fixture
def four(monkeypatch):
    """Whatever a sky needs, four azimuths are begun with, and said to be exact."""
    make = SkyPlanner.make

    def poor(self):
        self.units, self.expected = 4, Errors(0.0, 0.0, 0.0)
        return make(self)

    monkeypatch.setattr(SkyPlanner, "make", poor)


def test_a_beam_that_misses_the_map(fast):
    """Errors count against the beam's own light: nothing is refined, and nothing is warned of."""
    y, x = np.mgrid[:32, :32]
    scene = sl.Scene(16 + 3 * np.sin(x / 4) + 2 * np.cos(y / 5))
    beam = sl.cosine_power(300, axis=(1, 0, 0.3))
    out = irradiance(scene, sl.Lamp((16, 16, -40), 3, beam), fast, tolerance=0.01)
    assert not out.warnings and len(out.plan.steps) == 1 and out.image.max() < 1e-9
    assert out.plan.error < 0.01


@pytest.mark.parametrize("missed, ratio", [(0.0, 0.2), (1.0, 0.5)], ids=["seen", "missed"])
def test_error_that_samples_miss(missed, ratio):
    """Samples tell a half difference's error ratio; where only few other nodes have one, it is one half."""
    ones = np.ones(100)
    planner = SimpleNamespace(
        samples=SimpleNamespace(errors=errors, least=0.0),
        exact=ones,
        audit=lambda method: 0.002,
        exact_error=0.0,
        tables_error=0.0,
        tail=0.1,
        mean=1.0,
    )
    method = SimpleNamespace(
        at=lambda samples: ones,
        half_difference_at=lambda samples: 0.01 * ones,
        estimate=lambda limit: Estimate(math.hypot(0.01, missed), 0.0, 1.0),
    )
    found = refinement.assess(planner, method)
    assert found.error_ratio == pytest.approx(ratio, rel=0.01)
    assert found.estimated == pytest.approx(ratio * math.hypot(0.01, missed), rel=0.01)


def test_errors_are_relative_to_the_exact_mean(fast):
    """Of a steep spot most nodes get next to nothing, which an image rounds to 0: its own mean is larger."""
    x, y = np.meshgrid(np.arange(96.0), np.arange(96.0))
    scene = sl.Scene(np.where((x % 9 < 4) & (y % 7 < 3), 4.0, 20.0))
    centre, target = np.array([-15.0, -20.0, -25.0]), np.array([6.0, 6.0, 20.0])
    axis = tuple((target - centre) / np.linalg.norm(target - centre))
    lamp = sl.Lamp(tuple(centre), 3, brightness=sl.cosine_power(200, axis=axis))
    planner = refinement.choose(scene, lamp, 0.003, select(fast))
    method = planner.begin()
    image, exact = method.irradiance(), planner.exact
    shown, lit = np.mean(method.at(planner.samples) > 0), np.mean(exact > 0)
    assert 0 < shown < 0.8 * lit  # else the case tells nothing
    mean = image.sum(dtype=float) / image.size / lit  # all light over the nodes that have any
    rms = np.sqrt(np.mean(method.half_difference()().astype(float) ** 2)) / mean
    assert refinement.assess(planner, method).estimate.rms == pytest.approx(rms, rel=0.25)


def test_light_that_no_sample_receives(fast):
    """The estimate is over all nodes, and relative to the image's own mean."""
    depth = np.full((64, 64), 5.0)
    depth[23:27, 23:27] = 9.0
    scene, lamp = sl.Scene(depth), sl.Lamp((24.2, 24.6, 7.4), 0.6)
    planner = refinement.choose(scene, lamp, 0.003, select(fast))
    method = planner.begin()
    image, difference = method.irradiance(), method.half_difference()()
    assert not planner.exact.any() and image.any() and difference.any()
    expected = np.sqrt(np.mean(difference.astype(float) ** 2)) / image[image > 0].mean()
    assert refinement.assess(planner, method).estimate.rms == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("source", [sl.Sky(), GLOW, SUN], ids=["uniform", "glow", "sun"])
def test_a_bad_choice_is_refined(fast, four, source):
    """By the azimuths between, again and again, until image and estimate are within tolerance."""
    for tolerance in (0.03, 0.006):
        out = irradiance(SCENES["rough"], source, fast, tolerance=tolerance)
        units = [step.units for step in out.plan.steps]
        assert sorted({*units}) == [4 * 2**n for n in range(len({*units}))] and units == sorted(
            units
        )  # the same number again: with more near rows
        assert len({*units}) >= 1 + 2 * (tolerance < 0.01) and out.plan.azimuths == units[-1]
        estimates = [step.estimate for step in out.plan.steps]
        assert (
            (len({*units}) == 1 or estimates[0] > tolerance)
            and tolerance >= out.plan.error
            and out.plan.error in out.plan.steps[-1][1:]
            and not out.warnings
        )
        nodes = some_nodes(SCENES["rough"], 150)
        assert (
            errors(out.image[nodes].astype(float), truth(SCENES["rough"], source, nodes)).rms
            <= 1.15 * tolerance
        )


def test_a_tolerance_that_cannot_be_had(fast):
    """The best there is, and a warning with the number."""
    out = irradiance(SCENES["tiny"], sl.Sky(), fast, tolerance=1e-6)
    assert out.plan.azimuths >= 128 and said(out) == pytest.approx(
        max(v for v in out.plan.steps[-1][1:] if v is not None), rel=0.05
    )
    nodes = some_nodes(SCENES["tiny"], 100)
    assert errors(out.image[nodes].astype(float), truth(SCENES["tiny"], sl.Sky(), nodes)).rms < 0.01


def test_what_cannot_be_worked_off_is_an_error(fast):
    """Depth in another unit than spacing on a map that repeats: said before anything is begun."""
    with pytest.raises(sl.errors.CapacityError, match="relief"):
        render(sl.Scene(1e9 * SCENES["periodic"].depth, sides="periodic"), sl.Sky(), backend=fast)


@pytest.mark.slow
def test_the_audit_tells_what_halves_share(fast, monkeypatch):
    """An image that is off in both halves alike is found out by the samples, and said so."""
    before = horizon._scaled
    monkeypatch.setattr(horizon, "_scaled", lambda image, scale: before(image, scale) * np.float32(1.05))
    out = irradiance(SCENES["rough"], sl.Sky(), fast, tolerance=0.01)
    assert any(w.startswith("Tolerance:") for w in out.warnings) and out.plan.steps[0].audit == pytest.approx(
        0.05, rel=0.3
    )


# -- the same bytes


CALLS = [
    ("rough", sl.Sky(), 0.01),
    ("houses", GLOW, 0.01),
    ("holes", LOW, 0.01),
    ("dark", WINDOW, 0.02),
    ("periodic", sl.Sky(), 0.03),
    ("dome", HIGH, 0.01),
]


@pytest.mark.slow
def test_the_same_call_gives_the_same_bytes(fast):
    """Again, after other renders, of a scene that is equal, and while another thread works."""
    call = lambda name, source, tolerance: irradiance(
        replace(SCENES[name]), source, fast, tolerance=tolerance
    )
    first = [call(*given) for given in CALLS]
    stop = threading.Event()
    busy = threading.Thread(
        target=lambda: [
            np.linalg.norm(np.random.default_rng(0).random((300, 300)) @ np.ones((300, 300)))
            for _ in iter(stop.is_set, True)
        ]
    )
    busy.start()
    try:
        for before, given in reversed([*zip(first, CALLS)]):
            again = call(*given)
            np.testing.assert_array_equal(again.image.view(np.uint32), before.image.view(np.uint32))
            np.testing.assert_array_equal(again.error.view(np.uint32), before.error.view(np.uint32))
            assert again.plan == before.plan and again.warnings == before.warnings
    finally:
        stop.set()
        busy.join()


@pytest.mark.slow
def test_the_same_bytes_in_another_process(tmp_path):
    """With an empty folder of caches."""
    code = (
        "import sys, numpy as np, skylamp as sl; z = np.load(sys.argv[1]); out = sl.render(sl.Scene(z),"
        " sl.Sky(sl.cie_clear((30, 40), direct=2.0)), tolerance=0.01, backend='numpy',"
        " interreflection=False); np.save(sys.argv[2], out.image); print(out.plan)"
    )
    np.save(tmp_path / "z.npy", ROUGH[:40, :40])
    run = lambda n: (
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "z.npy"), str(tmp_path / f"{n}.npy")],
            capture_output=True,
            text=True,
            timeout=300,
            check=True,
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / f"cache{n}")},
        ).stdout
    )
    text = run(0)
    out = render(
        sl.Scene(ROUGH[:40, :40]), sl.Sky(sl.cie_clear((30, 40), direct=2.0)), tolerance=0.01, backend="numpy"
    )
    assert_bits_equal(out.image, np.load(tmp_path / "0.npy"))
    assert text.strip() == str(out.plan)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "source", "tolerance"),
    [
        *CALLS,
        ("rough", WINDOW, 0.01),
        ("houses", sl.Sky(), 0.03),
        ("flat", SUN, 0.01),
        ("dark", sl.Sky(sl.cie_overcast()), 0.003),
    ],
    ids=named,
)
def test_what_is_planned_is_what_is_done(fast, name, source, tolerance):
    """sl.plan and the render's plan agree line by line; in azimuths too where nothing was refined."""
    made, out = (
        sl.plan(SCENES[name], source, tolerance, fast, interreflection=False),
        irradiance(SCENES[name], source, fast, tolerance=tolerance),
    )
    assert (
        made.method == out.plan.method
        and made.choices == tuple(choice for choice in out.plan.choices if choice.what != "refined to")
        and made.beyond == out.plan.beyond
        and made.max_distance == out.plan.max_distance
    )
    if len(out.plan.steps) == 1:
        assert made.azimuths == out.plan.azimuths
    if out.plan.azimuths is not None:
        assert made.unit_name == out.plan.unit_name and out.plan.steps[-1].units == out.plan.azimuths
    assert out.plan.seconds >= out.plan.planning_seconds


@pytest.mark.parametrize(
    ("source", "first"),
    [
        (sl.Sky((0.0, 1.0, 0.5)), sl.Sky()),
        (replace(WINDOW, brightness=(1.0, 0.5, 0.2)), replace(WINDOW, brightness=1.0)),
        (sl.Lamp((20, 30, -9), 4, (0.0, 0.0, 0.0)), sl.Lamp((20, 30, -9), 4)),
        (sl.Sky(lambda L: np.stack([1 + L[..., 0], 1 - L[..., 0], 0 * L[..., 0]], -1)), None),
    ],
    ids=["sky", "window", "black", "function"],
)
def test_sources_in_colour_are_planned(fast, source, first):
    """The plan of the first colour, or of brightness 1 where colours are numbers, as a render begins."""
    scene = SCENES["rough"]
    first = sl.Sky(lambda L: 1 + L[..., 0]) if first is None else first
    made, grey = (sl.plan(scene, light, 0.03, fast, interreflection=False) for light in (source, first))
    assert str(made) == str(grey)
    out = irradiance(scene, source, fast, tolerance=0.03).plan
    units = out.steps[0].units if made.azimuths else None  # a closed form has none
    assert made.method == out.method and made.azimuths == units


PIERCED = sl.Window(aperture=np.arange(SIZE * SIZE).reshape(SIZE, SIZE) % 3 == 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sides", "source", "diffuse", "said"),
    [
        ("periodic", sl.Sky(), 0.4, "the radiance is made by a lattice"),
        ("open", PIERCED, 0.4, "summed over the lattice's directions"),
        ("open", PIERCED, 0.0, "summed over the lattice's directions"),
        ("open", sl.Sky(), 0.4, "summed beside the irradiance"),
    ],
    ids=["repeats", "aperture", "aperture, no diffuse light", "open"],
)
def test_a_plan_says_where_a_lobe_needs_the_lattice(fast, sides, source, diffuse, said):
    """And a render warns that the lobe, or all of the image, is not refined; of the others only."""
    scene = sl.Scene(ROUGH + 1, sides=sides, reflectance=sl.Phong(diffuse, 0.3, 5))
    assert said in str(sl.plan(scene, source, 0.03, fast))
    out = sl.render(scene, source, tolerance=0.03, backend=fast, interreflection=False)
    assert (out.plan.method == "lattice") == ("lattice" in said)
    assert any("is not known" in warning for warning in out.warnings) == ("lattice" in said)
    assert bool(out.plan.steps) == (sides == "open" and diffuse > 0)


# -- maps that lie on a device


def on_device(depth):
    import warp as wp

    return sl.Scene(wp.array(depth.astype(np.float32), device="cpu"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rough", "houses"])
@pytest.mark.parametrize(
    "source", [sl.Sky(), sl.Sky(sl.cie_overcast()), GLOW], ids=["uniform", "overcast", "glow"]
)
def test_a_map_on_a_device_obeys_the_tolerance(name, source):
    """As the host's map does, to rounding."""
    depth = SCENES[name].depth
    samples = Samples(select("warp:cpu"), sl.Scene(depth), 300, 100_003)
    exact = samples.exact(source)
    for tolerance in (0.03, 0.006):
        there, here = (
            irradiance(scene, source, "warp:cpu", tolerance=tolerance)
            for scene in (on_device(depth), sl.Scene(depth))
        )
        assert errors(
            samples.of(there.image), exact
        ).rms <= 1.15 * tolerance and there.plan.tail == pytest.approx(10 * tolerance)
        np.testing.assert_allclose(there.image, here.image, rtol=1e-5, atol=1e-5 * here.image.max())
        assert there.plan.azimuths == here.plan.azimuths
    tight = sl.plan(on_device(depth), source, 0.03, "warp:cpu", tail=0.02)
    assert tight.azimuths > sl.plan(on_device(depth), source, 0.03, "warp:cpu").azimuths, (
        "a tail counts here too"
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rough", "houses", "flat", "dome"])
def test_a_map_on_a_device_is_not_fetched(monkeypatch, name):
    """Under a uniform sky: planned, rendered and judged there."""
    from skylamp.backends.resident import Resident

    monkeypatch.setattr(Resident, "download", lambda self: pytest.fail("the map came to the host"))
    scene = on_device(SCENES[name].depth)
    out = irradiance(scene, sl.Sky(), "warp:cpu", tolerance=0.01)
    assert out.error.shape == out.image.shape and "depth" not in vars(scene)


# -- maps that repeat, masks and dark boxes


SUNNY = sl.Sky(lambda L: 0.5 + 3e4 * (L @ towards(70, 35) > np.cos(np.radians(0.27))))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["periodic", "holes", "dark"])
@pytest.mark.parametrize(
    "source", [sl.Sky(), sl.Sky(sl.cie_overcast()), SUNNY], ids=["uniform", "overcast", "sunny"]
)
def test_maps_of_every_kind_keep_the_tolerance(fast, name, source):
    """Against exact rays in very many directions, at nodes that no plan has seen."""
    scene = SCENES[name]
    samples = Samples(select(fast), scene, 300, 100_003)
    exact = (
        under(samples, 0.5, [(towards(70, 35), np.radians(0.27), 3e4)])
        if source is SUNNY
        else truth(scene, source, (samples.y, samples.x))
    )
    out = irradiance(scene, source, fast, tolerance=0.01)
    assert errors(samples.of(out.image), exact).rms <= 0.0115 and not any(
        w.startswith("Tolerance") for w in out.warnings
    )


@pytest.mark.slow
def test_brightness_is_looked_at(fast):
    """A function is a table per azimuth; suns have their own azimuths."""
    line = lambda name, sky, t, what: next(
        (c.taken for c in sl.plan(SCENES[name], sky, t, fast).choices if c.what == what), ""
    )
    assert line("rough", sl.Sky(2.0), 0.05, "brightness") == "constant"
    assert (
        line("rough", sl.Sky(sl.cie_overcast()), 0.01, "brightness")
        == line("rough", GLOW, 0.01, "brightness")
        == "a table per azimuth"
    )
    count, each = zip(
        *(map(int, re.findall(r"\d+", line("houses", SUN, t, "bright parts"))) for t in (0.1, 0.003))
    )
    assert count == (2, 2) and each[0] < each[1]  # the disc, and what glows round it
    assert line("periodic", SUN, 0.01, "bright parts") and not line("rough", GLOW, 0.01, "bright parts")


def test_more_rows_are_tested_among_cliffs_where_the_tolerance_needs_it(fast):
    """And the image is within it: sweeps with few rows are all off alike behind cliffs."""
    loose, tight = (sl.plan(SCENES["houses"], sl.Sky(), t, fast) for t in (0.05, 0.01))
    assert "near rows" in str(tight) and "near rows" not in str(loose) and loose.azimuths < tight.azimuths


# -- what is beyond the model


# tilted, its lower edge 0.4 spacings above the level ground
TILTED_PANEL = sl.Lamp(corner=(30, 40, 4.6), edges=((0, 6, 0), (8, 0, -6)))


@pytest.mark.parametrize(
    ("scene", "source", "says"),
    [
        (sl.Scene(ROUGH, albedo=0.8), sl.Sky(), "Light between surfaces is left out: it is about"),
        (SCENES["rough"], sl.Lamp((36, 36, float(ROUGH[36, 36]) - 1.5), 1.2), "The lamp touches the surface"),
        (SCENES["flat"], sl.Lamp((30, 40, -20), 24.5), "The lamp touches the surface: it ends 0.5 spacings"),
        (SCENES["flat"], TILTED_PANEL, "The lamp touches the surface: it ends 0.4 spacings"),
        (
            SCENES["holes"],
            replace(TILTED_PANEL, corner=(12, 40, float(ROUGH[40, 12]))),
            "The lamp touches the surface",
        ),
        (SCENES["houses"], sl.Sky(), "Slopes are steeper than the grid holds"),
        (SCENES["holes"], sl.Sky(), "Nodata"),
        (sl.Scene(np.float32(ROUGH + 3e5)), sl.Sky(), "float32 rounds depths by"),
    ],
    ids=[
        "between surfaces",
        "touching lamp",
        "large lamp",
        "panel",
        "panel over holes",
        "cliffs",
        "holes",
        "rounding",
    ],
)
def test_what_a_scene_needs_beyond_the_model(fast, scene, source, says):
    """Each is said with a number, and not of a scene that lacks it."""
    direct = {"backend": fast, "interreflection": False}
    found = [text for text in sl.plan(scene, source, **direct).beyond if text.startswith(says)]
    assert len(found) == 1 and any(c.isdigit() for c in found[0]), found
    for apart in (sl.Sky(), replace(TILTED_PANEL, corner=(30, 40, 3.9))):
        assert sl.plan(SCENES["flat"], apart, backend=fast).beyond == ()
    assert not any(
        text.startswith("Light between")
        for scene, asked in ((sl.Scene(ROUGH, albedo=0.0), False), (sl.Scene(ROUGH), "auto"))
        for text in sl.plan(scene, sl.Sky(), backend=fast, interreflection=asked).beyond
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("depth", "source", "says"),
    [
        (5.0, sl.Lamp(corner=(4, 4, 5), edges=((6, 0, 0), (0, 6, 0))), "The lamp touches the surface: nodes"),
        (0.0, sl.Window((2, 9), (2, 9)), "The window touches the surface: nodes lie in its plane"),
    ],
    ids=["panel", "window"],
)
def test_a_source_in_the_surface_is_a_warning(fast, depth, source, says):
    """Its light is not defined there; a source above the surface has no such warning."""
    for away, method in itertools.product((0.0, 3.5), ("auto", "horizon", "unoccluded")):
        scene = sl.Scene(np.full((16, 16), depth + away))
        out = sl.render(scene, source, method, tolerance=0.1, interreflection=False, backend=fast)
        assert sum(text.startswith(says) for text in out.warnings) == (away == 0), out.warnings


def test_a_plan_tells_the_light_between_surfaces_in_a_bowl(fast):
    """In a bowl of rim angle a, bounces add E rho (1 - f) / (1 - rho (1 - f)) with f = (1 + cos a) / 2."""
    radius, rim = 150.0, np.radians(50)
    size = 2 * int(radius * np.sin(rim)) + 9
    y, x = np.mgrid[:size, :size] - size // 2
    depth = np.maximum(0, np.sqrt(np.maximum(0, radius**2 - x**2 - y**2)) - radius * np.cos(rim))
    rho, sky = 0.6, (1 + np.cos(rim)) / 2
    made = sl.plan(sl.Scene(depth, albedo=rho), sl.Sky(), backend=fast)
    exact = rho * (1 - sky) / (1 - rho * (1 - sky))
    inside = np.pi * (radius * np.sin(rim)) ** 2 / size**2  # the flat corners add nothing
    direct = sky * inside + 1 - inside
    assert made.interreflection == pytest.approx(exact * sky * np.sqrt(inside) / direct, rel=0.05)
    (line,) = (choice for choice in made.choices if choice.what == "interreflection")
    assert line.taken == "included" and f"{100 * made.interreflection:.2g} %" in line.why


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_a_sun_behind_an_aperture_has_all_its_light(fast, sides):
    """It fell between the directions of the lattice, and of the light that judges it: two thirds of all light
    were lost without a word.
    """
    sun, edge = towards(270, 60), math.cos(math.radians(0.27))
    window = sl.Window(aperture=np.ones((40, 40), bool), brightness=lambda L: 1 + 1e5 * (L @ sun > edge))
    out = irradiance(sl.Scene(np.full((40, 40), 0.5), sides=sides), window, fast)
    whole = math.pi * (1 + 1e5 * math.sin(math.radians(0.27)) ** 2 * math.sin(math.radians(60)))
    assert out.image[20, 20] == pytest.approx(whole, rel=0.01) and not out.warnings


@pytest.mark.slow
def test_a_sun_through_holes_is_told(fast):
    """The patches of light of a sun between the lattice's directions lie elsewhere; a warning says so."""
    sun, edge = towards(200, 50), math.cos(math.radians(2))
    holes = np.random.default_rng(3).random((40, 40)) < 0.3
    window = sl.Window(aperture=holes, brightness=lambda L: 1 + 2e3 * (L @ sun > edge))
    out = irradiance(sl.Scene(np.full((40, 40), 10.0)), window, fast)
    y, x = np.mgrid[:40, :40].astype(float)
    exact, n = np.zeros((40, 40)), 1000
    for k in range(n):  # the sun alone, as n points
        r, a = math.radians(2) * math.sqrt((k + 0.5) / n), k * math.pi * (1 + 5**0.5)
        east = np.cross(sun, [0, 0, 1.0]) / np.hypot(*sun[:2])
        L = sun + math.tan(r) * (math.cos(a) * east + math.sin(a) * np.cross(sun, east))
        col, row = (np.rint(v + 10 * L[axis] / -L[2]).astype(int) for axis, v in enumerate((x, y)))
        on_map = (col >= 0) & (col < 40) & (row >= 0) & (row < 40)
        exact += on_map & holes[np.clip(row, 0, 39), np.clip(col, 0, 39)]
    exact *= 2e3 * math.pi * math.sin(math.radians(2)) ** 2 * math.sin(math.radians(50)) / n
    true = errors(out.image.ravel() - out.image.min(), exact.ravel()).rms
    assert 0.4 < true and 0.5 * true < said(out) < 2 * true


def test_what_the_lattice_must_do_is_planned_too(fast):
    """An aperture, a window over a map that repeats, a volume: hemicubes, measured where possible."""
    aperture = np.zeros((SIZE, SIZE), bool)
    aperture[10:50, 20:60] = True
    made = sl.plan(SCENES["rough"], sl.Window(aperture=aperture), 0.05, fast)
    assert (
        made.method == "lattice"
        and made.filled
        and made.hemicube > 5
        and made.error < 0.05
        and "aperture" in str(made)
    )
    assert sl.plan(SCENES["periodic"], WINDOW, 0.1, fast).method == "lattice"
    volume = np.zeros((2, SIZE, SIZE), bool)
    volume[0, 20:50, 20:50] = True
    unknown = sl.plan(sl.Scene(ROUGH + 5), sl.Lamp(volume=volume), 0.01, fast)
    assert unknown.method == "lattice" and unknown.error is None and "35 to 110 %" in str(unknown)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: sl.plan(SCENES["flat"], sl.Sky(), 0), "tolerance"),
        (lambda: sl.plan(SCENES["flat"], sl.Sky(), "x"), "tolerance"),
        (lambda: sl.plan(SCENES["flat"], sl.Sky(), tail=-1), "tail"),
        (lambda: sl.plan(np.ones((3, 3)), sl.Sky()), "skylamp.Scene"),
        (lambda: sl.plan(SCENES["flat"], 3.0), "Sky, Lamp or Window"),
        (lambda: render(SCENES["flat"], sl.Sky(), "horizon", tail=0.1), "tail"),
        (lambda: render(SCENES["flat"], sl.Sky(), "unoccluded", azimuths=3), "unoccluded"),
        (lambda: render(SCENES["periodic"], HIGH, tolerance=0.01), "periodic"),
        (lambda: sl.plan(SCENES["rough"], sl.Lamp((36, 36, 500), 2)), "below the surface"),
    ],
)
def test_bad_input_is_named(call, says):
    with pytest.raises(sl.InputError, match=says):
        call()


# -- command line and chart


def test_the_command_line_prints_plans(fast, tmp_path):
    """A table with reasons, or one JSON object; a tolerance as a share or in percent; else a usage error."""
    from typer.testing import CliRunner

    from skylamp.app.cli import app

    np.save(tmp_path / "depth.npy", ROUGH)
    ask = lambda *more: CliRunner().invoke(
        app, ["plan", str(tmp_path / "depth.npy"), "--backend", fast, *more]
    )
    percent, share = (json.loads(ask("--json", "--tolerance", text).stdout) for text in ("0.4%", "0.004"))
    assert (
        percent["tolerance"] == share["tolerance"] == pytest.approx(0.004)
        and percent["azimuths"] == share["azimuths"] > 8
    )
    text = ask("--tolerance", "1%", "--interreflection", "off").stdout
    assert "azimuths" in text and "within 1%" in text and "Beyond the model" in text
    assert "interreflection" in text and ask("--interreflection", "perhaps").exit_code == 2
    assert ask("--tolerance", "much").exit_code == 2


@pytest.mark.slow
def test_the_chart_has_a_point_for_every_setting(fast, tmp_path):
    """All classes, the plan's three choices, a picture; the frontier is what nothing beats."""
    from skylamp.app import chart

    rows = chart.measure([fast], (24,), longest=0.02)
    assert {row["class"] for row in rows} == set(chart.CLASSES) and all(
        row["seconds"] > 0 and row["error"] >= 0 for row in rows
    )
    for kind in chart.CLASSES:
        here = [row for row in rows if row["class"] == kind]
        assert [row["units"] for row in here if row["method"] == "plan"] == list(chart.TOLERANCES)
        assert {row["method"] for row in here} == {method for method, *_ in chart.settings(kind)}
    chart.draw(rows, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 20_000
    row = lambda method, units, error, seconds, again: {
        "class": "smooth",
        "size": 9,
        "method": method,
        "units": units,
        "error": error,
        "seconds": seconds,
        "again": again,
    }
    some = [
        row("plan", 0.03, 0.01, 6, 3),
        row("filled", 5, 0.02, 2, 2),
        row("horizon", 8, 0.01, 4, 4),
        row("horizon", 64, 0.001, 9, 9),
        {**row("horizon", 4, 0.001, 1, 1), "size": 8},
    ]
    assert (
        chart.behind(some)["smooth"][0] == 3
        and chart.behind(some, "again")["smooth"][0] == 1.5
        and chart.behind(some, "again", True)["smooth"][0] == 0.75
    )
    assert chart.frontier([(1, 5), (2, 6), (3, 1), (2.5, 2)]) == [(1, 5), (2.5, 2), (3, 1)]
    with pytest.raises(sl.InputError, match="sizes"):
        chart.measure([fast], (4,))


@pytest.mark.parametrize("tail", [None, 1e-4])
def test_a_tail_that_is_not_had_is_a_warning(fast, tail):
    """The share of nodes beyond it, and nothing where the usual one is had."""
    out = irradiance(
        SCENES["rough"], sl.Sky(), fast, tolerance=0.05, **({} if tail is None else {"tail": tail})
    )
    said = [text for text in out.warnings if text.startswith("Tail: the error is estimated to pass 0.01 %")]
    assert bool(said) == (tail is not None)


def test_a_plan_says_how_it_was_refined(fast, monkeypatch):
    """With the number that was taken in the end, not the one that was begun with."""
    monkeypatch.setattr(SkyPlanner, "choose_units", lambda self, ladder: setattr(self, "units", 4))
    out = irradiance(SCENES["rough"], sl.Sky(), fast, tolerance=0.01)
    assert len(out.plan.steps) > 1 and out.plan.azimuths == out.plan.steps[-1].units > 4
    taken = {choice.what: choice.taken for choice in out.plan.choices}
    assert taken["refined to"] == f"{out.plan.azimuths} azimuths" and "refined" in out.plan.line
    assert "4 azimuths at first" in str(out.plan)


def test_a_plan_calls_its_units_by_their_name(fast):
    """Points of a tube, slices of a lamp, rays of a closed form."""
    bumps, tube = SCENES["rough"], sl.Lamp(corner=(4, 10, -10), edges=((12, 0, 0), (0, 0.01, 0)))
    made = sl.plan(bumps, tube, 0.01, fast)
    assert made.line.startswith(f"horizon, {made.azimuths} points: ")
    planner = refinement.choose(bumps, sl.Lamp((8, 8, -10), 3), 0.01, select(fast))
    method = planner.begin()
    begun, units = method.amount, method.units
    method.refine()
    assert (begun, method.amount) == (f"{units} slices", f"{2 * units} slices")
    image = np.zeros(bumps.shape, np.float32)
    words = [unoccluded.ClosedForm(bumps, image, units=rays).amount for rays in (0, 1, 16)]
    assert words == ["a closed form", "1 ray", "16 rays"]


@pytest.mark.slow
def test_where_nothing_is_lit_the_error_is_a_number(fast):
    """At the bottom of a box a million times as deep as it is wide no error is nan."""
    depth = np.full((8, 10), 1e7)
    depth[2:5, 3:7] += 1
    source = sl.Sky(sl.cie_sky(12, (200, 60), direct=2.0))
    out = sl.render(sl.Scene(depth, sides="dark"), source, backend=fast)
    assert np.isfinite(out.error).all() and np.isfinite(out.image).all()


@pytest.mark.slow
def test_light_where_exact_rays_find_none_is_warned_of(fast):
    """A shaft a million times as deep as it is wide: no estimate is nan, which passes every tolerance."""
    sky = sl.Window((-1e9, 1e9), (-1e9, 1e9), brightness=lambda L: np.stack([1 - L[..., 2]] * 3, -1))
    out = sl.render(sl.Scene(np.full((10, 12), 1e7), sides="dark"), sky, backend=fast)
    assert not np.isnan(out.error).any()
    assert any(text.startswith("Tolerance") for text in out.warnings) or out.image.max() < 1e-9


@functools.cache
def above_dark_boxes(n, deep):
    """(random heights, an uneven sky, its irradiance as if ground hid nothing), from flat boxes to shafts."""
    sky = sl.Sky((sl.cie_sky(12, (263, 41), direct=2.0), sl.cie_clear((40, 8)), GLOW.brightness)[n])
    depth = np.random.default_rng(n).random((5, 4 + n)) * deep
    scene = sl.Scene(depth, sides="dark")
    return depth, sky, render(scene, sky, "unoccluded", quantity="irradiance", backend="numpy").image


def no_light_is_negative(backend, deep, some):
    for n in some:
        depth, sky, free = above_dark_boxes(n, deep)
        for how in ({"tolerance": 0.05}, {"method": "horizon", "azimuths": 8}):
            scene = sl.Scene(depth, sides="dark")
            out = render(scene, sky, quantity="irradiance", backend=backend, **how)
            assert out.image.min() >= 0, (n, deep, how)
            assert (out.image <= 1.05 * free + 1e-6).all(), (n, deep, how)


@pytest.mark.slow
@pytest.mark.parametrize("deep", [30, 1e7])
def test_no_light_is_negative_in_a_shaft(fast, deep):
    """Uneven skies in the few azimuths of a coarse tolerance: a control variate left -15 % of the mean."""
    no_light_is_negative(fast, deep, range(3))


@pytest.mark.slow
@pytest.mark.parametrize("deep", [30, 1e7])
def test_no_light_is_negative(backend, deep):
    """Nor on any backend."""
    no_light_is_negative(backend, deep, [1])
