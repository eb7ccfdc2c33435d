"""Planning for what horizons cannot render: directions of the lattice, filled."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .. import sources
from ..light import lattice
from ..light.base import LightMethod
from ..light.lattice import Lattice, lacking
from ..sources.integrals import Integrals, integrals
from .base import UnitsPlanner, uniform_light
from .plan import Choice

# what is known of the error under lamps given as volumes: RMS over the mean, by shadow rays to cubes at the
# nodes that shine, on two maps of 20 x 22 nodes, tolerance 1 %: 6 and 48 % of a box 6 nodes thick, over
# smooth ground and on blocks that it touches, 35 and 44 % of a rod, 72 to 109 % of a sheet, a row, one node
VOLUME_ERRORS = (
    "under lamps 6 nodes thick it was 6 to 48 % (RMS over the mean), under thinner ones 35 to 110 %"
)


class LatticePlanner(UnitsPlanner):
    """What horizons cannot render: lattice directions, filled."""

    method_class, sample_count = Lattice, 64
    sky: Integrals | None = None  # of the brightness of a window, if it varies

    def choose(self) -> None:
        scene, source = self.scene, self.source
        self.why = lacking(scene, source)
        if isinstance(source, sources.Lamp):  # a volume: nothing but the lattice knows it
            known = lattice.HEMICUBE_ERRORS
            self.unknown = f"{self.why}; {VOLUME_ERRORS}"
            fitting = (size for size, error in known.items() if error <= self.tolerance)
            self.units = next(fitting, max(known))
            assert source.volume is not None, "slices serve every other lamp"
            volume = np.asarray(source.volume)
            volume = volume & (scene.spacing * np.arange(len(volume))[:, None, None] < scene.depth)
            thin = min(int(volume.any(others).sum()) for others in ((1, 2), (0, 2), (0, 1)))
            if thin < (passed := self.units // 2):
                self.unknown += (
                    f"; rays step over up to {passed} nodes, so that a lamp {thin} thick loses light: give it"
                    " as a sphere or a rectangle"
                )
            return
        if callable(source.brightness):
            self.sky = integrals(sources.Sky(source.brightness), self.tolerance)
        self.uniform = uniform_light(self.samples)
        self.choose_units([(0, lattice.HEMICUBE_ERRORS)])

    def set_exact_light(self, units: int) -> None:
        self.exact = lattice.through_window(self.samples, self.scene, self.source, self.sky)

    def light_by(self, units: int) -> np.ndarray:
        return lattice.at_samples(self.samples, self.scene, self.source, units, self.sky)

    def make(self) -> LightMethod:
        return Lattice(self.engine, self.scene, self.source, self.units, self.sky)

    def refine(self, is_mostly_common: bool) -> bool:
        if self.method.units >= max(lattice.HEMICUBE_ERRORS):
            return False
        self.method.refine()
        return True

    def choices(self) -> Iterator[Choice]:
        yield Choice("occlusion", "by ground", self.why)
        why = self.unknown or "the smallest whose light at the samples is that of many directions"
        yield Choice("directions", f"hemicube {self.units}, filled", why)
