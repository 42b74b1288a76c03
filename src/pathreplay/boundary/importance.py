"""Importance of segments. Segments are selected for bisection in proportion to their importance, without bias.

The importance of a segment is estimated from its probes. The contribution of an edge has two factors. The direction to
an edge at distance r turns by 1 / r per unit of motion. At the edge, the integrand jumps by a fraction of the scattered
radiance. The radiance of the visible surfaces is unknown before a path is traced, and is replaced by a constant: 1 for
the sky, and `DIM` for any surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import Survey
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.transport.vertex import TraceConfig

WITHIN = 2.0
"""Distance of an edge below which its importance hardly increases, in units of the visible surface's `blend_length`."""
DIM, OWN = 0.3, 0.1
"""Factors of the importance: DIM if no sky is visible, OWN if the plane of the observer's own triangle is the edge."""
UNFORESEEN = 0.1
"""Weight with which the presence of an edge is added to its importance, because probes do not predict every large
contribution."""
MOST = 4.0
"""Largest importance of a pilot segment, relative to the mean. It is bounded because there are few pilot segments."""
STEEP = 0.03
"""Angle in radians per unit length of a segment in an emitter's square. It is added to the angle that the segment
subtends, to bound the importance of small emitters."""


@dataclass
class Importance:
    """Importance of a segment."""

    presence: mi.Float  # see `Survey.presence`
    edges: mi.Float  # importance of the edges
    light: mi.Float  # for an emitter sample: its scattered radiance; for an arc: its scattering weight

    @staticmethod
    def of(survey: Survey, light: mi.Float, scale: mi.Float) -> Importance:
        """Compute the importance from a survey. Non-finite values become zero.

        ``scale`` is the product of all factors of the importance that the survey does not contain.
        """
        edges = survey.presence * survey.near * survey.bright * scale
        return Importance(_finite(survey.presence), _finite(edges), _finite(light))


def _finite(x: mi.Float) -> mi.Float:
    return dr.select(dr.isfinite(x), x, 0)


def closeness(trace: TraceConfig, hit: mi.PreliminaryIntersection3f) -> mi.Float:
    """Return about 1 / r for a hit at distance r, and 0 for a miss. `WITHIN` bounds the result for small r.

    The direction to the hit turns by the angle 1 / r if the hit point moves by one unit of length.
    """
    shape = dr.reinterpret_array(mi.UInt32, hit.shape)
    h0 = dr.gather(mi.Float, trace.traits.tables.blend_lengths, shape, hit.is_valid())
    return dr.select(hit.is_valid(), dr.rcp(hit.t + WITHIN * h0), 0)


def own_plane(observer: ObserverVertex, a: mi.Vector3f, b: mi.Vector3f) -> mi.Float:
    """Return `OWN` where the plane of the observer's own triangle separates two directions, else 1."""
    return dr.select(observer.separates(a, b), OWN, mi.Float(1))


def radiance_of(importances: list[Importance]) -> mi.Float:
    """Estimate the mean radiance along arcs.

    The estimate is the scattered radiance of all emitter samples, divided by the scattering weight of all arcs.
    """
    from_emitters, total = (dr.sum(importance.light) for importance in importances)
    return dr.select((from_emitters > 0) & (total > 0), from_emitters / total, 1)


def weighed(importances: list[Importance], radiance: mi.Float) -> list[mi.Float]:
    """Return `Importance.presence` and the importance of edges as two arrays. Each of the two arrays has the sum 1.

    In both arrays, the segments in emitter squares precede the arcs.
    """
    in_squares, on_arcs = importances
    presence = dr.concat([in_squares.presence, on_arcs.presence])
    importance = dr.concat([in_squares.edges, radiance * on_arcs.edges])
    dr.eval(presence, importance)
    return [x / dr.maximum(dr.sum(x), dr.smallest(mi.Float)) for x in (presence, importance)]
