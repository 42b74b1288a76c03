"""The sweep driver: record a path vertex by vertex, then back-propagate from its last vertex to the first.

The record is in thread-local memory. Its size depends on ``max_depth`` and on the number of running threads, and not on
the number of paths. The reverse pass computes L_i = e_i + w_i L_{i+1} from the last vertex to the first, without
division or subtraction.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, RayDerivative, backward
from pathreplay.adjoint.baseline import BaselineStats
from pathreplay.adjoint.null_branching import branch_backward
from pathreplay.adjoint.record import Layout, deepest, record_type, room_for
from pathreplay.adjoint.two_passes import PathAdjoint, RecordedPath, record_path, sweep_path
from pathreplay.errors import PathreplayError
from pathreplay.transport.motion import along_moving_paths, path_moves
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


def sweep(
    trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter, seen: BaselineStats | None = None
) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into the parameters and into the ``start``.

    Returns whether the path moves with the parameters. ``lost`` counts the paths whose gradient is incomplete, for one
    of two reasons. In media, a path is truncated if null boundaries fill its record (see `room_for`). On a path that
    moves, a ray adjoint that is not finite is set to zero. ``seen`` accumulates the radiance in media, from which the
    baseline of later passes is computed. Weights that are exactly zero are differentiated. Not differentiated:
    visibility and, with ``attach='none'``, all motion.

    Raises PathreplayError if ``max_depth`` exceeds `deepest`, or if the paths depend on no parameter with gradients.
    """
    if trace.max_depth > deepest(trace):
        remedy = "adjoint = 'replay', which has no limit"
        raise PathreplayError(
            f"max_depth = {trace.max_depth} is more than adjoint = 'recorded' can hold ({deepest(trace)}): "
            + (f"use {remedy}" if trace.media is None else f"lower it or, if no parameter moves paths, use {remedy}")
        )
    path = PathState.begin(trace, start, sustained=True)
    ray0 = path.at.ray
    moves = path_moves(trace, start, path.at)
    trace = along_moving_paths(trace, moves)
    layout = Layout.of(trace, moves)
    records = dr.alloc_local(record_type(layout), room_for(trace))
    records, count, _, L, branch = record_path(trace, start.sampler, path, layout, records, mi.UInt32(0), lost)

    recorded = RecordedPath(layout, records, mi.UInt32(0), count, count - 1, ray0)
    q = sweep_path(trace, recorded, PathAdjoint(δL, L, RayDerivative.zero()), lost, seen).q
    if trace.branch:
        if seen is not None:
            seen.tally(branch.number)
        branch_backward(trace, branch, start.sampler, ray0, δL)
    with dr.resume_grad():
        o, d = start.repeat()
        if moves and dr.grad_enabled(o, d):
            dr.eval(q)  # otherwise, the sum over q for each camera parameter would repeat the loops
            backward(dr.dot(q.o, o) + dr.dot(q.d, d))
    return moves
