"""The command line: `skylamp render | plan | recover | horizon | field | chart | backends | selftest | demo`.

Data go to files or to stdout; messages, progress and errors go to stderr. Exit codes: 0 ok, 2 usage, 3 bad
input, 4 backend unavailable, 1 the rest. An error is one line; --debug adds the traceback.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import re
import sys
import traceback
from pathlib import Path
from typing import Annotated, NoReturn, Optional

import numpy as np
import skylamp as sl
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Column, Table

from ..backends import select
from ..errors import BackendError, InputError, SkylampError, bad
from ..io import files as io
from ..io import geotiff as geo
from . import plot
from .selftest import selftest as run_selftest

app = typer.Typer(
    name="skylamp",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Light from skies, lamps and windows on depth maps, forward and inverse.",
)
_debug = False

# The demo. Real ground is gentle: heights are exaggerated so that valleys lose sky. The lamp is (x, y, z,
# radius) in nodes.
EXAGGERATION = 4
LAMP = (215, 150, -45, 40)

File = Annotated[
    Path,
    typer.Argument(
        help="Depth, or height with --height: .npy, .npz, grey .png, .tif or .exr; a GeoTIFF holds height",
        show_default=False,
    ),
]
Out = Annotated[
    str,
    typer.Option(
        help=".npy, .npz, .tif, .png, .exr or .hdr; - writes .npy to stdout; a .tif from a GeoTIFF is one",
        show_default=False,
    ),
]
Height = Annotated[
    bool | None,
    typer.Option(
        "--height/--depth",
        help=(
            "What the file holds: height (larger is nearer to the viewer) or depth  [default: depth, height"
            " in a GeoTIFF]"
        ),
        show_default=False,
    ),
]
Spacing = Annotated[
    float | None,
    typer.Option(
        help="Distance between neighbouring nodes, in the unit of depth  [default: 1, a GeoTIFF's own]",
        show_default=False,
    ),
]
Resample = Annotated[
    bool, typer.Option("--resample", help="GeoTIFF: make cells square that are not, such as cells of degrees")
]
Albedo = Annotated[float, typer.Option(help="Diffuse reflectance, 0 to 1")]
Albedos = Annotated[
    str, typer.Option(metavar="A|R,G,B", help="Diffuse reflectance, 0 to 1; in colour with three numbers")
]
Specular = Annotated[
    str | None,
    typer.Option(
        metavar="S|R,G,B",
        help="Specular albedo of a lobe about the mirror direction, 0 to 1 - albedo",
        show_default=False,
    ),
]
Exponent = Annotated[
    float | None,
    typer.Option(
        help="Phong's exponent of that lobe; inf is an ideal mirror  [default: 20]", show_default=False
    ),
]
Nodata = Annotated[
    float | None, typer.Option(help="Leave out nodes of this value (a number, or nan)", show_default=False)
]
Source = Annotated[
    str | None,
    typer.Option(
        help=(
            "sky | overcast | clear | cie1 to cie15 | lamp | window | FILE, an environment map  [default:"
            " lamp with --lamp, window with --window, else sky]"
        ),
        show_default=False,
    ),
]
Lamp = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z,R",
        help="Centre and radius of a spherical lamp, in the unit of spacing",
        show_default=False,
    ),
]
Window = Annotated[
    str | None,
    typer.Option(
        metavar="X0,X1,Y0,Y1", help="Rectangle in the plane z = 0, in the unit of spacing", show_default=False
    ),
]
Sun = Annotated[
    str | None,
    typer.Option(
        metavar="AZ,EL | TIME,LAT,LON",
        help=(
            "Where the sun stands, for clear and cie skies: degrees clockwise from north and above the"
            " horizon, or 2026-06-21T12:00Z and degrees north and east"
        ),
        show_default=False,
    ),
]
Direct = Annotated[
    float,
    typer.Option(
        help="Irradiance by the sun's disc of a surface that faces it, beside a zenith of brightness 1"
    ),
]
Sides = Annotated[str, typer.Option(help="open | dark | periodic")]
Backend = Annotated[str, typer.Option(help="auto, or a name from `skylamp backends`")]
Hemicube = Annotated[int, typer.Option(help="Nodes along an edge of the cube of directions, odd")]
Picture = Annotated[
    Path | None, typer.Option("--plot", help="Draw a picture: .png, .svg or .pdf", show_default=False)
]
MaybeOut = Annotated[
    str | None,
    typer.Option(
        "--out",
        help=".npy, .npz, .tif or .exr, or .png for one plane; - writes .npy to stdout",
        show_default=False,
    ),
]
Tolerance = Annotated[str, typer.Option(help="Relative RMS error that auto may make: 0.01 or 1%")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout")]


def _version(asked: bool):
    if asked:
        print(f"skylamp {sl.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_version, help="Print the version and exit")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Print the traceback of an error")] = False,
):
    global _debug
    _debug = debug


@app.command()
def render(
    file: File,
    out: Out,
    height: Height = None,
    spacing: Spacing = None,
    albedo: Albedos = "0.8",
    specular: Specular = None,
    exponent: Exponent = None,
    nodata: Nodata = None,
    resample: Resample = False,
    source: Source = None,
    lamp: Lamp = None,
    window: Window = None,
    sun: Sun = None,
    direct: Direct = 0.0,
    sides: Sides = "open",
    method: Annotated[str, typer.Option(help="auto | lattice | horizon | unoccluded")] = "auto",
    tolerance: Tolerance = "1%",
    hemicube: Annotated[
        int | None,
        typer.Option(help="Lattice: nodes along an edge of the cube of directions, odd", show_default=False),
    ] = None,
    filled: Annotated[
        bool | None,
        typer.Option(
            "--filled/--stride",
            help="Lattice: test between the nodes, or step over them as the paper does",
            show_default=False,
        ),
    ] = None,
    quantity: Annotated[str, typer.Option(help="radiance | irradiance")] = "radiance",
    white: Annotated[
        float | None,
        typer.Option(
            help="PNG: the value that becomes white  [default: the image's maximum]", show_default=False
        ),
    ] = None,
    bits: Annotated[int, typer.Option(help="PNG: 8 or 16")] = 8,
    exposure: Annotated[
        float | None,
        typer.Option(
            help="PNG for the eye: 8 bits in sRGB's tones, image x 2^exposure, white at 1", show_default=False
        ),
    ] = None,
    error: Annotated[
        str | None,
        typer.Option(
            "--error",
            metavar="FILE",
            help=(
                "Where to write the estimated error of every pixel, in the image's unit, of a render within a"
                " tolerance"
            ),
            show_default=False,
        ),
    ] = None,
    backend: Backend = "auto",
    as_json: Json = False,
):
    """Render a depth map under a source."""
    _check_output(out, as_json)
    if error is not None:
        _check_output(error, as_json)
    if exposure is not None and (not out.lower().endswith(".png") or white is not None or bits != 8):
        raise typer.BadParameter(
            "makes an 8-bit .png for the eye: it goes without --white and --bits 16, and with no other"
            " format",
            param_hint="--exposure",
        )
    scene, raster = _scene(
        file, height, spacing, _reflectance(albedo, specular, exponent), nodata, sides, resample
    )
    with _working("rendering"):
        done = sl.render(
            scene,
            _source(source, lamp, window, sun, direct),
            method=method,
            tolerance=_tolerance(tolerance),
            backend=backend,
            quantity=quantity,
            hemicube=hemicube,
            filled=filled,
        )
    if error is not None and done.error is None:
        raise typer.BadParameter(
            "an error is estimated where a tolerance decides: it goes with --method auto, and without"
            " --hemicube and --stride",
            param_hint="--error",
        )
    image = done.image if exposure is None else io.tone_mapped(done.image, exposure)
    scale = _deliver(out, image, raster, range=None if white is None else (0.0, white), bits=bits)
    if error is not None:
        _deliver(error, done.error, raster)
    _report(done, out, as_json, shape=done.image.shape, range=scale)


@app.command()
def plan(
    file: File,
    height: Height = None,
    spacing: Spacing = None,
    albedo: Albedos = "0.8",
    specular: Specular = None,
    exponent: Exponent = None,
    nodata: Nodata = None,
    resample: Resample = False,
    source: Source = None,
    lamp: Lamp = None,
    window: Window = None,
    sun: Sun = None,
    sides: Sides = "open",
    tolerance: Tolerance = "1%",
    tail: Annotated[
        str | None,
        typer.Option(
            help="Bound on the 99.9th percentile of the error  [default: ten tolerances]", show_default=False
        ),
    ] = None,
    backend: Backend = "auto",
    as_json: Json = False,
):
    """Print the cheapest model of a scene within a tolerance, with a reason for every choice."""
    scene, _ = _scene(
        file, height, spacing, _reflectance(albedo, specular, exponent), nodata, sides, resample
    )
    with _working("planning"):
        made = sl.plan(
            scene,
            _source(source, lamp, window, sun),
            _tolerance(tolerance),
            backend,
            tail=None if tail is None else _tolerance(tail, "--tail"),
        )
    if as_json:
        print(json.dumps(_plain(made)))
        return
    table = Table(Column("choice", no_wrap=True), "taken", "why", title=f"{file}, within {tolerance}")
    for choice in made.choices:
        table.add_row(choice.what, choice.taken, escape(choice.why))
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(table)
    for text in made.beyond:
        console.print(f"Beyond the model: {escape(text)}")


@app.command()
def recover(
    file: Annotated[
        Path, typer.Argument(help="Image of radiance: .npy, .npz, grey .png or .tif", show_default=False)
    ],
    out: Out,
    albedo: Albedo = 0.8,
    spacing: Annotated[float, typer.Option(help="Distance between neighbouring nodes")] = 1.0,
    source: Source = None,
    lamp: Lamp = None,
    window: Window = None,
    sun: Sun = None,
    sides: Sides = "open",
    method: Annotated[
        str, typer.Option(help="robust: the surface whose image is nearest to this one | paper: carving")
    ] = "robust",
    near: Annotated[
        float | None, typer.Option(help="robust: the least depth  [default: 0]", show_default=False)
    ] = None,
    far: Annotated[
        float | None,
        typer.Option(help="robust: the greatest depth  [default: layers x spacing]", show_default=False),
    ] = None,
    max_seconds: Annotated[
        float | None, typer.Option(help="robust: stop with the best so far", show_default=False)
    ] = None,
    picture: Annotated[
        str | None,
        typer.Option(
            help=(
                "robust: PNG of image, relief, confidence and residual, without scales  [default: beside OUT]"
            ),
            show_default=False,
        ),
    ] = None,
    layers: Annotated[
        int, typer.Option(help="Greatest depth in spacings; paper: of the block that is carved")
    ] = 64,
    hemicube: Hemicube = 9,
    eps: Annotated[
        float,
        typer.Option(
            help="paper: stop a column when it is this close to the image, as a share of the image's maximum"
        ),
    ] = 0.02,
    stop: Annotated[
        str, typer.Option(help="paper: eps | sign: when the column becomes darker than the image")
    ] = "eps",
    white: Annotated[
        float | None,
        typer.Option(
            help="Radiance of a full-scale count, for integer files that skylamp did not write",
            show_default=False,
        ),
    ] = None,
    figure: Picture = None,
    backend: Backend = "auto",
    as_json: Json = False,
):
    """Recover depth from an image, with a picture of how far it is to be trusted. An .npz also holds
    confidence, candidates and the masks of ambiguous pixels and drilled columns; a .png holds depth in whole
    layers, 16 bit.
    """
    _check_output(out, as_json, figure)
    if picture is None and out != "-" and method == "robust":
        picture = str(Path(out).with_name(Path(out).stem + "_picture.png"))
    if picture is not None:
        io.writable(picture)
    image = _radiance(file, white)
    with _working("recovering" if method == "robust" else "carving") as progress:
        done = sl.recover(
            image,
            _source(source, lamp, window, sun),
            albedo=albedo,
            sides=sides,
            spacing=spacing,
            layers=layers,
            hemicube=hemicube,
            method=method,
            eps=eps,
            stop=stop,
            near=near,
            far=far,
            max_seconds=max_seconds,
            backend=backend,
            progress=progress,
        )
    more = {}
    if out.lower().endswith(".npz"):
        more = {
            "drilled": done.drilled,
            "confidence": done.confidence,
            "candidates": done.candidates,
            "ambiguous": done.ambiguous,
        }
    _deliver(out, done.depth, range=(0.0, 65535.0 * spacing), bits=16, name="depth", **more)
    if picture is not None:
        io.write(picture, _four(image, done, spacing), range=(0.0, 1.0))
    if figure:
        plot.save(plot.recovery(image, done), figure)
    _report(
        done,
        out,
        as_json,
        shape=done.depth.shape,
        drilled=int(np.count_nonzero(done.drilled)),
        picture=picture,
        confident=float(np.mean(done.confidence >= 0.5)),
        levels=[level._asdict() for level in done.levels],
    )


@app.command()
def horizon(
    file: File,
    out: MaybeOut = None,
    height: Height = None,
    spacing: Spacing = None,
    nodata: Nodata = None,
    resample: Resample = False,
    sides: Sides = "open",
    what: Annotated[
        str,
        typer.Option(help="sky-view-factor | openness | negative-openness | slopes, (azimuths, rows, cols)"),
    ] = "sky-view-factor",
    definition: Annotated[
        str, typer.Option(help="Of the sky-view factor: tilted | horizontal | solid_angle")
    ] = "tilted",
    azimuths: Annotated[int, typer.Option(help="Directions along which horizons are looked for")] = 64,
    max_distance: Annotated[
        float | None,
        typer.Option(
            help="Ground farther away does not count, in the unit of spacing  [default: the whole map]",
            show_default=False,
        ),
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="ROW,COL", help="The node that --plot shows", show_default=False)
    ] = None,
    picture: Picture = None,
    source: Annotated[
        str, typer.Option(help="The sky that --plot shows: sky | overcast | clear | cie1 to cie15 | FILE")
    ] = "sky",
    sun: Sun = None,
    backend: Backend = "auto",
    as_json: Json = False,
):
    """Horizons: sky-view factor, openness [rad] or slopes of the whole map, and the sky above one node as a
    picture.
    """
    _check_outputs(out, picture, as_json)
    if bool(at) != bool(picture):
        raise typer.BadParameter(
            "a node and its picture go together: --at ROW,COL --plot FILE", param_hint="--at"
        )
    kinds = {
        "sky-view-factor": lambda: sl.sky_view_factor(
            scene, definition, azimuths, engine.name, max_distance=max_distance
        ),
        "openness": lambda: sl.openness(scene, azimuths, engine.name, max_distance=max_distance),
        "negative-openness": lambda: sl.openness(
            scene, azimuths, engine.name, negative=True, max_distance=max_distance
        ),
        "slopes": lambda: sl.horizons(scene, azimuths, engine.name, max_distance=max_distance),
    }
    if what not in kinds:
        raise bad("--what", repr(what), " | ".join(kinds))
    node = at and _numbers(at, "--at", "ROW,COL")
    scene, raster = _scene(file, height, spacing, None, nodata, sides, resample)
    engine, shape, scale = select(backend), None, None
    with _working("looking for horizons"):
        found = kinds[what]() if out else None
        if picture:
            if any(n != int(n) for n in node):
                raise bad("--at", at, "two whole numbers")
            plot.save(
                plot.horizon(scene, *map(int, node), _source(source, None, None, sun), backend=engine.name),
                picture,
            )
    if out:
        shape = found.shape
        scale = _deliver(
            out,
            found,
            raster,
            range=(0.0, 1.0) if what == "sky-view-factor" else None,
            name=what.replace("-", "_"),
        )
    _tell(out, picture, as_json, engine.name, shape=shape, range=scale, what=what if out else None)


@app.command()
def field(
    file: File,
    out: MaybeOut = None,
    height: Height = None,
    spacing: Spacing = None,
    nodata: Nodata = None,
    resample: Resample = False,
    albedo: Albedo = 0.8,
    source: Source = None,
    lamp: Lamp = None,
    window: Window = None,
    sun: Sun = None,
    sides: Sides = "open",
    hemicube: Hemicube = 9,
    layers: Annotated[
        int | None,
        typer.Option(
            help="Layers of free space, from z = 0  [default: down to the deepest node]", show_default=False
        ),
    ] = None,
    layer: Annotated[
        int | None, typer.Option(help="Write this layer alone, (rows, cols)", show_default=False)
    ] = None,
    picture: Picture = None,
    row: Annotated[
        int | None,
        typer.Option(help="The row that --plot cuts along  [default: the middle one]", show_default=False),
    ] = None,
    backend: Backend = "auto",
    as_json: Json = False,
):
    """The visibility field: the solid angle [sr] of the source in sight, for every point of free space,
    (layers, rows, cols); as a picture, the rays through points of one row.
    """
    _check_outputs(out, picture, as_json)
    if out and layer is None and out.lower().endswith(".png"):
        raise typer.BadParameter(
            "a .png holds one layer: give --layer, or write .npy, .npz or .tif", param_hint="--out"
        )
    scene, raster = _scene(
        file, height, spacing, None if albedo is None else sl.Lambertian(albedo), nodata, sides, resample
    )
    shape = scale = None
    with _working("propagating") as progress:
        done = sl.visibility_field(
            scene,
            _source(source, lamp, window, sun),
            hemicube=hemicube,
            layers=layers,
            backend=backend,
            progress=progress,
        )
        angle = done.solid_angle() if out else None
        if picture:
            plot.save(plot.field(done, row, backend=done.backend), picture)
    if out:
        if layer is not None:
            if not 0 <= layer < len(angle):
                raise bad("--layer", layer, f"0 to {len(angle) - 1}")
            angle = angle[layer]
        shape, scale = angle.shape, _deliver(out, angle, raster, range=(0.0, 2 * np.pi), name="solid_angle")
    _tell(out, picture, as_json, done.backend, shape=shape, range=scale)


@app.command()
def chart(
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for chart.png (needs matplotlib) and chart.csv; created if need be",
            show_default=False,
        ),
    ],
    backend: Annotated[
        str, typer.Option(help="Names with commas between  [default: all that are here]", show_default=False)
    ] = "",
    sizes: Annotated[str, typer.Option(help="Rows and columns of the maps")] = "128,512",
    as_json: Json = False,
):
    """Speed against accuracy of every method and backend on this machine, and where plans stand."""
    import csv

    from . import chart as charts

    try:
        many = [int(part) for part in sizes.split(",")]
    except ValueError:
        raise typer.BadParameter(
            f"got {sizes!r}; allowed: whole numbers with commas between", param_hint="--sizes"
        ) from None
    folder = io.folder(out)
    with _working("measuring") as progress:
        rows = charts.measure([name for name in backend.split(",") if name] or None, many, progress=progress)
    with open(folder / "chart.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    try:
        charts.draw(rows, folder / "chart.png")
    except ImportError:
        print(
            "skylamp: warning: no chart.png without matplotlib: pip install 'skylamp[plot]'", file=sys.stderr
        )
    if as_json:
        print(json.dumps(_plain({"out": str(folder), "points": rows, "behind": charts.behind(rows)})))
    else:
        for kind, times in charts.behind(rows).items():
            print(
                f"{kind}: the default takes "
                + ", ".join(f"{ratio:.2g} ({100 * t:g} %)" for ratio, t in zip(times, charts.TOLERANCES))
                + " times as long as the quickest setting within its tolerance",
                file=sys.stderr,
            )
        print(f"{folder / 'chart.png'}: {len(rows)} points", file=sys.stderr)


@app.command()
def backends(as_json: Json = False):
    """List the backends: name, device, and why one is not available."""
    with _working("looking for devices"):
        found = sl.backends()
    if as_json:
        print(json.dumps({"backends": [_plain(b) for b in found]}))
        return
    table = Table("backend", "device", "available", "why not")
    for b in found:
        table.add_row(b.name, b.device, "yes" if b.available else "no", b.why)
    Console(width=None if sys.stdout.isatty() else 160).print(table)


@app.command()
def selftest(as_json: Json = False):
    """Compare every available backend with every other on a built-in case; exit 1 if two differ."""
    with _working("comparing") as progress:
        compared = run_selftest(progress)
    names = [b.name for b in sl.backends() if b.available]
    wrong = [c for c in compared if not c.passed]
    if as_json:
        print(
            json.dumps(
                {
                    "backends": names,
                    "passed": not wrong,
                    "comparisons": [{**_plain(c), "passed": c.passed} for c in compared],
                }
            )
        )
    else:
        pairs = list(dict.fromkeys((c.one, c.other) for c in compared))
        table = Table(
            "case",
            *(f"{one} / {other}" for one, other in pairs),
            "allowed",
            title="Largest difference, as a share of the largest value",
        )
        for case in dict.fromkeys(c.case for c in compared):
            row = [c for c in compared if c.case == case]
            shown = {
                (c.one, c.other): (
                    "failed" if c.difference is None else f"{c.difference:.1e}" if c.difference else "0"
                )
                for c in row
            }
            table.add_row(
                case,
                *(
                    shown[p] + ("" if next(c for c in row if (c.one, c.other) == p).passed else "  DIFFERS")
                    for p in pairs
                ),
                f"{row[0].allowed:.0e}" if row[0].allowed else "0",
            )
        Console(width=None if sys.stdout.isatty() else 160).print(
            table if pairs else f"Only {', '.join(names)} is here: nothing to compare."
        )
    for reason in dict.fromkeys(c.error for c in wrong if c.error):
        print(f"skylamp: {reason}", file=sys.stderr)
    if wrong:
        raise typer.Exit(1)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option(help="Folder for the pictures; created if need be", show_default=False)
    ],
    backend: Backend = "auto",
    as_json: Json = False,
):
    """Real mountains under two skies and a lamp, depth recovered from a picture, and every backend beside the
    others.
    """
    select(backend)  # a name that is not there shall leave nothing behind
    folder = io.folder(out)
    with _working("demo") as progress:
        stages = iter(range(1, 7))
        step = lambda: progress and progress(next(stages), 6)
        pictures, panel = [], []

        def show(name, image, low, high, gamma, text):
            """One 8-bit picture: low is black, high is white, ((v - low) / (high - low))^(1 / gamma) between
            them.
            """
            tone = np.clip((image - low) / (high - low), 0, 1) ** (1 / gamma)
            io.write(folder / name, tone, range=(0.0, 1.0))
            panel.append(tone)
            pictures.append(
                {"file": name, "shows": text, "black": float(low), "white": float(high), "gamma": gamma}
            )

        height, spacing = io.terrain()
        compared = _compare(
            sl.Scene.from_height(height[100:228, 130:258], spacing=spacing)
        )  # before the rest: it tells what compiling takes
        step()
        mountains = sl.Scene.from_height(EXAGGERATION * height, spacing=spacing)
        lamp = sl.Lamp(center=tuple(spacing * v for v in LAMP[:3]), radius=spacing * LAMP[3])
        renderings = []
        for name, source, hemicube, text in (
            ("uniform_sky", sl.Sky(), 9, "uniform sky"),
            ("overcast_sky", sl.Sky(sl.cie_overcast()), 9, "CIE overcast sky"),
            (
                "low_lamp",
                lamp,
                33,
                f"a lamp, radius {LAMP[3]} nodes, {-LAMP[2]} nodes above the highest peak",
            ),
        ):
            done = sl.render(
                mountains, source, method="lattice", hemicube=hemicube, filled=True, backend=backend
            )
            renderings.append(done)
            if source is lamp:
                low, high, gamma = 0.0, np.percentile(done.image, 99), 2.2
            else:  # white is what open level ground would send, so that the two skies compare
                level = sl.render(
                    sl.Scene(np.zeros((1, 1))), source, method="lattice", hemicube=hemicube, backend=backend
                ).image[0, 0]
                low, high, gamma = 0.3 * level, level, 1.0
            show(
                f"jacksboro_x{EXAGGERATION}_{name}.png",
                done.image,
                low,
                high,
                gamma,
                f"Jacksboro fault, heights x {EXAGGERATION}, under {text}",
            )
            step()

        depth = _relief()
        seen = sl.render(sl.Scene(depth, sides="dark"), sl.Sky(), backend=backend)
        step()
        found = sl.recover(seen.image, sl.Sky(), sides="dark", backend=backend)
        step()
        error = float(np.sqrt(np.mean((found.depth - depth) ** 2)))
        show(
            "relief_rendered.png",
            seen.image,
            0.0,
            seen.image.max(),
            1.0,
            "folds in a black box under a uniform sky",
        )
        for name, z, text in (
            (
                "relief_recovered.png",
                found.depth,
                (
                    f"depth recovered from that picture, near is bright; off by {error:.2g} RMS in a relief"
                    f" of {np.ptp(depth):.0f}"
                ),
            ),
            ("relief_true.png", depth, "its true depth, same scale"),
        ):
            show(name, -z, -depth.max(), -depth.min(), 1.0, text)
        io.write(folder / "panel.png", _panel(panel), range=(0.0, 1.0))
        pictures.append({"file": "panel.png", "shows": "all of them"})
    used = renderings[0].backend
    if as_json:
        print(
            json.dumps(
                _plain(
                    {
                        "out": str(folder),
                        "backend": used,
                        "pictures": pictures,
                        "seconds": [r.seconds for r in renderings],
                        "compile_seconds": [r.compile_seconds for r in renderings],
                        "backends": compared,
                    }
                )
            )
        )
        return
    console = Console(stderr=True, width=None if sys.stderr.isatty() else 160)
    table = Table(
        Column("picture", no_wrap=True),
        "shows",
        "black",
        "white",
        "gamma",
        title=f"Pictures in {escape(str(folder))}, made by {used}",
    )
    for picture in pictures:
        table.add_row(
            picture["file"],
            picture["shows"],
            *(f"{picture[k]:.3g}" if k in picture else "" for k in ("black", "white", "gamma")),
        )
    console.print(table)
    table = Table(
        "backend",
        "device",
        "compile [s]",
        "run [s]",
        "bits as numpy",
        "radiance off by",
        title="128 x 128 nodes, 209 directions, beside NumPy",
    )
    for row in compared:
        if row["available"]:
            table.add_row(
                row["name"],
                row["device"],
                f"{row['compile_seconds']:.2f}",
                f"{row['seconds']:.4f}",
                "all" if row["bits_equal"] else "NO",
                f"{row['difference']:.1e}",
            )
        else:
            table.add_row(row["name"], row["device"], escape(row["why"]))
    console.print(table)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit; ``arguments`` default to the process's own."""
    for library, level in (
        ("tifffile", logging.ERROR),
        ("rasterio", logging.CRITICAL),
    ):  # what they log would stand beside our one line
        logging.getLogger(library).setLevel(level)
    try:
        app(arguments, prog_name="skylamp")
    except Exception as error:
        if _debug:
            traceback.print_exc()
        known = isinstance(error, (SkylampError, OSError))
        text = (
            " ".join(str(error).split())
            if known
            else f"{type(error).__name__}: {' '.join(str(error).split())} (--debug shows where)"
        )
        print(f"skylamp: error: {text}", file=sys.stderr)
        sys.exit(3 if isinstance(error, InputError) else 4 if isinstance(error, BackendError) else 1)
    sys.exit(0)


def _scene(file, height, spacing, reflectance, nodata, sides, resample=False):
    """(scene, the raster that the file is if it is a GeoTIFF)."""
    raster = geo.read(file, resample=resample) if geo.is_geotiff(file) else None
    if resample and raster is None:
        raise typer.BadParameter(f"{file} is not a GeoTIFF", param_hint="--resample")
    height = raster is not None if height is None else height
    with _muted(file):
        values = io.read(file, "height" if height else "depth") if raster is None else raster.values
    mask = None if raster is None or raster.mask.all() else raster.mask
    if nodata is not None:
        known = ~np.isnan(values) if np.isnan(nodata) else values != nodata
        mask = known if mask is None else mask & known
    if raster is not None and not height:
        values = np.where(raster.mask, values, 0)
    spacing = spacing if spacing is not None else 1.0 if raster is None else raster.spacing
    return (sl.Scene.from_height if height else sl.Scene)(
        values, spacing=spacing, mask=mask, sides=sides, reflectance=reflectance
    ), raster


def _reflectance(albedo, specular, exponent):
    if specular is None:
        if exponent is not None:
            raise typer.BadParameter("goes with --specular", param_hint="--exponent")
        return sl.Lambertian(_share(albedo, "--albedo"))
    albedo, specular = _share(albedo, "--albedo"), _share(specular, "--specular")
    return (
        sl.Mirror(specular, albedo)
        if exponent == np.inf
        else sl.Phong(albedo, specular, 20.0 if exponent is None else exponent)
    )


def _share(text, option):
    return _numbers(text, option, "R,G,B") if "," in text else _numbers(text, option, "A")[0]


def _source(kind, lamp, window, sun=None, direct=0.0):
    kind = kind or ("lamp" if lamp else "window" if window else "sky")
    for name, given in (("lamp", lamp), ("window", window)):
        if bool(given) != (kind == name):
            raise typer.BadParameter(
                f"--{name} goes with --source {name}: got --source {kind}"
                + ("" if given else f" without --{name}"),
                param_hint=f"--{name}",
            )
    cie = re.fullmatch("clear|cie([0-9]+)", kind)
    if (sun or direct) and not cie:
        raise typer.BadParameter(
            f"goes with --source clear or cie1 to cie15: got --source {kind}",
            param_hint="--sun" if sun else "--direct",
        )
    if kind == "lamp":
        x, y, z, radius = _numbers(lamp, "--lamp", "X,Y,Z,R")
        return sl.Lamp(center=(x, y, z), radius=radius)
    if kind == "window":
        x0, x1, y0, y1 = _numbers(window, "--window", "X0,X1,Y0,Y1")
        return sl.Window(x=(x0, x1), y=(y0, y1))
    if kind == "sky":
        return sl.Sky()
    if kind == "overcast":
        return sl.Sky(sl.cie_overcast())
    if cie:
        return sl.Sky(sl.cie_sky(int(cie[1] or 12), None if sun is None else _sun(sun), direct=direct))
    if not Path(kind).exists():
        raise bad(
            "--source",
            repr(kind),
            "sky, overcast, clear, cie1 to cie15, lamp, window, or an existing file (an environment map)",
        )
    with _muted(kind):
        return sl.Sky(sl.environment_map(io.read_environment(kind)))


def _sun(text):
    """(azimuth, elevation) [degree] of --sun, given as such or by time and place."""
    if text.count(",") == 2:
        time, place = text.split(",", 1)
        azimuth, elevation = sl.sun_position(time, *_numbers(place, "--sun", "LAT,LON"))
        if elevation < 0:
            raise bad(f"--sun {text}", f"a sun {-elevation:.1f} degrees below the horizon", "a time of day")
        return azimuth, elevation
    return tuple(_numbers(text, "--sun", "AZ,EL"))


def _tolerance(text, option="--tolerance"):
    """A share of one: 0.01 or 1%."""
    try:
        return float(text[:-1]) / 100 if text.endswith("%") else float(text)
    except ValueError:
        raise typer.BadParameter(
            f"got {text!r}; allowed: a number above 0, such as 0.01 or 1%", param_hint=option
        ) from None


def _numbers(text, option, form):
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len(form.split(",")):
        raise typer.BadParameter(
            f"got {text!r}; allowed: {form}, numbers with commas between", param_hint=option
        )
    return numbers


def _radiance(file, white):
    """The image in ``file`` as radiance: counts need a scale, the file's own or --white; floating values are
    radiance already.
    """
    with _muted(file):
        image = io.read(file, "image")
    if image.dtype.kind == "f":
        if white is not None:
            raise typer.BadParameter(
                f"{file} holds floating values, which are radiance as they are", param_hint="--white"
            )
        return image
    low, high = (0.0, white) if white is not None else io.read_range(file) or (None, None)
    if high is None or image.dtype.kind != "u":
        raise bad(
            f"{file}: counts without a scale",
            image.dtype,
            "floating values, or unsigned counts with a scale",
            "Give --white, the radiance of a full-scale count.",
        )
    return low + image * ((high - low) / np.iinfo(image.dtype).max)


def _check_outputs(out, picture, as_json):
    if not out and not picture:
        raise typer.BadParameter("nothing to do: give --out FILE, --plot FILE or both", param_hint="--out")
    _check_output(out or "-", as_json and bool(out), picture)


def _check_output(out, as_json, picture=None):
    """Before any work is done: can the result be put there?"""
    if picture is not None:
        plot.drawable(picture)
    if out != "-":
        io.writable(out)
    elif as_json:
        raise typer.BadParameter(
            "stdout holds either the data or the JSON object: give --out a file", param_hint="--out"
        )


def _deliver(out, array, raster=None, **options):
    if raster is not None and out.lower().endswith((".tif", ".tiff")):
        return geo.write(out, array, raster)
    if out != "-":
        return io.write(out, array, **options)
    np.save(sys.stdout.buffer, array, allow_pickle=False)
    sys.stdout.flush()


@contextlib.contextmanager
def _muted(path):
    """Off the process's own stderr while an .exr or .hdr is read: OpenEXR and OpenCV tell it about damage,
    and our one line does too.
    """
    if not str(path).lower().endswith(io.HDR):
        yield
        return
    sys.stderr.flush()
    kept = os.dup(2)
    nothing = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


@contextlib.contextmanager
def _working(title):
    """Progress for the library, progress(done, total), as a bar on stderr if that is a terminal, else None.
    What libraries print goes to stderr too.
    """
    import warp

    # No banner, no line per module: here, because a library must not decide that for its user. Older Warps
    # have no levels.
    warp.config.log_level = getattr(warp, "LOG_WARNING", None)
    with contextlib.redirect_stdout(sys.stderr):
        if not sys.stderr.isatty():
            yield None
            return
        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(title, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)


def _report(done, out, as_json, **facts):
    """One line about the result on stderr, or everything as JSON on stdout; the library's warnings on stderr
    either way.
    """
    known = {
        name: getattr(done, name)
        for name in ("plan", "backend", "seconds", "compile_seconds")
        if hasattr(done, name)
    }
    facts = {"out": out, **known, **facts, "warnings": getattr(done, "warnings", [])}
    for warning in facts["warnings"]:
        print(f"skylamp: warning: {warning}", file=sys.stderr)
    if as_json:
        print(json.dumps(_plain(facts)))
    else:
        scale = f", white is {facts['range'][1]:.6g}" if facts.get("range") else ""
        plan = f"; {done.plan.line}" if "plan" in facts else ""
        print(
            f"{out}: {' x '.join(map(str, facts['shape']))} by {done.backend}{scale}{plan}", file=sys.stderr
        )


def _tell(out, picture, as_json, backend, shape=None, range=None, **facts):
    """What was written where, for commands that may write an array, a picture or both."""
    if as_json:
        print(
            json.dumps(
                _plain(
                    {
                        "out": out,
                        "plot": picture and str(picture),
                        "backend": backend,
                        "shape": shape,
                        "range": range,
                        **facts,
                    }
                )
            )
        )
        return
    if out:
        print(
            f"{out}: {' x '.join(map(str, shape))} by {backend}"
            + (f", white is {range[1]:.6g}" if range else ""),
            file=sys.stderr,
        )
    if picture:
        print(f"{picture}: drawn, by {backend}", file=sys.stderr)


def _plain(value):
    """``value`` as JSON knows it."""
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value


def _relief():
    """The folds of a drapery, (100, 100) depth in nodes."""
    y, x = np.mgrid[:100, :100] / 99.0
    return 16 + 24 * np.sin(2 * np.pi * (1.6 * x + 0.2 * np.sin(2 * np.pi * y))) ** 2


def _panel(pictures):
    """Two rows of three, the small ones enlarged to whole multiples, on grey."""
    rows, cols = pictures[0].shape
    sheet = np.full((2 * rows + 30, 3 * cols + 40), 0.5)
    for number, picture in enumerate(pictures):
        times = min(rows // picture.shape[0], cols // picture.shape[1])
        picture = np.kron(picture, np.ones((times, times)))
        top = 10 + (rows + 10) * (number // 3) + (rows - picture.shape[0]) // 2
        left = 10 + (cols + 10) * (number % 3) + (cols - picture.shape[1]) // 2
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def _four(image, done, spacing):
    """Side by side, on grey: the image, the depth as a relief under a low lamp, the confidence, and |model -
    image| from 0 to a tenth of the image.
    """
    rows, cols = done.depth.shape
    size, depth = max(rows, cols) * spacing, done.depth - done.depth.min()
    lamp = sl.Lamp(center=(-size, -size, -1.5 * size), radius=size / 4)
    relief = sl.render(sl.Scene(depth, spacing), lamp, backend=done.backend).image
    scaled = lambda values, white: np.clip(values / max(float(white), 1e-30), 0, 1)
    pictures = [
        scaled(image, image.max()),
        scaled(relief, np.percentile(relief, 99)),
        done.confidence,
        scaled(np.abs(done.residual), 0.1 * image.max()),
    ]
    times = max(1, 256 // max(rows, cols))
    sheet = np.full((rows * times + 20, 4 * (cols * times + 10) + 10), 0.5)
    for number, values in enumerate(pictures):
        left = 10 + number * (cols * times + 10)
        sheet[10 : 10 + rows * times, left : left + cols * times] = np.kron(values, np.ones((times, times)))
    return sheet


def _compare(scene):
    """Every backend on one small scene: seconds of compiling and of a second call, and how far it is from
    NumPy.
    """
    image = sl.render(scene, sl.Sky(), method="lattice", hemicube=9, backend="numpy").image
    bits = sl.visibility(scene, sl.Sky(), hemicube=9, backend="numpy")
    table = []
    for b in sl.backends():
        row = {"name": b.name, "device": b.device, "available": b.available, "why": b.why}
        if b.available:
            first, again = (
                sl.render(scene, sl.Sky(), method="lattice", hemicube=9, backend=b.name) for _ in range(2)
            )
            same = np.array_equal(sl.visibility(scene, sl.Sky(), hemicube=9, backend=b.name), bits)
            row |= {
                "compile_seconds": first.compile_seconds,
                "seconds": again.seconds,
                "bits_equal": same,
                "difference": float(np.abs(again.image - image).max()),
            }
        table.append(row)
    return table


if __name__ == "__main__":
    main()
