"""Speed against accuracy on one chart: `skylamp chart`, and other packages as points of it.

    python performance/speed_accuracy.py --out docs [--backends opencl,numpy] [--sizes 128,512]
        [--rows docs/speed_accuracy.csv] [--peers /path/to/python]

``--peers``: an interpreter that has the packages (see peers.py; this one unless given). They claim sky-view
factors, which are compared at the same nodes with exact ones of their own definition. ``--rows``: points
measured before, drawn again. Writes speed_accuracy.csv, .svg and .png; largest maps alone are drawn.
"""

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import skylamp as sl
from skylamp.app import chart
from skylamp.backends import select

HERE = Path(__file__).parent
MEAN_ELSEWHERE = 0.78  # mean sky-view factor of the rough map of performance/horizon.py
LABELS = {
    "peer rvt-py": "rvt-py, radius 100 and 10 nodes, 1 core",
    "peer xarray-spatial": "xarray-spatial, radius 100 and 10, 1 core",
    "peer topocalc": "topocalc, whole map, 1 core",
    "peer trimesh + embreex": "trimesh + embreex, 256 rays, 1 core",
    "peer HORAYZON": "HORAYZON, 2 cores, from a reader, another map",
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
        level = pilots.slopes(engine, cosine, sine, np.zeros((720, len(pilots))))
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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--backends", default="")
    parser.add_argument("--sizes", default="128,512")
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--peers", nargs="?", const=sys.executable)
    parser.add_argument("--drawn", default="opencl", help="the backend that is drawn")
    parser.add_argument("--title", default="", help="machine and date, above the chart")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    sizes = [int(size) for size in args.sizes.split(",")]
    if args.rows:
        with open(args.rows, newline="") as file:
            rows = [
                {
                    **row,
                    "size": int(row["size"]),
                    **{
                        name: float(row[name] or 0)
                        for name in ("units", "error", "seconds", "planning", "again")
                    },
                }
                for row in csv.DictReader(file)
            ]
        if args.peers:
            rows = [row for row in rows if row["backend"] != "peer"]
    else:
        rows = chart.measure([name for name in args.backends.split(",") if name] or None, sizes)
    if args.peers:
        rows += peers_rows(args.peers, max(row["size"] for row in rows))
    if not args.rows or args.peers:
        with open(args.out / "speed_accuracy.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    largest = max(row["size"] for row in rows)
    drawn = [row for row in rows if row["backend"] == "peer" or row["backend"].startswith(args.drawn)]
    drawn += elsewhere(args.out, largest)
    for suffix in (".svg", ".png"):
        chart.draw(drawn, args.out / f"speed_accuracy{suffix}", args.title, LABELS)
    for time in ("seconds", "again"):
        for what, as_accurate in (("within the tolerance", False), ("as accurate as its own image", True)):
            for kind, times in chart.behind(rows, time, as_accurate).items():
                print(
                    f"{kind}, {time}: the default's time over that of the quickest setting {what}:",
                    ", ".join(f"{ratio:.2f} ({100 * t:g} %)" for ratio, t in zip(times, chart.TOLERANCES)),
                )


if __name__ == "__main__":
    main()
