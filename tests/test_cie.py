"""The CIE standard general sky, the sun's disc in it, and where the sun stands."""

import datetime
import sys

import numpy as np
import pytest

import skylamp as sl
from skylamp import sources
from skylamp.app import cli
from skylamp.sources import cie as skies

FLAT = sl.Scene(np.full((5, 6), 3.0), albedo=1.0)
# Zenith luminance over diffuse horizontal illuminance, (B sin^C g / cos^D g + E sin g) / (133.8 sin g) for a
# sun at elevation g: B, C, D, E as Kittler, Perez and Darula published them with the fifteen types
PUBLISHED = {
    1: (54.63, 1, 0, 0), 2: (12.35, 3.68, 0.59, 50.47), 3: (48.30, 1, 0, 0),
    4: (12.23, 3.57, 0.57, 44.27), 5: (42.59, 1, 0, 0), 6: (11.84, 3.53, 0.55, 38.78),
    7: (21.72, 4.52, 0.64, 34.56), 8: (29.35, 4.94, 0.70, 30.41), 9: (10.34, 3.45, 0.50, 27.47),
    10: (18.41, 4.27, 0.63, 24.04), 11: (24.41, 4.60, 0.72, 20.76), 12: (23.00, 4.43, 0.74, 18.52),
    13: (27.45, 4.61, 0.76, 16.59), 14: (25.54, 4.40, 0.79, 14.56), 15: (28.08, 4.13, 0.79, 13.23),
}  # fmt: skip


def integral(brightness, n=600):
    """Irradiance of level ground by the midpoint rule in elevation and azimuth, without the library."""
    e = np.pi / 2 * (np.arange(n) + 0.5) / n
    a = 2 * np.pi * (np.arange(2 * n) + 0.5) / (2 * n)
    L = np.stack(
        [
            np.cos(e) * np.cos(a[:, None]),
            np.cos(e) * np.sin(a[:, None]),
            np.broadcast_to(-np.sin(e), (2 * n, n)),
        ],
        -1,
    )
    return (brightness(L) * np.sin(e) * np.cos(e)).sum() * (np.pi / n) * (np.pi / 2 / n)


@pytest.mark.slow
@pytest.mark.parametrize("type", range(1, 16))
def test_horizontal_illuminance(type, fast):
    """The published fit of the types to 5 %, a converged integral to 1e-4, a render to 1e-3."""
    for elevation in (20, 40, 60):
        sky = sl.cie_sky(type, (123, elevation))
        B, C, D, E = PUBLISHED[type]
        sine, cosine = np.sin(np.radians(elevation)), np.cos(np.radians(elevation))
        assert sky.horizontal() * (B * sine**C / cosine**D + E * sine) / (133.8 * sine) == pytest.approx(
            1, rel=0.05
        )
    assert sky.horizontal() == pytest.approx(integral(sky), rel=1e-4)
    image = sl.render(
        FLAT,
        sl.Sky(sl.cie_sky(type, (123, 60), horizontal=7.0)),
        quantity="irradiance",
        azimuths=64,
        backend=fast,
    ).image
    np.testing.assert_allclose(image, 7.0, rtol=1e-3)


def test_types_by_hand():
    """Numbers worked out from the standard's formula: types 1, 5 and 12, and the named skies."""
    up, level = np.array([0.0, 0, -1]), np.array([1.0, 0, -1e-12])
    assert sl.cie_sky(1)(level) == pytest.approx(1 / (1 + 4 * np.exp(-0.7)))
    assert sl.cie_sky(5, zenith=3.0)(np.array([up, level, -up])).tolist() == [3, 3, 0]  # no light from below
    clear = sl.cie_clear((90, 30), zenith=2.0)
    assert clear == sl.cie_sky(12, (90, 30), zenith=2.0) and sl.cie_clear((90, 30), turbid=True).type == 13
    assert clear(up) == pytest.approx(2.0)
    towards, away = (
        np.array([x * np.cos(np.pi / 6), 0, -0.5]) for x in (1, -1)
    )  # the sun in the east is on the side of +x
    assert clear(towards) / clear(away) == pytest.approx(
        10.909, rel=1e-3
    )  # f(0) / f(120 degrees) = 11.360 / 1.0413


@pytest.mark.parametrize("sun", [(0, 20), (90, 20), (200, 45)])
def test_sun_side(sun, fast):
    """The clear sky is brightest at the sun, alike on both sides of it, and slopes that face it get more."""
    sky = sl.cie_clear(sun)
    a = np.radians(sun[0] + np.arange(-180, 180))
    around = sky(
        np.stack([np.sin(a), -np.cos(a), np.full(360, -np.tan(np.radians(sun[1])))], -1)
        * np.cos(np.radians(sun[1]))
    )
    assert around.argmax() == 180
    np.testing.assert_allclose(around[1:180], around[:180:-1], rtol=1e-9)
    y, x = np.mgrid[:9, :9] * 0.6
    light = lambda rise: sl.render(
        sl.Scene.from_height(rise - rise.min()), sl.Sky(sky), quantity="irradiance", backend=fast
    ).image[4, 4]
    east, south = np.sin(np.radians(sun[0])), -np.cos(np.radians(sun[0]))
    falls_towards_sun, rises = -(x * east + y * south), x * east + y * south
    assert light(falls_towards_sun) > 1.5 * light(rises)


@pytest.mark.parametrize("elevation", [1, 25, 85, 90])
def test_disc_has_its_irradiance(elevation, fast):
    """direct x sin(elevation) on level ground, at any azimuth, plus the sky's light; twice for two."""
    for azimuth in (0, 123.4):
        sky = sl.cie_clear((azimuth, elevation), horizontal=1.0, direct=10.0)
        image = sl.render(FLAT, sl.Sky(sky), azimuths=64, quantity="irradiance", backend=fast).image
        np.testing.assert_allclose(image, 1 + 10 * np.sin(np.radians(elevation)), rtol=2e-3)


def test_disc_has_its_size(fast):
    """Behind a wall 300 high, the shadow of a sun at 45 degrees ends at 300, over a penumbra."""
    depth = np.full((15, 460), 300.0)  # rows enough that no ray passes the wall beside the map
    depth[:, :101] = 0  # a step: its edge stands at column 100; the sun is in the west
    sky = sl.cie_sky(5, (270, 45), zenith=0.0, direct=np.sqrt(2))
    light = sl.render(sl.Scene(depth), sl.Sky(sky), quantity="irradiance", backend=fast).image[7, 300:]
    half = 300 * 2 * np.sin(np.radians(0.2665))
    x = np.arange(300, 460) - 400
    assert light[x < -half - 1].max() < 1e-9 and light[x > half + 1] == pytest.approx(1, abs=2e-3)
    t = np.clip(-x / half, -1, 1)
    np.testing.assert_allclose(
        light, (np.arccos(t) - t * np.sqrt(1 - t * t)) / np.pi, atol=0.02
    )  # what a chord leaves of a disc


def test_disc_over_walls(fast):
    """In a dark box 10 deep, the east wall shadows 10 nodes under a sun at 45 degrees in the east."""
    sky = sl.Sky(sl.cie_sky(5, (90, 45), zenith=0.0, direct=np.sqrt(2)))
    light = sl.render(
        sl.Scene(np.full((9, 30), 10.0), sides="dark"), sky, quantity="irradiance", backend=fast
    ).image[4]
    np.testing.assert_allclose(light, np.where(np.arange(30) + 10 < 29.5, 1.0, 0.0), atol=2e-3)


def test_disc_beside_a_mask(fast):
    """Masked nodes stay nan, radiance is rho E / pi of both parts."""
    mask = np.ones((5, 6), bool)
    mask[2, 3] = False
    sky = sl.Sky(sl.cie_clear((10, 50), direct=3.0))
    radiance, irradiance = (
        sl.render(sl.Scene(np.full((5, 6), 3.0), mask=mask, albedo=0.5), sky, quantity=q, backend=fast).image
        for q in ("radiance", "irradiance")
    )
    assert np.isnan(radiance[2, 3]) and np.isfinite(radiance[mask]).all()
    np.testing.assert_allclose(radiance[mask], irradiance[mask] * 0.5 / np.pi, rtol=1e-6)


def test_disc_that_nothing_is_said_to_hide(fast):
    """method="unoccluded": a wall before the sun hides neither sky nor disc; the floor has all of both."""
    depth = np.full((24, 24), 40.0)
    depth[:, 12] = 5.0
    sky = sl.cie_clear((90, 30), direct=3.0)
    free, hidden = (
        sl.render(sl.Scene(depth), sl.Sky(sky), method, backend=fast, quantity="irradiance").image[12, 4]
        for method in ("unoccluded", "horizon")
    )
    assert free == pytest.approx(sky.horizontal() + 3.0 * np.sin(np.radians(30)), rel=2e-3)
    assert hidden < 0.6 * free


def test_disc_where_it_would_be_lost(fast):
    """Lattice, carving, and explicit azimuths of periodic or limited maps refuse the disc."""
    sky = sl.cie_clear((10, 50), direct=3.0)
    for work in (
        lambda: sl.render(FLAT, sl.Sky(sky), method="lattice", backend=fast),
        lambda: sl.recover(np.ones((4, 4)), sl.Sky(sky), backend=fast),
        lambda: sl.render(FLAT, sl.Window(x=(0, 3), y=(0, 3), brightness=sky), backend=fast),
    ):
        with pytest.raises(sl.InputError, match=r"sun's disc \(direct\).*by default, or by 'horizon'"):
            work()
    with pytest.raises(sl.InputError, match="sides='periodic'"):
        sl.render(sl.Scene(np.ones((4, 4)), sides="periodic"), sl.Sky(sky), method="horizon", backend=fast)
    with pytest.raises(sl.InputError, match="max_distance=2"):
        sl.render(FLAT, sl.Sky(sky), max_distance=2, backend=fast)


@pytest.mark.parametrize(
    "make, says",
    [
        (lambda: sl.cie_sky(0), "type: got 0; allowed: a whole number from 1 to 15"),
        (lambda: sl.cie_sky(True), "type"),
        (lambda: sl.cie_sky(12), "type 12: got no sun"),
        (lambda: sl.cie_sky(5, direct=1.0), "with direct: got no sun"),
        (lambda: sl.cie_sky(12, (10, -1)), "elevation 0 to 90"),
        (lambda: sl.cie_sky(12, (10,)), "elevation 0 to 90"),
        (lambda: sl.cie_sky(12, (np.nan, 10)), "elevation 0 to 90"),
        (lambda: sl.cie_sky(12, (10, 20), 1.0, horizontal=2.0), "one of the two"),
        (lambda: sl.cie_sky(12, (10, 20), -1.0), "brightness: got -1.0"),
        (lambda: sl.cie_sky(12, (10, 20), direct="much"), "direct: brightness: got 'much'"),
        (lambda: sl.cie_sky(12, (10, 20), horizontal=-1), "horizontal: brightness: got -1.0"),
        (lambda: sl.sun_position("2026-06-21T12:00", 0, 0), "time without a zone"),
        (lambda: sl.sun_position("noon", 0, 0), "ISO 8601"),
        (lambda: sl.sun_position("2026-06-21T12:00Z", 91, 0), "latitude -90 to 90"),
        (lambda: sl.sun_position("2026-06-21T12:00Z", "here", 0), "latitude -90 to 90"),
        (lambda: sl.sun_position("2026-06-21T12:00Z", 46.5, 8, 50_000), "altitude -1,000 to 10,000"),
        (lambda: sl.sun_position(datetime.time(12, tzinfo=datetime.UTC), 46.5, 8), "ISO 8601"),
    ],
)
def test_bad_arguments(make, says):
    """One clear error each."""
    with pytest.raises(sl.InputError) as caught:
        make()
    assert says in str(caught.value)


def test_sun_position():
    """Greenwich, noon of the solstice: in the south, 90 - 51.48 + 23.44 high; the same in another zone."""
    azimuth, elevation = sl.sun_position("2026-06-21T12:02:00Z", 51.48, 0)
    assert azimuth == pytest.approx(180, abs=1) and elevation == pytest.approx(61.96, abs=0.05)
    there = datetime.datetime(2026, 6, 21, 14, 2, tzinfo=datetime.timezone(datetime.timedelta(hours=2)))
    assert sl.sun_position(there, 51.48, 0) == (azimuth, elevation)
    assert sl.sun_position("2026-03-20T06:30Z", 0, 0)[0] == pytest.approx(90, abs=1)  # rises in the east


def test_without_pvlib(monkeypatch):
    """The error names the pip command."""
    monkeypatch.setitem(sys.modules, "pvlib", None)
    with pytest.raises(
        sl.InputError, match=r"sun_position needs pvlib, which is not installed: pip install 'skylamp\[sun\]'"
    ):
        skies.sun_position("2026-06-21T12:00Z", 0, 0)


def test_command_line(tmp_path, capsys, fast):
    """--source clear and cie1 to cie15, the sun by angles or by time and place; conflicts are refused."""
    np.save(tmp_path / "d.npy", FLAT.depth)

    def run(*options):
        with pytest.raises(SystemExit) as ended:
            cli.main(
                [
                    "render",
                    str(tmp_path / "d.npy"),
                    "--out",
                    str(tmp_path / "a.npy"),
                    "--backend",
                    fast,
                    "--albedo",
                    "1",
                    *options,
                ]
            )
        return ended.value.code or 0, capsys.readouterr().err

    position = sl.sun_position("2026-06-21T12:00Z", 51.48, 0)
    for options, sky in (
        (("--source", "clear", "--sun", "120,30"), sl.cie_clear((120, 30))),
        (("--source", "cie3"), sl.cie_sky(3)),
        (
            ("--source", "cie13", "--sun", "120,30", "--direct", "2.5"),
            sl.cie_clear((120, 30), turbid=True, direct=2.5),
        ),
        (("--source", "clear", "--sun", "2026-06-21T12:00Z,51.48,0"), sl.cie_clear(position)),
    ):
        assert run(*options)[0] == 0
        np.testing.assert_array_equal(
            np.load(tmp_path / "a.npy"), sl.render(FLAT, sl.Sky(sky), backend=fast).image
        )
    for code, says, options in (
        (3, "got no sun", ("--source", "clear")),
        (3, "Give --sun AZ,EL or --sun TIME,LAT,LON.", ("--source", "clear")),
        (3, "from 1 to 15", ("--source", "cie16", "--sun", "1,2")),
        (2, "AZ,EL", ("--source", "clear", "--sun", "1")),
        (2, "clear or cie1 to cie15", ("--source", "overcast", "--sun", "1,2")),
        (2, "--direct", ("--source", "sky", "--direct", "1")),
        (3, "below the horizon", ("--source", "clear", "--sun", "2026-06-21T00:00Z,51.48,0")),
        (3, "without a zone", ("--source", "clear", "--sun", "2026-06-21T00:00,51.48,0")),
    ):
        got, err = run(*options)
        assert got == code and says in err, (options, err)


def test_a_sky_without_its_disc_keeps_named_features():
    """Only the disc goes; the directions that the caller named stay."""
    sky = sl.Sky(sl.cie_clear((180, 40), direct=1.0), suns=[(0, 0, -1)])
    without = sources.without_disc(sky)
    assert without.brightness.direct == 0 and len(without.suns) == 1
