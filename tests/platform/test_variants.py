"""Every variant with derivatives in Mitsuba's wheel: our plugins and the main job in it, also one after another."""

from __future__ import annotations

import json

import pytest

from variant import BACKEND, MONO, SPECTRAL

# Renders with each of our plugins and differentiates, in each variant named on the command line; what a variant gives
# the second time has to be what it gave the first time. Earlier scenes stay alive on purpose.
SEQUENCE = """
import json, sys
import numpy as np
import pathreplay
from pathreplay.platform.backend import ensure_llvm
import drjit as dr, mitsuba as mi

if any(name.startswith("llvm") for name in sys.argv[1:]):
    ensure_llvm()
glass = {"type": "dielectric_ad", "int_ior": 1.2}

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
    before = float(np.sum(np.array(dr.grad(params[key]))))
    image = mi.render(scene, params, integrator=integrator, spp=16, seed=1)
    dr.backward(dr.mean(image, axis=None))
    return float(np.mean(np.array(image))), float(np.sum(np.array(dr.grad(params[key])))) - before

pathreplay.baselines.register()
alive = []
for variant in sys.argv[1:]:
    mi.set_variant(variant)
    if variant.startswith("scalar"):
        for plugin in [*pathreplay.platform.registration.PLUGINS, *pathreplay.platform.registration.BASELINES]:
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
        ("naive_ad", glassy_scene, eta), ("radiative_backprop", glassy_scene, paint), ("prb", glassy_scene, paint),
    ]:
        options = {"sampling": "scene", "boundary": "none"} if plugin == "pathreplay" else {}  # as the others have it
        integrator = mi.load_dict({"type": plugin, "max_depth": 4, **options})
        assert isinstance(integrator, mi.Integrator), (variant, plugin)
        print()  # ends what Mitsuba's log may have begun
        print(json.dumps([variant, plugin, key, *derivative(made, integrator, key)]))
"""

RGB = f"{BACKEND}_ad_rgb"
SEQUENCES = {
    "over scalar": (RGB, "scalar_rgb", RGB),
    "there and back": (RGB, MONO, "scalar_rgb", RGB),
    "scalar first": ("scalar_rgb", MONO, "scalar_spectral", RGB, MONO),
    "spectral first": (SPECTRAL, RGB, SPECTRAL),
    "all": (MONO, SPECTRAL, MONO, RGB, SPECTRAL),
}
QUICK = "over scalar"


@pytest.mark.parametrize("name", [n if n == QUICK else pytest.param(n, marks=pytest.mark.slow) for n in SEQUENCES])
def test_plugins_work_in_every_order_of_variants(run_python, name: str) -> None:
    done = run_python(SEQUENCE, args=SEQUENCES[name])
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    refusals = [line for line in lines if line[0].startswith("scalar")]
    assert len(refusals) == 7 * sum(variant.startswith("scalar") for variant in SEQUENCES[name])
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
            # On the same random numbers, but `radiative_backprop` walks paths of its own, too.
            assert len(same) > 1 and all(v == pytest.approx(same[0], rel=5e-3) for v in same), (variant, key, same)
        assert of["pathreplay", "cloud.interior_medium.sigma_t.data"][1] < 0


# Optimises for five iterations in each of the variants on the command line, exports what came of it, and checks three
# kinds of parameters.
MAIN_JOB = """
import json, sys
from pathlib import Path
import numpy as np
import pathreplay
from pathreplay import check_gradient, optimize
from pathreplay.inverse.config.schema import PICTURE, load_config
from pathreplay.inverse.images.io import exr_bytes, read_image
from pathreplay.output.export import export_run
from pathreplay.scenes.loading import load_scene

folder, *variants = sys.argv[1:]
folder = Path(folder)
(folder / "colours.exr").write_bytes(exr_bytes(np.random.default_rng(1).uniform(0.2, 0.8, (3, 4, 3)).astype("f4")))
(folder / "room.xml").write_text('''<scene version="3.0.0"><default name="grey" value="0.3"/>
  <sensor type="perspective"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film></sensor>
  <integrator type="path"><integer name="max_depth" value="3"/></integrator>
  <shape type="sphere" id="ball"><bsdf type="diffuse"><spectrum name="reflectance" value="$grey"/></bsdf></shape>
  <shape type="sphere" id="red"><point name="center" x="-1" y="1" z="0"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.3, 0.2"/></bsdf></shape>
  <shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/><translate z="-1"/></transform>
    <bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="colours.exr"/>
    </texture></bsdf></shape>
  <shape type="sphere" id="lamp"><point name="center" x="1" y="1.5" z="2"/><float name="radius" value="0.3"/>
    <emitter type="area"><rgb name="radiance" value="6, 5, 4"/></emitter></shape>
  <emitter type="constant"><rgb name="radiance" value="0.4, 0.5, 0.6"/></emitter>
</scene>''')
job = '''scene = "room.xml"
variant = "VARIANT"
iterations = 5
spp = 16
eval_spp = 4
learning_rate = 0.08
integrator = { type = "pathreplay", max_depth = 3 }
parameters = [ { key = "ball.bsdf.reflectance.value", lower = 0, upper = 1 } ]
[target]
scene = "room.xml"
scene_parameters = { grey = 0.7 }
spp = 64
integrator = { type = "path", max_depth = 3 }
'''
for variant in variants:
    (folder / f"{variant}.toml").write_text(job.replace("VARIANT", variant))
    result = optimize(folder / f"{variant}.toml", output=folder / "out", progress=False)
    print()  # ends what Mitsuba's log may have begun
    print(json.dumps([variant, "loss", *(entry.loss for entry in result.history)]))
    export_run(result.folder)
    import mitsuba as mi
    exported = mi.load_file(str(result.folder / "export" / "scene.xml"))
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    seed = load_config(folder / f"{variant}.toml").seeds(PICTURE, 0)[0]
    image = np.array(mi.render(exported, integrator=ours, spp=4, seed=seed))
    (shown,) = (result.folder / "images").glob("result-*.exr")
    print()
    print(json.dumps([variant, "export", float(np.isclose(image, read_image(shown), rtol=1e-3, atol=1e-4).mean())]))
    scene = load_scene(folder / "room.xml")
    keys = ("red.bsdf.reflectance.value", "floor.bsdf.reflectance.data", "lamp.emitter.radiance.value")
    for key in keys if len(variants) == 1 else keys[:1]:
        check = check_gradient(scene, key, seeds=6, spp=48, max_depth=3)
        print()
        print(json.dumps([variant, key, check.verdict, str(check)]))
"""

JOBS = {
    "mono": (MONO,),
    "spectral": (SPECTRAL,),
    "in turn": (RGB, SPECTRAL, MONO, RGB),
}


@pytest.mark.slow  # the quick tests check and optimise scenes of test_ordinary_use in these variants
@pytest.mark.parametrize("name", JOBS)
def test_the_main_job_runs_in_every_variant(run_python, tmp_path, name: str) -> None:
    done = run_python(MAIN_JOB, args=(str(tmp_path), *JOBS[name]))
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    losses = [line[2:] for line in lines if line[1] == "loss"]
    assert len(losses) == len(JOBS[name]) and all(len(history) == 5 for history in losses)
    assert all(history[-1] < 0.8 * history[0] for history in losses), losses
    exports = [line[2] for line in lines if line[1] == "export"]
    assert len(exports) == len(JOBS[name]) and min(exports) > 0.95, exports
    checks = [line for line in lines if line[1] not in ("loss", "export")]
    assert len(checks) == (3 if len(JOBS[name]) == 1 else len(JOBS[name]))
    assert all(verdict == "pass" for _, _, verdict, _ in checks), checks


# A ball that moves hides a lamp and a sky, in the variant on the command line, with and without edges.
EDGES_JOB = """
import json, sys
import pathreplay
from pathreplay.platform.backend import set_variant

set_variant(sys.argv[1])
import mitsuba as mi

def colour(*rgb):
    return {"type": "rgb", "value": list(rgb)}

look_at = mi.ScalarTransform4f().look_at
scene = mi.load_dict({
    "type": "scene",
    "camera": {"type": "perspective", "fov": 40, "to_world": look_at([0, 3, 5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 12, "height": 10, "rfilter": {"type": "box"}}},
    "ball": {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([0.1, 0.3, 0]).scale(0.6),
        "bsdf": {"type": "diffuse", "reflectance": colour(0.7, 0.3, 0.2)}},
    "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": colour(0.3, 0.5, 0.6)},
        "to_world": mi.ScalarTransform4f().translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(3)},
    "lamp": {"type": "rectangle", "to_world": look_at([1, 3, 1], [0, 0, 0], [0, 0, 1]).scale(0.5),
        "emitter": {"type": "area", "radiance": colour(9, 8, 6)}},
    "sky": {"type": "constant", "radiance": colour(0.1, 0.2, 0.4)},
}, optimize=False)
for edges in ("all", "none"):
    tested = {"type": "pathreplay", "max_depth": 3, "boundary": edges}
    check = pathreplay.check_gradient(scene, "ball.to_world", integrator=tested, seeds=16, spp=2048, step=0.02)
    print()
    print(json.dumps([edges, check.verdict, str(check)]))
"""


@pytest.mark.slow  # the quick tests hold edges to finite differences in one variant
@pytest.mark.parametrize("variant", [MONO, SPECTRAL])
def test_edges_are_right_in_every_variant(run_python, variant: str) -> None:
    done = run_python(EDGES_JOB, args=(variant,))
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert [(edges, verdict) for edges, verdict, _ in lines] == [("all", "pass"), ("none", "fail")], lines


def test_the_variants_here_are_all_that_there_are() -> None:
    import mitsuba as mi

    from pathreplay.platform.backend import is_usable_variant

    usable = {name for name in mi.variants() if is_usable_variant(name) and name.startswith(BACKEND)}
    assert usable == {variant for sequence in JOBS.values() for variant in sequence}


def test_what_belongs_to_another_variant_is_told(run_python) -> None:
    done = run_python("""
import pathreplay, mitsuba as mi
from pathreplay.platform.backend import ensure_llvm
ensure_llvm()
mi.set_variant("llvm_ad_rgb")
scene, integrator = mi.load_dict(mi.cornell_box()), mi.load_dict({"type": "pathreplay"})
mi.set_variant("llvm_ad_mono")
other = mi.load_dict(mi.cornell_box())
for work in (
    lambda: integrator.render(other, 0, spp=1),
    lambda: mi.load_dict({"type": "pathreplay"}).render(scene, 0, spp=1),
    lambda: pathreplay.check_gradient(scene, "green.reflectance.value"),
):
    try:
        work()
    except pathreplay.PathreplayError as error:
        print("\\ntold:", error)
""")
    assert done.returncode == 0, done.stderr[-2000:]
    told = [line for line in done.stdout.splitlines() if line.startswith("told:")]
    assert len(told) == 3 and all("another variant than the active one, 'llvm_ad_mono'" in line for line in told), told
