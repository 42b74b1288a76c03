"""Facts about the triangles of smooth-shaded meshes, on which the search for edges depends.

A mesh is coarse if its triangles deviate from their shading normals. Near the silhouette, such triangles occlude
emitters that lie above the horizon of the shading normal. Sides of its triangles are therefore edges. They are also
edges of meshes whose BSDF depends on the tangent, if tangents jump between neighbouring triangles: Mitsuba's tangent is
constant in each triangle.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeGuard

import mitsuba as mi
import numpy as np

from pathreplay.platform import compat
from pathreplay.transport.facts.nodes import is_mesh, nodes_of
from pathreplay.transport.facts.traits import RELIEFS

COARSE = 1.0
"""Mean angle in degrees between geometric and shading normals, or between neighbouring tangents, that matters."""
INSPECTED = 20_000
"""Largest number of triangles that are inspected after each change of the vertices."""


class Facets:
    """Facts about the triangles of all smooth-shaded meshes of a scene."""

    def __init__(self, shapes: Iterable[mi.Shape]) -> None:
        self.meshes = [shape for shape in shapes if _is_smooth(shape)]
        self._positions = [compat.positions_array(mesh) for mesh in self.meshes]
        self._coarse = [is_coarse(mesh) for mesh in self.meshes]
        self._by_tangent = [depends_on_tangent(mesh.bsdf()) for mesh in self.meshes]
        pairs = zip(self.meshes, self._by_tangent, strict=True)
        self._jumps = [by_tangent and has_jumps(mesh) for mesh, by_tangent in pairs]

    def update(self) -> None:
        """Find out again which meshes are coarse, where vertices changed."""
        for i, mesh in enumerate(self.meshes):
            positions = compat.positions_array(mesh)
            if positions.index != self._positions[i].index:
                self._positions[i], self._coarse[i] = positions, is_coarse(mesh)

    @property
    def coarse(self) -> bool:
        """Whether some mesh is coarse."""
        return any(self._coarse)

    @property
    def brushed(self) -> tuple[int, ...]:
        """Indices of the meshes whose triangles all count as edges.

        These are the meshes with jumps of tangents. If such a mesh is coarse, all coarse meshes are included.
        """
        facts = list(zip(self._coarse, self._by_tangent, self._jumps, strict=True))
        any_coarse = any(coarse and by_tangent for coarse, by_tangent, _ in facts)
        return tuple(i for i, (coarse, _, jumps) in enumerate(facts) if jumps or (any_coarse and coarse))


def _is_smooth(shape: mi.Shape) -> TypeGuard[mi.Mesh]:
    return is_mesh(shape) and not shape.has_face_normals() and compat.has_normals(shape)


def is_coarse(mesh: mi.Mesh) -> bool:
    """Return whether triangles deviate from their shading normals by more than `COARSE` degrees on average."""
    if (data := compat.mesh_arrays(mi.traverse(mesh))) is None:
        return False
    faces = data.faces[:: -(-len(data.faces) // INSPECTED)]
    a, b, c = (data.positions[faces[:, i]].astype(np.float64) for i in range(3))
    n = _unit(np.cross(b - a, c - a))
    return _mean_angle(np.einsum("fk,fik->fi", n, data.normals[faces])) > COARSE


def has_jumps(mesh: mi.Mesh) -> bool:
    """Return whether neighbouring triangles differ in their tangents ∂p/∂u by more than `COARSE` degrees on average.

    The tangent of a triangle is compared with the mean tangents at its vertices.
    """
    data = compat.mesh_arrays(mi.traverse(mesh))
    if data is None or not len(data.texcoords):
        return False
    a, b, c = (data.positions[data.faces[:, i]].astype(np.float64) for i in range(3))
    x, y, z = (data.texcoords[data.faces[:, i]].astype(np.float64) for i in range(3))
    u, v = y - x, z - x
    orientation = np.sign(u[:, :1] * v[:, 1:] - u[:, 1:] * v[:, :1])
    tangents = _unit(orientation * ((b - a) * v[:, 1:] - (c - a) * u[:, 1:]))
    valid = np.linalg.norm(tangents, axis=1) > 0
    corners, tangents = data.faces[valid].ravel(), tangents[valid]
    sums = [np.bincount(corners, np.repeat(tangents[:, k], 3), len(data.positions)) for k in range(3)]
    around = _unit(np.stack(sums, 1))[data.faces[valid]]
    return len(tangents) > 0 and _mean_angle(np.einsum("fk,fik->fi", tangents, around)) > COARSE


def depends_on_tangent(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF, or one nested in it, depends on the shading tangent."""
    if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Anisotropic):
        return True
    return any(isinstance(node, mi.BSDF) and node.class_name() in RELIEFS for node in {bsdf, *nodes_of(bsdf)})


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


def _mean_angle(cosines: np.ndarray) -> float:
    """Return the mean of angles in degrees."""
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())
