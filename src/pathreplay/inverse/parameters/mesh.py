"""Preconditioned mesh optimisation: "Large Steps in Inverse Rendering of Geometry" (Nicolet et al. 2021).

Gradients of vertex positions are noisy, and often only vertices near silhouettes have a nonzero gradient. The optimiser
therefore steps a function u of the vertices v:

    u = (I + λ L) v,        where L is the combinatorial Laplacian of the mesh.

A step δu moves the vertices by the smooth displacement (I + λ L)⁻¹ δu. Mitsuba's `mi.ad.LargeSteps` implements the same
method; this module uses the sparse solver of SciPy.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from pathreplay.inverse.parameters.neighbours import neighbours

Array = NDArray[np.float32]


class Surface:
    """Large Steps coordinates (`Coordinates`) of a mesh with n vertices and m faces.

    Vertices with equal positions are merged, because steps would otherwise open seams.

    Args:
        positions: vertex positions, 3 n floats.
        faces: vertex indices, 3 m integers.
        smooth: the smoothness λ.
    """

    uniform = True

    def __init__(self, positions: Array, faces: NDArray[np.integer], smooth: float) -> None:
        self._copies, adjacent = neighbours(positions, faces)
        laplacian = scipy.sparse.diags(np.asarray(adjacent.sum(axis=1)).ravel()) - adjacent
        self._matrix = (scipy.sparse.identity(adjacent.shape[0]) + smooth * laplacian).tocsc()
        self._solver = scipy.sparse.linalg.splu(self._matrix)

    @property
    def merges(self) -> bool:
        """Whether several vertices share a position, and therefore each have the whole gradient of this position."""
        return len(self._copies) > self._matrix.shape[0]

    def latent(self, values: Array) -> Array:
        points = np.zeros((self._matrix.shape[0], 3))
        points[self._copies] = values.reshape(-1, 3)
        return self._spread(self._matrix @ points)

    def values(self, latent: Array) -> Array:
        points = np.zeros((self._matrix.shape[0], 3))
        points[self._copies] = latent.reshape(-1, 3)
        return self._spread(self._solver.solve(points))

    def gradient(self, values: Array, by_values: Array) -> Array:
        """Convert the gradient with respect to v to the gradient with respect to u, and add it over merged vertices."""
        total = np.zeros((self._matrix.shape[0], 3))
        np.add.at(total, self._copies, by_values.reshape(-1, 3))
        return self._spread(self._solver.solve(total))

    def _spread(self, points: NDArray[np.float64]) -> Array:
        return points[self._copies].ravel().astype(np.float32)
