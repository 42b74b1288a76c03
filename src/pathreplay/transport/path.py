"""The state of a path in the loops that trace paths, and its transition to the next vertex."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.meet import meet
from pathreplay.transport.start import Start, behind_emitters
from pathreplay.transport.step import choose_step
from pathreplay.transport.vertex import Arrival, SampledStep, TraceConfig, VertexRecord, VertexSamples, reciprocal
from pathreplay.transport.volume.passage import skip_null

# At each vertex from ``rr_depth`` on, Russian roulette terminates at least one path in twenty. Paths between mirrors
# therefore end.
MAX_SURVIVAL = 0.95


@dataclass
class PathState:
    """Loop state of a path: the arrival at the current vertex, and the throughput up to this vertex."""

    at: Arrival
    β: mi.Spectrum  # throughput
    # β, but with the first zero weight of each channel replaced (see `sustain`). Termination depends on β_alive and not
    # on β, because a path whose β is zero may have nonzero derivatives. None if zero weights end paths.
    β_alive: mi.Spectrum | None
    η: mi.Float  # product of the relative indices of refraction since the camera
    depth: mi.UInt32  # number of vertices before this one
    active: mi.Bool

    @staticmethod
    def begin(trace: TraceConfig, start: Start, sustained: bool = False) -> PathState:
        """Start paths at their first vertices.

        If ``sustained``, the first zero weight does not end a path: see `sustain`.
        """
        active = mi.Bool(start.active) & (trace.max_depth > 0)
        β_alive = mi.Spectrum(1) if sustained else None
        return PathState(start.choose(trace, active), mi.Spectrum(1), β_alive, mi.Float(1), mi.UInt32(0), active)

    def choose(self, trace: TraceConfig, sampler: Sampler) -> tuple[VertexSamples, SampledStep]:
        """Sample the step of this vertex. Return the random numbers with which the step was sampled, and the step."""
        u = VertexSamples.draw(sampler)
        β = self.β if self.β_alive is None else self.β_alive
        step = choose_step(trace, self.at, β, u, sampler, self.depth + 1 < trace.max_depth, self.active)
        return step.u, step

    def leave(self) -> tuple[PathState, mi.Bool]:
        """Terminate paths whose ray leaves the scene.

        Returns the new state, whose ``at`` is unchanged, and the mask of the terminated paths.
        """
        left = self.active & ~self.at.hit.is_valid()
        return replace(self, active=self.active & ~left), left

    def passed(self, trace: TraceConfig, step: SampledStep) -> mi.UInt32:
        """Return the number of vertices before the next vertex; with media, null boundaries do not count."""
        return self.depth + (1 if trace.media is None else dr.select(step.null, mi.UInt32(0), 1))

    def advance(
        self, trace: TraceConfig, u: VertexSamples, step: SampledStep, at: Arrival | None = None
    ) -> tuple[PathState, VertexRecord]:
        """Move to the next vertex; return the new state and the record of the previous vertex for later passes.

        ``at`` is the arrival at the next vertex, if the caller has already traced the continuation.
        """
        β = self.β * dr.detach(step.w)
        β_alive = None if self.β_alive is None else sustain(self.β_alive, self.β, step)
        lasting = β if β_alive is None else β_alive
        η = self.η * step.eta
        rr_weight, survives = survival(lasting, η, self.depth, u.roulette, trace, step)
        β_alive = None if β_alive is None else β_alive * rr_weight  # without ``u_weight``: rare lobes would soon end
        if step.u_weight is not None:
            rr_weight *= step.u_weight
        active = step.active & survives & (dr.max(lasting) != 0)
        at = next_arrival(trace, self.at, step, active, self.depth == 0) if at is None else at
        onward = PathState(at, β * rr_weight, β_alive, η, self.passed(trace, step), active)
        return onward, VertexRecord(self.at, u, step.kept, active, at.hit, rr_weight, self.β)


def survival(
    β: mi.Spectrum, η: mi.Float, depth: mi.UInt32, u: mi.Float, trace: TraceConfig, step: SampledStep
) -> tuple[mi.Float, mi.Bool]:
    """Play Russian roulette: return 1 / (survival probability), and whether the path survives. Detached.

    The probability is min(max β · η², 0.95) from depth ``rr_depth`` on, and 1 before. The factor η² cancels the change
    of β by refraction, which scales radiance but not power. Paths are not terminated at null boundaries between media.
    """
    probability = dr.minimum(dr.max(β) * dr.square(η), MAX_SURVIVAL)
    plays = depth >= trace.rr_depth
    if trace.media is not None:
        plays &= ~step.null
    return dr.select(plays, reciprocal(probability), 1), ~plays | (u < probability)


def sustain(β_alive: mi.Spectrum, β: mi.Spectrum, step: SampledStep) -> mi.Spectrum:
    """Return the throughput after this step, with the first zero weight of each channel replaced by a nonzero number.

    A weight of zero can have a nonzero derivative, which multiplies the radiance from the rest of the path. The path
    must therefore continue. The replacement is the largest weight among the channels, or one if all weights are zero. A
    second zero weight is not replaced: all derivatives of the channel are then zero. A zero weight of null collisions
    is not replaced either, because this weight comes from the sampling and not from the scene.
    """
    w = dr.detach(step.w)
    w_max = dr.max(w)
    stand_in = dr.select(step.kept.pdf != 0, dr.select(w_max != 0, w_max, 1), 0)
    if step.kept.media is not None:
        stand_in = dr.select(step.kept.media.flight.W != 0, stand_in, 0)
    return β_alive * mi.Spectrum(dr.select((w == 0) & (β != 0), stand_in, w))


def next_arrival(
    trace: TraceConfig, at: Arrival, step: SampledStep, active: mi.Bool, first: mi.Bool | bool = False
) -> Arrival:
    """Trace the continuation of a step to the next vertex. ``at`` is the arrival at the vertex of the step.

    ``first`` is the mask of paths that leave their first vertex. MIS ignores null boundaries between media: the density
    of the last scattering event remains valid behind a boundary. Environments hidden by ``hide_emitters`` stay hidden
    behind surfaces that the path passes unscattered. In scenes with media, this is also true of area emitters.
    """
    kept, null, ray = step.kept, step.null, step.ray_next
    hit = meet(trace, ray, active)
    if trace.skips_null:
        hit = skip_null(trace, ray, hit, active)
    scattered = at.scattered
    if trace.without_caustics:
        scattered = dr.select(first, ~(kept.delta | null), at.scattered)
    if trace.media is None:
        camera = null & at.camera if trace.hide_emitters and trace.to_sensor is None else mi.Bool(False)
        return Arrival(ray, hit, kept.pdf, kept.delta, camera, scattered=scattered)
    camera = null & at.camera
    if trace.hide_emitters and trace.to_sensor is None:
        hit = behind_emitters(trace, ray, hit, active & camera)
    pdf, delta = dr.select(null, at.pdf, kept.pdf), dr.select(null, at.delta, kept.delta)
    behind = dr.select(null, at.behind + dr.norm(ray.o - at.ray.o), 0)
    return Arrival(ray, hit, pdf, delta, camera, step.medium, behind, scattered)
