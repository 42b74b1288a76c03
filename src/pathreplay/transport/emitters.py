"""The light that a vertex adds by itself: emission of what was hit, and samples of the emitters."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .surface import held_point
from .vertex import Arrival, Walk, mis_weight, reciprocal


def emission(scene: Any, at: Arrival, si: Any, attached: bool, active: Any) -> Any:
    """Radiance emitted towards the ray's origin by what the ray hit (the environment on a miss), MIS weighted.

    Returns a Spectrum, differentiable in the emitter's radiance and, if ``attached``, in the ray, the hit point and
    the density ``at.pdf``. A path that is held fixed needs no derivative of its MIS weights: they sum to one whatever
    the parameters do.
    """
    with dr.suspend_grad(when=not attached):
        origin = dr.zeros(mi.Interaction3f)
        origin.p, origin.time, origin.wavelengths = at.ray.o, at.ray.time, at.ray.wavelengths
        if at.behind is not None:
            origin.p -= at.behind * at.ray.d
        ds = mi.DirectionSample3f(scene, si=si, ref=origin)
        mis = mis_weight(at.pdf, scene.pdf_emitter_direction(origin, ds, active & ~at.delta))
    return mis * ds.emitter.eval(si, active)


def draw_emitter(scene: Any, si: Any, u: Any, active: Any, visible: bool = True) -> tuple[Any, Any]:
    """Sample a direction towards an emitter: the DirectionSample3f and Le/p (Spectrum).

    If it must be ``visible``, an occluded sample comes back with density and weight zero; else nobody looks. Nothing is
    differentiated.
    """
    with dr.suspend_grad():
        return scene.sample_emitter_direction(si, u, visible, active)


def redraw_emitter(walk: Walk, si: Any, u: Any, light: Any, attached: bool, lit: Any) -> tuple[Any, Any]:
    """The emitter sample of a first walk once more, differentiable: the DirectionSample3f and Le/p (Spectrum).

    ``light`` is the sample itself, if it is still at hand, else None. If ``attached``, the point on the emitter stays
    the same in the emitter's own coordinates, so that it moves with the emitter, and everything follows; else it is
    fixed in space and only the emitted radiance is differentiated. Visibility never is.
    """
    scene = walk.scene
    if attached:
        light, Le = scene.sample_emitter_direction(si, u, False, lit)
        if walk.traits.lights_deform:
            Le *= _mesh_growth(scene, si, light, lit)
        return light, Le
    if light is None:
        with dr.suspend_grad():
            light, _ = scene.sample_emitter_direction(si, u, False, lit)
    return light, scene.eval_emitter_direction(si, light, lit) * dr.detach(reciprocal(light.pdf))


def _mesh_growth(scene: Any, si: Any, light: Any, lit: Any) -> Any:
    """Area of the emitting triangle relative to its present one: 1, with the derivative of log area.

    Mitsuba samples a mesh with the areas that its triangles had, and does not differentiate them.
    """
    ray = dr.detach(si.spawn_ray_to(light.p))
    ray.maxt = dr.largest(mi.Float)
    hit = scene.ray_intersect_preliminary(ray, active=lit)
    on_mesh = lit & hit.is_valid() & hit.shape.is_mesh() & (hit.shape.emitter() == light.emitter)
    area = dr.norm(held_point(hit, ray, on_mesh).A)
    return dr.select(on_mesh & (area > 0), dr.replace_grad(mi.Float(1), area * dr.detach(reciprocal(area))), 1)
