"""Balanced lobes: rare lobes beside a reflection are sampled every second time, and nothing changes in the mean."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.lifetimes import careful
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.transport.meet import meet
from pathreplay.transport.motion import along_moving_paths
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import SampledStep

LANES = 2**16
KINDS: dict[str, Any] = {
    "glass": {"type": "dielectric"},
    "our glass": {"type": "dielectric_ad"},
    "thin glass": {"type": "thindielectric"},
    "plastic": {"type": "plastic"},
    "two-sided plastic": {"type": "twosided", "inside": {"type": "plastic"}},
    "glass in a blend": {
        "type": "blendbsdf",
        "weight": 0.9,
        "other": {"type": "diffuse"},
        "glass": {"type": "dielectric"},
    },
}


def sampled(
    bsdf: dict[str, Any], cos: float, balances: bool, sustained: bool = False, **properties: Any
) -> tuple[SampledStep, PathState]:
    """Steps at the first vertex of paths that meet a square with this cosine, and the paths after it."""
    scene = mi.load_dict({"type": "scene", "square": {"type": "rectangle", "bsdf": bsdf}})
    trace = mi.load_dict({"type": "pathreplay", **properties})._trace_config(scene, None)
    trace = along_moving_paths(trace, balances)
    d = mi.Vector3f((1 - cos * cos) ** 0.5, 0, -cos)
    ray = mi.Ray3f(-0.5 * d + dr.zeros(mi.Point3f, LANES), d)
    start = CameraStart(ray, CounterSampler.of(dr.arange(mi.UInt32, LANES)), mi.Bool(True))
    with careful(), dr.suspend_grad():
        assert dr.all(meet(trace, ray, mi.Bool(True)).is_valid())
        path = PathState.begin(trace, start, sustained)
        u, step = path.choose(trace, start.sampler)
        onward = path.advance(trace, u, step)[0]
        dr.eval(step, onward)
    return step, onward


def passed(step: SampledStep) -> np.ndarray:
    return np.array(step.ray_next.d.z < 0)


@pytest.mark.parametrize("cos", [0.8, 0.05, 0.003])
@pytest.mark.parametrize("kind", KINDS)
def test_the_mean_is_unchanged(kind: str, cos: float) -> None:
    """Light that is reflected and light that is not: (mean, standard error) of each weight."""
    found = []
    for balances in (True, False):
        step, onward = sampled(KINDS[kind], cos, balances)
        w = np.array(dr.mean(onward.β))
        mirrored = np.array(step.kept.delta) & ~passed(step)
        found.append([(x.mean(), x.std() / LANES**0.5) for x in (w * mirrored, w * ~mirrored)])
    for (a, da), (b, db) in zip(*found, strict=True):
        assert abs(a - b) < 4 * np.hypot(da, db) + 1e-6, found


@pytest.mark.parametrize("cos", [0.05, 1e-3, 1e-5])
def test_rare_transmission_is_sampled_every_second_time(cos: float) -> None:
    step, _ = sampled(KINDS["glass"], cos, True)
    assert passed(step).mean() == pytest.approx(0.5, abs=0.02)
    assert passed(sampled(KINDS["glass"], cos, False)[0]).mean() < 0.3


def test_common_lobes_are_sampled_as_the_bsdf_does() -> None:
    assert np.all(np.array(sampled(KINDS["glass"], 0.8, True)[0].u_weight) == 1)


def test_russian_roulette_does_not_end_them() -> None:
    """A throughput that is small because a rare lobe was sampled often says nothing about the radiance behind it."""
    _, onward = sampled(KINDS["glass"], 1e-3, True, sustained=True, rr_depth=1)
    β, alive = np.array(dr.mean(onward.β)), np.array(dr.mean(onward.β_alive))
    assert β.min() < 0.05 and alive.min() > 0.3
