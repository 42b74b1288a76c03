"""Passage: what a straight line meets behind null boundaries, and what media on the way leave of its light.

Edges are looked for as if null boundaries were not there: light goes straight through them, so that they hide nothing.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .shadow import Stretch, transmittance
from .traits import is_null
from .vertex import Walk


@dr.syntax
def beyond_null(
    scene: mi.Scene, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """The hit, or the first one behind null boundaries; distances are told along ``ray``."""
    here, onward, gone = mi.PreliminaryIntersection3f(hit), mi.Ray3f(ray), mi.Float(0)
    passing = active & _is_boundary(here)
    while dr.hint(passing, exclude=[scene, ray], label="pathreplay: beyond null boundaries"):
        si = here.compute_surface_interaction(onward, mi.RayFlags.Minimal, passing)
        o = si.spawn_ray(ray.d).o
        gone += dr.norm(o - onward.o)
        onward.o, onward.maxt = o, ray.maxt - gone
        here = scene.ray_intersect_preliminary(onward, coherent=False, reorder=False, active=passing)
        passing &= _is_boundary(here)
    here.t += gone
    return here


def _is_boundary(hit: mi.PreliminaryIntersection3f) -> mi.Bool:
    return hit.is_valid() & is_null(hit.shape.bsdf())


@dr.syntax
def passage(
    walk: Walk, ray: mi.Ray3f, reach: mi.Float, medium: mi.MediumPtr, sampler: mi.Sampler, active: mi.Bool
) -> tuple[mi.Spectrum, mi.MediumPtr]:
    """The transmittance of the first ``reach`` of a ray that starts in ``medium``, and the medium there. Detached."""
    ray = mi.Ray3f(ray)
    ray.maxt = reach
    stretch = Stretch.begin(ray, medium, active)
    T = mi.Spectrum(1)
    while dr.hint(stretch.active, exclude=[walk], label="pathreplay: passage"):
        hit, a, b, inside = stretch.part(walk.scene)
        T = dr.select(inside, T * transmittance(walk, stretch.medium, stretch.ray, a, b, sampler, inside), T)
        stretch, T = stretch.beyond(hit, T)
    return T, stretch.medium
