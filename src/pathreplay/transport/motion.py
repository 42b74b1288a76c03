"""Find which parts of a path depend on differentiated parameters. Kernels omit the derivatives of all other parts.

The functions of this file record one step of a path and ask Dr.Jit which results have gradients. Virtual function calls
reach the objects of all scenes in the process. Results may therefore have gradients because of another scene. They
count only if objects of the traced scene have gradients, too.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.platform.traversal import known_values
from pathreplay.transport import scatter
from pathreplay.transport.arrive import Vertex
from pathreplay.transport.facts.nodes import may_have_gradients, nodes_of, with_gradients
from pathreplay.transport.start import Start
from pathreplay.transport.vertex import Arrival, SampledContinuation, TraceConfig, VertexRecord, VertexSamples

FEW = 8
"""Largest number of moving shapes that are tracked individually. If more shapes move, every shape counts as moving."""
SEVERAL = 64
"""Largest number of moving shapes for which `shapes_with_gradients` returns a result."""
COPIES = frozenset({"Instance", "ShapeGroup"})


def moving_shapes(
    scene: mi.Scene, still: Collection[mi.Object]
) -> tuple[tuple[mi.Shape, ...] | None, tuple[mi.Shape, ...]]:
    """Find the shapes that have gradients themselves, and the shapes that have gradients in a child object only.

    The surfaces of the latter do not move. If the child object is a BSDF, the rays that continue from the surface may
    move. The first result is None, which means that everything may move, if gradients exist outside the shapes, in an
    instance or shape group, or in more than `FEW` shapes. Gradients of the objects in ``still`` are ignored, because
    the caller knows that these objects do not move.
    """
    params = mi.traverse(scene)
    with dr.resume_grad():
        attached = {params.properties[key][2] for key, value in known_values(params) if dr.grad_enabled(value)}
    attached.difference_update(still)
    shapes = {shape: nodes_of(shape) | {shape} for shape in scene.shapes()}
    found = [shape for shape, nodes in shapes.items() if not attached.isdisjoint(nodes)]
    rest = attached.difference(*(shapes[shape] for shape in found))
    copies = any(shape.class_name() in COPIES for shape in found)
    if rest or copies or len(found) > FEW:
        return None, ()
    moving = tuple(shape for shape in found if shape in attached)
    return moving, tuple(shape for shape in found if shape not in moving)


def shapes_with_gradients(scene: mi.Scene) -> tuple[mi.Shape, ...] | None:
    """Return the shapes that have gradients themselves; None if there are instances, or more than `SEVERAL` shapes."""
    shapes = scene.shapes()
    if any(shape.class_name() in COPIES for shape in shapes):
        return None
    found = tuple(shape for shape in shapes if with_gradients(shape, "to_world", "control_points", *compat.POSITIONS))
    return found if len(found) <= SEVERAL else None


def may_move(trace: TraceConfig, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
    """Return the lanes in which a parameter may move the surface that was hit.

    If `moving_shapes` returned None, the result is True in all lanes, including misses.
    """
    moving = trace.traits.moving
    return mi.Bool(True) if moving is None else is_one_of(moving, hit)


def may_turn(trace: TraceConfig, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
    """Return the lanes in which the surface that was hit does not move, but rays that continue from it may move."""
    return is_one_of(trace.traits.turning, hit)


def is_one_of(shapes: tuple[mi.Shape, ...], hit: mi.PreliminaryIntersection3f) -> mi.Bool:
    """Return the lanes in which one of the shapes was hit."""
    found = mi.Bool(False)
    for shape in shapes:
        found |= hit.shape == mi.ShapePtr(shape)
    return found & hit.is_valid()


def path_moves(trace: TraceConfig, start: Start, at: Arrival) -> bool:
    """Return whether hit points, sampled directions or emitter samples depend on parameters with gradients.

    ``at`` is the first arrival. Motion can enter at four places, which are checked: the start of the path, the shapes,
    the BSDFs whose sampled directions are differentiated, and the emitters. Nothing is evaluated.
    """
    return _depends(trace, start, at, painted=True)


def along_moving_paths(trace: TraceConfig, moves: bool) -> TraceConfig:
    """Return the configuration with `TraceConfig.balances_lobes` set, if paths move and some BSDF has such lobes.

    ``moves`` is the result of `path_moves`.
    """
    mirrors = (bsdf for bsdf in trace.traits.mirrors if mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection))
    return replace(trace, balances_lobes=moves and any(bsdf.component_count() > 1 for bsdf in mirrors))


def edges_move(trace: TraceConfig, start: Start, at: Arrival) -> bool:
    """Return whether visibility edges may move.

    Edges may move if occluders, path vertices or emitters depend on parameters with gradients. The test is that of
    `path_moves`, with three differences. Texture coordinates and the tangents computed from them do not count, because
    a texture occludes nothing. Smooth lobes that are sampled attached do not count, because boundary terms need
    ``attach='delta'``, where these lobes occur only in scenes without outlines. The rotation and the cutoff angle of a
    projector or spot light count, because they move the boundary of the lit region.
    """
    lights = [*trace.traits.projectors, *trace.traits.spots]
    turns = trace.attach != "none" and any(with_gradients(light, "to_world", "cutoff_angle") for light in lights)
    return turns or _depends(trace, start, at, painted=False)


def _depends(trace: TraceConfig, start: Start, at: Arrival, painted: bool) -> bool:
    if trace.attach == "none":
        return False
    with dr.resume_grad():
        si = at.hit.compute_surface_interaction(at.ray, compat.shading())
        surface: list[dr.ArrayBase] = [si.p, si.n, si.sh_frame.n]
        if painted:
            surface += [si.uv, si.dp_du, si.dp_dv]
        still, delta, any_lobe = dr.detach(si), mi.BSDFContext(), mi.BSDFContext()
        delta.type_mask = +mi.BSDFFlags.Delta  # a `mask` or `plastic` has smooth lobes, too, which are sampled detached
        sampled = [(bsdf, delta) for bsdf in trace.traits.mirrors]
        if trace.follows and painted:
            sampled += [(bsdf, any_lobe) for bsdf in trace.traits.attachables]
        mirrored = [bsdf.sample(ctx, still, 0.5, mi.Point2f(0.5), mi.Bool(True))[0].wo for bsdf, ctx in sampled]
        light, _ = trace.scene.sample_emitter_direction(still, mi.Point2f(0.5), False)
        return (
            dr.grad_enabled(*start.repeat(), *mirrored)
            or (dr.grad_enabled(*surface) and have_gradients(trace.scene, mi.Shape))
            or (dr.grad_enabled(light.p, light.d, light.pdf) and have_gradients(trace.scene, mi.Shape, mi.Emitter))
        )


def have_gradients(scene: mi.Scene, *kinds: type[mi.Object]) -> bool:
    """Return whether objects of these types in the scene may have gradients (see `may_have_gradients`)."""
    return any(map(may_have_gradients, (node for node in nodes_of(scene) if isinstance(node, kinds))))


def weights_vary(trace: TraceConfig, at: Arrival) -> bool:
    """Return whether the weights of a path depend on parameters with gradients.

    The result is valid only if `path_moves` is False. ``at`` is the first arrival. As later passes do, the function
    records the weight of a lobe symbolically. It then checks whether the weight has gradients. Media count if a
    parameter of a medium has gradients. Nothing is evaluated.
    """
    nodes = nodes_of(trace.scene)
    media, bsdfs = ([node for node in nodes if isinstance(node, kind)] for kind in (mi.Medium, mi.BSDF))
    if any(map(may_have_gradients, set().union(media, *map(nodes_of, media)))):
        return True
    lobe, valid = at.hit.prim_index, at.hit.is_valid()  # arrays whose values Dr.Jit does not know while it traces
    si = at.hit.compute_surface_interaction(at.ray, compat.shading(), valid)
    v = Vertex(si, si.bsdf(at.ray), valid, si, mi.Spectrum(0))
    kept = SampledContinuation(si.to_world(si.wi), mi.Float(1), lobe == 0, mi.Bool(False), lobe, valid)
    u = VertexSamples(mi.Point2f(0.5), mi.Float(0.5), mi.Point2f(0.5), mi.Float(0.5))
    again = VertexRecord(at, u, kept, valid, at.hit, mi.Float(1), mi.Spectrum(1))
    shapes = (node for node in nodes if isinstance(node, mi.Shape))
    surfaces = set(bsdfs).union(shapes, *map(nodes_of, bsdfs))  # with the textures of the BSDFs
    with dr.resume_grad():
        weight = scatter.repeat(trace, v, again, mi.BSDFContext(), False)[0]
        return dr.grad_enabled(weight) and any(map(may_have_gradients, surfaces))
