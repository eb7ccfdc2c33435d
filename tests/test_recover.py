"""recover(method="paper") equals the oracle's carving exactly, and says what went wrong."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
from skylamp import oracle
from skylamp.inverse import diagnostics
from skylamp.inverse.carving import carving_integers
from skylamp.sources.shapes import BALL, RECTANGLE, SKY, VOLUME, Geometry, radiance

paper = functools.partial(sl.recover, method="paper")
NOTHING = np.zeros((1, 1, 1), np.uint8)
LAYERS = 14
FEW = 6  # layers for the lamp of nodes, whose rays are long


def _volume():
    flags = np.zeros((3, 27, 36), bool)
    flags[0, 8:13, 10:16] = True
    flags[2, 20, 5:9] = True
    return flags


SOURCES = {
    "sky": (sl.Sky(), Geometry(SKY, np.zeros(4), NOTHING)),
    "overcast": (sl.Sky(sl.cie_overcast(3.0)), Geometry(SKY, np.zeros(4), NOTHING)),
    "window": (sl.Window(x=(8, 24.5), y=(5, 20)), Geometry(RECTANGLE, np.array([8, 24.5, 5, 20.0]), NOTHING)),
    "lamp": (
        sl.Lamp(center=(17, 12, -5), radius=4.5, brightness=sl.cosine_power(2)),
        Geometry(BALL, np.array([17, 12, -5, 4.5]), NOTHING),
    ),
    "volume": (sl.Lamp(volume=_volume()), Geometry(VOLUME, np.zeros(4), _volume().astype(np.uint8))),
}


@functools.cache
def _image(kind, sides, size=5):
    """An image of the fractal relief by the oracle's own Eq. 3 with a little noise; where nothing shines,
    still a little light.
    """
    cube, (source, geometry) = sl.Hemicube(size), SOURCES[kind]
    depth = scenes.layers("fractal")
    lit = oracle.surface_visibility(depth, cube.steps, sides, geometry)
    light = oracle.luminance(
        lit, oracle.normals(depth, 1.0, depth >= 0, sides), radiance(source, cube.directions), cube.moments
    )
    noise = 1 + 0.02 * np.random.default_rng(4).normal(size=depth.shape)
    return 0.6 / np.pi * light * noise + 1e-4


@functools.cache
def _carved(kind, sides, stop, eps, size=5, albedo="number"):
    cube, (source, geometry) = sl.Hemicube(size), SOURCES[kind]
    low, high, weights = carving_integers(
        _image(kind, sides, size),
        ALBEDO[albedo],
        radiance(source, cube.directions),
        cube.solid_angles,
        eps if stop == "eps" else 0.0,
    )
    return oracle.carve(
        low, high, weights, cube.steps, sides, geometry, FEW if kind == "volume" else LAYERS, stop
    )


ALBEDO = {
    "number": 0.6,
    "map": np.where(np.arange(36) % 7 < 3, np.float32(0.5), np.float32(0.7)) * np.ones((27, 1), np.float32),
}


@pytest.mark.slow
@pytest.mark.parametrize("stop", ["eps", "sign"])
@pytest.mark.parametrize(
    ("kind", "sides"),
    [
        (k, s)
        for k in SOURCES
        for s in scenes.SIDES
        if (k, s) != ("lamp", "periodic") and not (k == "overcast" and s != "dark")
    ],
)
def test_recovery_equals_the_oracle(backend, kind, sides, stop):
    """Every source and side, both stops: the same depth in every column; drilled means carved to the back."""
    expected = _carved(kind, sides, stop, 0.05)
    layers = FEW if kind == "volume" else LAYERS
    got = paper(
        _image(kind, sides),
        SOURCES[kind][0],
        0.6,
        sides,
        1.0,
        layers,
        5,
        eps=0.05,
        stop=stop,
        backend=backend,
    )
    assert got.backend == backend
    assert_bits_equal(got.depth, expected.astype(np.float32))
    assert_bits_equal(got.drilled, expected == layers)
    if not (
        kind == "sky" and stop == "sign" and sides != "dark"
    ):  # there all columns go down together, and nothing ever gets darker
        assert len(np.unique(expected)) > 2, "nothing was carved, so this test says little"


@pytest.mark.parametrize("eps", [pytest.param(0.002, marks=pytest.mark.slow), 0.3])
def test_recovery_with_an_albedo_map_and_spacing_equals_the_oracle(backend, eps):
    """The albedo divides the image, pixel by pixel; depth comes in the unit of the spacing; M = 9."""
    expected = _carved("sky", "dark", "eps", eps, 9, "map")
    got = paper(
        _image("sky", "dark", 9), sl.Sky(), ALBEDO["map"], "dark", 2.5, LAYERS, 9, eps=eps, backend=backend
    )
    assert_bits_equal(got.depth, (expected * 2.5).astype(np.float32))
    assert got.drilled.any() == (eps < 0.1)
    assert any("Drilled" in w and "stop='sign'" in w for w in got.warnings) == (eps < 0.1)


@pytest.mark.slow
def test_drilled_columns_are_named_and_the_sign_drills_fewer(backend):
    """With a narrow eps most columns never match; the stop at the sign change is monotone."""
    image = _image("sky", "dark")
    by_eps, by_sign = (
        paper(image, sl.Sky(), 0.6, "dark", 1.0, LAYERS, 5, eps=0.002, stop=stop, backend=backend)
        for stop in ("eps", "sign")
    )
    assert by_eps.drilled.mean() > 0.3 > by_sign.drilled.mean()
    assert any(f"{by_eps.drilled.mean():.1%}" in w for w in by_eps.warnings)


def test_an_image_of_equation_four_gives_its_depth_back(backend):
    """A flat floor in a dark box at depth 5, lit by Eq. 4 itself: no column goes deeper or drills, and those
    that stop above it do so because the few directions give two layers the same light.
    """
    cube = sl.Hemicube(7)
    depth = np.full((11, 14), 5)
    lit = oracle.surface_visibility(depth, cube.steps, "dark", scenes.SKY)
    image = 0.8 * (lit * cube.solid_angles).sum(-1) / (2 * np.pi)
    got = paper(image, sl.Sky(), 0.8, "dark", 1.0, 12, 7, eps=1e-6, backend=backend)
    assert got.depth.max() == 5 and got.depth.min() >= 3 and (got.depth == 5).mean() > 0.8
    assert not got.drilled.any() and got.warnings == []


def test_open_sides_under_a_sky_are_called_ill_posed(backend):
    """A flat start explains a plane's image at any depth; a window does not need the warning."""
    image = _image("sky", "open")
    assert any(
        "ill-posed" in w for w in paper(image, sl.Sky(), 0.6, layers=3, hemicube=3, backend=backend).warnings
    )
    assert not any(
        "ill-posed" in w
        for w in paper(image, SOURCES["window"][0], 0.6, layers=3, hemicube=3, backend=backend).warnings
    )
    assert not any(
        "ill-posed" in w
        for w in paper(image, sl.Sky(), 0.6, "dark", layers=3, hemicube=3, backend=backend).warnings
    )


def test_carving_has_a_residual_of_zero_and_no_albedo(backend):
    """As Recovery says: the residual is 0, and the albedo, which was given, is None."""
    got = paper(_image("sky", "dark"), sl.Sky(), 0.6, "dark", 1.0, LAYERS, 5, eps=0.05, backend=backend)
    assert_bits_equal(got.residual, np.zeros(got.depth.shape, np.float32))
    assert got.albedo is None


@pytest.mark.slow
def test_progress_counts_layers_and_a_second_run_is_the_same(backend):
    """Called once per layer with the total; the image is not changed."""
    image = _image("window", "dark").copy()
    before, calls = image.copy(), []
    first = paper(
        image,
        SOURCES["window"][0],
        0.6,
        "dark",
        1.0,
        LAYERS,
        5,
        backend=backend,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert calls == [(n + 1, LAYERS) for n in range(len(calls))] and calls
    assert_bits_equal(
        paper(image, SOURCES["window"][0], 0.6, "dark", 1.0, LAYERS, 5, backend=backend).depth, first.depth
    )
    assert_bits_equal(image, before)


def described(noise=0.0):
    """What `of_residual` asks of a pyramid."""
    return SimpleNamespace(noise=noise, sides="dark")


def test_a_residual_is_said_to_be_poorly_explained_and_where():
    """Above 3 % of the image, unless noise explains it; near the border the sides are named."""
    inside, rim = np.zeros((32, 32)), np.zeros((32, 32))
    inside[8:24, 8:24] = 0.2 * diagnostics.IMAGE_RMS
    rim[0] = 0.4 * diagnostics.IMAGE_RMS
    (text,) = diagnostics.of_residual(described(), inside)
    assert text.startswith("Poorly explained: model and image differ by 10%") and "relief is finer" in text
    (text,) = diagnostics.of_residual(described(), rim)
    assert "near the border: check the sides (sides='dark'" in text
    assert diagnostics.of_residual(described(), 0.29 * inside) == []
    assert diagnostics.of_residual(described(0.1 * diagnostics.IMAGE_RMS), inside) == []


def test_doubtful_pixels_are_said():
    """Ambiguous ones from half a percent on; of an unknown albedo untrusted ones above 20 %."""
    confidence, ambiguous = np.ones((20, 20)), np.zeros((20, 20), bool)
    assert diagnostics.of_confidence(confidence, ambiguous, False) == []
    ambiguous[0, :2], confidence[:5] = True, 0.4
    few, albedo = diagnostics.of_confidence(confidence, ambiguous, False)
    assert few.startswith("Ambiguous: 0.5%") and albedo.startswith("Depth depends on the albedo at 25% of")
    assert len(diagnostics.of_confidence(confidence, ambiguous, True)) == 1
    ambiguous[0, 1] = False
    (doubtful,) = diagnostics.of_confidence(confidence, ambiguous, True)
    assert doubtful.startswith("Doubtful: the confidence of 25% of the pixels is below 0.5.")
    assert diagnostics.of_confidence(confidence, ambiguous, True, place_is_known=False) == []
    confidence[4] = 1
    assert diagnostics.of_confidence(confidence, ambiguous, True) == []
    assert diagnostics.of_confidence(np.ones((20, 20)), ambiguous, False) == []


def test_images_of_few_levels_are_said():
    """8 bits where most neighbours differ by less than a step; for carving, fewer than 200 counts."""
    across = np.linspace(0.2, 0.8, 64) + np.linspace(0, 0.1, 64)[:, None]
    steps = lambda bits: np.round(across * 2**bits) / 2**bits
    scene, lamp = sl.Scene(np.ones((64, 64))), sl.Lamp((32.0, 32.0, -40.0), 10.0)
    of_images = lambda image: diagnostics.of_images([image], [image > 0], [lamp], scene, 20.0)
    (text,) = of_images(steps(5))
    assert text.startswith("8-bit steps: the image has 24 values, 0.031 apart")
    assert of_images(across) == [] and of_images(steps(16)) == []
    assert of_images(across[:1] * np.ones((64, 1))) == []  # 64 values, since it is constant along one axis
    shadow = np.where(np.hypot(*np.ogrid[-32:32, -32:32]) < 9, across, 0)  # 253 values and black around
    in_shadow = diagnostics.of_images([shadow], [np.ones((64, 64), bool)], [lamp], scene, 20.0)
    assert not any(text.startswith("8-bit") for text in in_shadow)
    (text,) = diagnostics.of_carving(steps(5), lamp, "open", np.zeros((64, 64), bool), "eps")
    assert text.startswith("Few counts: the image's values are multiples of 0.034")
    assert diagnostics.of_carving(across, lamp, "open", np.zeros((64, 64), bool), "eps") == []
