"""Scattering that follows a choice already made: the weight of the continuation, its direction, and their derivatives.

A smooth lobe is differentiated as f/p at a held place: the point where the continuation hit the next surface, which
moves with that surface, or its direction (see `velocity`). A delta lobe is differentiated through its direction. With
``attach='all'`` so are the smooth lobes of BSDFs for which that is right, and where nothing has an outline the narrow
ones in any case.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .velocity import moved_direction
from .vertex import Kept, Numbers, Walk, reciprocal

# Share by which the weight of a lobe sampled alone may differ from the weight that was drawn (and squared distance of
# their directions) and still belong to the same lobe: float32 rounding is far below it, BSDFs without support for
# restricted sampling (`mask`) far above.
SAME_LOBE = 1e-3

# Density in its centre above which a lobe is narrow: that of a diffuse lobe. A held lobe has noise in proportion to the
# slope of its logarithm, a followed one to that of the light; docs/gradients.md has the variances by roughness.
NARROW = 1 / dr.pi


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
        d, J = moved_direction(walk.traits.tables.blend_lengths, si, kept.d, hit_next, smooth)

    if walk.resamples:
        sample, w_sample = bsdf.sample(ctx, si, u.lobe, u.direction, active)
        if attached:
            free = _followed(walk, bsdf, si, u, smooth)
            follows = free | (active & kept.delta)
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


def _followed(walk: Walk, bsdf: Any, si: Any, u: Numbers, active: Any) -> Any:
    """Which smooth lobes are sampled attached (Bool): decided by what the lobe is, never by the direction drawn."""
    if not walk.follows:
        return mi.Bool(False)
    index = dr.reinterpret_array(mi.UInt32, bsdf)
    table = walk.traits.tables.attachable
    free = active & dr.gather(mi.Bool, table, index, active & (index < dr.width(table)))
    if walk.attach == "all":
        return free
    centre, _ = bsdf.sample(mi.BSDFContext(), dr.detach(si), u.lobe, mi.Point2f(0.5), free)
    return free & (dr.detach(centre.pdf) > NARROW)


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
