"""Kernels do not depend on the samples per pixel: whoever takes more of them waits for no compiler."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

import edge_media_scenes as media
import edge_scenes as scenes
from truth import translate

FEW = 1000
"""Operations of kernels that may be compiled again: sums over all samples, and the like."""
PASSES = {
    "boundary": lambda: ({"boundary": "all"}, scenes.scene(**parts())),
    "caustics": lambda: ({"boundary": "all", "caustics": "particles"}, scenes.scene(**parts())),
    "in fog": lambda: ({"boundary": "all"}, media.in_fog(media.thin(), **parts())),
    "light paths": lambda: ({"type": "pathreplay_particles"}, scenes.scene(**parts())),
}


def parts() -> dict[str, Any]:
    """A ball and a pane before a wall, under a lamp."""
    pane = scenes.T().translate([0.2, 0.3, 0.8]).rotate([1, 1, 0], 30).scale(0.3)
    return {
        "wall": scenes.shape(scenes.BACK, scenes.paint(0.5)),
        "lamp": scenes.lamp(scenes.OVERHEAD),
        "object": scenes.shape(scenes.T().scale(0.3), scenes.paint(0.6), "sphere"),
        "pane": scenes.shape(pane, {"type": "thindielectric"}),
    }


@pytest.mark.parametrize("make", PASSES.values(), ids=PASSES)
def test_other_samples_are_no_other_kernels(make: Callable[[], tuple[dict[str, Any], dict[str, Any]]]) -> None:
    gc.collect()  # Dr.Jit traces calls through all scenes alive: one that goes between two passes makes other kernels
    options, described = make()
    scene = mi.load_dict(described)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "pathreplay", "max_depth": 4, **options})
    rest, compiled = mi.Transform4f(params["object.to_world"]), []
    for spp in (16, 16, 8, 64):
        x = mi.Float(0)
        dr.enable_grad(x)
        params["object.to_world"] = translate(1, 0, 0)(rest, x)
        params.update()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            image = mi.render(scene, params, integrator=integrator, seed=1, spp=spp)
            dr.backward(dr.sum(image, axis=None))
            dr.eval()
            history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
        compiled.append(sum(entry["operation_count"] for entry in history if not entry["cache_hit"]))
    assert max(compiled[2:]) < FEW, compiled
