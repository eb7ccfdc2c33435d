"""Generated cases against all that must hold of them, on every backend; docs/evidence/robustness.md: results.

    python performance/campaign.py --cases 10000 --seed 1 --seconds 2400 --out campaign
    python performance/campaign.py --kills 300 --calls 200 --out surroundings
    python performance/campaign.py --replay "mirrors" --case "Case(...)" --backend opencl

Writes OUT.json: machine, versions, seed, cases by relation and backend, seconds, the share of cases that kept
their tolerance, and every failure with the case that makes it again. Exits with 1 where there was one. Cases
are hypothesis', whose choice the seed fixes; nothing is shrunk. A case that takes more than --bound seconds
of the processor is a failure too.
"""

import argparse
import faulthandler
import json
import os
import platform
import signal
import sys
import time
import traceback
from collections import Counter
from importlib.metadata import version
from pathlib import Path

import hypothesis

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzz import cases, environment, odd, relations  # noqa: E402  after the path

import skylamp as sl  # noqa: E402

SHARES = (("opencl", 0.6), ("numpy", 0.25), ("warp:cpu", 0.15))
SKIPPED = {"opencl": [], "numpy": ["files", "backends agree"]}  # files need no backend: once suffices
HANGS = 10  # bounds of real time after which a case inside a library's call ends the campaign
CHUNK = 25  # cases of a relation and a backend in a row


class Overdue(Exception):
    """A case took too long."""


def machine():
    names = ("skylamp", "numpy", "warp-lang", "pyopencl", "hypothesis")
    return {
        "machine": platform.platform(),
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in names},
        "backends": {info.name: info.device for info in sl.backends() if info.available},
    }


def drawn(relation, backend, count, seed, bound, log, current):
    """``count`` cases of a relation on a backend; failures go to ``log``.

    ``current``: file that holds the case that is running, for what does not come back.
    """
    done = 0

    def overdue(*_):
        raise Overdue(f"longer than {bound} s")

    signal.signal(signal.SIGPROF, overdue)

    def one(case):
        nonlocal done
        done += 1
        start = time.perf_counter()
        current.write_text(repr(case))
        faulthandler.dump_traceback_later(HANGS * bound, exit=True)
        signal.setitimer(signal.ITIMER_PROF, bound)
        try:
            relation.check(case, backend)
        except Exception as error:
            log(case, backend, error, time.perf_counter() - start)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            faulthandler.cancel_dump_traceback_later()

    settings = hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    hypothesis.seed(seed)(settings(hypothesis.given(relation.strategy)(one)))()
    return done


def campaign(options):
    start, counts, failures = time.perf_counter(), Counter(), []
    chosen = {
        name: relation
        for name, relation in relations.RELATIONS.items()
        if name not in options.without and (not options.only or name in options.only)
    }
    backends = [(options.backend, 1.0)] if options.backend else SHARES
    weights = {
        (name, backend): relation.weight * share
        for name, relation in chosen.items()
        for backend, share in backends
        if name not in SKIPPED.get(backend, ["files"])
    }
    number, current = 0, Path(f"{options.out}.current")
    while sum(counts.values()) < options.cases and time.perf_counter() - start < options.seconds:
        name, backend = min(weights, key=lambda key: counts[key] / weights[key])

        def log(case, backend, error, seconds, name=name):
            where = traceback.extract_tb(error.__traceback__)[-1]
            failure = {
                "relation": name,
                "backend": backend,
                "case": repr(case),
                "error": f"{type(error).__name__}: {str(error)[:400]}",
                "at": f"{Path(where.filename).name}:{where.lineno}",
                "seconds": round(seconds, 2),
            }
            failures.append(failure)
            print(json.dumps(failure), flush=True)

        number += 1
        counts[name, backend] += drawn(
            chosen[name], backend, CHUNK, options.seed * 1_000_003 + number, options.bound, log, current
        )
        report(options, start, counts, failures)
    return failures


def report(options, start, counts, failures):
    kept = relations.KEPT
    found = {
        **machine(),
        "seed": options.seed,
        "cases": sum(counts.values()),
        "seconds": round(time.perf_counter() - start),
        "by relation and backend": {f"{name}, {backend}": n for (name, backend), n in sorted(counts.items())},
        "tolerance": kept,
        "failures": failures,
    }
    temporary = Path(f"{options.out}.json.tmp")
    temporary.write_text(json.dumps(found, indent=1))
    temporary.replace(f"{options.out}.json")


def surroundings(options):
    """Killed writers and threads; the numbers go to OUT.json."""
    found = {**machine(), "seed": options.seed, "kills": options.kills, "calls": options.calls}
    if options.kills:
        half, left = environment.killed_writers(options.kills, seed=options.seed)
        found["half files"], found["temporary files left"] = half, left
    for info in sl.backends() if options.calls else []:
        if info.available and options.backend in (None, info.name.split(":")[0], info.name):
            wrong = environment.wrong_on_threads(info.name, calls=options.calls)
            found[f"wrong of {8 * options.calls} calls on 8 threads, {info.name}"] = wrong
    Path(f"{options.out}.json").write_text(json.dumps(found, indent=1))


def replay(options):
    """Makes one case again, and shows what it raises."""
    names = {"nan": float("nan"), "inf": float("inf"), **vars(cases), **vars(odd)}
    relations.RELATIONS[options.replay].check(eval(options.case, names), options.backend or "opencl")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument(
        "--bound", type=float, default=60.0, help="seconds of the processor that a case may take"
    )
    parser.add_argument("--only", nargs="*", choices=list(relations.RELATIONS))
    parser.add_argument("--without", nargs="*", choices=list(relations.RELATIONS), default=[])
    parser.add_argument("--backend", help="this one alone; else " + ", ".join(name for name, _ in SHARES))
    parser.add_argument("--out", default="campaign")
    parser.add_argument("--kills", type=int, default=0, help="kill -9 of a writer so often, instead of cases")
    parser.add_argument("--calls", type=int, default=0, help="calls of 8 threads each, instead of cases")
    parser.add_argument("--replay", choices=list(relations.RELATIONS))
    parser.add_argument("--case", help="what a failure says of its case")
    options = parser.parse_args()
    faulthandler.enable()
    if options.replay:
        replay(options)
        return
    if options.kills or options.calls:
        surroundings(options)
        return
    sys.exit(1 if campaign(options) else 0)


if __name__ == "__main__":
    main()
