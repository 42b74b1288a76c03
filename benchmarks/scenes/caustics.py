"""Scenes of light paths: closed rooms, one with the caustic of a wavy glass slab, and a slab that casts a picture."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from .parts import SceneDict

#: Keys of what is differentiated.
HEIGHTS, FLOOR, LAMP = "slab.vertex_positions", "floor.bsdf.reflectance.data", "lamp.position"

GLASS: SceneDict = {"type": "dielectric_ad", "int_ior": 1.5, "ext_ior": 1.0}
WALL: SceneDict = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.9}}


def _mesh(name: str, positions: np.ndarray, faces: np.ndarray, bsdf: SceneDict, smooth: bool) -> mi.Mesh:
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(positions), len(faces), has_vertex_normals=smooth, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = positions.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return mesh


def grid(x: np.ndarray, y: np.ndarray, z: np.ndarray, bsdf: SceneDict, up: bool = True) -> mi.Mesh:
    """Create a sheet of (rows, columns) vertices with shading normals towards positive z (``up``) or negative z."""
    i = np.arange(z.size).reshape(z.shape)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    return _mesh(
        "grid", np.stack([x, y, z], axis=-1).reshape(-1, 3), faces if up else faces[:, ::-1], bsdf, smooth=True
    )


def rim(half_width: float, low: float, high: float, bsdf: SceneDict) -> mi.Mesh:
    """Create the four sides of a box, with normals outwards."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half_width
    positions = np.concatenate([np.column_stack([square, np.full(4, z)]) for z in (low, high)])
    sides = [[[i, (i + 1) % 4, (i + 1) % 4 + 4], [i, (i + 1) % 4 + 4, i + 4]] for i in range(4)]
    return _mesh("rim", positions, np.concatenate(sides), bsdf, smooth=False)


def _room(resolution: int) -> SceneDict:
    """A sealed cube [-1, 1]³ of diffuse walls with a textured floor, which a camera inside sees. It has no lamp.

    All filters are Gaussian: derivatives of film positions vanish under a box filter.
    """
    T = mi.ScalarTransform4f
    texels = np.random.default_rng(0).uniform(0.5, 0.95, (16, 16, 3)).astype(np.float32)
    floor = {"type": "bitmap", "data": mi.TensorXf(texels), "raw": True}
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "sample_border": True}
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 60,
            "to_world": T().look_at(origin=[0.9, -0.2, -0.2], target=[-0.1, 0, -1], up=[0, 0, 1]),
            "film": {**film, "rfilter": {"type": "gaussian"}},
        },
        "room": {"type": "cube", "flip_normals": True, "bsdf": WALL},
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, -0.99]).scale(0.999),
            "bsdf": {"type": "diffuse", "reflectance": floor},
        },
    }


def caustic_room(resolution: int, n: int = 33) -> SceneDict:
    """A spot light shines through a wavy slab of glass onto the floor of a sealed room. Key: `HEIGHTS`.

    The rim of the slab is black, like the mount of a lens. Behind a white rim or sides of glass, total reflection would
    trap paths in the slab, and the variance of derivatives would grow exponentially with their length.
    """
    T = mi.ScalarTransform4f
    width, low, high = 0.3, 0.2, 0.4
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    # The border is flat, so that the slab is closed.
    waves = 0.006 * np.sin(5 * x) * np.cos(4 * y) * (1 - x * x) * (1 - y * y)
    spot = T().look_at(origin=[0, 0, 0.95], target=[0, 0, 0], up=[0, 1, 0])
    return _room(resolution) | {
        "lamp": {
            "type": "spot",
            "to_world": spot,
            "cutoff_angle": 25.0,
            "intensity": {"type": "rgb", "value": [6, 5, 4]},
        },
        "slab": grid(width * x, width * y, high + waves, GLASS),
        "bottom": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, low]).rotate([1, 0, 0], 180).scale(width),
            "bsdf": GLASS,
        },
        "rim": rim(width, low, high, {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}),
    }


def lit_room(resolution: int) -> SceneDict:
    """A point light in a sealed room. Keys: `FLOOR` and `LAMP`."""
    lamp = {"type": "point", "position": [0.2, 0.3, 0.4], "intensity": {"type": "rgb", "value": [3, 2, 1]}}
    return _room(resolution) | {"lamp": lamp}


CAUSTIC_ROOM, LIT_ROOM = "caustic-room", "lit-room"
CAUSTIC_SCENES: dict[str, Callable[[int], SceneDict]] = {
    CAUSTIC_ROOM: caustic_room,
    LIT_ROOM: lit_room,
}
