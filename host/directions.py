"""Direction sets: the paper's hemicube with solid angles and moments in closed form."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from .checks import real_array, whole_number
from .errors import bad
from .radiometry import polygon_moment, rectangle_solid_angle

MOST_AZIMUTHS = 4096
LARGEST = 129  # 16,641 + 32,768 directions; a larger cube is a slip of the keyboard


@dataclass(frozen=True)
class Hemicube:
    """The surface nodes with L_z <= 0 of an M x M x M cube (Langer and Zucker, section 5).

    They are ordered by (k, j, i). Every direction owns the part of the cube's surface nearest to its node,
    clipped at edges and at the horizon.

    Parameters
    ----------
    size : odd int >= 3
        M. There are M^2 + 8 m^2 directions, m = (M - 1) / 2.

    Attributes
    ----------
    steps : (D, 3) int32
        (i, j, -k), pixels along columns, rows and depth; max(|i|, |j|, k) = m.
    directions : (D, 3) float64, unit vectors from the surface towards the source.
    solid_angles : (D,) float64 [sr], summing to 2 pi.
    moments : (D, 3) float64 [sr]
        Integral of L dOmega over each cell (Lambert's formula), summing to (0, 0, -pi).

    Raises
    ------
    InputError
        If ``size`` is not an odd whole number from 3 to 129.

    Examples
    --------
    >>> cube = sl.Hemicube(9)
    >>> cube.directions.shape, round(float(cube.solid_angles.sum() / np.pi), 6)
    ((209, 3), 2.0)
    """

    size: int

    def __post_init__(self) -> None:
        allowed = f"an odd whole number from 3 to {LARGEST}"
        size = whole_number(self.size, "hemicube", 3, LARGEST, allowed)
        if size % 2 == 0:
            raise bad("hemicube", size, allowed)
        object.__setattr__(self, "size", size)

    def __len__(self) -> int:
        return len(self.steps)

    @property
    def reach(self) -> int:
        """m = (M - 1) / 2, the longest step along an axis."""
        return (self.size - 1) // 2

    @property
    def words(self) -> int:
        """32-bit words that hold one bit per direction."""
        return -(-len(self) // 32)

    @property
    def steps(self) -> np.ndarray:
        return _steps(self.size)

    @cached_property
    def directions(self) -> np.ndarray:
        return _frozen(self.steps / np.linalg.norm(self.steps, axis=1, keepdims=True))

    @cached_property
    def solid_angles(self) -> np.ndarray:
        return _cells(self.size)[0]

    @cached_property
    def moments(self) -> np.ndarray:
        return _cells(self.size)[1]

    def unpack(self, bits: np.ndarray) -> np.ndarray:
        """Packed bits (..., words) uint32 -> (..., D) bool, in the order of ``steps``.

        InputError where there are not as many words.
        """
        if np.asarray(bits).dtype.kind not in "iu" or np.shape(bits)[-1:] != (self.words,):
            got = f"{np.asarray(bits).dtype}, shape {np.shape(bits)}"
            raise bad("hemicube: packed bits", got, f"whole numbers (..., {self.words})")
        bits = np.ascontiguousarray(bits, "<u4")
        return np.unpackbits(bits.view(np.uint8), axis=-1, bitorder="little")[..., : len(self)].astype(bool)

    def pack(self, visible: np.ndarray) -> np.ndarray:
        """(..., D) bool -> packed bits (..., words) uint32: direction d is bit d % 32 of word d // 32.

        InputError where there is not one value for every direction.
        """
        visible = np.asarray(visible)
        if visible.shape[-1:] != (len(self),):
            raise bad(
                "hemicube: visible", f"shape {visible.shape}", f"(..., {len(self)}), one for a direction"
            )
        room = np.zeros((*visible.shape[:-1], 32 * self.words), bool)
        room[..., : len(self)] = visible
        return np.packbits(room, axis=-1, bitorder="little").view("<u4").astype(np.uint32)


@dataclass(frozen=True)
class Azimuths:
    """Sectors of azimuth, each sampled along its middle; angles from +x (columns) towards +y (rows).

    Parameters
    ----------
    count : int >= 1
        Number of sectors.
    edges : (count + 1,) increasing, spanning 2 pi [rad], optional
        Borders of the sectors; evenly from 0 unless given, so that azimuth a looks along 2 pi (a + 1/2) /
        count.

    Attributes
    ----------
    angles : (count,) float64 [rad]
    widths : (count,) float64 [rad], summing to 2 pi.

    Raises
    ------
    InputError
        If ``count`` is not a whole number from 1 to 4096, or ``edges`` do not increase over 2 pi.

    Examples
    --------
    >>> sl.Azimuths(4).angles.round(3)
    array([0.785, 2.356, 3.927, 5.498])
    """

    count: int
    edges: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        count = whole_number(self.count, "azimuths", 1, MOST_AZIMUTHS)
        turn = np.linspace(0, 2 * np.pi, count + 1)
        edges = turn if self.edges is None else real_array(self.edges, "azimuths: edges", None)
        increase = edges.shape == turn.shape and bool((np.diff(edges) > 0).all())
        if not increase or abs(edges[-1] - edges[0] - 2 * np.pi) > 1e-9:
            got = reprlib.repr(edges.tolist()) if edges.shape == turn.shape else f"shape {edges.shape}"
            raise bad("azimuths: edges", got, f"{count + 1} increasing angles that span 2 pi")
        object.__setattr__(self, "count", count)
        object.__setattr__(self, "edges", tuple(edges.tolist()))

    def __len__(self) -> int:
        return self.count

    @property
    def angles(self) -> np.ndarray:
        edges = np.array(self.edges, float)
        middles: np.ndarray = (edges[1:] + edges[:-1]) / 2
        return middles

    @property
    def widths(self) -> np.ndarray:
        return np.diff(np.array(self.edges, float))

    def on_axes(self, axes: tuple[float, float]) -> Azimuths:
        """The same sectors in the axes of a map, see ``Scene.axes``, in order of their angles there."""
        if axes == (1.0, 1.0):
            return self
        edges = angles_on(axes, np.array(self.edges, float))
        return Azimuths(self.count, tuple(np.sort(edges).tolist()))

    @classmethod
    def placed(cls, count: int, weights: np.ndarray, axes: tuple[float, float] = (1.0, 1.0)) -> Azimuths:
        """``count`` sectors, half spread evenly, half by ``weights`` (n,), the light of n even sectors.

        In the axes of a map, see ``Scene.axes``, in which the weights are too. The first sector begins in the
        east all the same, so that the sectors do not depend on them.
        """
        weights = np.asarray(weights, float)
        weights = np.roll(weights[::-1], len(weights) // 2) if axes[0] < 0 else weights
        weights = weights[::-1] if axes[1] < 0 else weights
        share = np.concatenate([[0], np.cumsum(0.5 * weights / weights.sum() + 0.5 / len(weights))])
        turn = np.linspace(0, 2 * np.pi, len(weights) + 1)
        sectors = cls(count, tuple(np.interp(np.linspace(0, 1, count + 1), share / share[-1], turn)))
        return sectors.on_axes(axes)


def angles_on(axes: tuple[float, float], angles: np.ndarray) -> np.ndarray:
    """Azimuths [rad] from east towards south in the axes of a map, see ``Scene.axes``."""
    angles = np.pi - angles if axes[0] < 0 else angles
    return -angles if axes[1] < 0 else angles


def _frozen(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


@lru_cache(maxsize=8)
def _steps(size: int) -> np.ndarray:
    """Lattice steps to all nodes of the hemicube's faces, (D, 3) int32."""
    m = (size - 1) // 2
    k, j, i = np.meshgrid(np.arange(m + 1), np.arange(-m, m + 1), np.arange(-m, m + 1), indexing="ij")
    steps = np.stack([i.ravel(), j.ravel(), -k.ravel()], 1)
    return _frozen(steps[np.abs(steps).max(1) == m].astype(np.int32))


@lru_cache(maxsize=8)
def _cells(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Solid angle (D,) and moment (D, 3) of every cell: one to three rectangles on the cube's faces."""
    cube = Hemicube(size)
    m = cube.reach
    solid_angle, moment = np.zeros(len(cube)), np.zeros((len(cube), 3))
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, -1)):
        u_axis, v_axis = (a for a in range(3) if a != axis)
        node = np.abs(cube.steps[:, axis] - sign * m) == 0
        centre = cube.steps[node].astype(float)
        low, high = np.maximum(centre - 0.5, -m), np.minimum(centre + 0.5, m)
        high[:, 2] = np.minimum(high[:, 2], 0)  # the horizon
        u0, u1, v0, v1 = low[:, u_axis], high[:, u_axis], low[:, v_axis], high[:, v_axis]
        corners = np.empty((len(centre), 4, 3))
        corners[:, :, axis] = sign * m
        corners[:, :, u_axis] = np.stack([u0, u1, u1, u0], 1)
        corners[:, :, v_axis] = np.stack([v0, v0, v1, v1], 1)
        solid_angle[node] += rectangle_solid_angle(u0, u1, v0, v1, m)
        moment[node] += polygon_moment(corners)
    return _frozen(solid_angle), _frozen(moment)
