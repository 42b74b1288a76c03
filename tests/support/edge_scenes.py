"""Scenes whose edges move: small rooms of one wall, one lamp and one thing before them, and what moves in each.

The cells are cases of truth tests, whose pictures are weighed by `weights`. Where a light's radiance or a wall's paint
varies, it is bilinear noise, so that no side of an edge is constant. Steps are large, since a central difference is
held to the mean of the gradient between its two places: behind a ball of glass, which images the camera close to what
is there, the gradient changes by a tenth within a few hundredths, and no difference at one place would be right.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_configs import ball as sphere
from mitsuba_configs import square
from truth import RES, Case, Move, add, bitmap, camera, noise, rgb, rotate, translate, translate_vertices, turn_vertices

Place = Any
T = mi.ScalarTransform4f

# ------------------------------ Parts ------------------------------


def paint(*value: float) -> dict:
    value = value * 3 if len(value) == 1 else value
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": rgb(*value)}}


BLACK = paint(0, 0, 0)
BRUSHED = {"type": "twosided", "inner": {"type": "roughconductor", "alpha_u": 0.15, "alpha_v": 0.5}}
GLASS = {"type": "dielectric_ad", "int_ior": 1.5}
BACK = T().translate([0, 0, -1]).scale([6, 6, 1])


def picture() -> dict:
    return {**bitmap(noise(8, 3, 0.1, 1.0)), "filter_type": "bilinear"}


def patterned() -> dict:
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": picture()}}


def shape(place: Place, bsdf: dict, kind: str = "rectangle", **more: Any) -> dict:
    return {"type": kind, "to_world": place, "bsdf": bsdf, **more}


def lamp(place: Place, radiance: Any = 10.0, kind: str = "rectangle", bsdf: dict = BLACK) -> dict:
    radiance = radiance if isinstance(radiance, dict) else rgb(*3 * [radiance])
    return shape(place, bsdf, kind, emitter={"type": "area", "radiance": radiance})


def glow() -> dict:
    """A patterned wall that shines by itself."""
    return lamp(BACK, picture())


def scene(fov: float = 45, **parts: Any) -> dict:
    return {"type": "scene", "camera": camera((0, 0, 4), fov), **parts}


def mesh(vertices: Any, faces: Any, bsdf: dict, smooth: bool = False) -> mi.Mesh:
    """A mesh of these corners and triangles; ``smooth``: with vertex normals."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh("object", len(vertices), len(faces), props=props, has_vertex_normals=smooth)
    params = mi.traverse(made)
    params["vertex_positions"] = np.ravel(vertices)
    params["faces"] = np.ravel(faces)
    params.update()
    return made


def cube8(place: Place, bsdf: dict) -> mi.Mesh:
    """The cube [-1, 1]³ with eight vertices, so that faces share their edges."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices = [np.array(place @ mi.ScalarPoint3f(*p)).ravel() for p in corners]
    return mesh(vertices, [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))], bsdf)


def can(place: Place, bsdf: dict, n: int = 10) -> mi.Mesh:
    """A cylinder with smooth sides and flat ends: there the rims are written twice, and triangles share the rest."""
    turns = 2 * np.pi * np.arange(n) / n
    rims = [np.array(place @ mi.ScalarPoint3f(np.cos(a), y, np.sin(a))).ravel() for y in (-1, 1) for a in turns]
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    sides = [*zip(i, i + n, j, strict=True), *zip(j, i + n, j + n, strict=True)]
    below = [(2 * n, 2 * n + k, 2 * n + k + 1) for k in range(1, n - 1)]
    above = [(3 * n, 3 * n + k + 1, 3 * n + k) for k in range(1, n - 1)]
    return mesh([*rims, *rims], [*sides, *below, *above], bsdf, smooth=True)


def cube24(place: Place, bsdf: dict) -> dict:
    """The same as Mitsuba has it: every face has vertices of its own."""
    return shape(place, bsdf, "cube", face_normals=True)


def sky() -> dict:
    texels = np.random.default_rng(5).uniform(0.1, 2, (4, 8, 3)).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(texels.repeat(4, 0).repeat(4, 1))}


# ------------------------------ What the camera sees ------------------------------

CARD = T().translate([0.7, 0.5, 0.9]).rotate([0, 0, 1], 20).scale([0.35, 0.3, 1])
BOX = T().translate([0.1, 0.1, 0]).rotate([1, 0.4, 0], 30).scale(0.4)
OVERHEAD = T().translate([1.6, 1.2, 2.5]).look_at([0, 0, 0], [-1.6, -1.2, -3.5], [0, 1, 0]).scale([0.5, 0.5, 1])


def before_a_glow(thing: Any) -> Callable[[], dict]:
    return lambda: scene(wall=glow(), object=thing())


def lit_box(make: Callable[[Place, dict], Any]) -> Callable[[], dict]:
    return lambda: scene(wall=shape(BACK, patterned()), lamp=lamp(OVERHEAD), object=make(BOX, paint(0.5, 0.5, 0.2)))


def can_lit_from_the_front() -> dict:
    """Without places where a facet hides a lamp that smooth shading would see: `hexagon_lit` has those."""
    place = T().translate([0.1, 0.2, 4.5]).rotate([0, 1, 0], 180).scale([0.5, 0.5, 1])
    return scene(wall=shape(BACK, patterned()), lamp=lamp(place), object=can(BOX, paint(0.5, 0.5, 0.2)))


def hexagon_lit(**more: Any) -> Callable[[], dict]:
    """Its triangles hide a lamp that their smooth shading would see."""
    return lambda: scene(lamp=lamp(OVERHEAD), object=can(BOX, paint(0.5, 0.5, 0.2), 6), **more)


def can_from_near(bsdf: dict) -> Callable[[], dict]:
    """Some sides of a can and nothing else, before a wide glow: all that the film has of edges are creases."""
    wide = T().translate([0, 0, -1]).scale([30, 30, 1])
    return lambda: scene(8, wall=lamp(wide, 1), object=can(BOX, bsdf, 16))


def facet_seen() -> dict:
    """A bit of one triangle before a wide glow: what its plane hides moves on the wall, and not on the film."""
    wide = T().translate([0, 0, -1]).scale([30, 30, 1])
    return scene(0.2, wall=lamp(wide, 1), object=can(BOX, paint(0.5, 0.5, 0.2), 6))


def lamp_seen() -> dict:
    place = T().translate([0.2, 0.1, 0.3]).rotate([0, 1, 0], 200).scale([0.5, 0.4, 1])
    return scene(wall=shape(BACK, patterned()), lamp=lamp(place, 3), other=lamp(OVERHEAD, 6))


# ------------------------------ Shadows ------------------------------

SHADE = T().translate([1.3, 0.9, 1.2])


def shadow(thing: Any = None, wall: Any = patterned, light: Any = None) -> Callable[[], dict]:
    """A wall, a lamp, and between them something that the camera does not see."""
    thing = thing or (lambda: shape(SHADE.scale([0.35, 0.3, 1]), BLACK))
    light = light or (lambda: lamp(OVERHEAD))
    return lambda: scene(30, wall=shape(BACK, wall()), lamp=light(), object=thing())


def plain() -> dict:
    return paint(0.7, 0.6, 0.5)


def glossy() -> dict:
    """Plastic so dark that nearly half of the samples are reflected."""
    return {"type": "plastic", "diffuse_reflectance": rgb(0.05, 0.06, 0.04)}


def bulb() -> dict:
    return {"type": "point", "position": [1.6, 1.2, 2.5], "intensity": rgb(40, 30, 50)}


def ball_lamp() -> dict:
    return lamp(T().translate([1.6, 1.2, 2.5]).scale(0.4), kind="sphere")


def painted_lamp() -> mi.Mesh:
    """A mesh that glows with a texture."""
    radiance = {**bitmap(noise(8, 3, 1, 10)), "filter_type": "bilinear"}
    return square(OVERHEAD, bsdf=BLACK, emitter={"type": "area", "radiance": radiance})


def ball_of_triangles() -> mi.Mesh:
    """A ball that glows, of 224 triangles that are shaded smoothly."""
    return sphere(T().translate([1.6, 1.2, 2.5]).scale(0.4), 8, emitter={"type": "area", "radiance": rgb(10, 10, 10)})


def shadow_of_sky() -> dict:
    place = T().translate([0.9, 0.9, 0.2]).scale([0.8, 0.6, 1])
    return scene(30, wall=shape(BACK, patterned()), sky=sky(), object=shape(place, BLACK))


def lamp_lights() -> dict:
    """A lamp that the camera sees from behind, and that lights the wall."""
    place = T().translate([0.9, 0.8, 0.6]).rotate([0, 1, 0], 160).scale([0.4, 0.3, 1])
    return scene(30, wall=shape(BACK, patterned()), lamp=lamp(place, 5), other=lamp(OVERHEAD))


def copies_shade() -> dict:
    box = shape(T().rotate([1, 0.4, 0], 30).scale(0.25), BLACK, "cube", face_normals=True)
    group = {"type": "shapegroup", "box": box}
    copy = {"type": "instance", "to_world": SHADE, "group": {"type": "ref", "id": "group"}}
    return scene(30, wall=shape(BACK, patterned()), lamp=lamp(OVERHEAD), group=group, copy=copy)


def two_copies() -> dict:
    """Two copies of a box that are seen, and shade a wall and each other."""
    box = shape(T().rotate([1, 0.4, 0], 30).scale(0.35), paint(0.6, 0.4, 0.3), "cube", face_normals=True)
    group = {"type": "shapegroup", "box": box}
    one, two = (
        {"type": "instance", "to_world": T().translate([x, 0.1, 0.1]), "group": {"type": "ref", "id": "group"}}
        for x in (-0.5, 0.6)
    )
    return scene(wall=shape(BACK, patterned()), lamp=lamp(OVERHEAD), group=group, one=one, two=two)


def copied(thing: dict, place: Place) -> dict:
    """The parts of a scene that has a copy of something; its name is 'group.thing'."""
    copy = {"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}}
    return {"group": {"type": "shapegroup", "thing": thing}, "copy": copy}


def copy_is_shaded() -> dict:
    card = shape(SHADE.scale([0.35, 0.3, 1]), BLACK)
    return scene(30, lamp=lamp(OVERHEAD), object=card, **copied(shape(T().scale([6, 6, 1]), patterned()),
                 T().translate([0, 0, -1])))  # fmt: skip


def projected() -> dict:
    """A picture that is thrown at a wall, and ends there."""
    turned = T().look_at([1.2, 0.8, 2.5], [0, 0, -1], [0, 1, 0])
    return scene(
        wall=shape(BACK, plain()),
        lamp={"type": "projector", "to_world": turned, "fov": 25, "irradiance": {**bitmap(noise(8, 3, 2, 9)),
              "filter_type": "bilinear"}},
    )  # fmt: skip


def spotted(beam: float) -> Callable[[], dict]:
    """A spot whose light does not fade, since its beam is as wide as its cone, or wider."""
    turned = T().look_at([1.2, 0.8, 2.5], [0, 0, -1], [0, 1, 0])
    return lambda: scene(
        wall=shape(BACK, plain()),
        lamp={"type": "spot", "to_world": turned, "intensity": rgb(9, 8, 7), "cutoff_angle": 15.0, "beam_width": beam},
    )


def in_the_sun(thing: Callable[[], Any]) -> Callable[[], dict]:
    """Something before a wall, in parallel light."""
    sun = {"type": "directional", "to_world": T().look_at([1.6, 2.2, 2.0], [0, 0, -0.5], [0, 1, 0]),
           "irradiance": rgb(9, 8, 7)}  # fmt: skip
    return lambda: scene(wall=shape(BACK, patterned()), lamp=sun, object=thing())


def behind_a_post() -> dict:
    """A lamp that the camera sees, half behind a post."""
    light = T().translate([0.3, 0.1, -0.3]).scale([0.45, 0.3, 1])
    post = T().translate([0.1, 0, 0.4]).scale([0.15, 1.5, 1])
    return scene(wall=shape(BACK, patterned()), lamp=lamp(light, 3), object=shape(post, paint(0.5)))


def by_a_side_wall(wall: Callable[[], dict], side: Callable[[], dict], light: dict | None = None) -> Callable[[], dict]:
    """Light that reaches the wall by another, past something that hides a part of it."""
    aside = T().translate([2.2, 0, 0]).rotate([0, 1, 0], -90).scale([2, 2, 1])
    above = T().translate([0.6, 2.6, 0.5]).look_at([0, 0, 0], [1.6, -2.4, 0], [0, 0, 1]).scale([0.4, 0.4, 1])
    card = T().translate([1.5, 0.2, 0.2]).rotate([0, 1, 0], 60).scale([0.5, 0.5, 1])
    return lambda: scene(
        30,
        wall=shape(BACK, wall()),
        side=shape(aside, side()),
        lamp=light or lamp(above, 20),
        object=shape(card, paint(0.3)),
    )


def on_a_side_wall(thing: Callable[[], Any]) -> Callable[[], dict]:
    """Light that reaches the wall by something bright at a dark wall beside it."""
    aside = T().translate([2.2, 0, 0]).rotate([0, 1, 0], -90).scale([2, 2, 1])
    above = T().translate([0.6, 2.6, 0.5]).look_at([0, 0, 0], [1.6, -2.4, 0], [0, 0, 1]).scale([0.4, 0.4, 1])
    return lambda: scene(
        30, wall=shape(BACK, patterned()), side=shape(aside, paint(0.1)), lamp=lamp(above, 20), object=thing()
    )


def stands_in_the_wall() -> dict:
    return scene(wall=shape(BACK, plain()), lamp=lamp(OVERHEAD), object=cube24(IN_THE_BACK, paint(0.8, 0.8, 0.3)))


def in_a_floor(thing: Callable[[], Any]) -> Callable[[], dict]:
    """Something that stands in a floor, under a sky: from the line of contact it overhangs."""
    floor = T().rotate([1, 0, 0], -90).scale([4, 4, 1])
    return lambda: {
        "type": "scene",
        "camera": camera((0, 1.2, 4), 30, (0, 0.3, 0)),
        "floor": shape(floor, paint(0.5, 0.6, 0.7)),
        "object": thing(),
        "sky": {"type": "constant", "radiance": rgb(0.8, 0.9, 1)},
    }


def sheet() -> dict:
    """That lets a part of the light through."""
    half = {"type": "mask", "opacity": 0.6, "bsdf": paint(0.6, 0.4, 0.3)}
    return shape(SHADE.scale([0.35, 0.3, 1]), half)


# ------------------------------ Glass and mirrors ------------------------------


def mirror() -> dict:
    glass = T().rotate([0, 1, 0], -25).scale([1.5, 1.5, 1])
    light = T().translate([-3, 0.2, 2.5]).rotate([0, 1, 0], 120).scale([0.6, 0.5, 1])
    return scene(mirror=shape(glass, {"type": "conductor"}), lamp=lamp(light, rgb(3, 0, 0)))


def ball_of_glass() -> dict:
    light = T().translate([0.2, 0.1, -3]).scale([0.7, 0.5, 1])
    return scene(24, ball=shape(T(), GLASS, "sphere"), lamp=lamp(light, 3))


def glowing_behind_glass() -> dict:
    """A glowing wall and a brighter card before it, behind a ball of glass: every edge is seen through the glass."""
    far, card = T().translate([0, 0, -3]).scale([8, 8, 1]), T().translate([0.3, 0.2, -2]).scale([0.4, 0.3, 1])
    bright = lamp(card, rgb(3, 2, 1))
    return scene(24, ball=shape(T().scale(0.9), GLASS, "sphere"), wall=lamp(far, picture()), object=bright)


def behind_a_pane() -> dict:
    """A wall that a lamp lights through a pane of glass, with a ball between lamp and pane."""
    pane = OVERHEAD.translate([0, 0, 2.4]).scale([3, 3, 1])
    return scene(
        30,
        wall=shape(BACK, patterned()),
        pane=shape(pane, {"type": "thindielectric"}),
        lamp=lamp(OVERHEAD, 20),
        object=shape(SHADE.translate([0, 0, 0.3]).scale(0.3), BLACK, "sphere"),
    )


def everything() -> dict:
    """Lamps with and without extent, a mirror, glass, a mesh with edges, and a sky: all of them may move."""
    tilted = T().translate([-1.2, 0.2, 0]).rotate([0, 1, 0], 30).scale([0.5, 0.6, 1])
    return scene(
        wall=shape(BACK, patterned()), lamp=lamp(OVERHEAD), sky=sky(),
        bulb=lamp(T().translate([-1.5, 1.8, 1.5]).scale(0.2), 20, "sphere"),
        point={"type": "point", "position": [0.5, 2.5, 2.0], "intensity": rgb(9, 8, 7)},
        mirror=shape(tilted, {"type": "conductor"}),
        ball=shape(T().translate([0.9, -0.5, 0.3]).scale(0.4), GLASS, "sphere"),
        object=cube24(IN_THE_BACK, paint(0.8, 0.8, 0.3)), can=can(BOX, paint(0.5, 0.5, 0.2)),
    )  # fmt: skip


# ------------------------------ Cells ------------------------------


def weights() -> np.ndarray:
    """Of a picture: smooth, and another wave in each channel, so that what moves across it does not cancel."""
    y, x = np.mgrid[0:RES, 0:RES]
    waves = [1.2 + np.sin(0.74 * x + 0.11 * y), 1.2 + np.cos(0.23 * x - 0.62 * y), np.ones_like(x)]
    return np.stack(waves, -1).astype(np.float32) / (3 * RES**2)


ASIDE = (1.0, 0.3, 0.0)
SEVERAL = ("wall.to_world", "lamp.to_world", "object.to_world")


def cell(name: str, make: Callable[[], dict], key: str, move: Move, depth: int = 2, **more: Any) -> Case:
    """A case of everything moving but what paths choose at random; roulette would depend on the parameter."""
    settings: dict[str, Any] = dict(
        step=0.05, spp=256, seeds=12, reference_spp=1024, rr_depth=1000, options={"boundary": "all"},
        drivers=("recorded",), lanes=None,
    )  # fmt: skip
    return Case(name, make, key, move, depth, **{**settings, **more})


def disk() -> dict:
    return shape(T().translate([0.1, 0.1, 0.2]).rotate([0, 1, 0], 30).scale(0.5), BLACK, "disk")


def ball() -> dict:
    return shape(T().translate([0.1, 0.1, 0]).scale(0.5), BLACK, "sphere")


IN_THE_BACK = T().translate([0.2, -0.6, -0.9]).rotate([1, 0.4, 0], 30).scale(0.4)
IN_THE_WALL = T().translate([2.1, 0.1, -0.1]).rotate([1, 0, 0], 25).scale(0.4)
BESIDE = T().translate([1.6, 0.1, -0.1]).rotate([0, 0, 1], 20).scale([0.4, 0.5, 0.4])
SHADE_BOX = SHADE.rotate([1, 0.4, 0], 30).scale(0.25)
TURN, UP = turn_vertices(0, 1, 0), translate(0, 0, 1)
OBJECT, VERTICES = "object.to_world", "object.vertex_positions"

SEEN = [
    cell("rect_black", before_a_glow(lambda: shape(CARD, BLACK)), OBJECT, translate(*ASIDE)),
    cell("rect_emit", lambda: scene(object=lamp(T().translate([0.1, 0.05, 0]).scale([0.4, 0.3, 1]), 1)),
         OBJECT, translate(1, 0, 0)),
    cell("sphere_black", before_a_glow(ball), OBJECT, translate(*ASIDE)),
    cell("disk_black", before_a_glow(disk), OBJECT, translate(*ASIDE)),
    cell("cube8_turns", before_a_glow(lambda: cube8(BOX, BLACK)), VERTICES, TURN),
    cell("cube24_turns", before_a_glow(lambda: cube24(BOX, BLACK)), VERTICES, TURN),
    cell("cube8_lit", lit_box(cube8), VERTICES, TURN),
    cell("cube24_lit", lit_box(cube24), VERTICES, TURN),
    cell("can_moves", can_lit_from_the_front, VERTICES, translate_vertices(0, 1, 0), seeds=32),
    cell("hexagon_moves", hexagon_lit(), VERTICES, translate_vertices(*ASIDE), seeds=32),
    cell("hexagon_seen", hexagon_lit(), "camera.to_world", translate(*ASIDE), seeds=32),
    cell("hexagon_bounced", hexagon_lit(wall=shape(BACK, paint(0.9))), VERTICES, translate_vertices(*ASIDE), 3),
    cell("facet_seen", facet_seen, VERTICES, translate_vertices(1, 0.3, 0.4), step=0.002, spp=1024, reference_spp=4096,
         seeds=24),
    cell("can_seen", can_from_near(paint(0.5, 0.5, 0.2)), VERTICES, translate_vertices(1, 0.3, 0.4), step=0.002,
         spp=1024, seeds=24),
    cell("brushed_can_seen", can_from_near(BRUSHED), VERTICES, translate_vertices(1, 0.3, 0.4), step=0.002, spp=1024,
         seeds=24),
    cell("projector_moves", projected, "lamp.to_world", translate(*ASIDE)),
    cell("camera_moves", before_a_glow(lambda: shape(CARD, BLACK)), "camera.to_world", translate(*ASIDE)),
    cell("spot_sharp", spotted(15.0), "lamp.to_world", translate(*ASIDE)),
    cell("spot_turns", spotted(15.0), "lamp.to_world", rotate(0.3, 1, 0)),
    cell("spot_widens", spotted(20.0), "lamp.cutoff_angle", add(10.0)),
    cell("sun_turns", in_the_sun(lambda: cube24(BOX, paint(0.6, 0.4, 0.3))), "lamp.to_world", rotate(0.3, 1, 0), 3),
    cell("lamp_by_post", behind_a_post, "lamp.to_world", translate(*ASIDE)),
    cell("lamp_seen", lamp_seen, "lamp.to_world", translate(*ASIDE)),
]  # fmt: skip
"""What the camera sees."""
SHADOWS = [
    cell("shadow_occluder", shadow(), OBJECT, translate(*ASIDE)),
    cell("shadow_lamp", shadow(), "lamp.to_world", translate(*ASIDE)),
    cell("shadow_receiver", shadow(wall=plain), "wall.to_world", UP),
    cell("shadow_all", shadow(wall=plain), SEVERAL, UP, seeds=8),
    cell("shadow_sphere", shadow(lambda: shape(SHADE.scale(0.3), BLACK, "sphere")), OBJECT, translate(*ASIDE)),
    cell("shadow_hard", shadow(lambda: shape(SHADE.scale(0.3), BLACK, "sphere"), light=bulb), OBJECT,
         translate(*ASIDE)),
    cell("shadow_on_plastic", shadow(lambda: shape(SHADE.scale(0.3), BLACK, "sphere"), glossy, bulb), OBJECT,
         translate(*ASIDE)),
    cell("shadow_cube8", shadow(lambda: cube8(SHADE_BOX, BLACK)), VERTICES, turn_vertices(0, 0, 1)),
    cell("shadow_cube24", shadow(lambda: cube24(SHADE_BOX, BLACK)), VERTICES, turn_vertices(0, 0, 1)),
    cell("copies_move", two_copies, "group.box.vertex_positions", translate_vertices(*ASIDE), 3),
    cell("shadow_copy", copies_shade, "group.box.vertex_positions", translate_vertices(*ASIDE)),
    cell("copy_is_shaded", copy_is_shaded, OBJECT, translate(*ASIDE)),
    cell("sphere_lamp", shadow(light=ball_lamp), "lamp.to_world", translate(*ASIDE)),
    cell("shadow_env", shadow_of_sky, OBJECT, translate(*ASIDE)),
    cell("shadow_painted", shadow(light=painted_lamp), "lamp.vertex_positions", turn_vertices(0.3, 1, 0.2)),
    cell("mesh_lamp", shadow(light=ball_of_triangles), OBJECT, translate(*ASIDE), spp=512),
    cell("lamp_lights", lamp_lights, "lamp.to_world", translate(*ASIDE)),
]  # fmt: skip
INDIRECT = [
    cell("indirect", by_a_side_wall(patterned, lambda: paint(0.8, 0.7, 0.3)), OBJECT, translate(1, 0.3, 0.4), 3,
         seeds=32),
    cell("indirect_point", by_a_side_wall(plain, lambda: paint(0.8, 0.7, 0.3),
        {"type": "point", "position": [0.6, 2.6, 0.5], "intensity": rgb(9, 8, 7)}), OBJECT, translate(1, 0.3, 0.4), 3),
    cell("indirect_rough", by_a_side_wall(
        lambda: {"type": "twosided", "inner": {"type": "roughconductor", "alpha": 0.3}}, patterned),
        OBJECT, translate(1, 0.3, 0.4), 3, seeds=24),
    cell("cube_in_wall", stands_in_the_wall, VERTICES, translate_vertices(0, 0, 1), 3, seeds=16),
    cell("indirect_contact", on_a_side_wall(lambda: cube24(IN_THE_WALL, paint(0.9))), VERTICES,
         translate_vertices(0.3, 1, 0.2), 3, seeds=48),
    cell("indirect_can", on_a_side_wall(lambda: can(BESIDE, paint(0.9), 5)), VERTICES, turn_vertices(0, 1, 0.3), 3,
         seeds=16),
]  # fmt: skip
"""One bounce more."""
TOUCHING = [
    cell("ball_in_floor", in_a_floor(lambda: shape(T().translate([0, 0.35, 0]).scale(0.5), paint(0.7, 0.5, 0.3),
        "sphere")), OBJECT, translate(0, 1, 0), spp=2048, reference_spp=4096, step=0.02),
    cell("cube_in_floor", in_a_floor(lambda: cube24(T().translate([0, 0.2, 0]).rotate([1, 0.3, 0.5], 40).scale(0.4),
        paint(0.7, 0.5, 0.3))), VERTICES, translate_vertices(0, 1, 0), 3, spp=1024, reference_spp=4096, step=0.02),
]  # fmt: skip
"""Bodies that stand in another."""
VEILED = [
    cell("veil_moves", shadow(sheet), OBJECT, translate(*ASIDE), 3, spp=1024, seeds=48),
]
"""Seen through what lets a part of the light straight through."""
BENT = [
    cell("mirror_z", mirror, "mirror.to_world", UP, 3),
    cell("mirror_x", mirror, "mirror.to_world", translate(1, 0, 0), 3),
    cell("glass_index", ball_of_glass, "ball.bsdf.eta", add(1.0), 5),
    cell("glass_moves", ball_of_glass, "ball.to_world", translate(1, 0, 0), 5, step=0.01,
         reference_spp=4096),
    cell("emit_eta", glowing_behind_glass, "ball.bsdf.eta", add(1.0), 6),
    cell("emit_blocker", glowing_behind_glass, OBJECT, translate(1, 0, 0), 6, step=0.02),
    cell("emit_sphere", glowing_behind_glass, "ball.to_world", translate(*ASIDE), 6, step=0.01),
]  # fmt: skip
"""By mirrors and through glass."""
REFLECTED = [
    cell("pane_shades", behind_a_pane, OBJECT, translate(*ASIDE), 4, spp=1024, reference_spp=8192, seeds=24),
    cell("mirror_shades", by_a_side_wall(plain, lambda: {"type": "conductor"}), OBJECT, translate(1, 0, -1), 3,
         spp=1024, reference_spp=8192, seeds=48),
    cell("index_of_a_shade", shadow(lambda: shape(SHADE.scale(0.3), GLASS, "sphere"), plain), "object.bsdf.eta",
         add(1.0), 4, spp=1024, reference_spp=8192, seeds=32),
    cell("mirror_in_a_room", by_a_side_wall(plain, lambda: {"type": "conductor"}), "lamp.to_world",
         translate(1, 0.3, 0.4), 4, spp=1024, reference_spp=8192, seeds=24),
]  # fmt: skip
"""Seen by surfaces, in mirrors and through glass."""
ALL_MOVE = cell("all_move", everything, ("wall.to_world", "lamp.to_world", "bulb.to_world", "mirror.to_world",
    "ball.to_world"), translate(*ASIDE), 3)  # fmt: skip
BY_NAME = {each.name: each for each in (*SEEN, *TOUCHING, *SHADOWS, *INDIRECT, *REFLECTED, *VEILED, *BENT)}
