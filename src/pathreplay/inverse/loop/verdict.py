"""What is to be thought of the values that a run ended with: on their way, as exact as they get, or not determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.stage_options import begins
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.movement import SHORTEST, still_moves
from pathreplay.inverse.loop.trade_offs import columns_of, trade_offs
from pathreplay.inverse.problem.problem import Problem


@dataclass(frozen=True)
class Verdict:
    """By key of the variables, of poses their parts: those that still move, and those that have arrived.

    ``trade_offs`` are pairs that the pictures do not tell apart, and ``unseen`` are variables that change nothing in
    them. Of variables that are in none of these there were too few iterations.
    """

    moving: tuple[str, ...] = ()
    arrived: tuple[str, ...] = ()
    trade_offs: tuple[tuple[str, str], ...] = ()
    unseen: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line."""
        parts = []
        if self.trade_offs:
            pairs = ", ".join(f"'{a}' against '{b}'" for a, b in self.trade_offs)
            parts.append(
                f"not determined by the pictures: {pairs}, where one undoes what the other does: hold one of them, or "
                "add l2_to_initial, or a view that tells them apart"
            )
        if self.unseen:
            parts.append(f"not determined by the pictures, in which they change nothing: {_listed(self.unseen)}")
        if self.moving:
            parts.append(f"still moving: {_listed(self.moving)}: go on with more iterations, or a higher learning_rate")
        free = {key for pair in self.trade_offs for key in pair} | set(self.unseen)
        if arrived := [key for key in self.arrived if key not in free]:
            which = _listed(arrived) if parts else "all"
            parts.append(f"as exact as the noise allows: {which}: more spp, or a learning rate that decays, bring more")
        return "values: " + ("; ".join(parts) or f"less than {SHORTEST} iterations do not say whether they still move")


def _listed(keys: Sequence[str]) -> str:
    more = f" (and {len(keys) - 4} more)" if len(keys) > 4 else ""
    return ", ".join(f"'{key}'" for key in keys[:4]) + more


def verdict_of(problem: Problem, run: Run, stopped: bool) -> Verdict:
    """The verdict on a run. Of one that was stopped nothing is rendered, so that trade-offs are not looked for."""
    moves = {v.key: still_moves(run.history, v.key, _begin(problem, v.key, run)) for v in problem.variables}
    known = [key for key, moving in moves.items() if moving is not None]
    done = bool(run.optimiser.finished)
    moving = tuple(key for key in known if moves[key] and not done)
    arrived = tuple(key for key in known if key not in moving)
    if stopped or not known:
        return Verdict(moving, arrived)
    pixels = np.mean([view.target[..., 0].size for view in problem.trained().values()])
    views = problem.config.view_batch_size or len(problem.trained())
    taken = float(pixels) * views * sum(entry.spp for entry in run.history)
    try:
        columns, unseen = columns_of(problem, run.values, taken)
        pairs = trade_offs(columns)
    except (PathreplayError, RuntimeError, ValueError, np.linalg.LinAlgError):
        # A function of the user's, or Mitsuba, may not take what is beside the values: the run is done.
        return Verdict(moving, arrived)
    # An outline may stay where it is among few samples; edges pull all the same.
    pulled = {key for entry in run.history for key, slopes in entry.slopes.items() if any(slopes)}
    return Verdict(moving, arrived, pairs, tuple(key for key in unseen if key not in pulled))


def _begin(problem: Problem, key: str, run: Run) -> int:
    """The iteration since which a variable is treated alike: that of the last stage, or of its last resolution."""
    stages = begins(problem.config.stages or [])[:-1]
    levels = next(v.levels for v in problem.variables if v.key == key)
    return max(at for at in (0, *stages, *(levels.begins if levels else ())) if at <= len(run.history))
