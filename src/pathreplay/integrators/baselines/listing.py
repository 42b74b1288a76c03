"""Differentiable delta tracking as first published: path replay with differentiated tentative collisions.

A second pass with the same random numbers differentiates each tentative collision: null collisions as dσ_n/σ_n and real
collisions as dσ_s/σ_s (supplement of Vicini, Speierer, Jakob 2021, listings 1 and 2). Where σ_n is zero, no null
collision is sampled, and the gradient lacks the derivative of null collisions. Where σ_s is zero, no real collision is
sampled, and the gradient lacks the derivative of real collisions. On a constant grid, σ_n is zero everywhere, and the
gradient lacks the whole derivative of the transmittance. The integrator `pathreplay` does not have these limitations.
This method exists for comparison only.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, backward
from pathreplay.adjoint.primal import path_radiance
from pathreplay.errors import PathreplayError
from pathreplay.integrators.baselines.collisions import differentiate_flight, differentiate_shadow
from pathreplay.transport import arrive, scatter
from pathreplay.transport.connect import Connection
from pathreplay.transport.emitters import redraw_emitter
from pathreplay.transport.motion import path_moves
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig, VertexSamples, reciprocal


@dr.syntax
def listing(trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into the parameters.

    Each medium has a single majorant. The gradient lacks the derivatives that the listings miss (see the module).
    Visibility and the emission of media are not differentiated. Raises PathreplayError if the scene has no media, or if
    vertices or directions of the paths depend on parameters with gradients.
    """
    if dr.hint(trace.media is None, mode="scalar"):
        raise PathreplayError("prb_volume_listing differentiates media, and the scene has none: use 'pathreplay'")
    # Use Mitsuba's interface for all media, so that every tracked collision can be differentiated.
    trace = replace(trace, media=replace(trace.media, grids=(), plain=True))
    sampler, path = start.sampler, PathState.begin(trace, start)
    if dr.hint(path_moves(trace, start, path.at), mode="scalar"):
        raise PathreplayError("prb_volume_listing does not differentiate motion: use 'pathreplay'")
    L = path_radiance(trace, sampler.clone(), dr.copy(path))[0]  # the loop subtracts the contribution of each vertex
    ctx = mi.BSDFContext()

    while dr.hint(path.active, exclude=[trace, ctx], label="pathreplay: listing"):
        past = sampler.clone()
        VertexSamples.draw(past)
        u, step = path.choose(trace, sampler)
        kept = step.kept

        # The weights of the flight's null collisions, and of its real collision if there is one, multiply all radiance
        # along the ray.
        differentiate_flight(path.at, kept.media.flight, past, path.active, δL * L)
        L -= path.β * step.e

        onward, repeated = path.advance(trace, u, step)
        with dr.resume_grad():
            v = arrive.choose(trace, path.at, past, path.β, path.active, kept.media.flight)
            light, Le = redraw_emitter(trace, v.origin, u.light, kept.light, False, kept.lit)
            f, pdf = scatter.towards(v, ctx, light.d, kept.lit)
            reached = Connection(light, Le * kept.media.shadow.T, kept.lit).reaches(pdf, False)
            lighting = v.inside.w * dr.select(kept.lit, f * reached, 0)
            w = scatter.repeat(trace, v, repeated, ctx, False)[0]
            w *= v.inside.w
            Lo = path.β * (v.inside.e + v.inside.w * v.glow + lighting) + L * w * dr.detach(reciprocal(w))
            if dr.hint(dr.grad_enabled(Lo), mode="scalar"):
                backward(dr.sum(δL * Lo))

        # The weights of the tentative collisions along the shadow ray multiply the radiance of the emitter sample.
        ray, begins = v.origin.spawn_ray_to(light.p), v.medium(light.d)
        differentiate_shadow(trace, ray, begins, past, kept.lit, δL * path.β * dr.detach(lighting))
        path = onward
    return False
