"""Identifiability: parameters that do not affect the images, and pairs of parameters whose effects cancel.

The Jacobian J of all images is computed by central differences. A parameter has one column of J per entry, or a single
column if it has many entries. All renderings use the same random numbers. If two changes have the same effect on the
images, their columns of J are therefore equal, including the noise. For example, moving a camera has the same effect as
moving everything else in the opposite direction.

`trade_offs` computes the smallest principal angle between the column spaces of two parameters. If the angle is zero, a
change of one parameter can be undone by a change of the other parameter, and the images determine only the combined
effect. For example, the images may determine only the product of an emitter's radiance and the reflectance of the
surface that the emitter lights.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pathreplay.inverse.loop.loop import pictures_of
from pathreplay.inverse.objective.evaluate import LARGE
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import Variable, range_of
from pathreplay.inverse.problem.problem import Problem

FEW = 4
"""Maximum number of entries of a variable that are perturbed one by one. Larger variables are scaled as a whole."""
MOST_COLUMNS, MOST_PIXELS, MOST_ROWS = 16, 2**23, 2**20
"""Limits on the columns of J, the pixels of all views, and the rows of J. If J has k times `MOST_ROWS` rows or
more, only every k-th row is used."""
MOST_SAMPLES, FREE_SAMPLES, SHARE = 16, 2**22, 0.1
"""`MOST_SAMPLES` is the maximum number of samples per pixel. The total number of samples is limited to `FREE_SAMPLES`,
or to the fraction `SHARE` of the run's samples if that is more."""
STEP = 0.01
"""Size of a perturbation relative to the sum of three numbers: value, change during the run, and learning rate."""
UNDONE = 0.05
"""Two parameters are a trade-off if the sine of their angle is below this value. If one parameter changes the images,
the sine is the fraction of this change that the other parameter cannot undo."""

Columns = Mapping[str, NDArray[np.float64]]
"""Columns of the Jacobian by variable, shape (pixels, entries)."""


def trade_offs(columns: Columns) -> tuple[tuple[str, str], ...]:
    """Return the pairs of variables for which the sine of the smallest principal angle is below `UNDONE`."""
    spans = {key: np.linalg.qr(column / np.linalg.norm(column, axis=0))[0] for key, column in columns.items()}
    pairs = []
    for a, b in combinations(spans, 2):
        cosine = min(float(np.linalg.svd(spans[a].T @ spans[b], compute_uv=False)[0]), 1.0)
        if np.sqrt(1 - cosine**2) < UNDONE:
            pairs.append((a, b))
    return tuple(pairs)


def columns_of(problem: Problem, values: Arrays, taken: float = 0) -> tuple[Columns, tuple[str, ...]]:
    """Compute the columns of the Jacobian for all variables except exposures and the camera response.

    Args:
        problem: the problem.
        values: values of the variables.
        taken: number of samples that the run has used. It limits the samples for the Jacobian (see `SHARE`).

    Returns:
        The columns by variable, and the variables that do not affect the images. Both results are empty if there are
        too many variables, if a variable is too large, or if rendering all views would be too expensive.
    """
    variables = [v for v in problem.variables if v.key not in (EXPOSURE, RESPONSE)]
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
    ranges = {v.key: range_of(v) for v in variables}
    jacobian, unseen = {}, []
    for key, perturbations in changes.items():
        columns = []
        for change in perturbations:
            ahead, behind = (_moved(values[key], sign * change, ranges[key]) for sign in (1, -1))
            column = _rendered(problem, {**values, key: ahead}, spp) - _rendered(problem, {**values, key: behind}, spp)
            column = np.where(np.isfinite(column), column, 0)
            if column.any():
                columns.append(column[:: max(1, column.size // MOST_ROWS)])
        if columns:
            jacobian[key] = np.stack(columns, axis=1).astype(np.float64)
        else:
            unseen.append(key)
    return {key: column for key, column in jacobian.items() if column.any(axis=0).all()}, tuple(unseen)


def _rendered(problem: Problem, values: Arrays, spp: int) -> Array:
    """Render all training views with common random numbers.

    Returns the pixels of all views in one vector. Each pixel is multiplied by the square root of its weight.
    """
    pictures = []
    views = problem.trained().values()
    for view, (_, picture) in zip(views, pictures_of(problem, values, views, spp), strict=True):
        pictures.append((picture if view.weight is None else picture * np.sqrt(view.weight)).ravel())
    return np.concatenate(pictures)


def _moved(value: Array, change: Array, within: tuple[float, float]) -> Array:
    """Add a change to a value. Entries move at most half of their distance from the ends of the range ``within``.

    The scene may be undefined at the ends and beyond.
    """
    least, most = (0.5 * (np.float32(end) - value) for end in within)
    return value + np.clip(change, least, most)


def _changes(variable: Variable, value: Array, few: int = FEW) -> list[Array]:
    """Make small perturbations of a value.

    Up to ``few`` entries are perturbed one by one. More entries are perturbed together, by a single perturbation.
    """
    size = STEP * variable.learning_rate
    if value.size <= few:
        size += STEP * (_length(value) + _length(value - variable.start))
        return [size * one.reshape(value.shape).astype(np.float32) for one in np.eye(value.size)]
    return [np.float32(STEP) * value if value.any() else np.full_like(value, size)]


def _length(value: Array) -> float:
    """Compute the root mean square of the entries of a value."""
    return float(np.sqrt(np.mean(np.square(value, dtype=np.float64))))
