"""The primal driver: walk paths and add up radiance, L = Σ β_i e_i."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.path import count, first_arrival, next_arrival, survival, take_step
from ..transport.vertex import Arrival, Numbers, Walk


def primal(walk: Walk, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any]:
    """Estimate the radiance along camera rays: ``(L, valid)``, a Spectrum and a Bool per ray.

    ``valid`` is Mitsuba's alpha: the path met a particle, or a surface that does not merely let it pass. Nothing is
    differentiated.
    """
    active = mi.Bool(active) & (walk.max_depth > 0)
    at = first_arrival(walk, ray, active)
    L, valid = walk_on(walk, sampler, at, mi.UInt32(0), mi.Float(1), active)
    return L, valid | (walk.background_is_opaque & active)


@dr.syntax
def walk_on(walk: Walk, sampler: Any, at: Arrival, depth: Any, η: Any, active: Any) -> tuple[Any, Any]:
    """Radiance (Spectrum) that arrives along ``at.ray``, and whether anything was met, from a vertex of a path on.

    ``depth`` (UInt32) are the vertices before, and ``η`` the relative index of refraction since the camera.
    """
    L = mi.Spectrum(0)  # radiance so far
    β = mi.Spectrum(1)  # throughput
    depth, η = mi.UInt32(depth), mi.Float(η)
    active, valid = mi.Bool(active), mi.Bool(False)

    while dr.hint(active, exclude=[walk], label="pathreplay: primal"):
        u = Numbers.draw(sampler)
        step = take_step(walk, at, u, sampler, β, depth + 1 < walk.max_depth, active)

        L += β * step.e
        β *= step.w
        η *= step.kept.eta
        valid |= active & step.met & ~step.kept.null

        rr_weight, survives = survival(β, η, depth, u.roulette, walk, step)
        active = step.active & survives & (dr.max(β) != 0)
        β *= rr_weight

        at = next_arrival(walk, at, step, active)
        depth += count(walk, step)

    return L, valid
