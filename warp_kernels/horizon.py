"""Horizons, and the light of a sky above them, by sweeps along lines that pass the map in one azimuth.

The horizon's slope at a node is the largest (height - own height) / distance over every crossing of the
azimuth's vertical plane with a row or column of the grid. Nearer than NEAR rows all crossings are tested,
exactly. Farther away a line that passes within half a node carries, for each slope s of a ladder, the
crossing that stands highest above a ray of that slope, max (height - s distance), as one integer: quantized
height above the ray, and the distance in its lowest bits. The two steps of the ladder between which the
node's own height lies give the two crossings between which the true one lies; both, and a column crossing
beside each, are then looked up on the node's own ray, exactly.

The map is turned so that rays go from row to row: azimuths nearer to the columns' direction belong to the
turned map.

  heights      (room)                float32 [spacing]  the padded map, (rows + 2 margin, cols + 2 margin);
                                                        -1e30 outside, -2e30 masked
  tilts        (2, room)             float32 [1]        d depth/dx and d depth/dy, padded likewise
  azimuths     (count, 8)            float32            columns per row towards the source, cosine and sine of
                                                        the azimuth in this map, the slope's unit (rows per
                                                        spacing), width [rad x unit of the sum], 1 / |columns
                                                        per row| or 1e9, reach [rows], 0
  ways         (count, 8)            int32              1 if the source lies towards row 0, else -1; near
                                                        rows; near columns; rows before the first from which a
                                                        map that repeats is swept; window [rows]; number
                                                        of its sum; 0, 0
  near_at      (count, n, 2)         int32              the first node of each near row (column) crossing:
                                                        columns on, rows on; n = NEAR + NEAR_COLUMNS
  near_weight  (count, n)            float32            weight of the farther node of each
  table        (count, knots)        vec4               brightness: integrals over elevation of B cos^2 and B
                                                        sin cos from tangent / (1 + tangent) = i / (knots -
                                                        1) to the zenith, and what to add up to the next knot
  slopes       (count, rows x cols)  float32            in, out: horizon slopes [1], rise over distance
  sum          (sums, rows x cols)   int32              in, out: irradiance in fixed point, so that no order
                                                        of summation matters
  steps        (LADDER)              int32              the ladder: (s << bits) - 1
  rises        (LADDER)              int32              and s times the distance at which a crossing comes in
  falling_steps, falling_rises (LADDER)  int32          both of a ladder of slopes below the level
  first        int32                                    number of the first azimuth that is swept
  group        int32                                    threads of a block
  rows, cols   int32                                    of the map and the image, without the margin
  margin       int32                                    nodes round the map in heights and tilts
  room         int32                                    nodes of the padded map
  knots        int32                                    of the table
  bits         int32                                    of a candidate's integer that hold its distance [rows]
  lowest       float32 [spacing]                        least height of the map
  height_scale, falling_scale  float32 [1 / spacing]    steps of a candidate's integer per height, by both
                                                        ladders

Steps have the same numbers as in its twin, opencl/horizon.cl.
"""

import functools

import warp as wp

from skylamp.constants import (
    ANGLES,
    ARC_TANGENT,
    DARK,
    GPU_LINES,
    HALF_PI,
    LADDER,
    MOST_TILE,
    NONE,
    PERIODIC,
    SLOPES,
    TABLE,
    TILE_ROWS,
    UNIFORM,
    UNSEEN,
)

from . import OPTIONS

A0, A1, A2, A3, A4, A5, A6, A7 = (f"{factor!r}f" for factor in ARC_TANGENT)

rungs = wp.types.vector(LADDER, wp.int32)
eight = wp.types.vector(8, wp.int32)


@wp.func
def around(v: wp.int32, period: wp.int32):
    w = v % period
    if w < 0:
        w += period
    return w


# What Warp lacks: shared memory, and a test for the device.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 1;
#else
return 0;
#endif
""")
def on_gpu() -> wp.int32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def barrier(): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
float value;
asm volatile("ld.shared.f32 %0, [%1];" : "=f"(value) : "r"(at));
return value;
#else
return 0.0f;
#endif
""")
def kept(at: wp.int32) -> wp.float32: ...


# What costs Warp many instructions: an index into an array, an exact reciprocal, a root.
READ = """
#if defined(__CUDA_ARCH__)
return __ldg(map.data + i);
#else
return map.data[i];
#endif
"""  # of what no kernel writes at the time


@wp.func_native(READ)
def read(map: wp.array[wp.float32], i: wp.int32) -> wp.float32: ...


@wp.func_native(READ)
def read2(map: wp.array2d[wp.float32], i: wp.int32) -> wp.float32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
atomicAdd(map.data + i, value);
#else
map.data[i] += value;
#endif
""")
def add(map: wp.array[wp.int32], i: wp.int32, value: wp.int32): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
float r;
asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
return r;
#else
return 1.0f / v;
#endif
""")
def reciprocal_of(v: wp.float32) -> wp.float32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
float r;
asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
return r;
#else
return 1.0f / sqrtf(v);
#endif
""")
def reciprocal_root(v: wp.float32) -> wp.float32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __float2int_rd(v);
#else
return (int)floorf(v);
#endif
""")
def floor_of(v: wp.float32) -> wp.int32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return fmaf(weight, b - a, a - own);
#else
return a - own + weight * (b - a);
#endif
""")
def stands(a: wp.float32, b: wp.float32, weight: wp.float32, own: wp.float32) -> wp.float32:
    """How far the ground between nodes of heights a and b stands above ``own``."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
#define TIMES(a, b, c) fmaf(a, b, c)
#else
#define TIMES(a, b, c) ((a) * (b) + (c))
#endif
float q = r * r, p = TIMES({A0}, q, {A1});
p = TIMES(p, q, {A2});
p = TIMES(p, q, {A3});
p = TIMES(p, q, {A4});
p = TIMES(p, q, {A5});
p = TIMES(p, q, {A6});
p = TIMES(p, q, {A7});
#undef TIMES
return p * r;
""")
def arctan(r: wp.float32) -> wp.float32:
    """Of 0 <= r <= 1 to 2e-7, by a polynomial fitted for least maximum error."""
    ...


@wp.func
def elevation_of(slope: wp.float32):
    """The angle [rad] whose tangent is ``slope`` >= 0."""
    angle = arctan(wp.where(slope > 1.0, reciprocal_of(slope), slope))
    return wp.where(slope > 1.0, wp.float32(HALF_PI) - angle, angle)


@wp.func
def quantized(
    a: wp.float32,
    b: wp.float32,
    weight: wp.float32,
    lowest: wp.float32,
    height_scale: wp.float32,
    bits: wp.int32,
    distance: wp.int32,
):
    """Ground of the line between two nodes, quantized, with the distance at which it comes in."""
    ground = a + weight * (b - a)
    if a == NONE:  # beside the map the border goes on; a masked node is a gap
        ground = b
    elif b == NONE:
        ground = a
    if ground < -1e20:
        return UNSEEN
    return (wp.int32(wp.max(ground - lowest, wp.float32(0.0)) * height_scale) << bits) | distance


@wp.func
def enters(line: wp.int32, count: wp.int32, shear: wp.float32, reciprocal: wp.float32, cols: wp.int32):
    """From which row on one of ``count`` lines is on the map."""
    return wp.max(
        wp.int32(wp.floor(wp.float32(wp.where(shear > 0.0, line - cols, -line - count)) * reciprocal)), 0
    )


@wp.func
def leaves(
    line: wp.int32,
    count: wp.int32,
    shear: wp.float32,
    reciprocal: wp.float32,
    stop: wp.int32,
    left: wp.int32,
    right: wp.int32,
):
    """Up to which row it may be in columns ``left`` to ``right`` - 1."""
    return wp.min(
        wp.int32(wp.float32(wp.where(shear > 0.0, line + count - left, right - line)) * reciprocal) + 2, stop
    )


@wp.func
def column_of(line: wp.int32, u: wp.int32, shear: wp.float32):
    """Where a line passes row u."""
    return line + wp.int32(wp.floor(wp.float32(0.5) - shear * wp.float32(u)))


@wp.func
def node_of(
    line: wp.int32,
    u: wp.int32,
    shear: wp.float32,
    towards: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
):
    """Where the node of a line in row u lies in a padded map, or the nearest one of that row."""
    x = wp.clamp(column_of(line, u, shear), -margin, cols + margin - 1)
    return (wp.where(towards > 0, u, rows - 1 - u) + margin) * (cols + 2 * margin) + margin + x


SHARED = """
#if defined(__CUDA_ARCH__)
__shared__ float tile[%d];
return (int)__cvta_generic_to_shared(tile);
#else
return 0;
#endif
"""  # body of a native function of sweep: the byte at which a block's tile lies

FILL = f"""
#if defined(__CUDA_ARCH__)
const int own = min(max(first_column + j, -margin), cols + margin - 1);
const int beyond_lines = min(max(first_column + {GPU_LINES} + j, -margin), cols + margin - 1);
#pragma unroll
for (int e = 0; e < TALL; ++e) {{
  const int r = towards > 0 ? first_row + e : rows - 1 - first_row - e;
  const float* row = map.data + (min(max(r, -margin), rows + margin - 1) + margin) * stride + margin;
  const int at = tile + 4 * (e * PITCH + j);
  asm volatile("st.shared.f32 [%0], %1;" : : "r"(at), "f"(__ldg(row + own)));
  if (j < PITCH - {GPU_LINES})
    asm volatile("st.shared.f32 [%0], %1;" : : "r"(at + {4 * GPU_LINES}), "f"(__ldg(row + beyond_lines)));
}}
#endif
"""  # and of one that fills it


@functools.cache
def rays(SIDES: int, BLOCKS: int):
    """(on_row, on_column): slopes along a node's own ray."""

    @wp.func
    def neighbour_of(
        p: wp.int32,
        x: wp.int32,
        y: wp.int32,
        dx: wp.int32,
        dy: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        margin: wp.int32,
    ):
        """Where the node dx columns and dy rows beside the node at p, (x, y), lies: on a map that repeats,
        round its sides.
        """
        if wp.static(SIDES == PERIODIC):
            return (around(y + dy, rows) + margin) * (cols + 2 * margin) + margin + around(x + dx, cols)
        return p + (cols + 2 * margin) * dy + dx

    @wp.func
    def rise(
        heights: wp.array[wp.float32],
        i: wp.int32,
        j: wp.int32,
        weight: wp.float32,
        distance: wp.float32,
        reach: wp.float32,
        own: wp.float32,
    ):
        """Slope to where a ray crosses the grid line between nodes i and j, at a distance."""
        slope = stands(read(heights, i), read(heights, j), weight, own) * reciprocal_of(distance)
        if wp.static(BLOCKS != 0) and distance > reach:
            slope = NONE
        return slope

    @wp.func
    def on_row(
        heights: wp.array[wp.float32],
        own: wp.float32,
        p: wp.int32,
        x: wp.int32,
        y: wp.int32,
        t: wp.int32,
        shear: wp.float32,
        reach: wp.float32,
        towards: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        margin: wp.int32,
    ):
        """The crossing with the row t rows on of the ray of the node at column x, row y."""
        distance = wp.float32(t)
        across = shear * distance
        n = floor_of(across)
        at = neighbour_of(p, x, y, n, -towards * t, rows, cols, margin)
        return rise(heights, at, at + 1, across - wp.float32(n), distance, reach, own)

    @wp.func
    def on_column(
        heights: wp.array[wp.float32],
        own: wp.float32,
        p: wp.int32,
        x: wp.int32,
        y: wp.int32,
        u: wp.int32,
        m: wp.int32,
        shear: wp.float32,
        reciprocal: wp.float32,
        reach: wp.float32,
        towards: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        margin: wp.int32,
    ):
        """The crossing with the column m columns on, which counts if it is within reach."""
        distance = wp.float32(m) * reciprocal
        n = wp.int32(distance)
        before = n
        if wp.static(SIDES != PERIODIC):
            before = wp.min(n, u + 1)
        at = neighbour_of(p, x, y, wp.where(shear > 0.0, m, -m), -towards * before, rows, cols, margin)
        return rise(
            heights, at, at - towards * (cols + 2 * margin), distance - wp.float32(n), distance, reach, own
        )

    return on_row, on_column


@functools.cache
def sweep(NEAR: int, SIDES: int, WHAT: int, FALLS: int, BLOCKS: int):
    """WHAT: SLOPES writes slopes, UNIFORM adds the light of a uniform sky, TABLE that of ``table``, ANGLES
    the angle from the zenith to the horizon [rad] times the width; a horizon without ground counts as level.
    SIDES: OPEN, DARK or PERIODIC. FALLS: slopes below the level are searched for. BLOCKS: the window is not
    endless. known: slopes holds what is known already. backward: rows at the far end of the window come in,
    and blocks of one window are swept from the last row to the first; with a forward sweep by blocks it
    covers exactly one window before every node. top, bottom, left, right: slopes and sums are computed in
    rows top .. bottom - 1 and columns left .. right - 1, and undefined outside, where ground only occludes.

    Thread (g, k, j) owns one line of azimuth k; long lines start first.
    """
    NEAR_COLUMNS = NEAR - 1
    nears, weights = wp.types.vector(NEAR, wp.int32), wp.types.vector(NEAR, wp.float32)
    column_nears, column_weights = (
        wp.types.vector(NEAR_COLUMNS, wp.int32),
        wp.types.vector(NEAR_COLUMNS, wp.float32),
    )
    on_row, on_column = rays(SIDES, BLOCKS)
    PITCH = GPU_LINES + TILE_ROWS + NEAR + 8
    TALL = TILE_ROWS + NEAR + 1
    TILE = TALL * PITCH
    TILED = not BLOCKS and SIDES != PERIODIC and TILE <= MOST_TILE  # on a GPU
    LIT = WHAT in (UNIFORM, TABLE)
    # tilts are asked for a row ahead: the four warps of a scheduler, at 128 registers, do not hide the way to
    # memory, which took 9 % of a sweep of an H200 (sky of 64 azimuths, 4096 x 4096: 25.8 to 23.5 ms)
    AHEAD = TILED and LIT

    @wp.func_native(SHARED % (TILE if TILED else 1))
    def tile_of() -> wp.int32: ...

    @wp.func_native(FILL.replace("TALL", str(TALL)).replace("PITCH", str(PITCH)))
    def fill(
        tile: wp.int32,
        map: wp.array[wp.float32],
        j: wp.int32,
        first_row: wp.int32,
        first_column: wp.int32,
        towards: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        margin: wp.int32,
        stride: wp.int32,
    ):
        """The rows from ``first_row`` on, and the columns from ``first_column`` on, of a block's tile."""
        ...

    @wp.func
    def node(heights: wp.array[wp.float32], at: wp.int32):
        """Of the tile, at a byte, or of the map."""
        if wp.static(TILED) and on_gpu() != 0:
            return kept(at)
        return read(heights, at)

    # 128 registers; on an H200 85 and 170 take 8 and 24 % more time
    @wp.kernel(module="unique", module_options=OPTIONS, launch_bounds=(GPU_LINES, 4))
    def sweep(
        heights: wp.array[wp.float32],
        tilts: wp.array2d[wp.float32],
        azimuths: wp.array2d[wp.float32],
        ways: wp.array2d[wp.int32],
        near_at: wp.array3d[wp.int32],
        near_weight: wp.array2d[wp.float32],
        table: wp.array2d[wp.vec4],
        slopes: wp.array2d[wp.float32],
        sum: wp.array2d[wp.int32],
        steps: rungs,
        rises: rungs,
        falling_steps: rungs,
        falling_rises: rungs,
        first: wp.int32,
        group: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        margin: wp.int32,
        room: wp.int32,
        knots: wp.int32,
        bits: wp.int32,
        lowest: wp.float32,
        height_scale: wp.float32,
        falling_scale: wp.float32,
        known: wp.int32,
        backward: wp.int32,
        top: wp.int32,
        bottom: wp.int32,
        left: wp.int32,
        right: wp.int32,
    ):
        g, plane, j = wp.tid()
        k = plane + first
        shear = azimuths[k, 0]
        cosine = azimuths[k, 1]
        sine = azimuths[k, 2]
        rows_per_spacing = azimuths[k, 3]
        width = azimuths[k, 4]
        reciprocal = azimuths[k, 5]
        reach = azimuths[k, 6]
        steepness = wp.abs(shear)
        towards = ways[k, 0]
        near_rows = ways[k, 1]
        near_columns = ways[k, 2]
        warm = ways[k, 3]
        window = ways[k, 4]
        own_sum = sum[ways[k, 5]]

        stride = cols + 2 * margin
        mask = (1 << bits) - 1
        back = -towards * stride
        element = wp.int32(1)  # of an offset
        tile = wp.int32(0)
        if wp.static(TILED) and on_gpu() != 0:
            tile = tile_of()
            element = wp.int32(4)
            back = wp.static(-4 * PITCH)

        # 1. which lines, the longest first, and from which row to which they are on the map
        overhang = wp.int32(steepness * wp.float32(rows)) + 1
        if wp.static(SIDES == PERIODIC):
            overhang = wp.int32(0)
        groups = (cols + overhang + group - 1) // group
        if g >= groups:
            return
        order = groups // 2 + g // 2
        if g % 2 == 1:
            order = groups // 2 - (g + 1) // 2
        first_line = order * group
        beyond = cols
        if shear < 0.0:
            first_line -= overhang
        elif shear > 0.0:
            beyond += overhang
        line = first_line + j
        first_asked = wp.where(towards > 0, top, rows - bottom)
        end = wp.where(towards > 0, bottom, rows - top)
        start = -warm
        stop = end
        if wp.static(SIDES != PERIODIC) and reciprocal < 1e8:
            start = enters(line, 1, shear, reciprocal, cols)
            stop = leaves(line, 1, shear, reciprocal, end, left, right)
        if line >= beyond:
            stop = start
        begin = start
        finish = stop
        if wp.static(BLOCKS != 0) and backward != 0:
            begin -= (start + warm) % window
            finish += window - 1 - (stop - 1 + warm) % window
        if wp.static(TILED) and on_gpu() != 0:  # the threads of a block go together
            begin = wp.int32(0)
            finish = end
            if reciprocal < 1e8:
                begin = enters(first_line, GPU_LINES, shear, reciprocal, cols)
                finish = leaves(first_line, GPU_LINES, shear, reciprocal, end, left, right)

        row_at = nears()
        row_weight = weights()
        for e in range(NEAR):
            row_at[e] = near_at[k, e, 0] * element + near_at[k, e, 1] * back
            row_weight[e] = near_weight[k, e]
        column_at = column_nears()
        column_weight = column_weights()
        for e in range(NEAR_COLUMNS):
            column_at[e] = near_at[k, NEAR + e, 0] * element + near_at[k, NEAR + e, 1] * back
            column_weight[e] = near_weight[k, NEAR + e]

        # 2. the ladder: nothing visible yet
        above = rungs()
        below = rungs()
        for s in range(LADDER):
            above[s] = UNSEEN
            if wp.static(FALLS != 0):
                below[s] = UNSEEN
        turn = wp.int32(-1)
        comes_at = wp.int32(NEAR + 1)
        if wp.static(BLOCKS != 0) and backward != 0:
            turn = wp.int32(1)
            comes_at = window
        here = wp.int32(0)
        gx = wp.float32(0.0)
        gy = wp.float32(0.0)
        gx_ahead = wp.float32(0.0)
        gy_ahead = wp.float32(0.0)
        if wp.static(AHEAD) and begin < finish:
            ahead = node_of(line, begin, shear, towards, rows, cols, margin)
            gx_ahead = read2(tilts, ahead)
            gy_ahead = read2(tilts, room + ahead)

        for i in range(begin, finish):
            u = wp.int32(i)
            into = wp.int32(1)
            if wp.static(BLOCKS != 0):
                into = (i + warm) % window
                if backward != 0:
                    u = i - 2 * into + window - 1
            comes = u - comes_at
            if wp.static(TILED) and on_gpu() != 0:
                if (
                    i - begin
                ) % TILE_ROWS == 0:  # TILE_ROWS rows, and those before them that are near or come in
                    first_row = i - wp.static(NEAR + 1)
                    first_column = (
                        first_line
                        + wp.int32(
                            wp.floor(
                                wp.float32(0.5)
                                - shear
                                * wp.float32(wp.where(shear > 0.0, i + wp.static(TILE_ROWS - 1), first_row))
                            )
                        )
                        - 2
                    )
                    barrier()
                    fill(tile, heights, j, first_row, first_column, towards, rows, cols, margin, stride)
                    barrier()
                    here = tile - 4 * (first_row * PITCH + first_column)

            # 3. the row that comes in, quantized; then every ray climbs (or, backward, falls) by one row
            if into == 0:
                for s in range(LADDER):
                    above[s] = UNSEEN
                    if wp.static(FALLS != 0):
                        below[s] = UNSEEN
            seen = UNSEEN
            seen_falling = UNSEEN
            arrives = (comes >= start and comes < stop) or wp.static(SIDES == PERIODIC)
            if wp.static(BLOCKS != 0) and backward == 0 and into <= NEAR:
                arrives = False
            if arrives:
                across = -shear * wp.float32(comes)
                column = wp.floor(across)
                cx = line + wp.int32(column)
                cy = comes
                if wp.static(SIDES == PERIODIC):
                    cx = around(cx, cols)
                    cy = around(cy, rows)
                if towards < 0:
                    cy = rows - 1 - cy
                at = (cy + margin) * stride + margin + cx
                if wp.static(TILED) and on_gpu() != 0:
                    at = here + 4 * (comes * PITCH + cx)
                a = node(heights, at)
                b = node(heights, at + element)
                seen = quantized(a, b, across - column, lowest, height_scale, bits, comes_at)
                if wp.static(FALLS != 0):
                    seen_falling = quantized(a, b, across - column, lowest, falling_scale, bits, comes_at)
            for s in range(LADDER):
                above[s] = wp.max(above[s] + turn * steps[s], seen)
                if wp.static(FALLS != 0):
                    below[s] = wp.max(below[s] + turn * falling_steps[s], seen_falling)

            if wp.static(AHEAD):
                gx = gx_ahead
                gy = gy_ahead
                if u + 1 < stop:
                    ahead = node_of(line, u + 1, shear, towards, rows, cols, margin)
                    gx_ahead = read2(tilts, ahead)
                    gy_ahead = read2(tilts, room + ahead)
            x = column_of(line, u, shear)
            if wp.static(SIDES == PERIODIC):
                x = around(x, cols)
            if u >= wp.max(start, first_asked) and u < stop and x >= left and x < right:
                # 4. the node of this row: every near crossing
                y = wp.where(towards > 0, u, rows - 1 - u)
                p = (y + margin) * stride + margin + x
                spot = p
                if wp.static(TILED) and on_gpu() != 0:
                    spot = here + 4 * (u * PITCH + x)
                own = node(heights, spot)
                if wp.static(LIT and not AHEAD):  # asked for early
                    gx = read2(tilts, p)
                    gy = read2(tilts, room + p)
                near = NONE
                for e in range(NEAR):
                    at_row = spot + row_at[e]
                    raised = wp.max(
                        near,
                        stands(node(heights, at_row), node(heights, at_row + element), row_weight[e], own)
                        * wp.static(wp.float32(1.0 / (e + 1))),
                    )
                    near = wp.where(wp.static(BLOCKS == 0) or e < near_rows, raised, near)
                by_column = NONE
                for e in range(NEAR_COLUMNS):
                    if e < near_columns:
                        at_column = spot + column_at[e]
                        by_column = wp.max(
                            by_column,
                            stands(
                                node(heights, at_column),
                                node(heights, at_column + back),
                                column_weight[e],
                                own,
                            )
                            * wp.static(wp.float32(1.0 / (e + 1))),
                        )
                slope = wp.max(near, by_column * wp.max(steepness, wp.float32(1e-6)))

                # 5. the two steps of the ladder between which the node lies, by bisection; above[s] is
                # rises[s] too high. The ladder below the level counts where nothing stands above the level
                height = wp.max(own - lowest, wp.float32(0.0))
                level = wp.int32(height * height_scale) << bits
                rung = above
                rise = rises
                if wp.static(FALLS != 0):
                    falls = above[0] < level
                    level = wp.where(falls, wp.int32(height * falling_scale) << bits, level)
                    for s in range(LADDER):
                        rung[s] = wp.where(falls, below[s], above[s])
                        rise[s] = wp.where(falls, falling_rises[s], rises[s])
                test = rung[8] >= level + rise[8]
                low = eight()
                limits = eight()
                for s in range(8):
                    low[s] = wp.where(test, rung[8 + s], rung[s])
                    limits[s] = wp.where(test, rise[8 + s], rise[s])
                upper = wp.where(test, rung[15], rung[8])
                test = low[4] >= level + limits[4]
                upper = wp.where(test, upper, low[4])
                for s in range(4):
                    low[s] = wp.where(test, low[4 + s], low[s])
                    limits[s] = wp.where(test, limits[4 + s], limits[s])
                test = low[2] >= level + limits[2]
                upper = wp.where(test, upper, low[2])
                for s in range(2):
                    low[s] = wp.where(test, low[2 + s], low[s])
                    limits[s] = wp.where(test, limits[2 + s], limits[s])
                test = low[1] >= level + limits[1]
                upper = wp.where(test, upper, low[1])
                lower = wp.where(test, low[1], low[0])

                # 6. both distances on the node's own ray, no farther than the map or the window goes
                last = wp.min(u + warm, window)
                if wp.static(SIDES != PERIODIC) and reciprocal < 1e8:
                    room_across = wp.float32(wp.where(shear > 0.0, cols - 1 - x, x)) * reciprocal
                    if room_across < wp.float32(wp.min(u, window)):
                        last = wp.int32(room_across)
                last = wp.max(last, 1)
                t1 = wp.max(wp.min(lower & mask, last), 1)
                t2 = wp.max(wp.min(upper & mask, last), 1)
                far = wp.max(
                    on_row(heights, own, p, x, y, t1, shear, reach, towards, rows, cols, margin),
                    on_row(heights, own, p, x, y, t2, shear, reach, towards, rows, cols, margin),
                )
                if wp.static(FALLS != 0):  # and the one that stands highest of all
                    t = wp.max(wp.min(above[0] & mask, last), 1)
                    far = wp.max(
                        far, on_row(heights, own, p, x, y, t, shear, reach, towards, rows, cols, margin)
                    )
                # 7. and the column crossings beside them: the nearer one's before, the farther one's behind
                if reciprocal < 1e8:
                    before = wp.int32(steepness * wp.float32(t1))
                    far = wp.max(
                        far,
                        on_column(
                            heights,
                            own,
                            p,
                            x,
                            y,
                            u,
                            wp.max(before, 1),
                            shear,
                            reciprocal,
                            reach,
                            towards,
                            rows,
                            cols,
                            margin,
                        ),
                    )
                    far = wp.max(
                        far,
                        on_column(
                            heights,
                            own,
                            p,
                            x,
                            y,
                            u,
                            before + 1,
                            shear,
                            reciprocal,
                            reach,
                            towards,
                            rows,
                            cols,
                            margin,
                        ),
                    )
                slope = wp.max(slope, far)
                if wp.static(BLOCKS != 0):  # downhill the end of the window is the horizon
                    slope = wp.max(
                        slope, on_row(heights, own, p, x, y, last, shear, reach, towards, rows, cols, margin)
                    )
                    if reciprocal < 1e8:
                        m = wp.int32(steepness * wp.min(reach, wp.float32(u + warm)))
                        if wp.static(SIDES != PERIODIC):
                            m = wp.min(m, wp.where(shear > 0.0, cols - 1 - x, x))
                        slope = wp.max(
                            slope,
                            on_column(
                                heights,
                                own,
                                p,
                                x,
                                y,
                                u,
                                wp.max(m, 1),
                                shear,
                                reciprocal,
                                reach,
                                towards,
                                rows,
                                cols,
                                margin,
                            ),
                        )
                slope *= rows_per_spacing
                if wp.static(SIDES == DARK):  # a wall half a node outside, up to height 0
                    wall = wp.float32(wp.where(shear > 0.0, 2 * (cols - x) - 1, 2 * x + 1)) * (
                        wp.float32(0.5) * reciprocal
                    )
                    slope = wp.max(slope, -own * rows_per_spacing / wp.min(wall, wp.float32(u) + 0.5))

                # 8. the slope, its angle from the zenith, or the light between horizon or tangent plane and
                # zenith
                if x >= 0 and x < cols:
                    if known != 0:
                        slope = wp.max(slope, slopes[plane, y * cols + x])
                    if wp.static(WHAT == SLOPES):
                        if slope < -1e20:
                            slope = -wp.inf
                        slopes[plane, y * cols + x] = slope
                    elif wp.static(WHAT == ANGLES):
                        angle = elevation_of(wp.abs(slope))
                        angle = wp.where(slope < 0.0, -angle, angle)
                        angle = wp.where(slope < -1e20, wp.float32(0.0), angle)
                        angle = width * (wp.float32(HALF_PI) - angle)
                        add(own_sum, y * cols + x, wp.int32(angle + 0.5))
                    else:
                        along = gx * cosine + gy * sine
                        limit = wp.max(wp.max(slope, -along), wp.float32(0.0))
                        c1 = wp.float32(0.0)
                        c2 = wp.float32(0.0)
                        if wp.static(WHAT == UNIFORM):
                            c2 = reciprocal_of(limit * limit + 1.0)
                            c1 = 0.5 * (wp.float32(HALF_PI) - elevation_of(limit) - limit * c2)
                            c2 *= 0.5
                        else:
                            at_knot = limit * reciprocal_of(limit + 1.0) * wp.float32(knots - 1)
                            knot = wp.min(wp.int32(at_knot), knots - 2)
                            entry = table[k, knot]
                            part = at_knot - wp.float32(knot)
                            c1 = entry[0] + part * entry[2]
                            c2 = entry[1] + part * entry[3]
                        light = (along * c1 + c2) * (width * reciprocal_root(gx * gx + (gy * gy + 1.0)))
                        add(own_sum, y * cols + x, wp.int32(light + 0.5))

    return sweep
