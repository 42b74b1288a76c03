"""Messages about wrong or incomplete gradients of a pass, and about their causes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import mitsuba as mi

from pathreplay.boundary.observer import omitted_distance
from pathreplay.errors import PathreplayError
from pathreplay.integrators.edge_notes import edges_note, keys_that_move_edges
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.platform import compat
from pathreplay.transport.facts.traits import is_specular
from pathreplay.transport.sensor import METER
from pathreplay.transport.vertex import TraceConfig

COST_OF_EDGES = (
    "edges move with the parameters (silhouettes, shadows, borders of lights) and are differentiated in a separate "
    "pass, which may take several times as long as the rest: boundary = 'none' of the integrator leaves them out, and "
    "boundary = 'primary' leaves out the edges that the camera does not see; see docs/boundary.md"
)
"""Message about the cost of boundary terms that were enabled by default."""
USED_BEFORE = (
    "a seed was used before: a pass must not use a control variate that was learned from the same seed, so passes with "
    "a repeated seed use none; give every pass its own seed"
)
"""Message about a pass that has already contributed to the control variate."""
MOST_OMITTED = 0.02
"""Largest `omitted_distance` that needs no message, as a fraction of the size of the scene."""


def offset_note(box: mi.ScalarBoundingBox3f) -> str:
    """Format the message about edges that are too close to surface points; "" if they hardly matter in this scene.

    ``box`` is the bounding box of the scene. See `omitted_distance`.
    """
    if not box.valid():
        return ""
    size = max(float(x) for x in box.extents())
    distance = omitted_distance(max(abs(float(x)) for corner in (box.min, box.max) for x in corner))
    if distance <= MOST_OMITTED * size:
        return ""
    return (
        f"edges that a surface point sees at a distance below {distance:.2g} are left out, in a scene of size "
        f"{size:.2g}: Mitsuba's rays start at an offset that grows with the coordinates; move the scene to the origin, "
        "or enlarge it"
    )


def lost_note(lost: int, paths: int) -> str:
    """Format the message about paths with an incomplete gradient."""
    why = "a ray adjoint was not finite, or a ray crosses more boundaries of media than the record holds"
    return f"{lost / paths:.2%} of the paths lost a part of their gradient: {why}"


def doubts(trace: TraceConfig) -> Iterator[str]:
    """Yield messages about properties of the scene that make the gradient wrong or incomplete.

    Raises PathreplayError if the gradient would be useless.
    """
    traits = trace.traits
    if traits.instances_move and trace.attach != "none":
        raise PathreplayError(
            "pathreplay: an instance's to_world has a gradient, but Mitsuba does not differentiate the normals "
            f"of instances: move the {compat.positions_name()} of the shapes in its group, or use a shape of its own"
        )
    if traits.blended_mirrors:
        yield (
            "a blendbsdf contains a lobe of delta reflection or transmission (a mirror, glass, plastic), whose samples "
            "Mitsuba weighs wrongly: image and gradient are biased; use a rough lobe instead"
        )
    if traits.masks_mirrors:
        yield (
            "a mask covers delta lobes, which Mitsuba then cannot sample one by one: derivatives with respect to "
            "parameters that change their probabilities (an index of refraction, a reflectance of plastic) are wrong"
        )
    if trace.media is not None and trace.media.passes and traits.opacity_moves:
        yield (
            "the opacity of a mask, or the weight of a blend that transmits light, has gradients in a scene with "
            "media: its effect on emitter samples whose shadow rays cross the surface is missing from the gradient"
        )
    if traits.tables_move:
        yield (
            "the gradient of a roughplastic's alpha or eta is incomplete, and that of eta may have the wrong sign, "
            "because Mitsuba does not differentiate the tables that it computes from them; see docs/gradients.md"
        )
    for value in facts_of(trace.scene).absent_lobes():
        yield (
            f"{value} leaves out a lobe, whose derivative is missing from the gradient: keep "
            "the value 0.001 inside of its range, as 'Problem' and jobs do; see docs/gradients.md"
        )
    for bsdf in facts_of(trace.scene).lobe_choice():
        yield (
            f"{bsdf} ignores BSDFContext.component: derivatives with respect to parameters that change the choice "
            "among its lobes (an index of refraction, an opacity) are wrong, unless its weights are "
            "f / detach(probability): let its 'sample' obey the component; see docs/bsdfs.md"
        )
    if traits.splines_move and trace.attach != "none":
        yield (
            "control points of a bsplinecurve have gradients: where curves bend, the derivative of their shading is "
            "wrong, because Mitsuba's derivative of their normals is wrong; see docs/boundary.md"
        )
    if traits.skies_move and trace.attach != "none":
        yield (
            "gradients of a sunsky are wrong: its samples of the sky move with the sun, and the motion of the edge of "
            "the sun's disc is missing; use attach = 'none' for sun_direction of a sky without sun (sun_scale = 0), or "
            "an envmap; see docs/gradients.md"
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


def sun_note(trace: TraceConfig) -> str:
    """Format the message about the sun of a `sunsky` in a scene with mirrors or glass; "" without such a sun."""
    if not trace.traits.reflects_sun:
        return ""
    return (
        "something moves in a scene with delta lobes and a sunsky: the motion of the edge of the sun's disc, as seen "
        "through glass or mirrors, is missing from the gradient; use a directional emitter and sun_scale = 0"
    )


def camera_doubts(trace: TraceConfig) -> Iterator[str]:
    """Yield messages about light that camera paths do not find."""
    if trace.traits.directed_areas:
        yield (
            "camera paths do not find the light of a directionalarea emitter, which image and gradient lack: use "
            "'pathreplay_particles'"
        )


def sample_doubts(trace: TraceConfig, light_paths: bool) -> Iterator[str]:
    """Yield messages about what is missing where Mitsuba's `moment` differentiates single camera paths.

    Mitsuba's `aov` takes the gradient of its inner integrator instead. With ``light_paths``, the integrator also traces
    paths from the emitters.
    """
    if light_paths:
        yield (
            "an integrator around this one (Mitsuba's 'moment') requests camera paths only: image and gradient lack "
            "the light paths; use caustics = 'camera' of the integrator 'pathreplay'"
        )
    moving = keys_that_move_edges(mi.traverse(trace.scene))
    if moving:
        yield (
            f"'{moving[0]}' moves, and the gradient of an integrator around 'pathreplay' (Mitsuba's 'moment') leaves "
            "out moving edges (silhouettes, shadows, borders of lights): differentiate an image of 'pathreplay' itself"
        )


def particle_doubts(trace: TraceConfig) -> Iterator[str]:
    """Yield messages about properties of the scene that make the gradient of light paths incomplete."""
    for texels in facts_of(trace.scene).dark_texels():
        yield (
            f"{texels} has black texels, at which no light path starts: their derivative is missing from the gradient "
            "of light paths; start from a small value, and keep the texels above it, or trace all paths from the "
            "sensor; see docs/particles.md"
        )


def meter_note(trace: TraceConfig, sensor: mi.Sensor) -> str:
    """Format the message about light from mirrors and smooth glass that light paths do not bring to a meter.

    Returns "" for other sensors, and for scenes without mirrors and smooth glass.
    """
    if sensor.class_name() != METER or not any(map(is_specular, trace.traits.mirrors)):
        return ""
    return (
        f"light that irradiance meter '{sensor.id()}' receives directly from a mirror or smooth glass is missing from "
        "the image and its gradient: use 'pathreplay', or, if the emitters have no extent, a camera that sees the "
        "receiver; see docs/particles.md"
    )


def particle_notes(trace: TraceConfig, sensor: mi.Sensor, omitted: Iterable[str]) -> Iterator[str]:
    """Yield messages about the derivatives that the gradient of light paths leaves out.

    ``omitted`` lists the edges that are left out.
    """
    if sensor.film().rfilter().is_box_filter() and sensor.class_name() != METER:
        yield (
            f"the film of sensor '{sensor.id()}' has a box filter, whose derivative is zero: the motion of light paths "
            "across pixels is missing from the gradient; use a 'tent' or 'gaussian' filter"
        )
    moving = keys_that_move_edges(mi.traverse(trace.scene)) or keys_that_move_edges(mi.traverse(sensor))
    left_out = " and ".join(omitted)
    if moving and left_out:
        yield (
            f"'{moving[0]}' moves, and the gradient of light paths leaves out {left_out}: measure the error with "
            "'pathreplay check'; see docs/particles.md"
        )


def missing_edges(trace: TraceConfig, sensor: mi.Sensor, edges: str) -> tuple[str, bool]:
    """Format the message about moving edges whose boundary term is left out ("" if there is none to report).

    ``edges`` is the value of the property ``boundary``. Also returns whether the message names a parameter that moves
    edges.
    """
    moving = keys_that_move_edges(mi.traverse(trace.scene)) or keys_that_move_edges(mi.traverse(sensor))
    if moving:
        return edges_note(moving, edges), True
    if edges == "none" and trace.traits.mirrors and trace.traits.area_lights:
        return (
            "something moves in a scene with delta lobes and area lights: the motion of edges (silhouettes, borders of "
            "lights) that are seen through glass or mirrors is missing from the gradient"
        ), False
    return "", False
