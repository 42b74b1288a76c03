"""Emitted radiance at a vertex: emission at the hit point, and emitter samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.transport.facts.traits import is_painted
from pathreplay.transport.meet import meet
from pathreplay.transport.surface import solid_angle, surface_point
from pathreplay.transport.vertex import Arrival, Lighting, TraceConfig, mis_weight, reciprocal
from pathreplay.transport.volume.passage import skip_null

SHORT = 1e-3
"""Fraction of the distance to an emitter sample at which a ray starts before the sample: see `_hit_of_sample`."""


def emission(scene: mi.Scene, at: Arrival, si: mi.SurfaceInteraction3f, attached: bool, active: mi.Bool) -> mi.Spectrum:
    """Return the MIS-weighted radiance that the hit surface, or on a miss the environment, emits to the ray's origin.

    Differentiable in the emitter's radiance and, if ``attached``, in the ray, the hit point and the density ``at.pdf``.
    The MIS weights of a detached path need no derivative: they sum to one for all values of the parameters.
    """
    with dr.suspend_grad(when=not attached):
        origin = dr.zeros(mi.Interaction3f)
        origin.p, origin.time, origin.wavelengths = at.ray.o, at.ray.time, at.ray.wavelengths
        if at.behind is not None:
            origin.p -= at.behind * at.ray.d
        ds = mi.DirectionSample3f(scene, si=si, ref=origin)
        pdf_light = scene.pdf_emitter_direction(origin, ds, active & ~at.delta)
        # The density of a texture that is black everywhere is not a number. Emitter samples never find its emission.
        mis = mis_weight(at.pdf, dr.select(dr.isfinite(pdf_light), pdf_light, 0))
    return mis * ds.emitter.eval(si, active)


def vertex_glow(
    trace: TraceConfig, at: Arrival, si: mi.SurfaceInteraction3f, attached: bool, active: mi.Bool
) -> mi.Spectrum:
    """Return the `emission` at a vertex.

    The result is zero on light paths. It is also zero if the caller adds the background and there are no area lights.
    """
    if trace.to_sensor is not None or (trace.background_apart and not trace.traits.area_lights):
        return mi.Spectrum(0)
    return emission(trace.scene, at, si, attached, active)


def relight(trace: TraceConfig, at: Arrival, lighting: Lighting) -> mi.Spectrum:
    """Evaluate emission plus next-event estimate of a vertex again (Spectrum), differentiable in emitted radiance."""
    own = vertex_glow(trace, at, lighting.si, False, lighting.seen)
    return own + lighting.w * trace.scene.eval_emitter_direction(lighting.si, lighting.light, lighting.lit)


def draw_emitter(
    scene: mi.Scene, origin: mi.Interaction3f, u: mi.Point2f, active: mi.Bool, visible: bool = True
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """Sample a direction towards an emitter, and return it with Le/p.

    If ``visible``, occlusion is tested and an occluded sample has density and weight zero; otherwise no ray is traced.
    Nothing is differentiated.
    """
    with dr.suspend_grad():
        return scene.sample_emitter_direction(origin, u, visible, active)


def redraw_emitter(
    trace: TraceConfig,
    origin: mi.Interaction3f,
    u: mi.Point2f,
    light: mi.DirectionSample3f | None,
    attached: bool,
    lit: mi.Bool,
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """Evaluate the emitter sample of the sampling pass again, differentiably; return the sample with Le/p.

    ``light`` is the original sample, or None if it is not available. If ``attached``, the sampled point has fixed
    coordinates on the emitter and moves with the emitter; direction, distance and density are differentiated as well.
    Otherwise the point is fixed in space, and only the emitted radiance is differentiated; in scenes with a
    `directionalarea`, the motion of emitters is then differentiated as well. Visibility is never differentiated.
    """
    scene = trace.scene
    if attached or trace.traits.directed_areas:  # Mitsuba does not implement `eval_direction` of such emitters
        painted = mi.Bool(False)
        if trace.traits.painted_meshes and not trace.traits.directed_areas:
            still, _ = draw_emitter(scene, dr.detach(origin), u, lit, visible=False)
            painted = lit & is_painted(still.emitter) & still.emitter.get_shape().is_mesh()
        light, Le = scene.sample_emitter_direction(origin, u, False, lit & ~painted)
        if trace.traits.lights_deform:
            Le *= _mesh_growth(trace, origin, light, lit & ~painted)
        if trace.traits.painted_meshes and not trace.traits.directed_areas:
            at_fixed_point, glow = _at_fixed_point(trace, origin, still, painted)
            light, Le = dr.select(painted, at_fixed_point, light), dr.select(painted, glow, Le)
        return light, Le
    if light is None:
        light, _ = draw_emitter(scene, origin, u, lit, visible=False)
    return light, scene.eval_emitter_direction(origin, light, lit) * dr.detach(reciprocal(light.pdf))


def _at_fixed_point(
    trace: TraceConfig, origin: mi.Interaction3f, still: mi.DirectionSample3f, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """Attach a sample on a textured emissive mesh to fixed barycentric coordinates; return the sample with Le/p.

    ``still`` is the detached sample. Mitsuba samples such a mesh by intersecting it in texture space. Mitsuba's own
    attached sample would not keep its barycentric coordinates when the mesh moves.
    """
    hit, ray = _hit_of_sample(trace, origin, still, active)
    y = surface_point(hit, ray, active)
    on_emitter = active & hit.is_valid() & (hit.shape.emitter() == still.emitter)
    ok, dist2, log_J = solid_angle(y, origin.p, on_emitter)
    J = dr.replace_grad(mi.Float(1), log_J)
    light = dr.copy(still)
    light.p = dr.select(ok, dr.replace_grad(still.p, y.p), still.p)
    light.d = dr.select(ok, dr.replace_grad(still.d, (y.p - origin.p) * dr.rsqrt(dist2)), still.d)
    light.dist = dr.select(ok, dr.replace_grad(still.dist, dr.sqrt(dist2)), still.dist)
    light.pdf = dr.select(ok, dr.replace_grad(still.pdf, -still.pdf * log_J), still.pdf)
    Le = trace.scene.eval_emitter_direction(dr.detach(origin), still, active) * reciprocal(still.pdf)
    return light, Le * J


def _hit_of_sample(
    trace: TraceConfig, origin: mi.Interaction3f, light: mi.DirectionSample3f, active: mi.Bool
) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
    """Return the hit of the ray from ``origin`` to a visible emitter sample, and the ray. Detached.

    With media, the ray may pass null boundaries and sheets that transmit light. It then starts shortly before the
    sample, behind all of them.
    """
    ray = dr.detach(origin.spawn_ray_to(light.p))
    if trace.media is not None:
        ray.o = dr.lerp(dr.detach(light.p), ray.o, SHORT)
    ray.maxt = dr.largest(mi.Float)
    hit = meet(trace, ray, active)
    return (hit if trace.media is None else skip_null(trace, ray, hit, active)), ray


def _mesh_growth(trace: TraceConfig, origin: mi.Interaction3f, light: mi.DirectionSample3f, lit: mi.Bool) -> mi.Float:
    """Return a factor of value 1, whose derivative is the derivative of the log area of the sampled triangle.

    The factor is needed because Mitsuba samples a mesh with the triangle areas at load time, without derivatives.
    """
    hit, ray = _hit_of_sample(trace, origin, light, lit)
    on_mesh = lit & hit.is_valid() & hit.shape.is_mesh() & (hit.shape.emitter() == light.emitter)
    return area_growth(hit, ray, on_mesh)


def area_growth(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, on_mesh: mi.Bool) -> mi.Float:
    """Return the factor A / A_0, where A is the area of the triangle at a hit, and A_0 is its detached value.

    The factor is 1, but its derivative is the derivative of log A. It is constant off meshes, and on rectangles, which
    Mitsuba counts as meshes, but whose area it differentiates.
    """
    on_mesh = on_mesh & (hit.shape.shape_type() != int(mi.ShapeType.Rectangle))
    area = dr.norm(surface_point(hit, ray, on_mesh).A)
    return dr.select(on_mesh & (area > 0), dr.replace_grad(mi.Float(1), area * dr.detach(reciprocal(area))), 1)
