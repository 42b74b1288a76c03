"""Scatter: sample the continuation of a path at a surface or in a medium, and differentiate its weight and direction.

The sampling pass chooses a lobe, and later passes keep this choice. Smooth lobes use detached sampling: the weight f/p
is differentiated with constant p. The direction of a smooth lobe is constant, or points to the next hit point, which
moves with its surface (see `velocity`). Delta lobes use attached sampling: the derivative passes through the sampled
direction. With ``attach='all'``, the smooth lobes of attachable BSDFs are also sampled attached. With
``attach='delta'``, the only smooth lobes sampled attached are narrow lobes in scenes without outlines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.transport.adjoint_bsdf import delta_adjoint, smooth_adjoint
from pathreplay.transport.arrive import Vertex
from pathreplay.transport.signature import shape_met
from pathreplay.transport.velocity import moved_direction
from pathreplay.transport.vertex import (
    Arrival,
    SampledContinuation,
    TraceConfig,
    VertexRecord,
    VertexSamples,
    is_smooth,
    reciprocal,
)

# Largest relative difference of the weights, and largest squared distance of the directions, between a lobe sampled
# alone and the original sample (see `_delta_weight`). Rounding errors in float32 are far smaller. BSDFs that do not
# support restricted sampling (`mask`) have far larger differences.
SAME_LOBE = 1e-3

# A lobe counts as narrow if its density at the centre is larger than the density of a diffuse lobe, 1/π. With detached
# sampling, the noise of the gradient is proportional to the slope of the log density. With attached sampling, the noise
# is proportional to the slope of the incident radiance. docs/gradients.md lists the variances for several roughnesses.
NARROW = 1 / dr.pi


@dataclass
class Sampled:
    """The continuation sampled at a vertex, and the BSDF or phase function in the direction of the emitter sample."""

    f: mi.Spectrum  # BSDF or phase function, times cosine on surfaces, for the direction of the emitter sample
    pdf_light: mi.Float  # density of sampling the direction of the emitter sample
    w: mi.Spectrum  # weight of the continuation
    kept: SampledContinuation
    null: mi.Bool  # the continuation passes the surface unscattered
    eta: mi.Float
    active: mi.Bool  # there is a continuation
    u: VertexSamples  # the random numbers that sampled the continuation
    u_weight: mi.Float | None  # 1 / density of ``u``, or None: see `balanced`


def choose(
    trace: TraceConfig,
    v: Vertex,
    at: Arrival,
    u: VertexSamples,
    ctx: mi.BSDFContext,
    d: mi.Vector3f,
    lit: mi.Bool,
    go_on: mi.Bool,
) -> Sampled:
    """Sample the continuation, and evaluate scattering from the direction ``d`` of the emitter sample. Detached."""
    at_surface = go_on & v.surface
    if v.inside is not None and trace.media.passes:
        at_surface |= v.surface & mi.has_flag(v.bsdf.flags(), mi.BSDFFlags.Null)
    u_weight = None
    if trace.balances_lobes:
        u, u_weight = balanced(v, u, ctx, at_surface)
    f, pdf_light, sample, w = v.bsdf.eval_pdf_sample(ctx, v.si, v.si.to_local(d), u.lobe, u.direction, at_surface)
    if ctx.mode == mi.TransportMode.Importance:
        f = smooth_adjoint(v, v.si.to_local(d), at_surface)
        w = _adjoint_weight(v, sample, w, at_surface)
    delta, null = (mi.has_flag(sample.sampled_type, kind) for kind in (mi.BSDFFlags.Delta, mi.BSDFFlags.Null))
    kept = SampledContinuation(
        v.si.to_world(sample.wo), sample.pdf, delta, dr.all(w == 0), sample.sampled_component, lit
    )
    sampled = Sampled(f, pdf_light, w, kept, null, sample.eta, at_surface, u, u_weight)
    return sampled if v.inside is None else _in_medium(v, at, u, d, lit, go_on, sampled)


def balanced(v: Vertex, u: VertexSamples, ctx: mi.BSDFContext, active: mi.Bool) -> tuple[VertexSamples, mi.Float]:
    """Change the distribution of ``u.lobe``, so that rare lobes beside a delta reflection are selected more often.

    If the other lobes of a BSDF are selected with a probability 1 - R < 1/2 beside a delta reflection, the function
    changes this probability to 1/2. Returns the new random numbers, and 1 / their density.

    At grazing angles, the transmittance T of glass is small and proportional to the cosine c of the angle to the
    normal. On a path that moves, the derivative of c is proportional to 1 / c, and so is that of T. If light is
    transmitted with the probability T, the second moment of the gradient is therefore the integral of (1 / c)² / T over
    the projected area, ∫ 1 / c² dc, which diverges. The same is true of the diffuse lobe of ``plastic``, and of
    transmission near the critical angle. BSDFs select the reflection if ``u.lobe`` is below R. Where this is not the
    case, the result is less efficient, with weights of at most 2.
    """
    mixed = active & mi.has_flag(v.bsdf.flags(), mi.BSDFFlags.DeltaReflection)
    mirrored, _ = v.bsdf.sample(ctx, v.si, mi.Float(0), u.direction, mixed)
    rest = 1 - mirrored.pdf
    mixed &= mi.has_flag(mirrored.sampled_type, mi.BSDFFlags.DeltaReflection) & (rest > 0) & (rest < 0.5)
    rare = u.lobe >= 0.5
    lobe = dr.select(rare, 1 - 2 * (1 - u.lobe) * rest, 2 * u.lobe * (1 - rest))
    lobe = dr.minimum(lobe, dr.one_minus_epsilon(mi.Float))
    weight = 2 * dr.select(rare, rest, 1 - rest)
    return replace(u, lobe=dr.select(mixed, lobe, u.lobe)), dr.select(mixed, weight, 1)


def _in_medium(
    v: Vertex, at: Arrival, u: VertexSamples, d: mi.Vector3f, lit: mi.Bool, go_on: mi.Bool, surface: Sampled
) -> Sampled:
    """Replace the sample at collisions by a phase function sample, and at null boundaries by straight transmission."""
    event, through, phase, ctx = v.inside.event, v.inside.through, v.inside.phase, mi.PhaseFunctionContext(None)
    f, pdf_light = phase.eval_pdf(ctx, v.inside.mei, d, lit & event)
    wo, w, pdf = phase.sample(ctx, v.inside.mei, u.lobe, u.direction, go_on & event)
    null = through | (v.surface & surface.null)
    bounce = go_on & (v.surface | event) & (~event | (pdf > 0))
    kept = replace(
        surface.kept,
        d=dr.select(event, wo, dr.select(through, at.ray.d, surface.kept.d)),
        pdf=dr.select(event, pdf, dr.select(through, 1, surface.kept.pdf)),
        delta=dr.select(event, ~at.medium.use_emitter_sampling(), surface.kept.delta),
        lobe=dr.select(v.surface, surface.kept.lobe, 0),
    )
    f, pdf_light = dr.select(event, f, surface.f), dr.select(event, pdf_light, surface.pdf_light)
    w = dr.select(event, dr.select(pdf > 0, w, 0), dr.select(through, 1, surface.w))
    eta = dr.select(v.surface, surface.eta, 1)
    return Sampled(f, pdf_light, w, kept, null, eta, bounce | null, surface.u, surface.u_weight)


def _adjoint_weight(v: Vertex, sample: mi.BSDFSample3f, w: mi.Spectrum, active: mi.Bool) -> mi.Spectrum:
    """Return the weight of a BSDF sample on a light path; ``w`` is the weight that Mitsuba returns."""
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    f = smooth_adjoint(v, sample.wo, active & ~delta)
    smooth = dr.select(dr.any(dr.detach(w) != 0), f * reciprocal(sample.pdf), 0)
    return dr.select(delta, w * delta_adjoint(v, sample.wo, sample.eta), smooth)


def towards(v: Vertex, ctx: mi.BSDFContext, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
    """Evaluate scattering of light from the world direction ``d`` (Spectrum), and the density of sampling ``d``."""
    surface = active if v.inside is None else active & v.surface
    f, pdf = v.bsdf.eval_pdf(ctx, v.si, v.si.to_local(d), surface)
    if ctx.mode == mi.TransportMode.Importance:
        f = smooth_adjoint(v, v.si.to_local(d), surface)
    if v.inside is None:
        return f, pdf
    event = v.inside.event
    f_medium, pdf_medium = v.inside.phase.eval_pdf(mi.PhaseFunctionContext(None), v.inside.mei, d, active & event)
    return dr.select(event, f_medium, f), dr.select(event, pdf_medium, pdf)


def repeat(
    trace: TraceConfig, v: Vertex, again: VertexRecord, ctx: mi.BSDFContext, attached: bool
) -> tuple[mi.Spectrum, mi.Vector3f, mi.Float]:
    """Evaluate weight w, world direction and density of the recorded continuation again, differentiably.

    Direction and density are differentiated only if ``attached``. The choice among lobes is never differentiated.
    """
    w, d, pdf = _at_surface(trace, v, again, ctx, attached, again.go_on & v.surface)
    if v.inside is None:
        return w, d, pdf
    event, through = v.inside.event, v.inside.through
    w_medium, d_medium, pdf_medium = _at_particle(trace, v, again, attached, again.go_on & event)
    d = dr.select(event, d_medium, dr.select(through, again.at.ray.d, d))
    pdf = dr.select(event, pdf_medium, dr.select(again.kept.media.null, again.at.pdf, pdf))
    return dr.select(event, w_medium, dr.select(through, 1, w)), d, pdf


def _at_surface(
    trace: TraceConfig, v: Vertex, again: VertexRecord, ctx: mi.BSDFContext, attached: bool, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Vector3f, mi.Float]:
    bsdf, si, kept, u = v.bsdf, v.si, again.kept, again.u
    smooth = active & ~kept.delta
    d, J = kept.d, mi.Float(1)
    if attached:
        ray = dr.detach(si.spawn_ray(kept.d))
        holds = smooth & ~keeps_direction(trace, si, smooth) & ~is_seen_through(trace, again.hit_next, ray)
        d, J = moved_direction(trace.traits.tables.blend_lengths, si, kept.d, again.hit_next, holds)

    if trace.resamples:
        drawn = active if trace.follows else active & kept.delta
        sample, w_sample = bsdf.sample(ctx, si, u.lobe, u.direction, drawn)
        if ctx.mode == mi.TransportMode.Importance:
            w_sample = _adjoint_weight(v, sample, w_sample, drawn)
        if attached:
            free = _followed(trace, v, u, ctx, smooth)
            follows = free | (active & kept.delta)
            d = dr.select(follows, dr.replace_grad(kept.d, si.to_world(sample.wo)), d)
            J = dr.select(follows, 1, J)

    wo, pdf = si.to_local(d), kept.pdf
    if ctx.mode == mi.TransportMode.Importance:
        f = smooth_adjoint(v, wo, smooth)  # light paths have no MIS weight, for which the density would be needed
    elif attached:
        f, pdf = bsdf.eval_pdf(ctx, si, wo, smooth)
        pdf = dr.replace_grad(kept.pdf, dr.select(smooth, pdf, 0))
    else:
        f = bsdf.eval(ctx, si, wo, smooth)
    w = f * J * dr.detach(reciprocal(kept.pdf))
    # The weight of a failed sample is zero even if f is not zero: `roughdielectric` may sample a reflected direction on
    # the wrong side of the surface. If the BSDF is black, both f and the weight are zero, and w keeps its derivative.
    w = dr.select(kept.black & dr.any(dr.detach(f) != 0), 0, w)

    if attached and trace.resamples:
        w = dr.select(free, w_sample, w)
    if trace.traits.mirrors:
        delta = active & kept.delta
        w = dr.select(delta, _delta_weight(trace, v, u, ctx, kept, w_sample, delta), w)
    return w, d, pdf


def keeps_direction(trace: TraceConfig, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
    """Return the lanes whose smooth continuations have a fixed direction, because the lobe is narrow.

    If the direction followed a moving hit point, the value of the lobe would change with the direction. In a narrow
    lobe, this change is a large and noisy derivative. Edges may move across a fixed direction, which requires a
    boundary term. The result is therefore False in all lanes unless boundary terms are estimated. The criterion depends
    on vertex and incident ray only, so that one rule applies to all directions sampled at a vertex.
    """
    if not may_keep_directions(trace):
        return mi.Bool(False)
    centre, _ = si.bsdf().sample(mi.BSDFContext(), dr.detach(si), 0.5, mi.Point2f(0.5), active)
    return active & ~mi.has_flag(centre.sampled_type, mi.BSDFFlags.Delta) & (dr.detach(centre.pdf) > NARROW)


def may_keep_directions(trace: TraceConfig) -> bool:
    """Return whether the result of `keeps_direction` may be True."""
    return trace.may_slide and trace.traits.glossy


def is_seen_through(trace: TraceConfig, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f) -> mi.Bool:
    """Return the lanes in which the surface that ``ray`` hit passes part of the light unscattered.

    A smooth continuation to such a surface has a fixed direction. A direction that followed the motion of the surface
    would move across other surfaces behind it, and across their edges. With a fixed direction, the outline of the
    transparent surface needs a boundary term. The result is therefore False in all lanes unless boundary terms are
    estimated.
    """
    if not (trace.may_slide and trace.traits.veils):
        return mi.Bool(False)
    return mi.has_flag(shape_met(trace, hit, ray, hit.is_valid()).bsdf().flags(), mi.BSDFFlags.Null)


def _followed(trace: TraceConfig, v: Vertex, u: VertexSamples, ctx: mi.BSDFContext, active: mi.Bool) -> mi.Bool:
    """Return the lanes whose smooth lobe is sampled attached. The sampled direction does not affect the result."""
    if not trace.follows:
        return mi.Bool(False)
    index = dr.reinterpret_array(mi.UInt32, v.bsdf)
    table = trace.traits.tables.attachable
    free = active & dr.gather(mi.Bool, table, index, active & (index < dr.width(table)))
    if trace.attach == "all":
        return free
    centre, _ = v.bsdf.sample(ctx, dr.detach(v.si), u.lobe, mi.Point2f(0.5), free)
    return free & (dr.detach(centre.pdf) > NARROW)


def _delta_weight(
    trace: TraceConfig,
    v: Vertex,
    u: VertexSamples,
    ctx: mi.BSDFContext,
    kept: SampledContinuation,
    w: mi.Spectrum,
    active: mi.Bool,
) -> mi.Spectrum:
    """Return the weight of a sampled delta lobe, differentiated at constant selection probability.

    A BSDF that chooses among lobes returns weights in which the selection probability has cancelled. In some plugins
    (``thindielectric``, ``plastic``) the derivative of the Fresnel term is lost in this cancellation. The lobe is
    therefore sampled again alone, through ``BSDFContext.component``, and its weight is divided by the detached
    selection probability. If weight or direction then differ from the original sample, the plugin does not support
    restricted sampling, and the derivative of the original weight is used. Mitsuba cannot sample the unscattered
    transmission of a mask inside of a blend alone. In blends, transmission is therefore evaluated instead. BSDFs made
    of `EXACT` ones return weights with the right derivative, and are not sampled again unless other BSDFs require it.
    """
    drawn = dr.detach(w)
    missing = mi.Bool(active)
    if trace.traits.blended_veils:
        T = v.bsdf.eval_null_transmission(v.si, active)
        wi, wo = v.si.wi, v.si.to_local(kept.d)
        straight = active & (mi.Frame3f.cos_theta(wi) * mi.Frame3f.cos_theta(wo) < 0)
        straight &= (dr.squared_norm(wi + wo) < SAME_LOBE) & dr.all(dr.detach(T) > 0)
        w = dr.select(straight, drawn * T * dr.detach(reciprocal(T)), w)
        missing &= ~straight
    for k in range(trace.traits.lobes):
        alone = mi.BSDFContext(ctx.mode)
        alone.component = k
        # On the back of a two-sided BSDF, ``sampled_component`` is numbered from zero, but ``component`` continues the
        # numbering of the front. The same is true of the second BSDF of a blend. If a scene has such BSDFs, all
        # components are therefore tried.
        picked = missing if trace.traits.renumbered else missing & (kept.lobe == k)
        sample, w_k = v.bsdf.sample(alone, v.si, u.lobe, u.direction, picked)
        w_k *= dr.detach(reciprocal(kept.pdf))
        if ctx.mode == mi.TransportMode.Importance:
            w_k *= delta_adjoint(v, sample.wo, sample.eta)
        same = picked & (dr.squared_norm(dr.detach(sample.wo) - v.si.to_local(kept.d)) < SAME_LOBE)
        same &= dr.all(dr.abs(dr.detach(w_k) - drawn) <= SAME_LOBE * dr.abs(drawn))
        w = dr.select(same, w_k, w)
        missing &= ~same
    return w


def _at_particle(
    trace: TraceConfig, v: Vertex, again: VertexRecord, attached: bool, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Vector3f, mi.Float]:
    """Evaluate again the weight, direction and density of a continuation that starts at a collision in a medium.

    If the next surface scatters or emits light, the direction follows the hit point, because such a surface may have
    edges and texture seams. Towards any other surface, the direction is constant, which is less noisy. With
    `TraceConfig.holds_collisions`, every direction is constant.
    """
    kept, hit_next = again.kept, again.hit_next
    d, J = kept.d, mi.Float(1)
    if attached and not trace.holds_collisions:
        ray = dr.detach(v.origin.spawn_ray(kept.d))
        shape = shape_met(trace, hit_next, ray, active)
        seen = is_smooth(shape.bsdf()) | (shape.emitter() != None)  # noqa: E711 (an array of pointers)
        holds = active & hit_next.is_valid() & seen & ~is_seen_through(trace, hit_next, ray)
        d, J = moved_direction(trace.traits.tables.blend_lengths, v.origin, kept.d, hit_next, holds)
    f, pdf = v.inside.phase.eval_pdf(mi.PhaseFunctionContext(None), v.inside.mei, d, active)
    pdf = dr.replace_grad(kept.pdf, dr.select(active, pdf, 0)) if attached else kept.pdf
    return f * J * dr.detach(reciprocal(kept.pdf)), d, pdf
