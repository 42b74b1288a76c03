"""The sweep driver: record a path vertex by vertex, then back-propagate from its last vertex to the camera.

The record lives in thread-local memory: its size depends on ``max_depth`` and on the number of running threads, not
on the number of paths. On the way back L_i = e_i + w_i L_{i+1} is rebuilt, so nothing is divided or subtracted.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import PathreplayError
from ..transport.motion import path_moves
from ..transport.path import count, first_arrival, next_arrival, survival, sustain, take_step
from ..transport.vertex import Numbers, Walk
from .adjoint import LostPaths, RayDerivative, backward, backward_step
from .branch import Branch, branch_backward
from .record import read_back, record, record_type

# Deepest path that the thread-local record holds: 16 lanes x 2048 vertices x up to 136 bytes are 4.5 MB, and a
# thread's stack is 8 MB. Beyond the stack the process would die without a word.
MAX_DEPTH = 2048
# With media a vertex takes up to 210 bytes, and null boundaries have records of their own.
MAX_DEPTH_MEDIA = 1024
MAX_RECORDS_MEDIA = 2000


def deepest(walk: Walk) -> int:
    """The largest ``max_depth`` that the sweep driver can hold in this scene."""
    return MAX_DEPTH if walk.media is None else MAX_DEPTH_MEDIA


def _records(walk: Walk) -> int:
    """How many vertices the record has room for: with media also two null boundaries at each, as convex ones need."""
    if walk.media is None:
        return max(walk.max_depth, 1)
    return min(3 * walk.max_depth + 8, MAX_RECORDS_MEDIA)


@dr.syntax
def sweep(walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any, lost: LostPaths, baseline: Any = None) -> bool:
    """Back-propagate the adjoint radiance ``δL`` (Spectrum per ray) into the parameters.

    ``ray`` may be attached to the camera. Returns whether the path moves with the parameters; if so, ``lost`` counts
    paths with an adjoint that was not finite, and those that crossed so many null boundaries between media that they
    had to end. ``baseline`` learns from this pass, for later ones. A weight that is exactly zero keeps its derivative.
    Not differentiated: visibility and, with ``attach='none'``, everything that moves.
    Raises PathreplayError when ``max_depth`` is above `deepest`, or when no parameter reaches the paths.
    """
    if dr.hint(walk.max_depth > deepest(walk), mode="scalar"):
        raise PathreplayError(
            f"max_depth = {walk.max_depth} is more than the sweep driver can hold ({deepest(walk)}): "
            "use driver = 'replay', which has no limit"
        )

    # ------------------ First pass: record the path -----------------

    β = mi.Spectrum(1)  # throughput
    β_alive = mi.Spectrum(1)  # throughput with one zero weight left out: what keeps the path going
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # vertices before
    records = mi.UInt32(0)  # as many, and null boundaries
    active = mi.Bool(active) & (walk.max_depth > 0)
    at = first_arrival(walk, ray, active)
    attached = path_moves(walk, ray, at)
    room = _records(walk)
    tape = dr.alloc_local(record_type(walk, attached), room)
    camera_ray = dr.detach(ray)
    branch = Branch.none()

    while dr.hint(active, exclude=[walk], label="pathreplay: record"):
        u = Numbers.draw(sampler)
        step = take_step(walk, at, u, sampler, β_alive, depth + 1 < walk.max_depth, active)

        β_alive = sustain(β_alive, β, step)
        η *= step.kept.eta
        rr_weight, survives = survival(β_alive, η, depth, u.roulette, walk, step)
        tape[records] = record(walk, attached, at, u, step, β, rr_weight)
        if dr.hint(walk.branch, mode="scalar"):
            branch = branch.offer(at, step, β, depth, η, active)

        active = step.active & survives & (dr.max(β_alive) != 0)
        β *= step.w * rr_weight
        β_alive *= rr_weight
        at = next_arrival(walk, at, step, active)
        depth += count(walk, step)
        records += 1
        if dr.hint(walk.media is not None, mode="scalar"):
            full = active & (records >= room)
            lost.add(full)
            active &= ~full

    # ------------ Second pass: from the last vertex back ------------

    last = records - 1  # index of the last vertex
    L = mi.Spectrum(0)  # radiance along the ray that leaves the vertex
    q = RayDerivative.zero()  # adjoint of that ray
    broken = mi.Bool(False)  # a part of the adjoint was not finite

    while dr.hint(records > 0, exclude=[walk, ray, camera_ray, lost, baseline], label="pathreplay: sweep"):
        records -= 1
        replayed, β_before = read_back(walk, tape, records, last, camera_ray)
        L, q, breaks = backward_step(walk, replayed, attached, δL * β_before, L, q, mi.Bool(True))
        if dr.hint(baseline is not None, mode="scalar"):
            baseline.learn(replayed, L)
        if dr.hint(attached, mode="scalar"):
            lost.add(breaks & ~broken)
            broken |= breaks

    # ---------------------- The path that branched --------------------

    if dr.hint(walk.branch, mode="scalar"):
        if dr.hint(baseline is not None, mode="scalar"):
            baseline.tally(branch.number)
        branch_backward(walk, branch, sampler, camera_ray, δL)

    # ----------------------- Back to the camera ----------------------

    with dr.resume_grad():
        if dr.hint(attached and dr.grad_enabled(ray.o, ray.d), mode="scalar"):
            dr.eval(q)  # every parameter of the camera sums over it apart, which would run the loops as often
            backward(dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d))
    return attached
