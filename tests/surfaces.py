"""Continuous surfaces for the inverse problem, and images of them on a finer grid than the one that is to be
recovered.

A surface is sampled FINER times as finely as the image, in the same box, rendered there with many azimuths,
and every FINER-th node is kept: horizons, walls and normals are nearly those of the continuous surface. It is
skylamp's own horizon method that renders (method="horizon", 64 or 128 azimuths): another grid and another
sampling of azimuths than recover() uses, but not another model. What the two share by mistake these images
cannot show; tests/test_oracle_horizons.py can.
"""

import functools

import numpy as np

import skylamp as sl
from skylamp.backends import select
from skylamp.io import files as io
from skylamp.light.interreflection import Bounces, Round
from skylamp.samples import Samples

# of light between surfaces: without the last of them, an image of folds changes by 0.08 % (rms)
ROUNDS = (Round(8, 2, 8, 0.25),) * 8 + (Round(64, 1, 64, 0.05),) * 3 + (Round(128, 1, 64, 0.05),)
SIZE, FINER, ALBEDO, LAYERS = 64, 5, 0.8, 64


def _fractal(x, y):
    rng, out = np.random.default_rng(3), 0
    for wave in range(1, 28):
        for _ in range(4):
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            out = out + wave**-1.6 * np.cos(
                2 * np.pi * wave * (x * np.cos(angle) + y * np.sin(angle)) / 100 + phase
            )
    return 20 * (out - out.min()) / np.ptp(out)


def _face(x, y):
    r = np.hypot((x - 32) / 24, (y - 32) / 28)
    z = 18 - 14 * np.exp(-((r / 0.8) ** 4))
    z = z - 5 * np.exp(-(((x - 32) / 5) ** 2) - ((y - 35) / 8) ** 2)
    for eye in (22, 42):
        z = z + 3 * np.exp(-(((x - eye) / 5) ** 2) - ((y - 25) / 4) ** 2)
    return z


SURFACES = {
    "plane": lambda x, y: 20 * (0.8 * x + 0.2 * y) / 64,
    "bumps": (
        lambda x, y: (
            20
            - sum(
                h * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * w * w))
                for u, v, w, h in ((18, 20, 7, 16), (44, 16, 6, 11), (30, 46, 9, 19), (52, 46, 5, 9))
            )
        )
    ),
    "egg-crate": lambda x, y: 9 - 9 * np.sin(2 * np.pi * x / 32) * np.sin(2 * np.pi * y / 32),
    "fractal": _fractal,
    "face": _face,
}
_RNG = np.random.default_rng(11)
_WAVES = [(w, _RNG.uniform(0, 2 * np.pi), _RNG.uniform(0, 2 * np.pi)) for w in range(1, 12) for _ in range(3)]
# ten that no constant was chosen by: performance/recover.py --without
OTHERS = {
    "pits": lambda x, y: sum(
        h * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * w * w))
        for u, v, w, h in ((16, 44, 6, 14), (40, 18, 8, 20), (50, 50, 5, 12))
    ),
    "ripples": lambda x, y: 10 + 5 * np.cos(2 * np.pi * np.hypot(x - 32, y - 32) / 14),
    "folds": lambda x, y: 20 * np.sin(x / 9.6 + 1.2 * np.sin(y / 15)) ** 2,
    "scarp": lambda x, y: 9 * np.tanh((x - 32 + 6 * np.sin(y / 10)) / 3),
    "cone": lambda x, y: 20 * np.minimum(np.hypot(x - 30, y - 34) / 26, 1),
    "saddle": lambda x, y: 9 * (((x - 32) / 32) ** 2 - ((y - 32) / 32) ** 2),
    "valley": lambda x, y: 20 - 20 * np.abs(x - 32 - 0.3 * (y - 32)) / 42,
    "bowl": lambda x, y: 20 * np.maximum(1 - ((x - 32) ** 2 + (y - 30) ** 2) / 28**2, 0),
    "crater": lambda x, y: 16 - 16 * np.exp(-(((np.hypot(x - 33, y - 31) - 17) / 5) ** 2)),
    "hills": lambda x, y: (
        2.5 * sum(np.cos(w * (x * np.cos(a) + y * np.sin(a)) / 18 + p) / w for w, a, p in _WAVES)
    ),
}
SUN = np.array([0.5, 0.3, -0.81]) / np.linalg.norm([0.5, 0.3, 0.81])
MIDDLE = (SIZE - 1) / 2
SOURCES = {
    "sky": sl.Sky(),
    "sun": sl.Sky(lambda L: 0.3 + 12 * np.exp(60 * (L @ SUN - 1))),
    "lamp": sl.Lamp(center=(MIDDLE, MIDDLE, -6), radius=8),
    "spot": sl.Lamp(center=(MIDDLE, MIDDLE, -6), radius=8, brightness=sl.cosine_power(10)),
}


@functools.cache
def pair(name, kind, size=SIZE, interreflection=False):
    """(depth, image), (size, size) float64: the truth at the nodes and its radiance, in a dark box. Light
    between surfaces is gathered more exactly than render() does with a method that is given.
    """
    at = (np.arange(size * FINER) + 0.5) / FINER - 0.5
    x, y = np.meshgrid(at * SIZE / size, at * SIZE / size)
    depth = (SURFACES | OTHERS)[name](x, y) * size / SIZE
    depth = depth - depth.min() + 20 * size / SIZE
    source = SOURCES[kind]
    if isinstance(source, sl.Lamp):  # seen from the fine grid's first node, which lies outside the image's
        scale, off = size / SIZE, (FINER - 1) / 2 / FINER
        middle = (size - 1) / 2 + off
        source = sl.Lamp(
            center=(middle, middle, source.center[2] * scale),
            radius=source.radius * scale,
            brightness=source.brightness,
        )
    azimuths = 128 if isinstance(source, sl.Sky) else 64
    scene = sl.Scene(depth, 1 / FINER, ALBEDO, sides="dark")
    render = functools.partial(
        sl.render, scene, method="horizon", quantity="irradiance", interreflection=False, backend="auto"
    )
    image = render(source, azimuths=azimuths).image
    if interreflection:
        share_of_sky = render(sl.Sky(1 / np.pi), azimuths=128).image
        engine = select("auto")
        bounces = Bounces(engine, scene, Samples(engine, scene, 1, 1), [image], [ALBEDO], share_of_sky)
        bounces.run(ROUNDS)
        (image,) = bounces.irradiance()
    pick = slice(FINER // 2, None, FINER)
    return depth[pick, pick], ALBEDO / np.pi * image[pick, pick].astype(float)


def source_of(kind, size=SIZE):
    """The source of :func:`pair`, in the image's own nodes."""
    source, scale = SOURCES[kind], size / SIZE
    if isinstance(source, sl.Sky):
        return source
    return sl.Lamp(
        center=((size - 1) / 2, (size - 1) / 2, source.center[2] * scale),
        radius=source.radius * scale,
        brightness=source.brightness,
    )


def terrain(size, heights=1.0, row=40, col=60):
    """Depth [nodes] of a crop of the Jacksboro fault with scaled heights; mirrored where the map ends."""
    height, spacing = io.terrain()
    height = np.asarray(height, float)
    if size > 512:
        height = np.kron(height, np.ones((2, 2)))
    height = np.pad(
        height,
        [(0, max(0, size + off - side)) for side, off in zip(height.shape, (row, col))],
        mode="reflect",
    )
    crop = heights * height[row : row + size, col : col + size] / spacing
    return crop.max() - crop + 2


def lamp_over(size):
    """An isotropic lamp over the middle of a terrain."""
    return sl.Lamp(center=((size - 1) / 2, (size - 1) / 2, -0.4 * size), radius=size / 8)


def image_of(depth, source):
    """Radiance (rows, cols) float64 in a dark box, by 128 azimuths on the grid of the depth itself."""
    return sl.render(
        sl.Scene(depth, albedo=ALBEDO, sides="dark"), source, method="horizon", azimuths=128
    ).image.astype(float)


def compared(depth, found):
    """(correlation, median angle between normals [degree]) of two depth maps."""
    normals = [
        np.stack([*np.gradient(np.asarray(z, float))[::-1], -np.ones(z.shape)], -1) for z in (depth, found)
    ]
    a, b = (n / np.linalg.norm(n, axis=-1, keepdims=True) for n in normals)
    return float(np.corrcoef(np.ravel(depth), np.ravel(found))[0, 1]), float(
        np.degrees(np.median(np.arccos(np.clip((a * b).sum(-1), -1, 1))))
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def fine(seed, blur, size=32):
    """(depth, on the finer grid too) of random relief of 6 nodes, 4 below the viewer, whose finest waves are
    close to those that the grid can hold, the closer the smaller ``blur`` [nodes] is.
    """
    waves = np.fft.fft2(np.random.default_rng(seed).standard_normal((size, size)))
    numbers = np.fft.fftfreq(size)
    waves *= np.exp(-20 * (blur * np.hypot(numbers[:, None], numbers)) ** 2)
    finer, at = np.zeros((FINER * size,) * 2, complex), np.rint(size * numbers).astype(int)
    finer[np.ix_(at, at)] = waves
    relief = np.fft.ifft2(finer).real
    finer = 4 + 6 * (relief - relief.min()) / np.ptp(relief)
    return finer[::FINER, ::FINER], finer


def fine_image(finer, light, albedo=0.5):
    """Direct light of the grid's nodes on such relief, in a box."""
    scene = sl.Scene(finer, spacing=1 / FINER, albedo=albedo, sides="dark")
    image = sl.render(scene, light, method="horizon", azimuths=64, interreflection=False).image
    return np.asarray(image[::FINER, ::FINER], float)
