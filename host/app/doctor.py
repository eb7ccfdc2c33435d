"""examined(): facts about this machine for a bug report, as plain values."""

from __future__ import annotations

import contextlib
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

from ..backends import backends
from ..backends.base import available_memory

PACKAGES = ("skylamp", "numpy", "warp-lang", "pyopencl", "pocl-binary-distribution", "imageio", "tifffile")
OPTIONAL = tuple(
    "matplotlib rasterio OpenEXR opencv-python-headless pvlib dask distributed xarray zarr filelock rioxarray"
    " nicegui".split()
)
PREFIXES = ("SKYLAMP_", "POCL_", "WARP_", "PYOPENCL_", "OCL_", "CUDA_", "XDG_CACHE_HOME", "PYTHONWARNINGS")


def examined() -> dict[str, Any]:
    """Versions, devices with their drivers, caches and memory [byte]."""
    return {
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "optional": {name: _version(name) for name in OPTIONAL},
        "machine": {"system": platform.platform(), "cores": os.cpu_count(), "free": available_memory()},
        "backends": [vars(info) for info in backends()],
        "caches": {name: _cache(path) for name, path in _caches().items()},
        "environment": {name: value for name, value in os.environ.items() if name.startswith(PREFIXES)},
    }


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _caches() -> dict[str, Path]:
    """Where compiled kernels are kept."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folders = {"pocl": Path(os.environ.get("POCL_CACHE_DIR") or home / "pocl")}
    with contextlib.suppress(ImportError):
        import warp

        folders["warp"] = Path(warp.config.kernel_cache_dir or home / "warp")
    return folders


def _cache(path: Path) -> dict[str, Any]:
    """Its path, whether it is there, and whether it or the folder to make it in can be written."""
    there = next((folder for folder in (path, *path.parents) if folder.exists()), path)
    writable = there.is_dir() and os.access(there, os.W_OK)
    return {"path": str(path), "exists": path.is_dir(), "writable": writable}
