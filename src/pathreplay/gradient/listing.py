"""Differentiable delta tracking as the seed lists it: path replay nested in the transmittance estimate.

Every tentative collision is differentiated by itself, in a second walk with the same random numbers: null ones as
dσ_n/σ_n, real ones as dσ_s/σ_s (supplement of Vicini, Speierer, Jakob 2021, listings 1 and 2). Where σ_n or σ_s is zero
such a collision is never drawn and its derivative is missing: on a constant grid all of that of the transmittance.
The score (`sweep`, `replay`) has no such holes; this driver is here to compare with.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import PathreplayError
from ..transport.flight import fly
from ..transport.motion import path_moves
from ..transport.path import count, first_arrival, next_arrival, repeat_step, survival, take_step
from ..transport.shadow import shadow
from ..transport.vertex import Numbers, Walk, reciprocal
from .adjoint import backward
from .primal import primal


@dr.syntax
def listing(walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any) -> None:
    """Back-propagate the adjoint radiance ``δL`` (Spectrum per ray) into the parameters.

    Uses one majorant for each medium. Not differentiated: what the listings miss (above), visibility, emission of
    media, and everything that moves: a path that moves with the parameters raises PathreplayError.
    """
    # A grid medium's own tracking is left out, so that every collision is one that can be differentiated.
    walk = replace(walk, listing=True, baseline=None, branching=None, media=replace(walk.media, grids=(), plain=True))
    active = mi.Bool(active) & (walk.max_depth > 0)
    at = first_arrival(walk, ray, active)
    if dr.hint(path_moves(walk, ray, at), mode="scalar"):
        raise PathreplayError("pathreplay_listing cannot follow what moves: use the integrator 'pathreplay'")
    L, _ = primal(walk, sampler.clone(), ray, active)  # β_i L_i, peeled on the way
    β = mi.Spectrum(1)  # throughput
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # vertices before

    while dr.hint(active, exclude=[walk], label="pathreplay: listing"):
        u = Numbers.draw(sampler)
        past = sampler.clone()
        step = take_step(walk, at, u, sampler, β, depth + 1 < walk.max_depth, active)

        # The flight: all that comes along the ray has passed its null collisions, or was scattered at the real one.
        fly(walk, at, past, β, active, _Collisions(δL * L))
        L -= β * step.e
        # The shadow ray: the same for the light of the emitter sample.
        kept = step.kept
        shadow(walk, kept.origin, kept.light, kept.start, past, kept.shaded, _Collisions(δL * β * kept.lighting))

        with dr.resume_grad():
            held = repeat_step(walk, at, u, kept, step.active, active)
            Lo = β * held.e + L * held.w * dr.detach(reciprocal(held.w))
            if dr.hint(dr.grad_enabled(Lo), mode="scalar"):
                backward(dr.sum(δL * Lo))

        β *= step.w
        η *= kept.eta
        rr_weight, survives = survival(β, η, depth, u.roulette, walk, step)
        active = step.active & survives & (dr.max(β) != 0)
        β *= rr_weight
        at = next_arrival(walk, at, step, active)
        depth += count(walk, step)


class _Collisions:
    """Differentiates collisions, each by the radiance that has passed it, times its adjoint (Spectrum)."""

    def __init__(self, adjoint: Any) -> None:
        self.adjoint = adjoint

    def __call__(self, mei: Any, σ_bar: Any, null: Any, real: Any = None) -> None:
        with dr.resume_grad():
            σ_s, _, σ_t = mei.medium.get_scattering_coefficients(mei, null if real is None else null | real)
            log = dr.select(null, -σ_t * dr.detach(reciprocal(σ_bar - σ_t)), 0)
            if real is not None:
                log += dr.select(real, σ_s * dr.detach(reciprocal(σ_s)), 0)
            if dr.grad_enabled(log):
                backward(dr.sum(self.adjoint * log))
