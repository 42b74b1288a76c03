"""Kernels do not depend on the samples per pixel: whoever takes more of them waits for no compiler.

Mitsuba itself has two kernels: one for samples per pixel that are a power of two, and one for all others.
"""

from __future__ import annotations

import gc
from collections import Counter
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
    "boundary": lambda: ({"boundary": "all"}, scenes.scene(**without_pane())),
    "direct light": lambda: ({"boundary": "all", "max_depth": 2}, scenes.scene(**without_pane())),
    "hard shadows": lambda: ({"boundary": "all"}, scenes.scene(**without_pane(), bulb=BULB)),
    "pane": lambda: ({"boundary": "all"}, scenes.scene(**parts())),
    "caustics": lambda: ({"boundary": "all", "caustics": "particles"}, scenes.scene(**parts())),
    "in fog": lambda: ({"boundary": "all"}, media.in_fog(media.thin(), **parts())),
    "light paths": lambda: ({"type": "pathreplay_particles"}, scenes.scene(**parts())),
}

BULB = {"type": "point", "position": [2, 2, 3], "intensity": 9.0}


def without_pane() -> dict[str, Any]:
    return {name: part for name, part in parts().items() if name != "pane"}


def parts() -> dict[str, Any]:
    """A ball and a pane before a wall, under a lamp."""
    pane = scenes.T().translate([0.2, 0.3, 0.8]).rotate([1, 1, 0], 30).scale(0.3)
    return {
        "wall": scenes.shape(scenes.BACK, scenes.paint(0.5)),
        "lamp": scenes.lamp(scenes.OVERHEAD),
        "object": scenes.shape(scenes.T().scale(0.3), scenes.paint(0.6), "sphere"),
        "pane": scenes.shape(pane, {"type": "thindielectric"}),
    }


def launched(options: dict[str, Any], described: dict[str, Any], *samples: int) -> list[list[dict[str, Any]]]:
    """The kernels of an image and its gradient, for each number of samples per pixel."""
    gc.collect()  # Dr.Jit traces calls through all scenes alive: one that goes between two passes makes other kernels
    scene = mi.load_dict(described)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "pathreplay", "max_depth": 4, **options})
    rest, found = mi.Transform4f(params["object.to_world"]), []
    for spp in samples:
        x = mi.Float(0)
        dr.enable_grad(x)
        params["object.to_world"] = translate(1, 0, 0)(rest, x)
        params.update()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            image = mi.render(scene, params, integrator=integrator, seed=1, spp=spp)
            dr.backward(dr.sum(image, axis=None))
            dr.eval()
            found.append([entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT])
    return found


@pytest.mark.parametrize("make", PASSES.values(), ids=PASSES)
def test_other_samples_are_no_other_kernels(make: Callable[[], tuple[dict[str, Any], dict[str, Any]]]) -> None:
    passes = launched(*make(), 16, 16, 8, 64)
    compiled = [sum(entry["operation_count"] for entry in each if not entry["cache_hit"]) for each in passes]
    assert sum(entry["operation_count"] for entry in passes[-1]) > 5 * FEW
    assert max(compiled[2:]) < FEW, compiled


def test_a_pilot_pass_launches_the_kernels_of_the_search() -> None:
    """Edges that the camera sees, edges that surfaces see, and those behind the pane: each twice."""
    (kernels,) = launched(*PASSES["pane"](), 16)
    times = Counter(entry["hash"] for entry in kernels if entry["operation_count"] > FEW)
    assert sum(count == 2 for count in times.values()) >= 3, times
