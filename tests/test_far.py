"""Ground far from a tile: overviews, and far horizons on all backends against the oracle."""

import math

import numpy as np
import pytest
from compare import assert_bits_equal

from skylamp import oracle
from skylamp.backends import select
from skylamp.errors import InputError
from skylamp.light import far as fields
from skylamp.light.far import TOWARDS_MAXIMUM, Far, Tiling, around, coarser, from_heights, scaled, top_of
from skylamp.light.sweeps import Rays, Sweeps, ground_of
from skylamp.scene import Scene

NONE = -1e20  # below this, a slope says that there is no far ground
FINE = Tiling(tile=16, halo=8, rule=4)


def ridges(rows, cols, seed=3):
    """Heights [nodes] of smooth mountains whose crests stand far apart, float32."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:rows, :cols]
    height = np.zeros((rows, cols))
    for wave in (2, 3, 5, 9, 17):
        turn, phase = rng.uniform(0, 2 * np.pi, 2)
        way = x * np.cos(turn) + y * np.sin(turn)
        height += 12 / wave * np.sin(2 * np.pi * wave * way / 150 + phase)
    return height.astype(np.float32)


def far_of(heights, tiling, at, tile, periodic=False, farthest=math.inf, drop=0.0):
    """(window, Far) of one tile of a map in nodes."""
    padded = np.pad(heights, tiling.halo, mode="wrap") if periodic else None
    begin = [first if periodic else max(0, first - tiling.halo) for first in at]
    end = [first + count + (2 if periodic else 1) * tiling.halo for first, count in zip(at, tile)]
    window = (heights if padded is None else padded)[begin[0] : end[0], begin[1] : end[1]]
    before = (tiling.halo,) * 2 if periodic else tuple(a - b for a, b in zip(at, begin))
    level0 = from_heights(heights)
    whole = coarser(level0, tiling.top)
    size, low = 1 << tiling.first, coarser(level0, tiling.first)
    picks = []
    for first, count, cells in zip(at, tile, low.shape[1:]):
        pick = np.arange((first - tiling.reach) // size, -(-(first + count + tiling.reach) // size))
        picks.append(pick % cells if periodic else pick[(pick >= 0) & (pick < cells)])
    part = low[:, picks[0][:, None], picks[1]]
    corner = tuple(first - (tiling.reach if periodic else min(first, tiling.reach)) for first in at)
    levels = around(tiling, corner, at, tile, part, top_of(whole), periodic)
    base = np.nanmax(window)
    own = np.where(np.isnan(window), -np.inf, scaled(window, base, 1.0)).astype(np.float32)
    nodes = fields.marched_nodes(tiling.spread, heights.shape, at, tile)
    marched = own[np.ix_(*(lines - first + room for lines, first, room in zip(nodes, at, before)))]
    marched = np.where(np.isneginf(marched), own[np.isfinite(own)].min(initial=0), marched)
    levels = [level._replace(heights=scaled(level.heights, base, 1.0)) for level in levels]
    return own, Far(
        tiling, heights.shape, at, tile, before, tiling.spread, marched, levels, farthest, periodic, drop
    )


def planes_of(engine, window, far, angles, turned=False):
    """Far slopes (azimuths, rows, cols) of a window."""
    margin = 2
    heights = window.T if turned else window
    padded = np.pad(np.maximum(heights, np.float32(-2e30)), margin, constant_values=-1e30).ravel()
    with engine.lock:
        found = engine.download(
            fields.Marched(engine, far).planes(heights.shape, margin, engine.upload(padded), angles, turned)
        )
    found = found.reshape(-1, *heights.shape)
    return found.transpose(0, 2, 1) if turned else found


def test_overviews_of_a_ramp_are_its_means():
    """Cells of a ramp: the mean of their nodes, and the maximum at the upper corner; ragged ends and gaps."""
    ramp = np.add.outer(2 * np.arange(5), np.arange(6)).astype(np.float32)
    mean, high = coarser(from_heights(ramp))
    assert_bits_equal(mean[:2], np.float32([[1.5, 3.5, 5.5], [5.5, 7.5, 9.5]]))
    assert_bits_equal(mean[2], np.float32([8.5, 10.5, 12.5]))  # one row of nodes alone
    assert_bits_equal(high[0], np.float32([3, 5, 7]))
    ramp[0, 0] = np.nan
    ramp[2:4, 2:4] = np.nan
    mean, high = coarser(from_heights(ramp))
    assert mean[0, 0] == 2 and high[0, 0] == 3  # of three nodes
    assert np.isnan(mean[1, 1]) and np.isnan(high[1, 1])


def test_overviews_do_not_depend_on_how_a_map_is_cut():
    """Two levels of a map and of its parts are the same bytes."""
    heights = ridges(40, 56)
    whole = coarser(from_heights(heights), 3)
    parts = [
        [coarser(from_heights(heights[i : i + 16, j : j + 24]), 3) for j in (0, 24, 48)] for i in (0, 16, 32)
    ]
    assert_bits_equal(whole, np.concatenate([np.concatenate(row, 2) for row in parts], 1))


def test_oracle_finds_a_far_wall():
    """A wall of height 30, 64 nodes thick, from column 192 on: the oracle's slope is that of a sample between
    its face and its middle; the other way there is nothing but level ground, and then no ground.
    """
    height = np.zeros((4, 256))
    height[:, 192:] = 30
    east, west = oracle.far_horizons(height, [0.0, math.pi], 16, 8, 2, float(TOWARDS_MAXIMUM))
    for x in (0, 7, 100, 150):
        assert 30 / (192 - x + 16) <= east[1, x] <= 30 / (192 - x - 16)
    assert west[1, 100] == 0 and west[1, 8] == -np.inf
    assert east[1, 250] == -np.inf


def test_oracle_sees_a_ramp_as_it_is():
    """On a ramp of slope g every horizon uphill is g, but for what overviews of maxima add: share x half a
    cell's rise at rule cells.
    """
    g, rule = 0.5, 8
    height = np.outer(np.ones(8), g * np.arange(300))
    east, west = oracle.far_horizons(height, [0.0, math.pi], 16, rule, 1, float(TOWARDS_MAXIMUM))
    seen = east[:, :280]
    assert (seen >= g - 1e-9).all() and (seen <= g * (1 + float(TOWARDS_MAXIMUM) / 2 / rule)).all()
    # downhill too, less what maxima add, and half a cell at the border, where ground goes on level
    west = west[:, 20:]
    assert (west >= -g).all() and (west <= -g * (1 - (1 + float(TOWARDS_MAXIMUM)) / 2 / rule)).all()


def test_oracle_lets_the_ground_fall_off():
    """On level ground that falls off with distance^2 the horizon is the nearest sample's: - drop x halo."""
    found = oracle.far_horizons(np.zeros((6, 90)), [0.0], 16, 8, 2, float(TOWARDS_MAXIMUM), drop=1e-3)
    np.testing.assert_allclose(found[0, :, :70], -0.016, rtol=1e-12)


@pytest.mark.slow
def test_far_horizons_are_the_oracles(backend):
    """A tile in the middle, one at the last corner with ragged sides, a whole map: as they lie and turned.

    Slopes are the oracle's on the whole map.
    """
    engine, heights = select(backend), ridges(75, 101)
    angles = 2 * np.pi * (np.arange(5) + 0.3) / 5
    truth = oracle.far_horizons(heights, angles, 8, 4, FINE.spread, float(TOWARDS_MAXIMUM))
    for at, tile in (((16, 32), (16, 16)), ((64, 80), (11, 21)), ((0, 0), (75, 101))):
        window, far = far_of(heights, FINE, at, tile)
        box = tuple(slice(b, b + n) for b, n in zip(far.before, tile))
        for turned in (False, True):
            found = planes_of(engine, window, far, angles, turned)
            outside = np.ones(window.shape, bool)
            outside[box] = False
            assert (found[:, outside] < NONE).all()
            expected = truth[:, at[0] : at[0] + tile[0], at[1] : at[1] + tile[1]]
            _same(found[(slice(None), *box)], expected)


def _same(found, expected):
    """Slopes equal to 2e-5, none where there is none."""
    none = found < NONE
    assert np.array_equal(none, np.isneginf(expected))
    assert np.abs(found[~none] - expected[~none]).max() < 2e-5
    assert np.abs(expected[~none]).max() > 0.1  # there is something to be wrong about


@pytest.mark.slow
@pytest.mark.parametrize("spread", [pytest.param(4, marks=pytest.mark.slow), 8])
def test_far_horizons_between_marched_nodes(backend, spread):
    """Bilinear between marched nodes, each moved to the node's own height, up to the last row and column."""
    engine, tiling = select(backend), Tiling(tile=64, halo=4 * spread, rule=4 * spread)
    assert tiling.spread == spread
    heights = ridges(2 * 64 + 5, 3 * 64 + 3)
    angles = np.array([0.4, 2.9, 5.0])
    truth = oracle.far_horizons(heights, angles, tiling.halo, tiling.rule, spread, float(TOWARDS_MAXIMUM))
    at, tile = (64, 128), (69, 67)
    window, far = far_of(heights, tiling, at, tile)
    found = planes_of(engine, window, far, angles)[(slice(None), *map(slice, far.before, window.shape))]
    expected = truth[:, 64:, 128:]
    known = np.isfinite(expected) & (found > NONE)
    assert known.mean() > 0.3
    assert np.abs(found[known] - expected[known]).max() < 2e-5


def test_far_horizons_pass_over_gaps(backend):
    """Masked ground has no part in overviews, and masked nodes see nothing."""
    engine, heights = select(backend), ridges(64, 96)
    heights[10:30, 40:70] = np.nan
    heights[50, 3] = heights[20, 20] = np.nan
    angles = np.array([0.1, 1.9, 4.0])
    truth = oracle.far_horizons(heights, angles, 8, 4, FINE.spread, float(TOWARDS_MAXIMUM))
    for at in ((16, 16), (48, 0), (16, 48)):
        window, far = far_of(heights, FINE, at, (16, 16))
        found = planes_of(engine, window, far, angles)[(slice(None), *(slice(b, b + 16) for b in far.before))]
        expected = truth[:, at[0] : at[0] + 16, at[1] : at[1] + 16]
        assert (found[np.isnan(expected)] < NONE).all()
        known = np.isfinite(expected)
        if known.any():
            assert np.abs(found[known] - expected[known]).max() < 2e-5


@pytest.mark.slow
def test_far_horizons_go_round_a_map_that_repeats(backend):
    """Up to the farthest distance, over several laps; the map's sides are whole cells."""
    engine, heights = select(backend), ridges(64, 96)
    angles = np.array([0.2, 2.2, 3.7])
    truth = oracle.far_horizons(heights, angles, 8, 4, FINE.spread, float(TOWARDS_MAXIMUM), True, 200.0)
    window, far = far_of(heights, FINE, (0, 80), (16, 16), True, 200.0)
    found = planes_of(engine, window, far, angles)[:, 8:24, 8:24]
    _same(found, truth[:, :16, 80:96])


@pytest.mark.slow
@pytest.mark.parametrize("drop", [2e-3, -0.05])
def test_round_earth_and_farthest_ground(backend, drop):
    """drop and farthest change slopes as the oracle says, also where the map is upside down."""
    engine, heights = select(backend), ridges(48, 160)
    angles = np.array([0.05, 3.1])
    plain = oracle.far_horizons(heights, angles, 8, 4, FINE.spread, float(TOWARDS_MAXIMUM))
    options = dict(farthest=40.0, drop=drop)
    truth = oracle.far_horizons(heights, angles, 8, 4, FINE.spread, float(TOWARDS_MAXIMUM), **options)
    window, far = far_of(heights, FINE, (16, 64), (16, 16), **options)
    found = planes_of(engine, window, far, angles)[:, 8:24, 8:24]
    _same(found, truth[:, 16:32, 64:80])
    known = np.isfinite(truth[0])
    assert np.abs(plain[0, known] - truth[0, known]).max() > 0.01


def test_sweeps_take_the_higher_of_near_and_far(backend):
    """Horizons and light of a tile are those of the far slopes where they are higher than the near ones."""
    engine, heights = select(backend), ridges(96, 96)
    angles = 2 * np.pi * (np.arange(8) + 0.5) / 8
    rays = Rays(angles, np.full(8, 2 * np.pi / 8))
    window, far = far_of(heights, FINE, (32, 48), (16, 16))
    box = tuple(slice(b, b + 16) for b in far.before)
    with engine.lock:
        ground = ground_of(Scene(-window), None, engine)
        near, both = (Sweeps(engine, ground, rays, far=f).slopes() for f in (None, far))
        beyond = planes_of(engine, window, far, angles)
        expected = np.maximum(near, beyond)
        np.testing.assert_allclose(both[(slice(None), *box)], expected[(slice(None), *box)], atol=2e-6)
        assert (both > near + 0.01)[(slice(None), *box)].mean() > 0.05
        light = Sweeps(engine, ground, rays, far=far, level=True).irradiance()[box]
    seen = np.maximum(both, 0)[(slice(None), *box)]
    expected = np.pi * (1 / (1 + seen**2)).mean(0)
    # horizons are searched from slopes below the level too
    np.testing.assert_allclose(light, expected, atol=1e-3)
    assert np.median(np.abs(light - expected)) < 1e-6


@pytest.mark.slow
def test_near_windows_keep_to_what_is_known_from_far(backend):
    """With a reach, too, sweeps by windows never go below the far slopes."""
    engine, heights = select(backend), ridges(96, 96)
    angles = np.array([0.3, 2.0, 4.4])
    window, far = far_of(heights, FINE, (32, 48), (16, 16), farthest=30.0)
    rays = Rays(angles, np.full(3, 2 * np.pi / 3))
    with engine.lock:
        ground = ground_of(Scene(-window), 8.0, engine)
        near, both = (Sweeps(engine, ground, rays, far=f).slopes() for f in (None, far))
    beyond = planes_of(engine, window, far, angles)
    box = (slice(None), *(slice(b, b + 16) for b in far.before))
    np.testing.assert_allclose(both[box], np.maximum(near, beyond)[box], atol=2e-6)


@pytest.mark.parametrize(
    "given",
    [
        dict(halo=100),
        dict(rule=3),
        dict(rule=256),
        dict(tile=1000),
        dict(tile=64),
        dict(halo=8.0),
        dict(tile=1152, rule=4),
    ],
)
def test_tilings_that_cannot_be_are_refused(given):
    """One error that names the argument."""
    with pytest.raises(InputError, match=f"Tiling: {next(iter(given))}"):
        Tiling(**given)


def test_what_is_left_of_a_map_belongs_to_the_tile_before():
    """No tile is smaller than its neighbours must be for their overviews and halos."""
    tiling = Tiling(tile=64, halo=8, rule=4)
    assert (tiling.first, tiling.top, tiling.reach, tiling.least) == (1, 4, 64, 64)
    assert tiling.starts(10) == tiling.starts(127) == [0]
    assert tiling.starts(128) == tiling.starts(191) == [0, 64]
    usual = Tiling()
    assert (usual.first, usual.top, usual.reach) == (2, 5, 1024)
    assert usual.starts(65536) == list(range(0, 65536, 8192))


def test_among_cliffs_more_nodes_are_marched():
    """Ramps are marched as ever; houses, steps of five spacings, more closely, with gaps too."""
    tiling, ramp = Tiling(), np.outer(np.ones(64), 3.9 * 30 * np.arange(64))
    town = np.kron(np.arange(256).reshape(16, 16) % 2, np.ones((4, 4))) * 5 * 30
    assert fields.spread_of(tiling, ramp, 30.0) == tiling.spread == 32
    assert fields.spread_of(tiling, town, 30.0) == 8
    town[:, ::3] = np.nan
    assert fields.spread_of(tiling, town, 30.0) == 8
    assert fields.spread_of(tiling, np.full((9, 9), np.nan), 30.0) == 32


@pytest.mark.parametrize("reach", [None, 11.0])
@pytest.mark.parametrize("what", ["light", "slopes"])
def test_only_the_tile_is_lit(fast, what, reach):
    """In a window around a tile its nodes have the bytes that they have if all of the window is lit; nodes of
    the halo, but for some beside the tile, get nothing.
    """
    engine, heights = select(fast), ridges(90, 70)
    rays = Rays(2 * np.pi * (np.arange(9) + 0.3) / 9, np.full(9, 2 * np.pi / 9))
    for at, tile in (((32, 16), (32, 16)), ((0, 48), (16, 22)), ((64, 0), (26, 32))):
        window, far = far_of(heights, FINE, at, tile)
        scene = Scene.from_height(window)
        found = []
        for lit in (far, far._replace(whole=True)):
            with engine.lock:
                sweeps = Sweeps(engine, ground_of(scene, reach, engine), rays, far=lit)
                found.append(sweeps.irradiance() if what == "light" else sweeps.slopes())
        box = (..., *(slice(b, b + n) for b, n in zip(far.before, tile)))
        assert_bits_equal(found[0][box], found[1][box])
        if what == "light":
            assert np.count_nonzero(found[0]) < np.count_nonzero(found[1])
            assert found[0][box].all()


def test_a_tiling_by_numpy_integers_is_that_by_python_s():
    """They have no bit_length, and another text, by which a scratch folder is told."""
    tiling = Tiling(*(np.int64(nodes) for nodes in (1024, 128, 32)))
    assert repr(tiling) == repr(Tiling(1024, 128, 32)) and tiling.top == Tiling(1024, 128, 32).top
