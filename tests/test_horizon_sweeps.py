"""Horizons by sweeps: backends against each other and against the oracle, the light above them, closed forms.

Heights are in spacings; what has no unit here is one of those.
"""

import functools
import importlib
import inspect
import math
import re

import numpy as np
import pytest
from compare import assert_bits_equal
from scenes import resident_map, rough

import skylamp as sl
import skylamp.opencl
from skylamp import oracle
from skylamp.backends import select
from skylamp.light.sweeps import FINE_NEAR_ROWS, MANY_AZIMUTHS, NEAR_ROWS, Ground, Rays, Sweeps

AGREE = 1e-5  # rad, and of the largest irradiance: what backends may differ by
HORIZON = 0.002  # rad, RMS against the oracle


def even(count):
    return Rays(2 * np.pi * (np.arange(count) + 0.5) / count, np.full(count, 2 * np.pi / count))


def _uneven(count):
    edges = np.sort(np.random.default_rng(2).random(count)) * 2 * np.pi
    widths = np.diff(edges, append=edges[0] + 2 * np.pi)
    return Rays((edges + widths / 2) % (2 * np.pi), widths)


def _axes():
    """Exactly along rows, columns and diagonals."""
    return Rays(np.arange(8) * np.pi / 4, np.full(8, np.pi / 4))


RAYS = {"even": even(16), "axes": _axes(), "uneven": _uneven(11), "few": _uneven(5)}


def _masked(shape, slope, falloff, seed):
    """Holes, at the border too, and a few nodes by themselves."""
    height = -rough(*shape, slope, seed, falloff)
    rows, cols = shape
    height[rows // 5 : rows // 2, cols // 4 : cols // 2] = -np.inf
    height[rows // 2 :, : cols // 12] = -np.inf
    height[np.random.default_rng(seed).random(shape) < 0.005] = -np.inf
    return height


def _noise(rows, cols):
    return -4 * np.random.default_rng(rows).random((rows, cols))


MAPS = {
    "rough": lambda: -rough(96, 120, 1.0, 1, 2.0), "smooth": lambda: -rough(96, 120, 0.5, 1, 2.5),
    "rough with holes": lambda: _masked((96, 120), 1.0, 2.0, 1),
    "smooth with holes": lambda: _masked((96, 120), 0.5, 2.5, 1),
    "small": lambda: -rough(29, 37, 1.0, 3, 2.0), "small with holes": lambda: _masked((37, 30), 1.0, 2.0, 4),
    "wide": lambda: -rough(9, 70, 1.0, 4, 2.0),
    "flat enough": lambda: -rough(20, 26, 0.2, 6, 2.5),  # a periodic map is swept 500 times its relief
    "one": lambda: _noise(1, 1), "row": lambda: _noise(1, 9),
    "column": lambda: _noise(9, 1), "tiny": lambda: _noise(3, 5),
}  # fmt: skip


@functools.cache
def heights(name):
    made = MAPS[name]().astype(np.float32)
    made.flags.writeable = False
    return made


def ground(backend, height, sides="open", reach=math.inf):
    """Heights [spacing] above the viewer's plane, -inf where masked, on a backend."""
    return Ground(resident_map(backend, -height), sides, reach)


@functools.cache
def truth(name, sides, reach, rays):
    """The oracle's horizons at the valid nodes (K, n)."""
    nodes = np.nonzero(np.isfinite(heights(name)))
    return oracle.horizons(
        -heights(name).astype(float),
        1.0,
        RAYS[rays].angles,
        sides,
        None if math.isinf(reach) else reach,
        nodes,
    )


@functools.cache
def found(backend, name, sides, reach, rays):
    """Horizons (K, n) and irradiance (n,) of the valid nodes, by a backend."""
    sweeps = Sweeps(select(backend), ground(backend, heights(name), sides, reach), RAYS[rays])
    valid = np.isfinite(heights(name))
    return sweeps.slopes()[:, valid], sweeps.irradiance()[valid]


def off(got, expected):
    """Angles [rad] between horizons; anything but -inf in the same places fails, and so does nan."""
    assert got.shape == expected.shape and got.size and not np.shares_memory(got, expected)
    assert not np.isnan(got).any() and not np.isnan(expected).any(), "nan"
    wrong = np.isneginf(got) != np.isneginf(expected)
    assert not wrong.any(), (
        f"{wrong.sum()} of {wrong.size} horizons are -inf in one only, {np.isneginf(got)[wrong].sum()} of"
        " them in the first"
    )
    some = np.isfinite(got)
    return np.arctan(got[some].astype(float)) - np.arctan(expected[some].astype(float))


def rms(errors):
    return float(np.sqrt(np.mean(np.square(errors)))) if errors.size else 0.0


def assert_agree(got, expected, bound=AGREE):
    """Horizons and irradiance of two backends; on CPUs all but a last bit of a few horizons are equal."""
    errors = abs(off(got[0], expected[0]))
    assert (errors <= bound).all(), (
        f"{(errors > bound).sum()} of {errors.size} horizons differ, by up to {errors.max():.2g} rad"
    )
    light = abs(got[1].astype(float) - expected[1])
    assert (light <= AGREE * expected[1].max()).all(), (
        f"irradiance differs by up to {light.max():.2g} of {expected[1].max():.2g}"
    )


# --- backends


@pytest.mark.parametrize("stem", ["horizon", "ground"])
def test_numpy_kernels_take_the_same_arguments(stem):
    """Names and order as in OpenCL; constants by keyword."""
    module = importlib.import_module(f"skylamp.backends.numpy.{stem}")
    text = re.sub(r"/\*.*?\*/", "", skylamp.opencl.source(stem), flags=re.S)
    kernels = re.findall(r"__kernel void (\w+)\((.*?)\)", text, re.S)
    assert kernels
    for name, arguments in kernels:
        parameters = inspect.signature(getattr(module, name)).parameters.values()
        assert [p.name for p in parameters if p.kind == p.POSITIONAL_OR_KEYWORD] == [
            re.search(r"\w+$", a.strip()).group().rstrip("_") for a in arguments.split(",")
        ]
        assert {p.name for p in parameters if p.kind == p.KEYWORD_ONLY} == (
            {"NEAR", "SIDES", "WHAT", "FALLS", "BLOCKS"} if name == "sweep" else set()
        )


CASES = [
    *(("small", "open", math.inf, rays) for rays in ("even", "axes", "uneven")),
    *(("small", "open", reach, "even") for reach in (1, 2.5, 7, 20)),
    *(("small", "dark", math.inf, rays) for rays in ("even", "axes")),
    ("small", "dark", 7, "even"),
    ("flat enough", "periodic", math.inf, "few"), ("flat enough", "periodic", math.inf, "axes"),
    *(("small", "periodic", reach, "even") for reach in (1, 2.5, 7, 20, 90)),
    ("small with holes", "open", math.inf, "even"), ("small with holes", "dark", math.inf, "uneven"),
    ("small with holes", "open", 7, "axes"), ("small with holes", "periodic", 7, "even"),
    ("wide", "open", math.inf, "even"), ("wide", "open", 20, "uneven"), ("wide", "open", 45, "even"),
    ("wide", "dark", math.inf, "uneven"), ("wide", "periodic", 7, "uneven"),
    *(
        (name, sides, reach, "uneven")
        for name in ("one", "row", "column", "tiny")
        for sides, reach in (("open", math.inf), ("dark", math.inf), ("periodic", 7), ("open", 2.5))
    ),
    *((name, "open", math.inf, "axes") for name in ("one", "row", "column", "tiny")),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_backends_agree(backend, case):
    """With NumPy's sweep, and that with OpenCL's."""
    other = "numpy" if backend != "numpy" else "opencl"
    on_cpus = all(
        select(name).lines == 1 for name in (backend, other)
    )  # no device with a reciprocal of its own
    assert_agree(found(backend, *case), found(other, *case), 1e-6 if on_cpus else AGREE)


def test_agreement_can_fail():
    """One horizon of the smallest map, off by 2e-5 rad, or -inf, or one node's light, is seen."""
    whole = found("numpy", "tiny", "open", math.inf, "uneven")
    assert_agree([part.copy() for part in whole], whole, 0)
    at = np.argwhere(np.isfinite(whole[0]))[3]
    for part, index, value in (
        (0, tuple(at), whole[0][tuple(at)] + 2e-5 * (1 + whole[0][tuple(at)] ** 2)),
        (0, tuple(at), -np.inf),
        (0, tuple(at), np.nan),
        (1, 2, whole[1][2] * 0.9999),
    ):
        changed = [p.copy() for p in whole]
        changed[part][index] = value
        with pytest.raises(AssertionError):
            assert_agree(changed, whole)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "near"), [(MANY_AZIMUTHS - 1, NEAR_ROWS), (MANY_AZIMUTHS, FINE_NEAR_ROWS)])
def test_many_azimuths_take_more_near_rows(backend, count, near):
    """Both numbers of near rows, and the same light by every backend."""
    height = heights("small with holes")
    valid = np.isfinite(height)
    sweeps = Sweeps(select(backend), ground(backend, height), even(count))
    assert sweeps.near == near
    got = sweeps.irradiance()[valid].astype(float)
    expected = _light("numpy" if backend != "numpy" else "opencl", "small with holes", count)[valid]
    assert abs(got - expected).max() <= AGREE * expected.max()


@pytest.mark.slow
@functools.cache
def test_near_rows_that_local_memory_does_not_hold(backend):
    """96 near rows, of which cliffs ask for, cross every line of a map of 29 rows: horizons are exact."""
    sweeps = Sweeps(select(backend), ground(backend, heights("small")), RAYS["even"], near=96)
    slopes = sweeps.slopes()[:, np.isfinite(heights("small"))]
    assert abs(off(slopes, truth("small", "open", math.inf, "even"))).max() < 1e-4


def _light(backend, name, count):
    return Sweeps(select(backend), ground(backend, heights(name), "open"), even(count)).irradiance()


@pytest.mark.parametrize(
    ("sides", "reach"),
    [
        ("open", math.inf),
        pytest.param("open", 7, marks=pytest.mark.slow),
        pytest.param("dark", math.inf, marks=pytest.mark.slow),
        ("periodic", 7),
    ],
)
def test_a_repeat_gives_the_same_bytes(backend, sides, reach):
    """Sums in fixed point do not depend on who adds first."""
    one, again = (
        Sweeps(select(backend), ground(backend, heights("small with holes"), sides, reach), RAYS["even"])
        for _ in range(2)
    )
    slopes = one.slopes().tobytes()
    assert slopes == one.slopes().tobytes() == again.slopes().tobytes()
    assert one.irradiance().tobytes() == again.irradiance().tobytes()


# --- horizons against the oracle


@pytest.mark.slow
def test_every_backend_is_near_the_oracle(backend):
    """All crossings, in float64."""
    got, _ = found(backend, "rough", "open", math.inf, "even")
    expected = truth("rough", "open", math.inf, "even")
    assert (expected < 0).mean() > 0.05 and np.isneginf(expected).any()
    assert rms(off(got, expected)) <= HORIZON


@pytest.mark.slow
@pytest.mark.parametrize("rays", ["even", "axes", "uneven"])
@pytest.mark.parametrize("sides", ["open", "dark"])
@pytest.mark.parametrize("name", ["rough", "smooth", "rough with holes", "smooth with holes"])
def test_horizons(fast, name, sides, rays):
    """RMS, and never above the oracle's, since every crossing that is looked up is there."""
    errors = off(found(fast, name, sides, math.inf, rays)[0], truth(name, sides, math.inf, rays))
    assert errors.max() <= AGREE
    if "holes" in name:
        errors = _but_a_few(errors)
    assert rms(errors) <= HORIZON


def _but_a_few(errors):
    """Errors without the largest thousandth; the RMS of all is up to 0.006 rad.

    Ground that is visible along a line next to a hole may lie in the hole for a node half a step away.
    """
    assert rms(errors) <= 0.006
    return np.sort(abs(errors))[: len(errors) * 999 // 1000]


@pytest.mark.slow
@pytest.mark.parametrize("rays", ["few", "axes"])
@pytest.mark.parametrize("name", ["rough", "smooth"])
def test_horizons_of_maps_that_repeat(fast, name, rays):
    """As far as the oracle looks, which is to where no ground can rise as much as it says."""
    errors = off(found(fast, name, "periodic", math.inf, rays)[0], truth(name, "periodic", math.inf, rays))
    assert abs(errors).max() <= 0.25 and rms(errors) <= HORIZON


@pytest.mark.slow
@pytest.mark.parametrize(("reach", "bound"), [(1, 1e-5), (2.5, 1e-5), (7, 1e-3), (20, 0.004), (60, 0.004)])
@pytest.mark.parametrize("sides", ["open", "dark", "periodic"])
@pytest.mark.parametrize("name", ["rough", "smooth with holes"])
def test_horizons_within_reach(fast, name, sides, reach, bound):
    """Near ones are exact; ground that lies farther away never counts."""
    errors = off(found(fast, name, sides, reach, "uneven")[0], truth(name, sides, reach, "uneven"))
    assert errors.size == 0 or errors.max() <= AGREE
    assert rms(_but_a_few(errors) if "holes" in name and errors.size else errors) <= bound


@pytest.mark.parametrize("sides", ["open", "dark", "periodic"])
@pytest.mark.parametrize("name", ["one", "row", "column", "tiny"])
@pytest.mark.parametrize("rays", ["axes", "uneven"])
def test_horizons_of_tiny_maps(fast, name, sides, rays):
    """Nothing is farther than the near rows, so they are exact; where a map repeats, as near as always."""
    reach = 4 if sides == "periodic" else math.inf
    errors = off(found(fast, name, sides, reach, rays)[0], truth(name, sides, reach, rays))
    assert not errors.size or abs(errors).max() <= (0.02 if sides == "periodic" else AGREE)


def test_reach_beyond_a_map_that_repeats(fast):
    """A search radius longer than the map is still one."""
    errors = off(found(fast, "tiny", "periodic", 20, "uneven")[0], truth("tiny", "periodic", 20, "uneven"))
    assert errors.max() <= AGREE and rms(errors) <= 0.004


def test_a_profile_that_repeats_is_swept_over_few_rows(fast):
    """As many as its relief needs, in either direction, however long it is: time went with the square."""
    profile = np.sin(np.arange(5000.0) / 9)[None]
    for height in (profile, profile.T):
        for half in Sweeps(select(fast), ground(fast, height, "periodic"), RAYS["even"]).halves:
            assert half.warm <= max(half.rows, 201)


@pytest.mark.slow
def test_reach_beyond_a_narrow_map_with_a_cliff(backend):
    """The ladder's integers hold falls over a window that is longer than the map has rows."""
    ground = np.where(np.arange(30)[:, None] < 15, 300.0, 0) + np.random.default_rng(0).random((30, 108))
    slopes = sl.horizons(sl.Scene.from_height(ground), 8, backend, max_distance=130.0)
    true = oracle.horizons(ground.max() - ground, 1.0, sl.Azimuths(8).angles)
    seen = np.isfinite(true)
    assert rms(np.arctan(slopes[seen]) - np.arctan(true[seen])) <= HORIZON


@pytest.mark.parametrize("broken", ["near", "azimuths", "ladder"])
def test_a_broken_table_is_seen(fast, monkeypatch, broken):
    """The comparison with the oracle fails if a table is wrong by a tenth of a node or by a degree."""
    module = importlib.import_module("skylamp.light.sweeps")
    if broken == "ladder":
        original = module.ladder
        monkeypatch.setattr(
            module,
            "ladder",
            lambda *args: (*original(*args)[:2], original(*args)[2][:1] * 16, original(*args)[3][:1] * 16),
        )
    engine = select(fast)
    sweeps = Sweeps(engine, ground(engine.name, heights("rough"), "open"), RAYS["even"])
    for half in sweeps.halves:
        azimuths, _, _, weights = (engine.download(table) for table in half.tables)
        if broken == "near":
            half.tables[3] = engine.upload(weights + np.float32(0.1))
        if broken == "azimuths":
            azimuths[:, 0] += np.float32(0.0175)
            half.tables[0] = engine.upload(azimuths)
    errors = sweeps.slopes().reshape(16, -1)
    errors = np.arctan(errors.astype(float)) - np.arctan(truth("rough", "open", math.inf, "even"))
    assert rms(errors[np.isfinite(errors)]) > 1.5 * HORIZON


# --- light


def _from_oracle(height, rays, nodes, sides="open", brightness=None):
    depth = -height.astype(float)
    valid = np.isfinite(height)
    return oracle.sky_irradiance(
        depth,
        1.0,
        valid,
        rays.angles,
        rays.widths,
        oracle.horizons(depth, 1.0, rays.angles, sides, nodes=nodes),
        brightness,
        nodes,
        sides,
    )


@pytest.mark.parametrize(
    ("name", "sides"), [("rough", "open"), ("smooth with holes", "dark"), ("flat enough", "periodic")]
)
def test_light_of_the_same_azimuths(backend, name, sides):
    """What the oracle has with the same azimuths: only horizons and normals differ."""
    height, rays = heights(name), RAYS["uneven"]
    rng = np.random.default_rng(0)
    nodes = tuple(rng.permutation(np.argwhere(np.isfinite(height)))[:200].T)
    got = Sweeps(select(backend), ground(backend, height, sides), rays).irradiance()[nodes]
    errors = (got - _from_oracle(height, rays, nodes, sides)) / np.pi
    assert rms(errors) <= 0.001 and abs(errors).max() <= 0.01


def overcast(L):
    """A third at the horizon, and more towards +x."""
    return (1 - 2 * L[..., 2]) / 3 * (1 + 0.5 * L[..., 0] / np.hypot(L[..., 0], L[..., 1]))


def _table(rays, knots):
    """Its integrals over elevation from each knot on, in closed form, as opencl/horizon.cl wants them."""
    knot = np.linspace(0, 1, knots)
    sine, cosine = knot / np.hypot(knot, 1 - knot), (1 - knot) / np.hypot(knot, 1 - knot)
    flat = ((np.pi / 2 - np.arcsin(sine) - sine * cosine) / 2 + 2 * cosine**3 / 3) / 3
    upright = (cosine**2 / 2 + 2 * (1 - sine**3) / 3) / 3
    both = np.stack([flat, upright, *(np.append(np.diff(v), 0) for v in (flat, upright))], -1)
    return (both * (1 + 0.5 * np.cos(rays.angles))[:, None, None]).astype(np.float32)


@pytest.mark.slow
def test_light_by_tables(backend):
    """Brightness that depends on elevation and azimuth, against the oracle's quadrature and NumPy's sums."""
    height, rays = heights("small with holes"), RAYS["even"]
    valid = np.isfinite(height)
    table = _table(rays, 257)
    got = Sweeps(select(backend), ground(backend, height, "open"), rays, table).irradiance()[valid]
    errors = (got - _from_oracle(height, rays, np.nonzero(valid), brightness=overcast)) / np.pi
    assert rms(errors) <= 0.0005 and abs(errors).max() <= 0.01
    other = "numpy" if backend != "numpy" else "opencl"
    same = Sweeps(select(other), ground(other, height, "open"), rays, table).irradiance()[valid]
    assert abs(got.astype(float) - same).max() <= AGREE * same.max()


@functools.cache
def _sampled(slope, falloff):
    """A map of 256 x 256, 300 of its nodes, and E / pi there by 1024 exact azimuths."""
    height = -rough(256, 256, slope, 1, falloff).astype(np.float32)
    nodes = tuple(np.random.default_rng(1).integers(0, 256, (2, 300)))
    return height, nodes, _from_oracle(height, even(1024), nodes) / np.pi


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slope", "falloff", "limits"),
    [(1.0, 2.0, {32: 0.0015, 64: 0.0007}), (0.5, 2.5, {32: 0.0005, 64: 0.0002})],
    ids=["rough", "smooth"],
)
def test_accuracy_of_a_uniform_sky(fast, slope, falloff, limits):
    """E / pi against 1024 exact azimuths: within limits, 1.5 times better for twice the azimuths."""
    height, nodes, expected = _sampled(slope, falloff)
    errors = {
        count: (
            Sweeps(select(fast), ground(fast, height, "open"), even(count)).irradiance()[nodes] / np.pi
            - expected
        )
        for count in (8, 16, 32, 64, 128, 256)
    }
    size = {count: rms(error) for count, error in errors.items()}
    for count, limit in limits.items():
        assert size[count] <= limit and abs(errors[count]).max() <= 0.02, size
    for count in (8, 16, 32, 64, 128):
        assert size[2 * count] <= size[count], size
        assert size[count] <= 0.00015 or size[2 * count] <= max(size[count] / 1.5, 0.00015), size


# --- closed forms


@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_a_plane_is_lit_by_all_the_sky(backend, sides):
    """E = pi B, whatever the azimuths, and beside masked nodes too."""
    height = np.full((23, 31), -5, np.float32)
    height[4:9, 6:14] = -np.inf
    for rays in ("even", "uneven", "axes"):
        light = Sweeps(select(backend), ground(backend, height, sides), RAYS[rays]).irradiance()
        assert abs(light[np.isfinite(height)] / np.pi - 1).max() <= 1e-6


@pytest.mark.parametrize(("gx", "gy"), [(0.3, 0.0), (0.0, -1.0), (0.9, 1.4), (-3.0, 0.5)])
def test_a_tilted_plane(backend, gx, gy):
    """E = pi B (1 + cos a) / 2 everywhere: its own ground is no higher than its tangent plane."""
    y, x = np.mgrid[:28, :33]
    height = (gx * x + gy * y - 100).astype(np.float32)
    light = Sweeps(select(backend), ground(backend, height, "open"), even(64)).irradiance()
    exact = np.pi * (1 + 1 / math.sqrt(1 + gx * gx + gy * gy)) / 2
    assert abs(light / exact - 1).max() <= 0.002


@pytest.mark.slow
@pytest.mark.parametrize(("half", "deep", "along"), [(10, 5, "rows"), (10, 20, "columns"), (15, 30, "rows")])
def test_the_middle_of_a_trench(backend, half, deep, along):
    """E = pi B a / sqrt(a^2 + d^2), a to the rim's node; 40 times as long as wide, so as good as endless."""
    height = np.zeros((2 * half + 9, 400), np.float32)
    height[5:-5] = -deep
    assert len(height[5:-5]) == 2 * half - 1
    height = height if along == "rows" else np.ascontiguousarray(height.T)
    middle = (half + 4, 200) if along == "rows" else (200, half + 4)
    light = Sweeps(select(backend), ground(backend, height, "open"), even(32)).irradiance()[middle]
    assert abs(light / (np.pi * half / math.hypot(half, deep)) - 1) <= 0.002


def _bowl(backend, degrees, count):
    """Largest relative error inside a spherical bowl of radius 200, away from its rim by 2 nodes."""
    radius, rim = 200, math.radians(degrees)
    size = math.ceil(radius * math.sin(rim)) + 4
    y, x = np.mgrid[-size : size + 1, -size : size + 1]
    away = np.hypot(x, y)
    height = radius * math.cos(rim) - np.sqrt(np.maximum(radius**2 - away**2, (radius * math.cos(rim)) ** 2))
    light = Sweeps(
        select(backend), ground(backend, height.astype(np.float32), "open"), even(count)
    ).irradiance()
    inside = away <= radius * math.sin(rim) - 2
    return abs(light[inside] / (np.pi * (1 + math.cos(rim)) / 2) - 1).max()


@pytest.mark.slow
def test_a_shallow_bowl(backend):
    """The same light at every point, E = pi B (1 + cos a) / 2."""
    assert _bowl(backend, 20, 64) <= 0.002


@pytest.mark.parametrize("degrees", [30, 45, 60])
def test_a_bowl(fast, degrees):
    """The same, up to a rim of 60 degrees."""
    assert _bowl(fast, degrees, 64) <= 0.002


def test_arrays_last_as_long_as_kernels_need_them(fast):
    """A large periodic map is swept through scratch arrays, released while kernels may still run."""
    depth = np.tile(rough(64, 64, 0.3), (17, 17))
    options = dict(method="horizon", azimuths=4, max_distance=9, backend=fast)
    image = sl.render(sl.Scene(depth, sides="periodic"), sl.Sky(), **options).image
    small = sl.render(sl.Scene(depth[:64, :64], sides="periodic"), sl.Sky(), **options).image
    np.testing.assert_allclose(image[512:576, 512:576], small, atol=0.01)


def test_numpy_climbs_before_a_map_that_repeats_in_blocks_of_any_size(monkeypatch):
    """Whether many rows come in at once, or one."""
    module = importlib.import_module("skylamp.backends.numpy.horizon")
    scene = sl.Scene(5 * np.random.default_rng(3).random((6, 7)), sides="periodic")
    slopes = []
    for rays in (2**18, 1000, 1):
        monkeypatch.setattr(module, "WARM_UP", rays)
        slopes.append(sl.horizons(sl.Scene(scene.depth, sides="periodic"), 5, backend="numpy"))
    assert_bits_equal(slopes[1], slopes[0])
    assert_bits_equal(slopes[2], slopes[0])
