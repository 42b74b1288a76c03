"""Plain automatic differentiation of a wavefront of paths, for comparison.

Every vertex of every path is evaluated to memory, and stays there until the AD graph of the whole loop has been
traversed. Memory therefore grows with the number of paths times their length, as in plain reverse-mode AD.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, backward, tangents
from pathreplay.transport.motion import path_moves
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import repeat_step
from pathreplay.transport.vertex import TraceConfig

T = TypeVar("T")


def tape_backward(trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into the parameters and the rays of ``start``.

    Returns whether vertices or directions of the paths depend on parameters with gradients. This function uses the
    estimator of `sweep`: with equal random numbers, both functions compute equal gradients. `tape` states what is not
    differentiated. Raises PathreplayError if the paths depend on no parameter with gradients.
    """
    with dr.resume_grad(), dr.isolate_grad():
        L, _, moves = tape(trace, start)
        backward(dr.sum(δL * L))
    return moves


def tape_forward(trace: TraceConfig, start: CameraStart, lost: NonFiniteCounter) -> tuple[mi.Spectrum, mi.Bool, bool]:
    """Compute the tangent of the radiance along camera rays: see `ForwardDriver` for the returned values.

    The parameters must carry their tangents already. `tape` states what is not differentiated.
    """
    with dr.resume_grad():
        L, valid, moves = tape(trace, start)
        return tangents(L)[0], valid, moves


def _cut(state: T) -> T:
    """Return ``state`` unchanged. During AD traversal, the derivatives of ``state`` are evaluated to memory here.

    Without this function, the reverse pass would be a single kernel, whose size grows with depth. At 64 vertices,
    compilation takes a minute.
    """

    class Cut(dr.CustomOp):
        def eval(self, state: tuple[dr.ArrayBase, ...]) -> tuple[dr.ArrayBase, ...]:
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
def tape(trace: TraceConfig, start: CameraStart) -> tuple[mi.Spectrum, mi.Bool, bool]:
    """Compute the radiance along the camera rays of ``start`` as an AD variable.

    Returns the radiance, Mitsuba's alpha per path, and whether vertices or directions of the paths depend on parameters
    with gradients. Every path step is sampled detached and then evaluated attached. Visibility and Russian roulette are
    not differentiated. With ``attach='none'``, no motion is differentiated. Non-finite adjoints are not detected. The
    caller must enable gradients (`dr.resume_grad`).
    """
    sampler = start.sampler
    with dr.suspend_grad():
        path = PathState.begin(trace, start, sustained=True)
        at = path.at
        valid = mi.Bool(trace.background_is_opaque) & path.active
    moves = path_moves(trace, start, at)
    L = mi.Spectrum(0)  # accumulated radiance
    β = mi.Spectrum(1)  # attached throughput; the variables ``o``, ``d`` and ``pdf`` below are attached as well
    first = start.ray if moves else at.ray
    o, d, pdf = mi.Point3f(first.o), mi.Vector3f(first.d), mi.Float(at.pdf)

    while dr.hint(path.active, mode="evaluated", exclude=[trace, moves], label="pathreplay: tape"):
        with dr.suspend_grad():
            u, step = path.choose(trace, sampler)
            valid |= path.active & step.seen
            onward, v = path.advance(trace, u, step)

        L, β, o, d, pdf = _cut((L, β, o, d, pdf))
        ray = mi.Ray3f(path.at.ray)
        ray.o, ray.d = o, d
        at = replace(path.at, ray=ray, pdf=pdf)
        repeated = repeat_step(trace, replace(v, at=at), moves, path.active)
        L += β * repeated.e
        β *= repeated.w * v.rr_weight
        ray, pdf = (repeated.ray_next, repeated.pdf) if moves else (onward.at.ray, onward.at.pdf)
        o, d, pdf = mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Float(pdf)
        path = onward

    return L, valid, moves
