"""Light of a thin source, a slit or a tube: along the line through its middle."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from .. import sources
from ..backends.base import Backend
from ..constants import STEEP
from ..samples import Samples, samples_of
from ..scene import Scene
from ..sources.integrals import R2_STEPS, BrightPart, cut, without
from ..sources.solids import Dome, Quad
from ..sources.tables import GOLDEN
from .base import HostImage
from .slices import Slices
from .unoccluded import Values, gradients

BATCH = 8  # points whose rays are followed at a time: some 100 bytes a node each
RAYS_AT_ONCE = 2**18  # from few nodes, some 150 bytes each
# points in the cone of a small bright part, over those along the line. Of a slit before a sun that lights
# 0.3 % of the nodes, the error at 0.3 % is 2.1 tolerances with 16, in 5.4 s, 0.95 with 32 in 5.6 s, 0.99 with
# 64 in 3.5 s (performance/refinement.py --seed 9971 --size 128 --only 13)
CONE_POINTS = 32

Cone = tuple[np.ndarray, float]  # its axis, a unit vector with z upwards, and the sine of its radius


class LineLight(NamedTuple):
    """A brightness; the cone outside of which it is 0, within which its points are taken; and the number of
    these over that of a single cone.
    """

    brightness: sources.Brightness
    cone: Cone | None = None
    point_share: float = 1.0


def lights_of(brightness: sources.Brightness, parts: Sequence[BrightPart]) -> tuple[LineLight, ...]:
    """What a brightness is the sum of: what is left without small bright parts, and what each adds to it."""
    parts = sorted(parts, key=lambda part: -part.limit)  # the brightest first: parts may lie within others

    def added(L: np.ndarray, n: int, near: list[BrightPart]) -> np.ndarray:
        before = without(brightness, near, L)
        light: np.ndarray = before - cut(before, [parts[n]], L)
        return light

    rest = LineLight(partial(without, brightness, parts) if parts else brightness)
    shares = _point_shares(np.array([part.power for part in parts]))
    return rest, *(
        LineLight(partial(added, n=n, near=[p for p in parts[:n] if _meet(p, part)]), part.cone, shares[n])
        for n, part in enumerate(parts)
    )


def _meet(part: BrightPart, other: BrightPart) -> bool:
    """Whether their cones have directions in common."""
    (axis, sine), (other_axis, other_sine) = part.cone, other.cone
    return float(axis @ other_axis) >= math.cos(math.asin(sine) + math.asin(other_sine))


def _point_shares(power: np.ndarray) -> np.ndarray:
    """Points in each of several cones of this power, over those of a single cone, for the same error of all.

    Derived: where errors are independent and in proportion to light over points, and rays cost the same, no
    other shares have so few rays.
    """
    powers = (power / power.sum()) ** (2 / 3)
    shares: np.ndarray = powers * np.sqrt(powers.sum())
    return shares


def _points_in_cone(light: LineLight, count: int) -> int:
    """Points in a light's cone where the line has ``count``."""
    return math.ceil(CONE_POINTS * count * light.point_share)


class Line(NamedTuple):
    """A thin quadrangle [spacings, heights third].

    The ends of the line through its middle, its edge across, its width, and the unit normal of its plane.
    """

    begin: np.ndarray
    end: np.ndarray
    across: np.ndarray
    width: float
    normal: np.ndarray

    def strips(self, count: int) -> Iterator[Line]:
        """Lines in the middle of ``count`` strips side by side, each with its share of the width and all its
        points in the middle of it.
        """
        for n in range(count):
            shift = self.across * ((n + 0.5) / count - 0.5)
            yield Line(self.begin + shift, self.end + shift, 0 * shift, self.width / count, self.normal)


def line_of(quad: Quad) -> Line:
    """The line through the middle of an upright quadrangle, along its longer edges."""
    corners = np.asarray(quad.corners, float)
    along, across = corners[1] - corners[0], corners[3] - corners[0]
    if np.linalg.norm(across) > np.linalg.norm(along):
        along, across = across, along
    area = np.cross(along, across)
    size, begin = float(np.linalg.norm(area)), corners[0] + across / 2
    return Line(begin, begin + along, across, size / float(np.linalg.norm(along)), area / max(size, 1e-300))


class _Nodes(NamedTuple):
    """Nodes that look at a line: their slopes, unit vector (3, ...) and distance [spacings] to the nearest
    point of the endless line, and the angles [rad] from there at which its part begins and that it spans.
    """

    gx: Values
    gy: Values
    nearest: np.ndarray
    distance: np.ndarray
    first: np.ndarray
    span: np.ndarray


def _looking(
    line: Line, gx: Values, gy: Values, at: np.ndarray, cone: Cone | None, wide: bool = False
) -> tuple[_Nodes, np.ndarray]:
    """Nodes at ``at`` (3, ...), with the angles of the line's part within the cone; its unit vector (3,).

    ``wide``: within the cone anywhere across the line.
    """
    length = float(np.linalg.norm(line.end - line.begin))
    axis = (line.end - line.begin) / length
    to = line.begin.reshape(3, *(1,) * (at.ndim - 1)) - at
    begin = np.einsum("i,i...->...", axis, to)
    nearest = to - np.multiply.outer(axis, begin)
    distance = np.maximum(np.sqrt((nearest**2).sum(0)), 1e-9)
    nearest /= distance
    first, last = np.arctan2(begin, distance), np.arctan2(begin + length, distance)
    if cone is not None:
        # the cosine to the cone's axis is that of the angle to ``middle``, times ``most``
        up, along = np.tensordot(cone[0], nearest, 1), float(cone[0] @ axis)
        most, middle = np.hypot(up, along), np.arctan2(along, up)
        radius = math.asin(cone[1]) + (line.width / distance if wide else 0.0)
        half = np.arccos(np.clip(np.cos(np.minimum(radius, np.pi)) / np.maximum(most, 1e-9), -1, 1))
        first, last = np.maximum(first, middle - half), np.minimum(last, middle + half)
    return _Nodes(gx, gy, nearest, distance, first, np.maximum(0, last - first)), axis


def _rays(
    line: Line,
    nodes: _Nodes,
    axis: np.ndarray,
    points: np.ndarray,
    count: int,
    offset: Values,
    brightness: sources.Brightness,
) -> tuple[np.ndarray, ...]:
    """(cosine and sine of the azimuth, slope, distance along the ground, light) of rays to points.

    ``points``: numbers of some of ``count``, in equal steps of the line's angle at a node, from ``offset``
    [step] on; there dl / r^2 is dangle / distance. Each lies at another place across the source, so that the
    part of its width that the ground hides is met. Each (n, ...).
    """
    points = points.reshape(-1, *(1,) * nodes.span.ndim)
    angle = nodes.first + (points + offset) / count * nodes.span
    reach = nodes.distance / np.cos(angle)
    way = nodes.nearest[:, None] * np.cos(angle) + np.multiply.outer(axis, np.sin(angle))
    way = reach * way + np.multiply.outer(line.across, (GOLDEN * points + 0.5) % 1 - 0.5)
    length = np.sqrt((way**2).sum(0))
    light = line.width / nodes.distance * nodes.span / count * (reach / length) ** 2
    way /= length
    flat = np.maximum(np.hypot(way[0], way[1]), 1e-9)
    tilt = (way[0] * nodes.gx + way[1] * nodes.gy + way[2]) / np.sqrt(1 + nodes.gx**2 + nodes.gy**2)
    light = light * np.maximum(0, tilt) * np.abs(np.tensordot(line.normal, way, 1))
    direction = np.stack([way[0], way[1], np.minimum(-way[2], 0)], -1)
    light = np.where(way[2] > 0, light * sources.radiance(sources.Sky(brightness), direction), 0.0)
    return way[0] / flat, way[1] / flat, way[2] / flat, length * flat, light


def at_samples(samples: Samples, quad: Quad, lights: Sequence[LineLight], count: int) -> np.ndarray:
    """Irradiance (nodes,) of a thin quadrangle [spacings], whose brightness is the sum of ``lights``.

    By exact rays to ``count`` points of its line, and more in a cone (:func:`_points_in_cone`): on so many
    strips that they lie as far apart across the quadrangle as along it.
    """
    line, total = line_of(quad), np.zeros(len(samples))
    at = np.stack([samples.x, samples.y, samples.own]).astype(float)
    for light in lights:
        nodes, _ = _looking(line, samples.gx, samples.gy, at, light.cone, wide=True)
        lit = np.flatnonzero(nodes.span)
        if not len(lit):
            continue
        strips, points = 1, count
        if light.cone is not None:
            across = line.width / (2 * light.cone[1] * float(np.median(nodes.distance[lit])))
            total_points = _points_in_cone(light, count)
            strips = max(1, round(math.sqrt(total_points * across)))
            points = -(-total_points // strips)
        batch = max(BATCH, RAYS_AT_ONCE // len(lit))
        for n, strip in enumerate([line] if light.cone is None else line.strips(strips)):
            # points that differ from node to node: at the same ones all would miss the same of an edge
            offset = (R2_STEPS @ at[:2, lit] + GOLDEN * n) % 1 if light.cone else 0.5
            nodes, axis = _looking(strip, samples.gx[lit], samples.gy[lit], at[:, lit], light.cone)
            for first in range(0, points, batch):
                some = np.arange(first, min(first + batch, points))
                c, s, slope, reach, values = _rays(strip, nodes, axis, some, points, offset, light.brightness)
                # along = 1 and limit = reach: ground beyond the point hides nothing
                least = np.clip(slope * (1 - 1e-6), 0, STEEP)
                tangents = samples.slopes(c, s, least, np.ones_like(c), 0.0, reach, node=lit)
                clear = tangents <= np.maximum(least, slope).astype(np.float32)
                total[lit] += np.where(clear, values, 0.0).sum(0)
    return total


class LinePoints(HostImage):
    """A thin quadrangle [spacings, heights third] by ``units`` points of the line through its middle.

    Its brightness is the sum of ``lights``. Two numbers of points share none: half the difference of their
    images estimates the error. ``ray_count``: rays of the image.
    """

    unit_name = "points"

    def __init__(self, engine: Backend, scene: Scene, quad: Quad, lights: Sequence[LineLight], units: int):
        self.scene, self.quad, self.lights, self.units, self.ray_count = scene, quad, lights, units, 0
        self.samples = samples_of(engine, scene)
        self.slices = Slices(scene.on(engine), scene.sides, Dome())
        self.slices.coarsen()
        self.image = self._image(units // 2)
        self._compare()

    def refine(self) -> None:
        """Take twice as many points."""
        self.units *= 2
        self._compare()

    def _compare(self) -> None:
        coarse, self.image = self.image, self._image(self.units)
        self._half_difference = (self.image - coarse) / 2

    def _image(self, count: int) -> np.ndarray:
        """Irradiance (rows, cols) float32, otherwise as :func:`at_samples`."""
        scene, samples = self.scene, self.samples
        rows, cols = scene.shape
        y, x = np.mgrid[:rows, :cols]
        deep = scene.depth if scene.mask is None else np.nan_to_num(scene.depth)
        at, slopes = np.stack([x, y, -deep.astype(float) / scene.spacing]), gradients(scene)
        total, line, self.ray_count = np.zeros(scene.shape), line_of(self.quad), 0
        for light in self.lights:
            nodes, axis = _looking(line, *slopes, at, light.cone, wide=True)
            if light.cone is not None:
                seen = nodes.span > 0 if scene.mask is None else (nodes.span > 0) & scene.mask
                lit = np.nonzero(seen)
                samples.set_nodes(*lit[::-1])
                total[lit] += at_samples(samples, self.quad, [light], count)
                self.ray_count += _points_in_cone(light, count) * len(samples)
                continue
            for first in range(0, count, BATCH):
                some = np.arange(first, first + BATCH)
                c, s, slope, reach, values = _rays(line, nodes, axis, some, count, 0.5, light.brightness)
                ways = np.stack([c, s, np.clip(slope, 0, STEEP), np.maximum(reach, 1e-6)])
                clear = self.slices.rays(np.ascontiguousarray(np.moveaxis(ways, (2, 3), (0, 1)), np.float32))
                total += np.where(np.moveaxis(clear, -1, 0), values, 0.0).sum(0)
            self.ray_count += count * rows * cols
        return total.astype(np.float32)
