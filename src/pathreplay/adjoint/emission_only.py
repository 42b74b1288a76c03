"""The emission-only driver: if only emitted radiance has gradients, a single pass without a record suffices.

L = Σ β_i e_i is linear in emitted radiance, and β does not depend on it. δL β_i de_i is therefore back-propagated
during sampling.
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
    """Whether nothing has gradients but what lights emit: no weight, and nothing that moves. For scenes without media.

    Found out by tracing, so never where Dr.Jit evaluates what is called as it goes: there some may not be met.
    """
    if trace.media is not None or not trace.traits.lights_vary or not dr.flag(dr.JitFlag.SymbolicCalls):
        return False
    if not trace.scene.shapes():  # nothing that could be lit is traced, and so nothing met
        return False
    at = PathState.begin(trace, start).at
    return not path_moves(trace, start, at) and not weights_vary(trace, at)


def lights_or(other: Driver) -> Driver:
    """A driver: `emission_only` where that will do, and the ``other`` elsewhere."""

    def driver(trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter) -> bool:
        return (emission_only if only_emission_varies(trace, start) else other)(trace, start, δL, lost)

    return driver


@dr.syntax
def emission_only(trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into what lights emit. Of any depth; for `lights_alone`.

    At each vertex what was hit, and an emitter sample, by the weights of the picture; in the end what is around the
    scene, which each path meets once. Returns that paths do not move.
    Not differentiated: all but what lights emit. Raises PathreplayError when no parameter reaches the paths.
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
