"""The step: what one surface vertex adds, how it scatters, and the derivative of both.

Every driver is built from this one function. It knows emission, next-event estimation, BSDF sampling and multiple
importance sampling; loops, images and gradients of them are its callers' business.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .emitters import draw_emitter, emission, emitted_towards
from .lobes import held_weight
from .vertex import Arrival, Kept, Numbers, Options, Step, is_smooth, mis_weight


def surface_step(
    scene: Any, at: Arrival, u: Numbers, go_on: Any, options: Options, active: Any, kept: Kept | None = None
) -> Step:
    """Evaluate L_i = e_i + w_i L_{i+1} at one surface vertex.

    A first walk (``kept`` is None) draws the emitter sample and the continuation from the numbers ``u``. A later
    pass hands back what the first walk ``kept`` and gets the same values, now differentiable: e and w carry the
    derivatives of emission, BSDF and textures. ``go_on`` (Bool) is False at the last vertex that ``max_depth`` allows.

    With ``attach='none'`` vertices and directions are constants: motion of shapes, normals of the geometry and
    sampling densities are *not* differentiated, nor is visibility in any mode.
    """
    ctx = mi.BSDFContext()
    with dr.suspend_grad(when=options.attach == "none"):
        si = at.hit.compute_surface_interaction(at.ray, mi.RayFlags.All, active)
    bsdf = si.bsdf(at.ray)

    # ------------------------- Emission -------------------------

    seen = active & (~at.camera | si.is_valid()) if options.hide_emitters else active
    e = emission(scene, at, si, seen)

    # ------------------- Next-event estimation ------------------

    go_on = active & go_on & si.is_valid()
    first_walk = kept is None
    light = None if first_walk else kept.light
    if light is None:
        wants_light = go_on & is_smooth(bsdf) if first_walk else kept.lit
        light, Le = draw_emitter(scene, si, u.light, first_walk, wants_light)
    lit = go_on & (light.pdf != 0) & is_smooth(bsdf) if first_walk else kept.lit
    wo_light = si.to_local(light.d)

    if first_walk:
        f, pdf, sample, w = bsdf.eval_pdf_sample(ctx, si, wo_light, u.lobe, u.direction, go_on)
        d = si.to_world(sample.wo)
        kept = Kept(
            d=d,
            pdf=sample.pdf,
            delta=mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta),
            lobe=sample.sampled_component,
            lit=lit,
            light=light,
        )
        eta, null = sample.eta, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    else:
        Le = emitted_towards(scene, si, light, lit)
        f, pdf = bsdf.eval_pdf(ctx, si, wo_light, lit)
        w = held_weight(bsdf, ctx, si, u, kept, options, go_on)
        eta, null = mi.Float(1), mi.Bool(False)

    mis = dr.select(light.delta, 1, dr.detach(mis_weight(light.pdf, pdf)))
    e += dr.select(lit, f * mis * Le, 0)

    return Step(
        e=e,
        w=w,
        ray_next=si.spawn_ray(kept.d),
        kept=kept,
        eta=eta,
        surface=si.is_valid(),
        null=null,
        active=go_on,
    )
