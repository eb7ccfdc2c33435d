"""The kernels of `propagate` in NumPy: twin of opencl/propagate.cl and warp_kernels/propagate.py."""

from __future__ import annotations

import numpy as np

from .scan import sweep_lines


def reaches(
    depth: np.ndarray,
    ways: np.ndarray,
    lap: np.ndarray,
    levels: np.ndarray,
    rows: int,
    cols: int,
    lap_lines: int,
    periodic: int,
) -> None:
    nothing = np.zeros((1, 1), np.float32)
    for w, (i, j) in enumerate(ways.tolist()):
        z, out = (depth, levels[w]) if j else (depth.T, levels[w].T)
        i, j = (i, j) if j else (0, i)

        def first_ceiling(line: int, w: int = w, cols: int = z.shape[1]) -> np.ndarray:
            sky = np.full((1, cols), np.inf, np.float32)
            return lap[w, None, line : line + cols].copy() if periodic else sky

        keep = lambda ceiling, row: None
        for row, _, ceiling in sweep_lines(z, i, j, 0, first_ceiling, periodic, keep, nothing):
            out[row] = ceiling[0]


def propagate(
    depth: np.ndarray,
    levels: np.ndarray,
    offsets: np.ndarray,
    field: np.ndarray,
    rows: int,
    cols: int,
    reach: int,
    n_words: int,
    n_directions: int,
    n_level: int,
    layer: int,
) -> None:
    here = field[layer + reach]
    width = cols + 2 * reach
    lit = np.zeros((n_words, rows, cols), np.uint32)
    for d, (k, offset) in enumerate(offsets.tolist()):
        word, bit = d // 32, np.uint32(1 << d % 32)
        if d < n_level:
            lit[word] |= np.where(levels[d] >= layer, bit, np.uint32(0))
        else:
            j = round(offset / width)
            i = offset - j * width
            above = field[layer + reach - k, word]
            lit[word] |= above[reach + j : reach + j + rows, reach + i : reach + i + cols] & bit
    here[:, reach : reach + rows, reach : reach + cols] = np.where(depth >= layer, lit, np.uint32(0))


def wrap(field: np.ndarray, rows: int, cols: int, reach: int, n_words: int, layer: int) -> None:
    y, x = (np.arange(n + 2 * reach) - reach for n in (rows, cols))
    field[layer + reach] = field[layer + reach][:, (y % rows + reach)[:, None], (x % cols + reach)[None]]
