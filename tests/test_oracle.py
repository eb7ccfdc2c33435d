"""The oracle against closed forms and cases worked out by hand; nothing here runs a backend."""

from fractions import Fraction

import numpy as np
import pytest
from compare import assert_bits_equal

import skylamp as sl
from skylamp import oracle
from skylamp.sources.shapes import APERTURE, BALL, RECTANGLE, SKY, VOLUME, Geometry

NOTHING = np.zeros((1, 1, 1), np.uint8)
OPEN_SKY = Geometry(SKY, np.zeros(4), NOTHING)


def ball(*numbers):
    return Geometry(BALL, np.array(numbers, float), NOTHING)


def visible(depth, size=3, sides="open", source=OPEN_SKY):
    """{(i, j, k): (rows, cols) bool} by propagation."""
    cube = sl.Hemicube(size)
    bits = oracle.surface_visibility(np.asarray(depth), cube.steps, sides, source)
    return {(i, j, -up): bits[..., d] for d, (i, j, up) in enumerate(cube.steps.tolist())}


@pytest.mark.parametrize("sides", ["open", "periodic"])
def test_a_flat_plane_sees_every_direction(sides):
    """At any depth; level rays too, since touching does not block."""
    for depth in (0, 3):
        assert all(v.all() for v in visible(np.full((5, 7), depth), 5, sides).values())


def test_the_shadow_of_a_wall_one_node_wide():
    """Floor at 4, wall up to 0 at column 6, step (1, 0, -1): column x is blocked while 6 - x < 4."""
    depth = np.full((3, 12), 4)
    depth[:, 6] = 0
    lit = visible(depth)
    assert lit[1, 0, 1][1].tolist() == [x <= 2 or x >= 6 for x in range(12)]
    assert lit[-1, 0, 1][1].tolist() == [x >= 10 or x <= 6 for x in range(12)]
    assert lit[1, 0, 0][1].tolist() == [x >= 6 for x in range(12)]
    assert lit[0, 0, 1].all() and lit[0, 1, 0][:, [0, 11]].all()


def test_a_step_of_two_jumps_over_a_wall_of_one():
    """The paper's step x + l looks at every second node only: the leak that filled visibility closes."""
    depth = np.full((1, 12), 4)
    depth[:, 6] = 0
    cube = sl.Hemicube(5)
    d = cube.steps.tolist().index([2, 0, -1])
    stride = visible(depth, 5)[2, 0, 1][0]
    filled = oracle.filled_visibility(depth.astype(float), 1.0, cube.steps, "open")[0, :, d]
    assert stride.tolist() == [
        x >= 6 or x % 2 == 1 for x in range(12)
    ]  # from 4 nodes or fewer: over the wall the ray is at least 2 deep
    assert filled.tolist() == [
        x >= 6 for x in range(12)
    ]  # the ray from column 0 is still at depth 1 over the wall


def test_level_rays_run_in_order_from_the_source():
    """k = 0: a higher node anywhere on the line blocks, an equal one does not, in both orders of the loop."""
    depth = np.array([[3, 3, 2, 3, 4, 3]])
    lit = visible(depth)
    assert lit[1, 0, 0][0].tolist() == [False, False, True, True, False, True]
    assert lit[-1, 0, 0][0].tolist() == [True, True, True, False, False, False]
    column = visible(depth.T)
    assert_bits_equal(column[0, 1, 0][:, 0].copy(), lit[1, 0, 0][0].copy())
    assert_bits_equal(column[0, -1, 0][:, 0].copy(), lit[-1, 0, 0][0].copy())


def test_the_corner_of_a_dark_box():
    """Dark: lit iff -k <= 2 (x k + i n) < (2 cols - 1) k, in both axes; the low wall belongs to the box."""
    for depth in (1, 2, 3):
        lit = visible(np.full((4, 6), depth), 5, "dark")
        for (i, j, k), got in lit.items():
            for y in range(4):
                for x in range(6):
                    inside = (
                        k > 0
                        and Fraction(-1, 2) <= x + Fraction(i * depth, k) < 6 - Fraction(1, 2)
                        and Fraction(-1, 2) <= y + Fraction(j * depth, k) < 4 - Fraction(1, 2)
                    )
                    assert got[y, x] == inside, (depth, i, j, k, y, x)
    exact = visible(np.full((1, 6), 1), 5, "dark")
    assert exact[-1, 0, 2][0].tolist() == [True] * 6  # from x = 0 it leaves at -1/2, which belongs to the box
    assert exact[1, 0, 2][0].tolist() == [True] * 5 + [False]  # from x = 5 at 5 1/2, which does not


def test_the_edges_of_a_window_are_half_open():
    """x0 <= x < x1 at the crossing with z = 0, also outside the map; level rays never pass a window."""
    window = Geometry(RECTANGLE, np.array([2.0, 5.0, 0.0, 3.0]), NOTHING)
    lit = visible(np.full((3, 9), 1), 5, "open", window)
    for (i, j, k), got in lit.items():
        for y in range(3):
            for x in range(9):
                inside = k > 0 and 2 <= x + Fraction(i, k) < 5 and 0 <= y + Fraction(j, k) < 3
                assert got[y, x] == inside, (i, j, k, y, x)
    beyond = visible(
        np.full((1, 3), 2), 3, "open", Geometry(RECTANGLE, np.array([3.0, 5.0, -9.0, 9.0]), NOTHING)
    )
    assert beyond[1, 0, 1][0].tolist() == [False, True, True]
    assert not beyond[1, 0, 0].any()


def test_a_window_over_a_periodic_map_repeats():
    """It stands over every image of the map, also where it reaches across the edge."""
    window = Geometry(RECTANGLE, np.array([4.0, 6.0, 0.0, 1.0]), NOTHING)
    lit = visible(np.full((1, 5), 2), 3, "periodic", window)
    assert lit[0, 0, 1][0].tolist() == [True, False, False, False, True]
    assert lit[1, 0, 1][0].tolist() == [False, False, True, True, False]
    assert lit[-1, 0, 1][0].tolist() == [False, True, True, False, False]


def test_an_aperture_takes_the_nearest_node():
    """floor(x + 1/2) of the crossing: half way the higher node counts; off the map nothing is open."""
    flags = np.array([[[1, 0, 0, 1, 1]]], np.uint8)
    lit = visible(np.full((1, 5), 1), 5, "open", Geometry(APERTURE, np.zeros(4), flags))
    assert lit[1, 0, 2][0].tolist() == [False, False, True, True, False]  # x + 1/2 -> x + 1
    assert lit[-1, 0, 2][0].tolist() == [True, False, False, True, True]  # x - 1/2 -> x
    assert lit[0, 0, 2][0].tolist() == [True, False, False, True, True]


def test_level_rays_of_a_periodic_map_follow_their_cycle():
    """Lit iff no node of the cycle is higher: on a 4 x 6 torus a diagonal meets every second node."""
    depth = np.full((4, 6), 2)
    depth[1, 2] = 1
    lit = visible(depth, 3, "periodic")
    y, x = np.mgrid[:4, :6]
    assert_bits_equal(lit[1, 1, 0], (x - y - 1) % 2 != 0 | ((y == 1) & (x == 2)))
    assert_bits_equal(lit[1, 0, 0], (y != 1) | (x == 2))
    assert_bits_equal(lit[0, -1, 0], (x != 2) | (y == 1))
    assert lit[0, 0, 1].all()


def test_a_periodic_ray_climbs_past_the_edge():
    """The left edge shades the right one: the ray from column 6 meets the wall of column 0 as column 7."""
    depth = np.full((1, 7), 3)
    depth[0, 0] = 0
    assert visible(depth, 3, "periodic")[1, 0, 1][0].tolist() == [True, True, True, True, True, False, False]
    assert visible(depth, 3, "open")[1, 0, 1][0].all()


def test_masked_nodes_neither_block_nor_are_lit():
    """A hole in a wall: light passes it at any depth."""
    depth = np.full((1, 9), 3)
    depth[0, 4] = 0
    holed = depth.copy()
    holed[0, 4] = -1
    assert not visible(depth)[1, 0, 1][0, 2]
    lit = visible(holed)
    for got in lit.values():
        assert got[0].tolist() == [x != 4 for x in range(9)]


# -- lamps


def _free_segment(depth, x, y, step, end):
    """Whether no lattice node strictly before ``end`` steps is blocked, by going there."""
    rows, cols = depth.shape
    t = 1
    while t < end:
        px, py, n = x + t * step[0], y + t * step[1], depth[y, x] + t * step[2]
        if n < 0 or not (0 <= px < cols and 0 <= py < rows):
            return True
        if n > depth[py, px]:
            return False
        t += 1
    return True


@pytest.mark.parametrize(
    "lamp", [(5, 4, -6, 3), (3, 3, 1, 1.5), (6.25, 2.5, 0.5, 1.25), (-4, 3, 0, 2), (4, 4, 3, 2)], ids=str
)
def test_a_ball_is_seen_where_the_ray_meets_it_first(lamp):
    """Ray and ball by the distance of the centre from the ray, then a walk to the near side."""
    depth = np.random.default_rng(6).integers(2, 6, (8, 10))
    depth[4, 4] = 3
    centre, radius = np.array(lamp[:3], float), lamp[3]
    seen = 0
    for step, got in visible(depth, 5, "open", ball(*lamp)).items():
        line = np.array([step[0], step[1], -step[2]], float)
        unit = line / np.linalg.norm(line)
        for y in range(8):
            for x in range(10):
                to = centre - (x, y, depth[y, x])
                along = to @ unit
                away = np.sqrt(max(0, to @ to - along**2))
                if abs(away - radius) < 1e-9:
                    continue  # grazing: rounding decides
                meets = to @ to <= radius**2 or (along > 0 and away < radius)
                first = (
                    0
                    if to @ to <= radius**2
                    else (along - np.sqrt(max(0, radius**2 - away**2))) / np.linalg.norm(line)
                )
                expected = bool(meets and _free_segment(depth, x, y, line.astype(int), first))
                assert got[y, x] == expected, (step, y, x)
                seen += expected
    assert seen


def test_ground_behind_a_lamp_does_not_hide_it():
    """A wall between shades; the same wall beyond the ball does not."""
    depth = np.full((1, 12), 6)
    depth[0, 9] = 0
    east = lambda lamp: visible(depth, 3, "open", ball(*lamp))[1, 0, 0][0]
    assert east((6, 0, 6, 0.25)).tolist() == [x <= 6 for x in range(12)]
    assert east((11, 0, 6, 0.25)).tolist() == [False] * 9 + [
        False,
        True,
        True,
    ]  # column 9 stands at z = 0, and its level ray passes above


def test_a_lamp_outside_a_dark_box_is_seen_through_its_opening_only():
    """A ball behind z = 0, off the map: open sides see it, a box only where rays leave through z = 0."""
    depth = np.full((1, 9), 2)
    lamp = ball(12, 0, -4, 0.5)  # on the ray (1, 0, -1) from column 6: 6 steps of 1 up
    assert visible(depth, 3, "open", lamp)[1, 0, 1][0].tolist() == [x == 6 for x in range(9)]
    assert visible(depth, 3, "dark", lamp)[1, 0, 1][0].tolist() == [
        x == 6 for x in range(9)
    ]  # leaves at column 8 < 8.5
    assert not visible(depth[:, :8], 3, "dark", lamp)[1, 0, 1].any()  # leaves at column 8 >= 7.5
    assert visible(depth[:, :8], 3, "open", lamp)[1, 0, 1][0, 6]


def test_a_volume_shines_from_its_nodes():
    """From inside in every direction; from outside along the lattice only; a buried node not at all."""
    depth = np.full((3, 9), 4)
    flags = np.zeros((5, 3, 9), np.uint8)
    flags[2, 1, 6] = 1
    flags[4, 1, 0] = 1
    lit = visible(depth, 3, "open", Geometry(VOLUME, np.zeros(4), flags))
    for step, got in lit.items():
        assert got[1, 0], step  # the node shines itself
    assert np.argwhere(lit[1, 0, 1]).tolist() == [[1, 0], [1, 4]]
    assert np.argwhere(lit[0, 0, 1]).tolist() == [[1, 0], [1, 6]]
    assert np.argwhere(lit[-1, 0, 0]).tolist() == [[1, x] for x in range(9)]
    around = visible(depth, 3, "periodic", Geometry(VOLUME, np.zeros(4), flags))
    assert around[1, 0, 0][1].all() and not around[1, 0, 0][[0, 2]].any()


# -- filled


def _crossed(depth, x, y, step):
    """Whether the ray passes below the surface at a grid line, in fractions, from crossing to crossing."""
    rows, cols = depth.shape
    i, j, k = step
    times = {Fraction(c - x, i) for c in range(cols) if i} | {Fraction(r - y, j) for r in range(rows) if j}
    for t in sorted(t for t in times if t > 0):
        px, py = x + t * i, y + t * j
        c, r = px.numerator // px.denominator, py.numerator // py.denominator
        c2, r2 = c + (px != c), r + (py != r)
        if c < 0 or r < 0 or c2 >= cols or r2 >= rows:
            continue
        part = px - c if px != c else py - r
        if (1 - part) * int(depth[r, c]) + part * int(depth[r2, c2]) < int(depth[y, x]) - t * k:
            return True
    return False


@pytest.mark.slow
def test_filled_visibility_looks_at_every_crossing():
    """Against crossings in exact fractions, on a map that is taller than wide."""
    depth = np.random.default_rng(12).integers(0, 7, (9, 6))
    cube = sl.Hemicube(7)
    got = oracle.filled_visibility(depth.astype(float), 1.0, cube.steps, "open")
    expected = np.array(
        [
            [[not _crossed(depth, x, y, (i, j, -up)) for i, j, up in cube.steps.tolist()] for x in range(6)]
            for y in range(9)
        ]
    )
    assert_bits_equal(got, expected)
    stride = oracle.surface_visibility(depth, cube.steps, "open", OPEN_SKY)
    assert (stride & ~got).sum() > 50, "the map does not leak, so the test says little"
    assert not (got & ~stride).any(), "filled tests the nodes too"


def test_filled_and_stride_are_the_same_where_steps_are_of_one_node():
    """M = 3: all crossings are nodes."""
    depth = np.random.default_rng(13).integers(0, 7, (9, 8))
    cube = sl.Hemicube(3)
    for sides in ("open", "dark", "periodic"):
        assert_bits_equal(
            oracle.filled_visibility(depth.astype(float), 1.0, cube.steps, sides),
            oracle.surface_visibility(depth, cube.steps, sides, OPEN_SKY),
        )


# -- luminance, normals


@pytest.mark.parametrize("size", [3, 9])
@pytest.mark.parametrize("slope", [(0, 0), (1, 0), (0.5, -2)])
def test_luminance_of_an_open_plane_is_the_closed_form(size, slope):
    """pi (1 + cos a) / 2: exact where level, within the cells that the tangent plane cuts where tilted."""
    normal = np.array([*slope, -1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    cube = sl.Hemicube(size)
    everything = np.ones((2, 3, len(cube)), bool)
    got = oracle.luminance(everything, np.broadcast_to(normal, (2, 3, 3)), np.ones(len(cube)), cube.moments)
    wanted = np.pi * (1 + 1 / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)) / 2
    assert np.abs(got - wanted).max() <= (1e-12 if slope == (0, 0) else {3: 0.12, 9: 0.012}[size] * np.pi)
    assert (
        oracle.luminance(
            ~everything, np.broadcast_to(normal, (2, 3, 3)), np.ones(len(cube)), cube.moments
        ).max()
        == 0
    )


def test_gradient_by_hand():
    """Central inside, one-sided at the border and beside a hole, zero where alone; spacing divides."""
    z = np.array([[0.0, 2.0, 6.0, 1.0], [5.0, 5.0, 5.0, 5.0]])
    valid = np.array([[True, True, True, False], [True, False, True, False]])
    gx, gy = oracle.gradient(z, 2.0, valid)
    assert gx.tolist() == [[1.0, 1.5, 2.0, 0.0], [0.0, 0.0, 0.0, 0.0]]
    assert gy.tolist() == [[2.5, 0.0, -0.5, 0.0], [2.5, 0.0, -0.5, 0.0]]
    normal = oracle.normals(np.arange(12.0).reshape(3, 4), 1.0, np.ones((3, 4), bool))
    assert np.allclose(normal, np.array([1, 4, -1]) / np.sqrt(18))


def test_gradient_goes_round_a_map_that_repeats():
    """By hand: at the border as inside, one-sided only beside a hole; zero for two nodes alone."""
    z = np.array([[0.0, 2.0, 6.0, 1.0], [5.0, 5.0, 5.0, 5.0], [3.0, 9.0, 4.0, 7.0]])
    valid = np.array([[True, True, True, True], [True, False, True, True], [True, True, True, True]])
    gx, gy = oracle.gradient(z, 2.0, valid, "periodic")
    assert gx.tolist() == [[0.25, 1.5, -0.25, -1.5], [0.0, 0.0, 0.0, 0.0], [0.5, 0.25, -0.5, -0.25]]
    assert gy.tolist() == [[0.5, -3.5, 0.25, -0.5], [0.75, 0.0, -0.5, 1.5], [-1.25, -3.5, 0.25, -1.0]]
    two = np.array([[1.0, 4.0]])
    assert not np.any(oracle.gradient(two, 1.0, two > 0, "periodic"))
    assert oracle.gradient(two, 1.0, two > 0)[0].tolist() == [[3.0, 3.0]]


# -- carving


def _carve_row(low, high, stop="eps", layers=6):
    """A row under light from above and from both sides at 45 degrees, weights 1, 2 and 4, dark sides."""
    steps = np.array([[-1, 0, -1], [0, 0, -1], [1, 0, -1]])
    return oracle.carve(
        np.array([low]), np.array([high]), np.array([2, 1, 4]), steps, "dark", OPEN_SKY, layers, stop
    )[0].tolist()


def test_carving_a_trench_by_hand():
    """Five columns in a dark box; the middle one asks for the light of its bottom at depth 2.

    At n = 0 every ray leaves at its own node: all see 7. Columns that ask for 7 stop; the middle one asks for
    1. At n = 1 its rays at 45 degrees come from columns 1 and 3 at layer 0, which are free: 7 again. At n = 2
    they pass through columns 1 and 3 at layer 1, below the surface: 1.
    """
    assert _carve_row([7, 7, 1, 7, 7], [7, 7, 1, 7, 7]) == [0, 0, 2, 0, 0]
    assert _carve_row([7, 7, 3, 7, 7], [7, 7, 3, 7, 7]) == [
        0,
        0,
        6,
        0,
        0,
    ]  # never so bright again: drilled through
    assert _carve_row([7, 7, 3, 7, 7], [7, 7, 3, 7, 7], "sign") == [
        0,
        0,
        2,
        0,
        0,
    ]  # passed between n = 1 and n = 2
    assert _carve_row([7, 7, 0, 7, 7], [7, 7, 1, 7, 7]) == [0, 0, 2, 0, 0]
    assert _carve_row([9] * 5, [9] * 5) == [6] * 5


def test_carving_a_box_by_hand():
    """All five ask to go down: walls shade the outer columns first; what was carved is free for the rest.

    At depth n the ray (1, 0, -1) leaves the box from columns x + n < 4.5: at n = 1 column 4 loses weight 4
    and column 0 weight 2; at n = 2 columns 3 and 4 lose 4, columns 0 and 1 lose 2.
    """
    assert _carve_row([5, 5, 0, 3, 3], [5, 5, 0, 3, 3]) == [1, 2, 6, 2, 1]
