"""The `pathreplay` integrator plugin: chooses step and driver, and speaks Mitsuba's integrator interface."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .errors import PathreplayError
from .gradient.forward import forward
from .gradient.primal import primal
from .gradient.ray_jacobian import Recovery
from .gradient.replay import replay
from .gradient.sweep import MAX_DEPTH, sweep
from .transport.traits import Traits, scene_traits
from .transport.vertex import Walk

DRIVERS = ("auto", "sweep", "replay")
ATTACH = ("delta", "all", "none")
UNBOUNDED = 0xFFFFFFFF


def _choice(props: Any, name: str, default: str, choices: tuple[str, ...]) -> str:
    value = props.get(name, default)
    if value not in choices:
        raise PathreplayError(f"pathreplay: {name} = {value!r} is unknown: use one of {', '.join(map(repr, choices))}")
    return str(value)


def _make_class() -> type:
    from mitsuba.ad.integrators.common import RBIntegrator

    class PathReplayIntegrator(RBIntegrator):  # type: ignore[misc]
        """Differentiable path tracer for surfaces.

        Properties: ``max_depth`` (6; -1 = unbounded, with the replay driver), ``rr_depth`` (5), ``hide_emitters``
        (False), ``driver`` (``auto``, ``sweep``, ``replay``), ``attach`` (``delta``) and ``noise`` (0.3; of
        ray adjoints with the replay driver: see `Recovery`). ``auto`` sweeps unless
        ``max_depth`` is more than the sweep can hold. Forward mode is the same whatever the driver.

        Not differentiated: visibility; with ``attach='none'`` all motion of shapes, cameras and directions.
        Raises PathreplayError for unknown or unusable properties and in polarised variants.
        """

        def __init__(self, props: Any) -> None:
            if mi.is_polarized:
                raise PathreplayError(
                    f"pathreplay: variant {mi.variant()!r} tracks polarisation, which is not supported: "
                    f"use {mi.variant().replace('_polarized', '')!r}"
                )
            max_depth, rr_depth = props.get("max_depth", 6), props.get("rr_depth", 5)
            if max_depth < -1:
                raise PathreplayError(f"pathreplay: max_depth = {max_depth}: use -1 (unbounded) or a depth >= 0")
            if rr_depth < 1:
                raise PathreplayError(f"pathreplay: rr_depth = {rr_depth}: use a depth >= 1")
            super().__init__(props)
            self.hide_emitters = props.get("hide_emitters", False)
            self.attach = _choice(props, "attach", "delta", ATTACH)
            driver = _choice(props, "driver", "auto", DRIVERS)
            if driver == "sweep" and self.max_depth > MAX_DEPTH:
                depth = "-1 (unbounded)" if max_depth == -1 else max_depth
                raise PathreplayError(
                    f"pathreplay: max_depth = {depth} is more than the sweep driver can hold ({MAX_DEPTH}): "
                    "use driver = 'replay', which has no limit"
                )
            if driver == "auto":
                driver = "sweep" if self.max_depth <= MAX_DEPTH else "replay"
            self.driver = driver
            noise = props.get("noise", Recovery.noise)
            if noise < 0:
                raise PathreplayError(f"pathreplay: noise = {noise}: use a standard deviation >= 0 (0 = off)")
            self.recovery = Recovery(noise=noise)
            self.told = False  # the log line about BSDFs that stay detached

        def sample(
            self,
            mode: dr.ADMode,
            scene: Any,
            sampler: Any,
            ray: Any,
            δL: Any = None,
            active: Any = True,
            **_: Any,
        ) -> tuple[Any, Any, list[Any], Any]:
            """Radiance, its tangent, or nothing (after back-propagating ``δL``): see Mitsuba's ADIntegrator."""
            walk = self._walk(scene)
            if mode == dr.ADMode.Primal:
                L, valid = primal(walk, sampler, dr.detach(ray), active)
                return L, valid, [], None
            if mode == dr.ADMode.Forward:
                tangent, valid = forward(walk, sampler, ray, active)
                return tangent, valid, [], None
            if self.driver == "sweep":
                sweep(walk, sampler, ray, δL, active)
            else:
                replay(walk, sampler, ray, δL, active, self.recovery)
            return mi.Spectrum(0), mi.Bool(True), [], None

        def _walk(self, scene: Any) -> Walk:
            traits = scene_traits(scene)
            if self.attach == "all":
                self._tell_attachable(traits)
            return Walk(
                scene=scene,
                traits=traits,
                attach=self.attach,
                hide_emitters=self.hide_emitters,
                max_depth=self.max_depth,
                rr_depth=self.rr_depth,
                skip_area_emitters=self.skip_area_emitters,
            )

        def _tell_attachable(self, traits: Traits) -> None:
            if traits.attachable is None:
                raise PathreplayError(
                    "pathreplay: attach = 'all', but no BSDF of the scene can be sampled attached (diffuse, "
                    "roughconductor, roughdielectric, normal and bump maps over them can): use attach = 'delta'"
                )
            if traits.detached_names and not self.told:
                names = ", ".join(traits.detached_names)
                mi.Log(mi.LogLevel.Warn, f"pathreplay: attach = 'all' keeps the directions of {names} fixed")
                self.told = True

        def to_string(self) -> str:
            depth = -1 if self.max_depth == UNBOUNDED else self.max_depth
            return (
                f"PathReplayIntegrator[max_depth = {depth}, rr_depth = {self.rr_depth}, "
                f"hide_emitters = {self.hide_emitters}, driver = {self.driver}, attach = {self.attach}]"
            )

    return PathReplayIntegrator


def register() -> None:
    """Register the plugin for the active variant, which must be an AD variant."""
    plugin = _make_class()
    mi.register_integrator("pathreplay", lambda props: plugin(props))
