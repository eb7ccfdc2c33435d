"""Light of the visible directions that a lobe about the mirror direction reflects (docs/explanation). Twin
of opencl/specular.cl.
"""

import functools

import warp as wp

from skylamp.constants import GPU_PIXELS

from . import OPTIONS

wp.set_module_options(OPTIONS)

floats = wp.types.vector(GPU_PIXELS, wp.float32)
words = wp.types.vector(GPU_PIXELS // 4, wp.uint32)  # four pixels' bytes each, for whole loads


@wp.func
def gloss(
    gx: wp.float32,
    gy: wp.float32,
    L: wp.vec4,
    lobe: wp.array[wp.float32],
    n_lobe: wp.int32,
    per_step: wp.float32,
):
    """|(dz/dx, dz/dy, -1)| x max(0, N.L) x lobe for one direction."""
    twice = 2.0 / (gx * gx + gy * gy + 1.0)
    cosine = gx * L[0] + gy * L[1] - L[2]
    x = L[0] - twice * gx
    y = L[1] - twice * gy
    z = L[2] - (1.0 - twice)
    at = (x * x + y * y + z * z) * per_step
    if cosine > 0.0 and at < wp.float32(n_lobe - 1):
        i = wp.int32(at)
        first = lobe[i]
        return cosine * (first + (at - wp.float32(i)) * (lobe[i + 1] - first))
    return wp.float32(0.0)


@functools.cache
def specular(BITS: int):
    """radiance += sum over set bits of weight x max(0, N.L) x lobe(1 - R.L), R = 2 (N.V) N - V the mirror
    direction of the viewer's V = (0, 0, -1).

      planes      (walks, room)  uint8
      slopes      (2, room)      float32  dz/dx, dz/dy
      directions  (walks, BITS)  vec4     L, x, y, z, and its weight: brightness x solid angle x the lobe's
                                          norm
      lobe        (n_lobe)       float32  by even steps of 1 - cosine from 0 to rim, beyond which there is
                                          none
      radiance    (room)         float32  in, out: the sum x |(dz/dx, dz/dy, -1)|, and after the last group
                                          the sum itself

    Thread g owns pixels GPU_PIXELS g to GPU_PIXELS g + GPU_PIXELS - 1. Order of summation: walks, within a
    walk elevations. 1 - R.L is taken as |L - R|^2 / 2, which loses no digits where the lobe is narrow.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def specular(
        planes: wp.array2d[words],
        slopes: wp.array2d[floats],
        directions: wp.array2d[wp.vec4],
        lobe: wp.array[wp.float32],
        radiance: wp.array[floats],
        room: wp.int32,
        n_walks: wp.int32,
        n_lobe: wp.int32,
        is_first: wp.int32,
        is_last: wp.int32,
        rim: wp.float32,
    ):
        g = wp.tid()
        gx = slopes[0, g]
        gy = slopes[1, g]
        per_step = 0.5 * wp.float32(n_lobe - 1) / rim
        total = floats()
        if is_first == 0:
            total = radiance[g]
        for w in range(n_walks):
            lit = planes[w, g]
            for b in range(BITS):
                L = directions[w, b]
                for lane in range(GPU_PIXELS):
                    if (lit[lane // 4] & wp.uint32(1 << (8 * (lane % 4) + b))) != wp.uint32(0):
                        total[lane] += L[3] * gloss(gx[lane], gy[lane], L, lobe, n_lobe, per_step)
        if is_last != 0:
            for lane in range(GPU_PIXELS):
                total[lane] /= wp.sqrt(gx[lane] * gx[lane] + gy[lane] * gy[lane] + 1.0)
        radiance[g] = total

    return specular


@wp.kernel
def bound(
    slopes: wp.array2d[wp.float32],
    directions: wp.array[wp.vec4],
    lobe: wp.array[wp.float32],
    radiance: wp.array[wp.float32],
    room: wp.int32,
    n: wp.int32,
    n_lobe: wp.int32,
    rim: wp.float32,
):
    """radiance /= what the lobe would make of a sky of brightness 1, all of it visible, if that is more than
    1: where a lobe is narrower than the directions stand apart, a direction may count for more than its
    share.

      directions  (n)     vec4     L, and its weight: solid angle x the lobe's norm
      radiance    (room)  float32  in, out

    Thread g owns GPU_PIXELS pixels from GPU_PIXELS g on.
    """
    group = wp.tid()
    per_step = 0.5 * wp.float32(n_lobe - 1) / rim
    for g in range(GPU_PIXELS * group, GPU_PIXELS * group + GPU_PIXELS):
        gx = slopes[0, g]
        gy = slopes[1, g]
        total = wp.float32(0.0)
        for d in range(n):
            L = directions[d]
            total += L[3] * gloss(gx, gy, L, lobe, n_lobe, per_step)
        total /= wp.sqrt(gx * gx + gy * gy + 1.0)
        radiance[g] = radiance[g] / wp.max(total, 1.0)
