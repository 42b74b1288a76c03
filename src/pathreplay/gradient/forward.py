"""The forward driver: carry tangents along the path, δL = Σ (δβ_i e_i + β_i δe_i), in a single pass."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.path import Walk, first_arrival, next_arrival, sustain, survival
from ..transport.step import surface_step
from ..transport.vertex import Numbers


@dr.syntax
def forward(walk: Walk, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any]:
    """Tangent of the radiance along camera rays: ``(δL, valid)``, a Spectrum and a Bool per ray.

    The parameters must carry their tangents already (propagate to them before the call). Nothing is divided, so a
    weight that is exactly zero keeps its derivative: δβ_{i+1} = δβ_i w_i + β_i δw_i.
    Visibility and, with ``attach='none'``, all motion are not differentiated.
    """
    scene, options = walk.scene, walk.options
    δL = mi.Spectrum(0)  # tangent of the radiance
    β = mi.Spectrum(1)  # throughput
    δβ = mi.Spectrum(0)  # its tangent
    β_alive = mi.Spectrum(1)  # throughput with one zero weight left out: what keeps the path going
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # index of the vertex
    active = mi.Bool(active) & (options.max_depth > 0)
    valid = mi.Bool(walk.environment_is_opaque) & active
    at = first_arrival(walk, ray, active)

    while dr.hint(active, max_iterations=options.max_depth, exclude=[walk, scene, options], label="pathreplay: forward"):
        u = Numbers.draw(sampler)
        go_on = depth + 1 < options.max_depth
        step = surface_step(scene, at, u, go_on, options, active)

        with dr.resume_grad():
            held = surface_step(scene, at, u, go_on, options, active, step.kept)
            δe, δw = tangents(held.e, held.w)

        δL += δβ * dr.detach(held.e) + β * δe
        δβ = δβ * dr.detach(held.w) + β * δw
        β_alive = sustain(β_alive, β, step)
        β *= dr.detach(held.w)
        η *= step.eta
        valid |= active & step.surface & ~step.null

        rr_weight, survives = survival(β_alive, η, depth, u.roulette, options)
        active = step.active & survives & (dr.max(β_alive) != 0)
        β *= rr_weight
        δβ *= rr_weight
        β_alive *= rr_weight

        at = next_arrival(scene, step, active)
        depth += 1

    return δL, valid


def tangents(*values: Any) -> list[Any]:
    """Forward-propagate from the parameters to all values at once; zero for those that no parameter reaches."""
    attached = [value for value in values if dr.grad_enabled(value)]
    if not attached:
        return [dr.zeros(type(value)) for value in values]
    dr.forward_to(*attached, flags=dr.ADFlag.ClearEdges)
    return [dr.grad(value) for value in values]
