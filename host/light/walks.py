"""Tables for the kernels of all languages: walks over lattice lines, crossings of grid lines, cycles."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

BYTE = 8  # visibility bits of one walk and node that a plane holds
# a rise after which nothing occludes; so small beside the largest float32 that adding it changes nothing
FREE = 1e30


class Group(NamedTuple):
    """Walks with equally many elevations. A walk is an azimuth (i, j) with up to 8 of its elevations.

    The kernels' arguments of these names, see opencl/scan.cl, source.cl and filled.cl: walks (count, 8)
    int32, rise (count, bits) float32, crossings (n, 8) int32, climbs (n, bits) float32, spans (count, 2)
    int32, and directions (count, bits) int32, the number of each direction. Walks along rows (j = 0) are
    walks along columns of the turned map, so that neighbours in memory stay neighbours; their results are
    turned back, plane by plane: pairs (turned walks, 2) int32, (from, to).
    """

    pairs: np.ndarray
    walks: np.ndarray
    rise: np.ndarray
    crossings: np.ndarray
    climbs: np.ndarray
    spans: np.ndarray
    directions: np.ndarray

    @property
    def n_walks(self) -> int:
        return len(self.walks)

    @property
    def bits(self) -> int:
        """Elevations of a walk."""
        return int(self.directions.shape[1])


@functools.lru_cache(16)
def walk_groups(
    steps: tuple[tuple[int, int, int], ...],
    shape: tuple[int, int],
    relief: float,
    step: float,
    periodic: bool,
    filled: bool,
    most: int,
) -> tuple[Group, ...]:
    """The directions ``steps`` (i, j, -k) over a map of ``shape``, at most ``most`` walks per group.

    ``relief``, 0 unless the map repeats, and ``step``, the spacing, in the unit of depth.
    """
    ways: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for d, (i, j, up) in enumerate(steps):
        ways.setdefault((i, j), []).append((-up, d))
    chunks = []
    for way, members in ways.items():
        chunks += [
            (way, part) for part in np.array_split(np.array(sorted(members)), -(-len(members) // BYTE))
        ]

    # Many elevations first; of equally many the longest lines first, so that none runs alone at the end.
    chunks.sort(key=lambda c: (-len(c[1]), abs(c[0][1]) or abs(c[0][0]), c[0], c[1][0, 0]))
    groups = []
    while chunks:
        count = min(most, sum(len(c[1]) == len(chunks[0][1]) for c in chunks))
        groups.append(_group(chunks[:count], shape, relief, step, periodic, filled))
        chunks = chunks[count:]
    return tuple(groups)


def _group(
    chunks: list[tuple[tuple[int, int], np.ndarray]],
    shape: tuple[int, int],
    relief: float,
    step: float,
    periodic: bool,
    filled: bool,
) -> Group:
    crossings: list[tuple[int, ...]] = []
    pairs: list[tuple[int, int]] = []
    walks, spans, climbs, rise = [], [], [], []
    for w, ((i, j), members) in enumerate(chunks):
        k = members[:, 0]
        turned = j == 0 and i != 0
        i, j = (j, i) if turned else (i, j)
        rows, cols = shape[::-1] if turned else shape
        points, parts = crossings_of(i, j, filled)
        spans.append((len(crossings), len(points)))
        crossings += points
        climbs += [point[6] * k * step for point in points]
        i = i % cols if periodic else i
        if (i == 0 and j == 0) or abs(i) >= cols:  # straight up, or off the map at once: nothing occludes
            i, j, warm = 0, 1, 0
            rise.append(np.full(len(k), FREE))
        else:
            climbing = k[k > 0]  # a level ray starts from its whole cycle instead
            warm = (
                min(cycle_length(i, j, rows, cols), math.ceil(relief / (climbing.min() * step)) + 1)
                if periodic and len(climbing)
                else 0
            )
            rise.append(k * step * parts)
        if turned:
            pairs.append((len(chunks) + len(pairs), w))
        walks.append(
            (i, j, warm, warm * i % cols, warm * j % rows, parts, turned, pairs[-1][0] if turned else w)
        )
    return Group(
        np.array(pairs, np.int32).reshape(-1, 2),
        np.array(walks, np.int32),
        np.array(rise, np.float32),
        np.array(crossings, np.int32),
        np.array(climbs, np.float32),
        np.array(spans, np.int32),
        np.array([members[:, 1] for _, members in chunks], np.int32),
    )


def cycle_length(i: int, j: int, rows: int, cols: int) -> int:
    """Steps (i, j) after which a walk over a periodic map is back at its node."""
    return math.lcm(cols // math.gcd(cols, i), rows // math.gcd(rows, j))


@functools.lru_cache(2048)  # M = 33 has 1,089 of them; some 10 MB
def crossings_of(i: int, j: int, filled: bool) -> tuple[tuple[tuple[int, ...], ...], int]:
    """Where a step (i, j) meets grid lines, in order, as rows of the kernels' table, and the parts of a step.

    Not filled: the lattice node at its end alone.
    """
    if not filled or not (i or j):
        return ((i, j, 0, 0, 1, 0, 1, 1),), 1
    parts = math.lcm(abs(i) or 1, abs(j) or 1)
    points = {}
    for a in range(1, abs(i) + 1):  # columns
        row, rest = divmod(a * j, abs(i))
        far = rest * parts // abs(i)
        points[a * parts // abs(i)] = (int(math.copysign(a, i)), row, 0, int(rest > 0), parts - far, far)
    for b in range(1, abs(j) + 1):  # rows
        col, rest = divmod(b * i, abs(j))
        far = rest * parts // abs(j)
        points[b * parts // abs(j)] = (col, int(math.copysign(b, j)), int(rest > 0), 0, parts - far, far)
    return tuple((*points[t], t, parts) for t in sorted(points)), parts


def lap_table(depth: np.ndarray, ways: list[tuple[int, int]], filled: bool) -> np.ndarray:
    """Of a periodic map, the least depth x parts on the cycle of each line of walks: (walks, lines) float32.

    Line r * across + n of a walk is the n-th of residue r: adjacent in x, or in y where j = 0.
    """
    rows, cols = depth.shape
    lines = [cols * min(abs(j), rows) if j else rows * min(abs(i), cols) for i, j in ways]
    table = np.full((len(ways), max(lines, default=0)), np.inf, np.float32)
    least: dict[tuple[int, int], np.ndarray] = {}
    for w, (i, j) in enumerate(ways):
        if (i, j) not in least:
            opposite = least.get((-i, -j))  # the same cycle, walked the other way
            least[i, j] = _cycle_minimum(depth, i, j, filled) if opposite is None else opposite
        across, along, stride = (cols, rows, j) if j else (rows, cols, i)
        residue, lane = np.divmod(np.arange(lines[w]), across)
        start = along - 1 - residue if stride > 0 else residue
        table[w, : lines[w]] = least[i, j][start, lane] if j else least[i, j][lane, start]
    # where a whole cycle is masked; see the first ceilings of scan
    return np.minimum(table, np.finfo(np.float32).max)


def _cycle_minimum(depth: np.ndarray, i: int, j: int, filled: bool) -> np.ndarray:
    """Of every node (rows, cols) float32, the least depth x parts on the cycle of steps (i, j) through it."""
    rows, cols = depth.shape

    def moved(values: np.ndarray, x: int, y: int) -> np.ndarray:
        return np.roll(values, (-y, -x), (0, 1))

    points, parts = crossings_of(i, j, filled)
    least: np.ndarray = depth * np.float32(parts)
    with np.errstate(invalid="ignore"):  # inf x 0 where masked
        for x, y, to_x, to_y, near, far, _, _ in points[:-1]:
            a, b = moved(depth, x, y), moved(depth, x + to_x, y + to_y)
            ground = np.float32(near + far) * a + np.float32(far) * (b - a)
            least = np.minimum(least, np.where(np.isfinite(a) & np.isfinite(b), ground, np.float32(np.inf)))
    cycle, length = cycle_length(i, j, rows, cols), 1
    while length < cycle:  # the minimum over 1, 2, 4, ... nodes of the cycle
        least = np.minimum(least, moved(least, i * length, j * length))
        length *= 2
    return least
