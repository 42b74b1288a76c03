"""The emission-only driver: if only emitted radiance has gradients, a single pass without a record suffices.

L = Σ β_i e_i is linear in the emitted radiance, and the throughput β does not depend on it. The term δL β_i de_i of
each vertex is therefore back-propagated while the path is sampled.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, backward
from pathreplay.adjoint.driver import Driver
from pathreplay.transport.arrive import background
from pathreplay.transport.emitters import relight
from pathreplay.transport.motion import path_moves, weights_vary
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


def only_emission_varies(trace: TraceConfig, start: CameraStart) -> bool:
    """Return whether only emitted radiance has gradients: no weight depends on a parameter, and nothing moves.

    The result is always False in scenes with media, or with a `directionalarea` emitter, which `relight` cannot
    evaluate. It is also always False if symbolic calls are turned off in Dr.Jit. With symbolic calls, one traced step
    covers the virtual functions of all objects of the scene. Without symbolic calls, the step would cover only the
    objects at the first vertices.
    """
    traits = trace.traits
    if trace.media is not None or traits.directed_areas or not traits.lights_vary:
        return False
    if not dr.flag(dr.JitFlag.SymbolicCalls):
        return False
    if not trace.scene.shapes():  # without shapes, no virtual function of a BSDF is traced
        return False
    at = PathState.begin(trace, start).at
    return not path_moves(trace, start, at) and not weights_vary(trace, at)


def lights_or(other: Driver) -> Driver:
    """Return a driver that calls `emission_only` if only emitted radiance has gradients, and ``other`` otherwise."""

    def driver(trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter) -> bool:
        return (emission_only if only_emission_varies(trace, start) else other)(trace, start, δL, lost)

    return driver


@dr.syntax
def emission_only(trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into emitted radiance, for paths of any depth.

    Only valid if `only_emission_varies` is true. Each vertex contributes the emission of the hit surface and the
    emitter sample, with the same weights as in the image. A path that leaves the scene also contributes the radiance of
    the environment. Returns False, because paths do not move. Not differentiated: everything except emitted radiance.
    Raises PathreplayError if the paths depend on no parameter with gradients.
    """
    trace = replace(trace, background_apart=True)
    sampler, path = start.sampler, PathState.begin(trace, start)
    path, left = path.leave()

    while dr.hint(path.active, exclude=[trace], label="pathreplay: lights"):
        u, step = path.choose(trace, sampler)
        with dr.resume_grad():
            backward(dr.sum(δL * path.β * relight(trace, path.at, step.lighting)))
        path = path.advance(trace, u, step)[0]
        path, gone = path.leave()
        left |= gone

    with dr.resume_grad():
        beyond = background(trace, path.at, left)
        if dr.grad_enabled(beyond):
            backward(dr.sum(δL * path.β * beyond))
    return False
