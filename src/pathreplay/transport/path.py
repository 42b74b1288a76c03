"""What all walks share: the first vertex, the step that a scene needs, Russian roulette, the ray to the next vertex."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .medium_step import medium_step
from .step import surface_step
from .vertex import Arrival, Kept, Numbers, Step, Walk, reciprocal

# Russian roulette ends at least one path in twenty, so that a path between mirrors comes to an end.
MAX_SURVIVAL = 0.95


def first_arrival(walk: Walk, ray: Any, active: Any) -> Arrival:
    """The first vertex along camera rays, detached from them; ``hide_emitters`` makes area emitters transparent."""
    ray = mi.Ray3f(dr.detach(ray))
    hit = walk.scene.ray_intersect_preliminary(ray, coherent=True, reorder=False, active=active)
    if walk.hide_emitters:
        hit = _behind_emitters(walk, ray, hit, active)
    at = Arrival(ray=ray, hit=hit, pdf=mi.Float(1), delta=mi.Bool(True), camera=mi.Bool(True))
    if walk.media is not None:
        around = walk.media.around
        at.medium = dr.zeros(mi.MediumPtr) if around is None else mi.MediumPtr(around)
        at.behind = mi.Float(0)
    return at


def take_step(walk: Walk, at: Arrival, u: Numbers, sampler: Any, β: Any, go_on: Any, active: Any) -> Step:
    """The step of a first walk, which chooses: see `surface_step` and `medium_step`."""
    if walk.media is None:
        return surface_step(walk, at, u, go_on, active)
    return medium_step(walk, at, u, go_on, active, sampler, β)


def repeat_step(
    walk: Walk,
    at: Arrival,
    u: Numbers,
    kept: Kept,
    go_on: Any,
    active: Any,
    attached: bool = False,
    hit_next: Any = None,
) -> Step:
    """The same step once more, differentiable: see `surface_step` and `medium_step`."""
    if walk.media is None:
        return surface_step(walk, at, u, go_on, active, kept, attached, hit_next)
    return medium_step(walk, at, u, go_on, active, kept=kept, attached=attached, hit_next=hit_next)


def count(walk: Walk, step: Step) -> Any:
    """How much deeper a step goes (UInt32): 1, but with media 0 at null boundaries."""
    return mi.UInt32(1) if walk.media is None else dr.select(step.kept.null, mi.UInt32(0), 1)


def survival(β: Any, η: Any, depth: Any, u: Any, walk: Walk, step: Step) -> tuple[Any, Any]:
    """Russian roulette: 1 / (survival probability) (Float) and whether the path survives (Bool). Detached.

    The probability is min(max β · η², 0.95) from ``rr_depth`` on and one before; η² takes the compression of solid
    angle out of the radiance throughput. Null boundaries between media let all paths pass.
    """
    probability = dr.minimum(dr.max(β) * dr.square(η), MAX_SURVIVAL)
    plays = depth >= walk.rr_depth
    if walk.media is not None:
        plays &= ~step.kept.null
    return dr.select(plays, reciprocal(probability), 1), ~plays | (u < probability)


def sustain(β_alive: Any, β: Any, step: Step) -> Any:
    """Throughput that decides how long a path is worth differentiating: one zero weight per channel is left out.

    A weight that is zero now still has a derivative, times the light beyond it; so the path goes on as if that weight
    were the largest among the channels (one, if all are zero). A second zero makes every derivative zero and ends it.
    So does a null collision that was impossible in a channel: its weight is a choice of the walk.
    """
    w = dr.detach(step.w)
    w_max = dr.max(w)
    stand_in = dr.select(step.kept.pdf != 0, dr.select(w_max != 0, w_max, 1), 0)
    if step.kept.flight is not None:
        stand_in = dr.select(step.kept.flight.W != 0, stand_in, 0)
    return β_alive * mi.Spectrum(dr.select((w == 0) & (β != 0), stand_in, w))


def next_arrival(walk: Walk, at: Arrival, step: Step, active: Any) -> Arrival:
    """Follow the continuation of a step, which was taken from ``at``, to the next vertex.

    With media a null boundary is no vertex for multiple importance sampling: what was sampled before it still counts.
    """
    kept, ray = step.kept, step.ray_next
    hit = walk.scene.ray_intersect_preliminary(ray, coherent=False, reorder=False, active=active)
    if walk.media is None:
        return Arrival(ray=ray, hit=hit, pdf=kept.pdf, delta=kept.delta, camera=mi.Bool(False))
    camera = kept.null & at.camera
    if walk.hide_emitters:
        hit = _behind_emitters(walk, ray, hit, active & camera)
    return Arrival(
        ray=ray,
        hit=hit,
        pdf=dr.select(kept.null, at.pdf, kept.pdf),
        delta=dr.select(kept.null, at.delta, kept.delta),
        camera=camera,
        medium=step.medium,
        behind=dr.select(kept.null, at.behind + dr.norm(ray.o - at.ray.o), 0),
    )


def _behind_emitters(walk: Walk, ray: Any, hit: Any, active: Any) -> Any:
    """The hit, or what lies behind the area emitters that were hit; distances are told along ``ray``."""
    passed = active & hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 (an array of pointers)
    si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, passed)
    onward = si.spawn_ray(ray.d)
    behind = walk.skip_area_emitters(walk.scene, onward, True, passed)
    behind.t += dr.norm(onward.o - ray.o)
    hit[passed] = behind
    return hit
