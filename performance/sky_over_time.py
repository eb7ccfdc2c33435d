"""The light of many hours in one render against a render of every hour: error and time.

    python performance/sky_over_time.py --out docs [--every N] [--case K]

Both are irradiation [kWh m^-2] on real terrain, compared at 200 nodes, of every 11th hour of a year unless
--every says otherwise: some 400 suns a case, which take a quarter of an hour on two busy cores. --every 1 is
the whole year. The renders of single hours share no table with the sum: their skies are functions with the
sun's disc named. Measured light is a clear sky's under clouds from a seeded generator, split by pvlib's Erbs.
Writes sky_over_time.csv.
"""

import argparse
import csv
import os
import platform
import time
from datetime import date
from pathlib import Path

import numpy as np
import pandas
import pvlib

import skylamp as sl
from skylamp import io

NODES, SEED = 200, 23
TOLERANCE = 0.01  # relative RMS error that every render is asked for: the default
SIDE = 128
PLACES = {
    "Jacksboro": (36.6, -84.2),
    "equator": (0.0, 20.0),
    "Tromso": (69.6, 19.0),
    "Cape Town": (-33.9, 18.4),
}
CASES = (  # place, times the heights, model, measured
    ("Jacksboro", 1, "perez", False),
    ("Jacksboro", 4, "perez", False),
    ("Jacksboro", 4, 12, True),
    ("equator", 4, "perez", True),
    ("Tromso", 4, 12, False),
    ("Cape Town", 1, "perez", True),
)


def measured(times: pandas.DatetimeIndex, place: pvlib.location.Location) -> tuple[np.ndarray, np.ndarray]:
    """dni and dhi [W m^-2] of a cloudy place."""
    sun = place.get_solarposition(times)
    share = np.random.default_rng(SEED).uniform(0.15, 1.0, len(times))
    ghi = place.get_clearsky(times, solar_position=sun)["ghi"].to_numpy() * share
    split = pvlib.irradiance.erbs(ghi, sun["zenith"].to_numpy(), times)
    return np.asarray(split["dni"]), np.asarray(split["dhi"])


def perez_sky(sun, dni, dhi, when) -> sl.Sky:
    """The Perez sky of one hour as a plain function [W m^-2 sr^-1] with the sun's disc."""
    azimuth, zenith = sun
    arguments = (dhi, dni, pvlib.irradiance.get_extra_radiation(when), zenith, azimuth)
    mass = pvlib.atmosphere.get_relative_airmass(zenith)
    level = pvlib.irradiance.perez(0, 0, *arguments, mass, return_components=True) if dhi > 0 else None
    wall = pvlib.irradiance.perez(90, azimuth, *arguments, mass, return_components=True) if dhi > 0 else None
    even = float(level["poa_isotropic"]) if level else 0.0
    horizon = float(wall["poa_horizon"]) if wall else 0.0
    beam = dni + (dhi - even) / max(np.cos(np.radians(zenith)), np.cos(np.radians(85)))
    edge = np.radians(6.5)
    on_level, on_wall = np.pi * np.sin(edge) ** 2, edge + np.sin(2 * edge) / 2
    band = max(horizon / (on_wall - on_level / 2), -even / (np.pi - on_level))
    even = (even - on_level * band) / np.pi
    a, e, radius = np.radians(azimuth), np.radians(90 - zenith), np.radians(0.2665)
    towards = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), -np.sin(e)])
    disc = beam / (np.pi * np.sin(radius) ** 2)
    light = lambda L: (
        np.maximum(0, even + band * (-L[..., 2] < np.sin(edge))) + disc * (L @ towards > np.cos(radius))
    )
    return sl.Sky(light, suns=[tuple(towards)])


def compare(name: str, times_heights: float, model, clouds: bool, every: int) -> dict:
    """One line of the table."""
    latitude, longitude = PLACES[name]
    times = pandas.date_range("2026-01-01", "2027-01-01", freq=f"{every}h", inclusive="left", tz="UTC")
    place = pvlib.location.Location(latitude, longitude, altitude=500.0)
    clear = place.get_clearsky(times)
    dni, dhi = measured(times, place) if clouds else (clear["dni"].to_numpy(), clear["dhi"].to_numpy())
    given = {"dni": dni, "dhi": dhi} if clouds else {}
    height = times_heights * io.terrain()[0][100 : 100 + SIDE, 100 : 100 + SIDE]
    spacing = io.terrain()[1]
    rng = np.random.default_rng(SEED)
    rows, cols = rng.integers(SIDE, size=(2, NODES))

    def light(source: sl.Sky) -> np.ndarray:
        scene = sl.Scene.from_height(height, spacing)
        done = sl.render(scene, source, tolerance=TOLERANCE, quantity="irradiance", interreflection=False)
        return np.asarray(done.image)

    light(sl.Sky())  # compiles
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        year = sl.sky_over_time(times, latitude, longitude, 500.0, model=model, **given)
        image = light(sl.Sky(year))
        seconds.append(time.perf_counter() - start)
    sun = place.get_solarposition(times)
    total, hourly, suns = np.zeros(NODES), 0.0, 0
    for n in np.flatnonzero(sun["apparent_elevation"].to_numpy() > 0):
        azimuth, elevation = (float(sun[key].iloc[n]) for key in ("azimuth", "apparent_elevation"))
        if model == "perez":
            source = perez_sky((azimuth, 90 - elevation), dni[n], dhi[n], times[n])
        else:
            source = sl.Sky(sl.cie_sky(model, (azimuth, elevation), horizontal=dhi[n], direct=dni[n]))
        start = time.perf_counter()
        total += light(source)[rows, cols] * every / 1000
        hourly, suns = hourly + time.perf_counter() - start, suns + 1
    error = (image[rows, cols] - total) / total.mean()
    percent = lambda value: round(100 * float(value), 3)
    return {
        "place": name,
        "heights_times": times_heights,
        "model": model,
        "measured": clouds,
        "suns": suns,
        "kwh_m2": round(float(total.mean()), 1),
        "rms_percent": percent(np.sqrt((error**2).mean())),
        "bias_percent": percent(error.mean()),
        "worst_percent": percent(abs(error).max()),
        "seconds": round(min(seconds), 2),
        "hourly_seconds": round(hourly, 1),
        "ratio": round(hourly / min(seconds), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder")
    parser.add_argument("--every", type=int, default=11, metavar="N", help="hours from time to time")
    parser.add_argument("--case", type=int, help="this case alone, from 0")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for n, case in enumerate(CASES):
        if options.case in (None, n):
            rows.append(compare(*case, options.every))
            print(rows[-1], flush=True)
    machine = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "skylamp": sl.__version__,
        "date": date.today(),
    }
    with open(options.out / "sky_over_time.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], *machine])
        writer.writeheader()
        writer.writerows({**row, **machine} for row in rows)


if __name__ == "__main__":
    main()
