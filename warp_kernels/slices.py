"""Light of a finite source, a ball or a flat quadrangle, through a few azimuth slices per pixel. Twin of
opencl/slices.cl.

In the slice at azimuth phi the source covers a chord of elevations; what ground, tangent plane and level
leave of it gives E = sum over slices of share x (n_c integral of B cos^2 + n_z integral of B sin cos), n_c
the normal's part along phi. Elevations go by their tangents. Lengths are in units of the spacing; heights
grow towards the viewer.

  heights      (rows + 2, cols + 1)   float32  -depth, and one element more; NONE where masked, in column 0,
                                               in the first and the last row: node (x, y) stands at
                                               (y + 1) (cols + 1) + x + 1, and every neighbour of a node can
                                               be read
  tops         (cells, width)         float32  highest node of square cells, corners included: level l = 1,
                                               2.. has cells 2^l wide, from column width - (width >> l - 1)
                                               on; width is a multiple of 2^levels
  sky          (side, side)           float32  of light in a lobe: brightness over the stereographic plane, x
                                               / (1 - z) and y / (1 - z) from -1 to 1
  points       (n_points, 2)          float32  where along a chord that brightness is taken, 0..1, and
                                               weights; none: it is 1
  lobe         (n_lobe)               float32  weight of light by 1 - cosine of its angle to the mirror
                                               direction, even steps from 0 to rim, beyond which there is
                                               none; n_lobe 0: all light counts alike
  chords       (n_turns, n_knots, 2)  float32  of light in no lobe: integrals of B cos^2 and B sin cos over
                                               elevation, from the sine k / (n_knots - 1) to the zenith, means
                                               over n_turns even cells of the diamond angle q = s / (|c| +
                                               |s|), 2 - q, 4 + q of the azimuth's cosine c and sine s, 0..4;
                                               n_knots 0: B is 1
  irradiance   (rows, cols)           float32  out; factor: of it
  least, most                         int32    slices of a source that is a point, and of one that stands all
                                               round: multiples of SLICES, as what is between
  highest                             float32  of the heights
  dark                                int32    whether walls stand half a node outside the map, up to height 0

A thread owns one node, and a block of threads a square of nodes. Order of summation: slices.
"""

import warp as wp

from skylamp.constants import (
    CHORD_TANGENT,
    ENDLESS,
    NONE,
    SLICES,
    SQUARE,
    STEEP,
    TURN_BY_SINE,
    TURN_BY_TANGENT,
)

from . import OPTIONS
from .horizon import read

wp.set_module_options(OPTIONS)

B0, B1, B2, B3, B4, B5, B6, B7 = CHORD_TANGENT
SINE_1, SINE_3 = TURN_BY_SINE
TANGENT_1, TANGENT_3 = TURN_BY_TANGENT
# threads of a block, and blocks that a multiprocessor shall hold: 64 registers each
BOUNDS = (SQUARE * SQUARE, 16)


@wp.func
def node_of(squares: wp.int32, i: wp.int32):
    """(x, y) of thread i of a row of squares of SQUARE x SQUARE nodes."""
    x = i // (SQUARE * SQUARE) * SQUARE + i % SQUARE
    y = squares * SQUARE + i % (SQUARE * SQUARE) // SQUARE
    return x, y


@wp.kernel
def coarser(
    heights: wp.array[wp.float32],
    tops: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    width: wp.int32,
    level: wp.int32,
):
    """One level of tops, from the heights (level 1) or from the level before. Thread (y, x) owns a cell."""
    y, x = wp.tid()
    top = wp.float32(NONE)
    if level == 1:
        for j in range(2 * y, wp.min(2 * y + 3, rows)):
            for i in range(2 * x, wp.min(2 * x + 3, cols)):
                top = wp.max(top, heights[(j + 1) * (cols + 1) + i + 1])
    else:
        finer = width - (width >> (level - 2))
        for j in range(2 * y, wp.min(2 * y + 2, ((rows - 1) >> (level - 1)) + 1)):
            for i in range(2 * x, 2 * x + 2):
                top = wp.max(top, tops[j * width + finer + i])
    tops[y * width + width - (width >> (level - 1)) + x] = top


@wp.struct
class Pixel:
    """Values that all slices of a pixel share. A point (c t, s t, v) from the pixel stands before the source
    iff along t + up v < reach, ``along`` the slice's own. radius: of a ball, 0 for a quadrangle, below 0 for
    the sky.
    """

    heights: wp.array[wp.float32]
    tops: wp.array[wp.float32]
    sky: wp.array[wp.float32]
    points: wp.array[wp.float32]
    lobe: wp.array[wp.float32]
    chords: wp.array[wp.float32]
    rows: wp.int32
    cols: wp.int32
    width: wp.int32
    levels: wp.int32
    side: wp.int32
    n_points: wp.int32
    n_lobe: wp.int32
    n_turns: wp.int32
    n_knots: wp.int32
    dark: wp.int32
    x: wp.int32
    y: wp.int32
    height: wp.float32
    tilt_x: wp.float32
    tilt_y: wp.float32
    rim: wp.float32
    above: wp.float32
    mirror_x: wp.float32
    mirror_y: wp.float32
    mirror_z: wp.float32
    up: wp.float32
    reach: wp.float32
    radius: wp.float32


@wp.func
def above_all(highest: wp.float32, height: wp.float32):
    """How far the highest ground stands above a node, and no less for rounding."""
    return highest - height + 1e-6 * (wp.abs(highest) + wp.abs(height))


@wp.func
def slope_between(low: wp.float32, here: wp.float32, high: wp.float32):
    if low > NONE and high > NONE:
        return (low - high) * 0.5
    if low > NONE:
        return low - here
    if high > NONE:
        return here - high
    return wp.float32(0.0)


@wp.func
def under_source(pixel: Pixel, along: wp.float32, aside: wp.float32, t: wp.float32):
    """The tangent at which a column at distance t goes into the source: what stands in it there hides no more
    than what is below.
    """
    if pixel.radius > 0.0:
        offset = t - along
        square = pixel.radius * pixel.radius - aside * aside - offset * offset
        if square > 0.0:
            return (pixel.up - wp.sqrt(square)) / t
        return wp.float32(ENDLESS)
    if pixel.up > 0.0:
        return (pixel.reach / t - along) / pixel.up
    return wp.float32(ENDLESS)


@wp.func
def horizon(
    pixel: Pixel,
    begin: wp.float32,
    c: wp.float32,
    s: wp.float32,
    start: wp.float32,
    high: wp.float32,
    along: wp.float32,
    aside: wp.float32,
):
    """The tangent of the horizon along (c, s), from ``start`` on, over the ground before the source and as
    far as ``high`` matters. The slice begins at a distance of ``begin``, on the map.

    The slice goes from cell to cell of a quadtree, and no farther than where it is above all ground. A large
    cell whose top stays below the line is left as a whole, else its quarters are looked at; the way out of a
    single cell is a crossing with a grid line. u and v count cells the way that the slice goes: x or -1 - x,
    so that a cell's far side is always the greater one.
    """
    x = pixel.x
    y = pixel.y
    stride = pixel.cols + 1
    abs_c = wp.abs(c)
    abs_s = wp.abs(s)
    per_x = wp.float32(ENDLESS)
    per_y = wp.float32(ENDLESS)
    end = wp.float32(ENDLESS)
    flip_x = wp.where(c < 0.0, -1, 0)
    flip_y = wp.where(s < 0.0, -1, 0)
    from_x = (x ^ flip_x) - flip_x
    from_y = (y ^ flip_y) - flip_y
    if c != 0.0:
        per_x = 1.0 / abs_c
        end = wp.float32(wp.where(c > 0.0, pixel.cols - 1 - x, x)) * per_x
    if s != 0.0:
        per_y = 1.0 / abs_s
        end = wp.min(end, wp.float32(wp.where(s > 0.0, pixel.rows - 1 - y, y)) * per_y)
    slope = wp.float32(start)
    if slope > 0.0:
        end = wp.min(end, pixel.above / slope)
    t = wp.float32(begin)
    u = from_x + wp.int32(abs_c * t)
    v = from_y + wp.int32(abs_s * t)
    level = wp.int32(0)
    while slope < high and t < end and t * (along + slope * pixel.up) < pixel.reach:
        # 1. down to a cell whose top stays below the line where it comes in, or to a single one
        while level > 0:
            first = pixel.width - (pixel.width >> (level - 1))
            cell = ((v >> level) ^ flip_y) * pixel.width + first + ((u >> level) ^ flip_x)
            if not read(pixel.tops, cell) - pixel.height > slope * t:
                break
            level -= 1
        # 2. the way out of it
        mask = (1 << level) - 1
        edge_u = (u | mask) + 1
        edge_v = (v | mask) + 1
        out_x = wp.float32(edge_u - from_x) * per_x
        out_y = wp.float32(edge_v - from_y) * per_y
        by_x = out_x <= out_y
        out = wp.where(by_x, out_x, out_y)
        if level == 0:
            # 3. the ground there
            node_x = wp.where(by_x, (edge_u ^ flip_x) - flip_x, u ^ flip_x)
            node_y = wp.where(by_x, v ^ flip_y, (edge_v ^ flip_y) - flip_y)
            low = (node_y + 1) * stride + node_x + 1
            across = wp.where(by_x, s, c) * out
            part = wp.clamp(across - wp.float32(wp.where(by_x, node_y - y, node_x - x)), 0.0, 1.0)
            rise = (
                read(pixel.heights, low) * (1.0 - part)
                + read(pixel.heights, low + wp.where(by_x, stride, 1)) * part
                - pixel.height
            )
            if rise > slope * out and out * (along + slope * pixel.up) < pixel.reach:
                slope = wp.max(slope, wp.min(rise / out, under_source(pixel, along, aside, out)))
        # 4. on, and up where a larger cell begins
        last = wp.where(by_x, v, u) | mask
        to = wp.int32(wp.where(by_x, abs_s, abs_c) * out) + wp.where(by_x, from_y, from_x)
        to = wp.clamp(to, last - mask, last)
        begins = (wp.where(by_x, edge_u, edge_v) >> level & 1) == 0
        u = wp.where(by_x, edge_u, to)
        v = wp.where(by_x, to, edge_v)
        t = out
        if begins and level < pixel.levels:
            level += 1
    return slope


@wp.func
def copy_of(node: wp.int32, steps: wp.int32, way: wp.float32, size: wp.int32, period: wp.int32):
    """The copy of a node on a map that repeats from which a slice has most of the map ahead, some steps
    on.
    """
    back = (node + steps) / period
    on = (size - 1 - node + steps) / period
    return node + period * wp.where(way < 0.0, on, -back)


@wp.func
def repeated_horizon(
    pixel: Pixel,
    x: wp.int32,
    y: wp.int32,
    period_y: wp.int32,
    period_x: wp.int32,
    c: wp.float32,
    s: wp.float32,
    start: wp.float32,
    high: wp.float32,
    along: wp.float32,
):
    """As `horizon`, over a map that repeats: a slice that leaves it goes on from the same place of a copy.
    The map is larger than a period by more than 1e-6 of the way, so that every lap leads on. (x, y): the
    node.
    """
    abs_c = wp.abs(c)
    abs_s = wp.abs(s)
    slope = wp.float32(start)
    t = wp.float32(0.0)
    while slope < high and t * slope < pixel.above and t * along < pixel.reach:
        pixel.x = copy_of(x, wp.int32(abs_c * t), c, pixel.cols, period_x)
        pixel.y = copy_of(y, wp.int32(abs_s * t), s, pixel.rows, period_y)
        slope = horizon(pixel, t, c, s, slope, high, along, 0.0)
        end_x = wp.float32(wp.where(c < 0.0, pixel.x, pixel.cols - 1 - pixel.x)) / wp.max(abs_c, 1e-30)
        end_y = wp.float32(wp.where(s < 0.0, pixel.y, pixel.rows - 1 - pixel.y)) / wp.max(abs_s, 1e-30)
        t = wp.min(end_x, end_y) * (1.0 - 1e-6)  # rounding passes over no crossing
    return slope


@wp.func
def in_lobe(pixel: Pixel, c: wp.float32, s: wp.float32, cosine: wp.float32, sine: wp.float32):
    """The lobe's weight of the direction whose elevation has this cosine and sine."""
    x = cosine - (pixel.mirror_x * c + pixel.mirror_y * s)
    y = pixel.mirror_y * c - pixel.mirror_x * s
    z = sine - pixel.mirror_z
    most = wp.float32(pixel.n_lobe - 1)
    at = wp.min((x * x + y * y + z * z) * (0.5 * most / pixel.rim), most)  # 1 - cos is half of |L - R|^2
    i = wp.min(wp.int32(at), pixel.n_lobe - 2)
    first = pixel.lobe[i]
    return first + (at - wp.float32(i)) * (pixel.lobe[i + 1] - first)


@wp.func
def brightness_of(
    pixel: Pixel, c: wp.float32, s: wp.float32, tilt: wp.float32, low: wp.float32, high: wp.float32
):
    """Mean brightness of the chord between two tangents, weighted by the cosine to the normal and by the
    lobe.
    """
    half = 0.5 * wp.float32(pixel.side - 1)
    most = pixel.side - 2
    low_c = 1.0 / wp.sqrt(low * low + 1.0)
    high_c = 1.0 / wp.sqrt(high * high + 1.0)
    low_s = low * low_c
    high_s = high * high_c
    total = wp.float32(0.0)
    all = wp.float32(0.0)
    for k in range(pixel.n_points):
        f = pixel.points[2 * k]
        weight = pixel.points[2 * k + 1]
        cosine = low_c + f * (high_c - low_c)
        sine = low_s + f * (high_s - low_s)
        square = cosine * cosine + sine * sine
        from_zenith = half * cosine / (wp.sqrt(square) + sine)
        u = half + from_zenith * c
        v = half + from_zenith * s
        i = wp.clamp(wp.int32(u), 0, most)
        j = wp.clamp(wp.int32(v), 0, most)
        at = j * pixel.side + i
        p = u - wp.float32(i)
        q = v - wp.float32(j)
        near = pixel.sky[at] * (1.0 - p) + pixel.sky[at + 1] * p
        far = pixel.sky[at + pixel.side] * (1.0 - p) + pixel.sky[at + pixel.side + 1] * p
        share = weight / (square * square) * cosine * wp.max(tilt * cosine + sine, 0.0)
        length = wp.sqrt(square)
        light = (near * (1.0 - q) + far * q) * in_lobe(pixel, c, s, cosine / length, sine / length)
        total += share * light
        all += share
    return total / wp.max(all, 1.0 / ENDLESS)


@wp.func
def arctan(x: wp.float32):
    """atan(x), 0 <= x <= 1, to 2e-7."""
    y = x * x
    total = wp.float32(B0)
    total = total * y + B1
    total = total * y + B2
    total = total * y + B3
    total = total * y + B4
    total = total * y + B5
    total = total * y + B6
    return x * (total * y + B7)


@wp.func
def mean_cosine(a: wp.float32, b: wp.float32):
    """Mean of the cosine over the sines between two near directions with cosines a and b, to second order
    even at the zenith.
    """
    return (a * a + a * b + b * b) / wp.max(1.5 * (a + b), 1.0 / ENDLESS)


@wp.func
def blended(pixel: Pixel, before: wp.int32, after: wp.int32, part: wp.float32, knot: wp.int32):
    """Both integrals from a knot to the zenith, between two turns."""
    i = 2 * (before * pixel.n_knots + knot)
    j = 2 * (after * pixel.n_knots + knot)
    return wp.vec2(
        pixel.chords[i] * (1.0 - part) + pixel.chords[j] * part,
        pixel.chords[i + 1] * (1.0 - part) + pixel.chords[j + 1] * part,
    )


@wp.func
def of_chords(
    pixel: Pixel,
    c: wp.float32,
    s: wp.float32,
    tilt: wp.float32,
    low: wp.float32,
    high: wp.float32,
    by_cosine: wp.float32,
    by_sine: wp.float32,
):
    """As chord(), from the table; by_cosine, by_sine: what the chord is worth where brightness is 1.

    Brightness is even between two knots. Sines and cosines are in steps of the knots' sines, so are `even`
    integrals.
    """
    # 1. the cells of azimuth beside
    diamond = s / (wp.abs(c) + wp.abs(s))
    if c < 0.0:
        diamond = 2.0 - diamond
    elif s < 0.0:
        diamond = 4.0 + diamond
    place = diamond * (0.25 * wp.float32(pixel.n_turns)) + 0.5
    after = wp.min(wp.int32(place), pixel.n_turns)
    turn = place - wp.float32(after)
    before = wp.where(after > 0, after - 1, pixel.n_turns - 1)
    after = wp.where(after < pixel.n_turns, after, 0)
    # 2. the knots below the ends
    steps = pixel.n_knots - 1
    size = wp.float32(steps)
    low_c = size / wp.sqrt(low * low + 1.0)
    high_c = size / wp.sqrt(high * high + 1.0)
    low_s = low * low_c
    high_s = high * high_c
    i = wp.clamp(wp.int32(low_s), 0, steps - 1)
    j = wp.clamp(wp.int32(high_s), 0, steps - 1)
    low_0 = blended(pixel, before, after, turn, i)
    low_1 = blended(pixel, before, after, turn, i + 1)
    high_0 = blended(pixel, before, after, turn, j)
    high_1 = blended(pixel, before, after, turn, j + 1)
    at_i = wp.sqrt(wp.float32((steps - i) * (steps + i)))
    at_j = wp.sqrt(wp.float32((steps - j) * (steps + j)))
    # 3. the even integrals: of both cells, and what of them lies below the ends
    low_all = wp.vec2(
        mean_cosine(at_i, wp.sqrt(wp.float32((steps - i - 1) * (steps + i + 1)))), wp.float32(i) + 0.5
    )
    high_all = wp.vec2(
        mean_cosine(at_j, wp.sqrt(wp.float32((steps - j - 1) * (steps + j + 1)))), wp.float32(j) + 0.5
    )
    rest = low_s - wp.float32(i)
    low_part = wp.vec2(rest * mean_cosine(at_i, low_c), rest * 0.5 * (low_s + wp.float32(i)))
    rest = high_s - wp.float32(j)
    high_part = wp.vec2(rest * mean_cosine(at_j, high_c), rest * 0.5 * (high_s + wp.float32(j)))
    # 4. brightness there; in one cell or two neighbours the closed forms leave short chords all digits
    here = wp.cw_div(low_0 - low_1, low_all)
    there = wp.cw_div(high_0 - high_1, high_all)
    if j <= i + 1:
        light = here * (size * size)
        return tilt * (light[0] * by_cosine + (there[0] - here[0]) * high_part[0]) + (
            light[1] * by_sine + (there[1] - here[1]) * high_part[1]
        )
    whole = (low_1 - high_0) + wp.cw_mul(here, low_all - low_part) + wp.cw_mul(there, high_part)
    return tilt * whole[0] + whole[1]


@wp.func
def chord(pixel: Pixel, c: wp.float32, s: wp.float32, low: wp.float32, high: wp.float32, rise: wp.float32):
    """Integral of B (tilt cos^2 + sin cos) of elevation between the tangents low and high, which are ``rise``
    apart.
    """
    if not low < high:
        return wp.float32(0.0)
    tilt = pixel.tilt_x * c + pixel.tilt_y * s
    product = low * high
    r = wp.sqrt((low * low + 1.0) * (high * high + 1.0))
    sine = rise / r
    by_cosine = arctan(rise / (r + 1.0 + product)) + 0.5 * ((1.0 - product) / r * sine)
    by_sine = 0.5 * ((low + high) / r * sine)
    if pixel.n_knots > 0:
        return of_chords(pixel, c, s, tilt, low, high, by_cosine, by_sine)
    light = wp.float32(1.0)
    if pixel.n_points > 0:
        light = brightness_of(pixel, c, s, tilt, low, high)
    return light * (tilt * by_cosine + by_sine)


@wp.func
def to_wall(ends: wp.int32, at: wp.int32, along: wp.float32):
    """How far the walls before the first of ``ends`` nodes and behind the last one are from node ``at``."""
    if along > 0.0:
        return (wp.float32(ends) - 0.5 - wp.float32(at)) / along
    if along < 0.0:
        return (-0.5 - wp.float32(at)) / along
    return wp.float32(ENDLESS)


@wp.func
def to_rim(
    pixel: Pixel, c: wp.float32, s: wp.float32, before: wp.float32, after: wp.float32, rise: wp.float32
):
    """The part of the chord between two tangents that a slice along (c, s) leaves within the lobe's rim, and
    how far they are apart.
    """
    least = 1.0 - pixel.rim
    up = pixel.mirror_z
    in_plane = pixel.mirror_x * c + pixel.mirror_y * s
    square = in_plane * in_plane + up * up - least * least
    half = wp.sqrt(wp.max(square, 0.0))  # of the chord: least is to it as cosine to sine
    low_c = in_plane * least + up * half
    high_c = in_plane * least - up * half
    start = wp.where(up > 0.0, STEEP, -STEEP)
    stop = start
    if low_c > 0.0:
        start = (up * least - in_plane * half) / low_c
    if high_c > 0.0:
        stop = (up * least + in_plane * half) / high_c
    low = wp.max(before, start)
    high = wp.where(square > 0.0, wp.min(after, stop), -STEEP)
    if start > before or stop < after:
        return wp.vec3(low, high, high - low)
    return wp.vec3(low, high, rise)


@wp.func
def slice_light(
    pixel: Pixel,
    c: wp.float32,
    s: wp.float32,
    along: wp.float32,
    aside: wp.float32,
    before: wp.float32,
    after: wp.float32,
    apart: wp.float32,
):
    """The light through a slice along (c, s) of a source between the tangents before and after, ``apart``
    apart; aside: how far its middle stands from the slice.
    """
    low = before
    high = after
    rise = apart
    if pixel.n_lobe > 0:
        chord_left = to_rim(pixel, c, s, before, after, apart)
        low = chord_left[0]
        high = chord_left[1]
        rise = chord_left[2]
    # 1. the tangent plane and the level
    plane = -(pixel.tilt_x * c + pixel.tilt_y * s)
    slope = wp.clamp(wp.max(low, plane), 0.0, STEEP)
    if pixel.dark == 0:
        slope = horizon(pixel, 0.0, c, s, slope, high, along, aside)
        return chord(pixel, c, s, slope, high, wp.where(slope > low, high - slope, rise))
    # 2. the wall hides what lies beyond it: tangents up to `under`, and from `over` on, but none from its top
    # on
    wall = wp.min(to_wall(pixel.cols, pixel.x, c), to_wall(pixel.rows, pixel.y, s))
    top = -pixel.height / wall
    under = -ENDLESS
    over = wp.float32(ENDLESS)
    if pixel.radius > 0.0:
        offset = wall - along
        square = pixel.radius * pixel.radius - aside * aside - offset * offset
        half = wp.sqrt(wp.max(square, 0.0))  # of where the wall cuts the ball
        if pixel.reach > 0.0 and wall * (along + slope * pixel.up) < pixel.reach:
            under = wp.where(square > 0.0, (pixel.up - half) / wall, ENDLESS)
        if pixel.reach > 0.0 and wall * (along + high * pixel.up) < pixel.reach:
            over = wp.where(square > 0.0, (pixel.up + half) / wall, ENDLESS)
    else:
        up = wp.where(pixel.up == 0.0, 1.0 / ENDLESS, pixel.up)
        meets = (pixel.reach / wall - along) / up
        if pixel.radius < 0.0:
            under = wp.float32(ENDLESS)
        elif up > 0.0:
            under = meets
        else:
            over = meets
    slope = wp.max(slope, wp.min(under, top))
    split = over < top
    left = wp.where(split, wp.min(high, over), high)
    most = wp.where(split and high <= top, left, high)
    slope = horizon(pixel, 0.0, c, s, slope, most, along, aside)
    total = chord(pixel, c, s, slope, left, wp.where(slope > low or left < high, left - slope, rise))
    if split:
        above = wp.max(slope, top)
        total += chord(pixel, c, s, above, high, high - above)
    return total


@wp.func
def tilt_of(heights: wp.array[wp.float32], here: wp.int32, stride: wp.int32):
    own = heights[here]
    return wp.vec2(
        slope_between(heights[here - 1], own, heights[here + 1]),
        slope_between(heights[here - stride], own, heights[here + stride]),
    )


@wp.func
def mirror_of(tilt: wp.vec2):
    """Where a viewer straight above looks by way of the surface."""
    twice = 2.0 / (1.0 + tilt[0] * tilt[0] + tilt[1] * tilt[1])
    return wp.vec3(twice * tilt[0], twice * tilt[1], twice - 1.0)


@wp.kernel(launch_bounds=BOUNDS)
def ball(
    heights: wp.array[wp.float32],
    tops: wp.array[wp.float32],
    quadrature: wp.array[wp.float32],
    sky: wp.array[wp.float32],
    points: wp.array[wp.float32],
    lobe: wp.array[wp.float32],
    chords: wp.array[wp.float32],
    irradiance: wp.array[wp.float32],
    alternating: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    width: wp.int32,
    levels: wp.int32,
    least: wp.int32,
    most: wp.int32,
    side: wp.int32,
    n_points: wp.int32,
    n_lobe: wp.int32,
    n_turns: wp.int32,
    n_knots: wp.int32,
    dark: wp.int32,
    rim: wp.float32,
    highest: wp.float32,
    x0: wp.float32,
    y0: wp.float32,
    z0: wp.float32,
    radius: wp.float32,
    factor: wp.float32,
):
    """x0, y0, z0: its centre (z0 a height), and its radius.

      quadrature   (most / SLICES, 4, most)  float32  for SLICES, 2 SLICES.. slices: sine and cosine of theta,
                                                      midpoints of -pi/2..pi/2, and of the azimuths of
                                                      midpoints all round; or other places in the same even
                                                      steps
      alternating  (rows, cols)              float32  out: the even slices' light less that of the odd ones,
                                                      a measure of the error by too few slices

    The slice at the azimuth offset d from the centre, sin d = (sin a / cos e) sin theta, a the ball's angular
    radius and e its centre's elevation, holds a chord of half width w, sin w = sin a cos theta / r, r^2 = 1 -
    cos^2 e sin^2 d. Where the zenith lies within the disc, slices go all round.
    """
    squares, thread = wp.tid()
    x, y = node_of(squares, thread)
    if x >= cols or y >= rows:
        return
    here = (y + 1) * (cols + 1) + x + 1
    tilt = tilt_of(heights, here, cols + 1)
    mirror = mirror_of(tilt)
    pixel = Pixel(
        heights,
        tops,
        sky,
        points,
        lobe,
        chords,
        rows,
        cols,
        width,
        levels,
        side,
        n_points,
        n_lobe,
        n_turns,
        n_knots,
        dark,
        x,
        y,
        heights[here],
        tilt[0],
        tilt[1],
        rim,
        above_all(highest, heights[here]),
        mirror[0],
        mirror[1],
        mirror[2],
        0.0,
        0.0,
        radius,
    )

    # 1. where the ball stands, and how many slices it is worth
    dx = x0 - wp.float32(x)
    dy = y0 - wp.float32(y)
    dz = z0 - pixel.height
    flat = wp.sqrt(dx * dx + dy * dy)
    far = wp.sqrt(flat * flat + dz * dz)
    inside = far <= radius
    ux = wp.float32(1.0)
    uy = wp.float32(0.0)
    sin_e = wp.float32(1.0)
    cos_e = wp.float32(0.0)
    sin_a = wp.float32(1.0)
    cos_a = wp.float32(0.0)
    beyond = wp.float32(0.0)
    if flat > 0.0:
        ux = dx / flat
        uy = dy / flat
    if far > 0.0:
        sin_e = dz / far
        cos_e = flat / far
    if not inside:
        beyond = (far - radius) * (far + radius)
        sin_a = radius / far
        cos_a = wp.sqrt(beyond) / far
    all_round = sin_a >= cos_e
    widest = wp.float32(1.0)
    turn = wp.float32(1.0)
    if not all_round:
        widest = sin_a / cos_e
        turn = widest * (SINE_1 + SINE_3 * widest * widest)  # share of the circle, nearly
    blocks = wp.min((least + wp.int32(turn * wp.float32(most - least))) // SLICES, most // SLICES)
    n_slices = blocks * SLICES
    step = wp.float32(wp.pi) / wp.float32(n_slices)
    own = (blocks - 1) * 4 * most
    pixel.up = dz
    pixel.reach = beyond

    # 2. its slices
    total = wp.float32(0.0)
    other = wp.float32(0.0)
    if pixel.height > NONE and (inside or dz + radius > 0.0):
        for j in range(n_slices):
            sin_d = widest * quadrature[own + j]
            half = sin_a * quadrature[own + most + j]
            cos_d = wp.sqrt((1.0 - sin_d) * (1.0 + sin_d))
            share = (
                widest * step * quadrature[own + most + j] / wp.max(cos_d, 1e-6)
            )  # no less but where there is no chord
            if all_round:
                sin_d = quadrature[own + 2 * most + j]
                cos_d = quadrature[own + 3 * most + j]
                half = wp.sqrt(wp.max(sin_a * sin_a - cos_e * cos_e * (sin_d * sin_d), 0.0))
                share = 2.0 * step
            in_plane = cos_e * cos_d
            square = in_plane * in_plane + sin_e * sin_e
            low_c = in_plane * cos_a + sin_e * half
            low_s = sin_e * cos_a - in_plane * half
            high_c = in_plane * cos_a - sin_e * half
            high_s = sin_e * cos_a + in_plane * half
            low = wp.where(low_s > 0.0, STEEP, -STEEP)
            high = wp.where(sin_e > 0.0, STEEP, -STEEP)
            if low_c > 0.0:
                low = low_s / low_c
            if high_c > 0.0:
                high = high_s / high_c
            if inside:
                low = -STEEP
            if inside or high > STEEP:
                high = wp.float32(STEEP)
            rise = high - low
            if low_c > 0.0 and high < STEEP:
                rise = 2.0 * cos_a * half * square / (low_c * high_c)
            light = share * slice_light(
                pixel,
                ux * cos_d - uy * sin_d,
                uy * cos_d + ux * sin_d,
                flat * cos_d,
                flat * sin_d,
                low,
                high,
                rise,
            )
            total += light
            other += wp.where((j & 1) == 0, light, -light)
    slant = wp.sqrt(1.0 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y)
    irradiance[y * cols + x] = factor * total / slant
    alternating[y * cols + x] = factor * other / slant


@wp.func
def sector_between(ax: wp.float32, ay: wp.float32, bx: wp.float32, by: wp.float32):
    """Azimuths between two directions: the bisector (c, s), and the tangent of a quarter of the angle."""
    length_a = wp.sqrt(ax * ax + ay * ay)
    product = length_a * wp.sqrt(bx * bx + by * by)
    cosine = ax * bx + ay * by  # times product
    sine = ax * by - ay * bx
    half = wp.max(sine, 0.0) / (product + wp.max(cosine, 0.0))
    if cosine < 0.0:
        half = (product - cosine) / wp.max(sine, 1e-7 * product)
    r = wp.sqrt(1.0 + half * half)
    scale = 1.0 / (r * length_a)
    return wp.vec3((ax - ay * half) * scale, (ay + ax * half) * scale, half / (1.0 + r))


@wp.func
def share_of(quarter: wp.float32):
    """The angle by its quarter's tangent: share of the circle, nearly, up to half of it."""
    return quarter * (TANGENT_1 - TANGENT_3 * quarter * quarter)


@wp.func
def in_order(px: wp.vec4, py: wp.vec4, i: wp.int32, j: wp.int32):
    """Directions i and j of four swapped where the second does not lie to the left."""
    ax = px[i]
    ay = py[i]
    bx = px[j]
    by = py[j]
    if ax * by - ay * bx < 0.0:
        px[i] = bx
        py[i] = by
        px[j] = ax
        py[j] = ay
    return px, py


@wp.kernel(launch_bounds=BOUNDS)
def quad(
    heights: wp.array[wp.float32],
    tops: wp.array[wp.float32],
    corners: wp.array[wp.float32],
    quadrature: wp.array[wp.float32],
    sky: wp.array[wp.float32],
    points: wp.array[wp.float32],
    lobe: wp.array[wp.float32],
    chords: wp.array[wp.float32],
    irradiance: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    width: wp.int32,
    levels: wp.int32,
    least: wp.int32,
    most: wp.int32,
    side: wp.int32,
    n_points: wp.int32,
    n_lobe: wp.int32,
    n_turns: wp.int32,
    n_knots: wp.int32,
    dark: wp.int32,
    rim: wp.float32,
    highest: wp.float32,
    factor: wp.float32,
):
    """A flat, convex quadrangle, which shines from both faces.

      corners  (6, 3)           float32  four corners round it, from their middle; the middle; the unit
                                         normal. Third: heights
      quadrature  (most, most, 2)  float32  row n - 1: Gauss-Legendre nodes, -1..1, and weights of n slices

    Between the azimuths of neighbouring corners the chord's ends run along one edge each: every such sector
    gets its share of the slices, at least one. All is computed from the quadrangle's middle, so that small
    far sources lose no digits.
    """
    squares, thread = wp.tid()
    x, y = node_of(squares, thread)
    if x >= cols or y >= rows:
        return
    here = (y + 1) * (cols + 1) + x + 1
    tilt = tilt_of(heights, here, cols + 1)
    mirror = mirror_of(tilt)
    pixel = Pixel(
        heights,
        tops,
        sky,
        points,
        lobe,
        chords,
        rows,
        cols,
        width,
        levels,
        side,
        n_points,
        n_lobe,
        n_turns,
        n_knots,
        dark,
        x,
        y,
        heights[here],
        tilt[0],
        tilt[1],
        rim,
        above_all(highest, heights[here]),
        mirror[0],
        mirror[1],
        mirror[2],
        0.0,
        0.0,
        0.0,
    )

    # 1. the corners, in the frame that points below the middle
    dx = corners[12] - wp.float32(x)
    dy = corners[13] - wp.float32(y)
    dz = corners[14] - pixel.height
    flat = wp.sqrt(dx * dx + dy * dy)
    ux = wp.float32(1.0)
    uy = wp.float32(0.0)
    if flat > 0.0:
        ux = dx / flat
        uy = dy / flat
    ax = wp.vec4()  # corners
    ay = wp.vec4()
    away = wp.vec4()  # from the middle
    up = wp.vec4()
    turn = wp.vec4()
    top = -ENDLESS
    for i in range(4):
        away[i] = corners[3 * i] * ux + corners[3 * i + 1] * uy
        ay[i] = corners[3 * i + 1] * ux - corners[3 * i] * uy
        up[i] = corners[3 * i + 2]
        ax[i] = flat + away[i]
        if ax[i] == 0.0 and ay[i] == 0.0:
            ax[i] = 1e-6
        top = wp.max(top, dz + up[i])
    for i in range(4):
        j = (i + 1) % 4
        turn[i] = ax[i] * (ay[j] - ay[i]) - ay[i] * (ax[j] - ax[i])
    left = turn[0] >= 0.0 and turn[1] >= 0.0 and turn[2] >= 0.0 and turn[3] >= 0.0
    right = turn[0] <= 0.0 and turn[1] <= 0.0 and turn[2] <= 0.0 and turn[3] <= 0.0
    within = left != right  # the zenith or the nadir lies in the quadrangle
    normal_x = corners[15] * ux + corners[16] * uy
    normal_y = corners[16] * ux - corners[15] * uy
    apart = flat * normal_x + dz * corners[17]
    sense = wp.where(apart < 0.0, wp.float32(-1.0), wp.float32(1.0))
    pixel.up = sense * corners[17]
    pixel.reach = sense * apart

    # 2. sectors, and how many slices they are worth
    px = wp.vec4(ax[0], ax[1], ax[2], ax[3])
    py = wp.vec4(ay[0], ay[1], ay[2], ay[3])
    if right and within:
        px = wp.vec4(ax[3], ax[2], ax[1], ax[0])
        py = wp.vec4(ay[3], ay[2], ay[1], ay[0])
    if not within:
        px, py = in_order(px, py, 0, 1)
        px, py = in_order(px, py, 2, 3)
        px, py = in_order(px, py, 0, 2)
        px, py = in_order(px, py, 1, 3)
        px, py = in_order(px, py, 1, 2)
    a = sector_between(px[0], py[0], px[1], py[1])
    b = sector_between(px[1], py[1], px[2], py[2])
    c = sector_between(px[2], py[2], px[3], py[3])
    d = sector_between(px[3], py[3], px[0], py[0])
    if not within:
        d[2] = 0.0
    to_a = share_of(a[2])
    to_b = to_a + share_of(b[2])
    to_c = to_b + share_of(c[2])
    all = to_c + share_of(d[2])
    blocks = wp.min((least + wp.int32(all * wp.float32(most - least))) // SLICES, most // SLICES)
    n_slices = blocks * SLICES
    narrow = 1e-4 * all  # a sector below that is left out
    # an eighth of the slices for every sector, the rest by width: below a slit narrow sectors have most light
    used_a = wp.where(to_a > narrow, blocks, 0)
    used_b = used_a + wp.where(to_b - to_a > narrow, blocks, 0)
    used_c = used_b + wp.where(to_c - to_b > narrow, blocks, 0)
    used = used_c + wp.where(all - to_c > narrow, blocks, 0)
    more = wp.float32(0.0)
    if all > 0.0:
        more = wp.float32(n_slices - used) / all
    end_a = used_a + wp.int32(to_a * more + 0.5)
    end_b = used_b + wp.int32(to_b * more + 0.5)
    end_c = used_c + wp.int32(to_c * more + 0.5)

    # 3. the slices
    total = wp.float32(0.0)
    if (
        pixel.height > NONE and all > 0.0 and top >= 0.0 and (within or apart != 0.0)
    ):  # from its own plane it is a line
        for k in range(n_slices):
            sector = d
            first = end_c
            count = n_slices - end_c
            if k < end_a:
                sector = a
                first = 0
                count = end_a
            elif k < end_b:
                sector = b
                first = end_a
                count = end_b - end_a
            elif k < end_c:
                sector = c
                first = end_b
                count = end_c - end_b
            at = 2 * ((count - 1) * most + k - first)
            tangent = sector[2] * quadrature[at]  # of half the angle from the bisector
            scale = 1.0 / (1.0 + tangent * tangent)
            cos_t = (1.0 - tangent * tangent) * scale
            sin_t = 2.0 * tangent * scale
            cos_d = sector[0] * cos_t - sector[1] * sin_t
            sin_d = sector[1] * cos_t + sector[0] * sin_t
            share = 2.0 * sector[2] * quadrature[at + 1] * scale
            # where the outline goes through the slice to the left, and to the right: distance and height from
            # the middle
            left_r = wp.float32(0.0)
            left_z = wp.float32(0.0)
            right_r = wp.float32(0.0)
            right_z = wp.float32(0.0)
            has_left = wp.bool(False)
            has_right = wp.bool(False)
            for i in range(4):
                j = (i + 1) % 4
                side_i = cos_d * ay[i] - sin_d * ax[i]
                side_j = cos_d * ay[j] - sin_d * ax[j]
                r_i = cos_d * away[i] + sin_d * ay[i]
                r_j = cos_d * away[j] + sin_d * ay[j]
                f = side_i / (side_i - side_j)
                r = r_i + f * (r_j - r_i)
                z = up[i] + f * (up[j] - up[i])
                if side_i <= 0.0 and side_j > 0.0:
                    left_r = r
                    left_z = z
                    has_left = True
                if side_j <= 0.0 and side_i > 0.0:
                    right_r = r
                    right_z = z
                    has_right = True
            in_plane = flat * cos_d
            to_left = wp.max(in_plane + left_r, 1e-10)
            to_right = wp.max(in_plane + right_r, 1e-10)
            steep_left = (dz + left_z) / to_left
            steep_right = (dz + right_z) / to_right
            low = -STEEP
            high = wp.float32(STEEP)
            rise = wp.float32(0.0)
            if within:
                edge = wp.where(left, steep_left, steep_right)
                if pixel.up > 0.0:
                    low = wp.min(edge, STEEP)
                else:
                    high = edge
                if not wp.where(left, has_left, has_right):
                    high = -STEEP
                rise = high - low
            else:
                wide = (
                    dz * (right_r - left_r)
                    + in_plane * (left_z - right_z)
                    + left_z * right_r
                    - right_z * left_r
                )
                low = wp.where(wide > 0.0, steep_right, steep_left)
                high = wp.where(wide > 0.0, steep_left, steep_right)
                rise = wp.where(high < STEEP, wp.abs(wide) / (to_left * to_right), STEEP - low)
                if not (has_left and has_right):
                    high = -STEEP
            high = wp.min(high, STEEP)
            along = sense * (normal_x * cos_d + normal_y * sin_d)
            total += share * slice_light(
                pixel, ux * cos_d - uy * sin_d, uy * cos_d + ux * sin_d, along, 0.0, low, high, rise
            )
    irradiance[y * cols + x] = (
        factor * total / wp.sqrt(1.0 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y)
    )


@wp.kernel(launch_bounds=BOUNDS)
def gloss(
    heights: wp.array[wp.float32],
    tops: wp.array[wp.float32],
    quadrature: wp.array[wp.float32],
    sky: wp.array[wp.float32],
    points: wp.array[wp.float32],
    lobe: wp.array[wp.float32],
    irradiance: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    width: wp.int32,
    levels: wp.int32,
    least: wp.int32,
    most: wp.int32,
    side: wp.int32,
    n_points: wp.int32,
    n_lobe: wp.int32,
    dark: wp.int32,
    rim: wp.float32,
    highest: wp.float32,
    reach: wp.float32,
    factor: wp.float32,
):
    """The light of the sky within the lobe; quadrature as for a ball.

      reach  float32 [spacing]  ground farther away does not count

    Slices go through the disc within the rim about the mirror direction, or all round where the zenith lies
    within it.
    """
    squares, thread = wp.tid()
    x, y = node_of(squares, thread)
    if x >= cols or y >= rows:
        return
    here = (y + 1) * (cols + 1) + x + 1
    tilt = tilt_of(heights, here, cols + 1)
    mirror = mirror_of(tilt)
    pixel = Pixel(
        heights,
        tops,
        sky,
        points,
        lobe,
        sky,
        rows,
        cols,
        width,
        levels,
        side,
        n_points,
        n_lobe,
        0,
        0,
        dark,
        x,
        y,
        heights[here],
        tilt[0],
        tilt[1],
        rim,
        above_all(highest, heights[here]),
        mirror[0],
        mirror[1],
        mirror[2],
        0.0,
        reach,
        -1.0,
    )

    # 1. where the disc stands, and how many slices it is worth
    flat = wp.sqrt(mirror[0] * mirror[0] + mirror[1] * mirror[1])
    ux = wp.float32(1.0)
    uy = wp.float32(0.0)
    if flat > 0.0:
        ux = mirror[0] / flat
        uy = mirror[1] / flat
    sin_a = wp.sqrt(rim * (2.0 - rim))
    all_round = sin_a >= flat
    widest = wp.float32(1.0)
    turn = wp.float32(1.0)
    if not all_round:
        widest = sin_a / flat
        turn = widest * (SINE_1 + SINE_3 * widest * widest)
    blocks = wp.min((least + wp.int32(turn * wp.float32(most - least))) // SLICES, most // SLICES)
    n_slices = blocks * SLICES
    step = wp.float32(wp.pi) / wp.float32(n_slices)
    own = (blocks - 1) * 4 * most

    # 2. its slices
    total = wp.float32(0.0)
    if pixel.height > NONE:
        for j in range(n_slices):
            sin_d = widest * quadrature[own + j]
            cos_d = wp.sqrt((1.0 - sin_d) * (1.0 + sin_d))
            share = widest * step * quadrature[own + most + j] / cos_d
            if all_round:
                sin_d = quadrature[own + 2 * most + j]
                cos_d = quadrature[own + 3 * most + j]
                share = 2.0 * step
            total += share * slice_light(
                pixel, ux * cos_d - uy * sin_d, uy * cos_d + ux * sin_d, 1.0, 0.0, -STEEP, STEEP, 2.0 * STEEP
            )
    irradiance[y * cols + x] = (
        factor * total / wp.sqrt(1.0 + pixel.tilt_x * pixel.tilt_x + pixel.tilt_y * pixel.tilt_y)
    )


@wp.kernel
def rays(
    heights: wp.array[wp.float32],
    tops: wp.array[wp.float32],
    ways: wp.array[wp.float32],
    seen: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    width: wp.int32,
    levels: wp.int32,
    count: wp.int32,
    highest: wp.float32,
):
    """Whether the ground leaves rays free.

    ways  (rows, cols, 4, count)  float32  azimuth's cosine and sine, tangent of the elevation, and how far
                                           [spacing] ground counts
    seen  (rows, cols, count)     float32  out: 1 where no ground stands higher than the ray, else 0; count:
                                           a multiple of LANES
    """
    squares, thread = wp.tid()
    x, y = node_of(squares, thread)
    if x >= cols or y >= rows:
        return
    own = (y + 1) * (cols + 1) + x + 1
    pixel = Pixel()
    pixel.heights = heights
    pixel.tops = tops
    pixel.rows = rows
    pixel.cols = cols
    pixel.width = width
    pixel.levels = levels
    pixel.x = x
    pixel.y = y
    pixel.height = heights[own]
    pixel.above = above_all(highest, heights[own])
    pixel.reach = 1.0  # along the ray ground counts up to t / reach = 1
    pixel.radius = -1.0
    here = (y * cols + x) * count
    for j in range(count):
        tangent = ways[4 * here + 2 * count + j]
        above = tangent + 1e-6 * (1.0 + wp.abs(tangent))  # so that one obstacle is enough
        slope = horizon(
            pixel,
            0.0,
            ways[4 * here + j],
            ways[4 * here + count + j],
            tangent,
            above,
            1.0 / ways[4 * here + 3 * count + j],
            0.0,
        )
        seen[here + j] = wp.where(slope > tangent, 0.0, 1.0)


@wp.func
def between(at: wp.float32, low: wp.float32, high: wp.float32, along: wp.float32):
    """The distances between which a way from ``at``, ``along`` its part there, is within low..high."""
    if along > 0.0:
        return wp.vec2((low - at) / along, (high - at) / along)
    if along < 0.0:
        return wp.vec2((high - at) / along, (low - at) / along)
    if low <= at and at < high:
        return wp.vec2(-ENDLESS, ENDLESS)
    return wp.vec2(ENDLESS, -ENDLESS)


@wp.func
def light_above(
    table: wp.array[wp.float32],
    entry: wp.int32,
    knots: wp.int32,
    first: wp.float32,
    scale: wp.float32,
    tangent: wp.float32,
    tilt: wp.float32,
):
    """The light of a sector above a tangent."""
    at = wp.max((tangent / (tangent + 1.0) - first) * scale, 0.0)
    knot = wp.min(wp.int32(at), knots - 2)
    part = wp.min(at - wp.float32(knot), 1.0)
    here = (entry + knot) * 4
    by_cosine = table[here] + part * table[here + 2]
    by_sine = table[here + 1] + part * table[here + 3]
    return tilt * by_cosine + by_sine


@wp.kernel(launch_bounds=BOUNDS)
def sectors(
    heights: wp.array[wp.float32],
    tops: wp.array[wp.float32],
    ways: wp.array[wp.float32],
    table: wp.array[wp.float32],
    irradiance: wp.array[wp.float32],
    other: wp.array[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    width: wp.int32,
    levels: wp.int32,
    count: wp.int32,
    knots: wp.int32,
    dark: wp.int32,
    image_rows: wp.int32,
    image_cols: wp.int32,
    highest: wp.float32,
    farthest: wp.float32,
    x0: wp.float32,
    x1: wp.float32,
    y0: wp.float32,
    y1: wp.float32,
):
    """The light of a sky in a few sectors of azimuth, each above the exact horizon along one azimuth, added
    to what is there.

      ways        (6, count)         float32  azimuth's cosine and sine, width [rad]; of its table: where it
                                              begins, `first`, and knots per unit, `scale`, of the diamond
                                              angle tangent / (1 + tangent) of elevation; 1 if its light is
                                              added to `other`, else 0; count: a multiple of LANES
      table       (count, knots, 4)  float32  integrals over elevation of B cos^2 and B sin cos, from first +
                                              i / scale on, and what to add up to the next knot; below the
                                              first knot and above the last there is no light
      irradiance, other  (image_rows, image_cols)  float32  in, out; may be the same

    rows, cols: of the image, or more: then its map repeats, and goes on in the others, without a wall or a
    window. farthest [spacing]: beyond, ground is not looked for.
    x0 <= x < x1, y0 <= y < y1 [spacing]: window at height 0 through which the light
    comes; -ENDLESS..ENDLESS: there is none.
    """
    squares, thread = wp.tid()
    x, y = node_of(squares, thread)
    if x >= image_cols or y >= image_rows:
        return
    here = (y + 1) * (cols + 1) + x + 1
    tilt_xy = tilt_of(heights, here, cols + 1)
    pixel = Pixel()
    pixel.heights = heights
    pixel.tops = tops
    pixel.rows = rows
    pixel.cols = cols
    pixel.width = width
    pixel.levels = levels
    pixel.x = x
    pixel.y = y
    pixel.height = heights[here]
    pixel.above = above_all(highest, heights[here])
    pixel.reach = 1.0  # ground counts up to t x along = 1
    pixel.radius = -1.0
    framed = x0 > -ENDLESS or x1 < ENDLESS or y0 > -ENDLESS or y1 < ENDLESS
    repeats = image_cols < cols
    total = wp.float32(0.0)
    other_total = wp.float32(0.0)
    if pixel.height > NONE and (not framed or pixel.height < 0.0):
        for j in range(count):
            c = ways[j]
            s = ways[count + j]
            first = ways[3 * count + j]
            scale = ways[4 * count + j]
            last = first + wp.float32(knots - 1) / scale
            low = first / wp.max(1.0 - first, 1e-6)
            high = last / wp.max(1.0 - last, 1e-6)
            # farther on, a ray is above all ground
            along = wp.max(wp.max(low, 1e-6) / wp.max(highest - pixel.height, 1e-6), 1.0 / farthest)
            tilt = tilt_xy[0] * c + tilt_xy[1] * s
            # 1. the tangent plane, the level, the wall, the window, and the ground
            slope = wp.max(-tilt, low)
            if dark != 0:
                slope = wp.max(slope, -pixel.height / wp.min(to_wall(cols, x, c), to_wall(rows, y, s)))
            end = wp.float32(STEEP)
            if framed:
                by_x = between(wp.float32(x), x0, x1, c)
                by_y = between(wp.float32(y), y0, y1, s)
                near = wp.max(wp.max(by_x[0], by_y[0]), 0.0)
                far = wp.min(by_x[1], by_y[1])
                if near < far:
                    slope = wp.max(slope, -pixel.height / far)
                    if near > 0.0:
                        end = wp.min(-pixel.height / near, STEEP)
                else:
                    end = wp.float32(-STEEP)
            if repeats:
                slope = repeated_horizon(pixel, x, y, image_rows, image_cols, c, s, slope, high, along)
            else:
                slope = horizon(pixel, 0.0, c, s, slope, wp.min(high, end), along, 0.0)
            # 2. the light above it
            light = wp.float32(0.0)
            if not framed or slope < end:
                light = light_above(table, j * knots, knots, first, scale, slope, tilt)
                if end < STEEP:
                    light -= light_above(table, j * knots, knots, first, scale, end, tilt)
            light *= ways[2 * count + j]
            to_other = ways[5 * count + j]
            total += (1.0 - to_other) * light
            other_total += to_other * light
    at = y * image_cols + x
    length = wp.sqrt(1.0 + tilt_xy[0] * tilt_xy[0] + tilt_xy[1] * tilt_xy[1])
    irradiance[at] = irradiance[at] + total / length
    other[at] = other[at] + other_total / length
