"""What the gradients of many seeds say: their noise entry by entry and along smooth directions, and their bias."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

DIRECTIONS = 16  # random, but the same for all methods


def spreads(
    kept: dict[str, list[np.ndarray]], reference: str | None, grid: tuple[int, ...]
) -> dict[str, dict[str, Any]]:
    """`spread` of every method with at least two rows, all of them finite."""
    others = kept.get(reference or "")
    fit = {name: rows for name, rows in kept.items() if len(rows) > 1 and np.isfinite(rows).all()}
    return {name: spread(rows, others, grid) for name, rows in fit.items()}


def spread(rows: Sequence[np.ndarray], reference: Sequence[np.ndarray] | None, grid: tuple[int, ...]) -> dict[str, Any]:
    """Values by the names that `Point` has for them; ``rows`` are flat gradients, one a seed, as are the lists' values.

    ``grid`` is the shape of the gradient, if it is one tensor: with three axes and channels there are smooth errors.
    ``reference`` has the seeds of ``rows``.
    """
    gradients = np.stack(rows).astype(np.float64)
    found: dict[str, Any] = {"mean": float(gradients.mean()), "squared_errors": squared_errors(gradients).tolist()}
    if len(grid) == 4 and np.prod(grid) == gradients.shape[1]:
        found["smooth_errors"] = squared_errors(gradients @ smooth_directions(grid).T).tolist()
    if reference is not None and len(reference) == len(rows) and np.isfinite(reference).all():
        found["bias_products"] = bias_products(gradients - np.stack(reference)).tolist()
    return found


def squared_errors(rows: np.ndarray) -> np.ndarray:
    """Of each row: mean of (row - mean of rows)² · n / (n - 1). Their mean is the sample variance, mean over entries.

    The rows need not be alike in variance: uncorrelated and of one mean is enough, so that a method that learns from
    its earlier rows is charged with the mean of what it had then and has now.
    """
    return np.mean((rows - rows.mean(axis=0)) ** 2, axis=1) * len(rows) / (len(rows) - 1)


def bias_products(differences: np.ndarray) -> np.ndarray:
    """Of each row: mean over entries of (row · mean of the other rows). Their mean estimates |bias|² / entries."""
    others = (differences.sum(axis=0) - differences) / (len(differences) - 1)
    return np.mean(differences * others, axis=1)


def smooth_directions(grid: tuple[int, ...]) -> np.ndarray:
    """Unit vectors (DIRECTIONS, entries): half a wave to two waves across the grid, of random direction and phase.

    The mean variance along *all* directions is the mean over entries; along these, errors of neighbours add up.
    """
    random = np.random.default_rng(5)
    axes = np.meshgrid(*(np.linspace(0, 1, n) for n in grid[:3]), indexing="ij")
    found = []
    for _ in range(DIRECTIONS):
        k = random.normal(size=3)
        k *= 2 * np.pi * random.uniform(0.5, 2) / np.linalg.norm(k)
        phase = random.uniform(0, 2 * np.pi, grid[3])
        wave = np.cos(np.tensordot(k, axes, axes=1)[..., None] + phase).ravel()
        found.append(wave / np.linalg.norm(wave))
    return np.stack(found)
