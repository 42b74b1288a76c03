"""Shadow rays through media and null boundaries: ratio tracking, and the derivative of the transmittance it found.

T = exp(-∫ σ_t ds) is estimated by walking from boundary to boundary; in homogeneous media it is known. Its derivative
is taken at one point y, uniform over the whole length Λ of medium on the ray:  d log T = -Λ dσ_t(y).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .media import carried, interaction, is_grid, majorant, span
from .vertex import Walk


@dataclass
class Shadow:
    """What a first walk found between a vertex and its emitter sample."""

    T: Any  # Spectrum: estimate of the transmittance, 0 if something is in the way
    y: Any  # Float: distance of the point where its derivative is taken
    medium: Any  # MediumPtr: the medium there; null if there is none on the way
    length: Any  # Float: length of medium on the ray


@dr.syntax
def shadow(
    walk: Walk,
    origin: Any,
    light: Any,
    medium: Any,
    sampler: Any,
    active: Any,
    visit: Any = None,
) -> Shadow:
    """Estimate the transmittance from the Interaction3f ``origin``, in ``medium``, to the emitter sample. Detached.

    ``visit`` is called at every tentative collision of ratio tracking: see `ratio_tracking`.
    """
    scene, media = walk.scene, walk.media
    ray = dr.detach(origin.spawn_ray_to(light.p))
    gone = mi.Float(0)  # distance from the origin
    far = mi.Float(ray.maxt)
    active = mi.Bool(active)
    medium = mi.MediumPtr(medium)
    T = mi.Spectrum(1)
    y, y_medium, length = mi.Float(0), dr.zeros(mi.MediumPtr), mi.Float(0)

    while dr.hint(active, exclude=[walk, scene, media, visit], label="pathreplay: shadow"):
        ray.maxt = far - gone
        hit = scene.ray_intersect_preliminary(ray, coherent=False, reorder=False, active=active)
        met = active & hit.is_valid()

        inside = active & (medium != None)  # noqa: E711
        a, b = span(medium, ray, dr.select(met, hit.t, ray.maxt), inside)
        inside &= a < b
        T = dr.select(inside, T * _transmittance(walk, medium, ray, a, b, sampler, inside, visit), T)
        length += b - a
        u = sampler.next_1d(inside) * length
        picked = inside & (u < b - a)
        y = dr.select(picked, gone + a + u, y)
        y_medium = dr.select(picked, medium, y_medium)

        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, met)
        T = dr.select(met, T * si.bsdf(ray).eval_null_transmission(si, met), T)
        crossed = met & si.is_medium_transition()
        medium = dr.select(crossed, si.target_medium(ray.d), medium)
        onward = si.spawn_ray(ray.d)
        gone += dr.select(met, dr.norm(onward.o - ray.o), 0)
        ray.o = dr.select(met, onward.o, ray.o)
        active = met & (gone < far) & dr.any(T != 0)

    return Shadow(T=T, y=y, medium=y_medium, length=length)


def _transmittance(walk: Walk, medium: Any, ray: Any, a: Any, b: Any, sampler: Any, active: Any, visit: Any) -> Any:
    """An unbiased estimate of the transmittance of one medium between the distances a and b (Spectrum)."""
    media = walk.media
    T = mi.Spectrum(1)
    rest = mi.Bool(active)
    for grid in media.grids:
        mine = active & is_grid(grid, medium)
        part = mi.Ray3f(ray.o + a * ray.d, ray.d, ray.time, ray.wavelengths)
        part.maxt = b - a
        T = dr.select(mine, grid.transmittance(part, sampler, mine), T)
        rest &= ~mine
    if media.homogeneous:
        same = rest & medium.is_homogeneous()
        σ_t = dr.detach(medium.get_scattering_coefficients(interaction(medium, ray, a), same)[2])
        T = dr.select(same, mi.Spectrum(dr.exp(-σ_t * (b - a))), T)
        rest &= ~same
    if media.plain:
        T = dr.select(rest, ratio_tracking(medium, ray, a, b, sampler, rest, visit), T)
    return T


@dr.syntax
def ratio_tracking(medium: Any, ray: Any, a: Any, b: Any, sampler: Any, active: Any, visit: Any = None) -> Any:
    """T = Π (1 - σ_t/σ̄) over tentative collisions between a and b, with Mitsuba's majorant of the whole medium.

    ``visit`` is called at every one, with its MediumInteraction3f, the majorant (Float) and where there is one (Bool).
    """
    σ_bar = majorant(medium, ray, active)
    active = active & (σ_bar > 0)
    t = mi.Float(a)
    T = mi.Spectrum(1)
    while dr.hint(active, exclude=[visit], label="pathreplay: ratio tracking"):
        t -= dr.log(1 - sampler.next_1d(active)) / σ_bar
        active &= t < b
        mei = interaction(medium, ray, t)
        _, _, σ_t = medium.get_scattering_coefficients(mei, active)
        if dr.hint(visit is not None, mode="scalar"):
            visit(mei, σ_bar, active)
        T = dr.select(active, T * (1 - dr.detach(σ_t) / σ_bar), T)
        active &= dr.any(T != 0)
    return T


def shadow_again(walk: Walk, origin: Any, light: Any, kept: Shadow, attached: bool, active: Any) -> Any:
    """The kept transmittance (Spectrum), differentiable in σ_t and, if ``attached``, in the two ends of the ray.

    The point y keeps its place between the two surfaces (or ends of the ray) next to it.
    """
    walked = active & (kept.medium != None)  # noqa: E711
    ray = origin.spawn_ray_to(light.p)
    y, growth = kept.y, mi.Float(1)
    if attached:
        still = dr.detach(ray)
        near, reach = _boundary(walk, ray, still, kept.y, -1, walked), _boundary(walk, ray, still, kept.y, 1, walked)
        a, b = span(kept.medium, ray, reach, walked)
        a = dr.maximum(a, near)
        y, growth = carried(y, a, b, walked)
    else:
        ray = dr.detach(ray)
    with dr.suspend_grad(when=walk.listing):
        _, _, σ_t = kept.medium.get_scattering_coefficients(interaction(kept.medium, ray, y), walked)
    if not dr.grad_enabled(σ_t, growth):
        return kept.T
    log_T = dr.select(walked, -kept.length * growth * σ_t, 0)
    return kept.T * dr.replace_grad(mi.Spectrum(1), log_T)


def _boundary(walk: Walk, ray: Any, still: Any, y: Any, sign: int, active: Any) -> Any:
    """Distance along ``ray`` of the first surface that is met from y on towards its end (sign 1) or origin (sign -1).

    Where none is met it is the end of the ray, or its origin (0). Differentiable in the ray and in the surface.
    """
    probe = mi.Ray3f(still.o + y * still.d, sign * still.d, still.time, still.wavelengths)
    probe.maxt = still.maxt - y if sign > 0 else y
    hit = walk.scene.ray_intersect_preliminary(probe, coherent=False, reorder=False, active=active)
    met = active & hit.is_valid()
    # The same surface, as the attached ray itself meets it.
    hit.t = y + sign * hit.t
    si = hit.compute_surface_interaction(ray, mi.RayFlags.All, met)
    return dr.select(met, dr.replace_grad(hit.t, si.t), ray.maxt if sign > 0 else 0)
