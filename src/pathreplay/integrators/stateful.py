"""The interface of integrators whose passes take and return a `PassState`, and an adapter for Mitsuba's integrators."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Seed, Which
from pathreplay.integrators.pass_state import PassState
from pathreplay.types import Json

Learned = Mapping[str, np.ndarray]
_RECORDABLE = frozenset({"PRBIntegrator", "BasicPRBIntegrator"})
"""Classes of Mitsuba's integrators that `dr.freeze` can record."""
_PROJECTIVE = "Projective"
"""Substring in the class names of Mitsuba's integrators that estimate boundary terms."""
PARTICLES, PTRACER = "pathreplay_particles", "ptracer"
"""Names of the plugins that trace all light from the emitters."""
_LIGHT_PATHS = {"ParticleIntegrator": PARTICLES, "ParticleTracerIntegrator": PTRACER}
"""These plugins by class."""


@runtime_checkable
class StatefulIntegrator(Protocol):
    """An integrator whose passes take and return a `PassState`. `PathIntegrator` documents the other methods."""

    @property
    def boundary(self) -> str:
        """Boundary terms that the integrator estimates: a value of the property ``boundary`` of `pathreplay`."""

    @property
    def warned(self) -> Collection[str]:
        """Notes that were logged about the scene of the last pass, or silenced."""

    def silence(self, notes: Iterable[str]) -> None:
        """Suppress the given notes, about all scenes."""

    def is_recordable(self, has_media: bool) -> bool:
        """Return whether `dr.freeze` is expected to record passes of this integrator."""

    def is_reached(self, scene: mi.Scene, sensor: Which = 0) -> bool: ...

    def why_no_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> str: ...

    def pass_of(self, scene: mi.Scene, sensor: Which, seed: Seed, spp: int) -> Pass: ...

    def begin(self, scene: mi.Scene) -> PassState: ...

    def keep(self, scene: mi.Scene, state: PassState) -> None: ...

    def image_pass(self, view: Pass, state: PassState) -> mi.TensorXf: ...

    def tangent_pass(self, view: Pass, state: PassState) -> tuple[mi.TensorXf, PassState]: ...

    def gradient_pass(self, view: Pass, grad_in: mi.TensorXf, state: PassState) -> PassState: ...

    def pixel_pass(
        self, view: Pass, derivative: tuple[mi.TensorXf, mi.TensorXf], pixels: mi.UInt32 | None, state: PassState
    ) -> tuple[mi.TensorXf, PassState]: ...

    @property
    def baseline(self) -> object:
        """Learned state, or None. Each change of the learned state creates a new object."""

    def state_dict(self) -> dict[str, np.ndarray]: ...

    def load_state_dict(self, scene: mi.Scene, learned: Learned) -> None: ...

    def options(self) -> Json:
        """Return properties with which `pathreplay` matches this integrator, without properties of `PathIntegrator`."""


class Unlearned:
    """Methods of integrators that learn nothing, and have no pixel sweep."""

    baseline: object = None

    @property
    def _kind(self) -> str:
        return type(self).__name__

    def why_no_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> str:
        return f"{self._kind} renders whole images only; take the integrator 'pathreplay'"

    def pixel_pass(
        self, view: Pass, derivative: tuple[mi.TensorXf, mi.TensorXf], pixels: mi.UInt32 | None, state: PassState
    ) -> tuple[mi.TensorXf, PassState]:
        raise PathreplayError(self.why_no_pixel_sweep(view.scene))

    def state_dict(self) -> dict[str, np.ndarray]:
        return {}

    def load_state_dict(self, scene: mi.Scene, learned: Learned) -> None:
        if learned:
            raise PathreplayError(
                "The checkpoint contains state that another integrator learned from media; set the config's "
                "'integrator' back, or start a new run"
            )

    def options(self) -> Json:
        return {}


@dataclass(frozen=True)
class Stateless(Unlearned):
    """Adapter for an integrator of Mitsuba: its passes return the state unchanged and learn nothing."""

    integrator: mi.Integrator

    @property
    def _kind(self) -> str:
        return type(self.integrator).__name__

    @property
    def boundary(self) -> str:
        return "all" if _PROJECTIVE in self._kind else "none"

    @property
    def warned(self) -> frozenset[str]:
        return frozenset()

    def silence(self, notes: Iterable[str]) -> None:
        """Do nothing, since no notes are logged."""

    def options(self) -> Json:
        return {"caustics": "particles"} if light_path_plugin(self.integrator) else {}

    def is_recordable(self, has_media: bool) -> bool:
        return self._kind in _RECORDABLE and not has_media

    def is_reached(self, scene: mi.Scene, sensor: Which = 0) -> bool:
        """Return True, because Mitsuba's integrators do not tell whether a parameter reaches the paths."""
        return True

    def pass_of(self, scene: mi.Scene, sensor: Which, seed: Seed, spp: int) -> Pass:
        return Pass.of(scene, sensor, seed, spp)

    def begin(self, scene: mi.Scene) -> PassState:
        return PassState()

    def keep(self, scene: mi.Scene, state: PassState) -> None:
        """Do nothing, since there are no results to report."""

    def image_pass(self, view: Pass, state: PassState) -> mi.TensorXf:
        with dr.suspend_grad():
            return mi.render(view.scene, sensor=view.sensor, integrator=self.integrator, spp=view.spp, seed=view.seed)

    def tangent_pass(self, view: Pass, state: PassState) -> tuple[mi.TensorXf, PassState]:
        params = mi.traverse(view.scene)
        return self.integrator.render_forward(view.scene, params, view.sensor, view.seed, view.spp), state

    def gradient_pass(self, view: Pass, grad_in: mi.TensorXf, state: PassState) -> PassState:
        with dr.isolate_grad():  # preserves the AD graph of scene values for the next pass
            params = mi.traverse(view.scene)
            self.integrator.render_backward(view.scene, params, grad_in, view.sensor, view.seed, view.spp)
        return state


def light_path_plugin(integrator: mi.Integrator) -> str | None:
    """Return the name of an integrator that traces all light from the emitters; None for other integrators."""
    # For Python plugins Mitsuba's class_name() returns the name of the C++ base class.
    return _LIGHT_PATHS.get(type(integrator).__name__, _LIGHT_PATHS.get(integrator.class_name()))


def stateful(integrator: mi.Integrator) -> StatefulIntegrator:
    """Return the integrator itself if it implements the interface. Otherwise return an adapter for it."""
    return integrator if isinstance(integrator, StatefulIntegrator) else Stateless(integrator)
