"""Light of a thin source, a slit or a tube: along the line through its middle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .. import sources
from ..constants import STEEP
from ..samples import Samples
from ..scene import Scene
from ..sources.solids import Quad
from .slices import Slices
from .unoccluded import Values, gradients

BATCH = 16  # points whose rays are followed at a time: 16 x 16 bytes a node


class Line(NamedTuple):
    """A thin quadrangle [spacings, heights third]: its ends, its width, and the unit normal of its plane."""

    begin: np.ndarray
    end: np.ndarray
    width: float
    normal: np.ndarray


def line_of(quad: Quad) -> Line:
    """The line through the middle of an upright quadrangle, along its longer edges."""
    corners = np.asarray(quad.corners, float)
    along, across = corners[1] - corners[0], corners[3] - corners[0]
    if np.linalg.norm(across) > np.linalg.norm(along):
        along, across = across, along
    area = np.cross(along, across)
    size, begin = float(np.linalg.norm(area)), corners[0] + across / 2
    return Line(begin, begin + along, size / float(np.linalg.norm(along)), area / max(size, 1e-300))


class _Nodes(NamedTuple):
    """Nodes that look at a line: their slopes, the nearest way (3, ...) and distance to it, and angles."""

    gx: Values
    gy: Values
    nearest: np.ndarray
    distance: np.ndarray
    first: np.ndarray
    span: np.ndarray


def _looking(line: Line, gx: Values, gy: Values, at: np.ndarray) -> tuple[_Nodes, np.ndarray]:
    """Nodes at ``at`` (3, ...), and the line's unit vector (3)."""
    length = float(np.linalg.norm(line.end - line.begin))
    axis = (line.end - line.begin) / length
    to = line.begin.reshape(3, *(1,) * (at.ndim - 1)) - at
    begin = np.einsum("i,i...->...", axis, to)
    nearest = to - np.multiply.outer(axis, begin)
    distance = np.maximum(np.sqrt((nearest**2).sum(0)), 1e-9)
    first = np.arctan2(begin, distance)
    span = np.arctan2(begin + length, distance) - first
    return _Nodes(gx, gy, nearest / distance, distance, first, span), axis


def _rays(
    line: Line, nodes: _Nodes, axis: np.ndarray, share: float, brightness: sources.Brightness
) -> tuple[np.ndarray, ...]:
    """(cosine and sine of the azimuth, slope, distance along the ground, light) of rays to a point.

    The point lies at this ``share`` of the line's angle at a node: there dl / r^2 is dangle / distance.
    """
    angle = nodes.first + nodes.span * share
    way = nodes.nearest * np.cos(angle) + np.multiply.outer(axis, np.sin(angle))
    flat = np.maximum(np.hypot(way[0], way[1]), 1e-9)
    tilt = (way[0] * nodes.gx + way[1] * nodes.gy + way[2]) / np.sqrt(1 + nodes.gx**2 + nodes.gy**2)
    light = (
        line.width
        / nodes.distance
        * nodes.span
        * np.maximum(0, tilt)
        * np.abs(np.tensordot(line.normal, way, 1))
    )
    direction = np.stack([way[0], way[1], np.minimum(-way[2], 0)], -1)
    light = np.where(way[2] > 0, light * sources.radiance(sources.Sky(brightness), direction), 0.0)
    return way[0] / flat, way[1] / flat, way[2] / flat, nodes.distance * flat / np.cos(angle), light


def at_samples(samples: Samples, quad: Quad, brightness: sources.Brightness, count: int) -> np.ndarray:
    """Irradiance (nodes,) by ``count`` points of a thin quadrangle [spacings], with exact rays."""
    line = line_of(quad)
    at = np.stack([samples.x, samples.y, samples.own]).astype(float)
    nodes, axis = _looking(line, samples.gx, samples.gy, at)
    total = np.zeros(len(samples))
    for first in range(0, count, BATCH):
        shares = (np.arange(first, min(first + BATCH, count)) + 0.5) / count
        c, s, slope, reach, light = (
            np.stack(values) for values in zip(*(_rays(line, nodes, axis, p, brightness) for p in shares))
        )
        # ground counts as far as along x distance is less than the limit
        least = np.clip(slope * (1 - 1e-6), 0, STEEP)
        tangents = samples.slopes(c, s, least, np.ones_like(c), 0.0, reach)
        total += np.where(tangents <= np.maximum(least, slope).astype(np.float32), light, 0.0).sum(0)
    irradiance: np.ndarray = total / count
    return irradiance


def image(slices: Slices, scene: Scene, quad: Quad, brightness: sources.Brightness, count: int) -> np.ndarray:
    """Irradiance (rows, cols) float32 by ``count`` points of a thin quadrangle [spacings]."""
    line, (rows, cols) = line_of(quad), scene.shape
    y, x = np.mgrid[:rows, :cols]
    deep = scene.depth if scene.mask is None else np.nan_to_num(scene.depth)
    at = np.stack([x, y, -deep.astype(float) / scene.spacing])
    nodes, axis = _looking(line, *gradients(scene), at)
    total = np.zeros(scene.shape)
    slices.coarsen()
    for first in range(0, count, BATCH):
        shares = (np.arange(first, first + BATCH) + 0.5) / count
        rays = [_rays(line, nodes, axis, share, brightness) for share in shares]
        ways = np.stack([np.stack([ray[n] for n in range(4)]) for ray in rays], -1)
        ways[2], ways[3] = np.clip(ways[2], 0, STEEP), np.maximum(ways[3], 1e-6)
        clear = slices.rays(np.ascontiguousarray(np.moveaxis(ways, 0, 2), np.float32))
        total += sum(np.where(clear[..., n], ray[4], 0.0) for n, ray in enumerate(rays))
    return (total / count).astype(np.float32)
