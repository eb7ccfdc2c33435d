"""Suns and skies of many times, summed into one brightness, with pvlib.

The sum is a table of cells, as fine as those that :class:`~skylamp.sources.integrals.Integrals` divides any
sky into, so it is integrated and refined once, however many times it holds. Each sun's disc is shared out
among the cells that it covers. Skies of one CIE type and one elevation of the sun are one pattern, turned:
their sum is a convolution over azimuth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import real_array, whole_number
from ..errors import InputError, bad, import_extra
from .brightness import EnvironmentMap, directions_of
from .cie import PARAMETERS, SUN_RADIUS, check_place, gradation, scattered
from .integrals import COLS, ROWS

CELL, TURN = math.pi / 2 / ROWS, 2 * math.pi / COLS  # [rad] height and width of a cell
# points of equal light in a sun's disc, 0.08 degrees apart: half a cell
DISC_POINTS = 37
# columns as wide as a cell is high, from which on discs are spread over azimuth: 14 degrees round the zenith
NARROW_COLUMNS = 4
SUNS_AT_ONCE = 2**14  # whose points are shared out together: some 60 MB
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # [rad] from point to point of a sunflower's pattern
# elevations of the sun, a degree apart, whose skies are computed; between them is interpolated
SUN_CLASSES = 91
# cells along each side of a cell of scattered light: half a degree, a tenth of its finest feature
SCATTERED_PARTS = 4
# [rad] height of the band at the horizon (Perez et al. 1987: 6.5 degrees)
PEREZ_BAND = math.radians(6.5)
LONGEST, STRONGEST = 1e5, 1e9  # [hour], [W m^-2] that a time may stand for and a sun may give; chosen
PEREZ_LEAST_COSINE = math.cos(math.radians(85))  # of the sun's angle from the zenith, in circumsolar light


@dataclass(frozen=True, eq=False)
class SkyOverTime(EnvironmentMap):
    """A brightness function, made by :func:`sky_over_time`: (..., 3) unit vectors -> (...) [kWh m^-2 sr^-1].

    image: the sum as an equirectangular map (1280, 2304), laid out as for :func:`environment_map`. ghi, dhi:
    irradiation of open level ground [kWh m^-2] by all light, and the diffuse part of it that was given or
    computed (of "perez" less reaches level ground where the sun is lower than 5 degrees, as with pvlib).
    suns: number of positions of the sun above the horizon. Cells are 0.14 degrees high, which blurs a disc of
    0.53 degrees a little: at one time with the sun lower than two degrees shadows on rough ground err by
    0.5 to 1 % (RMS), whatever the tolerance is; a ``CieSky`` with ``direct`` has no such limit.

    Examples
    --------
    >>> year = sl.sky_over_time(["2026-06-21T12:00+02:00"], 48.0, 9.0, hours=1)
    >>> year.image.shape, year.suns, year.dhi < year.ghi
    ((1280, 2304), 1, True)
    """

    ghi: float
    dhi: float
    suns: int


def sky_over_time(
    times: Any,
    latitude: float,
    longitude: float,
    altitude: float = 0.0,
    *,
    dni: Any = None,
    dhi: Any = None,
    model: Any = "perez",
    hours: Any = None,
    substeps: int = 1,
    convergence: float = 0.0,
) -> SkyOverTime:
    """The suns and skies of many times as one brightness, for ``Sky``: a day, a season, a year of light.

    One ``render(scene, Sky(sky_over_time(...)), quantity="irradiance")`` gives the irradiation in kWh m^-2:
    the sum of the images of all times [W m^-2], each times its hours, over 1000.

    Parameters
    ----------
    times : pandas.DatetimeIndex, or an argument of it
        With a time zone. The position of the sun is that at these times: for values that are means over an
        hour, give the middle of the hour.
    latitude, longitude, altitude : float [degree, north and east positive; metre]
        Of the map. One sun and one sky serve all of it.
    dni, dhi : (times,) [W m^-2], optional
        Measured direct normal and diffuse horizontal irradiance, both or neither. Without them those of a
        clear sky (Ineichen and Perez 2002, with pvlib's monthly Linke turbidity). While the sun is
        down, dni has no effect, and dhi comes evenly from the sky.
    model : "perez", 1 to 15, or (times,) of these numbers
        How dhi is spread over the sky. "perez": Perez et al. 1990 as in ``pvlib.irradiance.perez``: even
        light, circumsolar light, which comes from the sun's disc, and a band of 6.5 degrees at the horizon.
        A number: that type of the CIE standard general sky, see :func:`cie_sky`, say 12 for clear days and 1
        for overcast ones.
    hours : float or (times,), optional
        Hours that each time stands for; the step of ``times`` where that is even.
    substeps : int
        Positions of the sun, evenly over the hours of each time and around it; 1 unless given. With 12 for
        times an hour apart the discs follow one another along the sun's track without a gap of more than 1.3
        degrees, and shadows are no longer those of separate hours.
    convergence : float [degree]
        Of the map: the azimuth of its north, clockwise from true north, see
        :func:`skylamp.geo.convergence`. Some degrees in a UTM zone, tens in systems of continents.

    Returns
    -------
    SkyOverTime
        Brightness in kWh m^-2 sr^-1, with ``ghi`` and ``dhi`` of open level ground [kWh m^-2].

    Raises
    ------
    InputError
        For times without a zone or without an even step and hours, a place that is not on Earth, dni or dhi
        that do not fit or are not finite and >= 0 by day, or if pvlib is not installed.

    Examples
    --------
    >>> import pandas
    >>> hours = pandas.date_range("2026-01-01", "2027-01-01", freq="h", inclusive="left", tz="UTC")
    >>> year = sl.sky_over_time(hours, 36.6, -84.2, altitude=500)
    >>> flat = sl.Scene.from_height(np.zeros((3, 3)))
    >>> kwh = sl.render(flat, sl.Sky(year), quantity="irradiance", azimuths=16).image[1, 1]
    >>> round(float(kwh / year.ghi), 2)
    1.0
    """
    place = check_place("sky_over_time", latitude, longitude, altitude)
    pandas, pvlib = import_extra("sky_over_time", "pvlib", "sun", "pandas", "pvlib")
    index = _index(times, pandas)
    step = _hours(index, hours)
    measured = _measured(dni, dhi, index, pandas.Timedelta(hours=float(step.max())))
    types = _types(model, len(index))
    substeps = whole_number(substeps, "sky_over_time: substeps", 1)
    shift = (np.arange(substeps) + 0.5) / substeps - 0.5
    index = index.repeat(substeps) + pandas.to_timedelta(np.outer(step, shift).ravel(), "h")
    step, types = (np.repeat(values, substeps) for values in (step / substeps, types))
    turn = float(real_array(convergence, "sky_over_time: convergence", 0))
    if not abs(turn) <= 360:
        raise bad("sky_over_time: convergence", turn, "-360 to 360 degrees")
    return _summed(index, place, step / 1000, types, measured, pvlib, turn)


def _summed(
    index: Any,
    place: list[float],
    weight: np.ndarray,
    types: np.ndarray,
    measured: Any,
    pvlib: Any,
    turn: float,
) -> SkyOverTime:
    """The sum of light [W m^-2] times ``weight``; ``measured`` (2, times), each for equally many of index;
    ``turn``: convergence [degree].
    """
    # the table of turbidities holds no others
    east = place[1] if abs(place[1]) <= 180 else (place[1] + 180) % 360 - 180
    location = pvlib.location.Location(place[0], east, altitude=place[2])
    sun = location.get_solarposition(index)
    if measured is None:
        clear = location.get_clearsky(index, solar_position=sun)
        light = np.stack([clear["dni"].to_numpy(), clear["dhi"].to_numpy()])
    else:
        light = np.repeat(measured, len(index) // measured.shape[1], 1)
    azimuth, elevation = sun["azimuth"].to_numpy() - turn, sun["apparent_elevation"].to_numpy()
    light = _checked(light, elevation > 0, index)
    up = np.flatnonzero(elevation > 0)
    night = np.delete(weight * light[1], up).sum()
    azimuth, elevation, index, weight = azimuth[up], elevation[up], index[up], weight[up]
    types, (beam, diffuse) = types[up], light[:, up]
    sky = np.full((ROWS, COLS), night / math.pi)
    perez = types == 0
    if perez.any():
        at = azimuth[perez], elevation[perez]
        even, band, circumsolar = _perez(index[perez], *at, beam[perez], diffuse[perez], pvlib)
        beam[perez] += circumsolar
        sky += weight[perez] @ even
        sky[: round(PEREZ_BAND / CELL)] += weight[perez] @ band
        np.maximum(sky, 0, out=sky)  # rounding
    for kind in np.unique(types[~perez]):
        of = types == kind
        sky += _scattered(int(kind), azimuth[of], elevation[of], weight[of] * diffuse[of])
    sky += _discs(azimuth, elevation, weight * beam)
    # below the horizon only what interpolation needs
    image = np.concatenate([sky[::-1], sky[:1], np.zeros((ROWS - 1, COLS))])
    return SkyOverTime(image, _level(sky), float(night + weight @ diffuse), len(up))


def _index(times: Any, pandas: Any) -> Any:
    """``times`` as a pandas.DatetimeIndex with a zone."""
    try:
        if np.ndim(times) > 1:
            raise ValueError("more than one axis")
        index = pandas.DatetimeIndex(times)
    except (TypeError, ValueError) as error:
        raise bad(
            "sky_over_time: times", f"{type(times).__name__} ({error})", "a pandas.DatetimeIndex"
        ) from None
    if not len(index) or index.hasnans:
        raise bad(
            "sky_over_time: times",
            f"{len(index)} times, missing ones: {index.hasnans}",
            "at least one, none missing",
        )
    if index.tz is None:
        raise bad(
            "sky_over_time: times without a zone",
            str(index[0]),
            "times with a time zone",
            'Use times.tz_localize("UTC").',
        )
    return index


def _hours(index: Any, hours: Any) -> np.ndarray:
    """(times,) [hour] that each time stands for."""
    if hours is None:
        steps = np.diff(index.asi8 if hasattr(index, "asi8") else index.astype("int64"))
        if not len(steps) or steps[0] <= 0 or (steps != steps[0]).any():
            raise bad(
                "sky_over_time: times without an even step",
                f"{len(index)} times, {len(np.unique(steps))} different steps"
                + (", backwards" if (steps < 0).any() else ""),
                "times that increase evenly, or hours",
                "Pass hours=1.0 for values of an hour each.",
            )
        hours = (index[1] - index[0]).total_seconds() / 3600
    durations = real_array(hours, "sky_over_time: hours", None)
    wrong = durations[~((durations > 0) & (durations <= LONGEST))]
    if durations.shape not in ((), (len(index),)) or wrong.size:
        raise bad(
            "sky_over_time: hours",
            f"shape {durations.shape}" + (f" with {wrong[0]}" if wrong.size else ""),
            f"numbers > 0, at most {LONGEST:g}, one or {len(index)}",
        )
    return np.broadcast_to(durations, len(index))


def _measured(dni: Any, dhi: Any, index: Any, longest: Any) -> np.ndarray | None:
    """(2, times) [W m^-2], or None.

    Times of a pandas.Series may differ by one shift, say half an hour, up to the ``longest`` step.
    """
    if dni is None and dhi is None:
        return None
    if dni is None or dhi is None:
        raise InputError(
            f"sky_over_time: {'dni' if dhi is None else 'dhi'} is given without the other;"
            " allowed: both, or neither for a clear sky."
        )
    measured: dict[str, np.ndarray] = {
        "dni": real_array(dni, "sky_over_time: dni", 1),
        "dhi": real_array(dhi, "sky_over_time: dhi", 1),
    }
    for (name, values), given in zip(measured.items(), (dni, dhi)):
        if len(values) != len(index):
            raise bad(f"sky_over_time: {name}", f"{len(values)} values", f"{len(index)}, one for every time")
        labels: Any = getattr(given, "index", None)
        if getattr(labels, "tz", None) is None:
            continue
        if (index - labels).nunique() > 1 or abs(index[0] - labels[0]) > longest:
            raise bad(
                f"sky_over_time: {name}, a Series of other times",
                f"{labels[0]} to {labels[-1]}",
                f"the order and the steps of times, {index[0]} to {index[-1]}",
                "Use its reindex(times), or pass its values.",
            )
    return np.stack(list(measured.values()))


def _types(model: Any, count: int) -> np.ndarray:
    """(times,) CIE types, 0 for Perez."""
    if isinstance(model, str) and model == "perez":
        return np.zeros(count, int)
    types = np.asarray(model)
    fits = types.dtype.kind in "iu" and types.shape in ((), (count,))
    if not fits or not np.isin(types, list(PARAMETERS)).all():
        allowed = f'"perez", a CIE type from 1 to 15, or {count} such types'
        raise bad("sky_over_time: model", repr(model), allowed)
    return np.broadcast_to(types, count)


def _checked(light: np.ndarray, up: np.ndarray, index: Any) -> np.ndarray:
    """dni and dhi (2, times): by night no dni, and dhi where there is any."""
    light = np.where(up, light, np.stack([np.zeros(len(up)), np.fmax(light[1], 0)]))
    wrong = ~((light >= 0) & (light <= STRONGEST)).all(0)
    if wrong.any():
        n = int(np.argmax(wrong))
        raise bad(
            f"sky_over_time: dni and dhi of {wrong.sum()} times",
            f"{light[0, n]} and {light[1, n]} at {index[n]}",
            f"numbers from 0 to {STRONGEST:g} [W m^-2], of which dni matters while the sun is up",
            "Fill gaps, or leave these times out and pass hours.",
        )
    return light


def _moments() -> np.ndarray:
    """Light on level ground of a cell of brightness 1 in every row, from the horizon up: (ROWS,)."""
    middle = np.sin(CELL * (np.arange(ROWS) + 0.5)) * math.cos(CELL / 2)
    moments: np.ndarray = middle * _lookup_angles()
    return moments


def _level(sky: np.ndarray) -> float:
    """Irradiance of level ground under cells (ROWS, COLS)."""
    return float(_moments() @ sky.sum(1))


def _perez(
    index: Any, azimuth: np.ndarray, elevation: np.ndarray, dni: np.ndarray, dhi: np.ndarray, pvlib: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Brightness of the even sky and of the band above it [W m^-2 sr^-1], circumsolar light [W m^-2]:
    (times,).

    The first two have the light of pvlib's model on level ground and on a wall. Where that requires a
    negative brightness, of the even sky (by day, of more dhi than comes to the atmosphere) or of the band, it
    is 0; on level ground the sum is the same.
    """
    zenith = 90 - elevation
    there = dhi > 0
    extra = pvlib.irradiance.get_extra_radiation(index[there]).to_numpy()
    airmass = pvlib.atmosphere.get_relative_airmass(zenith[there])
    given = dhi[there], dni[there], extra, zenith[there], azimuth[there], airmass
    even, wall = np.zeros((2, len(dhi)))
    poa = pvlib.irradiance.perez(0, 0, *given, return_components=True)["poa_isotropic"]
    even[there] = np.maximum(poa, 0)
    wall[there] = pvlib.irradiance.perez(90, azimuth[there], *given, return_components=True)["poa_horizon"]
    circumsolar = (dhi - even) / np.maximum(np.cos(np.radians(zenith)), PEREZ_LEAST_COSINE)
    # of a band of brightness 1, on level ground and on a wall
    edge = round(PEREZ_BAND / CELL) * CELL
    on_level, on_wall = math.pi * math.sin(edge) ** 2, edge + math.sin(2 * edge) / 2
    band = np.clip(wall / (on_wall - on_level / 2), -even / (math.pi - on_level), even / on_level)
    return (even - on_level * band) / math.pi, band, circumsolar


def _scattered(kind: int, azimuth: np.ndarray, elevation: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """The sum of skies of a CIE type (ROWS, COLS), whose light on level ground is ``energy`` (times,)."""
    rows, cols = ROWS // SCATTERED_PARTS, COLS // SCATTERED_PARTS
    middle = SCATTERED_PARTS * CELL * (np.arange(rows) + 0.5)
    relative = SCATTERED_PARTS * TURN * np.arange(cols)
    L = directions_of(relative, np.sin(middle)[:, None])
    fine = gradation(kind, np.sin(CELL * (np.arange(ROWS) + 0.5)))
    moments = SCATTERED_PARTS * (_moments() * fine).reshape(rows, SCATTERED_PARTS).sum(1)
    turned = np.radians(azimuth - 90) / (SCATTERED_PARTS * TURN) - 0.5
    suns = _shared(elevation / 90 * (SUN_CLASSES - 1), turned, energy, (SUN_CLASSES, cols))
    spectrum = np.zeros((rows, cols // 2 + 1), complex)
    for n in np.flatnonzero(suns.any(1)):
        e = math.pi / 2 * n / (SUN_CLASSES - 1)
        chi = np.arccos(np.clip(L @ [math.cos(e), 0.0, -math.sin(e)], -1, 1))
        pattern = scattered(kind, chi)
        spectrum += np.fft.rfft(suns[n]) * np.fft.rfft(pattern / (moments @ pattern.sum(1)))
    light = fine[:, None] * _finer(np.fft.irfft(spectrum, cols))
    return np.asarray(light * (energy.sum() / max(_level(light), 1e-300)))


def _finer(cells: np.ndarray) -> np.ndarray:
    """Cells (rows, cols) all round in cells SCATTERED_PARTS times as fine, interpolated bilinearly."""
    for axis, around in ((0, False), (1, True)):
        count = cells.shape[axis]
        place = (np.arange(SCATTERED_PARTS * count) + 0.5) / SCATTERED_PARTS - 0.5
        low = np.floor(place).astype(int)
        part = np.expand_dims(place - low, 1 - axis)
        ends = (
            [low % count, (low + 1) % count] if around else [np.clip(low + n, 0, count - 1) for n in (0, 1)]
        )
        cells = (1 - part) * cells.take(ends[0], axis) + part * cells.take(ends[1], axis)
    return cells


def _shared(row: np.ndarray, col: np.ndarray, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """``values`` at fractional places, shared out among the four cells round each; columns run all round."""
    cells = np.zeros(math.prod(shape))
    low, left = np.floor(row), np.floor(col)
    for i, part in ((0, 1 - row + low), (1, row - low)):
        at = np.clip(low + i, 0, shape[0] - 1).astype(int) * shape[1]
        for j, share in ((0, 1 - col + left), (1, col - left)):
            cell = at + (left + j).astype(int) % shape[1]
            cells += np.bincount(cell, part * share * values, len(cells))
    return cells.reshape(shape)


def _discs(azimuth: np.ndarray, elevation: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """The sum of suns' discs (ROWS, COLS), ``energy`` (times,) on surfaces that face them."""
    a, e = np.radians(azimuth - 90), np.radians(elevation)
    out = math.radians(SUN_RADIUS) * np.sqrt((np.arange(DISC_POINTS) + 0.5) / DISC_POINTS)
    turn = GOLDEN_ANGLE * np.arange(DISC_POINTS)
    across, along = out * np.cos(turn), out * np.sin(turn)
    across, along = across - across.mean(), along - along.mean()  # their middle is the sun's
    # points are shared out between cells of width h, and these are interpolated: each adds h^2 / 6 to the
    # mean square of the distance from the sun's middle along an axis, so that of the points is so much less
    # than a quarter of the radius squared. With the disc's own points, shadows of suns near the horizon err
    # twice as much
    width = np.stack([TURN * np.cos(e), np.full(len(e), CELL)])
    shrink = np.sqrt(1 - 4 / 3 * (width / math.radians(SUN_RADIUS)) ** 2)[..., None]
    grid = np.zeros((ROWS, COLS))
    for some in np.array_split(np.arange(len(a)), -(-len(a) // SUNS_AT_ONCE) or 1):
        c, s, cosine, sine = (f(v)[some, None] for v in (a, e) for f in (np.cos, np.sin))
        right, up = shrink[0, some] * across, shrink[1, some] * along
        # the disc's plane is spanned by the vectors to the right and upwards
        x = c * (cosine - up * sine) - right * s
        y = s * (cosine - up * sine) + right * c
        z = sine + up * cosine
        row = np.arctan2(z, np.hypot(x, y)) / CELL - 0.5
        col = np.arctan2(y, x) / TURN - 0.5
        light = np.broadcast_to(energy[some, None] / DISC_POINTS, row.shape)
        above = sine + along * cosine > 0  # of the disc's own points
        grid += _shared(row[above], col[above], light[above], (ROWS, COLS))
    brightness: np.ndarray = _round_zenith(grid) / _lookup_angles()[:, None]
    return brightness


def _lookup_angles() -> np.ndarray:
    """Solid angles (ROWS,) that a cell's brightness stands for where the table is interpolated bilinearly.

    Those of the cells, but for the row at the zenith: there is none beyond it, so it holds all the way up.
    At t cells from the zenith its weight is 1 up to t = 1/2, then falls to 0 at 3/2: the integral of t is
    13/24, that over the cell 1/2.
    """
    angles: np.ndarray = TURN * np.diff(np.sin(CELL * np.arange(ROWS + 1)))
    angles[-1] *= 13 / 12
    return angles


def _round_zenith(grid: np.ndarray) -> np.ndarray:
    """Cells (ROWS, COLS) whose light near the zenith is spread over as much azimuth as a cell is high.

    Points of a disc are half a cell apart, but columns are far narrower there: each would be a needle.
    """
    spread: np.ndarray = grid.copy()
    columns = CELL / (TURN * np.cos(CELL * (np.arange(ROWS) + 0.5)))  # as wide as a cell is high
    for row in np.flatnonzero(columns >= NARROW_COLUMNS):
        if grid[row].any():
            half = int(columns[row] / 2)
            sums = np.append(0.0, np.cumsum(np.pad(grid[row], (half, half), mode="wrap")))
            spread[row] = np.maximum(0, sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)
    return spread
