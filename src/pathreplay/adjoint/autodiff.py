"""Reverse and forward differentiation of a single step: the only module that calls automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.transport.step import repeat_step
from pathreplay.transport.vertex import Arrival, Step, TraceConfig, VertexRecord


class Unreached(PathreplayError):
    """No parameter with gradients reaches the light paths. Who knows sensor and scene says what to do."""


@dataclass
class RayDerivative:
    """Derivative of an arrival: the adjoint q in reverse mode, the tangent in forward mode."""

    o: mi.Point3f
    d: mi.Vector3f
    pdf: mi.Float

    @staticmethod
    def zero() -> RayDerivative:
        # Not dr.zeros, which remembers the types of the variant in which it saw a class first.
        return RayDerivative(mi.Point3f(0), mi.Vector3f(0), mi.Float(0))

    def finite_part(self) -> tuple[RayDerivative, mi.Bool]:
        """The derivative where it is finite and zero elsewhere, and where that is."""
        ok = dr.all(dr.isfinite(self.o)) & dr.all(dr.isfinite(self.d)) & dr.isfinite(self.pdf)
        return dr.select(ok, self, RayDerivative.zero()), ok


class NonFiniteCounter:
    """Counts the paths that lost a part of their gradient because it was not finite."""

    def __init__(self) -> None:
        self.count = dr.zeros(mi.UInt32, 1)

    def add(self, lost: mi.Bool) -> None:
        """Count lanes, inside the loop.

        There it is a side effect, like the gradients. A mask that left the loop and were evaluated by itself would run
        the whole kernel once more.
        """
        dr.scatter_add(self.count, mi.UInt32(1), mi.UInt32(0), lost)


def _attached_arrival(at: Arrival) -> Arrival:
    """A copy of an arrival whose ray and density are AD variables of their own."""
    ray, pdf = _attached_ray(at.ray), mi.Float(dr.detach(at.pdf))
    dr.enable_grad(pdf)
    return replace(at, ray=ray, pdf=pdf)


def backward_step(
    trace: TraceConfig,
    v: VertexRecord,
    attached: bool,
    δL: mi.Spectrum,
    L: mi.Spectrum,
    q: RayDerivative,
    active: mi.Bool,
    rays_only: bool = False,
) -> tuple[mi.Spectrum, RayDerivative, mi.Bool]:
    """Back-propagate  δL β_i·(e_i + w_i L_{i+1}) + q_{i+1}·r_{i+1}  into the parameters; gives L_i, q_i, and its loss.

    ``L`` is L_{i+1}. Where not ``attached``, q stays zero and costs nothing. A q_i that is not finite is dropped: the
    last result tells where.
    """
    lost = mi.Bool(False)
    with dr.resume_grad():
        at = _attached_arrival(v.at) if attached else v.at
    with dr.resume_grad(*((at.ray.o, at.ray.d, at.pdf) if rays_only else ())):
        step = repeat_step(trace, replace(v, at=at), attached, active)
        Li = step.e + step.w * (v.rr_weight * L)
        target = dr.sum(δL * v.β * Li)
        if attached:
            along = dr.dot(q.o, step.ray_next.o) + dr.dot(q.d, step.ray_next.d) + q.pdf * step.pdf
            target += dr.select(v.go_on, along, 0)
        backward(target)
        if attached:
            q, finite = RayDerivative(dr.grad(at.ray.o), dr.grad(at.ray.d), dr.grad(at.pdf)).finite_part()
            lost = ~finite
    return dr.detach(Li), q, lost


def forward_step(
    trace: TraceConfig, v: VertexRecord, attached: bool, tangent: RayDerivative, active: mi.Bool
) -> tuple[Step, mi.Spectrum, mi.Spectrum, RayDerivative]:
    """The step, the tangents of e_i and w_i, and that of the next arrival."""
    with dr.resume_grad():
        at = v.at
        if attached:
            at = _attached_arrival(at)
            dr.set_grad(at.ray.o, tangent.o)
            dr.set_grad(at.ray.d, tangent.d)
            dr.set_grad(at.pdf, tangent.pdf)
        step = repeat_step(trace, replace(v, at=at), attached, active)
        δe, δw, δo, δd, δpdf = tangents(step.e, step.w, step.ray_next.o, step.ray_next.d, step.pdf)
    return step, δe, δw, RayDerivative(δo, δd, δpdf)


def backward_ray(ray: mi.Ray3f, f: Callable[[mi.Ray3f], mi.Float]) -> RayDerivative:
    """Back-propagate a function of a ray into the parameters; gives the adjoint of the ray, where that is finite."""
    with dr.resume_grad():
        ray = _attached_ray(ray)
        backward(f(ray))
        return RayDerivative(dr.grad(ray.o), dr.grad(ray.d), mi.Float(0)).finite_part()[0]


def forward_ray(ray: mi.Ray3f, tangent: RayDerivative, f: Callable[[mi.Ray3f], mi.Spectrum]) -> mi.Spectrum:
    """The tangent of a function of a ray, from those of the ray and of the parameters."""
    with dr.resume_grad():
        ray = _attached_ray(ray)
        dr.set_grad(ray.o, tangent.o)
        dr.set_grad(ray.d, tangent.d)
        return tangents(f(ray))[0]


def derivative_by_ray(ray: mi.Ray3f, f: Callable[[mi.Ray3f], mi.Float]) -> RayDerivative:
    """The derivative of a function by a ray, where that is finite. Reaches no parameter."""
    with dr.resume_grad():
        ray = _attached_ray(ray)
    with dr.resume_grad(ray.o, ray.d):
        dr.backward_from(f(ray))
        return RayDerivative(dr.grad(ray.o), dr.grad(ray.d), mi.Float(0)).finite_part()[0]


def derivative_by_place(s: mi.Point2f, f: Callable[[mi.Point2f], mi.Float]) -> mi.Vector2f:
    """The derivative of a function by a place in the plane. Reaches no parameter."""
    s = mi.Point2f(dr.detach(s))
    with dr.resume_grad():
        dr.enable_grad(s)
    with dr.resume_grad(s):
        # What is the same everywhere, such as the direction of a light without extent, has no gradient.
        dr.backward_from(f(s), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        return mi.Vector2f(dr.grad(s))


def _attached_ray(ray: mi.Ray3f) -> mi.Ray3f:
    """A copy of a ray, origin and direction of which are variables of their own."""
    ray = mi.Ray3f(ray)
    ray.o, ray.d = mi.Point3f(dr.detach(ray.o)), mi.Vector3f(dr.detach(ray.d))
    dr.enable_grad(ray.o, ray.d)
    return ray


def tangents(*values: Any) -> list[Any]:
    """Forward-propagate from the parameters to all values at once; zero for those that no parameter reaches."""
    attached = [value for value in values if dr.grad_enabled(value)]
    if not attached:
        return [dr.zeros(type(value)) for value in values]
    # Interior gradients must survive: some of the values are computed from others.
    dr.forward_to(*attached, flags=dr.ADFlag.ClearEdges)
    return [dr.grad(value) for value in values]


def backward(target: mi.Float) -> None:
    """Back-propagate from a scalar per path.

    Raises Unreached when no parameter with gradients reaches it: the gradient would silently be zero.
    """
    if not dr.grad_enabled(target):
        if not dr.flag(dr.JitFlag.SymbolicLoops) and not dr.flag(dr.JitFlag.SymbolicCalls):
            return  # only what these very paths meet is called: others, or other vertices, may meet the parameter
        raise Unreached("no parameter with gradients reaches the light paths")
    dr.backward_from(target)
