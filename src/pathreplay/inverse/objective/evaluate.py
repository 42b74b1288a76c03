"""Evaluates loss and gradient.

An iteration is split into shards. An `Evaluator` computes loss and gradient of a shard. An `Executor` passes all shards
of an iteration to evaluators, in this process or in others.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.integrators.camera_pass import Which
from pathreplay.integrators.film.image import make_ready
from pathreplay.integrators.lifetimes import plain_errors
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.losses.pixelwise import ELSEWHERE, Own
from pathreplay.inverse.objective.frozen import (
    NotRecordable,
    Recordings,
    RenderRequest,
    ViewLoss,
    ViewTarget,
    differentiate,
    is_recordable,
)
from pathreplay.inverse.objective.jacobian import Jacobians
from pathreplay.inverse.objective.pixel_batches import Batch, obstacle, refused
from pathreplay.inverse.objective.shared_sensors import SharedSensors
from pathreplay.inverse.parameters.exposures import EXPOSURE, factor_of
from pathreplay.inverse.parameters.exposures import gradient as exposure_gradient
from pathreplay.inverse.parameters.gauss_newton import GaussNewton
from pathreplay.inverse.parameters.response import RESPONSE, linearized
from pathreplay.inverse.parameters.response import gradient as response_gradient
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem.problem import Problem, scene_values, sensor_of
from pathreplay.platform import memory
from pathreplay.platform.owned_arrays import owned, with_space
from pathreplay.scenes.parameters import get_array

LARGE = 2**22
"""Number of entries from which the memory of a variable is managed explicitly (see `release`)."""
MOST_INPUTS = 4096
"""Maximum number of sensors, times the number of kinds of views. Each kind is recorded, and a recording contains all
sensors of the scene (measured: 3 MB with 50 sensors, 11 MB with 200)."""


@dataclass(frozen=True)
class Shard:
    """A part of an iteration: indices of views, samples per pixel, and a seed for each view."""

    views: tuple[int, ...]
    samples: int
    seeds: tuple[int, ...]
    stage: int = 0
    """Index of the job's stage, which determines targets and trainable variables."""
    pixels: int | None = None
    """Number of random pixels per view; None: all pixels."""
    second_order: bool = False
    """Whether the Gauss-Newton model is evaluated as well, by forward-mode differentiation; see `jacobian`."""


@dataclass(frozen=True)
class Evaluation:
    """Contribution of a shard to the loss and to the gradients of the loss.

    The loss is the mean over the training views. The gradients are indexed by the key of the variable. The gradients
    are unbiased for the losses in `QUADRATIC`. The expected loss includes the variance of the images.
    """

    loss: float
    gradients: dict[str, Array]
    dropped: dict[str, int]
    """Number of gradient entries that were NaN or infinite in a view and were replaced by zero, by key."""
    learned: Arrays
    """State of the integrator after the shard."""
    model: GaussNewton | None = None
    """Gauss-Newton model of the loss, if the shard is of second order."""


Evaluate = Callable[[Arrays, Shard, Arrays], Evaluation]
"""evaluate(values, shard, learned): a pure function, up to rounding in sums over threads.

``values`` are the decoded values of all variables. ``learned`` is the integrator's state after earlier evaluations.
"""


class Total:
    """Running sum of evaluations. Each evaluation can be freed after it has been added."""

    def __init__(self, owned: bool = False) -> None:
        self._owned, self._count, self._loss = owned, 0, 0.0
        self._sums: dict[str, Array] = {}
        self._known: dict[str, Array] = {}
        self._dropped: Counter[str] = Counter()
        self._model: GaussNewton | None = None

    def add(self, each: Evaluation) -> None:
        """Add an evaluation.

        If the sum was created with ``owned``, later additions overwrite the arrays of the first evaluation.
        """
        for key, gradient in each.gradients.items():
            if self._count:
                gradient = np.add(self._sums[key], gradient, out=self._room(key))
            self._sums[key] = gradient
        for name, value in each.learned.items():
            self._known[name] = np.add(self._known[name], value) if self._count else value
        self._loss += each.loss
        self._dropped += Counter(each.dropped)
        if each.model is not None:
            self._model = each.model if self._model is None else self._model + each.model
        self._owned |= self._count > 0
        self._count += 1

    def _room(self, key: str) -> Array | None:
        """Return the array that contains the sum of the gradients of a variable, if the next sum may overwrite it.

        Returns None if the array must not be overwritten, for example read-only memory from another process.
        """
        here = self._sums[key]
        return here if self._owned and here.flags.writeable else None

    def of(self, share: float = 1.0) -> Evaluation:
        """Return the sum of losses and gradients, times ``share``, and the mean of the integrator's states.

        All evaluations of an iteration start from the same state of the integrator, so they can run concurrently.
        """
        sums, known = self._sums, self._known
        if share != 1:
            sums = {key: np.multiply(value, np.float32(share), out=self._room(key)) for key, value in sums.items()}
        if self._count > 1:
            known = {name: value / np.float32(self._count) for name, value in known.items()}
        model = None if self._model is None else self._model.times(share)
        return Evaluation(self._loss * share, sums, dict(self._dropped), known, model)


def total(evaluations: Iterable[Evaluation], share: float = 1.0, owned: bool = False) -> Evaluation:
    """Sum evaluations in the given order, and multiply the sum by ``share`` (see `Total`)."""
    found = Total(owned)
    for each in evaluations:
        found.add(each)
        del each
    return found.of(share)


class Executor(Protocol):
    """Evaluates the shards of an iteration, and yields results in the order of the shards.

    The caller drops each result before it requests the next result. Memory therefore contains only one gradient and the
    sum, for any number of shards.
    """

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> Iterator[Evaluation]:
        """Yield one evaluation per shard, in order. All evaluations start from the same state ``learned``."""


class Local:
    """`Executor` that evaluates shards sequentially in this process."""

    def __init__(self, evaluate: Evaluate) -> None:
        self.evaluate = evaluate

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> Iterator[Evaluation]:
        for shard in shards:
            yield self.evaluate(values, shard, learned)


def _taken(gradient: dr.ArrayBase) -> Array:
    """Convert a gradient to NumPy. For large grids, the result shares memory with Dr.Jit."""
    if dr.is_tensor_v(gradient) and dr.width(gradient) >= LARGE and dr.type_v(gradient) == dr.VarType.Float32:
        return gradient.numpy()
    return get_array(gradient)


def release(values: Arrays) -> None:
    """Free Dr.Jit's cache of unused memory if the cache may be large.

    Raises PathreplayError if the process uses more memory than the memory limit.
    """
    if any(value.size >= LARGE for value in values.values()) or memory.is_crowded():
        dr.flush_malloc_cache()
    memory.require_kept()


def owned_tensor(picture: Array) -> mi.TensorXf:
    """Copy an image into memory that Dr.Jit owns: see `owned`."""
    tensor = owned(mi.TensorXf(with_space(np.ascontiguousarray(picture))))
    dr.eval(tensor)
    return tensor


class Evaluator:
    """Evaluates shards of a problem with one integrator. After a call, the scene contains the values of this call.

    Only the variables ``moving`` (default: all) are differentiated. Views are rendered and back-propagated one by one,
    which limits memory to the AD graph of a single view.
    """

    def __init__(
        self,
        problem: Problem,
        integrator: mi.Integrator,
        record: bool = True,
        moving: Collection[str] | None = None,
    ) -> None:
        self.problem, self.integrator = problem, stateful(integrator)
        self._moving = frozenset((v.key for v in problem.variables) if moving is None else moving)
        self._reached = problem.reached(self._moving)
        has_media = facts_of(problem.scene).has_media
        # Deterministic jobs do not record passes: recording splits kernels differently, and thus changes the last bit
        # of results.
        # A user's loss may contain NumPy arrays. To copy one during a recording ends the process.
        loss = problem.loss not in ELSEWHERE and not isinstance(problem.loss, Own)
        recordable = record and loss and is_recordable(self.integrator, has_media)
        sensors = SharedSensors(problem, self._moving, self._reached) if recordable else None
        if sensors is not None and sensors.count * len(problem.scene.sensors()) > MOST_INPUTS:
            sensors = None
        self._sensors = sensors  # None if passes are not recorded
        self._recordings: defaultdict[int, Recordings] = defaultdict(Recordings)  # Keys: samples per pixel.
        # Whether one pass computes image and gradient. Keys: kind of view (see `SharedSensors`), samples per pixel, and
        # whether pixels are batched.
        self._sweeps: dict[tuple[Which, int, bool], bool] = {}
        self._learned: Arrays = {}  # State of the integrator after the last evaluation.
        self._at: object = None  # `integrator.baseline` after the last evaluation. Another evaluator may replace it.
        self._begun = False
        self._jacobians: Jacobians | None = None

    @property
    def freezes(self) -> bool:
        """Whether passes are recorded. The first attempt may show that they cannot be recorded."""
        return self._sensors is not None

    def __call__(self, values: Arrays, shard: Shard, learned: Arrays) -> Evaluation:
        """See `Evaluate`. Errors and warnings of the integrator are passed to the caller."""
        if self.freezes and not self._begun:
            for about in self.problem.views:
                make_ready(sensor_of(self.problem, about))
        self._begun = True

        def each() -> Iterator[Evaluation]:
            for view, seed in zip(shard.views, shard.seeds, strict=True):
                self._know(learned)
                if shard.second_order:
                    yield self._second_order(values, view, seed, shard.samples)
                else:
                    yield self._view(values, view, seed, shard.samples, shard.pixels)

        return total(each(), owned=True)

    def _know(self, learned: Arrays) -> None:
        """Load the state ``learned`` into the integrator. Raises PathreplayError if the kinds of integrator differ."""
        held = self.integrator.baseline
        if (learned is self._learned and held is self._at) or (held is None and not learned):
            return
        self.integrator.load_state_dict(self.problem.scene, learned)
        self._learned, self._at = learned, self.integrator.baseline

    def _second_order(self, values: Arrays, view: int, seed: int, spp: int) -> Evaluation:
        """Evaluate loss, gradient and Gauss-Newton model of a view by forward-mode differentiation."""
        sensor_of(self.problem, self.problem.views[view])
        if self._jacobians is None:
            self._jacobians = Jacobians(self.problem, self.integrator, self._moving, self._sensors)
        try:
            with plain_errors():
                loss, gradients, dropped, model = self._jacobians.model(values, view, seed, spp)
        except NotRecordable:
            self._sensors = self._jacobians = None
            return self._second_order(values, view, seed, spp)
        release(values)
        self._learned, self._at = self.integrator.state_dict(), self.integrator.baseline
        return Evaluation(loss, gradients, dropped, self._learned, model)

    def _view(self, values: Arrays, view: int, seed: int, spp: int, pixels: int | None) -> Evaluation:
        about = self.problem.views[view]
        sensor_of(self.problem, about)
        variables = self.problem.cache.variables(self.problem, values)
        moving = {key: value for key, value in variables.items() if key in self._moving}
        if view in self._reached:
            dr.enable_grad(moving)
        self.problem.params.update(scene_values(self.problem, variables))
        try:
            factor = factor_of(values, view, about.target.shape[2])
            batch = None if pixels is None else Batch.of(about.weight, about.target.shape[:2], pixels, seed)
            loss, by_factor, by_target = self._differentiated(values, view, seed, spp, factor, batch)
        except NotRecordable:  # a part of the gradient may have been added: start again with a zero gradient
            self._sensors = None
            return self._view(values, view, seed, spp, pixels)
        gradients: dict[str, Array] = {}
        for key, value in moving.items():
            gradient = _taken(dr.grad(value))  # The gradient is zero if the variable does not affect the view.
            # Equal gradients may be one array of Dr.Jit, but `Total` overwrites each gradient on its own.
            shared = any(np.may_share_memory(gradient, other) for other in gradients.values())
            gradients[key] = gradient.copy() if shared else gradient
            dr.clear_grad(value)  # The scene refers to the variable, which would keep the gradient in memory.
        release(values)
        if by_factor is not None:
            gradients[EXPOSURE] = exposure_gradient(values, view, np.array(by_factor).ravel())
        if by_target is not None:
            gradients[RESPONSE] = response_gradient(values, about.target, np.array(by_target))
        # One bad path must not end a long run. A sum is finite only if all entries are, and needs no temporary array.
        broken = [key for key, gradient in gradients.items() if not np.isfinite(gradient.sum(dtype=np.float64))]
        dropped = {key: int((~np.isfinite(gradients[key])).sum()) for key in broken}
        for key in broken:
            gradients[key] = np.where(np.isfinite(gradients[key]), gradients[key], 0)
        self._learned, self._at = self.integrator.state_dict(), self.integrator.baseline
        return Evaluation(loss, gradients, dropped, self._learned)

    def _differentiated(
        self, values: Arrays, view: int, seed: int, spp: int, factor: Array | None, batch: Batch | None
    ) -> tuple[float, mi.TensorXf | None, mi.TensorXf | None]:
        """Return the view's contribution to the loss, and the derivatives with respect to ``factor`` and to the target.

        A derivative that is not needed is None. The gradients of scene parameters are accumulated in the parameters.
        """
        problem, about = self.problem, self.problem.views[view]
        picture, counts = linearized(values, about.target), about.weight
        if batch is not None:
            picture, counts = batch.rows(picture), None if counts is None else batch.rows(counts)
        others = (None if part is None else owned_tensor(part) for part in (counts, factor))
        target = ViewTarget(owned_tensor(picture), *others)
        # The first call is not recorded, because Mitsuba creates some parts of a scene during its first rendering.
        kind = about.sensor if self._sensors is None else self._sensors.kind(view)
        which = kind, spp, batch is not None
        sensors = self._sensors if which in self._sweeps else None
        if which not in self._sweeps:
            why = obstacle(problem, self.integrator, about.sensor, spp, batch is not None)
            if why and batch is not None:
                raise refused(about.name, why)
            self._sweeps[which] = not why and view in self._reached
        # Seeds are inputs of recorded passes. Other passes take plain integers, which avoids reads from the device.
        number = dr.opaque(mi.UInt32, seed) if self.freezes else seed
        share = about.share / len(problem.trained()) * (1 if batch is None else batch.share)
        loss = ViewLoss(
            problem.loss,
            dr.opaque(mi.Float, share) if self.freezes else share,
            self._sweeps[which],
            EXPOSURE in self._moving,
            RESPONSE in self._moving,
            problem.debias,
        )
        problem.disk.rest()
        with plain_errors():
            sensor = about.sensor if sensors is None else sensors.of(view)
            request = RenderRequest(sensor, number, spp, None if batch is None else batch.pixels)
            step = differentiate if sensors is None else self._recordings[spp].differentiate
            found = step(problem.params, problem.scene, self.integrator, request, target, loss)
        self.integrator.keep(problem.scene, found.state)
        return float(found.loss[0]) if dr.width(found.loss) else float("nan"), found.by_factor, found.by_target
