"""A slab of glass that casts a caustic on a receiver, as a built-in scene."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.types import SceneDict


def caustic_lens(
    resolution: int = 128,
    columns: int = 128,
    rows: int = 128,
    distance: float = 1.5,
    eta: float = 1.5,
    receiver_width: float = 1.0,
) -> SceneDict:
    """Describe a glass slab between a light and a white receiver, on which the slab casts a caustic.

    The slab has the width 1 and the thickness 0.2. Its exit surface in the plane z = 0 has a vertex per cell of a
    height map of ``rows`` x ``columns``. The receiver is at z = ``distance``. Collimated light falls perpendicularly on
    the whole entry surface. The camera sees the part of the receiver that is ``receiver_width`` wide, with x to the
    right and y down. It stands halfway between slab and receiver and hides neither. The key is
    ``lens.vertex_positions``, and ``vertex_weight`` is the attribute of the mesh for a displacement.
    """
    T = mi.ScalarTransform4f
    width, thickness, high = 1.0, 0.2, rows / columns
    half = [width / 2 * (1 - 1 / columns), width / 2 * high * (1 - 1 / rows), 1]  # of the slab
    fov = float(np.degrees(2 * np.arctan(receiver_width / distance)))
    film = {"type": "hdrfilm", "width": resolution, "height": round(resolution * high), "pixel_format": "luminance"}
    lamp = {
        "type": "rectangle",
        "to_world": T().translate([0, 0, -2 * thickness]).scale(half),
        "emitter": {"type": "directionalarea", "radiance": {"type": "rgb", "value": 3.0}},
    }
    return {
        "type": "scene",
        "integrator": {"type": "ptracer", "max_depth": 6},
        "camera": {
            "type": "perspective",
            "to_world": T().look_at(origin=[0, 0, distance / 2], target=[0, 0, distance], up=[0, -1, 0]),
            "fov": fov,
            "fov_axis": "x",
            "film": {**film, "rfilter": {"type": "gaussian"}},
        },
        "lens": slab(rows, columns, width, thickness, {"type": "dielectric", "int_ior": eta, "ext_ior": 1.0}),
        "lamp": lamp,
        "receiver": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, distance]).rotate([1, 0, 0], 180).scale(receiver_width * max(1, high)),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}},
        },
    }


def slab(rows: int, columns: int, width: float, thickness: float, bsdf: dict[str, object]) -> mi.Mesh:
    """Create a closed slab whose upper face is a grid, for displacement by a height map of ``rows`` x ``columns``.

    The map has square cells and is centred at the origin of the plane z = 0; ``width`` is the width of all its columns.
    The upper face has a vertex at the centre of each cell, so it ends half a cell before the map. Its texture
    coordinates are those of the map, and its normals are smooth. The lower face and the sides are flat; they share
    positions with the upper face, but no vertices. The attribute ``vertex_weight`` is 1 at all vertices of the plane z
    = 0, and 0 below.

    Raises PathreplayError if there are fewer than two rows or columns.
    """
    if min(rows, columns) < 2:
        raise PathreplayError(f"A slab has {rows} rows and {columns} columns of vertices; give at least 2 of each")
    u, v = ((np.arange(n) + 0.5) / n for n in (columns, rows))
    x, y = (u - 0.5) * width, (v - 0.5) * width * rows / columns
    n = len(x)
    at = np.stack([*np.meshgrid(x, y), np.zeros((len(y), n))], axis=-1).reshape(-1, 3)
    i = (np.arange(len(y) - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = [np.stack([i, i + 1, i + n + 1], axis=1), np.stack([i, i + n + 1, i + n], axis=1)]
    places, weights, count = [at], [np.ones(len(at))], len(at)
    grid = np.arange(len(at)).reshape(len(y), n)
    borders = [grid[0], grid[:, -1], grid[-1, ::-1], grid[::-1, 0]]  # anticlockwise, seen from above
    below = np.array([0, 0, -thickness])
    for border in borders:
        m = len(border)
        low = count + np.arange(m - 1)
        faces += [np.stack([low, low + 1, low + m + 1], axis=1), np.stack([low, low + m + 1, low + m], axis=1)]
        places += [at[border] + below, at[border]]
        weights += [np.zeros(m), np.ones(m)]
        count += 2 * m
    rim = np.concatenate([border[:-1] for border in borders])
    around = count + 1 + np.arange(len(rim))
    faces.append(np.stack([np.full(len(rim), count), np.roll(around, -1), around], axis=1))
    places += [below[None], at[rim] + below]
    weights.append(np.zeros(len(rim) + 1))
    vertices = np.concatenate(places)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    corners = np.concatenate(faces)
    result = mi.Mesh("slab", len(vertices), len(corners), props, has_vertex_normals=True, has_vertex_texcoords=True)
    params = mi.traverse(result)
    params["vertex_positions"], params["faces"] = np.float32(vertices).ravel(), np.uint32(corners).ravel()
    params["vertex_texcoords"] = np.float32(vertices[:, :2] / [width, width * rows / columns] + 0.5).ravel()
    params.update()
    result.add_attribute("vertex_weight", 1, np.concatenate(weights).astype(np.float32))
    return result
