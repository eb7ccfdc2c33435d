"""OpenCL through pyopencl: any device; on a CPU (PoCL) the kernels carry several lanes per work-item."""

from __future__ import annotations

import contextlib
import functools
import mmap
import time
import weakref

import numpy as np

from ..constants import GPU_LINES, GPU_PIXELS
from ..errors import BackendError
from .base import CPU_ALONE, CPU_EACH, GPU_AHEAD, Backend, BackendInfo

OPTIONS = ("-cl-std=CL1.2",)
HUGE = 2**21  # bytes of a huge page
CPU_LANES = 8
CPU_STRIPS = 8  # strips of lines that a sweep takes side by side
CPU_TEAMS = 16  # most sets of sums that are scattered into side by side
GPU_GROUP = 1024  # work-items of a group of scan
FETCHED = 6  # depths that a scan on a GPU fetches before it uses them; a CPU sees ahead by itself


def probe():
    """A BackendInfo for every OpenCL device, or one that says why there is none."""
    try:
        import pyopencl as cl

        platforms = cl.get_platforms()
    except ImportError as error:
        return [BackendInfo("opencl", "", False, f"pyopencl cannot be imported ({error})")]
    except cl.Error as error:
        return [
            BackendInfo(
                "opencl",
                "",
                False,
                f"no OpenCL platform ({error}); pocl-binary-distribution brings one for the CPU",
            )
        ]
    found = []
    for p, platform in enumerate(platforms):
        for d, device in enumerate(platform.get_devices()):
            name = f"opencl:{p}:{d}"
            described = (
                f"{device.name.strip()} ({platform.version.strip()}, {device.max_compute_units} compute"
                " units)"
            )
            gpu = bool(device.type & cl.device_type.GPU)
            if device.double_fp_config:
                found.append(BackendInfo(name, described, True, gpu=gpu))
            else:
                found.append(
                    BackendInfo(
                        name,
                        described,
                        False,
                        "the device has no double precision, which windows and lamps need",
                        gpu,
                    )
                )
    return sorted(found, key=lambda info: not info.gpu) or [
        BackendInfo("opencl", "", False, "the OpenCL platforms have no device")
    ]


class OpenclBackend(Backend):
    """One OpenCL device with one queue. Device arrays are pyopencl arrays."""

    def __init__(self, platform: int, device: int):
        import pyopencl as cl
        import pyopencl.array

        super().__init__()
        self.cl = cl
        self.name = f"opencl:{platform}:{device}"
        self._device = cl.get_platforms()[platform].get_devices()[device]
        self.device = self._device.name.strip()
        self.context = cl.Context([self._device])
        self.queue, self._side, self._pending = (
            cl.CommandQueue(self.context),
            cl.CommandQueue(self.context),
            None,
        )
        exact = self._device.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
        self._exact = (
            ("-cl-fp32-correctly-rounded-divide-sqrt",) if exact else ()
        )  # where a GPU would else take 2.5 ulp
        self.on_cpu = bool(self._device.type & cl.device_type.CPU)
        self.lanes = CPU_LANES if self.on_cpu else 1
        self.teams = min(CPU_TEAMS, 2 * self._device.max_compute_units) if self.on_cpu else 1
        self.alone, self.each, self.ahead = (CPU_ALONE, CPU_EACH, 1) if self.on_cpu else (0, 1, GPU_AHEAD)
        self.strips = CPU_STRIPS if self.on_cpu else 1
        self.lines = 1 if self.on_cpu else GPU_LINES
        self.pixel_lanes = CPU_LANES if self.on_cpu else GPU_PIXELS
        self.memory = int(self._device.max_mem_alloc_size)
        self._kernels, self._recorded = {}, None

    def upload(self, array):
        device = self._array(array.shape, array.dtype)
        device.set(np.ascontiguousarray(array))
        return device

    def put(self, array, values):
        array.set(np.ascontiguousarray(values))

    def empty(self, shape, dtype, fill=None):
        array = self._array(shape, dtype)
        if fill is not None:
            array.fill(np.dtype(dtype).type(fill))
        return array

    def _array(self, shape, dtype):
        data = self._on_huge_pages(shape, dtype)
        array = self.cl.array.Array(self.queue, shape, dtype, data=data)
        if (
            data is not None
        ):  # its memory is ours, not the device's: kernels that were started must be done with it first
            weakref.finalize(array, self.queue.finish).atexit = False
        return array

    def _on_huge_pages(self, shape, dtype):
        """A buffer in main memory for a large array on a CPU, or None: kernels that step from row to row
        touch a page a row.
        """
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if not self.on_cpu or size < 2 * HUGE or not hasattr(mmap, "MADV_HUGEPAGE"):
            return None
        room = mmap.mmap(-1, size + HUGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        memory = np.frombuffer(room, np.uint8)
        start = -memory.ctypes.data % HUGE
        room.madvise(
            mmap.MADV_HUGEPAGE, start, size // HUGE * HUGE
        )  # not the rest, which would take a whole one
        flags = self.cl.mem_flags
        return self.cl.Buffer(
            self.context, flags.READ_WRITE | flags.USE_HOST_PTR, hostbuf=memory[start : start + size]
        )

    def fill(self, array, value):
        array.fill(array.dtype.type(value))

    def download(self, array):
        return array.get()

    def view(self, array, shape):
        return array  # a kernel is given a pointer

    @contextlib.contextmanager
    def beside(self):
        if self.on_cpu:
            yield
            return
        main, before = self.queue, self.cl.enqueue_marker(self.queue)
        self.queue = self._side
        self.cl.enqueue_barrier(self.queue, wait_for=[before])
        try:
            yield
        finally:
            self._pending = self.cl.enqueue_marker(self.queue)
            self.queue.flush()
            self.queue = main

    def join(self):
        if self._pending is not None:
            self.cl.enqueue_barrier(self.queue, wait_for=[self._pending])
            self._pending = None

    def finish(self):
        self.queue.finish()

    def launch(self, stem, kernel, dim, *args, lanes=None, group=None, **constants):
        function, kinds, usual = self._kernel(
            stem, kernel, lanes or self.lanes, tuple(sorted(constants.items()))
        )
        values = [
            arg.data if hasattr(arg, "data") and not np.isscalar(arg) else kind(arg)
            for arg, kind in zip(args, kinds, strict=True)
        ]
        local = (group or usual,) + (1,) * (len(dim) - 1)
        size = tuple(-(-n // l) * l for n, l in zip(dim, local))
        if self._recorded is not None:
            function = self.cl.Kernel(function.program, kernel)
            function.set_args(*values)
            self._recorded.append((function, size, local))
        else:
            function(self.queue, size, local, *values)

    def record(self, work, times):
        self._recorded = recorded = []
        try:
            work()
        finally:
            self._recorded = None

        def again():
            for _ in range(times):
                for function, size, local in recorded:
                    self.cl.enqueue_nd_range_kernel(self.queue, function, size, local)

        return again

    def _kernel(self, stem, kernel, lanes, constants):
        key = stem, kernel, lanes, constants
        if key not in self._kernels:
            function = self.cl.Kernel(self._program(stem, lanes, constants), kernel)
            info = self.cl.kernel_work_group_info
            demanded = function.get_work_group_info(info.COMPILE_WORK_GROUP_SIZE, self._device)[0]
            most = min(256, function.get_work_group_info(info.WORK_GROUP_SIZE, self._device))
            self._kernels[key] = (
                function,
                _scalar_kinds(stem, kernel),
                demanded or (1 if self.on_cpu else most),
            )
        return self._kernels[key]

    @functools.cache
    def _program(self, stem, lanes, constants):
        from skylamp.opencl import defines, source

        start = time.perf_counter()
        group = 1 if self.on_cpu else min(GPU_GROUP, self._device.max_work_group_size)
        known = {
            "LANES": lanes,
            "BITS": 0,
            "AHEAD": 1 if self.on_cpu else FETCHED,
            "GROUP": group,
            "STRIPS": self.strips,
            "LINES": self.lines,
            "ON_CPU": int(self.on_cpu),
            **dict(constants),
        }
        shared, own = defines(stem), [f"-D{name}={value}" for name, value in known.items()]
        try:
            program = self.cl.Program(self.context, source(stem)).build(
                [*OPTIONS, *self._exact, *shared, *own]
            )
        except self.cl.Error as error:
            raise BackendError(f"{self.name}: {stem}.cl does not build on {self.device}: {error}") from error
        self.compile_seconds += time.perf_counter() - start
        return program


@functools.cache
def _scalar_kinds(stem, kernel):
    """The NumPy type of every scalar argument (None for buffers), read off the kernel's own signature."""
    import re

    from skylamp.opencl import source

    signature = re.search(rf"__kernel void {kernel}\((.*?)\)", source(stem), re.S).group(1)
    kinds = {
        "int": np.int32,
        "float": np.float32,
        "double": np.float64,
        "Ladder": lambda values: np.array(values, np.int32),
    }
    return [
        None if "*" in argument else kinds[argument.replace("const", "").split()[0]]
        for argument in signature.split(",")
    ]
