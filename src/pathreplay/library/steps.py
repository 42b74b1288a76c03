"""One optimisation step as a pure function of problem and state, for custom loops."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.loop import best_values, new_run, optimiser_of, require_gradients, take_step
from pathreplay.inverse.objective.evaluate import Executor, Local
from pathreplay.inverse.objective.stages import evaluator_of, restore_films
from pathreplay.inverse.optim import adaptive
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import latents
from pathreplay.inverse.problem import problem as inner
from pathreplay.library.optimizers import OfMitsuba, Stepper, adapted, options_of, require_no_options
from pathreplay.library.problem import Problem, run_settings


class _Task:
    """Settings, kernels and optimiser that all states of an optimisation share.

    The internal state of the optimiser belongs to the `State` in ``at``. If ``at`` is None, it is unknown to which
    `State` the internal state belongs.
    """

    def __init__(self, changes: Mapping[str, object]) -> None:
        self._changes = changes
        self.own: adaptive.Optimiser | None = None
        """Optimiser object of the user, if any."""
        self._known: WeakKeyDictionary[Problem, tuple[inner.Problem, Executor]] = WeakKeyDictionary()
        self.at: State | None = None
        self.optimiser: adaptive.Optimiser | None = None

    def of(self, problem: Problem, name: str = "step") -> tuple[inner.Problem, Executor]:
        """Return ``problem`` with the changed settings, and its executor. Error messages begin with ``name``.

        Raises PathreplayError if a setting is invalid, or the problem's ``executor`` is not ``local``.
        """
        if problem not in self._known:
            built = problem.configured(self._changes, name)
            config = built.config
            if config.executor != "local":
                raise PathreplayError(
                    f"{name}: executor = '{config.executor}' is for minimize, and steps are computed in this process; "
                    "set executor to 'local'"
                )
            executor = Local(evaluator_of(built, built.integrator, config.integrator))
            self._known[problem] = built, executor
        return self._known[problem]

    def optimiser_at(self, state: State, built: inner.Problem) -> adaptive.Optimiser:
        """Return an optimiser whose internal state is that of ``state``."""
        if self.optimiser is None or self.at is not state:
            self.optimiser = self.own or optimiser_of(built, state._next, built.config.optimizer)
            self.optimiser.restore(state._kept, latents(built.variables, state._next))
        if isinstance(self.optimiser, OfMitsuba):
            self.optimiser.use(built)
        self.at = None  # a failed step would leave the optimiser in an unknown state; a successful step sets `at` again
        return self.optimiser


@dataclass(frozen=True, repr=False, eq=False)
class State:
    """State of an optimisation, immutable: `step` returns the next one."""

    values: Mapping[str, Array]
    """Values by name, which are the best estimate so far, not always the values of the next evaluation."""
    history: tuple[Entry, ...]
    """One entry per step: loss, seconds, gradient norms and more."""
    finished: str
    """Reason why the optimizer has terminated, or ""."""
    _next: Arrays = field(repr=False)
    _learned: Arrays = field(repr=False)
    _kept: adaptive.State = field(repr=False)
    _task: _Task = field(repr=False)

    def __repr__(self) -> str:
        loss = f", loss {self.loss:.4g}" if self.history else ""
        return f"<State: after {len(self.history)} steps{loss}; {', '.join(self.values)}>"

    @property
    def loss(self) -> float:
        """Return the loss before the last step; NaN before the first step."""
        return self.history[-1].loss if self.history else float("nan")


def init(
    problem: Problem,
    optimizer: str | Mapping[str, object] | Stepper | object = None,
    steps: int | None = None,
    **settings: object,
) -> State:
    """Create the initial state of an optimisation.

    Args:
        problem: the problem.
        optimizer: see `minimize`. A custom object needs ``state_dict()`` and ``load_state_dict(arrays)``. The object is
            modified by `step` and must not be used elsewhere.
        steps: length of the learning rate schedule, after which the last rate is kept. Default: see `minimize`.
        **settings: see `minimize`, such as ``stages``, ``learning_rate_schedule`` or ``view_batch_size``.

    Returns:
        The state before the first step.

    Raises:
        PathreplayError: the settings are invalid, or ``executor`` is not ``local``.
    """
    require_no_options("init", settings, optimizer, problem.built.config.optimizer)
    options, own = options_of(optimizer, problem.built.config.optimizer)
    task = _Task(run_settings("init", steps, options, settings))
    built, executor = task.of(problem, "init")
    run = new_run(built, built.integrator, optimizer=built.config.optimizer, executor=executor)
    if own is not None:
        run.optimiser = task.own = adapted(own, built, run.values)
    return State(run.values, (), "", run.values, {}, _copied(run.optimiser.state()), task)


def step(problem: Problem, state: State) -> State:
    """Take one optimisation step: evaluate loss and gradient, and update the values.

    The function is pure up to rounding in multithreaded sums; with ``deterministic``, it is bitwise pure. The problem
    may differ from step to step if its parameters stay the same. The second step of each problem records kernels, which
    later steps replay.

    Args:
        problem: the problem.
        state: state from `init` or from an earlier step.

    Returns:
        The state after the step, or ``state`` itself if the optimizer has terminated.

    Raises:
        PathreplayError: loss or values are not finite, the problem and the state have different parameters, or another
            variant is active than when the problem was created.
    """
    problem.require_variant()
    if state.finished:
        return state
    task = state._task
    built, executor = task.of(problem)
    if (keys := {v.key for v in built.variables}) != set(state._next):
        raise PathreplayError(
            f"The state has the parameters {', '.join(state._next)}, but the problem has {', '.join(sorted(keys))}; "
            "start again with init"
        )
    optimiser = task.optimiser_at(state, built)
    run = Run(executor, optimiser, dict(state._next), state._learned, list(state.history))
    with built.computing():
        try:
            take_step(built, run, min(len(state.history), built.config.iterations - 1))
        finally:
            restore_films(built)
            inner.detach(built)
    require_gradients(built, run)
    found = best_values(built, run)
    kept = _copied(optimiser.state())
    after = State(found, tuple(run.history), optimiser.finished, run.values, run.learned, kept, task)
    task.at = after
    return after


def _copied(state: adaptive.State) -> adaptive.State:
    return adaptive.State(dict(state.steps), {name: np.array(state.arrays[name]) for name in state.arrays})
