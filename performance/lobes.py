"""Errors of specular lobes under uneven sources, at several tolerances and without refinement.

    python performance/lobes.py [--backend opencl] [--seed 5]

Each line: source, exponent, tolerance; errors by once the slices and as rendered (RMS over the mean, of the
whole image) against 11 times the slices, which no render takes; seconds of both; warnings.
"""

import argparse
import time

import numpy as np
from plans import fractal

import skylamp as sl
from skylamp import renderer

EXPONENTS, TOLERANCES, FINEST = (5, 50, 600), (0.01, 0.003), 11


def step(L):
    return 0.1 + (L[..., 0] > 0.1)


def patch(L):
    return 0.2 + 5.0 * (0.3 * L[..., 0] - 0.95 * L[..., 2] > 0.9)


def stripes(L):
    return 1 + np.sign(np.sin(9 * L[..., 0] + 4 * L[..., 1]))


def sources(rng):
    """(name, source) of skies, a window and a sphere."""
    noise = sl.environment_map(rng.lognormal(0, 1, (32, 64)))
    clear = sl.cie_clear((135, 30), horizontal=90)
    for name, L in (("step", step), ("stripes", stripes), ("spot", sl.cosine_power(30, (0.3, 0.1, 1)))):
        yield f"window {name}", sl.Window(x=(10, 30), y=(5, 25), brightness=L)
        yield f"sphere {name}", sl.Lamp((20, 20, -9), 6, brightness=L)
    for name, L in (
        ("even", 1.0),
        ("step", step),
        ("patch", patch),
        ("stripes", stripes),
        ("noise", noise),
        ("clear", clear),
        ("overcast", sl.cie_overcast()),
    ):
        yield f"sky {name}", sl.Sky(L)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--seed", type=int, default=5)
    args = parser.parse_args()
    rng, chosen = np.random.default_rng(args.seed), renderer._refined_lobe
    depth = fractal(48, 0.6, 1.8, args.seed)
    depth = depth - depth.min() + 2

    def render(source, exponent, tolerance, fineness=None):
        """(image, seconds, warnings), by a number of slices unless the tolerance chooses."""
        by = lambda call, grey, lobe_of, *shares: lobe_of(grey, fineness)
        renderer._refined_lobe = chosen if fineness is None else by
        scene, begin = sl.Scene(depth, reflectance=sl.Phong(0.3, 0.4, exponent)), time.perf_counter()
        out = sl.render(scene, source, tolerance=tolerance, interreflection=False, backend=args.backend)
        return np.asarray(out.image), time.perf_counter() - begin, out.warnings

    for name, source in sources(rng):
        for exponent in EXPONENTS:
            exact, _, _ = render(source, exponent, min(TOLERANCES) / 3, FINEST)
            error = lambda image: 100 * np.sqrt(np.mean((image - exact) ** 2)) / exact.mean()  # noqa: B023
            once, before, _ = render(source, exponent, TOLERANCES[0], 1)
            for tolerance in TOLERANCES:
                image, seconds, warnings = render(source, exponent, tolerance)
                print(
                    f"{name:15} n={exponent:<4} {tolerance:<6} once {error(once):.3f} %, as rendered"
                    f" {error(image):.3f} %; {before:.2f}, {seconds:.2f} s",
                    *warnings,
                )


if __name__ == "__main__":
    main()
