"""The command line: `skylamp render | plan | recover | field | chart | backends | demo`.

Data go to files or to stdout; messages, progress and errors go to stderr. Exit codes: 0 ok, 2 usage, 3 bad input,
4 backend unavailable, 1 the rest. An error is one line; --debug adds the traceback.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import sys
import traceback
from pathlib import Path
from typing import Annotated, NoReturn, Optional

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Column, Table

import skylamp as sl

from . import io
from .backends import select
from .errors import BackendError, InputError, SkylampError, bad

app = typer.Typer(name="skylamp", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
                  help="Light from skies, lamps and windows on depth maps, forward and inverse.")
_debug = False

# The demo. Real ground is gentle: heights are exaggerated so that valleys lose sky. The lamp is (x, y, z, radius) in nodes.
EXAGGERATION = 4
LAMP = (215, 150, -45, 40)

File = Annotated[Path, typer.Argument(help="Depth, or height with --height: .npy, .npz, grey .png or .tif", show_default=False)]
Out = Annotated[str, typer.Option(help=".npy, .npz, .tif or .png; - writes .npy to stdout", show_default=False)]
Height = Annotated[bool, typer.Option("--height", help="The file holds height (larger is nearer to the viewer), not depth")]
Spacing = Annotated[float, typer.Option(help="Distance between neighbouring nodes, in the unit of depth")]
Albedo = Annotated[float, typer.Option(help="Diffuse reflectance, 0 to 1")]
Nodata = Annotated[Optional[float], typer.Option(help="Leave out nodes of this value (a number, or nan)", show_default=False)]
Source = Annotated[Optional[str], typer.Option(help="sky | overcast | lamp | window | FILE, an environment map  [default: lamp with --lamp, window with --window, else sky]", show_default=False)]
Lamp = Annotated[Optional[str], typer.Option(metavar="X,Y,Z,R", help="Centre and radius of a spherical lamp, in the unit of spacing", show_default=False)]
Window = Annotated[Optional[str], typer.Option(metavar="X0,X1,Y0,Y1", help="Rectangle in the plane z = 0, in the unit of spacing", show_default=False)]
Sides = Annotated[str, typer.Option(help="open | dark | periodic")]
Backend = Annotated[str, typer.Option(help="auto, or a name from `skylamp backends`")]
Hemicube = Annotated[int, typer.Option(help="Nodes along an edge of the cube of directions, odd")]
Tolerance = Annotated[str, typer.Option(help="Relative RMS error that auto may make: 0.01 or 1%")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout")]


def _version(asked: bool):
    if asked:
        print(f"skylamp {sl.__version__}")
        raise typer.Exit()


@app.callback()
def _options(version: Annotated[bool, typer.Option("--version", is_eager=True, callback=_version, help="Print the version and exit")] = False,
             debug: Annotated[bool, typer.Option("--debug", help="Print the traceback of an error")] = False):
    global _debug
    _debug = debug


@app.command()
def render(file: File, out: Out, height: Height = False, spacing: Spacing = 1.0, albedo: Albedo = 0.8, nodata: Nodata = None,
           source: Source = None, lamp: Lamp = None, window: Window = None, sides: Sides = "open",
           method: Annotated[str, typer.Option(help="auto | lattice | horizon | unoccluded")] = "auto", tolerance: Tolerance = "1%",
           hemicube: Annotated[Optional[int], typer.Option(help="Lattice: nodes along an edge of the cube of directions, odd", show_default=False)] = None,
           filled: Annotated[Optional[bool], typer.Option("--filled/--stride", help="Lattice: test between the nodes, or step over them as the paper does", show_default=False)] = None,
           quantity: Annotated[str, typer.Option(help="radiance | irradiance")] = "radiance",
           white: Annotated[Optional[float], typer.Option(help="PNG: the value that becomes white  [default: the image's maximum]", show_default=False)] = None,
           bits: Annotated[int, typer.Option(help="PNG: 8 or 16")] = 8,
           backend: Backend = "auto", as_json: Json = False):
    """Render a depth map under a source."""
    _check_output(out, as_json)
    scene = _scene(file, height, spacing, albedo, nodata, sides)
    with _working("rendering"):
        done = sl.render(scene, _source(source, lamp, window), method=method, tolerance=_share(tolerance), backend=backend,
                         quantity=quantity, hemicube=hemicube, filled=filled)
    scale = _deliver(out, done.image, range=None if white is None else (0.0, white), bits=bits)
    _report(done, out, as_json, shape=done.image.shape, range=scale)


@app.command()
def plan(file: File, height: Height = False, spacing: Spacing = 1.0, albedo: Albedo = 0.8, nodata: Nodata = None,
         source: Source = None, lamp: Lamp = None, window: Window = None, sides: Sides = "open", tolerance: Tolerance = "1%",
         tail: Annotated[Optional[str], typer.Option(help="Bound on the 99.9th percentile of the error  [default: ten tolerances]", show_default=False)] = None,
         backend: Backend = "auto", as_json: Json = False):
    """Print the cheapest model of a scene within a tolerance, with a reason for every choice."""
    scene = _scene(file, height, spacing, albedo, nodata, sides)
    with _working("planning"):
        made = sl.plan(scene, _source(source, lamp, window), _share(tolerance), backend, tail=None if tail is None else _share(tail, "--tail"))
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
def recover(file: Annotated[Path, typer.Argument(help="Image of radiance: .npy, .npz, grey .png or .tif", show_default=False)], out: Out,
            albedo: Albedo = 0.8, spacing: Spacing = 1.0, source: Source = None, lamp: Lamp = None, window: Window = None, sides: Sides = "open",
            layers: Annotated[int, typer.Option(help="Depth of the block that is carved, in layers of one spacing")] = 64,
            hemicube: Hemicube = 9,
            eps: Annotated[float, typer.Option(help="Stop a column when it is this close to the image, as a share of the image's maximum")] = 0.02,
            stop: Annotated[str, typer.Option(help="eps: the paper's rule | sign: when the column becomes darker than the image")] = "eps",
            white: Annotated[Optional[float], typer.Option(help="Radiance of a full-scale count, for integer files that skylamp did not write", show_default=False)] = None,
            backend: Backend = "auto", as_json: Json = False):
    """Recover depth from an image. An .npz also holds the mask of drilled columns; a .png holds depth in whole layers, 16 bit."""
    _check_output(out, as_json)
    image = _radiance(file, white)
    with _working("carving") as progress:
        done = sl.recover(image, _source(source, lamp, window), albedo=albedo, sides=sides, spacing=spacing, layers=layers, hemicube=hemicube,
                          eps=eps, stop=stop, backend=backend, progress=progress)
    more = {"drilled": done.drilled} if out.lower().endswith(".npz") else {}
    _deliver(out, done.depth, range=(0.0, 65535.0 * spacing), bits=16, name="depth", **more)
    _report(done, out, as_json, shape=done.depth.shape, drilled=int(np.count_nonzero(done.drilled)))


@app.command()
def field(file: File, out: Out, height: Height = False, spacing: Spacing = 1.0, nodata: Nodata = None,
          source: Source = None, lamp: Lamp = None, window: Window = None, sides: Sides = "open", hemicube: Hemicube = 9,
          layers: Annotated[Optional[int], typer.Option(help="Layers of free space, from z = 0  [default: down to the deepest node]", show_default=False)] = None,
          layer: Annotated[Optional[int], typer.Option(help="Write this layer alone, (rows, cols)", show_default=False)] = None,
          backend: Backend = "auto", as_json: Json = False):
    """The visibility field: the solid angle [sr] of the source in sight, for every point of free space, (layers, rows, cols)."""
    _check_output(out, as_json)
    if layer is None and out.lower().endswith(".png"):
        raise typer.BadParameter("a .png holds one layer: give --layer, or write .npy, .npz or .tif", param_hint="--out")
    scene = _scene(file, height, spacing, 0.8, nodata, sides)
    with _working("propagating") as progress:
        done = sl.visibility_field(scene, _source(source, lamp, window), hemicube=hemicube, layers=layers, backend=backend, progress=progress)
        angle = done.solid_angle()
    if layer is not None:
        if not 0 <= layer < len(angle):
            raise bad("--layer", layer, f"0 to {len(angle) - 1}")
        angle = angle[layer]
    scale = _deliver(out, angle, range=(0.0, 2 * np.pi), name="solid_angle")
    _report(done, out, as_json, shape=angle.shape, range=scale)


@app.command()
def chart(out: Annotated[Path, typer.Option(help="Folder for chart.png (needs matplotlib) and chart.csv; created if need be", show_default=False)],
          backend: Annotated[str, typer.Option(help="Names with commas between  [default: all that are here]", show_default=False)] = "",
          sizes: Annotated[str, typer.Option(help="Rows and columns of the maps")] = "128,512", as_json: Json = False):
    """Speed against accuracy of every method and backend on this machine, and where plans stand."""
    import csv

    from . import chart as charts

    try:
        many = [int(part) for part in sizes.split(",")]
    except ValueError:
        raise typer.BadParameter(f"got {sizes!r}; allowed: whole numbers with commas between", param_hint="--sizes") from None
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
        print("skylamp: warning: no chart.png without matplotlib: pip install 'skylamp[plot]'", file=sys.stderr)
    if as_json:
        print(json.dumps(_plain({"out": str(folder), "points": rows})))
    else:
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
def demo(out: Annotated[Path, typer.Option(help="Folder for the pictures; created if need be", show_default=False)], backend: Backend = "auto", as_json: Json = False):
    """Real mountains under two skies and a lamp, depth recovered from a picture, and every backend beside the others."""
    select(backend)  # a name that is not there shall leave nothing behind
    folder = io.folder(out)
    with _working("demo") as progress:
        stages = iter(range(1, 7))
        step = lambda: progress and progress(next(stages), 6)
        pictures, panel = [], []

        def show(name, image, low, high, gamma, text):
            """One 8-bit picture: low is black, high is white, ((v - low) / (high - low))^(1 / gamma) between them."""
            tone = np.clip((image - low) / (high - low), 0, 1) ** (1 / gamma)
            io.write(folder / name, tone, range=(0.0, 1.0))
            panel.append(tone)
            pictures.append({"file": name, "shows": text, "black": float(low), "white": float(high), "gamma": gamma})

        height, spacing = io.terrain()
        compared = _compare(sl.Scene.from_height(height[100:228, 130:258], spacing=spacing))  # before the rest: it tells what compiling takes
        step()
        mountains = sl.Scene.from_height(EXAGGERATION * height, spacing=spacing)
        lamp = sl.Lamp(center=tuple(spacing * v for v in LAMP[:3]), radius=spacing * LAMP[3])
        renderings = []
        for name, source, hemicube, text in (
            ("uniform_sky", sl.Sky(), 9, "uniform sky"),
            ("overcast_sky", sl.Sky(sl.cie_overcast()), 9, "CIE overcast sky"),
            ("low_lamp", lamp, 33, f"a lamp, radius {LAMP[3]} nodes, {-LAMP[2]} nodes above the highest peak"),
        ):
            done = sl.render(mountains, source, method="lattice", hemicube=hemicube, filled=True, backend=backend)
            renderings.append(done)
            if source is lamp:
                low, high, gamma = 0.0, np.percentile(done.image, 99), 2.2
            else:  # white is what open level ground would send, so that the two skies compare
                level = sl.render(sl.Scene(np.zeros((1, 1))), source, method="lattice", hemicube=hemicube, backend=backend).image[0, 0]
                low, high, gamma = 0.3 * level, level, 1.0
            show(f"jacksboro_x{EXAGGERATION}_{name}.png", done.image, low, high, gamma, f"Jacksboro fault, heights x {EXAGGERATION}, under {text}")
            step()

        depth = _relief()
        seen = sl.render(sl.Scene(depth, sides="dark"), sl.Sky(), method="lattice", hemicube=33, filled=True, backend=backend)
        step()
        found = sl.recover(seen.image, sl.Sky(), sides="dark", layers=64, hemicube=17, stop="sign", backend=backend)
        step()
        error = float(np.sqrt(np.mean((found.depth - depth) ** 2)))
        show("relief_rendered.png", seen.image, 0.0, seen.image.max(), 1.0, "folds in a black box under a uniform sky")
        for name, z, text in (("relief_recovered.png", found.depth, f"depth recovered from that picture by the paper's method, near is bright; off by {error:.1f} RMS in a relief of {np.ptp(depth):.0f}"),
                              ("relief_true.png", depth, "its true depth, same scale")):
            show(name, -z, -depth.max(), -depth.min(), 1.0, text)
        io.write(folder / "panel.png", _panel(panel), range=(0.0, 1.0))
        pictures.append({"file": "panel.png", "shows": "all of them"})
    used = renderings[0].backend
    if as_json:
        print(json.dumps(_plain({"out": str(folder), "backend": used, "pictures": pictures, "seconds": [r.seconds for r in renderings], "compile_seconds": [r.compile_seconds for r in renderings], "backends": compared})))
        return
    console = Console(stderr=True, width=None if sys.stderr.isatty() else 160)
    table = Table(Column("picture", no_wrap=True), "shows", "black", "white", "gamma", title=f"Pictures in {escape(str(folder))}, made by {used}")
    for picture in pictures:
        table.add_row(picture["file"], picture["shows"], *(f"{picture[k]:.3g}" if k in picture else "" for k in ("black", "white", "gamma")))
    console.print(table)
    table = Table("backend", "device", "compile [s]", "run [s]", "bits as numpy", "radiance off by", title="128 x 128 nodes, 209 directions, beside NumPy")
    for row in compared:
        if row["available"]:
            table.add_row(row["name"], row["device"], f"{row['compile_seconds']:.2f}", f"{row['seconds']:.4f}", "all" if row["bits_equal"] else "NO", f"{row['difference']:.1e}")
        else:
            table.add_row(row["name"], row["device"], escape(row["why"]))
    console.print(table)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit; ``arguments`` default to the process's own."""
    logging.getLogger("tifffile").setLevel(logging.ERROR)  # its warnings would stand beside our one line
    try:
        app(arguments, prog_name="skylamp")
    except Exception as error:
        if _debug:
            traceback.print_exc()
        known = isinstance(error, (SkylampError, OSError))
        text = " ".join(str(error).split()) if known else f"{type(error).__name__}: {' '.join(str(error).split())} (--debug shows where)"
        print(f"skylamp: error: {text}", file=sys.stderr)
        sys.exit(3 if isinstance(error, InputError) else 4 if isinstance(error, BackendError) else 1)
    sys.exit(0)


def _scene(file, height, spacing, albedo, nodata, sides):
    values = io.read(file, "height" if height else "depth")
    mask = None if nodata is None else ~np.isnan(values) if np.isnan(nodata) else values != nodata
    return (sl.Scene.from_height if height else sl.Scene)(values, spacing=spacing, albedo=albedo, mask=mask, sides=sides)


def _source(kind, lamp, window):
    kind = kind or ("lamp" if lamp else "window" if window else "sky")
    for name, given in (("lamp", lamp), ("window", window)):
        if bool(given) != (kind == name):
            raise typer.BadParameter(f"--{name} goes with --source {name}: got --source {kind}" + ("" if given else f" without --{name}"), param_hint=f"--{name}")
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
    if not Path(kind).exists():
        raise bad("--source", repr(kind), "sky, overcast, lamp, window, or an existing file (an environment map)")
    return sl.Sky(sl.environment_map(io.read_environment(kind)))


def _share(text, option="--tolerance"):
    """A share of one: 0.01 or 1%."""
    try:
        return float(text[:-1]) / 100 if text.endswith("%") else float(text)
    except ValueError:
        raise typer.BadParameter(f"got {text!r}; allowed: a number above 0, such as 0.01 or 1%", param_hint=option) from None


def _numbers(text, option, form):
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len(form.split(",")):
        raise typer.BadParameter(f"got {text!r}; allowed: {form}, numbers with commas between", param_hint=option)
    return numbers


def _radiance(file, white):
    """The image in ``file`` as radiance: counts need a scale, the file's own or --white; floating values are radiance already."""
    image = io.read(file, "image")
    if image.dtype.kind == "f":
        if white is not None:
            raise typer.BadParameter(f"{file} holds floating values, which are radiance as they are", param_hint="--white")
        return image
    low, high = (0.0, white) if white is not None else io.read_range(file) or (None, None)
    if high is None or image.dtype.kind != "u":
        raise bad(f"{file}: counts without a scale", image.dtype, "floating values, or unsigned counts with a scale", "Give --white, the radiance of a full-scale count.")
    return low + image * ((high - low) / np.iinfo(image.dtype).max)


def _check_output(out, as_json):
    """Before any work is done: can the result be put there?"""
    if out != "-":
        io.writable(out)
    elif as_json:
        raise typer.BadParameter("stdout holds either the data or the JSON object: give --out a file", param_hint="--out")


def _deliver(out, array, **options):
    if out != "-":
        return io.write(out, array, **options)
    np.save(sys.stdout.buffer, array, allow_pickle=False)
    sys.stdout.flush()


@contextlib.contextmanager
def _working(title):
    """Progress for the library, progress(done, total), as a bar on stderr if that is a terminal, else None. What libraries print goes to stderr too."""
    import warp

    # No banner, no line per module: here, because a library must not decide that for its user. Older Warps have no levels.
    warp.config.log_level = getattr(warp, "LOG_WARNING", None)
    with contextlib.redirect_stdout(sys.stderr):
        if not sys.stderr.isatty():
            yield None
            return
        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(title, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)


def _report(done, out, as_json, **facts):
    """One line about the result on stderr, or everything as JSON on stdout; the library's warnings on stderr either way."""
    known = {name: getattr(done, name) for name in ("plan", "backend", "seconds", "compile_seconds") if hasattr(done, name)}
    facts = {"out": out, **known, **facts, "warnings": getattr(done, "warnings", [])}
    for warning in facts["warnings"]:
        print(f"skylamp: warning: {warning}", file=sys.stderr)
    if as_json:
        print(json.dumps(_plain(facts)))
    else:
        scale = f", white is {facts['range'][1]:.6g}" if facts.get("range") else ""
        plan = f"; {done.plan.line}" if "plan" in facts else ""
        print(f"{out}: {' x '.join(map(str, facts['shape']))} by {done.backend}{scale}{plan}", file=sys.stderr)


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
        sheet[top: top + picture.shape[0], left: left + picture.shape[1]] = picture
    return sheet


def _compare(scene):
    """Every backend on one small scene: seconds of compiling and of a second call, and how far it is from NumPy."""
    image = sl.render(scene, sl.Sky(), method="lattice", hemicube=9, backend="numpy").image
    bits = sl.visibility(scene, sl.Sky(), hemicube=9, backend="numpy")
    table = []
    for b in sl.backends():
        row = {"name": b.name, "device": b.device, "available": b.available, "why": b.why}
        if b.available:
            first, again = (sl.render(scene, sl.Sky(), method="lattice", hemicube=9, backend=b.name) for _ in range(2))
            same = np.array_equal(sl.visibility(scene, sl.Sky(), hemicube=9, backend=b.name), bits)
            row |= {"compile_seconds": first.compile_seconds, "seconds": again.seconds, "bits_equal": same, "difference": float(np.abs(again.image - image).max())}
        table.append(row)
    return table


if __name__ == "__main__":
    main()
