"""GeoTIFF: the same georeference out as in, cells in degrees, holes, damaged files, the command line."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

import skylamp as sl
from skylamp import io
from skylamp.app import cli
from skylamp.errors import InputError
from skylamp.io import geotiff as geo

rasterio = pytest.importorskip("rasterio")
from rasterio.transform import Affine, from_origin  # noqa: E402

HEIGHT = np.rint(40 * np.random.default_rng(5).random((13, 17))).astype(np.int16)
HEIGHT[3, 4:6] = -32768
MOON = "+proj=eqc +R=1737400 +units=m"
METRES = dict(crs="EPSG:32616", transform=from_origin(730000, 4070000, 30, 30))


def make(
    path,
    values=HEIGHT,
    *,
    crs="EPSG:32616",
    transform=METRES["transform"],
    nodata=-32768,
    tags=(),
    band=(),
    **options,
):
    values = values if values.ndim == 3 else values[None]
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=values.shape[2],
        height=values.shape[1],
        count=len(values),
        dtype=values.dtype,
        crs=crs,
        transform=transform,
        nodata=nodata,
        **options,
    ) as file:
        file.write(values)
        file.update_tags(**dict(tags))
        for name, value in dict(band).items():
            setattr(file, name, value)
    return path


def facts(path):
    with rasterio.open(path) as file:
        return file.crs, file.transform, file.nodata, file.tags()["AREA_OR_POINT"], file.shape, file.dtypes


def refused(says, function, *arguments, **options):
    with pytest.raises(InputError) as caught:
        function(*arguments, **options)
    text = str(caught.value)
    assert all(part in text for part in ((says,) if isinstance(says, str) else says)) and "\n" not in text, (
        text
    )


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code or 0


@pytest.mark.parametrize("tags", [{}, {"AREA_OR_POINT": "Point"}], ids=["area", "point"])
@pytest.mark.parametrize("nodata", [-32768, None, 0])
def test_same_georeference_out_as_in(tmp_path, tags, nodata, fast):
    """Rendered by the command line; reopened with rasterio; heights, spacing and holes are the file's own."""
    height = (
        np.where(HEIGHT == -32768, 9, HEIGHT).astype(HEIGHT.dtype) if nodata == 0 else HEIGHT
    )  # a pit of 32 km is black, and 0 its radiance
    path, out = make(tmp_path / "dem.tif", height, nodata=nodata, tags=tags), tmp_path / "lit.tif"
    assert run("render", path, "--out", out, "--backend", fast) == 0
    crs, transform, _, area, shape, _ = facts(path)
    got = facts(out)
    assert (got[0], got[1], got[3], got[4], got[5]) == (
        crs,
        transform,
        area,
        shape,
        ("float32",),
    ) and crs.to_epsg() == 32616
    mask = np.ones(HEIGHT.shape, bool) if nodata is None else height != nodata
    expected = sl.render(sl.Scene.from_height(height, spacing=30.0, mask=mask), sl.Sky(), backend=fast).image
    with rasterio.open(out) as file:
        np.testing.assert_array_equal(file.read(1)[mask], expected[mask])
        np.testing.assert_array_equal(file.read_masks(1) > 0, mask)
        assert np.isnan(file.nodata) and np.isnan(file.read(1)[~mask]).all()  # as files made in tiles


def test_colours_are_bands(tmp_path, fast):
    """Of an image in colour; it was refused after the render."""
    path = make(tmp_path / "dem.tif", np.maximum(HEIGHT, 0))
    assert run("render", path, tmp_path / "a.tif", "--albedo", ".5,.4,.3", "--backend", fast) == 0
    with rasterio.open(tmp_path / "a.tif") as file:
        image = file.read()
        assert (file.count, file.crs, file.transform) == (3, *facts(path)[:2])
    assert (image[0] > image[1]).all() and (image[1] > image[2]).all()
    geo.write(tmp_path / "b.tif", np.moveaxis(image, 0, -1), geo.read(path))  # as render() gives it
    with rasterio.open(tmp_path / "b.tif") as file:
        assert np.array_equal(file.read(), image)


@pytest.mark.parametrize(
    ("crs", "east", "north", "stretch"),
    [
        ("EPSG:3857", 4e5, 5.9e6, "1.46"),
        ("EPSG:3857", 4e5, 0, None),
        ("EPSG:32632", 4e5, 5.2e6, None),
        ("EPSG:32660", 833_800, 1e4, None),
        ("EPSG:3035", 5.09e6, 4.26e6, None),  # equal areas, 11 degrees from its middle
        ("EPSG:3035", 2.66e6, 1.95e6, "0.987 to 1.01"),
        (MOON, 4e5, 1e6, None),
    ],
)
def test_a_projection_that_stretches_the_map_is_told(tmp_path, crs, east, north, stretch):
    """Web Mercator far from the equator, equal areas far from their middle; not UTM, also across 180 degrees,
    nor a moon, which rasterio does not know. A DataArray is told the same.
    """
    rioxarray = pytest.importorskip("rioxarray")
    path = make(tmp_path / "dem.tif", crs=crs, transform=from_origin(east, north, 25, 25))
    of_file = lambda: geo.read(path).spacing
    of_array = lambda: sl.Scene.from_height(rioxarray.open_rasterio(path, masked=True)[0]).spacing
    for spacing_of in (of_file, of_array) if crs != MOON else (of_file,):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert spacing_of() == 25
        texts = [str(one.message) for one in told if "Projection" in str(one.message)]
        assert [f"{stretch} times" in text for text in texts] == ([True] if stretch else [])
        assert all(("divide the spacing" in text) == ("to" not in stretch) for text in texts)


def test_a_spacing_that_is_given_silences_its_warnings(tmp_path):
    """The cure that a warning names: of lengths on the map, and of units."""
    path = make(tmp_path / "dem.tif", crs="EPSG:3857", transform=from_origin(4e5, 5.9e6, 25, 25))
    feet = make(tmp_path / "feet.tif", crs="EPSG:2263", transform=from_origin(9.8e5, 2e5, 25, 25))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for file in (path, feet):
            assert geo.read(file, spacing=17.1).spacing == geo.header(file, spacing=17.1).spacing == 17.1
            with pytest.raises(UserWarning, match="Projection|Unit of height"):
                geo.read(file)
    refused("spacing: got -1", geo.read, path, spacing=-1)


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude"),
    [
        ("EPSG:3035", 24.0, 60.5),
        ("EPSG:3413", 16.0, 78.0),
        ("EPSG:32633", 12.2, 60.0),
        ("EPSG:2193", 168.0, -45.0),
    ],
)
def test_the_convergence_is_that_of_pyproj(tmp_path, crs, longitude, latitude):
    """At the middle of the map, of a path, a raster and a DataArray alike; south-up files too."""
    pyproj, rioxarray = pytest.importorskip("pyproj"), pytest.importorskip("rioxarray")
    expected = pyproj.Proj(crs).get_factors(longitude, latitude).meridian_convergence
    x, y = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude)
    sides = 30 * HEIGHT.shape[1] / 2, 30 * HEIGHT.shape[0] / 2
    for transform in (
        from_origin(x - sides[0], y + sides[1], 30, 30),
        Affine(30, 0, x - sides[0], 0, 30, y - sides[1]),
    ):
        path = make(tmp_path / "dem.tif", crs=crs, transform=transform)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of lengths on the map
            maps = path, str(path), geo.read(path), rioxarray.open_rasterio(path)[0]
        for dem in maps:
            assert geo.convergence(dem) == pytest.approx(expected, abs=1e-5)


def test_an_array_without_coordinates_lies_where_its_transform_says(tmp_path):
    """Its spacing and convergence were 1 and 0; degrees and turned grids are refused as with coordinates."""
    rioxarray = pytest.importorskip("rioxarray")
    read = lambda path: rioxarray.open_rasterio(path, masked=True, parse_coordinates=False)[0]
    path = make(tmp_path / "dem.tif")
    own, usual = read(path), rioxarray.open_rasterio(path, masked=True)[0]
    assert not set(own.dims) & set(own.coords)
    for dem in (own, usual.drop_vars(["x", "y"]), own.chunk(4)):
        assert sl.Scene.from_height(dem).spacing == 30
    assert geo.convergence(own) == geo.convergence(usual) != 0
    found = sl.sky_view_factor(own, azimuths=4, backend="numpy")
    assert set(found.coords) == set(own.coords)
    np.testing.assert_array_equal(found, sl.sky_view_factor(usual, azimuths=4, backend="numpy"))
    with pytest.raises(sl.InputError, match="albedo: coordinate 'y'"):
        sl.Scene.from_height(own, albedo=0 * usual.assign_coords(y=usual.y + 300) + 0.5)
    south = make(tmp_path / "south.tif", transform=Affine(30, 0, 730000, 0, 30, 4070000))
    for file in (path, south):  # rows that run south, and north
        given = read(file), rioxarray.open_rasterio(file, masked=True)[0]
        np.testing.assert_array_equal(*(sl.horizons(dem, azimuths=4, backend="numpy") for dem in given))
    degrees = make(tmp_path / "degrees.tif", crs="EPSG:4326", transform=from_origin(5, 40, 1e-3, 1e-3))
    turned = make(tmp_path / "turned.tif", transform=METRES["transform"] * Affine.rotation(10))
    for dem, says in ((degrees, "degrees"), (turned, "transform of the reference system, of a turned")):
        refused(says, sl.Scene.from_height, read(dem))
    odd = own.copy()
    odd.spatial_ref.attrs["GeoTransform"] = "1 2 three"  # no transform at all
    assert sl.Scene.from_height(odd).spacing == 1


def test_a_result_is_written_where_its_coordinates_say(tmp_path):
    """One with rows from south to north was mirrored, since a Raster is north up."""
    rioxarray = pytest.importorskip("rioxarray")
    south = make(tmp_path / "south.tif", transform=Affine(30, 0, 730000, 0, 30, 4070000))
    result = 1.0 + rioxarray.open_rasterio(south, masked=True)[0]
    like, out = geo.read(south), tmp_path / "out.tif"
    refused(("coordinate 'y': got", "sortby"), geo.write, out, result, like)
    moved = result.sortby("y", ascending=False)
    refused("coordinate 'x'", geo.write, out, moved.assign_coords(x=moved.x + 30), like)
    assert not out.exists()
    geo.write(out, moved, like)
    np.testing.assert_array_equal(rioxarray.open_rasterio(out, masked=True)[0], moved)
    geo.write(out, moved.drop_vars(["x", "y", "spatial_ref"]), like)
    geo.write(out, moved.expand_dims(colour=3, axis=-1), like)
    refused("coordinate 'y'", geo.write, out, result.expand_dims(colour=3, axis=-1), like)


def test_files_of_results_declare_nan(tmp_path):
    """As no data, also those that rioxarray writes."""
    rioxarray = pytest.importorskip("rioxarray")
    dem = rioxarray.open_rasterio(make(tmp_path / "dem.tif"))[0]
    found = sl.sky_view_factor(dem, azimuths=4, backend="numpy")
    found.rio.to_raster(tmp_path / "out.tif")
    with rasterio.open(tmp_path / "out.tif") as file:
        assert np.isnan(file.nodata) and not file.read_masks(1)[3, 4:6].any()


def test_no_projection_no_convergence(tmp_path):
    for name, options in {
        "moon": dict(crs=MOON),
        "degrees": dict(crs="EPSG:4326", transform=from_origin(5, 40, 1e-3, 1e-3)),
        "none": dict(crs=None),
    }.items():
        assert geo.convergence(make(tmp_path / f"{name}.tif", **options)) == 0.0
    refused("convergence: got ndarray", geo.convergence, HEIGHT)


def test_a_sun_by_time_and_place_stands_in_the_axes_of_the_map(tmp_path, fast):
    """--sun TIME,LAT,LON over Finland on the map of Europe: 12 degrees from the same numbers as AZ,EL."""
    pytest.importorskip("pvlib")
    path = make(
        tmp_path / "dem.tif",
        np.maximum(HEIGHT, 0),
        crs="EPSG:3035",
        transform=from_origin(5.09e6, 4.26e6, 30, 30),
    )
    time, place = "2026-03-20T08:00Z", (60.5, 24.0)
    azimuth, elevation = sl.sun_position(time, *place)
    turned = azimuth - geo.convergence(path)
    assert abs(turned - azimuth) > 10
    images = []
    for sun in (f"{time},60.5,24", f"{turned},{elevation}", f"{azimuth},{elevation}"):
        out = tmp_path / "light.tif"
        options = ("--source", "clear", "--sun", sun, "--direct", "5", "--backend", fast)
        assert run("render", path, out, *options) == 0
        images.append(geo.read(out).values)
    np.testing.assert_allclose(images[0], images[1], rtol=1e-5)
    assert abs(images[0] - images[2]).max() > 0.02 * images[0].max()


@pytest.mark.parametrize(
    "light", [("--lamp", "730195,4069880,-9,3"), ("--window", "730100,730200,4069800,4069900")]
)
def test_a_lamp_in_coordinates_of_the_reference_system(tmp_path, capsys, fast, light):
    """It lay far away, and the image was black; the error says where it lies from the first node."""
    path = make(tmp_path / "dem.tif", np.maximum(HEIGHT, 0))
    for command in (
        ("render", path, tmp_path / "a.tif"),
        ("plan", path),
        ("field", path, tmp_path / "a.npy"),
    ):
        assert run(*command, *light, "--backend", fast) == 2
        errors = capsys.readouterr().err
        assert light[0] in errors and "to the east and" in errors
    assert run("render", path, tmp_path / "a.tif", "--lamp", "195,120,-90,3", "--backend", fast) == 0


@pytest.mark.slow
def test_warnings_of_a_command_are_one_line(tmp_path):
    """Without the place in the code that gives them."""
    path = make(tmp_path / "dem.tif", crs="EPSG:3857", transform=from_origin(4e5, 5.9e6, 25, 25))
    arguments = ["horizon", path, tmp_path / "a.tif", "--backend", "numpy"]
    done = subprocess.run([sys.executable, "-m", "skylamp", *arguments], capture_output=True, text=True)
    lines = [line for line in done.stderr.splitlines() if "1.46 times" in line]
    assert done.returncode == 0 and len(lines) == 1 and lines[0].startswith("skylamp: ")
    assert "geotiff.py" not in done.stderr


def test_layers_are_bands(tmp_path, fast):
    """Horizons and fields are several maps: one band each, with the georeference too."""
    path = make(tmp_path / "dem.tif", np.maximum(HEIGHT, 0))
    assert (
        run(
            "horizon",
            path,
            "--what",
            "slopes",
            "--azimuths",
            4,
            "--out",
            tmp_path / "a.tif",
            "--backend",
            fast,
        )
        == 0
    )
    expected = sl.horizons(geo.read(path).scene(), 4, fast)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert (file.count, file.crs, file.transform) == (4, *facts(path)[:2])
        np.testing.assert_array_equal(file.read(), expected)


def test_holes_stay_holes_when_heights_are_written_again(tmp_path):
    """Of files with a scale and an offset, with a band of masks, and of resampled cells."""
    rasterio = pytest.importorskip("rasterio")
    about = dict(driver="GTiff", width=30, height=24, count=1, crs="EPSG:32632")
    square, oblong = (rasterio.transform.from_origin(4e5, 5e6, 30, north) for north in (30, 20))
    values = np.arange(720, dtype=np.int16).reshape(24, 30)
    values[4:9, 7:15] = -9999
    with rasterio.open(
        tmp_path / "scaled.tif", "w", dtype="int16", nodata=-9999, transform=square, **about
    ) as f:
        f.write(values, 1)
        f.scales, f.offsets = (0.1,), (5.0,)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        with rasterio.open(tmp_path / "band.tif", "w", dtype="float32", transform=square, **about) as f:
            f.write(values.astype(np.float32), 1)
            f.write_mask(values != -9999)
    with rasterio.open(
        tmp_path / "oblong.tif", "w", dtype="int16", nodata=-9999, transform=oblong, **about
    ) as f:
        f.write(values, 1)
    for name in ("scaled", "band", "oblong"):
        first = geo.read(tmp_path / f"{name}.tif", resample=name == "oblong")
        geo.write(tmp_path / "again.tif", first.values.astype(np.float32), first)
        again = geo.read(tmp_path / "again.tif")
        assert not first.mask.all() and np.array_equal(again.mask, first.mask), name
        np.testing.assert_allclose(again.values[again.mask], first.values[again.mask], rtol=1e-6)
        filled = np.where(first.mask, first.values, 7.25).astype(np.float32)
        geo.write(tmp_path / "filled.tif", filled, first)
        assert geo.read(tmp_path / "filled.tif").mask.all()


def test_nodata_that_is_a_value(tmp_path):
    """No data is 0 in the file, and shadows are 0 too: holes become NaN instead of swallowing the shadows."""
    raster = geo.read(make(tmp_path / "dem.tif", nodata=0))
    light = np.where(raster.mask, 1.0, np.nan).astype(np.float32)
    light[0, 0] = 0
    geo.write(tmp_path / "a.tif", light, raster)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert np.isnan(file.nodata)
        np.testing.assert_array_equal(file.read(1), light)
    geo.write(tmp_path / "c.tif", raster.values.astype(np.float32), raster)  # its own heights: 0 is a hole
    assert np.array_equal(geo.read(tmp_path / "c.tif").mask, raster.mask)
    geo.write(
        tmp_path / "b.tif", raster.mask, geo.read(make(tmp_path / "dem.tif"))
    )  # -32768 does not fit into a byte
    assert facts(tmp_path / "b.tif")[2] is None and facts(tmp_path / "b.tif")[5] == ("uint8",)


def test_unit_of_a_band_that_is_written(tmp_path):
    """Heights in feet that are written with their unit are read in feet; other arrays have none."""
    feet = dict(crs="EPSG:2274", transform=from_origin(1e6, 5e5, 10, 10), band={"units": ("us-ft",)})
    dem = geo.read(make(tmp_path / "dem.tif", **feet))
    assert dem.unit == "us-ft"
    geo.write(tmp_path / "same.tif", dem.values, dem, unit=dem.unit)
    assert geo.read(tmp_path / "same.tif").spacing == dem.spacing == pytest.approx(10)
    geo.write(tmp_path / "two.tif", np.stack([dem.values, dem.values]), dem, unit="W m-2")
    geo.write(tmp_path / "none.tif", dem.values, dem)
    with rasterio.open(tmp_path / "two.tif") as two, rasterio.open(tmp_path / "none.tif") as none:
        assert two.units == ("W m-2", "W m-2") and none.units == (None,)
    refused(("unit", "7"), geo.write, tmp_path / "bad.tif", dem.values, dem, unit=7)


@pytest.mark.parametrize("latitude", [0, 46.0, -60.0])
def test_degrees(tmp_path, latitude, fast):
    """Refused with both lengths; resampled to squares, the light is that of the ground in metres."""
    arc = 1 / 3600
    y, x = np.mgrid[:40, :44]
    dem = make(
        tmp_path / "dem.tif",
        (200 + 3.0 * x + 2.0 * y).astype(np.float32),
        crs="EPSG:4326",
        transform=from_origin(7.5, latitude + 20 * arc, arc, arc),
        nodata=None,
    )
    with rasterio.open(dem) as file:  # metres by PROJ, not by us
        from rasterio.crs import CRS
        from rasterio.warp import transform

        centre = (7.5, latitude)
        local = CRS.from_proj4(f"+proj=aeqd +lat_0={latitude} +lon_0=7.5 +datum=WGS84")
        east = transform(file.crs, local, [centre[0] + arc], [centre[1]])[0][0]
        north = transform(file.crs, local, [centre[0]], [centre[1] + arc])[1][0]
    if abs(east / north - 1) > geo.MOST_OBLONG:
        refused(
            ("cells are not square", f"{east:.4g} m to the east by {north:.4g} m", "--resample", "rio warp"),
            geo.read,
            dem,
        )
    raster = geo.read(dem, resample=True)
    assert raster.spacing == pytest.approx(min(east, north), rel=5e-3) and raster.crs.to_epsg() == 4326
    rows, cols = raster.values.shape
    assert (cols * raster.transform.a, rows * raster.transform.e) == pytest.approx(
        (44 * arc, -40 * arc)
    )  # the same ground
    slope = np.hypot(3 / east, 2 / north)  # a plane's light says what its slope came out as
    image = sl.render(raster.scene(albedo=1.0), sl.Sky(), quantity="irradiance", backend=fast).image
    middle = image[rows // 2, cols // 2]
    assert middle == pytest.approx(np.pi * (1 + 1 / np.sqrt(1 + slope**2)) / 2, rel=2e-3)
    geo.write(tmp_path / "a.tif", image, raster)
    assert facts(tmp_path / "a.tif")[:2] == (raster.crs, raster.transform)


def test_holes_grow_no_heights(tmp_path):
    """Resampling keeps what lies beside a hole out of it: no height is made of a nodata value."""
    values = np.full((30, 30), 100, np.int16)
    values[10:13, 10:13] = -32768
    raster = geo.read(
        make(tmp_path / "dem.tif", values, crs="EPSG:4326", transform=from_origin(7, 50, 1 / 3600, 1 / 3600)),
        resample=True,
    )
    assert (raster.values[raster.mask] == 100).all() and 0.9 < raster.mask.mean() < 1


def test_what_is_not_finite_is_no_data(tmp_path):
    """Also where the file's nodata value is another; a mask of the caller's leaves out more."""
    values = HEIGHT.astype(np.float32)
    values[5, 5], values[5, 6] = np.nan, np.inf
    raster = geo.read(make(tmp_path / "a.tif", values))
    wanted = (HEIGHT != -32768) & np.isfinite(values)
    assert np.array_equal(raster.mask, wanted) and np.array_equal(raster.scene().mask, wanted)
    mine = np.ones(HEIGHT.shape, bool)
    mine[0] = False
    assert np.array_equal(raster.scene(mask=mine).mask, wanted & mine)
    for wrong in (mine[1:], mine.astype(int)):
        with pytest.raises(InputError, match="mask: wrong type or shape"):
            raster.scene(mask=wrong)


def test_units(tmp_path):
    """US survey feet of the system, of the band, and of a compound system's heights; and scaled counts."""
    feet = dict(crs="EPSG:2274", transform=from_origin(1e6, 5e5, 10, 10))  # Tennessee, ftUS
    with pytest.warns(UserWarning, match="^Unit of height: .*a.tif tells none.*US survey foot.*metres"):
        assert geo.read(make(tmp_path / "a.tif", **feet)).spacing == pytest.approx(10 * 1200 / 3937)
    assert geo.read(make(tmp_path / "a.tif", band={"units": ("us-ft",)}, **feet)).spacing == pytest.approx(10)
    for crs, spacing in (("EPSG:2274+6360", 10), ("EPSG:32616+6360", 10 * 3937 / 1200)):
        compound = make(tmp_path / "a.tif", **feet | {"crs": crs})
        assert geo.read(compound).spacing == pytest.approx(spacing)
    assert geo.read(make(tmp_path / "a.tif", band={"units": ("cm",)})).spacing == pytest.approx(3000)
    with pytest.warns(UserWarning, match="^Unit of height: 'furlong' in .*a.tif is not known.*metres"):
        assert geo.read(make(tmp_path / "a.tif", band={"units": ("furlong",)})).spacing == pytest.approx(30)
    raster = geo.read(make(tmp_path / "a.tif", band={"scales": (0.1,), "offsets": (100.0,)}))
    np.testing.assert_allclose(raster.values[0], 100 + 0.1 * HEIGHT[0])
    assert not raster.mask[3, 4] and raster.mask.sum() == HEIGHT.size - 2


@pytest.mark.slow
def test_recover_keeps_spacing_and_georeference(tmp_path, fast):
    """Of an image that is a GeoTIFF: depth and std lie where it does; cells without data do not count."""
    rng = np.random.default_rng(2)
    image = rng.uniform(0.05, 0.09, (12, 10)).astype(np.float32)
    path, out, std = make(tmp_path / "i.tif", image), tmp_path / "d.tif", tmp_path / "s.tif"
    options = "--sides", "dark", "--layers", "6", "--max-seconds", "0.5", "--backend", fast
    assert run("recover", path, "--out", out, "--std", std, *options) == 0
    assert facts(out)[:2] == facts(std)[:2] == facts(path)[:2]
    spacing = geo.read(path).spacing
    assert spacing > 5 and spacing < geo.read(out).values.max() <= 6 * spacing
    options = *options, "--max-seconds", "100"  # so that no clock decides
    image[3, 4] = -32768
    assert run("recover", make(tmp_path / "i.tif", image), "--out", out, *options) == 0
    image[3, 4] = 0.07
    mask = np.ones(image.shape)
    mask[3, 4] = 0
    io.write(tmp_path / "m.npy", mask)
    masked = tmp_path / "e.tif"
    path = make(tmp_path / "i.tif", image)
    assert run("recover", path, "--out", masked, "--mask", tmp_path / "m.npy", *options) == 0
    np.testing.assert_array_equal(geo.read(out).values, geo.read(masked).values)


def test_depth_and_spacing_can_be_told(tmp_path, fast):
    """--depth and --spacing overrule a GeoTIFF; --resample needs one; a plain TIFF stays plain."""
    path = make(tmp_path / "dem.tif")
    assert (
        run("render", path, "--depth", "--spacing", "2", "--out", tmp_path / "a.npy", "--backend", fast) == 0
    )
    mask = HEIGHT != -32768
    expected = sl.render(sl.Scene(np.where(mask, HEIGHT, 0), 2.0, mask=mask), sl.Sky(), backend=fast).image
    np.testing.assert_array_equal(io.read(tmp_path / "a.npy"), expected)
    io.write(tmp_path / "plain.tif", np.ones((4, 5), np.float32))
    assert not geo.is_geotiff(tmp_path / "plain.tif") and geo.is_geotiff(path)
    assert run("render", tmp_path / "plain.tif", "--out", tmp_path / "b.tif", "--backend", fast) == 0
    assert not geo.is_geotiff(tmp_path / "b.tif")
    assert run("render", tmp_path / "plain.tif", "--resample", "--out", tmp_path / "b.tif") == 2


@pytest.mark.parametrize(
    "options, says",
    [
        (dict(values=np.stack([HEIGHT] * 3)), "bands: got 3"),
        (dict(transform=Affine(28, -10, 730000, -10, -28, 4070000)), "turned grid"),
        (dict(transform=Affine(-30, 0, 0, 0, 30, 0)), "turned grid"),
        (dict(transform=from_origin(0, 0, 30, 20)), ("not square", "30 m to the east by 20 m to the north")),
        (dict(crs="EPSG:4326", transform=from_origin(0, 70, 1, 1)), ("change their width", "57 to 70")),
        (dict(crs="EPSG:4326", transform=from_origin(0, 95, 1, 1)), "latitudes"),
        (dict(values=(HEIGHT + 0j).astype(np.complex64), nodata=None), "real numbers"),
    ],
)
def test_rasters_that_do_not_fit(tmp_path, options, says):
    """One clear error, with what to do where something can be done."""
    refused(says, geo.read, make(tmp_path / "a.tif", **options))


@pytest.mark.parametrize("tags", [{}, {"AREA_OR_POINT": "Point"}], ids=["area", "point"])
def test_south_up(tmp_path, tags, fast):
    """Rows from south to north are read, windowed, resampled and rendered as the same ground north up."""
    usual = make(tmp_path / "usual.tif", tags=tags)
    up = Affine(30, 0, 730000, 0, 30, 4070000 - 30 * len(HEIGHT))
    other = make(tmp_path / "other.tif", HEIGHT[::-1], transform=up, tags=tags)
    found, expected = geo.read(other), geo.read(usual)
    np.testing.assert_array_equal(found.values, expected.values)
    np.testing.assert_array_equal(found.mask, expected.mask)
    assert (found.transform, found.spacing) == (expected.transform, expected.spacing)
    assert geo.header(other).transform == expected.transform
    for part in ((slice(0, 13), slice(0, 17)), (slice(2, 5), slice(3, 9))):
        np.testing.assert_array_equal(geo.window(other, *part), geo.window(usual, *part))
    options = ("--source", "clear", "--sun", "150,30", "--backend", fast)
    for path in (usual, other):
        assert run("render", path, "--out", path.with_suffix(".lit.tif"), *options) == 0
    with rasterio.open(tmp_path / "usual.lit.tif") as a, rasterio.open(tmp_path / "other.lit.tif") as b:
        np.testing.assert_array_equal(a.read(), b.read())
        assert (a.transform, a.tags()) == (b.transform, b.tags())
    arc = 1 / 3600
    degrees = dict(crs="EPSG:4326", tags=tags)
    make(usual, transform=from_origin(7, 50, arc, arc), **degrees)
    make(other, HEIGHT[::-1], transform=Affine(arc, 0, 7, 0, arc, 50 - 13 * arc), **degrees)
    found, expected = geo.read(other, resample=True), geo.read(usual, resample=True)
    np.testing.assert_allclose(found.values, expected.values, atol=1e-3)
    assert found.transform.almost_equals(expected.transform, 1e-9)
    assert found.spacing == pytest.approx(expected.spacing, rel=1e-9)


def test_control_points_are_no_transform(tmp_path):
    """A file with ground control points alone is refused, not read with cells of 1 m."""
    from rasterio.control import GroundControlPoint

    path = tmp_path / "a.tif"
    corners = [(0, 0, 7e5, 4e6), (0, 17, 7e5 + 510, 4e6), (13, 0, 7e5, 4e6 - 390)]
    with rasterio.open(
        path, "w", driver="GTiff", width=17, height=13, count=1, dtype="int16", crs="EPSG:32616",
        gcps=[GroundControlPoint(*corner) for corner in corners],
    ) as file:  # fmt: skip
        file.write(HEIGHT, 1)
    refused("a.tif: no transform: got control points alone", geo.read, path)


def test_not_a_geotiff(tmp_path):
    """No georeference, another format under the name (a VRT could name any file), what cannot be written."""
    io.write(tmp_path / "plain.tif", np.ones((4, 5), np.float32))
    refused("no georeference: got a plain TIFF", geo.read, tmp_path / "plain.tif")
    source = make(tmp_path / "dem.tif")
    (tmp_path / "vrt.tif").write_text(
        '<VRTDataset rasterXSize="17" rasterYSize="13"><VRTRasterBand dataType="Int16"'
        ' band="1"><SimpleSource>'
        f"<SourceFilename>{source}</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    refused("vrt.tif: cannot read", geo.read, tmp_path / "vrt.tif")
    raster = geo.read(source)
    for path, array in (
        (tmp_path / "a.png", raster.mask),
        (tmp_path / "a.tif", raster.mask[1:]),
        (tmp_path / "a.tif", raster.values * 1j),
        (tmp_path / "no" / "a.tif", raster.mask),
    ):
        before = sorted(tmp_path.iterdir())
        refused(str(path), geo.write, path, array, raster)
        assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "options",
    [
        {},
        dict(compress="deflate"),
        dict(compress="lzw", blockysize=2),
        dict(tiled=True, blockxsize=16, blockysize=16),
    ],
    ids=["plain", "deflate", "lzw", "tiles"],
)
def test_truncated_and_damaged(tmp_path, options):
    """Cut anywhere: an error, or all values; with changed bytes: an InputError or a raster."""
    path = make(tmp_path / "a.tif", **options)
    whole, data = geo.read(path).values, path.read_bytes()
    for length in sorted({1, 8, 100, *np.linspace(10, len(data) - 1, 25).astype(int).tolist()}):
        path.write_bytes(data[:length])
        try:
            np.testing.assert_array_equal(geo.read(path).values, whole)
        except InputError as error:
            assert "a.tif" in str(error) and "\n" not in str(error)
    rng = np.random.default_rng(3)
    for _ in range(40):
        position = int(rng.integers(len(data)))
        path.write_bytes(
            data[:position] + bytes([data[position] ^ int(rng.integers(1, 256))]) + data[position + 1 :]
        )
        try:
            geo.read(path)
        except InputError as error:
            assert "a.tif" in str(error)


@pytest.mark.slow
def test_command_line_stays_one_line(tmp_path):
    """GDAL and rasterio log by themselves; a process says one line."""
    path = make(tmp_path / "a.tif")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    done = subprocess.run(
        [sys.executable, "-m", "skylamp.app.cli", "render", str(path), "--out", str(tmp_path / "o.npy")],
        capture_output=True,
        timeout=300,
    )
    assert (
        done.returncode == 3
        and done.stdout == b""
        and done.stderr.count(b"\n") == 1
        and b"a.tif" in done.stderr
    ), done


def test_without_rasterio(tmp_path, monkeypatch):
    """The error names the pip command; a plain TIFF does not need it."""
    path = make(tmp_path / "a.tif")
    monkeypatch.setitem(sys.modules, "rasterio", None)
    refused("a GeoTIFF needs rasterio, which is not installed: pip install 'skylamp[geo]'", geo.read, path)
    io.write(tmp_path / "plain.tif", np.ones((4, 5), np.float32))
    assert run("render", path, "--out", tmp_path / "a.npy") == 3
    assert run("render", tmp_path / "plain.tif", "--out", tmp_path / "a.npy", "--backend", "numpy") == 0


def test_a_file_in_place_of_a_raster(tmp_path):
    path = make(tmp_path / "dem.tif")
    refused(("like: got PosixPath", "Raster"), geo.write, tmp_path / "a.tif", HEIGHT, path)


@pytest.mark.parametrize(
    "array",
    [
        np.ma.masked_less(HEIGHT, 1e9),
        [[1, 2], [3]],
        HEIGHT.astype(np.longdouble),
        HEIGHT.astype(np.float16),
        HEIGHT * 1j,
        np.zeros((0, *HEIGHT.shape)),
        HEIGHT[1:],
    ],
)
def test_what_a_geotiff_would_not_give_back_is_refused(tmp_path, array):
    """A mask was dropped; ragged lists and long doubles were raw errors."""
    raster = geo.read(make(tmp_path / "d.tif"))
    refused("cannot write the array", geo.write, tmp_path / "a.tif", array, raster)
    assert not (tmp_path / "a.tif").exists()


def test_failing_write_leaves_no_trace(tmp_path, monkeypatch):
    """A full disk at the last moment: the older file stays."""
    raster = geo.read(make(tmp_path / "a.tif"))
    before = (tmp_path / "a.tif").read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        geo.write(tmp_path / "a.tif", raster.mask, raster)
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"] and (tmp_path / "a.tif").read_bytes() == before
