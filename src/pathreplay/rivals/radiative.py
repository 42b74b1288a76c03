"""Radiative backpropagation: adjoint radiance walks from the camera, to compare the other drivers with.

At every vertex δL β_i is multiplied with the derivative of e_i + w_i L_{i+1}, and the radiance L_{i+1} that comes back
along the continuation is estimated by a fresh path of all the remaining depth (Nimier-David, Speierer, Ruiz, Jakob:
Radiative Backpropagation, 2020). Memory is constant; time grows with the square of the depth.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..gradient.adjoint import backward
from ..gradient.primal import walk_on
from ..transport.path import count, first_arrival, next_arrival, repeat_step, survival, take_step
from ..transport.vertex import Numbers, Walk


@dr.syntax
def radiative(walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any, linear: bool) -> None:
    """Back-propagate the adjoint radiance ``δL`` (Spectrum per ray) into the parameters.

    ``linear`` is a biased variant in linear time, after those of the paper, which leave the incident radiance out: no
    fresh paths, and L_{i+1} is taken to be one in all channels wherever a path goes on, while emission and next-event
    estimation (e_i) are as they are. The size of a gradient is wrong, and where media are also dark its sign may be.
    Not differentiated: everything that moves (as with ``attach='none'``), and visibility. Raises
    PathreplayError when no parameter reaches the paths.
    """
    β = mi.Spectrum(1)  # throughput
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # vertices before
    active = mi.Bool(active) & (walk.max_depth > 0)
    at = first_arrival(walk, ray, active)

    while dr.hint(active, exclude=[walk], label="pathreplay: radiative backpropagation"):
        u = Numbers.draw(sampler)
        step = take_step(walk, at, u, sampler, β, depth + 1 < walk.max_depth, active)
        at_next = next_arrival(walk, at, step, step.active)
        depth_next = depth + count(walk, step)

        if dr.hint(linear, mode="scalar"):
            L = mi.Spectrum(dr.select(step.active, 1, 0))
        else:
            L, _ = walk_on(walk, sampler, at_next, depth_next, η * step.kept.eta, step.active)
        with dr.resume_grad():
            held = repeat_step(walk, at, u, step.kept, step.active, active)
            backward(dr.sum(δL * β * (held.e + held.w * L)))

        β *= step.w
        η *= step.kept.eta
        rr_weight, survives = survival(β, η, depth, u.roulette, walk, step)
        active = step.active & survives & (dr.max(β) != 0)
        β *= rr_weight
        at = at_next
        depth = depth_next
