"""Arrive: evaluate the end point of a ray, the emission seen along the ray, and the free flight up to the end point.

Without media, a ray ends at a surface or leaves the scene. With media, a ray may also end at a collision inside a
medium, and the free flight has a weight and emission of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.emitters import emission, vertex_glow
from pathreplay.transport.facts.traits import is_null
from pathreplay.transport.surface import met, met_with_normal, steady
from pathreplay.transport.vertex import Arrival, Flight, TraceConfig, VertexRecord
from pathreplay.transport.volume.flight import Flown, fly, fly_again
from pathreplay.transport.volume.media import interaction


@dataclass
class Vertex:
    """The vertex at the end of a ray: a scattering surface, a collision in a medium, a null boundary, or a miss."""

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    surface: mi.Bool  # the vertex lies on a surface that scatters
    origin: mi.Interaction3f  # origin of the rays that leave the vertex
    glow: mi.Spectrum  # radiance emitted towards the ray's origin, MIS weighted
    inside: InMedium = None  # type: ignore[assignment]  # None in scenes without media
    n: mi.Vector3f | None = None  # on attached light paths, the normal of `met_with_normal`

    def met(self, go_on: mi.Bool) -> mi.Bool:
        """Return whether the ray hit a surface or had a collision. Collisions at the end of a path do not count."""
        return self.si.is_valid() if self.inside is None else self.surface | (self.inside.event & go_on)

    def medium(self, d: mi.Vector3f) -> mi.MediumPtr:
        """Return the medium along a ray that leaves the vertex in direction ``d``, in a scene with media."""
        turns = ~self.inside.event & self.si.is_valid() & self.si.is_medium_transition()
        return dr.select(turns, self.si.target_medium(d), self.inside.around)


@dataclass
class InMedium:
    """The additional state of a vertex in a scene with media."""

    event: mi.Bool  # the flight ended at a real collision in the medium
    through: mi.Bool  # the ray ended at a null boundary, which transmits all light and does not count as a vertex
    around: mi.MediumPtr  # the medium through which the path arrived
    mei: mi.MediumInteraction3f
    phase: mi.PhaseFunctionPtr
    flight: Flight
    w: mi.Spectrum  # weight of the radiance from the vertex: flight.W, multiplied by σ_s / density if ``event``
    e: mi.Spectrum  # radiance emitted by the medium along the flight


def choose(
    trace: TraceConfig, at: Arrival, sampler: Sampler, β: mi.Spectrum, active: mi.Bool, flight: Flight | None = None
) -> Vertex:
    """Evaluate an arrival in the sampling pass. Nothing is differentiated.

    With media, the flight is sampled from ``sampler`` unless ``flight`` is given. The throughput ``β`` affects the
    probability that a collision is real (see `fly`).
    """
    si = at.hit.compute_surface_interaction(at.ray, compat.shading(), active)
    if trace.steady_frames:
        si = steady(si, at.ray, active)
    if trace.media is None:
        return _on_surface(trace, at, si, False, active)
    flight = fly(trace, at, sampler, β, active) if flight is None else flight
    mei = interaction(at.medium, dr.detach(at.ray), flight.t)
    e = mi.Spectrum(0 if flight.E is None else flight.E)
    return _in_medium(trace, at, si, flight, Flown(mei, flight.weight, e), False, active)


def repeat(trace: TraceConfig, again: VertexRecord, attached: bool, active: mi.Bool) -> Vertex:
    """Evaluate a recorded arrival again, differentiable in emission and the coefficients of media.

    If ``attached``, the hit point is also differentiable in the ray and the shape, and the MIS weight of the emission
    is differentiable in the density of the ray.
    """
    at, kept = again.at, again.kept
    n: mi.Vector3f | None = None
    if not attached:
        with dr.suspend_grad():
            si = at.hit.compute_surface_interaction(at.ray, compat.shading(), active)
    elif trace.to_sensor is None:
        si = met(at.hit, at.ray, active)
    else:
        si, n = met_with_normal(at.hit, at.ray, active)
    if kept.media is None:
        known = None if kept.known is None or attached else kept.known.glow
        v = _on_surface(trace, at, si, attached, active, known)
    else:
        reach = dr.select(si.is_valid(), si.t, dr.inf)
        flown = fly_again(trace, at, kept.media.flight, reach, attached, active)
        v = _in_medium(trace, at, si, kept.media.flight, flown, attached, active)
    v.n = n
    return v


def background(trace: TraceConfig, at: Arrival, left: mi.Bool) -> mi.Spectrum:
    """Return the MIS-weighted environment radiance along rays that leave the scene (mask ``left``), differentiably."""
    if trace.scene.environment() is None or trace.to_sensor is not None:
        return mi.Spectrum(0)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.t, si.wi, si.time, si.wavelengths = dr.inf, -at.ray.d, at.ray.time, at.ray.wavelengths
    return emission(trace.scene, at, si, False, sees_lights(trace, at, si, left))


def sees_lights(trace: TraceConfig, at: Arrival, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
    """Return the lanes in which emission along the ray is visible.

    With ``hide_emitters``, the environment is invisible to the camera. If caustics are omitted, an area light is
    invisible to a ray from a delta lobe if the first vertex of the path has scattered with a smooth lobe.
    """
    if trace.without_caustics:
        active = active & ~(at.delta & at.scattered & si.is_valid())
    return active & (~at.camera | si.is_valid()) if trace.hide_emitters else active


def _on_surface(
    trace: TraceConfig,
    at: Arrival,
    si: mi.SurfaceInteraction3f,
    attached: bool,
    active: mi.Bool,
    known: mi.Spectrum | None = None,
) -> Vertex:
    if known is None:
        known = vertex_glow(trace, at, si, attached, sees_lights(trace, at, si, active))
    return Vertex(si, si.bsdf(at.ray), active & si.is_valid(), si, known)


def _in_medium(
    trace: TraceConfig,
    at: Arrival,
    si: mi.SurfaceInteraction3f,
    flight: Flight,
    flown: Flown,
    attached: bool,
    active: mi.Bool,
) -> Vertex:
    event = active & flight.event
    bsdf, phase = si.bsdf(at.ray), at.medium.phase_function()
    surface = active & ~event & si.is_valid()
    through = surface & is_null(bsdf)
    seen = sees_lights(trace, at, si, active & ~event)
    origin = dr.zeros(mi.Interaction3f)
    origin.t, origin.time, origin.wavelengths = mi.Float(0), at.ray.time, at.ray.wavelengths
    origin.p = dr.select(event, flown.mei.p, si.p)
    origin.n = dr.select(event, 0, si.n)
    inside = InMedium(event, through, at.medium, flown.mei, phase, flight, flown.w, flown.e)
    return Vertex(si, bsdf, surface & ~through, origin, vertex_glow(trace, at, si, attached, seen), inside)
