"""The forward model of recover(method="robust") and its derivatives: right, exact, and the same bits on every backend."""

import numpy as np
import pytest
import scenes

import skylamp as sl
from skylamp import oracle
from skylamp.backends import select
from skylamp.backends.adjoint import FIXED, Descent
from skylamp.synthesis import light_of

ROWS, COLS, COUNT = 17, 21, 16  # no multiple of the lanes
DEPTH = (scenes.rough(ROWS, COLS, 0.7, seed=2) + 8).astype(np.float32)
SUN = np.array([0.6, 0.3, -0.74]) / np.linalg.norm([0.6, 0.3, 0.74])
SOURCES = {
    "sky": sl.Sky(), "sun": sl.Sky(lambda L: 1 + 30 * np.exp(20 * (L @ SUN - 1))),
    "ball": sl.Lamp(center=(9, 7, -5), radius=6), "ball inside": sl.Lamp(center=(9, 7, 3), radius=3.0),
    "spot": sl.Lamp(center=(24, 9, -5), radius=4, brightness=sl.cosine_power(4, axis=(0.2, 0.1, 1))),
    "window": sl.Window(x=(4, 15), y=(3, 12)), "rectangle": sl.Lamp(corner=(3, 3, -6), edges=((8, 0, 0), (0, 7, 4))),
}  # fmt: skip
CASES = [(name, sides) for name in SOURCES for sides in scenes.SIDES if sides != "periodic" or name in ("sky", "sun")]


def _descent(backend, name, sides, depth=DEPTH, count=COUNT, gain=1.0):
    return Descent(select(backend), depth.shape, sides, [(light_of(SOURCES[name], depth.shape, 1.0, count), np.full(depth.shape, gain), np.zeros(depth.shape))], 0, 99)


def _irradiance(descent, depth):
    return descent.irradiances(depth)[0].astype(float)


def _transposed(descent, depth, u):
    """transpose(J) u by the device."""
    descent.value(depth, 0)
    descent._pull(descent.images[0], descent.backend.upload(u.astype(np.float32).ravel()), FIXED)
    total = descent.backend.download(descent.sum)
    descent.backend.fill(descent.sum, 0)
    return (total / FIXED).reshape(depth.shape)


@pytest.mark.parametrize("sides", scenes.SIDES[:2])
def test_sky_equals_the_oracle(backend, sides):
    """Horizons by the oracle's brute force, closed form over elevation, central differences."""
    azimuths = sl.Azimuths(COUNT)
    horizon = oracle.horizons(DEPTH.astype(float), 1.0, azimuths.angles, sides)
    expected = oracle.sky_irradiance(DEPTH, 1.0, np.ones(DEPTH.shape, bool), azimuths.angles, azimuths.widths, horizon)
    np.testing.assert_allclose(_irradiance(_descent(backend, "sky", sides), DEPTH), expected, atol=3e-6)


@pytest.mark.parametrize("name", ["ball", "ball inside", "spot", "window", "rectangle"])
def test_lamps_and_windows_agree_with_shadow_rays(fast, name):
    """Within the noise of 4096 rays per node; the window's slices have kinks at its corners, which 16 of them see coarsely."""
    nodes = (np.array([2, 8, 13, 5]), np.array([3, 11, 17, 7]))
    source, valid = SOURCES[name], np.ones(DEPTH.shape, bool)
    if isinstance(source, sl.Window):
        expected = oracle.window_irradiance(DEPTH, 1.0, valid, source, nodes)
    else:
        lamp = source if source.center is not None else (source.corner, *source.edges, source.brightness)
        expected = oracle.lamp_irradiance(DEPTH, 1.0, valid, lamp, nodes)
    got = _irradiance(_descent(fast, name, "open"), DEPTH)[nodes]
    np.testing.assert_allclose(got, expected, atol=0.015 * expected.max())


@pytest.mark.parametrize(("name", "sides"), CASES)
def test_gradient_agrees_with_finite_differences(fast, name, sides):
    """Of a random weighting of all irradiances, by every fifth depth. A difference may step over a kink, so the median decides."""
    descent, rng = _descent(fast, name, sides), np.random.default_rng(1)
    weights = rng.normal(size=DEPTH.shape)
    exact = _transposed(descent, DEPTH, weights)
    step, wrong, size = 4e-3, [], []
    for index in range(0, DEPTH.size, 5):
        up, down = DEPTH.copy(), DEPTH.copy()
        up.flat[index] += step
        down.flat[index] -= step
        slope = (weights * (_irradiance(descent, up) - _irradiance(descent, down))).sum() / (float(up.flat[index]) - float(down.flat[index]))
        wrong.append(abs(slope - exact.flat[index]))
        size.append(abs(slope))
    assert np.median(wrong) < 1e-3 * np.mean(size), np.median(wrong) / np.mean(size)
    assert np.percentile(wrong, 80) < 2e-2 * np.mean(size)


@pytest.mark.parametrize(("name", "sides"), CASES)
def test_products_are_each_others_transpose(backend, name, sides):
    """u . (J v) = (transpose(J) u) . v, to float32."""
    descent, rng = _descent(backend, name, sides), np.random.default_rng(2)
    u, v = rng.normal(size=(2, *DEPTH.shape)).astype(np.float32)
    transposed = _transposed(descent, DEPTH, u)
    engine, image = descent.backend, descent.images[0]
    out = engine.empty((descent.pixels,), np.float32)
    descent._launch("push", *image.products(), image.gain, engine.upload(v.ravel()), out, ROWS, COLS, image.count, dim=(-(-descent.pixels // engine.lanes),))
    forward = float(u.ravel().astype(float) @ engine.download(out))
    assert forward == pytest.approx(float((transposed * v).sum()), rel=1e-5, abs=1e-5)
    assert abs(forward) > 0.01


@pytest.mark.parametrize(("name", "sides"), CASES)
def test_backends_have_equal_bits(backend, name, sides):
    """Irradiance, where every slice's limit lies, and the depth after five Gauss-Newton steps, against NumPy."""
    def state(backend):
        descent = _descent(backend, name, sides, gain=0.3)
        light = descent.irradiances(DEPTH)[0]
        at = descent.backend.download(descent.images[0].at).copy()
        descent.aim([light])
        return light, at, descent.run(DEPTH + np.linspace(0, 2, COLS), 1e-3, 5, 15)[0]

    light, at, depth = state(backend)
    for got, expected in zip((light, at, depth), state("numpy")):
        np.testing.assert_array_equal(got, expected)
    assert np.ptp(light) > 0 and np.abs(depth - DEPTH - np.linspace(0, 2, COLS)).max() > 0.1


def test_bounds_hold_and_the_objective_never_rises(fast):
    """Whatever the image asks for, depth stays between its bounds, and more steps are no worse."""
    low, high = 6.0, np.where(np.arange(COLS) < 9, 9.0, 30.0) * np.ones((ROWS, 1))
    target = np.full(DEPTH.shape, 0.1)
    descent = Descent(select(fast), DEPTH.shape, "dark", [(light_of(sl.Sky(), DEPTH.shape, 1.0, COUNT), np.full(DEPTH.shape, 0.3), target)], low, high)
    values = []
    for steps in (1, 4, 12):
        z, value = descent.run(np.full(DEPTH.shape, 8.0), 1e-4, steps, 20, settled=0)
        values.append(value)
        assert z.min() >= low and (z <= high.astype(np.float32)).all()
    assert values[0] > values[1] >= values[2] and (z[:, :9] == 9).any()
