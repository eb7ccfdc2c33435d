"""The plan of a render: its record of what was chosen, why, and by how much each image erred."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


@dataclass(frozen=True)
class Choice:
    """One line of a plan: what was to be chosen, what was taken, and why."""

    what: str
    taken: str
    why: str


class Step(NamedTuple):
    """One image of a refinement.

    units: azimuths, slices or points; the hemicube's size; or, of a closed form, rays from every node, 0 if
    the brightness is constant. estimate: relative RMS error, estimated over all nodes; audit: the same
    at the samples.
    """

    units: int
    estimate: float | None
    audit: float | None

    @property
    def error(self) -> float | None:
        """The larger of the two, None where neither is known."""
        return larger(self.estimate, self.audit)


@dataclass(frozen=True)
class Plan:
    """The model that was or will be used, and why.

    method: "unoccluded", "horizon" or "lattice". hemicube, filled: of the lattice, else None. azimuths: of
    horizons, slices of a lamp or window, or points of a thin one; unit_name: which of these. max_distance
    [unit of spacing] of the search, None: the whole map. tolerance, tail: the relative RMS error and the
    99.9th percentile of the error that were asked for.
    error: the relative RMS error, expected from the samples before an image is made, estimated from its two
    halves afterwards; error_tail: the 99.9th percentile expected from the samples; measured: the RMS error of
    the rendered image at the samples. reason: of the method and its units, in one sentence; choices: every
    choice with its reason, and the refinement; steps: every image that was made; beyond: what the scene needs
    and the model lacks, with numbers; interreflection: estimated RMS of the light between surfaces over the
    mean of the direct light. seconds of the whole call and planning_seconds before the first image are
    measured; no decision depends on them. Fields that do not apply are None or empty.

    Examples
    --------
    >>> plan = sl.plan(sl.Scene(np.zeros((8, 8))), sl.Sky())
    >>> plan.error < plan.tolerance
    True
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
    unit_name: str = "azimuths"

    @property
    def line(self) -> str:
        """The plan in one line."""
        if self.method == "lattice":
            step = "filled" if self.filled else "stride"
            return f"lattice, hemicube {self.hemicube}, {step}: {self.reason}"
        units = "" if self.azimuths is None else f", {self.azimuths} {self.unit_name}"
        return f"{self.method}{units}: {self.reason}"

    def __str__(self) -> str:
        if not self.choices:
            return self.line
        widths = [max(len(getattr(c, name)) for c in self.choices) for name in ("what", "taken")]
        lines = [f"{c.what:{widths[0]}}  {c.taken:{widths[1]}}  {c.why}".rstrip() for c in self.choices]
        return "\n".join([*lines, *(f"beyond the model: {text}" for text in self.beyond)])


def larger(*errors: float | None) -> float | None:
    """The largest of the errors that are known, None if none is."""
    return max((error for error in errors if error is not None), default=None)


def percent(value: float) -> str:
    return f"{100 * value:{'.2g' if value < 0.995 else '.0f'}} %"
