"""Irradiance with its derivatives, and the steps of Gauss-Newton: against float64, against dense matrices,
and backend by backend.
"""

import functools
import importlib
import math

import numpy as np
import pytest
from compare import assert_bits_equal
from scenes import rough

import skylamp as sl
from skylamp import oracle
from skylamp.backends import select
from skylamp.constants import SIDES
from skylamp.errors import CapacityError
from skylamp.inverse import conjugate_gradients, lights, resampling
from skylamp.inverse.descent import Descent
from skylamp.inverse.posterior import posterior_deviation, prior_sample

SHAPE = (9, 11)


def overcast(L):
    return (1 - 2 * L[..., 2]) / 3


def glow(L):
    """Bright towards one side, and towards the zenith."""
    return 0.3 + L[..., 2] ** 2 + 0.5 * np.maximum(0, L[..., 0] - 0.4 * L[..., 1])


SUN = np.array([0.6, 0.3, -0.74]) / np.linalg.norm([0.6, 0.3, 0.74])
SKIES = {
    "uniform": sl.Sky(),
    "glow": sl.Sky(brightness=glow),
    "sun": sl.Sky(lambda L: 1 + 30 * np.exp(20 * (L @ SUN - 1))),
}
SOLIDS = {  # for a map of SHAPE, depths from 3 on
    "ball": sl.Lamp(center=(5.3, 12.5, -4.0), radius=1.5),
    "ball overhead": sl.Lamp(center=(4.2, 4.6, -5.0), radius=4.0),
    "ball round a few nodes": sl.Lamp(center=(5.2, 4.3, 3.5), radius=2.5),
    "ball in the box": sl.Lamp(center=(5.2, 3.6, 1.0), radius=0.8),  # below the walls' tops
    "window": sl.Window(x=(3.7, 8.9), y=(2.2, 11.4)),
    "upright": sl.Lamp(corner=(-3.0, 1.3, 2.0), edges=((0.0, 7.0, 0.0), (0.0, 0.0, -9.0))),
}
SPOTS = {
    "spot": sl.Lamp(center=(5.3, 12.5, -4.0), radius=1.5, brightness=glow),
    "lit window": sl.Window(x=(3.7, 8.9), y=(2.2, 11.4), brightness=overcast),
}
SOURCES = {**SKIES, **SOLIDS, **SPOTS}
CASES = [
    (name, sides)
    for name, source in SOURCES.items()
    for sides in ("open", "dark", "periodic")
    if name in SKIES or sides != "periodic"
]


@pytest.fixture(autouse=True)
def few_slices(monkeypatch):
    monkeypatch.setattr(lights, "LAMP_SLICES", 10)


def ground(shape=SHAPE, seed=0, slope=0.8):
    """Depths from 3 on; float32, so that float64 sees the same ones."""
    return (3 + rough(max(shape[0], 2), max(shape[1], 2), slope, seed)[: shape[0], : shape[1]]).astype(
        np.float32
    )


def light_of(source, shape, azimuths):
    return lights.light_of(source, shape, 1.0, lights.brightness_of(source, azimuths))


def problem(
    backend, source, shape=SHAPE, sides="open", gain=1.0, target=0.0, low=0.0, high=1e3, azimuths=8, **more
):
    full = lambda value: np.broadcast_to(np.asarray(value, float), shape)
    lights = [light_of(each, shape, azimuths) for each in (source if isinstance(source, list) else [source])]
    return Descent(
        select(backend),
        shape,
        sides,
        [(light, full(gain), full(target)) for light in lights],
        full(low),
        full(high),
        **more,
    )


def gradient(made, smoothness):
    """Readies a step of conjugate gradients at the depths of the last evaluation: v v and r v."""
    return made.gradients.gradient(made.here, sum(made.misfits), smoothness)


def image(made, z):
    """E (rows, cols) float32."""
    made.value(z, 0.0)
    return made.backend.download(made.images[0].links[made.here][0])[0].reshape(made.shape)


def upload(made, v):
    return made.backend.upload(np.asarray(v, np.float32).ravel())


def links(made, number=0):
    """Of an image: held (pixels,), and first, second, near, far (count, pixels)."""
    image = made.images[number]
    held, *rest = (made.backend.download(array) for array in image.links[made.here][1:])
    return held, *(array.transpose(1, 0, 2).reshape(image.count, -1)[:, : len(held)] for array in rest)


def push(made, v, number=0):
    """J v of an image, in float64, at the depths of the last evaluation: by its tilts and links."""
    _, own, by_x, by_y = made.backend.download(made.images[number].links[made.here][0]).astype(float)
    held, first, second, near, far = links(made, number)
    v, total = np.asarray(v, float), own * np.ravel(v)
    periodic = made.images[number].sides == SIDES["periodic"]
    for axis, by in ((1, by_x), (0, by_y)):
        if periodic:
            total += by * ((np.roll(v, -1, axis) - np.roll(v, 1, axis)) / 2).ravel()
        elif v.shape[axis] > 1:
            total += by * np.gradient(v, axis=axis).ravel()
    for k in range(int(held.max())):
        some = np.flatnonzero(held > k)
        one, two = first[k, some], second[k, some]
        total[some] += (
            near[k, some].astype(float) * v.ravel()[one] + far[k, some].astype(float) * v.ravel()[two]
        )
    return total.reshape(v.shape)


def derivative(made, number=0):
    """J (pixels, pixels)."""
    return np.stack([push(made, v.reshape(made.shape), number).ravel() for v in np.eye(made.pixels)], 1)


def product(made, v):
    """The sum over images of transpose(J) gain^2 J v, by the kernel."""
    length = float(np.linalg.norm(v))
    made.launcher.launch(
        "start",
        made.gradients.states[0],
        made.gradients.totals[0],
        length**2,
        1.0,
        0.0,
        0.0,
        0.0,
        conjugate_gradients.FIXED,
        conjugate_gradients.EXACT,
        1,
        dim=(1,),
    )
    made.backend.put(made.gradients.v[0], np.asarray(v, np.float32).ravel())
    made.gradients.multiply(made.here, made.gradients.states[0])
    sum = made.backend.download(made.gradients.sum).sum(0).reshape(made.shape)
    made.backend.fill(made.gradients.sum, 0)
    return sum * length / conjugate_gradients.FIXED


# -- float64


def tilts_of(z, sides):
    gx, gy = oracle.gradient(z, 1.0, np.ones(z.shape, bool), sides)
    return gx, gy, np.sqrt(1 + gx**2 + gy**2)


def sky64(z, light, sides):
    """E under a sky of the same azimuths, the horizons by the oracle."""
    angles, widths = np.arctan2(light.directions[:, 1], light.directions[:, 0]), light.directions[:, 2]
    tangent = oracle.horizons(z, 1.0, angles, sides)
    if sides == "periodic":  # what is lower is not looked for
        tangent = np.where(tangent > 0.01, tangent, -np.inf)
    if light.table is None:
        return oracle.sky_irradiance(z, 1.0, np.ones(z.shape, bool), angles, widths, tangent, sides=sides)
    gx, gy, length = tilts_of(z, sides)
    knots, total = np.linspace(0, 1, light.table.shape[1]), 0.0
    for k, angle in enumerate(angles):
        along = gx * math.cos(angle) + gy * math.sin(angle)
        limit = np.maximum(np.maximum(tangent[k], -along), 0)
        by_cosine, by_sine = (
            np.interp(limit / (1 + limit), knots, column) for column in light.table[k, :, :2].astype(float).T
        )
        total = total + widths[k] * (along * by_cosine + by_sine)
    return total / length


def ground64(height, x, y, c, s, reach):
    """Tangent of the horizon along (c, s), every crossing within reach."""
    rows, cols = height.shape
    best = -math.inf
    for lines, own, across, a, b in ((height, y, x, s, c), (height.T, x, y, c, s)):
        if a == 0:
            continue
        step = np.arange(1, len(lines))
        place, line = across + step * b / abs(a), own + step * (1 if a > 0 else -1)
        here = (
            (line >= 0)
            & (line < len(lines))
            & (place >= 0)
            & (place <= lines.shape[1] - 1)
            & (step <= reach * abs(a))
        )
        place, line, distance = place[here], line[here], step[here] / abs(a)
        low = np.minimum(place.astype(int), max(lines.shape[1] - 2, 0))
        up = np.minimum(low + 1, lines.shape[1] - 1)
        rise = lines[line, low] * (1 - (place - low)) + lines[line, up] * (place - low) - height[y, x]
        best = max(best, (rise / distance).max(initial=-math.inf))
    return best


def in_ball(lamp, x, y, own, k, count):
    """A slice by its angles: azimuth, width, elevations of its ends, how far ground counts, how far the
    source goes.
    """
    dx, dy, rise = lamp.center[0] - x, lamp.center[1] - y, -lamp.center[2] - own
    flat, to = math.hypot(dx, dy), math.atan2(dy, dx)
    if flat > lamp.radius:
        theta = math.pi * ((k + 0.5) / count - 0.5)
        off = math.asin(lamp.radius / flat * math.sin(theta))
        along, half = flat * math.cos(off), lamp.radius * math.cos(theta)
        width = math.pi / count * half / flat / math.cos(off)
    else:
        off = 2 * math.pi * (k + 0.5) / count - to
        along, half = flat * math.cos(off), math.sqrt(lamp.radius**2 - (flat * math.sin(off)) ** 2)
        width = 2 * math.pi / count
    if math.hypot(flat, rise) <= lamp.radius:  # inside
        return to + off, width, -math.pi / 2, math.pi / 2, max(along, half), along + half
    middle, spread = math.atan2(rise, along), math.asin(half / math.hypot(along, rise))
    return to + off, width, middle - spread, middle + spread, max(along, half), along + half


def corners_of(source):
    """(4, 3) x, y, height, in turn."""
    if isinstance(source, sl.Window):
        return np.array(
            [(x, y, 0.0) for x, y in zip(np.array(source.x)[[0, 1, 1, 0]], np.array(source.y)[[0, 0, 1, 1]])]
        )
    a, (u, v) = np.array(source.corner), np.array(source.edges)
    return np.array([a, a + u, a + u + v, a + v]) * [1, 1, -1]


def in_quadrangle(corners, x, y, own, k, count):
    to = corners[:, 0] - x + 1j * (corners[:, 1] - y)
    turns = np.imag(np.conj(to) * np.roll(to, -1))
    if (turns >= 0).all() or (turns <= 0).all():
        azimuth, width = 2 * math.pi * (k + 0.5) / count, 2 * math.pi / count
    else:
        off = np.angle(to / to.mean())
        quarter = math.tan((off.max() - off.min()) / 4)
        t = quarter * ((2 * k + 1) / count - 1)
        azimuth = np.angle(to.mean()) + (off.max() + off.min()) / 2 + 2 * math.atan(t)
        width = 4 * quarter / count / (1 + t * t)
    turned = to * np.exp(-1j * azimuth)
    met = []
    for i in range(4):
        a, b = turned[i], turned[(i + 1) % 4]
        if (a.imag <= 0) != (b.imag <= 0):
            share = a.imag / (a.imag - b.imag)
            r = a.real + share * (b.real - a.real)
            if r > 0:
                met.append(
                    (
                        math.atan2(
                            corners[i, 2] + share * (corners[(i + 1) % 4, 2] - corners[i, 2]) - own, r
                        ),
                        r,
                    )
                )
    if not met:
        return azimuth, width, 1.0, 0.0, 0.0, 0.0
    angles, reach = [angle for angle, _ in met], max(r for _, r in met)
    return (
        azimuth,
        width,
        min(angles),
        math.pi / 2 if len(met) == 1 and angles[0] > 0 else max(angles),
        reach,
        reach,
    )


def solid64(z, source, sides, count):
    """E of a ball or quadrangle of brightness 1, node by node and slice by slice, in angles."""
    rows, cols = z.shape
    gx, gy, length = tilts_of(z, sides)
    out = np.zeros(z.shape)
    for y, x in np.ndindex(*z.shape):
        for k in range(count):
            if isinstance(source, sl.Lamp) and source.center:
                azimuth, width, low, high, reach, end = in_ball(source, x, y, -z[y, x], k, count)
            else:
                azimuth, width, low, high, reach, end = in_quadrangle(
                    corners_of(source), x, y, -z[y, x], k, count
                )
            c, s, high = math.cos(azimuth), math.sin(azimuth), min(high, math.pi / 2)
            tilt = gx[y, x] * c + gy[y, x] * s
            wall = min(
                (cols - 0.5 - x if c > 0 else x + 0.5) / abs(c),
                (rows - 0.5 - y if s > 0 else y + 0.5) / abs(s),
            )
            limits = [0.0, -tilt, ground64(-z, x, y, c, s, reach)] + [
                z[y, x] / wall if sides == "dark" and end > wall else 0.0
            ]
            low = max(low, *map(math.atan, limits))
            if low < high:
                by_sine = (math.sin(high) ** 2 - math.sin(low) ** 2) / 2
                by_cosine = (high - low) / 2 + (math.sin(2 * high) - math.sin(2 * low)) / 4
                out[y, x] += width * (by_sine + tilt * by_cosine)
    return out / length


def model64(source, sides, azimuths=8):
    """depths -> E, in float64, with the discretization of the kernels."""
    if isinstance(source, sl.Sky):
        light = light_of(source, SHAPE, azimuths)  # of any shape
        return lambda z: sky64(z, light, sides)
    return lambda z: solid64(z, source, sides, lights.LAMP_SLICES)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sides"), [case for case in CASES if case[0] not in SPOTS])
def test_irradiance_and_its_derivative(fast, monkeypatch, name, sides):
    """E within 1e-5, J v within 3e-4 of finite differences in float64, relative to the maximum.

    The tables are fine: on a tangent plane light does not change with the limit, but between knots it does.
    """
    fine = functools.partial(sl.sources.elevation_table, knots=8192)
    monkeypatch.setattr(sl.sources, "elevation_table", fine)
    z, model, rng = ground(), model64(SOURCES[name], sides), np.random.default_rng(3)
    made = problem(fast, SOURCES[name], sides=sides)
    got, z = image(made, z), z.astype(float)
    wanted = model(z)
    assert wanted.max() > 0.01 and np.ptp(wanted) > 0.05 * wanted.max()
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-5 * wanted.max())
    for v in rng.normal(size=(2, *SHAPE)):
        step = 1e-6
        change = (model(z + step * v) - model(z - step * v)) / (2 * step)
        np.testing.assert_allclose(push(made, v), change, rtol=0, atol=3e-4 * abs(change).max())


@pytest.mark.parametrize(
    "name", ["ball", "ball overhead", "ball in the box", "spot", "window", "lit window", "upright"]
)
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_a_solid_is_the_oracles(fast, monkeypatch, name, sides):
    """With many slices, shadow rays within 1.5 % RMS of the mean that is lit."""
    monkeypatch.setattr(lights, "LAMP_SLICES", 96)
    monkeypatch.setattr(lights, "TABLE_AZIMUTHS", 16)  # so that what is between rows of the table counts
    z, source = ground(), SOURCES[name]
    nodes = tuple(np.random.default_rng(0).permutation(np.indices(SHAPE).reshape(2, -1).T)[:30].T)
    if isinstance(source, sl.Window):
        wanted = oracle.window_irradiance(
            z.astype(float), 1.0, np.ones(SHAPE, bool), source, nodes, 1024, sides=sides
        )
    else:
        lamp = source if source.center else (source.corner, *source.edges, source.brightness)
        wanted = oracle.lamp_irradiance(
            z.astype(float), 1.0, np.ones(SHAPE, bool), lamp, nodes, 1024, sides=sides
        )
    got = image(problem(fast, source, sides=sides), z)[nodes]
    assert wanted.max() > 0
    assert np.sqrt(np.mean((got - wanted) ** 2)) < 0.015 * wanted[wanted > 0].mean()


@pytest.mark.parametrize("shape", [(1, 1), (1, 29), (31, 1), (2, 2), (17, 33)])
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_maps_of_any_shape(fast, shape, sides):
    """One node, one row, one column, sides that are no multiples of a tile: as in float64."""
    z = ground(shape)
    made = problem(fast, sl.Sky(), shape, sides)
    np.testing.assert_allclose(
        image(made, z), model64(sl.Sky(), sides)(z.astype(float)), rtol=0, atol=1e-5 * math.pi
    )


@pytest.fixture(scope="module")
def spikes():
    """Single nodes that stand out beside every edge of the tiles; their light under a sky and a low lamp."""
    shape, rng = (34, 43), np.random.default_rng(2)
    y, x = np.indices(shape)
    z = (
        12
        + ground(shape, 8, 0.05)
        - np.where(
            np.isin(y % 8, (0, 7)) & np.isin(x % 8, (0, 7)) & (rng.random(shape) < 0.3),
            6 * rng.random(shape),
            0,
        )
    )
    z, lamp = z.astype(np.float32), sl.Lamp(center=(47.0, 38.0, 5.0), radius=3.0)
    return (
        z,
        lamp,
        sky64(z.astype(float), light_of(sl.Sky(), shape, 20), "open"),
        solid64(z.astype(float), lamp, "open", 6),
    )


@pytest.mark.slow
def test_spikes_at_the_edges_of_tiles(backend, spikes, monkeypatch):
    """What is left out by the highest ground of tiles never stands above."""
    z, lamp, by_sky, by_lamp = spikes
    monkeypatch.setattr(lights, "LAMP_SLICES", 6)
    np.testing.assert_allclose(
        image(problem(backend, sl.Sky(), z.shape, azimuths=20), z), by_sky, rtol=0, atol=1e-5 * math.pi
    )
    got = image(problem(backend, lamp, z.shape), z)
    assert (by_lamp < 0.5 * np.median(by_lamp)).mean() > 0.02, "the spikes shade nothing"
    np.testing.assert_allclose(got, by_lamp, rtol=0, atol=2e-5 * by_lamp.max())


def test_which_node_limits_a_slice(backend):
    """A level floor at depth 9 with a ridge to 5 along column 6: E's share to each node, how far, and round a
    map that repeats.
    """
    rows, cols, at = 5, 11, 6
    z = np.full((rows, cols), 9.0, np.float32)
    z[:, at] = 5
    light = lights.Light(None, np.array([(1.0, 0, 2, 0), (-1, 0, 2, 0), (0.6, 0.8, 2, 0)]))
    for sides in ("open", "periodic"):
        made = Descent(select(backend), z.shape, sides, [(light, np.ones(z.shape), np.zeros(z.shape))], 0, 99)
        made.value(z, 0.0)
        held, first, second, near, far = links(made)
        wanted = [[] for _ in range(rows * cols)]  # links of every node, where they can be told
        for y, x in np.ndindex(rows, cols):
            for ahead in (at - x, x - at):
                away = ahead % cols if sides == "periodic" else ahead
                if away > 1 and away < cols - 1:  # level beside the ridge is not: there the slope is not 0
                    tangent = 4 / away
                    wanted[y * cols + x].append((y * cols + at, -2 * tangent / (1 + tangent**2) ** 2 / away))
        flat = made.backend.download(made.surface.tilts)[0] == 0
        for p, expected in enumerate(wanted):
            for k, (node, pull) in enumerate(expected if flat[p] else ()):
                assert first[k, p] == node and far[k, p] == 0 and near[k, p] == pytest.approx(-pull, rel=1e-6)

        def slanting(y, x, held=held, first=first):
            return [k for k in range(held[y * cols + x]) if first[k, y * cols + x] // cols != y]

        if sides == "open":
            # 3 columns on the slanting ray has gone 4 rows; from row 1 it meets the last row a quarter of a
            # node before the ridge
            assert not any(slanting(y, 3) for y in range(2, rows)) and all(
                held[y * cols + at] == 0 for y in range(rows)
            )
            (k,), p = slanting(1, 3), cols + 3
            tangent = 1 / 3.75
            pull = -2 * tangent / (1 + tangent**2) ** 2 / 3.75
            assert (first[k, p], second[k, p]) == (4 * cols + at - 1, 4 * cols + at)
            assert (near[k, p], far[k, p]) == (
                pytest.approx(-0.75 * pull, rel=1e-5),
                pytest.approx(-0.25 * pull, rel=1e-5),
            )
        else:
            assert all(slanting(y, 3) for y in range(rows))


def test_an_azimuth_almost_along_the_grid(backend):
    """Is along it: no node of the first column or row looks past the border there."""
    z = ground()

    def lit(c, s):
        light = lights.Light(None, np.array([(c, s, 2 * math.pi, 0)]))
        made = Descent(select(backend), SHAPE, "open", [(light, np.ones(SHAPE), np.zeros(SHAPE))], 0, 99)
        return image(made, z)

    for c, s in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        wanted = lit(c, s)
        assert np.ptp(wanted) > 0.5
        for off in (1e-9, -1e-9, -2e-8):
            np.testing.assert_allclose(lit(c or off, s or off), wanted, rtol=1e-5)


# -- the adjoint


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sides"), [("uniform", "dark"), ("glow", "periodic"), ("spot", "open"), ("window", "dark")]
)
def test_a_product_is_that_of_the_matrices(backend, name, sides):
    """transpose(J) gain^2 J v, for noise and for a mass at a node."""
    rng = np.random.default_rng(5)
    shape, gain = (13, 21), rng.uniform(0.3, 1, (13, 21)).astype(np.float32)
    made = problem(backend, [SOURCES[name]], shape, sides, gain)
    made.value(ground(shape), 0.0)
    J = gain.ravel()[:, None] * derivative(made)
    for v in (rng.normal(size=shape), np.eye(1, 13 * 21, 130).reshape(shape)):
        wanted = (J.T @ (J @ v.ravel())).reshape(shape)
        assert np.linalg.norm(wanted) > 0
        np.testing.assert_allclose(product(made, v), wanted, rtol=0, atol=2e-6 * abs(wanted).max())


@pytest.mark.parametrize("name", ["uniform", "glow", "spot", "upright"])
def test_the_gradient_is_that_of_the_objective(fast, name):
    """By differences of the objective itself, of image and smoothness together: within 1 %."""
    rng, shape, z = np.random.default_rng(7), (12, 15), ground((12, 15), 2).astype(float)
    gain = rng.uniform(0.3, 0.6, shape)
    made = problem(fast, [SOURCES[name], sl.Sky()], shape, "dark", gain, 0.4 + 0.1 * rng.normal(size=shape))
    smooth = resampling.doubled(resampling.doubled(rng.normal(size=(3, 4)), (6, 8)), shape)
    made.value(z, 0.02)
    gradient(made, 0.02)
    downhill = made.backend.download(made.gradients.r[0]).reshape(shape).astype(float)
    for v in (smooth, downhill / abs(downhill).max()):
        step = 2e-3
        slope = (made.value(z + step * v, 0.02) - made.value(z - step * v, 0.02)) / (2 * step)
        assert abs(slope) > 1e-3 and slope == pytest.approx(-(downhill * v).sum(), rel=0.01)


@pytest.mark.parametrize("sides", ["open", "dark", "periodic"])
@pytest.mark.parametrize("name", ["uniform", "glow"])
def test_the_derivative_of_what_ground_sends_is_that_of_the_light(fast, name, sides):
    """By differences of E, on deep relief of uneven radiance; a second image has a source of its own."""
    rng, shape, z = np.random.default_rng(7), (12, 15), ground((12, 15), 2, slope=2.0).astype(float)
    sent = [1 + 0.9 * np.sin(np.arange(180.0)).reshape(shape), rng.uniform(0.2, 1, shape)]
    sky = sl.Sky(lambda L: 1 + L[..., 0] / 2)
    made = problem(fast, [SOURCES[name], sky], shape, sides, azimuths=24, radiances=sent)
    v = resampling.doubled(resampling.doubled(rng.normal(size=(3, 4)), (6, 8)), shape)

    def lights(z):
        made.value(z, 0.0)
        return [
            made.backend.download(i.links[made.here][0])[0].reshape(shape).astype(float) for i in made.images
        ]

    step = 2e-3
    slopes = [(b - a) / (2 * step) for a, b in zip(lights(z - step * v), lights(z + step * v))]
    lights(z)
    for number, slope in enumerate(slopes):
        assert abs(slope).max() > 0.05
        off = np.abs(push(made, v, number).reshape(shape) - slope)
        assert np.quantile(off, 0.9) < 0.01 * abs(slope).max()
        assert np.linalg.norm(off) < 0.05 * np.linalg.norm(slope)


def lit_twice(backend, shape, known=False, seed=7):
    """A surface whose images under a sky and a lamp are those of no albedo, and its images of albedo 1."""
    rng, z = np.random.default_rng(seed), ground(shape, 2)
    gain = rng.uniform(0.3, 0.6, shape).astype(np.float32)
    made = problem(
        backend,
        [SOURCES["uniform"], SOURCES["spot"]],
        shape,
        "dark",
        gain,
        0.4 + 0.1 * rng.normal(size=shape),
        albedo_known=known,
    )
    made.value(z, 0.02)
    return (
        made,
        z,
        [
            gain * made.backend.download(each.links[made.here][0])[0].reshape(shape).astype(float)
            for each in made.images
        ],
    )


def test_the_albedo_is_the_best_there_is(backend):
    """Pixel by pixel the least-squares solution of both images and the prior; so is the objective."""
    made, z, bright = lit_twice(backend, (9, 11))
    pull, expected = 0.3, 0.7
    made.albedo.set_prior(expected, pull)
    value = made.value(z, 0.0)
    targets = [made.backend.download(each.target).reshape(z.shape) for each in made.images]
    columns, rows = [*bright, np.full(z.shape, pull)], [*targets, np.full(z.shape, pull * expected)]
    albedo = np.empty(z.shape)
    for node in np.ndindex(z.shape):
        column, row = [[b[node]] for b in columns], [t[node] for t in rows]
        albedo[node] = np.linalg.lstsq(column, row, rcond=None)[0][0]
    np.testing.assert_allclose(made.fitted_albedo(z), albedo, rtol=1e-5)
    assert np.ptp(albedo) > 0.2
    squares = (
        sum(((albedo * b - t) ** 2).sum() for b, t in zip(bright, targets))
        + ((pull * (albedo - expected)) ** 2).sum()
    )
    assert value == pytest.approx(0.5 * squares, rel=1e-5)
    for got, b in zip(made.irradiances(z), bright):
        np.testing.assert_allclose(got, albedo * b, rtol=1e-5)


def test_a_product_leaves_out_what_the_albedo_makes_up_for(backend):
    """Of the images' change by depth, that part which no change of the pixel's albedo undoes."""
    made, z, bright = lit_twice(backend, (9, 11))
    made.albedo.set_prior(1.0, 0.3)
    albedo = made.fitted_albedo(z).astype(float).ravel()
    bare = [made.backend.download(each.gain).astype(float) for each in made.images]
    J = [(albedo * gain)[:, None] * derivative(made, number) for number, gain in enumerate(bare)]
    under = sum(b.ravel() ** 2 for b in bright) + 0.3**2
    shared = sum(b.ravel()[:, None] * part for b, part in zip(bright, J)) / under[:, None]
    matrix = sum(part.T @ (part - b.ravel()[:, None] * shared) for b, part in zip(bright, J))
    assert np.linalg.norm(matrix - sum(part.T @ part for part in J)) > 0.1 * np.linalg.norm(matrix)
    v = np.random.default_rng(5).normal(size=z.shape)
    wanted = (matrix @ v.ravel()).reshape(z.shape)
    np.testing.assert_allclose(product(made, v), wanted, rtol=0, atol=4e-6 * abs(wanted).max())


def test_the_gradient_with_the_best_albedo_is_that_of_the_objective(fast):
    """By differences of the objective, the albedo found anew for each: within 1 %. Held fast, the albedo of
    another surface has another one.
    """
    made, z, _ = lit_twice(fast, (12, 15))
    gradient(made, 0.02)
    downhill = made.backend.download(made.gradients.r[0]).reshape(z.shape).astype(float)
    v, step = downhill / abs(downhill).max(), 2e-3
    slope = (made.value(z + step * v, 0.02) - made.value(z - step * v, 0.02)) / (2 * step)
    assert abs(slope) > 1e-3 and slope == pytest.approx(-(downhill * v).sum(), rel=0.01)
    fixed, *_ = lit_twice(fast, (12, 15), known=True)
    other = (fixed.value(z + step * v, 0.02) - fixed.value(z - step * v, 0.02)) / (2 * step)
    assert abs(other - slope) > 0.1 * abs(slope)


def second_differences(shape):
    """D (2 pixels, pixels), along rows and along columns, 0 at the ends."""
    one = lambda n: np.array(
        [
            np.eye(n)[i - 1] - 2 * np.eye(n)[i] + np.eye(n)[i + 1] if 0 < i < n - 1 else np.zeros(n)
            for i in range(n)
        ]
    )
    return np.vstack([np.kron(np.eye(shape[0]), one(shape[1])), np.kron(one(shape[0]), np.eye(shape[1]))])


@pytest.mark.parametrize(("name", "sides"), [("uniform", "dark"), ("glow", "periodic"), ("ball", "open")])
def test_a_step_is_that_of_the_dense_matrices(backend, name, sides):
    """Gradient, scale, and conjugate gradients against J column by column, with nodes that a bound holds and
    nodes it lets go.
    """
    shape, rng = (6, 7), np.random.default_rng(11)
    n, weight, damping = 42, 0.03, 0.01
    gain, target, z = (
        rng.uniform(0.3, 0.9, shape).astype(np.float32),
        rng.uniform(0.3, 0.9, shape).astype(np.float32),
        ground(shape, 4),
    )
    low, high = np.where(rng.random(shape) < 0.3, z, 0), np.where(rng.random(shape) < 0.3, z, 99)
    made = problem(backend, SOURCES[name], shape, sides, gain, target, low, high)
    value = made.value(z, weight)
    E = made.backend.download(made.images[0].links[made.here][0])
    J = gain.ravel()[:, None] * derivative(made)
    D, misfit = second_differences(shape), (gain * E[0].reshape(shape) - target).ravel().astype(float)
    assert value == pytest.approx(0.5 * (misfit @ misfit + weight * ((D @ z.ravel()) ** 2).sum()), rel=1e-5)

    gained = made.solve(weight, damping, 400, 1e-7)
    get = lambda array: made.backend.download(array).astype(float)
    down = -(J.T @ misfit + weight * D.T @ (D @ z.ravel().astype(float)))
    held = ((z <= low).ravel() & (down < 0)) | ((z >= high).ravel() & (down > 0))
    free = ~held
    assert 3 < held.sum() < ((z <= low) | (z >= high)).sum() and (get(made.gradients.free[0]) == free).all()
    # the diagonal of transpose(J) J, but for a node's links that lead to the same one
    scale, (E, own, by_x, by_y), (held, first, second, near, far) = (
        np.full(n, 12 * weight + 1e-7),
        E.astype(float),
        links(made),
    )
    y, x = np.indices(shape)
    for p, (i, j) in enumerate(zip(y.ravel(), x.ravel())):
        g = float(gain[i, j])
        parts = [(p, own[p])]
        for by, place, size, step in ((by_x, j, 7, 1), (by_y, i, 6, 7)):
            half = 0.5 if 0 < place < size - 1 or sides == "periodic" else 1
            for neighbour in (place + 1, place - 1):
                if sides == "periodic":
                    neighbour %= size
                else:
                    neighbour = min(max(neighbour, 0), size - 1)
                parts.append((p + step * (neighbour - place), half * by[p]))
        parts += [
            (to[k, p], part[k, p]) for k in range(held[p]) for to, part in ((first, near), (second, far))
        ]
        for to, part in parts:
            scale[to] += (g * float(part)) ** 2
    np.testing.assert_allclose(get(made.gradients.scale[0]), scale, rtol=1e-5)
    matrix = (J.T @ J + weight * D.T @ D + damping * np.diag(scale))[np.ix_(free, free)]
    wanted = np.zeros(n)
    wanted[free] = np.linalg.solve(matrix, down[free])
    np.testing.assert_allclose(get(made.gradients.x), wanted, rtol=0, atol=2e-4 * abs(wanted).max())
    assert gained == pytest.approx(0.5 * down[free] @ wanted[free], rel=1e-3)
    assert abs(get(made.gradients.r[0])).max() < 1e-4 * abs(down).max()

    made.launcher.launch(
        "bounded_step",
        made.backend.upload(z.ravel()),
        made.gradients.x,
        made.depths.low,
        made.depths.high,
        made.depths.z[1],
        made.pixels,
        made.launcher.nodes_per_item,
    )
    np.testing.assert_allclose(
        get(made.depths.z[1]),
        np.clip(z.ravel() + wanted, low.ravel(), high.ravel()),
        atol=3e-4 * abs(wanted).max(),
    )


@pytest.mark.slow
def test_the_posterior_is_that_of_the_dense_hessian(fast):
    """Where the model is linear, J at a surface, the samples have the standard deviation of sigma^2 H^-1, of
    means over neighbours; it is proportional to noise, and no smaller where a second image is left out.
    """
    shape, weight, sigma = (7, 8), 0.03, 0.02
    z = ground(shape, 4)
    both = [SOURCES["glow"], SOURCES["ball overhead"]]
    made = problem(fast, both, shape, "dark", 0.7)
    made.value(z, 0.0)
    D = second_differences(shape)
    J = 0.7 * np.concatenate([derivative(made, number) for number in (0, 1)])
    hessian = J.T @ J + weight * D.T @ D
    wanted = np.sqrt(resampling.blurred(np.diag(sigma**2 * np.linalg.inv(hessian)).reshape(shape)))
    found = posterior_deviation(made, z, weight, sigma, probes=400)
    np.testing.assert_allclose(found, wanted, rtol=0.12)
    assert np.mean(found / wanted) == pytest.approx(1, abs=0.03)
    again = posterior_deviation(made, z, weight, 2 * sigma, probes=20)
    once = posterior_deviation(made, z, weight, sigma, probes=20)
    np.testing.assert_allclose(again, 2 * once, rtol=1e-2)  # as close as conjugate gradients go
    alone = posterior_deviation(problem(fast, both[0], shape, "dark", 0.7), z, weight, sigma, probes=400)
    assert np.mean(alone) > 1.03 * np.mean(found)


def test_a_sample_of_the_prior_has_its_covariance():
    """Second differences of a sample, over many, are those of the pseudo-inverse of D^T D."""
    shape = (5, 4)
    samples = [prior_sample(unit.reshape(shape)).ravel() for unit in np.eye(20)]
    D = second_differences(shape)
    np.testing.assert_allclose(np.stack(samples, 1) @ np.stack(samples), np.linalg.pinv(D.T @ D), atol=1e-10)


def hats(n):
    """(n, coarse) linear interpolation from a line of nodes four times as coarse, whose first lies at node
    1.5, level beyond its ends.
    """
    coarse = -(-n // 4)
    return np.stack(
        [np.interp(np.arange(n), 4 * np.arange(coarse) + 1.5, unit) for unit in np.eye(coarse)], 1
    )


@pytest.mark.parametrize("shape", [(6, 7), (16, 37), (1, 21)])
def test_what_preconditions_is_that_of_dense_matrices(backend, shape):
    """v = free (r / scale + P (P^T r / S + P' (P'^T P^T r / S'))), P interpolation, S of grids 4 and 16 times
    as coarse.
    """
    z, rng = ground(shape, 4), np.random.default_rng(2)
    held = rng.random(shape) < 0.2
    made = problem(
        backend, sl.Sky(), shape, "dark", 0.5, np.where(held, 2, 0), np.where(held, z, 0), 99
    )  # too dark: it would go up
    made.value(z, 0.03)
    square, along = gradient(made, 0.03)
    get = lambda array: made.backend.download(array).astype(float)
    once = np.kron(hats(shape[0]), hats(shape[1]))
    twice = np.kron(hats(-(-shape[0] // 4)), hats(-(-shape[1] // 4)))
    r, scale, free = get(made.gradients.r[0]), get(made.gradients.scale[0]), get(made.gradients.free[0])
    broad = conjugate_gradients.BROAD * once.T @ scale
    broader = conjugate_gradients.BROADER * twice.T @ broad
    np.testing.assert_allclose(get(made.gradients.scale[1]), broad, rtol=1e-5)
    np.testing.assert_allclose(get(made.gradients.scale[2]), broader, rtol=1e-5)
    low = once.T @ r
    wanted = free * (r / scale + once @ (low / broad + twice @ (twice.T @ low / broader)))
    assert (free == 0).any() and (wanted != 0).any()
    np.testing.assert_allclose(get(made.gradients.v[0]), wanted, rtol=0, atol=1e-5 * abs(wanted).max())
    assert (square, along) == (pytest.approx(wanted @ wanted, rel=1e-4), pytest.approx(r @ wanted, rel=1e-4))


def test_coarse_grids_make_conjugate_gradients_quick(fast, monkeypatch):
    """Where a broad part of a surface is wrong, ten iterations leave less than a fifth of what is left
    without coarse grids.
    """
    shape, gains = (48, 48), []
    z = ground(shape, 6, 0.5)
    target = problem(fast, sl.Sky(), shape, "dark", 0.3).irradiances(z)[0]
    for broad, most in ((conjugate_gradients.BROAD, 10), (1e20, 10), (conjugate_gradients.BROAD, 400)):
        monkeypatch.setattr(conjugate_gradients, "BROAD", broad)
        made = problem(fast, sl.Sky(), shape, "dark", 0.3, target)
        made.value(z + 2 * np.hanning(48) * np.hanning(48)[:, None], 1e-4)
        gains.append(made.solve(1e-4, 1e-6, most, 1e-6))
    assert 0 < gains[2] - gains[0] < 0.2 * (gains[2] - gains[1])


def test_descent_finds_the_surface(fast):
    """From a blurred start to the surface whose image it is; the objective returned is the one there."""
    shape = (16, 16)
    z = ground(shape, 6, 0.5)
    rng = np.random.default_rng(1)
    start = z + 0.3 * resampling.doubled(resampling.doubled(rng.normal(size=(4, 4)), (8, 8)), shape)
    made = problem(fast, sl.Sky(), shape, "dark", 1 / math.pi, azimuths=16)
    target = made.irradiances(z)[0]
    made.set_targets([target])
    assert made.value(z, 0.0) < 1e-9
    before = made.value(start, 1e-6)
    found, value = made.run(start, 1e-6, 30, 60, tolerance=0.01, converged=1e-5)
    assert value < 1e-3 * before and value == made.value(found, 1e-6)
    assert np.sqrt(np.mean((found - z) ** 2)) < 0.1 * np.sqrt(np.mean((start - z) ** 2))


def test_what_is_at_hand_is_not_looked_at_again(fast, monkeypatch):
    """Depths that were just evaluated cost no rays, with whatever target and rest; others do, and so does a
    surface that was left since.
    """
    depth, other, looks = ground(), ground(seed=1), []
    made, target = problem(fast, sl.Sky(), low=0.5), 0.3 * np.ones(SHAPE)
    engine, before = made.backend, made.backend.launch
    monkeypatch.setattr(
        engine, "record", lambda work, times=1: lambda: [work() for _ in range(times)]
    )  # launches shall be seen
    monkeypatch.setattr(
        engine,
        "launch",
        lambda stem, kernel, *args, **more: (looks.append(kernel), before(stem, kernel, *args, **more))[1],
    )
    looked = lambda: [looks.count("horizons"), looks.clear()][0]
    first = made.value(depth, 1e-3)
    assert looked() == 1 and made.value(depth, 1e-3) == first and looked() == 0
    made.set_targets([target])
    made.set_prior(other)
    anew = problem(fast, sl.Sky(), low=0.5, target=target)
    anew.set_prior(other)
    assert looked() == 0 and made.value(depth, 1e-3) == anew.value(depth, 1e-3) != first and looked() == 1
    found, reached = made.run(depth, 1e-3, 3, 20, 0.1)
    steps = made.steps
    assert looked() == steps and made.value(found, 1e-3) == reached and looked() == 0
    found += 1  # the caller's own
    assert made.value(found, 1e-3) == anew.value(found, 1e-3) != reached and looked() == 2
    assert made.value(depth, 1e-3) == anew.value(depth, 1e-3) and looked() == 2


def test_bounds_hold_and_the_objective_never_rises(fast):
    """Whatever the image asks for, depth stays between its bounds, and more steps are no worse."""
    shape, low = (17, 21), 6.0
    high = np.where(np.arange(21) < 9, 9.0, 30.0) * np.ones((17, 1))
    made, values = problem(fast, sl.Sky(), shape, "dark", 0.3, 0.1, low, high, 16), []
    for steps in (1, 4, 12):
        z, value = made.run(np.full(shape, 8.0), 1e-4, steps, 20, converged=0)
        values.append(value)
        assert z.min() >= low and (z <= high.astype(np.float32)).all()
    assert values[0] > values[1] >= values[2] and (z[:, :9] == 9).any()


# -- backends


def everything(made, z):
    """What an evaluation and a step leave on the device, only what is defined; adding 0 makes -0 a 0."""
    value = made.value(z, 1e-3)
    get = made.backend.download
    held, *rest = links(made)
    seen = [
        get(made.images[0].links[made.here][0]) + 0,
        held,
        *(np.where(np.arange(len(array))[:, None] < held, array, 0) + 0 for array in rest),
    ]
    gained, solver = made.solve(1e-3, 1e-3, 8, 1e-3), made.gradients
    return [
        *seen,
        *(get(array) + 0 for array in (*solver.scale, *solver.free, solver.x, *solver.r, *solver.v)),
        np.array([value, gained]),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sides"), CASES)
def test_backends_agree_to_the_bit_and_repeat_themselves(backend, fast, name, sides):
    """Image, derivatives, crossings, and eight conjugate gradients with their scattered sums."""
    z, other = ground((13, 21), 1), ground((13, 21), 9)
    made, reference = (problem(each, SOURCES[name], (13, 21), sides, 0.3, 0.4) for each in (backend, fast))
    wanted = everything(reference, z)
    got = everything(made, z)
    assert got[1].max() > got[1].min() and abs(made.backend.download(made.gradients.x)).max() > 1e-3
    for a, b in zip(got, wanted, strict=True):
        assert_bits_equal(a, b)
    everything(made, other)
    for a, b in zip(everything(made, z), wanted, strict=True):
        assert_bits_equal(a, b)


@pytest.mark.slow
def test_descents_agree_to_the_bit(backend, fast):
    """Three whole steps under a sky and a lamp together, with a known and an unknown albedo."""
    shape = (16, 19)
    start, target = ground(shape, 3, 0.4), 0.3 + 0.1 * ground(shape, 5, 0.1)
    for known in (True, False):
        both = [sl.Sky(), SOURCES["spot"]]
        (found, value), (wanted, other) = (
            problem(each, both, shape, "open", 0.3, target, albedo_known=known).run(start, 1e-2, 3, 10)
            for each in (backend, fast)
        )
        assert value == other and np.ptp(found - start) > 0.1
        assert_bits_equal(found, wanted)


def test_one_kernel_solves_as_many_do(fast, monkeypatch):
    """A step of conjugate gradients by one work-item, and by launches for every part of it, also when they go
    on after the end: the same bits.
    """
    shape, found = (33, 35), []
    start, target = ground(shape, 3, 0.4), 0.3 + 0.1 * ground(shape, 5, 0.1)
    for alone, ahead in ((0, 1), (0, 7), (2**30, 1)):
        made = problem(fast, sl.Sky(), shape, "dark", 0.3, target)
        monkeypatch.setattr(made.backend, "single_item_links", alone, raising=False)
        monkeypatch.setattr(made.backend, "iterations_ahead", ahead, raising=False)
        found.append(made.run(start, 1e-3, 3, 41, 1e-3))
    for z, value in found[1:]:
        assert value == found[0][1] and np.ptp(z - start) > 0.1
        assert_bits_equal(z, found[0][0])


def test_more_work_items_than_nodes(fast, monkeypatch):
    """A GPU's groups reach beyond the map; nothing is written there. Groups of 64 on any device."""
    made = problem(fast, sl.Sky(brightness=glow), (13, 21), "periodic", 0.3, 0.4)
    if not made.backend.name.startswith("opencl"):
        pytest.skip("only OpenCL rounds up")
    z = ground((13, 21), 1)
    wanted = everything(made, z)
    launch = type(made.backend).launch
    monkeypatch.setattr(
        type(made.backend),
        "launch",
        lambda self, *args, group=None, **more: launch(self, *args, group=64, **more),
    )
    for got, expected in zip(everything(made, z), wanted, strict=True):
        assert_bits_equal(got, expected)
    # sums of blocks end where their array ends
    part, blocks = made.backend.upload(np.full(200, 7.0)), made.launcher.blocks
    depths = made.backend.upload(z.ravel()), made.depths.rest
    made.launcher.launch("bending", *depths, part, 0, 13, 21, dim=(blocks,))
    assert (made.backend.download(part)[blocks:] == 7).all() and made.backend.download(part)[0] != 7


def test_a_map_with_too_many_links(backend):
    """More than 2^31 links are a CapacityError."""
    light = lights.Light(None, np.zeros((2**22, 4), np.float32))
    with pytest.raises(CapacityError, match="links"):
        Descent(select(backend), (16, 32), "open", [(light, np.ones((16, 32)), np.ones((16, 32)))], 0, 1)


# -- Warp's tape, where it is right: no loop that changes what it reads


def _taped():
    import warp as wp

    from skylamp.warp_kernels import adjoint as kernels

    @wp.kernel
    def of_slope(
        t: wp.array[wp.float32],
        table: wp.array[wp.float32],
        row: wp.int32,
        share: wp.float32,
        knots: wp.int32,
        c1: wp.array[wp.float32],
        c2: wp.array[wp.float32],
        found: wp.array2d[wp.float32],
    ):
        i = wp.tid()
        lit = kernels.above(t[i], table, row, row + 1, share, knots)
        c1[i] = lit[0]
        c2[i] = lit[1]
        found[i, 0] = lit[2]
        found[i, 1] = lit[3]

    @wp.kernel
    def of_nodes(
        heights: wp.array2d[wp.float32],
        share: wp.float32,
        closeness: wp.float32,
        tilt: wp.float32,
        width: wp.float32,
        table: wp.array[wp.float32],
        out: wp.array[wp.float32],
        pulls: wp.array[wp.float32],
    ):
        i = wp.tid()
        own = heights[i, 0]
        a = heights[i, 1]
        b = heights[i, 2]
        lit = kernels.above((a + share * (b - a) - own) * closeness, table, 0, 0, 0.0, 0)
        out[i] = width * (lit[0] + tilt * lit[1])
        pulls[i] = width * (lit[2] + tilt * lit[3]) * closeness

    return wp, of_slope, of_nodes


@pytest.fixture(scope="module")
def taped():
    return _taped()


@pytest.mark.parametrize("knots", [0, 64])
def test_light_above_a_slope_has_the_derivative_of_the_tape(taped, knots):
    """c1 and c2 by their slope: in closed form, and from two rows of a table."""
    wp, of_slope, _ = taped
    slopes = np.array([0.003, 0.2, 0.71, 0.99, 1.01, 2.5, 9.0, 80.0], np.float32)
    angles = np.array([0.3, 1.1])
    table = (
        np.zeros((1, 4))
        if knots == 0
        else importlib.import_module("skylamp.sources").elevation_table(
            sl.Sky(brightness=glow), angles, 0 * angles, 64, knots
        )
    )
    put = lambda array, grad=False: wp.array(np.asarray(array, np.float32), device="cpu", requires_grad=grad)
    found = put(np.zeros((8, 2)))
    for column in range(2):
        t, c1, c2 = (put(v, True) for v in (slopes, 0 * slopes, 0 * slopes))
        tape = wp.Tape()
        with tape:
            wp.launch(
                of_slope, dim=8, inputs=[t, put(np.ravel(table)), 0, 0.4, knots, c1, c2, found], device="cpu"
            )
        tape.backward(grads={(c1, c2)[column]: put(np.ones(8))})
        assert (abs(t.grad.numpy()[:6]) > 1e-3).all()
        np.testing.assert_allclose(found.numpy()[:, column], t.grad.numpy(), rtol=2e-4, atol=2e-6)
    # and the integrals are those of the sky: from each slope to the zenith
    e = (
        np.arctan(slopes.astype(float))[:, None]
        + (np.pi / 2 - np.arctan(slopes.astype(float)))[:, None] * (np.arange(4000) + 0.5) / 4000
    )
    light = 1.0
    if knots:
        ways = [
            glow(np.stack([np.cos(e) * math.cos(a), np.cos(e) * math.sin(a), -np.sin(e)], -1)) for a in angles
        ]
        light = ways[0] + 0.4 * (ways[1] - ways[0])
    step = np.pi / 2 - np.arctan(slopes.astype(float))
    np.testing.assert_allclose(c1.numpy(), (light * np.sin(e) * np.cos(e)).mean(1) * step, rtol=0, atol=1e-4)
    np.testing.assert_allclose(
        c2.numpy(), (light * np.cos(e) ** 2).mean(1) * step, rtol=0, atol=5e-4
    )  # knots are far apart near the zenith


def test_the_pull_of_a_crossing_is_that_of_the_tape(taped):
    """A link's parts of a pull: -1 to the node's own height, 1 - share and share to the crossing's nodes."""
    wp, _, of_nodes = taped
    share, closeness, tilt, width = 0.3, 0.25, -0.2, 0.7
    heights = wp.array(
        np.array([[-9, -5, -6.5], [-9, -8.6, -8], [-3, 2, 90]], np.float32), device="cpu", requires_grad=True
    )
    out, pulls = (wp.zeros(3, dtype=wp.float32, device="cpu", requires_grad=True) for _ in range(2))
    tape = wp.Tape()
    with tape:
        wp.launch(
            of_nodes,
            dim=3,
            inputs=[
                heights,
                share,
                closeness,
                tilt,
                width,
                wp.zeros(4, dtype=wp.float32, device="cpu"),
                out,
                pulls,
            ],
            device="cpu",
        )
    tape.backward(grads={out: wp.array(np.ones(3, np.float32), device="cpu")})
    pull = pulls.numpy()
    assert (pull < 0).sum() >= 2
    np.testing.assert_allclose(
        heights.grad.numpy(), pull[:, None] * [-1, 1 - share, share], rtol=1e-3, atol=1e-7
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["uniform", "sun"])
def test_ground_as_bright_as_the_sky_tells_nothing_of_depth(backend, name):
    """Radiance 1 all round: E is what the source adds to a sky of 1, and that of a uniform sky has no
    derivative.
    """
    source, z = SKIES[name], ground(slope=2.0)
    alone = problem(backend, source, sides="periodic", azimuths=24)
    made = problem(backend, source, sides="periodic", azimuths=24, radiances=[np.ones(SHAPE)])
    sky = problem(backend, sl.Sky(), sides="periodic", azimuths=24)
    np.testing.assert_allclose(image(made, z), image(alone, z) + math.pi - image(sky, z), rtol=2e-6)
    v = np.random.default_rng(4).normal(size=SHAPE)
    difference = push(made, v) - push(alone, v) + push(sky, v)
    assert np.abs(difference).max() < 1e-5 * max(1, np.abs(push(sky, v)).max())


@pytest.mark.slow
def test_ground_is_seen_alike_on_all_backends(backend):
    """Two images, one of a lamp: light and derivatives against the NumPy kernels."""
    z, sent = ground(slope=1.5), [1 + np.sin(np.arange(99)).reshape(SHAPE), np.full(SHAPE, 0.3)]
    sources = [SKIES["glow"], SOLIDS["ball"]]
    made, expected = (problem(name, sources, sides="dark", radiances=sent) for name in (backend, "numpy"))
    v = np.random.default_rng(4).normal(size=SHAPE)
    image(made, z), image(expected, z)
    for number in range(2):
        lights = [each.backend.download(each.images[number].links[each.here][0]) for each in (made, expected)]
        np.testing.assert_allclose(*lights, atol=2e-5)
        np.testing.assert_allclose(push(made, v, number), push(expected, v, number), atol=2e-5)
