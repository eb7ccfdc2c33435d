"""Light of balls, rectangles and windows through slices: closed forms, oracle's shadow rays, all backends."""

import functools
import importlib
import math

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal
from scenes import resident_map, rough

import skylamp as sl
from skylamp import constants, oracle
from skylamp.light import unoccluded
from skylamp.light.horizon import COPIED
from skylamp.radiometry import disc_moment, polygon_moment, rectangle_solid_angle
from skylamp.sources import solids
from skylamp.sources.cie import towards
from skylamp.sources.integrals import Integrals
from skylamp.sources.tables import diamond, elevation_of

slices = importlib.import_module("skylamp.light.slices")
UP = np.array([0.0, 0.0, -1.0])
NODES = (np.array([0, 7, 7, 12]), np.array([0, 3, 9, 16]))


@functools.cache
def lit(light):
    """A function of directions as Slices takes it."""
    return table_of(light, 2048, 1025)


def table_of(light, turns, knots):
    """Integrals along chords, nothing taken apart."""
    return Integrals(sl.Sky(light), math.inf, True).chords(turns, knots)


def made(backend, depth, solid, light=1.0, step=1.0, sides="open", **options):
    """Slices that have run; ``light``: a number, a function of directions, or a table of chords."""
    run = slices.Slices(
        resident_map(backend, depth, step), sides, solid, lit(light) if callable(light) else light, **options
    )
    run.run()
    return run


def image(*args, **options):
    """Irradiance (rows, cols) float32."""
    return made(*args, **options).download()


def slanted(shape, gx, gy, z=30.0):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return z + gx * x + gy * y, np.array([gx, gy, -1]) / math.sqrt(1 + gx**2 + gy**2)


def places(depth, spacing=1.0, nodes=NODES):
    """(n, 3) positions of nodes."""
    return np.stack([nodes[1] * spacing, nodes[0] * spacing, np.asarray(depth, float)[nodes]], -1)


def near(got, wanted, share):
    """Within a share of each wanted value."""
    np.testing.assert_allclose(got.astype(float), wanted, rtol=share, atol=1e-12)


def walled(rows=41, cols=45, floor=12.0, top=4.0, at=22):
    """A level floor with a wall one node wide along column ``at``."""
    depth = np.full((rows, cols), floor)
    depth[:, at] = top
    return depth


def cut(polygon, normal):
    """The part of a polygon (n, 3) on the upper side of a plane through the origin."""
    out = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0)):
        ha, hb = a @ normal, b @ normal
        out += [a] if ha >= 0 else []
        out += [a + (b - a) * ha / (ha - hb)] if ha * hb < 0 else []
    return np.array(out)


def of_polygon(corners, eyes, *planes):
    """Lambert's formula for the part above every plane through each eye; the first is the surface's own."""
    out = []
    for eye in eyes:
        part = np.asarray(corners, float) - eye
        for plane in planes:
            part = cut(part, plane) if len(part) else part
        out.append(polygon_moment(part) @ planes[0] if len(part) else 0.0)
    return np.array(out)


# --- balls


@pytest.mark.slow
@pytest.mark.parametrize(("gx", "gy"), [(0, 0), (0.5, -0.3)])
def test_a_ball_above_the_plane(backend, gx, gy):
    """pi (R / d)^2 cos: close by, overhead, behind the viewer, and as small as a star; in any unit."""
    for lamp in (
        (8, 6, 5, 4),
        (9, 7, 2, 9),
        (-9, 20, -15, 7),
        (100, 100, -200, 1.5),
        (300, -500, -2000, 0.2),
    ):
        for spacing in (1.0, 0.5):
            depth, normal = slanted((13, 17), gx, gy)
            to = (np.array(lamp[:3]) - places(depth)) * spacing
            far = np.linalg.norm(to, axis=1)
            assert (to @ normal > lamp[3] * spacing).all(), "partly below the tangent plane"
            ball = slices.Ball(tuple(np.array(lamp[:3]) * spacing), lamp[3] * spacing)
            got = image(backend, depth * spacing, ball, step=spacing)[NODES]
            near(got, np.pi * (lamp[3] * spacing / far) ** 2 * (to @ normal) / far, 5e-4)


def test_a_half_set_ball(backend):
    """Cut by the level, which is the tangent plane too; wholly below it, nothing."""
    depth = np.full((13, 17), 10.0)
    for lamp in ((25, 6, 10, 5), (24, 5, 12, 6), (22, 6, 8, 5)):
        to = np.array(lamp[:3]) - places(depth)
        far = np.linalg.norm(to, axis=1)
        assert (abs(to[:, 2]) < lamp[3]).all()
        near(
            image(backend, depth, slices.Ball(lamp[:3], lamp[3]))[NODES],
            disc_moment(to / far[:, None], lamp[3] / far, UP) @ UP,
            1e-3,
        )
    assert not image(backend, depth, slices.Ball((25, 6, 15), 5)).any()


def test_a_node_inside_the_ball(backend):
    """All round, and nothing stands before it, not even the wall beside."""
    depth = np.full((13, 17), 10.0)
    depth[:, 4] = 7.0
    for sides in ("open", "dark"):
        assert image(backend, depth, slices.Ball((7, 6, 9), 6), sides=sides)[6, 6] == pytest.approx(
            np.pi, rel=1e-5
        )
    depth, normal = slanted((13, 17), 1.0, 0.5)
    assert image(backend, depth, slices.Ball((8, 6, 38), 6))[6, 8] == pytest.approx(
        np.pi * (1 - normal[2]) / 2, rel=2e-3
    )


def test_the_penumbra_of_a_ball(backend):
    """Behind a straight edge: the disc's part above the plane through node and edge, from dark to light."""
    spacing = 0.5
    lamp = np.array([34.0, 20.0, -4.0, 3.0]) * spacing
    depth = walled() * spacing
    nodes = (np.full(20, 20), np.arange(20))
    to = lamp[:3] - places(depth, spacing, nodes)
    far = np.linalg.norm(to, axis=1)
    edge = np.stack([np.full(20, 4.0 - 12), np.zeros(20), -(22.0 - nodes[1])], -1) * spacing
    above = edge / np.linalg.norm(edge, axis=1)[:, None]
    height = (to * above).sum(1) / lamp[3]
    full = disc_moment(to / far[:, None], lamp[3] / far) @ UP
    wanted = np.where(
        height <= -1,
        0,
        np.where(height >= 1, full, disc_moment(to / far[:, None], lamp[3] / far, above) @ UP),
    )
    partly = (height > -1) & (height < 1)
    for most, bound in ((32, 4e-3), (64, 1e-3), (128, 5e-4)):
        got = image(backend, depth, slices.Ball(tuple(lamp[:3]), lamp[3]), step=spacing, most=most)[nodes]
        np.testing.assert_allclose(got, wanted, atol=bound * wanted.max())
        assert (
            partly.sum() >= 10 and (np.diff((got / full)[partly]) < 0).all() and not got[height < -1.1].any()
        )


def test_ground_in_and_behind_a_ball(backend):
    """A ball through a wall: its part before the wall shines as without it, and that behind does not."""
    depth = walled(floor=12.0, top=2.0)
    nodes = ([20], [8])
    for ball in (slices.Ball((20, 20, 6), 4.0), slices.Ball((14, 20, 7), 2.0)):
        clear = image(backend, np.full_like(depth, 12.0), ball)[nodes]
        near(image(backend, depth, ball)[nodes], clear.astype(float), 1e-3)
    assert image(backend, depth, slices.Ball((31, 20, 8), 3.0))[nodes] == 0


def test_two_halves_of_a_balls_slices(backend):
    """The two images agree where nothing hides the ball, differ in a penumbra, and are 0 in the umbra."""
    lamp, floor, depth = slices.Ball((34.0, 20.0, -4.0), 3.0), np.full((41, 45), 12.0), walled()
    clear = image(backend, floor, lamp)
    for row in (12, 20):
        nodes = np.full(20, row), np.arange(20)
        to = np.array(lamp.center) - places(depth, nodes=nodes)
        edge = np.stack([np.full(20, 4.0 - 12), np.zeros(20), -(22.0 - np.arange(20))], -1)
        height = (
            (to * edge).sum(1) / np.linalg.norm(edge, axis=1) / lamp.radius
        )  # of its centre above the plane through node and edge
        free, dark, partly = height > 1.02, height < -1.02, np.abs(height) < 1
        assert free.sum() >= 2 and dark.sum() >= 2 and partly.sum() >= 10
        images = []
        for shift in (0.5, 0.0):
            run = made(backend, floor, lamp, shift=shift)
            np.testing.assert_allclose(run.download(), clear, rtol=1e-4)
            assert (np.abs(run.backend.download(run.alternating)) < 1e-3 * clear).all()
            run = made(backend, depth, lamp, shift=shift)
            share, off = (
                value[nodes] / clear[nodes]
                for value in (run.download(), np.abs(run.backend.download(run.alternating)))
            )
            images.append(share)
            np.testing.assert_allclose(share[free], 1, rtol=1e-4)
            assert off[free].max() < 1e-3 and not off[dark].any() and not share[dark].any()
            if (row, shift) == (20, 0.5):
                assert off.max() < 1e-6
            else:
                assert 5e-3 < off[partly].max() < 0.02
        apart = np.abs(images[0] - images[1])
        assert apart[free].max() < 1e-4 and 1e-3 < apart[partly].max() < 0.01


# --- rectangles and windows


RECTANGLES = {
    "above": ((4, 3, 12), (8, 0, 0), (0, 6, 0)), "slanted": ((3, 9, 4), (9, 2, 1), (0, -1, 2)),
    "aside": ((30, -4, 2), (0, 20, 0), (6, 0, -8)), "on edge": ((20, 6, 3), (0, 7, 0), (0, 0, 5)),
    "small and far": ((200, 300, -400), (0.3, 0, 0), (0, 0.1, 0.2)),
}  # fmt: skip


@pytest.mark.parametrize("name", RECTANGLES)
def test_a_rectangle_above_the_plane(backend, name):
    """Lambert's formula; both faces shine, whatever the corners' order."""
    corner, u, v = RECTANGLES[name]
    for gx, gy in ((0, 0), (0.3, -0.2)):
        depth, normal = slanted((13, 17), gx, gy, z=20.0)
        quad = solids.rectangle(corner, u, v)
        wanted = of_polygon(quad.corners, places(depth), normal, UP)
        assert (wanted > 0).all()
        near(image(backend, depth, quad)[NODES], wanted, 1e-3)
    near(image(backend, depth, solids.rectangle(corner, v, u))[NODES], wanted, 1e-3)


def test_a_rectangle_seen_on_edge(backend):
    """Nothing from its own plane, and only what rises above the level."""
    depth = np.full((13, 17), 10.0)
    assert not image(backend, depth, solids.rectangle((6, 7, 2), (8, 0, 0), (0, 0, 5)))[7].any()
    assert not image(backend, depth, solids.rectangle((6, 7, 2), (8, 0, 0), (0, 0, 9)))[7].any()
    for most in (32, 128):  # from its corner, and with an edge overhead
        got = image(backend, depth, solids.rectangle((6, 7, 10), (2, 3, 0), (0, 0, -4)), most=most)
        assert np.isfinite(got).all() and got.max() < 4
    low = solids.rectangle((3, 4, 7), (9, 0, 0), (0, 0, 6))
    near(image(backend, depth, low)[NODES], of_polygon(low.corners, places(depth), UP), 2e-3)


@pytest.mark.parametrize(
    ("x", "y"),
    [((4.25, 9), (3, 8.5)), ((-30, -12), (5, 60)), ((-5000, 6000), (-3000, 9000)), ((8, 8.01), (6, 6.01))],
)
def test_a_window_over_the_plane(backend, x, y):
    """Parallel, tilted, above, across, very large, a pinhole; a plane that cuts it needs more slices."""
    for gx, gy in ((0, 0), (0.3, -0.4)):
        depth, normal = slanted((13, 17), gx, gy, z=9.0)
        window = solids.aperture(x, y, depth.shape, 1.0, "open", 30.0)
        wanted = of_polygon(window.corners, places(depth), normal)
        np.testing.assert_allclose(
            image(backend, depth, window)[NODES], wanted, rtol=2e-3, atol=0.02 * wanted.max() if gx else 0
        )
        near(image(backend, depth, window, most=64)[NODES], wanted, 4e-3)


def test_a_node_in_the_window(backend):
    """In its plane the whole sky or none; a hair below it, half the sky on an edge, a quarter on a corner."""
    nodes = (np.array([7, 7, 7, 8, 6]), np.array([3, 8, 9, 5, 5]))
    window = lambda x, y: solids.aperture(x, y, (13, 17), 1.0, "open", 30.0)
    near(
        image(backend, np.zeros((13, 17)), window((2.5, 8.5), (6.5, 7.5)))[nodes],
        np.pi * np.array([1.0, 1, 0, 0, 0]),
        1e-5,
    )
    shallow = np.full((13, 17), 1e-4)
    got = image(backend, shallow, window((3, 9), (7, 8)))[nodes]
    np.testing.assert_allclose(
        got, of_polygon(window((3, 9), (7, 8)).corners, places(shallow, nodes=nodes), UP), atol=5e-3
    )


def test_the_shadow_of_an_edge_in_a_window(backend):
    """Lambert's polygon, cut by the plane through node and edge."""
    depth = walled()
    nodes = (np.full(10, 20), np.arange(0, 20, 2))
    window = solids.aperture((25, 44), (12, 31), depth.shape, 1.0, "open", 30.0)
    wanted = np.array(
        [
            of_polygon(window.corners, [eye], UP, np.array([4.0 - 12, 0, -(22 - eye[0])]))[0]
            for eye in places(depth, nodes=nodes)
        ]
    )
    for most, bound in ((32, 6e-3), (64, 2e-3), (128, 1e-3)):
        np.testing.assert_allclose(
            image(backend, depth, window, most=most)[nodes], wanted, atol=bound * wanted.max()
        )
    assert wanted[0] > 0 and wanted[-1] == 0


# --- brightness


@pytest.mark.slow
def test_a_small_lamp_shines_with_the_brightness_of_its_direction(backend):
    """B(L) pi (R / d)^2 cos for a spot cos^16; overhead, where knots are far apart, their mean."""
    depth = np.full((13, 17), 30.0)
    spot = sl.cosine_power(16, axis=(0.3, 0.1, 1), brightness=2.0)
    for center, radius, bound in (((4, 5, -20), 0.05, 0.015), ((14, 9, 10), 0.1, 2e-3)):
        to = np.array(center) - places(depth)
        far = np.linalg.norm(to, axis=1)
        wanted = spot(to / far[:, None]) * np.pi * (radius / far) ** 2 * -to[:, 2] / far
        np.testing.assert_allclose(
            image(backend, depth, slices.Ball(center, radius), spot)[NODES],
            wanted,
            rtol=bound,
            atol=bound * wanted.max(),
        )


@pytest.mark.slow
@pytest.mark.parametrize("azimuths", [64, 128, None])
def test_a_small_sun_through_a_window_is_whole_in_as_many_slices_as_asked(backend, azimuths):
    """Slices alone met or missed it: 0 to 7 times its light."""
    sun = np.array([0.4, 0.3, -0.866]) / np.linalg.norm([0.4, 0.3, -0.866])
    edge = np.cos(np.radians(0.27))
    window = sl.Window((10, 46), (10, 46), lambda L: (L @ sun > edge) / (np.pi * (1 - edge**2)))
    more = {} if azimuths is None else {"azimuths": azimuths}
    scene = sl.Scene(np.full((56, 56), 20.0))
    image = sl.render(scene, window, "horizon", quantity="irradiance", backend=backend, **more).image
    np.testing.assert_allclose(image[8:30, 6:30], -sun[2], rtol=1e-3)
    assert not image[40:].any()


@pytest.mark.slow
def test_the_brightness_of_a_window(backend):
    """B = 1 / cosine gives the solid angle."""
    depth = np.full((13, 17), 9.0)
    eyes = places(depth)
    wanted = rectangle_solid_angle(3 - eyes[:, 0], 10 - eyes[:, 0], 2 - eyes[:, 1], 11 - eyes[:, 1], 9.0)
    got = image(
        backend,
        depth,
        solids.aperture((3, 10), (2, 11), depth.shape, 1.0, "open", 30.0),
        lambda L: 1 / np.maximum(-L[..., 2], 0.01),
    )[NODES]
    near(got, wanted, 2e-3)


def within_cone(axis, radius, rings=200, spokes=400):
    """Directions (n, 3) evenly through a cone round a unit vector, and the solid angle of each."""
    cosine = 1 - (1 - math.cos(radius)) * (np.arange(rings) + 0.5)[:, None] / rings
    turn = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    u = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.7 else [0, 1.0, 0])
    u /= np.linalg.norm(u)
    off = np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * np.cross(axis, u)
    L = cosine[..., None] * axis + np.sqrt(1 - cosine**2)[..., None] * off
    return L.reshape(-1, 3), 2 * np.pi * (1 - math.cos(radius)) / (rings * spokes)


def stripes(L):
    return ((20 * L[..., 0]) % 1 < 0.5).astype(float)


@pytest.mark.slow
def test_a_window_with_stripes(backend):
    """Stripes far narrower than the window, against quadrature: samples along a chord would miss them."""
    depth = np.full((13, 17), 9.0)
    x, y = (4.0, 15.0), (3.0, 12.0)
    u, v = (a + (b - a) * (np.arange(1500) + 0.5) / 1500 for a, b in (x, y))
    got = image(backend, depth, solids.aperture(x, y, depth.shape, 1.0, "open", 30.0), stripes, most=256)[
        NODES
    ]  # half as many leave 2 % near a node below
    for value, eye in zip(got, places(depth)):
        to = np.stack(np.broadcast_arrays(u - eye[0], (v - eye[1])[:, None], -9.0), -1)
        square = (to * to).sum(-1)
        light = stripes(to / np.sqrt(square)[..., None]) * 81 / square**2
        assert value == pytest.approx(light.mean() * 11 * 9, rel=5e-3)


@pytest.mark.slow
def test_a_beam_narrower_than_its_lamp(backend):
    """cos^900 from a ball by 64 slices, in the beam's middle and on its flank, against quadrature."""
    ball = slices.Ball((14.0, 9.0, -16.0), 4.0)
    for gx, gy in ((0, 0), (0.3, -0.2)):
        depth, normal = slanted((13, 17), gx, gy, z=20.0)
        axis = places(depth, nodes=(np.array([7]), np.array([6])))[0] - ball.center
        beam = sl.cosine_power(900, axis=axis)
        nodes = (np.array([7, 7, 6, 8]), np.array([6, 7, 5, 6]))
        wanted = []
        for eye in places(depth, nodes=nodes):
            to = np.array(ball.center) - eye
            far = np.linalg.norm(to)
            L, angle = within_cone(to / far, math.asin(ball.radius / far))
            wanted.append((beam(L) * (L @ normal)).sum() * angle)
        near(image(backend, depth, ball, beam, most=64)[nodes], np.array(wanted), 0.006)


def test_the_table_of_chords():
    """Closed forms at every knot; each azimuth has its own brightness, in the order of the diamond angle."""
    turns, knots = 64, 33
    s = np.arange(knots) / (knots - 1)
    t = np.arcsin(s)
    table = table_of(lambda L: 3 - L[..., 2] * 0, turns, knots)
    assert table.shape == (turns, knots, 2) and table.dtype == np.float32
    np.testing.assert_allclose(
        table[5], 3 * np.stack([np.pi / 2 - t - np.sin(t) * np.cos(t), 1 - s**2], -1) / 2, atol=5e-6
    )  # linear within cells
    quarter = lambda L: np.select(
        [(L[..., 0] >= 0) & (L[..., 1] >= 0), L[..., 1] >= 0, L[..., 0] < 0], [1.0, 2.0, 3.0], 4.0
    )
    table = table_of(quarter, turns, knots)
    wanted, inner = (
        np.repeat([0.5, 1, 1.5, 2], turns // 4),
        abs(np.arange(turns) % (turns // 4) - (turns // 4 - 1) / 2) < turns // 8 - 2,
    )
    np.testing.assert_allclose(table[inner, 0, 1], wanted[inner], rtol=1e-5)
    np.testing.assert_allclose(
        table[~inner, 0, 1], wanted[~inner], atol=0.08
    )  # cells of the sky lie across the borders, and those beside are sharpened
    assert table[:, 0, 1].sum() == pytest.approx(wanted.sum(), rel=2e-3)


def test_brightness_goes_evenly_from_turn_to_turn(backend):
    """Rows of the table count at the middles of their cells, the last next to the first: by a tiny lamp."""
    depth, turns, knots = np.full((13, 17), 30.0), 8, 33
    even = table_of(lambda L: np.ones(L.shape[:-1]), turns, knots)
    middle = (np.arange(turns) + 0.5) * 4 / turns
    for q in (0.0, 0.1, 0.2, 0.6, 1.3, 2.9, 3.5, 3.9):
        x, y = 1 - q if q < 2 else q - 3, q if q < 1 else 2 - q if q < 3 else q - 4
        lamp = slices.Ball((8 + 1e5 * x, 6 + 1e5 * y, -1e5), 10.0)
        got, one = (image(backend, depth, lamp, light)[6, 8] for light in (middle[:, None, None] * even, 1.0))
        assert got / one == pytest.approx(np.interp(q, middle, middle, period=4), rel=1e-4)


def test_the_map_of_brightness():
    """Each sample stands for its direction; a function that is the same everywhere is a number."""
    side = 9
    values = slices.stereographic_brightness(
        sl.Sky(brightness=lambda L: 5 + L @ np.array([1.0, 2.0, 3.0])), side
    )
    assert values.shape == (side, side)
    assert (
        values[4, 4] == pytest.approx(5 - 3)
        and values[4, 8] == pytest.approx(5 + 1)
        and values[0, 4] == pytest.approx(5 - 2)
    )
    assert values[8, 8] == pytest.approx(5 + 3 / math.sqrt(2))  # beyond the level
    u = v = 0.5
    L = np.array([2 * u, 2 * v, -(1 - u * u - v * v)]) / (1 + u * u + v * v)
    assert values[6, 6] == pytest.approx(5 + L @ [1, 2, 3])
    assert (
        slices.stereographic_brightness(sl.Sky(brightness=lambda L: np.full(L.shape[:-1], 7.0)))
        == 7.0
        == slices.stereographic_brightness(sl.Sky(brightness=7))
    )


def test_the_rules_of_quadrature():
    """Gauss-Legendre for every number of slices."""
    table = slices._quad_quadrature(40)
    for count in (1, 2, 3, 7, 40):
        np.testing.assert_allclose(
            table[count - 1, :count].T, np.polynomial.legendre.leggauss(count), atol=1e-7
        )
        assert not table[count - 1, count:].any()


# --- walls and masks


def test_a_light_and_the_walls_of_a_dark_box(backend):
    """Behind the viewer only what shows through the box's opening; inside the box only what stands inside."""
    depth, spacing = np.full((9, 13), 8.0), 0.5
    nodes = (np.array([4, 0, 7]), np.array([6, 0, 12]))
    low, high = np.array([-0.25, -0.25]), np.array([6.25, 4.25])
    eyes = places(depth, spacing, nodes)

    def flat(corner, end, z):
        return np.array(
            [[corner[0], corner[1], z], [end[0], corner[1], z], [end[0], end[1], z], [corner[0], end[1], z]]
        )

    light = lambda z: solids.rectangle((-4.0, 1.0, z), (14.0, 0, 0), (0, 12.0, 0))
    # seen from depth 8, a light at z = -8 covers half its width in the plane z = 0
    wanted = np.array(
        [
            of_polygon(
                flat(np.maximum(low, (eye[:2] + [-4, 1]) / 2), np.minimum(high, (eye[:2] + [10, 13]) / 2), 0),
                [eye],
                UP,
            )[0]
            for eye in eyes
        ]
    )
    dark = lambda solid: image(backend, depth, solid, step=spacing, sides="dark")[nodes]
    np.testing.assert_allclose(dark(light(-8.0)), wanted, rtol=0.02)
    np.testing.assert_allclose(dark(light(5.0)), of_polygon(flat((-0.25, 1), high, 5), eyes, UP), rtol=0.02)
    beyond = slices.Ball((9, 2, 4), 1.0)
    assert not dark(beyond).any() and image(backend, depth, beyond, step=spacing)[nodes].all()
    through = slices.Ball((6.5, 2, 4), 2.0)
    valid = np.ones(depth.shape, bool)
    lamp = sl.Lamp(center=through.center, radius=through.radius)
    np.testing.assert_allclose(
        dark(through),
        oracle.lamp_irradiance(depth, spacing, valid, lamp, nodes, rays=65536, sides="dark"),
        rtol=0.02,
    )


def test_a_window_in_a_dark_box(backend):
    """Only what lies over the box; one beside it is nothing."""
    depth, spacing = np.full((13, 17), 9.0), 0.5
    window = solids.aperture((5, 40), (-7, 3), depth.shape, spacing, "dark", 30.0)
    assert window.corners[:, :2].min(0).tolist() == [5, -0.25] and window.corners[:, :2].max(0).tolist() == [
        8.25,
        3,
    ]
    near(
        image(backend, depth, window, step=spacing, sides="dark")[NODES],
        of_polygon(window.corners, places(depth, spacing), UP),
        2e-3,
    )
    assert solids.aperture((8.25, 9), (0, 3), depth.shape, spacing, "dark", 30.0) is None


def test_masked_ground_neither_hides_nor_is_lit(backend):
    """A hole in a wall lets the lamp through; beside the hole the wall is one node shorter."""
    depth = walled()
    ball = slices.Ball((34, 20, 10), 1.0)
    nodes = ([20, 20], [10, 22])
    assert not image(backend, depth, ball)[20, 10]
    depth[19:22, 22] = np.inf
    got = image(backend, depth, ball)
    to = np.array(ball.center) - [10, 20, 12]
    assert got[20, 10] == pytest.approx(np.pi * to[2] / -(np.linalg.norm(to) ** 3), rel=1e-3)
    assert got[nodes][1] == 0 and np.isfinite(got).all()
    valid = np.isfinite(depth)
    some = tuple(np.argwhere(valid)[:: valid.size // 40].T)
    wanted = oracle.lamp_irradiance(
        depth, 1.0, valid, sl.Lamp(center=ball.center, radius=1.0), some, rays=256
    )
    assert np.sqrt(np.mean((got[some] - wanted) ** 2)) < 0.01 * wanted[wanted > 0].mean()
    nothing = image(backend, np.full((4, 5), np.inf), ball)
    assert nothing.shape == (4, 5) and not nothing.any()


# --- rough ground


def _shifted(source, x, y):
    """The same source for a map that begins at (x, y)."""
    if isinstance(source, sl.Lamp):
        return sl.Lamp(
            center=tuple(np.array(source.center) - (x, y, 0)),
            radius=source.radius,
            brightness=source.brightness,
        )
    if isinstance(source, sl.Window):
        return sl.Window(
            x=tuple(np.array(source.x) - x), y=tuple(np.array(source.y) - y), brightness=source.brightness
        )
    return (tuple(np.array(source[0]) - (x, y, 0)), *source[1:])


SOURCES = {
    "large and near": sl.Lamp(center=(200, 170, -30), radius=25),
    "small and far": sl.Lamp(center=(600, -200, -250), radius=14),
    "spot": sl.Lamp(center=(250, 120, -80), radius=10, brightness=sl.cosine_power(16, axis=(-0.4, 0.3, 1))),
    "rectangle": ((120.0, 150.0, -20.0), (80.0, 0.0, 0.0), (0.0, 0.0, -30.0), 1.0),
    "slab": ((160.0, 120.0, -15.0), (60.0, 20.0, 0.0), (-15.0, 45.0, 0.0), sl.cosine_power(2)),
    "window": sl.Window(x=(120, 260), y=(100, 220), brightness=sl.cie_overcast()),
}  # fmt: skip


def _terrain():
    """The Jacksboro fault, three times as steep (rms slope 0.8), in spacings."""
    height, spacing = scenes.terrain()
    return ((height.max() - height) * (3 / spacing)).astype(np.float32)


def _solid(source, shape):
    if isinstance(source, sl.Lamp):
        return slices.Ball(source.center, source.radius), source.brightness
    if isinstance(source, sl.Window):
        return solids.aperture(source.x, source.y, shape, 1.0, "open", 30.0), source.brightness
    return solids.rectangle(*source[:3]), source[3]


@pytest.mark.slow
@pytest.mark.parametrize("name", SOURCES)
def test_real_terrain_against_shadow_rays(fast, name):
    """Within 0.5 % RMS of the mean lit irradiance, measured 0.03 to 0.27; with twice the slices no worse."""
    depth, source = _terrain(), SOURCES[name]
    rng = np.random.default_rng(1)
    nodes = tuple(rng.integers(0, n, 60) for n in depth.shape)
    truth = oracle.window_irradiance if name == "window" else oracle.lamp_irradiance
    wanted = truth(depth.astype(float), 1.0, np.isfinite(depth), source, nodes, 2304)
    errors = []
    for most in (slices.MOST, 2 * slices.MOST):
        off = image(fast, depth, *_solid(source, depth.shape), most=most)[nodes] - wanted
        errors.append(np.sqrt(np.mean(off**2)) / wanted[wanted > 0].mean())
        assert abs(off.mean()) < 1e-3 * wanted[wanted > 0].mean()
    assert errors[0] < 0.005 and errors[1] < max(1.1 * errors[0], 0.003), errors
    assert 0.2 < (wanted > 0).mean() < 0.95, "nothing is shaded"


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_backends_agree_and_repeat_themselves(backend, fast, sides):
    """To 1e-5 of the maximum, and each gives the same bytes again; masked ground, walls, all sources."""
    depth = _terrain()[100:148, 150:222].copy()
    depth[20:26, 40:43] = np.inf
    for source in SOURCES.values():
        solid, light = _solid(_shifted(source, 150, 100), depth.shape)
        brightness = table_of(light, 128, 65) if callable(light) else light
        one = slices.Slices(resident_map(backend, depth), sides, solid, brightness)
        one.run()
        got = one.download()
        one.run()
        assert_bits_equal(one.download(), got)
        reference = slices.Slices(resident_map(fast, depth), sides, solid, brightness)
        reference.run()
        assert got.max() > 0
        np.testing.assert_allclose(got, reference.download(), rtol=0, atol=1e-5 * got.max())
        if isinstance(solid, slices.Ball):
            other, wanted = (run.backend.download(run.alternating) for run in (one, reference))
            np.testing.assert_allclose(other, wanted, rtol=0, atol=1e-5 * got.max())


@pytest.mark.parametrize("shape", [(1, 1), (1, 29), (31, 1), (2, 2), (17, 33)])
def test_maps_of_any_shape(backend, shape):
    """As the oracle has them, a row and a column included."""
    depth = rough(max(shape[0], 2), max(shape[1], 2), 1.0, seed=4)[: shape[0], : shape[1]].astype(np.float32)
    nodes = tuple(np.indices(shape).reshape(2, -1)[:, :40])
    lamp = sl.Lamp(center=(shape[1] * 0.7, shape[0] * 0.4, -3.0), radius=2.0)
    wanted = oracle.lamp_irradiance(depth.astype(float), 1.0, np.ones(shape, bool), lamp, nodes, 1024)
    got = image(backend, depth, slices.Ball(lamp.center, lamp.radius))[nodes]
    np.testing.assert_allclose(got, wanted, atol=0.02 * wanted.max())


def test_the_tops_of_the_cells(backend):
    """Each cell's highest node, its corners included, on every level."""
    depth = rough(21, 37, 1.0, seed=8).astype(np.float32)
    depth[5, 6] = np.inf
    run = made(backend, depth, slices.Ball((5, 5, -5), 1.0))
    tops = run.backend.download(run.tops)
    height = np.where(np.isfinite(depth), -depth, constants.NONE)
    assert run.levels >= 3
    for level in range(1, run.levels + 1):
        size, first = 2**level, run.width - (run.width >> level - 1)
        for j in range((20 >> level) + 1):
            for i in range((36 >> level) + 1):
                assert (
                    tops[j, first + i]
                    == height[j * size : (j + 1) * size + 1, i * size : (i + 1) * size + 1].max()
                )


# --- suns


def sunny(radius, height=60.0):
    """A disc in a sky of 1, and the lamp that it is far away."""
    e, a, r = np.radians((35.0, 200.0, radius))
    axis = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])
    return sl.Sky(lambda L: 1 + height * (L @ axis >= np.cos(r))), sl.Lamp(
        tuple(1e7 * axis), 1e7 * np.sin(r), height - 3
    )


def by_suns(backend, depth, launches, window=None, sides="open"):
    """Irradiance by sectors, (ways, table) of each launch."""
    run = slices.Slices(resident_map(backend, depth), sides, slices.Dome())
    run.backend.fill(run.image, 0)
    for ways, table in launches:
        run.sectors(ways, table, window)
    return run.download()


def test_a_slit_almost_overhead(backend):
    """Nodes that nearly lie below a slit see most of its light in two narrow sectors: as in closed form."""
    depth = np.full((24, 9), 35.0)
    slit = slices.Quad(np.array([(3.85, 3.1, 0.0), (3.95, 3.1, 0.0), (3.95, 20.3, 0.0), (3.85, 20.3, 0.0)]))
    wanted = unoccluded.image(sl.Scene(depth), slices.Quad(slit.corners * (1, 1, -1)), 1.0)
    np.testing.assert_allclose(image(backend, depth, slit, most=64), wanted, rtol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("azimuth, elevation, scale", [(200, 35, 1), (70, 12, 1), (181, 12, 1), (7, 1, 0.05)])
def test_a_sun_over_a_map_that_repeats(backend, azimuth, elevation, scale):
    """As in the middle of a map of many copies, though rays go round few of them: from the highest nodes too,
    before a sun that touches the level.
    """
    depth = scale * _terrain()[100:124, 150:178].astype(np.float32)
    depth[12:15, 20:23] = np.inf
    axis = towards(azimuth, elevation)
    sky = sl.Sky(lambda L: 1 + 60.0 * (L @ axis >= np.cos(np.radians(2))))
    ways, table = Integrals(sky).bright_parts[0].sectors(8)
    run = slices.Slices(resident_map(backend, depth), "periodic", slices.Dome(), copied=COPIED)
    run.backend.fill(run.image, 0)
    run.sectors(ways, table)
    middle = by_suns(backend, np.tile(depth, (13, 13)), [(ways, table)])[144:168, 168:196]
    off = 1e-5 if elevation > 2 else 1e-2  # rays end at the border of the many copies, 150 spacings away
    np.testing.assert_allclose(run.download(), middle, rtol=1e-5, atol=off * middle.max())
    assert (abs(middle - by_suns(backend, depth, [(ways, table)])) > 0.1 * middle.max()).any()


def test_a_small_ball_near_a_large_map_is_not_enlarged_into_it(backend):
    """By the distance of most nodes it would reach nearly to the nearest; far from all it may grow."""
    there = resident_map(backend, np.full((3, 40_000), 5.0, np.float32))
    near, far = slices.Ball((20_000.0, 1.0, 4.5), 0.03), slices.Ball((20_000.0, 1.0, -9e4), 0.03)
    assert slices.widened(near, there) == (near, 1.0)
    grown, scale = slices.widened(far, there)
    assert 0.5 < grown.radius < 1 and scale == (0.03 / grown.radius) ** 2


def test_sectors_of_two_images_at_once(backend):
    """Each image receives the light of its own sectors."""
    depth = _terrain()[100:140, 150:190]
    sun = Integrals(sunny(2.0)[0]).bright_parts[0]
    halves = [sun.sectors(3), sun.sectors(3, True)]
    run = slices.Slices(resident_map(backend, depth), "open", slices.Dome())
    other = run.backend.empty(depth.shape, np.float32, 0)
    run.backend.fill(run.image, 0)
    ways, tables = zip(*halves)
    of_other = np.repeat([0, 1], [len(table) for table in tables])
    run.sectors(np.concatenate(ways, 1), np.concatenate(tables), other=other, to_other=of_other)
    for image, half in zip((run.download(), run.backend.download(other)), halves):
        wanted = by_suns(backend, depth, [half])
        np.testing.assert_allclose(image, wanted, rtol=1e-6, atol=1e-6 * wanted.max())
        assert wanted.any()


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_a_sun_in_sectors_is_the_disc_that_it_is(backend, sides):
    """As a far lamp through slices, whose disc is in closed form."""
    depth = _terrain()[100:160, 150:230].copy()
    depth[20:26, 40:43] = np.inf
    sky, lamp = sunny(2.0)
    (sun,) = Integrals(sky).bright_parts
    assert sun.limit == pytest.approx(4) and lamp.brightness == 57
    ball = slices.Ball(lamp.center, lamp.radius)
    wanted = image(backend, depth, ball, lamp.brightness, sides=sides, most=256)
    for sectors in (sun.sectors(120), sun.sectors(40), sun.sectors(40, True)):
        got = by_suns(backend, depth, [sectors], sides=sides)
        np.testing.assert_allclose(got, wanted, atol=0.02 * wanted.max())
        assert np.sqrt(np.mean((got - wanted) ** 2)) < 0.003 * wanted.max() and 0.2 < (got > 0).mean() < 0.95


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_backends_agree_on_suns_and_repeat_themselves(backend, fast, sides):
    """To 1e-5 of the maximum, and the same bytes again; a map of one row too."""
    sky, _ = sunny(1.0)
    sectors = Integrals(sky).bright_parts[0].sectors(24)
    for depth in (_terrain()[100:150, 150:204], _terrain()[100:101, 150:204]):
        images = []
        for name in (backend, backend, fast):
            images.append(by_suns(name, depth, [sectors], sides=sides))
        assert_bits_equal(images[0], images[1])
        assert images[0].any() == (
            sides == "open" or len(depth) > 1
        )  # the walls of one row hide a sun aside of it
        np.testing.assert_allclose(images[0], images[2], rtol=0, atol=1e-5 * images[2].max())


def a_sun(elevation, azimuth, radius, count=64, knots=129):
    """(ways, table) of a disc of brightness 1, in closed form along the middle of every sector; degrees."""
    e, a, r = np.radians((elevation, azimuth, radius))
    widest = np.arcsin(np.sin(r) / np.cos(e))
    d = widest * (2 * (np.arange(count) + 0.5) / count - 1)
    in_plane = np.cos(e) * np.cos(d)
    middle, half = (
        np.arctan2(np.sin(e), in_plane),
        np.arccos(np.minimum(np.cos(r) / np.hypot(in_plane, np.sin(e)), 1)),
    )
    first, last = diamond(np.radians([elevation - 1.1 * radius, elevation + 1.1 * radius]))
    knot = elevation_of(np.linspace(first, last, knots))
    low, high = np.clip(knot, (middle - half)[:, None], (middle + half)[:, None]), (middle + half)[:, None]
    whole = lambda t: np.stack([t + np.sin(t) * np.cos(t), np.sin(t) ** 2], -1) / 2
    table = whole(high) - whole(low)
    table = np.concatenate([table, np.diff(table, axis=1, append=table[:, -1:])], -1)
    same = np.ones(count)
    return (
        np.stack(
            [
                np.cos(a + d),
                np.sin(a + d),
                2 * widest / count * same,
                first * same,
                (knots - 1) / (last - first) * same,
            ]
        ),
        table,
    )


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_two_suns_at_once(backend, sides):
    """Sectors with tables over other elevations in one launch are the sum; a window without edges is none."""
    depth = _terrain()[100:150, 150:210].copy()
    depth[20:26, 40:43] = np.inf
    depth[3, 3] = -1.0  # above the plane of windows
    high, low = a_sun(50, 200, 3, count=20), a_sun(12, 20, 1, count=11)
    together = np.concatenate([high[0], low[0]], 1), np.concatenate([high[1], low[1]])
    got = by_suns(backend, depth, [together], sides=sides)
    one, other = (by_suns(backend, depth, [sun], sides=sides) for sun in (high, low))
    np.testing.assert_allclose(got, one + other, atol=1e-6 * got.max())
    np.testing.assert_allclose(
        by_suns(backend, depth, [high, low], sides=sides), one + other, atol=1e-6 * got.max()
    )
    assert one[3, 3] > 0 and (other > 0).mean() > 0.05 and (other == 0).mean() > 0.05
    assert_bits_equal(by_suns(backend, depth, [together], (-1e30, 1e30, -1e30, 1e30), sides), got)
    np.testing.assert_allclose(
        by_suns(backend, depth, [together], (-1e6, 1e6, -1e6, 1e6), sides),
        np.where(depth > 0, got, 0),
        atol=1e-6 * got.max(),
    )


@pytest.mark.slow
def test_a_sun_through_a_window(backend, fast):
    """Over a level floor: all of the disc, none of it, or a part, counted direction by direction."""
    depth = np.full((33, 41), 20.0)
    elevation, radius, window = 50, 3, (18.0, 33.5, 9.0, 24.25)
    for azimuth in (0, 35, 200):
        e, a = np.radians((elevation, azimuth))
        L, _ = within_cone(
            np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)]), np.radians(radius), 40, 80
        )
        x, y = (np.arange(n)[:, None] - 20.0 * L[:, k] / L[:, 2] for k, n in ((0, 41), (1, 33)))
        inside = lambda at, low, high: ((at >= low) & (at < high)).astype(float)
        weight = -L[:, 2] / -L[:, 2].sum()
        share = np.einsum("yn,xn,n->yx", inside(y, *window[2:]), inside(x, *window[:2]), weight)
        full = np.pi * np.sin(np.radians(radius)) ** 2 * np.sin(e)
        sun = a_sun(elevation, azimuth, radius)
        got = by_suns(backend, depth, [sun], window)
        near(by_suns(backend, depth, [sun]), np.full(depth.shape, full), 3e-3)
        wholly, outside = share > 1 - 1e-9, share == 0
        assert wholly.sum() > 50 and outside.sum() > 50 and (~wholly & ~outside).sum() > 50
        near(got[wholly], np.full(wholly.sum(), full), 3e-3)
        assert got[outside].max() < 2e-3 * full and (got[outside] == 0).mean() > 0.9
        np.testing.assert_allclose(got / full, share, atol=0.02)
        np.testing.assert_allclose(got, by_suns(fast, depth, [sun], window), rtol=0, atol=1e-5 * full)
    along = by_suns(backend, depth, [a_sun(elevation, 0, radius, count=1)], (-1e30, 1e30, 9.0, 24.0))
    assert np.flatnonzero(along.any(1)).tolist() == list(
        range(9, 24)
    )  # half-open where the way runs along an edge
    higher = depth.copy()
    higher[:, 30] = 8.0  # the window frames what the ground leaves
    for edges in (window, (-1e30, 1e30, 9.0, 24.25)):
        got, free = by_suns(backend, higher, [sun], edges), by_suns(backend, higher, [sun])
        assert (got <= free * (1 + 1e-5)).all() and not got[(free == 0)].any()
    assert not by_suns(backend, np.full_like(depth, 0.0), [sun], window).any()


@pytest.mark.slow
def test_suns_are_found_wherever_they_stand():
    """At the zenith, across azimuth 0, two at once; all of their light, and none where brightness is even."""

    def disc(elevation, azimuth, radius=0.27):
        e, a, r = np.radians((elevation, azimuth, radius))
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)]), np.cos(r)

    for discs in ([disc(89.9, 10)], [disc(30, 0.05)], [disc(20, 40), disc(50, 250, 2)], [disc(0.2, 300)]):
        sky = Integrals(
            sl.Sky(lambda L, discs=discs: 1 + sum(5e3 * (L @ axis >= edge) for axis, edge in discs))
        )
        assert len(sky.bright_parts) == len(discs)
        if discs[0][0][2] < -0.1:
            level = 5e3 * np.pi * sum((1 - edge**2) * -axis[2] for axis, edge in discs)
            assert sky.level == pytest.approx(np.pi + level, rel=1e-4)
            for count in (120, 5):
                found = [sun.sectors(count) for sun in sky.bright_parts]
                assert sky.rest + sum(ways[2] @ table[:, 0, 1] for ways, table in found) == pytest.approx(
                    np.pi + level, rel=1e-4
                )
            assert not sky.bright_parts or sky.rest < np.pi + 2e-3 * level
    assert Integrals(sl.Sky(sl.cie_overcast())).bright_parts == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [{"tolerance": 0.01}, {"method": "horizon"}, {"method": "unoccluded"}], ids=str
)
def test_a_window_without_end_is_one_of_a_thousand_maps(fast, how):
    """From some distance on a window's edge makes no difference, however far it is."""
    depth = 10 + np.random.default_rng(0).random((20, 25))
    for ends in (lambda far: ((-far, far), (-far, far)), lambda far: ((5, far), (0, 20))):
        near, far, farthest = (
            sl.render(sl.Scene(depth), sl.Window(*ends(away)), backend=fast, **how).image
            for away in (2e3, 1e6, 1e30)
        )
        np.testing.assert_allclose(far, near, rtol=0.01)
        np.testing.assert_allclose(farthest, far, rtol=1e-4)


def test_a_window_far_away_lights_nothing(fast):
    """It is too far to be told from none, and its place does not overflow."""
    out = sl.render(sl.Scene(np.ones((8, 9))), sl.Window((1e30, 2e30), (0, 5)), backend=fast)
    assert (out.image == 0).all() and not out.warnings


@pytest.mark.filterwarnings("error")
def test_a_node_in_the_plane_of_a_window_has_a_number(fast):
    """At the very middle of it, where a direction to it is not defined."""
    window = sl.Window((-4, 4), (-3, 3), brightness=lambda L: 1 - L[..., 2])
    scene = sl.Scene(np.zeros((1, 1)))
    assert np.isfinite(sl.render(scene, window, method="unoccluded", backend=fast).image).all()
