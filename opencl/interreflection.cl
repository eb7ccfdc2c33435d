/* Light between surfaces, which ground sends to ground (docs/explanation, Light between surfaces).

In every azimuth strips of ground are visible from a node. A crossing of the azimuth's vertical plane with a
grid line opens one where it stands higher, seen from the node, than the tangent plane and all crossings
before it. Its share of the light is the integral of N.L over the strip's elevations; its radiance is the mean
of that at the crossing and of that where the line of sight so far meets the stretch before the crossing. The
sum of shares x radiance over the sum of the shares of all that is not sky is the mean radiance of the ground,
m; a node gets E = E_d + pi (1 - f) m, f the share of sky visible from it. Shares come without the factor that
a node's own normal gives all of them.

Maps lie in planes: column c is element margin + (c >> shift) of plane c mod 2^shift, so that nodes 2^shift
columns apart are neighbours; each plane has a row more before and after the map, and `margin` elements at
both ends of a row: the map repeated where it is periodic, else nothing.

  heights    (2^shift, rows + 2, pitch)          float  [spacing]  pitch = across + 2 margin, across =
                                                                  ceil(cols / 2^shift); -1e30 where there is
                                                                  no ground
  light      (LIGHTS, 2^shift, rows + 2, pitch)  float  radiance of the ground; 0 where there is none
  ways       (azimuths, 4)         float  cosine and sine of the azimuth, 1 where crossings lie on columns and
                                          0 where they lie on rows, 0
  places     (azimuths, count, 2)  int    columns and rows to the node at or before each crossing, in order of
                                          distance; never back
  crossings  (azimuths, count, 3)  float  weight of the next node of each, distance [spacing], 1 / distance
  sums       (LIGHTS + 1, ceil(rows / stride), phases, width)  float  of shares x radiance for every light,
                                          and of shares; phases = max(1, 2^shift / stride), width >= across;
                                          -1 instead of the sum of shares where a node is no receiver

sides: OPEN, DARK or PERIODIC. A sum is in order of azimuths and crossings. Twin of
warp_kernels/interreflection.py. */
#include "lanes.h"
#include "strips.h"
#ifndef LIGHTS /* of spread, which takes any number */
#define LIGHTS 1
#endif

#if LANES == 1
#define LANE(type, v, l) (v)
#define COUNT 0
#define ANY(test) (test)
#else
#define LANE(type, v, l) ((type *)&v)[l]
#define COUNT (floats)(0, 1, 2, 3, 4, 5, 6, 7)
#define ANY(test) any_lane(test)
int any_lane(ints test)
{
  const int4 four = test.lo | test.hi;
  const int2 two = four.lo | four.hi;
  return two.x | two.y;
}
#endif
/* PoCL calls its own max and min */
#define MOST(a, b) ((a) > (b) ? (a) : (b))
#define LEAST(a, b) ((a) < (b) ? (a) : (b))

int wrapped(int v, int period)
{
  v %= period;
  return v < 0 ? v + period : v;
}

/* Element of a plane map at column c (>= -margin 2^shift), row r (-1 .. rows). */
int place(int c, int r, int rows, int pitch, int margin, int shift)
{
  return ((c & ((1 << shift) - 1)) * (rows + 2) + r + 1) * pitch + margin + (c >> shift);
}

/* Slope of depth between neighbours: central, one-sided beside what is no ground. */
floats tilt(floats low, floats own, floats high)
{
  const ints low_masked = WHERE(low <= HIGHEST_MASKED), high_masked = WHERE(high <= HIGHEST_MASKED);
  const floats tilted =
      ((low_masked ? own : low) - (high_masked ? own : high)) *
      ((low_masked | high_masked) ? (floats)1 : (floats)0.5f);
  return own <= HIGHEST_MASKED ? (floats)0 : tilted;
}

/* Heights of nodes; where there is no ground the highest, from which almost no ground is visible. */
floats stands_at(floats own, float highest) { return own > HIGHEST_MASKED ? own : (floats)highest; }

/* Distance of the wall of a dark box, half a node outside, from x on `count` nodes, along a component. */
floats to_wall(floats x, float along, int count)
{
  if (fabs(along) < 1e-6f)
    return (floats)ENDLESS;
  return (along > 0 ? (float)count - 0.5f - x : x + 0.5f) * (1 / fabs(along));
}

/* Sums over all strips that LANES nodes see: columns c, c + 2^shift, .. of row y. */
void gathered(__global const float *restrict heights, __global const float *restrict light,
              __global const float *ways, __global const int *places, __global const float *crossings, int c,
              int y, int azimuths, int count, int rows, int cols, int across, int margin, int shift,
              int sides, float highest, floats own, floats gx, floats gy, floats *num, floats *den)
{
  const int pitch = across + 2 * margin, plane_size = (rows + 2) * pitch, phases = 1 << shift;
  const floats x = (floats)c + (floats)(float)phases * (floats)COUNT;
  floats total = 0;
  for (int l = 0; l < LIGHTS; ++l)
    num[l] = 0;
  for (int k = 0; k < azimuths; ++k) {
    const float cosine = ways[4 * k], sine = ways[4 * k + 1];
    const int on_columns = ways[4 * k + 2] > 0;
    const floats plane = -(gx * cosine + gy * sine), start = below(plane, plane);
    floats slope = plane, past = start, before = 0;
    int was = place(c, y, rows, pitch, margin, shift), was_next = was;
    float was_weight = 0, was_distance = 0;
    for (int j = k * count; j < (k + 1) * count; ++j) {
      const float weight = crossings[3 * j], distance = crossings[3 * j + 1],
                  per_distance = crossings[3 * j + 2];
      /* 1. where the crossing lies, if it is on the map, and if any ground there could be seen */
      int u = c + places[2 * j], v = y + places[2 * j + 1];
      if (sides == PERIODIC) {
        u = (wrapped(u >> shift, across) << shift) + (u & (phases - 1));
        v = wrapped(v, rows);
      } else if (v < -1 || v >= rows || (u >> shift) <= -LANES || (u >> shift) >= across)
        break;
      if (!ANY(WHERE(highest - own > slope * distance)))
        break;
      const int at = place(u, v, rows, pitch, margin, shift),
                next = on_columns ? at + pitch : place(u + 1, v, rows, pitch, margin, shift);
      /* 2. the ground there */
      const floats a = READ(at, heights), b = READ(next, heights);
      const floats stands = a + weight * (b - a) - own, rises = stands * per_distance;
      const ints seen = WHERE(rises > slope);
      /* 3. the strip that it opens: its share, and the mean of the light at both ends */
      if (ANY(seen)) {
        const floats low = before - slope * was_distance, high = stands - slope * distance;
        /* on a plane rounding alone may raise a crossing, and then high may be below 0, or below low */
        const ints past_near = seen & WHERE(low < 0) & WHERE(high > low) & WHERE((floats)was_distance > 0);
        floats part = past_near ? -low / (high - low) : (floats)0;
        part = part < 1 ? part : (floats)1;
        const floats here = below(rises, plane), share = seen ? (here - past) * 0.5f : (floats)0;
        for (int l = 0; l < LIGHTS; ++l) {
          __global const float *map = light + (size_t)l * phases * plane_size;
          const floats c0 = READ(was, map), c1 = READ(was_next, map), d0 = READ(at, map),
                       d1 = READ(next, map);
          const floats near = c0 + was_weight * (c1 - c0), far = d0 + weight * (d1 - d0);
          num[l] += share * (near * (1 - part) + far * (1 + part));
        }
        past = seen ? here : past;
        slope = seen ? rises : slope;
      }
      before = stands;
      was = at;
      was_next = next;
      was_weight = weight;
      was_distance = distance;
    }
    /* 4. all that is not sky */
    if (sides != PERIODIC)
      slope = MOST(slope, (floats)0);
    if (sides == DARK) {
      const floats wall_x = to_wall(x, cosine, cols), wall_y = to_wall((floats)y, sine, rows);
      const floats wall = -own / (wall_x < wall_y ? wall_x : wall_y);
      slope = MOST(slope, wall);
    }
    total += below(slope, plane) - start;
  }
  *den = total;
}

/* spread: maps as planes, each times a factor.

  maps    (n, rows x cols)                   float
  albedo  (n, rows x cols) or (n)            float  of every node where it `varies`, else of every map
  planes  (n, 2^shift, rows + 2, pitch)      float  out; `outside` where there is no map

Work-item (x, r, l) owns elements x of row r of all planes of map l. */
__kernel void spread(__global const float *maps, __global const float *albedo, __global float *planes, int n,
                     int rows, int cols, int across, int margin, int shift, int periodic, int varies,
                     float scale, float outside)
{
  const int x = get_global_id(0), r = get_global_id(1), l = get_global_id(2), pitch = across + 2 * margin;
  if (x >= pitch || r >= rows + 2 || l >= n)
    return;
  for (int phase = 0; phase < 1 << shift; ++phase) {
    int c = (x - margin) * (1 << shift) + phase, y = r - 1;
    if (periodic) {
      c = wrapped(c, cols);
      y = wrapped(y, rows);
    }
    const int on_map = c >= 0 && c < cols && y >= 0 && y < rows, p = (l * rows + y) * cols + c;
    planes[(((l << shift) + phase) * (rows + 2) + r) * pitch + x] =
        on_map ? maps[p] * (albedo[varies ? p : l] * scale) : outside;
  }
}

/* begin: light before the first gather: that of a node among its like, E_d / (1 - albedo (1 - f)).

  direct      (n, rows x cols)         float  in and out: what is not above 0, nan too, becomes 0
  albedo      (n, rows x cols) or (n)  float  as for spread
  sky         (rows x cols)            float  f, the share of sky that a node sees, cosine-weighted
  irradiance  (n, rows x cols)         float  out

Work-item (p, l) owns node p of light l. */
__kernel void begin(__global float *direct, __global const float *albedo, __global const float *sky,
                    __global float *irradiance, int n, int pixels, int varies)
{
  const int p = get_global_id(0), l = get_global_id(1), q = l * pixels + p;
  if (p >= pixels || l >= n)
    return;
  const float light = direct[q] > 0 ? direct[q] : 0.0f;
  direct[q] = light;
  irradiance[q] = light / fmax(1 - albedo[varies ? q : l] * (1 - sky[p]), LEAST_ESCAPE);
}

/* gather: sums of strips at every stride-th node of every stride-th row, or every 2^shift-th if that is less.
   Masked nodes are no receivers. Work-item (g, phase, r) owns LANES receivers of row r. */
__kernel void gather(__global const float *restrict heights, __global const float *restrict light,
                     __global const float *ways, __global const int *places, __global const float *crossings,
                     __global float *sums, int azimuths, int count, int rows, int cols, int across,
                     int margin, int shift, int sides, int stride, int phases, int width,
                     float highest)
{
  const int x = (int)get_global_id(0) * LANES, phase = get_global_id(1), row = get_global_id(2);
  const int y = row * stride, step = min(stride, 1 << shift), pitch = across + 2 * margin;
  if (x >= across || phase >= phases || y >= rows)
    return;
  const int c = (x << shift) + phase * step;
  const floats own = READ(place(c, y, rows, pitch, margin, shift), heights),
               left = READ(place(c - 1, y, rows, pitch, margin, shift), heights),
               right = READ(place(c + 1, y, rows, pitch, margin, shift), heights),
               above = READ(place(c, y - 1, rows, pitch, margin, shift), heights),
               beneath = READ(place(c, y + 1, rows, pitch, margin, shift), heights);
  const ints receives = WHERE(own > HIGHEST_MASKED);
  const int all = (rows + stride - 1) / stride * phases * width, at = (row * phases + phase) * width + x;
  floats num[LIGHTS], den = -1;
  for (int l = 0; l < LIGHTS; ++l)
    num[l] = 0;
  if (ANY(receives)) {
    gathered(heights, light, ways, places, crossings, c, y, azimuths, count, rows, cols, across, margin,
             shift, sides, highest, stands_at(own, highest), tilt(left, own, right),
             tilt(above, own, beneath), num, &den);
    den = receives ? den : (floats)-1;
  }
  for (int l = 0; l < LIGHTS; ++l)
    STORE(num[l], l * all + at, sums);
  STORE(den, LIGHTS * all + at, sums);
}

/* fill: irradiance of every node from the receivers round it. Numerator and denominator are interpolated
   apart, over those receivers that there are.

  direct      (LIGHTS, rows x cols)  float  [brightness x sr]
  sky         (rows x cols)          float  f, the share of sky that a node sees, cosine-weighted
  irradiance  (LIGHTS, rows x cols)  float  out, as direct; -1 where no receiver is near and a
                                            node must gather by itself; 0 where masked

Work-item (i, y) owns the nodes of row y from receiver column i up to the next. */
__kernel void fill(__global const float *heights, __global const float *sums, __global const float *direct,
                   __global const float *sky, __global float *irradiance, int rows, int cols, int across,
                   int margin, int shift, int sides, int stride, int phases, int width)
{
  const int i = get_global_id(0), y = get_global_id(1), pitch = across + 2 * margin;
  const int step = min(stride, 1 << shift), lines = (rows + stride - 1) / stride,
            columns = (cols + step - 1) / step, all = lines * phases * width;
  if (i >= columns || y >= rows)
    return;
  /* 1. along the columns of receivers on both sides: the last receiver serves up to the map's end, or up to
     the first where the map repeats */
  const int row = y / stride, periodic = sides == PERIODIC, last_row = row + 1 == lines,
            last = i + 1 == columns;
  const float down = last_row ? (float)(y - row * stride) / (rows - row * stride) * periodic
                              : (float)(y - row * stride) / stride;
  const int at_column[2] = {i, last ? 0 : i + 1};
  float num[2][LIGHTS], den[2], whole[2];
  for (int side = 0; side < 2; ++side) {
    den[side] = whole[side] = 0;
    for (int l = 0; l < LIGHTS; ++l)
      num[side][l] = 0;
    for (int lower = 0; lower < 2; ++lower) {
      const int r = lower ? (last_row ? 0 : row + 1) : row, c = at_column[side] * step;
      const int at = (r * phases + (c & ((1 << shift) - 1)) / step) * width + (c >> shift);
      const float shares = sums[LIGHTS * all + at],
                  weight = shares < 0 ? 0.0f : lower ? down : 1 - down;
      whole[side] += weight;
      den[side] += weight * shares;
      for (int l = 0; l < LIGHTS; ++l)
        num[side][l] += weight * sums[l * all + at];
    }
  }
  /* 2. between them */
  const int first = i * step, end = min(first + step, cols);
  for (int x = first; x < end; ++x) {
    const int p = y * cols + x;
    const float own = heights[place(x, y, rows, pitch, margin, shift)];
    const float right = last ? (float)(x - first) / (cols - first) * periodic : (float)(x - first) / step;
    const float known = whole[0] * (1 - right) + whole[1] * right,
                shares = den[0] * (1 - right) + den[1] * right;
    for (int l = 0; l < LIGHTS; ++l) {
      const float mean = shares > 0 ? (num[0][l] * (1 - right) + num[1][l] * right) / shares : 0.0f;
      const float total = direct[l * rows * cols + p] + PI * (1 - sky[p]) * mean;
      irradiance[l * rows * cols + p] =
          own <= HIGHEST_MASKED ? 0.0f : !(known > 0) ? -1.0f : total;
    }
  }
}

/* gather_nodes: irradiance of nodes by strips of their own, `every` one or those where it is < 0. Work-item
   (g, phase, y) owns LANES nodes of row y, 2^shift columns apart. direct, sky and irradiance as for fill. */
__kernel void gather_nodes(__global const float *restrict heights, __global const float *restrict light,
                           __global const float *ways, __global const int *places,
                           __global const float *crossings, __global const float *direct,
                           __global const float *sky, __global float *irradiance, int azimuths, int count,
                           int rows, int cols, int across, int margin, int shift, int sides, int every,
                           float highest)
{
  const int x = (int)get_global_id(0) * LANES, phase = get_global_id(1), y = get_global_id(2);
  const int pitch = across + 2 * margin, phases = 1 << shift;
  if (x >= across || phase >= phases || y >= rows)
    return;
  const int c = (x << shift) + phase;
  int wanted = every;
  for (int l = 0; l < LANES; ++l)
    wanted = wanted || (c + l * phases < cols && irradiance[y * cols + c + l * phases] < 0);
  if (!wanted)
    return;
  const floats own = READ(place(c, y, rows, pitch, margin, shift), heights),
               left = READ(place(c - 1, y, rows, pitch, margin, shift), heights),
               right = READ(place(c + 1, y, rows, pitch, margin, shift), heights),
               above = READ(place(c, y - 1, rows, pitch, margin, shift), heights),
               beneath = READ(place(c, y + 1, rows, pitch, margin, shift), heights);
  floats num[LIGHTS], den;
  gathered(heights, light, ways, places, crossings, c, y, azimuths, count, rows, cols, across, margin, shift,
           sides, highest, stands_at(own, highest), tilt(left, own, right), tilt(above, own, beneath), num,
           &den);
  for (int l = 0; l < LANES; ++l) {
    const int p = y * cols + c + l * phases;
    if (c + l * phases >= cols || !(every || irradiance[p] < 0))
      continue;
    const float shares = LANE(float, den, l);
    for (int i = 0; i < LIGHTS; ++i) {
      const float mean = shares > 0 ? LANE(float, num[i], l) / shares : 0.0f;
      const int q = i * rows * cols + p;
      irradiance[q] = LANE(float, own, l) > HIGHEST_MASKED ? direct[q] + PI * (1 - sky[p]) * mean : 0.0f;
    }
  }
}

#if LANES == 1
/* Distance between crossings along an axis, of a unit vector's component. */
float per(float component) { return fabs(component) > 1e-6f ? 1 / fabs(component) : ENDLESS; }

/* Where a ray crosses a column or a row of nodes: between the nodes at two places. */
typedef struct {
  int at, next;
  float weight, distance; /* of the next node; [spacing] */
} Crossing;

/* Step from a node (x, y) to the next crossing, after those of columns and rows that were `met`. Returns 0
   where it lies outside the map; it is not moved on then. */
int cross(int x, int y, float cosine, float sine, float per_column, float per_row, int met[2], int rows,
          int cols, int across, int margin, int shift, int sides, Crossing *crossing)
{
  const float to_column = (met[0] + 1) * per_column, to_row = (met[1] + 1) * per_row,
              distance = LEAST(to_column, to_row);
  const int on_column = to_column <= to_row;
  const float at_line = on_column ? y + sine * distance : x + cosine * distance;
  int low = (int)at_line;
  low -= low > at_line; /* floor, which PoCL calls */
  float weight = at_line - low;
  if (weight > 1 - 1e-4f) { /* at a node */
    low += 1;
    weight = 0;
  }
  weight = weight < 1e-4f ? 0.0f : weight;
  met[0] += on_column;
  met[1] += !on_column;
  int u = on_column ? (cosine > 0 ? x + met[0] : x - met[0]) : low,
      v = on_column ? low : (sine > 0 ? y + met[1] : y - met[1]);
  if (sides == PERIODIC) {
    u = wrapped(u, cols);
    v = wrapped(v, rows);
  } else if (u < 0 || u >= cols || v < 0 || v >= rows ||
             (weight > 0 && (on_column ? v + 1 >= rows : u + 1 >= cols)))
    return 0;
  crossing->at = place(u, v, rows, across + 2 * margin, margin, shift);
  crossing->next = on_column ? crossing->at + across + 2 * margin
                             : place(u + 1, v, rows, across + 2 * margin, margin, shift);
  crossing->weight = weight;
  crossing->distance = distance;
  return 1;
}

/* Value of a map at a crossing. */
float value_at(__global const float *map, Crossing crossing)
{
  return map[crossing.at] + crossing.weight * (map[crossing.next] - map[crossing.at]);
}

/* Part of a stretch of ground before a line of sight meets it, from how far ground stands above the line at
   both ends; 0 for the stretch that begins at the node. */
float part_past(float low, float high, float distance)
{
  return distance > 0 && low < 0 && high > low ? LEAST(-low / (high - low), 1.0f) : 0.0f;
}

/* A ray in an azimuth: elevation's cosine and sine, slope, and change of elevation by its place. */
typedef struct {
  float cosine, sine, slope, per_place;
} Aim;

/* The ray at a place from -1 to 1, on either side of an elevation of this cosine and sine. below, above:
   tangents of half the angles that the sides span. The slope is a little less: ground that the ray misses by
   rounding is met. */
Aim aimed(float place, float below, float above, float from_cosine, float from_sine)
{
  const float side = place < 0 ? below : above, t = side * place, scale = 1 / (1 + t * t),
              cosine = (1 - t * t) * scale, sine = 2 * t * scale;
  Aim aim;
  aim.cosine = from_cosine * cosine - from_sine * sine;
  aim.sine = from_sine * cosine + from_cosine * sine;
  aim.slope = aim.sine / MOST(aim.cosine, 1 / (float)STEEP);
  aim.slope -= GRAZES * (1 + MOST(aim.slope, -aim.slope));
  aim.per_place = 2 * side * scale;
  return aim;
}

/* Weight of a lobe at a part of its rim, from its table. */
float lobe_at(__global const float *lobe, int n_lobe, float part)
{
  const float at = LEAST(part, 1.0f) * (n_lobe - 1);
  const int i = LEAST((int)at, n_lobe - 2);
  return lobe[i] + (at - i) * (lobe[i + 1] - lobe[i]);
}
#endif

/* strips: the sums of single rays, over every crossing with a column or a row, exactly.

  rays   (rays, 4)           float  column, row, cosine and sine of the azimuth
  sums   (LIGHTS + 2, rays)  float  out: sum of shares x radiance for every light, sum of shares of all that
                                    is not sky, and the sky's share; with the upward part of the normal: the
                                    mean over azimuths of the last two is 1

reach [spacing]: as far as is looked. LANES is 1: work-item n owns a ray. */
__kernel void strips(__global const float *heights, __global const float *light, __global const float *rays,
                     __global float *sums, int n_rays, int rows, int cols, int across, int margin, int shift,
                     int sides, float highest, float reach)
{
#if LANES == 1
  const int n = get_global_id(0), pitch = across + 2 * margin, plane_size = (rows + 2) * pitch;
  if (n >= n_rays)
    return;
  const int x = (int)rays[4 * n], y = (int)rays[4 * n + 1];
  const float cosine = rays[4 * n + 2], sine = rays[4 * n + 3];
  const float own = heights[place(x, y, rows, pitch, margin, shift)];
  const float gx = tilt(heights[place(x - 1, y, rows, pitch, margin, shift)], own,
                        heights[place(x + 1, y, rows, pitch, margin, shift)]),
              gy = tilt(heights[place(x, y - 1, rows, pitch, margin, shift)], own,
                        heights[place(x, y + 1, rows, pitch, margin, shift)]);
  const float plane = -(gx * cosine + gy * sine), start = below(plane, plane);
  const float per_column = per(cosine), per_row = per(sine);
  float num[LIGHTS], slope = plane, past = start, before = 0;
  for (int l = 0; l < LIGHTS; ++l)
    num[l] = 0;
  const int node = place(x, y, rows, pitch, margin, shift);
  Crossing was = {node, node, 0, 0}, at;
  int met[2] = {0, 0};
  /* 1. the next crossing, if it is on the map, and if any ground there could be seen */
  while (cross(x, y, cosine, sine, per_column, per_row, met, rows, cols, across, margin, shift, sides, &at) &&
         !(at.distance > reach) && highest - own > slope * at.distance) {
    /* 2. the ground there */
    const float stands = value_at(heights, at) - own, rises = stands / at.distance;
    /* 3. the strip that it opens */
    if (rises > slope) {
      const float part = part_past(before - slope * was.distance, stands - slope * at.distance, was.distance),
                  here = below(rises, plane), share = (here - past) * 0.5f;
      for (int l = 0; l < LIGHTS; ++l) {
        __global const float *map = light + (size_t)l * (1 << shift) * plane_size;
        num[l] += share * (value_at(map, was) * (1 - part) + value_at(map, at) * (1 + part));
      }
      past = here;
      slope = rises;
    }
    before = stands;
    was = at;
  }
  /* 4. all that is not sky, and the sky */
  if (sides != PERIODIC)
    slope = max(slope, 0.0f);
  if (sides == DARK)
    slope = max(slope, -own / min(to_wall(x, cosine, cols), to_wall(y, sine, rows)));
  const float up = 1 / sqrt(1 + gx * gx + gy * gy), sky = below(slope, plane);
  for (int l = 0; l < LIGHTS; ++l)
    sums[l * n_rays + n] = up * num[l];
  sums[LIGHTS * n_rays + n] = up * (sky - start);
  sums[(LIGHTS + 1) * n_rays + n] = up * (-plane * HALF_PI - sky);
#endif
}

/* glossy: what nodes reflect of the ground round them towards the viewer, by a lobe about the mirror
   direction R = 2 (N.V) N - V, V = (0, 0, -1), or along R alone.

  lobe   (n_lobe)               float  weight by 1 - cosine of the angle to R, even steps from 0 to rim,
                                       beyond which there is none
  spots  (slices + rays, 2)     float  places from -1 to 1 across the lobe, and their widths, which add up to
                                       2: of azimuths, and then of the elevations in each
  image  (LIGHTS, rows x cols)  float  out: integral of radiance x lobe x N.L over the directions that ground
                                       occupies; with rim 0 the radiance of the ground along R. 0 where masked

The spots lie as dense as the lobe: the host makes them from its table. Rays of an azimuth meet the ground in
order of elevation, so that one walk serves all. Between two crossings height and radiance are linear; the
first stretch bends from the tangent plane up to its crossing, and a ray meets it half way. reach [spacing]:
ground farther away is not met. LANES is 1: work-item (x, phase, y) owns the node of row y at element x of
plane `phase`. */
__kernel void glossy(__global const float *heights, __global const float *light, __global const float *lobe,
                     __global const float *spots, __global float *image, int rows, int cols, int across,
                     int margin, int shift, int sides, int slices, int rays, int n_lobe, float rim,
                     float highest, float reach)
{
#if LANES == 1
  const int x = ((int)get_global_id(0) << shift) + (int)get_global_id(1), y = get_global_id(2),
            pitch = across + 2 * margin, plane_size = (rows + 2) * pitch;
  if (x >= cols || y >= rows || get_global_id(1) >= 1 << shift)
    return;
  const int node = place(x, y, rows, pitch, margin, shift);
  const float own = heights[node];
  float sums[LIGHTS];
  for (int l = 0; l < LIGHTS; ++l)
    sums[l] = 0;
  /* 1. the mirror direction, by sine and cosine of its elevation and azimuth, and the azimuths of the lobe */
  const float gx = tilt(heights[place(x - 1, y, rows, pitch, margin, shift)], own,
                        heights[place(x + 1, y, rows, pitch, margin, shift)]),
              gy = tilt(heights[place(x, y - 1, rows, pitch, margin, shift)], own,
                        heights[place(x, y + 1, rows, pitch, margin, shift)]);
  const float square = 1 + gx * gx + gy * gy, steep = sqrt(gx * gx + gy * gy), up = 2 / square - 1,
              flat = 2 * steep / square, wide = sqrt(rim * (2 - rim));
  const float half_turn = wide < flat ? asin(wide / flat) : PI, upward = 1 / sqrt(square),
              per_rim = rim > 0 ? 1 / rim : 0.0f;
  for (int k = 0; k < slices && own > HIGHEST_MASKED; ++k) {
    const float angle = half_turn * spots[2 * k], c = cos(angle), s = sin(angle),
                turn = upward * half_turn * spots[2 * k + 1];
    const float cosine = steep > 0 ? (gx * c - gy * s) / steep : c,
                sine = steep > 0 ? (gy * c + gx * s) / steep : s;
    /* 2. the elevations of the lobe in this azimuth: at an angle from the middle, 1 - cosine to R is
       aside + length (1 - cos(angle)); they are above the tangent plane and not beyond the zenith */
    const float along = flat * c, length = sqrt(along * along + up * up),
                aside = flat * flat * s * s / (1 + length), plane = -(gx * cosine + gy * sine);
    if (aside > rim)
      continue;
    const float middle = atan2(up, along), tangent = arctan(plane),
                spread = 2 * asin(sqrt(LEAST((rim - aside) / (2 * length), 1.0f)));
    const float lowest = MOST(middle - spread, tangent), most = LEAST(middle + spread, HALF_PI),
                from = LEAST(MOST(middle, lowest), most);
    if (most < lowest)
      continue;
    const float per_length = 1 / length;
    const float from_cosine = from == middle ? along * per_length : cos(from),
                from_sine = from == middle ? up * per_length : sin(from);
    const float below = tan(0.5f * (from - lowest)), above = tan(0.5f * (most - from));
    /* 3. the first ground along each */
    const float per_column = per(cosine), per_row = per(sine);
    Crossing was = {node, node, 0, 0}, at;
    int met[2] = {0, 0}, ray = 0;
    Aim aim = aimed(spots[2 * slices], below, above, from_cosine, from_sine);
    float before = 0;
    while (cross(x, y, cosine, sine, per_column, per_row, met, rows, cols, across, margin, shift, sides,
                 &at) &&
           !(at.distance > reach) && highest - own > aim.slope * at.distance) {
      const float stands = value_at(heights, at) - own, rises = stands / at.distance;
      while (ray < rays && rises > aim.slope) {
        const float part = was.distance > 0 ? part_past(before - aim.slope * was.distance,
                                                        stands - aim.slope * at.distance, was.distance)
                                            : 0.5f;
        float weight = 1;
        if (rim > 0) {
          const float off = (aim.sine * along - aim.cosine * up) * per_length,
                      near = (aim.cosine * along + aim.sine * up) * per_length,
                      away = aside + length * off * off / (1 + near);
          weight = lobe_at(lobe, n_lobe, away * per_rim) * MOST(aim.sine - plane * aim.cosine, 0.0f) *
                   aim.cosine * aim.per_place * spots[2 * (slices + ray) + 1] * turn;
        }
        for (int l = 0; l < LIGHTS; ++l) {
          __global const float *map = light + (size_t)l * (1 << shift) * plane_size;
          sums[l] += weight * (value_at(map, was) * (1 - part) + value_at(map, at) * part);
        }
        ++ray;
        if (ray < rays)
          aim = aimed(spots[2 * (slices + ray)], below, above, from_cosine, from_sine);
      }
      if (ray == rays)
        break;
      before = stands;
      was = at;
    }
  }
  for (int l = 0; l < LIGHTS; ++l)
    image[(l * rows + y) * cols + x] = sums[l];
#endif
}
