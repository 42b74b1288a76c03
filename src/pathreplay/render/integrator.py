"""The `pathreplay` integrator plugin: chooses step and driver, and speaks Mitsuba's integrator interface."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import PathreplayError
from ..gradient.adjoint import LostPaths
from ..gradient.baseline import FIRST_BRANCHING, Baseline
from ..gradient.forward import forward
from ..gradient.pixel_sweep import PixelLoss, fits, pixel_camera, pixel_sweep, sweepable
from ..gradient.primal import primal
from ..gradient.ray_jacobian import Recovery
from ..gradient.replay import replay
from ..gradient.sweep import MAX_DEPTH, deepest, sweep
from ..rivals.listing import listing
from ..transport.start import CameraStart
from ..transport.traits import Traits, nodes_of
from ..transport.vertex import Walk
from .edges import edges_note, keys_that_move_edges
from .path_integrator import UNBOUNDED, path_integrator
from .properties import choice, deviation

DRIVERS = ("auto", "sweep", "replay")
ATTACH = ("delta", "all", "none")
VOLUME_GRADIENTS = ("score", "listing")
BRANCH = ("auto", True, False)
EDGES = "edges"
"""In `told`: that edges move has been said."""


def _make_class() -> type:
    class PathReplayIntegrator(path_integrator()):  # type: ignore[misc]
        """Differentiable path tracer for surfaces and media.

        Properties: ``max_depth`` (6; -1 = unbounded, with the replay driver), ``rr_depth`` (5), ``hide_emitters``
        (False), ``driver`` (``auto``, ``sweep``, ``replay``), ``attach`` (``delta``, ``all``, ``none``), ``noise``
        (0.01; of ray adjoints with the replay driver: see `Recovery`), ``volume_gradient`` (``score``, ``listing``)
        and ``branch`` (``auto``, True, False). ``auto`` drivers sweep unless ``max_depth`` is more than the sweep can
        hold. Forward mode is the same whatever the driver.

        ``volume_gradient='score'`` differentiates media where paths went, less a baseline that is learned from earlier
        gradient passes of this integrator (with other seeds); ``listing`` is delta tracking as first published.
        ``branch`` walks one more path from where a medium might have scattered and did not, without which a gradient by
        extinction is wrong where it is zero; ``auto`` does so where extinction with gradients varies in space or is
        zero, which mostly takes less time for the same noise, too.

        Not differentiated: visibility; with ``attach='none'`` all motion of shapes, cameras and directions; by
        extinction where it is zero if ``branch`` is off; with the replay driver, by weights that are exactly zero.
        Raises PathreplayError for unknown or unusable properties and in polarised variants.
        """

        name = "pathreplay"

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.attach = choice(props, self.name, "attach", "delta", ATTACH)
            driver = choice(props, self.name, "driver", "auto", DRIVERS)
            if driver == "sweep" and self.max_depth > MAX_DEPTH:
                depth = "-1 (unbounded)" if self.max_depth == UNBOUNDED else self.max_depth
                raise PathreplayError(
                    f"pathreplay: max_depth = {depth} is more than the sweep driver can hold ({MAX_DEPTH}): "
                    "use driver = 'replay', which has no limit"
                )
            self.auto = driver == "auto"
            if self.auto:
                driver = "sweep" if self.max_depth <= MAX_DEPTH else "replay"
            self.driver = driver
            self.volume_gradient = choice(props, self.name, "volume_gradient", "score", VOLUME_GRADIENTS)
            self.branch = choice(props, self.name, "branch", "auto", BRANCH)
            self.recovery = Recovery(noise=deviation(props, self.name, "noise", Recovery.noise))
            self.told: set[str] = set()  # what has been said in the log
            self.lost: list[tuple[LostPaths, int]] = []  # of how many paths each, not told yet
            self.baseline: tuple[int, Baseline] | None = None  # and the scene that it belongs to
            self.learner: Baseline | None = None  # the same, in a pass that it may learn from
            self.known: set[Any] = set()  # keys of the passes that it has learned from

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
            if mode == dr.ADMode.Primal and self.goes_back:
                return mi.Spectrum(0), mi.Bool(True), [], None
            walk = self._walk(scene, mode != dr.ADMode.Primal)
            if mode == dr.ADMode.Primal:
                L, valid = primal(walk, sampler, CameraStart(dr.detach(ray)), active)
                return L, valid, [], None
            self._check(walk)
            lost = LostPaths()
            if mode == dr.ADMode.Forward:
                tangent, valid, moves = forward(walk, sampler, CameraStart(ray), active, lost)
                if moves:
                    self._tell_edges(walk)
                    self.lost.append((lost, dr.width(ray)))
                return tangent, valid, [], None
            driver = self.driver
            if self.auto and self.max_depth > deepest(walk):
                driver = "replay"
            moves = False
            if walk.media is not None and self.volume_gradient == "listing":
                listing(walk, sampler, CameraStart(ray), δL, active, lost)
            elif driver == "sweep":
                if walk.baseline is not None and self.baseline is not None and self.of_pass is not None:
                    self.learner = self.baseline[1]
                    self.known.add(self._pass_key())
                moves = sweep(walk, sampler, CameraStart(ray), δL, active, lost, self.learner)
            else:
                moves = replay(replace(walk, baseline=None), sampler, CameraStart(ray), δL, active, lost, self.recovery)
            if moves:
                self._tell_edges(walk)
            if moves or walk.media is not None:
                self.lost.append((lost, dr.width(ray)))
            return mi.Spectrum(0), mi.Bool(True), [], None

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            """Back-propagate an image gradient into the parameters: see Mitsuba's ADIntegrator.

            Warns when a part of the gradient was not finite and had to be left out.
            """
            self._forget_lost()
            try:
                super().render_backward(scene, params, grad_in, sensor, seed, spp)
                self._tell_lost()
                if self.learner is not None:
                    self.learner.absorb()
            finally:
                self.learner = None

        def sweeps_pixels(self, scene: Any, sensor: Any = 0, spp: int = 0) -> bool:
            """Whether `render_and_backward` can be used: see `sweepable`. It needs the sweep driver, and no media."""
            sensor, spp = self._resolved(scene, sensor, spp)
            if self.driver != "sweep" or not sweepable(sensor, self.max_depth, spp):
                return False
            return not any(isinstance(node, mi.Medium) for node in nodes_of(scene))

        def render_and_backward(
            self, scene: Any, offset: Any, slope: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> Any:
            """Render an image and back-propagate a loss whose derivative by it is offset + slope · image, in one pass.

            ``offset`` and ``slope`` are tensors like the image (height x width x 3); the loss adds up over its values.
            Each path is judged by the others of its pixel: see `pixel_sweep`. What is not differentiated: see `sweep`.
            Warns as `render_backward` does. Use it where `sweeps_pixels` allows it; raises PathreplayError where the
            number of samples does not, or a tensor has another shape.
            """
            sensor, spp = self._resolved(scene, sensor, spp)
            width, height = sensor.film().crop_size()
            if not fits(self.max_depth, spp):
                raise PathreplayError(
                    f"pathreplay: {spp} samples per pixel, of {self.max_depth} vertices, cannot be swept: use "
                    f"2 or more, and at most {MAX_DEPTH} vertices in all, or mi.render"
                )
            for tensor in (offset, slope):
                if tensor.shape != (height, width, 3):
                    raise PathreplayError(
                        f"pathreplay: derivative of the loss has shape {tensor.shape}: use {(height, width, 3)}"
                    )
            self._forget_lost()
            with self._looking_through(scene, sensor, seed, spp), dr.suspend_grad(), dr.isolate_grad():
                sampler = sensor.sampler().clone()
                sampler.seed(seed, width * height)
                pixel = dr.arange(mi.UInt32, width * height)
                o, k = (dr.gather(mi.Color3f, tensor.array, pixel) for tensor in (offset, slope))
                walk, lost = self._walk(scene, True), LostPaths()
                self._check(walk)
                moves, L = pixel_sweep(walk, sampler, pixel_camera(sensor, pixel), spp, PixelLoss(o, k), lost)
                if moves:
                    self._tell_edges(walk)
                    self.lost.append((lost, width * height * spp))
                dr.eval(L)  # in one kernel with the gradients
                image = mi.TensorXf(dr.ravel(L), (height, width, 3))
            self._tell_lost()
            return image

        def _resolved(self, scene: Any, sensor: Any, spp: int) -> tuple[Any, int]:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            return sensor, spp or sensor.sampler().sample_count()

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            """Tangent of the image along those of the parameters: see Mitsuba's ADIntegrator.

            The parameters must carry their tangents already: after ``dr.set_grad`` on something that they are computed
            from, propagate with ``dr.forward(x, dr.ADFlag.ClearEdges)``. Warns as `render_backward` does.
            """
            self._forget_lost()
            tangent = super().render_forward(scene, params, sensor, seed, spp)
            if self.lost:
                dr.eval(tangent)  # in one kernel with the count of lost paths
            self._tell_lost()
            return tangent

        def _walk(self, scene: Any, differentiate: bool) -> Walk:
            walk = super()._walk(scene, differentiate)
            if walk.media is None or not differentiate:
                return walk
            known = self._baseline(scene)
            branching = None
            if walk.media.branches if self.branch == "auto" else self.branch:
                branching = dr.opaque(mi.Float, FIRST_BRANCHING) if known is None else known.branching
            return replace(walk, baseline=None if known is None else known.look, branching=branching)

        def learned(self) -> dict[str, Any]:
            """What gradient passes have learned of media, as arrays by name; empty where there is nothing to learn."""
            return {} if self.baseline is None else self.baseline[1].learned()

        def restore_learned(self, scene: Any, learned: Any) -> None:
            """Go on with what `learned` told of the same scene, in another process. Raises PathreplayError."""
            baseline = Baseline(scene.bbox())
            baseline.restore(learned)
            self.baseline = scene.ptr, baseline
            self.known.clear()

        def _baseline(self, scene: Any) -> Baseline | None:
            """What was learned of this scene so far; another scene starts anew, and nothing is its own judge."""
            if self.baseline is None or self.baseline[0] != scene.ptr:
                self.baseline = scene.ptr, Baseline(scene.bbox())
                self.known.clear()
            key = self._pass_key()
            if key in self.known:
                self._tell_once(
                    f"seed {key[0]} was used before: a pass cannot serve as baseline for itself, so that this "
                    "one goes without; give every pass a seed of its own"
                )
                return None
            return self.baseline[1]

        def _check(self, walk: Walk) -> None:
            """Refuse, or warn of, what would make the gradient of this scene wrong."""
            traits = walk.traits
            if traits.instances_move and self.attach != "none":
                raise PathreplayError(
                    "pathreplay: an instance's to_world has a gradient, but Mitsuba does not differentiate the normals "
                    "of instances: move the vertex_positions of the shapes in its group, or use a shape of its own"
                )
            if traits.masks_mirrors:
                self._tell_once(
                    "a mask lies over delta lobes, which Mitsuba cannot sample one by one there: derivatives by what "
                    "decides among them (an index, or a reflectance of plastic) are wrong"
                )
            if walk.media is not None and walk.media.passes and traits.opacity_moves:
                self._tell_once(
                    "the opacity of a mask has gradients in a scene with media: what it does to the light of emitters "
                    "that shadow rays see through it is missing from the gradient"
                )
            if self.attach == "all":
                self._tell_attachable(traits)

        def _tell_attachable(self, traits: Traits) -> None:
            if not traits.attachables:
                raise PathreplayError(
                    "pathreplay: attach = 'all', but no BSDF of the scene can be sampled attached (diffuse, "
                    "roughconductor, roughdielectric, normal and bump maps over them can): use attach = 'delta'"
                )
            if traits.detached_names:
                names = ", ".join(traits.detached_names)
                self._tell_once(f"attach = 'all' keeps the directions of {names} fixed")

        def _tell_edges(self, walk: Walk) -> None:
            if EDGES in self.told:
                return
            seen_from = [] if self.sensor is None else keys_that_move_edges(mi.traverse(self.sensor))
            moving = keys_that_move_edges(mi.traverse(walk.scene)) or seen_from
            if moving:
                self.told.add(EDGES)
                self._tell_once(edges_note(moving))
            elif walk.traits.lobes and walk.traits.area_lights:
                self._tell_once(
                    "something moves in a scene with delta lobes and area lights: where the edge of a light or a "
                    "silhouette is seen through glass or mirrors, its motion is missing from the gradient"
                )

        def _tell_once(self, message: str) -> None:
            if message not in self.told:
                self.told.add(message)
                mi.Log(mi.LogLevel.Warn, f"pathreplay: {message}")

        def _forget_lost(self) -> None:
            """Before a pass; but in a frozen function the passes before are still to be told of: see `take_lost`."""
            if not dr.flag(dr.JitFlag.FreezingScope):
                self.lost.clear()

        def _tell_lost(self) -> None:
            if self.lost and not dr.flag(dr.JitFlag.FreezingScope):
                paths = sum(number for _, number in self.lost)
                self.tell_lost(self.take_lost(), paths)

        def take_lost(self) -> Any:
            """How many paths lost a part of their gradient (UInt32) or None: a frozen function cannot look itself."""
            counts = [lost.count for lost, _ in self.lost]
            self.lost.clear()
            return sum(counts[1:], counts[0]) if counts else None

        def tell_lost(self, count: Any, paths: int) -> None:
            """Warn if paths lost a part of their gradient; ``count`` (UInt32) of so many ``paths``."""
            if count[0] > 0:
                why = "a ray adjoint was not finite, or media have more boundaries on the way than the record holds"
                share = f"{count[0] / paths:.2%}"
                mi.Log(mi.LogLevel.Warn, f"pathreplay: {share} of the paths lost a part of their gradient: {why}")

        def to_string(self) -> str:
            return self._described(
                hide_emitters=self.hide_emitters,
                driver=self.driver,
                attach=self.attach,
                volume_gradient=self.volume_gradient,
                branch=self.branch,
            )

    return PathReplayIntegrator


def register() -> None:
    """Register the plugin for the active variant, which must be an AD variant."""
    plugin = _make_class()
    mi.register_integrator("pathreplay", lambda props: plugin(props))
