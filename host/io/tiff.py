"""TIFF without a georeference: one grey channel, or equal pages as layers."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import bad
from .paths import replacing, reserve
from .png import GREY_FIX


def read(path: Path) -> np.ndarray:
    """(rows, cols), or (layers, rows, cols) for equal pages, in the type of the file."""
    # imageio's own backend; asked directly because imageio hides pages, palettes and missing strips
    import tifffile

    with _logged_errors_raise("tifffile"), tifffile.TiffFile(path) as file:
        if len(file.pages) == 0 or len(file.series) != 1:
            got = f"{len(file.pages)} pages of {len(file.series)} kinds"
            raise bad(f"{path}: pages", got, "one picture, or equal pages as layers")
        size = path.stat().st_size
        for page in (page.aspage() for page in file.pages):
            if page.samplesperpixel != 1 or page.photometric != tifffile.PHOTOMETRIC.MINISBLACK:
                photometric = getattr(page.photometric, "name", page.photometric)
                got = f"{page.samplesperpixel} samples, photometric {photometric}"
                allowed = "one grey channel, 0 is black (photometric MINISBLACK)"
                raise bad(f"{path}: not grey", got, allowed, GREY_FIX)
            # tifffile fills such strips with zeros
            if any(n <= 0 or at + n > size for at, n in zip(page.dataoffsets, page.databytecounts)):
                raise ValueError("truncated: a strip or tile is missing or lies beyond the end of the file")
            if page.dtype is None or page.dtype.itemsize * 8 != page.bitspersample:
                raise bad(f"{path}: bit depth", f"{page.bitspersample} bits per sample", "8, 16, 32 or 64")
            if page.compression == tifffile.COMPRESSION.NONE:
                reserve(path, page.nbytes, sum(page.databytecounts))
        reserve(path, len(file.pages) * file.pages[0].aspage().nbytes)
        return file.asarray()


def write(path: Path, array: np.ndarray, rgb: bool) -> None:
    """Write ``array`` in its own type; (rows, cols, 3) as red, green, blue if ``rgb``."""
    import tifffile

    if array.ndim not in (2, 3) or array.dtype.itemsize > 8:
        got = f"shape {array.shape}, dtype {array.dtype}"
        allowed = "(rows, cols) or (layers, rows, cols), of 8 to 64 bits"
        raise bad(f"{path}: cannot write the array", got, allowed, "Write .npy or .npz instead.")
    with replacing(path) as file:
        tifffile.imwrite(file, array, photometric="rgb" if rgb else "minisblack", metadata=None)


@contextlib.contextmanager
def _logged_errors_raise(name: str) -> Iterator[None]:
    """tifffile logs some damage, such as a broken chain of pages, and reads on: here that is an error."""

    def stop(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            raise ValueError(record.getMessage())
        return True

    logger = logging.getLogger(name)
    logger.addFilter(stop)
    try:
        yield
    finally:
        logger.removeFilter(stop)
