"""Choose a light method, render, estimate the error, and refine until it is within the tolerance.

Exact rays at some hundred samples choose how much is rendered at first (samples.py). Half the difference of
two halves of an image estimates its error over all nodes (light/base.py); the samples audit the image for
error that both halves share. The Plan records every choice. No decision reads a clock.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from . import sources
from .arrays import by_bands
from .backends import select
from .backends.base import Backend
from .checks import positive_number
from .constants import LEAST_SEARCHED_SLOPE
from .directions import Hemicube
from .errors import CapacityError, bad
from .interreflection import ESTIMATE_SHARE, check_choice, choice, expected, is_needed
from .light import lattice, line, unoccluded
from .light.base import Estimate, Later, LightMethod, estimated
from .light.finite import MOST_RAY_EVALUATIONS, RAYS, Sliced, most_rays
from .light.horizon import Horizons, correction, margin_of
from .light.lattice import Lattice, lacking
from .light.slices import outline, widened
from .radiometry import point_error
from .reflectance import Lambertian
from .samples import (
    CHORD_POINTS,
    CLIFF,
    SAMPLE_COUNT,
    SAMPLED_SLOPE,
    Errors,
    Samples,
    samples_of,
)
from .scene import Scene, is_scene
from .sources.integrals import BrightPart, Integrals, even, integrals, without
from .sources.solids import Ball, Quad, aperture, rectangle, upright

# -- tolerance and estimates
# default bound on the 99.9th percentile of the error, in tolerances; chosen: over the images of
# docs/refinement.csv it is 3.9, 7.1 and 13 times the RMS error (5th, median and 95th percentile)
DEFAULT_TAIL = 10.0
# ratio of the error to half the difference of an image's two halves. UNSEEN_SHARE is taken where the samples
# cannot measure the ratio: the median of 60 lamps and windows (96 x 96). MOST_SHARE bounds it: error above it
# is common to both halves, and more azimuths do not reduce that. With half of UNSEEN_SHARE, one of 57 images
# of 19 lamps and panels has an error of 1.6 tolerances without a warning; with twice, 52 % of the estimates
# are within 0.5 to 3 times the truth instead of 79 %. With half and twice of MOST_SHARE, 91 % of 45 lamps,
# panels and windows (64 x 64) are within 1 %, as with it
UNSEEN_SHARE, MOST_SHARE = 0.5, 1.3
# largest ratio of the mean square of that half difference over all nodes to the one at the samples that is
# taken for sampling noise; what is above it belongs to a few nodes that the samples miss. Chosen: the samples
# measure a mean square to some 10 %, and a few missed nodes make it 4 to 10^6 times as large. With twice the
# ratio, of 57 images of 19 lamps and panels as many are within the tolerance, and as many estimates are right
SEEN = 2.0
# error of the exact light at the samples over its difference from coarser light; measured, docs/explanation.
# With half and twice the errors of 15 lamps and windows and of 24 skies at 1 % stay the same
# (performance/constants.py --seed 24 --size 64)
JUDGE_SHARE = 0.45
MOST_TAIL_SHARE = 1e-3  # share of nodes whose error may be above the tail, which bounds a 99.9th percentile
MOST_UNITS = {Horizons: 1024, Sliced: 1024, Lattice: 33}  # largest number of units that refinement reaches
# azimuths of a sweep whose search takes as long as the samples' rays on a map that repeats, row by row on
# NumPy: measured 29 (relief of 100 spacings, 16 x 16, two busy cores). Chosen: some 55 s for the longest plan
# there, by that measurement; with half, twice as long
SAMPLED_SEARCHES = 16
MOST_STEPS = 2**40  # nodes x azimuths of a call: some three hours on two cores, ten seconds on an H200

# -- skies
# numbers of azimuths that an image may begin with: powers of two, and 3/2 of them; refining doubles them
AZIMUTH_COUNTS = (4, 6, 8, 12, 16, 24, 32, 48)
EXACT_GRIDS = (36, 72, 144, 288)  # azimuths of the exact light, which judges a sixth as many
# the first of them on a device with memory of its own, which traces so many as fast as 36 (line
# "tolerance 0.01" of performance/whole_calls.py, H200: 31 ms, with 36 at first 34; 8.1 and 9.1 on 256 x 256)
GPU_GRID = 144
# least number of sectors of azimuth of all small bright parts together, as many as a CPU computes at a time;
# the multiples of it that are tried in turn; and the multiple of an image's in the exact light: odd, so that
# its sectors have other borders
LEAST_SECTORS, SECTOR_MULTIPLES, JUDGING_MULTIPLE = 8, (1, 3, 9), 3
# near rows, within which every crossing is tested: where the usual 6 do not suffice, and where 24 do not
CLIFF_NEAR_ROWS = 24, 96
# RMS error of sweeps with 6 near rows, over the square root of the share of neighbouring nodes that are
# cliffs; measured. With half and twice as many of 24 images are within 1 %, in 1.02 and 0.95 of the time
# (performance/constants.py --seed 23 --size 64)
BEHIND_CLIFFS = 0.028
# tolerance below which the shadows of suns are computed with 24 near rows: their error is 0.1 to 0.9 % with 6
# near rows and 0.01 to 0.35 % with 24 (fractals, terrain)
SHARP_SHADOWS = 0.01
# relative error of the light by tables of brightness: of a sky on level ground (tests/test_integrals.py), and
# along the chords of lamps and windows, where 5e-6 to 3e-4 of the mean were measured
# (performance/refinement.py)
TABLES_ERROR = 1e-4
# of the mean, error of closed forms and sums in float32, in which two halves do not differ: measured 1e-5 RMS
# under panels over planes (performance/refinement.py)
ROUNDING_ERROR = 1e-5

# -- lamps and windows
# numbers of slices that an image may begin with: of a source that stands all round a node, and of a
# quadrangle, whose four sectors share them; refining doubles them
BALL_SLICES, QUAD_SLICES = (8, 16, 32, 64), (32, 64)
# points along a thin source; and the apparent width [rad], 0.3 degrees, below which a source is computed as a
# line. That neglects how brightness varies across it: its curvature times the squared width over 24. Chosen;
# with half and twice the median and the largest error of 16 panels, windows and lamps at 1 % stay the same
LINE_COUNTS, LINE_WIDTH = (32, 64, 128, 256, 512), 5e-3
JUDGING_SLICES = 4  # times the slices of an image: those of the exact light that judges it
# largest azimuth [rad] that a small bright part behind a window may span: slices, which are placed within the
# window, resolve wider ones
WINDOWED_PART = math.radians(5)
# sectors of a small bright part behind a window in the exact light, where the window shows the whole part;
# multiplied by the part's width over the window's where that is larger; and their largest number. They are
# odd, so that they are no multiple of the numbers that they judge
JUDGING_SECTORS, MOST_JUDGING_SECTORS = 127, 1021
# apparent radius [rad] of a lamp below which rays sample its brightness: six cells of a table of brightness
NARROW_RADIUS = 0.02
# extents of a map to which a rectangular lamp may reach: there a node is a quarter of float32's resolution
MOST_PANEL_EXTENTS = 2.0**22
MOST_BALL_EXTENTS = 2.0**40  # the same of a sphere, whose squares stay in float32; suns stand at 1e5
# least mean irradiance to which errors are relative, as a share of the mean light of the same source if it
# were unoccluded and everywhere as bright as in its brightest direction; chosen: a thousandth of what an
# 8-bit image shows under the beam itself; with half and twice the errors of 15 lamps and windows at 1 % stay
# the same
DARK = 1e-6
# rounding of depths [spacing], over the tolerance, from which on a plan says so; chosen: by as much the slope
# between neighbours is wrong, a tenth of the error that was asked for
ROUNDED_SHARE = 0.1
POINT_SHARE = 0.1  # share of the tolerance: largest error as a point of a lamp that a plan calls a point


@dataclass(frozen=True)
class Choice:
    """One line of a plan: what was to be chosen, what was taken, and why."""

    what: str
    taken: str
    why: str


class Step(NamedTuple):
    """One image of a refinement.

    units: azimuths, slices or the hemicube's size; estimate: of the relative RMS error over all nodes; audit:
    the relative RMS error at the samples.
    """

    units: int
    estimate: float | None
    audit: float | None


@dataclass(frozen=True)
class Plan:
    """The model that was or will be used, and why.

    method: "unoccluded", "horizon" or "lattice". hemicube, filled: of the lattice, else None. azimuths: of
    horizons, or slices of a lamp or window. max_distance [unit of spacing] of the search, None: the whole
    map. tolerance, tail: the relative RMS error and the 99.9th percentile of the error that were asked for.
    error: the relative RMS error, expected from the samples before an image is made, estimated from its two
    halves afterwards; error_tail: the 99.9th percentile expected from the samples; measured: the RMS error of
    the rendered image at the samples. reason: of the method and its units, in one sentence; choices: every
    choice with its reason, and the refinement; steps: every image that was made; beyond: what the scene needs
    and the model lacks, with numbers; interreflection: estimated RMS of the light between surfaces over the
    mean of the direct light. seconds of the whole call and planning_seconds before the first image are
    measured; no decision depends on them. Fields that do not apply are None or empty.
    """

    method: str
    hemicube: int | None
    filled: bool | None
    reason: str
    azimuths: int | None = None
    max_distance: float | None = None
    tolerance: float | None = None
    tail: float | None = None
    error: float | None = None
    error_tail: float | None = None
    measured: float | None = None
    seconds: float | None = field(default=None, compare=False)
    planning_seconds: float | None = field(default=None, compare=False)
    choices: tuple[Choice, ...] = ()
    steps: tuple[Step, ...] = ()
    beyond: tuple[str, ...] = ()
    interreflection: float | None = None

    @property
    def line(self) -> str:
        """The plan in one line."""
        if self.method == "lattice":
            step = "filled" if self.filled else "stride"
            return f"lattice, hemicube {self.hemicube}, {step}: {self.reason}"
        return f"{self.method}{'' if self.azimuths is None else f', {self.azimuths} azimuths'}: {self.reason}"

    def __str__(self) -> str:
        if not self.choices:
            return self.line
        widths = [max(len(getattr(c, name)) for c in self.choices) for name in ("what", "taken")]
        lines = [f"{c.what:{widths[0]}}  {c.taken:{widths[1]}}  {c.why}".rstrip() for c in self.choices]
        return "\n".join([*lines, *(f"beyond the model: {text}" for text in self.beyond)])


class Refined(NamedTuple):
    """A refined irradiance (rows, cols) float32 and its error.

    half: half the difference of its two halves, or None; error_per_half: ratio of the error to it;
    common_error: error that is common to both halves [brightness x sr]; the plan, and warnings.
    """

    irradiance: Any  # np.ndarray, or a DeviceImage where it stays on the device
    half: Later | None
    error_per_half: float
    common_error: float
    plan: Plan
    warnings: list[str]


def plan(
    scene: Scene,
    source: sources.Source,
    tolerance: float = 0.01,
    backend: str = "auto",
    *,
    tail: float | None = None,
    interreflection: bool | str = "auto",
) -> Plan:
    """How :func:`skylamp.render` will begin on ``scene`` under ``source`` to be within ``tolerance``.

    Printed, it is a table with a reason per choice. Its error is the one expected at the samples; a render
    refines further where its image has a larger one. One line gives the share of light between surfaces.

    Parameters
    ----------
    tolerance : float
        RMS error over all valid nodes, divided by the mean of the exact irradiance over its lit nodes.
    tail : float, optional
        Bound on the 99.9th percentile of the absolute error, over the same mean; ten tolerances unless given.
    backend : str
        See :func:`skylamp.backends`.
    interreflection : "auto", True or False
        As of :func:`skylamp.render`.

    Returns
    -------
    Plan
        Printed, a table with a reason per line.

    Raises
    ------
    InputError, BackendError, CapacityError
    """
    is_scene(scene)
    check_choice(interreflection)
    engine = select(backend)
    if isinstance(source, sources.Sky):
        scene = scene.under_sky()
    if isinstance(source, sources.Source):
        source, _ = sources.in_range(sources.on_axes(source, scene.axes))
    with engine.lock:
        seconds = _stopwatch(engine)
        planner = choose(scene, source, tolerance, engine, tail, interreflection)
        planning = seconds()
        return replace(planner.plan(), planning_seconds=planning)


def refined(
    scene: Scene,
    source: sources.Source,
    tolerance: float,
    engine: Backend,
    tail: float | None = None,
    interreflection: bool | str = "auto",
    stays: bool = False,
) -> Refined:
    """The direct irradiance of a grey source within the tolerance, or as near as possible with a warning.

    ``interreflection``: as of :func:`skylamp.render`; the plan alone uses it. ``stays``: an irradiance that
    is made on the device stays there.
    """
    seconds = _stopwatch(engine)
    planner = choose(scene, source, tolerance, engine, tail, interreflection)
    planning = seconds()
    method, steps = planner.begin(), []
    while True:
        assessment = assess(planner, method)
        steps.append(Step(method.units, assessment.estimated, assessment.audit))
        if assessment.within(tolerance) or not planner.refine(assessment.is_shared):
            break
        method = planner.method
    made = planner.plan(method.at(planner.samples) if planner.exact is None else None)
    if len(steps) > 1:
        begun, last = (f"{step.units} {_units_of(made.method)}" for step in (steps[0], steps[-1]))
        why = f"{begun} at first: the estimated error was {_percent(assessment.error or 0)} in the end"
        reason = f"refined {len(steps) - 1} times, relative RMS error {assessment.error or 0:.2g} estimated"
        made = replace(made, reason=reason, choices=(*made.choices, Choice("refined to", last, why)))
    made = replace(
        made,
        hemicube=method.units if made.method == "lattice" else None,
        azimuths=method.units if made.method == "horizon" else None,
        error=made.error if assessment.error is None else assessment.error,
        measured=assessment.audit,
        steps=tuple(steps),
        seconds=seconds(),
        planning_seconds=planning,
    )
    mean = planner.mean if math.isfinite(planner.mean) else 0.0
    common = math.hypot(assessment.common_error, ROUNDING_ERROR)
    common = common * mean if math.isfinite(common) else math.inf
    light = method.device_image() if stays else None
    irradiance = method.irradiance() if light is None else light
    return Refined(
        irradiance,
        method.half(),
        assessment.error_per_half,
        common,
        made,
        assessment.warnings(tolerance, planner.tail),
    )


def _units_of(method: str) -> str:
    return {"lattice": "nodes of a hemicube's side", "unoccluded": "rays"}.get(method, "azimuths or slices")


class Assessment(NamedTuple):
    """What is known of the relative RMS error of an image.

    estimate: half the difference of the image's two halves, None where it has none; error_per_half: ratio
    of the error to it; audit: the error at the samples, None where their exact light is not known;
    common_error: the part of the error that is common to both halves.
    """

    estimate: Estimate | None
    error_per_half: float
    audit: float | None
    common_error: float

    @property
    def estimated(self) -> float | None:
        """The error over all nodes: what differs between the halves, and what is common to them."""
        if self.estimate is None:
            return None
        return math.hypot(self.error_per_half * self.estimate.rms, self.common_error)

    @property
    def error(self) -> float | None:
        """The larger of the estimate and the audit, None where neither is known; the tolerance bounds it."""
        return max((value for value in (self.estimated, self.audit) if value is not None), default=None)

    @property
    def is_shared(self) -> bool:
        """Whether most of the error is common to both halves."""
        return self.audit is not None and self.common_error > 0.5 * self.audit

    def within(self, tolerance: float) -> bool:
        """Whether the error is within the tolerance and its tail, as far as they are known."""
        few = self.estimate is None or self.estimate.tail_share <= MOST_TAIL_SHARE
        return self.error is None or self.error <= ESTIMATE_SHARE * tolerance and few

    def warnings(self, tolerance: float, tail: float) -> list[str]:
        """A sentence, with its number, for each of tolerance and tail that is not kept."""
        texts = []
        if self.error is not None and self.error > tolerance:
            texts.append(
                f"Tolerance: the estimated error is {100 * self.error:.3g} % of the mean (RMS),"
                f" more than the {100 * tolerance:.3g} % asked for."
            )
        if self.estimate is not None and self.estimate.tail_share > MOST_TAIL_SHARE:
            texts.append(
                f"Tail: the error is estimated to pass {100 * tail:.3g} % of the mean at"
                f" {100 * self.estimate.tail_share:.2g} % of the nodes; {100 * MOST_TAIL_SHARE:.2g} % of them"
                " may."
            )
        return texts


def assess(planner: _Planner, method: LightMethod) -> Assessment:
    """The error of an image, by the difference of its two halves and by the samples.

    The samples give the ratio of the error to half the difference. The error of the exact light itself, up to
    UNSEEN_SHARE of half the difference, is a lower bound of the image's. Error above MOST_SHARE of half the
    difference is common to both halves. Where half the difference is far larger over all nodes than at the
    samples, the excess belongs to few nodes that the samples miss; its ratio is UNSEEN_SHARE.
    """
    samples, exact = planner.samples, planner.exact
    audit = planner.audit(method)
    half = None if exact is None else method.half_at(samples)
    if exact is None or half is None or audit is None or math.isinf(audit):  # nothing is lit by exact rays
        return Assessment(None, 0.0, audit, audit or 0.0)
    by_half = samples.errors(exact + half, exact).rms
    error = max(audit, min(planner.exact_error, UNSEEN_SHARE * by_half))
    share = min(error / by_half, MOST_SHARE) if by_half > 0 else UNSEEN_SHARE
    estimate = method.estimate(planner.tail * planner.mean / max(share, UNSEEN_SHARE))
    assert estimate is not None, "a method with a half has an estimate"
    lit = exact[exact > 0]
    estimate = estimate._replace(rms=estimate.rms * float(lit.sum()) / max(1, lit.size) / planner.mean)
    seen = min(1.0, SEEN * (by_half / estimate.rms) ** 2) if estimate.rms > 0 else 1.0
    shared = math.sqrt(max(0.0, error**2 - (share * by_half) ** 2))
    share = math.sqrt(seen * share**2 + (1 - seen) * UNSEEN_SHARE**2)
    return Assessment(estimate, share, audit, math.hypot(shared, planner.tables))


def choose(
    scene: Scene,
    source: sources.Source,
    tolerance: float,
    engine: Backend,
    tail: float | None = None,
    interreflection: bool | str = "auto",
) -> _Planner:
    """The planner for this kind of source, with the method and units that an image begins with."""
    tolerance = positive_number(tolerance, "tolerance")
    tail = DEFAULT_TAIL * tolerance if tail is None else positive_number(tail, "tail")
    if not isinstance(source, sources.Source):
        raise bad("source", type(source).__name__, "Sky, Lamp or Window")
    if scene.sides == "periodic" or not (isinstance(source, sources.Lamp) and source.corner is not None):
        sources.geometry(source, scene, 1.0)  # checks that they fit
    planner_class: type[_Planner] = _SlicePlanner
    if lacking(scene, source):
        planner_class = _LatticePlanner
    elif isinstance(source, sources.Sky):
        planner_class = _SkyPlanner
    elif solid_of(scene, source, 1 / scene.spacing, 1.0) is None:
        planner_class = _HiddenWindowPlanner
    planner = planner_class(scene, source, tolerance, tail, engine)
    planner.interreflection = interreflection
    planner.choose()
    return planner


def solid_of(
    scene: Scene, source: sources.Lamp | sources.Window, scale: float, step: float
) -> Ball | Quad | None:
    """The shape of a lamp or window, lengths times ``scale`` so that the spacing is ``step``.

    None for a window outside a dark box, or too far away to light anything.
    """
    if isinstance(source, sources.Window):
        (x0, x1), (y0, y1) = np.array(source.x) * scale, np.array(source.y) * scale
        return aperture((x0, x1), (y0, y1), scene.shape, step, scene.sides, scene.deepest * scale)
    _check_reach(scene, source)
    if source.corner is not None and source.edges is not None:
        return rectangle(*(np.array(v) * scale for v in (source.corner, *source.edges)))
    assert source.center is not None and source.radius is not None, "the lattice alone renders a volume"
    x, y, z = np.array(source.center) * scale
    return Ball((x, y, z), source.radius * scale)


def _check_reach(scene: Scene, lamp: sources.Lamp) -> None:
    """InputError for a lamp so far away, or so large, that float32 cannot tell the nodes' views apart."""
    numbers: list[Any] = [lamp.center, lamp.radius]
    most = MOST_BALL_EXTENTS
    if lamp.corner is not None:
        numbers, most = [lamp.corner, lamp.edges], MOST_PANEL_EXTENTS
    far = max(float(np.abs(part).max()) for part in numbers if part is not None)
    extent = max(max(scene.shape) * scene.spacing, scene.deepest)
    if far > most * extent:
        raise bad(
            "lamp: of such size or so far away",
            f"{far:.3g} for a map of {extent:.3g}",
            f"{most:g} times the map's extent, which float32 resolves",
            "Give a Sky, or a Window.",
        )


class _ClosedForm(LightMethod):
    """An image in closed form, which has nothing to refine.

    ``coarse``: the same by a quarter of the rays to a source whose brightness varies.
    """

    units = 0

    def __init__(self, scene: Scene, image: np.ndarray, coarse: np.ndarray | None = None):
        self.scene, self.image, self.difference = scene, image, None
        if coarse is not None:
            self.difference = (image - coarse) / 2

    def refine(self) -> None:
        """There is nothing finer."""

    def irradiance(self) -> np.ndarray:
        return self.image

    def half(self) -> Later | None:
        half = self.difference
        return None if half is None else Later(lambda: half)

    def estimate(self, limit: float) -> Estimate | None:
        half = self.difference
        return None if half is None else estimated(self.image, half, self.scene.mask, limit)


class _Planner(ABC):
    """Chooses a light method and its units for a kind of source, says why, and refines.

    Subclasses set ``method_class``, ``units``, ``expected`` (errors at the samples) and ``exact`` (light at
    the samples) in :meth:`choose`.
    """

    sample_count = SAMPLE_COUNT
    method_class: type[LightMethod] = _ClosedForm
    method: LightMethod
    units = 0
    expected = Errors(math.nan, math.nan, math.nan)
    exact: np.ndarray | None = None  # light at the samples
    uniform: np.ndarray | None = None  # that of a uniform sky of brightness 1
    exact_error = 0.0  # relative RMS error of the exact light at the samples
    tables = 0.0  # error of tables of brightness, which that light and the image share
    unknown = ""  # why the error is not known
    interreflection: bool | str = "auto"  # whether the light between surfaces is asked for

    def __init__(self, scene: Scene, source: Any, tolerance: float, tail: float, engine: Backend):
        self.scene, self.source, self.engine = scene, source, engine
        self.tolerance, self.tail = tolerance, tail
        self.samples = samples_of(engine, scene, self.sample_count)
        lap = self.samples.relief / SAMPLED_SLOPE
        most = min(MOST_STEPS / 512 / len(self.samples), engine.most_searched_rows / SAMPLED_SEARCHES)
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

    def refine(self, is_shared: bool) -> bool:
        """Whether the method could be refined. ``is_shared``: its two halves share the error."""
        most = MOST_UNITS.get(self.method_class)
        if most is None or 2 * self.method.units > most:
            return False
        self.method.refine()
        return True

    def fits(self, errors: Errors) -> bool:
        """Whether errors at the samples are within the tolerance and its tail."""
        return errors.bound <= ESTIMATE_SHARE * self.tolerance and errors.tail <= self.tail

    @property
    def closed(self) -> bool:
        """Whether the image is a closed form."""
        return self.method_class is _ClosedForm

    @property
    def mean(self) -> float:
        """Mean of the exact light over the lit samples, at least the least; inf where it is not known."""
        lit = self.exact[self.exact > 0] if self.exact is not None else np.zeros(0)
        return max(float(lit.mean()) if lit.size else 0.0, self.samples.least) or math.inf

    def between_surfaces(self, direct: np.ndarray | None) -> float | None:
        """RMS of the light between surfaces over the mean of the direct light, None where that is not known.

        ``direct``: at the samples.
        """
        if direct is None or not direct.any() or not np.any(self.scene.albedo):
            return None if direct is None else 0.0
        if self.uniform is None:
            self.uniform = _uniform_light(self.samples)
        return expected(self.scene, self.samples, direct, self.uniform / np.pi)

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
        )


def _common_choices(planner: _Planner, between: float | None) -> Iterator[Choice]:
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
        yield Choice("specular lobe", type(surface).__name__, why)
    yield Choice("interreflection", *choice(planner.interreflection, between, planner.tolerance))
    yield Choice("precision", "float32", f"depths are rounded by {_rounding(planner.samples):.1g} spacings")
    if not math.isfinite(planner.expected.rms):
        yield Choice("error", "not known", planner.unknown)
        return
    yield Choice(
        "error",
        _percent(planner.expected.rms),
        f"RMS over the mean, expected from {len(planner.samples)} samples; at most"
        f" {_percent(planner.expected.bound)} over all nodes, asked for"
        f" {_percent(planner.tolerance)}",
    )
    yield Choice("99.9th percentile", _percent(planner.expected.tail), f"asked for {_percent(planner.tail)}")


def _rounding(samples: Samples) -> float:
    """By how much float32 rounds depths [spacings]."""
    return abs(float(samples.own.min())) * 2.0**-24  # no height is above 0


def _uniform_light(samples: Samples) -> np.ndarray:
    """Light at the samples of a uniform sky of brightness 1, by 12 azimuths."""
    azimuths = 2 * np.pi * (np.arange(12) + 0.5) / 12
    light: np.ndarray = samples.uniform(azimuths).mean(0) * 2 * np.pi
    return light


class _UnitsPlanner(_Planner):
    """Chooses how many azimuths, slices or directions an image begins with, by exact light at the samples."""

    @abstractmethod
    def judge_by(self, units: int) -> None:
        """Set the exact light at the samples, of so many units, and its error."""

    @abstractmethod
    def light_of(self, units: int) -> np.ndarray:
        """Light at the samples of an image of so many units."""

    def choose_units(self, ladder: Iterable[tuple[int, Iterable[int]]]) -> None:
        """Take the first number of units within the tolerance.

        ``ladder``: (units of the exact light, numbers of units that it judges), in order.
        """
        for judge, counts in ladder:
            self.judge_by(judge)
            assert self.exact is not None, "judge_by sets it"
            for self.units in counts:
                self.expected = self.samples.errors(self.light_of(self.units), self.exact)
                if self.fits(self.expected):
                    return


class _SkyPlanner(_UnitsPlanner):
    """Skies: horizons in even azimuths."""

    method_class = Horizons

    light: float | Integrals  # a brightness, or its integrals
    bright_parts: tuple[BrightPart, ...] = ()
    by_sectors: dict[int, np.ndarray]  # their light at the samples by sectors of each, two halves
    near_rows: int | None = None
    sectors = judging_sectors = 0  # of azimuth, of every small bright part: of the image, of the exact light
    exact_margin: int | None = None  # of the map, for exact horizons of small bright parts; None: swept
    grid = 0  # azimuths of the exact light
    angles: np.ndarray  # these azimuths
    slopes: np.ndarray  # exact horizons in them
    lit: np.ndarray  # light of brightness 1 above these, per radian
    smooth: np.ndarray  # exact light without small bright parts, two halves
    exact: np.ndarray
    uniform: np.ndarray

    def choose(self) -> None:
        samples, self.by_sectors = self.samples, {0: np.zeros((2, len(self.samples)))}
        self._integrate()
        sharp = self.bright_parts and self.exact_margin is None and self.tolerance < SHARP_SHADOWS
        if sharp or BEHIND_CLIFFS * math.sqrt(samples.cliffs) > 0.5 * self.tolerance:
            self.near_rows = CLIFF_NEAR_ROWS[0]
        planes = even(unoccluded.INTEGRATED_AZIMUTHS, 0.5)
        self.free = (
            planes.widths
            @ samples.ring(
                planes.angles,
                _open_slopes(samples, planes.angles),
                self.light.table(planes.angles, planes.widths),
            )
            if isinstance(self.light, Integrals)
            else np.pi / 2 * self.light * (1 + 1 / samples.length)
        )
        grids = [grid for grid in EXACT_GRIDS if self.engine.shares or grid >= GPU_GRID]
        self.judge_by(grids[0])
        self._choose_sectors()
        judged = [0, *(grid // 6 for grid in grids)]
        self.choose_units(
            (grid, [n for n in AZIMUTH_COUNTS if low < n <= high])
            for grid, low, high in zip(grids, judged, judged[1:])
        )
        self._check_work()

    def _integrate(self) -> None:
        """Set the brightness: a number, or its integrals and its small bright parts."""
        scene, brightness = self.scene, self.source.brightness
        if not callable(brightness):
            self.light = float(brightness)
            return
        self.light = sky = integrals(self.source, self.tolerance)
        self.bright_parts, self.tables = sky.bright_parts, math.hypot(TABLES_ERROR, sky.error)
        if self.bright_parts and self.samples.cliffs > 0:
            self.exact_margin = margin_of(scene, self.bright_parts, self.samples.relief)

    def judge_by(self, units: int) -> None:
        """Exact light at the samples in so many azimuths, unless it is known in as many or more."""
        samples, width = self.samples, 2 * np.pi / units
        if units <= self.grid:
            return
        self.grid, self.angles = units, width * np.arange(units)
        self.slopes, self.lit = samples.horizons(self.angles), samples.uniform(self.angles)
        self.uniform = self.lit.sum(0) * width
        self.smooth = np.stack([self._light_in(np.arange(odd, units, 2), width) for odd in (0, 1)])
        self._add_bright_parts()

    def _add_bright_parts(self) -> None:
        """Set the exact light, that of even azimuths and that of small bright parts."""
        one, other = self.smooth + self._bright_light(self.judging_sectors)
        self.exact = (one + other) / 2
        self.exact_error = JUDGE_SHARE * self.samples.errors(other, self.exact).rms

    def light_of(self, units: int) -> np.ndarray:
        one, other = (
            self._light_in(self.grid * (3 * np.arange(odd, units, 2) + 1) // (3 * units), 2 * np.pi / units)
            for odd in (0, 1)
        )
        light: np.ndarray = (one + other) / 2 + self._bright_light(self.sectors).mean(0)
        return light

    def _bright_light(self, sectors: int) -> np.ndarray:
        """Light of small bright parts at the samples by so many sectors of each, (2, nodes): two halves."""
        if sectors not in self.by_sectors:
            halves = [
                [self.samples.sectors(*spot.sectors(sectors, half)) for spot in self.bright_parts]
                for half in (False, True)
            ]
            self.by_sectors[sectors] = np.array(
                [sum(lights, np.zeros(len(self.samples))) for lights in halves]
            )
        return self.by_sectors[sectors]

    def _light_in(self, chosen: np.ndarray, window: float) -> np.ndarray:
        """Light in ``chosen`` azimuths of the grid, as a share of that above tangent planes; see Horizons.

        Brightness is averaged over ``window`` [rad] round each.
        """
        width = 2 * np.pi / len(chosen)
        if not isinstance(self.light, Integrals):
            uniform: np.ndarray = self.light * width * self.lit[chosen].sum(0)
            return uniform
        angles = self.angles[chosen]
        table = self.light.table(angles, np.full(len(chosen), window))
        planes, light = (
            width * self.samples.ring(angles, slopes, table).sum(0)
            for slopes in (_open_slopes(self.samples, angles), self.slopes[chosen])
        )
        total: np.ndarray = light * correction(self.free, planes)
        return total

    def _choose_sectors(self) -> None:
        """The fewest sectors of small bright parts whose light at the samples is that of many."""
        if not self.bright_parts:
            return
        for times in SECTOR_MULTIPLES:
            self.sectors = times * max(1, -(-LEAST_SECTORS // len(self.bright_parts)))
            self.judging_sectors = JUDGING_MULTIPLE * self.sectors
            self._add_bright_parts()
            few, many = (self._bright_light(n).mean(0) for n in (self.sectors, self.judging_sectors))
            if self.fits(self.samples.errors(self.exact + few - many, self.exact)):
                break

    def _check_work(self) -> None:
        """CapacityError where the azimuths, with the search on a map that repeats, are too much work."""
        lap = self.samples.relief / LEAST_SEARCHED_SLOPE if self.scene.sides == "periodic" else 0.0
        steps = self.units * math.prod(self.scene.shape) * (1 + lap / min(self.scene.shape))
        if steps > MOST_STEPS:
            raise CapacityError(
                f"A tolerance of {self.tolerance:g} takes some {steps:.2g} nodes x azimuths here; at most"
                f" {MOST_STEPS:,}. Take a larger tolerance or a smaller map."
            )

    def make(self) -> LightMethod:
        return self._horizons(self.units)

    def _horizons(self, units: int) -> Horizons:
        return Horizons(
            self.engine,
            self.scene,
            self.light,
            units,
            self.sectors,
            self.near_rows,
            self.exact_margin,
        )

    def audit(self, method: LightMethod) -> float | None:
        if 3 * method.units > self.grid:
            self.judge_by(max(EXACT_GRIDS))
        if isinstance(method, Horizons) and JUDGING_MULTIPLE * method.sectors > self.judging_sectors:
            self.judging_sectors = JUDGING_MULTIPLE * method.sectors
            self._add_bright_parts()
        return super().audit(method)

    def refine(self, is_shared: bool) -> bool:
        if self.method_class is Horizons and is_shared:
            near = next((near for near in CLIFF_NEAR_ROWS if near > (self.near_rows or 0)), None)
            if near is not None:
                self.near_rows = near
                self.method = self._horizons(self.method.units)
                return True
        if self.method_class is Horizons and self.scene.sides == "periodic":
            times = self.method.units // self.units
            added = times * (self.units + 2 * len(self.bright_parts) * self.sectors)
            if self.samples.relief / LEAST_SEARCHED_SLOPE * added > self.engine.most_searched_rows:
                return False  # the image stays, with its warning
        return super().refine(is_shared)

    def choices(self) -> Iterator[Choice]:
        hidden = self.samples.errors(self.uniform, np.pi / 2 * (1 + 1 / self.samples.length)).rms
        yield Choice("occlusion", "by ground", f"ground takes {_percent(hidden)} of the light (RMS)")
        if isinstance(self.light, Integrals):
            yield Choice("brightness", "a table per azimuth", f"integrated to {_percent(self.light.error)}")
        else:
            yield Choice("brightness", "constant", "it is a number")
        if self.bright_parts:
            taken = f"{2 * self.sectors + 1} azimuths each"
            why = "small and bright: suns, lights and spots have azimuths of their own"
            yield Choice("bright parts", f"{len(self.bright_parts)}, {taken}", why)
        yield Choice(
            "azimuths", f"{self.units} evenly", "the fewest whose light at the samples is that of many"
        )
        why = f"on a map that repeats, as far as its relief makes a slope of {LEAST_SEARCHED_SLOPE}"
        yield Choice(
            "search radius",
            "whole map",
            why if self.scene.sides == "periodic" else "a sweep costs the same however far it looks",
        )
        if self.near_rows:
            yield Choice(
                "near rows", f"{self.near_rows}", "there are cliffs: every crossing so near is tested"
            )


def _open_slopes(samples: Samples, angles: np.ndarray) -> np.ndarray:
    """Horizon slopes at the samples of tangent planes and the level alone."""
    slopes: np.ndarray = np.maximum(0, samples.plane(np.cos(angles)[:, None], np.sin(angles)[:, None]))
    return slopes


class _HiddenWindowPlanner(_Planner):
    """A window of which a dark box, or its distance, leaves nothing."""

    def choose(self) -> None:
        self.exact, self.expected = np.zeros(len(self.samples)), Errors(0.0, 0.0, 0.0)

    def make(self) -> LightMethod:
        return _ClosedForm(self.scene, np.zeros(self.scene.shape, np.float32))

    def choices(self) -> Iterator[Choice]:
        yield Choice("window", "nothing to see", "a dark box, or its distance, leaves nothing of it")


class _SlicePlanner(_UnitsPlanner):
    """Lamps and windows of simple shape: a closed form where every node looks at all of it, else slices."""

    sample_count = 256  # shadows are sharper than a sky's, and rays cost more
    solid: Ball | Quad  # [spacings], heights third
    sky: Integrals | None = None  # of a brightness that varies
    rays = 0  # along which the brightness of slices is taken, 0: along their chords
    points = 0  # rays of the closed form
    is_thin = False  # its light is taken along the line through its middle
    bright: float | np.ndarray = 0.0  # light of small bright parts behind a window
    smooth: sources.Brightness  # brightness without these
    lights: tuple[line.Light, ...] = ()  # of a thin source
    by_slices: dict[
        tuple[int, int], np.ndarray
    ]  # light at the samples by numbers of slices and points of each
    exact: np.ndarray

    def choose(self) -> None:
        brightness = self.source.brightness
        self._place()
        self.is_thin = _looks_thin(self)
        if callable(brightness):
            if self.is_thin or isinstance(self.source, sources.Window):
                self._integrate_sky()
            most = sources.radiance(sources.Sky(brightness), Hemicube(9).directions).max()
            self.samples.least = DARK * float(self._unoccluded(1, float(most)).mean())
        self.uniform = _uniform_light(self.samples)
        if self.sky is not None and self.sky.bright_parts and not self.is_thin:
            self.bright = self.scale * sum(
                self.samples.sectors(
                    *spot.sectors(_judging_sectors(spot, self.outline, self.samples)), self.outline
                )
                for spot in self.sky.bright_parts
            )
            brightness = partial(without, self.source.brightness, self.sky.bright_parts)
        self.smooth, self.by_slices = brightness, {}
        if self.is_thin:
            self.lights = line.lights_of(self.source.brightness, self.sky.bright_parts if self.sky else ())
        else:
            self.judge_by(JUDGING_SLICES * BALL_SLICES[0])
            if self._fits_closed_form():
                return
        self._take_slices()

    def _take_slices(self) -> None:
        """Choose slices, and how brightness is taken: along few rays to a small lamp, else along chords."""
        self.method_class = Sliced
        counts = LINE_COUNTS if self.is_thin else BALL_SLICES if isinstance(self.solid, Ball) else QUAD_SLICES
        if callable(self.source.brightness) and not self.is_thin:
            if self.is_small:
                self.rays = RAYS[0]
            elif self.sky is None:
                self.sky = integrals(sources.Sky(self.source.brightness), math.inf, True)
            self.tables = 0.0 if self.rays else TABLES_ERROR
        self.choose_units((JUDGING_SLICES * count, [count]) for count in counts)

    def judge_by(self, units: int) -> None:
        # half of the points along chords too: they meet a brightness's edges by chance
        coarse, self.exact = self._through(units // 2, CHORD_POINTS // 2), self._through(units, CHORD_POINTS)
        self.exact_error = JUDGE_SHARE * self.samples.errors(coarse, self.exact).rms

    def light_of(self, units: int) -> np.ndarray:
        # of a quadrangle that looks small the kernel takes half of the slices
        halved = isinstance(self.solid, Quad) and not self.is_thin
        return self._through(units // 2 if halved else units, CHORD_POINTS)

    def _through(self, count: int, points: int) -> np.ndarray:
        """Light at the samples through ``count`` slices, and that of small bright parts; or along a line."""
        if self.is_thin or not callable(self.smooth):
            points = 0
        if (count, points) not in self.by_slices:
            if self.is_thin:
                assert isinstance(self.solid, Quad), "balls are not thin"
                light = line.at_samples(self.samples, self.solid, self.lights, count)
            else:
                light = (
                    self.samples.through_slices(self.solid, self.smooth, count, points=points) + self.bright
                )
            self.by_slices[count, points] = light
        return self.by_slices[count, points]

    def _place(self) -> None:
        """The solid, its middle, the radius of a sphere round it, and the mean apparent radius [rad]."""
        scene, samples = self.scene, self.samples
        solid = upright(solid_of(scene, self.source, 1 / scene.spacing, 1.0))
        assert solid is not None, "_HiddenWindowPlanner takes a window of which nothing is left"
        self.solid = solid
        if isinstance(self.solid, Ball):
            self.middle, self.radius = np.array(self.solid.center), self.solid.radius
        else:
            corners = np.asarray(self.solid.corners, float)
            self.middle = corners.mean(0)
            self.radius = float(np.linalg.norm(corners - self.middle, axis=1).max())
        away = self.middle[:, None] - np.stack([samples.x, samples.y, samples.own])
        distance = np.maximum(np.sqrt((away**2).sum(0)), 1e-9)
        self.apparent = float(np.arcsin(np.minimum(1, self.radius / distance)).mean())
        self.is_small = isinstance(self.source, sources.Lamp) and self.apparent < NARROW_RADIUS

    def _integrate_sky(self) -> None:
        """Integrals of the brightness, and unless it is thin the window's outline for small bright parts."""
        self.sky = integrals(sources.Sky(self.source.brightness), self.tolerance, True, WINDOWED_PART)
        if self.is_thin:
            return
        there = self.scene.on(self.engine)
        window = solid_of(self.scene, self.source, there.step / self.scene.spacing, there.step)
        assert isinstance(window, Quad), "a window of which something is left is a quadrangle"
        wide, self.scale = widened(window, there)
        assert isinstance(wide, Quad), "widening keeps the kind of solid"
        self.outline = outline(wide, there.step)

    def _unoccluded(self, points: int, brightness: sources.Brightness | None = None) -> np.ndarray:
        """Light at the samples in closed form, its brightness along ``points`` rays."""
        at = self.samples
        return unoccluded.lamp(
            at.gx,
            at.gy,
            at.x,
            at.y,
            at.own.astype(float),
            self.solid,
            self.source.brightness if brightness is None else brightness,
            points,
        ).astype(float)

    def _fits_closed_form(self) -> bool:
        """Whether every node sees all of the source, also over the walls of a dark box."""
        if self.scene.sides == "dark":
            corners = (
                [self.middle - self.radius, self.middle + self.radius]
                if isinstance(self.solid, Ball)
                else self.solid.corners
            )
            low, high = np.min(corners, 0)[:2], np.max(corners, 0)[:2]
            if not ((low >= -0.5).all() and (high <= np.array(self.scene.shape[::-1]) - 0.5).all()):
                return False
        most = most_rays(self.scene) if callable(self.source.brightness) else 0
        for points in (1, *(rays for rays in RAYS if rays <= most)):
            errors = self.samples.errors(self._unoccluded(points), self.exact)
            if self.fits(errors) and self._faces_source():
                self.expected, self.points = errors, points
                return True
        return False

    def _faces_source(self) -> bool:
        """Whether every node's tangent plane lies below all of the source: the samples' first, then all."""
        at, radius = self.samples, self.radius if isinstance(self.solid, Ball) else 0.0
        x, y, z = self.middle[:, None] - np.stack([at.x, at.y, at.own])
        if self.scene.mask is not None or not unoccluded.above_plane(at.gx, at.gy, x, y, z, radius).all():
            return False
        across, down = (np.arange(n, dtype=np.float32) for n in self.scene.shape[::-1])
        points = np.asarray([self.middle] if isinstance(self.solid, Ball) else self.solid.corners, np.float32)

        def face(rows: slice) -> bool:
            gx, gy = unoccluded.gradients(self.scene, rows)
            deep = self.scene.depth[rows] / np.float32(self.scene.spacing)
            return all(
                unoccluded.above_plane(
                    gx, gy, x - across, y - down[rows, None], z + deep, np.float32(radius)
                ).all()
                for x, y, z in points
            )

        return all(by_bands(face, self.scene.shape))

    def make(self) -> LightMethod:
        scene, source = self.scene, self.source
        if self.closed:
            counts = (self.points, self.points // 4) if self.points > 1 else (1,)
            images = (unoccluded.image(scene, self.solid, source.brightness, n) for n in counts)
            return _ClosedForm(scene, *images)
        step = scene.on(self.engine).step
        solid = solid_of(scene, source, step / scene.spacing, step)
        assert solid is not None, "_HiddenWindowPlanner takes a window of which nothing is left"
        sky = None if self.rays else self.sky
        return Sliced(self.engine, scene, source, solid, self.units, self.rays, sky, self.lights)

    def refine(self, is_shared: bool) -> bool:
        if self.closed:
            self.points *= 4
            if self.points > most_rays(self.scene):
                self._take_slices()
        elif isinstance(self.method, Sliced) and 2 * self.method.ray_count > MOST_RAY_EVALUATIONS:
            return False
        else:
            return super().refine(is_shared)
        self.method = self.make()
        return True

    def choices(self) -> Iterator[Choice]:
        closed, source = self.closed, self.source
        yield Choice(
            "occlusion",
            "none" if closed else "by ground",
            "every node looks at all of the source" if closed else "ground may stand before the source",
        )
        off = float(point_error(np.sin(self.apparent), 1.0))
        taken, why = (
            f"{self.units} {'points' if self.is_thin else 'slices'}",
            f"its angular radius is {np.degrees(self.apparent):.2g} degrees on average",
        )
        if self.is_thin:
            why += "; it is a line to every node"
        if closed:
            shape = "a sphere, closed form" if isinstance(self.solid, Ball) else "a polygon, closed form"
            taken = "a point" if off <= POINT_SHARE * self.tolerance else shape
            why += f"; as a point, a disc of that size has an error of {_percent(off)}"
        yield Choice("lamp" if isinstance(source, sources.Lamp) else "window", taken, why)
        rays = self.points if closed else self.rays
        if not callable(source.brightness):
            yield Choice("brightness", "constant", "it is a number")
        elif self.is_thin:
            yield Choice("brightness", f"along {self.units} rays", "one to every point")
        elif rays:
            yield Choice("brightness", f"along {rays} rays", "it varies little across the source")
        else:
            yield Choice("brightness", "along every chord", "integrated")
        if not closed and callable(source.brightness) and self.sky is not None and self.sky.bright_parts:
            why = "seen through the window in azimuths of their own"
            if self.is_thin:
                why = "points of the line within each, besides those along all of it"
            yield Choice("bright parts", f"{len(self.sky.bright_parts)}", why)
        yield Choice("search radius", "up to the source", "what lies behind it hides nothing")


def _looks_thin(planner: _SlicePlanner) -> bool:
    """Whether the source is so thin that a line has its light, and the map on the host and small enough."""
    scene, samples = planner.scene, planner.samples
    walled = isinstance(planner.source, sources.Lamp) and scene.sides == "dark"
    if isinstance(planner.solid, Ball) or walled or scene.resident is not None:
        return False
    away = planner.middle[:, None] - np.stack([samples.x, samples.y, samples.own])
    distance = float(np.median(np.sqrt((away**2).sum(0))))
    few = LINE_COUNTS[2] * math.prod(scene.shape) <= MOST_RAY_EVALUATIONS
    return few and line.line_of(planner.solid).width < LINE_WIDTH * distance


def _judging_sectors(spot: BrightPart, outline: tuple[float, float, float, float], samples: Samples) -> int:
    """By how many sectors a small bright part behind a window of this ``outline`` [spacings] is judged."""
    (_, _, up), sine = spot.cone
    x0, x1, y0, y1 = outline
    across = 2 * sine * float(np.median(np.maximum(0, -samples.own))) / max(up, sine)
    times = math.ceil(across / min(x1 - x0, y1 - y0))
    return int(min(JUDGING_SECTORS * times | 1, MOST_JUDGING_SECTORS))


class _LatticePlanner(_UnitsPlanner):
    """What horizons cannot render: lattice directions, filled."""

    method_class, sample_count = Lattice, 64

    def choose(self) -> None:
        scene, source = self.scene, self.source
        self.why = lacking(scene, source)
        if isinstance(source, sources.Lamp):  # a volume: nothing but the lattice knows it
            known = lattice.HEMICUBE_ERRORS
            self.unknown = (
                f"{self.why}; its error was not measured, on rough ground under a sky it is"
                f" {min(known.values())} to {max(known.values())} of pi"
            )
            fitting = (size for size, error in known.items() if error <= self.tolerance)
            self.units = next(fitting, max(known))
            return
        self.uniform = _uniform_light(self.samples)
        self.choose_units([(0, lattice.HEMICUBE_ERRORS)])

    def judge_by(self, units: int) -> None:
        self.exact = lattice.through_window(self.samples, self.scene, self.source)

    def light_of(self, units: int) -> np.ndarray:
        return lattice.at_samples(self.samples, self.scene, self.source, units)

    def make(self) -> LightMethod:
        return Lattice(self.engine, self.scene, self.source, self.units)

    def refine(self, is_shared: bool) -> bool:
        if self.method.units >= max(lattice.HEMICUBE_ERRORS):
            return False
        self.method.refine()
        return True

    def choices(self) -> Iterator[Choice]:
        yield Choice("occlusion", "by ground", self.why)
        why = self.unknown or "the smallest whose light at the samples is that of many directions"
        yield Choice("directions", f"hemicube {self.units}, filled", why)


def beyond_model(planner: _Planner, between: float | None) -> Iterator[str]:
    """What the scene needs and the model lacks, with numbers."""
    scene, source, samples = planner.scene, planner.source, planner.samples
    if planner.interreflection is False and between is not None and is_needed(between, planner.tolerance):
        yield (
            f"Light between surfaces is left out: it is about {_percent(between)} of the direct light (RMS"
            " over the mean)."
        )
    if isinstance(source, sources.Lamp) and source.center is not None and source.radius is not None:
        x, y, z, radius = (value / scene.spacing for value in (*source.center, source.radius))
        gap = _gap(scene, planner.engine, samples.highest, x, y, z, radius)
        if gap < 1:
            touches = (
                f"reaches {-gap:.2g} spacings into it" if gap < 0 else f"ends {gap:.2g} spacings from it"
            )
            yield f"The lamp touches the surface: it {touches}, and the grid holds nothing finer than 1."
    if samples.cliffs > 0:
        yield (
            f"Slopes are steeper than the grid holds: {_percent(samples.cliffs)} of neighbouring nodes"
            f" lie more than {CLIFF:g} spacings apart in depth."
        )
    if scene.mask is not None and not scene.mask.all():
        yield (
            f"Nodata: {_percent(1 - scene.mask.mean())} of the nodes are masked; they hide nothing, so"
            " light may come through holes."
        )
    if _rounding(samples) > ROUNDED_SHARE * planner.tolerance:
        yield (
            f"float32 rounds depths by {_rounding(samples):.2g} spacings, more than the tolerance allows:"
            " subtract the least depth."
        )


def _gap(scene: Scene, engine: Backend, highest: float, x: float, y: float, z: float, radius: float) -> float:
    """Least distance [spacings] from a ball to the nodes, where it is less than 1."""
    if -z - radius >= highest + 1:
        return math.inf
    rows, cols = scene.shape
    i, j = (round(min(max(at, 0), n - 1)) for at, n in ((x, cols), (y, rows)))
    reach = min(int(radius) + 2, 256)
    v, u = np.mgrid[
        max(0, j - reach) : min(j + reach + 1, rows), max(0, i - reach) : min(i + reach + 1, cols)
    ]
    there = scene.on(engine)
    square = (u - x) ** 2 + (v - y) ** 2 + (there.pick(v * cols + u).astype(float) / there.step - z) ** 2
    return math.sqrt(square.min()) - radius


def _stopwatch(engine: Backend) -> Callable[[], float]:
    """Seconds from here on, without those of compiling."""
    start, compiled = time.perf_counter(), engine.compile_seconds
    return lambda: time.perf_counter() - start - (engine.compile_seconds - compiled)


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %"
