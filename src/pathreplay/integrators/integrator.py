"""The `pathreplay` integrator plugin: reads properties, adds up terms, keeps what they learn, and tells of problems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from operator import add
from typing import Any
from weakref import ReferenceType, ref

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.adjoint.baseline import Baseline, BaselineState
from pathreplay.adjoint.ray_jacobian import Recovery
from pathreplay.adjoint.record import MAX_DEPTH
from pathreplay.errors import PathreplayError
from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.camera_pass import Pass, Seed, Which
from pathreplay.integrators.diagnostics import COST_OF_EDGES, doubts, lost_note, missing_edges, used_before_note
from pathreplay.integrators.film.camera_flow import CameraFlow
from pathreplay.integrators.film.motion import FilmMotion
from pathreplay.integrators.film.pixel_passes import among, obstacle, pixel_loss
from pathreplay.integrators.film.surface_flow import SeenFlow, can_follow
from pathreplay.integrators.interior import PathReplay
from pathreplay.integrators.lifetimes import is_recording
from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.path_integrator import UNBOUNDED, PathIntegrator, reached
from pathreplay.integrators.properties import choice, deviation, whole_number
from pathreplay.integrators.scene_facts import SceneFacts, facts_of
from pathreplay.integrators.term import Term, TermResult
from pathreplay.transport.vertex import TraceConfig

ADJOINTS = ("auto", "recorded", "replay")
#: Properties of 0.1.0's first edition -> what they are called now.
RENAMED = {
    "branch": "null_branching",
    "driver": "adjoint",
    "edge_spp": "boundary_spp",
    "edges": "boundary",
    "noise": "jacobian_noise",
    "numbers": "sampling",
}
ATTACH = ("delta", "all", "none")
NULL_BRANCHING = ("auto", True, False)
SAMPLING = ("scene", "sobol")
BOUNDARIES = ("auto", "none", "primary", "all")
EDGES = "edges"
"""In `warned`: what there is to say of edges that move has been said."""


def _interior(name: str, props: mi.Properties, max_depth: int) -> PathReplay:
    """The interior term that the properties describe. Raises PathreplayError for unusable properties."""
    for old, new in RENAMED.items():
        if old in props:
            raise PathreplayError(f"{name}: there is no property '{old}': it is called '{new}' now")
    adjoint = choice(props, name, "adjoint", "auto", ADJOINTS)
    if adjoint == "recorded" and max_depth > MAX_DEPTH:
        depth = "-1 (unbounded)" if max_depth == UNBOUNDED else max_depth
        raise PathreplayError(
            f"{name}: max_depth = {depth} is more than adjoint = 'recorded' can hold ({MAX_DEPTH}): "
            "use adjoint = 'replay', which has no limit"
        )
    branch = choice(props, name, "null_branching", "auto", NULL_BRANCHING)
    recovery = Recovery(noise=deviation(props, name, "jacobian_noise", Recovery.noise))
    auto = adjoint == "auto"
    if auto:
        adjoint = "recorded" if max_depth <= MAX_DEPTH else "replay"
    return PathReplay(adjoint, auto, branch, recovery)


class PathReplayIntegrator(PathIntegrator):
    """Differentiable path tracer for surfaces and media.

    Properties: ``max_depth`` (6; -1 = unbounded, with ``adjoint='replay'``), ``rr_depth`` (5), ``hide_emitters``
    (False), ``adjoint`` (``auto``, ``recorded``, ``replay``: how reverse mode visits a path again), ``attach``
    (``delta``, ``all``, ``none``), ``jacobian_noise`` (0.01: standard deviation of the perturbation of ray Jacobians in
    replay, see `Recovery`), ``null_branching`` (``auto``, True, False), ``boundary`` (``auto``, ``none``, ``primary``,
    ``all``: see `Boundary`), ``boundary_spp`` (0: the samples of the pass) and ``sampling`` (``sobol``:
    `OwenSobolSampler` in place of an independent sampler; ``scene``: the scene's own sampler). ``adjoint = 'auto'``
    records paths unless ``max_depth`` exceeds what a record holds, or only emitters have gradients (see
    `emission_only`). Forward mode does not depend on ``adjoint``.

    ``boundary = 'auto'`` means ``all`` where something that can occlude light moves (see `edges_move`) and its boundary
    term can be computed. Otherwise it means ``none``: with an ``attach`` other than ``delta``, and, with a message, for
    sensors of type ``batch``. Without motion no boundary term is computed, whatever ``boundary`` is.

    Gradients of media use a control variate that this integrator learns from earlier gradient passes (with other
    seeds). ``null_branching`` traces one more path from a null collision, where the medium could have scattered.
    Without it a gradient by extinction is wrong where extinction is zero. ``auto`` branches where extinction with
    gradients varies in space or is zero; at equal noise that mostly takes less time, too.

    Not differentiated: visibility, as far as ``boundary`` leaves it out; all motion of shapes, cameras and directions
    with ``attach='none'``; extinction where it is zero without ``null_branching``; weights that are exactly zero with
    ``adjoint='replay'``.
    Raises PathreplayError for unknown or unusable properties and in polarised variants.
    """

    name = "pathreplay"
    interior: PathReplay

    def __init__(self, props: mi.Properties) -> None:
        PathIntegrator.__init__(self, props)
        self.attach = choice(props, self.name, "attach", "delta", ATTACH)
        self.moves_rays = self.attach != "none"  # gradients reach cameras, and lights that move
        self.interior = _interior(self.name, props, self.max_depth)
        self.adjoint, self.null_branching = self.interior.adjoint, self.interior.branch
        self.even = choice(props, self.name, "sampling", "sobol", SAMPLING) == "sobol"
        self.boundary = choice(props, self.name, "boundary", "auto", BOUNDARIES)
        self.boundary_spp = whole_number(
            props, self.name, "boundary_spp", 0, lowest=0, kind="number of segments per pixel"
        )
        if self.boundary == "auto" and self.attach != "delta":
            self.boundary = "none"
        if self.boundary != "none" and self.attach != "delta":
            raise PathreplayError(
                f"{self.name}: boundary = '{self.boundary}' with attach = '{self.attach}': edges know what moves with "
                "attach = 'delta' only: use that, or boundary = 'none'"
            )
        self.baseline: tuple[ReferenceType[SceneFacts], BaselineState] | None = None  # and the scene that it belongs to

    @property
    def terms(self) -> tuple[Term, ...]:
        """The interior, and edges unless they are switched off; `_planned` adds that of a camera that moves."""
        if self.boundary == "none":
            return (self.interior,)
        return self.interior, Boundary(inner=self.boundary != "primary", spp=self.boundary_spp)

    def _planned(self, view: Pass, state: PassState, follow: bool = True) -> tuple[Pass, TraceConfig, tuple[Term, ...]]:
        """See `PathIntegrator`. What moves over the film has a term of its own, and the others what that leaves.

        Where it may, the film's flow is to ``follow`` what is seen. Edges are left out where none move, and where
        `auto` finds that they cannot be done; the interior, where the film's term is all.
        """
        view, trace, terms = PathIntegrator._planned(self, view, state)
        if self.boundary == "none":
            return view, trace, terms
        view = replace(view, flow=CameraFlow.of(view.scene, view.sensor))
        needs_edges = self._needs_edges(view, trace)
        if needs_edges and follow and self._may_follow(view, trace):
            trace = Boundary.informed(view, trace)
            view = replace(view, flow=SeenFlow.of(view.sensor, trace))
        motion: tuple[Term, ...] = () if view.flow is None else (FilmMotion(view.flow),)
        if not needs_edges:
            terms = tuple(term for term in terms if term is self.interior or not isinstance(term, Boundary))
            return view, trace, motion if view.flow is not None and view.flow.is_all else (*terms, *motion)
        if not state.is_complete:
            tables = facts_of(view.scene).recorded_tables(state.tables, edges=True)
            trace = replace(trace, traits=replace(trace.traits, tables=tables))
        return view, replace(trace, may_slide=self.boundary != "primary" and trace.media is None), (*terms, *motion)

    def _may_follow(self, view: Pass, trace: TraceConfig) -> bool:
        """Whether the film may follow what it sees: all edges are found of what then slides under it."""
        return self.boundary != "primary" and can_follow(trace, view.sensor) and not facts_of(view.scene).has_seams

    def _needs_edges(self, view: Pass, trace: TraceConfig) -> bool:
        """Whether edges move, and can be differentiated where that is left to ``auto``; says what they cost."""
        if not Boundary.move(view, trace):
            return False
        why = Boundary.obstacle(view) if self.boundary == "auto" else ""
        if why:
            self._tell_once(f"{why}; they are left out here")
        elif self.boundary == "auto" and EDGES not in self.warned:
            self._tell_once(COST_OF_EDGES)
        return not why

    def is_recordable(self, has_media: bool) -> bool:
        """Always: rendering reads nothing on the host."""
        return True

    def supports_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> bool:
        """Whether `render_value_and_grad` can be used, for all pixels or for ``some``: see `pixel_obstacle`."""
        return not self.why_no_pixel_sweep(scene, sensor, spp, some)

    def why_no_pixel_sweep(self, scene: mi.Scene, sensor: Which = 0, spp: int = 0, some: bool = False) -> str:
        """Why it cannot be used, with the remedy: see `obstacle`. It needs the sweep driver, too, and no media."""
        view = Pass.of(scene, sensor, 0, spp)
        if self.adjoint != "recorded":
            return f"adjoint = '{self.adjoint}' records no paths; use 'recorded'"
        if facts_of(scene).has_media:
            return "the scene has media; leave them out"
        return obstacle(view.sensor, self.max_depth, view.spp, some) or ("" if some else self._loss_of_sweep(view))

    def _loss_of_sweep(self, view: Pass) -> str:
        """Why whole images should not use the pixel sweep: a film flow is needed, which the sweep does not support."""
        if self.boundary in ("none", "primary"):
            return ""
        with self._passing():
            trace = self._walk(view.scene, view.sensor)
            follows = Boundary.move(view, trace) and not Boundary.obstacle(view) and self._may_follow(view, trace)
        return "the film follows what moves; take boundary = 'none'" if follows else ""

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
        """Render an image and back-propagate a loss whose derivative by it is offset + slope · image, in one pass.

        ``offset`` and ``slope`` are tensors like the image (height x width x 3); the loss adds up over its values.
        Each path is judged by the others of its pixel: see `pixel_sweep`; edges, by the image. With ``pixels`` (their
        numbers, row by row, none twice) only these are rendered, and add to the loss: the tensors and what is returned
        have a row for each of them (n x 1 x 3). What is not differentiated: see `sweep`.
        Warns as `render_backward` does. Use it where `supports_pixel_sweep` allows it; raises PathreplayError where the
        number of samples does not, a tensor has another shape, there are no such pixels, or no parameter with gradients
        reaches the paths.
        """
        view = self.pass_of(scene, sensor, seed, spp)
        image, state = self.pixel_pass(view, (offset, slope), pixels, self.begin(scene))
        self.keep(scene, state)
        return image

    def pixel_pass(
        self, view: Pass, derivative: tuple[mi.TensorXf, mi.TensorXf], pixels: mi.UInt32 | None, state: PassState
    ) -> tuple[mi.TensorXf, PassState]:
        """Return image and state of `render_value_and_grad`, whose offset and slope are the ``derivative``."""
        offset, slope = derivative
        some = None if pixels is None else mi.UInt32(pixels)
        with reached(view.scene, view.sensor, zero_is_told=True), self._passing(), dr.isolate_grad():
            loss = pixel_loss(view, self.max_depth, offset, slope, some)
            view, trace, (_, *edges) = self._planned(view, state, follow=False)
            if view.flow is not None:
                raise PathreplayError(
                    f"pathreplay: sensor '{view.sensor.id()}' moves, and cannot be swept: hold it, or use mi.render"
                )
            self._learned(view, trace, state)
            found = self.interior.pixels(view, trace, loss, some)
            if edges:
                wanted = offset + slope * found.image
                if some is not None:
                    wanted = among(some, wanted, view.size)
                found = reduce(add, [term.backward(view, trace, wanted, None) for term in edges], found)
        self._told(view, trace, found)
        return found.image, state.after(found)

    def begin(self, scene: mi.Scene) -> PassState:
        """See `PathIntegrator`. Adds the control variate of media, except in a user's recording, which cannot learn."""
        state = PathIntegrator.begin(self, scene)
        if not state.is_complete or not facts_of(scene).has_media:
            return state
        known = self._known(scene)
        return replace(state, guess=known.guess, passes=known.passes)

    def keep(self, scene: mi.Scene, state: PassState) -> None:
        """See `PathIntegrator`. Does nothing in a user's recording, which cannot read results."""
        if is_recording():
            return
        found = state.found
        if found.lost is not None and found.lost[0] > 0:
            mi.Log(mi.LogLevel.Warn, f"pathreplay: {lost_note(found.lost[0], found.paths)}")
        if state.guess is not None:
            known = self._known(scene)
            self.baseline = ref(facts_of(scene)), known if found.seen is None else known.after(found.seen)

    def _known(self, scene: mi.Scene) -> BaselineState:
        """Return what is known of the media of a scene; nothing unless it is the last one that was differentiated."""
        if self.baseline is None or self.baseline[0]() is not facts_of(scene):
            return BaselineState.fresh(scene.bbox())
        return self.baseline[1]

    def _learned(self, view: Pass, trace: TraceConfig, state: PassState) -> Baseline | None:
        """See `PathIntegrator`. A pass never uses a control variate that it contributed to, which would bias it."""
        for doubt in filter(None, (*doubts(trace), *(term.note(trace) for term in self.terms))):
            self._tell_once(doubt)
        if trace.media is None or state.guess is None:
            return None
        if state.passes.intersection(view.keys):
            self._tell_once(used_before_note(view.keys[0][0]))
            return None
        return state.guess

    def state_dict(self) -> dict[str, np.ndarray]:
        """What gradient passes have learned of media, as arrays by name; empty where there is nothing to learn."""
        return {} if self.baseline is None else self.baseline[1].state_dict()

    def load_state_dict(self, scene: mi.Scene, learned: Mapping[str, np.ndarray]) -> None:
        """Go on with what `learned` told of the same scene; where that is nothing, anew. Raises PathreplayError."""
        box = scene.bbox()
        baseline = BaselineState.restored(box, learned) if learned else BaselineState.fresh(box)
        self.baseline = ref(facts_of(scene)), baseline

    def _told(self, view: Pass, trace: TraceConfig, found: TermResult) -> None:
        """Note moving edges that are not differentiated: see `PathIntegrator`."""
        if not found.moves or EDGES in self.warned or self.boundary in ("auto", "all"):
            return
        note, named = missing_edges(trace, view.sensor, self.boundary)
        if named:
            self.warned.add(EDGES)
        if note:
            self._tell_once(note)

    def _tell_once(self, message: str) -> None:
        if message not in self.warned:
            self.warned.add(message)
            mi.Log(mi.LogLevel.Warn, f"pathreplay: {message}")

    def options(self) -> dict[str, Any]:
        """The properties that this one was made of, beside those that all integrators of paths share."""
        return {
            "adjoint": "auto" if self.interior.auto else self.adjoint,
            "attach": self.attach,
            "jacobian_noise": self.interior.recovery.noise,
            "null_branching": self.null_branching,
            "sampling": SAMPLING[self.even],
            "boundary": self.boundary,
            "boundary_spp": self.boundary_spp,
        }

    def to_string(self) -> str:
        return self._described(
            hide_emitters=self.hide_emitters,
            adjoint=self.adjoint,
            attach=self.attach,
            null_branching=self.null_branching,
            sampling=SAMPLING[self.even],
            boundary=self.boundary,
        )
