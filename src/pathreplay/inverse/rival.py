"""What a rival came to: the same problem, from the same start, by another integrator in the same time."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np
import safetensors.numpy

from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.config import Config
from pathreplay.inverse.images import Image
from pathreplay.inverse.loop import Run, render_views
from pathreplay.inverse.problem import Problem, put_values
from pathreplay.inverse.values import Array


@dataclass(frozen=True)
class Rival:
    """Its history, its variables, and pictures of them (rendered by the job's integrator)."""

    history: tuple[Entry, ...]
    values: dict[str, Array]
    pictures: dict[str, Image]

    def files(self) -> dict[str, bytes]:
        """History and values, for the run folder."""
        lines = "".join(json.dumps(asdict(entry)) + "\n" for entry in self.history)
        values = {key: np.ascontiguousarray(value) for key, value in self.values.items()}
        return {
            "rival/history.jsonl": lines.encode(),
            "rival/parameters.safetensors": safetensors.numpy.save(values),
        }


def finished(problem: Problem, config: Config, run: Run) -> Rival:
    """The result of a rival's run; leaves its values in the scene."""
    put_values(problem, run.values)
    return Rival(tuple(run.history), run.values, render_views(problem, config))
