"""Kernels that pool, pick, place, correct, halve and judge, each against a few lines of plain NumPy.

Heights are in spacings.
"""

import inspect
import re

import numpy as np
import pytest

import skylamp.opencl
from skylamp.backends import select
from skylamp.backends.numpy import pilot as numpy_pilot

SHAPE = ROWS, COLS = 37, 53
CLOSE = 1e-6  # of the largest value, where values are rounded on the way


@pytest.fixture
def engine(backend):
    return select(backend)


def _rng(seed=1):
    return np.random.default_rng(seed)


def _map(rows=ROWS, cols=COLS, mask=-1e30):
    """Heights, with holes where there is a ``mask``: whole blocks, at a corner and within, and nodes by
    themselves.
    """
    rng = _rng(rows * cols)
    heights = rng.normal(0, 3, (rows, cols)).astype(np.float32)
    if mask is not None:
        heights[rng.random((rows, cols)) < 0.2] = mask
        heights[:18, 20:40] = mask
        heights[-6:, -9:] = mask
    return heights


def _padded(heights, margin):
    """With a margin that no node may be read from."""
    return np.pad(heights, margin, constant_values=np.float32(np.nan)).ravel()


def _in_order(terms, axis):
    """Their float32 sum from the first on, each rounded; NumPy's own sum takes them in pairs."""
    return np.cumsum(terms, axis, dtype=np.float32).take(-1, axis)


def _close(got, expected):
    np.testing.assert_allclose(got, expected, rtol=0, atol=CLOSE * abs(expected).max())


# -- pool


def _pooled(heights, shift, periodic, cliff):
    """What pool is to find, block by block."""
    rows, cols = heights.shape
    size, found = 1 << shift, []
    for y in range(0, rows, size):
        for x in range(0, cols, size):
            own = heights[y : y + size, x : x + size]
            more = [
                [v % n for v in range(o, min(o + size, n) + 1) if periodic or v < n]
                for o, n in ((y, rows), (x, cols))
            ]
            with_next, known = heights[np.ix_(*more)], own[own > -1e29]
            cliffs = 0
            for j, i in np.argwhere(own > -1e29) + (y, x):
                for v, u in ((j, i + 1), (j + 1, i)):
                    cliffs += (
                        v < rows
                        and u < cols
                        and heights[v, u] > -1e29
                        and abs(heights[v, u] - heights[j, i]) > cliff
                    )
            found.append(
                (
                    with_next[with_next > -1e29].max(initial=np.float32(-1e30)),
                    known.min(initial=np.float32(1e30)),
                    cliffs,
                )
            )
    return np.array(found, np.float32).T.reshape(3, -(-rows // size), -(-cols // size))


def _pool(engine, heights, shift, periodic, cliff):
    rows, cols = heights.shape
    down, across = (-(-n >> shift) for n in (rows, cols))
    given, found = engine.upload(heights), engine.empty((3, down, across), np.float32, np.nan)
    engine.launch(
        "pilot",
        "pool",
        (across, down),
        given,
        found,
        rows,
        cols,
        across,
        down,
        shift,
        int(periodic),
        cliff,
        lanes=1,
    )
    return engine.download(found)


MAPS = [
    (SHAPE, None),
    (SHAPE, -1e30),
    (SHAPE, -np.inf),
    ((32, 48), -1e30),
    ((16, 17), -1e30),
    ((1, 9), None),
    ((9, 1), None),
    ((1, 1), None),
]


@pytest.mark.parametrize("shift", [3, 4])
@pytest.mark.parametrize("periodic", [False, True], ids=["open", "periodic"])
@pytest.mark.parametrize(("shape", "mask"), MAPS, ids=str)
def test_pool_finds_the_extremes_and_cliffs_of_every_block(engine, shape, mask, periodic, shift):
    """Exactly, on maps that blocks divide and do not, round the map or not, masked in either way."""
    heights = _map(*shape, mask)
    expected = _pooled(heights, shift, periodic, np.float32(2.5))
    assert expected[2].any() or shape == (1, 1)
    np.testing.assert_array_equal(_pool(engine, heights, shift, periodic, 2.5), expected)


def test_pool_of_blocks_without_ground(engine):
    """Neither a highest nor a lowest node, nor a cliff; the row and the column after a block count for its
    highest alone.
    """
    heights = np.full((16, 16), -1e30, np.float32)
    heights[8, 8] = 5
    found = _pool(engine, heights, 3, False, 0.0)
    assert (
        (found[0] == 5).all()
        and found[1, 1, 1] == 5
        and (found[1].ravel()[:3] == np.float32(1e30)).all()
        and not found[2].any()
    )
    assert (_pool(engine, np.full((16, 16), -1e30, np.float32), 3, True, 0.0)[0] == np.float32(-1e30)).all()


def test_pool_counts_a_cliff_once_and_not_round_the_map(engine):
    """A step of 3 along a whole edge between blocks is the blocks' on its left; the same step round the map
    is nobody's; 3 is not more than 3.
    """
    heights = np.zeros((16, 16), np.float32)
    heights[:, 8:] = 3
    assert (
        _pool(engine, heights, 3, True, 2.9)[2].tolist() == [[8, 0], [8, 0]]
        and not _pool(engine, heights, 3, True, 3.0)[2].any()
    )
    assert _pool(engine, heights.T, 3, True, 2.9)[2].tolist() == [[8, 8], [0, 0]]


# -- pick


def test_pick_takes_values_or_what_stands_for_none(engine):
    """Exactly, first and last value and repeated ones among them."""
    values, at = _rng().normal(size=1961).astype(np.float32), _rng(2).integers(-1, 1961, 301).astype(np.int32)
    at[:5] = -1, 0, 1960, 0, -7
    found = engine.empty((301,), np.float32, np.nan)
    given = engine.upload(values), engine.upload(at)
    engine.launch("pilot", "pick", (301,), *given, found, 301, -1e30, lanes=1)
    np.testing.assert_array_equal(engine.download(found), np.where(at >= 0, values[at], np.float32(-1e30)))


# -- place


@pytest.mark.parametrize("turned", [False, True])
def test_place_puts_maps_where_their_numbers_say(engine, turned):
    """Layers of other numbers are left alone; nan where the map is masked."""
    maps = _rng(3).normal(size=(3, ROWS, COLS)).astype(np.float32)
    maps[1, 2, 3] = -np.inf  # a horizon without ground
    depth = np.where(_rng(4).random(SHAPE) < 0.3, np.inf, 1).astype(np.float32)
    numbers = np.array([4, 0, 2], np.int32)
    stack = engine.empty((5, ROWS * COLS), np.float32, 7)
    given = np.swapaxes(maps, 1, 2) if turned else maps
    arrays = (engine.upload(a) for a in (np.ascontiguousarray(given).reshape(3, -1), depth.ravel(), numbers))
    engine.launch("ground", "place", (COLS, ROWS, 3), *arrays, stack, ROWS, COLS, 3, int(turned))
    expected = np.full((5, ROWS, COLS), np.float32(7))
    expected[numbers] = np.where(np.isinf(depth), np.float32(np.nan), maps)
    np.testing.assert_array_equal(engine.download(stack).reshape(expected.shape), expected)


# -- correct


def _correct(engine, gx, gy, table, before, margin=3):
    rows, cols = before.shape
    tilts = np.stack([_padded(gx, margin), _padded(gy, margin)])
    given, light = (
        [engine.upload(np.asarray(a, np.float32)) for a in (tilts, table)],
        engine.upload(before.astype(np.float32).ravel()),
    )
    engine.launch(
        "ground",
        "correct",
        (cols, rows),
        *given,
        light,
        rows,
        cols,
        margin,
        tilts.shape[1],
        len(table),
        lanes=1,
    )
    return engine.download(light).reshape(rows, cols)


def _slopes():
    """From level to a cliff, in all directions and along the axes."""
    gx, gy = (
        10.0 ** _rng(3).uniform(-3, 4, (2, *SHAPE))
        * _rng(4).choice([-1, 1, 0], (2, *SHAPE), p=[0.45, 0.45, 0.1])
    ).astype(np.float32)
    gx[0], gy[0] = 1e6, 0
    gx[1], gy[1] = 0, -1e6
    return gx, gy


@pytest.mark.parametrize("side", [2, 9, 32])
def test_correct_multiplies_by_a_table_of_normals(engine, side):
    """A table that is linear in u and v is met exactly between its elements, up to its corners and rims."""
    gx, gy = _slopes()
    before = _rng(5).random(SHAPE).astype(np.float32)
    v, u = np.mgrid[:side, :side]
    up = 1 / np.sqrt(1 + gx.astype(float) ** 2 + gy.astype(float) ** 2)
    at_u, at_v = ((g * up / (1 + up) + 1) * 0.5 * (side - 1) for g in (gx, gy))
    assert at_u.max() > (side - 1) * 0.999 and at_v.min() < 0.001 * (side - 1)
    _close(
        _correct(engine, gx, gy, 0.5 + 2 * u - 0.75 * v, before),
        np.maximum(0, before * (0.5 + 2 * at_u - 0.75 * at_v)),
    )


def test_correct_is_bilinear(engine):
    """In a table of anything, against the four elements and their weights."""
    (gx, gy), side = _slopes(), 9
    table = _rng(6).random((side, side)).astype(np.float32)
    up = 1 / np.sqrt(1 + gx.astype(float) ** 2 + gy.astype(float) ** 2)
    u, v = ((g * up / (1 + up) + 1) * 0.5 * (side - 1) for g in (gx, gy))
    i, j = np.minimum(u.astype(int), side - 2), np.minimum(v.astype(int), side - 2)
    expected = sum(
        abs(1 - a - (u - i)) * abs(1 - b - (v - j)) * table[j + b, i + a] for a in (0, 1) for b in (0, 1)
    )
    got = _correct(engine, gx, gy, table, np.ones(SHAPE))
    np.testing.assert_allclose(
        got, expected, rtol=0, atol=3 * CLOSE * abs(expected).max()
    )  # u, up to 8, is rounded itself


def test_correct_takes_the_middle_where_level(engine):
    """Exactly, and multiplies what was there; what is negative becomes 0."""
    table, before = _rng(7).random((9, 9)).astype(np.float32), _rng(8).normal(size=SHAPE).astype(np.float32)
    level = np.zeros(SHAPE, np.float32)
    np.testing.assert_array_equal(
        _correct(engine, level, level, table, before), np.maximum(0, before * table[4, 4])
    )


def test_correct_takes_the_rim_where_steep(engine):
    """A column is by gx and a row by gy; nothing past the last column is read, not even to be weighted with
    0.
    """
    table = _rng(7).random((9, 9)).astype(np.float32)
    level, steep = (
        np.zeros(SHAPE, np.float32),
        np.full(SHAPE, 1e8, np.float32),
    )  # whose up is nothing: u = side - 1
    table[:, 0] = np.nan
    np.testing.assert_array_equal(
        _correct(engine, steep, level, table, np.ones(SHAPE)), table[4, 7] + (table[4, 8] - table[4, 7])
    )
    np.testing.assert_array_equal(
        _correct(engine, level, steep, table, np.ones(SHAPE)), table[7, 4] + (table[8, 4] - table[7, 4])
    )


def test_correct_writes_into_sums_that_hold_irradiance(engine):
    """gather leaves float32 in an array of int32, which correct and halves take as it is."""
    before, other = (_rng(n).random(ROWS * COLS).astype(np.float32) for n in (9, 10))
    a, b, tilts, table = (
        engine.upload(v)
        for v in (
            before.view(np.int32),
            other.view(np.int32),
            np.zeros((2, ROWS * COLS), np.float32),
            np.full((3, 3), 1.5, np.float32),
        )
    )
    engine.launch("ground", "correct", (COLS, ROWS), tilts, table, a, ROWS, COLS, 0, ROWS * COLS, 3, lanes=1)
    np.testing.assert_array_equal(engine.download(a).view(np.float32), before * np.float32(1.5))
    engine.launch("ground", "halves", (ROWS * COLS,), a, b, ROWS * COLS, 0, lanes=1)
    np.testing.assert_array_equal(engine.download(b).view(np.float32), (other - before * np.float32(1.5)) / 2)


# -- halves, judge


def test_halves_are_mean_and_half_difference(engine):
    """Exactly, and nothing past count is touched."""
    a, b = _rng().normal(size=(2, ROWS * COLS)).astype(np.float32)
    on = engine.upload(a), engine.upload(b)
    count = ROWS * COLS - 7
    engine.launch("ground", "halves", (count,), *on, count, 0, lanes=1)
    mean, half = (engine.download(v) for v in on)
    np.testing.assert_array_equal(mean[:-7], ((a + b) / 2)[:-7])
    np.testing.assert_array_equal(half[:-7], ((b - a) / 2)[:-7])
    np.testing.assert_array_equal(np.stack([mean, half])[:, -7:], np.stack([a, b])[:, -7:])
    on = engine.upload(a), engine.upload(b)
    engine.launch("ground", "halves", (count,), *on, count, 1, lanes=1)
    half, kept = (engine.download(v) for v in on)
    np.testing.assert_array_equal(half[:-7], ((b - a) / 2)[:-7])
    np.testing.assert_array_equal(kept, b)
    np.testing.assert_array_equal(half[-7:], a[-7:])


@pytest.mark.parametrize("block", [1, 8, 10, 37, 64])
def test_judge_sums_over_valid_nodes(engine, block):
    """Exactly, row by row in float32; what a masked node holds, nan even, counts for nothing."""
    heights, margin, limit = _map(), 4, np.float32(0.4)
    known = heights > -1e29
    image, half = (_rng(n).normal(size=SHAPE).astype(np.float32) for n in (11, 12))
    image[3], half[4] = 0, limit
    image[~known] = half[~known] = np.nan
    blocks = -(-ROWS // block)
    given = [engine.upload(v) for v in (_padded(heights, margin), image, half)]
    found = engine.empty((5, blocks, COLS), np.float32, np.nan)
    engine.launch("ground", "judge", (COLS, blocks), *given, found, ROWS, COLS, margin, block, limit, lanes=1)
    got = engine.download(found)
    terms = np.where(
        known, np.stack([image, half * half, known, image > 0, abs(half) > limit]), np.float32(0)
    )
    np.testing.assert_array_equal(
        got, np.stack([_in_order(terms[:, y : y + block], 1) for y in range(0, ROWS, block)], 1)
    )
    assert (
        got.shape == (5, blocks, COLS)
        and got[2].sum() == known.sum()
        and all(0 < number.sum() < known.sum() for number in got[3:])
    )
    _close(got[:2].sum(1, dtype=float), np.where(known, [image, half.astype(float) ** 2], 0).sum(1))


def test_numpy_kernels_take_the_same_arguments():
    """Names and order as in OpenCL; those of ground are compared beside horizon's."""
    text = re.sub(r"/\*.*?\*/", "", skylamp.opencl.source("pilot"), flags=re.S)
    kernels = dict(re.findall(r"__kernel void (\w+)\((.*?)\)", text, re.S))
    assert set(kernels) == {"pilot", "pool", "pick"}
    for name, arguments in kernels.items():
        assert [*inspect.signature(getattr(numpy_pilot, name)).parameters] == [
            re.search(r"\w+$", a.strip()).group() for a in arguments.split(",")
        ], name
