"""Least squares for the inverse problem (docs/explanation): the misfit of images and its gradient by depth,
products with the Gauss-Newton matrix, and the conjugate gradients that solve with it. Twin of
opencl/gauss_newton.cl.

Lengths are in spacings. The arrays of an image and its links are those of adjoint.py; J is the derivative
of E by depth, one row per node. Sums over nodes are added in whole numbers or in one order, so that every
backend finds the same bits.
"""

import warp as wp

from skylamp.constants import (
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
    SUM_SLOTS,
    UNIT_RV,
    UNIT_VV,
)

from . import OPTIONS
from .adjoint import half_within, link_at, on_line, rise_at

wp.set_module_options(OPTIONS)


@wp.func
def change_at(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    v: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    p: wp.int32,
):
    """Row p of J, the derivative of E by depth, times v: by how much E changes there."""
    pixels = rows * cols
    x = p % cols
    y = p / cols
    sum = light[pixels + p] * v[p]
    if cols > 1:
        sum += light[2 * pixels + p] * rise_at(v, y * cols, x, cols, 1, sides)
    if rows > 1:
        sum += light[3 * pixels + p] * rise_at(v, x, y, rows, cols, sides)
    for k in range(held[p]):
        e = link_at(p, k, count)
        sum += near[e] * v[first[e]] + far[e] * v[second[e]]
    return sum


@wp.func
def add(sum: wp.array[wp.int64], to: wp.int32, part: wp.float32, u: wp.float32, squared: wp.int32):
    if squared != 0:
        wp.atomic_add(sum, to, wp.int64(part * part * u))
    else:
        wp.atomic_add(sum, to, wp.int64(part * u))


@wp.func
def spread_at(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    u: wp.float32,
    squared: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    p: wp.int32,
):
    """sum += row p of J times u, in whole numbers, so that no order of summation matters; its elements
    squared if asked for.
    """
    pixels = rows * cols
    x = p % cols
    y = p / cols
    add(sum, p, light[pixels + p], u, squared)
    if cols > 1:
        part = light[2 * pixels + p] * half_within(x, cols, sides)
        add(sum, y * cols + on_line(x + 1, cols, sides), part, u, squared)
        add(sum, y * cols + on_line(x - 1, cols, sides), -part, u, squared)
    if rows > 1:
        part = light[3 * pixels + p] * half_within(y, rows, sides)
        add(sum, on_line(y + 1, rows, sides) * cols + x, part, u, squared)
        add(sum, on_line(y - 1, rows, sides) * cols + x, -part, u, squared)
    for k in range(held[p]):
        e = link_at(p, k, count)
        add(sum, first[e], near[e], u, squared)
        add(sum, second[e], far[e], u, squared)


@wp.kernel
def albedo_sums(
    light: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    target: wp.array[wp.float32],
    over: wp.array[wp.float32],
    under: wp.array[wp.float32],
    is_first: wp.int32,
    pixels: wp.int32,
):
    """Over and under: what an image adds to those of its pixels' albedo, over / under: the one with which all
    images are nearest to their targets, gain that of albedo 1. The first sets them.
    """
    p = wp.tid()
    e = gain[p] * light[p]
    if is_first != 0:
        over[p] = wp.float32(0.0)
        under[p] = wp.float32(0.0)
    over[p] = over[p] + e * target[p]
    under[p] = under[p] + e * e


@wp.kernel
def albedo_gain(
    over: wp.array[wp.float32],
    under: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    out: wp.array[wp.float32],
    pixels: wp.int32,
):
    """The gain with that albedo."""
    p = wp.tid()
    out[p] = over[p] / under[p] * gain[p]


@wp.kernel
def misfit(
    light: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    target: wp.array[wp.float32],
    part: wp.array[wp.float64],
    block: wp.int32,
    pixels: wp.int32,
):
    """In part (blocks), from ``block`` on, the sums of (gain E - target)^2.

    Thread g of this, of bending and of descent owns NODES_PER_SUM nodes and adds them in order."""
    g = wp.tid()
    square = wp.float64(0.0)
    for p in range(g * NODES_PER_SUM, wp.min(pixels, g * NODES_PER_SUM + NODES_PER_SUM)):
        r = gain[p] * light[p] - target[p]
        square += wp.float64(r) * wp.float64(r)
    part[block + g] = square


@wp.func
def bend(v: wp.array[wp.float32], p: wp.int32, i: wp.int32, n: wp.int32, step: wp.int32):
    """Second difference of v along a line of n nodes, ``step`` apart in memory, about node i of it, at p; 0
    at the ends.
    """
    if i < 1 or i > n - 2:
        return wp.float32(0.0)
    return (v[p - step] - v[p]) - (v[p] - v[p + step])


@wp.func
def unbend(v: wp.array[wp.float32], p: wp.int32, i: wp.int32, n: wp.int32, step: wp.int32):
    """The transpose of bend, of itself."""
    sum = -2.0 * bend(v, p, i, n, step)
    if i > 1:
        sum += bend(v, p - step, i - 1, n, step)
    if i < n - 2:
        sum += bend(v, p + step, i + 1, n, step)
    return sum


@wp.kernel
def bending(
    z: wp.array[wp.float32],
    rest: wp.array[wp.float32],
    part: wp.array[wp.float64],
    block: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
):
    """In part (blocks), from ``block`` on, the sums of squared second differences of z - rest along rows and
    columns.
    """
    g = wp.tid()
    pixels = rows * cols
    sum = wp.float64(0.0)
    for p in range(g * NODES_PER_SUM, wp.min(pixels, g * NODES_PER_SUM + NODES_PER_SUM)):
        a = bend(z, p, p % cols, cols, 1) - bend(rest, p, p % cols, cols, 1)
        b = bend(z, p, p / cols, rows, cols) - bend(rest, p, p / cols, rows, cols)
        sum += wp.float64(a) * wp.float64(a) + wp.float64(b) * wp.float64(b)
    part[block + g] = sum


@wp.kernel
def gradient(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    target: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    squares: wp.array[wp.int64],
    quanta: wp.float32,
    fine: wp.float32,
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    per_item: wp.int32,
    copies: wp.int32,
):
    """sum += quanta transpose(J) gain (gain E - target), and squares += fine x the diagonal of transpose(J)
    gain^2 J, or what it is where no two links of a node lead to the same one. Sums are in fixed point:
    ``quanta`` is how many integers make 1, ``quantum`` the value of one. Thread g of this and of all below
    owns ``per_item`` nodes. Here there is one copy of the sums.
    """
    g = wp.tid()
    for p in range(g * per_item, wp.min(rows * cols, g * per_item + per_item)):
        spread_at(
            light,
            held,
            first,
            second,
            near,
            far,
            sum,
            gain[p] * (gain[p] * light[p] - target[p]) * quanta,
            0,
            rows,
            cols,
            count,
            sides,
            p,
        )
        spread_at(
            light,
            held,
            first,
            second,
            near,
            far,
            squares,
            gain[p] * gain[p] * fine,
            1,
            rows,
            cols,
            count,
            sides,
            p,
        )


@wp.kernel
def descent(
    z: wp.array[wp.float32],
    rest: wp.array[wp.float32],
    low: wp.array[wp.float32],
    high: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    squares: wp.array[wp.int64],
    scale: wp.array[wp.float32],
    r: wp.array[wp.float32],
    x: wp.array[wp.float32],
    p: wp.array[wp.float32],
    s: wp.array[wp.float32],
    is_free: wp.array[wp.float32],
    quantum: wp.float32,
    fine: wp.float32,
    least: wp.float32,
    lambda_: wp.float32,
    rows: wp.int32,
    cols: wp.int32,
    per_item: wp.int32,
    copies: wp.int32,
):
    """The descent direction r = -(sum quantum + lambda unbend (z - rest)), 0 where a bound holds z (free 0);
    scale = squares fine + least; x = p = s = sum = squares = 0 for conjugate gradients.
    """
    g = wp.tid()
    for i in range(g * per_item, wp.min(rows * cols, g * per_item + per_item)):
        smooth = (unbend(z, i, i % cols, cols, 1) + unbend(z, i, i / cols, rows, cols)) - (
            unbend(rest, i, i % cols, cols, 1) + unbend(rest, i, i / cols, rows, cols)
        )
        steepest = -(wp.float32(sum[i]) * quantum + lambda_ * smooth)
        moves = wp.float32(1.0)
        if (z[i] <= low[i] and steepest < 0.0) or (z[i] >= high[i] and steepest > 0.0):
            moves = 0.0
        scale[i] = wp.float32(squares[i]) * fine + least
        sum[i] = wp.int64(0)
        squares[i] = wp.int64(0)
        is_free[i] = moves
        r[i] = moves * steepest
        x[i] = 0.0
        p[i] = 0.0
        s[i] = 0.0


# The preconditioner: v = r / scale, and the same on grids COARSENING and COARSENING^2 times as coarse,
# brought up by linear interpolation (Bramble, Pasciak and Xu 1990); r is brought down by its transpose.


@wp.func
def hat(a: wp.int32, j: wp.int32, n: wp.int32):
    """Node j of a coarse line of n: its share in node COARSENING j - 2 + a of the fine one."""
    share = wp.float32(wp.min(2 * a + 1, 15 - 2 * a)) * 0.125
    if (a < COARSENING and j == 0) or (a >= COARSENING and j == n - 1):
        share = 1.0
    return share


@wp.func
def restricted(fine: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, x: wp.int32, y: wp.int32):
    """Node (x, y) of the restriction to a coarse grid from one of rows x cols."""
    n_rows = (rows - 1) / COARSENING + 1
    n_cols = (cols - 1) / COARSENING + 1
    sum = wp.float32(0.0)
    for a in range(wp.max(0, 2 - COARSENING * x), wp.min(2 * COARSENING, cols + 2 - COARSENING * x)):
        column = wp.float32(0.0)
        for b in range(wp.max(0, 2 - COARSENING * y), wp.min(2 * COARSENING, rows + 2 - COARSENING * y)):
            column += hat(b, y, n_rows) * fine[(COARSENING * y - 2 + b) * cols + COARSENING * x - 2 + a]
        sum += hat(a, x, n_cols) * column
    return sum


@wp.kernel
def restriction(
    fine: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    to: wp.array[wp.float32],
    times: wp.float32,
    divides: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
):
    """to = times the restriction of ``fine``; over ``scale``, if asked to divide."""
    y, x = wp.tid()
    sum = times * restricted(fine, rows, cols, x, y)
    j = y * ((cols - 1) / COARSENING + 1) + x
    if divides != 0:
        sum = sum / scale[j]
    to[j] = sum


@wp.func
def neighbour(i: wp.int32, n: wp.int32):
    """The coarse node that has a share in fine node i and is not its own."""
    step = wp.int32(-1)
    if i % COARSENING > 1:
        step = 1
    return wp.clamp(i / COARSENING + step, 0, n - 1)


@wp.func
def share_of(i: wp.int32):
    """Its share."""
    return wp.float32(wp.abs(2 * (i % COARSENING) - 3)) * 0.125


@wp.func
def prolong_at(
    r: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    is_free: wp.array[wp.float32],
    coarse: wp.array[wp.float32],
    v: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    x: wp.int32,
    y: wp.int32,
):
    """v = free (r / scale + the prolongation of a coarse grid) at node (x, y)."""
    n_cols = (cols - 1) / COARSENING + 1
    here = y / COARSENING * n_cols
    there = neighbour(y, (rows - 1) / COARSENING + 1) * n_cols
    along = share_of(y)
    own = (1.0 - along) * coarse[here + x / COARSENING] + along * coarse[there + x / COARSENING]
    other = (1.0 - along) * coarse[here + neighbour(x, n_cols)] + along * coarse[there + neighbour(x, n_cols)]
    across = share_of(x)
    i = y * cols + x
    v[i] = is_free[i] * (r[i] / scale[i] + ((1.0 - across) * own + across * other))


@wp.kernel
def prolongation(
    r: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    is_free: wp.array[wp.float32],
    coarse: wp.array[wp.float32],
    v: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
):
    """See prolong_at, for the nodes of row y that lie in a coarse one."""
    y, j = wp.tid()
    for x in range(COARSENING * j, wp.min(cols, COARSENING * j + COARSENING)):
        prolong_at(r, scale, is_free, coarse, v, rows, cols, x, y)


@wp.kernel
def inner_products(
    r: wp.array[wp.float32], v: wp.array[wp.float32], part: wp.array[wp.float64], pixels: wp.int32
):
    """In part (2, blocks) the sums of v v and of r v."""
    g = wp.tid()
    square = wp.float64(0.0)
    product = wp.float64(0.0)
    for i in range(g * NODES_PER_SUM, wp.min(pixels, g * NODES_PER_SUM + NODES_PER_SUM)):
        square += wp.float64(v[i]) * wp.float64(v[i])
        product += wp.float64(r[i]) * wp.float64(v[i])
    part[g] = square
    part[(pixels - 1) / NODES_PER_SUM + 1 + g] = product


# The state of conjugate gradients (float64): iterations left, 0 once it has stopped; units of the scattered
# sum and of r v, v w and v v, from the last ones' size; alpha, 0 before the first step; the first r v; what
# the quadratic model has gained; and what was asked for: lambda, damping, share of the first r v at which to
# stop. Two of them take turns, and so do the totals (3, SUM_SLOTS)
# of r v, v w and v v.
State = wp.types.vector(11, wp.float64)
Sums = wp.types.vector(3, wp.int64)


@wp.func
def product_at(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    v: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    quanta: wp.float32,
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    p: wp.int32,
):
    """See product."""
    change = change_at(light, held, first, second, near, far, v, rows, cols, count, sides, p)
    spread_at(
        light,
        held,
        first,
        second,
        near,
        far,
        sum,
        gain[p] * gain[p] * change * quanta,
        0,
        rows,
        cols,
        count,
        sides,
        p,
    )


@wp.kernel
def product(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    v: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    state: wp.array[wp.float64],
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    per_item: wp.int32,
    copies: wp.int32,
):
    """sum += quanta transpose(J) gain^2 J v."""
    g = wp.tid()
    if state[LEFT] > wp.float64(0.0):
        for p in range(g * per_item, wp.min(rows * cols, g * per_item + per_item)):
            product_at(
                light,
                held,
                first,
                second,
                near,
                far,
                gain,
                v,
                sum,
                wp.float32(state[SCATTERED]),
                rows,
                cols,
                count,
                sides,
                p,
            )


@wp.kernel
def albedo_change(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    bare: wp.array[wp.float32],
    v: wp.array[wp.float32],
    share: wp.array[wp.float32],
    state: wp.array[wp.float64],
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    is_first: wp.int32,
    per_item: wp.int32,
):
    """In (or added to) share, the part of the change of the pixels' albedo by v from one image: bright gain J
    v, bright = the image at albedo 1.
    """
    g = wp.tid()
    if state[LEFT] > wp.float64(0.0):
        for p in range(g * per_item, wp.min(rows * cols, g * per_item + per_item)):
            own = (
                bare[p]
                * light[p]
                * (gain[p] * change_at(light, held, first, second, near, far, v, rows, cols, count, sides, p))
            )
            if is_first != 0:
                share[p] = own
            else:
                share[p] = share[p] + own


@wp.kernel
def reduced_product(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    bare: wp.array[wp.float32],
    share: wp.array[wp.float32],
    under: wp.array[wp.float32],
    v: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    state: wp.array[wp.float64],
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    per_item: wp.int32,
    copies: wp.int32,
):
    """As product, less what a change of the albedo makes up for."""
    g = wp.tid()
    if state[LEFT] > wp.float64(0.0):
        for p in range(g * per_item, wp.min(rows * cols, g * per_item + per_item)):
            left = gain[p] * change_at(
                light, held, first, second, near, far, v, rows, cols, count, sides, p
            ) - bare[p] * light[p] * (share[p] / under[p])
            spread_at(
                light,
                held,
                first,
                second,
                near,
                far,
                sum,
                gain[p] * left * wp.float32(state[SCATTERED]),
                0,
                rows,
                cols,
                count,
                sides,
                p,
            )


@wp.func
def normal_product_at(
    r: wp.array[wp.float32],
    v: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    is_free: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    w: wp.array[wp.float32],
    quantum: wp.float32,
    lambda_: wp.float32,
    damping: wp.float32,
    by_product: wp.float64,
    by_square: wp.float64,
    rows: wp.int32,
    cols: wp.int32,
    i: wp.int32,
):
    """w = free (sum quantum + lambda unbend v + damping scale v), the normal equations' matrix times v;
    sum = 0; and what the node adds to r v, v w and v v.
    """
    smooth = unbend(v, i, i % cols, cols, 1) + unbend(v, i, i / cols, rows, cols)
    w[i] = is_free[i] * (wp.float32(sum[i]) * quantum + lambda_ * smooth + damping * scale[i] * v[i])
    sum[i] = wp.int64(0)
    product = wp.float64(r[i]) * wp.float64(v[i])
    curvature = wp.float64(v[i]) * wp.float64(w[i])
    square = wp.float64(v[i]) * wp.float64(v[i])
    return Sums(
        wp.int64(product * by_product), wp.int64(curvature * by_product), wp.int64(square * by_square)
    )


@wp.kernel
def normal_product(
    r: wp.array[wp.float32],
    v: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    is_free: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    w: wp.array[wp.float32],
    totals: wp.array[wp.int64],
    state: wp.array[wp.float64],
    rows: wp.int32,
    cols: wp.int32,
    per_item: wp.int32,
    copies: wp.int32,
):
    """See normal_product_at."""
    g = wp.tid()
    if state[LEFT] > wp.float64(0.0):
        part = Sums()
        quantum = wp.float32(wp.float64(1.0) / state[SCATTERED])
        for i in range(g * per_item, wp.min(rows * cols, g * per_item + per_item)):
            part += normal_product_at(
                r,
                v,
                scale,
                is_free,
                sum,
                w,
                quantum,
                wp.float32(state[LAMBDA]),
                wp.float32(state[DAMPING]),
                state[UNIT_RV],
                state[UNIT_VV],
                rows,
                cols,
                i,
            )
        wp.atomic_add(totals, g % SUM_SLOTS, part[0])
        wp.atomic_add(totals, SUM_SLOTS + g % SUM_SLOTS, part[1])
        wp.atomic_add(totals, 2 * SUM_SLOTS + g % SUM_SLOTS, part[2])


@wp.func
def iteration_of(state: wp.array[wp.float64], total: Sums, fixed_: wp.float64, exact: wp.float64):
    """The state after an iteration with these totals, beta, and whether it takes a step."""
    next = State()
    for i in range(11):
        next[i] = state[i]
    product = wp.float64(total[0]) / state[UNIT_RV]
    square = wp.float64(total[2]) / state[UNIT_VV]
    curvature = wp.float64(total[1]) / state[UNIT_RV]
    beta = wp.float64(0.0)
    takes_step = wp.int32(0)
    if state[ALPHA] != wp.float64(0.0):
        beta = product / state[PRODUCT]
        curvature -= beta * product / state[ALPHA]
    else:
        next[START] = product
    if product > state[STOP_RATIO] * next[START] and curvature > wp.float64(0.0):
        takes_step = 1
        next[LEFT] = state[LEFT] - wp.float64(1.0)
        next[SCATTERED] = fixed_ / wp.sqrt(square)
        next[UNIT_RV] = exact / product
        next[UNIT_VV] = exact / square
        next[PRODUCT] = product
        next[ALPHA] = product / curvature
        next[GAIN] = state[GAIN] + wp.float64(0.5) * next[ALPHA] * product
    else:
        next[LEFT] = wp.float64(0.0)
    return next, beta, takes_step


@wp.func
def conjugate_step_at(
    v: wp.array[wp.float32],
    w: wp.array[wp.float32],
    r: wp.array[wp.float32],
    x: wp.array[wp.float32],
    p: wp.array[wp.float32],
    s: wp.array[wp.float32],
    alpha: wp.float32,
    beta: wp.float32,
    i: wp.int32,
):
    """See conjugate_step."""
    p[i] = v[i] + beta * p[i]
    s[i] = w[i] + beta * s[i]
    x[i] = x[i] + alpha * p[i]
    r[i] = r[i] - alpha * s[i]


@wp.kernel
def conjugate_step(
    v: wp.array[wp.float32],
    w: wp.array[wp.float32],
    r: wp.array[wp.float32],
    x: wp.array[wp.float32],
    p: wp.array[wp.float32],
    s: wp.array[wp.float32],
    totals: wp.array[wp.int64],
    next_totals: wp.array[wp.int64],
    state: wp.array[wp.float64],
    next: wp.array[wp.float64],
    fixed_: wp.float64,
    exact: wp.float64,
    pixels: wp.int32,
    per_item: wp.int32,
):
    """A step of conjugate gradients with one sum (Chronopoulos and Gear 1989): p = v + beta p, s = w + beta
    s, x += alpha p, r -= alpha s.
    """
    g = wp.tid()
    if state[LEFT] > wp.float64(0.0):
        total = Sums()
        for i in range(SUM_SLOTS):
            total += Sums(totals[i], totals[SUM_SLOTS + i], totals[2 * SUM_SLOTS + i])
        after_, beta, takes_step = iteration_of(state, total, fixed_, exact)
        if g == 0:
            for i in range(11):
                next[i] = after_[i]
            for i in range(3 * SUM_SLOTS):
                next_totals[i] = wp.int64(0)
        if takes_step != 0:
            for i in range(g * per_item, wp.min(pixels, g * per_item + per_item)):
                conjugate_step_at(v, w, r, x, p, s, wp.float32(after_[ALPHA]), wp.float32(beta), i)
    elif g == 0:
        for i in range(11):
            next[i] = state[i]


@wp.kernel
def start(
    state: wp.array[wp.float64],
    totals: wp.array[wp.int64],
    square: wp.float64,
    product: wp.float64,
    lambda_: wp.float64,
    damping: wp.float64,
    least: wp.float64,
    fixed_: wp.float64,
    exact: wp.float64,
    most: wp.int32,
):
    """The state and the totals before the first iteration; square and product: v v and r v. One thread."""
    for i in range(3 * SUM_SLOTS):
        totals[i] = wp.int64(0)
    for i in range(11):
        state[i] = wp.float64(0.0)
    state[LEFT] = wp.float64(most)
    state[SCATTERED] = fixed_ / wp.sqrt(square)
    state[UNIT_RV] = exact / product
    state[UNIT_VV] = exact / square
    state[LAMBDA] = lambda_
    state[DAMPING] = damping
    state[STOP_RATIO] = least


@wp.kernel
def solve(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    gain: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    scale_4: wp.array[wp.float32],
    scale_16: wp.array[wp.float32],
    is_free: wp.array[wp.float32],
    is_free_4: wp.array[wp.float32],
    sum: wp.array[wp.int64],
    r: wp.array[wp.float32],
    r_4: wp.array[wp.float32],
    v: wp.array[wp.float32],
    v_4: wp.array[wp.float32],
    v_16: wp.array[wp.float32],
    w: wp.array[wp.float32],
    x: wp.array[wp.float32],
    p: wp.array[wp.float32],
    s: wp.array[wp.float32],
    state: wp.array[wp.float64],
    fixed_: wp.float64,
    exact: wp.float64,
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    sides: wp.int32,
):
    """product, normal_product, conjugate_step, restriction and prolongation until they stop, by one thread:
    on a small grid a CPU takes longer to start a kernel than to run it. 4 and 16: of the coarse grids.
    """
    pixels = rows * cols
    rows_4 = (rows - 1) / COARSENING + 1
    cols_4 = (cols - 1) / COARSENING + 1
    rows_16 = (rows_4 - 1) / COARSENING + 1
    cols_16 = (cols_4 - 1) / COARSENING + 1
    while state[LEFT] > wp.float64(0.0):
        total = Sums()
        quantum = wp.float32(wp.float64(1.0) / state[SCATTERED])
        for i in range(pixels):
            product_at(
                light,
                held,
                first,
                second,
                near,
                far,
                gain,
                v,
                sum,
                wp.float32(state[SCATTERED]),
                rows,
                cols,
                count,
                sides,
                i,
            )
        for i in range(pixels):
            total += normal_product_at(
                r,
                v,
                scale,
                is_free,
                sum,
                w,
                quantum,
                wp.float32(state[LAMBDA]),
                wp.float32(state[DAMPING]),
                state[UNIT_RV],
                state[UNIT_VV],
                rows,
                cols,
                i,
            )
        after_, beta, takes_step = iteration_of(state, total, fixed_, exact)
        for i in range(11):
            state[i] = after_[i]
        if takes_step == 0:
            return
        for i in range(pixels):
            conjugate_step_at(v, w, r, x, p, s, wp.float32(after_[ALPHA]), wp.float32(beta), i)
        for j in range(rows_4 * cols_4):
            r_4[j] = restricted(r, rows, cols, j % cols_4, j / cols_4)
        for j in range(rows_16 * cols_16):
            v_16[j] = restricted(r_4, rows_4, cols_4, j % cols_16, j / cols_16) / scale_16[j]
        for j in range(rows_4 * cols_4):
            prolong_at(r_4, scale_4, is_free_4, v_16, v_4, rows_4, cols_4, j % cols_4, j / cols_4)
        for i in range(pixels):
            prolong_at(r, scale, is_free, v_4, v, rows, cols, i % cols, i / cols)


@wp.kernel
def bounded_step(
    z: wp.array[wp.float32],
    x: wp.array[wp.float32],
    low: wp.array[wp.float32],
    high: wp.array[wp.float32],
    to: wp.array[wp.float32],
    pixels: wp.int32,
    per_item: wp.int32,
):
    """to = z + x, within its bounds."""
    g = wp.tid()
    for i in range(g * per_item, wp.min(pixels, g * per_item + per_item)):
        to[i] = wp.min(wp.max(z[i] + x[i], low[i]), high[i])
