/* Light of a finite source, a ball or a flat quadrangle, through a few azimuth slices per pixel.

In the slice at azimuth phi the source covers the elevations low..high; what ground, tangent plane and level leave of them
gives E = sum over slices of width x (n_c integral of B cos^2 + n_z integral of B sin cos), n_c the normal's part along phi.
Elevations are carried as tangents; lengths are in units of the spacing, heights grow towards the viewer.

Shared arguments
  heights     (rows + 2, cols + 1) float  -depth; NONE where masked, in column 0 and in the first and last row: node (x, y)
                                          stands at (y + 1) stride + x + 1, and every neighbour of a node can be read
  tops        (cells, width)       float  highest node of square cells, corners included: level l = 1.. has cells 2^l wide
                                          from column width - (width >> l - 1) on; width is a multiple of 2^(levels - 1)
  sky         (side, side)         float  brightness over the stereographic plane, u and v from -1 to 1
  points      (n_points, 2)        float  where a chord's brightness is taken, 0..1, and weights; none: uniform
  irradiance  (rows, cols)         float  out; brightness: a factor of the result
  dark        walls half a node outside the map, up to height 0

Twin of warp_kernels/slices.py. */
#include "lanes.h"
#define NONE -1e30f
#define STEEP 1e6f /* as good as the zenith */
#define LESS(a, b) ((a) < (b) ? (a) : (b)) /* min and max of vectors are calls on PoCL */
#define MORE(a, b) ((a) > (b) ? (a) : (b))
#if LANES == 1
#define TO_FLOATS convert_float
#define FEW(pointer, i) (pointer)[i]
#define ANY(test) (test)
#define TOTAL(v) (v)
#define LANE 0
typedef float floats_at;
#define AT(offset, pointer) (pointer)[offset]
#else
#define TO_FLOATS convert_float8
#define LANE (ints)(0, 1, 2, 3, 4, 5, 6, 7)
#define FEW(p, i) ((floats)((p)[(i).s0], (p)[(i).s1], (p)[(i).s2], (p)[(i).s3], (p)[(i).s4], (p)[(i).s5], (p)[(i).s6], (p)[(i).s7]))
typedef struct __attribute__((packed)) {
  floats v;
} floats_at;
#define AT(offset, pointer) ((__global const floats_at *)((pointer) + (offset)))->v
inline int any_of(ints test)
{
  const int4 four = test.lo | test.hi;
  const int2 two = four.lo | four.hi;
  return two.x | two.y;
}
#define ANY any_of
inline float total_of(floats v)
{
  const float4 four = v.lo + v.hi;
  const float2 two = four.lo + four.hi;
  return two.x + two.y;
}
#define TOTAL total_of
#endif

/* coarser: one level of tops. Work-item (x, y) owns a cell. */
__kernel void coarser(__global const float *heights, __global float *tops, int rows, int cols, int width, int level)
{
  const int x = get_global_id(0), y = get_global_id(1), wide = width >> level, stride = cols + 1;
  if (x >= wide)
    return;
  float top = NONE;
  if (level == 1) {
    for (int j = 2 * y; j <= min(2 * y + 2, rows - 1); ++j)
      for (int i = 2 * x; i <= min(2 * x + 2, cols - 1); ++i)
        top = max(top, heights[(j + 1) * stride + i + 1]);
  } else {
    const int finer = ((rows - 1) >> (level - 1)) + 1; /* cells down */
    __global const float *from = tops + width - (width >> (level - 2));
    for (int j = 2 * y; j <= min(2 * y + 1, finer - 1); ++j)
      for (int i = 2 * x; i <= 2 * x + 1; ++i)
        top = max(top, from[j * width + i]);
  }
  tops[y * width + width - (width >> (level - 1)) + x] = top;
}

/* What a pixel's slices share. */
typedef struct {
  __global const float *heights, *tops, *sky, *points;
  int rows, cols, width, levels, side, n_points, dark;
  int x, y, here;
  float height, tilt_x, tilt_y; /* slopes of depth */
  float up, reach; /* a point (c t, s t, v) stands before the source iff along t + up v < reach */
} Pixel;

inline float slope_between(__global const float *heights, int here, int low, int high)
{
  const float before = heights[low], after = heights[high], own = heights[here];
  if (before > NONE && after > NONE)
    return (before - after) * 0.5f;
  return before > NONE ? before - own : after > NONE ? own - after : 0.0f;
}

/* The tangent of the horizon along (c, s), of the ground before the source, from `slope` on and as far as `high` matters.

Cell by cell of the quadtree: a cell whose top stays below the line is skipped; where it does not, its quarters are
looked at, down to single cells, whose way out is a crossing with a grid line. */
inline floats horizon(const Pixel *pixel, floats c, floats s, floats slope, floats high, floats along)
{
  const int stride = pixel->cols + 1, x = pixel->x, y = pixel->y;
  const floats per_x = c != 0 ? 1 / c : 1e30f, per_y = s != 0 ? 1 / s : 1e30f;
  const ints on_x = WHERE(c >= 0) & 1, on_y = WHERE(s >= 0) & 1;
  const floats end_x = c != 0 ? (c > 0 ? (floats)(pixel->cols - 1 - x) : (floats)x) * (c < 0 ? -per_x : per_x) : 1e30f;
  const floats end_y = s != 0 ? (s > 0 ? (floats)(pixel->rows - 1 - y) : (floats)y) * (s < 0 ? -per_y : per_y) : 1e30f;
  const floats end = LESS(end_x, end_y);
  ints ix = x - 1 + on_x, iy = y - 1 + on_y, level = 0;
  floats t = 0;
  ints going = WHERE(slope < high) & WHERE(end > 0) & WHERE((floats)pixel->reach > 0);
  while (ANY(going)) {
    const ints cell_x = ix >> level, cell_y = iy >> level;
    const ints edge_x = cell_x + on_x, edge_y = cell_y + on_y;
    const ints line_x = edge_x << level, line_y = edge_y << level;
    const floats out_x = TO_FLOATS(line_x - x) * per_x, out_y = TO_FLOATS(line_y - y) * per_y;
    const ints by_x = WHERE(out_x <= out_y);
    const floats out = by_x ? out_x : out_y;
    const floats px = c * out, py = s * out;
    ints skip;
    const ints fine = WHERE(level == 0);
    /* 1. the crossing at a single cell's way out */
    {
      const ints low = by_x ? iy * stride + line_x : line_y * stride + ix;
      const ints at = (fine & going) ? low + stride + 1 : (ints)0;
      const ints next = at + (by_x ? (ints)stride : (ints)1);
      floats f = by_x ? py - TO_FLOATS(iy - y) : px - TO_FLOATS(ix - x);
      f = f < 0 ? 0 : f > 1 ? 1 : f;
      const floats rise = FEW(pixel->heights, at) * (1 - f) + FEW(pixel->heights, next) * f - pixel->height;
      const ints over = fine & going & WHERE(rise > slope * out) & WHERE(out * (along + slope * pixel->up) < pixel->reach);
      slope = over ? rise / out : slope;
    }
    /* 2. a larger cell's top against the line where it enters */
    {
      const ints at = cell_y * pixel->width + pixel->width - ((ints)pixel->width >> (level - 1)) + cell_x;
      const floats top = FEW(pixel->tops, (fine | ~going) ? (ints)0 : at);
      skip = fine | WHERE(top - pixel->height <= slope * t);
    }
    /* 3. on, and up where a larger cell begins; or down */
    skip &= going;
    const ints side = ((ints)1 << level) - 1, low_x = cell_x << level, low_y = cell_y << level;
    ints to_x = convert_int8(px), to_y = convert_int8(py);
    to_x = x + to_x + WHERE(px < TO_FLOATS(to_x));
    to_y = y + to_y + WHERE(py < TO_FLOATS(to_y));
    to_x = LESS(MORE(to_x, low_x), low_x + side);
    to_y = LESS(MORE(to_y, low_y), low_y + side);
    ix = skip ? (by_x ? line_x - 1 + on_x : to_x) : ix;
    iy = skip ? (by_x ? to_y : line_y - 1 + on_y) : iy;
    t = skip ? out : t;
    const ints rise = WHERE(((by_x ? edge_x : edge_y) & 1) == 0) & WHERE(level < pixel->levels);
    level += skip ? -rise : going;
    going &= WHERE(slope < high) & WHERE(t < end) & WHERE(t * (along + slope * pixel->up) < pixel->reach);
  }
  return slope;
}

/* Mean brightness of a chord between the tangents low and high, weighted by cos^2 and by sin cos of elevation. */
inline void brightness_of(const Pixel *pixel, floats c, floats s, floats low, floats high, floats *of_c1, floats *of_c2)
{
  const floats low_c = 1 / sqrt(low * low + 1), high_c = 1 / sqrt(high * high + 1);
  const floats low_s = low * low_c, high_s = high * high_c;
  const float half_side = 0.5f * (pixel->side - 1);
  floats b1 = 0, b2 = 0, g1 = 0, g2 = 0;
  for (int k = 0; k < pixel->n_points; ++k) {
    const float f = pixel->points[2 * k], w = pixel->points[2 * k + 1];
    const floats out = low_c + f * (high_c - low_c), rise = low_s + f * (high_s - low_s);
    const floats square = out * out + rise * rise;
    const floats from_pole = half_side * out / (sqrt(square) + rise); /* stereographic */
    const floats u = half_side + from_pole * c, v = half_side + from_pole * s;
    ints i = TO_INTS(u), j = TO_INTS(v);
    i = LESS(i, (ints)(pixel->side - 2));
    j = LESS(j, (ints)(pixel->side - 2));
    i = MORE(i, (ints)0);
    j = MORE(j, (ints)0);
    const ints at = j * pixel->side + i;
    const floats p = u - TO_FLOATS(i), q = v - TO_FLOATS(j);
    const floats near = FEW(pixel->sky, at) * (1 - p) + FEW(pixel->sky, at + 1) * p;
    const floats far = FEW(pixel->sky, at + pixel->side) * (1 - p) + FEW(pixel->sky, at + pixel->side + 1) * p;
    const floats bright = near * (1 - q) + far * q;
    const floats weight = w / (square * square);
    const floats w1 = weight * out * out, w2 = weight * out * rise;
    b1 += w1 * bright;
    b2 += w2 * bright;
    g1 += w1;
    g2 += w2;
  }
  *of_c1 = b1 / MORE(g1, (floats)1e-30f);
  *of_c2 = b2 / MORE(g2, (floats)1e-30f);
}

/* atan(x), 0 <= x <= 1. */
inline floats arctan(floats x)
{
  const floats y = x * x;
  return x * (((((((-0.004693274851888418f * y + 0.024252399802207947f) * y + -0.05948638916015625f) * y + 0.09914292395114899f) * y + -0.14019480347633362f) * y + 0.19969724118709564f) * y + -0.33331990242004395f) * y + 0.9999998807907104f);
}

/* tilt x integral of B cos^2 + integral of B sin cos between the tangents low and high; rise = high - low. */
inline floats chord(const Pixel *pixel, floats c, floats s, floats tilt, floats low, floats high, floats rise)
{
  const ints shows = WHERE(low < high);
  if (!ANY(shows))
    return 0;
  high = MORE(high, low);
  rise = MORE(rise, (floats)0);
  const floats r = sqrt((low * low + 1) * (high * high + 1)), product = low * high;
  const floats sine = rise / r; /* of the chord's angle */
  floats c1 = arctan(rise / (r + 1 + product)) + 0.5f * (1 - product) / r * sine, c2 = 0.5f * (low + high) / r * sine;
  if (pixel->n_points) {
    floats of_c1, of_c2;
    brightness_of(pixel, c, s, low, high, &of_c1, &of_c2);
    c1 *= of_c1;
    c2 *= of_c2;
  }
  return shows ? tilt * c1 + c2 : (floats)0;
}

/* Light through a slice along (c, s), times sqrt(1 + tilt^2): the source between the tangents low and high, `width` apart. */
inline floats slice(const Pixel *pixel, floats c, floats s, floats along, floats low, floats high, floats width)
{
  const floats tilt = pixel->tilt_x * c + pixel->tilt_y * s;
  floats slope = MORE(low, -tilt);
  slope = MORE(slope, (floats)0);
  slope = LESS(slope, (floats)STEEP);
  slope = horizon(pixel, c, s, slope, high, along);
  return chord(pixel, c, s, tilt, slope, high, slope > low ? high - slope : width);
}

/* ball: x0, y0, z0 its centre (z0 a height), radius.

  slices  (4, n_slices)  float  sine and cosine of theta, -pi/2..pi/2, and of the azimuths all round; n_slices in whole lanes

The slice at the azimuth offset d, sin d = (sin a / cos e) sin theta, a the ball's angular radius and e the elevation of its
centre, has a chord of half width w, sin w = sin a cos theta / r, r = sqrt(1 - cos^2 e sin^2 d). Where the zenith lies within
the disc, slices go all round. Work-item (x, y) owns one node; order of summation: slices, then lanes. */
__kernel void ball(__global const float *heights, __global const float *tops, __global const float *slices,
                   __global const float *sky, __global const float *points, __global float *irradiance, int rows,
                   int cols, int width, int levels, int n_slices, int side, int n_points, int dark, float x0, float y0,
                   float z0, float radius, float brightness)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x >= cols || y >= rows)
    return;
  const int stride = cols + 1, here = (y + 1) * stride + x + 1;
  const float height = heights[here];
  Pixel pixel = {heights, tops, sky, points, rows, cols, width, levels, side, n_points, dark, x, y, here, height};
  pixel.tilt_x = slope_between(heights, here, here - 1, here + 1);
  pixel.tilt_y = slope_between(heights, here, here - stride, here + stride);

  /* 1. where the ball stands */
  const float dx = x0 - x, dy = y0 - y, dz = z0 - height;
  const float flat2 = dx * dx + dy * dy, flat = sqrt(flat2), far = sqrt(flat2 + dz * dz);
  const int inside = far <= radius;
  const float ux = flat > 0 ? dx / flat : 1, uy = flat > 0 ? dy / flat : 0;
  const float sin_e = far > 0 ? dz / far : 1, cos_e = far > 0 ? flat / far : 0;
  const float sin_a = inside ? 1 : radius / far, cos_a = inside ? 0 : sqrt((far - radius) * (far + radius)) / far;
  const int all_round = inside || sin_a >= cos_e;
  const float widest = all_round ? 1 : sin_a / cos_e; /* sine of the largest offset */
  const float step = M_PI_F / n_slices;
  pixel.up = dz;
  pixel.reach = inside ? 0 : (far - radius) * (far + radius);

  /* 2. its slices */
  floats sum = 0;
  if (height > NONE && (inside || dz + radius > 0))
    for (int j = 0; j < n_slices; j += LANES) {
      floats sin_d, cos_d, half_width, share;
      if (all_round) {
        sin_d = AT(2 * n_slices + j, slices);
        cos_d = AT(3 * n_slices + j, slices);
        const floats square = sin_a * sin_a - cos_e * cos_e * sin_d * sin_d;
        half_width = sqrt(MORE(square, (floats)0));
        share = 2 * step;
      } else {
        sin_d = widest * AT(j, slices);
        cos_d = sqrt((1 - sin_d) * (1 + sin_d));
        half_width = sin_a * AT(n_slices + j, slices);
        share = widest * step * AT(n_slices + j, slices) / cos_d;
      }
      const floats c = ux * cos_d - uy * sin_d, s = uy * cos_d + ux * sin_d;
      const floats p = cos_e * cos_d, square = p * p + sin_e * sin_e;
      const floats low_c = p * cos_a + sin_e * half_width, low_s = sin_e * cos_a - p * half_width;
      const floats high_c = p * cos_a - sin_e * half_width, high_s = sin_e * cos_a + p * half_width;
      floats low = low_c > 0 ? low_s / low_c : low_s > 0 ? (floats)STEEP : (floats)-STEEP;
      floats high = high_c > 0 ? high_s / high_c : sin_e > 0 ? (floats)STEEP : (floats)-STEEP;
      high = LESS(high, (floats)STEEP);
      low = inside ? (floats)-STEEP : low;
      high = inside ? (floats)STEEP : high;
      const ints whole = WHERE(low_c > 0) & WHERE(high < STEEP);
      const floats chord_width = whole ? 2 * cos_a * half_width * square / (low_c * high_c) : high - low;
      sum += share * slice(&pixel, c, s, flat * cos_d, low, high, chord_width);
    }
  irradiance[y * cols + x] = brightness * TOTAL(sum) / sqrt(1 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y);
}

/* Where slices of a sector of azimuths stand, in the frame whose first axis points below the middle of a quadrangle. */
typedef struct {
  float c, s, quarter; /* its bisector, and the tangent of a quarter of its angle */
} Sector;

inline Sector sector_between(float ax, float ay, float bx, float by)
{
  const float product = sqrt((ax * ax + ay * ay) * (bx * bx + by * by));
  const float turn = ax * by - ay * bx, along = ax * bx + ay * by;
  const float half_ = along < 0 ? (product - along) / max(turn, 1e-7f * product) : max(turn, 0.0f) / (product + along); /* tangent of half the angle */
  const float r = sqrt(1 + half_ * half_), length = r * sqrt(ax * ax + ay * ay);
  const Sector sector = {(ax - ay * half_) / length, (ay + ax * half_) / length, half_ / (1 + r)};
  return sector;
}

#define IN_ORDER(i, j)                       \
  if (px[i] * py[j] - py[i] * px[j] < 0) {   \
    const float swap_x = px[i], swap_y = py[i]; \
    px[i] = px[j], py[i] = py[j];            \
    px[j] = swap_x, py[j] = swap_y;          \
  }

/* quad: a flat quadrangle, which shines from both faces.

  corners  (6, 3)                 float  four corners round it, from their middle; the middle; the normal; heights third
  nodes    (n_slices, n_slices, 2) float  row n - 1: Gauss-Legendre nodes, -1..1, and weights of n slices

Between the azimuths of two neighbouring corners the chord's ends run along one edge each: every such sector gets its share
of the slices, at least one. All is taken from the middle, so that small far sources lose no digits. Work-item (x, y) owns
one node; order of summation: slices, then lanes. */
__kernel void quad(__global const float *heights, __global const float *tops, __global const float *corners,
                   __global const float *nodes, __global const float *sky, __global const float *points,
                   __global float *irradiance, int rows, int cols, int width, int levels, int n_slices, int side,
                   int n_points, int dark, float brightness)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x >= cols || y >= rows)
    return;
  const int stride = cols + 1, here = (y + 1) * stride + x + 1;
  const float height = heights[here];
  Pixel pixel = {heights, tops, sky, points, rows, cols, width, levels, side, n_points, dark, x, y, here, height};
  pixel.tilt_x = slope_between(heights, here, here - 1, here + 1);
  pixel.tilt_y = slope_between(heights, here, here - stride, here + stride);

  /* 1. the corners, in the frame of the azimuth of their middle */
  const float mx = corners[12] - x, my = corners[13] - y, mz = corners[14] - height;
  const float flat = sqrt(mx * mx + my * my), ux = flat > 0 ? mx / flat : 1, uy = flat > 0 ? my / flat : 0;
  float px[4], py[4], qx[4], qy[4], top = 0;
  for (int i = 0; i < 4; ++i) {
    qx[i] = corners[3 * i] * ux + corners[3 * i + 1] * uy;
    qy[i] = corners[3 * i + 1] * ux - corners[3 * i] * uy;
    px[i] = flat + qx[i];
    py[i] = qy[i];
    if (px[i] == 0 && py[i] == 0)
      px[i] = 1e-6f;
    top = max(top, mz + corners[3 * i + 2]);
  }
  const float q0x = px[0], q0y = py[0], q1x = px[1], q1y = py[1], q2x = px[2], q2y = py[2], q3x = px[3], q3y = py[3];
  float t0 = q0x * (q1y - q0y) - q0y * (q1x - q0x), t1 = q1x * (q2y - q1y) - q1y * (q2x - q1x);
  float t2 = q2x * (q3y - q2y) - q2y * (q3x - q2x), t3 = q3x * (q0y - q3y) - q3y * (q0x - q3x);
  const int left = t0 >= 0 && t1 >= 0 && t2 >= 0 && t3 >= 0, right = t0 <= 0 && t1 <= 0 && t2 <= 0 && t3 <= 0;
  const int below = left != right; /* the node stands below or above the quadrangle */
  const float sense = right ? -1 : 1;
  float normal_x = corners[15] * ux + corners[16] * uy, normal_y = corners[16] * ux - corners[15] * uy, normal_z = corners[17];
  const float apart = flat * normal_x + mz * normal_z, facing = apart < 0 ? -1 : 1;
  pixel.reach = fabs(apart);
  pixel.up = facing * normal_z;
  normal_x *= facing;
  normal_y *= facing;

  /* 2. sectors between neighbouring corners, and their slices */
  Sector s0, s1, s2, s3;
  if (below) {
    s0 = right ? sector_between(q1x, q1y, q0x, q0y) : sector_between(q0x, q0y, q1x, q1y);
    s1 = right ? sector_between(q2x, q2y, q1x, q1y) : sector_between(q1x, q1y, q2x, q2y);
    s2 = right ? sector_between(q3x, q3y, q2x, q2y) : sector_between(q2x, q2y, q3x, q3y);
    s3 = right ? sector_between(q0x, q0y, q3x, q3y) : sector_between(q3x, q3y, q0x, q0y);
  } else {
    IN_ORDER(0, 1)
    IN_ORDER(2, 3)
    IN_ORDER(0, 2)
    IN_ORDER(1, 3)
    IN_ORDER(1, 2)
    s0 = sector_between(px[0], py[0], px[1], py[1]);
    s1 = sector_between(px[1], py[1], px[2], py[2]);
    s2 = sector_between(px[2], py[2], px[3], py[3]);
    s3 = s2;
    s3.quarter = 0;
  }
  const float all = s0.quarter + s1.quarter + s2.quarter + s3.quarter, least = 1e-4f * all;
  const int used0 = s0.quarter > least, used1 = used0 + (s1.quarter > least), used2 = used1 + (s2.quarter > least), used = used2 + (s3.quarter > least);
  const float more = all > 0 ? (n_slices - used) / all : 0;
  const int end0 = used0 + (int)(s0.quarter * more + 0.5f), end1 = used1 + (int)((s0.quarter + s1.quarter) * more + 0.5f);
  const int end2 = used2 + (int)((s0.quarter + s1.quarter + s2.quarter) * more + 0.5f);

  /* 3. slices */
  floats sum = 0;
  if (height > NONE && all > 0 && top > 0)
    for (int j = 0; j < n_slices; j += LANES) {
      const ints number = j + LANE;
      const ints in0 = WHERE(number < end0), in1 = WHERE(number < end1), in2 = WHERE(number < end2);
      const floats axis_c = in0 ? (floats)s0.c : in1 ? (floats)s1.c : in2 ? (floats)s2.c : (floats)s3.c;
      const floats axis_s = in0 ? (floats)s0.s : in1 ? (floats)s1.s : in2 ? (floats)s2.s : (floats)s3.s;
      const floats quarter = in0 ? (floats)s0.quarter : in1 ? (floats)s1.quarter : in2 ? (floats)s2.quarter : (floats)s3.quarter;
      const ints first = in0 ? (ints)0 : in1 ? (ints)end0 : in2 ? (ints)end1 : (ints)end2;
      const ints count = (in0 ? (ints)end0 : in1 ? (ints)end1 : in2 ? (ints)end2 : (ints)n_slices) - first;
      const ints at = 2 * ((count - 1) * n_slices + number - first);
      const floats turn = quarter * FEW(nodes, at), scale = 1 / (1 + turn * turn);
      const floats cos_t = (1 - turn * turn) * scale, sin_t = 2 * turn * scale;
      const floats cd = axis_c * cos_t - axis_s * sin_t, sd = axis_s * cos_t + axis_c * sin_t;
      const floats share = 2 * quarter * FEW(nodes, at + 1) * scale;
      /* where the slice cuts the outline: distance and height from the middle, on an edge that runs to the left, and to the right */
      floats left_r = 0, left_z = 0, right_r = 0, right_z = 0;
      ints has_left = 0, has_right = 0;
      floats side_a = cd * q3y - sd * q3x, r_a = cd * qx[3] + sd * qy[3], z_a = corners[11];
      for (int i = 0; i < 4; ++i) {
        const floats side_b = cd * (i == 0 ? q0y : i == 1 ? q1y : i == 2 ? q2y : q3y) - sd * (i == 0 ? q0x : i == 1 ? q1x : i == 2 ? q2x : q3x);
        const floats r_b = cd * qx[i] + sd * qy[i], z_b = corners[3 * i + 2];
        const floats turned_a = sense * side_a, turned_b = sense * side_b;
        const ints to_left = WHERE(turned_a <= 0) & WHERE(turned_b > 0), to_right = WHERE(turned_b <= 0) & WHERE(turned_a > 0);
        const floats f = side_a / (side_a - side_b), r = r_a + f * (r_b - r_a), z = z_a + f * (z_b - z_a);
        left_r = to_left ? r : left_r;
        left_z = to_left ? z : left_z;
        right_r = to_right ? r : right_r;
        right_z = to_right ? z : right_z;
        has_left |= to_left;
        has_right |= to_right;
        side_a = side_b, r_a = r_b, z_a = z_b;
      }
      const floats middle = flat * cd;
      const floats to_left = MORE(middle + left_r, (floats)1e-20f), to_right = MORE(middle + right_r, (floats)1e-20f);
      const floats steep_left = (mz + left_z) / to_left, steep_right = (mz + right_z) / to_right;
      const floats apart_s = mz * (right_r - left_r) + middle * (left_z - right_z) + left_z * right_r - right_z * left_r;
      floats low, high, chord_width;
      if (below) {
        low = pixel.up > 0 ? steep_left : (floats)-STEEP;
        high = pixel.up > 0 ? (floats)STEEP : steep_left;
        low = LESS(low, (floats)STEEP);
        chord_width = high - low;
      } else {
        low = apart_s > 0 ? steep_right : steep_left;
        high = apart_s > 0 ? steep_left : steep_right;
        chord_width = (apart_s > 0 ? apart_s : -apart_s) / (to_left * to_right);
        has_left &= has_right;
      }
      high = has_left ? LESS(high, (floats)STEEP) : (floats)-STEEP;
      const floats c = ux * cd - uy * sd, s = uy * cd + ux * sd;
      sum += share * slice(&pixel, c, s, normal_x * cd + normal_y * sd, low, high, chord_width);
    }
  irradiance[y * cols + x] = brightness * TOTAL(sum) / sqrt(1 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y);
}
