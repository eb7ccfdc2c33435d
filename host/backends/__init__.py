"""Where the arithmetic runs: NumPy, Warp and OpenCL behind one set of kernels with one set of arguments."""

from .base import BackendInfo
from .registry import backends, prefer, select

__all__ = ["BackendInfo", "backends", "prefer", "select"]
