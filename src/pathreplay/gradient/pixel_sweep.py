"""The pixel sweep: an image and the gradient of a quadratic loss, from one set of paths that are walked once.

What a loss wants of a path is known only when its pixel is. So a lane walks all N paths of a pixel and records them
one behind the other, as `sweep` does for one path; then it goes back through all of them. With I the mean of their
radiances L_s, a loss with derivative f'(I) must not judge a path by itself, or the gradient would be biased by the
covariance of L_s and its derivative. Each is judged by the others:

    δL_s = f'(I_{-s}) / N,    I_{-s} = (N I - L_s) / (N - 1),    f'(I) = offset + slope · I.

The gradient's mean is that with an image of other paths. Its variance differs by the covariance of f'(I) dL_s and the
change of f' with L_s: to the better where the loss asks for more light, to the worse where it asks for less; and, of
second order in 1/N, by what the noise of the image and that of the derivative make together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.motion import path_moves
from ..transport.path import PathState
from ..transport.start import CameraStart
from ..transport.vertex import Walk
from .adjoint import LostPaths, RayDerivative
from .record import Layout, record_type, room_for
from .two_walks import first_walk, walk_back


@dataclass(frozen=True)
class PixelLoss:
    """Derivative of a loss by each lane's pixel: offset + slope · I."""

    offset: mi.Spectrum
    slope: mi.Spectrum


@dr.syntax
def pixel_sweep(
    walk: Walk, sampler: mi.Sampler, camera: Callable[..., Any], paths: int, loss: PixelLoss, lost: LostPaths
) -> tuple[bool, mi.Spectrum]:
    """Walk ``paths`` paths (two or more) in every lane and back-propagate the loss.

    Returns whether the paths move with the parameters, and the mean of their radiances. ``camera`` gives rays,
    detached, and their weights: (sampler, active) -> (Ray3f, Spectrum). For scenes without media. What is not
    differentiated, what is counted as ``lost`` and what is raised: see `sweep`.
    """
    room = room_for(walk)
    total = mi.Spectrum(0)  # radiance of all paths
    with dr.suspend_grad():
        ray0, _ = camera(sampler.clone(), mi.Bool(True))
        start = CameraStart(ray0, sampler, mi.Bool(True))
        layout = Layout.of(walk, path_moves(walk, start, PathState.begin(walk, start).at))
    records = dr.alloc_local(record_type(layout), paths * room)
    ends = dr.alloc_local(mi.Spectrum, paths)  # of each path the radiance, and the number of its records
    counts = dr.alloc_local(mi.UInt32, paths)
    s = mi.UInt32(0)  # number of the path

    while dr.hint(s < paths, exclude=[walk, camera, layout, start, lost], label="pathreplay: paths of a pixel"):
        ray, β = camera(sampler, mi.Bool(walk.max_depth > 0))
        path = PathState.begin(walk, CameraStart(ray, sampler, mi.Bool(True)), sustained=True)
        path.β, path.β_alive = mi.Spectrum(β), mi.Spectrum(β)
        records, count, L, _branch = first_walk(walk, sampler, path, layout, records, s * room, lost)
        ends[s], counts[s] = L, count
        total += L
        s += 1

    while dr.hint(s > 0, exclude=[walk, ray0, lost, loss, layout, start], label="pathreplay: pixel, backwards"):
        s -= 1
        δL = (loss.offset + loss.slope * ((total - ends[s]) / (paths - 1))) / paths
        none, still = mi.Spectrum(0), RayDerivative.zero()
        first, count = s * room, mi.UInt32(counts[s])
        walk_back(walk, layout, records, first, count, first + count - 1, ray0, δL, none, still, lost)

    return layout.moves, total / paths
