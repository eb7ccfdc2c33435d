"""One loop: choose a method, render, estimate the error, refine until it is within the tolerance. The record
of it is the Plan.

Light at some hundred samples by exact rays chooses how much is rendered (samples.py); half the difference of
two halves of it estimates the error over all nodes (light/base.py); the samples audit the image, for what
both halves share. Nothing here reads a clock to decide.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from . import sources
from .backends import select
from .backends.base import Backend
from .checks import positive_number
from .errors import CapacityError, bad
from .light import lattice, unoccluded
from .light.base import LightMethod
from .light.finite import RAYS, Sliced
from .light.horizon import OFFSET, Horizons
from .light.lattice import Lattice, lacking
from .light.slices import outline, widened
from .light.sweeps import FAINTEST
from .radiometry import point_error
from .reflectance import Lambertian
from .samples import CLIFF, COUNT, FAINT, Errors, Samples
from .scene import Scene, is_scene
from .sources.integrals import Integrals, even
from .sources.solids import Ball, Quad, aperture, rectangle

TAIL = 10.0  # bound on the 99.9th percentile of the error, in tolerances, unless given
# share of the tolerance that an estimate may take; chosen: samples know an RMS to some 10 %, and with 0.95
# one image in twelve at 0.3 % was 1 to 1.4 tolerances off
MARGIN = 0.85
EVEN = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024)  # azimuths
GRIDS = {
    36: 6,
    72: 12,
    144: 24,
    288: 48,
}  # azimuths of the exact light, each grid within the next, and how many azimuths it can judge: a sixth
LANES, FINER = (
    8,
    (
        1,
        3,
        9,
    ),
    # sectors of azimuth that small bright parts have together at least, as many as a CPU takes at a time; times
    # as many are tried
)
SUN = 0.25  # error over the difference of two halves of sectors: about LEAST of half of it, as for azimuths
SLICES, JUDGES = (
    (
        8,
        16,
        32,
        64,
        128,
        256,
    ),
    4,
)  # slices of a source that stands all round; times as many judge them
MOST = {Horizons: 1024, Sliced: 1024, Lattice: 33}  # units up to which is refined
ORDER = 1.2  # of convergence in the number of azimuths, on rough ground: performance/horizon.py
FIRST, LEAST = (
    0.9,
    0.45,
    # error over half the difference of two halves, if nothing else is known, and at least: measured,
    # docs/model.md
)
LOW = 0.3  # the least share that the samples may tell; chosen
BALL = 0.5  # the same of the alternating sum of a ball's slices: at most 0.61 on 114 pairs
BEHIND = {
    None: 0.028,
    24: 0.0085,
    # RMS error of sweeps behind cliffs, over the root of their share of the neighbours, with 6 near rows and with
    # 24: measured
}
# tolerance below which shadows of suns take 24 near rows: with 6 they cost 0.1 to 0.9 %, with 24 0.01 to 0.35
# % (fractals, terrain)
SHARP = 0.01
UNIFORM = 0.1  # tolerances by which a brightness may vary that is taken as a number
REACHES = (0.8, 0.4, 0.2, 0.1, 0.05, 0.025)  # slopes over which a map that repeats is searched
SHORT = 0.3  # tolerances that a shorter search may cost
WINDOWED = 2.5  # times as many steps as a sweep without a search radius
MOST_STEPS = 2**40  # nodes x azimuths of a call: some three hours on two cores, ten seconds on an H200
SMALL = math.radians(
    5
    # azimuth that a small bright part behind a window may span: slices, which stand within the window, resolve
    # what is wider
)
PATCHES = 16  # of one where nodes are looked for that it lights through a window; chosen
# sectors of a small bright part behind a window, to judge by: its edges cut the part wherever they like. No
# multiple of what is judged, so that their errors differ
BEHIND_WINDOW = 1021
# apparent radius [rad] of a lamp, six cells of a table of brightness, up to which rays tell its brightness
NARROW = 0.02
MOST_LOOKS = 2**25  # evaluations of a brightness for the sake of rays, some ten seconds
POINT = 0.1  # share of the tolerance by which a lamp that is called a point may be off as one
# times the estimate from which on an audit tells of what both halves share: more near rows are tried before
# more azimuths
DISAGREE = 1.3


@dataclass(frozen=True)
class Choice:
    """One line of a plan: what was to be chosen, what was taken, and why."""

    what: str
    taken: str
    why: str


class Step(NamedTuple):
    """An image on the way: azimuths, slices or the hemicube's size; estimate of its relative RMS error over
    all nodes, and what the samples' audit found.
    """

    units: int
    estimate: float | None
    audit: float | None


@dataclass(frozen=True)
class Plan:
    """The model that was or will be used, and why.

    method: "unoccluded", "horizon" or "lattice". hemicube, filled: of the lattice, else None. azimuths: of
    horizons, or slices of a lamp or window. max_distance [unit of spacing] of the search, None: the whole
    map. tolerance, tail: what was asked for, relative RMS error and 99.9th percentile; error, error_tail:
    what they are expected to be, by the samples before an image is made, and by the two halves of it
    afterwards; measured: the RMS error of the image at the samples, once rendered. choices, line by line;
    steps: every image that was made; beyond: what the scene needs and the model lacks, with numbers. seconds
    of the whole call and planning_seconds until the first image was begun were measured; no decision depends
    on them. Fields that do not apply are None or empty.
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

    @property
    def line(self) -> str:
        """The plan in one line."""
        if self.method == "lattice":
            return (
                f"lattice, hemicube {self.hemicube}, {'filled' if self.filled else 'stride'}: {self.reason}"
            )
        return f"{self.method}{'' if self.azimuths is None else f', {self.azimuths} azimuths'}: {self.reason}"

    def __str__(self) -> str:
        if not self.choices:
            return self.line
        widths = [max(len(getattr(c, name)) for c in self.choices) for name in ("what", "taken")]
        lines = [f"{c.what:{widths[0]}}  {c.taken:{widths[1]}}  {c.why}".rstrip() for c in self.choices]
        return "\n".join([*lines, *(f"beyond the model: {text}" for text in self.beyond)])


class Refined(NamedTuple):
    """An irradiance (rows, cols) float32, half the difference of its two halves or None, their share that is
    the error, what all halves share of error [brightness x sr], the plan and warnings.
    """

    irradiance: np.ndarray
    half: np.ndarray | None
    share: float
    floor: float
    plan: Plan
    warnings: list[str]


def plan(
    scene: Scene,
    source: sources.Source,
    tolerance: float = 0.01,
    backend: str = "auto",
    *,
    tail: float | None = None,
) -> Plan:
    """How :func:`skylamp.render` will begin on ``scene`` under ``source`` to be within ``tolerance``, with
    reasons; print it.

    What it says of the error is what the samples expect; a render refines on where its image proves to be
    worse. The light left out between surfaces is no part of the error; ``Plan.beyond`` bounds it.

    Parameters
    ----------
    tolerance : float
        RMS error over all valid nodes, divided by the mean of the exact irradiance over its lit nodes.
    tail : float, optional
        Bound on the 99.9th percentile of the absolute error, over the same mean; ten tolerances unless given.
    backend : str
        See :func:`skylamp.backends`.

    Raises
    ------
    InputError, BackendError, CapacityError
    """
    is_scene(scene)
    engine = select(backend)
    with engine.lock:
        start, compiled = time.perf_counter(), engine.compile_seconds
        chosen = choose(scene, source, tolerance, engine, tail)
        seconds = time.perf_counter() - start - (engine.compile_seconds - compiled)
        return replace(chosen.plan(), planning_seconds=seconds)


def refined(
    scene: Scene, source: sources.Source, tolerance: float, engine: Backend, tail: float | None = None
) -> Refined:
    """The irradiance of a grey source within the tolerance, or as near as can be and a warning."""
    start, compiled = time.perf_counter(), engine.compile_seconds
    now = lambda: time.perf_counter() - start - (engine.compile_seconds - compiled)
    chosen = choose(scene, source, tolerance, engine, tail)
    planned, method, steps, before = now(), chosen.begin(), [], None
    while True:
        image = method.irradiance()
        audit = chosen.audit(image, method.units)
        share = chosen.share if before is None else LEAST
        found = method.estimate(chosen.tail * chosen.mean / share)
        if (
            before is not None and found
            # errors of sets that share no ray: that of their mean follows from how fast their differences fall
        ):
            share = max(LEAST, 1 / math.sqrt(max((before / max(found.rms, 1e-30)) ** 2 - 1, FIRST**-2)))
        expected = math.hypot(share * found.rms, chosen.floor) if found else audit
        off = expected if audit is None or audit <= DISAGREE * expected else audit
        steps.append(Step(method.units, expected if found else None, audit))
        within = (
            off is None
            or max(off, audit or 0.0) <= MARGIN * tolerance
            and (found is None or found.beyond <= 1e-3)
        )
        if within or not chosen.refine(method, alike=audit is not None and (found is None or off == audit)):
            break
        before, method = found.rms if found and method is chosen.method else None, chosen.method
    made, warnings = chosen.plan(), []
    worst = max(off or 0.0, audit or 0.0)
    if worst > tolerance:
        warnings.append(
            f"Tolerance: the image is estimated to be {100 * worst:.2g} % off (RMS over the mean), more than"
            f" the {100 * tolerance:.2g} % asked for."
        )
    shared = (
        max(chosen.floor, math.sqrt(max(0.0, off**2 - (share * found.rms) ** 2))) if found else off or 0.0
    )
    units = {
        "hemicube" if made.method == "lattice" else "azimuths": (
            None if made.method == "unoccluded" else method.units
        )
    }
    made = replace(
        made,
        **units,
        error=made.error if off is None else off,
        measured=audit,
        steps=tuple(steps),
        seconds=now(),
        planning_seconds=planned,
    )
    return Refined(
        image,
        method.half(),
        share,
        shared * (chosen.mean if math.isfinite(chosen.mean) else 0.0),
        made,
        warnings,
    )


def choose(
    scene: Scene, source: sources.Source, tolerance: float, engine: Backend, tail: float | None = None
) -> _Chosen:
    """What to begin with."""
    tolerance = positive_number(tolerance, "tolerance")
    tail = TAIL * tolerance if tail is None else positive_number(tail, "tail")
    if not isinstance(source, sources.Source):
        raise bad("source", type(source).__name__, "Sky, Lamp or Window")
    if getattr(source, "corner", None) is None or scene.sides == "periodic":
        sources.geometry(source, scene, 1.0)  # checks that they fit
    kind = _Lattice if lacking(scene, source) else _Sky if isinstance(source, sources.Sky) else _Slices
    chosen = kind(scene, source, tolerance, tail, engine)
    chosen.choose()
    return chosen


def solid_of(scene: Scene, source: sources.Source, unit: float, step: float) -> Ball | Quad | None:
    """The shape of a lamp or window, lengths times ``unit`` so that the spacing is ``step``; None for a
    window outside a dark box.
    """
    if isinstance(source, sources.Window):
        return aperture(np.array(source.x) * unit, np.array(source.y) * unit, scene.shape, step, scene.sides)
    if source.corner is not None:
        return rectangle(*(np.array(v) * unit for v in (source.corner, *source.edges)))
    return Ball(tuple(np.array(source.center) * unit), source.radius * unit)


def upright(solid: Ball | Quad | None) -> Ball | Quad | None:
    """The same with heights for depths."""
    if solid is None or isinstance(solid, Quad):
        return solid and Quad(np.asarray(solid.corners, float) * (1, 1, -1))
    return Ball((*solid.center[:2], -solid.center[2]), solid.radius)


class _ClosedForm(LightMethod):
    """An image that nothing need refine."""

    units = 0

    def __init__(self, image):
        self.image = image

    def refine(self):
        """There is nothing finer."""

    def irradiance(self):
        return self.image


class _Chosen:
    """What is chosen for a kind of source, and why."""

    kind: type = _ClosedForm
    units = 0
    errors = Errors(math.nan, math.nan, math.nan)
    exact: np.ndarray | None = None  # light at the samples
    uniform: np.ndarray | None = None  # of a uniform sky of brightness 1
    share, floor, max_distance = FIRST, 0.0, None
    method: LightMethod
    unknown = ""

    def __init__(self, scene, source, tolerance, tail, engine):
        self.scene, self.source, self.tolerance, self.tail, self.engine = (
            scene,
            source,
            tolerance,
            tail,
            engine,
        )
        self.samples = Samples(engine, scene, self.count)
        if scene.sides == "periodic" and self.samples.relief / FAINT * len(self.samples) > MOST_STEPS / 512:
            raise CapacityError(
                f"A relief of {self.samples.relief:.3g} spacings on a map that repeats must be followed over"
                f" {self.samples.relief / FAINT:.2g} nodes; give depth and spacing in one unit."
            )

    count = COUNT

    def fits(self, found: Errors, besides: float = 0.0) -> bool:
        return math.hypot(found.bound, besides) <= MARGIN * self.tolerance and found.tail <= self.tail

    @property
    def mean(self) -> float:
        """Exact light over the lit samples."""
        lit = None if self.exact is None else self.exact[self.exact > 0]
        return float(lit.mean()) if lit is not None and lit.size else math.inf

    def begin(self) -> LightMethod:
        self.method = self.make()
        return self.method

    def audit(self, image, units) -> float | None:
        """The image's relative RMS error at the samples."""
        return None if self.exact is None else self.samples.errors(self.samples.of(image), self.exact).rms

    def refine(self, method, alike: bool) -> bool:
        """Whether the method could be refined. ``alike``: its halves agree and yet are off."""
        if self.kind not in MOST or 2 * method.units > MOST[self.kind]:
            return False
        method.refine()
        return True

    def plan(self) -> Plan:
        latticed, closed = self.kind is Lattice, self.kind is _ClosedForm
        known = lambda value: float(value) if math.isfinite(value) else None
        rms = math.hypot(self.errors.rms, self.floor)
        verdict = (
            "within tolerance"
            if math.hypot(self.errors.bound, self.floor) <= MARGIN * self.tolerance
            else "the best there is for tolerance"
        )
        reason = (
            f"relative RMS error {rms:.2g} expected, {verdict} {self.tolerance:g}"
            if known(rms) is not None
            else self.unknown
        )
        return Plan(
            "lattice" if latticed else "unoccluded" if closed else "horizon",
            self.units if latticed else None,
            True if latticed else None,
            reason,
            None if latticed or closed else self.units,
            self.max_distance,
            self.tolerance,
            self.tail,
            known(rms),
            known(self.errors.tail),
            choices=(*self.choices(), *self._common()),
            beyond=tuple(self._beyond()),
        )

    def _common(self) -> Iterator[Choice]:
        if self.kind is not _ClosedForm:
            yield Choice(
                "method",
                "lattice" if self.kind is Lattice else "horizons",
                lacking(self.scene, self.source)
                or "sweeps and slices serve every sky, sphere, rectangle and window",
            )
        kind = self.scene.reflectance
        lobe = (
            ("none", "the surface is Lambertian")
            if isinstance(kind, Lambertian)
            else (type(kind).__name__, "summed beside the irradiance, to which the error given here belongs")
        )
        yield Choice("specular lobe", *lobe)
        yield Choice("precision", "float32", f"depths are rounded by {self._rounding:.1g} spacings")
        if math.isfinite(self.errors.rms):
            yield Choice(
                "error",
                _percent(math.hypot(self.errors.rms, self.floor)),
                f"RMS over the mean, expected from {len(self.samples)} samples; at most"
                f" {_percent(math.hypot(self.errors.bound, self.floor))} over all nodes, asked for"
                f" {_percent(self.tolerance)}",
            )
            yield Choice("99.9th percentile", _percent(self.errors.tail), f"asked for {_percent(self.tail)}")
        else:
            yield Choice("error", "not known", self.unknown)

    @property
    def _rounding(self):
        return abs(float(self.samples.own.min())) * 2.0**-24  # heights are none above 0

    def _beyond(self) -> Iterator[str]:
        """What the scene needs and the model lacks, with numbers."""
        scene, source, samples = self.scene, self.source, self.samples
        if self.exact is not None and self.exact.any() and self.uniform is not None:
            yield from between_surfaces(scene, self.uniform, self.exact, self.tolerance)
        if isinstance(source, sources.Lamp) and source.center is not None:
            gap = _gap(scene, samples.highest, *(v / scene.spacing for v in (*source.center, source.radius)))
            if gap < 1:
                yield (
                    "The lamp touches the surface:"
                    f" {'it reaches %.2g spacings into it' % -gap if gap < 0 else f'it ends {gap:.2g} spacings from it'},"
                    " and the grid holds nothing finer than 1."
                )
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
        if self._rounding > 0.1 * self.tolerance:
            yield (
                f"Depths are rounded by {self._rounding:.2g} spacings, more than the tolerance allows: take"
                " the least depth off."
            )

    def _seen_of_sky(self):
        azimuths = 2 * np.pi * (np.arange(12) + 0.5) / 12
        return self.samples.ring(azimuths, self.samples.horizons(azimuths)).mean(0) * 2 * np.pi


class _Sky(_Chosen):
    """Skies: closed forms where ground hides next to nothing, else horizons in even azimuths."""

    near: int | None = None
    sectors = number = 0
    slopes: np.ndarray | None = None
    rays = False

    def choose(self):
        samples, brightness = self.samples, self.source.brightness
        self.light = float(brightness) if not callable(brightness) else Integrals(self.source, self.tolerance)
        self.varies = isinstance(self.light, Integrals)
        if self.varies and not self.light.suns and self.light.variation <= UNIFORM * self.tolerance:
            self.light, self.varies = float(self.light.mean), False
        suns = self.light.suns if self.varies else ()
        rest = self.light.rest / max(self.light.level, 1e-30) if self.varies else 1.0
        cliffs = math.sqrt(samples.cliffs) * rest
        self.rays = (
            bool(suns)
            and samples.cliffs > 0
            and self.scene.sides != "periodic"
            and self.scene.resident is None
        )
        self.near = (
            24
            if BEHIND[None] * cliffs > 0.5 * self.tolerance
            or suns
            and not self.rays
            and self.tolerance < SHARP
            else None
        )
        floor = BEHIND[self.near] * cliffs
        planes = even(unoccluded.AZIMUTHS, 0.5)
        self.free = (
            self._above_planes(planes.angles, planes.widths, planes.widths)
            if self.varies
            else np.pi / 2 * self.light * (1 + 1 / samples.length)
        )
        self.bright = self._bright(suns)
        self._look(min(GRIDS))
        if self._closed(suns):
            return
        self.bright = self._bright(suns, floor)
        measured = {}
        for number, most in GRIDS.items():
            self._look(number)
            measured = {
                count: self._measured(count) for count in EVEN if count <= most and number % (3 * count) == 0
            }
            fitting = [count for count, (found, _) in measured.items() if self.fits(found, floor)]
            if fitting:
                break
        count = min(fitting, default=max(measured))
        self.errors, share = measured[count]
        if not fitting:
            last, judged = self.errors, count
            for count in (count for count in EVEN if count > judged):
                self.errors = Errors(*(value * (judged / count) ** ORDER for value in last))
                if self.fits(self.errors, floor):
                    break
        self.hidden = samples.errors(self.uniform, np.pi / 2 * (1 + 1 / samples.length)).rms
        self.kind, self.units, self.floor, self.share = Horizons, count, floor, min(max(share, LOW), 1.5)
        self._search()
        warm = (
            0
            if self.scene.sides != "periodic"
            else min(
                samples.relief / FAINTEST,
                math.inf if self.max_distance is None else self.max_distance / self.scene.spacing,
            )
        )
        steps = count * math.prod(self.scene.shape) * (1 + warm / min(self.scene.shape))
        if steps > MOST_STEPS:
            raise CapacityError(
                f"A tolerance of {self.tolerance:g} takes some {steps:.2g} nodes x azimuths here; at most"
                f" {MOST_STEPS:,}. Take a larger tolerance or a smaller map."
            )

    def _look(self, number):
        """Exact light at the samples in so many azimuths, twice as many as before or as often; ``doubt``:
        what it is off itself.
        """
        samples = self.samples
        while self.number < number:
            self.number = 2 * self.number or min(GRIDS)
            angles = 2 * np.pi * np.arange(self.number) / self.number
            new = samples.horizons(angles if self.slopes is None else angles[1::2])
            self.slopes = (
                new if self.slopes is None else np.stack([self.slopes, new], 1).reshape(self.number, -1)
            )
        width = 2 * np.pi / self.number
        angles = self.angles = width * np.arange(self.number)
        self.uniform = samples.ring(angles, self.slopes).sum(0) * width
        halves = [
            self._corrected(
                angles[odd::2],
                self.slopes[odd::2],
                np.full(self.number // 2, 2 * width),
                np.full(self.number // 2, width),
            )
            for odd in (0, 1)
        ]
        self.rest = (halves[0] + halves[1]) / 2
        self.exact = self.rest + self.bright
        self.doubt = LEAST * samples.errors(self.exact + (halves[1] - halves[0]) / 2, self.exact).rms

    def _measured(self, count) -> tuple[Errors, float]:
        """Errors at the samples of so many azimuths, and over half the difference of their halves."""
        at = [(self.number * (3 * np.arange(odd, count, 2) + 1)) // (3 * count) for odd in (0, 1)]
        first, second = (
            self._corrected(
                self.angles[n],
                self.slopes[n],
                np.full(count // 2, 4 * np.pi / count),
                np.full(count // 2, 2 * np.pi / count),
            )
            for n in at
        )
        found = self.samples.errors((first + second) / 2 + self.bright, self.exact)
        half = self.samples.errors((second - first) / 2 + self.exact, self.exact).rms
        return found, found.rms / half if half > 0 else FIRST

    def _above_planes(self, angles, widths, windows):
        """Light at the samples above tangent planes and the level alone, suns apart."""
        planes = np.maximum(0, self.samples.plane(np.cos(angles)[:, None], np.sin(angles)[:, None]))
        return widths @ self.samples.ring(angles, planes, self.light.table(angles, windows))

    def _corrected(self, angles, slopes, widths, windows):
        """Light above ``slopes`` with what tangent planes alone would let through put right; see Horizons."""
        if not self.varies:
            return self.light * (widths @ self.samples.ring(angles, slopes))
        return (
            widths @ self.samples.ring(angles, slopes, self.light.table(angles, windows))
            + self.free
            - self._above_planes(angles, widths, windows)
        )

    def _bright(self, suns, floor=None):
        """Light of the small bright parts at the samples, in the fewest sectors whose two halves agree;
        without ``floor``, the error besides, in the fewest that are tried.
        """
        if not suns:
            return 0.0
        for self.sectors in (times * max(1, -(-LANES // len(suns))) for times in FINER):
            halves = [
                sum(self.samples.sectors(*sun.sectors(self.sectors, odd)) for sun in suns)
                for odd in (False, True)
            ]
            light = (halves[0] + halves[1]) / 2
            if floor is None:
                break
            found = self.samples.errors(self.rest + light + SUN * (halves[1] - halves[0]), self.rest + light)
            if math.hypot(found.bound, floor) <= 0.7 * self.tolerance and found.tail <= 0.7 * self.tail:
                break
        return light

    def _closed(self, suns) -> bool:
        """Whether closed forms do: over all samples, also where ground is rare; of a small bright part no
        node may miss any, which normals tell of all nodes.
        """
        samples = self.samples
        light = self.free + sum(
            np.maximum(0, samples.gx * x + samples.gy * y + z) / samples.length
            for x, y, z in (sun.moment for sun in suns)
        )
        found = samples.errors(light, self.exact)
        if not self.fits(found) or (
            samples.rare.any()
            and samples.errors(np.where(samples.rare, light, self.exact), self.exact).rms
            / math.sqrt(samples.weights[samples.rare].sum())
            > self.tail
        ):
            return False
        if suns and (
            self.scene.sides == "dark" or self.scene.resident is not None or not self._all_look(suns)
        ):
            return False
        self.errors, self.kind, self.hidden = found, _ClosedForm, found.rms
        return True

    def _all_look(self, suns) -> bool:
        at = self.samples
        if not all(
            unoccluded.looks_at_all(at.gx, at.gy, *middle, sine).all()
            for middle, sine in (sun.cone for sun in suns)
        ):
            return False
        gx, gy = unoccluded.gradients(self.scene)
        return all(
            unoccluded.looks_at_all(gx, gy, *middle.astype(np.float32), np.float32(sine)).all()
            for middle, sine in (sun.cone for sun in suns)
        )

    def _search(self):
        """On a map that repeats: how far must be looked."""
        self.why_far = "a sweep costs the same however far it looks"
        if self.scene.sides != "periodic":
            return
        samples, side = self.samples, math.sqrt(math.prod(self.scene.shape))
        whole = 1 + max(*self.scene.shape, samples.relief / FAINTEST) / side
        angles = 2 * np.pi * (np.arange(24) + OFFSET) / 24
        full = samples.ring(angles, samples.horizons(angles)).sum(0)
        self.why_far = f"on a map that repeats, as far as its relief makes a slope of {FAINTEST}"
        for slope in REACHES:
            reach = max(2.0, math.ceil(samples.relief / slope))
            if WINDOWED * (1 + reach / side) > 0.8 * whole:
                return
            cut = samples.errors(samples.ring(angles, samples.horizons(angles, reach)).sum(0), full)
            if cut.bound <= SHORT * self.tolerance and cut.tail <= 0.5 * self.tail:
                self.max_distance, self.floor = reach * self.scene.spacing, math.hypot(self.floor, cut.rms)
                self.why_far = f"what lies farther away costs {_percent(cut.rms)}"
                return

    def make(self):
        if self.kind is not _ClosedForm:
            return Horizons(
                self.engine,
                self.scene,
                self.light,
                self.units,
                self.sectors,
                self.near,
                self.max_distance,
                self.rays,
            )
        if (
            self.scene.resident is not None
            and self.scene.resident.backend is self.engine
            and not (self.varies and self.light.suns)
        ):
            return Horizons(self.engine, self.scene, self.light, 0)
        return _ClosedForm(unoccluded.sky(self.scene, self.light).astype(np.float32, copy=False))

    def audit(self, image, units):
        if 3 * units > self.number:
            self._look(max(GRIDS))
        found = super().audit(image, units)
        return found if 3 * units <= self.number else math.sqrt(max(0.0, found**2 - self.doubt**2))

    def refine(self, method, alike):
        if self.kind is Horizons and alike and self.near is None:
            self.near = 24
            self.method = Horizons(
                self.engine,
                self.scene,
                self.light,
                method.units,
                self.sectors,
                self.near,
                self.max_distance,
                self.rays,
            )
            self.floor *= BEHIND[24] / BEHIND[None]
            return True
        return super().refine(method, alike)

    def choices(self):
        closed = self.kind is _ClosedForm
        yield Choice(
            "occlusion",
            "none" if closed else "by ground",
            f"ground takes {_percent(self.hidden)} of the light (RMS)",
        )
        yield Choice(
            "brightness",
            "a table per azimuth" if self.varies else "constant",
            (
                f"integrated to {_percent(self.light.error)}"
                if self.varies
                else "it is a number, or varies too little to matter"
            ),
        )
        if self.varies and self.light.suns:
            yield Choice(
                "bright parts",
                f"{len(self.light.suns)},"
                f" {'as directions' if closed else f'{2 * self.sectors + 1} azimuths each'}",
                "small and bright: suns, lights and spots have azimuths of their own",
            )
        if not closed:
            yield Choice(
                "azimuths", f"{self.units} evenly", "the fewest whose light at the samples is that of many"
            )
            yield Choice(
                "search radius",
                "whole map" if self.max_distance is None else f"{self.max_distance:g}",
                self.why_far,
            )
            if self.near:
                yield Choice(
                    "near rows", f"{self.near}", "there are cliffs: every crossing so near is tested"
                )


class _Slices(_Chosen):
    """Lamps and windows of simple shape: a closed form where every node looks at all of the source, else
    slices.
    """

    count = 256  # shadows are sharper than a sky's, and rays cost more
    rays = 0
    sky: Integrals | None = None

    def choose(self):
        scene, source, samples = self.scene, self.source, self.samples
        self.kind, self.apparent = _ClosedForm, 0.0
        self.solid = upright(solid_of(scene, source, 1 / scene.spacing, 1.0))
        if self.solid is None:
            self.exact, self.errors = np.zeros(len(samples)), Errors(0.0, 0.0, 0.0)
            return
        corners = None if isinstance(self.solid, Ball) else np.asarray(self.solid.corners, float)
        self.middle, self.radius = (
            (np.array(self.solid.center), self.solid.radius)
            if corners is None
            else (corners.mean(0), float(np.linalg.norm(corners - corners.mean(0), axis=1).max()))
        )
        away = self.middle[:, None] - np.stack([samples.x, samples.y, samples.own])
        self.apparent = float(
            np.arcsin(np.minimum(1, self.radius / np.maximum(np.sqrt((away**2).sum(0)), 1e-9))).mean()
        )
        bright, brightness = 0.0, source.brightness
        if isinstance(source, sources.Window) and callable(brightness):
            self.sky = Integrals(sources.Sky(brightness), self.tolerance, True, SMALL)
            depth, step = scene.lattice()
            wide, scale = widened(solid_of(scene, source, step / scene.spacing, step), depth, step)
            self.outline = outline(wide, step)
        if callable(brightness):
            samples.look_where(scene, self._open_light)
        self.uniform = self._seen_of_sky()
        if self.sky is not None and self.sky.suns:
            bright = scale * sum(
                samples.sectors(*sun.sectors(BEHIND_WINDOW), self.outline) for sun in self.sky.suns
            )
            brightness = self._without_suns
        light = lambda count: samples.through_slices(self.solid, brightness, count) + bright
        by_count = {count: light(count) for count in SLICES[:3]}
        self.exact = by_count[SLICES[2]]
        if self._closed():
            return
        self.kind = Sliced
        if callable(source.brightness):
            even = samples.through_slices(self.solid, 1.0, SLICES[2]) / np.maximum(
                self._formed(1, 1.0), 1e-30
            )
            for rays in RAYS if isinstance(source, sources.Lamp) and self.apparent < NARROW else ():
                if samples.errors(self._formed(rays) * even, self.exact).bound <= 0.5 * self.tolerance:
                    self.rays = rays
                    break
            if not self.rays and self.sky is None:
                self.sky = Integrals(sources.Sky(source.brightness), math.inf, True)
        for finest in SLICES[2:]:
            self.exact = by_count[finest] = by_count[finest] if finest in by_count else light(finest)
            for self.units in SLICES[
                isinstance(self.solid, Quad) :
            ]:  # a quadrangle has four sectors to share them
                number, through = self._taken(self.units), by_count[SLICES[0]]
                for count in by_count:
                    through = np.where(number >= count, by_count[count], through)
                self.errors = samples.errors(through, self.exact)
                if self.fits(Errors(self.errors.rms, 2 * self.errors.bound, 2 * self.errors.tail)):
                    break
            if JUDGES * number.max() <= finest:
                break
        self.share = BALL

    def _open_light(self, at):
        """What nodes would have if nothing stood before the source: by its middle, and the small bright parts
        that shine through a window.
        """
        light = self._formed(1, at=at)
        if self.sky is not None and self.sky.suns:
            light = light + sum(
                at.sectors(*sun.sectors(PATCHES), self.outline, occluded=False) for sun in self.sky.suns
            )
        return light

    def _without_suns(self, L):
        """The brightness that is left where small bright parts are taken out: no more than where these begin."""
        values = sources.radiance(sources.Sky(self.source.brightness), L)
        for sun in self.sky.suns:
            middle, sine = sun.cone
            inside = (L[..., 0] * middle[0] + L[..., 1] * middle[1] - L[..., 2] * middle[2]) > math.sqrt(
                1 - sine * sine
            )
            values = np.where(inside, np.minimum(values, sun.limit), values)
        return values

    def _formed(self, points, brightness=None, at=None):
        at = at or self.samples
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

    def _closed(self) -> bool:
        """The closed form, where every node looks at all of the source and no wall of a dark box stands
        between.
        """
        if self.scene.sides == "dark":
            corners = (
                [self.middle - self.radius, self.middle + self.radius]
                if isinstance(self.solid, Ball)
                else self.solid.corners
            )
            low, high = np.min(corners, 0)[:2], np.max(corners, 0)[:2]
            if not ((low >= -0.5).all() and (high <= np.array(self.scene.shape[::-1]) - 0.5).all()):
                return False
        for points in (1, *RAYS) if callable(self.source.brightness) else (1,):
            found = self.samples.errors(self._formed(points), self.exact)
            if self.fits(found) and self._all_look():
                self.errors, self.points = found, points
                return True
        return False

    def _all_look(self) -> bool:
        at, radius = self.samples, self.radius if isinstance(self.solid, Ball) else 0.0
        far = self.middle[:, None] - np.stack([at.x, at.y, at.own])
        if self.scene.mask is not None or not unoccluded.looks_at_all(at.gx, at.gy, *far, radius).all():
            return False
        rows, cols = self.scene.shape
        (gx, gy), deep = unoccluded.gradients(self.scene), self.scene.depth / np.float32(self.scene.spacing)
        points = [self.middle] if isinstance(self.solid, Ball) else self.solid.corners
        return all(
            unoccluded.looks_at_all(
                gx,
                gy,
                np.float32(x) - np.arange(cols, dtype=np.float32),
                np.float32(y) - np.arange(rows, dtype=np.float32)[:, None],
                np.float32(z) + deep,
                np.float32(radius),
            ).all()
            for x, y, z in points
        )

    def _taken(self, most):
        """As many slices at every sample as the kernel would take."""
        least = max(most // (4 if isinstance(self.solid, Ball) else 2) // 8, 1) * 8
        return (least + self.samples.turn(self.solid) * (most - least)).astype(int) // 8 * 8

    def refine(self, method, alike):
        if (
            self.kind is Sliced
            and alike
            and not self.rays
            and isinstance(self.source, sources.Lamp)
            and self.apparent < NARROW
            and self.sky is not None
            and math.prod(self.scene.shape) * RAYS[-1] <= MOST_LOOKS
        ):
            self.rays, self.sky = RAYS[-1], None  # what a table of the sky is too coarse for
            self.method = self.make()
            return True
        if self.kind is not _ClosedForm or self.solid is None or self.points == max(RAYS):
            return super().refine(method, alike)
        self.points = 4 * max(1, self.points)
        self.method = self.make()
        return True

    def make(self):
        if self.solid is None:
            return _ClosedForm(np.zeros(self.scene.shape, np.float32))
        if self.kind is _ClosedForm:
            return _ClosedForm(
                unoccluded.image(self.scene, self.solid, self.source.brightness, self.points).astype(
                    np.float32, copy=False
                )
            )
        step = self.scene.lattice()[1]
        return Sliced(
            self.engine,
            self.scene,
            self.source,
            solid_of(self.scene, self.source, step / self.scene.spacing, step),
            self.units,
            self.rays,
            None if self.rays else self.sky,
        )

    def choices(self):
        closed = self.kind is _ClosedForm
        yield Choice(
            "occlusion",
            "none" if closed else "by ground",
            "every node looks at all of the source" if closed else "ground may stand before the source",
        )
        kind = "lamp" if isinstance(self.source, sources.Lamp) else "window"
        off = 0.0 if self.solid is None else float(point_error(np.sin(self.apparent), 1.0))
        taken = (
            "nothing to see"
            if self.solid is None
            else (
                "a point"
                if off <= POINT * self.tolerance
                else "a sphere, closed form"
                if isinstance(self.solid, Ball)
                else "a polygon, closed form"
            )
        )
        yield Choice(
            kind,
            taken if closed else f"{self.units} slices",
            (
                ""
                if self.solid is None
                else f"its radius seems {np.degrees(self.apparent):.2g} degrees on average"
                + (f"; as a point, a disc of that size is off by {_percent(off)}" if closed else "")
            ),
        )
        if callable(self.source.brightness):
            yield Choice(
                "brightness",
                (
                    f"along {self.points if closed else self.rays} rays"
                    if closed or self.rays
                    else "along every chord"
                ),
                "it varies little across the source" if closed or self.rays else "integrated",
            )
            if not closed and self.sky is not None and self.sky.suns:
                yield Choice(
                    "bright parts",
                    f"{len(self.sky.suns)}",
                    "seen through the window in azimuths of their own",
                )
        else:
            yield Choice("brightness", "constant", "it is a number")
        yield Choice("search radius", "up to the source", "what lies behind it hides nothing")


class _Lattice(_Chosen):
    """What horizons cannot render: lattice directions, filled."""

    kind, count = Lattice, 64

    def choose(self):
        self.why = lacking(self.scene, self.source)
        if isinstance(self.source, sources.Lamp):  # a volume: nothing but the lattice knows it
            known = lattice.ERRORS
            self.unknown = (
                f"{self.why}; its error was not measured, on rough ground under a sky it is"
                f" {min(known.values())} to {max(known.values())} of pi"
            )
            self.units = next((size for size, error in known.items() if error <= self.tolerance), max(known))
            return
        self.exact, self.uniform = (
            lattice.through_window(self.samples, self.scene, self.source),
            self._seen_of_sky(),
        )
        for self.units in lattice.ERRORS:
            self.errors = self.samples.errors(
                lattice.at_samples(self.samples, self.scene, self.source, self.units), self.exact
            )
            if self.fits(self.errors):
                break

    def make(self):
        return Lattice(self.engine, self.scene, self.source, self.units)

    def refine(self, method, alike):
        if method.units >= max(lattice.ERRORS):
            return False
        method.refine()
        return True

    def choices(self):
        yield Choice("occlusion", "by ground", self.why)
        yield Choice(
            "directions",
            f"hemicube {self.units}, filled",
            self.unknown or "the smallest whose light at the samples is that of many directions",
        )


def between_surfaces(scene, uniform, exact, tolerance):
    """What light between surfaces may add to the irradiance ``exact`` at some nodes, if it passes the
    tolerance; ``uniform``: that of a sky of brightness 1.
    """
    rho = np.asarray(scene.albedo, float)
    rho = float((rho[scene.valid] if rho.ndim > 1 else rho).max())
    sky = np.clip(uniform / np.pi, 0, 1)
    bound = rho * (1 - sky) * exact.max() / (1 - rho * (1 - sky.min()))
    share = float(np.sqrt(np.mean(bound**2)) / exact[exact > 0].mean())
    if share > tolerance:
        yield (
            f"Light between surfaces is left out: at most {_percent(share)} of the mean (RMS) at albedo"
            f" {rho:g}."
        )


def _gap(scene, highest, x, y, z, radius):
    """Least distance [spacings] from a ball to the nodes, where it is less than 1."""
    if -z - radius >= highest + 1:
        return math.inf
    rows, cols = scene.shape
    i, j = (round(min(max(at, 0), n - 1)) for at, n in ((x, cols), (y, rows)))
    reach = min(int(radius) + 2, 256)
    v, u = np.mgrid[
        max(0, j - reach) : min(j + reach + 1, rows), max(0, i - reach) : min(i + reach + 1, cols)
    ]
    values, step = scene.lattice()
    return (
        math.sqrt(((u - x) ** 2 + (v - y) ** 2 + (values[v, u].astype(float) / step - z) ** 2).min()) - radius
    )


def _percent(value) -> str:
    return f"{100 * value:.2g} %"
