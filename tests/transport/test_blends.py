"""Blends of BSDFs that transmit light unscattered. The sky is white, so radiances and derivatives are known."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from truth import camera
from variant import VARIANT

PAINT = {"type": "diffuse", "reflectance": 0.5}
MASK = {"type": "mask", "opacity": 0.6, "nested": PAINT}
CHILDREN: dict[str, tuple[dict[str, Any], str, float]] = {
    "null": ({"type": "null"}, "weight", 0.5),
    "mask": (MASK, "weight", 0.2),
    "opacity": (MASK, "bsdf_1.opacity", -0.2),
    "masks": ({"type": "blendbsdf", "weight": 0.3, "one": MASK, "two": {"type": "null"}}, "bsdf_1.weight", 0.12),
}
"""The second BSDF of the blend, the parameter, and the derivative of the radiance."""


@pytest.mark.parametrize("adjoint", ["recorded", "replay"])
@pytest.mark.parametrize("name", CHILDREN)
def test_the_share_of_transmitted_light_is_differentiated(name: str, adjoint: str) -> None:
    mi.set_variant(VARIANT)
    child, key, slope = CHILDREN[name]
    sheet = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(100),
        "bsdf": {"type": "blendbsdf", "weight": 0.4, "one": PAINT, "two": child},
    }
    scene = mi.load_dict({"type": "scene", "camera": camera(), "sheet": sheet, "sky": {"type": "constant"}})
    params, key = mi.traverse(scene), f"sheet.bsdf.{key}.value"
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4, "adjoint": adjoint})
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, integrator=integrator, spp=64)
    dr.backward(dr.mean(image, axis=None))
    assert float(np.array(dr.grad(params[key])).sum()) == pytest.approx(slope, abs=0.01)
