"""Importance of segments. Segments are selected for bisection in proportion to their importance, without bias.

The importance of a segment is estimated from its probes. The contribution of an edge has two factors. The direction to
an edge at distance r turns by 1 / r per unit of motion. At the edge, the integrand jumps by a fraction of the scattered
radiance. The radiance of the visible surfaces is unknown before a path is traced, and is replaced by a constant: 1 for
the sky, and `DIM` for any surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import Survey
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.transport.velocity import blend_length_at
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
ON_ARCS = 8.0
"""Factor of the importance of arcs. The radiance beyond an edge is unknown until the edge is located. The contributions
of arcs therefore vary more than their importance, and the variance is smaller if more arcs are bisected."""
VERTICES = 8
"""Number of vertices of a path that are distinguished. All later vertices count as the last of these."""
EVENLY = 0.25
"""Smallest relative weight of a vertex in the selection of observers, because there are few pilot segments."""

Values = TypeVar("Values", "mi.Float", "mi.UInt32")


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
        return Importance(finite(survey.presence), finite(edges), finite(light))


def finite(x: mi.Float) -> mi.Float:
    """Replace values that are not finite by zero."""
    return dr.select(dr.isfinite(x), x, 0)


def closeness(trace: TraceConfig, hit: mi.PreliminaryIntersection3f) -> mi.Float:
    """Return about 1 / r for a hit at distance r, and 0 for a miss. `WITHIN` bounds the result for small r.

    The direction to the hit turns by the angle 1 / r if the hit point moves by one unit of length.
    """
    h0 = blend_length_at(trace.traits.tables.blend_lengths, hit)
    return dr.select(hit.is_valid(), dr.rcp(hit.t + WITHIN * h0), 0)


def own_plane(observer: ObserverVertex, a: mi.Vector3f, b: mi.Vector3f) -> mi.Float:
    """Return `OWN` where the plane of the observer's own triangle separates two directions, else 1."""
    return dr.select(observer.separates(a, b), OWN, mi.Float(1))


@dataclass
class Importances:
    """Importance of all segments around the observers of several paths."""

    squares: Importance  # one segment in the square of emitter samples per path
    arcs: Importance  # one arc of each path, then a second arc of each path, and so on
    vertex: mi.UInt32  # number of vertices before the observer of each path, at most `VERTICES` - 1
    exists: mi.Bool  # whether the path has an observer

    def radiance(self) -> mi.Float:
        """Estimate the mean radiance along arcs, by the number of vertices before the observer.

        The estimate is the radiance that emitter samples scatter at this and all later vertices, divided by the
        scattering weight of the arcs. If no observer has this number of preceding vertices, the result is an average.
        """
        scattered, weight = self._by_vertex(self.squares.light), self._by_vertex(self.arcs.light)
        total, total_weight = dr.sum(scattered), dr.sum(weight)
        onward = total - dr.cumsum(scattered) + scattered
        average = dr.select((total > 0) & (total_weight > 0), total / total_weight, 1)
        return dr.select((onward > 0) & (weight > 0), onward / weight, average)

    def weighed(self, radiance: mi.Float) -> list[mi.Float]:
        """Return `Importance.presence` and the importance of edges as two arrays. Each of the two arrays has the sum 1.

        In both arrays, the segments in emitter squares precede the arcs. ``radiance`` is the result of `radiance`, for
        these or for other paths.
        """
        on_arcs = ON_ARCS * dr.gather(mi.Float, radiance, repeated(self.vertex, self.arcs.edges)) * self.arcs.edges
        presence = dr.concat([self.squares.presence, self.arcs.presence])
        importance = dr.concat([self.squares.edges, on_arcs])
        dr.eval(presence, importance)
        return [x / dr.maximum(dr.sum(x), dr.smallest(mi.Float)) for x in (presence, importance)]

    def shares(self, importance: mi.Float) -> mi.Float:
        """Return weights for the selection of observers, by the number of preceding vertices: see `choose_vertex`.

        A weight is proportional to the root mean square of the segments' ``importance``, to minimise the variance.
        """
        squares, count = self._by_vertex(dr.square(importance)), self._by_vertex(dr.select(self.exists, mi.Float(1), 0))
        rms = dr.sqrt(squares / dr.maximum(count, 1))
        largest = dr.max(rms)
        return dr.select(largest > 0, dr.lerp(rms / largest, 1, EVENLY), 1)

    def _by_vertex(self, x: mi.Float) -> mi.Float:
        """Sum values of segments by the number of vertices before the observer."""
        total = dr.zeros(mi.Float, VERTICES)
        dr.scatter_add(total, x, repeated(self.vertex, x))
        return total


def repeated(x: Values, like: mi.Float) -> Values:
    """Repeat the values of all paths, once for each of their segments in ``like``. A single value is broadcast."""
    return x if dr.width(x) == 1 else dr.concat([x] * (dr.width(like) // dr.width(x)))
