"""Facts about a scene that are found on the host, before a kernel is traced: which lobes its BSDFs have."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


def scene_bsdfs(scene: Any) -> list[Any]:
    """All BSDFs that the scene's shapes use, those nested in other BSDFs and in instanced shapes included."""
    seen: set[Any] = set()

    class Collector(mi.TraversalCallback):  # type: ignore[misc, name-defined]
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object) and value not in seen:
                seen.add(value)
                value.traverse(Collector())  # one callback per node: Mitsuba forbids re-entry

    scene.traverse(Collector())
    return [node for node in seen if isinstance(node, mi.BSDF)]


def delta_lobes(bsdfs: list[Any]) -> int:
    """One more than the largest component index at which one of the BSDFs has a delta lobe; 0 if none has."""
    count = 0
    for bsdf in bsdfs:
        for k in range(bsdf.component_count()):
            if mi.has_flag(bsdf.flags(k), mi.BSDFFlags.Delta):
                count = max(count, k + 1)
    return count


def attachable_bsdfs(bsdfs: list[Any]) -> Any:
    """Which smooth lobes may be sampled attached: Bool by BSDF registry index.

    Right where sampling is a smooth function of the random numbers and the choice among lobes does not depend on a
    parameter: `diffuse`, `roughconductor`, `roughdielectric`, and normal or bump maps over them.
    """
    allowed = [bsdf for bsdf in bsdfs if _is_attachable(bsdf)]
    index = dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(allowed))
    return index
