"""Files in and out: .npy, .npz, grey PNG (8 and 16 bit) and TIFF, by their extension and never by guess.

What is read has exactly the values that the file holds; whatever a reader would have to change (colour, packed bits,
palettes, pickles) is an error that names the fix. What is written is whole or not there.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np

from .errors import InputError, bad

SUFFIXES = (".npy", ".npz", ".png", ".tif", ".tiff")
ROLES = ("depth", "height", "image")
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear red, green, blue: ITU-R BT.709
_RANGE = "skylamp:range"
_PNG_COLOURS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_GREY_FIX = "Convert it to one grey channel first, so that the weights of the colours are your choice."


def read(path, name: str | None = None) -> np.ndarray:
    """The array in a file, its values untouched.

    ``path``: .npy; .npz; grey PNG of 8 or 16 bits (uint8, uint16); TIFF of one grey channel in the type that it has,
    (rows, cols), or (layers, rows, cols) for equal pages. ``name``: which array of an .npz, "depth", "height" or
    "image"; without that name the only array is taken, unless it is named as another of the three.

    Raises InputError, naming the file, what was got and what is allowed: missing, a folder, empty, truncated or damaged
    files, unknown extensions, pickles, colour, and bit depths that a reader would change on the way.
    """
    path = _readable(path)
    with _reading(path):
        if path.suffix.lower() == ".npy":
            with open(path, "rb") as file:
                array = np.lib.format.read_array(file, allow_pickle=False)
        elif path.suffix.lower() == ".npz":
            array = _read_npz(path, name)
        elif path.suffix.lower() == ".png":
            array = _read_png(path, colours=(0,))
        else:
            array = _read_tiff(path)
    if getattr(array, "dtype", np.dtype(object)).kind not in "biuf":
        raise bad(f"{path}: wrong type", getattr(array, "dtype", "no array"), "real numbers (integer or floating)")
    if array.size == 0:
        raise bad(f"{path}: empty array", f"shape {array.shape}", "at least one element")
    return array


def read_environment(path) -> np.ndarray:
    """An environment map (rows, cols) float64 for :func:`skylamp.environment_map`: brightness per pixel.

    Reads what :func:`read` reads, and RGB: an 8-bit RGB PNG or a (rows, cols, 3) .npy or .npz, turned into luminance,
    0.2126 R + 0.7152 G + 0.0722 B (ITU-R BT.709). Counts of integer files are taken as proportional to brightness,
    full scale (255, 65535) as 1; floating values as they are. Errors as in :func:`read`.
    """
    path = _readable(path)
    if path.suffix.lower() == ".png":
        with _reading(path):
            array = _read_png(path, colours=(0, 2))
    else:
        array = read(path)
    if array.ndim != 2 and not (array.ndim == 3 and array.shape[2] == 3):
        raise bad(f"{path}: wrong shape", array.shape, "(rows, cols) or (rows, cols, 3)")
    scale = np.iinfo(array.dtype).max if array.dtype.kind in "iu" else 1
    array = array / np.float64(scale)
    return array @ LUMINANCE if array.ndim == 3 else array


def read_range(path) -> tuple[float, float] | None:
    """The values (low, high) that the counts 0 and full scale of a PNG written by :func:`write` stand for, or None."""
    path = _readable(path)
    if path.suffix.lower() != ".png":
        return None
    import imageio.v3 as imageio

    with _reading(path):
        _png_header(path)
        text = imageio.immeta(path, plugin="pillow").get(_RANGE)
        return None if text is None else _range(tuple(map(float, text.split())), path)


def writable(path) -> Path:
    """``path`` if a file can be put there; InputError for an unknown extension or a parent folder that is missing."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise bad(f"{path}: unknown extension", repr(path.suffix), " ".join(SUFFIXES))
    _parent(path)
    return path


def folder(path) -> Path:
    """``path`` as an existing folder, created with its parents if need be; InputError where a file stands in the way."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise bad(f"{path}: not a folder", "a file of that name, or a file among its parents", "a folder, or a name that is free") from None
    return path


def write(path, array, *, range: tuple[float, float] | None = None, bits: int = 8, name: str = "image", **more) -> tuple[float, float] | None:
    """Write ``array`` to ``path``, whole or not at all; an older file stays until the new one is complete.

    .npy and .tif keep the values and their type (bool becomes 0 and 255 in .tif). .npz holds the array as ``name`` and
    the arrays in ``more``, which other formats do not take. An "image" (rows, cols, 3) is RGB in .tif and in .png, there with
    8 bits. .png holds (rows, cols): uint8, uint16 and bool as they
    are (True is 255), anything else as counts of ``bits`` (8 or 16): rint((value - low) / (high - low) * full scale),
    clipped, NaN as 0, with ``range`` = (low, high), by default (0, the largest finite value); the range is put
    into the file and :func:`read_range` gives it back.

    Returns the range of a scaled PNG, else None. Raises InputError for a missing parent folder, an unknown extension, or
    an array that the format does not hold; OSError if the disk refuses.
    """
    path, array = writable(path), np.asarray(array)
    suffix = path.suffix.lower()
    colour = name == "image" and array.ndim == 3 and array.shape[2] == 3
    if array.dtype.kind not in "biuf" or array.size == 0:
        raise bad(f"{path}: cannot write the array", f"dtype {array.dtype}, shape {array.shape}", "real numbers, at least one")
    if more and suffix != ".npz":
        raise bad(f"{path}: only one array fits", f"{1 + len(more)} arrays", "several arrays in an .npz")
    if suffix == ".npz":
        with replacing(path) as file:
            np.savez_compressed(file, **{name: array}, **more)
        return None
    if suffix == ".npy":
        with replacing(path) as file:
            np.save(file, array, allow_pickle=False)
        return None
    if array.dtype == bool:
        array = array * np.uint8(255)
    if suffix != ".png":
        import tifffile

        with replacing(path) as file:
            tifffile.imwrite(file, array, photometric="rgb" if colour else "minisblack", metadata=None)
        return None
    if array.ndim != 2 and not colour:
        raise bad(f"{path}: a PNG holds one picture", f"shape {array.shape}", "(rows, cols)", "Write .npy, .npz or .tif instead.")
    if colour and (bits != 8 or array.dtype == np.uint16):
        raise bad(f"{path}: a PNG in colour", "16 bits", "8 bits", "Write .npy, .npz or .tif instead.")
    header = None
    if array.dtype not in (np.uint8, np.uint16):
        array, range = _counts(array, range, bits, path)
        from PIL.PngImagePlugin import PngInfo

        header = PngInfo()
        header.add_text(_RANGE, f"{range[0]!r} {range[1]!r}")
    else:
        range = None
    import imageio.v3 as imageio

    with replacing(path) as file:
        imageio.imwrite(file, array, plugin="pillow", extension=".png", pnginfo=header)
    return range


@contextlib.contextmanager
def replacing(path):
    """A binary file that becomes ``path`` when the block ends well, and leaves no trace when it does not."""
    path = _parent(Path(path)).resolve()  # through a symbolic link, not over it
    temporary = path.with_name(f".{secrets.token_hex(8)}.tmp")  # same folder: a rename must not cross file systems
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def terrain() -> tuple[np.ndarray, float]:
    """The Jacksboro fault, Tennessee: (height (344, 403) float32 in whole metres, north up; spacing in metres).

    The grid is 3 arc seconds, so its steps are not equally long; the spacing is their geometric mean.
    ``data/jacksboro.json`` holds both steps and the provenance.
    """
    data = Path(__file__).with_name("data")
    about = json.loads((data / "jacksboro.json").read_text(encoding="utf-8"))
    return read(data / "jacksboro.png").astype(np.float32), about["spacing"]


def _readable(path) -> Path:
    path = Path(path)
    with _reading(path):
        if path.is_dir():
            raise bad(f"{path}: cannot read", "a folder", "a file")
        if not path.exists():
            raise bad(f"{path}: cannot read", "no such file", "an existing file")
        if path.suffix.lower() not in SUFFIXES:
            raise bad(f"{path}: unknown extension", repr(path.suffix), " ".join(SUFFIXES))
        if path.stat().st_size == 0:
            raise bad(f"{path}: cannot read", "an empty file", "a file with data")
    return path


@contextlib.contextmanager
def _reading(path):
    """Whatever a reader throws at a damaged or hostile file, as one InputError that names the file."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # the libraries raise OSError, ValueError, struct.error, zlib.error, SyntaxError, MemoryError ...
        text = " ".join(str(error).split()) or "no reason given"
        raise bad(f"{path}: cannot read", f"{type(error).__name__}: {text}", f"a whole {path.suffix.lower()} file of real numbers") from error


def _read_npz(path, name) -> np.ndarray:
    if not zipfile.is_zipfile(path):
        raise ValueError("not a zip archive, or a truncated one")
    with np.load(path, allow_pickle=False) as arrays:
        found = arrays.files
        chosen = [n for n in found if n in ((name,) if name else ROLES)]
        if not chosen and len(found) == 1 and not (name and found[0] in ROLES):
            chosen = found
        if len(chosen) != 1:
            raise bad(f"{path}: cannot tell which array is the {name or 'data'}", f"arrays {', '.join(found) or 'none'}",
                      f"an array named {name or ' or '.join(ROLES)}, or a single array under a name of its own")
        return arrays[chosen[0]]


def _png_header(path) -> tuple[int, int, int, int]:
    """(width, height, bit depth, colour type), once every chunk up to IEND is there and its checksum holds."""
    with open(path, "rb") as file:
        if file.read(8) != b"\x89PNG\r\n\x1a\n":
            raise ValueError("not a PNG: wrong signature")
        header = None
        while True:
            start = file.read(8)
            if len(start) < 8:
                raise ValueError("truncated: no IEND chunk")
            length, kind = struct.unpack(">I4s", start)
            body, check = file.read(length), file.read(4)
            if len(check) < 4 or zlib.crc32(kind + body) != int.from_bytes(check, "big"):
                raise ValueError(f"truncated or damaged: chunk {kind.decode('latin-1')}")
            if header is None:
                if kind != b"IHDR" or length != 13:
                    raise ValueError("not a PNG: no IHDR chunk first")
                header = struct.unpack(">IIBB", body[:10])
            if kind == b"IEND":
                return header


def _read_png(path, colours) -> np.ndarray:
    width, height, depth, colour = _png_header(path)
    what = f"{depth}-bit {_PNG_COLOURS.get(colour, 'unknown colour type')} PNG"
    allowed = "grey PNG of 8 or 16 bits" + (" or RGB of 8 bits" if 2 in colours else "")
    if colour not in colours:
        raise bad(f"{path}: not grey", what, allowed, _GREY_FIX)
    if depth not in ((8, 16) if colour == 0 else (8,)):
        raise bad(f"{path}: bit depth", what, allowed)
    import imageio.v3 as imageio

    array = imageio.imread(path, plugin="pillow")
    shape = (height, width) if colour == 0 else (height, width, 3)
    if array.dtype.itemsize * 8 != depth or array.shape != shape:  # imageio turns some 16-bit files into 8-bit
        raise bad(f"{path}: the reader changed the data", f"{array.dtype} {array.shape} from a {what} of {shape}", allowed)
    return array


def _read_tiff(path) -> np.ndarray:
    import tifffile  # imageio's own backend; asked directly because imageio hides pages, palettes and missing strips

    with _logged_errors_raise("tifffile"), tifffile.TiffFile(path) as file:
        if len(file.pages) == 0 or len(file.series) != 1:
            raise bad(f"{path}: pages", f"{len(file.pages)} pages of {len(file.series)} kinds", "one picture, or equal pages as layers")
        size = path.stat().st_size
        for page in file.pages:
            page = page.aspage()
            if page.samplesperpixel != 1 or page.photometric != tifffile.PHOTOMETRIC.MINISBLACK:
                raise bad(f"{path}: not grey", f"{page.samplesperpixel} samples, photometric {getattr(page.photometric, 'name', page.photometric)}",
                          "one grey channel, 0 is black (photometric MINISBLACK)", _GREY_FIX)
            if any(n <= 0 or at + n > size for at, n in zip(page.dataoffsets, page.databytecounts)):  # tifffile fills such strips with zeros
                raise ValueError("truncated: a strip or tile is missing or lies beyond the end of the file")
        array = file.asarray()
        if array.dtype.itemsize * 8 != page.bitspersample:
            raise bad(f"{path}: bit depth", f"{page.bitspersample} bits per sample", "8, 16, 32 or 64")
        return array


@contextlib.contextmanager
def _logged_errors_raise(name):
    """tifffile logs some damage, such as a broken chain of pages, and reads on: here that ends the reading."""
    def stop(record):
        if record.levelno >= logging.ERROR:
            raise ValueError(record.getMessage())
        return True

    logger = logging.getLogger(name)
    logger.addFilter(stop)
    try:
        yield
    finally:
        logger.removeFilter(stop)


def _parent(path) -> Path:
    if not path.parent.is_dir():
        raise bad(f"{path}: cannot write", f"no folder {path.parent}", "a file in an existing folder", "Create the folder first.")
    if path.exists() and not path.is_file():
        raise bad(f"{path}: cannot write", "a folder or a device of that name", "a file")
    return path


def _range(range, path) -> tuple[float, float]:
    low, high = map(float, range)
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise bad(f"{path}: range", (low, high), "finite (low, high) with low < high")
    return low, high


def _counts(array, range, bits, path):
    if bits not in (8, 16):
        raise bad(f"{path}: bits of a PNG", bits, "8 or 16")
    array = array.astype(np.float64)
    if range is None:
        top = np.max(array, initial=0.0, where=np.isfinite(array))
        range = (0.0, top if top > 0 else 1.0)
    low, high = _range(range, path)
    full = 2**bits - 1
    scaled = np.nan_to_num((array - low) / (high - low) * full, nan=0.0)
    return np.rint(np.clip(scaled, 0, full)).astype(f"uint{bits}"), (low, high)
