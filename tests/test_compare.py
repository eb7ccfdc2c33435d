"""The comparators fail when they should."""

import numpy as np
import pytest
from compare import assert_bits_equal, assert_close

WORDS = np.arange(12, dtype=np.uint32).reshape(3, 4)
FLOATS = np.linspace(0.5, 4, 12, dtype=np.float32).reshape(3, 4)


def changed(array, index, value):
    out = array.copy()
    out[index] = value
    return out


def test_equal_arrays_pass():
    """The comparators do not refuse everything."""
    assert_bits_equal(WORDS.copy(), WORDS)
    assert_bits_equal(FLOATS.copy(), FLOATS)
    assert_close(FLOATS.copy(), FLOATS.astype(np.float64))
    assert_close(FLOATS * np.float32(1 + 5e-6), FLOATS.astype(np.float64))


@pytest.mark.parametrize("bit", [0, 13, 31])
@pytest.mark.parametrize("index", [(0, 0), (1, 2), (2, 3)])
def test_one_flipped_bit_fails(bit, index):
    """Any bit of any element, the first and the last too; the message says where."""
    with pytest.raises(
        AssertionError, match=rf"1 of 12 elements differ, first at \({index[0]}, {index[1]}\)"
    ):
        assert_bits_equal(changed(WORDS, index, WORDS[index] ^ np.uint32(1 << bit)), WORDS)


@pytest.mark.parametrize(
    "got",
    [
        WORDS,
        WORDS[:],
        WORDS.view(np.int32),
        WORDS.astype(np.int32),
        WORDS.astype(np.uint64),
        WORDS[:2].copy(),
        WORDS.ravel().copy(),
        WORDS[None].copy(),
        WORDS.tolist(),
        None,
    ],
    ids=[
        "same object",
        "view",
        "view of another type",
        "int32",
        "uint64",
        "fewer rows",
        "flat",
        "one axis more",
        "list",
        "None",
    ],
)
def test_bits_of_another_kind_fail(got):
    """Shared memory, another type, another shape: broadcasting must not hide any of them."""
    with pytest.raises(AssertionError):
        assert_bits_equal(got, WORDS)


def test_nan_fails_in_bits_even_against_nan():
    """Nothing that is compared bit for bit may hold NaN."""
    broken = changed(FLOATS, (1, 1), np.nan)
    for got, expected in ((broken, FLOATS), (FLOATS, broken), (broken.copy(), broken)):
        with pytest.raises(AssertionError, match="NaN"):
            assert_bits_equal(got, expected)


def test_negative_zero_is_not_zero_in_bits():
    """Bytes are compared, not values."""
    with pytest.raises(AssertionError):
        assert_bits_equal(np.array([-0.0], np.float32), np.array([0.0], np.float32))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf], ids=str)
def test_what_is_not_finite_is_never_close(value):
    """NaN against a number, a number against NaN, and NaN or infinity against itself."""
    broken, expected = changed(FLOATS, (2, 3), value), FLOATS.astype(np.float64)
    for a, b in (
        (broken, expected),
        (FLOATS, changed(expected, (2, 3), value)),
        (broken, changed(expected, (2, 3), value)),
    ):
        with pytest.raises(AssertionError, match=r"first at \(2, 3\)"):
            assert_close(a, b)


def test_two_bounds_off_fails_in_either_direction():
    """Just outside fails, too large and too small, at large and at small values."""
    for value in (0.0, 1e-3, 1.0, 1e6):
        for sign in (-1, 1):
            expected = np.array([value])
            got = (expected + sign * 2e-5 * max(1.0, value)).astype(np.float32)
            with pytest.raises(AssertionError):
                assert_close(got, expected)


@pytest.mark.parametrize(
    "got",
    [
        FLOATS.astype(np.float64),
        FLOATS.astype(np.float16),
        FLOATS[:2].copy(),
        FLOATS[:1].copy(),
        FLOATS[0, 0],
    ],
    ids=["float64", "float16", "rows", "row", "number"],
)
def test_close_arrays_of_another_kind_fail(got):
    """Another type or shape than the float32 image that is promised."""
    with pytest.raises(AssertionError):
        assert_close(got, FLOATS.astype(np.float64))


def test_a_backend_cannot_stand_in_for_the_oracle():
    """Expected values in float32 did not come from the float64 oracle."""
    with pytest.raises(AssertionError, match="not float64"):
        assert_close(FLOATS.copy(), FLOATS)


def test_empty_arrays_fail():
    """A comparison of nothing is a test that cannot fail."""
    for compare, types in (
        (assert_bits_equal, (np.uint32, np.uint32)),
        (assert_close, (np.float32, np.float64)),
    ):
        with pytest.raises(AssertionError, match="empty"):
            compare(*(np.empty((0, 4), t) for t in types))
