"""skylamp: spatially varying illumination of depth maps, forward and inverse (Langer and Zucker)."""

import importlib
from types import ModuleType

from .backends import backends
from .directions import Azimuths, Hemicube
from .errors import BackendError, CapacityError, InputError, OutOfTimeError, SkylampError
from .horizon import horizons, openness, sky_view_factor
from .images import Rendering
from .inverse.recover import Recovery, recover
from .light.far import Tiling
from .planning.plan import Plan
from .refinement import plan
from .reflectance import BRDF, Lambertian, Mirror, Phong, grooves
from .rendering import render
from .scale import devices
from .scene import Scene
from .shading import normals
from .sources.brightness import cie_overcast, cosine_power, environment_map, uniform
from .sources.cie import CieSky, cie_clear, cie_sky, sun_position
from .sources.over_time import SkyOverTime, sky_over_time
from .sources.shapes import Lamp, Sky, Window
from .visibility import View, VisibilityField, visibility, visibility_field

_LAZY = {name: f"skylamp.{name}" for name in ("geo", "io", "plot")}  # they import more than arrays need


def __getattr__(name: str) -> ModuleType:
    if name in _LAZY:
        return importlib.import_module(_LAZY[name])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__version__ = "0.1.0"
__all__ = [
    "Azimuths",
    "BRDF",
    "BackendError",
    "CapacityError",
    "CieSky",
    "Hemicube",
    "InputError",
    "Lambertian",
    "Lamp",
    "Mirror",
    "OutOfTimeError",
    "Phong",
    "Plan",
    "Recovery",
    "Rendering",
    "Scene",
    "Sky",
    "SkyOverTime",
    "SkylampError",
    "Tiling",
    "View",
    "VisibilityField",
    "Window",
    "backends",
    "cie_clear",
    "cie_overcast",
    "cie_sky",
    "cosine_power",
    "devices",
    "environment_map",
    "grooves",
    "horizons",
    "normals",
    "openness",
    "plan",
    "recover",
    "render",
    "sky_over_time",
    "sky_view_factor",
    "sun_position",
    "uniform",
    "visibility",
    "visibility_field",
]
