"""The primal driver: sample paths and accumulate radiance, L = Σ β_i e_i."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.arrive import background
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


def primal(trace: TraceConfig, start: CameraStart) -> tuple[mi.Spectrum, mi.Bool]:
    """Estimate the radiance along the rays of a ``start``; return ``(L, valid)`` per ray.

    ``valid`` is Mitsuba's alpha: the path had a collision in a medium, or was scattered or absorbed at a surface.
    Nothing is differentiated.
    """
    path = PathState.begin(trace, start)
    L, valid = path_radiance(trace, start.sampler, path)
    return L, valid | (trace.background_is_opaque & path.active)


@dr.syntax
def two_radiances(
    trace: TraceConfig, sampler: Sampler, first: PathState, second: PathState
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Return the `path_radiance` of two paths that use the same random numbers. The kernel contains one loop for both.

    The ``sampler`` is not advanced.
    """
    a, b, n = mi.Spectrum(0), mi.Spectrum(0), mi.UInt32(0)
    either = first.active | second.active
    while dr.hint(either & (n < 2), exclude=[trace, sampler, first, second], label="pathreplay: two paths"):
        path = dr.select(n == 0, first, second)
        a, b = b, path_radiance(trace, sampler.clone(), path)[0]
        n += 1
    return a, b


@dr.syntax
def path_radiance(trace: TraceConfig, sampler: Sampler, path: PathState) -> tuple[mi.Spectrum, mi.Bool]:
    """Continue a path from its present state; return the radiance along the path, and ``valid`` (see `primal`).

    The throughput ``path.β`` must be one, because it is a factor of the result. A path that only reaches the
    environment is not valid.
    """
    trace = replace(trace, background_apart=trace.media is None)
    L = mi.Spectrum(0)  # radiance so far
    valid, left = mi.Bool(False), mi.Bool(False)
    if dr.hint(trace.background_apart, mode="scalar"):
        path, left = path.leave()

    while dr.hint(path.active, exclude=[trace], label="pathreplay: primal"):
        u, step = path.choose(trace, sampler)
        L += path.β * step.e
        valid |= path.active & step.seen
        path = path.advance(trace, u, step)[0]
        if dr.hint(trace.background_apart, mode="scalar"):
            path, gone = path.leave()
            left |= gone

    if dr.hint(trace.background_apart, mode="scalar"):
        L += path.β * background(trace, path.at, left)
    return L, valid
