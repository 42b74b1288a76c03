"""Attached path replay: recover the adjoint of the ray, too, by inverting one 4x4 Jacobian per vertex.

The first pass keeps L_0 and q_0 = δL·∂L_0/∂r_0. The second walks the path again and peels both,

    β_{i+1} L_{i+1} = β_i L_i - β_i e_i,      (A_i + ε_i X_i)^T q_{i+1} = q_i - p_i,      A_i = ∂r_{i+1}/∂r_i,

where p_i = δL·∂(β_i e_i + β_i w_i L_{i+1})/∂r_i at fixed L_{i+1}. ε_i has mean zero and the first pass carries the
same A_i + ε_i X_i along: the expectation of q_0 is what it would be without. This is the attached estimator of Vicini,
Speierer and Jakob (2021). It is here to be compared with: the sweep driver needs no inverse.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.path import first_arrival, next_arrival, survival
from ..transport.step import surface_step
from ..transport.vertex import Arrival, Numbers, Walk
from .adjoint import LostPaths, Replayed, backward
from .ray_jacobian import (
    RayFrame,
    Recovery,
    emission_slope,
    length_scale,
    linearise,
    local_terms,
    random_sign,
    regularise,
)


def _advance(
    walk: Walk, sampler: Any, at: Arrival, β: Any, η: Any, depth: Any, active: Any
) -> tuple[Replayed, Arrival, Any, Any, Any]:
    """One step of the walk, the same in both passes: the vertex, the next arrival, e (Spectrum), next β and η."""
    u = Numbers.draw(sampler)
    step = surface_step(walk, at, u, depth + 1 < walk.max_depth, active)
    β = β * step.w  # not in place: the caller still needs it
    η = η * step.kept.eta
    rr_weight, survives = survival(β, η, depth, u.roulette, walk, step)
    go_on = step.active & survives & (dr.max(β) != 0)
    at_next = next_arrival(walk, at, step, go_on)
    return Replayed(at, u, step.kept, go_on, at_next.hit, rr_weight), at_next, step.e, β * rr_weight, η


@dr.syntax
def replay_attached(
    walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any, lost: LostPaths, recovery: Recovery
) -> None:
    """Back-propagate the adjoint radiance ``δL`` (Spectrum per ray) into the parameters and the camera.

    ``lost`` counts the paths on which a q was not finite, and what it had to tell was left out. Exact on chains of
    delta lobes. Behind smooth lobes A_i has rank two: without noise q is lost there, with noise the result is unbiased
    as long as rounding is not magnified beyond it. Not differentiated: visibility, and weights that are exactly zero.
    """
    Spectrum, Matrix = recovery.real(mi.Spectrum), recovery.real(mi.Matrix4f)
    Vector = recovery.real(mi.Vector4f)
    scale = length_scale(walk.scene)
    sampler2 = sampler.clone()

    # -------------- First pass: L_0 and its derivative --------------

    L = Spectrum(0)  # δL is not part of it
    q = Vector(0)  # δL·∂L_0/∂r_0
    J = Matrix(1)  # ∂r_i/∂r_0
    κ = [Spectrum(0) for _ in range(4)]  # ∂ log β_i / ∂r_0, by each coordinate
    β = mi.Spectrum(1)  # throughput
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # index of the vertex
    camera_active = mi.Bool(active) & (walk.max_depth > 0)
    active = mi.Bool(camera_active)
    at = first_arrival(walk, ray, active)

    while dr.hint(active, max_iterations=walk.max_depth, exclude=[walk, recovery, scale], label="pathreplay: tangents"):
        v, at_next, e, β_next, η = _advance(walk, sampler, at, β, η, depth, active)
        slope = emission_slope(walk, at_next, δL * β_next, v.go_on)
        frame, frame_next = RayFrame.of(at.ray, scale), RayFrame.of(at_next.ray, scale)
        local = linearise(walk, v, δL * β, slope, frame, frame_next, active)

        L += Spectrum(β * e)
        lit = Spectrum(δL) * Spectrum(β * e)
        q += Vector(J.T @ Vector(local.e)) + Vector(*[dr.sum(lit * k) for k in κ])
        κ = [κ[k] + sum(Spectrum(local.log_w[j]) * J[j, k] for j in range(4)) for k in range(4)]
        ε = recovery.noise * random_sign(v.u)
        J = regularise(Matrix(local.A), type(q.x)(ε), recovery.place, ~v.kept.delta) @ J

        β, at, active = β_next, at_next, v.go_on
        depth += 1

    # ----------------------- Back to the camera ----------------------

    overflow = ~dr.all(dr.isfinite(q))
    q = dr.select(overflow, 0, q)
    with dr.resume_grad():
        if dr.hint(dr.grad_enabled(ray.o, ray.d), mode="scalar"):
            x = RayFrame.of(dr.detach(ray), scale).coordinates(ray.o, ray.d)
            q0 = mi.Vector4f(q)
            dr.eval(q0, overflow)  # as in the sweep
            backward(sum(q0[k] * x[k] for k in range(4)))

    # --------- Second pass: peel L and q, feed the parameters --------

    broken = mi.Bool(False)  # this path has been counted as lost
    β = mi.Spectrum(1)
    η = mi.Float(1)
    depth = mi.UInt32(0)
    active = mi.Bool(camera_active)
    at = first_arrival(walk, ray, active)

    while dr.hint(
        active, max_iterations=walk.max_depth, exclude=[walk, recovery, scale, lost], label="pathreplay: replay"
    ):
        v, at_next, e, β_next, η = _advance(walk, sampler2, at, β, η, depth, active)
        slope = emission_slope(walk, at_next, δL * β_next, v.go_on)
        frame, frame_next = RayFrame.of(at.ray, scale), RayFrame.of(at_next.ray, scale)
        L = dr.select(v.go_on, L - Spectrum(β * e), 0)
        local = linearise(walk, v, δL * β, slope, frame, frame_next, active)

        p = Vector(local.e) + Vector(*[dr.sum(Spectrum(δL) * L * Spectrum(k)) for k in local.log_w])
        ε = recovery.noise * random_sign(v.u)
        A = regularise(Matrix(local.A), type(q.x)(ε), recovery.place, ~v.kept.delta)
        q = dr.select(v.go_on, Vector(dr.rcp(A.T) @ (q - p)), 0)
        breaks = overflow | ~dr.all(dr.isfinite(q))
        q = dr.select(breaks, 0, q)
        lost.add(breaks & ~broken)
        broken |= breaks

        with dr.resume_grad():
            e, w, x_next = local_terms(walk, v, at, δL * β, slope, frame_next, active)
            q_next = mi.Vector4f(q)
            target = e + dr.sum(δL * mi.Spectrum(L) * w) + sum(q_next[k] * x_next[k] for k in range(4))
            if dr.hint(dr.grad_enabled(target), mode="scalar"):  # not so where the camera alone moves
                backward(target)

        β, at, active = β_next, at_next, v.go_on
        depth += 1
