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
from ..transport.path import Walk, first_arrival, next_arrival, sustain, survival
from ..transport.step import surface_step
from ..transport.vertex import Arrival, Kept, Numbers, Options, Step

# Deepest path that the thread-local record holds: 16 lanes x 2048 vertices x about 100 bytes are 3.3 MB, and a
# thread's stack is 8 MB. Beyond the stack the process would die without a word.
MAX_DEPTH = 2048

# Bits of Record.flags: Dr.Jit's local memory cannot hold Bool.
HIT, DELTA, LIT = 1, 2, 4
LOBE_SHIFT = 8


@cache
def _record_type(variant: str, with_lobes: bool) -> type:
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
    if with_lobes:
        fields |= {"lobe": mi.Float, "direction": mi.Point2f}
    return make_dataclass("Record", list(fields.items()))


def _write(at: Arrival, u: Numbers, step: Step, β: Any, rr_weight: Any, options: Options) -> Any:
    with_lobes = options.lobes > 0
    flags = dr.select(at.hit.valid, mi.UInt32(HIT), 0)
    flags |= dr.select(at.delta, mi.UInt32(DELTA), 0)
    flags |= dr.select(step.kept.lit, mi.UInt32(LIT), 0)
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
    if with_lobes:
        fields |= {"lobe": u.lobe, "direction": u.direction}
    return _record_type(mi.variant(), with_lobes)(**fields)


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


def _read_numbers(record: Any, with_lobes: bool) -> Numbers:
    lobe = record.lobe if with_lobes else mi.Float(0)
    direction = record.direction if with_lobes else mi.Point2f(0)
    return Numbers(light=record.light, lobe=lobe, direction=direction, roulette=mi.Float(0))


@dr.syntax
def sweep(walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any) -> Any:
    """Back-propagate the adjoint radiance ``δL`` (Spectrum per ray) into the parameters; returns L (Spectrum per ray).

    Not differentiated: visibility and, with ``attach='none'``, all motion. A weight that is exactly zero keeps its
    derivative. Raises PathreplayError when ``max_depth`` is above `MAX_DEPTH`.
    """
    scene, options = walk.scene, walk.options
    with_lobes = options.lobes > 0
    if dr.hint(options.max_depth > MAX_DEPTH, mode="scalar"):
        raise PathreplayError(
            f"max_depth = {options.max_depth} is more than the sweep driver can hold ({MAX_DEPTH}): "
            "use driver = 'replay', which has no limit"
        )

    # ------------------ First pass: record the path -----------------

    tape = dr.alloc_local(_record_type(mi.variant(), with_lobes), max(options.max_depth, 1))
    β = mi.Spectrum(1)  # throughput
    β_alive = mi.Spectrum(1)  # throughput with one zero weight left out: what keeps the path going
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # index of the vertex
    active = mi.Bool(active) & (options.max_depth > 0)
    at = first_arrival(walk, ray, active)

    while dr.hint(active, max_iterations=options.max_depth, exclude=[walk, scene, options], label="pathreplay: record"):
        u = Numbers.draw(sampler)
        step = surface_step(scene, at, u, depth + 1 < options.max_depth, options, active)

        β_next = β * step.w
        β_alive = sustain(β_alive, β, step)
        η *= step.eta
        rr_weight, survives = survival(β_alive, η, depth, u.roulette, options)
        tape[depth] = _write(at, u, step, β, rr_weight, options)

        active = step.active & survives & (dr.max(β_alive) != 0)
        β = β_next * rr_weight
        β_alive *= rr_weight
        at = next_arrival(scene, step, active)
        depth += 1

    # ------------ Second pass: from the last vertex back ------------

    last = mi.UInt32(depth)  # number of vertices
    L = mi.Spectrum(0)  # radiance along the ray that leaves the vertex
    d_next = mi.Vector3f(0, 0, 1)  # that ray, as vertex i + 1 recorded it
    pdf_next = mi.Float(0)
    delta_next = mi.Bool(False)

    while dr.hint(depth > 0, exclude=[walk, scene, options], label="pathreplay: sweep"):
        has_next = depth < last
        depth -= 1
        record = tape[depth]
        at = _read_arrival(record, ray, depth == 0)
        kept = Kept(
            d=d_next,
            pdf=pdf_next,
            delta=delta_next,
            lobe=record.flags >> LOBE_SHIFT,
            lit=(record.flags & LIT) != 0,
        )
        with dr.resume_grad():
            step = surface_step(scene, at, _read_numbers(record, with_lobes), has_next, options, mi.Bool(True), kept)
            Lo = step.e + step.w * record.rr_weight * L
            backward(δL * record.β * Lo)

        L = dr.detach(Lo)
        d_next, pdf_next, delta_next = at.ray.d, at.pdf, at.delta

    return L


def backward(contribution: Any) -> None:
    """Back-propagate from a contribution to the image.

    Raises PathreplayError when no parameter with gradients reaches it: the gradient would silently be zero.
    """
    if not dr.grad_enabled(contribution):
        raise PathreplayError(
            "no parameter with gradients reaches the light paths: with attach = 'none' only materials, textures and "
            "lights are differentiated, and some values have no derivative at all (see mi.traverse(scene))"
        )
    dr.backward_from(contribution)
