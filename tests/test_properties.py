"""Properties of visibility that hold for every map, with examples drawn by hypothesis."""

import numpy as np
import pytest
from compare import assert_bits_equal
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import skylamp as sl

SHAPES = st.tuples(st.integers(1, 12), st.integers(1, 19))
WHOLE = SHAPES.flatmap(lambda shape: hnp.arrays(np.int64, shape, elements=st.integers(0, 9)))
REAL = SHAPES.flatmap(
    lambda shape: hnp.arrays(np.float32, shape, elements=st.floats(0, 40, width=32, allow_subnormal=True))
)
SIDES = st.sampled_from(["open", "dark", "periodic"])
SKY = sl.Sky()
CUBE = sl.Hemicube(5)


def flags(depth, backend, sides="open", spacing=1.0, filled=False):
    return CUBE.unpack(
        sl.visibility(sl.Scene(depth, spacing, sides=sides), SKY, CUBE, backend, filled=filled)
    )


def same(got, expected):
    """As bits, also where symmetry makes the two share memory or no memory at all."""
    assert_bits_equal(np.array(got, order="C"), np.array(expected, order="C"))


@pytest.mark.slow
@given(depth=WHOLE, sides=SIDES, filled=st.booleans(), data=st.data())
def test_raising_an_occluder_never_reveals_another_node(backend, depth, sides, filled, data):
    """A node that comes nearer can only take light from the others."""
    row, col = (data.draw(st.integers(0, n - 1)) for n in depth.shape)
    before = flags(depth, backend, sides, filled=filled)
    higher = depth.copy()
    higher[row, col] = data.draw(st.integers(0, int(depth[row, col])))
    after = flags(higher, backend, sides, filled=filled)
    after[row, col] = False  # it may see more itself
    assert not (after & ~before).any()


@pytest.mark.slow
@given(
    depth=REAL,
    sides=SIDES,
    filled=st.booleans(),
    power=st.integers(-20, 20),
    spacing=st.sampled_from([1.0, 0.7, 30.0]),
)
def test_scaling_by_a_power_of_two_changes_nothing(backend, depth, sides, filled, power, spacing):
    """The unit of length is the caller's: every comparison scales exactly."""
    depth = np.where(depth < 1e-3, np.float32(0), depth)  # what underflows does not scale
    same(
        flags(depth * np.float32(2.0**power), backend, sides, spacing * 2.0**power, filled),
        flags(depth, backend, sides, spacing, filled),
    )


@pytest.mark.slow
@given(depth=WHOLE, sides=SIDES, filled=st.booleans())
def test_transposed_maps_see_transposed_directions(backend, depth, sides, filled):
    """Rows and columns are treated alike by every walk, with and without filling."""
    number = {tuple(s): d for d, s in enumerate(CUBE.steps.tolist())}
    order = [number[j, i, k] for i, j, k in CUBE.steps.tolist()]
    same(
        flags(depth.T, backend, sides, filled=filled)[..., order].transpose(1, 0, 2),
        flags(depth, backend, sides, filled=filled),
    )


@given(
    depth=WHOLE,
    sides=st.sampled_from(["open", "periodic"]),
    filled=st.booleans(),
    axis=st.sampled_from([0, 1]),
)
def test_mirrored_maps_see_mirrored_directions(backend, depth, sides, filled, axis):
    """East and west, north and south; a dark box is left out, since its edges are half-open."""
    number = {tuple(s): d for d, s in enumerate(CUBE.steps.tolist())}
    order = [number[(i if axis == 0 else -i), (j if axis == 1 else -j), k] for i, j, k in CUBE.steps.tolist()]
    same(
        np.flip(flags(np.flip(depth, axis), backend, sides, filled=filled)[..., order], axis),
        flags(depth, backend, sides, filled=filled),
    )


@given(depth=WHOLE, filled=st.booleans(), down=st.integers(0, 11), right=st.integers(0, 18))
def test_a_periodic_map_may_be_cut_anywhere(backend, depth, filled, down, right):
    """Rolling the map rolls the answer: no seam."""
    rolled = flags(np.roll(depth, (down, right), (0, 1)), backend, "periodic", filled=filled)
    same(np.roll(rolled, (-down, -right), (0, 1)), flags(depth, backend, "periodic", filled=filled))


@pytest.mark.slow
@given(
    shape=SHAPES,
    level=st.floats(0, 1e6, width=32),
    sides=st.sampled_from(["open", "periodic"]),
    filled=st.booleans(),
    spacing=st.floats(1e-3, 1e4),
)
def test_a_flat_plane_is_fully_visible(backend, shape, level, sides, filled, spacing):
    """At any depth and spacing; rounding must not make a plane shade itself."""
    scene = sl.Scene(np.full(shape, level), spacing, sides=sides)
    for size in (5, 9):
        cube = sl.Hemicube(size)
        assert cube.unpack(sl.visibility(scene, SKY, cube, backend, filled=filled)).all()


@given(depth=WHOLE, step=st.integers(1, 50))
def test_sinking_an_open_map_changes_nothing(backend, depth, step):
    """Under a sky with open sides only differences of depth count."""
    same(flags(depth + step, backend), flags(depth, backend))


KINDS = {
    "Fortran order": lambda a: np.asfortranarray(a.astype(np.float32)),
    "big-endian": lambda a: a.astype(">f4"),
    "big-endian integers": lambda a: a.astype(">i2"),
    "uint8": lambda a: a.astype(np.uint8),
    "int64": lambda a: a.astype(np.int64),
    "float16": lambda a: a.astype(np.float16),
    "float64": lambda a: a.astype(np.float64),
    "negative strides": lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
    "every second element": lambda a: np.repeat(np.repeat(a, 2, 0), 2, 1)[::2, 1::2],
    "read-only": lambda a: np.frombuffer(a.astype(np.float32).tobytes(), np.float32).reshape(a.shape),
    "list": lambda a: a.tolist(),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
@given(depth=WHOLE)
def test_layout_and_type_of_the_input_do_not_matter(fast, kind, depth):
    """The same numbers give the same bytes, however they lie in memory."""
    expected = sl.visibility(sl.Scene(depth.astype(np.float32)), SKY, 3, fast)
    assert_bits_equal(sl.visibility(sl.Scene(KINDS[kind](depth)), SKY, 3, fast), expected)
