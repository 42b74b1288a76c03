"""The sweep driver: record a path vertex by vertex, then back-propagate from its last vertex to the camera.

The record lives in thread-local memory: its size depends on ``max_depth`` and on the number of running threads, not
on the number of paths. On the way back L_i = e_i + w_i L_{i+1} is rebuilt, so nothing is divided or subtracted.
"""

from __future__ import annotations

from dataclasses import make_dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import PathreplayError
from ..transport.motion import path_moves
from ..transport.path import first_arrival, next_arrival, survival, sustain
from ..transport.step import surface_step
from ..transport.vertex import Arrival, Kept, Numbers, Step, Walk
from .adjoint import LostPaths, RayDerivative, Replayed, backward, backward_step

# Deepest path that the thread-local record holds: 16 lanes x 2048 vertices x about 100 bytes are 3.3 MB, and a
# thread's stack is 8 MB. Beyond the stack the process would die without a word.
MAX_DEPTH = 2048

# Bits of Record.flags: Dr.Jit's local memory cannot hold Bool.
HIT, DELTA, LIT, BLACK = 1, 2, 4, 8
LOBE_SHIFT = 8


@cache
def _record_type(variant: str, resamples: bool) -> type:
    fields = {
        "o": mi.Point3f,  # ray
        "d": mi.Vector3f,
        "t": mi.Float,  # preliminary intersection
        "uv": mi.Point2f,
        "prim_index": mi.UInt32,
        "shape_index": mi.UInt32,
        "shape": mi.UInt32,
        "instance": mi.UInt32,
        "pdf": mi.Float,  # of ray.d
        "β": mi.Spectrum,  # throughput before the vertex
        "rr_weight": mi.Float,  # 1 / survival probability after the vertex
        "light": mi.Point2f,  # random numbers
        "flags": mi.UInt32,
    }
    if resamples:
        fields |= {"lobe": mi.Float, "direction": mi.Point2f}
    return make_dataclass("Record", list(fields.items()))


def _write(at: Arrival, u: Numbers, step: Step, β: Any, rr_weight: Any, walk: Walk) -> Any:
    flags = dr.select(at.hit.valid, mi.UInt32(HIT), 0)
    flags |= dr.select(at.delta, mi.UInt32(DELTA), 0)
    flags |= dr.select(step.kept.lit, mi.UInt32(LIT), 0)
    flags |= dr.select(step.kept.black, mi.UInt32(BLACK), 0)
    flags |= step.kept.lobe << LOBE_SHIFT
    fields = {
        "o": at.ray.o,
        "d": at.ray.d,
        "t": at.hit.t,
        "uv": at.hit.prim_uv,
        "prim_index": at.hit.prim_index,
        "shape_index": at.hit.shape_index,
        "shape": dr.reinterpret_array(mi.UInt32, at.hit.shape),
        "instance": dr.reinterpret_array(mi.UInt32, at.hit.instance),
        "pdf": at.pdf,
        "β": β,
        "rr_weight": rr_weight,
        "light": u.light,
        "flags": flags,
    }
    if walk.resamples:
        fields |= {"lobe": u.lobe, "direction": u.direction}
    return _record_type(mi.variant(), walk.resamples)(**fields)


def _read_arrival(record: Any, ray0: Any, camera: Any) -> Arrival:
    ray = mi.Ray3f(record.o, record.d, ray0.time, ray0.wavelengths)
    hit = dr.zeros(mi.PreliminaryIntersection3f)
    hit.valid = (record.flags & HIT) != 0
    hit.t = record.t
    hit.prim_uv = record.uv
    hit.prim_index = record.prim_index
    hit.shape_index = record.shape_index
    hit.shape = dr.reinterpret_array(mi.ShapePtr, record.shape)
    hit.instance = dr.reinterpret_array(mi.ShapePtr, record.instance)
    return Arrival(ray=ray, hit=hit, pdf=record.pdf, delta=(record.flags & DELTA) != 0, camera=camera)


def _read_numbers(record: Any, walk: Walk) -> Numbers:
    lobe = record.lobe if walk.resamples else mi.Float(0)
    direction = record.direction if walk.resamples else mi.Point2f(0)
    return Numbers(light=record.light, lobe=lobe, direction=direction, roulette=mi.Float(0))


def _read_continuation(record: Any, onward: Arrival) -> Kept:
    return Kept(
        d=onward.ray.d,
        pdf=onward.pdf,
        delta=onward.delta,
        black=(record.flags & BLACK) != 0,
        lobe=record.flags >> LOBE_SHIFT,
        lit=(record.flags & LIT) != 0,
    )


@dr.syntax
def sweep(walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any, lost: LostPaths) -> bool:
    """Back-propagate the adjoint radiance ``δL`` (Spectrum per ray) into the parameters.

    ``ray`` may be attached to the camera. Returns whether the path moves with the parameters; if so, ``lost`` counts
    paths with an adjoint that was not finite. A weight that is exactly zero keeps its derivative. Not differentiated:
    visibility and, with ``attach='none'``, everything that moves.
    Raises PathreplayError when ``max_depth`` is above `MAX_DEPTH`, or when no parameter reaches the paths.
    """
    if dr.hint(walk.max_depth > MAX_DEPTH, mode="scalar"):
        raise PathreplayError(
            f"max_depth = {walk.max_depth} is more than the sweep driver can hold ({MAX_DEPTH}): "
            "use driver = 'replay', which has no limit"
        )

    # ------------------ First pass: record the path -----------------

    tape = dr.alloc_local(_record_type(mi.variant(), walk.resamples), max(walk.max_depth, 1))
    β = mi.Spectrum(1)  # throughput
    β_alive = mi.Spectrum(1)  # throughput with one zero weight left out: what keeps the path going
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # index of the vertex
    active = mi.Bool(active) & (walk.max_depth > 0)
    at = first_arrival(walk, ray, active)
    attached = path_moves(walk, ray, at)
    camera_ray = dr.detach(ray)

    while dr.hint(active, max_iterations=walk.max_depth, exclude=[walk], label="pathreplay: record"):
        u = Numbers.draw(sampler)
        step = surface_step(walk, at, u, depth + 1 < walk.max_depth, active)

        β_alive = sustain(β_alive, β, step)
        η *= step.kept.eta
        rr_weight, survives = survival(β_alive, η, depth, u.roulette, walk)
        tape[depth] = _write(at, u, step, β, rr_weight, walk)

        active = step.active & survives & (dr.max(β_alive) != 0)
        β *= step.w * rr_weight
        β_alive *= rr_weight
        at = next_arrival(walk, step, active)
        depth += 1

    # ------------ Second pass: from the last vertex back ------------

    last = depth - 1  # index of the last vertex
    L = mi.Spectrum(0)  # radiance along the ray that leaves the vertex
    q = RayDerivative.zero()  # adjoint of that ray
    broken = mi.Bool(False)  # a part of the adjoint was not finite

    while dr.hint(depth > 0, exclude=[walk, ray, camera_ray, lost], label="pathreplay: sweep"):
        depth -= 1
        record = tape[depth]
        onward = _read_arrival(tape[dr.minimum(depth + 1, last)], camera_ray, mi.Bool(False))
        replayed = Replayed(
            at=_read_arrival(record, camera_ray, depth == 0),
            u=_read_numbers(record, walk),
            kept=_read_continuation(record, onward),
            go_on=depth < last,
            hit_next=onward.hit,
            rr_weight=record.rr_weight,
        )
        L, q, breaks = backward_step(walk, replayed, attached, δL * record.β, L, q, mi.Bool(True))
        if dr.hint(attached, mode="scalar"):
            lost.add(breaks & ~broken)
            broken |= breaks

    # ----------------------- Back to the camera ----------------------

    with dr.resume_grad():
        if dr.hint(attached and dr.grad_enabled(ray.o, ray.d), mode="scalar"):
            backward(dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d))
    return attached
