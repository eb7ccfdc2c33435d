"""Light between surfaces: the kernels against the oracle, closed forms, and each other."""

import functools
import math

import numpy as np
import pytest
from scenes import rough
from surfaces import rms

import skylamp as sl
from skylamp import oracle
from skylamp.backends import select
from skylamp.light.interreflection import OFFSET, Bounces, Round, steps
from skylamp.samples import Samples

ROUNDS = (Round(8, 4, 4, 0.25), Round(8, 2, 4, 0.25), Round(4, 1, 8, 0.125))
ALBEDOS = 0.5, 0.8, 0.3


def azimuths(count):
    return 2 * np.pi * (np.arange(count) + OFFSET) / count


def masked(depth):
    valid = np.ones(depth.shape, bool)
    valid[3:6, 4:9] = valid[:, -1] = valid[9, 2] = False
    return valid


@functools.cache
def exact(rows, cols, sides, has_mask, count):
    """(depth, valid, shares, sky) of a rough map."""
    depth = rough(rows, cols, 0.9).astype(np.float32)
    valid = masked(depth) if has_mask else np.ones(depth.shape, bool)
    return depth, valid, *oracle.strips(depth.astype(float), 1.0, valid, azimuths(count), sides)


def bounces(backend, depth, valid, sides, direct, albedo, sky, spacing=1.0):
    engine = select(backend)
    scene = sl.Scene(
        np.where(valid, spacing * depth, np.nan), spacing, sides=sides, mask=None if valid.all() else valid
    )
    samples = Samples(engine, scene, 1)
    samples.set_nodes(*np.nonzero(valid)[::-1])
    return Bounces(engine, scene, samples, direct, albedo, sky.astype(np.float32))


def lights(shape, count=3):
    return list(np.random.default_rng(0).random((count, *shape)).astype(np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark", "periodic"])
@pytest.mark.parametrize("has_mask", [False, True], ids=["whole", "masked"])
def test_strips_are_the_oracles(backend, sides, has_mask):
    """Light of three colours and share of sky at every node, over every crossing, as in float64."""
    depth, valid, shares, sky = exact(13, 18, sides, has_mask, 12)
    direct = lights(depth.shape)
    found = bounces(backend, depth, valid, sides, direct, ALBEDOS, sky.reshape(depth.shape))
    light, seen = found.at_samples(12)
    at = found.samples.y * depth.shape[1] + found.samples.x
    sent = [albedo * np.where(valid, total, 0).ravel() for albedo, total in zip(ALBEDOS, found.irradiance())]
    expected = np.stack([(shares @ light_of)[at] for light_of in sent])
    # a map that repeats is followed to other slopes, and the oracle scales what it finds
    bound = 1e-5 if sides != "periodic" else 2e-4
    np.testing.assert_allclose(seen, sky[at], atol=bound)
    np.testing.assert_allclose(light, expected, atol=bound * expected.max())


@pytest.mark.parametrize("sides", ["open", "dark", "periodic"])
@pytest.mark.parametrize(
    "shape, has_mask", [((13, 18), True), ((16, 24), False), ((9, 11), False), ((1, 20), False)]
)
def test_backends_agree(backend, sides, shape, has_mask):
    """Rounds of all strides, with masks and maps of uneven sizes: as NumPy to 1e-5."""
    depth = rough(13, 24, 1.5).astype(np.float32)[: shape[0], : shape[1]]
    depth = np.resize(depth, shape)
    valid = masked(depth) if has_mask else np.ones(shape, bool)
    direct, sky = lights(shape), np.random.default_rng(1).uniform(0.5, 1, shape)
    albedo = [0.5, np.random.default_rng(2).random(shape), 0.3]
    found, again, expected = (
        bounces(name, depth, valid, sides, direct, albedo, sky) for name in (backend, backend, "numpy")
    )
    for each in ROUNDS:
        for one in (found, again, expected):
            one.run([each])
        got = found.irradiance()
        for light, same, other in zip(got, again.irradiance(), expected.irradiance()):
            assert light.tobytes() == same.tobytes()
            np.testing.assert_allclose(light, other, atol=1e-5)
            assert (light[~valid] == 0).all() and (light[valid] > 0).all()


@pytest.mark.parametrize("rounds", [ROUNDS[:1], ROUNDS[1:2], ROUNDS[2:]], ids=["4", "2", "1"])
def test_white_furnace(backend, rounds):
    """Albedo 1 on a map that repeats, under a uniform sky: pi everywhere, to 1e-5, by any receivers."""
    depth = rough(16, 24, 1.0).astype(np.float32)
    sky = np.random.default_rng(3).uniform(0.3, 1, depth.shape).astype(np.float32)
    found = bounces(
        backend, depth, np.ones(depth.shape, bool), "periodic", [np.float32(np.pi) * sky], [1.0], sky
    )
    found.run(rounds * 3)
    np.testing.assert_allclose(found.irradiance()[0], np.pi, rtol=1e-5)


def test_rounds_come_to_the_oracles_light(fast):
    """Many azimuths at every node: the converged light of exact strips to 1 %; direct light is far off."""
    depth, valid, shares, sky = exact(24, 26, "open", False, 24)
    direct = np.pi * sky.reshape(depth.shape).astype(np.float32)
    total = oracle.interreflection(direct.ravel(), np.full(depth.size, 0.8), shares).reshape(depth.shape)
    found = bounces(fast, depth, valid, "open", [direct], [0.8], sky.reshape(depth.shape))

    def error(light):
        return np.sqrt(np.mean((light - total) ** 2)) / total.mean()

    found.run([Round(24, 1, 32, 0.125)] * 6)
    assert error(found.irradiance()[0]) < 0.01 < 0.1 < error(direct)


@pytest.mark.slow
def test_planes_that_rounding_bends(backend):
    """Two slanted planes that meet: crossings of one height but for rounding; light is finite and bounded."""
    y, x = np.mgrid[:24, :40]
    depth = (1.1 * (12 - np.minimum(np.abs(0.9 * (x - 19.5) + 0.436 * (y - 11.5)), 12))).astype(np.float32)
    depth -= depth.min()
    sky = np.full(depth.shape, 0.8, np.float32)
    found = bounces(backend, depth, np.ones(depth.shape, bool), "open", [np.pi * sky], [0.8], sky)
    found.run([Round(36, 4, 8, 0.125), Round(36, 2, 8, 0.125), Round(36, 1, 8, 0.125)])
    got = found.irradiance()[0]
    assert (got >= np.float32(np.pi) * sky).all() and (got <= np.pi).all()
    light, _ = found.at_samples(72)
    assert (light >= 0).all() and (light <= np.pi).all()


@pytest.mark.parametrize("stride, bound", [(4, 0.003), (2, 0.003), (1, 0.003)])
def test_bowl(fast, stride, bound):
    """In a spherical bowl E = E_d / (1 - albedo (1 - f)), f = (1 + cos a) / 2."""
    size, rim, a = 128, 56, math.radians(50)
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    r, radius = np.hypot(x, y), rim / math.sin(a)
    depth = np.where(r < rim, np.sqrt(np.maximum(radius**2 - r * r, 0)) - radius * math.cos(a), 0.0)
    f = np.where(r < rim, (1 + math.cos(a)) / 2, 1.0)
    scene = sl.Scene(depth)
    engine = select(fast)
    # begun without any light between surfaces
    found = Bounces(
        engine, scene, Samples(engine, scene, 64), [np.float32(np.pi) * f.astype(np.float32)], [0.8], f
    )
    engine.put(found.total, np.float32(np.pi) * f.astype(np.float32).ravel())
    found.run([Round(16, stride, 8, 0.125)] * 6)
    got = found.irradiance()[0][r < rim - 4]
    assert got.mean() == pytest.approx(np.pi * f[64, 64] / (1 - 0.8 * (1 - f[64, 64])), rel=bound)


def test_no_light_is_negative(fast):
    """Where direct light is, by rounding or a control variate, a little below 0, it counts as 0."""
    depth = rough(12, 20, 1.0).astype(np.float32)
    valid, sky = np.ones(depth.shape, bool), np.full(depth.shape, 0.7)
    direct = lights(depth.shape, 1)
    low, none = ([np.where(direct[0] < 0.3, value, direct[0]).astype(np.float32)] for value in (-0.1, 0.0))
    one, other = (bounces(fast, depth, valid, "open", light, [0.8], sky) for light in (low, none))
    for found in (one, other):
        found.run(ROUNDS)
    np.testing.assert_array_equal(one.irradiance()[0], other.irradiance()[0])
    assert (one.irradiance()[0] >= 0).all()


def test_colours_are_grey_lights(backend):
    """Each of three lights comes out as it does alone, bit for bit."""
    depth = rough(12, 20, 1.0).astype(np.float32)
    valid, sky = np.ones(depth.shape, bool), np.random.default_rng(1).uniform(0.5, 1, depth.shape)
    direct = lights(depth.shape)
    together = bounces(backend, depth, valid, "open", direct, ALBEDOS, sky)
    together.run(ROUNDS)
    for light, albedo, expected in zip(direct, ALBEDOS, together.irradiance()):
        alone = bounces(backend, depth, valid, "open", [light], [albedo], sky)
        alone.run(ROUNDS)
        assert alone.irradiance()[0].tobytes() == expected.tobytes()


def test_spacing_scales_nothing(fast):
    """The same map in another unit of length: the same light."""
    depth = np.rint(rough(16, 16, 1.0)).astype(np.float32)
    valid, sky, direct = np.ones(depth.shape, bool), np.full(depth.shape, 0.7), lights(depth.shape, 1)
    one, other = (bounces(fast, depth, valid, "open", direct, [0.8], sky, unit) for unit in (1.0, 0.5))
    for found in (one, other):
        found.run(ROUNDS)
    np.testing.assert_array_equal(one.irradiance()[0], other.irradiance()[0])


def test_steps_grow():
    """One by one up to `near`, then by a share, up to `far`."""
    assert steps(4, 0.5, 20) == [1, 2, 3, 4, 6, 9, 13, 19]
    assert steps(30, 0.5, 5) == [1, 2, 3, 4, 5]


def test_rare_ground_in_a_dark_box_is_found(fast):
    """Two white walls on a dark plain: left out, with 2 % of the light, though open sides included it."""
    depth, albedo = np.full((96, 96), 6.0), np.full((96, 96), 0.02)
    depth[20:30, 40] = depth[60, 10:20] = 0.5
    albedo[depth < 1] = 1.0
    scene = sl.Scene(depth, albedo=albedo, sides="dark")
    auto = sl.render(scene, sl.Sky(), backend=fast)
    true = sl.render(scene, sl.Sky(), backend=fast, interreflection=True, tolerance=0.003)
    assert auto.interreflection.included
    assert rms(auto.image - true.image) < 0.01 * true.image.mean()


def test_walls_of_a_dark_box_are_no_ground(fast):
    """A bright plain at the bottom of a box sees little sky, and nothing that lights it: it is left out."""
    depth = np.full((32, 32), 12.0)
    depth[16, 16] = 11.9
    out = sl.render(sl.Scene(depth, albedo=0.9, sides="dark"), sl.Sky(), backend=fast)
    assert not out.interreflection.included and out.interreflection.share < 1e-3
