"""plan(): pilots against the oracle, promises kept, what is flat runs no kernel, and every warning that a plan can give."""

import json
import re
import sys
import weakref
from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
from skylamp import costs, oracle, sources, unoccluded
from skylamp.backends import select
from skylamp.backends.slices import Ball, rectangle
from skylamp.pilots import NONE, Pilots
from skylamp.plan import Errors, errors, solid_of, upright
from skylamp.radiometry import polygon_moment

SIZE = 72
Y, X = np.mgrid[:SIZE, :SIZE].astype(float)
AWAY = np.hypot(X - 35.5, Y - 35.5)
ROUGH = scenes.rough(SIZE, SIZE, 1.0, 4)
HOUSES = np.where((X % 18 < 8) & (Y % 15 < 7), 20 - (X // 18 * 5 + Y // 15 * 3) % 17, 24.0)
HOLES = np.ones(ROUGH.shape, bool)
HOLES[20:30, 30:50] = HOLES[60:, :9] = False
SCENES = {
    "flat": sl.Scene(np.full((SIZE, SIZE), 5.0)), "ramp": sl.Scene(0.6 * X + 0.3 * Y), "dome": sl.Scene(0.004 * AWAY**2), "rough": sl.Scene(ROUGH), "houses": sl.Scene(HOUSES),
    "dark": sl.Scene(ROUGH + 6, sides="dark"), "periodic": sl.Scene(scenes.rough(SIZE, SIZE, 0.6, 9), sides="periodic"), "holes": sl.Scene(np.where(HOLES, ROUGH, np.nan), mask=HOLES),
    "metres": sl.Scene(30 * ROUGH, 30.0), "tiny": sl.Scene(ROUGH[:9, :13]),
}  # fmt: skip
GLOW = sl.Sky(lambda L: 1 + 5 * np.maximum(0, L @ np.array([0.6, 0.48, -0.64])) ** 6)
SUN = sl.Sky(lambda L: 1 + 600 * np.exp((L @ np.array([0.6, 0.48, -0.64]) - 1) / 0.001))  # some 3 degrees wide; smooth, for the oracle samples it
HIGH = sl.Lamp((40, 30, -60), 6)
LOW = sl.Lamp((20, 50, -6), 3, brightness=sl.cosine_power(2))
PANEL = sl.Lamp(corner=(20, 22, -15), edges=((18, 0, 0), (0, 12, 0)))
WINDOW = sl.Window(x=(20.3, 45.1), y=(12, 50.7))


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
        return oracle.sky_irradiance(np.nan_to_num(depth), scene.spacing, valid, rays.angles, rays.widths, horizon, source.brightness if callable(source.brightness) else None, nodes)
    if isinstance(source, sl.Window):
        return oracle.window_irradiance(depth, scene.spacing, valid, source, nodes, 4096, sides=scene.sides)
    lamp = source if source.center is not None else (source.corner, *source.edges, source.brightness)
    return oracle.lamp_irradiance(depth, scene.spacing, valid, lamp, nodes, 4096, sides=scene.sides)


@pytest.fixture
def launched(monkeypatch, fast):
    """The stems of all kernels that are launched on the fast backend."""
    engine, stems = select(fast), []
    for method in costs.UNITS:  # else they are measured when a plan first asks
        costs.Costs(engine)[method]
    before = engine.launch
    monkeypatch.setattr(engine, "launch", lambda stem, *args, **more: (stems.append(stem), before(stem, *args, **more))[1])
    return stems


# -- pilots ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rough", "dark", "periodic", "holes", "metres", "tiny"])
def test_pilots_see_the_oracles_horizons(backend, name):
    """On every backend, every crossing: horizons clamped at the level, the tangent plane and the wall agree to float32."""
    scene, pilots = SCENES[name], Pilots(SCENES[name], 24)
    azimuths = np.array([0, 0.3, 1.1, np.pi / 4, np.pi / 2, 2.2, 3.6, 4.9, 6.1])
    found = pilots.horizons(select(backend), azimuths)
    raw = oracle.horizons(scene.depth.astype(float), scene.spacing, azimuths, scene.sides, nodes=(pilots.y, pilots.x))
    wanted = np.maximum(pilots.least(np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]), raw)
    np.testing.assert_allclose(found, wanted, atol=2e-4, rtol=2e-5)
    assert (raw > pilots.least(np.cos(azimuths)[:, None], np.sin(azimuths)[:, None])).mean() > 0.2, "nothing stands in the way"
    normal = oracle.normals(np.nan_to_num(scene.depth.astype(float)), scene.spacing, scene.valid)[pilots.y, pilots.x]
    np.testing.assert_allclose(np.stack([pilots.gx, pilots.gy]), (normal[:, :2] / -normal[:, 2:]).T, atol=1e-5)


@pytest.mark.parametrize("source", [HIGH, LOW, PANEL, WINDOW], ids=["ball", "low spot", "panel", "window"])
def test_pilots_see_lamps_as_shadow_rays_do(fast, source):
    """Slices through a source against 4096 rays a node, and never a node that is masked."""
    for scene in (SCENES["rough"], SCENES["holes"]):
        pilots = Pilots(scene, 40)
        assert scene.valid[pilots.y, pilots.x].all() and (pilots.own > NONE).all()
        solid = upright(solid_of(scene, source, 1.0, 1.0))
        found = pilots.through_slices(select(fast), solid, source.brightness, 128)
        wanted = truth(scene, source, (pilots.y, pilots.x))
        assert errors(found, wanted).rms < 0.005 and (wanted > 0).mean() > 0.3


def test_pilots_are_spread_and_the_same_again():
    """Over all quarters of a map, on a few valid nodes among many masked, and all nodes of a small map."""
    one, other = Pilots(SCENES["rough"]), Pilots(SCENES["rough"])
    assert_bits_equal(one.x.astype(np.int64), other.x.astype(np.int64))
    quarters = np.bincount(2 * (one.x > SIZE / 2) + (one.y > SIZE / 2), minlength=4)
    assert len(one) == 256 and quarters.min() > 50
    few = np.zeros((40, 50), bool)
    few[3:5, 7:30] = True
    assert len(Pilots(sl.Scene(np.zeros((40, 50)), mask=few))) == 46 and len(Pilots(SCENES["tiny"])) == 9 * 13


def test_errors_by_hand():
    """RMS over all nodes, mean over the lit ones; exponential errors have their 99.9th percentile at ln 1000 of their mean."""
    exact = np.array([0.0, 0.0, 1.0, 3.0])
    assert errors(exact + [0.2, 0, 0, -0.2], exact).rms == pytest.approx(np.sqrt(0.08 / 4) / 2)
    rng = np.random.default_rng(0)
    found = errors(1 + 0.01 * rng.exponential(size=4000), np.ones(4000))
    assert found.tail == pytest.approx(0.01 * np.log(1000), rel=0.1) and found.rms < found.bound < 1.06 * found.rms
    rare = np.zeros(100)
    rare[7] = 1
    assert errors(rare + 1, np.ones(100)).bound > 1.4 * errors(rare + 1, np.ones(100)).rms, "one node in a hundred may be three"
    assert errors(np.zeros(3), np.zeros(3)) == Errors(0, 0, 0) and errors(np.ones(3), np.zeros(3)).rms == np.inf


# -- promises --------------------------------------------------------------------------------------------------------------------


def named(value):
    """A test's name that is the same in every process."""
    return re.sub(r" at 0x\w+", "", str(value))


@pytest.mark.parametrize(("name", "source"), [
    ("rough", sl.Sky()), ("rough", GLOW), ("rough", SUN), ("houses", sl.Sky()), ("houses", SUN), ("houses", HIGH), ("dark", sl.Sky(sl.cie_overcast())), ("periodic", sl.Sky()),
    ("holes", LOW), ("metres", sl.Sky(2.0)), ("rough", WINDOW), ("rough", PANEL), ("dark", WINDOW), ("dome", GLOW), ("dome", HIGH), ("tiny", GLOW),
], ids=named)  # fmt: skip
def test_tolerances_are_kept(fast, name, source):
    """Against the oracle at nodes that no plan has seen; a plan's word and the pilots' agree."""
    scene = SCENES[name]
    nodes = some_nodes(scene, 150)
    exact = truth(scene, source, nodes) * (source.brightness if isinstance(source, sl.Sky) and not callable(source.brightness) else 1)
    for tolerance in (0.03, 0.006):
        out = sl.render(scene, source, tolerance=tolerance, backend=fast, quantity="irradiance")
        error = errors(out.image[nodes].astype(float), exact).rms
        assert error <= 1.15 * tolerance, (tolerance, error, out.plan)
        assert out.plan.tolerance == tolerance and out.plan.tail == pytest.approx(10 * tolerance)
        assert out.plan.measured is None or out.plan.measured <= tolerance
        assert not any(w.startswith("Tolerance") for w in out.warnings)


def test_a_tighter_tolerance_or_tail_takes_more(fast):
    """More azimuths, a smaller error, and a reason that names it; a tail alone can ask for more."""
    plans = [sl.plan(SCENES["rough"], sl.Sky(), t, fast) for t in (0.0115, 0.004, 0.001)]
    assert plans[0].azimuths < plans[1].azimuths < plans[2].azimuths and plans[0].error > plans[1].error > plans[2].error
    assert all(p.error <= p.tolerance and p.error_tail <= p.tail for p in plans)
    assert sl.plan(SCENES["rough"], sl.Sky(), 0.0115, fast, tail=0.01).azimuths > plans[0].azimuths
    text = str(plans[1])
    assert f"{plans[1].azimuths} evenly" in text and "precision" in text and "99.9th percentile" in text and plans[1].line.startswith("horizon, ")
    assert {c.what for c in plans[1].choices} >= {"occlusion", "brightness", "azimuths", "search radius", "method", "specular lobe", "precision", "error", "99.9th percentile", "time"}
    assert plans[1].seconds > plans[1].planning_seconds > 0


@pytest.mark.parametrize("elevation", [12, 70, 89.9])
def test_a_sun_of_its_real_size_brings_all_its_light(fast, elevation):
    """On open level ground, also near the zenith, where no azimuth stands out; among houses by every crossing (tests/test_slices.py)."""
    e, r = np.radians((elevation, 0.2665))
    axis = np.array([np.cos(e) * np.cos(1.0), np.cos(e) * np.sin(1.0), -np.sin(e)])
    sun = sl.Sky(lambda L: 1 + 2e4 * (L @ axis >= np.cos(r)))
    image = sl.render(SCENES["flat"], sun, tolerance=0.01, backend=fast, quantity="irradiance").image
    np.testing.assert_allclose(image, np.pi * (1 + 2e4 * np.sin(r) ** 2 * np.sin(e)), rtol=0.004)


def choosing_takes(seconds, backend, monkeypatch):
    engine = select(backend)
    costs.Costs(engine)["plan"]
    monkeypatch.setitem(costs.known[costs.Costs(engine).key], "plan", costs.Cost(seconds, 0.0, 0.0))


@pytest.mark.parametrize(("name", "source"), [("houses", sl.Sky()), ("houses", SUN), ("rough", sl.Sky(sl.cie_overcast(2.0))), ("dark", GLOW), ("rough", LOW), ("dark", WINDOW), ("houses", PANEL)], ids=named)
def test_what_is_sure_is_taken_where_choosing_takes_longer(fast, launched, monkeypatch, name, source):
    """A render in no time to choose: unmeasured, within tolerance, with the bounds of what the model lacks; plan() itself chooses."""
    choosing_takes(1e9, fast, monkeypatch)
    scene = replace(SCENES[name])
    nodes = some_nodes(scene, 150)
    exact = truth(scene, source, nodes)
    for tolerance in (0.03, 0.01, 0.003):
        out = sl.render(scene, source, tolerance=tolerance, backend=fast, quantity="irradiance")
        if source in (WINDOW, PANEL) and tolerance < 0.01:  # is not known to do
            assert out.plan.measured <= tolerance
            continue
        assert out.plan.error is None and out.plan.measured is None and "longer than to render" in str(out.plan)
        assert not isinstance(source, sl.Sky) or callable(source.brightness) or "pilot" not in launched, "no ray need be cast under a uniform sky"
        assert errors(out.image[nodes].astype(float), exact).rms <= tolerance
        assert any(text.startswith("Light between") for text in out.plan.beyond)
    assert sl.plan(scene, source, 0.01, fast).error <= 0.01
    assert sl.render(scene, source, tolerance=1e-4, backend=fast).plan.error is not None, "nothing is known to be as good as that"


@pytest.mark.parametrize(("name", "says"), [("houses", "Slopes are steeper"), ("holes", "Nodata"), ("rough", "Light between")])
def test_what_is_taken_at_a_glance_says_what_it_lacks(fast, monkeypatch, name, says):
    """What a plan with pilots has to say, and as large a bound on the light between surfaces, of the image's own nodes."""
    choosing_takes(1e9, fast, monkeypatch)
    beyond = lambda plan: next(text for text in plan.beyond if text.startswith(says))
    made, out = sl.plan(SCENES[name], sl.Sky(2.0), 0.03, fast), sl.render(SCENES[name], sl.Sky(2.0), tolerance=0.03, backend=fast)
    assert out.plan.error is None and ("near rows" in str(out.plan)) == (name == "houses")
    percents = [float(re.search(r"([\d.e+]+) %", beyond(plan))[1]) for plan in (made, out.plan)]
    assert percents[1] == pytest.approx(percents[0], rel=0.2)


@pytest.mark.parametrize("name", ["flat", "ramp", "dome"])
def test_what_nothing_hides_is_never_swept_however_long_choosing_takes(fast, launched, monkeypatch, name):
    choosing_takes(1e9, fast, monkeypatch)
    assert sl.render(replace(SCENES[name]), sl.Sky(), tolerance=0.03, backend=fast).plan.method == "unoccluded" and launched == []


def test_a_scene_is_not_looked_at_twice(fast, launched):
    """Other skies and tolerances find the horizons that are known, and say the same of a scene that is new; nothing keeps a scene alive."""
    scene = sl.Scene(ROUGH)
    sl.plan(scene, sl.Sky(), 0.001, fast)
    assert "pilot" in launched
    launched.clear()
    for source, tolerance in ((sl.Sky(3.0), 0.001), (GLOW, 0.01), (sl.Sky(), 0.03)):
        again = sl.plan(scene, source, tolerance, fast)
        assert launched == []
        new = sl.plan(sl.Scene(ROUGH), source, tolerance, fast)
        assert (again.error, again.error_tail, again.azimuths, again.beyond) == (new.error, new.error_tail, new.azimuths, new.beyond)
        launched.clear()
    kept = Pilots.of(scene, 144, rare=True)
    assert kept._slopes and not kept._on and "heights" not in vars(kept), "copies of the map are not kept"
    azimuths = 2 * np.pi * np.arange(24) / 24
    assert (kept.horizons(select(fast), azimuths, 3.0) < kept.horizons(select(fast), azimuths)).any(), "a search that ends early is another"
    gone = weakref.ref(scene)
    del scene
    assert gone() is None


def test_what_other_light_may_do_is_looked_at_once(fast, launched, monkeypatch):
    """Under a lamp that is taken at a glance, few rays tell how much of the sky the ground sees, and are kept with the scene."""
    choosing_takes(1e9, fast, monkeypatch)
    scene = sl.Scene(ROUGH)
    first = sl.render(scene, LOW, backend=fast).plan
    assert "pilot" in launched and len(Pilots.of(scene, 192)._seen[select(fast).name]) == 48
    launched.clear()
    assert sl.render(scene, LOW, backend=fast).plan.beyond == first.beyond != () and "pilot" not in launched


def test_references_are_as_fine_as_they_must_be(fast, monkeypatch):
    """A loose tolerance asks 24 azimuths; a tight one as many as can judge it, and the finest at the latest."""
    sky, asked = sys.modules["skylamp.plan"]._Sky, []
    before = sky._evaluate
    monkeypatch.setattr(sky, "_evaluate", lambda self, azimuths, *more: asked.append(len(azimuths)) or before(self, azimuths, *more))
    for tolerance, wanted in ((0.05, [24]), (0.004, [24, 48, 96]), (1e-5, [24, 48, 96, 192])):
        asked.clear()
        made = sl.plan(sl.Scene(ROUGH), sl.Sky(), tolerance, fast)
        assert asked == wanted and (made.error <= tolerance) == (tolerance > 1e-4)


def test_a_glance_sees_what_is_far_away():
    """A wall round a floor that is level near every node; as a rule less is seen than there is, and on flat ground nothing."""
    wall = np.full((600, 600), 200.0)
    wall[:100] = wall[-100:] = 0
    for depth, least, most in ((wall, 0.7, 1.05), (scenes.rough(600, 600, 1.0, 4), 0.5, 1.0), (0.3 * np.mgrid[:600, :600][0], 0.0, 1.0)):
        pilots = Pilots(sl.Scene(depth))
        seen, lost = pilots.sky_lost_at_a_glance(), pilots.sky_lost(0.0)
        assert least * lost <= seen <= most * lost, (seen, lost)
        assert lost > 0.05 or lost < 1e-6


def test_few_rows_are_tested_among_cliffs_where_the_tolerance_allows_it(fast):
    """Twice as quick, and within the tolerance; else more rows."""
    loose, tight = (sl.plan(SCENES["houses"], sl.Sky(), t, fast) for t in (0.05, 0.01))
    assert "near rows" in str(tight) and "near rows" not in str(loose) and loose.azimuths < tight.azimuths
    units = [s.units for s in sys.modules["skylamp.plan"].work(SCENES["houses"], sl.Sky(), 0.01, select(fast)).settings]
    assert units == sorted(set(units)), "what is tried next, where the image is off, is finer"


def test_an_image_that_is_off_is_made_again(fast, monkeypatch):
    """A plan that claims four azimuths to be exact is found out at the pilots, and its image replaced by a finer one."""
    choosing_takes(0.0, fast, monkeypatch)
    module = sys.modules["skylamp.plan"]
    between = module._between
    monkeypatch.setattr(module, "_between", lambda measured, count: Errors(0.0, 0.0, 0.0) if count == 4 else between(measured, count))
    out = sl.render(SCENES["rough"], sl.Sky(), tolerance=0.01, backend=fast)
    assert sl.plan(SCENES["rough"], sl.Sky(), 0.01, fast).azimuths == 4 < out.plan.azimuths
    monkeypatch.setattr(module, "_between", lambda measured, count: Errors(0.0, 0.0, 0.0) if count <= 8 else between(measured, count))
    out = sl.render(SCENES["rough"], sl.Sky(), tolerance=0.001, backend=fast)
    assert out.plan.measured > 0.001 and any(w.startswith("Tolerance: the image is off by") for w in out.warnings)


def test_brightness_is_looked_at(fast):
    """A sky that hardly varies is a number; one of elevation alone has one table; a sun has azimuths of its own, more where walls may cut it; on a map that repeats it places them."""
    looks = lambda sky, t: next(c.taken for c in sl.plan(SCENES["rough"], sky, t, fast).choices if c.what == "brightness")
    nearly = sl.Sky(lambda L: 1 + 0.01 * L[..., 0])
    assert looks(nearly, 0.05) == "constant" and looks(nearly, 0.002) == "a table per azimuth"
    assert looks(sl.Sky(sl.cie_overcast()), 0.01) == "one table" and looks(GLOW, 0.01).startswith("a table per")
    suns = [next((c.taken for c in sl.plan(SCENES["houses"], SUN, t, fast).choices if c.what == "sun"), "") for t in (0.03, 0.003)]
    assert [text.split(" azimuths")[0] for text in suns] == ["8", "24"] and "placed" in str(sl.plan(SCENES["periodic"], SUN, 0.01, fast))


def test_a_coarse_map_of_the_sky_is_looked_at_where_it_has_pixels():
    """One bright pixel among many is found wherever it stands, in a tenth of the looks that a function of directions takes."""
    for row, col in ((0, 0), (3, 17), (7, 31)):
        panorama = np.ones((16, 32))
        panorama[row, col] = 50
        image = sl.environment_map(panorama)
        light, sine = sources.looks(sl.Sky(image))
        assert 45 < light.max() <= 50 and light.shape == sine.shape and light.size < 0.1 * sources.looks(sl.Sky(lambda L: image(L)))[0].size
    assert sources.looks(sl.Sky(sl.environment_map(np.ones((1024, 2048)))))[0].shape == sources.PROFILE


def test_a_map_that_repeats_is_not_searched_farther_than_need_be(fast):
    """High relief, loose tolerance: a search radius; and the image with it is within tolerance."""
    scene = sl.Scene(20 * (1 + np.sin(2 * np.pi * X / SIZE * 8)), sides="periodic")
    made = sl.plan(scene, sl.Sky(), 0.03, fast)
    assert made.max_distance is not None and "farther away" in str(made)
    nodes = some_nodes(scene, 100)
    out = sl.render(scene, sl.Sky(), tolerance=0.03, backend=fast, quantity="irradiance")
    assert errors(out.image[nodes].astype(float), truth(scene, sl.Sky(), nodes)).rms < 0.03


# -- no more model than the scene needs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "source"), [
    *[(name, source) for name in ("flat", "ramp", "dome") for source in (sl.Sky(3.0), sl.Sky(sl.cie_overcast()), HIGH)], ("flat", PANEL), ("flat", WINDOW), ("ramp", SUN), ("flat", LOW),
], ids=named)  # fmt: skip
def test_what_nothing_hides_launches_no_kernel(fast, launched, name, source):
    """Flat, slanted and convex ground, and lamps that stand clear: closed forms, and right."""
    scene = SCENES[name]
    out = sl.render(scene, source, backend=fast, quantity="irradiance")
    assert launched == [] and out.plan.method == "unoccluded" and "none" in str(out.plan)
    nodes = some_nodes(scene, 40)
    exact = truth(scene, source, nodes) * (source.brightness if isinstance(source, sl.Sky) and not callable(source.brightness) else 1)
    assert errors(out.image[nodes].astype(float), exact).rms < 0.01
    sl.plan(scene, source, backend=fast)
    assert launched == []


def test_a_clear_lamp_over_gentle_ground_launches_nothing_that_looks_for_shadows(fast, launched, monkeypatch):
    """Every node looks at the lamp, so nothing can hide it; under a sky the same ground is swept."""
    scene = sl.Scene(20 + scenes.rough(SIZE, SIZE, 0.08, 6, 2.2))
    assert sl.render(scene, sl.Lamp((36, 36, -50), 4), tolerance=0.01, backend=fast).plan.method == "unoccluded"
    assert not set(launched) & {"slices", "horizon", "scan", "filled", "source"}
    choosing_takes(0.0, fast, monkeypatch)
    sl.render(sl.Scene(ROUGH), sl.Sky(), backend=fast)
    assert set(launched) <= {"pilot", "ground", "horizon", "scan", "filled", "luminance"} and "pilot" in launched


POLES = 60 + 0.02 * np.mgrid[:240, :240][0]
POLES[[60, 150, 40, 201], [60, 22, 170, 108]] -= 25.0  # thin, in a plain
HOLED = np.ones(POLES.shape, bool)
HOLED[50:64, 45:60] = HOLED[150:170, 23:40] = False  # beside two of them
MOUND = 80 - 30 * np.exp(-((np.mgrid[:240, :240] - np.array([60, 200])[:, None, None]) ** 2).sum(0) / 40)


@pytest.mark.parametrize(("scene", "lamp"), [
    (sl.Scene(POLES), sl.Lamp((150, 90, -100), 12)), (sl.Scene(POLES), sl.Lamp((-60, 130, -60), 5)), (sl.Scene(np.where(HOLED, POLES, np.nan), mask=HOLED), sl.Lamp((150, 90, -100), 12)), (sl.Scene(MOUND), sl.Lamp((-60, 130, -60), 5)),
], ids=["above", "aside", "holes", "mound"])  # fmt: skip
def test_shadows_are_sought_where_ground_looks_away(fast, scene, lamp):
    """Nearly every node that poles or a mound hide some of a lamp from is found from the normals, also beyond a hole, and few others."""
    solid = upright(solid_of(scene, lamp, 1.0, 1.0))
    fine, free = (sl.render(scene, lamp, method, backend=fast, quantity="irradiance", **more).image for method, more in (("horizon", {"azimuths": 64}), ("unoccluded", {})))
    dark, found = np.nan_to_num(free - fine) > 0.02 * np.nanmean(fine), np.zeros(fine.shape, bool)
    found[tuple(unoccluded.shaded(scene, np.array(solid.center), solid.radius, False))] = True
    assert dark.sum() > 100 and (dark & ~found).sum() <= 0.03 * dark.sum() and found.sum() < 4 * dark.sum() and scene.valid[found].all()


def test_shadows_are_not_sought_in_vain():
    """None on slanted or convex ground, and no answer where they are everywhere."""
    shaded = lambda depth, convex=False: unoccluded.shaded(sl.Scene(depth), np.array([40.0, 30.0, 60.0]), 6.0, convex)
    assert shaded(0.2 * Y + 9).size == 0 == shaded(0.05 * AWAY**2, True).size
    assert shaded(3 * ROUGH) is None


def test_few_shadows_are_left_out_where_the_tolerance_allows_it(fast, launched):
    """Thin shadows, which hardly any pilot meets, have pilots of their own: all nodes are within tolerance, and swept where they would not be."""
    scene, lamp = sl.Scene(POLES), sl.Lamp((150, 90, -100), 12)
    assert sl.plan(scene, lamp, 0.003, fast).method == "horizon"
    fine = sl.render(scene, lamp, azimuths=64, backend=fast, quantity="irradiance").image
    launched.clear()
    out = sl.render(scene, lamp, tolerance=0.1, tail=2.0, backend=fast, quantity="irradiance")
    assert sl.plan(scene, lamp, 0.1, fast, tail=0.5).method == "horizon", "more than a thousandth of the nodes is dark"
    assert out.plan.method == "unoccluded" and set(launched) == {"pilot"} and out.plan.choices[0].taken == "left out"
    error = np.sqrt(np.mean((out.image - fine) ** 2)) / fine.mean()
    assert 0.02 < error < 0.1 and out.plan.error == pytest.approx(error, rel=0.4) and out.plan.measured == pytest.approx(out.plan.error)
    kept = Pilots.of(scene, 192, rare=True)
    assert "heights" not in vars(kept) and not kept._on


def test_a_spotlight_over_holes_has_a_closed_form(fast):
    """Its brightness is asked in no direction from what is not there."""
    spot = sl.Lamp((36, 30, -60), 4, brightness=sl.cosine_power(6))
    whole, holed = (sl.render(scene, spot, "unoccluded", backend=fast, quantity="irradiance").image for scene in (sl.Scene(0.1 * X + 20), sl.Scene(np.where(HOLES, 0.1 * X + 20, np.nan), mask=HOLES)))
    np.testing.assert_allclose(holed[HOLES], whole[HOLES], rtol=1e-4)
    assert np.isnan(holed[~HOLES]).all()


def test_a_spike_on_a_plain_is_not_overlooked(fast):
    """Ground that is flat but for one tall node in each quarter is not taken for flat under a lamp at its side."""
    depth = np.full((SIZE, SIZE), 30.0)
    depth[18::36, 18::36] = 0
    assert sl.plan(sl.Scene(depth), sl.Lamp((-40, 36, 5), 3), backend=fast).method == "horizon"


def test_a_trench_in_a_plain_is_not_overlooked(fast):
    """Under a sky, where few pilots or none lie in it; gentle ground of the same extent launches nothing."""
    y, x = np.mgrid[:600, :600].astype(float)
    trench = sl.Scene(np.where(np.abs(x - 300) < 4, 25.0, 0.0) + 0.01 * y)
    out = sl.render(trench, sl.Sky(), tolerance=0.03, backend=fast, quantity="irradiance")
    assert out.plan.method == "horizon"
    nodes = np.full(200, 300), np.arange(200, 400)  # across it
    wrong = out.image[nodes] - truth(trench, sl.Sky(), nodes)
    assert np.sqrt(np.sum(wrong**2) / 600) < 0.03 * np.pi, "nothing is hidden farther away"


def test_holes_are_no_cliffs():
    """Steps to masked nodes do not count."""
    assert Pilots(SCENES["rough"]).steep == Pilots(SCENES["holes"]).steep == 0 < Pilots(SCENES["houses"]).steep


def test_pilots_look_closer_where_ground_is_rare():
    """Nodes are added where a few blocks have most of the relief, none that is masked, below a cliff between two blocks too; weighted, they tell the features' shares."""
    y, x = np.mgrid[:600, :600]
    holes = (x + y) % 3 > 0
    for lower, mask in ((np.abs(x - 300) < 4, None), (x >= 256, None), (np.hypot(x - 200, y - 300) < 25, None), (np.abs(x - 300) < 4, holes)):
        pilots = Pilots(sl.Scene(np.where(lower, 25.0, 0.0), mask=mask), rare=True)
        assert len(pilots) > 320 and pilots.weights.sum() == pytest.approx(1)
        assert mask is None or mask[pilots.y, pilots.x].all()
        there = lower[pilots.y, pilots.x]
        assert there.sum() >= 8 and pilots.weights[there].sum() == pytest.approx(lower.mean(), rel=0.5)
    beside = Pilots(sl.Scene(np.where(x >= 256, 25.0, 0.0)), rare=True)
    assert ((beside.x >= 256) & (beside.x < 288)).sum() > 30
    for depth in (scenes.rough(600, 600, 1.0, 4), 0.3 * y, np.hypot(x, y), np.where((x % 30 == 0) & (y % 30 == 0), 9.0, 0.0)):
        assert Pilots(sl.Scene(depth), rare=True).weights is None, "what is everywhere is met often enough"


def test_a_bowl_in_a_plain_needs_no_sweep(fast, launched, monkeypatch):
    """It hides what the tolerance allows, which few pilots would not know: closed forms, and within tolerance over all of the map."""
    choosing_takes(0.0, fast, monkeypatch)  # where it takes longer than a sweep, as on a GPU, it is not done
    y, x = np.mgrid[:1024, :1024]
    scene = sl.Scene(40 - np.minimum(40, 0.012 * np.hypot(x - 512, y - 512) ** 2))
    out = sl.render(scene, sl.Sky(), tolerance=0.03, backend=fast, quantity="irradiance")
    assert out.plan.method == "unoccluded" and set(launched) == {"pilot"}
    fine = sl.render(scene, sl.Sky(), azimuths=64, backend=fast, quantity="irradiance").image
    error = np.sqrt(np.mean((out.image - fine) ** 2)) / fine.mean()
    assert 0.01 < error < 0.03 and out.plan.error == pytest.approx(error, rel=0.2)
    assert sl.plan(scene, sl.Sky(), 0.01, fast).method == "horizon"


def test_weights_by_hand():
    """Ten nodes in forty that stand for two thousandths of the map, of whose error five make the last thousandth; weights are shares whatever their sum."""
    weights, off = (np.repeat(pair, (30, 10)) for pair in ((0.998 / 30, 0.0002), (0.01, 0.4)))
    found = errors(1 + off, np.ones(40), weights)
    assert found.rms == pytest.approx(np.sqrt(0.998 * 0.01**2 + 0.002 * 0.4**2)) and found.tail == pytest.approx(0.4)
    assert errors(1 + off, np.ones(40), 8 * weights) == found
    assert errors(1 + off, np.ones(40)).rms == pytest.approx(np.sqrt(0.75 * 0.01**2 + 0.25 * 0.4**2))


def test_unoccluded_closed_forms(fast):
    """Asked for by name: a tilted plane's view factor, Lambert's polygon, and balls that the tangent plane cuts."""
    tilted = sl.render(SCENES["ramp"], sl.Sky(2.0), "unoccluded", quantity="irradiance", backend=fast).image
    np.testing.assert_allclose(tilted, np.pi * (1 + 1 / np.sqrt(1.45)), rtol=1e-5)
    by_table = sl.render(SCENES["ramp"], sl.Sky(sl.uniform(2.0)), "unoccluded", quantity="irradiance", backend=fast).image
    np.testing.assert_allclose(by_table, tilted, rtol=3e-3)
    window = sl.render(SCENES["flat"], WINDOW, "unoccluded", quantity="irradiance", backend=fast).image
    corners = np.stack([np.stack([u - X, v - Y, np.full(X.shape, -5.0)], -1) for u, v in ((20.3, 12), (45.1, 12), (45.1, 50.7), (20.3, 50.7))], -2)
    np.testing.assert_allclose(window, -polygon_moment(corners)[..., 2], rtol=2e-3, atol=1e-4)
    pilots = Pilots(SCENES["rough"], 200)
    ball = Ball((40.0, 30.0, 10.0), 8.0)
    found = unoccluded.lamp(pilots.gx, pilots.gy, pilots.x, pilots.y, pilots.own.astype(float), ball, 1.0)
    wanted = pilots.through_slices(select(fast), ball, 1.0, 512, occluded=False)
    cut = np.abs(found - np.pi * 64 / ((pilots.x - 40) ** 2 + (pilots.y - 30) ** 2 + (pilots.own - 10.0) ** 2)) > 1e-6
    np.testing.assert_allclose(found, wanted, atol=2e-3 * wanted.max())
    assert cut.any() and rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0)).corners.shape == (4, 3)


# -- what is beyond the model ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scene", "source", "says"), [
    (sl.Scene(ROUGH, albedo=0.8), sl.Sky(), "Light between surfaces is left out: at most"), (SCENES["rough"], sl.Lamp((36, 36, float(ROUGH[36, 36]) - 1.5), 1.2), "The lamp touches the surface"),
    (SCENES["flat"], sl.Lamp((30, 40, -20), 24.5), "The lamp touches the surface: it ends 0.5 spacings"),
    (SCENES["houses"], sl.Sky(), "Slopes are steeper than the grid holds"), (SCENES["holes"], sl.Sky(), "Nodata"), (sl.Scene(ROUGH + 3e5), sl.Sky(), "Depths are rounded by"),
], ids=["between surfaces", "touching lamp", "large lamp", "cliffs", "holes", "rounding"])  # fmt: skip
def test_what_a_scene_needs_beyond_the_model(fast, scene, source, says):
    """Each is said with a number, and not of a scene that lacks it."""
    found = [text for text in sl.plan(scene, source, backend=fast).beyond if text.startswith(says)]
    assert len(found) == 1 and any(c.isdigit() for c in found[0]), found
    assert sl.plan(SCENES["flat"], sl.Sky(), backend=fast).beyond == ()
    assert not any(text.startswith("Light between") for text in sl.plan(sl.Scene(ROUGH, albedo=0.0), sl.Sky(), backend=fast).beyond)


def test_the_light_between_surfaces_bounds_what_a_bowl_adds(fast):
    """In a bowl of rim angle a every point sees sky by (1 + cos a) / 2, and all bounces add E rho (1 - f) / (1 - rho (1 - f)) exactly."""
    radius, rim = 150.0, np.radians(50)
    size = 2 * int(radius * np.sin(rim)) + 9
    y, x = np.mgrid[:size, :size] - size // 2
    depth = np.maximum(0, np.sqrt(np.maximum(0, radius**2 - x**2 - y**2)) - radius * np.cos(rim))
    rho, sky = 0.6, (1 + np.cos(rim)) / 2
    text = next(t for t in sl.plan(sl.Scene(depth, albedo=rho), sl.Sky(), backend=fast).beyond if t.startswith("Light"))
    bound = float(text.split("at most ")[1].split(" %")[0]) / 100
    exact = rho * (1 - sky) / (1 - rho * (1 - sky))
    assert 0.8 * exact < bound < 2.5 * exact, (bound, exact)  # the flat corners see more, the rim's slopes less


def test_what_the_lattice_must_do_is_planned_too(fast):
    """A window as an aperture, a window over a map that repeats, a lamp as a volume: hemicubes, measured where there is a reference."""
    aperture = np.zeros((SIZE, SIZE), bool)
    aperture[10:50, 20:60] = True
    made = sl.plan(SCENES["rough"], sl.Window(aperture=aperture), 0.05, fast)
    assert made.method == "lattice" and made.filled and made.hemicube > 5 and made.error < 0.05 and "aperture" in str(made)
    assert sl.plan(SCENES["periodic"], WINDOW, 0.1, fast).method == "lattice"
    volume = np.zeros((2, SIZE, SIZE), bool)
    volume[0, 20:50, 20:50] = True
    unknown = sl.plan(sl.Scene(ROUGH + 5), sl.Lamp(volume=volume), 0.01, fast)
    assert unknown.method == "lattice" and unknown.error is None and "was not measured" in str(unknown)


@pytest.mark.parametrize(("call", "says"), [
    (lambda: sl.plan(SCENES["flat"], sl.Sky(), 0), "tolerance"), (lambda: sl.plan(SCENES["flat"], sl.Sky(), "x"), "tolerance"), (lambda: sl.plan(SCENES["flat"], sl.Sky(), tail=-1), "tail"),
    (lambda: sl.plan(np.ones((3, 3)), sl.Sky()), "skylamp.Scene"), (lambda: sl.plan(SCENES["flat"], 3.0), "Sky, Lamp or Window"), (lambda: sl.render(SCENES["flat"], sl.Sky(), "horizon", tail=0.1), "tail"),
    (lambda: sl.render(SCENES["flat"], sl.Sky(), "unoccluded", azimuths=3), "unoccluded"), (lambda: sl.render(SCENES["periodic"], HIGH, tolerance=0.01), "periodic"),
    (lambda: sl.plan(SCENES["rough"], sl.Lamp((36, 36, 500), 2)), "below the surface"),
])  # fmt: skip
def test_bad_input_is_named(call, says):
    with pytest.raises(sl.InputError, match=says):
        call()


# -- costs -----------------------------------------------------------------------------------------------------------------------


def test_costs_are_measured_once_and_kept(fast, monkeypatch, tmp_path):
    """A file in the user's cache; a broken one, one of another make, or one that cannot be written: measured anew."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    counted = []
    monkeypatch.setattr(costs, "_cost", lambda engine, method, *units: counted.append(method) or costs.Cost(1e-3, 1e-8, 1e-9))
    ask = lambda: (monkeypatch.setattr(costs, "known", {}), costs.Costs(select(fast))["horizon"])[1]
    assert ask() == costs.Cost(1e-3, 1e-8, 1e-9) == ask() and counted == ["horizon"]
    kept = json.loads(costs.path().read_text())
    assert list(kept.values()) == [{"horizon": [1e-3, 1e-8, 1e-9]}] and select(fast).name in next(iter(kept))
    for broken in ("{", "[1]", '{"a": {"horizon": [1]}}', json.dumps({k: {"horizon": [1, -1, 2]} for k in kept}), json.dumps({k: {"other": [1, 1, 2]} for k in kept})):
        counted.clear()
        costs.path().write_text(broken)
        ask()
        assert counted == ["horizon"], broken
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" / "below"))
    (tmp_path / "file").write_text("no folder")
    counted.clear()
    assert ask().fixed == 1e-3 and counted == ["horizon"]


@pytest.mark.parametrize(("fixed", "each", "unit", "sizes"), [(1e-3, 1e-9, 1e-11, {24, 224, 1024}), (1e-3, 1e-7, 1e-8, {24, 224}), (0.02, 1e-6, 1e-7, {24, 40})])
def test_costs_are_measured_on_maps_that_take_some_time(monkeypatch, fixed, each, unit, sizes):
    """Found again from the seconds that they would give; the largest map where all others are done at once, a small one where they take long."""
    asked = set()
    monkeypatch.setattr(costs, "_seconds", lambda engine, method, size, units: asked.add(size) or fixed + size**2 * (each + unit * units))
    np.testing.assert_allclose(costs._cost(None, "horizon", *costs.UNITS["horizon"]), (fixed, each, unit), rtol=1e-6)
    assert asked == sizes


def test_choosing_is_timed_on_scenes_that_are_new(fast, launched):
    costs._seconds(select(fast), "plan", 24, 1)
    assert launched.count("pilot") >= costs.RUNS + 1


def test_costs_grow_with_the_work(fast):
    """Measured on this machine: positive, and more for more."""
    cost = costs.Costs(select(fast))["horizon"]
    assert min(cost) >= 0 and cost.seconds(1e6, 64) > cost.seconds(1e5, 16) > 0


# -- command line and chart --------------------------------------------------------------------------------------------------------


def test_the_command_line_prints_plans(fast, tmp_path):
    """A table with reasons, or one JSON object; the tolerance as a share or in percent; a bad one is a usage error."""
    from typer.testing import CliRunner

    from skylamp.cli import app

    np.save(tmp_path / "depth.npy", ROUGH)
    ask = lambda *more: CliRunner().invoke(app, ["plan", str(tmp_path / "depth.npy"), "--backend", fast, *more])
    percent, share = (json.loads(ask("--json", "--tolerance", text).stdout) for text in ("0.4%", "0.004"))
    assert percent["tolerance"] == share["tolerance"] == pytest.approx(0.004) and percent["azimuths"] == share["azimuths"] > 8
    text = ask("--tolerance", "1%").stdout
    assert "azimuths" in text and "within 1%" in text and "Beyond the model" in text
    assert ask("--tolerance", "much").exit_code == 2


def test_the_chart_has_a_point_for_every_setting(fast, tmp_path):
    """All classes, the plan's three choices, a picture; the frontier is what nothing beats."""
    from skylamp import chart

    rows = chart.measure([fast], (24,), longest=0.5)
    assert {row["class"] for row in rows} == set(chart.CLASSES) and all(row["seconds"] > 0 and row["error"] >= 0 for row in rows)
    for kind in chart.CLASSES:
        here = [row for row in rows if row["class"] == kind]
        assert [row["units"] for row in here if row["method"] == "plan"] == list(chart.TOLERANCES)
        assert {row["method"] for row in here} >= ({"slices", "unoccluded"} if kind == "lamp" else {"horizon", "filled", "stride", "unoccluded"})
    chart.draw(rows, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 20_000
    row = lambda method, units, error, seconds, again: {"class": "smooth", "size": 9, "method": method, "units": units, "error": error, "seconds": seconds, "again": again}
    some = [row("plan", 0.03, 0.01, 6, 3), row("filled", 5, 0.02, 2, 2), row("horizon", 8, 0.01, 4, 4), row("horizon", 64, 0.001, 9, 9), {**row("horizon", 4, 0.001, 1, 1), "size": 8}]
    assert chart.behind(some)["smooth"][0] == 3 and chart.behind(some, "again")["smooth"][0] == 1.5 and chart.behind(some, "again", True)["smooth"][0] == 0.75
    assert chart.frontier([(1, 5), (2, 6), (3, 1), (2.5, 2)]) == [(1, 5), (2.5, 2), (3, 1)]
    with pytest.raises(sl.InputError, match="sizes"):
        chart.measure([fast], (4,))
