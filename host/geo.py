"""``skylamp.geo``: GeoTIFF with its georeference (extra ``geo``)."""

from .io.geotiff import Raster, convergence, header, is_geotiff, read, window, write

__all__ = ["Raster", "convergence", "header", "is_geotiff", "read", "window", "write"]
