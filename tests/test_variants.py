"""Every variant with derivatives in Mitsuba's wheel: our plugins and the main job in it, also one after another."""

from __future__ import annotations

import json

import pytest

# Renders with each of our plugins and differentiates, in each variant named on the command line; what a variant gives
# the second time has to be what it gave the first time. Earlier scenes stay alive on purpose.
SEQUENCE = """
import json, sys
import numpy as np
import pathreplay
from pathreplay.backend import ensure_llvm
import drjit as dr, mitsuba as mi

ensure_llvm()
glass = {"type": "smoothdielectric", "int_ior": 1.2}

def scene(extra):
    return mi.load_dict({
        "type": "scene", "sky": {"type": "constant", "radiance": 1.0},
        "ball": {"type": "sphere", "center": [-0.6, 0, 0], "radius": 0.5, "bsdf": {"type": "diffuse", "id": "paint"}},
        "camera": {"type": "perspective", "fov": 60, "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0],
            [0, 1, 0]), "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}}, **extra},
        optimize=False)

def glassy():
    return scene({"glass": {"type": "sphere", "center": [0.6, 0, 0], "radius": 0.5, "bsdf": glass}})

def cloudy():
    density = mi.VolumeGrid(np.linspace(0.5, 2, 8).reshape(2, 2, 2, 1).astype(np.float32))
    medium = {"type": "gridmedium", "albedo": 0.5, "sigma_t": {"type": "gridvolume", "grid": density}}
    return scene({"cloud": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5).translate([1, 0, 0]),
        "bsdf": {"type": "null"}, "interior": medium}})

def derivative(scene, integrator, key):
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, integrator=integrator, spp=16, seed=1)
    dr.backward(dr.mean(image, axis=None))
    gradient = float(np.sum(np.array(dr.grad(params[key]))))
    dr.set_grad(params[key], 0)
    return float(np.mean(np.array(image))), gradient

alive = []
for variant in sys.argv[1:]:
    mi.set_variant(variant)
    if variant.startswith("scalar"):
        for plugin in ("pathreplay", "pathreplay_tape", "pathreplay_rb", "smoothdielectric", "gridmedium"):
            try:
                mi.load_dict({"type": plugin})
            except Exception as error:
                print(json.dumps([variant, plugin, str(error).splitlines()[-1]]))
        continue
    glassy_scene, cloudy_scene = glassy(), cloudy()
    alive += [glassy_scene, cloudy_scene]
    paint, eta = "ball.bsdf.reflectance.value", "glass.bsdf.eta"
    density = "cloud.interior_medium.sigma_t.data"
    for plugin, made, key in [
        ("pathreplay", glassy_scene, eta), ("pathreplay", cloudy_scene, density), ("pathreplay", glassy_scene, paint),
        ("pathreplay_tape", glassy_scene, eta), ("pathreplay_rb", glassy_scene, paint), ("prb", glassy_scene, paint),
    ]:
        integrator = mi.load_dict({"type": plugin, "max_depth": 4})
        assert isinstance(integrator, mi.Integrator), (variant, plugin)
        print()  # ends what Mitsuba's log may have begun
        print(json.dumps([variant, plugin, key, *derivative(made, integrator, key)]))
"""

SEQUENCES = {
    "there and back": ("llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb", "llvm_ad_rgb"),
    "scalar first": ("scalar_rgb", "llvm_ad_mono", "scalar_spectral", "llvm_ad_rgb", "llvm_ad_mono"),
    "spectral first": ("llvm_ad_spectral", "llvm_ad_rgb", "llvm_ad_spectral"),
    "all": ("llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral"),
}
QUICK = "there and back"


@pytest.mark.parametrize("name", [n if n == QUICK else pytest.param(n, marks=pytest.mark.slow) for n in SEQUENCES])
def test_plugins_work_in_every_order_of_variants(run_python, name: str) -> None:
    done = run_python(SEQUENCE, args=SEQUENCES[name])
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    refusals = [line for line in lines if line[0].startswith("scalar")]
    assert len(refusals) == 5 * sum(variant.startswith("scalar") for variant in SEQUENCES[name])
    for variant, plugin, message in refusals:
        instead = "llvm_ad_spectral" if "spectral" in variant else "llvm_ad_rgb"
        assert message.startswith(f"PathreplayError: {plugin}: variant {variant!r} has no derivatives: use {instead} ")
    found: dict[str, dict[tuple[str, str], list[float]]] = {}
    for variant, plugin, key, *values in [line for line in lines if line not in refusals]:
        # What a variant gave the first time, it gives again; the order of additions is another each time.
        assert values == pytest.approx(found.setdefault(variant, {}).setdefault((plugin, key), values), rel=1e-4)
    assert set(found) == {variant for variant in SEQUENCES[name] if not variant.startswith("scalar")}
    for variant, of in found.items():
        for key in ("glass.bsdf.eta", "ball.bsdf.reflectance.value"):
            same = [values for (_, k), values in of.items() if k == key]
            # On the same random numbers, but `pathreplay_rb` walks paths of its own, too.
            assert len(same) > 1 and all(v == pytest.approx(same[0], rel=5e-3) for v in same), (variant, key, same)
        assert of["pathreplay", "cloud.interior_medium.sigma_t.data"][1] < 0
