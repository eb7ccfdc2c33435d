"""``skylamp.plot``: pictures of fields, horizons, maps and recovered depth (extra ``plot``)."""

from .app.plot import field, horizon, recovery, save, sectors, terrain

__all__ = ["field", "horizon", "recovery", "save", "sectors", "terrain"]
