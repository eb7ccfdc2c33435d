"""A depth map on a device: copied, surveyed, padded and probed there. Twin of opencl/resident.cl."""

import warp as wp

from skylamp.constants import HIGHEST_MASKED, NO_CEILING, NONE

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def adopt(
    values: wp.array[wp.float32],
    mask: wp.array[wp.uint8],
    depth: wp.array[wp.float32],
    top: wp.float32,
    sign: wp.float32,
    masked: wp.int32,
    count: wp.int32,
):
    """depth = top + sign x value: a copy (0, 1), or the depth of heights (highest, -1).

      values, depth  (count)  float32 [length]  nan for a value of +inf
      mask           (count)  uint8   where it is 0 the depth is +inf; read if masked is not 0

    Thread p owns one node.
    """
    p = wp.tid()
    if p >= count:
        return
    infinity = wp.float32(wp.inf)
    value = top + sign * values[p]
    if values[p] == infinity:
        value = wp.float32(wp.nan)
    if masked != 0:
        if mask[p] == wp.uint8(0):
            value = infinity
    depth[p] = value


@wp.kernel
def survey(
    values: wp.array[wp.float32],
    stats: wp.array3d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    block: wp.int32,
    step: wp.float64,
):
    """Properties of a map over each column of some rows. +inf is masked.

      values  (rows x cols)      float32 [length]
      stats   (8, blocks, cols)  float32  out: the smallest and the largest value; numbers of values that are
                                          -inf or nan, and of those that are no whole number of steps; sums of
                                          the squares of differences [length^2] to the neighbour at the right
                                          and below, where neither is masked; and how many these are; blocks =
                                          ceil(rows / block)
      step                       float64 [length]

    Thread (b, x) owns column x of rows b block .. min((b + 1) block, rows) - 1, summed in this order.
    """
    b, x = wp.tid()
    if x >= cols or b * block >= rows:
        return
    low = wp.float32(NO_CEILING)
    high = wp.float32(-NO_CEILING)
    across = wp.float32(0.0)
    down = wp.float32(0.0)
    broken = wp.int32(0)
    fractional = wp.int32(0)
    pairs_across = wp.int32(0)
    pairs_down = wp.int32(0)
    infinity = wp.float32(wp.inf)
    for y in range(b * block, wp.min((b + 1) * block, rows)):
        z = values[y * cols + x]
        if z == infinity:
            continue
        if not wp.isfinite(z):
            broken += 1
            continue
        low = wp.min(low, z)
        high = wp.max(high, z)
        if wp.float32(wp.rint(wp.float64(z) / step) * step) != z:
            fractional += 1
        right = infinity
        below = infinity
        if x + 1 < cols:
            right = values[y * cols + x + 1]
        if y + 1 < rows:
            below = values[y * cols + cols + x]
        if wp.isfinite(right):
            across += (right - z) * (right - z)
            pairs_across += 1
        if wp.isfinite(below):
            down += (below - z) * (below - z)
            pairs_down += 1
    stats[0, b, x] = low
    stats[1, b, x] = high
    stats[2, b, x] = wp.float32(broken)
    stats[3, b, x] = wp.float32(fractional)
    stats[4, b, x] = across
    stats[5, b, x] = down
    stats[6, b, x] = wp.float32(pairs_across)
    stats[7, b, x] = wp.float32(pairs_down)


@wp.kernel
def layers(depth: wp.array[wp.float32], step: wp.float64, count: wp.int32):
    """Depth in whole steps, in place.

      depth  (count)  float32 [length] in, [step] out
      step            float64 [length]

    Thread p owns one node.
    """
    p = wp.tid()
    if p < count:
        depth[p] = wp.float32(wp.rint(wp.float64(depth[p]) / step))


@wp.kernel
def heights(
    depth: wp.array[wp.float32],
    heights: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    left: wp.int32,
    above: wp.int32,
    width: wp.int32,
    height: wp.int32,
    step: wp.float32,
    masked: wp.float32,
    periodic: wp.int32,
):
    """-depth / step with margins round the map: the map again where it repeats, else NONE.

      depth    (rows x cols)     float32 [length]   +inf where masked
      heights  (height x width)  float32 [spacing]  out; masked where masked

    The map begins in column left of row above. Thread (y, x) owns one element.
    """
    row, column = wp.tid()
    if column >= width or row >= height:
        return
    x = column - left
    y = row - above
    if periodic != 0:
        x = (x % cols + cols) % cols
        y = (y % rows + rows) % rows
    value = wp.float32(NONE)
    if x >= 0 and x < cols and y >= 0 and y < rows:
        z = depth[y * cols + x]
        if z == wp.float32(wp.inf):
            value = masked
        else:
            value = -z / step
    heights[row * width + column] = value


@wp.kernel
def shade(
    image: wp.array[wp.float32],
    depth: wp.array[wp.float32],
    albedo: wp.array[wp.float32],
    varies: wp.int32,
    factor: wp.float32,
    least: wp.float32,
    count: wp.int32,
):
    """image = max(image, least) x (albedo x factor), nan where masked.

      image   (count)       float32  in and out
      depth   (count)       float32 [length]  +inf where masked
      albedo  (count or 1)  float32 [1]       of every node if varies, else of all

    Thread p owns one node.
    """
    p = wp.tid()
    if p >= count:
        return
    q = wp.int32(0)
    if varies != 0:
        q = p
    value = wp.max(image[p], least) * (albedo[q] * factor)
    if depth[p] == wp.float32(wp.inf):
        value = wp.float32(wp.nan)
    image[p] = value


@wp.kernel
def probe(
    heights: wp.array[wp.float32],
    best: wp.array2d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    every: wp.int32,
    across: wp.int32,
    count: wp.int32,
    first: wp.int32,
):
    """The steepest slope to ground in eight directions from every ``every``-th node, at growing distances
    from ``first`` on; -inf where none lies, or the node is masked.

      heights  (room)      float32 [spacing]  as for sweep
      best     (8, count)  float32 [1]        out

    Thread (direction, sample) owns one slope; samples run along rows, ``across`` of them in each.
    """
    way, sample = wp.tid()
    if sample >= count:
        return
    i = wp.where(way == 0 or way == 1 or way == 7, 1, wp.where(way == 2 or way == 6, 0, -1))
    j = wp.where(way >= 1 and way <= 3, 1, wp.where(way == 0 or way == 4, 0, -1))
    x = sample % across * every
    y = sample // across * every
    stride = cols + 2 * margin
    own = heights[(y + margin) * stride + margin + x]
    steepest = wp.float32(-wp.inf)
    distance = wp.int32(first)
    if own <= HIGHEST_MASKED:
        best[way, sample] = steepest
        return
    while distance < wp.max(rows, cols):
        u = x + i * distance
        v = y + j * distance
        if u >= 0 and u < cols and v >= 0 and v < rows:
            there = heights[(v + margin) * stride + margin + u]
            if there > HIGHEST_MASKED:
                steepest = wp.max(steepest, (there - own) / wp.float32(distance))
        distance = distance * 5 // 4 + 1
    best[way, sample] = steepest
