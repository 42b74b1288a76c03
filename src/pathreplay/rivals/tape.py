"""The tape driver: plain automatic differentiation of a wavefront of paths, to compare the other drivers with.

Every vertex of every path is evaluated in memory and stays there until the graph of the whole loop has been
back-propagated: memory grows with the number of paths times their length. This is what reverse mode does by itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..gradient.adjoint import backward, tangents
from ..transport.motion import path_moves
from ..transport.path import count, first_arrival, next_arrival, repeat_step, survival, sustain, take_step
from ..transport.vertex import Numbers, Walk


def tape_backward(walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any) -> None:
    """Back-propagate the adjoint radiance ``δL`` (Spectrum per ray) into the parameters and the camera.

    The estimator is that of the sweep driver, and with the same random numbers so is the gradient. Not differentiated:
    see `tape`. Raises PathreplayError when no parameter reaches the paths.
    """
    with dr.resume_grad(), dr.isolate_grad():
        L, _ = tape(walk, sampler, ray, active)
        backward(dr.sum(δL * L))


def tape_forward(walk: Walk, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any]:
    """Tangent of the radiance along camera rays, ``(δL, valid)``: a Spectrum and a Bool per ray.

    The parameters must carry their tangents already. Not differentiated: see `tape`.
    """
    with dr.resume_grad():
        L, valid = tape(walk, sampler, ray, active)
        return tangents(L)[0], valid


def _cut(state: tuple[Any, ...]) -> Any:
    """The same values; on the way back, all that comes from behind them is evaluated before it goes on.

    Without it the way back is a single kernel, whose code grows with the depth: a minute to compile at 64 vertices.
    """

    class Cut(dr.CustomOp):  # type: ignore[misc]
        def eval(self, state: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(type(value)(value) for value in state)

        def backward(self) -> None:
            gradient = self.grad_out()
            dr.eval(gradient)
            self.set_grad_in("state", gradient)

        def forward(self) -> None:
            gradient = self.grad_in("state")
            dr.eval(gradient)
            self.set_grad_out(gradient)

    return dr.custom(Cut, state)


@dr.syntax
def tape(walk: Walk, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any]:
    """Radiance along camera rays as an AD variable, ``(L, valid)``: L = Σ β_i e_i with all derivatives attached.

    ``ray`` may be attached to the camera. Every step is taken detached, to make its choices, and once more attached.
    Not differentiated: visibility, Russian roulette and, with ``attach='none'``, everything that moves. Adjoints that
    are not finite are not looked for. Call it under `dr.resume_grad`.
    """
    active = mi.Bool(active) & (walk.max_depth > 0)
    with dr.suspend_grad():
        at = first_arrival(walk, ray, active)
        valid = mi.Bool(walk.background_is_opaque) & active
    attached = path_moves(walk, ray, at)
    if dr.hint(attached, mode="scalar"):
        at.ray.o, at.ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)

    L = mi.Spectrum(0)  # radiance so far
    β = mi.Spectrum(1)  # throughput
    β_alive = mi.Spectrum(1)  # throughput with one zero weight left out: what keeps the path going
    η = mi.Float(1)  # relative index of refraction since the camera
    depth = mi.UInt32(0)  # vertices before

    while dr.hint(active, mode="evaluated", exclude=[walk, attached], label="pathreplay: tape"):
        with dr.suspend_grad():
            u = Numbers.draw(sampler)
            still = dr.detach(at)
            step = take_step(walk, still, u, sampler, β_alive, depth + 1 < walk.max_depth, active)
            kept = step.kept
            β_alive = sustain(β_alive, dr.detach(β), step)
            η *= kept.eta
            valid |= active & step.met & ~kept.null
            rr_weight, survives = survival(β_alive, η, depth, u.roulette, walk, step)
            go_on = step.active & survives & (dr.max(β_alive) != 0)
            β_alive *= rr_weight
            depth += count(walk, step)
            at_next = next_arrival(walk, still, step, go_on)

        L, β, at.ray.o, at.ray.d, at.pdf = _cut((L, β, at.ray.o, at.ray.d, at.pdf))
        step = repeat_step(walk, at, u, kept, go_on, active, attached, at_next.hit)
        L += β * step.e
        β *= step.w * rr_weight
        if dr.hint(attached, mode="scalar"):
            onward = mi.Ray3f(at_next.ray)
            onward.o, onward.d = step.ray_next.o, step.ray_next.d
            at_next = replace(at_next, ray=onward, pdf=step.pdf)
        at = at_next
        active = go_on

    return L, valid
