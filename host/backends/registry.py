"""Which backends are here, and the rule of choice: a named backend or an error; only "auto" falls back."""

from __future__ import annotations

import difflib
import functools
import os
import threading
from dataclasses import replace

from ..errors import BackendError
from .base import Backend, BackendInfo

HOST = "numpy", "warp:cpu"  # backends without a driver, which work in a forked process too
FORKED = (
    "its driver was started before this process was forked, and does not answer here; start processes by"
    ' "spawn" or "forkserver" (multiprocessing.set_start_method), or before the first use of skylamp'
)
_preferred = ""  # what "auto" takes in this process, see prefer()
_forked = False  # whether this process was forked from one in which devices had been looked for
_lock = threading.RLock()  # devices are looked for, and a backend is made, by one thread


def backends() -> list[BackendInfo]:
    """Every backend that was looked for, in the order in which "auto" would take them.

    Returns
    -------
    list of BackendInfo
        With name, device, available and, where it is not, the reason ``why``.

    Examples
    --------
    >>> [info.name for info in sl.backends() if info.available][-1]
    'numpy'
    """
    with _lock:
        infos = _probe()
    if _forked:
        infos = tuple(
            replace(info, available=False, why=info.why or FORKED) if info.name not in HOST else info
            for info in infos
        )
    kinds = ["opencl", "warp", "numpy"]
    order = lambda info: (not info.available, not info.gpu, kinds.index(info.name.split(":")[0]))
    return sorted(infos, key=order)


def select(name: str = "auto") -> Backend:
    """The backend of this name, made once per process.

    ``auto``: a GPU if there is one, else OpenCL on the CPU, else Warp, else NumPy. ``opencl``: the first
    device, GPU before CPU. Raises BackendError, with the reason and the nearest name that is here, if a named
    one is not.
    """
    if not isinstance(name, str):
        raise BackendError(f"backend: got {name!r}; allowed: a name, one of {', '.join(_names())}, auto.")
    infos = {info.name: info for info in backends()}
    if name == "auto":
        name = _preferred or next(info.name for info in infos.values() if info.available)
    if name == "opencl":
        name = next((name for name in infos if name.startswith("opencl")), name)  # one that is here, if any
    info = infos.get(name)
    if info is None or not info.available:
        why = info.why if info else "there is no such backend"
        here = _names()
        nearest = difflib.get_close_matches(name, here, 1, 0.0)[0]
        raise BackendError(
            f"backend {name!r} is not available: {why}. Nearest that is: {nearest!r} (here:"
            f" {', '.join(here)}, auto)."
        )
    with _lock:
        return _make(name)


def prefer(name: str) -> None:
    """``auto`` takes this backend in this process from now on; "" for the usual choice.

    For workers that share a machine's devices. Raises BackendError.
    """
    global _preferred
    _preferred = select(name).name if name else ""


def _after_fork() -> None:
    """In the child: the drivers' threads are the parent's, and so may be the holder of the lock."""
    global _forked, _lock
    _forked, _lock = _forked or _probe.cache_info().currsize > 0, threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _names() -> list[str]:
    return [info.name for info in backends() if info.available]


@functools.cache
def _probe() -> tuple[BackendInfo, ...]:
    from . import opencl, warp

    return (BackendInfo("numpy", "NumPy, 1 thread", True), *warp.probe(), *opencl.probe())


@functools.cache
def _make(name: str) -> Backend:
    kind, _, device = name.partition(":")
    if kind == "numpy":
        from .numpy import NumpyBackend

        return NumpyBackend()
    if kind == "warp":
        from .warp import WarpBackend

        return WarpBackend(device)
    from .opencl import OpenclBackend

    return OpenclBackend(*map(int, device.split(":")))
