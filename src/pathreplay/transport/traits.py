"""Facts about a scene, found on the host before a kernel is traced: its lobes, and lights that change shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .velocity import blend_lengths

# Sampling is a smooth function of the random numbers, and no choice among lobes depends on a parameter.
ATTACHABLE = frozenset({"SmoothDiffuse", "RoughConductor", "RoughDielectric"})
FLAT = frozenset({"Rectangle", "Disk"})
FRAMES = frozenset({"NormalMap", "BumpMap", "TwoSidedBRDF"})


@dataclass
class Tables:
    """Facts about BSDFs and shapes by registry index, in arrays for kernels to look them up.

    A frozen function cannot make such arrays: it has to be handed them.
    """

    attachable: Any  # Bool: the smooth lobes of this BSDF may be sampled attached (None: nowhere)
    blend_lengths: Any  # Float: those of `velocity`, by shape


@dataclass(frozen=True)
class Traits:
    """What the drivers want to know about a scene.

    ``mirrors`` are the BSDFs with delta lobes, and ``lobes`` is one more than the largest component index of such a
    lobe, 0 if there is none. ``attachables`` are the BSDFs whose smooth lobes may be sampled attached;
    ``detached_names`` are the classes of the other BSDFs with smooth lobes. ``lights_deform`` says that an emitting
    mesh has vertex positions with gradients, ``instances_move`` that an instance's ``to_world`` has, ``area_lights``
    that there are emitters with an edge, ``two_sides`` that a surface may have another BSDF on its back,
    ``masks_mirrors`` that a mask lies over delta lobes, ``opacity_moves`` that the opacity of a mask has gradients,
    ``lights_vary`` that something about emitters has, or about the shapes that emit. ``outlines`` says that a point
    of a surface may see where a shape, a lamp or a texture ends. ``tables`` tell of single BSDFs and shapes.
    """

    mirrors: tuple[Any, ...]
    lobes: int
    attachables: tuple[Any, ...]
    detached_names: tuple[str, ...]
    lights_deform: bool
    instances_move: bool
    area_lights: bool
    two_sides: bool
    masks_mirrors: bool
    opacity_moves: bool
    lights_vary: bool
    outlines: bool
    tables: Tables


def scene_traits(nodes: set[Any], scene: Any, media: bool, tables: Tables | None = None) -> Traits:
    """Look at all BSDFs and meshes of a scene, those nested in other BSDFs and in instanced shapes included.

    With media, null boundaries are not mirrors: the step sends light straight through them. ``tables`` are those of
    this scene, if they are at hand.
    """
    bsdfs = [node for node in nodes if isinstance(node, mi.BSDF) and not (media and node.class_name() == "Null")]
    shapes = [node for node in nodes if isinstance(node, mi.Shape)]
    attachables = _attachables(nodes, shapes)
    others = [bsdf for bsdf in bsdfs if not _is_attachable(bsdf) and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)]
    masks = [bsdf for bsdf in bsdfs if bsdf.class_name() == "MaskBSDF"]
    return Traits(
        mirrors=tuple(bsdf for bsdf in bsdfs if _delta_lobes(bsdf)),
        lobes=max((_delta_lobes(bsdf) for bsdf in bsdfs), default=0),
        attachables=tuple(attachables),
        detached_names=tuple(sorted({bsdf.class_name() for bsdf in others})),
        lights_deform=any(with_gradients(s, "vertex_positions") for s in shapes if s.is_mesh() and s.is_emitter()),
        instances_move=any(with_gradients(s, "to_world") for s in shapes if s.class_name() == "Instance"),
        area_lights=any(mi.has_flag(light.flags(), mi.EmitterFlags.Surface) for light in scene.emitters()),
        two_sides=any(bsdf.class_name() == "TwoSidedBRDF" for bsdf in bsdfs),
        masks_mirrors=any(_delta_lobes(_nested(mask)) for mask in masks),
        opacity_moves=any(with_gradients(mask, "opacity") for mask in masks),
        outlines=not _seamless(shapes, nodes),
        lights_vary=any(map(with_gradients, [*scene.emitters(), *(shape for shape in shapes if shape.is_emitter())])),
        tables=_tables(attachables, shapes) if tables is None else tables,
    )


def scene_tables(nodes: set[Any]) -> Tables:
    """The tables of a scene, by its nodes."""
    shapes = [node for node in nodes if isinstance(node, mi.Shape)]
    return _tables(_attachables(nodes, shapes), shapes)


def _tables(attachables: list[Any], shapes: list[Any]) -> Tables:
    return Tables(
        attachable=_mask_by_index(attachables) if attachables else None,
        blend_lengths=blend_lengths(shapes),
    )


def _attachables(nodes: set[Any], shapes: list[Any]) -> list[Any]:
    # A lamp for which the scene names no BSDF has a diffuse one all the same: nobody asked to have that attached.
    of_lamps = {shape.bsdf() for shape in shapes if shape.is_emitter()}
    seen = {shape.bsdf() for shape in shapes if not shape.is_emitter()}
    bsdfs = {node for node in nodes if isinstance(node, mi.BSDF)} - (of_lamps - seen)
    return [bsdf for bsdf in bsdfs if _is_attachable(bsdf)]


def nodes_of(root: Any) -> set[Any]:
    """All objects of a scene, or below one of its objects."""
    seen: set[Any] = set()

    class Collector(mi.TraversalCallback):  # type: ignore[misc, name-defined]
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object) and value not in seen:
                seen.add(value)
                value.traverse(Collector())  # one callback per node: Mitsuba forbids re-entry

    root.traverse(Collector())
    return seen


def _seamless(shapes: list[Any], nodes: set[Any]) -> bool:
    """Whether no point of a surface sees an end of anything: there is one shape only, which sees no end of itself.

    A flat shape does not see itself at all. A sphere does from the inside, where a texture would have a seam.
    """
    if len(shapes) != 1 or shapes[0].is_emitter():
        return False
    textured = any(isinstance(node, mi.Texture) and node.is_spatially_varying() for node in nodes)
    kind = shapes[0].class_name()
    return kind in FLAT or (kind == "Sphere" and not textured)


def _nested(bsdf: Any) -> Any:
    return next(node for node in nodes_of(bsdf) if isinstance(node, mi.BSDF))


def _delta_lobes(bsdf: Any) -> int:
    delta = [k for k in range(bsdf.component_count()) if mi.has_flag(bsdf.flags(k), mi.BSDFFlags.Delta)]
    return max(delta) + 1 if delta else 0


def _is_attachable(bsdf: Any) -> bool:
    name = bsdf.class_name()
    if name in FRAMES:
        return all(_is_attachable(nested) for nested in nodes_of(bsdf) if isinstance(nested, mi.BSDF))
    return name in ATTACHABLE


def _mask_by_index(bsdfs: list[Any]) -> Any:
    index = [dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0] for bsdf in bsdfs]
    mask = [False] * (max(index) + 1)
    for i in index:
        mask[i] = True
    return mi.Bool(mask)


def with_gradients(node: Any, *names: str) -> list[Any]:
    """The parameters of a node, and of those below it, that have gradients; with names, those that are called so.

    What goes on after a name with a dot is called so, too.
    """
    params = mi.traverse(node)
    found = [params[key] for key in params.keys() if not names or any(f"{key}.".startswith(f"{n}.") for n in names)]
    with dr.resume_grad():
        return [value for value in found if dr.grad_enabled(value)]
