/* The test and the step of the inverse algorithm (Eq. 4), in whole numbers.

carve: light += sum over set bits of the weights; after the last group of walks a column that is still carved
(its depth is `layer`) stops if its light agrees with the image, or else goes one layer down.

  planes   (walks, room)       uchar
  weights  (walks, BITS)       int    rho B dOmega / (2 pi), in the image's unit
  light    (rows, cols)        int    in, out
  low      (rows, cols)        int    image - eps
  high     (rows, cols)        int    image + eps
  side     (rows, cols)        int    in, out: 1 where the light exceeded the image at layer 0; used where
                                      by_sign is 1
  depth    (rows, cols)        float  in, out [layers]
  active   (1)                 int    in, out: how many columns went down (a sum of ones: order-free)

Work-item p owns pixel p. Twin of warp_kernels/carve.py. */
#pragma OPENCL FP_CONTRACT OFF

__kernel void carve(__global const uchar *planes, __global const int *weights, __global int *light,
                    __global const int *low, __global const int *high, __global int *side,
                    __global float *depth, __global int *active, int pixels, int room, int n_walks,
                    int is_first, int is_last, int layer, int by_sign)
{
  const size_t p = get_global_id(0);
  if (p >= pixels || depth[p] != (float)layer)
    return;
  int sum = is_first ? 0 : light[p];
  for (int w = 0; w < n_walks; ++w) {
    const int lit = planes[(size_t)w * room + p];
    for (int b = 0; b < BITS; ++b)
      sum += lit >> b & 1 ? weights[BITS * w + b] : 0;
  }
  light[p] = sum;
  if (!is_last)
    return;
  if (layer == 0)
    side[p] = sum > high[p];
  const int agrees = low[p] <= sum && sum <= high[p];
  if (agrees || (by_sign && (sum > high[p]) != side[p]))
    return;
  depth[p] = (float)(layer + 1);
  atomic_inc(active);
}
