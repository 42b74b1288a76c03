"""Scattering that follows a choice already made: the weight of the continuation, its direction, and their derivatives.

A smooth lobe is differentiated as f/p at a held place: either the point where the continuation hit the next surface,
which moves with that surface, or, where nothing was hit, the direction. A delta lobe is differentiated through its
direction. With ``attach='all'`` so are the smooth lobes of BSDFs for which that is right.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .surface import held_point
from .vertex import Kept, Numbers, Walk, reciprocal

# Share by which the weight of a lobe sampled alone may differ from the weight that was drawn (and squared distance of
# their directions) and still belong to the same lobe: float32 rounding is far below it, BSDFs without support for
# restricted sampling (`mask`) far above.
SAME_LOBE = 1e-3


def scatter(
    walk: Walk, bsdf: Any, si: Any, u: Numbers, kept: Kept, attached: bool, hit_next: Any, active: Any
) -> tuple[Any, Any, Any]:
    """Weight w (Spectrum), world direction and density (Float) of the kept continuation, differentiably.

    Not differentiated: the choice among lobes and, unless ``attached``, direction and density.
    """
    ctx = mi.BSDFContext()
    smooth = active & ~kept.delta
    d, J = kept.d, mi.Float(1)
    if attached:
        d, J = held_at_hit(si, kept.d, hit_next, smooth)

    if walk.resamples:
        sample, w_sample = bsdf.sample(ctx, si, u.lobe, u.direction, active)
        if attached:
            follows = active & kept.delta
            free = mi.Bool(False)  # smooth lobes that are sampled attached
            if walk.attach == "all":
                index = dr.reinterpret_array(mi.UInt32, bsdf)
                table = walk.traits.attachable
                free = smooth & dr.gather(mi.Bool, table, index, smooth & (index < dr.width(table)))
                follows |= free
            d = dr.select(follows, dr.replace_grad(kept.d, si.to_world(sample.wo)), d)
            J = dr.select(follows, 1, J)

    wo = si.to_local(d)
    if attached:
        f, pdf = bsdf.eval_pdf(ctx, si, wo, smooth)
        pdf = dr.replace_grad(kept.pdf, dr.select(smooth, pdf, 0))
    else:
        f, pdf = bsdf.eval(ctx, si, wo, smooth), kept.pdf
    w = f * J * dr.detach(reciprocal(kept.pdf))
    # A sample that failed (`roughdielectric` may reflect to the far side) has weight zero whatever f is there; a black
    # BSDF has weight zero because f is, and keeps its derivative.
    w = dr.select(kept.black & dr.any(dr.detach(f) != 0), 0, w)

    if attached and walk.resamples:
        w = dr.select(free, w_sample, w)
    if walk.traits.lobes > 0:
        delta = active & kept.delta
        w = dr.select(delta, _delta_weight(walk, bsdf, si, u, kept, w_sample, delta), w)
    return w, d, pdf


def held_at_hit(si: Any, d: Any, hit: Any, active: Any) -> tuple[Any, Any]:
    """Direction towards the point that a ray from ``si`` along ``d`` hit, and the density of that point's place.

    The point stays where it is on its surface and moves with it. J = |A · d| / dist², with A the area element there, is
    the solid angle that a piece of the surface takes up, relative to its present value: 1, with the derivative of
    log J. Holding the point and not the direction keeps edges of emitters and seams between materials where they are
    in the integrand; held directions would see them move, and that boundary term would be missing. Rays that left the
    scene hold ``d``.
    """
    found = active & hit.is_valid()
    ray = dr.detach(si.spawn_ray(d))
    y, A = held_point(hit, ray, found)
    x = si.spawn_ray(dr.detach(d)).o
    towards = y - x
    facing = dr.abs(dr.dot(A, towards))
    ok = found & (facing > 0)
    dist2 = dr.select(ok, dr.squared_norm(towards), 1)
    # In corners distances are tiny: the derivative of a logarithm holds where those of powers would overflow.
    log_J = dr.log(dr.select(ok, facing, 1)) - 1.5 * dr.log(dist2)
    return dr.select(ok, dr.replace_grad(d, towards * dr.rsqrt(dist2)), d), dr.replace_grad(mi.Float(1), log_J)


def _delta_weight(walk: Walk, bsdf: Any, si: Any, u: Numbers, kept: Kept, w: Any, active: Any) -> Any:
    """Weight of a sampled delta lobe, with the derivative of (weight of the lobe alone) / (probability of its choice).

    A BSDF that picks among lobes returns weights in which the choice has cancelled, and with it, in some plugins,
    the derivative of Fresnel's term (``thindielectric``, ``plastic``). So the lobe is sampled once more by itself,
    through ``BSDFContext.component``, and divided by the probability with which it was picked. Where a plugin does
    not support that (weights or directions disagree) its own derivative stays.
    """
    drawn = dr.detach(w)
    missing = mi.Bool(active)
    for k in range(walk.traits.lobes):
        alone = mi.BSDFContext()
        alone.component = k
        # The lobes of a surface's back are counted from zero, too, but asked for after those of the front.
        picked = missing if walk.traits.two_sides else missing & (kept.lobe == k)
        sample, w_k = bsdf.sample(alone, si, u.lobe, u.direction, picked)
        w_k *= dr.detach(reciprocal(kept.pdf))
        same = picked & (dr.squared_norm(dr.detach(sample.wo) - si.to_local(kept.d)) < SAME_LOBE)
        same &= dr.all(dr.abs(dr.detach(w_k) - drawn) <= SAME_LOBE * dr.abs(drawn))
        w = dr.select(same, w_k, w)
        missing &= ~same
    return w
