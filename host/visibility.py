"""Surface visibility as packed bits, and the visibility field over free space."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from . import sources
from .backends import select
from .backends.base import within
from .backends.resident import upload
from .checks import one_of, positive_number, whole_number
from .directions import Hemicube
from .errors import CapacityError, bad
from .images import is_in_colour
from .light import lattice, propagation
from .light.propagation import Problem, Progress
from .rendering import render
from .scene import Scene, check_scene


def visibility(
    scene: Scene,
    source: sources.Source,
    hemicube: int | Hemicube = 9,
    backend: str = "auto",
    *,
    filled: bool = False,
    algorithm: str = "scan",
    max_seconds: float | None = None,
) -> np.ndarray:
    """The directions of the hemicube in which the source is visible from every surface node.

    Returns packed bits (rows, cols, words) uint32: direction d, in the order of ``Hemicube.steps``, is bit d
    % 32 of word d // 32; no bit is set where the scene is masked. ``filled``: test every crossing with a grid
    line, not the lattice nodes alone. ``algorithm``: "scan", or "propagate" (the paper's own, layer by layer,
    for depths rounded to layers; the same bits where depths are whole layers). ``Hemicube.unpack`` makes
    booleans of the bits.

    ``max_seconds``: OutOfTimeError once they are over, compiling apart; they are looked at before each launch
    of a kernel.

    Raises InputError, BackendError, CapacityError or OutOfTimeError.

    Examples
    --------
    >>> cube = sl.Hemicube(5)
    >>> words = sl.visibility(sl.Scene(np.zeros((3, 3))), sl.Sky(), cube)
    >>> words.shape, bool(cube.unpack(words).all())
    ((3, 3, 2), True)
    """
    cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(hemicube)
    one_of(algorithm, ("scan", "propagate"), "algorithm")
    if not isinstance(filled, (bool, np.bool_)):
        raise bad("filled", repr(filled), "True or False")
    if algorithm == "propagate":
        if filled:
            raise bad(
                "algorithm 'propagate' with filled=True",
                "both",
                "filled=False: propagation goes from node to node",
            )
        return visibility_field(scene, source, cube, backend=backend, max_seconds=max_seconds).surface()
    check_scene(scene)
    if isinstance(source, sources.Sky):
        scene = scene.under_sky()
    engine = select(backend)
    with engine.lock, within(max_seconds, "visibility", engine):
        return propagation.visibility(engine, lattice.problem_of(engine, scene, source, cube, filled))


def visibility_field(
    scene: Scene,
    source: sources.Source,
    hemicube: int | Hemicube = 9,
    layers: int | None = None,
    backend: str = "auto",
    *,
    max_bytes: int | None = None,
    progress: Progress | None = None,
    max_seconds: float | None = None,
) -> VisibilityField:
    """The visibility field over free space, by the paper's forward algorithm (section 6).

    Depths are rounded to layers one spacing thick. ``layers``: how many, from z = 0 down; unless given, down
    to the deepest node. ``max_bytes``: what the field may take (half of what is free unless given).
    ``progress``: called with (layers done, layers).

    ``max_seconds``: as of :func:`visibility`.

    Raises InputError, BackendError, OutOfTimeError, and CapacityError before anything is allocated if the
    field is too large.

    Returns
    -------
    VisibilityField
        Its ``words`` are packed bits, (layers, words, rows, cols) uint32.

    Examples
    --------
    >>> pit = np.zeros((5, 5))
    >>> pit[2, 2] = 3
    >>> field = sl.visibility_field(sl.Scene(pit), sl.Sky(), 3)
    >>> field.words.shape
    (4, 1, 5, 5)
    """
    cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(hemicube)
    if progress is not None and not callable(progress):
        raise bad("progress", repr(progress), "a function of (layers done, layers), or None")
    check_scene(scene)
    depth, step = scene.layers()
    known = depth[scene.valid]
    if layers is None:
        layers = int(known.max()) + 1
    layers = whole_number(layers, "layers", 1)
    rim = 2 * cube.reach  # that propagation needs
    needed = 4 * cube.words * (layers + cube.reach) * (scene.shape[0] + rim) * (scene.shape[1] + rim)
    if max_bytes is not None and needed > (most := positive_number(max_bytes, "max_bytes")):
        raise CapacityError(
            f"The visibility field of {layers} layers x {scene.shape[0]} rows x {scene.shape[1]} cols x"
            f" {cube.words} words takes {needed:,} bytes; max_bytes allows {most:,.0f}. Ask for fewer"
            " layers, a smaller hemicube or a coarser map."
        )
    engine = select(backend)
    geometry = sources.geometry(source, scene, step)
    with engine.lock, within(max_seconds, "visibility_field", engine):
        there = upload(engine, depth, step, float(known.min()), float(known.max()))
        problem = Problem(there, step, scene.sides, cube.steps, geometry)
        words = propagation.field(engine, problem, layers, progress)
    return VisibilityField(words, cube, scene, source, depth, engine.name)


@dataclass(frozen=True, eq=False)
class VisibilityField:
    """The visibility field V(x) on the lattice.

    Node (x, y, layer) stands at column x, row y and depth layer x spacing.

    Attributes
    ----------
    words : (layers, words, rows, cols) uint32
        Packed bits; none is set below the surface.
    hemicube, scene, source, backend
        The arguments that it was made from.
    depth : (rows, cols) float32
        Depth of the surface in layers, +inf where masked.

    Examples
    --------
    >>> field = sl.visibility_field(sl.Scene(np.full((5, 5), 3.0)), sl.Sky(), 3)
    >>> field.words.shape
    (4, 1, 5, 5)
    """

    words: np.ndarray
    hemicube: Hemicube
    scene: Scene
    source: sources.Source
    depth: np.ndarray
    backend: str
    _images: dict[str, np.ndarray] = field(default_factory=dict, init=False, repr=False)  # by backend

    @property
    def bits(self) -> np.ndarray:
        """Packed bits (layers, rows, cols, words), laid out as those of :func:`visibility` (a view)."""
        return np.moveaxis(self.words, 1, -1)

    @property
    def layers(self) -> int:
        return len(self.words)

    def at(self, x: int, y: int, layer: int) -> np.ndarray:
        """Whether the source is visible from node (x, y, layer), per direction of the hemicube: (D,) bool.

        Raises InputError if the node is not in the field.
        """
        layers, _, rows, cols = self.words.shape
        for name, value, size in (("x", x, cols), ("y", y, rows), ("layer", layer, layers)):
            whole_number(value, f"field: {name}", 0, size - 1)
        return self.hemicube.unpack(self.words[layer, :, y, x])

    def surface(self) -> np.ndarray:
        """Packed bits (rows, cols, words) at the surface's own nodes, as :func:`visibility` gives them.

        Raises InputError if the field does not reach down to the surface everywhere.
        """
        deepest = int(self.depth[self.scene.valid].max())
        if deepest >= self.layers:
            raise bad(
                "field: surface",
                f"{self.layers} layers",
                f"at least {deepest + 1}, the deepest node of the surface",
            )
        out = np.zeros((*self.scene.shape, self.hemicube.words), np.uint32)
        y, x = np.nonzero(self.scene.valid)
        out[y, x] = self.words[self.depth[y, x].astype(int), :, y, x]
        return out

    def solid_angle(self) -> np.ndarray:
        """Visible solid angle [sr] of the source: (layers, rows, cols) float32, 0 below the surface."""
        total = np.zeros((self.layers, *self.scene.shape), np.float32)
        for d, angle in enumerate(self.hemicube.solid_angles):
            total += (self.words[:, d // 32] >> np.uint32(d % 32) & np.uint32(1)) * np.float32(angle)
        return total

    def view(self, point: tuple[int, int, int], backend: str = "auto") -> View:
        """The view from the point (x, y, layer) in every direction of the whole cube, up and down.

        The source's brightness where it is visible, and elsewhere the radiance rho E / pi (Eq. 1, 3) of the
        surface that the ray hits: the white and the grey sectors of the paper's Fig. 1. A ray goes from node
        to node, as in propagation, and hits the column that it first stands below. Walls, and the
        surroundings of an open map, are black.

        Raises InputError if the point is not in the field or lies below the surface, or where the source or
        the surface is in colour; BackendError.
        """
        shares = (getattr(self.scene.reflectance, name, 0.0) for name in ("albedo", "specular"))
        if any(is_in_colour(np.asarray(share)) for share in shares):
            raise bad("field: view", "a surface in colour", "a grey one", "Only render takes colour.")
        try:
            x, y, layer = point
        except (TypeError, ValueError):
            raise bad("field: view point", repr(point), "three whole numbers (x, y, layer)") from None
        visible = self.at(x, y, layer)
        if not layer <= self.depth[y, x]:
            raise bad(
                "field: view point",
                (x, y, layer),
                f"a node in free space, layer <= {self.depth[y, x]:g} at (row, col) = ({y}, {x})",
            )
        engine = select(backend)
        if engine.name not in self._images:
            self._images[engine.name] = np.asarray(
                render(self.scene, self.source, "lattice", backend=engine.name, hemicube=self.hemicube).image
            )
        image = self._images[engine.name]
        cube = self.hemicube
        down = cube.steps[:, 2] < 0
        steps = np.concatenate([cube.steps, cube.steps[down] * [1, 1, -1]])
        directions = np.concatenate([cube.directions, cube.directions[down] * [1, 1, -1]])
        level = cube.steps[:, 2] == 0
        above = np.where(level, 2, 1) * cube.solid_angles  # a whole cell again, where the horizon had cut it
        visible = np.concatenate([visible, np.zeros(down.sum(), bool)])
        brightness, hit = np.zeros(len(steps)), np.full((len(steps), 2), -1)
        source = sources.on_axes(self.source, self.scene.axes)
        brightness[visible] = sources.radiance(source, directions[visible])
        for d in np.flatnonzero(~visible):
            where = self._first_hit(np.array([x, y, layer]), steps[d])
            if where is not None:
                hit[d] = where
                brightness[d] = image[where]
        return View(
            steps, directions, np.concatenate([above, cube.solid_angles[down]]), visible, brightness, hit
        )

    def _first_hit(self, node: np.ndarray, step: np.ndarray) -> tuple[int, int] | None:
        """(row, col) of the first column that the ray from ``node`` stands below, or None."""
        rows, cols = self.scene.shape
        deepest = self.depth[self.scene.valid].max()
        node = node.copy()
        for _ in range(rows * cols + int(deepest) + 1):
            node += step
            if self.scene.sides == "periodic":
                node[:2] %= (cols, rows)
            elif not (0 <= node[0] < cols and 0 <= node[1] < rows):
                return None
            if node[2] < 0:
                return None
            if node[2] > self.depth[node[1], node[0]]:
                return int(node[1]), int(node[0])
        return None


@dataclass(frozen=True, eq=False)
class View:
    """The view from a point in every direction of the whole cube.

    The hemicube's directions come first, then those that look down. steps (n, 3) int; directions (n, 3) unit
    vectors from the point; solid_angles (n,) [sr], summing to 4 pi; visible (n,) bool: the source is seen;
    brightness (n,) [unit of the source's]; hit (n, 2) int: (row, col) of the surface that is seen, -1 where
    it is not the surface.

    Examples
    --------
    >>> field = sl.visibility_field(sl.Scene(np.full((5, 5), 3.0)), sl.Sky(), 3)
    >>> view = field.view((2, 2, 1))
    >>> round(float(view.solid_angles.sum() / np.pi), 6), bool(view.visible[view.directions[:, 2] < 0].all())
    (4.0, True)
    """

    steps: np.ndarray
    directions: np.ndarray
    solid_angles: np.ndarray
    visible: np.ndarray
    brightness: np.ndarray
    hit: np.ndarray
