"""What sweeps need besides: slopes of a padded map, a map turned, and sums as irradiance. Twin of opencl/ground.cl."""

import warp as wp

from . import OPTIONS

wp.set_module_options(OPTIONS)

NONE = wp.constant(wp.float32(-1e30))


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
def tilt(heights: wp.array[wp.float32], tilts: wp.array2d[wp.float32], rows: wp.int32, cols: wp.int32, margin: wp.int32, room: wp.int32, periodic: wp.int32):
    """d depth/dx and d depth/dy of a padded map, by central differences; one-sided at the border and beside masked nodes,
    0 where alone or masked.

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
            gx = difference(heights, p, wp.where(x > 0, p - 1, p), wp.where(x < cols - 1, p + 1, p))
            gy = difference(heights, p, wp.where(y > 0, p - stride, p), wp.where(y < rows - 1, p + stride, p))
    tilts[0, row * stride + column] = gx
    tilts[1, row * stride + column] = gy


@wp.kernel
def turn(map: wp.array[wp.float32], turned: wp.array[wp.float32], rows: wp.int32, cols: wp.int32):
    """A map (rows, cols) and the same turned, (cols, rows). Thread (y, x) owns one node of the turned map."""
    y, x = wp.tid()
    turned[y * rows + x] = map[x * cols + y]


@wp.kernel
def gather(sum: wp.array[wp.int32], turned: wp.array[wp.int32], irradiance: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, unit: wp.float32):
    """The sums of both maps, (rows, cols) and (cols, rows), as irradiance [unit]. Thread (y, x) owns one node."""
    y, x = wp.tid()
    irradiance[y * cols + x] = wp.float32(sum[y * cols + x] + turned[x * rows + y]) * unit
