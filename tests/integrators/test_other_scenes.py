"""Attached parameters of another scene in the process do not change what a pass computes, or how."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay import PathreplayError
from pathreplay.adjoint.emission_only import only_emission_varies
from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.lifetimes import careful
from pathreplay.transport.motion import path_moves, weights_vary
from pathreplay.transport.path import PathState
from truth import lit_room, rgb, translate

COLOUR, PLACE = "object.bsdf.reflectance.value", "object.to_world"
LAMP, SKY = "lamp.intensity.value", "sky.radiance.value"
OF_OTHER = COLOUR, PLACE, LAMP, "lamp.position"


def room() -> mi.Scene:
    description = lit_room({"type": "diffuse", "reflectance": rgb(0.5, 0.6, 0.7)})
    description["lamp"] = {"type": "point", "position": [0.5, 2, 2], "intensity": rgb(2, 2, 2)}
    return mi.load_dict(description, optimize=False)


def attach(scene: mi.Scene, *keys: str) -> mi.SceneParameters:
    params = mi.traverse(scene)
    dr.enable_grad(*(params[key] for key in keys))
    params.update()
    return params


def detach(params: mi.SceneParameters) -> None:
    dr.disable_grad(*(params[key] for key in OF_OTHER))
    params.update()


@pytest.fixture(autouse=True)
def other() -> Iterator[mi.SceneParameters]:
    """The parameters of another scene, in which everything moves."""
    params = attach(room(), *OF_OTHER)
    yield params
    detach(params)


@pytest.mark.parametrize(
    ("key", "path", "edges", "weights"),
    [
        (COLOUR, False, False, True),
        (LAMP, False, False, False),
        (SKY, False, False, False),
        (PLACE, True, True, None),  # weights_vary is defined only where nothing moves
        ("lamp.position", True, True, None),
        ("camera.to_world", True, True, None),
    ],
)
def test_a_pass_knows_what_moves(key: str, path: bool, edges: bool, weights: bool | None) -> None:
    scene = room()
    attach(scene, key)
    integrator, view = mi.load_dict({"type": "pathreplay", "max_depth": 3}), Pass.of(scene, 0, 1, 1)
    with careful(), dr.suspend_grad():
        trace, start = integrator._trace_config(scene, view.sensor), view.rays().start
        at = PathState.begin(trace, start).at
        assert path_moves(trace, start, at) == path
        assert Boundary.move(view, trace) == edges
        if weights is not None:
            assert weights_vary(trace, at) == weights
        assert only_emission_varies(trace, start) == (key in (LAMP, SKY))


@pytest.mark.parametrize(("key", "flows"), [(PLACE, True), ("lamp.position", False)])
def test_the_film_flows_with_surfaces_of_the_scene_alone(key: str, flows: bool) -> None:
    scene = room()
    attach(scene, key)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    with careful(), dr.suspend_grad():
        part, _, _ = integrator._planned(Pass.of(scene, 0, 1, 4), integrator.begin(scene))
    assert (part.flow is not None) == flows


@pytest.mark.parametrize("key", [COLOUR, pytest.param("lamp.position", marks=pytest.mark.slow)])
def test_gradients_are_the_same(key: str, other: mi.SceneParameters) -> None:
    scene, integrator, found = room(), mi.load_dict({"type": "pathreplay", "max_depth": 3}), []
    for change in (lambda params: None, detach):
        change(other)
        params = attach(scene, key)
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=1, spp=16)
        found.append(np.array(dr.grad(params[key])))
        dr.disable_grad(params[key])
    assert np.abs(found[0]).max() > 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4)


@pytest.mark.parametrize("plugin", ["pathreplay", "pathreplay_particles"])
def test_a_pass_without_gradients_is_an_error(plugin: str) -> None:
    scene, integrator = room(), mi.load_dict({"type": plugin, "max_depth": 3})
    with pytest.raises(PathreplayError, match="and none has gradients"):
        integrator.render_backward(scene, None, dr.ones(mi.TensorXf, (16, 16, 3)), spp=1)


def test_forward_mode_says_what_is_in_the_way() -> None:
    scene = room()
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    params[PLACE] = translate(1, 0, 0)(params[PLACE], t)
    params.update()
    dr.forward(t, dr.ADFlag.ClearEdges)
    with pytest.raises(PathreplayError, match="also those of other scenes") as caught:
        mi.load_dict({"type": "pathreplay", "max_depth": 3}).render_forward(scene, params, spp=1)
    assert "\n" not in str(caught.value)
