"""What a lobe about the mirror direction makes of the light from the visible directions (MODEL.md, 6). Twin of opencl/specular.cl."""

import functools

import warp as wp

from . import OPTIONS, PIXELS

wp.set_module_options(OPTIONS)

floats = wp.types.vector(PIXELS, wp.float32)
words = wp.types.vector(PIXELS // 4, wp.uint32)  # four pixels' bytes each, for whole loads


@functools.cache
def specular(BITS: int):
    """radiance += sum over set bits of weight x max(0, N.L) x lobe(1 - R.L), R = 2 (N.V) N - V the mirror direction of the
    viewer's V = (0, 0, -1).

      planes      (walks, room)  uint8
      slopes      (2, room)      float32  dz/dx, dz/dy
      directions  (walks, BITS)  vec4     L, x, y, z, and its weight: brightness x solid angle x the lobe's norm
      lobe        (n_lobe)       float32  by even steps of 1 - cosine from 0 to rim, beyond which there is none
      radiance    (room)         float32  in, out: the sum x |(dz/dx, dz/dy, -1)|, and after the last group the sum itself

    Thread g owns pixels PIXELS g to PIXELS g + PIXELS - 1. Order of summation: walks, within a walk elevations. 1 - R.L is
    taken as |L - R|^2 / 2, which loses no digits where the lobe is narrow.
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
                for l in range(PIXELS):
                    twice = 2.0 / (gx[l] * gx[l] + gy[l] * gy[l] + 1.0)
                    cosine = gx[l] * L[0] + gy[l] * L[1] - L[2]
                    x = L[0] - twice * gx[l]
                    y = L[1] - twice * gy[l]
                    z = L[2] - (1.0 - twice)
                    at = (x * x + y * y + z * z) * per_step
                    if (lit[l // 4] & wp.uint32(1 << (8 * (l % 4) + b))) != wp.uint32(0) and cosine > 0.0 and at < wp.float32(n_lobe - 1):
                        i = wp.int32(at)
                        first = lobe[i]
                        total[l] += L[3] * cosine * (first + (at - wp.float32(i)) * (lobe[i + 1] - first))
        if is_last != 0:
            for l in range(PIXELS):
                total[l] /= wp.sqrt(gx[l] * gx[l] + gy[l] * gy[l] + 1.0)
        radiance[g] = total

    return specular
