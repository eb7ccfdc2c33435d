"""Surface visibility and the field: every backend and both algorithms equal the oracle bit for bit."""

import functools

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
from skylamp import oracle
from skylamp.backends import select
from skylamp.errors import CapacityError, InputError
from skylamp.sources.shapes import APERTURE, BALL, RECTANGLE, VOLUME, Geometry

NOTHING = np.zeros((1, 1, 1), np.uint8)
SKY = sl.Sky()


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
@pytest.mark.parametrize("size", [3, 5, 9])
@pytest.mark.parametrize("name", list(scenes.MAPS))
def test_scan_and_propagation_equal_the_oracle(backend, name, size, sides):
    """Every map in whole layers, hemicubes of three sizes, every kind of side."""
    scene, expected = scenes.scene(name, sides), scenes.truth(name, size, sides)
    assert_bits_equal(sl.visibility(scene, SKY, size, backend), expected)
    assert_bits_equal(sl.visibility(scene, SKY, size, backend, algorithm="propagate"), expected)


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("fractal", 7),
        ("walls", 9),
        ("spikes", 5),
        ("plateaus", 7),
        ("masked", 9),
        ("terrain", 9),
        ("column", 17),
        ("row", 9),
        ("column", 7),
        ("tiny", 9),
        ("one", 5),
    ],
)
def test_filled_scan_equals_brute_force_over_all_crossings(backend, name, size, sides):
    """filled=True tests every crossing with a grid line; M = 17 has more elevations than a byte holds."""
    assert_bits_equal(
        sl.visibility(scenes.scene(name, sides), SKY, size, backend, filled=True),
        scenes.filled_truth(name, size, sides),
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sides"), [("noise", "dark"), ("small noise", "periodic")])
def test_filled_scan_of_a_large_hemicube(fast, name, sides):
    """M = 17 on a whole map, on the backend that takes the least time."""
    assert_bits_equal(
        sl.visibility(scenes.scene(name, sides), SKY, 17, fast, filled=True),
        scenes.filled_truth(name, 17, sides),
    )


@functools.cache
def _window(name):
    depth, _ = scenes.whole_layers(name)
    rows, cols = depth.shape
    y, x = np.mgrid[:rows, :cols]
    aperture = (x // 3 + y // 4) % 2 == 0
    return {
        "rectangle": (
            dict(x=(cols / 4, cols / 2), y=(rows / 8, rows - 0.5)),
            RECTANGLE,
            [cols / 4, cols / 2, rows / 8, rows - 0.5],
            NOTHING,
        ),
        "beside": (dict(x=(-9, 2), y=(-6.25, rows + 7)), RECTANGLE, [-9, 2, -6.25, rows + 7], NOTHING),
        "aperture": (dict(aperture=aperture), APERTURE, np.zeros(4), aperture[None].astype(np.uint8)),
    }


@functools.cache
def _through(name, kind, size, sides):
    _, number, numbers, flags = _window(name)[kind]
    cube = sl.Hemicube(size)
    return cube.pack(
        oracle.surface_visibility(
            scenes.layers(name), cube.steps, sides, Geometry(number, np.array(numbers, float), flags)
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
@pytest.mark.parametrize("kind", ["rectangle", "beside", "aperture"])
@pytest.mark.parametrize(("name", "size"), [("fractal", 9), ("masked", 7), ("walls", 5), ("row", 9)])
def test_windows_equal_the_oracle(backend, name, size, kind, sides):
    """A rectangle inside, one that reaches past the map, and a chequered aperture."""
    scene, expected = scenes.scene(name, sides), _through(name, kind, size, sides)
    window = sl.Window(**_window(name)[kind][0])
    assert expected.any()
    assert_bits_equal(sl.visibility(scene, window, size, backend), expected)
    assert_bits_equal(sl.visibility(scene, window, size, backend, algorithm="propagate"), expected)


LAMPS = {
    "viewer": (14, 12, -3, 3.5),
    "amid": (12, 9, 0.5, 2),
    "half buried": (9, 15, None, 3),
    "beside": (-6, 8, 1, 4),
    "far": (20, 14, -60, 20),
}


def _lamp(name, kind):
    x, y, z, r = LAMPS[kind]
    return (float(x), float(y), float(scenes.whole_layers(name)[0][y, x] if z is None else z), float(r))


@functools.cache
def _lamplight(name, kind, size, sides):
    cube = sl.Hemicube(size)
    return cube.pack(
        oracle.surface_visibility(
            scenes.layers(name), cube.steps, sides, Geometry(BALL, np.array(_lamp(name, kind)), NOTHING)
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark"])
@pytest.mark.parametrize("kind", list(LAMPS))
@pytest.mark.parametrize(("name", "size"), [("fractal", 7), ("spikes", 7), ("masked", 5)])
def test_lamps_equal_the_oracle(backend, name, size, kind, sides):
    """A ball at the viewer, amid the relief, half in the ground, beside the map, and far and large."""
    scene, expected = scenes.scene(name, sides), _lamplight(name, kind, size, sides)
    x, y, z, r = _lamp(name, kind)
    depth, _ = scenes.whole_layers(name)
    if 0 <= x and z > depth[int(y), int(x)]:
        pytest.fail("the lamp stands below the surface: choose another place")
    lamp = sl.Lamp(center=(x, y, z), radius=r)
    assert expected.any()
    assert_bits_equal(sl.visibility(scene, lamp, size, backend), expected)
    assert_bits_equal(sl.visibility(scene, lamp, size, backend, algorithm="propagate"), expected)


@functools.cache
def _volume(name):
    depth, valid = scenes.whole_layers(name)
    n, y, x = np.ogrid[:6, : depth.shape[0], : depth.shape[1]]
    shape = (
        ((x - 8) ** 2 + (y - 12) ** 2 < 9) & (n < 3)
        | (x == 17) & (y > 20) & (n == 4)
        | (x + y == 25) & (n == 5)
    )
    return shape, shape & (n <= np.where(True if valid is None else valid, depth, 99))


@functools.cache
def _volume_truth(name, size, sides):
    cube = sl.Hemicube(size)
    geometry = Geometry(VOLUME, np.zeros(4), _volume(name)[1].astype(np.uint8))
    return cube.pack(oracle.surface_visibility(scenes.layers(name), cube.steps, sides, geometry))


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
@pytest.mark.parametrize(("name", "size"), [("fractal", 7), ("spikes", 5), ("masked", 7)])
def test_lamps_of_any_shape_equal_the_oracle(backend, name, size, sides):
    """A volume with a thick, a thin and a partly buried part."""
    expected = _volume_truth(name, size, sides)
    lamp = sl.Lamp(volume=_volume(name)[0])
    assert expected.any()
    assert_bits_equal(sl.visibility(scenes.scene(name, sides), lamp, size, backend), expected)
    assert_bits_equal(
        sl.visibility(scenes.scene(name, sides), lamp, size, backend, algorithm="propagate"), expected
    )


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_filled_windows_and_high_lamps_are_the_filled_sky_clipped(backend, sides):
    """Above z = 0 nothing blocks, so there a source only takes away what it does not fill."""
    name, cube = "fractal", sl.Hemicube(9)
    scene, (rows, cols) = scenes.scene(name, sides), scenes.whole_layers(name)[0].shape
    y, x = np.mgrid[:rows, :cols]
    lamp, numbers = (15.0, 13.0, -9.0, 5.0), np.array([5, 17.5, 3, 20])
    for source, geometry in (
        (sl.Lamp(center=lamp[:3], radius=lamp[3]), Geometry(BALL, np.array(lamp), NOTHING)),
        (sl.Window(x=(5, 17.5), y=(3, 20)), Geometry(RECTANGLE, numbers, NOTHING)),
    ):
        clipped = cube.unpack(scenes.filled_truth(name, 9, sides)).copy()
        for d, step in enumerate(cube.steps):
            clipped[..., d] &= oracle.meets_source(
                x, y, scenes.layers(name), step, (rows, cols), sides, geometry
            )
        assert clipped.any()
        assert_bits_equal(sl.visibility(scene, source, cube, backend, filled=True), cube.pack(clipped))


# -- larger, continuous maps: backends against one another ---------------------------------------------------


def _large():
    height, spacing = scenes.terrain()
    return {
        "rough": lambda sides: sl.Scene(scenes.rough(160, 231, 1.0, 4), 1.0, sides=sides),
        "near ties": lambda sides: sl.Scene(scenes.offset_plane(), 0.1, sides=sides),
        "real terrain": lambda sides: sl.Scene.from_height(height[:161, :215], spacing, sides=sides),
    }


@functools.cache
def _numpy_bits(name, sides, source, filled, size=9):
    return sl.visibility(_large()[name](sides), SOURCES[source], size, "numpy", filled=filled)


SOURCES = {
    "sky": SKY,
    "lamp": sl.Lamp(center=(2.05, 1.95, -1.0), radius=1.5),
    "window": sl.Window(x=(0.5, 3.3), y=(0.7, 2.1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("filled", [False, True], ids=["stride", "filled"])
@pytest.mark.parametrize("sides", scenes.SIDES)
@pytest.mark.parametrize("name", ["rough", "near ties", "real terrain"])
def test_backends_agree_on_continuous_maps(backend, name, sides, filled):
    """Rounding is the same everywhere: no bit differs from NumPy's, also where rounding decides ties."""
    if backend == "numpy":
        pytest.skip("the reference of this test")
    assert_bits_equal(
        sl.visibility(_large()[name](sides), SKY, 9, backend, filled=filled),
        _numpy_bits(name, sides, "sky", filled),
    )


@pytest.mark.parametrize("filled", [False, True], ids=["stride", "filled"])
@pytest.mark.parametrize("sides", ["open", "dark"])
@pytest.mark.parametrize("source", ["lamp", "window"])
def test_backends_agree_on_lamps_and_windows_where_rounding_decides(backend, source, sides, filled):
    """Geometry is in float64 and the scan in float32; which of them decides is the same on every backend."""
    if backend == "numpy":
        pytest.skip("the reference of this test")
    assert_bits_equal(
        sl.visibility(_large()["near ties"](sides), SOURCES[source], 9, backend, filled=filled),
        _numpy_bits("near ties", sides, source, filled),
    )


@pytest.mark.slow
def test_the_whole_real_terrain_is_the_same_everywhere(backend, fast):
    """344 x 403 nodes in metres, against the quickest backend here, and the oracle's rule on a row."""
    if backend == fast:
        pytest.skip("the reference of this test")
    height, spacing = scenes.terrain()
    scene = sl.Scene.from_height(height, spacing)
    assert_bits_equal(sl.visibility(scene, SKY, 5, backend), sl.visibility(scene, SKY, 5, fast))


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
def test_metres_are_layers_where_depths_are_whole_layers(backend, sides):
    """Another spacing, whole layers: the bits of layers, by both algorithms, for sky, window and lamp."""
    name = "fractal"
    for spacing in (30.0, 0.1, 75.0):
        scene = scenes.scene(name, sides, spacing)
        assert_bits_equal(sl.visibility(scene, SKY, 5, backend), scenes.truth(name, 5, sides))
        assert_bits_equal(
            sl.visibility(scene, SKY, 5, backend, algorithm="propagate"), scenes.truth(name, 5, sides)
        )


def test_whole_metres_between_layers_are_compared_in_metres(backend):
    """Whole metres, 30 a layer, against the definition: dividing or rounding first would flip bits."""
    depth = np.random.default_rng(2).integers(0, 200, (15, 18)).astype(float)
    cube = sl.Hemicube(7)
    expected = np.ones((15, 18, len(cube)), bool)
    for d, (i, j, up) in enumerate(cube.steps.tolist()):
        for t in range(1, 18 if i or j else 1):
            for y in range(15):
                for x in range(18):
                    if (
                        0 <= x + t * i < 18
                        and 0 <= y + t * j < 15
                        and depth[y + t * j, x + t * i] < depth[y, x] + t * up * 30.0
                    ):
                        expected[y, x, d] = False
    assert_bits_equal(sl.visibility(sl.Scene(depth, 30.0), SKY, cube, backend), cube.pack(expected))


@pytest.mark.parametrize("spacing", [30.0, 49.0, 75.0])
def test_window_edges_on_nodes_do_not_depend_on_the_unit(backend, spacing):
    """Half-open edges at whole nodes: the same bits in metres as in layers, low edge in, high edge out."""
    depth = np.random.default_rng(3).integers(0, 4, (12, 40))
    for edge in range(1, 36, 2):
        in_layers = sl.visibility(sl.Scene(depth), sl.Window(x=(edge, edge + 3), y=(1, 9)), 3, backend)
        in_metres = sl.visibility(
            sl.Scene(depth * spacing, spacing),
            sl.Window(x=(edge * spacing, (edge + 3) * spacing), y=(spacing, 9 * spacing)),
            3,
            backend,
        )
        assert_bits_equal(in_metres, in_layers)


# -- promises ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("filled", [False, True], ids=["stride", "filled"])
def test_a_second_run_gives_the_same_bytes(backend, filled):
    """No race and no leftover of the run before; another problem runs in between."""
    scene = sl.Scene(scenes.rough(61, 83, 1.0, 5), sides="periodic")
    first = sl.visibility(scene, SKY, 9, backend, filled=filled)
    sl.visibility(scenes.scene("spikes", "dark"), SKY, 9, backend, filled=not filled)
    assert_bits_equal(sl.visibility(scene, SKY, 9, backend, filled=filled), first)


def test_the_callers_arrays_are_not_changed(backend):
    """Depth, mask, albedo, volume and aperture stay as they were; writing to them later changes no scene."""
    depth, valid = (a.copy() for a in scenes.whole_layers("masked"))
    depth = depth.astype(np.float32)
    albedo, volume, aperture = (
        np.full(depth.shape, 0.5, np.float32),
        _volume("masked")[0].copy(),
        np.ones(depth.shape, bool),
    )
    arrays = (depth, valid, albedo, volume, aperture)
    before = [a.copy() for a in arrays]
    scene = sl.Scene(depth, albedo=albedo, mask=valid)
    for source in (SKY, sl.Lamp(volume=volume), sl.Window(aperture=aperture)):
        sl.render(scene, source, backend=backend, hemicube=5)
        sl.visibility(scene, source, 5, backend, algorithm="propagate")
    for array, old in zip(arrays, before):
        assert_bits_equal(array, old)
    kept = sl.visibility(scene, SKY, 5, backend)
    depth[:], valid[:], albedo[:] = 0, True, 0
    assert_bits_equal(sl.visibility(scene, SKY, 5, backend), kept)


def _with_memory(monkeypatch, engine, size):
    monkeypatch.setattr(type(engine), "memory", size, raising=False)
    if "memory" in vars(engine):
        monkeypatch.setitem(vars(engine), "memory", size)


@pytest.mark.slow
@pytest.mark.parametrize("filled", [False, True], ids=["stride", "filled"])
def test_work_that_goes_in_groups_gives_the_same_bytes(backend, filled, monkeypatch):
    """With memory for a few walks at a time: bits, light and carving are the same to the byte."""
    scene = scenes.scene("fractal", "periodic")
    window = sl.Window(x=(4, 21), y=(2, 19))
    lit = lambda: (
        sl.visibility(scene, SKY, 9, backend, filled=filled),
        sl.visibility(scene, window, 9, backend, filled=filled),
        sl.render(scene, SKY, "lattice", backend=backend, filled=filled).image,
    )
    whole = lit()
    engine = select(backend)
    words = sl.Hemicube(9).words
    for share in (4 * words, 4 * words + 7):
        with monkeypatch.context() as patch:
            _with_memory(patch, engine, share * scene.depth.size)
            from skylamp.light.lattice import problem_of
            from skylamp.light.propagation import LatticeMap

            groups = LatticeMap(engine, problem_of(engine, scene, SKY, sl.Hemicube(9), filled)).groups
            assert len(groups) > 4, "the work was not split, so this test says nothing"
            for got, expected in zip(lit(), whole):
                assert_bits_equal(got, expected)


def test_what_cannot_fit_is_an_error_that_names_the_bytes(backend, monkeypatch):
    """Before anything is taken: packed bits, and the field."""
    scene, engine = scenes.scene("fractal"), select(backend)
    with monkeypatch.context() as patch:
        _with_memory(patch, engine, 1000)
        with pytest.raises(CapacityError, match=r"needs [\d,]+ bytes; .* may take 1,000"):
            sl.visibility(scene, SKY, 9, backend)
        for source in (SKY, sl.Lamp(center=(3, 3, -2), radius=1)):
            with pytest.raises(CapacityError, match=r"field needs [\d,]+ bytes"):
                sl.visibility_field(scene, source, 9, backend=backend)
    with pytest.raises(CapacityError, match=r"takes [\d,]+ bytes; max_bytes allows 1,000"):
        sl.visibility_field(scene, SKY, 9, backend=backend, max_bytes=1000)


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
def test_garbage_in_new_arrays_does_not_show(backend, sides, monkeypatch):
    """Device arrays that a kernel should fill start out full of 0xA5: what it leaves out would be seen."""
    engine = select(backend)
    original = type(engine).empty

    def poisoned(self, shape, dtype, fill=None):
        array = original(self, shape, dtype, fill)
        if fill is None:
            return self.upload(
                np.full(int(np.prod(shape)) * np.dtype(dtype).itemsize, 0xA5, np.uint8)
                .view(dtype)
                .reshape(shape)
            )
        return array

    monkeypatch.setattr(type(engine), "empty", poisoned)
    lamp = sl.Lamp(volume=_volume("masked")[0])
    for name in ("masked", "tiny", "row"):
        scene, truth = scenes.scene(name, sides), scenes.truth(name, 7, sides)
        assert_bits_equal(sl.visibility(scene, SKY, 7, backend), truth)
        assert_bits_equal(sl.visibility(scene, SKY, 7, backend, algorithm="propagate"), truth)
        image = sl.render(scene, SKY, "lattice", backend=backend, hemicube=7, quantity="irradiance").image[
            scene.valid
        ]
        assert (image >= 0).all() and (image <= np.pi * 1.00001).all()
    scene = scenes.scene("masked", sides)
    rectangle = sl.Window(**_window("masked")["rectangle"][0])
    assert_bits_equal(
        sl.visibility(scene, rectangle, 7, backend, algorithm="propagate"),
        _through("masked", "rectangle", 7, sides),
    )
    assert_bits_equal(
        sl.visibility(scene, lamp, 7, backend, algorithm="propagate"), _volume_truth("masked", 7, sides)
    )


# -- the field -----------------------------------------------------------------------------------------------


@functools.cache
def _field_truth(name, size, sides, layers):
    cube = sl.Hemicube(size)
    return np.stack(
        [
            np.moveaxis(v, 0, -1)
            for _, v in oracle.propagate(scenes.layers(name), cube.steps, sides, scenes.SKY, layers)
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize("sides", scenes.SIDES)
@pytest.mark.parametrize("name", ["spikes", "masked", "tiny"])
def test_every_node_of_the_field_equals_the_oracle(backend, name, sides):
    """All layers, below the deepest node too; at(), solid_angle(), surface() and bits say the same."""
    depth = scenes.layers(name)
    layers = int(depth.max()) + 3
    field = sl.visibility_field(scenes.scene(name, sides), SKY, 5, layers, backend)
    expected = _field_truth(name, 5, sides, layers)
    cube = field.hemicube
    assert field.backend == backend and field.layers == layers
    assert_bits_equal(np.ascontiguousarray(field.bits), np.stack([cube.pack(v) for v in expected]))
    rows, cols = depth.shape
    for x, y, n in ((0, 0, 0), (cols - 1, rows - 1, 2), (cols // 2, rows // 2, 4), (cols - 1, 0, layers - 1)):
        assert_bits_equal(field.at(x, y, n), expected[n, y, x].copy())
    assert np.abs(field.solid_angle() - expected @ cube.solid_angles).max() < 1e-5
    assert_bits_equal(field.surface(), scenes.truth(name, 5, sides))


def test_the_field_refuses_nodes_that_it_has_not(backend):
    """Negative indices must not wrap round, and a shallow field has no surface to give."""
    field = sl.visibility_field(scenes.scene("spikes"), SKY, 3, 4, backend)
    rows, cols = field.scene.shape
    for node in (
        (-1, 0, 0),
        (0, -1, 0),
        (0, 0, -1),
        (cols, 0, 0),
        (0, rows, 0),
        (0, 0, 4),
        (1.5, 0, 0),
        (True, 0, 0),
    ):
        with pytest.raises(InputError, match="a whole number from 0 to"):
            field.at(*node)
    with pytest.raises(InputError, match="at least"):
        field.surface()
    with pytest.raises(InputError, match="free space"):
        wall = np.argwhere(scenes.layers("spikes") == 0)[0]
        field.view((int(wall[1]), int(wall[0]), 3), backend)


def test_a_view_shows_source_and_ground_where_they_are(backend):
    """A pit with one bright wall: solid angles cover the sphere, the sky is above, hits are right."""
    depth = np.full((15, 15), 6)
    depth[:, 10:] = 0
    scene = sl.Scene(depth, albedo=np.where(np.arange(15) >= 10, 0.9, 0.1) * np.ones((15, 1)))
    field = sl.visibility_field(scene, sl.Sky(2.0), 5, backend=backend)
    view = field.view((7, 7, 5), backend)
    cube = field.hemicube
    assert abs(view.solid_angles.sum() - 4 * np.pi) < 1e-9
    assert_bits_equal(view.visible[: len(cube)].copy(), field.at(7, 7, 5))
    assert (view.brightness[view.visible] == 2.0).all() and (view.hit[view.visible] == -1).all()
    number = {tuple(s): d for d, s in enumerate(view.steps.tolist())}
    image = sl.render(scene, sl.Sky(2.0), "lattice", backend=backend, hemicube=5).image
    east, down = number[2, 0, 0], number[0, 0, 2]
    assert (
        view.hit[east].tolist() == [7, 11] and not view.visible[east]
    )  # columns 9 and 11 are looked at; 11 stands higher
    assert view.hit[down].tolist() == [7, 7]
    for d in (east, down):
        assert view.brightness[d] == image[tuple(view.hit[d])]
    assert (
        view.visible[number[-2, 0, 0]]
        and view.brightness[number[-2, 0, 2]] == image[tuple(view.hit[number[-2, 0, 2]])]
    )


@pytest.mark.slow
def test_a_lamp_far_above_a_pit_takes_no_steps(backend):
    """Straight up nothing stands in the way of a sphere, however many layers lie between."""
    scene = sl.Scene(np.full((3, 4), 3e7), sides="dark")
    bits = sl.visibility(scene, sl.Lamp((1.5, 1.0, -50.0), 20.0), 3, backend)
    cube = sl.Hemicube(3)
    up = [n for n, step in enumerate(cube.steps.tolist()) if step == [0, 0, -1]]
    assert cube.unpack(bits)[..., up].all()


def test_a_volume_far_above_the_ground_is_too_much_work(fast):
    """Its rays go from node to node; that is said before they do."""
    lamp = sl.Lamp(volume=np.ones((2, 3, 4), bool))
    with pytest.raises(sl.CapacityError, match="steps"):
        sl.visibility(sl.Scene(np.full((3, 4), 1e7)), lamp, 3, fast)


@pytest.mark.slow
@pytest.mark.parametrize("power, says", [(3, False), (4000, True)])
def test_a_sky_whose_light_lies_between_directions_is_told(fast, power, says):
    """A narrow spot, with the share of its light that level ground gets; a wide one is as it should be."""
    sky = sl.Sky(sl.cosine_power(power, (0.31, 0.2, 1.0)))
    flat = sl.Scene(np.ones((6, 6)))
    found = sl.render(flat, sky, "lattice", backend=fast, quantity="irradiance")
    told = [text for text in found.warnings if text.startswith("Uneven sky")]
    assert bool(told) == says
    if says:
        exact = sl.render(flat, sky, backend=fast, quantity="irradiance").image[3, 3]
        assert (
            f"gets {found.image[3, 3] / exact:.2g}" in told[0]
            or f"{found.image[3, 3] / exact:.3g}" in told[0]
        )


def test_a_view_through_a_hole_in_the_data(backend):
    """A ray goes on over masked nodes and shows the ground beyond, however deep other ground is."""
    depth, mask = np.full((1, 12), 3, np.float32), np.ones((1, 12), bool)
    mask[0, 4:6] = False
    for deepest in (3, 9):
        depth[0, 11] = deepest
        view = sl.visibility_field(sl.Scene(depth, mask=mask), sl.Sky(), 9, backend=backend).view((0, 0, 0))
        n = int(np.flatnonzero((view.steps == (4, 0, 4)).all(1))[0])
        assert tuple(view.hit[n]) == (0, 8)


@pytest.mark.parametrize(
    "surface",
    [
        dict(albedo=(0.8, 0.2, 0.1)),
        dict(albedo=np.full((20, 30, 3), 0.5)),
        dict(reflectance=sl.Phong(0.5, (0.1, 0.2, 0.3))),
    ],
)
def test_a_view_of_ground_in_colour_is_refused(fast, surface):
    """As that of a source in colour is: a view has one brightness per direction."""
    scene, lamp = sl.Scene(np.full((20, 30), 14.0), **surface), sl.Lamp(center=(4, 10, -4), radius=4)
    with pytest.raises(InputError, match="field: view: got a surface in colour"):
        sl.visibility_field(scene, lamp, 3, backend=fast).view((10, 10, 5), fast)
