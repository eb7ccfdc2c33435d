"""NVIDIA Warp: warp:cuda:N, and warp:cpu, which runs a launch on one thread and one lane."""

from __future__ import annotations

import contextlib
import functools
import importlib
import math
import os
import tempfile
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from skylamp.warp_kernels import GROUP

from ..constants import GPU_LINES, GPU_PIXELS, SQUARE
from ..locks import give_lock
from . import staging
from .base import (
    CPU_LOOPS,
    DEFAULT_GROUP,
    GPU_LOOPS,
    MOST_HELD,
    Array,
    Backend,
    BackendInfo,
    available_memory,
)

# Warp's warning where there is no GPU; `skylamp backends` says so, and nobody else needs to know
NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def probe() -> list[BackendInfo]:
    """A BackendInfo for Warp's CPU device and for every CUDA device."""
    try:
        wp: Any = importlib.import_module("warp")
        with _quiet(wp), _without(NO_DRIVER):  # no banner for having looked
            wp.init()
        here = wp.is_cpu_available()
        why = "" if here else "this Warp comes without its CPU compiler"
        infos = [BackendInfo("warp:cpu", "Warp on the CPU, 1 thread", here, why)]
        infos += [BackendInfo(f"warp:{d.alias}", d.name, True, gpu=True) for d in wp.get_cuda_devices()]
    except (ImportError, OSError, RuntimeError) as error:
        fix = "; WARP_CACHE_PATH may name a folder that can be written" * isinstance(error, PermissionError)
        return [BackendInfo("warp:cpu", "", False, f"warp-lang cannot be started ({error}){fix}")]
    if len(infos) == 1:
        infos.append(BackendInfo("warp:cuda:0", "", False, "Warp finds no CUDA device or driver", gpu=True))
    return infos


@contextlib.contextmanager
def _quiet(wp: Any) -> Iterator[None]:
    """Warp prints nothing but warnings meanwhile."""
    level, wp.config.log_level = wp.config.log_level, wp.LOG_WARNING
    try:
        yield
    finally:
        wp.config.log_level = level


@contextlib.contextmanager
def _without(text: bytes) -> Iterator[None]:
    """Lines with this text do not reach stderr, to which native code writes; others do, at the end."""
    try:
        file, stderr = tempfile.TemporaryFile(), os.dup(2)
    except OSError:  # no folder can be written, or stderr is closed
        yield
        return
    with file:
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            file.seek(0)
            for line in file:
                if text not in line:
                    os.write(2, line)


def _trim(backend: WarpBackend, held: int) -> None:
    """Empty the pool of a GPU, which then holds up to ``held`` bytes again."""
    wp, device = backend.wp, backend._device
    with backend.lock:  # no other thread may be recording launches
        wp.set_mempool_release_threshold(device, 0)
        wp.synchronize_device(device)
        wp.set_mempool_release_threshold(device, held)


class WarpBackend(Backend):
    """One Warp device. Device arrays are Warp arrays."""

    def __init__(self, alias: str) -> None:
        self.wp: Any = importlib.import_module("warp")
        self.kept, self.tables = OrderedDict(), OrderedDict()
        self.name = f"warp:{alias}"
        self._device = self.wp.get_device(alias)
        cuda = self._device.is_cuda
        self.device = self._device.name if cuda else "Warp on the CPU, 1 thread"
        self.lines = GPU_LINES if cuda else 1
        self.pixel_lanes = GPU_PIXELS
        self.shares = not cuda
        self.single_item_links, self.nodes_per_item, self.iterations_ahead = GPU_LOOPS if cuda else CPU_LOOPS
        if cuda and self.wp.is_mempool_enabled(self._device):
            usual = self.wp.get_mempool_release_threshold(self._device)
            held = max(usual, min(MOST_HELD, self._device.total_memory // 8))
            self.wp.set_mempool_release_threshold(self._device, held)
            self.trim = functools.partial(_trim, self, held)
        self._loaded: set[tuple[Any, int]] = set()  # modules, each with a size of block
        self._side: Any = None  # the stream of launches beside others

    @property
    def memory(self) -> int:
        if self._device.is_cuda:
            return int(self._device.free_memory) * 9 // 10
        return available_memory() // 2

    def upload(self, array: np.ndarray, constant: bool = False) -> Array:
        array = np.ascontiguousarray(array)
        if constant and self.shares:
            kind = self.wp.dtype_from_numpy(array.dtype)
            uploaded = self.wp.array(ptr=array.ctypes.data, dtype=kind, shape=array.shape, device="cpu")
            uploaded.memory = array  # held as long
            return uploaded
        if self.shares or array.nbytes < staging.LEAST:
            return self.wp.array(array, device=self._device)
        uploaded = self.empty(array.shape, array.dtype)
        self.transfers.upload(array, uploaded)
        return uploaded

    def put(self, array: Array, values: np.ndarray) -> None:
        array.assign(np.ascontiguousarray(values))

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike, fill: float | None = None) -> Array:
        array = self.wp.empty(shape, dtype=self.wp.dtype_from_numpy(dtype), device=self._device)
        if fill is not None:
            scalar: Any = np.dtype(dtype).type
            array.fill_(scalar(fill))
        return array

    def fill(self, array: Array, value: float) -> None:
        array.fill_(value)

    def download(self, array: Array) -> np.ndarray:
        kind = np.dtype(self.wp.dtype_to_numpy(array.dtype))
        if self.shares or array.size * kind.itemsize < staging.LEAST:
            return array.numpy() if self._device.is_cuda else np.array(array.numpy())  # a copy in either case
        return self.transfers.download(array, array.shape, kind)

    @functools.cached_property
    def transfers(self) -> staging.Staging:
        """Transfers follow the launches before them."""
        wp = self.wp
        held = [wp.empty(staging.ROOM, wp.uint8, device="cpu", pinned=True) for _ in range(staging.ROOMS)]
        rooms = {room.ptr: room for room in held}

        def copy(array: Any, start: int, part: np.ndarray, fetch: bool) -> Callable[[], None]:
            there = wp.array(ptr=array.ptr + start, dtype=wp.uint8, shape=part.size, device=array.device)
            here = rooms[part.ctypes.data]
            wp.copy(*((here, there) if fetch else (there, here)), count=part.size)
            event = self._device.stream.record_event()
            return lambda: wp.synchronize_event(event)

        return staging.Staging([room.numpy() for room in held], copy)

    def view(self, array: Array, shape: tuple[int, ...]) -> Array:
        return array.flatten()[: math.prod(shape)].reshape(shape)  # which keeps the array alive

    @contextlib.contextmanager
    def overlapped(self) -> Iterator[None]:
        if not self._device.is_cuda:
            yield
            return
        self._side = self._side or self.wp.Stream(self._device)
        self._side.wait_stream(self._device.stream)
        with self.wp.ScopedStream(self._side, sync_enter=False):
            yield

    def join(self) -> None:
        if self._side:
            self._device.stream.wait_stream(self._side)

    def finish(self) -> None:
        self.wp.synchronize_device(self._device)

    def record(self, work: Callable[[], None], times: int) -> Callable[[], None]:
        again = super().record(work, times)
        if not self._device.is_cuda:
            return again
        with self.wp.ScopedCapture(self._device, force_module_load=False) as capture:
            again()
        graph = capture.graph
        return lambda: self.wp.capture_launch(graph)

    def launch(
        self,
        stem: str,
        kernel: str,
        dim: tuple[int, ...],
        *args: Any,
        lanes: int | None = None,
        group: int | None = None,
        squares: bool = False,
        **constants: int,
    ) -> None:
        function = getattr(importlib.import_module(f"skylamp.warp_kernels.{stem}"), kernel)
        if not isinstance(function, self.wp.Kernel):
            function = function(**constants)
        group = group or (GROUP if kernel == "scan" else DEFAULT_GROUP)
        if squares:  # a square is a block of threads, and a run of the last dimension
            group = SQUARE * SQUARE
            dim = -(-dim[0] // SQUARE) * group, -(-dim[1] // SQUARE)
        if (function.module, group) not in self._loaded:  # Warp compiles for every size of block
            start = time.perf_counter()
            with _quiet(self.wp):
                self.wp.load_module(function.module, device=self._device, block_dim=group)
            self.compile_seconds += time.perf_counter() - start
            self._loaded.add((function.module, group))
        values = [self._as(arg, formal.type) for arg, formal in zip(args, function.adj.args, strict=True)]
        # Warp's last index runs fastest, OpenCL's first
        self.wp.launch(
            function, dim=tuple(reversed(dim)), inputs=values, device=self._device, block_dim=group
        )

    def _as(self, value: Any, kind: Any) -> Any:
        """A device array with the axes and elements that the kernel declares: trailing axes run
        together, in vectors.
        """
        if not isinstance(value, self.wp.array):
            return kind(*value) if hasattr(kind, "_wp_scalar_type_") else value  # a vector by value
        if value.dtype == kind.dtype and value.ndim == kind.ndim:
            return value
        size = self.wp.types.type_size_in_bytes
        lead = value.shape[: kind.ndim - 1]
        shape = (*lead, value.size * size(value.dtype) // size(kind.dtype) // int(np.prod(lead)))
        return self.wp.array(ptr=value.ptr, dtype=kind.dtype, shape=shape, device=value.device)


# one for all devices: modules and settings are the process's, and a scene's map may lie on another device
give_lock(WarpBackend)
