"""Speed against accuracy on one chart: `skylamp chart`, light between surfaces, the inverse, other packages.

    python performance/speed_accuracy.py --out docs [--panels sun,window,...] [--backends opencl,numpy]
        [--sizes 128,512] [--peers /path/to/python] [--mitsuba /path/to/python] [--quick] [--draw]
    python performance/speed_accuracy.py --out docs --name speed_accuracy_h200 --backends opencl,warp

Panels are measured in turn; rows of each replace those of NAME.csv when it ends. ``--panels``: classes of
`skylamp chart`, "inverse", "peers" and "mitsuba". ``--draw``: NAME.svg and NAME.png from NAME.csv alone.

``--peers``: an interpreter that has the packages (see peers.py; this one unless given). They claim sky-view
factors, which are compared at the same nodes with exact ones of their own definition. ``--mitsuba``: one
that has Mitsuba 3 (see path_tracer.py; this one unless given); its error is its noise, against 4096 paths a
node of its own, so that the different surface (two triangles a cell) does not count.
"""

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import skylamp as sl
from skylamp.app import chart
from skylamp.backends import select

sys.path.insert(0, str(Path(__file__).parent))
import record

HERE = Path(__file__).parent
MEAN_ELSEWHERE = 0.78  # mean sky-view factor of the rough map of performance/horizon.py
LABELS = {
    "peer rvt-py": "rvt-py, radius 100 and 10 nodes, 1 core",
    "peer xarray-spatial": "xarray-spatial, radius 100 and 10, 1 core",
    "peer topocalc": "topocalc, whole map, 1 core",
    "peer trimesh + embreex": "trimesh + embreex, 256 rays, 1 core",
    "peer HORAYZON": "HORAYZON, 2 cores, from a reader, another map",
    "peer Mitsuba 3": "Mitsuba 3, path tracer, all cores",
}
CHILD = """
import json, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
import peers
data = np.load(sys.argv[2])
missing = peers.missing()
print(json.dumps({"missing": missing}), flush=True)
for name, azimuths, radius in peers.RUNS:
    if name not in missing:
        values, seconds, _ = peers.run(name, data["height"], (data["rows"], data["cols"]), azimuths, radius)
        row = {"peer": name, "azimuths": azimuths, "radius": radius, "quantity": peers.PEERS[name][3]}
        row |= {"seconds": seconds, "values": np.asarray(values, float).tolist()}
        print(json.dumps(row), flush=True)
"""


def peers_rows(python: str, size: int) -> list[dict]:
    """Points of the peers that the interpreter has, on the classes under a uniform sky."""
    rows, engine = [], select("auto")
    for kind in ("smooth", "rough", "urban"):
        scene, _, pilots, exact = chart.reference(kind, size, engine)
        border = size // 8
        inside = (
            (pilots.x >= border)
            & (pilots.x < size - border)
            & (pilots.y >= border)
            & (pilots.y < size - border)
        )  # some mirror the map at its border
        azimuths = sl.Azimuths(720).angles
        cosine, sine = np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]
        level = pilots.slopes(cosine, sine, np.zeros((720, len(pilots))))
        truth = {"tilted": exact / np.pi, "solid_angle": 1 - np.mean(level / np.sqrt(1 + level**2), 0)}
        with tempfile.NamedTemporaryFile(suffix=".npz") as file:
            np.savez(
                file, height=scene.depth.max() - scene.depth, rows=pilots.y[inside], cols=pilots.x[inside]
            )
            file.flush()
            out = subprocess.run(
                [python, "-W", "ignore", "-c", CHILD, str(HERE), file.name],
                capture_output=True,
                text=True,
                check=True,
            ).stdout
        for line in map(json.loads, out.splitlines()):
            for name, why in line.get("missing", {}).items():
                print(f"not run: {name} ({why})", flush=True)
            if "peer" in line:
                wanted = truth[line["quantity"]][inside]
                error = float(np.sqrt(np.mean((np.array(line["values"]) - wanted) ** 2)) / wanted.mean())
                rows.append(
                    {
                        "class": kind,
                        "size": size,
                        "backend": "peer",
                        "method": f"peer {line['peer']}",
                        "units": line["azimuths"],
                        "error": error,
                        "seconds": line["seconds"],
                    }
                )
                print(rows[-1], flush=True)
    return rows


def elsewhere(folder: Path, size: int) -> list[dict]:
    """Points that were not measured here, from peers_elsewhere.csv: on rough ground of 1024 x 1024 nodes."""
    path = folder / "peers_elsewhere.csv"
    if not path.exists():
        return []
    with open(path, newline="") as file:
        found = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return [
        {
            "class": "rough",
            "size": size,
            "backend": "peer",
            "method": f"peer {row['package']}",
            "units": float(row["azimuths"]),
            "error": float(row["error"]) / MEAN_ELSEWHERE,
            "seconds": float(row["seconds"]) * (size / 1024) ** 2,
        }
        for row in found
    ]


TRACED = """
import json, sys
import numpy as np
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import time
data = np.load(sys.argv[1])
depth, albedo, nodes = data["depth"], float(data["albedo"]), data["nodes"]
rows, cols = depth.shape
y, x = np.mgrid[:rows, :cols].astype(np.float32)
number = np.arange(rows * cols).reshape(rows, cols)
a, b, c, d = (number[i : rows - 1 + i, j : cols - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.uint32)
mesh = mi.Mesh("surface", rows * cols, len(faces))
values = mi.traverse(mesh)
values["vertex_positions"] = np.stack([x, y, -depth], -1).astype(np.float32).ravel()
values["faces"] = faces.ravel()
values.update()
mesh.write_ply(sys.argv[2])
reflects = lambda share: {"type": "diffuse", "reflectance": {"type": "rgb", "value": [share] * 3}}
beneath = mi.ScalarTransform4f().translate([0, 0, -float(depth.max()) - 1]).scale(1000 * rows)
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "path", "max_depth": 64, "rr_depth": 64},
    "surface": {"type": "ply", "filename": sys.argv[2], "face_normals": False,
                "bsdf": {"type": "twosided", "bsdf": reflects(albedo)}},
    "beneath": {"type": "rectangle", "to_world": beneath, "bsdf": reflects(0.0)},
    "sky": {"type": "constant", "radiance": 1.0},
})
sampler = mi.load_dict({"type": "independent"})

def light(at_x, at_y, paths, seed):
    # radiance above each point, a mean of so many paths
    total, some = 0.0, max(1, min(paths, 2**21 // at_x.size))
    at = [np.repeat(v.ravel(), some).astype(np.float32) for v in (at_x, at_y)]
    above = np.full(at[0].size, 1 - float(depth.min()), np.float32)
    rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*at, above), mi.Vector3f(0, 0, -1)))
    for turn in range(paths // some):
        sampler.seed(seed + turn, at[0].size)
        values = np.asarray(scene.integrator().sample(scene, sampler, rays)[0])[0]
        total = total + values.reshape(at_x.size, some).mean(1, dtype=float)
    return total / (paths // some)

exact = light(x.ravel()[nodes], y.ravel()[nodes], int(data["reference"]), 100000)
for paths in data["paths"].tolist():
    seconds = []
    for turn in range(2):
        start = time.perf_counter()
        found = light(x, y, paths, 1)
        seconds.append(time.perf_counter() - start)
    error = float(np.sqrt(np.mean((found[nodes] - exact) ** 2)) / exact.mean())
    print(json.dumps({"units": paths, "error": error, "seconds": min(seconds)}), flush=True)
"""


def mitsuba_rows(python: str, size: int, quick: bool) -> list[dict]:
    """Points of Mitsuba's path tracer, by paths a node, on class "albedo"."""
    scene, _ = chart.scene_of("albedo", size)
    samples = chart.Samples(select("auto"), scene, chart.NODES, chart.FIRST)
    border = (samples.x > 0) & (samples.x < size - 1) & (samples.y > 0) & (samples.y < size - 1)
    nodes = (samples.y * size + samples.x)[border]
    with tempfile.TemporaryDirectory() as folder:
        file, mesh = Path(folder) / "map.npz", Path(folder) / "surface.ply"
        paths = np.array([1, 4] if quick else [1, 4, 16, 64])
        reference = 64 if quick else 4096
        np.savez(file, depth=scene.depth, albedo=scene.albedo, nodes=nodes, paths=paths, reference=reference)
        words = [python, "-W", "ignore", "-c", TRACED, str(file), str(mesh)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"Mitsuba 3 failed:\n{done.stderr}")
    rows = []
    for line in map(json.loads, done.stdout.splitlines()):
        more = {name: line[name] for name in ("units", "error", "seconds")}
        rows.append({"class": "albedo", "size": size, "backend": "peer", "method": "peer Mitsuba 3", **more})
    return rows


EPS = (0.002, 0.01, 0.02, 0.05, 0.1)  # of the paper's carving, one of them the best


def inverse_rows(backend: str, quick: bool) -> list[dict]:
    """RMSE of depth [layers] and seconds of recover() and of the paper's carving, on tests/surfaces.py."""
    sys.path.insert(0, str(HERE.parent / "tests"))
    import surfaces

    rows, source = [], surfaces.source_of("sky")
    for name in list(surfaces.SURFACES)[1 : 2 if quick else None]:
        depth, image = surfaces.pair(name, "sky")
        ask = lambda image=image, **options: sl.recover(
            image, source, surfaces.ALBEDO, "dark", layers=surfaces.LAYERS, backend=backend, **options
        )
        found = [("robust", 0.0, ask(interreflection=False))]
        found += [("paper", eps, ask(method="paper", eps=eps)) for eps in EPS]
        here = [
            {"class": chart.INVERSE, "size": surfaces.SIZE, "backend": one.backend, "method": method}
            | {"units": eps, "error": surfaces.rms(one.depth - depth), "seconds": one.seconds}
            | {"surface": name, "best": 0}
            for method, eps, one in found
        ]
        min(here[1:], key=lambda row: row["error"])["best"] = 1
        print(here[0], flush=True)
        rows += here
    return rows


COLUMNS = (
    *("class", "size", "backend", "method", "units", "error", "seconds", "planning", "again"),
    *("surface", "best"),
)
PANELS = (*chart.CLASSES, chart.INVERSE, "peers", "mitsuba")


def panel_of(row: dict) -> str:
    """The name in PANELS by which a row is measured."""
    if row["method"] == "peer Mitsuba 3":
        return "mitsuba"
    return "peers" if row["method"].startswith(chart.PEER) else row["class"]


def read(path: Path) -> tuple[dict[str, str], list[dict]]:
    """(where and when each panel was measured, rows) of a file, empty if there is none."""
    if not path.exists():
        return {}, []
    lines = path.read_text().splitlines()
    facts = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
    rows = []
    for row in csv.DictReader(line for line in lines if not line.startswith("#")):
        numbers = {name: float(row.get(name) or 0) for name in COLUMNS[4:9]}
        rows.append({**row, **numbers, "size": int(row["size"]), "best": int(row.get("best") or 0)})
    return facts, rows


def write(path: Path, facts: dict[str, str], rows: list[dict]) -> None:
    """Rows in the order of PANELS, below a line of facts for each panel."""
    facts = {panel: facts[panel] for panel in PANELS if panel in facts}
    rows = sorted(rows, key=lambda row: PANELS.index(panel_of(row)))
    with open(path, "w", newline="") as file:
        file.writelines(f"# {panel}: {words}\n" for panel, words in facts.items())
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def measured(panel: str, args: argparse.Namespace, names: list[str], sizes: list[int]) -> list[dict]:
    """The rows of one panel."""
    if panel == "peers":
        return peers_rows(args.peers, max(sizes))
    if panel == "mitsuba":
        return mitsuba_rows(args.mitsuba, max(sizes), args.quick)
    if panel == chart.INVERSE:
        return inverse_rows(names[0] if names else "auto", args.quick)
    return chart.measure(names or None, sizes, args.longest, kinds=(panel,))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--name", default="speed_accuracy", help="of the files, without an ending")
    parser.add_argument("--panels", default=",".join(PANELS[:-2]))
    parser.add_argument("--backends", default="")
    parser.add_argument("--sizes", default="128,512")
    parser.add_argument("--longest", type=float, default=3.0, help="[s] of a call that is timed")
    parser.add_argument("--peers", default=sys.executable)
    parser.add_argument("--mitsuba", default=sys.executable)
    parser.add_argument("--quick", action="store_true", help="one small map, to test the script")
    parser.add_argument("--draw", action="store_true", help="measure nothing")
    parser.add_argument("--drawn", default="opencl", help="the backend that is drawn")
    parser.add_argument("--title", default="", help="machine and date, above the chart")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    names = [name for name in args.backends.split(",") if name]
    sizes = [32] if args.quick else [int(size) for size in args.sizes.split(",")]
    path = args.out / f"{args.name}.csv"
    facts, rows = read(path)
    for panel in [] if args.draw else args.panels.split(","):
        if panel not in PANELS:
            parser.error(f"no panel {panel}; there are {', '.join(PANELS)}")
        start = time.perf_counter()
        found = measured(panel, args, names, sizes)
        rows = [row for row in rows if panel_of(row) != panel] + found
        facts[panel] = record.comment(backend=",".join(names) or "all")[2:]
        write(path, facts, rows)
        print(f"{panel}: {len(found)} points, {time.perf_counter() - start:.0f} s", flush=True)
    for time_of in ("seconds", "again"):
        for what, as_accurate in (("within the tolerance", False), ("as accurate as its own image", True)):
            for kind, times in chart.behind(rows, time_of, as_accurate).items():
                print(
                    f"{kind}, {time_of}: the default's time over that of the quickest setting {what}:",
                    ", ".join(f"{ratio:.2f} ({100 * t:g} %)" for ratio, t in zip(times, chart.TOLERANCES)),
                )
    drawn = [row for row in rows if row["backend"] == "peer" or row["backend"].startswith(args.drawn)]
    if any(panel_of(row) == "peers" for row in drawn):
        drawn += elsewhere(args.out, max(row["size"] for row in rows))
    try:
        for suffix in (".svg", ".png"):
            chart.draw(drawn, args.out / f"{args.name}{suffix}", args.title, LABELS)
    except ImportError as error:
        print(f"not drawn: {error}; --draw draws {path} elsewhere")


if __name__ == "__main__":
    main()
