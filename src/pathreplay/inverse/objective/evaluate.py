"""The loss of a problem and its gradient as a function of values and shard, and who computes them, and where."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.integrators.film.image import make_ready
from pathreplay.integrators.lifetimes import plain_errors
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.losses.pixelwise import ELSEWHERE
from pathreplay.inverse.objective.frozen import (
    NotRecordable,
    Recordings,
    RenderRequest,
    ViewLoss,
    ViewTarget,
    differentiate,
    is_recordable,
)
from pathreplay.inverse.objective.pixel_batches import Batch, obstacle, refused
from pathreplay.inverse.parameters.exposures import EXPOSURE, factor_of
from pathreplay.inverse.parameters.exposures import gradient as exposure_gradient
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem.problem import Problem, scene_values, sensor_of
from pathreplay.platform import memory
from pathreplay.scenes.parameters import get_array

LARGE = 2**22
"""Entries of a variable from which on its memory is looked after."""
MOST_SENSORS = 64
"""Of a scene whose passes are recorded: what is recorded of a view holds all sensors, so that memory grows with the
square of their number (by measurement 3 MB a view where there are 50, and 11 MB where there are 200)."""


@dataclass(frozen=True)
class Shard:
    """A part of an iteration: views (places in the problem), samples per pixel, and a seed for each view."""

    views: tuple[int, ...]
    samples: int
    seeds: tuple[int, ...]
    stage: int = 0
    """Of the job, whose views these are, and which says what is differentiated."""
    pixels: int | None = None
    """Of each view, drawn by its seed; None: all."""


@dataclass(frozen=True)
class Evaluation:
    """What a shard adds to the loss (the mean over views that are learned from) and to its gradient, by key.

    And what is known after it. Unbiased for the losses in `QUADRATIC`; the loss itself carries the variance of the
    pictures on top.
    """

    loss: float
    gradients: dict[str, Array]
    dropped: dict[str, int]
    """By key, how many entries of its gradient were NaN or infinite in a view, and count as zero there."""
    learned: Arrays


Evaluate = Callable[[Arrays, Shard, Arrays], Evaluation]
"""evaluate(values, shard, learned): a pure function, but for rounding where threads add.

The values are those of all variables, as people see them; ``learned`` is what evaluations before have learned, by name.
"""


class Total:
    """A sum of evaluations as they come, of which only the sum is held."""

    def __init__(self, owned: bool = False) -> None:
        self._owned, self._count, self._loss = owned, 0, 0.0
        self._sums: dict[str, Array] = {}
        self._known: dict[str, Array] = {}
        self._dropped: Counter[str] = Counter()

    def add(self, each: Evaluation) -> None:
        """Add gradients in place, to those of the first evaluation, too, where these are ``owned`` by nobody else."""
        for key, gradient in each.gradients.items():
            if self._count:
                gradient = np.add(self._sums[key], gradient, out=self._room(key))
            self._sums[key] = gradient
        for name, value in each.learned.items():
            self._known[name] = np.add(self._known[name], value) if self._count else value
        self._loss += each.loss
        self._dropped += Counter(each.dropped)
        self._owned |= self._count > 0
        self._count += 1

    def _room(self, key: str) -> Array | None:
        """Where a sum may be written: what came from another process may only be read."""
        here = self._sums[key]
        return here if self._owned and here.flags.writeable else None

    def of(self, share: float = 1.0) -> Evaluation:
        """The sum times ``share``; what is known is the mean of what each of them knows.

        They began with the same knowledge, so that none had to wait for another.
        """
        sums, known = self._sums, self._known
        if share != 1:
            sums = {key: np.multiply(value, np.float32(share), out=self._room(key)) for key, value in sums.items()}
        if self._count > 1:
            known = {name: value / np.float32(self._count) for name, value in known.items()}
        return Evaluation(self._loss * share, sums, dict(self._dropped), known)


def total(evaluations: Iterable[Evaluation], share: float = 1.0, owned: bool = False) -> Evaluation:
    """The sum, added up in the order given, times ``share``: see `Total`."""
    found = Total(owned)
    for each in evaluations:
        found.add(each)
        del each
    return found.of(share)


class Executor(Protocol):
    """Evaluates the shards of an iteration. Results come in the order of the shards, whoever was ready first.

    Each is given when it is asked for and none is wanted back: memory holds one gradient and the sum, however many
    shards there are.
    """

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> Iterator[Evaluation]:
        """One evaluation for each shard, in their order; each begins with what was ``learned`` before all of them."""


class Local:
    """In this process, one after the other."""

    def __init__(self, evaluate: Evaluate) -> None:
        self.evaluate = evaluate

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> Iterator[Evaluation]:
        """See `Executor`."""
        for shard in shards:
            yield self.evaluate(values, shard, learned)


def _taken(gradient: Any) -> Array:
    """A gradient as NumPy's; one of a large grid in the memory that Dr.Jit has made it in."""
    if dr.is_tensor_v(gradient) and dr.width(gradient) >= LARGE and dr.type_v(gradient) == dr.VarType.Float32:
        return gradient.numpy()
    return get_array(gradient)


def release(values: Arrays) -> None:
    """Give memory back that Dr.Jit has done with and keeps for later, where it is much; hold the run to its budget.

    Raises PathreplayError where that is not kept.
    """
    if any(value.size >= LARGE for value in values.values()) or memory.is_crowded():
        dr.flush_malloc_cache()
    memory.require_kept()


def held_tensor(picture: Array) -> Any:
    """A picture in memory of Dr.Jit's own: see `variables_of`."""
    tensor = mi.TensorXf(np.ascontiguousarray(picture)) * dr.opaque(mi.Float, 1)
    dr.eval(tensor)
    return tensor


class Evaluator:
    """Evaluates shards of a problem by one integrator, in its scene, which keeps the values of the last shard.

    ``moving`` are the variables that are differentiated (default: all).

    One view is rendered and back-propagated after the other: memory holds the graph of one.
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
        # Recorded kernels are cut otherwise than traced ones, and round otherwise in the last bit.
        known = len(problem.scene.sensors()) <= MOST_SENSORS
        self.freezes = known and record and is_recordable(self.integrator, has_media) and problem.loss not in ELSEWHERE
        self._recordings: defaultdict[int, Recordings] = defaultdict(Recordings)  # by samples per pixel
        # Of each view and number of samples that was seen, whole or a batch of it: whether pixels can be swept.
        self._sweeps: dict[tuple[int, int, bool], bool] = {}
        self._learned: Arrays = {}  # state of the integrator after the last evaluation
        self._at: Any = None  # its state then, which another evaluator may have changed since
        self._begun = False

    def __call__(self, values: Arrays, shard: Shard, learned: Arrays) -> Evaluation:
        """See `Evaluate`. Raises what the integrator raises; warns as it does."""
        if self.freezes and not self._begun:
            for about in self.problem.views:
                make_ready(sensor_of(self.problem, about))
        self._begun = True

        def each() -> Iterator[Evaluation]:
            for view, seed in zip(shard.views, shard.seeds, strict=True):
                self._know(learned)
                yield self._view(values, view, seed, shard.samples, shard.pixels)

        return total(each(), owned=True)

    def _know(self, learned: Arrays) -> None:
        """Go on with what an evaluation has learned. Raises PathreplayError if it is none of this integrator's."""
        held = self.integrator.baseline
        if (learned is self._learned and held is self._at) or (held is None and not learned):
            return
        self.integrator.load_state_dict(self.problem.scene, learned)
        self._learned, self._at = learned, self.integrator.baseline

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
            loss, by_factor = self._differentiated(view, seed, spp, factor, batch)
        except NotRecordable:  # a part of the gradient may be there: once more, with variables of its own
            self.freezes = False
            return self._view(values, view, seed, spp, pixels)
        gradients = {}
        for key, value in moving.items():
            gradients[key] = _taken(dr.grad(value))  # zero in a view that nothing reaches
            dr.clear_grad(value)  # which the scene holds
        release(values)
        if by_factor is not None and EXPOSURE in gradients:
            gradients[EXPOSURE] = exposure_gradient(values, view, np.array(by_factor).ravel())
        # One bad path does not end a long run. (A sum is finite where all is: it takes no memory.)
        broken = [key for key, gradient in gradients.items() if not np.isfinite(gradient.sum(dtype=np.float64))]
        dropped = {key: int((~np.isfinite(gradients[key])).sum()) for key in broken}
        for key in broken:
            gradients[key] = np.where(np.isfinite(gradients[key]), gradients[key], 0)
        self._learned, self._at = self.integrator.state_dict(), self.integrator.baseline
        return Evaluation(loss, gradients, dropped, self._learned)

    def _differentiated(
        self, view: int, seed: int, spp: int, factor: Array | None, batch: Batch | None
    ) -> tuple[float, Any]:
        """What the view adds to the loss, and the derivative by its ``factor``; the rest is added to the parameters."""
        problem, about = self.problem, self.problem.views[view]
        sensor, picture, counts = about.sensor, about.target, about.weight
        if batch is not None:
            picture, counts = batch.rows(picture), None if counts is None else batch.rows(counts)
        target = ViewTarget(*(None if part is None else held_tensor(part) for part in (picture, counts, factor)))
        # The first call is not recorded: scenes make some of their parts when they are first rendered.
        which = view, spp, batch is not None
        records = self.freezes and which in self._sweeps
        if which not in self._sweeps:
            why = obstacle(problem, self.integrator, sensor, spp, batch is not None)
            if why and batch is not None:
                raise refused(about.name, why)
            self._sweeps[which] = not why and view in self._reached
        # Of recorded passes seeds are inputs; of others they are best numbers, which nobody has to read back.
        number: Any = dr.opaque(mi.UInt32, seed) if self.freezes else seed
        request = RenderRequest(sensor, number, spp, batch)
        loss = ViewLoss(problem.loss, about.share / len(problem.trained()), self._sweeps[which])
        problem.disk.rest()
        with plain_errors():
            step = self._recordings[spp].differentiate if records else differentiate
            found = step(problem.params, problem.scene, self.integrator, request, target, loss)
        self.integrator.keep(problem.scene, found.state)
        return float(found.loss[0]) if dr.width(found.loss) else float("nan"), found.by_factor
