"""What pictures do not determine: parameters that change nothing, and pairs of which one undoes what the other does.

The columns of J, the derivative of all pictures by a few numbers of each parameter, are central differences of
renderings with the same random numbers, so that what moves a camera back and what moves all else forth give the same
column, noise and all. Between the spaces that the columns of two parameters span is a smallest angle: where it is
zero, some change of the one looks as some change of the other, and the pictures know only what both make together. The
light of a lamp and the reflectance of what it lights are such a pair.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pathreplay.inverse.loop.loop import picture_of
from pathreplay.inverse.objective.evaluate import LARGE
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import Variable
from pathreplay.inverse.problem.problem import Problem

FEW = 4
"""Numbers of a variable that are changed one by one; those of larger ones, all in proportion."""
MOST_COLUMNS, MOST_PIXELS, MOST_ROWS = 16, 2**23, 2**20
"""Of all variables, of all views, and what of these is compared, evenly chosen."""
MOST_SAMPLES, FREE_SAMPLES, SHARE = 16, 2**22, 0.1
"""Of a pixel; of all renderings, where the run took few; and next to those that the run took."""
STEP = 0.01
"""Of a value and of how far it has come, and of a step: so much is changed."""
UNDONE = 0.05
"""The sine of the smallest angle: the share of a change of the pictures that the other parameter cannot undo."""

Columns = Mapping[str, NDArray[np.float64]]
"""By variable: pixels x numbers."""


def trade_offs(columns: Columns) -> tuple[tuple[str, str], ...]:
    """The pairs of which one undoes what the other does, but for `UNDONE`."""
    spans = {key: np.linalg.qr(column / np.linalg.norm(column, axis=0))[0] for key, column in columns.items()}
    found = []
    for a, b in combinations(spans, 2):
        cosine = min(float(np.linalg.svd(spans[a].T @ spans[b], compute_uv=False)[0]), 1.0)
        if np.sqrt(1 - cosine**2) < UNDONE:
            found.append((a, b))
    return tuple(found)


def columns_of(problem: Problem, values: Arrays, taken: float = 0) -> tuple[Columns, tuple[str, ...]]:
    """Derivatives of the pictures by the variables, and the variables that change nothing in them.

    Exposures are left out. Nothing where there are too many or too large variables, or where to look at all views would
    cost too much beside a run that took so many samples (``taken``).
    """
    variables = [v for v in problem.variables if v.key != EXPOSURE]
    if any(values[v.key].size >= LARGE for v in variables) or len(variables) > MOST_COLUMNS:
        return {}, ()
    changes = {v.key: _changes(v, values[v.key]) for v in variables}
    if sum(map(len, changes.values())) > MOST_COLUMNS:
        changes = {v.key: _changes(v, values[v.key], few=0) for v in variables}
    pixels = sum(view.target[..., 0].size for view in problem.trained().values())
    pictures = 2 * pixels * sum(map(len, changes.values()))
    spp = min(problem.config.most_spp, MOST_SAMPLES, int(max(FREE_SAMPLES, SHARE * taken) / pictures))
    if spp < 1 or pixels > MOST_PIXELS:
        return {}, ()
    bounds = {v.key: v.bounds for v in variables}
    found, unseen = {}, []
    for key, each in changes.items():
        columns = []
        for change in each:
            ahead, behind = (np.clip(values[key] + sign * change, *bounds[key]) for sign in (1, -1))
            column = _rendered(problem, {**values, key: ahead}, spp) - _rendered(problem, {**values, key: behind}, spp)
            column = np.where(np.isfinite(column), column, 0)
            if column.any():
                columns.append(column[:: max(1, column.size // MOST_ROWS)])
        if columns:
            found[key] = np.stack(columns, axis=1).astype(np.float64)
        else:
            unseen.append(key)
    return {key: column for key, column in found.items() if column.any(axis=0).all()}, tuple(unseen)


def _rendered(problem: Problem, values: Arrays, spp: int) -> Array:
    """All that counts of the pictures with these values in the scene, always by the same random numbers."""
    pictures = []
    for view in problem.trained().values():
        picture = picture_of(problem, problem.config, values, view, spp)
        pictures.append((picture if view.weight is None else picture * np.sqrt(view.weight)).ravel())
    return np.concatenate(pictures)


def _changes(variable: Variable, value: Array, few: int = FEW) -> list[Array]:
    """Small changes of a value: of each number, or of all in proportion."""
    size = STEP * variable.learning_rate
    if value.size <= few:
        size += STEP * (_length(value) + _length(value - variable.start))
        return [size * one.reshape(value.shape).astype(np.float32) for one in np.eye(value.size)]
    return [np.float32(STEP) * value if value.any() else np.full_like(value, size)]


def _length(value: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(value, dtype=np.float64))))
