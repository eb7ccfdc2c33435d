"""Sources as the kernels of the inverse take them: azimuths of a sky, slices of a lamp or window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import sources
from ..directions import Azimuths
from ..sources.solids import rectangle
from ..sources.tables import diamond_azimuths

LAMP_SLICES = 24  # of a lamp or window
TABLE_AZIMUTHS = 128  # of a lamp's table of brightness
# azimuths at which a sky's brightness is taken, over all sectors: even ones, ones of equal light
SAMPLES, SECTOR_SAMPLES = 256, 1024
ON_GRID = 1e-12  # component of an azimuth below which the ray is along the grid: roundings of cos and sin

Brightness = tuple[np.ndarray | None, np.ndarray | None]


@dataclass(frozen=True, eq=False)
class Light:
    """A source as the kernels take it, lengths in nodes of this grid.

    table: its brightness, (n, knots, 4), or None for 1 everywhere. directions (count, 4): azimuths of a sky,
    or quadrature of the slices of a lamp or window, which alone has frames (pixels, 4) and a solid. ball:
    whether the solid is one.
    """

    table: np.ndarray | None
    directions: np.ndarray
    frames: np.ndarray | None = None
    solid: np.ndarray | None = None
    ball: bool = False


def brightness_of(source: sources.Source, azimuths: int) -> Brightness:
    """(a sky's azimuths or None, the table of brightness or None for a number, which is part of the gains),
    as in Light: the same for every grid.
    """
    if isinstance(source, sources.Sky):
        sectors, table = Azimuths(azimuths), None
        if callable(source.brightness):
            profile = sources.azimuth_profile(source)
            sectors = sectors if profile is None else Azimuths.placed(azimuths, profile)
            samples = SAMPLES if profile is None else SECTOR_SAMPLES
            table = sources.elevation_table(source, sectors.angles, sectors.widths, samples)
        angles = sectors.angles
        directions = np.stack([np.cos(angles), np.sin(angles), sectors.widths, 0 * angles], 1)
        directions[np.abs(directions) < ON_GRID] = 0
        return directions, table
    if not callable(source.brightness):
        return None, None
    angles = diamond_azimuths(TABLE_AZIMUTHS)
    return None, sources.elevation_table(source, angles, 0 * angles, TABLE_AZIMUTHS)


def light_of(source: sources.Source, shape: tuple[int, int], scale: float, brightness: Brightness) -> Light:
    """A source, with what brightness_of says of it, for a grid whose node i stands at (i + 1/2) / scale - 1/2
    nodes of the unit in which the source is given.
    """
    azimuths, table = brightness
    if azimuths is not None:
        return Light(table, azimuths)
    assert not isinstance(source, sources.Sky), "a sky has azimuths"
    share = (np.arange(LAMP_SLICES) + 0.5) / LAMP_SLICES
    theta, azimuth = np.pi * (share - 0.5), 2 * np.pi * share
    quadrature = np.stack([np.sin(theta), np.cos(theta), np.cos(azimuth), np.sin(azimuth)], 1)
    if isinstance(source, sources.Lamp) and source.center is not None:
        assert source.radius is not None, "a sphere has a radius"
        center = _on_grid(source.center, scale)
        solid = np.array([*center, source.radius * scale])
        return Light(table, quadrature, _ball_frames(center, shape), solid, ball=True)
    corners = np.array([_on_grid(corner, scale) for corner in _corners(source)])
    return Light(table, quadrature, _quadrangle_frames(corners, shape), corners.ravel())


def _on_grid(point: Sequence[float] | np.ndarray, scale: float) -> np.ndarray:
    """x, y [nodes] and height [nodes] of a point on a grid."""
    return np.array([(point[0] + 0.5) * scale - 0.5, (point[1] + 0.5) * scale - 0.5, -point[2] * scale])


def _corners(source: sources.Lamp | sources.Window) -> Sequence[Sequence[float]] | np.ndarray:
    """The corners of a window or rectangular lamp, in turn."""
    if isinstance(source, sources.Window):
        assert source.x is not None and source.y is not None, "apertures are for method='paper'"
        (x0, x1), (y0, y1) = source.x, source.y
        return [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)]
    assert source.corner is not None and source.edges is not None, "volumes are for method='paper'"
    return rectangle(source.corner, *source.edges).corners


def _ball_frames(center: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(pixels, 4): the unit vector from each node towards the centre in the plane, and the distance there."""
    y, x = np.indices(shape).astype(float)
    dx, dy = center[0] - x, center[1] - y
    distance = np.hypot(dx, dy)
    safe = np.where(distance > 0, distance, 1)
    frames = np.stack([np.where(distance > 0, dx / safe, 1), dy / safe, distance, 0 * distance], -1)
    return frames.reshape(-1, 4)


def _quadrangle_frames(corners: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(pixels, 4): the unit vector from each node towards the middle of the azimuths that the quadrangle
    spans, and the tangent of a quarter of the span, 0 from below the quadrangle.
    """
    y, x = np.indices(shape).astype(float)
    to = corners[:, :2, None, None] - np.stack([x, y])
    middle = np.arctan2(*to.mean(0)[::-1])
    off = np.angle(np.exp(1j * (np.arctan2(to[:, 1], to[:, 0]) - middle)))
    turn = np.stack([to[i, 0] * to[(i + 1) % 4, 1] - to[i, 1] * to[(i + 1) % 4, 0] for i in range(4)])
    within = (turn >= 0).all(0) | (turn <= 0).all(0)
    middle = middle + (off.min(0) + off.max(0)) / 2
    quarter = np.where(within, 0, np.tan((off.max(0) - off.min(0)) / 4))
    frames = np.stack([np.cos(middle), np.sin(middle), quarter, 0 * middle], -1)
    return frames.reshape(-1, 4)
