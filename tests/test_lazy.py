"""Lazy maps as users of xarray, rioxarray and Dask bring them, and what becomes of their results there."""

import numpy as np
import pytest
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


def image(scene, source, **options):
    return sl.render(scene, source, backend="numpy", tiling=TILES, **options).image


CALLS = {
    "horizons": lambda heights: sl.horizons(heights, 4, "numpy", tiling=TILES),
    "sky view": lambda heights: sl.sky_view_factor(heights, azimuths=4, backend="numpy", tiling=TILES),
    "coarser": lambda heights: sl.sky_view_factor(
        heights, azimuths=4, backend="numpy", tiling=sl.Tiling(64, 16, 8)
    ),
    "near": lambda heights: sl.sky_view_factor(
        heights, azimuths=4, backend="numpy", tiling=TILES, max_distance=200.0
    ),
    "openness": lambda heights: sl.openness(heights, 4, "numpy", tiling=TILES),
    "seen from below": lambda heights: sl.openness(heights, 4, "numpy", negative=True, tiling=TILES),
    "sky": lambda heights: image(sl.Scene.from_height(heights), sl.Sky(), azimuths=4),
    "all light": lambda heights: image(sl.Scene.from_height(heights), sl.Sky(), tolerance=0.05),
    "lamp": lambda heights: image(sl.Scene.from_height(heights), LAMP, max_distance=900.0),
}


def test_names_tell_what_is_computed():
    """The same call has the same keys, so that Dask computes it once; any other call has another name."""
    names = {}
    for what, call in CALLS.items():
        one, again = (call(dem().chunk(40)) for _ in range(2))
        assert set(one.__dask_graph__()) == set(again.__dask_graph__()), what
        names[what] = one.data.name
        assert call(dem(HEIGHTS + 1).chunk(40)).data.name != one.data.name
    assert len(set(names.values())) == len(CALLS)


def test_a_key_means_the_same_in_all_graphs():
    """What two results share they compute alike: a scheduler that holds both may hang else."""
    heights, known = dem().chunk(40), {}
    for what, call in CALLS.items():
        graph = call(heights).__dask_graph__()
        for key, after in graph.get_all_dependencies().items():
            assert known.setdefault(key, after) == after, (what, key)
