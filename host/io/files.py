"""Files in and out: .npy, .npz, PNG (8 and 16 bit), TIFF, OpenEXR and Radiance HDR, by their extension and
never by guess.

GeoTIFF with its georeference is read and written by :mod:`skylamp.geo`.

What is read has exactly the values that the file holds; whatever a reader would have to change (colour,
packed bits, palettes, pickles) is an error that names the fix. What is written is whole or not there.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import secrets
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np

from ..errors import InputError, bad, lacking

SUFFIXES = (".npy", ".npz", ".png", ".tif", ".tiff")
HDR = (".exr", ".hdr")  # with the extra of that name
MOST_PIXELS = 2**30  # a header that asks for more is damaged or hostile
ROLES = ("depth", "height", "image")
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear red, green, blue: ITU-R BT.709
_RANGE = "skylamp:range"
_PNG_COLOURS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_GREY_FIX = "Convert it to one grey channel first, so that the weights of the colours are your choice."


def read(path, name: str | None = None) -> np.ndarray:
    """The array in a file, its values untouched.

    ``path``: .npy; .npz; grey PNG of 8 or 16 bits (uint8, uint16); TIFF of one grey channel in the type that
    it has, (rows, cols), or (layers, rows, cols) for equal pages; OpenEXR of one channel (float16, float32 or
    uint32). ``name``: which array of an .npz, "depth", "height" or "image"; without that name the only array
    is taken, unless it is named as another of the three.

    Raises InputError, naming the file, what was got and what is allowed: missing, a folder, empty, truncated
    or damaged files, unknown extensions, pickles, colour, and bit depths that a reader would change on the
    way.
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
        elif path.suffix.lower() in HDR:
            array = _read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
            if array.ndim == 3:
                raise bad(f"{path}: not grey", "red, green and blue", "one channel", _GREY_FIX)
        else:
            array = _read_tiff(path)
    if getattr(array, "dtype", np.dtype(object)).kind not in "biuf":
        raise bad(
            f"{path}: wrong type", getattr(array, "dtype", "no array"), "real numbers (integer or floating)"
        )
    if array.size == 0:
        raise bad(f"{path}: empty array", f"shape {array.shape}", "at least one element")
    return array


def read_environment(path) -> np.ndarray:
    """An environment map (rows, cols) float64 for :func:`skylamp.environment_map`: brightness per pixel.

    Reads what :func:`read` reads, and RGB: OpenEXR, Radiance HDR (divided by its EXPOSURE), an 8-bit RGB PNG
    or a (rows, cols, 3) .npy or .npz, turned into luminance, 0.2126 R + 0.7152 G + 0.0722 B (ITU-R BT.709).
    Counts of integer files are taken as proportional to brightness, full scale (255, 65535) as 1; floating
    values as they are. Errors as in :func:`read`.
    """
    path = _readable(path)
    if path.suffix.lower() == ".png":
        with _reading(path):
            array = _read_png(path, colours=(0, 2))
    elif path.suffix.lower() in HDR:
        with _reading(path):
            array = _read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
    else:
        array = read(path)
    if array.ndim != 2 and not (array.ndim == 3 and array.shape[2] == 3):
        raise bad(f"{path}: wrong shape", array.shape, "(rows, cols) or (rows, cols, 3)")
    scale = np.iinfo(array.dtype).max if array.dtype.kind in "iu" else 1
    array = array / np.float64(scale)
    return array @ LUMINANCE if array.ndim == 3 else array


def read_range(path) -> tuple[float, float] | None:
    """The values (low, high) that the counts 0 and full scale of a PNG written by :func:`write` stand for, or
    None.
    """
    path = _readable(path)
    if path.suffix.lower() != ".png":
        return None
    import imageio.v3 as imageio

    with _reading(path):
        _png_header(path)
        text = imageio.immeta(path, plugin="pillow").get(_RANGE)
        return None if text is None else _range(tuple(map(float, text.split())), path)


def writable(path) -> Path:
    """``path`` if a file can be put there; InputError for an unknown extension or a parent folder that is
    missing.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES + HDR:
        raise bad(f"{path}: unknown extension", repr(path.suffix), " ".join(SUFFIXES + HDR))
    if path.suffix.lower() in HDR:
        _module(path)
    _parent(path)
    return path


def folder(path) -> Path:
    """``path`` as an existing folder, created with its parents if need be; InputError where a file stands in
    the way.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise bad(
            f"{path}: not a folder",
            "a file of that name, or a file among its parents",
            "a folder, or a name that is free",
        ) from None
    return path


def write(
    path, array, *, range: tuple[float, float] | None = None, bits: int = 8, name: str = "image", **more
) -> tuple[float, float] | None:
    """Write ``array`` to ``path``, whole or not at all; an older file stays until the new one is complete.

    .npy and .tif keep the values and their type (bool becomes 0 and 255 in .tif). .exr keeps float16, float32
    and uint32, as channel Y, or R, G and B for (rows, cols, 3). .hdr holds (rows, cols) or (rows, cols, 3) of
    floats >= 0 with 8 bits of mantissa, so it is off by up to 1 in 256 of a pixel's largest channel. .npz
    holds the array as ``name`` and the arrays in ``more``, which other formats do not take. An "image" (rows,
    cols, 3) is RGB in .tif and in .png, there with 8 bits. .png holds (rows, cols): uint8, uint16 and bool as
    they are (True is 255), anything else as counts of ``bits`` (8 or 16): rint((value - low) / (high - low) *
    full scale), clipped, NaN as 0, with ``range`` = (low, high), by default (0, the largest finite value);
    the range is put into the file and :func:`read_range` gives it back.

    Returns the range of a scaled PNG, else None. Raises InputError for a missing parent folder, an unknown
    extension, or an array that the format does not hold; OSError if the disk refuses.
    """
    path, array = writable(path), np.asarray(array)
    suffix = path.suffix.lower()
    colour = name == "image" and array.ndim == 3 and array.shape[2] == 3
    if array.dtype.kind not in "biuf" or array.size == 0:
        raise bad(
            f"{path}: cannot write the array",
            f"dtype {array.dtype}, shape {array.shape}",
            "real numbers, at least one",
        )
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
    if suffix in HDR:
        (_write_exr if suffix == ".exr" else _write_hdr)(path, array)
        return None
    if array.dtype == bool:
        array = array * np.uint8(255)
    if suffix != ".png":
        import tifffile

        with replacing(path) as file:
            tifffile.imwrite(file, array, photometric="rgb" if colour else "minisblack", metadata=None)
        return None
    if array.ndim != 2 and not colour:
        raise bad(
            f"{path}: a PNG holds one picture",
            f"shape {array.shape}",
            "(rows, cols)",
            "Write .npy, .npz or .tif instead.",
        )
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


def tone_mapped(image, exposure: float = 0.0) -> np.ndarray:
    """``image`` for a display, uint8 of the same shape: image x 2^exposure, clipped at 1, in sRGB's tones
    (IEC 61966-2-1).

    ``exposure`` [stops]: 0 shows 1 as white, 1 shows 0.5 as white. NaN is black. Raises InputError for an
    exposure that is not finite.
    """
    if isinstance(exposure, str) or not np.isfinite(exposure):
        raise bad("exposure", repr(exposure), "a finite number of stops")
    light = np.clip(np.nan_to_num(np.asarray(image, np.float64), nan=0.0) * 2.0**exposure, 0, 1)
    return np.rint(
        255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    ).astype(np.uint8)


@contextlib.contextmanager
def replacing(path):
    """A binary file that becomes ``path`` when the block ends well, and leaves no trace when it does not."""
    path = _parent(Path(path)).resolve()  # through a symbolic link, not over it
    temporary = path.with_name(
        f".{secrets.token_hex(8)}.tmp"
    )  # same folder: a rename must not cross file systems
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
    """The Jacksboro fault, Tennessee: (height (344, 403) float32 in whole metres, north up; spacing in
    metres).

    The grid is 3 arc seconds, so its steps are not equally long; the spacing is their geometric mean.
    ``data/jacksboro.json`` holds both steps and the provenance.
    """
    data = Path(__file__).parents[1] / "data"
    about = json.loads((data / "jacksboro.json").read_text(encoding="utf-8"))
    return read(data / "jacksboro.png").astype(np.float32), about["spacing"]


def _readable(path) -> Path:
    path = Path(path)
    with _reading(path):
        if path.is_dir():
            raise bad(f"{path}: cannot read", "a folder", "a file")
        if not path.exists():
            raise bad(f"{path}: cannot read", "no such file", "an existing file")
        if path.suffix.lower() not in SUFFIXES + HDR:
            raise bad(f"{path}: unknown extension", repr(path.suffix), " ".join(SUFFIXES + HDR))
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
    # the libraries raise OSError, ValueError, struct.error, zlib.error, SyntaxError, MemoryError ...
    except Exception as error:
        text = " ".join(str(error).split()) or "no reason given"
        raise bad(
            f"{path}: cannot read",
            f"{type(error).__name__}: {text}",
            f"a whole {path.suffix.lower()} file of real numbers",
        ) from error


def _read_npz(path, name) -> np.ndarray:
    if not zipfile.is_zipfile(path):
        raise ValueError("not a zip archive, or a truncated one")
    with np.load(path, allow_pickle=False) as arrays:
        found = arrays.files
        chosen = [n for n in found if n in ((name,) if name else ROLES)]
        if not chosen and len(found) == 1 and not (name and found[0] in ROLES):
            chosen = found
        if len(chosen) != 1:
            raise bad(
                f"{path}: cannot tell which array is the {name or 'data'}",
                f"arrays {', '.join(found) or 'none'}",
                f"an array named {name or ' or '.join(ROLES)}, or a single array under a name of its own",
            )
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
    if (
        array.dtype.itemsize * 8 != depth or array.shape != shape
    ):  # imageio turns some 16-bit files into 8-bit
        raise bad(
            f"{path}: the reader changed the data",
            f"{array.dtype} {array.shape} from a {what} of {shape}",
            allowed,
        )
    return array


def _read_tiff(path) -> np.ndarray:
    # imageio's own backend; asked directly because imageio hides pages, palettes and missing strips
    import tifffile

    with _logged_errors_raise("tifffile"), tifffile.TiffFile(path) as file:
        if len(file.pages) == 0 or len(file.series) != 1:
            raise bad(
                f"{path}: pages",
                f"{len(file.pages)} pages of {len(file.series)} kinds",
                "one picture, or equal pages as layers",
            )
        size = path.stat().st_size
        for page in file.pages:
            page = page.aspage()
            if page.samplesperpixel != 1 or page.photometric != tifffile.PHOTOMETRIC.MINISBLACK:
                raise bad(
                    f"{path}: not grey",
                    f"{page.samplesperpixel} samples, photometric"
                    f" {getattr(page.photometric, 'name', page.photometric)}",
                    "one grey channel, 0 is black (photometric MINISBLACK)",
                    _GREY_FIX,
                )
            if any(
                n <= 0 or at + n > size for at, n in zip(page.dataoffsets, page.databytecounts)
            ):  # tifffile fills such strips with zeros
                raise ValueError("truncated: a strip or tile is missing or lies beyond the end of the file")
        array = file.asarray()
        if array.dtype.itemsize * 8 != page.bitspersample:
            raise bad(f"{path}: bit depth", f"{page.bitspersample} bits per sample", "8, 16, 32 or 64")
        return array


def _module(path):
    """OpenEXR or OpenCV, whichever reads and writes ``path``."""
    try:
        if path.suffix.lower() == ".exr":
            import OpenEXR

            return OpenEXR
        import cv2

        return cv2
    except ImportError as error:
        raise lacking(
            str(path), "OpenEXR" if path.suffix.lower() == ".exr" else "opencv-python-headless", "hdr"
        ) from error


def _read_exr(path) -> np.ndarray:
    """(rows, cols), or (rows, cols, 3) red, green, blue; alpha is left out, since colours are what shines."""
    OpenEXR = _module(path)
    file = OpenEXR.File(str(path), header_only=True)
    if len(file.parts) != 1:
        raise bad(f"{path}: parts", len(file.parts), "an OpenEXR file of one picture")
    header = file.header()
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    size = high - low + 1
    if (size < 1).any() or size.prod() > MOST_PIXELS:
        raise bad(f"{path}: size", " x ".join(map(str, size)), f"at least one pixel, at most {MOST_PIXELS:,}")
    if not all(np.array_equal(a, b) for a, b in zip(header["dataWindow"], header["displayWindow"])):
        raise bad(
            f"{path}: part of a picture", "a data window that is not the display window", "a whole picture"
        )
    file = OpenEXR.File(str(path), separate_channels=True)
    if not file.parts:
        raise ValueError("truncated or damaged")
    channels = {name: channel.pixels for name, channel in file.channels().items() if name != "A"}
    if set(channels) == set("RGB"):
        array = np.stack([channels[c] for c in "RGB"], -1)
    elif len(channels) == 1:
        (array,) = channels.values()
    else:
        raise bad(f"{path}: channels", ", ".join(channels), "R, G and B, or one channel")
    if array.shape[:2] != (size[1], size[0]):
        raise ValueError(f"channels of {array.shape[:2]} in a picture of {size[1]} x {size[0]}")
    return array


def _write_exr(path, array):
    if (
        array.dtype not in (np.float16, np.float32, np.uint32)
        or array.shape[2:] not in ((), (3,))
        or array.ndim < 2
    ):
        raise bad(
            f"{path}: an OpenEXR file holds one picture",
            f"dtype {array.dtype}, shape {array.shape}",
            "float16, float32 or uint32, (rows, cols) or (rows, cols, 3)",
        )
    OpenEXR = _module(path)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as file:
        OpenEXR.File(header, {"Y" if array.ndim == 2 else "RGB": np.ascontiguousarray(array)}).write(
            file.name
        )


def _read_hdr(path) -> np.ndarray:
    """(rows, cols, 3) float32 red, green, blue."""
    cv2 = _module(path)
    data = path.read_bytes()
    header = data[: data.find(b"\n\n") + 1]
    if not header.startswith(b"#?"):
        raise ValueError("not a Radiance picture")
    array = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if array is None or array.dtype != np.float32 or array.ndim != 3:
        raise ValueError("truncated or damaged")
    exposures = [float(value) for value in re.findall(rb"^EXPOSURE=\s*(\S+)", header, re.MULTILINE)]
    return array[..., ::-1] / np.float32(np.prod(exposures))


def _write_hdr(path, array):
    if (
        array.dtype.kind != "f"
        or array.shape[2:] not in ((), (3,))
        or array.ndim < 2
        or not (np.isfinite(array).all() and array.min() >= 0)
    ):
        raise bad(
            f"{path}: a Radiance picture holds light",
            f"dtype {array.dtype}, shape {array.shape}, {np.nanmin(array)} to {np.nanmax(array)}",
            "finite floats >= 0, (rows, cols) or (rows, cols, 3)",
            "Write .exr or .tif to keep negative values and NaN.",
        )
    cv2 = _module(path)
    colours = np.ascontiguousarray(
        (array if array.ndim == 3 else np.stack([array] * 3, -1))[..., ::-1], np.float32
    )
    done, data = cv2.imencode(".hdr", colours)
    if not done:
        raise OSError(f"{path}: OpenCV could not encode it")
    with replacing(path) as file:
        file.write(data.tobytes())


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
        raise bad(
            f"{path}: cannot write",
            f"no folder {path.parent}",
            "a file in an existing folder",
            "Create the folder first.",
        )
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
