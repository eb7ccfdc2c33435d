"""Horizons, and the light of a sky above them, by sweeps along lines that pass the map in one azimuth.

The method and the arguments are told in opencl/horizon.cl, whose steps have the same numbers. Twin of opencl/horizon.cl.
"""

import functools

import warp as wp

from . import LINES, OPTIONS

LADDER = 16
NONE = wp.constant(wp.float32(-1e30))
UNSEEN = wp.constant(wp.int32(1 - (1 << 30)))  # far below all ground, one row away
OPEN, DARK, PERIODIC = range(3)  # SIDES
SLOPES, UNIFORM, TABLE = range(3)  # WHAT

rungs = wp.types.vector(LADDER, wp.int32)
eight = wp.types.vector(8, wp.int32)


@wp.func
def around(v: wp.int32, period: wp.int32):
    w = v % period
    if w < 0:
        w += period
    return w


# What costs Warp many instructions: an index into an array, an exact reciprocal, a root.
@wp.func_native("return map.data[i];")
def read(map: wp.array[wp.float32], i: wp.int32) -> wp.float32: ...


@wp.func_native("return map.data[i];")
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
return rsqrtf(v);
#else
return 1.0f / sqrtf(v);
#endif
""")
def reciprocal_root(v: wp.float32) -> wp.float32: ...


@wp.func_native("""
const float *a = map.data + i;
#if defined(__CUDA_ARCH__)
return fmaf(weight, a[next] - a[0], a[0] - own);
#else
return a[0] - own + weight * (a[next] - a[0]);
#endif
""")
def stands(map: wp.array[wp.float32], i: wp.int32, next: wp.int32, weight: wp.float32, own: wp.float32) -> wp.float32:
    """How far the ground between element i and the one ``next`` elements on stands above ``own``."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return fmaf(c[2], c[1] - c[0], c[0] - own) * c[3];
#else
return (c[0] - own + c[2] * (c[1] - c[0])) * c[3];
#endif
""")
def rise(c: wp.vec4, own: wp.float32) -> wp.float32:
    """Slope to a crossing: heights of its grid line's two nodes, weight of the second, 1 / distance."""
    ...


@wp.func
def look(heights: wp.array[wp.float32], at: wp.int32, weight: wp.float32, lowest: wp.float32, unit: wp.float32, bits: wp.int32, distance: wp.int32):
    """Height of the line at a row, quantized, with the distance at which it comes in."""
    a = read(heights, at)
    b = read(heights, at + 1)
    ground = a + weight * (b - a)
    if a == NONE:  # beside the map the border goes on; a masked node is a gap
        ground = b
    elif b == NONE:
        ground = a
    if ground < -1e20:
        return UNSEEN
    return (wp.int32(wp.max(ground - lowest, wp.float32(0.0)) * unit) << bits) | distance


@functools.cache
def rays(SIDES: int, BLOCKS: int):
    """(on_row, on_column): slopes along a node's own ray."""

    @wp.func
    def beside_of(p: wp.int32, x: wp.int32, y: wp.int32, dx: wp.int32, dy: wp.int32, rows: wp.int32, cols: wp.int32, margin: wp.int32):
        """Where the node dx columns and dy rows beside the node at p, (x, y), lies: on a map that repeats, round its sides."""
        if wp.static(SIDES == PERIODIC):
            return (around(y + dy, rows) + margin) * (cols + 2 * margin) + margin + around(x + dx, cols)
        return p + (cols + 2 * margin) * dy + dx

    @wp.func
    def on_row(
        heights: wp.array[wp.float32],
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
        n = wp.int32(across)
        if across < wp.float32(n):
            n -= 1
        at = beside_of(p, x, y, n, -towards * t, rows, cols, margin)
        a = read(heights, at)
        b = read(heights, at + 1)
        if wp.static(BLOCKS != 0) and distance > reach:
            a = NONE
            b = NONE
        return wp.vec4(a, b, across - wp.float32(n), reciprocal_of(distance))


    @wp.func
    def on_column(
        heights: wp.array[wp.float32],
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
        at = beside_of(p, x, y, wp.where(shear > 0.0, m, -m), -towards * before, rows, cols, margin)
        a = read(heights, at)
        b = read(heights, at - towards * (cols + 2 * margin))
        if wp.static(BLOCKS != 0) and distance > reach:
            a = NONE
            b = NONE
        return wp.vec4(a, b, distance - wp.float32(n), reciprocal_of(distance))

    return on_row, on_column


@functools.cache
def sweep(NEAR: int, SIDES: int, WHAT: int, BLOCKS: int):
    """WHAT: SLOPES writes horizon slopes, UNIFORM adds the light of a uniform sky, TABLE that of ``table``; see opencl/horizon.cl.

    Thread (g, k, j) owns one line of azimuth k; long lines start first.
    """
    NEAR_COLUMNS = NEAR - 1
    nears, weights = wp.types.vector(NEAR, wp.int32), wp.types.vector(NEAR, wp.float32)
    column_nears, column_weights = wp.types.vector(NEAR_COLUMNS, wp.int32), wp.types.vector(NEAR_COLUMNS, wp.float32)
    on_row, on_column = rays(SIDES, BLOCKS)
    FETCH = not BLOCKS and SIDES != PERIODIC

    @wp.kernel(module="unique", module_options=OPTIONS, launch_bounds=LINES)
    def sweep(
        heights: wp.array[wp.float32],
        tilts: wp.array2d[wp.float32],
        azimuths: wp.array2d[wp.float32],
        ways: wp.array2d[wp.int32],
        near_at: wp.array2d[wp.int32],
        near_weight: wp.array2d[wp.float32],
        table: wp.array2d[wp.vec4],
        slopes: wp.array2d[wp.float32],
        sum: wp.array[wp.int32],
        steps: rungs,
        rises: rungs,
        first: wp.int32,
        groups: wp.int32,
        group: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        margin: wp.int32,
        room: wp.int32,
        knots: wp.int32,
        bits: wp.int32,
        lowest: wp.float32,
        unit: wp.float32,
        known: wp.int32,
        backward: wp.int32,
    ):
        g, plane, j = wp.tid()
        k = plane + first
        shear = azimuths[k, 0]
        cosine = azimuths[k, 1]
        sine = azimuths[k, 2]
        tangent = azimuths[k, 3]
        width = azimuths[k, 4]
        reciprocal = azimuths[k, 5]
        reach = azimuths[k, 6]
        steepness = wp.abs(shear)
        towards = ways[k, 0]
        near_rows = ways[k, 1]
        near_columns = ways[k, 2]
        warm = ways[k, 3]
        window = ways[k, 4]

        # 1. which lines, the longest first, and from which row to which they are on the map
        order = groups // 2 + g // 2
        if g % 2 == 1:
            order = groups // 2 - (g + 1) // 2
        overhang = wp.int32(steepness * wp.float32(rows)) + 1
        if wp.static(SIDES == PERIODIC):
            overhang = wp.int32(0)
        line = order * group + j
        end = cols
        if shear < 0.0:
            line -= overhang
        elif shear > 0.0:
            end += overhang
        if line >= end:
            return
        start = -warm
        stop = rows
        if wp.static(SIDES != PERIODIC) and reciprocal < 1e8:
            enters = wp.where(shear > 0.0, line - cols, -line - 1)
            leaves = wp.where(shear > 0.0, line + 1, cols - line)
            start = wp.max(wp.int32(wp.floor(wp.float32(enters) * reciprocal)), 0)
            stop = wp.min(wp.int32(wp.float32(leaves) * reciprocal) + 2, rows)

        row_at = nears()
        row_weight = weights()
        for e in range(NEAR):
            row_at[e] = near_at[k, e]
            row_weight[e] = near_weight[k, e]
        column_at = column_nears()
        column_weight = column_weights()
        for e in range(NEAR_COLUMNS):
            column_at[e] = near_at[k, NEAR + e]
            column_weight[e] = near_weight[k, NEAR + e]

        # 2. the ladder: nothing seen yet
        above = rungs()
        for s in range(LADDER):
            above[s] = UNSEEN
        stride = cols + 2 * margin
        back = -towards * stride
        mask = (1 << bits) - 1
        turn = wp.int32(-1)
        comes_at = wp.int32(NEAR + 1)
        begin = start
        finish = stop
        if wp.static(BLOCKS != 0) and backward != 0:
            turn = wp.int32(1)
            comes_at = window
            begin -= (start + warm) % window
            finish += window - 1 - (stop - 1 + warm) % window

        # The far crossings of a node are looked up in one turn of the loop and used in the next, when they have arrived.
        far1 = wp.vec4()
        far2 = wp.vec4()
        far3 = wp.vec4()
        far4 = wp.vec4()
        own_ = wp.float32(0.0)
        near_ = wp.float32(0.0)
        beyond_ = wp.float32(0.0)
        gx_ = wp.float32(0.0)
        gy_ = wp.float32(0.0)
        hidden_ = wp.bool(False)  # nothing far can rise above what is near
        waits = wp.bool(False)
        x_ = wp.int32(0)
        y_ = wp.int32(0)
        u_ = wp.int32(0)
        per_rung = unit * wp.float32(1 << bits) * wp.float32(comes_at)
        ahead = wp.float32(0.0)  # height of the next row's node, asked for one row before
        if wp.static(FETCH):
            row = wp.where(towards > 0, begin, rows - 1 - begin)
            ahead = read(heights, (row + margin) * stride + margin + line + wp.int32(wp.floor(wp.float32(0.5) - shear * wp.float32(begin))))
        for i in range(begin, finish + 1):
            u = wp.int32(i)
            into = wp.int32(1)
            if wp.static(BLOCKS != 0):
                into = (i + warm) % window
                if backward != 0:
                    u = i - 2 * into + window - 1
            here = i < finish and u >= wp.max(start, 0) and u < stop

            # 3. the node of this row: every near crossing
            v = u
            if wp.static(BLOCKS != 0 or SIDES == PERIODIC):  # what is looked up must be there
                v = wp.min(wp.max(u, wp.max(start, 0)), stop)
            x = line + wp.int32(wp.floor(wp.float32(0.5) - shear * wp.float32(v)))
            if wp.static(SIDES == PERIODIC):
                x = around(x, cols)
            y = wp.where(towards > 0, v, rows - 1 - v)
            p = (y + margin) * stride + margin + x
            own = ahead
            if wp.static(FETCH):
                ahead = read(heights, p + towards * stride + line + wp.int32(wp.floor(wp.float32(0.5) - shear * wp.float32(v + 1))) - x)
            else:
                own = read(heights, p)
            near = NONE
            gx = wp.float32(0.0)
            gy = wp.float32(0.0)
            if wp.static(WHAT != SLOPES):
                gx = read2(tilts, p)
                gy = read2(tilts, room + p)
            for e in range(NEAR):
                found = wp.max(near, stands(heights, p + row_at[e], 1, row_weight[e], own) * wp.static(wp.float32(1.0 / (e + 1))))
                near = wp.where(wp.static(BLOCKS == 0) or e < near_rows, found, near)
            beside = NONE
            for e in range(NEAR_COLUMNS):
                found = wp.max(beside, stands(heights, p + column_at[e], back, column_weight[e], own) * wp.static(wp.float32(1.0 / (e + 1))))
                beside = wp.where(e < near_columns, found, beside)
            near = wp.max(near, beside * wp.max(steepness, wp.float32(1e-6)))

            # 4. the node of the turn before: its horizon, and the light between it, or the tangent plane, and the zenith
            if waits:
                slope = near_
                if not hidden_:
                    slope = wp.max(wp.max(rise(far1, own_), rise(far2, own_)), near_)
                    if reciprocal < 1e8:
                        slope = wp.max(slope, wp.max(rise(far3, own_), rise(far4, own_)))
                if wp.static(BLOCKS != 0):
                    slope = wp.max(slope, beyond_)
                slope *= tangent
                if wp.static(SIDES == DARK):  # a wall half a node outside, up to height 0
                    wall = wp.float32(wp.where(shear > 0.0, 2 * (cols - x_) - 1, 2 * x_ + 1)) * (wp.float32(0.5) * reciprocal)
                    slope = wp.max(slope, -own_ * tangent / wp.min(wall, wp.float32(u_) + 0.5))
                if x_ >= 0 and x_ < cols:
                    if wp.static(BLOCKS != 0 or WHAT == SLOPES) and known != 0:
                        slope = wp.max(slope, slopes[plane, y_ * cols + x_])
                    if wp.static(WHAT == SLOPES):
                        if slope < -1e20:
                            slope = -wp.inf
                        slopes[plane, y_ * cols + x_] = slope
                    else:
                        along = gx_ * cosine + gy_ * sine
                        limit = wp.max(wp.max(slope, -along), wp.float32(0.0))
                        c1 = wp.float32(0.0)
                        c2 = wp.float32(0.0)
                        if wp.static(WHAT == UNIFORM):
                            c2 = reciprocal_of(limit * limit + 1.0)
                            c1 = 0.5 * (wp.float32(1.57079633) - wp.atan(limit) - limit * c2)
                            c2 *= 0.5
                        else:
                            at_knot = limit * reciprocal_root(limit * limit + 1.0) * wp.float32(knots - 1)
                            knot = wp.min(wp.int32(at_knot), knots - 2)
                            entry = table[k, knot]
                            part = at_knot - wp.float32(knot)
                            c1 = entry[0] + part * entry[2]
                            c2 = entry[1] + part * entry[3]
                        light = (along * c1 + c2) * (width * reciprocal_root(gx_ * gx_ + (gy_ * gy_ + 1.0)))
                        add(sum, y_ * cols + x_, wp.int32(light + 0.5))

            # 5. the row that comes in, quantized; then every ray climbs (or, backward, falls) by one row
            if into == 0:
                for s in range(LADDER):
                    above[s] = UNSEEN
            comes = u - comes_at
            seen = UNSEEN
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
                seen = look(heights, (cy + margin) * stride + margin + cx, across - column, lowest, unit, bits, comes_at)
            for s in range(LADDER):
                above[s] = wp.max(above[s] + turn * steps[s], seen)
            waits = here
            if here:
                # 6. the two steps of the ladder between which the node lies, by bisection; above[s] is rises[s] too high
                level = wp.int32(wp.max(own - lowest, wp.float32(0.0)) * unit) << bits
                test = above[8] >= level + rises[8]
                low = eight()
                limits = eight()
                for s in range(8):
                    low[s] = wp.where(test, above[8 + s], above[s])
                    limits[s] = wp.where(test, rises[8 + s], rises[s])
                upper = wp.where(test, above[15], above[8])
                rung = wp.where(test, wp.static(2**31 - 1), rises[8])  # of the upper step
                test = low[4] >= level + limits[4]
                upper = wp.where(test, upper, low[4])
                rung = wp.where(test, rung, limits[4])
                for s in range(4):
                    low[s] = wp.where(test, low[4 + s], low[s])
                    limits[s] = wp.where(test, limits[4 + s], limits[s])
                test = low[2] >= level + limits[2]
                upper = wp.where(test, upper, low[2])
                rung = wp.where(test, rung, limits[2])
                for s in range(2):
                    low[s] = wp.where(test, low[2 + s], low[s])
                    limits[s] = wp.where(test, limits[2 + s], limits[s])
                test = low[1] >= level + limits[1]
                upper = wp.where(test, upper, low[1])
                rung = wp.where(test, rung, limits[1])
                lower = wp.where(test, low[1], low[0])

                # 7. both distances on the node's own ray, no farther than the map or the window goes
                last = wp.min(u + warm, window)
                if wp.static(SIDES != PERIODIC) and reciprocal < 1e8:
                    room_beside = wp.float32(wp.where(shear > 0.0, cols - 1 - x, x)) * reciprocal
                    if room_beside < wp.float32(wp.min(u, window)):
                        last = wp.int32(room_beside)
                last = wp.max(last, 1)
                hidden_ = near * per_rung >= wp.float32(rung)
                if not hidden_:
                    t1 = wp.max(wp.min(lower & mask, last), 1)
                    t2 = wp.max(wp.min(upper & mask, last), 1)
                    far1 = on_row(heights, p, x, y, t1, shear, reach, towards, rows, cols, margin)
                    far2 = on_row(heights, p, x, y, t2, shear, reach, towards, rows, cols, margin)
                    # 8. and the column crossings beside them: the nearer one's before, the farther one's behind
                    if reciprocal < 1e8:
                        m1 = wp.max(wp.int32(steepness * wp.float32(t1)), 1)
                        m2 = wp.int32(steepness * wp.float32(t1)) + 1
                        far3 = on_column(heights, p, x, y, u, m1, shear, reciprocal, reach, towards, rows, cols, margin)
                        far4 = on_column(heights, p, x, y, u, m2, shear, reciprocal, reach, towards, rows, cols, margin)
                if wp.static(BLOCKS != 0):  # downhill the end of the window is the horizon
                    beyond_ = rise(on_row(heights, p, x, y, last, shear, reach, towards, rows, cols, margin), own)
                    if reciprocal < 1e8:
                        m3 = wp.int32(steepness * wp.min(reach, wp.float32(u + warm)))
                        if wp.static(SIDES != PERIODIC):
                            m3 = wp.min(m3, wp.where(shear > 0.0, cols - 1 - x, x))
                        m3 = wp.max(m3, 1)
                        beyond_ = wp.max(beyond_, rise(on_column(heights, p, x, y, u, m3, shear, reciprocal, reach, towards, rows, cols, margin), own))
                own_ = own
                near_ = near
                gx_ = gx
                gy_ = gy
                x_ = x
                y_ = y
                u_ = u

    return sweep
