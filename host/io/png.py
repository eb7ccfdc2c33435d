"""PNG, grey or RGB: every chunk is checked before reading; floats are scaled to counts for writing."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import bad
from .paths import replacing, reserve

GREY_FIX = "Convert it to one grey channel first, so that the weights of the colours are your choice."
MOST_DEFLATED = 1032  # bytes that a byte of a deflated stream can stand for: 258 of two bits
_RANGE = "skylamp:range"  # key of the text chunk that holds the range
_COLOURS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}


def header(path: Path) -> tuple[int, int, int, int, int]:
    """(width, height, bit depth, colour type, bytes of compressed data).

    ValueError unless all chunks and their checksums are right.
    """
    with open(path, "rb") as file:
        if file.read(8) != b"\x89PNG\r\n\x1a\n":
            raise ValueError("not a PNG: wrong signature")
        fields: tuple[int, int, int, int] | None = None
        data = 0
        while True:
            start = file.read(8)
            if len(start) < 8:
                raise ValueError("truncated: no IEND chunk")
            length, kind = struct.unpack(">I4s", start)
            body, check = file.read(length), file.read(4)
            if len(check) < 4 or zlib.crc32(kind + body) != int.from_bytes(check, "big"):
                raise ValueError(f"truncated or damaged: chunk {kind.decode('latin-1')}")
            if fields is None:
                if kind != b"IHDR" or length != 13:
                    raise ValueError("not a PNG: no IHDR chunk first")
                width, height, depth, colour = struct.unpack(">IIBB", body[:10])
                fields = width, height, depth, colour
            data += length * (kind == b"IDAT")
            if kind == b"IEND":
                return *fields, data


def read(path: Path, colours: tuple[int, ...]) -> np.ndarray:
    """(rows, cols) or (rows, cols, 3), uint8 or uint16, of a PNG of one of these colour types (0 or 2)."""
    width, height, depth, colour, data = header(path)
    what = f"{depth}-bit {_COLOURS.get(colour, 'unknown colour type')} PNG"
    allowed = "grey PNG of 8 or 16 bits" + (" or RGB of 8 bits" if 2 in colours else "")
    if colour not in colours:
        raise bad(f"{path}: not grey", what, allowed, GREY_FIX)
    if depth not in ((8, 16) if colour == 0 else (8,)):
        raise bad(f"{path}: bit depth", what, allowed)
    channels = 3 if colour == 2 else 1
    reserve(path, width * height * channels * depth // 8, MOST_DEFLATED * data)
    import imageio.v3 as imageio

    array: np.ndarray = imageio.imread(path, plugin="pillow")
    shape = (height, width) if colour == 0 else (height, width, 3)
    # imageio turns some 16-bit files into 8-bit
    if array.dtype.itemsize * 8 != depth or array.shape != shape:
        raise bad(
            f"{path}: the reader changed the data",
            f"{array.dtype} {array.shape} from a {what} of {shape}",
            allowed,
        )
    return array


def read_range(path: Path) -> tuple[float, float] | None:
    """The values of count 0 and of full scale, if :func:`write` put them into the file."""
    import imageio.v3 as imageio

    header(path)
    text = imageio.immeta(path, plugin="pillow").get(_RANGE)
    return None if text is None else _checked_range(tuple(map(float, text.split())), path)


def write(
    path: Path, array: np.ndarray, range: tuple[float, float] | None, bits: int | None, rgb: bool
) -> tuple[float, float] | None:
    """Write (rows, cols), or (rows, cols, 3) if ``rgb``; integers of 8 and 16 bits as they are, else counts.

    Returns the range of the counts, or None. InputError for a ``range`` or ``bits`` that the integers do not
    have already.
    """
    import imageio.v3 as imageio
    from PIL.PngImagePlugin import PngInfo

    if bits is not None and not (isinstance(bits, (int, np.integer)) and bits in (8, 16)):
        raise bad(f"{path}: bits of a PNG", repr(bits), "8 or 16")
    if array.ndim != 2 and not rgb:
        raise bad(
            f"{path}: a PNG holds one picture",
            f"shape {array.shape}",
            "(rows, cols)",
            "Write .npy, .npz or .tif instead.",
        )
    if rgb and (bits == 16 or array.dtype == np.uint16):
        raise bad(f"{path}: a PNG in colour", "16 bits", "8 bits", "Write .npy, .npz or .tif instead.")
    info, scale = None, None
    if array.dtype in (np.uint8, np.uint16):
        own = 8 * array.dtype.itemsize
        if range is not None or bits not in (None, own):
            got = f"{array.dtype} with range {range!r} and bits {bits!r}"
            allowed = f"no range, and {own} bits"
            raise bad(f"{path}: counts are kept", got, allowed, "Pass floating values to scale them.")
    else:
        array, scale = _counts(array, range, bits or 8, path)
        info = PngInfo()
        info.add_text(_RANGE, f"{scale[0]!r} {scale[1]!r}")
    with replacing(path) as file:
        imageio.imwrite(file, array, plugin="pillow", extension=".png", pnginfo=info)
    return scale


def _checked_range(range: Any, path: Path) -> tuple[float, float]:
    try:
        low, high = (np.nan, np.nan) if isinstance(range, (str, bytes)) else map(float, range)
    except (TypeError, ValueError, OverflowError):
        low = high = np.nan
    if not (low < high and np.isfinite(high - low)):
        raise bad(f"{path}: range", repr(range), "finite (low, high) with low < high")
    return low, high


def _counts(
    array: np.ndarray, range: tuple[float, float] | None, bits: int, path: Path
) -> tuple[np.ndarray, tuple[float, float]]:
    """(counts of ``bits``, the range that they cover)."""
    array = array.astype(np.float64)
    if range is None:
        top = np.max(array, initial=0.0, where=np.isfinite(array))
        range = (0.0, top if top > 0 else 1.0)
    low, high = _checked_range(range, path)
    full = 2**bits - 1
    with np.errstate(over="ignore"):  # it is clipped
        scaled = np.nan_to_num((array - low) / (high - low) * full, nan=0.0)
    return np.rint(np.clip(scaled, 0, full)).astype(f"uint{bits}"), (low, high)
