"""Facts about the media of a scene, found on the host before a kernel is traced, and what a medium is at one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True)
class Media:
    """What the walk wants to know about the media of a scene.

    ``grids`` are the media that have functions of their own for free flight and transmittance (`gridmedium`). The
    others are known to Mitsuba only: ``plain`` says that there are any, ``homogeneous`` that some have the same
    coefficients everywhere. ``chromatic`` says that some extinction differs between channels, ``emissive`` that some
    medium emits, ``passes`` that some surface may let light straight through by chance. ``around`` is the sensor's.
    """

    grids: tuple[Any, ...]
    plain: bool
    homogeneous: bool
    chromatic: bool
    emissive: bool
    passes: bool
    around: Any


def scene_media(nodes: set[Any], sensor: Any) -> Media | None:
    """Look at all media among the objects of a scene; None if there are none. ``sensor`` (or None) may be in one."""
    media = [node for node in nodes if isinstance(node, mi.Medium)]
    if not media:
        return None
    grids = tuple(medium for medium in media if hasattr(medium, "free_flight"))
    plain = [medium for medium in media if not hasattr(medium, "free_flight")]
    bsdfs = [node for node in nodes if isinstance(node, mi.BSDF)]
    return Media(
        grids=grids,
        plain=bool(plain),
        homogeneous=any(medium.is_homogeneous() for medium in plain),
        chromatic=any(grid.is_chromatic for grid in grids) or any(map(_is_chromatic, plain)),
        emissive=any(grid.emission is not None for grid in grids),
        passes=any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) and bsdf.class_name() != "Null" for bsdf in bsdfs),
        around=None if sensor is None else _medium_around(sensor),
    )


def _is_chromatic(medium: Any) -> bool:
    if dr.size_v(mi.Spectrum) == 1:
        return False
    params = mi.traverse(medium)
    extinction = [params[key] for key in params.keys() if key.startswith("sigma_t.")]
    one_number = [
        value.shape[-1] == 1 if dr.is_tensor_v(value) else not dr.is_vector_v(value)
        for value in extinction
        if dr.is_tensor_v(value) or dr.is_diff_v(value)
    ]
    return not one_number or not all(one_number)


def _medium_around(sensor: Any) -> Any:
    found: list[Any] = []

    class Collector(mi.TraversalCallback):  # type: ignore[misc, name-defined]
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if name == "medium":
                found.append(value)

    sensor.traverse(Collector())
    return found[0] if found else None


def wants_branch(nodes: set[Any]) -> bool:
    """Whether the extinction of some medium has gradients, and varies in space or is zero."""
    for medium in nodes:
        if isinstance(medium, mi.Medium):
            params = mi.traverse(medium)
            extinction = [params[key] for key in params.keys() if key.split(".")[0] in ("sigma_t", "scale")]
            with dr.resume_grad():
                moving = [value for value in extinction if dr.grad_enabled(value)]
            if moving and not (medium.is_homogeneous() and all(dr.all(dr.detach(v) != 0, axis=None) for v in moving)):
                return True
    return False


def opacity_moves(nodes: set[Any]) -> bool:
    """Whether the opacity of some mask has gradients."""
    for bsdf in nodes:
        if isinstance(bsdf, mi.BSDF) and bsdf.class_name() == "MaskBSDF":
            params = mi.traverse(bsdf)
            with dr.resume_grad():
                if any(dr.grad_enabled(params[key]) for key in params.keys() if key.startswith("opacity")):
                    return True
    return False


def interaction(medium: Any, ray: Any, t: Any) -> Any:
    """The MediumInteraction3f at distance ``t`` along ``ray``; it follows both."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.t = t
    mei.p = ray.o + t * ray.d
    mei.wi = -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time = ray.time
    mei.wavelengths = ray.wavelengths
    mei.medium = medium
    return mei


def span(medium: Any, ray: Any, reach: Any, active: Any) -> tuple[Any, Any]:
    """The part [a, b] of the ray up to distance ``reach`` in which the medium may interact; empty (a = b = 0) outside.

    Differentiable in the ray and in ``reach``.
    """
    met, near, far = medium.intersect_aabb(ray)
    met &= active & (dr.isfinite(near) | dr.isfinite(far))
    a, b = dr.maximum(near, 0), dr.minimum(far, reach)
    met &= a < b
    return dr.select(met, a, 0), dr.select(met, b, 0)


def majorant(medium: Any, ray: Any, active: Any) -> Any:
    """An upper bound of the extinction in all channels, everywhere in the medium (Float, detached)."""
    return dr.max(dr.detach(medium.get_majorant(interaction(medium, dr.detach(ray), mi.Float(0)), active)))


def is_grid(grid: Any, medium: Any) -> Any:
    """Where an array of media points at this grid (Bool)."""
    return medium == mi.MediumPtr(grid)
