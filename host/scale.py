"""Maps beyond one device: canonical tiles, each with a halo of the map and overviews of the rest.

A tile's bytes depend on the heights, the tiling, the azimuths and the backend. They do not depend on the
chunks of the map, nor on how many workers compute tiles, or in which order.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import sys
import warnings
from collections.abc import Iterable, Iterator
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import DTypeLike

from .arrays import Quantity, by_bands, labelled
from .backends import backends, prefer
from .backends.base import Backend, has_room, within
from .checks import positive_number
from .constants import LEAST_SEARCHED_SLOPE, MOST_PIXELS
from .directions import Azimuths
from .errors import InputError, bad, lacking
from .light.far import (
    Far,
    Tiling,
    Top,
    around,
    coarser,
    from_heights,
    marched,
    marched_nodes,
    scaled,
    spread_of,
    top_of,
)
from .light.sweeps import NODE_BYTES, TILT_BYTES, Rays, engine_of
from .samples import Samples, lit_mean, ring
from .scene import ALBEDO, Scene

MOST_MARGIN = 128  # [node] beside a map that is swept: at most 96 near rows, the lanes of a CPU and 3
REFRACTED = 0.87  # of the Earth's curvature that light, which bends with the air, leaves; Corripio 2003
GROUP_BYTES = 2**30  # of the horizons of one tile that are in memory at a time; chosen

# nodes of a tile whose far ground is compared with exact rays, in so many azimuths; chosen: an RMS is known
# to 1 / sqrt(2 x 256), 4 %, if errors are normal
AUDITED, AUDITED_AZIMUTHS = 256, 16
# RMS error of sky-view factors above which there is a warning; chosen: three times that of mountains
# (performance/scale.py)
WORTH_SAYING = 0.001
# measured on cities of seven kinds (performance/scale.py --cities): 0.58 to 0.82
CLOSER = "a Tiling of twice the halo and rule leaves 0.6 to 0.8 of that"

USUAL = Tiling()  # of maps that are given none

# windows of a tile, and nodes along each side of a window: from their light, that between surfaces is
# estimated. Chosen: 0.2 % of a tile of 8192 x 8192 nodes, 14 % of one of 1024; in windows of half the side
# nodes see a third less ground, and windows of twice the side take four times as long
WINDOWS, WINDOW = 9, 128

Way = tuple[int, int]  # from a tile to a neighbour, in tiles: down and across
BESIDE = [(down, across) for down in (-1, 0, 1) for across in (-1, 0, 1) if down or across]

Box = tuple[tuple[int, int], tuple[int, int]]  # a tile's first row and its rows, first column and columns
Lights = tuple[tuple[Rays, np.ndarray | None], ...]  # azimuths and tables of skies, see skylamp.samples.ring


class Work(Protocol):
    """What is computed of a map, or of a tile with its halo and overviews of the rest."""

    def __call__(
        self, scene: Scene, max_distance: float | None, far: Far | None, part: slice = ...
    ) -> np.ndarray:
        """(rows, cols) float32; or ``part`` of an axis before these."""


class Undecided(Work, Protocol):
    """Work that depends on the whole map: whether light between surfaces is added."""

    def sums(self, scene: Scene) -> np.ndarray:
        """Sums over a window of the map; :meth:`decided` takes their total over all windows."""

    def decided(self, sums: np.ndarray, possible: bool) -> Work:
        """The work itself; ``possible``: whether tiles have a halo of their own."""


class Audit(NamedTuple):
    """The check of the error that overviews of far ground add: on which backend, within which tolerance.

    ``tolerance``: relative RMS error of the irradiance of each of ``lights``; None: sky-view factors to
    WORTH_SAYING. ``suns``: small bright parts are among the lights, whose shadows have edges.
    """

    backend: str
    tolerance: float | None = None
    lights: Lights = ()
    suns: bool = False


class Layout(NamedTuple):
    """A map in tiles: all that a tile depends on besides heights.

    ``spacing`` [length]; ``max_distance`` [length] or None; ``room``: nodes around every tile that are
    computed with it, besides the halo; ``undecided``: the work is :class:`Undecided`.
    """

    tiling: Tiling
    shape: tuple[int, int]
    spacing: float
    periodic: bool
    max_distance: float | None
    room: int = 0
    audit: Audit | None = None
    undecided: bool = False

    @property
    def has_room(self) -> bool:
        """Whether tiles have a halo of their own, or are the whole map."""
        return self.room > 0 or self.single

    @property
    def starts(self) -> tuple[list[int], list[int]]:
        """First rows and first columns of the tiles."""
        return self.tiling.starts(self.shape[0]), self.tiling.starts(self.shape[1])

    @property
    def sizes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Rows and columns of the tiles."""
        rows, cols = (
            tuple(np.diff([*starts, nodes]).tolist()) for starts, nodes in zip(self.starts, self.shape)
        )
        return rows, cols

    @property
    def single(self) -> bool:
        """Whether the map is one tile and swept whole: no part of it is far, and the Earth is flat."""
        return self.tiling.earth is None and all(len(starts) == 1 for starts in self.starts)

    @property
    def needs_overviews(self) -> bool:
        """Whether ground beyond the halo counts."""
        return self.max_distance is None or self.max_distance / self.spacing > self.tiling.halo

    @property
    def depths(self) -> list[int]:
        """Rows and columns around every tile; none along an axis that has one tile."""
        depth = self.tiling.halo + self.room
        return [depth if len(starts) > 1 or self.periodic else 0 for starts in self.starts]

    def margins(self, axis: int, first: int, count: int) -> tuple[int, int]:
        """Nodes of the window before and behind a tile, along an axis of the map."""
        depth, nodes = self.depths[axis], self.shape[axis]
        if self.periodic:
            return depth, depth
        return min(first, depth), min(nodes - first - count, depth)

    def roomy(self, box: Box) -> Box:
        """A tile and ``room`` nodes around it, as far as the map goes."""
        begin = [max(0, first - self.room) for first, _ in box]
        end = [min(nodes, first + count + self.room) for (first, count), nodes in zip(box, self.shape)]
        return (begin[0], end[0] - begin[0]), (begin[1], end[1] - begin[1])

    def boxes(self) -> Iterator[Box]:
        """All tiles, row by row."""
        (rows, cols), (heights, widths) = self.starts, self.sizes
        for r, n in zip(rows, heights):
            for c, m in zip(cols, widths):
                yield (r, n), (c, m)


def layout_of(
    scene: Scene, tiling: Tiling | None, max_distance: float | None, audit: Audit, between: bool | None
) -> Layout:
    """The layout of a scene's map, checked; ``between``: as for :func:`layout_of_map`."""
    check_tiling(tiling)
    layout = layout_of_map(
        tiling or USUAL, scene.shape, scene.spacing, scene.sides == "periodic", max_distance, audit, between
    )
    if layout.single:
        return layout
    if scene.sides == "dark":
        raise bad(
            "sides 'dark' over several tiles, or on a round Earth",
            f"{scene.shape[0]} x {scene.shape[1]} nodes in tiles of {layout.tiling.tile}",
            "sides 'open' or 'periodic'",
            "A box's walls reach up to the highest ground of the whole map.",
        )
    if layout.periodic and min(scene.shape) < layout.tiling.least:
        least = f"at least {layout.tiling.least} nodes a side"
        raise bad("a map that repeats, over several tiles", scene.shape, least)
    return layout


def check_tiling(tiling: Tiling | None) -> None:
    """InputError unless it is a Tiling, or none is given."""
    if not isinstance(tiling, (Tiling, type(None))):
        raise bad("tiling", type(tiling).__name__, "a skylamp.Tiling")


def layout_of_map(
    tiling: Tiling,
    shape: tuple[int, int],
    spacing: float,
    periodic: bool,
    max_distance: float | None,
    audit: Audit,
    between: bool | None = False,
) -> Layout:
    """The layout of a map, its ``max_distance`` checked.

    ``between``: whether there is light between surfaces; None: :class:`Undecided` work decides.
    """
    if max_distance is not None and positive_number(max_distance, "max_distance") < spacing:
        raise bad("max_distance", max_distance, f"at least one spacing, {spacing:g}")
    layout = Layout(tiling, shape, spacing, periodic, max_distance, audit=audit, undecided=between is None)
    if between is False or layout.single:
        return layout
    if periodic or tiling.tile < 2 * tiling.halo:
        if between is None:
            return layout
        raise bad(
            "light between surfaces in tiles",
            "a map that repeats" if periodic else f"tiles of {tiling.tile} nodes",
            f"sides 'open', and tiles of at least two halos, {2 * tiling.halo} nodes",
            "What a tile's ground sends is known of a halo around it too.",
        )
    return layout._replace(room=tiling.halo)


def limited(
    seconds: float | None, what: str, scene: Scene, backend: str
) -> contextlib.AbstractContextManager[None]:
    """:func:`skylamp.backends.base.within`; InputError where the work is done later."""
    if seconds is not None and scene.lazy is not None:
        raise bad("max_seconds", "a lazy map, whose work is done when it is computed", "None")
    return within(seconds, what, engine_of(scene, backend))


def over_tiles(
    work: Work,
    scene: Scene,
    tiling: Tiling | None,
    max_distance: float | None,
    backend: str,
    quantity: Quantity,
    **leading: Any,
) -> Any:
    """``work`` of a whole scene, labelled as its map is, its values being ``quantity``.

    At once where that can be; else tile by tile: with a ``tiling``, where the map is beyond the device, and
    lazily where the map is lazy. ``leading``: a coordinate, by its name, of an axis before rows and columns.
    """
    for name in leading:
        if scene.labels is not None and name in scene.labels.dims:
            raise bad(
                "dimensions of a DataArray", scene.labels.dims, f"others than {name!r}", "Use rename()."
            )
    engine, counts = engine_of(scene, backend), [len(values) for values in leading.values()]
    if scene.lazy is None and tiling is None and holds(*scene.shape, engine):
        return labelled(work(scene, max_distance, None), scene.labels, quantity, **leading)
    mapped = tiled(work, scene, tiling, max_distance, Audit(backend), *counts)
    return labelled(mapped, scene.labels, quantity, **leading)


def tiled(
    work: Work,
    scene: Scene,
    tiling: Tiling | None,
    max_distance: float | None,
    audit: Audit,
    *leading: int,
    between: bool | None = False,
) -> Any:
    """``work`` tile by tile: a dask.array where the map is lazy, else (*leading, rows, cols) float32.

    ``between``: tiles are computed with a halo of their own, for the light between their surfaces; None: the
    work is :class:`Undecided`, and all of a lazy map decides.
    """
    layout = layout_of(scene, tiling, max_distance, audit, between)
    if scene.lazy is not None:
        return lazily(work, scene, layout, *leading)
    return work(scene, max_distance, None) if layout.single else _in_memory(work, scene, layout, *leading)


def decided(work: Any, scene: Scene, tiling: Tiling | None, max_distance: float | None, audit: Audit) -> Any:
    """:class:`Undecided` work, decided by a map in memory."""
    layout = layout_of(scene, tiling, max_distance, audit, None)
    heights, (one, varying) = np.negative(scene.depth), albedo_of(scene)
    sums = [
        sums_of_tile(work, layout.spacing, window_of(heights, box, [0, 0], False), albedo)
        for box in layout.boxes()
        for albedo in [one if varying is None else window_of(varying, box, [0, 0], False)]
    ]
    return decided_by_sums(work, layout, np.sum(sums, 0))[0]


def sums_of_tile(work: Any, spacing: float, heights: np.ndarray, albedo: Any) -> np.ndarray:
    """The sums of a tile, extrapolated from some windows to all of its nodes."""
    sums = np.zeros((work.colours, 3))
    for part, times in _windows(heights):
        window = heights[part]
        here = albedo[part] if np.ndim(albedo) > 1 else albedo
        sums += times * work.sums(_scene_of(window, _valid(window), spacing, here))
    return sums


def _windows(heights: np.ndarray) -> list[tuple[Any, float]]:
    """Windows of a tile, and how many of their kind each stands for.

    All windows with data, in order of their mean square slope, are parted into WINDOWS groups that have the
    same sum of that and of its mean over all: rare relief is met, and level ground too. The middle one of
    each group stands for it.
    """
    rows, cols = (_windows_along(nodes) for nodes in heights.shape)
    parts = [(..., r, c) for r in rows for c in cols]
    steep = np.array([_mean_square_step(heights[part]) for part in parts])
    order = np.argsort(steep, kind="stable")[: np.count_nonzero(np.isfinite(steep))]
    if not len(order):
        return []
    share = np.cumsum(steep[order] + max(float(steep[order].mean()), 1e-300))
    ends = np.searchsorted(share, share[-1] * (np.arange(1, WINDOWS) / WINDOWS) * (1 + 1e-9), "right")
    groups = [group for group in np.split(order, ends) if len(group)]
    scale = heights.size / (len(parts) * heights[parts[0]].size)  # windows may overlap
    return [(parts[group[len(group) // 2]], scale * len(group)) for group in groups]


def _mean_square_step(window: np.ndarray) -> float:
    """Mean square of the differences between neighbours with data; inf without data."""
    with np.errstate(invalid="ignore"):  # of inf - inf, where ground is missing
        steps = [np.diff(window, axis=axis) for axis in (0, 1)]
    known = [step[np.isfinite(step)] for step in steps]
    if not any(step.size for step in known):
        return 0.0 if np.isfinite(window).any() else math.inf
    return float(np.mean([np.mean(np.square(step, dtype=float)) for step in known if step.size]))


def _windows_along(nodes: int) -> list[slice]:
    """Windows that cover an axis of a tile, evenly spaced."""
    side, count = min(nodes, WINDOW), -(-nodes // WINDOW)
    starts = [round(n * (nodes - side) / max(1, count - 1)) for n in range(count)]
    return [slice(first, first + side) for first in starts]


def decided_by_sums(work: Any, layout: Layout, sums: np.ndarray) -> tuple[Any, Layout]:
    """:class:`Undecided` work and its layout, decided by the sums over the whole map."""
    work = work.decided(sums, layout.has_room)
    return work, layout._replace(room=layout.room if work.between else 0, undecided=False)


def albedo_of(scene: Scene) -> tuple[Any, Any]:
    """(The albedo where it is one number or colour, None), or (None, the map of it).

    The map is (rows, cols) or (3, rows, cols), a dask.array where the scene is lazy.
    """
    albedo: Any = scene.albedo
    if np.ndim(albedo) < 2:
        return albedo, None
    return None, albedo if albedo.ndim == 2 else albedo.transpose(2, 0, 1)


def holds(rows: int, cols: int, engine: Backend) -> bool:
    """Whether a map of this shape can be swept at once."""
    room = (rows + 2 * MOST_MARGIN) * (cols + 2 * MOST_MARGIN)
    return room <= MOST_PIXELS and has_room(engine, NODE_BYTES * rows * cols, TILT_BYTES * room)


def warn(text: str) -> None:
    """Warn whoever has asked for a tile, on a worker of dask.distributed the client."""
    distributed: Any = sys.modules.get("distributed")
    tell = getattr(distributed, "warn", warnings.warn)
    tell(text, stacklevel=2)


def tile_of(
    work: Work,
    layout: Layout,
    box: Box,
    window: np.ndarray,
    low: np.ndarray | None,
    top: Top | None,
    part: slice | None = None,
    albedo: Any = ALBEDO,
) -> np.ndarray:
    """``work`` of one tile, or ``part`` of its leading axis.

    ``window``: heights [length] of the tile and its halo, clipped at the map's border unless that repeats,
    nan without data. ``low``, ``top``: overviews, as :func:`skylamp.light.far.around` takes them; None where
    nothing beyond the halo counts. ``albedo``: one, or that of the window, (rows, cols) or (3, rows, cols).
    """
    (row, rows), (col, cols) = box
    before = [layout.margins(axis, *one)[0] for axis, one in enumerate(box)]
    inner = (..., slice(before[0], before[0] + rows), slice(before[1], before[1] + cols))
    valid = _valid(window)
    if valid is not None and not valid.any():
        return _nothing(part, rows, cols)
    scene = _scene_of(window, valid, layout.spacing, albedo, (row - before[0], col - before[1]))
    far, max_distance = None, layout.max_distance
    if top is not None:
        assert low is not None, "there are overviews of all levels, or of none"
        heights = window if valid is None else np.where(valid, window, np.nan)
        far = _far(layout, box, (before[0], before[1]), heights, low, top)
        if layout.audit is not None and (part is None or part.start == 0):
            _audit(layout.audit, scene, far)
    if layout.tiling.earth is not None:  # what is nearer is nearly flat
        near = layout.tiling.halo * layout.spacing
        max_distance = near if max_distance is None else min(near, max_distance)
    values = (work(scene, max_distance, far) if part is None else work(scene, max_distance, far, part))[inner]
    return values if valid is None else np.where(valid[inner[1:]], values, np.float32(np.nan))


def _valid(window: np.ndarray) -> np.ndarray | None:
    """Where a window has data; None where that is everywhere."""
    if all(by_bands(lambda rows: bool(np.isfinite(window[rows]).all()), window.shape)):
        return None
    valid: np.ndarray = np.isfinite(window)
    return valid


def _audit(audit: Audit, scene: Scene, far: Far) -> None:
    """Warn where far ground costs more than is asked for, see :func:`seen_from_edge`."""
    engine = engine_of(scene, audit.backend)
    with engine.lock:
        samples = Samples(engine, scene, AUDITED)
        inner = within_tile(samples, far)
        if not inner.any():
            return
        if audit.tolerance is None:
            slopes = seen_from_edge(samples, inner, scene, far, Azimuths(AUDITED_AZIMUTHS).angles)
            estimated, true = (1 / (1 + np.maximum(s, 0) ** 2) for s in slopes)
            off = math.sqrt(float(np.mean((estimated - true).mean(0) ** 2)))
            if off > WORTH_SAYING:
                warn(
                    f"Tiles: ground beyond the halo adds about {off:.1g} (RMS) to the error of sky-view"
                    f" factors; {CLOSER}."
                )
            return
        share = 0.0
        for rays, table in audit.lights:
            slopes = seen_from_edge(samples, inner, scene, far, rays.angles)
            plane = samples.gx[inner], samples.gy[inner]
            estimated, true = (rays.widths @ ring(*plane, rays.angles, s, table) for s in slopes)
            if mean := lit_mean(true):
                share = max(share, math.sqrt(float(np.mean((estimated - true) ** 2))) / mean)
    if share > audit.tolerance:
        warn(
            f"Tolerance: ground beyond the halo of tiles adds about {100 * share:.2g} % (RMS) to the error,"
            f" more than the {100 * audit.tolerance:.2g} % asked for; {CLOSER}."
        )


def within_tile(samples: Samples, far: Far) -> np.ndarray:
    """Which samples of a window lie in its tile (nodes,)."""
    rows, cols = samples.y - far.before[0], samples.x - far.before[1]
    return (rows >= 0) & (rows < far.tile[0]) & (cols >= 0) & (cols < far.tile[1])


def seen_from_edge(
    samples: Samples, inner: np.ndarray, scene: Scene, far: Far, angles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Horizons at samples (azimuths, nodes): what a node at the tile's edge makes of the ground, exact to the
    halo, from overviews beyond; and those of exact rays through the window.

    Rays whose far ground lies outside the window tell nothing: there the two are the same. On a round Earth
    what exact rays find beyond the halo sinks as the far ground does.
    """
    rows, cols = samples.y[inner] - far.before[0], samples.x[inner] - far.before[1]
    exact = samples.horizons(angles, far.farthest)[:, inner]
    near = samples.horizons(angles, far.tiling.halo)[:, inner]
    own = samples.own[inner].astype(float)
    slopes, distance = marched(scene.on(samples.engine), far).seen_from(rows, cols, own, angles)
    ends = []  # of the window, along every ray
    for place, way, nodes in zip((samples.x, samples.y), (np.cos(angles), np.sin(angles)), scene.shape[::-1]):
        room = np.where(way[:, None] > 0, nodes - 1 - place[inner], place[inner])
        ends.append(room / np.maximum(np.abs(way[:, None]), 1e-9))
    if far.drop:
        exact = np.maximum(near, np.where(exact > near, exact - far.drop * distance, exact))
    truth = np.where(distance > np.minimum(*ends), np.maximum(exact, slopes), exact)
    return np.maximum(near, slopes), truth


def _scene_of(
    window: np.ndarray,
    valid: np.ndarray | None,
    spacing: float,
    albedo: Any,
    first: tuple[int, int] | None = None,
    sides: str = "open",
) -> Scene:
    """The scene of a window; where it is not ``valid`` it is masked. first: its first node's (row, col)."""
    albedo = np.asarray(albedo)
    heights = window if valid is None else np.where(valid, window, 0)
    surface = np.moveaxis(albedo, 0, -1) if albedo.ndim == 3 else albedo
    try:
        return Scene.from_height(heights, spacing, surface, valid, sides)
    except InputError as error:  # it may tell rows and columns
        rows, cols = window.shape
        where = "" if first is None else f"its first node is (row, col) = {first}; "
        raise InputError(f"In a window of {rows} x {cols} nodes of the map: {where}{error}") from None


def _nothing(part: slice | None, *shape: int) -> np.ndarray:
    """Nodes without data."""
    return np.full(shape if part is None else (part.stop - part.start, *shape), np.nan, np.float32)


def _far(
    layout: Layout, box: Box, before: tuple[int, int], heights: np.ndarray, low: np.ndarray, top: Top
) -> Far:
    begin = box[0][0] - before[0], box[1][0] - before[1]
    # overviews about the room of a tile are those about the tile, so that they are within its neighbours
    low_begin = [
        first - (layout.tiling.reach if layout.periodic else min(first, layout.tiling.reach))
        for first, _ in box
    ]
    box = layout.roomy(box)
    (row, rows), (col, cols) = box
    before = row - begin[0], col - begin[1]
    at, tile, spacing, tiling = (row, col), (rows, cols), layout.spacing, layout.tiling
    base = np.nanmax(heights)
    levels = around(tiling, (low_begin[0], low_begin[1]), at, tile, low, top, layout.periodic)
    inner = heights[before[0] : before[0] + rows, before[1] : before[1] + cols]
    spread = spread_of(tiling, inner, spacing, layout.audit is not None and layout.audit.suns)
    nodes = marched_nodes(spread, layout.shape, at, tile)
    within = np.ix_(*(lines - first + room for lines, first, room in zip(nodes, at, before)))
    own = heights[within]
    own = scaled(np.where(np.isnan(own), np.nanmin(heights), own), base, spacing)
    farthest = math.inf if layout.max_distance is None else layout.max_distance / spacing
    if layout.periodic and math.isinf(farthest):
        relief = (top.highest - top.lowest) / spacing
        farthest = max(*layout.shape, relief / LEAST_SEARCHED_SLOPE)
    drop = 0.0 if tiling.earth is None else REFRACTED * spacing / (2 * tiling.earth)
    return Far(
        tiling,
        layout.shape,
        at,
        tile,
        before,
        spread,
        own,
        [level._replace(heights=scaled(level.heights, float(base), spacing)) for level in levels],
        farthest,
        layout.periodic,
        drop,
        layout.room > 0,
    )


def _around(first: int, count: int, depth: int, nodes: int, periodic: bool) -> Any:
    """Indices along an axis of a tile and ``depth`` nodes (or cells) around it."""
    if not periodic:
        return slice(max(0, first - depth), min(nodes, first + count + depth))
    return np.arange(first - depth, first + count + depth) % nodes


def window_of(values: Any, box: Box, depths: list[int], periodic: bool) -> np.ndarray:
    """The part of an array (..., rows, cols) about a box, see :func:`_around`."""
    picks = [
        _around(first, count, depth, nodes, periodic)
        for (first, count), depth, nodes in zip(box, depths, values.shape[-2:])
    ]
    if periodic:
        picks[0] = picks[0][:, None]
    part: np.ndarray = values[(..., *picks)]
    return part


def around_tile(low: Any, layout: Layout, box: Box) -> np.ndarray:
    """The part of the overviews (2, rows, cols) at level ``tiling.first`` that a tile is given."""
    reach = layout.tiling.reach >> layout.tiling.first
    return window_of(low, _cells_of(layout, box), [reach, reach], layout.periodic)


def _cells_of(layout: Layout, box: Box) -> Box:
    """A tile in cells of level ``tiling.first``."""
    size = 1 << layout.tiling.first
    (row, rows), (col, cols) = box
    return (row // size, -(-rows // size)), (col // size, -(-cols // size))


def _in_memory(work: Work, scene: Scene, layout: Layout, *leading: int) -> np.ndarray:
    """All tiles of a scene, one after another: (*leading, rows, cols) float32."""
    heights, parts = np.negative(scene.depth), _parts(layout, *leading)
    one, varying = albedo_of(scene)
    low: np.ndarray | None = None
    top: Top | None = None
    if layout.needs_overviews:
        tiling = layout.tiling
        size = 1 << tiling.first
        low = np.empty((2, *(-(-nodes // size) for nodes in layout.shape)), np.float32)
        for box in layout.boxes():
            cells = _cells_of(layout, box)
            tile = window_of(heights, box, [0, 0], False)
            window_of(low, cells, [0, 0], False)[...] = coarser(from_heights(tile), tiling.first)
        top = top_of(coarser(low, tiling.top - tiling.first))
    out = np.empty((*leading, *layout.shape), np.float32)
    for box in layout.boxes():
        near = window_of(heights, box, layout.depths, layout.periodic)
        far = None if low is None else around_tile(low, layout, box)
        albedo = one if varying is None else window_of(varying, box, layout.depths, layout.periodic)
        for part in parts:
            values = tile_of(work, layout, box, near, far, top, part, albedo)
            window_of(out if part is None else out[part], box, [0, 0], False)[...] = values
    return out


def over_area(work: Any, scene: Scene, rows: slice, cols: slice, *leading: int) -> Any:
    """``work`` (scene, row, col, depth of its plane) of a part of a map at once, and 0 around it.

    It is given the nodes next to the part too, from which the slopes at its border come. A dask.array where
    the map is lazy, else (*leading, rows, cols) float32; nan without data.
    """
    _, varying = albedo_of(scene)
    part = (..., rows, cols)
    rows, cols = (
        slice(max(0, some.start - 1), min(n, some.stop + 1)) for some, n in zip(part[1:], scene.shape)
    )
    given = (..., rows, cols)
    inner: Any = (..., *(slice(p.start - g.start, p.stop - g.start) for p, g in zip(part[1:], given[1:])))
    albedo: Any = scene.albedo if varying is None else varying[given]
    if scene.lazy is None:
        heights = np.negative(scene.depth)
        mapped = np.where(np.isnan(heights), heights, np.float32(0)) + np.zeros((*leading, 1, 1), np.float32)
        # the plane z = 0 is the viewer's, which need not touch the ground
        image = _area(work, scene.spacing, rows, cols, heights[given], 0.0, albedo)
        mapped[part] = image[inner]
        return mapped
    da = importlib.import_module("dask.array")
    from dask.graph_manipulation import bind

    finite = da.where(da.isfinite(scene.lazy), scene.lazy, np.nan)
    highest = da.nanmax(finite)
    again = bind(finite, highest, seed=highest.name)  # so that not all heights are kept meanwhile
    axes = "aij"[1 - len(leading) :]
    surface = (albedo, None) if varying is None else (albedo.rechunk(-1), "cij"[3 - varying.ndim :])
    call, arrays = (
        partial(_area, work, scene.spacing, rows, cols),
        (again[given].rechunk(-1), "ij", highest, ""),
    )
    image = _blockwise(da, call, axes, *arrays, *surface, new_axes={"a": leading[0]} if leading else {})
    around = [(0, 0)] * len(leading) + [(p.start, n - p.stop) for p, n in zip(part[1:], scene.shape)]
    base = da.where(da.isnan(again), np.float32(np.nan), np.float32(0))
    chunks = {axis + len(leading): sizes for axis, sizes in enumerate(scene.lazy.chunks)}
    return base + da.pad(image[inner], around).rechunk(chunks)


def _area(
    work: Any, spacing: float, rows: slice, cols: slice, window: np.ndarray, highest: float, albedo: Any
) -> np.ndarray:
    """``work`` of a part of a map; ``highest``: height of the plane z = 0."""
    valid = _valid(window)
    if valid is not None and not valid.any():
        return np.full((*((3,) if work.in_colour else ()), *window.shape), np.nan, np.float32)
    below = float(highest) - float((window if valid is None else window[valid]).max())
    scene = _scene_of(window, valid, spacing, albedo, (rows.start, cols.start))
    values: np.ndarray = work(scene, rows.start, cols.start, below)
    return values


# -- on Dask


def _blockwise(
    da: Any, work: Any, axes: str, *arrays: Any, dtype: DTypeLike = np.float32, **options: Any
) -> Any:
    """dask.array.blockwise of whole blocks; neither their chunks nor ``work`` is looked at."""
    options |= dict(align_arrays=False, concatenate=True, dtype=dtype)
    return da.blockwise(work, axes, *arrays, meta=np.empty((0,) * len(axes), dtype), **options)


def lazily(work: Work, scene: Scene, layout: Layout, *leading: int) -> Any:
    """A dask.array of what ``work`` gives, in the map's own chunks; nothing is computed yet.

    Heights are computed twice: for the overviews, and, once these are known, for the tiles. So of heights the
    edges of tiles alone are all in memory.
    """
    da = importlib.import_module("dask.array")
    heights = scene.lazy
    assert heights is not None, "the map is lazy"
    parts = _parts(layout, *leading)
    axes = "aij"[1 - len(leading) :]
    numbers = [da.from_array(np.arange(len(parts)), chunks=1), "a"] if leading else [0, None]
    sizes: dict[str, Any] = {"a": tuple(part.stop - part.start for part in parts if part is not None)}
    albedo, varying = albedo_of(scene)
    surface: tuple[Any, Any] = (albedo, None)
    if layout.single:
        if varying is not None:
            surface = varying.rechunk(-1), "cij"[3 - varying.ndim :]
        call = partial(_whole, work, layout, scene.sides, parts)
        arrays = [heights.rechunk(-1), "ij", *numbers, *surface]
        mapped = _blockwise(da, call, axes, *arrays, adjust_chunks=sizes)
    else:
        if varying is not None:
            varying = varying.rechunk({0: -1} | dict(enumerate(layout.sizes, varying.ndim - 2)))
            surface = varying, "cij"[3 - varying.ndim :]
        sums = _lazy_sums(da, work, heights, surface, layout) if layout.undecided else None
        low, top, again = _overviews(da, heights, layout, sums)
        edges = _Edges(da, layout, heights.rechunk(layout.sizes), low)
        low = None if low is None else edges.around(da, 1, low)
        if varying is not None:
            surface = _Edges(da, layout, varying).around(da, 0, varying), surface[1]
        rows, cols = (da.from_array(np.arange(len(sizes)), chunks=1) for sizes in layout.sizes)
        sizes |= dict(zip("ij", layout.sizes))
        call = partial(_block, work, layout, parts)
        places = rows, "i", cols, "j", low, None if low is None else "kij"
        arrays = [edges.around(da, 0, again.rechunk(layout.sizes)), "ij", *numbers, *surface, *places]
        mapped = _blockwise(da, call, axes, *arrays, adjust_chunks=sizes, top=top, sums=sums)
    return mapped.rechunk({axis + len(leading): chunks for axis, chunks in enumerate(heights.chunks)})


class _Edges:
    """What tiles give their neighbours, as tasks of Dask: of each edge and corner, the part of every array.

    ``heights`` (..., rows, cols) in tiles; ``low``: overviews of them (2, rows, cols), or None. Parts are
    copies: views would keep all nine tiles in memory until a window is made. They are taken where the
    overviews are made. So the heights of a tile, when they are computed again, wait for none of its
    neighbours; until then 4 halo / tile of the map is kept, 6 % with the usual tiles, and as much of the
    overviews.

    Dask's own ``overlap`` makes twice as many tasks a tile. Its scheduler is one process, which many fast
    workers keep busy.
    """

    def __init__(self, da: Any, layout: Layout, heights: Any, low: Any = None):
        from dask.base import tokenize
        from dask.highlevelgraph import HighLevelGraph

        reach = layout.tiling.reach >> layout.tiling.first
        arrays, self.depths = [heights], [layout.depths]
        if low is not None and reach:
            arrays.append(low)
            self.depths.append([reach if halo else 0 for halo in layout.depths])
        count = heights.numblocks[-2:]
        self.neighbours = {place: _neighbours(place, count, layout.periodic) for place in np.ndindex(*count)}
        name = "edges-" + tokenize(layout.periodic, self.depths, *(array.name for array in arrays))
        tasks: Any = {}
        for place, there in self.neighbours.items():
            blocks = [(array.name, *(0,) * (array.ndim - 2), *place) for array in arrays]
            tasks[(name, *place)] = (partial(_parts_of, self.depths, list(there)), *blocks)
            for n, way in enumerate(there):
                tasks[(name, *place, BESIDE.index(way))] = (itemgetter(n), (name, *place))
        graph = HighLevelGraph.from_collections(name, tasks, dependencies=arrays)
        self.parts = da.Array(graph, name, [(1,) * n for n in (*count, len(BESIDE))], dtype=object)

    def around(self, da: Any, number: int, tiles: Any) -> Any:
        """A dask.array of ``tiles``, each with what is around it in array ``number``."""
        from dask.base import tokenize
        from dask.highlevelgraph import HighLevelGraph

        if number >= len(self.depths):
            return tiles
        # no blockwise layer: Dask would fuse it with the work, and keep the tile beside its window meanwhile
        name = "window-" + tokenize(self.parts.name, number, tiles.name)
        tasks: Any = {}
        for place, there in self.neighbours.items():
            block = (*(0,) * (tiles.ndim - 2), *place)
            given = [(self.parts.name, *at, BESIDE.index((-y, -x))) for (y, x), at in there.items()]
            make = partial(_window, self.depths[number], list(there), number)
            tasks[(name, *block)] = (make, (tiles.name, *block), *given)
        rows, cols = ([place for place in self.neighbours if not place[n]] for n in (1, 0))  # of the first
        sizes = [
            tuple(
                count + sum(_margins(self.depths[number], self.neighbours[place])[axis])
                for count, place in zip(tiles.chunks[axis - 2], places)
            )
            for axis, places in enumerate((rows, cols))
        ]
        graph = HighLevelGraph.from_collections(name, tasks, dependencies=[self.parts, tiles])
        return da.Array(graph, name, (*tiles.chunks[:-2], *sizes), meta=tiles._meta)


def _neighbours(place: tuple[int, int], count: tuple[int, int], periodic: bool) -> dict[Way, tuple[int, int]]:
    """The tiles around one, by the way to them."""
    found = {way: (place[0] + way[0], place[1] + way[1]) for way in BESIDE}
    if periodic:
        return {way: (i % count[0], j % count[1]) for way, (i, j) in found.items()}
    return {way: (i, j) for way, (i, j) in found.items() if 0 <= i < count[0] and 0 <= j < count[1]}


def _margins(depths: list[int], ways: Iterable[Way]) -> list[tuple[int, int]]:
    """Nodes before and behind a tile with neighbours on these ``ways``, along both axes."""
    before, behind = (
        [depth * any(way[n] == side for way in ways) for n, depth in enumerate(depths)] for side in (-1, 1)
    )
    return list(zip(before, behind))


def _end(way: int, depth: int, count: int) -> slice:
    """The first or the last ``depth`` elements of ``count``, or all of them."""
    return slice(depth) if way < 0 else slice(count - depth, count) if way > 0 else slice(count)


def _parts_of(depths: list[list[int]], ways: list[Way], *blocks: np.ndarray) -> list[list[np.ndarray]]:
    """What each neighbour is given of the ``blocks`` (..., rows, cols) of a tile."""

    def part(way: Way, depth: list[int], block: np.ndarray) -> np.ndarray:
        rows, cols = map(_end, way, depth, block.shape[-2:])
        return block[..., rows, cols].copy()

    return [[part(way, depth, block) for depth, block in zip(depths, blocks)] for way in ways]


def _window(
    depths: list[int], ways: list[Way], number: int, tile: np.ndarray, *given: list[np.ndarray]
) -> np.ndarray:
    """A tile (..., rows, cols) with what is around it: element ``number`` of what neighbours have given."""
    margins, shape = _margins(depths, ways), tile.shape[-2:]
    window = np.empty((*tile.shape[:-2], *(n + sum(both) for n, both in zip(shape, margins))), tile.dtype)
    inner = [slice(before, before + n) for n, (before, _) in zip(shape, margins)]
    for way, part in [((0, 0), tile), *zip(ways, (parts[number] for parts in given))]:
        ends = map(_end, way, depths, window.shape[-2:])
        rows, cols = (end if side else middle for side, end, middle in zip(way, ends, inner))
        window[..., rows, cols] = part
    return window


def _box(layout: Layout, i: np.ndarray, j: np.ndarray) -> Box:
    """The tile whose numbers, down and across, are the elements of ``i`` and ``j``."""
    (rows, cols), (heights, widths) = layout.starts, layout.sizes
    return (rows[int(i[0])], heights[int(i[0])]), (cols[int(j[0])], widths[int(j[0])])


def _parts(layout: Layout, *leading: int) -> list[slice | None]:
    """Parts of the leading axis that a task computes; one, None, where there is no such axis."""
    if not leading:
        return [None]
    most = max(1, GROUP_BYTES // (4 * max(layout.sizes[0]) * max(layout.sizes[1])))
    return [slice(first, min(first + most, leading[0])) for first in range(0, leading[0], most)]


def _lazy_sums(
    da: Any, work: Work, heights: Any, surface: tuple[Any, Any], layout: Layout
) -> Any:  # a dask.delayed.Delayed
    """What :class:`Undecided` work is decided by."""
    from dask.delayed import delayed

    sums = _blockwise(
        da,
        partial(_block_sums, work, layout.spacing),
        "ijab",
        heights.rechunk(layout.sizes),
        "ij",
        *surface,
        dtype=np.float64,
        new_axes={"a": (work.colours,), "b": (3,)},  # type: ignore[attr-defined]  # it is Undecided
        adjust_chunks={"i": 1, "j": 1},
    )
    total = partial(np.sum, axis=(0, 1))
    return delayed(total, pure=True)(sums.rechunk(-1).to_delayed(optimize_graph=False).item())


def _block_sums(*given: Any) -> np.ndarray:
    return sums_of_tile(*given)[None, None]


def _overviews(da: Any, heights: Any, layout: Layout, sums: Any) -> tuple[Any, Any, Any]:
    """(Overviews of every tile, the levels that all tiles see, heights once these are known); lazy.

    (None, None, heights) where nothing beyond the halo counts. ``sums``: what else is computed before.
    """
    from dask.delayed import delayed
    from dask.graph_manipulation import bind

    if not layout.needs_overviews:
        return None, None, heights if sums is None else bind(heights, sums, seed=sums.key)

    tiling = layout.tiling
    levels: list[Any] = []
    for level, times in ((tiling.first, tiling.first), (tiling.top, tiling.top - tiling.first)):
        cells = [tuple(-(-n // (1 << level)) for n in sizes) for sizes in layout.sizes]
        levels.append(
            da.map_blocks(
                partial(_coarser, times=times),
                levels[-1] if levels else heights.rechunk(layout.sizes),
                chunks=((2,), *cells),
                new_axis=None if levels else 0,
                dtype=heights.dtype,
                meta=np.empty((0, 0, 0), heights.dtype),
            )
        )
    lowest, highest = levels
    top = delayed(top_of, pure=True)(highest.rechunk(-1).to_delayed(optimize_graph=False).item())
    before = top if sums is None else delayed([top, sums], pure=True)
    return lowest, top, bind(heights, before, seed=before.key)


def _coarser(block: np.ndarray, times: int) -> np.ndarray:
    return coarser(block if block.ndim == 3 else from_heights(block), times)


def _whole(
    work: Work,
    layout: Layout,
    sides: str,
    parts: list[slice | None],
    window: np.ndarray,
    number: np.ndarray | int,
    albedo: Any,
) -> np.ndarray:
    """``work`` of a map that is one tile."""
    valid, part, max_distance = _valid(window), parts[int(np.sum(number))], layout.max_distance
    if valid is not None and not valid.any():
        return _nothing(part, *window.shape)
    if layout.undecided:
        work, layout = decided_by_sums(work, layout, sums_of_tile(work, layout.spacing, window, albedo))
    scene = _scene_of(window, valid, layout.spacing, albedo, sides=sides)
    return work(scene, max_distance, None) if part is None else work(scene, max_distance, None, part)


def _block(
    work: Work,
    layout: Layout,
    parts: list[slice | None],
    window: np.ndarray,
    number: np.ndarray | int,
    albedo: Any,
    i: np.ndarray,
    j: np.ndarray,
    low: np.ndarray | None,
    top: Top | None = None,
    sums: np.ndarray | None = None,
) -> np.ndarray:
    box = _box(layout, i, j)
    if sums is not None:
        wide = layout
        work, layout = decided_by_sums(work, layout, sums)
        window = _trimmed(window, wide, layout, box)
        albedo = _trimmed(albedo, wide, layout, box) if np.ndim(albedo) > 1 else albedo
    values = tile_of(work, layout, box, window, low, top, parts[int(np.sum(number))], albedo)
    return np.ascontiguousarray(values)  # a view would keep the halo too


def _trimmed(window: np.ndarray, wide: Layout, narrow: Layout, box: Box) -> np.ndarray:
    """The window (..., rows, cols) about a tile that one layout has, from that of another with more room."""
    picks: list[Any] = []
    for axis, (first, count) in enumerate(box):
        before, after = narrow.margins(axis, first, count)
        cut = wide.margins(axis, first, count)[0] - before
        picks.append(slice(cut, cut + before + count + after))
    return window[(..., *picks)]


def devices(*names: str) -> Any:
    """A plugin for dask.distributed that gives each worker process a device of its own machine.

    ``client.register_plugin(skylamp.devices())``: worker n takes GPU n, round the GPUs that it sees, or round
    the backends that are named; ``backend="auto"`` is then that. A worker without a GPU takes what it would
    take anyway. Under dask-cuda every worker sees one GPU, and takes it.

    Raises InputError without dask.distributed.

    Returns
    -------
    distributed.WorkerPlugin
        For ``client.register_plugin``.

    Examples
    --------
    >>> client.register_plugin(sl.devices())  # doctest: +SKIP
    """
    try:
        from distributed import WorkerPlugin
    except ImportError as error:
        raise lacking("Workers", "dask.distributed", "dask", error) from error

    class Devices(WorkerPlugin):
        name = "skylamp-devices"

        def setup(self, worker: Any) -> None:
            chosen = names or tuple(info.name for info in backends() if info.gpu and info.available)
            chosen = tuple(name for name in chosen if name.startswith("warp")) or chosen
            number = int(worker.name) if str(worker.name).isdigit() else 0
            if chosen:
                prefer(chosen[number % len(chosen)])

    return Devices()
