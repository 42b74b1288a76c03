"""Generated meshes: a triangulated sphere, and an asymmetric body with knobs that looks different from all sides."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from pathreplay.platform import compat

_KNOBS = (  # direction, height and sharpness of each knob
    ((1.0, 0.1, 0.2), 0.55, 7.0),
    ((-0.5, 0.8, 0.3), 0.4, 9.0),
    ((-0.4, -0.7, 0.6), 0.25, 6.0),
    ((0.1, -0.3, -1.0), 0.35, 8.0),
)


def ball(splits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and faces (m, 3) of a unit sphere, from an octahedron subdivided ``splits`` times.

    Each subdivision splits every face into four. Faces share vertices, and are counter-clockwise seen from outside.
    """
    v = np.concatenate([np.eye(3), -np.eye(3)])
    f = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)])
    for _ in range(splits):
        sides = np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, at = np.unique(sides, axis=0, return_inverse=True)
        a, b, c = (len(v) + at.reshape(-1, 3)).T
        v = np.concatenate([v, v[edges].mean(axis=1)])
        x, y, z = f.T
        f = np.concatenate([np.stack(corner, axis=1) for corner in ((x, a, c), (a, y, b), (c, b, z), (a, b, c))])
    return v / np.linalg.norm(v, axis=1, keepdims=True), f


def knobs(directions: np.ndarray) -> np.ndarray:
    """Return points (n, 3) on the surface of a body with four knobs. The body has length 1.

    The origin is inside the body. Each point is seen from the origin in one of the unit ``directions`` (n, 3).
    """
    radius = np.full(len(directions), 0.4)
    for at, height, sharpness in _KNOBS:
        radius += height * np.exp(sharpness * (directions @ (np.array(at) / np.linalg.norm(at)) - 1))
    points = directions * radius[:, None]
    return points / np.ptp(points, axis=0).max()


def mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    bsdf: dict[str, object],
    flat: bool = False,
    texcoords: np.ndarray | None = None,
) -> mi.Mesh:
    """Create a Mitsuba mesh, with vertex normals unless it is ``flat``."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    return compat.new_mesh(vertices, faces, props, flat, texcoords)
