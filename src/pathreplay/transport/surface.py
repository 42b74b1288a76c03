"""Points that are held on a surface while it moves: where they go, and how the area around them grows."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def held_point(hit: Any, ray: Any, active: Any) -> tuple[Any, Any]:
    """The point that was hit, glued to its surface, and an area element around it.

    Returns p (Point3f) and A (Vector3f), whose length is proportional to the area of a piece of surface at p and whose
    direction is its normal. Only relative changes of A mean something. On meshes A is taken from the triangle itself:
    derivatives by texture coordinates would lose it where these are degenerate, and follow them where they move.
    """
    flags = mi.RayFlags.FollowShape
    on_mesh = active & hit.shape.is_mesh()
    y = hit.compute_surface_interaction(ray, mi.RayFlags.All | flags, active)
    triangle = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal | flags, on_mesh)
    A = dr.select(on_mesh, dr.cross(triangle.dp_du, triangle.dp_dv), dr.cross(y.dp_du, y.dp_dv))
    return y.p, A
