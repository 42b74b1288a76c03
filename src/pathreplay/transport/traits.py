"""Facts about a scene, found on the host before a kernel is traced: its lobes, and lights that change shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

# Sampling is a smooth function of the random numbers, and no choice among lobes depends on a parameter.
ATTACHABLE = frozenset({"SmoothDiffuse", "RoughConductor", "RoughDielectric"})
FRAMES = frozenset({"NormalMap", "BumpMap", "TwoSidedBRDF"})


@dataclass(frozen=True)
class Traits:
    """What the drivers want to know about a scene.

    ``lobes`` is one more than the largest component index at which a BSDF has a delta lobe, 0 if none has.
    ``attachable`` tells, by BSDF registry index (Bool), where smooth lobes may be sampled attached; None if nowhere.
    ``detached_names`` are the classes of the BSDFs with smooth lobes where they may not. ``lights_deform`` says that
    an emitting mesh has vertex positions with gradients; ``area_lights`` that there are emitters with an edge.
    """

    lobes: int
    attachable: Any
    detached_names: tuple[str, ...]
    lights_deform: bool
    area_lights: bool


def scene_traits(scene: Any) -> Traits:
    """Look at all BSDFs and meshes of a scene, those nested in other BSDFs and in instanced shapes included."""
    nodes = _nodes(scene)
    bsdfs = [node for node in nodes if isinstance(node, mi.BSDF)]
    attachable = [bsdf for bsdf in bsdfs if _is_attachable(bsdf)]
    others = {b.class_name() for b in bsdfs if b not in attachable and mi.has_flag(b.flags(), mi.BSDFFlags.Smooth)}
    return Traits(
        lobes=max((_delta_lobes(bsdf) for bsdf in bsdfs), default=0),
        attachable=_mask_by_index(attachable) if attachable else None,
        detached_names=tuple(sorted(others)),
        lights_deform=any(_deforms(node) for node in nodes if isinstance(node, mi.Mesh) and node.is_emitter()),
        area_lights=any(mi.has_flag(light.flags(), mi.EmitterFlags.Surface) for light in scene.emitters()),
    )


def _nodes(root: Any) -> set[Any]:
    seen: set[Any] = set()

    class Collector(mi.TraversalCallback):  # type: ignore[misc, name-defined]
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object) and value not in seen:
                seen.add(value)
                value.traverse(Collector())  # one callback per node: Mitsuba forbids re-entry

    root.traverse(Collector())
    return seen


def _delta_lobes(bsdf: Any) -> int:
    delta = [k for k in range(bsdf.component_count()) if mi.has_flag(bsdf.flags(k), mi.BSDFFlags.Delta)]
    return max(delta) + 1 if delta else 0


def _is_attachable(bsdf: Any) -> bool:
    name = bsdf.class_name()
    if name in FRAMES:
        return all(_is_attachable(nested) for nested in _nodes(bsdf) if isinstance(nested, mi.BSDF))
    return name in ATTACHABLE


def _mask_by_index(bsdfs: list[Any]) -> Any:
    index = [dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0] for bsdf in bsdfs]
    mask = [False] * (max(index) + 1)
    for i in index:
        mask[i] = True
    return mi.Bool(mask)


def _deforms(mesh: Any) -> bool:
    params = mi.traverse(mesh)
    with dr.resume_grad():
        return "vertex_positions" in params and bool(dr.grad_enabled(params["vertex_positions"]))
