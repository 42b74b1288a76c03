"""The same problem solved by another integrator in the same time, so that a report can show two curves."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace

import numpy as np
import safetensors.numpy

from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.config import Config
from pathreplay.inverse.images import Image
from pathreplay.inverse.loop import Pace, Stop, iterate, make_adam, render_views
from pathreplay.inverse.problem import Problem
from pathreplay.inverse.progress import Progress
from pathreplay.inverse.values import Array
from pathreplay.parameters import get_array


@dataclass(frozen=True)
class Rival:
    """What the rival came to: its history, its variables, and pictures of them (rendered by the job's integrator)."""

    history: tuple[Entry, ...]
    values: dict[str, Array]
    pictures: dict[str, Image]

    def files(self) -> dict[str, bytes]:
        """History and values, for the run folder."""
        lines = "".join(json.dumps(asdict(entry)) + "\n" for entry in self.history)
        return {
            "rival/history.jsonl": lines.encode(),
            "rival/parameters.safetensors": safetensors.numpy.save(
                {key: np.ascontiguousarray(value) for key, value in self.values.items()}
            ),
        }


def run_rival(problem: Problem, config: Config, seconds: float, stop: Stop, bar: Progress) -> Rival:
    """Start anew with ``problem.rival`` and go on for ``seconds``, the time of the job's own iterations.

    Everything else is the same: start values, targets, samples, seeds, learning rates and, by the share of the time
    that has passed, their decay and the resolutions. Compiling its kernels counts, as it did for the job.
    """
    assert problem.rival is not None and config.rival is not None
    adam = make_adam(problem)
    history: list[Entry] = []
    pace = Pace(config.iterations, seconds)
    bar.start(0, config.iterations, f"rival {config.rival.type}")

    def after(entry: Entry) -> None:
        bar.reach(pace.position(history), entry.loss)

    iterate(replace(problem, integrator=problem.rival), config, adam, history, stop, pace, after)
    values = {key: get_array(value) for key, value in adam.items()}
    return Rival(tuple(history), values, render_views(problem, config))
