"""The light that a vertex adds by itself: emission of what was hit, and samples of the emitters."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .vertex import Arrival, mis_weight, reciprocal


def emission(scene: Any, at: Arrival, si: Any, active: Any) -> Any:
    """Radiance emitted towards the ray's origin by what the ray hit (the environment on a miss), MIS weighted.

    Returns a Spectrum, differentiable in the emitter's radiance. The MIS weight is not differentiated: where the
    path is held fixed, it is a weighting that sums to one whatever the parameters do.
    """
    with dr.suspend_grad():
        origin = dr.zeros(mi.Interaction3f)
        origin.p, origin.time, origin.wavelengths = at.ray.o, at.ray.time, at.ray.wavelengths
        ds = mi.DirectionSample3f(scene, si=si, ref=origin)
        mis = mis_weight(at.pdf, scene.pdf_emitter_direction(origin, ds, active & ~at.delta))
    return mis * ds.emitter.eval(si, active)


def draw_emitter(scene: Any, si: Any, u: Any, shadow_ray: bool, active: Any) -> tuple[Any, Any]:
    """Sample a direction towards an emitter: the DirectionSample3f and Le/p (Spectrum).

    With ``shadow_ray``, an occluded sample comes back with density and weight zero.
    """
    with dr.suspend_grad():
        return scene.sample_emitter_direction(si, u, shadow_ray, active)


def emitted_towards(scene: Any, si: Any, ds: Any, active: Any) -> Any:
    """Le/p of an emitter sample that is held fixed: a Spectrum, differentiable in the emitter's radiance."""
    return scene.eval_emitter_direction(si, ds, active) * dr.detach(reciprocal(ds.pdf))
