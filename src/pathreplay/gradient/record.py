"""One vertex of a path as the sweep drivers remember it: plain numbers, for thread-local memory.

What is remembered stands in one table, from which the type of a record, its writing and its reading follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, make_dataclass, replace
from functools import cache, reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.vertex import Arrival, Flight, Kept, KeptInMedia, KnownLight, Numbers, Shadow, Walk
from .adjoint import Replayed

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


@dataclass(frozen=True)
class Layout:
    """What the walk decides about its records."""

    variant: str
    moves: bool  # the path moves with the parameters
    resamples: bool  # BSDFs are sampled once more
    fixed: bool  # what emitters bring to surfaces is known
    media: bool
    chromatic: bool
    emissive: bool
    passes: bool
    branch: bool

    @staticmethod
    def of(walk: Walk, moves: bool) -> Layout:
        """The layout for a walk."""
        media = walk.media
        return Layout(
            variant=mi.variant(),
            moves=moves,
            resamples=walk.resamples or media is not None,
            fixed=media is None and not moves and not walk.traits.lights_vary,
            media=media is not None,
            chromatic=media is not None and media.chromatic,
            emissive=media is not None and media.emissive,
            passes=media is not None and media.passes,
            branch=walk.branch,
        )


Condition = Callable[[Layout], bool]


def _always(layout: Layout) -> bool:
    return True


def _media(layout: Layout) -> bool:
    return layout.media


# Where it stands in a Replayed, its type in Mitsuba, and whether it is remembered.
FIELDS: tuple[tuple[str, str, Condition], ...] = (
    ("at.ray.o", "Point3f", _always),
    ("at.ray.d", "Vector3f", _always),
    ("at.hit.t", "Float", _always),
    ("at.hit.prim_uv", "Point2f", _always),
    ("at.hit.prim_index", "UInt32", _always),
    ("at.hit.shape_index", "UInt32", _always),
    ("at.hit.shape", "ShapePtr", _always),
    ("at.hit.instance", "ShapePtr", _always),
    ("at.pdf", "Float", _always),
    ("at.medium", "MediumPtr", _media),
    ("at.behind", "Float", _media),
    ("β", "Spectrum", _always),
    ("rr_weight", "Float", _always),
    ("u.light", "Point2f", lambda layout: not layout.fixed),
    ("u.lobe", "Float", lambda layout: layout.resamples),
    ("u.direction", "Point2f", lambda layout: layout.resamples),
    ("kept.known.glow", "Spectrum", lambda layout: layout.fixed),
    ("kept.known.d", "Vector3f", lambda layout: layout.fixed),
    ("kept.known.w", "Spectrum", lambda layout: layout.fixed),
    ("kept.pdf", "Float", lambda layout: layout.passes),
    ("kept.media.flight.t", "Float", _media),
    ("kept.media.flight.density", "Float", _media),
    ("kept.media.flight.along", "Float", _media),
    ("kept.media.flight.W", "Spectrum", lambda layout: layout.chromatic),
    ("kept.media.flight.E", "Spectrum", lambda layout: layout.emissive),
    ("kept.media.flight.t_emit", "Float", lambda layout: layout.emissive),
    ("kept.media.flight.c_emit", "Spectrum", lambda layout: layout.emissive),
    ("kept.media.flight.p", "Float", lambda layout: layout.branch),
    ("kept.media.shadow.T", "Spectrum", _media),
    ("kept.media.shadow.y", "Float", _media),
    ("kept.media.shadow.medium", "MediumPtr", _media),
    ("kept.media.shadow.length", "Float", _media),
)

# Dr.Jit's local memory cannot hold Bool: these share a word, one bit each, and the lobe takes the bits above.
BITS: tuple[tuple[str, Condition], ...] = (
    ("at.hit.valid", _always),
    ("at.delta", _always),
    ("at.camera", _always),
    ("kept.lit", _always),
    ("kept.black", _always),
    ("kept.media.flight.event", _media),
    ("kept.media.null", _media),
)
LOBE_SHIFT = 8


@cache
def record_type(layout: Layout) -> type:
    """The dataclass that holds a vertex."""
    fields = {_name(place): _plain(kind) for place, kind, remembered in FIELDS if remembered(layout)}
    return make_dataclass("Record", [*fields.items(), ("word", mi.UInt32)])


def record(layout: Layout, v: Replayed) -> Any:
    """A vertex, to be written."""
    fields = {}
    for place, kind, remembered in FIELDS:
        if remembered(layout):
            value = reduce(getattr, place.split("."), v)
            fields[_name(place)] = dr.reinterpret_array(mi.UInt32, value) if kind.endswith("Ptr") else value
    word = v.kept.lobe << LOBE_SHIFT
    for k, (place, remembered) in enumerate(BITS):
        if remembered(layout):
            word |= dr.select(reduce(getattr, place.split("."), v), mi.UInt32(1 << k), 0)
    return record_type(layout)(**fields, word=word)


def read_back(layout: Layout, records: Any, index: mi.UInt32, last: mi.UInt32, ray0: mi.Ray3f) -> Replayed:
    """The vertex recorded at ``index``.

    ``last`` is the index of the path's last vertex; time and wavelengths are those of the ray ``ray0``.
    """
    v = _read(layout, records[index], ray0)
    onward = _read(layout, records[dr.minimum(index + 1, last)], ray0).at
    # The next vertex remembers how the path came to it.
    kept = replace(v.kept, d=onward.ray.d, delta=onward.delta)
    if layout.passes:
        kept.delta |= kept.media.null
    else:
        kept.pdf = onward.pdf
    return replace(v, kept=kept, go_on=index < last, hit_next=onward.hit)


def _read(layout: Layout, read: Any, ray0: mi.Ray3f) -> Replayed:
    v = _blank(layout, ray0)
    for place, kind, remembered in FIELDS:
        if remembered(layout):
            value = getattr(read, _name(place))
            _put(v, place, dr.reinterpret_array(getattr(mi, kind), value) if kind.endswith("Ptr") else value)
    for k, (place, remembered) in enumerate(BITS):
        if remembered(layout):
            _put(v, place, (read.word & (1 << k)) != 0)
    v.kept.lobe = read.word >> LOBE_SHIFT
    return v


def _blank(layout: Layout, ray0: mi.Ray3f) -> Replayed:
    """A vertex of which nothing is known yet; what is not remembered stays what it is here."""
    zero, no = mi.Float(0), mi.Bool(False)
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0), ray0.time, ray0.wavelengths)
    at = Arrival(ray, dr.zeros(mi.PreliminaryIntersection3f), zero, no, no)
    kept = Kept(mi.Vector3f(0), zero, no, no, mi.UInt32(0), no)
    if layout.fixed:
        kept.known = KnownLight(mi.Spectrum(0), mi.Vector3f(0), mi.Spectrum(0))
    if layout.media:
        flight = Flight(no, zero, zero, mi.Spectrum(1), zero)
        kept.media = KeptInMedia(no, flight, Shadow(mi.Spectrum(0), zero, dr.zeros(mi.MediumPtr), zero))
    u = Numbers(mi.Point2f(0), zero, mi.Point2f(0), zero)
    return Replayed(at, u, kept, no, at.hit, zero, mi.Spectrum(0))


def _put(v: Replayed, place: str, value: Any) -> None:
    *way, name = place.split(".")
    setattr(reduce(getattr, way, v), name, value)


def _name(place: str) -> str:
    return place.replace(".", "_")


def _plain(kind: str) -> type:
    return mi.UInt32 if kind.endswith("Ptr") else getattr(mi, kind)
