"""Suns and skies of many times in one brightness: against the skies one by one, and pvlib's own sums."""

import numpy as np
import pytest

import skylamp as sl
from skylamp.sources.integrals import Integrals

pandas = pytest.importorskip("pandas")
pvlib = pytest.importorskip("pvlib")

PLACE = 46.5, 8.0
DAY = pandas.date_range("2026-06-21", periods=6, freq="4h", tz="UTC")
TIMES = DAY.append(pandas.date_range("2026-12-21", periods=6, freq="4h", tz="UTC"))


def sun_at(when):
    return sl.sun_position(when.to_pydatetime(), *PLACE, 500.0)


def slopes(count=5):
    """Unit normals (count * 8, 3), third component upwards, of slopes to all sides."""
    tilt, turn = np.meshgrid(np.linspace(0, 1.5, count), 2 * np.pi * np.arange(8) / 8 + 0.1)
    found = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], -1)
    return found.reshape(-1, 3)


def on_slopes(image, normals):
    """Irradiance of planes that face ``normals`` under an equirectangular map, cell by cell."""
    rows, cols = image.shape
    zenith = np.pi * (np.arange(rows // 2) + 0.5) / rows
    azimuth = 2 * np.pi * (np.arange(cols) + 0.5) / cols
    weight = image[: rows // 2] * (np.pi / rows * 2 * np.pi / cols * np.sin(zenith))[:, None]
    x, y, z = (
        np.sin(zenith)[:, None] * np.cos(azimuth),
        np.sin(zenith)[:, None] * np.sin(azimuth),
        np.cos(zenith),
    )
    return np.array(
        [(weight * np.maximum(0, nx * x + ny * y + nz * z[:, None])).sum() for nx, ny, nz in normals]
    )


@pytest.mark.slow
def test_a_sum_is_that_of_its_skies():
    """CIE types that change from time to time, measured light, uneven hours: plane by plane, sky by sky."""
    rng = np.random.default_rng(1)
    dni, dhi, hours = rng.uniform(100, 800, (3, len(TIMES))) / [[1], [4], [200]]
    types = np.array([12, 7, 1, 13, 5, 15] * 2)
    found = sl.sky_over_time(TIMES, *PLACE, 500.0, dni=dni, dhi=dhi, model=types, hours=hours)
    normals, expected, level, suns = slopes(), 0.0, 0.0, 0
    for n, when in enumerate(TIMES):
        sun = sun_at(when)
        if sun[1] <= 0:  # dhi comes evenly
            sky, beam = sl.cie_sky(5, zenith=dhi[n] / np.pi), 0.0
        else:
            sky, beam, suns = sl.cie_sky(int(types[n]), sun, horizontal=dhi[n]), dni[n], suns + 1
        rows, cols = 320, 576
        zenith, azimuth = np.meshgrid(
            np.pi * (np.arange(rows) + 0.5) / rows, 2 * np.pi * (np.arange(cols) + 0.5) / cols, indexing="ij"
        )
        L = np.stack(
            [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), -np.cos(zenith)], -1
        )
        a, e = np.radians(sun)
        towards = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
        light = on_slopes(sky(L), normals) + beam * np.maximum(0, normals @ towards)
        expected = expected + light * hours[n] / 1000
        level += (dhi[n] + beam * max(0, np.sin(e))) * hours[n] / 1000
    assert suns == found.suns > 4
    np.testing.assert_allclose(found.ghi, level, rtol=1e-5)
    np.testing.assert_allclose(on_slopes(found.image, normals), expected, rtol=0, atol=2e-3 * expected.mean())


def test_longitudes_may_go_on_beyond_180_degrees():
    """The clear sky's turbidity raised pvlib's own error for 200."""
    east, west = (sl.sky_over_time(DAY, PLACE[0], longitude).image for longitude in (200.0, -160.0))
    assert np.array_equal(east, west) and east.any()


def test_perez_is_that_of_pvlib():
    """Level ground, walls to all sides: what pvlib gives, hour by hour, without light from the ground."""
    times = TIMES
    place = pvlib.location.Location(*PLACE, altitude=500.0)
    sun, clear = place.get_solarposition(times), place.get_clearsky(times)
    found = sl.sky_over_time(times, *PLACE, 500.0, hours=1.0)
    extra = pvlib.irradiance.get_extra_radiation(times)
    tilts, sides = np.array([0, 90, 90, 90, 90]), np.array([0, 0, 90, 180, 270])
    expected = []
    mass = pvlib.atmosphere.get_relative_airmass(sun["apparent_zenith"])
    for tilt, side in zip(tilts, sides):
        light = pvlib.irradiance.get_total_irradiance(
            tilt, side, sun["apparent_zenith"], sun["azimuth"], clear["dni"], clear["ghi"], clear["dhi"],
            dni_extra=extra, airmass=mass, model="perez",
        )  # fmt: skip
        up = sun["apparent_elevation"] > 0
        expected.append((light["poa_direct"] + light["poa_sky_diffuse"])[up].sum() / 1000)
    tilt, side = np.radians(tilts), np.radians(sides)
    normals = np.stack([np.sin(tilt) * np.sin(side), -np.sin(tilt) * np.cos(side), np.cos(tilt)], -1)
    np.testing.assert_allclose(on_slopes(found.image, normals), expected, rtol=2e-3)
    np.testing.assert_allclose(found.ghi, expected[0], rtol=1e-4)


def test_overcast_light_is_nowhere_negative(fast):
    """Perez's band at the horizon may be black, never darker, not even by rounding; all light stays."""
    when = pandas.DatetimeIndex(["2026-04-20 14:00", "2026-02-09 08:00"], tz="UTC")
    for n in range(2):
        found = sl.sky_over_time(when[[n]], *PLACE, 500.0, dni=[0.0], dhi=[100.0 - 50 * n], hours=1.0)
        assert found.image.min() == 0 and found.image[639].max() < 1e-12
        np.testing.assert_allclose(found.ghi, 0.1 - 0.05 * n, rtol=1e-6)
        sl.render(sl.Scene(np.ones((8, 8))), sl.Sky(found), azimuths=8, backend=fast)


def test_the_integrals_of_a_render_have_all_of_it():
    """A render's table of the sum is its cells: no sun between samples, none twice."""
    year = sl.sky_over_time(TIMES, *PLACE, hours=2.0)
    sky = Integrals(sl.Sky(year))
    np.testing.assert_allclose(sky.level, year.ghi, rtol=5e-6)
    assert len(sky.bright_parts) >= year.suns // 2


def test_hours_are_weights_and_substeps_follow_the_track():
    """Twice the hours are twice the light; the mean of substeps is that of finer times."""
    one = sl.sky_over_time(DAY, *PLACE, dni=[500.0] * 6, dhi=[100.0] * 6)
    two = sl.sky_over_time(DAY, *PLACE, dni=[500.0] * 6, dhi=[100.0] * 6, hours=8.0)
    np.testing.assert_allclose(2 * one.image, two.image, rtol=1e-12)
    assert one.dhi == pytest.approx(6 * 4 * 0.1)  # day and night
    many = sl.sky_over_time(DAY, *PLACE, dni=[500.0] * 6, dhi=[100.0] * 6, substeps=4)
    fine = pandas.date_range(DAY[0] - pandas.Timedelta("90min"), periods=24, freq="h")
    like = sl.sky_over_time(fine, *PLACE, dni=[500.0] * 24, dhi=[100.0] * 24)
    np.testing.assert_allclose(many.image, like.image, rtol=1e-9, atol=1e-12)
    assert abs(many.image - one.image).max() > 1


def test_convergence_turns_the_suns():
    """By as many degrees from east to north as the map's north lies east of true north."""
    options = dict(dni=[500.0] * 6, dhi=[0.0] * 6)
    plain, turned = (sl.sky_over_time(DAY, *PLACE, convergence=angle, **options) for angle in (0.0, 12.0))
    when = next(time for time in DAY if sun_at(time)[1] > 20)
    azimuth, elevation = np.radians(sun_at(when))
    there = [
        np.array([np.sin(a) * np.cos(elevation), -np.cos(a) * np.cos(elevation), -np.sin(elevation)])
        for a in (azimuth, azimuth - np.radians(12.0))
    ]
    assert plain(there[0]) > 100 * turned(there[0]) and turned(there[1]) > 100 * plain(there[1])
    assert turned.ghi == pytest.approx(plain.ghi, rel=1e-3)


@pytest.mark.slow
def test_a_valley_gets_the_sum_of_its_hours(fast):
    """One render of the sum against a render of every sky, shadows and all."""
    y, x = np.mgrid[:32, :32] - 15.5
    scene = sl.Scene.from_height(0.6 * abs(x) + 0.2 * y + np.where(np.hypot(x + 8, y) < 3, 6, 0.0))
    dni, dhi = np.full(6, 700.0), np.full(6, 100.0)
    options = {"quantity": "irradiance", "interreflection": False, "backend": fast, "tolerance": 0.003}
    year = sl.sky_over_time(DAY, *PLACE, 500.0, dni=dni, dhi=dhi, model=12)
    found = sl.render(scene, sl.Sky(year), **options)
    total = 0.0
    for when in DAY:
        if sun_at(when)[1] > 0:
            sky = sl.Sky(sl.cie_clear(sun_at(when), horizontal=100.0, direct=700.0))
            total = total + sl.render(scene, sky, **options).image * 4 / 1000
        else:
            total = total + sl.render(scene, sl.Sky(100 / np.pi), **options).image * 4 / 1000
    assert np.sqrt(((found.image - total) ** 2).mean()) < 0.006 * total.mean()


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"times": DAY.tz_localize(None)}, "tz_localize"),
        ({"times": ["yesterday"]}, "times"),
        ({"times": DAY[[0, 1, 3]]}, "Pass hours"),
        ({"times": DAY[:1]}, "Pass hours"),
        ({"times": DAY[::-1]}, "backwards; allowed: times that increase"),
        ({"times": DAY[:0]}, "at least one"),
        ({"hours": [1.0, 2.0]}, "one or 6"),
        ({"hours": 0.0}, "with 0.0.* > 0"),
        ({"hours": 1e12}, "at most 100000"),
        ({"dni": [1e24] * 6, "dhi": [1.0] * 6}, "to 1e\\+09"),
        ({"dni": pandas.Series([1.0] * 6, DAY[::-1]), "dhi": [1.0] * 6}, "dni, a Series of other times"),
        ({"dni": pandas.Series([1.0] * 6, DAY + 2 * (DAY[1] - DAY[0])), "dhi": [1.0] * 6}, "of other times"),
        ({"dni": [1.0] * 6}, "dni is given without the other"),
        ({"dni": [1.0] * 5, "dhi": [1.0] * 5}, "5 values"),
        ({"dni": [np.nan] * 6, "dhi": [1.0] * 6}, "while the sun is up"),
        ({"dni": [1.0] * 6, "dhi": [-1.0] * 6}, "while the sun is up"),
        ({"model": 16}, "1 to 15"),
        ({"model": "isotropic"}, "perez"),
        ({"model": [12, 12]}, "6 such types"),
        ({"latitude": 91.0}, "latitude"),
        ({"substeps": 0}, "substeps"),
        ({"convergence": np.inf}, "convergence: got inf"),
        ({"substeps": 1.5}, "substeps"),
    ],
)
def test_what_does_not_fit_is_an_error(changes, text):
    arguments = {"times": DAY, "latitude": 46.5, "longitude": 8.0} | changes
    with pytest.raises(sl.InputError, match=text):
        sl.sky_over_time(**arguments)
    with pytest.raises(sl.InputError, match="sun_position: time"):
        sl.sun_position(DAY, 46.5, 8.0)


@pytest.mark.parametrize("seconds", [0, 20, 60])
def test_a_sun_near_the_zenith_has_its_own_light_and_no_more(seconds):
    """It was 2.8 % too bright: a cell of the table at the pole stands for more than its solid angle."""
    time = pandas.DatetimeIndex(
        [pandas.Timestamp("2026-03-20T12:07:30Z") + pandas.Timedelta(seconds=seconds)]
    )
    sky = sl.sky_over_time(time, 0, 0, hours=1.0, dni=[900.0], dhi=[0.0])
    _, elevation = sl.sun_position(time[0], 0, 0)
    assert abs(sky.ghi / (0.9 * np.sin(np.radians(elevation))) - 1) < 1e-4
    assert abs(Integrals(sl.Sky(sky)).level / sky.ghi - 1) < 1e-3


@pytest.mark.parametrize("dhi", [300, 600, 20_000])
def test_more_diffuse_light_than_comes_to_the_atmosphere(dhi):
    """As at dusk with times that are an hour off: level ground gets it, and no more."""
    times = pandas.DatetimeIndex(["2026-06-21 18:30Z"])
    for when in (times, times - pandas.Timedelta("7h")):
        found = sl.sky_over_time(when, 45.0, 10.0, dni=[0], dhi=[dhi], hours=1000.0)
        assert found.ghi == pytest.approx(dhi, rel=1e-4)


def test_cells_do_not_widen_the_disc():
    """The mean square of the distance from the sun's middle is a quarter of its radius squared, along both
    axes, whereever the disc lies between cells."""
    radius = np.radians(0.2665)
    for minute in range(0, 10, 3):
        times = pandas.DatetimeIndex([f"2026-06-21 07:{minute:02}Z"])
        sky = sl.sky_over_time(times, *PLACE, dni=[500], dhi=[0], hours=1.0)
        azimuth, elevation = sun_at(times[0])
        e = np.radians(elevation) + np.linspace(-2.5, 2.5, 301)[:, None] * radius
        a = np.radians(azimuth - 90) + np.linspace(-2.5, 2.5, 301) * radius / np.cos(np.radians(elevation))
        light = sky(
            np.stack(np.broadcast_arrays(np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)), -1)
        )
        for place, scale in ((e, 1.0), (a, np.cos(np.radians(elevation)))):
            mean = np.average(np.broadcast_to(place, light.shape), weights=light)
            spread = np.average((scale * (place - mean)) ** 2 + 0 * light, weights=light)
            assert spread == pytest.approx(radius**2 / 4, rel=0.1)
