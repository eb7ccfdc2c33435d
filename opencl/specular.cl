/* Light of the visible directions that a lobe about the mirror direction reflects (docs/explanation).

specular: radiance += sum over set bits of weight x max(0, N.L) x lobe(1 - R.L), R = 2 (N.V) N - V the mirror
direction of the viewer's V = (0, 0, -1).

  planes      (walks, room)     uchar
  slopes      (2, room)         float  dz/dx, dz/dy
  directions  (walks, BITS, 4)  float  L, x, y, z, and its weight: brightness x solid angle x the lobe's norm
  lobe        (n_lobe)          float  by even steps of 1 - cosine from 0 to rim, beyond which there is none
  radiance    (room)            float  in, out: the sum x |(dz/dx, dz/dy, -1)|, and after the last group the
                                       sum itself

Work-item g owns pixels LANES g to LANES g + LANES - 1. Order of summation: walks, within a walk elevations. 1
- R.L is taken as |L - R|^2 / 2, which loses no digits where the lobe is narrow. Twin of
warp_kernels/specular.py. */
#include "lanes.h"
#if LANES == 1
#define GATHER(pointer, offsets) (pointer)[offsets]
#define TO_FLOATS convert_float
#else
#define GATHER(p, o)                                                                                         \
  (floats)((p)[(o).s0], (p)[(o).s1], (p)[(o).s2], (p)[(o).s3], (p)[(o).s4], (p)[(o).s5], (p)[(o).s6],        \
           (p)[(o).s7])
#define TO_FLOATS convert_float8
#endif

/* |(dz/dx, dz/dy, -1)| x max(0, N.L) x lobe for one direction; where it shows. */
floats gloss(floats gx, floats gy, floats twice, float4 L, __global const float *lobe, int n_lobe,
             float per_step, ints lit)
{
  const floats cosine = gx * L.x + gy * L.y - L.z;
  const floats x = L.x - twice * gx, y = L.y - twice * gy, z = L.z - (1 - twice),
               at = (x * x + y * y + z * z) * per_step;
  const ints shows = lit & WHERE(cosine > 0) & WHERE(at < n_lobe - 1);
  const ints i = shows ? TO_INTS(at) : 0;
  const floats first = GATHER(lobe, i);
  return shows ? cosine * (first + (at - TO_FLOATS(i)) * (GATHER(lobe, i + 1) - first)) : (floats)0;
}

__kernel void specular(__global const uchars *planes, __global const floats *slopes,
                       __global const float4 *directions, __global const float *lobe,
                       __global floats *radiance, int room, int n_walks, int n_lobe, int is_first,
                       int is_last, float rim)
{
  const size_t g = get_global_id(0), groups = room / LANES;
  if (g >= groups)
    return;
  const floats gx = slopes[g], gy = slopes[groups + g], square = gx * gx + gy * gy + 1, twice = 2 / square;
  const float per_step = 0.5f * (n_lobe - 1) / rim;
  floats sum = 0;
  if (!is_first)
    sum = radiance[g];
  for (int w = 0; w < n_walks; ++w) {
    const ints lit = TO_INTS(planes[w * groups + g]);
    for (int b = 0; b < BITS; ++b) {
      const float4 L = directions[BITS * w + b];
      sum += L.w * gloss(gx, gy, twice, L, lobe, n_lobe, per_step, WHERE((lit & (1 << b)) != 0));
    }
  }
  if (is_last)
    sum /= sqrt(square);
  radiance[g] = sum;
}

/* bound: radiance /= what the lobe would make of a sky of brightness 1, all of it visible, if that is more
than 1: where a lobe is narrower than the directions stand apart, a direction may count for more than its
share.

  directions  (n, 4)  float  L, and its weight: solid angle x the lobe's norm
  radiance    (room)  float  in, out

Work-item g owns pixels LANES g to LANES g + LANES - 1. */
__kernel void bound(__global const floats *slopes, __global const float4 *directions,
                    __global const float *lobe, __global floats *radiance, int room, int n, int n_lobe,
                    float rim)
{
  const size_t g = get_global_id(0), groups = room / LANES;
  if (g >= groups)
    return;
  const floats gx = slopes[g], gy = slopes[groups + g], square = gx * gx + gy * gy + 1, twice = 2 / square;
  const float per_step = 0.5f * (n_lobe - 1) / rim;
  floats sum = 0;
  for (int d = 0; d < n; ++d)
    sum += directions[d].w * gloss(gx, gy, twice, directions[d], lobe, n_lobe, per_step, WHERE(square > 0));
  sum /= sqrt(square);
  radiance[g] /= sum > 1 ? sum : (floats)1;
}
