"""Irradiance of a depth map and its derivatives, for the inverse problem (MODEL.md, 5.2). Twin of opencl/adjoint.cl.

E = (1 + |grad z|^2)^(-1/2) sum over slices of width x [C1(T) + s C2(T)], s = e . grad z, C1 and C2 the integrals of
B sin cos and of B cos^2 above the slope T: the largest of the level, the tangent plane, the wall, the source's own lower
edge and the horizon. Where the horizon is the limit, dE/dT goes to the two nodes beside its crossing, over its distance.

Shared arguments, lengths in spacings
  heights  (rows, cols + 2 margin)  float32  -z; in the margins -1e30, or the other side of a map that repeats
  tilts    (2, pixels)              float32  dz/dx, dz/dy by central differences, one-sided at the border
  tiles, top                        float32  the greatest height of every TILE x TILE nodes, and of all
  light    (5, pixels)              float32  out: E; dE by own depth, by dz/dx, by dz/dy; (1 + |grad z|^2)^(-1/2)
  pulls    (count, pixels)          float32  out: width x dF/dT / distance of the node that limits a slice, without the root
  at       (count, pixels)          int32    out: that crossing's first node, row << 16 | column, bit 30 set if the other is a
                                             row on, else a column on; -1: no node limits this slice
  shares   (count, pixels)          float32  out: weight of the second node
  table    (n, knots, 4)            float32  integrals of B cos^2 and of B sin cos from sin(elevation) = i / (knots - 1) to the
                                             zenith, and what to add up to the next knot; knots 0: brightness 1, closed form
  sides                             0 open, 1 dark, 2 periodic

All arithmetic is +, -, x, / and sqrt, correctly rounded and in one order, so that every backend finds the same bits.
"""

import warp as wp

from . import OPTIONS

wp.set_module_options(OPTIONS)

NONE = wp.constant(wp.float32(-1e30))
STEEP = wp.constant(wp.float32(1e6))  # as good as the zenith
ALONG = wp.constant(wp.float32(1e-6))  # closer to the grid is along it: n times -1e-9 would be a crossing all but on a node, and one of its two off the map
LEVEL = wp.constant(wp.float32(0.01))  # slope below which a map that repeats is not searched
SLACK = wp.constant(wp.float32(1.00001))  # what is left out must be lower by more than roundings
COLUMN = wp.constant(wp.int32(1 << 30))
BLOCK = wp.constant(wp.int32(64))  # nodes that a thread of a sum owns
TILE = wp.constant(wp.int32(8))
OPEN, DARK, PERIODIC = (wp.constant(wp.int32(side)) for side in range(3))


@wp.func
def arc_tangent(v: wp.float32):
    """Of v >= 0, to 2e-7, by a polynomial fitted for least maximum error."""
    r = v
    if v > 1.0:
        r = 1.0 / v
    q = r * r
    p = wp.float32(-0.0040545627)
    p = p * q + 0.021862943
    p = p * q - 0.055912301
    p = p * q + 0.096421957
    p = p * q - 0.13908629
    p = p * q + 0.19946566
    p = p * q - 0.33329859
    p = p * q + 0.99999934
    if v > 1.0:
        return 1.57079633 - p * r
    return p * r


@wp.func
def above(t: wp.float32, table: wp.array[wp.float32], row: wp.int32, next: wp.int32, share: wp.float32, knots: wp.int32):
    """Light between the slope t and the zenith: integrals of B sin cos and of B cos^2, and their derivatives by t."""
    square = 1.0 + t * t
    cosine = 1.0 / square
    if knots == 0:
        return wp.vec4(0.5 * cosine, 0.5 * (1.57079633 - arc_tangent(t) - t * cosine), -t * cosine * cosine, -cosine * cosine)
    root = wp.sqrt(square)
    sine = t / root
    place = sine * wp.float32(knots - 1)
    per = wp.float32(knots - 1) / (square * root)
    knot = wp.min(wp.int32(place), knots - 2)
    part = place - wp.float32(knot)
    one = 4 * (row * knots + knot)
    v = wp.vec4(table[one], table[one + 1], table[one + 2], table[one + 3])
    if share > 0.0:
        two = 4 * (next * knots + knot)
        v += share * (wp.vec4(table[two], table[two + 1], table[two + 2], table[two + 3]) - v)
    return wp.vec4(v[1] + part * v[3], v[0] + part * v[2], v[3] * per, v[2] * per)


@wp.struct
class Way:
    """A slice: the azimuth's cosine and sine, columns per row and rows per column, and their reciprocal lengths."""

    c: wp.float32
    s: wp.float32
    columns: wp.float32
    rise: wp.float32
    rows: wp.float32
    run: wp.float32


@wp.func
def way_of(c: wp.float32, s: wp.float32):
    way = Way()
    way.c = wp.where(wp.abs(c) > ALONG, c, 0.0)
    way.s = wp.where(wp.abs(s) > ALONG, s, 0.0)
    across = wp.abs(way.c)
    along = wp.abs(way.s)
    way.columns = wp.float32(0.0)
    way.rows = wp.float32(0.0)
    if along > 0.0:
        way.columns = way.c / along
    if across > 0.0:
        way.rows = way.s / across
    way.rise = along
    way.run = across
    return way


@wp.func
def highest_in(tiles: wp.array[wp.float32], left: wp.int32, right: wp.int32, over: wp.int32, under: wp.int32, rows: wp.int32, cols: wp.int32):
    """The highest ground in the tiles that hold columns left..right of rows over..under, what is off the map left out."""
    across = (cols - 1) / TILE + 1
    high = wp.float32(NONE)
    for j in range(wp.max(over, 0) / TILE, wp.min(under, rows - 1) / TILE + 1):
        for i in range(wp.max(left, 0) / TILE, wp.min(right, cols - 1) / TILE + 1):
            high = wp.max(tiles[j * across + i], high)
    return high


@wp.func
def within(value: wp.int32, size: wp.int32):
    return (value % size + size) % size


@wp.func
def horizon(heights: wp.array[wp.float32], tiles: wp.array[wp.float32], way: Way, x: wp.int32, y: wp.int32, own: wp.float32, least: wp.float32,
            top: wp.float32, reach: wp.float32, rows: wp.int32, cols: wp.int32, margin: wp.int32, sides: wp.int32):
    """(slope, number): ``least``, which is not below 0, raised to the horizon as far as ``reach``, and by which crossing: n
    rows on, or -n columns on; 0 where nothing stands above. TILE crossings at a time are left out where no ground near them
    is high enough."""
    stride = cols + 2 * margin
    best = wp.float32(least)
    number = wp.int32(0)
    up = wp.int32(-1)
    on = wp.int32(-1)
    n_rows = y
    n_columns = x
    if way.s > 0.0:
        up = 1
        n_rows = rows - 1 - y
    if way.c > 0.0:
        on = 1
        n_columns = cols - 1 - x
    if sides == PERIODIC:
        n_rows = 1 << 20
        n_columns = 1 << 20
    if way.s == 0.0:
        n_rows = 0
    if way.c == 0.0:
        n_columns = 0
    n = wp.int32(0)
    while n < n_rows:
        n += 1
        closeness = way.rise / wp.float32(n)
        if reach * closeness < 1.0:
            break
        across = wp.float32(n) * way.columns
        low = wp.floor(across)
        share = across - low
        column = x + wp.int32(low)
        row = y + up * n
        if sides == PERIODIC:
            column = within(column, cols)
            row = within(row, rows)
        elif column >= cols or column + 1 < 0:
            break
        leave = wp.int32(0)
        if n % TILE == 1:
            if (top - own) * (SLACK * closeness) <= best:
                break
            if sides != PERIODIC and wp.abs(way.columns) <= 2.0:
                last = x + wp.int32(wp.floor(wp.float32(n + TILE - 1) * way.columns))
                end = y + up * (n + TILE - 1)
                high = highest_in(tiles, wp.min(column, last), wp.max(column, last) + 1, wp.min(row, end), wp.max(row, end), rows, cols)
                if (high - own) * (SLACK * closeness) <= best:
                    leave = 1
        if leave == 1:
            n += TILE - 1
        else:
            here = row * stride + margin + column
            a = heights[here]
            b = heights[here + 1]
            slope = (a + share * (b - a) - own) * closeness
            if slope > best:
                best = slope
                number = n
    n = wp.int32(0)
    while n < n_columns:
        n += 1
        closeness = way.run / wp.float32(n)
        if reach * closeness < 1.0:
            break
        along = wp.float32(n) * way.rows
        low = wp.floor(along)
        share = along - low
        column = x + on * n
        row = y + wp.int32(low)
        next = row + 1
        if sides == PERIODIC:
            column = within(column, cols)
            row = within(row, rows)
            next = within(row + 1, rows)
        elif row < 0 or row >= rows or (next >= rows and share > 0.0):
            break
        else:
            next = wp.min(next, rows - 1)
        leave = wp.int32(0)
        if n % TILE == 1:
            if (top - own) * (SLACK * closeness) <= best:
                break
            if sides != PERIODIC and wp.abs(way.rows) <= 2.0:
                last = column + on * (TILE - 1)
                end = y + wp.int32(wp.floor(wp.float32(n + TILE - 1) * way.rows))
                high = highest_in(tiles, wp.min(column, last), wp.max(column, last), wp.min(row, end), wp.max(row, end) + 1, rows, cols)
                if (high - own) * (SLACK * closeness) <= best:
                    leave = 1
        if leave == 1:
            n += TILE - 1
        else:
            a = heights[row * stride + margin + column]
            b = heights[next * stride + margin + column]
            slope = (a + share * (b - a) - own) * closeness
            if slope > best:
                best = slope
                number = -n
    return best, number


@wp.func
def wall_of(way: Way, x: wp.int32, y: wp.int32, rows: wp.int32, cols: wp.int32):
    """Distance to the wall half a node outside the map."""
    wall = wp.float32(1e30)
    if way.c > 0.0:
        wall = (wp.float32(cols) - 0.5 - wp.float32(x)) / way.run
    if way.c < 0.0:
        wall = (wp.float32(x) + 0.5) / way.run
    if way.s > 0.0:
        wall = wp.min(wall, (wp.float32(rows) - 0.5 - wp.float32(y)) / way.rise)
    if way.s < 0.0:
        wall = wp.min(wall, (wp.float32(y) + 0.5) / way.rise)
    return wall


@wp.func
def crossing_of(way: Way, number: wp.int32, x: wp.int32, y: wp.int32, rows: wp.int32, cols: wp.int32, sides: wp.int32):
    """Where crossing ``number`` of a node lies: as in ``at``, the second node's weight, 1 / distance."""
    if number == 0:
        return wp.int32(-1), wp.float32(0.0), wp.float32(0.0)
    n = wp.abs(number)
    count = wp.float32(n)
    place = count * way.rows
    closeness = way.run / count
    if number > 0:
        place = count * way.columns
        closeness = way.rise / count
    low = wp.int32(wp.floor(place))
    column = x + low
    row = y + low
    if number > 0:
        row = y - n
        if way.s > 0.0:
            row = y + n
    else:
        column = x - n
        if way.c > 0.0:
            column = x + n
    if sides == PERIODIC:
        column = within(column, cols)
        row = within(row, rows)
    found = (row << 16) | column
    if number < 0:
        found = found | COLUMN
    return found, place - wp.float32(low), closeness


@wp.kernel
def surface(z: wp.array[wp.float32], heights: wp.array[wp.float32], tilts: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, margin: wp.int32, sides: wp.int32):
    """Heights and tilts of the depths z (pixels). Thread (y, x) owns a node."""
    y, x = wp.tid()
    stride = cols + 2 * margin
    p = y * cols + x
    h = -z[p]
    heights[y * stride + margin + x] = h
    if sides == PERIODIC:
        to = x + cols
        while to < cols + margin:
            heights[y * stride + margin + to] = h
            to += cols
        to = x - cols
        while to >= -margin:
            heights[y * stride + margin + to] = h
            to -= cols
    left = wp.max(x - 1, 0)
    right = wp.min(x + 1, cols - 1)
    over = wp.max(y - 1, 0)
    under = wp.min(y + 1, rows - 1)
    gx = wp.float32(0.0)
    gy = wp.float32(0.0)
    if right > left:
        gx = (z[y * cols + right] - z[y * cols + left]) / wp.float32(right - left)
    if under > over:
        gy = (z[under * cols + x] - z[over * cols + x]) / wp.float32(under - over)
    tilts[p] = gx
    tilts[rows * cols + p] = gy


@wp.kernel
def tiles(z: wp.array[wp.float32], tiles: wp.array[wp.float32], rows: wp.int32, cols: wp.int32):
    """The greatest height of every TILE x TILE nodes. Thread (j, i) owns a tile."""
    j, i = wp.tid()
    top = wp.float32(NONE)
    for y in range(j * TILE, wp.min(j * TILE + TILE, rows)):
        for x in range(i * TILE, wp.min(i * TILE + TILE, cols)):
            top = wp.max(-z[y * cols + x], top)
    tiles[j * ((cols - 1) / TILE + 1) + i] = top


@wp.kernel
def highest(tiles: wp.array[wp.float32], top: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, last: wp.int32):
    """The greatest height, top[0], by way of those of the rows of tiles: one thread per row of tiles, then one for all."""
    j = wp.tid()
    down = (rows - 1) / TILE + 1
    across = (cols - 1) / TILE + 1
    high = wp.float32(NONE)
    if last != 0:
        for i in range(down):
            high = wp.max(top[1 + i], high)
        top[0] = high
    else:
        for i in range(across):
            high = wp.max(tiles[j * across + i], high)
        top[1 + j] = high


@wp.kernel
def sky(heights: wp.array[wp.float32], tilts: wp.array[wp.float32], tiles: wp.array[wp.float32], top: wp.array[wp.float32],
        azimuths: wp.array[wp.float32], table: wp.array[wp.float32], light: wp.array[wp.float32], pulls: wp.array[wp.float32],
        at: wp.array[wp.int32], shares: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, margin: wp.int32, count: wp.int32,
        knots: wp.int32, sides: wp.int32):
    """E and its derivatives under a sky. azimuths (count, 4): cosine, sine, width, 0; table: one row per azimuth.

    Thread (y, x) owns a node. Order of summation: azimuths."""
    y, x = wp.tid()
    pixels = rows * cols
    p = y * cols + x
    own = heights[y * (cols + 2 * margin) + margin + x]
    gx = tilts[p]
    gy = tilts[pixels + p]
    peak = top[0]
    sum = wp.float32(0.0)
    by_own = wp.float32(0.0)
    by_x = wp.float32(0.0)
    by_y = wp.float32(0.0)
    for k in range(count):
        way = way_of(azimuths[4 * k], azimuths[4 * k + 1])
        width = azimuths[4 * k + 2]
        s = gx * way.c + gy * way.s
        slope = wp.max(-s, 0.0)
        by_wall = wp.float32(0.0)
        if sides == DARK:
            closeness = 1.0 / wall_of(way, x, y, rows, cols)
            wall = -own * closeness
            if wall > slope:
                slope = wall
                by_wall = closeness
        least = slope
        if sides == PERIODIC:
            least = wp.max(slope, LEVEL)
        found, number = horizon(heights, tiles, way, x, y, own, least, peak, 1e30, rows, cols, margin, sides)
        if number != 0:
            slope = found
        lit = above(slope, table, k, k, 0.0, knots)
        per_slope = width * (lit[2] + s * lit[3])
        sum += width * (lit[0] + s * lit[1])
        by_x += width * way.c * lit[1]
        by_y += width * way.s * lit[1]
        where, share, near = crossing_of(way, number, x, y, rows, cols, sides)
        e = k * pixels + p
        pulls[e] = per_slope * near
        at[e] = where
        shares[e] = share
        if number == 0:
            by_own += per_slope * by_wall
        else:
            by_own += per_slope * near
    inverse = 1.0 / wp.sqrt(1.0 + gx * gx + gy * gy)
    drop = sum * inverse * inverse * inverse
    light[p] = sum * inverse
    light[pixels + p] = by_own * inverse
    light[2 * pixels + p] = by_x * inverse - drop * gx
    light[3 * pixels + p] = by_y * inverse - drop * gy
    light[4 * pixels + p] = inverse


@wp.kernel
def lamp(heights: wp.array[wp.float32], tilts: wp.array[wp.float32], tiles: wp.array[wp.float32], top: wp.array[wp.float32],
         frames: wp.array[wp.float32], nodes: wp.array[wp.float32], solid: wp.array[wp.float32], table: wp.array[wp.float32],
         light: wp.array[wp.float32], pulls: wp.array[wp.float32], at: wp.array[wp.int32], shares: wp.array[wp.float32],
         rows: wp.int32, cols: wp.int32, margin: wp.int32, count: wp.int32, knots: wp.int32, n_rows: wp.int32, ball: wp.int32,
         sides: wp.int32):
    """The same for a finite source, through slices within it as every node sees it. A ball, ``solid`` its centre (x, y, height)
    and radius; or a flat, convex quadrangle, ``solid`` its four corners in turn.

      frames  (pixels, 4)  float32  cosine and sine of the azimuth of the source's middle; ball: distance to the centre along the
                                    ground; quadrangle: tangent of a quarter of the angle it takes up, 0 where it stands all round
      nodes   (count, 4)   float32  sine and cosine of midpoints of -pi/2..pi/2, cosine and sine of midpoints all round
      n_rows  rows of table, evenly in the diamond angle (c, s) -> s / (|c| + |s|), -1..1 over the half c > 0 and on

    Thread (y, x) owns a node. Order of summation: slices."""
    y, x = wp.tid()
    pixels = rows * cols
    p = y * cols + x
    own = heights[y * (cols + 2 * margin) + margin + x]
    gx = tilts[p]
    gy = tilts[pixels + p]
    ux = frames[4 * p]
    uy = frames[4 * p + 1]
    extent = frames[4 * p + 2]
    sum = wp.float32(0.0)
    by_own = wp.float32(0.0)
    by_x = wp.float32(0.0)
    by_y = wp.float32(0.0)
    for k in range(count):
        # 1. the slice, and the slopes between which the source stands in it, with their derivatives by the own depth
        c = nodes[4 * k + 2]
        s = nodes[4 * k + 3]
        width = 6.28318531 / wp.float32(count)
        low = wp.float32(1.0)
        high = wp.float32(0.0)
        low_by = wp.float32(0.0)
        high_by = wp.float32(0.0)
        reach = wp.float32(0.0)  # ground counts as far as this
        end = wp.float32(0.0)  # of the source
        if ball != 0:
            radius = solid[3]
            rise = solid[2] - own
            beyond = extent * extent + rise * rise - radius * radius
            along = wp.float32(0.0)
            half = wp.float32(0.0)
            if extent <= radius:
                off = extent * (s * ux - c * uy)
                along = extent * (c * ux + s * uy)
                half = wp.sqrt(wp.max(radius * radius - off * off, 0.0))
            else:
                off = radius / extent * nodes[4 * k]
                on = wp.sqrt((1.0 - off) * (1.0 + off))
                c = ux * on - uy * off
                s = uy * on + ux * off
                width = radius / extent * nodes[4 * k + 1] * (3.14159265 / wp.float32(count)) / on
                along = extent * on
                half = radius * nodes[4 * k + 1]
            reach = wp.max(along, half)
            end = along + half
            if beyond <= 0.0:
                low = -STEEP
                high = STEEP
            else:
                tangent = wp.sqrt(beyond)
                square = along * along + rise * rise
                low_c = along * tangent + rise * half
                low_s = rise * tangent - along * half
                high_c = along * tangent - rise * half
                high_s = rise * tangent + along * half
                low = -STEEP
                high = -STEEP
                if low_c > 0.0:
                    low = low_s / low_c
                    low_by = square / (low_c * tangent)
                elif low_s > 0.0:
                    low = STEEP
                if high_c > 0.0:
                    high = high_s / high_c
                    high_by = square / (high_c * tangent)
                elif rise > 0.0:
                    high = STEEP
        else:
            if extent > 0.0:
                t = extent * (wp.float32(2 * k + 1) / wp.float32(count) - 1.0)  # of half the angle from the middle
                scale = 1.0 / (1.0 + t * t)
                on = (1.0 - t * t) * scale
                off = 2.0 * t * scale
                c = ux * on - uy * off
                s = uy * on + ux * off
                width = 4.0 * extent / wp.float32(count) * scale
            least = wp.float32(STEEP)
            most = wp.float32(-STEEP)
            least_by = wp.float32(0.0)
            most_by = wp.float32(0.0)
            met = wp.int32(0)
            for i in range(4):
                j = (i + 1) & 3
                ax = solid[3 * i] - wp.float32(x)
                ay = solid[3 * i + 1] - wp.float32(y)
                bx = solid[3 * j] - wp.float32(x)
                by = solid[3 * j + 1] - wp.float32(y)
                start = c * ay - s * ax
                stop = c * by - s * bx
                if (start <= 0.0) != (stop <= 0.0):
                    share = start / (start - stop)
                    r = c * (ax + share * (bx - ax)) + s * (ay + share * (by - ay))
                    if r > 0.0:
                        slant = (solid[3 * i + 2] + share * (solid[3 * j + 2] - solid[3 * i + 2]) - own) / r
                        if slant < least:
                            least = slant
                            least_by = 1.0 / r
                        if slant > most:
                            most = slant
                            most_by = 1.0 / r
                        reach = wp.max(r, reach)
                        end = reach
                        met += 1
            if met == 1 and least > 0.0:  # the zenith lies within it
                most = STEEP
                most_by = 0.0
            if met > 0:
                low = least
                high = most
                low_by = least_by
                high_by = most_by

        # 2. what limits it from below
        way = way_of(c, s)
        tilt = gx * c + gy * s
        slope = wp.max(-tilt, 0.0)
        by_limit = wp.float32(0.0)
        if sides == DARK:
            wall = wall_of(way, x, y, rows, cols)
            closeness = 1.0 / wall
            if end > wall and -own * closeness > slope:
                slope = -own * closeness
                by_limit = closeness
        if low > slope:
            slope = low
            by_limit = low_by
        number = wp.int32(0)
        if slope < high:
            slope, number = horizon(heights, tiles, way, x, y, own, slope, top[0], reach, rows, cols, margin, OPEN)

        # 3. the light between
        where = wp.int32(-1)
        share = wp.float32(0.0)
        pull = wp.float32(0.0)
        if slope < high:
            diamond = wp.float32(0.0)
            if s >= 0.0:
                if c >= 0.0:
                    diamond = s / (c + s)
                else:
                    diamond = 1.0 - c / (s - c)
            elif c < 0.0:
                diamond = 2.0 - s / (-c - s)
            else:
                diamond = 3.0 + c / (c - s)
            place = 0.25 * diamond * wp.float32(n_rows)
            row = wp.min(wp.int32(place), n_rows - 1)
            next = wp.int32(0)
            if row + 1 < n_rows:
                next = row + 1
            lit = above(slope, table, row, next, place - wp.float32(row), knots)
            c1 = lit[0]
            c2 = lit[1]
            per_slope = width * (lit[2] + tilt * lit[3])
            if high < STEEP:
                over = above(high, table, row, next, place - wp.float32(row), knots)
                c1 -= over[0]
                c2 -= over[1]
                by_own -= width * (over[2] + tilt * over[3]) * high_by
            near = wp.float32(0.0)
            if number != 0:
                where, share, near = crossing_of(way, number, x, y, rows, cols, OPEN)
            pull = per_slope * near
            sum += width * (c1 + tilt * c2)
            if number == 0:
                by_own += per_slope * by_limit
            else:
                by_own += pull
            by_x += width * c * c2
            by_y += width * s * c2
        pulls[k * pixels + p] = pull
        at[k * pixels + p] = where
        shares[k * pixels + p] = share
    inverse = 1.0 / wp.sqrt(1.0 + gx * gx + gy * gy)
    drop = sum * inverse * inverse * inverse
    light[p] = sum * inverse
    light[pixels + p] = by_own * inverse
    light[2 * pixels + p] = by_x * inverse - drop * gx
    light[3 * pixels + p] = by_y * inverse - drop * gy
    light[4 * pixels + p] = inverse


@wp.func
def ends_of(where: wp.int32, rows: wp.int32, cols: wp.int32):
    """The two nodes beside a crossing."""
    row = (where >> 16) & 16383
    column = where & 65535
    next_row = row
    next_column = column
    if (where & COLUMN) == 0:
        next_column = 0
        if column + 1 < cols:
            next_column = column + 1
    else:
        next_row = 0
        if row + 1 < rows:
            next_row = row + 1
    return row * cols + column, next_row * cols + next_column


@wp.func
def push_at(light: wp.array[wp.float32], pulls: wp.array[wp.float32], at: wp.array[wp.int32], shares: wp.array[wp.float32],
            gain: wp.array[wp.float32], v: wp.array[wp.float32], out: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, count: wp.int32, p: wp.int32):
    """See push."""
    pixels = rows * cols
    sum = wp.float32(0.0)
    for k in range(count):
        e = k * pixels + p
        if at[e] >= 0:
            one, two = ends_of(at[e], rows, cols)
            a = v[one]
            sum += pulls[e] * (a + shares[e] * (v[two] - a))
    x = p % cols
    y = p / cols
    before = wp.max(x - 1, 0)
    after = wp.min(x + 1, cols - 1)
    over = wp.max(y - 1, 0)
    under = wp.min(y + 1, rows - 1)
    dx = wp.float32(0.0)
    dy = wp.float32(0.0)
    if after > before:
        dx = (v[y * cols + after] - v[y * cols + before]) / wp.float32(after - before)
    if under > over:
        dy = (v[under * cols + x] - v[over * cols + x]) / wp.float32(under - over)
    change = light[pixels + p] * v[p] - light[4 * pixels + p] * sum + light[2 * pixels + p] * dx + light[3 * pixels + p] * dy
    out[p] = gain[p] * gain[p] * change


@wp.kernel
def push(light: wp.array[wp.float32], pulls: wp.array[wp.float32], at: wp.array[wp.int32], shares: wp.array[wp.float32],
         gain: wp.array[wp.float32], v: wp.array[wp.float32], out: wp.array[wp.float32], rows: wp.int32, cols: wp.int32, count: wp.int32):
    """out = gain^2 J v, J the derivative of E by z, v a change of z. Thread p owns a node."""
    push_at(light, pulls, at, shares, gain, v, out, rows, cols, count, wp.tid())


@wp.func
def pull_at(light: wp.array[wp.float32], pulls: wp.array[wp.float32], at: wp.array[wp.int32], shares: wp.array[wp.float32],
            u: wp.array[wp.float32], sum: wp.array[wp.int64], unit: wp.float32, rows: wp.int32, cols: wp.int32, count: wp.int32, p: wp.int32):
    """See pull."""
    pixels = rows * cols
    x = p % cols
    y = p / cols
    own = u[p] * unit
    before = wp.max(x - 1, 0)
    after = wp.min(x + 1, cols - 1)
    over = wp.max(y - 1, 0)
    under = wp.min(y + 1, rows - 1)
    wp.atomic_add(sum, p, wp.int64(own * light[pixels + p]))
    if after > before:
        part = own * light[2 * pixels + p] / wp.float32(after - before)
        wp.atomic_add(sum, y * cols + after, wp.int64(part))
        wp.atomic_add(sum, y * cols + before, wp.int64(-part))
    if under > over:
        part = own * light[3 * pixels + p] / wp.float32(under - over)
        wp.atomic_add(sum, under * cols + x, wp.int64(part))
        wp.atomic_add(sum, over * cols + x, wp.int64(-part))
    for k in range(count):
        e = k * pixels + p
        if at[e] >= 0:
            one, two = ends_of(at[e], rows, cols)
            part = u[p] * unit * light[4 * pixels + p] * pulls[e]
            wp.atomic_add(sum, one, wp.int64(-(part - part * shares[e])))
            wp.atomic_add(sum, two, wp.int64(-part * shares[e]))


@wp.kernel
def pull(light: wp.array[wp.float32], pulls: wp.array[wp.float32], at: wp.array[wp.int32], shares: wp.array[wp.float32],
         u: wp.array[wp.float32], sum: wp.array[wp.int64], unit: wp.float32, rows: wp.int32, cols: wp.int32, count: wp.int32):
    """sum += unit transpose(J) u, in fixed point, so that no order of summation matters. Thread p owns a node."""
    pull_at(light, pulls, at, shares, u, sum, unit, rows, cols, count, wp.tid())


@wp.kernel
def misfit(light: wp.array[wp.float32], gain: wp.array[wp.float32], target: wp.array[wp.float32], u: wp.array[wp.float32],
           part: wp.array[wp.float64], pixels: wp.int32):
    """Residual r = gain E - target, u = gain r, and in part (blocks, 3) the sums of r^2, (gain E)^2 and gain E target.

    Thread g of this and of all below owns BLOCK nodes and adds them in order."""
    g = wp.tid()
    square = wp.float64(0.0)
    bright = wp.float64(0.0)
    both = wp.float64(0.0)
    for p in range(g * BLOCK, wp.min(pixels, g * BLOCK + BLOCK)):
        seen = gain[p] * light[p]
        r = seen - target[p]
        u[p] = gain[p] * r
        square += wp.float64(r) * wp.float64(r)
        bright += wp.float64(seen) * wp.float64(seen)
        both += wp.float64(seen) * wp.float64(target[p])
    part[3 * g] = square
    part[3 * g + 1] = bright
    part[3 * g + 2] = both


@wp.func
def bend(v: wp.array[wp.float32], p: wp.int32, i: wp.int32, n: wp.int32, step: wp.int32):
    """Second difference of v along a line of n nodes, ``step`` apart in memory, about node i of it, at p; 0 at the ends."""
    if i < 1 or i > n - 2:
        return wp.float32(0.0)
    return (v[p - step] - v[p]) - (v[p] - v[p + step])


@wp.func
def unbend(v: wp.array[wp.float32], p: wp.int32, i: wp.int32, n: wp.int32, step: wp.int32):
    """The transpose of bend, of itself."""
    sum = -2.0 * bend(v, p, i, n, step)
    if i > 1:
        sum += bend(v, p - step, i - 1, n, step)
    if i < n - 2:
        sum += bend(v, p + step, i + 1, n, step)
    return sum


@wp.kernel
def bending(z: wp.array[wp.float32], part: wp.array[wp.float64], rows: wp.int32, cols: wp.int32):
    """In part (blocks) the sums of squared second differences along rows and columns."""
    g = wp.tid()
    pixels = rows * cols
    sum = wp.float64(0.0)
    for p in range(g * BLOCK, wp.min(pixels, g * BLOCK + BLOCK)):
        a = bend(z, p, p % cols, cols, 1)
        b = bend(z, p, p / cols, rows, cols)
        sum += wp.float64(a) * wp.float64(a) + wp.float64(b) * wp.float64(b)
    part[g] = sum


@wp.kernel
def diagonal(light: wp.array[wp.float32], gain: wp.array[wp.float32], scale: wp.array[wp.float32], rows: wp.int32, cols: wp.int32,
             least: wp.float32, is_first: wp.int32):
    """Adds the diagonal of transpose(J) gain^2 J, without the far nodes' part, to scale; is_first: to ``least`` instead."""
    y, x = wp.tid()
    p = y * cols + x
    pixels = rows * cols
    own = gain[p] * light[pixels + p]
    sum = own * own
    for s in range(2):
        side = 2 * s - 1
        if x + side >= 0 and x + side < cols:
            half = wp.float32(0.5)
            if x + side == 0 or x + side == cols - 1:
                half = 1.0
            part = gain[p + side] * light[2 * pixels + p + side] * half
            sum += part * part
        if y + side >= 0 and y + side < rows:
            half = wp.float32(0.5)
            if y + side == 0 or y + side == rows - 1:
                half = 1.0
            part = gain[p + side * cols] * light[3 * pixels + p + side * cols] * half
            sum += part * part
    if is_first != 0:
        scale[p] = sum + least
    else:
        scale[p] = sum + scale[p]


@wp.kernel
def begin(z: wp.array[wp.float32], low: wp.array[wp.float32], high: wp.array[wp.float32], scale: wp.array[wp.float32],
          sum: wp.array[wp.int64], r: wp.array[wp.float32], v: wp.array[wp.float32], x: wp.array[wp.float32], p: wp.array[wp.float32],
          s: wp.array[wp.float32], is_free: wp.array[wp.float32], part: wp.array[wp.float64], unit: wp.float32, lambda_: wp.float32,
          rows: wp.int32, cols: wp.int32):
    """The downhill direction r = -(sum unit + lambda unbend z), 0 where a bound holds z (free 0); v = r / scale, and
    x = p = s = sum = 0 for conjugate gradients. In part (blocks) v v."""
    g = wp.tid()
    pixels = rows * cols
    square = wp.float64(0.0)
    for i in range(g * BLOCK, wp.min(pixels, g * BLOCK + BLOCK)):
        smooth = unbend(z, i, i % cols, cols, 1) + unbend(z, i, i / cols, rows, cols)
        down = -(wp.float32(sum[i]) * unit + lambda_ * smooth)
        moves = wp.float32(1.0)
        if (z[i] <= low[i] and down < 0.0) or (z[i] >= high[i] and down > 0.0):
            moves = 0.0
        sum[i] = wp.int64(0)
        is_free[i] = moves
        r[i] = moves * down
        v[i] = r[i] / scale[i]
        x[i] = 0.0
        p[i] = 0.0
        s[i] = 0.0
        square += wp.float64(v[i]) * wp.float64(v[i])
    part[g] = square


@wp.func
def curve_at(r: wp.array[wp.float32], v: wp.array[wp.float32], scale: wp.array[wp.float32], is_free: wp.array[wp.float32],
             sum: wp.array[wp.int64], w: wp.array[wp.float32], part: wp.array[wp.float64], unit: wp.float32, lambda_: wp.float32,
             damping: wp.float32, rows: wp.int32, cols: wp.int32, g: wp.int32):
    """See curve."""
    pixels = rows * cols
    product = wp.float64(0.0)
    curvature = wp.float64(0.0)
    square = wp.float64(0.0)
    for i in range(g * BLOCK, wp.min(pixels, g * BLOCK + BLOCK)):
        smooth = unbend(v, i, i % cols, cols, 1) + unbend(v, i, i / cols, rows, cols)
        w[i] = is_free[i] * (wp.float32(sum[i]) * unit + lambda_ * smooth + damping * scale[i] * v[i])
        sum[i] = wp.int64(0)
        product += wp.float64(r[i]) * wp.float64(v[i])
        curvature += wp.float64(v[i]) * wp.float64(w[i])
        square += wp.float64(v[i]) * wp.float64(v[i])
    part[3 * g] = product
    part[3 * g + 1] = curvature
    part[3 * g + 2] = square


@wp.kernel
def curve(r: wp.array[wp.float32], v: wp.array[wp.float32], scale: wp.array[wp.float32], is_free: wp.array[wp.float32],
          sum: wp.array[wp.int64], w: wp.array[wp.float32], part: wp.array[wp.float64], unit: wp.float32, lambda_: wp.float32,
          damping: wp.float32, rows: wp.int32, cols: wp.int32):
    """w = free (sum unit + lambda unbend v + damping scale v), the normal equations' matrix times v; sum = 0.

    In part (blocks, 3) r v, v w and v v."""
    curve_at(r, v, scale, is_free, sum, w, part, unit, lambda_, damping, rows, cols, wp.tid())


@wp.func
def go_at(scale: wp.array[wp.float32], w: wp.array[wp.float32], r: wp.array[wp.float32], v: wp.array[wp.float32], x: wp.array[wp.float32],
          p: wp.array[wp.float32], s: wp.array[wp.float32], alpha: wp.float32, beta: wp.float32, pixels: wp.int32, g: wp.int32):
    """See go."""
    for i in range(g * BLOCK, wp.min(pixels, g * BLOCK + BLOCK)):
        p[i] = v[i] + beta * p[i]
        s[i] = w[i] + beta * s[i]
        x[i] = x[i] + alpha * p[i]
        r[i] = r[i] - alpha * s[i]
        v[i] = r[i] / scale[i]


@wp.kernel
def go(scale: wp.array[wp.float32], w: wp.array[wp.float32], r: wp.array[wp.float32], v: wp.array[wp.float32], x: wp.array[wp.float32],
       p: wp.array[wp.float32], s: wp.array[wp.float32], alpha: wp.float32, beta: wp.float32, pixels: wp.int32):
    """A step of conjugate gradients with one sum (Chronopoulos and Gear 1989): p = v + beta p, s = w + beta s, x += alpha p,
    r -= alpha s, v = r / scale."""
    go_at(scale, w, r, v, x, p, s, alpha, beta, pixels, wp.tid())


@wp.kernel
def solve(light: wp.array[wp.float32], pulls: wp.array[wp.float32], at: wp.array[wp.int32], shares: wp.array[wp.float32],
          gain: wp.array[wp.float32], scale: wp.array[wp.float32], is_free: wp.array[wp.float32], sum: wp.array[wp.int64],
          r: wp.array[wp.float32], v: wp.array[wp.float32], w: wp.array[wp.float32], x: wp.array[wp.float32], p: wp.array[wp.float32],
          s: wp.array[wp.float32], u: wp.array[wp.float32], part: wp.array[wp.float64], gained: wp.array[wp.float64],
          length: wp.float64, fixed_: wp.float64, lambda_: wp.float32, damping: wp.float32, least: wp.float64, most: wp.int32,
          rows: wp.int32, cols: wp.int32, count: wp.int32):
    """All of conjugate gradients after begin, by one thread: on a small grid a CPU takes longer to start a kernel than to run it.

    The same operations in the same order as the kernels above, and as Descent.solve between them. gained[0]: what the
    quadratic model gains."""
    pixels = rows * cols
    blocks = (pixels - 1) / BLOCK + 1
    size = wp.float64(length)
    start = wp.float64(0.0)
    before = wp.float64(0.0)
    alpha = wp.float64(0.0)
    total = wp.float64(0.0)
    done = wp.int32(0)
    number = wp.int32(0)
    while number < most and done == 0:
        unit = fixed_ / size
        for i in range(pixels):
            push_at(light, pulls, at, shares, gain, v, u, rows, cols, count, i)
        for i in range(pixels):
            pull_at(light, pulls, at, shares, u, sum, wp.float32(unit), rows, cols, count, i)
        product = wp.float64(0.0)
        curvature = wp.float64(0.0)
        square = wp.float64(0.0)
        for g in range(blocks):
            curve_at(r, v, scale, is_free, sum, w, part, wp.float32(wp.float64(1.0) / unit), lambda_, damping, rows, cols, g)
            product += part[3 * g]
            curvature += part[3 * g + 1]
            square += part[3 * g + 2]
        beta = wp.float64(0.0)
        if number == 0:
            start = product
        else:
            beta = product / before
            curvature -= beta * product / alpha
        if product > least * start and curvature > wp.float64(0.0):
            alpha = product / curvature
            before = product
            size = wp.sqrt(square)
            for g in range(blocks):
                go_at(scale, w, r, v, x, p, s, wp.float32(alpha), wp.float32(beta), pixels, g)
            total += wp.float64(0.5) * alpha * product
        else:
            done = wp.int32(1)
        number += 1
    gained[0] = total


@wp.kernel
def move(z: wp.array[wp.float32], x: wp.array[wp.float32], low: wp.array[wp.float32], high: wp.array[wp.float32], to: wp.array[wp.float32],
         pixels: wp.int32):
    """to = z + x, within its bounds."""
    g = wp.tid()
    for i in range(g * BLOCK, wp.min(pixels, g * BLOCK + BLOCK)):
        to[i] = wp.min(wp.max(z[i] + x[i], low[i]), high[i])
