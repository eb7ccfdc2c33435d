"""The fifteen skies of the CIE standard general sky, the sun's disc in them, and the sun's position.

Directions of the sky are given as in terrain analysis and solar engineering: azimuth [degree] clockwise from
geographic north (-y), so that 90 is east (+x), and elevation [degree] above the horizon. Brightness functions
take unit vectors L, as all brightness functions here do.
"""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..checks import number_or_nan
from ..errors import bad, import_extra
from .brightness import Directions, Disc, Distribution, brightness_number

SUN_RADIUS = 0.2665  # [degree], the mean apparent radius of the sun
# ISO 15469:2004 / CIE S 011:2003, table 1: gradation a, b; indicatrix c, d, e
PARAMETERS = {
    1: (4.0, -0.70, 0.0, -1.0, 0.00), 2: (4.0, -0.70, 2.0, -1.5, 0.15), 3: (1.1, -0.80, 0.0, -1.0, 0.00),
    4: (1.1, -0.80, 2.0, -1.5, 0.15), 5: (0.0, -1.00, 0.0, -1.0, 0.00), 6: (0.0, -1.00, 2.0, -1.5, 0.15),
    7: (0.0, -1.00, 5.0, -2.5, 0.30), 8: (0.0, -1.00, 10.0, -3.0, 0.45), 9: (-1.0, -0.55, 2.0, -1.5, 0.15),
    10: (-1.0, -0.55, 5.0, -2.5, 0.30), 11: (-1.0, -0.55, 10.0, -3.0, 0.45),
    12: (-1.0, -0.32, 10.0, -3.0, 0.45), 13: (-1.0, -0.32, 16.0, -3.0, 0.30),
    14: (-1.0, -0.15, 16.0, -3.0, 0.30), 15: (-1.0, -0.15, 24.0, -2.8, 0.15),
}  # fmt: skip
WITHOUT_SUN = (1, 3, 5)  # whose brightness does not depend on the sun


@dataclass(frozen=True)
class CieSky(Distribution):
    """A brightness function, made by :func:`cie_sky`: (..., 3) unit vectors -> (...), 0 below the horizon.

    ``sun`` (azimuth, elevation) [degree] or None; ``zenith``: brightness of the zenith; ``direct``:
    irradiance by the sun's disc of a surface that faces it. The function itself is the sky without the disc,
    which :func:`skylamp.render` adds: as a part of the integrated sky, or, where a method is asked for, as a
    lamp far away, in slices. No set of directions is fine enough for it.

    Examples
    --------
    >>> sky = sl.cie_sky(12, sun=(135, 30), horizontal=100, direct=700)
    >>> sky.sun, round(float(sky(np.array([0, 0, -1])) / sky.zenith), 6)
    ((135.0, 30.0), 1.0)
    """

    type: int
    sun: tuple[float, float] | None
    zenith: float
    direct: float = 0.0

    def by_formula(self) -> bool:
        return True

    def __call__(self, L: np.ndarray) -> np.ndarray:
        L = np.asarray(L, float)
        up = -L[..., 2]
        light = self.zenith * gradation(self.type, up) / gradation(self.type, 1.0)
        if self.sun is not None:
            chi = np.arccos(np.clip(L @ towards(*self.sun), -1, 1))
            light = light * scattered(self.type, chi) / scattered(self.type, np.radians(90 - self.sun[1]))
        return np.where(up >= 0, light, 0.0)

    def scaled(self, factor: float) -> CieSky:
        """This sky and its disc, ``factor`` times as bright."""
        return replace(self, zenith=self.zenith * factor, direct=self.direct * factor)

    def disc(self) -> Disc | None:
        if not self.direct:
            return None
        assert self.sun is not None, "cie_sky requires a sun where there is a disc"
        return Disc(tuple(towards(*self.sun)), self.direct, math.radians(SUN_RADIUS))

    def without_disc(self) -> CieSky:
        return replace(self, direct=0.0)

    def narrow(self) -> Directions:
        """The direction of the disc, if there is one."""
        disc = self.disc()
        return () if disc is None else (disc.direction,)

    def horizontal(self) -> float:
        """Irradiance of an open level surface by the sky without the disc [unit of brightness x sr]."""
        return self.zenith * _horizontal(self.type, self.sun)


def cie_sky(
    type: int,
    sun: tuple[float, float] | None = None,
    zenith: float | None = None,
    *,
    horizontal: float | None = None,
    direct: float = 0.0,
) -> CieSky:
    """A sky of the CIE standard general sky (ISO 15469:2004), as a brightness function for ``Sky``.

    B(L) / B(zenith) = f(chi) phi(Z) / (f(Z_sun) phi(0)), with Z the angle from the zenith, chi the angle from
    the sun, phi(Z) = 1 + a exp(b / cos Z) and f(chi) = 1 + c (exp(d chi) - exp(d pi / 2)) + e cos^2 chi.

    Parameters
    ----------
    type : 1 to 15
        1: overcast, steep gradation (the CIE standard overcast sky's pattern), 5: uniform, 7: partly cloudy,
        12: the CIE standard clear sky of low turbidity, 13: that of a polluted atmosphere, 15: white-blue
        turbid with a broad corona.
    sun : (azimuth, elevation) [degree]
        Clockwise from north (-y), above the horizon (0 to 90); see :func:`sun_position`. Not needed for 1, 3
        and 5, which do not depend on it.
    zenith : float [unit of brightness]
        Brightness of the zenith, 1 unless given.
    horizontal : float [unit of brightness x sr], optional
        Instead of ``zenith``: the diffuse irradiance of open level ground, which the sky is scaled to.
    direct : float [unit of brightness x sr]
        Irradiance by the sun's disc of a surface that faces it; 0, no disc, unless given. The disc has a
        radius of 0.2665 degrees and the uniform brightness direct / (pi sin^2 radius). It goes with
        ``render``: by default on any sides, with method="horizon" or "unoccluded" on sides "open" or "dark".
        The lattice, windows, mirrors, BRDFs, ``max_distance`` and ``recover`` raise InputError.

    Returns
    -------
    CieSky
        A function of unit vectors (..., 3) that returns their brightness (...) [unit of ``zenith``].

    Raises
    ------
    InputError
        For another type, a sun that is missing or not above the horizon, or brightness that is not finite.

    Examples
    --------
    >>> sky = sl.cie_sky(12, sun=(180, 45), zenith=2.0)
    >>> round(float(sky(np.array([0, 0, -1]))), 6)
    2.0
    """
    if isinstance(type, bool) or not isinstance(type, (int, float, np.number)) or type not in PARAMETERS:
        raise bad("cie_sky: type", repr(type), "a whole number from 1 to 15")
    if sun is None and (type not in WITHOUT_SUN or direct):
        raise bad(
            f"cie_sky: type {type}{' with direct' * bool(direct)}",
            "no sun",
            "sun=(azimuth, elevation) in degrees",
            "sun_position gives it from time and place.",
        )
    if sun is not None:
        sun = _angles(sun)
    if zenith is not None and horizontal is not None:
        raise bad("cie_sky: brightness", "zenith and horizontal", "one of the two")
    direct = brightness_number(direct, "direct: brightness")
    if horizontal is not None:
        zenith = brightness_number(horizontal, "horizontal: brightness") / _horizontal(int(type), sun)
    return CieSky(int(type), sun, brightness_number(1.0 if zenith is None else zenith), direct)


def cie_clear(
    sun: tuple[float, float],
    zenith: float | None = None,
    *,
    turbid: bool = False,
    horizontal: float | None = None,
    direct: float = 0.0,
) -> CieSky:
    """The CIE standard clear sky: type 12 of :func:`cie_sky`, or 13 where ``turbid``.

    Arguments and errors are those of :func:`cie_sky`.

    Returns
    -------
    CieSky
        A function of unit vectors (..., 3) that returns their brightness (...) [unit of ``zenith``].

    Examples
    --------
    >>> sky = sl.Sky(sl.cie_clear((135, 30), horizontal=90, direct=600))
    >>> E = sl.render(sl.Scene(np.zeros((3, 3))), sky, quantity="irradiance").image
    >>> round(float(E[1, 1]))  # 90 + 600 sin 30
    390
    """
    return cie_sky(13 if turbid else 12, sun, zenith, horizontal=horizontal, direct=direct)


def sun_position(
    time: datetime.datetime | str, latitude: float, longitude: float, altitude: float = 0.0
) -> tuple[float, float]:
    """(azimuth, elevation) of the sun [degree], for ``sun`` of :func:`cie_sky`.

    The elevation is with refraction, and below 0 at night. ``time``: a datetime with a time zone, or such a
    time as ISO 8601 text ("2026-06-21T09:00+02:00"). ``latitude``, ``longitude`` [degree], north and east
    positive; ``altitude`` [metre]. By pvlib (NREL's algorithm, Reda and Andreas 2004).

    Raises InputError for a time without a zone or a place that is not on Earth, or if pvlib is not installed.

    Returns
    -------
    (azimuth, elevation) [degree]
        Azimuth clockwise from true north, elevation above the horizontal plane. The azimuth on a map is this
        less :func:`skylamp.geo.convergence` of it.

    Examples
    --------
    >>> azimuth, elevation = sl.sun_position("2026-06-21T12:00+00:00", 51.48, 0.0)
    >>> round(azimuth), round(elevation)
    (179, 62)
    """
    try:
        when = datetime.datetime.fromisoformat(time) if isinstance(time, str) else time
        known = when.date() and when.utcoffset() is not None
    except (ValueError, AttributeError, TypeError):
        allowed = "a datetime, or ISO 8601 text, with its time zone"
        raise bad("sun_position: time", repr(time), allowed) from None
    if not known:
        raise bad(
            "sun_position: time without a zone",
            str(time),
            "a time with its time zone",
            "Append Z for universal time, or +02:00.",
        )
    numbers = check_place("sun_position", latitude, longitude, altitude)
    pandas, pvlib = import_extra("sun_position", "pvlib", "sun", "pandas", "pvlib")
    position = pvlib.solarposition.get_solarposition(
        pandas.DatetimeIndex([when]), numbers[0], numbers[1], altitude=numbers[2]
    )
    return float(position["azimuth"].iloc[0]), float(position["apparent_elevation"].iloc[0])


def gradation(type: int, sine: Any) -> Any:
    """phi of a CIE type, by the sine of the elevation."""
    a, b, *_ = PARAMETERS[type]
    return 1 + a * np.exp(b / np.maximum(sine, 1e-9))


def scattered(type: int, chi: Any) -> Any:
    """f of a CIE type, by the angle [rad] from the sun."""
    c, d, e = PARAMETERS[type][2:]
    return 1 + c * (np.exp(d * chi) - np.exp(d * np.pi / 2)) + e * np.cos(chi) ** 2


LOWEST, HIGHEST = -1000, 10_000  # [metre], altitudes of ground; chosen round the Dead Sea and Everest


def check_place(what: str, *place: Any) -> list[float]:
    """Latitude, longitude and altitude as numbers; InputError for a place that is not on Earth."""
    numbers = [number_or_nan(value) for value in place]
    on_earth = np.isfinite(numbers).all() and abs(numbers[0]) <= 90 and abs(numbers[1]) <= 360
    if not on_earth or not all(LOWEST <= altitude <= HIGHEST for altitude in numbers[2:]):
        allowed = (
            f"latitude -90 to 90, longitude -360 to 360 [degree], altitude {LOWEST:,} to {HIGHEST:,} [metre]"
        )
        raise bad(f"{what}: place", place, allowed)
    return numbers


def towards(azimuth: float, elevation: float) -> np.ndarray:
    """The unit vector (x, y, z) towards (azimuth clockwise from north, elevation) [degree]."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), -np.sin(e)])


def _angles(sun: Any) -> tuple[float, float]:
    try:
        azimuth, elevation = (float(v) for v in sun)
    except (TypeError, ValueError, OverflowError):
        azimuth = elevation = np.nan
    if not (np.isfinite(azimuth) and 0 <= elevation <= 90):
        raise bad("sun", repr(sun), "(azimuth clockwise from north, elevation 0 to 90) in degrees")
    return azimuth, elevation


def _horizontal(type: int, sun: tuple[float, float] | None) -> float:
    """Irradiance of level ground for a zenith of 1.

    Gauss-Legendre quadrature in the sine of elevation, 128 azimuths from the sun's on.
    """
    node, weight = np.polynomial.legendre.leggauss(96)
    sine = (1 + node) / 2
    azimuth = 2 * np.pi * (np.arange(128)[:, None] + 0.5) / 128 + (np.radians(sun[0]) if sun else 0.0)
    cosine = np.sqrt(1 - sine**2)
    L = np.stack([cosine * np.sin(azimuth), -cosine * np.cos(azimuth), np.broadcast_to(-sine, (128, 96))], -1)
    return float(np.pi / 128 * (CieSky(type, sun, 1.0)(L) @ (weight * sine)).sum())
