"""Shadow rays through media and null boundaries: ratio tracking, and the derivative of the estimated transmittance.

T = exp(-∫ σ_t ds) is estimated separately for each segment between boundaries. In homogeneous media, T is known in
closed form. The derivative is estimated at one point y, uniformly distributed over the total length Λ of media on the
ray, as d log T = -Λ dσ_t(y).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.meet import meet
from pathreplay.transport.vertex import Shadow, TraceConfig
from pathreplay.transport.volume.media import carried, interaction, is_grid, majorant, span


@dataclass
class Stretch:
    """Loop state of a shadow ray: the segment up to the next surface. The segment contains at most one medium."""

    ray: mi.Ray3f  # the rest of the shadow ray, behind the last surface that it met
    end: mi.Point3f  # end of the shadow ray
    gone: mi.Float  # distance from the shadow ray's origin to the last surface
    medium: mi.MediumPtr
    active: mi.Bool

    @staticmethod
    def begin(ray: mi.Ray3f, medium: mi.MediumPtr, active: mi.Bool) -> Stretch:
        """Return the first segment of a ray that starts in ``medium``. Detached."""
        ray = mi.Ray3f(dr.detach(ray))
        return Stretch(ray, ray(ray.maxt), mi.Float(0), mi.MediumPtr(medium), mi.Bool(active))

    def part(self, trace: TraceConfig) -> tuple[mi.PreliminaryIntersection3f, mi.Float, mi.Float, mi.Bool]:
        """Return the surface at the segment's end, the part [a, b] inside a medium, and the mask of non-empty parts."""
        hit = meet(trace, self.ray, self.active)
        inside = self.active & (self.medium != None)  # noqa: E711 (an array of pointers)
        a, b = span(self.medium, self.ray, dr.select(self.active & hit.is_valid(), hit.t, self.ray.maxt), inside)
        return hit, a, b, inside & (a < b)

    def beyond(
        self, trace: TraceConfig, hit: mi.PreliminaryIntersection3f, T: mi.Spectrum
    ) -> tuple[Stretch, mi.Spectrum]:
        """Return the segment behind the surface at ``hit``, and ``T`` times the null transmission of the surface.

        The segment leads to the end of the shadow ray. If it kept its direction, the offset of its origin along the
        normal would shift it sideways, and it might meet the emitter at whose surface it should end. On the way from a
        light path to the sensor, emitters hidden by ``hide_emitters`` occlude nothing.
        """
        met, ray = self.active & hit.is_valid(), mi.Ray3f(self.ray)
        si = hit.compute_surface_interaction(ray, compat.shading(), met)
        transmission = si.bsdf(ray).eval_null_transmission(si, met)
        if trace.hide_emitters and trace.to_sensor is not None:
            transmission = dr.select(si.shape.emitter() != None, 1, transmission)  # noqa: E711 (an array of pointers)
        T = dr.select(met, T * transmission, T)
        medium = dr.select(met & si.is_medium_transition(), si.target_medium(ray.d), self.medium)
        o = si.spawn_ray(ray.d).o
        gone, rest = self.gone + dr.select(met, dr.norm(o - ray.o), 0), self.end - o
        ends = dr.isfinite(dr.squared_norm(rest))
        ahead = ~ends | (dr.dot(rest, ray.d) > 0)
        turned = met & ends & ahead
        ray.o, ray.d = dr.select(met, o, ray.o), dr.select(turned, dr.normalize(rest), ray.d)
        ray.maxt = dr.select(turned, dr.norm(rest), ray.maxt)
        return Stretch(ray, self.end, gone, medium, met & ahead & dr.any(T != 0)), T


@dr.syntax
def shadow(trace: TraceConfig, ray: mi.Ray3f, medium: mi.MediumPtr, sampler: Sampler, active: mi.Bool) -> Shadow:
    """Estimate the transmittance along a shadow ray that starts in ``medium``. Detached."""
    stretch = Stretch.begin(ray, medium, active)
    T = mi.Spectrum(1)
    y, y_medium, length = mi.Float(0), dr.zeros(mi.MediumPtr), mi.Float(0)

    while dr.hint(stretch.active, exclude=[trace], label="pathreplay: shadow"):
        hit, a, b, inside = stretch.part(trace)
        T = dr.select(inside, T * transmittance(trace, stretch.medium, stretch.ray, a, b, sampler, inside), T)
        length += b - a
        u = sampler.next_1d(inside) * length
        picked = inside & (u < b - a)
        y = dr.select(picked, stretch.gone + a + u, y)
        y_medium = dr.select(picked, stretch.medium, y_medium)
        stretch, T = stretch.beyond(trace, hit, T)

    return Shadow(T=T, y=y, medium=y_medium, length=length)


def transmittance(
    trace: TraceConfig,
    medium: mi.MediumPtr,
    ray: mi.Ray3f,
    a: mi.Float,
    b: mi.Float,
    sampler: Sampler,
    active: mi.Bool,
) -> mi.Spectrum:
    """Estimate the transmittance of one medium between the distances a and b, without bias."""
    media = trace.media
    T = mi.Spectrum(1)
    rest = mi.Bool(active)
    for grid in media.grids:
        mine = active & is_grid(grid, medium)
        part = mi.Ray3f(ray.o + a * ray.d, ray.d, ray.time, ray.wavelengths)
        part.maxt = b - a
        T = dr.select(mine, grid.transmittance(part, sampler, mine), T)
        rest &= ~mine
    if media.homogeneous:
        same = rest & medium.is_homogeneous()
        σ_t = dr.detach(medium.get_scattering_coefficients(interaction(medium, ray, a), same)[2])
        T = dr.select(same, mi.Spectrum(dr.exp(-σ_t * (b - a))), T)
        rest &= ~same
    if media.plain:
        T = dr.select(rest, ratio_tracking(medium, ray, a, b, sampler, rest), T)
    return T


@dr.syntax
def ratio_tracking(
    medium: mi.MediumPtr, ray: mi.Ray3f, a: mi.Float, b: mi.Float, sampler: Sampler, active: mi.Bool
) -> mi.Spectrum:
    """Estimate T = Π (1 - σ_t/σ̄) over tentative collisions between a and b, with Mitsuba's global majorant."""
    σ_bar = majorant(medium, ray, active)
    active = active & (σ_bar > 0)
    t = mi.Float(a)
    T = mi.Spectrum(1)
    while dr.hint(active, label="pathreplay: ratio tracking"):
        t -= dr.log(1 - sampler.next_1d(active)) / σ_bar
        active &= t < b
        _, _, σ_t = medium.get_scattering_coefficients(interaction(medium, ray, t), active)
        T = dr.select(active, T * (1 - dr.detach(σ_t) / σ_bar), T)
        active &= dr.any(T != 0)
    return T


def shadow_again(trace: TraceConfig, ray: mi.Ray3f, kept: Shadow, attached: bool, active: mi.Bool) -> mi.Spectrum:
    """Return the recorded transmittance, differentiable in σ_t and, if ``attached``, in the two ends of the ray.

    The derivative is estimated at the recorded point y. The relative position of y between the last surface before y
    and the first surface behind y is constant. If there is no such surface, the end of the ray takes its place.
    """
    walked = active & (kept.medium != None)  # noqa: E711
    y, growth = kept.y, mi.Float(1)
    if attached:
        still = dr.detach(ray)
        near, reach = _boundary(trace, ray, still, kept.y, -1, walked), _boundary(trace, ray, still, kept.y, 1, walked)
        a, b = span(kept.medium, ray, reach, walked)
        a = dr.maximum(a, near)
        y, growth = carried(y, a, b, walked)
    else:
        ray = dr.detach(ray)
    _, _, σ_t = kept.medium.get_scattering_coefficients(interaction(kept.medium, ray, y), walked)
    if not dr.grad_enabled(σ_t, growth):
        return kept.T
    log_T = dr.select(walked, -kept.length * growth * σ_t, 0)
    return kept.T * dr.replace_grad(mi.Spectrum(1), log_T)


def _boundary(trace: TraceConfig, ray: mi.Ray3f, still: mi.Ray3f, y: mi.Float, sign: int, active: mi.Bool) -> mi.Float:
    """Return the distance along ``ray`` of the first surface behind y (sign 1) or the last surface before y (sign -1).

    Without such a surface, return the distance of the ray's end (sign 1) or 0 (sign -1). Differentiable in the ray and
    in the surface.
    """
    probe = mi.Ray3f(still.o + y * still.d, sign * still.d, still.time, still.wavelengths)
    probe.maxt = still.maxt - y if sign > 0 else y
    hit = meet(trace, probe, active)
    met = active & hit.is_valid()
    # The attached ray must start at y, too: on a sphere, Mitsuba computes the hit again, as the ray's first hit.
    probe.o, probe.d = ray.o + y * ray.d, sign * ray.d
    si = hit.compute_surface_interaction(probe, compat.shading(), met)
    return dr.select(met, dr.replace_grad(y + sign * hit.t, y + sign * si.t), ray.maxt if sign > 0 else 0)
