"""Integrators as objectives use them: passes take a `PassState` and return it with what they found.

Ours do. `stateful` makes such integrators of Mitsuba's own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Seed, Which
from pathreplay.integrators.pass_state import PassState

Learned = Mapping[str, np.ndarray]
_RECORDABLE = frozenset({"PRBIntegrator", "BasicPRBIntegrator"})
"""Mitsuba's that look at nothing on the host while they render, by class."""
_PROJECTIVE = "Projective"
"""In the class names of Mitsuba's that sample edges."""


@runtime_checkable
class StatefulIntegrator(Protocol):
    """An integrator whose passes take a state and return it: see `PathIntegrator`, which documents the methods."""

    @property
    def boundary(self) -> str:
        """Boundary terms that are estimated, as the property of `pathreplay` has it."""

    @property
    def warned(self) -> Collection[str]:
        """What has been said in the log."""

    def silence(self, notes: Iterable[str]) -> None:
        """Say nothing of these in the log."""

    def is_recordable(self, has_media: bool) -> bool:
        """Whether `dr.freeze` can record its passes in a scene with or without media, as far as that is known."""

    def is_reached(self, scene: mi.Scene, sensor: Which = 0) -> bool: ...

    def why_no_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> str: ...

    def pass_of(self, scene: mi.Scene, sensor: Which, seed: Seed, spp: int) -> Pass: ...

    def begin(self, scene: mi.Scene) -> PassState: ...

    def keep(self, scene: mi.Scene, state: PassState) -> None: ...

    def image_pass(self, view: Pass, state: PassState) -> mi.TensorXf: ...

    def gradient_pass(self, view: Pass, grad_in: mi.TensorXf, state: PassState) -> PassState: ...

    def pixel_pass(
        self, view: Pass, derivative: tuple[mi.TensorXf, mi.TensorXf], pixels: mi.UInt32 | None, state: PassState
    ) -> tuple[mi.TensorXf, PassState]: ...

    def state_dict(self) -> dict[str, np.ndarray]: ...

    def load_state_dict(self, scene: mi.Scene, learned: Learned) -> None: ...

    def options(self) -> dict[str, Any]:
        """The properties of `pathreplay` that stand for this one, beside those that all integrators of paths share."""


@dataclass(frozen=True)
class Stateless:
    """An integrator of Mitsuba's as a `StatefulIntegrator`: it takes nothing from a state, and learns nothing."""

    integrator: mi.Integrator

    @property
    def name(self) -> str:
        """Its class."""
        return type(self.integrator).__name__

    @property
    def boundary(self) -> str:
        return "all" if _PROJECTIVE in self.name else "none"

    @property
    def warned(self) -> frozenset[str]:
        return frozenset()

    def silence(self, notes: Iterable[str]) -> None:
        """Nothing is said."""

    def is_recordable(self, has_media: bool) -> bool:
        return self.name in _RECORDABLE and not has_media

    def is_reached(self, scene: mi.Scene, sensor: Which = 0) -> bool:
        """Not known, and so assumed."""
        return True

    def why_no_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> str:
        return whole_pictures(self.name)

    def pass_of(self, scene: mi.Scene, sensor: Which, seed: Seed, spp: int) -> Pass:
        return Pass.of(scene, sensor, seed, spp)

    def begin(self, scene: mi.Scene) -> PassState:
        return PassState()

    def keep(self, scene: mi.Scene, state: PassState) -> None:
        """Nothing."""

    def image_pass(self, view: Pass, state: PassState) -> mi.TensorXf:
        with dr.suspend_grad():
            return mi.render(view.scene, sensor=view.sensor, integrator=self.integrator, spp=view.spp, seed=view.seed)

    def gradient_pass(self, view: Pass, grad_in: mi.TensorXf, state: PassState) -> PassState:
        with dr.isolate_grad():  # as in `PathIntegrator`
            params = mi.traverse(view.scene)
            self.integrator.render_backward(view.scene, params, grad_in, view.sensor, view.seed, view.spp)
        return state

    def pixel_pass(
        self, view: Pass, derivative: tuple[mi.TensorXf, mi.TensorXf], pixels: mi.UInt32 | None, state: PassState
    ) -> tuple[mi.TensorXf, PassState]:
        """There is none. Raises PathreplayError."""
        raise PathreplayError(whole_pictures(self.name))

    def state_dict(self) -> dict[str, np.ndarray]:
        return {}

    def load_state_dict(self, scene: mi.Scene, learned: Learned) -> None:
        require_nothing_learned(learned)

    def options(self) -> dict[str, Any]:
        return {}


def stateful(integrator: mi.Integrator) -> StatefulIntegrator:
    """The integrator itself if it is one of ours, else as such a one."""
    return integrator if isinstance(integrator, StatefulIntegrator) else Stateless(integrator)


def whole_pictures(name: str) -> str:
    """Why an integrator of this class sweeps no pixels, with the way out."""
    return f"{name} renders whole pictures; take the integrator 'pathreplay'"


def require_nothing_learned(learned: Learned) -> None:
    """Raise PathreplayError where an integrator that learns nothing is to go on with what was learned."""
    if learned:
        raise PathreplayError(
            "The checkpoint holds what another integrator has learned of media; set the config's 'integrator' "
            "back, or start a new run"
        )
