"""Points of surfaces while rays and shapes move: those that a ray slides to, and those that are held where they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

# Share by which a surface may differ from a sphere (derivatives of its normal) and still be taken for one.
UMBILIC = 1e-4
# Cosine between a ray and the limb of a sphere or cylinder below which nothing follows; as wide a band beside it counts
# for both.
GRAZES = 0.01


def met(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
    """What a ray met, differentiable in the ray and the shape.

    Distances to spheres and cylinders are roots of which the derivative is 1 / cos of the angle to the normal. Its
    square has no mean over rays, and where rounding has put a ray on the limb itself it is many millions. So where the
    cosine is less than `GRAZES`, nothing follows, and what does where it is less than twice that counts twice. Rays
    that are spread evenly meet cosines c with density c, which is what makes up for 1 / c: both bands hold as much of
    the mean. What remains is of second order in `GRAZES`.
    """
    si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active)
    kind = si.shape.shape_type()
    rounded = (kind == int(mi.ShapeType.Sphere)) | (kind == int(mi.ShapeType.Cylinder))
    cos = dr.abs(dr.dot(dr.detach(si.n), dr.detach(ray.d)))
    near = active & rounded & (cos < 2 * GRAZES)
    return _scaled(si, dr.select(near, dr.select(cos < GRAZES, 0, 2), mi.Float(1)))


def _scaled(si: mi.SurfaceInteraction3f, by: mi.Float) -> mi.SurfaceInteraction3f:
    """The same, with so many times its derivatives: zero times those that are not finite is zero."""
    for name in ("t", "p", "n", "uv", "dp_du", "dp_dv", "dn_du", "dn_dv", "wi"):
        setattr(si, name, _times(getattr(si, name), by))
    frame = si.sh_frame
    frame.s, frame.t, frame.n = (_times(axis, by) for axis in (frame.s, frame.t, frame.n))
    return si


def _times(value: Any, by: mi.Float) -> Any:
    moved = dr.select(by == 0, dr.detach(value), value)
    return dr.replace_grad(value, by * moved)


def steady(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
    """The same point of a mesh with a shading frame that its normal decides alone, which no crease makes jump.

    Mitsuba's has the tangent of the triangle. With equal random numbers lobes that are as wide in all directions then
    have equal directions on both sides of a crease.
    """
    turned = mi.SurfaceInteraction3f(si)
    turned.sh_frame = mi.Frame3f(si.sh_frame.n)
    turned.wi = turned.to_local(-ray.d)
    return dr.select(active & si.is_valid() & si.shape.is_mesh(), turned, si)


@dataclass
class HeldPoint:
    """A point that is glued to its surface."""

    p: mi.Point3f
    A: mi.Vector3f  # area element, along the normal; only relative changes of its length mean something
    n: mi.Normal3f  # the side from which κ is seen; detached
    κ: mi.Float  # curvature of a sphere (> 0: convex), 0 of a plane, infinite of what is neither; detached


def held_point(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> HeldPoint:
    """The point that ``ray`` hit, glued to its surface.

    On meshes A is taken from the triangle itself: derivatives by texture coordinates would lose it where these are
    degenerate, and follow them where they move.
    """
    flags = mi.RayFlags.FollowShape
    on_mesh = active & hit.shape.is_mesh()
    y = hit.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.dNGdUV | flags, active)
    triangle = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal | flags, on_mesh)
    A = dr.select(on_mesh, dr.cross(triangle.dp_du, triangle.dp_dv), dr.cross(y.dp_du, y.dp_dv))
    return HeldPoint(y.p, A, dr.detach(y.n), dr.select(on_mesh, 0, _curvature(dr.detach(y))))


def _curvature(y: mi.SurfaceInteraction3f) -> mi.Float:
    """κ with dn = κ dp for all tangents, infinite where there is none."""
    turn = dr.squared_norm(y.dn_du) + dr.squared_norm(y.dn_dv)
    κ = dr.dot(y.dn_du, y.dp_du) / dr.squared_norm(y.dp_du)
    rest = dr.squared_norm(y.dn_du - κ * y.dp_du) + dr.squared_norm(y.dn_dv - κ * y.dp_dv)
    return dr.select(turn == 0, 0, dr.select(rest < UMBILIC * turn, κ, dr.inf))
