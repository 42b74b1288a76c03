"""Edge normals, and hashes of the surfaces that rays hit. The hashes of two rays with an edge between them differ."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.transport.facts.traits import FACETS, WHOLE, Tables
from pathreplay.transport.surface import surface_point
from pathreplay.transport.vertex import TraceConfig

TUBES = mi.ShapeType.Cylinder, mi.ShapeType.BSplineCurve, mi.ShapeType.LinearCurve
"""Shapes that are open at both ends: their outlines consist of silhouettes and rims."""
# The edge of a tube is its silhouette if the cosine between ray and normal is smaller than `GRAZING`, and its rim
# otherwise.
GRAZING = 0.05


def place_met(
    trace: TraceConfig, hit: mi.PreliminaryIntersection3f, active: mi.Bool, shape: mi.ShapePtr, facets: bool = True
) -> mi.UInt32:
    """Compute a hash of the surface that a ray hit, from shape, instance and smoothing group; 0 on a miss.

    ``shape`` is the result of `shape_met`. Smoothing groups are distinguished only if ``facets``; each triangle of a
    flat-shaded mesh is its own group.
    """
    met = active & hit.is_valid()
    number = dr.reinterpret_array(mi.UInt32, shape)
    place = mixed(number, dr.reinterpret_array(mi.UInt32, hit.instance))
    if facets:
        place = mixed(place, _group(trace.traits.tables, number, hit.prim_index, met))
    return dr.select(met, place | 1, 0)


def _group(tables: Tables, shape: mi.UInt32, triangle: mi.UInt32, met: mi.Bool) -> mi.UInt32:
    begin = dr.gather(mi.UInt32, tables.groups_at, shape, met)
    flat = begin == FACETS
    group = dr.gather(mi.UInt32, tables.groups, begin + triangle, met & ~flat & (begin != WHOLE))
    return dr.select(flat, triangle + 1, group)


def shape_met(trace: TraceConfig, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.ShapePtr:
    """Return the shape that a ray hit. For a shape inside an instance, ``hit.shape`` is not this shape."""
    if not trace.traits.copies:
        return hit.shape
    return hit.compute_surface_interaction(ray, compat.minimal(), active & hit.is_valid()).shape


def mixed(h: mi.UInt32, x: mi.UInt32) -> mi.UInt32:
    """Hash two integers (Knuth's multiplicative hashing)."""
    h = (h ^ x) * mi.UInt32(0x9E3779B1)
    return h ^ (h >> 15)


def turned_away(si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Bool:
    """Return whether the shading normal of a mesh faces away from a ray along ``d``, so that shading is black.

    On other shapes, the result is False. Normals of other shapes face away only through rounding at the silhouette,
    which is detected as an edge in any case.
    """
    return si.shape.is_mesh() & (dr.dot(si.sh_frame.n, d) > 0)


def horizon_gap(sunsky: mi.Emitter, d: mi.Vector3f) -> mi.Float:
    """Return the height of a direction above the horizon of a `sunsky`, which is black where the result is negative.

    Differentiable in ``d``.
    """
    return (dr.detach(sunsky.world_transform()).inverse() @ d).z


def edge_normal(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Vector3f:
    """Compute the unit vector perpendicular to the ray and to an edge near the hit. Detached.

    The edge is the nearest side of the triangle on meshes, the rim on rectangles and disks, the rim or the silhouette
    on tubes (see `GRAZING`), and the silhouette on other shapes.
    """
    with dr.suspend_grad():
        si = hit.compute_surface_interaction(ray, compat.shading(), active)
        kind = si.shape.shape_type()  # hit.shape may be an instance, which has no type
        on_mesh = active & si.shape.is_mesh()
        square, disk = kind == int(mi.ShapeType.Rectangle), kind == int(mi.ShapeType.Disk)
        limb = dr.abs(dr.dot(si.n, ray.d)) < GRAZING
        tube = mi.Bool(False)
        for of_tubes in TUBES:
            tube |= kind == int(of_tubes)
        rim = disk | (tube & ~limb)
        # Distance to the sides u = 0, 1 and v = 0, 1.
        to_u = dr.minimum(si.uv.x, 1 - si.uv.x) * dr.norm(si.dp_du)
        to_v = dr.minimum(si.uv.y, 1 - si.uv.y) * dr.norm(si.dp_dv)
        side = dr.select(to_u < to_v, si.dp_dv, si.dp_du)
        side = dr.select(
            on_mesh, _nearest_side(hit, ray, on_mesh), dr.select(square, side, dr.select(tube, si.dp_du, si.dp_dv))
        )
        straight = on_mesh | square | rim
        n = dr.normalize(dr.select(straight, dr.cross(side, ray.d), si.n - dr.dot(si.n, ray.d) * ray.d))
        # Return zero instead of NaN where no normal exists: on a triangle without area, or for a ray along its normal.
        return dr.select(dr.all(dr.isfinite(n)), n, 0)


def outline_gap(
    n: mi.Vector3f,
    o: mi.Point3f,
    d: mi.Vector3f,
    hit: mi.PreliminaryIntersection3f,
    ray: mi.Ray3f,
    active: mi.Bool,
) -> mi.Float:
    """Evaluate B = n·(o + t d - z): the signed distance, along n, from a point z of an outline to the line (o, d).

    ``ray`` hit z at distance t. The point z has fixed surface coordinates on its shape. Differentiable in o, d and the
    shape; zero where not ``active``.
    """
    z = surface_point(hit, dr.detach(ray), active).p
    return dr.select(active, dr.dot(n, o + dr.select(active, hit.t, 0) * d - z), 0)


def _nearest_side(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Vector3f:
    a, b, c = compat.triangle_corners(hit, ray, active)
    sides = (c - b, c - a, b - a)  # the sides opposite to a, b and c
    weights = (1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
    # Distances of the hit point from the sides, divided by twice the area of the triangle.
    heights = [dr.abs(w) * dr.rcp(dr.norm(side)) for w, side in zip(weights, sides, strict=True)]
    nearest = dr.select(heights[1] < heights[2], sides[1], sides[2])
    return dr.select(heights[0] < dr.minimum(heights[1], heights[2]), sides[0], nearest)
