"""The step in scenes with media: a flight to a particle or a surface, what the vertex adds there, and how it scatters.

The sibling of `surface_step`: L_i = e_i + w_i L_{i+1}, where e_i and w_i now hold the transmittance of the flight, and
where the vertex may be a particle. One emitter sample and one shadow ray serve both kinds of vertices.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .emitters import draw_emitter, emission, redraw_emitter
from .flight import Flight, fly, fly_again
from .lobes import scatter
from .media import interaction
from .shadow import shadow, shadow_again
from .velocity import moved_direction
from .vertex import Arrival, Kept, Numbers, Step, Walk, is_smooth, mis_weight, reciprocal


def medium_step(
    walk: Walk,
    at: Arrival,
    u: Numbers,
    go_on: Any,
    active: Any,
    sampler: Any = None,
    β: Any = None,
    kept: Kept | None = None,
    attached: bool = False,
    hit_next: Any = None,
    flight: Flight | None = None,
) -> Step:
    """Evaluate L_i = e_i + w_i L_{i+1} at one vertex, the flight that leads to it included.

    A first walk (``kept`` is None) draws the flight and the shadow ray from ``sampler``, choosing real collisions by
    the throughput ``β``, unless the ``flight`` is given; a later pass has what was kept. Everything else is as
    `surface_step` says. Null boundaries come back as steps with ``kept.null``, which are not counted as vertices.
    """
    ray, medium = at.ray, at.medium
    with dr.suspend_grad(when=not attached):
        si = at.hit.compute_surface_interaction(ray, mi.RayFlags.All, active)

    # -------------------------- The flight --------------------------

    if kept is None:
        if flight is None:
            flight = fly(walk, at, sampler, β, active)
        event = active & flight.event
        mei = interaction(medium, dr.detach(ray), flight.t)
        w_flight = dr.select(event, flight.σ_s * dr.rcp(flight.density), 1) * flight.W
        e = mi.Spectrum(0 if flight.E is None else flight.E)
    else:
        event = active & kept.flight.event
        reach = dr.select(si.is_valid(), si.t, dr.inf)
        flown = fly_again(walk, at, kept.flight, reach, attached, active)
        mei, w_flight, e = flown.mei, flown.w, flown.e

    surface = active & ~event & si.is_valid()
    bsdf, phase = si.bsdf(ray), medium.phase_function()
    through = surface & _is_null(bsdf)
    surface &= ~through

    # ------------------------- Emission -------------------------

    seen = active & ~event
    if walk.hide_emitters:
        seen &= ~at.camera | si.is_valid()
    arriving = emission(walk.scene, at, si, attached, seen)

    # ---------- Next-event estimation and continuation ----------

    origin = dr.zeros(mi.Interaction3f)
    origin.t, origin.time, origin.wavelengths = mi.Float(0), ray.time, ray.wavelengths
    origin.p = dr.select(event, mei.p, si.p)
    origin.n = dr.select(event, 0, si.n)

    bounce = go_on & (surface | event)
    ctx, phase_ctx = mi.BSDFContext(), mi.PhaseFunctionContext(sampler)
    if kept is None:
        lit = bounce & dr.select(event, medium.use_emitter_sampling(), is_smooth(bsdf))
        light, Le = draw_emitter(walk.scene, origin, u.light, lit, visible=False)
        lit &= light.pdf != 0
        leaves = surface & si.is_medium_transition()
        start = dr.select(leaves, si.target_medium(light.d), medium)
        shaded = lit
        dark = shadow(walk, origin, light, start, sampler, lit)
        lit &= dr.any(dark.T != 0)
        T = dark.T

        at_surface = bounce & surface
        if walk.media.passes:
            at_surface |= surface & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        f, pdf_light, sample, w_surface = bsdf.eval_pdf_sample(
            ctx, si, si.to_local(light.d), u.lobe, u.direction, at_surface
        )
        f_medium, pdf_medium = phase.eval_pdf(phase_ctx, mei, light.d, lit & event)
        wo, w_medium, pdf = phase.sample(phase_ctx, mei, u.lobe, u.direction, bounce & event)
        d = dr.select(event, wo, dr.select(through, ray.d, si.to_world(sample.wo)))
        null = through | (surface & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null))
        kept = Kept(
            d=d,
            pdf=dr.select(event, pdf, dr.select(through, 1, sample.pdf)),
            delta=dr.select(
                event, ~medium.use_emitter_sampling(), mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
            ),
            null=null,
            black=dr.all(w_surface == 0),
            lobe=dr.select(surface, sample.sampled_component, 0),
            eta=dr.select(surface, sample.eta, 1),
            lit=lit,
            light=light,
            flight=flight,
            shadow=dark,
            origin=origin,
            start=start,
            shaded=shaded,
        )
        w_medium = dr.select(pdf > 0, w_medium, 0)
        pdf = kept.pdf
        bounce = (bounce & (~event | (pdf > 0))) | null
    else:
        bounce |= go_on & through
        lit = kept.lit
        light, Le = redraw_emitter(walk, origin, u.light, kept.light, attached, lit)
        T = shadow_again(walk, origin, light, kept.shadow, attached, lit)
        f, pdf_light = bsdf.eval_pdf(ctx, si, si.to_local(light.d), lit & surface)
        f_medium, pdf_medium = phase.eval_pdf(phase_ctx, mei, light.d, lit & event)
        w_surface, d, pdf = scatter(walk, bsdf, si, u, kept, attached, hit_next, go_on & surface)
        w_medium, d_medium, pdf_phase = _scatter_in_medium(
            walk, phase, mei, origin, kept, attached, hit_next, go_on & event
        )
        d = dr.select(event, d_medium, dr.select(through, ray.d, d))
        pdf = dr.select(event, pdf_phase, dr.select(kept.null, at.pdf, pdf))

    f = dr.select(event, f_medium, f)
    mis = dr.select(light.delta, 1, mis_weight(light.pdf, dr.select(event, pdf_medium, pdf_light)))
    lighting = dr.select(lit, f * Le * T * (mis if attached else dr.detach(mis)), 0)
    arriving += lighting
    w = dr.select(event, w_medium, dr.select(through, 1, w_surface))

    kept.lighting = w_flight * lighting
    ray_next = origin.spawn_ray(d)
    crossed = (surface | through) & si.is_medium_transition()
    return Step(
        e=e + w_flight * arriving,
        w=w_flight * w,
        ray_next=ray_next,
        pdf=pdf,
        kept=kept,
        met=surface | (event & go_on),
        active=bounce,
        medium=dr.select(crossed, si.target_medium(dr.detach(d)), medium),
    )


def _is_null(bsdf: Any) -> Any:
    """True where light can only pass straight through."""
    flags = bsdf.flags()
    reflects = mi.has_flag(flags, mi.BSDFFlags.Smooth) | mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
    return mi.has_flag(flags, mi.BSDFFlags.Null) & ~reflects & ~mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)


def _scatter_in_medium(
    walk: Walk, phase: Any, mei: Any, origin: Any, kept: Kept, attached: bool, hit_next: Any, active: Any
) -> tuple[Any, Any, Any]:
    """Weight (Spectrum), direction and density of the kept continuation at a particle, differentiably.

    Its direction is held as on surfaces, towards the next surface point, but only where that matters: where the surface
    scatters or emits, and so may have seams and edges. Otherwise it is fixed in space, which is less noisy.
    """
    ctx = mi.PhaseFunctionContext(None)
    d, J = kept.d, mi.Float(1)
    if attached:
        shape = hit_next.shape
        seen = is_smooth(shape.bsdf()) | (shape.emitter() != None)  # noqa: E711 (an array of pointers)
        found = active & hit_next.is_valid() & seen
        d, J = moved_direction(walk.traits.tables.blend_lengths, origin, kept.d, hit_next, found)
    f, pdf = phase.eval_pdf(ctx, mei, d, active)
    pdf = dr.replace_grad(kept.pdf, dr.select(active, pdf, 0)) if attached else kept.pdf
    return f * J * dr.detach(reciprocal(kept.pdf)), d, pdf
