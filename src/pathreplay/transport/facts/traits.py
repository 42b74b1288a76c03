"""Facts about a scene, found on the host before a kernel is traced: its lobes, and lights that change shape."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.transport.facts.nodes import nodes_of
from pathreplay.transport.facts.seams import CHECKERBOARD
from pathreplay.transport.facts.smoothing_groups import mesh_smoothing_groups
from pathreplay.transport.velocity import blend_length

# Classes by name: Mitsuba's objects do not tell these things of themselves.
# Sampling is a smooth function of the random numbers, and no choice among lobes depends on a parameter.
ATTACHABLE = frozenset({"SmoothDiffuse", "RoughConductor", "RoughDielectric"})
MASK, TWO_SIDED = "MaskBSDF", "TwoSidedBRDF"
RELIEFS = frozenset({"NormalMap", "BumpMap"})
FRAMES = RELIEFS | {TWO_SIDED}
# Those without a narrow lobe of their own.
DULL = FRAMES | {MASK, "SmoothDiffuse"}
INSTANCE, PROJECTOR, SPOT = "Instance", "Projector", "SpotLight"
WHOLE, FACETS = 0, 0xFFFFFFFF
"""Shapes without edges but their outlines, and meshes that are shaded flat, in the table of smoothing groups."""
COARSE = 1.0
"""Degrees between triangles and shading normals from which on it matters that they are not the same."""

MOST_RUNS = 4096
"""Of equal values, that a recording writes one by one."""

T = TypeVar("T")
V = TypeVar("V")


@dataclass
class Tables:
    """Facts about BSDFs and shapes by registry index, in arrays for kernels to look them up.

    A frozen function is handed them, or finds them with the integrator; else it has to write them: see `_array`.
    """

    attachable: mi.Bool | None  # the smooth lobes of this BSDF may be sampled attached (None: nowhere)
    blend_lengths: mi.Float  # those of `velocity`, by shape
    groups_at: mi.UInt32  # by shape: offset of its triangles, or `WHOLE` or `FACETS`
    groups: mi.UInt32  # of all such meshes (see `smoothing_groups`), in a row; the first is no triangle's
    lamp_balls: mi.Float  # of emitters that are meshes: see `lamp_balls`


@dataclass(frozen=True)
class Traits:
    """What the drivers want to know about a scene."""

    mirrors: tuple[mi.BSDF, ...]  # those with delta lobes
    lobes: int  # one more than the largest component index of a delta lobe, 0 if there is none
    attachables: tuple[mi.BSDF, ...]  # those whose smooth lobes may be sampled attached
    detached_names: tuple[str, ...]  # classes of the others with smooth lobes
    area_lights: bool  # there are emitters with an edge
    hard_lights: bool  # there are emitters whose shadows are hard
    projectors: tuple[mi.Emitter, ...]  # of these also the border of what they light is hard
    spots: tuple[mi.Emitter, ...]  # and of these where beam_width is at least cutoff_angle
    mesh_lights: bool  # there are meshes that emit
    ball_lights: bool  # there are spheres that emit
    coarse_meshes: bool  # there are meshes that are shaded as if they were smooth, and are not: see `is_coarse`
    brushed_meshes: bool  # of these, some with BSDFs that tell one tangent from another
    painted_meshes: bool  # there are meshes that emit, with a texture
    two_sides: bool  # a surface may have another BSDF on its back
    copies: bool  # there are instances
    splines: bool  # there are B-spline curves
    veils: bool  # a surface may scatter some light and let some straight through
    masks_mirrors: bool  # a mask lies over delta lobes
    narrow: bool  # a surface may have a narrow smooth lobe
    glossy: bool  # a surface may have a narrow smooth lobe, and no texture has a seam that it would slide over
    outlines: bool  # a point of a surface may see where a shape, a lamp or a texture ends
    tables: Tables = None  # type: ignore[assignment]  # of single BSDFs and shapes; of now, as all that follows
    # What has gradients:
    lights_deform: bool = False  # vertex positions of a mesh that emits
    instances_move: bool = False  # the to_world of an instance
    opacity_moves: bool = False  # the opacity of a mask
    lights_vary: bool = False  # something about an emitter, or about a shape that emits
    moving: tuple[mi.Shape, ...] | None = None  # the shapes that may move, or None: all, and the camera, too


def fixed_traits(nodes: set[mi.Object], scene: mi.Scene) -> Traits:
    """Look at all BSDFs and shapes of a scene, those nested in other BSDFs and in instanced shapes included.

    Tables and what depends on gradients are left out: see `SceneFacts`. With media, null boundaries are not mirrors:
    the step sends light straight through them.
    """
    media = any(isinstance(node, mi.Medium) for node in nodes)
    bsdfs = [node for node in nodes if isinstance(node, mi.BSDF) and not (media and is_null(node))]
    shapes = [node for node in nodes if isinstance(node, mi.Shape)]
    attachables = _attachables(nodes, shapes)
    others = [bsdf for bsdf in bsdfs if not _is_attachable(bsdf) and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)]
    coarse = [shape for shape in shapes if shape.is_mesh() and is_coarse(shape)]
    return Traits(
        mirrors=tuple(bsdf for bsdf in bsdfs if _delta_lobes(bsdf)),
        lobes=max((_delta_lobes(bsdf) for bsdf in bsdfs), default=0),
        attachables=tuple(attachables),
        detached_names=tuple(sorted({bsdf.class_name() for bsdf in others})),
        area_lights=any(mi.has_flag(light.flags(), mi.EmitterFlags.Surface) for light in scene.emitters()),
        hard_lights=any(mi.has_flag(light.flags(), mi.EmitterFlags.Delta) for light in scene.emitters()),
        projectors=tuple(light for light in scene.emitters() if light.class_name() == PROJECTOR),
        spots=tuple(light for light in scene.emitters() if light.class_name() == SPOT),
        mesh_lights=any(_ball(lamp)[3] > 0 for lamp in _mesh_lamps(shapes)),
        ball_lights=any(shape.is_emitter() and shape.shape_type() == mi.ShapeType.Sphere for shape in shapes),
        coarse_meshes=bool(coarse),
        brushed_meshes=any(is_brushed(shape.bsdf()) for shape in coarse),
        painted_meshes=any(is_painted(lamp.emitter()) for lamp in _mesh_lamps(shapes)),
        two_sides=any(bsdf.class_name() == TWO_SIDED for bsdf in bsdfs),
        copies=any(shape.class_name() == INSTANCE for shape in shapes),
        splines=any(shape.shape_type() == mi.ShapeType.BSplineCurve for shape in shapes),
        veils=any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) and not is_null(bsdf) for bsdf in bsdfs),
        masks_mirrors=any(_delta_lobes(_nested(bsdf)) for bsdf in bsdfs if bsdf.class_name() == MASK),
        narrow=_is_narrow(bsdfs),
        glossy=_is_narrow(bsdfs) and not any(node.class_name() == CHECKERBOARD for node in nodes),
        outlines=not _seamless(shapes, nodes),
    )


def tables_of(
    attachables: Iterable[mi.BSDF], shapes: list[mi.Shape], emitters: list[mi.Emitter], edges: bool = True
) -> Tables:
    """The tables of a scene, as it is now; without ``edges`` smoothing groups, which may be long, are left out."""
    attachable = _by_index(mi.BSDFPtr, attachables, lambda bsdf: True, False)
    return Tables(
        _array(mi.Bool, attachable) if attachables else None,
        blend_lengths(shapes),
        *(smoothing_groups_of(shapes) if edges else (mi.UInt32(WHOLE), mi.UInt32(0))),
        lamp_balls(emitters, shapes),
    )


def _array(kind: type, values: Any) -> Any:
    """An array of these values.

    While `dr.freeze` records, arrays from the host are unknown to it. Then the recording writes them, in runs of equal
    values.
    """
    if not dr.flag(dr.JitFlag.FreezingScope):
        return kind(values)
    values = np.asarray(values)
    begins = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1), len(values)]
    if len(begins) > MOST_RUNS:
        raise PathreplayError(
            f"pathreplay: dr.freeze records a pass over a scene that was not rendered before, and would have to write "
            f"{len(begins)} facts about it: call the function once outside of dr.freeze, with the same integrator"
        )
    array = dr.full(kind, values[0].item(), len(values))
    for begin, end in pairwise(begins[1:]):
        dr.scatter(array, kind(values[begin].item()), int(begin) + dr.arange(mi.UInt32, int(end - begin)))
    dr.eval(array)
    return array


def blend_lengths(shapes: list[mi.Shape]) -> mi.Float:
    """The table of each shape's `blend_length`."""
    return _array(mi.Float, _by_index(mi.ShapePtr, shapes, blend_length, 0.0))


def smoothing_groups_of(shapes: list[mi.Shape]) -> tuple[mi.UInt32, mi.UInt32]:
    """The tables of smoothing groups: the offset of each shape, and the group of each triangle."""
    found: list[np.ndarray] = [np.zeros(1, np.uint32)]

    def begin(shape: mi.Shape) -> int:
        if not shape.is_mesh():
            return WHOLE
        if shape.has_face_normals() or not shape.has_vertex_normals():
            return FACETS
        groups = mesh_smoothing_groups(shape)
        if not groups.any():
            return WHOLE
        found.append(groups)
        return sum(map(len, found[:-1]))

    begins = _by_index(mi.ShapePtr, shapes, begin, WHOLE)
    return _array(mi.UInt32, begins), _array(mi.UInt32, np.concatenate(found).astype(np.uint32))


def is_coarse(mesh: mi.Mesh) -> bool:
    """Whether triangles of a mesh leave the normals at their corners by `COARSE` degrees, on average.

    Along their sides, where the shading is smooth, lamps are then hidden that the shading would see.
    """
    params = mi.traverse(mesh)
    if mesh.has_face_normals() or not mesh.has_vertex_normals() or "faces" not in params:
        return False
    faces, at, normals = (
        np.array(params[key]).reshape(-1, 3) for key in ("faces", "vertex_positions", "vertex_normals")
    )
    a, b, c = (at[faces[:, i]].astype(np.float64) for i in range(3))
    n = np.cross(b - a, c - a)
    cosines = np.einsum("fk,fik->fi", n, normals[faces]) / np.maximum(np.linalg.norm(n, axis=1), 1e-30)[:, None]
    return bool(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean() > COARSE)


def is_brushed(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF tells one tangent from another: it, or one nested in it."""
    if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Anisotropic):
        return True
    return any(isinstance(node, mi.BSDF) and node.class_name() in RELIEFS for node in {bsdf, *nodes_of(bsdf)})


def lamp_balls(emitters: list[mi.Emitter], shapes: list[mi.Shape]) -> mi.Float:
    """For each emitter, in the order of the scene, a ball around its mesh: centre, and radius, 0 without one."""
    lamps = {lamp.emitter(): lamp for lamp in _mesh_lamps(shapes)}
    balls = [_ball(lamps[emitter]) if emitter in lamps else np.zeros(4) for emitter in emitters]
    return _array(mi.Float, np.ravel(balls or [np.zeros(4)]))  # an empty array would end the process


def _mesh_lamps(shapes: list[mi.Shape]) -> list[mi.Shape]:
    return [shape for shape in shapes if shape.is_emitter() and shape.is_mesh()]


def _ball(mesh: mi.Mesh) -> np.ndarray:
    """Around the middle of its box. Mitsuba's rectangle hides its mesh: none."""
    params = mi.traverse(mesh)
    if "vertex_positions" not in params:
        return np.zeros(4)
    positions = np.array(params["vertex_positions"], np.float64).reshape(-1, 3)
    centre = (positions.min(axis=0) + positions.max(axis=0)) / 2
    return np.array([*centre, np.linalg.norm(positions - centre, axis=1).max()])


def _by_index(pointer: type, objects: Iterable[T], value: Callable[[T], V], otherwise: V) -> list[V]:
    """The values of objects by their index in Dr.Jit's registry."""
    found = {dr.reinterpret_array(mi.UInt32, pointer(x))[0]: value(x) for x in objects}
    return [found.get(i, otherwise) for i in range(max(found, default=0) + 1)]


def is_null(bsdf: mi.BSDF | mi.BSDFPtr) -> bool | mi.Bool:
    """Whether (or where) a BSDF does nothing but let light straight through."""
    others = mi.BSDFFlags.Smooth | mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
    return bsdf.flags() & (others | mi.BSDFFlags.Null) == +mi.BSDFFlags.Null


def _attachables(nodes: set[mi.Object], shapes: list[mi.Shape]) -> list[mi.BSDF]:
    # A lamp for which the scene names no BSDF has a diffuse one all the same: nobody asked to have that attached.
    of_lamps = {shape.bsdf() for shape in shapes if shape.is_emitter()}
    seen = {shape.bsdf() for shape in shapes if not shape.is_emitter()}
    bsdfs = {node for node in nodes if isinstance(node, mi.BSDF)} - (of_lamps - seen)
    return [bsdf for bsdf in bsdfs if _is_attachable(bsdf)]


def is_painted(emitter: mi.Emitter | mi.EmitterPtr) -> bool | mi.Bool:
    """Whether (or where) an emitter glows with a texture."""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def _is_narrow(bsdfs: list[mi.BSDF]) -> bool:
    """Whether a surface may have a narrow smooth lobe."""
    return any(mi.has_flag(b.flags(), mi.BSDFFlags.Smooth) and b.class_name() not in DULL for b in bsdfs)


def _seamless(shapes: list[mi.Shape], nodes: set[mi.Object]) -> bool:
    """Whether no point of a surface sees an end of anything: there is one shape only, which sees no end of itself.

    A flat shape does not see itself at all. A sphere does from the inside, where a texture would have a seam.
    """
    if len(shapes) != 1 or shapes[0].is_emitter():
        return False
    textured = any(isinstance(node, mi.Texture) and node.is_spatially_varying() for node in nodes)
    kind = shapes[0].shape_type()
    return kind in (mi.ShapeType.Rectangle, mi.ShapeType.Disk) or (kind == mi.ShapeType.Sphere and not textured)


def _nested(bsdf: mi.BSDF) -> mi.BSDF:
    return next(node for node in nodes_of(bsdf) if isinstance(node, mi.BSDF))


def _delta_lobes(bsdf: mi.BSDF) -> int:
    delta = [k for k in range(bsdf.component_count()) if mi.has_flag(bsdf.flags(k), mi.BSDFFlags.Delta)]
    return max(delta) + 1 if delta else 0


def _is_attachable(bsdf: mi.BSDF) -> bool:
    name = bsdf.class_name()
    if name in FRAMES:
        return all(_is_attachable(nested) for nested in nodes_of(bsdf) if isinstance(nested, mi.BSDF))
    return name in ATTACHABLE
