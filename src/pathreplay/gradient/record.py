"""One vertex of a path as the sweep driver remembers it: plain numbers, for thread-local memory."""

from __future__ import annotations

from dataclasses import make_dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.flight import Flight
from ..transport.shadow import Shadow
from ..transport.vertex import Arrival, Kept, Numbers, Step, Walk
from .adjoint import Replayed

# Bits of Record.flags: Dr.Jit's local memory cannot hold Bool.
HIT, DELTA, LIT, BLACK, CAMERA, EVENT, NULL = 1, 2, 4, 8, 16, 32, 64
LOBE_SHIFT = 8


def record_type(walk: Walk, attached: bool) -> type:
    """The fields that the records of this walk have; ``attached`` says that the path moves with the parameters."""
    media = walk.media
    fixed = media is None and not attached and not walk.traits.lights_vary
    return _record_type(
        mi.variant(), walk.resamples or media is not None, media is not None, bool(media and media.chromatic),
        bool(media and media.emissive), bool(media and media.passes), walk.branch, fixed,
    )  # fmt: skip


@cache
def _record_type(
    variant: str,
    resamples: bool,
    media: bool,
    chromatic: bool,
    emissive: bool,
    passes: bool,
    branch: bool,
    fixed: bool,
) -> type:
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
        "flags": mi.UInt32,
    }
    if fixed:
        fields |= {"glow": mi.Spectrum, "light_d": mi.Vector3f, "light_w": mi.Spectrum}
    else:
        fields |= {"light": mi.Point2f}  # random numbers
    if resamples:
        fields |= {"lobe": mi.Float, "direction": mi.Point2f}
    if media:
        fields |= {
            "medium": mi.UInt32,
            "behind": mi.Float,
            "t_event": mi.Float,  # flight
            "density": mi.Float,
            "along": mi.Float,
            "T": mi.Spectrum,  # shadow
            "y": mi.Float,
            "y_medium": mi.UInt32,
            "length": mi.Float,
        }
    if chromatic:
        fields |= {"W": mi.Spectrum}
    if emissive:
        fields |= {"E": mi.Spectrum, "t_emit": mi.Float, "c_emit": mi.Spectrum}
    if passes:
        fields |= {"chance": mi.Float}  # density of the continuation, also where it passes straight through
    if branch:
        fields |= {"p": mi.Float}
    return make_dataclass("Record", list(fields.items()))


def record(walk: Walk, attached: bool, at: Arrival, u: Numbers, step: Step, β: Any, rr_weight: Any) -> Any:
    """A vertex, to be written."""
    kept = step.kept
    bits = {HIT: at.hit.valid, DELTA: at.delta, LIT: kept.lit, BLACK: kept.black, CAMERA: at.camera}
    if walk.media is not None:
        bits |= {EVENT: kept.flight.event, NULL: kept.null}
    flags = kept.lobe << LOBE_SHIFT
    for bit, value in bits.items():
        flags |= dr.select(value, mi.UInt32(bit), 0)
    Record = record_type(walk, attached)
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
        "glow": kept.glow,
        "light_d": kept.light_d,
        "light_w": kept.light_w,
        "flags": flags,
        "lobe": u.lobe,
        "direction": u.direction,
    }
    if walk.media is not None:
        flight, dark = kept.flight, kept.shadow
        fields |= {
            "medium": dr.reinterpret_array(mi.UInt32, at.medium),
            "behind": at.behind,
            "t_event": flight.t,
            "density": flight.density,
            "along": flight.along,
            "T": dark.T,
            "y": dark.y,
            "y_medium": dr.reinterpret_array(mi.UInt32, dark.medium),
            "length": dark.length,
            "W": flight.W,
            "E": flight.E,
            "t_emit": flight.t_emit,
            "c_emit": flight.c_emit,
            "chance": kept.pdf,
            "p": flight.p,
        }
    names = Record.__dataclass_fields__  # type: ignore[attr-defined]
    return Record(**{name: value for name, value in fields.items() if name in names})


@cache
def _end_type(variant: str) -> type:
    return make_dataclass("End", {"L": mi.Spectrum, "records": mi.UInt32}.items())


def end_type() -> type:
    """What is kept of a path that has ended, where many are recorded: its radiance, and its number of records."""
    return _end_type(mi.variant())


def read_back(walk: Walk, tape: Any, index: Any, last: Any, ray0: Any) -> tuple[Replayed, Any]:
    """The vertex recorded at ``index`` (UInt32), and the throughput before it (Spectrum).

    ``last`` is the index of the path's last vertex; time and wavelengths are those of the camera ray ``ray0``.
    """
    read = tape[index]
    onward = _arrival(walk, tape[dr.minimum(index + 1, last)], ray0)
    vertex = Replayed(
        at=_arrival(walk, read, ray0),
        u=_numbers(walk, read),
        kept=_continuation(walk, read, onward),
        go_on=index < last,
        hit_next=onward.hit,
        rr_weight=read.rr_weight,
    )
    return vertex, read.β


def _arrival(walk: Walk, read: Any, ray0: Any) -> Arrival:
    """How the path came to the recorded vertex; time and wavelengths are those of the camera ray ``ray0``."""
    hit = dr.zeros(mi.PreliminaryIntersection3f)
    hit.valid = (read.flags & HIT) != 0
    hit.t = read.t
    hit.prim_uv = read.uv
    hit.prim_index = read.prim_index
    hit.shape_index = read.shape_index
    hit.shape = dr.reinterpret_array(mi.ShapePtr, read.shape)
    hit.instance = dr.reinterpret_array(mi.ShapePtr, read.instance)
    at = Arrival(
        ray=mi.Ray3f(read.o, read.d, ray0.time, ray0.wavelengths),
        hit=hit,
        pdf=read.pdf,
        delta=(read.flags & DELTA) != 0,
        camera=(read.flags & CAMERA) != 0,
    )
    if walk.media is not None:
        at.medium, at.behind = dr.reinterpret_array(mi.MediumPtr, read.medium), read.behind
    return at


def _numbers(walk: Walk, read: Any) -> Numbers:
    """The random numbers that later passes need."""
    again = walk.resamples or walk.media is not None
    lobe, direction = (read.lobe, read.direction) if again else (mi.Float(0), mi.Point2f(0))
    light = getattr(read, "light", mi.Point2f(0))
    return Numbers(light=light, lobe=lobe, direction=direction, roulette=mi.Float(0))


def _continuation(walk: Walk, read: Any, onward: Arrival) -> Kept:
    """What the first walk chose at the recorded vertex; ``onward`` is the arrival at the next."""
    kept = Kept(
        d=onward.ray.d,
        pdf=onward.pdf,
        delta=onward.delta,
        black=(read.flags & BLACK) != 0,
        lobe=read.flags >> LOBE_SHIFT,
        lit=(read.flags & LIT) != 0,
    )
    if hasattr(read, "glow"):
        kept.glow, kept.light_d, kept.light_w = read.glow, read.light_d, read.light_w
    if walk.media is None:
        return kept
    kept.null = (read.flags & NULL) != 0
    if walk.media.passes:
        kept.pdf, kept.delta = read.chance, kept.delta | kept.null
    kept.flight = Flight(
        event=(read.flags & EVENT) != 0,
        t=read.t_event,
        density=read.density,
        W=read.W if walk.media.chromatic else mi.Spectrum(1),
        along=read.along,
        p=read.p if walk.branch else None,
    )
    if walk.media.emissive:
        kept.flight.E, kept.flight.t_emit, kept.flight.c_emit = read.E, read.t_emit, read.c_emit
    y_medium = dr.reinterpret_array(mi.MediumPtr, read.y_medium)
    kept.shadow = Shadow(T=read.T, y=read.y, medium=y_medium, length=read.length)
    return kept
