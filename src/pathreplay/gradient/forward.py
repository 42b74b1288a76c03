"""The forward driver: carry tangents along the path, δL = Σ (δβ_i e_i + β_i δe_i), in a single pass."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.motion import path_moves
from ..transport.path import count, first_arrival, next_arrival, survival, sustain, take_step
from ..transport.vertex import Numbers, Walk
from .adjoint import LostPaths, RayDerivative, Replayed, forward_step, tangents
from .branch import Branch, branch_term


@dr.syntax
def forward(walk: Walk, sampler: Any, ray: Any, active: Any, lost: LostPaths) -> tuple[Any, Any, bool]:
    """Tangent of the radiance along camera rays: ``(δL, valid, moves)``, a Spectrum and a Bool per ray, and a bool.

    The parameters must carry their tangents already (propagate to them before the call); ``ray`` may be attached to
    the camera. Nothing is divided, so a weight that is exactly zero keeps its derivative:
    δβ_{i+1} = δβ_i w_i + β_i δw_i. If the path ``moves`` with the parameters, ``lost`` counts paths with a tangent that
    was not finite and was dropped. Visibility is not differentiated and, with ``attach='none'``, nothing that moves.
    """
    with dr.resume_grad():
        δo, δd = tangents(ray.o, ray.d)
    δ = RayDerivative(mi.Point3f(δo), mi.Vector3f(δd), mi.Float(0))  # tangent of the arrival

    δL = mi.Spectrum(0)  # tangent of the radiance
    broken = mi.Bool(False)  # a tangent was not finite
    β = mi.Spectrum(1)  # throughput
    δβ = mi.Spectrum(0)  # its tangent
    β_alive = mi.Spectrum(1)  # throughput with one zero weight left out: what keeps the path going
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # vertices before
    active = mi.Bool(active) & (walk.max_depth > 0)
    valid = mi.Bool(walk.background_is_opaque) & active
    at = first_arrival(walk, ray, active)
    attached = path_moves(walk, ray, at)
    branch = Branch.none()

    while dr.hint(active, exclude=[walk, attached, lost], label="pathreplay: forward"):
        u = Numbers.draw(sampler)
        step = take_step(walk, at, u, sampler, β_alive, depth + 1 < walk.max_depth, active)

        β_alive = sustain(β_alive, β, step)
        η *= step.kept.eta
        valid |= active & step.met & ~step.kept.null
        rr_weight, survives = survival(β_alive, η, depth, u.roulette, walk, step)
        go_on = step.active & survives & (dr.max(β_alive) != 0)
        at_next = next_arrival(walk, at, step, go_on)

        if dr.hint(walk.branch, mode="scalar"):
            branch = branch.offer(at, step, β, depth, η, active)
        replayed = Replayed(at, u, step.kept, go_on, at_next.hit, rr_weight)
        depth += count(walk, step)
        step, δe, δw, δ = forward_step(walk, replayed, attached, δ, active)
        if dr.hint(attached, mode="scalar"):
            δ, finite = δ.finite_part()
            lost.add(active & ~finite & ~broken)
            broken |= ~finite
        δL += δβ * dr.detach(step.e) + β * δe
        δβ = (δβ * dr.detach(step.w) + β * δw) * rr_weight
        β *= dr.detach(step.w) * rr_weight
        β_alive *= rr_weight

        active = go_on
        at = at_next

    if dr.hint(walk.branch, mode="scalar"):
        with dr.resume_grad():
            δL += tangents(branch_term(walk, branch, sampler, dr.detach(ray)))[0]
    return δL, valid, attached
