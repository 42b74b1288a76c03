"""The plugin classes of `pathreplay.baselines`, on the same light-transport step as `pathreplay`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import mitsuba as mi

from pathreplay.adjoint.baseline import Baseline
from pathreplay.adjoint.driver import Driver, ForwardDriver
from pathreplay.adjoint.forward import forward
from pathreplay.integrators.baselines.listing import listing
from pathreplay.integrators.baselines.naive import tape_backward, tape_forward
from pathreplay.integrators.baselines.radiative import no_forward, radiative
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.interior import back_propagate, tangent
from pathreplay.integrators.path_integrator import PathIntegrator
from pathreplay.integrators.properties import choice, flag
from pathreplay.integrators.term import TermResult
from pathreplay.transport.vertex import TraceConfig

ATTACH = ("delta", "none")


@dataclass(frozen=True)
class OtherInterior:
    """The interior term by another driver.

    Media are differentiated by the score, without control variate; empty voxels have no derivative.
    """

    backwards: Driver
    forwards: ForwardDriver

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        """Tangent of the image: see `Term`."""
        return tangent(view, trace, self.forwards)

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        """Back-propagate the adjoint of the image: see `Term`."""
        return back_propagate(view, trace, grad_in, self.backwards)

    def note(self, trace: TraceConfig) -> str:
        """Nothing: see `Term`."""
        return ""


class NaiveIntegrator(PathIntegrator):
    """AD of a wavefront path tracer, for comparison only: memory grows with depth (see `tape`).

    Properties: those of `PathIntegrator` and ``attach`` (``delta``, ``none``), which means what it does for
    `pathreplay`.
    """

    name = "naive_ad"
    interior = OtherInterior(tape_backward, tape_forward)

    def __init__(self, props: mi.Properties) -> None:
        PathIntegrator.__init__(self, props)
        self.attach = choice(props, self.name, "attach", "delta", ATTACH)


class RadiativeIntegrator(PathIntegrator):
    """Radiative backpropagation, for comparison only: time grows with the square of the depth.

    Properties: those of `PathIntegrator` and ``linear`` (False: unbiased; True: the biased variant in linear
    time), see `radiative`. Nothing that moves is differentiated, and there is no forward mode.
    """

    name = "radiative_backprop"

    def __init__(self, props: mi.Properties) -> None:
        PathIntegrator.__init__(self, props)
        linear = flag(props, self.name, "linear", False)
        self.interior = OtherInterior(partial(radiative, linear=linear), no_forward)


class ListingIntegrator(PathIntegrator):
    """Delta tracking as first published, for comparison only: it misses derivatives (see `listing`).

    Properties: those of `PathIntegrator`. For scenes with media; motion raises in reverse mode. Forward mode
    uses the forward driver, without control variate and branch.
    """

    name = "prb_volume_listing"
    attach = "delta"  # so that it is noticed
    interior = OtherInterior(listing, forward)
