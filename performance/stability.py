"""The stability atlas: for each known failure, error against the parameter that provokes it, for each method.

    python performance/stability.py --out docs [--backend opencl] [--only leak,sun]
    python performance/stability.py --out docs --draw        # the page and its figures from stability.csv

Writes evidence/stability.md, stability.csv and stability-*.png (matplotlib). tests/test_stability.py
measures the same failures at two values each. Errors of images are relative RMS against exact rays, unless a
failure says otherwise; those of depth are RMS in layers.
"""

import argparse
import csv
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import plans
import record

import skylamp as sl

SIZE = 80
LAYERS = 32
Y, X = np.mgrid[:SIZE, :SIZE].astype(float)
UNIFORM = sl.Sky()
EPS = 0.1  # at which the clean image drills nothing
DIRECT = {"interreflection": False}  # what is measured against direct light

RECOVERIES = {
    "paper, eps": {"method": "paper", "stop": "eps"},
    "paper, sign": {"method": "paper", "stop": "sign"},
    "robust": {"method": "robust", **DIRECT},
}


class Failure(NamedTuple):
    """A failure, what provokes it and what skylamp does about it.

    ``measure(value, backend)`` gives the error of every line. ``bad`` fails at ``quick[1]`` and not at
    ``quick[0]``, by ``limit``. ``good`` does not fail there, or ``warns(value, backend)`` gives warnings that
    begin with ``says`` at ``quick[1]`` and not at ``quick[0]``.
    """

    title: str
    parameter: str
    values: tuple
    quick: tuple
    limit: float
    measure: Callable
    bad: str
    does: str
    good: str | None = None
    warns: Callable | None = None
    says: str = ""
    unit: str = "relative RMS error"


def error_of(scene, source, backend, **options):
    samples, exact = truth(scene, source, backend)
    return plans.relative_errors(
        samples,
        sl.render(scene, source, backend=backend, quantity="irradiance", **DIRECT, **options).image,
        exact,
    )[0]


def truth(scene, source, backend):
    return plans.truth(scene, source, backend, 300)


def lines(scene, source, backend, **ways):
    return {
        name.replace("_", " "): error_of(scene, source, backend, **options) for name, options in ways.items()
    }


@functools.cache
def rough(slope=1.0, seed=1):
    return plans.fractal(SIZE, slope, 1.9, seed)


def leak(m, backend):
    found = lines(
        sl.Scene(rough()),
        sl.Sky(),
        backend,
        stride={"method": "lattice", "hemicube": m},
        filled={"method": "lattice", "hemicube": m, "filled": True},
        default={},
    )
    return found


def razor(width, backend):
    depth = np.full((SIZE, SIZE), 25.0)
    for at in range(5, SIZE, 20):
        depth[:, at : at + width] = 0
    return lines(
        sl.Scene(depth),
        sl.Sky(),
        backend,
        stride_M_17={"method": "lattice", "hemicube": 17},
        filled_M_17={"method": "lattice", "hemicube": 17, "filled": True},
        default={},
    )


def valley(deep, backend):
    scene = sl.Scene(np.where(np.abs(X - 40) < 3, float(deep), 0.0)[:, 20:60])
    inside = np.abs(np.arange(20, 60) - 40) < 3
    samples, exact = truth(scene, sl.Sky(), backend)
    some = inside[samples.x]
    exact = exact[some]

    def off(**options):
        image = samples.of(
            sl.render(scene, sl.Sky(), backend=backend, quantity="irradiance", **DIRECT, **options).image
        )[some]
        return float(np.sqrt(np.mean((image - exact) ** 2)) / exact.mean())

    return {
        "lattice, M 9": off(method="lattice", hemicube=9, filled=True),
        "8 azimuths": off(method="horizon", azimuths=8),
        "64 azimuths": off(method="horizon", azimuths=64),
        "tolerance 0.3 %": off(tolerance=0.003),
    }


def small_lamp(radius, backend):
    scene, lamp = sl.Scene(np.full((40, 40), 24.0)), sl.Lamp((20.3, 19.6, 0), radius)
    return lines(
        scene,
        lamp,
        backend,
        lattice_M_9={"method": "lattice", "hemicube": 9, "filled": True},
        lattice_M_33={"method": "lattice", "hemicube": 33, "filled": True},
        slices={"method": "horizon"},
        default={},
    )


def small_lamp_says(radius, backend):
    return sl.render(
        sl.Scene(np.full((40, 40), 24.0)), sl.Lamp((20.3, 19.6, 0), radius), "lattice", backend=backend
    ).warnings


def sunny(radius, elevation):
    return sl.Sky(plans.sun(radius, elevation, 35, 0.6))


def small_sun(radius, backend):
    scene, sky = sl.Scene(rough(0.6)), sunny(radius, 35)
    return lines(
        scene,
        sky,
        backend,
        lattice_M_17={"method": "lattice", "hemicube": 17, "filled": True},
        even_azimuths={"method": "horizon", "azimuths": sl.Azimuths(64)},
        placed_azimuths={"method": "horizon", "azimuths": 64},
        default={},
    )


def grazing(elevation, backend):
    scene, sky = sl.Scene(rough(0.6)), sunny(1.0, elevation)
    return lines(
        scene,
        sky,
        backend,
        lattice_M_17={"method": "lattice", "hemicube": 17, "filled": True},
        even_azimuths={"method": "horizon", "azimuths": sl.Azimuths(32)},
        default={},
    )


def cliff(height, backend):
    depth = plans.urban(2 * SIZE)
    scene, sky = sl.Scene(40 - (40 - depth) * (height / 36)), sl.Sky(plans.sun(0.27, 35, 200, 0.7))
    samples, exact = plans.truth(scene, sky, backend, 600)
    ways = {"six near rows": {"method": "horizon", "azimuths": 64}, "default": {}}
    return {
        name: plans.relative_errors(
            samples,
            sl.render(scene, sky, backend=backend, quantity="irradiance", **DIRECT, **way).image,
            exact,
        )[0]
        for name, way in ways.items()
    }


def between(albedo, backend):
    """Without and with light between surfaces, against the closed form of a spherical bowl."""
    scene, sky, inside = bowl(albedo)
    exact = np.pi * sky / (1 - albedo * (1 - sky))

    def off(**options):
        image = sl.render(scene, sl.Sky(), backend=backend, quantity="irradiance", **options).image[inside]
        return float(np.sqrt(np.mean((image - exact) ** 2)) / exact)

    return {"direct light": off(**DIRECT), "default": off(), "tolerance 0.3 %": off(tolerance=0.003)}


def bowl(albedo):
    """(scene, share of sky that its nodes see, which nodes lie in the bowl, 2 nodes from the rim)."""
    radius, rim = 200.0, np.radians(60)
    half = int(radius * np.sin(rim)) + 1
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    depth = np.maximum(0, np.sqrt(np.maximum(0, radius**2 - x**2 - y**2)) - radius * np.cos(rim))
    return sl.Scene(depth, albedo=albedo), (1 + np.cos(rim)) / 2, np.hypot(x, y) < half - 3


def holes(share, backend):
    scene, whole = holed(share), sl.Scene(rough())
    samples, exact = truth(whole, sl.Sky(), backend)
    some = scene.valid[samples.y, samples.x]

    def off(**options):
        image = samples.of(
            sl.render(scene, sl.Sky(), backend=backend, quantity="irradiance", **DIRECT, **options).image
        )
        return float(np.sqrt(np.mean((image - exact)[some] ** 2)) / exact.mean())

    return {
        "against the ground without holes": off(),
        "lattice, M 17": off(method="lattice", hemicube=17, filled=True),
    }


def holed(share):
    blocks = np.random.default_rng(3).random((SIZE // 8, SIZE // 8)) >= share
    mask = np.kron(blocks, np.ones((8, 8))).astype(bool)
    return sl.Scene(np.where(mask, rough(), np.nan), mask=mask)


def holes_says(share, backend):
    return sl.render(holed(share), sl.Sky(), backend=backend).plan.beyond


def touching(gap):
    return sl.Scene(
        np.full((41, 41), 20.0) - 4 * np.exp(-((X - 30) ** 2 + (Y - 20) ** 2) / 20)[:41, :41]
    ), sl.Lamp((20, 20, 20 - gap - 2), 2)


def touching_lamp(gap, backend):
    """Irradiance at the nodes below a ball, against the mean of their cells: what the grid does not hold."""
    scene = sl.Scene(np.full((41, 41), 20.0))
    fine = sl.Scene(np.full((41 * 8 - 7,) * 2, 20.0 * 8), 1.0)
    lamp, large = sl.Lamp((20, 20, 20 - gap - 2), 2), sl.Lamp((160, 160, 160 - 8 * gap - 16), 16)
    coarse = sl.render(scene, lamp, "horizon", backend=backend, quantity="irradiance").image.astype(float)
    sharp = sl.render(fine, large, "horizon", backend=backend, quantity="irradiance").image.astype(float)
    blocks = np.pad(sharp, 4, "edge")[: 41 * 8, : 41 * 8].reshape(41, 8, 41, 8).mean((1, 3))
    return {
        "nodes against the mean of their cells": float(
            np.sqrt(np.mean((coarse - blocks) ** 2)) / blocks.mean()
        )
    }


def touching_says(gap, backend):
    return sl.plan(*touching(gap), backend=backend).beyond


def offset(metres, backend):
    """A relief of a few spacings far below the viewer's plane, against the same at it."""
    depths = {"float32 depth": np.float32(rough() + metres), "float64 depth": rough() + metres}
    near, *low = (
        sl.render(sl.Scene(depth), sl.Sky(), "horizon", backend=backend, quantity="irradiance").image
        for depth in (rough(), *depths.values())
    )
    errors = (float(np.sqrt(np.mean((image - near) ** 2)) / near.mean()) for image in low)
    return dict(zip(depths, errors))


def offset_says(metres, backend):
    return sl.plan(sl.Scene(np.float32(rough() + metres)), sl.Sky(), backend=backend).beyond


def search(distance, backend):
    scene = sl.Scene(20 * (1 + np.sin(2 * np.pi * X / SIZE * 4)), sides="periodic")
    return lines(
        scene,
        sl.Sky(),
        backend,
        as_far_as_asked={"method": "horizon", "azimuths": 64, "max_distance": distance},
        default={},
    )


def sides(depth, backend):
    """A plane in a dark box, rendered as if its sides were open."""
    box, free = (sl.Scene(np.full((SIZE, SIZE), float(depth)), sides=s) for s in ("dark", "open"))
    samples, exact = truth(box, sl.Sky(), backend)
    return {
        name: plans.relative_errors(
            samples, sl.render(scene, sl.Sky(), backend=backend, quantity="irradiance", **DIRECT).image, exact
        )[0]
        for name, scene in (("sides given as open", free), ("sides given as dark", box))
    }


# -- recovery ------------------------------------------------------------------------------------------------


@functools.cache
def relief(kind="egg crate"):
    y, x = np.mgrid[:32, :32].astype(float)
    return {
        "egg crate": 12 + 4 * np.sin(x / 5) * np.sin(y / 5),
        "plane": np.full((32, 32), 12.0),
        "slant": 8 + 0.3 * x,
    }[kind]


@functools.cache
def picture(backend, albedo=0.8, kind="egg crate"):
    return sl.render(
        sl.Scene(relief(kind), albedo=albedo, sides="dark"),
        sl.Sky(),
        tolerance=0.003,
        backend=backend,
        **DIRECT,
    ).image.astype(float)


def recovered(image, backend, source=UNIFORM, ways=RECOVERIES, **options):
    options = {"sides": "dark", "layers": LAYERS, "backend": backend, **options}
    return {name: sl.recover(image, source, **{**options, **RECOVERIES[name]}) for name in ways}


def first_says(image, backend, way="paper, eps", **options):
    return recovered(image, backend, ways=[way], **options)[way].warnings


def drilled(eps, backend):
    return {
        name: float(found.drilled.mean())
        for name, found in recovered(picture(backend), backend, eps=eps).items()
    }


def noisy(backend, share):
    image = picture(backend)
    return np.maximum(0, image + share * image.max() * np.random.default_rng(5).standard_normal(image.shape))


def counted(backend, bits):
    image = picture(backend)
    return np.rint(image / image.max() * (2**bits - 1)) / (2**bits - 1) * image.max()


def change(image, backend, **options):
    """RMS change of depth [layers] from that recovered from the clean image."""
    clean, other = (
        recovered(picture(backend), backend, eps=EPS),
        recovered(image, backend, eps=EPS, **options),
    )
    return {name: float(np.sqrt(np.mean((other[name].depth - clean[name].depth) ** 2))) for name in clean}


@functools.cache
def spot_picture(power, backend):
    """A slanting plane under a lamp at the viewer, shaded with N.L = 1/2, as Eq. 4 has it."""
    lamp = spot(power)
    scene = sl.Scene(relief("slant"), albedo=0.8)
    cube = sl.Hemicube(17)
    bits = cube.unpack(sl.visibility(scene, lamp, 17, backend))
    return (
        0.8 / (2 * np.pi) * (bits * cube.solid_angles * sl.sources.radiance(lamp, cube.directions)).sum(-1),
        lamp,
    )


def spot(power):
    return sl.Lamp((15.5, 15.5, -10), 8, brightness=sl.cosine_power(power))


def spot_errors(power, backend):
    image, lamp = spot_picture(power, backend)
    shaded = sl.render(
        sl.Scene(relief("slant"), albedo=0.8), lamp, tolerance=0.003, backend=backend
    ).image.astype(float)  # with normals, for the method that has them
    found = {
        name: recovered(
            shaded if name == "robust" else image, backend, lamp, [name], sides="open", hemicube=17, eps=0.01
        )[name]
        for name in RECOVERIES
    }
    return {name: float(np.sqrt(np.mean((one.depth - relief("slant")) ** 2))) for name, one in found.items()}


def spot_says(power, backend):
    image, lamp = spot_picture(power, backend)
    return first_says(image, backend, "paper, sign", source=lamp, sides="open", hemicube=17)


def flat_start(depth, backend):
    """A plane under an open sky: every depth explains it."""
    image = np.full((24, 24), 0.8)
    return {
        name: float(np.sqrt(np.mean((found.depth - depth) ** 2)))
        for name, found in recovered(image, backend, sides="open").items()
    }


def open_says(sides, backend):
    return first_says(picture(backend), backend, sides=sides, eps=0.05)


FAILURES = {
    "leak": Failure(
        title="The paper's step leaks at large M",
        parameter="M",
        values=(5, 7, 9, 17, 33),
        quick=(5, 33),
        limit=0.05,
        measure=leak,
        bad="stride",
        does=(
            "Steps go from node to node and jump over the ridges between them. `filled=True` tests the"
            " surface between the nodes; horizons test every crossing in near rows and the best ones beyond"
            " ([horizon sweep](../explanation/methods.md#the-horizon-sweep)). `render` warns where stride"
            " leaks."
        ),
        good="default",
        warns=lambda m, b: sl.render(sl.Scene(rough()), sl.Sky(), "lattice", hemicube=m, backend=b).warnings,
        says="Leak",
    ),
    "razor": Failure(
        title="Razor ridges",
        parameter="width of the ridges [nodes]",
        values=(8, 6, 4, 3, 2, 1),
        quick=(8, 1),
        limit=0.1,
        measure=razor,
        bad="stride M 17",
        does=(
            "A ridge narrower than the step stands between two nodes of a ray. The filled lattice tests every"
            " crossing, and horizons those in near rows and the best ones beyond."
        ),
        good="default",
    ),
    "valley": Failure(
        title="Deep narrow valleys",
        parameter="depth of a trench 5 nodes wide",
        values=(2, 5, 10, 20, 40, 80),
        quick=(2, 40),
        limit=0.05,
        measure=valley,
        bad="lattice, M 9",
        does=(
            "Little sky is visible from the bottom, in few directions. The error is that of the nodes at"
            " the bottom alone. A tolerance applies to the whole image: set a smaller one where the bottom"
            " matters."
        ),
        good="64 azimuths",
    ),
    "small lamp": Failure(
        title="Small lamps vanish between lattice directions",
        parameter="radius of the lamp [nodes], 24 above a plane",
        values=(11, 8, 4, 2, 1, 0.5),
        quick=(11, 1),
        limit=0.3,
        measure=small_lamp,
        bad="lattice M 9",
        does=(
            "Rays of the lattice miss a small lamp. Slices are placed within its outline at every node;"
            " where nothing hides the lamp, the default is a closed form. The lattice gives a warning."
        ),
        good="default",
        warns=small_lamp_says,
        says="Small lamp",
    ),
    "small sun": Failure(
        title="Small suns vanish between directions",
        parameter="radius of the sun [degrees]",
        values=(10, 5, 2, 1, 0.5, 0.27),
        quick=(10, 0.27),
        limit=0.1,
        measure=small_sun,
        bad="lattice M 17",
        does=(
            "Directions of the lattice hit or miss a small sun. Tables of horizons contain all of its"
            " light, since they integrate the brightness. With a given number of azimuths, half of them"
            " are placed where the light is; with a tolerance the sun has azimuths of its own."
        ),
        good="default",
    ),
    "grazing": Failure(
        title="Grazing light",
        parameter="elevation of the sun [degrees]",
        values=(60, 40, 20, 10, 5, 2),
        quick=(60, 10),
        limit=0.1,
        measure=grazing,
        bad="even azimuths",
        does=(
            "A low sun lights few nodes, and a small error of a horizon darkens them. With a tolerance"
            " the sun has azimuths of its own, and their number follows the estimated error."
        ),
        good="default",
    ),
    "cliff": Failure(
        title="Cliffs under a hard sun",
        parameter="height of the tallest houses [spacings]",
        values=(1, 4, 9, 18, 36),
        quick=(1, 36),
        limit=0.03,
        measure=cliff,
        bad="six near rows",
        does=(
            "Beyond 6 rows, sweeps look up the two best crossings only; behind a wall a wrong one hides"
            " the sun from a node. With a tolerance, where neighbours lie more than 4 spacings apart, the"
            " sun has exact horizons in azimuths of its own, and for the rest every crossing within 24"
            " rows is tested."
        ),
        good="default",
    ),
    "between": Failure(
        title="Light between surfaces",
        parameter="albedo of a spherical bowl",
        values=(0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.95),
        quick=(0.02, 0.8),
        limit=0.02,
        measure=between,
        bad="direct light",
        does=(
            "With a tolerance this light is computed, to any number of bounces, where leaving it out"
            " would cost more than a third of the tolerance. Methods selected by name include it with"
            " `interreflection=True`."
        ),
        good="default",
    ),
    "holes": Failure(
        title="Holes in the data",
        parameter="share of 8 x 8 blocks that are masked",
        values=(0.0, 0.01, 0.03, 0.1, 0.2, 0.4),
        quick=(0.0, 0.3),
        limit=0.015,
        measure=holes,
        bad="against the ground without holes",
        does=(
            "Masked ground hides nothing, so light passes through it. Plans give the share of masked nodes."
        ),
        good=None,
        warns=holes_says,
        says="Nodata",
    ),
    "touching": Failure(
        title="A lamp that touches the surface",
        parameter="gap below a ball of radius 2 [nodes]",
        values=(8, 4, 2, 1, 0.5, 0.25),
        quick=(8, 0.25),
        limit=0.1,
        measure=touching_lamp,
        bad="nodes against the mean of their cells",
        does=(
            "Below such a lamp the light changes within one cell. Plans give the distance between lamp"
            " and surface if it is less than a spacing."
        ),
        good=None,
        warns=touching_says,
        says="The lamp touches",
    ),
    "rounding": Failure(
        title="Relief far below the viewer's plane",
        parameter="depth added to it [spacings]",
        values=(1e2, 1e3, 1e4, 1e5, 1e6, 1e7),
        quick=(1e2, 1e7),
        limit=0.01,
        measure=offset,
        bad="float32 depth",
        does=(
            "Depths given as float32 have lost their relief. Under a sky, those given as float64 are counted"
            " from the least. Plans give the rounding if it is more than a tenth of the tolerance."
        ),
        good="float64 depth",
        warns=offset_says,
        says="float32 rounds depths",
    ),
    "search": Failure(
        title="Searching not far enough",
        parameter="max_distance [spacings]",
        values=(160, 80, 40, 20, 10, 5),
        quick=(80, 5),
        limit=0.05,
        measure=search,
        bad="as far as asked",
        does=(
            "`max_distance` excludes the ground beyond it. Plans measure the resulting error before they"
            " use a `max_distance`."
        ),
        good="default",
    ),
    "sides": Failure(
        title="Wrong sides",
        parameter="depth of a plane in a dark box of 80 nodes",
        values=(1, 2, 5, 10, 20, 40),
        quick=(1, 40),
        limit=0.1,
        measure=sides,
        bad="sides given as open",
        does=("A map does not contain its surroundings: set `sides` to the true ones."),
        good="sides given as dark",
    ),
    "drilled": Failure(
        title="Columns drilled through",
        parameter="eps, share of the image's maximum",
        values=(0.2, 0.1, 0.05, 0.02, 0.01, 0.002),
        quick=(0.2, 0.002),
        limit=0.15,
        measure=drilled,
        bad="paper, eps",
        does=(
            "A column that steps past the image's value is carved through to the back, and a column that"
            " stops early shades the others. `drilled` marks the carved columns, and a warning gives their"
            " share. The default (`robust`) does not carve and has no eps."
        ),
        good="robust",
        warns=lambda eps, b: first_says(picture(b), b, eps=eps),
        says="Drilled",
        unit="share of columns drilled",
    ),
    "two values": Failure(
        title="Two depths explain one value",
        parameter="k of a lamp cos^k",
        values=(0, 1, 2, 4, 8, 16),
        quick=(0, 16),
        limit=4.0,
        measure=spot_errors,
        bad="paper, sign",
        does=(
            "Under a spotlight a column is dark near the viewer, brighter below, and dark again. Carving"
            " stops at the first match, or drills, and a warning gives the share of drilled columns. The"
            " default fits the whole surface. The image of each method follows its own model: N.L = 1/2"
            " for carving, normals for the default."
        ),
        good="robust",
        warns=spot_says,
        says="Drilled",
        unit="RMS error of depth [layers]",
    ),
    "noise": Failure(
        title="Noise",
        parameter="noise, share of the image's maximum",
        values=(0.001, 0.003, 0.01, 0.03, 0.1),
        quick=(0.001, 0.1),
        limit=1.5,
        measure=lambda v, b: change(noisy(b, v), b),
        bad="paper, eps",
        does=(
            "One false stop shades its neighbours, so small noise moves whole groups of columns; a"
            " warning counts the drilled ones. The change of the default is 6 to 13 times smaller at 1 %"
            " of noise, and about a fifth at 10 %."
        ),
        good=None,
        warns=lambda v, b: first_says(noisy(b, v), b, eps=EPS),
        says="Drilled",
        unit="RMS change of depth [layers]",
    ),
    "bits": Failure(
        title="Images of few bits",
        parameter="bits",
        values=(16, 8, 6, 4, 3, 2),
        quick=(16, 2),
        limit=1.0,
        measure=lambda v, b: change(counted(b, v), b),
        bad="paper, eps",
        does=(
            "One step of the counts is more than eps. A warning gives the number of counts. Use 16-bit"
            " files. At 2 bits the error of the default exceeds that of carving."
        ),
        good=None,
        warns=lambda v, b: first_says(counted(b, v), b, eps=EPS),
        says="Few counts",
        unit="RMS change of depth [layers]",
    ),
    "albedo": Failure(
        title="Wrong albedo",
        parameter="albedo given, over the true one",
        values=(1.0, 1.02, 1.05, 1.1, 1.2, 1.5),
        quick=(1.0, 1.3),
        limit=1.5,
        measure=lambda v, b: change(picture(b, 0.6), b, albedo=0.6 * v),
        bad="paper, eps",
        does=(
            "If the given albedo is too high, the surface has to lie deeper; the bright parts fit at no"
            " depth and are drilled. The default does not drill, but its depth changes too: less than with"
            ' carving and stop "eps" up to 1.1 and more from 1.2 on, and no less than with "sign" from'
            " 1.05 on. One image does not determine both depth and albedo."
        ),
        good=None,
        warns=lambda v, b: first_says(picture(b, 0.6), b, albedo=0.6 * v, eps=EPS),
        says="Drilled",
        unit="RMS change of depth [layers]",
    ),
    "ill-posed": Failure(
        title="A plane under an open sky",
        parameter="its depth [layers]",
        values=(1, 2, 5, 10, 20, 30),
        quick=(1, 20),
        limit=5.0,
        measure=flat_start,
        bad="paper, eps",
        does=(
            "Every depth gives the same image, and no method finds the right one. There is a warning"
            " whenever sides are open under a sky."
        ),
        good=None,
        warns=lambda v, b: open_says("open" if v > 1 else "dark", b),
        says="Open sides",
        unit="RMS error of depth [layers]",
    ),
}


def sets_in(failure, found) -> str:
    """The first value at which the bad line exceeds the limit, as a sentence."""
    for value, errors in zip(failure.values, found[failure.bad]):
        if errors > failure.limit:
            place = f"from {value:g} on"
            return f"*{failure.bad}* exceeds {failure.limit:g} {place}; parameter: {failure.parameter}."
    return f"*{failure.bad}* does not exceed {failure.limit:g} in this range of: {failure.parameter}."


# Okabe and Ito (2008); told apart in the three kinds of colour blindness (tests/test_charts.py)
DEFAULT_COLOUR, BAD_COLOUR, OTHER_COLOURS = "#0072B2", "#D55E00", ("#E69F00", "#009E73")
STATES = {"solved": "#0072B2", "warned": "#F0E442", "open": "#D55E00"}
# lines that are the default, or that the default cannot avoid: of holes and lamps that touch
DEFAULTS = (
    "default",
    "robust",
    "against the ground without holes",
    "nodes against the mean of their cells",
    "float64 depth",
    "sides given as open",
    "tolerance 0.3 %",
)
ABOUT_THE_PAPER = ("leak", "small lamp", "drilled", "two values", "noise", "bits", "albedo")  # warnings there
COLUMNS = ("lattice, or carving", "fixed settings", "default")


def default_of(found) -> str | None:
    """The line of the default."""
    return next((name for name in DEFAULTS if name in found), None)


def draw(path, failure, found):
    """Error against the parameter: the default thick and blue, the failing method dashed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    ours, others = default_of(found), iter(OTHER_COLOURS)
    for (name, values), marker in zip(found.items(), "osD^"):
        if name == ours and name != failure.bad:
            style = {"color": DEFAULT_COLOUR, "lw": 3, "zorder": 3}
        elif name == failure.bad:
            style = {"color": BAD_COLOUR, "lw": 1.6, "ls": "--"}
        else:
            style = {"color": next(others), "lw": 1.2}
        axes.plot(failure.values, values, marker=marker, ms=5, label=name, **style)
    axes.axhline(failure.limit, color="0.4", lw=1, ls=":")
    low, high = min(failure.values), max(failure.values)
    if low > 0 and high / low >= 12:
        axes.set_xscale("log")
        axes.minorticks_off()
    axes.set_xticks(failure.values, tick_labels(failure.values, axes.get_xscale() == "log"))
    if failure.values[0] > failure.values[-1]:
        axes.invert_xaxis()
    smallest = min((v for values in found.values() for v in values if v > 0), default=1)
    if smallest < failure.limit / 5:
        axes.set_yscale("symlog", linthresh=max(smallest, failure.limit / 300))
    axes.set_ylim(bottom=0)
    axes.annotate(
        f"counts as failed above {failure.limit:g}",
        (0.02, failure.limit),
        (0, 2),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        fontsize=7,
        color="0.3",
    )
    axes.set_xlabel(failure.parameter)
    axes.set_ylabel(failure.unit)
    axes.set_title(failure.title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, frameon=False)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def tick_labels(values, logarithmic) -> list[str]:
    """The values, but for those that would touch the label before them."""
    at = np.log(values) if logarithmic else np.asarray(values, float)
    labels, last = [], -np.inf
    for place, value in zip(np.abs(at - at[0]) / np.ptp(at), values):
        labels.append(f"{value:g}" if place - last > 0.06 else "")
        last = place if labels[-1] else last
    return labels


def states(name, failure, found) -> dict[str, str]:
    """By column of the matrix: solved, warned or open at the most harmful value; no entry without a line.

    The worst line of a column counts.
    """
    ours, by = default_of(found), {}
    for line, errors in found.items():
        is_paper = line.startswith(("stride", "filled", "lattice", "paper"))
        column = COLUMNS[2] if line == ours else COLUMNS[0] if is_paper else COLUMNS[1]
        by[column] = max(by.get(column, 0.0), errors[-1])
    result = {}
    for column, error in by.items():
        spoken = failure.warns and (column == COLUMNS[0] if name in ABOUT_THE_PAPER else column == COLUMNS[2])
        spoken = spoken or (name in ("ill-posed", "rounding") and failure.warns)
        result[column] = "solved" if error <= failure.limit else "warned" if spoken else "open"
    return result


def draw_matrix(path, results):
    """Failures by methods: solved, warned, open, by colour and word."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.2, 0.27 * len(results) + 0.7), layout="constrained")
    for row, by in enumerate(results.values()):
        for column, state in by.items():
            x = COLUMNS.index(column)
            axes.add_patch(plt.Rectangle((x - 0.48, row - 0.44), 0.96, 0.88, color=STATES[state]))
            dark = state != "warned"
            axes.text(x, row, state, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    axes.set_xlim(-0.5, len(COLUMNS) - 0.5)
    axes.set_ylim(len(results) - 0.5, -0.5)
    axes.set_xticks(range(len(COLUMNS)), COLUMNS)
    axes.set_yticks(range(len(results)), [FAILURES[name].title for name in results], fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def kept(folder) -> dict[str, dict[str, list[float]]]:
    """Errors by failure and line, as stability.csv has them."""
    found: dict[str, dict[str, list[float]]] = {}
    with open(folder / "stability.csv", newline="") as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            found.setdefault(row["failure"], {}).setdefault(row["line"], []).append(float(row["error"]))
    return found


HEAD = [
    "# Where methods fail, and what skylamp does about it",
    "",
    "Each failure is provoked by a parameter, from harmless to harmful (`performance/stability.py`)."
    " The matrix has the state at the most harmful value: *solved*, the error stays below the threshold;"
    " *warned*, a warning names it; *open*, it fails without a warning. Empty: the method was not measured.",
    "",
    "![Failures by methods: solved, warned or open](../stability-matrix.png)",
    "",
    "In the figures the default is the thick blue line, the failing method is dashed, and the dotted line is"
    " the threshold. `tests/test_stability.py` asserts that each failure occurs in the method that has it,"
    " and that the remedy in the text solves it or a warning names it.",
    "",
]


def write_page(folder, found) -> None:
    """evidence/stability.md, its figures and its matrix."""
    text = list(HEAD)
    for name, errors in found.items():
        failure = FAILURES[name]
        picture_file = f"stability-{name.replace(' ', '-')}.png"
        draw(folder / picture_file, failure, errors)
        text += [f"## {failure.title}", "", failure.does, ""]
        text += [sets_in(failure, errors)]
        text += ["", f"![{failure.title}](../{picture_file})", ""]
    draw_matrix(folder / "stability-matrix.png", {n: states(n, FAILURES[n], e) for n, e in found.items()})
    (folder / "evidence").mkdir(exist_ok=True)
    (folder / "evidence" / "stability.md").write_text("\n".join(text))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--backend", default="auto")
    parser.add_argument(
        "--only", default="", help="names, comma-separated; others stay as stability.csv has them"
    )
    parser.add_argument("--draw", action="store_true", help="measure nothing: the page from stability.csv")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.draw:
        write_page(args.out, kept(args.out))
        return
    path = args.out / "stability.csv"
    by_name: dict[str, list[tuple]] = {}
    if args.only and path.exists():
        with open(path, newline="") as file:
            for row in csv.DictReader(line for line in file if not line.startswith("#")):
                by_name.setdefault(row["failure"], []).append(tuple(row.values()))
    for name, failure in FAILURES.items():
        if args.only and name not in args.only.split(","):
            continue
        each = [failure.measure(value, args.backend) for value in failure.values]
        by_name[name] = [
            (name, failure.parameter, value, line, errors[line])
            for value, errors in zip(failure.values, each)
            for line in errors
        ]
        shown = {line: [round(errors[line], 4) for errors in each] for line in each[0]}
        print(name, shown, flush=True)
        with open(path, "w", newline="") as file:  # each time, since a later one takes minutes
            file.write(record.comment(f"last measured: {args.only or 'all'}", args.backend) + "\n")
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("failure", "parameter", "value", "line", "error"))
            for kept_name in FAILURES:
                writer.writerows(by_name.get(kept_name, []))
    found = kept(args.out)
    if set(found) == set(FAILURES):
        write_page(args.out, found)


if __name__ == "__main__":
    main()
