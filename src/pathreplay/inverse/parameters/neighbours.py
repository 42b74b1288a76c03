"""Which vertices of a mesh are one place, and which places are neighbours: those that share a side of a face."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray


def neighbours(positions: NDArray[np.floating], faces: NDArray[np.integer]) -> tuple[NDArray[np.integer], Any]:
    """Of vertices (3 n numbers) and faces (3 m): the place of each vertex, and a sparse matrix, 1 for neighbours.

    Vertices in one place are one: files have several where texture coordinates or normals differ.
    """
    points, places = np.unique(positions.reshape(-1, 3), axis=0, return_inverse=True)
    places, n = places.ravel(), len(points)
    corners = places[faces.reshape(-1, 3)]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    i, j = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0).T
    i, j = i[i != j], j[i != j]  # faces without area have such sides
    return places, scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)).tocsr()
