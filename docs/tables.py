"""Write every table and number of README and docs/ that was measured, from the data of the scripts.

    python docs/tables.py           # write them into the pages
    python docs/tables.py --check   # exit with 1 if a page differs from the data

A page holds ``<!-- data: NAME -->`` ... ``<!-- end -->``; what stands between is the function of that name
here. The data are the CSV and JSON files in docs/, written by the scripts in performance/.
"""

import argparse
import csv
import json
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
MARK = re.compile(r"(<!-- data: ([\w-]+) -->)(.*?)(<!-- end -->)", re.DOTALL)

Row = dict[str, str]


def rows(name: str) -> list[Row]:
    """Rows of a CSV; lines that begin with # are comments."""
    with open(DOCS / f"{name}.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def facts(name: str) -> dict:
    """A JSON file."""
    return json.loads((DOCS / f"{name}.json").read_text(encoding="utf-8"))


def table(head: Iterable[str], body: Iterable[Iterable[object]]) -> str:
    """A table in Markdown, with the blank lines that it needs."""
    head = list(head)
    lines = [head, ["---"] * len(head), *([str(cell) for cell in line] for line in body)]
    return "\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n\n"


def digits(value: float, count: int = 2) -> str:
    """Rounded to some significant digits, without an exponent."""
    rounded = float(f"{value:.{count}g}")
    return (
        f"{rounded:.0f}" if abs(rounded) >= 10 ** (count - 1) else f"{rounded:.10f}".rstrip("0").rstrip(".")
    )


# -- other packages: performance/horizon.py --peers ------------------------------------------------------


def _peers() -> list[dict]:
    return sorted(facts("horizon")["peers"], key=lambda peer: peer["seconds"] / peer["skylamp"]["seconds"])


def _ratio(peer: dict) -> float:
    return peer["seconds"] / peer["skylamp"]["seconds"]


def peers_least() -> str:
    return f"{min(map(_ratio, _peers())):.0f}"


def peers_most() -> str:
    return digits(max(map(_ratio, _peers())))


def _case(peer: dict, name: str) -> str:
    """One comparison in words; ``name``: what the package is called there."""
    reach = (
        f"{peer['azimuths']} rays per node"
        if "embree" in peer["peer"]
        else "the whole map searched"
        if peer["radius"] is None
        else f"a search radius of {peer['radius']} nodes"
    )
    ours = digits(peer["skylamp"]["seconds"])
    return f"{name} with {reach}: {digits(peer['seconds'])} s, skylamp {ours} s"


def peers_least_case() -> str:
    return _case(_peers()[0], _peers()[0]["peer"])


def peers_most_case() -> str:
    return _case(_peers()[-1], "embree" if "embree" in _peers()[-1]["peer"] else _peers()[-1]["peer"])


def peers() -> str:
    """Packages beside the cheapest skylamp that is no less accurate, and what was measured elsewhere."""
    body = [
        (
            f"{peer['peer']} {peer['version']}",
            peer["azimuths"],
            "whole map" if peer["radius"] is None else peer["radius"],
            f"{peer['cores']:.0f}",
            digits(peer["seconds"]),
            f"{peer['rms']:.4f}",
            peer["skylamp"]["azimuths"],
            digits(peer["skylamp"]["seconds"]),
            f"{peer['skylamp']['rms']:.4f}",
            digits(_ratio(peer)),
        )
        for peer in sorted(_peers(), key=lambda peer: peer["peer"])
    ]
    horizons = [line for line in facts("horizon")["side by side"] if line["quantity"] == "tilted"]
    for line in rows("peers_elsewhere"):
        error = float(line["error"])
        ours = min(
            (one for one in horizons if "azimuths" in one and one["rms"] <= error),
            key=lambda one: one["seconds"],
            default=None,
        )
        body.append(
            (
                f"{line['package']} (\\*)",
                line["azimuths"],
                line["radius"],
                line["cores"],
                line["seconds"],
                f"{error:.4f}",
                *(
                    ("", "", "", "")
                    if ours is None
                    else (
                        ours["azimuths"],
                        digits(ours["seconds"]),
                        f"{ours['rms']:.4f}",
                        digits(float(line["seconds"]) / ours["seconds"]),
                    )
                ),
            )
        )
    return table(
        (
            "package",
            "azimuths or rays",
            "radius [nodes]",
            "cores",
            "s",
            "RMS error",
            "skylamp: azimuths",
            "s",
            "RMS error",
            "times faster",
        ),
        body,
    )


# -- tolerances: performance/refinement.py ---------------------------------------------------------------


def _pairs(tolerance: float) -> list[Row]:
    return [row for row in rows("refinement") if float(row["tolerance"]) == tolerance]


def _silent(found: list[Row], over: float) -> int:
    return sum(float(row["over"]) > over and row["warned"] != "True" for row in found)


def pairs() -> str:
    return str(len(_pairs(0.01)))


def pairs_kept() -> str:
    found = _pairs(0.01)
    return f"{sum(float(row['over']) <= 1 for row in found)} of {len(found)}"


def pairs_rest() -> str:
    """How many pairs exceeded a tolerance of 1 %, with and without a warning, and by how much at most."""
    found = _pairs(0.01)
    silent = _silent(found, 1)
    warned = sum(float(row["over"]) > 1 for row in found) - silent
    worst = digits(max(float(row["over"]) for row in found))
    return f"{warned} exceeded it with a warning, {silent} without one; the largest error was {worst} %"


def tolerances() -> str:
    return table(
        ("tolerance", "pairs", "within it", "beyond it, no warning", "beyond 1.5 times, no warning"),
        (
            (
                f"{100 * tolerance:g} %",
                len(found),
                f"{100 * sum(float(row['over']) <= 1 for row in found) / len(found):.1f} %",
                _silent(found, 1),
                _silent(found, 1.5),
            )
            for tolerance in (0.03, 0.01, 0.003)
            for found in [_pairs(tolerance)]
        ),
    )


def error_map() -> str:
    """Mean shares of nodes within one, two and three times Rendering.error."""
    found = [row for row in rows("refinement") if row["within 1"] not in ("", "nan")]
    shares = [100 * sum(float(row[f"within {n}"]) for row in found) / len(found) for n in (1, 2, 3)]
    return ", ".join(f"{share:.0f} %" for share in shares)


def _estimates(least: float) -> str:
    """Share of images off by at least ``least`` whose estimate is 0.5 to 3 times the true error."""
    found = [row for row in rows("refinement") if float(row["error"]) >= least]
    good = [row for row in found if 0.5 <= float(row["estimate"]) / float(row["error"]) <= 3]
    return f"{100 * len(good) / len(found):.0f} %"


def estimates() -> str:
    return _estimates(0)


def estimates_of_errors() -> str:
    return _estimates(1e-4)


# -- whole calls: performance/whole_calls.py -------------------------------------------------------------

CALLS = {
    "Scene.from_height": "`Scene.from_height`",
    "horizons, 8 azimuths": "`horizons`, 8 azimuths",
    "sky_view_factor, 64": "`sky_view_factor`, 64 azimuths",
    "openness, 64": "`openness`, 64 azimuths",
    "render, 64 azimuths": "`render`, 64 azimuths",
    "tolerance 0.01, direct": "`render(tolerance=0.01)`, direct light",
    "tolerance 0.01, all light": "`render(tolerance=0.01)`, all light, albedo 0.8",
    "environment map, new": "the same of direct light, under an environment map made in the call",
    "environment map, kept": "the same, under one that is kept",
    "function, kept": "the same, under a function of direction",
    "lattice, M = 9": "lattice, M = 9",
    "lamp": "spherical lamp",
    "lamp, tolerance 0.01": "spherical lamp, `tolerance=0.01`",
    "visibility, M = 9": "`visibility`, M = 9",
}


def _call(call: str, size: int, backend: str, given: str, time: str) -> float | None:
    for row in rows("whole_calls"):
        if (row["call"], row["size"], row["backend"], row["input"]) == (call, str(size), backend, given):
            return float(row[time]) if row[time] else None
    return None


def _ms(value: float | None) -> str:
    return "" if value is None else digits(1000 * value)


def whole_calls_card() -> str:
    (card,) = {row["device"] for row in rows("whole_calls")}
    return card


def svf_gpu() -> str:
    """Milliseconds of a sky-view factor of 4096 x 4096 nodes on that card."""
    return _ms(_call("sky_view_factor, 64", 4096, "opencl", "numpy", "new"))


def whole_calls() -> str:
    places = tuple((name, "numpy", ("new", "known", "kernels")) for name in ("opencl", "warp:cuda:0"))
    return table(
        (
            "4096 x 4096 nodes, ms",
            *(f"{backend}, {given}, {time}" for backend, given, times in places for time in times),
        ),
        (
            (
                words,
                *(
                    _ms(_call(call, 4096, backend, given, time))
                    for backend, given, times in places
                    for time in times
                ),
            )
            for call, words in CALLS.items()
        ),
    )


def whole_calls_sizes() -> str:
    sizes = sorted({int(row["size"]) for row in rows("whole_calls")})
    return table(
        ("`opencl`, NumPy in and out, new scene, ms", *(f"{size} x {size}" for size in sizes)),
        (
            (words, *(_ms(_call(call, size, "opencl", "numpy", "new")) for size in sizes))
            for call, words in CALLS.items()
        ),
    )


def horizons_speed() -> str:
    return table(
        ("nodes", "kernels, ms", "cores busy", "ns per horizon", "whole call, ms"),
        (
            (
                f"{one['size']} x {one['size']}",
                digits(1000 * one["light"]["seconds"]),
                f"{one['light']['cores']:.1f}",
                digits(one["ns per horizon"]),
                digits(1000 * one["whole"]["seconds"]),
            )
            for one in facts("horizon")["speed"]
        ),
    )


# -- accuracy: performance/horizon.py, lattice_error.py, interreflection.py ------------------------------


def horizons_accuracy() -> str:
    found = facts("horizon")["accuracy"]
    by = {(one["ground"], one["azimuths"]): one for one in found}
    return table(
        ("azimuths", "rough, RMS", "rough, largest", "smooth, RMS", "smooth, largest"),
        (
            (
                count,
                *(
                    f"{by[ground, count][what]:.4f}"
                    for ground in ("rough", "smooth")
                    for what in ("rms", "max")
                ),
            )
            for count in sorted({one["azimuths"] for one in found})
        ),
    )


def lamps_accuracy() -> str:
    return table(
        ("lamp", "nodes lit", "whole call, s", "RMS", "largest"),
        (
            (
                one["lamp"],
                f"{one['lit']:.0%}",
                digits(one["seconds"]),
                f"{one['rms']:.5f}",
                f"{one['max']:.4f}",
            )
            for one in facts("horizon")["lamps"]
        ),
    )


def lattice() -> str:
    by = {(row["ground"], int(row["M"])): row for row in rows("lattice_error")}
    return table(
        ("M", "directions", "rough, stride", "rough, filled", "smooth, stride", "smooth, filled"),
        (
            (
                size,
                by["rough", size]["directions"],
                *(by[ground, size][step] for ground in ("rough", "smooth") for step in ("stride", "filled")),
            )
            for size in sorted({size for _, size in by})
        ),
    )


def between() -> str:
    found = [row for row in rows("interreflection") if row["size"] == "256"]
    sources = list(dict.fromkeys(row["source"] for row in found))

    def cell(surface: str, tolerance: str, what: str) -> str:
        by = {
            row["source"]: row for row in found if (row["surface"], row["tolerance"]) == (surface, tolerance)
        }
        return ", ".join(digits(100 * float(by[source][what])) for source in sources)

    return table(
        ("surface", "left out", "error at 1 %", "error at 0.3 %"),
        (
            (
                surface,
                cell(surface, "0.01", "left out"),
                cell(surface, "0.01", "error"),
                cell(surface, "0.003", "error"),
            )
            for surface in dict.fromkeys(row["surface"] for row in found)
        ),
    )


def tiles() -> str:
    return table(
        (
            "map",
            "tiles",
            "RMS",
            "99.9th percentile",
            "largest",
            "bias",
            "jump at seams",
            "inside",
            "horizon RMS [rad]",
        ),
        (
            tuple(
                row[name]
                for name in ("map", "tiles", "rms", "p999", "max", "bias", "seams", "inside", "horizon_rms")
            )
            for row in rows("scale")
        ),
    )


# -- depth from images: performance/recover.py -----------------------------------------------------------

SOURCES = {
    "sky": "uniform sky",
    "sun": "sky with sun",
    "lamp": "isotropic lamp",
    "spot": "spotlight, one image",
    "spot, depth known to 6": "spotlight, depth known to 6 spacings",
    "spot and sky": "spotlight and sky, two images",
}


def _recovered() -> list[dict]:
    return facts("recover")["accuracy"]


def _compared() -> list[dict]:
    """Single images whose depth was recovered in both ways."""
    return [one for one in _recovered() if "paper" in one]


def recover_count() -> str:
    return str(len(_compared()))


def recover_ours() -> str:
    """Median RMSE of the default [node spacings]."""
    return digits(median(one["robust"] for one in _compared()))


def recover_carving() -> str:
    """Median RMSE of carving at its best eps [node spacings]."""
    return digits(median(one["paper"] for one in _compared()))


def recover() -> str:
    names = list(dict.fromkeys(one["surface"] for one in _recovered()))
    by = {(one["source"], one["surface"]): one for one in _recovered()}
    body = []
    for source, words in SOURCES.items():
        if not all((source, name) in by for name in names):
            continue
        carved = [by[source, name].get("paper") for name in names if (source, name) in by]
        span = "" if None in carved else f"{digits(min(carved))} to {digits(max(carved))}"
        body.append((words, *(f"{by[source, name]['robust']:.2f}" for name in names), span))
    return table(("source", *names, "carving at its best eps"), body)


def recover_machine() -> str:
    measured = facts("recover")["measured"]
    return f"{measured['machine']}, {measured['cores']} cores, {measured['backend']}, {measured['date']}"


# -------------------------------------------------------------------------------------------------------

# -- generated cases: performance/campaign.py ------------------------------------------------------------


def campaign_relations() -> str:
    """Cases and failures of every relation, over all seeds."""
    cases: dict[str, int] = {}
    failures: dict[str, int] = {}
    for run in facts("campaign")["relations"]:
        for name, count in run["by relation and backend"].items():
            relation = name.split(",")[0]
            cases[relation] = cases.get(relation, 0) + count
        for failure in run["failures"]:
            failures[failure["relation"]] = failures.get(failure["relation"], 0) + 1
    lines = [
        (name, count, failures.get(name, 0)) for name, count in sorted(cases.items(), key=lambda c: -c[1])
    ]
    total = "all", sum(cases.values()), sum(failures.values())
    return table(("relation", "cases", "failures"), [*lines, total])


def campaign_tolerance() -> str:
    """How many images were within their tolerance, of how many."""
    runs = [run["tolerance"] for run in facts("campaign")["relations"]]
    return f"{sum(run['kept'] for run in runs)} of {sum(run['cases'] for run in runs)}"


def campaign_files() -> str:
    """Damaged files that were read."""
    return str(sum(run["cases"] for run in facts("campaign")["damaged files"]))


# -- the page of skylamp view: performance/view.py -------------------------------------------------------


def _frames(source: str) -> str:
    return digits(next(float(r["frames_per_second"]) for r in rows("view") if r["source"] == source))


def view_sun() -> str:
    """Frames a second while the sun is dragged."""
    return _frames("clear sky")


def view_lamp() -> str:
    """Frames a second while the lamp is dragged."""
    return _frames("lamp")


MAKERS: dict[str, Callable[[], str]] = {
    name.replace("_", "-"): function
    for name, function in list(globals().items())
    if callable(function)
    and getattr(function, "__module__", "") == __name__
    and not name.startswith("_")
    and not function.__code__.co_argcount
}


def made(text: str) -> str:
    """The page with its tables and numbers as the data have them."""
    return MARK.sub(lambda match: match.group(1) + MAKERS[match.group(2)]() + match.group(4), text)


def pages() -> list[Path]:
    """Pages that hold data."""
    return [
        page for page in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))] if MARK.search(page.read_text())
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    check = parser.parse_args().check
    differing = [page for page in pages() if made(page.read_text()) != page.read_text()]
    for page in differing:
        if not check:
            page.write_text(made(page.read_text()))
        print("differs:" if check else "wrote", page.relative_to(ROOT))
    sys.exit(check and bool(differing))


if __name__ == "__main__":
    main()
