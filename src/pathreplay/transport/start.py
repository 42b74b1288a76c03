"""Start: generate the first ray of a path, and intersect it with the scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.meet import meet
from pathreplay.transport.vertex import Arrival, TraceConfig
from pathreplay.transport.volume.passage import skip_null


class Start(Protocol):
    """The start of paths, at the sensor or at emitters."""

    sampler: Sampler  # source of the random numbers of the paths
    active: mi.Bool

    def choose(self, trace: TraceConfig, active: mi.Bool) -> Arrival:
        """Intersect the rays with the scene. Nothing is differentiated."""

    def repeat(self) -> tuple[mi.Point3f, mi.Vector3f]:
        """Return origin and direction of the rays, differentiably."""


@dataclass
class CameraStart:
    """The start of paths at camera rays. Reverse passes back-propagate the adjoint of each camera ray to the camera."""

    ray: mi.Ray3f  # attached to the camera's parameters, if these have gradients
    sampler: Sampler  # source of the random numbers of the paths
    active: mi.Bool

    def choose(self, trace: TraceConfig, active: mi.Bool) -> Arrival:
        """Intersect the rays with the scene. Nothing is differentiated.

        Camera rays pass through area emitters if these are hidden. Chains of light paths, which start here too, do not.
        """
        ray = mi.Ray3f(dr.detach(self.ray))
        hit = meet(trace, ray, active, coherent=True)
        if trace.skips_null:
            hit = skip_null(trace, ray, hit, active)
        if trace.hide_emitters and trace.to_sensor is None:
            hit = behind_emitters(trace, ray, hit, active)
        at = Arrival(ray=ray, hit=hit, pdf=mi.Float(1), delta=mi.Bool(True), camera=mi.Bool(True))
        if trace.without_caustics:
            at.scattered = mi.Bool(False)
        if trace.media is not None:
            at.medium = medium_around(trace)
            at.behind = mi.Float(0)
        return at

    def repeat(self) -> tuple[mi.Point3f, mi.Vector3f]:
        return self.ray.o, self.ray.d


@dr.syntax
def behind_emitters(
    trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """Return the first hit that is not on an area emitter. Its distance is measured from the origin of ``ray``.

    Mitsuba's ``skip_area_emitters`` measures the distance from the last emitter instead.
    """
    here, onward, gone = mi.PreliminaryIntersection3f(hit), mi.Ray3f(ray), mi.Float(0)
    passing = active & here.is_valid() & (here.shape.emitter() != None)  # noqa: E711 (an array of pointers)
    while dr.hint(passing, exclude=[trace], label="pathreplay: behind emitters"):
        si = here.compute_surface_interaction(onward, compat.minimal(), passing)
        behind = si.spawn_ray(onward.d)
        gone += dr.norm(behind.o - onward.o)
        onward = behind
        here = meet(trace, onward, passing)
        passing &= here.is_valid() & (here.shape.emitter() != None)  # noqa: E711
    here.t += gone
    return here


def occluder(trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
    """Return the first hit on the way from a light path to the sensor. Hidden emitters occlude nothing.

    ``ray`` ends at the sensor.
    """
    hit = meet(trace, ray, active)
    if trace.hide_emitters and trace.traits.area_lights:
        hit = behind_emitters(trace, ray, hit, active)
        hit.valid = hit.is_valid() & (hit.t < ray.maxt)  # `behind_emitters` ignores the end of the ray
    return hit


def medium_around(trace: TraceConfig) -> mi.MediumPtr:
    """Return the medium that contains the camera."""
    around = trace.media.around
    return dr.zeros(mi.MediumPtr) if around is None else mi.MediumPtr(around)
