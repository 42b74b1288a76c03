"""Integrators to compare `pathreplay` with, on the same steps: `pathreplay_tape` and `pathreplay_rb`.

They show what memory and time the other ways of differentiating a path tracer take. Nothing else is a reason to use
them: `pathreplay` gives the same gradients for less.
"""

from __future__ import annotations

import gc
from typing import Any

import drjit as dr
import mitsuba as mi

from .errors import PathreplayError
from .gradient.primal import primal
from .gradient.radiative import radiative
from .gradient.tape import tape_backward, tape_forward
from .integrator import UNBOUNDED, mendable
from .transport.media import scene_media
from .transport.traits import nodes_of, scene_traits
from .transport.vertex import Walk

ATTACH = ("delta", "none")


def _make_classes() -> tuple[type, type]:
    from mitsuba.ad.integrators.common import RBIntegrator

    class Rival(RBIntegrator):  # type: ignore[misc]
        """What both have: properties ``max_depth`` (6; -1 = unbounded), ``rr_depth`` (5), ``hide_emitters`` (False).

        Each has its ``propagate``, which takes what a driver takes and back-propagates the adjoint radiance. Media are
        differentiated by the score, without a baseline, and where they are empty not at all. Raises PathreplayError for
        unusable properties and in polarised variants.
        """

        name = ""
        attach = "none"

        def __init__(self, props: Any) -> None:
            if mi.is_polarized:
                raise PathreplayError(
                    f"{self.name}: variant {mi.variant()!r} tracks polarisation, which is not supported: "
                    f"use {mi.variant().replace('_polarized', '')!r}"
                )
            max_depth, rr_depth = props.get("max_depth", 6), props.get("rr_depth", 5)
            if max_depth < -1:
                raise PathreplayError(f"{self.name}: max_depth = {max_depth}: use -1 (unbounded) or a depth >= 0")
            if rr_depth < 1:
                raise PathreplayError(f"{self.name}: rr_depth = {rr_depth}: use a depth >= 1")
            super().__init__(props)
            self.hide_emitters = props.get("hide_emitters", False)
            self.sensor: Any = None  # that is rendered

        def sample(
            self, mode: dr.ADMode, scene: Any, sampler: Any, ray: Any, δL: Any = None, active: Any = True, **_: Any
        ) -> tuple[Any, Any, list[Any], Any]:
            """Radiance, its tangent, or nothing (after back-propagating ``δL``): see Mitsuba's ADIntegrator."""
            walk = self._walk(scene)
            if mode == dr.ADMode.Primal:
                return *primal(walk, sampler, dr.detach(ray), active), [], None
            if mode == dr.ADMode.Forward:
                return *self.tangent(walk, sampler, ray, active), [], None
            self.propagate(walk, sampler, ray, δL, active)
            return mi.Spectrum(0), mi.Bool(True), [], None

        def tangent(self, walk: Walk, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any]:
            """Tangent of the radiance (Spectrum) and whether anything was met (Bool), per ray."""
            raise PathreplayError(f"{self.name} has no forward mode: use the integrator 'pathreplay'")

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            """Back-propagate an image gradient into the parameters: see Mitsuba's ADIntegrator."""
            self._looking_through(scene, sensor, super().render_backward, params, grad_in, sensor, seed, spp)

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            """Tangent of the image along those of the parameters: see Mitsuba's ADIntegrator."""
            return self._looking_through(scene, sensor, super().render_forward, params, sensor, seed, spp)

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """Render an image: see Mitsuba's ADIntegrator."""
            return self._looking_through(scene, sensor, super().render, sensor, seed, spp, develop, evaluate)

        def _looking_through(self, scene: Any, sensor: Any, render: Any, *args: Any) -> Any:
            """Remember the sensor, which may be in a medium; make errors plain; let no old scene vanish on the way.

            Dr.Jit counts the instances of virtual calls, and writes kernels that do not compile if they change.
            """
            self.sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            collecting = gc.isenabled()
            gc.disable()
            try:
                return render(scene, *args)
            except RuntimeError as error:
                mended = mendable(error)
                if mended is error:
                    raise
                raise mended from None
            finally:
                self.sensor = None
                if collecting:
                    gc.enable()

        def _walk(self, scene: Any) -> Walk:
            nodes = nodes_of(scene)
            media = scene_media(nodes, self.sensor)
            return Walk(
                scene=scene,
                traits=scene_traits(nodes, scene, media is not None),
                media=media,
                attach=self.attach,
                hide_emitters=self.hide_emitters,
                max_depth=self.max_depth,
                rr_depth=self.rr_depth,
                skip_area_emitters=self.skip_area_emitters,
            )

        def to_string(self) -> str:
            depth = -1 if self.max_depth == UNBOUNDED else self.max_depth
            return f"{type(self).__name__}[max_depth = {depth}, rr_depth = {self.rr_depth}]"

    class TapeIntegrator(Rival):
        """Plain AD of a wavefront path tracer: for comparison only, since memory grows with the depth (see `tape`).

        Properties: those of `Rival` and ``attach`` (``delta``, ``none``), which means what it does for `pathreplay`.
        """

        name = "pathreplay_tape"

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.attach = props.get("attach", "delta")
            if self.attach not in ATTACH:
                choices = ", ".join(map(repr, ATTACH))
                raise PathreplayError(f"{self.name}: attach = {self.attach!r} is unknown: use one of {choices}")

        def propagate(self, walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any) -> None:
            """Back-propagate ``δL``: see `tape_backward`."""
            tape_backward(walk, sampler, ray, δL, active)

        def tangent(self, walk: Walk, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any]:
            """Tangent of the radiance: see `tape_forward`."""
            return tape_forward(walk, sampler, ray, active)

    class RadiativeIntegrator(Rival):
        """Radiative backpropagation: for comparison only, since time grows with the square of the depth.

        Properties: those of `Rival` and ``linear`` (False: unbiased; True: the biased variant in linear time), see
        `radiative`. Nothing that moves is differentiated, and there is no forward mode.
        """

        name = "pathreplay_rb"

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.linear = props.get("linear", False)

        def propagate(self, walk: Walk, sampler: Any, ray: Any, δL: Any, active: Any) -> None:
            """Back-propagate ``δL``: see `radiative`."""
            radiative(walk, sampler, ray, δL, active, self.linear)

    return TapeIntegrator, RadiativeIntegrator


def register() -> None:
    """Register the plugins for the active variant, which must be an AD variant."""
    for plugin in _make_classes():
        mi.register_integrator(plugin.name, lambda props, plugin=plugin: plugin(props))  # type: ignore[attr-defined]
