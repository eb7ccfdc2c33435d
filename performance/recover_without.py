"""What each ingredient of recover(method="robust") is worth: recovers with all, and with all but one.

    python performance/recover.py --without NAME[,NAME...]|all [--backend NAME] [--out FOLDER]

An ingredient is switched off from outside, by another value of a module's function or constant for the time
of a call; the library has no switch for it. Cases: the five surfaces of tests/surfaces.py under four sources,
under a sky with 3 % of noise, and chequered with an albedo that is not given; ten other surfaces under two
sources; terrain and six larger ones. A case that never reaches an ingredient is not run again without it.
Results stand in OUT/recover_without.json, and what stands there is not run again. The whole takes about an
hour on two cores.
"""

from __future__ import annotations

import contextlib
import copy
import datetime
import functools
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import surfaces
from surfaces import ALBEDO, LAYERS, OTHERS, SURFACES, pair, rms, source_of

import skylamp as sl
from skylamp.inverse import confidence, conjugate_gradients, lights, multigrid, pyramid, search, starts
from skylamp.inverse.conjugate_gradients import ConjugateGradients
from skylamp.inverse.descent import Solution
from skylamp.inverse.multigrid import Multigrid
from skylamp.inverse.pyramid import Pyramid
from skylamp.inverse.search import Search
from skylamp.inverse.starts import Starts

recover = sys.modules["skylamp.inverse.recover"]

LARGE = 96  # nodes a side: the smallest of tests and script that is solved by cycles
WORSE = 1.1  # times the RMSE, or the error of confidence, from which an ingredient pays on a surface
LEAST = {"rmse": 0.01, "brier": 0.005, "half": 0.01}  # changes of a figure below these are no changes

Patch = tuple[object, str, Any]


DEPTH, CONFIDENCE, BOTH = "depth", "confidence", "both"


class Ingredient(NamedTuple):
    """patches: what stands for it when it is off. reached: what is called only where it matters. effect:
    what is measured; if that is confidence alone, the search is not run again. only: the cases.
    """

    patches: list[Patch]
    reached: tuple[object, str] | None = None
    effect: str = DEPTH
    only: Callable[[str], bool] | None = None

    def concerns(self, case: str) -> bool:
        if self.only:
            return self.only(case)
        if self.effect == DEPTH:
            return tells_depth(case)
        return self.effect == CONFIDENCE or tells_depth(case) or is_spot(case)


def _linear(values: np.ndarray, times: int) -> np.ndarray:
    for_size = times * len(values), times * values.shape[1]
    at = [(np.arange(size) + 0.5) / times - 0.5 for size in for_size]
    for one in at:
        low = np.clip(np.floor(one).astype(int), 0, max(len(values) - 2, 0))
        share = (one - low)[:, None]
        values = (values[low] * (1 - share) + values[np.minimum(low + 1, len(values) - 1)] * share).T
    return values


def _relaxed(self: Multigrid, level: int, z: np.ndarray) -> Solution:
    return self.relax(level, z, multigrid.FROM_COARSER)


def _best_alone(self: Search, answers: list[Solution]) -> list[Solution]:
    """Only the best answer goes to the finer grid."""
    best = min(answers, key=lambda answer: answer.objective)
    if self.comparing == self.sorting:
        return [best]
    return [self.multigrid.refine(best.depth, self.sorting, self.comparing)]


def _as_it_was(self: Multigrid, level: int, z: np.ndarray) -> Solution:
    self.pyramid.accept(level, z)
    return Solution(z, 0.0)


EXPECT = Pyramid._expect_albedo


def _albedo_held(self: ConjugateGradients, side: int, state: Any) -> None:
    """The product for an albedo that does not follow the step."""
    with mock.patch.object(self, "albedo", None):
        MULTIPLY(self, side, state)


MULTIPLY = ConjugateGradients.multiply
ADD = Starts.add_mosaic
NOTHING = lambda *args, **more: None


def _expect_first(self: Pyramid, level: int, z: np.ndarray) -> None:
    if not self.expected_albedo:
        EXPECT(self, level, z)


is_spot = lambda case: case.endswith("spot")
has_no_albedo = lambda case: case.startswith("albedo")
is_large = lambda case: case.startswith(("terrain", "large"))
is_noisy = lambda case: case.startswith("noise")
tells_depth = lambda case: case.endswith(" sun") and not has_no_albedo(case) or case.startswith("large")
of_cycles = Multigrid, "cycles"
of_gain = Pyramid, "set_shading_gain"

RIVALS = "rivals"
INGREDIENTS = {
    # the search; those that decide which other answers there are, with their effect on confidence
    "starts from elsewhere": Ingredient([(starts, "CONFINED", ())], (Starts, "confined"), BOTH),
    "mosaic": Ingredient([(Starts, "add_mosaic", NOTHING)], (Starts, "mosaic"), BOTH),
    "mosaic before answers are compared": Ingredient(
        [
            (
                Starts,
                "add_mosaic",
                lambda self, level, answers: level == self.last or ADD(self, level, answers),
            )
        ],
        (Starts, "mosaic"),
    ),
    "mosaic after answers were compared": Ingredient(
        [(Starts, "add_mosaic", lambda self, level, answers: level < self.last or ADD(self, level, answers))],
        (Starts, "mosaic"),
    ),
    "shading gain": Ingredient([(Pyramid, "set_shading_gain", NOTHING)], of_gain),
    "strong relief": Ingredient([(search, "LOST", math.inf)], (Starts, "strong_relief")),
    "several compared": Ingredient([(Search, "_compared", _best_alone)], None, BOTH),
    "directed": Ingredient([(recover, "_directed", lambda light: False)], None, BOTH, is_spot),
    "polish": Ingredient([(Multigrid, "polish", _as_it_was)]),
    "continuation on finer grids": Ingredient(
        [(multigrid, "FROM_COARSER", ()), (starts, "FROM_COARSER", ())]
    ),
    "prior of the coarser grid": Ingredient([(Pyramid, "set_prior", NOTHING)], None, DEPTH, is_noisy),
    "cubic interpolation": Ingredient(
        [(module, "cubic", _linear) for module in (pyramid, multigrid, confidence)]
    ),
    "last accuracy": Ingredient([(multigrid, "LAST", multigrid.CLOSE)]),
    "cycles": Ingredient([(Multigrid, "cycles", _relaxed)], of_cycles, DEPTH, is_large),
    "least on large": Ingredient(
        [(pyramid, "LEAST_ON_LARGE", pyramid.LEAST_SMOOTHNESS)], of_cycles, DEPTH, is_large
    ),
    "more cycles under skies": Ingredient([(multigrid, "MORE_UNDER_SKIES", 0)], of_cycles, DEPTH, is_large),
    "stiff cycles": Ingredient([(multigrid, "CYCLE_SMOOTHNESS", 1e-9)], of_cycles, DEPTH, is_large),
    "unseen shading": Ingredient([(pyramid, "UNEVEN_SHADING", 0.0)], of_gain),
    "close accuracy": Ingredient([(multigrid, "CLOSE", multigrid.LOOSE)], None, DEPTH, is_spot),
    "start on a large grid": Ingredient(
        [(pyramid, "grid_of_starts", lambda shapes: len(shapes) - 1)], None, DEPTH, is_large
    ),
    "noise": Ingredient([(pyramid, "noise_of", lambda image: 0.0)], None, DEPTH, is_noisy),
    "albedo expected anew": Ingredient(
        [(Pyramid, "_expect_albedo", _expect_first)], None, DEPTH, has_no_albedo
    ),
    "albedo projected": Ingredient(
        [(ConjugateGradients, "multiply", _albedo_held)], None, DEPTH, has_no_albedo
    ),
    "preconditioner's coarse grids": Ingredient(
        [(conjugate_gradients, name, 1e30) for name in ("BROAD", "BROADER")]
    ),
    "azimuths of equal light": Ingredient(
        [(lights.sources, "azimuth_profile", NOTHING)], None, DEPTH, lambda case: case.endswith("sun")
    ),
    "nearest flat": Ingredient([(Starts, "nearest_flat", lambda self: 0.5)]),
    "continuation at the start": Ingredient([(multigrid, "FROM_STIFF", ()), (starts, "FROM_STIFF", ())]),
    # confidence
    RIVALS: Ingredient([], None, CONFIDENCE),  # none are handed over
    "posterior deviation": Ingredient(
        [(confidence, "posterior_deviation", lambda pyramid, level, z: 0 * z)], None, CONFIDENCE
    ),
    "finer model": Ingredient(
        [(confidence, "finer_model_depth", lambda pyramid, level, z: z)], None, CONFIDENCE
    ),
    "second refit": Ingredient([(confidence, "REFITS", 1)], None, CONFIDENCE),
    "even albedo": Ingredient(
        [(confidence, "even_albedo_depth", lambda pyramid, level, z: z)], None, CONFIDENCE, has_no_albedo
    ),
    "poor fit": Ingredient([(confidence, "POOR", math.inf)], None, CONFIDENCE),
}
ALL = "nothing"  # left out


class Case(NamedTuple):
    truth: np.ndarray
    images: list[np.ndarray]
    lights: list[sl.sources.Source]
    albedo: float | None
    layers: int


@functools.cache
def case_of(name: str) -> Case:
    """By "group surface source"."""
    group, surface, kind = name.split(" ", 2)
    if group == "terrain":
        depth = surfaces.terrain(LARGE, int(surface[1:]))
        light = surfaces.lamp_over(LARGE) if kind == "lamp" else source_of(kind)
        return Case(
            depth, [surfaces.image_of(depth, light)], [light], ALBEDO, math.ceil(1.2 * float(depth.max()))
        )
    if group == "large" and surface == "steep":  # that of tests/test_recover_robust.py
        y, x = np.indices((LARGE, LARGE))
        depth = 16 + 24 * np.sin(x / 9.6 + 1.2 * np.sin(y / 15)) ** 2
        return Case(depth, [surfaces.image_of(depth, sl.Sky())], [sl.Sky()], ALBEDO, LAYERS)
    if group == "large":
        depth, image = pair(surface, kind, LARGE)
        return Case(depth, [image], [source_of(kind, LARGE)], ALBEDO, LARGE)
    kinds = kind.split(" ")
    depth, images = pair(surface, kinds[0])[0], [pair(surface, one)[1] for one in kinds]
    albedo: float | None = ALBEDO
    if group == "noise":
        rng = np.random.default_rng(5)
        images = [
            np.maximum(image + 0.03 * image.max() * rng.normal(size=image.shape), 0) for image in images
        ]
    if group == "albedo":
        y, x = np.indices(depth.shape) // 8
        images, albedo = [image * np.where((x + y) % 2, 0.7, 0.3) / ALBEDO for image in images], None
    return Case(depth, images, [source_of(one) for one in kinds], albedo, LAYERS)


NAMES = [
    *(f"five {name} {kind}" for kind in surfaces.SOURCES for name in SURFACES),
    *(f"ten {name} {kind}" for kind in ("sky", "sun") for name in OTHERS),
    *(f"terrain x{heights} {kind}" for heights in (1, 4) for kind in ("lamp", "sun", "sky")),
    *(f"large {name} sky" for name in ("egg-crate", "fractal", "face", "folds", "cone", "steep")),
    *(f"noise {name} sky" for name in SURFACES),
    *(f"albedo {name} {kinds}" for kinds in ("sky lamp", "sky sun") for name in SURFACES),
]


def _no_confidence(solver: Multigrid, level: int, z: np.ndarray, *rest: Any) -> tuple:
    shape = solver.pyramid.shape(0)
    return np.zeros(shape), np.full((1, *shape), np.nan)


def figures(case: Case, depth: np.ndarray, sure: np.ndarray) -> dict[str, float]:
    """RMSE [nodes]; the mean squared difference between confidence and whether a pixel is within the depth
    that is worth half of it (Brier's score); RMSE of the confident half over that of all.
    """
    error = np.abs(depth - case.truth)
    within = error < max(confidence.DOUBT * case.layers, confidence.LEAST_DOUBT)
    half = np.argsort(-sure.ravel(), kind="stable")[: sure.size // 2]
    return {
        "rmse": rms(error),
        "brier": float(np.mean((sure - within) ** 2)),
        "half": rms(error.ravel()[half]) / rms(error),
    }


@contextlib.contextmanager
def without(patches: list[Patch]) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for place, name, value in patches:
            stack.enter_context(mock.patch.object(place, name, value))
        yield


def run(case: Case, backend: str) -> sl.Recovery:
    several = len(case.images) > 1
    return sl.recover(
        case.images if several else case.images[0],
        case.lights if several else case.lights[0],
        case.albedo,
        "dark",
        layers=case.layers,
        backend=backend,
    )


def run_with_all(name: str, backend: str) -> dict[str, dict]:
    """By ingredient: figures with all, and without each ingredient of confidence; with all, also which
    ingredients were reached.
    """
    case, reached, sure = case_of(name), set(), {}
    own = recover.confidence_of

    def spied(key: str, function: Callable) -> Callable:
        def called(*args: Any, **more: Any) -> Any:
            if not (function.__name__ == "set_shading_gain" and args[1] >= 1):
                reached.add(key)
            return function(*args, **more)

        return called

    def several_confidences(solver: Multigrid, level, z, rivals, rivals_at, depth_range):
        rest = level, z, rivals, rivals_at, depth_range
        for key, ingredient in INGREDIENTS.items():
            if ingredient.effect == CONFIDENCE and ingredient.concerns(name):
                clone = copy.copy(solver)
                clone.pyramid = copy.copy(solver.pyramid)
                clone.pyramid.problems = dict(solver.pyramid.problems)
                clone.pyramid.albedo = list(solver.pyramid.albedo)
                with without(ingredient.patches):
                    given = (level, z, [], rivals_at, depth_range) if key == RIVALS else rest
                    sure[key] = own(clone, *given)[0]
        return own(solver, *rest)

    spies: dict[tuple[object, str], set] = {}
    for key, ingredient in INGREDIENTS.items():
        if ingredient.reached:
            spies.setdefault(ingredient.reached, set()).add(key)
    patches: list[Patch] = [(place, what, spied(what, getattr(place, what))) for place, what in spies]
    with without([*patches, (recover, "confidence_of", several_confidences)]):
        found = run(case, backend)
    done = {key: figures(case, found.depth, each) for key, each in sure.items()}
    called = sorted(key for spy, keys in spies.items() if spy[1] in reached for key in keys)
    return {ALL: figures(case, found.depth, found.confidence) | {"reached": called}, **done}


def measure(names: list[str], backend: str, path: Path) -> dict[str, dict[str, dict]]:
    """figures[ingredient][case], written to ``path`` as they are found."""
    done: dict[str, dict[str, dict]] = json.loads(path.read_text()) if path.exists() else {}

    def keep(ingredient: str, case: str, row: dict) -> None:
        done.setdefault(ingredient, {})[case] = row
        path.write_text(json.dumps(done, indent=1))
        print(ingredient, "|", case, row, flush=True)

    for case in NAMES:
        if case not in done.get(ALL, {}):
            for ingredient, row in run_with_all(case, backend).items():
                keep(ingredient, case, row)
    for name in names:
        ingredient = INGREDIENTS[name]
        if ingredient.effect == CONFIDENCE:
            continue
        for case in NAMES:
            if case in done.get(name, {}) or not ingredient.concerns(case):
                continue
            if ingredient.reached and name not in done[ALL][case]["reached"]:
                continue
            patches = list(ingredient.patches)
            if ingredient.effect == DEPTH:
                patches.append((recover, "confidence_of", _no_confidence))
            known = case_of(case)  # its images are made with everything on
            with without(patches):
                found = run(known, backend)
            row = figures(known, found.depth, found.confidence)
            keep(name, case, {"rmse": row["rmse"]} if ingredient.effect == DEPTH else row)
    return done


def surface_of(case: str) -> str:
    group, surface, _ = case.split(" ", 2)
    return f"{group} {surface}" if group in ("terrain", "large") else surface


def changes(done: dict[str, dict[str, dict]], name: str, what: str, least: float) -> tuple[list, list, float]:
    """(surfaces that are worse without, surfaces that are better, geometric mean of without / with) of a
    figure that is better if it is small.
    """
    worse, better, ratios = set(), set(), []
    for case, row in done.get(name, {}).items():
        if what not in row:
            continue
        own, other = done[ALL][case][what], row[what]
        ratios.append(math.log(max(other, least) / max(own, least)))
        if abs(other - own) > least and max(own, other) > WORSE * min(own, other):
            (worse if other > own else better).add((surface_of(case), case))
    only = [sorted({surface for surface, _ in group}) for group in (worse, better)]
    return only[0], only[1], math.exp(sum(ratios) / max(1, len(ratios)))


def report(done: dict[str, dict[str, dict]], backend: str) -> str:
    """The table, in Markdown, with machine and date."""
    lines = [
        f"{platform.machine()}, {os.cpu_count()} cores, {backend}, {datetime.date.today()}.",
        "",
        "| without | cases | RMSE | worse | better | Brier | worse | better | half / all | worse | better |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in INGREDIENTS:
        if name not in done:
            continue
        cells = [name, str(len(done[name]))]
        for what, least in LEAST.items():
            if INGREDIENTS[name].effect == (CONFIDENCE if what == "rmse" else DEPTH):
                cells += ["", "", ""]
                continue
            worse, better, ratio = changes(done, name, what, least)
            cells += [f"{ratio:.2f}", str(len(worse)), str(len(better))]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(names: str, backend: str, out: Path) -> None:
    """Measures what is not in ``out`` yet, and writes the table beside it."""
    chosen = list(INGREDIENTS) if names == "all" else names.split(",")
    if unknown := set(chosen) - set(INGREDIENTS):
        raise SystemExit(f"--without {', '.join(sorted(unknown))}: not among {', '.join(INGREDIENTS)}")
    done = measure(chosen, backend, out / "recover_without.json")
    (out / "recover_without.md").write_text(report(done, backend))
