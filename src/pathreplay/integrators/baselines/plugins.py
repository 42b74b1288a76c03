"""The plugin classes of `pathreplay.baselines`; they use the same light-transport step as `pathreplay`."""

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
from pathreplay.integrators.interior import Interior, back_propagate, tangent
from pathreplay.integrators.path_integrator import PathIntegrator
from pathreplay.integrators.properties import PATHS, choice, flag
from pathreplay.integrators.term import TermResult
from pathreplay.platform.properties import Property
from pathreplay.transport.vertex import TraceConfig

ATTACH = Property("attach", "string", "delta", "As in `pathreplay`, without `all`.", ("delta", "none"))
LINEAR = Property(
    "linear",
    "boolean",
    False,
    "False is unbiased, and its time grows with the square of the depth. True is a biased variant in linear time.",
)


@dataclass(frozen=True)
class OtherInterior(Interior):
    """The interior term of a baseline, computed by ``reverse_driver`` and ``forward_driver``.

    Media are differentiated with the score-function estimator, without a control variate. Empty voxels get no
    derivative.
    """

    reverse_driver: Driver
    forward_driver: ForwardDriver

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        return tangent(view, trace, self.forward_driver)

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        return back_propagate(view, trace, grad_in, self.reverse_driver)

    def drivers(self, trace: TraceConfig) -> tuple[TraceConfig, Driver, ForwardDriver]:
        return trace, self.reverse_driver, self.forward_driver


class NaiveIntegrator(PathIntegrator):
    """AD of a wavefront path tracer, for comparison only: memory grows with depth (see `tape`).

    The integrator has the properties of `PathIntegrator`, and the property ``attach`` of `pathreplay` with the values
    ``delta`` and ``none``.
    """

    name, properties = "naive_ad", (*PATHS, ATTACH)
    interior = OtherInterior(tape_backward, tape_forward)

    def __init__(self, props: mi.Properties) -> None:
        PathIntegrator.__init__(self, props)
        self.attach = choice(props, self.name, ATTACH)


class RadiativeIntegrator(PathIntegrator):
    """Radiative backpropagation, for comparison only: time grows with the square of the depth.

    The integrator has the properties of `PathIntegrator`, and ``linear``. If ``linear`` is False (the default), the
    gradient is unbiased. If ``linear`` is True, a biased variant runs in linear time (see `radiative`). Motion is not
    differentiated, and there is no forward mode.
    """

    name, properties = "radiative_backprop", (*PATHS, LINEAR)

    def __init__(self, props: mi.Properties) -> None:
        PathIntegrator.__init__(self, props)
        linear = flag(props, self.name, LINEAR)
        self.interior = OtherInterior(partial(radiative, linear=linear), no_forward)


class ListingIntegrator(PathIntegrator):
    """Delta tracking as first published, for comparison only. The gradient lacks some derivatives (see `listing`).

    The integrator has the properties of `PathIntegrator`. Reverse mode raises PathreplayError if the scene has no media
    or if something moves with the parameters. Forward mode uses `forward`, without a control variate and without null
    branching.
    """

    name = "prb_volume_listing"
    attach = "delta"  # with 'none', motion would be ignored instead of raising an error
    interior = OtherInterior(listing, forward)
