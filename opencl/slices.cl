/* Light of a finite source, a ball or a flat quadrangle, through a few azimuth slices per pixel.

In the slice at azimuth phi the source covers a chord of elevations; what ground, tangent plane and level
leave of it gives E = sum over slices of share x (n_c integral of B cos^2 + n_z integral of B sin cos), n_c
the normal's part along phi. Elevations go by their tangents. Lengths are in units of the spacing; heights
grow towards the viewer.

Shared arguments
  heights     (rows + 2, cols + 1)  float  -depth, and one element more; NONE where masked, in column 0, in
                                           the first and the last row: node (x, y) stands at
                                           (y + 1) (cols + 1) + x + 1, and every neighbour of a node can be
                                           read
  tops        (cells, width)  float  highest node of square cells, corners included: level l = 1, 2.. has
                                     cells 2^l wide, from column width - (width >> l - 1) on; width is a
                                     multiple of 2^levels
  sky         (side, side)    float  of light in a lobe: brightness over the stereographic plane, x / (1 - z)
                                     and y / (1 - z) from -1 to 1
  points      (n_points, 2)   float  where along a chord that brightness is taken, 0..1, and weights; none: it
                                     is 1
  lobe        (n_lobe)        float  weight of light by 1 - cosine of its angle to the mirror direction, even
                                     steps from 0 to rim, beyond which there is none; n_lobe 0: all light
                                     counts alike
  chords      (n_turns, n_knots, 2)  float  of light in no lobe: integrals of B cos^2 and B sin cos over
                                            elevation, from the sine k / (n_knots - 1) to the zenith, means
                                            over n_turns even cells of the diamond angle q = s / (|c| + |s|),
                                            2 - q, 4 + q of the azimuth's cosine c and sine s, 0..4; n_knots
                                            0: B is 1
  irradiance  (rows, cols)    float  out; factor: of it
  least, most                       int    slices of a source that is a point, and of one that stands all
                                           round: multiples of SLICES, as what is between
  highest                           float  of the heights
  dark                              int    whether walls stand half a node outside the map, up to height 0

Work-item (x, y) owns one node and takes LANES of its slices at a time. Order of summation: slices of a lane,
then lanes. Twin of warp_kernels/slices.py. */
#include "lanes.h"
#define LESS(a, b) ((a) < (b) ? (a) : (b)) /* min and max of vectors are calls on PoCL, as vload is */
#define MORE(a, b) ((a) > (b) ? (a) : (b))
#if LANES == 1
#define ALL(v) (v)
#define LANE 0
#define TO_FLOATS convert_float
#define AT(pointer, offset) (pointer)[offset]
#define GATHER(pointer, offsets) (pointer)[offsets]
#define ANY(test) (test)
#define TOTAL(v) (v)
#else
#define ALL(v) ((floats)(v))
#define LANE (ints)(0, 1, 2, 3, 4, 5, 6, 7)
#define TO_FLOATS convert_float8
typedef struct __attribute__((packed)) {
  floats v;
} Packed;
#define AT(pointer, offset) ((__global const Packed *)((pointer) + (offset)))->v
#define GATHER(p, o)                                                                                         \
  (floats)((p)[(o).s0], (p)[(o).s1], (p)[(o).s2], (p)[(o).s3], (p)[(o).s4], (p)[(o).s5], (p)[(o).s6],        \
           (p)[(o).s7])
int ANY(ints test)
{
  const int4 four = test.lo | test.hi;
  const int2 two = four.lo | four.hi;
  return two.x | two.y;
}
float TOTAL(floats v)
{
  const float4 four = v.lo + v.hi;
  const float2 two = four.lo + four.hi;
  return two.x + two.y;
}
#endif

/* coarser: one level of tops, from the heights (level 1) or from the level before. Work-item (x, y) owns a
   cell. */
__kernel void coarser(__global const float *heights, __global float *tops, int rows, int cols, int width,
                      int level)
{
  const int x = get_global_id(0), y = get_global_id(1), stride = cols + 1;
  if (x >= width >> level || y > (rows - 1) >> level)
    return;
  float top = NONE;
  if (level == 1) {
    for (int j = 2 * y; j <= min(2 * y + 2, rows - 1); ++j)
      for (int i = 2 * x; i <= min(2 * x + 2, cols - 1); ++i)
        top = max(top, heights[(j + 1) * stride + i + 1]);
  } else {
    __global const float *finer = tops + width - (width >> (level - 2));
    for (int j = 2 * y; j <= min(2 * y + 1, (rows - 1) >> (level - 1)); ++j)
      for (int i = 2 * x; i <= 2 * x + 1; ++i)
        top = max(top, finer[j * width + i]);
  }
  tops[y * width + width - (width >> (level - 1)) + x] = top;
}

/* Values that all slices of a pixel share. A point (c t, s t, v) from the pixel stands before the source iff
along t + up v < reach, `along` the slice's own. */
typedef struct {
  __global const float *heights, *tops, *sky, *points, *lobe, *chords;
  int rows, cols, width, levels, side, n_points, n_lobe, n_turns, n_knots, dark, x, y;
  float height, tilt_x, tilt_y, rim, mirror_x, mirror_y, mirror_z;
  float above; /* how far the highest ground stands above the node, and no less for rounding */
  float up, reach, radius; /* radius: of a ball, 0 for a quadrangle, below 0 for the sky */
} Pixel;

float slope_between(float low, float here, float high)
{
  if (low > NONE && high > NONE)
    return (low - high) * 0.5f;
  return low > NONE ? low - here : high > NONE ? here - high : 0.0f;
}

Pixel pixel_at(__global const float *heights, __global const float *tops, __global const float *sky,
               __global const float *points, __global const float *lobe, __global const float *chords,
               int rows, int cols, int width, int levels, int side, int n_points, int n_lobe, int n_turns,
               int n_knots, int dark, float rim, float highest, int x, int y)
{
  const int stride = cols + 1;
  __global const float *here = heights + (y + 1) * stride + x + 1;
  const float tilt_x = slope_between(here[-1], here[0], here[1]),
              tilt_y = slope_between(here[-stride], here[0], here[stride]);
  const float twice = 2 / (1 + tilt_x * tilt_x + tilt_y * tilt_y);
  const Pixel pixel = {heights,  tops,   sky,     points,   lobe,   chords,  rows,           cols,
                       width,    levels, side,    n_points, n_lobe, n_turns, n_knots,        dark,
                       x,        y,      here[0], tilt_x,   tilt_y, rim,     twice * tilt_x, twice * tilt_y,
                       twice - 1, highest - here[0] + 1e-6f * (fabs(highest) + fabs(here[0]))};
  return pixel;
}

/* The tangent at which a column at distance t goes into the source: what stands in it there hides no more
   than what is below. */
floats under_source(const Pixel *pixel, floats along, floats aside, floats t)
{
  if (pixel->radius > 0) {
    const floats offset = t - along,
                 square = pixel->radius * pixel->radius - aside * aside - offset * offset;
    return square > 0 ? (pixel->up - sqrt(MORE(square, 0))) / t : ENDLESS;
  }
  return pixel->up > 0 ? (pixel->reach / t - along) / pixel->up : ALL(ENDLESS);
}

/* The tangent of the horizon along (c, s), from `slope` on, over the ground before the source and as far as
`high` matters. The slice begins at a distance of t from (x, y), which lies on the map then.

The slice goes from cell to cell of a quadtree, and no farther than where it is above all ground. A large cell
whose top stays below the line is left as a whole, else its quarters are looked at; the way out of a single
cell is a crossing with a grid line. u and v count cells the way that the slice goes: x or -1 - x, so that a
cell's far side is always the greater one. */
floats horizon(const Pixel *pixel, ints x, ints y, floats t, floats c, floats s, floats slope, floats high,
               floats along, floats aside)
{
  const int stride = pixel->cols + 1;
  const ints flip_x = WHERE(c < 0), flip_y = WHERE(s < 0);
  const ints from_x = (x ^ flip_x) - flip_x, from_y = (y ^ flip_y) - flip_y;
  const floats abs_c = c < 0 ? -c : c, abs_s = s < 0 ? -s : s;
  const floats per_x = c != 0 ? 1 / abs_c : ENDLESS, per_y = s != 0 ? 1 / abs_s : ENDLESS;
  const floats end_x = c == 0 ? ALL(ENDLESS) : TO_FLOATS(c > 0 ? pixel->cols - 1 - x : x) * per_x;
  const floats end_y = s == 0 ? ALL(ENDLESS) : TO_FLOATS(s > 0 ? pixel->rows - 1 - y : y) * per_y;
  const floats at_edge = LESS(end_x, end_y), at_top = pixel->above / slope;
  const floats end = slope > 0 && at_top < at_edge ? at_top : at_edge;
  ints u = from_x + TO_INTS(abs_c * t), v = from_y + TO_INTS(abs_s * t), level = 0;
  floats toward = along + slope * pixel->up;
  ints going = WHERE(slope < high) & WHERE(t < end) & WHERE(t * toward < pixel->reach);
  while (ANY(going)) {
    /* 1. down to a cell whose top stays below the line where it comes in, or to a single one */
    ints large = going & WHERE(level > 0);
    while (ANY(large)) {
      const ints first = pixel->width - ((ints)pixel->width >> (level - 1)),
                 at = ((v >> level) ^ flip_y) * pixel->width + first + ((u >> level) ^ flip_x);
      large &= WHERE(GATHER(pixel->tops, large ? at : 0) - pixel->height > slope * t);
      level += large;
      large &= WHERE(level > 0);
      if (LANES > 1)
        break; /* lanes that go down again wait, since each gather takes as long as the rest */
    }
    const ints passes = going & ~large;
    /* 2. the way out of it */
    const ints mask = ((ints)1 << level) - 1, edge_u = (u | mask) + 1, edge_v = (v | mask) + 1;
    const floats out_x = TO_FLOATS(edge_u - from_x) * per_x, out_y = TO_FLOATS(edge_v - from_y) * per_y;
    const ints by_x = WHERE(out_x <= out_y), single = passes & WHERE(level == 0);
    const floats out = by_x ? out_x : out_y, across = (by_x ? s : c) * out;
    /* 3. the ground there */
    if (ANY(single)) {
      const ints node_x = by_x ? (edge_u ^ flip_x) - flip_x : u ^ flip_x,
                 node_y = by_x ? v ^ flip_y : (edge_v ^ flip_y) - flip_y;
      const ints at = (node_y + 1) * stride + node_x + 1;
      const ints low = single ? at : 0, next = low + (by_x ? stride : 1);
      const floats f = across - TO_FLOATS(by_x ? node_y - y : node_x - x), part = f < 0 ? 0 : f > 1 ? 1 : f;
      const floats rise =
          GATHER(pixel->heights, low) * (1 - part) + GATHER(pixel->heights, next) * part - pixel->height;
      const ints higher = single & WHERE(rise > slope * out) & WHERE(out * toward < pixel->reach);
      if (ANY(higher)) {
        const floats tangent = LESS(rise / out, under_source(pixel, along, aside, out));
        slope = higher && tangent > slope ? tangent : slope;
        toward = along + slope * pixel->up;
      }
    }
    /* 4. on, and up where a larger cell begins */
    const ints last = (by_x ? v : u) | mask, first = last - mask;
    ints to = TO_INTS((by_x ? abs_s : abs_c) * out) + (by_x ? from_y : from_x);
    to = to < first ? first : to > last ? last : to;
    u = passes ? (by_x ? edge_u : to) : u;
    v = passes ? (by_x ? to : edge_v) : v;
    t = passes ? out : t;
    level -= passes & WHERE(((by_x ? edge_u : edge_v) >> level & 1) == 0) & WHERE(level < pixel->levels);
    going &= WHERE(slope < high) & WHERE(t < end) & WHERE(t * toward < pixel->reach);
  }
  return slope;
}

/* The copy of a node on a map that repeats from which a slice has most of the map ahead, some steps on. */
ints copy_of(int node, ints steps, floats way, int size, int period)
{
  const ints back = (node + steps) / period, on = (size - 1 - node + steps) / period;
  return node + period * (way < 0 ? on : -back);
}

/* As `horizon`, over a map that repeats: a slice that leaves it goes on from the same place of a copy. The
map is larger than a period by more than 1e-6 of the way, so that every lap leads on. */
floats repeated_horizon(const Pixel *pixel, int period_y, int period_x, floats c, floats s, floats slope,
                        floats high, floats along)
{
  const floats abs_c = c < 0 ? -c : c, abs_s = s < 0 ? -s : s;
  floats t = 0;
  ints going = WHERE(slope < high);
  while (ANY(going)) {
    const ints x = copy_of(pixel->x, TO_INTS(abs_c * t), c, pixel->cols, period_x),
               y = copy_of(pixel->y, TO_INTS(abs_s * t), s, pixel->rows, period_y);
    slope = horizon(pixel, x, y, t, c, s, slope, going ? high : slope, along, 0);
    const floats end_x = TO_FLOATS(c < 0 ? x : pixel->cols - 1 - x) / MORE(abs_c, 1e-30f),
                 end_y = TO_FLOATS(s < 0 ? y : pixel->rows - 1 - y) / MORE(abs_s, 1e-30f);
    t = LESS(end_x, end_y) * (1 - 1e-6f); /* rounding passes over no crossing */
    going &= WHERE(slope < high) & WHERE(t * slope < pixel->above) & WHERE(t * along < pixel->reach);
  }
  return slope;
}

/* The lobe's weight of the direction whose elevation has this cosine and sine. */
floats in_lobe(const Pixel *pixel, floats c, floats s, floats cosine, floats sine)
{
  const floats x = cosine - (pixel->mirror_x * c + pixel->mirror_y * s),
               y = pixel->mirror_y * c - pixel->mirror_x * s, z = sine - pixel->mirror_z;
  const float most = pixel->n_lobe - 1;
  /* 1 - cos is half of |L - R|^2 */
  const floats all = (x * x + y * y + z * z) * (0.5f * most / pixel->rim), at = all < most ? all : most;
  ints i = TO_INTS(at);
  i = i > pixel->n_lobe - 2 ? pixel->n_lobe - 2 : i;
  const floats first = GATHER(pixel->lobe, i);
  return first + (at - TO_FLOATS(i)) * (GATHER(pixel->lobe, i + 1) - first);
}

/* Mean brightness of the chord between two tangents, weighted by the cosine to the normal and by the lobe. */
floats brightness_of(const Pixel *pixel, floats c, floats s, floats tilt, floats low, floats high)
{
  const float half_ = 0.5f * (pixel->side - 1);
  const int most = pixel->side - 2;
  const floats low_c = 1 / sqrt(low * low + 1), high_c = 1 / sqrt(high * high + 1);
  const floats low_s = low * low_c, high_s = high * high_c;
  floats sum = 0, all = 0;
  for (int k = 0; k < pixel->n_points; ++k) {
    const float f = pixel->points[2 * k], weight = pixel->points[2 * k + 1];
    const floats cosine = low_c + f * (high_c - low_c), sine = low_s + f * (high_s - low_s),
                 square = cosine * cosine + sine * sine;
    const floats from_zenith = half_ * cosine / (sqrt(square) + sine);
    const floats u = half_ + from_zenith * c, v = half_ + from_zenith * s;
    ints i = TO_INTS(u), j = TO_INTS(v);
    i = i < 0 ? 0 : i > most ? most : i;
    j = j < 0 ? 0 : j > most ? most : j;
    const ints at = j * pixel->side + i;
    const floats p = u - TO_FLOATS(i), q = v - TO_FLOATS(j);
    const floats near = GATHER(pixel->sky, at) * (1 - p) + GATHER(pixel->sky, at + 1) * p;
    const floats far =
        GATHER(pixel->sky, at + pixel->side) * (1 - p) + GATHER(pixel->sky, at + pixel->side + 1) * p;
    const floats facing = tilt * cosine + sine, share = weight / (square * square) * cosine * MORE(facing, 0);
    const floats length = sqrt(square),
                 light = (near * (1 - q) + far * q) * in_lobe(pixel, c, s, cosine / length, sine / length);
    sum += share * light;
    all += share;
  }
  return sum / MORE(all, 1 / ENDLESS);
}

/* atan(x), 0 <= x <= 1, to 2e-7. */
floats arctan(floats x)
{
  const floats y = x * x;
  floats sum = CHORD_TANGENT_0;
  sum = sum * y + CHORD_TANGENT_1;
  sum = sum * y + CHORD_TANGENT_2;
  sum = sum * y + CHORD_TANGENT_3;
  sum = sum * y + CHORD_TANGENT_4;
  sum = sum * y + CHORD_TANGENT_5;
  sum = sum * y + CHORD_TANGENT_6;
  return x * (sum * y + CHORD_TANGENT_7);
}

/* Mean of the cosine over the sines between two near directions with cosines a and b, to second order even at
   the zenith. */
floats mean_cosine(floats a, floats b)
{
  const floats twice = 1.5f * (a + b);
  return (a * a + a * b + b * b) / MORE(twice, 1 / ENDLESS);
}

/* An integral of the table, 0 or 1, from a knot to the zenith, between two turns. */
floats blended(const Pixel *pixel, ints before, ints after, floats part, ints knot, int which)
{
  const ints i = 2 * (before * pixel->n_knots + knot) + which,
             j = 2 * (after * pixel->n_knots + knot) + which;
  return GATHER(pixel->chords, i) * (1 - part) + GATHER(pixel->chords, j) * part;
}

/* As chord(), from the table; by_cosine, by_sine: what the chord is worth where brightness is 1.

Brightness is even between two knots. Sines and cosines are in steps of the knots' sines, so are `even`
integrals. */
floats of_chords(const Pixel *pixel, floats c, floats s, floats tilt, floats low, floats high,
                 floats by_cosine, floats by_sine)
{
  /* 1. the cells of azimuth beside */
  const floats ratio = s / ((c < 0 ? -c : c) + (s < 0 ? -s : s)), diamond = c < 0   ? 2 - ratio
                                                                            : s < 0 ? 4 + ratio
                                                                                    : ratio;
  const floats place = diamond * (0.25f * pixel->n_turns) + 0.5f;
  ints after = TO_INTS(place);
  after = after > pixel->n_turns ? pixel->n_turns : after;
  const floats turn = place - TO_FLOATS(after);
  const ints before = after > 0 ? after - 1 : pixel->n_turns - 1;
  after = after < 0 || after >= pixel->n_turns ? 0 : after;
  /* 2. the knots below the ends */
  const int steps = pixel->n_knots - 1;
  const float size = steps;
  const floats low_c = size / sqrt(low * low + 1), high_c = size / sqrt(high * high + 1), low_s = low * low_c,
               high_s = high * high_c;
  ints i = TO_INTS(low_s), j = TO_INTS(high_s);
  i = i < 0 ? 0 : i > steps - 1 ? steps - 1 : i;
  j = j < 0 ? 0 : j > steps - 1 ? steps - 1 : j;
  const floats at_i = sqrt(TO_FLOATS((steps - i) * (steps + i))),
               at_j = sqrt(TO_FLOATS((steps - j) * (steps + j)));
  const floats rest_i = low_s - TO_FLOATS(i), rest_j = high_s - TO_FLOATS(j);
  const ints near = WHERE(j <= i + 1);
  floats light[2];
  for (int k = 0; k < 2; ++k) {
    const floats low_0 = blended(pixel, before, after, turn, i, k),
                 low_1 = blended(pixel, before, after, turn, i + 1, k);
    const floats high_0 = blended(pixel, before, after, turn, j, k),
                 high_1 = blended(pixel, before, after, turn, j + 1, k);
    /* 3. the even integrals: of both cells, and what of them lies below the ends */
    floats low_all, high_all, low_part, high_part;
    if (k) {
      low_all = TO_FLOATS(i) + 0.5f;
      high_all = TO_FLOATS(j) + 0.5f;
      low_part = rest_i * 0.5f * (low_s + TO_FLOATS(i));
      high_part = rest_j * 0.5f * (high_s + TO_FLOATS(j));
    } else {
      low_all = mean_cosine(at_i, sqrt(TO_FLOATS((steps - i - 1) * (steps + i + 1))));
      high_all = mean_cosine(at_j, sqrt(TO_FLOATS((steps - j - 1) * (steps + j + 1))));
      low_part = rest_i * mean_cosine(at_i, low_c);
      high_part = rest_j * mean_cosine(at_j, high_c);
    }
    /* 4. brightness there; in one cell or two neighbours the closed forms leave short chords all digits */
    const floats here = (low_0 - low_1) / low_all, there = (high_0 - high_1) / high_all;
    const floats few = here * (size * size) * (k ? by_sine : by_cosine) + (there - here) * high_part;
    const floats many = (low_1 - high_0) + here * (low_all - low_part) + there * high_part;
    light[k] = near ? few : many;
  }
  return tilt * light[0] + light[1];
}

/* Integral of B (tilt cos^2 + sin cos) of elevation between the tangents low and high, which are `rise`
   apart. */
floats chord(const Pixel *pixel, floats c, floats s, floats low, floats high, floats rise)
{
  const ints shows = WHERE(low < high);
  if (!ANY(shows))
    return 0;
  high = MORE(low, high);
  const floats tilt = pixel->tilt_x * c + pixel->tilt_y * s, product = low * high;
  const floats r = sqrt((low * low + 1) * (high * high + 1)), sine = rise / r;
  const floats by_cosine = arctan(rise / (r + 1 + product)) + 0.5f * ((1 - product) / r * sine),
               by_sine = 0.5f * ((low + high) / r * sine);
  if (pixel->n_knots) {
    const floats all = of_chords(pixel, c, s, tilt, low, high, by_cosine, by_sine);
    return shows ? all : 0;
  }
  const floats light = pixel->n_points ? brightness_of(pixel, c, s, tilt, low, high) : 1;
  return shows ? light * (tilt * by_cosine + by_sine) : 0;
}

/* The part of the chord between two tangents that a slice along (c, s) leaves within the lobe's rim; gives
   how far they are apart. */
floats to_rim(const Pixel *pixel, floats c, floats s, floats *low, floats *high, floats rise)
{
  const float least = 1 - pixel->rim, up = pixel->mirror_z;
  const floats in_plane = pixel->mirror_x * c + pixel->mirror_y * s,
               square = in_plane * in_plane + up * up - least * least;
  /* of the chord: least is to it as cosine to sine */
  const floats half_ = sqrt(MORE(square, 0)), before = *low, after = *high;
  const floats low_c = in_plane * least + up * half_, low_s = up * least - in_plane * half_;
  const floats high_c = in_plane * least - up * half_, high_s = up * least + in_plane * half_;
  const floats from = low_c > 0 ? low_s / low_c
                      : up > 0  ? ALL(STEEP)
                                : ALL(-STEEP),
               to = high_c > 0 ? high_s / high_c
                    : up > 0   ? ALL(STEEP)
                               : ALL(-STEEP);
  *low = MORE(before, from);
  *high = square > 0 ? LESS(after, to) : -STEEP;
  return from > before || to < after ? *high - *low : rise;
}

/* The light through a slice along (c, s) of a source between the tangents low and high, `rise` apart; aside:
how far its middle stands from the slice. */
floats slice(const Pixel *pixel, floats c, floats s, floats along, floats aside, floats low, floats high,
             floats rise)
{
  if (pixel->n_lobe)
    rise = to_rim(pixel, c, s, &low, &high, rise);
  /* 1. the tangent plane and the level */
  const floats plane = -(pixel->tilt_x * c + pixel->tilt_y * s);
  floats slope = MORE(low, plane);
  slope = slope < 0 ? 0 : slope > STEEP ? STEEP : slope;
  if (!pixel->dark) {
    slope = horizon(pixel, pixel->x, pixel->y, 0, c, s, slope, high, along, aside);
    return chord(pixel, c, s, slope, high, slope > low ? high - slope : rise);
  }
  /* 2. the wall hides what lies beyond it: tangents up to `under`, and from `over` on, but none from its top
     on */
  const floats wall_x =
      c == 0 ? ALL(ENDLESS) : (c > 0 ? ALL(pixel->cols - 0.5f - pixel->x) : ALL(-0.5f - pixel->x)) / c;
  const floats wall_y =
      s == 0 ? ALL(ENDLESS) : (s > 0 ? ALL(pixel->rows - 0.5f - pixel->y) : ALL(-0.5f - pixel->y)) / s;
  const floats wall = LESS(wall_x, wall_y), top = -pixel->height / wall;
  floats under, over;
  if (pixel->radius > 0) {
    const floats offset = wall - along,
                 square = pixel->radius * pixel->radius - aside * aside - offset * offset;
    const floats half_ = sqrt(MORE(square, 0)); /* of where the wall cuts the ball */
    under = square > 0 ? (pixel->up - half_) / wall : ENDLESS;
    over = square > 0 ? (pixel->up + half_) / wall : ENDLESS;
    under = ALL(pixel->reach) > 0 && wall * (along + slope * pixel->up) < pixel->reach ? under : -ENDLESS;
    over = ALL(pixel->reach) > 0 && wall * (along + high * pixel->up) < pixel->reach ? over : ENDLESS;
  } else {
    const float up = pixel->up == 0 ? 1 / ENDLESS : pixel->up;
    const floats meets = (pixel->reach / wall - along) / up;
    under = pixel->radius < 0 ? ENDLESS : up > 0 ? meets : -ENDLESS;
    over = up > 0 ? ENDLESS : meets;
  }
  under = LESS(under, top);
  slope = MORE(slope, under);
  const ints split = WHERE(over < top);
  const floats left = split ? LESS(high, over) : high;
  const floats most = (split & WHERE(high <= top)) ? left : high;
  slope = horizon(pixel, pixel->x, pixel->y, 0, c, s, slope, most, along, aside);
  floats sum = chord(pixel, c, s, slope, left, slope > low || left < high ? left - slope : rise);
  if (ANY(split)) {
    const floats above = MORE(slope, top);
    sum += split ? chord(pixel, c, s, above, high, high - above) : 0;
  }
  return sum;
}

/* ball: x0, y0, z0 its centre (z0 a height) and its radius.

  quadrature  (most / SLICES, 4, most)  float  for SLICES, 2 SLICES.. slices: sine and cosine of theta,
                                          midpoints of -pi/2..pi/2, and of the azimuths of midpoints all
                                          round; or other places in the same even steps
  alternating  (rows, cols)        float  out: the even slices' light less that of the odd ones, a
                                          measure of the error by too few slices

The slice at the azimuth offset d from the centre, sin d = (sin a / cos e) sin theta, a the ball's angular
radius and e its centre's elevation, holds a chord of half width w, sin w = sin a cos theta / r, r^2 = 1 -
cos^2 e sin^2 d. Where the zenith lies within the disc, slices go all round. */
__kernel void ball(__global const float *heights, __global const float *tops,
                   __global const float *quadrature, __global const float *sky, __global const float *points,
                   __global const float *lobe, __global const float *chords, __global float *irradiance,
                   __global float *alternating,
                   int rows, int cols, int width, int levels, int least, int most, int side, int n_points,
                   int n_lobe, int n_turns, int n_knots, int dark, float rim, float highest,
                   float x0, float y0, float z0, float radius, float factor)
{
  if (get_global_id(0) >= cols || get_global_id(1) >= rows)
    return;
  Pixel pixel = pixel_at(heights, tops, sky, points, lobe, chords, rows, cols, width, levels, side, n_points,
                         n_lobe, n_turns, n_knots, dark, rim, highest, get_global_id(0),
                         get_global_id(1));

  /* 1. where the ball stands, and how many slices it is worth */
  const float dx = x0 - pixel.x, dy = y0 - pixel.y, dz = z0 - pixel.height;
  const float flat = sqrt(dx * dx + dy * dy), far = sqrt(flat * flat + dz * dz);
  const int inside = far <= radius;
  const float ux = flat > 0 ? dx / flat : 1, uy = flat > 0 ? dy / flat : 0;
  const float sin_e = far > 0 ? dz / far : 1, cos_e = far > 0 ? flat / far : 0;
  const float beyond = inside ? 0 : (far - radius) * (far + radius);
  const float sin_a = inside ? 1 : radius / far, cos_a = inside ? 0 : sqrt(beyond) / far;
  const int all_round = sin_a >= cos_e;
  const float widest = all_round ? 1 : sin_a / cos_e;
  /* share of the circle, nearly */
  const float turn = all_round ? 1 : widest * (TURN_BY_SINE_0 + TURN_BY_SINE_1 * widest * widest);
  const int blocks = min((least + (int)(turn * (most - least))) / SLICES, most / SLICES),
            n_slices = blocks * SLICES;
  const float step = M_PI_F / n_slices;
  __global const float *own = quadrature + (blocks - 1) * 4 * most;
  pixel.up = dz;
  pixel.reach = beyond;
  pixel.radius = radius;

  /* 2. its slices */
  floats sum = 0, other = 0;
  if (pixel.height > NONE && (inside || dz + radius > 0))
    for (int j = 0; j < n_slices; j += LANES) {
      floats sin_d, cos_d, half_, share;
      if (all_round) {
        sin_d = AT(own, 2 * most + j);
        cos_d = AT(own, 3 * most + j);
        const floats square = sin_a * sin_a - cos_e * cos_e * (sin_d * sin_d);
        half_ = sqrt(MORE(square, 0));
        share = 2 * step;
      } else {
        sin_d = widest * AT(own, j);
        cos_d = sqrt((1 - sin_d) * (1 + sin_d));
        half_ = sin_a * AT(own, most + j);
        /* no less but where there is no chord */
        share = widest * step * AT(own, most + j) / MORE(cos_d, 1e-6f);
      }
      const floats in_plane = cos_e * cos_d, square = in_plane * in_plane + sin_e * sin_e;
      const floats low_c = in_plane * cos_a + sin_e * half_, low_s = sin_e * cos_a - in_plane * half_;
      const floats high_c = in_plane * cos_a - sin_e * half_, high_s = sin_e * cos_a + in_plane * half_;
      floats low = low_c > 0 ? low_s / low_c : low_s > 0 ? STEEP : -STEEP;
      floats high = high_c > 0 ? high_s / high_c : sin_e > 0 ? STEEP : -STEEP;
      low = inside ? -STEEP : low;
      high = inside || high > STEEP ? STEEP : high;
      const floats rise =
          low_c > 0 && high < STEEP ? 2 * cos_a * half_ * square / (low_c * high_c) : high - low;
      const floats light = share * slice(&pixel, ux * cos_d - uy * sin_d, uy * cos_d + ux * sin_d,
                                         flat * cos_d, flat * sin_d, low, high, rise);
      sum += light;
      other += TO_FLOATS(1 - 2 * ((j + LANE) & 1)) * light;
    }
  const float slant = sqrt(1 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y);
  irradiance[pixel.y * cols + pixel.x] = factor * TOTAL(sum) / slant;
  alternating[pixel.y * cols + pixel.x] = factor * TOTAL(other) / slant;
}

/* Azimuths between two directions: the bisector, and the tangent of a quarter of the angle. */
typedef struct {
  float c, s, quarter;
} Sector;

Sector sector_between(float ax, float ay, float bx, float by)
{
  const float length_a = sqrt(ax * ax + ay * ay), product = length_a * sqrt(bx * bx + by * by);
  const float cosine = ax * bx + ay * by, sine = ax * by - ay * bx; /* times product */
  const float half_ =
      cosine < 0 ? (product - cosine) / max(sine, 1e-7f * product) : max(sine, 0.0f) / (product + cosine);
  const float r = sqrt(1 + half_ * half_), scale = 1 / (r * length_a);
  const Sector sector = {(ax - ay * half_) * scale, (ay + ax * half_) * scale, half_ / (1 + r)};
  return sector;
}

/* The angle by its quarter's tangent: share of the circle, nearly, up to half of it. */
float share_of(float quarter)
{
  return quarter * (TURN_BY_TANGENT_0 - TURN_BY_TANGENT_1 * quarter * quarter);
}

/* Swaps directions i and j of four where the second does not lie to the left. */
void in_order(float *px, float *py, int i, int j)
{
  const float ax = px[i], ay = py[i], bx = px[j], by = py[j];
  const int swap = ax * by - ay * bx < 0;
  px[i] = swap ? bx : ax, py[i] = swap ? by : ay;
  px[j] = swap ? ax : bx, py[j] = swap ? ay : by;
}

#define OF_SECTOR(a, b, c, d) (in_a ? (a) : in_b ? (b) : in_c ? (c) : (d))

/* quad: a flat, convex quadrangle, which shines from both faces.

  corners  (6, 3)          float  four corners round it, from their middle; the middle; the unit normal.
                                  Third: heights
  quadrature  (most, most, 2)  float  row n - 1: Gauss-Legendre nodes, -1..1, and weights of n slices

Between the azimuths of neighbouring corners the chord's ends run along one edge each: every such sector gets
its share of the slices, at least one. All is computed from the quadrangle's middle, so that small far sources
lose no digits. */
__kernel void quad(__global const float *heights, __global const float *tops, __global const float *corners,
                   __global const float *quadrature, __global const float *sky, __global const float *points,
                   __global const float *lobe, __global const float *chords, __global float *irradiance,
                   int rows, int cols, int width, int levels, int least, int most, int side, int n_points,
                   int n_lobe, int n_turns, int n_knots, int dark, float rim, float highest,
                   float factor)
{
  if (get_global_id(0) >= cols || get_global_id(1) >= rows)
    return;
  Pixel pixel = pixel_at(heights, tops, sky, points, lobe, chords, rows, cols, width, levels, side, n_points,
                         n_lobe, n_turns, n_knots, dark, rim, highest, get_global_id(0),
                         get_global_id(1));

  /* 1. the corners, in the frame that points below the middle */
  const float dx = corners[12] - pixel.x, dy = corners[13] - pixel.y, dz = corners[14] - pixel.height;
  const float flat = sqrt(dx * dx + dy * dy), ux = flat > 0 ? dx / flat : 1, uy = flat > 0 ? dy / flat : 0;
  /* corners; `from` the middle; the same in order of azimuth */
  float ax[4], ay[4], from[4], up[4], turn[4], px[4], py[4];
  float top = -ENDLESS;
  for (int i = 0; i < 4; ++i) {
    from[i] = corners[3 * i] * ux + corners[3 * i + 1] * uy;
    ay[i] = corners[3 * i + 1] * ux - corners[3 * i] * uy;
    up[i] = corners[3 * i + 2];
    ax[i] = flat + from[i];
    if (ax[i] == 0 && ay[i] == 0)
      ax[i] = 1e-6f;
    px[i] = ax[i];
    py[i] = ay[i];
    top = max(top, dz + up[i]);
  }
  for (int i = 0; i < 4; ++i) {
    const int j = (i + 1) % 4;
    turn[i] = ax[i] * (ay[j] - ay[i]) - ay[i] * (ax[j] - ax[i]);
  }
  const int left = turn[0] >= 0 && turn[1] >= 0 && turn[2] >= 0 && turn[3] >= 0;
  const int right = turn[0] <= 0 && turn[1] <= 0 && turn[2] <= 0 && turn[3] <= 0;
  const int within = left != right; /* the zenith or the nadir lies in the quadrangle */
  const float normal_x = corners[15] * ux + corners[16] * uy, normal_y = corners[16] * ux - corners[15] * uy;
  const float apart = flat * normal_x + dz * corners[17], sense = apart < 0 ? -1 : 1;
  pixel.up = sense * corners[17];
  pixel.reach = sense * apart;
  pixel.radius = 0;

  /* 2. sectors, and how many slices they are worth */
  Sector a, b, c, d;
  if (right && within)
    for (int i = 0; i < 4; ++i) {
      px[i] = ax[3 - i];
      py[i] = ay[3 - i];
    }
  if (!within) {
    in_order(px, py, 0, 1);
    in_order(px, py, 2, 3);
    in_order(px, py, 0, 2);
    in_order(px, py, 1, 3);
    in_order(px, py, 1, 2);
  }
  a = sector_between(px[0], py[0], px[1], py[1]);
  b = sector_between(px[1], py[1], px[2], py[2]);
  c = sector_between(px[2], py[2], px[3], py[3]);
  d = sector_between(px[3], py[3], px[0], py[0]);
  d.quarter = within ? d.quarter : 0;
  const float to_a = share_of(a.quarter), to_b = to_a + share_of(b.quarter),
              to_c = to_b + share_of(c.quarter), all = to_c + share_of(d.quarter);
  const int blocks = min((least + (int)(all * (most - least))) / SLICES, most / SLICES),
            n_slices = blocks * SLICES;
  const float narrow = 1e-4f * all; /* a sector below that is left out */
  /* an eighth of the slices for every sector, the rest by width: narrow ones below a slit have most light */
  const int used_a = blocks * (to_a > narrow), used_b = used_a + blocks * (to_b - to_a > narrow),
            used_c = used_b + blocks * (to_c - to_b > narrow), used = used_c + blocks * (all - to_c > narrow);
  const float more = all > 0 ? (n_slices - used) / all : 0;
  const int end_a = used_a + (int)(to_a * more + 0.5f), end_b = used_b + (int)(to_b * more + 0.5f),
            end_c = used_c + (int)(to_c * more + 0.5f);

  /* 3. the slices */
  floats sum = 0;
  /* from its own plane it is a line */
  if (pixel.height > NONE && all > 0 && top >= 0 && (within || apart != 0))
    for (int k = 0; k < n_slices; k += LANES) {
      const ints number = k + LANE;
      const ints in_a = WHERE(number < end_a), in_b = WHERE(number < end_b), in_c = WHERE(number < end_c);
      const floats axis_c = OF_SECTOR(a.c, b.c, c.c, ALL(d.c)), axis_s = OF_SECTOR(a.s, b.s, c.s, ALL(d.s));
      const floats quarter = OF_SECTOR(a.quarter, b.quarter, c.quarter, ALL(d.quarter));
      const ints first = OF_SECTOR(0, end_a, end_b, (ints)end_c),
                 count = OF_SECTOR(end_a, end_b, end_c, (ints)n_slices) - first;
      const ints at = 2 * ((count - 1) * most + number - first);
      /* of half the angle from the bisector */
      const floats tangent = quarter * GATHER(quadrature, at), scale = 1 / (1 + tangent * tangent);
      const floats cos_t = (1 - tangent * tangent) * scale, sin_t = 2 * tangent * scale;
      const floats cos_d = axis_c * cos_t - axis_s * sin_t, sin_d = axis_s * cos_t + axis_c * sin_t;
      const floats share = 2 * quarter * GATHER(quadrature, at + 1) * scale;
      /* where the outline goes through the slice to the left, and to the right: distance and height from the
         middle */
      floats left_r = 0, left_z = 0, right_r = 0, right_z = 0;
      ints has_left = 0, has_right = 0;
      for (int i = 0; i < 4; ++i) {
        const int j = (i + 1) % 4;
        const floats side_i = cos_d * ay[i] - sin_d * ax[i], side_j = cos_d * ay[j] - sin_d * ax[j];
        const floats r_i = cos_d * from[i] + sin_d * ay[i], r_j = cos_d * from[j] + sin_d * ay[j];
        const floats f = side_i / (side_i - side_j), r = r_i + f * (r_j - r_i),
                     z = up[i] + f * (up[j] - up[i]);
        const ints to_left = WHERE(side_i <= 0) & WHERE(side_j > 0),
                   to_right = WHERE(side_j <= 0) & WHERE(side_i > 0);
        left_r = to_left ? r : left_r;
        left_z = to_left ? z : left_z;
        right_r = to_right ? r : right_r;
        right_z = to_right ? z : right_z;
        has_left |= to_left;
        has_right |= to_right;
      }
      const floats in_plane = flat * cos_d;
      const floats to_left = MORE(in_plane + left_r, 1e-10f), to_right = MORE(in_plane + right_r, 1e-10f);
      const floats steep_left = (dz + left_z) / to_left, steep_right = (dz + right_z) / to_right;
      floats low, high, rise;
      if (within) {
        const floats edge = left ? steep_left : steep_right;
        low = pixel.up > 0 ? LESS(edge, STEEP) : -STEEP;
        high = pixel.up > 0 ? STEEP : edge;
        high = (left ? has_left : has_right) ? high : -STEEP;
        rise = high - low;
      } else {
        const floats wide =
            dz * (right_r - left_r) + in_plane * (left_z - right_z) + left_z * right_r - right_z * left_r;
        low = wide > 0 ? steep_right : steep_left;
        high = wide > 0 ? steep_left : steep_right;
        rise = (wide > 0 ? wide : -wide) / (to_left * to_right);
        rise = high < STEEP ? rise : STEEP - low;
        high = has_left & has_right ? high : -STEEP;
      }
      high = LESS(high, STEEP);
      const floats along = normal_x * cos_d + normal_y * sin_d;
      sum += share * slice(&pixel, ux * cos_d - uy * sin_d, uy * cos_d + ux * sin_d, sense * along, 0, low,
                           high, rise);
    }
  irradiance[pixel.y * cols + pixel.x] =
      factor * TOTAL(sum) / sqrt(1 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y);
}

/* gloss: the light of the sky within the lobe; quadrature as for a ball.

  reach  float [spacing]  ground farther away does not count

Slices go through the disc within the rim about the mirror direction, or all round where the zenith lies
within it. */
__kernel void gloss(__global const float *heights, __global const float *tops,
                    __global const float *quadrature, __global const float *sky, __global const float *points,
                    __global const float *lobe, __global float *irradiance, int rows, int cols, int width,
                    int levels, int least, int most, int side, int n_points, int n_lobe, int dark, float rim,
                    float highest, float reach, float factor)
{
  if (get_global_id(0) >= cols || get_global_id(1) >= rows)
    return;
  Pixel pixel = pixel_at(heights, tops, sky, points, lobe, sky, rows, cols, width, levels, side, n_points,
                         n_lobe, 0, 0, dark, rim, highest, get_global_id(0), get_global_id(1));

  /* 1. where the disc stands, and how many slices it is worth */
  const float flat = sqrt(pixel.mirror_x * pixel.mirror_x + pixel.mirror_y * pixel.mirror_y);
  const float ux = flat > 0 ? pixel.mirror_x / flat : 1, uy = flat > 0 ? pixel.mirror_y / flat : 0;
  const float sin_a = sqrt(rim * (2 - rim));
  const int all_round = sin_a >= flat;
  const float widest = all_round ? 1 : sin_a / flat;
  const float turn = all_round ? 1 : widest * (TURN_BY_SINE_0 + TURN_BY_SINE_1 * widest * widest);
  const int blocks = min((least + (int)(turn * (most - least))) / SLICES, most / SLICES),
            n_slices = blocks * SLICES;
  const float step = M_PI_F / n_slices;
  __global const float *own = quadrature + (blocks - 1) * 4 * most;
  pixel.up = 0;
  pixel.reach = reach;
  pixel.radius = -1;

  /* 2. its slices */
  floats sum = 0;
  if (pixel.height > NONE)
    for (int j = 0; j < n_slices; j += LANES) {
      floats sin_d, cos_d, share;
      if (all_round) {
        sin_d = AT(own, 2 * most + j);
        cos_d = AT(own, 3 * most + j);
        share = 2 * step;
      } else {
        sin_d = widest * AT(own, j);
        cos_d = sqrt((1 - sin_d) * (1 + sin_d));
        share = widest * step * AT(own, most + j) / cos_d;
      }
      sum += share *
             slice(&pixel, ux * cos_d - uy * sin_d, uy * cos_d + ux * sin_d, 1, 0, -STEEP, STEEP, 2 * STEEP);
    }
  irradiance[pixel.y * cols + pixel.x] =
      factor * TOTAL(sum) / sqrt(1 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y);
}

/* rays: whether the ground leaves rays free.

  ways  (rows, cols, 4, count)  float  azimuth's cosine and sine, tangent of the elevation, and how far
                                       [spacing] ground counts
  seen  (rows, cols, count)     float  out: 1 where no ground stands higher than the ray, else 0; count: a
                                       multiple of LANES */
__kernel void rays(__global const float *heights, __global const float *tops, __global const float *ways,
                   __global float *seen, int rows, int cols, int width, int levels, int count, float highest)
{
  if (get_global_id(0) >= cols || get_global_id(1) >= rows)
    return;
  Pixel pixel = pixel_at(heights, tops, heights, heights, heights, heights, rows, cols, width, levels, 0, 0,
                         0, 0, 0, 0, 0, highest, get_global_id(0), get_global_id(1));
  const size_t here = ((size_t)pixel.y * cols + pixel.x) * count;
  pixel.up = 0;
  pixel.radius = -1;
  for (int j = 0; j < count; j += LANES) {
    const floats c = AT(ways, 4 * here + j), s = AT(ways, 4 * here + count + j),
                 tangent = AT(ways, 4 * here + 2 * count + j), reach = AT(ways, 4 * here + 3 * count + j);
    /* so that one obstacle is enough */
    const floats above = tangent + 1e-6f * (1 + (tangent < 0 ? -tangent : tangent));
    pixel.reach = 1; /* along the ray ground counts up to t / reach = 1 */
    const floats slope = horizon(&pixel, pixel.x, pixel.y, 0, c, s, tangent, above, 1 / reach, 0);
    STORE(slope > tangent ? 0 : ALL(1), here + j, seen);
  }
}

/* Between which distances a way from `at` is within low..high, `along` its part in their direction. */
void between(float at, float low, float high, floats along, floats *from, floats *to)
{
  const floats one = (low - at) / along, other = (high - at) / along;
  const floats nowhere = low <= at && at < high ? -ENDLESS : ENDLESS;
  *from = along > 0 ? one : along < 0 ? other : nowhere;
  *to = along > 0 ? other : along < 0 ? one : -nowhere;
}

/* The light of a sector above a tangent. */
floats light_above(__global const float *table, ints entry, int knots, floats first, floats scale,
                   floats tangent, floats tilt)
{
  const floats at = MORE((tangent / (tangent + 1) - first) * scale, 0);
  ints knot = TO_INTS(at);
  knot = knot > knots - 2 ? knots - 2 : knot;
  const floats rest = at - TO_FLOATS(knot), part = rest > 1 ? 1 : rest;
  const ints here = (entry + knot) * 4;
  const floats by_cosine = GATHER(table, here) + part * GATHER(table, here + 2),
               by_sine = GATHER(table, here + 1) + part * GATHER(table, here + 3);
  return tilt * by_cosine + by_sine;
}

/* sectors: the light of a sky in a few sectors of azimuth, each above the exact horizon along one azimuth,
added to what is there.

  ways        (6, count)         float  azimuth's cosine and sine, width [rad]; of its table: where it begins,
                                        `first`, and knots per unit, `scale`, of the diamond angle tangent /
                                        (1 + tangent) of elevation; 1 if its light is added to `other`, else
                                        0; count: a multiple of LANES
  table       (count, knots, 4)  float  integrals over elevation of B cos^2 and B sin cos, from first + i /
                                        scale on, and what to add up to the next knot; below the first knot
                                        and above the last there is no light
  irradiance, other  (image_rows, image_cols)  float  in, out; may be the same

rows, cols: of the image, or more: then its map repeats, and goes on in the others, without a wall or a
window. farthest [spacing]: beyond, ground is not looked for. x0 <= x < x1, y0 <= y < y1
[spacing]: window at height 0 through which the light comes; -ENDLESS..ENDLESS: there is none. */
__kernel void sectors(__global const float *heights, __global const float *tops, __global const float *ways,
                      __global const float *table, __global float *irradiance, __global float *other,
                      int rows, int cols, int width, int levels, int count, int knots, int dark,
                      int image_rows, int image_cols, float highest, float farthest, float x0, float x1,
                      float y0, float y1)
{
  const int x = get_global_id(0), y = get_global_id(1);
  if (x >= image_cols || y >= image_rows)
    return;
  Pixel pixel = pixel_at(heights, tops, heights, heights, heights, heights, rows, cols, width, levels, 0, 0,
                         0, 0, 0, dark, 0, highest, x, y);
  pixel.up = 0;
  pixel.reach = 1; /* ground counts up to t x along = 1 */
  pixel.radius = -1;
  const int framed = x0 > -ENDLESS || x1 < ENDLESS || y0 > -ENDLESS || y1 < ENDLESS;
  const int repeats = image_cols < cols;
  floats sum = 0, other_sum = 0;
  if (pixel.height > NONE && (!framed || pixel.height < 0))
    for (int j = 0; j < count; j += LANES) {
      const floats c = AT(ways, j), s = AT(ways, count + j), first = AT(ways, 3 * count + j),
                   scale = AT(ways, 4 * count + j);
      const floats last = first + (knots - 1) / scale, below = 1 - first, beyond = 1 - last;
      const floats low = first / MORE(below, 1e-6f), high = last / MORE(beyond, 1e-6f);
      /* farther on, a ray is above all ground */
      floats along = MORE(low, 1e-6f) / max(highest - pixel.height, 1e-6f);
      along = MORE(along, 1 / farthest);
      const floats tilt = pixel.tilt_x * c + pixel.tilt_y * s;
      /* 1. the tangent plane, the level, the wall, the window, and the ground */
      floats slope = MORE(-tilt, low), end = STEEP;
      if (dark) {
        const floats wall_x =
            c == 0 ? ALL(ENDLESS) : (c > 0 ? ALL(cols - 0.5f - pixel.x) : ALL(-0.5f - pixel.x)) / c;
        const floats wall_y =
            s == 0 ? ALL(ENDLESS) : (s > 0 ? ALL(rows - 0.5f - pixel.y) : ALL(-0.5f - pixel.y)) / s;
        const floats top = -pixel.height / LESS(wall_x, wall_y);
        slope = MORE(slope, top);
      }
      if (framed) {
        floats from_x, to_x, from_y, to_y;
        between(pixel.x, x0, x1, c, &from_x, &to_x);
        between(pixel.y, y0, y1, s, &from_y, &to_y);
        const floats from = MORE(from_x, from_y), near = from > 0 ? from : 0, far = LESS(to_x, to_y);
        const floats least = -pixel.height / far, most = -pixel.height / near;
        slope = near < far ? MORE(slope, least) : slope;
        end = near < far ? (near > 0 && most < STEEP ? most : STEEP) : -STEEP;
      }
      if (repeats)
        slope = repeated_horizon(&pixel, image_rows, image_cols, c, s, slope, high, along);
      else
        slope = horizon(&pixel, x, y, 0, c, s, slope, LESS(high, end), along, 0);
      /* 2. the light above it */
      const ints entry = (j + LANE) * knots;
      floats light = light_above(table, entry, knots, first, scale, slope, tilt);
      if (framed) {
        const floats past = light_above(table, entry, knots, first, scale, end, tilt);
        light = slope < end ? light - (end < STEEP ? past : 0) : 0;
      }
      light *= AT(ways, 2 * count + j);
      const floats to_other = AT(ways, 5 * count + j);
      sum += (1 - to_other) * light;
      other_sum += to_other * light;
    }
  const int at = y * image_cols + x;
  const float length = sqrt(1 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y);
  irradiance[at] += TOTAL(sum) / length;
  other[at] += TOTAL(other_sum) / length;
}
