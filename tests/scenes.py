"""Depth maps of the suite: whole layers, where every method is exact, and continuous ones.

All are made here, from fixed seeds. Most sizes have short common cycles, since the oracle follows level rays
round a periodic map node by node.
"""

import functools

import numpy as np

import skylamp as sl
from skylamp import oracle
from skylamp.backends import resident, select
from skylamp.io import files as io
from skylamp.sources.shapes import Geometry

SKY = Geometry(0, np.zeros(4), np.zeros((1, 1, 1), np.uint8))
SIDES = ("open", "dark", "periodic")


def rough(rows, cols, slope, seed=0, falloff=1.6):
    """A continuous random surface of about this rms slope, its nearest point at 0."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None]
    frequency = np.hypot(fy, fx)
    frequency[0, 0] = np.inf
    height = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(rows, cols))) * frequency**-falloff, (rows, cols))
    rms = np.sqrt(sum(np.mean(np.diff(height, axis=a) ** 2) for a in (0, 1)))
    return (height.max() - height) * (slope / rms)


def resident_map(backend, depth, step=1.0):
    """A depth map (rows, cols), inf where masked, on a backend; the spacing in its unit is ``step``."""
    depth = np.ascontiguousarray(depth, np.float32)
    valid = depth[np.isfinite(depth)]
    least, most = (float(valid.min()), float(valid.max())) if valid.size else (0.0, 0.0)
    return resident.upload(select(backend), depth, step, least, most)


def _slanted():
    y, x = np.mgrid[:26, :39]
    return x // 4 + y // 3


def _bumps():
    y, x = np.mgrid[:30, :25]
    return np.rint(4 + 4 * np.cos(x / 2.1) * np.cos(y / 2.7)).astype(int)


def _fractal():
    return np.rint(rough(27, 36, 1.0, seed=3)).astype(int)


def _walls():
    depth = np.full((33, 22), 9)
    depth[:, 7] = 0
    depth[5, 9:] = 2
    depth[20, :20] = 4
    for t in range(9):
        depth[22 + t, 10 + t] = 1
    return depth


def _spikes():
    rng = np.random.default_rng(5)
    depth = np.full((22, 33), 11)
    depth[rng.random(depth.shape) < 0.08] = 0
    where = rng.random(depth.shape) < 0.1
    depth[where] = rng.integers(1, 16, where.sum())  # shallower than the floor, and pits of one node
    return depth


def _plateaus():
    y, x = np.mgrid[
        :24, :32
    ]  # terraces whose edges stand in line with rays of slope 1, 1/2 and 2: touching everywhere
    return np.where(y < 12, 2 * (x // 4), np.minimum(x, 31 - x) // 2 + (y - 12) // 3)


def _noise():
    return np.random.default_rng(8).integers(0, 6, (17, 19))


def _masked():
    depth = _bumps()
    valid = np.ones(depth.shape, bool)
    valid[0, :4] = valid[10:14, 8:13] = valid[-1, -1] = valid[:, 20] = False
    valid[17, 3] = False
    return depth, valid


@functools.cache
def terrain():
    """The Jacksboro fault: height (rows, cols) [m] and spacing [m]."""
    height, spacing = io.terrain()
    return np.asarray(height, float), float(spacing)


def _terrain_layers():
    height, _ = terrain()
    crop = height[100:130, 180:220]
    return np.rint((crop.max() - crop) / 12).astype(int)


MAPS = {
    "slanted": _slanted,
    "bumps": _bumps,
    "fractal": _fractal,
    "walls": _walls,
    "spikes": _spikes,
    "plateaus": _plateaus,
    "noise": _noise,
    "small noise": lambda: np.random.default_rng(9).integers(0, 6, (8, 12)),  # of short cycles
    "masked": _masked,
    "terrain": _terrain_layers,
    "row": lambda: np.random.default_rng(1).integers(0, 5, (1, 29)),
    "column": lambda: np.random.default_rng(2).integers(0, 5, (31, 1)),
    "tiny": lambda: np.array([[2, 0, 1], [3, 1, 4]]),
    "one": lambda: np.array([[3]]),
}


@functools.cache
def whole_layers(name):
    """(depth (rows, cols) int64 in layers, valid (rows, cols) bool or None), not to be written to."""
    made = MAPS[name]()
    depth, valid = made if isinstance(made, tuple) else (made, None)
    depth = depth.astype(np.int64)
    depth.flags.writeable = False
    return depth, valid


def scene(name, sides="open", spacing=1.0, albedo=0.8):
    """The sl.Scene of a map in whole layers, ``spacing`` per layer; masked depths are NaN."""
    depth, valid = whole_layers(name)
    values = depth * float(spacing)
    return sl.Scene(
        values if valid is None else np.where(valid, values, np.nan), spacing, albedo, valid, sides
    )


def layers(name):
    """Depth as the oracle takes it: whole layers, -1 where masked."""
    depth, valid = whole_layers(name)
    return depth if valid is None else np.where(valid, depth, -1)


@functools.cache
def truth(name, size, sides):
    """The oracle's propagation under a sky, packed (rows, cols, words) uint32; made once per session."""
    cube = sl.Hemicube(size)
    return cube.pack(oracle.surface_visibility(layers(name), cube.steps, sides, SKY))


@functools.cache
def filled_truth(name, size, sides):
    """The oracle's test of every crossing, packed."""
    depth, valid = whole_layers(name)
    cube = sl.Hemicube(size)
    return cube.pack(
        oracle.filled_visibility(
            np.where(True if valid is None else valid, depth, np.inf).astype(float), 1.0, cube.steps, sides
        )
    )


def offset_plane(rows=40, cols=56, spacing=0.1):
    """A slanted plane half a layer off the lattice, step 0.1: rounding decides nearly every tie."""
    y, x = np.mgrid[:rows, :cols]
    return spacing * (x + 0.5) + 2 * spacing * (y // 8)
