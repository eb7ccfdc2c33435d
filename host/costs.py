"""What rendering costs on this machine's backends: measured once, kept in the user's cache folder."""

from __future__ import annotations

import json
import logging
import math
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import sources
from .backends.base import Backend
from .scene import Scene

VERSION = 7  # of the file and of what is measured
RUNS = 3  # of which the fastest counts: others only disturb
SMALL, SLOW = 24, 0.01  # rows and columns of the first map; seconds that it may take if the second is to be large
LARGE, MODEST = 224, 40
QUICK, LARGEST = 0.008, 1024  # seconds within which a large map tells little: the largest does
UNITS = {"horizon": (8, 32), "sectors": (8, 40), "lattice": (3, 7), "slices": (8, 32), "closed form": (1, 1), "plan": (1, 1)}  # azimuths, sectors, hemicubes, slices; to choose among them
known: dict[str, dict[str, "Cost"]] = {}


class Cost(NamedTuple):
    """seconds = fixed + pixels (each + unit x units), units: azimuths, directions or slices."""

    fixed: float
    each: float
    unit: float

    def seconds(self, pixels: float, units: float = 0.0) -> float:
        return self.fixed + pixels * (self.each + self.unit * units)


class Costs:
    """Costs by method on a backend: from this process, from the cache file, or measured when they are first asked for."""

    def __init__(self, engine: Backend):
        self.engine = engine
        self.key = f"{engine.name}, {engine.device}, {os.cpu_count()} processors"

    def __getitem__(self, method: str) -> Cost:
        here = known.setdefault(self.key, {})
        if method not in here:
            kept = _read()
            here.update({m: cost for m, cost in kept.get(self.key, {}).items() if m not in here})
            if method not in here:
                here[method] = _cost(self.engine, method, *UNITS[method])
                _write({**kept, self.key: here})
        return here[method]


def path() -> Path:
    """The cache file; $XDG_CACHE_HOME or ~/.cache holds its folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "skylamp" / f"costs-{VERSION}.json"


def _read() -> dict[str, dict[str, Cost]]:
    """What the file holds; nothing where it is missing, broken or of another make."""
    try:
        found = json.loads(path().read_text())
        kept = {key: {method: Cost(*map(float, cost)) for method, cost in methods.items()} for key, methods in found.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
    fine = lambda methods: set(methods) <= set(UNITS) and all(math.isfinite(v) and v >= 0 for cost in methods.values() for v in cost)
    return {key: methods for key, methods in kept.items() if fine(methods)}


def _write(all_of_them) -> None:
    """Whole or not at all; a folder that cannot be written costs the next process a measurement."""
    try:
        path().parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path().parent)
        with os.fdopen(handle, "w") as file:
            json.dump(all_of_them, file, indent=1)
        os.replace(name, path())
    except OSError as error:
        logging.getLogger(__name__).info("costs are not kept: %s", error)


def _cost(engine, method, few, many):
    count = (lambda m: m * m + 2 * (m - 1) ** 2) if method == "lattice" else lambda n: n
    first = _seconds(engine, method, SMALL, few)
    size = LARGE if first < SLOW else MODEST
    low = _seconds(engine, method, size, few)
    if size == LARGE and low < QUICK:
        size, low = LARGEST, _seconds(engine, method, LARGEST, few)
    unit = max(0.0, _seconds(engine, method, size, many) - low) / (size**2 * max(1, count(many) - count(few))) if many > few else 0.0
    each = max(0.0, (low - first) / (size**2 - SMALL**2) - unit * count(few))
    return Cost(max(0.0, first - SMALL**2 * (each + unit * count(few))), each, unit)


def _seconds(engine, method, size, units):
    """The fastest whole call on a map of gentle waves that shade each other."""
    from .plan import work as plan
    from .render import by_sectors, render

    y, x = np.mgrid[:size, :size]
    scene = Scene(12 + 6 * np.sin(x / 5) * np.sin(y / 6) + 6 * np.sin((x + y) / 17))
    if method == "slices":  # round the zenith, so that as many slices are taken as are asked for
        source = sources.Lamp(center=(size / 2, size / 2, -size / 4), radius=size / 4.5)
    else:
        source = sources.Sky()
    options = {"lattice": {"method": "lattice", "hemicube": units, "filled": True}, "closed form": {"method": "unoccluded"}}.get(method, {"method": "horizon", "azimuths": units})
    work = lambda: render(scene, source, backend=engine.name, **options)
    if method == "sectors":  # a low sun
        spots = sources.Spots(0.6 + 1e-4 * np.arange(units), np.full(units, 1e-4), np.ones((units, sources.SPOT_KNOTS, 4), np.float32), 0.4, 0.41)
        work = lambda: by_sectors(scene, engine, spots)
    elif method == "plan":
        new = [replace(scene) for _ in range(RUNS + 1)]  # a scene is not looked at twice
        work = lambda: plan(new.pop(), source, 0.01, engine)
    work()  # compiles
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)
