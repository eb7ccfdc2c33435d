"""Several pictures on one grey sheet, without scales: for PNG, without matplotlib."""

from __future__ import annotations

import numpy as np

from ..inverse.recover import Recovery
from ..rendering import render
from ..scene import Scene
from ..sources import Lamp

GREY = 0.5
BORDER = 10  # pixels between pictures and along the edge
ROW = 256  # pixels: pictures of a recovery are enlarged towards this side


def enlarged(picture: np.ndarray, times: int) -> np.ndarray:
    """``picture`` with every pixel repeated ``times`` times along both axes."""
    return np.kron(picture, np.ones((times, times)))


def sheet_of(pictures: list[np.ndarray], across: int) -> np.ndarray:
    """Rows of so many pictures, the small ones enlarged to whole multiples."""
    rows, cols = pictures[0].shape
    down = -(-len(pictures) // across)
    sheet = np.full((down * (rows + BORDER) + BORDER, across * (cols + BORDER) + BORDER), GREY)
    for number, picture in enumerate(pictures):
        picture = enlarged(picture, min(rows // picture.shape[0], cols // picture.shape[1]))
        top = BORDER + (rows + BORDER) * (number // across) + (rows - picture.shape[0]) // 2
        left = BORDER + (cols + BORDER) * (number % across) + (cols - picture.shape[1]) // 2
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def of_recovery(image: np.ndarray, recovered: Recovery, spacing: float) -> np.ndarray:
    """Side by side: image, relief, confidence and residual.

    The relief is the depth under a low lamp; the residual is |model - image|, white at a tenth of the image's
    maximum. What does not count of the image, nan, is black.
    """
    assert recovered.confidence is not None and recovered.residual is not None, "recover() gives both"
    rows, cols = recovered.depth.shape
    size, depth = max(rows, cols) * spacing, recovered.depth - recovered.depth.min()
    lamp = Lamp(center=(-size, -size, -1.5 * size), radius=size / 4)
    relief = render(Scene(depth, spacing), lamp, backend=recovered.backend).image
    pictures = [
        _scaled(image, np.nanmax(image)),
        _scaled(relief, np.percentile(relief, 99)),
        recovered.confidence,
        _scaled(np.abs(recovered.residual), 0.1 * np.nanmax(image)),
    ]
    times = max(1, ROW // max(rows, cols))
    return sheet_of([enlarged(values, times) for values in pictures], 4)


def _scaled(values: np.ndarray, white: float) -> np.ndarray:
    scaled: np.ndarray = np.clip(np.nan_to_num(values) / max(float(white), 1e-30), 0, 1)
    return scaled
