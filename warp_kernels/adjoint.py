"""Irradiance of a depth map and its derivatives, for the inverse problem (docs/explanation). Twin of
opencl/adjoint.cl.

E = (1 + |grad z|^2)^(-1/2) sum over slices of width x [C1(T) + s C2(T)], s = e . grad z, C1 and C2 the
integrals of B sin cos and of B cos^2 above the slope T: the largest of the level, the tangent plane, the
wall, the source's own lower edge and the horizon. The horizon is the largest (height - own height) / distance
over every crossing of the slice with a row or a column of the grid; where it is the limit, dE/dT goes to the
two nodes beside that crossing, over its distance. Where the tangent plane is the limit the integrand is 0 and
so is the derivative.

Lengths are in spacings. z is depth, heights are -z. `pixels` is rows x cols.

  heights        (rows, cols + 2 margin)  float32  -z; in the margins -1e30, or the other side of a map that
                                                   repeats
  tilts          (2, pixels)              float32  dz/dx, dz/dy by central differences, one-sided at the
                                                   border
  tiles          (down x across)          float32  the greatest height of every TILE x TILE nodes
  top            (1)                      int32    that of all, as ordered() gives it
  numbers        (count, room)            int32    under a sky: number of the crossing that is the horizon, by
                                                   horizons; 0 where the ground is no limit; room = pixels +
                                                   PIXEL_PADDING
  slopes         (count, room)            float32  and the slope to it
  light          (4, pixels)              float32  out: E; dE by own depth, by dz/dx, by dz/dy
  held           (pixels)                 int32    out: slices of a node that another node limits, or two: its
                                                   links
  first, second                           int32    out: these nodes; (pixels / LINK_BLOCK, count, LINK_BLOCK):
                                                   node by node, their links
  near, far                               float32  out: dE by the depth of the first, of the second; likewise
  table          (n, knots, 4)            float32  integrals of B cos^2 and of B sin cos over elevation from
                                                   tangent / (1 + tangent) = i / (knots - 1) to the zenith,
                                                   and what to add up to the next knot; knots 0: brightness
                                                   1, closed form
  sides                                   int32    0 open, 1 dark, 2 periodic

All arithmetic is +, -, x, / and sqrt, correctly rounded and in one order, so that every backend finds the
same bits.
"""

import warp as wp

from skylamp.constants import (
    DARK,
    HALF_PI,
    LEAST_SEARCHED_SLOPE,
    LINK_BLOCK,
    NONE,
    OPEN,
    PARALLEL,
    PERIODIC,
    PI,
    PIXEL_PADDING,
    ROUNDING,
    STEEP,
    TILE,
    TWO_PI,
)

from . import OPTIONS
from .interreflection import arctan, below

wp.set_module_options(OPTIONS)


@wp.func
def above(
    t: wp.float32,
    table: wp.array[wp.float32],
    row: wp.int32,
    next: wp.int32,
    share: wp.float32,
    knots: wp.int32,
):
    """Light between the slope t and the zenith: integrals of B sin cos and of B cos^2, and their derivatives
    by t.
    """
    square = 1.0 + t * t
    cosine = 1.0 / square
    if knots == 0:
        return wp.vec4(
            0.5 * cosine, 0.5 * (HALF_PI - arctan(t) - t * cosine), -t * cosine * cosine, -cosine * cosine
        )
    diamond = t / (1.0 + t)
    place = diamond * wp.float32(knots - 1)
    per = (1.0 - diamond) / (1.0 + t) * wp.float32(knots - 1)
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
    """A slice: the azimuth's cosine and sine, columns per row and rows per column, and their reciprocal
    inner_products.
    """

    c: wp.float32
    s: wp.float32
    columns: wp.float32
    rise: wp.float32
    rows: wp.float32
    run: wp.float32


@wp.func
def way_of(c: wp.float32, s: wp.float32):
    way = Way()
    way.c = wp.where(wp.abs(c) > PARALLEL, c, 0.0)
    way.s = wp.where(wp.abs(s) > PARALLEL, s, 0.0)
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
def highest_in(
    tiles: wp.array[wp.float32],
    left: wp.int32,
    right: wp.int32,
    over: wp.int32,
    under: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
):
    """The highest ground in the tiles that hold columns left..right of rows over..under, what is off the map
    left out.
    """
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
def horizon(
    heights: wp.array[wp.float32],
    tiles: wp.array[wp.float32],
    way: Way,
    x: wp.int32,
    y: wp.int32,
    own: wp.float32,
    least: wp.float32,
    top: wp.float32,
    reach: wp.float32,
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    sides: wp.int32,
):
    """(slope, number): ``least``, which is not below 0, raised to the horizon as far as ``reach``, and by
    which crossing: n rows on, or -n columns on; 0 where nothing stands above. TILE crossings at a time are
    left out where no ground near them is high enough.
    """
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
            if (top - own) * (ROUNDING * closeness) <= best:
                break
            if sides != PERIODIC and wp.abs(way.columns) <= 2.0:
                last = x + wp.int32(wp.floor(wp.float32(n + TILE - 1) * way.columns))
                end = y + up * (n + TILE - 1)
                high = highest_in(
                    tiles,
                    wp.min(column, last),
                    wp.max(column, last) + 1,
                    wp.min(row, end),
                    wp.max(row, end),
                    rows,
                    cols,
                )
                if (high - own) * (ROUNDING * closeness) <= best:
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
            if (top - own) * (ROUNDING * closeness) <= best:
                break
            if sides != PERIODIC and wp.abs(way.rows) <= 2.0:
                last = column + on * (TILE - 1)
                end = y + wp.int32(wp.floor(wp.float32(n + TILE - 1) * way.rows))
                high = highest_in(
                    tiles,
                    wp.min(column, last),
                    wp.max(column, last),
                    wp.min(row, end),
                    wp.max(row, end) + 1,
                    rows,
                    cols,
                )
                if (high - own) * (ROUNDING * closeness) <= best:
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
def crossing_of(
    way: Way, number: wp.int32, x: wp.int32, y: wp.int32, rows: wp.int32, cols: wp.int32, sides: wp.int32
):
    """The nodes beside crossing ``number`` of a node, the second one's weight, 1 / distance."""
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
    next_column = column
    next_row = row
    if number > 0:
        next_column = 0
        if column + 1 < cols:
            next_column = column + 1
    else:
        next_row = 0
        if row + 1 < rows:
            next_row = row + 1
    return row * cols + column, next_row * cols + next_column, place - wp.float32(low), closeness


@wp.func
def link_at(p: wp.int32, k: wp.int32, count: wp.int32):
    return (p / LINK_BLOCK * count + k) * LINK_BLOCK + p % LINK_BLOCK


@wp.func
def ordered(v: wp.float32):
    """A float as a whole number of the same order; unordered: back."""
    bits = wp.cast(v, wp.int32)
    if bits < 0:
        bits = bits ^ 2147483647
    return bits


@wp.func
def unordered(bits: wp.int32):
    if bits < 0:
        return wp.cast(bits ^ 2147483647, wp.float32)
    return wp.cast(bits, wp.float32)


@wp.func
def on_line(i: wp.int32, n: wp.int32, sides: wp.int32):
    """Node i of a line of n, which may lie one beyond its ends."""
    if sides == PERIODIC:
        return (i + n) % n
    return wp.clamp(i, 0, n - 1)


@wp.func
def half_within(i: wp.int32, n: wp.int32, sides: wp.int32):
    """1 over the distance of the nodes on both sides of node i of n, or of it and its one neighbour."""
    if sides == PERIODIC or (i > 0 and i < n - 1):
        return wp.float32(0.5)
    return wp.float32(1.0)


@wp.func
def rise_at(
    v: wp.array[wp.float32], start: wp.int32, i: wp.int32, n: wp.int32, step: wp.int32, sides: wp.int32
):
    """Central difference of v along a line of n nodes, ``step`` apart in memory from ``start`` on, about node
    i of it.
    """
    after = v[start + on_line(i + 1, n, sides) * step]
    return (after - v[start + on_line(i - 1, n, sides) * step]) * half_within(i, n, sides)


@wp.kernel
def surface(
    z: wp.array[wp.float32],
    heights: wp.array[wp.float32],
    tilts: wp.array[wp.float32],
    top: wp.array[wp.int32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    sides: wp.int32,
):
    """Heights and tilts of the depths z (pixels), and a top for tiles to raise. Thread (y, x) owns a node."""
    y, x = wp.tid()
    stride = cols + 2 * margin
    p = y * cols + x
    h = -z[p]
    if p == 0:
        top[0] = ordered(NONE)
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
    tilts[p] = rise_at(z, y * cols, x, cols, 1, sides)
    tilts[rows * cols + p] = rise_at(z, x, y, rows, cols, sides)


@wp.kernel
def tiles(
    z: wp.array[wp.float32],
    tiles: wp.array[wp.float32],
    top: wp.array[wp.int32],
    rows: wp.int32,
    cols: wp.int32,
):
    """The greatest height of every TILE x TILE nodes, and of all. Thread (j, i) owns a tile."""
    j, i = wp.tid()
    high = wp.float32(NONE)
    for y in range(j * TILE, wp.min(j * TILE + TILE, rows)):
        for x in range(i * TILE, wp.min(i * TILE + TILE, cols)):
            high = wp.max(-z[y * cols + x], high)
    tiles[j * ((cols - 1) / TILE + 1) + i] = high
    wp.atomic_max(top, 0, ordered(high))


@wp.func
def limit_of(
    way: Way,
    own: wp.float32,
    gx: wp.float32,
    gy: wp.float32,
    x: wp.int32,
    y: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    sides: wp.int32,
):
    """The limit of a slice of a sky without the ground: the level, the tangent plane or the wall, then
    with its derivative.
    """
    slope = wp.max(-(gx * way.c + gy * way.s), 0.0)
    by_wall = wp.float32(0.0)
    if sides == DARK:
        closeness = 1.0 / wall_of(way, x, y, rows, cols)
        wall = -own * closeness
        if wall > slope:
            slope = wall
            by_wall = closeness
    return slope, by_wall


@wp.kernel
def horizons(
    heights: wp.array[wp.float32],
    tilts: wp.array[wp.float32],
    tiles: wp.array[wp.float32],
    top: wp.array[wp.int32],
    azimuths: wp.array[wp.float32],
    numbers: wp.array[wp.int32],
    slopes: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    count: wp.int32,
    sides: wp.int32,
    ways: wp.int32,
):
    """The horizon of every slice under a sky: its crossing's number (as horizon gives it) and its slope.

    azimuths (count, 4): cosine, sine, width, 0. Thread (a, y, x) owns a node and ``ways`` azimuths."""
    a, y, x = wp.tid()
    p = y * cols + x
    own = heights[y * (cols + 2 * margin) + margin + x]
    for k in range(a * ways, wp.min(count, a * ways + ways)):
        way = way_of(azimuths[4 * k], azimuths[4 * k + 1])
        least, _by_wall = limit_of(way, own, tilts[p], tilts[rows * cols + p], x, y, rows, cols, sides)
        if sides == PERIODIC:
            least = wp.max(least, LEAST_SEARCHED_SLOPE)
        slope, number = horizon(
            heights, tiles, way, x, y, own, least, unordered(top[0]), 1e30, rows, cols, margin, sides
        )
        numbers[k * (rows * cols + PIXEL_PADDING) + p] = number
        slopes[k * (rows * cols + PIXEL_PADDING) + p] = slope


@wp.kernel
def sky(
    heights: wp.array[wp.float32],
    tilts: wp.array[wp.float32],
    top: wp.array[wp.int32],
    numbers: wp.array[wp.int32],
    slopes: wp.array[wp.float32],
    azimuths: wp.array[wp.float32],
    table: wp.array[wp.float32],
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    count: wp.int32,
    knots: wp.int32,
    sides: wp.int32,
):
    """E and its derivatives under a sky, after horizons. table: one row per azimuth.

    Thread (y, x) owns a node. Order of summation: azimuths."""
    y, x = wp.tid()
    pixels = rows * cols
    p = y * cols + x
    own = heights[y * (cols + 2 * margin) + margin + x]
    gx = tilts[p]
    gy = tilts[pixels + p]
    inverse = 1.0 / wp.sqrt(1.0 + gx * gx + gy * gy)
    links = wp.int32(0)
    sum = wp.float32(0.0)
    by_own = wp.float32(0.0)
    by_x = wp.float32(0.0)
    by_y = wp.float32(0.0)
    for k in range(count):
        way = way_of(azimuths[4 * k], azimuths[4 * k + 1])
        width = azimuths[4 * k + 2]
        s = gx * way.c + gy * way.s
        slope, by_wall = limit_of(way, own, gx, gy, x, y, rows, cols, sides)
        number = numbers[k * (pixels + PIXEL_PADDING) + p]
        if number != 0:
            slope = slopes[k * (pixels + PIXEL_PADDING) + p]
        lit = above(slope, table, k, k, 0.0, knots)
        per_slope = width * (lit[2] + s * lit[3])
        sum += width * (lit[0] + s * lit[1])
        by_x += width * way.c * lit[1]
        by_y += width * way.s * lit[1]
        if number == 0:
            by_own += per_slope * by_wall
        else:
            one, two, share, closeness = crossing_of(way, number, x, y, rows, cols, sides)
            pull = per_slope * closeness
            whole = -pull * inverse
            e = link_at(p, links, count)
            by_own += pull
            first[e] = one
            second[e] = two
            near[e] = whole - whole * share
            far[e] = whole * share
            links += 1
    drop = sum * inverse * inverse * inverse
    light[p] = sum * inverse
    light[pixels + p] = by_own * inverse
    light[2 * pixels + p] = by_x * inverse - drop * gx
    light[3 * pixels + p] = by_y * inverse - drop * gy
    held[p] = links


@wp.kernel
def lamp(
    heights: wp.array[wp.float32],
    tilts: wp.array[wp.float32],
    tiles: wp.array[wp.float32],
    top: wp.array[wp.int32],
    frames: wp.array[wp.float32],
    quadrature: wp.array[wp.float32],
    solid: wp.array[wp.float32],
    table: wp.array[wp.float32],
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    margin: wp.int32,
    count: wp.int32,
    knots: wp.int32,
    n_rows: wp.int32,
    ball: wp.int32,
    sides: wp.int32,
):
    """The same for a finite source, through slices within it as every node sees it. A ball, ``solid`` its
    centre (x, y, height) and radius; or a flat, convex quadrangle, ``solid`` its four corners in turn.

      frames  (pixels, 4)  float32  cosine and sine of the azimuth of the source's middle; ball: distance to
                                    the centre along the ground; quadrangle: tangent of a quarter of the angle
                                    it takes up, 0 where it stands all round
      quadrature  (count, 4)  float32  sine and cosine of midpoints of -pi/2..pi/2, cosine and sine of
                                    midpoints all round
      n_rows  rows of table, evenly in the diamond angle (c, s) -> s / (|c| + |s|), -1..1 over the half c > 0
              and on

    Thread (y, x) owns a node. Order of summation: slices.
    """
    y, x = wp.tid()
    pixels = rows * cols
    p = y * cols + x
    own = heights[y * (cols + 2 * margin) + margin + x]
    gx = tilts[p]
    gy = tilts[pixels + p]
    ux = frames[4 * p]
    uy = frames[4 * p + 1]
    extent = frames[4 * p + 2]
    inverse = 1.0 / wp.sqrt(1.0 + gx * gx + gy * gy)
    links = wp.int32(0)
    sum = wp.float32(0.0)
    by_own = wp.float32(0.0)
    by_x = wp.float32(0.0)
    by_y = wp.float32(0.0)
    for k in range(count):
        # 1. the slice, and the slopes between which the source stands in it, with their derivatives by the
        # own depth
        c = quadrature[4 * k + 2]
        s = quadrature[4 * k + 3]
        width = TWO_PI / wp.float32(count)
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
                offset = extent * (s * ux - c * uy)
                along = extent * (c * ux + s * uy)
                half = wp.sqrt(wp.max(radius * radius - offset * offset, 0.0))
            else:
                sin_d = radius / extent * quadrature[4 * k]
                cos_d = wp.sqrt((1.0 - sin_d) * (1.0 + sin_d))
                c = ux * cos_d - uy * sin_d
                s = uy * cos_d + ux * sin_d
                width = radius / extent * quadrature[4 * k + 1] * (PI / wp.float32(count)) / cos_d
                along = extent * cos_d
                half = radius * quadrature[4 * k + 1]
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
                t = extent * (
                    wp.float32(2 * k + 1) / wp.float32(count) - 1.0
                )  # of half the angle from the middle
                scale = 1.0 / (1.0 + t * t)
                cos_d = (1.0 - t * t) * scale
                sin_d = 2.0 * t * scale
                c = ux * cos_d - uy * sin_d
                s = uy * cos_d + ux * sin_d
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
            slope, number = horizon(
                heights, tiles, way, x, y, own, slope, unordered(top[0]), reach, rows, cols, margin, OPEN
            )

        # 3. the light between
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
            sum += width * (c1 + tilt * c2)
            by_x += width * c * c2
            by_y += width * s * c2
            if number == 0:
                by_own += per_slope * by_limit
            else:
                one, two, weight, nearness = crossing_of(way, number, x, y, rows, cols, OPEN)
                pull = per_slope * nearness
                whole = -pull * inverse
                e = link_at(p, links, count)
                by_own += pull
                first[e] = one
                second[e] = two
                near[e] = whole - whole * weight
                far[e] = whole * weight
                links += 1
    drop = sum * inverse * inverse * inverse
    light[p] = sum * inverse
    light[pixels + p] = by_own * inverse
    light[2 * pixels + p] = by_x * inverse - drop * gx
    light[3 * pixels + p] = by_y * inverse - drop * gy
    held[p] = links


@wp.struct
class Crossing:
    """The nodes beside a crossing, the second one's weight, 1 / distance; 0 where there is none."""

    first: wp.int32
    second: wp.int32
    share: wp.float32
    closeness: wp.float32


@wp.func
def add_link(
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    p: wp.int32,
    made: wp.int32,
    most: wp.int32,
    room: wp.int32,
    at: Crossing,
    part: wp.float32,
):
    """A link of node p to the two nodes of a crossing, ``part`` the derivative by its height; the last one
    takes it in where no more than ``most`` may be. Gives how many there are.
    """
    other = part * at.share
    one = part - other
    if made < most:
        e = link_at(p, made, room)
        first[e] = at.first
        second[e] = at.second
        near[e] = -one
        far[e] = -other
        return made + 1
    e = link_at(p, made - 1, room)
    near[e] -= one
    far[e] -= other
    return made


@wp.func
def copy_links(
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    p: wp.int32,
    made: wp.int32,
    room: wp.int32,
    held: wp.int32,
    other_first: wp.array[wp.int32],
    other_second: wp.array[wp.int32],
    other_near: wp.array[wp.float32],
    other_far: wp.array[wp.float32],
    count: wp.int32,
    part: wp.float32,
):
    """Copies ``held`` links of node p of another image, with room for ``count``, times ``part``. Returns the
    number of links.
    """
    for k in range(held):
        source = link_at(p, k, count)
        to = link_at(p, made + k, room)
        first[to] = other_first[source]
        second[to] = other_second[source]
        near[to] = part * other_near[source]
        far[to] = part * other_far[source]
    return made + held


@wp.func
def below_by_plane(s: wp.float32):
    """Derivative of ``below`` by the plane's slope, with the sign reversed."""
    return arctan(s) + s / (1.0 + s * s)


@wp.func
def below_by(s: wp.float32, plane: wp.float32):
    """Derivative of ``below`` by the slope."""
    q = 1.0 / (1.0 + s * s)
    return 2.0 * q * q * (s - plane)


@wp.func
def between(values: wp.array[wp.float32], start: wp.int32, at: Crossing):
    """At a crossing, of the values of nodes from ``start`` on."""
    a = values[start + at.first]
    return a + at.share * (values[start + at.second] - a)


@wp.kernel
def add_ground(
    light: wp.array[wp.float32],
    held: wp.array[wp.int32],
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    near: wp.array[wp.float32],
    far: wp.array[wp.float32],
    sky_light: wp.array[wp.float32],
    sky_held: wp.array[wp.int32],
    sky_first: wp.array[wp.int32],
    sky_second: wp.array[wp.int32],
    sky_near: wp.array[wp.float32],
    sky_far: wp.array[wp.float32],
    z: wp.array[wp.float32],
    tilts: wp.array[wp.float32],
    sums: wp.array[wp.float32],
    radiance: wp.array[wp.float32],
    ways: wp.array[wp.float32],
    places: wp.array[wp.int32],
    crossings: wp.array[wp.float32],
    all_light: wp.array[wp.float32],
    all_held: wp.array[wp.int32],
    all_first: wp.array[wp.int32],
    all_second: wp.array[wp.int32],
    all_near: wp.array[wp.float32],
    all_far: wp.array[wp.float32],
    number: wp.int32,
    images: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    width: wp.int32,
    shift: wp.int32,
    azimuths: wp.int32,
    steps: wp.int32,
    count: wp.int32,
    sky_count: wp.int32,
    room: wp.int32,
    is_sky: wp.int32,
    sides: wp.int32,
):
    """Light and links of an image with the light that ground sends. Thread p owns node p."""
    p = wp.tid()
    pixels = rows * cols
    x = p % cols
    y = p / cols
    # 1. the mean radiance
    phases = 1 << shift
    place = (y * phases + x % phases) * width + x / phases
    all_places = rows * phases * width
    den = sums[images * all_places + place]
    left = wp.float32(PI) - sky_light[p]
    m = wp.float32(0.0)
    per = wp.float32(0.0)
    if den > 0.0:
        m = sums[number * all_places + place] / den
        per = left / den
    # 2. links of the direct light, and of U
    own = wp.float32(1.0)
    if is_sky != 0:
        own = wp.float32(1.0) - m
    made = copy_links(
        all_first, all_second, all_near, all_far, p, 0, room, held[p], first, second, near, far, count, own
    )
    if is_sky == 0:
        made = copy_links(
            all_first,
            all_second,
            all_near,
            all_far,
            p,
            made,
            room,
            sky_held[p],
            sky_first,
            sky_second,
            sky_near,
            sky_far,
            sky_count,
            -m,
        )
    # 3. those of the strips
    sent = number * pixels
    gx = tilts[p]
    gy = tilts[pixels + p]
    by_own = wp.float32(0.0)
    by_x = wp.float32(0.0)
    by_y = wp.float32(0.0)
    for k in range(wp.where(den > 0.0, azimuths, 0)):
        cosine = ways[4 * k]
        sine = ways[4 * k + 1]
        plane = -(gx * cosine + gy * sine)
        on_columns = ways[4 * k + 2] > 0.0
        slope = plane
        past = below(plane, plane)
        before = wp.float32(0.0)
        was_distance = wp.float32(0.0)
        by_plane = wp.float32(0.0)
        by_top = wp.float32(0.0)
        was = Crossing(p, p, 0.0, 0.0)
        top = Crossing(p, p, 0.0, 0.0)
        # one at least for each azimuth that follows
        most = room - (azimuths - 1 - k)
        for j in range(k * steps, (k + 1) * steps):
            # 3.1 the crossing, if it is on the map, and if any ground there could be seen
            weight = crossings[3 * j]
            distance = crossings[3 * j + 1]
            u = x + places[2 * j]
            v = y + places[2 * j + 1]
            u_next = u + 1
            v_next = v
            if on_columns:
                u_next = u
                v_next = v + 1
            if sides == PERIODIC:
                u = within(u, cols)
                v = within(v, rows)
                u_next = within(u_next, cols)
                v_next = within(v_next, rows)
            elif u < 0 or v < 0 or u_next >= cols or v_next >= rows:
                break
            if not (z[p] > slope * distance):
                break
            at = Crossing(v * cols + u, v_next * cols + u_next, weight, crossings[3 * j + 2])
            a = -z[at.first]
            stands = a + weight * (-z[at.second] - a) + z[p]
            rises = stands * at.closeness
            # 3.2 the strip that it opens, and its derivatives by the crossing, by what bounds it below, and
            # by the crossing before
            if rises > slope:
                low = before - slope * was_distance
                high = stands - slope * distance
                whole = high - low
                here = below(rises, plane)
                begins = low < 0.0 and whole > 0.0 and was_distance > 0.0
                is_between = begins and -low < whole
                part = wp.float32(0.0)
                if begins:
                    part = wp.float32(1.0)
                near_light = between(radiance, sent, was)
                far_light = between(radiance, sent, at)
                by_part = wp.float32(0.0)
                if is_between:
                    part = -low / whole
                    by_part = 0.5 * (here - past) * (far_light - near_light) / (whole * whole)
                mean = 0.5 * (near_light * (1.0 - part) + far_light * (1.0 + part))
                by_slope = by_part * (high * was_distance - low * distance) - mean * below_by(slope, plane)
                if is_between:
                    made = add_link(
                        all_first,
                        all_second,
                        all_near,
                        all_far,
                        p,
                        made,
                        most,
                        room,
                        was,
                        per * -by_part * high,
                    )
                    by_own -= by_part * high
                by_plane -= mean * (below_by_plane(rises) - below_by_plane(slope))
                if top.closeness > 0.0:
                    by_top += by_slope * top.closeness
                    made = add_link(
                        all_first, all_second, all_near, all_far, p, made, most, room, top, per * by_top
                    )
                    by_own += by_top
                else:
                    by_plane += by_slope
                by_top = mean * below_by(rises, plane) * at.closeness + by_part * low
                top = at
                past = here
                slope = rises
            before = stands
            was = at
            was_distance = distance
        # 3.3 all that is not sky
        end = slope
        if sides != PERIODIC:
            end = wp.max(slope, 0.0)
        if sides == DARK:
            closeness = 1.0 / wall_of(way_of(cosine, sine), x, y, rows, cols)
            wall = z[p] * closeness
            if wall > end:
                by_own -= m * below_by(wall, plane) * closeness
            end = wp.max(wall, end)
        by_plane += m * (below_by_plane(end) - below_by_plane(plane))
        if top.closeness > 0.0:
            if end == slope:
                by_top -= m * below_by(end, plane) * top.closeness
            made = add_link(all_first, all_second, all_near, all_far, p, made, most, room, top, per * by_top)
            by_own += by_top
        by_x -= cosine * by_plane
        by_y -= sine * by_plane
    all_held[p] = made
    all_light[p] = light[p] + left * m
    all_light[pixels + p] = light[pixels + p] - m * sky_light[pixels + p] + per * by_own
    all_light[2 * pixels + p] = light[2 * pixels + p] - m * sky_light[2 * pixels + p] + per * by_x
    all_light[3 * pixels + p] = light[3 * pixels + p] - m * sky_light[3 * pixels + p] + per * by_y
