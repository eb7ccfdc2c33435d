"""OpenCL through pyopencl: any device; on a CPU (PoCL) the kernels carry several lanes per work-item."""

from __future__ import annotations

import contextlib
import functools
import math
import mmap
import re
import time
import warnings
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

import skylamp.opencl

from ..constants import GPU_LINES, GPU_PIXELS, SQUARE
from ..errors import BackendError
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

OPTIONS = "-cl-std=CL1.2", "-w"  # without remarks on the kernels, which clang counts on stderr
HUGE_PAGE = 2**21  # [byte], of Linux on x86-64 and, with pages of 4 KiB, on ARM
# attempts to build a program: PoCL fails now and then where several processes build the same one into an
# empty cache; of 112 processes, eight at a time, 5 failed with one attempt and none with three
BUILDS = 3
MOST_OF_ERROR = 200  # characters of a compiler's error that are shown; the rest are its options
# registers a work-item on NVIDIA, of stems that wait for memory: with 64 more run at once. Measured on an
# H200, 4096 x 4096 nodes: sweeps of 64 azimuths took 23.5 ms with 64 and 27 with 96 (of 16: 13.3 and 12.3),
# about 31 with 48; slices of a sphere 31.4 ms with 64, 31.5 with 48, 32 with 80 or 96
REGISTERS = {"horizon": 64, "slices": 64}
MOST_POOLED = MOST_HELD // 8  # [byte] of the largest array that a pool may hold; chosen: 8192 x 8192 floats
CPU_LANES = 8  # float32 of a vector register of 256 bits
CPU_STRIPS = 8  # strips of lines that a sweep takes side by side
CPU_PARTIAL_SUMS = 16  # most copies of a sum that work-items scatter into
MOST_FILLED = 2**31  # [byte] from which NVIDIA's driver fills wrongly (pyopencl, issue 395)
SCAN_GROUP = 1024  # work-items of a group of scan on a GPU
NOT_EXACT = "the device has no double precision, which windows and lamps need"
UNKNOWN_PROCESSOR = (
    "this PoCL is older than the processor and builds no kernel for it; install a newer one from the system's"
    " packages (apt install pocl-opencl-icd)"
)
PREFETCHED_DEPTHS = 6  # depths that a scan on a GPU fetches before it uses them; a CPU does so by itself


def probe() -> list[BackendInfo]:
    """A BackendInfo for every OpenCL device, or one with the reason why there is none."""
    try:
        import pyopencl as cl
    except ImportError as error:
        return [BackendInfo("opencl", "", False, f"pyopencl cannot be imported ({error})")]
    try:
        failure = cl.Error
    except AttributeError:  # a folder that an uninstalled pyopencl left behind
        return [BackendInfo("opencl", "", False, "pyopencl is not installed")]
    try:
        platforms = cl.get_platforms()
    except failure as error:
        why = f"no OpenCL platform ({error}); pocl-binary-distribution brings one for the CPU"
        return [BackendInfo("opencl", "", False, why)]
    infos = []
    for p, platform in enumerate(platforms):
        for d, device in enumerate(platform.get_devices()):
            units = f"{device.max_compute_units} compute units"
            described = f"{device.name.strip()} ({platform.version.strip()}, {units})"
            why = "" if device.double_fp_config else NOT_EXACT
            if knows_no_processor(device.version):
                why = UNKNOWN_PROCESSOR
            gpu = bool(device.type & cl.device_type.GPU)
            infos.append(BackendInfo(f"opencl:{p}:{d}", described, not why, why, gpu))
    why = "no OpenCL platform has a device; PoCL has none if it cannot write to POCL_CACHE_DIR or ~/.cache"
    return sorted(infos, key=lambda info: not info.gpu) or [BackendInfo("opencl", "", False, why)]


def knows_no_processor(version: str) -> bool:
    """Whether a device of this CL_DEVICE_VERSION is a PoCL whose LLVM is older than the processor.

    It takes the processor for a "generic" one then, a name that clang refuses on x86: no kernel builds.
    """
    return "PoCL" in version and "x86_64" in version and version.strip().endswith("-generic")


class OpenclBackend(Backend):
    """One OpenCL device with one queue. Device arrays are pyopencl arrays."""

    def __init__(self, platform: int, device: int) -> None:
        import pyopencl as cl
        import pyopencl.array
        import pyopencl.tools

        super().__init__()
        self.cl = cl
        self.name = f"opencl:{platform}:{device}"
        self._device = cl.get_platforms()[platform].get_devices()[device]
        self.device = self._device.name.strip()
        self.context = cl.Context([self._device])
        self.queue, self._side = cl.CommandQueue(self.context), cl.CommandQueue(self.context)
        self._pending: Any = None  # the last launch on the side queue, until join
        # what such launches use: memory of a pool must not be another array's before the join
        self._used_aside: list[Any] = []
        exact = self._device.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
        # where a GPU would else take 2.5 ulp
        self._exact = ("-cl-fp32-correctly-rounded-divide-sqrt",) if exact else ()
        self.on_cpu = bool(self._device.type & cl.device_type.CPU)
        self.shares = self.on_cpu
        self.lanes, self.pixel_lanes, self.strips, self.lines = (
            (CPU_LANES, CPU_LANES, CPU_STRIPS, 1) if self.on_cpu else (1, GPU_PIXELS, 1, GPU_LINES)
        )
        self.most_array_bytes = self._device.max_mem_alloc_size
        self.partial_sums = min(CPU_PARTIAL_SUMS, 2 * self._device.max_compute_units) if self.on_cpu else 1
        self.single_item_links, self.nodes_per_item, self.iterations_ahead = (
            CPU_LOOPS if self.on_cpu else GPU_LOOPS
        )
        self._pool: Any = None
        if not self.on_cpu:
            self._pool = pyopencl.tools.MemoryPool(pyopencl.tools.ImmediateAllocator(self.queue))
            self._most_held = min(MOST_HELD, self._device.global_mem_size // 8)
            self.trim = self._pool.free_held
        self._programs: dict[tuple[Any, ...], Any] = {}
        self._kernels: dict[tuple[Any, ...], Any] = {}
        self._recorded: list[tuple[Any, ...]] | None = None

    @property
    def memory(self) -> int:
        """On a GPU, whose free memory OpenCL does not tell, the bytes of its largest array."""
        return available_memory() // 2 if self.shares else int(self._device.max_mem_alloc_size)

    def upload(self, array: np.ndarray, constant: bool = False) -> Array:
        array = np.ascontiguousarray(array)
        if constant and self.shares:
            flags = self.cl.mem_flags.READ_ONLY | self.cl.mem_flags.USE_HOST_PTR
            data = self.cl.Buffer(self.context, flags, hostbuf=array)
            shared = self.cl.array.Array(self.queue, array.shape, array.dtype, data=data)
            _finish_before_release(self, shared)
            return shared
        device = _new(self, array.shape, array.dtype)
        if self.shares or array.nbytes < staging.LEAST:
            device.set(array)
        else:
            self.transfers.upload(array, device)
        return device

    def put(self, array: Array, values: np.ndarray) -> None:
        array.set(np.ascontiguousarray(values))

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike, fill: float | None = None) -> Array:
        array = _new(self, shape, dtype)
        if fill is not None:
            self.fill(array, fill)
        return array

    def fill(self, array: Array, value: float) -> None:
        scalar = array.dtype.type(value)
        if array.nbytes >= MOST_FILLED:
            array.fill(scalar)
        elif array.nbytes:  # pyopencl's own fill would compile a kernel, with the compiler's remarks
            self.cl.enqueue_fill_buffer(self.queue, array.data, scalar, 0, array.nbytes)

    def download(self, array: Array) -> np.ndarray:
        if self.shares or array.nbytes < staging.LEAST:
            values: np.ndarray = array.get()
            return values
        return self.transfers.download(array, array.shape, array.dtype)

    @functools.cached_property
    def transfers(self) -> staging.Staging:
        """Transfers follow the launches before them; drivers of GPUs hold mapped buffers in place."""
        cl, access = self.cl, self.cl.map_flags.READ | self.cl.map_flags.WRITE
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        self._held = [cl.Buffer(self.context, flags, staging.ROOM) for _ in range(staging.ROOMS)]
        rooms = [
            cl.enqueue_map_buffer(self.queue, buffer, access, 0, staging.ROOM, np.uint8)[0]
            for buffer in self._held
        ]

        def copy(array: Any, start: int, part: np.ndarray, fetch: bool) -> Callable[[], None]:
            ends = (part, array.data) if fetch else (array.data, part)
            offset = {"src_offset" if fetch else "dst_offset": start}
            wait: Callable[[], None] = cl.enqueue_copy(self.queue, *ends, is_blocking=False, **offset).wait
            return wait

        return staging.Staging(rooms, copy)

    def view(self, array: Array, shape: tuple[int, ...]) -> Array:
        return array  # a kernel is given a pointer

    @contextlib.contextmanager
    def overlapped(self) -> Iterator[None]:
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

    def join(self) -> None:
        if self._pending is not None:
            self.cl.enqueue_barrier(self.queue, wait_for=[self._pending])
            self._pending = None
            self._used_aside.clear()

    def finish(self) -> None:
        self.queue.finish()

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
        known = tuple(sorted(constants.items()))
        function, kinds, usual = self._kernel(stem, kernel, lanes or self.lanes, known)
        values = [arg.data if kind is None else kind(arg) for arg, kind in zip(args, kinds, strict=True)]
        local = (group or usual,) + (1,) * (len(dim) - 1)
        if squares and not self.on_cpu:
            local = SQUARE, SQUARE
        size = tuple(-(-whole // part) * part for whole, part in zip(dim, local))
        if self._recorded is not None:
            function = self.cl.Kernel(function.program, kernel)
            function.set_args(*values)
            self._recorded.append((function, size, local))
        else:
            function(self.queue, size, local, *values)
        if self.queue is self._side:
            self._used_aside += args

    def record(self, work: Callable[[], None], times: int) -> Callable[[], None]:
        recorded: list[tuple[Any, ...]] = []
        self._recorded = recorded
        try:
            work()
        finally:
            self._recorded = None

        def again() -> None:
            for _ in range(times):
                for function, size, local in recorded:
                    self.cl.enqueue_nd_range_kernel(self.queue, function, size, local)

        return again

    def _kernel(self, stem: str, kernel: str, lanes: int, constants: tuple[tuple[str, int], ...]) -> Any:
        """(kernel, types of its scalar arguments, work-items of a group), compiled once."""
        key = stem, kernel, lanes, constants
        if key not in self._kernels:
            if (stem, lanes, constants) not in self._programs:
                self._programs[stem, lanes, constants] = _program(self, stem, lanes, constants)
            function = self.cl.Kernel(self._programs[stem, lanes, constants], kernel)
            info = self.cl.kernel_work_group_info
            demanded = function.get_work_group_info(info.COMPILE_WORK_GROUP_SIZE, self._device)[0]
            most = min(DEFAULT_GROUP, function.get_work_group_info(info.WORK_GROUP_SIZE, self._device))
            usual = demanded or (1 if self.on_cpu else most)
            kinds = _scalar_kinds(stem, kernel)
            # else pyopencl finds out each time, which takes 90 of 115 microseconds of a sweep's launch
            function.set_arg_types([kind if isinstance(kind, type) else None for kind in kinds])
            self._kernels[key] = function, kinds, usual
        return self._kernels[key]


def _program(backend: OpenclBackend, stem: str, lanes: int, constants: tuple[tuple[str, int], ...]) -> Any:
    start = time.perf_counter()
    group = 1 if backend.on_cpu else min(SCAN_GROUP, backend._device.max_work_group_size)
    known = {
        "LANES": lanes,
        "BITS": 0,
        "AHEAD": 1 if backend.on_cpu else PREFETCHED_DEPTHS,
        "GROUP": group,
        "STRIPS": backend.strips,
        "LINES": backend.lines,
        "ON_CPU": int(backend.on_cpu),
        **dict(constants),
    }
    defines = [*skylamp.opencl.defines(stem), *(f"-D{name}={value}" for name, value in known.items())]
    if stem in REGISTERS and "cl_nv_compiler_options" in backend._device.extensions:
        defines.insert(0, f"-cl-nv-maxrregcount={REGISTERS[stem]}")
    for attempt in range(BUILDS):
        try:
            program = backend.cl.Program(backend.context, skylamp.opencl.source(stem))
            with warnings.catch_warnings():
                # a compiler's remarks on kernels are not the caller's, who may have made warnings errors
                warnings.simplefilter("ignore", backend.cl.CompilerWarning)
                program.build([*OPTIONS, *backend._exact, *defines])
            break
        except backend.cl.Error as error:
            if attempt == BUILDS - 1:
                cause = str(error).strip().splitlines()[0][:MOST_OF_ERROR]
                raise BackendError(
                    f"{backend.name}: {stem}.cl does not build on {backend.device}: {cause}. Perhaps the"
                    " compiler's cache cannot be written to: see skylamp doctor. backend='numpy' needs no"
                    " compiler."
                ) from error
    backend.compile_seconds += time.perf_counter() - start
    return program


def _new(backend: OpenclBackend, shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    size = math.prod(shape) * np.dtype(dtype).itemsize
    large = backend.on_cpu and size >= 2 * HUGE_PAGE and hasattr(mmap, "MADV_HUGEPAGE")
    data = _on_huge_pages(backend.context, size) if large else None
    pool = backend._pool
    if pool is not None and pool.managed_bytes - pool.active_bytes > backend._most_held:
        pool.free_held()
    array = backend.cl.array.Array(
        backend.queue, shape, dtype, data=data, allocator=pool if size <= MOST_POOLED else None
    )
    if large:
        _finish_before_release(backend, array)
    return array


def _finish_before_release(backend: OpenclBackend, array: Array) -> None:
    """Kernels that were started must be done with memory of the host's before it is freed."""
    weakref.finalize(array, backend.queue.finish).atexit = False


def _on_huge_pages(context: Any, size: int) -> Any:
    """A buffer in main memory for a large array: kernels that step from row to row touch a page a row."""
    import pyopencl as cl

    room = mmap.mmap(-1, size + HUGE_PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory = np.frombuffer(room, np.uint8)
    start = -memory.ctypes.data % HUGE_PAGE
    # not the rest, which would take a whole page
    room.madvise(mmap.MADV_HUGEPAGE, start, size // HUGE_PAGE * HUGE_PAGE)
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    return cl.Buffer(context, flags, hostbuf=memory[start : start + size])


@functools.cache
def _scalar_kinds(stem: str, kernel: str) -> list[Callable[[Any], Any] | None]:
    """The NumPy type of every scalar argument (None for buffers), read off the kernel's own signature."""
    signature = re.search(rf"__kernel void {kernel}\((.*?)\)", skylamp.opencl.source(stem), re.S)
    if signature is None:
        raise BackendError(f"{stem}.cl has no kernel {kernel}")
    kinds: dict[str, Callable[[Any], Any]] = {
        "int": np.int32,
        "float": np.float32,
        "double": np.float64,
        "Ladder": lambda values: np.array(values, np.int32),
    }
    return [
        None if "*" in argument else kinds[argument.replace("const", "").split()[0]]
        for argument in signature.group(1).split(",")
    ]
