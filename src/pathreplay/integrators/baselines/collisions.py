"""Derivatives of individual tentative collisions along a path, used by `listing`.

The collisions are not stored. They are reproduced from the random numbers with which the path was sampled.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import backward
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.vertex import Arrival, Flight, TraceConfig, reciprocal
from pathreplay.transport.volume.media import interaction, majorant, span
from pathreplay.transport.volume.shadow import Stretch


@dr.syntax
def differentiate_flight(at: Arrival, flight: Flight, past: Sampler, active: mi.Bool, weight: mi.Spectrum) -> None:
    """Differentiate the collisions of a flight; ``past`` is the sampler state before the flight."""
    medium, ray = at.medium, at.ray
    flying = active & (medium != None)  # noqa: E711 (an array of pointers)
    a, b = span(medium, ray, dr.select(at.hit.is_valid(), at.hit.t, dr.inf), flying)
    flying &= a < b
    σ_bar = majorant(medium, ray, flying)
    t = mi.Float(a)
    while dr.hint(flying, exclude=[at, flight], label="pathreplay: listing, flight"):
        u = past.next_1d(flying)
        t += dr.select(σ_bar > 0, -dr.log(1 - u) * dr.rcp(σ_bar), dr.inf)
        inside = flying & (t < b)
        past.next_1d(inside)  # skips the random number that decided between a real and a null collision
        real = inside & flight.event & (t >= flight.t)
        flying = inside & ~real
        _differentiate(medium, ray, t, σ_bar, flying, real, weight)
    past.next_1d(active)


@dr.syntax
def differentiate_shadow(
    trace: TraceConfig, ray: mi.Ray3f, medium: mi.MediumPtr, past: Sampler, active: mi.Bool, weight: mi.Spectrum
) -> None:
    """Differentiate the tentative collisions of an unoccluded shadow ray. There are none in homogeneous media."""
    stretch = Stretch.begin(ray, medium, active)
    while dr.hint(stretch.active, exclude=[trace], label="pathreplay: listing, shadow"):
        hit, a, b, inside = stretch.part(trace)
        σ_bar = majorant(stretch.medium, stretch.ray, inside)
        tracked = inside & (σ_bar > 0)
        if dr.hint(trace.media.homogeneous, mode="scalar"):
            tracked &= ~stretch.medium.is_homogeneous()  # homogeneous media have a closed form, which needs no tracking
        t = mi.Float(a)
        while dr.hint(tracked, label="pathreplay: listing, ratio tracking"):
            t -= dr.log(1 - past.next_1d(tracked)) / σ_bar
            tracked &= t < b
            _differentiate(stretch.medium, stretch.ray, t, σ_bar, tracked, mi.Bool(False), weight)
        past.next_1d(inside)
        stretch = stretch.beyond(trace, hit, mi.Spectrum(1))[0]


def _differentiate(
    medium: mi.MediumPtr, ray: mi.Ray3f, t: mi.Float, σ_bar: mi.Float, null: mi.Bool, real: mi.Bool, weight: mi.Spectrum
) -> None:
    """Differentiate a null or real collision at ``t``; ``weight`` is the transmitted radiance times its adjoint."""
    with dr.resume_grad():
        σ_s, _, σ_t = medium.get_scattering_coefficients(interaction(medium, ray, t), null | real)
        log = dr.select(null, -σ_t * dr.detach(reciprocal(σ_bar - σ_t)), 0)
        log += dr.select(real, σ_s * dr.detach(reciprocal(σ_s)), 0)
        if dr.grad_enabled(log):
            backward(dr.sum(weight * log))
