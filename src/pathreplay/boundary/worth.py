"""Importance of edges on a segment, estimated from its probes: it decides which segments are resolved, nothing else.

An edge at a distance r turns by 1 / r as things move, and the integrand jumps there by a part of what is scattered. The
radiance of what is seen is unknown before a path is traced: the sky counts fully, everything else by `DIM`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import Survey
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.transport.vertex import TraceConfig

WITHIN = 2.0
"""`blend_length`s of what is seen: closer than these nothing counts more."""
DIM, OWN = 0.3, 0.1
"""How much an edge counts where no sky is seen, and where the plane of the seer's own triangle may be all there is."""
UNFORESEEN = 0.1
"""Fraction of the importance that goes by the presence of an edge alone: probes do not foresee all that counts."""
MOST = 4.0
"""Largest importance of a segment in the first look, over the mean: the first look has few segments."""
STEEP = 0.03
"""Least angle that an emitter subtends across its square, in radians: bounds the importance of small emitters."""


@dataclass
class Worth:
    """Importance of a segment."""

    found: mi.Float  # see `Survey`
    edges: mi.Float  # what they may be worth
    light: mi.Float  # scattered radiance, of emitters or of indirect light

    @staticmethod
    def of(seen: Survey, light: mi.Float, scale: mi.Float) -> Worth:
        """Of a segment with this survey; ``scale`` is the rest of its importance. What is not finite counts as zero."""
        edges = seen.found * seen.near * seen.bright * scale
        return Worth(_finite(seen.found), _finite(edges), _finite(light))


def _finite(x: mi.Float) -> mi.Float:
    return dr.select(dr.isfinite(x), x, 0)


def closeness(trace: TraceConfig, hit: mi.PreliminaryIntersection3f) -> mi.Float:
    """1 / r, as fast as what was hit turns when it moves on; see `WITHIN`."""
    shape = dr.reinterpret_array(mi.UInt32, hit.shape)
    h0 = dr.gather(mi.Float, trace.traits.tables.blend_lengths, shape, hit.is_valid())
    return dr.select(hit.is_valid(), dr.rcp(hit.t + WITHIN * h0), 0)


def own_plane(observer: ObserverVertex, a: mi.Vector3f, b: mi.Vector3f) -> mi.Float:
    """`OWN` where the plane of the seer's own triangle lies between two directions, else 1."""
    return dr.select(observer.parts(a, b), OWN, mi.Float(1))


def radiance_of(worths: list[Worth]) -> mi.Float:
    """Radiance of what arcs see, relative to emitters, as one number: taken to be that of what emitters light."""
    lit, all_of_it = (dr.sum(worth.light) for worth in worths)
    return dr.select((lit > 0) & (all_of_it > 0), lit / all_of_it, 1)


def weighed(worths: list[Worth], radiance: mi.Float) -> list[mi.Float]:
    """Presence and importance of edges on the segments of both kinds, one after the other, normalised to sum to 1."""
    in_squares, on_arcs = worths
    found = dr.concat([in_squares.found, on_arcs.found])
    worth = dr.concat([in_squares.edges, radiance * on_arcs.edges])
    dr.eval(found, worth)
    return [x / dr.maximum(dr.sum(x), dr.smallest(mi.Float)) for x in (found, worth)]
