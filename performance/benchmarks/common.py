"""The map, the methods, and the backends that are measured at each size."""

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

import skylamp as sl

SIZES = 256, 1024  # rows and columns of the map
BACKENDS = "numpy", "warp:cpu", "opencl", "warp:cuda:0"  # "opencl": the first device, a GPU before a CPU
METHODS = "horizon", "lattice", "lamp", "tolerance"
SLOW = {("numpy", 1024)}  # a call takes 7 to 92 s on two cores that are shared: left out


@functools.cache
def rough_ground(size: int) -> NDArray[np.float32]:
    """Depth (size, size) float32 [spacing]: noise whose amplitude falls as 1 / f^1.5, rms slope 1."""
    frequency = np.hypot(*np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = np.inf
    noise = np.fft.rfft2(np.random.default_rng(1).standard_normal((size, size)))
    depth = np.fft.irfft2(noise / frequency**1.5, (size, size))
    depth /= np.sqrt((np.hypot(*np.gradient(depth)) ** 2).mean())
    return np.asarray(depth - depth.min(), np.float32)


def work(method: str, size: int) -> tuple[sl.Sky | sl.Lamp, dict[str, Any]]:
    """The source and the arguments of :func:`skylamp.render`."""
    options: dict[str, dict[str, Any]] = {
        "horizon": {"method": "horizon", "azimuths": 64},
        "lattice": {"method": "lattice", "hemicube": 9},
        "lamp": {"method": "horizon"},
        "tolerance": {"tolerance": 0.01},
    }
    sphere = sl.Lamp(center=(size / 2, size / 2, -size / 8), radius=size / 16)
    return sphere if method == "lamp" else sl.Sky(), options[method]


@functools.cache
def available() -> frozenset[str]:
    """Names of the backends that are here."""
    names = {info.name for info in sl.backends() if info.available}
    return frozenset(names | {name.partition(":")[0] for name in names})


def skip_missing(backend: str, size: int) -> None:
    """asv leaves a benchmark out whose setup raises NotImplementedError."""
    if backend not in available():
        raise NotImplementedError(f"{backend} is not available")
    if (backend, size) in SLOW:
        raise NotImplementedError(f"{backend} is too slow for {size} x {size} nodes")
