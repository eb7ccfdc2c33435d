"""render(): every backend against the oracle, the lattice against closed forms, and its known errors."""

import functools
import itertools
import pickle

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal, assert_close

import skylamp as sl
from skylamp import oracle
from skylamp.radiometry import polygon_moment
from skylamp.sources.shapes import BALL, RECTANGLE, Geometry

NOTHING = np.zeros((1, 1, 1), np.uint8)
SIZES = (9, 17, 33)


def irradiance(scene, source, size, backend, filled=True, **more):
    out = sl.render(
        scene, source, "lattice", backend=backend, quantity="irradiance", hemicube=size, filled=filled, **more
    )
    assert out.backend == backend
    return out.image


# -- the oracle


SOURCES = {
    "uniform": (sl.Sky(), scenes.SKY, lambda L: np.ones(L.shape[:-1])),
    "overcast": (sl.Sky(sl.cie_overcast(2.0)), scenes.SKY, lambda L: 2 * (1 - 2 * L[..., 2]) / 3),
    "any function": (
        sl.Sky(lambda L: 1 + L[..., 0] + 0.5 * L[..., 1] ** 2),
        scenes.SKY,
        lambda L: 1 + L[..., 0] + 0.5 * L[..., 1] ** 2,
    ),
    "window": (
        sl.Window(x=(6, 17), y=(4, 20), brightness=3.0),
        Geometry(RECTANGLE, np.array([6, 17, 4, 20.0]), NOTHING),
        lambda L: np.full(L.shape[:-1], 3.0),
    ),
    "spotlight": (
        sl.Lamp(center=(13, 11, -4), radius=4, brightness=sl.cosine_power(3)),
        Geometry(BALL, np.array([13, 11, -4, 4.0]), NOTHING),
        lambda L: np.maximum(0, -L[..., 2]) ** 3,
    ),
}


@functools.cache
def _expected(name, source, sides, size, weights):
    cube = sl.Hemicube(size)
    depth, valid = scenes.whole_layers(name)
    valid = np.ones(depth.shape, bool) if valid is None else valid
    _, geometry, brightness = SOURCES[source]
    visible = oracle.surface_visibility(scenes.layers(name), cube.steps, sides, geometry)
    moments = cube.moments if weights == "moment" else cube.directions * cube.solid_angles[:, None]
    return (
        oracle.luminance(
            visible, oracle.normals(depth, 1.0, valid, sides), brightness(cube.directions), moments
        ),
        valid,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "source", "sides", "size"),
    [
        ("fractal", "uniform", "open", 9),
        ("walls", "overcast", "periodic", 9),
        ("spikes", "any function", "dark", 5),
        ("masked", "uniform", "open", 7),
        ("masked", "window", "dark", 9),
        ("terrain", "window", "open", 9),
        ("plateaus", "spotlight", "open", 9),
        ("noise", "spotlight", "dark", 7),
        ("row", "overcast", "periodic", 3),
        ("tiny", "uniform", "dark", 9),
        ("one", "overcast", "open", 3),
    ],
)
@pytest.mark.parametrize("weights", ["moment", "printed"])
def test_radiance_agrees_with_the_oracle(backend, name, source, sides, size, weights):
    """Eq. 3 in float32 against float64, to 1e-5 of the value down to 0.01 of the brightness; masked: NaN."""
    light, valid = _expected(name, source, sides, size, weights)
    rho = np.linspace(0.1, 1, light.size).reshape(light.shape)
    depth, mask = scenes.whole_layers(name)
    scene = sl.Scene(
        depth if mask is None else np.where(mask, depth, np.nan), albedo=rho, mask=mask, sides=sides
    )
    options = dict(method="lattice", backend=backend, hemicube=size, weights=weights)
    bright, lit = (
        sl.render(scene, SOURCES[source][0], quantity=q, **options) for q in ("radiance", "irradiance")
    )
    assert bright.backend == lit.backend == backend
    assert np.isnan(bright.image[~valid]).all() and np.isnan(lit.image[~valid]).all()
    assert_close(bright.image[valid], (rho * light / np.pi)[valid], floor=0.01)
    assert_close(lit.image[valid], light[valid], floor=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        dict(method="lattice", hemicube=9),
        dict(method="lattice", hemicube=9, filled=True),
        dict(method="horizon", azimuths=16, max_distance=4.0),
    ],
    ids=["stride", "filled", "near horizons"],
)
def test_a_map_that_repeats_has_no_seam(backend, model):
    """Moved by rows and columns round its border, a map has the same image moved, normals and all."""
    y, x = np.mgrid[:23, :29]
    depth = 6 + 2 * np.cos(2 * np.pi * x / 29) + 3 * np.sin(2 * np.pi * (y / 23 + 2 * x / 29))
    depth = np.round(depth * 16) / 16  # so that float32 holds every sum of four of them

    def image(z):
        scene = sl.Scene(z, sides="periodic")
        return sl.render(scene, sl.Sky(sl.cie_overcast()), backend=backend, **model).image

    moved, expected = image(np.roll(depth, (7, 11), (0, 1))), np.roll(image(depth), (7, 11), (0, 1))
    if model["method"] == "lattice":
        assert_bits_equal(moved, expected)
    else:  # crossings round differently in other columns
        np.testing.assert_allclose(moved, expected, rtol=1e-6)


def test_spacing_scales_slopes_not_light(backend):
    """A relief in metres, 30 to the layer, and one between layers: lengths in metres change nothing."""
    depth = np.random.default_rng(9).uniform(0, 90, (12, 15)).astype(np.float32)
    cube = sl.Hemicube(5)
    scene = sl.Scene(depth, 30.0)
    visible = cube.unpack(sl.visibility(scene, sl.Sky(), cube, backend))
    expected = oracle.luminance(
        visible,
        oracle.normals(depth.astype(float), 30.0, np.ones(depth.shape, bool)),
        np.ones(len(cube)),
        cube.moments,
    )
    assert_close(irradiance(scene, sl.Sky(), 5, backend, False), expected, floor=0.01)


def test_printed_weights_differ(backend):
    """Eq. 3 as printed gives a level plane not quite pi; the moments do."""
    flat = sl.Scene(np.ones((3, 4)))
    moment, printed = (irradiance(flat, sl.Sky(), 3, backend, weights=w) for w in ("moment", "printed"))
    assert np.abs(moment / np.pi - 1).max() < 1e-6 < 0.005 < np.abs(printed / np.pi - 1).min()


# -- closed forms (docs/explanation)


@pytest.mark.slow
@pytest.mark.parametrize("size", [3, 5, 9, 17, 33])
@pytest.mark.parametrize("filled", [False, True], ids=["stride", "filled"])
@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_a_level_plane_gets_the_whole_sky_at_every_size(backend, size, filled, sides):
    """Radiance is rho B, exactly but for rounding (some hundred terms of 6e-8), whatever M and depth."""
    scene = sl.Scene(np.full((5, 9), 7.3), 1.7, albedo=0.5, sides=sides)
    out = sl.render(scene, sl.Sky(4.0), "lattice", backend=backend, hemicube=size, filled=filled)
    assert_close(out.image, np.full((5, 9), 2.0), relative=2e-6 if size < 17 else 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("slope", [(1, 0), (0.5, -0.25), (-2, 1)], ids=str)
def test_a_tilted_plane_converges_to_its_view_factor(backend, slope):
    """E = pi B (1 + cos a) / 2; the error, of cells that the tangent plane cuts, falls as 1 / M^2."""
    y, x = np.mgrid[:5, :7]
    z = slope[0] * x + slope[1] * y
    wanted = np.pi * (1 + 1 / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)) / 2
    errors = [
        abs(irradiance(sl.Scene(z - z.min()), sl.Sky(), size, backend)[2, 3] / wanted - 1) for size in SIZES
    ]
    assert errors[0] < 4e-3 and errors[1] < 0.4 * errors[0] and errors[2] < 0.4 * errors[1]


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_infinite_trenches_converge_to_their_view_factor(fast):
    """Middle of a trench of half-width a and depth d: E = pi B a / sqrt(a^2 + d^2), over thirty trenches.

    One cell straddles the rim, a share of 1 / m of the profile: the error falls about as 1 / M.
    """
    shapes = [(a, d) for a in range(3, 13, 2) for d in (2, 3, 5, 7, 11, 16)]
    errors = []
    for size in SIZES:
        found = []
        for a, d in shapes:
            depth = np.full((1, 2 * a + 4), float(d))
            depth[0, 2 * a :] = depth[0, 0] = 0  # rims at columns 0 and 2 a
            found.append(
                irradiance(sl.Scene(depth, sides="periodic"), sl.Sky(), size, fast)[0, a] / np.pi
                - a / np.hypot(a, d)
            )
        errors.append(_rms(found))
    assert errors[0] > errors[1] > errors[2], errors
    assert errors[2] < 0.012, errors


@pytest.mark.slow
def test_a_trench_is_the_same_on_every_backend(backend):
    """a = 10, d = 4 at M = 17: within one cell of the closed form, along rows and along columns."""
    depth = np.full((1, 24), 4.0)
    depth[0, 20:] = depth[0, 0] = 0
    along, across = (
        irradiance(sl.Scene(z, sides="periodic"), sl.Sky(), 17, backend) for z in (depth, depth.T)
    )
    assert abs(along[0, 10] / (np.pi * 10 / np.hypot(10, 4)) - 1) < 0.02
    assert abs(across[10, 0] / along[0, 10] - 1) < 1e-5


def test_rectangular_windows_converge_to_lamberts_polygon(fast):
    """A floor below a window: each pixel has its own closed form, straight below and far to the side."""
    depth, (x0, x1), (y0, y1) = 7.0, (3.2, 14.1), (2.3, 9.7)
    y, x = np.mgrid[:13, :19]
    corners = np.stack(
        [
            np.stack([u - x, v - y, np.full(x.shape, -depth)], -1)
            for u, v in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        ],
        -2,
    )
    wanted = -polygon_moment(corners)[..., 2]
    scene = sl.Scene(np.full(x.shape, depth))
    errors = [
        _rms(irradiance(scene, sl.Window(x=(x0, x1), y=(y0, y1)), size, fast) - wanted) / wanted.mean()
        for size in SIZES
    ]
    assert errors[0] > errors[1] > errors[2] and errors[2] < 0.36 * errors[0], errors  # at least as 1 / M
    assert errors[2] < 0.04, errors


def test_a_sphere_converges_to_its_closed_form(fast):
    """E = pi B (R / d)^2 cos: a floor below a ball at half height, wholly above it."""
    radius, (cx, cy, cz), depth = 6.0, (8.3, 5.6, 3.0), 16.0
    y, x = np.mgrid[:13, :19]
    square = (x - cx) ** 2 + (y - cy) ** 2 + (depth - cz) ** 2
    wanted = np.pi * radius**2 / square * (depth - cz) / np.sqrt(square)
    scene = sl.Scene(np.full(x.shape, depth))
    errors = [
        _rms(irradiance(scene, sl.Lamp(center=(cx, cy, cz), radius=radius), size, fast) - wanted)
        / wanted.mean()
        for size in SIZES
    ]
    assert errors[0] > errors[1] > errors[2] and errors[2] < 0.36 * errors[0], errors  # at least as 1 / M
    assert errors[2] < 0.04, errors


@pytest.mark.slow
def test_the_penumbra_has_the_width_of_similar_triangles(backend):
    """A window behind an edge is seen whole from x <= 24, in part up to x = 36, and not beyond."""
    # floor at depth 24, edge at column 40 and depth 12, window from x = 44 to 56: from between, the part
    # beyond the edge's shadow is seen, X <= x + 2 (40 - x)
    depth = np.full((25, 60), 24.0)
    depth[:, 40:] = 12
    window = sl.Window(x=(44, 56), y=(2, 22))  # rays from row 12 to the window stay on the map
    shaded, free = (
        irradiance(sl.Scene(z), window, 17, backend)[12, :40].astype(float)
        for z in (depth, np.full(depth.shape, 24.0))
    )
    x = np.arange(40)
    assert (free > 0).all() and (shaded[x <= 24] == free[x <= 24]).all()
    assert (shaded[x > 36] == 0).all()

    def light(x, end):
        corners = np.array([[u - x, v - 12, -24.0] for u, v in ((44, 2), (end, 2), (end, 22), (44, 22))])
        return -polygon_moment(corners)[2]

    wanted = np.array([light(at, 80 - at) / light(at, 56) for at in range(25, 36)])
    share = shaded[25:36] / free[25:36]
    assert _rms(share - wanted) < 0.12
    assert _rms(share - (wanted > 0.5)) > 0.25  # smooth, not a step


# -- what goes wrong, by name


@pytest.mark.slow
def test_longer_strides_leak_light_and_filling_stops_it(fast):
    """docs/explanation: on rough ground the stride's error grows from M = 9 on; filled, it falls."""
    scene = sl.Scene(scenes.rough(96, 96, 1.0, 2, 1.4))
    reference = irradiance(scene, sl.Sky(), 65, fast).astype(float)
    stride, filled = (
        [_rms(irradiance(scene, sl.Sky(), size, fast, f) - reference) / np.pi for size in SIZES]
        for f in (False, True)
    )
    assert stride[0] < stride[1] < stride[2], stride
    assert filled[0] > 2 * filled[1] > 4 * filled[2], filled
    assert filled[2] < 0.0015 and stride[2] > 30 * filled[2]
    assert (
        irradiance(scene, sl.Sky(), 33, fast, False) - irradiance(scene, sl.Sky(), 33, fast, True)
    ).min() > -1e-4  # it only ever adds light
    said = lambda size, f: any(
        w.startswith("Leak") and "filled=True" in w
        for w in sl.render(scene, sl.Sky(), "lattice", backend=fast, hemicube=size, filled=f).warnings
    )
    assert said(7, False) and said(9, False) and said(17, False) and not said(9, True) and not said(5, False)
    gentle = sl.Scene(scenes.rough(32, 32, 0.3, 2, 1.4))
    assert sl.render(gentle, sl.Sky(), "lattice", backend=fast, hemicube=17).warnings == []


def test_a_volume_shines_alike_to_all_sides(backend):
    """A square plate over level ground, filled: of two nodes as near one was always taken, 4 % at M = 9."""
    plate = np.zeros((1, 21, 21), bool)
    plate[0, 6:15, 6:15] = True
    scene, lamp = sl.Scene(np.full((21, 21), 8.0)), sl.Lamp(volume=plate)
    image = sl.render(scene, lamp, "lattice", hemicube=9, filled=True, backend=backend).image
    for other in (image[:, ::-1], image[::-1], image.T):
        np.testing.assert_allclose(image, other, atol=2e-6 * image.mean())


@pytest.mark.slow
def test_filled_steps_that_pass_a_thin_volume_are_named(fast):
    """A plate one node thick loses a quarter of its light at M = 33."""
    light, warned = {}, {}
    for thick, size in ((1, 9), (1, 33), (4, 33)):
        plate = np.zeros((thick, 21, 21), bool)
        plate[:, 6:15, 6:15] = True
        scene = sl.Scene(np.full((21, 21), 7.0 + thick))
        out = sl.render(scene, sl.Lamp(volume=plate), "lattice", hemicube=size, filled=True, backend=fast)
        light[thick, size] = out.image.mean()
        warned[thick, size] = any("between two crossings" in text for text in out.warnings)
    assert light[1, 33] < 0.8 * light[1, 9]
    assert warned == {(1, 9): False, (1, 33): True, (4, 33): False}


@pytest.mark.slow
@pytest.mark.parametrize("radius", [2, 4, 7])
def test_steps_that_jump_over_a_volume_are_named(fast, radius):
    """A ball of nodes, of whose light steps of 16 nodes find a half to nothing: none was named."""
    z, y, x = np.mgrid[:14, :40, :40]
    ball = (x - 20) ** 2 + (y - 12) ** 2 + (z - 7) ** 2 <= radius**2 + 0.5
    scene = sl.Scene(np.full((40, 40), 27.0))
    whole = sl.render(scene, sl.Lamp(center=(20, 12, 7), radius=radius), backend=fast).image.sum()
    for size, filled in itertools.product((9, 17, 33), (False, True)):
        out = sl.render(scene, sl.Lamp(volume=ball), "lattice", hemicube=size, filled=filled, backend=fast)
        jumped = any("jump over parts of a volume" in text for text in out.warnings)
        assert jumped == (not filled and 2 * radius + 1 < 2 * (size // 2))
        if filled:
            assert out.image.sum() == pytest.approx(whole, rel=0.15)
        assert out.image.sum() > 0.9 * whole or filled or out.warnings


def test_a_lamp_between_the_directions_is_named(fast):
    """A lamp narrower than the directions' spacing leaves pixels dark, with a warning; others do not."""
    scene = sl.Scene(np.full((24, 24), 24.0))
    small, large = (
        sl.render(scene, sl.Lamp(center=(11.5, 11.5, 0), radius=r), "lattice", backend=fast) for r in (1, 11)
    )
    assert (small.image == 0).mean() > 0.8 and any(
        "Small lamp" in w and "larger hemicube" in w for w in small.warnings
    )
    assert (large.image > 0).all() and large.warnings == []


@pytest.mark.slow
def test_a_directed_lamp_moves_the_maximum_towards_the_centre(backend):
    """The paper's Fig. 2: a slanted plane under a sphere at the viewer, isotropic to strongly directed.

    The maxima stand where N.L (R / d)^2 cos^k, the closed form of a sphere, has them.
    """
    x = np.arange(81)
    depth, height, slope = 14 + 0.7 * x, -10, 0.7
    towards = np.stack([40 - x, height - depth])
    far = np.hypot(*towards)
    peak, wanted = [], []
    for power in (0, 4, 24):
        lamp = sl.Lamp(center=(40, 1, height), radius=18, brightness=sl.cosine_power(power))
        light = irradiance(sl.Scene(np.tile(depth, (3, 1))), lamp, 17, backend)[1].astype(float)
        peak.append(
            3 + int(np.argmax(np.convolve(light, np.ones(7) / 7, "valid")))
        )  # over the lattice's grain
        wanted.append(
            int(np.argmax((slope * towards[0] - towards[1]) / far**3 * (-towards[1] / far) ** power))
        )
    assert wanted == [16, 28, 36]
    assert peak[0] + 5 < peak[1] < peak[2] - 3 and peak[2] <= 40, peak
    assert np.abs(np.subtract(peak, wanted)).max() <= 4, peak


# -- brightness, albedo, plan


UNIT = np.array([[0, 0, -1], [1, 0, 0], [0, 1, 0], [-0.6, 0, -0.8], [0, -0.8, -0.6]])


def test_brightness_functions_by_hand():
    """Zenith and horizon of the overcast sky are 3 to 1; a spotlight is bright against its axis."""
    assert np.allclose(sl.uniform(2.5)(UNIT), 2.5) and sl.uniform(2.5)(UNIT).shape == (5,)
    assert np.allclose(sl.cie_overcast(3.0)(UNIT), [3, 1, 1, 2.6, 2.2])
    assert np.allclose(sl.cosine_power(2)(UNIT), [1, 0, 0, 0.64, 0.36])
    assert np.allclose(sl.cosine_power(0)(UNIT), 1)
    assert np.allclose(sl.cosine_power(1, axis=(3, 0, 0), brightness=5)(UNIT), [0, 0, 0, 3, 0])


def test_the_overcast_sky_lights_a_plane_with_seven_ninths(fast):
    """E = pi Lz (1/3) (1 + 4/3) = 7 pi Lz / 9."""
    errors = [
        abs(
            irradiance(sl.Scene(np.ones((1, 1))), sl.Sky(sl.cie_overcast(9.0)), size, fast)[0, 0]
            / (7 * np.pi)
            - 1
        )
        for size in SIZES
    ]
    assert errors[0] < 3e-3 and errors[2] < errors[1] < errors[0]


def test_an_environment_map_has_the_zenith_above_and_column_zero_in_the_east():
    """Row 0 at the zenith, column 0 towards +x, columns growing towards +y; pixel centres give the pixels."""
    image = np.random.default_rng(1).uniform(0, 1, (6, 8))
    sky = sl.environment_map(image)
    row, col = np.mgrid[:6, :8]
    away, azimuth = (row + 0.5) / 6 * np.pi, (col + 0.5) / 8 * 2 * np.pi
    assert np.allclose(
        sky(np.stack([np.sin(away) * np.cos(azimuth), np.sin(away) * np.sin(azimuth), -np.cos(away)], -1)),
        image,
    )
    assert np.allclose(
        sky(np.array([np.sin(away[2, 0]), 0, -np.cos(away[2, 0])])), (image[2, 0] + image[2, 7]) / 2
    )  # no seam at +x
    assert sl.environment_map([[3.0]])(UNIT).tolist() == [3.0] * 5


@pytest.mark.slow
def test_an_environment_map_lights_the_slope_that_faces_it(backend):
    """Light from +x only: depth grows towards +x where the ground faces it; +y for columns 1 of 4."""
    image = np.zeros((4, 4))
    y, x = np.mgrid[:5, :5]
    for col, towards in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        image[:] = 0
        image[:, col] = image[:, col - 1] = 1  # two columns that meet at azimuth col x 90 degrees
        light = {}
        for way in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            z = way[0] * x + way[1] * y
            light[way] = irradiance(sl.Scene(z - z.min()), sl.Sky(sl.environment_map(image)), 9, backend)[
                2, 2
            ]
        assert max(light, key=light.get) == towards and light[towards] > 1.3 * sorted(light.values())[-2]


def test_albedo_multiplies_radiance_and_not_irradiance(backend):
    """As a number, as a map, and 0 and 1 among its values."""
    depth, _ = scenes.whole_layers("fractal")
    rho = np.random.default_rng(2).uniform(0, 1, depth.shape)
    rho[3, 4], rho[5, 6] = 0, 1
    light = irradiance(sl.Scene(depth), sl.Sky(), 5, backend)
    by_map, by_number = (
        sl.render(
            sl.Scene(depth, albedo=a), sl.Sky(), "lattice", backend=backend, hemicube=5, filled=True
        ).image
        for a in (rho, 0.25)
    )
    assert_close(by_map, rho * light.astype(float) / np.pi, relative=1e-6)
    assert_close(by_number, 0.25 * light.astype(float) / np.pi, relative=1e-6)
    assert by_map[3, 4] == 0
    assert_bits_equal(irradiance(sl.Scene(depth, albedo=rho), sl.Sky(), 5, backend), light)


def test_brightness_is_linear_and_lamps_only_add(backend):
    """Twice the brightness is twice the light to the bit; a window and its complement make up the sky."""
    scene = scenes.scene("fractal")
    one, two = (irradiance(scene, sl.Sky(b), 5, backend) for b in (1.0, 2.0))
    assert_bits_equal(two, 2 * one)
    rows, cols = scene.shape
    aperture = np.random.default_rng(3).random((rows, cols)) < 0.4
    dark = scenes.scene("fractal", "dark")
    parts = sum(
        irradiance(dark, sl.Window(aperture=a), 5, backend, False).astype(float)
        for a in (aperture, ~aperture)
    )
    assert_close(irradiance(dark, sl.Sky(), 5, backend, False), parts)


@pytest.mark.slow
def test_a_second_run_gives_the_same_image(backend):
    """Byte for byte, and NaN where masked."""
    scene = scenes.scene("masked")
    first, second = (sl.render(scene, sl.Sky(), backend=backend).image for _ in range(2))
    assert first is not second and first.tobytes() == second.tobytes() and first.dtype == np.float32
    assert_bits_equal(np.isnan(first), ~scenes.whole_layers("masked")[1])


def test_what_is_asked_for_is_taken(fast):
    """Whatever the tolerance; and of lattice arguments alone, hemicube 9 is meant."""
    scene = sl.Scene(np.ones((3, 3)))
    asked = sl.render(scene, sl.Sky(), "lattice", hemicube=5, backend=fast).plan
    assert (asked.method, asked.hemicube, asked.filled, asked.azimuths) == ("lattice", 5, False, None)
    out = sl.render(scene, sl.Sky(), filled=True, backend=fast)
    assert (out.plan.hemicube, out.plan.filled, str(out.plan)) == (
        9,
        True,
        "lattice, hemicube 9, filled: as asked",
    )
    assert out.seconds >= 0 and out.compile_seconds >= 0


@pytest.mark.parametrize(
    "brightness",
    [sl.cosine_power(3), sl.cosine_power(300), sl.cosine_power(3000, (0, 1, 2)), sl.cie_overcast(2.0)],
)
def test_sources_can_be_pickled(brightness):
    """Worker processes of data loaders need it; functions within functions cannot be pickled."""
    L = np.array([[0.0, 0.0, -1.0], [0.0, -0.6, -0.8]])
    again = pickle.loads(pickle.dumps(sl.Sky(brightness)))
    np.testing.assert_array_equal(again.brightness(L), brightness(L))


@pytest.mark.parametrize("how", [{}, {"method": "horizon"}, {"hemicube": 5}])
def test_light_from_below_the_level_is_told(fast, how):
    """A sphere beside a slope that sees all of it: what images lack of the closed form is in the warning."""
    x, y = np.meshgrid(np.arange(32.0), np.arange(32.0))
    centre, slope = (24, 16, 14), np.array([1, 0, -1]) / np.sqrt(2)
    to = np.stack([centre[0] - x, centre[1] - y, centre[2] - (2 + x)], -1)
    far = np.linalg.norm(to, axis=-1)
    exact = np.pi * (3 / far) ** 2 * (to @ slope) / far
    scene, lamp = sl.Scene(2 + x), sl.Lamp(centre, 3)
    result = sl.render(scene, lamp, interreflection=False, quantity="irradiance", backend=fast, **how)
    told = next(text for text in result.warnings if text.startswith("Lamp below ground"))
    share = float(told.split("It is ")[1].split(" %")[0]) / 100
    if "hemicube" not in how:
        missing = np.sqrt(np.mean((exact - result.image) ** 2)) / exact.mean()
        np.testing.assert_allclose(share, missing, rtol=0.03)
    assert 0.28 < share < 0.3
    assert any(text.startswith("Lamp below") for text in sl.plan(scene, lamp, backend=fast).beyond)


@pytest.mark.slow
def test_light_from_below_the_level_is_told_beyond_the_tolerance_alone(fast):
    """Of the brightest colour, and by the plan from a tenth of the tolerance on."""
    x, y = np.meshgrid(np.arange(24.0), np.arange(24.0))
    scene = sl.Scene(10 - 3 * np.exp(-((x - 12) ** 2 + (y - 12) ** 2) / 30))
    ask = functools.partial(sl.render, scene, interreflection=False, backend=fast)
    downwards = lambda L: np.stack([L[..., 2] < -0.3, L[..., 2] <= 0, L[..., 2] < -0.3], -1).astype(float)
    for brightness in (1.0, downwards):
        lamp = sl.Lamp((3, 3, 8.5), 1.0, brightness=brightness)
        told = [ask(lamp, tolerance=t).warnings for t in (0.01, 0.2)]
        assert ["Lamp below" in " ".join(warnings) for warnings in told] == [True, False]
    lamp = sl.Lamp((3, 3, 8.5), 1.0)
    plans = [sl.plan(scene, lamp, tolerance=t, backend=fast).beyond for t in (0.2, 0.9)]
    assert ["Lamp below" in " ".join(beyond) for beyond in plans] == [True, False]


@pytest.mark.parametrize("name", ["above", "closed form", "window"])
def test_light_from_the_viewers_side_is_all_there(fast, name):
    """No warning of light below the level: lamps above all ground, windows, closed forms that include it."""
    ground = 2 + np.mgrid[:16, :16][1].astype(float)
    source = (
        sl.Window((2, 9), (2, 9)) if name == "window" else sl.Lamp((12, 8, 1 if name == "above" else 7), 1)
    )
    method = "unoccluded" if name == "closed form" else "auto"
    result = sl.render(sl.Scene(ground), source, method=method, interreflection=False, backend=fast)
    assert not any("below" in text for text in (*result.warnings, *result.plan.beyond))


@pytest.mark.slow
@pytest.mark.parametrize("between", [False, "auto"])
def test_no_light_is_negative(backend, between):
    """Light is a difference of sums, which rounds to less than 0 in shadow: 0 is given there."""
    random, (y, x) = np.random.default_rng(2 if between else 0), np.mgrid[:96, :96]
    height = np.zeros(y.shape)
    for k in range(1, 6):
        size, *phases = random.normal() * 6 / k, random.random() * 6, random.random() * 6
        height += size * np.sin(k * x / 15 + phases[0]) * np.cos(k * y / 14 + phases[1])
    scene = sl.Scene.from_height(height)
    spot = sl.Sky(sl.cosine_power(300, axis=(1, 0.3, -0.8)))
    source = sl.Lamp((40, 40, -10), 2) if between else spot
    options = dict(quantity="irradiance", interreflection=between, backend=backend)
    assert sl.render(scene, source, tolerance=0.003 if between else 0.01, **options).image.min() >= 0
