"""What planners of all kinds of source have in common.

A planner chooses the light method and the number of azimuths, slices or directions that an image begins with,
by exact light at samples (samples.py). It audits an image there, makes it finer where the loop in
refinement.py asks for that, and writes the plan.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from .. import sources
from ..backends.base import Backend
from ..errors import CapacityError
from ..interreflection import choice, expected, is_needed
from ..light.base import LightMethod
from ..light.far import CLIFF
from ..light.finite import left_below
from ..light.lattice import Lattice, lacking
from ..light.unoccluded import ClosedForm
from ..reflectance import BRDF, Lambertian, Phong
from ..samples import (
    ESTIMATE_SHARE,
    SAMPLE_COUNT,
    SAMPLED_SLOPE,
    Errors,
    Samples,
    lit_mean,
    samples_of,
    without_walls,
)
from ..scene import Scene
from .plan import Choice, Plan, percent

# error of the exact light at the samples over its difference from coarser light; measured, docs/explanation.
# With half and twice the errors of 15 lamps and windows and of 24 skies at 1 % stay the same
# (performance/constants.py --seed 24 --size 64)
EXACT_ERROR_RATIO = 0.45
MOST_UNITS = 1024  # azimuths, slices or points that refinement reaches
# the samples' rays on a map that repeats count as the search of so many azimuths of a sweep over as many
# rows, which a backend bounds. Measured on NumPy, which searches row by row (relief of 100 spacings, 16 x 16,
# two busy cores): they take as long as 29 azimuths where the exact light is found in all of EXACT_AZIMUTHS in
# turn (planning/sky.py), as 5 where the first of these suffice. Chosen between: NumPy then takes reliefs up
# to 164 spacings, whose longest plan lasts 40 to 55 s there; with half, twice as long
SAMPLED_SEARCHES = 16
MOST_STEPS = 2**40  # nodes x azimuths of a call: some three hours on two cores, ten seconds on an H200
# azimuths that a bound on the samples' search counts, a ray from every sample in each; chosen: about as many
# as the exact light of a sky takes when it is judged by all of EXACT_AZIMUTHS in turn, 540 (planning/sky.py)
SAMPLED_AZIMUTHS = 512
# relative error of the light by tables of brightness: of a sky on level ground (tests/test_integrals.py), and
# along the chords of lamps and windows, where 5e-6 to 3e-4 of the mean were measured
# (performance/refinement.py)
TABLES_ERROR = 1e-4
# of the tolerance, from which on a plan notes the rounding of depths [spacing], and light from below the
# level. Chosen: by as much as depths are rounded slopes are wrong, a tenth of what was asked for
NOTED_SHARE = 0.1
# rows and columns of nodes, at most, whose distance from a lamp is looked at; chosen
GAP_NODES = 512


class Planner(ABC):
    """Chooses a light method and its units for a kind of source, says why, and refines.

    Units are azimuths, slices, points of a line, or the hemicube's size. Subclasses set ``method_class``,
    ``units``, ``expected`` (errors at the samples) and ``exact`` (light at the samples) in :meth:`choose`.
    """

    sample_count = SAMPLE_COUNT
    method_class: type[LightMethod] = ClosedForm
    method: LightMethod
    units = 0
    expected = Errors(math.nan, math.nan, math.nan)
    exact: np.ndarray | None = None  # light at the samples
    uniform: np.ndarray | None = None  # that of a uniform sky of brightness 1
    exact_error = 0.0  # relative RMS error of the exact light at the samples
    tables_error = 0.0  # of tables of brightness, which that light and the image have in common
    unknown = ""  # why the error is not known
    interreflection: bool | str = "auto"  # whether the light between surfaces is asked for

    def __init__(self, scene: Scene, source: Any, tolerance: float, tail: float, engine: Backend):
        self.scene, self.source, self.engine = scene, source, engine
        self.tolerance, self.tail = tolerance, tail
        self.samples = samples_of(engine, scene, self.sample_count)
        lap = self.samples.relief / SAMPLED_SLOPE
        most = min(
            MOST_STEPS / SAMPLED_AZIMUTHS / len(self.samples), engine.most_searched_rows / SAMPLED_SEARCHES
        )
        if scene.sides == "periodic" and lap > most:
            raise CapacityError(
                f"A relief of {self.samples.relief:.3g} spacings on a map that repeats must be followed over"
                f" {lap:.2g} nodes; {engine.name} takes {most:.2g} at most. Give depth and spacing in one"
                " unit, or choose a compiled backend."
            )

    @abstractmethod
    def choose(self) -> None:
        """Choose the method and units that an image begins with."""

    @abstractmethod
    def make(self) -> LightMethod:
        """The chosen method, with its first image."""

    @abstractmethod
    def choices(self) -> Iterator[Choice]:
        """Lines of the plan on what is chosen for this kind of source."""

    def begin(self) -> LightMethod:
        self.method = self.make()
        return self.method

    def audit(self, method: LightMethod) -> float | None:
        """The image's relative RMS error at the samples, less that of the exact light there."""
        if self.exact is None:
            return None
        rms = self.samples.errors(method.at(self.samples), self.exact).rms
        return math.sqrt(max(0.0, rms**2 - self.exact_error**2))

    def refine(self, is_mostly_common: bool) -> bool:
        """Whether the method could be refined.

        ``is_mostly_common``: most of its error is common to both halves.
        """
        if self.closed or 2 * self.method.units > MOST_UNITS:
            return False
        self.method.refine()
        return True

    def fits(self, errors: Errors) -> bool:
        """Whether errors at the samples are within the tolerance and its tail."""
        return errors.bound <= ESTIMATE_SHARE * self.tolerance and errors.tail <= self.tail

    @property
    def closed(self) -> bool:
        """Whether the image is a closed form."""
        return self.method_class is ClosedForm

    @property
    def mean(self) -> float:
        """Mean of the exact light over the lit samples, ``samples.least`` at least; inf if both are 0."""
        known = 0.0 if self.exact is None else lit_mean(self.exact)
        return max(known, self.samples.least) or math.inf

    def between_surfaces(self, direct: np.ndarray | None) -> float | None:
        """RMS of the light between surfaces over the mean of the direct light, None where that is not known.

        ``direct``: at the samples.
        """
        if direct is None or not direct.any() or not np.any(self.scene.albedo):
            return None if direct is None else 0.0
        seen = self.uniform
        if seen is None or self.samples.sides == "dark":
            seen = uniform_light(without_walls(self.samples))
        return expected(self.scene, self.samples, direct, seen / np.pi)

    def plan(self, direct: np.ndarray | None = None) -> Plan:
        """The plan, with the errors that the samples expect; ``direct`` light there, if it was unknown."""
        between = self.between_surfaces(self.exact if direct is None else direct)
        latticed = self.method_class is Lattice
        rms = self.expected.rms
        fits = self.expected.bound <= ESTIMATE_SHARE * self.tolerance
        verdict = "within tolerance" if fits else "the best there is for tolerance"
        return Plan(
            "lattice" if latticed else "unoccluded" if self.closed else "horizon",
            self.units if latticed else None,
            True if latticed else None,
            f"relative RMS error {rms:.2g} expected, {verdict} {self.tolerance:g}"
            if math.isfinite(rms)
            else self.unknown,
            None if latticed or self.closed else self.units,
            tolerance=self.tolerance,
            tail=self.tail,
            error=float(rms) if math.isfinite(rms) else None,
            error_tail=float(self.expected.tail) if math.isfinite(self.expected.tail) else None,
            choices=(*self.choices(), *_common_choices(self, between)),
            beyond=tuple(beyond_model(self, between)),
            interreflection=between,
            unit_name=self.method_class.unit_name,
        )


def _common_choices(planner: Planner, between: float | None) -> Iterator[Choice]:
    """Lines of the plan that every kind of source has."""
    if not planner.closed:
        serves = "sweeps and slices serve every sky, sphere, rectangle and window"
        yield Choice(
            "method",
            "lattice" if planner.method_class is Lattice else "horizons",
            lacking(planner.scene, planner.source) or serves,
        )
    surface = planner.scene.reflectance
    if isinstance(surface, Lambertian):
        yield Choice("specular lobe", "none", "the surface is Lambertian")
    else:
        why = "summed beside the irradiance, to which the error given here belongs"
        lobed = isinstance(surface, Phong) and bool(np.any(surface.specular))
        latticed = lacking(planner.scene, planner.source)
        if isinstance(surface, BRDF) and latticed or lobed and planner.scene.sides == "periodic":
            why = (
                "the radiance is made by a lattice, its hemicube by the tolerance alone, and not refined; all"
                " else here is of the irradiance"
            )
        elif lobed and latticed:
            why = "summed over the lattice's directions, and not refined; the error is that of the irradiance"
        yield Choice("specular lobe", type(surface).__name__, why)
    yield Choice("interreflection", *choice(planner.interreflection, between, planner.tolerance))
    yield Choice("precision", "float32", f"depths are rounded by {_rounding(planner.samples):.1g} spacings")
    if not math.isfinite(planner.expected.rms):
        yield Choice("error", "not known", planner.unknown)
        return
    yield Choice(
        "error",
        percent(planner.expected.rms),
        f"RMS over the mean, expected from {len(planner.samples)} samples; at most"
        f" {percent(planner.expected.bound)} over all nodes, asked for"
        f" {percent(planner.tolerance)}",
    )
    yield Choice("99.9th percentile", percent(planner.expected.tail), f"asked for {percent(planner.tail)}")


def _rounding(samples: Samples) -> float:
    """By how much float32 rounds depths [spacings]."""
    return abs(float(samples.own.min())) * 2.0**-24  # no height is above 0


def uniform_light(samples: Samples) -> np.ndarray:
    """Light at the samples of a uniform sky of brightness 1, by 12 azimuths."""
    azimuths = 2 * np.pi * (np.arange(12) + 0.5) / 12
    light: np.ndarray = samples.uniform(azimuths).mean(0) * 2 * np.pi
    return light


class UnitsPlanner(Planner):
    """Chooses how many azimuths, slices or directions an image begins with, by exact light at the samples."""

    @abstractmethod
    def set_exact_light(self, units: int) -> None:
        """Set the exact light at the samples, of so many units, and its error."""

    @abstractmethod
    def light_by(self, units: int) -> np.ndarray:
        """Light at the samples of an image of so many units."""

    def choose_units(self, ladder: Iterable[tuple[int, Iterable[int]]]) -> None:
        """Take the first number of units within the tolerance, or the last of all if none is.

        ``ladder``: (units of the exact light, numbers of units that it judges), in order.
        """
        for judge, counts in ladder:
            self.set_exact_light(judge)
            assert self.exact is not None, "set_exact_light sets it"
            for self.units in counts:
                self.expected = self.samples.errors(self.light_by(self.units), self.exact)
                if self.fits(self.expected):
                    return


def beyond_model(planner: Planner, between: float | None) -> Iterator[str]:
    """What the scene needs and the model lacks, with numbers."""
    scene, source, samples = planner.scene, planner.source, planner.samples
    if planner.interreflection is False and between is not None and is_needed(between, planner.tolerance):
        yield (
            f"Light between surfaces is left out: it is about {percent(between)} of the direct light (RMS"
            " over the mean)."
        )
    gap = gap_below(scene, source, planner.engine)
    if undefined := undefined_light(source, gap):
        yield from undefined
    elif gap < 1:
        where = f"reaches {-gap:.2g} spacings into" if gap < 0 else f"ends {gap:.2g} spacings from"
        yield f"{_touches(source)} it {where} it, and the grid holds nothing finer than 1."
    if isinstance(source, sources.Lamp) and source.volume is None and not planner.closed:
        if (lost := left_below(scene, source, planner.engine)) > NOTED_SHARE * planner.tolerance:
            yield lamp_below(lost)
    if samples.cliffs > 0:
        yield (
            f"Slopes are steeper than the grid holds: {percent(samples.cliffs)} of neighbouring nodes"
            f" lie more than {CLIFF:g} spacings apart in depth."
        )
    if scene.mask is not None and not scene.mask.all():
        yield (
            f"Nodata: {percent(1 - scene.mask.mean())} of the nodes are masked; they hide nothing, so"
            " light may come through holes."
        )
    if _rounding(samples) > NOTED_SHARE * planner.tolerance:
        yield (
            f"float32 rounds depths by {_rounding(samples):.2g} spacings, more than the tolerance allows:"
            " subtract the least depth."
        )


def lamp_below(lost: float) -> str:
    """The sentence on light from below the level, of this share."""
    return (
        "Lamp below ground: ground is higher than a part of the lamp, which it sees below its level; that"
        f" light is left out. It is {percent(lost)} of all (RMS over the mean) where nothing occludes."
    )


def undefined_light(source: sources.Source, gap: float) -> list[str]:
    """The warning of a flat source from which nodes lie a ``gap`` of 0 away."""
    if gap != 0 or getattr(source, "radius", None) is not None:
        return []
    return [f"{_touches(source)} nodes lie in its plane, 0 spacings from it, where its light is not defined."]


def _touches(source: sources.Source) -> str:
    is_window = isinstance(source, sources.Window)
    return "The window touches the surface:" if is_window else "The lamp touches the surface:"


def gap_below(scene: Scene, source: sources.Source, engine: Backend) -> float:
    """Least distance [spacings] from a ball or rectangle to the nodes below it, where it is less than 1; else
    inf.
    """
    radius, edges = 0.0, np.zeros((2, 3))
    if isinstance(source, sources.Sky):
        return math.inf
    if isinstance(source, sources.Window):
        if source.x is None or source.y is None:
            return math.inf
        corner = np.array((source.x[0], source.y[0], 0.0)) / scene.spacing
        edges[0, 0], edges[1, 1] = np.diff(source.x)[0] / scene.spacing, np.diff(source.y)[0] / scene.spacing
    elif source.center is not None and source.radius is not None:
        corner, radius = np.array(source.center) / scene.spacing, source.radius / scene.spacing
    elif source.corner is not None:
        corner, edges = np.array(source.corner) / scene.spacing, np.array(source.edges) / scene.spacing
    else:  # a volume
        return math.inf
    low, high = corner + np.minimum(edges, 0).sum(0) - radius, corner + np.maximum(edges, 0).sum(0) + radius
    there = scene.on(engine)
    if -high[2] >= there.heights_range[1] + 1:
        return math.inf
    spans = []
    for axis, count in ((1, scene.shape[0]), (0, scene.shape[1])):
        first, last = (int(np.clip(end, -1e9, 1e9)) for end in (low[axis] - 2, high[axis] + 2))
        nodes = np.arange(min(max(first, 0), count - 1), max(min(last, count - 1), 0) + 1)
        spans.append(nodes[:: len(nodes) // GAP_NODES + 1])
    v, u = np.meshgrid(*spans, indexing="ij")
    z = np.nan_to_num(there.pick(v * scene.shape[1] + u).astype(float), posinf=1e30) / there.step  # masked
    apart = np.stack([u, v, z], -1) - corner
    for edge in edges[edges.any(1)]:  # they are at right angles
        apart = apart - np.clip(apart @ edge / (edge @ edge), 0, 1)[..., None] * edge
    return float(np.sqrt((apart**2).sum(-1)).min()) - radius
