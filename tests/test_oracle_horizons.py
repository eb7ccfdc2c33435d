"""The oracle's horizons and shadow rays against closed forms and cases worked out by hand.

Nothing here runs a backend.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
from compare import assert_bits_equal
from scenes import rough

import skylamp as sl
from skylamp import oracle
from skylamp.radiometry import disc_moment, polygon_moment, rectangle_solid_angle

UP = np.array([0.0, 0.0, -1.0])


def circle(count):
    """Azimuths and their widths."""
    return 2 * np.pi * (np.arange(count) + 0.5) / count, np.full(count, 2 * np.pi / count)


def everywhere(depth):
    return np.ones(np.shape(depth), bool)


def sky(depth, spacing=1.0, count=64, brightness=None, nodes=None, **options):
    azimuths, widths = circle(count)
    valid = np.isfinite(depth)
    return oracle.sky_irradiance(
        depth,
        spacing,
        valid,
        azimuths,
        widths,
        oracle.horizons(depth, spacing, azimuths, nodes=nodes, **options),
        brightness,
        nodes,
        options.get("sides", "open"),
    )


def slope(depth, x, y, azimuth, spacing=1.0, **options):
    """The horizon of one node."""
    return float(
        oracle.horizons(np.asarray(depth, float), spacing, [azimuth], nodes=([y], [x]), **options)[0, 0]
    )


def spiked(shape=(17, 21), at=(8, 10), floor=5.0, top=2.0):
    """A level floor with one node at ``at`` = (row, col) that is nearer to the viewer."""
    depth = np.full(shape, floor)
    depth[at] = top
    return depth


# -- horizons: by hand ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", [1.0, 0.25])
@pytest.mark.parametrize(
    "dx, dy", [(1, 0), (-4, 0), (0, 3), (0, -1), (5, 5), (-3, 3), (3, 1), (-2, -5), (7, -2), (-9, 4)]
)
def test_a_spike_seen_exactly(dx, dy, spacing):
    """3 high: 3 / distance, whatever the azimuth's rounding; a degree off, less; behind, the level floor."""
    depth = spiked()
    x, y, towards = 10 - dx, 8 - dy, math.atan2(dy, dx)
    exact = 3 / (math.hypot(dx, dy) * spacing)
    for turn in (-2 * math.pi, 0, 2 * math.pi):
        assert slope(depth, x, y, towards + turn, spacing) == pytest.approx(exact, rel=1e-12)
    for off in (-0.017, 0.017):
        assert 0 < slope(depth, x, y, towards + off, spacing) < exact
    assert slope(depth, x, y, towards + math.pi, spacing) == 0


def test_crossings_between_the_spike_and_its_neighbours():
    """Heights fall from 3 to 0 over one node along rows and columns: the crossings of a ray, by hand."""
    depth = spiked()
    # from 2 columns west: the spike's column is crossed at dy = 1/2, no row before
    assert slope(depth, 8, 8, math.atan2(0.5, 2)) == pytest.approx(1.5 / math.hypot(2, 0.5), rel=1e-12)
    # from 4 rows south of it and 1 west: the spike's row is crossed 3/4 of a node west of it
    assert slope(depth, 9, 12, math.atan2(-4, 0.25)) == pytest.approx(0.75 / math.hypot(4, 0.25), rel=1e-12)
    # past it on the diagonal's side: the row of the spike at dx = 4.5, its column at dy = -3.6, off the
    # spike's edges
    assert slope(depth, 5, 12, math.atan2(-4, 4.5)) == pytest.approx(1.5 / math.hypot(4, 4.5), rel=1e-12)
    # a node nearer meets two edges: column 1 at dy = 1/3 (height 2), then row 1 at dx = 3 (0)
    assert slope(depth, 9, 8, math.atan2(1, 3)) == pytest.approx(2 / math.hypot(1, 1 / 3), rel=1e-12)
    # diagonally out of the neighbour to the south, up the ridge between them: nothing but nodes
    assert slope(depth, 10, 9, math.atan2(-1, 1)) == 0


def _horizon_by_hand(depth, x, y, i, j, laps=0):
    """Steepest crossing along (i, j) in fractions; None: masked. ``laps`` > 0: the map repeats."""
    rows, cols = len(depth), len(depth[0])
    reach = laps * max(rows, cols) if laps else max(rows, cols)
    times = {Fraction(s, abs(n)) for n in (i, j) if n for s in range(1, reach * abs(n) + 1)}
    best = -math.inf
    for t in sorted(times):
        px, py = x + t * i, y + t * j
        c, r = math.floor(px), math.floor(py)
        c2, r2 = c + (px != c), r + (py != r)
        assert c == c2 or r == r2
        if laps:
            c, r, c2, r2 = c % cols, r % rows, c2 % cols, r2 % rows
        if min(c, r) < 0 or c2 >= cols or r2 >= rows or depth[r][c] is None or depth[r2][c2] is None:
            continue
        part = (px - math.floor(px)) + (py - math.floor(py))
        ground = (1 - part) * depth[r][c] + part * depth[r2][c2]
        best = max(best, float((depth[y][x] - ground) / t) / math.hypot(i, j))
    return best


DIRECTIONS = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if math.gcd(i, j) == 1] + [
    (7, 2),
    (-5, 8),
    (1, -11),
]


@pytest.mark.slow
@pytest.mark.parametrize("masked", [False, True])
def test_horizons_look_at_every_crossing(masked):
    """Against exact fractions, on a map wider than tall; through nodes beside masked ones too."""
    rng = np.random.default_rng(4)
    whole = rng.integers(0, 9, (7, 12))
    gone = masked & (rng.random(whole.shape) < 0.25)
    rows = [[None if gone[y, x] else int(whole[y, x]) for x in range(12)] for y in range(7)]
    depth = np.where(gone, np.inf, whole)
    got = oracle.horizons(depth, 0.5, [math.atan2(j, i) for i, j in DIRECTIONS])
    expected = np.array(
        [
            [
                [np.nan if gone[y, x] else _horizon_by_hand(rows, x, y, i, j) / 0.5 for x in range(12)]
                for y in range(7)
            ]
            for i, j in DIRECTIONS
        ]
    )
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)
    assert (got > 0).any() and (got[np.isfinite(got)] < 0).any() and np.isneginf(got).any()
    np.testing.assert_array_equal(
        oracle.horizons(np.where(gone, np.nan, whole), 0.5, [math.atan2(j, i) for i, j in DIRECTIONS]), got
    )


@pytest.mark.slow
def test_horizons_of_a_map_that_repeats_look_at_every_crossing():
    """Over four laps, in fractions: 32 nodes at least, from where on a relief of 4 can only rise 1/8."""
    whole = np.random.default_rng(5).integers(0, 5, (5, 8))
    got = oracle.horizons(whole, 1.0, [math.atan2(j, i) for i, j in DIRECTIONS[::2]], "periodic")
    near = np.array(
        [
            [[_horizon_by_hand(whole.tolist(), x, y, i, j, 4) for x in range(8)] for y in range(5)]
            for i, j in DIRECTIONS[::2]
        ]
    )
    assert ((near - 1e-12 <= got) & (got <= np.maximum(near, 1 / 8) + 1e-12)).all()
    np.testing.assert_allclose(got[near > 1 / 8], near[near > 1 / 8], rtol=1e-12)
    assert (near > 1 / 8).mean() > 0.5


@pytest.mark.parametrize("turns", range(8))
def test_along_axes_and_diagonals(turns):
    """Rays along them meet only nodes: a walk from node to node finds the same, beside masked ones too."""
    depth = np.random.default_rng(7).random((9, 9)) * 6
    i, j = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)][turns]
    walk = np.full(depth.shape, -np.inf)
    for y in range(9):
        for x in range(9):
            for t in range(1, 9):
                if 0 <= x + t * i < 9 and 0 <= y + t * j < 9:
                    walk[y, x] = max(
                        walk[y, x], (depth[y, x] - depth[y + t * j, x + t * i]) / (t * math.hypot(i, j))
                    )
    for azimuth in (turns * math.pi / 4, (turns - 8) * math.pi / 4, (turns + 16) * math.pi / 4):
        np.testing.assert_allclose(oracle.horizons(depth, 1.0, [azimuth])[0], walk, rtol=1e-12, atol=1e-12)
    alone = np.full((9, 9), np.nan)
    line = [(4 + t * j, 4 + t * i) for t in range(-4, 5)]
    for y, x in line:
        alone[y, x] = depth[y, x]
    got = oracle.horizons(alone, 1.0, [turns * math.pi / 4])[0]
    np.testing.assert_allclose(
        [got[p] for p in line[:-1]],
        [
            max((depth[p] - depth[q]) / math.dist(p, q) for q in line[n + 1 :])
            for n, p in enumerate(line[:-1])
        ],
        rtol=1e-12,
    )
    assert got[line[-1]] == -np.inf and np.isnan(got).sum() == 72


def test_no_ground_that_way():
    """-inf, not 0: off the border, across a map of one row, beside nothing but masked nodes."""
    level = np.full((4, 5), 3.0)
    east = oracle.horizons(level, 1.0, [0.0])[0]
    assert np.isneginf(east[:, -1]).all() and (east[:, :-1] == 0).all()
    shallow = oracle.horizons(level, 1.0, [math.atan2(1, 100)])[0]
    assert np.isneginf(shallow[-1]).all()  # the ray leaves the map between its last row and nothing
    assert (shallow[:-1, :-1] == 0).all() and np.isneginf(shallow[:, -1]).all()
    row = oracle.horizons(np.array([[3.0, 1.0, 2.0]]), 1.0, [0.0, math.pi, 0.01, math.pi / 2])[:, 0]
    assert row.tolist() == [[2, -1, -math.inf], [-math.inf, -2, 1], [-math.inf] * 3, [-math.inf] * 3]
    level[:, 2:4] = np.inf
    assert (
        np.isneginf(oracle.horizons(level, 1.0, [0.0])[0][:, 4]).all()
        and (oracle.horizons(level, 1.0, [0.0])[0][:, :2] == 0).all()
    )
    level[:, 4] = np.inf
    assert np.isneginf(oracle.horizons(level, 1.0, [0.0])[0][:, 1]).all()


def test_masked_nodes_do_not_occlude():
    """A wall with a masked node: seen on either side of the hole, through the hole not at all."""
    depth = np.full((9, 9), 4.0)
    depth[:, 6] = 0.0
    depth[4, 6] = np.nan
    got = oracle.horizons(depth, 1.0, [0.0])[0]
    assert got[4, :6].tolist() == [0] * 6 and np.isnan(got[4, 6]) and (got[[3, 5], 2] == 1).all()
    for across, expected in ((0.5, 0), (0.8, 0), (1.0, 4), (1.01, 4), (-0.5, 0), (-1.0, 4), (1 - 1e-11, 4)):
        found = slope(depth, 2, 4, math.atan2(across, 4))
        assert found == pytest.approx(expected / math.hypot(4, across), rel=1e-9, abs=0)
    assert np.isnan(oracle.horizons(depth, 1.0, [0.0, 1.0])[:, 4, 6]).all()


def test_walls_of_a_dark_box():
    """Half a node outside, up to z = 0: depth / distance of the first wall; higher ground still counts."""
    depth = np.full((5, 9), 6.0)
    spacing = 2.0
    got = lambda x, y, i, j: slope(depth, x, y, math.atan2(j, i), spacing, sides="dark")
    assert got(3, 2, 1, 0) == 6 / (5.5 * spacing)
    assert got(3, 2, -1, 0) == 6 / (3.5 * spacing)
    assert got(8, 1, 1, 0) == 6 / (0.5 * spacing)
    assert got(3, 1, 0, -1) == pytest.approx(6 / (1.5 * spacing), rel=1e-12)
    assert got(3, 1, 0, 1) == pytest.approx(6 / (3.5 * spacing), rel=1e-12)
    assert got(6, 1, 1, 1) == pytest.approx(6 / (2.5 * math.sqrt(2) * spacing), rel=1e-12)
    assert got(1, 1, -2, 3) == pytest.approx(
        6 / (0.75 * math.hypot(2, 3) * spacing), rel=1e-12
    )  # at x = -1/2 after 3/4, y = 4 1/2 after 7/6
    assert got(0, 0, -1, -1) == pytest.approx(6 / (0.5 * math.sqrt(2) * spacing), rel=1e-12)
    depth[2, 5] = 1.0
    assert got(3, 2, 1, 0) == 5 / (2 * spacing)
    depth[2, 3] = np.nan
    assert math.isnan(got(3, 2, 1, 0))
    tall = np.full((9, 2), 3.0)
    assert slope(tall, 0, 2, math.pi / 2, sides="dark") == pytest.approx(3 / 6.5, rel=1e-12)


def test_a_spike_across_the_seam():
    """A map that repeats: column 1's spike stands before column 19 as column 22, and before itself."""
    depth = spiked((15, 21), (3, 1))
    periodic = lambda x, y, i, j: slope(depth, x, y, math.atan2(j, i), sides="periodic")
    assert periodic(19, 3, 1, 0) == 1.0
    assert periodic(2, 3, 1, 0) == 3 / 20
    assert periodic(1, 12, 0, 1) == pytest.approx(3 / 6, rel=1e-12)
    assert periodic(19, 13, 3, 5) == pytest.approx(3 / math.hypot(3, 5), rel=1e-12)
    assert periodic(4, 5, -3, -2) == pytest.approx(3 / math.hypot(3, 2), rel=1e-12)
    assert periodic(1, 3, 1, 0) == 0.0  # the next image, level with it
    assert slope(depth, 19, 3, 0.0) == 0.0
    assert (oracle.horizons(np.full((3, 4), 2.0), 1.0, circle(8)[0], "periodic") == 0).all()
    # laps on: along (1, 5) the spike's image comes after the row has wrapped twice, 5 t = 33 - 3, x + t = 1 +
    # 21 n
    assert periodic(16, 3, 1, 5) == pytest.approx(3 / math.hypot(6, 30), rel=1e-12)


@pytest.mark.parametrize("sides", ["open", "periodic"])
@pytest.mark.parametrize("i, j", [(1, 0), (0, -1), (2, 1), (-3, 2)])
def test_max_distance_on_either_side_of_a_spike(i, j, sides):
    """At exactly its distance it counts, a thousandth short of it not."""
    depth, spacing = spiked((23, 23), (11, 11)), 0.1
    away = 3 * math.hypot(i, j) * spacing
    got = lambda far: slope(
        depth, 11 - 3 * i, 11 - 3 * j, math.atan2(j, i), spacing, sides=sides, max_distance=far
    )
    assert got(away) == got(away * 1.001) == pytest.approx(3 / away, rel=1e-12)
    assert got(away * 0.999) < 0.75 * 3 / away
    assert got(0.099 * math.hypot(i, j) / max(abs(i), abs(j))) == -math.inf  # nearer than any crossing
    if sides == "open":
        assert got(math.inf) == got(None) == pytest.approx(3 / away, rel=1e-12)


def test_max_distance_spares_the_walls_of_a_dark_box():
    """The box is where the light ends, not ground that may be left out."""
    depth = spiked((5, 30), (2, 12), floor=6.0, top=0.0)
    assert slope(depth, 2, 2, 0.0, sides="dark") == 6 / 10
    assert slope(depth, 2, 2, 0.0, sides="dark", max_distance=9) == 6 / 27.5


def test_nodes_are_the_map_sampled():
    """In the order asked for, twice if asked twice."""
    depth = rough(12, 17, 1.0, seed=2)
    depth[4, 4:7] = np.inf
    azimuths, _ = circle(7)
    nodes = (np.array([3, 11, 4, 0, 3]), np.array([16, 2, 5, 9, 16]))
    for sides in ("open", "dark", "periodic"):
        full = oracle.horizons(depth, 3.0, azimuths, sides)
        assert full.shape == (7, 12, 17) and full.dtype == np.float64
        np.testing.assert_array_equal(
            oracle.horizons(depth, 3.0, azimuths, sides, nodes=nodes), full[:, nodes[0], nodes[1]]
        )


def test_horizons_scale_with_length():
    """Depth and spacing in another unit: the same; spacing alone: its inverse. Integers and float32 too."""
    depth = rough(10, 9, 1.0, seed=3).astype(np.float32)
    azimuths, _ = circle(9)
    one = oracle.horizons(depth, 1.0, azimuths, "dark")
    np.testing.assert_array_equal(oracle.horizons(4 * depth, 4.0, azimuths, "dark"), one)
    np.testing.assert_array_equal(oracle.horizons(depth, 4.0, azimuths, "dark"), one / 4)
    np.testing.assert_array_equal(
        oracle.horizons(np.arange(20).reshape(4, 5), 1.0, [0.0]),
        oracle.horizons(np.arange(20.0).reshape(4, 5), 1.0, [0.0]),
    )


# -- skies ---------------------------------------------------------------------------------------------------


def test_a_level_plane_under_a_uniform_sky():
    """Exactly pi, masked nodes nan; with a number, that many times."""
    depth = np.full((4, 5), 2.0)
    depth[1, 2] = np.nan
    got = sky(depth, count=16)
    assert np.isnan(got[1, 2]) and np.isnan(got).sum() == 1 and np.nanmax(abs(got - np.pi)) < 1e-14 * 16
    azimuths, widths = circle(16)
    bare = oracle.sky_irradiance(
        depth, 1.0, np.isfinite(depth), azimuths, widths, np.zeros((16, 4, 5))
    )  # whose horizon does not know the mask
    np.testing.assert_array_equal(bare, got)
    np.testing.assert_allclose(sky(depth, count=16, brightness=2.5), 2.5 * got, rtol=1e-14)


@pytest.mark.parametrize("gx, gy", [(0.5, 0), (0, -1.5), (1.2, 0.9), (-3, 2)])
def test_a_tilted_plane_under_a_uniform_sky(gx, gy):
    """pi (1 + cos a) / 2 at every node, the border included, where no ground lies above the tangent plane."""
    y, x = np.mgrid[:6, :7]
    depth = 20 + gx * x + gy * y
    got = sky(depth, count=512)
    np.testing.assert_allclose(got, np.pi * (1 + 1 / np.sqrt(1 + gx**2 + gy**2)) / 2, rtol=2e-5)
    np.testing.assert_allclose(sky(depth * 0.5, 0.5, count=512), got, rtol=1e-12)


def test_a_trench_without_end():
    """pi a / sqrt(a^2 + d^2) in the middle, a to the rim's node: endless, since the map repeats."""
    for a, d, spacing in ((6, 8.0, 1.0), (3, 1.0, 1.0), (5, 40.0, 0.5)):
        depth = np.zeros((3, 2 * a + 9))
        depth[:, 5 : 4 + 2 * a] = d
        middle = ([1], [4 + a])
        got = sky(depth, spacing, count=256, nodes=middle, sides="periodic")
        assert got[0] == pytest.approx(np.pi * a * spacing / math.hypot(a * spacing, d), rel=1e-5)


def test_a_spherical_bowl():
    """pi (1 + cos a) / 2 at every node, 2 nodes from the rim and in: R = 200, a = 60 degrees."""
    R, a = 200.0, math.radians(60)
    y, x = np.mgrid[-178:179, -178:179]
    depth = np.sqrt(np.maximum(R**2 - x**2 - y**2, 0)) - R * math.cos(a)
    depth[np.hypot(x, y) >= R * math.sin(a)] = 0
    spots = np.array(
        [(0, 0), (60, -31), (-100, 100), (0, 150), (-165, 30), (100, 137), (3, -170), (121, 121)]
    )
    assert np.hypot(*spots.T).max() < R * math.sin(a) - 2
    got = sky(depth, count=128, nodes=tuple(spots.T + 178))
    np.testing.assert_allclose(got / (np.pi * (1 + math.cos(a)) / 2), 1, atol=2e-3)


def test_brightness_by_quadrature():
    """Closed forms on a level plane: uniform pi, overcast 7/9 pi, sine of elevation 2/3 pi, odd ones 0."""
    depth = np.full((2, 3), 4.0)
    for brightness, wanted in (
        (sl.uniform(1.0), 1),
        (sl.cie_overcast(), 7 / 9),
        (lambda L: -L[..., 2], 2 / 3),
        (lambda L: 1 + L[..., 0] - L[..., 1], 1),
        (sl.cosine_power(8), 2 / 10),
    ):
        np.testing.assert_allclose(sky(depth, count=8, brightness=brightness), wanted * np.pi, rtol=1e-12)
    tilted = 3 + np.add.outer(np.arange(5.0), 2 * np.arange(4.0))
    np.testing.assert_allclose(
        sky(tilted, count=16, brightness=sl.uniform(3.0)), sky(tilted, count=16, brightness=3.0), rtol=1e-12
    )


def test_half_a_sky_behind_a_horizon_of_45_degrees():
    """B = 1 + L_y, over 45 degrees to +y: pi cos^2 t / 2 + 2 cos^3 t / 3 there, pi / 2 - 2 / 3 behind."""
    azimuths, widths = circle(720)
    horizon = np.where(azimuths < np.pi, 1.0, -np.inf)[:, None, None] * np.ones((1, 1))
    got = oracle.sky_irradiance(
        np.ones((1, 1)), 1.0, np.ones((1, 1), bool), azimuths, widths, horizon, lambda L: 1 + L[..., 1]
    )
    c = math.sqrt(0.5)
    assert got[0, 0] == pytest.approx(np.pi * c**2 / 2 + 2 * c**3 / 3 + np.pi / 2 - 2 / 3, rel=1e-5)
    plain = oracle.sky_irradiance(np.ones((1, 1)), 1.0, np.ones((1, 1), bool), azimuths, widths, horizon)
    assert plain[0, 0] == pytest.approx(0.75 * np.pi, rel=1e-12)


def test_widths_weigh_the_azimuths():
    """Azimuths that crowd on one side, each with its own share of the circle."""
    edges = np.concatenate([np.linspace(0, 1, 60, endpoint=False), np.linspace(1, 2 * np.pi, 201)])
    depth = 9 + np.add.outer(np.arange(5.0), np.arange(4.0))
    azimuths, widths = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    got = oracle.sky_irradiance(
        depth, 1.0, everywhere(depth), azimuths, widths, oracle.horizons(depth, 1.0, azimuths)
    )
    np.testing.assert_allclose(got, np.pi * (1 + 3**-0.5) / 2, rtol=1e-3)


# -- shadow rays ---------------------------------------------------------------------------------------------


def _random_rays(count, seed):
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(count, 3)) * (1, 1, 0.3)
    L[:, 2] = -abs(L[:, 2])
    return L / np.linalg.norm(L, axis=1)[:, None]


@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_a_ray_without_end_is_free_above_the_horizon(sides):
    """The two marches, made apart, on rough ground with masked nodes: node by node and ray by ray."""
    depth = rough(24, 31, 1.0, seed=6)
    depth[3:6, 10:13] = depth[20, 4] = np.nan
    L = _random_rays(300, 1)
    L[:8] = [[x, y, -0.2] for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
    L /= np.linalg.norm(L, axis=1)[:, None]
    nodes = (np.array([0, 12, 23, 9, 17]), np.array([0, 30, 8, 15, 22]))
    horizon = oracle.horizons(depth, 2.0, np.arctan2(L[:, 1], L[:, 0]), sides, nodes=nodes)
    elevation = -L[:, 2] / np.hypot(L[:, 0], L[:, 1])
    seen = 0
    for n, (row, col) in enumerate(zip(*nodes)):
        got = oracle.unblocked(depth, 2.0, row, col, L, np.full(len(L), np.inf), sides)
        sure = abs(elevation - horizon[:, n]) > 1e-9
        sure &= (elevation > oracle.LEVEL_SLOPE) | (sides == "open")
        assert_bits_equal(got[sure], (elevation > horizon[:, n])[sure])
        seen += got.sum()
    assert 0.2 < seen / (5 * len(L)) < 0.8


def test_a_ray_ends_where_it_ends():
    """A wall beyond the end does not block it, one before does; touching its top does not."""
    depth = np.full((5, 12), 6.0)
    depth[:, 9] = 0.0
    east = np.array([[1.0, 0, 0], [1, 0, -1], [0.6, 0.8, 0], [0, 0, -1]])
    east /= np.linalg.norm(east, axis=1)[:, None]
    free = lambda col, end: oracle.unblocked(depth, 0.5, 2, col, east, np.full(4, end)).tolist()
    assert free(4, 2.5) == [True, True, True, True]
    assert free(4, 2.6) == [False, True, True, True]
    assert free(4, 99.0) == [
        False,
        False,
        True,
        True,
    ]  # the slanting ray leaves the map in row 4 before it meets the wall
    assert free(3, 3.0) == [True] * 4
    low = np.full((1, 9), 2.0)
    low[0, 6] = 0.0
    up = np.array([[1.0, 0, -1.0]]) / math.sqrt(2)
    assert oracle.unblocked(low, 1.0, 0, 4, up, np.array([50.0]))[0]
    assert not oracle.unblocked(low, 1.0, 0, 5, up, np.array([50.0]))[0]


# -- lamps ---------------------------------------------------------------------------------------------------


def ball(x, y, z, radius, brightness=1.0):
    return sl.Lamp(center=(x, y, z), radius=radius, brightness=brightness)


def slanted(shape, gx, gy, z=30.0):
    y, x = np.mgrid[: shape[0], : shape[1]]
    depth = z + gx * x + gy * y
    return depth, np.array([gx, gy, -1]) / math.sqrt(1 + gx**2 + gy**2)


NODES = (np.array([0, 7, 7, 12]), np.array([0, 3, 9, 16]))


def places(depth, spacing=1.0, nodes=NODES):
    """(n, 3) positions of nodes."""
    return np.stack([nodes[1] * spacing, nodes[0] * spacing, np.asarray(depth, float)[nodes]], -1)


@pytest.mark.parametrize("gx, gy", [(0, 0), (0.5, -0.3)])
@pytest.mark.parametrize("lamp", [(8, 6, 5, 4), (-9, 20, -15, 7), (100, 100, -200, 1.5)])
def test_a_sphere_above_the_plane(lamp, gx, gy):
    """pi (R / d)^2 cos(angle): near, far, inside the volume, behind the viewer; spacing 0.5."""
    depth, normal = slanted((13, 17), gx, gy)
    for spacing in (1.0, 0.5):
        to = np.array(lamp[:3]) * spacing - places(depth * spacing, spacing)
        far = np.linalg.norm(to, axis=1)
        assert (to @ normal / far > lamp[3] * spacing / far).all(), "partly below the tangent plane"
        got = oracle.lamp_irradiance(
            depth * spacing, spacing, everywhere(depth), ball(*np.array(lamp) * spacing), NODES
        )
        np.testing.assert_allclose(
            got, np.pi * (lamp[3] * spacing / far) ** 2 * (to @ normal) / far, rtol=2e-4
        )


def test_a_small_far_lamp_shines_with_the_brightness_of_its_direction():
    """B(L) pi (R / d)^2 cos for a spot, whose axis points away from it; below the horizon, nothing."""
    depth = np.full((13, 17), 30.0)
    spot = sl.cosine_power(16, axis=(0.3, 0.1, 1), brightness=2.0)
    to = np.array([4.0, 5.0, -20.0]) - places(depth)
    far = np.linalg.norm(to, axis=1)
    got = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), ball(4, 5, -20, 0.05, spot), NODES, rays=256)
    np.testing.assert_allclose(
        got, spot(to / far[:, None]) * np.pi * (0.05 / far) ** 2 * -to[:, 2] / far, rtol=1e-4
    )
    assert oracle.lamp_irradiance(depth, 1.0, everywhere(depth), ball(40, 5, 33, 2), NODES).tolist() == [
        0,
        0,
        0,
        0,
    ]


def test_the_moment_of_a_disc_cut_by_a_plane():
    """The closed form that the next tests stand on, against quadrature over the disc, and in its limits."""
    axis, sine = np.array([0.36, 0.48, -0.8]), 0.55
    np.testing.assert_allclose(disc_moment(axis, sine), np.pi * sine**2 * axis, rtol=1e-14)
    np.testing.assert_allclose(disc_moment(axis, sine, axis), np.pi * sine**2 * axis, rtol=1e-12)
    np.testing.assert_allclose(disc_moment(axis, sine, -axis), np.zeros(3), atol=1e-12)
    one = (np.arange(1200) + 0.5) / 1200
    L = (1 - one * (1 - math.sqrt(1 - sine**2)))[:, None, None] * axis
    e, f = np.array([0.8, -0.6, 0]), np.array([0.48, 0.64, 0.6])
    around = np.cos(2 * np.pi * one)[:, None] * e + np.sin(2 * np.pi * one)[:, None] * f
    L = L + np.sqrt(1 - (L @ axis) ** 2)[..., None] * around
    for above in ([0.6, 0, -0.8], [0, 0.6, 0.8], [1.0, 0, 0], [-0.6, 0.8, 0]):
        cut = np.where(L @ np.array(above) > 0, 1.0, 0.0)
        got = disc_moment(axis, sine, above)
        np.testing.assert_allclose(
            got, (L * cut[..., None]).mean((0, 1)) * 2 * np.pi * (1 - math.sqrt(1 - sine**2)), atol=2e-3
        )
        np.testing.assert_allclose(
            got + disc_moment(axis, sine, -np.array(above)), np.pi * sine**2 * axis, atol=1e-12
        )


def test_a_half_set_sphere():
    """Cut by the tangent plane: the disc's moment above it. On level ground plane and horizon are one."""
    depth = np.full((13, 17), 10.0)
    for lamp in ((25, 6, 10, 5), (24, 5, 12, 6), (22, 6, 8, 5)):
        to = np.array(lamp[:3]) - places(depth)
        far = np.linalg.norm(to, axis=1)
        assert (abs(to[:, 2]) < lamp[3]).all()
        wanted = disc_moment(to / far[:, None], lamp[3] / far, UP) @ UP
        got = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), ball(*lamp), NODES)
        np.testing.assert_allclose(got, wanted, rtol=3e-3)
    # centre on the plane: d - sin d cos d, d the disc's radius in angle
    angle = math.asin(5 / 9)
    got = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), ball(25, 7, 10, 5), ([7], [16]))
    assert got[0] == pytest.approx(angle - math.sin(angle) * math.cos(angle), rel=2e-3)


def test_light_from_below_the_level_does_not_count():
    """On a falling slope the upper half of a sphere at the node's level shines, above the tangent plane."""
    depth, normal = slanted((13, 17), 0.8, 0.0)
    lamp = np.array([22.0, 6, 38, 3])
    nodes = (np.array([6, 4]), np.array([10, 10]))
    to = lamp[:3] - places(depth, nodes=nodes)
    far = np.linalg.norm(to, axis=1)
    assert (to @ normal > lamp[3]).all()
    wanted = disc_moment(to / far[:, None], lamp[3] / far, UP) @ normal
    got = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), ball(*lamp), nodes, rays=16384)
    np.testing.assert_allclose(got, wanted, rtol=2e-3)


def test_a_node_inside_the_sphere_sees_it_everywhere():
    """pi on level ground, pi (1 + cos a) / 2 tilted (nothing shines from below), beside a wall or not."""
    depth = np.full((13, 17), 10.0)
    depth[:, 4] = 7.0
    got = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), ball(7, 6, 9, 6), ([6], [6]))
    assert got[0] == pytest.approx(np.pi, rel=1e-3)
    depth, normal = slanted((13, 17), 1.0, 0.5)
    got = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), ball(8, 6, 38, 6), ([6], [8]))
    assert got[0] == pytest.approx(np.pi * (1 - normal[2]) / 2, rel=1e-3)


def walled(rows=81, cols=45, floor=12.0, top=4.0, at=22):
    """A level floor with a wall one node wide along column ``at``."""
    depth = np.full((rows, cols), floor)
    depth[:, at] = top
    return depth


def test_the_penumbra_of_a_sphere_behind_a_straight_edge():
    """From nothing to the whole disc: the part above the plane through node and edge, in closed form."""
    spacing = 0.5
    depth, lamp = walled() * spacing, np.array([34.0, 40.0, -4.0, 3.0]) * spacing
    cols = np.arange(0, 20)
    nodes = (np.full(20, 40), cols)
    eye = places(depth, spacing, nodes)
    to = lamp[:3] - eye
    far = np.linalg.norm(to, axis=1)
    edge = np.array([22, 40, 4.0]) * spacing - eye
    above = np.stack(
        [edge[:, 2], 0 * far, -edge[:, 0]], -1
    )  # normal of the plane of the eye and the edge, upwards
    above /= np.linalg.norm(above, axis=1)[:, None]
    wanted = disc_moment(to / far[:, None], lamp[3] / far, above) @ UP
    got = oracle.lamp_irradiance(depth, spacing, everywhere(depth), ball(*lamp), nodes, rays=16384)
    full = np.pi * (lamp[3] / far) ** 2 * -to[:, 2] / far
    np.testing.assert_allclose(got / full, wanted / full, atol=2e-3)
    share = wanted / full
    assert share[0] > 0.999 and share[-1] == 0 and ((0.05 < share) & (share < 0.95)).sum() >= 4
    assert_bits_equal(got == 0, wanted == 0)


def _above(polygon, normal):
    """The part of a polygon (n, 3) on the upper side of a plane through the origin."""
    out = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0)):
        ha, hb = a @ normal, b @ normal
        out += [a] if ha >= 0 else []
        out += [a + (b - a) * ha / (ha - hb)] if ha * hb < 0 else []
    return np.array(out)


def test_the_penumbra_of_an_area_light_behind_a_straight_edge():
    """Lambert's polygon cut at the edge; light begins and is whole where similar triangles say."""
    depth = walled()
    corner, edge_u, edge_v = np.array([30.0, 30.0, -2.0]), np.array([4.0, 0, 0]), np.array([0, 20.0, 0])
    polygon = np.array([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v])
    cols = np.arange(0, 20)
    nodes = (np.full(20, 40), cols)
    share = []
    got = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), (corner, edge_u, edge_v, 1.0), nodes)
    for node, col in enumerate(cols):
        eye = np.array([col, 40, 12.0])
        edge = np.array([22, 40, 4.0]) - eye
        whole, part = polygon - eye, _above(polygon - eye, np.array([edge[2], 0, -edge[0]]))
        full = polygon_moment(whole) @ UP
        wanted = polygon_moment(part) @ UP if len(part) else 0.0
        assert abs(got[node] - wanted) <= 2e-3 * full, (col, got[node], wanted)
        share.append(got[node] / full)
    # the ground's plane is 8 below the edge, the light 6 above it: shadows end 8/6 of the light's distance
    # before the wall
    begins, whole = 22 - 8 / 6 * (30 - 22), 22 - 8 / 6 * (34 - 22)
    share = np.array(share)
    assert (share[cols > begins] == 0).all() and (share[cols < begins] > 0).all()
    np.testing.assert_allclose(share[cols <= whole], 1, atol=2e-3)
    assert (share[cols > whole] < 0.999).all()
    assert (np.diff(share[(cols > whole) & (cols < begins)]) < 0).all()


@pytest.mark.parametrize("gx, gy", [(0, 0), (-0.4, 0.7)])
def test_an_area_light_in_the_open(gx, gy):
    """Lambert's formula for a tilted rectangle, either face, edges in either order; B by direction."""
    depth, normal = slanted((13, 17), gx, gy)
    corner, u, v = np.array([2.0, 3.0, 4.0]), np.array([9.0, 0, 3]), np.array([-1.0, 5, 3])
    assert u @ v == 0
    polygon = np.array([corner, corner + u, corner + u + v, corner + v])
    eye = places(depth)[:, None]
    assert ((polygon - eye) @ normal > 0).all()
    wanted = polygon_moment(polygon - eye) @ normal
    for light in ((corner, u, v), (corner, v, u), (corner + u, -u, v), (corner + u + v, -v, -u)):
        np.testing.assert_allclose(
            oracle.lamp_irradiance(depth, 1.0, everywhere(depth), (*light, 1.0), NODES), wanted, rtol=3e-4
        )
    small = np.array([40.0, 20, -40])
    to = small - eye[:, 0]
    far = np.linalg.norm(to, axis=1)
    glow = lambda L: 2 + L[..., 0] - L[..., 2] ** 3
    light = (small - (0.5, 0.5, 0), (1.0, 0, 0), (0, 1.0, 0), glow)
    np.testing.assert_allclose(
        oracle.lamp_irradiance(depth, 1.0, everywhere(depth), light, NODES, rays=256),
        glow(to / far[:, None]) * -to[:, 2] / far**3 * (to @ normal) / far,
        rtol=2e-3,
    )


def test_an_area_light_seen_edge_on():
    """From its own plane nothing; upright, half of it below the ground: the part above."""
    depth = np.full((13, 17), 10.0)
    assert oracle.lamp_irradiance(
        depth, 1.0, everywhere(depth), ((2.0, 7, 2), (8.0, 0, 0), (0, 0, 5.0), 1.0), ([7], [3])
    ).tolist() == [0]
    light = (np.array([20.0, 2, 6]), np.array([0, 9.0, 0]), np.array([0, 0, 8.0]))
    part = np.array([[20.0, 2, 6], [20, 11, 6], [20, 11, 10], [20, 2, 10]])
    wanted = polygon_moment(part - places(depth)[:, None]) @ UP
    np.testing.assert_allclose(
        oracle.lamp_irradiance(depth, 1.0, everywhere(depth), (*light, 1.0), NODES), wanted, rtol=2e-3
    )


def test_a_wall_shades_only_before_the_lamp():
    """A lamp before the wall, around it and beyond it; a masked node in the wall lets it through."""
    depth = walled(rows=21, top=0.0)
    valid = everywhere(depth)
    at = ([10], [10])
    assert oracle.lamp_irradiance(depth, 1.0, valid, ball(18, 10, 10, 1), at)[0] > 0
    assert oracle.lamp_irradiance(depth, 1.0, valid, ball(26, 10, 10, 1), at)[0] == 0
    # a wall inside the sphere hides none of it: rays end at the near side
    to = np.array([20.5, 10, 4]) - (10, 10, 12)
    far = np.linalg.norm(to)
    assert oracle.lamp_irradiance(depth, 1.0, valid, ball(20.5, 10, 4, 3), at)[0] == pytest.approx(
        np.pi * 9 / far**3 * 8, rel=1e-3
    )
    valid[10, 22] = False  # what lies under the mask is no matter
    to = np.array([26.0, 10, 10]) - (10, 10, 12)
    far = np.linalg.norm(to)
    for hidden in (0.0, np.inf, np.nan, 99.0):
        depth[10, 22] = hidden
        through = oracle.lamp_irradiance(depth, 1.0, valid, ball(26, 10, 10, 1), ([10, 10], [10, 22]))
        assert through[0] == pytest.approx(np.pi / far**2 * 2 / far, rel=1e-3) and np.isnan(through[1])


def test_rays_belong_to_the_node_and_the_seed():
    """The same node gives the same number whatever else is asked for; another seed another, close by."""
    depth = rough(20, 20, 1.0, seed=9)
    lamp = ball(10, 10, -8, 4)
    all_four = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), lamp, NODES, rays=1024)
    one = oracle.lamp_irradiance(
        depth, 1.0, everywhere(depth), lamp, (NODES[0][2:3], NODES[1][2:3]), rays=1024
    )
    assert one[0] == all_four[2] > 0
    other = oracle.lamp_irradiance(depth, 1.0, everywhere(depth), lamp, NODES, rays=1024, seed=1)
    assert (other != all_four)[all_four > 0].all()
    np.testing.assert_allclose(other, all_four, rtol=0.02)


def _rectangle(x0, x1, y0, y1, z, eye):
    return np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], float) - eye


def test_a_lamp_and_the_walls_of_a_dark_box():
    """Behind the viewer only what shows through the box's opening; inside the box only what stands inside."""
    depth, spacing = np.full((9, 13), 8.0), 0.5
    nodes = (np.array([4, 0, 7]), np.array([6, 0, 12]))
    x_low, x_high, y_low, y_high = -0.25, 6.25, -0.25, 4.25
    eyes = places(depth, spacing, nodes)
    light = lambda z: ((-4.0, 1.0, z), (14.0, 0, 0), (0, 12.0, 0), 1.0)
    got = oracle.lamp_irradiance(
        depth, spacing, everywhere(depth), light(-8.0), nodes, rays=65536, sides="dark"
    )
    # seen from depth 8, a light at z = -8 covers half its width in the plane z = 0
    wanted = [
        polygon_moment(
            _rectangle(
                max(x_low, (x - 4) / 2),
                min(x_high, (x + 10) / 2),
                max(y_low, (y + 1) / 2),
                min(y_high, (y + 13) / 2),
                0,
                (x, y, z),
            )
        )
        @ UP
        for x, y, z in eyes
    ]
    np.testing.assert_allclose(got, wanted, rtol=3e-3)
    got = oracle.lamp_irradiance(
        depth, spacing, everywhere(depth), light(5.0), nodes, rays=65536, sides="dark"
    )
    wanted = [polygon_moment(_rectangle(x_low, x_high, 1, y_high, 5, eye)) @ UP for eye in eyes]
    np.testing.assert_allclose(got, wanted, rtol=3e-3)
    beyond = ball(9, 2, 4, 1)
    assert oracle.lamp_irradiance(
        depth, spacing, everywhere(depth), beyond, nodes, sides="dark"
    ).tolist() == [0, 0, 0]
    assert (oracle.lamp_irradiance(depth, spacing, everywhere(depth), beyond, nodes) > 0).all()


# -- windows -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gx, gy", [(0, 0), (0.3, -0.4)])
@pytest.mark.parametrize(
    "x, y", [((4.25, 9), (3, 8.5)), ((-30, -12), (5, 60)), ((-500, 600), (-300, 900)), ((8, 8.01), (6, 6.01))]
)
def test_a_window_over_the_open_plane(x, y, gx, gy):
    """Lambert's formula: parallel and tilted, above, across, far larger than the map, small as a pinhole."""
    depth, normal = slanted((13, 17), gx, gy, z=9.0)
    eyes = places(depth)
    wanted = np.array([polygon_moment(_above(_rectangle(*x, *y, 0, eye), normal)) @ normal for eye in eyes])
    got = oracle.window_irradiance(depth, 1.0, everywhere(depth), sl.Window(x=x, y=y), NODES, points=16384)
    np.testing.assert_allclose(got, wanted, rtol=1e-3)
    half = oracle.window_irradiance(
        depth / 2,
        0.5,
        everywhere(depth),
        sl.Window(x=tuple(np.array(x) / 2), y=tuple(np.array(y) / 2)),
        NODES,
        points=16384,
    )
    np.testing.assert_allclose(half, got, rtol=1e-9)


def test_the_brightness_of_a_window_is_that_of_the_ray():
    """B = -L_z / N.L is 1 / cosine: the solid angle, in closed form; a pinhole shows one direction."""
    depth = np.full((13, 17), 9.0)
    window = sl.Window(x=(3, 10), y=(2, 11), brightness=lambda L: 1 / -L[..., 2])
    eyes = places(depth)
    wanted = rectangle_solid_angle(3 - eyes[:, 0], 10 - eyes[:, 0], 2 - eyes[:, 1], 11 - eyes[:, 1], 9.0)
    np.testing.assert_allclose(
        oracle.window_irradiance(depth, 1.0, everywhere(depth), window, NODES), wanted, rtol=1e-3
    )
    sun = lambda L: 1 + L[..., 0] + 2 * L[..., 1]
    to = np.array([8.0, 6, 0]) - eyes
    far = np.linalg.norm(to, axis=1)
    got = oracle.window_irradiance(
        depth,
        1.0,
        everywhere(depth),
        sl.Window(x=(7.99, 8.01), y=(5.99, 6.01), brightness=sun),
        NODES,
        points=256,
    )
    np.testing.assert_allclose(got, sun(to / far[:, None]) * 4e-4 * 81 / far**4, rtol=1e-3)


def test_a_node_in_the_window():
    """At z = 0 the whole sky or none, x0 <= x < x1; just below it by Lambert's formula, half on an edge."""
    depth = np.zeros((13, 17))
    window = sl.Window(x=(3.0, 9.0), y=(7.0, 8.0))
    nodes = (np.array([7, 7, 7, 8, 6]), np.array([3, 8, 9, 5, 5]))
    np.testing.assert_allclose(
        oracle.window_irradiance(depth, 1.0, everywhere(depth), window, nodes),
        [np.pi, np.pi, 0, 0, 0],
        rtol=1e-3,
    )
    shallow = np.full((13, 17), 1e-4)
    got = oracle.window_irradiance(shallow, 1.0, everywhere(depth), window, nodes)
    wanted = [polygon_moment(_rectangle(3, 9, 7, 8, 0, eye)) @ UP for eye in places(shallow, nodes=nodes)]
    np.testing.assert_allclose(got, wanted, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(
        wanted, np.pi * np.array([0.25, 0.5, 0.25, 0.5, 0]), atol=1e-3
    )  # on corners and on edges


def test_the_shadow_of_an_edge_in_a_window():
    """Lambert's polygon cut by the plane through node and edge; on a floor with a wall, as for lamps."""
    depth = walled()
    window = sl.Window(x=(25, 44), y=(20, 61))
    cols = np.arange(0, 20, 2)
    got = oracle.window_irradiance(
        depth, 1.0, everywhere(depth), window, (np.full(10, 40), cols), points=16384
    )
    for node, col in enumerate(cols):
        eye = np.array([col, 40, 12.0])
        part = _above(_rectangle(25, 44, 20, 61, 0, eye), np.array([4.0 - 12, 0, -(22 - col)]))
        wanted = polygon_moment(part) @ UP if len(part) else 0
        assert abs(got[node] - wanted) <= 2e-3 * got.max(), (col, got[node], wanted)
    assert got[0] > 0 and got[-1] == 0


def test_a_window_in_a_dark_box():
    """Only what lies over the box; one beside it is dark."""
    depth, spacing = np.full((13, 17), 9.0), 0.5
    eyes = places(depth, spacing)
    got = oracle.window_irradiance(
        depth, spacing, everywhere(depth), sl.Window(x=(5, 40), y=(-7, 3)), NODES, sides="dark"
    )
    wanted = [polygon_moment(_rectangle(5, 8.25, -0.25, 3, 0, eye)) @ UP for eye in eyes]
    np.testing.assert_allclose(got, wanted, rtol=1e-3)
    beside = oracle.window_irradiance(
        depth, spacing, everywhere(depth), sl.Window(x=(8.25, 9), y=(0, 3)), NODES, sides="dark"
    )
    assert beside.tolist() == [0, 0, 0, 0]


def test_a_window_over_a_map_that_repeats():
    """It stands over every image: the sum of Lambert's formula over the images."""
    depth, spacing = np.full((6, 8), 2.0), 0.5
    window = sl.Window(x=(2.5, 4.5), y=(1.0, 2.0))  # across the seam at 4
    nodes = (np.array([0, 3]), np.array([0, 5]))
    got = oracle.window_irradiance(
        depth, spacing, everywhere(depth), window, nodes, sides="periodic", points=65536
    )
    i, j = (n.ravel() for n in np.mgrid[-60:61, -60:61])
    for node, eye in enumerate(places(depth, spacing, nodes)):
        images = _rectangle(2.5, 4.5, 1, 2, 0, eye) + np.stack([4.0 * i, 3.0 * j, 0 * i], -1)[:, None]
        assert got[node] == pytest.approx((polygon_moment(images) @ UP).sum(), rel=5e-3)


def test_a_window_without_end_is_the_sky():
    """Horizons and shadow rays on rough ground, by different quadratures; no ray half a map away is lost."""
    depth = rough(40, 48, 1.0, seed=11)
    depth[10:13, 20:24] = np.inf
    nodes = tuple(np.random.default_rng(3).integers(0, 40, (2, 12)))
    wanted = sky(depth, 0.5, count=512, nodes=nodes)
    got = oracle.window_irradiance(
        depth, 0.5, np.isfinite(depth), sl.Window(x=(-1e5, 1e5), y=(-1e5, 1e5)), nodes
    )
    np.testing.assert_allclose(got, wanted, rtol=0.01)
    assert np.sqrt(np.nanmean((got - wanted) ** 2)) < 0.003 * np.nanmean(wanted)
    assert np.nanmax(wanted) - np.nanmin(wanted) > 1, "the ground hardly shades"
