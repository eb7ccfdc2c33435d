"""Variable projection: the albedo of every pixel that explains all images best, where none is given."""

from __future__ import annotations

import numpy as np

from .forward import DeviceArray, Image, Launcher

# weight of the prior of an unknown albedo: a deviation of the albedo's own size counts as much as one of this
# size in an image
PRIOR_WEIGHT = 1e-3


class AlbedoFit:
    """The least-squares albedo of every pixel at a surface and at a trial, as a share of what the images'
    gains stand for.

    The prior of the albedo counts as one more image, whose light is 1.
    """

    def __init__(self, launcher: Launcher, images: list[Image]):
        self.launcher, self.images = launcher, images
        self.pixels = launcher.pixels
        backend = launcher.backend
        # sums of light x target and, at both sides, of light^2; what depth and albedo share; the prior's
        # weight and target
        self.over, self.shared, self.weight, self.expected, *self.unders = (
            backend.empty((self.pixels,), np.float32, PRIOR_WEIGHT) for _ in range(6)
        )
        self.ones, self.product = (backend.empty((1, self.pixels), np.float32, 1) for _ in range(2))
        for image in images:
            image.gains = [backend.empty((self.pixels,), np.float32) for _ in range(2)]

    def set_prior(self, albedo: float, weight: float = PRIOR_WEIGHT) -> None:
        """From here on the albedo is expected to be about this; at first 1."""
        self.launcher.backend.fill(self.weight, weight)
        self.launcher.backend.fill(self.expected, weight * albedo)

    def fit(self, side: int) -> None:
        """Fits the albedo to the evaluated light, and sets the images' gains by it."""
        self._match(self.ones, self.weight, self.expected, side, True)
        for image in self.images:
            self._match(image.links[side][0], image.gain, image.target, side, False)
        gains = ((image.gain, image.gains[side]) for image in self.images)
        for gain, out in ((self.ones, self.product), *gains):
            self.launcher.launch(
                "albedo_gain", self.over, self.unders[side], gain, out, self.pixels, dim=(self.pixels,)
            )

    def _match(
        self, light: DeviceArray, gain: DeviceArray, target: DeviceArray, side: int, is_first: bool
    ) -> None:
        sums = self.over, self.unders[side]
        self.launcher.launch(
            "albedo_sums", light, gain, target, *sums, is_first, self.pixels, dim=(self.pixels,)
        )

    def values(self) -> np.ndarray:
        """(pixels,) the albedo that was fitted last."""
        albedo: np.ndarray = self.launcher.backend.download(self.product)[0]
        return albedo
