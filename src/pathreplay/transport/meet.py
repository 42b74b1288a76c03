"""What a ray meets: every path, shadow ray and line looks for it here.

Mitsuba computes derivatives at a point of a B-spline curve from v, its place along the whole curve, and takes
floor(n v) for the number of its segment, of n. Where v rounds to 1 there is no such segment, and whatever lies behind
the table in memory is read (Mitsuba 3.9.1): garbage, or the process ends. The end of a curve is an edge, on which
lines close in. So hits stay short of the end of their segment, by what rounding may add.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.transport.signature import shape_met
from pathreplay.transport.vertex import TraceConfig

ROUNDING = 2.0**-22
"""Of v = (s + k) / n, for the k-th segment and its own s, in segments per segment before."""


def meet(trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool, coherent: bool = False) -> mi.PreliminaryIntersection3f:
    """What a ray meets. Detached."""
    hit = trace.scene.ray_intersect_preliminary(ray, coherent=coherent, reorder=False, active=active)
    return short_of_end(trace, ray, hit, active)


def short_of_end(
    trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """The same hit; on a B-spline not at the end of a segment."""
    if trace.traits.splines:
        kind = shape_met(trace, hit, ray, active).shape_type()
        on_spline = active & hit.is_valid() & (kind == int(mi.ShapeType.BSplineCurve))
        end = 1 - ROUNDING * (mi.Float(hit.prim_index) + 1)
        hit.prim_uv.x = dr.select(on_spline, dr.minimum(hit.prim_uv.x, end), hit.prim_uv.x)
    return hit
