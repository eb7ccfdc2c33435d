"""Transfers between ordinary memory and a GPU through memory that the driver holds in place (pinned).

A GPU reads and writes pinned memory at the speed of its bus, and ordinary memory at a fraction of it. Pieces
of an array go through a few pinned rooms: threads copy one piece while another is on the bus.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np

from ..arrays import by_bands, scratch, threads

# [byte], and how many: 32 MiB, which is taken from the whole machine. Measured on an H200 with 16 cores,
# 64 MiB to and from the device: 3.7 and 3.4 ms with 4 rooms, 2.8 and 2.5 with 8, 4.3 and 4.3 with 3; 3.5 with
# 4 rooms of twice the size, 3.6 with 8 of half
ROOM, ROOMS = 2**22, 8
LEAST = 2 * ROOM  # arrays from this size on are sent in pieces


def fetch(backend: Any, array: Any, parts: Sequence[np.ndarray]) -> None:
    """Copy a device array to contiguous arrays of its type, which take its elements in turn."""
    if not backend.shares and sum(part.nbytes for part in parts) >= LEAST:
        backend.transfers.fetch(array, parts)
        return
    values, first = backend.download(array).reshape(-1), 0
    for part in parts:
        part.reshape(-1)[:] = values[first : first + part.size]
        first += part.size


class Staging:
    """``rooms``: pinned arrays (ROOM,) uint8; ``copy`` starts a transfer and returns a function that waits
    for it.

    It is given an array on the device, an offset in it [byte], the first part of a room, and whether the room
    is written.
    """

    def __init__(
        self, rooms: Sequence[np.ndarray], copy: Callable[[Any, int, np.ndarray, bool], Callable[[], None]]
    ):
        self.rooms, self.copy = rooms, copy

    def upload(self, values: np.ndarray, array: Any) -> None:
        """Copy contiguous ``values`` to a device array of as many bytes."""
        given, pool = values.reshape(-1).view(np.uint8), threads()
        starts = range(0, given.size, ROOM)

        def filled(n: int) -> np.ndarray:
            part = given[starts[n] : starts[n] + ROOM]
            room = self.rooms[n % ROOMS][: part.size]
            np.copyto(room, part)
            return room

        copies = [pool.submit(filled, n) for n in range(min(ROOMS, len(starts)))]
        for n, start in enumerate(starts):
            self.copy(array, start, copies[n].result(), False)()  # the other rooms are filled meanwhile
            if n + ROOMS < len(starts):
                copies.append(pool.submit(filled, n + ROOMS))

    def download(self, array: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray:
        """A device array in new memory of the host, whose pages are made while the device computes."""
        count = int(np.prod(shape)) * dtype.itemsize
        whole = scratch((-(-count // 4),))
        by_bands(lambda band: whole[band][:: mmap.PAGESIZE // 4].fill(0), whole.shape)
        raw = whole.view(np.uint8)[:count]
        self.fetch(array, [raw])
        return raw.view(dtype).reshape(shape)

    def fetch(self, array: Any, parts: Sequence[np.ndarray]) -> None:
        """Copy a device array to contiguous arrays of the host, which take its elements in turn."""
        pool, copies, first = threads(), list[Future[None]](), 0
        for part in (part.reshape(-1).view(np.uint8) for part in parts):
            for start in range(0, part.size, ROOM):
                if len(copies) >= ROOMS:
                    copies[-ROOMS].result()
                piece = part[start : start + ROOM]
                room = self.rooms[len(copies) % ROOMS][: piece.size]
                self.copy(array, first + start, room, True)()
                copies.append(pool.submit(np.copyto, piece, room))
            first += part.size
        for copy in copies[-ROOMS:]:
            copy.result()
