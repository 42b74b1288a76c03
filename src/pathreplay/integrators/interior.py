"""The interior term: derivative of path contributions at fixed visibility. A driver traces and differentiates paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, Unreached
from pathreplay.adjoint.baseline import FIRST_BRANCHING, Baseline, BaselineStats
from pathreplay.adjoint.driver import Driver, ForwardDriver
from pathreplay.adjoint.emission_only import lights_or
from pathreplay.adjoint.forward import forward
from pathreplay.adjoint.pixel_sweep import PixelLoss, pixel_sweep
from pathreplay.adjoint.primal import primal
from pathreplay.adjoint.ray_jacobian import Recovery
from pathreplay.adjoint.record import deepest
from pathreplay.adjoint.replay import replay
from pathreplay.adjoint.sweep import sweep
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.image import adjoint, splat
from pathreplay.integrators.film.pixel_passes import pixel_camera
from pathreplay.integrators.lifetimes import careful
from pathreplay.integrators.term import Term, TermResult
from pathreplay.platform.device import device_of
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


def tangent(view: Pass, trace: TraceConfig, driver: ForwardDriver) -> TermResult:
    """Compute the tangent of the image with a driver.

    If hit points, directions or emitter samples depend on parameters with gradients, also count the paths with an
    incomplete gradient.
    """
    rays, lost = view.rays(), NonFiniteCounter()
    δL, _, moves = driver(trace, rays.start, lost)
    image = splat(view, rays, δL, mi.Bool(False))  # alpha has no derivative
    if not moves:
        return TermResult(image)
    dr.eval(image)  # the kernel of the image also counts the paths with an incomplete gradient
    return TermResult(image, lost=lost.count, paths=dr.width(rays.ray), moves=True)


def back_propagate(view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, driver: Driver) -> TermResult:
    """Back-propagate the adjoint of the image with a driver.

    If hit points, directions or emitter samples depend on parameters with gradients, or if the scene has media, also
    count the paths with an incomplete gradient.
    """
    rays, lost = view.rays(), NonFiniteCounter()
    δL, paths = adjoint(view, rays, grad_in), dr.width(rays.ray)
    moves = driver(trace, rays.start, δL, lost)
    del rays, δL  # Dr.Jit does not compute loop outputs without references
    dr.eval()
    return TermResult(lost=lost.count, paths=paths, moves=moves) if moves or trace.media is not None else TermResult()


class Interior(Term, Protocol):
    """An interior term, whose drivers can also differentiate paths along rays that a caller has sampled."""

    def drivers(self, trace: TraceConfig) -> tuple[TraceConfig, Driver, ForwardDriver]:
        """Return the drivers, with the configuration that they need. No control variate is used."""


class _Radiance(dr.CustomOp):
    """Radiance with derivatives computed by two functions, so that AD of the caller's operations can continue."""

    def eval(
        self,
        L: mi.Spectrum,
        forward_pass: Callable[[], mi.Spectrum],
        reverse_pass: Callable[[mi.Spectrum], None],
        inputs: object,
    ) -> mi.Spectrum:
        self.forward_pass, self.reverse_pass = forward_pass, reverse_pass
        return L

    def forward(self) -> None:
        self.set_grad_out(self.forward_pass())

    def backward(self) -> None:
        self.reverse_pass(self.grad_out())


def differentiable_radiance(
    interior: Interior,
    trace: TraceConfig,
    start: CameraStart,
    inputs: object,
    tell: Callable[[TermResult], None],
) -> tuple[mi.Spectrum, mi.Bool]:
    """Estimate the radiance along the rays of a ``start``, as `primal` does, with the derivative of the interior term.

    ``inputs`` contains the variables with gradients on which the radiance may depend. The derivative is computed when
    AD reaches the radiance; ``tell`` then receives the result of the pass. Not differentiated: what the drivers leave
    out, and the motion of edges.
    """
    sampler, paths = start.sampler.clone(), dr.width(start.ray)
    with dr.suspend_grad():
        L, valid = primal(trace, start)

    def again() -> CameraStart:
        return replace(start, sampler=sampler.clone())

    def forward_pass() -> mi.Spectrum:
        with careful(), dr.suspend_grad():
            prepared, _, driver = interior.drivers(trace)
            lost = NonFiniteCounter()
            δL, _, moves = driver(prepared, again(), lost)
            dr.eval(δL)
        tell(TermResult(lost=lost.count, paths=paths, moves=moves))
        return δL

    def reverse_pass(δL: mi.Spectrum) -> None:
        lost = NonFiniteCounter()
        try:
            with careful(), dr.suspend_grad(), dr.isolate_grad():
                prepared, driver, _ = interior.drivers(trace)
                moves = driver(prepared, again(), δL, lost)
                dr.eval()
        except Unreached:  # other operations of the caller may depend on the parameters
            moves = False
        tell(TermResult(lost=lost.count, paths=paths, moves=moves))

    return dr.custom(_Radiance, L, forward_pass, reverse_pass, inputs), valid


@dataclass(frozen=True)
class PathReplay(Interior):
    """The interior term: `forward` in forward mode, and `sweep`, `replay` or `emission_only` in reverse mode.

    The docstrings of these functions state what is not differentiated. Unlike `sweep`, `replay` does not differentiate
    weights that are exactly zero.
    """

    adjoint: str  # "recorded" for `sweep`, or "replay" for `replay`
    auto: bool  # use `replay` for paths too deep to be recorded, and `emission_only` if only emitters have gradients
    branch: str | bool  # whether paths branch at a null collision; "auto": if the media require branching
    recovery: Recovery  # regularisation of `replay`

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        return tangent(view, self._with_baseline(trace, learned), forward)

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        trace, stats = self._with_baseline(trace, learned), None
        if not self._sweeps(trace):
            trace = replace(trace, baseline=None)
        elif learned is not None and trace.media is not None:
            stats = BaselineStats.none(learned.cells, *view.keys)
        return replace(back_propagate(view, trace, grad_in, self._reverse_driver(trace, stats)), stats=stats)

    def drivers(self, trace: TraceConfig) -> tuple[TraceConfig, Driver, ForwardDriver]:
        trace = self._with_baseline(trace, None)
        return trace, self._reverse_driver(trace, None), forward

    def pixels(self, view: Pass, trace: TraceConfig, loss: PixelLoss, some: mi.UInt32 | None) -> TermResult:
        """Render the image and back-propagate the loss in one pass: see `pixel_sweep`. The scene must have no media.

        With ``some`` (row-major pixel indices), the image has one row per pixel.
        """
        width, height = view.size
        lost, pixel = NonFiniteCounter(), dr.arange(mi.UInt32, width * height) if some is None else some
        lanes = dr.width(pixel)
        samples, camera = view.pixel_samples(pixel), pixel_camera(view.sensor, pixel)
        moves, L = pixel_sweep(trace, samples, camera, view.spp, loss, lost)
        dr.eval(L)  # the kernel of L also computes the gradients
        image = mi.TensorXf(dr.ravel(L), (height, width, 3) if some is None else (lanes, 1, 3))
        return TermResult(image, lost=lost.count, paths=lanes * view.spp, moves=True) if moves else TermResult(image)

    def note(self, trace: TraceConfig) -> str:
        """Return a message if paths are replayed because records do not fit into GPU memory, otherwise ""."""
        device = device_of(mi.variant())
        if self._sweeps(trace) or self.adjoint == "replay" or not device.is_gpu:
            return ""
        return (
            f"records of {trace.max_depth} vertices per thread do not fit into the memory of "
            f"{device.name or 'the GPU'}: paths are replayed instead (adjoint = 'replay'); "
            f"up to max_depth = {deepest(trace, device)} they are recorded"
        )

    def _reverse_driver(self, trace: TraceConfig, seen: BaselineStats | None) -> Driver:
        driver = partial(sweep, seen=seen) if self._sweeps(trace) else partial(replay, recovery=self.recovery)
        return lights_or(driver) if self.auto else driver

    def _sweeps(self, trace: TraceConfig) -> bool:
        return self.adjoint == "recorded" and not (self.auto and trace.max_depth > deepest(trace))

    def _with_baseline(self, trace: TraceConfig, learned: Baseline | None) -> TraceConfig:
        """Return ``trace`` with the learned control variate and the weight of null collisions, if the scene has media.

        Both are learned from earlier passes. Without null branching, the weight of null collisions is None.
        """
        if trace.media is None:
            return trace
        branching = None
        if trace.media.branches if self.branch == "auto" else self.branch:
            branching = dr.opaque(mi.Float, FIRST_BRANCHING) if learned is None else learned.branching
        return replace(trace, baseline=None if learned is None else learned.lookup, branching=branching)
