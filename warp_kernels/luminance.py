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
def difference(
    here: wp.float32,
    low: wp.float32,
    high: wp.float32,
    has_low: wp.bool,
    has_high: wp.bool,
    half: wp.float32,
    one: wp.float32,
):
    below = has_low and low < wp.inf
    above = has_high and high < wp.inf
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
):
    """dz/dx and dz/dy by central differences, one-sided at the border and beside masked nodes, 0 where alone.

      depth   (rows, cols)  float32 [length]  +inf where masked
      slopes  (2, room)     float32 [1]       out: dz/dx, dz/dy; room: pixels rounded up for whole vectors
      half, one             float32 [1/length]  1 / (2 step) and 1 / step

    Thread (y, x) owns one node.
    """
    y, x = wp.tid()
    z = depth[y, x]
    gx = wp.float32(0.0)
    gy = wp.float32(0.0)
    if z < wp.inf:
        gx = difference(
            z, depth[y, wp.max(x - 1, 0)], depth[y, wp.min(x + 1, cols - 1)], x > 0, x < cols - 1, half, one
        )
        gy = difference(
            z, depth[wp.max(y - 1, 0), x], depth[wp.min(y + 1, rows - 1), x], y > 0, y < rows - 1, half, one
        )
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
