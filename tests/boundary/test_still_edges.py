"""Static edges: what a gradient moves, and how little an edge counts if nothing moves before it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.boundary.chains import begin_chain, chain_config, probe_chain
from pathreplay.boundary.crofton import STILL
from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.transport.motion import moving_shapes

T = mi.ScalarTransform4f


def before_a_wall() -> mi.Scene:
    """A ball of glass before a wall. The camera sees the outline of the ball in pixel columns 4.4 and 11.6."""
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 40,
                "to_world": T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": film,
            },
            "wall": {"type": "rectangle", "to_world": T().translate([0, 0, -2]).scale(6), "bsdf": red},
            "ball": {"type": "sphere", "radius": 0.65, "bsdf": {"type": "dielectric_ad"}},
            "lamp": {"type": "point", "position": [0, 3, 3], "intensity": 9.0},
        }
    )


def attached(scene: mi.Scene, *keys: str) -> mi.Scene:
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    return scene


@pytest.mark.parametrize(
    ("keys", "moving", "turning"),
    [
        (["ball.bsdf.eta"], [], ["ball"]),
        (["ball.to_world"], ["ball"], []),
        (["ball.to_world", "ball.bsdf.eta", "wall.bsdf.reflectance.value"], ["ball"], ["wall"]),
        (["lamp.position", "ball.bsdf.eta"], None, []),
    ],
    ids=["index", "pose", "all", "lamp"],
)
def test_a_gradient_of_a_material_moves_no_surface(
    keys: list[str], moving: list[str] | None, turning: list[str]
) -> None:
    found, turned = moving_shapes(attached(before_a_wall(), *keys), ())
    assert (None if found is None else [shape.id() for shape in found]) == moving
    assert [shape.id() for shape in turned] == turning


@pytest.mark.parametrize(
    ("key", "outline", "inside"), [("ball.bsdf.eta", STILL, 0), ("ball.to_world", 1, 0), ("wall.to_world", 1, 0)]
)
def test_the_outline_of_static_glass_counts_little(key: str, outline: float, inside: float) -> None:
    scene = attached(before_a_wall(), key)
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 4})
    view = Pass.of(scene, 0, 0, 1)
    with dr.suspend_grad():
        trace = ours._trace_config(scene, view.sensor)
    chain = chain_config(Boundary.informed(view, trace))
    with dr.suspend_grad():
        places, number = FilmPlaces.of(view), mi.UInt32(7, 7)
        a, b = (
            probe_chain(
                chain,
                begin_chain(chain, places.ray(mi.Point2f(x, 8), number)[0], mi.Bool(True)),
                number,
                mi.Bool(False),
            )
            for x in (mi.Float(3.0, 7.7), mi.Float(6.0, 8.3))
        )
        np.testing.assert_allclose(a.edge_importance(b), [outline, inside])


def test_static_hard_shadows_are_no_edges() -> None:
    """A point light casts the shadows of a static ball and of a moving ball onto a wall."""
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    eye = {"type": "perspective", "fov": 60, "to_world": T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]), "film": film}
    scene = {
        "type": "scene",
        "camera": eye,
        "wall": {"type": "rectangle", "to_world": T().translate([0, 0, -2]).scale(6)},
        "static": {"type": "sphere", "center": [0, 1, 0], "radius": 0.3},
        "ball": {"type": "sphere", "center": [0, -1, 0], "radius": 0.3},
        "lamp": {"type": "point", "position": [3, 0, 4]},
    }
    scene = attached(mi.load_dict(scene), "ball.to_world")
    ours, view = mi.load_dict({"type": "pathreplay", "max_depth": 3}), Pass.of(scene, 0, 0, 1)
    with dr.suspend_grad():
        chain = chain_config(Boundary.informed(view, ours._trace_config(scene, view.sensor)))
        places, key, lanes = FilmPlaces.of(view), mi.UInt32(7, 7), mi.Bool(True, True)
        dark, lit = (
            probe_chain(
                chain, begin_chain(chain, places.ray(places.of_point(p)[0], key)[0], lanes), key, mi.Bool(False)
            )
            for p in (mi.Point3f(-1.5, mi.Float(1.5, -1.5), -2), mi.Point3f(-1.5, mi.Float(0.1, -0.1), -2))
        )
        np.testing.assert_allclose(dark.edge_importance(lit), [0, 1])
