"""The arguments of render(), checked against each other, the scene and the source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import shading, sources
from .checks import one_of, positive_number
from .directions import Azimuths, Hemicube
from .errors import bad
from .images import IMAGES
from .interreflection import check_choice
from .light import lattice
from .light.propagation import Lobe
from .reflectance import BRDF
from .scene import Scene, check_scene

RENDER_METHODS = ("auto", "lattice", "horizon", "unoccluded")
DEFAULT_AZIMUTHS = 64  # of method "horizon", unless given
REPEATED_LOBE = "a lobe over a map that repeats"


@dataclass(frozen=True)
class Options:
    """What :func:`render` was asked for, but for scene, source and backend."""

    method: str = "auto"
    tolerance: float = 0.01
    quantity: str = "radiance"
    hemicube: int | Hemicube | None = None
    filled: bool | None = None
    weights: str = "moment"
    azimuths: int | Azimuths | None = None
    max_distance: float | None = None
    tail: float | None = None
    interreflection: bool | str = "auto"
    parts: bool = False

    @property
    def lattice(self) -> bool:
        """Whether arguments of the lattice are given."""
        return self.hemicube is not None or self.filled is not None or self.weights != "moment"

    @property
    def horizon(self) -> bool:
        """Whether arguments of horizons are given."""
        return self.azimuths is not None or self.max_distance is not None

    @property
    def chooses(self) -> bool:
        """Whether the method is the library's choice."""
        return self.method == "auto" and not self.lattice and not self.horizon

    def lobe(self, scene: Scene) -> Lobe | None:
        return shading.lobe_of(scene) if self.quantity == "radiance" else None

    def brdf(self, scene: Scene) -> bool:
        return self.quantity == "radiance" and isinstance(scene.reflectance, BRDF)

    def mirror(self, scene: Scene) -> bool:
        return self.quantity == "radiance" and shading.has_mirror(scene)

    def shines(self, scene: Scene) -> bool:
        """Whether there is more to show than rho E / pi."""
        return self.lobe(scene) is not None or self.brdf(scene) or self.mirror(scene)

    def needs_irradiance(self, scene: Scene) -> bool:
        """Whether irradiance is asked for, or reflected: a surface that only shines needs none."""
        if self.quantity == "irradiance" or bool(np.any(scene.albedo)):
            return True
        return not (shading.lobe_of(scene) or shading.has_mirror(scene))

    def missing(self, scene: Scene, source: sources.Source) -> str:
        """Why horizons, slices and closed forms cannot render this, or nothing."""
        if scene.sides == "periodic" and self.lobe(scene):
            return REPEATED_LOBE
        return lattice.lacking(scene, source)

    def planned(self, scene: Scene, source: sources.Source) -> bool:
        """Whether the library's choice is refined until it is within the tolerance."""
        return self.chooses and self.missing(scene, source) != REPEATED_LOBE

    def check(self, scene: Scene, source: sources.Source) -> None:
        """InputError unless all arguments go together."""
        check_scene(scene)
        one_of(self.method, RENDER_METHODS, "method")
        one_of(self.quantity, tuple(IMAGES), "quantity")
        one_of(self.weights, ("moment", "printed"), "weights")
        if not isinstance(self.filled, (bool, type(None))):
            raise bad("filled", repr(self.filled), "True, False or None")
        sources.check_source(source)
        positive_number(self.tolerance, "tolerance")
        check_choice(self.interreflection)
        if not isinstance(self.parts, bool):
            raise bad("parts", repr(self.parts), "True or False")
        self._check_method()
        missing = self.missing(scene, source)
        if missing and (self.method in ("horizon", "unoccluded") or self.horizon):
            raise bad(
                f"method '{'horizon' if self.horizon else self.method}'",
                missing,
                "a sky, a rectangular window, or a lamp given by its centre and radius or by a corner and"
                " edges, windows and lamps with sides='open' or 'dark'",
                "" if isinstance(source, sources.Lamp) and source.volume is None else "Use method='lattice'.",
            )
        if self.method == "unoccluded" and self.shines(scene):
            raise bad("method 'unoccluded'", type(scene.reflectance).__name__, "a Lambertian surface")
        if self.tail is not None and not self.planned(scene, source):
            raise bad("tail", self.tail, "a bound for method='auto' without arguments of a method")

    def _check_method(self) -> None:
        """InputError where arguments of another method are given."""
        if self.horizon and (self.lattice or self.method == "lattice"):
            raise bad(
                "render: arguments of two methods",
                "azimuths or max_distance with the lattice's",
                "azimuths and max_distance with method='horizon'; hemicube, filled and weights with"
                " 'lattice'",
            )
        if self.method == "horizon" and self.lattice:
            raise bad(
                "method 'horizon' with hemicube, filled or weights", "both", "azimuths and max_distance"
            )
        if self.method == "unoccluded" and (self.lattice or self.horizon):
            raise bad(
                "method 'unoccluded' with arguments of another",
                "both",
                "neither azimuths and max_distance nor hemicube, filled and weights",
            )


def sectors_of(azimuths: int | Azimuths | None, axes: tuple[float, float] = (1.0, 1.0)) -> Azimuths:
    """Sectors of azimuth, as asked, in the axes of a map, see ``Scene.axes``."""
    if not isinstance(azimuths, Azimuths):
        azimuths = Azimuths(DEFAULT_AZIMUTHS if azimuths is None else azimuths)
    return azimuths.on_axes(axes)
