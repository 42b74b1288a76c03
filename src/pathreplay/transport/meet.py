"""Ray intersection for paths, shadow rays and boundary segments, with a workaround for the ends of B-spline curves.

At a point of a B-spline curve with n segments, Mitsuba 3.9.1 computes derivatives from the global curve parameter v and
takes floor(n v) as the segment index. Where v rounds to 1 this index is out of range, and Mitsuba reads past the end of
its table: the result is garbage, or the process crashes. Boundary sampling is likely to hit this case, because the end
of a curve is an edge to which bisection converges. Hits near the end of a segment are therefore moved away from the
end, by a bound on the rounding error.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.transport.signature import shape_met
from pathreplay.transport.vertex import TraceConfig

ROUNDING = 2.0**-22
"""The rounding error of n v in segment k is at most this value times k + 1."""


def meet(trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool, coherent: bool = False) -> mi.PreliminaryIntersection3f:
    """Intersect a ray with the scene, with the workaround for curve ends. Detached."""
    hit = trace.scene.ray_intersect_preliminary(ray, coherent=coherent, reorder=False, active=active)
    if trace.traits.splines:
        kind = shape_met(trace, hit, ray, active).shape_type()
        on_spline = active & hit.is_valid() & (kind == int(mi.ShapeType.BSplineCurve))
        end = 1 - ROUNDING * (mi.Float(hit.prim_index) + 1)
        hit.prim_uv.x = dr.select(on_spline, dr.minimum(hit.prim_uv.x, end), hit.prim_uv.x)
    return hit
