"""``skylamp.geo``: GeoTIFF with its georeference (extra ``geo``)."""

from .io.geotiff import Raster, header, is_geotiff, read, window, write

__all__ = ["Raster", "header", "is_geotiff", "read", "window", "write"]
