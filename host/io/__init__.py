"""Files: depth maps, images, environment maps (`files`), GeoTIFF (`geotiff`)."""

from .files import (
    folder,
    read,
    read_environment,
    read_range,
    replacing,
    terrain,
    tone_mapped,
    writable,
    write,
)

__all__ = [
    "folder",
    "read",
    "read_environment",
    "read_range",
    "replacing",
    "terrain",
    "tone_mapped",
    "writable",
    "write",
]
