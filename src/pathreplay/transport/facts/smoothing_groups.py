"""Smoothing groups of meshes: sets of triangles that are shaded as one surface. Edges lie where two groups meet.

Triangles with a common vertex share its shading normal. At a visible edge, and at a seam of texture coordinates,
modelling programs duplicate vertices. The triangles on both sides then have two positions in common, but no vertex.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from pathreplay.platform import compat

WELD, ULPS = 1e-5, 4
"""Vertices coincide if their distance is at most WELD times the mesh's diagonal plus ULPS units in the last place."""


def mesh_smoothing_groups(mesh: mi.Mesh) -> np.ndarray:
    """Return the `smoothing_groups` of a smooth mesh; zeros for a rectangle, whose vertices are not accessible."""
    data = compat.mesh_arrays(mi.traverse(mesh))
    if data is None:
        return np.zeros(mesh.face_count(), int)
    # Seams of emitters are not edges, because emission is continuous across a seam. Boundary segments that detect such
    # seams would be wasted, and fewer segments would detect outlines.
    return smoothing_groups(data.faces, data.positions, 0 if mesh.is_emitter() else WELD)


def smoothing_groups(faces: np.ndarray, positions: np.ndarray, weld: float = WELD) -> np.ndarray:
    """Return the group index of each triangle; all indices are zero in a mesh without edges.

    Triangles connected by common vertices form a group. If an edge ends inside a group, triangles of this group meet
    across the edge: they have two positions in common, but no vertex. Each such triangle becomes a group of its own.
    Two positions count as equal if their distance is at most ``weld`` times the mesh's diagonal plus rounding. For
    ``weld`` = 0 they must be exactly equal.
    """
    count = len(positions)
    groups = _components(faces.ravel(), np.roll(faces, 1, axis=1).ravel(), count)[faces[:, 0]]
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2).astype(np.int64), axis=1)
    _, side, shared = np.unique(sides[:, 0] * count + sides[:, 1], return_inverse=True, return_counts=True)
    alone = np.flatnonzero(shared[side] == 1)
    places = _places(positions, sides[alone].ravel(), weld)
    of = alone // 3  # triangle indices
    meeting = np.column_stack([np.sort(places.reshape(-1, 2), axis=1), groups[of]])
    _, where, together = np.unique(meeting, axis=0, return_inverse=True, return_counts=True)
    torn = of[together[where.ravel()] > 1]
    groups[torn] = count + torn
    return np.unique(groups, return_inverse=True)[1].reshape(-1)


def _places(positions: np.ndarray, vertices: np.ndarray, weld: float) -> np.ndarray:
    """Return an index for the position of each vertex; vertices that coincide up to rounding have equal indices.

    Modelling programs compute both ends of a seam separately, for example as sin 0 and sin 2π. The two results differ
    in the last bits.
    """
    from scipy.spatial import cKDTree

    ends, at = np.unique(vertices, return_inverse=True)
    if not len(ends):
        return at
    diagonal = np.linalg.norm(np.ptp(positions, axis=0))
    near = weld * diagonal + ULPS * np.finfo(np.float32).eps * np.abs(positions).max() if weld else 0.0
    pairs = cKDTree(positions[ends]).query_pairs(near, output_type="ndarray")
    return _components(pairs[:, 0], pairs[:, 1], len(ends))[at]


def _components(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Return the index of the connected component of each of ``count`` nodes; node a[i] is linked to node b[i].

    SciPy is imported here, because importing it takes long, and most processes do not need it.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(a), bool), (a, b)), (count, count))
    return connected_components(links, directed=False)[1]
