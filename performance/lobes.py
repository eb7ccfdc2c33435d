"""Errors of specular lobes under uneven sources, at several tolerances and without refinement.

    python performance/lobes.py [--backend opencl] [--seed 5] [--noise 14]

Each line: source, exponent, tolerance; errors by once the slices and as rendered (RMS over the mean, of the
whole image) against 11 times the slices, which no render takes; seconds of both; warnings.

With --noise: wide lobes over level, tilted and hilly ground under so many skies of noise. Each line: the
share of the tolerance that the first difference may be (renderer.FIRST_SHARE), tolerance; share of the images
that are beyond the tolerance, number beyond three times it without a warning, largest error over the
tolerance; slices, in those of once.
"""

import argparse
import time

import numpy as np
from plans import fractal

import skylamp as sl
from skylamp import renderer

EXPONENTS, TOLERANCES, FINEST = (5, 50, 600), (0.01, 0.003), 11
WIDE, TRUE = (0, 1, 3, 10, 40), 20  # exponents, and times the slices of the truth, under skies of noise


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


def noisy_sky(number):
    """Three kinds in turn: noise of log-normal pixels, coarser and more of it, and a few bright pixels."""
    rng = np.random.default_rng(number + 100)
    if number % 3 == 0:
        return sl.Sky(sl.environment_map(np.exp(rng.standard_normal((16, 32)))))
    if number % 3 == 1:
        return sl.Sky(
            sl.environment_map(np.exp(1.5 * rng.standard_normal((8, 16))).repeat(2, 0).repeat(2, 1))
        )
    return sl.Sky(sl.environment_map(1 + 3.0 * (rng.random((32, 64)) > 0.9)))


def kept(blurred):
    """``blurred`` of one source, each table made once."""
    made = {}

    def table(source, *options):
        if options not in made:
            made[options] = blurred(source, *options)
        return made[options]

    return table


def of_noise(backend, count):
    """Prints what the difference of the first two images decides on."""
    blurred = renderer.blurred
    numbers = [*renderer.LOBE_FINENESS, TRUE]
    y, x = np.mgrid[:24, :24]
    grounds = np.zeros((8, 8)), 0.4 * x[:8, :8] - 0.3 * y[:8, :8], 2 * np.sin(x / 3) * np.cos(y / 4)
    every = []  # (errors, differences from the number before) over the mean, by number of slices
    for sky in map(noisy_sky, range(count)):
        renderer.blurred = kept(blurred)
        for exponent in WIDE:
            for heights in grounds:
                scene, images = sl.Scene.from_height(heights, reflectance=sl.Phong(0, 1, exponent)), []
                for fineness in numbers:
                    renderer._refined_lobe = lambda call, grey, lobe_of, *shares: lobe_of(grey, fineness)  # noqa: B023
                    image = sl.render(
                        scene, sky, tolerance=0.01, interreflection=False, backend=backend
                    ).image
                    images.append(np.asarray(image, float))
                rms = lambda a, b: np.sqrt(np.mean((a - b) ** 2)) / images[-1].mean()  # noqa: B023
                pairs = zip(images, images[1:-1], numbers, numbers[1:])
                off = [rms(b, a) / np.hypot(1, m / n) for a, b, n, m in pairs]
                every.append(([rms(image, images[-1]) for image in images[1:-1]], off))
    for share in (1, 1 / 2, 1 / 3, 1 / 5):
        for tolerance in (0.01, 0.003, 0.001):
            found, slices = [], 0
            for errors, off in every:
                fits = [o <= tolerance * (1 if n else share) for n, o in enumerate(off)]
                n = fits.index(True) if any(fits) else len(fits) - 1
                found.append((errors[n] / tolerance, fits[n]))
                slices += sum(numbers[: n + 2]) / len(every)
            beyond = np.array([error for error, _ in found])
            worst = sum(error > 3 and fits for error, fits in found)
            print(
                f"share {share:.2f}, {tolerance}: beyond {np.mean(beyond > 1):.1%}, three times {worst},"
                f" most {beyond.max():.1f}; slices {slices:.2f}"
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--noise", type=int, default=0, metavar="SKIES")
    args = parser.parse_args()
    if args.noise:
        return of_noise(args.backend, args.noise)
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
