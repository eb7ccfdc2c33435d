"""DataArrays whose rows run north, or whose columns run west, are lit as the same map in the usual order."""

import dataclasses

import numpy as np
import pytest

import skylamp as sl
from skylamp.sources import on_axes
from skylamp.sources.brightness import distribution

xr = pytest.importorskip("xarray")

ORDERS = [(1, 1), (-1, 1), (1, -1), (-1, -1)]  # steps through rows and columns of the usual order
SUN = 150.0, 25.0  # azimuth from north and elevation [degree]: in the south, and a little east


@pytest.fixture(scope="module")
def dem():
    """Hills, north up and west first, in metres."""
    y, x = np.mgrid[:28, :36]
    heights = 60 * np.sin(x / 5.0 + 0.3 * y) * np.cos(y / 4.0) + 40 * np.exp(-((x - 20) ** 2 + y**2) / 60)
    coordinates = {"y": 4000.0 - 30 * np.arange(28), "x": 500.0 + 30 * np.arange(36)}
    return xr.DataArray(heights.astype(np.float32), coordinates, ("y", "x"))


def panorama(cols):
    """An environment map that is bright in the south-south-east."""
    rng = np.random.default_rng(3)
    image = rng.random((16, cols)) / 2
    image[5:8, cols // 5] = 30
    return sl.environment_map(image)


SKIES = {
    "sun": sl.Sky(sl.cie_clear(SUN, direct=3.0)),
    "map": sl.Sky(panorama(64)),
    "map of an odd number of columns": sl.Sky(panorama(63)),
    "colours": sl.Sky(lambda L: np.maximum(L[..., 1:2], 0) * [1.0, 0.5, 0.2] + 0.1),
    "a named sun": sl.Sky(
        lambda L: 0.2 + 5e3 * (L @ [0.3, 0.8, -0.52] > 0.99995 * np.sqrt(1.0004)), suns=[(0.3, 0.8, -0.52)]
    ),
}


def alike(found, expected, share):
    """The same coordinates in the order of ``found``, and values to a share of their mean."""
    like = expected.sel(y=found.y, x=found.x)
    assert found.dims == expected.dims and found.coords.keys() == expected.coords.keys()
    off = np.sqrt(np.mean((found.values - like.values) ** 2)) / np.abs(like.values).mean()
    assert off < share, off


@pytest.mark.slow
@pytest.mark.parametrize(
    "sky", [pytest.param(sky, marks=pytest.mark.slow) if sky == "colours" else sky for sky in SKIES]
)
def test_skies_light_each_order_alike(dem, fast, sky):
    """Suns, environment maps, functions and named suns: north is where y grows, east where x does."""
    options = dict(backend=fast, azimuths=32, quantity="irradiance")
    expected = sl.render(sl.Scene.from_height(dem), SKIES[sky], **options).image
    for order in ORDERS[1:]:
        turned = dem[:: order[0], :: order[1]]
        found = sl.render(sl.Scene.from_height(turned), SKIES[sky], **options).image
        assert found.y.identical(turned.y) and found.x.identical(turned.x)
        alike(found, expected, 0.004)


def test_a_southern_slope_faces_a_southern_sun(fast):
    """By hand: of a ridge from west to east, the side with the smaller y is lit by a sun in the south."""
    y = np.arange(20.0)
    ridge = xr.DataArray(np.broadcast_to(-np.abs(y[:, None] - 10), (20, 12)), {"y": y}, ("y", "x"))
    sun = sl.Sky(sl.cie_sky(5, (180.0, 20.0), direct=50.0))
    for dem in (ridge, ridge[::-1]):
        image = sl.render(sl.Scene.from_height(dem), sun, azimuths=16, backend=fast).image
        assert float(image.sel(y=4)[6]) > 5 * float(image.sel(y=16)[6])
    west = xr.DataArray(ridge.values.T, {"y": -np.arange(12.0), "x": y}, ("y", "x"))
    sun = sl.Sky(sl.cie_sky(5, (90.0, 20.0), direct=50.0))
    for dem in (west, west[:, ::-1]):
        image = sl.render(sl.Scene.from_height(dem), sun, azimuths=16, backend=fast).image
        assert float(image.sel(x=16)[6]) > 5 * float(image.sel(x=4)[6])


@pytest.mark.parametrize("order", ORDERS[1:])
@pytest.mark.parametrize("chunks", [None, 13])
def test_horizons_of_each_order(dem, fast, order, chunks):
    """Azimuths count from east to south; sky-view factors and openness are those of the same nodes."""
    turned = dem[:: order[0], :: order[1]]
    if chunks:
        pytest.importorskip("dask.array")
        turned = turned.chunk(chunks)
    expected, found = (sl.horizons(heights, azimuths=12, backend=fast) for heights in (dem, turned))
    assert found.azimuth.identical(expected.azimuth) and found.y.identical(turned.y)
    like = expected.sel(y=found.y, x=found.x).values
    there = np.isfinite(like)
    np.testing.assert_array_equal(np.isfinite(found.values), there)
    np.testing.assert_allclose(found.values[there], like[there], atol=0.02)
    uneven = sl.Azimuths(5, (0, 0.5, 1.5, 3, 5, 2 * np.pi))
    for work in (sl.sky_view_factor, sl.openness):
        alike(work(turned, azimuths=uneven, backend=fast), work(dem, azimuths=uneven, backend=fast), 0.004)


def test_a_lazy_map_of_each_order_is_rendered(dem, fast):
    """In the input's chunks, and with the light of the same map in the usual order."""
    pytest.importorskip("dask.array")
    options = dict(backend=fast, azimuths=16, quantity="irradiance", tiling=sl.Tiling(16, 8, 8))
    expected = sl.render(sl.Scene.from_height(dem.chunk(10)), SKIES["sun"], **options).image
    turned = dem[::-1].chunk({"y": (5, 23), "x": 36})
    found = sl.render(sl.Scene.from_height(turned), SKIES["sun"], **options).image
    assert found.chunks == turned.chunks
    alike(found.compute(), expected.compute(), 0.02)


@pytest.mark.slow
def test_plans_and_windows_and_lamps(dem, fast):
    """The sky behind a window is turned; lamps and windows stand where rows and columns say."""
    turned = dem[::-1]
    rows = dem.shape[0] * 30.0
    usual, mirrored = sl.Scene.from_height(dem), sl.Scene.from_height(turned)
    sky = sl.cie_clear(SUN)
    window = sl.Window(x=(200, 800), y=(300.0, 700.0), brightness=sky)
    there = sl.Window(x=(200, 800), y=(rows - 730.0, rows - 330.0), brightness=sky)
    options = dict(backend=fast, azimuths=32, quantity="irradiance")
    alike(sl.render(mirrored, there, **options).image, sl.render(usual, window, **options).image, 0.02)
    lamps = [sl.Lamp(center=(500.0, at, -200.0), radius=40.0) for at in (240.0, rows - 30 - 240.0)]
    alike(sl.render(mirrored, lamps[1], **options).image, sl.render(usual, lamps[0], **options).image, 0.01)
    plans = [sl.plan(scene, SKIES["sun"], backend=fast) for scene in (usual, mirrored)]
    assert plans[1].interreflection == pytest.approx(plans[0].interreflection, rel=0.1)


@pytest.mark.slow
def test_recover_takes_light_from_where_it_comes(dem, fast):
    """The same depth from an image in each order, under a sky that is bright in the south."""
    sky = sl.Sky(lambda L: 0.3 + np.maximum(L[..., 1], 0) ** 2)
    small = dem[:16, :16]
    image = sl.render(sl.Scene.from_height(small), sky, backend=fast, interreflection=False).image
    options = dict(layers=8, spacing=30.0, backend=fast, interreflection=False)
    expected, found = (sl.recover(picture, sky, **options).depth for picture in (image, image[::-1]))
    alike(found, expected, 0.1)


def test_what_a_mirrored_brightness_tells():
    """Its disc, its named features and its map are where its own values are."""
    for axes in ((-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        sun = distribution(on_axes(SKIES["sun"], axes).brightness)
        toward = np.array(sun.disc().direction)
        assert np.allclose(toward * [*axes, 1], distribution(SKIES["sun"].brightness).disc().direction)
        assert np.allclose(sun.narrow(), [toward]) and sun.without_disc().disc() is None
        painted = distribution(on_axes(SKIES["map"], axes).brightness)
        around = np.random.default_rng(0).normal(size=(50, 3))
        around /= np.linalg.norm(around, axis=1)[:, None]
        again = sl.environment_map(painted.equirectangular())
        np.testing.assert_allclose(again(around), painted(around), rtol=1e-9, atol=1e-9)
        assert on_axes(SKIES["a named sun"], axes).suns[0] == (0.3 * axes[0], 0.8 * axes[1], -0.52)
    odd = distribution(on_axes(SKIES["map of an odd number of columns"], (-1.0, 1.0)).brightness)
    assert odd.equirectangular() is None


def test_rows_along_x_are_refused(dem):
    """A map whose rows are x would be lit mirrored."""
    with pytest.raises(sl.InputError, match="transpose"):
        sl.Scene.from_height(dem.transpose("x", "y"))


@pytest.mark.slow
@pytest.mark.parametrize("azimuths", [5, sl.Azimuths(3, (0.0, np.pi / 6, np.pi / 2, 2 * np.pi))])
def test_sectors_lie_the_same_way_in_each_order(dem, fast, azimuths):
    """An odd number of azimuths, or uneven ones, of a method that is asked for, whole and in tiles."""
    sky = sl.Sky(lambda L: 2 + L[..., 0] + 0.5 * L[..., 1])
    options = dict(backend=fast, azimuths=azimuths, quantity="irradiance", interreflection=False)
    for more in ({}, {"tiling": sl.Tiling(16, 4, 4)}):
        expected = sl.render(sl.Scene.from_height(dem), sky, **options, **more).image
        for order in ORDERS[1:]:
            turned = dem[:: order[0], :: order[1]]
            alike(sl.render(sl.Scene.from_height(turned), sky, **options, **more).image, expected, 3e-3)


REFLECTANCES = {
    "grooves": lambda dem: sl.grooves(),
    "phong": lambda dem: sl.Phong(0.3 + 0.002 * dem, 0.3, 20),
}


@pytest.mark.slow
@pytest.mark.parametrize("surface", REFLECTANCES)
def test_surfaces_reflect_the_same_way_in_each_order(dem, fast, surface):
    """The frame of a BRDF lies east and south, maps of reflectance where their coordinates are."""
    sky = sl.Sky(lambda L: 0.1 + 3 * np.maximum(0, -L[..., 0]) ** 2)
    reflectance, options = REFLECTANCES[surface], dict(backend=fast, azimuths=24)
    expected = sl.render(sl.Scene.from_height(dem, reflectance=reflectance(dem)), sky, **options).image
    for order in ORDERS[1:]:
        turned = dem[:: order[0], :: order[1]]
        scene = sl.Scene.from_height(turned, reflectance=reflectance(turned))
        alike(sl.render(scene, sky, **options).image, expected, 2e-3)


@pytest.mark.parametrize(
    "make",
    [
        lambda dem: sl.Scene.from_height(dem[::-1], reflectance=sl.Lambertian(dem * 0 + 0.5)),
        lambda dem: sl.Scene.from_height(dem[:, ::-1], reflectance=sl.Mirror(dem * 0 + 0.5)),
        lambda dem: sl.render(
            sl.Scene.from_height(dem[::-1]), sl.Window(aperture=dem > 0), method="lattice", hemicube=3
        ),
        lambda dem: sl.plan(sl.Scene.from_height(dem[::-1]), sl.Window(aperture=dem > 0)),
        lambda dem: sl.render(  # these are replaced by lights of other brightness before they are used
            sl.Scene.from_height(dem[:, ::-1]),
            sl.Window(aperture=dem > 0, brightness=lambda L: 1 + L[..., 2] ** 2),
            method="lattice",
            hemicube=3,
        ),
        lambda dem: sl.visibility(sl.Scene.from_height(dem[::-1]), sl.Window(aperture=dem > 0), 3),
        lambda dem: sl.render(
            sl.Scene.from_height(dem[:, ::-1]),
            sl.Lamp(volume=(dem > 0).expand_dims(layer=3)),
            method="lattice",
            hemicube=3,
        ),
    ],
)
def test_maps_of_reflectance_and_light_lie_on_the_scene(dem, make):
    """A DataArray whose coordinates run the other way is refused, as an albedo or a mask is."""
    with pytest.raises(sl.InputError, match=r"(albedo|specular|aperture|volume): coordinate '[xy]'"):
        make(dem)


def test_sectors_by_brightness_lie_the_same_way_in_each_order(dem, fast):
    """Few azimuths under a sky with a sun's glow begin in the east, not in the first column."""
    sky = sl.Sky(sl.cie_clear((150.0, 25.0)))
    options = dict(backend=fast, azimuths=7, quantity="irradiance", interreflection=False)
    expected = sl.render(sl.Scene.from_height(dem), sky, **options).image
    for order in ORDERS[1:]:
        turned = dem[:: order[0], :: order[1]]
        alike(sl.render(sl.Scene.from_height(turned), sky, **options).image, expected, 3e-3)


def test_a_scene_with_a_field_replaced_keeps_its_north(dem, fast):
    """And its coordinates, and a node of depth 0 where the attributes say that a height of 0 is no data."""
    up = dem[::-1].assign_attrs(nodata=0.0)
    scene = sl.Scene.from_height(up)
    again = dataclasses.replace(scene, sides="dark")
    assert again.axes == scene.axes == (1.0, -1.0) != sl.Scene.from_height(dem).axes
    assert again.mask is None and again.depth.min() == 0
    light = SKIES["sun"], dict(backend=fast, azimuths=16)
    image, wanted = (
        sl.render(one, light[0], **light[1]).image for one in (again, sl.Scene.from_height(up, sides="dark"))
    )
    xr.testing.assert_identical(image, wanted)
    with pytest.raises(sl.InputError, match="labels: got those of another map"):
        dataclasses.replace(scene, depth=scene.depth[2:])
    assert dataclasses.replace(scene, depth=scene.depth[2:], labels=None).labels is None


def test_the_zenith_of_a_map_is_one_place():
    """Also where a mirrored direction has a zero with a sign."""
    image = np.ones((8, 16))
    image[0, :4] = 3
    light = sl.environment_map(image)
    zeros = [np.array([x, y, -1.0]) for x in (0.0, -0.0) for y in (0.0, -0.0)]
    assert len({float(light(L)) for L in zeros}) == 1


def test_normals():
    """Of a tilted plane by hand, in the axes of a map and of a DataArray; masked nodes are nan; periodic."""
    y, x = np.mgrid[:5, :6]
    depth = 1 + 2.0 * x + 3 * y  # dz/dx = 1, dz/dy = 1.5 at a spacing of 2
    expected = np.array([1, 1.5, -1]) / np.sqrt(4.25)
    mask = x > 0
    found = sl.normals(sl.Scene(depth, 2.0, mask=mask))
    assert found.dtype == np.float32 and np.isnan(found[:, 0]).all()
    np.testing.assert_allclose(found[mask], np.broadcast_to(expected, (25, 3)), atol=1e-6)
    coordinates = {"y": -2.0 * np.arange(5), "x": 2.0 * np.arange(6)}
    south = xr.DataArray(50 - depth, coordinates, ("y", "x"), attrs={"units": "m"})
    for height in (south, south[::-1], south[:, ::-1]):
        given = sl.normals(sl.Scene.from_height(height))
        assert given.dims == ("y", "x", "component") and given.component.values.tolist() == ["x", "y", "z"]
        np.testing.assert_allclose(given.values, np.broadcast_to(expected, (5, 6, 3)), atol=1e-6)
    wave = 2 + np.sin(np.arange(6) * np.pi / 3)[None] + np.zeros((5, 1))
    rise = np.sin(np.pi / 3)
    repeats = sl.normals(sl.Scene(wave, sides="periodic"))[0, 0]
    np.testing.assert_allclose(repeats, np.array([rise, 0, -1]) / np.hypot(rise, 1), atol=1e-6)
    with pytest.raises(sl.InputError, match="scene: got ndarray"):
        sl.normals(depth)
    taken = south.rename(x="component")
    with pytest.raises(sl.InputError, match="names of a DataArray: got component"):
        sl.normals(sl.Scene.from_height(taken))
    assert sl.normals(sl.Scene.from_height(south.assign_coords(channel=3))).dims[2] == "component"
