"""By how much the light of a sun is wrong above swept horizons, against the same above exact ones.

    python performance/swept_suns.py [--pairs 150] [--size 128] [--seed N] [--backend opencl]

Random ground of pairs.py, and a sun of 0.1 to 14 degrees radius at 1 to 60 degrees elevation, in the same
sectors both times. Prints the RMS error over the mean light of the sun for each pair, and the share of
pairs within some errors: SWEPT_SUN of host/planning/sky.py.
"""

import argparse
import os

import numpy as np
from pairs import axis_of, height

import skylamp as sl
from skylamp.backends import select
from skylamp.light.horizon import Horizons
from skylamp.sources.integrals import Integrals

SKY = 1e-3  # brightness of the sky round a sun whose irradiance, facing it, is 1
AZIMUTHS, SECTORS = 4, 8


def error_of(rng, size, engine):
    """(ground, elevation and radius [degree], RMS error over the mean); None where the sun is no part."""
    what, z = height(rng, size)
    elevation, radius = np.exp(rng.uniform(np.log([1, 0.1]), np.log([60, 14])))
    axis = axis_of(*np.radians([rng.uniform(0, 360), elevation]))
    cosine = np.cos(np.radians(radius))
    light = 1 / (2 * np.pi * (1 - cosine))
    sky = Integrals(sl.Sky(lambda L: SKY + light * (L @ axis >= cosine), suns=[tuple(axis)]))
    if len(sky.bright_parts) != 1:
        return None
    scene = sl.Scene.from_height(z.astype(np.float32), 1.0)
    swept, exact = (
        Horizons(engine, scene, sky, AZIMUTHS, SECTORS, exact_parts=exactly).irradiance()
        for exactly in (False, True)
    )
    return what, elevation, radius, np.sqrt(np.mean((swept - exact) ** 2)) / exact.mean()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=150)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(4), "little"))
    parser.add_argument("--backend", default="auto")
    given = parser.parse_args()
    print(f"seed {given.seed}, {given.pairs} pairs, size {given.size}")
    rng, engine = np.random.default_rng(given.seed), select(given.backend)
    errors = []
    for _ in range(given.pairs):
        found = error_of(rng, given.size, engine)
        if found is not None:
            print("{:10} elevation {:5.2f} radius {:5.2f} error {:.4f}".format(*found), flush=True)
            errors.append(found[-1])
    print(f"most {max(errors):.3f}")
    for bound in (0.03, 0.06, 0.1, 0.2):
        print(f"within {bound}: {np.mean(np.array(errors) <= bound):.1%} of {len(errors)}")


if __name__ == "__main__":
    main()
