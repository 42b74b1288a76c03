"""Null branching: an extra path from a null collision, for derivatives where real collisions cannot occur.

The derivative at a collision is dσ_s L_s - dσ_t b, with L_s the in-scattered radiance and b the baseline. Where σ_s is
zero, no path scatters, so that L_s is not estimated. One null collision per path is therefore kept, by weighted
reservoir sampling, and an extra path that starts there (the branch) estimates L_s. `branch_weight` distributes the
derivative between real and null collisions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import backward
from pathreplay.adjoint.primal import path_radiance
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.path import PathState, next_arrival
from pathreplay.transport.step import choose_step
from pathreplay.transport.vertex import Arrival, Flight, SampledStep, TraceConfig, VertexSamples
from pathreplay.transport.volume.media import interaction, majorant


@dataclass
class Branch:
    """The null collision in the reservoir (loop state). All fields are zero before the first collision."""

    p: mi.Point3f  # position of the collision
    d: mi.Vector3f  # direction of the path before the collision
    medium: mi.MediumPtr
    weight: mi.Spectrum  # throughput times `NullCollision.ω`
    bare: mi.Spectrum  # throughput times `NullCollision.bare`
    mass: mi.Float  # sum of the resampling weights of all null collisions so far
    number: mi.Float  # number of null collisions so far
    depth: mi.UInt32  # number of vertices before the collision
    η: mi.Float  # product of the relative indices of refraction along the path
    scattered: mi.Bool  # `Arrival.scattered` after the collision; None unless caustics are omitted

    @staticmethod
    def none(trace: TraceConfig) -> Branch:
        o, d, black, zero = mi.Point3f(0), mi.Vector3f(0), mi.Spectrum(0), mi.Float(0)
        no: mi.Bool = mi.Bool(False) if trace.without_caustics else None  # type: ignore[assignment]
        return Branch(o, d, dr.zeros(mi.MediumPtr), black, black, zero, mi.Float(0), mi.UInt32(0), mi.Float(1), no)

    def offer(self, path: PathState, step: SampledStep) -> Branch:
        """Offer the null collision of a step to the reservoir. Its resampling weight is `NullCollision.mass`."""
        ray, null = path.at.ray, step.kept.media.flight.null
        active = path.active & dr.any(path.β != 0)
        mass = self.mass + dr.select(active, null.mass, 0)
        taken = active & (null.pick * mass < null.mass)
        weight, bare = mi.Spectrum(path.β * null.ω), mi.Spectrum(path.β * null.bare)
        number = self.number + dr.select(active, null.number, 0)
        p, medium = mi.Point3f(ray.o + null.t * ray.d), path.at.medium
        scattered = self.scattered
        if scattered is not None:
            scattered = path.at.scattered | (path.at.camera & medium.use_emitter_sampling())
        offered = Branch(p, ray.d, medium, weight, bare, mass, number, path.depth, path.η, scattered)
        return replace(dr.select(taken, offered, self), mass=mass, number=number)


def branch_backward(trace: TraceConfig, branch: Branch, sampler: Sampler, ray: mi.Ray3f, δL: mi.Spectrum) -> None:
    """Back-propagate ``δL`` through the `branch_term`, if this term depends on a parameter with gradients."""
    with dr.resume_grad():
        term = branch_term(trace, branch, sampler, ray)
        if dr.grad_enabled(term):
            backward(dr.sum(δL * term))


def branch_term(trace: TraceConfig, branch: Branch, sampler: Sampler, ray: mi.Ray3f) -> mi.Spectrum:
    """Return a term whose derivative is the branch's contribution to the derivative of the radiance (Spectrum).

    Only the derivative of the term is meaningful. The extra path is detached, and takes time and wavelengths from the
    camera ``ray``. The term is differentiable in the coefficients of the medium. The caller must resume gradients
    (`dr.resume_grad`).
    """
    onward = replace(trace, branching=None, balances_lobes=False)
    active = branch.mass > 0
    with dr.suspend_grad():
        ray, hit = mi.Ray3f(branch.p, branch.d, ray.time, ray.wavelengths), dr.zeros(mi.PreliminaryIntersection3f)
        no, scattered = mi.Bool(False), branch.scattered
        at = Arrival(ray, hit, mi.Float(1), mi.Bool(True), no, branch.medium, mi.Float(0), scattered)
        one = mi.Spectrum(1)
        flight = Flight(event=active, t=mi.Float(0), density=mi.Float(1), W=one, along=mi.Float(0), σ_s=one)
        u = VertexSamples.draw(sampler)
        step = choose_step(onward, at, one, u, sampler, branch.depth + 1 < trace.max_depth, active, flight)
        at_next = next_arrival(onward, at, step, step.active)
        L, _ = path_radiance(onward, sampler, PathState(at_next, one, None, branch.η, branch.depth + 1, step.active))
        L_s = step.e + step.w * L
    mei = interaction(branch.medium, at.ray, mi.Float(0))
    σ_s, _, σ_t = branch.medium.get_scattering_coefficients(mei, active)
    term = branch.weight * σ_s * L_s
    if trace.baseline is not None:
        term -= branch.bare * σ_t * trace.baseline(mei, σ_t, majorant(branch.medium, at.ray, active), active)
    return dr.select(active, branch.mass * term, 0)
