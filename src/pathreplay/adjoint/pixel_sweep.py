"""The pixel sweep: an image and the gradient of a quadratic loss from the same set of paths, each sampled once.

The adjoint radiance of a path is known only after all paths of the pixel have been traced. Each lane therefore samples
all N paths of a pixel, records each path like `sweep`, and then sweeps back through all records. Let I be the mean of
the radiances L_s of the paths, and f'(I) the derivative of the loss. The adjoint of a path must not depend on the
radiance of the same path, because the covariance of L_s and dL_s would bias the gradient. For the same reason, it must
not depend on correlated paths, such as other stratified samples of the pixel. Paths are therefore drawn in mutually
independent sets S, and the adjoint of each path uses only the other sets:

    δL_s = f'(I_{-S}) / N,    I_{-S} = (N I - Σ_S L) / (N - |S|),    f'(I) = offset + slope · I.

The expected gradient is the same as with an independent image, but the variance is not. First, the noise of the image
and the noise of its derivative are correlated, in most cases positively. A positive correlation lowers the variance
where the loss falls with more radiance (f' < 0), and raises it where the loss grows (f' > 0). Second, the product of
these two noises adds a term of second order in 1/N.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, RayDerivative
from pathreplay.adjoint.record import Layout, record_type, room_for
from pathreplay.adjoint.two_passes import PathAdjoint, RecordedPath, record_path, sweep_path
from pathreplay.samplers.pixel_samples import PixelSamples
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.motion import along_moving_paths, path_moves
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


@dataclass(frozen=True)
class PixelLoss:
    """The derivative of the loss with respect to the pixel of each lane: offset + slope · I, with I the pixel value."""

    offset: mi.Spectrum
    slope: mi.Spectrum


@dr.syntax
def pixel_sweep(
    trace: TraceConfig,
    numbers: PixelSamples,
    camera: Callable[[Sampler, mi.Bool], tuple[mi.Ray3f, mi.Spectrum]],
    paths: int,
    loss: PixelLoss,
    lost: NonFiniteCounter,
) -> tuple[bool, mi.Spectrum]:
    """Trace ``paths`` paths (two or more) in every lane and back-propagate the loss.

    Returns whether the paths move with the parameters, and the mean of their radiances. ``camera`` maps (sampler,
    active) to detached rays and their weights (Ray3f, Spectrum). The scene must have no media. The documentation of
    `sweep` describes ``lost``, the errors, and what is not differentiated.
    """
    room, size = room_for(trace), numbers.together(paths)
    total = mi.Spectrum(0)  # sum of the radiances of all paths
    with dr.suspend_grad():
        sampler = numbers.first()
        ray0, _ = camera(sampler.clone(), mi.Bool(True))
        start = CameraStart(ray0, sampler, mi.Bool(True))
        moves = path_moves(trace, start, PathState.begin(trace, start).at)
    trace, layout = along_moving_paths(trace, moves), Layout.of(trace, moves)
    records = dr.alloc_local(record_type(layout), paths * room)
    counts = dr.alloc_local(mi.UInt32, paths)  # number of records of each path
    ends = dr.alloc_local(mi.Spectrum, paths)  # radiance along the ray from the last recorded vertex
    sets = dr.alloc_local(mi.Spectrum, -(-paths // size), dr.zeros(mi.Spectrum))  # sum of radiances of each set
    s = mi.UInt32(0)  # index of the path

    while dr.hint(
        s < paths, exclude=[trace, numbers, camera, layout, start, lost], label="pathreplay: paths of a pixel"
    ):
        sampler = numbers.of(sampler, s % size, size, s // size)
        ray, β = camera(sampler, mi.Bool(trace.max_depth > 0))
        path = PathState.begin(trace, CameraStart(ray, sampler, mi.Bool(True)), sustained=True)
        path.β, path.β_alive = mi.Spectrum(β), mi.Spectrum(β)
        records, count, L, beyond, _branch = record_path(trace, sampler, path, layout, records, s * room, lost)
        counts[s], ends[s] = count, beyond
        sets[s // size] += L
        total += L
        s += 1

    while dr.hint(s > 0, exclude=[trace, ray0, lost, loss, layout, start], label="pathreplay: pixel, backwards"):
        s -= 1
        others = mi.Float(paths - dr.minimum(size, paths - s // size * size))
        δL = (loss.offset + loss.slope * ((total - sets[s // size]) / others)) / paths
        first, count = s * room, mi.UInt32(counts[s])
        recorded = RecordedPath(layout, records, first, count, first + count - 1, ray0)
        sweep_path(trace, recorded, PathAdjoint(δL, mi.Spectrum(ends[s]), RayDerivative.zero()), lost)

    return layout.moves, total / paths
