"""Shadows that lights cast tell where lines look first; lines among a lamp's samples are reflected at the border."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from edge_ordinary import T, film, sensor
from pathreplay.boundary.cast_shadows import cast_shadows, casters
from pathreplay.boundary.emitters import BORDER, EmitterSegment, SampledEmitter
from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.transport.vertex import TraceConfig

SIDE = 48
KEY = "ball.to_world"


def room(*, ball: bool = True, size: float = 0.1) -> mi.Scene:
    """A floor, a lamp above, and in between a small ball."""
    parts = {
        "type": "scene",
        "camera": sensor(place=T().look_at([0, 2, 3.5], [0, -0.3, 0], [0, 1, 0]), film=film(width=SIDE, height=SIDE)),
        "floor": {"type": "rectangle", "to_world": T().translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(3)},
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([1, 2, 0.5]).rotate([1, 0, 0], 90).scale(0.1),
            "emitter": {"type": "area", "radiance": 200.0},
        },
        "sky": {"type": "constant", "radiance": 0.01},
    }
    if ball:
        parts["ball"] = {"type": "sphere", "to_world": T().translate([0.2, 0.2, 0]).scale(size)}
    return mi.load_dict(parts)


def informed(scene: mi.Scene) -> tuple[Pass, TraceConfig]:
    """A pass, and a walk that knows what moves."""
    view = Pass.of(scene, 0, 0, 1)
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    return view, Boundary.informed(view, ours._trace_config(scene, view.sensor))


def test_a_shadow_falls_where_the_picture_is_darker() -> None:
    scene, bare = room(), room(ball=False)
    direct = mi.load_dict({"type": "path", "max_depth": 2})
    with_ball, without = (np.array(mi.render(s, integrator=direct, spp=64))[..., 0] for s in (scene, bare))
    params = mi.traverse(scene)
    moved = mi.Transform4f(params[KEY])
    dr.enable_grad(moved)
    params[KEY] = moved
    params.update()
    with dr.suspend_grad():
        view, trace = informed(scene)
        s, found = cast_shadows(trace, casters(trace), FilmPlaces.of(view), mi.UInt32(3))
    found = np.array(found)
    x, y = np.array(mi.Point2u(s))[:, found]
    assert found.sum() > 300
    # Lamp and sky send as many rays; in the picture only the shadow of the lamp, which is far brighter, is seen.
    dark = with_ball[y, x] < 0.5 * without[y, x]
    assert 0.4 < dark.mean() < 0.75
    fair = (with_ball < 0.5 * without).mean()
    assert dark.mean() > 20 * fair


def test_nothing_is_cast_where_nothing_is_known_to_move() -> None:
    """A camera that moves beside a mesh: lines are thrown evenly at first."""
    scene = room()
    params = mi.traverse(scene)
    place = mi.Transform4f(params["camera.to_world"])
    dr.enable_grad(place)
    params["camera.to_world"] = place
    params.update()
    with dr.suspend_grad():
        assert not casters(informed(scene)[1])
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 3, "boundary": "all"})
    dr.backward(dr.sum(mi.render(scene, params, integrator=ours, spp=4), axis=None))
    assert np.isfinite(np.array(dr.grad(place).matrix)).all()


def test_lines_are_reflected_at_the_border_of_the_square() -> None:
    rng = np.random.default_rng(2)
    n, l = 2000, 0.25
    turn = mi.Float(rng.uniform(0, 2 * np.pi, n))
    c, w = mi.Point2f(rng.uniform(0, 1, (2, n))), mi.Vector2f(dr.cos(turn), dr.sin(turn))
    none = SampledEmitter(dr.zeros(mi.EmitterPtr, n), mi.Point3f(0), mi.Float(0), mi.Bool(False))
    nobody: Any = None
    segment = EmitterSegment(c, w, mi.Float(l), nobody, mi.UInt32(0), none, mi.Float(1))
    t, step = mi.Float(rng.uniform(-0.5 * l, 0.5 * l, n)), 1e-3
    at, ahead = np.array(segment.at(t)), np.array(segment.at(t + step))
    assert (at >= BORDER).all() and (at <= 1 - BORDER).all()
    folded = np.array(segment.direction(t)) != np.array(segment.direction(t + step))
    assert np.abs((ahead - at) / step - np.array(segment.direction(t)))[~folded].max() < 1e-3
    assert 0 < folded.mean() < 0.01
    # Places of lines whose middle is anywhere fill the square evenly.
    counts = np.histogram2d(*at, bins=4, range=[[0, 1], [0, 1]])[0]
    assert np.abs(counts - n / 16).max() < 5 * (n / 16) ** 0.5


@pytest.mark.slow
def test_the_shadow_of_a_small_thing_is_found() -> None:
    """Its derivative is not noisier than a difference of pictures with common random numbers, nor is one pass all."""
    scene = room(size=0.05)
    params = mi.traverse(scene)
    place = mi.ScalarTransform4f(params[KEY].matrix.numpy()[..., 0])
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    direct = mi.load_dict({"type": "path", "max_depth": 2})
    weights = mi.TensorXf(np.linspace(-1, 1, SIDE)[None, :, None] * np.ones((SIDE, 1, 3)))

    def put(x: mi.Float) -> None:
        params[KEY] = mi.Transform4f().translate([x, 0, 0]) @ mi.Transform4f(place)
        params.update()

    def picture(x: float, seed: int) -> float:
        put(dr.opaque(mi.Float, x))
        return float(dr.sum(weights * mi.render(scene, integrator=direct, spp=8, seed=seed), axis=None).array[0])

    def derivative(seed: int) -> float:
        x = mi.Float(0)
        dr.enable_grad(x)
        put(x)
        dr.backward(dr.sum(weights * mi.render(scene, params, integrator=ours, spp=8, seed=seed), axis=None))
        return float(dr.grad(x)[0])

    rows = np.array([(derivative(seed), (picture(0.02, seed) - picture(-0.02, seed)) / 0.04) for seed in range(24)])
    ours_var, other_var = rows.var(axis=0, ddof=1)
    assert ours_var < other_var
    squares = (rows[:, 0] - rows[:, 0].mean()) ** 2
    assert squares.max() < 0.5 * squares.sum()
