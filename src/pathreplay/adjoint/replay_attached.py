"""Attached path replay: also recover the adjoint of the ray, by inverting one 4x4 Jacobian per vertex.

The first pass stores L_0 and q_0 = δL·∂L_0/∂r_0. The second pass ("peeling") computes L and q of each next ray:

    β_{i+1} L_{i+1} = β_i L_i - β_i e_i,      (A_i + ε_i X_i)^T q_{i+1} = q_i - p_i,      A_i = ∂r_{i+1}/∂r_i,

where p_i = δL·∂(β_i e_i + β_i w_i L_{i+1})/∂r_i at fixed L_{i+1}. `Recovery` describes the noise ε_i X_i. The noise has
mean zero. Both passes use the same A_i + ε_i X_i, so that the noise does not change the expectation of q_0. This is the
attached estimator of Vicini, Speierer and Jakob (2021). The sweep driver computes q without inverting a matrix.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, backward
from pathreplay.adjoint.ray_jacobian import (
    PeeledPath,
    RayFrame,
    Recovery,
    length_scale,
    linearise,
    local_terms,
    random_sign,
)
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


def replay_attached(
    trace: TraceConfig, start: CameraStart, path: PathState, δL: mi.Spectrum, lost: NonFiniteCounter, recovery: Recovery
) -> None:
    """Back-propagate the adjoint radiance ``δL`` into the parameters and into the ``start`` of a ``path``.

    ``lost`` counts the paths on which an adjoint q was not finite and was set to zero. The recovery is exact on chains
    of delta lobes. At smooth lobes, A_i has rank two, and q can be recovered only with noise. The result is unbiased
    unless rounding errors, amplified by the inverse, exceed the noise. Not differentiated: visibility and zero weights.
    """
    scale = length_scale(trace.scene)
    again = start.sampler.clone()
    L, q = _tangents(trace, start.sampler, dr.copy(path), δL, recovery, scale)
    overflow = ~dr.all(dr.isfinite(q))
    q = dr.select(overflow, 0, q)
    with dr.resume_grad():
        o, d = start.repeat()
        if dr.grad_enabled(o, d):
            dr.eval(q, L, overflow)  # otherwise, each gradient of a camera parameter would repeat the first pass
            x = RayFrame.of(path.at.ray, scale).coordinates(o, d)
            q0 = mi.Vector4f(q)
            backward(sum((q0[k] * x[k] for k in range(1, 4)), q0[0] * x[0]))
    _peel(trace, again, path, PeeledPath(δL, L, q, overflow), lost, recovery, scale)


@dr.syntax
def _tangents(
    trace: TraceConfig, sampler: Sampler, path: PathState, δL: mi.Spectrum, recovery: Recovery, scale: float
) -> tuple[mi.Spectrum, mi.Vector4f]:
    """Run the first pass: compute L_0 and q_0 = δL·∂L_0/∂r_0."""
    Spectrum, Matrix, Vector = map(recovery.real, (mi.Spectrum, mi.Matrix4f, mi.Vector4f))
    L = Spectrum(0)  # radiance so far, without the factor δL
    q = Vector(0)
    J = Matrix(1)  # Jacobian ∂r_i/∂r_0 of the ray that arrives at vertex i
    κ = [Spectrum(0) for _ in range(4)]  # ∂ log β_i / ∂r_0, one spectrum for each of the four coordinates of r_0

    while dr.hint(path.active, exclude=[trace, recovery, scale], label="pathreplay: tangents"):
        u, step = path.choose(trace, sampler)
        onward, v = path.advance(trace, u, step)
        local = linearise(trace, v, onward, δL, scale, path.active)

        L += Spectrum(v.β * step.e)
        lit = Spectrum(δL) * Spectrum(v.β * step.e)
        q += Vector(J.T @ Vector(local.e)) + Vector(*[dr.sum(lit * k) for k in κ])
        κ = [κ[k] + sum(Spectrum(local.log_w[j]) * J[j, k] for j in range(4)) for k in range(4)]
        J = recovery.regularised(Matrix(local.A), random_sign(u), ~v.kept.delta) @ J
        path = onward

    return L, q


@dr.syntax
def _peel(
    trace: TraceConfig,
    sampler: Sampler,
    path: PathState,
    peeled: PeeledPath,
    lost: NonFiniteCounter,
    recovery: Recovery,
    scale: float,
) -> None:
    """Run the second pass: compute L and q of each ray in turn, and back-propagate into the parameters."""
    δL, L, q, overflow = peeled.δL, peeled.L, peeled.q, peeled.overflow
    Spectrum, Matrix, Vector = map(recovery.real, (mi.Spectrum, mi.Matrix4f, mi.Vector4f))
    broken = mi.Bool(False)  # true once ``lost`` has counted the path

    while dr.hint(path.active, exclude=[trace, recovery, scale, lost], label="pathreplay: replay"):
        u, step = path.choose(trace, sampler)
        onward, v = path.advance(trace, u, step)
        L = dr.select(v.go_on, L - Spectrum(v.β * step.e), 0)
        local = linearise(trace, v, onward, δL, scale, path.active)

        p = Vector(local.e) + Vector(*[dr.sum(Spectrum(δL) * L * Spectrum(k)) for k in local.log_w])
        A = recovery.regularised(Matrix(local.A), random_sign(u), ~v.kept.delta)
        q = dr.select(v.go_on, Vector(dr.rcp(A.T) @ (q - p)), 0)
        breaks = overflow | ~dr.all(dr.isfinite(q))
        q = dr.select(breaks, 0, q)
        lost.add(breaks & ~broken)
        broken |= breaks

        with dr.resume_grad():
            e, w, x_next = local_terms(trace, v, v.at, δL * v.β, local.slope, local.frame_next, path.active)
            q_next = mi.Vector4f(q)
            target = e + dr.sum(δL * mi.Spectrum(L) * w) + sum(q_next[k] * x_next[k] for k in range(4))
            if dr.hint(dr.grad_enabled(target), mode="scalar"):  # false if only the camera moves
                backward(target)

        path = onward
