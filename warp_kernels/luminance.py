"""The sum of brightness x cosine x solid angle over the visible directions (Eq. 3). Twin of
opencl/luminance.cl.
"""

import functools

import warp as wp

from skylamp.constants import GPU_PIXELS

from . import OPTIONS

wp.set_module_options(OPTIONS)

floats = wp.types.vector(GPU_PIXELS, wp.float32)
words = wp.types.vector(GPU_PIXELS // 4, wp.uint32)  # four pixels' bytes each, for whole loads


@wp.func
def on_line(i: wp.int32, n: wp.int32, periodic: wp.int32):
    """Node i of a line of n, which may lie one beyond its ends."""
    if periodic != 0:
        return (i + n) % n
    return wp.clamp(i, 0, n - 1)


@wp.func
def difference(
    depth: wp.array2d[wp.float32],
    y: wp.int32,
    x: wp.int32,
    low_y: wp.int32,
    low_x: wp.int32,
    high_y: wp.int32,
    high_x: wp.int32,
    half: wp.float32,
    one: wp.float32,
):
    low = depth[low_y, low_x]
    high = depth[high_y, high_x]
    here = depth[y, x]
    below = (low_y != y or low_x != x) and low < wp.inf
    above = (high_y != y or high_x != x) and high < wp.inf
    if below and above:
        return (high - low) * half
    if above:
        return (high - here) * one
    if below:
        return (here - low) * one
    return wp.float32(0.0)


@wp.kernel
def gradient(
    depth: wp.array2d[wp.float32],
    slopes: wp.array2d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    room: wp.int32,
    half: wp.float32,
    one: wp.float32,
    periodic: wp.int32,
):
    """dz/dx and dz/dy by central differences, one-sided beside masked nodes and, unless the map repeats, at
    the border; 0 where alone.

      depth   (rows, cols)  float32 [length]  +inf where masked
      slopes  (2, room)     float32 [1]       out: dz/dx, dz/dy; room: pixels rounded up for whole vectors
      half, one             float32 [1/length]  1 / (2 step) and 1 / step
      periodic              int32               1 where the map repeats

    Thread (y, x) owns one node.
    """
    y, x = wp.tid()
    gx = wp.float32(0.0)
    gy = wp.float32(0.0)
    if depth[y, x] < wp.inf:
        left = on_line(x - 1, cols, periodic)
        right = on_line(x + 1, cols, periodic)
        over = on_line(y - 1, rows, periodic)
        under = on_line(y + 1, rows, periodic)
        gx = difference(depth, y, x, y, left, y, right, half, one)
        gy = difference(depth, y, x, over, x, under, x, half, one)
    slopes[0, y * cols + x] = gx
    slopes[1, y * cols + x] = gy


@functools.cache
def luminance(BITS: int):
    """irradiance += sum over set bits of max(0, N . moment) x brightness; the moments come multiplied by it.

      planes      (walks, room)  uint8
      slopes      (2, room)      float32
      moments     (walks, BITS)  vec4 [sr x brightness]  x, y, z, 0
      irradiance  (room)         float32                 in, out: the sum x |(dz/dx, dz/dy, -1)|, and after
                                                         the last group the sum itself

    Thread g owns pixels GPU_PIXELS g to GPU_PIXELS g + GPU_PIXELS - 1. Order of summation: walks, within a
    walk elevations.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def luminance(
        planes: wp.array2d[words],
        slopes: wp.array2d[floats],
        moments: wp.array2d[wp.vec4],
        irradiance: wp.array[floats],
        pixels: wp.int32,
        room: wp.int32,
        n_walks: wp.int32,
        is_first: wp.int32,
        is_last: wp.int32,
    ):
        g = wp.tid()
        gx = slopes[0, g]
        gy = slopes[1, g]
        total = floats()
        if is_first == 0:
            total = irradiance[g]
        for w in range(n_walks):
            lit = planes[w, g]
            for b in range(BITS):
                moment = moments[w, b]
                for lane in range(GPU_PIXELS):
                    cosine = gx[lane] * moment[0] + gy[lane] * moment[1] - moment[2]
                    if (lit[lane // 4] & wp.uint32(1 << (8 * (lane % 4) + b))) != wp.uint32(
                        0
                    ) and cosine > 0.0:
                        total[lane] += cosine
        if is_last != 0:
            for lane in range(GPU_PIXELS):
                total[lane] /= wp.sqrt(gx[lane] * gx[lane] + gy[lane] * gy[lane] + 1.0)
        irradiance[g] = total

    return luminance
