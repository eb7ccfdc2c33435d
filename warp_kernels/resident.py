"""A depth map on the device: checked, padded and probed there. Twin of opencl/resident.cl."""

import warp as wp

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def take(
    values: wp.array[wp.float32],
    depth: wp.array[wp.float32],
    top: wp.float32,
    sign: wp.float32,
    count: wp.int32,
):
    """depth = top + sign x value: a copy (0, 1), or the depth of heights (highest, -1).

      values, depth  (count)  float32 [length]

    Thread p owns one node.
    """
    p = wp.tid()
    if p < count:
        depth[p] = top + sign * values[p]


@wp.kernel
def survey(values: wp.array[wp.float32], found: wp.array2d[wp.float32], rows: wp.int32, cols: wp.int32):
    """Per column the smallest and the largest value that is finite, and how many are not.

      values  (rows x cols)  float32 [length]
      found   (3, cols)      float32  out

    Thread x owns one column, from row 0 on.
    """
    x = wp.tid()
    if x >= cols:
        return
    low = wp.float32(3.4028235e38)
    high = wp.float32(-3.4028235e38)
    broken = wp.int32(0)
    for y in range(rows):
        z = values[y * cols + x]
        if wp.isfinite(z):
            low = wp.min(low, z)
            high = wp.max(high, z)
        else:
            broken += 1
    found[0, x] = low
    found[1, x] = high
    found[2, x] = wp.float32(broken)


@wp.kernel
def pad(
    depth: wp.array[wp.float32],
    heights: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    step: wp.float32,
    outside: wp.float32,
    periodic: wp.int32,
):
    """Heights as sweep wants them, -depth / step with a margin round them: the map again where it repeats,
    else ``outside``.

      depth    (rows x cols)                              float32 [length]
      heights  (rows + 2 margin) x (cols + 2 margin)      float32 [spacing]  out

    Thread (y, x) owns one element of the padded map.
    """
    row, column = wp.tid()
    x = column - margin
    y = row - margin
    value = outside
    if periodic != 0:
        x = (x % cols + cols) % cols
        y = (y % rows + rows) % rows
    if x >= 0 and x < cols and y >= 0 and y < rows:
        value = -depth[y * cols + x] / step
    heights[row * (cols + 2 * margin) + column] = value


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
    from ``first`` on; -inf where none lies.

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
    while distance < wp.max(rows, cols):
        u = x + i * distance
        v = y + j * distance
        if u >= 0 and u < cols and v >= 0 and v < rows:
            steepest = wp.max(
                steepest, (heights[(v + margin) * stride + margin + u] - own) / wp.float32(distance)
            )
        distance = distance * 5 // 4 + 1
    best[way, sample] = steepest
