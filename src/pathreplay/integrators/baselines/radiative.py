"""Radiative backpropagation, for comparison: adjoint radiance is propagated from the camera into the scene.

At every vertex, δL β_i multiplies the derivative of e_i + w_i L_{i+1}. An independent path of the full remaining depth
estimates L_{i+1}, the incident radiance along the continuation (Nimier-David, Speierer, Ruiz, Jakob: Radiative
Backpropagation, 2020). Memory is constant; time grows with the square of the depth.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, backward
from pathreplay.adjoint.primal import path_radiance
from pathreplay.errors import PathreplayError
from pathreplay.transport.path import PathState, next_arrival
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import repeat_step
from pathreplay.transport.vertex import TraceConfig


def no_forward(trace: TraceConfig, start: CameraStart, lost: NonFiniteCounter) -> tuple[mi.Spectrum, mi.Bool, bool]:
    """Raise PathreplayError: there is no forward mode."""
    raise PathreplayError("radiative_backprop has no forward mode: use the integrator 'pathreplay'")


@dr.syntax
def radiative(
    trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter, linear: bool = False
) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into the parameters.

    ``linear`` selects a biased variant in linear time. As in the biased variants of Nimier-David et al. (2020), the
    incident radiance is not estimated: wherever a path continues, the number one takes the place of L_{i+1} in all
    channels. Emission and next-event estimation (e_i) are unchanged. The magnitude of the gradient is then wrong. In
    dark media, the sign of the gradient may also be wrong.

    The counter ``lost`` is not used. Visibility is not differentiated. As with ``attach='none'``, no motion is
    differentiated. Raises PathreplayError if the paths depend on no parameter with gradients.
    """
    sampler, path = start.sampler, PathState.begin(trace, start)

    while dr.hint(path.active, exclude=[trace], label="pathreplay: radiative backpropagation"):
        u, step = path.choose(trace, sampler)
        at = next_arrival(trace, path.at, step, step.active)
        if dr.hint(linear, mode="scalar"):
            L = mi.Spectrum(dr.select(step.active, 1, 0))
        else:
            depth, η = path.passed(trace, step), path.η * step.eta
            L, _ = path_radiance(trace, sampler, PathState(at, mi.Spectrum(1), None, η, depth, step.active))
        onward, v = path.advance(trace, u, step, at)
        with dr.resume_grad():
            repeated = repeat_step(trace, replace(v, go_on=step.active), False, path.active)
            backward(dr.sum(δL * path.β * (repeated.e + repeated.w * L)))
        path = onward
    return False
