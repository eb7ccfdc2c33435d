"""Kernels about a sweep: slopes of a padded map, a map turned, sums as irradiance, and their error.

Twin of opencl/ground.cl.
"""

import warp as wp

from skylamp.constants import HIGHEST_MASKED, NONE

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def difference(heights: wp.array[wp.float32], here: wp.int32, low: wp.int32, high: wp.int32):
    first = low
    second = high
    if heights[low] <= NONE:
        first = here
    if heights[high] <= NONE:
        second = here
    rise = heights[first] - heights[second]
    if first == here or second == here:
        return rise
    return rise * wp.float32(0.5)


@wp.kernel
def tilt(
    heights: wp.array[wp.float32],
    tilts: wp.array2d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    room: wp.int32,
    periodic: wp.int32,
):
    """d depth/dx and d depth/dy of a padded map, by central differences; one-sided beside what is no ground:
    masked nodes, and the border of a map that does not repeat. 0 where alone or masked.

      heights  (room)     float32 [spacing]  as for sweep
      tilts    (2, room)  float32 [1]        out

    Thread (y, x) owns one element of the padded map; where the map repeats, so do the slopes.
    """
    row, column = wp.tid()
    stride = cols + 2 * margin
    x = column - margin
    y = row - margin
    if periodic != 0:
        x = (x % cols + cols) % cols
        y = (y % rows + rows) % rows
    gx = wp.float32(0.0)
    gy = wp.float32(0.0)
    if x >= 0 and x < cols and y >= 0 and y < rows:
        p = (y + margin) * stride + margin + x
        if heights[p] > NONE:
            gx = difference(heights, p, p - 1, p + 1)
            gy = difference(heights, p, p - stride, p + stride)
    tilts[0, row * stride + column] = gx
    tilts[1, row * stride + column] = gy


@wp.kernel
def turn(
    maps: wp.array[wp.float32], turned: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, count: wp.int32
):
    """Maps (count, rows, cols) and the same turned, (count, cols, rows).

    Thread (n, y, x) owns one node of the turned map n.
    """
    n, y, x = wp.tid()
    first = n * rows * cols
    turned[first + y * rows + x] = maps[first + x * cols + y]


@wp.kernel
def gather(
    sum: wp.array2d[wp.int32],
    turned: wp.array2d[wp.int32],
    irradiance: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    n: wp.int32,
    quantum: wp.float32,
):
    """Sum n of each of both maps, (rows, cols) and (cols, rows), as irradiance, sum x quantum; a sum that
    rounding made negative as 0. Thread (y, x) owns one node.
    """
    y, x = wp.tid()
    irradiance[y * cols + x] = wp.float32(wp.max(sum[n, y * cols + x] + turned[n, x * rows + y], 0)) * quantum


@wp.kernel
def place(
    maps: wp.array2d[wp.float32],
    depth: wp.array[wp.float32],
    numbers: wp.array[wp.int32],
    stack: wp.array2d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    turned: wp.int32,
):
    """Maps, each turned if ``turned``, as layers of a stack; nan where masked.

      maps     (count, rows x cols)  float32 [any]     those of the turned map are (count, cols x rows)
      depth    (rows x cols)         float32 [length]  +inf where masked
      numbers  (count)               int32             of the maps in the stack
      stack    (any, rows x cols)    float32 [any]     out

    Thread (n, y, x) owns one node of map n.
    """
    n, y, x = wp.tid()
    at = y * cols + x
    value = maps[n, wp.where(turned != 0, x * rows + y, at)]
    stack[numbers[n], at] = wp.where(wp.isinf(depth[at]), wp.nan, value)


@wp.kernel
def correct(
    tilts: wp.array2d[wp.float32],
    table: wp.array[wp.float32],
    irradiance: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    room: wp.int32,
    side: wp.int32,
):
    """irradiance *= table, by normal; not below 0, where a table of brightness that is linear between its
    knots may leave some -1e-6 of a sky where almost nothing but the zenith is visible.


      tilts       (2, room)      float32 [1]  gx and gy, as tilt makes them
      table       (side, side)   float32 [1]  at v (row) and u (column), and bilinear between: u =
                                        (gx up / (1 + up) + 1) (side - 1) / 2, v so with gy,
                                        up = 1 / sqrt(1 + gx^2 + gy^2)
      irradiance  (rows x cols)  float32  in and out

    side >= 2. Thread (y, x) owns one node; a masked one is as if level.
    """
    y, x = wp.tid()
    at = (y + margin) * (cols + 2 * margin) + margin + x
    gx = tilts[0, at]
    gy = tilts[1, at]
    one = wp.float32(1.0)
    scale = wp.float32(side - 1)
    up = one / wp.sqrt(one + gx * gx + gy * gy)
    u = (gx * up / (one + up) + one) * wp.float32(0.5) * scale
    v = (gy * up / (one + up) + one) * wp.float32(0.5) * scale
    i = wp.clamp(wp.int32(u), 0, side - 2)
    j = wp.clamp(wp.int32(v), 0, side - 2)
    cell = j * side + i
    across = u - wp.float32(i)
    low = table[cell] + across * (table[cell + 1] - table[cell])
    high = table[cell + side] + across * (table[cell + side + 1] - table[cell + side])
    value = low + (v - wp.float32(j)) * (high - low)
    irradiance[y * cols + x] = wp.max(wp.float32(0.0), irradiance[y * cols + x] * value)


@wp.kernel
def halves(a: wp.array[wp.float32], b: wp.array[wp.float32], count: wp.int32, keep: wp.int32):
    """Of two images of the same light, in place, their mean and half their difference.

      a     (count)  float32  in and out: (a + b) / 2, or (b - a) / 2 if b is kept
      b     (count)  float32  in and out: (b - a) / 2, or b if it is kept
      keep  int32    1 to keep b

    Thread p owns one node of both.
    """
    p = wp.tid()
    if p >= count:
        return
    first = a[p]
    second = b[p]
    if keep != 0:
        a[p] = (second - first) * wp.float32(0.5)
    else:
        a[p] = (first + second) * wp.float32(0.5)
        b[p] = (second - first) * wp.float32(0.5)


@wp.kernel
def judge(
    heights: wp.array[wp.float32],
    image: wp.array[wp.float32],
    half: wp.array[wp.float32],
    sums: wp.array2d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    block: wp.int32,
    limit: wp.float32,
):
    """Sums for an estimate of the error, over the valid nodes of each column of a few rows.

      heights  (room)             float32 [spacing]  as for sweep; a node is valid where > -1e29
      image    (rows x cols)      float32
      half     (rows x cols)      float32 [image]    half a difference, as halves makes it
      sums     (5, blocks, cols)  float32            out: sum of image, sum of half^2, and numbers of nodes
                                                     that are valid, whose image is > 0, and whose abs(half)
                                                     is > limit; blocks = ceil(rows / block)

    Thread (b, x) owns column x of rows b block .. min((b + 1) block, rows) - 1, summed in this order.
    """
    b, x = wp.tid()
    light = wp.float32(0.0)
    square = wp.float32(0.0)
    valid = wp.int32(0)
    lit = wp.int32(0)
    beyond = wp.int32(0)
    for y in range(b * block, wp.min((b + 1) * block, rows)):
        if heights[(y + margin) * (cols + 2 * margin) + margin + x] > HIGHEST_MASKED:
            here = image[y * cols + x]
            apart = half[y * cols + x]
            light += here
            square += apart * apart
            valid += 1
            if here > wp.float32(0.0):
                lit += 1
            if wp.abs(apart) > limit:
                beyond += 1
    at = b * cols + x
    sums[0, at] = light
    sums[1, at] = square
    sums[2, at] = wp.float32(valid)
    sums[3, at] = wp.float32(lit)
    sums[4, at] = wp.float32(beyond)
