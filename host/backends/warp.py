"""NVIDIA Warp: warp:cuda:N, and warp:cpu, which runs a launch on one thread and one lane."""

from __future__ import annotations

import contextlib
import importlib
import threading
import time

import numpy as np

from skylamp.warp_kernels import GROUP

from ..constants import GPU_LINES, GPU_PIXELS
from .base import CPU_ALONE, CPU_EACH, GPU_AHEAD, Backend, BackendInfo, available_memory


def probe():
    """A BackendInfo for Warp's CPU device and for every CUDA device."""
    try:
        import warp as wp

        level, wp.config.log_level = wp.config.log_level, wp.LOG_WARNING  # no banner for having looked
        try:
            wp.init()
        finally:
            wp.config.log_level = level
        here = wp.is_cpu_available()
        found = [
            BackendInfo(
                "warp:cpu",
                "Warp on the CPU, 1 thread",
                here,
                "" if here else "this Warp comes without its CPU compiler",
            )
        ]
        found += [BackendInfo(f"warp:{d.alias}", d.name, True, gpu=True) for d in wp.get_cuda_devices()]
    except (ImportError, OSError, RuntimeError) as error:
        return [BackendInfo("warp:cpu", "", False, f"warp-lang cannot be started ({error})")]
    if len(found) == 1:
        found.append(BackendInfo("warp:cuda:0", "", False, "Warp finds no CUDA device or driver", gpu=True))
    return found


class WarpBackend(Backend):
    """One Warp device. Device arrays are Warp arrays."""

    # one for all devices: modules and settings are the process's, and a scene's map may lie on another device
    lock = threading.RLock()

    def __init__(self, alias: str):
        import warp as wp

        self.wp = wp
        self.name = f"warp:{alias}"
        self._device = wp.get_device(alias)
        self.device = self._device.name if self._device.is_cuda else "Warp on the CPU, 1 thread"
        self.lines = GPU_LINES if self._device.is_cuda else 1
        self.pixel_lanes = GPU_PIXELS
        self.alone, self.each, self.ahead = (
            (0, 1, GPU_AHEAD) if self._device.is_cuda else (CPU_ALONE, CPU_EACH, 1)
        )
        self._loaded, self._side = set(), None

    @property
    def memory(self) -> int:
        return self._device.free_memory * 9 // 10 if self._device.is_cuda else available_memory() // 2

    def upload(self, array):
        return self.wp.array(np.ascontiguousarray(array), device=self._device)

    def put(self, array, values):
        array.assign(np.ascontiguousarray(values))

    def empty(self, shape, dtype, fill=None):
        array = self.wp.empty(shape, dtype=self.wp.dtype_from_numpy(dtype), device=self._device)
        if fill is not None:
            array.fill_(np.dtype(dtype).type(fill))
        return array

    def fill(self, array, value):
        array.fill_(value)

    def download(self, array):
        return np.array(array.numpy())

    def view(self, array, shape):
        return self.wp.array(ptr=array.ptr, dtype=array.dtype, shape=shape, device=array.device)

    @contextlib.contextmanager
    def beside(self):
        if not self._device.is_cuda:
            yield
            return
        self._side = self._side or self.wp.Stream(self._device)
        self._side.wait_stream(self._device.stream)
        with self.wp.ScopedStream(self._side, sync_enter=False):
            yield

    def join(self):
        if self._side:
            self._device.stream.wait_stream(self._side)

    def finish(self):
        self.wp.synchronize_device(self._device)

    def record(self, work, times):
        again = super().record(work, times)
        if not self._device.is_cuda:
            return again
        with self.wp.ScopedCapture(self._device, force_module_load=False) as capture:
            again()
        return lambda: self.wp.capture_launch(capture.graph)

    def launch(self, stem, kernel, dim, *args, lanes=None, group=None, **constants):
        function = getattr(importlib.import_module(f"skylamp.warp_kernels.{stem}"), kernel)
        if not isinstance(function, self.wp.Kernel):
            function = function(**constants)
        group = group or (GROUP if kernel == "scan" else 256)
        if (function.module, group) not in self._loaded:  # Warp compiles for every size of block
            start = time.perf_counter()
            level, self.wp.config.log_level = (
                self.wp.config.log_level,
                self.wp.LOG_WARNING,
            )  # Warp would tell stdout
            try:
                self.wp.load_module(function.module, device=self._device, block_dim=group)
            finally:
                self.wp.config.log_level = level
            self.compile_seconds += time.perf_counter() - start
            self._loaded.add((function.module, group))
        values = [self._as(arg, formal.type) for arg, formal in zip(args, function.adj.args, strict=True)]
        # Warp's last index runs fastest, OpenCL's first
        self.wp.launch(
            function, dim=tuple(reversed(dim)), inputs=values, device=self._device, block_dim=group
        )

    def _as(self, value, kind):
        """A device array seen with the axes and elements that the kernel declares: trailing axes run
        together, in vectors.
        """
        if not isinstance(value, self.wp.array):
            return kind(*value) if hasattr(kind, "_wp_scalar_type_") else value  # a vector by value
        if value.dtype == kind.dtype and value.ndim == kind.ndim:
            return value
        size = lambda dtype: self.wp.types.type_size_in_bytes(dtype)
        lead = value.shape[: kind.ndim - 1]
        shape = (*lead, value.size * size(value.dtype) // size(kind.dtype) // int(np.prod(lead)))
        return self.wp.array(ptr=value.ptr, dtype=kind.dtype, shape=shape, device=value.device)
