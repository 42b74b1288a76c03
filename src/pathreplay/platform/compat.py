"""Functions that hide the differences between the interfaces of Mitsuba 3.9 and 3.10.

Version 3.9 is supported. Code for 3.10 follows its development branch. The functions test which names Mitsuba provides,
and ignore its version number.

- Flags of `compute_surface_interaction`: 3.10 has ``Minimal``, ``Shading`` (alias ``Default``) and ``NormalPartials``
  only, and tangents are not part of ``Minimal``.
- Meshes: 3.9 has flat arrays such as ``vertex_positions``; 3.10 has tensors such as ``positions``, with one row per
  point. In 3.10, vertices can refer to positions and normals through index maps, which are empty by default.
- Silhouettes: 3.10 prepares silhouettes lazily, for meshes whose positions have gradients. The difference is without
  effect, because pathreplay does not sample Mitsuba's silhouettes.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.platform.owned_arrays import with_space

POSITIONS = "vertex_positions", "positions"
"""Names of the parameter that consists of the positions of a mesh, in 3.9 and 3.10."""
NORMALS = "vertex_normals", "normals"
TEXCOORDS = "vertex_texcoords", "texcoords"
_FACES = "faces"
_SHADING = "Default"  # a flag that only 3.10 has
_FROM_FIELDS = "from_fields"  # a method of meshes in 3.10, which sets faces, positions and other data
_PREFIXES = "vertex_", "face_"
_OTHERS = _FACES, "bsdf_index", "position_index", "normal_index"


class _Detail(NamedTuple):
    """Combinations of flags for `compute_surface_interaction`, one for each function of the same name below."""

    minimal: int
    shading_frame: int
    shading: int
    normal_partials: int
    follow_shape: int


@cache
def _detail(flags: type[enum.Enum]) -> _Detail:
    """Return the combinations of flags. ``flags`` is the enumeration `mi.RayFlags` of the active variant."""
    value = {name: int(flag.value) for name, flag in flags.__members__.items()}
    minimal, follow = value["Minimal"], value["FollowShape"]
    if _SHADING in value:
        shading = value[_SHADING]
        return _Detail(minimal, shading, shading, shading | value["NormalPartials"], follow)
    every = value["All"]
    return _Detail(minimal, minimal | value["ShadingFrame"], every, every | value["dNGdUV"], follow)


def minimal() -> int:
    """Flags of an interaction with distance, position and geometric normal."""
    return _detail(mi.RayFlags).minimal


def shading_frame() -> int:
    """Flags of an interaction with the fields of `minimal` and a shading frame."""
    return _detail(mi.RayFlags).shading_frame


def shading() -> int:
    """Flags of an interaction with the fields of `shading_frame`, texture coordinates, tangents and `wi`."""
    return _detail(mi.RayFlags).shading


def normal_partials() -> int:
    """Flags of an interaction with the fields of `shading` and derivatives of the normal.

    The derivatives are those of the geometric normal in 3.9, and those of the shading normal in 3.10. On shapes other
    than meshes, the two normals are equal.
    """
    return _detail(mi.RayFlags).normal_partials


def follow_shape() -> int:
    """Flag of an interaction that follows the shape: its derivatives are taken at fixed surface coordinates."""
    return _detail(mi.RayFlags).follow_shape


def triangle_corners(
    hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.Point3f, mi.Point3f, mi.Point3f]:
    """Return the corners of the triangle that was hit.

    The corners carry the derivatives of the mesh and of the instance that contains the mesh.
    """
    points = []
    for uv in ((0, 0), (1, 0), (0, 1)):
        corner = mi.PreliminaryIntersection3f(hit)
        corner.prim_uv = mi.Point2f(*uv)
        points.append(corner.compute_surface_interaction(ray, minimal() | follow_shape(), active).p)
    a, b, c = points
    return a, b, c


def triangle_point(
    hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Vector3f]:
    """Return the interaction with the triangle that was hit, at fixed surface coordinates, and the area vector.

    The area vector is the cross product of two sides of the triangle. The sides carry the same derivatives as the
    corners (see `triangle_corners`), except in instances: there, Mitsuba 3.9 returns sides in the coordinates of the
    mesh.
    """
    si = hit.compute_surface_interaction(ray, minimal() | follow_shape(), active)
    if _SHADING in mi.RayFlags.__members__:
        a, b, c = triangle_corners(hit, ray, active)
        return si, dr.cross(b - a, c - a)
    return si, dr.cross(si.dp_du, si.dp_dv)  # both are sides, because the flags request no texture coordinates


class MeshArrays(NamedTuple):
    """The data of a mesh with n vertices and m faces."""

    faces: NDArray[np.integer]
    """Vertex indices, (m, 3)."""
    positions: NDArray[np.float32]
    """Positions, (n, 3)."""
    normals: NDArray[np.float32]
    """Normals, (n, 3), or (0, 3) if the mesh has none."""
    texcoords: NDArray[np.float32]
    """Texture coordinates, (n, 2), or (0, 2) if the mesh has none."""


def mesh_arrays(params: Mapping[str, object]) -> MeshArrays | None:
    """Return the data of a mesh, or None for a shape whose positions are not accessible, such as a rectangle.

    Args:
        params: ``mi.traverse(mesh)``.
    """
    if _FACES not in params:
        return None
    positions = _rows(params, POSITIONS, 3)
    at = _index(params, "position_index", len(positions))
    normals, texcoords = _rows(params, NORMALS, 3), _rows(params, TEXCOORDS, 2)
    if len(normals):
        # With an empty `normal_index` and as many normals as positions, normals are indexed by `position_index`.
        with_positions = len(normals) == len(positions)
        normals = normals[_index(params, "normal_index", len(normals), at if with_positions else None)]
    return MeshArrays(np.array(params[_FACES]).reshape(-1, 3), positions[at], normals, texcoords)


def positions_array(mesh: mi.Mesh) -> mi.Float:
    """Return the vertex positions of a mesh as a flat, detached array of Dr.Jit."""
    return mi.Float(dr.detach(_buffer(mesh, "vertex_positions_buffer", *POSITIONS)))


def faces_array(mesh: mi.Mesh) -> mi.UInt32 | None:
    """Return the faces of a mesh as a flat array of Dr.Jit, or None if they are not accessible (see `mesh_arrays`)."""
    faces = _buffer(mesh, "faces_buffer", _FACES)
    return None if faces is None else mi.UInt32(faces)


def _buffer(mesh: mi.Mesh, method: str, *names: str) -> mi.Float | mi.UInt32 | None:
    """Return a flat array of a mesh by its accessor or, without one, by the first of its parameter names; or None."""
    if hasattr(mesh, method):  # faster, in 3.9
        return getattr(mesh, method)()
    params = mi.traverse(mesh)
    value = next((params[name] for name in names if name in params), None)
    return value.array if dr.is_tensor_v(value) else value


def _rows(params: Mapping[str, object], names: tuple[str, str], width: int) -> NDArray[np.float32]:
    for name in names:
        if name in params:
            return np.array(params[name], np.float32).reshape(-1, width)
    return np.zeros((0, width), np.float32)


def _index(
    params: Mapping[str, object], name: str, count: int, otherwise: NDArray[np.integer] | None = None
) -> NDArray[np.integer]:
    """Return the index map ``name``. If the map is empty or missing, return ``otherwise`` instead.

    The default of ``otherwise`` is the identity map with ``count`` entries.
    """
    index = np.array(params[name]).ravel() if name in params else np.zeros(0, int)
    if len(index):
        return index
    return np.arange(count) if otherwise is None else otherwise


def positions_name() -> str:
    """Return the name that the active version gives to the positions of a mesh."""
    return POSITIONS[_has_mesh_tensors()]


def _has_mesh_tensors() -> bool:
    return hasattr(mi.Mesh, _FROM_FIELDS)


def is_positions(key: str) -> bool:
    """Return whether a parameter with this key consists of the positions of a mesh."""
    return key.rpartition(".")[2] in POSITIONS


def faces_of_positions(params: Mapping[str, object], key: str) -> NDArray[np.integer] | None:
    """Return the faces (m, 3) of a mesh as indices into its positions; None if ``key`` is another kind of parameter."""
    owner, dot, _ = key.rpartition(".")
    faces, index = f"{owner}{dot}{_FACES}", f"{owner}{dot}position_index"
    if not is_positions(key) or faces not in params:
        return None
    corners = np.array(params[faces]).reshape(-1, 3)
    at = np.array(params[index]).ravel() if index in params else np.zeros(0, int)
    return at[corners] if len(at) else corners


def texcoords_of(params: Mapping[str, object], key: str) -> NDArray[np.float32]:
    """Return the texture coordinates of a mesh as an array (n, 2), or (0, 2) if the mesh has none.

    ``key`` is the key of the positions of the mesh.
    """
    owner, dot, _ = key.rpartition(".")
    first, second = (f"{owner}{dot}{name}" for name in TEXCOORDS)
    return _rows(params, (first, second), 2)


def points_of(positions: dr.ArrayBase) -> mi.Vector3f:
    """Convert ``positions``, the parameter of a mesh, to an array of 3D points."""
    return dr.unravel(mi.Vector3f, positions.array if dr.is_tensor_v(positions) else positions)


def positions_like(positions: dr.ArrayBase, points: mi.Vector3f) -> dr.ArrayBase:
    """Convert 3D points to the type and shape of ``positions``, the parameter of a mesh."""
    flat: mi.Float = dr.ravel(points)
    return mi.TensorXf(flat, shape=positions.shape) if dr.is_tensor_v(positions) else flat


def is_mesh_data(name: str) -> bool:
    """Return whether mesh files store the mesh parameter ``name``. They store, for example, positions and faces."""
    return name.startswith(_PREFIXES) or name in {*POSITIONS, *NORMALS, *TEXCOORDS, *_OTHERS}


def has_normals(mesh: mi.Mesh) -> bool:
    """Return whether a mesh has vertex normals."""
    name = "has_normals" if hasattr(mesh, "has_normals") else "has_vertex_normals"
    return bool(getattr(mesh, name)())


def new_mesh(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    props: mi.Properties,
    flat: bool,
    texcoords: NDArray[np.floating] | None = None,
) -> mi.Mesh:
    """Create a mesh.

    Args:
        vertices: positions, (n, 3).
        faces: vertex indices, (m, 3).
        props: properties of the mesh, such as its material.
        flat: whether the mesh has no vertex normals.
        texcoords: texture coordinates, (n, 2), or None.
    """
    props["face_normals"] = flat
    points, corners = vertices.astype(np.float32), faces.astype(np.uint32)
    if _has_mesh_tensors():
        mesh = mi.Mesh(props)
        more = {} if texcoords is None else {TEXCOORDS[1]: mi.TensorXf(texcoords.astype(np.float32))}
        getattr(mesh, _FROM_FIELDS)(faces=mi.TensorXu(corners), positions=mi.TensorXf(points), **more)
        return mesh
    has_texcoords = texcoords is not None
    mesh = mi.Mesh(
        "mesh", len(vertices), len(faces), props, has_vertex_normals=not flat, has_vertex_texcoords=has_texcoords
    )
    params = mi.traverse(mesh)
    if texcoords is not None:
        params[TEXCOORDS[0]] = mi.Float(with_space(texcoords.astype(np.float32).ravel()))
    params[POSITIONS[0]] = mi.Float(with_space(points.ravel()))
    params[_FACES] = mi.UInt32(with_space(corners.ravel()))
    params.update()
    return mesh
