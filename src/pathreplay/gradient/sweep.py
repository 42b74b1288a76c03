"""The sweep driver: record a path vertex by vertex, then back-propagate from its last vertex to the first.

The record lives in thread-local memory: its size depends on ``max_depth`` and on the number of running threads, not
on the number of paths. On the way back L_i = e_i + w_i L_{i+1} is rebuilt, so nothing is divided or subtracted.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import PathreplayError
from ..transport.motion import path_moves
from ..transport.path import PathState
from ..transport.start import CameraStart
from ..transport.vertex import Walk
from .adjoint import LostPaths, RayDerivative, Replayed, backward, backward_step
from .baseline import Baseline
from .branch import Branch, branch_backward
from .record import Layout, read_back, record, record_type

# Deepest path that the thread-local record holds: 16 lanes x 2048 vertices x up to 136 bytes are 4.5 MB, and a
# thread's stack is 8 MB. Beyond the stack the process would die without a word.
MAX_DEPTH = 2048
# With media a vertex takes up to 210 bytes, and null boundaries have records of their own.
MAX_DEPTH_MEDIA = 1024
MAX_RECORDS_MEDIA = 2000


def deepest(walk: Walk) -> int:
    """The largest ``max_depth`` that the sweep driver can hold in this scene."""
    return MAX_DEPTH if walk.media is None else MAX_DEPTH_MEDIA


def room_for(walk: Walk) -> int:
    """How many vertices the record has room for: with media also two null boundaries at each, as convex ones need."""
    if walk.media is None:
        return max(walk.max_depth, 1)
    return min(3 * walk.max_depth + 8, MAX_RECORDS_MEDIA)


def sweep(
    walk: Walk,
    sampler: mi.Sampler,
    start: CameraStart,
    δL: mi.Spectrum,
    active: mi.Bool,
    lost: LostPaths,
    baseline: Baseline | None = None,
) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into the parameters, and into the ``start``.

    Returns whether the path moves with the parameters; if so, ``lost`` counts paths with an adjoint that was not
    finite, and those that crossed so many null boundaries between media that they had to end. ``baseline`` learns from
    this pass, for later ones. A weight that is exactly zero keeps its derivative. Not differentiated: visibility and,
    with ``attach='none'``, everything that moves.
    Raises PathreplayError when ``max_depth`` is above `deepest`, or when no parameter reaches the paths.
    """
    if walk.max_depth > deepest(walk):
        raise PathreplayError(
            f"max_depth = {walk.max_depth} is more than the sweep driver can hold ({deepest(walk)}): "
            "use driver = 'replay', which has no limit"
        )
    active = mi.Bool(active) & (walk.max_depth > 0)
    at = start.choose(walk, active)
    moves = path_moves(walk, start, at)
    layout = Layout.of(walk, moves)
    records = dr.alloc_local(record_type(layout), room_for(walk))
    path = PathState.begin(at, active, sustained=True)
    records, count, _, branch = first_walk(walk, sampler, path, layout, records, mi.UInt32(0), lost)

    first, L, q = mi.UInt32(0), mi.Spectrum(0), RayDerivative.zero()
    _, q = walk_back(walk, layout, records, first, count, count - 1, at.ray, δL, L, q, lost, baseline)
    if walk.branch:
        if baseline is not None:
            baseline.tally(branch.number)
        branch_backward(walk, branch, sampler, at.ray, δL)
    with dr.resume_grad():
        o, d = start.repeat()
        if moves and dr.grad_enabled(o, d):
            dr.eval(q)  # with the gradients in the scene: else each entry of a camera's matrix runs the kernel again
            backward(dr.dot(q.o, o) + dr.dot(q.d, d))
    return moves


@dr.syntax
def first_walk(
    walk: Walk, sampler: mi.Sampler, path: PathState, layout: Layout, records: Any, first: mi.UInt32, lost: LostPaths
) -> tuple[Any, mi.UInt32, mi.Spectrum, Branch]:
    """Record a path from ``first`` on; gives the records, their number, the radiance, and the branch.

    All lanes of a packet write to the same place: elsewhere writes to local memory get lost (Dr.Jit 1.5).
    """
    L = mi.Spectrum(0)  # radiance so far
    count = mi.UInt32(0)  # vertices, and null boundaries
    branch = Branch.none()

    while dr.hint(path.active, exclude=[walk, layout, lost], label="pathreplay: record"):
        u, step = path.choose(walk, sampler)
        onward, rr_weight = path.advance(walk, u, step)
        records[first + count] = record(layout, Replayed.of(path, u, step, onward, rr_weight))
        if dr.hint(walk.branch, mode="scalar"):
            branch = branch.offer(path, step)
        L += path.β * step.e
        path = onward
        count += 1
        if dr.hint(walk.media is not None, mode="scalar"):
            full = path.active & (count >= room_for(walk))
            lost.add(full)
            path.active &= ~full

    return records, count, L, branch


@dr.syntax
def walk_back(
    walk: Walk,
    layout: Layout,
    records: Any,
    first: mi.UInt32,
    count: mi.UInt32,
    last: mi.UInt32,
    ray0: mi.Ray3f,
    δL: mi.Spectrum,
    L: mi.Spectrum,
    q: RayDerivative,
    lost: LostPaths,
    baseline: Baseline | None = None,
) -> tuple[mi.Spectrum, RayDerivative]:
    """Back-propagate from the last of ``count`` records to the first; gives radiance and ray adjoint there.

    ``L`` is the radiance along the ray that leaves those records, and ``q`` its adjoint: zero where the path ends with
    them. ``last`` is the index of the path's last record, where that ray arrived or beyond.
    """
    broken = mi.Bool(False)  # a part of the adjoint was not finite

    while dr.hint(count > 0, exclude=[walk, layout, ray0, lost, baseline], label="pathreplay: sweep"):
        count -= 1
        v = read_back(layout, records, first + count, last, ray0)
        L, q, breaks = backward_step(walk, v, layout.moves, δL, L, q, mi.Bool(True))
        if dr.hint(baseline is not None, mode="scalar"):
            baseline.learn(v, L)  # type: ignore[union-attr]
        if dr.hint(layout.moves, mode="scalar"):
            lost.add(breaks & ~broken)
            broken |= breaks

    return L, q
