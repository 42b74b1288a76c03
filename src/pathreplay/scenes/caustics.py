"""A slab of glass and a mirror that cast a caustic on a receiver, as built-in scenes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.scenes.bodies import mesh
from pathreplay.types import SceneDict

_WIDTH, _THICKNESS = 1.0, 0.2
_Z = np.array([0.0, 0.0, 1.0])
_GAP = 1e-4
"""Distance from the black frame to the entry surface of a lens."""

Array = NDArray[np.floating]


def caustic_lens(  # noqa: PLR0913 (keywords of a job)
    resolution: int = 128,
    columns: int = 128,
    rows: int = 128,
    distance: float = 1.5,
    eta: float = 1.5,
    receiver_width: float = 1.0,
    source_distance: float | None = None,
    irradiance: float = 3.0,
    two_surfaces: bool = False,
) -> SceneDict:
    """Describe a glass slab between a light and a white receiver, on which the slab casts a caustic.

    The slab has the width 1 and the thickness 0.2. Its exit surface is in the plane z = 0. The function `slab` creates
    the mesh for a height map of ``rows`` x ``columns``. The receiver is at z = ``distance``. Collimated light falls
    perpendicularly on the whole entry surface. With ``source_distance``, the light comes from a point at this distance
    from the entry surface, and a black frame blocks the light that would miss the exit surface. ``irradiance`` is the
    irradiance at the centre of the entry surface.

    The camera is halfway between slab and receiver, and casts no shadow. The camera sees a part of the receiver whose
    width is ``receiver_width``. In the image, x points to the right and y points down.

    The scene parameter ``lens.vertex_positions`` contains the vertices of the slab. The mesh attribute
    ``vertex_weight`` is 1 at the vertices of the exit surface and 0 at all other vertices, so that a height map can be
    applied to the exit surface only. With ``two_surfaces``, the attribute ``vertex_entry_weight`` is 1 at the vertices
    of the entry surface and 0 at all other vertices.
    """
    high = rows / columns
    glass = {"type": "dielectric", "int_ior": eta, "ext_ior": 1.0}
    lens = slab(rows, columns, _WIDTH, _THICKNESS, glass, two_surfaces)
    scene = _observed(resolution, high, distance, receiver_width, 0.0) | {"lens": lens}
    half = _half(rows, columns)
    if source_distance is None:
        return scene | {"lamp": _collimated(np.array([0, 0, -2 * _THICKNESS]), _Z, half, irradiance)}
    hole = half * min(_at_entry(r, source_distance, eta) / r for r in (*half, np.hypot(*half)))
    frame = _frame(hole, 4 * hole, -_THICKNESS - _GAP)
    origin = np.array([0, 0, -_THICKNESS - source_distance])
    return scene | {"frame": frame, "lamp": _point(origin, _Z, hole, -_THICKNESS, irradiance)}


def caustic_mirror(
    resolution: int = 128,
    columns: int = 128,
    rows: int = 128,
    distance: float = 1.5,
    angle: float = 30.0,
    receiver_width: float = 1.0,
    source_distance: float | None = None,
    irradiance: float = 3.0,
) -> SceneDict:
    """Describe a mirror that reflects light onto a white receiver, where the light forms a caustic.

    The mirror has the width 1. It is in the plane z = 0 and faces +z. The function `sheet` creates the mesh for a
    height map of ``rows`` x ``columns``. Light arrives along (sin α, 0, -cos α), where α is ``angle`` in degrees. The
    light is collimated, or comes from a point at the distance ``source_distance`` from the centre of the mirror.
    ``irradiance`` is the irradiance at the centre of the mirror, on a plane perpendicular to the light.

    The receiver is parallel to the mirror, at z = ``distance``. A flat mirror would reflect the light that arrives at
    the centre of the mirror to the centre of the receiver. The camera sees a part of the receiver whose width is
    ``receiver_width``. In the image, x points to the right and y points down.

    The scene parameter ``mirror.vertex_positions`` contains the vertices of the mirror.
    """
    if not 10 <= angle <= 80:
        raise PathreplayError(f"The angle of the mirror is {angle:g}; give 10 to 80 degrees, so that nothing is shaded")
    α, high = np.radians(angle), rows / columns
    along = np.array([np.sin(α), 0, -np.cos(α)])
    scene = _observed(resolution, high, distance, receiver_width, distance * float(np.tan(α)))
    scene["mirror"] = sheet(rows, columns, _WIDTH, {"type": "conductor", "material": "none"})
    half = _half(rows, columns)
    if source_distance is not None:
        return scene | {"lamp": _point(-source_distance * along, along, half, 0.0, irradiance)}
    # The beam is wider than the mirror, so that the beam also covers a displaced mirror. The light source is so far
    # away that it does not block reflected light.
    half = half * [np.cos(α), 1] + 0.1
    return scene | {"lamp": _collimated(-2 * _WIDTH / np.sin(α) * along, along, half, irradiance)}


def _observed(resolution: int, high: float, distance: float, receiver_width: float, x: float) -> SceneDict:
    """Describe the camera, and the receiver centred at (x, 0, ``distance``).

    ``high`` is the height of the image divided by its width.
    """
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": resolution, "height": round(resolution * high), "pixel_format": "luminance"}
    return {
        "type": "scene",
        "integrator": {"type": "ptracer", "max_depth": 6},
        "camera": {
            "type": "perspective",
            "to_world": T().look_at(origin=[x, 0, distance / 2], target=[x, 0, distance], up=[0, -1, 0]),
            "fov": float(np.degrees(2 * np.arctan(receiver_width / distance))),
            "fov_axis": "x",
            "film": {**film, "rfilter": {"type": "gaussian"}},
        },
        "receiver": {
            "type": "rectangle",
            "to_world": T().translate([x, 0, distance]).rotate([1, 0, 0], 180).scale(receiver_width * max(1, high)),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}},
        },
    }


def _half(rows: int, columns: int) -> Array:
    """Return half of the width and half of the height of a surface with a height map of width 1.

    The surface ends half a cell inside the border of the height map.
    """
    return np.array([columns - 1, rows - 1]) / columns * _WIDTH / 2


def _collimated(centre: Array, along: Array, half: Array, irradiance: float) -> SceneDict:
    """Describe a rectangle that emits light perpendicularly to its surface.

    ``half`` contains half of the width and half of the height of the rectangle.
    """
    place = mi.ScalarTransform4f().look_at(origin=centre.tolist(), target=(centre + along).tolist(), up=[0, 1, 0])
    return {
        "type": "rectangle",
        "to_world": place.scale([*half.tolist(), 1]),
        "emitter": {"type": "directionalarea", "radiance": {"type": "rgb", "value": irradiance}},
    }


def _point(origin: Array, axis: Array, half: Array, z: float, irradiance: float) -> SceneDict:
    """Describe a point light whose cone contains a rectangle around the z axis in a plane z = const."""
    corners = np.array([[x * half[0], y * half[1], z] for x in (-1, 1) for y in (-1, 1)]) - origin
    cosine = corners @ axis / np.linalg.norm(corners, axis=1)
    beam = float(np.degrees(np.arccos(cosine.min()))) + 1
    distance = (z - origin[2]) / axis[2]
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(
            origin=origin.tolist(), target=(origin + axis).tolist(), up=[0, 1, 0]
        ),
        "beam_width": beam,
        "cutoff_angle": beam + 1,
        "intensity": {"type": "rgb", "value": float(irradiance * distance**2)},
    }


def _frame(hole: Array, outer: Array, z: float) -> mi.Mesh:
    """Create a black frame in the plane z = const.

    ``hole`` contains half of the width and half of the height of the hole. ``outer`` contains half of the width and
    half of the height of the whole frame.
    """
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    vertices = np.concatenate([corners * hole, corners * outer])
    i, j = np.arange(4), np.roll(np.arange(4), -1)
    faces = np.concatenate([np.stack([i, j, j + 4], axis=1), np.stack([i, j + 4, i + 4], axis=1)])
    return mesh(np.c_[vertices, np.full(8, z)], faces, {"type": "diffuse", "reflectance": 0.0}, flat=True)


def _at_entry(r: float, s: float, eta: float) -> float:
    """Return the distance from the axis at which a ray from a point light enters the slab.

    The axis passes through the point light and is perpendicular to the slab. ``s`` is the distance from the light to
    the slab. ``r`` is the distance from the axis at which the ray leaves the slab.
    """
    sine = np.linspace(0, 0.999, 10000)
    enters = s * sine / np.sqrt(1 - sine**2)
    inside = sine / eta
    return float(np.interp(r, enters + _THICKNESS * inside / np.sqrt(1 - inside**2), enters))


def sheet(rows: int, columns: int, width: float, bsdf: dict[str, object]) -> mi.Mesh:
    """Create a rectangle that faces +z, for displacement by a height map of ``rows`` x ``columns``.

    The map has square cells and is centred at the origin of the plane z = 0. Its total width is ``width``. The
    rectangle has a vertex at the centre of each cell, so the rectangle ends half a cell inside the border of the map.
    The texture coordinates of the rectangle are the coordinates on the map. The rectangle has vertex normals.

    Raises PathreplayError if there are fewer than two rows or columns.
    """
    return _mesh(*_grid(rows, columns, width), width, rows / columns, bsdf)


def slab(
    rows: int, columns: int, width: float, thickness: float, bsdf: dict[str, object], two_surfaces: bool = False
) -> mi.Mesh:
    """Create a closed slab whose upper face is a `sheet`, for displacement by a height map of ``rows`` x ``columns``.

    The lower face and the sides are flat. The sides share positions with the two faces, but no vertices. With
    ``two_surfaces``, the lower face has the same grid of vertices as the upper face, for displacement by a second map.
    Both maps have the same texture coordinates.

    The attribute ``vertex_weight`` is 1 at all vertices of the upper plane, and 0 at all other vertices. With
    ``two_surfaces``, the attribute ``vertex_entry_weight`` is 1 at all vertices of the lower plane, and 0 at all other
    vertices.

    Raises PathreplayError if there are fewer than two rows or columns.
    """
    at, upper = _grid(rows, columns, width)
    grid = np.arange(len(at)).reshape(rows, columns)
    places, faces, count = [at], [upper], len(at)
    borders = [grid[0], grid[:, -1], grid[-1, ::-1], grid[::-1, 0]]  # anticlockwise, seen from above
    below = np.array([0, 0, -thickness])
    for border in borders:
        m = len(border)
        low = count + np.arange(m - 1)
        faces += [np.stack([low, low + 1, low + m + 1], axis=1), np.stack([low, low + m + 1, low + m], axis=1)]
        places += [at[border] + below, at[border]]
        count += 2 * m
    if two_surfaces:
        faces.append(upper[:, ::-1] + count)
        places.append(at + below)
    else:
        rim = np.concatenate([border[:-1] for border in borders])
        around = count + 1 + np.arange(len(rim))
        faces.append(np.stack([np.full(len(rim), count), np.roll(around, -1), around], axis=1))
        places += [below[None], at[rim] + below]
    vertices = np.concatenate(places)
    result = _mesh(vertices, np.concatenate(faces), width, rows / columns, bsdf)
    result.add_attribute("vertex_weight", 1, (vertices[:, 2] == 0).astype(np.float32))
    if two_surfaces:
        result.add_attribute("vertex_entry_weight", 1, (vertices[:, 2] < 0).astype(np.float32))
    return result


def _grid(rows: int, columns: int, width: float) -> tuple[Array, NDArray[np.integer]]:
    """Return the vertices (n, 3) and faces (m, 3) of a `sheet`."""
    if min(rows, columns) < 2:
        raise PathreplayError(f"A height map has {rows} rows and {columns} columns; give at least 2 of each")
    v, u = ((np.arange(n) + 0.5) / n for n in (rows, columns))
    x, y = np.meshgrid((u - 0.5) * width, (v - 0.5) * width * rows / columns)
    n = columns
    i = (np.arange(rows - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], axis=1), np.stack([i, i + n + 1, i + n], axis=1)])
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3), faces


def _mesh(vertices: Array, faces: NDArray[np.integer], width: float, high: float, bsdf: dict[str, object]) -> mi.Mesh:
    """Create a mesh whose texture coordinates are the coordinates on its height map.

    ``width`` is the width of the map, and ``high`` its height divided by its width.
    """
    return mesh(vertices, faces, bsdf, texcoords=vertices[:, :2] / np.array([width, width * high]) + 0.5)
