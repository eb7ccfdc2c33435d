"""Light of finite sources, balls, rectangles and windows, through a few azimuth slices per pixel (MODEL.md, 3.4)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..sources import radiance
from .base import Backend

NONE = -1e30
MOST_LEVELS = 7
SIDE = 512


class Ball(NamedTuple):
    center: tuple
    radius: float


class Quad(NamedTuple):
    corners: np.ndarray


class Slices:
    def __init__(self, backend, depth, step, sides, solid, brightness=1.0, slices=8, n_points=4):
        self.backend, self.solid = backend, solid
        rows, cols = self.shape = depth.shape
        heights = np.full((rows + 2) * (cols + 1) + 1, NONE, np.float32)
        inside = heights[cols + 1 : -(cols + 2)].reshape(rows, cols + 1)[:, 1:] if False else None
        grid = np.full((rows + 2, cols + 1), NONE, np.float32)
        grid[1:-1, 1:] = np.where(np.isfinite(depth), -depth / np.float32(step), np.float32(NONE))
        self.heights = backend.upload(np.append(grid.ravel(), np.float32(NONE)))
        self.levels = min(MOST_LEVELS, max(1, int(np.ceil(np.log2(max(rows, cols))))))
        unit = 2 ** self.levels
        self.width = -(-cols // unit) * unit
        self.tops = backend.empty((((rows - 1) >> 1) + 1) * self.width, np.float32) if False else backend.empty(((((rows - 1) >> 1) + 1), self.width), np.float32, NONE)
        self.image = backend.empty((rows, cols), np.float32)
        self.step, self.dark = float(step), int(sides == "dark")
        if np.ndim(brightness):
            self.sky, self.scale, self.n_points = backend.upload(np.asarray(brightness, np.float32)), 1.0, n_points
        else:
            self.sky, self.scale, self.n_points = backend.upload(np.zeros((1, 1), np.float32)), float(brightness), 0
        f, w = np.polynomial.legendre.leggauss(max(1, n_points))
        self.points = backend.upload(np.stack([(f + 1) / 2, w / 2], 1).astype(np.float32))
        self.slices = slices
        if isinstance(solid, Ball):
            table = np.zeros((slices // 8, 4, slices))
            for b in range(slices // 8):
                n = 8 * (b + 1)
                share = (np.arange(n) + 0.5) / n
                theta, azimuth = np.pi * (share - 0.5), 2 * np.pi * share
                table[b, :, :n] = np.sin(theta), np.cos(theta), np.sin(azimuth), np.cos(azimuth)
            self.table = backend.upload(table.astype(np.float32))
        else:
            c = np.asarray(solid.corners, float) / self.step * [1, 1, -1]
            middle = c.mean(0)
            normal = np.cross(c[1] - c[0], c[3] - c[0])
            normal /= np.linalg.norm(normal)
            self.corners = backend.upload(np.concatenate([c - middle, [middle, normal]]).astype(np.float32))
            table = np.zeros((slices, slices, 2))
            for n in range(1, slices + 1):
                table[n - 1, :n] = np.stack(np.polynomial.legendre.leggauss(n), 1)
            self.table = backend.upload(table.astype(np.float32))

    def build(self):
        rows, cols = self.shape
        for level in range(1, self.levels + 1):
            self.backend.launch("slices", "coarser", (self.width >> level, ((rows - 1) >> level) + 1), self.heights, self.tops, rows, cols, self.width, level)

    def run(self):
        rows, cols = self.shape
        self.build()
        if isinstance(self.solid, Quad):
            self.backend.launch("slices", "quad", (cols, rows), self.heights, self.tops, self.corners, self.table, self.sky, self.points, self.image, rows, cols, self.width,
                                self.levels, self.slices, len(self.sky) if self.n_points else 1, self.n_points, self.dark, self.scale)
            return
        x, y, z = (v / self.step for v in self.solid.center)
        self.backend.launch("slices", "ball", (cols, rows), self.heights, self.tops, self.table, self.sky, self.points, self.image, rows, cols, self.width,
                            self.levels, self.slices, len(self.sky) if self.n_points else 1, self.n_points, self.dark, x, y, -z, self.solid.radius / self.step, self.scale)

    def download(self):
        return self.backend.download(self.image)


def brightness_map(source, side=SIDE):
    """Brightness over the stereographic plane, (side, side)."""
    u = np.linspace(-1, 1, side)
    u, v = np.meshgrid(u, u)
    r2 = u * u + v * v
    over = np.sqrt(np.maximum(r2, 1))
    u, v = u / over, v / over
    r2 = u * u + v * v
    L = np.stack([2 * u, 2 * v, -(1 - r2)], -1) / (1 + r2)[..., None]
    return radiance(source, L)
