"""The tables that every kernel language is handed: walks over lattice lines, crossings of grid lines, cycles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

BYTE = 8  # visibility bits of one walk and node that a plane holds


class Group(NamedTuple):
    """Walks with equally many elevations. A walk is an azimuth (i, j) with up to 8 of its elevations.

    walks (count, 8) int32, directions (count, bits) int32, steps (count, bits, 4) int32, rise (count, bits) float32,
    crossings (n, 8) int32, climbs (n, bits) float32, spans (count, 2) int32: the kernels' arguments of these names,
    see opencl/scan.cl, source.cl and filled.cl.
    """

    walks: np.ndarray
    directions: np.ndarray
    steps: np.ndarray
    rise: np.ndarray
    crossings: np.ndarray
    climbs: np.ndarray
    spans: np.ndarray

    @property
    def count(self) -> int:
        return len(self.walks)

    @property
    def bits(self) -> int:
        return self.directions.shape[1]


def walk_groups(steps: np.ndarray, shape: tuple[int, int], relief: float, step: float, periodic: bool, filled: bool, most: int) -> list[Group]:
    """The directions ``steps`` (D, 3) over a map of ``shape``, ``most`` walks a group; relief and step in the unit of depth."""
    ways: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for d, (i, j, up) in enumerate(steps.tolist()):
        ways.setdefault((i, j), []).append((-up, d))
    chunks = []
    for way, members in ways.items():
        chunks += [(way, part) for part in np.array_split(np.array(sorted(members)), -(-len(members) // BYTE))]
    # Many elevations first; within a size the longest lines first, so that none is left to run alone at the end.
    chunks.sort(key=lambda c: (-len(c[1]), abs(c[0][1]) or max(abs(c[0][0]), 1), c[0], c[1][0, 0]))
    groups = []
    while chunks:
        bits = len(chunks[0][1])
        count = min(most, sum(len(c[1]) == bits for c in chunks))
        groups.append(_group(chunks[:count], steps, shape, relief, step, periodic, filled))
        chunks = chunks[count:]
    return groups


def _group(chunks, steps, shape, relief, step, periodic, filled):
    rows, cols = shape
    walks, spans, crossings, climbs = [], [], [], []
    for (i, j), members in chunks:
        k = members[:, 0]
        points, parts = crossings_of(i, j, filled)
        spans.append((len(crossings), len(points)))
        crossings += points
        climbs += [point[6] * k * step for point in points]
        i, j = (i, j) if i or j else (0, rows)  # straight up: every node is a line of its own
        warm = _warm_up(i, j, k, shape, relief, step) if periodic else 0
        walks.append((i, j, -i % cols, -j % rows, warm, warm * i % cols, warm * j % rows, parts))
    directions = np.array([members[:, 1] for _, members in chunks], np.int32)
    k = np.array([members[:, 0] for _, members in chunks], float)
    walks = np.array(walks, np.int32)
    full_steps = np.concatenate([steps[directions] * [1, 1, -1], directions[..., None]], -1).astype(np.int32)
    return Group(walks, directions, full_steps, (k * step * walks[:, 7:]).astype(np.float32), np.array(crossings, np.int32),
                 np.array(climbs, np.float32), np.array(spans, np.int32))


def _warm_up(i, j, k, shape, relief, step):
    """Steps after which a ray has come round or is above all ground; the level ray starts from its cycle instead."""
    rows, cols = shape
    cycle = math.lcm(cols // math.gcd(cols, i), rows // math.gcd(rows, j))
    climbing = k[k > 0]
    return min(cycle, math.ceil(relief / (climbing.min() * step)) + 1) if len(climbing) else 0


def crossings_of(i: int, j: int, filled: bool) -> tuple[list[tuple[int, ...]], int]:
    """Where a step (i, j) meets grid lines, in order, as rows of the kernels' table, and the parts of a step.

    Not filled: the lattice node at its end alone.
    """
    if not filled or not (i or j):
        return [(i, j, 0, 0, 1, 0, 1, 1)], 1
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
    return [(*points[t], t, parts) for t in sorted(points)], parts


def lap_table(depth: np.ndarray, group: Group, filled: bool) -> np.ndarray:
    """(walks, lines) float32: the least depth x parts on the cycle of each line of a walk, on a map that repeats."""
    rows, cols = depth.shape
    ways = group.walks[:, :2].tolist()
    lines = [cols * min(abs(j), rows) if j else rows * min(abs(i), cols) for i, j in ways]
    table = np.full((group.count, max(lines)), np.inf, np.float32)
    least: dict[tuple[int, int], np.ndarray] = {}
    for w, (i, j) in enumerate(ways):
        if group.rise[w, 0] > 0:
            continue  # no level ray here
        opposite = least.get((-i, -j))  # the same cycle, walked the other way
        least[i, j] = _cycle_minimum(depth, i, j, filled) if opposite is None else opposite
        across, along, stride = (cols, rows, j) if j else (rows, cols, i)
        line = np.arange(lines[w])
        residue, lane = line // across, line % across
        start = along - 1 - residue if stride > 0 else residue
        table[w, : lines[w]] = least[i, j][start, lane] if j else least[i, j][lane, start]
    return table


def _cycle_minimum(depth, i, j, filled):
    rows, cols = depth.shape
    moved = lambda values, x, y: np.roll(values, (-y % rows, -x % cols), (0, 1))
    points, parts = crossings_of(i, j, filled)
    least = depth * np.float32(parts)
    for x, y, to_x, to_y, near, far, _, _ in points[:-1]:
        a, b = moved(depth, x, y), moved(depth, x + to_x, y + to_y)
        with np.errstate(invalid="ignore"):  # inf x 0 where masked
            ground = np.float32(near) * a + np.float32(far) * b
        least = np.minimum(least, np.where(np.isfinite(a) & np.isfinite(b), ground, np.float32(np.inf)))
    cycle = math.lcm(cols // math.gcd(cols, i), rows // math.gcd(rows, j))
    length = 1
    while length < cycle:  # the minimum over 1, 2, 4, ... nodes of the cycle
        least = np.minimum(least, moved(least, i * length, j * length))
        length *= 2
    return least
