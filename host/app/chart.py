"""Speed against accuracy: a point for every method, setting and backend, and where plans stand among them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import sources
from ..backends import backends, select
from ..backends.base import Backend
from ..errors import bad
from ..images import Rendering
from ..interreflection import sky_share
from ..io.paths import StrPath, replacing_file
from ..light.finite import solid_of
from ..light.interreflection import Bounces, Round
from ..rendering import render
from ..samples import Samples
from ..scene import Scene
from ..sources.cie import cie_clear
from ..sources.solids import upright

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CLASSES = ("smooth", "rough", "urban", "lamp", "sun", "window", "albedo")
INVERSE = "inverse"  # the class of points of recover(): error is RMSE in layers, ``surface`` a name
BRIGHT_ALBEDO = 0.8  # of class "albedo", whose light between surfaces counts
SUN = ((135.0, 35.0), 3.0)  # [degree] azimuth and elevation of class "sun"; irradiance, zenith brightness 1
TOLERANCES = (0.03, 0.01, 0.003)
NODES, FIRST = 300, 100_003  # at which errors are taken; other nodes than a plan's samples
SKY_METHODS = (
    [("horizon", k) for k in (4, 6, 8, 12, 16, 24, 32, 64, 128)]
    + [("filled", m) for m in (5, 9, 17, 33)]
    + [("stride", m) for m in (5, 9, 17, 33)]
    + [("unoccluded", 0)]
)
SUN_METHODS = [(method, n) for method, n in SKY_METHODS if method in ("horizon", "unoccluded")]
# with which the exact light between surfaces is found: measured on 128 x 128 nodes, twice the fine rounds and
# twice the azimuths differ by 0.03 % of the mean
EXACT_ROUNDS = (Round(8, 2, 8, 0.25),) * 8 + (Round(64, 1, 64, 0.05),) * 3
REFERENCE_AZIMUTHS = 90
LAMP_METHODS = (
    [("slices", s) for s in (8, 16, 32, 64, 128)]
    + [("filled", m) for m in (9, 17, 33)]
    + [("stride", m) for m in (9, 17, 33)]
    + [("unoccluded", 0)]
)
RUNS = 3
TITLES = {
    "smooth": "smooth ground, uniform sky",
    "rough": "rough ground, uniform sky",
    "urban": "houses, uniform sky",
    "lamp": "rough ground, spherical lamp",
    "sun": "rough ground, clear sky with a sun",
    "window": "rough ground, rectangular window",
    "albedo": "rough ground of albedo 0.8, uniform sky, all light",
    INVERSE: "depth from one image, uniform sky",
}
LEAST_DRAWN_ERROR = 2e-5  # errors below are drawn here
PEER = "peer "  # methods of other packages begin with it
# by method; Okabe and Ito (2008), distinct in the three kinds of colour blindness (tests/test_charts.py)
COLOURS = {
    "horizon": "#0072B2",
    "slices": "#0072B2",
    "filled": "#E69F00",
    "stride": "#D55E00",
    "unoccluded": "#009E73",
    "plan": "#F0E442",
    "robust": "#F0E442",
    "paper": "#D55E00",
    "peer trimesh + embreex": "#56B4E9",
    "peer Mitsuba 3": "#56B4E9",
}
PEER_COLOUR = "#CC79A7"  # horizon searches of other packages
MARKERS = {
    "peer rvt-py": "X",
    "peer xarray-spatial": "P",
    "peer topocalc": "D",
    "peer trimesh + embreex": "v",
    "peer HORAYZON": "s",
    "peer Mitsuba 3": "^",
}

Row = dict[str, Any]  # a point of the chart: class, size, backend, method, units, error, seconds ...


def scene_of(kind: str, size: int) -> tuple[Scene, sources.Source]:
    """A scene and its source: fractal ground of rms slope 0.5 or 1, or houses."""
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
    white = np.random.default_rng(1).standard_normal((size, size))
    z = np.fft.irfft2(np.fft.rfft2(white) / frequency**power, s=(size, size))
    z *= slope / np.sqrt(sum(np.mean(np.diff(z, axis=a) ** 2) for a in (0, 1)))
    source: sources.Source = sources.Sky()
    if kind == "lamp":
        source = sources.Lamp((0.3 * size, 0.6 * size, -0.15 * size), 0.04 * size)
    elif kind == "window":
        source = sources.Window((0.3 * size, 0.6 * size), (0.2 * size, 0.5 * size))
    elif kind == "sun":
        source = sources.Sky(cie_clear(SUN[0], direct=SUN[1]))
    return Scene(z - z.min(), albedo=BRIGHT_ALBEDO), source


def settings(kind: str) -> Iterator[tuple[str, float, Row]]:
    """(method, units, arguments of render()) of every point of a class; coarse before fine."""
    methods = {"lamp": LAMP_METHODS, "window": LAMP_METHODS, "sun": SUN_METHODS}.get(kind, SKY_METHODS)
    for method, units in methods:
        options: Row = {"method": "horizon", "azimuths": units}
        if method in ("stride", "filled"):
            options = {"method": "lattice", "hemicube": units, "filled": method == "filled"}
        elif method == "unoccluded":
            options = {"method": method}
        yield method, units, options
    more: Row = {"interreflection": True} if kind == "albedo" else {}
    for tolerance in TOLERANCES:
        yield "plan", tolerance, {"tolerance": tolerance, **more}


def reference(kind: str, size: int, engine: Backend) -> tuple[Scene, sources.Source, Samples, np.ndarray]:
    """(scene, source, samples, exact irradiance at them)."""
    scene, source = scene_of(kind, size)
    samples = Samples(engine, scene, NODES, FIRST)
    solid = None if isinstance(source, sources.Sky) else upright(solid_of(scene, source))
    exact = samples.exact(source, solid)
    if kind == "albedo":
        exact = exact + _between(scene, samples, engine)
    return scene, source, samples, exact


def _between(scene: Scene, samples: Samples, engine: Backend) -> np.ndarray:
    """Irradiance of the samples by the ground of a scene under a uniform sky, by exact strips."""
    options: Row = {"quantity": "irradiance", "azimuths": 128, "interreflection": False}
    image = render(scene, sources.Sky(), "horizon", backend=engine.name, **options).image
    bounces = Bounces(engine, scene, samples, [image], [BRIGHT_ALBEDO], sky_share(scene, engine, 1e-4))
    bounces.run(EXACT_ROUNDS)
    light: np.ndarray = bounces.at_samples(REFERENCE_AZIMUTHS)[0][0]
    return light


def checked(names: list[str] | None, sizes: Sequence[int]) -> list[str]:
    """The backends to measure, all that there are unless named. Raises InputError or BackendError."""
    here = [info.name for info in backends() if info.available]
    if not sizes or min(sizes) < 16:
        raise bad("chart: sizes", list(sizes), "whole numbers from 16 on")
    return list(dict.fromkeys(select(name).name for name in names or here))


def measure(
    names: list[str] | None = None,
    sizes: Sequence[int] = (128, 512),
    longest: float = 1.5,
    progress: Callable[[int, int], None] | None = None,
    kinds: Sequence[str] = CLASSES,
) -> list[Row]:
    """Rows of class, size, backend, method, units, error (relative RMS), and seconds: "seconds" of the whole
    call, "planning" of these, and "again" of the call on a scene that was rendered before.

    The default has the method "plan", and its tolerance for units.

    A setting but the plan's is left out if the next coarser one of its method took longer than ``longest``
    seconds a call, or would have, as the next smaller map has it.
    """
    chosen, best = checked(names, sizes), select("auto")
    rows: list[Row] = []
    durations: dict[tuple[str, str, str, float], tuple[int, float]] = {}
    jobs = [(kind, size) for kind in kinds for size in sorted(sizes)]
    for number, (kind, size) in enumerate(jobs):
        case = _Case(kind, size, *reference(kind, size, best))
        for name in chosen:
            rows += _timed(case, name, longest, durations)
        if progress:
            progress(number + 1, len(jobs))
    return rows


@dataclass(frozen=True, eq=False)
class _Case:
    """A class of scene at one size, with the truth for its images."""

    kind: str
    size: int
    scene: Scene
    source: sources.Source
    samples: Samples
    exact: np.ndarray

    def render(self, backend: str, options: Row, new: bool = False) -> Rendering:
        """The irradiance; ``new``: of a scene that holds nothing that was computed before."""
        scene = scene_of(self.kind, self.size)[0] if new else self.scene
        options = {"interreflection": False, **options}
        return render(scene, self.source, backend=backend, quantity="irradiance", **options)

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
    case: _Case, backend: str, longest: float, durations: dict[tuple[str, str, str, float], tuple[int, float]]
) -> list[Row]:
    """Rows of all settings on one backend. ``durations``: (last size, its seconds) of each; updated."""
    points: list[_Point] = []
    slow: set[str] = set()
    for method, units, options in settings(case.kind):
        key = case.kind, backend, method, units
        last, seconds = durations.get(key, (case.size, 0.0))
        # the default is always there: its choice takes as long on any map
        if method != "plan" and (method in slow or seconds * (case.size / last) ** 2 > longest):
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

    Only the largest maps count, and classes of direct light. The default is the plan on the
    backend where it is quickest. ``time``: "seconds", or "again", of a scene that was rendered before.
    ``as_accurate``: the other settings must be no less accurate than the default's own image, instead of
    within the tolerance.
    """
    largest = max(row["size"] for row in rows)
    ratios: dict[str, list[float]] = {}
    for kind in CLASSES:
        if kind == "albedo":  # other settings have direct light alone
            continue
        here = [row for row in rows if row["class"] == kind and row["size"] == largest]
        here = [row for row in here if not row["method"].startswith(PEER)]
        if not here:
            continue
        plans = [row for row in here if row["method"] == "plan"]
        for tolerance in TOLERANCES:
            within = [(row[time], row["error"]) for row in plans if row["units"] == tolerance]
            ours, error = min(within, default=(math.nan, math.nan))
            limit = error if as_accurate else tolerance
            others = (row for row in here if row["method"] != "plan" and row["error"] <= limit)
            best = min((row["seconds"] for row in others), default=math.nan)
            ratios.setdefault(kind, []).append(ours / best)
    return ratios


def draw(rows: list[Row], path: StrPath, title: str = "", labels: Mapping[str, str] | None = None) -> None:
    """The chart: a panel a class that has points, error against time; needs matplotlib.

    All panels but that of the inverse have the same axes. Only the largest maps are drawn. Colours stand for
    methods, markers for packages, and points of other backends than the quickest are hollow. ``labels``:
    words for methods of other packages, by their name. A path that ends in .svg has the setting of every
    point as the text that appears on hover.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    largest = max((row["size"] for row in rows if row["class"] != INVERSE), default=0)
    rows = [row for row in rows if row["class"] == INVERSE or row["size"] == largest]
    kinds = [kind for kind in (*CLASSES, INVERSE) if any(row["class"] == kind for row in rows)]
    ours = [row for row in rows if not row["method"].startswith(PEER)]
    quickest = min(ours, key=lambda row: float(row["seconds"]))["backend"]
    cols = 3 if len(kinds) > 4 else min(2, len(kinds))
    lines = -(-len(kinds) // cols)
    figure = Figure(figsize=(5.6 * cols, 4.1 * lines + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    hints: dict[str, str] = {}
    panels = figure.subplots(lines, cols, squeeze=False).ravel()
    for axes, kind in zip(panels, kinds):
        axes.set(xscale="log", yscale="log")
        axes.set_title(TITLES[kind], fontsize=11)
        axes.grid(which="major", alpha=0.25)
        here = [row for row in rows if row["class"] == kind]
        for row in here:
            _draw_point(axes, row, quickest, hints)
        settings = [row for row in here if not row["method"].startswith(PEER)]
        if kind != "albedo":  # where no setting but a tolerance has all light
            settings = [row for row in settings if row["method"] != "plan"]
        if settings and kind != INVERSE:
            _draw_frontier(axes, [_place(row) for row in settings])
    for axes in panels[len(kinds) :]:
        axes.axis("off")
    _draw_axes(panels, kinds, cols, largest)
    _draw_legend(figure, panels[len(kinds) :], rows, quickest, labels or {})
    if title:
        figure.suptitle(title, fontsize=10)
    kind = Path(path).suffix[1:].lower()
    with replacing_file(path) as file:
        figure.savefig(file, format=kind, dpi=100, metadata={"Date": None} if kind == "svg" else None)
        if kind == "svg":
            _add_hints(file, hints)


def _place(row: Row) -> tuple[float, float]:
    """Where a row stands on the chart: (time of the whole call [ns per node], error); [s] for the inverse."""
    if row["class"] == INVERSE:
        return row["seconds"], row["error"]
    return 1e9 * row["seconds"] / row["size"] ** 2, max(row["error"], LEAST_DRAWN_ERROR)


def _draw_point(axes: Axes, row: Row, quickest: str, hints: dict[str, str]) -> None:
    """One setting, with its words for the hover; plans are stars with their tolerance beside them."""
    x, y = _place(row)
    method, planned = row["method"], row["method"] in ("plan", "robust")
    if method == "plan" and row["backend"] != quickest:
        return
    peer = method.startswith(PEER)
    solid = peer or planned or (bool(row["best"]) if method == "paper" else row["backend"] == quickest)
    colour = COLOURS.get(method, PEER_COLOUR)
    marker = "*" if planned else MARKERS.get(method, "X") if peer else "o"
    point = axes.scatter(
        x,
        y,
        s=190 if planned else 45,
        marker=marker,
        facecolor=colour if solid else "none",
        edgecolor="black" if planned or peer else colour,
        lw=0.8,
        zorder=5 if planned else 3,
    )
    words = f"{method.removeprefix(PEER)}, {row['units']:g}"
    if row["class"] == INVERSE:
        method = "the default" if planned else f"the paper's carving, eps {row['units']:g}"
        words = f"{row['surface']}: {method}" + " (the best)" * bool(row.get("best"))
    elif planned:
        share = float(row.get("planning") or 0) / row["seconds"]
        words = f"default at a tolerance of {row['units']:.1%}; planning is {share:.0%} of the time"
        offset = (8, -11 + 9 * TOLERANCES.index(row["units"])) if row["units"] in TOLERANCES else (8, 0)
        name = f"{100 * row['units']:g} %"
        axes.annotate(name, (x, y), offset, textcoords="offset points", fontsize=8, zorder=6)
    gid = f"point-{len(hints)}"
    point.set_gid(gid)
    backend = "" if peer else f" ({row['backend']})"
    error = "RMSE in layers" if row["class"] == INVERSE else "error"
    hints[gid] = f"{words}{backend}: {row['seconds']:.3g} s, {error} {row['error']:.2g}"


def _draw_frontier(axes: Axes, points: list[tuple[float, float]]) -> None:
    edge = frontier(points)
    axes.plot(*zip(*edge), color="0.35", lw=1.2, zorder=1)
    style: Row = dict(textcoords="offset points", ha="left", fontsize=8, color="0.35")
    axes.annotate("frontier", edge[-1], (8, -10), **style)


def _draw_axes(panels: Any, kinds: Sequence[str], cols: int, size: int) -> None:
    """Time in ns per node below and in s per megapixel above, same but for the inverse; where better is."""
    forward = [axes for axes, kind in zip(panels, kinds) if kind != INVERSE]
    limits = [(*axes.get_xlim(), *axes.get_ylim()) for axes in forward]
    for axes in forward:
        left, right, low, high = zip(*limits)
        axes.set(xlim=(min(left), max(right)), ylim=(min(low), max(high)))
    for number, (axes, kind) in enumerate(zip(panels, kinds)):
        axes.annotate(
            "better",
            (0.015, 0.02),
            (0.09, 0.1),
            xycoords="axes fraction",
            fontsize=9,
            color="0.3",
            arrowprops={"arrowstyle": "->", "color": "0.3"},
        )
        if kind == INVERSE:
            axes.set(xlabel="time of the whole call [s]", ylabel="RMSE of depth [layers of 64]")
            continue
        if number + cols >= len(kinds):
            axes.set_xlabel(f"time of the whole call, {size} x {size} nodes [ns per node]")
        if number % cols == 0:
            axes.set_ylabel("RMS error over the mean")
        if number < cols:
            above = axes.secondary_xaxis("top", functions=(lambda ns: ns / 1000, lambda s: s * 1000))
            above.set_xlabel("[s per megapixel]", fontsize=9)


def _draw_legend(
    figure: Figure, spare: Any, rows: list[Row], quickest: str, labels: Mapping[str, str]
) -> None:
    """The legend of colours and markers, in a ``spare`` panel or below."""
    from matplotlib.lines import Line2D

    def mark(
        colour: str, marker: str, label: str, edge: str = "none", size: int = 7, fill: bool = True
    ) -> Line2D:
        style: Row = dict(ls="", marker=marker, label=label, markersize=size)
        face, edge = (colour, edge) if fill else ("none", colour)
        return Line2D([], [], color=face, markeredgecolor=edge, **style)

    backends = {row["backend"] for row in rows if not row["method"].startswith(PEER)}
    inverse = any(row["class"] == INVERSE for row in rows)
    peers = sorted({row["method"] for row in rows if row["method"].startswith(PEER)})
    names = {
        "horizon": "horizons; slices under a lamp",
        "filled": "lattice, filled",
        "stride": "lattice, stride (the paper)",
        "unoccluded": "closed form, occlusion left out",
    }
    handles = [mark(COLOURS[method], "o", label) for method, label in names.items()]
    if inverse:
        handles.append(mark(COLOURS["paper"], "o", "the paper's carving; filled: its best eps"))
    handles.append(mark(COLOURS["plan"], "*", "the default, by tolerance", "black", 13))
    if len(backends) > 1:
        handles.append(mark("0.3", "o", f"hollow: not on {quickest}", fill=False))
    for peer in peers:
        label = labels.get(peer, peer.removeprefix(PEER))
        handles.append(mark(COLOURS.get(peer, PEER_COLOUR), MARKERS.get(peer, "X"), label, "black"))
    if len(spare):
        spare[0].legend(handles=handles, loc="center", frameon=False, fontsize=10)
    else:
        figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)


def _add_hints(path: Path, hints: Mapping[str, str]) -> None:
    """Texts that appear on hover over the points of an SVG."""
    text = path.read_text(encoding="utf-8")
    for gid, words in hints.items():
        text = text.replace(f'<g id="{gid}">', f'<g id="{gid}"><title>{escape(words)}</title>', 1)
    path.write_text(text, encoding="utf-8")
