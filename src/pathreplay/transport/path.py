"""The one walk that all drivers share: where a path is, and how it goes on to its next vertex."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.transport.meet import meet
from pathreplay.transport.start import CameraStart, behind_emitters
from pathreplay.transport.step import Visit, choose_step
from pathreplay.transport.vertex import Arrival, SampledStep, TraceConfig, VertexRecord, VertexSamples, reciprocal
from pathreplay.transport.volume.passage import skip_null

# Russian roulette ends at least one path in twenty, so that a path between mirrors comes to an end.
MAX_SURVIVAL = 0.95


@dataclass
class PathState:
    """A path on its way (loop state): where it has arrived, and what its vertices so far made of it."""

    at: Arrival
    β: mi.Spectrum  # throughput
    # Throughput with one zero weight left out, what keeps a path going that is to be differentiated; else None.
    β_alive: mi.Spectrum | None
    η: mi.Float  # relative index of refraction since the camera
    depth: mi.UInt32  # vertices before
    active: mi.Bool

    @staticmethod
    def begin(trace: TraceConfig, start: CameraStart, sustained: bool = False) -> PathState:
        """Paths at their first vertices; ``sustained`` says that weights of zero are to keep their derivatives."""
        active = mi.Bool(start.active) & (trace.max_depth > 0)
        β_alive = mi.Spectrum(1) if sustained else None
        return PathState(start.choose(trace, active), mi.Spectrum(1), β_alive, mi.Float(1), mi.UInt32(0), active)

    def choose(self, trace: TraceConfig, sampler: mi.Sampler) -> tuple[VertexSamples, SampledStep]:
        """The random numbers of this vertex, and the step that they choose."""
        u = VertexSamples.draw(sampler)
        β = self.β if self.β_alive is None else self.β_alive
        return u, choose_step(trace, Visit(self.at, β, self.depth + 1 < trace.max_depth, self.active), u, sampler)

    def leave(self) -> tuple[PathState, mi.Bool]:
        """The path, ended where the ray that arrives has hit nothing, and where that is so. ``at`` stays what it is."""
        left = self.active & ~self.at.hit.is_valid()
        return replace(self, active=self.active & ~left), left

    def passed(self, trace: TraceConfig, step: SampledStep) -> mi.UInt32:
        """Vertices before the next: one more, but with media not so at null boundaries."""
        return self.depth + (1 if trace.media is None else dr.select(step.null, mi.UInt32(0), 1))

    def advance(
        self, trace: TraceConfig, u: VertexSamples, step: SampledStep, at: Arrival | None = None
    ) -> tuple[PathState, VertexRecord]:
        """The path at its next vertex, and what later passes are to know of the one that it has left.

        ``at`` is the next arrival, if somebody has followed the step already.
        """
        β = self.β * dr.detach(step.w)
        β_alive = None if self.β_alive is None else sustain(self.β_alive, self.β, step)
        lasting = β if β_alive is None else β_alive
        η = self.η * step.eta
        rr_weight, survives = survival(lasting, η, self.depth, u.roulette, trace, step)
        active = step.active & survives & (dr.max(lasting) != 0)
        at = next_arrival(trace, self.at, step, active) if at is None else at
        β_alive = None if β_alive is None else β_alive * rr_weight
        onward = PathState(at, β * rr_weight, β_alive, η, self.passed(trace, step), active)
        return onward, VertexRecord(self.at, u, step.kept, active, at.hit, rr_weight, self.β)


def survival(
    β: mi.Spectrum, η: mi.Float, depth: mi.UInt32, u: mi.Float, trace: TraceConfig, step: SampledStep
) -> tuple[mi.Float, mi.Bool]:
    """Russian roulette: 1 / (survival probability), and whether the path survives. Detached.

    The probability is min(max β · η², 0.95) from ``rr_depth`` on and one before; η² takes the compression of solid
    angle out of the radiance throughput. Null boundaries between media let all paths pass.
    """
    probability = dr.minimum(dr.max(β) * dr.square(η), MAX_SURVIVAL)
    plays = depth >= trace.rr_depth
    if trace.media is not None:
        plays &= ~step.null
    return dr.select(plays, reciprocal(probability), 1), ~plays | (u < probability)


def sustain(β_alive: mi.Spectrum, β: mi.Spectrum, step: SampledStep) -> mi.Spectrum:
    """Throughput that decides how long a path is worth differentiating: one zero weight per channel is left out.

    A weight that is zero now still has a derivative, times the light beyond it; so the path goes on as if that weight
    were the largest among the channels (one, if all are zero). A second zero makes every derivative zero and ends it.
    So does a null collision that was impossible in a channel: its weight is a choice of the walk.
    """
    w = dr.detach(step.w)
    w_max = dr.max(w)
    stand_in = dr.select(step.kept.pdf != 0, dr.select(w_max != 0, w_max, 1), 0)
    if step.kept.media is not None:
        stand_in = dr.select(step.kept.media.flight.W != 0, stand_in, 0)
    return β_alive * mi.Spectrum(dr.select((w == 0) & (β != 0), stand_in, w))


def next_arrival(trace: TraceConfig, at: Arrival, step: SampledStep, active: mi.Bool) -> Arrival:
    """Follow the continuation of a step, which was taken from ``at``, to the next vertex.

    With media a null boundary is no vertex for multiple importance sampling: what was sampled before it still counts.
    """
    kept, null, ray = step.kept, step.null, step.ray_next
    hit = meet(trace, ray, active)
    if trace.clear:
        hit = skip_null(trace, ray, hit, active)
    if trace.media is None:
        return Arrival(ray=ray, hit=hit, pdf=kept.pdf, delta=kept.delta, camera=mi.Bool(False))
    camera = null & at.camera
    if trace.hide_emitters:
        hit = behind_emitters(trace, ray, hit, active & camera)
    pdf, delta = dr.select(null, at.pdf, kept.pdf), dr.select(null, at.delta, kept.delta)
    behind = dr.select(null, at.behind + dr.norm(ray.o - at.ray.o), 0)
    return Arrival(ray, hit, pdf, delta, camera, step.medium, behind)
