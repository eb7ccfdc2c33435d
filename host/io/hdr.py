"""Pictures of high dynamic range: OpenEXR (.exr) and Radiance HDR (.hdr), both with the extra ``hdr``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..constants import MOST_FILE_PIXELS
from ..errors import bad, import_extra
from .paths import replacing, reserve

BRIGHTEST_RGBE = 255 * 2.0**119  # that a Radiance picture holds: a mantissa of 255/256, an exponent of 127


def module(path: Path) -> Any:
    """OpenEXR or OpenCV, whichever reads and writes ``path``; InputError if it is not installed."""
    package, name = ("OpenEXR",) * 2 if path.suffix.lower() == ".exr" else ("opencv-python-headless", "cv2")
    return import_extra(str(path), package, "hdr", name)[0]


def read(path: Path) -> np.ndarray:
    """(rows, cols), or (rows, cols, 3) red, green, blue."""
    return _read_openexr(path) if path.suffix.lower() == ".exr" else _read_radiance(path)


def write(path: Path, array: np.ndarray) -> None:
    """Write (rows, cols) or (rows, cols, 3); InputError for a type that the format does not hold."""
    (_write_openexr if path.suffix.lower() == ".exr" else _write_radiance)(path, array)


def _is_picture(array: np.ndarray) -> bool:
    return array.ndim >= 2 and array.shape[2:] in ((), (3,))


def _read_openexr(path: Path) -> np.ndarray:
    """(rows, cols), or (rows, cols, 3) red, green, blue; alpha is left out, since the colours alone are
    radiance.
    """
    OpenEXR = module(path)
    file = OpenEXR.File(str(path), header_only=True)
    if len(file.parts) != 1:
        raise bad(f"{path}: parts", len(file.parts), "an OpenEXR file of one picture")
    header = file.header()
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    size = high - low + 1
    if (size < 1).any() or size.prod() > MOST_FILE_PIXELS:
        raise bad(
            f"{path}: size", " x ".join(map(str, size)), f"at least one pixel, at most {MOST_FILE_PIXELS:,}"
        )
    if not all(np.array_equal(a, b) for a, b in zip(header["dataWindow"], header["displayWindow"])):
        raise bad(
            f"{path}: part of a picture", "a data window that is not the display window", "a whole picture"
        )
    reserve(path, 4 * len(header["channels"]) * int(size.prod()))
    file = OpenEXR.File(str(path), separate_channels=True)
    if not file.parts:
        raise ValueError("truncated or damaged")
    channels = {name: channel.pixels for name, channel in file.channels().items() if name != "A"}
    array: np.ndarray
    if set(channels) == set("RGB"):
        array = np.stack([channels[c] for c in "RGB"], -1)
    elif len(channels) == 1:
        (array,) = channels.values()
    else:
        raise bad(f"{path}: channels", ", ".join(channels), "R, G and B, or one channel")
    if array.shape[:2] != (size[1], size[0]):
        raise ValueError(f"channels of {array.shape[:2]} in a picture of {size[1]} x {size[0]}")
    return array


def _write_openexr(path: Path, array: np.ndarray) -> None:
    if array.dtype not in (np.float16, np.float32, np.uint32) or not _is_picture(array):
        raise bad(
            f"{path}: cannot be written as OpenEXR",
            f"dtype {array.dtype}, shape {array.shape}",
            "float16, float32 or uint32, (rows, cols) or (rows, cols, 3), in one file one picture",
        )
    OpenEXR = module(path)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"Y" if array.ndim == 2 else "RGB": np.ascontiguousarray(array)}
    with replacing(path) as file:
        OpenEXR.File(header, channels).write(file.name)


def _read_radiance(path: Path) -> np.ndarray:
    """(rows, cols, 3) float32 red, green, blue."""
    cv2 = module(path)
    data = path.read_bytes()
    header = data[: data.find(b"\n\n") + 1]
    if not header.startswith(b"#?"):
        raise ValueError("not a Radiance picture")
    size = re.search(rb"^([-+][XY]) (\d+) ([-+][XY]) (\d+)$", data, re.MULTILINE)
    if size is None:
        raise ValueError("its header has no size")
    if size[1] + size[3] != b"-Y+X":  # OpenCV reads no others
        order = f"{size[1].decode()} {size[3].decode()}"
        raise bad(f"{path}: order of its pixels", order, "-Y +X, rows from the top, each from the left")
    reserve(path, 12 * int(size[2]) * int(size[4]), 12 * MOST_FILE_PIXELS)
    array: np.ndarray | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if array is None or array.dtype != np.float32 or array.ndim != 3:
        raise ValueError("truncated or damaged")
    with np.errstate(over="ignore"):
        light: np.ndarray = (array[..., ::-1] / _multipliers(header)).astype(np.float32)
    if not np.isfinite(light).all():
        got = f"light of up to {array.max():g} that EXPOSURE or COLORCORR takes beyond float32"
        raise bad(f"{path}: brightness", got, "at most 3.4e38")
    return light


def _multipliers(header: bytes) -> np.ndarray:
    """What red, green and blue were multiplied by: the product of all EXPOSURE and COLORCORR lines.

    ValueError for lines that are not one and three finite numbers > 0.
    """
    product = np.ones(3)
    for key, text in re.findall(rb"^(EXPOSURE|COLORCORR)=(.*)$", header, re.MULTILINE):
        factors = [float(word) for word in text.split()]
        if len(factors) != (1 if key == b"EXPOSURE" else 3) or not all(0 < f < np.inf for f in factors):
            raise ValueError(f"{key.decode()} of {text.decode(errors='replace').strip()}")
        product *= factors
    if not ((product > 0) & (product < np.inf)).all():
        raise ValueError(f"EXPOSURE and COLORCORR whose product is {product.tolist()}")
    return product


def _write_radiance(path: Path, array: np.ndarray) -> None:
    is_light = array.dtype.kind == "f" and bool(np.isfinite(array).all() and array.min() >= 0)
    if not is_light or not _is_picture(array):
        least, most = np.fmin.reduce(array, None), np.fmax.reduce(array, None)
        raise bad(
            f"{path}: a Radiance picture holds light",
            f"dtype {array.dtype}, shape {array.shape}, {least} to {most}",
            "finite floats >= 0, (rows, cols) or (rows, cols, 3)",
            "Write .exr or .tif to keep negative values and NaN.",
        )
    cv2 = module(path)
    light = _rounded(array if array.ndim == 3 else np.stack([array] * 3, -1))
    if light.max() > BRIGHTEST_RGBE:
        allowed = f"at most {BRIGHTEST_RGBE:.4g}"
        raise bad(f"{path}: too bright for a Radiance picture", array.max(), allowed, "Use a larger unit.")
    done, data = cv2.imencode(".hdr", np.ascontiguousarray(light[..., ::-1], np.float32))
    if not done:
        raise OSError(f"{path}: OpenCV could not encode it")
    with replacing(path) as file:
        file.write(data.tobytes())


def _rounded(rgb: np.ndarray) -> np.ndarray:
    """(rows, cols, 3) float64, rounded to what the format holds; OpenCV would cut it off instead."""
    with np.errstate(over="ignore"):  # of long doubles
        light = rgb.astype(np.float64)
    most = light.max(-1, keepdims=True)
    # a mantissa of the largest channel is 128 to 255 steps; -127 is the format's least exponent
    step = np.ldexp(1.0, np.maximum(np.frexp(most)[1], -127) - 8)
    step = np.where(np.rint(most / step) > 255, 2 * step, step)  # 255.5 steps and more are 128 of the next
    with np.errstate(invalid="ignore"):  # inf / inf
        rounded: np.ndarray = np.rint(light / step) * step
    return rounded
