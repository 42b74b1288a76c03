"""The lights driver: its gradient is the sweep's, path by path, and it is used where it is right."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from driven import BALL, FLOOR, LAMP, SEED, SIZE, SPP, attached, close, driven, ours, world
from pathreplay.adjoint import emission_only as module
from pathreplay.adjoint.emission_only import emission_only, only_emission_varies
from pathreplay.adjoint.sweep import sweep
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.lifetimes import careful
from truth import camera, rgb

SKY = "sky.radiance.value"
PAINT = {"type": "diffuse", "reflectance": rgb(0.5, 0.4, 0.3)}
METAL = {"type": "roughconductor", "alpha": 0.2}
GLASS = {"type": "dielectric"}
BULB = {"type": "point", "position": [0.5, 2, 2.5], "intensity": rgb(9, 9, 8)}


def texture() -> dict[str, Any]:
    """New each time: who loads it takes its texels away."""
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.random.default_rng(2).random((4, 4, 3), np.float32))}


def painted_lamp() -> dict[str, Any]:
    at = mi.ScalarTransform4f().translate([0.5, 3, 1]).rotate([1, 0, 0], 90)
    return {"type": "rectangle", "to_world": at, "emitter": {"type": "area", "radiance": texture()}}


def even() -> mi.TensorXf:
    """The adjoint of the mean of a picture."""
    return dr.full(mi.TensorXf, 1 / (3 * SIZE**2), (SIZE, SIZE, 3))


def alone(scene: mi.Scene, *keys: str, **options: Any) -> bool:
    """What the driver says of a scene where these parameters have gradients."""
    with attached(scene, *keys), careful(), dr.suspend_grad():
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4, **options})
        trace = integrator._trace_config(scene, scene.sensors()[0])
        return only_emission_varies(trace, Pass.of(scene, 0, SEED, SPP).rays().start)


@pytest.mark.parametrize(
    ("bsdf", "key"),
    [
        ({"type": "plastic"}, LAMP),
        (GLASS, "lamp.emitter.radiance.data"),
        (METAL, "bulb.intensity.value"),
        (METAL, SKY),
    ],
)
def test_it_has_the_gradient_of_the_sweep(bsdf: dict[str, Any], key: str) -> None:
    scene = world(bsdf, None if key in (LAMP, SKY) else {"lamp": painted_lamp(), "bulb": BULB})
    found, moves = driven(emission_only, scene, key)
    assert moves is False
    close(found, driven(sweep, scene, key)[0])


def test_the_camera_sees_no_hidden_sky() -> None:
    scene = world(GLASS, {"sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)}})
    hidden = {"type": "pathreplay", "max_depth": 1, "hide_emitters": True}
    with attached(scene, SKY) as params:
        mi.load_dict(hidden).render_backward(scene, params, even(), seed=SEED, spp=SPP)
        assert dr.all(dr.grad(params[SKY]) == 0)


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_a_sky_around_nothing_has_its_gradient(hide_emitters: bool) -> None:
    """That of the mean of a picture of it: a third of it by each channel."""
    sky = {"type": "constant", "radiance": rgb(1, 1, 1)}
    view = camera() | {"film": camera()["film"] | {"width": SIZE, "height": SIZE}}
    scene = mi.load_dict({"type": "scene", "camera": view, "sky": sky})
    with attached(scene, SKY) as params:
        integrator = mi.load_dict({"type": "pathreplay", "hide_emitters": hide_emitters})
        integrator.render_backward(scene, params, even(), seed=SEED, spp=SPP)
        assert np.array(dr.grad(params[SKY])) == pytest.approx(0 if hide_emitters else 1 / 3, rel=1e-4)


@pytest.mark.parametrize("adjoint", ["recorded", "replay"])
@pytest.mark.parametrize("kind", ["lamp", "envmap"])
def test_black_texels_have_the_gradient_of_dark_ones(kind: str, adjoint: str) -> None:
    """Mitsuba's density of a map that is black everywhere is not a number. Light is linear in it."""

    def slope(brightness: float) -> float:
        texels = np.full((4, 4, 3), brightness, np.float32)
        if kind == "envmap":
            scene, key = world(lights={"sky": {"type": "envmap", "bitmap": mi.Bitmap(texels)}}), "sky.data"
        else:
            lamp = painted_lamp()
            lamp["emitter"]["radiance"]["data"] = mi.TensorXf(texels)
            scene, key = world(lights={"lamp": lamp}), "lamp.emitter.radiance.data"
        with attached(scene, key) as params:
            integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3, "adjoint": adjoint})
            integrator.render_backward(scene, params, even(), seed=SEED, spp=1024)
            return float(np.array(dr.grad(params[key])).sum())

    assert slope(0) == pytest.approx(slope(1e-3), rel=0.03)


def test_it_knows_when_it_will_do() -> None:
    assert alone(world(), LAMP) and alone(world(), LAMP, SKY)
    assert not alone(world(), LAMP, FLOOR) and not alone(world(), BALL) and not alone(world())
    assert not alone(world(), LAMP, "lamp.to_world") and alone(world(), LAMP, "lamp.to_world", attach="none")
    tinted = {"type": "thindielectric", "specular_transmittance": rgb(0.9, 0.8, 0.7)}
    assert not alone(world(tinted), LAMP, "ball.bsdf.specular_transmittance.value")
    fog = {"type": "homogeneous", "sigma_t": 0.9}
    assert not alone(world(fog={"type": "cube", "bsdf": {"type": "null"}, "interior": fog}), LAMP)


def test_it_sees_a_texture_that_a_lamp_shares_with_paint() -> None:
    shared = mi.load_dict(texture())
    lamp = painted_lamp() | {"emitter": {"type": "area", "radiance": shared}}
    scene = world({"type": "diffuse", "reflectance": shared}, {"lamp": lamp})
    (key,) = (key for key in mi.traverse(scene).keys() if key.endswith("data"))
    assert not alone(scene, key)


def test_it_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    used = []
    monkeypatch.setattr(module, "emission_only", lambda *args: used.append(args) or emission_only(*args))
    scene, named = world(), mi.load_dict({"type": "pathreplay", "max_depth": 2, "adjoint": "recorded"})
    for integrator, *keys in ((ours(2), LAMP), (ours(2), LAMP, FLOOR), (named, LAMP)):
        with attached(scene, *keys) as params:
            integrator.render_backward(scene, params, even(), seed=SEED, spp=SPP)
    assert len(used) == 1


def test_it_has_no_limit_of_depth() -> None:
    """Beyond what the sweep can hold, and with no limit at all: roulette ends the paths."""
    scene = world(GLASS)
    with attached(scene, LAMP) as params:
        found = []
        for depth in (2000, 5000, -1):
            dr.clear_grad(params[LAMP])
            ours(depth).render_backward(scene, params, even(), seed=SEED, spp=SPP)
            found.append(np.array(dr.grad(params[LAMP])))
    close(found[1], found[0])
    close(found[2], found[0])
