"""Start: generate the first ray of a path, and intersect it with the scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.meet import meet
from pathreplay.transport.vertex import Arrival, TraceConfig
from pathreplay.transport.volume.passage import first_behind, is_boundary, skip_null


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


def behind_emitters(
    trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """Return the first hit that is not on an area emitter: see `first_behind`.

    Mitsuba's ``skip_area_emitters`` measures the distance of this hit from the last emitter instead.
    """
    return first_behind(trace, ray, hit, _is_emitter, active)


def occluder(trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
    """Return the first hit on the way from a light path to the sensor.

    Hidden emitters occlude nothing, and neither do null boundaries in scenes with media. ``ray`` ends at the sensor.
    """
    hides, clear = trace.hide_emitters and trace.traits.area_lights, trace.skips_null or trace.media is not None

    def passes(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        passed = is_boundary(trace, hit, ray, active) if clear else mi.Bool(False)
        return passed | _is_emitter(hit, ray, active) if hides else passed

    hit = meet(trace, ray, active)
    return first_behind(trace, ray, hit, passes, active) if hides or clear else hit


def _is_emitter(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
    return hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 (an array of pointers)


def medium_around(trace: TraceConfig) -> mi.MediumPtr:
    """Return the medium that contains the camera."""
    around = trace.media.around
    return dr.zeros(mi.MediumPtr) if around is None else mi.MediumPtr(around)
