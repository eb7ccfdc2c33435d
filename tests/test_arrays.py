"""Arrays of other libraries in: the same bytes as NumPy's. xarray in, xarray out."""

import subprocess
import sys

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
from skylamp.arrays import host_array

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


@pytest.mark.slow
@pytest.mark.parametrize(
    "other", [WithArray, WithDlpack, OnGpu, warp_array, np.ndarray.tolist, np.asfortranarray]
)
def test_same_scene_from_every_kind_of_array(other, fast):
    """Depth, albedo, environment map and image; the caller's array is untouched."""
    rng = np.random.default_rng(2)
    albedo, light, before = rng.random(DEPTH.shape, np.float32), rng.random((6, 12), np.float32), DEPTH.copy()
    expected = sl.render(
        sl.Scene(DEPTH, albedo=albedo), sl.Sky(sl.environment_map(light)), backend=fast
    ).image
    got = sl.render(
        sl.Scene(other(DEPTH), albedo=other(albedo)), sl.Sky(sl.environment_map(other(light))), backend=fast
    ).image
    assert_bits_equal(got, expected)
    assert_bits_equal(
        sl.recover(other(expected), sl.Sky(), layers=5, hemicube=3, backend=fast).depth,
        sl.recover(expected, sl.Sky(), layers=5, hemicube=3, backend=fast).depth,
    )
    assert_bits_equal(DEPTH, before)


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
        {"units": "m", "_FillValue": -9999},
    )


def same_labels(got, like, leading=()):
    assert (
        type(got) is type(like)
        and got.dims == (*leading, *like.dims)
        and got.name == like.name
        and got.attrs == like.attrs
    )
    assert set(got.coords) == {*like.coords, *leading}
    for name in like.coords:
        assert got.coords[name].identical(like.coords[name]), name


def test_dataarray_in_dataarray_out(labelled, fast):
    """Every map that a scene gives carries the labels, with the values that NumPy gets."""
    before = labelled.copy(deep=True)
    scene, plain = sl.Scene.from_height(labelled, spacing=2), sl.Scene.from_height(labelled.values, spacing=2)
    lamp = sl.Lamp(center=(10, 10, -20), radius=4)
    for work in (
        lambda s: sl.render(s, sl.Sky(), backend=fast).image,
        lambda s: sl.render(s, lamp, method="lattice", backend=fast).image,
        lambda s: sl.sky_view_factor(s, backend=fast),
        lambda s: sl.openness(s, backend=fast),
        lambda s: sl.openness(s, backend=fast, negative=True),
    ):
        same_labels(work(scene), labelled)
        assert_bits_equal(work(scene).values, work(plain))
    slopes = sl.horizons(scene, azimuths=8, backend=fast)
    same_labels(slopes, labelled, ("azimuth",))
    np.testing.assert_allclose(slopes.azimuth, 2 * np.pi * (np.arange(8) + 0.5) / 8)
    assert isinstance(sl.sky_view_factor(plain, backend=fast), np.ndarray)
    assert labelled.identical(before)
    same_labels(sl.render(sl.Scene(labelled), sl.Sky(), backend=fast).image, labelled)


def test_labels_are_a_copy(labelled, fast):
    """Changing the DataArray afterwards changes no result."""
    scene, before = sl.Scene(labelled), labelled.copy(deep=True)
    labelled.attrs["units"] = "ft"
    labelled.coords["spatial_ref"] = 7
    labelled.values[:] = 0
    same_labels(sl.sky_view_factor(scene, backend=fast), before)


def test_recover_from_a_dataarray(labelled, fast):
    """Depth and the mask of drilled columns."""
    image = labelled / labelled.max()
    image.attrs, image.name = labelled.attrs, "image"
    found = sl.recover(image, sl.Sky(), layers=5, hemicube=3, backend=fast)
    same_labels(found.depth, image)
    same_labels(found.drilled, image)
    field = sl.visibility_field(sl.Scene(labelled), sl.Sky(), hemicube=3, layers=4, backend=fast)
    assert isinstance(field.view((3, 3, 0), backend=fast).brightness, np.ndarray)


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
    assert_bits_equal(
        sl.render(scene, sl.Sky(), azimuths=12, backend=name).image,
        sl.render(plain, sl.Sky(), azimuths=12, backend=name).image,
    )
    assert_bits_equal(sl.sky_view_factor(scene, backend=name), sl.sky_view_factor(plain, backend=name))
    assert_bits_equal(host_array(there(DEPTH.astype(np.float64))), DEPTH.astype(np.float64))


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


def test_maps_that_the_host_must_straighten(fast):
    """Masks, other types and strides take the host's way, with the same result."""
    import warp as wp

    mask = DEPTH > 0.2
    for values, options in (
        (warp_array(DEPTH), {"mask": mask}),
        (warp_array(DEPTH.astype(np.float64)), {}),
        (wp.array(np.ascontiguousarray(DEPTH.T), device="cpu").transpose(), {}),
    ):
        scene = sl.Scene(values, **options)
        assert scene.resident is None
        np.testing.assert_array_equal(scene.depth, np.where(options.get("mask", True), DEPTH, np.nan))


@pytest.mark.parametrize("sides", scenes.SIDES)
def test_kernels_of_resident_maps(backend, sides):
    """On every backend: the checks, the padded map and the slopes are those of the host."""
    from skylamp.backends import select
    from skylamp.backends.resident import adopt
    from skylamp.light import sweeps as horizon

    engine = select(backend)
    heights = DEPTH.max() - DEPTH
    for height, depth in ((False, DEPTH), (True, np.float32(heights.max()) - heights)):
        here = adopt(engine, engine.upload((heights if height else DEPTH).ravel()), DEPTH.shape, height)
        assert (here.least, here.most, here.broken) == (depth.min(), depth.max(), 0)
        assert_bits_equal(here.download(), depth)
        padded = here.padded(5, 2.0, sides, horizon.NONE)
        zero = np.float32(0)  # -0.0 becomes 0.0: nothing that is made of heights tells them apart
        assert_bits_equal(
            engine.download(padded) + zero,
            horizon._padded(horizon.Ground(-depth / np.float32(2), sides), 5) + zero,
        )
        got = here.probe(padded, 5, 2, 3)
        np.testing.assert_allclose(got, horizon._probe(-depth / np.float32(2), 2, 3), rtol=1e-6)
