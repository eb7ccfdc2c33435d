"""Light from ground to ground in the inverse: by the images themselves, which show what the ground sends.

A node that sees a share f of the sky gets E = E_d + pi (1 - f) m, m the mean radiance of all that is not sky.
That ground's radiance stands in the image, so m is one gather along the rays of the surface at hand
(light/interreflection.py), and no bounce has to be followed.
"""

from __future__ import annotations

import numpy as np

from .. import sources
from ..light.interreflection import MeanRadiance, Round
from .forward import DeviceArray, Image, Launcher, Surface, links_of
from .lights import brightness_of, light_of

SKY_AZIMUTHS = 24  # by which the share of sky is found, as those of a source
RAYS = Round(24, 1, 8, 0.18)


class Ground:
    """What the ground sends, for all images of a surface.

    ``radiances`` (rows, cols) of each image, in the unit of its model's brightness; ``relief`` [nodes].
    """

    def __init__(
        self,
        launcher: Launcher,
        sides: str,
        images: list[Image],
        radiances: list[np.ndarray],
        relief: float,
    ):
        self.launcher, self.images = launcher, images
        backend, shape = launcher.backend, launcher.shape
        sent = np.stack(radiances).astype(np.float32)
        self.mean = MeanRadiance(backend, sides, sent, relief, RAYS)
        self.radiance = backend.upload(sent.ravel())
        uniform = [image for image in images if image.is_sky and not image.knots]
        self.has_own_sky = not uniform
        if self.has_own_sky:
            sky = sources.Sky()
            light = light_of(sky, shape, 1.0, brightness_of(sky, SKY_AZIMUTHS))
            nothing = np.zeros(shape)
            self.sky = Image(backend, light, shape, sides, nothing, nothing)
        else:
            self.sky = uniform[0]
        for image in images:
            if image is not self.sky:
                image.count = image.slices + self.sky.slices
            image.links = [links_of(backend, launcher.pixels, image.count) for _ in range(2)]
            image.direct = image.direct[:1] * 2
        backend.finish()

    def add(self, side: int, surface: Surface, z: DeviceArray) -> None:
        """To what the images of depths z were evaluated to be by direct light."""
        if self.has_own_sky:
            self.sky.evaluate(side, surface)
        self.mean.find(z)
        for number, image in enumerate(self.images):
            self.launcher.launch(
                "add_ground",
                *(*image.direct[side], *self.sky.direct[side]),
                *(self.mean.found, self.radiance, *image.links[side]),
                *(number, self.launcher.pixels, image.slices, self.sky.slices, int(image is self.sky)),
                dim=(self.launcher.pixels,),
            )
