"""Statistics of gradients over many seeds: noise by entry, noise along smooth directions, and bias."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

DIRECTIONS = 16  # random, but the same for all methods


def spreads(
    kept: dict[str, list[np.ndarray]], reference: str | None, grid: tuple[int, ...]
) -> dict[str, dict[str, Any]]:
    """Return `spread` of every method that has at least two rows and only finite values."""
    others = kept.get(reference or "")
    fit = {name: rows for name, rows in kept.items() if len(rows) > 1 and np.isfinite(rows).all()}
    return {name: spread(rows, others, grid) for name, rows in fit.items()}


def spread(rows: Sequence[np.ndarray], reference: Sequence[np.ndarray] | None, grid: tuple[int, ...]) -> dict[str, Any]:
    """Return statistics of the gradients ``rows``, one flat gradient per seed, by the names of fields of `Point`.

    ``grid`` is the shape of the gradient if it is one tensor; errors along smooth directions require three axes and
    channels. The gradients in ``reference`` have the same seeds as ``rows``.
    """
    gradients = np.stack(rows).astype(np.float64)
    found: dict[str, Any] = {"mean": float(gradients.mean()), "squared_errors": squared_errors(gradients).tolist()}
    if len(grid) == 4 and np.prod(grid) == gradients.shape[1]:
        found["smooth_errors"] = squared_errors(gradients @ smooth_directions(grid).T).tolist()
    if reference is not None and len(reference) == len(rows) and np.isfinite(reference).all():
        found["bias_products"] = bias_products(gradients - np.stack(reference)).tolist()
    return found


def squared_errors(rows: np.ndarray) -> np.ndarray:
    """Return for each row the mean over entries of (row - mean of rows)² · n / (n - 1).

    The mean of the results is the sample variance, averaged over entries. The rows must be uncorrelated and have the
    same mean, but may have different variances. For a method that learns from earlier rows, the result is therefore its
    mean variance before and after learning.
    """
    return np.mean((rows - rows.mean(axis=0)) ** 2, axis=1) * len(rows) / (len(rows) - 1)


def bias_products(differences: np.ndarray) -> np.ndarray:
    """Return for each row the mean over entries of (row · mean of the other rows).

    The mean of the results estimates |bias|² / entries.
    """
    others = (differences.sum(axis=0) - differences) / (len(differences) - 1)
    return np.mean(differences * others, axis=1)


def smooth_directions(grid: tuple[int, ...]) -> np.ndarray:
    """Return unit vectors (DIRECTIONS, entries): waves of random direction and phase, 1/2 to 2 periods across the grid.

    The mean variance along *all* directions equals the mean over entries. Along smooth directions, errors of
    neighbouring entries add up.
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
