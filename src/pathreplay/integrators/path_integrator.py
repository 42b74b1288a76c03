"""Base of our integrators: common properties, Mitsuba's interface, and the rules of each pass."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import reduce
from operator import add
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.adjoint.autodiff import Unreached
from pathreplay.adjoint.baseline import Baseline
from pathreplay.adjoint.primal import primal
from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Seed, Which
from pathreplay.integrators.interior import image
from pathreplay.integrators.lifetimes import careful, is_recording
from pathreplay.integrators.parts import parts, summed
from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.properties import flag, whole_number
from pathreplay.integrators.reach import unreached_note
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import Learned, require_nothing_learned, whole_pictures
from pathreplay.integrators.term import Term, TermResult
from pathreplay.platform.registration import mitsuba_integrator
from pathreplay.transport.facts.traits import Tables
from pathreplay.transport.motion import path_moves, weights_vary
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig

UNBOUNDED = 0xFFFFFFFF


def _sum(total: Any, image: Any, share: float) -> Any:
    """Weighted sum of the images of split passes, each evaluated before the next begins."""
    if share == 1:
        return image
    total = image * share if total is None else total + image * share
    dr.eval(total)
    return total


@contextmanager
def reached(scene: mi.Scene, sensor: Which, zero_is_told: bool = False) -> Iterator[None]:
    """Within this block, which differentiates, a gradient that is plainly zero is no error: see `unreached_note`.

    Unless ``zero_is_told``: then it is one, too.
    """
    try:
        yield
    except Unreached as error:
        note = unreached_note(scene, Pass.of(scene, sensor, 0, 1).sensor)
        if note or zero_is_told:
            raise Unreached(note or str(error)) from error


class PathIntegrator:
    """A template of an integrator (see `on_base`), for those of ours.

    Properties ``max_depth`` (6; -1 = unbounded), ``rr_depth`` (5) and ``hide_emitters`` (False).
    Classes below have a ``name`` (the plugin's), ``attach`` (as `TraceConfig` has it) and the term ``interior``. Raises
    PathreplayError for unusable properties and in polarised variants.

    Methods whose names end in ``_pass`` take a `PassState`. Mitsuba's methods, which have no such parameter, `begin` a
    state for each pass and `keep` its results.
    """

    name = ""
    attach = "none"
    even = False  # whether even numbers take the place of independent ones
    boundary = "none"  # which boundary terms are estimated
    baseline: Any = None  # what was learned
    interior: Term
    max_depth: int  # these are Mitsuba's
    rr_depth: int
    skip_area_emitters: Callable[..., mi.PreliminaryIntersection3f]

    def __init__(self, props: mi.Properties) -> None:
        if mi.is_polarized:
            raise PathreplayError(
                f"{self.name}: variant {mi.variant()!r} tracks polarisation, which is not supported: "
                f"use {mi.variant().replace('_polarized', '')!r}"
            )
        # All three are Mitsuba's, too, which takes what it is given or says less.
        whole_number(props, self.name, "max_depth", 6, lowest=0, unbounded=True)
        whole_number(props, self.name, "rr_depth", 5, lowest=1)
        hide_emitters = flag(props, self.name, "hide_emitters", False)
        mitsuba_integrator().__init__(self, props)
        self.hide_emitters = hide_emitters
        self.warned: set[str] = set()  # notes that were logged or silenced
        self.tables: Tables | None = None  # of the scene that was rendered last: there a user's `dr.freeze` finds them

    @property
    def terms(self) -> tuple[Term, ...]:
        """Terms that add up to the gradient."""
        return (self.interior,)

    def render(
        self,
        scene: mi.Scene,
        sensor: Which = 0,
        seed: Seed = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render an image: see Mitsuba's ADIntegrator. Nothing is differentiated: use `mi.render` for that."""
        if not develop:
            raise PathreplayError(f"{self.name}: develop = False is not supported: leave it out")
        return self.image_pass(self.pass_of(scene, sensor, seed, spp), PathIntegrator.begin(self, scene))

    def render_forward(
        self, scene: mi.Scene, params: object, sensor: Which = 0, seed: Seed = 0, spp: int = 0
    ) -> mi.TensorXf:
        """Tangent of the image along those of the parameters: see Mitsuba's ADIntegrator.

        The parameters must carry their tangents already: after ``dr.set_grad`` on something that they are computed
        from, propagate with ``dr.forward(x, dr.ADFlag.ClearEdges)``. Warns as `render_backward` does.
        """
        tangent = None
        for part in parts(self.pass_of(scene, sensor, seed, spp)):
            state = self.begin(scene)
            with self._passing():
                part, trace, terms = self._planned(part, state)
                learned = self._learned(part, trace, state)
                if part.flow is not None:
                    part.flow.carry_tangents()
                found = reduce(add, [term.forward(part, trace, learned) for term in terms])
                tangent = _sum(tangent, found.image, part.share)
            self._told(part, trace, found)
            self.keep(scene, state.after(found))
        return tangent

    def render_backward(
        self, scene: mi.Scene, params: object, grad_in: mi.TensorXf, sensor: Which = 0, seed: Seed = 0, spp: int = 0
    ) -> None:
        """Back-propagate an image gradient into the parameters: see Mitsuba's ADIntegrator.

        Warns of what terms tell: a part of the gradient was not finite and had to be left out, edges move. Raises
        PathreplayError where no parameter with gradients reaches the paths, unless all are those of other cameras.
        """
        of_parts = parts(self.pass_of(scene, sensor, seed, spp))
        with summed(scene, of_parts) as add_up:
            for part in of_parts:
                self.keep(scene, self.gradient_pass(part, grad_in, self.begin(scene)))
                add_up()

    def image_pass(self, view: Pass, state: PassState) -> mi.TensorXf:
        """Render the image of a pass, detached."""
        made = None
        for part in parts(view):
            with self._passing():
                made = _sum(made, image(part, self._walk(part.scene, part.sensor, state)), part.share)
        return made

    def gradient_pass(self, view: Pass, grad_in: mi.TensorXf, state: PassState) -> PassState:
        """Back-propagate an image gradient into the parameters: see `render_backward`."""
        of_parts = parts(view)
        with reached(view.scene, view.sensor), summed(view.scene, of_parts) as add_up:
            for part in of_parts:
                # Isolated, so that what the scene computes from its parameters can be differentiated in the next pass.
                with self._passing(), dr.isolate_grad():
                    part, trace, terms = self._planned(part, state)
                    learned = self._learned(part, trace, state)
                    wanted = grad_in if part.share == 1 else grad_in * part.share
                    with dr.isolate_grad():  # of terms, one by one, from the flow that they share
                        found = reduce(add, [term.backward(part, trace, wanted, learned) for term in terms])
                self._told(part, trace, found)
                state = state.after(found)
                add_up()
        return state

    def sample(
        self, mode: dr.ADMode, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool = True, **_: Any
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float], Any]:
        """Radiance along rays, for those who have rays and no sensor, such as Mitsuba's `aov`: they start in no medium.

        Derivatives are those of passes: see `render_forward` and `render_backward`. Raises PathreplayError for them.
        """
        if mode != dr.ADMode.Primal:
            raise PathreplayError(f"{self.name}: sample() is not differentiated: use mi.render, or render_backward")
        return *primal(self._walk(scene, None), CameraStart(ray, sampler, mi.Bool(active))), [], None

    def begin(self, scene: mi.Scene) -> PassState:
        """Make the state of a pass over a scene.

        In a recording by a user's `dr.freeze` it holds what a recording can find out.
        """
        with careful():
            facts = facts_of(scene)
            if is_recording():
                return PassState(facts.recorded_tables(self.tables, edges=False))
            self.tables = facts.tables()
            return PassState(self.tables, facts.branches())

    def keep(self, scene: mi.Scene, state: PassState) -> None:
        """Report the results of passes whose state came from `begin`, and learn from them."""

    def _planned(self, view: Pass, state: PassState) -> tuple[Pass, TraceConfig, tuple[Term, ...]]:
        """A gradient pass as terms see it, how it walks, and the terms that it adds up."""
        return view, self._walk(view.scene, view.sensor, state), self.terms

    def _learned(self, view: Pass, trace: TraceConfig, state: PassState) -> Baseline | None:
        """Control variate that this pass may use."""
        return None

    def _told(self, view: Pass, trace: TraceConfig, found: TermResult) -> None:
        """Log notes about a pass, after its kernels were launched."""

    def pass_of(self, scene: mi.Scene, sensor: Which, seed: Seed, spp: int) -> Pass:
        """Make a pass from the arguments of Mitsuba's methods."""
        self._require_active(scene)
        return Pass.of(scene, sensor, seed, spp, self.even)

    def _require_active(self, scene: mi.Scene) -> None:
        """Raise PathreplayError if scene or integrator are none of the active variant."""
        if not isinstance(scene, mi.Scene) or not isinstance(self, mi.Integrator):
            raise PathreplayError(
                f"{self.name}: scene or integrator belongs to another variant than the active one, "
                f"{mi.variant()!r}: load it anew, or set its variant"
            )

    @contextmanager
    def _passing(self) -> Iterator[None]:
        """Context of a pass, with gradients suspended by default: see `careful`."""
        with careful(), dr.suspend_grad():
            yield

    def _walk(self, scene: mi.Scene, sensor: mi.Sensor | None, state: PassState | None = None) -> TraceConfig:
        """Options and facts of a trace; ``sensor`` may be inside a medium. Default ``state``: the scene's."""
        facts, state = facts_of(scene), PathIntegrator.begin(self, scene) if state is None else state
        return TraceConfig(
            scene=scene,
            traits=facts.traits(state.tables),
            media=facts.media(sensor, state.branches),  # type: ignore[arg-type]
            attach=self.attach,
            hide_emitters=self.hide_emitters,
            max_depth=self.max_depth,
            rr_depth=self.rr_depth,
            skip_area_emitters=self.skip_area_emitters,
        )

    def is_reached(self, scene: mi.Scene, sensor: Which = 0) -> bool:
        """Whether a parameter with gradients reaches the paths of a sensor; where there are media, this is assumed.

        Traces one step and evaluates nothing.
        """
        view = Pass.of(scene, sensor, 0, 1)
        with self._passing():
            trace, start = self._walk(scene, view.sensor), view.rays().start
            if trace.media is not None or trace.traits.lights_vary or not dr.flag(dr.JitFlag.SymbolicCalls):
                return True
            at = PathState.begin(trace, start).at
            return path_moves(trace, start, at) or weights_vary(trace, at)

    def is_recordable(self, has_media: bool) -> bool:
        """See `StatefulIntegrator`."""
        return False

    def why_no_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> str:
        """Return why `pixel_pass` cannot be used, with the remedy; "" if it can."""
        return whole_pictures(type(self).__name__)

    def pixel_pass(
        self, view: Pass, derivative: tuple[mi.TensorXf, mi.TensorXf], pixels: mi.UInt32 | None, state: PassState
    ) -> tuple[mi.TensorXf, PassState]:
        """Not available. Raises PathreplayError."""
        raise PathreplayError(self.why_no_pixel_sweep(view.scene))

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return what gradient passes have learned: nothing."""
        return {}

    def load_state_dict(self, scene: mi.Scene, learned: Learned) -> None:
        """Restore the result of `state_dict`. Raises PathreplayError unless it is empty."""
        require_nothing_learned(learned)

    def options(self) -> dict[str, Any]:
        """See `StatefulIntegrator`."""
        return {}

    def silence(self, notes: Iterable[str]) -> None:
        """Do not log these notes."""
        self.warned.update(notes)

    def _described(self, **more: Any) -> str:
        depth = -1 if self.max_depth == UNBOUNDED else self.max_depth
        values = {"max_depth": depth, "rr_depth": self.rr_depth, **more}
        return f"{type(self).__name__}[{', '.join(f'{key} = {value}' for key, value in values.items())}]"

    def to_string(self) -> str:
        return self._described()
