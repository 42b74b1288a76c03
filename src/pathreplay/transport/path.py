"""What all walks share: the first vertex, Russian roulette, and the ray that finds the next vertex."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .vertex import Arrival, Step, Walk, reciprocal

# Russian roulette ends at least one path in twenty, so that a path between mirrors comes to an end.
MAX_SURVIVAL = 0.95


def first_arrival(walk: Walk, ray: Any, active: Any) -> Arrival:
    """The first vertex along camera rays, detached from them; ``hide_emitters`` makes area emitters transparent."""
    ray = mi.Ray3f(dr.detach(ray))
    hit = walk.scene.ray_intersect_preliminary(ray, coherent=True, reorder=False, active=active)
    if walk.hide_emitters:
        passed = active & hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 (an array of pointers)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, passed)
        onward = si.spawn_ray(ray.d)
        behind = walk.skip_area_emitters(walk.scene, onward, True, passed)
        behind.t += dr.norm(onward.o - ray.o)  # distances are told along the camera ray
        hit[passed] = behind
    return Arrival(ray=ray, hit=hit, pdf=mi.Float(1), delta=mi.Bool(True), camera=mi.Bool(True))


def survival(β: Any, η: Any, depth: Any, u: Any, walk: Walk) -> tuple[Any, Any]:
    """Russian roulette: 1 / (survival probability) (Float) and whether the path survives (Bool). Detached.

    The probability is min(max β · η², 0.95) from ``rr_depth`` on and one before; η² takes the compression of solid
    angle out of the radiance throughput.
    """
    probability = dr.minimum(dr.max(β) * dr.square(η), MAX_SURVIVAL)
    plays = depth >= walk.rr_depth
    return dr.select(plays, reciprocal(probability), 1), ~plays | (u < probability)


def sustain(β_alive: Any, β: Any, step: Step) -> Any:
    """Throughput that decides how long a path is worth differentiating: one zero weight per channel is left out.

    A weight that is zero now still has a derivative, times the light beyond it; so the path goes on as if that weight
    were the largest among the channels (one, if all are zero). A second zero makes every derivative zero and ends it.
    """
    w = dr.detach(step.w)
    w_max = dr.max(w)
    stand_in = dr.select(step.kept.pdf != 0, dr.select(w_max != 0, w_max, 1), 0)
    return β_alive * mi.Spectrum(dr.select((w == 0) & (β != 0), stand_in, w))


def next_arrival(walk: Walk, step: Step, active: Any) -> Arrival:
    """Follow the continuation of a step to the next vertex."""
    hit = walk.scene.ray_intersect_preliminary(step.ray_next, coherent=False, reorder=False, active=active)
    return Arrival(ray=step.ray_next, hit=hit, pdf=step.kept.pdf, delta=step.kept.delta, camera=mi.Bool(False))
