"""The lights driver: its gradient is the sweep's, path by path or in expectation, and it is used where it is right."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.check.statistics import gap
from pathreplay.check.verdict import Z_LIMIT
from pathreplay.gradient import lights as module
from pathreplay.gradient.lights import lights, lights_alone
from pathreplay.gradient.sweep import sweep
from pathreplay.render.camera_pass import Pass
from pathreplay.render.path_integrator import careful
from test_architecture import BALL, FLOOR, LAMP, SEED, SIZE, SPP, attached, close, driven, ours, rgb, world

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


def bright(width: int = 8) -> np.ndarray:
    """A dim sky with a patch a hundred times as bright, which emitter samples are drawn to."""
    sky = np.random.default_rng(1).uniform(0.2, 1, (width // 2, width, 3)).astype(np.float32)
    sky[1, 2] *= 100
    return sky


def under_sky(bsdf: dict[str, Any] | None = None) -> mi.Scene:
    return world(fresh(bsdf), {"sky": {"type": "envmap", "bitmap": mi.Bitmap(bright())}})


def even() -> mi.TensorXf:
    """The adjoint of the mean of a picture."""
    return dr.full(mi.TensorXf, 1 / (3 * SIZE**2), (SIZE, SIZE, 3))


def alone(scene: mi.Scene, *keys: str, **options: Any) -> bool:
    """What the driver says of a scene where these parameters have gradients."""
    with attached(scene, *keys), careful(), dr.suspend_grad():
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4, **options})
        walk = integrator._walk(scene, scene.sensors()[0])
        return lights_alone(walk, Pass.of(scene, 0, SEED, SPP).rays().start)


@pytest.mark.parametrize(
    ("bsdf", "key"),
    [({"type": "plastic"}, LAMP), (GLASS, "lamp.emitter.radiance.data"), (METAL, "bulb.intensity.value")],
)
def test_it_has_the_gradient_of_the_sweep(bsdf: dict[str, Any], key: str) -> None:
    scene = world(bsdf, None if key == LAMP else {"lamp": painted_lamp(), "bulb": BULB})
    found, moves = driven(lights, scene, key)
    assert moves is False
    close(found, driven(sweep, scene, key)[0])


def test_the_camera_sees_no_hidden_sky() -> None:
    scene = world(GLASS, {"sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)}})
    hidden = {"type": "pathreplay", "max_depth": 1, "hide_emitters": True}
    with attached(scene, SKY) as params:
        mi.load_dict(hidden).render_backward(scene, params, even(), seed=SEED, spp=SPP)
        assert dr.all(dr.grad(params[SKY]) == 0)


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
    monkeypatch.setattr(module, "lights", lambda *args: used.append(args) or lights(*args))
    scene, named = world(), mi.load_dict({"type": "pathreplay", "max_depth": 2, "driver": "sweep"})
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


# ------------------------------ By the sky alone ------------------------------

BSDFS: dict[str, dict[str, Any]] = {
    "diffuse": PAINT,
    "dielectric": GLASS,
    "thindielectric": {"type": "thindielectric"},
    "conductor": {"type": "conductor"},
    "roughconductor": METAL,
    "plastic": {"type": "plastic"},
    "roughplastic": {"type": "roughplastic", "alpha": 0.2},
    "principled": {"type": "principled", "metallic": 0.5, "roughness": 0.3, "clearcoat": 0.5, "sheen": 0.5},
    "principled glass": {"type": "principled", "spec_trans": 0.8, "roughness": 0.4, "eta": 1.4},
    "twosided": {"type": "twosided", "bsdf": METAL},
    "mask": {"type": "mask", "opacity": 0.4, "bsdf": PAINT},
    "blendbsdf": {"type": "blendbsdf", "weight": 0.3, "a": PAINT, "b": METAL},
    "normalmap": {"type": "normalmap", "normalmap": {"type": "rgb", "value": [0.55, 0.5, 0.95]}, "bsdf": METAL},
    "bumpmap": {"type": "bumpmap", "scale": 0.1, "bsdf": PAINT},
}


def fresh(bsdf: dict[str, Any] | None) -> dict[str, Any] | None:
    """With texels of its own, where it has any."""
    return {**bsdf, "texture": texture()} if bsdf is not None and bsdf["type"] == "bumpmap" else bsdf


def sky_gradient(scene: mi.Scene, seed: int) -> np.ndarray:
    """By the pixels of the sky, of the mean of the picture; the columns at its ends repeat others, and have none."""
    params = mi.traverse(scene)
    leaf = mi.TensorXf(params["sky.data"])
    dr.enable_grad(leaf)
    params["sky.data"] = leaf
    params.update()
    ours().render_backward(scene, params, even(), seed=seed, spp=SPP)
    dr.enqueue(dr.ADMode.Backward, params["sky.data"])
    dr.traverse(dr.ADMode.Backward)
    gradient = np.array(dr.grad(leaf))
    params["sky.data"] = mi.TensorXf(dr.detach(leaf))
    params.update()
    return gradient


def seen(bsdf: dict[str, Any], sky: np.ndarray, seeds: int) -> list[float]:
    """Means of pictures by Mitsuba's `path`."""
    scene = world(fresh(bsdf), {"sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)}})
    path = mi.load_dict({"type": "path", "max_depth": 4})
    return [float(np.mean(mi.render(scene, integrator=path, spp=8 * SPP, seed=900 + k))) for k in range(seeds)]


def held_to_pictures(bsdf: dict[str, Any], seeds: int) -> list[float]:
    """z of the derivative by the sky as it is, and by a white one: the picture is linear, so those are its pictures."""
    scene, sky = under_sky(bsdf), bright()
    gradients = [sky_gradient(scene, k) for k in range(seeds)]
    assert all(np.isfinite(g).all() and (g >= 0).all() for g in gradients)
    along = [
        np.array([np.vdot(g, v) for g in gradients])
        for v in (np.array(mi.traverse(scene)["sky.data"]), 1 + 0 * gradients[0])
    ]
    return [float(gap(found, seen(bsdf, v, seeds)).z) for found, v in zip(along, (sky, np.ones_like(sky)), strict=True)]


@pytest.mark.parametrize("name", [n if n == "diffuse" else pytest.param(n, marks=pytest.mark.slow) for n in BSDFS])
def test_by_the_sky_it_is_right(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against pictures by `path`; glossy and rough BSDFs sample exactly what they scatter."""
    used = []
    monkeypatch.setattr(module, "_sky", lambda *args, of=module._sky: used.append(args) or of(*args))
    z = held_to_pictures(BSDFS[name], 8 if name == "diffuse" else 32)
    print(name, z)
    assert len(used) and np.abs(z).max() < Z_LIMIT


def test_rough_glass_keeps_emitter_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its samples leave out a part of what it scatters."""
    monkeypatch.setattr(module, "_sky", None)
    assert (sky_gradient(under_sky({"type": "roughdielectric", "alpha": 0.3}), 0) != 0).any()


@pytest.mark.slow
def test_a_sky_whose_scale_has_gradients_keeps_emitter_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_sky", None)
    scene = under_sky()
    with attached(scene, "sky.scale") as params:
        ours().render_backward(scene, params, even(), seed=SEED, spp=SPP)
        assert (np.array(dr.grad(params["sky.scale"])) != 0).all()
