"""RMS error of the lattice under a uniform sky against horizons by brute force; docs/evidence.

The error is that of E / pi, on two random grounds with open sides, rough (rms slope 1) and smooth (0.5). The
reference shares nothing with the library: at each sampled node, every crossing with a grid line along 720
azimuths, and the closed form over elevation. Writes lattice_error.csv (about a minute on two cores):

    python performance/lattice_error.py --out docs
"""

import argparse
import csv
from pathlib import Path

import numpy as np
import record

import skylamp as sl

SIZE, SAMPLES, AZIMUTHS = 256, 1000, 720
GROUNDS = {
    "rough": (1.0, 1.5),
    "smooth": (0.5, 2.5),
}  # rms slope, and the power by which amplitude falls with frequency


def ground(slope, power):
    """Height (SIZE, SIZE) float32: filtered noise of this rms slope."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIZE), np.fft.fftfreq(SIZE)))
    frequency[0, 0] = 1
    noise = np.random.default_rng(1).standard_normal((SIZE, SIZE))
    height = np.fft.ifft2(np.fft.fft2(noise) * frequency**-power * (frequency < 0.5)).real
    return (height * slope / np.sqrt((np.hypot(*np.gradient(height)) ** 2).mean())).astype(np.float32)


def lines(height, rows, cols, dx, dy):
    """Heights of the crossings with columns along (dx, dy), dx = +-1: (steps, nodes), -inf off the map."""
    t = np.arange(1, SIZE)[:, None]
    x, y = cols + np.rint(dx).astype(int) * t, rows + dy * t
    inside = (x >= 0) & (x < SIZE) & (y >= 0) & (y <= SIZE - 1)
    x, low = np.clip(x, 0, SIZE - 1), np.clip(np.floor(y).astype(int), 0, SIZE - 2)
    part = y - low
    return np.where(inside, height[low, x] * (1 - part) + height[low + 1, x] * part, -np.inf)


def reference(height, rows, cols):
    """E / pi at the nodes (rows, cols) under a uniform sky of brightness 1, float64."""
    height = height.astype(float)
    gy, gx = (-g[rows, cols] for g in np.gradient(height))  # of depth
    length = np.sqrt(1 + gx**2 + gy**2)
    here, t = height[rows, cols], np.arange(1, SIZE)[:, None]
    total = np.zeros(len(rows))
    for azimuth in 2 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS:
        c, s = np.cos(azimuth), np.sin(azimuth)
        slopes = [
            ((lines(z, v, u, np.sign(a), b / abs(a)) - here) * abs(a) / t).max(0)
            for z, u, v, a, b in ((height, cols, rows, c, s), (height.T, rows, cols, s, c))
        ]
        along, up = (gx * c + gy * s) / length, 1 / length  # N.L = along cos(elevation) + up sin(elevation)
        low = np.maximum(np.maximum(np.arctan(np.maximum(*slopes)), np.arctan2(-along, up)), 0)
        total += along * (np.pi / 2 - low - np.sin(low) * np.cos(low)) / 2 + up * np.cos(low) ** 2 / 2
    return total * 2 / AZIMUTHS


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hemicubes", type=int, nargs="+", default=[3, 5, 7, 9, 17, 33], help="M, odd")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for lattice_error.csv")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows, cols = np.random.default_rng(0).integers(0, SIZE, (2, SAMPLES))
    found = [("ground", "mean", "M", "directions", "stride", "filled")]
    for name, (slope, power) in GROUNDS.items():
        height = ground(slope, power)
        exact = reference(height, rows, cols)
        for size in options.hemicubes:
            off = [
                sl.render(
                    sl.Scene.from_height(height),
                    sl.Sky(),
                    "lattice",
                    hemicube=size,
                    filled=filled,
                    quantity="irradiance",
                    backend=options.backend,
                ).image[rows, cols]
                / np.pi
                - exact
                for filled in (False, True)
            ]
            errors = [f"{np.sqrt((values**2).mean()):.4f}" for values in off]
            found.append((name, f"{exact.mean():.4f}", size, len(sl.Hemicube(size)), *errors))
            print(*found[-1], flush=True)
    with open(options.out / "lattice_error.csv", "w", newline="") as file:
        file.write(
            record.comment("RMS error of E / pi, uniform sky, 256 x 256 nodes", options.backend) + "\n"
        )
        csv.writer(file, lineterminator="\n").writerows(found)


if __name__ == "__main__":
    main()
