"""Sources of light: their shapes, their brightness, and its integrals over the sky."""

from ..constants import APERTURE, BALL, RECTANGLE, SKY, VOLUME
from .brightness import Brightness, cie_overcast, cosine_power, directions_of, environment_map, uniform
from .shapes import Geometry, Lamp, Sky, Source, Window, channels, geometry, in_range, radiance, without_disc
from .tables import azimuth_profile, elevation_table

__all__ = [
    "APERTURE",
    "BALL",
    "RECTANGLE",
    "SKY",
    "VOLUME",
    "Brightness",
    "Geometry",
    "Lamp",
    "Sky",
    "Source",
    "Window",
    "azimuth_profile",
    "channels",
    "cie_overcast",
    "cosine_power",
    "directions_of",
    "elevation_table",
    "environment_map",
    "geometry",
    "in_range",
    "radiance",
    "uniform",
    "without_disc",
]
