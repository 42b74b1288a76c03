"""Integrators to compare `pathreplay` with, on the same steps: `pathreplay_tape` and `pathreplay_rb`.

They show what memory and time the other ways of differentiating a path tracer take. Nothing else is a reason to use
them: `pathreplay` gives the same gradients for less.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import PathreplayError
from ..gradient.adjoint import LostPaths
from ..gradient.primal import primal
from ..render.path_integrator import path_integrator
from ..render.properties import choice, flag
from ..transport.start import CameraStart
from ..transport.vertex import Walk
from .radiative import radiative
from .tape import tape_backward, tape_forward

ATTACH = ("delta", "none")


def _make_classes() -> tuple[type, type]:
    class Rival(path_integrator()):  # type: ignore[misc]
        """Each has its ``propagate``, which takes what a driver takes and back-propagates the adjoint radiance.

        Media are differentiated by the score, without a baseline, and where they are empty not at all.
        """

        def sample(
            self, mode: dr.ADMode, scene: Any, sampler: Any, ray: Any, δL: Any = None, active: Any = True, **_: Any
        ) -> tuple[Any, Any, list[Any], Any]:
            """Radiance, its tangent, or nothing (after back-propagating ``δL``): see Mitsuba's ADIntegrator."""
            if mode == dr.ADMode.Primal and self.goes_back:
                return mi.Spectrum(0), mi.Bool(True), [], None
            walk = self._walk(scene, mode != dr.ADMode.Primal)
            if mode == dr.ADMode.Primal:
                return *primal(walk, sampler, CameraStart(dr.detach(ray)), active), [], None
            if mode == dr.ADMode.Forward:
                return *self.tangent(walk, sampler, CameraStart(ray), active), [], None
            self.propagate(walk, sampler, CameraStart(ray), δL, active)
            return mi.Spectrum(0), mi.Bool(True), [], None

        def tangent(self, walk: Walk, sampler: Any, start: CameraStart, active: Any) -> tuple[Any, Any]:
            """Tangent of the radiance (Spectrum) and whether anything was met (Bool), per ray."""
            raise PathreplayError(f"{self.name} has no forward mode: use the integrator 'pathreplay'")

    class TapeIntegrator(Rival):
        """Plain AD of a wavefront path tracer: for comparison only, since memory grows with the depth (see `tape`).

        Properties: those of `PathIntegrator` and ``attach`` (``delta``, ``none``), which means what it does for
        `pathreplay`.
        """

        name = "pathreplay_tape"

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.attach = choice(props, self.name, "attach", "delta", ATTACH)

        def propagate(self, walk: Walk, sampler: Any, start: CameraStart, δL: Any, active: Any) -> None:
            """Back-propagate ``δL``: see `tape_backward`."""
            tape_backward(walk, sampler, start, δL, active, LostPaths())

        def tangent(self, walk: Walk, sampler: Any, start: CameraStart, active: Any) -> tuple[Any, Any]:
            """Tangent of the radiance: see `tape_forward`."""
            return tape_forward(walk, sampler, start, active, LostPaths())[:2]

    class RadiativeIntegrator(Rival):
        """Radiative backpropagation: for comparison only, since time grows with the square of the depth.

        Properties: those of `PathIntegrator` and ``linear`` (False: unbiased; True: the biased variant in linear
        time), see `radiative`. Nothing that moves is differentiated, and there is no forward mode.
        """

        name = "pathreplay_rb"

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.linear = flag(props, self.name, "linear", False)

        def propagate(self, walk: Walk, sampler: Any, start: CameraStart, δL: Any, active: Any) -> None:
            """Back-propagate ``δL``: see `radiative`."""
            radiative(walk, sampler, start, δL, active, LostPaths(), self.linear)

    return TapeIntegrator, RadiativeIntegrator


def register() -> None:
    """Register the plugins for the active variant, which must be an AD variant."""
    for plugin in _make_classes():
        mi.register_integrator(plugin.name, lambda props, plugin=plugin: plugin(props))  # type: ignore[attr-defined]
