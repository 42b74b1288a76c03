"""Crofton's formula: find edges by comparing the ends of short random segments, without a list of edges.

Segments of length l are distributed at random over a surface, for example the film or the sphere of directions. Let
p(c) be the density of their centres, and let their directions be uniform. The expected sum of g / p(c) over all
crossings with edges is 2 l / π times the integral of g along the edges. Different signatures (hashes of the visible
surfaces) at the ends of a segment indicate a crossing; bisection locates it.

If a segment has two crossings, for example at a corner, the signatures at its two ends may be equal. Each segment is
therefore also probed in the middle. Two crossings on the same side of the middle are still missed. Other segments make
up for the missed crossings: if the two ends have the same signature, and the middle has a different signature, the
weight of the segment is larger (see `middle_weight`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import drjit as dr
import mitsuba as mi

BISECTIONS = 12
"""Number of bisections of a segment: the final interval has 2^-12 of its length."""
OFF_PLANE = 0.1
"""Threshold above which a surface may occlude itself: distance of a point from the tangent plane of another point,
relative to the distance between the two points."""
ROUNDING = 1e-5
"""Relative rounding error of the coordinates of points."""
HIDES, BENDS = 0.25, 0.02
"""Importance of an edge between two points of one shape, relative to points of two shapes. BENDS applies if each point
is in front of the other's tangent plane, or each is behind: in most such cases, the surface is merely curved."""
STILL = 1 / 16
"""Importance of an edge, relative to other edges, if the first surfaces of two chains differ and their edges do not
contribute (see `VisibilityProbe.still`). The same segment may also cross another edge."""
ANGLE = 1e-3
"""Smallest angle between two surfaces, in radians, that counts as an edge."""
CRACK_BISECTIONS = 8
"""An end that stays fixed in this many successive bisections suggests a crack. At a true edge, this happens with a
probability of 2^-7."""
PARTS = 3
"""Number of probes with which `MiddlePart` locates each of its ends."""
MIN_FRACTION = 9 / 32
"""Fraction below which `middle_weight` is constant. It is halfway between two values of `MiddlePart.fraction`."""
AFTER_ENDS, AFTER_MIDDLE, AFTER_BISECTIONS = 2, 2 + 2 * PARTS, 2 + 2 * PARTS + BISECTIONS
"""Values of the counter of `bisect` after its first three stages."""
BEYOND = 1.5
"""Distance beyond the fixed end at which a suspected crack is probed, in lengths of the final interval. In the square
of an emitter this distance is less than `emitters.BORDER`."""


Direction = TypeVar("Direction", "mi.Vector2f", "mi.Vector3f")


@dataclass
class VisibilityProbe:
    """Visibility at one position of a segment. If two probes differ, an edge lies between their positions."""

    signature: mi.UInt32
    p: mi.Point3f  # the visible point; zero if no surface is visible
    n: mi.Normal3f
    moves: mi.Bool = field(default_factory=lambda: mi.Bool(True))  # may move; edges between static points are ignored
    # Two factors of the importance of an edge next to the probe. A single probe suffices to estimate these factors:
    near: mi.Float = field(default_factory=lambda: mi.Float(1))  # reciprocal distance of the visible point
    bright: mi.Float = field(default_factory=lambda: mi.Float(1))  # estimate of the radiance
    # Used for coarse meshes with smooth shading. The plane of a triangle of such a mesh may occlude light:
    triangle: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))  # 1 + index of the visible triangle; 0: none
    light: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))  # direction of the emitter sample, or zero
    lobe: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))  # direction of the BSDF sample, or zero
    # Hash of the first surface if its edges do not contribute, because they are static or belong to another search:
    still: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))

    @staticmethod
    def of(signature: int | mi.UInt32 | mi.Bool = 0) -> VisibilityProbe:
        """Create a probe that consists of a signature only."""
        return VisibilityProbe(mi.UInt32(signature), mi.Point3f(0), mi.Normal3f(0))

    def differs(self, other: VisibilityProbe) -> mi.Bool:
        """Return whether there is an edge between the probes that may move: see `edge_importance`."""
        return self.edge_importance(other) > 0

    def edge_importance(self, other: VisibilityProbe) -> mi.Float:
        """Return the importance of an edge between the probes, a measure of its likelihood; 0 if there is no edge."""
        across = other.p - self.p
        bend = dr.dot(self.n, across) * dr.dot(other.n, across) < 0
        same = dr.select(hides_itself(self, other), dr.select(bend, mi.Float(BENDS), HIDES), 0)
        importance = dr.select((self.signature != other.signature) | self._crease(other), 1, same)
        static = (self.still != 0) & (other.still != 0) & (self.still != other.still)
        importance *= dr.select(static, mi.Float(STILL), 1)
        return dr.select(self.moves | other.moves, importance, 0)

    def _crease(self, other: VisibilityProbe) -> mi.Bool:
        """Return whether different triangles are visible, and a sampled direction lies between their planes.

        Only one of the two triangles occludes such a direction. A direction that is merely close to one of the planes
        counts as well. The sampled direction turns with the shading normal from the probe to the crease, by at most the
        angle between the triangles, and may lie between the planes at the crease.
        """
        between = mi.Bool(False)
        for d in (self.light, self.lobe, other.light, other.lobe):
            a, b = dr.dot(self.n, d), dr.dot(other.n, d)
            between |= (a * b < 0) | (dr.minimum(dr.abs(a), dr.abs(b)) < dr.abs(a - b))
        return (self.triangle != other.triangle) & at_an_angle(self.n, other.n) & between


def at_an_angle(n: mi.Normal3f, n_other: mi.Normal3f) -> mi.Bool:
    """Return whether two surfaces with these normals would form an edge where they meet."""
    return dr.squared_norm(dr.cross(n, n_other)) > dr.square(ANGLE)


def hides_itself(a: VisibilityProbe | mi.SurfaceInteraction3f, b: VisibilityProbe | mi.SurfaceInteraction3f) -> mi.Bool:
    """Return whether two points of one shape may lie on different sheets, so that the shape occludes itself.

    The result is true if one point is off the tangent plane of the other point. This is also the case if the shape is
    merely curved between the points. To distinguish the two cases, the points would have to be closer to each other.
    """
    across = b.p - a.p
    off = dr.maximum(dr.abs(dr.dot(a.n, across)), dr.abs(dr.dot(b.n, across)))
    rounding = ROUNDING * dr.max(dr.maximum(dr.abs(a.p), dr.abs(b.p)))
    return off > OFF_PLANE * dr.norm(across) + rounding


Probe: TypeAlias = "Callable[[mi.Float, mi.Bool], VisibilityProbe]"
"""(position, active) -> `VisibilityProbe`. Positions on a segment of length l range from -l / 2 to l / 2."""


@dataclass
class PlaneSegment:
    """A segment in a plane."""

    c: mi.Point2f
    w: mi.Vector2f  # unit direction
    length: mi.Float

    def at(self, t: mi.Float) -> mi.Point2f:
        return self.c + t * self.w


def heading(turn: mi.Float) -> mi.Vector2f:
    """Return the unit vector in the plane at the angle 2π ``turn``."""
    sin, cos = dr.sincos(dr.two_pi * turn)
    return mi.Vector2f(cos, sin)


@dataclass
class Bracket:
    """An interval of a segment, from ``a`` to ``b``, that contains an edge."""

    a: mi.Float
    b: mi.Float
    weight: mi.Float  # number of crossings that the interval represents; 0: no edge

    def per_length(self, length: mi.Float | float, density: mi.Float) -> mi.Float:
        """Return the number of crossings times π/2 / (l p(c)), with l the ``length`` and p(c) the ``density``.

        By Crofton's formula, each crossing represents an edge of length π/2 / (l p(c)).
        """
        return 0.5 * dr.pi * self.weight / (length * density)


def crossing_weight(w: Direction, jump: mi.Spectrum, slope: Direction) -> mi.Spectrum:
    """Return K = jump · sgn(w·∂B) / |∂B|, where ∂B is ``slope`` and w the direction of the segment; 0 if not finite."""
    n = dr.norm(slope)
    K = jump * (dr.sign(dr.dot(w, slope)) / n)
    return dr.select((n > 0) & dr.all(dr.isfinite(K)), K, 0)


@dataclass
class Survey:
    """Summary of the probes of a segment."""

    presence: mi.Float  # importance of an edge, times the weight of the segment; 0: no edge
    near: mi.Float  # largest ``near`` of the probes
    bright: mi.Float  # largest ``bright`` of the probes

    @staticmethod
    def of(probes: list[VisibilityProbe], active: mi.Bool) -> Survey:
        """Summarise the probes at `probe_positions`."""
        a, b, c = probes
        ends, halves = a.edge_importance(b), dr.maximum(c.edge_importance(a), c.edge_importance(b))
        # If the probes at the ends are equal and the probe in the middle differs, the segment has a weight of about 4.
        # One factor of 2 arises because `bisect` selects one of two crossings. `middle_weight` is also about 2.
        presence = dr.select(ends > 0, dr.maximum(ends, halves), 4 * halves)
        near = dr.maximum(dr.maximum(a.near, b.near), c.near)
        bright = dr.maximum(dr.maximum(a.bright, b.bright), c.bright)
        return Survey(dr.select(active, presence, 0), near, bright)


def probe_positions(length: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return the positions at which segments are probed to detect edges: both ends and the middle."""
    return -0.5 * length, 0.5 * length, mi.Float(0)


@dr.syntax
def survey(probe: Probe, length: mi.Float, active: mi.Bool) -> Survey:
    """Probe a segment at `probe_positions`, in a loop, so that the kernel contains the probe only once."""
    a, b, c = VisibilityProbe.of(), VisibilityProbe.of(), VisibilityProbe.of()
    n, (first, second, third) = mi.UInt32(0), probe_positions(length)
    while dr.hint(active & (n < 3), exclude=[probe], label="pathreplay: survey of a segment"):
        t = dr.select(n == 0, first, dr.select(n == 1, second, third))
        a, b, c = b, c, probe(t, mi.Bool(True))
        n += 1
    return Survey.of([a, b, c], active)


def detect(probe: Probe, length: mi.Float, active: mi.Bool) -> mi.Float:
    """Probe a segment, and return `Survey.presence`: 0 if no edge is detected."""
    return survey(probe, length, active).presence


def middle_weight(m: mi.Float) -> mi.Float:
    """Return the weight of a segment whose two ends have equal probes, but whose middle has a different probe.

    The probe differs on an interval around the middle. ``m`` is the length of this interval, divided by the length l of
    the segment. The weight compensates for segments that contain such an interval beside their middle: these segments
    do not detect the interval. Suppose that a segment is shifted along its own line. The segment contains the whole
    interval for a range of shifts of size (1 - m) l. For a part of this range, of size min(m, 1 - m) l, the middle of
    the segment also lies in the interval. The weight is the ratio of the two sizes, which is unbounded for small m. It
    is therefore constant for all m below `MIN_FRACTION`. The constant gives the correct expectation at corners,
    where all m are equally likely.
    """
    return dr.select(m < MIN_FRACTION, 2 / MIN_FRACTION - 1, dr.select(m < 0.5, (1 - m) / m, 1))


@dataclass
class MiddlePart:
    """The interval around the middle of a segment in which probes differ from those at the ends, while it is measured.

    A position belongs to the interval if its probe differs from the probe at one of the ends. The interval may contain
    further edges. In each half of the segment, the error of its length is at most 1/16 of this half.
    """

    fraction: mi.Float  # length of the interval, relative to the segment; complete after 2 `PARTS` probes
    reach: mi.Float  # largest distance from the middle with a different probe, relative to a half of the segment
    step: mi.Float  # distance of the next probe from ``reach``, in the same unit

    @staticmethod
    def begin() -> MiddlePart:
        """Return the interval before the first probe."""
        return MiddlePart(mi.Float(0), mi.Float(0), mi.Float(0.5))

    def position(self, n: mi.UInt32, length: mi.Float) -> mi.Float:
        """Return the position of the n-th probe."""
        return dr.select(n < PARTS, -0.5, mi.Float(0.5)) * length * (self.reach + self.step)

    def after(self, n: mi.UInt32, differs: mi.Bool) -> MiddlePart:
        """Return the interval after the n-th probe."""
        reach, step = dr.select(differs, self.reach + self.step, self.reach), 0.5 * self.step
        done = (n == PARTS - 1) | (n == 2 * PARTS - 1)
        fraction = self.fraction + dr.select(done, 0.5 * (reach + step), 0)
        return MiddlePart(fraction, dr.select(done, 0, reach), dr.select(done, 0.5, step))


@dr.syntax
def bisect(probe: Probe, length: mi.Float, weight: mi.Float, generator: mi.PCG32) -> Bracket:
    """Bisect each segment of non-zero ``weight``. The result is an interval that contains an edge.

    The length of the interval is 2^-12 of the length of the segment. If a segment has several crossings, one is
    selected with a probability proportional to its importance, and the weight is divided by this probability. If the
    ends of a segment have equal probes, the weight is multiplied by `middle_weight`. The weight becomes 0 where a
    surface is merely curved. It also becomes 0 at a crack between triangles, through which few rays pass. A crack is
    assumed if many successive bisections have left one end of the interval unchanged, and a probe just beyond this end
    equals the probe at the other end.

    One loop has four stages, so that the kernel contains the probe only once. The stages probe both ends, measure the
    `MiddlePart` of segments whose ends have equal probes, bisect, and probe beyond an end that may be at a crack.
    """
    a, b, _ = probe_positions(length)
    weight = mi.Float(weight)
    at_a, at_b, middle = VisibilityProbe.of(), VisibilityProbe.of(), MiddlePart.begin()
    n, unchanged, was_left = mi.UInt32(0), mi.UInt32(0), mi.Bool(False)
    while dr.hint(
        (weight > 0) & ((n < AFTER_BISECTIONS) | ((n == AFTER_BISECTIONS) & (unchanged >= CRACK_BISECTIONS))),
        exclude=[probe],
        label="pathreplay: bisection",
    ):
        at_first, at_second, bisects = n == 0, n == 1, n >= AFTER_MIDDLE
        in_middle = (n >= AFTER_ENDS) & ~bisects
        halve, step = n < AFTER_BISECTIONS, BEYOND * (b - a)
        c = dr.select(halve, 0.5 * (a + b), dr.select(was_left, a - step, b + step))
        c = dr.select(in_middle, middle.position(n - AFTER_ENDS, length), c)
        seen = probe(dr.select(at_first, a, dr.select(at_second, b, c)), mi.Bool(True))

        at_a, at_b = dr.select(at_first, seen, at_a), dr.select(at_second, seen, at_b)
        to_a, to_b = seen.edge_importance(at_a), seen.edge_importance(at_b)
        middle = dr.select(in_middle, middle.after(n - AFTER_ENDS, (to_a > 0) | (to_b > 0)), middle)
        weight *= dr.select(n == AFTER_MIDDLE - 1, middle_weight(middle.fraction), 1)

        total = to_a + to_b
        left = (to_b == 0) | (generator.next_float32(bisects) * total < to_a)
        inv_probability = dr.select(total > 0, total / dr.select(left, to_a, to_b), 0)
        no_crack = dr.select(was_left, to_b, to_a) > 0
        weight *= dr.select(bisects, dr.select(halve, inv_probability, dr.select(no_crack, 1, 0)), 1)
        unchanged = dr.select(bisects, dr.select(left == was_left, unchanged + 1, 1), unchanged)
        was_left = bisects & left
        a, at_a = dr.select(bisects & ~left & halve, c, a), dr.select(bisects & ~left, seen, at_a)
        b, at_b = dr.select(bisects & left & halve, c, b), dr.select(bisects & left, seen, at_b)
        n = dr.select(at_second & (to_a > 0), AFTER_MIDDLE, n + 1)
    return Bracket(a, b, weight)
