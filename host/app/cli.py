"""The command line: `skylamp render | plan | recover | horizon | field | chart | view | backends | doctor |
selftest | demo`.

Data go to files or to stdout; messages, progress and errors go to stderr. Exit codes: 0 ok, 2 usage, 3 bad
input, 4 backend unavailable, 1 the rest. An error is one line; --debug adds the traceback.
"""

from __future__ import annotations

import csv
import logging
import os
import sys
import traceback
import warnings
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import typer
from rich.table import Column, Table

import skylamp as sl

from .. import io
from ..backends import select
from ..errors import BackendError, InputError, SkylampError, bad
from ..io import geotiff as geo
from ..io.paths import replacing_file
from . import chart as charts
from . import demo as demos
from . import mosaic, out_of_core, output, parsing, plot
from . import options as opt
from . import view as views
from .doctor import examined
from .examples import epilog
from .selftest import Check, Comparison, checks
from .selftest import selftest as run_selftest

app = typer.Typer(
    name="skylamp",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Render depth and height maps under skies, lamps and windows, and recover depth from images.",
)
_debug = False


def _print_version(asked: bool) -> None:
    if asked:
        print(f"skylamp {sl.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit"),
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Print the traceback of an error")] = False,
) -> None:
    global _debug
    _debug, output.quiet = debug, False


IN_TILES = (  # options of an image that is made tile by tile
    "--albedo, --source, --sun, --horizontal, --direct, --quantity, --method, --tolerance, --azimuths,"
    " --max-distance, --interreflection"
)


@app.command(epilog=epilog("render"))
def render(
    file: opt.File,
    target: opt.Target = None,
    out: opt.Out = None,
    height: opt.Height = None,
    spacing: opt.Spacing = None,
    albedo: opt.Albedos = "0.8",
    specular: opt.Specular = None,
    exponent: opt.Exponent = None,
    nodata: opt.Nodata = None,
    resample: opt.Resample = False,
    source: opt.Source = None,
    lamp: opt.Lamp = None,
    window: opt.Window = None,
    sun: opt.Sun = None,
    horizontal: opt.Horizontal = None,
    direct: opt.Direct = 0.0,
    sides: opt.Sides = "open",
    method: opt.Method = "auto",
    tolerance: opt.RenderTolerance = None,
    tail: opt.Tail = None,
    azimuths: opt.FixedAzimuths = None,
    max_distance: opt.MaxDistance = None,
    hemicube: opt.LatticeHemicube = None,
    filled: opt.Filled = None,
    quantity: opt.Quantity = "radiance",
    interreflection: opt.Interreflection = "auto",
    white: opt.PngWhite = None,
    bits: opt.Bits = 8,
    exposure: opt.Exposure = None,
    error: opt.ErrorFile = None,
    memory: opt.Memory = None,
    workers: opt.Workers = 1,
    scheduler: opt.Scheduler = None,
    tile: opt.Tile = None,
    resume: opt.Resume = False,
    cog: opt.Cog = False,
    backend: opt.Backend = "auto",
    as_json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Render a depth map under a source."""
    out = output.needed((file, source), target, out, error)
    output.check(out, as_json, error=error)
    machines = out_of_core.Machines(memory, workers, scheduler, tile, resume, cog)
    _check_png(exposure, out, white, bits)
    surface = parsing.reflectance(albedo, specular, exponent)
    light = parsing.source(source, lamp, window, sun, direct, horizontal, file=file)
    asked = method != "auto" or azimuths or max_distance or hemicube or filled is not None
    between = parsing.INTERREFLECTION[interreflection]
    options: dict[str, Any] = dict(
        method=method,
        tolerance=_tolerance(tolerance, asked, between),
        tail=None if tail is None else parsing.tolerance(tail, "--tail"),
        azimuths=azimuths,
        max_distance=max_distance,
        quantity=quantity,
        hemicube=hemicube,
        filled=filled,
        interreflection=between,
    )
    if machines.asked:
        to_read = height is False, nodata, resample, sides != "open"
        others = *to_read, white, bits != 8, exposure, error
        out_of_core.checked_output(IN_TILES, out, others)
        words = dict(albedo=albedo, source=source, sun=sun, direct=direct, horizontal=horizontal)
        work = out_of_core.image(file, surface, light, backend, words, spacing, **options)
        return _by_tiles(file, out, work, machines, as_json)
    scene, raster = parsing.scene(file, height, spacing, surface, nodata, sides, resample)
    parsing.check_place(light, raster)
    with output.progress_bar("rendering"):
        done = sl.render(scene, light, backend=backend, **options)
    white_range = None if white is None else (0.0, white)
    _write_image(done, out, error, raster, exposure, as_json, range=white_range, bits=bits)


def _write_image(
    done: sl.Rendering,
    out: str,
    error: str | None,
    raster: geo.Raster | None,
    exposure: float | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Write an image, and its error if that is asked for, and report them; ``options`` of a PNG."""
    if error is not None and done.error is None:
        raise typer.BadParameter(
            "the error is estimated where a tolerance chooses the method, of diffuse light: it requires"
            " --method auto without --hemicube, --stride and --azimuths, and an albedo above 0",
            param_hint="--error",
        )
    image = done.image if exposure is None else io.tone_mapped(done.image, exposure)
    scale = output.write(out, image, raster, **options)
    if error is not None:
        output.write(error, done.error, raster)
    output.report(done, out, as_json, shape=done.image.shape, range=scale)


def _tolerance(given: str | None, asked: Any, interreflection: bool | str) -> float:
    """--tolerance; BadParameter where it is given to a method that is asked for, which keeps to none."""
    if given is not None and asked and interreflection is not True:
        raise typer.BadParameter(
            "goes with --method auto, without --azimuths, --max-distance, --hemicube and --stride, or with"
            " --interreflection on",
            param_hint="--tolerance",
        )
    return parsing.tolerance(given or "1%")


def _check_png(exposure: float | None, out: str, white: float | None, bits: int) -> None:
    if white is not None and not 0 < white < np.inf:
        raise bad("--white", white, "the finite value of the largest count, 0 that of 0: low < high")
    if bits not in (8, 16):
        raise bad("--bits", bits, "8 or 16")
    is_png, counts = out.lower().endswith(".png"), {"--white": white is not None, "--bits": bits != 8}
    if exposure is not None and (not is_png or any(counts.values())):
        raise typer.BadParameter(
            "makes an 8-bit .png for the eye: it goes without --white and --bits 16, and with no other"
            " format",
            param_hint="--exposure",
        )
    if exposure is not None:
        io.tone_mapped(0.0, exposure)  # an exposure that is none is refused before any work
    for option, given in counts.items():
        if given and not is_png:
            raise typer.BadParameter("is of a .png; other formats hold radiance as it is", param_hint=option)


def _by_tiles(
    file: Path,
    out: str,
    work: out_of_core.Computation,
    machines: out_of_core.Machines,
    as_json: bool,
    **facts: Any,
) -> None:
    """Compute and write a quantity of a GeoTIFF tile by tile, and report it."""
    with output.warnings_told() as told, output.progress_bar("computing tiles") as progress:
        shape, backend = out_of_core.write_quantity(file, out, work, machines, progress)
    output.report_array_or_picture(out, None, as_json, backend, shape=shape, warnings=told, **facts)


@app.command(epilog=epilog("plan"))
def plan(
    file: opt.File,
    height: opt.Height = None,
    spacing: opt.Spacing = None,
    albedo: opt.Albedos = "0.8",
    specular: opt.Specular = None,
    exponent: opt.Exponent = None,
    nodata: opt.Nodata = None,
    resample: opt.Resample = False,
    source: opt.Source = None,
    lamp: opt.Lamp = None,
    window: opt.Window = None,
    sun: opt.Sun = None,
    horizontal: opt.Horizontal = None,
    direct: opt.Direct = 0.0,
    sides: opt.Sides = "open",
    tolerance: opt.Tolerance = "1%",
    tail: opt.Tail = None,
    interreflection: opt.Interreflection = "auto",
    backend: opt.Backend = "auto",
    as_json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Print the cheapest model of a scene within a tolerance, with a reason for every choice."""
    surface = parsing.reflectance(albedo, specular, exponent)
    scene, raster = parsing.scene(file, height, spacing, surface, nodata, sides, resample)
    light = parsing.source(source, lamp, window, sun, direct, horizontal, file=file)
    parsing.check_place(light, raster)
    with output.progress_bar("planning"):
        made = sl.plan(
            scene,
            light,
            parsing.tolerance(tolerance),
            backend,
            tail=None if tail is None else parsing.tolerance(tail, "--tail"),
            interreflection=parsing.INTERREFLECTION[interreflection],
        )
    if as_json:
        output.print_json(made)
        return
    table = Table(Column("choice", no_wrap=True), "taken", "why", title=f"{file}, within {tolerance}")
    for choice in made.choices:
        table.add_row(choice.what, choice.taken, choice.why)
    console = output.console()
    console.print(table)
    for text in made.beyond:
        console.print(f"Beyond the model: {text}")


@app.command(epilog=epilog("recover"))
def recover(
    file: opt.Image,
    target: opt.Target = None,
    out: opt.Out = None,
    albedo: opt.Albedo = 0.8,
    spacing: opt.Spacing = None,
    resample: opt.Resample = False,
    source: opt.Source = None,
    lamp: opt.Lamp = None,
    window: opt.Window = None,
    sun: opt.Sun = None,
    sides: opt.Sides = "open",
    method: opt.RecoverMethod = "robust",
    near: opt.Near = None,
    far: opt.Far = None,
    mask: opt.ImageMask = None,
    max_seconds: opt.MaxSeconds = None,
    picture: opt.RecoveryPicture = None,
    std: opt.StdFile = None,
    layers: opt.Layers = 64,
    interreflection: opt.Interreflection = "auto",
    hemicube: opt.Hemicube = 9,
    eps: opt.Eps = 0.02,
    stop: opt.Stop = "eps",
    white: opt.CountWhite = None,
    figure: opt.Plot = None,
    backend: opt.Backend = "auto",
    as_json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Recover depth from an image, with a picture of its confidence. An .npz also holds
    confidence, standard deviation (robust), candidates and the masks of ambiguous pixels and drilled columns;
    a .png holds depth in whole layers, 16 bit.
    """
    out = output.needed((file, source), target, out)
    output.check(out, as_json, figure, std)
    if std is not None and method != "robust":
        raise typer.BadParameter("it goes with --method robust", param_hint="--std")
    picture = _checked_picture(picture, out, method)
    output.check_apart((file, source, mask), out, std, picture, figure)
    image, raster = parsing.radiance(file, white, resample, spacing)
    known = parsing.where_known(image, raster, mask)
    spacing = parsing.spacing_of(spacing, raster)
    light = parsing.source(source, lamp, window, sun, file=file)
    parsing.check_place(light, raster)
    options: dict[str, Any] = dict(albedo=albedo, sides=sides, layers=layers, hemicube=hemicube, eps=eps)
    options |= dict(stop=stop, near=near, far=far, max_seconds=max_seconds, backend=backend)
    with output.progress_bar("recovering" if method == "robust" else "carving") as progress:
        done = sl.recover(
            image,
            light,
            spacing=spacing,
            method=method,
            interreflection=parsing.INTERREFLECTION[interreflection],
            mask=known,
            progress=progress,
            **options,
        )
    image = image if known is None else np.where(known, image, np.nan)
    kept = ("drilled", "confidence", "candidates", "ambiguous", *(["std"] if method == "robust" else []))
    more = {name: getattr(done, name) for name in kept if out.lower().endswith(".npz")}
    output.write(out, done.depth, raster, range=(0.0, 65535.0 * spacing), bits=16, name="depth", **more)
    if std is not None:
        output.write(std, done.std, raster)
    if picture is not None:
        io.write(picture, mosaic.of_recovery(image, done, spacing), range=(0.0, 1.0))
    if figure:
        plot.save(plot.recovery(image, done), figure)
    output.report(
        done,
        out,
        as_json,
        shape=done.depth.shape,
        drilled=int(np.count_nonzero(done.drilled)),
        picture=picture,
        std=std,
        confident=float(np.mean(done.confidence >= 0.5)),
        levels=[level._asdict() for level in done.levels],
    )


def _checked_picture(given: str | None, out: str, method: str) -> str | None:
    """The picture of a recovery: as given, or beside its output."""
    if given is None and (out == "-" or method != "robust"):
        return None
    picture = given or str(Path(out).with_suffix("")) + "_picture.png"
    if not picture.lower().endswith(".png"):
        raise typer.BadParameter(f"got {picture!r}; allowed: a .png", param_hint="--picture")
    io.writable(picture)
    return picture


@app.command(epilog=epilog("horizon"))
def horizon(
    file: opt.File,
    target: opt.Target = None,
    out: opt.MaybeOut = None,
    height: opt.Height = None,
    spacing: opt.Spacing = None,
    nodata: opt.Nodata = None,
    resample: opt.Resample = False,
    sides: opt.Sides = "open",
    what: opt.What = "sky-view-factor",
    definition: opt.Definition = "tilted",
    azimuths: opt.Azimuths = 64,
    max_distance: opt.MaxDistance = None,
    at: opt.At = None,
    picture: opt.Plot = None,
    source: opt.PlotSky = "sky",
    sun: opt.Sun = None,
    memory: opt.Memory = None,
    workers: opt.Workers = 1,
    scheduler: opt.Scheduler = None,
    tile: opt.Tile = None,
    resume: opt.Resume = False,
    cog: opt.Cog = False,
    backend: opt.Backend = "auto",
    as_json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Compute horizons: sky-view factor, openness [rad] or slopes of the map; draw the sky above one node."""
    out = output.either((file, source), target, out, picture)
    output.check_array_or_picture(out, picture, as_json)
    if bool(at) != bool(picture):
        raise typer.BadParameter(
            "a node and its picture go together: --at ROW,COL --plot FILE", param_hint="--at"
        )
    if definition != "tilted" and what != "sky-view-factor":
        raise typer.BadParameter("is one of sky-view factors", param_hint="--definition")
    if not picture and (source != "sky" or sun):
        raise typer.BadParameter(
            "the sky above a node is drawn with --at ROW,COL --plot FILE", param_hint="--source"
        )
    if not out and (what, definition, azimuths) != ("sky-view-factor", "tilted", 64):
        raise typer.BadParameter(
            "are of OUTPUT, not of --plot", param_hint="--what, --definition, --azimuths"
        )
    machines = out_of_core.Machines(memory, workers, scheduler, tile, resume, cog)
    if machines.asked:
        others = picture, height is False, nodata, resample, sides != "open"
        out = out_of_core.checked_output("--what, --definition, --azimuths, --max-distance", out, others)
        work = out_of_core.horizon(what, definition, azimuths, max_distance, backend, spacing)
        return _by_tiles(file, out, work, machines, as_json, what=what)
    quantities = {
        "sky-view-factor": partial(sl.sky_view_factor, definition=definition),
        "openness": sl.openness,
        "negative-openness": partial(sl.openness, negative=True),
        "slopes": sl.horizons,
    }
    node, sky = parsing.node(at) if at else None, parsing.sky(source, sun, file)
    scene, raster = parsing.scene(file, height, spacing, None, nodata, sides, resample)
    maps: np.ndarray | None = None
    with output.progress_bar("looking for horizons"):
        name = select(backend).name
        if out:
            maps = quantities[what](scene, azimuths=azimuths, backend=name, max_distance=max_distance)
        if picture and node:
            drawn = plot.horizon(scene, *node, sky, backend=name, max_distance=max_distance)
            plot.save(drawn, picture)
    shape, scale = (), None
    if out and maps is not None:
        shape = maps.shape
        whole = (0.0, 1.0) if what == "sky-view-factor" else None
        scale = output.write(out, maps, raster, range=whole, name=what.replace("-", "_"))
    output.report_array_or_picture(
        out, picture, as_json, name, shape=shape, range=scale, what=what if out else None
    )


@app.command(epilog=epilog("field"))
def field(
    file: opt.File,
    target: opt.Target = None,
    out: opt.MaybeOut = None,
    height: opt.Height = None,
    spacing: opt.Spacing = None,
    nodata: opt.Nodata = None,
    resample: opt.Resample = False,
    source: opt.Source = None,
    lamp: opt.Lamp = None,
    window: opt.Window = None,
    sun: opt.Sun = None,
    sides: opt.Sides = "open",
    hemicube: opt.Hemicube = 9,
    layers: opt.FieldLayers = None,
    layer: opt.Layer = None,
    picture: opt.Plot = None,
    row: opt.Row = None,
    backend: opt.Backend = "auto",
    as_json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Compute the visibility field: the visible solid angle [sr] of the source at every point of free space,
    (layers, rows, cols); draw the rays through points of one row.
    """
    out = output.either((file, source), target, out, picture)
    output.check_array_or_picture(out, picture, as_json)
    if out and layer is None and out.lower().endswith(".png"):
        raise typer.BadParameter(
            "a .png holds one layer: give --layer, or write .npy, .npz or .tif", param_hint="--out"
        )
    if row is not None and picture is None:
        raise typer.BadParameter("goes with --plot", param_hint="--row")
    if layer is not None and not out:
        raise typer.BadParameter("goes with an output file, --out", param_hint="--layer")
    scene, raster = parsing.scene(file, height, spacing, None, nodata, sides, resample)
    light = parsing.source(source, lamp, window, sun, file=file)
    parsing.check_place(light, raster)
    with output.progress_bar("propagating") as progress:
        done = sl.visibility_field(
            scene, light, hemicube=hemicube, layers=layers, backend=backend, progress=progress
        )
        angle: np.ndarray | None = done.solid_angle() if out else None
        if picture:
            plot.save(plot.field(done, row, backend=done.backend), picture)
    shape, scale = (), None
    if out and angle is not None:
        if layer is not None:
            if not 0 <= layer < len(angle):
                raise bad("--layer", layer, f"0 to {len(angle) - 1}")
            angle = angle[layer]
        shape = angle.shape
        scale = output.write(out, angle, raster, range=(0.0, 2 * np.pi), name="solid_angle")
    output.report_array_or_picture(out, picture, as_json, done.backend, shape=shape, range=scale)


@app.command(epilog=epilog("chart"))
def chart(
    out: opt.ChartFolder,
    backend: opt.Backends = "",
    sizes: opt.Sizes = "128,512",
    as_json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Measure speed and accuracy of every method, backend and plan on this machine, and draw a chart."""
    many = parsing.whole_numbers(sizes, "--sizes")
    names = charts.checked([name for name in backend.split(",") if name], many)
    folder = io.folder(out)
    with output.progress_bar("measuring") as progress:
        rows = charts.measure(names, many, progress=progress)
    with replacing_file(folder / "chart.csv") as path, open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    written = folder / "chart.csv"
    try:
        charts.draw(rows, folder / "chart.png")
        written = folder / "chart.png"
    except ImportError:
        text = "no chart.png without matplotlib: pip install 'skylamp[plot]'"
        print(f"skylamp: warning: {text}", file=sys.stderr)
    if as_json:
        output.print_json({"out": str(folder), "points": rows, "behind": charts.behind(rows)})
        return
    for kind, times in charts.behind(rows).items():
        ratios = ", ".join(f"{ratio:.2g} ({100 * t:g} %)" for ratio, t in zip(times, charts.TOLERANCES))
        rest = "times as long as the quickest setting within its tolerance"
        print(f"{kind}: the default takes {ratios} {rest}", file=sys.stderr)
    output.message(f"{written}: {len(rows)} points")


@app.command(epilog=epilog("backends"))
def backends(as_json: opt.Json = False, quiet: opt.Quiet = False) -> None:
    """List the backends: name, device, and the reason if one is not available."""
    with output.progress_bar("looking for devices"):
        infos = sl.backends()
    if as_json:
        output.print_json({"backends": infos})
        return
    table = Table("backend", "device", "available", "why not")
    for b in infos:
        table.add_row(b.name, b.device, "yes" if b.available else "no", b.why)
    output.console().print(table)


@app.command(epilog=epilog("doctor"))
def doctor(as_json: opt.Json = False, quiet: opt.Quiet = False) -> None:
    """Print versions, devices, caches and free memory as JSON, for bug reports; with --json in one line."""
    with output.progress_bar("looking for devices"):
        report = examined()
    output.print_json(report, None if as_json else 1)


@app.command(epilog=epilog("selftest"))
def selftest(as_json: opt.Json = False, quiet: opt.Quiet = False) -> None:
    """Check every available backend against closed forms, brute force and each other; exit 1 if one fails."""
    with output.progress_bar("checking") as progress:
        checked = checks(progress)
    with output.progress_bar("comparing") as progress:
        compared = run_selftest(progress)
    names = [b.name for b in sl.backends() if b.available]
    every: list[Check | Comparison] = [*checked, *compared]
    wrong = [c for c in every if not c.passed]
    if as_json:
        results: dict[str, Any] = {"checks": checked, "comparisons": compared}
        facts = {name: [{**vars(c), "passed": c.passed} for c in some] for name, some in results.items()}
        output.print_json({"backends": names, "passed": not wrong, **facts})
    else:
        output.console().print(_checked(checked))
        if compared:
            output.console().print(_differences(compared))
    for reason in dict.fromkeys(c.error for c in wrong if c.error):
        print(f"skylamp: {reason}", file=sys.stderr)
    if wrong:
        raise typer.Exit(1)


def _checked(checks: list[Check]) -> Table:
    """A row for each check."""
    table = Table("check", "backend", "measured", "at most")
    for c in checks:
        shown = "failed" if c.figure is None else f"{c.figure:.1e}"
        table.add_row(c.name, c.backend, shown + ("" if c.passed else "  WRONG"), f"{c.bound:.0e}")
    return table


def _differences(compared: list[Comparison]) -> Table:
    """A row for each case, a column for each pair of backends."""
    pairs = list(dict.fromkeys((c.one, c.other) for c in compared))
    table = Table(
        "case",
        *(f"{one} / {other}" for one, other in pairs),
        "allowed",
        title="Largest difference, as a share of the largest value",
    )
    for case in dict.fromkeys(c.case for c in compared):
        row = {(c.one, c.other): c for c in compared if c.case == case}
        allowed = next(iter(row.values())).allowed
        table.add_row(case, *(_difference(row[pair]) for pair in pairs), f"{allowed:.0e}" if allowed else "0")
    return table


def _difference(c: Comparison) -> str:
    shown = "failed" if c.difference is None else f"{c.difference:.1e}" if c.difference else "0"
    return shown + ("" if c.passed else "  DIFFERS")


@app.command(epilog=epilog("demo"))
def demo(
    out: opt.DemoFolder, backend: opt.Backend = "auto", as_json: opt.Json = False, quiet: opt.Quiet = False
) -> None:
    """Render mountains under two skies and a lamp, recover depth from an image, and compare the backends."""
    with output.progress_bar("looking for devices"):
        select(backend)  # a name that is not there shall leave nothing behind
    folder = io.folder(out)
    with output.progress_bar("demo") as progress:
        facts = demos.demo(folder, backend, progress, as_json)
    if as_json:
        output.print_json(facts)
    else:
        demos.print_tables(facts)
        output.message(f"Next: open {folder / 'panel.png'}, then try: skylamp render YOUR_MAP image.png")


@app.command(epilog=epilog("view"))
def view(
    file: opt.File,
    height: opt.Height = None,
    spacing: opt.Spacing = None,
    resample: opt.Resample = False,
    nodata: opt.Nodata = None,
    port: opt.Port = 8080,
    browser: opt.Browser = True,
    backend: opt.Backend = "auto",
    quiet: opt.Quiet = False,
) -> None:
    """Open a page in the browser to render the map while the sun or a lamp is dragged with the mouse."""
    with output.progress_bar("reading"):
        viewer = views.Viewer(views.read(file, height, spacing, resample, nodata), select(backend).name)
        viewer.scene(views.Settings())  # checks the map
        views.check_port(port)
    views.imported()
    output.message(f"http://127.0.0.1:{port} shows {file}; Ctrl-C ends it.")
    views.serve(viewer, port, browser)


# what the errors of the library advise, as the command line has it
ADVICE = {
    "sun_position gives it from time and place.": "Give --sun AZ,EL or --sun TIME,LAT,LON.",
    "For terrain heights use Scene.from_height.": "For terrain heights give --height.",
    "Pass mask=numpy.isfinite(height) to leave them out.": "Give --nodata nan to leave them out.",
    "Pass mask=numpy.isfinite(depth) to leave them out.": "Give --nodata nan to leave them out.",
    "Pass mask=numpy.isfinite(image) to leave gaps out.": "Give --mask FILE, 0 in gaps, to leave them out.",
}


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit; ``arguments`` default to the process's own."""
    # of closed streams, whose numbers the files of the command would get else
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))
    # these libraries log the text of the error too
    for library, level in (("tifffile", logging.ERROR), ("rasterio", logging.CRITICAL)):
        logging.getLogger(library).setLevel(level)
    as_usual = warnings.formatwarning
    # without the place in the code that gives it
    warnings.formatwarning = lambda message, *_, **__: f"skylamp: warning: {message}\n"
    try:
        app(arguments, prog_name="skylamp")
    except Exception as error:
        if _debug:
            traceback.print_exc()
        text = " ".join(str(error).split())
        for library, here in ADVICE.items():
            text = text.replace(library, here)
        if not isinstance(error, (SkylampError, OSError)):
            text = f"{type(error).__name__}: {text} (--debug shows where)"
        print(f"skylamp: error: {text}", file=sys.stderr)
        sys.exit(3 if isinstance(error, InputError) else 4 if isinstance(error, BackendError) else 1)
    finally:
        warnings.formatwarning = as_usual
    sys.exit(0)


if __name__ == "__main__":
    main()
