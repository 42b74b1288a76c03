"""Tests which passes Dr.Jit records for CUDA, without a GPU: the CUDA driver is replaced by one that runs no kernels.

Dr.Jit traces other code for a GPU than for a CPU, and ends the process at some kernels that it cannot record. Results
are not tested, because all of them are zero.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from typing import Any

import pytest

import fixed_scenes
from places import SUPPORT

# Records passes of the scenes that the command line names, and replays them.
RECORD = """
import sys
sys.path.insert(0, sys.argv[1])
from pathreplay.platform.backend import set_variant
set_variant("cuda_ad_rgb")
import drjit as dr, mitsuba as mi, numpy as np
import fixed_scenes
from pathreplay.inverse.losses.pixelwise import l2
from pathreplay.inverse.objective.frozen import NotRecordable, Recordings, RenderRequest, ViewLoss, ViewTarget

def glow():
    # As `pathreplay from-photos` writes it: a medium that emits and does not scatter, before a sky.
    medium = {"type": "gridmedium", "albedo": 0.0, "sigma_t": fixed_scenes.grid(0.5, 2.0),
              "radiance": fixed_scenes.grid(0.1, 0.9, 3)}
    return {"type": "scene", **fixed_scenes.cameras([0, 0, 4]), "sky": fixed_scenes.sky(),
            "object": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}}

KEYS = ("object.interior_medium.sigma_t.data", "object.interior_medium.radiance.data", "sky.data")
GLOW = fixed_scenes.Scene("glow", glow, KEYS, (), depth=1)
SCENES = {scene.name: scene for scene in (*fixed_scenes.SCENES, GLOW)}

for name in sys.argv[2:]:
    about = SCENES[name]
    scene = mi.load_dict(about.build(), optimize=False)
    params = mi.traverse(scene)
    params.keep(list(about.keys))
    for key in about.keys:  # `fixed_set.Opened.put` would compute poses, which are zero here
        dr.enable_grad(params[key].matrix if key.endswith("to_world") else params[key])
        params[key] = params[key]
    params.update()
    target = ViewTarget(mi.TensorXf(np.zeros((fixed_scenes.SIZE, fixed_scenes.SIZE, 3), np.float32)))
    for boundary in ("none", "all"):
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": about.depth, "boundary": boundary})
        for swept in (False, boundary == "none" and not integrator.why_no_pixel_sweep(scene)):
            recordings, recorded = Recordings(), True
            for seed in range(3):
                request = RenderRequest(0, mi.UInt32(seed), 4)
                try:
                    of_view = ViewLoss(l2, 1.0, swept)
                    result = recordings.differentiate(params, scene, integrator, request, target, of_view)
                except NotRecordable:
                    recorded = False
                    break
                dr.eval(result.loss)
            print("\\nDONE", name, boundary, swept, recorded)
"""
# Scenes with a plugin whose arrays Dr.Jit does not see; on LLVM they are not recorded either.
HIDDEN = {"lens", "lamps", "lights", "fog", "cloud"}


@pytest.fixture(scope="module")
def null_gpu(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str | None]:
    """The environment in which Dr.Jit finds a GPU that runs nothing."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    library = tmp_path_factory.mktemp("null_gpu") / "libnull_gpu.so"
    source = SUPPORT / "null_gpu.c"
    subprocess.run([compiler, "-O1", "-fPIC", "-shared", "-fvisibility=hidden", source, "-o", library], check=True)
    cache = str(tmp_path_factory.mktemp("cache"))  # its kernels are none
    return {"DRJIT_LIBCUDA_PATH": str(library), "DRJIT_LIBOPTIX_PATH": str(library), "DRJIT_CACHE_DIR": cache}


def hold(run_python: Callable[..., Any], null_gpu: dict[str, str | None], names: tuple[str, ...]) -> None:
    done = run_python(RECORD, env=null_gpu, args=(str(SUPPORT), *names))
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    lines = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("DONE")]
    assert {line[0] for line in lines} == set(names)
    assert {line[0] for line in lines if line[3] == "False"} <= HIDDEN, lines


def test_a_glowing_medium_is_recorded(run_python: Callable[..., Any], null_gpu: dict[str, str | None]) -> None:
    """Lookups of its radiance stand outside of virtual calls; if they had a mask, this would end the process."""
    hold(run_python, null_gpu, ("glow", "room"))


@pytest.mark.slow  # the scenes of the quick test are recorded in the same way
@pytest.mark.parametrize("name", [scene.name for scene in fixed_scenes.SCENES])
def test_scenes_are_recorded(run_python: Callable[..., Any], null_gpu: dict[str, str | None], name: str) -> None:
    hold(run_python, null_gpu, (name,))
