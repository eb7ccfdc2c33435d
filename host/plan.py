"""plan(): the cheapest model of a scene and source that is within a tolerance, with a reason for every choice.

Candidates are measured, not guessed: their light at a few hundred pilot nodes (pilots.py) is compared with that of exact rays
in many azimuths, and their cost is what the backend took on this machine (costs.py).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from . import sources, unoccluded
from .backends import select
from .backends.base import Backend
from .backends.horizon import FAINTEST
from .backends.slices import Ball, Quad, aperture, rectangle
from .costs import Costs
from .directions import Azimuths, Hemicube
from .errors import bad
from .pilots import CLIFF, COUNT, Pilots
from .radiometry import point_error
from .reflectance import Lambertian
from .scene import Scene, is_scene, positive_number

FEWEST, SPARSE = 144, 8  # pilots of a small map under a sky; rows of a larger one for each: planning should stay a small part of the whole
TAIL = 10.0  # bound on the 99.9th percentile of the error, in tolerances, unless given
MARGIN = 0.95  # share of the tolerance that a setting may take: kernels add a little to the error of their azimuths
SIGMAS = 1.5  # standard errors by which the RMS error of all nodes may pass that of the pilots
EVEN = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)  # azimuths
GRIDS = {24: 6, 48: 12, 96: 24, 192: 256}  # azimuths of the reference, and how many azimuths it can judge; EVEN's are among them where half of it is a multiple
PLACED, PLACED_GRID = (8, 16, 32, 80), 160  # azimuths where brightness is uneven on a map that repeats, and of their reference
PLACED_COUNT = 128  # pilots there
SUNS, SPANS = 120, (15, 5, 3, 1)  # sectors of a sun's light in the reference, and how many of them a candidate takes together
SLICES, FINEST = (8, 16, 32, 64, 128, 256), {0.01: 48, 0.0: 96}  # slices of a source that stands all round; slices of the reference, from a tolerance on
LATTICES = (5, 7, 9, 17, 33)
# RMS error of E / pi of the filled lattice under a uniform sky on rough ground (rms slope 1): performance/lattice_error.py
LATTICE_ERROR = {5: 0.0376, 7: 0.0188, 9: 0.0119, 17: 0.0039, 33: 0.0012}
LOOKS = 192  # azimuths at which a sky's brightness is looked at, at least; a multiple of those of GRIDS
NEAR = 24  # rows within which every crossing is tested where a small error of the horizon shows
BEHIND = {NEAR: 0.017, None: 0.045}  # RMS error of sweeps behind cliffs, with so many and with the backend's choice, over the root of the cliffs' share of the nodes: 0.2 to 0.6 % and 0.5 to 1.1 % among houses
DEARER = 1.4  # times as long as a sweep takes with so many
SAFE = {24: 0.033, 48: 0.0125, 64: 0.0080, 96: 0.0046, 128: 0.0033, 192: 0.0021, 256: 0.0017}  # RMS error by azimuths, with so many, among houses
SAFE_SLICES, SAFE_BALL, SAFE_QUAD = 128, 0.0016, 0.0062  # slices that do for lamps and windows; RMS error with so many, among houses
SAFELY = 1.5  # tolerance over the known error from which a setting is taken unmeasured
CLOSED = {(Ball, 0): 3, (Ball, 1): 8, (Ball, 4): 46, (Quad, 0): 11, (Quad, 1): 12, (Quad, 4): 28}  # times as long as the closed form of a uniform sky, by points of brightness
SHADED = 64  # pilots where ground may hide some of a source that is nearly clear
LIKELY = 1.5  # times as many nodes may be dark as these have it, where a percentile depends on few of them
SMALL, COARSE = 0.1, 24  # apparent radius [rad] up to which so many slices may be reference enough
POINT = 0.1  # share of the tolerance by which a lamp that is called a point may be off as one
SLIGHT, FAINT = 0.7, 0.1  # share of the tolerance that ground may take from a sky, as its highest nodes have it, that no ray is cast; where some ground is rare
BEYOND = 3  # nodes beyond the percentile, from which on it is read off
HIDDEN = 1.25  # times the bound that counts where what ground hides is left out


@dataclass(frozen=True)
class Choice:
    """One line of a plan: what was to be chosen, what was taken, and why."""

    what: str
    taken: str
    why: str


@dataclass(frozen=True)
class Plan:
    """The model that was or will be used, and why.

    method: "unoccluded", "horizon" or "lattice". hemicube, filled: of the lattice, else None. azimuths: of horizons, or
    slices of a lamp or window. max_distance [unit of spacing] of the search, None: the whole map. tolerance, tail: what was
    asked for, relative RMS error and 99.9th percentile; error, error_tail: what the pilots say it will be; measured: the
    RMS error of the image at the pilots, once rendered. seconds: the estimated time of the call, planning included;
    planning_seconds. choices, line by line; beyond: what the scene needs and the model lacks, with numbers. Fields that
    nothing was planned for are None or empty.
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
    seconds: float | None = None
    planning_seconds: float | None = None
    choices: tuple[Choice, ...] = ()
    beyond: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The plan in one line."""
        if self.method == "lattice":
            return f"lattice, hemicube {self.hemicube}, {'filled' if self.filled else 'stride'}: {self.reason}"
        return f"{self.method}{'' if self.azimuths is None else f', {self.azimuths} azimuths'}: {self.reason}"

    def __str__(self) -> str:
        if not self.choices:
            return self.line
        widths = [max(len(getattr(c, name)) for c in self.choices) for name in ("what", "taken")]
        lines = [f"{c.what:{widths[0]}}  {c.taken:{widths[1]}}  {c.why}".rstrip() for c in self.choices]
        return "\n".join([*lines, *(f"beyond the model: {text}" for text in self.beyond)])


@dataclass(frozen=True, eq=False)
class Setting:
    """One way to compute the image, and what it is reckoned to be worth; render() knows how to run it."""

    method: str
    units: int = 0  # azimuths, slices, or the hemicube
    error: float = math.nan
    bound: float = math.nan
    tail: float = math.nan
    seconds: float = 0.0
    sectors: Azimuths | None = None
    table: Callable[[], np.ndarray] | None = None  # makes the table of brightness
    scale: float = 1.0
    max_distance: float | None = None
    near: int | None = None  # rows within which every crossing is tested; the backend's choice unless given
    suns: sources.Spots | None = None  # bright parts of the sky, which sweeps leave out


class Work(NamedTuple):
    """A plan with what it takes to follow it: settings from the one chosen on, the pilots and their reference; ``glanced``: the
    pilots' light is not known, so that the image has to tell what is left out between surfaces, by ``uniform``, what they see of a
    uniform sky, unless that is the source."""

    plan: Plan
    settings: list[Setting]
    pilots: Pilots
    exact: np.ndarray | None
    glanced: bool
    uniform: np.ndarray | None


def plan(scene: Scene, source: sources.Source, tolerance: float = 0.01, backend: str = "auto", *, tail: float | None = None) -> Plan:
    """The cheapest model of ``scene`` under ``source`` whose relative error is within ``tolerance``, with reasons; print it.

    The light left out between surfaces is no part of the error; ``Plan.beyond`` bounds it.

    Parameters
    ----------
    tolerance : float
        RMS error over all valid nodes, divided by the mean of the exact irradiance over its lit nodes.
    tail : float, optional
        Bound on the 99.9th percentile of the absolute error, over the same mean; ten tolerances unless given.
    backend : str
        Its costs are measured once on this machine and kept in the user's cache folder.

    Raises
    ------
    InputError, BackendError, CapacityError
    """
    return work(scene, source, tolerance, select(backend), tail).plan


def work(scene: Scene, source: sources.Source, tolerance: float, engine: Backend, tail: float | None = None, hurry: bool = False) -> Work:
    """The plan and all that render() needs to follow it. ``hurry``: a setting that is known to do is taken where that takes less
    time than to choose one."""
    is_scene(scene)
    tolerance = positive_number(tolerance, "tolerance")
    tail = TAIL * tolerance if tail is None else positive_number(tail, "tail")
    if not isinstance(source, sources.Source):
        raise bad("source", type(source).__name__, "Sky, Lamp or Window")
    if getattr(source, "corner", None) is None or scene.sides == "periodic":
        sources.geometry(source, scene, 1.0)  # checks that they fit
    cost = Costs(engine)
    start, compiled = time.perf_counter(), engine.compile_seconds
    source = sources.without_disc(source)  # which render adds by slices
    planner = (_Lattice if lacking(scene, source) else _Sky if isinstance(source, sources.Sky) else _Slices)(scene, source, tolerance, tail, engine, cost, hurry)
    settings = planner.settings()
    fitting = [s for s in settings if planner.fits(s)]
    if fitting:
        best = min(fitting, key=lambda s: s.seconds)
    else:
        best = min(settings, key=lambda s: (s.error if math.isfinite(s.error) else math.inf, s.seconds))
    finer = sorted((s for s in settings if s.method == best.method and s.units > best.units and s.near == best.near and s.suns is settings[-1].suns), key=lambda s: s.units)
    if best.method == "unoccluded":
        finer = sorted((s for s in settings if s.method != "unoccluded" and s.error <= tolerance), key=lambda s: s.seconds)[:1]
    if best.method == "horizon":
        finer = [replace(s, near=NEAR) for s in ([best] if best.near is None else []) + finer]
    choices = [*planner.choices(best, settings), *_common(planner, best, settings, tolerance, tail)]
    beyond = tuple(_beyond(planner, tolerance))
    planner.pilots.put_away()
    took = time.perf_counter() - start - (engine.compile_seconds - compiled)
    choices.append(Choice("time", f"{1e3 * (best.seconds + took):.0f} ms", f"{1e3 * took:.0f} ms of it to plan; costs of {engine.name} were measured on this machine"))
    lattice = best.method == "lattice"
    reason = _error_text(best, tolerance) if math.isfinite(best.error) else planner.unmeasured
    made = Plan("horizon" if best.method == "slices" else best.method, best.units if lattice else None, True if lattice else None, reason, None if lattice or best.method == "unoccluded" else best.units,
                best.max_distance, tolerance, tail, _known(best.error), _known(best.tail), None, best.seconds + took, took, tuple(choices), beyond)
    return Work(made, [best, *finer], planner.pilots, planner.exact if math.isfinite(best.error) else None, planner.glanced, planner.uniform)


def lacking(scene: Scene, source: sources.Source) -> str:
    """Why horizons cannot render this, or nothing."""
    if isinstance(source, sources.Lamp) and source.volume is not None:
        return "a lamp given as a volume"
    if isinstance(source, sources.Window) and source.aperture is not None:
        return "a window given as an aperture"
    if scene.sides == "periodic" and not isinstance(source, sources.Sky):
        return "a lamp or window over a map that repeats"
    return ""


def solid_of(scene: Scene, source: sources.Source, unit: float, step: float) -> Ball | Quad | None:
    """The shape of a lamp or window, lengths times ``unit`` so that the spacing is ``step``; None for a window outside a dark box."""
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


class Errors(NamedTuple):
    """Relative errors of a sample of nodes: RMS, what the RMS over all nodes hardly passes, and 99.9th percentile."""

    rms: float
    bound: float
    tail: float


def errors(found: np.ndarray, exact: np.ndarray, weights: np.ndarray | None = None) -> Errors:
    """Errors over the mean of ``exact`` where it is lit, nodes by their ``weights``, even unless given.

    ``bound``: RMS and SIGMAS standard errors of it, from the sample's own spread. The percentile is extrapolated from the
    tenth of largest errors, whose excess is taken as exponential, unless BEYOND nodes pass it.
    """
    lit = exact > 0
    if not lit.any():
        return Errors(*(0.0 if not np.abs(found).max(initial=0) > 0 else math.inf,) * 3)
    weights = np.full(len(exact), 1 / len(exact)) if weights is None else weights / weights.sum()
    off = np.abs(found - exact) * (weights[lit].sum() / (weights @ exact))
    square = float(weights @ off**2)
    bound = math.sqrt(square + SIGMAS * float(np.linalg.norm(weights * (off**2 - square))))
    order = np.argsort(off)
    off, weights = off[order], weights[order]
    tenth, last = np.searchsorted(np.cumsum(weights), (0.9 - 1e-9, 0.999))
    threshold, tail = off[tenth], off[min(last, len(off) - 1)]
    if len(off) - last < BEYOND:
        excess, share = off[tenth:] - threshold, weights[tenth:] * (off[tenth:] > threshold)
        tail = threshold + (share @ excess / share.sum() * math.log(100) if share.any() else 0.0)
    return Errors(math.sqrt(square), bound, float(tail))


class _Planner:
    """A kind of source: its settings, measured at the pilots, and the reasons for them."""

    unmeasured = ""
    exact: np.ndarray | None = None
    uniform: np.ndarray | None = None  # irradiance of a uniform sky of brightness 1
    hidden = math.nan  # RMS share of the light that ground takes
    glanced = False

    def __init__(self, scene, source, tolerance, tail, engine, cost: Costs, hurry: bool):
        self.scene, self.source, self.tolerance, self.tail, self.engine, self.cost, self.hurry = scene, source, tolerance, tail, engine, cost, hurry
        self.pixels = math.prod(scene.shape)

    @cached_property
    def pilots(self):
        return Pilots.of(self.scene, self.count, rare=True)

    def fits(self, found: Errors | Setting) -> bool:
        return found.bound <= MARGIN * self.tolerance and found.tail <= self.tail

    def errors(self, found: np.ndarray, exact: np.ndarray) -> Errors:
        return errors(found, exact, self.pilots.weights)

    def _quicker(self, more: float) -> bool:
        """Whether a setting that is known to do takes less time, ``more`` than the cheapest, than to choose one."""
        return self.hurry and self.tail >= 5 * self.tolerance and more < self.cost["plan"].seconds(self.pixels)


class _Sky(_Planner):
    """Skies: no occlusion, horizons in even or placed azimuths, or the lattice."""

    reach, reach_why = None, "a sweep costs the same however far it looks"
    looks = "constant"
    why_looks = "it is a number"
    profile = suns = None
    constant = False  # whether brightness is taken as one number

    @property
    def count(self):
        return min(COUNT, max(FEWEST, math.isqrt(self.pixels) // SPARSE))

    def settings(self):
        source = self.source
        self.rest, self.scale, self.knots, self.one = source, 1.0, 0, False
        if callable(source.brightness):
            self._look()
        else:
            self.scale = float(source.brightness)
        if found := self._at_a_glance():
            return found
        pilots = self.pilots
        slight = (SLIGHT if pilots.weights is None else FAINT) * self.tolerance
        lost = pilots.sky_lost(slight / self.contrast) * self.contrast
        if lost <= slight and 5 * lost <= self.tail:
            self.hidden, self.reach_why = lost, "there is nothing to look for"
            return [Setting("unoccluded", 0, lost, lost, 5 * lost, self._seconds("closed form", 1), table=self._unoccluded if self.knots else None, scale=self.scale, suns=self.suns)]
        if self.profile is not None and pilots.periodic:
            return self._placed()
        return self._even()

    contrast = 1.0

    def _look(self):
        """What the sky's brightness needs: a number, one table for all azimuths, or a table for each."""
        self.seen = sources.looks(self.source)
        self.profile = sources.azimuth_profile(self.source, self.seen)
        light, mean = self._look_at_rest()
        low = light[:, : light.shape[1] // 2].max() if mean else 1.0
        self.contrast = max(1.0, float(low / mean)) if mean else 1.0
        if self.profile is not None:
            self.contrast *= float(self.profile.max() / self.profile.mean())
        if self.profile is not None and self.pilots.periodic:
            self.looks, self.why_looks, self.knots = "a table per azimuth", "it is uneven in azimuth, so half of the azimuths go where the light is", 1024 if self.tolerance < 0.02 else 512
        elif not self.pilots.periodic and (found := sources.split(self.source, SUNS, self.seen)):
            self.rest, self.suns = found
            self._look_at_rest()

    def _look_at_rest(self):
        """Knots, and whether one table does, for what sweeps see of the sky; its brightness (azimuths, knots) and mean."""
        azimuth = 2 * np.pi * (np.arange(24) + 0.5) / 24
        sine = np.linspace(0, 1, 513)
        light = sources.radiance(self.rest, sources.directions_of(azimuth[:, None], sine))
        mean = float((light * sine).sum() / (sine.sum() * len(azimuth)))
        spread = light - light.mean(0)
        self.one = bool(np.abs(spread).max() <= 0.1 * self.tolerance * mean) if mean else True
        whole = np.concatenate([np.zeros((len(light), 1)), np.cumsum((light[:, 1:] + light[:, :-1]) / 2, 1)], 1) / 512
        self.knots = 1024
        for knots in (33, 65, 129, 257):
            span = 512 // (knots - 1)
            low, high = whole[:, :-1:span, None], whole[:, span::span, None]
            off = low + (high - low) * (np.arange(span) / span) - whole[:, :-1].reshape(len(light), knots - 1, span)
            if np.sqrt(np.mean(off**2)) <= 0.05 * self.tolerance * whole[:, -1].mean() >= 0.1 * np.abs(off).max():
                self.knots = knots
                break
        self.looks = "one table" if self.one else "a table per azimuth"
        self.why_looks = f"{'it depends on elevation alone' if self.one else 'it varies with azimuth and elevation'}; {self.knots} knots"
        return light, mean

    def _table(self, angles, widths, looks=0):
        if self.one:
            return np.repeat(sources.elevation_table(self.rest, np.zeros(1), np.full(1, 2 * np.pi), LOOKS, self.knots), len(angles), 0)
        return sources.elevation_table(self.rest, angles, widths, looks or max(2 * len(angles), LOOKS), self.knots, self._points)

    @property
    def _points(self):
        """Of brightness between knots; where these are many, one does."""
        return max(1, 4 * 33 // self.knots)

    @cached_property
    def _fine(self):
        """The table of LOOKS even sectors, of which others are made."""
        sectors = Azimuths(LOOKS)
        return self._table(sectors.angles, sectors.widths, LOOKS)

    def _around(self, number):
        """The table of ``number`` even sectors round azimuth 0 and so on, as the reference has them."""
        span = LOOKS // number
        shifted = np.roll(self._fine, span // 2, 0) if span > 1 else (self._fine + np.roll(self._fine, 1, 0)) / 2
        return shifted.reshape(number, span, *self._fine.shape[1:]).mean(1)

    def _unoccluded(self):
        if self.profile is not None and self.pilots.periodic:
            sectors = Azimuths.placed(PLACED_GRID, self.profile)
            return sources.fine_table(self.source, sectors.angles, sectors.widths, self.knots), sectors
        sectors = Azimuths(unoccluded.AZIMUTHS)
        return self._table(sectors.angles, sectors.widths), sectors

    def _seconds(self, method, units, factor=1.0):
        cost = self.cost[method]
        tables = 3e-8 * 4 * self.knots * (1 if self.one else 2 * units) if method == "horizon" and not self.constant else 0.0
        return cost.seconds(self.pixels, factor * units) + tables

    def _at_a_glance(self):
        """A number of azimuths that does anywhere, if it takes less time than to choose one, where a few hundred nodes show that closed
        forms will not do; or nothing."""
        count = next((count for count, error in SAFE.items() if SAFELY * error <= self.tolerance), None)
        more = self.cost["sectors"].seconds(self.pixels, SUNS) if self.suns else 0.0
        if count is None or self.scene.sides == "periodic" or not self._quicker(self._seconds("horizon", count, DEARER) - self._seconds("horizon", EVEN[0]) + more):
            return None
        pilots = Pilots.of(self.scene, FEWEST)
        self.hidden = pilots.sky_lost_at_a_glance()
        if self.hidden <= self.tolerance:
            return None
        self.pilots, self.glanced = pilots, True
        self.unmeasured = f"on ground that is hard to render it is off by {_percent(SAFE[count])}, and to choose fewer would take longer than to render"
        if self.knots:
            self.uniform = pilots.sky_seen(self.engine)
        near = NEAR if self.knots or pilots.steep > 0 else None
        return [Setting("horizon", count, seconds=self._seconds("horizon", count, DEARER if near else 1.0) + more, sectors=_evenly(count), table=self._maker(count) if self.knots else None,
                        scale=self.scale, near=near, suns=self.suns)]

    def _even(self):
        pilots, engine = self.pilots, self.engine
        self.by_suns = {None: 0.0}
        if self.suns:  # the coarsest sectors by the next, until these prove too coarse
            self.by_suns = dict(zip(SPANS, pilots.suns(engine, self.suns.fewer(SPANS[1]), (SPANS[0] // SPANS[1], 1))))
        for number, judges in GRIDS.items():
            azimuths = 2 * np.pi * np.arange(number) / number
            if number == min(GRIDS):
                slopes = pilots.horizons(engine, azimuths)
            else:  # every other one is known
                slopes = np.stack([slopes, pilots.horizons(engine, azimuths[1::2])], 1).reshape(number, -1)
            settings = self._evaluate(azimuths, slopes, judges)
            if len(self.by_suns) == 2 and not (settings and self.fits(self.errors(self.exact - self.by_suns[SPANS[1]] + self.by_suns[SPANS[0]], self.exact))):
                self.by_suns = dict(zip(SPANS, pilots.suns(engine, self.suns, SPANS)))
                settings = self._evaluate(azimuths, slopes, judges)
            if any(self.fits(s) and s.units <= judges for s in settings):
                break
        if pilots.periodic:
            return self._shorter(settings, azimuths, slopes)
        fitting = [s.seconds for s in settings if self.fits(s)]
        if self.tolerance >= LATTICE_ERROR[LATTICES[0]] and _lattice_seconds(self, LATTICES[0]) < 0.8 * min(fitting, default=0):
            settings += _of_lattices(self, LATTICES[:1], self.exact)
        return settings

    def _evaluate(self, azimuths, slopes, judges):
        """Settings of every number of azimuths, up to ``judges`` against all of ``azimuths``, and what others may be worth."""
        pilots, number = self.pilots, len(azimuths)
        width = 2 * np.pi / number
        reference = min(self.by_suns) if self.suns else None
        suns = self.by_suns[reference]
        varies = callable(self.source.brightness)
        uniform = pilots.ring(azimuths, slopes)
        rings, table = uniform, None
        self.uniform = uniform.sum(0) * width
        if varies:
            table = self._around(number)
            rings = pilots.ring(azimuths, slopes, table)
        rest = rings.sum(0) * width * (1.0 if varies else self.scale)
        self.exact = exact = rest + suns
        if varies:  # is a number near enough?
            best = float((rest * self.uniform).sum() / max((self.uniform**2).sum(), 1e-300))
            error = self.errors(best * self.uniform + suns, exact)
            if self.fits(Errors(error.rms, 2 * error.bound, error.tail)):
                self.scale, varies, self.constant = best, False, True
                self.looks, self.why_looks = "constant", f"taken as one number it costs {_percent(error.rms)}"
                rings = uniform
        planes = np.maximum(0, pilots.plane(np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]))
        free = pilots.ring(azimuths, planes).sum(0) * width
        self.hidden = self.errors(self.uniform, free).rms
        free = pilots.ring(azimuths, planes, table).sum(0) * width if varies else free * self.scale
        measured = {span: {} for span in self.by_suns}
        for count in EVEN:
            if number % (2 * count) == 0 and count <= judges:
                at = np.arange(number // (2 * count), number, number // count)
                light = rings[at]
                if varies and not self.one:  # each sector by its mean brightness
                    span = number // count
                    around = (at[:, None] + np.arange(-(span // 2), span // 2 + 1)) % number
                    share = np.ones(around.shape[1])
                    share[0] = share[-1] = 0.5
                    light = pilots.ring(azimuths[at], slopes[at], np.einsum("s,kstn->ktn", share / share.sum(), table[around]))
                light = light.sum(0) * (2 * np.pi / count) * (1.0 if varies else self.scale)
                for span, sun in self.by_suns.items():
                    measured[span][count] = self.errors(light + sun, exact)
        cliffs = math.sqrt(pilots.steep) * float(rest.mean() / max(exact.mean(), 1e-30))  # behind them the two best crossings are not enough
        found = self.errors(free, exact)
        settings = [Setting("unoccluded", 0, *found, self._seconds("closed form", 1), table=self._unoccluded if varies else None, scale=self.scale)]
        if self.suns or not self.fits(Errors(found.rms, HIDDEN * found.bound, found.tail)):
            settings = []  # what little ground hides may be the sun, at a few nodes where no pilot is
        for span in self.by_suns if reference in (None, SPANS[-1]) else SPANS[:1]:
            few, more = None, 0.0
            if span:
                few = self.suns.fewer(span)
                more = self.cost["sectors"].seconds(self.pixels, len(few.angles))
                if cliffs and span > 1 and suns.max() / (2 * len(few.angles)) > self.tail * exact[exact > 0].mean():
                    continue  # the corner of a wall, where no pilot is, may cut off half a sector of the sun
            of = lambda e, missed: (math.hypot(e.rms, missed), math.hypot(e.bound, missed), e.tail)
            seconds = lambda count, near: self._seconds("horizon", count, DEARER if near else 1.0) + more
            table = lambda count: self._maker(count) if varies else None
            settings += [Setting("horizon", count, *of(_between(measured[span], count), BEHIND[near] * cliffs), seconds(count, near), _evenly(count), table(count), self.scale, near=near, suns=few)
                         for near in (BEHIND if cliffs else (None,)) for count in EVEN]
        return settings

    def _maker(self, count):
        if self.one or LOOKS % count:
            return lambda: self._table(Azimuths(count).angles, Azimuths(count).widths)
        return lambda: self._fine.reshape(count, -1, *self._fine.shape[1:]).mean(1, dtype=np.float32)

    def _shorter(self, settings, azimuths, slopes):
        """On a map that repeats: how far must be looked."""
        rows, cols = self.scene.shape
        whole = 1 + max(rows, cols, self.pilots.relief / FAINTEST) / math.sqrt(rows * cols)
        settings = [replace(s, seconds=s.seconds * whole) for s in settings]
        some = slice(None, None, len(azimuths) // 24)
        full = self.pilots.ring(azimuths[some], slopes[some]).sum(0)
        self.reach_why = f"on a map that repeats, as far as its relief makes a slope of {FAINTEST}"
        for slope in (0.8, 0.4, 0.2, 0.1, 0.05, 0.025):
            reach = max(2.0, math.ceil(self.pilots.relief / slope))
            factor = 2.5 * (1 + reach / math.sqrt(rows * cols))
            if factor > 0.8 * whole:
                break
            short = self.pilots.ring(azimuths[some], self.pilots.horizons(self.engine, azimuths[some], reach)).sum(0)
            cut = self.errors(short, full)
            if cut.bound <= 0.3 * self.tolerance and cut.tail <= 0.5 * self.tail:
                self.reach_why = f"what lies farther away costs {_percent(cut.rms)}"
                settings += [replace(s, max_distance=reach * self.scene.spacing, seconds=s.seconds / whole * factor, error=math.hypot(s.error, cut.rms), bound=math.hypot(s.bound, cut.bound), tail=s.tail + cut.tail) for s in settings]
                break
        return settings

    def _placed(self):
        """Azimuths placed by brightness: every candidate's sectors are unions of the reference's."""
        pilots = self.pilots = Pilots.of(self.scene, PLACED_COUNT)
        engine, source = self.engine, self.source
        grid = Azimuths.placed(PLACED_GRID, self.profile)
        table = sources.fine_table(source, grid.angles, grid.widths, self.knots)
        slopes = pilots.horizons(engine, grid.angles)
        self.uniform = grid.widths @ pilots.ring(grid.angles, slopes)
        self.exact = exact = grid.widths @ pilots.ring(grid.angles, slopes, table)
        lost = grid.widths @ pilots.ring(grid.angles, np.maximum(0, pilots.plane(np.cos(grid.angles)[:, None], np.sin(grid.angles)[:, None])), table)
        self.hidden = self.errors(exact, lost).rms
        measured, made = {}, {}
        for count in (*PLACED, PLACED_GRID):
            span = PLACED_GRID // count
            sectors = grid if span == 1 else Azimuths(count, grid.edges[::span])
            share = (grid.widths.reshape(count, span) / sectors.widths[:, None])[..., None, None]
            made[count] = sectors, (lambda share=share, count=count: (share * table.reshape(count, -1, *table.shape[1:])).sum(1).astype(np.float32))
            if count <= PLACED[-2] or (count < PLACED_GRID and not self.fits(measured[PLACED[-2]])):
                measured[count] = self.errors(sectors.widths @ pilots.ring(sectors.angles, pilots.horizons(engine, sectors.angles), made[count][1]()), exact)
        near = NEAR if pilots.steep > 0 else None
        return [Setting("horizon", count, *_between(measured, count), self._seconds("horizon", count), *made[count], near=near) for count in made]

    def choices(self, best, settings):
        yield Choice("occlusion", "none" if best.method == "unoccluded" else "by ground", f"ground takes {'at least ' * self.glanced}{_percent(self.hidden)} of the light (RMS)")
        yield Choice("brightness", self.looks, self.why_looks)
        if best.method == "horizon":
            yield Choice("azimuths", f"{best.units} {'evenly' if best.sectors.edges == Azimuths(best.units).edges else 'placed by brightness'}", self.unmeasured or _among(best, settings))
            if best.suns is not None:
                yield Choice("sun", f"{len(best.suns.angles)} azimuths of its own", f"of what is brighter than {sources.SUNNY:g} times the sky's median every crossing is tested")
        elif best.method == "lattice":
            yield Choice("directions", f"{len(Hemicube(best.units))}, filled", _among(best, settings))
        yield Choice("search radius", "whole map" if best.max_distance is None else f"{best.max_distance:g}", self.reach_why)
        if best.near:
            yield Choice("near rows", f"{best.near}", "there are cliffs: every crossing so near is tested" if self.pilots.steep else "every crossing so near is tested")


class _Slices(_Planner):
    """Lamps and windows of simple shape: a closed form where nothing hides them, else slices."""

    count = 192  # shadows are sharper than a sky's
    shade = 0.0  # share of the nodes that may lie in shadow

    def settings(self):
        engine, source = self.engine, self.source
        self.solid = solid_of(self.scene, source, 1 / self.scene.spacing, 1.0)
        if self.solid is None:
            self.exact = np.zeros(len(self.pilots))
            return [Setting("unoccluded", 0, 0.0, 0.0, 0.0, self._seconds("closed form", 0))]
        if isinstance(self.solid, Ball):
            x, y, z = self.solid.center
            self.ball = np.array([x, y, -z]), self.solid.radius
        else:
            corners = self.solid.corners * (1, 1, -1)
            self.ball = corners.mean(0), float(np.linalg.norm(corners - corners.mean(0), axis=1).max())
        self.upright = upright(self.solid)
        if found := self._at_a_glance():
            return found
        pilots = self.pilots
        brightness = (lambda L: sources.radiance(source, L)) if callable(source.brightness) else source.brightness
        light = lambda slices, occluded=True, pilots=pilots: pilots.through_slices(engine, self.upright, brightness, slices, occluded)
        self.clear = self._in_box() and pilots.clear(self.upright)
        by_count = {8: light(8, not self.clear)}
        finest = COARSE
        self.exact = exact = light(finest, not self.clear) if self.apparent < SMALL else by_count[8]
        found = self.errors(by_count[8], exact)
        if exact is by_count[8] or not self.fits(Errors(found.rms, 2 * found.bound, 2 * found.tail)):
            finest = next(slices for least, slices in FINEST.items() if self.tolerance >= least)
            self.exact = exact = light(finest, not self.clear)
        if found := self._unoccluded(lambda pilots: light(finest, pilots=pilots)):
            return found
        self.hidden = 0.0 if self.clear else self.errors(by_count[8], light(8, False)).rms
        settings = []
        for most in SLICES[isinstance(self.solid, Quad):]:  # a quadrangle has four sectors to share them
            number = self._taken(most)
            through = np.zeros(len(pilots))
            for count in (8, 16, 32, 64):
                if (number >= count).any():
                    by_count[count] = by_count.get(count) if count in by_count else light(count, not self.clear)
                    through = np.where(number >= count, by_count[count], through)
            found = self.errors(np.where(number >= 128, exact, through), exact)
            settings.append(Setting("slices", most, *found, self._seconds("slices", float(number.mean()))))
            if self.fits(Errors(found.rms, 2 * found.bound, 2 * found.tail)):
                break
        return settings

    def _taken(self, most):
        """As many slices at every pilot as the kernel would take."""
        least = max(most // (4 if isinstance(self.solid, Ball) else 2) // 8, 1) * 8
        return (least + self.pilots.turn(self.upright) * (most - least)).astype(int) // 8 * 8

    @property
    def _towards(self):
        """Vectors from the pilots to the source's middle (3, nodes), heights third."""
        return self.ball[0][:, None] - np.stack([self.pilots.x, self.pilots.y, self.pilots.own])

    @cached_property
    def apparent(self):
        """Radius of the source as it seems on average [rad]."""
        return float(np.arcsin(np.minimum(1, self.ball[1] / np.maximum(np.sqrt((self._towards**2).sum(0)), 1e-9))).mean())

    def _at_a_glance(self):
        """Slices that do anywhere, if they take less time than to choose, where a few hundred nodes show that the source may be hidden
        from some and no closed form will do, or would take longer; or nothing."""
        error = SAFE_BALL if isinstance(self.solid, Ball) else SAFE_QUAD
        if not self.hurry or self.tolerance < SAFELY * error:
            return None
        pilots = self.pilots = Pilots.of(self.scene, self.count)
        seconds, least = (self._seconds("slices", float(self._taken(most).mean())) for most in (SAFE_SLICES, SLICES[0]))
        looks = (self._towards * np.stack([pilots.gx, pilots.gy, np.ones(len(pilots))])).sum(0) >= self.ball[1] * pilots.length
        if not self._quicker(seconds - least) or self._in_box() and pilots.clear(self.upright) or looks.all() and self._closed(1) < seconds:
            del self.pilots
            return None
        self.glanced = True
        self.unmeasured = f"on ground that is hard to render it is off by {_percent(error)}, and to choose fewer would take longer than to render"
        self.uniform = pilots.sky_seen(self.engine)
        return [Setting("slices", SAFE_SLICES, seconds=seconds)]

    def _unoccluded(self, light):
        """The closed form, where that is cheaper than any slices and its error at the pilots, and at others where ground may hide some of
        the source, is within tolerance; or nothing."""
        pilots, exact, self.hidden = self.pilots, self.exact, 0.0
        formed = lambda pilots, points: unoccluded.lamp(pilots.gx, pilots.gy, pilots.x, pilots.y, pilots.own.astype(float), self.upright, self.source.brightness, points)
        for points in (1, 4) if callable(self.source.brightness) else (1,):
            seconds = self._closed(points)
            found = formed(pilots, points)
            if self.fits(self.errors(found, exact)) and (self.clear or seconds < self._seconds("slices", SLICES[0])):
                break
        else:
            return []
        if not self._in_box():
            return []
        shaded = unoccluded.shaded(self.scene, *self.ball, self.clear)
        if shaded is None:
            return []
        of = self.errors(found, exact)
        if shaded.size:
            share = shaded.shape[1] / np.count_nonzero(self.scene.valid)
            row, col = shaded[:, np.unique(np.linspace(0, shaded.shape[1] - 1, SHADED).astype(int))]
            there = pilots.moved(col, row)
            weights = np.full(len(pilots), 1 / len(pilots)) if pilots.weights is None else pilots.weights
            weighed = lambda share: np.append((1 - share) * weights, np.full(len(row), share / len(row)))
            bright = formed(there, points)
            found, exact = np.append(found, bright), np.append(exact, light(there))
            of = errors(found, exact, weighed(share))._replace(tail=errors(found, exact, weighed(LIKELY * share)).tail)
            if len(row) < shaded.shape[1] and exact.any():  # three more might be dark
                of = of._replace(bound=math.hypot(of.bound, math.sqrt(3 * share / len(row) * np.mean(bright**2)) / exact[exact > 0].mean()))
            if not self.fits(of):
                return []
            pilots.put_away()
            self.pilots, self.exact, self.shade = pilots.moved(np.append(pilots.x, col), np.append(pilots.y, row), weighed(share)), exact, share
        return [Setting("unoccluded", points, *of, seconds)]

    def _closed(self, points):
        """Seconds of the closed form."""
        return CLOSED[type(self.solid), points if callable(self.source.brightness) else 0] * self._seconds("closed form", 1)

    def _in_box(self):
        """Whether no wall of a dark box can stand between."""
        if self.scene.sides != "dark":
            return True
        corners = [self.ball[0] - self.ball[1], self.ball[0] + self.ball[1]] if isinstance(self.solid, Ball) else self.upright.corners
        low, high = np.min(corners, 0)[:2], np.max(corners, 0)[:2]
        return bool((low >= -0.5).all() and (high <= np.array(self.scene.shape[::-1]) - 0.5).all())

    def _seconds(self, method, units):
        return self.cost[method].seconds(self.pixels, units)

    def choices(self, best, settings):
        if best.method == "unoccluded":
            yield Choice("occlusion", "left out" if self.shade else "none", f"ground may hide some of the source from {_percent(self.shade)} of the nodes" if self.shade else "nothing stands between ground and source")
        else:
            yield Choice("occlusion", "by ground", "ground takes some of the light" if self.glanced else f"ground takes {_percent(self.hidden)} of the light (RMS)")
        kind = "lamp" if isinstance(self.source, sources.Lamp) else "window"
        if best.method == "unoccluded":
            off = 0.0 if self.solid is None else float(point_error(np.sin(self.apparent), 1.0))
            taken = "nothing to see" if self.solid is None else "a point" if off <= POINT * self.tolerance else "a sphere, closed form" if isinstance(self.solid, Ball) else "a polygon, closed form"
            yield Choice(kind, taken, "" if self.solid is None else f"its radius seems {np.degrees(self.apparent):.2g} degrees on average, and nothing cuts it; as a point, a disc of that size is off by {_percent(off)}")
        else:
            yield Choice(kind, f"{best.units} slices", f"its radius seems {np.degrees(self.apparent):.2g} degrees on average; {self.unmeasured or _among(best, settings, 'slices')}")
        varies = callable(self.source.brightness)
        yield Choice("brightness", "by direction" if varies and best.method != "unoccluded" else f"along {_count(best.units, 'ray')}" if varies else "constant", "it is a function" if varies else "it is a number")
        yield Choice("search radius", "up to the source", "what lies behind it hides nothing")


class _Lattice(_Planner):
    """What horizons cannot render: lattice directions, filled."""

    count = 64

    def settings(self):
        self.why = lacking(self.scene, self.source)
        if isinstance(self.source, sources.Lamp):  # a volume: no reference but the lattice itself
            self.unmeasured = f"{self.why}; its error was not measured, on rough ground under a sky it is {LATTICE_ERROR[33]} to {LATTICE_ERROR[5]} of pi"
            size = next((m for m, error in LATTICE_ERROR.items() if error <= self.tolerance), 33)
            return [Setting("lattice", size, seconds=_lattice_seconds(self, size))]
        self.exact = _through_window(self)
        settings = _of_lattices(self, LATTICES, self.exact)
        last = settings[-1]
        return [*settings, *(replace(last, units=m, error=last.error * 33 / m, bound=last.bound * 33 / m, tail=last.tail * 33 / m, seconds=_lattice_seconds(self, m)) for m in (65, 129))]

    def choices(self, best, settings):
        yield Choice("occlusion", "by ground", self.why)
        yield Choice("directions", f"{len(Hemicube(best.units))}, filled", self.unmeasured or _among(best, settings, "hemicubes"))


def _through_window(planner):
    """Irradiance at the pilots through a window of any kind, by directions: azimuths x elevations."""
    pilots, source, scene = planner.pilots, planner.source, planner.scene
    number = 96
    azimuths = 2 * np.pi * (np.arange(number) + 0.5) / number
    slopes = pilots.horizons(planner.engine, azimuths)
    ups = 192
    total = np.zeros(len(pilots))
    deep = -pilots.own.astype(float)
    for azimuth, slope in zip(azimuths, slopes):
        e = (np.arange(ups)[:, None] + 0.5) / ups * np.pi / 2
        c, s = math.cos(azimuth), math.sin(azimuth)
        away = deep / np.tan(e)
        seen = _passes(scene, source, pilots.x + away * c, pilots.y + away * s) & (np.tan(e) >= slope)
        light = sources.radiance(source, sources.directions_of(azimuth, np.sin(e)))
        along = (pilots.gx * c + pilots.gy * s) / pilots.length
        total += (np.where(seen, light, 0) * np.cos(e) * np.maximum(0, along * np.cos(e) + np.sin(e) / pilots.length)).sum(0)
    return total * (np.pi / 2 / ups) * (2 * np.pi / number)


def _passes(scene, source, x, y):
    """Whether rays that cross z = 0 at (x, y) [spacings] pass the window."""
    rows, cols = scene.shape
    inside = (x >= -0.5) & (x < cols - 0.5) & (y >= -0.5) & (y < rows - 0.5)
    passes = inside if scene.sides == "dark" else np.ones(inside.shape, bool)
    if source.aperture is not None:
        col, row = np.floor(x + 0.5).astype(np.int64), np.floor(y + 0.5).astype(np.int64)
        if scene.sides == "periodic":
            return source.aperture[row % rows, col % cols]
        return inside & source.aperture[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
    for at, (low, high), period in ((x, source.x, cols), (y, source.y, rows)):
        low, high = low / scene.spacing, high / scene.spacing
        passes = passes & (np.mod(at - low, period) < high - low if scene.sides == "periodic" else (low <= at) & (at < high))
    return passes


def _of_lattices(planner, sizes, exact) -> list[Setting]:
    """The filled lattice's light at the pilots: a direction is seen where it lies on or above the horizon of its azimuth."""
    pilots, source = planner.pilots, planner.source
    settings = []
    for size in sizes:
        cube = Hemicube(size)
        brightness = sources.radiance(source, cube.directions)
        ways, number = np.unique(np.round(np.arctan2(cube.steps[:, 1], cube.steps[:, 0]), 9), return_inverse=True)
        slopes = pilots.horizons(planner.engine, ways)
        flat = np.hypot(cube.steps[:, 0], cube.steps[:, 1])
        rise = -cube.steps[:, 2] / np.maximum(flat, 1e-9)
        normal = np.stack([pilots.gx, pilots.gy, -np.ones(len(pilots))]) / pilots.length
        total = np.zeros(len(pilots))
        for some in np.array_split(np.arange(len(cube)), len(cube) // 512 + 1):
            seen = rise[some, None] * (1 + 1e-6) >= slopes[number[some]]
            seen |= slopes[number[some]] <= np.maximum(0, pilots.plane(*(f(ways)[number[some]][:, None] for f in (np.cos, np.sin))))  # the tangent plane hides nothing: cells are cut by N.w
            if isinstance(source, sources.Window):
                away = -pilots.own / np.maximum(rise[some, None], 1e-9)
                unit = cube.steps[some, :2] / np.maximum(flat[some, None], 1e-9)
                seen &= _passes(planner.scene, source, pilots.x + away * unit[:, :1], pilots.y + away * unit[:, 1:]) & (rise[some, None] > 0)
            total += (seen * np.maximum(0, cube.moments[some] @ normal) * brightness[some, None]).sum(0)
        settings.append(Setting("lattice", size, *planner.errors(total, exact), _lattice_seconds(planner, size)))
    return settings


def _lattice_seconds(planner, size):
    return planner.cost["lattice"].seconds(planner.pixels, size**2 + 2 * (size - 1) ** 2)


_evenly = cache(Azimuths)


def _between(measured: dict[int, Errors], count: int) -> Errors:
    """Errors of a number of azimuths: measured, between two that were by a power law, or beyond them by K^-1.2."""
    if count in measured:
        return measured[count]
    low, high = max((k for k in measured if k < count), default=None), min((k for k in measured if k > count), default=None)
    if low is None:
        return Errors(math.inf, math.inf, math.inf)
    if high is None:
        return Errors(*(value * (low / count) ** 1.2 for value in measured[low]))
    part = math.log(count / low) / math.log(high / low)
    return Errors(*(a ** (1 - part) * b**part for a, b in zip(measured[low], measured[high])))


def _percent(value) -> str:
    return f"{100 * value:.2g} %"


def _count(number, what):
    return f"{number} {what}{'s' * (number != 1)}"


def _known(value):
    return float(value) if math.isfinite(value) else None


def _among(best, settings, what="azimuths"):
    """What the choice was made among."""
    same = sorted({s.units: s.error for s in settings if s.method == best.method and (s.max_distance, s.near) == (best.max_distance, best.near) and s.suns is best.suns}.items())
    near = [n for n, (units, _) in enumerate(same) if units == best.units][0]
    return "error by " + what + ": " + ", ".join(f"{units}: {_percent(error)}" for units, error in same[max(0, near - 2) : near + 2])


def _error_text(best, tolerance):
    verdict = f"within tolerance {tolerance:g}" if best.bound <= MARGIN * tolerance else f"the best there is for tolerance {tolerance:g}"
    return f"relative RMS error {best.error:.2g} at the pilots, {verdict}"


def _common(planner, best, settings, tolerance, tail):
    """Lines that every plan has."""
    if best.method != "unoccluded":
        others = [s for s in settings if s.method not in (best.method, "unoccluded") and s.bound <= MARGIN * tolerance]
        why = f"the cheapest other way within tolerance takes {min(s.seconds for s in others) / best.seconds:.1f} times as long" if others else "no other way is within tolerance" if math.isfinite(best.error) else "no other way was tried"
        yield Choice("method", "horizons" if best.method in ("horizon", "slices") else "lattice", lacking(planner.scene, planner.source) or why)
    kind = planner.scene.reflectance
    if isinstance(kind, Lambertian):
        yield Choice("specular lobe", "none", "the surface is Lambertian")
    else:
        yield Choice("specular lobe", type(kind).__name__, "summed beside the irradiance, to which the error and the time given here belong")
    yield Choice("precision", "float32", f"depths are rounded by {_rounding(planner.pilots):.1g} spacings")
    if math.isfinite(best.error):
        yield Choice("error", _percent(best.error), f"RMS over the mean, at {len(planner.pilots)} pilot nodes; at most {_percent(best.bound)} over all nodes, asked for {_percent(tolerance)}")
        yield Choice("99.9th percentile", _percent(best.tail), f"asked for {_percent(tail)}")
    else:
        yield Choice("error", "not known", planner.unmeasured)


def _beyond(planner, tolerance):
    """What the scene needs and the model lacks, with numbers."""
    scene, source, pilots = planner.scene, planner.source, planner.pilots
    if planner.exact is not None and planner.exact.any():
        uniform = planner.uniform
        if uniform is None and planner.hidden:
            uniform = pilots.sky_seen(planner.engine)
        if uniform is not None:
            yield from between_surfaces(scene, uniform, planner.exact, tolerance)
    if isinstance(source, sources.Lamp) and source.center is not None:
        x, y, z = (v / scene.spacing for v in source.center)
        radius = source.radius / scene.spacing
        gap = _gap(pilots, x, y, -z, radius)
        if gap < 1:
            yield f"The lamp touches the surface: {'it reaches %.2g spacings into it' % -gap if gap < 0 else 'it ends %.2g spacings from it' % gap}, and the grid holds nothing finer than 1."
    steep = pilots.steep
    if steep > 0:
        yield f"Slopes are steeper than the grid holds: {_percent(steep)} of neighbouring nodes lie more than {CLIFF:g} spacings apart in depth."
    if scene.mask is not None and not scene.mask.all():
        yield f"Nodata: {_percent(1 - scene.mask.mean())} of the nodes are masked; they hide nothing, so light may come through holes."
    if _rounding(pilots) > 0.1 * tolerance:
        yield f"Depths are rounded by {_rounding(pilots):.2g} spacings, more than the tolerance allows: take the least depth off."


def between_surfaces(scene, uniform, exact, tolerance):
    """What light between surfaces may add to the irradiance ``exact`` at some nodes, if it passes the tolerance; ``uniform``: that of a sky of brightness 1, at these or a few of them."""
    rho = np.asarray(scene.albedo, float)
    rho = float((rho[scene.valid] if rho.ndim > 1 else rho).max())
    sky = np.clip(uniform / np.pi, 0, 1)
    bound = rho * (1 - sky) * exact.max() / (1 - rho * (1 - sky.min()))
    share = float(np.sqrt(np.mean(bound**2)) / exact[exact > 0].mean())
    if share > tolerance:
        yield f"Light between surfaces is left out: at most {_percent(share)} of the mean (RMS) at albedo {rho:g}."


def _rounding(pilots):
    return abs(pilots.deepest) * 2.0**-24  # heights are none above 0


def _gap(pilots, x, y, height, radius):
    """Least distance [spacings] from a ball to the nodes, where it is less than 1."""
    if height - radius >= pilots.highest + 1:
        return math.inf
    i, j = (round(min(max(at, 0), n - 1)) for at, n in ((x, pilots.cols), (y, pilots.rows)))
    reach = min(int(radius) + 2, 256)
    v, u = np.mgrid[max(0, j - reach) : min(j + reach + 1, pilots.rows), max(0, i - reach) : min(i + reach + 1, pilots.cols)]
    return math.sqrt(((u - x) ** 2 + (v - y) ** 2 + (pilots.height(v, u).astype(float) - height) ** 2).min()) - radius
