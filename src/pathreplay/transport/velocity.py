"""What a smooth continuation holds while things move: the point that it hit or, close to that surface, its direction.

Let x be a vertex, y what its continuation along d hit, and r = |y - x|. An integral over directions does not depend on
how it is parametrised: d may move with any velocity V(d), if the weight takes its divergence along, (log J)' = div V.
Two are at hand:

    V_H    follows y, which stays where it is on its surface: J_H = |A·d| / r², with A an area element at y
    0      keeps d

V_H holds the edges of lamps and the seams between materials where they are in the integrand; otherwise their motion
is a boundary term, and missing. But where x slides past the surface of y at a distance h, (log J_H)' grows like 1/h,
so that its variance is infinite wherever two surfaces touch. So V = φ V_H, with φ = 1 - exp(-m) and m = h r / h0²:

    (log J)' = φ (log J_H)' + ∇φ·V_H,        ∇φ·V_H = -m exp(-m) (n·d_H') / (n·d)

since h is the same for all d that meet the plane of y, and r is not. m grows with r, too, because the few directions
that graze a near plane meet it far away: holding those costs little, and edges are there. For a sphere h is the
distance of x to it, which is constant as well and does not vanish at its limb. On other curved shapes V = V_H.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from pathreplay.transport.surface import HeldPoint, held_point

# h0 over the size of the shape that was hit. A larger one is less noisy and gives up more of the edges that are close
# by; docs/gradients.md has both for 0.003 to 0.03.
BLEND = 0.01
# m from which on V follows y but for a thousandth.
CLOSE = 7.0


def blend_length(shape: mi.Shape) -> float:
    """h0 of a shape: BLEND times the diagonal of its bounding box; 0 of an empty group, which has none."""
    size = sum(float(x) ** 2 for x in shape.bbox().extents()) ** 0.5
    return BLEND * size if math.isfinite(size) else 0.0


def moved_direction(
    lengths: mi.Float, origin: mi.Interaction3f, d: mi.Vector3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float]:
    """The kept direction ``d`` and J, as V moves them: their values are ``d`` and 1.

    ``lengths`` are each shape's `blend_length` and ``hit`` is what the continuation from ``origin`` along ``d``
    hit; rays that left the scene keep their direction. Differentiable in ``origin`` and in the shape that was hit.
    """
    found = active & hit.is_valid()
    y = held_point(hit, dr.detach(origin.spawn_ray(d)), found)
    towards = y.p - origin.spawn_ray(dr.detach(d)).o
    facing = dr.abs(dr.dot(y.A, towards))
    ok = found & (facing > 0)
    dist2 = dr.select(ok, dr.squared_norm(towards), 1)
    d_H = towards * dr.rsqrt(dist2)
    # In corners distances are tiny: the derivative of a logarithm holds where those of powers would overflow.
    log_J_H = dr.log(dr.select(ok, facing, 1)) - 1.5 * dr.log(dist2)

    h0 = dr.gather(mi.Float, lengths, dr.reinterpret_array(mi.UInt32, hit.shape), ok)
    φ, slope = _share(h0, dr.detach(y), dr.detach(towards), ok)
    log_J = φ * log_J_H + dr.dot(slope, d_H)
    return dr.select(ok, dr.replace_grad(d, φ * d_H), d), dr.replace_grad(mi.Float(1), log_J)


def jumps_at_facets(
    lengths: mi.Float, origin: mi.Interaction3f, hit: mi.PreliminaryIntersection3f, p: mi.Point3f, n: mi.Normal3f
) -> mi.Bool:
    """Whether V jumps from facet to facet where ``hit`` is, at ``p`` with the normal ``n``: φ asks for their planes."""
    towards = p - origin.p
    h0 = dr.gather(mi.Float, lengths, dr.reinterpret_array(mi.UInt32, hit.shape), hit.is_valid())
    near = dr.abs(dr.dot(n, towards)) * dr.norm(towards) < CLOSE * dr.square(h0)
    return hit.is_valid() & hit.shape.is_mesh() & near


def held_direction(
    origin: mi.Interaction3f, d: mi.Vector3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.Vector3f:
    """The direction from ``origin`` to the point that a ray along ``d`` hit, glued to its surface; its value is ``d``.

    Differentiable in ``origin`` and in the shape that was hit.
    """
    y = held_point(hit, dr.detach(origin.spawn_ray(d)), active)
    towards = y.p - origin.spawn_ray(dr.detach(d)).o
    ok = active & (dr.squared_norm(towards) > 0)
    return dr.select(ok, dr.replace_grad(d, dr.normalize(towards)), d)


def _share(h0: mi.Float, y: HeldPoint, towards: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.Vector3f]:
    """φ, and the slope that makes ∇φ·V_H = slope·d_H'; nothing here is attached."""
    r = dr.norm(towards)
    n = dr.normalize(y.A)
    turned = dr.dot(n, towards) > 0
    n = dr.select(turned, -n, n)
    κ = dr.select(turned ^ (dr.dot(y.A, y.n) < 0), -y.κ, y.κ)
    blends = active & (h0 > 0) & dr.isfinite(κ)
    # Distance to the sphere of curvature κ through y, ||x - centre| - 1/|κ||, without the cancellation in it; to the
    # plane for κ = 0.
    h = (κ * r * r - 2 * dr.dot(n, towards)) / (1 + dr.norm(n - κ * towards))
    m = dr.maximum(h, 0) * r / dr.square(h0)
    steep = m * dr.exp(-m) * r / dr.dot(n, towards)
    slope = dr.select(blends & dr.isfinite(steep), -steep * n, 0)
    return dr.select(blends, 1 - dr.exp(-m), 1), slope
