"""What pictures do not determine: parameters that change nothing, and pairs of which one undoes what the other does.

The columns of J, the derivative of all pictures by a few numbers of each parameter, are central differences of
renderings with the same random numbers, so that what moves a camera back and what moves all else forth give the same
column, noise and all. Between the spaces that the columns of two parameters span is a smallest angle: where it is
zero, some change of the one looks as some change of the other, and the pictures know only what both make together. The
light of a lamp and the reflectance of what it lights are such a pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pathreplay.inverse.exposures import EXPOSURE
from pathreplay.inverse.loop import picture_of
from pathreplay.inverse.problem import Problem
from pathreplay.inverse.values import Array, Arrays
from pathreplay.inverse.variables import Variable

FEW = 4
"""Numbers of a variable that are changed one by one; those of larger ones, all in proportion."""
MOST_COLUMNS, MOST_VIEWS, MOST_SAMPLES = 16, 4, 16
"""That this may cost: pairs of renderings of each view, views, and samples per pixel."""
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


def columns_of(problem: Problem, values: Arrays) -> tuple[Columns, tuple[str, ...]]:
    """Derivatives of the pictures by the variables, and the variables that change nothing in them.

    Exposures are left out. Nothing where there are too many variables.
    """
    variables = [v for v in problem.variables if v.key != EXPOSURE]
    changes = {v.key: _changes(v, values[v.key]) for v in variables}
    if sum(map(len, changes.values())) > MOST_COLUMNS:
        changes = {v.key: _changes(v, values[v.key], few=0) for v in variables}
    if len(variables) > MOST_COLUMNS:
        return {}, ()
    render, bounds = _renderer(problem), {v.key: v.bounds for v in variables}
    found, unseen = {}, []
    for key, each in changes.items():
        ends = [[np.clip(values[key] + sign * change, *bounds[key]) for sign in (1, -1)] for change in each]
        columns = np.stack([render({**values, key: a}) - render({**values, key: b}) for a, b in ends], axis=1)
        seen = np.linalg.norm(columns, axis=0) > 0
        if seen.any():
            found[key] = columns[:, seen]
        else:
            unseen.append(key)
    return found, tuple(unseen)


def _renderer(problem: Problem) -> Callable[[Arrays], NDArray[np.float64]]:
    """All pixels that count, of the pictures with some values in the scene, always with the same random numbers."""
    config, views = problem.config, list(problem.trained().values())[:MOST_VIEWS]
    spp = min(config.most_spp, MOST_SAMPLES)

    def render(values: Arrays) -> NDArray[np.float64]:
        pictures = []
        for view in views:
            picture = picture_of(problem, config, values, view, spp).astype(np.float64)
            pictures.append((picture if view.weight is None else picture * np.sqrt(view.weight)).ravel())
        return np.concatenate(pictures)

    return render


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
