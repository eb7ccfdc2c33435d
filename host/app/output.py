"""Output of commands: arrays to files or stdout, progress and messages to stderr, JSON to stdout."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from .. import io
from ..io import geotiff as geo
from ..io.paths import HDR
from . import plot

WIDTH = 160  # characters in a line of a table, off a terminal
quiet = False  # --quiet of the running command


def be_quiet(asked: bool) -> None:
    """The effect of --quiet."""
    global quiet
    quiet = quiet or asked


def message(text: str) -> None:
    """A line on stderr, unless --quiet."""
    if not quiet:
        print(text, file=sys.stderr)


Inputs = tuple[Path | str | None, ...]


def either(inputs: Inputs, target: str | None, out: str | None, *others: str | Path | None) -> str | None:
    """The output, given as OUTPUT or as --out; :func:`check_apart` holds for it and the ``others``."""
    if target and out:
        raise typer.BadParameter(
            f"OUTPUT and --out are both given: {target} and {out}. Give one of them.", param_hint="--out"
        )
    check_apart(inputs, target or out, *others)
    return target or out


def needed(inputs: Inputs, target: str | None, out: str | None, *others: str | Path | None) -> str:
    """:func:`either`, which must be given."""
    path = either(inputs, target, out, *others)
    if not path:
        raise typer.BadParameter(
            "no output is given. Give OUTPUT after the input, or --out FILE; - is stdout.", param_hint="--out"
        )
    return path


def check_apart(inputs: Inputs, *outputs: str | Path | None) -> None:
    """BadParameter where an output would take the place of an input, or of another output."""
    files = [Path(out) for out in outputs if out is not None and str(out) != "-"]
    given = [file for file in inputs if file is not None and os.path.exists(file)]
    for number, out in enumerate(files):
        if out.exists() and any(out.samefile(file) for file in given):
            raise typer.BadParameter(
                f"{out} is an input, which would be lost. Give another output.", param_hint="--out"
            )
        if out.absolute() in [other.absolute() for other in files[:number]]:
            raise typer.BadParameter(
                f"{out} is given for two outputs. Give a file for each.", param_hint="--out"
            )


def check_array_or_picture(out: str | None, picture: Path | None, as_json: bool) -> None:
    """:func:`check` for commands that may write an array, a picture or both."""
    if not out and not picture:
        raise typer.BadParameter(
            "no output is given. Give OUTPUT after the input, --plot FILE, or both.", param_hint="--out"
        )
    check(out or "-", as_json and bool(out), picture)


def check(out: str, as_json: bool, picture: Path | None = None, error: str | None = None) -> None:
    """Before any work is done: can the result, a picture and the error be put there?"""
    if picture is not None:
        plot.drawable(picture)
    if error is not None:
        check(error, as_json)
    if out != "-":
        io.writable(out)
    elif as_json:
        raise typer.BadParameter(
            "stdout holds either the data or the JSON object: give --out a file", param_hint="--out"
        )
    elif sys.__stdout__ is None:
        raise OSError("--out -: stdout is closed")


def write(
    out: str, array: np.ndarray, raster: geo.Raster | None = None, **options: Any
) -> tuple[float, float] | None:
    """Write ``array`` to a file, or as .npy to stdout if ``out`` is "-".

    A .tif is a GeoTIFF if ``raster`` is given, of three bands for colours. Options are those of
    :func:`skylamp.io.write`; ``range`` and ``bits`` are used for a .png alone. Returns the range of a scaled
    PNG, else None.
    """
    if raster is not None and out.lower().endswith((".tif", ".tiff")):
        geo.write(out, array, raster)
        return None
    if out != "-":
        if not out.lower().endswith(".png"):
            options = {key: options[key] for key in options.keys() - {"range", "bits"}}
        return io.write(out, array, **options)
    np.save(sys.stdout.buffer, array, allow_pickle=False)
    sys.stdout.flush()
    return None


@contextlib.contextmanager
def native_output_silenced(path: Path | str) -> Iterator[None]:
    """No native output to stdout and stderr while an .exr or .hdr is read.

    OpenEXR and OpenCV write there about damage, which the error of the command names too.
    """
    if not str(path).lower().endswith(HDR):
        yield
        return
    kept: dict[int, int] = {}
    null = os.open(os.devnull, os.O_WRONLY)
    for stream, number in ((sys.stdout, 1), (sys.stderr, 2)):
        with contextlib.suppress(OSError, ValueError):  # of a stream that is closed
            stream.flush()
            kept[number] = os.dup(number)
            os.dup2(null, number)
    try:
        yield
    finally:
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)
        os.close(null)


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int], None] | None]:
    """A progress(done, total) that draws a bar on stderr if that is a terminal, else None.

    The output of libraries goes to stderr too.
    """
    with contextlib.redirect_stdout(sys.stderr):
        if quiet or not sys.stderr.isatty():
            yield None
            return
        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(title, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)


@contextlib.contextmanager
def warnings_told() -> Iterator[list[str]]:
    """The texts of Python's warnings within, which are shown as usual."""
    told: list[str] = []
    show = warnings.showwarning

    def note(message: Warning | str, *where: Any, **more: Any) -> None:
        told.append(str(message))
        show(message, *where, **more)

    warnings.showwarning = note
    try:
        yield told
    finally:
        warnings.showwarning = show


def console(stderr: bool = False) -> Console:
    """A console for tables, as wide as the terminal, or of a fixed width where there is none.

    It prints brackets as they are: units and names of files and devices may hold them.
    """
    stream = sys.stderr if stderr else sys.stdout
    return Console(stderr=stderr, width=None if stream.isatty() else WIDTH, markup=False)


def report(done: Any, out: str, as_json: bool, **facts: Any) -> None:
    """One line about a result on stderr, or everything as JSON on stdout; warnings on stderr either way."""
    names = "plan", "backend", "seconds", "compile_seconds"
    known = {name: getattr(done, name) for name in names if hasattr(done, name)}
    facts = {"out": out, **known, **facts, "warnings": getattr(done, "warnings", [])}
    for warning in facts["warnings"]:
        print(f"skylamp: warning: {warning}", file=sys.stderr)
    if as_json:
        print_json(facts)
    else:
        scale = f", white is {facts['range'][1]:.6g}" if facts.get("range") else ""
        plan = f"; {done.plan.line}" if "plan" in facts else ""
        message(f"{out}: {' x '.join(map(str, facts['shape']))} by {done.backend}{scale}{plan}")


def report_array_or_picture(
    out: str | None,
    picture: Path | None,
    as_json: bool,
    backend: str,
    shape: tuple[int, ...] = (),
    range: tuple[float, float] | None = None,
    **facts: Any,
) -> None:
    """Reports the files that were written, for commands that may write an array, a picture or both."""
    if as_json:
        written = {"out": out, "plot": picture and str(picture), "backend": backend}
        print_json({**written, "shape": shape or None, "range": range, **facts})
        return
    if out:
        scale = f", white is {range[1]:.6g}" if range else ""
        message(f"{out}: {' x '.join(map(str, shape))} by {backend}{scale}")
    if picture:
        message(f"{picture}: drawn, by {backend}")


def print_json(value: object, indent: int | None = None) -> None:
    """``value`` as one JSON object on stdout; dataclasses are dicts of their fields."""
    print(json.dumps(value, indent=indent, default=_plain))


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else dataclasses.asdict(value)
