"""Files: arrays in several formats (`files`; `png`, `tiff`, `hdr`), GeoTIFF (`geotiff`), paths (`paths`)."""

from .files import linear, read, read_environment, read_range, terrain, tone_mapped, writable, write
from .paths import folder, replacing

__all__ = [
    "folder",
    "linear",
    "read",
    "read_environment",
    "read_range",
    "replacing",
    "terrain",
    "tone_mapped",
    "writable",
    "write",
]
