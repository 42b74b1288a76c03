"""Differentiates a single step of a path in reverse or forward mode.

Other modules differentiate with `backward`, `tangents` and the `derivative_by_*` functions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.transport.step import repeat_step
from pathreplay.transport.vertex import Arrival, Step, TraceConfig, VertexRecord

Tangents: TypeAlias = "list[Any]"
"""One tangent per value, of the value's type."""


class Unreached(PathreplayError):
    """Raised if the light paths depend on no parameter with gradients. Callers add a remedy to the message."""


@dataclass
class RayDerivative:
    """The adjoint q of a ray and of its density in reverse mode, or their tangent in forward mode."""

    o: mi.Point3f
    d: mi.Vector3f
    pdf: mi.Float

    @staticmethod
    def zero() -> RayDerivative:
        # dr.zeros reads the field types of a class only once. It would use the types of the first variant in all later
        # variants, and is therefore not called here.
        return RayDerivative(mi.Point3f(0), mi.Vector3f(0), mi.Float(0))

    def finite_part(self) -> tuple[RayDerivative, mi.Bool]:
        """Replace non-finite derivatives by zero; also return the mask of lanes with finite derivatives."""
        ok = dr.all(dr.isfinite(self.o)) & dr.all(dr.isfinite(self.d)) & dr.isfinite(self.pdf)
        return dr.select(ok, self, RayDerivative.zero()), ok


class NonFiniteCounter:
    """Counts the paths whose gradient is incomplete.

    A gradient is incomplete if one of its terms was not finite, or if the record of the path was full.
    """

    def __init__(self) -> None:
        self.count = dr.zeros(mi.UInt32, 1)

    def add(self, lost: mi.Bool) -> None:
        """Count the lanes in which ``lost`` is true, from inside a loop.

        The count is a side effect of the loop, like gradients. A mask returned from the loop would be evaluated
        separately, and the whole kernel would run again.
        """
        dr.scatter_add(self.count, mi.UInt32(1), mi.UInt32(0), lost)


def _attached_arrival(at: Arrival) -> Arrival:
    """Copy an `Arrival`. The ray and the density of the copy are independent AD variables."""
    ray, pdf = _attached_ray(at.ray), mi.Float(dr.detach(at.pdf))
    dr.enable_grad(pdf)
    return replace(at, ray=ray, pdf=pdf)


def _with_tangent(at: Arrival, tangent: RayDerivative) -> Arrival:
    """Copy an `Arrival`. The ray and the density of the copy have the given tangent."""
    at = _attached_arrival(at)
    dr.set_grad(at.ray.o, tangent.o)
    dr.set_grad(at.ray.d, tangent.d)
    dr.set_grad(at.pdf, tangent.pdf)
    return at


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
    """Back-propagate  δL β_i·(e_i + w_i L_{i+1}) + q_{i+1}·r_{i+1}  into the parameters; return L_i, q_i and a mask.

    `Step` defines e_i and w_i, and β_i is the throughput before vertex i. ``L`` is L_{i+1}, the radiance along the next
    ray r_{i+1}. ``q`` is q_{i+1}, the adjoint of the next ray. Unless ``attached``, ray adjoints are zero and are not
    computed. The mask contains the lanes in which q_i was not finite and was set to zero. With ``rays_only``, no
    parameter receives a gradient.
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
    trace: TraceConfig,
    v: VertexRecord,
    attached: bool,
    tangent: RayDerivative,
    active: mi.Bool,
    more: Callable[[Step], Sequence[object]] = lambda step: (),
) -> tuple[Step, mi.Spectrum, mi.Spectrum, RayDerivative, Tangents]:
    """Evaluate the step at vertex i again, with the tangent of the arriving ray.

    Returns the step, detached, the tangents of e_i, w_i (see `Step`) and the next ray, and the tangents of the values
    that ``more`` computes from the step.
    """
    with dr.resume_grad():
        at = _with_tangent(v.at, tangent) if attached else v.at
        step = repeat_step(trace, replace(v, at=at), attached, active)
        values = step.e, step.w, step.ray_next.o, step.ray_next.d, step.pdf, *more(step)
        # Without this, attached parts of the step that no value uses stay in the graph. Dr.Jit 1.5 then refuses to
        # differentiate virtual calls in a loop.
        step = dr.detach(step)
        δe, δw, δo, δd, δpdf, *δmore = tangents(*values)
    return step, δe, δw, RayDerivative(δo, δd, δpdf), δmore


def backward_ray(ray: mi.Ray3f, f: Callable[[mi.Ray3f], mi.Float]) -> tuple[RayDerivative, mi.Bool]:
    """Back-propagate a function of a ray into the parameters; return the adjoint of the ray and a mask.

    The mask contains the lanes in which the adjoint was not finite and was set to zero.
    """
    with dr.resume_grad():
        ray = _attached_ray(ray)
        backward(f(ray))
        q, finite = RayDerivative(dr.grad(ray.o), dr.grad(ray.d), mi.Float(0)).finite_part()
        return q, ~finite


def forward_ray(ray: mi.Ray3f, tangent: RayDerivative, f: Callable[[mi.Ray3f], mi.Spectrum]) -> mi.Spectrum:
    """Return the tangent of a function of a ray, given the tangents of the ray and of the parameters."""
    with dr.resume_grad():
        ray = _attached_ray(ray)
        dr.set_grad(ray.o, tangent.o)
        dr.set_grad(ray.d, tangent.d)
        return tangents(f(ray))[0]


def derivative_by_ray(ray: mi.Ray3f, f: Callable[[mi.Ray3f], mi.Float]) -> RayDerivative:
    """Differentiate a function with respect to a ray; zero if not finite. No parameter receives a gradient."""
    with dr.resume_grad():
        ray = _attached_ray(ray)
    with dr.resume_grad(ray.o, ray.d):
        dr.backward_from(f(ray))
        return RayDerivative(dr.grad(ray.o), dr.grad(ray.d), mi.Float(0)).finite_part()[0]


def derivative_by_place(s: mi.Point2f, f: Callable[[mi.Point2f], mi.Float]) -> mi.Vector2f:
    """Differentiate a function with respect to a point in the plane. No parameter receives a gradient."""
    s = mi.Point2f(dr.detach(s))
    with dr.resume_grad():
        dr.enable_grad(s)
    with dr.resume_grad(s):
        # f(s) has no gradient if it is constant, for example for the samples of a point light.
        dr.backward_from(f(s), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        return mi.Vector2f(dr.grad(s))


def _attached_ray(ray: mi.Ray3f) -> mi.Ray3f:
    """Copy a ray. The origin and the direction of the copy are independent AD variables."""
    ray = mi.Ray3f(ray)
    ray.o, ray.d = mi.Point3f(dr.detach(ray.o)), mi.Vector3f(dr.detach(ray.d))
    dr.enable_grad(ray.o, ray.d)
    return ray


def tangents(*values: object) -> Tangents:
    """Return the tangents of all values, propagated from the parameters in one traversal.

    The tangent of a value without gradients is zero.
    """
    attached = [value for value in values if dr.grad_enabled(value)]
    if not attached:
        return [dr.zeros(type(value)) for value in values]
    # Gradients of interior nodes must not be cleared: a value may be an interior node in the graph of another value.
    dr.forward_to(*attached, flags=dr.ADFlag.ClearEdges)
    return [dr.grad(value) for value in values]


def backward(target: mi.Float) -> None:
    """Back-propagate from a scalar per path.

    Raises Unreached if the scalar depends on no parameter with gradients. Without this error, all gradients would
    silently be zero.
    """
    if not dr.grad_enabled(target):
        if not dr.flag(dr.JitFlag.SymbolicLoops) and not dr.flag(dr.JitFlag.SymbolicCalls):
            return  # Dr.Jit runs loop iterations one by one; ``target`` may have gradients in another iteration.
        raise Unreached("no parameter with gradients reaches the light paths")
    dr.backward_from(target)
