"""Choose a light method, render, estimate the error, and refine until it is within the tolerance.

Exact rays at some hundred samples choose how much is rendered at first (samples.py). An image is the mean of
two halves; half their difference, in short its half difference, estimates its error over all nodes
(light/base.py). The samples audit the image for error that is common to both halves. The Plan records every
choice. No decision reads a clock.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

from . import sources
from .backends import select
from .backends.base import Backend, stopwatch
from .checks import positive_number
from .interreflection import check_choice
from .light.base import Estimate, Later, LightMethod
from .light.finite import solid_of
from .light.lattice import lacking
from .planning.base import Planner
from .planning.finite import HiddenWindowPlanner, LinePlanner, SlicePlanner, looks_thin
from .planning.lattice import LatticePlanner
from .planning.plan import Choice, Plan, Step, larger, percent
from .planning.sky import SkyPlanner
from .samples import ESTIMATE_SHARE
from .scene import Scene, check_scene

# default bound on the 99.9th percentile of the error, in tolerances; chosen: over the images of
# docs/refinement.csv that percentile is 3.9, 7.1 and 13 times the RMS error (5th, median and 95th percentile)
DEFAULT_TAIL = 10.0
# error ratios: an image's error over its half difference. ASSUMED_ERROR_RATIO is taken where the samples
# cannot measure the ratio: the median of 60 lamps and windows (96 x 96). MOST_ERROR_RATIO bounds it: error
# above it is common to both halves, and more azimuths do not reduce that. With half of ASSUMED_ERROR_RATIO,
# one of 57 images of 19 lamps and panels has an error of 1.6 tolerances without a warning; with twice, 52 %
# of the estimates are within 0.5 to 3 times the truth instead of 79 %. With half and twice of
# MOST_ERROR_RATIO, 91 % of 45 lamps, panels and windows (64 x 64) are within 1 %, as with it
ASSUMED_ERROR_RATIO, MOST_ERROR_RATIO = 0.5, 1.3
# largest ratio of the mean square of the half difference over all nodes to the one at the samples that is
# taken for sampling noise; what is above it belongs to a few nodes that the samples miss. Chosen: the samples
# measure a mean square to some 10 %, and a few missed nodes make it 4 to 10^6 times as large. With twice the
# ratio, of 57 images of 19 lamps and panels as many are within the tolerance, and as many estimates are right
SEEN = 2.0
# times the samples' mean light: an image's mean above it is what errors are relative to. Chosen: samples know
# the mean to some 10 % where nodes are lit alike, and may have next to none of a beam's. With 2 the beam of a
# sun through a slit, a third of whose light the samples know, errs 2.6 tolerances in place of 0.9; with 100
# the images of seven spotlights stay the same
UNSEEN_LIGHT = 10.0
MOST_TAIL_SHARE = 1e-3  # share of nodes whose error may be above the tail, which bounds a 99.9th percentile
# relative RMS error by float32's rounding of closed forms and sums, which is common to both halves:
# measured 1e-5 under panels over planes (performance/refinement.py)
ROUNDING_ERROR = 1e-5


class Refined(NamedTuple):
    """A refined irradiance (rows, cols) float32 and its error.

    half_difference: of its two halves, or None; error_ratio: its error over that; common_error: error that is
    common to both halves [brightness x sr]; the plan, and warnings.
    """

    irradiance: Any  # np.ndarray, or a DeviceImage where it stays on the device
    half_difference: Later | None
    error_ratio: float
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

    Examples
    --------
    >>> y, x = np.mgrid[:64, :64]
    >>> plan = sl.plan(sl.Scene.from_height(3 * np.sin(x / 5) * np.sin(y / 7)), sl.Sky(), tolerance=0.003)
    >>> plan.method, plan.azimuths >= 8
    ('horizon', True)
    """
    check_scene(scene)
    check_choice(interreflection)
    engine = select(backend)
    if isinstance(source, sources.Sky):
        scene = scene.under_sky()
    if isinstance(source, sources.Source):
        source, _ = sources.in_range(sources.on_axes(source, scene.axes))
        source = sources.channels(source)[0]  # a render begins with its first colour
        if not callable(source.brightness):  # which stands for all if they differ by a factor
            source = replace(source, brightness=1.0)
    with engine.lock:
        seconds = stopwatch(engine)
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
    seconds = stopwatch(engine)
    planner = choose(scene, source, tolerance, engine, tail, interreflection)
    planning = seconds()
    method, steps = planner.begin(), []
    begun = method.amount
    while True:
        assessment = assess(planner, method)
        steps.append(Step(method.units, assessment.estimated, assessment.audit))
        if assessment.is_enough(tolerance) or not planner.refine(assessment.is_mostly_common):
            break
        method = planner.method
    made = replace(_record(planner, method, begun, steps), seconds=seconds(), planning_seconds=planning)
    mean = planner.mean if math.isfinite(planner.mean) else 0.0
    common = math.hypot(assessment.common_error, ROUNDING_ERROR)
    light = method.device_image() if stays else None
    return Refined(
        method.irradiance() if light is None else light,
        method.half_difference(),
        assessment.error_ratio,
        common * mean if math.isfinite(common) and not planner.unknown else math.inf,
        made,
        [
            *assessment.warnings(tolerance, planner.tail),
            *([f"Tolerance: the error is not known, {planner.unknown}."] if planner.unknown else []),
        ],
    )


def _record(planner: Planner, method: LightMethod, begun: str, steps: list[Step]) -> Plan:
    """The plan as it was carried out: the units of the last image, its error, and how it was refined.

    ``begun``: the amount of the first image, in words.
    """
    last = steps[-1]
    made = planner.plan(method.at(planner.samples) if planner.exact is None else None)
    reason, choices = made.reason, made.choices
    if len(steps) > 1:
        why = f"{begun} at first: the estimated error was {percent(last.error or 0)} in the end"
        times = "once" if len(steps) == 2 else f"{len(steps) - 1} times"
        reason = f"refined {times}, relative RMS error {last.error or 0:.2g} estimated"
        choices = (*choices, Choice("refined to", method.amount, why))
    return replace(
        made,
        reason=reason,
        choices=choices,
        hemicube=last.units if made.method == "lattice" else None,
        azimuths=last.units if made.method == "horizon" else None,
        error=made.error if last.error is None else last.error,
        measured=last.audit,
        steps=tuple(steps),
    )


class Assessment(NamedTuple):
    """What is known of the relative RMS error of an image.

    estimate: of the image's half difference, None where it has none; error_ratio: the error over that; audit:
    the error at the samples, None where their exact light is not known; common_error: the part of the error
    that is common to both halves.
    """

    estimate: Estimate | None
    error_ratio: float
    audit: float | None
    common_error: float

    @property
    def estimated(self) -> float | None:
        """The error over all nodes: what differs between the halves, and what is common to them."""
        if self.estimate is None:
            return None
        return math.hypot(self.error_ratio * self.estimate.rms, self.common_error)

    @property
    def error(self) -> float | None:
        """The larger of the estimate and the audit, None where neither is known; the tolerance bounds it."""
        return larger(self.estimated, self.audit)

    @property
    def is_mostly_common(self) -> bool:
        """Whether more than half of the error at the samples is common to both halves."""
        return self.audit is not None and self.common_error > 0.5 * self.audit

    def is_enough(self, tolerance: float) -> bool:
        """Whether to stop refining: the error is unknown, or within ESTIMATE_SHARE of the tolerance with few
        nodes beyond the tail. Above that share an image is refined; above the tolerance it has a warning.
        """
        few_beyond = self.estimate is None or self.estimate.tail_share <= MOST_TAIL_SHARE
        return self.error is None or (self.error <= ESTIMATE_SHARE * tolerance and few_beyond)

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


def assess(planner: Planner, method: LightMethod) -> Assessment:
    """The error of an image, by its half difference and by the samples.

    The samples give the error ratio, that of the error to the half difference. The error of the exact light
    itself, up to ASSUMED_ERROR_RATIO times the half difference, is a lower bound of the image's. Error above
    MOST_ERROR_RATIO times the half difference is common to both halves. Where the half difference is far
    larger over all nodes than at the samples, the excess belongs to few nodes that the samples miss; its
    ratio is ASSUMED_ERROR_RATIO. Where the samples lie beside most of the light, ``samples.least`` becomes
    the image's own mean.
    """
    samples, exact = planner.samples, planner.exact
    audit = planner.audit(method)
    half_difference = None if exact is None else method.half_difference_at(samples)
    if exact is None or half_difference is None or audit is None or math.isinf(audit):
        # no exact light, no second image, or light where exact rays find none: the audit is all that is known
        return Assessment(None, 0.0, audit, audit or 0.0)
    sampled = samples.errors(exact + half_difference, exact).rms  # relative RMS of the half difference there
    error = max(audit, min(planner.exact_error, ASSUMED_ERROR_RATIO * sampled))
    ratio = min(error / sampled, MOST_ERROR_RATIO) if sampled > 0 else ASSUMED_ERROR_RATIO
    estimate = method.estimate(planner.tail * planner.mean / max(ratio, ASSUMED_ERROR_RATIO))
    assert estimate is not None, "a method with a half difference has an estimate"
    mean, lit = estimate.mean, int((exact > 0).sum())
    if lit:
        # over the nodes that exact rays light: an image is 0 at nodes whose light is next to nothing
        mean *= max(1, int((method.at(samples) > 0).sum())) / lit
    if mean > UNSEEN_LIGHT * planner.mean:  # the samples lie beside the light
        samples.least = mean
        return assess(planner, method)
    estimate = estimate._replace(rms=estimate.rms * estimate.mean / max(mean, samples.least))
    # share of the mean square over all nodes that the samples see
    seen = min(1.0, SEEN * (sampled / estimate.rms) ** 2) if estimate.rms > 0 else 1.0
    common = math.sqrt(max(0.0, error**2 - (ratio * sampled) ** 2))
    ratio = math.sqrt(seen * ratio**2 + (1 - seen) * ASSUMED_ERROR_RATIO**2)
    return Assessment(estimate, ratio, audit, math.hypot(common, planner.tables_error))


def choose(
    scene: Scene,
    source: sources.Source,
    tolerance: float,
    engine: Backend,
    tail: float | None = None,
    interreflection: bool | str = "auto",
) -> Planner:
    """The planner for this kind of source, with the method and units that an image begins with."""
    tolerance = positive_number(tolerance, "tolerance")
    tail = DEFAULT_TAIL * tolerance if tail is None else positive_number(tail, "tail")
    sources.check_source(source)
    if scene.sides == "periodic" or not (isinstance(source, sources.Lamp) and source.corner is not None):
        sources.geometry(source, scene, 1.0)  # checks that they fit
    planner_class: type[Planner] = SlicePlanner
    if lacking(scene, source):
        planner_class = LatticePlanner
    elif isinstance(source, sources.Sky):
        planner_class = SkyPlanner
    elif solid_of(scene, source) is None:
        planner_class = HiddenWindowPlanner
    elif looks_thin(scene, source, engine):
        planner_class = LinePlanner
    planner = planner_class(scene, source, tolerance, tail, engine)
    planner.interreflection = interreflection
    planner.choose()
    return planner
