"""Velocity of sampled directions while the scene moves. A direction follows its next hit point, fully or in part.

Let x be a vertex, y the hit point of its continuation along d, and r = |y - x|. An integral over directions does not
depend on its parametrisation. When the parameters change, the direction d may therefore move with any velocity field
V(d), if the weight contains a factor J with (log J)' = div V. The prime denotes the derivative with respect to a
parameter. Two simple fields are

    V_H    d points to y, which moves with its surface: J_H = |A·d| / r², with A the area element at y
    V_D    d rotates as the normal at x does, about an axis perpendicular to this normal: J_D = 1

With V_H, the edges of emitters and the seams between materials have fixed positions in the integrand. With other
fields, the motion of edges and seams is a boundary term, which the interior term does not contain. However, V_H has
infinite variance wherever two surfaces touch. Let h be the distance from x to the plane of y, and k the distance from y
to the plane of x. If x moves parallel to the plane of y, (log J_H)' grows like 1/h. If y moves perpendicular to the
plane of x, the relative derivative of the cosine at x grows like 1/k. With V_D, this cosine is constant. The field used
here is therefore a blend, with the length h0 of `blend_length`:

    V = φ V_H + (1 - φ) V_D,    φ = (1 - exp(-m)) (1 - exp(-q)),    m = h r / h0²,    q = k / h0
    (log J)' = φ (log J_H)' + ∇φ·(V_H - V_D)

Let n be the normal at y, and n_x the normal at x with n_x·d > 0. All directions that hit the plane of y have the same
h, but different r and k. For a change δd of the direction,

    ∇m·δd = -m (n·δd) / (n·d),    ∇q·δd = (r n_x·δd - k (n·δd) / (n·d)) / h0

The factor r in m keeps V close to V_H at distant hit points on a near plane. Such points may lie on edges. The cost in
variance is small, because only a few directions, all at grazing angles, reach such points. For a sphere, h is the
distance from x to the sphere, which is also independent of d. This distance does not vanish at the silhouette. On other
curved shapes, m is infinite. If x is in a medium, it has no normal: q is infinite, and V_D = 0.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from pathreplay.transport.surface import SurfacePoint, solid_angle, surface_point

# Length h0 relative to the size of the shape that was hit. A larger value gives less noise. Without boundary terms, a
# larger value also omits more of the derivative due to moving edges nearby. docs/gradients.md has measurements for
# 0.003 to 0.03.
BLEND = 0.01
# Value of m (see the module docstring) above which the velocity V equals V_H to within 0.1 %.
CLOSE = 7.0


def blend_length(shape: mi.Shape) -> float:
    """Return the length h0 of a shape: BLEND times the diagonal of its bounding box; 0 for an empty shape group."""
    size = sum(float(x) ** 2 for x in shape.bbox().extents()) ** 0.5
    return BLEND * size if math.isfinite(size) else 0.0


def moved_direction(
    lengths: mi.Float, origin: mi.Interaction3f, d: mi.Vector3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float]:
    """Return the recorded direction ``d``, and J = 1, with the derivatives that the field V prescribes.

    ``lengths`` contains the `blend_length` of each shape, and ``hit`` is the intersection of the continuation from
    ``origin`` along ``d``. Rays that leave the scene have a constant direction. Differentiable in ``origin`` and in the
    shape that was hit.
    """
    valid = active & hit.is_valid()
    y = surface_point(hit, dr.detach(origin.spawn_ray(d)), valid)
    start = origin.spawn_ray(dr.detach(d)).o
    towards = y.p - start
    ok, dist2, log_J_H = solid_angle(y, start, valid)
    d_H = towards * dr.rsqrt(dist2)

    h0 = blend_length_at(lengths, hit, ok)
    n_x = dr.detach(origin.n)
    d_D = dr.cross(dr.cross(n_x, origin.n), dr.detach(d))  # its derivative is V_D
    φ, slope = _share(h0, dr.detach(y), n_x, dr.detach(towards), ok)
    log_J = φ * log_J_H + dr.dot(slope, d_H - d_D)
    return dr.select(ok, dr.replace_grad(d, φ * d_H + (1 - φ) * d_D), d), dr.replace_grad(mi.Float(1), log_J)


def blend_length_at(lengths: mi.Float, hit: mi.PreliminaryIntersection3f, active: mi.Bool | bool = True) -> mi.Float:
    """Return the `blend_length` of the shape that was hit; inside an instance, that of the instance. Zero on a miss."""
    shape = dr.select(hit.instance != None, hit.instance, hit.shape)  # noqa: E711 (an array of pointers)
    return dr.gather(mi.Float, lengths, dr.reinterpret_array(mi.UInt32, shape), active & hit.is_valid())


def jumps_at_facets(
    lengths: mi.Float, origin: mi.Interaction3f, hit: mi.PreliminaryIntersection3f, p: mi.Point3f, n: mi.Normal3f
) -> mi.Bool:
    """Return whether V jumps between the triangle at ``hit`` and the adjacent triangles of the mesh.

    ``p`` and ``n`` are position and normal at the hit. Near the surface, φ depends on the plane of the triangle.
    """
    towards = p - origin.p
    near = dr.abs(dr.dot(n, towards)) * dr.norm(towards) < CLOSE * dr.square(blend_length_at(lengths, hit))
    return hit.is_valid() & (hit.shape.is_mesh() | (hit.instance != None)) & near  # noqa: E711 (an array of pointers)


def held_direction(
    origin: mi.Interaction3f, d: mi.Vector3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.Vector3f:
    """Return ``d`` with the derivatives of the direction from ``origin`` to the hit point, which is fixed on its shape.

    Differentiable in ``origin`` and in the shape that was hit.
    """
    y = surface_point(hit, dr.detach(origin.spawn_ray(d)), active)
    towards = y.p - origin.spawn_ray(dr.detach(d)).o
    ok = active & (dr.squared_norm(towards) > 0)
    return dr.select(ok, dr.replace_grad(d, dr.normalize(towards)), d)


def _share(
    h0: mi.Float, y: SurfacePoint, n_x: mi.Normal3f, towards: mi.Vector3f, active: mi.Bool
) -> tuple[mi.Float, mi.Vector3f]:
    """Compute the blend factor φ and its gradient ∇φ with respect to the direction (see the module docstring).

    ``n_x`` is the normal at x, or zero, and ``towards`` is y - x. All inputs and results are detached.
    """
    r = dr.norm(towards)
    n = dr.normalize(y.A)
    turned = dr.dot(n, towards) > 0
    n = dr.select(turned, -n, n)
    κ = dr.select(turned ^ (dr.dot(y.A, y.n) < 0), -y.κ, y.κ)
    blends = active & (h0 > 0) & dr.isfinite(κ)
    # h = ||x - centre| - 1/|κ||, the distance to the sphere of curvature κ through y, in a form without cancellation.
    # For κ = 0, h is the distance to the plane.
    h = (κ * r * r - 2 * dr.dot(n, towards)) / (1 + dr.norm(n - κ * towards))
    m = dr.maximum(h, 0) * r / dr.square(h0)
    inv_cos = r / dr.dot(n, towards)
    steep = m * dr.exp(-m) * inv_cos
    φ, slope = dr.select(blends, 1 - dr.exp(-m), 1), dr.select(blends & dr.isfinite(steep), -steep * n, 0)

    k = dr.dot(n_x, towards)
    q = dr.abs(k) / h0
    steep_x = φ * dr.exp(-q) * dr.sign(k) * (r * mi.Vector3f(n_x) - k * inv_cos * n) / h0
    blends = active & (h0 > 0) & (dr.squared_norm(n_x) > 0) & dr.isfinite(inv_cos)
    φ_x = dr.select(blends, 1 - dr.exp(-q), 1)
    return φ * φ_x, φ_x * slope + dr.select(blends, steep_x, 0)
