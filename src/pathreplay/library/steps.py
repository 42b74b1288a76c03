"""One step of a minimisation as a pure function of a problem and a state, for loops of a user's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.loop import best_values, new_run, optimiser_of, require_gradients, take_step
from pathreplay.inverse.objective.evaluate import Executor, Local, computing
from pathreplay.inverse.objective.stages import evaluator_of
from pathreplay.inverse.optim import adaptive
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem import problem as inner
from pathreplay.library.optimizers import Stepper, adapted, options_of
from pathreplay.library.problem import Problem


class _Task:
    """What the states of one minimisation share: settings, kernels, and an optimiser that is at one of them."""

    def __init__(self, changes: Mapping[str, Any]) -> None:
        self._changes = changes
        self.own: adaptive.Optimiser | None = None
        """Of the user's, where it is none of ours."""
        self._known: WeakKeyDictionary[Problem, tuple[inner.Problem, Executor]] = WeakKeyDictionary()
        self.at: State | None = None
        self.optimiser: adaptive.Optimiser | None = None

    def of(self, problem: Problem, name: str = "step") -> tuple[inner.Problem, Executor]:
        """The problem with these settings, and who evaluates it; ``name`` is who asks."""
        if problem not in self._known:
            built = problem.configured(self._changes, name)
            config = built.config
            executor = Local(evaluator_of(built, config, built.integrator, config.integrator))
            self._known[problem] = built, executor
        return self._known[problem]

    def optimiser_at(self, state: State, built: inner.Problem) -> adaptive.Optimiser:
        """An optimiser that goes on from the state."""
        if self.optimiser is None or self.at is not state:
            # A new one: what a line search has found out since is not to be known.
            self.optimiser = self.own or optimiser_of(built, state._next, built.config.optimizer)
            self.optimiser.restore(state._kept, state._next)
        self.at = None  # until the step is done
        return self.optimiser


@dataclass(frozen=True, repr=False, eq=False)
class State:
    """Where a minimisation is. Nothing changes it: `step` makes another."""

    values: Mapping[str, Array]
    """By name; the best so far where the optimizer searches along lines."""
    history: tuple[Entry, ...]
    """One entry for each step: loss, seconds, norms of gradients, ..."""
    finished: str
    """Why the optimizer takes no more steps; "" while it does."""
    _next: Arrays = field(repr=False)
    _learned: Arrays = field(repr=False)
    _kept: adaptive.State = field(repr=False)
    _task: _Task = field(repr=False)

    def __repr__(self) -> str:
        """Short: a notebook prints it."""
        loss = f", loss {self.loss:.4g}" if self.history else ""
        return f"<State: after {len(self.history)} steps{loss}; {', '.join(self.values)}>"

    @property
    def loss(self) -> float:
        """Of the last step, before it; NaN before the first."""
        return self.history[-1].loss if self.history else float("nan")


def init(
    problem: Problem,
    optimizer: str | Mapping[str, Any] | Stepper | Any = None,
    steps: int | None = None,
    **settings: Any,
) -> State:
    """Make the state at which a minimisation begins.

    Args:
        problem: what shall be minimised.
        optimizer: as `minimize` takes it; an object of your own needs ``state_dict()`` and ``load_state_dict(arrays)``.
            The states own an object that is given here.
        steps: the length of the schedule, whose last learning rate stays after it; it ends nothing.
        **settings: as `minimize` takes them: ``stages``, ``learning_rate_schedule``, ``view_batch_size``, ...

    Returns:
        The state before the first step.

    Raises:
        PathreplayError: for settings that cannot work.
    """
    options, own = options_of(optimizer)
    given = {"iterations": steps, "optimizer": options, **settings}
    changes = {key: value for key, value in given.items() if value is not None}
    task = _Task(changes)
    built, executor = task.of(problem, "init")
    run = new_run(built, built.integrator, optimizer=built.config.optimizer, executor=executor)
    if own is not None:
        run.optimiser = task.own = adapted(own, built, run.values)
    return State(run.values, (), "", run.values, {}, _copied(run.optimiser.state()), task)


def step(problem: Problem, state: State) -> State:
    """Take one step: evaluate the problem at the state, and step against its gradient.

    A pure function, but for rounding where threads add; with ``deterministic`` the same state gives the same bits. The
    problem may be another one with the same parameters at each step, so that several scenes are learned from in turn.
    Kernels are recorded by the second step of each problem, and used by all later ones.

    Args:
        problem: what is minimised.
        state: of `init`, or of a step before.

    Returns:
        The state after the step; ``state`` itself where the optimizer has finished.

    Raises:
        PathreplayError: loss or values are no longer finite, or the problem has other parameters than the state.
    """
    if state.finished:
        return state
    task = state._task
    built, executor = task.of(problem)
    if (keys := {v.key for v in built.variables}) != set(state._next):
        raise PathreplayError(
            f"The state has the parameters {', '.join(state._next)}, and the problem {', '.join(sorted(keys))}; begin "
            "anew with init"
        )
    optimiser = task.optimiser_at(state, built)
    run = Run(executor, optimiser, dict(state._next), state._learned, list(state.history))
    with computing(built.config):
        take_step(built, built.config, run, min(len(state.history), built.config.iterations - 1))
    require_gradients(built.config, run)
    found = best_values(built, run)
    kept = _copied(optimiser.state())
    after = State(found, tuple(run.history), optimiser.finished, run.values, run.learned, kept, task)
    task.at = after
    return after


def _copied(state: adaptive.State) -> adaptive.State:
    """What an optimiser remembers, in arrays that it does not change any more."""
    return adaptive.State(dict(state.steps), {name: np.array(state.arrays[name]) for name in state.arrays})
