"""The test and the step of the inverse algorithm (Eq. 4), in whole numbers. Twin of opencl/carve.cl."""

import functools

import warp as wp

from . import OPTIONS


@functools.cache
def carve(BITS: int):
    """light += sum over set bits of the weights; after the last group of walks a column that is still carved
    (its depth is `layer`) stops if its light agrees with the image, or else goes one layer down.

      planes   (walks, room)  uint8
      weights  (walks, BITS)  int32    rho B dOmega / (2 pi), in the image's unit
      light    (rows, cols)   int32    in, out
      low      (rows, cols)   int32    image - eps
      high     (rows, cols)   int32    image + eps
      side     (rows, cols)   int32    in, out: 1 where the light exceeded the image at layer 0; used where
                                       by_sign is 1
      depth    (rows, cols)   float32  in, out [layers]
      active   (1)            int32    in, out: how many columns went down (a sum of ones: order-free)

    Thread p owns pixel p.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def carve(
        planes: wp.array2d[wp.uint8],
        weights: wp.array2d[wp.int32],
        light: wp.array[wp.int32],
        low: wp.array[wp.int32],
        high: wp.array[wp.int32],
        side: wp.array[wp.int32],
        depth: wp.array2d[wp.float32],
        active: wp.array[wp.int32],
        pixels: wp.int32,
        room: wp.int32,
        n_walks: wp.int32,
        is_first: wp.int32,
        is_last: wp.int32,
        layer: wp.int32,
        by_sign: wp.int32,
    ):
        p = wp.tid()
        cols = depth.shape[1]
        y = p // cols
        x = p - y * cols
        if depth[y, x] != wp.float32(layer):
            return
        total = wp.int32(0)
        if is_first == 0:
            total = light[p]
        for w in range(n_walks):
            lit = wp.int32(planes[w, p])
            for b in range(BITS):
                if (lit & (1 << b)) != 0:
                    total += weights[w, b]
        light[p] = total
        if is_last == 0:
            return
        exceeds = wp.int32(0)
        if total > high[p]:
            exceeds = 1
        if layer == 0:
            side[p] = exceeds
        if low[p] <= total and total <= high[p]:
            return
        if by_sign != 0 and exceeds != side[p]:
            return
        depth[y, x] = wp.float32(layer + 1)
        wp.atomic_add(active, 0, 1)

    return carve
