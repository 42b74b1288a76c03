"""Minimisation of a problem in memory: steps, callbacks, and the result. It writes no files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.loop.events import Stepped
from pathreplay.inverse.loop.loop import best_values, computed, new_run
from pathreplay.inverse.objective.evaluate import computing
from pathreplay.inverse.objective.stages import Staged, require_single_pixels, require_stages
from pathreplay.inverse.parameters.values import Array
from pathreplay.inverse.problem.problem import put_values
from pathreplay.library.optimizers import Stepper, adapted
from pathreplay.library.problem import Problem
from pathreplay.platform.interrupts import Stop, stopping
from pathreplay.report.progress import Progress
from pathreplay.report.recovered import with_scene


@dataclass(frozen=True)
class Iteration:
    """One iteration, as callbacks see it. Nothing in it changes when the minimisation goes on."""

    entry: Entry
    """What the history says of it."""
    values: Mapping[str, Array]
    """After the step, by name."""
    _problem: Problem = field(repr=False)

    @property
    def number(self) -> int:
        """From 0."""
        return self.entry.iteration

    @property
    def loss(self) -> float:
        """Before the step."""
        return self.entry.loss

    def render(self, view: int = 0, spp: int | None = None) -> Array:
        """The image of a view with these values."""
        return self._problem.render(self.values, view, spp)


@dataclass(frozen=True, repr=False)
class Result:
    """What a minimisation came to."""

    values: dict[str, Array]
    """By name; poses and derived parameters by their keys, too."""
    history: list[Entry]
    """One entry for each iteration: loss, seconds, norms of gradients, ..."""
    stopped: str | None
    """Who ended it early: a callback, 'Ctrl-C', or the optimiser, and why."""
    problem: Problem

    def __repr__(self) -> str:
        """Short: a notebook prints it."""
        stopped = "" if self.stopped is None else f", ended by {self.stopped}"
        return f"<Result: {len(self.history)} iterations, loss {self.loss:.4g}{stopped}; {', '.join(self.values)}>"

    @property
    def loss(self) -> float:
        """Of the last iteration, before its step."""
        return self.history[-1].loss if self.history else float("nan")

    def apply(self, scene: mi.Scene) -> None:
        """Give a scene with these parameters the values that were found; that of the problem has them."""
        self.problem.assign(self.values, scene)

    def render(self, view: int = 0, spp: int | None = None) -> Array:
        """The image of a view (height, width, channels; linear) with these values."""
        return self.problem.render({v.key: self.values[v.key] for v in self.problem.built.variables}, view, spp)


def minimize(  # noqa: PLR0913 (of which most are keywords)
    problem: Problem,
    optimizer: str | Mapping[str, Any] | Stepper | Any = "adam",
    steps: int = 200,
    *,
    callbacks: Iterable[Callable[[Iteration], Any]] = (),
    progress: bool = True,
    stages: Sequence[Mapping[str, Any]] | None = None,
    learning_rate_schedule: str | None = None,
    final_learning_rate_ratio: float | None = None,
    warmup_steps: int | None = None,
    view_batch_size: int | None = None,
    pixel_batch_size: int | None = None,
) -> Result:
    """Minimise a problem from its initial values.

    Args:
        problem: what is minimised. Its scene holds the result afterwards.
        optimizer: ``"adam"``, ``"adamw"``, ``"sgd"``, ``"rmsprop"`` or ``"l-bfgs-b"``; a mapping with its ``type`` and
            options; an optimizer of `mitsuba.ad` that holds nothing yet, with learning rates of its own where a
            `Parameter` has none; or any object with ``step(values, gradients, learning_rates, loss) -> values``, arrays
            by name.
        steps: iterations.
        callbacks: each is called after every step with an `Iteration`; one that returns True ends the minimisation.
        progress: show a bar on a terminal, and lines elsewhere.
        stages: tables of settings that differ for some iterations, as ``[[stages]]`` of jobs; their ``iterations`` take
            the place of ``steps``.
        learning_rate_schedule: ``"constant"`` (the default), ``"exponential"``, ``"linear"`` or ``"cosine"``.
        final_learning_rate_ratio: learning rate at the end over that at the start.
        warmup_steps: iterations in which the learning rate grows from nearly zero.
        view_batch_size: views in an iteration; all by default.
        pixel_batch_size: pixels of each view in an iteration; all by default.

    Returns:
        Values, history, and who ended it. A first Ctrl-C ends it after the iteration that is under way.

    Raises:
        PathreplayError: for settings that cannot work, and where loss or values are no longer finite.
    """
    given = {
        "iterations": None if stages else steps,
        "stages": None if stages is None else [dict(stage) for stage in stages],
        "optimizer": _options(optimizer),
        "learning_rate_schedule": learning_rate_schedule,
        "final_learning_rate_ratio": final_learning_rate_ratio,
        "warmup_steps": warmup_steps,
        "view_batch_size": view_batch_size,
        "pixel_batch_size": pixel_batch_size,
    }
    built, config = problem.configured({key: value for key, value in given.items() if value is not None})
    require_stages(built, config)
    require_single_pixels(built, config)
    record = not config.deterministic
    staged = None if config.stages is None else Staged(built, config, built.integrator, config.integrator, record)
    run = new_run(built, built.integrator, record, config.optimizer, staged)
    if given["optimizer"] is None:
        rates = {entry.key: entry.learning_rate for entry in config.parameters}
        run.optimiser = adapted(optimizer, run.values, {key for key, rate in rates.items() if rate is not None})
    stop, callbacks = Stop(), list(callbacks)
    with ExitStack() as stack:
        bar = stack.enter_context(Progress(progress))
        stack.enter_context(stopping(bar.say, "aborted", stop))
        for note in problem.notes + built.notes:
            bar.remark(note)
        for event in computed(built, config, run, stop):
            bar.observe(event)
            if isinstance(event, Stepped):
                about = Iteration(event.entry, best_values(built, run), problem)
                if any([callback(about) is True for callback in callbacks]):
                    stop.by = stop.by or "a callback"
    values = best_values(built, run)
    with computing(config):
        put_values(built, values)
        found = with_scene(built, values)
    return Result(found, run.history, stop.by or run.optimiser.finished or None, problem)


def _options(optimizer: Any) -> dict[str, Any] | None:
    """The options of one of ours; None for another's object."""
    if isinstance(optimizer, str):
        return {"type": optimizer}
    if isinstance(optimizer, Mapping) and "type" in optimizer:
        return dict(optimizer)
    if not hasattr(optimizer, "step"):
        raise PathreplayError(
            f"optimizer: {type(optimizer).__name__} has no step(); give a name such as 'adam', an optimizer of "
            "mitsuba.ad, or an object with step(values, gradients, learning_rates, loss)"
        )
    return None
