"""Depth maps that lie on a device: checked, padded and probed there."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..constants import NONE
from .base import Array, Backend

# rows of a column that a work-item of ``survey`` owns; chosen: 32 k items on 4096 x 4096 nodes
SURVEYED_ROWS = 512
LAYERS = 2**20  # up to which whole layers are compared in place of depths: their sums are exact in float32


class DeviceImage:
    """An image (rows, cols), or a stack of images, float32, that lies on a backend.

    ``numpy.asarray`` fetches a copy. Where it lies on a GPU, libraries that read ``__cuda_array_interface__``
    or DLPack (CuPy, PyTorch, JAX, Warp) take it in place.

    ``held``: what owns the arrays that launches under way read, until the image is fetched. A driver waits
    for these launches before it frees memory, and the host with it.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, backend: Backend, values: Array, shape: tuple[int, ...], held: Any = None):
        self.backend, self.values, self.shape, self.held = backend, values, shape, held
        self.ndim = len(shape)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        values = self.backend.download(self.values).reshape(-1)[: math.prod(self.shape)].reshape(self.shape)
        self.held = None
        return values if dtype is None else values.astype(dtype, copy=False)

    def shade(
        self, there: Resident, albedo: float | np.ndarray, unit: float, least: float = -math.inf
    ) -> None:
        """Multiply by albedo, a number or a map, and ``unit``, in place; nan where the map is masked.

        Values below ``least`` become ``least`` before.
        """
        values, count = np.asarray(albedo, np.float32), math.prod(self.shape)
        given = self.backend.table(values.reshape(-1))
        numbers = int(values.ndim > 0), float(unit), float(least), count
        self.backend.launch("resident", "shade", (count,), self.values, there.depth, given, *numbers)
        if values.ndim:
            self.backend.finish()  # the albedo may be freed

    def copy(self) -> DeviceImage:
        """The same values in memory of their own."""
        count = math.prod(self.shape)
        copied, none = self.backend.empty((count,), np.float32), self.backend.table(np.zeros(1, np.uint8))
        self.backend.launch("resident", "adopt", (count,), self.values, none, copied, 0.0, 1.0, 0, count)
        return DeviceImage(self.backend, copied, self.shape)

    def scale(self, factor: float, least: float = -math.inf) -> None:
        """Multiply by a number, in place; values below ``least`` become ``least`` before."""
        count = math.prod(self.shape)
        one = self.backend.table(np.ones(1, np.float32))
        numbers = 0, float(factor), float(least), count
        self.backend.launch("resident", "shade", (count,), self.values, self.values, one, *numbers)

    def __deepcopy__(self, memo: dict[int, Any]) -> DeviceImage:
        with self.backend.lock:
            return self.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as a NumPy array: who reads it may have no such device."""
        return np.asarray, (np.asarray(self),)

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"DeviceImage({' x '.join(map(str, self.shape))}, float32, on {self.backend.name})"

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        if self.backend.shares:
            raise AttributeError(f"the image lies on {self.backend.name}, which is no CUDA device")
        self.backend.finish()  # whoever reads it may do so on a stream of its own
        address = int(self.values.ptr), False
        return dict(shape=self.shape, typestr=self.dtype.str, data=address, strides=None, version=3)

    def __dlpack__(self, **options: Any) -> Any:
        return self.backend.view(self.values, self.shape).__dlpack__(**options)

    def __dlpack_device__(self) -> Any:
        return self.values.__dlpack_device__()


class Survey(NamedTuple):
    """Properties of a map's valid nodes, from one pass over it.

    Least and greatest value; numbers of values that are not finite, and of those that are no whole number of
    steps; sums of the squares of differences between neighbours, and how many there are, along rows and down
    columns.
    """

    least: float
    most: float
    broken: int
    fractional: int
    squares: tuple[float, float]
    pairs: tuple[int, int]


class Resident(NamedTuple):
    """A depth map on a device.

    The device's backend; depth (rows x cols) float32 there, +inf where masked, in a unit in which the spacing
    is ``step``; least and greatest valid depth; the bytes that it takes besides the host's; what was
    ``derived`` of it, which a later call finds.
    """

    backend: Backend
    depth: Array
    shape: tuple[int, int]
    step: float
    least: float
    most: float
    nbytes: int
    derived: dict[tuple[Any, ...], Any]

    def download(self) -> np.ndarray:
        """The map (rows, cols) on the host."""
        return self.backend.download(self.depth).reshape(self.shape)

    @property
    def heights_range(self) -> tuple[float, float]:
        """The lowest and the highest ground [spacing], rounded as :meth:`heights` rounds them."""
        low, high = (-np.float32(depth) / np.float32(self.step) for depth in (self.most, self.least))
        return float(low), float(high)

    def heights(
        self,
        left: int = 0,
        above: int = 0,
        right: int = 0,
        below: int = 0,
        masked: float = NONE,
        periodic: bool = False,
    ) -> Array:
        """Heights [spacing] with margins, flat, on the device; ``masked`` where masked, NONE beside the map.

        A map that is ``periodic`` goes on in the margins.
        """
        rows, cols = self.shape
        width, height = cols + left + right, rows + above + below
        window = self.backend.empty((width * height,), np.float32)
        size = rows, cols, left, above, width, height
        numbers = float(self.step), float(masked), int(periodic)
        self.backend.launch("resident", "heights", (width, height), self.depth, window, *size, *numbers)
        return window

    def probe(self, heights: Array, margin: int, every: int, first: int) -> np.ndarray:
        """Steepest slopes (8, samples) from every ``every``-th node to ground at least ``first`` rows away.

        -inf where no ground lies.
        """
        rows, cols = self.shape
        across = -(-cols // every)
        count = across * -(-rows // every)
        best = self.backend.empty((8, count), np.float32)
        self.backend.launch(
            "resident", "probe", (count, 8), heights, best, rows, cols, margin, every, across, count, first
        )
        return self.backend.download(best)

    def pick(self, nodes: np.ndarray) -> np.ndarray:
        """Depths at nodes, numbered row by row."""
        return gather(self.backend, self.depth, nodes, math.inf)

    def copy_into(self, depth: Array) -> None:
        """Copy the map to the first elements of a device array."""
        rows, cols = self.shape
        size = rows, cols, 0, 0, cols, rows
        self.backend.launch("resident", "heights", (cols, rows), self.depth, depth, *size, -1.0, math.inf, 0)

    def survey(self) -> Survey:
        """Properties of the valid nodes, by one pass over the map, which is kept."""
        if ("survey",) not in self.derived:
            self.derived["survey",] = survey(self.backend, self.depth, self.shape, self.step)
        surveyed: Survey = self.derived["survey",]
        return surveyed


def gather(backend: Backend, values: Array, at: np.ndarray, missing: float) -> np.ndarray:
    """Elements of a device array; ``missing`` where the number is negative."""
    given, picked = backend.table(at.astype(np.int32).ravel()), backend.empty((at.size,), np.float32)
    backend.launch("pilot", "pick", (at.size,), values, given, picked, at.size, missing, lanes=1)
    return backend.download(picked).reshape(at.shape)


def adopt(
    backend: Backend, values: Array, shape: tuple[int, int], mask: np.ndarray | None, height: bool
) -> tuple[Array, Survey]:
    """A copy of device array ``values`` (rows x cols) float32 [length] as depth, and its survey.

    ``values`` are depth, or with ``height`` heights, which are turned into depth: the highest valid one minus
    each. Where ``mask`` is False the depth is +inf, and where it is True and a value is +inf it is nan.
    """
    count = math.prod(shape)
    depth = backend.empty((count,), np.float32)
    valid = backend.empty((1,), np.uint8) if mask is None else backend.upload(mask.view(np.uint8).ravel())

    def take(top: float, sign: float) -> Survey:
        masked = int(mask is not None)
        backend.launch("resident", "adopt", (count,), values, valid, depth, top, sign, masked, count)
        return survey(backend, depth, shape)

    surveyed = take(0.0, 1.0)
    if height and not surveyed.broken and surveyed.least <= surveyed.most:
        surveyed = take(surveyed.most, -1.0)
    return depth, surveyed


def survey(backend: Backend, depth: Array, shape: tuple[int, int], step: float = 1.0) -> Survey:
    """A pass over a map (rows x cols) float32 [length] on a device, +inf where masked."""
    rows, cols = shape
    blocks = -(-rows // SURVEYED_ROWS)
    partial = backend.empty((8, blocks, cols), np.float32)
    backend.launch(
        "resident", "survey", (cols, blocks), depth, partial, rows, cols, SURVEYED_ROWS, float(step)
    )
    low, high, *sums = backend.download(partial).reshape(8, -1)
    broken, fractional, *rest = (float(part.sum(dtype=np.float64)) for part in sums)
    squares, pairs = (rest[0], rest[1]), (int(rest[2]), int(rest[3]))
    return Survey(float(low.min()), float(high.max()), int(broken), int(fractional), squares, pairs)


def in_layers(
    backend: Backend, depth: Array, shape: tuple[int, int], spacing: float, surveyed: Survey
) -> Resident:
    """A map of depths [length]; whole layers in place of depths where all are such, as for a host's map."""
    count, step = math.prod(shape), spacing
    least, most = surveyed.least, surveyed.most
    if spacing != 1 and most / spacing < LAYERS and not survey(backend, depth, shape, spacing).fractional:
        backend.launch("resident", "layers", (count,), depth, float(spacing), count)
        step, least, most = 1.0, float(np.rint(least / spacing)), float(np.rint(most / spacing))
    return Resident(backend, depth, shape, step, least, most, 4 * count, {})


def upload(backend: Backend, depth: np.ndarray, step: float, least: float, most: float) -> Resident:
    """A host's map (rows, cols) float32, +inf where masked, which nobody changes, on a device."""
    (rows, cols), nbytes = depth.shape, 0 if backend.shares else depth.nbytes
    there = backend.upload(depth, constant=True)
    return Resident(backend, there, (rows, cols), step, least, most, nbytes, {})
