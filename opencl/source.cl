/* Where the source shines from: dark walls, windows and lamps, by geometry, in double precision.

Shared arguments
  depth      (rows, cols)       float   [length]  +inf where masked
  steps      (walks, BITS, 4)   int     i, j, k, direction number
  crossings  (n, 8)             int     where a ray meets grid lines within one step, in order: x, y of a
                                        node, x, y to the next node on that line, the weights of both, when
                                        (per STEP_PARTS), parts
  spans      (walks, 2)         int     first crossing of a walk and how many; the last one is the lattice
                                        node itself
  numbers    (4)                double  [length]  x0, x1, y0, y1 of a rectangle, or x, y, z, radius of a ball
  flags      (layers, rows, cols) uchar aperture (one layer) or volume
  kind       0 sky, 1 rectangle, 2 aperture, 3 ball, 4 volume (skylamp.sources); sides: 0 open, 1 dark, 2
             periodic
  step       double [length]  the spacing in the unit of depth

Every formula is one rounding per operation, so every device decides alike. Twin of warp_kernels/source.py. */
#pragma OPENCL FP_CONTRACT OFF
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

/* Whether low <= w / k < high, multiplied out; where the map repeats, for some image of it. */
int within(double w, double k, double low, double high, double period, int sides)
{
  if (sides != PERIODIC)
    return k * low <= w && w < k * high;
  const double v = w - k * low, lap = k * period;
  return v - floor(v / lap) * lap < k * (high - low);
}

/* Whether a ray through (x, y, z) crosses z = 0 inside the box of the map. */
int leaves_box(int x, int y, double z, int i, int j, double climb, int rows, int cols)
{
  const double u = 2 * (x * climb + i * z), v = 2 * (y * climb + j * z);
  return -climb <= u && u < (2 * cols - 1) * climb && -climb <= v && v < (2 * rows - 1) * climb;
}

/* Whether an unblocked ray through (x, y, z) along (i, j, -k) comes from the sky or through the window. */
int meets_plane(int x, int y, double z, int i, int j, int k, __global const double *numbers,
                __global const uchar *flags, int rows, int cols, int kind, int sides, double step)
{
  if (k == 0)
    return kind == SKY && sides != DARK;
  const double climb = k * step;
  if (sides == DARK && !leaves_box(x, y, z, i, j, climb, rows, cols))
    return 0;
  const double u = x * climb + i * z, v = y * climb + j * z;
  if (kind == RECTANGLE)
    return within(u, k, numbers[0], numbers[1], cols * step, sides) &&
           within(v, k, numbers[2], numbers[3], rows * step, sides);
  if (kind == APERTURE) {
    double col = floor((2 * u + climb) / (2 * climb)), row = floor((2 * v + climb) / (2 * climb));
    if (sides == PERIODIC) {
      col -= floor(col / cols) * cols;
      row -= floor(row / rows) * rows;
    }
    return 0 <= col && col < cols && 0 <= row && row < rows && flags[(size_t)row * cols + (size_t)col];
  }
  return 1;
}

/* The step count at which a ray from (x, y, z) along (i, j, -k) first meets the closed ball; -1 if it does
   not. The discriminant b^2 - a (d.d - r^2) is a r^2 - |l x d|^2, which keeps its digits from far away. */
double meets_ball(int x, int y, double z, int i, int j, int k, __global const double *numbers, double step)
{
  const double lx = i * step, ly = j * step, lz = -(k * step);
  const double dx = numbers[0] - x * step, dy = numbers[1] - y * step, dz = numbers[2] - z;
  const double a = lx * lx + ly * ly + lz * lz, b = dx * lx + dy * ly + dz * lz;
  const double q = dx * dx + dy * dy + dz * dz - numbers[3] * numbers[3];
  if (q <= 0)
    return 0;
  const double cx = ly * dz - lz * dy, cy = lz * dx - lx * dz, cz = lx * dy - ly * dx;
  const double root = a * (numbers[3] * numbers[3]) - (cx * cx + cy * cy + cz * cz);
  return b > 0 && root >= 0 ? (b - sqrt(root)) / a : -1;
}

/* Whether the lamp is visible from (x, y, z) along the step: the ray meets it, and neither ground nor wall
   comes before. */
int meets_lamp(__global const float *depth, int x, int y, double z, int i, int j, int k,
               __global const int *crossings, int n_crossings, __global const double *numbers,
               __global const uchar *flags, int rows, int cols, int layers, int kind, int sides, double step)
{
  double hit = INFINITY;
  const double climb = k * step;
  const long level = (long)rint(z / step);
  if (kind == BALL) {
    hit = meets_ball(x, y, z, i, j, k, numbers, step);
    if (hit < 0)
      return 0;
    if (sides == DARK) {
      if (k > 0 && z <= hit * climb) {
        if (!leaves_box(x, y, z, i, j, climb, rows, cols))
          return 0;
      } else {
        const double px = x + hit * i, py = y + hit * j;
        if (px < -0.5 || px >= cols - 0.5 || py < -0.5 || py >= rows - 0.5)
          return 0;
      }
    }
    if (i == 0 && j == 0)
      return 1; /* straight up nothing is in the way, however deep the node lies */
  } else if (level < layers && flags[((size_t)level * rows + y) * cols + x])
    return 1;
  for (long t = 0;; ++t)
    for (int c = 0; c < n_crossings; ++c) {
      __global const int *at = crossings + 8 * c;
      const double parts = at[7], when = t * parts + at[6];
      if (kind == BALL && when >= hit * parts)
        return 1;
      const double over = z * parts - when * climb; /* the ray's depth x parts */
      if (over < (kind == BALL ? 0.0 : -0.5 * step * parts))
        return kind == BALL;
      long cx = x + t * i + at[0], cy = y + t * j + at[1], ex = cx + at[2], ey = cy + at[3];
      if (sides == PERIODIC) {
        cx -= (long)floor((double)cx / cols) * cols;
        cy -= (long)floor((double)cy / rows) * rows;
        ex -= (long)floor((double)ex / cols) * cols;
        ey -= (long)floor((double)ey / rows) * rows;
      }
      const int near_in = cx >= 0 && cx < cols && cy >= 0 && cy < rows;
      const int far_in = ex >= 0 && ex < cols && ey >= 0 && ey < rows;
      if (!near_in && !far_in && c == n_crossings - 1)
        return kind == BALL; /* past the side of the map nothing stands in the way */
      if (near_in && (at[5] == 0 || far_in)) {
        const float near = depth[(size_t)cy * cols + cx],
                    far = at[5] == 0 ? near : depth[(size_t)ey * cols + ex];
        if (!isinf(near) && !isinf(far) && at[4] * (double)near + at[5] * (double)far < over)
          return 0;
      }
      if (kind == VOLUME) {
        /* of two nodes as near, that farther along the ray: else a lamp is off to one side */
        const int ahead = i * at[2] + j * at[3] > 0, is_far = ahead ? 2 * at[5] >= parts : 2 * at[5] > parts;
        const long nx = is_far ? ex : cx, ny = is_far ? ey : cy;
        const long n = (long)floor((2 * (level * parts - when * k) + parts) / (2 * parts));
        if (n >= 0 && n < layers && nx >= 0 && nx < cols && ny >= 0 && ny < rows &&
            flags[((size_t)n * rows + ny) * cols + nx])
          return 1;
      }
      if (k == 0 && c == n_crossings - 1 && cx == x && cy == y)
        return 0; /* a level ray on a map that repeats has come round */
    }
}

/* clip: clears the bits of surface nodes whose unblocked rays do not come from the sky, window or lamp, and
with a lamp sets those that only something beyond the lamp blocks. planes (walks, room) uchar, in, out.
Work-item p owns pixel p. */
__kernel void clip(__global const float *depth, __global const int *steps, __global const int *crossings,
                   __global const int *spans, __global const double *numbers, __global const uchar *flags,
                   __global uchar *planes, int rows, int cols, int room, int layers, int kind, int sides,
                   double step, int n_walks)
{
  const size_t p = get_global_id(0), pixels = (size_t)rows * cols;
  if (p >= pixels || isinf(depth[p]))
    return;
  const int x = p % cols, y = p / cols;
  for (int w = 0; w < n_walks; ++w) {
    int lit = planes[(size_t)w * room + p];
    for (int b = 0; b < BITS; ++b) {
      __global const int *l = steps + 4 * (BITS * w + b);
      int on;
      if (kind == BALL && lit >> b & 1 && sides == OPEN)
        on = meets_ball(x, y, depth[p], l[0], l[1], l[2], numbers, step) >= 0;
      else if (kind >= BALL)
        on = meets_lamp(depth, x, y, depth[p], l[0], l[1], l[2], crossings + 8 * spans[2 * w],
                        spans[2 * w + 1], numbers, flags, rows, cols, layers, kind, sides, step);
      else
        on = lit >> b & 1 &&
             meets_plane(x, y, depth[p], l[0], l[1], l[2], numbers, flags, rows, cols, kind, sides, step);
      lit = on ? lit | 1 << b : lit & ~(1 << b);
    }
    planes[(size_t)w * room + p] = lit;
  }
}

/* enter: the field outside the volume. Nodes of layer n < 0, and of the rim of `reach` nodes around layer n
>= 0, get the bits of the rays that come from the sky or through the window; lamps do not use it.

  field  (layers + reach, words, rows + 2 reach, cols + 2 reach) uint  out; layer n stands at n + reach

Work-item (X, Y, n) owns a node of the layer with its rim, for all directions. */
__kernel void enter(__global const int *steps, __global const double *numbers, __global const uchar *flags,
                    __global uint *field, int rows, int cols, int reach, int n_words, int n_directions,
                    int kind, int sides)
{
  const int X = get_global_id(0), Y = get_global_id(1), layer = get_global_id(2);
  const int width = cols + 2 * reach, height = rows + 2 * reach;
  const int x = X - reach, y = Y - reach, n = layer - reach;
  if (X >= width || Y >= height || (n >= 0 && x >= 0 && x < cols && y >= 0 && y < rows))
    return;
  for (int word = 0; word < n_words; ++word) {
    uint lit = 0;
    for (int d = 32 * word; d < min(32 * word + 32, n_directions); ++d) {
      __global const int *l = steps + 4 * d;
      if (!(sides == DARK && n >= 0) &&
          meets_plane(x, y, n, l[0], l[1], l[2], numbers, flags, rows, cols, kind, sides, 1))
        lit |= 1u << d % 32;
    }
    field[(((size_t)layer * n_words + word) * height + Y) * width + X] = lit;
  }
}

/* beam: the field of a lamp, node by node. words (layers, words, rows, cols) uint, out. Work-item (p, n) owns
   node p of layer n. */
__kernel void beam(__global const float *depth, __global const int *steps, __global const int *crossings,
                   __global const int *spans, __global const double *numbers, __global const uchar *flags,
                   __global uint *field, int rows, int cols, int layers, int kind, int sides, int n_words,
                   int n_directions, int field_layers)
{
  const size_t p = get_global_id(0), pixels = (size_t)rows * cols;
  const int n = get_global_id(1);
  if (p >= pixels || n >= field_layers)
    return;
  const int x = p % cols, y = p / cols;
  for (int word = 0; word < n_words; ++word) {
    uint lit = 0;
    for (int d = 32 * word; d < min(32 * word + 32, n_directions); ++d) {
      __global const int *l = steps + 4 * d;
      if (n <= depth[p] && meets_lamp(depth, x, y, n, l[0], l[1], l[2], crossings + 8 * spans[2 * d],
                                      spans[2 * d + 1], numbers, flags, rows, cols, layers, kind, sides, 1))
        lit |= 1u << d % 32;
    }
    field[((size_t)n * n_words + word) * pixels + p] = lit;
  }
}
