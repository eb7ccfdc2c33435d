"""What half and twice of constants of refinement do, on random pairs with their truth.

    python performance/constants.py [--pairs 6] [--size 128] [--seed N] [--backend opencl] [--only PART]

For each constant the errors over the tolerance at its half, itself and its double, on pairs of the kind that
it concerns: how many are within, the median and the largest; beyond 1.5 without a warning; and the time over
that with the constant as it is. The truth of a pair is found once. Six pairs of each kind take some ten
minutes on two cores.
"""

import argparse
import importlib
import os
import time
from dataclasses import replace

import numpy as np
from pairs import pair, truth
from plans import relative_errors
from refinement import estimated, least_light

import skylamp as sl
from skylamp.backends import select
from skylamp.samples import Samples
from skylamp.sources.integrals import Integrals

TOLERANCE, NODES = 0.01, 400  # asked for; at which an image is judged
SKY, LIGHTS, FINITE = "sky", "sky with small lights", "finite"
CONSTANTS = {  # module and name: on which pairs
    "refinement.ESTIMATE_SHARE": SKY,
    "planning.base.ESTIMATE_SHARE": SKY,
    "samples.SIGMAS": SKY,
    "planning.base.EXACT_ERROR_RATIO": SKY,
    "planning.sky.BEHIND_CLIFFS": SKY,
    "planning.sky.LEAST_SECTORS": LIGHTS,
    "planning.sky.EXACT_SECTOR_MULTIPLE": LIGHTS,
    "planning.sky.SWEPT_SUN": LIGHTS,
    "light.unoccluded.INTEGRATED_AZIMUTHS": SKY,
    "sources.integrals.ROUGH": LIGHTS,
    "sources.integrals.SECTOR_CELL_PARTS": LIGHTS,
    "sources.integrals.BRIGHT": LIGHTS,
    "sources.integrals.LEAST_LEVEL": LIGHTS,
    "sources.integrals.FAINT_PARTS_SHARE": LIGHTS,
    "sources.integrals.INNER": LIGHTS,
    "sources.integrals.DARK_GAP": LIGHTS,
    "refinement.SEEN": FINITE,
    "refinement.ASSUMED_ERROR_RATIO": FINITE,
    "refinement.MOST_ERROR_RATIO": FINITE,
    "planning.finite.LEAST_LIGHT": FINITE,
    "planning.finite.LINE_WIDTH": FINITE,
    "planning.finite.NARROW_RADIUS": FINITE,
    "planning.finite.WINDOWED_PART": FINITE,
    "planning.finite.EXACT_SECTORS": FINITE,
    "planning.finite.CHORD_POINTS": FINITE,
    "light.finite.PARTLY": FINITE,
    "light.slices.MEDIAN_NODES": FINITE,
}


def known_pairs(seed, count, size, backend, kind):
    """The first ``count`` pairs of a kind: scene, source, samples, their light, the least light that errors
    are relative to.
    """
    number = 0
    while count:
        _, ground, _, source, light = pair(seed, number, size)
        number += 1
        if not callable(source.brightness) or isinstance(source, sl.Sky) == (kind == FINITE):
            continue
        if kind != LIGHTS or len(Integrals(source).bright_parts) > 1:
            samples = Samples(select(backend), ground, NODES, first=100_003)
            yield (
                ground,
                source,
                samples,
                truth(samples, ground, source, light),
                least_light(samples, ground, source),
            )
            count -= 1


def judge(pairs, backend):
    """(errors over the tolerance, how many are beyond 1.5 without a warning, seconds)."""
    over, silent, start = [], 0, time.perf_counter()
    for ground, source, samples, exact, least in pairs:
        out = sl.render(
            replace(ground),
            source,
            tolerance=TOLERANCE,
            quantity="irradiance",
            backend=backend,
            interreflection=False,
        )
        over.append(relative_errors(samples, out.image, exact, least)[0] / TOLERANCE)
        silent += over[-1] > 1.5 and np.isnan(estimated(out.warnings))
    return np.array(over), silent, time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(4), "little"))
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--only", help="constants by a part of their names, as sources.integrals")
    args = parser.parse_args()
    print(f"seed {args.seed}, {args.pairs} pairs of a kind, size {args.size}, tolerance {TOLERANCE}")
    print(f"{'constant':40} {'value':>10} within  median    most  silent    time")
    chosen = {name: kind for name, kind in CONSTANTS.items() if not args.only or args.only in name}
    pairs, plain = {}, {}
    for kind in sorted(set(chosen.values())):
        pairs[kind] = list(known_pairs(args.seed, args.pairs, args.size, args.backend, kind))
        judge(pairs[kind], args.backend)  # compiles
        plain[kind] = judge(pairs[kind], args.backend)
    for name, kind in chosen.items():
        module, constant = name.rsplit(".", 1)
        module = importlib.import_module(f"skylamp.{module}")
        usual = getattr(module, constant)
        for value in (usual / 2, usual, 2 * usual):
            value = round(value) if isinstance(usual, int) else value
            setattr(module, constant, value)
            over, silent, seconds = plain[kind] if value == usual else judge(pairs[kind], args.backend)
            print(
                f"{name:40} {value:10.4g} {np.mean(over <= 1):6.0%} {np.median(over):7.3f} {over.max():7.3f}"
                f" {silent:7} {seconds / plain[kind][2]:7.2f}",
                flush=True,
            )
        setattr(module, constant, usual)


if __name__ == "__main__":
    main()
