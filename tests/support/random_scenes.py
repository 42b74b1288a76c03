"""Random scenes, loaded, rendered, differentiated and dropped one after the other in one process, as notebooks do.

    python tests/support/random_scenes.py COUNT [--first SEED] [--no-gc]

A scene has random shapes, materials, lights, media and instances, one of several variants, and one parameter with a
gradient. Some scenes outlive the next one, and some integrators serve several scenes. Prints a line for each. Every
scene is a handful of kernels that nobody runs again, and so LLVM does not optimise them: this is about lifetimes.
"""

from __future__ import annotations

import argparse
import gc
from typing import Any

import numpy as np

from unoptimised import keep_apart, leave_unoptimised

if __name__ == "__main__":
    keep_apart()
import pathreplay
from pathreplay.platform.backend import set_variant

VARIANTS = ("llvm_ad_rgb", "llvm_ad_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral")
BLOCK = 10
"""Scenes of one variant in a row: each change of it imports Mitsuba's Python modules anew."""


class Draw:
    """Draws scenes."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def one(self, *values: Any) -> Any:
        return values[self.rng.integers(len(values))]

    def colour(self, low: float = 0.1, high: float = 0.9) -> dict:
        import mitsuba as mi

        if mi.is_monochromatic:
            return {"type": "uniform", "value": float(self.rng.uniform(low, high))}
        return {"type": "rgb", "value": self.rng.uniform(low, high, 3).tolist()}

    def place(self, size: float = 0.5) -> Any:
        import mitsuba as mi

        x, y, z = self.rng.uniform(-0.8, 0.8, 3)
        axis, angle = self.rng.normal(size=3), float(self.rng.uniform(0, 360))
        turned = mi.ScalarTransform4f().translate([x, y, z]).rotate((axis / np.linalg.norm(axis)).tolist(), angle)
        return turned.scale(float(size * self.rng.uniform(0.5, 1)))

    def bsdf(self) -> dict:
        diffuse = {"type": "diffuse", "reflectance": self.colour()}
        return self.one(
            diffuse,
            {"type": "twosided", "inner": diffuse},
            {"type": "mask", "opacity": 0.6, "inner": diffuse},
            {"type": "conductor"},
            {"type": "roughconductor", "alpha": 0.2},
            {"type": "dielectric"},
            {"type": "dielectric_ad"},
            {"type": "roughdielectric", "alpha": 0.3},
            {"type": "plastic", "diffuse_reflectance": self.colour()},
            {"type": "principled", "base_color": self.colour(), "roughness": 0.4},
        )

    def shape(self) -> dict:
        kind = self.one("rectangle", "sphere", "disk", "cube", "cylinder")
        return {"type": kind, "to_world": self.place(), "bsdf": self.bsdf()}

    def light(self) -> dict:
        import mitsuba as mi

        T = mi.ScalarTransform4f
        down = T().look_at([0, 2.5, 1], [0, 0, 0], [0, 0, 1])
        kind = self.one("area", "ball", "mesh", "point", "spot", "directional", "constant")
        glow = {"type": "area", "radiance": self.colour(2, 8)}
        if kind == "area":
            return {"type": "rectangle", "to_world": down.scale(0.5), "emitter": glow}
        if kind in ("ball", "mesh"):
            shape = "sphere" if kind == "ball" else "cube"
            return {"type": shape, "to_world": T().translate([0.5, 2, 1]).scale(0.3), "emitter": glow}
        if kind == "point":
            return {"type": "point", "position": [1.0, 2.0, 2.0], "intensity": self.colour(2, 8)}
        if kind == "spot":
            return {"type": "spot", "to_world": down, "intensity": self.colour(5, 9)}
        return {"type": kind, "irradiance" if kind == "directional" else "radiance": self.colour(0.5, 1)}

    def medium(self) -> dict:
        import mitsuba as mi

        if self.rng.random() < 0.5:
            return {"type": "homogeneous", "sigma_t": 0.7, "albedo": self.colour()}
        grid = mi.VolumeGrid(self.rng.uniform(0.1, 1, (4, 4, 4)).astype(np.float32))
        to_world = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
        sigma_t = {"type": "gridvolume", "grid": grid, "use_grid_bbox": False, "raw": True, "to_world": to_world}
        return {"type": self.one("heterogeneous", "gridmedium"), "sigma_t": sigma_t, "albedo": 0.6}

    def scene(self) -> dict:
        import mitsuba as mi

        T = mi.ScalarTransform4f
        film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": self.one("box", "gaussian")}}
        camera = {"type": "perspective", "fov": 45, "to_world": T().look_at([0, 0.5, 4], [0, 0, 0], [0, 1, 0])}
        camera |= {"film": film, "sampler": {"type": "independent"}}
        floor = {"type": "rectangle", "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3)}
        parts = {"type": "scene", "camera": camera, "floor": {**floor, "bsdf": {"type": "diffuse"}}}
        for k in range(self.rng.integers(1, 3)):
            parts[f"thing{k}"] = self.shape()
        for k in range(self.rng.integers(1, 3)):
            parts[f"light{k}"] = self.light()
        if self.rng.random() < 0.3:
            box = {"type": "cube", "to_world": T().scale(1.2), "bsdf": {"type": "null"}}
            parts["fog"] = {**box, "interior": self.medium()}
        elif self.rng.random() < 0.3:
            parts["group"] = {"type": "shapegroup", "inner": {"type": "cube", "to_world": T().scale(0.2)}}
            for k in range(2):
                place = T().translate([k - 0.5, 0.5, 0.5])
                parts[f"copy{k}"] = {"type": "instance", "to_world": place, "g": {"type": "ref", "id": "group"}}
        environments = [name for name, part in parts.items() if isinstance(part, dict) and part["type"] == "constant"]
        return {name: part for name, part in parts.items() if name not in environments[1:]}


def differentiate(scene: Any, integrator: Any, key: str, seed: int) -> float:
    """One gradient by a parameter, in which it is added to or, if it is a transformation, moved."""
    import drjit as dr
    import mitsuba as mi

    params = mi.traverse(scene)
    value, t = params[key], mi.Float(0)
    dr.enable_grad(t)
    params[key] = mi.Transform4f().translate([t, 0, 0]) @ value if hasattr(value, "matrix") else value + t
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=2, seed=seed), axis=None))
    g = float(dr.grad(t)[0])
    params[key] = dr.detach(value)
    params.update()
    return g


def keys_of(scene: Any) -> list[str]:
    """What may have a gradient."""
    import mitsuba as mi

    from pathreplay.scenes.parameters import carries_derivative, is_transform

    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "pathreplay"})
    keys = [key for key in params.keys() if carries_derivative(params, key, integrator)]
    return [key for key in keys if not is_transform(params[key]) or "thing" in key]


def run(count: int, first: int, collects: bool) -> None:
    """Scene after scene."""
    if not collects:
        gc.disable()
    kept: list[Any] = []
    integrator = None
    for n in range(first, first + count):
        draw = Draw(n)
        variant = VARIANTS[(n // BLOCK) % len(VARIANTS)]
        import mitsuba as mi

        if mi.variant() != variant:
            kept.clear()
            integrator = None
            set_variant(variant)
        scene = mi.load_dict(draw.scene(), optimize=False)
        if integrator is None or draw.rng.random() < 0.6:
            options = {"max_depth": int(draw.rng.integers(2, 4)), "boundary": draw.one("none", "primary", "all")}
            integrator = mi.load_dict({"type": "pathreplay", **options})
        key = draw.one(*keys_of(scene))
        print(n, variant, integrator.boundary, key, end=" ", flush=True)
        try:
            print([differentiate(scene, integrator, key, k) for k in range(2)], flush=True)
        except pathreplay.PathreplayError as error:
            print("refused:", error, flush=True)
        kept[:] = [scene] if draw.rng.random() < 0.3 else []
    print(f"{count} scenes", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--no-gc", action="store_true")
    options = parser.parse_args()
    set_variant(VARIANTS[0])
    leave_unoptimised("-regalloc=fast")
    run(options.count, options.first, not options.no_gc)
