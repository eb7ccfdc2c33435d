"""The forward model on a device: irradiance of a depth map, and its derivatives by depth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..backends.base import Backend, reserve
from ..constants import LINK_BLOCK, NODES_PER_SUM, NONE, PIXEL_PADDING, SIDES, TILE
from ..errors import CapacityError
from .lights import Light

MARGIN = 16  # nodes left and right of the map of heights
BYTES_PER_LINK, BYTES_PER_NODE, BYTES_PER_SUM = 40, 80, 16  # of an image and what solves for it, about

DeviceArray = Any  # each backend has its own


class Launcher:
    """Launches of the kernels of gauss_newton over the nodes of a grid."""

    def __init__(self, backend: Backend, shape: tuple[int, int]):
        self.backend, self.shape, self.pixels = backend, shape, shape[0] * shape[1]
        self.blocks = -(-self.pixels // NODES_PER_SUM)  # a work-item of a sum owns one
        # nodes of a work-item, and sums that work-items of their own scatter into
        self.nodes_per_item, self.partial_sums = backend.nodes_per_item, backend.partial_sums
        self._recorded: dict[tuple[str, int], Callable[[], None] | None] = {}

    def launch(self, kernel: str, *args: Any, dim: tuple[int, ...] | None = None) -> None:
        """Runs a kernel, over all nodes unless ``dim`` says otherwise."""
        self.backend.launch("gauss_newton", kernel, dim or (-(-self.pixels // self.nodes_per_item),), *args)

    def repeat(self, work: Callable[[int], None], side: int, times: int = 1) -> None:
        """Does work(side), ``times`` times; from the second call on as the backend has recorded it."""
        key = work.__name__, side
        if key not in self._recorded:
            for _ in range(times):
                work(side)
            self._recorded[key] = None
            return
        recorded = self._recorded[key] or self.backend.record(lambda: work(side), times)
        self._recorded[key] = recorded
        recorded()


class Surface:
    """A depth map for rays: heights with a margin, tilts, the greatest heights of tiles and of all."""

    def __init__(self, launcher: Launcher, sides: str):
        rows, cols = launcher.shape
        backend, self.launcher, self.sides = launcher.backend, launcher, SIDES[sides]
        self.heights = backend.empty((rows * (cols + 2 * MARGIN),), np.float32, NONE)
        self.tilts, self.top = backend.empty((2, rows * cols), np.float32), backend.empty((1,), np.int32)
        self.across = -(-cols // TILE), -(-rows // TILE)
        self.tiles = backend.empty((self.across[1] * self.across[0],), np.float32)

    def set_depth(self, z: DeviceArray) -> None:
        rows, cols = self.launcher.shape
        heights = self.heights, self.tilts, self.top, rows, cols, MARGIN, self.sides
        self.launcher.backend.launch("adjoint", "surface", (cols, rows), z, *heights)
        self.launcher.backend.launch("adjoint", "tiles", self.across, z, self.tiles, self.top, rows, cols)


def links_of(backend: Backend, pixels: int, count: int) -> tuple[DeviceArray, ...]:
    """light, held, first, second, near, far (opencl/adjoint.cl), with room for so many links of a node."""
    room = -(-pixels // LINK_BLOCK), count, LINK_BLOCK
    kinds = np.int32, np.int32, np.float32, np.float32
    light, held = backend.empty((4, pixels), np.float32), backend.empty((pixels,), np.int32)
    return light, held, *(backend.empty(room, kind) for kind in kinds)


class Image:
    """One image of the surface on the device: the irradiance of a depth map, and its derivatives."""

    def __init__(
        self,
        backend: Backend,
        light: Light,
        shape: tuple[int, int],
        sides: str,
        gain: np.ndarray,
        target: np.ndarray,
    ):
        self.backend, self.shape, self.sides = backend, shape, SIDES[sides]
        # slices of the source, and links of a node that there is room for
        self.slices = self.count = len(light.directions)
        pixels = shape[0] * shape[1]
        if (pixels + PIXEL_PADDING) * self.count >= 2**31:
            raise CapacityError(
                f"An image of {pixels:,} pixels along {self.count} azimuths: more than 2^31 links. Cut it"
                " into tiles."
            )
        reserve(
            backend,
            pixels * (BYTES_PER_LINK * self.count + BYTES_PER_NODE + BYTES_PER_SUM * backend.partial_sums),
            f"Recovering {pixels:,} nodes along {self.count} azimuths",
            "Recover a smaller image.",
        )

        def put(array: np.ndarray | None) -> DeviceArray:
            return backend.upload(np.ascontiguousarray(array, np.float32))

        self.is_sky, self.is_ball = light.frames is None, int(light.ball)
        self.directions = put(light.directions)
        self.table = put(np.zeros((1, 4)) if light.table is None else light.table)
        self.knots, self.rows_of_table = (0, 1) if light.table is None else light.table.shape[1::-1]
        if self.is_sky:
            self.numbers, self.slopes = (
                backend.empty((self.count, pixels + PIXEL_PADDING), kind) for kind in (np.int32, np.float32)
            )
        else:
            self.frames, self.solid = put(light.frames), put(light.solid)
        self.gain = put(np.broadcast_to(gain, shape).ravel())
        self.gains = [self.gain] * 2  # with the albedo of the surface and of a trial
        self.target = put(target.ravel())
        # of the surface and of a trial
        self.links = [links_of(backend, pixels, self.count) for _ in range(2)]
        self.direct = self.links  # those of direct light, by which an evaluation begins

    def evaluate(self, side: int, surface: Surface) -> None:
        """Irradiance and its derivatives at a surface."""
        if self.is_sky:
            self._evaluate_sky(side, surface)
        else:
            self._evaluate_lamp(side, surface)

    def _evaluate_sky(self, side: int, surface: Surface) -> None:
        rows, cols = self.shape
        azimuths = self.slices if self.backend.nodes_per_item > 1 else 1  # of a work-item
        across = -(-cols // self.backend.lanes)
        size = rows, cols, MARGIN, self.slices
        self.backend.launch(
            "adjoint",
            "horizons",
            (across, rows, -(-self.slices // azimuths)),
            *(surface.heights, surface.tilts, surface.tiles, surface.top),
            *(self.directions, self.numbers, self.slopes, *size, self.sides, azimuths),
        )
        self.backend.launch(
            "adjoint",
            "sky",
            (across, rows),
            *(surface.heights, surface.tilts, surface.top, self.numbers, self.slopes),
            *(self.directions, self.table, *self.direct[side], *size, self.knots, self.sides),
        )

    def _evaluate_lamp(self, side: int, surface: Surface) -> None:
        rows, cols = self.shape
        self.backend.launch(
            "adjoint",
            "lamp",
            (cols, rows),
            *(surface.heights, surface.tilts, surface.tiles, surface.top),
            *(self.frames, self.directions, self.solid, self.table),
            *(*self.direct[side], rows, cols, MARGIN, self.slices),
            *(self.knots, self.rows_of_table, self.is_ball, self.sides),
            lanes=1,
        )
