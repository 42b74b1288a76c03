"""Adjacency of the vertices of a mesh, after merging vertices with equal positions."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray


def neighbours(
    positions: NDArray[np.floating], faces: NDArray[np.integer]
) -> tuple[NDArray[np.integer], scipy.sparse.csr_matrix]:
    """Merge vertices with equal positions and compute the adjacency matrix of the merged vertices.

    Mesh files duplicate vertices where texture coordinates or normals differ.

    Args:
        positions: vertex positions, 3 n floats.
        faces: vertex indices, 3 m integers.

    Returns:
        The index of the merged vertex of each of the n vertices, and a sparse matrix with entry 1 where two merged
        vertices share an edge.
    """
    points, places = np.unique(positions.reshape(-1, 3), axis=0, return_inverse=True)
    places, n = places.ravel(), len(points)
    corners = places[faces.reshape(-1, 3)]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    i, j = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0).T
    i, j = i[i != j], j[i != j]  # degenerate faces have edges from a vertex to itself
    return places, scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)).tocsr()
