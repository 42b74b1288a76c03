"""Loops over light paths. They render the image, compute its tangent, and back-propagate the adjoint of the image.

Each lane traces many light paths one after the other. Memory therefore does not depend on the number of light paths.

Let W_0 be the weight of the first ray of a path, and w_i the weight with which the path continues at vertex i. The
throughput at vertex i is W_0 β_i, where β_i is the product of the weights w at the vertices before i. Vertex i adds the
value W_0 β_i c_i to the image, at the film position s_i (see `Splat`). Let A be the adjoint of the image, interpolated
by the filter (see `ParticleFilm.gather`). The function A is fixed, but its argument s_i is differentiated. The
derivative of the loss is then the derivative of the sum of W_0 L_0 over all paths, with

    L_i = A(s_i) c_i + w_i L_{i+1}.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import (
    NonFiniteCounter,
    RayDerivative,
    Unreached,
    backward,
    forward_step,
    tangents,
)
from pathreplay.adjoint.record import Layout, deepest, record_type, room_for
from pathreplay.adjoint.two_passes import PathAdjoint, RecordedPath, record_path, sweep_path
from pathreplay.errors import PathreplayError
from pathreplay.particles.film import ParticleFilm, colour, colour_adjoint
from pathreplay.particles.start import Emission, EmitterSamples, EmitterStart
from pathreplay.platform.device import device_of
from pathreplay.samplers.owen_sobol import OwenSobolSampler
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.motion import along_moving_paths, path_moves, weights_vary
from pathreplay.transport.path import PathState
from pathreplay.transport.sensor import SensorLink
from pathreplay.transport.vertex import Step, TraceConfig

# Numbers of lanes that trace light paths at the same time, on CPUs and on GPUs.
LANES = 2**16
LANES_GPU = 2**20


@dataclass(frozen=True)
class Particles:
    """``number`` light paths of a scene. Their random numbers are a pure function of ``key``."""

    emission: Emission
    key: mi.UInt32
    number: int

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return min(self.number, LANES_GPU if device_of(mi.variant()).is_gpu else LANES)

    def start(self, trace: TraceConfig, i: mi.UInt32, active: mi.Bool | bool = True) -> EmitterStart:
        """Return the start of the light paths with indices ``i``."""
        sampler = OwenSobolSampler.of(i, self.key)
        return EmitterStart(trace, self.emission, EmitterSamples.draw(sampler), sampler, mi.Bool(active))

    def moves(self, trace: TraceConfig) -> bool:
        """Return whether light paths or their film positions depend on parameters with gradients."""
        if trace.attach == "none":
            return False
        assert trace.to_sensor is not None
        start = self.start(trace, dr.arange(mi.UInt32, self.lanes))
        return trace.to_sensor.moves() or path_moves(trace, start, PathState.begin(trace, start).at)


@dr.syntax
def particle_image(trace: TraceConfig, particles: Particles, film: ParticleFilm) -> mi.TensorXf:
    """Render the image of light paths. Nothing is differentiated."""
    sums = dr.zeros(mi.Float, 4 * film.pixels)
    i = dr.arange(mi.UInt32, particles.lanes)
    lanes, number = dr.opaque(mi.UInt32, particles.lanes), dr.opaque(mi.UInt32, particles.number)

    while dr.hint(i < number, exclude=[trace, particles, film, sums], label="pathreplay: particles"):
        start = particles.start(trace, i, i < number)
        splat_path(trace, start.sampler, PathState.begin(trace, start), start.W, film, sums)
        i += lanes

    return film.develop(sums * film.scale(particles.number))


@dr.syntax
def splat_path(
    trace: TraceConfig, sampler: Sampler, path: PathState, W: mi.Spectrum, film: ParticleFilm, sums: mi.Float
) -> None:
    """Continue a light path, and add ``W`` times its contributions to the buffer ``sums``. Detached."""
    while dr.hint(path.active, exclude=[trace, film, sums, W], label="pathreplay: light path"):
        u, step = path.choose(trace, sampler)
        assert step.splat is not None
        at, c = film.footprint(step.splat.s), W * path.β * step.splat.c
        film.add(sums, at, at.x, at.y, colour(c, path.at.ray.wavelengths), path.active & step.kept.lit)
        path = path.advance(trace, u, step)[0]


@dr.syntax
def particle_tangent(
    trace: TraceConfig, particles: Particles, film: ParticleFilm, lost: NonFiniteCounter
) -> tuple[mi.TensorXf, bool]:
    """Compute the tangent of the image from the tangents of the parameters.

    Returns the tangent, and whether the parameters move the vertices or the film positions of light paths. ``lost``
    counts the paths whose tangent was not finite and was dropped.
    """
    sums = dr.zeros(mi.Float, 4 * film.pixels)
    i = dr.arange(mi.UInt32, particles.lanes)
    lanes, number = dr.opaque(mi.UInt32, particles.lanes), dr.opaque(mi.UInt32, particles.number)
    moves = particles.moves(trace)
    trace = along_moving_paths(trace, moves)

    while dr.hint(i < number, exclude=[trace, particles, film, sums, lost, moves], label="pathreplay: particles"):
        start = particles.start(trace, i, i < number)
        with dr.resume_grad():
            ray0, W0 = start.emit()
            δo, δd, δβ = tangents(ray0.o, ray0.d, W0)
        W = start.W
        δ = RayDerivative(mi.Point3f(δo), mi.Vector3f(δd), mi.Float(0))
        path = PathState.begin(trace, start, sustained=True)
        sampler, broken = start.sampler, mi.Bool(False)
        while dr.hint(path.active, exclude=[trace, film, sums, W, moves, lost], label="pathreplay: light path"):
            u, step = path.choose(trace, sampler)
            onward, v = path.advance(trace, u, step)
            β, lit = W * path.β, path.active & step.kept.lit
            again, _, δw, δ, (δc, *δh) = forward_step(trace, v, moves, δ, path.active, partial(_on_film, film))
            assert again.splat is not None
            at = film.footprint(again.splat.s)
            if dr.hint(moves, mode="scalar"):
                δ, finite = δ.finite_part()
                lost.add(path.active & ~finite & ~broken)
                broken |= ~finite
            wavelengths = path.at.ray.wavelengths
            c = colour(β * again.splat.c, wavelengths)
            film.add(sums, at, at.x, at.y, colour(δβ * again.splat.c + β * δc, wavelengths), lit)
            if dr.hint(moves and not film.meter, mode="scalar"):
                film.add(sums, at, δh[: film.n], at.y, c, lit)
                film.add(sums, at, at.x, δh[film.n :], c, lit)
            δβ = (δβ * again.w + β * δw) * v.rr_weight
            path = onward
        i += lanes

    return film.develop(sums * film.scale(particles.number)), moves


def _on_film(film: ParticleFilm, step: Step) -> list[object]:
    """Return the contribution of a step to the film, and the values of the filter around its position."""
    assert step.splat is not None
    at = film.footprint(step.splat.s)
    return [step.splat.c, *at.x, *at.y]


@dr.syntax
def particle_sweep(
    trace: TraceConfig, particles: Particles, film: ParticleFilm, grad_in: mi.TensorXf, lost: NonFiniteCounter
) -> bool:
    """Back-propagate the adjoint ``grad_in`` of the image into the parameters.

    Returns whether the parameters move the vertices or the film positions of light paths. Each path is recorded, and
    its vertices are differentiated from the last to the first, as in `sweep`. Visibility is not differentiated. With
    ``attach='none'``, the motion of paths is not differentiated either. ``lost`` counts the paths whose gradient is
    incomplete.

    Raises PathreplayError if ``max_depth`` exceeds `deepest`, or if the paths depend on no parameter with gradients.
    """
    if trace.max_depth > deepest(trace):
        depth = "-1 (unbounded)" if trace.max_depth >= 2**32 - 2 else trace.max_depth + 1
        raise PathreplayError(
            f"max_depth = {depth} is more than the record of a light path can hold: take up to {deepest(trace) + 1} "
            "where light paths are differentiated"
        )
    trace = with_adjoint(trace, film, film.adjoint(grad_in) * film.scale(particles.number))
    moves = particles.moves(trace)
    trace = along_moving_paths(trace, moves)
    layout = Layout.of(trace, moves)
    records = dr.alloc_local(record_type(layout), room_for(trace))
    i = dr.arange(mi.UInt32, particles.lanes)
    lanes, number = dr.opaque(mi.UInt32, particles.lanes), dr.opaque(mi.UInt32, particles.number)
    start0 = particles.start(trace, i)
    at0 = PathState.begin(trace, start0).at
    varies = moves or weights_vary(trace, at0)
    with dr.resume_grad():
        starts = dr.grad_enabled(*start0.repeat(), start0.emit()[1])
    if not (varies or starts):
        raise Unreached("no parameter with gradients reaches the light paths")

    while dr.hint(
        i < number,
        exclude=[trace, particles, lost, layout, moves, varies, starts, start0, at0],
        label="pathreplay: particles",
    ):
        start = particles.start(trace, i, i < number)
        path = PathState.begin(trace, start, sustained=True)
        ray0 = path.at.ray
        records, count, L, _beyond, _branch = record_path(
            trace, start.sampler, path, layout, records, mi.UInt32(0), lost
        )
        q = RayDerivative.zero()
        if dr.hint(varies, mode="scalar"):
            recorded = RecordedPath(layout, records, mi.UInt32(0), count, count - 1, ray0)
            swept = sweep_path(trace, recorded, PathAdjoint(start.W, mi.Spectrum(0), q), lost)
            L, q = swept.L, swept.q
        if dr.hint(starts, mode="scalar"):
            with dr.resume_grad():
                ray, W = start.emit()
                backward(dr.sum(W * L) + dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d))
        i += lanes
    return moves


def with_adjoint(trace: TraceConfig, film: ParticleFilm, A: mi.Float) -> TraceConfig:
    """Return the configuration with an adjoint image, by which contributions to the film are multiplied.

    ``A`` is the adjoint of a buffer of ``film``.
    """
    dr.eval(A)

    def adjoint(s: mi.Point2f, wavelengths: mi.Spectrum, active: mi.Bool) -> mi.Spectrum:
        return colour_adjoint(film.gather(A, s, active), wavelengths)

    assert trace.to_sensor is not None
    return replace(trace, to_sensor=replace(trace.to_sensor, adjoint=adjoint))


def link_of(trace: TraceConfig, sensor: mi.Sensor, caustics: bool) -> TraceConfig:
    """Return the configuration with which light paths to a sensor are traced.

    A light path of ``max_depth`` segments has ``max_depth`` - 1 vertices, because neither emitter nor sensor counts as
    a vertex. With ``caustics``, only the paths that `TraceConfig.without_caustics` omits are traced. Directions from
    smooth lobes and collisions follow their hit points, because no boundary term follows a smooth lobe or a collision.
    """
    link = replace(SensorLink.of(sensor), caustics=caustics)
    trace = replace(trace, to_sensor=link, max_depth=max(trace.max_depth - 1, 0), without_caustics=False)
    return replace(trace, may_slide=False, holds_collisions=False)
