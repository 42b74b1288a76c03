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
from ..transport.path import first_arrival, next_arrival, survival, sustain, take_step
from ..transport.vertex import Numbers, Walk
from .adjoint import LostPaths, RayDerivative, backward_step
from .record import end_type, read_back, record, record_type
from .sweep import MAX_DEPTH


def fits(max_depth: int, spp: int) -> bool:
    """Whether there are two paths or more, and the record of a lane can hold all of them."""
    return 1 < spp <= MAX_DEPTH // max(max_depth, 1)


def sweepable(sensor: Any, max_depth: int, spp: int) -> bool:
    """Whether pixels of a sensor can be swept: a box filter, so that each path belongs to one pixel; colours (rgb) and
    no alpha; an independent sampler; a camera that stands still and takes no time; two paths or more (``spp``), all of
    which fit into the record of a lane."""
    film = sensor.film()
    film.prepare([])
    with dr.resume_grad():
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    return bool(
        film.rfilter().is_box_filter()
        and mi.is_rgb
        and not mi.has_flag(film.flags(), mi.FilmFlags.Special)
        and film.bitmap().pixel_format() == mi.Bitmap.PixelFormat.RGB
        and sensor.sampler().class_name() == "IndependentSampler"
        and sensor.shutter_open_time() == 0
        and not dr.grad_enabled(ray.o, ray.d)
        and fits(max_depth, spp)
    )


def pixel_camera(sensor: Any, pixel: Any) -> Callable[..., Any]:
    """Rays through random places of pixels (UInt32, row by row): (sampler, active) -> Ray3f and weight (Spectrum).

    As in Mitsuba's RBIntegrator. Detached.
    """
    width, height = sensor.film().crop_size()
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))

    def camera(sampler: Any, active: Any) -> tuple[Any, Any]:
        place = (corner + sampler.next_2d(active)) / mi.Point2f(width, height)
        aperture = sampler.next_2d(active) if sensor.needs_aperture_sample() else mi.Point2f(0)
        return sensor.sample_ray(sensor.shutter_open(), 0.0, place, aperture, active)

    return camera


@dataclass(frozen=True)
class PixelLoss:
    """Derivative of a loss by each lane's pixel: offset + slope · I (Spectrum each)."""

    offset: Any
    slope: Any


@dr.syntax
def pixel_sweep(
    walk: Walk, sampler: Any, camera: Callable[..., Any], paths: int, loss: PixelLoss, lost: LostPaths
) -> tuple[bool, Any]:
    """Walk ``paths`` paths (two or more) in every lane and back-propagate the loss.

    Returns whether the paths move with the parameters, and the mean of their radiances (Spectrum). ``camera`` is a
    `pixel_camera`. For scenes without media. What is not differentiated, what is counted as ``lost`` and what is
    raised: see `sweep`.
    """

    # ---------------- First pass: record the paths -----------------

    room = max(walk.max_depth, 1)
    total = mi.Spectrum(0)  # radiance of all paths
    with dr.suspend_grad():
        ray0, _ = camera(sampler.clone(), mi.Bool(True))
        attached = path_moves(walk, ray0, first_arrival(walk, ray0, mi.Bool(True)))
    tape = dr.alloc_local(record_type(walk, attached), paths * room)
    ends = dr.alloc_local(end_type(), paths)
    s = mi.UInt32(0)  # number of the path

    while dr.hint(s < paths, exclude=[walk, camera], label="pathreplay: paths of a pixel"):
        active = mi.Bool(walk.max_depth > 0)
        ray, β = camera(sampler, active)
        at = first_arrival(walk, ray, active)
        β_alive = mi.Spectrum(β)  # as in `sweep`
        L = mi.Spectrum(0)  # radiance so far
        η = mi.Float(1)
        depth = mi.UInt32(0)

        while dr.hint(active, exclude=[walk, camera], label="pathreplay: record"):
            u = Numbers.draw(sampler)
            step = take_step(walk, at, u, sampler, β_alive, depth + 1 < walk.max_depth, active)

            β_alive = sustain(β_alive, β, step)
            η *= step.kept.eta
            rr_weight, survives = survival(β_alive, η, depth, u.roulette, walk, step)
            # All lanes of a packet write to the same place: elsewhere writes to local memory get lost (Dr.Jit 1.5).
            tape[s * room + depth] = record(walk, attached, at, u, step, β, rr_weight)

            L += β * step.e
            active = step.active & survives & (dr.max(β_alive) != 0)
            β *= step.w * rr_weight
            β_alive *= rr_weight
            at = next_arrival(walk, at, step, active)
            depth += 1

        ends[s] = end_type()(L, depth)
        total += L
        s += 1

    # ------------ Second pass: from the last vertex back ------------

    while dr.hint(s > 0, exclude=[walk, ray0, lost, loss], label="pathreplay: paths of a pixel, backwards"):
        s -= 1
        end = ends[s]
        δL = (loss.offset + loss.slope * ((total - end.L) / (paths - 1))) / paths
        L = mi.Spectrum(0)  # radiance along the ray that leaves the vertex
        q = RayDerivative.zero()  # adjoint of that ray
        broken = mi.Bool(False)  # a part of the adjoint was not finite
        records = mi.UInt32(end.records)

        while dr.hint(records > 0, exclude=[walk, ray0, lost, loss], label="pathreplay: sweep"):
            records -= 1
            replayed, β = read_back(walk, tape, s * room + records, s * room + end.records - 1, ray0)
            L, q, breaks = backward_step(walk, replayed, attached, δL * β, L, q, mi.Bool(True))
            if dr.hint(attached, mode="scalar"):
                lost.add(breaks & ~broken)
                broken |= breaks

    return attached, total / paths
