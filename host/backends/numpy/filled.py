"""The kernels of `filled` in NumPy: twin of opencl/filled.cl and warp_kernels/filled.py."""

from __future__ import annotations

import numpy as np

from .scan import map_of, scan_walk


def scan_filled(
    maps: np.ndarray,
    walks: np.ndarray,
    rise: np.ndarray,
    lap: np.ndarray,
    crossings: np.ndarray,
    climbs: np.ndarray,
    spans: np.ndarray,
    planes: np.ndarray,
    map_rows: int,
    map_cols: int,
    room: int,
    lap_lines: int,
    periodic: int,
    BITS: int,
) -> None:
    for w, walk in enumerate(walks):
        begin, end = spans[w, 0], spans[w].sum() - 1
        depth = map_of(maps, walk[6], (map_rows, map_cols))
        limits = np.full((climbs.shape[1], *depth.shape), np.inf, np.float32)
        for crossing, climb in zip(crossings[begin:end], climbs[begin:end]):
            np.minimum(limits, _ground(depth, crossing, periodic) + climb[:, None, None], out=limits)

        def lower(ceiling: np.ndarray, row: int, limits: np.ndarray = limits) -> None:
            np.minimum(ceiling, limits[:, row], out=ceiling)

        scan_walk(maps, walk, rise[w], lap[w], planes, (map_rows, map_cols), periodic, lower)


def _ground(depth: np.ndarray, crossing: np.ndarray, periodic: int) -> np.ndarray:
    """Depth x parts at a crossing next to every node (rows, cols); +inf where it is unknown."""
    rows, cols = depth.shape
    y, x = np.arange(rows)[:, None], np.arange(cols)
    to_x, to_y, next_x, next_y, near_weight, far_weight = (int(v) for v in crossing[:6])

    def depth_at(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        there: np.ndarray = depth[py % rows, px % cols]
        inside = (px >= 0) & (px < cols) & (py >= 0) & (py < rows)
        return there if periodic else np.where(inside, there, np.float32(np.inf))

    near, far = depth_at(x + to_x, y + to_y), depth_at(x + to_x + next_x, y + to_y + next_y)
    ground = np.float32(near_weight + far_weight) * near + np.float32(far_weight) * (far - near)
    return np.where((near < np.inf) & (far < np.inf), ground, np.float32(np.inf))
