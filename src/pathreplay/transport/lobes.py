"""The weight of a continuation that is held fixed, and its derivative: smooth lobes by f/p, delta lobes by component."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .vertex import Kept, Numbers, Options, reciprocal

# Share by which the weight of a lobe sampled alone may differ from the weight that was drawn and still be the same
# lobe: float32 rounding is far below it, BSDFs that do not support restricted sampling (`mask`) are far above.
SAME_LOBE = 1e-3


def held_weight(bsdf: Any, ctx: Any, si: Any, u: Numbers, kept: Kept, options: Options, active: Any) -> Any:
    """Weight w of the kept continuation, differentiable in the BSDF.

    Smooth lobes: w = f(wo)/p with the density p held fixed (the direction is held fixed, so its density is a
    constant). Delta lobes: see `delta_weight`. Returns a Spectrum.
    """
    smooth = active & ~kept.delta
    f = bsdf.eval(ctx, si, si.to_local(kept.d), smooth)
    w = f * dr.detach(reciprocal(kept.pdf))
    if options.lobes == 0:
        return w
    delta = active & kept.delta
    return dr.select(delta, delta_weight(bsdf, ctx, si, u, kept, options, delta), w)


def delta_weight(bsdf: Any, ctx: Any, si: Any, u: Numbers, kept: Kept, options: Options, active: Any) -> Any:
    """Weight of a sampled delta lobe with the derivative of  (weight of the lobe alone) / (probability of its choice).

    A BSDF that picks among lobes returns weights in which the choice has cancelled, and with it, in some plugins,
    the derivative of Fresnel's term (``thindielectric``). So the lobe is sampled once more by itself, through
    ``BSDFContext.component``, and divided by the probability with which it was picked. Where a plugin does not
    support that (the two weights disagree) the plugin's own derivative stays.
    """
    sample, w = bsdf.sample(ctx, si, u.lobe, u.direction, active)
    for k in range(options.lobes):
        alone = mi.BSDFContext()
        alone.component = k
        picked = active & (kept.lobe == k)
        _, w_k = bsdf.sample(alone, si, u.lobe, u.direction, picked)
        w_k *= dr.detach(reciprocal(kept.pdf))
        same = picked & dr.all(dr.abs(dr.detach(w_k) - dr.detach(w)) <= SAME_LOBE * dr.abs(dr.detach(w)))
        w = dr.select(same, w_k, w)
    return w
