"""The lights driver: where only what lights emit has gradients, one walk is enough, and nothing is recorded.

L = Σ β_i e_i is linear in what lights emit, and β knows nothing of it. So δL β_i de_i is back-propagated on the way."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..transport.arrive import background
from ..transport.emitters import relight
from ..transport.motion import path_moves, weights_vary
from ..transport.path import PathState
from ..transport.start import CameraStart
from ..transport.vertex import Walk
from .adjoint import LostPaths, backward
from .driver import Driver


def lights_alone(walk: Walk, start: CameraStart) -> bool:
    """Whether nothing has gradients but what lights emit: no weight, and nothing that moves. For scenes without media.

    Found out by tracing, so never where Dr.Jit evaluates what is called as it goes: there some may not be met.
    """
    if walk.media is not None or not walk.traits.lights_vary or not dr.flag(dr.JitFlag.SymbolicCalls):
        return False
    if not walk.scene.shapes():  # nothing that could be lit is traced, and so nothing met
        return False
    at = PathState.begin(walk, start).at
    return not path_moves(walk, start, at) and not weights_vary(walk, at)


def lights_or(other: Driver) -> Driver:
    """A driver: `lights` where that will do, and the ``other`` elsewhere."""

    def driver(walk: Walk, start: CameraStart, δL: mi.Spectrum, lost: LostPaths) -> bool:
        return (lights if lights_alone(walk, start) else other)(walk, start, δL, lost)

    return driver


@dr.syntax
def lights(walk: Walk, start: CameraStart, δL: mi.Spectrum, lost: LostPaths) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into what lights emit. Of any depth; for `lights_alone`.

    At each vertex what was hit, and an emitter sample, by the weights of the picture; in the end what is around the
    scene, which each path meets once. Returns that paths do not move.
    Not differentiated: all but what lights emit. Raises PathreplayError when no parameter reaches the paths.
    """
    walk = replace(walk, leaves=True)
    sampler, path = start.sampler, PathState.begin(walk, start)
    path, left = path.leave()

    while dr.hint(path.active, exclude=[walk], label="pathreplay: lights"):
        u, step = path.choose(walk, sampler)
        with dr.resume_grad():
            backward(dr.sum(δL * path.β * relight(walk, path.at, step.lighting)))
        path = path.advance(walk, u, step)[0]
        path, gone = path.leave()
        left |= gone

    with dr.resume_grad():
        beyond = background(walk, path.at, left)
        if dr.grad_enabled(beyond):
            backward(dr.sum(δL * path.β * beyond))
    return False
