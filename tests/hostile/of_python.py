"""Hostile arguments in scripts: our plugins, `check_gradient`, `optimize`, and what reads and writes volumes."""

from __future__ import annotations

import numpy as np

from .case import Action, add, recipe
from .room import Room
from .values import pick

KIND = "python"

START = "import pathreplay, mitsuba as mi, drjit as dr, numpy as np\nmi.set_variant({variant!r})\n"
LOADED = 'scene = mi.load_file("ball.xml", optimize=False)\n'

#: As they are written in a script. None is not among them: Mitsuba's own `load_dict` dies of it, with any plugin.
VALUES = (
    "'6'",
    "''",
    "float('nan')",
    "float('inf')",
    "-float('inf')",
    "1.5",
    "-1",
    "-2",
    "0",
    "True",
    "10**12",
    "2**32",
    "10**30",
    "1e308",
    "[1, 2]",
    "{'type': 'diffuse'}",
    "mi.ScalarTransform4f()",
    "'\\x1b[2J'",
    "'x' * 100_000",
)


def script(code: str, variant: str = "llvm_ad_rgb") -> Action:
    """A script in which a variant is set."""
    return Action(script=START.format(variant=variant) + code)


def _code(name: str, code: str, *, refused: bool = True, variant: str = "llvm_ad_rgb") -> None:
    add(KIND, name, lambda room, rng: script(code, variant), refused=refused)


# ------------------------------------------------------------------------------
#  Plugins
# ------------------------------------------------------------------------------

OPTIONS = {
    "pathreplay": (
        "max_depth",
        "rr_depth",
        "hide_emitters",
        "adjoint",
        "attach",
        "jacobian_noise",
        "null_branching",
        "boundary",
        "sampling",
        "caustics",
    ),
    "pathreplay_particles": ("max_depth", "rr_depth", "hide_emitters", "samples_per_pass", "attach", "boundary"),
    "dielectric_ad": ("int_ior", "ext_ior", "specular_reflectance", "specular_transmittance"),
    "gridmedium": ("sigma_t", "albedo", "scale", "emission", "supergrid"),
}
for _plugin, _options in OPTIONS.items():
    for _option in (*_options, "unknown"):

        def _hostile(room: Room, rng: np.random.Generator, plugin: str = _plugin, option: str = _option) -> Action:
            return script(f"mi.load_dict({{'type': {plugin!r}, {option!r}: {pick(rng, VALUES)}}})")

        add(KIND, f"{_plugin}: {_option} of any kind", _hostile, fuzz=True)

for _value in ("'6'", "float('nan')", "1.5", "10**12", "-2", "True"):
    _code(f"pathreplay: max_depth = {_value}", f"mi.load_dict({{'type': 'pathreplay', 'max_depth': {_value}}})")
for _value in ("'5'", "float('nan')", "1.5", "0"):
    _code(f"pathreplay: rr_depth = {_value}", f"mi.load_dict({{'type': 'pathreplay', 'rr_depth': {_value}}})")
for _value in ("'low'", "float('nan')", "-1"):
    _code(
        f"pathreplay: jacobian_noise = {_value}", f"mi.load_dict({{'type': 'pathreplay', 'jacobian_noise': {_value}}})"
    )
for _plugin in OPTIONS:
    for _variant in ("scalar_rgb", "scalar_spectral"):
        _code(f"{_plugin} in {_variant}", f"mi.load_dict({{'type': {_plugin!r}}})", variant=_variant)
    if _plugin != "gridmedium":  # media know no polarisation
        _code(f"{_plugin}, polarised", f"mi.load_dict({{'type': {_plugin!r}}})", variant="llvm_ad_mono_polarized")


# ------------------------------------------------------------------------------
#  Functions
# ------------------------------------------------------------------------------

ARGUMENTS = ("sensor", "seeds", "spp", "fd_spp", "step", "direction", "mode", "loss", "seed", "integrator", "reference")
CHECK = LOADED + "pathreplay.check_gradient(scene, {key}, **{{'seeds': 2, 'spp': 1, **{options}}})"


@recipe(KIND, fuzz=True)
def check_gradient_of_any_kind(room: Room, rng: np.random.Generator) -> Action:
    # Ten million samples are a legitimate wish; those here are far above what is possible, or wrong.
    options = f"{{{pick(rng, ARGUMENTS)!r}: {pick(rng, VALUES)}}}"
    return script(CHECK.format(key="'paint.reflectance.data'", options=options))


for _key in ("None", "3", "''", "'paint'", "['paint.reflectance.data']", "'x' * 100_000", "'\\x1b[2J'"):
    _code(f"check_gradient: key = {_key}", CHECK.format(key=_key, options="{}"))
for _scene in ("None", "'ball.xml'", "{}", "mi.load_dict({'type': 'sphere'})"):
    _code(f"check_gradient: scene = {_scene}", f"pathreplay.check_gradient({_scene}, 'paint.reflectance.data')")
for _name, _value in {
    "seeds": "10**9",
    "spp": "10**9",
    "fd_spp": "2**31",
    "seed": "-1",
    "sensor": "'eye'",
    "mode": "None",
    "step": "0",
    "direction": "np.ones(7)",
    "reference": "'prbb'",
}.items():
    _code(
        f"check_gradient: {_name} = {_value}",
        CHECK.format(key="'paint.reflectance.data'", options=f"{{{_name!r}: {_value}}}"),
    )
_code("check_gradient: direction of NaN", CHECK.format(
    key="'sky.radiance.value'", options="{'direction': np.full(3, np.nan)}"))  # fmt: skip
_code(
    "check_gradient without a variant's derivatives",
    LOADED + "pathreplay.check_gradient(scene, 'a')",
    variant="scalar_rgb",
)
_code("check_gradient of a loss that is NaN", CHECK.format(
    key="'paint.reflectance.data'", options="{'loss': lambda image: dr.sum(image) * float('nan')}"))  # fmt: skip

OPTIMIZE = "from pathreplay.jobs import make_config, optimize\n"
for _call in (
    "optimize()",
    "optimize(3)",
    "optimize('')",
    "optimize('no.toml')",
    "optimize({'scene': 'ball.xml'})",
    "optimize(None, resume='.')",
    "optimize('job.toml', output='job.toml/run')",
    "optimize(make_config({}))",
    "optimize(make_config(None))",
    "optimize(make_config([1, 2]))",
    "make_config({'scene': 'ball.xml', 'parameters': [], 'target': {}})",
    "make_config({'scene': b'\\xff', 'parameters': [{'key': 1}], 'target': None})",
    "make_config({3: 4})",
    "optimize(np.zeros(3))",
):
    _code(_call[:60], OPTIMIZE + _call)

VOLUMES = "from pathreplay.scenes.volume_files import grid_volume, load_volume, save_vol, vol_bytes\n"
for _call in (
    "load_volume('')",
    "load_volume('texture.png')",
    "load_volume('cloud.vol', 'density')",
    "load_volume('two.vdb')",
    "load_volume('two.vdb', 'dens')",
    "load_volume('two.nvdb', 3)",
    "vol_bytes(np.zeros(3))",
    "vol_bytes(np.zeros((0, 2, 2)))",
    "grid_volume('cloud.vol', filter_typ='nearest') and mi.load_dict(grid_volume('cloud.vol', filter_typ='nearest'))",
    "mi.load_dict(grid_volume('cloud.vol', to_world=3))",
):
    _code(_call[:60], VOLUMES + _call)

RENDER = LOADED + "integrator = mi.load_dict({'type': 'pathreplay'})\n"
for _call in (
    "mi.render(scene, integrator=integrator, spp=2**31)",
    "integrator.render_value_and_grad(scene, 0, 0, scene.sensors()[0], 0, 1)",
    "integrator.render_value_and_grad(scene, *2 * [mi.TensorXf(0, (1, 1, 1))], scene.sensors()[0], 0, 1)",
):
    _code(_call[:80], RENDER + _call)
_code(
    "nothing to differentiate",
    RENDER + "image = mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1)\ndr.backward(dr.sum(image))",
    refused=False,
)


@recipe(KIND)
def one_variant_after_another(room: Room, rng: np.random.Generator) -> Action:
    names = ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_rgb"]
    return script(
        f"for name in {[names[int(i)] for i in rng.permutation(4)]!r}:\n"
        "    mi.set_variant(name)\n"
        "    scene = mi.load_file('ball.xml')\n"
        "    image = mi.render(scene, spp=1, integrator=mi.load_dict({'type': 'pathreplay'}))\n"
        "    dr.eval(image); del image, scene\n"
    )
