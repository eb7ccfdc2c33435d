"""Where the arithmetic runs: NumPy, Warp and OpenCL behind one set of kernels with one set of arguments."""

from .base import BackendInfo
from .registry import backends, select

__all__ = ["BackendInfo", "backends", "select"]
