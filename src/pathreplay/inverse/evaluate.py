"""The loss of a problem and its gradient as a function of values and shard, and who computes them, and where."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.exposures import EXPOSURE, factor_of
from pathreplay.inverse.exposures import gradient as exposure_gradient
from pathreplay.inverse.losses import ELSEWHERE, QUADRATIC
from pathreplay.inverse.problem import Problem, scene_values, variables_of
from pathreplay.inverse.recorded import NotRecordable, Recordings, differentiate, is_recordable
from pathreplay.inverse.values import Array, Arrays
from pathreplay.render.facts import SceneFacts
from pathreplay.render.film import fit_film
from pathreplay.render.path_integrator import plain_errors
from pathreplay.scenes.parameters import get_array


@dataclass(frozen=True)
class Shard:
    """A part of an iteration: views (places in the problem), samples per pixel, and a seed for each view."""

    views: tuple[int, ...]
    samples: int
    seeds: tuple[int, ...]
    stage: int = 0
    """Of the job, whose views these are, and which says what is differentiated."""


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

    def of(self, share: float) -> Evaluation:
        """So many times the loss and the gradient, as if so many more views had been evaluated that are like these."""
        if share == 1:
            return self
        gradients = {key: gradient * np.float32(share) for key, gradient in self.gradients.items()}
        return replace(self, loss=self.loss * share, gradients=gradients)


Evaluate = Callable[[Arrays, Shard, Arrays], Evaluation]
"""evaluate(values, shard, learned): a pure function, but for rounding where threads add.

The values are those of all variables, as people see them; ``learned`` is what evaluations before have learned, by name.
"""


def total(evaluations: Sequence[Evaluation]) -> Evaluation:
    """The sum, added up in the order given; what is known is the mean of what each of them knows.

    They began with the same knowledge, so that none had to wait for another.
    """
    if len(evaluations) == 1:
        return evaluations[0]
    known = {
        name: reduce(np.add, [each.learned[name] for each in evaluations]) / np.float32(len(evaluations))
        for name in evaluations[0].learned
    }
    return Evaluation(
        sum(each.loss for each in evaluations),
        {key: reduce(np.add, [each.gradients[key] for each in evaluations]) for key in evaluations[0].gradients},
        dict(sum((Counter(each.dropped) for each in evaluations), Counter())),
        known,
    )


class Executor(Protocol):
    """Evaluates the shards of an iteration. Results come in the order of the shards, whoever was ready first."""

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> list[Evaluation]:
        """One evaluation for each shard, in their order; each begins with what was ``learned`` before all of them."""


class Local:
    """In this process, one after the other."""

    def __init__(self, evaluate: Evaluate) -> None:
        self.evaluate = evaluate

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> list[Evaluation]:
        """See `Executor`."""
        return [self.evaluate(values, shard, learned) for shard in shards]


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
        self.problem, self.integrator = problem, integrator
        self._moving = {v.key for v in problem.variables} if moving is None else set(moving)
        self._facts = facts = SceneFacts(problem.scene)
        # Recorded kernels are cut otherwise than traced ones, and round otherwise in the last bit.
        self.freezes = record and is_recordable(integrator, facts.has_media) and problem.loss not in ELSEWHERE
        self._targets = [mi.TensorXf(view.target) for view in problem.views]
        self._weights = [None if view.weight is None else mi.TensorXf(view.weight) for view in problem.views]
        self._recordings: defaultdict[int, Recordings] = defaultdict(Recordings)  # by samples per pixel
        # Of each view and number of samples that was seen: whether pixels can be swept.
        self._sweeps: dict[tuple[int, int], bool] = {}
        self._learned: Arrays = {}  # what the integrator knows

    def __call__(self, values: Arrays, shard: Shard, learned: Arrays) -> Evaluation:
        """See `Evaluate`. Raises what the integrator raises; warns as it does."""
        found = []
        for view, seed in zip(shard.views, shard.seeds, strict=True):
            self._know(learned)
            found.append(self._view(values, view, seed, shard.samples))
        return total(found)

    def _know(self, learned: Arrays) -> None:
        """Go on with what an evaluation has learned. Raises PathreplayError if it is none of this integrator's."""
        if learned is self._learned or not (learned or self._learned):
            return
        if not hasattr(self.integrator, "restore_learned"):
            raise PathreplayError(
                "The checkpoint holds what another integrator has learned of media; set the config's 'integrator' "
                "back, or start a new run"
            )
        self.integrator.restore_learned(self.problem.scene, learned)
        self._learned = learned

    def _view(self, values: Arrays, view: int, seed: int, spp: int) -> Evaluation:
        fit_film(self.problem.scene.sensors()[self.problem.views[view].sensor], self._targets[view].shape)
        variables = variables_of(self.problem, values)
        moving = {key: value for key, value in variables.items() if key in self._moving}
        dr.enable_grad(moving)
        self.problem.params.update(scene_values(self.problem, variables))
        try:
            factor = factor_of(values, view, self._targets[view].shape[2])
            loss, by_factor = self._differentiated(view, seed, spp, None if factor is None else mi.TensorXf(factor))
        except NotRecordable:  # a part of the gradient may be there: once more, with variables of its own
            self.freezes = False
            return self._view(values, view, seed, spp)
        gradients = {key: get_array(dr.grad(value)) for key, value in moving.items()}
        if by_factor is not None and EXPOSURE in gradients:
            gradients[EXPOSURE] = exposure_gradient(values, view, np.array(by_factor).ravel())
        fine = {key: np.isfinite(gradient) for key, gradient in gradients.items()}
        # One bad path does not end a long run.
        dropped = {key: int((~each).sum()) for key, each in fine.items() if not each.all()}
        if dropped:
            gradients = {key: np.where(fine[key], gradient, 0) for key, gradient in gradients.items()}
        if hasattr(self.integrator, "learned"):
            self._learned = self.integrator.learned()
        return Evaluation(loss, gradients, dropped, self._learned)

    def _differentiated(self, view: int, seed: int, spp: int, factor: Any = None) -> tuple[float, Any]:
        """What the view adds to the loss, and the derivative by its ``factor``; the rest is added to the parameters."""
        problem, target = self.problem, self._targets[view]
        sensor = problem.views[view].sensor
        # The first call is not recorded: scenes make some of their parts when they are first rendered.
        which = view, spp
        records = self.freezes and which in self._sweeps
        if which not in self._sweeps:
            may = problem.loss in QUADRATIC and hasattr(self.integrator, "sweeps_pixels")
            scene = problem.scene
            self._sweeps[which] = may and bool(self.integrator.sweeps_pixels(scene, scene.sensors()[sensor], spp))
        # Of recorded passes seeds are inputs; of others they are best numbers, which nobody has to read back.
        number: Any = dr.opaque(mi.UInt32, seed) if self.freezes else seed
        share = problem.views[view].share / len(problem.trained())
        with plain_errors():
            value, lost, by_factor = (self._recordings[spp].differentiate if records else differentiate)(
                problem.params, problem.scene, sensor, self.integrator, target, self._weights[view], number, spp,
                problem.loss, share, self._sweeps[which], self._facts.tables(), factor,
            )  # fmt: skip
        if lost is not None:
            self.integrator.tell_lost(lost, target.shape[0] * target.shape[1] * spp)
        return float(value[0]) if dr.width(value) else float("nan"), by_factor
