"""Light from ground to ground in the inverse: by the images themselves, which show what the ground sends.

A node that sees a share f of the sky gets E = E_d + pi (1 - f) m, m the mean radiance of all that is not sky.
That ground's radiance stands in the image, so m is one gather along the rays of the surface at hand
(light/interreflection.py), and no bounce has to be followed. Every strip of ground that a node sees has links
to the crossings that bound it: the derivative of m by depth.
"""

from __future__ import annotations

import numpy as np

from .. import sources
from ..backends.base import reserve
from ..light.interreflection import Round, Strips
from .forward import BYTES_PER_LINK, DeviceArray, Image, Launcher, Surface, links_of
from .lights import brightness_of, light_of

GROUND_RAYS = Round(24, 1, 8, 0.18)  # as many azimuths as of a source
# room for links of a node in each azimuth, and for those of all nodes of an image: where it is
# full, the last link takes in the rest. Chosen: nodes of deep relief (32 x 32 of three surfaces) took 1 to 4
# in the mean over azimuths, one in an egg-crate all
STRIPS, MOST_LINKS = 8, 2**25


class GroundLight:
    """What the ground sends, for all images of a surface.

    ``radiances`` (rows, cols) of each image, in the unit of its model's brightness; ``relief`` [nodes];
    ``rays`` find the share of sky too; ``strips``: room for links of a node in each azimuth.
    """

    def __init__(
        self,
        launcher: Launcher,
        sides: str,
        images: list[Image],
        radiances: list[np.ndarray],
        relief: float,
        rays: Round = GROUND_RAYS,
        strips: int = STRIPS,
    ):
        self.launcher, self.images = launcher, images
        backend, shape = launcher.backend, launcher.shape
        sent = np.stack(radiances).astype(np.float32)
        self.strips = Strips(backend, sides, sent, relief, rays)
        self.radiance = backend.upload(sent.ravel())
        uniform = [image for image in images if image.is_sky and not image.knots]
        self.has_own_sky = not uniform
        if self.has_own_sky:
            sky = sources.Sky()
            light = light_of(sky, shape, 1.0, brightness_of(sky, rays.azimuths))
            nothing = np.zeros(shape)
            self.sky = Image(backend, light, shape, sides, nothing, nothing)
        else:
            self.sky = uniform[0]
        per_azimuth = min(max(MOST_LINKS // launcher.pixels // rays.azimuths, 1), strips)
        for image in images:
            image.count = image.slices + rays.azimuths * per_azimuth
            if image is not self.sky:
                image.count += self.sky.slices
            reserve(
                backend,
                BYTES_PER_LINK * launcher.pixels * image.count,
                f"Light between {launcher.pixels:,} nodes, by {image.count} links of each",
                "Recover a smaller image, or say interreflection=False.",
            )
            image.links = [links_of(backend, launcher.pixels, image.count) for _ in range(2)]
            image.direct = image.direct[:1] * 2
        backend.finish()

    def add(self, side: int, surface: Surface, z: DeviceArray) -> None:
        """To what the images of depths z were evaluated to be by direct light."""
        if self.has_own_sky:
            self.sky.evaluate(side, surface)
        strips, launcher = self.strips, self.launcher
        strips.find(z)
        for number, image in enumerate(self.images):
            launcher.backend.launch(
                "adjoint",
                "add_ground",
                (launcher.pixels,),
                *(*image.direct[side], *self.sky.direct[side]),
                *(z, surface.tilts, strips.sums, self.radiance, *strips.tables, *image.links[side]),
                *(number, len(self.images), *launcher.shape, strips.width, strips.shift, strips.azimuths),
                *(strips.steps, image.slices, self.sky.slices, image.count),
                *(int(image is self.sky), image.sides),
                lanes=1,
            )
