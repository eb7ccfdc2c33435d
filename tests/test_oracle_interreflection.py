"""The oracle's light between surfaces against closed forms and cases worked out by hand.

Nothing here runs a backend.
"""

import math

import numpy as np
import pytest
from scenes import rough

from skylamp import oracle


def circle(count):
    return 2 * np.pi * (np.arange(count) + 0.5) / count


def everywhere(depth):
    return np.ones(np.shape(depth), bool)


def strips(depth, count=32, sides="open", spacing=1.0, nodes=None):
    depth = np.asarray(depth, float)
    return oracle.strips(depth, spacing, everywhere(depth), circle(count), sides, nodes)


def seen(along, up, low, high):
    """Integral of N.L over elevations between two slopes, per radian of azimuth, by quadrature."""
    e, w = np.polynomial.legendre.leggauss(40)
    a, b = math.atan(low), math.atan(high)
    e = (a + b) / 2 + (b - a) / 2 * e
    return float((w * (along * np.cos(e) + up * np.sin(e)) * np.cos(e)).sum() * (b - a) / 2)


@pytest.mark.parametrize("angle, bound", [pytest.param(60, 0.003, marks=pytest.mark.slow), (40, 0.001)])
def test_bowl(angle, bound):
    """In a spherical bowl every node sees the same ground: E = E_d / (1 - albedo (1 - f))."""
    size, rim = 48, 22
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    r, a = np.hypot(x, y), math.radians(angle)
    radius = rim / math.sin(a)
    depth = np.where(r < rim, np.sqrt(np.maximum(radius**2 - r * r, 0)) - radius * math.cos(a), 0.0)
    shares, sky = strips(depth)
    total = oracle.interreflection(np.pi * sky, np.full(size * size, 0.8), shares)[(r < rim - 2).ravel()]
    f = (1 + math.cos(a)) / 2
    assert total.mean() == pytest.approx(np.pi * f / (1 - 0.8 * (1 - f)), rel=bound)
    assert total.std() < 0.015 * total.mean()
    alone = np.pi * f  # what the direct light would be: the test can fail
    assert abs(total.mean() / alone - 1) > 0.07


@pytest.mark.slow
def test_white_furnace():
    """Albedo 1 on a map that repeats: E = pi everywhere, whatever the ground."""
    shares, sky = strips(rough(12, 16, 1.0), 16, "periodic")
    assert sky.min() < 0.8
    np.testing.assert_allclose(shares.sum(1) + sky, 1, rtol=1e-12)
    total = oracle.interreflection(np.pi * sky, np.ones(12 * 16), shares)
    np.testing.assert_allclose(total, np.pi, rtol=1e-7)


@pytest.mark.parametrize("sides", ["open", "dark"])
def test_nothing_comes_from_nowhere(sides):
    """Ground, sky and what is black make 1 at most; a level plane sees the sky alone, or the walls too."""
    shares, sky = strips(rough(14, 11, 1.2), 16, sides)
    assert (shares >= 0).all() and (shares.sum(1) + sky).max() <= 1 + 1e-6  # a plane's by 16 azimuths
    shares, sky = strips(np.full((5, 7), 3.0), 16, sides)
    assert not shares.any()
    np.testing.assert_allclose(sky, 1, rtol=1e-12) if sides == "open" else np.testing.assert_array_less(
        sky, 0.7
    )


@pytest.mark.slow
def test_facing_walls():
    """Two endless walls that meet in a groove: the view factor of parallel strips, weighted by brightness.

    A strip that is endless along y and lies between angles a and b from the normal, in the plane across, has
    the view factor (sin b - sin a) / 2.
    """
    half, slope, rows = 12, 1.2, 301
    x = np.arange(2 * half + 1) - half
    depth = np.repeat(slope * (half - np.abs(x))[None].astype(float), rows, 0)
    for own in (-9, -6, -3):
        shares, _ = strips(depth, 256, nodes=([rows // 2], [own + half]))
        for name, light in (("even", np.ones(2 * half + 1)), ("brighter above", np.abs(x) / half)):
            at = np.linspace(0, half, 20001)  # along the wall that faces
            to = np.stack([at - own, slope * (at + own)])  # own < 0 is at height -slope own
            normal = np.array([slope, 1]) / math.hypot(slope, 1)
            sine = (normal[0] * to[1] - normal[1] * to[0]) / np.hypot(*to)
            bright = np.interp(at, x, light)
            exact = abs(np.sum(np.diff(sine) * (bright[1:] + bright[:-1]) / 2)) / 2
            found = float(shares[0] @ np.repeat(light[None], rows, 0).ravel())
            assert found == pytest.approx(exact, rel=5e-3), (own, name)


def test_stretches_by_hand():
    """Heights 0, 1, 3, 6 in a row: each strip's light is the mean at its two ends."""
    shares, sky = oracle.strips(
        np.array([[6.0, 5, 3, 0]]), 1.0, np.ones((1, 4), bool), [0.0], nodes=([0], [0])
    )
    n = 1 / math.sqrt(2)  # the tangent plane rises by 1: one-sided at the border
    # the tangent plane meets the second stretch at node 1; the line of sight over node 2, of slope 1.5, meets
    # the third stretch at node 2
    second, third = 2 * seen(-n, n, 1, 1.5), 2 * seen(-n, n, 1.5, 2)
    np.testing.assert_allclose(shares[0], [0, second / 2, second / 2 + third / 2, third / 2], atol=1e-12)
    assert sky[0] == pytest.approx(2 * seen(-n, n, 2, 1e9), rel=1e-9)


def test_a_cliff_by_hand():
    """At the foot of a cliff 4 high the first strip has the mean of foot and top."""
    depth = np.array([[4.0, 4, 0, 0]])
    shares, _ = oracle.strips(depth, 1.0, np.ones((1, 4), bool), [0.0], nodes=([0, 0], [1, 0]))
    along, up = -2 / math.sqrt(5), 1 / math.sqrt(5)  # central differences: it rises by 2
    first = 2 * seen(along, up, 2, 4)
    np.testing.assert_allclose(shares[0], [0, first / 2, first / 2, 0], atol=1e-12)
    # from the level ground before it: slope 2 at the top, and the line of sight of slope 0 meets its foot
    first = 2 * seen(0, 1, 0, 2)
    np.testing.assert_allclose(shares[1], [0, first / 2, first / 2, 0], atol=1e-12)


def test_hidden_ground_sends_nothing():
    """Of ground behind a ridge only what stands above the line of sight over the ridge is seen."""
    depth = np.array([[9.0, 9, 7, 9, 9, 1]])  # heights 0, 0, 2, 0, 0, 8
    shares, _ = oracle.strips(depth, 1.0, np.ones((1, 6), bool), [0.0], nodes=([0], [0]))
    first, last = 2 * seen(0, 1, 0, 1), 2 * seen(0, 1, 1, 1.6)
    past = 4 / 7  # slope 1 meets the last stretch, from height 0 at 4 to 8 at 5: 8 t = 4 + t
    near = (1 - past) / 2
    np.testing.assert_allclose(
        shares[0], [0, first / 2, first / 2, 0, last * near, last * (1 - near)], atol=1e-12
    )


def test_masked_ground_is_bottomless():
    """Behind a masked node the strip begins with the crossing's own light; the masked node sends none."""
    valid = np.array([[True, False, True]])
    shares, _ = oracle.strips(np.array([[5.0, 0, 1]]), 1.0, valid, [0.0], nodes=([0], [0]))
    np.testing.assert_allclose(shares[0], [0, 0, 2 * seen(0, 1, 0, 2)], atol=1e-12)


def test_spacing_scales_nothing():
    """Lengths in another unit: the same shares."""
    depth = rough(9, 8, 1.0)
    for one, other in zip(strips(depth, 8), strips(4 * depth, 8, spacing=4.0)):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-15)
