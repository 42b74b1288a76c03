"""Messages about a pass: paths that lost a part of their gradient, and causes of wrong gradients."""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.integrators.edge_notes import edges_note, keys_that_move_edges
from pathreplay.transport.vertex import TraceConfig

COST_OF_EDGES = (
    "edges move with the parameters (silhouettes, shadows, borders of lights) and are differentiated in a pass of "
    "their own, which may take several times as long as the rest: boundary = 'none' of the integrator leaves them out, "
    "boundary = 'primary' those that only surfaces see; see docs/boundary.md"
)
"""One line that tells what edges cost, where nobody asked for them."""


def lost_note(lost: int, paths: int) -> str:
    """Message about paths that lost a part of their gradient."""
    why = "a ray adjoint was not finite, or media have more boundaries on the way than the record holds"
    return f"{lost / paths:.2%} of the paths lost a part of their gradient: {why}"


def used_before_note(seed: int) -> str:
    """Message about a pass that has contributed to the control variate before."""
    return (
        f"seed {seed} was used before: a pass cannot serve as baseline for itself, so that this one goes without; "
        "give every pass a seed of its own"
    )


def doubts(trace: TraceConfig) -> Iterator[str]:
    """Messages about what makes the gradient of this scene wrong or incomplete, whatever moves.

    Raises PathreplayError if the gradient would be useless.
    """
    traits = trace.traits
    if traits.instances_move and trace.attach != "none":
        raise PathreplayError(
            "pathreplay: an instance's to_world has a gradient, but Mitsuba does not differentiate the normals "
            "of instances: move the vertex_positions of the shapes in its group, or use a shape of its own"
        )
    if traits.masks_mirrors:
        yield (
            "a mask lies over delta lobes, which Mitsuba cannot sample one by one there: derivatives by what "
            "decides among them (an index, or a reflectance of plastic) are wrong"
        )
    if trace.media is not None and trace.media.passes and traits.opacity_moves:
        yield (
            "the opacity of a mask has gradients in a scene with media: what it does to the light of emitters "
            "that shadow rays see through it is missing from the gradient"
        )
    if trace.attach != "all":
        return
    if not traits.attachables:
        raise PathreplayError(
            "pathreplay: attach = 'all', but no BSDF of the scene can be sampled attached (diffuse, "
            "roughconductor, roughdielectric, normal and bump maps over them can): use attach = 'delta'"
        )
    if traits.detached_names:
        yield f"attach = 'all' keeps the directions of {', '.join(traits.detached_names)} fixed"


def missing_edges(trace: TraceConfig, sensor: mi.Sensor, edges: str) -> tuple[str, bool]:
    """One line that tells of the motion of edges where something moves (empty: none), and whether it names what.

    ``edges`` are looked at.
    """
    moving = keys_that_move_edges(mi.traverse(trace.scene)) or keys_that_move_edges(mi.traverse(sensor))
    if moving:
        return edges_note(moving, edges), True
    if edges == "none" and trace.traits.lobes and trace.traits.area_lights:
        return (
            "something moves in a scene with delta lobes and area lights: where the edge of a light or a "
            "silhouette is seen through glass or mirrors, its motion is missing from the gradient"
        ), False
    return "", False
