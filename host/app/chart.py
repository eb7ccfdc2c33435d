"""Speed against accuracy: every method, setting and backend that is here as a point, and where the plan's
choices stand among them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from .. import sources
from ..backends import backends, select
from ..errors import bad
from ..refinement import solid_of, upright
from ..rendering import render
from ..samples import Samples
from ..scene import Scene

CLASSES = ("smooth", "rough", "urban", "lamp")
TOLERANCES = (0.03, 0.01, 0.003)
NODES, FIRST = 300, 100_003  # at which errors are taken; other nodes than a plan's samples
SKY = (
    [("horizon", k) for k in (4, 6, 8, 12, 16, 24, 32, 64, 128)]
    + [("filled", m) for m in (5, 9, 17, 33)]
    + [("stride", m) for m in (5, 9, 17, 33)]
    + [("unoccluded", 0)]
)
LAMP = (
    [("slices", s) for s in (8, 16, 32, 64, 128)]
    + [("filled", m) for m in (9, 17, 33)]
    + [("stride", m) for m in (9, 17, 33)]
    + [("unoccluded", 0)]
)
RUNS = 3


def scene_of(kind: str, size: int) -> tuple[Scene, sources.Source]:
    """A scene of the class and its source: fractal ground of rms slope 0.5 or 1, blocks of houses, or the
    rough ground under a lamp.
    """
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


def options_of(method: str, units: int) -> dict:
    if method in ("stride", "filled"):
        return {"method": "lattice", "hemicube": units, "filled": method == "filled"}
    return {"method": "unoccluded"} if method == "unoccluded" else {"method": "horizon", "azimuths": units}


def judged(kind: str, size: int, engine):
    """(scene, source, samples, exact irradiance at them)."""
    scene, source = scene_of(kind, size)
    samples = Samples(engine, scene, NODES, FIRST)
    solid = None if isinstance(source, sources.Sky) else upright(solid_of(scene, source, 1.0, 1.0))
    return scene, source, samples, samples.exact(source, solid)


def measure(
    names: list[str] | None = None, sizes=(128, 512), longest: float = 1.5, progress=None
) -> list[dict]:
    """Rows of class, size, backend, method, units, error (relative RMS), seconds of the whole call, of it to
    plan, and again; the plan's are ``method`` "plan", their units the tolerance, timed on a scene that is
    new, and "again" on one that was rendered before.

    A setting is left out if the next coarser one of its method took longer than ``longest`` seconds a call,
    or would have, as the next smaller map has it.
    """
    here = [info.name for info in backends() if info.available]
    for name in names or []:
        select(name)
    engines = {select(name).name: select(name) for name in names or here}
    if not sizes or min(sizes) < 16:
        raise bad("chart: sizes", list(sizes), "whole numbers from 16 on")
    best = select("auto")
    rows, jobs, took_before = [], [(kind, size) for kind in CLASSES for size in sorted(sizes)], {}
    for number, (kind, size) in enumerate(jobs):
        scene, source, samples, exact = judged(kind, size, best)
        for name in engines:
            points, slow = [], set()

            def point(method, units, options):
                last, seconds = took_before.get((kind, name, method, units), (size, 0.0))
                if method in slow or seconds * (size / last) ** 2 > longest:
                    return
                work = lambda scene: render(scene, source, backend=name, quantity="irradiance", **options)
                out = work(scene)
                if out.seconds > longest:
                    slow.add(method)
                took_before[kind, name, method, units] = size, out.seconds
                points.append(
                    (
                        {
                            "class": kind,
                            "size": size,
                            "backend": name,
                            "method": method,
                            "units": units,
                            "error": samples.errors(samples.of(out.image), exact).rms,
                        },
                        work,
                        [],
                        [],
                    )
                )

            for method, units in LAMP if kind == "lamp" else SKY:
                point(method, units, options_of(method, units))
            for tolerance in TOLERANCES:
                point("plan", tolerance, {"tolerance": tolerance})
            for _ in range(RUNS):  # in turns, so that what else the machine does falls on all of them
                for row, work, times, again in points:
                    if sum(took for took, _ in times) < longest:
                        out = work(replace(scene) if row["method"] == "plan" else scene)
                        times.append((out.seconds, out.plan.planning_seconds or 0.0))
                        again.append(work(scene).seconds if row["method"] == "plan" else out.seconds)
            rows += [
                {**row, **dict(zip(("seconds", "planning"), min(times))), "again": min(again)}
                for row, _, times, again in points
            ]
        if progress:
            progress(number + 1, len(jobs))
    return rows


def frontier(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Of (seconds, error), those that no other beats in both, by time."""
    left, lowest = [], math.inf
    for seconds, error in sorted(points):
        if error < lowest:
            left.append((seconds, error))
            lowest = error
    return left


def behind(rows: list[dict], time: str = "seconds", as_accurate: bool = False) -> dict[str, list[float]]:
    """Where the default stands: by class, for each tolerance, its ``time`` ("again": of a scene that was
    rendered before) over that of the quickest setting of any method and backend that is within the tolerance,
    or, ``as_accurate``, no less accurate than the default's own image, on the largest maps; nan where none
    is. The default is the plan on the backend where it is quickest.
    """
    largest, found = max(row["size"] for row in rows), {}
    for kind in CLASSES:
        here = [
            row
            for row in rows
            if row["class"] == kind and row["size"] == largest and not row["method"].startswith("peer")
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
            best = min(
                (
                    row["seconds"]
                    for row in here
                    if row["method"] != "plan" and row["error"] <= (error if as_accurate else tolerance)
                ),
                default=math.nan,
            )
            found.setdefault(kind, []).append(ours / best)
    return found


def draw(rows: list[dict], path, title: str = "") -> None:
    """The chart as PNG: a panel a class, error against time per node; needs matplotlib."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(12.5, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    names, sizes = (
        sorted({row["backend"] for row in rows if not row["method"].startswith("peer")}),
        sorted({row["size"] for row in rows}),
    )
    colours = {
        "horizon": "C0",
        "slices": "C0",
        "filled": "C1",
        "stride": "C3",
        "unoccluded": "C2",
        "plan": "k",
    }
    marks = dict(zip(names, "osD^v<>"))
    peers = sorted({row["method"] for row in rows if row["method"].startswith("peer")})
    floor = 2e-5
    for axes, kind in zip(figure.subplots(2, 2).flat, CLASSES):
        largest = max(sizes)
        for row in (r for r in rows if r["class"] == kind):
            x, y, area = (
                1e9 * row["seconds"] / row["size"] ** 2,
                max(row["error"], floor),
                42 if row["size"] == largest else 14,
            )
            if row["method"] in peers:
                axes.scatter(x, y, s=50, marker="X", color=f"C{4 + peers.index(row['method'])}", zorder=3)
            elif row["method"] != "plan":
                axes.scatter(
                    x,
                    y,
                    s=area,
                    marker=marks[row["backend"]],
                    facecolor=colours[row["method"]] if row["size"] == largest else "none",
                    edgecolor=colours[row["method"]],
                    lw=0.8,
                    alpha=0.8,
                )
        of = [r for r in rows if r["class"] == kind and r["size"] == largest]
        edge = frontier(
            [
                (1e9 * r["seconds"] / r["size"] ** 2, max(r["error"], floor))
                for r in of
                if r["method"] != "plan"
            ]
        )
        axes.plot(*zip(*edge), color="0.4", lw=1.2, zorder=1)
        quickest = min((r for r in of if r["method"] == "plan"), key=lambda r: r["seconds"], default=None)
        level = {t: n for n, t in enumerate(TOLERANCES)}
        for row in (r for r in of if r["method"] == "plan" and r["backend"] == quickest["backend"]):
            x, y = 1e9 * row["seconds"] / row["size"] ** 2, max(row["error"], floor)
            axes.plot(
                [x * (1 - float(row.get("planning") or 0) / row["seconds"]), x],
                [y, y],
                color="k",
                lw=1.1,
                zorder=4,
            )
            axes.scatter(x, y, s=190, marker="*", color="gold", edgecolor="k", lw=0.9, zorder=5)
            axes.annotate(
                f"{100 * row['units']:g} %",
                (x, y),
                (9, 10 - 13 * level.get(row["units"], 0)),
                textcoords="offset points",
                fontsize=8,
                zorder=6,
            )
        axes.margins(0.06, 0.08)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_title(
            {"lamp": "rough ground, spherical lamp"}.get(
                kind, f"{kind} ground, uniform sky" if kind != "urban" else "urban steps, uniform sky"
            ),
            fontsize=11,
        )
        axes.set_xlabel("time of the whole call [ns per node]")
        axes.set_ylabel("relative RMS error")
        axes.grid(which="both", alpha=0.15)
    dot = lambda colour, mark="o", label="", fill=True, size=7: Line2D(
        [],
        [],
        ls="",
        marker=mark,
        color=colour,
        markerfacecolor=colour if fill else "none",
        label=label,
        markersize=size,
    )
    handles = [
        dot("C0", label="horizon (lamp: slices)"),
        dot("C1", label="lattice, filled"),
        dot("C3", label="lattice, stride (the paper)"),
        dot("C2", label="unoccluded"),
    ]
    handles += [dot("0.3", marks[name], name) for name in names]
    handles += [
        dot(
            "0.3",
            label=f"{size} x {size} nodes",
            fill=size == max(sizes),
            size=7 if size == max(sizes) else 4,
        )
        for size in sizes
    ]
    handles += [
        Line2D([], [], color="0.4", lw=1.2, label=f"frontier, {max(sizes)} x {max(sizes)}"),
        Line2D(
            [],
            [],
            ls="",
            marker="*",
            color="gold",
            markeredgecolor="k",
            markersize=13,
            label="the default, by tolerance; to its left, planning",
        ),
    ]
    handles += [dot(f"C{4 + n}", "X", peer[5:]) for n, peer in enumerate(peers)]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    if title:
        figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=100)
