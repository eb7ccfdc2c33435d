"""Light between surfaces beside Mitsuba 3's path tracer: the same surfaces as meshes, three times as dense.

    pip install mitsuba
    python performance/path_tracer.py [--out DIR] [--nodes 96] [--samples 1024] [--backend NAME]

Some minutes on two idle cores. Mitsuba's LLVM variant needs a libLLVM (DRJIT_LIBLLVM_PATH names it). Paths
begin above every node, so both give the light of a point, not of a pixel. Nodes of the border, where rays
miss the mesh, are not compared. A constant emitter shines from below as well; a black rectangle below the
mesh, much larger than it, keeps that out, as open sides do.

Writes path_tracer.csv: for three surfaces at albedo 0.2, 0.5 and 0.8 under a uniform sky the RMS difference
over the mean, what of it is the path tracer's noise (from its samples), and what direct light alone is off;
and path_tracer.png, one scene at three albedos: direct light, all light, the path tracer's.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import record

import skylamp as sl

ALBEDOS, DENSER, LONGEST, PATHS = (0.2, 0.5, 0.8), 3, 64, 2**20
TOLERANCE = 0.003
INSIDE = np.s_[1:-1, 1:-1]


def hills(x, y, size):
    rng = np.random.default_rng(5)
    waves = rng.uniform(0.5, 1, (12, 1, 1)) * np.exp(2j * np.pi * rng.uniform(size=(12, 1, 1)))
    angles, lengths = rng.uniform(0, np.pi, (12, 1, 1)), rng.uniform(24, 60, (12, 1, 1))
    phase = 2j * np.pi * (x * np.cos(angles) + y * np.sin(angles)) / lengths
    return 30 + 3 * np.real(waves * np.exp(phase)).sum(0)


def bowl(x, y, size):
    middle, rim, angle = (size - 1) / 2, 0.42 * size, math.radians(55)
    r, radius = np.hypot(x - middle, y - middle), rim / math.sin(angle)
    inside = np.sqrt(np.maximum(radius**2 - r * r, 0)) - radius * math.cos(angle)
    return np.where(r < rim, inside, 0.0)


def folds(x, y, size):
    return 22 * np.sin(x / 9 + 1.3 * np.sin(y / 14)) ** 2


SURFACES = {"hills": hills, "bowl": bowl, "folds": folds}


def on_grid(surface, nodes, denser=1):
    """x, y and depth on the nodes 0 .. nodes - 1, so many times as dense."""
    along = np.arange((nodes - 1) * denser + 1) / denser
    x, y = np.meshgrid(along, along)
    return x, y, surface(x, y, nodes)


def write_mesh(mi, path, x, y, depth):
    """Two triangles a cell, as PLY."""
    rows, cols = depth.shape
    number = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = (number[i : rows - 1 + i, j : cols - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.uint32)
    corners = np.stack([x, y, -depth], -1).reshape(-1, 3).astype(np.float32)
    mesh = mi.Mesh("surface", len(corners), len(faces))
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = corners.ravel(), faces.ravel()
    values.update()
    mesh.write_ply(str(path))


def traced(mi, surface, nodes, albedo, samples):
    """(radiance, its standard deviation) of the inner nodes, by paths from above each."""
    fine = on_grid(surface, nodes, DENSER)
    reflects = lambda share: {"type": "diffuse", "reflectance": {"type": "rgb", "value": [share] * 3}}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surface.ply"
        write_mesh(mi, path, *fine)
        beneath = mi.ScalarTransform4f().translate([0, 0, -float(fine[2].max()) - 1]).scale(1000 * nodes)
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": LONGEST, "rr_depth": LONGEST},
                "surface": {
                    "type": "ply",
                    "filename": str(path),
                    "face_normals": False,
                    "bsdf": {"type": "twosided", "bsdf": reflects(albedo)},
                },
                "beneath": {"type": "rectangle", "to_world": beneath, "bsdf": reflects(0.0)},
                "sky": {"type": "constant", "radiance": 1.0},
            }
        )
    x, y, depth = (values[INSIDE] for values in on_grid(surface, nodes))
    count, some = x.size, max(1, PATHS // x.size)
    at = [np.repeat(v.ravel(), some).astype(np.float32) for v in (x, y)]
    above = np.full(count * some, 1 - float(depth.min()), np.float32)
    rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*at, above), mi.Vector3f(0, 0, -1)))
    sampler, total, square = mi.load_dict({"type": "independent"}), 0.0, 0.0
    times = -(-samples // some)
    for seed in range(times):
        sampler.seed(seed, count * some)
        light = np.asarray(scene.integrator().sample(scene, sampler, rays)[0])[0].reshape(count, some)
        total, square = total + light.sum(1, dtype=float), square + (light.astype(float) ** 2).sum(1)
    n = times * some
    mean = total / n
    deviation = np.sqrt(np.maximum(square / n - mean**2, 0) / n)
    return mean.reshape(x.shape), deviation.reshape(x.shape)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", default=".", type=Path)
    parser.add_argument("--nodes", default=96, type=int)
    parser.add_argument("--samples", default=1024, type=int)
    parser.add_argument("--backend", default="auto")
    arguments = parser.parse_args()
    try:
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
    except ImportError as error:
        sys.exit(f"Mitsuba 3 is missing (pip install mitsuba): {error}")
    rows, shown = [], []
    rms = lambda values: math.sqrt(float(np.mean(np.square(values))))
    for name, surface in SURFACES.items():
        for albedo in ALBEDOS:
            depth = on_grid(surface, arguments.nodes)[2]
            out = sl.render(
                sl.Scene(depth, albedo=albedo),
                sl.Sky(),
                tolerance=TOLERANCE,
                backend=arguments.backend,
                interreflection=True,
                parts=True,
            )
            light, deviation = traced(mi, surface, arguments.nodes, albedo, arguments.samples)
            direct, image = out.direct[INSIDE], out.image[INSIDE]
            off, mean = image - light, float(light.mean())
            row = {
                "surface": name,
                "albedo": albedo,
                "difference": rms(off) / mean,
                "noise": rms(deviation) / mean,
                "bias": float(off.mean()) / mean,
                "direct light alone": rms(direct - light) / mean,
                "samples": arguments.samples,
                "mitsuba": mi.__version__,
            }
            rows.append(row)
            print(row, flush=True)
            if name == "folds":
                shown.append((albedo, direct, image, light))
    arguments.out.mkdir(parents=True, exist_ok=True)
    record.write_rows(arguments.out / "path_tracer.csv", rows, backend=arguments.backend)
    figure, axes = plt.subplots(3, 3, figsize=(9, 9.2), constrained_layout=True)
    for column, (albedo, *images) in zip(axes.T, shown):
        for axis, image, title in zip(column, images, ("direct light", "all light", "Mitsuba 3")):
            axis.imshow(image, cmap="gray", vmin=0, vmax=albedo)
            axis.set(xticks=[], yticks=[], title=f"albedo {albedo:g}: {title}")
    figure.savefig(arguments.out / "path_tracer.png", dpi=90)


if __name__ == "__main__":
    main()
