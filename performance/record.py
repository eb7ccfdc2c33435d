"""Where and when a measurement was made: every script that writes data writes this with it."""

import csv
import datetime
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import skylamp as sl

PACKAGES = ("numpy", "warp-lang", "pyopencl", "pocl-binary-distribution")


def processor() -> str:
    """The name of the CPU, as Linux gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")


def facts(backend: str = "auto") -> dict[str, str | int]:
    """Machine, device of ``backend``, cores that this process may use, versions and date."""
    found: dict[str, str | int] = {
        "date": datetime.date.today().isoformat(),
        "machine": processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 0,
        "backend": backend,
        "system": platform.platform(),
        "python": platform.python_version(),
        "skylamp": sl.__version__,
    }
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def comment(more: str = "", backend: str = "auto") -> str:
    """The same as the first line of a CSV."""
    said = "; ".join(f"{name}: {value}" for name, value in facts(backend).items())
    return f"# {said}; {more}" if more else f"# {said}"


def write_rows(path: Path, rows: list[dict], more: str = "", backend: str = "auto") -> None:
    """A CSV file of rows under a :func:`comment`."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        file.write(comment(more, backend) + "\n")
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
