"""Optimisation steps, recorded or traced anew, as losses and norms of gradients."""

from __future__ import annotations

import numpy as np

from pathreplay.inverse.loop.loop import new_run, take_step
from pathreplay.inverse.objective.evaluate import Evaluator


def times_recorded(evaluate: Evaluator) -> list[int]:
    """How often each frozen function of an evaluator was recorded."""
    return [each.n_recordings for several in evaluate._recordings.values() for each in several._frozen.values()]


def steps(problem, config, passes: str, kinds: int = 1) -> np.ndarray:
    """Loss and norm of the gradient of four steps, recorded (from the second on) or traced anew each time.

    Views that are alike share a recording; there are as many recordings as ``kinds`` of views.
    """
    run = new_run(problem, problem.integrator, record=passes == "recorded")
    for i in range(4):
        take_step(problem, run, i)
    # The first pass of a kind is traced in any case; the others launch what the second recorded.
    recordings = times_recorded(run.executor.evaluate)
    assert recordings == [1] * kinds * (passes == "recorded"), recordings
    return np.array([[entry.loss, *entry.gradient_norms.values()] for entry in run.history])
