"""Evaluation of joint problems, in which each shard belongs to one of several scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.objective.evaluate import Evaluate, Evaluation, Shard
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.inverse.problem.joint import JointProblem


class JointEvaluator:
    """Evaluates each shard of a joint problem with the evaluator of its scene.

    All views of a shard belong to one scene. In the learned state, the names of arrays begin with the
    index of the scene.
    """

    def __init__(self, problem: JointProblem, parts: Sequence[Evaluate]) -> None:
        self._problem, self._parts = problem, parts
        self._fresh: dict[str, np.ndarray] = {}
        for n, part in enumerate(problem.parts):
            integrator = stateful(part.integrator)
            integrator.load_state_dict(part.scene, {})
            self._fresh |= {f"{n}:{name}": array for name, array in integrator.state_dict().items()}

    def __call__(self, values: Arrays, shard: Shard, learned: Arrays) -> Evaluation:
        """See `Evaluate`. Loss and gradients are divided by the number of scenes."""
        places = [self._problem.place(view) for view in shard.views]
        ((n, part),) = {number: self._problem.parts[number] for number, _ in places}.items()
        known = learned or self._fresh
        found = self._parts[n](
            {v.key: values[v.key] for v in part.variables},
            replace(shard, views=tuple(view for _, view in places)),
            {name.removeprefix(f"{n}:"): array for name, array in known.items() if name.startswith(f"{n}:")},
        )
        share = np.float32(1 / len(self._parts))
        gradients = {key: np.zeros_like(value) for key, value in values.items() if key not in found.gradients}
        gradients |= {key: share * gradient for key, gradient in found.gradients.items()}
        after = {**known, **{f"{n}:{name}": array for name, array in found.learned.items()}}
        model = None
        if found.model is not None:
            sizes = {v.key: values[v.key].size for v in self._problem.variables}
            model = found.model.within(sizes).times(1 / len(self._parts))
        return Evaluation(found.loss / len(self._parts), gradients, found.dropped, after, model)
