"""Sources of light: their shapes, their brightness, and its integrals over the sky."""

from .shapes import (
    APERTURE, BALL, RECTANGLE, SKY, VOLUME, Brightness, Geometry, Lamp, Sky, Source, Window, azimuth_profile, channels, cie_overcast, cosine_power, directions_of,
    elevation_table, environment_map, geometry, looks, radiance, uniform, without_disc,
)

__all__ = [
    "APERTURE", "BALL", "RECTANGLE", "SKY", "VOLUME", "Brightness", "Geometry", "Lamp", "Sky", "Source", "Window", "azimuth_profile", "channels", "cie_overcast",
    "cosine_power", "directions_of", "elevation_table", "environment_map", "geometry", "looks", "radiance", "uniform", "without_disc",
]
