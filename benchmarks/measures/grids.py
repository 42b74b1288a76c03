"""Measures flights through a density grid and estimates of its transmittance, for the task `gridmedium`.

Seconds are CPU time, which includes all threads and hardly depends on the load of the machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.plugins import grid_traversal

from ..scenes.grids import grid_medium
from .job import Job, Measure
from .scene import stopwatch

POINTS = 1000  # of the quadrature, along each ray

#: What the medium is told, by method: one majorant for the grid, the medium's own choice, a majorant for each cell.
MAJORANTS: dict[str, str | bool] = {"one majorant": False, "auto": "auto", "cells": True}


class Flight(Measure):
    """Time and number of tentative collisions of delta tracking to the first real collision, along lines."""

    def __init__(self, job: Job) -> None:
        self.rays = job.resolution**2 * job.spp
        self.grids = {name: grid_medium(job.scene, MAJORANTS[name]) for name in job.methods}
        self.ray = _lines(self.rays)

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return CPU seconds, and the number of tentative collisions per ray."""

        def run() -> tuple[Any, Any]:
            return _first_collision(self.grids[method], self.ray, _sampler(seed, self.rays))

        seconds, (_, count) = stopwatch(run, time.process_time)
        return seconds, np.array(dr.mean(mi.Float(count)))

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return the mean number of tentative collisions per ray, by method."""
        return {name: {"mean": float(np.mean(rows))} for name, rows in kept.items()}


class Transmittance(Measure):
    """Time and squared error of transmittance estimates along shadow rays, relative to a quadrature.

    The rays start in all directions from points of the medium, which are drawn in proportion to the density.
    """

    def __init__(self, job: Job) -> None:
        self.rays = job.resolution**2 * job.spp
        self.grid = grid_medium(job.scene, "auto")
        self.cells = {name: CANDIDATES[name](self.grid) for name in job.methods}
        self.ray = _shadow_rays(self.grid, self.rays)
        self.right = _quadrature(self.grid, self.ray)

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return CPU seconds, and the error of each ray."""
        self.grid.shadow_cells = self.cells[method]
        run = lambda: self.grid.transmittance(self.ray, _sampler(seed, self.rays))  # noqa: E731
        seconds, found = stopwatch(run, time.process_time)
        return seconds, np.array(found, dtype=np.float64)[0] - self.right

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return the squared errors, and the mean error in standard errors, by method."""
        found = {name: np.stack(rows) for name, rows in kept.items() if rows}
        return {
            name: {
                "squared_errors": np.square(errors).mean(axis=1).tolist(),
                "z": float(errors.mean() / (errors.std() / np.sqrt(errors.size) + 1e-7)),
            }
            for name, errors in found.items()
        }


def _fine(grid: Any) -> Any:
    return next(level for level in grid.levels if level.shape == (8, 8, 8))


def _controlled(grid: Any, bounds: Any, control: Any, denser: float) -> Any:
    low, high = bounds.lowest * grid.scale, bounds.highest * grid.scale
    return grid_traversal.make_cells(bounds, [control, denser * dr.maximum(high - control, control - low)])


def _with(control: Callable[[Any, Any], Any], denser: float) -> Callable[[Any], Any]:
    """Return a function that makes cells of the fine level; ``control`` computes their control densities."""
    return lambda grid: _controlled(grid, _fine(grid), control(_fine(grid), grid.scale), denser)


#: Cells with control densities and rates, made from the medium; the last ones are what the medium itself chose.
CANDIDATES: dict[str, Callable[[Any], Any]] = {
    "ratio, one majorant": lambda grid: _controlled(grid, grid.levels[-1], mi.Float(0), 1),
    "ratio, by cell": _with(lambda fine, scale: fine.lowest * 0, 1),
    "lowest as control": _with(lambda fine, scale: fine.lowest * scale, 1),
    "lowest, x 2": _with(lambda fine, scale: fine.lowest * scale, 2),
    "mean as control": _with(lambda fine, scale: fine.mean * scale, 1),
    "mean, x 2": _with(lambda fine, scale: fine.mean * scale, 2),
    **{f"bounded, x {n}": _with(lambda fine, scale: grid_traversal.control(fine, scale)[0], n) for n in (1, 2, 4)},
    "gridmedium": lambda grid: grid.shadow_cells,
}


def _sampler(seed: int, rays: int) -> Any:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, rays)
    return sampler


@dr.syntax
def _first_collision(grid: Any, ray: Any, sampler: Any) -> tuple[Any, Any]:
    """Return the distance of the first real collision, and the number of tentative collisions."""
    active = mi.Bool(True)
    t, count = mi.Float(0), mi.UInt32(0)
    while dr.hint(active, exclude=[grid, ray]):
        u = sampler.next_1d(active)
        step, bar = grid.free_flight(mi.Ray3f(ray.o + t * ray.d, ray.d), u, active)
        t += step
        active &= dr.isfinite(t)
        mei = dr.zeros(mi.MediumInteraction3f)
        mei.p = ray.o + t * ray.d
        _, _, density = grid.get_scattering_coefficients(mei, active)
        count[active] += 1
        active &= sampler.next_1d(active) * bar >= density[0]
    return t, count


def _lines(rays: int) -> Any:
    """Return rays in all directions that start outside of the unit cube and pass through a point in the cube."""
    sampler = _sampler(1, rays)
    p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    ray = mi.Ray3f(p - 2 * d, d)
    dr.eval(ray)
    return ray


def _shadow_rays(grid: Any, rays: int) -> Any:
    sampler = _sampler(7, rays * 64)
    at = dr.zeros(mi.MediumInteraction3f, rays * 64)
    at.p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    density = grid.get_scattering_coefficients(at)[2][0]
    chosen = dr.compress(sampler.next_1d() * grid.majorant < density)
    chosen = dr.gather(mi.UInt32, chosen, dr.arange(mi.UInt32, rays) % dr.width(chosen))
    d = mi.warp.square_to_uniform_sphere(_sampler(8, rays).next_2d())
    ray = mi.Ray3f(dr.gather(mi.Point3f, at.p, chosen), d)
    dr.eval(ray)
    return ray


def _quadrature(grid: Any, ray: Any) -> np.ndarray:
    a, b = grid_traversal.clip(grid.box, ray)
    h = dr.maximum(b - a, 0) / POINTS

    def body(i: Any, depth: Any) -> tuple[Any, Any]:
        mei = dr.zeros(mi.MediumInteraction3f)
        mei.p = ray(a + h * (i + 0.5))
        return i + 1, depth + h * grid.get_scattering_coefficients(mei)[2][0]

    _, depth = dr.while_loop((mi.UInt32(0), mi.Float(0)), lambda i, _: i < POINTS, body)
    return np.array(dr.exp(-depth))
