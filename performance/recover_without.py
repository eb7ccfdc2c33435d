"""What each ingredient of recover(method="robust") is worth: recovers with all, and with all but one.

    python performance/recover.py --without NAME[,NAME...]|all [--backend NAME] [--out FOLDER]

An ingredient is switched off from outside, by another value of a module's function or constant for the time
of a call; the library has no switch for it. Cases: the five surfaces of tests/surfaces.py under four sources,
under a sky with 3 % of noise, and chequered with an albedo that is not given; ten other surfaces under two
sources; terrain and six larger ones.
Results stand in OUT/recover_without.json, and what stands there is not run again. The whole takes about an
hour on two cores.
"""

from __future__ import annotations

import contextlib
import copy
import datetime
import functools
import itertools
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
from skylamp.inverse import confidence, conjugate_gradients, finer_model, lights, multigrid, pyramid, search
from skylamp.inverse.conjugate_gradients import ConjugateGradients
from skylamp.inverse.descent import Solution
from skylamp.inverse.multigrid import Multigrid
from skylamp.inverse.pyramid import Pyramid
from skylamp.inverse.search import Search

recover = sys.modules["skylamp.inverse.recover"]

LARGE = 96  # nodes a side: the smallest of tests and script that is solved by cycles
WORSE = 1.1  # times the RMSE, or the error of confidence, from which an ingredient pays on a surface
FAR = 5.0  # nodes
LEAST = {
    "rmse": 0.01,
    "brier": 0.005,
    "half": 0.01,
    "missed": 0.01,
}  # changes of a figure below these are no changes

Patch = tuple[object, str, Any]


DEPTH, CONFIDENCE, BOTH = "depth", "confidence", "both"


class Ingredient(NamedTuple):
    """patches: what stands for it when it is off. effect: what is measured; if that is confidence alone, the
    search is not run again. only: the cases.
    """

    patches: list[Patch]
    effect: str = DEPTH
    only: Callable[[str], bool] | None = None

    def concerns(self, case: str) -> bool:
        if self.only:
            return self.only(case)
        return self.effect == CONFIDENCE or tells_depth(case) or self.effect == BOTH and is_spot(case)


def without_stage(stage: Callable[[Search], None], instead: Callable[[Search], None] | None = None) -> Patch:
    """Leaves a stage of the search out, or puts another one in its place."""
    put = [instead] if instead else []
    found = [put if own is stage else [own] for own in search.STAGES]
    return search, "STAGES", tuple(itertools.chain(*found))


def without_doubt(doubt: Callable) -> Patch:
    return confidence, "PARTS", tuple(own for own in confidence.PARTS if own is not doubt)


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


def _best_alone(work: Search) -> None:
    """Only the best answer goes to the finer grid."""
    work.answers = [min(work.answers, key=lambda answer: answer.objective)]
    search.compare(work)


def _accepted(work: Search) -> None:
    work.pyramid.accept(work.level, work.answers[0].depth)


def _from_halfway(work: Search) -> None:
    work.begun = work.flat(work.share, work.pyramid.start), work.pyramid.start
    work.answers = [work.multigrid.solve(*work.begun, work.level)]


EXPECT = Pyramid._expect_albedo


def _expect_first(self: Pyramid, level: int, z: np.ndarray) -> None:
    if not self.expected_albedo:
        EXPECT(self, level, z)


def _albedo_held(self: ConjugateGradients, side: int, state: Any) -> None:
    """The product for an albedo that does not follow the step."""
    with mock.patch.object(self, "albedo", None):
        MULTIPLY(self, side, state)


MULTIPLY = ConjugateGradients.multiply
NOTHING = lambda *args, **more: None


is_spot = lambda case: case.endswith("spot")
is_uneven = lambda case: case.endswith(("spot", "sun"))
has_no_albedo = lambda case: case.startswith("albedo")
is_large = lambda case: case.startswith(("terrain", "large"))
is_noisy = lambda case: case.startswith("noise")
tells_depth = lambda case: case.endswith(" sun") and not has_no_albedo(case) or case.startswith("large")
INGREDIENTS = {
    # the search; where other answers come and go, with the effect on confidence
    "starts from elsewhere": Ingredient([without_stage(search.start_shallower)], BOTH),
    "mosaic": Ingredient([without_stage(search.join), (search, "join", NOTHING)], BOTH),
    "mosaic before answers are compared": Ingredient([without_stage(search.join)], BOTH),
    "mosaic after answers were compared": Ingredient([(search, "join", NOTHING)], BOTH),
    "several compared": Ingredient([without_stage(search.compare, _best_alone)], BOTH),
    "mirrored starts": Ingredient([without_stage(search.start_mirrored)], BOTH),
    "directed": Ingredient([(recover, "_directed", lambda light: False)], BOTH, is_spot),
    "strong relief": Ingredient([without_stage(search.start_stronger)], DEPTH, is_large),
    "polish": Ingredient([without_stage(search.polish, _accepted)]),
    "nearest flat": Ingredient([without_stage(search.start_flat, _from_halfway)]),
    "start on a large grid": Ingredient(
        [(pyramid, "grid_of_starts", lambda shapes: len(shapes) - 1)], DEPTH, is_large
    ),
    "continuation at the start": Ingredient([(multigrid, "FROM_STIFF", ())]),
    "continuation on finer grids": Ingredient(
        [(multigrid, "FROM_COARSER", ()), (search, "FROM_COARSER", ())]
    ),
    "more cycles under skies": Ingredient([(multigrid, "MORE_UNDER_SKIES", 0)], DEPTH, is_large),
    "least on large": Ingredient([(pyramid, "LEAST_ON_LARGE", pyramid.LEAST_SMOOTHNESS)], DEPTH, is_large),
    "cycles": Ingredient([(Multigrid, "cycles", _relaxed)], DEPTH, is_large),
    "stiff cycles": Ingredient([(multigrid, "CYCLE_SMOOTHNESS", 1e-9)], DEPTH, is_large),
    "noise": Ingredient([(pyramid, "noise_of_all", lambda *_: 0.0)], DEPTH, is_noisy),
    "prior of the coarser grid": Ingredient([(Pyramid, "set_prior", NOTHING)], DEPTH, is_noisy),
    "cubic interpolation": Ingredient(
        [(module, "cubic", _linear) for module in (pyramid, multigrid, finer_model)]
    ),
    "azimuths of equal light": Ingredient(
        [(lights.sources, "azimuth_profile", NOTHING)], DEPTH, lambda case: case.endswith("sun")
    ),
    "albedo projected": Ingredient([(ConjugateGradients, "multiply", _albedo_held)], DEPTH, has_no_albedo),
    "albedo expected anew": Ingredient([(Pyramid, "_expect_albedo", _expect_first)], BOTH, has_no_albedo),
    "close accuracy": Ingredient([(multigrid, "CLOSE", multigrid.LOOSE)], BOTH, is_spot),
    "last accuracy": Ingredient([(multigrid, "LAST", multigrid.CLOSE)]),
    "preconditioner's coarse grids": Ingredient(
        [(conjugate_gradients, name, 1e30) for name in ("BROAD", "BROADER")]
    ),
    # confidence
    "rivals": Ingredient([without_doubt(confidence.by_rivals)], CONFIDENCE),
    "posterior deviation": Ingredient(
        [(confidence, "by_noise", lambda pyramid, level, z, misfit: np.zeros(z.shape))], CONFIDENCE
    ),
    "finer model": Ingredient([without_doubt(confidence.by_finer_model)], CONFIDENCE),
    "creases": Ingredient([without_doubt(confidence.by_creases)], CONFIDENCE),
    "second refit": Ingredient([(finer_model, "REFITS", 1)], CONFIDENCE),
    "even albedo": Ingredient(
        [(confidence, "by_even_albedo", lambda pyramid, level, z: np.zeros(z.shape))],
        CONFIDENCE,
        has_no_albedo,
    ),
    "poor fit": Ingredient([(confidence, "MISFIT_WEIGHT", 0.0)], CONFIDENCE),
    "other answers": Ingredient([without_doubt(confidence.by_other_answers)], CONFIDENCE, is_uneven),
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


def figures(case: Case, depth: np.ndarray, sure: np.ndarray) -> dict[str, float]:
    """RMSE [nodes]; the mean squared difference between confidence and whether a pixel is within the depth
    that is worth half of it (Brier's score); of the pixels that are FAR off, the share that is trusted; RMSE
    of the confident half over that of all.
    """
    error = np.abs(depth - case.truth)
    within = error < max(confidence.RIGHT * case.layers, confidence.LEAST_RIGHT)
    half = np.argsort(-sure.ravel(), kind="stable")[: sure.size // 2]
    return {
        "rmse": rms(error),
        "missed": float(np.mean(sure[error > FAR] >= 0.5)) if (error > FAR).any() else 0.0,
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
        interreflection=False,
    )


def run_with_all(name: str, backend: str) -> dict[str, dict]:
    """By ingredient: figures with all, and without each ingredient of confidence."""
    case, sure = case_of(name), {}
    own = recover.judgement_of

    def several_judgements(solved: Multigrid, *rest: Any) -> confidence.Judgement:
        for key, ingredient in INGREDIENTS.items():
            if ingredient.effect == CONFIDENCE and ingredient.concerns(name):
                pyramid, clone = copy.copy(solved.pyramid), copy.copy(solved)
                pyramid.problems, pyramid.albedo = dict(pyramid.problems), list(pyramid.albedo)
                clone.pyramid = pyramid
                with without(ingredient.patches):
                    sure[key] = confidence.confidence_of(own(clone, *rest).std, rest[-1])
        return own(solved, *rest)

    with without([(recover, "judgement_of", several_judgements)]):
        found = run(case, backend)
    sure[ALL] = found.confidence
    return {key: figures(case, found.depth, each) for key, each in sure.items()}


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
            patches = list(ingredient.patches)
            if ingredient.effect == DEPTH:
                patches.append((confidence, "PARTS", ()))  # the standard deviation is not asked for
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
    """The table, in Markdown, with machine and date. What older files name and the library has no more is
    there as gone.
    """
    lines = [
        "# What each ingredient of recover is worth",
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, {backend}, {datetime.date.today()}."
        " Made by `performance/recover.py --without`.",
        "",
        "Every ingredient of `method='robust'` was left out alone. For each figure: the geometric mean of"
        " what it is without, over what it is with; the number of surfaces on which it is at least 10 % worse"
        " without; and on which it is as much better. rmse: of depth. brier: mean squared difference between"
        " the confidence and whether a pixel is right. half: rmse of the confident half over that of all."
        f" missed: of the pixels that are {FAR:g} nodes off, the share that is trusted, in cases where"
        " that was measured. Empty: not measured,"
        " or unchanged by its nature.",
        "",
        "| without | cases | " + " | ".join(f"{what} | worse | better" for what in LEAST) + " |",
        "|---|---|" + "---|---|---|" * len(LEAST),
    ]
    for name in sorted(set(done) - {ALL}, key=lambda name: (name not in INGREDIENTS, name)):
        cells = [name if name in INGREDIENTS else f"{name} (gone)", str(len(done[name]))]
        for what, least in LEAST.items():
            of_confidence = name in INGREDIENTS and INGREDIENTS[name].effect == CONFIDENCE
            if what == "rmse" and of_confidence or all(what not in row for row in done[name].values()):
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
