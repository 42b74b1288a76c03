"""Scenes with a wall, an emitter and a moving mesh ``object``, which show its shadow, its outline or both."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull

from .parts import SceneDict, sensor

LUMPS = 600
"""Vertices of the mesh with many triangles."""


def _room(resolution: int, fov: float, glows: bool = False, **parts: mi.Mesh) -> SceneDict:
    """A textured wall lit by an area light, or, with ``glows``, a wall with textured emission."""
    T = mi.ScalarTransform4f
    texels = np.random.default_rng(3).uniform(0.1, 1, (8, 8, 3)).astype(np.float32)
    picture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels)}
    wall = {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale([6, 6, 1])}
    dark = {"bsdf": _paint(0, 0, 0)}
    over = T().translate([1.6, 1.2, 2.5]).look_at([0, 0, 0], [-1.6, -1.2, -3.5], [0, 1, 0]).scale([0.5, 0.5, 1])
    lamp = {"type": "rectangle", "to_world": over, **dark, "emitter": {"type": "area", "radiance": 10.0}}
    if glows:
        lit = {"wall": {**wall, **dark, "emitter": {"type": "area", "radiance": picture}}}
    else:
        lit = {"wall": {**wall, "bsdf": {"type": "diffuse", "reflectance": picture}}, "lamp": lamp}
    camera = sensor(resolution, [0, 0, 4], [0, 0, 0], fov, up=(0, 1, 0))
    return {"type": "scene", "camera": camera, **lit, **parts}


def _paint(*value: float) -> SceneDict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(value)}}


def _box(bsdf: SceneDict) -> mi.Mesh:
    return mesh_of(*_cube(), [0.1, 0.1, 0], 0.4, bsdf, flat=True)


def _ears(bsdf: SceneDict) -> mi.Mesh:
    return mesh_of(*ball_with_bumps(LUMPS, *EARS), [0.1, 0, 0], 0.4, bsdf, flat=False)


def _cube() -> tuple[np.ndarray, np.ndarray]:
    """Eight vertices, so that faces share their edges."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return corners, np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])


Bump = tuple[tuple[float, float, float], float, float]
"""Direction of a bump, its height, and the square of its width."""
EARS: tuple[Bump, ...] = tuple(((side, 0.8, 0.2), 0.9, 0.06) for side in (-0.5, 0.5))


def ball_with_bumps(n: int, *bumps: Bump) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a closed, self-occluding mesh: a sphere of n points with waves and bumps.

    The points lie on a spiral, and the faces are those of their convex hull.
    """
    z = 1 - (2 * np.arange(n) + 1) / n
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(n)
    points = np.stack([*(np.sqrt(1 - z * z) * f(turn) for f in (np.cos, np.sin)), z], -1)
    faces = ConvexHull(points).simplices
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    radius = 1 + 0.1 * np.sin(5 * points[:, 0]) * np.cos(4 * points[:, 1])
    for at, height, width in bumps:
        middle = np.array(at) / np.linalg.norm(at)
        radius += height * np.exp(-np.sum((points - middle) ** 2, -1) / width)
    return points * radius[:, None], faces


def mesh_of(
    vertices: np.ndarray, faces: np.ndarray, at: list[float], size: float, bsdf: SceneDict, flat: bool
) -> mi.Mesh:
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict({"type": "twosided", "inner": bsdf})
    props["face_normals"] = flat
    mesh = mi.Mesh("object", len(vertices), len(faces), has_vertex_normals=not flat, props=props)
    place = mi.ScalarTransform4f().translate(at).rotate([1, 0.4, 0], 30).scale(size)
    matrix = np.array(place.matrix, float)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ravel(vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    params.update()
    return mesh


EDGE_SCENES: dict[str, Callable[[int], SceneDict]] = {
    "shadow": lambda n: _room(n, 30, object=mesh_of(*_cube(), [1.3, 0.9, 1.2], 0.25, _paint(0, 0, 0), flat=True)),
    "silhouette": lambda n: _room(n, 45, object=_box(_paint(0.5, 0.5, 0.2))),
    "bumps": lambda n: _room(n, 45, object=_ears(_paint(0.5, 0.5, 0.2))),
    "black silhouette": lambda n: _room(n, 45, glows=True, object=_box(_paint(0, 0, 0))),
    "black bumps": lambda n: _room(n, 45, glows=True, object=_ears(_paint(0, 0, 0))),
}
"""Scenes by name. The key of the moving parameter is ``object.vertex_positions``."""
