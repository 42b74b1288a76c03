"""Optimisation steps, recorded or traced anew, as losses and norms of gradients."""

from __future__ import annotations

import numpy as np

from pathreplay.inverse.loop.loop import new_run, take_step


def steps(problem, config, passes: str) -> np.ndarray:
    """Loss and norm of the gradient of four steps, recorded (from the second on) or traced anew each time."""
    run = new_run(problem, problem.integrator, record=passes == "recorded")
    for i in range(4):
        take_step(problem, run, i)
    # The first step is traced in any case; the others launch what was recorded, once for each kind of view.
    evaluate = run.executor.evaluate
    recordings = [each.n_recordings for each in evaluate._recordings[config.spp]._frozen.values()]
    assert recordings == ([1] * evaluate._sensors.count if passes == "recorded" else []), recordings
    return np.array([[entry.loss, *entry.gradient_norms.values()] for entry in run.history])
