"""The protocol of a backend, and the sequences of kernels that are the same on all of them.

A backend knows arrays and kernels, not scenes. A kernel has the same stem, name and arguments in
warp_kernels/, in opencl/ and in numpy.py; what is here launches them by name.
"""

from __future__ import annotations

import contextlib
import functools
import math
import mmap
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..constants import ROOM
from ..errors import CapacityError

CPU_ALONE, CPU_EACH, GPU_AHEAD = 8192, 64, 8  # Backend.alone, each and ahead of compiled backends


def scratch(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros, float32, that go back to the system when they are dropped: malloc would keep some 30 MB of what
    is freed.
    """
    count = math.prod(shape)
    if hasattr(mmap, "MADV_HUGEPAGE"):  # to touch every small page first would take longer than to fill them
        room = mmap.mmap(-1, max(4, 4 * count), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        room.madvise(mmap.MADV_HUGEPAGE)
    else:
        room = mmap.mmap(-1, max(4, 4 * count))
    return np.frombuffer(room, np.float32, count).reshape(shape)


def available_memory() -> int:
    """Bytes of main memory that could be taken now, where the system tells; else a cautious 2 GiB."""
    try:
        with open("/proc/meminfo") as lines:
            return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return (
            os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
            if hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names
            else 2**31
        )


def rounded_up(pixels: int) -> int:
    """Elements of a pixel array that kernels read in whole vectors."""
    return -(-pixels // ROOM) * ROOM


ALONE = {
    "upload",
    "put",
    "empty",
    "fill",
    "download",
    "launch",
    "record",
    "finish",
}  # methods of a backend that take its lock


def _alone(method: Callable) -> Callable:
    @functools.wraps(method)
    def alone(self, *args, **more):
        with self.lock:
            return method(self, *args, **more)

    return alone


@dataclass(frozen=True)
class BackendInfo:
    """A backend that was looked for: its name, device, whether it is available, and if not, why not."""

    name: str
    device: str
    available: bool
    why: str = ""
    gpu: bool = False


class Backend(ABC):
    """One device. Subclasses give ``name``, ``device``, ``lanes``, ``memory`` and the abstract methods.

    ``lock``: every public call holds it from its first array to its last download, so calls from threads come
    one after another: the arguments of kernels, queues, what is recorded and the seconds of compiling belong
    to one call at a time. What uses the device outside of such calls, as a scene does whose map lies there,
    waits for them in each of the methods of ALONE.
    """

    name: str
    device: str
    memory: int  # bytes that may be taken at once
    lanes = 1  # adjacent lines per work-item
    strips = 1  # strips of such lines that a sweep takes side by side
    # nodes up to which one work-item takes all steps of conjugate gradients, since starting kernels would
    # take longer
    alone = 0
    ahead = 1  # pairs of such steps that are started before one looks whether to stop
    each = 1  # nodes that a work-item of a loop over all owns
    # work-items that have sums of their own to scatter into, where adding to one that is shared would take
    # longer
    teams = 1
    lines = 1  # adjacent work-items that share cache lines, where work-items of a group run together
    pixel_lanes = 1  # adjacent pixels per work-item where there are no lines; divides ROOM
    compile_seconds = 0.0

    def __init__(self):
        self.lock = threading.RLock()  # a call makes others

    def __init_subclass__(cls):
        for name in ALONE & vars(cls).keys():
            setattr(cls, name, _alone(vars(cls)[name]))

    @abstractmethod
    def upload(self, array: np.ndarray):
        """A copy of ``array`` on the device."""

    @abstractmethod
    def put(self, array, values: np.ndarray) -> None:
        """Sets all of a device array."""

    @abstractmethod
    def empty(self, shape: tuple[int, ...], dtype, fill: int | float | None = None):
        """A new device array; every element ``fill`` if given."""

    @abstractmethod
    def fill(self, array, value) -> None:
        """Set every element of a device array."""

    @abstractmethod
    def download(self, array) -> np.ndarray:
        """A copy of a device array in NumPy, after all launches before it are done."""

    @abstractmethod
    def view(self, array, shape: tuple[int, ...]):
        """The first elements of a device array, seen in another shape; no copy."""

    @abstractmethod
    def launch(
        self,
        stem: str,
        kernel: str,
        dim: tuple[int, ...],
        *args,
        lanes: int | None = None,
        group: int | None = None,
        **constants: int,
    ) -> None:
        """Run ``kernel`` of module ``stem`` over ``dim`` work-items; scalars and vectors are passed as the
        kernel declares them.

        ``lanes``: lines or pixels per work-item, the backend's own number of lines unless given. ``group``:
        work-items of a group, where it matters. ``constants``: what must be known when the kernel is
        compiled, such as BITS, elevations per walk.
        """

    def record(self, work: Callable[[], None], times: int) -> Callable[[], None]:
        """What launches ``times`` times the kernels that ``work`` launches, on the same arrays with the same
        numbers, and faster where starting a kernel takes long. Another kernel of each of their modules must
        have run before.
        """

        def again():
            for _ in range(times):
                work()

        return again

    def beside(self):
        """A context in which launches may run beside those that come after it, until ``join``."""
        return contextlib.nullcontext()

    def join(self) -> None:
        """Launches from here on come after those that were made ``beside``."""

    @abstractmethod
    def finish(self) -> None:
        """Wait until all launches are done."""

    def reserve(self, bytes_needed: int, what: str, fix: str) -> None:
        """Raise a CapacityError if ``bytes_needed`` is more than the device may give."""
        if bytes_needed > self.memory:
            raise CapacityError(
                f"{what} needs {bytes_needed:,} bytes; {self.name} may take {self.memory:,}. {fix}"
            )
