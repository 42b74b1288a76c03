"""The `pathreplay` integrator plugin: reads properties, sums gradient terms, keeps learned state, and logs warnings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import reduce
from operator import add
from weakref import ReferenceType, ref

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.adjoint.autodiff import Unreached
from pathreplay.adjoint.baseline import Baseline, BaselineState
from pathreplay.adjoint.ray_jacobian import Recovery
from pathreplay.adjoint.record import MAX_DEPTH
from pathreplay.errors import PathreplayError
from pathreplay.integrators import properties as declared
from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.camera_pass import Pass, Seed, Which
from pathreplay.integrators.diagnostics import (
    COST_OF_EDGES,
    USED_BEFORE,
    camera_doubts,
    doubts,
    lost_note,
    missing_edges,
    offset_note,
    particle_doubts,
    particle_notes,
    sample_doubts,
    sun_note,
)
from pathreplay.integrators.film.camera_flow import CameraFlow
from pathreplay.integrators.film.motion import FilmMotion
from pathreplay.integrators.film.pixel_passes import obstacle, pixel_loss, scatter_rows
from pathreplay.integrators.film.surface_flow import SurfaceFlow, can_follow
from pathreplay.integrators.interior import PathReplay
from pathreplay.integrators.lifetimes import is_recording
from pathreplay.integrators.particles.boundary import ParticleBoundary
from pathreplay.integrators.particles.term import ParticleTerm
from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.path_integrator import UNBOUNDED, PathIntegrator, reached
from pathreplay.integrators.properties import choice, deviation, whole_number
from pathreplay.integrators.scene_facts import SceneFacts, facts_of
from pathreplay.integrators.term import Term, TermResult
from pathreplay.transport.vertex import TraceConfig
from pathreplay.types import Json

#: Old property names of 0.1.0 and their current names.
RENAMED = {
    "branch": "null_branching",
    "driver": "adjoint",
    "edge_spp": "boundary_spp",
    "edges": "boundary",
    "noise": "jacobian_noise",
    "numbers": "sampling",
}
EDGES = "edges"
"""Entry of `warned` that suppresses further notes about moving edges."""


def _interior(name: str, props: mi.Properties, max_depth: int) -> PathReplay:
    """Build the interior term from the properties. Raises PathreplayError for unusable properties."""
    for old, new in RENAMED.items():
        if old in props:
            raise PathreplayError(f"{name}: there is no property '{old}': it is called '{new}' now")
    adjoint = choice(props, name, declared.ADJOINT)
    if adjoint == "recorded" and max_depth > MAX_DEPTH:
        depth = "-1 (unbounded)" if max_depth == UNBOUNDED else max_depth
        raise PathreplayError(
            f"{name}: max_depth = {depth} is more than adjoint = 'recorded' can hold ({MAX_DEPTH}): "
            "use adjoint = 'replay', which has no limit"
        )
    branch: str | bool = choice(props, name, declared.NULL_BRANCHING)
    recovery = Recovery(noise=deviation(props, name, declared.JACOBIAN_NOISE))
    auto = adjoint == "auto"
    if auto:
        adjoint = "recorded" if max_depth <= MAX_DEPTH else "replay"
    return PathReplay(adjoint, auto, branch, recovery)


class PathReplayIntegrator(PathIntegrator):
    """Differentiable path tracer for surfaces and media.

    Properties: see `PATH_REPLAY` in `integrators/properties.py`.

    ``boundary = 'auto'`` means ``all`` if edges move (see `edges_move`) and the boundary term can be computed.
    Otherwise, ``auto`` means ``none``. The boundary term cannot be computed if ``attach`` is not ``delta``, if the
    sensor is of type ``batch``, or if the scene contains a shape that `Boundary.obstacle` names. With ``auto``, a
    warning reports such a sensor or shape. If no edge moves, no boundary term is computed for any ``boundary``.

    Gradients of media use a control variate. The integrator learns the control variate from earlier gradient passes
    with other seeds. With ``null_branching``, an additional path continues from a null collision, as if the path had
    been scattered there. Without null branching, the gradient with respect to extinction is wrong where extinction is
    zero. With ``null_branching = 'auto'``, paths branch if the extinction has gradients, and varies in space or is
    zero. In these cases, null branching usually also reaches a given noise level in less time.

    The integrator does not differentiate visibility that ``boundary`` leaves out. With ``attach='none'``, it does not
    differentiate the motion of shapes, cameras and directions. Without ``null_branching``, it does not differentiate
    extinction where the extinction is zero. With ``adjoint='replay'``, it does not differentiate weights that are
    exactly zero.

    Raises PathreplayError for unknown or unusable properties and in polarised variants.
    """

    name, properties = "pathreplay", declared.PATH_REPLAY
    without_light_paths = "take caustics = 'camera'"  # remedy, for errors about unsupported light paths
    interior: PathReplay

    def __init__(self, props: mi.Properties) -> None:
        PathIntegrator.__init__(self, props)
        self.attach = choice(props, self.name, declared.ATTACH)
        self.moves_rays = self.attach != "none"  # whether parameters that move cameras and emitters receive gradients
        self.interior = _interior(self.name, props, self.max_depth)
        self.adjoint, self.null_branching = self.interior.adjoint, self.interior.branch
        self.uses_sobol = choice(props, self.name, declared.SAMPLING) == "sobol"
        self.boundary = self._declared_boundary = choice(props, self.name, declared.BOUNDARY)
        self.boundary_spp = whole_number(
            props, self.name, declared.BOUNDARY_SPP, lowest=0, kind="number of segments per pixel"
        )
        if self.boundary == "auto" and self.attach != "delta":
            self.boundary = "none"
        if self.boundary != "none" and self.attach != "delta":
            raise PathreplayError(
                f"{self.name}: boundary = '{self.boundary}' with attach = '{self.attach}': boundary terms need "
                "attach = 'delta': use that, or boundary = 'none'"
            )
        split = self.name == "pathreplay" and choice(props, self.name, declared.CAUSTICS) == "particles"
        self.particles: ParticleTerm | None = ParticleTerm(self.max_depth, caustics=True) if split else None
        self.baseline: tuple[ReferenceType[SceneFacts], BaselineState] | None = None  # a scene; state learned from it

    def _light_terms(self, view: Pass, trace: TraceConfig) -> tuple[Term, ...]:
        """Return the terms of light paths; empty if there are none.

        The boundary term is left out as the boundary term of camera paths is (see `_needs_edges`), and with
        ``boundary = 'primary'``.
        """
        if self.particles is None:
            return ()
        edges = ParticleBoundary(self.particles, self.boundary_spp)
        if self.boundary in ("none", "primary") or not self._needs_edges(view, edges.move(view, trace)):
            return (self.particles,)
        Boundary.require(view, self.boundary_spp)
        return self.particles, edges

    @property
    def terms(self) -> tuple[Term, ...]:
        """The interior and boundary terms. `_planned` may add a term for the motion of film positions."""
        if self.boundary == "none":
            return (self.interior,)
        return self.interior, Boundary(inner=self.boundary != "primary", spp=self.boundary_spp)

    def _image(self, part: Pass, trace: TraceConfig) -> mi.TensorXf:
        """Render the image of camera paths and, if there are any, light paths."""
        lit = None if self.particles is None else self.particles.image(part, trace)
        image = PathIntegrator._image(self, self._camera_view(part), trace)
        return image if lit is None else image + lit

    def _camera_view(self, view: Pass) -> Pass:
        """Return the pass that generates the camera rays. In this class, it is the pass ``view`` itself."""
        return view

    def _trace_config(self, scene: mi.Scene, sensor: mi.Sensor | None, state: PassState | None = None) -> TraceConfig:
        """Build the trace configuration of camera paths, which omit caustics if light paths estimate caustics."""
        trace = PathIntegrator._trace_config(self, scene, sensor, state)
        return trace if self.particles is None else replace(trace, without_caustics=True)

    def _forward(self, terms: tuple[Term, ...], part: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        if self.particles is None:
            return PathIntegrator._forward(self, terms, part, trace, learned)
        light = [term.forward(part, trace, learned) for term in self._light_terms(part, trace)]
        camera = [term.forward(self._camera_view(part), trace, learned) for term in terms]
        return reduce(add, camera + light)

    def _backward(
        self, terms: tuple[Term, ...], part: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None
    ) -> TermResult:
        """Back-propagate through all terms. Raises `Unreached` only if no parameter reaches camera or light paths."""
        if self.particles is None:
            return PathIntegrator._backward(self, terms, part, trace, grad_in, learned)
        unreached, results = [], []
        for some, view in ((self._light_terms(part, trace), part), (terms, self._camera_view(part))):
            try:
                results += [term.backward(view, trace, grad_in, learned) for term in some]
            except Unreached as error:
                unreached.append(error)
        if not results:
            raise unreached[0]
        return reduce(add, results)

    def _planned(self, view: Pass, state: PassState, follow: bool = True) -> tuple[Pass, TraceConfig, tuple[Term, ...]]:
        """Return the pass with its film flow, its trace configuration, and the terms of its gradient.

        A film flow is a velocity field of film positions (see `FilmFlow`). If the pass has one, the terms include
        `FilmMotion`, and the other terms only differentiate motion that the flow does not contain. With ``follow``, the
        flow may follow visible surfaces (`SurfaceFlow`).

        The boundary term is left out if no edge moves, or if ``boundary = 'auto'`` and the term cannot be computed. The
        interior term is left out if `FilmMotion` is the whole derivative.

        Raises PathreplayError, before any kernel is launched, if the boundary term is needed and cannot be computed.
        """
        view, trace, terms = PathIntegrator._planned(self, view, state)
        if self.boundary == "none":
            return view, trace, terms
        view = replace(view, flow=CameraFlow.of(trace, view.sensor))
        needs_edges = self._needs_edges(view, Boundary.move(view, trace))
        if needs_edges:
            Boundary.require(view, self.boundary_spp)
        if needs_edges and follow and self._may_follow(view, trace):
            trace = Boundary.informed(view, trace)
            view = replace(view, flow=SurfaceFlow.of(view.sensor, trace))
        motion: tuple[Term, ...] = () if view.flow is None else (FilmMotion(view.flow),)
        if not needs_edges:
            terms = tuple(term for term in terms if term is self.interior or not isinstance(term, Boundary))
            return view, trace, motion if view.flow is not None and view.flow.is_all else (*terms, *motion)
        if not state.is_complete:
            tables = facts_of(view.scene).recorded_tables(state.tables, edges=True)
            trace = replace(trace, traits=replace(trace.traits, tables=tables))
        if self.boundary != "primary":
            fog, facts = trace.media is not None, facts_of(view.scene)
            holds = fog and not (facts.has_seams or facts.has_wrapping_textures)
            trace = replace(trace, may_slide=not fog, holds_collisions=holds)
        return view, trace, (*terms, *motion)

    def _may_follow(self, view: Pass, trace: TraceConfig) -> bool:
        """Return whether film positions may follow visible surfaces, which requires that all edges can be sampled."""
        if self.boundary == "primary" or not can_follow(trace, view.sensor):
            return False
        facts = facts_of(view.scene)
        return not (facts.has_seams or facts.has_steps)

    def _needs_edges(self, view: Pass, move: bool) -> bool:
        """Return whether edges ``move``. With ``boundary = 'auto'``, return False if no boundary term can be computed.

        With ``auto``, log either that the boundary terms are costly, or why they are left out.
        """
        if not move:
            return False
        why = Boundary.obstacle(view) if self.boundary == "auto" else ""
        if why:
            self._warn_once(f"{why}; they are left out here")
        elif self.boundary == "auto" and EDGES not in self.warned:
            self._warn_once(COST_OF_EDGES)
        if not why and self.boundary != "primary" and (note := offset_note(view.scene.bbox())):
            self._warn_once(note)
        return not why

    def is_recordable(self, has_media: bool) -> bool:
        """Return True, because rendering reads no results on the host."""
        return True

    def supports_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> bool:
        """Return whether `render_value_and_grad` can be used, for all pixels or for a subset (``some``)."""
        return not self.why_no_pixel_sweep(scene, sensor, spp, some)

    def why_no_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> str:
        """Return why `render_value_and_grad` cannot be used, with the remedy; "" if it can (see also `obstacle`)."""
        view = Pass.of(scene, sensor, 0, spp)
        if self.adjoint != "recorded":
            return f"adjoint = '{self.adjoint}' records no paths; use 'recorded'"
        if facts_of(scene).has_media:
            return "the scene has media; leave them out"
        if self.particles is not None:
            return f"light paths contribute to other pixels; {self.without_light_paths}"
        return obstacle(view.sensor, self.max_depth, view.spp, some) or ("" if some else self._flow_obstacle(view))

    def _flow_obstacle(self, view: Pass) -> str:
        """Return why `pixel_sweep` cannot compute the pass if film positions follow surfaces (`SurfaceFlow`), or ""."""
        if self.boundary in ("none", "primary"):
            return ""
        with self._pass_context():
            trace = self._trace_config(view.scene, view.sensor)
            follows = Boundary.move(view, trace) and not Boundary.obstacle(view) and self._may_follow(view, trace)
        return "film positions follow moving surfaces; take boundary = 'none'" if follows else ""

    def render_value_and_grad(
        self,
        scene: mi.Scene,
        offset: mi.TensorXf,
        slope: mi.TensorXf,
        sensor: Which = 0,
        seed: Seed = 0,
        spp: int = 0,
        pixels: mi.UInt32 | None = None,
    ) -> mi.TensorXf:
        """Render an image and back-propagate a loss with derivative offset + slope · image, in one pass.

        The paths of a pixel form independent sets (see `pixel_sweep`). In the interior term, the loss derivative for a
        path is evaluated at the mean radiance of all paths in other sets. In the boundary term, the loss derivative is
        evaluated at the image. The documentation of `sweep` states what is not differentiated.

        Warns like `render_backward`. Requires `supports_pixel_sweep`.

        Args:
            scene: the scene, without media.
            offset: constant part of the loss derivative, in the shape of the returned image.
            slope: linear part of the loss derivative, in the shape of the returned image.
            sensor: a sensor, or its index in the scene.
            seed: seed of the random numbers.
            spp: samples per pixel; 0 means the sample count of the sensor's sampler.
            pixels: distinct row-major indices of n pixels. If given, only these pixels are rendered and contribute to
                the loss.

        Returns:
            The image, height x width x 3, or n x 1 x 3 with ``pixels``.

        Raises:
            PathreplayError: an unsuitable number of samples, a wrong tensor shape, repeated or invalid pixels, or no
                parameter with gradients that reaches the paths.
        """
        view = self.pass_of(scene, sensor, seed, spp)
        image, state = self.pixel_pass(view, (offset, slope), pixels, self.begin(scene))
        self.keep(scene, state)
        return image

    def pixel_pass(
        self, view: Pass, derivative: tuple[mi.TensorXf, mi.TensorXf], pixels: mi.UInt32 | None, state: PassState
    ) -> tuple[mi.TensorXf, PassState]:
        """Render and back-propagate as `render_value_and_grad` does; ``derivative`` is the pair (offset, slope)."""
        offset, slope = derivative
        some = None if pixels is None else mi.UInt32(pixels)
        with reached(view, zero_is_error=True), self._pass_context(), dr.isolate_grad():
            loss = pixel_loss(view, self.max_depth, offset, slope, some)
            view, trace, (_, *edges) = self._planned(view, state, follow=False)
            if view.flow is not None:
                raise PathreplayError(
                    f"pathreplay: sensor '{view.sensor.id()}' moves, which a pixel sweep does not support: freeze it, "
                    "or use mi.render"
                )
            self._learned(view, trace, state)
            result = self.interior.pixels(view, trace, loss, some)
            if edges:
                assert result.image is not None
                grad_in = offset + slope * result.image
                if some is not None:
                    grad_in = scatter_rows(some, grad_in, view.size)
                result = reduce(add, [term.backward(view, trace, grad_in, None) for term in edges], result)
        self._log_notes(view, trace, result)
        assert result.image is not None
        return result.image, state.after(result)

    def begin(self, scene: mi.Scene) -> PassState:
        """Create the state of a pass. In scenes with media, the state contains the learned control variate.

        While `dr.freeze` records a function of the user, the state contains no control variate, because the recorded
        passes cannot update it.
        """
        state = PathIntegrator.begin(self, scene)
        if not state.is_complete or not facts_of(scene).has_media:
            return state
        learned = self._baseline_state(scene)
        return replace(state, guess=learned.guess, passes=learned.passes)

    def keep(self, scene: mi.Scene, state: PassState) -> None:
        """Warn of incomplete gradients, and update the learned state. Does nothing while `dr.freeze` records."""
        if is_recording():
            return
        result = state.result
        if result.lost is not None and result.lost[0] > 0:
            mi.Log(mi.LogLevel.Warn, f"pathreplay: {lost_note(result.lost[0], result.paths)}")
        if state.guess is not None:
            learned = self._baseline_state(scene)
            self.baseline = ref(facts_of(scene)), learned if result.stats is None else learned.after(result.stats)

    def _baseline_state(self, scene: mi.Scene) -> BaselineState:
        """Return the state learned from a scene, or a fresh state if the last gradient pass was over another scene."""
        if self.baseline is None or self.baseline[0]() is not facts_of(scene):
            return BaselineState.fresh(scene.bbox())
        return self.baseline[1]

    def _learned(self, view: Pass, trace: TraceConfig, state: PassState) -> Baseline | None:
        """Log messages about wrong or incomplete gradients. Return the control variate, or None if none may be used.

        A pass never uses a control variate to which it has contributed, because the gradient would be biased.
        """
        other = camera_doubts(trace) if self.particles is None else particle_doubts(trace)
        for doubt in filter(None, (*doubts(trace), *other, *(term.note(trace) for term in self.terms))):
            self._warn_once(doubt)
        if trace.media is None or state.guess is None:
            return None
        if state.passes.intersection(self._camera_view(view).keys):
            self._warn_once(USED_BEFORE)
            self.silence([USED_BEFORE])  # about other scenes
            return None
        return state.guess

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state learned from gradient passes over media, as arrays by name; empty if there is none."""
        return {} if self.baseline is None else self.baseline[1].state_dict()

    def load_state_dict(self, scene: mi.Scene, learned: Mapping[str, np.ndarray]) -> None:
        """Restore a `state_dict` of the same scene; an empty dictionary resets the learned state.

        Raises PathreplayError for an invalid dictionary.
        """
        box = scene.bbox()
        baseline = BaselineState.restored(box, learned) if learned else BaselineState.fresh(box)
        self.baseline = ref(facts_of(scene)), baseline

    def _log_notes(self, view: Pass, trace: TraceConfig, result: TermResult) -> None:
        if result.moves and (note := sun_note(trace)):
            self._warn_once(note)
        if self.particles is not None and result.moves:
            for note in particle_notes(trace, view.sensor, self._omitted_by(self.particles, trace)):
                self._warn_once(note)
            if not self.particles.caustics:
                return
        if not result.moves or EDGES in self.warned or self.boundary in ("auto", "all"):
            return
        note, named = missing_edges(trace, view.sensor, self.boundary)
        if named:
            self.warned.add(EDGES)
        if note:
            self._warn_once(note)

    def _omitted_by(self, particles: ParticleTerm, trace: TraceConfig) -> Iterable[str]:
        """Return the edges that the gradient of light paths leaves out, except for edges that another note names.

        With ``boundary = 'none'``, the note of `missing_edges` names edges of camera paths and light paths, and so does
        the note of a `Problem`.
        """
        if self.boundary in ("auto", "all"):
            return ParticleBoundary(particles).notes(trace)
        named = self.boundary == "none" and (particles.caustics or EDGES in self.warned)
        return () if named else ("moving edges",)

    def _log_sample_notes(self, trace: TraceConfig) -> None:
        for doubt in (*doubts(trace), *sample_doubts(trace, self.particles is not None)):
            self._warn_once(doubt)

    def _warn_once(self, message: str) -> None:
        if message not in self.warned:
            self.warned.add(message)
            mi.Log(mi.LogLevel.Warn, f"pathreplay: {message}")

    def options(self) -> Json:
        """Return the properties as they were declared, except for the properties of `PathIntegrator`."""
        return {
            "adjoint": "auto" if self.interior.auto else self.adjoint,
            "attach": self.attach,
            "jacobian_noise": self.interior.recovery.noise,
            "null_branching": self.null_branching,
            "sampling": declared.SAMPLING.choices[self.uses_sobol],
            "boundary": self._declared_boundary,
            "boundary_spp": self.boundary_spp,
            "caustics": self.caustics,
        }

    @property
    def caustics(self) -> str:
        """The value of the property ``caustics``; "particles" if all light is traced from the emitters."""
        return declared.CAUSTICS.choices[self.particles is not None]

    def to_string(self) -> str:
        return self._described(
            hide_emitters=self.hide_emitters,
            adjoint=self.adjoint,
            attach=self.attach,
            null_branching=self.null_branching,
            sampling=declared.SAMPLING.choices[self.uses_sobol],
            boundary=self.boundary,
            caustics=self.caustics,
        )
