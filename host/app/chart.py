"""Speed against accuracy: a point for every method, setting and backend, and where plans stand among them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import sources
from ..backends import backends, select
from ..backends.base import Backend
from ..errors import bad
from ..io.paths import StrPath
from ..refinement import solid_of
from ..rendering import Rendering, render
from ..samples import Samples
from ..scene import Scene
from ..sources.solids import upright

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CLASSES = ("smooth", "rough", "urban", "lamp")
TOLERANCES = (0.03, 0.01, 0.003)
NODES, FIRST = 300, 100_003  # at which errors are taken; other nodes than a plan's samples
SKY_METHODS = (
    [("horizon", k) for k in (4, 6, 8, 12, 16, 24, 32, 64, 128)]
    + [("filled", m) for m in (5, 9, 17, 33)]
    + [("stride", m) for m in (5, 9, 17, 33)]
    + [("unoccluded", 0)]
)
LAMP_METHODS = (
    [("slices", s) for s in (8, 16, 32, 64, 128)]
    + [("filled", m) for m in (9, 17, 33)]
    + [("stride", m) for m in (9, 17, 33)]
    + [("unoccluded", 0)]
)
RUNS = 3
COLOURS = {"horizon": "C0", "slices": "C0", "filled": "C1", "stride": "C3", "unoccluded": "C2", "plan": "k"}
LEAST_DRAWN_ERROR = 2e-5  # errors below are drawn here
PEER = "peer "  # methods of other packages begin with it

Row = dict[str, Any]  # a point of the chart: class, size, backend, method, units, error, seconds ...


def scene_of(kind: str, size: int) -> tuple[Scene, sources.Source]:
    """A scene and its source: fractal ground of rms slope 0.5 or 1, houses, or that ground under a lamp."""
    if kind == "urban":
        rng = np.random.default_rng(2)
        depth = np.full((size, size), 40.0)
        for row in range(3, size - 10, 15):
            for col in range(3, size - 10, 15):
                if rng.random() < 0.75:
                    depth[row : row + rng.integers(7, 12), col : col + rng.integers(7, 12)] = (
                        40 - rng.integers(4, 40)
                    )
        return Scene(depth), sources.Sky()
    slope, power = (0.5, 2.5) if kind == "smooth" else (1.0, 2.0)
    frequency = np.hypot(*np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = 1
    z = np.fft.irfft2(
        np.fft.rfft2(np.random.default_rng(1).standard_normal((size, size))) / frequency**power,
        s=(size, size),
    )
    z *= slope / np.sqrt(sum(np.mean(np.diff(z, axis=a) ** 2) for a in (0, 1)))
    lamp = sources.Lamp((0.3 * size, 0.6 * size, -0.15 * size), 0.04 * size)
    return Scene(z - z.min()), lamp if kind == "lamp" else sources.Sky()


def options_of(method: str, units: int) -> Row:
    """The arguments of render() for a method of the chart."""
    if method in ("stride", "filled"):
        return {"method": "lattice", "hemicube": units, "filled": method == "filled"}
    return {"method": "unoccluded"} if method == "unoccluded" else {"method": "horizon", "azimuths": units}


def settings(kind: str) -> Iterator[tuple[str, float, Row]]:
    """(method, units, arguments of render()) of every point of a class; coarse before fine."""
    for method, units in LAMP_METHODS if kind == "lamp" else SKY_METHODS:
        yield method, units, options_of(method, units)
    for tolerance in TOLERANCES:
        yield "plan", tolerance, {"tolerance": tolerance}


def reference(kind: str, size: int, engine: Backend) -> tuple[Scene, sources.Source, Samples, np.ndarray]:
    """(scene, source, samples, exact irradiance at them)."""
    scene, source = scene_of(kind, size)
    samples = Samples(engine, scene, NODES, FIRST)
    solid = None if isinstance(source, sources.Sky) else upright(solid_of(scene, source, 1.0, 1.0))
    return scene, source, samples, samples.exact(source, solid)


def measure(
    names: list[str] | None = None,
    sizes: Sequence[int] = (128, 512),
    longest: float = 1.5,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Rows of class, size, backend, method, units, error (relative RMS), seconds of the whole call, of it to
    plan, and again; the plan's are ``method`` "plan", their units the tolerance, timed on a scene that is
    new, and "again" on one that was rendered before.

    A setting is left out if the next coarser one of its method took longer than ``longest`` seconds a call,
    or would have, as the next smaller map has it.
    """
    here = [info.name for info in backends() if info.available]
    for name in names or []:
        select(name)
    chosen = list(dict.fromkeys(select(name).name for name in names or here))
    if not sizes or min(sizes) < 16:
        raise bad("chart: sizes", list(sizes), "whole numbers from 16 on")
    best = select("auto")
    rows: list[Row] = []
    durations: dict[tuple[str, str, str, float], tuple[int, float]] = {}
    jobs = [(kind, size) for kind in CLASSES for size in sorted(sizes)]
    for number, (kind, size) in enumerate(jobs):
        case = _Case(kind, size, *reference(kind, size, best))
        for name in chosen:
            rows += _timed(case, name, longest, durations)
        if progress:
            progress(number + 1, len(jobs))
    return rows


@dataclass(frozen=True, eq=False)
class _Case:
    """A class of scene at one size, with what its images are compared with."""

    kind: str
    size: int
    scene: Scene
    source: sources.Source
    samples: Samples
    exact: np.ndarray

    def render(self, backend: str, options: Row, new: bool = False) -> Rendering:
        """The irradiance; ``new``: of a copy of the scene, which holds nothing that was computed before."""
        scene = replace(self.scene) if new else self.scene
        return render(
            scene, self.source, backend=backend, quantity="irradiance", interreflection=False, **options
        )

    def error(self, done: Rendering) -> float:
        """Relative RMS error at the samples."""
        return self.samples.errors(self.samples.of(done.image), self.exact).rms


@dataclass
class _Point:
    """A setting that is timed: (seconds, of them to plan) of every run, and seconds on a known scene."""

    row: Row
    options: Row
    times: list[tuple[float, float]] = field(default_factory=list)
    again: list[float] = field(default_factory=list)


def _timed(
    case: _Case,
    backend: str,
    longest: float,
    durations: dict[tuple[str, str, str, float], tuple[int, float]],
) -> list[Row]:
    """Rows of all settings on one backend. ``durations``: (last size, its seconds) of each; updated."""
    points: list[_Point] = []
    slow: set[str] = set()
    for method, units, options in settings(case.kind):
        key = case.kind, backend, method, units
        last, seconds = durations.get(key, (case.size, 0.0))
        if method in slow or seconds * (case.size / last) ** 2 > longest:
            continue
        done = case.render(backend, options)
        if done.seconds > longest:
            slow.add(method)
        durations[key] = case.size, done.seconds
        row = {"class": case.kind, "size": case.size, "backend": backend, "method": method, "units": units}
        points.append(_Point({**row, "error": case.error(done)}, options))
    for _ in range(RUNS):  # in turns, so that what else the machine does falls on all of them
        for point in points:
            if sum(seconds for seconds, _ in point.times) >= longest:
                continue
            planned = point.row["method"] == "plan"
            done = case.render(backend, point.options, new=planned)
            point.times.append((done.seconds, done.plan.planning_seconds or 0.0))
            point.again.append(case.render(backend, point.options).seconds if planned else done.seconds)
    return [
        {**point.row, **dict(zip(("seconds", "planning"), min(point.times))), "again": min(point.again)}
        for point in points
    ]


def frontier(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Of (seconds, error), those that no other beats in both, by time."""
    left, lowest = [], math.inf
    for seconds, error in sorted(points):
        if error < lowest:
            left.append((seconds, error))
            lowest = error
    return left


def behind(rows: list[Row], time: str = "seconds", as_accurate: bool = False) -> dict[str, list[float]]:
    """By class and tolerance: the time of the default over that of the quickest setting within it; else nan.

    Only the largest maps count. The default is the plan on the backend where it is quickest. ``time``:
    "seconds", or "again", of a scene that was rendered before. ``as_accurate``: the other settings must be no
    less accurate than the default's own image, instead of within the tolerance.
    """
    largest = max(row["size"] for row in rows)
    found: dict[str, list[float]] = {}
    for kind in CLASSES:
        here = [
            row
            for row in rows
            if row["class"] == kind and row["size"] == largest and not row["method"].startswith(PEER)
        ]
        for tolerance in TOLERANCES:
            ours, error = min(
                (
                    (row[time], row["error"])
                    for row in here
                    if row["method"] == "plan" and row["units"] == tolerance
                ),
                default=(math.nan, math.nan),
            )
            limit = error if as_accurate else tolerance
            best = min(
                (row["seconds"] for row in here if row["method"] != "plan" and row["error"] <= limit),
                default=math.nan,
            )
            found.setdefault(kind, []).append(ours / best)
    return found


def draw(rows: list[Row], path: StrPath, title: str = "") -> None:
    """The chart as PNG: a panel a class, error against time per node; needs matplotlib."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    names = sorted({row["backend"] for row in rows if not row["method"].startswith(PEER)})
    peers = sorted({row["method"] for row in rows if row["method"].startswith(PEER)})
    sizes = sorted({row["size"] for row in rows})
    marks = dict(zip(names, "osD^v<>"))
    for axes, kind in zip(figure.subplots(2, 2).flat, CLASSES):
        here = [row for row in rows if row["class"] == kind]
        largest = [row for row in here if row["size"] == max(sizes)]
        _draw_points(axes, here, max(sizes), marks, peers)
        edge = frontier([_place(row) for row in largest if row["method"] != "plan"])
        axes.plot(*zip(*edge), color="0.4", lw=1.2, zorder=1)
        _draw_plans(axes, [row for row in largest if row["method"] == "plan"])
        axes.margins(0.06, 0.08)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_title(
            {"lamp": "rough ground, spherical lamp", "urban": "urban steps, uniform sky"}.get(
                kind, f"{kind} ground, uniform sky"
            ),
            fontsize=11,
        )
        axes.set_xlabel("time of the whole call [ns per node]")
        axes.set_ylabel("relative RMS error")
        axes.grid(which="both", alpha=0.15)
    _draw_legend(figure, marks, sizes, peers)
    if title:
        figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=100)


def _place(row: Row) -> tuple[float, float]:
    """Where a row stands on the chart: (time of the whole call [ns per node], error)."""
    return 1e9 * row["seconds"] / row["size"] ** 2, max(row["error"], LEAST_DRAWN_ERROR)


def _draw_points(axes: Axes, rows: list[Row], largest: int, marks: dict[str, str], peers: list[str]) -> None:
    """Settings by colour of method and mark of backend, filled on the largest maps; peers by crosses."""
    for row in rows:
        x, y = _place(row)
        if row["method"] in peers:
            axes.scatter(x, y, s=50, marker="X", color=f"C{4 + peers.index(row['method'])}", zorder=3)
        elif row["method"] != "plan":
            colour = COLOURS[row["method"]]
            axes.scatter(
                x,
                y,
                s=42 if row["size"] == largest else 14,
                marker=marks[row["backend"]],
                facecolor=colour if row["size"] == largest else "none",
                edgecolor=colour,
                lw=0.8,
                alpha=0.8,
            )


def _draw_plans(axes: Axes, plans: list[Row]) -> None:
    """Stars of the plans on the backend where they are quickest; to the left of each, its planning."""
    if not plans:
        return
    quickest = min(plans, key=lambda row: float(row["seconds"]))
    level = {tolerance: number for number, tolerance in enumerate(TOLERANCES)}
    for row in plans:
        if row["backend"] != quickest["backend"]:
            continue
        x, y = _place(row)
        begin = x * (1 - float(row.get("planning") or 0) / row["seconds"])
        axes.plot([begin, x], [y, y], color="k", lw=1.1, zorder=4)
        axes.scatter(x, y, s=190, marker="*", color="gold", edgecolor="k", lw=0.9, zorder=5)
        axes.annotate(
            f"{100 * row['units']:g} %",
            (x, y),
            (9, 10 - 13 * level.get(row["units"], 0)),
            textcoords="offset points",
            fontsize=8,
            zorder=6,
        )


def _draw_legend(figure: Figure, marks: dict[str, str], sizes: list[int], peers: list[str]) -> None:
    from matplotlib.lines import Line2D

    def dot(colour: str, mark: str = "o", label: str = "", fill: bool = True, size: int = 7) -> Line2D:
        face = colour if fill else "none"
        return Line2D(
            [], [], ls="", marker=mark, color=colour, markerfacecolor=face, label=label, markersize=size
        )

    largest = max(sizes)
    star: dict[str, Any] = dict(marker="*", color="gold", markeredgecolor="k", markersize=13)
    handles = [
        dot("C0", label="horizon (lamp: slices)"),
        dot("C1", label="lattice, filled"),
        dot("C3", label="lattice, stride (the paper)"),
        dot("C2", label="unoccluded"),
        *(dot("0.3", mark, name) for name, mark in marks.items()),
        *(
            dot("0.3", label=f"{size} x {size} nodes", fill=size == largest, size=7 if size == largest else 4)
            for size in sizes
        ),
        Line2D([], [], color="0.4", lw=1.2, label=f"frontier, {largest} x {largest}"),
        Line2D([], [], ls="", label="the default, by tolerance; to its left, planning", **star),
        *(dot(f"C{4 + number}", "X", peer[len(PEER) :]) for number, peer in enumerate(peers)),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
