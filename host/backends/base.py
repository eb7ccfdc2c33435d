"""The protocol of a backend: arrays on one device, and launches of kernels by their name.

A backend handles arrays and kernels, not scenes. A kernel has the same stem, name and arguments in
warp_kernels/, in opencl/ and in numpy/. The sequence of kernels for an image is in host/light/.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import os
import threading
import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from .. import deadline
from ..checks import positive_number
from ..constants import MOST_PIXELS, PIXEL_PADDING
from ..errors import CapacityError, OutOfTimeError
from ..locks import give_lock

# how a device takes loops over nodes and iterations: single_item_links, nodes_per_item, iterations_ahead.
# 2^18 links: with 0, recover() of one image of direct light, up to 90 x 90 nodes, takes 1.7 times as long (on
# PoCL, two cores); with 2^30, that of light between surfaces from 48 x 48 nodes on takes 1.35 times as long
CPU_LOOPS, GPU_LOOPS = (2**18, 64, 1), (0, 1, 8)
DEFAULT_GROUP = 256  # work-items of a group of any kernel but scan, at most

# tables that a backend keeps, and the bytes of one at most; chosen: together they stay below 32 MiB, and a
# call has some 30 of them
TABLES, TABLE_BYTES = 512, 2**16

# [byte] of freed arrays that a GPU's memory pool holds for later ones, an eighth of the GPU's memory at most.
# Chosen: without them a call of 4096 x 4096 nodes takes 1 to 5 ms longer on an H100, in which the driver maps
# memory, and one of 256 x 256 nodes a fifth; with half of it Warp's horizons in 8 azimuths take 2 ms longer,
# the lattice 0.7; twice gains nothing.
MOST_HELD = 2**31

Array = Any  # of a device: NumPy's, Warp's or pyopencl's


def available_memory() -> int:
    """Bytes of main memory that could be taken now, where the system gives them; else a cautious 2 GiB.

    No more than the limits of this process leave (ulimit -v, memory of a control group).
    """
    return int(max(0, min(_free_memory(), *_left_by_limits())))


def _left_by_limits() -> Iterator[float]:
    with contextlib.suppress(ImportError, OSError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            with open("/proc/self/statm") as sizes:
                yield limit - int(sizes.read().split()[0]) * resource.getpagesize()
    with (
        contextlib.suppress(OSError, ValueError),  # "max", where there is no limit, is no number
        open("/sys/fs/cgroup/memory.max") as most,
        open("/sys/fs/cgroup/memory.current") as used,
    ):
        yield int(most.read()) - int(used.read())
    yield math.inf


def _free_memory() -> int:
    try:
        with open("/proc/meminfo") as lines:
            return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        if hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
            return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        return 2**31


def rounded_up(pixels: int) -> int:
    """Elements of a pixel array that kernels read in whole vectors."""
    return -(-pixels // PIXEL_PADDING) * PIXEL_PADDING


Result = TypeVar("Result")

# methods of a backend that take its lock
LOCKED = {"upload", "put", "empty", "fill", "download", "launch", "record", "finish"}


def _locked(method: Callable[..., Any]) -> Callable[..., Any]:
    is_launch = method.__name__ == "launch"

    @functools.wraps(method)
    def locked(self: Backend, *args: Any, **more: Any) -> Any:
        with self.lock:
            deadline.check()
            result = method(self, *args, **more)
            if is_launch and deadline.limited():
                self.finish()  # else all are queued at once, and the time passes in the last transfer
            return result

    return locked


@contextlib.contextmanager
def within(seconds: float | None, what: str, engine: Backend) -> Iterator[None]:
    """Within this context, transfers, launches and evaluations of brightness by this thread raise
    OutOfTimeError once ``seconds`` are over, without those of compiling.

    The clock is read before each of them, so a call ends later by its longest one. Launches come one after
    another; the result does not depend on it. None: no limit but that of a call around this one.
    """
    if seconds is None:
        yield
        return
    most, spent, steps = positive_number(seconds, "max_seconds"), stopwatch(engine), itertools.count()

    def check() -> None:
        step = next(steps)
        if spent() > most:
            raise OutOfTimeError(
                f"{what}: max_seconds={most:g} are over after {step} steps on {engine.name}. Give more, a"
                " larger tolerance, or fewer azimuths, directions or nodes."
            )

    with deadline.checked_by(check):
        yield


@dataclass(frozen=True)
class BackendInfo:
    """A backend that was looked for: its name, device, whether it is available, and if not, why not."""

    name: str
    device: str
    available: bool
    why: str = ""
    gpu: bool = False


def has_room(backend: Backend, bytes_needed: int, largest: int) -> bool:
    """Whether the device may give so many bytes, whatever it holds for later arrays.

    ``largest``: bytes of the largest array among them.
    """
    free = backend.memory
    if bytes_needed > free:
        backend.trim()
        free = backend.memory
    return bytes_needed <= free and largest <= backend.most_array_bytes


def reserve(backend: Backend, bytes_needed: int, what: str, fix: str, largest: int | None = None) -> None:
    """Raise a CapacityError if ``bytes_needed`` is more than the device may give.

    ``largest``: bytes of the largest array among them, all of them unless given.
    """
    largest = bytes_needed if largest is None else largest
    if has_room(backend, bytes_needed, largest):
        return
    if largest > backend.most_array_bytes:
        raise CapacityError(
            f"{what} needs {largest:,} bytes in one array; {backend.name} may take"
            f" {backend.most_array_bytes:,}. {fix}"
        )
    raise CapacityError(
        f"{what} needs {bytes_needed:,} bytes; {backend.name} may take {backend.memory:,}. {fix}"
    )


def reserve_map(backend: Backend, nodes: int, bytes_needed: int, largest: int) -> None:
    """:func:`reserve` for a map of so many nodes, margins included, all of which kernels must count."""
    what, fix = f"A map of {nodes:,} nodes", "Cut it into tiles."
    if nodes > MOST_PIXELS:
        raise CapacityError(f"{what}; at most {MOST_PIXELS:,}, since kernels count in 32 bits. {fix}")
    reserve(backend, bytes_needed, what, fix, largest)


class Backend(ABC):
    """One device. Subclasses give ``name``, ``device``, ``lanes``, ``memory`` and the abstract methods.

    ``lock``: every public call holds it from its first array to its last download, so calls from threads come
    one after another: the arguments of kernels, queues, recorded launches and the seconds of compiling belong
    to one call at a time. Code that uses the device outside of such calls, as a scene does whose map lies
    there, waits for them in each of the methods of LOCKED.
    """

    name: str
    device: str
    # gives memory that is held for later arrays back to the device
    trim: Callable[[], None] = staticmethod(lambda: None)
    lanes = 1  # adjacent lines per work-item
    strips = 1  # strips of such lines that a sweep takes side by side
    # links of all nodes of an image, as many as there is room for, up to which one work-item takes all steps
    # of conjugate gradients, since starting kernels would take longer
    single_item_links = 0
    iterations_ahead = 1  # pairs of such steps that are started before the host reads whether to stop
    nodes_per_item = 1  # nodes that a work-item of a loop over all owns
    # work-items that have sums of their own to scatter into, where adding to one that is shared would take
    # longer
    partial_sums = 1
    lines = 1  # adjacent work-items that share cache lines, where work-items of a group run together
    pixel_lanes = 1  # adjacent pixels per work-item where there are no lines; divides PIXEL_PADDING
    most_array_bytes: float = math.inf  # of one array
    compile_seconds = 0.0
    # rows x azimuths over which sweeps may follow the relief of a map that repeats, besides the map itself:
    # chosen: some two minutes where rows are as short as they can be (0.3 us a row, PoCL, two cores)
    most_searched_rows = 2**28

    shares = False  # whether the device's memory is the host's

    lock: threading.RLock  # a call makes others

    def __init__(self) -> None:
        give_lock(self)
        # by the ids of scenes, the one that was used last at the end: the map, and its finalizer; see
        # Scene.on
        self.kept: OrderedDict[int, Any] = OrderedDict()
        self.tables: OrderedDict[tuple[Any, ...], Any] = OrderedDict()  # by type, shape and bytes

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in LOCKED & vars(cls).keys():
            setattr(cls, name, _locked(vars(cls)[name]))

    @property
    @abstractmethod
    def memory(self) -> int:
        """Bytes that may be taken at once, by all arrays together."""

    @abstractmethod
    def upload(self, array: np.ndarray, constant: bool = False) -> Array:
        """A copy of ``array`` on the device; of a ``constant`` none if ``shares``."""

    def table(self, array: np.ndarray) -> Array:
        """``array``, which kernels only read, on the device; equal small ones are uploaded once."""
        if array.nbytes > TABLE_BYTES:
            return self.upload(array)
        key = array.dtype.str, array.shape, array.tobytes()
        with self.lock:
            if key not in self.tables:
                self.tables[key] = self.upload(array)
            self.tables.move_to_end(key)
            if len(self.tables) > TABLES:
                self.tables.popitem(last=False)
            return self.tables[key]

    @abstractmethod
    def put(self, array: Array, values: np.ndarray) -> None:
        """Sets all of a device array."""

    @abstractmethod
    def empty(self, shape: tuple[int, ...], dtype: DTypeLike, fill: float | None = None) -> Array:
        """A new device array; every element ``fill`` if given."""

    @abstractmethod
    def fill(self, array: Array, value: float) -> None:
        """Set every element of a device array."""

    @abstractmethod
    def download(self, array: Array) -> np.ndarray:
        """A copy of a device array in NumPy, after all launches before it are done."""

    @abstractmethod
    def view(self, array: Array, shape: tuple[int, ...]) -> Array:
        """The first elements of a device array in another shape; no copy."""

    @abstractmethod
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
        """Run ``kernel`` of module ``stem`` over ``dim`` work-items; scalars and vectors are passed as the
        kernel declares them.

        ``lanes``: lines or pixels per work-item, the backend's own number of lines unless given. ``group``:
        work-items of a group, where it matters. ``squares``: of the two dimensions of ``dim``, squares of
        SQUARE x SQUARE work-items run together on a GPU. ``constants``: what must be known when the kernel is
        compiled, such as BITS, elevations per walk.
        """

    def record(self, work: Callable[[], None], times: int) -> Callable[[], None]:
        """A function that launches ``times`` times the kernels that ``work`` launches, on the same arrays
        with the same numbers, and faster where starting a kernel takes long. Another kernel of each of their
        modules must have run before.
        """

        def again() -> None:
            for _ in range(times):
                work()

        return again

    def overlapped(self) -> contextlib.AbstractContextManager[None]:
        """A context in which launches may overlap those that come after it, until ``join``."""
        return contextlib.nullcontext()

    def join(self) -> None:  # noqa: B027  nothing to do where launches never overlap
        """Launches from here on come after those that were made ``overlapped``."""

    @abstractmethod
    def finish(self) -> None:
        """Wait until all launches are done."""


def stopwatch(engine: Backend) -> Callable[[], float]:
    """Seconds from here on, without those of compiling."""
    start, compiled = time.perf_counter(), engine.compile_seconds
    return lambda: time.perf_counter() - start - (engine.compile_seconds - compiled)


def timed(engine: Backend, work: Callable[[], Result]) -> tuple[Result, float, float]:
    """(result, seconds without compiling, seconds of compiling) of ``work``, once the engine is free."""
    with engine.lock:
        compiled, seconds = engine.compile_seconds, stopwatch(engine)
        result = work()
        return result, seconds(), engine.compile_seconds - compiled
