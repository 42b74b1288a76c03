"""Surface interactions under motion: hit points that follow the ray, and points with fixed surface coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat

T = TypeVar("T", bound="dr.ArrayBase")

# A surface with normal n and position p is treated as a sphere of curvature κ if dn = κ dp is satisfied up to this
# squared relative error.
UMBILIC = 1e-4
# Derivatives of hits on spheres and cylinders are set to zero if the cosine between ray and normal is below this value.
# In compensation, they are doubled between this value and twice this value.
GRAZES = 0.01
FIELDS = "p", "n", "uv", "dp_du", "dp_dv", "dn_du", "dn_dv"
"""Fields of an interaction that describe the surface, without the shading frame."""


def met(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
    """Compute the surface interaction of a hit, differentiable in the ray and the shape.

    The derivative of the distance to a sphere or cylinder is proportional to 1 / c, with c the cosine between ray and
    normal. The mean square of this derivative over rays is infinite. Where rounding puts a ray onto the silhouette, the
    derivative reaches many millions. Derivatives are therefore set to zero for c < `GRAZES` and doubled for `GRAZES` <=
    c < 2 `GRAZES`. The doubling preserves the mean, because both bands contribute equally: for uniformly distributed
    rays, the density of c is proportional to c and cancels 1 / c. The remaining bias is of second order in `GRAZES`.
    """
    si = hit.compute_surface_interaction(ray, compat.shading(), active)
    kind = si.shape.shape_type()
    rounded = (kind == int(mi.ShapeType.Sphere)) | (kind == int(mi.ShapeType.Cylinder))
    cos = dr.abs(dr.dot(dr.detach(si.n), dr.detach(ray.d)))
    near = active & rounded & (cos < 2 * GRAZES)
    return _scaled(si, dr.select(near, dr.select(cos < GRAZES, 0, 2), mi.Float(1)))


def _scaled(si: mi.SurfaceInteraction3f, by: mi.Float) -> mi.SurfaceInteraction3f:
    """Scale the derivatives of the interaction by ``by``; a factor of zero also removes non-finite derivatives."""
    for name in (*FIELDS, "t", "wi"):
        setattr(si, name, _times(getattr(si, name), by))
    frame = si.sh_frame
    frame.s, frame.t, frame.n = (_times(axis, by) for axis in (frame.s, frame.t, frame.n))
    return si


def _times(value: T, by: mi.Float) -> T:
    moved = dr.select(by == 0, dr.detach(value), value)
    return dr.replace_grad(value, by * moved)


def steady(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
    """Replace the shading frame of mesh hits by a frame that depends only on the shading normal.

    Mitsuba's frame uses the tangent of the triangle and is discontinuous across mesh edges. With the new frame, an
    isotropic lobe sampled with equal random numbers gives equal directions on both sides of an edge.
    """
    turned = mi.SurfaceInteraction3f(si)
    turned.sh_frame = mi.Frame3f(si.sh_frame.n)
    turned.wi = turned.to_local(-ray.d)
    return dr.select(active & si.is_valid() & si.shape.is_mesh(), turned, si)


def met_with_normal(
    hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Vector3f]:
    """Return `met`, and the geometric normal in the shading frame, differentiable in the shape only.

    The normal is that of a constant position on the shape. On a mesh with interpolated normals, the normal in the
    shading frame drifts as the position moves within a triangle, and jumps back at the edge to the next triangle. Drift
    and jumps nearly cancel in the mean, but automatic differentiation would include the drift only.

    To first order, a hit point moves with its shape, and slides over the static shape along a ray that moves relative
    to the shape. The two motions are computed separately. The former also gives the normal, and the arrays of the shape
    then receive one gradient, not two. Near silhouettes, only the slide is modified as described in `met`: the motion
    with the shape is bounded.
    """
    y = hit.compute_surface_interaction(dr.detach(ray), compat.shading() | compat.follow_shape(), active)
    if not dr.grad_enabled(y):
        si = met(hit, ray, active)
        return si, dr.detach(si.to_local(si.n))
    relative = mi.Ray3f(ray)
    relative.o = ray.o - _motion(y.p)
    with dr.suspend_grad(), dr.resume_grad(relative.o, relative.d):
        si = met(hit, relative, active)
    for moved, followed, names in ((si, y, FIELDS), (si.sh_frame, y.sh_frame, ("s", "t", "n"))):
        for name in names:
            setattr(moved, name, getattr(moved, name) + _motion(getattr(followed, name)))
    si.wi = dr.select(si.is_valid(), si.to_local(-ray.d), -ray.d)
    return si, dr.replace_grad(dr.detach(si.to_local(si.n)), y.to_local(y.n))


def _motion(value: T) -> T:
    """Return zero with the derivatives of ``value``."""
    return dr.replace_grad(type(value)(0), value)


@dataclass
class SurfacePoint:
    """A point with fixed surface coordinates, which moves with its surface."""

    p: mi.Point3f
    A: mi.Vector3f  # normal times area element, up to a constant factor
    n: mi.Normal3f  # normal that determines the sign of κ; detached
    κ: mi.Float  # curvature of a sphere (> 0: convex), 0 for a plane, infinite for other surfaces; detached


def surface_point(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> SurfacePoint:
    """Return the point that ``ray`` hit, with fixed surface coordinates.

    On meshes, the area vector A is the cross product of two sides of the triangle. A is not computed from derivatives
    of the position with respect to texture coordinates: these derivatives vanish if the texture coordinates are
    degenerate, and change if the texture coordinates move.
    """
    on_mesh = active & hit.shape.is_mesh()
    x, A = compat.triangle_point(hit, ray, on_mesh)
    on_triangle = SurfacePoint(x.p, A, dr.detach(x.n), mi.Float(0))
    y = hit.compute_surface_interaction(ray, compat.normal_partials() | compat.follow_shape(), active & ~on_mesh)
    elsewhere = SurfacePoint(y.p, dr.cross(y.dp_du, y.dp_dv), dr.detach(y.n), _curvature(dr.detach(y)))
    return dr.select(on_mesh, on_triangle, elsewhere)


def solid_angle(y: SurfacePoint, origin: mi.Point3f, active: mi.Bool) -> tuple[mi.Bool, mi.Float, mi.Float]:
    """Compute the log of the solid angle of the area element at ``y``, as seen from ``origin``, up to a constant.

    Returns the lanes in which the solid angle is not zero, the squared distance of ``y``, and the logarithm. The
    logarithm is used because powers of the tiny distances in corners would overflow.
    """
    towards = y.p - origin
    facing = dr.abs(dr.dot(y.A, towards))
    ok = active & (facing > 0)
    dist2 = dr.select(ok, dr.squared_norm(towards), 1)
    return ok, dist2, dr.log(dr.select(ok, facing, 1)) - 1.5 * dr.log(dist2)


def _curvature(y: mi.SurfaceInteraction3f) -> mi.Float:
    """Return the curvature κ of a surface: dn = κ dp for the normal n and point p. Infinite if no such κ exists."""
    turn = dr.squared_norm(y.dn_du) + dr.squared_norm(y.dn_dv)
    κ = dr.dot(y.dn_du, y.dp_du) / dr.squared_norm(y.dp_du)
    rest = dr.squared_norm(y.dn_du - κ * y.dp_du) + dr.squared_norm(y.dn_dv - κ * y.dp_dv)
    return dr.select(turn == 0, 0, dr.select(rest < UMBILIC * turn, κ, dr.inf))
