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
    HALF_PI,
    HIGHEST_MASKED,
    LEAST_ESCAPE,
    PERIODIC,
    PI,
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
        ways: wp.array[wp.float32],
        places: wp.array[wp.int32],
        crossings: wp.array[wp.float32],
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
            cosine = ways[4 * k]
            sine = ways[4 * k + 1]
            on_columns = ways[4 * k + 2] > wp.float32(0.0)
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
                weight = crossings[3 * j]
                distance = crossings[3 * j + 1]
                per_distance = crossings[3 * j + 2]
                # 1. where the crossing lies, if it is on the map, and if any ground there could be seen
                u = c + places[2 * j]
                v = y + places[2 * j + 1]
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
        ways: wp.array[wp.float32],
        places: wp.array[wp.int32],
        crossings: wp.array[wp.float32],
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
        ways: wp.array[wp.float32],
        places: wp.array[wp.int32],
        crossings: wp.array[wp.float32],
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


@functools.cache
def strips(LIGHTS: int):
    """The sums of single rays, over every crossing with a column or a row, exactly. Thread n owns a ray."""
    lights = wp.types.vector(LIGHTS, wp.float32)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def strips(
        heights: wp.array[wp.float32],
        light: wp.array[wp.float32],
        rays: wp.array[wp.float32],
        sums: wp.array[wp.float32],
        n_rays: wp.int32,
        rows: wp.int32,
        cols: wp.int32,
        across: wp.int32,
        margin: wp.int32,
        shift: wp.int32,
        sides: wp.int32,
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
        was = place(x, y, rows, pitch, margin, shift)
        own = heights[was]
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
        per_column = wp.float32(ENDLESS)
        per_row = wp.float32(ENDLESS)
        if wp.abs(cosine) > wp.float32(1e-6):
            per_column = wp.float32(1.0) / wp.abs(cosine)
        if wp.abs(sine) > wp.float32(1e-6):
            per_row = wp.float32(1.0) / wp.abs(sine)
        num = lights()
        slope = plane
        past = start
        before = wp.float32(0.0)
        was_next = was
        was_weight = wp.float32(0.0)
        was_distance = wp.float32(0.0)
        columns = wp.int32(1)
        lines = wp.int32(1)
        going = wp.bool(True)
        while going:
            # 1. the next crossing, if it is on the map, and if any ground there could be seen
            to_column = wp.float32(columns) * per_column
            to_row = wp.float32(lines) * per_row
            distance = wp.min(to_column, to_row)
            if distance > reach or not (highest - own > slope * distance):
                break
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
                u = wp.where(cosine > wp.float32(0.0), x + columns, x - columns)
                columns += 1
            else:
                v = wp.where(sine > wp.float32(0.0), y + lines, y - lines)
                lines += 1
            if sides == PERIODIC:
                u = wrapped(u, cols)
                v = wrapped(v, rows)
            else:
                if u < 0 or u >= cols or v < 0 or v >= rows:
                    break
                if weight > wp.float32(0.0) and wp.where(on_column, v + 1 >= rows, u + 1 >= cols):
                    break
            at = place(u, v, rows, pitch, margin, shift)
            next = at + pitch
            if not on_column:
                next = place(u + 1, v, rows, pitch, margin, shift)
            # 2. the ground there
            stands = heights[at] + weight * (heights[next] - heights[at]) - own
            rises = stands / distance
            # 3. the strip that it opens
            if rises > slope:
                below_line = before - slope * was_distance
                above_line = stands - slope * distance
                part = wp.float32(0.0)
                if (
                    was_distance > wp.float32(0.0)
                    and below_line < wp.float32(0.0)
                    and above_line > below_line
                ):
                    part = wp.min(-below_line / (above_line - below_line), wp.float32(1.0))
                here = below(rises, plane)
                share = (here - past) * wp.float32(0.5)
                for m in range(LIGHTS):
                    first = m * map_size
                    near = light[first + was] + was_weight * (light[first + was_next] - light[first + was])
                    far = light[first + at] + weight * (light[first + next] - light[first + at])
                    num[m] += share * (near * (wp.float32(1.0) - part) + far * (wp.float32(1.0) + part))
                past = here
                slope = rises
            before = stands
            was = at
            was_next = next
            was_weight = weight
            was_distance = distance
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
