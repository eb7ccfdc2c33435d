"""Pictures (extra ``plot``, matplotlib): the visibility field's discs, the sky above a node, recovered depth,
and maps with a scale bar.

Each function returns a matplotlib Figure, made without pyplot: no window opens, no global state changes. Save
it with :func:`save`, or ``figure.savefig``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .. import oracle, sources
from ..arrays import axes_of, labels_of
from ..checks import number_or_nan, positive_number, whole_number
from ..directions import angles_on
from ..errors import bad, import_extra
from ..horizon import horizon_at
from ..inverse.recover import Recovery
from ..io.files import numbers
from ..io.paths import StrPath, destination, replacing
from ..scene import Scene, check_scene
from ..sources.cie import CieSky
from ..visibility import View, VisibilityField

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

FIGURE_SUFFIXES = (".png", ".svg", ".pdf")
MOST_DPI = 10_000  # chosen: such a figure has 1e9 pixels and more
DISCS = 12  # along the longer side of a section, unless asked otherwise
RADIUS = 0.42  # of a disc, as a share of the distance between discs
GREYS = "0.2", "0.72"  # black, and the brightest surface; the source is white
GROUND = "#6b5b4b"
MISSING = "#7fa7d9"  # of nodes without a value: no grey


def field(
    field: VisibilityField, row: int | None = None, every: int | None = None, backend: str = "auto"
) -> Figure:
    """The paper's Fig. 1: a section of the visibility field along ``row`` (the middle one unless given).

    A disc stands for the rays through a point of free space that lie in the plane of the drawing. In
    white sectors the source is visible, in grey ones a lit surface with its brightness; the rest is black.
    ``every``: nodes between discs. Only directions (i, 0, k) lie in the plane: the field's hemicube of M
    makes 4 (M - 1) sectors.

    Raises InputError for a row outside the map, a source or a surface in colour, or if matplotlib is not
    installed.
    """
    matplotlib = _matplotlib()
    if not isinstance(field, VisibilityField):
        raise bad("plot.field: field", type(field).__name__, "what skylamp.visibility_field returned")
    rows, cols = field.scene.shape
    row = whole_number(rows // 2 if row is None else row, "plot.field: row", 0, rows - 1)
    depth = field.depth[row]
    if every is None:  # smaller discs where the ground leaves no room for larger ones
        every = max(2, round(max(cols, field.layers) / DISCS))
        while every > 2 and not _disc_centres(depth, field.layers, every):
            every = max(2, every // 2)
    every = whole_number(every, "plot.field: every", 2, allowed="a whole number of nodes, at least 2")
    points, radius = _disc_centres(depth, field.layers, every), RADIUS * every
    if not points:
        raise bad(
            f"plot.field: every, in a map of {cols} nodes along a row and {field.layers} layers",
            every,
            "a distance at which at least one disc fits above the ground of the row",
            "Give a smaller one, or another row." if every > 2 else "Give another row, or a deeper map.",
        )
    views = [field.view((x, row, z), backend=backend) for x, z in points]
    brightest = max(max(view.brightness[~view.visible].max() for view in views), 1e-30)
    floor = np.where(np.isfinite(depth), depth, field.layers)
    bottom = max(field.layers, floor.max()) + 0.03 * cols
    figure = _figure(9.5, float(np.clip(0.9 + 8.0 * (bottom + 0.02 * cols) / cols, 2.8, 9)))
    axes = figure.add_subplot()
    shades = matplotlib.colors.LinearSegmentedColormap.from_list("surface", list(GREYS))
    axes.set_facecolor("#cdd8e3")
    along = np.linspace(-0.5, cols - 0.5, 8 * cols)
    axes.fill_between(along, np.interp(along, np.arange(cols), floor), bottom, color=GROUND, lw=0)
    for point, view in zip(points, views):
        _draw_disc(axes, point, radius, view, shades(view.brightness / brightest))
    axes.set(
        xlim=(-0.5, cols - 0.5),
        ylim=(bottom, -0.02 * cols),
        aspect="equal",
        xlabel="x [nodes]",
        ylabel="depth [nodes]",
        title=f"Rays through points of row {row}: white from the {type(field.source).__name__.lower()}",
    )
    mappable = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0, brightest), shades)
    bar = figure.colorbar(mappable, ax=axes, shrink=0.8, pad=0.015)
    bar.set_label("brightness of visible surfaces")
    return figure


def _disc_centres(depth: np.ndarray, layers: int, every: int) -> list[tuple[int, int]]:
    """(x, layer) of discs ``every`` nodes apart that keep clear of the ground below a row of the map."""
    cols, rim, radius = len(depth), every // 2, RADIUS * every
    start = rim + (cols - 1 - 2 * rim) % every // 2  # as much room on the left as on the right
    return [
        (x, z)
        for z in range(rim, layers, every)
        for x in range(start, cols - rim, every)
        if z + radius < (depth[max(0, int(x - radius)) : int(x + radius) + 2]).min()
    ]


def _draw_disc(axes: Axes, centre: tuple[int, int], radius: float, view: View, surface: np.ndarray) -> None:
    """One disc; ``surface``: (directions, 4) colours where the source is not visible."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle, Wedge

    low, high, which = sectors(view)
    colours = np.where(view.visible[which, None], 1.0, surface[which])
    # depth is drawn downwards, which turns angles round
    wedges = [Wedge(centre, radius, -b, -a) for a, b in zip(low, high)]
    axes.add_collection(PatchCollection(wedges, facecolors=colours, edgecolors=colours, linewidths=0.3))
    axes.add_patch(Circle(centre, radius, fill=False, ec="0.2", lw=0.6))


def sectors(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(angle [degree] at which each sector starts, ends; index of its direction), in the plane y = const.

    Angles run from +x towards the viewer's side, -z. A sector reaches halfway to the neighbouring directions.
    """
    flat = np.flatnonzero(view.steps[:, 1] == 0)
    angle = np.degrees(np.arctan2(-view.directions[flat, 2], view.directions[flat, 0])) % 360
    order = np.argsort(angle)
    angle = angle[order]
    before, after = np.roll(angle, 1), np.roll(angle, -1)
    before[0] -= 360
    after[-1] += 360
    return (angle + before) / 2, (angle + after) / 2, flat[order]


def horizon(
    scene: Scene,
    row: int,
    col: int,
    source: sources.Sky | None = None,
    azimuths: int = 360,
    backend: str = "auto",
    max_distance: float | None = None,
) -> Figure:
    """The sky above one node: the horizon and the brightness above it, as a polar plot.

    The zenith is in the middle, the level horizon at the rim, north (-y) up and east (+x) to the right, as on
    the map (a view from above, not from below). The dashed line is where the surface's own
    tangent plane ends. ``source``: a Sky, uniform unless given. ``max_distance`` [unit of spacing]: ground
    farther away does not count, as of :func:`skylamp.horizons`.

    Raises InputError for a node that is outside or masked, a source that is no sky, or if matplotlib is not
    installed.
    """
    _matplotlib()
    check_scene(scene)
    azimuths = whole_number(azimuths, "plot.horizon: azimuths", 3, 10_000)
    row = whole_number(row, "plot.horizon: row", 0, scene.shape[0] - 1)
    col = whole_number(col, "plot.horizon: col", 0, scene.shape[1] - 1)
    if not scene.valid[row, col]:
        raise bad("plot.horizon: node", (row, col), "a node that is not masked")
    source = sources.Sky() if source is None else source
    if not isinstance(source, sources.Sky):
        raise bad("plot.horizon: source", type(source).__name__, "a Sky")
    sun = None
    if isinstance(source.brightness, CieSky) and source.brightness.direct:
        sun, source = source.brightness.sun, sources.Sky(source.brightness.without_disc())
    turn = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths  # from east towards south
    on_map = angles_on(scene.axes, turn)
    elevation = np.degrees(np.arctan(horizon_at(scene, row, col, on_map, backend, max_distance)))
    compass = turn + np.pi / 2  # from north, clockwise

    figure = _figure(6.4, 5.6)
    axes: Any = figure.add_subplot(projection="polar")  # PolarAxes: add_subplot is typed as Axes
    mesh = _draw_sky(axes, source, turn, elevation)
    ring = np.append(compass, compass[0] + 2 * np.pi)
    axes.plot(ring, np.append(90 - elevation, 90 - elevation[0]), color="k", lw=1.5, label="horizon")
    plane = _tangent_plane(scene, row, col, on_map)
    plane = np.where(plane > 0, 90 - plane, np.nan)
    if np.isfinite(plane).any():
        axes.plot(ring, np.append(plane, plane[0]), color="w", lw=1.2, ls="--", label="tangent plane")
    if sun is not None:
        axes.plot(np.radians(sun[0]), 90 - sun[1], "o", ms=9, mfc="#ffd54a", mec="k", label="sun")
    _label_compass(axes)
    figure.colorbar(mesh, ax=axes, shrink=0.7, pad=0.1, label="brightness of the visible sky")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower right", ncols=3, fontsize=9, facecolor=GROUND, labelcolor="w")
    seen = float((np.cos(np.radians(elevation)) ** 2).mean())
    figure.suptitle(
        f"Row {row}, column {col}: horizon to {elevation.max():.0f}°, sky-view factor of level ground"
        f" {seen:.2f}",
        fontsize=11,
    )
    return figure


def _draw_sky(axes: PolarAxes, source: sources.Sky, turn: np.ndarray, elevation: np.ndarray) -> Any:
    """The sky's brightness above the horizon ``elevation`` [degree] of the azimuths ``turn`` [rad]."""
    edges = np.linspace(0, 2 * np.pi, len(turn) + 1), np.linspace(0, 90, 181)
    heights = 90 - (edges[1][:-1] + edges[1][1:]) / 2
    light = sources.radiance(source, sources.directions_of(turn[None], np.sin(np.radians(heights))[:, None]))
    light = np.where(heights[:, None] >= elevation, light, np.nan)
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_facecolor(GROUND)
    top = np.nanmax(light) if np.isfinite(light).any() else 1.0
    uniform = np.isfinite(light).any() and np.nanmin(light) >= 0.999 * top
    style: dict[str, Any] = dict(cmap="YlGnBu_r", vmin=0 if uniform else None, vmax=top or 1.0)
    return axes.pcolormesh(edges[0] + np.pi / 2, edges[1], light, rasterized=True, **style)


def _tangent_plane(scene: Scene, row: int, col: int, turn: np.ndarray) -> np.ndarray:
    """Elevation [degree] of a node's tangent plane, in the azimuths ``turn`` [rad] of the map's own axes."""
    near = slice(max(0, row - 1), row + 2), slice(max(0, col - 1), col + 2)
    tilts = oracle.gradient(scene.depth[near], scene.spacing, scene.valid[near])
    gx, gy = (tilt[min(row, 1), min(col, 1)] for tilt in tilts)
    # the ground rises where depth falls
    elevation: np.ndarray = np.degrees(np.arctan(-(gx * np.cos(turn) + gy * np.sin(turn))))
    return elevation


def _label_compass(axes: PolarAxes) -> None:
    """Directions of the compass along the rim, elevations along a radius."""
    axes.set_xticks(np.radians(np.arange(0, 360, 45)), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    box = dict(boxstyle="round,pad=0.1", fc="w", ec="none", alpha=0.7)
    axes.set_yticks([30, 60, 90], ["60°", "30°", ""], fontsize=9, bbox=box)
    axes.set_rlabel_position(112)
    axes.set_rlim(0, 90)
    axes.grid(color="0.5", lw=0.5, alpha=0.6)


def recovery(image: ArrayLike, found: Recovery, truth: ArrayLike | None = None) -> Figure:
    """The image, the depth recovered from it, its confidence, and the albedo if it was recovered.

    ``found``: what :func:`skylamp.recover` returned; ``truth``: the true depth, for comparison, with the
    error (recovered minus true depth); image, truth: (rows, cols). The panels are side by side. Axes are in
    nodes; nodes without a finite value are blue. Raises InputError where shapes differ, if ``found`` is
    something else, or if matplotlib is not installed.

    Example: ``plot.save(plot.recovery(image, sl.recover(image, sky)), "recovered.png")``
    """
    _matplotlib()
    if not isinstance(found, Recovery):
        raise bad("plot.recovery: found", type(found).__name__, "what skylamp.recover returned")
    image, depth = numbers(image, "plot.recovery: image"), np.asarray(found.depth)
    depths = [depth] if truth is None else [depth, np.asarray(truth)]
    nearest, farthest = np.nanmin([np.nanmin(z) for z in depths]), np.nanmax([np.nanmax(z) for z in depths])
    scale = dict(cmap="viridis_r", vmin=nearest, vmax=farthest)
    sure = dict(cmap="cividis", vmin=0, vmax=1)
    panels: list[tuple[str, np.ndarray, dict[str, Any], str]] = [
        ("image", image, dict(cmap="gray", vmin=0, vmax=float(np.nanmax(image)) or 1.0), "radiance"),
        ("recovered depth", depth, scale, "depth [unit of spacing]"),
    ]
    for true in depths[1:]:
        if true.shape != depth.shape:
            raise bad("plot.recovery: true depth", true.shape, f"the depth's shape {depth.shape}")
        error = depth - true
        most = float(np.nanmax(np.abs(error))) or 1.0
        name = f"error, RMS {np.sqrt(np.nanmean(error**2)):.2g}"
        panels.append(("true depth", true, scale, "depth [unit of spacing]"))
        panels.append((name, error, dict(cmap="PuOr", vmin=-most, vmax=most), "recovered - true"))
    panels.append(("confidence", np.asarray(found.confidence), sure, "doubtful below 0.5"))
    if found.albedo is not None:
        panels.append(("albedo", np.asarray(found.albedo), dict(cmap="gray", vmin=0), "albedo"))
    for name, values, _, _ in panels:
        if values.shape != depth.shape:
            raise bad(f"plot.recovery: {name}", values.shape, f"the depth's shape {depth.shape}")
    rows, cols = depth.shape
    across = min(len(panels), 3)
    down = -(-len(panels) // across)
    figure = _figure(3.5 * across, float(np.clip(0.6 + 2.7 * rows / cols, 1.8, 8)) * down)
    places = figure.subplots(down, across, squeeze=False).flat
    for (name, values, style, label), axes in zip(panels, places):
        shown = axes.imshow(np.ma.masked_invalid(values), interpolation="nearest", **style)
        shown.set_cmap(shown.get_cmap().with_extremes(bad=MISSING))
        axes.set_title(name, fontsize=11)
        axes.set_xticks([0, cols - 1])
        axes.set_yticks([0, rows - 1])
        figure.colorbar(shown, ax=axes, shrink=0.8, pad=0.03, label=label)
    for axes in places:
        axes.set_axis_off()
    return figure


def terrain(
    values: ArrayLike,
    spacing: float,
    title: str = "",
    label: str = "",
    vmin: float | None = None,
    vmax: float | None = None,
) -> Figure:
    """A map of values (rows, cols) with north, a scale bar and a scale of the values.

    spacing: distance of neighbouring nodes [m]. north is up, the direction -y; a DataArray is turned so that
    it is. Nodes without a finite value, or masked in a numpy masked array, are blue. title, label: texts of
    the map and of its scale, with the unit; what stands between two $ is mathtext, unless matplotlib cannot
    read it. vmin, vmax: the values of black and white; the least and the largest unless given.

    Returns a matplotlib Figure. Raises InputError for another shape, type or spacing, a vmin above vmax, or
    if matplotlib is not installed.

    Example: ``plot.save(plot.terrain(sl.sky_view_factor(scene), 30.0, label="sky-view factor"), "svf.png")``
    """
    _matplotlib()
    east, south = axes_of(labels_of(values))
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(float), np.nan)
    values = np.asarray(values)
    if values.ndim != 2 or not values.size or values.dtype.kind not in "biuf":
        got = f"shape {values.shape}, dtype {values.dtype}"
        raise bad("plot.terrain: values", got, "real numbers (rows, cols), at least one")
    spacing = positive_number(spacing, "plot.terrain: spacing")
    values = values[:: int(south), :: int(east)]
    _check_limits(values, vmin, vmax)
    rows, cols = values.shape
    figure = _figure(6.2, float(np.clip(5.2 * rows / cols + 0.4, 2, 9)))
    draw_terrain(figure.add_subplot(), values, spacing, title, label, vmin, vmax)
    return figure


def _check_limits(values: np.ndarray, vmin: Any, vmax: Any) -> None:
    """InputError unless the limits, by default the least and the largest finite value, are in order."""
    known = values[np.isfinite(values)]
    least, most = (known.min(), known.max()) if known.size else (0.0, 1.0)
    low, high = map(number_or_nan, (least if vmin is None else vmin, most if vmax is None else vmax))
    if not (np.isfinite([low, high]).all() and low <= high):
        got = f"{vmin!r}, {vmax!r} of values from {least} to {most}"
        raise bad("plot.terrain: vmin, vmax", got, "finite numbers, vmin <= vmax")


def _shown_as(text: str) -> dict[str, Any]:
    """Properties with which matplotlib shows a text: literally where it is no mathtext that it can read."""
    from matplotlib.cbook import is_math_text
    from matplotlib.mathtext import MathTextParser

    try:
        if is_math_text(text):
            MathTextParser("path").parse(text)
    except ValueError:
        return {"parse_math": False}
    return {}


def draw_terrain(
    axes: Axes,
    values: np.ndarray,
    spacing: float,
    title: str = "",
    label: str = "",
    vmin: float | None = None,
    vmax: float | None = None,
) -> None:
    """:func:`terrain` in axes of a figure of one's own."""
    rows, cols = values.shape
    known = np.ma.masked_invalid(values)
    shown = axes.imshow(known, cmap="gray", vmin=vmin, vmax=vmax, interpolation="nearest")
    shown.set_cmap(shown.get_cmap().with_extremes(bad=MISSING))
    axes.set_xticks([])
    axes.set_yticks([])
    literally = _shown_as(title)  # which matplotlib cannot wrap
    axes.set_title(title, fontsize=11, wrap=not literally, **literally)
    if label:
        bar = axes.figure.colorbar(shown, ax=axes, shrink=0.85, pad=0.02)
        bar.set_label(label, **_shown_as(label))
    length = _round_length(cols * spacing / 4)
    words = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    x, wide = 0.05 * cols - 0.5, length / spacing
    across = axes.get_xaxis_transform()  # x in nodes, y a share of the map's height
    box = dict(facecolor="white", edgecolor="none", alpha=0.8, pad=1.5)
    text: dict[str, Any] = dict(bbox=box, fontsize=9, color="black", ha="center")
    for colour, width in (("black", 5), ("white", 2.5)):
        axes.plot([x, x + wide], [0.07] * 2, color=colour, lw=width, transform=across, solid_capstyle="butt")
    axes.text(x + wide / 2, 0.1, words, va="bottom", transform=across, **text)
    x, y = 0.95 * cols - 0.5, 0.17 * rows - 0.5
    arrow = dict(facecolor="black", edgecolor="white", width=3, headwidth=9, headlength=9)
    axes.annotate("N", (x, y - 0.12 * rows), (x, y), va="center", arrowprops=arrow, **text)
    axes.set(xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))  # the bar's place widens no small map


def _round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not beyond ``most``."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * max(step for step in (0.5, 1, 2, 5) if step * power <= most))


def save(figure: Figure, path: StrPath, dpi: float = 120) -> Path:
    """Write a figure as .png, .svg or .pdf, whole or not at all.

    Raises InputError for another extension, no such folder, or a ``dpi`` that is no number from 0 to 10,000.
    """
    path, dpi = drawable(path), positive_number(dpi, "dpi")
    if dpi > MOST_DPI:
        raise bad("dpi", dpi, f"at most {MOST_DPI}")
    if not hasattr(figure, "savefig"):
        raise bad("plot.save: figure", type(figure).__name__, "a figure of matplotlib")
    suffix = path.suffix.lower()
    options: dict[str, Any] = {"pil_kwargs": {"optimize": True}} if suffix == ".png" else {}
    with replacing(path) as file:
        figure.savefig(file, format=suffix[1:], dpi=dpi, **options)
    return path


def drawable(path: StrPath) -> Path:
    """``path`` if a picture can be put there.

    Raises InputError for another extension, no such folder, or without matplotlib.
    """
    path = Path(path)
    if path.suffix.lower() not in FIGURE_SUFFIXES:
        raise bad(f"{path}: unknown extension of a picture", repr(path.suffix), " ".join(FIGURE_SUFFIXES))
    _matplotlib()
    return destination(path)


def _matplotlib() -> Any:
    modules = "matplotlib", "matplotlib.cm", "matplotlib.colors"
    return import_extra("a picture", "matplotlib", "plot", *modules)[0]


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
