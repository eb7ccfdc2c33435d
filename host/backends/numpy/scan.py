"""The kernels of `scan` in NumPy: twin of opencl/scan.cl and warp_kernels/scan.py."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ... import constants

NO_CEILING = np.float32(constants.NO_CEILING)  # finite, so that a masked node never passes

Lowering = Callable[[np.ndarray, int], None]  # of the ceilings at a row


def sweep_lines(
    depth: np.ndarray,
    i: int,
    j: int,
    warm: int,
    first_ceiling: Callable[[int], np.ndarray],
    periodic: int,
    lower: Lowering,
    climb: np.ndarray,
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yields (row, depths, ceilings) of one walk (i, j), j not 0, row by row from the source's side.

    ``lower(ceiling, row)`` lowers the ceilings first.
    """
    rows, cols = depth.shape
    for residue in range(min(abs(j), rows)):
        ceiling = first_ceiling(residue * cols)
        for u in range(-warm, -(-(rows - residue) // abs(j))):
            row = (residue + u * abs(j)) % rows
            row = rows - 1 - row if j > 0 else row
            lower(ceiling, row)
            z = depth[row]
            if u >= 0:
                yield row, z, ceiling
            ceiling = np.minimum(ceiling, z) + climb
            # the next node of a line lies i columns back; a line from outside the map has open sky
            ceiling = np.roll(ceiling, -i, 1)
            if not periodic and i:
                ceiling[:, slice(-i, None) if i > 0 else slice(0, -i)] = NO_CEILING


def scan_walk(
    maps: np.ndarray,
    walk: np.ndarray,
    climb: np.ndarray,
    lap: np.ndarray,
    planes: np.ndarray,
    shape: tuple[int, int],
    periodic: int,
    lower: Lowering | None = None,
) -> None:
    i, j, warm, _, _, parts, turned, plane = walk.tolist()
    depth = map_of(maps, turned, shape)
    bits = len(climb)

    def first_ceiling(line: int) -> np.ndarray:
        ceiling = np.full((bits, depth.shape[1]), NO_CEILING)
        if periodic and climb[0] == 0:
            # the warm-up begins elsewhere on the cycle
            ceiling[0] = np.roll(lap[line : line + depth.shape[1]], warm * i)
        return ceiling

    out = planes[plane, : depth.size].reshape(depth.shape)
    weights = (1 << np.arange(bits, dtype=np.uint8))[:, None]
    scaled = depth * np.float32(parts) if lower else depth
    lower = lower or (lambda ceiling, row: None)
    for row, z, ceiling in sweep_lines(scaled, i, j, warm, first_ceiling, periodic, lower, climb[:, None]):
        out[row] = ((z <= ceiling) * weights).sum(0, dtype=np.uint8)


def map_of(maps: np.ndarray, turned: int, shape: tuple[int, int]) -> np.ndarray:
    shape = shape[::-1] if turned else shape
    return maps[turned, : shape[0] * shape[1]].reshape(shape)


def scan(
    maps: np.ndarray,
    walks: np.ndarray,
    rise: np.ndarray,
    lap: np.ndarray,
    planes: np.ndarray,
    map_rows: int,
    map_cols: int,
    room: int,
    lap_lines: int,
    periodic: int,
    BITS: int,
) -> None:
    for w, walk in enumerate(walks):
        scan_walk(maps, walk, rise[w], lap[w], planes, (map_rows, map_cols), periodic)


def turn_map(maps: np.ndarray, rows: int, cols: int, room: int) -> None:
    map_of(maps, 1, (rows, cols))[...] = map_of(maps, 0, (rows, cols)).T


def turn_planes(planes: np.ndarray, pairs: np.ndarray, rows: int, cols: int, room: int) -> None:
    n = rows * cols
    for turned, plane in pairs:
        planes[plane, :n].reshape(rows, cols)[...] = planes[turned, :n].reshape(cols, rows).T


def pack(
    planes: np.ndarray,
    order: np.ndarray,
    words: np.ndarray,
    pixels: int,
    room: int,
    n_words: int,
    n_walks: int,
    BITS: int,
) -> None:
    words = words.reshape(pixels, n_words)
    for w in range(n_walks):
        lit = planes[w, :pixels]
        for b, d in enumerate(order[w]):
            words[:, d // 32] |= (lit >> np.uint8(b) & np.uint8(1)).astype(np.uint32) << np.uint32(d % 32)


turn_planes_by_fours = turn_planes
