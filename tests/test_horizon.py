"""sl.horizons, sl.sky_view_factor, sl.openness and render(method="horizon"): what a user touches."""

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
from skylamp import oracle


def spike(rows=31, cols=31, height=5.0, spacing=1.0, **more):
    """Level ground at depth 10 with one node that stands out."""
    depth = np.full((rows, cols), 10.0)
    depth[rows // 2, cols // 2] -= height
    return sl.Scene(depth * spacing, spacing, **more)


def test_horizons_beyond_the_memory(fast, monkeypatch):
    """They are refused before they are allocated, by their bytes; lazy ones are not."""
    monkeypatch.setattr("skylamp.horizon.LARGE", 0)
    monkeypatch.setattr("skylamp.horizon.available_memory", lambda: 8 * 4 * 12 * 13)
    scene = sl.Scene(np.zeros((12, 13)))
    assert sl.horizons(scene, 8, fast).shape == (8, 12, 13)
    with pytest.raises(sl.CapacityError, match="take 5,616 bytes; 4,992 are free"):
        sl.horizons(scene, 9, fast)


@pytest.mark.slow
def test_exact_in_near_rows_and_never_too_high_beyond(backend):
    """Up to 12 spacings slopes are the oracle's; beyond, none is above it, and few are far below."""
    rng = np.random.default_rng(1)
    towers = 2 * rng.random((90, 100))
    for row, col, height in zip(rng.integers(0, 88, 9), rng.integers(0, 98, 9), rng.uniform(20, 300, 9)):
        towers[row : row + 2, col : col + 2] += height
    nodes = rng.integers(0, 90, 200), rng.integers(0, 100, 200)
    for heights, rms in ((3 * rng.random((90, 100)), 0.004), (towers, 0.06)):
        heights = heights.astype(np.float32)
        for reach in (12.0, None):
            angles = sl.Azimuths(16).angles
            true = oracle.horizons(heights.max() - heights.astype(float), 1.0, angles, "open", reach, nodes)
            scene = sl.Scene.from_height(heights)
            found = sl.horizons(scene, 16, backend, max_distance=reach)[:, nodes[0], nodes[1]]
            assert np.array_equal(np.isfinite(found), np.isfinite(true))
            error = np.arctan(found) - np.arctan(true)  # of -inf too
            assert np.isfinite(error).all()
            assert error.max() < 3e-5
            assert error.min() > -3e-5 if reach else rms / 30 < np.sqrt((error**2).mean()) < rms


@pytest.mark.parametrize("spacing", [1.0, 30.0])
def test_a_spike_is_seen_where_it_stands(backend, spacing):
    """Along the axes, at its slope, from both sides, whatever the unit; azimuth grows from +x towards +y."""
    slopes = sl.horizons(
        spike(spacing=spacing),
        sl.Azimuths(4, (-np.pi / 4, np.pi / 4, 3 * np.pi / 4, 5 * np.pi / 4, 7 * np.pi / 4)),
        backend,
    )
    assert slopes.shape == (4, 31, 31) and slopes.dtype == np.float32
    for azimuth, (dx, dy) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        for distance in (1, 4, 9, 14):
            assert slopes[azimuth, 15 - dy * distance, 15 - dx * distance] == pytest.approx(
                5 / distance, rel=1e-6
            )
            assert slopes[azimuth, 15 + dy * distance, 15 + dx * distance] <= 0


@pytest.mark.slow
def test_max_distance_ends_what_counts(backend):
    east = sl.Azimuths(1, (-np.pi, np.pi))
    for reach, seen in ((8.0, False), (8.99, False), (9.0, True), (30.0, True)):
        slope = sl.horizons(spike(), east, backend, max_distance=reach)[0, 15, 6]
        assert slope == pytest.approx(5 / 9 if seen else 0, abs=1e-6), reach


def test_masked_nodes_have_no_horizon_and_make_none(backend):
    mask = np.ones((31, 31), bool)
    mask[15, 15] = False
    slopes = sl.horizons(spike(mask=mask), 8, backend)
    assert np.isnan(slopes[:, 15, 15]).all() and np.isfinite(slopes).sum() > 0
    assert np.nanmax(slopes) <= 0


def test_no_ground_is_minus_infinity(backend):
    slopes = sl.horizons(sl.Scene(np.ones((5, 7))), 4, backend)
    assert (
        np.isneginf(slopes[0][:, -1]).all() and np.isneginf(slopes[1][-1]).all()
    )  # azimuths pi/4 and 3 pi/4
    assert (slopes[0][:-1, :-1] == 0).all()


@pytest.mark.slow
def test_sky_view_factor_by_its_definitions(fast):
    """In a trench of known shape, in its middle: closed forms of all three."""
    half, deep = 20, 15
    depth = np.zeros((24, 24 * half + 1))
    middle = depth.shape[1] // 2
    depth[:, middle - half + 1 : middle + half] = deep
    scene = sl.Scene(np.tile(depth, (1, 1)), sides="periodic")
    azimuth = np.linspace(0, 2 * np.pi, 100001)[:-1]
    elevation = np.arctan(deep / half * np.abs(np.cos(azimuth)))
    row = 12
    for definition, expected in (
        ("tilted", half / np.hypot(half, deep)),
        ("horizontal", half / np.hypot(half, deep)),
        ("solid_angle", 1 - np.sin(elevation).mean()),
    ):
        got = sl.sky_view_factor(scene, definition, 128, fast)[row, middle]
        assert got == pytest.approx(expected, rel=2e-3), definition
    assert sl.sky_view_factor(sl.Scene(np.zeros((6, 6))), "solid_angle", 16, fast) == pytest.approx(1)


def test_tilted_and_horizontal_differ_on_a_slope(backend):
    """45 degrees, at the upper border: a level element sees all, the surface itself looks away."""
    y, x = np.mgrid[:40, :40]
    scene = sl.Scene(100 - x * 1.0)
    tilted, level = (
        sl.sky_view_factor(scene, definition, 64, backend)[20] for definition in ("tilted", "horizontal")
    )
    assert tilted == pytest.approx((1 + np.cos(np.pi / 4)) / 2, rel=2e-3)
    assert level[-1] == pytest.approx(1) and level[2] == pytest.approx(tilted[2], rel=2e-3)


def test_horizons_below_the_level(backend):
    """Around a summit most ground lies below: horizons are close to the oracle's, never above them."""
    y, x = np.mgrid[:61, :61] - 30.0
    far = np.hypot(x, y)
    cliff = 40 - 0.2 * np.minimum(far, 13) - 2.0 * np.maximum(0, far - 13)
    azimuths = sl.Azimuths(16)
    for height in (cliff, cliff - scenes.rough(61, 61, 0.1, 5)):
        expected = oracle.horizons(-height, 1.0, azimuths.angles)
        found = sl.horizons(sl.Scene.from_height(height), azimuths, backend)
        below = np.isfinite(expected) & (expected < 0)
        assert below.mean() > 0.4
        wrong = np.arctan(found[below]) - np.arctan(expected[below])
        assert wrong.max() < 1e-5 and np.sqrt(np.mean(wrong**2)) < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("sides, reach", [("open", None), ("open", 17.0), ("dark", None), ("periodic", None)])
def test_openness_is_the_mean_angle_to_the_horizons(backend, sides, reach):
    """Of horizons above the level and below it, at masked nodes and where no ground is to be seen."""
    depth = scenes.rough(30, 41, 0.3, 2)
    mask = np.random.default_rng(1).random(depth.shape) > 0.1
    azimuths = sl.Azimuths(6, (0.0, 1.0, 1.5, 3.0, 3.7, 4.6, 2 * np.pi))
    scene = sl.Scene(depth, 2.0, mask=mask, sides=sides)
    how: dict = dict(backend=backend, max_distance=reach and reach * 2)
    slopes = sl.horizons(scene, azimuths, **how)
    if sides == "open":
        assert (slopes[:, mask] < 0).any() and np.isneginf(slopes).any()
    angles = np.pi / 2 - np.arctan(np.where(np.isneginf(slopes), 0, slopes))
    expected = np.tensordot(azimuths.widths, angles, 1) / (2 * np.pi)
    np.testing.assert_allclose(sl.openness(scene, azimuths, **how), expected, rtol=0, atol=3e-6)


def test_openness_of_planes_and_pits(fast):
    """Level: pi / 2. In the middle of a pit: up to its rim. Negative: that of the surface upside down."""
    assert sl.openness(sl.Scene(np.zeros((9, 9))), 16, fast) == pytest.approx(np.pi / 2)
    y, x = np.mgrid[:81, :81] - 40.0
    pit = np.maximum(0, 15 - 0.5 * np.maximum(0, np.hypot(x, y) - 6))
    assert sl.openness(sl.Scene(pit), 32, fast)[40, 40] == pytest.approx(
        np.pi / 2 - np.arctan(15 / 36), abs=2e-3
    )
    negative = sl.openness(sl.Scene(pit), 32, fast, negative=True)
    assert negative == pytest.approx(sl.openness(sl.Scene(15 - pit), 32, fast), abs=1e-5)
    assert abs(negative - sl.openness(sl.Scene(pit), 32, fast)).max() > 0.1


def test_render_agrees_with_the_oracle_on_brightness(fast):
    """A sky that varies with azimuth and elevation, on rough ground, against quadrature in float64."""
    depth = scenes.rough(48, 56, 1.0)
    brightness = lambda L: 1 + 0.8 * L[..., 0] + 0.5 * L[..., 2] ** 2
    image = sl.render(
        sl.Scene(depth), sl.Sky(brightness), "horizon", azimuths=48, backend=fast, quantity="irradiance"
    ).image
    sectors = sl.Azimuths(48)
    nodes = tuple(np.random.default_rng(0).integers(0, n, 200) for n in depth.shape)
    horizon = oracle.horizons(depth, 1.0, sectors.angles, nodes=nodes)
    expected = oracle.sky_irradiance(
        depth, 1.0, np.ones(depth.shape, bool), sectors.angles, sectors.widths, horizon, brightness, nodes
    )
    off = image[nodes] - expected
    assert np.sqrt((off**2).mean()) < 2e-3 * expected.mean() and abs(off).max() < 0.03 * expected.mean()


def test_every_brightness_on_level_ground(backend):
    """Closed forms: uniform pi B, overcast 7/9 pi, sine of elevation 2/3 pi; a small sun."""
    level = sl.Scene(np.full((9, 9), 3.0))
    sun = np.array([0.48, -0.36, -0.8])
    cap = np.cos(np.radians(3))
    for brightness, expected in (
        (2.5, 2.5 * np.pi),
        (sl.cie_overcast(), 7 / 9 * np.pi),
        (lambda L: -L[..., 2], 2 / 3 * np.pi),
        (lambda L: 1000.0 * (L @ sun > cap), 1000 * np.pi * (1 - cap**2) * 0.8),
    ):
        got = sl.render(level, sl.Sky(brightness), "horizon", backend=backend, quantity="irradiance").image
        assert got == pytest.approx(expected, rel=6e-3)


def test_azimuths_go_where_a_sun_is():
    """Half of the sectors lie within the sun; its penumbra behind a wall is finer than by even sectors."""
    sun = np.array([0.6, 0.0, -0.8])
    profile = sl.sources.azimuth_profile(sl.Sky(lambda L: 1e-3 + 1e4 * (L @ sun > np.cos(np.radians(1)))))
    sectors = sl.Azimuths.placed(64, profile)
    near = np.abs((sectors.angles + np.pi) % (2 * np.pi) - np.pi) < np.radians(3)
    assert near.sum() >= 28 and sectors.widths.sum() == pytest.approx(2 * np.pi) and len(sectors) == 64
    assert sl.sources.azimuth_profile(sl.Sky(sl.cie_overcast())) is None


def test_a_table_of_brightness_is_the_mean_of_its_looks():
    """However many azimuths and looks it is made of, and of each azimuth alone."""
    glow = sl.Sky(lambda L: 1 + 5 * np.maximum(0, L @ np.array([0.6, 0.48, -0.64])) ** 6)
    table, angles = sl.sources.elevation_table, np.linspace(0, 6, 300)
    looks = table(glow, 0.3 + 0.8 * ((np.arange(64) + 0.5) / 64 - 0.5), np.zeros(64), 64, 33)
    np.testing.assert_allclose(
        table(glow, np.array([0.3]), np.array([0.8]), 64, 33)[0], looks.mean(0), atol=1e-6
    )
    many = table(glow, angles, np.full(300, 0.02), 600, 33)
    for n in (0, 137, 299):
        np.testing.assert_allclose(
            many[n], table(glow, angles[n : n + 1], np.array([0.02]), 2, 33)[0], atol=1e-6
        )


@pytest.mark.slow
def test_auto_takes_horizons_where_it_can_and_says_so(fast):
    scene = sl.Scene(scenes.rough(24, 24, 1.0))
    plan = sl.plan(scene, sl.Sky(), 0.01, fast)
    assert (
        plan.method == "horizon"
        and 6 <= plan.azimuths <= 24
        and f"{plan.azimuths} evenly" in str(plan)
        and "tolerance 0.01" in plan.reason
    )
    finer = sl.render(scene, sl.Sky(), tolerance=0.001, backend=fast).plan
    assert finer.method == "horizon" and finer.azimuths > plan.azimuths
    aperture = np.ones((24, 24), bool)
    assert sl.render(scene, sl.Window(aperture=aperture), backend=fast).plan.method == "lattice"
    assert sl.render(scene, sl.Sky(), hemicube=5, backend=fast).plan.method == "lattice"


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda s: sl.render(s, sl.Sky(), "horizon", hemicube=9), "azimuths and max_distance"),
        (lambda s: sl.render(s, sl.Sky(), "lattice", azimuths=9), "two methods"),
        (lambda s: sl.render(s, sl.Window(aperture=np.ones((31, 31), bool)), "horizon"), "aperture"),
        (lambda s: sl.render(s, sl.Sky(), "horizon", azimuths=0), "1 to 4096"),
        (lambda s: sl.horizons(s, 2.5), "1 to 4096"),
        (lambda s: sl.horizons(s, max_distance=0.5), "at least one spacing"),
        (lambda s: sl.horizons(s, max_distance=-1), "> 0"),
        (lambda s: sl.sky_view_factor(s, "tilt"), "tilted | horizontal | solid_angle"),
        (lambda s: sl.openness(s, negative=1), "True or False"),
        (
            lambda s: sl.Azimuths(2, (0, 1, 2)),
            "got .0.0, 1.0, 2.0.; allowed: 3 increasing angles that span 2 pi",
        ),
        (lambda s: sl.Azimuths(2, (0, 7)), "shape .2,.; allowed: 3 increasing"),
        (lambda s: sl.Azimuths(2, "abc"), "real numbers"),
        (lambda s: sl.horizons(np.zeros((3, 3))), "skylamp.Scene"),
    ],
)
def test_bad_input_is_named(call, says):
    with pytest.raises(sl.InputError, match=says.replace("|", r"\|")):
        call(spike())


def test_a_relief_beyond_all_search_is_a_capacity_error(backend):
    """On a map that repeats it would be followed over more rows than an integer counts."""
    depth = np.where(np.eye(5, 7) > 0, 2.4e6, 1.0)
    for work in (sl.sky_view_factor, sl.horizons, sl.openness):
        with pytest.raises(sl.CapacityError, match="repeats"):
            work(sl.Scene(depth, sides="periodic"), azimuths=4, backend=backend)


@pytest.mark.parametrize("reach", [1e4, 3e9, 1e20])
def test_far_distances_on_a_map_that_repeats(backend, reach):
    """A max_distance beyond all that can be seen is none."""
    scene = sl.Scene(np.random.default_rng(1).uniform(2, 6, (16, 18)).astype(np.float32), sides="periodic")
    found, expected = (
        sl.sky_view_factor(scene, azimuths=12, backend=backend, max_distance=distance)
        for distance in (reach, None)
    )
    assert_bits_equal(found, expected)
