"""Base class of the integrators: common properties, Mitsuba's interface, and the steps of a pass."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import reduce
from operator import add
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import Unreached
from pathreplay.adjoint.baseline import Baseline
from pathreplay.adjoint.primal import primal
from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Seed, Which
from pathreplay.integrators.film.image import splat
from pathreplay.integrators.interior import Interior, differentiable_radiance
from pathreplay.integrators.lifetimes import careful, is_recording
from pathreplay.integrators.parts import parts, summed
from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.properties import HIDE_EMITTERS, MAX_DEPTH, PATHS, RR_DEPTH, flag, whole_number
from pathreplay.integrators.reach import unreached_note
from pathreplay.integrators.scene_facts import SceneFacts, facts_of
from pathreplay.integrators.stateful import Unlearned
from pathreplay.integrators.term import Term, TermResult
from pathreplay.platform.registration import mitsuba_integrator
from pathreplay.transport.facts.nodes import may_have_gradients, nodes_of, with_gradients
from pathreplay.transport.facts.traits import Tables
from pathreplay.transport.motion import path_moves, weights_vary
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig

UNBOUNDED = 0xFFFFFFFF


def _sum(total: mi.TensorXf | None, image: mi.TensorXf, share: float) -> mi.TensorXf:
    """Add the weighted image of a part of a pass to ``total``, and evaluate the sum before the next part begins."""
    if share == 1:
        return image
    total = image * share if total is None else total + image * share
    dr.eval(total)
    return total


@contextmanager
def reached(view: Pass, zero_is_error: bool = False) -> Iterator[None]:
    """Context of a gradient pass: explain `Unreached` errors, and suppress them if the gradient is zero by design.

    The gradient is zero by design if only other cameras have gradients (see `unreached_note`). With ``zero_is_error``,
    the error is also raised in this case. Virtual calls reach the objects of all scenes, so a pass may raise no error
    because another scene has gradients. The error is then raised after the pass, if no object of this scene has
    gradients.
    """
    try:
        yield
        if not any(map(may_have_gradients, nodes_of(view.scene) | nodes_of(view.sensor) | {view.sensor})):
            raise Unreached("no parameter of the scene has gradients")
    except Unreached as error:
        note = unreached_note(view.scene, view.sensor)
        if note or zero_is_error:
            raise Unreached(note or str(error)) from error


class PathIntegrator(Unlearned):
    """Base of all integrators of this package: a template that `on_base` combines with Mitsuba's base class.

    Properties: see `PATHS`.
    Subclasses define ``name`` and ``properties`` (of the plugin), ``attach`` (see `TraceConfig`) and the term
    ``interior``. Raises PathreplayError for unusable properties and in polarised variants.

    Methods whose names end in ``_pass`` take a `PassState`. Mitsuba's methods have no such parameter; they call `begin`
    before each pass and `keep` after it.
    """

    name, properties = "", PATHS
    attach = "none"
    uses_sobol = False  # whether Owen-scrambled Sobol samples replace independent samples
    boundary = "none"  # boundary terms that are estimated
    interior: Interior
    max_depth: int  # this member and the next belong to Mitsuba's integrator
    rr_depth: int

    def __init__(self, props: mi.Properties) -> None:
        if mi.is_polarized:
            raise PathreplayError(
                f"{self.name}: variant {mi.variant()!r} tracks polarisation, which is not supported: "
                f"use {mi.variant().replace('_polarized', '')!r}"
            )
        # Mitsuba reads these three properties as well, but does not reject all invalid values.
        whole_number(props, self.name, MAX_DEPTH, lowest=0, unbounded=True)
        whole_number(props, self.name, RR_DEPTH, lowest=1)
        hide_emitters = flag(props, self.name, HIDE_EMITTERS)
        mitsuba_integrator().__init__(self, props)
        self.hide_emitters = hide_emitters
        self.warned: set[str] = set()  # notes about the scene of the last pass that were logged or silenced
        self._silenced: set[str] = set()
        self._warned_of: WeakKeyDictionary[SceneFacts, set[str]] = WeakKeyDictionary()  # `warned` of each scene
        # Lookup tables of the last rendered scene, for functions of the user that `dr.freeze` records.
        self.tables: Tables | None = None

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
        """Render an image, without derivatives: see Mitsuba's ADIntegrator. `mi.render` is differentiable."""
        if not develop:
            raise PathreplayError(f"{self.name}: develop = False is not supported: leave it out")
        return self.image_pass(self.pass_of(scene, sensor, seed, spp), PathIntegrator.begin(self, scene))

    def render_forward(
        self, scene: mi.Scene, params: object, sensor: Which = 0, seed: Seed = 0, spp: int = 0
    ) -> mi.TensorXf:
        """Compute the tangent of the image from the tangents of the parameters: see Mitsuba's ADIntegrator.

        The parameters must carry their tangents already. If the parameters are computed from another variable ``x``,
        first call ``dr.set_grad`` on ``x``, and then propagate the tangents with
        ``dr.forward(x, dr.ADFlag.ClearEdges)``. Logs the same warnings as `render_backward`.
        """
        tangent, state = self.tangent_pass(self.pass_of(scene, sensor, seed, spp), self.begin(scene))
        self.keep(scene, state)
        return tangent

    def render_backward(
        self, scene: mi.Scene, params: object, grad_in: mi.TensorXf, sensor: Which = 0, seed: Seed = 0, spp: int = 0
    ) -> None:
        """Back-propagate an image gradient into the parameters: see Mitsuba's ADIntegrator.

        Warns if a part of the gradient was not finite and was left out, or if moving edges are not differentiated.
        Raises PathreplayError if no parameter with gradients reaches the paths, unless all parameters with gradients
        belong to other cameras.
        """
        passes = parts(self.pass_of(scene, sensor, seed, spp))
        with summed(scene, passes) as add_up:
            for part in passes:
                self.keep(scene, self.gradient_pass(part, grad_in, self.begin(scene)))
                add_up()

    def image_pass(self, view: Pass, state: PassState) -> mi.TensorXf:
        """Render the image of a pass, detached."""
        total = None
        for part in parts(view):
            with self._pass_context():
                total = _sum(total, self._image(part, self._trace_config(part.scene, part.sensor, state)), part.share)
        assert total is not None
        return total

    def tangent_pass(self, view: Pass, state: PassState) -> tuple[mi.TensorXf, PassState]:
        """Compute the tangent of the image from the tangents of the parameters: see `render_forward`."""
        tangent = None
        for part in parts(view):
            with self._pass_context():
                part, trace, terms = self._planned(part, state)
                learned = self._learned(part, trace, state)
                if part.flow is not None:
                    part.flow.carry_tangents()
                result = self._forward(terms, part, trace, learned)
                assert result.image is not None
                tangent = _sum(tangent, result.image, part.share)
            self._log_notes(part, trace, result)
            state = state.after(result)
        assert tangent is not None
        return tangent, state

    def gradient_pass(self, view: Pass, grad_in: mi.TensorXf, state: PassState) -> PassState:
        """Back-propagate an image gradient into the parameters: see `render_backward`."""
        passes = parts(view)
        with reached(view), summed(view.scene, passes) as add_up:
            for part in passes:
                # Isolation preserves the AD graph from the parameters to derived scene values for the next pass.
                with self._pass_context(), dr.isolate_grad():
                    part, trace, terms = self._planned(part, state)
                    learned = self._learned(part, trace, state)
                    weighted = grad_in if part.share == 1 else grad_in * part.share
                    # All terms share the film flow. Isolation postpones back-propagation through the flow until all
                    # terms are done.
                    with dr.isolate_grad():
                        result = self._backward(terms, part, trace, weighted, learned)
                self._log_notes(part, trace, result)
                state = state.after(result)
                add_up()
        return state

    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        active: mi.Bool | bool = True,
        **_: object,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float], None]:
        """Estimate radiance along rays that start outside of media, for callers without a sensor (`aov`, `moment`).

        If gradients are not suspended, AD differentiates the result; `differentiable_radiance` states what is left out.
        A warning reports moving edges, which are not differentiated. Only the primal ``mode`` is supported. Raises
        PathreplayError for the other modes.
        """
        if mode != dr.ADMode.Primal:
            raise PathreplayError(f"{self.name}: sample() is not differentiated: use mi.render, or render_backward")
        state = PathIntegrator.begin(self, scene)
        trace, start = self._trace_config(scene, None, state), CameraStart(ray, sampler, mi.Bool(active))
        inputs = ray.o, ray.d, with_gradients(scene)
        if not dr.grad_enabled(inputs):
            with dr.suspend_grad():
                return *primal(trace, start), [], None

        def tell(result: TermResult) -> None:
            self._log_sample_notes(trace)
            self.keep(scene, state.after(result))

        return *differentiable_radiance(self.interior, trace, start, inputs, tell), [], None

    def begin(self, scene: mi.Scene) -> PassState:
        """Create the state of a pass over a scene.

        While `dr.freeze` records a function of the user, media cannot be inspected. The state then only contains the
        lookup tables of the scene.
        """
        with careful():
            facts = facts_of(scene)
            self.warned = self._warned_of.setdefault(facts, set(self._silenced))
            if is_recording():
                return PassState(facts.recorded_tables(self.tables, edges=False))
            facts.enclose(scene)
            self.tables = facts.tables()
            return PassState(self.tables, facts.branches())

    def keep(self, scene: mi.Scene, state: PassState) -> None:
        """Log warnings about the passes since `begin`, and update the learned state from their results."""

    def _image(self, part: Pass, trace: TraceConfig) -> mi.TensorXf:
        """Render the image of a pass (height x width x channels)."""
        rays = part.rays()
        return splat(part, rays, *primal(trace, rays.start))

    def _forward(self, terms: tuple[Term, ...], part: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        return reduce(add, [term.forward(part, trace, learned) for term in terms])

    def _backward(
        self, terms: tuple[Term, ...], part: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None
    ) -> TermResult:
        return reduce(add, [term.backward(part, trace, grad_in, learned) for term in terms])

    def _planned(self, view: Pass, state: PassState) -> tuple[Pass, TraceConfig, tuple[Term, ...]]:
        """Return the gradient pass with its film flow, its trace configuration, and the terms of the gradient."""
        return view, self._trace_config(view.scene, view.sensor, state), self.terms

    def _learned(self, view: Pass, trace: TraceConfig, state: PassState) -> Baseline | None:
        """Return the control variate that this pass may use, or None."""
        return None

    def _log_notes(self, view: Pass, trace: TraceConfig, result: TermResult) -> None:
        """Log notes about a pass after its kernels have been launched."""

    def _log_sample_notes(self, trace: TraceConfig) -> None:
        """Log notes about wrong or missing derivatives of the result of `sample`."""

    def pass_of(self, scene: mi.Scene, sensor: Which, seed: Seed, spp: int) -> Pass:
        """Create a pass from the arguments of Mitsuba's methods."""
        if not isinstance(scene, mi.Scene) or not isinstance(self, mi.Integrator):
            raise PathreplayError(
                f"{self.name}: scene or integrator belongs to another variant than the active one, "
                f"{mi.variant()!r}: load it anew, or set its variant"
            )
        return Pass.of(scene, sensor, seed, spp, self.uses_sobol)

    @contextmanager
    def _pass_context(self) -> Iterator[None]:
        """Enter the context of a pass (see `careful`), with gradients suspended."""
        with careful(), dr.suspend_grad():
            yield

    def _trace_config(self, scene: mi.Scene, sensor: mi.Sensor | None, state: PassState | None = None) -> TraceConfig:
        """Build the trace configuration; ``sensor`` may be inside a medium. If ``state`` is None, create a state."""
        facts, state = facts_of(scene), PathIntegrator.begin(self, scene) if state is None else state
        return TraceConfig(
            scene=scene,
            traits=facts.traits(state.tables),
            media=facts.media(sensor, state.branches),  # type: ignore[arg-type]
            attach=self.attach,
            hide_emitters=self.hide_emitters,
            max_depth=self.max_depth,
            rr_depth=self.rr_depth,
        )

    def is_reached(self, scene: mi.Scene, sensor: Which = 0) -> bool:
        """Return whether a parameter with gradients reaches the paths of a sensor. With media, the result is True.

        Dr.Jit traces the computation of one path step, but evaluates nothing.
        """
        view = Pass.of(scene, sensor, 0, 1)
        with self._pass_context():
            trace, start = self._trace_config(scene, view.sensor), view.rays().start
            if trace.media is not None or trace.traits.lights_vary or not dr.flag(dr.JitFlag.SymbolicCalls):
                return True
            at = PathState.begin(trace, start).at
            return path_moves(trace, start, at) or weights_vary(trace, at)

    def is_recordable(self, has_media: bool) -> bool:
        return False

    def silence(self, notes: Iterable[str]) -> None:
        for some in (self._silenced, self.warned, *self._warned_of.values()):
            some.update(notes)

    def _described(self, **more: object) -> str:
        depth = -1 if self.max_depth == UNBOUNDED else self.max_depth
        values = {"max_depth": depth, "rr_depth": self.rr_depth, **more}
        return f"{type(self).__name__}[{', '.join(f'{key} = {value}' for key, value in values.items())}]"

    def to_string(self) -> str:
        return self._described()
