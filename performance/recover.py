"""Depth from images: how accurate, how stable, how fast. Writes recover.json.

    python performance/recover.py [--backend NAME] [--sizes 64,256] [--seeds 4] [--out FOLDER]
        [--what accuracy,stability,albedo,between,suspected,fine,terrain,speed]
    python performance/recover.py --without NAME[,NAME...]|all [--backend NAME] [--out FOLDER]

Surfaces and images are those of tests/surfaces.py: continuous surfaces, rendered five times as finely in a
box with dark sides. RMSE in layers (nodes), of a range of 64. "paper" is method="paper" at the eps that is
best for each surface with the truth in hand. --without: see performance/recover_without.py.
"""

import argparse
import importlib
import itertools
import json
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import record
import recover_without
import surfaces
from surfaces import ALBEDO, LAYERS, SURFACES, pair, rms, source_of

import skylamp as sl
from skylamp.inverse import diagnostics
from skylamp.inverse.pyramid import IMAGE_RMS

recovery = importlib.import_module("skylamp.inverse.recover")  # skylamp.inverse.recover is the function too
EXPLAINED = recovery._explained
EPS = (0.002, 0.01, 0.02, 0.05, 0.1)


def robust(image, source, backend, **more):
    more = {"interreflection": False, **more}
    return sl.recover(image, source, ALBEDO, "dark", layers=LAYERS, backend=backend, **more)


def best_paper(image, source, depth, backend):
    return min(
        rms(
            sl.recover(
                image, source, ALBEDO, "dark", layers=LAYERS, method="paper", eps=eps, backend=backend
            ).depth
            - depth
        )
        for eps in EPS
    )


def accuracy(backend):
    """RMSE by source and surface, and whether the confidence tells."""
    for kind in surfaces.SOURCES:
        for name in SURFACES:
            depth, image = pair(name, kind)
            found = robust(image, source_of(kind), backend)
            error, sure = np.abs(found.depth - depth), found.confidence >= np.median(found.confidence)
            marked, wrong, right = (found.confidence < 0.5) | found.ambiguous, error > 5, error < 2
            yield {
                "source": kind,
                "surface": name,
                "robust": rms(error),
                "paper": best_paper(image, source_of(kind), depth, backend),
                "confident half": rms(error[sure]),
                "the rest": rms(error[~sure]),
                "wrong by 5, marked": float(marked[wrong].mean()) if wrong.any() else None,
                "right within 2, marked": float(marked[right].mean()) if right.any() else None,
                "seconds": found.seconds,
            }
    for name in SURFACES:
        (depth, spot), (_, sky) = pair(name, "spot"), pair(name, "sky")
        two = robust([spot, sky], [source_of("spot"), source_of("sky")], backend)
        prior = robust(spot, source_of("spot"), backend, near=np.maximum(depth - 6, 0), far=depth + 6)
        yield {
            "source": "spot and sky",
            "surface": name,
            "robust": rms(two.depth - depth),
            "seconds": two.seconds,
        }
        yield {
            "source": "spot, depth known to 6",
            "surface": name,
            "robust": rms(prior.depth - depth),
            "seconds": prior.seconds,
        }


def disturbed(image, what, rng):
    if what.startswith("noise"):
        return np.maximum(
            image + float(what.split()[1]) / 100 * image.max() * rng.normal(size=image.shape), 0
        )
    if what == "8 bits":
        return np.rint(image / image.max() * 255) / 255 * image.max()
    return image * 1.05  # an albedo 5 % too low


def stability(backend):
    """(rms change of depth / layers) / (rms change of image / maximum), under a uniform sky."""
    for name in SURFACES:
        depth, image = pair(name, "sky")
        clean = robust(image, sl.Sky(), backend).depth
        carved = sl.recover(
            image, sl.Sky(), ALBEDO, "dark", layers=LAYERS, method="paper", backend=backend
        ).depth
        for what in ("noise 1 %", "noise 3 %", "8 bits", "albedo 5 %"):
            other = disturbed(image, what, np.random.default_rng(5))
            change = rms(other - image) / image.max()
            found = robust(other, sl.Sky(), backend).depth
            again = sl.recover(
                other, sl.Sky(), ALBEDO, "dark", layers=LAYERS, method="paper", backend=backend
            ).depth
            yield {
                "surface": name,
                "disturbance": what,
                "robust": rms(found - clean) / LAYERS / change,
                "paper": rms(again - carved) / LAYERS / change,
                "RMSE / clean RMSE": rms(found - depth) / rms(clean - depth),
            }


def real(backend, size=256):
    """Real terrain, its heights as they are and raised, rendered on its own grid."""
    for kind, source in (
        ("lamp", surfaces.lamp_over(size)),
        ("sun", source_of("sun")),
        ("sky", source_of("sky")),
    ):
        for heights in (1, 2, 4):
            depth = surfaces.terrain(size, heights)
            found = sl.recover(
                surfaces.image_of(depth, source),
                source,
                ALBEDO,
                "dark",
                layers=int(np.ceil(1.2 * depth.max())),
                backend=backend,
                interreflection=False,
            )
            correlation, angle = surfaces.compared(depth, found.depth)
            yield {
                "source": kind,
                "heights": heights,
                "correlation": correlation,
                "median normal error, degrees": angle,
                "RMSE": rms(found.depth - depth),
                "relief": float(np.ptp(depth)),
                "residual": found.levels[-1].residual,
                "seconds": found.seconds,
            }


def speed(backend, sizes):
    """The hardest: real terrain, heights x 4, under a uniform sky; and the five surfaces."""
    for size in sizes:
        depth = surfaces.terrain(size, 4)
        image = surfaces.image_of(depth, sl.Sky())
        start = time.perf_counter()
        found = sl.recover(
            image,
            sl.Sky(),
            ALBEDO,
            "dark",
            layers=int(np.ceil(depth.max() * 1.2)),
            backend=backend,
            interreflection=False,
        )
        whole = time.perf_counter() - start
        yield {
            "backend": found.backend,
            "surface": "terrain",
            "size": size,
            "seconds": found.seconds,
            "compiling": found.compile_seconds,
            "whole call": whole,
        }
    for name in SURFACES:
        found = robust(pair(name, "sky")[1], sl.Sky(), backend)
        yield {
            "backend": found.backend,
            "surface": name,
            "size": surfaces.SIZE,
            "seconds": found.seconds,
            "compiling": found.compile_seconds,
        }


def albedos(backend):
    """Albedo not given: chequered surfaces, 0.3 and 0.7, seen under two or three sources."""
    y, x = np.indices((surfaces.SIZE, surfaces.SIZE)) // 8
    albedo = np.where((x + y) % 2, 0.7, 0.3)
    for kinds in (("sky", "lamp"), ("sun", "lamp"), ("sky", "sun"), ("sky", "sun", "lamp")):
        for name in SURFACES:
            depth, images = pair(name, "sky")[0], [pair(name, kind)[1] * albedo / ALBEDO for kind in kinds]
            lights = [source_of(kind) for kind in kinds]
            options = {"layers": LAYERS, "backend": backend, "interreflection": False}
            found = sl.recover(images, lights, None, "dark", **options)
            known = sl.recover(images, lights, albedo, "dark", **options)
            error, doubted = np.abs(found.depth - depth), found.confidence < 0.5
            yield {
                "sources": " ".join(kinds),
                "surface": name,
                "RMSE": rms(error),
                "RMSE, albedo given": rms(known.depth - depth),
                "albedo off, RMS": rms(found.albedo - albedo),
                "wrong by 2, marked": float(doubted[error > 2].mean()) if (error > 2).any() else None,
                "right within 1, marked": float(doubted[error < 1].mean()),
                "seconds": found.seconds,
            }


def between(backend):
    """Images with light between surfaces and images without, as "auto" takes them and by direct light."""
    for kind in ("sky", "sun", "lamp"):
        for name in (*SURFACES, *surfaces.OTHERS):
            row = {"source": kind, "surface": name}
            for what, light in (("direct", False), ("all", True)):
                depth, image = pair(name, kind, interreflection=light)
                auto = robust(image, source_of(kind), backend, interreflection="auto")
                alone = robust(image, source_of(kind), backend)
                row |= {
                    f"{what} light": rms(auto.depth - depth),
                    f"{what} light, by direct light": rms(alone.depth - depth),
                    f"{what} light, taken": "all" if auto.interreflection else "direct",
                    f"{what} light, residual": auto.levels[-1].residual,
                    f"{what} light, seconds": auto.seconds,
                }
            yield row


def suspected(backend, size=32):
    """What decides on the warnings of residual and doubt, with right arguments and with wrong ones."""
    wrong = {"right": {}, "albedo x 0.5": {"albedo": 0.5 * ALBEDO}, "sides": {"sides": "open"}}
    for kind in ("sky", "sun", "lamp"):
        for name in (*SURFACES, "pits", "ripples", "folds", "scarp", "saddle"):
            _, image = pair(name, kind, size)
            for what, changed in wrong.items():
                given = {"albedo": ALBEDO, "sides": "dark", **changed}
                found = sl.recover(
                    image,
                    source_of(kind, size),
                    layers=LAYERS * size // surfaces.SIZE,
                    backend=backend,
                    interreflection=False,
                    **given,
                )
                level = rms(image)
                yield {
                    "source": kind,
                    "surface": name,
                    "given": what,
                    "residual": rms(found.residual) / level,
                    "too bright": float(np.mean(found.residual < -0.1 * level)),
                    "ambiguous": float(found.ambiguous.mean()),
                    "warnings": [text.split(":")[0].split(" at ")[0] for text in found.warnings],
                }


def fine(backend, sizes, seeds):
    """What tells fine relief from noise: residual over noise, correlation of residuals, and what an answer
    to images without noise leaves.
    """
    images = [("relief", blur, "", 0.0) for blur in (0.7, 0.8, 0.9, 1.0)]
    images += [("both", 0.8, "even", share) for share in (0.05, 0.1)]
    images += [
        ("noise", 2.0, kind, share) for kind in ("even", "root", "as light") for share in (0.03, 0.1, 0.2)
    ]
    lights = {
        "lamp beside": lambda n: sl.Lamp((n / 8, n / 2, -n / 4), radius=3 * n / 32),
        "lamp above": lambda n: sl.Lamp((n / 2, n / 2, -3 * n / 8), radius=n / 8),
        "sky": lambda n: sl.Sky(),
    }
    cases = itertools.product(sizes, range(seeds), lights, images)
    for size, seed, light, (what, blur, kind, share) in cases:
        source = lights[light](size)
        depth, finer = surfaces.fine(seed, blur, size)
        image = surfaces.fine_image(finer, source)
        power = {"": 0, "even": 0, "root": 0.5, "as light": 1}[kind]
        random = np.random.default_rng(seed).standard_normal(image.shape)
        image = np.maximum(image + share * rms(image) ** (1 - power) * image**power * random, 0)
        answers, told, told_by = [], [], diagnostics.is_relief

        def explained(*args, answers=answers, **more):
            answers.append(EXPLAINED(*args, **more))
            return answers[-1]

        def always(pyramid, off, told=told, told_by=told_by):
            told.append((bool(told_by(pyramid, off)), diagnostics.correlation_of(off)))
            return True

        with (
            mock.patch.object(recovery, "_explained", explained),
            mock.patch.object(diagnostics, "is_relief", always),
        ):
            sl.recover(image, source, 0.5, "dark", layers=32, backend=backend, interreflection=False)
        first, second = answers
        yield {
            "size": size,
            "what": what,
            "blur": blur,
            "noise": kind,
            "share": share,
            "seed": seed,
            "light": light,
            "noise taken": first.search.pyramid.noise / IMAGE_RMS,
            "residual": first.levels[-1].residual,
            "residual without noise": second.levels[-1].residual,
            "correlated": told[0][1],
            "is relief": told[0][0],
            "rms": rms(first.z - depth),
            "rms without noise": rms(second.z - depth),
        }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--what", default="accuracy,stability,albedo,terrain,speed")
    parser.add_argument("--sizes", default="64,256")
    parser.add_argument("--seeds", type=int, default=4, help="of fine")
    parser.add_argument("--out", default="docs")
    parser.add_argument("--without", help="what an ingredient is worth: its name, names, or all")
    options = parser.parse_args()
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    if options.without:
        recover_without.main(options.without, options.backend, out)
        return
    done = {}
    for what in options.what.split(","):
        work = {
            "accuracy": accuracy,
            "stability": stability,
            "albedo": albedos,
            "terrain": real,
            "between": between,
            "suspected": suspected,
            "fine": lambda backend: fine(backend, map(int, options.sizes.split(",")), options.seeds),
            "speed": lambda backend: speed(backend, map(int, options.sizes.split(","))),
        }[what]
        done[what] = []
        for row in work(options.backend):
            done[what].append(row)
            print(what, row, flush=True)
            facts = {"measured": record.facts(options.backend), **done}
            (out / "recover.json").write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
