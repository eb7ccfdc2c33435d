"""Hemicubes and the closed forms of radiometry."""

import numpy as np
import pytest
from compare import assert_bits_equal

import skylamp as sl
from skylamp.radiometry import polygon_moment, rectangle_solid_angle

SIZES = [3, 5, 7, 9, 17, 33]


@pytest.mark.parametrize("size", SIZES)
def test_a_hemicube_covers_the_hemisphere_once(size):
    """Count, solid angles and moments in closed form; cells that overlap or leave gaps would not add up."""
    cube = sl.Hemicube(size)
    m = (size - 1) // 2
    assert len(cube) == cube.steps.shape[0] == size**2 + 8 * m**2
    assert cube.reach == m and cube.words == -(-len(cube) // 32)
    assert abs(cube.solid_angles.sum() - 2 * np.pi) < 1e-12
    assert np.abs(cube.moments.sum(0) - (0, 0, -np.pi)).max() < 1e-12
    assert cube.solid_angles.min() > 0


@pytest.mark.parametrize("size", SIZES)
def test_steps_are_the_surface_nodes_of_the_half_cube(size):
    """Every node with L_z <= 0 once, unit vectors along them, ordered by (k, j, i)."""
    cube = sl.Hemicube(size)
    m = cube.reach
    wanted = [
        (i, j, -k)
        for k in range(m + 1)
        for j in range(-m, m + 1)
        for i in range(-m, m + 1)
        if max(abs(i), abs(j), k) == m
    ]
    assert [tuple(s) for s in cube.steps.tolist()] == wanted
    assert np.allclose(np.linalg.norm(cube.directions, axis=1), 1, rtol=0, atol=1e-15)
    assert (
        np.allclose(np.cross(cube.directions, cube.steps), 0, atol=1e-12)
        and ((cube.directions * cube.steps).sum(1) > 0).all()
    )


@pytest.mark.parametrize("size", [3, 9])
def test_cells_have_the_symmetry_of_the_cube(size):
    """Transposing and mirroring permute solid angles and moments; a face with swapped axes would fail."""
    cube = sl.Hemicube(size)
    number = {tuple(step): d for d, step in enumerate(cube.steps.tolist())}
    for change in (lambda v: v[:, [1, 0, 2]], lambda v: v * [-1, 1, 1], lambda v: v * [1, -1, 1]):
        order = [number[tuple(step)] for step in change(cube.steps).tolist()]
        assert np.allclose(cube.solid_angles[order], cube.solid_angles, rtol=0, atol=1e-14)
        assert np.allclose(cube.moments[order], change(cube.moments), rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("size", [3, 5, 9])
def test_every_cell_agrees_with_quadrature_over_the_nearest_node(size):
    """Midpoint quadrature of dOmega and L dOmega over the cube's faces, by the nearest node."""
    cube = sl.Hemicube(size)
    m, n = cube.reach, 64 * 2 * cube.reach
    edge = (np.arange(n) + 0.5) / n * 2 * m - m
    u, v = (a.ravel() for a in np.meshgrid(edge, edge))
    area = (2 * m / n) ** 2
    solid_angle, moment = np.zeros(len(cube)), np.zeros((len(cube), 3))
    number = {tuple(step): d for d, step in enumerate(cube.steps.tolist())}
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, -1)):
        point = np.empty((len(u), 3))
        point[:, axis] = sign * m
        point[:, [a for a in range(3) if a != axis]] = np.stack([u, v], 1)
        point = point[point[:, 2] <= 0]
        r = np.linalg.norm(point, axis=1)
        d_omega = m * area / r**3
        owner = np.array([number[tuple(p)] for p in np.rint(point).astype(int).tolist()])
        np.add.at(solid_angle, owner, d_omega)
        np.add.at(moment, owner, point / r[:, None] * d_omega[:, None])
    assert np.abs(solid_angle / cube.solid_angles - 1).max() < 1e-3
    assert np.abs(moment - cube.moments).max() < 1e-3 * cube.solid_angles.max()


@pytest.mark.parametrize("size", [3, 5, 7, 9, 17])
def test_packed_bits_stand_where_the_design_says(size):
    """Direction d is bit d % 32 of word d // 32; unpacking undoes packing, and spare bits are 0."""
    cube = sl.Hemicube(size)
    flags = np.random.default_rng(size).random((5, 3, len(cube))) < 0.5
    bits = cube.pack(flags)
    assert bits.dtype == np.uint32 and bits.shape == (5, 3, cube.words)
    by_hand = np.zeros((5, 3, 32 * cube.words), bool)
    for d in range(32 * cube.words):
        by_hand[..., d] = bits[..., d // 32] >> np.uint32(d % 32) & 1
    assert_bits_equal(by_hand[..., : len(cube)].copy(), flags)
    assert not by_hand[..., len(cube) :].any()
    assert_bits_equal(cube.unpack(bits), flags)
    assert_bits_equal(cube.unpack(bits[::2, ::-1]), flags[::2, ::-1].copy())


@pytest.mark.parametrize("u", [(-1.0, 2.0), (0.5, 0.75), (-3.0, -1.0)])
@pytest.mark.parametrize("v", [(-0.5, 0.5), (1.0, 4.0)])
@pytest.mark.parametrize("distance", [0.3, 2.0])
def test_rectangle_solid_angle_and_moment_agree_with_quadrature(u, v, distance):
    """The foot of the perpendicular inside, outside, and off to every side."""
    n = 800
    us, vs = (np.linspace(*w, n, endpoint=False) + (w[1] - w[0]) / (2 * n) for w in (u, v))
    x, y = np.meshgrid(us, vs)
    r = np.sqrt(x**2 + y**2 + distance**2)
    d_omega = distance / r**3 * (u[1] - u[0]) * (v[1] - v[0]) / n**2
    assert rectangle_solid_angle(*u, *v, distance) == pytest.approx(d_omega.sum(), rel=2e-5)
    corners = np.array(
        [[u[0], v[0], distance], [u[1], v[0], distance], [u[1], v[1], distance], [u[0], v[1], distance]]
    )
    wanted = [(c / r * d_omega).sum() for c in (x, y, distance)]
    assert polygon_moment(corners) == pytest.approx(wanted, rel=2e-5, abs=2e-5 * max(wanted))
    assert_bits_equal(polygon_moment(corners), polygon_moment(corners.copy()))
    assert polygon_moment(corners[::-1]) == pytest.approx(
        wanted, rel=2e-5, abs=2e-5 * max(wanted)
    )  # either sense of rotation


def test_the_tables_of_a_hemicube_cannot_be_written_to():
    """They are shared by all users of the process."""
    cube = sl.Hemicube(5)
    for table in (cube.steps, cube.directions, cube.solid_angles, cube.moments):
        with pytest.raises(ValueError):
            table[0] = 0


@pytest.mark.parametrize(
    "call",
    [
        lambda cube: cube.pack(np.zeros((3, 7), bool)),
        lambda cube: cube.pack(np.ones((3, 1), bool)),
        lambda cube: cube.pack(True),
        lambda cube: cube.unpack(np.zeros((3, 1), np.uint32)),
        lambda cube: cube.unpack(np.zeros((3, 7), float)),
        lambda cube: cube.unpack(0),
    ],
)
def test_bits_of_another_hemicube_are_refused(call):
    """Bits and words must be those of all directions."""
    with pytest.raises(sl.InputError, match="hemicube: "):
        call(sl.Hemicube(9))


def test_mirrored_sectors():
    """In the axes of a map: from west to east, from south to north, or both, in order of their angles."""
    sectors = sl.Azimuths(3, (0.0, 0.5, 1.5, 2 * np.pi))
    assert sectors.on_axes((1.0, 1.0)) is sectors
    for axes in ((-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        found, by = sectors.on_axes(axes), np.array(axes)
        for angle, width in zip(found.angles, found.widths):
            way = by * [np.cos(angle), np.sin(angle)]
            there = np.stack([np.cos(sectors.angles), np.sin(sectors.angles)], 1)
            n = int(np.argmin(np.abs(there - way).max(1)))
            np.testing.assert_allclose(there[n], way, atol=1e-12)
            assert sectors.widths[n] == pytest.approx(width)
