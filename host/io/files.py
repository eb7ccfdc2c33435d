"""Arrays in files: .npy, .npz, PNG (8 and 16 bit), TIFF, OpenEXR and Radiance HDR.

The format follows from the extension alone. GeoTIFF with its georeference is read and written by
:mod:`skylamp.geo`.

Arrays that are read have exactly the values in the file. Content that a reader would have to change (colour,
packed bits, palettes, pickles) is an error that names the fix. A written file is complete or does not exist.
"""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import number_or_nan
from ..errors import bad
from . import hdr, png, tiff
from .paths import HDR, MAP_SUFFIXES, StrPath, destination, readable, reading, replacing, reserve

NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
ROLES = ("depth", "height", "image")
NOT_NAMES = ("", "file", "allow_pickle")  # of arrays in an .npz: NumPy's writer has parameters of these names
NOT_WRITTEN = "cannot write the array"
MOST_STOPS = 1000  # so that 2^stops is finite
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear red, green, blue: ITU-R BT.709


def read(path: StrPath, name: str | None = None, *, scaled: bool = False) -> np.ndarray:
    """The array in a file, its values untouched.

    ``path``: .npy; .npz; grey PNG of 8 or 16 bits (uint8, uint16); TIFF of one grey channel in the type that
    it has, (rows, cols), or (layers, rows, cols) for equal pages; OpenEXR of one channel (float16, float32 or
    uint32). ``name``: which array of an .npz, "depth", "height" or "image"; without that name the only array
    is taken, unless it is named as another of the three. ``scaled``: counts of a PNG that holds a range, see
    :func:`write`, become the values that they stand for, float64.

    Raises InputError with the file, the content got and that allowed: missing, a folder, empty, truncated
    or damaged files, unknown extensions, pickles, colour, and bit depths that a reader would change on the
    way.
    """
    path = readable(path)
    with reading(path):
        if path.suffix.lower() == ".npy":
            with open(path, "rb") as file:
                array = _read_npy(path, file, path.stat().st_size)
        elif path.suffix.lower() == ".npz":
            array = _read_npz(path, name)
        elif path.suffix.lower() == ".png":
            array = png.read(path, colours=(0,))
            array = _values(path, array) if scaled else array
        elif path.suffix.lower() in HDR:
            array = hdr.read(path)
            if array.ndim == 3 and (array == array[..., :1]).all():
                array = array[..., 0]  # three equal channels are grey; a .hdr has no fewer
            if array.ndim == 3:
                fix = f"{png.GREY_FIX} read_environment(path, colour=True) keeps the colours."
                raise bad(f"{path}: not grey", "red, green and blue", "one channel", fix)
        else:
            array = tiff.read(path)
    dtype: Any = getattr(array, "dtype", "no array")
    if getattr(dtype, "kind", "O") not in "biuf":
        raise bad(f"{path}: wrong type", dtype, "real numbers (integer or floating)")
    if array.size == 0:
        raise bad(f"{path}: empty array", f"shape {array.shape}", "at least one element")
    return array


def read_environment(path: StrPath, *, colour: bool = False) -> np.ndarray:
    """An environment map (rows, cols) float64 for :func:`skylamp.environment_map`: brightness per pixel.

    Reads what :func:`read` reads, and RGB: OpenEXR, Radiance HDR (divided by its EXPOSURE and COLORCORR), an
    8-bit RGB PNG or a (rows, cols, 3) .npy or .npz, turned into luminance, 0.2126 R + 0.7152 G + 0.0722 B
    (ITU-R BT.709), unless ``colour`` keeps them, (rows, cols, 3). Counts of a PNG that holds a range, see
    :func:`write`, are the values that they stand for; those of other integer files are taken as proportional
    to brightness, full scale (255, 65535) as 1. Floating values are taken as they are. Errors as in
    :func:`read`.
    """
    path = readable(path)
    suffix = path.suffix.lower()
    if suffix == ".png" or suffix in HDR:
        with reading(path):
            array = _values(path, png.read(path, colours=(0, 2))) if suffix == ".png" else hdr.read(path)
    else:
        array = read(path)
    if array.ndim != 2 and not (array.ndim == 3 and array.shape[2] == 3):
        raise bad(f"{path}: wrong shape", array.shape, "(rows, cols) or (rows, cols, 3)")
    scale = np.iinfo(array.dtype).max if array.dtype.kind in "iu" else 1
    array = array / np.float64(scale)
    return array @ LUMINANCE if array.ndim == 3 and not colour else array


def read_range(path: StrPath) -> tuple[float, float] | None:
    """The values (low, high) of the counts 0 and full scale of a PNG that :func:`write` wrote, or None."""
    path = readable(path)
    if path.suffix.lower() != ".png":
        return None
    with reading(path):
        return png.read_range(path)


def writable(path: StrPath) -> Path:
    """``path`` if a file can be put there.

    Raises InputError for an unknown extension or a parent folder that is missing.
    """
    path = Path(path)
    if path.suffix.lower() not in MAP_SUFFIXES + HDR:
        raise bad(f"{path}: unknown extension", repr(path.suffix), " ".join(MAP_SUFFIXES + HDR))
    if path.suffix.lower() in HDR:
        hdr.module(path)
    return destination(path)


def write(
    path: StrPath,
    array: ArrayLike,
    *,
    range: tuple[float, float] | None = None,
    bits: int | None = None,
    name: str = "image",
    **more: ArrayLike,
) -> tuple[float, float] | None:
    """Write ``array`` to ``path``, whole or not at all; an older file stays until the new one is complete.

    .npy and .tif keep the values and their type (bool becomes 0 and 255 in .tif). .exr keeps float16, float32
    and uint32, as channel Y, or R, G and B for (rows, cols, 3). .hdr holds (rows, cols) or (rows, cols, 3) of
    floats from 0 to 1.69e38 with 8 bits of mantissa: an error of up to 1 in 256 of a pixel's largest channel;
    pixels below 1e-32 become 0. .npz
    holds the array as ``name`` and the arrays in ``more``, which other formats do not take. An "image" (rows,
    cols, 3) is RGB in .tif and in .png, there with 8 bits. .png holds (rows, cols): uint8, uint16 and bool as
    they are (True is 255), anything else as counts of ``bits`` (8, the default, or 16): rint((value - low) /
    (high - low) * full scale), clipped, NaN as 0, with ``range`` = (low, high), by default (0, the largest
    finite value); the range is put into the file and :func:`read_range` gives it back.

    Returns the range of a scaled PNG, else None. Raises InputError for a missing parent folder, an unknown
    extension, an array that the format does not hold, names that are two arrays' or NumPy's own (file,
    allow_pickle), or a ``range`` or ``bits`` that would do nothing; OSError if the disk refuses.
    """
    path = writable(path)
    array, suffix = numbers(array, f"{path}: {NOT_WRITTEN}"), path.suffix.lower()
    if more and suffix != ".npz":
        raise bad(f"{path}: only one array fits", f"{1 + len(more)} arrays", "several arrays in an .npz")
    if suffix != ".png" and not (range is None and bits is None):
        got, allowed = f"range {range!r}, bits {bits!r}", "neither: other formats than PNG keep the values"
        raise bad(f"{path}: range and bits", got, allowed)
    if suffix == ".npz":
        _write_npz(path, array, name, more)
        return None
    if suffix == ".npy":
        with replacing(path) as file:
            np.save(file, array, allow_pickle=False)
        return None
    if suffix in HDR:
        hdr.write(path, array)
        return None
    rgb = name == "image" and array.ndim == 3 and array.shape[2] == 3
    if array.dtype == bool:
        array = array * np.uint8(255)
    if suffix == ".png":
        return png.write(path, array, range, bits, rgb)
    tiff.write(path, array, rgb)
    return None


def tone_mapped(image: ArrayLike, exposure: float = 0.0) -> np.ndarray:
    """``image`` for a display, uint8 of the same shape: image x 2^exposure, clipped at 1, in sRGB's tones
    (IEC 61966-2-1).

    ``exposure`` [stops], -1000 to 1000: 0 shows 1 as white, 1 shows 0.5 as white. NaN is black. Raises
    InputError for another exposure, or an image that is no real array.
    """
    stops = np.nan if isinstance(exposure, (str, bytes)) else number_or_nan(exposure)
    if not abs(stops) <= MOST_STOPS:
        raise bad("exposure", repr(exposure), f"a finite number of stops, -{MOST_STOPS} to {MOST_STOPS}")
    light = np.nan_to_num(numbers(image, "tone_mapped: image").astype(np.float64), nan=0.0)
    with np.errstate(over="ignore"):  # it is clipped
        light = np.clip(light * 2.0**stops, 0, 1)
    tones = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    counts: np.ndarray = np.rint(255 * tones).astype(np.uint8)
    return counts


def linear(image: ArrayLike) -> np.ndarray:
    """Light of an image in sRGB's tones (IEC 61966-2-1), as cameras and :func:`tone_mapped` make them:
    float64 of the same shape, 0 to 1.

    ``image``: counts of 8 or 16 bits, uint8 or uint16, or tones from 0 to 1. The light is proportional to
    radiance where a camera applied no other curve and clipped nothing. Raises InputError for other types, or
    tones beyond 0 to 1.

    Example: ``io.linear(imageio.imread("photo.jpg")) @ (0.2126, 0.7152, 0.0722)``, a photograph's luminance.
    """
    tones = numbers(image, "linear: image")
    if tones.dtype.kind != "f" and tones.dtype not in (np.uint8, np.uint16):
        raise bad("linear: image", tones.dtype, "uint8, uint16, or tones from 0 to 1, floating")
    full = 1 if tones.dtype.kind == "f" else np.iinfo(tones.dtype).max
    tones = tones.astype(np.float64) / full
    if not (tones.min() >= 0 and tones.max() <= 1):  # nan is neither
        raise bad("linear: image", f"tones from {tones.min()} to {tones.max()}", "0 to 1")
    light: np.ndarray = np.where(tones <= 0.04045, tones / 12.92, ((tones + 0.055) / 1.055) ** 2.4)
    return light


def terrain() -> tuple[np.ndarray, float]:
    """The Jacksboro fault, Tennessee: (height (344, 403) float32 in whole metres, north up; spacing in
    metres).

    The grid is 3 arc seconds, so its steps are not equally long; the spacing is their geometric mean.
    ``data/jacksboro.json`` holds both steps and the provenance.
    """
    data = Path(__file__).parents[1] / "data"
    about = json.loads((data / "jacksboro.json").read_text(encoding="utf-8"))
    return read(data / "jacksboro.png").astype(np.float32), about["spacing"]


def _values(path: Path, counts: np.ndarray) -> np.ndarray:
    """What the counts of a PNG stand for, float64, if it holds a range, else the counts."""
    range = png.read_range(path)
    if range is None:
        return counts
    return range[0] + counts * ((range[1] - range[0]) / np.iinfo(counts.dtype).max)


def numbers(values: Any, what: str) -> np.ndarray:
    """``values`` as an array of real numbers, at least one, in the machine's order of bytes."""
    if isinstance(values, np.ma.MaskedArray):
        allowed, fix = "plain arrays", "Pass array.filled(value)."
        raise bad(f"{what}: a numpy masked array", "mask inside the array", allowed, fix)
    try:
        array = np.asarray(values)
    except Exception as error:  # ragged lists; whatever __array__ raises
        got = f"{type(error).__name__}: {error}"
        raise bad(what, got, "real numbers, at least one") from error
    if array.dtype.kind not in "biuf" or array.size == 0:
        raise bad(what, f"dtype {array.dtype}, shape {array.shape}", "real numbers, at least one")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _write_npz(path: Path, array: np.ndarray, name: Any, more: dict[str, Any]) -> None:
    for key in (name, *more):
        if not isinstance(key, str) or key in NOT_NAMES:
            raise bad(f"{path}: name of an array", repr(key), f"text other than {', '.join(NOT_NAMES[1:])}")
    if name in more:
        raise bad(f"{path}: two arrays of one name", repr(name), "a name for each", "Pass another name=.")
    arrays: dict[str, Any] = {name: array}
    arrays |= {key: numbers(values, f"{path}: {NOT_WRITTEN} {key}") for key, values in more.items()}
    with replacing(path) as file:
        np.savez_compressed(file, **arrays)


def _read_npz(path: Path, name: str | None) -> np.ndarray:
    if not zipfile.is_zipfile(path):
        raise ValueError("not a zip archive, or a truncated one")
    with zipfile.ZipFile(path) as arrays:
        names = [entry.removesuffix(".npy") for entry in arrays.namelist()]
        chosen = [n for n in names if n in ((name,) if name else ROLES)]
        if not chosen and len(names) == 1 and not (name and names[0] in ROLES):
            chosen = names
        if len(chosen) != 1:
            raise bad(
                f"{path}: it is not clear which array is the {name or 'data'}",
                f"arrays {', '.join(names) or 'none'}",
                f"an array named {name or ' or '.join(ROLES)}, or a single array under a name of its own",
            )
        entry = arrays.infolist()[names.index(chosen[0])]
        with arrays.open(entry) as file:
            return _read_npy(path, file, entry.file_size)


def _read_npy(path: Path, file: IO[bytes], size: int) -> np.ndarray:
    """The array of an open .npy of ``size`` bytes. A pickle is refused, never read."""
    version = np.lib.format.read_magic(file)
    if version not in NPY_HEADERS:
        raise ValueError(f".npy of version {version}, which no array of numbers needs")
    shape, _, dtype = NPY_HEADERS[version](file)
    if dtype.hasobject:
        raise ValueError("Object arrays are pickles, which are never read")
    reserve(path, math.prod(shape) * dtype.itemsize, size)
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
