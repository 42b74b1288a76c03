"""The primal driver: walk paths and add up radiance, L = Σ β_i e_i."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.path import PathState
from ..transport.start import CameraStart
from ..transport.vertex import Walk


def primal(walk: Walk, sampler: mi.Sampler, start: CameraStart, active: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
    """Estimate the radiance along the rays of a ``start``: ``(L, valid)``, per ray.

    ``valid`` is Mitsuba's alpha: the path met a particle, or a surface that does not merely let it pass. Nothing is
    differentiated.
    """
    active = mi.Bool(active) & (walk.max_depth > 0)
    L, valid = walk_on(walk, sampler, PathState.begin(start.choose(walk, active), active))
    return L, valid | (walk.background_is_opaque & active)


@dr.syntax
def walk_on(walk: Walk, sampler: mi.Sampler, path: PathState) -> tuple[mi.Spectrum, mi.Bool]:
    """Radiance that arrives at a path from where it is on, and whether anything was met there.

    Relative to its throughput, which has to be one.
    """
    L = mi.Spectrum(0)  # radiance so far
    valid = mi.Bool(False)

    while dr.hint(path.active, exclude=[walk], label="pathreplay: primal"):
        u, step = path.choose(walk, sampler)
        L += path.β * step.e
        valid |= path.active & step.seen
        path = path.advance(walk, u, step)[0]

    return L, valid
