"""Does the path move with the parameters? Found out when a kernel is traced, so that it holds nothing it need not."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .start import CameraStart
from .vertex import Arrival, Walk


def path_moves(walk: Walk, start: CameraStart, at: Arrival) -> bool:
    """Whether hit points, sampled directions or emitter samples depend on parameters with gradients.

    ``at`` is the first arrival. Looks at the four places where motion can enter: the start, the shapes, the BSDFs whose
    directions are followed, and the emitters. Nothing is evaluated.
    """
    if walk.attach == "none":
        return False
    with dr.resume_grad():
        si = at.hit.compute_surface_interaction(at.ray, mi.RayFlags.All)
        moving = [*start.repeat(), si.p, si.n, si.sh_frame.n, si.uv, si.dp_du, si.dp_dv]
        still = dr.detach(si)
        for bsdf in walk.traits.mirrors + (walk.traits.attachables if walk.follows else ()):
            sample, _ = bsdf.sample(mi.BSDFContext(), still, 0.5, mi.Point2f(0.5))
            moving.append(sample.wo)
        light, _ = walk.scene.sample_emitter_direction(still, mi.Point2f(0.5), False)
        moving += [light.p, light.d, light.pdf]
        return any(dr.grad_enabled(value) for value in moving)
