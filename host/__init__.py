"""skylamp: spatially varying illumination of depth maps, forward and inverse (Langer and Zucker)."""

from .backends import backends
from .directions import Hemicube
from .errors import BackendError, CapacityError, InputError, SkylampError
from .scene import Scene
from .sources import Lamp, Sky, Window, cie_overcast, cosine_power, environment_map, uniform

__version__ = "0.1.0"
__all__ = [
    "BackendError", "CapacityError", "Hemicube", "InputError", "Lamp", "Scene", "Sky", "SkylampError", "Window",
    "backends", "cie_overcast", "cosine_power", "environment_map", "uniform",
]
