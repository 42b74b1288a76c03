"""Scenes with one parameter after those by which Mitsuba tests its own derivatives, and its thresholds.

Mitsuba's `src/integrators/tests/test_ad_integrators.py` (3.9.1) has 24 configurations: 8 in which nothing moves, 7 in
which something moves but no edge counts, and 9 with edges. Those here have the same layout, film, samples and limits;
textures and meshes are made here. How they are measured: see `mitsuba_errors`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.testing.objective import Move
from truth import add, bitmap, noise, rgb, translate, translate_vertices


class Limits(NamedTuple):
    """Largest relative errors: mean and maximum over values of the image, and of the reverse derivative."""

    mean: float
    most: float
    reverse: float = 0.05


@dataclass(frozen=True)
class Config:
    """A scene by the width of its film, what moves and how, and how it is measured."""

    scene: Callable[[int], dict]
    keys: tuple[str, ...]
    move: Move
    limits: Limits
    depth: int = 2
    res: int = 128
    spp: int = 1024
    step: float = 1e-3
    reverse_spp: int = 128
    rise: int = (
        1  # on a smaller film as many samples as on the large one per pixel (0), in a row of them (1), in all (2)
    )


# ------------------------------ Moves ------------------------------


def turn_normals(value: Any, t: Any) -> Any:
    """Flat normals, turned by t degrees about y."""
    return dr.ravel(mi.Transform4f().rotate([0, 1, 0], t) @ dr.unravel(mi.Normal3f, value))


def grow(value: Any, t: Any) -> Any:
    return value * (1 + t)


along_x, along_z = translate_vertices(1, 0, 0), translate_vertices(0, 0, 1)


# ------------------------------ Parts ------------------------------


def at(*chain: mi.ScalarTransform4f) -> mi.ScalarTransform4f:
    """The product of transformations, of which the last comes first."""
    result = T()
    for transform in chain:
        result = result @ transform
    return result


def T() -> Any:
    return mi.ScalarTransform4f()


def looking(origin: list[float], target: list[float], up: tuple[float, ...] = (0, 1, 0)) -> Any:
    return T().look_at(origin=origin, target=target, up=list(up))


def camera(size: int, view: Any = None, **more: Any) -> dict:
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "sample_border": True}
    return {"type": "perspective", "to_world": view or looking([0, 0, 4], [0, 0, 0]), "film": film, **more}


def diffuse(*colour: float) -> dict:
    return {"type": "diffuse", "reflectance": rgb(*(colour or (0.5, 0.5, 0.5)))}


def glow(*radiance: float) -> dict:
    return {"type": "area", "radiance": rgb(*radiance)}


def sky(radiance: float = 1.0) -> dict:
    return {"type": "constant", "radiance": rgb(radiance, radiance, radiance)}


def ramp() -> np.ndarray:
    """Grey that grows from left to right, with a black border."""
    image = np.zeros((16, 16, 3))
    image[1:15, 1:15] = (np.arange(1, 15) / 15)[:, None]
    return image


def ramp_glow() -> dict:
    return {"type": "area", "radiance": bitmap(ramp())}


def mesh(positions: Any, faces: Any, coordinates: Any, place: Any, normals: Any = None, **parts: dict) -> mi.Mesh:
    """A mesh, faceted unless it has normals."""
    props = mi.Properties()
    props["face_normals"] = normals is None
    for name, part in ({"bsdf": diffuse()} | parts).items():
        props[name] = mi.load_dict(part)
    smooth = normals is not None
    made = mi.Mesh("mesh", len(positions), len(faces), props, has_vertex_normals=smooth, has_vertex_texcoords=True)
    params, place = mi.traverse(made), np.array((place or T()).matrix, np.float64)
    params["vertex_positions"] = np.ravel(positions @ place[:3, :3].T + place[:3, 3]).astype(np.float32)
    params["vertex_texcoords"] = np.ravel(coordinates).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    if smooth:  # right for rotations and equal scales
        turned = normals @ place[:3, :3].T
        params["vertex_normals"] = np.ravel(turned / np.linalg.norm(turned, axis=1)[:, None]).astype(np.float32)
    params.update()
    return made


def square(place: Any = None, smooth: bool = False, **parts: dict) -> mi.Mesh:
    """The square [-1, 1]² of the plane z = 0, of two triangles."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]], np.float64)
    normals = np.tile([0.0, 0, 1], (4, 1)) if smooth else None
    return mesh(corners, [[1, 2, 0], [1, 3, 2]], (corners[:, :2] + 1) / 2, place, normals, **parts)


def ball(place: Any = None, rings: int = 64, **parts: dict) -> mi.Mesh:
    """The unit sphere as a smooth mesh with a seam, twice as many vertices round as from pole to pole."""
    v, u = (np.ravel(x) for x in np.meshgrid(np.arange(rings + 1) / rings, np.arange(2 * rings + 1) / (2 * rings),
                                             indexing="ij"))  # fmt: skip
    across, round_ = np.pi * v, 2 * np.pi * u
    points = np.stack([np.sin(across) * np.sin(round_), np.cos(across), np.sin(across) * np.cos(round_)], -1)
    row, column = (np.ravel(x) for x in np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij"))
    a = row * (2 * rings + 1) + column
    b, c = a + 2 * rings + 1, a + 1
    upper, lower = np.stack([a, b, c], -1)[row > 0], np.stack([c, b, b + 1], -1)[row < rings - 1]
    return mesh(points, np.concatenate([upper, lower]), np.stack([u, v], -1), place, points, **parts)


def beside() -> Any:
    """At the right of what is looked at, facing it."""
    return at(T().translate([1.25, 0, 1]), T().rotate([0, 1, 0], -90))


def tilted(turn: float) -> Any:
    return at(T().rotate([1, 0, 0], 45), T().rotate([0, 0, 1], turn))


# ------------------------------ Scenes ------------------------------


def plate(size: int, bsdf: dict | None = None, small: bool = True, **others: Any) -> dict:
    """A square seen from in front, as a rule with a small sphere in its middle."""
    scene = {"type": "scene", "camera": camera(size), "plane": {"type": "rectangle", "bsdf": bsdf or diffuse()}}
    if small:
        scene["sphere"] = {"type": "sphere", "to_world": T().scale(0.25), "bsdf": diffuse()}
    return {**scene, **others}


def lamp_beside() -> dict:
    return {"type": "rectangle", "to_world": beside(), "emitter": glow(3, 3, 3)}


def bounced(size: int) -> dict:
    green = {"type": "rectangle", "to_world": beside(), "bsdf": diffuse(0.1, 1, 0.1)}
    return plate(size, green=green, light=sky(3))


def point_lit(size: int) -> dict:
    light = {"type": "point", "position": [1.25, 0, 1], "intensity": rgb(5, 5, 5)}
    return plate(size, diffuse(1, 1, 1), light=light)


def cropped(size: int) -> dict:
    scene = plate(size, small=False, light=sky())
    window = {"crop_width": size // 2, "crop_height": size // 2}
    corner = {"crop_offset_x": size // 2, "crop_offset_y": size * 20 // 64}
    scene["camera"]["film"] |= {"rfilter": {"type": "gaussian", "stddev": 0.5}, **window, **corner}
    return scene


def facing(size: int, plane: mi.Mesh, **others: Any) -> dict:
    return {"type": "scene", "camera": camera(size), "plane": plane, **others}


def projected(size: int) -> dict:
    light = {"type": "projector", "irradiance": bitmap(ramp()), "to_world": looking([0, 0, 3], [0, 0, 0])}
    return facing(size, square(T().scale(3)), light=light)


def panes(size: int) -> dict:
    """A glowing square behind three panes of rough glass."""
    glass = {"type": "roughdielectric", "distribution": "beckmann", "alpha": 0.8, "int_ior": 1.001, "ext_ior": 1.1}
    one, two, three = (square(at(T().translate([0, 0, z]), T().scale(4)), bsdf=glass) for z in (1, 0, -1))
    light = square(at(T().translate([0, 0, -2]), T().scale(0.7)), emitter=ramp_glow())
    view = camera(size, looking([0, 0, 2], [0, 0, 0]))
    return {"type": "scene", "camera": view, "one": one, "shape": two, "three": three, "light": light}


def tilted_lamp(size: int) -> dict:
    view = camera(size, looking([0, 0.2, 4], [0, 0.2, 0]), fov=40)
    return {"type": "scene", "camera": view, "plane": square(tilted(-90), emitter=ramp_glow())}


def lit_from_below(size: int) -> dict:
    view = camera(size, looking([0, 0.1, 4], [0, 0.1, 0]), fov=18)
    up = at(T().translate([0, -1.5, 0]), T().rotate([0, 1, 0], -90), T().rotate([1, 0, 0], -90), T().scale(4))
    return {"type": "scene", "camera": view, "plane": square(tilted(90)), "light": square(up, emitter=ramp_glow())}


def disk_over_grey(size: int) -> dict:
    place = at(T().translate([0.2, 0, -1]), T().rotate([0, 1, 0], 60), T().scale(1.5))
    disk = {"type": "disk", "to_world": place, "emitter": glow(2, 2, 2)}
    view = camera(size, looking([0, 0, 1], [0, 0, 0]), fov=120, near_clip=0.01)
    return {"type": "scene", "camera": view, "disk": disk, "light": sky(0.2)}


def glowing(size: int, shape: mi.Mesh) -> dict:
    return {"type": "scene", "camera": camera(size), "light": shape}


def shadowed(size: int, plane: Any) -> dict:
    """A ball outside the view, and its shadow on a plane."""
    occluder = ball(at(T().translate([2, 0, 2]), T().scale(0.25)))
    light = ball(at(T().translate([4, 0, 4]), T().scale(0.05)), emitter=glow(1000, 1000, 1000))
    return facing(size, plane, occluder=occluder, light=light)


def lamp_below(size: int) -> dict:
    plane = square(at(looking([0, 0, -1], [0, -1, 0]), T().scale(0.25)))
    light = square(at(looking([0, -2, -1], [0, 0, -1], (0, 0, 1)), T().scale(0.75)), emitter=glow(1, 1, 1))
    return {"type": "scene", "camera": camera(size, looking([0, 0, 0], [0, 0, -1])), "plane": plane, "light": light}


def corner(size: int) -> dict:
    """A wall and a floor, one of which shades the other."""
    wall = square(looking([0, 0, -1], [0, 0, 0]), bsdf=diffuse(0.1, 0.1, 0.4))
    floor = square(looking([0, -1, -1], [0, 0, -1], (0, 0, 1)), bsdf=diffuse(0.4, 0.1, 0.1))
    above = at(T().translate([0, 8, -4]), T().scale([2, 0.5, 1]))
    light = {"type": "rectangle", "to_world": above, "emitter": glow(1, 1, 1)}
    view = camera(size, looking([0, 0, 1], [0, 0, -1]), fov=87)
    return {"type": "scene", "camera": view, "wall": wall, "floor": floor, "light": light}


def spotted() -> dict:
    """Colours of high contrast."""
    return bitmap(noise(64, 3, 0, 1) ** 6 * 10)


def textured(size: int) -> dict:
    return facing(size, square(T().scale(2), bsdf={"type": "diffuse", "reflectance": spotted()}), light=sky())


def under_sky(size: int) -> dict:
    light = {"type": "envmap", "bitmap": mi.Bitmap((noise(64, 3, 0, 1)[:32] ** 4 * 5).astype(np.float32))}
    return facing(size, square(T().scale(3)), light=light)


# ------------------------------ Configurations ------------------------------

LINEAR = 0.125
"""Step where the picture is linear in the parameter. Steps of 1e-3 are lost in sums of float32, which are 2 % off; of
values with few digits sums are exact."""
SWEPT = 5e-3
"""Step for edges. Mitsuba's own are from 1e-4 to 1e-3, with which few samples of a difference see an edge pass, so that
its noise exceeds the limits; a larger one is as right, since it is held to derivatives all along the step.
Samples of shadows' derivatives are a quarter of Mitsuba's where that is enough."""

PLANE, LIGHT = ("plane.vertex_positions",), ("light.vertex_positions",)
COLOUR = ("plane.bsdf.reflectance.value",)

STATIC = {
    "albedo": Config(lambda n: plate(n, light=sky()), COLOUR, add(), Limits(0.015, 0.25, 5e-4), step=LINEAR),
    "albedo of what is reflected": Config(
        bounced, ("green.bsdf.reflectance.value",), add(), Limits(0.04, 0.4, 5e-4), step=LINEAR, depth=3
    ),
    "lamp": Config(
        lambda n: plate(n, diffuse(1, 1, 1), light=lamp_beside()),
        ("light.emitter.radiance.value",),
        add(),
        Limits(0.02, 0.4, 5e-4),
        step=LINEAR,
    ),
    "lamp that is seen": Config(
        lambda n: {"type": "scene", "camera": camera(n), "light": {"type": "rectangle", "emitter": glow(1, 1, 1)}},
        ("light.emitter.radiance.value",),
        add(),
        Limits(0.02, 0.2, 0.02),
        step=LINEAR,
    ),
    "point light": Config(point_lit, ("light.intensity.value",), add(), Limits(0.02, 0.2, 0.002), step=LINEAR),
    "constant sky": Config(
        lambda n: plate(n, light=sky()), ("light.radiance.value",), add(), Limits(0.02, 0.1, 0.02), step=LINEAR
    ),
    "part of a film": Config(cropped, COLOUR, add(), Limits(0.01, 0.2, 0.002), step=LINEAR, res=64),
    "shading normals": Config(
        lambda n: facing(n, square(smooth=True), light=lamp_beside()),
        ("plane.vertex_normals",),
        turn_normals,
        Limits(0.02, 0.3, 2e-5),
        step=LINEAR,
    ),
}

MOVING = {
    "textured plane": Config(textured, PLANE, along_x, Limits(0.1, 56), res=64, reverse_spp=256, rise=2),
    "plane under a sky": Config(under_sky, PLANE, along_z, Limits(0.03, 0.2), res=64),
    "plane under a projector": Config(projected, PLANE, along_z, Limits(0.03, 0.2), res=64),
    "pane of rough glass": Config(
        panes,
        ("shape.vertex_positions",),
        along_z,
        Limits(0.03, 0.3),
        depth=4,
        res=32,
        spp=8192,
    ),
    "textured lamp": Config(tilted_lamp, PLANE, along_z, Limits(0.003, 0.4, 0.25), res=64),
    "plane under a textured lamp": Config(lit_from_below, PLANE, along_z, Limits(0.025, 0.4, 0.25), res=64),
    "textured lamp over a plane": Config(lit_from_below, LIGHT, along_z, Limits(0.025, 0.4, 0.25), res=64),
}

EDGES = {
    "rectangle under a sky": Config(
        lambda n: facing(n, square(), light=sky()), PLANE, along_x, Limits(0.02, 0.5, 0.25), step=SWEPT, rise=0
    ),
    "rectangle that glows": Config(
        lambda n: glowing(n, square(T().translate([1.25, 0, 0]), emitter=glow(1, 1, 1))),
        LIGHT,
        along_x,
        Limits(0.03, 1, 0.2),
        step=SWEPT,
        rise=0,
    ),
    "disk that glows": Config(
        disk_over_grey,
        ("disk.to_world",),
        translate(1, 0, 0),
        Limits(0.03, 1, 0.2),
        step=SWEPT,
        rise=0,
        depth=1,
        res=64,
    ),
    "sphere that glows": Config(
        lambda n: glowing(n, ball(T().translate([1.25, 0, 0]), emitter=glow(1, 1, 1))),
        LIGHT,
        along_x,
        Limits(0.08, 2, 0.15),
        step=SWEPT,
        rise=0,
    ),
    "sphere that grows": Config(
        lambda n: glowing(n, ball(emitter=glow(1, 1, 1))),
        LIGHT,
        grow,
        Limits(0.08, 0.5, 0.1),
        step=SWEPT,
        rise=0,
        res=64,
    ),
    "occluder": Config(
        lambda n: shadowed(n, {"type": "rectangle", "bsdf": diffuse()}),
        ("occluder.vertex_positions",),
        along_x,
        Limits(0.03, 1.75, 0.25),
        step=SWEPT,
        rise=0,
        spp=4192 * 4,
    ),
    "receiver of a shadow": Config(
        lambda n: shadowed(n, square()), PLANE, along_x, Limits(0.02, 0.5, 0.25), step=SWEPT, rise=0, spp=4096 // 2
    ),
    "plane and lamp": Config(
        lamp_below, PLANE + LIGHT, along_z, Limits(0.01, 0.1, 0.25), step=2 * SWEPT, spp=4096 // 4
    ),
    "wall and floor": Config(
        corner,
        ("wall.vertex_positions", "floor.vertex_positions"),
        along_z,
        Limits(0.01, 0.05, 0.25),
        step=SWEPT,
        rise=0,
        spp=4096 // 4,
    ),
}

CONFIGS = STATIC | MOVING | EDGES
