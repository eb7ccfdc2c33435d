"""Lazy maps as users of xarray, rioxarray and Dask bring them, and what becomes of their results there."""

import re
import warnings

import numpy as np
import pytest
from compare import assert_bits_equal
from test_scale import SPACING, mountains

import skylamp as sl

da = pytest.importorskip("dask.array")
xr = pytest.importorskip("xarray")
dask = pytest.importorskip("dask")

TILES = sl.Tiling(tile=32, halo=8, rule=8)
LAMP = sl.Lamp(center=(1500, 1500, -100), radius=60)
HEIGHTS = SPACING * mountains(70, 90, 15)


def dem(values=HEIGHTS, **attrs):
    """Heights with coordinates in metres and a CRS's place, as rioxarray reads them."""
    rows, cols = values.shape
    coords = {"y": 4e3 - SPACING * np.arange(rows), "x": 5e2 + SPACING * np.arange(cols), "spatial_ref": 0}
    return xr.DataArray(values, coords, ("y", "x"), "elevation", attrs)


def image(heights, source, on, **options):
    scene = heights if isinstance(heights, sl.Scene) else sl.Scene.from_height(heights)
    return sl.render(scene, source, backend=on, tiling=TILES, **options).image


CALLS = {
    "horizons": lambda heights, on: sl.horizons(heights, 4, on, tiling=TILES),
    "sky view": lambda heights, on: sl.sky_view_factor(heights, azimuths=4, backend=on, tiling=TILES),
    "coarser": lambda heights, on: sl.sky_view_factor(
        heights, azimuths=4, backend=on, tiling=sl.Tiling(64, 16, 8)
    ),
    "near": lambda heights, on: sl.sky_view_factor(
        heights, azimuths=4, backend=on, tiling=TILES, max_distance=200.0
    ),
    "openness": lambda heights, on: sl.openness(heights, 4, on, tiling=TILES),
    "seen from below": lambda heights, on: sl.openness(heights, 4, on, negative=True, tiling=TILES),
    "sky": lambda heights, on: image(heights, sl.Sky(), on, azimuths=4),
    "all light": lambda heights, on: image(heights, sl.Sky(), on, tolerance=0.05),
    "lamp": lambda heights, on: image(heights, LAMP, on, max_distance=900.0),
}


def test_names_tell_what_is_computed(fast):
    """The same call has the same keys, so that Dask computes it once; any other call has another name."""
    names = {}
    for what, call in CALLS.items():
        one, again = (call(dem().chunk(40), fast) for _ in range(2))
        assert set(one.__dask_graph__()) == set(again.__dask_graph__()), what
        names[what] = one.data.name
        assert call(dem(HEIGHTS + 1).chunk(40), fast).data.name != one.data.name
    assert len(set(names.values())) == len(CALLS)


def test_a_key_means_the_same_in_all_graphs(fast):
    """What two results share they compute alike: a scheduler that holds both may hang else."""
    heights, known = dem().chunk(40), {}
    for what, call in CALLS.items():
        graph = call(heights, fast).__dask_graph__()
        for key, after in graph.get_all_dependencies().items():
            assert known.setdefault(key, after) == after, (what, key)


@pytest.mark.parametrize(
    ("kind", "offset"),
    [
        ("int16", 0),
        ("uint16", 0),
        ("float16", 0),
        (">f4", 0),
        ("int32", 10**9),
        ("int64", 10**12),
        ("f8", 1e9),
    ],
)
def test_heights_of_any_type_keep_their_relief(kind, offset, fast):
    """However far they are above zero: lazily what the relief alone gives in memory."""
    relief = HEIGHTS.astype(kind)
    expected = CALLS["sky view"](dem(relief.astype("f4")), fast).values
    found = CALLS["sky view"](dem(relief + np.array(offset, kind)).chunk(40), fast).compute(scheduler="sync")
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)


def test_infinite_heights_are_no_data(fast):
    """Far ground is as if they were nan, and so are lamps, without remarks of NumPy's."""
    holes = HEIGHTS.copy()
    holes[10:13, 70:75] = np.nan
    endless = np.where(np.isnan(holes), np.inf * (-1.0) ** np.arange(90), holes).astype("f4")
    for what in ("sky view", "lamp"):
        found, expected = (CALLS[what](dem(values).chunk(40), fast) for values in (endless, holes))
        assert_bits_equal(
            *(np.nan_to_num(one.compute(scheduler="sync"), nan=-1) for one in (found, expected))
        )


@pytest.mark.parametrize("lazy", [False, True])
def test_values_without_data_by_attributes(lazy, fast):
    """A band as rioxarray opens it unasked: its no-data value is no ground. What is decoded is the same.

    Also where rioxarray is imported, which refuses lists of such values.
    """
    pytest.importorskip("rioxarray")
    for kind, attrs in (("i2", {"_FillValue": np.int16(-999)}), ("f4", {"missing_value": [-1e30, -999.0]})):
        heights = HEIGHTS.astype(kind)
        heights[10:13, 70:75] = -999
        decoded = np.where(heights == -999, np.nan, heights).astype("f4")
        found, expected = (
            CALLS["sky view"](given.chunk(40) if lazy else given, fast).compute(scheduler="sync").values
            for given in (dem(heights, **attrs), dem(decoded))
        )
        assert np.array_equal(np.isnan(found), heights == -999)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda d: d.assign_attrs(scale_factor=0.1), "mask_and_scale=True"),
        (lambda d: d.assign_attrs(add_offset=100.0), "mask_and_scale=True"),
        (lambda d: d.expand_dims("band"), r"dem\[0\]"),
        (lambda d: d.expand_dims(band=[1, 2]), r"dem\[0\]"),
        (lambda d: d.T.rename(x="projection_x_coordinate", y="projection_y_coordinate"), "rows first"),
        (
            lambda d: d.T.rename(x="a", y="b").assign_coords(a=("a", 30.0 * np.arange(90), {"axis": "X"})),
            "rows",
        ),
        (lambda d: d.to_dataset(), "Scene.from_height"),
    ],
)
def test_what_is_no_map_of_heights_is_refused(change, what, lazy):
    """With the way out, whether it is lazy or not."""
    given = change(dem())
    with pytest.raises(sl.errors.InputError, match=what):
        CALLS["sky view"](given.chunk() if lazy else given, "numpy")


@pytest.mark.parametrize("lazy", [False, True])
def test_a_mask_leaves_out_more_than_has_no_data(lazy, fast):
    """Of heights and of depth: what is not finite or is the no-data value stays out, whatever the mask is."""
    heights, mask = HEIGHTS.copy(), np.ones(HEIGHTS.shape, bool)
    heights[10:13, 70:75], heights[20, 20], heights[21, 20], mask[:5] = -999, np.nan, np.inf, False
    out = ~mask | (heights == -999) | ~np.isfinite(heights)
    given = dem(heights, _FillValue=-999.0)
    scene = sl.Scene.from_height(given.chunk(40) if lazy else given, mask=mask)
    assert np.array_equal(np.isnan(CALLS["sky view"](scene, fast).values), out)
    if not lazy:
        depth = given.copy(data=np.where(given == -999, -999, HEIGHTS.max() - given))
        assert np.array_equal(~sl.Scene(depth, SPACING, mask=mask).mask, out)


def test_a_depth_without_a_spacing_says_what_its_coordinates_have():
    """A scene's spacing is 1 unless given."""
    depth = dem(HEIGHTS.max() - HEIGHTS)
    with pytest.warns(UserWarning, match="^Spacing: 1 is taken, .* 30 apart. Give spacing=30"):
        assert sl.Scene(depth).spacing == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sl.Scene(depth, 30.0), sl.Scene(depth.drop_vars(["x", "y"])), sl.Scene(depth.values)


def test_a_dimension_named_as_the_results_is_refused():
    """Azimuths and colours have axes of their own."""
    with pytest.raises(sl.errors.InputError, match="azimuth.*rename"):
        sl.horizons(dem().rename(x="azimuth"), 4, "numpy")


def test_a_mask_may_be_a_list(fast):
    """Of Dask's, xarray's, NumPy's or Python's: the same bytes."""
    known, heights = dem() > 100, dem().chunk(40)
    found = [
        image(sl.Scene.from_height(heights, mask=mask), sl.Sky(), fast, azimuths=4).compute(scheduler="sync")
        for mask in (known, known.chunk(30), known.values, known.values.tolist())
    ]
    for other in found[1:]:
        assert_bits_equal(np.nan_to_num(other.values), np.nan_to_num(found[0].values))
    assert np.array_equal(np.isnan(found[0]), ~known)


@pytest.mark.parametrize("lazy", [False, True])
def test_a_reference_system_of_any_name_stays(lazy, fast, tmp_path):
    """In the result, in Zarr and in a GeoTIFF."""
    pytest.importorskip("rioxarray"), pytest.importorskip("zarr")
    given = dem().drop_vars("spatial_ref").rio.write_crs(32633, grid_mapping_name="utm")
    for what in ("sky view", "horizons"):
        found = CALLS[what](given.chunk(40) if lazy else given, fast)
        assert found.rio.crs.to_epsg() == 32633
        found.to_zarr(tmp_path / what, consolidated=False)
        kept = xr.open_zarr(tmp_path / what, consolidated=False, decode_coords="all")[found.name]
        found.rio.to_raster(tmp_path / f"{what}.tif")
        written = xr.open_dataarray(tmp_path / f"{what}.tif", engine="rasterio").squeeze(
            "band" if found.ndim == 2 else ()
        )
        for back in (kept, written):
            assert back.rio.crs == found.rio.crs
            assert_bits_equal(np.nan_to_num(back.values), np.nan_to_num(found.values))


@pytest.mark.parametrize("sides", ["dark", "periodic"])
def test_a_lamp_with_sides_is_refused_with_the_reason(sides):
    """What stands or repeats beside the map is not in the part that a lamp lights."""
    scene = sl.Scene.from_height(dem().chunk(40), sides=sides)
    with pytest.raises(sl.errors.InputError, match=f"{sides}.*without the walls or copies"):
        image(scene, LAMP, "numpy")


def test_azimuths_replace_a_coordinate_of_their_name(fast):
    """A hillshade's scalar azimuth, say, does not stand for the horizons' own."""
    for given in (dem(), dem().chunk(40)):
        found = CALLS["horizons"](given.assign_coords(azimuth=315.0), fast)
        np.testing.assert_allclose(found.azimuth, sl.Azimuths(4).angles)


def test_errors_of_tiles_tell_where_rows_are_counted_from(fast):
    """One albedo of 1.5, one height of 1e30: the numbers in the error are those of a window."""
    albedo, high = np.full(HEIGHTS.shape, 0.5), HEIGHTS.astype(float)
    albedo[60, 80], high[60, 80] = 1.5, 1e30
    for scene, what in (
        (sl.Scene.from_height(dem().chunk(40), albedo=albedo), "albedo.*got 1.5"),
        (sl.Scene.from_height(dem(high).chunk(40)), "too deep"),
    ):
        lazy = image(scene, sl.Sky(), fast, azimuths=4)
        with pytest.raises(sl.errors.InputError, match=f"In a window of .* nodes of the map: .*{what}"):
            lazy.compute(scheduler="sync")


def test_the_window_of_an_error_is_found_on_the_map(fast):
    """Its first node, and the row and column within it, are those of the wrong albedo."""
    heights, albedo = np.zeros((300, 300)), np.full((300, 300), 0.5)
    albedo[200, 250] = 1.5
    scene = sl.Scene.from_height(da.from_array(heights, chunks=100), 1.0, albedo=albedo)
    lazy = sl.render(scene, sl.Sky(), azimuths=4, tiling=sl.Tiling(128, 16, 8), backend=fast).image
    with pytest.raises(sl.InputError) as error:
        lazy.compute(scheduler="sync")
    first, within = re.findall(r"\(row, col\) = \((\d+), (\d+)\)", str(error.value))
    assert [int(a) + int(b) for a, b in zip(first, within)] == [200, 250]


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("what", ["mask", "albedo"])
def test_maps_beside_the_heights_lie_where_they_do(what, lazy):
    """Exchanged or reversed axes of a DataArray are refused; what is nearly there, or unlabelled, is not."""
    heights = dem(HEIGHTS[:, :70])
    given = heights > 100 if what == "mask" else heights / 1000
    if lazy:
        heights, given = heights.chunk(40), given.chunk(30)
    for wrong, said in ((given.T, "transpose"), (given[::-1], "coordinate 'y'"), (given[:, ::-1], "'x'")):
        with pytest.raises(sl.errors.InputError, match=f"{what}.*{said}"):
            sl.Scene.from_height(heights, **{what: wrong})
    for right in (given, given.assign_coords(x=given.x + 1e-6), given.drop_vars("y"), given.data):
        sl.Scene.from_height(heights, **{what: right})


def test_all_light_of_a_map_that_repeats(fast):
    """Whether light between surfaces counts is decided: it cannot be in such tiles, and its share is said."""
    scenes = [sl.Scene.from_height(given, sides="periodic") for given in (dem(), dem().chunk(40))]
    with pytest.warns(UserWarning, match="light between surfaces is left out"):
        tiles, lazy = (image(scene, sl.Sky(), fast, tolerance=0.05) for scene in scenes)
        found = lazy.compute(scheduler="sync")
    np.testing.assert_allclose(found, tiles, rtol=0, atol=2e-6)


def test_what_is_loaded(fast):
    """Of a small window, nine tiles' heights where the halo is all that counts; else all heights, for the
    overviews, and then those of the tile once more. Of several results that are computed together, all
    heights twice.
    """
    loaded = []

    def load(block, block_info=None):
        loaded.append(block_info[0]["chunk-location"])
        return block

    heights = SPACING * mountains(96, 128, 20)
    lazy = da.map_blocks(load, da.from_array(heights, chunks=32), dtype="f4", meta=np.empty((0, 0), "f4"))
    near = {(row, col) for row in (0, 1, 2) for col in (1, 2, 3)}
    for what, overviews, tiles in (("near", 0, near), ("horizons", 12, {(1, 2)}), ("sky", 12, {(1, 2)})):
        found = CALLS[what](dem(heights).copy(data=lazy), fast)
        assert not loaded
        found.isel(y=slice(40, 50), x=slice(70, 80)).compute(scheduler="sync")
        assert (len(loaded), set(loaded[overviews:])) == (overviews + len(tiles), tiles), what
        loaded.clear()
    together = [CALLS[what](dem(heights).copy(data=lazy), fast) for what in ("sky view", "openness", "sky")]
    dask.compute(*together, scheduler="sync")
    assert len(loaded) == 2 * 12


def test_calls_within_calls_of_xarray_and_dask(fast):
    """The bytes of the same call outside, with threads."""
    work, heights = CALLS["sky view"], dem()
    core = dict(input_core_dims=[["y", "x"]], output_core_dims=[["y", "x"]])
    inside = lambda values: work(dem(values), fast).values  # noqa: E731
    whole = xr.apply_ufunc(
        inside, heights.chunk(y=-1, x=-1), dask="parallelized", output_dtypes=["f4"], **core
    )
    assert_bits_equal(whole.compute(scheduler="threads").values, work(heights, fast).values)
    parts = heights.chunk(y=35, x=45)
    each = xr.map_blocks(lambda part: work(part, fast), parts, template=parts.rename("sky_view_factor"))
    for row in (slice(0, 35), slice(35, 70)):
        expected = work(heights[row, 45:], fast).values
        assert_bits_equal(each.compute(scheduler="threads")[row, 45:].values, expected)
    lazy = xr.apply_ufunc(lambda values: work(dem(values), fast).data, heights.chunk(40), dask="allowed")
    assert_bits_equal(lazy.persist().values, work(heights.chunk(40), fast).compute().values)


def spacing_and_warnings(heights):
    """The spacing, and how many warnings tell that the unit of heights is not known."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scene = sl.Scene.from_height(heights)
    return scene.spacing, sum(str(warning.message).startswith("Unit of height") for warning in said)


@pytest.mark.parametrize(
    "system, units, expected, said",
    [
        (2263, None, 30.0, 1),  # New York, US survey feet
        (2263, "US survey foot", 30.0, 0),
        (2263, "m", 30 * 1200 / 3937, 0),
        ("EPSG:2263+5703", None, 30 * 1200 / 3937, 0),  # heights in metres
        ("EPSG:2263+6360", None, 30.0, 0),  # and in US survey feet
        (32633, None, 30.0, 0),
        (32633, "ft", 30 / 0.3048, 0),
    ],
)
def test_units_of_a_reference_system(system, units, expected, said):
    """They count where coordinates and heights tell none; one warning where heights are in the dark."""
    pytest.importorskip("rioxarray")
    given = dem(**({"units": units} if units else {})).rio.write_crs(system)
    assert spacing_and_warnings(given) == (pytest.approx(expected, rel=1e-9), said)


@pytest.mark.parametrize("height, said", [(None, 0), ("m", 0), ("ft", 1), ("km", 1)])
def test_a_unit_of_heights_alone_is_not_dropped_in_silence(height, said):
    """It is taken as that of coordinates that tell none: the share of sky .36 off if these are metres."""
    assert spacing_and_warnings(dem(**({"units": height} if height else {}))) == (30.0, said)


def test_a_known_unit_counts_more_than_a_name():
    """Dimensions called lat and lon, in metres: they were refused as degrees."""
    given = dem().rename(y="lat", x="lon")
    given = given.assign_coords({name: given[name].assign_attrs(units="m") for name in ("lat", "lon")})
    assert spacing_and_warnings(given) == (30.0, 0)


def test_degrees_of_a_compound_system():
    """With heights."""
    pytest.importorskip("rioxarray")
    with pytest.raises(sl.errors.InputError, match="degrees"):
        sl.Scene.from_height(dem().rio.write_crs("EPSG:4326+5773"))


@pytest.mark.parametrize("lazy", [False, True])
def test_units_of_coordinates_and_heights(lazy):
    """The spacing is in the unit of height where both are told, else as the coordinates have it."""
    for along, height, expected in (
        ("km", "m", 30e3),
        ("m", "ft", 30 / 0.3048),
        ("US survey foot", "metre", 30 * 1200 / 3937),
        ("m", "metres", 30.0),
        ("km", None, 30.0),
        (None, "ft", 30.0),
    ):
        given = dem(**({"units": height} if height else {}))
        given = given.assign_coords(
            {n: given[n].assign_attrs(units=along) if along else given[n] for n in "xy"}
        )
        given = given.chunk(40) if lazy else given
        assert spacing_and_warnings(given) == (
            pytest.approx(expected, rel=1e-12),
            int(not (along and height)),
        )
    for attrs in (
        *({"units": u} for u in ("rad", "degree_N", "degreesE", "deg", "arcsec", "arc_second", "°")),
        {"units": "decimal degrees"},
        {"standard_name": "longitude"},
    ):
        with pytest.raises(sl.errors.InputError, match="degrees.*dem.rio.reproject"):
            sl.Scene.from_height(given.assign_coords(x=given.x.assign_attrs(attrs)))


def test_a_turned_grid_of_rioxarray_is_refused():
    """Its coordinates are of two dimensions; the spacing was 1, and the map 25 times too steep."""
    given = dem().drop_vars(["x", "y"])
    turned = given.assign_coords({name: (("y", "x"), HEIGHTS) for name in ("xc", "yc")})
    with pytest.raises(sl.errors.InputError, match="two-dimensional ones, xc.*dem.rio.reproject"):
        sl.Scene.from_height(turned)
    assert sl.Scene.from_height(given.assign_coords(quality=(("y", "x"), HEIGHTS))).spacing == 1


@pytest.mark.parametrize(("north", "stretch"), [(5.9e6, 1.463), (0.0, None)])
def test_a_projection_that_stretches_the_map_is_told(north, stretch):
    """Web Mercator, by 1.46 at 46.9 degrees and by nothing at the equator: 1 / cos."""
    pyproj = pytest.importorskip("pyproj")
    given = dem().assign_coords(y=dem().y + north)
    given["spatial_ref"] = given.spatial_ref.assign_attrs(crs_wkt=pyproj.CRS("EPSG:3857").to_wkt())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert sl.Scene.from_height(given).spacing == pytest.approx(SPACING)
    texts = [str(one.message) for one in told if "Projection" in str(one.message)]
    assert [f"{stretch:.3g} times" in text for text in texts] == ([True] if stretch else [])


@pytest.mark.parametrize(
    ("unit", "metres", "said"),
    [
        ("cm", 0.01, 0),
        ("mm", 0.001, 0),
        ("dm", 0.1, 0),
        ("US_survey_foot", 1200 / 3937, 0),
        ("international_foot", 0.3048, 0),
        ("m above sea level", 1.0, 0),
        ("furlong", 1.0, 1),
    ],
)
def test_every_unit_of_heights_is_known_or_told(unit, metres, said):
    """A unit that is told and not known is a warning, and no factor."""
    given = dem(units=unit).assign_coords({n: dem()[n].assign_attrs(units="m") for n in "xy"})
    assert spacing_and_warnings(given) == (pytest.approx(30 / metres, rel=1e-12), said)


@pytest.mark.parametrize("what", ["height", "albedo", "mask"])
@pytest.mark.parametrize("tile", [32, 128])
def test_chunks_of_another_shape_than_promised(what, tile, fast):
    """One error that names the chunk and both shapes; in tiles, and where the map is one."""

    def shorter(block, block_info=None):
        return block[:-1] if block_info[0]["chunk-location"] == (1, 2) else block

    lazy = da.from_array(HEIGHTS, chunks=32)
    false = da.map_blocks(shorter, lazy, dtype="f4", meta=np.empty((0, 0), "f4"))
    given = {"height": lazy} | {what: {"height": false, "albedo": false * 0, "mask": false < 1e9}[what]}
    scene = sl.Scene.from_height(**given, spacing=SPACING)
    options = dict(backend=fast, azimuths=4, tiling=sl.Tiling(tile, 8, 8))
    lazily = [sl.render(scene, sl.Sky(), **options).image]
    if what != "albedo":
        lazily.append(sl.sky_view_factor(scene, **options))
    for result in lazily:
        with pytest.raises(
            sl.errors.InputError, match=what + r": chunk \(1, 2\).*\(31, 26\).*\(32, 26\), by"
        ):
            result.compute(scheduler="sync")


def test_windows_carry_no_tables_of_the_sky(fast):
    """What is sent with the window of every tile is small, and the same under every sky."""
    import pickle

    scene = sl.Scene.from_height(da.from_array(np.zeros((96, 96), np.float32), chunks=32))
    tiling, keys = sl.Tiling(32, 16, 8), []
    for azimuth in (90.0, 180.0):
        sky = sl.Sky(sl.cie_clear((azimuth, 20.0), direct=5.0))
        image = sl.render(scene, sky, tiling=tiling, backend=fast, interreflection=False).image
        tasks = {key: task for key, task in dict(image.dask).items() if str(key[0]).startswith("window-")}
        assert tasks and all(len(pickle.dumps(task)) < 1e4 for task in tasks.values())
        keys.append(set(tasks))
    assert keys[0] == keys[1]


def test_a_map_as_reflectance_of_a_lazy_scene(fast):
    """Lambertian with a map is the same as that map as albedo."""
    albedo = np.random.default_rng(3).random(HEIGHTS.shape)
    found, expected = (
        sl.render(
            sl.Scene.from_height(dem().chunk(40), **surface), sl.Sky(), backend=fast, azimuths=4, tiling=TILES
        )
        for surface in ({"reflectance": sl.Lambertian(albedo)}, {"albedo": albedo})
    )
    assert_bits_equal(found.image.values, expected.image.values)
