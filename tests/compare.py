"""The only two comparators of the suite. Each can fail, and tests/test_compare.py shows it.

Both refuse an array that is compared with itself, and NaN never passes.
"""

import numpy as np

# A float32 sum of n terms, each of a few roundings, is off by at most about (n + 8) / 2 ulp: 209 directions
# give 217 x 6e-8 = 1.3e-5 at worst and about its square root, 1e-6, as a rule. 1e-5 is what the design
# promises.
RADIANCE = 1e-5


def _distinct_arrays(got, expected):
    assert isinstance(got, np.ndarray) and isinstance(expected, np.ndarray), (
        f"not arrays: {type(got)}, {type(expected)}"
    )
    assert got is not expected and not np.shares_memory(got, expected), (
        "an array compared with itself says nothing"
    )
    assert got.shape == expected.shape, f"shape {got.shape}, expected {expected.shape}"
    assert got.size, "empty arrays compare nothing"


def assert_bits_equal(got, expected):
    """Same type, shape and bytes; NaN fails, since no result that is compared in bits may hold one."""
    _distinct_arrays(got, expected)
    assert got.dtype == expected.dtype, f"dtype {got.dtype}, expected {expected.dtype}"
    if got.dtype.kind == "f":
        assert not np.isnan(got).any() and not np.isnan(expected).any(), "NaN"
    a, b = (np.ascontiguousarray(v).view(np.uint8).reshape(v.size, v.itemsize) for v in (got, expected))
    wrong = np.flatnonzero((a != b).any(1))
    if len(wrong):
        first = np.unravel_index(wrong[0], got.shape)
        raise AssertionError(
            f"{len(wrong)} of {got.size} elements differ, first at {tuple(map(int, first))}: {got[first]!r},"
            f" expected {expected[first]!r}"
        )


def assert_close(got, expected, relative=RADIANCE, floor=1.0):
    """float32 ``got`` within relative x max(floor, |expected|) of float64 ``expected``, and finite.

    The types differ on purpose: a backend is compared with the float64 oracle, so never with itself or
    another backend. ``floor``: the magnitude of the terms where they may cancel, the source's brightness
    unless given.
    """
    _distinct_arrays(got, expected)
    assert got.dtype == np.float32, f"dtype {got.dtype}, expected float32"
    assert expected.dtype == np.float64, f"the expected values are {expected.dtype}, not float64"
    bound = relative * np.maximum(floor, np.abs(expected))
    within = np.abs(got.astype(np.float64) - expected) <= bound  # False for NaN
    within &= np.isfinite(got) & np.isfinite(expected)
    if not within.all():
        first = tuple(map(int, np.argwhere(~within)[0]))
        raise AssertionError(
            f"{(~within).sum()} of {got.size} elements are off, first at {first}: {got[first]!r}, expected"
            f" {expected[first]!r}, bound {bound[first]:.3g}"
        )
