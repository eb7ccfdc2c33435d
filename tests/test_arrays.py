"""Arrays of other libraries in: the same bytes as NumPy's. xarray in, xarray out."""

import contextlib
import copy
import dataclasses
import functools
import gc
import importlib
import pickle
import subprocess
import sys
import warnings
import weakref

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
from skylamp.arrays import host_array
from skylamp.backends import base, resident, select, staging
from skylamp.constants import NONE
from skylamp.scale import holds

DEPTH = scenes.rough(18, 23, 0.8, seed=4).astype(np.float32)


class WithArray:
    """numpy's protocol alone."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype)


class WithDlpack:
    """DLPack alone, as the array API has it; counts how often it was asked."""

    def __init__(self, values):
        self.values, self.asked = values, 0

    def __dlpack__(self, **options):
        self.asked += 1
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


class OnGpu:
    """As PyTorch and CuPy do for a GPU's array, numpy is refused and Warp gets the memory, here the CPU's."""

    def __init__(self, values):
        self.values = values
        self.__cuda_array_interface__ = {
            "shape": values.shape,
            "typestr": values.dtype.str,
            "data": (values.ctypes.data, False),
            "version": 3,
        }

    def __array__(self, *a, **k):
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def __dlpack__(self, **options):
        return self.values.__dlpack__()

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


def warp_array(values):
    import warp as wp

    return wp.array(values, dtype=wp.dtype_from_numpy(values.dtype), device="cpu")


@functools.cache
def scene_of_numpy(backend):
    """Albedo and light; the image of them, a corner under a uniform sky, its albedo, and the depth that is
    recovered from that, by arrays of NumPy.
    """
    rng = np.random.default_rng(2)
    albedo, light = rng.random(DEPTH.shape, np.float32), rng.random((6, 12), np.float32)
    scene = sl.Scene(DEPTH, albedo=albedo)
    image = sl.render(scene, sl.Sky(sl.environment_map(light)), backend=backend).image
    corner = sl.render(scene, sl.Sky(), backend=backend).image[:8, :8].copy(), albedo[:8, :8].copy()
    depth = sl.recover(corner[0], sl.Sky(), corner[1], layers=5, backend=backend).depth
    return albedo, light, image, corner, depth


@pytest.mark.slow
@pytest.mark.parametrize(
    "other", [WithArray, WithDlpack, OnGpu, warp_array, np.ndarray.tolist, np.asfortranarray]
)
def test_same_scene_from_every_kind_of_array(other, fast):
    """Depth, albedo, environment map and image; the caller's arrays are untouched."""
    albedo, light, expected, corner, depth = scene_of_numpy(fast)
    given = DEPTH, albedo, light, *corner
    before = [array.copy() for array in given]
    got = sl.render(
        sl.Scene(other(DEPTH), albedo=other(albedo)), sl.Sky(sl.environment_map(other(light))), backend=fast
    ).image
    assert_bits_equal(got, expected)
    found = sl.recover(other(corner[0]), sl.Sky(), other(corner[1]), layers=5, backend=fast)
    assert_bits_equal(found.depth, depth)
    for array, was in zip(given, before, strict=True):
        assert_bits_equal(array, was)


@pytest.mark.parametrize("other", [OnGpu, warp_array, WithDlpack, np.ndarray.tolist])
def test_brightness_functions_may_return_any_array(other, fast):
    """What they compute with PyTorch or CuPy, say, is brought to the host."""
    scene, light = sl.Scene(DEPTH), lambda L: 1 - L[..., 2]
    expected, got = (
        sl.render(scene, sl.Sky(function), azimuths=8, backend=fast).image
        for function in (light, lambda L: other(light(L)))
    )
    assert_bits_equal(got, expected)


@pytest.mark.parametrize("other", [WithArray, WithDlpack])
def test_masks(other, fast):
    """A mask comes by the same ways (DLPack has bool)."""
    mask = DEPTH > np.median(DEPTH)
    np.testing.assert_array_equal(sl.Scene(DEPTH, mask=other(mask)).mask, mask)


def test_dlpack_is_taken_without_a_copy():
    """host_array shares memory where that can be; the Scene copies once."""
    given = WithDlpack(DEPTH)
    assert np.shares_memory(host_array(given), DEPTH) and given.asked == 1
    assert host_array(DEPTH) is DEPTH


def test_cuda_array_interface_alone(monkeypatch):
    """Numba has no DLPack: Warp is given pointer, type, shape and strides, on its CUDA device."""
    import warp as wp

    class Numba:
        __cuda_array_interface__ = {
            "shape": (4, 3),
            "typestr": "<f8",
            "data": (DEPTH.ctypes.data, False),
            "strides": (24, 8),
            "version": 3,
        }

    made = []
    monkeypatch.setattr(
        wp,
        "array",
        type(
            "array",
            (),
            {"__init__": lambda self, **options: made.append(options), "numpy": lambda self: np.ones((4, 3))},
        ),
    )
    monkeypatch.setattr(wp, "synchronize", lambda: made.append("waited"))
    assert host_array(Numba()).shape == (4, 3)
    assert made == [
        "waited",
        {
            "ptr": DEPTH.ctypes.data,
            "dtype": wp.float64,
            "shape": (4, 3),
            "strides": (24, 8),
            "device": "cuda",
        },
    ]


def test_what_is_no_array():
    """An object whose protocol fails is one InputError with its reason."""

    class Broken:
        def __array__(self, *a, **k):
            raise RuntimeError("lost")

    class Lost(WithDlpack):
        def __dlpack_device__(self):
            raise RuntimeError("lost")

    for value in (Broken(), Lost(DEPTH), object(), {"a": 1}):
        with pytest.raises(sl.InputError, match="depth"):
            sl.Scene(value)


@pytest.fixture
def labelled():
    """A DEM as rioxarray reads one: dimensions y and x, coordinates, attributes, a name."""
    xarray = pytest.importorskip("xarray")
    return xarray.DataArray(
        100 - DEPTH,
        {"y": 4000.0 - 30 * np.arange(18), "x": 500.0 + 30 * np.arange(23), "spatial_ref": 0},
        ("y", "x"),
        "elevation",
        {"units": "m", "_FillValue": -9999, "AREA_OR_POINT": "Area"},
    )


def same_labels(got, like, name, units, leading=()):
    """Coordinates of ``like``, but a result's own name and unit; attributes of the old values are gone."""
    assert type(got) is type(like) and got.dims == (*leading, *like.dims) and got.name == name
    assert got.attrs.get("units") == units and got.attrs["long_name"]
    assert set(got.attrs) - {"units", "long_name"} == {"AREA_OR_POINT"}
    assert set(got.coords) == {*like.coords, *leading}
    for coordinate in like.coords:
        assert got.coords[coordinate].identical(like.coords[coordinate]), coordinate


def test_dataarray_in_dataarray_out(labelled, fast):
    """Every map that a scene gives carries its coordinates, name and unit, with the values of NumPy's."""
    before = labelled.copy(deep=True)
    scene, plain = sl.Scene.from_height(labelled, spacing=2), sl.Scene.from_height(labelled.values, spacing=2)
    lamp = sl.Lamp(center=(10, 10, -20), radius=4)
    for work, name, units in (
        (lambda s: sl.render(s, sl.Sky(), backend=fast).image, "radiance", None),
        (lambda s: sl.render(s, sl.Sky(), backend=fast).error, "radiance_error", None),
        (lambda s: sl.render(s, sl.Sky(), backend=fast, parts=True).reflected, "radiance", None),
        (
            lambda s: sl.render(s, lamp, "lattice", backend=fast, quantity="irradiance").image,
            "irradiance",
            None,
        ),
        (lambda s: sl.sky_view_factor(s, backend=fast), "sky_view_factor", "1"),
        (lambda s: sl.openness(s, backend=fast), "openness", "rad"),
        (lambda s: sl.openness(s, backend=fast, negative=True), "negative_openness", "rad"),
    ):
        same_labels(work(scene), labelled, name, units)
        assert_bits_equal(work(scene).values, work(plain))
    slopes = sl.horizons(scene, azimuths=8, backend=fast)
    same_labels(slopes, labelled, "horizon_slope", "1", ("azimuth",))
    np.testing.assert_allclose(slopes.azimuth, 2 * np.pi * (np.arange(8) + 0.5) / 8)
    assert slopes.azimuth.attrs["units"] == "rad"
    assert isinstance(sl.sky_view_factor(plain, backend=fast), np.ndarray)
    assert labelled.identical(before)
    same_labels(sl.render(sl.Scene(labelled), sl.Sky(), backend=fast).image, labelled, "radiance", None)


def test_a_dataarray_brings_spacing_and_holes(labelled, fast):
    """Spacing by its coordinates, 30; nan is masked there, as xarray has it, and an error in other arrays."""
    labelled = labelled.astype(float)
    labelled[3, 4] = np.nan
    scene = sl.Scene.from_height(labelled.values, 30.0, mask=np.isfinite(labelled.values))
    for work in (sl.sky_view_factor, sl.openness, sl.horizons):
        found, expected = work(labelled, azimuths=4, backend=fast), work(scene, azimuths=4, backend=fast)
        np.testing.assert_array_equal(found.values, expected)
    image = sl.render(sl.Scene.from_height(labelled), sl.Sky(), azimuths=4, backend=fast).image
    np.testing.assert_array_equal(image, sl.render(scene, sl.Sky(), azimuths=4, backend=fast).image)
    assert np.isnan(image.values[3, 4]) and np.isfinite(image.values).sum() == image.size - 1
    with pytest.raises(sl.InputError, match="NaN"):
        sl.Scene.from_height(labelled.values)


@pytest.mark.parametrize(
    "along", [np.arange(18).astype("datetime64[h]"), np.array([f"s{i}" for i in range(18)])]
)
def test_a_dataarray_along_time_is_no_map(labelled, along):
    """It was taken for one without coordinates."""
    rows = labelled.dims[0]
    told = labelled.assign_coords({rows: along})
    for work in (sl.sky_view_factor, sl.Scene.from_height, sl.Scene):
        with pytest.raises(sl.InputError, match=f"coordinate '{rows}' of a map.*allowed: numbers"):
            work(told)


def test_an_empty_dataarray_is_one_error(labelled):
    """As a selection is that takes rows the wrong way round; it was an IndexError."""
    for given in (labelled, labelled.chunk()):
        with pytest.raises(sl.InputError, match=r"shape \(0, "):
            sl.sky_view_factor(given.isel(y=slice(0, 0)))


def test_labels_are_a_copy(labelled, fast):
    """Changing the DataArray afterwards changes no result."""
    scene, before = sl.Scene(labelled), labelled.copy(deep=True)
    labelled.attrs["units"] = "ft"
    labelled.coords["spatial_ref"] = 7
    labelled.values[:] = 0
    same_labels(sl.sky_view_factor(scene, backend=fast), before, "sky_view_factor", "1")


@pytest.mark.slow
def test_recover_from_a_dataarray(labelled, fast):
    """Depth and the mask of drilled columns."""
    image = labelled / labelled.max()
    image.attrs, image.name = labelled.attrs, "image"
    found = sl.recover(image, sl.Sky(), layers=5, hemicube=3, backend=fast)
    same_labels(found.depth, image, "depth", None)
    same_labels(found.drilled, image, "drilled", "1")
    field = sl.visibility_field(sl.Scene(labelled), sl.Sky(), hemicube=3, layers=4, backend=fast)
    assert isinstance(field.view((3, 3, 0), backend=fast).brightness, np.ndarray)


@pytest.mark.slow
def test_xarray_is_not_imported():
    """Nor is anything else that a user may not have."""
    code = (
        "import sys, numpy as np, skylamp as sl; sl.sky_view_factor(sl.Scene(np.ones((4, 4))),"
        " backend='numpy'); print(*[m for m in ('xarray', 'pandas', 'rasterio', 'OpenEXR', 'cv2', 'pvlib',"
        " 'torch', 'cupy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=300)
    assert (done.returncode, done.stdout.split()) == (0, []), done


# -- maps that lie on a device already


def never(*a, **k):
    pytest.fail("the map came to the host")


@pytest.fixture
def stays(monkeypatch):
    """Nothing may fetch the map: neither the scene's host copy nor a download of its size."""
    from skylamp.backends.resident import Resident

    monkeypatch.setattr(Resident, "download", never)


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
@pytest.mark.parametrize("other", [warp_array, OnGpu])
def test_a_map_on_the_device_stays_there(other, sides, stays):
    """Sky, horizons, sky-view factor, openness, heights: the same bytes as from the host, without it."""
    kinds = [(sl.Scene, DEPTH), (sl.Scene.from_height, DEPTH.max() - DEPTH)]
    for make, values in kinds:
        plain, there = make(values, albedo=0.5, sides=sides), make(other(values), albedo=0.5, sides=sides)
        assert (
            there.resident is not None
            and there.resident.backend.name == "warp:cpu"
            and there.shape == DEPTH.shape
        )
        for work in (
            lambda s: sl.render(s, sl.Sky(sl.cie_clear((50, 40))), azimuths=12, backend="warp:cpu").image,
            lambda s: sl.horizons(s, 8, "warp:cpu"),
            lambda s: sl.sky_view_factor(s, backend="warp:cpu"),
            lambda s: sl.openness(s, 8, "warp:cpu"),
            lambda s: sl.horizons(s, 8, "warp:cpu", max_distance=5),
        ):
            got, expected = work(there), work(plain)
            np.testing.assert_array_equal(np.isneginf(got), np.isneginf(expected))
            assert_bits_equal(np.nan_to_num(got, neginf=0), np.nan_to_num(expected, neginf=0))


@pytest.mark.gpu
@pytest.mark.parametrize("library", ["cupy", "torch", "warp"])
def test_a_map_on_a_gpu_stays_there(library, stays):
    """As the last, with a map on cuda:0 of another library, on its own stream; other types go by the host."""
    name = "warp:cuda:0"
    if missing := {info.name: info.why for info in sl.backends() if not info.available}.get(name):
        pytest.skip(f"{name}: {missing}")
    made = pytest.importorskip(library, reason=f"{library} is not installed")
    there = {
        "cupy": lambda v: made.asarray(v),
        "torch": lambda v: made.as_tensor(v, device="cuda"),
        "warp": lambda v: made.array(v, device="cuda:0"),
    }[library]
    plain, scene = (
        sl.Scene(DEPTH, albedo=0.5),
        sl.Scene(there(DEPTH), albedo=there(np.full(DEPTH.shape, 0.5, np.float32))),
    )
    assert scene.resident.backend.name == name
    lamp = sl.Lamp(center=(9, 9, -4), radius=2)
    for work in (
        lambda s: sl.render(s, sl.Sky(), azimuths=12, backend=name).image,
        lambda s: sl.render(s, lamp, "horizon", backend=name).image,
        lambda s: sl.render(s, sl.Sky(), "lattice", hemicube=5, backend=name).image,
        lambda s: sl.render(s, sl.Sky(), tolerance=0.03, interreflection=False, backend=name).image,
        lambda s: sl.sky_view_factor(s, backend=name),
        lambda s: sl.horizons(s, 6, name),
        lambda s: sl.openness(s, 6, name, negative=True),
    ):
        found, expected = work(scene), work(plain)
        assert isinstance(found, resident.DeviceImage)
        assert_bits_equal(np.asarray(found), expected)
        if library == "cupy":
            assert_bits_equal(made.asnumpy(made.asarray(found)), expected)
        elif library == "torch":
            assert_bits_equal(made.from_dlpack(found).cpu().numpy(), expected)
    assert_bits_equal(host_array(there(DEPTH.astype(np.float64))), DEPTH.astype(np.float64))


def device_image():
    """As a map on a GPU gives it; on Warp's CPU, which has the same arrays."""
    engine = select("warp:cpu")
    return resident.DeviceImage(engine, engine.upload(DEPTH.ravel()), DEPTH.shape)


@pytest.mark.slow
def test_an_exported_image_outlives_its_result():
    """The array that another library made of it holds the memory."""
    image = device_image()
    owner, taken = weakref.ref(image.values), np.from_dlpack(image)
    del image
    gc.collect()
    assert owner() is not None
    assert_bits_equal(taken, DEPTH)
    del taken
    gc.collect()
    assert owner() is None


def test_images_and_maps_on_a_device_are_copied():
    """Pickled as the host's arrays: who reads them may have no such device."""
    image, scene = device_image(), sl.Scene(warp_array(DEPTH), 2.0, mask=DEPTH > 0.5)
    again, beside = pickle.loads(pickle.dumps(image)), copy.deepcopy(image)
    assert isinstance(again, np.ndarray) and beside.values is not image.values
    for found in (again, np.asarray(beside)):
        assert_bits_equal(found, DEPTH)
    for other in (pickle.loads(pickle.dumps(scene)), copy.deepcopy(scene)):
        assert other.resident is None
        np.testing.assert_array_equal(other.depth, scene.depth)
        np.testing.assert_array_equal(*(sl.sky_view_factor(s, backend="warp:cpu") for s in (other, scene)))


def test_what_must_have_it_on_the_host_gets_it(fast):
    """Another backend, lamps, the lattice and scene.depth: downloaded once, same bytes; spacing divides."""
    plain, there = sl.Scene(DEPTH, 2.5), sl.Scene(warp_array(DEPTH), 2.5)
    assert "depth" not in vars(there)
    lamp = sl.Lamp(center=(20, 20, -9), radius=5)
    for work in (
        lambda s: sl.render(s, sl.Sky(), backend=fast).image,
        lambda s: sl.render(s, lamp, backend=fast).image,
        lambda s: sl.render(s, lamp, method="lattice", backend=fast).image,
    ):
        assert_bits_equal(work(there), work(plain))
    assert_bits_equal(there.depth, plain.depth)
    got, expected = (sl.render(s, sl.Sky(), azimuths=16, backend="warp:cpu").image for s in (there, plain))
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    with pytest.raises(AttributeError, match="no attribute 'height'"):
        _ = there.height


@pytest.mark.parametrize(
    "scene",
    [
        sl.Scene(DEPTH, albedo=0.5),
        sl.Scene(DEPTH, albedo=np.where(DEPTH > 1, 0.2, 0.6), mask=DEPTH > 0.5),
        sl.Scene(DEPTH, reflectance=sl.Phong(0.3, 0.2, 20)),
        sl.Scene.from_height(1e5 + DEPTH, albedo=(0.1, 0.2, 0.3)),
    ],
)
def test_fields_of_a_scene_can_be_replaced(scene, fast):
    """One at a time; an albedo together with the reflectance that was made of it."""
    render = lambda one: sl.render(one, sl.Sky(), azimuths=8, backend=fast).image
    np.testing.assert_array_equal(render(dataclasses.replace(scene)), render(scene))
    assert dataclasses.replace(scene, sides="dark").sides == "dark"
    wide = dataclasses.replace(scene, spacing=3.0)
    assert wide.spacing == 3 and np.array_equal(wide.albedo, scene.albedo, equal_nan=True)
    with pytest.raises(sl.InputError, match="reflectance=None beside it"):
        dataclasses.replace(scene, albedo=0.4)
    assert dataclasses.replace(scene, albedo=0.4, reflectance=None).albedo == 0.4


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda made: pickle.loads(pickle.dumps(made))])
def test_copies_of_a_scene_are_read_only_too(copied):
    """Its range and what backends keep of it would not follow a change."""
    scene = copied(sl.Scene(DEPTH, mask=DEPTH > 0.5))
    for array in (scene.depth, scene.mask):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    for array in (
        sl.Lamp(volume=np.ones((2, 3, 4), bool)).volume,
        sl.Window(aperture=np.eye(4) > 0).aperture,
    ):
        assert not array.flags.writeable


def test_the_scene_keeps_its_own_copy():
    """Writing into the device array afterwards changes nothing, as on the host."""
    given = warp_array(DEPTH)
    scene = sl.Scene(given)
    before = sl.sky_view_factor(scene, backend="warp:cpu")
    given.fill_(0.0)
    assert_bits_equal(sl.sky_view_factor(scene, backend="warp:cpu"), before)


def test_bad_maps_on_the_device(stays):
    """The checks of the host, made where the map lies."""
    broken, negative = DEPTH.copy(), DEPTH - 1
    broken[3, 4] = np.nan
    for values, says in (
        (broken, "1 values are NaN or infinite"),
        (negative, "negative"),
        (DEPTH * 1e20, "too deep"),
    ):
        with pytest.raises(sl.InputError, match=says):
            sl.Scene(warp_array(values.astype(np.float32)))


def test_maps_that_the_host_must_straighten():
    """Other types and strides take the host's way, a mask does not; all with the same result."""
    import warp as wp

    for values, mask, stays in (
        (warp_array(DEPTH), DEPTH > 0.2, True),
        (warp_array(DEPTH.astype(np.float64)), None, False),
        (wp.array(np.ascontiguousarray(DEPTH.T), device="cpu").transpose(), None, False),
    ):
        scene = sl.Scene(values, mask=mask)
        assert (scene.resident is not None) == stays
        np.testing.assert_array_equal(scene.depth, np.where(True if mask is None else mask, DEPTH, np.nan))


HOLES = DEPTH.copy()
HOLES[3:6, 7:9] = HOLES[0, 0] = np.inf


@pytest.mark.parametrize("height", [False, True])
@pytest.mark.parametrize("mask", [None, np.isfinite(HOLES)], ids=["whole", "masked"])
def test_a_map_is_adopted_and_surveyed(backend, height, mask):
    """On every backend: depth of depths and of heights, the range, and the squares of differences."""
    engine = select(backend)
    given = DEPTH.max() - DEPTH if height else DEPTH
    depth, found = resident.adopt(engine, engine.upload(given.ravel()), DEPTH.shape, mask, height)
    valid = np.ones(DEPTH.shape, bool) if mask is None else mask
    expected = np.where(valid, np.float32(given[valid].max()) - given if height else DEPTH, np.inf)
    assert_bits_equal(engine.download(depth).reshape(DEPTH.shape), expected)
    assert found[:3] == (expected[valid].min(), expected[valid].max(), 0)
    for total, count, axis in zip(found.squares, found.pairs, (1, 0)):
        with np.errstate(invalid="ignore"):
            steps = np.diff(expected.astype(float), axis=axis)
        steps = steps[np.isfinite(steps)]
        assert count == len(steps) and total == pytest.approx((steps**2).sum(), rel=1e-5)


def test_values_that_are_no_length_are_counted(backend):
    """nan, and both infinities where they are not masked; parts of a step."""
    engine, values = select(backend), np.arange(12, dtype=np.float32).reshape(3, 4)
    values[0, 1], values[1, 2], values[2, 0] = np.nan, np.inf, -np.inf
    mask = np.ones(values.shape, bool)
    mask[2, 3] = False
    found = resident.adopt(engine, engine.upload(values.ravel()), values.shape, mask, False)[1]
    assert (found.broken, found.least, found.most) == (3, 0, 10)
    mask[0, 1] = mask[1, 2] = mask[2, 0] = False
    depth, found = resident.adopt(engine, engine.upload(values.ravel()), values.shape, mask, False)
    assert found.broken == 0
    fractions = resident.survey(engine, depth, values.shape, 2.0).fractional
    assert fractions == np.count_nonzero(values[mask] % 2)
    there = resident.in_layers(engine, engine.upload(np.float32([0.1, 0.3, np.inf, 0.5])), (2, 2), 0.1, found)
    assert there.step == 1 and there.download().tolist() == [[1, 3], [np.inf, 5]]


@pytest.mark.parametrize("sides", scenes.SIDES)
def test_heights_with_margins(backend, sides):
    """-depth / step on every backend, the map again where it repeats; and the slopes to far ground."""
    there = scenes.resident_map(backend, HOLES, 2.0)
    heights = there.heights(2, 1, 3, 4, -7.0, sides == "periodic")
    ground = np.where(np.isfinite(HOLES), -HOLES / np.float32(2), np.float32(-7))
    mode = {"mode": "wrap"} if sides == "periodic" else {"constant_values": np.float32(NONE)}
    padded = np.pad(ground, ((1, 4), (2, 3)), **mode)
    zero = np.float32(0)  # -0.0 becomes 0.0: nothing that is made of heights tells them apart
    assert_bits_equal(there.backend.download(heights).reshape(padded.shape) + zero, padded + zero)
    assert there.heights_range == (ground[np.isfinite(HOLES)].min(), ground[np.isfinite(HOLES)].max())
    copy = there.backend.empty((HOLES.size,), np.float32)
    there.copy_into(copy)
    assert_bits_equal(there.backend.download(copy).reshape(HOLES.shape) + zero, HOLES + zero)


def test_probe(backend):
    """The steepest slopes from every second node, in eight directions, to ground three and more rows away."""
    there = scenes.resident_map(backend, HOLES, 2.0)
    got = there.probe(there.heights(5, 5, 5, 5, -2e30), 5, 2, 3)
    height, (rows, cols) = -HOLES / np.float32(2), HOLES.shape
    ways = (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)
    for n, (i, j) in enumerate(ways):
        expected = np.full((-(-rows // 2), -(-cols // 2)), -np.inf)
        for y, x in np.ndindex(expected.shape):
            for away in (3, 4, 6, 8, 11, 14, 18, 23):
                row, col = 2 * y + j * away, 2 * x + i * away
                if (
                    0 <= row < rows
                    and 0 <= col < cols
                    and np.isfinite(HOLES[[row, 2 * y], [col, 2 * x]]).all()
                ):
                    slope = (height[row, col] - height[2 * y, 2 * x]) / away
                    expected[y, x] = max(expected[y, x], slope)
        np.testing.assert_allclose(got[n], expected.ravel(), rtol=1e-6)


def test_a_map_is_uploaded_once_and_released(fast):
    """A backend keeps it while the scene lives, or until it is released."""
    engine, scene = select(fast), sl.Scene(DEPTH)
    assert scene.on(engine) is scene.on(engine) and id(scene) in engine.kept
    scene.release(fast)
    assert id(scene) not in engine.kept
    scene.on(engine)
    key = id(scene)
    del scene
    gc.collect()
    assert key not in engine.kept


def test_a_backend_keeps_few_maps(fast, monkeypatch):
    """Those used last, as far as a quarter of its memory goes."""
    engine = select(fast)
    monkeypatch.setattr(type(engine), "memory", property(lambda self: 9 * DEPTH.nbytes))
    monkeypatch.setattr(engine, "shares", False)
    made = [sl.Scene(DEPTH + n) for n in range(3)]
    for n in (0, 1, 0, 2):
        made[n].on(engine)
    assert [id(scene) in engine.kept for scene in made] == [True, False, True]


def test_what_a_device_holds_counts_as_free(fast, monkeypatch):
    """A map is refused by the memory that there is once the backend has given back what it holds."""
    engine, free = select(fast), [100]
    monkeypatch.setattr(type(engine), "memory", property(lambda self: free[0]))
    monkeypatch.setattr(engine, "trim", lambda: free.__setitem__(0, 150))
    assert base.has_room(engine, 100, 100) and free == [100]
    assert base.has_room(engine, 150, 150) and free == [150]
    with pytest.raises(sl.CapacityError, match="A map needs 151 bytes; .* may take 150"):
        base.reserve(engine, 151, "A map", "Cut it.")


def test_the_limit_of_one_array_is_not_that_of_all(fast, monkeypatch):
    """Maps take several arrays, each of which must fit, as PoCL's limit of one allocation is small."""
    engine = select(fast)
    monkeypatch.setattr(type(engine), "memory", property(lambda self: 10**6))
    monkeypatch.setattr(engine, "most_array_bytes", 1000)
    base.reserve(engine, 5000, "A map", "Cut it.", largest=1000)
    with pytest.raises(sl.CapacityError, match="A map needs 1,001 bytes in one array; .* may take 1,000"):
        base.reserve(engine, 5000, "A map", "Cut it.", largest=1001)
    with pytest.raises(sl.CapacityError, match="5,000 bytes in one array"):
        base.reserve(engine, 5000, "A map", "Cut it.")
    for most, whole in ((1_014_000, True), (1_013_000, False)):  # tilts: 8 bytes of 356 x 356 nodes
        monkeypatch.setattr(engine, "most_array_bytes", most)
        assert holds(100, 100, engine) is whole


@pytest.mark.gpu
def test_a_gpu_holds_little_memory_and_gives_it_back():
    """Arrays of a former call are held, up to a bound, until a scene is released."""
    if missing := {info.name: info.why for info in sl.backends() if not info.available}.get("warp:cuda:0"):
        pytest.skip(f"warp:cuda:0: {missing}")
    engine = select("warp:cuda:0")
    scene = sl.Scene(np.zeros((2048, 2048), np.float32))
    scene.release(engine.name)
    before = engine.memory
    sl.sky_view_factor(scene, azimuths=4, backend=engine.name)
    assert before - base.MOST_HELD <= engine.memory < before - 2**26
    scene.release(engine.name)
    assert abs(engine.memory - before) < 2**26


@pytest.mark.gpu
def test_an_opencl_gpu_holds_little_memory_and_gives_it_back():
    """Likewise; arrays of the queue aside are no longer held once it has been joined."""
    names = [b.name for b in sl.backends() if b.available and b.gpu and b.name.startswith("opencl")]
    if not names:
        pytest.skip("no OpenCL GPU")
    engine = select(names[0])
    pool, scene = engine._pool, sl.Scene(np.zeros((2048, 2048), np.float32))
    held = lambda: pool.managed_bytes - pool.active_bytes
    sl.sky_view_factor(scene, azimuths=4, backend=engine.name)
    assert 2**26 < held() <= base.MOST_HELD and not engine._used_aside
    scene.release(engine.name)
    assert pool.held_blocks == 0


def test_equal_tables_are_uploaded_once(backend, monkeypatch):
    """By type, shape and bytes; large ones always; the oldest goes when there are many."""
    engine = select(backend)
    one, other = np.arange(6, dtype=np.float32), np.arange(6, dtype=np.int32)
    first = engine.table(one)
    assert engine.table(one.copy()) is first
    assert engine.table(other) is not first and engine.table(one.reshape(2, 3)) is not first
    assert_bits_equal(engine.download(engine.table(one)), one)
    large = np.zeros(base.TABLE_BYTES + 1, np.uint8)
    assert engine.table(large) is not engine.table(large)
    monkeypatch.setattr(base, "TABLES", 2)
    engine.tables.clear()
    kept = engine.table(one), engine.table(other)
    assert engine.table(one) is kept[0]
    engine.table(one + 1)
    assert engine.table(one) is kept[0] and engine.table(other) is not kept[1]


def test_relief_far_above_zero(fast):
    """Heights at 1e7 with a relief of 1 in float64 render like the same without the offset."""
    height = DEPTH.max() - DEPTH.astype(float)
    plain, far = (
        sl.render(sl.Scene.from_height(height / height.max() + offset), sl.Sky(), azimuths=12, backend=fast)
        for offset in (0.0, 1e7)
    )
    np.testing.assert_allclose(far.image, plain.image, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "dtype, least", [("i8", 2**53), (">i8", 2**53), ("i8", -(2**63)), ("u8", 2**64 - 20)]
)
def test_heights_of_64_bits_keep_their_digits(dtype, least):
    """float64 holds whole numbers up to 2^53; a difference of any two is exact modulo 2^64."""
    height = np.array([[least + 4 * row + col for col in range(4)] for row in range(4)], dtype)
    depth = 15.0 - np.arange(16).reshape(4, 4)
    scene = sl.Scene.from_height(height)
    assert scene.deepest == 15
    np.testing.assert_array_equal(scene.depth, depth)
    mask = depth < 12
    height[0] = np.iinfo(height.dtype).max
    scene = sl.Scene.from_height(height, mask=mask)
    assert scene.deepest == 11
    np.testing.assert_array_equal(scene.depth, np.where(mask, depth, np.nan))


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_depths_far_from_zero_under_a_sky(fast, sides):
    """As heights: where z = 0 lies means nothing to a sky, and float32 would leave steps of 1 and of 64."""
    depth = 1 + DEPTH.astype(float) / DEPTH.max()
    near, sky = sl.Scene(depth, sides=sides), sl.Sky(lambda L: 1 - L[..., 2])
    made = {
        "auto": lambda scene: sl.render(scene, sky, backend=fast).image,
        "lattice": lambda scene: sl.render(scene, sky, method="lattice", hemicube=5, backend=fast).image,
        "sky-view factor": lambda scene: sl.sky_view_factor(scene, backend=fast),
        "bits": lambda scene: sl.visibility(scene, sky, 5, backend=fast),
        "plan": lambda scene: np.array(sl.plan(scene, sky, backend=fast).azimuths),
    }
    for offset in (1e7, 1e9):
        far = sl.Scene(depth + offset, sides=sides)
        for name, make in made.items():
            kept = 1e-5 if offset > 1e8 else 2e-6  # steps of float64 at 1e9 are 1e-7
            np.testing.assert_allclose(make(far), make(near), rtol=0, atol=kept, err_msg=f"{name} {offset}")
        assert sl.render(far, sky, backend=fast).warnings == []
    counts = np.rint(20 * depth).astype(np.int64)
    images = [sl.render(sl.Scene(c, sides=sides), sky, backend=fast).image for c in (counts, counts + 10**9)]
    np.testing.assert_allclose(*images, rtol=1e-6)


def test_depths_far_from_zero_that_float32_rounds_are_told(fast):
    """Where z = 0 counts, under a lamp or in a box, and none where nothing is rounded."""
    depth, lamp = 1e7 + DEPTH.astype(float) / DEPTH.max(), sl.Lamp((5, 5, 1e7 - 20), 3)
    for scene, source in ((sl.Scene(depth), lamp), (sl.Scene(depth, sides="dark"), sl.Sky())):
        (text,) = sl.render(scene, source, azimuths=8, backend=fast).warnings
        assert text.startswith("Depths are rounded by 0.6 spacings")
    for scene in (sl.Scene(depth.astype(np.float32)), sl.Scene(np.full((5, 6), 1e7)), sl.Scene(DEPTH)):
        assert scene.rounding == 0 and scene.under_sky() is scene


@pytest.mark.parametrize("size", [(3, 5), (700, 900)])
def test_a_scene_of_any_type_of_numbers(size):
    """Integers, halves, doubles, in bands and whole: depths to the nearest float32, nan where masked."""
    rng = np.random.default_rng(1)
    values = rng.integers(0, 200, size)
    mask = rng.random(size) < 0.7
    for kind in (np.uint8, np.int64, np.float16, np.float32, np.float64):
        scene = sl.Scene.from_height(values.astype(kind), mask=mask)
        expected = values[mask].max() - values.astype(float)
        np.testing.assert_array_equal(scene.depth, np.where(mask, expected, np.nan).astype(np.float32))
        depth, step = scene.lattice
        assert step == 1 and np.isposinf(depth[~mask]).all() and (depth[mask] == expected[mask]).all()


def test_shade(backend):
    """A map of albedos or a number, a unit, no less than asked, and nan where masked; fetched by asarray."""
    there, rng = scenes.resident_map(backend, HOLES), np.random.default_rng(3)
    engine, values = there.backend, rng.normal(size=HOLES.shape).astype(np.float32)
    albedo = rng.random(HOLES.shape, np.float32)
    for share in (albedo, 0.25):
        image = resident.DeviceImage(engine, engine.upload(values.ravel()), HOLES.shape)
        image.shade(there, share, 0.5, -0.1)
        expected = np.maximum(values, np.float32(-0.1)) * (np.float32(share) * np.float32(0.5))
        np.testing.assert_array_equal(np.asarray(image), np.where(np.isfinite(HOLES), expected, np.nan))


WIDE = scenes.rough(150, 160, 0.8, seed=5).astype(np.float32)
WIDE_MASK = scenes.rough(150, 160, 1.0, seed=6) > 1


@contextlib.contextmanager
def passing_for_a_gpu():
    """Warp's CPU as if it were a GPU; the test fails where a whole map is fetched from it or sent to it."""
    engine, (rows, cols) = select("warp:cpu"), WIDE.shape
    sizes = {(rows + 2 * m) * (cols + 2 * m) for m in range(20)}  # a map, with margins

    def counted(transfer):
        def work(array, *args, **more):
            if array.size in sizes and getattr(array, "dtype", None) != np.uint8:
                pytest.fail(f"a map crossed: {transfer.__name__}")
            return transfer(array, *args, **more)

        return work

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "shares", False)
        for name in ("download", "upload", "put"):
            patch.setattr(engine, name, counted(getattr(engine, name)))
        yield


STAYS = {
    "sky by horizons": lambda s, b: sl.render(s, sl.Sky(0.7), "horizon", backend=b, azimuths=8).image,
    "lamp by slices": lambda s, b: (
        sl.render(s, sl.Lamp(center=(9, 9, -4), radius=2), "horizon", backend=b).image
    ),
    "window by slices": lambda s, b: sl.render(s, sl.Window(x=(3, 12), y=(2, 9)), "horizon", backend=b).image,
    "lattice": lambda s, b: sl.render(s, sl.Sky(), "lattice", backend=b, hemicube=7).image,
    "irradiance": lambda s, b: sl.render(s, sl.Sky(), "horizon", backend=b, quantity="irradiance").image,
    "sky within tolerance": lambda s, b: (
        sl.render(s, sl.Sky(1.3), tolerance=0.03, interreflection=False, backend=b).image
    ),
    "lamp within tolerance": lambda s, b: (
        sl.render(
            s, sl.Lamp(center=(40, 40, -20), radius=9), tolerance=0.01, interreflection=False, backend=b
        ).image
    ),
    "window within tolerance": lambda s, b: (
        sl.render(
            s, sl.Window(x=(30, 90), y=(20, 80)), tolerance=0.03, interreflection=False, backend=b
        ).image
    ),
    "sky-view factor": lambda s, b: sl.sky_view_factor(s, backend=b),
    "horizons": lambda s, b: sl.horizons(s, 6, b),
    "openness": lambda s, b: sl.openness(s, 6, b, max_distance=40),
    "negative openness": lambda s, b: sl.openness(s, 6, b, negative=True),
}


@pytest.mark.parametrize("name", STAYS)
@pytest.mark.parametrize("masked", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_maps_and_images_stay_on_a_gpu(name, masked):
    """The same numbers as from the host; CUDA libraries find the image where it lies."""
    mask = WIDE_MASK if masked else None
    with passing_for_a_gpu():
        found = STAYS[name](sl.Scene(warp_array(WIDE), mask=mask), "warp:cpu")
        assert isinstance(found, resident.DeviceImage) and found.held is None  # no other memory
        described = found.__cuda_array_interface__
    plain = STAYS[name](sl.Scene(WIDE, mask=mask), "warp:cpu")
    assert described["shape"] == found.shape == plain.shape and described["typestr"] == "<f4"
    assert found.ndim == plain.ndim and repr(found.shape[-1]) in repr(found)
    np.testing.assert_array_equal(np.asarray(found), plain)
    np.testing.assert_array_equal(np.from_dlpack(found), plain)


@pytest.mark.parametrize("factor", [1.0, 2.5])
def test_light_between_surfaces_of_a_map_on_a_gpu(monkeypatch, factor, stays):
    """It starts from the direct light of brightness 1, whatever was made of that on the device."""
    ground = WIDE[:40, :48].copy()
    work = lambda scene: sl.render(scene, sl.Sky(factor), tolerance=0.05, backend="warp:cpu")
    plain = work(sl.Scene(ground))
    assert plain.interreflection.included
    monkeypatch.setattr(select("warp:cpu"), "shares", False)
    there = work(sl.Scene(warp_array(ground)))
    assert isinstance(there.image, resident.DeviceImage)
    np.testing.assert_allclose(np.asarray(there.image), plain.image, rtol=1e-5)


def test_horizons_come_from_a_gpu_as_from_a_cpu(backend, monkeypatch):
    """Planes that were swept on the turned map are turned back on a device with memory of its own."""
    scene = sl.Scene(WIDE[:24, :41].copy())
    plain = sl.horizons(scene, 6, backend)
    monkeypatch.setattr(select(backend), "shares", False)
    assert_bits_equal(sl.horizons(scene, 6, backend), plain)


def test_pieces_of_a_device_array_go_to_their_parts():
    """Parts of any size take their elements in turn, through rooms that are used again."""
    values = np.arange(3 * staging.ROOM, dtype=np.uint8)
    order = []

    def copy(array, start, room, fetch):
        order.append((start, room.size))
        return lambda: room.__setitem__(slice(None), array[start : start + room.size])

    rooms = [np.zeros(staging.ROOM, np.uint8) for _ in range(staging.ROOMS)]
    parts = [np.zeros(size, np.uint8) for size in (7, 2 * staging.ROOM + 1, 0, staging.ROOM - 8)]
    staging.Staging(rooms, copy).fetch(values, parts)
    np.testing.assert_array_equal(np.concatenate(parts), values)
    assert order == [
        (0, 7),
        (7, staging.ROOM),
        (7 + staging.ROOM, staging.ROOM),
        (7 + 2 * staging.ROOM, 1),
        (8 + 2 * staging.ROOM, staging.ROOM - 8),
    ]


def test_no_room_is_filled_again_before_its_transfer_is_over():
    """A transfer reads its room as late as it may: when it is waited for."""
    values = np.random.default_rng(0).integers(0, 256, 7 * staging.ROOM + 5, np.uint8)
    there = np.zeros_like(values)

    def copy(array, start, room, fetch):
        return lambda: array.__setitem__(slice(start, start + room.size), room)

    rooms = [np.zeros(staging.ROOM, np.uint8) for _ in range(staging.ROOMS)]
    staging.Staging(rooms, copy).upload(values, there)
    np.testing.assert_array_equal(there, values)


@pytest.mark.parametrize("attribute", ["_FillValue", "missing_value", "nodata", "nodatavals", "rio"])
def test_every_name_of_no_data_masks(attribute):
    """Those of CF, GDAL and xarray.open_rasterio, and what rioxarray keeps beside the attributes."""
    xarray = pytest.importorskip("xarray")
    heights = np.arange(20, dtype=np.int16).reshape(4, 5)
    heights[1, 2] = -32768
    given = xarray.DataArray(heights, dims=("y", "x"))
    if attribute == "rio":
        pytest.importorskip("rioxarray")
        given = given.rio.set_nodata(-32768)
    else:
        given.attrs[attribute] = (-32768,) if attribute == "nodatavals" else -32768
    scene = sl.Scene.from_height(given)
    assert scene.mask is not None and not scene.mask[1, 2] and scene.mask.sum() == 19
    result = sl.sky_view_factor(scene, backend="numpy")
    assert np.isnan(result[1, 2]) and not set(result.attrs) & {"nodata", "nodatavals", "_FillValue"}


def test_modules_with_optional_libraries_can_be_imported():
    """As ``import skylamp.geo`` and ``from skylamp import geo``: the same functions."""
    for name, function in (("geo", "read"), ("plot", "save")):
        module = importlib.import_module(f"skylamp.{name}")
        assert getattr(module, function) is getattr(getattr(sl, name), function)
        assert all(hasattr(module, public) for public in module.__all__)


def test_coordinates_that_may_be_degrees_are_told():
    """Without a unit, a name or a system that says so, by relief 100 times as high as the map is wide."""
    xarray = pytest.importorskip("xarray")
    heights = 200 * np.random.default_rng(0).random((8, 9))
    for step, told in ((1 / 3600, True), (30.0, False)):
        places = {"y": 46 - step * np.arange(8), "x": 8 + step * np.arange(9)}
        given = xarray.DataArray(heights, places, ("y", "x"), attrs={"units": "m"})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sl.Scene.from_height(given)
        assert any("If these are degrees" in str(w.message) for w in caught) == told
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            sl.Scene.from_height(given, 30.0)
