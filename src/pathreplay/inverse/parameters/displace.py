"""Displacement of a mesh by height maps, a built-in derived parameter.

    p = p₀ + Σ w_k h_k(u, v) d,    where p₀ is the position of a vertex in the scene, (u, v) are its coordinates on the
                                   maps h_k, d is a unit vector, and w_k is the factor of the vertex for map k

The position is linear in the entries of the maps, so its derivative is exact. Mitsuba recomputes vertex normals from
positions whenever they are set, and derivatives propagate through this computation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import Displace
from pathreplay.platform import compat
from pathreplay.platform.owned_arrays import with_space
from pathreplay.scenes.parameters import get_array


@dataclass(frozen=True)
class HeightMap:
    """Displacement of n vertices by one height map. A call returns the displaced positions as 3 n floats.

    Vertices with equal positions p₀ have the same direction and move by the mean of their displacements. A watertight
    mesh therefore stays watertight, although files duplicate vertices at creases and seams of texture coordinates.
    """

    coordinates: mi.Point2f
    direction: mi.Vector3f
    """Unit vector per vertex, multiplied by the factor of the vertex."""
    merged: mi.UInt32 | None
    """Index of the position of each vertex, or None if all positions differ."""
    share: mi.Float
    """1 / n for each vertex, where n is the number of vertices at the same position."""
    cubic: bool

    def __call__(self, first: mi.Float, heights: mi.TensorXf) -> mi.Float:
        """Compute the displaced positions.

        Args:
            first: positions p₀.
            heights: height map of shape (rows, columns, 1) in scene units. Row 0 is at v = 0, as in a bitmap texture.

        Returns:
            The positions p.
        """
        grid = mi.Texture2f(heights, wrap_mode=dr.WrapMode.Clamp, use_accel=False, migrate=False)
        height = (grid.eval_cubic if self.cubic else grid.eval)(self.coordinates)[0]
        step = height * self.direction
        if self.merged is not None:
            step = mi.Vector3f(*(self._averaged(component) for component in step))
        return first + dr.ravel(step)

    def _averaged(self, component: mi.Float) -> mi.Float:
        sums = dr.zeros(mi.Float, dr.width(self.coordinates))
        dr.scatter_add(sums, component * self.share, self.merged)
        return dr.gather(mi.Float, sums, self.merged)


def displacement_of(params: mi.SceneParameters, key: str, options: Displace) -> Callable[..., mi.Float]:
    """Make the displacement of a mesh, by one height map for each name in ``options.weights``.

    Args:
        params: parameters of the scene.
        key: key of the vertex positions of the mesh.
        options: direction, coordinates, factors and interpolation.

    Returns:
        A function that computes the displaced positions from the positions p₀ and the height maps.

    Raises:
        PathreplayError: the key is not the vertex positions of a mesh, or the mesh lacks coordinates or factors.
    """
    owner, faces = key.rpartition(".")[0], compat.faces_of_positions(params, key)
    if faces is None:
        raise PathreplayError(f"Parameter '{key}' is not the vertex positions of a mesh; remove 'displace'")
    positions = get_array(params[key]).reshape(-1, 3)
    places, counts = np.unique(positions, axis=0, return_inverse=True, return_counts=True)[1:]
    places = places.ravel()
    if options.direction == "normal":
        direction = _normals(positions.astype(np.float64), places[faces], faces, len(counts))[places]
    else:
        vector = np.array(options.direction)
        if not (length := np.linalg.norm(vector)):
            raise PathreplayError(
                f"Parameter '{key}' is displaced along the direction {options.direction}; give a vector that is not "
                "zero, or 'normal'"
            )
        direction = np.broadcast_to(vector / length, positions.shape)
    u, v = _coordinates(params, key, options.coordinates, positions)
    coordinates = mi.Point2f(with_space(u), with_space(v))
    merged = None if len(counts) == len(positions) else mi.UInt32(with_space(places.astype(np.uint32)))
    share = mi.Float(with_space((1 / counts[places]).astype(np.float32)))
    maps = []
    for name in options.weights if isinstance(options.weights, list) else [options.weights]:
        factors = _factors(params, key, owner, name, len(positions))
        scaled = mi.Vector3f(*map(with_space, (direction * factors[:, None]).T.astype(np.float32)))
        maps.append(HeightMap(coordinates, scaled, merged, share, options.interpolation == "cubic"))

    def displaced(first: mi.Float, *heights: mi.TensorXf) -> mi.Float:
        for place, grid in zip(maps, heights, strict=True):
            first = place(first, grid)
        return first

    return displaced


def require_map(key: str, name: str, shape: tuple[int, ...]) -> None:
    """Raise PathreplayError unless the variable ``name``, which displaces ``key``, has the shape of a height map."""
    if len(shape) != 3 or shape[2] != 1:
        raise PathreplayError(
            f"Parameter '{key}' is displaced by '{name}' of shape {list(shape)}; give a height map of shape [rows, "
            "columns, 1]"
        )


def _normals(
    positions: NDArray[np.float64], corners: NDArray[np.integer], faces: NDArray[np.integer], count: int
) -> NDArray[np.float64]:
    """Return the unit normal at each of ``count`` distinct positions.

    The normal at a position is the mean of the normals of the adjacent faces, weighted by the angles of the faces.

    Args:
        positions: positions of all vertices.
        corners: for each face, the indices of the distinct positions of its three corners.
        faces: for each face, the indices of its three vertices.
        count: number of distinct positions.
    """
    points = positions[faces]
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    sums = np.zeros((count, 3))
    for i in range(3):
        a, b = points[:, (i + 1) % 3] - points[:, i], points[:, (i + 2) % 3] - points[:, i]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b))
        for axis in range(3):
            sums[:, axis] += np.bincount(corners[:, i], angle * normal[:, axis], count)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)


def _factors(params: mi.SceneParameters, key: str, owner: str, name: str | None, count: int) -> NDArray[np.floating]:
    """Return the factor on the displacement of each of the ``count`` vertices, from the vertex attribute ``name``.

    If ``name`` is None, all factors are 1. Raises PathreplayError if the mesh lacks the attribute, or if the attribute
    does not have one number per vertex or is zero at all vertices.
    """
    if name is None:
        return np.ones(count)
    if f"{owner}.{name}" not in params:
        known = [other.rpartition(".")[2] for other in params.keys() if other.startswith(f"{owner}.vertex_")]
        others = ", ".join(sorted({*known}.difference(compat.POSITIONS, compat.NORMALS, compat.TEXCOORDS))) or "none"
        raise PathreplayError(
            f"Parameter '{key}': displace.weights is '{name}', but the mesh has no such attribute (it has: {others}); "
            "add it to the mesh file, or remove 'weights'"
        )
    factors = get_array(params[f"{owner}.{name}"])
    if factors.size != count:
        raise PathreplayError(
            f"Parameter '{key}': displace.weights is '{name}', which has {factors.size} numbers for {count} vertices; "
            "give one number per vertex"
        )
    if not factors.any():
        raise PathreplayError(
            f"Parameter '{key}': displace.weights is '{name}', which is 0 at all vertices; give some vertices 1"
        )
    return factors.ravel()


def _coordinates(
    params: mi.SceneParameters, key: str, kind: str, positions: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return (u, v) of all vertices as two rows.

    The coordinates are texture coordinates if ``kind`` is 'uv'. Otherwise ``kind`` names two axes, and the coordinates
    are the positions along these axes, scaled to [0, 1]. Raises PathreplayError if the mesh lacks texture coordinates,
    or has no extent along one of the axes.
    """
    if kind == "uv":
        known = compat.texcoords_of(params, key)
        if not known.size:
            raise PathreplayError(
                f"Parameter '{key}': the mesh has no texture coordinates, which place the height map; set "
                "displace.coordinates to two axes such as 'xy', or add texture coordinates"
            )
        return np.ascontiguousarray(known.T)
    axes = positions[:, ["xyz".index(axis) for axis in kind]]
    low, extent = axes.min(axis=0), np.ptp(axes, axis=0)
    if not extent.all():
        flat = kind[int(np.argmin(extent))]
        raise PathreplayError(
            f"Parameter '{key}': displace.coordinates is '{kind}', but the mesh has no extent along {flat}; name two "
            "other axes"
        )
    return np.ascontiguousarray(((axes - low) / extent).T.astype(np.float32))
