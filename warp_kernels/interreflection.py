"""Light between surfaces, which ground sends to ground.

The method and the arguments are described in opencl/interreflection.cl, whose steps have the same numbers.
Twin of opencl/interreflection.cl.
"""

import functools

import warp as wp

from skylamp.constants import (
    ARC_TANGENT,
    DARK,
    ENDLESS,
    GRAZES,
    HALF_PI,
    HIGHEST_MASKED,
    LEAST_ESCAPE,
    PERIODIC,
    PI,
    STEEP,
)

from . import OPTIONS

wp.set_module_options(OPTIONS)

A0, A1, A2, A3, A4, A5, A6, A7 = ARC_TANGENT


@wp.func
def arctan(v: wp.float32):
    """Arc tangent of any v to 2e-7, by a polynomial fitted for least maximum error."""
    a = wp.abs(v)
    r = a
    if a > wp.float32(1.0):
        r = wp.float32(1.0) / a
    q = r * r
    p = wp.float32(A0) * q + wp.float32(A1)
    p = p * q + wp.float32(A2)
    p = p * q + wp.float32(A3)
    p = p * q + wp.float32(A4)
    p = p * q + wp.float32(A5)
    p = p * q + wp.float32(A6)
    p = p * q + wp.float32(A7)
    p = p * r
    if a > wp.float32(1.0):
        p = wp.float32(HALF_PI) - p
    if v < wp.float32(0.0):
        p = -p
    return p


@wp.func
def below(slope: wp.float32, plane: wp.float32):
    """Share of what lies below a slope, up to a constant: the integral of N.L over elevations for an element
    whose tangent plane rises by ``plane``, over half the upward part of N.
    """
    q = wp.float32(1.0) / (slope * slope + wp.float32(1.0))
    return -plane * (arctan(slope) + slope * q) - q


@wp.func
def wrapped(v: wp.int32, period: wp.int32):
    w = v % period
    if w < 0:
        w += period
    return w


@wp.func
def place(c: wp.int32, r: wp.int32, rows: wp.int32, pitch: wp.int32, margin: wp.int32, shift: wp.int32):
    """Element of a plane map at column c (>= -margin 2^shift), row r (-1 .. rows)."""
    return ((c & ((1 << shift) - 1)) * (rows + 2) + r + 1) * pitch + margin + (c >> shift)


@wp.func
def tilt(low: wp.float32, own: wp.float32, high: wp.float32):
    """Slope of depth between neighbours: central, one-sided beside what is no ground."""
    a = low
    b = high
    part = wp.float32(0.5)
    if low <= wp.float32(HIGHEST_MASKED):
        a = own
        part = wp.float32(1.0)
    if high <= wp.float32(HIGHEST_MASKED):
        b = own
        part = wp.float32(1.0)
    if own <= wp.float32(HIGHEST_MASKED):
        return wp.float32(0.0)
    return (a - b) * part


@wp.func
def stands_at(own: wp.float32, highest: wp.float32):
    """Heights of nodes; where there is no ground the highest, from which almost no ground is visible."""
    if own > wp.float32(HIGHEST_MASKED):
        return own
    return highest


@wp.func
def to_wall(x: wp.float32, along: wp.float32, count: wp.int32):
    """Distance of a dark box's wall, half a node outside, from x on ``count`` nodes, along a component."""
    if wp.abs(along) < wp.float32(1e-6):
        return wp.float32(ENDLESS)
    way = x + wp.float32(0.5)
    if along > wp.float32(0.0):
        way = wp.float32(count) - wp.float32(0.5) - x
    return way * (wp.float32(1.0) / wp.abs(along))


@functools.cache
def gathered_by(LIGHTS: int):
    """Sums over all strips that a node sees: (sums of every light, sum of shares)."""
    lights = wp.types.vector(LIGHTS, wp.float32)

    @wp.func
    def gathered(
        heights: wp.array[wp.float32],
        light: wp.array[wp.float32],
        ways: wp.array[wp.vec4],
        places: wp.array[wp.vec2i],
        crossings: wp.array[wp.vec3],
        c: wp.int32,
        y: wp.int32,
        azimuths: wp.int32,
        count: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        across: wp.int32,
        margin: wp.int32,
        shift: wp.int32,
        sides: wp.int32,
        highest: wp.float32,
        own: wp.float32,
        gx: wp.float32,
        gy: wp.float32,
    ):
        pitch = across + 2 * margin
        phases = 1 << shift
        map_size = phases * (rows + 2) * pitch
        num = lights()
        total = wp.float32(0.0)
        for k in range(azimuths):
            way = ways[k]
            cosine = way[0]
            sine = way[1]
            on_columns = way[2] > wp.float32(0.0)
            plane = -(gx * cosine + gy * sine)
            start = below(plane, plane)
            slope = plane
            past = start
            before = wp.float32(0.0)
            was = place(c, y, rows, pitch, margin, shift)
            was_next = was
            was_weight = wp.float32(0.0)
            was_distance = wp.float32(0.0)
            for j in range(k * count, (k + 1) * count):
                crossing = crossings[j]
                weight = crossing[0]
                distance = crossing[1]
                per_distance = crossing[2]
                # 1. where the crossing lies, if it is on the map, and if any ground there could be seen
                moved = places[j]
                u = c + moved[0]
                v = y + moved[1]
                if sides == PERIODIC:
                    u = (wrapped(u >> shift, across) << shift) + (u & (phases - 1))
                    v = wrapped(v, rows)
                elif v < -1 or v >= rows or (u >> shift) <= -1 or (u >> shift) >= across:
                    break
                if not (highest - own > slope * distance):
                    break
                at = place(u, v, rows, pitch, margin, shift)
                next = at + pitch
                if not on_columns:
                    next = place(u + 1, v, rows, pitch, margin, shift)
                # 2. the ground there
                a = heights[at]
                stands = a + weight * (heights[next] - a) - own
                rises = stands * per_distance
                # 3. the strip that it opens: its share, and the mean of the light at both ends
                if rises > slope:
                    low = before - slope * was_distance
                    high = stands - slope * distance
                    part = wp.float32(0.0)
                    # on a plane rounding alone may raise a crossing; high may then be below 0, or below low
                    if low < wp.float32(0.0) and high > low and was_distance > wp.float32(0.0):
                        part = wp.min(-low / (high - low), wp.float32(1.0))
                    here = below(rises, plane)
                    share = (here - past) * wp.float32(0.5)
                    for m in range(LIGHTS):
                        first = m * map_size
                        c0 = light[first + was]
                        d0 = light[first + at]
                        near = c0 + was_weight * (light[first + was_next] - c0)
                        far = d0 + weight * (light[first + next] - d0)
                        num[m] += share * (near * (wp.float32(1.0) - part) + far * (wp.float32(1.0) + part))
                    past = here
                    slope = rises
                before = stands
                was = at
                was_next = next
                was_weight = weight
                was_distance = distance
            # 4. all that is not sky
            if sides != PERIODIC:
                slope = wp.max(slope, wp.float32(0.0))
            if sides == DARK:
                wall_x = to_wall(wp.float32(c), cosine, cols)
                wall_y = to_wall(wp.float32(y), sine, rows)
                slope = wp.max(slope, -own / wp.min(wall_x, wall_y))
            total += below(slope, plane) - start
        return num, total

    return gathered


@wp.kernel
def begin(
    direct: wp.array[wp.float32],
    albedo: wp.array[wp.float32],
    sky: wp.array[wp.float32],
    irradiance: wp.array[wp.float32],
    n: wp.int32,
    pixels: wp.int32,
    varies: wp.int32,
):
    """Light before the first gather: that of a node among its like. Thread (m, p) owns node p of light m."""
    m, p = wp.tid()
    if p >= pixels or m >= n:
        return
    q = m * pixels + p
    share = albedo[wp.where(varies != 0, q, m)]
    light = wp.float32(0.0)
    if direct[q] > 0.0:
        light = direct[q]
    direct[q] = light
    escapes = 1.0 - share * (1.0 - sky[p])
    if not escapes > LEAST_ESCAPE:
        escapes = wp.float32(LEAST_ESCAPE)
    irradiance[q] = light / escapes


@wp.kernel
def spread(
    maps: wp.array[wp.float32],
    albedo: wp.array[wp.float32],
    planes: wp.array[wp.float32],
    n: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    across: wp.int32,
    margin: wp.int32,
    shift: wp.int32,
    periodic: wp.int32,
    varies: wp.int32,
    scale: wp.float32,
    outside: wp.float32,
):
    """Maps as planes, times a factor each. Thread (m, r, x) owns elements x of row r of map m's planes."""
    m, r, x = wp.tid()
    pitch = across + 2 * margin
    if x >= pitch or r >= rows + 2 or m >= n:
        return
    for phase in range(1 << shift):
        c = (x - margin) * (1 << shift) + phase
        y = r - 1
        if periodic != 0:
            c = wrapped(c, cols)
            y = wrapped(y, rows)
        value = outside
        if c >= 0 and c < cols and y >= 0 and y < rows:
            p = (m * rows + y) * cols + c
            value = maps[p] * (albedo[wp.where(varies != 0, p, m)] * scale)
        planes[(((m << shift) + phase) * (rows + 2) + r) * pitch + x] = value


@functools.cache
def gather(LIGHTS: int):
    """Sums of strips at every stride-th node of every stride-th row, or every 2^shift-th if that is less.
    Thread (r, phase, x) owns a receiver of row r.
    """
    gathered = gathered_by(LIGHTS)
    lights = wp.types.vector(LIGHTS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def gather(
        heights: wp.array[wp.float32],
        light: wp.array[wp.float32],
        ways: wp.array[wp.vec4],
        places: wp.array[wp.vec2i],
        crossings: wp.array[wp.vec3],
        sums: wp.array[wp.float32],
        azimuths: wp.int32,
        count: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        across: wp.int32,
        margin: wp.int32,
        shift: wp.int32,
        sides: wp.int32,
        stride: wp.int32,
        phases: wp.int32,
        width: wp.int32,
        highest: wp.float32,
    ):
        row, phase, x = wp.tid()
        y = row * stride
        step = wp.min(stride, 1 << shift)
        pitch = across + 2 * margin
        if x >= across or phase >= phases or y >= rows:
            return
        c = (x << shift) + phase * step
        own = heights[place(c, y, rows, pitch, margin, shift)]
        left = heights[place(c - 1, y, rows, pitch, margin, shift)]
        right = heights[place(c + 1, y, rows, pitch, margin, shift)]
        above = heights[place(c, y - 1, rows, pitch, margin, shift)]
        beneath = heights[place(c, y + 1, rows, pitch, margin, shift)]
        all = (rows + stride - 1) / stride * phases * width
        at = (row * phases + phase) * width + x
        num = lights()
        den = wp.float32(-1.0)
        if own > wp.float32(HIGHEST_MASKED):
            num, den = gathered(
                heights,
                light,
                ways,
                places,
                crossings,
                c,
                y,
                azimuths,
                count,
                rows,
                cols,
                across,
                margin,
                shift,
                sides,
                highest,
                stands_at(own, highest),
                tilt(left, own, right),
                tilt(above, own, beneath),
            )
        for m in range(LIGHTS):
            sums[m * all + at] = num[m]
        sums[LIGHTS * all + at] = den

    return gather


@functools.cache
def fill(LIGHTS: int):
    """Irradiance of every node from the receivers round it. Thread (y, i) owns the nodes of row y from
    receiver column i up to the next.
    """
    lights = wp.types.vector(LIGHTS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def fill(
        heights: wp.array[wp.float32],
        sums: wp.array[wp.float32],
        direct: wp.array[wp.float32],
        sky: wp.array[wp.float32],
        irradiance: wp.array[wp.float32],
        rows: wp.int32,
        cols: wp.int32,
        across: wp.int32,
        margin: wp.int32,
        shift: wp.int32,
        sides: wp.int32,
        stride: wp.int32,
        phases: wp.int32,
        width: wp.int32,
    ):
        y, i = wp.tid()
        pitch = across + 2 * margin
        step = wp.min(stride, 1 << shift)
        lines = (rows + stride - 1) / stride
        columns = (cols + step - 1) / step
        all = lines * phases * width
        if i >= columns or y >= rows:
            return
        # 1. along the columns of receivers on both sides: the last receiver serves up to the map's end, or up
        # to the first where the map repeats
        row = y / stride
        last_row = row + 1 == lines
        last = i + 1 == columns
        periodic = wp.where(sides == PERIODIC, wp.float32(1.0), wp.float32(0.0))
        down = wp.float32(y - row * stride) / wp.float32(stride)
        if last_row:
            down = wp.float32(y - row * stride) / wp.float32(rows - row * stride) * periodic
        num0 = lights()
        num1 = lights()
        den = wp.vec2f()
        whole = wp.vec2f()
        for side in range(2):
            c = wp.where(side == 0, i, wp.where(last, 0, i + 1)) * step
            for lower in range(2):
                r = wp.where(lower == 0, row, wp.where(last_row, 0, row + 1))
                at = (r * phases + (c & ((1 << shift) - 1)) / step) * width + (c >> shift)
                shares = sums[LIGHTS * all + at]
                weight = wp.where(lower == 1, down, wp.float32(1.0) - down)
                if shares < wp.float32(0.0):
                    weight = wp.float32(0.0)
                whole[side] += weight
                den[side] += weight * shares
                for m in range(LIGHTS):
                    if side == 0:
                        num0[m] += weight * sums[m * all + at]
                    else:
                        num1[m] += weight * sums[m * all + at]
        # 2. between them
        first = i * step
        for x in range(first, wp.min(first + step, cols)):
            p = y * cols + x
            own = heights[place(x, y, rows, pitch, margin, shift)]
            right = wp.float32(x - first) / wp.float32(step)
            if last:
                right = wp.float32(x - first) / wp.float32(cols - first) * periodic
            left = wp.float32(1.0) - right
            known = whole[0] * left + whole[1] * right
            shares = den[0] * left + den[1] * right
            for m in range(LIGHTS):
                mean = wp.float32(0.0)
                if shares > wp.float32(0.0):
                    mean = (num0[m] * left + num1[m] * right) / shares
                total = direct[m * rows * cols + p] + wp.float32(PI) * (wp.float32(1.0) - sky[p]) * mean
                if not (known > wp.float32(0.0)):
                    total = wp.float32(-1.0)
                if own <= wp.float32(HIGHEST_MASKED):
                    total = wp.float32(0.0)
                irradiance[m * rows * cols + p] = total

    return fill


@functools.cache
def gather_nodes(LIGHTS: int):
    """Irradiance of nodes by strips of their own, every one or those where it is < 0. Thread (y, phase, x)
    owns a node of row y.
    """
    gathered = gathered_by(LIGHTS)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def gather_nodes(
        heights: wp.array[wp.float32],
        light: wp.array[wp.float32],
        ways: wp.array[wp.vec4],
        places: wp.array[wp.vec2i],
        crossings: wp.array[wp.vec3],
        direct: wp.array[wp.float32],
        sky: wp.array[wp.float32],
        irradiance: wp.array[wp.float32],
        azimuths: wp.int32,
        count: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        across: wp.int32,
        margin: wp.int32,
        shift: wp.int32,
        sides: wp.int32,
        every: wp.int32,
        highest: wp.float32,
    ):
        y, phase, x = wp.tid()
        pitch = across + 2 * margin
        c = (x << shift) + phase
        if x >= across or phase >= 1 << shift or y >= rows or c >= cols:
            return
        p = y * cols + c
        if every == 0 and not (irradiance[p] < wp.float32(0.0)):
            return
        own = heights[place(c, y, rows, pitch, margin, shift)]
        num, den = gathered(
            heights,
            light,
            ways,
            places,
            crossings,
            c,
            y,
            azimuths,
            count,
            rows,
            cols,
            across,
            margin,
            shift,
            sides,
            highest,
            stands_at(own, highest),
            tilt(
                heights[place(c - 1, y, rows, pitch, margin, shift)],
                own,
                heights[place(c + 1, y, rows, pitch, margin, shift)],
            ),
            tilt(
                heights[place(c, y - 1, rows, pitch, margin, shift)],
                own,
                heights[place(c, y + 1, rows, pitch, margin, shift)],
            ),
        )
        for m in range(LIGHTS):
            q = m * rows * cols + p
            mean = wp.float32(0.0)
            if den > wp.float32(0.0):
                mean = num[m] / den
            estimate = direct[q] + wp.float32(PI) * (wp.float32(1.0) - sky[p]) * mean
            if own <= wp.float32(HIGHEST_MASKED):
                estimate = wp.float32(0.0)
            irradiance[q] = estimate

    return gather_nodes


@wp.struct
class Crossing:
    """Where a ray crosses a column or a row of nodes: between the nodes at two places."""

    at: wp.int32
    next: wp.int32
    column: wp.int32  # of the node ``at``
    row: wp.int32
    next_column: wp.int32  # whether the next is beside it
    weight: wp.float32  # of the next node
    distance: wp.float32  # [spacing]


@wp.func
def cross(
    x: wp.int32,
    y: wp.int32,
    cosine: wp.float32,
    sine: wp.float32,
    per_column: wp.float32,
    per_row: wp.float32,
    columns: wp.int32,
    lines: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    across: wp.int32,
    margin: wp.int32,
    shift: wp.int32,
    sides: wp.int32,
):
    """(crossing, columns, lines): the next one from a node (x, y), after so many columns and rows that were
    met; its distance is ENDLESS where it lies outside the map.
    """
    crossing = Crossing()
    crossing.distance = wp.float32(ENDLESS)
    to_column = wp.float32(columns + 1) * per_column
    to_row = wp.float32(lines + 1) * per_row
    distance = wp.min(to_column, to_row)
    on_column = to_column <= to_row
    at_line = wp.float32(x) + cosine * distance
    if on_column:
        at_line = wp.float32(y) + sine * distance
    low = wp.int32(wp.floor(at_line))
    weight = at_line - wp.float32(low)
    if weight > wp.float32(1.0) - wp.float32(1e-4):  # at a node
        low += 1
        weight = wp.float32(0.0)
    if weight < wp.float32(1e-4):
        weight = wp.float32(0.0)
    u = low
    v = low
    if on_column:
        columns += 1
        u = wp.where(cosine > wp.float32(0.0), x + columns, x - columns)
    else:
        lines += 1
        v = wp.where(sine > wp.float32(0.0), y + lines, y - lines)
    if sides == PERIODIC:
        u = wrapped(u, cols)
        v = wrapped(v, rows)
    else:
        if u < 0 or u >= cols or v < 0 or v >= rows:
            return crossing, columns, lines
        if weight > wp.float32(0.0) and wp.where(on_column, v + 1 >= rows, u + 1 >= cols):
            return crossing, columns, lines
    pitch = across + 2 * margin
    crossing.at = place(u, v, rows, pitch, margin, shift)
    crossing.next = crossing.at + pitch
    if not on_column:
        crossing.next = place(u + 1, v, rows, pitch, margin, shift)
    crossing.column = u
    crossing.row = v
    crossing.next_column = wp.where(on_column, 0, 1)
    crossing.weight = weight
    crossing.distance = distance
    return crossing, columns, lines


@wp.func
def value_at(map: wp.array[wp.float32], first: wp.int32, crossing: Crossing):
    """Value at a crossing of the map that begins at element ``first``."""
    near = map[first + crossing.at]
    return near + crossing.weight * (map[first + crossing.next] - near)


@wp.func
def part_past(low: wp.float32, high: wp.float32, distance: wp.float32):
    """Part of a stretch of ground before a line of sight meets it, from how far ground stands above the line
    at both ends; 0 for the stretch that begins at the node.
    """
    part = wp.float32(0.0)
    if distance > wp.float32(0.0) and low < wp.float32(0.0) and high > low:
        part = wp.min(-low / (high - low), wp.float32(1.0))
    return part


@wp.func
def per(component: wp.float32):
    """Distance between crossings along an axis, of a unit vector's component."""
    if wp.abs(component) > wp.float32(1e-6):
        return wp.float32(1.0) / wp.abs(component)
    return wp.float32(ENDLESS)


@wp.func
def passed_over(
    at: Crossing,
    tops: wp.array[wp.float32],
    slope: wp.float32,
    own: wp.float32,
    cosine: wp.float32,
    sine: wp.float32,
    met_columns: wp.int32,
    met_lines: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    block: wp.int32,
    blocks: wp.int32,
):
    """(columns, lines) that are met before the last crossing of the block of a crossing, if the ray passes
    over it and it holds more; else as they are. From that last one the ground after the block rises.
    """
    top = tops[(at.row >> block) * blocks + (at.column >> block)]
    if top - own > slope * at.distance:
        return met_columns, met_lines
    across = wp.abs(cosine)
    down = wp.abs(sine)
    left = (at.column >> block) << block
    above = (at.row >> block) << block
    x = wp.float32(at.column)
    y = wp.float32(at.row)
    if at.next_column != 0:
        x += at.weight
    else:
        y += at.weight
    out_x = x - wp.float32(left)
    if cosine > wp.float32(0.0):
        out_x = wp.float32(wp.min(left + (1 << block), cols)) - x
    out_y = y - wp.float32(above)
    if sine > wp.float32(0.0):
        out_y = wp.float32(wp.min(above + (1 << block), rows)) - y
    end = at.distance + wp.min(out_x * per(cosine), out_y * per(sine))
    if top - own > slope * end:  # of a ray that falls
        return met_columns, met_lines
    # rounding may lose the crossing on the way out, but finds none beyond it
    columns = wp.max(wp.int32(end * across - wp.float32(1e-3)), met_columns)
    lines = wp.max(wp.int32(end * down - wp.float32(1e-3)), met_lines)
    if wp.float32(columns) * down > wp.float32(lines) * across:
        columns -= 1
    else:
        lines -= 1
    if columns + lines <= met_columns + met_lines or columns < met_columns or lines < met_lines:
        return met_columns, met_lines
    return columns, lines


@wp.struct
class Aim:
    """A ray in an azimuth: elevation's cosine and sine, slope, and change of elevation by its place."""

    cosine: wp.float32
    sine: wp.float32
    slope: wp.float32
    per_place: wp.float32


@wp.func
def aimed(
    place: wp.float32, below: wp.float32, above: wp.float32, from_cosine: wp.float32, from_sine: wp.float32
):
    """The ray at a place from -1 to 1, on either side of an elevation of this cosine and sine. below, above:
    tangents of half the angles that the sides span. The slope is a little less: ground that the ray misses
    by rounding is met.
    """
    side = above
    if place < wp.float32(0.0):
        side = below
    t = side * place
    scale = wp.float32(1.0) / (wp.float32(1.0) + t * t)
    cosine = (wp.float32(1.0) - t * t) * scale
    sine = wp.float32(2.0) * t * scale
    aim = Aim()
    aim.cosine = from_cosine * cosine - from_sine * sine
    aim.sine = from_sine * cosine + from_cosine * sine
    slope = aim.sine / wp.max(aim.cosine, wp.float32(1.0) / wp.float32(STEEP))
    aim.slope = slope - wp.float32(GRAZES) * (wp.float32(1.0) + wp.abs(slope))
    aim.per_place = wp.float32(2.0) * side * scale
    return aim


@wp.func
def lobe_at(lobe: wp.array[wp.float32], n_lobe: wp.int32, part: wp.float32):
    """Weight of a lobe at a part of its rim, from its table."""
    at = wp.min(part, wp.float32(1.0)) * wp.float32(n_lobe - 1)
    i = wp.clamp(wp.int32(at), 0, n_lobe - 2)
    return lobe[i] + (at - wp.float32(i)) * (lobe[i + 1] - lobe[i])


@functools.cache
def strips(LIGHTS: int):
    """The sums of single rays, over every crossing with a column or a row, exactly. Thread n owns a ray."""
    lights = wp.types.vector(LIGHTS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def strips(
        heights: wp.array[wp.float32],
        light: wp.array[wp.float32],
        tops: wp.array[wp.float32],
        rays: wp.array[wp.float32],
        sums: wp.array[wp.float32],
        n_rays: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        across: wp.int32,
        margin: wp.int32,
        shift: wp.int32,
        sides: wp.int32,
        block: wp.int32,
        blocks: wp.int32,
        highest: wp.float32,
        reach: wp.float32,
    ):
        n = wp.tid()
        if n >= n_rays:
            return
        pitch = across + 2 * margin
        map_size = (1 << shift) * (rows + 2) * pitch
        x = wp.int32(rays[4 * n])
        y = wp.int32(rays[4 * n + 1])
        cosine = rays[4 * n + 2]
        sine = rays[4 * n + 3]
        node = place(x, y, rows, pitch, margin, shift)
        own = heights[node]
        gx = tilt(
            heights[place(x - 1, y, rows, pitch, margin, shift)],
            own,
            heights[place(x + 1, y, rows, pitch, margin, shift)],
        )
        gy = tilt(
            heights[place(x, y - 1, rows, pitch, margin, shift)],
            own,
            heights[place(x, y + 1, rows, pitch, margin, shift)],
        )
        plane = -(gx * cosine + gy * sine)
        start = below(plane, plane)
        per_column = per(cosine)
        per_row = per(sine)
        num = lights()
        slope = plane
        past = start
        before = wp.float32(0.0)
        was = Crossing()
        was.at = node
        was.next = node
        columns = wp.int32(0)
        lines = wp.int32(0)
        while True:
            # 1. the next crossing, if it is on the map, and if any ground there could be seen
            at, columns, lines = cross(
                x,
                y,
                cosine,
                sine,
                per_column,
                per_row,
                columns,
                lines,
                rows,
                cols,
                across,
                margin,
                shift,
                sides,
            )
            if at.distance > reach or not (highest - own > slope * at.distance):
                break
            columns_on, lines_on = passed_over(
                at, tops, slope, own, cosine, sine, columns, lines, rows, cols, block, blocks
            )
            if columns_on + lines_on > columns + lines:
                columns = columns_on
                lines = lines_on
                continue
            # 2. the ground there
            stands = value_at(heights, 0, at) - own
            rises = stands / at.distance
            # 3. the strip that it opens
            if rises > slope:
                part = part_past(before - slope * was.distance, stands - slope * at.distance, was.distance)
                here = below(rises, plane)
                share = (here - past) * wp.float32(0.5)
                for m in range(LIGHTS):
                    near = value_at(light, m * map_size, was)
                    far = value_at(light, m * map_size, at)
                    num[m] += share * (near * (wp.float32(1.0) - part) + far * (wp.float32(1.0) + part))
                past = here
                slope = rises
            before = stands
            was = at
        # 4. all that is not sky, and the sky
        if sides != PERIODIC:
            slope = wp.max(slope, wp.float32(0.0))
        if sides == DARK:
            wall = wp.min(to_wall(wp.float32(x), cosine, cols), to_wall(wp.float32(y), sine, rows))
            slope = wp.max(slope, -own / wall)
        up = wp.float32(1.0) / wp.sqrt(wp.float32(1.0) + gx * gx + gy * gy)
        sky = below(slope, plane)
        for m in range(LIGHTS):
            sums[m * n_rays + n] = up * num[m]
        sums[LIGHTS * n_rays + n] = up * (sky - start)
        sums[(LIGHTS + 1) * n_rays + n] = up * (-plane * wp.float32(HALF_PI) - sky)

    return strips


@functools.cache
def glossy(LIGHTS: int):
    """What nodes reflect of the ground round them towards the viewer, by a lobe or a mirror. Thread (y,
    phase, x) owns the node of row y at element x of plane ``phase``.
    """
    lights = wp.types.vector(LIGHTS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def glossy(
        heights: wp.array[wp.float32],
        light: wp.array[wp.float32],
        lobe: wp.array[wp.float32],
        spots: wp.array[wp.float32],
        tops: wp.array[wp.float32],
        image: wp.array[wp.float32],
        rows: wp.int32,
        cols: wp.int32,
        across: wp.int32,
        margin: wp.int32,
        shift: wp.int32,
        sides: wp.int32,
        block: wp.int32,
        blocks: wp.int32,
        slices: wp.int32,
        rays: wp.int32,
        n_lobe: wp.int32,
        rim: wp.float32,
        highest: wp.float32,
        reach: wp.float32,
    ):
        y, phase, column = wp.tid()
        x = (column << shift) + phase
        if x >= cols or y >= rows or phase >= 1 << shift:
            return
        pitch = across + 2 * margin
        map_size = (1 << shift) * (rows + 2) * pitch
        node = place(x, y, rows, pitch, margin, shift)
        own = heights[node]
        sums = lights()
        # 1. the mirror direction, by sine and cosine of its elevation and azimuth, and the lobe's azimuths
        gx = tilt(
            heights[place(x - 1, y, rows, pitch, margin, shift)],
            own,
            heights[place(x + 1, y, rows, pitch, margin, shift)],
        )
        gy = tilt(
            heights[place(x, y - 1, rows, pitch, margin, shift)],
            own,
            heights[place(x, y + 1, rows, pitch, margin, shift)],
        )
        square = wp.float32(1.0) + gx * gx + gy * gy
        steep = wp.sqrt(gx * gx + gy * gy)
        up = wp.float32(2.0) / square - wp.float32(1.0)
        flat = wp.float32(2.0) * steep / square
        wide = wp.sqrt(rim * (wp.float32(2.0) - rim))
        half_turn = wp.float32(PI)
        if wide < flat:
            half_turn = wp.asin(wide / flat)
        count = slices
        if own <= wp.float32(HIGHEST_MASKED):
            count = 0
        for k in range(count):
            angle = half_turn * spots[2 * k]
            c = wp.cos(angle)
            s = wp.sin(angle)
            turn = half_turn * spots[2 * k + 1] / wp.sqrt(square)
            cosine = c
            sine = s
            if steep > wp.float32(0.0):
                cosine = (gx * c - gy * s) / steep
                sine = (gy * c + gx * s) / steep
            # 2. the elevations of the lobe in this azimuth: at an angle from the middle, 1 - cosine to R is
            # aside + length (1 - cos(angle)); they are above the tangent plane and not beyond the zenith
            along = flat * c
            length = wp.sqrt(along * along + up * up)
            aside = flat * flat * s * s / (wp.float32(1.0) + length)
            plane = -(gx * cosine + gy * sine)
            middle = wp.atan2(up, along)
            ratio = wp.clamp((rim - aside) / (wp.float32(2.0) * length), wp.float32(0.0), wp.float32(1.0))
            spread = wp.float32(2.0) * wp.asin(wp.sqrt(ratio))
            lowest = wp.max(middle - spread, arctan(plane))
            most = wp.min(middle + spread, wp.float32(HALF_PI))
            start = wp.min(wp.max(middle, lowest), most)
            from_cosine = along / length
            from_sine = up / length
            if start != middle:
                from_cosine = wp.cos(start)
                from_sine = wp.sin(start)
            lower = wp.tan(wp.float32(0.5) * (start - lowest))
            upper = wp.tan(wp.float32(0.5) * (most - start))
            # 3. the first ground along each
            per_column = per(cosine)
            per_row = per(sine)
            was = Crossing()
            was.at = node
            was.next = node
            columns = wp.int32(0)
            lines = wp.int32(0)
            ray = wp.int32(0)
            if aside > rim or most < lowest:
                ray = rays
            before = wp.float32(0.0)
            aim = aimed(spots[2 * slices], lower, upper, from_cosine, from_sine)
            while ray < rays:
                at, columns, lines = cross(
                    x,
                    y,
                    cosine,
                    sine,
                    per_column,
                    per_row,
                    columns,
                    lines,
                    rows,
                    cols,
                    across,
                    margin,
                    shift,
                    sides,
                )
                if at.distance > reach or not (highest - own > aim.slope * at.distance):
                    break
                columns_on, lines_on = passed_over(
                    at, tops, aim.slope, own, cosine, sine, columns, lines, rows, cols, block, blocks
                )
                if columns_on + lines_on > columns + lines:
                    columns = columns_on
                    lines = lines_on
                    continue
                stands = value_at(heights, 0, at) - own
                rises = stands / at.distance
                while ray < rays and rises > aim.slope:
                    part = wp.float32(0.5)
                    if was.distance > wp.float32(0.0):
                        part = part_past(
                            before - aim.slope * was.distance, stands - aim.slope * at.distance, was.distance
                        )
                    weight = wp.float32(1.0)
                    if rim > wp.float32(0.0):
                        off = (aim.sine * along - aim.cosine * up) / length
                        close = (aim.cosine * along + aim.sine * up) / length
                        facing = wp.max(aim.sine - plane * aim.cosine, wp.float32(0.0))
                        away = aside + length * off * off / (wp.float32(1.0) + close)
                        width = spots[2 * (slices + ray) + 1] * turn
                        weight = (
                            lobe_at(lobe, n_lobe, away / rim) * facing * aim.cosine * aim.per_place * width
                        )
                    for m in range(LIGHTS):
                        near = value_at(light, m * map_size, was)
                        far = value_at(light, m * map_size, at)
                        sums[m] += weight * (near * (wp.float32(1.0) - part) + far * part)
                    ray += 1
                    if ray < rays:
                        aim = aimed(spots[2 * (slices + ray)], lower, upper, from_cosine, from_sine)
                before = stands
                was = at
        for m in range(LIGHTS):
            image[(m * rows + y) * cols + x] = sums[m]

    return glossy
