"""What of a path depends on parameters? Found out when a kernel is traced, so that it holds nothing it need not."""

from __future__ import annotations

from collections.abc import Collection

import drjit as dr
import mitsuba as mi

from pathreplay.platform.traversal import known_values
from pathreplay.transport import scatter
from pathreplay.transport.arrive import Vertex
from pathreplay.transport.facts.nodes import nodes_of, with_gradients
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import Arrival, SampledContinuation, TraceConfig, VertexRecord, VertexSamples

FEW = 8
"""Of more moving shapes than these nobody asks which they are."""
COPIES = frozenset({"Instance", "ShapeGroup"})


def moving_shapes(scene: mi.Scene, still: Collection[mi.Object]) -> tuple[mi.Shape, ...] | None:
    """Those that have gradients, in whatever belongs to them; None where other things have gradients, or too many.

    Things that are known to be ``still`` do not count.
    """
    params = mi.traverse(scene)
    with dr.resume_grad():
        attached = {params.properties[key][2] for key, value in known_values(params) if dr.grad_enabled(value)}
    attached.difference_update(still)
    shapes = {shape: nodes_of(shape) | {shape} for shape in scene.shapes()}
    moving = tuple(shape for shape, nodes in shapes.items() if not attached.isdisjoint(nodes))
    rest = attached.difference(*(shapes[shape] for shape in moving))
    copies = any(shape.class_name() in COPIES for shape in moving)
    return None if rest or copies or len(moving) > FEW else moving


def may_move(trace: TraceConfig, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
    """Whether what was hit may be moved by a parameter; what a ray misses is not."""
    moving = trace.traits.moving
    if moving is None:
        return mi.Bool(True)
    moves = mi.Bool(False)
    for shape in moving:
        moves |= hit.shape == mi.ShapePtr(shape)
    return moves & hit.is_valid()


def path_moves(trace: TraceConfig, start: CameraStart, at: Arrival) -> bool:
    """Whether hit points, sampled directions or emitter samples depend on parameters with gradients.

    ``at`` is the first arrival. Looks at the four places where motion can enter: the start, the shapes, the BSDFs whose
    directions are followed, and the emitters. Nothing is evaluated.
    """
    return _depends(trace, start, at, painted=True)


def edges_move(trace: TraceConfig, start: CameraStart, at: Arrival) -> bool:
    """Whether something that can hide light, or what is seen or lit from, depends on parameters with gradients.

    As `path_moves`, but for texture coordinates and the tangents that follow them: what is painted on a surface hides
    nothing. A projector or a spot that turns moves the border of what it lights, though its light comes from where it
    came.
    """
    lights = [*trace.traits.projectors, *trace.traits.spots]
    turns = trace.attach != "none" and any(with_gradients(light, "to_world", "cutoff_angle") for light in lights)
    return turns or _depends(trace, start, at, painted=False)


def _depends(trace: TraceConfig, start: CameraStart, at: Arrival, painted: bool) -> bool:
    if trace.attach == "none":
        return False
    with dr.resume_grad():
        si = at.hit.compute_surface_interaction(at.ray, mi.RayFlags.All)
        moving = [*start.repeat(), si.p, si.n, si.sh_frame.n]
        if painted:
            moving += [si.uv, si.dp_du, si.dp_dv]
        still = dr.detach(si)
        # Rough lobes are followed where nothing has an outline, and so there are no edges to move.
        for bsdf in trace.traits.mirrors + (trace.traits.attachables if trace.follows and painted else ()):
            sample, _ = bsdf.sample(mi.BSDFContext(), still, 0.5, mi.Point2f(0.5))
            moving.append(sample.wo)
        light, _ = trace.scene.sample_emitter_direction(still, mi.Point2f(0.5), False)
        moving += [light.p, light.d, light.pdf]
        return any(dr.grad_enabled(value) for value in moving)


def weights_vary(trace: TraceConfig, at: Arrival) -> bool:
    """Whether the weights of continuations on surfaces depend on parameters with gradients, where nothing moves.

    ``at`` is the first arrival. The weight of any lobe is looked at, as later passes find it. Nothing is evaluated.
    """
    lobe, valid = at.hit.prim_index, at.hit.is_valid()  # numbers that are not known while a kernel is traced
    si = at.hit.compute_surface_interaction(at.ray, mi.RayFlags.All, valid)
    v = Vertex(si, si.bsdf(at.ray), valid, si, mi.Spectrum(0))
    kept = SampledContinuation(si.to_world(si.wi), mi.Float(1), lobe == 0, mi.Bool(False), lobe, valid)
    u = VertexSamples(mi.Point2f(0.5), mi.Float(0.5), mi.Point2f(0.5), mi.Float(0.5))
    again = VertexRecord(at, u, kept, valid, at.hit, mi.Float(1), mi.Spectrum(1))
    with dr.resume_grad():
        return dr.grad_enabled(scatter.repeat(trace, v, again, mi.BSDFContext(), False)[0])
