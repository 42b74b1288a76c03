"""Materials, textures and lights: gradients of every BSDF and emitter parameter against finite differences."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from truth import Case, add, bitmap, environment, hold, lit_room, noise, random, rgb


def cell(name: str, bsdf: dict, key: str, move=None, **options) -> Case:
    shape = options.pop("shape", "sphere")
    return Case(name, lambda: room(bsdf_copy(bsdf), shape), f"object.bsdf.{key}", move or add(), **options)


def room(bsdf: dict, shape: str) -> dict:
    """The lit room; ``back`` is a rectangle that is seen from behind."""
    if shape != "back":
        return lit_room(bsdf, shape)
    scene = lit_room(bsdf, "rectangle")
    scene["object"]["to_world"] = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    return scene


def bsdf_copy(bsdf):
    """Mitsuba takes tensors out of the dictionary that it loads; so every load gets its own."""
    return {k: bsdf_copy(v) if isinstance(v, dict) else (v() if callable(v) else v) for k, v in bsdf.items()}


def texels(low, high, channels=3, n=4):
    return {"type": "bitmap", "raw": True, "data": lambda: bitmap(noise(n, channels, low, high))["data"]}


def ramp(value, t):
    """A bump map that gets a slope: all normals tilt the same way."""
    slope = np.linspace(-1, 1, value.shape[1], dtype=np.float32)[None, :, None] * np.ones(value.shape, np.float32)
    return value + t * mi.TensorXf(slope)


DIFFUSE = {"type": "diffuse", "reflectance": rgb(0.5, 0.4, 0.3)}
ROUGH = {"type": "roughconductor", "material": "Al", "alpha": 0.3}
NORMALS = {"type": "bitmap", "raw": True, "data": lambda: bitmap(np.concatenate(
    [noise(4, 2, 0.4, 0.6), np.full((4, 4, 1), 0.95)], -1))["data"]}  # fmt: skip

CASES = [
    cell("diffuse reflectance", DIFFUSE, "reflectance.value"),
    cell("diffuse texture", {"type": "diffuse", "reflectance": texels(0.2, 0.8)}, "reflectance.data", random(0.3)),
    cell("diffuse reflectance zero", {"type": "diffuse", "reflectance": rgb(0, 0, 0)}, "reflectance.value",
         drivers=("recorded",)),
    cell("diffuse one channel zero", {"type": "diffuse", "reflectance": rgb(0.5, 0, 0.3)}, "reflectance.value",
         add([0.0, 1.0, 0.0]), drivers=("recorded",)),
    cell("conductor specular reflectance", {"type": "conductor", "specular_reflectance": rgb(0.5, 0.6, 0.7)},
         "specular_reflectance.value"),
    cell("conductor eta", {"type": "conductor", "eta": 1.5, "k": 2.0}, "eta.value"),
    cell("conductor k", {"type": "conductor", "eta": 1.5, "k": 2.0}, "k.value"),
    cell("conductor tint zero", {"type": "conductor", "specular_reflectance": rgb(0, 0, 0)},
         "specular_reflectance.value", drivers=("recorded",)),
    cell("roughconductor specular reflectance", {**ROUGH, "specular_reflectance": rgb(0.5, 0.6, 0.7)},
         "specular_reflectance.value"),
    cell("roughconductor alpha", ROUGH, "alpha.value", lanes=None, spp=1024),
    cell("roughconductor k", {"type": "roughconductor", "eta": 1.5, "k": 2.0, "alpha": 0.3}, "k.value"),
    cell("plastic diffuse reflectance", {"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.4, 0.5)},
         "diffuse_reflectance.value", lanes=None, step=3e-3),
    cell("plastic specular reflectance", {"type": "plastic", "specular_reflectance": rgb(0.7, 0.8, 0.9)},
         "specular_reflectance.value", lanes=None, spp=256),
    cell("roughplastic diffuse reflectance", {"type": "roughplastic", "diffuse_reflectance": rgb(0.3, 0.4, 0.5)},
         "diffuse_reflectance.value", lanes=None, step=3e-3),
    cell("roughplastic specular reflectance", {"type": "roughplastic", "specular_reflectance": rgb(0.7, 0.8, 0.9)},
         "specular_reflectance.value", lanes=None, spp=256),
    cell("principled base colour", {"type": "principled", "base_color": rgb(0.3, 0.4, 0.5), "roughness": 0.5},
         "base_color.value", lanes=None),
    cell("principled roughness", {"type": "principled", "base_color": rgb(0.3, 0.4, 0.5), "roughness": 0.5,
         "metallic": 0.4}, "roughness.value", lanes=None, spp=512),
    cell("principled metallic", {"type": "principled", "base_color": rgb(0.3, 0.4, 0.5), "roughness": 0.5,
         "metallic": 0.4}, "metallic.value", lanes=None, spp=256),
    cell("roughdielectric reflectance", {"type": "roughdielectric", "alpha": 0.3, "specular_reflectance":
         rgb(0.5, 0.6, 0.7)}, "specular_reflectance.value", depth=6),
    cell("roughdielectric transmittance", {"type": "roughdielectric", "alpha": 0.3, "specular_transmittance":
         rgb(0.5, 0.6, 0.7)}, "specular_transmittance.value", depth=6),
    cell("thindielectric reflectance", {"type": "thindielectric", "specular_reflectance": rgb(0.5, 0.6, 0.7)},
         "specular_reflectance.value", spp=256),
    cell("thindielectric transmittance", {"type": "thindielectric", "specular_transmittance": rgb(0.5, 0.6, 0.7)},
         "specular_transmittance.value"),
    cell("dielectric reflectance", {"type": "dielectric", "specular_reflectance": rgb(0.5, 0.6, 0.7)},
         "specular_reflectance.value", depth=6, spp=256),
    cell("dielectric transmittance", {"type": "dielectric", "specular_transmittance": rgb(0.5, 0.6, 0.7)},
         "specular_transmittance.value", depth=6),
    cell("thindielectric transmittance zero", {"type": "thindielectric", "specular_transmittance": rgb(0.5, 0.6, 0)},
         "specular_transmittance.value", add([0.0, 0.0, 1.0]), shape="rectangle", drivers=("recorded",)),
    cell("twosided diffuse", {"type": "twosided", "nested": DIFFUSE}, "brdf_0.reflectance.value", shape="rectangle"),
    cell("twosided diffuse and plastic, from the back", {"type": "twosided", "a": DIFFUSE, "b": {"type": "plastic",
         "diffuse_reflectance": rgb(0.3, 0.4, 0.5)}}, "brdf_1.diffuse_reflectance.value", shape="back", lanes=None,
         step=3e-3),
    cell("opaque mask over a mirror, its tint", {"type": "mask", "opacity": 1.0, "nested": {"type": "conductor",
         "specular_reflectance": rgb(1, 1, 1)}}, "nested_bsdf.specular_reflectance.value"),
    cell("mask over diffuse, its reflectance", {"type": "mask", "opacity": 0.6, "nested": DIFFUSE},
         "nested_bsdf.reflectance.value"),
    cell("mask opacity", {"type": "mask", "opacity": 0.6, "nested": DIFFUSE}, "opacity.value", lanes=None, spp=256),
    cell("blend weight", {"type": "blendbsdf", "weight": 0.4, "a": DIFFUSE, "b": ROUGH}, "weight.value", lanes=None,
         spp=256),
    cell("blend child reflectance", {"type": "blendbsdf", "weight": 0.4, "a": DIFFUSE, "b": ROUGH},
         "bsdf_0.reflectance.value"),
    cell("normal map over diffuse", {"type": "normalmap", "normalmap": NORMALS, "nested": DIFFUSE}, "normalmap.data",
         random(1.0, planes=1), lanes=None, spp=256),
    cell("normal map over diffuse, reflectance", {"type": "normalmap", "normalmap": NORMALS, "nested": DIFFUSE},
         "nested_bsdf.reflectance.value"),
    cell("normal map over roughconductor", {"type": "normalmap", "normalmap": NORMALS, "nested": ROUGH},
         "normalmap.data", random(1.0, planes=2), lanes=None, spp=512),
    cell("bump map over diffuse", {"type": "bumpmap", "texture": texels(0.4, 0.6, 1), "nested": DIFFUSE, "scale": 0.2},
         "nested_texture.data", ramp, lanes=None, spp=1024),
]  # fmt: skip


def look_down():
    return mi.ScalarTransform4f().look_at(origin=[0.5, 3, 1], target=[0, 0, 0], up=[0, 0, 1])


PANEL = {"type": "area", "radiance": rgb(3, 2, 1)}


def lamp(name: str, light: dict, key: str, move=None, **options) -> Case:
    return Case(name, lambda: lit_room(DIFFUSE, light=bsdf_copy(light)), key, move or add(), **options)


def panel(emitter: dict) -> dict:
    return {"type": "sphere", "center": [0.5, 3, 1], "radius": 0.8, "emitter": emitter}


LIGHTS = [
    lamp("area radiance", panel(PANEL), "light.emitter.radiance.value"),
    lamp("area radiance zero", panel({"type": "area", "radiance": rgb(0, 0, 0)}), "light.emitter.radiance.value",
         drivers=("recorded",)),
    lamp("area radiance texture", panel({"type": "area", "radiance": texels(1, 4)}), "light.emitter.radiance.data",
         random(1.0), lanes=None),
    lamp("point intensity", {"type": "point", "position": [0.5, 3, 1], "intensity": rgb(9, 6, 3)},
         "light.intensity.value"),
    lamp("point intensity zero", {"type": "point", "position": [0.5, 3, 1], "intensity": rgb(0, 0, 0)},
         "light.intensity.value", drivers=("recorded",)),
    lamp("constant radiance", panel(PANEL), "sky.radiance.value"),
    lamp("directional irradiance", {"type": "directional", "direction": [0.2, -1, -0.5], "irradiance": rgb(3, 2, 1)},
         "light.irradiance.value"),
    lamp("spot intensity", {"type": "spot", "intensity": rgb(9, 6, 3), "cutoff_angle": 60.0, "to_world": look_down},
         "light.intensity.value"),
]  # fmt: skip


def _environment_scene() -> dict:
    scene = lit_room(DIFFUSE)
    scene["sky"] = environment(16)
    return scene


LIGHTS.append(Case("environment map texels", _environment_scene, "sky.data", random(0.3), lanes=None))

QUICK = {
    "diffuse texture", "diffuse reflectance zero", "conductor tint zero", "roughconductor alpha",
    "plastic diffuse reflectance", "principled metallic", "roughdielectric transmittance",
    "thindielectric transmittance", "dielectric transmittance", "mask opacity", "blend weight",
    "normal map over diffuse", "area radiance zero", "point intensity", "environment map texels",
}  # fmt: skip


@pytest.mark.parametrize(
    "case", [pytest.param(c, id=c.name, marks=() if c.name in QUICK else pytest.mark.slow) for c in CASES + LIGHTS]
)
def test_gradient_against_finite_differences(case: Case) -> None:
    hold(replace(case, seeds=6) if case.name in QUICK else case)  # which leaves its error below the limit
