"""The kernels of `gauss_newton` in NumPy, on all nodes at a time: twin of opencl/gauss_newton.cl."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...constants import (
    ALPHA,
    COARSENING,
    DAMPING,
    GAIN,
    LAMBDA,
    LEFT,
    NODES_PER_SUM,
    PRODUCT,
    SCATTERED,
    START,
    STOP_RATIO,
    UNIT_RV,
    UNIT_VV,
)
from .adjoint import _adjacent, _links

f32 = np.float32
Values = Any  # one per node, or one for all
Image = tuple[np.ndarray, ...]  # light and its links: light, held, first, second, near, far


def _neighbours(light: np.ndarray, rows: int, cols: int, sides: int) -> Iterator[tuple[np.ndarray, ...]]:
    """For the derivatives along x and y: by them, node before, node after, 1 over their distance."""
    y, x = (v.ravel() for v in np.indices((rows, cols)))
    if cols > 1:
        before, after, half = _adjacent(x, cols, sides)
        yield light[2], y * cols + before, y * cols + after, half
    if rows > 1:
        before, after, half = _adjacent(y, rows, sides)
        yield light[3], before * cols + x, after * cols + x, half


def _change(image: Image, v: np.ndarray, rows: int, cols: int, sides: int) -> Values:
    """The change of the light by changes ``v`` of the depths."""
    light, *links = image
    total = light[1] * v
    for by, before, after, half in _neighbours(light, rows, cols, sides):
        total += by * ((v[after] - v[before]) * half)
    for some, one, two, by_one, by_two in _links(*links):
        total[some] += by_one * v[one] + by_two * v[two]
    return total


def _spread(
    image: Image, sum: np.ndarray, u: np.ndarray, squared: bool, rows: int, cols: int, sides: int
) -> None:
    """Adds the transpose of :func:`_change`, or of its squares, times ``u``."""
    light, *links = image

    def add(to: np.ndarray, part: np.ndarray, u: np.ndarray) -> None:
        np.add.at(sum, to, ((part * part if squared else part) * u).astype(np.int64))

    add(np.arange(rows * cols), light[1], u)
    for by, before, after, half in _neighbours(light, rows, cols, sides):
        add(after, by * half, u)
        add(before, -(by * half), u)
    for some, one, two, by_one, by_two in _links(*links):
        add(one, by_one, u[some])
        add(two, by_two, u[some])


def _by_blocks(values: np.ndarray) -> np.ndarray:
    """Sums of NODES_PER_SUM values each, added one after another."""
    padded = np.zeros(-(-len(values) // NODES_PER_SUM) * NODES_PER_SUM)
    padded[: len(values)] = values
    return np.cumsum(padded.reshape(-1, NODES_PER_SUM), 1)[:, -1]


def _put(part: np.ndarray, block: int, values: np.ndarray) -> None:
    sums = _by_blocks(values)
    part.reshape(-1)[block : block + len(sums)] = sums


def albedo_sums(
    light: np.ndarray,
    gain: np.ndarray,
    target: np.ndarray,
    over: np.ndarray,
    under: np.ndarray,
    is_first: int,
    pixels: int,
) -> None:
    e = gain * light[0]
    over[:] = (f32(0) if is_first else over) + e * target
    under[:] = (f32(0) if is_first else under) + e * e


def albedo_gain(over: np.ndarray, under: np.ndarray, gain: np.ndarray, out: np.ndarray, pixels: int) -> None:
    out[:] = over / under * gain


def misfit(
    light: np.ndarray, gain: np.ndarray, target: np.ndarray, part: np.ndarray, block: int, pixels: int
) -> None:
    _put(part, block, (gain * light[0] - target).astype(np.float64) ** 2)


def _bend(v: np.ndarray) -> np.ndarray:
    """Second differences along rows of v, 0 at the ends."""
    out = np.zeros_like(v)
    if v.shape[1] > 2:
        out[:, 1:-1] = (v[:, :-2] - v[:, 1:-1]) - (v[:, 1:-1] - v[:, 2:])
    return out


def _unbend(v: np.ndarray, rows: int, cols: int) -> np.ndarray:
    v = v.reshape(rows, cols)
    along_rows, along_columns = (_unbent(_bend(z)) for z in (v, v.T))
    total: np.ndarray = (along_rows + along_columns.T).ravel()
    return total


def _unbent(bent: np.ndarray) -> np.ndarray:
    """The transpose of _bend."""
    out: np.ndarray = f32(-2) * bent
    out[:, 2:] += bent[:, 1:-1]
    out[:, :-2] += bent[:, 1:-1]
    return out


def bending(z: np.ndarray, rest: np.ndarray, part: np.ndarray, block: int, rows: int, cols: int) -> None:
    z, rest = z.reshape(rows, cols), rest.reshape(rows, cols)
    a, b = (v.ravel().astype(np.float64) for v in (_bend(z) - _bend(rest), (_bend(z.T) - _bend(rest.T)).T))
    _put(part, block, a * a + b * b)


def gradient(
    light: np.ndarray,
    held: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    gain: np.ndarray,
    target: np.ndarray,
    sum: np.ndarray,
    squares: np.ndarray,
    quanta: float,
    fine: float,
    rows: int,
    cols: int,
    count: int,
    sides: int,
    per_item: int,
    copies: int,
) -> None:
    image = light, held, first, second, near, far
    _spread(image, sum[0], gain * (gain * light[0] - target) * f32(quanta), False, rows, cols, sides)
    _spread(image, squares[0], gain * gain * f32(fine), True, rows, cols, sides)


def descent(
    z: np.ndarray,
    rest: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    sum: np.ndarray,
    squares: np.ndarray,
    scale: np.ndarray,
    r: np.ndarray,
    x: np.ndarray,
    p: np.ndarray,
    s: np.ndarray,
    is_free: np.ndarray,
    quantum: float,
    fine: float,
    least: float,
    lambda_: float,
    rows: int,
    cols: int,
    per_item: int,
    copies: int,
) -> None:
    steepest = -(
        sum[0].astype(f32) * f32(quantum)
        + f32(lambda_) * (_unbend(z, rows, cols) - _unbend(rest, rows, cols))
    )
    is_free[:] = ~(((z <= low) & (steepest < 0)) | ((z >= high) & (steepest > 0)))
    scale[:] = squares[0].astype(f32) * f32(fine) + f32(least)
    r[:] = is_free * steepest
    for array in (sum, squares, x, p, s):
        array[:] = 0


# shares of a coarse node in the fine ones about it: a hat, 1, 3, 5, 7, 7, 5, 3, 1 eighths
HAT_NODES = 2 * COARSENING
HAT = np.array([2 * min(a, HAT_NODES - 1 - a) + 1 for a in range(HAT_NODES)], f32) / f32(HAT_NODES)


def _restricted(v: np.ndarray) -> np.ndarray:
    """Rows of v, restricted to a line of nodes COARSENING times as coarse."""
    size, few = len(v), (len(v) - 1) // COARSENING + 1
    total = np.zeros((few, *v.shape[1:]), f32)
    for a, share in enumerate(HAT):
        at = COARSENING * np.arange(few) - 2 + a
        shares = np.full(few, share)
        shares[0 if a < COARSENING else -1] = 1
        some = (at >= 0) & (at < size)
        total[some] += shares[some, None] * v[at[some]]
    return total


def restriction(
    fine: np.ndarray, scale: np.ndarray, to: np.ndarray, times: float, divides: int, rows: int, cols: int
) -> None:
    to[:] = f32(times) * _restricted(_restricted(fine.reshape(rows, cols)).T).T.ravel()
    if divides:
        to /= scale


def _prolonged(v: np.ndarray, size: int) -> Values:
    """Rows of v, prolonged by linear interpolation to so many."""
    at, k = np.divmod(np.arange(size), COARSENING)
    neighbour = np.clip(np.where(k < 2, at - 1, at + 1), 0, len(v) - 1)
    share = (np.where(k < 2, 3 - 2 * k, 2 * k - 3).astype(f32) / f32(2 * COARSENING))[:, None]
    return (1 - share) * v[at] + share * v[neighbour]


def prolongation(
    r: np.ndarray,
    scale: np.ndarray,
    is_free: np.ndarray,
    coarse: np.ndarray,
    v: np.ndarray,
    rows: int,
    cols: int,
) -> None:
    v[:] = is_free * (
        r / scale
        + _prolonged(_prolonged(coarse.reshape((rows - 1) // COARSENING + 1, -1), rows).T, cols).T.ravel()
    )


def inner_products(r: np.ndarray, v: np.ndarray, part: np.ndarray, pixels: int) -> None:
    a, b = (array.astype(np.float64) for array in (r, v))
    part.reshape(-1)[:] = np.concatenate([_by_blocks(b * b), _by_blocks(a * b)])


def product(
    light: np.ndarray,
    held: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    gain: np.ndarray,
    v: np.ndarray,
    sum: np.ndarray,
    state: np.ndarray,
    rows: int,
    cols: int,
    count: int,
    sides: int,
    per_item: int,
    copies: int,
) -> None:
    if state[LEFT] > 0:
        image = light, held, first, second, near, far
        change = gain * gain * _change(image, v, rows, cols, sides) * f32(state[SCATTERED])
        _spread(image, sum[0], change, False, rows, cols, sides)


def albedo_change(
    light: np.ndarray,
    held: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    gain: np.ndarray,
    bare: np.ndarray,
    v: np.ndarray,
    share: np.ndarray,
    state: np.ndarray,
    rows: int,
    cols: int,
    count: int,
    sides: int,
    is_first: int,
    per_item: int,
) -> None:
    if state[LEFT] > 0:
        image = light, held, first, second, near, far
        own = bare * light[0] * (gain * _change(image, v, rows, cols, sides))
        share[:] = own if is_first else share + own


def reduced_product(
    light: np.ndarray,
    held: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    gain: np.ndarray,
    bare: np.ndarray,
    share: np.ndarray,
    under: np.ndarray,
    v: np.ndarray,
    sum: np.ndarray,
    state: np.ndarray,
    rows: int,
    cols: int,
    count: int,
    sides: int,
    per_item: int,
    copies: int,
) -> None:
    if state[LEFT] > 0:
        image = light, held, first, second, near, far
        left = gain * _change(image, v, rows, cols, sides) - bare * light[0] * (share / under)
        _spread(image, sum[0], gain * left * f32(state[SCATTERED]), False, rows, cols, sides)


def normal_product(
    r: np.ndarray,
    v: np.ndarray,
    scale: np.ndarray,
    is_free: np.ndarray,
    sum: np.ndarray,
    w: np.ndarray,
    totals: np.ndarray,
    state: np.ndarray,
    rows: int,
    cols: int,
    per_item: int,
    copies: int,
) -> None:
    if state[LEFT] > 0:
        bent = f32(state[LAMBDA]) * _unbend(v, rows, cols)
        w[:] = is_free * (
            sum[0].astype(f32) * f32(1 / state[SCATTERED]) + bent + f32(state[DAMPING]) * scale * v
        )
        sum[:] = 0
        a, b, c = (array.astype(np.float64) for array in (r, v, w))
        for n, values in enumerate((a * b * state[UNIT_RV], b * c * state[UNIT_RV], b * b * state[UNIT_VV])):
            totals[n, 0] = values.astype(np.int64).sum()


def conjugate_step(
    v: np.ndarray,
    w: np.ndarray,
    r: np.ndarray,
    x: np.ndarray,
    p: np.ndarray,
    s: np.ndarray,
    totals: np.ndarray,
    next_totals: np.ndarray,
    state: np.ndarray,
    next: np.ndarray,
    fixed_: float,
    exact: float,
    pixels: int,
    per_item: int,
) -> None:
    next[:] = state
    if state[LEFT] <= 0:
        return
    next_totals[:] = 0
    product, curvature, square = totals[:, 0] / state[[UNIT_RV, UNIT_RV, UNIT_VV]]
    beta = 0.0
    if state[ALPHA] != 0:
        beta = product / state[PRODUCT]
        curvature -= beta * product / state[ALPHA]
    else:
        next[START] = product
    if not (product > state[STOP_RATIO] * next[START] and curvature > 0):
        next[LEFT] = 0
        return
    step = product / curvature
    next[[LEFT, SCATTERED]] = state[LEFT] - 1, fixed_ / np.sqrt(square)
    next[[UNIT_RV, UNIT_VV]] = exact / product, exact / square
    next[[PRODUCT, ALPHA, GAIN]] = product, step, state[GAIN] + 0.5 * step * product
    alpha, share = f32(step), f32(beta)
    p[:] = v + share * p
    s[:] = w + share * s
    x += alpha * p
    r -= alpha * s


def start(
    state: np.ndarray,
    totals: np.ndarray,
    square: float,
    product: float,
    lambda_: float,
    damping: float,
    least: float,
    fixed_: float,
    exact: float,
    most: int,
) -> None:
    totals[:] = state[:] = 0
    state[[LEFT, SCATTERED]] = most, fixed_ / np.sqrt(square)
    state[[UNIT_RV, UNIT_VV]] = exact / product, exact / square
    state[[LAMBDA, DAMPING, STOP_RATIO]] = lambda_, damping, least


def bounded_step(
    z: np.ndarray,
    x: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    to: np.ndarray,
    pixels: int,
    per_item: int,
) -> None:
    to[:] = np.minimum(np.maximum(z + x, low), high)
