"""The step on surfaces: what one vertex adds, how it scatters, and the derivative of both.

It knows emission, next-event estimation, BSDF sampling and multiple importance sampling; loops, images and their
gradients are its callers' business. Its sibling for scenes with media is `medium_step`.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .emitters import draw_emitter, emission, redraw_emitter
from .lobes import scatter
from .vertex import Arrival, Kept, Numbers, Step, Walk, is_smooth, mis_weight


def surface_step(
    walk: Walk,
    at: Arrival,
    u: Numbers,
    go_on: Any,
    active: Any,
    kept: Kept | None = None,
    attached: bool = False,
    hit_next: Any = None,
) -> Step:
    """Evaluate L_i = e_i + w_i L_{i+1} at one surface vertex.

    A first walk (``kept`` is None) draws the emitter sample and the continuation from the numbers ``u``. A later pass
    hands back what the first walk ``kept`` and gets the same values, now differentiable in emission, BSDFs and
    textures. ``go_on`` (Bool) is False at the last vertex that ``max_depth`` allows.

    If ``attached``, the results are differentiable in ``at.ray``, ``at.pdf`` and everything that moves, too: the hit
    point follows ray and shape, and the continuation follows as `scatter` says (``hit_next`` is where it went). Else
    vertices and directions are constants. Visibility and Russian roulette are never differentiated.
    """
    ctx = mi.BSDFContext()
    with dr.suspend_grad(when=not attached):
        si = at.hit.compute_surface_interaction(at.ray, mi.RayFlags.All, active)
    bsdf = si.bsdf(at.ray)
    go_on = active & go_on & si.is_valid()

    # ----------- Light that is known and does not change -----------

    if kept is not None and kept.glow is not None and not attached:
        f = bsdf.eval(ctx, si, si.to_local(kept.light_d), kept.lit)
        e = kept.glow + dr.select(kept.lit, f * kept.light_w, 0)
        w, d, pdf = scatter(walk, bsdf, si, u, kept, attached, hit_next, go_on)
        return Step(e=e, w=w, ray_next=si.spawn_ray(d), pdf=pdf, kept=kept, met=si.is_valid(), active=go_on)

    # ------------------------- Emission -------------------------

    seen = active & (~at.camera | si.is_valid()) if walk.hide_emitters else active
    glow = emission(walk.scene, at, si, attached, seen)

    # ---------- Next-event estimation and continuation ----------

    first = kept is None
    if kept is None:
        lit = go_on & is_smooth(bsdf)
        light, Le = draw_emitter(walk.scene, si, u.light, lit)
        lit &= light.pdf != 0
        f, pdf_light, sample, w = bsdf.eval_pdf_sample(ctx, si, si.to_local(light.d), u.lobe, u.direction, go_on)
        kept = Kept(
            d=si.to_world(sample.wo),
            pdf=sample.pdf,
            delta=mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta),
            null=mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null),
            black=dr.all(w == 0),
            lobe=sample.sampled_component,
            eta=sample.eta,
            lit=lit,
            light=light,
        )
        d, pdf = kept.d, kept.pdf
    else:
        lit = kept.lit
        light, Le = redraw_emitter(walk, si, u.light, kept.light, attached, lit)
        f, pdf_light = bsdf.eval_pdf(ctx, si, si.to_local(light.d), lit)
        w, d, pdf = scatter(walk, bsdf, si, u, kept, attached, hit_next, go_on)

    mis = dr.select(light.delta, 1, mis_weight(light.pdf, pdf_light))
    light_w = Le * (mis if attached else dr.detach(mis))
    e = glow + dr.select(lit, f * light_w, 0)
    if first and not walk.traits.lights_vary:
        kept.glow, kept.light_d, kept.light_w = glow, light.d, light_w

    return Step(e=e, w=w, ray_next=si.spawn_ray(d), pdf=pdf, kept=kept, met=si.is_valid(), active=go_on)
