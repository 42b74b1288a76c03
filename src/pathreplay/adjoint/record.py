"""The record of one path vertex in the sweep drivers: plain values in thread-local memory.

One table lists the recorded fields. The record type and the functions that write and read it are derived from the
table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, make_dataclass, replace
from functools import cache, reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.platform.device import Device, device_of
from pathreplay.transport.vertex import (
    Arrival,
    Flight,
    KnownLight,
    SampledContinuation,
    SampledInMedia,
    Shadow,
    TraceConfig,
    VertexRecord,
    VertexSamples,
)

# Largest depth for which a path is recorded in thread-local memory. 16 lanes x 2048 vertices x up to 136 bytes are
# 4.5 MB, and a thread's stack has 8 MB. A stack overflow would terminate the process without a message.
MAX_DEPTH = 2048
LARGEST_RECORD = 136
"""Bytes per vertex without media, in rgb variants."""
# With media, a vertex takes up to 210 bytes, and null boundaries are recorded like vertices.
MAX_DEPTH_MEDIA = 1024
MAX_RECORDS_MEDIA = 2000


def deepest(trace: TraceConfig, device: Device | None = None) -> int:
    """Return the largest ``max_depth`` for which the sweep driver can record paths, on the active variant's device.

    On a GPU, the records may use only a fraction of the memory (see `pathreplay.platform.device`).
    """
    device = device_of(mi.variant()) if device is None else device
    if not device.is_gpu:
        return MAX_DEPTH if trace.media is None else MAX_DEPTH_MEDIA
    if trace.media is None:
        return device.most_records(largest_record(trace), MAX_DEPTH)
    return min(MAX_DEPTH_MEDIA, max((device.most_records(largest_record(trace), 2**30) - 8) // 3, 0))


def recordable(trace: TraceConfig) -> TraceConfig:
    """Return the configuration with a ``max_depth`` of at most `deepest`."""
    return replace(trace, max_depth=min(trace.max_depth, deepest(trace)))


def largest_record(trace: TraceConfig) -> int:
    """Return the bytes per vertex of the larger layout: static paths and moving paths have different layouts."""
    return max(_bytes(Layout.of(trace, moves)) for moves in (False, True))


def _bytes(layout: Layout) -> int:
    kinds = [_plain(kind) for _, kind, remembered in FIELDS if getattr(layout, remembered)]
    return 4 * sum(dr.size_v(kind) if dr.depth_v(kind) > 1 else 1 for kind in kinds) + 4  # 4 bytes for `BITS`


def room_for(trace: TraceConfig) -> int:
    """Return the number of records that are allocated per path.

    With media, this number allows for two null boundaries per vertex: a ray crosses the boundary of a convex medium at
    most twice.
    """
    if trace.media is None:
        return device_of(mi.variant()).room(max(trace.max_depth, 1))
    return min(3 * trace.max_depth + 8, MAX_RECORDS_MEDIA)


@dataclass(frozen=True)
class Layout:
    """The properties of a trace that determine which fields are recorded."""

    variant: str
    moves: bool  # the path moves with the parameters
    resamples: bool  # the passes that read the records sample BSDFs again
    fixed: bool  # radiance from emitters is recorded as a value, and rays that leave the scene have no vertex
    glows: bool  # emission at vertices is recorded: ``fixed`` is true, and some emitter is a surface
    media: bool
    chromatic: bool
    emissive: bool
    passes: bool
    branch: bool
    splits: bool  # the paths omit caustics: see `TraceConfig.without_caustics`
    always: bool = True  # always true: in `FIELDS` and `BITS`, it marks the fields that every record contains

    @property
    def varies(self) -> bool:
        """Whether the passes that read the records evaluate emitters again."""
        return not self.fixed

    @staticmethod
    def of(trace: TraceConfig, moves: bool) -> Layout:
        media = trace.media is not None
        fixed = not media and not moves and not trace.traits.lights_vary and trace.to_sensor is None
        kinds = {name: media and getattr(trace.media, name) for name in ("chromatic", "emissive", "passes")}
        glows, resamples = fixed and trace.traits.area_lights, trace.resamples or media
        splits = trace.without_caustics
        return Layout(
            mi.variant(), moves, resamples, fixed, glows, media=media, branch=trace.branch, splits=splits, **kinds
        )


# Each entry names a field of `VertexRecord`, the field's type in Mitsuba, and a property of `Layout`. The field is
# recorded if this property is true.
FIELDS = (
    ("at.ray.o", "Point3f", "always"),
    ("at.ray.d", "Vector3f", "always"),
    ("at.hit.t", "Float", "always"),
    ("at.hit.prim_uv", "Point2f", "always"),
    ("at.hit.prim_index", "UInt32", "always"),
    ("at.hit.shape_index", "UInt32", "always"),
    ("at.hit.shape", "ShapePtr", "always"),
    ("at.hit.instance", "ShapePtr", "always"),
    ("at.pdf", "Float", "varies"),
    ("at.medium", "MediumPtr", "media"),
    ("at.behind", "Float", "media"),
    ("β", "Spectrum", "always"),
    ("rr_weight", "Float", "always"),
    ("u.light", "Point2f", "varies"),
    ("u.lobe", "Float", "resamples"),
    ("u.direction", "Point2f", "resamples"),
    ("kept.known.glow", "Spectrum", "glows"),
    ("kept.known.d", "Vector3f", "fixed"),
    ("kept.known.w", "Spectrum", "fixed"),
    ("kept.d", "Vector3f", "fixed"),
    ("kept.pdf", "Float", "fixed"),
    ("kept.pdf", "Float", "passes"),
    ("kept.media.flight.t", "Float", "media"),
    ("kept.media.flight.density", "Float", "media"),
    ("kept.media.flight.along", "Float", "media"),
    ("kept.media.flight.W", "Spectrum", "chromatic"),
    ("kept.media.flight.E", "Spectrum", "emissive"),
    ("kept.media.flight.t_emit", "Float", "emissive"),
    ("kept.media.flight.c_emit", "Spectrum", "emissive"),
    ("kept.media.flight.p", "Float", "branch"),
    ("kept.media.shadow.T", "Spectrum", "media"),
    ("kept.media.shadow.y", "Float", "media"),
    ("kept.media.shadow.medium", "MediumPtr", "media"),
    ("kept.media.shadow.length", "Float", "media"),
)

# Dr.Jit's local memory does not support Bool. Each of these fields is therefore one bit of an integer. The upper bits
# of the integer contain the BSDF component that was sampled.
BITS = (
    ("at.hit.valid", "always"),
    ("at.delta", "varies"),
    ("at.camera", "always"),
    ("at.scattered", "splits"),
    ("kept.lit", "always"),
    ("kept.black", "always"),
    ("kept.delta", "fixed"),
    ("go_on", "fixed"),
    ("kept.media.flight.event", "media"),
    ("kept.media.null", "media"),
)
LOBE_SHIFT = 16


@cache
def record_type(layout: Layout) -> type[object]:
    """Return the dataclass of a recorded vertex."""
    kept = {_name(place): _plain(kind) for place, kind, remembered in FIELDS if getattr(layout, remembered)}
    return make_dataclass("Record", [*kept.items(), ("word", mi.UInt32)])


def record(layout: Layout, v: VertexRecord) -> object:
    """Convert a vertex to its record."""
    kept = {}
    for place, kind, remembered in FIELDS:
        if getattr(layout, remembered):
            value = reduce(getattr, place.split("."), v)
            kept[_name(place)] = dr.reinterpret_array(mi.UInt32, value) if kind.endswith("Ptr") else value
    word = v.kept.lobe << LOBE_SHIFT
    for k, (place, remembered) in enumerate(BITS):
        if getattr(layout, remembered):
            word |= dr.select(reduce(getattr, place.split("."), v), mi.UInt32(1 << k), 0)
    make: Callable[..., object] = record_type(layout)
    return make(**kept, word=word)


def read_back(
    layout: Layout, records: dr.Local[object], index: mi.UInt32, last: mi.UInt32, ray0: mi.Ray3f
) -> VertexRecord:
    """Read the vertex recorded at ``index``.

    ``last`` is the index of the path's last vertex. Time and wavelengths are taken from ``ray0``.
    """
    v = _read(layout, records[index], ray0)
    if layout.fixed:
        return v
    onward = _read(layout, records[dr.minimum(index + 1, last)], ray0).at
    # The record of the next vertex contains the direction in which the path continues at this vertex.
    kept = replace(v.kept, d=onward.ray.d, delta=onward.delta)
    if layout.passes:
        kept.delta |= kept.media.null
    else:
        kept.pdf = onward.pdf
    return replace(v, kept=kept, go_on=index < last, hit_next=onward.hit)


def _read(layout: Layout, read: Any, ray0: mi.Ray3f) -> VertexRecord:
    v = _blank(layout, ray0)
    for place, kind, remembered in FIELDS:
        if getattr(layout, remembered):
            value = getattr(read, _name(place))
            _put(v, place, dr.reinterpret_array(getattr(mi, kind), value) if kind.endswith("Ptr") else value)
    for k, (place, remembered) in enumerate(BITS):
        if getattr(layout, remembered):
            _put(v, place, (read.word & (1 << k)) != 0)
    v.kept.lobe = read.word >> LOBE_SHIFT
    return v


def _blank(layout: Layout, ray0: mi.Ray3f) -> VertexRecord:
    """Create a vertex with default values, in which `_read` replaces the recorded fields."""
    zero, no = mi.Float(0), mi.Bool(False)
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0), ray0.time, ray0.wavelengths)
    at = Arrival(ray, dr.zeros(mi.PreliminaryIntersection3f), zero, no, no)
    if layout.splits:
        at.scattered = no
    kept = SampledContinuation(mi.Vector3f(0), zero, no, no, mi.UInt32(0), no)
    if layout.fixed:
        kept.known = KnownLight(mi.Spectrum(0), mi.Vector3f(0), mi.Spectrum(0))
    if layout.media:
        flight = Flight(no, zero, zero, mi.Spectrum(1), zero)
        kept.media = SampledInMedia(no, flight, Shadow(mi.Spectrum(0), zero, dr.zeros(mi.MediumPtr), zero))
    u = VertexSamples(mi.Point2f(0), zero, mi.Point2f(0), zero)
    return VertexRecord(at, u, kept, no, at.hit, zero, mi.Spectrum(0))


def _put(v: VertexRecord, place: str, value: object) -> None:
    *way, name = place.split(".")
    setattr(reduce(getattr, way, v), name, value)


def _name(place: str) -> str:
    return place.replace(".", "_")


def _plain(kind: str) -> type:
    return mi.UInt32 if kind.endswith("Ptr") else getattr(mi, kind)
