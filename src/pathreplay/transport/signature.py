"""Signature: what tells paths apart that have an edge between them, and which way that edge lies."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.transport.facts.traits import FACETS, WHOLE, Tables
from pathreplay.transport.surface import held_point
from pathreplay.transport.vertex import TraceConfig

TUBES = mi.ShapeType.Cylinder, mi.ShapeType.BSplineCurve, mi.ShapeType.LinearCurve
"""Open at both ends: an edge is a limb or a rim."""
# Cosine between ray and normal of a tube below which an edge is its limb rather than its rim.
GRAZING = 0.05


def place_met(
    trace: TraceConfig, hit: mi.PreliminaryIntersection3f, active: mi.Bool, shape: mi.ShapePtr, facets: bool = True
) -> mi.UInt32:
    """What a ray met, as a number: 0 for nothing, else one for each shape, copy of a shape, and smoothing group.

    ``shape`` is what `shape_met` says. Triangles of a flat mesh are groups of their own.
    Only if ``facets``.
    """
    met = active & hit.is_valid()
    shape = dr.reinterpret_array(mi.UInt32, shape)
    place = mixed(shape, dr.reinterpret_array(mi.UInt32, hit.instance))
    if facets:
        place = mixed(place, _group(trace.traits.tables, shape, hit.prim_index, met))
    return dr.select(met, place | 1, 0)


def _group(tables: Tables, shape: mi.UInt32, triangle: mi.UInt32, met: mi.Bool) -> mi.UInt32:
    begin = dr.gather(mi.UInt32, tables.groups_at, shape, met)
    flat = begin == FACETS
    group = dr.gather(mi.UInt32, tables.groups, begin + triangle, met & ~flat & (begin != WHOLE))
    return dr.select(flat, triangle + 1, group)


def shape_met(trace: TraceConfig, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.ShapePtr:
    """The shape that a ray met; of a copy that which is copied, which a hit does not tell by itself."""
    if not trace.traits.copies:
        return hit.shape
    return hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, active & hit.is_valid()).shape


def mixed(h: mi.UInt32, x: mi.UInt32) -> mi.UInt32:
    """A number for a pair of numbers (Knuth's multiplicative hashing)."""
    h = (h ^ x) * mi.UInt32(0x9E3779B1)
    return h ^ (h >> 15)


def turned_away(si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Bool:
    """Whether a ray along ``d`` meets a mesh where its shading normal points along it, so that it is dark there.

    Other shapes turn away on their limb only, and there by rounding: what lies there is an outline, and nothing else.
    """
    return si.shape.is_mesh() & (dr.dot(si.sh_frame.n, d) > 0)


def edge_normal(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Vector3f:
    """A unit vector normal to the ray and to the border of the shape that it just met, on which the hit all but lies.

    On meshes the nearest side of the triangle, on rectangles and disks the rim, elsewhere the limb (of tubes
    the nearer of the two). Detached.
    """
    with dr.suspend_grad():
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active)
        kind = si.shape.shape_type()  # not that of the hit, which has none where a copy was met
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
        # Zero where there is none (a triangle without area, a ray along its normal): no edge, and no NaN behind a mask.
        return dr.select(dr.all(dr.isfinite(n)), n, 0)


def outline_gap(
    n: mi.Vector3f,
    o: mi.Point3f,
    d: mi.Vector3f,
    hit: mi.PreliminaryIntersection3f,
    ray: mi.Ray3f,
    active: mi.Bool,
) -> mi.Float:
    """B = n·(o + t d - z): distance, along n, of a line from a point of an outline, z, that ``ray`` hit at t.

    z is glued to its shape. Differentiable in o, d and the shape; zero where not ``active``.
    """
    z = held_point(hit, dr.detach(ray), active).p
    return dr.select(active, dr.dot(n, o + dr.select(active, hit.t, 0) * d - z), 0)


def _nearest_side(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Vector3f:
    corners = []
    for uv in ((0, 0), (1, 0), (0, 1)):
        corner = mi.PreliminaryIntersection3f(hit)
        corner.prim_uv = mi.Point2f(*uv)
        flags = mi.RayFlags.FollowShape | mi.RayFlags.Minimal
        corners.append(corner.compute_surface_interaction(ray, flags, active).p)
    a, b, c = corners
    sides = (c - b, c - a, b - a)  # facing a, b, c
    weights = (1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
    heights = [dr.abs(w) * dr.rcp(dr.norm(side)) for w, side in zip(weights, sides, strict=True)]  # x 2 areas
    nearest = dr.select(heights[1] < heights[2], sides[1], sides[2])
    return dr.select(heights[0] < dr.minimum(heights[1], heights[2]), sides[0], nearest)
