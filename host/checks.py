"""Checks of arguments before any work: one clear error each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import host_array
from .errors import InputError, bad


def real_array(values: Any, what: str, ndim: int | None = 2) -> np.ndarray:
    """``values`` as a real float64 array of ``ndim`` axes, not empty; always a copy."""
    return as_real(values, what, ndim).astype(np.float64)


def as_real(values: Any, what: str, ndim: int | None = 2) -> np.ndarray:
    """``values`` as a real array of its own type and ``ndim`` axes, not empty; a copy only if need be."""
    if isinstance(values, np.ma.MaskedArray):
        raise bad(
            f"{what}: a numpy masked array",
            "mask inside the array",
            "plain arrays",
            "Pass array.data and mask=~numpy.ma.getmaskarray(array), or array.filled(value) where no mask="
            " is taken.",
        )
    try:
        array = host_array(values)
    except Exception as error:
        raise InputError(f"{what}: not an array ({error}); allowed: a real array.") from error
    if array.dtype.kind not in "iuf":
        raise bad(f"{what}: wrong type", f"dtype {array.dtype}", "real numbers (integer or floating)")
    if ndim is not None and array.ndim != ndim:
        raise bad(
            f"{what}: wrong shape", array.shape, f"{ndim} axes" + (" (rows, cols)" if ndim == 2 else "")
        )
    if array.size == 0:
        raise bad(f"{what}: empty array", f"shape {array.shape}", "at least one element")
    if array.dtype == np.longdouble:
        with np.errstate(over="ignore"):  # beyond float64 it is infinite, which is refused where it must be
            return array.astype(np.float64)
    return array


def one_of(value: object, allowed: tuple[str, ...], what: str) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise bad(what, repr(value), " | ".join(allowed))


def number_or_nan(value: Any) -> float:
    """``value`` as a float, nan where it is no number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def positive_number(value: Any, what: str) -> float:
    try:
        if isinstance(value, (str, bytes, bool, np.bool_)):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise bad(f"{what}: not a number", repr(value), "a finite number > 0") from None
    if not (np.isfinite(number) and number > 0):
        raise bad(what, number, "a finite number > 0")
    return number


def whole_number(value: Any, what: str, least: int, most: int | None = None, allowed: str = "") -> int:
    """``value`` if it is a whole number from ``least`` to ``most``; ``allowed``: other words for these."""
    is_whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_whole or value < least or (most is not None and value > most):
        limits = f">= {least}" if most is None else f"from {least} to {most}"
        raise bad(what, repr(value), allowed or f"a whole number {limits}")
    return int(value)


def at(index: ArrayLike) -> str:
    """Where the first true element of a boolean array is, for messages."""
    return f"at (row, col) = {tuple(int(i) for i in np.argwhere(index)[0])}"
