"""Lazy maps as users of xarray, rioxarray and Dask bring them, and what becomes of their results there."""

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
    return sl.render(sl.Scene.from_height(heights), source, backend=on, tiling=TILES, **options).image


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
