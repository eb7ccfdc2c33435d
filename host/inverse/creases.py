"""Errors of the model at creases of the surface.

The model takes the normal of a node from central differences. On a crease that is the mean of the normals of
two faces, where the image has that of one of them. As foreshortening is concave, errors along a crease have
mostly one sign and do not cancel, and depth absorbs them: the images fit, and a face lies off as a whole.
"""

from __future__ import annotations

import numpy as np

from .descent import Descent


def errors_at_creases(problem: Descent, z: np.ndarray, is_periodic: bool) -> list[np.ndarray]:
    """Of every image (rows, cols) [unit of the images]: the light at depths z (rows, cols) [nodes], less its
    mean over the normals of the faces that may meet at a node. About 0 where z is smooth.

    The light is (c + p a + q b) / sqrt(1 + p^2 + q^2), p and q the tilts dz/dx and dz/dy; c, a, b are of the
    light that is visible, which is taken as it is.
    """
    z = z.astype(float)
    (p, bend_x), (q, bend_y) = ((part.T for part in _tilts(z.T, is_periodic)), _tilts(z, is_periodic))
    square = 1 + p**2 + q**2
    faces = [(sx * bend_x / 2, sy * bend_y / 2) for sx in (-1, 1) for sy in (-1, 1)]
    found = []
    # light, and its derivatives by the tilts where the light that is visible stays as it is
    for light, by_x, by_y in problem.irradiances(z, [0, 2, 3]):
        a, b = (by * np.sqrt(square) + light * tilt / np.sqrt(square) for by, tilt in ((by_x, p), (by_y, q)))
        flat = light * np.sqrt(square)
        of_faces = [
            np.maximum(flat + dp * a + dq * b, 0) / np.sqrt(1 + (p + dp) ** 2 + (q + dq) ** 2)
            for dp, dq in faces
        ]
        found.append(light - np.mean(of_faces, axis=0))
    return found


def _tilts(z: np.ndarray, is_periodic: bool) -> tuple[np.ndarray, np.ndarray]:
    """Central differences along axis 0 and what of the second differences is rough: their distance from the
    mean of both neighbours'. That is all of it at a crease, and of the fourth order of the spacing where z is
    smooth.
    """
    if is_periodic:
        before, after = np.roll(z, 1, 0), np.roll(z, -1, 0)
        tilts, bends = (after - before) / 2, np.pad(before - 2 * z + after, ((1, 1), (0, 0)), mode="wrap")
    elif len(z) > 2:
        tilts, bends = np.gradient(z, axis=0), np.pad(np.diff(z, 2, axis=0), ((2, 2), (0, 0)), mode="edge")
    else:  # too narrow to bend
        tilts, bends = np.diff(z, axis=0).sum(0) + np.zeros(z.shape), np.zeros((len(z) + 2, z.shape[1]))
    return tilts, bends[1:-1] - (bends[:-2] + bends[2:]) / 2
