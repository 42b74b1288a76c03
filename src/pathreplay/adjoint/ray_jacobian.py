"""Rays in four local coordinates, and the 4x4 Jacobian of the map from one ray of a path to the next.

A ray has four degrees of freedom: the position of its origin in the plane perpendicular to the ray, and its direction.
Moving the origin along the ray changes neither the hit point nor the rest of the path. The Jacobian in the six
coordinates (o, d) would therefore always be singular. Two quantities that belong to the ray are not functions of the
four coordinates: its density, and the distance from the previous vertex. Both affect only the MIS weight of the
emission at the next vertex. `emission_slope` differentiates this weight separately from the matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import tangents
from pathreplay.platform import compat
from pathreplay.transport.emitters import emission
from pathreplay.transport.path import PathState
from pathreplay.transport.step import repeat_step
from pathreplay.transport.vertex import Arrival, TraceConfig, VertexRecord, VertexSamples, reciprocal

# Noise is added where `independence` is below this value. At a smooth lobe whose sampled direction follows the next hit
# point, independence is zero up to float32 rounding (1e-7). At mirrors, glass and attached rough metal, independence is
# above 1e-3. In float64, matrices with an independence of 1e-4 can be inverted accurately.
ILL_CONDITIONED = 1e-4


@dataclass(frozen=True)
class Recovery:
    """How the adjoint q_{i+1} of the next ray is recovered: solve (A_i + ε_i X_i)^T q_{i+1} = q_i - p_i, in float64.

    See `replay_attached` for A_i and p_i. Where A_i is ill-conditioned, X_i is the identity on directions and zero on
    origins. Elsewhere, X_i is zero. The random number ε_i is +noise or -noise with equal probability. At ε_i = 0, an
    ill-conditioned matrix would stay singular. Among all distributions of ε_i with standard deviation ``noise``, this
    distribution stays farthest from zero. If ``noise`` is 0, no noise is added.
    """

    noise: float = 0.01

    def real(self, kind: type) -> type:
        """Return the float64 counterpart of an array type, in which adjoints are recovered."""
        return dr.float64_array_t(kind)  # type: ignore[no-any-return]

    def regularised(self, A: mi.Matrix4f, sign: mi.Float, smooth: mi.Bool) -> mi.Matrix4f:
        """Return A + ε X.

        ``smooth`` marks the lanes in which a smooth lobe was sampled. This class ignores
        the mask, but a subclass may use it.
        """
        ε = dr.select(independence(A) >= ILL_CONDITIONED, 0, type(A[0, 0])(self.noise * sign))
        return A + type(A)(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, ε, 0, 0, 0, 0, ε)


@dataclass
class RayFrame:
    """Two axes s, t perpendicular to a ray.

    A nearby ray (o, d) has the coordinates (s·o/ℓ, t·o/ℓ, s·d, t·d), where ℓ is the unit of length.
    """

    s: mi.Vector3f
    t: mi.Vector3f
    scale: float  # the unit of length ℓ

    @staticmethod
    def of(ray: mi.Ray3f, scale: float) -> RayFrame:
        s, t = mi.coordinate_system(ray.d)
        return RayFrame(s, t, scale)

    def point(self, o: mi.Point3f, x: list[mi.Float]) -> mi.Point3f:
        return o + self.scale * (self.s * x[0] + self.t * x[1])

    def direction(self, d: mi.Vector3f, x: list[mi.Float]) -> mi.Vector3f:
        return d + self.s * x[2] + self.t * x[3]

    def coordinates(self, o: mi.Point3f, d: mi.Vector3f) -> list[mi.Float]:
        inverse = 1 / self.scale
        return [dr.dot(self.s, o) * inverse, dr.dot(self.t, o) * inverse, dr.dot(self.s, d), dr.dot(self.t, d)]


@dataclass
class Slope:
    """Derivatives of δL·β e with respect to the density and to the origin of the ray that arrives at a vertex.

    Here e is the emission at the vertex. The origin moves along the ray. Neither the density nor this motion changes
    the four coordinates of the ray.
    """

    pdf: mi.Float  # derivative with respect to the density of the ray
    slide: mi.Float  # derivative with respect to the distance by which the origin of the ray moves along the ray


@dataclass
class Linearised:
    """A step linearised in the four coordinates of its ray."""

    A: mi.Matrix4f  # ∂r_{i+1}/∂r_i: derivative of the next ray's coordinates
    e: mi.Vector4f  # derivative of the first term of `local_terms`
    log_w: list[mi.Spectrum]  # derivative of log w_i with respect to each coordinate; 0 where w_i is 0
    slope: Slope  # slope of the emission at the next vertex
    frame_next: RayFrame  # axes of the next ray


@dataclass
class PeeledPath:
    """State of the second pass of attached replay. The pass starts with L and q as computed by the first pass."""

    δL: mi.Spectrum  # adjoint of the radiance of the path
    L: mi.Spectrum  # β_i L_i
    q: mi.Vector4f  # adjoint of the ray, in the coordinates of its `RayFrame`
    overflow: mi.Bool  # q was not finite, and was set to zero


def has_smooth_lobes(trace: TraceConfig) -> bool:
    """Return whether any BSDF of the scene has a lobe that is not a delta lobe."""
    return bool(trace.traits.detached_names or trace.traits.attachables)


def length_scale(scene: mi.Scene) -> float:
    """Return half the diagonal of the scene (1 if empty): a unit in which offsets are comparable to angles."""
    extents = scene.bbox().extents()
    diagonal = sum(float(x) ** 2 for x in extents) ** 0.5
    return diagonal / 2 if 0 < diagonal < float("inf") else 1.0


def emission_slope(trace: TraceConfig, at: Arrival, weight: mi.Spectrum, active: mi.Bool) -> Slope:
    """Differentiate weight·e, where e is the emission at ``at``, with respect to the density and the origin of the ray.

    The ``weight`` is a constant. The origin moves along the ray (see `Slope`).
    """
    if not has_smooth_lobes(trace):
        return Slope(mi.Float(0), mi.Float(0))
    slopes = []
    for k in range(2):
        x = [at.pdf, mi.Float(0)]
        x[k] = _unit_tangent(x[k])
        with dr.resume_grad(x[k]):
            pdf, slide = x
            ray = mi.Ray3f(at.ray)
            si = at.hit.compute_surface_interaction(ray, compat.shading(), active)
            ray.o = ray.o + ray.d * slide
            slid = replace(at, ray=ray, pdf=pdf)
            e = dr.sum(weight * emission(trace.scene, slid, si, True, active))
            slopes.append(dr.select(active, tangents(e)[0], 0))
    return Slope(*slopes)


def local_terms(
    trace: TraceConfig,
    v: VertexRecord,
    at: Arrival,
    weight: mi.Spectrum,
    slope: Slope,
    frame_next: RayFrame,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Spectrum, list[mi.Float]]:
    """Evaluate the step at ``v`` with the differentiable arrival ``at``; return three terms.

    Both passes of attached replay differentiate these terms:

    - δL·β_i e_i, plus a linear approximation of the emission at the next vertex: `Slope.pdf` times the density of the
      next ray, plus `Slope.slide` times the position of the next ray's origin along this ray
    - w_i / detach(w_i), or 0 where w_i is 0
    - the four coordinates of the next ray

    ``weight`` is δL β_i. ``slope`` is the slope of the emission at the next vertex.
    """
    step = repeat_step(trace, replace(v, at=at), True, active)
    o, d = step.ray_next.o, step.ray_next.d
    e = dr.sum(weight * step.e)
    e += dr.select(v.go_on, slope.pdf * step.pdf + slope.slide * dr.dot(dr.detach(d), o), 0)
    w = dr.select(v.go_on, step.w * dr.detach(reciprocal(step.w)), 0)
    return e, w, frame_next.coordinates(o, d)


def linearise(
    trace: TraceConfig, v: VertexRecord, onward: PathState, δL: mi.Spectrum, scale: float, active: mi.Bool
) -> Linearised:
    """Differentiate `local_terms` with respect to the four coordinates of the ray; parameters are constants.

    ``onward`` is the path at the next vertex, and ``scale`` the unit of length. Both passes of attached replay call
    this function, so that the values of the two passes agree to the last bit.
    """
    slope = emission_slope(trace, onward.at, δL * onward.β, v.go_on)
    frame, frame_next = RayFrame.of(v.at.ray, scale), RayFrame.of(onward.at.ray, scale)
    columns = []
    for k in range(4):
        # Each column has its own AD graph: Dr.Jit 1.5 crashes if a graph of virtual calls in a loop is traversed twice.
        x = [mi.Float(0) for _ in range(4)]
        x[k] = _unit_tangent(0)
        with dr.resume_grad(x[k]):
            ray = mi.Ray3f(v.at.ray)
            ray.o, ray.d = frame.point(ray.o, x), frame.direction(ray.d, x)
            at = replace(v.at, ray=ray)
            e, w, x_next = local_terms(trace, v, at, δL * v.β, slope, frame_next, active)
            columns.append(tangents(e, w, *x_next))
    A = [columns[k][2 + j] for j in range(4) for k in range(4)]
    δe, log_w = mi.Vector4f(*[c[0] for c in columns]), [c[1] for c in columns]
    return Linearised(mi.Matrix4f(*A), δe, log_w, slope, frame_next)


def _unit_tangent(value: mi.Float | float) -> mi.Float:
    """Create an independent AD variable with tangent 1, even if gradients are suspended.

    The caller must resume gradients for this variable only. Otherwise virtual calls would propagate tangents of
    parameters across the loop boundary.
    """
    variable = mi.Float(dr.detach(value))
    with dr.resume_grad():
        dr.enable_grad(variable)
        dr.set_grad(variable, 1)
    return variable


def random_sign(u: VertexSamples) -> mi.Float:
    """Return +1 or -1 with equal probability, from a hash of the vertex's samples.

    Both passes of attached replay get the same sign.
    """
    bits = [dr.reinterpret_array(mi.UInt32, x) for x in (u.light.x, u.roulette)]
    return dr.select((mi.sample_tea_32(bits[0], bits[1], 4)[0] & 1) == 0, mi.Float(1), mi.Float(-1))


def independence(A: mi.Matrix4f) -> mi.Float64:
    """Measure how far the columns of a 4x4 matrix are from linear dependence: about 1 / condition number.

    Modified Gram-Schmidt removes from each column the components along earlier columns. The result is the smallest
    remaining norm, relative to the Frobenius norm. The cofactors that `dr.rcp` computes cannot be used instead, because
    they consist of rounding errors for a matrix of rank two.
    """
    real = dr.float64_array_t(mi.Float)
    columns = [[real(A[i, k]) for i in range(4)] for k in range(4)]
    norm2 = sum(_dot(c, c) for c in columns)
    smallest = real(1)
    for k, a in enumerate(columns):
        rest2 = _dot(a, a)
        smallest = dr.minimum(smallest, dr.sqrt(rest2 / norm2))
        for j in range(k + 1, 4):
            share = dr.select(rest2 > 0, _dot(a, columns[j]) / rest2, 0)
            columns[j] = [y - share * x for x, y in zip(a, columns[j], strict=True)]
    return smallest


def _dot(a: list[mi.Float64], b: list[mi.Float64]) -> mi.Float64:
    return reduce(add, (x * y for x, y in zip(a, b, strict=True)))
