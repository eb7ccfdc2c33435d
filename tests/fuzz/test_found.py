"""Cases that a campaign found (performance/campaign.py), one for every defect."""

import numpy as np
import pytest
from fuzz import relations
from fuzz.cases import Ground
from fuzz.odd import Odd

import skylamp as sl
from skylamp.backends.registry import select
from skylamp.light import propagation
from skylamp.sources import geometry


def odd(ground, call="render", **more):
    known = {"dtype": "float64", "spoilt": None, "source": "panel", "brightness": "number", "albedo": 0.0}
    return Odd(**{"ground": ground, "call": call, "how": {}, "seed": 13, "size": 1.0, **known, **more})


def ground(kind, rows, cols, relief, offset=0.0, spacing=1.0, mask="none", sides="open", seed=2581):
    return Ground(rows, cols, kind, seed, relief, offset, spacing, mask, sides, 0.8)


FOUND = {
    "light of a lamp that rounds to less than 0": odd(
        ground("rough", 3, 24, 1.92e6, offset=1e7, spacing=1120.0, mask="border", seed=612706),
        source="ball",
        albedo=0.8,
        seed=28,
        size=0.000793,
    ),
    "an error that is not bounded, of ground of albedo 0": odd(ground("spikes", 3, 3, 1150.0, offset=1e7)),
    "parts of an irradiance over coloured ground": odd(
        ground("flat", 9, 9, 1.0), albedo="colour", how={"quantity": "irradiance", "parts": True}
    ),
    "an edge that rounding at the corner removes": odd(
        ground("noise", 2, 4, 5.0, offset=1.0), brightness="zero", how={"tolerance": 0.05}, size=2e-24
    ),
    "only nodes without weight are lit": odd(
        ground("rough", 6, 6, 2.13e6, 1e7, 4.68e-8, "none", "dark", seed=97),
        dtype="float16",
        source="sun",
        how={"quantity": "irradiance", "parts": True},
        seed=64,
    ),
    "a search over more rows than 32 bits count": odd(
        ground("rough", 9, 16, 1.37e8, 1.0, 1.0, "islands", "periodic"), call="horizons"
    ),
    "three columns and three colours": odd(
        ground("spikes", 3, 3, 1.0, 1.0, 0.0128, "one node", "dark"), albedo="colour", how={"hemicube": 3}
    ),
    "an error that is not bounded, of a black source": odd(
        ground("spikes", 5, 9, 7.48e8, mask="full", seed=3350319),
        source="aperture",
        brightness="zero",
        albedo=0.8,
        how={"interreflection": True, "tolerance": 0.05},
        seed=580407678,
        size=0.0083,
    ),
    "a panel whose squares leave float32": odd(
        ground("steps", 23, 2, 5.0, 1e7, sides="dark"), how={"method": "unoccluded"}, size=7.48e12
    ),
}


@pytest.mark.parametrize("name", FOUND)
def test_what_a_campaign_found_stays_mended(fast, name):
    """Each raised, or gave nan or negative light, before."""
    relations.RELATIONS["nothing breaks"].check(FOUND[name], fast)


@pytest.mark.parametrize("how", [{"azimuths": 64}, {"method": "unoccluded"}])
def test_a_window_as_wide_as_it_is_far_is_as_bright_at_any_distance(backend, how):
    """E = 2 sqrt(2) arctan(1 / sqrt(2)) below a square of half its side; products of areas left float32."""
    far = 1e13
    window = sl.Window((-far, far), (-far, far))
    out = sl.render(sl.Scene(np.full((3, 4), far)), window, quantity="irradiance", backend=backend, **how)
    assert out.image == pytest.approx(2**1.5 * np.arctan(0.5**0.5), rel=1e-3)


def test_no_light_of_a_uniform_sky_is_negative(backend):
    """In a shaft so deep that rounding is more than its light."""
    scene = sl.Scene(1e7 + np.random.default_rng(1).random((11, 11)), sides="dark")
    image = sl.render(scene, sl.Sky(), azimuths=1, quantity="irradiance", backend=backend).image
    assert 0 <= image.min() and image.max() < 1e-6


def test_a_search_that_takes_too_long_is_refused(fast, monkeypatch):
    """On NumPy it took minutes: of a relief of 20 spacings, 2,000 rows in each of four azimuths."""
    scene = sl.Scene(20 * np.random.default_rng(1).random((8, 8)), sides="periodic")
    engine = select(fast)
    monkeypatch.setattr(engine, "most_searched_rows", 4 * 2500, raising=False)
    sl.horizons(scene, azimuths=8, backend=fast)
    monkeypatch.setattr(engine, "most_searched_rows", 4 * 1500, raising=False)
    with pytest.raises(sl.CapacityError, match="rows in 4 azimuths"):
        sl.horizons(scene, azimuths=8, backend=fast)


def test_a_lamp_straight_above_is_found_in_one_step(backend):
    """In a box 1e12 spacings deep, where kernels took one step per layer up to the lamp."""
    cube = sl.Hemicube(3)
    scene, lamp = sl.Scene(np.full((3, 4), 1e12), sides="dark"), sl.Lamp((1, 1, -30), 10.0)
    bits = cube.unpack(sl.visibility(scene, lamp, cube, backend=backend))
    assert (bits == (cube.steps[:, :2] == 0).all(1)).all()


def test_searches_of_a_plan_are_bounded_before_they_start(fast, monkeypatch):
    """On NumPy a plan over high relief took minutes; an image that was refined ended with an error."""
    scene = sl.Scene(20 * np.random.default_rng(1).random((16, 16)), sides="periodic")
    sky, engine = sl.Sky(sl.cosine_power(4.0)), select(fast)
    monkeypatch.setattr(engine, "most_searched_rows", 40 * 2000, raising=False)
    result = sl.render(scene, sky, tolerance=1e-3, interreflection=False, backend=fast)
    assert [step.units for step in result.plan.steps] == [48]
    assert result.warnings[0].startswith("Tolerance")
    monkeypatch.setattr(engine, "most_searched_rows", 20 * 2000, raising=False)
    with pytest.raises(sl.CapacityError, match="must be followed over 4e[+]03 nodes"):
        sl.plan(scene, sky, backend=fast)


def test_a_small_lamp_far_above_is_met_by_the_rays_that_pass_it(backend):
    """From 2^30 spacings below, where the discriminant had lost all digits of the radius."""
    cube, far = sl.Hemicube(3), 2.0**30
    lamp = sl.Lamp((far + 30, 1, -30), 1.5)
    bits = cube.unpack(sl.visibility(sl.Scene(np.full((3, 4), far)), lamp, cube, backend=backend))
    y, x = np.mgrid[:3, :4]
    squares = (y - 1) ** 2 + x**2 / 2  # of distances from the centre to the rays along (1, 0, -1)
    towards = (cube.steps == (1, 0, -1)).all(1)
    assert (bits[..., towards] == (squares <= 1.5**2)[..., None]).all()
    assert not bits[..., ~towards].any()


@pytest.mark.parametrize("filled", [False, True])
def test_scans_over_a_relief_that_takes_too_long_are_refused(fast, monkeypatch, filled):
    """On NumPy a relief of 1e9 spacings took minutes."""
    ground = np.random.default_rng(1).random((23, 29))
    monkeypatch.setattr(select(fast), "most_searched_rows", 1000, raising=False)
    sl.visibility(sl.Scene(ground, sides="periodic"), sl.Sky(), 9, fast, filled=filled)
    with pytest.raises(sl.CapacityError, match="rows in 209 directions"):
        sl.visibility(sl.Scene(1e9 * ground, sides="periodic"), sl.Sky(), 9, fast, filled=filled)


def test_rays_to_a_lamp_that_take_too_many_steps_are_refused(fast, monkeypatch):
    """On NumPy the rays to a volume 6e4 layers above, and the field of a ball over 3e4 layers, took hours."""
    monkeypatch.setattr(select(fast), "most_searched_rows", 2**19, raising=False)
    ground = np.random.default_rng(1).random((16, 16))
    volume = np.zeros((3, 16, 16), bool)
    volume[0, 5:8, 5:8] = True
    with pytest.raises(sl.CapacityError, match="in 209 directions up to 5.99e[+]04 spacings"):
        deep = sl.Scene(6e4 * ground, sides="periodic")
        sl.visibility(deep, sl.Lamp(volume=volume), 9, fast)
    with pytest.raises(sl.CapacityError, match="layers, take some"):
        sl.visibility_field(sl.Scene(3e4 * ground), sl.Lamp((8, 8, -5), 2.0), 9, backend=fast)
    sl.visibility_field(sl.Scene(3 * ground), sl.Lamp((8, 8, -5), 2.0), 9, backend=fast)
    steps, ball = sl.Hemicube(9).steps, geometry(sl.Lamp((8, 8, -5), 2.0), sl.Scene(ground), 1.0)
    usual = propagation.Problem(np.zeros((256, 256), np.float32), 1.0, "open", steps, ball)
    propagation._check_rays(select(fast), usual, 200.0, 200, "field")  # is not refused


def test_a_window_on_a_single_node_is_not_called_small(fast):
    """The farthest ground lay at distance 0, by which its radius was divided."""
    with np.errstate(all="raise"):
        result = sl.render(
            sl.Scene([[0.0]]), sl.Window(aperture=np.ones((1, 1), bool)), hemicube=3, backend=fast
        )
    assert not any(text.startswith("Small") for text in result.warnings)


@pytest.mark.slow
def test_an_image_far_darker_than_its_source_is_answered(fast):
    """By 27 decades: the square of what the model leaves was infinite."""
    image = np.random.default_rng(1).uniform(0, 15, (6, 10)).astype(np.float32)
    source = sl.Sky(lambda towards: 1e28 * (1 - towards[..., 2]))
    with np.errstate(all="raise", under="ignore"):
        assert np.isfinite(sl.recover(image, source, 0.5, layers=8, backend=fast).std).all()
