"""The interior term: the derivative of what paths carry, visibility held, by any driver that follows camera rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter
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
from pathreplay.integrators.term import TermResult
from pathreplay.platform.device import device_of
from pathreplay.transport.vertex import TraceConfig


def image(view: Pass, trace: TraceConfig) -> mi.TensorXf:
    """The image of a pass (height x width x channels)."""
    rays = view.rays()
    return splat(view, rays, *primal(trace, rays.start))


def tangent(view: Pass, trace: TraceConfig, driver: ForwardDriver) -> TermResult:
    """Tangent of the image, by a driver. Paths are counted where they move."""
    rays, lost = view.rays(), NonFiniteCounter()
    δL, valid, moves = driver(trace, rays.start, lost)
    image = splat(view, rays, δL, valid)
    if not moves:
        return TermResult(image)
    dr.eval(image)  # in one kernel with the count of lost paths
    return TermResult(image, lost=lost.count, paths=dr.width(rays.ray), moves=True)


def back_propagate(view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, driver: Driver) -> TermResult:
    """Back-propagate the adjoint of the image by a driver. Paths are counted where they move, and in media."""
    rays, lost = view.rays(), NonFiniteCounter()
    δL, paths = adjoint(view, rays, grad_in), dr.width(rays.ray)
    moves = driver(trace, rays.start, δL, lost)
    del rays, δL  # so that loops need not compute what comes out of them
    dr.eval()
    return TermResult(lost=lost.count, paths=paths, moves=moves) if moves or trace.media is not None else TermResult()


@dataclass(frozen=True)
class PathReplay:
    """The interior by our own drivers: forward, and sweep, replay or lights.

    Not differentiated: see `sweep`, `replay` and `forward`; weights that are exactly zero with the replay driver.
    """

    adjoint: str  # recorded or replay
    auto: bool  # replay where the sweep cannot hold the paths, and lights where nothing else has gradients
    branch: str | bool  # whether a null collision of each path is kept (auto: where it is needed)
    recovery: Recovery  # of the replay driver

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        """Tangent of the image: see `Term`."""
        return tangent(view, self._informed(trace, learned), forward)

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        """Back-propagate the adjoint of the image: see `Term`."""
        trace = self._informed(trace, learned)
        if not self._sweeps(trace):
            again = partial(replay, recovery=self.recovery)
            return back_propagate(view, replace(trace, baseline=None), grad_in, self._or_lights(again))
        seen = None if learned is None or trace.media is None else BaselineStats.none(learned.cells, *view.keys)
        found = back_propagate(view, trace, grad_in, self._or_lights(partial(sweep, seen=seen)))
        return replace(found, seen=seen)

    def pixels(self, view: Pass, trace: TraceConfig, loss: PixelLoss, some: mi.UInt32 | None) -> TermResult:
        """The image, while the loss is back-propagated: see `pixel_sweep`. For scenes without media.

        If only ``some`` pixels are asked for, a row for each of them.
        """
        width, height = view.size
        lost, pixel = NonFiniteCounter(), dr.arange(mi.UInt32, width * height) if some is None else some
        lanes = dr.width(pixel)
        numbers, camera = view.of_pixels(pixel), pixel_camera(view.sensor, pixel)
        moves, L = pixel_sweep(trace, numbers, camera, view.spp, loss, lost)
        dr.eval(L)  # in one kernel with the gradients
        image = mi.TensorXf(dr.ravel(L), (height, width, 3) if some is None else (lanes, 1, 3))
        return TermResult(image, lost=lost.count, paths=lanes * view.spp, moves=True) if moves else TermResult(image)

    def _or_lights(self, driver: Driver) -> Driver:
        """The driver, where one was asked for; else one of its own where only lights have gradients."""
        return lights_or(driver) if self.auto else driver

    def note(self, trace: TraceConfig) -> str:
        """What is to be said of the driver that was chosen; "" if it is nothing."""
        device = device_of(mi.variant())
        if self._sweeps(trace) or self.adjoint == "replay" or not device.is_gpu:
            return ""
        return (
            f"records of {trace.max_depth} vertices are more than {device.name or 'the GPU'} can hold for each of its "
            f"threads: paths are walked twice instead (adjoint = 'replay'); up to max_depth = {deepest(trace, device)} "
            "they are recorded"
        )

    def _sweeps(self, trace: TraceConfig) -> bool:
        return self.adjoint == "recorded" and not (self.auto and trace.max_depth > deepest(trace))

    def _informed(self, trace: TraceConfig, learned: Baseline | None) -> TraceConfig:
        """The walk, with what earlier passes found out about media."""
        if trace.media is None:
            return trace
        branching = None
        if trace.media.branches if self.branch == "auto" else self.branch:
            branching = dr.opaque(mi.Float, FIRST_BRANCHING) if learned is None else learned.branching
        return replace(trace, baseline=None if learned is None else learned.look, branching=branching)
