"""Steps that are spread over a mesh, so that it stays one: "Large Steps in Inverse Rendering of Geometry" (2021).

A gradient by vertices is noisy, and only those near an outline have one. So not the vertices v are stepped but

    u = (I + λ L) v,        with L the Laplacian of the mesh that counts neighbours,

which makes of a step δu the smooth change (I + λ L)⁻¹ δu. It is what Mitsuba's `mi.ad.LargeSteps` does, with a sparse
solver that SciPy has.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from pathreplay.inverse.parameters.neighbours import neighbours

Array = NDArray[np.float32]


class Surface:
    """Of a mesh by its vertices (3 n numbers) and faces (3 m): `Coordinates`.

    Vertices in one place are one, so that no seam opens.
    """

    uniform = True

    def __init__(self, positions: Array, faces: NDArray[np.integer], smooth: float) -> None:
        self._copies, adjacent = neighbours(positions, faces)
        laplacian = scipy.sparse.diags(np.asarray(adjacent.sum(axis=1)).ravel()) - adjacent
        self._matrix = (scipy.sparse.identity(adjacent.shape[0]) + smooth * laplacian).tocsc()
        self._solver = scipy.sparse.linalg.splu(self._matrix)

    def latent(self, values: Array) -> Array:
        """u of v."""
        points = np.zeros((self._matrix.shape[0], 3))
        points[self._copies] = values.reshape(-1, 3)
        return self._spread(self._matrix @ points)

    def values(self, latent: Array) -> Array:
        """v of u."""
        points = np.zeros((self._matrix.shape[0], 3))
        points[self._copies] = latent.reshape(-1, 3)
        return self._spread(self._solver.solve(points))

    def gradient(self, values: Array, by_values: Array) -> Array:
        """The derivative by u, of that by v; all copies of a vertex have the same, which is that of their common u."""
        total = np.zeros((self._matrix.shape[0], 3))
        np.add.at(total, self._copies, by_values.reshape(-1, 3))
        return self._spread(self._solver.solve(total))

    def _spread(self, points: NDArray[np.float64]) -> Array:
        return points[self._copies].ravel().astype(np.float32)
