"""Horizons along single rays, exactly: what a plan is measured against; a map in blocks, for them; and values
picked. Twin of opencl/pilot.cl.
"""

import warp as wp

from skylamp.constants import HIGHEST_MASKED, NONE

from . import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def steps_out(at: wp.float32, move: wp.float32, low: wp.int32, high: wp.int32):
    """The steps after which a line that moves by `move` a step has left the block [low, high) it is in."""
    if move == wp.float32(0.0):
        return wp.int32(1 << 30)
    if move > wp.float32(0.0):
        return wp.int32(wp.min((wp.float32(high) - at) / move, wp.float32(1e9))) + 1
    return wp.int32(wp.min((at - wp.float32(low)) / -move, wp.float32(1e9))) + 1


@wp.kernel
def pilot(
    heights: wp.array[wp.float32],
    tops: wp.array[wp.float32],
    rays: wp.array2d[wp.float32],
    slopes: wp.array[wp.float32],
    count: wp.int32,
    rows: wp.int32,
    cols: wp.int32,
    across: wp.int32,
    shift: wp.int32,
    periodic: wp.int32,
    highest: wp.float32,
    reach: wp.float32,
):
    """The largest (height - own height) / distance over every crossing of a ray's vertical plane with a row
    or a column of the grid, from `least` >= 0 on; blocks whose highest node stays below the line so far are
    left as a whole.

      heights  (rows, cols)  float32 [spacing]  -1e30 where masked
      tops     (.., across)  float32 [spacing]  highest node of every block of 2^shift x 2^shift nodes, and of
                                                the row and column after
      rays     (count, 8)    float32            column, row, cosine and sine of the azimuth, least; along, up,
                                                limit: a point t away on the line with slope s is before
                                                the source iff t (along + s up) < limit
      slopes   (count)       float32            out

    reach [spacing]: the search radius. Thread n owns a ray.
    """
    number = wp.tid()
    if number >= count:
        return
    x = wp.int32(rays[number, 0])
    y = wp.int32(rays[number, 1])
    along = rays[number, 5]
    up = rays[number, 6]
    limit = rays[number, 7]
    own = heights[y * cols + x]
    slope = rays[number, 4]
    for by_rows in range(2):
        # crossings with columns, then with rows: node `at` of `length` along them, `start_aside` of `width`
        # aside
        to = rays[number, 2]
        aside = rays[number, 3]
        start = x
        length = cols
        start_aside = y
        width = rows
        if by_rows == 1:
            to = rays[number, 3]
            aside = rays[number, 2]
            start = y
            length = rows
            start_aside = x
            width = cols
        going = wp.abs(to) >= wp.float32(1e-6)
        way = wp.where(to > wp.float32(0.0), wp.int32(1), wp.int32(-1))
        apart = wp.float32(1.0) / wp.max(wp.abs(to), wp.float32(1e-6))
        move = aside * apart
        n = wp.int32(1)
        while going:
            t = wp.float32(n) * apart
            # 1. where the crossing lies
            at = start + way * n
            v = wp.float32(start_aside) + wp.float32(n) * move
            if periodic != 0:
                at = (at % length + length) % length
                v = v - wp.float32(width) * wp.floor(v / wp.float32(width))
                v = wp.where(v < wp.float32(width), v, wp.float32(0.0))
            elif (
                at < 0
                or at >= length
                or v < wp.float32(-1e-4)
                or v > wp.float32(width - 1) + wp.float32(1e-4)
            ):
                going = False
            if t > reach or highest - own <= slope * t or not (t * (along + slope * up) < limit):
                going = False
            if going:
                low = wp.min(wp.int32(wp.max(v, wp.float32(0.0))), width - 1)
                part = wp.min(wp.max(v - wp.float32(low), wp.float32(0.0)), wp.float32(1.0))
                # 2. its block, if that can hide nothing
                block_at = at >> shift
                block_low = low >> shift
                top = tops[
                    wp.where(by_rows == 1, block_at * across + block_low, block_low * across + block_at)
                ]
                if top - own <= slope * t:
                    left = wp.where(
                        way > 0, wp.min((block_at + 1) << shift, length) - at, at - (block_at << shift) + 1
                    )
                    n += wp.max(
                        1,
                        wp.min(
                            left,
                            steps_out(v, move, block_low << shift, wp.min((block_low + 1) << shift, width)),
                        ),
                    )
                else:
                    # 3. or the ground there
                    next = low
                    if low + 1 < width:
                        next = low + 1
                    elif periodic != 0:
                        next = wp.int32(0)
                    near = heights[wp.where(by_rows == 1, at * cols + low, low * cols + at)]
                    far = heights[wp.where(by_rows == 1, at * cols + next, next * cols + at)]
                    tangent = (near + part * (far - near) - own) / t
                    if up > wp.float32(0.0):  # through the source's plane no more is hidden than is below
                        tangent = wp.min(tangent, (limit / t - along) / up)
                    slope = wp.max(slope, tangent)
                    n += 1
    slopes[number] = slope


@wp.kernel
def pool(
    heights: wp.array[wp.float32],
    pooled: wp.array2d[wp.float32],
    rows: wp.int32,
    cols: wp.int32,
    across: wp.int32,
    down: wp.int32,
    shift: wp.int32,
    periodic: wp.int32,
    cliff: wp.float32,
):
    """Of every square block of 2^shift x 2^shift nodes the highest node, with the row and the column after
    it; the lowest node; and how many steps are cliffs.

      heights   (rows, cols)       float32 [spacing]  <= -1e29 where masked
      pooled    (3, down, across)  float32            out: the three that follow
      pooled[0]                    float32 [spacing]  highest valid node of the block, of the row and the
                                                      column after it and of the node where these meet: round
                                                      the map where that is periodic, else as far as it goes;
                                                      -1e30 if there is none
      pooled[1]                    float32 [spacing]  lowest valid node of the block itself; 1e30 if there is
                                                      none
      pooled[2]                    float32 [1]        steps from a valid node of the block to its right and to
                                                      its lower neighbour, valid and on the map (never round
                                                      it), that rise or fall by more than cliff

    Thread (by, bx) owns one block; its nodes along rows, from its first on.
    """
    by, bx = wp.tid()
    if bx >= across or by >= down:
        return
    end_x = wp.min((bx + 1) << shift, cols)
    end_y = wp.min((by + 1) << shift, rows)
    last_x = end_x
    last_y = end_y
    if periodic == 0:
        last_x = wp.min(end_x, cols - 1)
        last_y = wp.min(end_y, rows - 1)
    highest = wp.float32(NONE)
    lowest = wp.float32(-NONE)
    cliffs = wp.int32(0)
    for y in range(by << shift, last_y + 1):
        row = wp.where(y < rows, y, 0) * cols
        for x in range(bx << shift, last_x + 1):
            here = heights[row + wp.where(x < cols, x, 0)]
            if here > HIGHEST_MASKED:
                highest = wp.max(highest, here)
                if x < end_x and y < end_y:
                    lowest = wp.min(lowest, here)
                    if x + 1 < cols:
                        right = heights[row + x + 1]
                        if right > HIGHEST_MASKED and wp.abs(right - here) > cliff:
                            cliffs += 1
                    if y + 1 < rows:
                        below = heights[row + cols + x]
                        if below > HIGHEST_MASKED and wp.abs(below - here) > cliff:
                            cliffs += 1
    at = by * across + bx
    pooled[0, at] = highest
    pooled[1, at] = lowest
    pooled[2, at] = wp.float32(cliffs)


@wp.kernel
def pick(
    values: wp.array[wp.float32],
    at: wp.array[wp.int32],
    picked: wp.array[wp.float32],
    n_picked: wp.int32,
    missing: wp.float32,
):
    """Some values of an array.

      values   (count)    float32
      at       (n_picked)  int32    which; below 0 for none
      picked   (n_picked)  float32  out; ``missing`` where there is none

    Thread n owns one that is picked.
    """
    n = wp.tid()
    if n >= n_picked:
        return
    if at[n] >= 0:
        picked[n] = values[at[n]]
    else:
        picked[n] = missing
