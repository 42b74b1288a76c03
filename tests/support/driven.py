"""A ball on a floor, and drivers called by themselves: images, gradients and tangents."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.adjoint.autodiff import NonFiniteCounter
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.lifetimes import careful
from pathreplay.scenes.parameters import get_array
from truth import rgb

SIZE, SPP, SEED = 8, 16, 3


#: Two sums of the same numbers in 32 bits, added up in another order.
ROUNDING = 1e-5


def world(bsdf: dict[str, Any] | None = None, lights: dict[str, Any] | None = None, **more: Any) -> mi.Scene:
    """A sphere on a floor, under a lamp and the sky if there are no other lights."""
    camera = mi.ScalarTransform4f().look_at([0, 1, 6], [0, 0, 0], [0, 1, 0])
    down = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4)
    lamp = mi.ScalarTransform4f().translate([0.5, 3, 1]).rotate([1, 0, 0], 90)
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    paint = {"type": "diffuse", "reflectance": rgb(0.5, 0.4, 0.3)}
    usual = {
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": rgb(6, 5, 4)}},
        "sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)},
    }
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
            "floor": {"type": "rectangle", "to_world": down, "bsdf": paint},
            "ball": {"type": "sphere", "radius": 0.8, "bsdf": bsdf or dict(paint)},
            **(lights or usual),
            **more,
        },
        optimize=False,
    )


FLOOR, BALL, LAMP = "floor.bsdf.reflectance.value", "ball.bsdf.reflectance.value", "lamp.emitter.radiance.value"


@contextmanager
def attached(scene: mi.Scene, *keys: str) -> Iterator[mi.SceneParameters]:
    """The scene's parameters, of which these have gradients, for as long as the block.

    They are released in the end: Dr.Jit traces calls through every scene that is alive.
    """
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    try:
        yield params
    finally:
        release(params, keys)


@contextmanager
def moving(scene: mi.Scene, *keys: str) -> Iterator[mi.SceneParameters]:
    """The scene's parameters, of which these carry a tangent for as long as the block: they grow by their own size."""
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    for key in keys:
        params[key] = params[key] * (1 + t)
    params.update()
    try:
        dr.forward(t, dr.ADFlag.ClearEdges)
        yield params
    finally:
        release(params, keys)


def release(params: mi.SceneParameters, keys: tuple[str, ...]) -> None:
    for key in keys:
        params[key] = type(params[key])(dr.detach(params[key]))
    params.update()


def weights(scene: mi.Scene) -> mi.TensorXf:
    """The adjoint of an image; no two pixels can cancel by symmetry."""
    width, height = scene.sensors()[0].film().crop_size()
    return mi.TensorXf(np.random.default_rng(1).random((height, width, 3), np.float32))


def gradients(params: mi.SceneParameters, keys: tuple[str, ...]) -> np.ndarray:
    """Those by some keys, one behind the other."""
    return np.concatenate([np.ravel(get_array(dr.grad(params[key]))) for key in keys])


def backward(scene: mi.Scene, integrator: mi.Integrator, *keys: str) -> np.ndarray:
    """The gradients by some keys."""
    with attached(scene, *keys) as params:
        integrator.render_backward(scene, params, weights(scene), seed=SEED, spp=SPP)
        return gradients(params, keys)


def ours(max_depth: int = 4) -> mi.Integrator:
    return mi.load_dict({"type": "pathreplay", "max_depth": max_depth, "sampling": "scene"})


def close(found: Any, expected: Any) -> None:
    """Relative L1 distance below what rounding does, of something that is not zero."""
    found, expected = np.array(found, np.float64), np.array(expected, np.float64)
    assert found.shape == expected.shape and np.isfinite(expected).all() and np.abs(expected).sum() > 1e-3
    assert np.abs(found - expected).sum() < ROUNDING * np.abs(expected).sum()


def conforms(given: Callable[..., Any], promised: Any) -> bool:
    """Whether a function takes what a protocol promises, by these names and in this order, and more only by default."""
    wanted = inspect.signature(promised.__call__ if isinstance(promised, type) else promised)
    has = inspect.signature(given)
    names = [parameter for parameter in wanted.parameters.values() if parameter.name != "self"]
    first, more = list(has.parameters.values())[: len(names)], list(has.parameters.values())[len(names) :]
    alike = [(p.name, p.kind) for p in first] == [(p.name, p.kind) for p in names]
    return alike and all(p.default is not p.empty for p in more)


def driven(driver: Callable[..., Any], scene: mi.Scene, *keys: str, max_depth: int = 4) -> tuple[np.ndarray, bool]:
    """The gradients by a driver, which is called as the interior does, and whether it says that paths move."""
    with attached(scene, *keys) as params, careful():
        with dr.suspend_grad(), dr.isolate_grad():
            rays = Pass.of(scene, 0, SEED, SPP).rays()
            δL = mi.Spectrum(ray_weights(dr.width(rays.ray)))
            moves = driver(ours(max_depth)._trace_config(scene, scene.sensors()[0]), rays.start, δL, NonFiniteCounter())
            dr.eval()
        return gradients(params, keys), moves


def ray_weights(rays: int) -> np.ndarray:
    """The adjoint of the radiance along so many rays."""
    return np.random.default_rng(2).random((3, rays), np.float32)


def driven_forward(
    driver: Callable[..., Any], scene: mi.Scene, *keys: str, max_depth: int = 4
) -> tuple[np.ndarray, np.ndarray, bool]:
    """The tangents of all rays by a driver, which rays met anything, and whether it says that paths move."""
    with moving(scene, *keys), careful(), dr.suspend_grad():
        rays = Pass.of(scene, 0, SEED, SPP).rays()
        trace = ours(max_depth)._trace_config(scene, scene.sensors()[0])
        δL, valid, moves = driver(trace, rays.start, NonFiniteCounter())
        dr.eval(δL, valid)
        return np.array(δL), np.array(valid), moves


INSIDE = "fog.interior_medium."


KEYS = (INSIDE + "sigma_t.value.value", INSIDE + "albedo.value.value", FLOOR, LAMP)


def foggy(**more: Any) -> mi.Scene:
    medium = {"type": "homogeneous", "sigma_t": 0.9, "albedo": 0.7, "phase": {"type": "hg", "g": 0.4}}
    return world(fog={"type": "cube", "bsdf": {"type": "null"}, "interior": medium}, **more)
