/* Horizons, and the light of a sky above them, by sweeps along lines that pass the map in one azimuth.

The horizon's slope at a node is the largest (height - own height) / distance over every crossing of the
azimuth's vertical plane with a row or column of the grid. Nearer than NEAR rows all crossings are tested,
exactly. Farther away a line that passes within half a node carries, for each slope s of a ladder, the
crossing that stands highest above a ray of that slope, max (height - s distance), as one integer: quantized
height above the ray, and the distance in its lowest bits. The two steps of the ladder between which the
node's own height lies give the two crossings between which the true one lies; both, and a column crossing
beside each, are then looked up on the node's own ray, exactly.

The map is turned so that rays go from row to row: azimuths nearer to the columns' direction belong to the
turned map.

  heights      (room)          float  [spacing]  the padded map, (rows + 2 margin, cols + 2 margin); -1e30
                                                 outside, -2e30 masked
  tilts        (2, room)       float  [1]        d depth/dx and d depth/dy, padded likewise
  azimuths     (count, 8)      float  columns per row towards the source, cosine and sine of the azimuth in
                                      this map, the slope's unit (rows per spacing), width [rad x unit of the
                                      sum], 1 / |columns per row| or 1e9, reach [rows], 0
  ways         (count, 8)      int    1 if the source lies towards row 0, else -1; near rows; near columns;
                                      rows before the first from which a map that repeats is swept; window
                                      [rows]; number of its sum; 0, 0
  near_at      (count, n, 2)   int    the first node of each near row (column) crossing: columns on, rows on;
                                      n = NEAR + NEAR_COLUMNS
  near_weight  (count, n)      float  weight of the farther node of each
  table        (count, knots)  float4 brightness: integrals over elevation of B cos^2 and B sin cos from
                               tangent / (1 + tangent) = i / (knots - 1) to the zenith, and what to add up to
                               the next knot
  slopes       (count, rows x cols) float  in, out: horizon slopes [1], rise over distance
  sum          (sums, rows x cols) int  in, out: irradiance in fixed point, so that no order of summation
                                      matters
  steps        (LADDER)        int    the ladder: (s << bits) - 1
  rises        (LADDER)        int    and s times the distance at which a crossing comes in
  falling_steps, falling_rises (LADDER)  int  both of a ladder of slopes below the level
  first        int             number of the first azimuth that is swept
  group        int             work-items of a group
  rows, cols   int             of the map and the image, without the margin
  margin       int             nodes round the map in heights and tilts
  room         int             nodes of the padded map
  knots        int             of the table
  bits         int             of a candidate's integer that hold its distance [rows]
  lowest       float           [spacing], least height of the map
  height_scale, falling_scale  float  steps of a candidate's integer per spacing of height, by both ladders
  known, backward, top, bottom, left, right  int  see below

WHAT: SLOPES writes slopes, UNIFORM adds the light of a uniform sky, TABLE that of `table`, ANGLES the angle
from the zenith to the horizon [rad] times the width; a horizon without ground counts as level. SIDES: OPEN,
DARK or PERIODIC. FALLS: slopes below the level are searched for. known: slopes holds what is known already.
BLOCKS: the window is not endless. backward: rows at the far end of the window come in, and blocks of one
window are swept from the last row to the first; with a forward sweep by blocks it covers exactly one window
before every node. top, bottom, left, right: slopes and sums are computed in rows top .. bottom - 1 and
columns left .. right - 1, and undefined outside, where ground only occludes.
Work-item (j, k, g) owns LANES adjacent lines of azimuth k, or STRIPS times as many on a CPU; long lines start
first. On a GPU the LINES work-items of a group keep the rows about them in local memory if they fit
(TILED). Twin of warp_kernels/horizon.py. */
#include "lanes.h"
#define PITCH (LINES + TILE_ROWS + NEAR + 8)
#define TILE_SIZE ((TILE_ROWS + NEAR + 1) * PITCH)
#define TILED (!ON_CPU && !BLOCKS && SIDES != PERIODIC && TILE_SIZE <= MOST_TILE)
#define LIT (WHAT == UNIFORM || WHAT == TABLE)
#define RUNGS ((1 + FALLS) * LADDER)
#define ROWS_AHEAD 4            /* rows to the one that is fetched; 3, 6 and 10 are as good */
#define ACROSS (LANES * STRIPS) /* strips of LANES lines side by side, for the sake of cache lines */
#define NEAR_COLUMNS (NEAR - 1) /* the last one within NEAR rows lies on a row */

#if LANES == 1
#define TO_FLOATS convert_float
#define COUNT 0
#define PICK(pointer, at) (pointer)[at]
#define LANE(type, v, l) (v)
#else
#define TO_FLOATS JOIN(convert_float, LANES)
#define COUNT (ints)(0, 1, 2, 3, 4, 5, 6, 7)
#define PICK(p, i)                                                                                           \
  ((floats)((p)[(i).s0], (p)[(i).s1], (p)[(i).s2], (p)[(i).s3], (p)[(i).s4], (p)[(i).s5], (p)[(i).s6],       \
            (p)[(i).s7]))
#define LANE(type, v, l) ((type *)&v)[l]
#endif
#if ON_CPU
#define MORE(a, b) ((a) > (b) ? (a) : (b))
#define FMA(a, b, c) ((a) * (b) + (c))
#define ORDER(g, groups) (g) /* neighbours one after another find their lines in the cache */
#define RECIPROCAL(v) (1 / (v))
#define RECIPROCAL_ROOT(v) (1 / sqrt(v))
#define ADD_ALL(to, values) ((__global loose_ints *)(to))->v += values
#define ADD(to, value) *(to) += value /* azimuths come one by one, and no two lines share a node */
#else
#define MORE(a, b) fmax(a, b)
#define FMA(a, b, c) fma(a, b, c)
/* the longest first */
#define ORDER(g, groups) ((g) & 1 ? (groups) / 2 - ((g) + 1) / 2 : (groups) / 2 + (g) / 2)
#ifdef __NV_CL_C_VERSION /* whose native functions scale denormal numbers, four instructions a call */
float reciprocal_of(float v)
{
  float r;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
  return r;
}
float reciprocal_root(float v)
{
  float r;
  asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
  return r;
}
#define RECIPROCAL reciprocal_of
#define RECIPROCAL_ROOT reciprocal_root
#else
#define RECIPROCAL native_recip
#define RECIPROCAL_ROOT native_rsqrt
#endif
#define ADD(to, value) atomic_add(to, value)
#define ADD_ALL(to, values)
#endif

#if TILED
#define NODE(i) here[u * PITCH + x + (i)]
#define LINE(i) here[comes * PITCH + cx + (i)]
#else
#define NODE(i) READ(p + (i), heights)
#define LINE(i) READ(from_row + cx + (i), heights)
#endif

/* of the ladder that counts at a node */
#define RUNG(n) (FALLS ? falls ? above[RUNGS - LADDER + (n)] : above[n] : above[n])
#define RISE(n) (FALLS ? falls ? (ints)falling_rises.s[n] : (ints)rises.s[n] : (ints)rises.s[n])

typedef struct { int s[LADDER]; } Ladder;

ints more(ints a, ints b) { return a > b ? a : b; }
ints less(ints a, ints b) { return a < b ? a : b; }
floats higher(floats a, floats b) { return MORE(a, b); }
#if ON_CPU
ints FLOOR(floats v) /* with convert_int8_rtn a sweep on PoCL takes 5 % more time */
{
  const ints n = TO_INTS(v);
  return n - (v < TO_FLOATS(n) ? (ints)1 : (ints)0);
}
#else
#define FLOOR convert_int_rtn
#endif

/* Arc tangent of v >= 0 to 2e-7, by a polynomial fitted for least maximum error. */
floats arctan(floats v)
{
  const floats r = v > 1 ? RECIPROCAL(v) : v, q = r * r;
  floats p = FMA((floats)ARC_TANGENT_0, q, ARC_TANGENT_1);
  p = FMA(p, q, ARC_TANGENT_2);
  p = FMA(p, q, ARC_TANGENT_3);
  p = FMA(p, q, ARC_TANGENT_4);
  p = FMA(p, q, ARC_TANGENT_5);
  p = FMA(p, q, ARC_TANGENT_6);
  p = FMA(p, q, ARC_TANGENT_7);
  return v > 1 ? HALF_PI - p * r : p * r;
}

/* Where the node dx columns and dy rows beside the nodes at p, (x, y), lies: on a map that repeats, round its
   sides. */
ints neighbour_of(int p, int x, int y, ints dx, ints dy, int rows, int cols, int margin)
{
  if (SIDES != PERIODIC)
    return p + COUNT + (cols + 2 * margin) * dy + dx;
  ints u = (x + COUNT + dx) % cols, v = (y + dy) % rows;
  u = u < 0 ? u + cols : u;
  v = v < 0 ? v + rows : v;
  return (v + margin) * (cols + 2 * margin) + margin + u;
}

/* Offset of lane l of a row's nodes from the row's first, or -1 where it is not on the map. */
int column_of(int x, int line, int l, int cols)
{
  if (SIDES == PERIODIC)
    return line + l >= cols ? -1 : x + l >= cols ? x + l - cols : x + l;
  return x + l >= 0 && x + l < cols ? x + l : -1;
}

/* Ground of the line between two nodes, quantized, with the distance at which it comes in. */
ints quantized(floats a, floats b, float weight, float lowest, float height_scale, int bits, int distance)
{
  floats ground = a + weight * (b - a);
  /* beside the map the border goes on; a masked node is a gap */
  ground = a == NONE ? b : b == NONE ? a : ground;
  const ints seen = (TO_INTS(higher(ground - lowest, 0.0f) * height_scale) << bits) | distance;
  return ground < -1e20f ? (ints)UNSEEN : seen;
}

/* From which row on one of `count` lines is on the map, and up to which it may be in columns left to
   right - 1. */
int enters(int line, int count, float shear, float reciprocal, int cols)
{
  return max((int)floor((float)(shear > 0 ? line - cols : -line - count) * reciprocal), 0);
}
int leaves(int line, int count, float shear, float reciprocal, int stop, int left, int right)
{
  return min((int)((float)(shear > 0 ? line + count - left : right - line) * reciprocal) + 2, stop);
}

/* Slope to where a ray crosses the grid line between nodes i and j, at a distance. */
floats rise(__global const float *heights, ints i, ints j, floats weight, floats distance, float reach,
            floats own)
{
  const floats a = PICK(heights, i), b = PICK(heights, j),
               slope = FMA(weight, b - a, a - own) * RECIPROCAL(distance);
  return BLOCKS ? distance <= reach ? slope : NONE : slope;
}

/* The crossing with the row t rows on of the ray of the node at column x, row y. */
floats on_row(__global const float *heights, floats own, int p, int x, int y, ints t, float shear,
              float reach, int towards, int rows, int cols, int margin)
{
  const floats distance = TO_FLOATS(t), across = shear * distance;
  const ints n = FLOOR(across);
  const ints at = neighbour_of(p, x, y, n, -towards * t, rows, cols, margin);
  return rise(heights, at, at + 1, across - TO_FLOATS(n), distance, reach, own);
}

/* The crossing with the column m columns on, which counts if it is within reach. */
floats on_column(__global const float *heights, floats own, int p, int x, int y, int u, ints m, float shear,
                 float reciprocal, float reach, int towards, int rows, int cols, int margin)
{
  const floats distance = TO_FLOATS(m) * reciprocal;
  const ints n = TO_INTS(distance), before = SIDES == PERIODIC ? n : less(n, u + 1);
  const ints at = neighbour_of(p, x, y, shear > 0 ? m : -m, -towards * before, rows, cols, margin);
  return rise(heights, at, at - towards * (cols + 2 * margin), distance - TO_FLOATS(n), distance, reach, own);
}

__kernel void sweep(__global const float *restrict heights, __global const float *restrict tilts,
                    __constant float *azimuths, __constant int *ways, __constant int *near_at,
                    __constant float *near_weight, __global const float4 *restrict table,
                    __global float *restrict slopes, __global int *restrict sum, const Ladder steps,
                    const Ladder rises, const Ladder falling_steps, const Ladder falling_rises, int first,
                    int group, int rows, int cols, int margin, int room, int knots, int bits, float lowest,
                    float height_scale, float falling_scale, int known, int backward, int top, int bottom,
                    int left, int right)
{
  const int k = get_group_id(1) + first, g = get_global_id(2);
  const float shear = azimuths[8 * k], cosine = azimuths[8 * k + 1], sine = azimuths[8 * k + 2];
  const float rows_per_spacing = azimuths[8 * k + 3], width = azimuths[8 * k + 4];
  const float reciprocal = azimuths[8 * k + 5], reach = azimuths[8 * k + 6], steepness = fabs(shear);
  const int towards = ways[8 * k], near_rows = ways[8 * k + 1], near_columns = ways[8 * k + 2],
            warm = ways[8 * k + 3];
  const int window = ways[8 * k + 4];
  sum += (size_t)ways[8 * k + 5] * rows * cols;

  const int stride = cols + 2 * margin, back = TILED ? -PITCH : -towards * stride, mask = (1 << bits) - 1;

  /* 1. which lines, the longest first, and from which row to which they are on the map */
  const int overhang = SIDES == PERIODIC ? 0 : (int)(steepness * rows) + 1,
            beyond = cols + (shear > 0 ? overhang : 0);
  const int groups = (cols + overhang + ACROSS * group - 1) / (ACROSS * group);
  if (g >= groups)
    return;
  const int first_line = ORDER(g, groups) * group * ACROSS - (shear < 0 ? overhang : 0),
            line = first_line + (int)get_local_id(0) * ACROSS;
  if (!TILED && line >= beyond)
    return;
  const int first_asked = towards > 0 ? top : rows - bottom, end = towards > 0 ? bottom : rows - top;
  int start = -warm, stop = end;
  if (SIDES != PERIODIC && reciprocal < 1e8f) {
    start = enters(line, ACROSS, shear, reciprocal, cols);
    stop = leaves(line, ACROSS, shear, reciprocal, end, left, right);
  }
  int from = start, to = stop;
  if (BLOCKS && backward) {
    from -= (start + warm) % window;
    to += window - 1 - (stop - 1 + warm) % window;
  }
#if TILED /* the work-items of a group go together */
  if (reciprocal < 1e8f) {
    from = enters(first_line, LINES, shear, reciprocal, cols);
    to = leaves(first_line, LINES, shear, reciprocal, end, left, right);
  }
  if (line >= beyond)
    stop = start;
  __local float tile[TILE_SIZE];
  __local const float *here = tile;
#endif

  int row_at[NEAR], column_at[NEAR_COLUMNS];
  float row_weight[NEAR], column_weight[NEAR_COLUMNS];
  for (int e = 0; e < NEAR; ++e) {
    const int n = (NEAR + NEAR_COLUMNS) * k + e;
    row_at[e] = near_at[2 * n] + near_at[2 * n + 1] * back;
    row_weight[e] = near_weight[n];
  }
  for (int e = 0; e < NEAR_COLUMNS; ++e) {
    const int n = (NEAR + NEAR_COLUMNS) * k + NEAR + e;
    column_at[e] = near_at[2 * n] + near_at[2 * n + 1] * back;
    column_weight[e] = near_weight[n];
  }

  /* 2. the ladder: nothing visible yet */
  ints ladders[STRIPS][RUNGS];
  int step[RUNGS];
  for (int s = 0; s < RUNGS; ++s) {
    for (int q = 0; q < STRIPS; ++q)
      ladders[q][s] = UNSEEN;
    step[s] = s < LADDER ? steps.s[s] : falling_steps.s[s - LADDER];
    step[s] = BLOCKS && backward ? step[s] : -step[s];
  }
  const int comes_at = BLOCKS && backward ? window : NEAR + 1;

  for (int i = from; i < to; ++i) {
    int u = i, into = 1;
    if (BLOCKS) {
      into = (i + warm) % window;
      u = backward ? i - 2 * into + window - 1 : i;
    }
    const int on_line = u >= max(start, 0) && u < stop;
    const int y = towards > 0 ? u : rows - 1 - u, shift = (int)floor(0.5f - shear * u);
    const int comes = u - comes_at, arrives = (SIDES == PERIODIC || comes >= start && comes < stop) &&
                                              (!BLOCKS || backward || into > NEAR);
    const float across = -shear * comes;
    const int column = (int)floor(across), came = SIDES == PERIODIC ? (comes % rows + rows) % rows : comes;
    const int from_row = ((towards > 0 ? came : rows - 1 - came) + margin) * stride + margin;
#if TILED
    if ((i - from) % TILE_ROWS == 0) { /* TILE_ROWS rows, and those before them that are near or come in */
      const int first_row = i - NEAR - 1,
                first_column =
                    first_line + (int)floor(0.5f - shear * (shear > 0 ? i + TILE_ROWS - 1 : first_row)) - 2;
      barrier(CLK_LOCAL_MEM_FENCE);
      const int j = get_local_id(0), own = min(max(first_column + j, -margin), cols + margin - 1),
                beyond_lines = min(max(first_column + LINES + j, -margin), cols + margin - 1);
#pragma unroll
      for (int e = 0; e < TILE_ROWS + NEAR + 1; ++e) {
        const int r = towards > 0 ? first_row + e : rows - 1 - first_row - e;
        __global const float *row =
            heights + (min(max(r, -margin), rows + margin - 1) + margin) * stride + margin;
        tile[e * PITCH + j] = row[own];
        if (j < PITCH - LINES)
          tile[e * PITCH + LINES + j] = row[beyond_lines];
      }
      barrier(CLK_LOCAL_MEM_FENCE);
      here = tile - (first_row * PITCH + first_column);
    }
#endif

#if defined(PREFETCH) && SIDES != PERIODIC
    const int u_later = u + (BLOCKS && backward ? -ROWS_AHEAD : ROWS_AHEAD),
              later = towards > 0 ? u_later : rows - 1 - u_later,
              later_x = line + (int)floor(0.5f - shear * u_later),
              later_at = (later + margin) * stride + margin + later_x;
    for (int q = 0; q < STRIPS; q += 2) { /* a cache line has two vectors */
      PREFETCH(heights + later_at + LANES * q);
      if (known || WHAT == SLOPES)
        PREFETCH(slopes + ((size_t)get_group_id(1) * rows + later) * cols + later_x + LANES * q);
      if (LIT) {
        PREFETCH(tilts + later_at + LANES * q);
        PREFETCH(tilts + room + later_at + LANES * q);
        PREFETCH(sum + later * cols + later_x + LANES * q);
      }
    }
#endif

    for (int q = 0; q < STRIPS; ++q) {
      const int strip = line + LANES * q;
      int x = strip + shift, cx = strip + column;
      if (SIDES == PERIODIC) {
        x = (x % cols + cols) % cols;
        cx = (cx % cols + cols) % cols;
      }
      const int on_map = on_line && (SIDES == PERIODIC || STRIPS == 1 || x < cols && x > -LANES);
      if (STRIPS > 1 && !on_map && !BLOCKS && SIDES != PERIODIC)
        continue;

      /* 3. the row that comes in, quantized; then every ray climbs (or, backward, falls) by one row */
      ints *above = ladders[q], seen = UNSEEN, seen_falling = UNSEEN;
      for (int s = 0; s < RUNGS && into == 0; ++s)
        above[s] = UNSEEN;
      if (arrives && (STRIPS == 1 || cx < cols && cx >= -LANES)) {
        seen = quantized(LINE(0), LINE(1), across - column, lowest, height_scale, bits, comes_at);
        if (FALLS)
          seen_falling = quantized(LINE(0), LINE(1), across - column, lowest, falling_scale, bits, comes_at);
      }
      for (int s = 0; s < RUNGS; ++s)
        above[s] = more(above[s] + step[s], s < LADDER ? seen : seen_falling);
      if (!on_map || u < first_asked || x >= right || x <= left - LANES)
        continue;

      /* 4. LANES neighbours from column x: every near crossing */
      const int p = (y + margin) * stride + margin + x;
      const floats own = NODE(0);
      /* asked for early */
      const floats gx = LIT ? READ(p, tilts) : 0, gy = LIT ? READ(room + p, tilts) : 0;
      floats near = NONE, by_column = NONE;
      for (int e = 0; e < NEAR; ++e) {
        const floats a = NODE(row_at[e]), b = NODE(row_at[e] + 1);
        const floats raised = higher(near, FMA((floats)row_weight[e], b - a, a - own) * (1.0f / (e + 1)));
        near = !BLOCKS || e < near_rows ? raised : near;
      }
      for (int e = 0; e < NEAR_COLUMNS; ++e) {
        if (e >= near_columns)
          break;
        const floats a = NODE(column_at[e]), b = NODE(column_at[e] + back);
        by_column = higher(by_column, FMA((floats)column_weight[e], b - a, a - own) * (1.0f / (e + 1)));
      }
      floats slope = higher(near, by_column * max(steepness, 1e-6f));

      /* 5. the two steps of the ladder between which the node lies, by bisection; above[s] is rise[s] too
         high. The ladder below the level counts where nothing stands above the level */
      const floats height = higher(own - lowest, 0.0f);
      ints level = TO_INTS(height * height_scale) << bits;
      const ints falls = FALLS ? (ints)(above[0] < level) : (ints)0;
      level = FALLS ? falls ? TO_INTS(height * falling_scale) << bits : level : level;
      ints low[8], test = RUNG(8) >= level + RISE(8), lower, upper = test ? RUNG(15) : RUNG(8);
      for (int s = 0; s < 8; ++s)
        low[s] = test ? RUNG(8 + s) : RUNG(s);
      ints r1 = test ? RISE(9) : RISE(1), r2 = test ? RISE(10) : RISE(2), r3 = test ? RISE(11) : RISE(3);
      ints r4 = test ? RISE(12) : RISE(4), r5 = test ? RISE(13) : RISE(5), r6 = test ? RISE(14) : RISE(6);
      ints r7 = test ? RISE(15) : RISE(7);
      test = low[4] >= level + r4;
      upper = test ? upper : low[4];
      for (int s = 0; s < 4; ++s)
        low[s] = test ? low[4 + s] : low[s];
      r1 = test ? r5 : r1;
      r2 = test ? r6 : r2;
      r3 = test ? r7 : r3;
      test = low[2] >= level + r2;
      upper = test ? upper : low[2];
      low[0] = test ? low[2] : low[0];
      low[1] = test ? low[3] : low[1];
      r1 = test ? r3 : r1;
      test = low[1] >= level + r1;
      upper = test ? upper : low[1];
      lower = test ? low[1] : low[0];

      /* 6. both distances on the node's own ray, no farther than the map or the window goes */
      const ints xs = x + COUNT;
      ints last = min(u + warm, window);
      if (SIDES != PERIODIC && reciprocal < 1e8f) {
        const floats room_across = TO_FLOATS(shear > 0 ? cols - 1 - xs : xs) * reciprocal;
        last = room_across < (float)min(u, window) ? TO_INTS(room_across) : last;
      }
      last = more(last, 1);
      const ints t1 = more(less(lower & mask, last), 1), t2 = more(less(upper & mask, last), 1);
      floats far = higher(on_row(heights, own, p, x, y, t1, shear, reach, towards, rows, cols, margin),
                          on_row(heights, own, p, x, y, t2, shear, reach, towards, rows, cols, margin));
      if (FALLS) { /* and the one that stands highest of all */
        const ints t = more(less(above[0] & mask, last), 1);
        far = higher(far, on_row(heights, own, p, x, y, t, shear, reach, towards, rows, cols, margin));
      }
      /* 7. and the column crossings beside them: the nearer one's before, the farther one's behind */
      if (reciprocal < 1e8f) {
        const ints before = TO_INTS(steepness * TO_FLOATS(t1)), m1 = more(before, 1), m2 = before + 1;
        far = higher(far, higher(on_column(heights, own, p, x, y, u, m1, shear, reciprocal, reach, towards,
                                           rows, cols, margin),
                                 on_column(heights, own, p, x, y, u, m2, shear, reciprocal, reach, towards,
                                           rows, cols, margin)));
      }
      slope = higher(slope, far);
      if (BLOCKS) { /* downhill the end of the window is the horizon */
        slope = higher(slope, on_row(heights, own, p, x, y, last, shear, reach, towards, rows, cols, margin));
        if (reciprocal < 1e8f) {
          ints m = (int)(steepness * min(reach, (float)(u + warm)));
          m = SIDES == PERIODIC ? m : less(m, shear > 0 ? cols - 1 - xs : xs);
          slope = higher(slope, on_column(heights, own, p, x, y, u, more(m, 1), shear, reciprocal, reach,
                                          towards, rows, cols, margin));
        }
      }
      slope *= rows_per_spacing;
      if (SIDES == DARK) { /* a wall half a node outside, up to height 0 */
        const floats wall = TO_FLOATS(shear > 0 ? 2 * (cols - xs) - 1 : 2 * xs + 1) * (0.5f * reciprocal),
                     to_row = u + 0.5f;
        slope = higher(slope, -own * rows_per_spacing / (wall < to_row ? wall : to_row));
      }
      __global float *plane = slopes + ((size_t)get_group_id(1) * rows + y) * cols;
      if (known && LANES > 1 && x >= 0 && column_of(x, strip, LANES - 1, cols) == x + LANES - 1)
        slope = higher(slope, READ(x, plane));
      else if (known)
        for (int l = 0; l < LANES; ++l) {
          const int c = column_of(x, strip, l, cols);
          if (c >= 0)
            LANE(float, slope, l) = max(LANE(float, slope, l), plane[c]);
        }

      /* 8. the slope, its angle from the zenith, or the light between horizon or tangent plane and zenith */
      if (WHAT == SLOPES) {
        for (int l = 0; l < LANES; ++l) {
          const int c = column_of(x, strip, l, cols);
          if (c >= 0)
            plane[c] = LANE(float, slope, l) < -1e20f ? -INFINITY : LANE(float, slope, l);
        }
        continue;
      }
      floats light;
      if (WHAT == ANGLES) {
        const floats angle = arctan(fabs(slope)), up = slope < 0 ? -angle : angle;
        light = width * (HALF_PI - (slope < -1e20f ? (floats)0 : up));
      } else {
        const floats along = gx * cosine + gy * sine, limit = higher(higher(slope, -along), 0.0f);
        floats c1, c2;
        if (WHAT == UNIFORM) {
          c2 = RECIPROCAL(limit * limit + 1.0f);
          c1 = 0.5f * (HALF_PI - arctan(limit) - limit * c2);
          c2 *= 0.5f;
        } else {
          const floats at = limit * RECIPROCAL(limit + 1.0f) * (float)(knots - 1);
          const ints knot = less(TO_INTS(at), knots - 2);
          const floats part = at - TO_FLOATS(knot);
          for (int l = 0; l < LANES; ++l) {
            const float4 entry = table[(size_t)k * knots + LANE(int, knot, l)];
            LANE(float, c1, l) = FMA(LANE(float, part, l), entry.z, entry.x);
            LANE(float, c2, l) = FMA(LANE(float, part, l), entry.w, entry.y);
          }
        }
        light = (along * c1 + c2) * (width * RECIPROCAL_ROOT(gx * gx + (gy * gy + 1.0f)));
      }
      const ints share = TO_INTS(light + 0.5f);
      if (ON_CPU && x >= 0 && column_of(x, strip, LANES - 1, cols) == x + LANES - 1)
        ADD_ALL(sum + y * cols + x, share);
      else
        for (int l = 0; l < LANES; ++l) {
          const int c = column_of(x, strip, l, cols);
          if (c >= 0)
            ADD(sum + y * cols + c, LANE(int, share, l));
        }
    }
  }
}
