"""Maps in tiles: lazily on Dask and in memory. The same bytes however a map is cut."""

import os
import pickle
import re
import time
import warnings
import weakref

import numpy as np
import pytest
from compare import assert_bits_equal

import skylamp as sl
from skylamp import constants
from skylamp.backends import base, select
from skylamp.errors import InputError
from skylamp.light.sweeps import NEAR_ROWS
from skylamp.planning.sky import CLIFF_NEAR_ROWS
from skylamp.scale import MOST_MARGIN

da = pytest.importorskip("dask.array")
xr = pytest.importorskip("xarray")
dask = pytest.importorskip("dask")

SPACING = 30.0
SMALL = sl.Tiling(tile=64, halo=16, rule=8)  # tiles of some hundred nodes, for maps of some thousand


def mountains(rows, cols, relief, seed=1, roughness=1.85):
    """Fractal heights [nodes] float32; the spectrum falls off with frequency^roughness."""
    size = 1 << (max(rows, cols) - 1).bit_length()
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    frequency[0, 0] = 1
    waves = rng.normal(size=(2, *frequency.shape))
    spectrum = (waves[0] + 1j * waves[1]) * frequency**-roughness
    spectrum[0, 0] = 0
    heights = np.fft.irfft2(spectrum, s=(size, size))[:rows, :cols]
    return (relief * (heights - heights.min()) / np.ptp(heights)).astype(np.float32)


@pytest.fixture(scope="module")
def dem():
    """Mountains as rioxarray reads them: coordinates in metres, a CRS, attributes, a name."""
    return xr.DataArray(
        SPACING * mountains(230, 290, 25),
        {"y": 4000.0 - SPACING * np.arange(230), "x": 500.0 + SPACING * np.arange(290), "spatial_ref": 0},
        ("y", "x"),
        "elevation",
        {"units": "m", "_FillValue": -9999},
    )


def svf(heights, fast, tiling=SMALL, **options):
    return sl.sky_view_factor(
        sl.Scene.from_height(heights, sides=options.pop("sides", "open")),
        azimuths=8,
        backend=fast,
        tiling=tiling,
        **options,
    )


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


def test_a_lazy_map_gives_a_lazy_one_like_it(dem, fast):
    """Dimensions, chunks, coordinates, name and attributes are the map's, and nothing of it is computed."""

    def never(block):
        pytest.fail("a chunk was computed")

    chunks = ((100, 130), (290,))
    lazy = dem.copy(
        data=da.map_blocks(
            never,
            dem.chunk(dict(zip(dem.dims, chunks))).data,
            dtype=np.float32,
            meta=np.empty((0, 0), np.float32),
        )
    )
    scene = sl.Scene.from_height(lazy)
    assert scene.spacing == SPACING and scene.shape == dem.shape and "lazy" not in repr(scene.labels)
    for found, name, units in (
        (sl.sky_view_factor(scene, azimuths=8, backend=fast, tiling=SMALL), "sky_view_factor", "1"),
        (
            sl.openness(scene, azimuths=8, backend=fast, tiling=SMALL, negative=True),
            "negative_openness",
            "rad",
        ),
        (sl.sky_view_factor(scene, azimuths=8, backend=fast), "sky_view_factor", "1"),
    ):
        assert (found.dims, found.chunks, found.dtype) == (lazy.dims, chunks, np.float32)
        assert (found.name, found.attrs["units"]) == (name, units) and "_FillValue" not in found.attrs
        assert all(found.coords[name].identical(lazy.coords[name]) for name in lazy.coords)
    slopes = sl.horizons(scene, azimuths=8, backend=fast, tiling=SMALL)
    assert slopes.dims == ("azimuth", "y", "x") and slopes.chunks[1:] == chunks and slopes.shape[0] == 8


def test_a_dataarray_of_heights_stands_for_its_scene(dem, fast):
    """Lazy or not, with the spacing of its coordinates."""
    small = dem[:110, :140]
    for heights in (small, small.chunk(y=50)):
        for work in (sl.sky_view_factor, sl.openness, sl.horizons):
            found = work(heights, azimuths=4, backend=fast, tiling=SMALL)
            expected = work(sl.Scene.from_height(heights, SPACING), azimuths=4, backend=fast, tiling=SMALL)
            assert found.chunks == expected.chunks
            assert_bits_equal(np.nan_to_num(found.values), np.nan_to_num(expected.values))


def test_a_coordinate_reference_system_stays(dem, fast):
    """What rioxarray reads of the map it reads of the result."""
    pytest.importorskip("rioxarray")
    found = svf(dem.rio.write_crs(32633).chunk(), fast)
    assert found.rio.crs.to_epsg() == 32633 and found.rio.transform() == dem.rio.transform()


@pytest.mark.parametrize(
    "chunks",
    [
        (64, 64),
        pytest.param((230, 290), marks=pytest.mark.slow),
        pytest.param((50, 290), marks=pytest.mark.slow),
        pytest.param((10, 130), marks=pytest.mark.slow),
        ((3, 200, 27), (100, 1, 189)),
    ],
    ids=str,
)
def test_bytes_do_not_depend_on_chunks(dem, fast, chunks):
    """Tiles as chunks, one chunk, one chunk wide, chunks smaller than the halo, unequal ones."""
    expected = svf(dem.chunk({"y": 100, "x": 100}), fast).compute(scheduler="sync")
    found = svf(dem.chunk(dict(zip(dem.dims, chunks))), fast).compute(scheduler="sync")
    assert_bits_equal(found.values, expected.values)


@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_bytes_of_gaps_and_of_maps_that_repeat_do_not_depend_on_chunks(fast, sides):
    """Gaps across seams; chunks of one row, one chunk wide, unequal ones, smaller than the halo."""
    heights = mountains(130, 140, 20)
    heights[50:70, 60:140] = heights[128] = np.nan
    found = [
        svf(da.from_array(heights, chunks=chunks), fast, sides=sides).compute(scheduler="sync")
        for chunks in (64, (130, 9), ((1, 100, 29), 140))
    ]
    assert np.array_equal(np.isnan(found[0]), np.isnan(heights))
    for other in found[1:]:
        assert_bits_equal(np.nan_to_num(other), np.nan_to_num(found[0]))


def test_renders_of_lazy_maps_compute_nothing(dem, fast):
    """Neither heights nor a map of the albedo, whatever the light between surfaces; coordinates stay."""

    def never(block):
        pytest.fail("a chunk was computed")

    kind = dict(dtype=np.float32, meta=np.empty((0, 0), np.float32))
    heights, albedo = (da.map_blocks(never, da.zeros(dem.shape, chunks=n), **kind) for n in (100, 70))
    scene = sl.Scene.from_height(dem.copy(data=heights), albedo=albedo)
    for source, options in (
        (sl.Sky(), {}),
        (sl.Sky(sl.cie_clear((135.0, 30.0), direct=4.0)), dict(interreflection=True)),
        (sl.Sky((1.0, 2.0, 3.0)), dict(azimuths=8)),
        (sl.Lamp(center=(3000, 3000, -100), radius=20), dict(max_distance=600.0)),
    ):
        image = sl.render(scene, source, backend=fast, tiling=SMALL, **options).image
        assert image.dims[:2] == ("y", "x") and image.chunks[:2] == heights.chunks
        assert all(image.coords[name].identical(dem.coords[name]) for name in dem.coords)


def test_bytes_do_not_depend_on_schedulers(dem, fast):
    """One thread, four threads, a part of the map computed alone."""
    lazy = svf(dem.chunk({"y": 100, "x": 100}), fast)
    expected = lazy.compute(scheduler="sync").values
    assert_bits_equal(lazy.compute(scheduler="threads", num_workers=4).values, expected)
    assert_bits_equal(lazy[100:170, 60:80].compute(scheduler="sync").values, expected[100:170, 60:80])


@pytest.mark.slow
def test_tiles_in_memory_are_those_of_a_lazy_map(dem, fast):
    """A map at once, its tiles one by one, and lazily: the same but for roundings of heights."""
    for work, limit in (
        (sl.sky_view_factor, 1e-3),
        (sl.openness, 3e-3),
        (sl.horizons, 8e-3),
        (lambda scene, **o: sl.sky_view_factor(scene, "solid_angle", **o), 1e-3),
        (lambda scene, **o: sl.sky_view_factor(scene, max_distance=10 * SPACING, **o), 2e-4),
        (lambda scene, **o: sl.sky_view_factor(scene, max_distance=50 * SPACING, **o), 1e-3),
    ):
        scene = sl.Scene.from_height(dem)
        whole, tiles = (work(scene, azimuths=8, backend=fast, tiling=tiling) for tiling in (None, SMALL))
        lazy = work(sl.Scene.from_height(dem.chunk(y=90)), azimuths=8, backend=fast, tiling=SMALL).compute()
        assert lazy.dims == tiles.dims == whole.dims
        assert 0 < rms(tiles.values - whole.values) < limit
        assert rms(lazy.values - tiles.values) < 1e-5


def test_a_map_within_one_tile_is_swept_as_a_whole(dem, fast):
    """The bytes of the whole map, of every kind of sides."""
    for sides in ("open", "dark", "periodic"):
        scene = sl.Scene.from_height(dem, sides=sides)
        expected = sl.sky_view_factor(scene, azimuths=8, backend=fast).values
        assert_bits_equal(svf(dem.chunk(y=90), fast, None, sides=sides).compute().values, expected)
        assert_bits_equal(svf(dem, fast, sl.Tiling(), sides=sides).values, expected)


def test_ground_far_beyond_the_halo_counts(fast):
    """A plain below a cliff ten tiles away: a tile sees it, and does not with a halo alone."""
    heights = np.zeros((128, 1024), np.float32)
    heights[:, 760:] = 200
    east = sl.Azimuths(2, tuple(0.001 + np.pi * np.array([-0.5, 0.5, 1.5])))
    near, far = (
        sl.horizons(sl.Scene.from_height(heights), east, fast, tiling=SMALL, max_distance=reach)[0, 60, 200]
        for reach in (16.0, None)
    )
    assert near <= 0
    assert far == pytest.approx(200 / 560, rel=0.15)  # cells are an eighth of their distance


def test_the_round_earth_hides_far_ground(fast):
    """A radius of the Earth of 10,000 nodes lowers the cliff's horizon by 0.87 d / 2 R."""
    heights = np.zeros((128, 1024), np.float32)
    heights[:, 760:] = 200
    east = sl.Azimuths(2, tuple(0.001 + np.pi * np.array([-0.5, 0.5, 1.5])))
    flat, round_ = (
        sl.horizons(sl.Scene.from_height(heights), east, fast, tiling=sl.Tiling(64, 16, 8, earth=earth))[
            0, 60, 200
        ]
        for earth in (None, 1e4)
    )
    assert flat - round_ == pytest.approx(0.87 * 560 / 2e4, rel=0.15)


def test_no_data_is_nan_and_casts_no_shadow(dem, fast):
    """Gaps, a tile without data, and the same by a mask; what is left is as if there were no ground there."""
    heights = dem.values.copy()
    heights[64:128, 128:192] = np.nan
    heights[:70, 250:] = np.nan
    lazy = dem.copy(data=heights).chunk(y=50)
    found = svf(lazy, fast).compute(scheduler="sync").values
    assert np.array_equal(np.isnan(found), np.isnan(heights))
    masked = sl.Scene.from_height(dem.values, SPACING, mask=np.isfinite(heights))
    expected = sl.sky_view_factor(masked, azimuths=8, backend=fast)
    assert rms(found - expected) < 1e-3
    by_mask = sl.Scene.from_height(dem.chunk(y=50), mask=np.isfinite(heights))
    again = sl.sky_view_factor(by_mask, azimuths=8, backend=fast, tiling=SMALL).compute(scheduler="sync")
    assert_bits_equal(np.nan_to_num(again.values), np.nan_to_num(found))
    empty = svf(xr.full_like(dem, np.nan).chunk(y=50), fast)
    assert np.isnan(empty.compute(scheduler="sync")).all()


@pytest.mark.slow
def test_a_map_that_repeats_in_tiles(fast):
    """Tiles at the border see what comes round, near what the whole map gives."""
    heights = mountains(256, 256, 40)
    repeats = sl.sky_view_factor(sl.Scene.from_height(heights, sides="periodic"), azimuths=8, backend=fast)
    still = sl.sky_view_factor(sl.Scene.from_height(heights), azimuths=8, backend=fast)
    lazy = svf(da.from_array(heights, chunks=100), fast, sides="periodic").compute()
    tiles = svf(heights, fast, sides="periodic")
    inner = np.s_[1:-1, 1:-1]
    assert rms((tiles - repeats)[inner]) < 1.5e-3 < 0.3 * rms((still - repeats)[inner])
    assert rms(lazy - tiles) < 1e-5


def test_axes_shorter_than_the_halo(fast):
    """Ten rows, one row, one column: peers' halos are deeper than these, and fail."""
    for shape in ((10, 400), (1, 300), (300, 1)):
        heights = mountains(*shape, 20)
        whole = sl.sky_view_factor(sl.Scene.from_height(heights), azimuths=8, backend=fast)
        lazy = svf(da.from_array(heights, chunks=70), fast).compute()
        assert rms(lazy - whole) < 2e-3


def test_heights_are_read_twice_and_never_before_the_overviews_are_done(dem, fast):
    """Every chunk is computed for the overviews, then once more: else all would be in memory at a time."""
    order = []

    def read(block, block_info=None):
        order.append(block_info[0]["chunk-location"])
        return block

    source = da.from_array(dem.values, chunks=(64, 64))
    lazy = da.map_blocks(read, source, dtype=np.float32, meta=np.empty((0, 0), np.float32))
    scene = sl.Scene.from_height(lazy, SPACING)
    sl.sky_view_factor(scene, azimuths=4, backend=fast, tiling=SMALL).compute(scheduler="sync")
    count = source.npartitions
    assert len(order) == 2 * count and set(order[:count]) == set(order[count:])


def test_neighbours_do_not_stay_in_memory(fast):
    """Of the eight tiles around one, only edges are kept: slices of them would keep all nine."""
    made, held = [], []

    def hills(block_info=None):
        block = np.add.outer(*(np.sin(np.arange(*ends)) for ends in block_info[None]["array-location"]))
        held.append(sum(other() is not None for other in made))
        made.append(weakref.ref(block))
        return block

    heights = da.map_blocks(hills, chunks=((64,) * 3,) * 2, dtype=float, meta=np.empty((0, 0)))
    svf(heights, fast)[64:128, 64:128].compute(scheduler="sync")
    assert len(made) == 10 and max(held) <= 2


def test_whole_numbers_of_metres(dem, fast):
    """A map of int16 gives what the same heights in float32 give."""
    whole = dem.round().astype(np.int16)
    found, expected = (svf(heights.chunk(y=100), fast).compute() for heights in (whole, whole.astype("f4")))
    assert_bits_equal(found.values, expected.values)


def test_zarr_takes_the_result_as_it_is(dem, fast, tmp_path):
    """Chunks are those of the map, so that writes are aligned; the store holds the computed bytes."""
    pytest.importorskip("zarr")
    found = svf(dem.chunk({"y": 100, "x": 100}), fast)
    found.to_dataset().to_zarr(tmp_path / "svf.zarr", consolidated=False)
    kept = xr.open_zarr(tmp_path / "svf.zarr", consolidated=False)["sky_view_factor"]
    assert_bits_equal(kept.values, found.compute().values)


@pytest.mark.slow
def test_horizons_are_computed_a_few_azimuths_at_a_time(dem, fast, monkeypatch):
    """Where all would not be held at once; the bytes stay."""
    scene = sl.Scene.from_height(dem.chunk(y=100))
    expected = sl.horizons(scene, azimuths=7, backend=fast, tiling=SMALL).compute(scheduler="sync")
    monkeypatch.setattr("skylamp.scale.GROUP_BYTES", 3 * 4 * 80 * 80)
    found = sl.horizons(scene, azimuths=7, backend=fast, tiling=SMALL)
    assert max(found.chunks[0]) < 7
    assert_bits_equal(found.compute(scheduler="sync").values, expected.values)


def test_a_round_earth_in_one_tile(fast):
    """A wall beyond the halo sinks as in many tiles, to the same bytes: overviews do not depend on tiles."""
    height = np.zeros((90, 300), np.float32)
    height[:, 290:] = 20
    flat, one, many = (
        sl.horizons(sl.Scene.from_height(height), 32, fast, tiling=sl.Tiling(tile, 32, 16, earth=earth))
        for tile, earth in ((512, None), (512, 2000.0), (128, 2000.0))
    )
    assert flat[0, 45, 90] > 2 * one[0, 45, 90] > 0
    assert_bits_equal(one[:, 45, 90], many[:, 45, 90])


def test_nodes_that_kernels_can_count(fast, monkeypatch):
    """Warp counts the bytes of a plane in an int32; what is said to fit passes the sweep's own check."""
    assert 4 * constants.MOST_PIXELS < 2**31
    engine = select(fast)
    assert max(CLIFF_NEAR_ROWS) + engine.lanes + 3 <= MOST_MARGIN
    margin = NEAR_ROWS + engine.lanes + 3
    room, scene = (30 + 2 * margin) * (50 + 2 * margin), sl.Scene(np.zeros((30, 50)))
    monkeypatch.setattr(base, "MOST_PIXELS", room)
    sl.sky_view_factor(scene, backend=fast)
    monkeypatch.setattr(base, "MOST_PIXELS", room - 1)
    with pytest.raises(sl.CapacityError, match=f"A map of {room:,} nodes; at most {room - 1:,}.*tiles"):
        sl.sky_view_factor(scene, backend=fast)


def test_a_map_beyond_the_device_goes_by_tiles(dem, fast, monkeypatch):
    """Without a tiling: where nodes are too many for one sweep, the default tiles are taken."""
    scene = sl.Scene.from_height(dem.values, SPACING)
    expected = sl.sky_view_factor(scene, azimuths=8, backend=fast, tiling=SMALL)
    monkeypatch.setattr("skylamp.scale.MOST_PIXELS", 10_000)
    monkeypatch.setattr("skylamp.scale.USUAL", SMALL)
    found = sl.sky_view_factor(scene, azimuths=8, backend=fast)
    assert_bits_equal(found, expected)


SUNNY = sl.Sky(sl.cie_sky(12, (135.0, 30.0), direct=5.0))


@pytest.mark.parametrize(
    ("sky", "limit"),
    [
        (sl.Sky(), 3e-3),
        pytest.param(sl.Sky(2.5), 3e-3, marks=pytest.mark.slow),
        pytest.param(sl.Sky(sl.cie_overcast()), 3e-3, marks=pytest.mark.slow),
        pytest.param(SUNNY, 0.03, marks=pytest.mark.slow),
        pytest.param(sl.Sky((1.0, 2.0, 0.5)), 3e-3, marks=pytest.mark.slow),
    ],
    ids=["uniform", "brighter", "overcast", "sun", "colour"],
)
def test_skies_are_rendered_in_tiles(dem, fast, sky, limit):
    """Lazily and in memory, near what the whole map's rendering gives; the sun's edges of shadows differ."""
    whole = sl.render(sl.Scene.from_height(dem), sky, backend=fast, method="horizon", azimuths=32)
    options = dict(backend=fast, azimuths=32, tiling=SMALL)
    tiles = sl.render(sl.Scene.from_height(dem), sky, **options)
    lazy = sl.render(sl.Scene.from_height(dem.chunk({"y": 70, "x": 290})), sky, **options)
    assert lazy.image.chunks[:2] == ((70, 70, 70, 20), (290,)) and lazy.image.dims == whole.image.dims
    assert lazy.image.coords["x"].identical(dem.x) and "tiles" in lazy.plan.line and lazy.error is None
    assert not lazy.interreflection.included
    mean = float(whole.image.mean())
    assert rms(tiles.image.values - whole.image.values) < limit * mean
    assert rms(lazy.image.compute().values - tiles.image.values) < 2e-3 * limit * mean
    assert lazy.image.dtype == np.float32


@pytest.mark.slow
def test_albedo_and_irradiance_of_tiles(dem, fast):
    """Radiance is albedo E / pi, in colour where the albedo is."""
    options = dict(backend=fast, azimuths=8, tiling=SMALL)
    lazy = dem.chunk(y=100)
    light = sl.render(sl.Scene.from_height(lazy), sl.Sky(), quantity="irradiance", **options).image.compute()
    albedo = np.array([0.2, 0.5, 0.9])
    image = sl.render(sl.Scene.from_height(lazy, albedo=albedo), sl.Sky(), **options).image.compute()
    assert image.dims == ("y", "x", "channel")
    np.testing.assert_allclose(image, light.values[..., None] * albedo / np.pi, rtol=1e-5)


@pytest.mark.slow
def test_maps_of_albedo_in_tiles(dem, fast):
    """Of one colour and of three, computed or lazy in chunks of their own; nan where the ground is."""
    options = dict(backend=fast, azimuths=4, tiling=SMALL)
    heights = dem.copy(data=np.where(np.arange(290) < 20, np.nan, dem.values)).chunk(y=100)
    light = sl.render(sl.Scene.from_height(heights), sl.Sky(), quantity="irradiance", **options).image
    for shape in (dem.shape, (*dem.shape, 3)):
        albedo = np.random.default_rng(3).random(shape, np.float32)
        albedo[:, :20] = np.nan  # not looked at
        expected = albedo * (light.values if len(shape) == 2 else light.values[..., None]) / np.pi
        images = [
            sl.render(sl.Scene.from_height(heights, albedo=given), sl.Sky(), **options).image
            for given in (albedo, da.from_array(albedo, chunks=130))
        ]
        assert images[0].chunks[:2] == heights.chunks
        for image in images:
            np.testing.assert_allclose(image.values, expected, rtol=1e-5)
    wrong = da.from_array(np.full(dem.shape, 1.5, np.float32))
    lazy = sl.render(sl.Scene.from_height(heights, albedo=wrong), sl.Sky(), **options).image
    with pytest.raises(InputError, match="albedo"):
        lazy.compute(scheduler="sync")
    with pytest.raises(InputError, match="albedo"):
        sl.Scene.from_height(heights, albedo=wrong[:9])


def houses(size, seed=2):
    """Blocks of 6 to 25 nodes high on level ground [nodes] float32."""
    rng, heights = np.random.default_rng(seed), np.zeros((size, size), np.float32)
    for row, col, top in zip(*rng.integers(0, size, (2, size * size // 1200)), rng.uniform(6, 25, size**2)):
        heights[row : row + 15, col : col + 20] = top
    return heights


@pytest.mark.slow
def test_far_ground_among_houses_is_said(fast):
    """An audit of every tile tells the error that overviews add, where it is large or beyond a tolerance."""
    heights, options = houses(256), dict(azimuths=16, backend=fast)
    scene, tiling = sl.Scene.from_height(heights), sl.Tiling(128, 16, 8)
    with pytest.warns(UserWarning, match="adds about .* to the error of sky-view factors") as said:
        tiles = sl.sky_view_factor(scene, "horizontal", tiling=tiling, **options)
    told = np.array([float(str(warning.message).split()[7]) for warning in said])
    error = rms(tiles - sl.sky_view_factor(scene, "horizontal", **options))
    assert 0.5 < rms(told) / error < 4  # of nodes at a tile's edge; what lies inside is swept
    lazy = sl.Scene.from_height(da.from_array(heights, chunks=100))
    image = sl.render(lazy, sl.Sky(), tolerance=0.003, tiling=tiling, backend=fast).image
    with pytest.warns(UserWarning, match="Tolerance: ground beyond the halo .* % .* more than the 0.3 %"):
        image.compute(scheduler="sync")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        wide = sl.render(lazy, sl.Sky(), azimuths=8, tolerance=0.5, tiling=tiling, backend=fast).image
        wide.compute(scheduler="sync")
        svf(mountains(128, 128, 4), fast)


@pytest.mark.slow
def test_a_low_sun_behind_far_ground_is_said(fast):
    """The audit is of the image's own sky: where far ridges shade a low sun, it tells what overviews cost."""
    y, x = np.indices((400, 400))
    noise = 3 * np.random.default_rng(0).random((400, 400))
    scene = sl.Scene.from_height((80 * np.sin(x / 39) * np.cos(y / 57) + noise).astype(np.float32))
    options = dict(interreflection=False, backend=fast)
    for elevation, is_said in ((8.0, True), (60.0, False)):
        sky = sl.Sky(sl.cie_clear((75.0, elevation), direct=5.0))
        whole = sl.render(scene, sky, tolerance=0.005, **options).image
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            tiles = sl.render(scene, sky, tolerance=0.01, tiling=sl.Tiling(128), **options).image
        assert (rms(tiles - whole) > 0.015 * whole.mean()) == is_said
        told = [str(warning.message) for warning in said if "beyond the halo" in str(warning.message)]
        assert bool(told) == bool(said) == is_said, said
        assert all(1 <= float(text.split()[9]) < 10 for text in told), said


@pytest.mark.slow
def test_shadows_of_far_ground_along_the_border(fast):
    """Rays of nodes on the border leave the map before a wall that those beside meet: nodes between had half
    of the sun, 31 rows of them, and an error of 39 %.
    """
    height = np.zeros((256, 512), np.float32)
    height[:, 400:] = 250
    sky = sl.Sky(sl.cie_clear((90.0, 20.0), horizontal=90.0, direct=750.0))
    scene, options = sl.Scene.from_height(height), dict(interreflection=False, backend=fast)
    whole = sl.render(scene, sky, **options).image
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they tell of 10 %
        tiles = sl.render(scene, sky, tiling=sl.Tiling(128), **options).image
    off = np.abs(tiles - whole)[:, :256] > 0.5 * whole.mean()
    assert off[6:-6].mean() == 0 < off.mean()


@pytest.mark.slow
def test_a_low_sun_behind_sharp_crests_in_tiles(fast):
    """Within 6 near rows sweeps lit what it does not reach: 2 tolerances, told; the sun has 96."""
    y, x = np.mgrid[:128, :256].astype(float)
    bend = 6.9205479 * np.sin(y / 13.6753382)
    at = (x * np.cos(0.26194167) + y * np.sin(0.26194167) + bend) / 20.7776247 % 1
    scene = sl.Scene.from_height(8.0118527 * np.where(at < 0.75, at / 0.75, (1 - at) / 0.25))
    sky = sl.Sky(sl.cie_sky(7, (193.36, 5.25), direct=12.0))
    options = dict(interreflection=False, backend=fast, tolerance=0.003)
    exact = sl.render(scene, sky, method="horizon", azimuths=256, **options).image
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tiles = sl.render(scene, sky, tiling=sl.Tiling(128, 64, 32), **options).image
    assert rms(tiles - exact) < 0.003 * exact.mean()


@pytest.mark.slow
@pytest.mark.parametrize("brightness", [1.0, (0.0, 1.0, 0.5)])
def test_an_error_of_sweeps_among_towers_is_said(fast, brightness):
    """Of a colour that is dark nothing is seen, and the others tell; within twice the true error."""
    rng, height = np.random.default_rng(5), np.zeros((128, 256))
    for row, col in rng.integers(0, (122, 250), (110, 2)):
        height[row : row + rng.integers(1, 6), col : col + rng.integers(1, 6)] = rng.uniform(10, 70)
    scene, options = sl.Scene.from_height(height), dict(interreflection=False, backend=fast)
    exact = sl.render(scene, sl.Sky(), tolerance=0.002, **options).image
    with warnings.catch_warnings():  # of azimuths that are asked for nothing is promised
        warnings.filterwarnings("error", message=".*sweeps of tiles")
        tiles = sl.render(scene, sl.Sky(), azimuths=64, tiling=sl.Tiling(128, 64, 32), **options).image
    with pytest.warns(UserWarning, match="sweeps of tiles") as said:
        sl.render(scene, sl.Sky(brightness), tolerance=0.0025, tiling=sl.Tiling(128, 64, 32), **options)
    told = [
        float(found[1]) for found in (re.search(r"about ([\d.]+) %", str(w.message)) for w in said) if found
    ]
    true = 100 * rms(tiles - exact) / exact.mean()
    assert true / 2 < max(told) < 2 * true


@pytest.mark.slow
def test_light_between_surfaces_in_tiles(fast):
    """Near that of the whole map, lazily too; ground beyond the halo counts as what is seen of it within."""
    heights, options = (
        mountains(150, 170, 40),
        dict(backend=fast, azimuths=16, tolerance=0.005, quantity="irradiance"),
    )
    albedo = np.where(np.arange(170) < 90, 0.9, 0.3) * np.ones((150, 1), np.float32)
    scene, sky = sl.Scene.from_height(heights, albedo=albedo), sl.Sky()
    direct, whole = (sl.render(scene, sky, interreflection=b, **options).image for b in (False, True))
    assert rms(whole - direct) > 0.04 * direct.mean()
    tiles = sl.render(scene, sky, interreflection=True, tiling=SMALL, **options)
    assert rms(tiles.image - whole) < 0.005 * direct.mean() and tiles.interreflection.included
    lazy = sl.Scene.from_height(da.from_array(heights, chunks=60), albedo=da.from_array(albedo, chunks=70))
    image = sl.render(lazy, sky, interreflection=True, tiling=SMALL, **options).image
    assert rms(image.compute(scheduler="sync") - tiles.image) < 1e-5
    for given, tiling, sides in (
        (heights, sl.Tiling(16, 16, 8), "open"),
        (np.pad(heights, 9), SMALL, "periodic"),
    ):
        with pytest.raises(InputError, match="between surfaces in tiles"):
            there = sl.Scene.from_height(given, sides=sides)
            sl.render(there, sky, interreflection=True, tiling=tiling, backend=fast)


@pytest.mark.slow
@pytest.mark.parametrize(("albedo", "counts"), [(0.9, True), (0.02, False)])
def test_the_whole_map_decides_on_light_between_surfaces(fast, albedo, counts):
    """Once for all tiles, as if True or False had been asked for; one half of the map is flat."""
    heights = np.concatenate([np.zeros((130, 70), np.float32), mountains(130, 80, 25)], 1)
    options = dict(backend=fast, tiling=SMALL, tolerance=0.02)
    expected = sl.render(
        sl.Scene.from_height(heights, albedo=albedo), sl.Sky(), interreflection=counts, **options
    )
    tiles = sl.render(sl.Scene.from_height(heights, albedo=albedo), sl.Sky(), **options)
    assert_bits_equal(tiles.image, expected.image)
    assert tiles.interreflection.included is counts and tiles.interreflection.reason.startswith("it is about")
    whole = sl.plan(sl.Scene.from_height(heights, albedo=albedo), sl.Sky(), backend=fast)
    assert 0.5 < tiles.interreflection.share / whole.interreflection < 1.5
    varying = da.full((130, 150), albedo, dtype=np.float32, chunks=(130, 40))
    for chunks, surface in ((50, albedo), ((130, 31), varying)):
        lazy = sl.Scene.from_height(da.from_array(heights, chunks=chunks), albedo=surface)
        found = sl.render(lazy, sl.Sky(), **options)
        assert found.interreflection.included is None and "windows" in str(found.interreflection)
        lit = sl.render(lazy, sl.Sky(), interreflection=counts, **options).image
        assert_bits_equal(*(image.compute(scheduler="sync") for image in (found.image, lit)))
    one = da.from_array(heights[:60, 70:130], chunks=30)  # a map within one tile
    images = [
        sl.render(sl.Scene.from_height(one, albedo=albedo), sl.Sky(), interreflection=asked, **options).image
        for asked in ("auto", counts)
    ]
    assert_bits_equal(*(image.compute(scheduler="sync") for image in images))


def test_light_between_surfaces_that_cannot_be_in_tiles_is_said(fast):
    """On a map that repeats: a warning with how much it is, and direct light."""
    heights = np.pad(mountains(118, 118, 40), 5)
    scene = sl.Scene.from_height(heights, albedo=0.9, sides="periodic")
    with pytest.warns(
        UserWarning, match="Tolerance: light between surfaces .* about [0-9.]+ % of the direct"
    ):
        found = sl.render(scene, sl.Sky(), backend=fast, tiling=SMALL)
    assert not found.interreflection.included and found.interreflection.share > 0.01
    needs = "it needs open sides and tiles of at least two halos"
    assert str(found.interreflection).startswith(f"left out: {needs}; it is about")
    lazy = sl.Scene.from_height(da.from_array(heights, chunks=64), albedo=0.9, sides="periodic")
    promised = sl.render(lazy, sl.Sky(), backend=fast, tiling=SMALL).interreflection
    assert str(promised) == f"left out: {needs}"


def test_light_that_is_guessed_is_said(fast):
    """Between two ridges of a bright valley most light comes from beyond a halo of 16 nodes."""
    heights = np.abs(np.arange(-96.0, 96.0))[None] * np.ones((130, 1))
    scene = sl.Scene.from_height(da.from_array(heights.astype(np.float32)), albedo=0.9)
    image = sl.render(scene, sl.Sky(), interreflection=True, azimuths=8, backend=fast, tiling=SMALL).image
    with pytest.warns(UserWarning, match="about .* % of the light .* beyond a tile's halo"):
        image.compute(scheduler="sync")


def test_lamps_light_what_is_within_their_reach(dem, fast):
    """As the whole map's rendering within it, from a map whose highest ground is elsewhere; 0 beyond; nan
    without data. The warning has the number, and so has the error where too much would be lit.
    """
    heights = np.where(np.arange(290) < 150, np.nan, dem.values)
    heights[5, 200] = 2000.0  # a mast
    options = dict(backend=fast, tolerance=0.02, interreflection=False)
    highest = float(np.nanmax(dem.values[:, 150:]))  # where the mast is not
    depth = highest - float(dem.values[100, 240])
    lamp, below = (
        sl.Lamp(center=(240 * SPACING, 100 * SPACING, z - 300.0), radius=60.0)
        for z in (depth, depth + 2000.0 - highest)
    )
    whole = sl.render(sl.Scene.from_height(dem.values, SPACING, mask=np.isfinite(heights)), lamp, **options)
    albedo = np.array([0.2, 0.5, 0.8])
    lazy = sl.Scene.from_height(dem.copy(data=heights).chunk(y=70), albedo=albedo)
    done = sl.render(lazy, below, max_distance=1200.0, **options)
    assert done.image.chunks[0] == (70, 70, 70, 20) and "0.0079 times" in done.warnings[0]
    image = done.image.compute(scheduler="sync").values
    assert np.array_equal(np.isnan(image[..., 0]), np.isnan(heights))
    area = np.s_[60:141, 200:281]
    expected = whole.image[area][..., None] * albedo / 0.8
    off, border = image[area] - expected, np.pad(np.zeros((79, 79), bool), 1, constant_values=True)
    assert rms(off) < 0.02 * expected.mean()
    assert rms(off[border]) < 0.02 * expected[border].mean()  # their slopes are those of the whole map
    image[area] = np.nan
    assert np.nanmax(image) == 0


@pytest.mark.parametrize(
    "asked",
    [
        dict(method="lattice", hemicube=5),
        dict(method="unoccluded"),
        dict(azimuths=16),
        dict(azimuths=16, interreflection=True),
        dict(interreflection=False),
        {},
    ],
)
def test_a_lamp_in_tiles_says_what_the_whole_map_says(fast, asked):
    """Image, its shape, method and light between surfaces, in colour; of a lazy map what is known."""
    heights, lamp = mountains(60, 70, 8), sl.Lamp(center=(35, 30, -30), radius=10)
    surface, options = dict(albedo=(0.2, 0.5, 0.8)), dict(quantity="irradiance", backend=fast, **asked)
    scene = sl.Scene.from_height(heights, **surface)
    whole, tiled = (sl.render(scene, lamp, tiling=tiling, **options) for tiling in (None, SMALL))
    assert np.allclose(tiled.image, whole.image, rtol=1e-4) and tiled.image.shape == whole.image.shape
    facts = lambda plan: (plan.method, plan.hemicube, plan.filled, plan.azimuths)
    assert facts(tiled.plan) == facts(whole.plan) and "within reach of the lamp" in tiled.plan.reason
    assert str(tiled.interreflection) == str(whole.interreflection)
    lazy = sl.render(sl.Scene.from_height(da.from_array(heights, chunks=30), **surface), lamp, **options)
    assert lazy.image.shape == whole.image.shape
    if asked:
        assert facts(lazy.plan)[:3] == facts(whole.plan)[:3]
        assert lazy.interreflection.included == whole.interreflection.included
    else:
        assert lazy.interreflection.included is None and "third" in str(lazy.interreflection)


@pytest.mark.parametrize("source", [sl.Sky(), sl.Lamp(center=(0, 0, -10), radius=3)])
def test_a_tiling_is_a_tiling(source):
    """For a lamp as for a sky."""
    with pytest.raises(InputError, match="tiling: got int; allowed: a skylamp.Tiling"):
        sl.render(sl.Scene(np.zeros((4, 4))), source, backend="numpy", tiling=64)


def test_minus_infinity_is_missing_ground(fast):
    """As nan is, without a word of NumPy's."""
    heights = mountains(70, 80, 8)
    heights[20:50, 30:50] = np.nan
    images = [
        sl.render(sl.Scene.from_height(da.from_array(part)), sl.Sky(), backend=fast, tiling=SMALL).image
        for part in (heights, np.where(np.isnan(heights), -np.inf, heights))
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found, expected = (image.compute(scheduler="sync") for image in images)
    assert np.array_equal(np.isnan(found), np.isnan(heights))
    assert_bits_equal(np.nan_to_num(found), np.nan_to_num(expected))


@pytest.mark.parametrize("z", [-4.0, 4.0])
def test_lamps_in_tiles_count_z_from_the_viewer(fast, z):
    """Level ground 10 deep under a sphere gets rho (r / distance)^2, in tiles as on the whole map."""
    scene = sl.Scene(np.full((90, 120), 10.0), albedo=0.5)
    options = dict(max_distance=25, tiling=sl.Tiling(tile=32, halo=16, rule=16), interreflection=False)
    image = sl.render(scene, sl.Lamp(center=(44, 50, z), radius=2), backend=fast, **options).image
    assert image[50, 44] == pytest.approx(0.5 * 4 / (10 - z) ** 2, rel=1e-3)


def test_a_lamp_that_lights_too_much_is_refused(dem, fast, monkeypatch):
    """Its area is rendered at once; the error says what bounds it."""
    monkeypatch.setattr("skylamp.scale.MOST_PIXELS", 10_000)
    lamp = sl.Lamp(center=(0, 0, -10), radius=3)
    with pytest.raises(InputError, match="230 x 290 nodes.*max_distance.*at once"):
        sl.render(sl.Scene.from_height(dem.chunk()), lamp, backend=fast)
    mirror = sl.Scene.from_height(dem.values, SPACING, reflectance=sl.Mirror(0.5, 0.5))
    with pytest.raises(InputError, match="a lobe or a mirror.*Lambertian.*over any tile"):
        sl.render(mirror, lamp, backend=fast, tiling=SMALL)


@pytest.mark.parametrize(
    ("source", "options", "what"),
    [
        (sl.Window(x=(0, 10), y=(0, 10)), {}, "a window.*any tile on its way"),
        (sl.Lamp(corner=(0, 0, -9), edges=((3, 0, 0), (0, 3, 0))), {}, "a centre.*counted from there"),
        (
            sl.Lamp(center=(-90, 0, -10), radius=3),
            dict(max_distance=60.0),
            "whole map lies.*beyond its reach",
        ),
        (sl.Sky(), dict(method="lattice"), "lattice.*knows horizons alone"),
        (sl.Sky(), dict(hemicube=5), "lattice.*knows horizons alone"),
        (sl.Sky(), dict(method="unoccluded"), "closed forms.*horizons alone"),
        (sl.Sky(), dict(parts=True), "parts.*One image"),
        (sl.Sky(), dict(tail=0.1), "tail.*Nothing is refined"),
        (sl.Sky(), dict(tolerance=1e-4), "tolerance.*Nothing is refined"),
    ],
)
def test_what_is_not_rendered_in_tiles_is_refused(dem, source, options, what):
    """With what is allowed and the reason, before anything is computed."""
    with pytest.raises(InputError, match=f"tiles: got .*{what}"):
        sl.render(sl.Scene.from_height(dem.chunk()), source, backend="numpy", **options)


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda d: svf(d.chunk(), "numpy", sides="dark"), "dark"),
        (lambda d: svf(d.chunk(), "numpy", tiling=64), "tiling"),
        (lambda d: svf(d.chunk(), "numpy", max_distance=1.0), "max_distance"),
        (lambda d: svf(d.chunk(), "numpy", max_distance=-1), "max_distance"),
        (lambda d: svf(d[:40].chunk(), "numpy", sides="periodic"), "repeats"),
        (lambda d: sl.Scene(d.chunk()), "lazy map"),
        (lambda d: sl.Scene.from_height(d.chunk() > 3), "bool"),
        (lambda d: sl.Scene.from_height(d.chunk()[0]), "shape"),
        (lambda d: sl.Scene.from_height(d.chunk(), mask=np.ones((2, 2), bool)), "mask"),
        (lambda d: sl.Scene.from_height(d.chunk().rename(x="lon")), "degrees"),
        (lambda d: sl.Scene.from_height(d.assign_coords(x=2 * d.x)), "even steps"),
        (lambda d: sl.visibility(sl.Scene.from_height(d.chunk()), sl.Sky()), "lazy map"),
    ],
)
def test_what_lazy_maps_cannot_be_is_said_at_once(dem, make, what):
    """One error each, before anything is computed."""
    with pytest.raises(InputError, match=what):
        make(dem)


def test_degrees_of_a_reference_system_are_refused(dem):
    """Also where the coordinates are called x and y, as rioxarray calls them."""
    pytest.importorskip("rioxarray")
    with pytest.raises(InputError, match="degrees"):
        sl.Scene.from_height(dem.rio.write_crs(4326))
    assert sl.Scene.from_height(dem.rio.write_crs(4326), 25.0).spacing == 25.0


def test_a_graph_can_be_sent_to_workers(dem, fast):
    """All that tiles are computed from can be pickled."""
    scene = sl.Scene.from_height(dem.chunk(y=100))
    for found in (
        sl.sky_view_factor(scene, azimuths=sl.Azimuths(8), backend=fast, tiling=SMALL),
        sl.horizons(scene, azimuths=4, backend=fast, tiling=SMALL),
    ):
        graph = pickle.loads(pickle.dumps(dict(found.__dask_graph__())))
        assert len(graph) > 20


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [1.7, 2.1])
def test_error_of_tiles_on_mountains(fast, roughness):
    """Added to that of the whole map, mountains of a relief of 103 nodes on 1,536 x 1,536: what the
    documentation says of sky-view factors and horizons, and no seams.
    """
    heights = mountains(1536, 1536, 103, roughness=roughness)
    tiling, options = sl.Tiling(tile=512), dict(azimuths=16, backend=fast)
    scene = sl.Scene.from_height(heights)
    error = sl.sky_view_factor(scene, **options, tiling=tiling) - sl.sky_view_factor(scene, **options)
    assert rms(error) < 3e-4 and abs(error.mean()) < 1e-4 and np.quantile(np.abs(error), 0.999) < 3e-3
    jumps = np.abs(np.diff(error, axis=1)).mean(0)
    seams, inside = jumps[[511, 1023]].mean(), jumps[[255, 767, 1279]].mean()
    assert seams < 4e-4 and seams < 4 * inside
    few = dict(options, azimuths=2)
    slopes = sl.horizons(scene, **few, tiling=tiling), sl.horizons(scene, **few)
    known = np.isfinite(slopes[1])
    apart = np.arctan(slopes[0][known]) - np.arctan(slopes[1][known])
    assert rms(apart) < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_bytes_do_not_depend_on_workers(dem, fast, processes, tmp_path):
    """Processes of dask.distributed, one of which dies in the middle, give the bytes of one thread."""
    distributed = pytest.importorskip("distributed")
    died = tmp_path / "died"

    def deadly(block, block_info=None):
        if block_info[0]["chunk-location"] == (2, 1) and not died.exists():
            died.touch()
            os._exit(9)
        return block

    lazy = dem.chunk({"y": 60, "x": 100})
    expected = svf(lazy, fast).compute(scheduler="sync").values
    meta = np.empty((0, 0), np.float32)
    lazy = lazy.copy(data=da.map_blocks(deadly, lazy.data, dtype=np.float32, meta=meta))
    with (
        distributed.LocalCluster(
            n_workers=processes, threads_per_worker=2, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        found = client.compute(svf(lazy, fast)).result(timeout=300).values
    assert died.exists()
    assert_bits_equal(found, expected)


@pytest.mark.slow
def test_warnings_of_workers_reach_the_client(fast):
    """What a tile is audited to be off is said where the result is asked for."""
    distributed = pytest.importorskip("distributed")
    lazy = sl.Scene.from_height(da.from_array(houses(128), chunks=64))
    found = sl.sky_view_factor(lazy, azimuths=8, backend=fast, tiling=SMALL)
    options = dict(threads_per_worker=1, processes=True, dashboard_address=None)
    with distributed.LocalCluster(n_workers=1, **options) as cluster, distributed.Client(cluster):
        with pytest.warns(UserWarning, match="to the error of sky-view factors") as said:
            found.compute()
            for _ in range(100):
                time.sleep(0 if said else 0.05)


@pytest.mark.slow
def test_every_worker_takes_a_device_of_its_own(dem, fast):
    """The plugin hands devices out by turns; "auto" is then each worker's own."""
    distributed = pytest.importorskip("distributed")
    options = dict(threads_per_worker=1, processes=True, dashboard_address=None)

    def taken():
        from skylamp.backends import select

        return select("auto").name

    with distributed.LocalCluster(n_workers=2, **options) as cluster, distributed.Client(cluster) as client:
        client.register_plugin(sl.devices("numpy", fast))
        assert sorted(client.run(taken).values()) == sorted(["numpy", fast])
        client.register_plugin(sl.devices("numpy"), name="again")
        part = dem[:120, :150].chunk(y=100)
        found = svf(part, "auto").compute()
    assert_bits_equal(found.values, svf(part, "numpy").compute(scheduler="sync").values)


@pytest.mark.slow
def test_rare_ground_decides_on_light_between_surfaces(fast):
    """Two canyons that a grid of windows does not meet: the estimate is near that of the whole map."""
    heights = np.zeros((256, 1024), np.float32)
    heights[:, 5:35] = heights[:, 545:575] = -40
    heights += 0.1 * np.random.default_rng(1).normal(size=heights.shape).astype(np.float32)
    scene = sl.Scene.from_height(heights)
    found = sl.render(scene, sl.Sky(), backend=fast, tiling=sl.Tiling(256, 64, 32)).interreflection
    whole = sl.render(scene, sl.Sky(), backend=fast).interreflection
    assert found.included and whole.included
    assert found.share == pytest.approx(whole.share, rel=0.2)


@pytest.mark.slow
def test_an_islet_that_no_sample_meets(fast):
    """A tile of one node among tiles without gaps renders as any other, at every albedo."""
    y, x = np.mgrid[:130, :130]
    heights = np.sin(x / 9) + np.cos(y / 7)
    heights[64:128, 64:128], heights[90, 90] = np.nan, 0
    for albedo in (0.2, 0.8):
        scene = sl.Scene.from_height(heights, albedo=albedo, mask=np.isfinite(heights))
        image = sl.render(scene, sl.Sky(), backend=fast, tiling=SMALL).image
        assert np.array_equal(np.isnan(image), np.isnan(heights))


@pytest.mark.parametrize("lazy", [False, True])
def test_irradiance_of_coloured_ground_without_light_between(fast, lazy):
    """It is in colour, as it would be with that light, whether the map is one tile or many."""
    heights = 0.05 * np.sin(np.arange(130) / 9) + np.zeros((90, 1))
    given = da.from_array(heights, chunks=50) if lazy else heights
    scene = sl.Scene.from_height(given, 1.0, albedo=(0.2, 0.3, 0.4))
    for tiling in (SMALL, sl.Tiling(256, 16, 8)):
        image = sl.render(scene, sl.Sky(), backend=fast, quantity="irradiance", tiling=tiling).image
        image = np.asarray(image)
        assert image.shape == (90, 130, 3) and np.ptp(image, axis=2).max() == 0


@pytest.mark.parametrize("options", [{"max_distance": 30.0}, {"earth": 300.0}])
def test_what_is_not_seen_is_no_error(fast, options):
    """Ground beyond max_distance, or behind the round Earth, is no error of a tile's, so nothing is said."""
    heights = mountains(320, 320, 12, roughness=2.4)
    earth = options.pop("earth", None)
    tiling = sl.Tiling(128, 16, 16, earth=earth)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        svf(heights, fast, tiling, **options)


@pytest.mark.slow
def test_the_round_earth_falls_off_below_the_horizon(fast):
    """Seen from the nadir, level ground falls off: by the angle to its farthest node."""
    tiling, level = sl.Tiling(64, 16, 8, earth=1e3), sl.Scene.from_height(np.zeros((64, 512), np.float32))
    west = sl.Azimuths(2, tuple(0.001 + np.pi * np.array([-0.5, 0.5, 1.5])))
    below, above = (
        sl.openness(level, west, fast, negative=negative, tiling=tiling)[32] - np.pi / 2
        for negative in (True, False)
    )
    x = np.arange(512)
    expected = -np.arctan(0.87 * np.stack([x, 511 - x]) / 2e3).mean(0)
    np.testing.assert_allclose(below[64:-64], expected[64:-64], atol=0.02)
    np.testing.assert_allclose(above[64:-64], 0, atol=0.01)
