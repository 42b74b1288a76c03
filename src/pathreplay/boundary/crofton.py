"""Crofton's formula: edges are found by what differs between the ends of short segments, and not listed.

Segments of length l are thrown at random on a surface, such as the film or the sphere of directions. With p(c) the
density of their centres and directions that are uniform, the expected sum of g / p(c) over all crossings with edges is
2 l / π times the integral of g along the edges. Signatures tell that there is a crossing; bisection finds where.

Two crossings of one segment go unseen, as at a corner. So segments whose ends agree are probed in the middle, too; what
only the middle finds is weighted by its length, for the segments that have such a part elsewhere: see `alone`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

BISECTIONS = 12
"""How often a segment is halved: what is left of it is 2^-12 as long."""
OFF_PLANE = 0.1
"""Share of their distance by which two points leave each other's tangent planes, where a surface hides itself."""
ROUNDING = 1e-5
"""Share of their coordinates by which points may be wrong."""
HIDES, BENDS = 0.25, 0.02
"""Importance of an edge between two points of one shape, where two shapes have 1. Most of these are bends: there each
point is on the same side of the other's tangent plane."""
ANGLE = 1e-3
"""Between two surfaces, from which on they meet at an edge."""
STILL = 8
"""Halvings in a row that leave one end of a segment where it was: of segments with an edge 1 in 2^7 does."""
PARTS = 3
"""Halvings of half a segment that tell where what the middle sees ends."""
LEAST = 9 / 32
"""Share of a segment: see `alone`. Halfway between two that `part_seen` tells apart."""
BEYOND = 1.5
"""Lengths of what is left of a segment, by which one probes beyond such an end. (Within the `BORDER` of emitters.)"""


@dataclass
class VisibilityProbe:
    """What is seen at a place of a segment: two of them tell whether there is an edge between."""

    signature: mi.UInt32
    p: mi.Point3f  # where the view ends; zero where it does not
    n: mi.Normal3f
    moves: mi.Bool = field(default_factory=lambda: mi.Bool(True))  # between two that do not, an edge does nothing
    # Importance of an edge beside it, as far as a probe can tell:
    near: mi.Float = field(default_factory=lambda: mi.Float(1))  # how close it is
    bright: mi.Float = field(default_factory=lambda: mi.Float(1))  # how much light comes from it
    # Of a mesh that is shaded smoothly and is not smooth:
    triangle: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))  # 0: no matter
    light: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))  # directions that are scattered, or none:
    lobe: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))  # its plane may hide what is there

    @staticmethod
    def of(signature: int | mi.UInt32 = 0) -> VisibilityProbe:
        """What nothing but its signature tells apart."""
        return VisibilityProbe(mi.UInt32(signature), mi.Point3f(0), mi.Normal3f(0))

    def differs(self, other: VisibilityProbe) -> mi.Bool:
        """Whether it is another shape, or another sheet of the same: see `hides_itself`."""
        return self.hint(other) > 0

    def hint(self, other: VisibilityProbe) -> mi.Float:
        """How likely it is that there is an edge between, as an importance: 0 where there is none for certain."""
        across = other.p - self.p
        bend = dr.dot(self.n, across) * dr.dot(other.n, across) < 0
        same = dr.select(hides_itself(self, other), dr.select(bend, mi.Float(BENDS), HIDES), 0)
        hint = dr.select((self.signature != other.signature) | self._crease(other), 1, same)
        return dr.select(self.moves | other.moves, hint, 0)

    def _crease(self, other: VisibilityProbe) -> mi.Bool:
        """Whether another triangle is seen, and a direction is between their planes, or close: it jumps what they hide.

        Directions turn with the shading normal on the way to the crease, by no more than triangles do.
        """
        between = mi.Bool(False)
        for d in (self.light, self.lobe, other.light, other.lobe):
            a, b = dr.dot(self.n, d), dr.dot(other.n, d)
            between |= (a * b < 0) | (dr.minimum(dr.abs(a), dr.abs(b)) < dr.abs(a - b))
        return (self.triangle != other.triangle) & at_an_angle(self.n, other.n) & between


def at_an_angle(n: mi.Normal3f, n_other: mi.Normal3f) -> mi.Bool:
    """Whether two surfaces with these normals meet at an edge, if they meet."""
    return dr.squared_norm(dr.cross(n, n_other)) > dr.square(ANGLE)


def hides_itself(a: VisibilityProbe | mi.SurfaceInteraction3f, b: VisibilityProbe | mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether two points of one shape may be on different sheets: one is off the tangent plane of the other.

    Or the shape bends between them, which only points that are closer to each other can tell.
    """
    across = b.p - a.p
    off = dr.maximum(dr.abs(dr.dot(a.n, across)), dr.abs(dr.dot(b.n, across)))
    rounding = ROUNDING * dr.max(dr.maximum(dr.abs(a.p), dr.abs(b.p)))
    return off > OFF_PLANE * dr.norm(across) + rounding


Probe: TypeAlias = "Callable[[mi.Float, mi.Bool], VisibilityProbe]"
"""(place, active) -> what is seen there. Places of a segment of length l are from -l / 2 to l / 2."""


@dataclass
class PlaneSegment:
    """A segment in a plane."""

    c: mi.Point2f
    w: mi.Vector2f  # its direction
    length: mi.Float

    def at(self, t: mi.Float) -> mi.Point2f:
        return self.c + t * self.w


def heading(turn: mi.Float) -> mi.Vector2f:
    """A direction in the plane, from a number in [0, 1)."""
    sin, cos = dr.sincos(dr.two_pi * turn)
    return mi.Vector2f(cos, sin)


@dataclass
class Crossed:
    """A piece of a segment, from ``a`` to ``b``, with an edge on it."""

    a: mi.Float
    b: mi.Float
    weight: mi.Float  # number of crossings that it stands for; 0: none

    def per_length(self, length: mi.Float | float, density: mi.Float) -> mi.Float:
        """Crofton's weight of the crossing, π/2 / (l p(c)) each: the length of edge that it stands for."""
        return 0.5 * dr.pi * self.weight / (length * density)


def passed(w: mi.Vector2f, jump: mi.Spectrum, slope: mi.Vector2f) -> mi.Spectrum:
    """K: jump · sgn(w·∂B) / |∂B|, zero where that is not finite; ``slope`` is ∂B, ``jump`` the rest of K."""
    n = dr.norm(slope)
    K = jump * (dr.sign(dr.dot(w, slope)) / n)
    return dr.select((n > 0) & dr.all(dr.isfinite(K)), K, 0)


@dataclass
class Survey:
    """What the probes of a segment tell."""

    found: mi.Float  # how much the segment counts as one with an edge, 0 where it has none
    near: mi.Float  # of what is seen along it, the most
    bright: mi.Float

    @staticmethod
    def of(probes: list[VisibilityProbe], active: mi.Bool) -> Survey:
        """By what is seen at `probed`."""
        a, b, c = probes
        ends, halves = a.hint(b), dr.maximum(c.hint(a), c.hint(b))
        # Of two crossings one is chosen, for both, and counts more than once: see `alone`.
        found = dr.select(ends > 0, dr.maximum(ends, halves), 4 * halves)
        near = dr.maximum(dr.maximum(a.near, b.near), c.near)
        bright = dr.maximum(dr.maximum(a.bright, b.bright), c.bright)
        return Survey(dr.select(active, found, 0), near, bright)


def probed(length: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Where segments are probed to detect edges: at their ends, and in the middle."""
    return -0.5 * length, 0.5 * length, mi.Float(0)


def detect(probe: Probe, length: mi.Float, active: mi.Bool) -> mi.Float:
    """How much a segment counts as one with an edge: 0 where it has none."""
    return Survey.of([probe(t, active) for t in probed(length)], active).found


def alone(m: mi.Float) -> mi.Float:
    """The weight of a segment that is the same at both ends and otherwise in the middle, on a share ``m`` of it.

    Such a part lies within the segment for beginnings along 1 - m of its length, and in the middle, too, for
    min(m, 1 - m) of it. The ratio has no bounds for small parts, and is constant below `LEAST`, so that it is right
    on average over parts that a corner cuts off: there all m are as likely.
    """
    return dr.select(m < LEAST, 2 / LEAST - 1, dr.select(m < 0.5, (1 - m) / m, 1))


@dr.syntax
def part_seen(
    probe: Probe, length: mi.Float, at_a: VisibilityProbe, at_b: VisibilityProbe, active: mi.Bool
) -> mi.Float:
    """The share of a segment around its middle in which it looks as at neither end, within a sixteenth on each side.

    There may be edges within: what counts is that a segment with its middle there finds something.
    """
    half = 0.5 * length
    n, share, reach, step = mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Float(0.5)
    while dr.hint(active & (n < 2 * PARTS), exclude=[probe], label="pathreplay: part of a segment"):
        side = dr.select(n < PARTS, mi.Float(-1), 1)
        further = reach + step
        there = probe(side * half * further, mi.Bool(True))
        within = there.differs(at_a) | there.differs(at_b)
        reach, step = dr.select(within, further, reach), 0.5 * step
        n += 1
        done = (n == PARTS) | (n == 2 * PARTS)
        share += dr.select(done, 0.5 * (reach + step), 0)
        reach, step = dr.select(done, 0, reach), dr.select(done, 0.5, step)
    return share


@dr.syntax
def bisect(probe: Probe, length: mi.Float, weight: mi.Float, generator: mi.PCG32) -> Crossed:
    """A piece of each segment with an edge, 2^-12 as long as it, where ``weight`` is not zero.

    Of several crossings one is chosen, by how likely they are edges; what only the middle found counts as `alone` says.
    None, where a surface was merely bent, weighs 0. Nor does a crack between two triangles count, through which
    very few rays slip: an end in a crack never moves, and beyond it all is as at the other end.
    """
    a, b, _ = probed(length)
    weight = mi.Float(weight)
    at_a, at_b = probe(a, weight > 0), probe(b, weight > 0)
    only_middle = (weight > 0) & ~at_a.differs(at_b)
    weight = dr.select(only_middle, alone(part_seen(probe, length, at_a, at_b, only_middle)) * weight, weight)
    n, still, was_left = mi.UInt32(0), mi.UInt32(0), mi.Bool(False)
    while dr.hint(
        (weight > 0) & ((n < BISECTIONS) | ((n == BISECTIONS) & (still >= STILL))),
        exclude=[probe],
        label="pathreplay: bisection",
    ):
        halve, beyond = n < BISECTIONS, BEYOND * (b - a)
        c = dr.select(halve, 0.5 * (a + b), dr.select(was_left, a - beyond, b + beyond))
        at_c = probe(c, mi.Bool(True))
        to_a, to_b = at_c.hint(at_a), at_c.hint(at_b)
        both = to_a + to_b
        left = (to_b == 0) | (generator.next_float32() * both < to_a)
        likely = dr.select(both > 0, both / dr.select(left, to_a, to_b), 0)
        no_crack = dr.select(was_left, to_b, to_a) > 0
        weight *= dr.select(halve, likely, dr.select(no_crack, 1, 0))
        still = dr.select(left == was_left, still + 1, 1)
        was_left = left
        a, at_a = dr.select(left | ~halve, a, c), dr.select(left, at_a, at_c)
        b, at_b = dr.select(left & halve, c, b), dr.select(left, at_c, at_b)
        n += 1
    return Crossed(a, b, weight)
