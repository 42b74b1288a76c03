"""The forward driver: propagate tangents along the path, δL = Σ (δβ_i e_i + β_i δe_i), in a single pass."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, RayDerivative, forward_step, tangents
from pathreplay.adjoint.null_branching import Branch, branch_term
from pathreplay.transport.motion import along_moving_paths, path_moves
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


@dr.syntax
def forward(trace: TraceConfig, start: CameraStart, lost: NonFiniteCounter) -> tuple[mi.Spectrum, mi.Bool, bool]:
    """Compute the tangent of the radiance along the rays of a ``start``.

    The parameters must have tangents before the call. Returns ``(δL, valid, moves)``: tangent and alpha per ray, and
    whether paths move with the parameters. If paths move, ``lost`` counts the paths whose tangent was not finite and
    was set to zero. The recurrence δβ_{i+1} = δβ_i w_i + β_i δw_i contains no division, and is therefore correct where
    a weight is exactly zero. Not differentiated: visibility and, with ``attach='none'``, all motion.
    """
    with dr.resume_grad():
        δo, δd = tangents(*start.repeat())
    δ = RayDerivative(mi.Point3f(δo), mi.Vector3f(δd), mi.Float(0))  # tangent of the arrival

    δL = mi.Spectrum(0)  # tangent of the radiance
    δβ = mi.Spectrum(0)  # tangent of the throughput
    broken = mi.Bool(False)  # a tangent was not finite
    sampler = start.sampler
    path = PathState.begin(trace, start, sustained=True)
    ray0 = path.at.ray
    valid = mi.Bool(trace.background_is_opaque) & path.active
    moves = path_moves(trace, start, path.at)
    trace = along_moving_paths(trace, moves)
    branch = Branch.none(trace)

    while dr.hint(path.active, exclude=[trace, moves, lost], label="pathreplay: forward"):
        u, step = path.choose(trace, sampler)
        valid |= path.active & step.seen
        if dr.hint(trace.branch, mode="scalar"):
            branch = branch.offer(path, step)
        onward, v = path.advance(trace, u, step)
        again, δe, δw, δ, _ = forward_step(trace, v, moves, δ, path.active)
        if dr.hint(moves, mode="scalar"):
            δ, finite = δ.finite_part()
            lost.add(path.active & ~finite & ~broken)
            broken |= ~finite
        δL += δβ * again.e + path.β * δe
        δβ = (δβ * again.w + path.β * δw) * v.rr_weight
        path = onward

    if dr.hint(trace.branch, mode="scalar"):
        with dr.resume_grad():
            δL += tangents(branch_term(trace, branch, sampler, ray0))[0]
    return δL, valid, moves
