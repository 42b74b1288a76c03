"""Assessment of a run: which variables still move, which have converged, and which the images do not determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.stage_options import begins
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.movement import SHORTEST, still_moves
from pathreplay.inverse.loop.trade_offs import columns_of, trade_offs
from pathreplay.inverse.problem.problem import Problem


@dataclass(frozen=True)
class Verdict:
    """Keys of variables, grouped by state."""

    moving: tuple[str, ...] = ()
    """Variables that still move."""
    arrived: tuple[str, ...] = ()
    """Variables that have converged."""
    trade_offs: tuple[tuple[str, str], ...] = ()
    """Pairs of variables whose effects on the images cancel."""
    unseen: tuple[str, ...] = ()
    """Variables that do not affect the images."""
    untested: tuple[str, ...] = ()
    """Variables with too few iterations, in the last stage and at the last resolution, to test whether they move."""
    searches: bool = False
    """Whether the optimiser has no learning rate (see `Optimizer.searches`)."""

    def __str__(self) -> str:
        """Summarise the verdict in one line, which also suggests what to change."""
        parts = []
        if self.trade_offs:
            pairs = ", ".join(f"'{a}' against '{b}'" for a, b in self.trade_offs)
            parts.append(
                f"not determined by the images: {pairs}, whose effects cancel: freeze one of them, or add "
                "l2_to_initial, or a view that distinguishes them"
            )
        if self.unseen:
            parts.append(f"not determined by the images, which they do not affect: {_listed(self.unseen)}")
        if self.moving:
            faster = "" if self.searches else ", or raise learning_rate if they do not oscillate"
            parts.append(f"still moving: {_listed(self.moving)}: run more iterations{faster}")
        free = {key for pair in self.trade_offs for key in pair} | set(self.unseen)
        untested = [key for key in self.untested if key not in free]
        if arrived := [key for key in self.arrived if key not in free]:
            which = _listed(arrived) if parts or untested else "all"
            remedy = "raise spp" if self.searches else "raise spp or let the learning rate decay"
            parts.append(f"converged up to noise: {which}: {remedy} to improve them")
        if parts and untested:
            parts.append(f"too few iterations to test: {_listed(untested)}")
        since = f"fewer than {SHORTEST} iterations in the last stage or at the last resolution"
        return "values: " + ("; ".join(parts) or f"{since}, too few to test convergence")


def _listed(keys: Sequence[str]) -> str:
    more = f" (and {len(keys) - 4} more)" if len(keys) > 4 else ""
    return ", ".join(f"'{key}'" for key in keys[:4]) + more


def verdict_of(problem: Problem, run: Run, stopped: bool) -> Verdict:
    """Assess a run.

    If the run was ``stopped`` early, the groups ``trade_offs`` and ``unseen`` stay empty, because these groups need
    additional renderings.
    """
    moves = {v.key: still_moves(run.history, v.key, _begin(problem, v.key, run)) for v in problem.variables}
    known = [key for key, moving in moves.items() if moving is not None]
    done = bool(run.optimiser.finished)
    moving = tuple(key for key in known if moves[key] and not done)
    arrived = tuple(key for key in known if key not in moving)
    untested = tuple(key for key, moving in moves.items() if moving is None and not done)
    verdict = Verdict(moving, arrived, untested=untested, searches=problem.config.optimizer.searches)
    if stopped or not known:
        return verdict
    pixels = np.mean([view.target[..., 0].size for view in problem.trained().values()])
    views = problem.config.view_batch_size or len(problem.trained())
    taken = float(pixels) * views * sum(entry.spp for entry in run.history)
    try:
        columns, unseen = columns_of(problem, run.values, taken)
        pairs = trade_offs(columns)
    except (PathreplayError, RuntimeError, ValueError, np.linalg.LinAlgError):
        # User functions or Mitsuba may reject perturbed values. The run itself has succeeded, so no error is reported.
        return verdict
    # Variables with a nonzero gradient affect the images, even if their finite differences in `columns_of` are zero.
    # For example, the differences of a variable that only moves silhouettes are zero if no sample lies between the
    # silhouettes before and after the perturbation.
    pulled = {key for entry in run.history for key, slopes in entry.slopes.items() if any(slopes)}
    return replace(verdict, trade_offs=pairs, unseen=tuple(key for key in unseen if key not in pulled))


def _begin(problem: Problem, key: str, run: Run) -> int:
    """Return the iteration of the last change of the job's stage or of a variable's resolution; 0 without a change."""
    stages = begins(problem.config.stages or [])[:-1]
    levels = next(v.levels for v in problem.variables if v.key == key)
    return max(at for at in (0, *stages, *(levels.begins if levels else ())) if at <= len(run.history))
