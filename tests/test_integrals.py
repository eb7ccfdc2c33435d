"""A sky's brightness as integrals: level ground to 1e-4, small bright parts, tables against quadrature."""

import gc
import itertools
import math
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

import skylamp as sl
from skylamp import sources
from skylamp.backends import select
from skylamp.light.horizon import Horizons
from skylamp.sources import integrals
from skylamp.sources.brightness import distribution
from skylamp.sources.integrals import KEPT_TABLE_BYTES, Integrals, even, sector_multiples

FLAT = sl.Scene(np.full((24, 31), 5.0))
DISC = np.sin(np.radians(0.2665)) ** 2


def towards(azimuth, elevation):
    """Unit vector of angles [degree] of the house's axes."""
    a, e = np.radians((azimuth, elevation))
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])


def discs(seed, count, base=0.7, least=0.1, most=3.0):
    """(sky function, irradiance of level ground, directions) of random discs wholly above the horizon."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(count):
        radius = np.radians(np.exp(rng.uniform(np.log(least), np.log(most))))
        elevation = np.degrees(np.arcsin(rng.uniform(np.sin(1.01 * radius), 1)))
        axis = towards(rng.uniform(0, 360), max(elevation, 1.05 * np.degrees(radius)))
        parts.append((axis, radius, rng.uniform(0.2, 3) / (np.pi * np.sin(radius) ** 2)))
    level = np.pi * base + sum(k * np.pi * np.sin(r) ** 2 * -u[2] for u, r, k in parts)
    return lambda L: base + sum(k * (L @ u > np.cos(r)) for u, r, k in parts), level, [u for u, _, _ in parts]


def lights(seed, rows, count, base=0.5, size=2):
    """(environment map (rows, 2 rows), irradiance of level ground) with small lights above the horizon."""
    rng = np.random.default_rng(seed)
    image = np.full((rows, 2 * rows), base)
    for _ in range(count):
        row, col = int(rng.uniform(0.02, 0.47) * rows), int(rng.uniform(0, 2) * rows)
        image[row : row + size, np.arange(col, col + size) % (2 * rows)] += (
            1.5 / count / ((size * np.pi / rows) ** 2 * np.sin((row + 1) * np.pi / rows))
        )
    return image, of_map(image)


def of_map(image):
    """Irradiance of level ground: rows are linear between their middles, and azimuths even."""
    rows = len(image)
    theta = np.pi / 2 * (np.arange(400_000) + 0.5) / 400_000
    return (
        2
        * np.pi
        * (
            np.interp(theta / np.pi * rows - 0.5, np.arange(rows), image.mean(1))
            * np.sin(theta)
            * np.cos(theta)
        ).mean()
        * np.pi
        / 2
    )


def striped(count):
    """(sky function, irradiance of level ground) of stripes along y: integrals over a unit disc (Nusselt)."""
    until = lambda x: x * np.sqrt(1 - x * x) + np.arcsin(x)
    low = np.arange(-count, count) / count
    return lambda L: ((count * L[..., 0]) % 1 < 0.5).astype(float), float(
        (until(low + 0.5 / count) - until(low)).sum()
    )


def held(sky, level, fast, within=1e-4):
    """Level ground is right to 1e-4, integrated and rendered."""
    assert Integrals(sky).level == pytest.approx(level, rel=within)
    out = sl.render(FLAT, sky, tolerance=0.01, backend=fast, quantity="irradiance")
    np.testing.assert_allclose(out.image, level, rtol=within)
    assert not out.warnings


# --- level ground


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "seed"), [(count, seed) for seed, count in enumerate((1, 1, 1, 2, 2, 2, 10, 10, 10, 1, 3, 5))]
)
def test_level_ground_under_suns(fast, count, seed):
    """Any number of discs of any size."""
    function, level, _ = discs(seed, count)
    held(sl.Sky(function), level, fast)


@pytest.mark.parametrize(
    "seed", [10, 11, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(12, 18))]
)
def test_suns_that_are_named_have_all_their_light(seed):
    """Of any size from 0.02 degrees on, wherever they stand in the cells that are divided."""
    function, level, axes = discs(seed, 1 + seed % 3, least=0.02, most=1.0)
    assert Integrals(sl.Sky(function, suns=axes)).level == pytest.approx(level, rel=2e-4)


@pytest.mark.parametrize(
    ("rows", "count"), [(256, 1), (256, 4), (256, 10), (512, 1), (512, 4), (512, 10), (255, 4), (129, 3)]
)
def test_level_ground_under_an_environment_map(fast, rows, count):
    """Lights of two by two pixels; an odd number of rows has one across the horizon."""
    image, level = lights(rows + count, rows, count)
    held(sl.Sky(sl.environment_map(image)), level, fast)


def test_level_ground_under_a_coarse_map(fast):
    """Pixels 11 degrees wide: all different; one at the zenith, at the horizon, or next to column 0."""
    rng = np.random.default_rng(5)
    image = rng.random((16, 32))
    held(sl.Sky(sl.environment_map(image)), of_map(image), fast)
    for row, col in ((0, 0), (7, 31), (3, 17)):
        image = np.ones((16, 32))
        image[row, col] = 50
        held(sl.Sky(sl.environment_map(image)), of_map(image), fast)


@pytest.mark.parametrize("rows", [64, 96, 128])
def test_level_ground_under_a_panorama_of_many_lights(rows):
    """Pixels that are divided into an odd number of cells keep their light where bright ones are refined."""
    rng = np.random.default_rng(rows)
    image = np.exp(rng.normal(0, 0.2, (rows, 2 * rows)))
    image[rng.random(image.shape) < 0.004] *= 12
    sky = Integrals(sl.Sky(sl.environment_map(image)))
    assert sky.bright_parts and sky.level == pytest.approx(of_map(image), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("elevation", "radius"), [(90, 0.1), (89.95, 0.1), (90, 2), (47, 0.1), (0.2, 0.1), (12.3, 0.15), (88, 5)]
)
def test_level_ground_under_a_spot(fast, elevation, radius):
    """As small as 0.1 degrees, in the zenith and near the horizon, beside a sun."""
    axis, sun, r = towards(77.7, elevation), towards(200, 30), np.radians(radius)
    k = 2 / (np.pi * np.sin(r) ** 2)
    level = np.pi * 0.5 + 2 * -axis[2] + 1e4 * np.pi * DISC * 0.5
    held(
        sl.Sky(lambda L: 0.5 + k * (L @ axis > np.cos(r)) + 1e4 * (L @ sun > np.sqrt(1 - DISC))), level, fast
    )


@pytest.mark.slow
@pytest.mark.parametrize(("count", "within"), [(3, 1e-4), (20, 1e-4), (57, 1e-3)])
def test_level_ground_under_stripes(fast, count, within):
    """Of ten degrees and more, of 1.5, and of half a degree: borders all over the sky."""
    function, level = striped(count)
    held(sl.Sky(function), level, fast, within)


@pytest.mark.slow
def test_level_ground_under_borders(fast):
    """Sharp ones, along an elevation and along azimuths."""
    for e in np.radians((11.25, 30, 45.3)):
        held(
            sl.Sky(lambda L, e=e: np.where(L[..., 2] < -np.sin(e), 3.0, 0.2)),
            np.pi * (3 * np.cos(e) ** 2 + 0.2 * np.sin(e) ** 2),
            fast,
        )
    for low, high in ((0.0, np.pi), (0.7, 1.9), (1.0, 1.1), (np.pi / 4, np.pi / 2)):
        held(
            sl.Sky(
                lambda L, low=low, high=high: np.where(
                    (np.arctan2(L[..., 1], L[..., 0]) >= low) & (np.arctan2(L[..., 1], L[..., 0]) < high),
                    4.0,
                    1.0,
                )
            ),
            np.pi + 1.5 * (high - low),
            fast,
        )


@pytest.mark.slow
@pytest.mark.parametrize("power", [1, 6, 64, 300, 900])
def test_level_ground_under_cosine_powers(fast, power):
    """2 pi / (n + 2) about the zenith, whether it says that nothing of it is narrow or not."""
    held(sl.Sky(sl.cosine_power(power)), 2 * np.pi / (power + 2), fast)
    held(sl.Sky(lambda L: np.maximum(0, -L[..., 2]) ** power), 2 * np.pi / (power + 2), fast)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_few_azimuths_are_right_on_planes(fast, seed):
    """Four azimuths, two sectors of every sun, no closed form: the light above tangent planes is exact."""
    function, level, _ = discs(20 + seed, 4)
    np.testing.assert_allclose(
        Horizons(select(fast), FLAT, Integrals(sl.Sky(function)), 4, 2).irradiance(), level, rtol=1e-4
    )
    y, x = np.mgrid[:24, :31]
    normal = np.array([-0.2, 0.1, -1]) / np.sqrt(1.05)
    axes = [towards(a, e) for a, e in ((10 + seed, 60), (130, 40 + seed), (255.5, 80))]
    sky = sl.Sky(lambda L: 0.7 + sum(1e4 * (L @ u > np.sqrt(1 - DISC)) for u in axes))
    image = Horizons(select(fast), sl.Scene(30 - 0.2 * x + 0.1 * y), Integrals(sky), 4, 2).irradiance()
    np.testing.assert_allclose(
        image[2:-2, 2:-2],
        0.7 * np.pi * (1 - normal[2]) / 2 + 1e4 * np.pi * DISC * sum(u @ normal for u in axes),
        rtol=5e-4,
    )


# --- features that are named


@pytest.mark.slow
def test_a_spot_is_found_where_it_is_named(fast):
    """Of 0.01 degrees radius, named by the sky, by a vector of any length, or by the function."""
    rng = np.random.default_rng(11)
    for _ in range(4):
        axis, r = towards(rng.uniform(0, 360), rng.uniform(2, 88)), np.radians(0.01)
        k = 5 / (np.pi * np.sin(r) ** 2)
        spot = lambda L, k=k, axis=axis, r=r: 1 + k * (((L - axis) ** 2).sum(-1) < 4 * np.sin(r / 2) ** 2)
        level = np.pi + 5 * -axis[2]
        spot_with = lambda L, spot=spot: spot(L)
        spot_with.peaks = (tuple(axis),)
        for sky in (sl.Sky(spot, suns=[axis]), sl.Sky(spot, suns=[tuple(7 * axis)]), sl.Sky(spot_with)):
            assert Integrals(sky).level == pytest.approx(level, rel=2e-4)
            assert len(Integrals(sky).bright_parts) == 1
            np.testing.assert_allclose(
                sl.render(FLAT, sky, tolerance=0.01, backend=fast, quantity="irradiance").image,
                level,
                rtol=2e-4,
            )


@pytest.mark.parametrize(
    "suns",
    [
        3,
        "up",
        [3],
        [(0, 0)],
        [(0, 0, 0)],
        [(0, 0, 1)],
        [(np.nan, 0, -1)],
        [(0, 0, "x")],
        [(1, 2, 3, 4)],
        None,
    ],
)
def test_suns_that_are_none(suns):
    with pytest.raises(sl.InputError, match="suns"):
        sl.Sky(lambda L: L[..., 0], suns=suns)


@pytest.mark.slow
def test_a_sky_with_a_disc_is_its_parts(fast):
    """On level ground, also of a periodic map; an explicit number of azimuths still refuses the latter."""
    for sun in ((0, 90), (123.4, 35), (300, 3)):
        sky = sl.cie_clear(sun, horizontal=1.0, direct=10.0)
        for sides in ("open", "periodic"):
            scene = sl.Scene(FLAT.depth, sides=sides)
            image = sl.render(scene, sl.Sky(sky), tolerance=0.01, backend=fast, quantity="irradiance").image
            np.testing.assert_allclose(image, 1 + 10 * np.sin(np.radians(sun[1])), rtol=1e-3)
        with pytest.raises(sl.InputError, match="periodic"):
            sl.render(scene, sl.Sky(sky), "horizon", backend=fast)


# --- what is found of a sky


def test_suns_have_all_their_light(fast):
    """Directions, flux and cones of three discs; with the rest they are the whole; so are their sectors."""
    places = [
        (towards(10, 20), 0.5, 900.0),
        (towards(140, 50), 1.5, 300.0),
        (towards(359.9, 70), 0.3, 3000.0),
    ]
    light = Integrals(sl.Sky(lambda L: 1 + sum(k * (L @ u > np.cos(np.radians(r))) for u, r, k in places)))
    assert len(light.bright_parts) == 3 and [sun.power for sun in light.bright_parts] == sorted(
        (sun.power for sun in light.bright_parts), reverse=True
    )
    assert light.rest + sum(sun.moment[2] for sun in light.bright_parts) == pytest.approx(
        light.level
    ) and light.rest / np.pi == pytest.approx(1, rel=2e-3)
    for u, r, k in places:
        suns = light.bright_parts
        sun = max(suns, key=lambda sun: sun.moment @ (u * (1, 1, -1)) / np.linalg.norm(sun.moment))
        flux = (k - 3) * np.pi * np.sin(np.radians(r)) ** 2
        assert np.linalg.norm(sun.moment) == pytest.approx(flux, rel=2e-3) and sun.power == pytest.approx(
            flux, rel=2e-3
        )
        middle, sine = sun.cone
        assert np.degrees(np.arccos(min(1, middle @ (u * (1, 1, -1))))) < 0.03 and 0.99 * np.sin(
            np.radians(r)
        ) < sine < np.sin(np.radians(1.5 * r + 0.2))
        for count, shifted in ((1, False), (4, False), (4, True), (120, False)):
            ways, table = sun.sectors(count, shifted)
            assert 0.8 * count < ways.shape[1] == len(table) <= count + shifted
            np.testing.assert_allclose(ways[2] @ table[:, 0, 1], sun.moment[2], rtol=1e-5)
            np.testing.assert_allclose(
                (ways[:2] * table[:, 0, 0]).sum(1),
                sun.moment[:2],
                atol=1e-4 * np.linalg.norm(sun.moment)
                + (0.02 * flux * np.radians(r) if count == 1 else 2e-3 * flux),
            )
            share = table[:, 0, :2].sum(1) / table[:, 0, :2].sum()
            assert count != 4 or share[1:-1].max() < 1.6 / count


@pytest.mark.parametrize("radius", [0.05, 0.19, 1.0])
def test_a_small_sun_at_the_zenith_beside_a_cliff(fast, radius):
    """float32 resolves the sine of elevation there to some knots of its table; nothing of it may be lost."""
    edge, light = np.cos(np.radians(radius)), 1.0 / np.sin(np.radians(radius)) ** 2
    sky = sl.Sky(lambda L: 1 + light * (-L[..., 2] >= edge), suns=[(0.0, 0.0, -1.0)])
    depth = np.where(np.arange(40) < 3, 20.0, 1.0) * np.ones((40, 1))
    image = sl.render(
        sl.Scene(depth), sky, backend=fast, tolerance=0.01, interreflection=False, quantity="irradiance"
    ).image
    assert np.abs(image[:, 20:] / (2 * np.pi) - 1).max() < 1e-4


@pytest.mark.parametrize("how", [{"tolerance": 0.01}, {"method": "horizon", "azimuths": 16}])
def test_a_small_sun_at_the_zenith_lights_the_foot_of_a_wall(fast, how):
    """Of a dark box 30 deep: half a spacing from it a node sees the sky within 1 degree of the zenith."""
    edge = np.cos(np.radians(0.3))
    sky = sl.Sky(lambda L: 1.0 * (-L[..., 2] >= edge), suns=[(0.0, 0.0, -1.0)])
    scene = sl.Scene(np.full((40, 40), 30.0), sides="dark")
    image = sl.render(scene, sky, backend=fast, interreflection=False, quantity="irradiance", **how).image
    assert np.abs(image / (np.pi * np.sin(np.radians(0.3)) ** 2) - 1).max() < 1e-4


def test_a_small_sun_at_the_zenith_lights_the_foot_of_a_cliff(fast):
    """With azimuths that are asked for: the cliff's own slope tilts its foot and hides nothing of the sun."""
    edge, height = np.cos(np.radians(0.3)), 30.0
    sky = sl.Sky(lambda L: 1.0 * (-L[..., 2] >= edge), suns=[(0.0, 0.0, -1.0)])
    depth = np.where(np.arange(40) < 3, 1.0, 1.0 + height) * np.ones((40, 1))
    image = sl.render(sl.Scene(depth), sky, "horizon", backend=fast, azimuths=16, quantity="irradiance").image
    cosine = 1 / np.hypot(1, height / 2)
    assert np.abs(image[:, 3] / (cosine * np.pi * np.sin(np.radians(0.3)) ** 2) - 1).max() < 1e-3


@pytest.mark.slow
def test_what_is_no_sun():
    """Even skies have none; nor do parts that span much azimuth or give a tenth of the tolerance."""
    assert (
        Integrals(sl.Sky(sl.cie_overcast())).bright_parts
        == ()
        == Integrals(sl.Sky(lambda L: np.where(L[..., 0] > 0, 9.0, 1.0))).bright_parts
    )
    axis = towards(40, 40)
    for k, found in ((4e4, 1), (20.0, 0)):
        light = Integrals(sl.Sky(lambda L, k=k: 1 + k * (L @ axis > np.sqrt(1 - DISC))), 0.01)
        assert len(light.bright_parts) == found and light.level == pytest.approx(
            np.pi * (1 + k * DISC * -axis[2]), rel=1e-4
        )
    assert Integrals(sl.Sky(lambda L: 1 + 4e4 * (L @ axis > np.sqrt(1 - DISC))), math.inf).bright_parts == ()


def test_the_mean_brightness_of_a_sky():
    """That of a uniform sky with the same irradiance of level ground."""
    light = Integrals(sl.Sky(lambda L: 2 - L[..., 2]))  # 2 + sine: 2 to 3, mean 2 + 2 / 3
    assert light.rest / np.pi == pytest.approx(8 / 3, rel=1e-5)
    same = Integrals(sl.Sky(sl.uniform(3.0)))
    assert (
        same.rest / np.pi == pytest.approx(3) and same.level == pytest.approx(3 * np.pi) and same.error == 0
    )
    assert Integrals(sl.Sky(sl.uniform(0.0))).level == 0


@pytest.mark.slow
def test_errors_of_integrals_are_told(fast):
    """What is too rugged to integrate says by how much it may be off; what is smooth is known well."""
    assert (
        Integrals(sl.Sky(sl.cie_overcast())).error < 2e-5
        and 2e-5 < Integrals(sl.Sky(striped(57)[0])).error < 1e-3
    )
    rugged = sl.Sky(lambda L: (np.sin(500 * L[..., 0]) * np.sin(500 * L[..., 1]) > 0) * 1.0)
    light = Integrals(rugged)
    assert light.level == pytest.approx(np.pi / 2, rel=max(5e-3, 3 * light.error))


def test_tables_hold_integrals():
    """B cos^2 and B sin cos above every knot against quadrature; across azimuth 0; steps between knots."""
    function = lambda L: 1 + L[..., 0] ** 2 + 0.5 * L[..., 1] - 0.3 * L[..., 2]
    light, azimuths = Integrals(sl.Sky(function), math.inf), even(6, 0.1)
    table = light.table(azimuths.angles, azimuths.widths, 9)
    assert table.shape == (6, 9, 4) and table.dtype == np.float32
    e = np.pi / 2 * (np.arange(2000) + 0.5) / 2000
    for n, (angle, width) in enumerate(zip(azimuths.angles, azimuths.widths)):
        a = angle + width * ((np.arange(200) + 0.5) / 200 - 0.5)
        values = function(sources.directions_of(a[:, None], np.sin(e))).mean(0)
        for k, weight in enumerate((np.cos(e) ** 2, np.sin(e) * np.cos(e))):
            wanted = [
                (values * weight * (np.tan(e) * (1 - q) > q)).sum() * np.pi / 2 / 2000
                for q in np.linspace(0, 1, 9)
            ]
            np.testing.assert_allclose(table[n, :, k], wanted, atol=1e-3)
    np.testing.assert_allclose(table[:, :-1, :2] + table[:, :-1, 2:], table[:, 1:, :2], atol=1e-6)
    assert not table[:, -1].any()


@pytest.mark.slow
def test_a_map_is_its_function():
    """Integrals of the pixels against those of the same map as a function of directions, sector by sector."""
    image = np.random.default_rng(3).random((64, 128)) + 0.2
    there, azimuths = sl.environment_map(image), even(8, 0.3)
    of = lambda function: Integrals(sl.Sky(function), math.inf).table(azimuths.angles, azimuths.widths, 17)
    np.testing.assert_allclose(of(there), of(lambda L: there(L)), atol=2e-3)


def test_brightness_that_is_wrong_is_an_input_error(fast):
    """Negative, not finite, or of another shape, wherever it first turns up."""
    for function in (
        lambda L: L[..., 0],
        lambda L: np.where(L[..., 2] < -0.5, np.nan, 1.0),
        lambda L: np.ones(3),
    ):
        with pytest.raises(sl.InputError, match="brightness"):
            sl.render(FLAT, sl.Sky(function), backend=fast)


@pytest.mark.parametrize(
    "k", [1e-34, 1e25, *(pytest.param(k, marks=pytest.mark.slow) for k in (1e-28, 1e-12))], ids=str
)
@pytest.mark.parametrize("how", [{"tolerance": 0.01}, {"azimuths": 24}], ids=["tolerance", "azimuths"])
def test_faint_and_glaring_skies_scale(fast, how, k):
    """A function times k gives the image and its error times k: no absolute number stands in the way."""
    scene = sl.Scene(10 + np.random.default_rng(0).random((24, 31)) * 4)
    one, other = (
        sl.render(scene, sl.Sky(lambda L, k=k: k * (1 - L[..., 2])), backend=fast, **how) for k in (1.0, k)
    )
    np.testing.assert_allclose(other.image / np.float64(k), one.image.astype(float), rtol=1e-4)
    assert [text[:30] for text in other.warnings] == [text[:30] for text in one.warnings]
    if one.error is not None:
        np.testing.assert_allclose(other.error.mean() / k, one.error.mean(dtype=float), rtol=0.05)


def test_a_faint_sky_with_a_disc_scales(fast):
    """So do CIE's skies, whose disc is no part of the function, and the maps of environments."""
    scene = sl.Scene(10 + np.random.default_rng(0).random((24, 31)) * 4)
    clear = lambda k: sl.cie_sky(12, (135, 40), zenith=k, direct=3 * k)
    panorama = lambda k: sl.environment_map(k * np.random.default_rng(1).random((8, 16)))
    for make in (clear, panorama):
        one, other = (sl.render(scene, sl.Sky(make(k)), backend=fast, azimuths=16) for k in (1.0, 1e-30))
        np.testing.assert_allclose(other.image / np.float64(1e-30), one.image.astype(float), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [32, 128, 256])
def test_small_lights_of_a_map_have_their_power_and_extent(rows):
    """A bright pixel, which interpolation makes a tent two pixels wide; shadows and windows cut it."""
    image, pixel = np.full((rows, 2 * rows), 0.2), math.pi / rows
    row, col = int(0.31 * rows), int(0.47 * rows)
    image[row, col] = 900.0
    light = sl.environment_map(image)
    (part,) = Integrals(sl.Sky(light)).bright_parts
    cells, around = part.cells, np.linspace(-1, 1, 2001) * pixel
    e = (math.pi / 2 - (row + 0.5) * pixel + around)[:, None]
    a = np.average(cells.azimuth, weights=cells.light) + around
    directions = np.stack(np.broadcast_arrays(np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)), -1)
    excess = np.maximum(0, light(directions) - part.limit) * np.cos(e)

    def extent(elevation, weights):
        off = elevation - np.average(elevation, weights=weights)
        return math.sqrt(np.average(off**2, weights=weights))

    assert part.power == pytest.approx(excess.sum() * (pixel / 1000) ** 2, rel=5e-4)
    found = extent((cells.low + cells.high) / 2, cells.light * cells.solid_angle)
    assert found == pytest.approx(extent(e[:, 0], excess.sum(1)), rel=3e-3)


def test_bright_parts_have_sectors_by_their_light():
    """As many in all as if each had one, and none less than one: the light to the power of 2/3."""
    part = lambda power: SimpleNamespace(power=power)
    assert sector_multiples([]) == []
    assert sector_multiples([part(3.0)]) == [1]
    assert sector_multiples([part(2.0)] * 4) == [1, 1, 1, 1]
    assert sector_multiples([part(27.0), part(1.0), part(1.0), part(1.0)]) == [3, 1, 1, 1]


@pytest.mark.parametrize("rows", [7, 64, 180, 181, 512, 1024])
def test_a_light_in_the_zenith_of_a_map(rows):
    """Pixels narrow towards the zenith, so that means over them are not those by elevation; a quadrature of
    the map itself, as bright all round. A bright band at the horizon keeps cells from being divided."""
    image = np.full((rows, 2 * rows), 0.1)
    image[0], image[rows // 2 - rows // 20 : rows // 2] = 4e4, 0.6
    elevation = np.pi / 2 * (np.arange(100_000) + 0.5) / 100_000
    there = sl.environment_map(image)(sources.directions_of(0.3, np.sin(elevation)))
    level = 2 * np.pi * np.mean(there * np.sin(elevation) * np.cos(elevation)) * np.pi / 2
    for tolerance in (0.01, math.inf):
        assert Integrals(sl.Sky(sl.environment_map(image)), tolerance).level == pytest.approx(level, rel=1e-5)


@pytest.mark.slow
def test_integrals_are_kept_with_what_they_are_of(monkeypatch):
    """Of maps and functions, once per object: another value anywhere, another object, and nothing is kept of
    objects that are gone, nor of more than a bounded size."""
    made = []
    fill = Integrals.__init__

    def counted(self, *args, **options):
        made.append(self)
        fill(self, *args, **options)

    monkeypatch.setattr(Integrals, "__init__", counted)
    kept = integrals._of_objects

    def level(brightness, times=1.0, **named):
        return integrals.integrals(sl.Sky(brightness, **named)).level

    image = np.random.default_rng(2).random((8, 16, 3))
    rgb = sl.environment_map(image)
    first = [level(grey.brightness) for grey in sources.channels(sl.Sky(rgb))]
    image[:] = 0
    assert [level(grey.brightness) for grey in sources.channels(sl.Sky(rgb))] == first and len(made) == 3
    with pytest.raises(ValueError, match="read-only"):
        rgb.image[0] = 1

    copied = pickle.loads(pickle.dumps(rgb))
    with pytest.raises(ValueError, match="read-only"):
        copied.image[0] = 1

    state, sun = {"sky": 1.0, "radius": 0.03}, (0.0, 0.0, -1.0)
    wide = lambda L: state["sky"] + L[..., 2] ** 2
    assert level(wide) == level(wide) and len(made) == 4
    state["sky"] = 2.0
    assert level(wide) == pytest.approx(level(lambda L: 2 + L[..., 2] ** 2), rel=1e-12) and len(made) == 6
    owner = id(wide)
    assert sum(key[0] == owner for key in kept.of) == 2
    del wide
    gc.collect()
    assert not any(key[0] == owner for key in kept.of)

    spot = lambda L: 1 + 1e7 * (L[..., 2] < -np.cos(np.radians(state["radius"])))  # within one base cell
    for named in ({}, {"suns": [sun]}):
        levels = []
        for state["radius"] in (0.03, 0.06):
            levels.append(level(spot, **named))
        assert levels[1] > 2 * levels[0]
    monkeypatch.setattr(integrals, "KEPT_BYTES", 1)
    last = sl.environment_map(image[..., 0] + 1)
    level(last)
    assert list(kept.of)[0][0] == id(last) and len(kept.of) == 1


@pytest.mark.parametrize(
    "brightness",
    [
        sl.uniform(2.0),
        sl.cosine_power(3),
        sl.cosine_power(90),
        sl.cosine_power(1e6, (0.1, 0.2, 1.0)),
        sl.cie_overcast(),
        sl.cie_sky(12, (10, 40)),
        sl.cie_clear((10, 40), direct=2.0),
    ],
)
def test_brightness_can_be_pickled(brightness):
    """As processes get it, with what samples of it do not show; uniform() had a local function."""
    L = np.random.default_rng(4).normal(size=(50, 3))
    L /= -np.linalg.norm(L, axis=1, keepdims=True)
    copied = pickle.loads(pickle.dumps(sl.Sky(brightness))).brightness
    np.testing.assert_array_equal(copied(L), brightness(L))
    before, after = map(distribution, (brightness, copied))
    assert after.narrow() == before.narrow() and after.disc() == before.disc()


def test_kept_tables_are_bounded():
    """However many are asked for, they take KEPT_TABLE_BYTES at most, and nbytes has them."""
    light = Integrals(sl.Sky(sl.cie_overcast()))
    before = light.nbytes
    for count in range(20, 120):
        azimuths = even(count, 0.5)
        light.table(azimuths.angles, azimuths.widths, 1025)
    kept = light.nbytes - before
    assert 0 < kept <= KEPT_TABLE_BYTES
    first = light.table(azimuths.angles, azimuths.widths, 1025)
    assert first is light.table(azimuths.angles, azimuths.widths, 1025) and not first.flags.writeable


def test_spots_of_any_axis_and_of_no_greater_power():
    """An axis of any length is its direction; a power whose light would be wrong is refused."""
    L = np.array([[0.6, 0.0, -0.8], [0.0, 0.0, -1.0]])
    plain = sl.cosine_power(3, (-1, 0, 1))(L)
    for size in (1e300, 1e-300):
        np.testing.assert_allclose(sl.cosine_power(3, (-size, 0, size))(L), plain, rtol=1e-12)
    with pytest.raises(sl.InputError, match=r"power: got 100000000.0; allowed: .* at most 1e\+07"):
        sl.cosine_power(1e8)


def _cap(axis, half):
    """(Function of 1 in a disc of this radius [rad] round a unit vector, its light in full)."""
    whole = np.pi * np.sin(half) ** 2
    return lambda L: 1.0 * (np.linalg.norm(L - axis, axis=-1) < 2 * np.sin(half / 2)), whole


@pytest.mark.slow
@pytest.mark.parametrize("named", [True, False], ids=["named", "found"])
def test_small_lights_round_the_zenith_are_whole(named):
    """Cells there are as wide as high; with needles in azimuth up to 99 % of the light of a sun fell between
    their middles, and in the very zenith three times as much was found.
    """
    for off, half in itertools.product(
        (0, 0.001, 0.02, 0.1, 0.3, 1), (2e-4, 0.003, 0.05) if named else (0.12,)
    ):
        off, half = np.radians(off), np.radians(half)
        axis = np.array([np.sin(off) * 0.6, np.sin(off) * 0.8, -np.cos(off)])
        inside, whole = _cap(axis, half)
        light = integrals.integrals(sl.Sky(inside, **({"suns": [axis]} if named else {})))
        found = light.rest + sum(part.moment[2] for part in light.bright_parts)
        assert found == pytest.approx(whole * np.cos(off), rel=2e-3), np.degrees((off, half))


@pytest.mark.slow
def test_a_named_sun_is_met_among_many_edges():
    """The evaluations that clouds and stripes use up are not those of a named feature: it was lost."""
    axis, half = np.array([0.6, 0.0, -0.8]), np.radians(0.02)
    sun, whole = _cap(axis, half)
    for count in (60, 180):
        stripes = lambda L, n=count: 1.0 * (np.arctan2(L[..., 1], L[..., 0]) / (2 * np.pi) * n % 1 < 0.5)
        light = integrals.integrals(sl.Sky(lambda L, a=stripes: a(L) + sun(L) / half**2, suns=[axis]))
        bright = sum(part.moment[2] for part in light.bright_parts)
        assert light.rest + bright == pytest.approx(np.pi / 2 + whole / half**2 * 0.8, rel=0.05)


@pytest.mark.parametrize("named", [True, False])
def test_a_setting_sun_is_met(named):
    """Its middle may have set, and what is up be lower than half a cell: 0 before."""
    for below in (0.05, 0.1, 0.2):
        e, half = np.radians(-below), np.radians(0.267)
        sun, _ = _cap(np.array([np.cos(e), 0, -np.sin(e)]), half)
        if named:
            sun.peaks = ((np.cos(e), 0, -np.sin(e)),)
        light = integrals.integrals(sl.Sky(sun))
        up = half**2 * np.arccos(below / 0.267) + e * np.sqrt(half**2 - e**2)  # of a flat disc
        found = sum(part.power for part in light.bright_parts)
        assert found == pytest.approx(up, rel=0.02), below


def test_the_light_of_an_unseen_sun_is_no_level_of_the_lattice(fast):
    """A sun that a direction of the lattice meets is named, however small; and one that it misses."""
    for axis in ((0.6, 0.0, -0.8), (0.3, 0.42, -0.85)):
        axis = np.array(axis) / np.linalg.norm(axis)
        sun, _ = _cap(axis, np.radians(0.02))
        out = sl.render(sl.Scene(np.zeros((4, 4))), sl.Sky(sun, suns=[axis]), "lattice", backend=fast)
        assert any(text.startswith("Uneven sky") for text in out.warnings)


@pytest.mark.slow
def test_a_band_at_the_horizon_over_gentle_slopes():
    """Horizons lie within rows of cells, where light above them is the integral of sin cos, not a straight
    line: a band 0.2 degrees high was 4 % too dark.
    """
    for slope, wide in ((0.001, 0.2), (0.003, 0.33), (0.005, 0.5)):
        wide = np.radians(wide)
        band = lambda L, w=wide: 1.0 * (np.arcsin(np.clip(-L[..., 2], -1, 1)) < w)
        ramp = sl.Scene.from_height(slope * np.tile(np.arange(12.0), (12, 1)))
        image = sl.render(
            ramp, sl.Sky(band), tolerance=0.003, quantity="irradiance", interreflection=False
        ).image
        azimuth = (np.arange(3600) + 0.5) * 2 * np.pi / 3600
        tilt = -slope * np.cos(azimuth)
        low = np.arctan(np.maximum(0, -tilt))
        high, half = wide + low, (wide - low) / 2
        light = tilt * (half + np.cos(high) * np.sin(2 * half) / 2) + np.sin(high) * np.sin(2 * half) / 2
        exact = np.where(half > 0, light, 0).mean() * 2 * np.pi
        np.testing.assert_allclose(image, exact, rtol=0.01)
