"""Samples: exact rays against the oracle and shadow rays, and errors by hand."""

import numpy as np
import pytest
from compare import assert_bits_equal
from test_refinement import HIGH, LOW, PANEL, SCENES, SIZE, WINDOW, truth

import skylamp as sl
from skylamp import oracle
from skylamp.backends import select
from skylamp.light.finite import solid_of
from skylamp.light.slices import Slices
from skylamp.samples import NONE, SAMPLE_COUNT, Errors, Samples, errors, samples_of
from skylamp.sources.integrals import Integrals
from skylamp.sources.solids import Ball, Dome, Quad, upright


@pytest.mark.parametrize("name", ["rough", "dark", "periodic", "holes", "metres", "tiny"])
def test_samples_see_the_oracles_horizons(backend, name):
    """Horizons of every crossing, not below the level, the tangent plane and the wall, agree to float32."""
    scene = SCENES[name]
    samples = Samples(select(backend), scene, 24)
    azimuths = np.array([0, 0.3, 1.1, np.pi / 4, np.pi / 2, 2.2, 3.6, 4.9, 6.1])
    found = samples.horizons(azimuths)
    raw = oracle.horizons(
        scene.depth.astype(float), scene.spacing, azimuths, scene.sides, nodes=(samples.y, samples.x)
    )
    free = samples.free(np.cos(azimuths)[:, None], np.sin(azimuths)[:, None])
    np.testing.assert_allclose(found, np.maximum(free, raw), atol=2e-4, rtol=2e-5)
    assert (raw > free).mean() > 0.2, "nothing stands in the way"
    normal = oracle.normals(
        np.nan_to_num(scene.depth.astype(float)), scene.spacing, scene.valid, scene.sides
    )[samples.y, samples.x]
    np.testing.assert_allclose(
        np.stack([samples.gx, samples.gy]), (normal[:, :2] / -normal[:, 2:]).T, atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("source", [HIGH, LOW, PANEL, WINDOW], ids=["ball", "low spot", "panel", "window"])
def test_samples_see_lamps_as_shadow_rays_do(fast, source):
    """Slices through a source against 4096 rays a node, and never a node that is masked."""
    for scene in (SCENES["rough"], SCENES["holes"]):
        samples = Samples(select(fast), scene, 40)
        assert scene.valid[samples.y, samples.x].all() and (samples.own > NONE).all()
        found = samples.through_slices(upright(solid_of(scene, source)), source.brightness, 128)
        wanted = truth(scene, source, (samples.y, samples.x))
        assert errors(found, wanted).rms < 0.005 and (wanted > 0).mean() > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["open", "dark"])
def test_samples_see_suns_as_images_do(fast, sides):
    """Small bright parts in sectors agree with the kernel at the same nodes, also through a window."""
    axis = np.array([0.5, 0.4, -0.6]) / np.sqrt(0.77)
    sun = Integrals(sl.Sky(lambda L: 1 + 1e3 * (L @ axis > np.cos(0.02)))).bright_parts[0].sectors(16)
    scene = SCENES["dark"] if sides == "dark" else SCENES["rough"]
    samples = Samples(select(fast), scene, 200)
    for window in (None, (10.3, 51.0, 20.0, 66.6)):
        run = Slices(scene.on(select(fast)), sides, Dome())
        run.backend.fill(run.image, 0)
        run.sectors(*sun, *([window] if window else []))
        wanted = samples.of(run.download())
        assert errors(samples.sectors(*sun, window), wanted).rms < 0.01 and 0.1 < (wanted > 0).mean() < 0.95


def test_samples_are_spread_and_the_same_again(fast):
    """Over all quarters of a map, few valid nodes, or a whole small map; other numbers are other nodes."""
    of = lambda scene, *more: Samples(select(fast), scene, *more)
    one, other = of(SCENES["rough"]), of(sl.Scene(SCENES["rough"].depth.copy()))
    assert_bits_equal(one.x.astype(np.int64), other.x.astype(np.int64))
    quarters = np.bincount(2 * (one.x > SIZE / 2) + (one.y > SIZE / 2), minlength=4)
    assert len(one) == SAMPLE_COUNT and quarters.min() > 0.2 * SAMPLE_COUNT
    few = np.zeros((40, 50), bool)
    few[3:5, 7:30] = True
    assert len(of(sl.Scene(np.zeros((40, 50)), mask=few))) == 46 and len(of(SCENES["tiny"])) == 9 * 13
    there = of(SCENES["rough"], 300, 100_003)
    both = {*zip(one.x.tolist(), one.y.tolist())} & {*zip(there.x.tolist(), there.y.tolist())}
    assert len(both) < 0.25 * len(there)
    image = np.arange(SIZE * SIZE, dtype=np.float32).reshape(SIZE, SIZE)
    assert_bits_equal(one.of(image), (one.y * SIZE + one.x).astype(float))


def test_samples_are_kept_with_their_map(fast):
    """A known scene's samples are not traced again, are those of a new scene, and end with its map."""
    engine, scene = select(fast), sl.Scene(SCENES["rough"].depth, SCENES["rough"].spacing)
    azimuths = np.linspace(0, 6, 5)
    first = samples_of(engine, scene, 24)
    slopes = first.horizons(azimuths)
    again = samples_of(engine, scene, 24)
    assert again is not first and again.horizons(azimuths) is slopes
    assert again.horizons(azimuths, 3.0) is not slopes
    np.testing.assert_array_equal(Samples(engine, scene, 24).horizons(azimuths), slopes)
    assert (
        samples_of(engine, sl.Scene(scene.depth + scene.depth, scene.spacing), 24).horizons(azimuths)
        is not slopes
    )
    moved = samples_of(engine, scene, 24)
    moved.set_nodes(moved.x[::-1].copy(), moved.y)
    assert not np.array_equal(moved.horizons(azimuths), slopes)
    assert samples_of(engine, scene, 24).horizons(azimuths) is slopes
    scene.release(fast)
    assert samples_of(engine, scene, 24).horizons(azimuths) is not slopes


def test_errors_by_hand():
    """RMS over all nodes, mean over lit ones; the 99.9th percentile of exponential errors: ln 1000 means."""
    exact = np.array([0.0, 0.0, 1.0, 3.0])
    assert errors(exact + [0.2, 0, 0, -0.2], exact).rms == pytest.approx(np.sqrt(0.08 / 4) / 2)
    rng = np.random.default_rng(0)
    found = errors(1 + 0.01 * rng.exponential(size=4000), np.ones(4000))
    assert (
        found.tail == pytest.approx(0.01 * np.log(1000), rel=0.1)
        and found.rms < found.bound < 1.06 * found.rms
    )
    rare = np.zeros(100)
    rare[7] = 1
    assert errors(rare + 1, np.ones(100)).bound > 1.4 * errors(rare + 1, np.ones(100)).rms, (
        "one node in a hundred may be three"
    )
    assert (
        errors(np.zeros(3), np.zeros(3)) == Errors(0, 0, 0) and errors(np.ones(3), np.zeros(3)).rms == np.inf
    )
    assert errors(exact[:1], exact[:1] + 1).rms == 1.0, "one node has an error too"


def test_an_upright_shape_by_hand():
    """Depths become heights, lengths are in units of the step; the shape itself stays."""
    ball, quad = Ball((2.0, 4.0, -6.0), 1.0), Quad(np.arange(12.0).reshape(4, 3))
    assert upright(ball, 2.0) == Ball((1.0, 2.0, 3.0), 0.5) and upright(None) is None
    np.testing.assert_array_equal(upright(quad, 2.0).corners, quad.corners * (0.5, 0.5, -0.5))


def test_holes_are_no_cliffs(fast):
    """Steps to masked nodes do not count; of houses, the share of pairs of neighbours that are a step."""
    assert Samples(select(fast), SCENES["rough"]).cliffs == Samples(select(fast), SCENES["holes"]).cliffs == 0
    depth = SCENES["houses"].depth.astype(float)
    steps = [np.abs(np.diff(depth, axis=a)) > 4 for a in (0, 1)]
    assert Samples(select(fast), SCENES["houses"]).cliffs == pytest.approx(
        sum(s.sum() for s in steps) / sum(s.size for s in steps), rel=1e-5
    )


@pytest.mark.parametrize(
    "lamp",
    [
        sl.Lamp(center=(47.0, 20.4, 2.0), radius=3.0),
        sl.Lamp(center=(24.3, 20.4, 18.0), radius=5.0),  # around nodes
        sl.Lamp(corner=(40.0, 10.0, 2.0), edges=((12.0, 0, 1.0), (0, 9.0, 0))),
        sl.Lamp(corner=(44.0, 10.0, 6.0), edges=((6.0, 0, -5.0), (0, 9.0, 0))),
    ],
    ids=["ball", "ball around nodes", "panel", "steep panel"],
)
def test_a_lamp_through_the_wall_of_a_dark_box(fast, lamp):
    """What lies before the wall is seen, and what is above its top: by a million rays from a few nodes. The
    exact light that judges images took a source for before the wall or behind it, as a whole: warnings of 5
    to 120 %.
    """
    depth = np.full((48, 48), 20.0)
    scene = sl.Scene(depth, sides="dark")
    samples = Samples(select(fast), scene, 1)
    nodes = np.array([(46, 20), (40, 24), (30, 12), (24, 22), (47, 9)]).T
    samples.set_nodes(*nodes)
    found = samples.through_slices(upright(solid_of(scene, lamp)), 1.0, 512)
    n = np.arange(1_000_000) + 0.5
    turn, z = np.pi * (1 + 5**0.5) * n, -np.sqrt(1 - n / len(n))  # as dense as the cosine
    L = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    for x, y, light in zip(*nodes, found):
        origin = np.array([x, y, 20.0])
        with np.errstate(divide="ignore", invalid="ignore"):
            if lamp.center is not None:
                away = np.array(lamp.center) - origin
                along = away @ L
                root = lamp.radius**2 - away @ away + along**2
                inside = away @ away < lamp.radius**2
                hit = np.where((root > 0) & ((along > 0) | inside), along - np.sqrt(root), np.nan)
                hit = np.where(inside, 0.0, hit)
            else:
                u, v = np.array(lamp.edges)
                normal, to = np.cross(u, v), np.array(lamp.corner) - origin
                hit = (normal @ to) / (normal @ L)
                at = hit * L - to[:, None]
                a, b = (np.linalg.pinv(np.stack([u, v], 1)) @ at).reshape(2, -1)
                hit = np.where((hit > 0) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1), hit, np.nan)
            wall = np.minimum(*(np.where(w > 0, 47.5 - o, -0.5 - o) / w for w, o in zip(L[:2], origin)))
        seen = ~np.isnan(hit) & ((hit <= wall) | (20 + wall * L[2] < 0))
        assert light == pytest.approx(np.pi * seen.mean(), rel=0.01, abs=1e-3), (x, y)
    out = sl.render(scene, lamp, backend=fast, interreflection=False)
    assert not out.warnings
