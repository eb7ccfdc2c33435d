"""From the words of the command line to scenes, reflectances, sources and images."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import typer

from .. import io
from ..errors import bad
from ..io import geotiff as geo
from ..reflectance import Lambertian, Mirror, Phong, Reflectance
from ..scene import Scene
from ..sources import Lamp, Sky, Source, Window, cie_overcast, environment_map
from ..sources.cie import cie_sky, sun_position
from .output import native_output_silenced

CLEAR = 12  # the CIE's number of the clear sky


def scene(
    file: Path,
    height: bool | None,
    spacing: float | None,
    reflectance: Reflectance | None,
    nodata: float | None,
    sides: str,
    resample: bool = False,
) -> tuple[Scene, geo.Raster | None]:
    """(scene, the raster that the file is if it is a GeoTIFF)."""
    raster = raster_of(file, resample, spacing)
    height = raster is not None if height is None else height
    values = values_of(file, height, spacing) if raster is None else raster.values
    mask = None if raster is None or raster.mask.all() else raster.mask
    mask = without(nodata, values, mask)
    if raster is not None and not height:
        values = np.where(raster.mask, values, 0)
    spacing = spacing_of(spacing, raster)
    make = Scene.from_height if height else Scene
    return make(values, spacing=spacing, mask=mask, sides=sides, reflectance=reflectance), raster


def values_of(file: Path, height: bool | None, spacing: float | None) -> np.ndarray:
    """Depths, or heights, of a file that is no GeoTIFF; warns of heights without a unit."""
    with native_output_silenced(file):
        values = io.read(file, "height" if height else "depth", scaled=True)
    if height and spacing is None and file.suffix.lower() == ".png" and values.dtype.kind == "u":
        warnings.warn(
            f"Counts: heights are the counts of {file}, {values.min()} to {values.max()}, and neighbouring"
            " pixels are 1 apart. Give --spacing, that distance in counts.",
            stacklevel=2,
        )
    return values


def raster_of(file: Path, resample: bool, spacing: float | None) -> geo.Raster | None:
    """The raster that a file is if it is a GeoTIFF, with --spacing if that is given."""
    raster = geo.read(file, resample=resample, spacing=spacing) if geo.is_geotiff(file) else None
    if resample and raster is None:
        raise typer.BadParameter(f"{file} is not a GeoTIFF", param_hint="--resample")
    return raster


def spacing_of(spacing: float | None, raster: geo.Raster | None) -> float:
    """The spacing: --spacing, or that of the raster; 1 without both."""
    return raster.spacing if raster is not None else 1.0 if spacing is None else spacing


def without(nodata: float | None, values: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
    """The mask, less the nodes whose value is that of --nodata."""
    if nodata is None:
        return mask
    known: np.ndarray = ~np.isnan(values) if np.isnan(nodata) else values != nodata
    return known if mask is None else mask & known


def reflectance(albedo: str, specular: str | None, exponent: float | None) -> Reflectance:
    """The surface that --albedo, --specular and --exponent describe."""
    if specular is None:
        if exponent is not None:
            raise typer.BadParameter("goes with --specular", param_hint="--exponent")
        return Lambertian(_share(albedo, "--albedo"))
    diffuse, lobe = _share(albedo, "--albedo"), _share(specular, "--specular")
    if exponent == np.inf:
        return Mirror(lobe, diffuse)
    return Phong(diffuse, lobe, 20.0 if exponent is None else exponent)


def _share(text: str, option: str) -> float | np.ndarray:
    """A share of light, or one for each of red, green and blue."""
    return np.array(numbers(text, option, "R,G,B")) if "," in text else numbers(text, option, "A")[0]


def source(
    kind: str | None,
    lamp: str | None,
    window: str | None,
    sun: str | None = None,
    direct: float = 0.0,
    horizontal: float | None = None,
    *,
    file: Path,
) -> Source:
    """The source that --source, --lamp, --window, --sun, --direct and --horizontal describe, over the map in
    ``file``.
    """
    kind = kind or ("lamp" if lamp else "window" if window else "sky")
    for name, given in (("lamp", lamp), ("window", window)):
        if bool(given) != (kind == name):
            raise typer.BadParameter(
                f"--{name} goes with --source {name}: got --source {kind}"
                + ("" if given else f" without --{name}"),
                param_hint=f"--{name}",
            )
    cie = re.fullmatch("clear|cie([0-9]+)", kind)
    of_cie = {"--sun": sun, "--direct": direct, "--horizontal": horizontal is not None}
    for option in [option for option, given in of_cie.items() if given and not cie]:
        text = f"goes with --source clear or cie1 to cie15: got --source {kind}"
        raise typer.BadParameter(text, param_hint=option)
    if lamp:
        x, y, z, radius = numbers(lamp, "--lamp", "X,Y,Z,R")
        return Lamp(center=(x, y, z), radius=radius)
    if window:
        x0, x1, y0, y1 = numbers(window, "--window", "X0,X1,Y0,Y1")
        return Window(x=(x0, x1), y=(y0, y1))
    if cie:
        place = None if sun is None else _sun(sun, file)
        return Sky(cie_sky(int(cie[1] or CLEAR), place, horizontal=horizontal, direct=direct))
    return _sky(kind)


def sky(kind: str, sun: str | None, file: Path) -> Sky:
    """The sky that --source and --sun describe, over the map in ``file``."""
    if kind in ("lamp", "window"):
        raise typer.BadParameter(f"is a sky here: got {kind}", param_hint="--source")
    found = source(kind, None, None, sun, file=file)
    assert isinstance(found, Sky), "lamps and windows were refused"
    return found


def node(text: str) -> tuple[int, int]:
    """The node that --at names."""
    row, col = numbers(text, "--at", "ROW,COL")
    if not (row.is_integer() and col.is_integer()):
        raise bad("--at", text, "two whole numbers")
    return int(row), int(col)


def check_place(light: Source, raster: geo.Raster | None) -> None:
    """BadParameter for a lamp or window given in the coordinates of the file's reference system."""
    if raster is None or isinstance(light, Sky):
        return
    if isinstance(light, Window):
        assert light.x is not None and light.y is not None, "as source makes it"
        x, y = light.x[0], light.y[0]
    else:
        assert isinstance(light, Lamp) and light.center is not None, "as source makes it"
        x, y = light.center[:2]
    (rows, cols), t = raster.values.shape, raster.transform
    col, row = (x - t.c) / t.a, (y - t.f) / t.e
    if 0 <= col <= cols and 0 <= row <= rows and not (0 <= x / t.a <= cols and 0 <= -y / t.e <= rows):
        raise typer.BadParameter(
            f"{x:g}, {y:g} lies on the map by its reference system. Give lengths from the first node:"
            f" {col * raster.spacing:.6g} to the east and {row * raster.spacing:.6g} to the south",
            param_hint="--window" if isinstance(light, Window) else "--lamp",
        )


def _sky(kind: str) -> Sky:
    """The uniform sky, the overcast one, or the environment map in the file ``kind``."""
    if kind == "sky":
        return Sky()
    if kind == "overcast":
        return Sky(cie_overcast())
    if not Path(kind).exists():
        raise bad(
            "--source",
            repr(kind),
            "sky, overcast, clear, cie1 to cie15, lamp, window, or an existing file (an environment map)",
        )
    with native_output_silenced(kind):
        return Sky(environment_map(io.read_environment(kind)))


def _sun(text: str, file: Path) -> tuple[float, float]:
    """(azimuth, elevation) [degree] of --sun, given as such on the map in ``file``, or by time and place."""
    if text.count(",") == 2:
        time, place = text.split(",", 1)
        latitude, longitude = numbers(place, "--sun", "LAT,LON")
        azimuth, elevation = sun_position(time, latitude, longitude)
        if elevation < 0:
            raise bad(f"--sun {text}", f"a sun {-elevation:.1f} degrees below the horizon", "a time of day")
        return azimuth - (geo.convergence(file) if geo.is_geotiff(file) else 0.0), elevation
    azimuth, elevation = numbers(text, "--sun", "AZ,EL")
    return azimuth, elevation


INTERREFLECTION: dict[str, bool | str] = {"auto": "auto", "on": True, "off": False}  # of the option


def tolerance(text: str, option: str = "--tolerance") -> float:
    """A share of one: 0.01 or 1%."""
    try:
        return float(text[:-1]) / 100 if text.endswith("%") else float(text)
    except ValueError:
        raise typer.BadParameter(
            f"got {text!r}; allowed: a number above 0, such as 0.01 or 1%", param_hint=option
        ) from None


def byte_count(text: str) -> int:
    """Bytes of --memory: 8GB, 512MB, 6.5e9."""
    match = re.fullmatch(r"([0-9.]+(?:e[0-9]+)?)\s*([kMGT]?i?B?)", text.strip())
    units = {"": 1, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}
    units |= {"ki": 2**10, "Mi": 2**20, "Gi": 2**30, "Ti": 2**40}
    try:
        count = int(float(match[1]) * units[match[2].removesuffix("B")]) if match else 0
    except (ValueError, KeyError):
        count = 0
    if count <= 0:
        raise typer.BadParameter(
            f"got {text!r}; allowed: bytes, or with k, M, G, T or KiB, MiB, GiB, TiB: 6.5e9, 512MB, 8GiB",
            param_hint="--memory",
        )
    return count


def numbers(text: str, option: str, form: str) -> tuple[float, ...]:
    """As many numbers, with commas between, as ``form`` has names."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(form.split(",")):
        raise typer.BadParameter(
            f"got {text!r}; allowed: {form}, numbers with commas between", param_hint=option
        )
    return values


def whole_numbers(text: str, option: str) -> list[int]:
    """Whole numbers with commas between."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(
            f"got {text!r}; allowed: whole numbers with commas between", param_hint=option
        ) from None


def radiance(
    file: Path, white: float | None, resample: bool, spacing: float | None
) -> tuple[np.ndarray, geo.Raster | None]:
    """(The image in ``file`` as radiance, the raster that the file is if it is a GeoTIFF).

    Counts need a scale, the file's own or --white; floating values are radiance already. Cells of a raster
    without data are nan.
    """
    raster = raster_of(file, resample, spacing)
    if raster is not None:
        image = raster.values
    else:
        with native_output_silenced(file):
            image = io.read(file, "image", scaled=white is None)
    image = _scaled(file, image, white)
    return image if raster is None else np.where(raster.mask, image, np.nan), raster


def where_known(image: np.ndarray, raster: geo.Raster | None, file: Path | None) -> np.ndarray | None:
    """(rows, cols) bool: pixels of ``image`` that a raster knows, and that are not 0 in the image ``file``;
    None if there is neither.
    """
    masks = [] if raster is None or raster.mask.all() else [raster.mask]
    if file is not None:
        values = io.read(file)
        if values.shape != image.shape:
            raise bad(f"{file}: wrong shape", values.shape, f"that of the image, {image.shape}")
        masks.append((values != 0) & (values == values))  # nan is not known
    return np.logical_and.reduce(masks) if masks else None


def _scaled(file: Path, image: np.ndarray, white: float | None) -> np.ndarray:
    if image.dtype.kind == "f":
        if white is not None:
            raise typer.BadParameter(
                f"{file} holds floating values, which are radiance as they are", param_hint="--white"
            )
        return image
    if white is None or image.dtype.kind != "u":
        raise bad(
            f"{file}: counts without a scale",
            image.dtype,
            "floating values, or unsigned counts with a scale",
            "Give --white, the radiance of a full-scale count, if counts are linear; decode a photograph in"
            " sRGB by skylamp.io.linear first.",
        )
    return image * (white / np.iinfo(image.dtype).max)
