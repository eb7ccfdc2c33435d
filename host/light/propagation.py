"""Visibility along the directions of a lattice, and its uses: packed bits, irradiance, carving, the field.

The sequences of kernels are the same on every backend.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..backends.base import Array, Backend, reserve, reserve_map, rounded_up
from ..backends.resident import DeviceImage, Resident
from ..constants import COPY_SIDE, PATCH_X, PATCH_Y, SIDES, SKY, VOLUME
from ..errors import CapacityError
from ..sources import Geometry
from .walks import Group, crossings_of, cycle_length, lap_table, walk_groups

Progress = Callable[[int, int], None]
# steps of rays to lamps, over most_searched_rows of the backend; NumPy takes one for a whole map at a time.
# Chosen: the field of 200 layers of 256 x 256 nodes passes on NumPy, that of 1000 layers of 64 x 64 does not
RAY_STEPS = 8


class Lobe(NamedTuple):
    """A lobe about the mirror direction.

    ``table``: its weight by even steps of 1 - cosine from 0 to ``rim``; ``spread``: its half width [rad].
    """

    table: np.ndarray
    rim: float
    spread: float


class Problem(NamedTuple):
    """The input of a backend: depth (rows, cols) float32, +inf where masked, on the device.

    Depth is in a unit in which the spacing is ``step``; ``steps`` (D, 3): the directions.
    """

    depth: Resident
    step: float
    sides: str
    steps: np.ndarray
    geometry: Geometry
    filled: bool = False

    @property
    def pixels(self) -> int:
        return math.prod(self.depth.shape)

    @property
    def relief(self) -> float:
        return self.depth.most - self.depth.least

    @property
    def clips(self) -> bool:
        """Whether the source or the walls occlude a part of the sky."""
        return self.geometry.kind != SKY or self.sides == "dark"


class OnDevice(NamedTuple):
    """A group of walks with its tables on the device; names and order as in Group."""

    host: Group
    pairs: Array
    walks: Array
    rise: Array
    crossings: Array
    climbs: Array
    spans: Array
    directions: Array
    steps: Array  # (n_walks, bits, 4) i, j, k, number
    ways: Array  # crossings and spans of the map as it lies, for the rays of lamps
    way_spans: Array
    lines: int

    @property
    def n_walks(self) -> int:
        return self.host.n_walks

    @property
    def bits(self) -> int:
        return self.host.bits


class LatticeMap:
    """A map on a device, to be scanned group by group of walks; one buffer of planes serves all groups."""

    laps: list[tuple[Array, int]]

    def __init__(self, backend: Backend, problem: Problem, relief: float | None = None):
        self.backend, self.problem = backend, problem
        self.room = rounded_up(problem.pixels)
        # two maps, two slopes, the sum, and a plane with its turned twin
        reserve_map(backend, problem.pixels, 22 * self.room, 8 * self.room)
        planes = int(min(backend.memory // 3, backend.most_array_bytes) // self.room)
        most = min(max(1, planes), len(problem.steps))
        relief = problem.relief if relief is None else relief
        steps, followed = tuple(map(tuple, problem.steps.tolist())), relief if self.periodic else 0.0
        how = problem.step, self.periodic, problem.filled, most
        groups = walk_groups(steps, problem.depth.shape, followed, *how)
        _check_search(backend, problem, relief, groups)
        if problem.geometry.is_lamp:
            _check_rays(backend, problem, problem.depth.most, 1, "visibility")
        self.maps = backend.empty((2, self.room), np.float32, 0)  # the map, and room for the same turned
        problem.depth.copy_into(self.maps)
        self.depth = backend.view(self.maps, problem.depth.shape)
        self.planes = backend.empty((max(g.n_walks + len(g.pairs) for g in groups), self.room), np.uint8)
        self.numbers = backend.table(problem.geometry.numbers)
        self.flags = backend.table(problem.geometry.flags)
        self.groups = [self._upload(group) for group in groups]
        self.turn()
        self.find_laps(problem.depth.download() if self.periodic else None)

    @property
    def periodic(self) -> bool:
        return self.problem.sides == "periodic"

    def depths(self) -> np.ndarray:
        """The depths (rows, cols) that the device now holds."""
        return self.backend.download(self.maps)[0, : self.problem.pixels].reshape(self.problem.depth.shape)

    def _upload(self, group: Group) -> OnDevice:
        upload = self.backend.table
        lines = 0
        for _, j, _, _, _, _, turned, _ in group.walks.tolist():
            rows, cols = self.problem.depth.shape[:: -1 if turned else 1]
            lines = max(lines, min(abs(j), rows) * -(-cols // self.backend.lanes))
        steps = _numbered(self.problem.steps)[group.directions]
        points = [crossings_of(i, j, self.problem.filled)[0] for i, j in steps[:, 0, :2].tolist()]
        counts = np.array([len(p) for p in points])
        spans = np.stack([np.cumsum(counts) - counts, counts], 1).astype(np.int32)
        ways = np.array([point for way in points for point in way], np.int32)
        tables = (upload(table) if len(table) else None for table in group)
        return OnDevice._make([group, *tables, upload(steps), upload(ways), upload(spans), lines])

    def turn(self) -> None:
        """Update the turned map after a change of the depths on the device."""
        size = *self.problem.depth.shape, self.room
        self.backend.launch("scan", "turn_map", (self._blocks(),), self.maps, *size)

    def _blocks(self) -> int:
        rows, cols = self.problem.depth.shape
        down, across = -(-rows // (COPY_SIDE * PATCH_Y)), -(-cols // (COPY_SIDE * PATCH_X))
        return int(down * across * PATCH_X * PATCH_Y)

    def find_laps(self, depth: np.ndarray | None) -> None:
        """Of a periodic map: the first ceilings of the level rays for these depths; None where it ends."""
        self.laps = []
        for group in self.groups:
            lap = np.zeros((group.n_walks, 1), np.float32)
            if depth is not None and not group.host.rise[:, 0].all():
                turned = group.host.walks[:, 6] != 0
                ways = self.problem.steps[group.host.directions[:, 0], :2]
                tables = [
                    lap_table(z, way.tolist(), self.problem.filled)
                    for z, way in ((depth, ways[~turned]), (depth.T, ways[turned, ::-1]))
                ]
                lap = np.zeros((group.n_walks, max(table.shape[1] for table in tables)), np.float32)
                for which, table in zip((~turned, turned), tables):
                    lap[which, : table.shape[1]] = table
            self.laps.append((self.backend.table(lap), lap.shape[1]))

    def scan(self, number: int) -> Array:
        """The planes of a group, its walks first: (walks and more, room) uint8, overwritten by the next."""
        group, problem, launch = self.groups[number], self.problem, self.backend.launch
        shape = problem.depth.shape
        lap, lap_lines = self.laps[number]
        dim, walks = (group.lines, group.n_walks), (self.maps, group.walks, group.rise, lap)
        tail = (self.planes, *shape, self.room, lap_lines, int(self.periodic))
        if problem.filled:
            crossings = group.crossings, group.climbs, group.spans
            launch("filled", "scan_filled", dim, *walks, *crossings, *tail, BITS=group.bits)
        else:
            launch("scan", "scan", dim, *walks, *tail, BITS=group.bits)
        if group.pairs is not None:
            kernel = "turn_planes_by_fours" if all(n % 4 == 0 for n in shape) else "turn_planes"
            dim = self._blocks(), len(group.host.pairs)
            launch("scan", kernel, dim, self.planes, group.pairs, *shape, self.room)
        if problem.clips:
            rays = group.steps, group.ways, group.way_spans
            source = len(problem.geometry.flags), problem.geometry.kind, SIDES[problem.sides]
            maps, size = (self.numbers, self.flags, self.planes), (*shape, self.room)
            last = float(problem.step), group.n_walks
            given = self.depth, *rays, *maps, *size, *source, *last
            launch("source", "clip", (problem.pixels,), *given, BITS=group.bits)
        return self.planes


class LatticeLight:
    """The sum over the visible directions, with all arrays on the device; ``run`` may be repeated.

    ``moments`` (D, 3), or one for each colour (C, D, 3): all are summed in one pass over visibility.
    ``lobe``, with ``weights`` (C, D, 4) unit vectors and weights, adds the reflection about the mirror
    direction; no more is reflected than arrives if ``whole`` (D, 4) is given, the weights under a sky of
    brightness 1.
    """

    def __init__(
        self,
        surface: LatticeMap,
        moments: np.ndarray,
        lobe: Lobe | None = None,
        weights: np.ndarray | None = None,
        whole: np.ndarray | None = None,
    ):
        backend = surface.backend
        self.surface, self.lobe = surface, lobe
        self.slopes = backend.empty((2, surface.room), np.float32, 0)
        moments = moments.reshape(-1, *moments.shape[-2:])
        padded = np.concatenate([moments, np.zeros((*moments.shape[:2], 1))], 2)
        if lobe is None or weights is None:
            weights = np.zeros((0, *padded.shape[1:]))
        self.sums, self.glosses = (
            [backend.empty((surface.room,), np.float32, 0) for _ in values] for values in (padded, weights)
        )

        def by_group(values: np.ndarray) -> list[list[Array]]:
            return [
                [backend.table(one.astype(np.float32)[group.host.directions]) for one in values]
                for group in surface.groups
            ]

        self.tables, self.weights = by_group(padded), by_group(weights)
        self.table = None if lobe is None else backend.upload(lobe.table)
        self.whole = None if whole is None else backend.upload(whole.astype(np.float32))

    def run(self) -> None:
        surface, backend, problem = self.surface, self.surface.backend, self.surface.problem
        rows, cols = problem.depth.shape
        surface.turn()
        steps = 0.5 / problem.step, 1 / problem.step, int(problem.sides == "periodic")
        maps: tuple[Array, ...] = surface.depth, self.slopes
        backend.launch("luminance", "gradient", (cols, rows), *maps, rows, cols, surface.room, *steps)
        last = len(surface.groups) - 1

        def launch(stem: str, kernel: str, *args: Any, **constants: Any) -> None:
            dim = (surface.room // backend.pixel_lanes,)
            backend.launch(stem, kernel, dim, *args, lanes=backend.pixel_lanes, **constants)

        lobe_size, rim = (0, 0.0) if self.lobe is None else (len(self.lobe.table), self.lobe.rim)
        for number, group in enumerate(surface.groups):
            planes, when = surface.scan(number), (int(number == 0), int(number == last))
            pixels, walks = (problem.pixels, surface.room), (surface.room, group.n_walks)
            for table, total in zip(self.tables[number], self.sums):
                maps = planes, self.slopes, table, total
                launch("luminance", "luminance", *maps, *pixels, group.n_walks, *when, BITS=group.bits)
            for table, total in zip(self.weights[number], self.glosses):
                maps = planes, self.slopes, table, self.table, total
                launch("specular", "specular", *maps, *walks, lobe_size, *when, rim, BITS=group.bits)
        size = surface.room, len(problem.steps), lobe_size
        for total in self.glosses if self.whole is not None else ():
            launch("specular", "bound", self.slopes, self.whole, self.table, total, *size, rim)


class FieldByLayers:
    """The visibility field of a sky or window, layer by layer, on the device; ``run`` may be repeated."""

    def __init__(self, backend: Backend, problem: Problem, layers: int):
        self.backend, self.problem, self.layers = backend, problem, layers
        rows, cols = problem.depth.shape
        self.count, self.reach = len(problem.steps), int(np.abs(problem.steps).max())
        self.words = -(-self.count // 32)
        self.width, self.height = cols + 2 * self.reach, rows + 2 * self.reach
        level = problem.steps[:, 2] == 0
        self.n_level = int(level.sum())
        reserve(
            backend,
            4 * self.words * (layers + self.reach) * self.width * self.height
            + 4 * self.n_level * problem.pixels,
            "The visibility field",
            "Ask for fewer layers, a smaller hemicube or map.",
        )
        steps = _numbered(problem.steps)
        self.steps, self.numbers, self.flags = map(
            backend.upload, (steps, problem.geometry.numbers, problem.geometry.flags)
        )
        self.offsets = backend.upload(
            np.stack([steps[:, 2], steps[:, 1] * self.width + steps[:, 0]], 1).astype(np.int32)
        )
        self.depth = problem.depth.depth
        # A sky fills the space outside the map; level rays end at walls and in a window's plane.
        self.field = backend.empty(
            (layers + self.reach, self.words, self.height, self.width),
            np.uint32,
            0 if problem.clips else 0xFFFFFFFF,
        )
        self.levels = backend.empty((self.n_level, rows, cols), np.float32, -1 if problem.clips else None)
        ways = problem.steps[level, :2].tolist()
        lap = (
            lap_table(problem.depth.download(), ways, False)
            if problem.sides == "periodic"
            else np.zeros((1, 1), np.float32)
        )
        self.ways = backend.upload(problem.steps[level, :2].astype(np.int32))
        self.lap, self.lap_lines = backend.upload(lap), lap.shape[1]
        self.lines = max(min(abs(j or i), rows if j else cols) * (cols if j else rows) for i, j in ways)

    def run(self, progress: Progress | None = None) -> None:
        launch, problem = self.backend.launch, self.problem
        rows, cols = problem.depth.shape
        size = rows, cols, self.reach, self.words
        periodic = problem.sides == "periodic"
        if problem.clips:
            tables, kind = (self.steps, self.numbers, self.flags), problem.geometry.kind
            dim = self.width, self.height, self.layers + self.reach
            launch("source", "enter", dim, *tables, self.field, *size, self.count, kind, SIDES[problem.sides])
        else:
            tables, level = (self.depth, self.ways, self.lap), (self.lines, self.n_level)
            numbers = rows, cols, self.lap_lines, int(periodic)
            launch("propagate", "reaches", level, *tables, self.levels, *numbers)
        lanes = self.backend.lanes if cols >= self.backend.lanes else 1
        dim, counts = (-(-cols // lanes), rows, self.words), (self.count, self.n_level)
        maps = self.depth, self.levels, self.offsets, self.field
        for n in range(self.layers):
            launch("propagate", "propagate", dim, *maps, *size, *counts, n, lanes=lanes)
            if periodic:
                launch("propagate", "wrap", (self.width, self.height, self.words), self.field, *size, n)
            if progress:
                progress(n + 1, self.layers)

    def download(self) -> np.ndarray:
        rows, cols = self.problem.depth.shape
        m = self.reach
        return self.backend.download(self.field)[m:, :, m : m + rows, m : m + cols]


def _field_of_lamp(backend: Backend, problem: Problem, layers: int) -> np.ndarray:
    """The visibility field of a lamp, node by node: layers pass on the light of a boundary only."""
    words, geometry = -(-len(problem.steps) // 32), problem.geometry
    _check_rays(backend, problem._replace(filled=False), layers * problem.step, layers, "field")
    fix = "Ask for fewer layers, a smaller hemicube or map."
    reserve(backend, 4 * words * layers * problem.pixels, "The visibility field", fix)
    steps = _numbered(problem.steps)
    nodes = np.array([crossings_of(i, j, False)[0][0] for i, j, _ in problem.steps.tolist()], np.int32)
    spans = np.stack([np.arange(len(steps)), np.ones(len(steps))], 1).astype(np.int32)
    tables = steps, nodes, spans, geometry.numbers, geometry.flags
    there = [problem.depth.depth, *map(backend.upload, tables)]
    field = backend.empty((layers, words, *problem.depth.shape), np.uint32)
    source = len(geometry.flags), geometry.kind, SIDES[problem.sides]
    size = *problem.depth.shape, *source, words, len(steps), layers
    backend.launch("source", "beam", (problem.pixels, layers), *there, field, *size)
    return backend.download(field)


def visibility(backend: Backend, problem: Problem) -> np.ndarray:
    """Packed surface visibility (rows, cols, words) uint32."""
    words = -(-len(problem.steps) // 32)
    reserve(backend, 4 * words * problem.pixels, "Packed visibility", "Use a smaller hemicube or map.")
    surface = LatticeMap(backend, problem)
    out = backend.empty((*problem.depth.shape, words), np.uint32, 0)
    for number, group in enumerate(surface.groups):
        maps = surface.scan(number), group.directions, out
        size = problem.pixels, surface.room, words, group.n_walks
        backend.launch("scan", "pack", (problem.pixels,), *maps, *size, BITS=group.bits)
    return backend.download(out)


def light(
    backend: Backend,
    problem: Problem,
    moments: np.ndarray,
    lobe: Lobe | None = None,
    weights: np.ndarray | None = None,
    whole: np.ndarray | None = None,
    stays: bool = False,
) -> tuple[list[Any], list[np.ndarray]]:
    """Irradiance, and the light that a lobe reflects, (rows, cols) float32 per colour.

    Arguments as of LatticeLight; ``stays``: irradiances are DeviceImages.
    """
    light = LatticeLight(LatticeMap(backend, problem), moments, lobe, weights, whole)
    light.run()
    if stays:
        return [DeviceImage(backend, array, problem.depth.shape) for array in light.sums], []
    irradiances, glosses = (
        [backend.download(array)[: problem.pixels].reshape(problem.depth.shape) for array in arrays]
        for arrays in (light.sums, light.glosses)
    )
    return irradiances, glosses


def carve(
    backend: Backend,
    problem: Problem,
    low: np.ndarray,
    high: np.ndarray,
    weights: np.ndarray,
    layers: int,
    by_sign: bool,
    progress: Progress | None,
) -> np.ndarray:
    """Depth in layers (rows, cols) int32 by the inverse algorithm, from the depth 0 of the ``problem`` on;
    arguments as of skylamp.oracle.carve.
    """
    surface = LatticeMap(backend, problem, relief=float(layers))
    pixels = problem.pixels
    light, side = (backend.empty((pixels,), np.int32, 0) for _ in range(2))
    bounds = [backend.upload(a.astype(np.int32).ravel()) for a in (low, high)]
    tables = [backend.upload(weights.astype(np.int32)[group.host.directions]) for group in surface.groups]
    for layer in range(layers):
        active = backend.empty((1,), np.int32, 0)
        if layer:
            surface.turn()
            if surface.periodic:
                surface.find_laps(surface.depths())
        for number, (group, table) in enumerate(zip(surface.groups, tables)):
            planes = surface.scan(number)
            maps = planes, table, light, *bounds, side, surface.depth, active
            when = int(number == 0), int(number == len(tables) - 1), layer, int(by_sign)
            size = pixels, surface.room, group.n_walks
            backend.launch("carve", "carve", (pixels,), *maps, *size, *when, BITS=group.bits)
        if progress:
            progress(layer + 1, layers)
        if not backend.download(active)[0]:
            break
    return surface.depths().astype(np.int32)


def field(backend: Backend, problem: Problem, layers: int, progress: Progress | None = None) -> np.ndarray:
    """The visibility field (layers, words, rows, cols) uint32, bits packed; depths in layers (step 1)."""
    if not problem.geometry.is_lamp:
        field = FieldByLayers(backend, problem, layers)
        field.run(progress)
        return field.download()
    made = _field_of_lamp(backend, problem, layers)
    if progress:
        progress(layers, layers)
    return made


def _check_search(backend: Backend, problem: Problem, relief: float, groups: tuple[Group, ...]) -> None:
    """CapacityError where scans on a map that repeats would follow its relief for too many rows.

    Never where that is no more than the map itself takes.
    """
    own = searched = 0
    for group in groups:
        for walk, points in zip(group.walks.tolist(), group.spans[:, 1].tolist()):
            rows = problem.depth.shape[walk[6]]
            own += rows * points
            searched += walk[2] * min(abs(walk[1]), rows) * points
    if searched > max(own, backend.most_searched_rows):
        raise CapacityError(
            f"A relief of {relief / problem.step:.3g} spacings on a map that repeats must be followed over"
            f" {searched:,} rows in {len(problem.steps):,} directions; {backend.name} takes"
            f" {backend.most_searched_rows:,}. Give depth and spacing in one unit, take a smaller hemicube,"
            " or choose a compiled backend."
        )


def _check_rays(backend: Backend, problem: Problem, deepest: float, layers: int, what: str) -> None:
    """CapacityError where the rays from ``layers`` of nodes to a lamp would take too many steps."""
    rows, cols = problem.depth.shape
    periodic, total = problem.sides == "periodic", 0.0
    for i, j, up in problem.steps.tolist():
        longest = deepest / (-up * problem.step) if up else math.inf
        if not (i or j):
            longest = longest if problem.geometry.kind == VOLUME else 0.0
        elif not periodic:
            longest = min(longest, cols / abs(i) if i else math.inf, rows / abs(j) if j else math.inf)
        elif not up:
            longest = cycle_length(i, j, rows, cols)
        total += (longest + 1) * layers * len(crossings_of(i, j, problem.filled)[0])
    most = RAY_STEPS * backend.most_searched_rows
    if total > most:
        raise CapacityError(
            f"The {what} of a lamp: rays in {len(problem.steps):,} directions up to"
            f" {deepest / problem.step:.3g} spacings, from {layers:,} layers, take some {total:.2g} steps;"
            f" {backend.name} takes {most:,}. Subtract the least depth, take a smaller hemicube or fewer"
            " layers, or choose a compiled backend."
        )


def _numbered(steps: np.ndarray) -> np.ndarray:
    """(D, 4) int32: i, j, k and the direction's number."""
    return np.concatenate([steps * [1, 1, -1], np.arange(len(steps))[:, None]], 1).astype(np.int32)
