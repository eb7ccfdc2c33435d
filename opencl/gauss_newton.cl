/* Least squares for the inverse problem (docs/explanation): the misfit of images and its gradient by depth,
products with the Gauss-Newton matrix, and the conjugate gradients that solve with it. Twin of
warp_kernels/gauss_newton.py.

Lengths are in spacings. The arrays of an image and its links are those of adjoint.cl; J is the derivative
of E by depth, one row per node. Sums over nodes are added in whole numbers or in one order, so that every
backend finds the same bits. */
#include "lanes.h"
#include "links.h"
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

/* An image's derivative J by depth: rows of it are applied to a change of depths, and added up. */
typedef struct {
  __global const float *light;
  __global const int *held, *first, *second;
  __global const float *near, *far;
  int count, sides;
} Links;

/* Row p of J times v, but for its links. */
float own_change_at(Links links, __global const float *v, int rows, int cols, int p)
{
  const int pixels = rows * cols, x = p % cols, y = p / cols;
  float sum = links.light[pixels + p] * v[p];
  if (cols > 1)
    sum += links.light[2 * pixels + p] * rise_at(v + y * cols, x, cols, 1, links.sides);
  if (rows > 1)
    sum += links.light[3 * pixels + p] * rise_at(v + x, y, rows, cols, links.sides);
  return sum;
}

/* Row p of J times v: by how much E changes there. */
float change_at(Links links, __global const float *v, int rows, int cols, int p)
{
  float sum = own_change_at(links, v, rows, cols, p);
  for (int k = 0; k < links.held[p]; ++k) {
    const int e = link_at(p, k, links.count);
    sum += links.near[e] * v[links.first[e]] + links.far[e] * v[links.second[e]];
  }
  return sum;
}

void add(__global long *sum, long value, int exclusive)
{
  if (exclusive)
    *sum += value;
  else if (value != 0)
    atom_add(sum, value);
}

/* sum += an element of J times u. */
#define SPREAD(to, part)                                                                                     \
  {                                                                                                          \
    const float part_ = part;                                                                                \
    add(sum + (to), convert_long_rtz((squared ? part_ * part_ : part_) * u), exclusive);                     \
  }

/* sum += row p of J times u but for its links, in whole numbers, so that no order of summation matters; its
   elements squared if asked for. */
void spread_own_at(Links links, __global long *sum, float u, int squared, int rows, int cols, int p,
                   int exclusive)
{
  const int pixels = rows * cols, x = p % cols, y = p / cols, sides = links.sides;
  SPREAD(p, links.light[pixels + p])
  if (cols > 1) {
    const float part = links.light[2 * pixels + p] * half_within(x, cols, sides);
    SPREAD(y * cols + on_line(x + 1, cols, sides), part)
    SPREAD(y * cols + on_line(x - 1, cols, sides), -part)
  }
  if (rows > 1) {
    const float part = links.light[3 * pixels + p] * half_within(y, rows, sides);
    SPREAD(on_line(y + 1, rows, sides) * cols + x, part)
    SPREAD(on_line(y - 1, rows, sides) * cols + x, -part)
  }
}

/* The same with its links. */
void spread_at(Links links, __global long *sum, float u, int squared, int rows, int cols, int p,
               int exclusive)
{
  spread_own_at(links, sum, u, squared, rows, cols, p, exclusive);
  for (int k = 0; k < links.held[p]; ++k) {
    const int e = link_at(p, k, links.count);
    SPREAD(links.first[e], links.near[e])
    SPREAD(links.second[e], links.far[e])
  }
}

/* albedo_sums: over and under, what an image adds to those of its pixels' albedo, over / under: the one
   with which all images are nearest to their targets, gain that of albedo 1. The first sets them. */
__kernel void albedo_sums(__global const float *light, __global const float *gain,
                          __global const float *target, __global float *over, __global float *under,
                          int is_first, int pixels)
{
  const int p = get_global_id(0);
  if (p >= pixels)
    return;
  const float e = gain[p] * light[p];
  over[p] = (is_first ? 0 : over[p]) + e * target[p];
  under[p] = (is_first ? 0 : under[p]) + e * e;
}

/* albedo_gain: the gain with that albedo. */
__kernel void albedo_gain(__global const float *over, __global const float *under,
                          __global const float *gain, __global float *out, int pixels)
{
  const int p = get_global_id(0);
  if (p < pixels)
    out[p] = over[p] / under[p] * gain[p];
}

/* misfit: in part (blocks) the sums of (gain E - target)^2. Work-item g of this, of bending and of descent
   owns NODES_PER_SUM nodes and adds them in order. */
__kernel void misfit(__global const float *light, __global const float *gain, __global const float *target,
                     __global double *part, int block, int pixels)
{
  const int g = get_global_id(0);
  if (g * NODES_PER_SUM >= pixels)
    return;
  double square = 0;
  for (int p = g * NODES_PER_SUM; p < min(pixels, g * NODES_PER_SUM + NODES_PER_SUM); ++p) {
    const float r = gain[p] * light[p] - target[p];
    square += (double)r * (double)r;
  }
  part[block + g] = square;
}

/* Second difference of v along a line of n nodes, `step` apart in memory, about node i of it; 0 at the
   ends. */
float bend(__global const float *v, int i, int n, int step)
{
  return i < 1 || i > n - 2 ? 0 : (v[-step] - v[0]) - (v[0] - v[step]);
}

/* The transpose of bend, of itself. */
float unbend(__global const float *v, int i, int n, int step)
{
  float sum = -2 * bend(v, i, n, step);
  if (i > 1)
    sum += bend(v - step, i - 1, n, step);
  if (i < n - 2)
    sum += bend(v + step, i + 1, n, step);
  return sum;
}

/* bending: in part (blocks), from `block` on as above, the sums of squared second differences of z - rest
   along rows and columns. */
__kernel void bending(__global const float *z, __global const float *rest, __global double *part, int block,
                      int rows, int cols)
{
  const int g = get_global_id(0), pixels = rows * cols;
  if (g * NODES_PER_SUM >= pixels)
    return;
  double sum = 0;
  for (int p = g * NODES_PER_SUM; p < min(pixels, g * NODES_PER_SUM + NODES_PER_SUM); ++p) {
    const float a = bend(z + p, p % cols, cols, 1) - bend(rest + p, p % cols, cols, 1);
    const float b = bend(z + p, p / cols, rows, cols) - bend(rest + p, p / cols, rows, cols);
    sum += (double)a * (double)a + (double)b * (double)b;
  }
  part[block + g] = sum;
}

/* gradient: sum += quanta transpose(J) gain (gain E - target), and squares += fine x the diagonal of
   transpose(J) gain^2 J, or what it is where no two links of a node lead to the same one. Sums are in fixed
   point: `quanta` is how many integers make 1, `quantum` the value of one. Work-item g of this and of all
   below owns `per_item` nodes, a multiple of LANES; if there is more than one copy of the sums, it adds to a
   copy of its own: sum and squares (copies, pixels). */
__kernel void gradient(__global const float *restrict light, __global const int *restrict held,
                       __global const int *restrict first, __global const int *restrict second,
                       __global const float *restrict near, __global const float *restrict far,
                       __global const float *restrict gain, __global const float *restrict target,
                       __global long *sum, __global long *squares, float quanta, float fine, int rows,
                       int cols, int count, int sides, int per_item, int copies)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  const size_t own = copies > 1 ? (size_t)g * rows * cols : 0;
  for (int p = g * per_item; p < min(rows * cols, g * per_item + per_item); ++p) {
    spread_at(links, sum + own, gain[p] * (gain[p] * light[p] - target[p]) * quanta, 0, rows, cols, p,
              copies > 1);
    spread_at(links, squares + own, gain[p] * gain[p] * fine, 1, rows, cols, p, copies > 1);
  }
}

/* The sum for node i over all copies; they are 0 then. */
long taken(__global long *sum, int i, int pixels, int copies)
{
  long all_ = 0;
  for (int t = 0; t < copies; ++t) {
    all_ += sum[(size_t)t * pixels + i];
    sum[(size_t)t * pixels + i] = 0;
  }
  return all_;
}

/* descent: the descent direction r = -(sum quantum + lambda unbend (z - rest)), 0 where a bound holds z
   (free 0); scale = squares fine + least; x = p = s = sum = squares = 0 for conjugate gradients. */
__kernel void descent(__global const float *z, __global const float *rest, __global const float *low,
                      __global const float *high, __global long *sum, __global long *squares,
                      __global float *scale, __global float *r, __global float *x, __global float *p,
                      __global float *s, __global float *is_free, float quantum, float fine, float least,
                      float lambda_, int rows, int cols, int per_item, int copies)
{
  const int g = get_global_id(0), pixels = rows * cols;
  for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i) {
    const float smooth = (unbend(z + i, i % cols, cols, 1) + unbend(z + i, i / cols, rows, cols))
                         - (unbend(rest + i, i % cols, cols, 1) + unbend(rest + i, i / cols, rows, cols));
    const float steepest = -(convert_float(taken(sum, i, pixels, copies)) * quantum + lambda_ * smooth);
    const float moves = (z[i] <= low[i] && steepest < 0) || (z[i] >= high[i] && steepest > 0) ? 0 : 1;
    scale[i] = convert_float(taken(squares, i, pixels, copies)) * fine + least;
    is_free[i] = moves;
    r[i] = moves * steepest;
    x[i] = 0;
    p[i] = 0;
    s[i] = 0;
  }
}

/* The preconditioner: v = r / scale, and the same on grids COARSENING and COARSENING^2 times as coarse,
   brought up by linear interpolation (Bramble, Pasciak and Xu 1990); r is brought down by its transpose. */

/* Node j of a coarse line of n: its share in node COARSENING j - 2 + a of the fine one. */
float hat(int a, int j, int n)
{
  return (a < 4 ? j == 0 : j == n - 1) ? 1 : (a < 4 ? 2 * a + 1 : 15 - 2 * a) * 0.125f;
}

/* Node (x, y) of the restriction to a coarse grid from one of rows x cols. */
float restricted(__global const float *fine, int rows, int cols, int x, int y)
{
  const int n_rows = (rows - 1) / COARSENING + 1, n_cols = (cols - 1) / COARSENING + 1;
  const int a_0 = max(0, 2 - COARSENING * x), a_1 = min(2 * COARSENING, cols + 2 - COARSENING * x),
            b_0 = max(0, 2 - COARSENING * y), b_1 = min(2 * COARSENING, rows + 2 - COARSENING * y);
  fine += (COARSENING * y - 2) * cols + COARSENING * x - 2;
  float sum = 0;
#if LANES == 8
  if (a_1 - a_0 == LANES) {
    floats columns = 0;
    for (int b = b_0; b < b_1; ++b)
      columns += hat(b, y, n_rows) * READ(b * cols, fine);
    for (int a = 0; a < LANES; ++a)
      sum += hat(a, x, n_cols) * columns[a];
    return sum;
  }
#endif
  for (int a = a_0; a < a_1; ++a) {
    float column = 0;
    for (int b = b_0; b < b_1; ++b)
      column += hat(b, y, n_rows) * fine[b * cols + a];
    sum += hat(a, x, n_cols) * column;
  }
  return sum;
}

/* restriction: to = times the restriction of `fine`; over `scale`, if asked to divide. */
__kernel void restriction(__global const float *fine, __global const float *scale, __global float *to,
                          float times, int divides, int rows, int cols)
{
  const int x = get_global_id(0), y = get_global_id(1), n_rows = (rows - 1) / COARSENING + 1,
            n_cols = (cols - 1) / COARSENING + 1;
  if (x >= n_cols || y >= n_rows)
    return;
  const float sum = times * restricted(fine, rows, cols, x, y);
  to[y * n_cols + x] = divides ? sum / scale[y * n_cols + x] : sum;
}

/* v = free (r / scale + the prolongation of a coarse grid), for the nodes of row y that lie in its node
   x. */
void prolong_at(__global const float *r, __global const float *scale, __global const float *is_free,
                __global const float *coarse, __global float *v, int rows, int cols, int x, int y)
{
  const int n_rows = (rows - 1) / COARSENING + 1, n_cols = (cols - 1) / COARSENING + 1, k = y % COARSENING,
            i = y * cols + COARSENING * x;
  const float share = (k < 2 ? 3 - 2 * k : 2 * k - 3) * 0.125f, own = 1 - share;
  const int row = y / COARSENING, other = clamp(k < 2 ? row - 1 : row + 1, 0, n_rows - 1);
  __global const float *here = coarse + row * n_cols, *neighbour = coarse + other * n_cols;
  const int left = max(x - 1, 0), right = min(x + 1, n_cols - 1);
  const float a = own * here[left] + share * neighbour[left], b = own * here[x] + share * neighbour[x],
              c = own * here[right] + share * neighbour[right];
  const float4 raised = (float4)(0.625f * b + 0.375f * a, 0.875f * b + 0.125f * a, 0.875f * b + 0.125f * c,
                                 0.625f * b + 0.375f * c);
  for (int l = 0; l < min(COARSENING, cols - COARSENING * x); ++l)
    v[i + l] = is_free[i + l] * (r[i + l] / scale[i + l] + raised[l]);
}

__kernel void prolongation(__global const float *r, __global const float *scale,
                           __global const float *is_free, __global const float *coarse, __global float *v,
                           int rows, int cols)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x * COARSENING < cols && y < rows)
    prolong_at(r, scale, is_free, coarse, v, rows, cols, x, y);
}

/* inner_products: in part (2, blocks) the sums of v v and of r v. */
__kernel void inner_products(__global const float *r, __global const float *v, __global double *part,
                             int pixels)
{
  const int g = get_global_id(0), blocks = (pixels - 1) / NODES_PER_SUM + 1;
  if (g >= blocks)
    return;
  double square = 0, product = 0;
  for (int i = g * NODES_PER_SUM; i < min(pixels, g * NODES_PER_SUM + NODES_PER_SUM); ++i) {
    square += (double)v[i] * (double)v[i];
    product += (double)r[i] * (double)v[i];
  }
  part[g] = square;
  part[blocks + g] = product;
}

/* The state of conjugate gradients (double): iterations left, 0 once it has stopped; units of the scattered
   sum and of r v, v w and v v, from the last ones' size; alpha, 0 before the first step; the first r v; what
   the quadratic model has gained; and what was asked for: lambda, damping, share of the first r v at which to
   stop. Two of them take turns, and so do the totals (3, SUM_SLOTS) of r v, v w and v v. */

/* change_at of nodes p to p + LANES - 1, less those from `end` on; p is a multiple of LANES. Link by link,
   since those of neighbours lie side by side. */
void changes_at(Links links, __global const float *v, int rows, int cols, int p, int end, float *changes)
{
  const int begin = link_at(p, 0, links.count);
  int held[LANES], most = 0;
  for (int l = 0; l < LANES; ++l) {
    const int there = p + l < end;
    changes[l] = there ? own_change_at(links, v, rows, cols, p + l) : 0;
    held[l] = there ? links.held[p + l] : 0;
    most = max(most, held[l]);
  }
  for (int k = 0; k < most; ++k)
    for (int l = 0; l < LANES; ++l) {
      const int e = begin + k * LINK_BLOCK + l;
      if (k < held[l])
        changes[l] += links.near[e] * v[links.first[e]] + links.far[e] * v[links.second[e]];
    }
}

/* spread_at of the same nodes, each with its u. */
void spread_all_at(Links links, __global long *sum, const float *u, int rows, int cols, int p, int end,
                   int exclusive)
{
  const int begin = link_at(p, 0, links.count);
  int held[LANES], most = 0;
  for (int l = 0; l < LANES; ++l) {
    const int there = p + l < end;
    if (there)
      spread_own_at(links, sum, u[l], 0, rows, cols, p + l, exclusive);
    held[l] = there ? links.held[p + l] : 0;
    most = max(most, held[l]);
  }
  for (int k = 0; k < most; ++k)
    for (int l = 0; l < LANES; ++l) {
      const int e = begin + k * LINK_BLOCK + l;
      if (k < held[l]) {
        add(sum + links.first[e], (long)(links.near[e] * u[l]), exclusive);
        add(sum + links.second[e], (long)(links.far[e] * u[l]), exclusive);
      }
    }
}

/* product: sum += quanta transpose(J) gain^2 J v. */
__kernel void product(__global const float *restrict light, __global const int *restrict held,
                      __global const int *restrict first, __global const int *restrict second,
                      __global const float *restrict near, __global const float *restrict far,
                      __global const float *restrict gain, __global const float *restrict v,
                      __global long *sum, __global const double *state, int rows, int cols, int count,
                      int sides,
                      int per_item, int copies)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  const size_t own = copies > 1 ? (size_t)g * rows * cols : 0;
  const int end = state[LEFT] > 0 ? min(rows * cols, g * per_item + per_item) : 0;
  const float quanta = state[SCATTERED];
  float u[LANES];
  for (int p = g * per_item; p < end; p += LANES) {
    changes_at(links, v, rows, cols, p, end, u);
    for (int q = p; q < min(p + LANES, end); ++q)
      u[q - p] = gain[q] * gain[q] * u[q - p] * quanta;
    spread_all_at(links, sum + own, u, rows, cols, p, end, copies > 1);
  }
}

/* albedo_change: in (or added to) share, the part of the change of the pixels' albedo by v from one image:
   bright gain J v, bright = the image at albedo 1. */
__kernel void albedo_change(__global const float *restrict light, __global const int *restrict held,
                            __global const int *restrict first, __global const int *restrict second,
                            __global const float *restrict near, __global const float *restrict far,
                            __global const float *restrict gain, __global const float *restrict bare,
                            __global const float *restrict v, __global float *restrict share,
                            __global const double *state, int rows, int cols, int count, int sides,
                            int is_first, int per_item)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  const int end = state[LEFT] > 0 ? min(rows * cols, g * per_item + per_item) : 0;
  float changes[LANES];
  for (int p = g * per_item; p < end; p += LANES) {
    changes_at(links, v, rows, cols, p, end, changes);
    for (int q = p; q < min(p + LANES, end); ++q)
      share[q] = (is_first ? 0 : share[q]) + bare[q] * light[q] * (gain[q] * changes[q - p]);
  }
}

/* reduced_product: as product, less what a change of the albedo makes up for. */
__kernel void reduced_product(__global const float *restrict light, __global const int *restrict held,
                              __global const int *restrict first, __global const int *restrict second,
                              __global const float *restrict near, __global const float *restrict far,
                              __global const float *restrict gain, __global const float *restrict bare,
                              __global const float *restrict share, __global const float *restrict under,
                              __global const float *restrict v, __global long *sum,
                              __global const double *state, int rows, int cols, int count, int sides,
                              int per_item, int copies)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int g = get_global_id(0);
  const size_t own = copies > 1 ? (size_t)g * rows * cols : 0;
  const int end = state[LEFT] > 0 ? min(rows * cols, g * per_item + per_item) : 0;
  const float quanta = state[SCATTERED];
  float u[LANES];
  for (int p = g * per_item; p < end; p += LANES) {
    changes_at(links, v, rows, cols, p, end, u);
    for (int q = p; q < min(p + LANES, end); ++q) {
      const float left = gain[q] * u[q - p] - bare[q] * light[q] * (share[q] / under[q]);
      u[q - p] = gain[q] * left * quanta;
    }
    spread_all_at(links, sum + own, u, rows, cols, p, end, copies > 1);
  }
}

/* normal_product: w = free (sum quantum + lambda unbend v + damping scale v), the normal equations' matrix
   times v; sum = 0; and what the node adds to r v, v w and v v. */
long3 normal_product_at(__global const float *r, __global const float *v, __global const float *scale,
                        __global const float *is_free, __global long *sum, __global float *w, float quantum,
                        float lambda_, float damping, double by_product, double by_square, int rows,
                        int cols, int copies, int i)
{
  const float smooth = unbend(v + i, i % cols, cols, 1) + unbend(v + i, i / cols, rows, cols);
  w[i] = is_free[i] * (convert_float(taken(sum, i, rows * cols, copies)) * quantum + lambda_ * smooth +
                       damping * scale[i] * v[i]);
  const double product = (double)r[i] * (double)v[i], curvature = (double)v[i] * (double)w[i],
               square = (double)v[i] * (double)v[i];
  return (long3)(convert_long_rtz(product * by_product), convert_long_rtz(curvature * by_product),
                 convert_long_rtz(square * by_square));
}

__kernel void normal_product(__global const float *r, __global const float *v, __global const float *scale,
                             __global const float *is_free, __global long *sum, __global float *w,
                             __global long *totals, __global const double *state, int rows, int cols,
                             int per_item, int copies)
{
  const int g = get_global_id(0), pixels = rows * cols;
  if (g * per_item >= pixels || state[LEFT] <= 0)
    return;
  const float quantum = 1 / state[SCATTERED], lambda_ = state[LAMBDA], damping = state[DAMPING];
  long3 part = 0;
  for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i)
    part += normal_product_at(r, v, scale, is_free, sum, w, quantum, lambda_, damping, state[UNIT_RV],
                              state[UNIT_VV], rows, cols, copies, i);
  atom_add(totals + g % SUM_SLOTS, part.x);
  atom_add(totals + SUM_SLOTS + g % SUM_SLOTS, part.y);
  atom_add(totals + 2 * SUM_SLOTS + g % SUM_SLOTS, part.z);
}

/* The state after an iteration with these totals, whether it takes a step, and beta. */
typedef struct { double next[STATE]; double beta; int takes_step; } Iteration;

Iteration iteration_of(__global const double *state, long3 total, double fixed_, double exact)
{
  Iteration iteration;
  for (int i = 0; i < STATE; ++i)
    iteration.next[i] = state[i];
  const double product = total.x / state[UNIT_RV], square = total.z / state[UNIT_VV];
  double curvature = total.y / state[UNIT_RV];
  iteration.beta = 0;
  if (state[ALPHA] != 0) {
    iteration.beta = product / state[PRODUCT];
    curvature -= iteration.beta * product / state[ALPHA];
  } else
    iteration.next[START] = product;
  iteration.takes_step = product > state[STOP_RATIO] * iteration.next[START] && curvature > 0;
  if (iteration.takes_step) {
    iteration.next[LEFT] = state[LEFT] - 1;
    iteration.next[SCATTERED] = fixed_ / sqrt(square);
    iteration.next[UNIT_RV] = exact / product;
    iteration.next[UNIT_VV] = exact / square;
    iteration.next[PRODUCT] = product;
    iteration.next[ALPHA] = product / curvature;
    iteration.next[GAIN] = state[GAIN] + 0.5 * iteration.next[ALPHA] * product;
  } else
    iteration.next[LEFT] = 0;
  return iteration;
}

/* conjugate_step: a step of conjugate gradients with one sum (Chronopoulos and Gear 1989): p = v + beta p,
   s = w + beta s, x += alpha p, r -= alpha s. */
void conjugate_step_at(__global const float *v, __global const float *w, __global float *r,
                       __global float *x, __global float *p, __global float *s, float alpha, float beta,
                       int i)
{
  p[i] = v[i] + beta * p[i];
  s[i] = w[i] + beta * s[i];
  x[i] += alpha * p[i];
  r[i] -= alpha * s[i];
}

__kernel void conjugate_step(__global const float *v, __global const float *w, __global float *r,
                             __global float *x, __global float *p, __global float *s,
                             __global const long *totals, __global long *next_totals,
                             __global const double *state, __global double *next, double fixed_,
                             double exact, int pixels, int per_item)
{
  const int g = get_global_id(0);
  if (g * per_item >= pixels || (g > 0 && state[LEFT] <= 0))
    return;
  long3 total = 0;
  for (int i = 0; i < SUM_SLOTS; ++i)
    total += (long3)(totals[i], totals[SUM_SLOTS + i], totals[2 * SUM_SLOTS + i]);
  const Iteration iteration = iteration_of(state, total, fixed_, exact);
  if (g == 0) {
    for (int i = 0; i < STATE; ++i)
      next[i] = state[LEFT] > 0 ? iteration.next[i] : state[i];
    for (int i = 0; i < 3 * SUM_SLOTS; ++i)
      next_totals[i] = 0;
  }
  if (state[LEFT] > 0 && iteration.takes_step)
    for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i)
      conjugate_step_at(v, w, r, x, p, s, (float)iteration.next[ALPHA], (float)iteration.beta, i);
}

/* start: the state and the totals before the first iteration; square and product: v v and r v. One
   work-item. */
__kernel void start(__global double *state, __global long *totals, double square, double product,
                    double lambda_, double damping, double least, double fixed_, double exact, int most)
{
  if (get_global_id(0) > 0)
    return;
  for (int i = 0; i < 3 * SUM_SLOTS; ++i)
    totals[i] = 0;
  for (int i = 0; i < STATE; ++i)
    state[i] = 0;
  state[LEFT] = most;
  state[SCATTERED] = fixed_ / sqrt(square);
  state[UNIT_RV] = exact / product;
  state[UNIT_VV] = exact / square;
  state[LAMBDA] = lambda_;
  state[DAMPING] = damping;
  state[STOP_RATIO] = least;
}

/* The parts of `solve`: what the kernels above do, for all nodes. On a CPU that is done for LANES nodes of a
   row at once where all that they read is within the grid; each gets the same bits. 64 bits are four to a
   register. */
#if LANES == 8
typedef struct __attribute__((packed)) { long4 v; } loose_longs;
#define WRITE(value, offset, pointer) ((__global loose_floats *)((pointer) + (offset)))->v = value
#define LONGS(offset, pointer) ((__global loose_longs *)((pointer) + (offset)))->v

void spread_lanes(__global long *sum, floats values)
{
  LONGS(0, sum) += convert_long4_rtz(values.lo);
  LONGS(4, sum) += convert_long4_rtz(values.hi);
}

/* product for nodes p to p + LANES - 1, none of them at a border. */
void product_of_lanes(Links links, __global const float *gain, __global const float *v, __global long *sum,
                      float quanta, int pixels, int cols, int p)
{
  __global const float *light = links.light + pixels;
  const floats own = READ(p, light), across = READ(pixels + p, light), down = READ(2 * pixels + p, light);
  const floats gains = READ(p, gain);
  floats change = own * READ(p, v);
  change += across * ((READ(p + 1, v) - READ(p - 1, v)) * 0.5f);
  change += down * ((READ(p + cols, v) - READ(p - cols, v)) * 0.5f);
  float each[LANES];
  vstore8(change, 0, each);
  for (int l = 0; l < LANES; ++l) {
    float sum = each[l];
    for (int k = 0; k < links.held[p + l]; ++k) {
      const int e = link_at(p + l, k, links.count);
      sum += links.near[e] * v[links.first[e]] + links.far[e] * v[links.second[e]];
    }
    each[l] = sum;
  }
  const floats u = gains * gains * vload8(0, each) * quanta;
  const floats sideways = across * 0.5f * u, downwards = down * 0.5f * u;
  spread_lanes(sum + p, own * u);
  spread_lanes(sum + p + 1, sideways);
  spread_lanes(sum + p - 1, -sideways);
  spread_lanes(sum + p + cols, downwards);
  spread_lanes(sum + p - cols, -downwards);
  vstore8(u, 0, each);
  for (int l = 0; l < LANES; ++l)
    for (int k = 0; k < links.held[p + l]; ++k) {
      const int e = link_at(p + l, k, links.count);
      sum[links.first[e]] += convert_long_rtz(links.near[e] * each[l]);
      sum[links.second[e]] += convert_long_rtz(links.far[e] * each[l]);
    }
}

/* bend and unbend about nodes p to p + LANES - 1, at least two from the ends. */
floats bend_of_lanes(__global const float *v, int p, int step)
{
  const floats middle = READ(p, v);
  return (READ(p - step, v) - middle) - (middle - READ(p + step, v));
}

floats unbend_of_lanes(__global const float *v, int p, int step)
{
  floats sum = -2 * bend_of_lanes(v, p, step);
  sum += bend_of_lanes(v, p - step, step);
  sum += bend_of_lanes(v, p + step, step);
  return sum;
}

/* What four nodes add to r v, v w and v v. */
long3 totals_of(float4 r, float4 v, float4 w, double by_product, double by_square)
{
  const double4 along = convert_double4(v);
  const long4 product = convert_long4_rtz(convert_double4(r) * along * by_product),
              curvature = convert_long4_rtz(along * convert_double4(w) * by_product),
              square = convert_long4_rtz(along * along * by_square);
  return (long3)(product.x + product.y + product.z + product.w,
                 curvature.x + curvature.y + curvature.z + curvature.w,
                 square.x + square.y + square.z + square.w);
}

/* normal_product for nodes i to i + LANES - 1, at least two from all borders. */
long3 normal_product_of_lanes(__global const float *r, __global const float *v, __global const float *scale,
                              __global const float *is_free, __global long *sum, __global float *w,
                              float quantum, float lambda_, float damping, double by_product,
                              double by_square, int cols, int i)
{
  const floats smooth = unbend_of_lanes(v, i, 1) + unbend_of_lanes(v, i, cols), here = READ(i, v);
  const floats scattered = (floats)(convert_float4(LONGS(i, sum)), convert_float4(LONGS(i + 4, sum)));
  const floats found =
      READ(i, is_free) * (scattered * quantum + lambda_ * smooth + damping * READ(i, scale) * here);
  const floats left = READ(i, r);
  LONGS(i, sum) = 0;
  LONGS(i + 4, sum) = 0;
  WRITE(found, i, w);
  return totals_of(left.lo, here.lo, found.lo, by_product, by_square) +
         totals_of(left.hi, here.hi, found.hi, by_product, by_square);
}
#endif

/* product for node p, of a sum that no other work-item adds to. */
void product_at(Links links, __global const float *gain, __global const float *v, __global long *sum,
                float quanta, int rows, int cols, int p)
{
  spread_at(links, sum, gain[p] * gain[p] * change_at(links, v, rows, cols, p) * quanta, 0, rows, cols, p, 1);
}

void products(Links links, __global const float *gain, __global const float *v, __global long *sum,
              float quanta, int rows, int cols)
{
  for (int y = 0; y < rows; ++y) {
    int x = 0;
    while (x < cols) {
      const int p = y * cols + x;
#if LANES == 8
      if (y > 0 && y < rows - 1 && x > 0 && x + LANES < cols) {
        product_of_lanes(links, gain, v, sum, quanta, rows * cols, cols, p);
        x += LANES;
        continue;
      }
#endif
      product_at(links, gain, v, sum, quanta, rows, cols, p);
      ++x;
    }
  }
}

long3 normal_products(__global const float *r, __global const float *v, __global const float *scale,
                      __global const float *is_free, __global long *sum, __global float *w, float quantum,
                      float lambda_, float damping, double by_product, double by_square, int rows, int cols)
{
  long3 total = 0;
  for (int y = 0; y < rows; ++y) {
    int x = 0;
    while (x < cols) {
      const int i = y * cols + x;
#if LANES == 8
      if (y > 1 && y < rows - 2 && x > 1 && x + LANES < cols - 1) {
        total += normal_product_of_lanes(r, v, scale, is_free, sum, w, quantum, lambda_, damping, by_product,
                                         by_square, cols, i);
        x += LANES;
        continue;
      }
#endif
      total += normal_product_at(r, v, scale, is_free, sum, w, quantum, lambda_, damping, by_product,
                                 by_square, rows, cols, 1, i);
      ++x;
    }
  }
  return total;
}

/* solve: product, normal_product, conjugate_step, restriction and prolongation until they stop, by one
   work-item: on a small grid a CPU takes longer to start a kernel than to run it. 4 and 16: of the coarse
   grids. */
__kernel void solve(__global const float *restrict light, __global const int *restrict held,
                    __global const int *restrict first, __global const int *restrict second,
                    __global const float *restrict near, __global const float *restrict far,
                    __global const float *restrict gain, __global const float *restrict scale,
                    __global const float *restrict scale_4, __global const float *restrict scale_16,
                    __global const float *restrict is_free, __global const float *restrict is_free_4,
                    __global long *restrict sum, __global float *restrict r, __global float *restrict r_4,
                    __global float *restrict v, __global float *restrict v_4, __global float *restrict v_16,
                    __global float *restrict w, __global float *restrict x, __global float *restrict p,
                    __global float *restrict s, __global double *restrict state, double fixed_, double exact,
                    int rows, int cols, int count, int sides)
{
  const Links links = {light, held, first, second, near, far, count, sides};
  const int pixels = rows * cols, rows_4 = (rows - 1) / COARSENING + 1, cols_4 = (cols - 1) / COARSENING + 1;
  const int rows_16 = (rows_4 - 1) / COARSENING + 1, cols_16 = (cols_4 - 1) / COARSENING + 1;
  if (get_global_id(0) > 0)
    return;
  while (state[LEFT] > 0) {
    const float quanta = state[SCATTERED], quantum = 1 / state[SCATTERED], lambda_ = state[LAMBDA],
                damping = state[DAMPING];
    const double by_product = state[UNIT_RV], by_square = state[UNIT_VV];
    products(links, gain, v, sum, quanta, rows, cols);
    const long3 total = normal_products(r, v, scale, is_free, sum, w, quantum, lambda_, damping, by_product,
                                        by_square, rows, cols);
    const Iteration iteration = iteration_of(state, total, fixed_, exact);
    for (int i = 0; i < STATE; ++i)
      state[i] = iteration.next[i];
    if (!iteration.takes_step)
      return;
    for (int i = 0; i < pixels; ++i)
      conjugate_step_at(v, w, r, x, p, s, (float)iteration.next[ALPHA], (float)iteration.beta, i);
    for (int y = 0; y < rows_4; ++y)
      for (int x = 0; x < cols_4; ++x)
        r_4[y * cols_4 + x] = restricted(r, rows, cols, x, y);
    for (int y = 0; y < rows_16; ++y)
      for (int x = 0; x < cols_16; ++x)
        v_16[y * cols_16 + x] = restricted(r_4, rows_4, cols_4, x, y) / scale_16[y * cols_16 + x];
    for (int y = 0; y < rows_4; ++y)
      for (int x = 0; x < cols_16; ++x)
        prolong_at(r_4, scale_4, is_free_4, v_16, v_4, rows_4, cols_4, x, y);
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < cols_4; ++x)
        prolong_at(r, scale, is_free, v_4, v, rows, cols, x, y);
  }
}

/* bounded_step: to = z + x, within its bounds. */
__kernel void bounded_step(__global const float *z, __global const float *x, __global const float *low,
                           __global const float *high, __global float *to, int pixels, int per_item)
{
  const int g = get_global_id(0);
  for (int i = g * per_item; i < min(pixels, g * per_item + per_item); ++i)
    to[i] = clamp(z[i] + x[i], low[i], high[i]);
}
