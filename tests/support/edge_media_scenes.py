"""Scenes with media whose edges move: what is seen through fog, shadows in it, and boundaries of it that move.

They are built of the parts of `edge_scenes`, and weighed as those are. The fog has no end unless it is in a box or
ball: a camera says that it stands in it, and a wall stops its rays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import mitsuba as mi

from edge_scenes import (
    ASIDE,
    BACK,
    BLACK,
    CARD,
    OVERHEAD,
    T,
    by_a_side_wall,
    cell,
    glow,
    lamp,
    paint,
    patterned,
    picture,
    plain,
    shape,
    sky,
)
from media_scenes import FORWARD, NULL, heterogeneous, homogeneous, smooth
from truth import Case, Move, add, camera, rgb, translate

FOG = {"type": "ref", "id": "fog"}
WALL = paint(0.3, 0.25, 0.2)


def in_fog(medium: dict, fov: float = 45, **parts: Any) -> dict:
    """A scene in endless fog, in which the camera stands."""
    return {"type": "scene", "fog": medium, "camera": {**camera((0, 0, 4), fov), "medium": FOG}, **parts}


def in_a_box(medium: dict, **parts: Any) -> dict:
    """A scene with a box of fog, the cube [-1, 1]³ or a larger one, and the camera outside."""
    return {"type": "scene", "camera": camera((0, 0, 4), 45), "box": shape(T(), NULL, "cube", interior=medium), **parts}


BEHIND = T().translate([0, 0, -1.5]).scale([7, 7, 1])
"""A wall that does not touch the box."""
INSIDE = T().translate([0.2, 0.1, 0.3]).scale(0.4)


def thin(**more: Any) -> dict:
    return homogeneous(0.25, 0.8, **more)


def clouds(plugin: str = "heterogeneous") -> dict:
    return heterogeneous(smooth(0.1, 1.2), smooth(0.5, 0.9), plugin=plugin)


def grow(value: Any, t: Any) -> mi.Transform4f:
    """Of a card, so that its shadow does."""
    return mi.Transform4f(value) @ mi.Transform4f().scale([1 + t, 1 + t, 1])


def card() -> dict:
    return shape(CARD, BLACK)


def card_before_a_glow() -> dict:
    return in_fog(thin(phase=FORWARD), wall=glow(), object=card())


def card_in_clouds(plugin: str) -> Callable[[], dict]:
    return lambda: in_a_box(
        clouds(plugin), wall=lamp(BEHIND, picture()), object=shape(T().translate([0.2, 0.1, 0.3]).scale(0.4), BLACK)
    )


BEAM = T().translate([1.05, 0.75, 1.5]).rotate([0, 0, 1], 20).scale([0.45, 0.25, 1])
"""Where a card casts a shadow into the fog that the camera looks at, and is itself beside the picture."""


NEAR = T().translate([2.2, 1.6, 1.5]).look_at([0, 0, 0], [-2.2, -1.6, -1.5], [0, 1, 0]).scale([1.2, 1.2, 1])
"""A lamp large enough to be found by chance."""
BY_CHANCE = {"sample_emitters": False}
"""Of a medium: only directions that particles scatter find lamps."""


def shadow_in_fog(light: Callable[[], dict], **more: Any) -> Callable[[], dict]:
    return lambda: in_fog(thin(**more), 30, wall=shape(BACK, BLACK), lamp=light(), object=shape(BEAM, BLACK))


def point() -> dict:
    return {"type": "point", "position": [1.6, 1.2, 2.5], "intensity": rgb(12, 10, 8)}


def lamp_in_fog() -> dict:
    """A lamp that the camera sees, and that lights fog and wall."""
    place = T().translate([0.2, 0.1, 0.3]).rotate([0, 1, 0], 30).scale([0.4, 0.3, 1])
    return in_fog(thin(), wall=shape(BACK, patterned()), lamp=lamp(place, 4))


def ball_of_fog() -> dict:
    """It hangs before a wall under a lamp."""
    medium = homogeneous(1.5, 0.8)
    ball = {"type": "sphere", "to_world": T().translate([0.2, 0.1, -0.2]).scale(0.6), "bsdf": NULL, "interior": medium}
    return {"type": "scene", "camera": camera((0, 0, 4), 35), "wall": shape(BACK, patterned()), "lamp": lamp(OVERHEAD),
            "object": ball}  # fmt: skip


def ball_under_a_sky() -> dict:
    """Dark fog above a wall, beside the picture. What the wall holds of its directions jumps at the ball's outline."""
    ball = {"type": "sphere", "to_world": T().translate([0.9, 0.9, 0.2]).scale(0.7), "bsdf": NULL,
            "interior": homogeneous(1.0, 0.0)}  # fmt: skip
    return {"type": "scene", "camera": camera((0, 0, 4), 30), "wall": shape(BACK, patterned()), "sky": sky(),
            "object": ball}  # fmt: skip


def lamp_behind_a_ball() -> dict:
    """Its edge is seen by particles through the boundary of the ball, and by the camera through all of it."""
    ball = {"type": "sphere", "to_world": T().scale(0.7), "bsdf": NULL, "interior": homogeneous(1.0, 0.8, FORWARD)}
    light = T().translate([0.1, 0.1, -0.9]).scale([0.5, 0.4, 1])
    return {"type": "scene", "camera": camera((0, 0, 4), 35), "wall": shape(BACK, patterned()), "lamp": lamp(light, 4),
            "ball": ball}  # fmt: skip


def lamp_by_a_ball(**more: Any) -> dict:
    """A large lamp close to a ball of fog, beside the picture: particles often see it by chance."""
    ball = {"type": "sphere", "to_world": T().scale(0.7), "bsdf": NULL, "interior": homogeneous(1.5, 0.9, **more)}
    light = T().translate([1.4, 0.1, 0.2]).rotate([0, 1, 0], -90).scale([0.6, 0.7, 1])
    return {"type": "scene", "camera": camera((0, 0, 4), 20), "wall": shape(BACK, BLACK), "lamp": lamp(light, 4),
            "ball": ball}  # fmt: skip


def mirror_in_fog() -> dict:
    glass = T().rotate([0, 1, 0], -25).scale([1.5, 1.5, 1])
    light = T().translate([-2, 0.2, 2.0]).rotate([0, 1, 0], 120).scale([0.6, 0.5, 1])
    return in_fog(thin(), mirror=shape(glass, {"type": "conductor"}), lamp=lamp(light, 3), wall=shape(BACK, WALL))


def indirect_in_smoke(box: bool = False) -> dict:
    """Light that reaches a wall by another, through smoke that does not scatter: around all, or in a box of its own."""
    light = {"type": "point", "position": [0.6, 2.6, 0.5], "intensity": rgb(9, 8, 7)}
    parts = by_a_side_wall(plain, lambda: paint(0.8, 0.7, 0.3), light)()
    smoke = {"type": "homogeneous", "sigma_t": 0.2, "albedo": 0.0}
    if box:
        place = T().translate([1.2, 0.1, 0]).scale([0.7, 1.5, 0.9])
        return {**parts, "smoke": shape(place, NULL, "cube", interior=smoke)}
    return {**parts, "fog": smoke, "camera": {**parts["camera"], "medium": FOG}}


def spot_in_smoke() -> dict:
    """The sharp border of a spot light on a wall, through smoke that does not scatter."""
    place = T().look_at([0.6, 0.4, 2.5], [0.1, 0.1, 0], [0, 1, 0])
    spot = {"type": "spot", "to_world": place, "cutoff_angle": 8, "beam_width": 8, "intensity": rgb(12, 10, 8)}
    return in_fog({"type": "homogeneous", "sigma_t": 0.1, "albedo": 0.0}, wall=shape(BACK, plain()), lamp=spot)


def ball_in_thick_fog() -> dict:
    medium, ball = homogeneous(4.0, 0.8), {"type": "sphere", "to_world": T().translate([0.1, 0, -0.1]).scale(0.35)}
    return in_a_box(medium, object=ball, wall=lamp(BEHIND, 2), lamp=lamp(OVERHEAD))


def media_cell(name: str, make: Callable[[], dict], key: str, move: Move, depth: int = 3, **more: Any) -> Case:
    return cell(name, make, key, move, depth, **{"reference": "volpath", "spp": 128, **more})


OBJECT = "object.to_world"
CELLS = [
    media_cell("fog_card", card_before_a_glow, OBJECT, translate(*ASIDE)),
    media_cell("cloud_card", card_in_clouds("heterogeneous"), OBJECT, translate(*ASIDE)),
    media_cell("grid_card", card_in_clouds("gridmedium"), OBJECT, translate(*ASIDE)),
    media_cell("fog_shadow", shadow_in_fog(lambda: lamp(OVERHEAD)), OBJECT, grow, 2, spp=64),
    media_cell("fog_beam", shadow_in_fog(point), OBJECT, translate(0.5, -1, 0), 2, spp=192),
    media_cell("fog_lamp", lamp_in_fog, "lamp.to_world", translate(*ASIDE)),
    media_cell("fog_light_moves", shadow_in_fog(point), "lamp.position", add([1.0, 0.3, 0.0]), 2),
    media_cell("ball_moves", ball_of_fog, OBJECT, translate(*ASIDE)),
    media_cell("ball_sky", ball_under_a_sky, OBJECT, translate(*ASIDE), 2),
    media_cell("behind_ball", lamp_behind_a_ball, "lamp.to_world", translate(*ASIDE)),
    media_cell("by_ball_chance", lambda: lamp_by_a_ball(**BY_CHANCE), "lamp.to_world", translate(-1, 0, 0), 2),
    media_cell("shadow_chance", lambda: shadow_in_fog(lambda: lamp(NEAR, 4), **BY_CHANCE)(), OBJECT, grow, 2),
    media_cell("by_ball", lamp_by_a_ball, "lamp.to_world", translate(-1, 0, 0), 2),
    media_cell("fog_mirror", mirror_in_fog, "mirror.to_world", translate(0, 0, 1)),
    media_cell("spot_border", spot_in_smoke, "lamp.to_world", translate(1, 0.3, 0), 2),
    media_cell("thick_fog", ball_in_thick_fog, OBJECT, translate(1, 0.4, 0.2), 5, spp=64, step=2e-2),
    media_cell("indirect", indirect_in_smoke, OBJECT, translate(1, 0.3, 0.4), spp=256, seeds=24),
    media_cell("indirect_box", partial(indirect_in_smoke, True), OBJECT, translate(1, 0.3, 0.4), spp=256, seeds=24),
]
BY_NAME = {each.name: each for each in CELLS}
