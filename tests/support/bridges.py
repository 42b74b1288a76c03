"""What the bridges are held to: one small scene, and the gradients of its pictures by Mitsuba alone."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.scenes.loading import load_scene
from pathreplay.scenes.parameters import get_array

TEXTURE, WALL = "back.bsdf.reflectance.data", "red.reflectance.value"
SMALL = {"resolution": 6, "texture": 3}
PLAIN = {"type": "pathreplay", "max_depth": 3}


def mitsubas(values: Mapping[str, np.ndarray], sensor: int, weights: np.ndarray) -> dict[str, np.ndarray]:
    """The gradient of sum(weights * picture) by Mitsuba alone, with many samples."""
    scene = load_scene("cornell-box-photo", **SMALL)
    params = mi.traverse(scene)
    params[TEXTURE], params[WALL] = mi.TensorXf(values[TEXTURE]), mi.Color3f(*map(float, values[WALL]))
    for key in (TEXTURE, WALL):
        dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, sensor=sensor, integrator=mi.load_dict(PLAIN), spp=2048, seed=3)
    dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
    return {key: get_array(dr.grad(params[key])) for key in (TEXTURE, WALL)}


def hold(found: np.ndarray, gradient: np.ndarray) -> None:
    """A gradient to Mitsuba's of the same parameter."""
    assert found.shape == gradient.shape
    np.testing.assert_allclose(found.mean(), gradient.mean(), rtol=0.05)
    assert np.abs(found - gradient).mean() < 0.15 * np.abs(gradient).mean()
