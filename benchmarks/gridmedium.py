"""What the cells of `gridmedium` save on flights, and the noise and time of estimates of transmittance.

    python benchmarks/gridmedium.py [--quick] [--json FILE]

Flights are delta tracking to the first real collision, with one majorant for the grid and with a majorant by cell, in
turn. Shadow rays start at points of the medium, drawn in proportion to the density, in all directions. Their estimates
are compared by mean squared error times CPU time, relative to ratio tracking with one majorant; the reference is a
quadrature with 1000 points a ray. All grids have 64³ voxels and a highest value of 1 in the unit cube.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pathreplay.backend import set_variant  # before mitsuba: points Dr.Jit at a libLLVM

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np

from pathreplay.media import cellwalk
from pathreplay.media.supergrid import Bounds

VOXELS = 64


def grids() -> dict[str, np.ndarray]:
    """Six small blobs, a textured cloud, a dense half with a sharp edge, voxels of 0 or 1 by chance, a constant."""
    z, y, x = (np.mgrid[0:VOXELS, 0:VOXELS, 0:VOXELS] + 0.5) / VOXELS
    rng = np.random.default_rng(0)
    blobs = np.zeros_like(x)
    for cx, cy, cz in rng.uniform(0.15, 0.85, (6, 3)):
        r = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
        blobs = np.maximum(blobs, np.clip(1 - r / 0.1, 0, 1))
    r = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2)
    cloud = np.clip(1 - r / 0.48, 0, 1) * (1 + 0.4 * np.sin(20 * x + 3 * np.sin(9 * y)) * np.cos(17 * z + y))
    return {
        "sparse": blobs / blobs.max(),
        "cloud": cloud / cloud.max(),
        "wall": (x < 0.45).astype(float),
        "noise": rng.integers(0, 2, x.shape).astype(float),
        "uniform": np.ones_like(x),
    }


def medium(values: np.ndarray, scale: float, supergrid: bool | str) -> Any:
    data = mi.TensorXf(values.astype(np.float32)[..., None])
    return mi.load_dict(
        {
            "type": "gridmedium",
            "sigma_t": {"type": "gridvolume", "data": data},
            "scale": scale,
            "supergrid": supergrid,
        }
    )


def cpu_seconds(runs: Mapping[str, Callable[..., Any]], rounds: int) -> dict[str, float]:
    """CPU time of each, in turn: the mean of some rounds, after one that compiles.

    CPU time, since it counts all threads and hardly feels what else the machine does; the mean, since some clocks tick
    every few milliseconds.
    """
    times: dict[str, list[float]] = {label: [] for label in runs}
    for seed in range(rounds + 1):
        for label, run in runs.items():
            dr.sync_thread()
            start = time.process_time()
            dr.eval(run(seed))
            dr.sync_thread()
            times[label].append(time.process_time() - start)
    return {label: statistics.fmean(each[1:]) for label, each in times.items()}


def new_sampler(seed: int, rays: int) -> Any:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, rays)
    return sampler


# ------------------------------------------------------ flights ------------------------------------------------------


@dr.syntax
def first_collision(grid: Any, ray: Any, sampler: Any) -> tuple[Any, Any]:
    """Distance of the first real collision, and the number of tentative ones."""
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


def random_lines(seed: int, rays: int) -> Any:
    """Rays that start outside of the unit cube and pass through a point in it, in all directions."""
    sampler = new_sampler(seed, rays)
    p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    ray = mi.Ray3f(p - 2 * d, d)
    dr.eval(ray)
    return ray


def flights(rays: int, rounds: int, scales: list[float]) -> list[dict[str, Any]]:
    rows = []
    ray = random_lines(1, rays)
    for name, values in grids().items():
        for scale in scales:
            found = {label: medium(values, scale, label) for label in (False, "auto", True)}
            runs = {
                str(label): lambda seed, grid=grid: first_collision(grid, ray, new_sampler(seed, rays))
                for label, grid in found.items()
            }
            seconds = cpu_seconds(runs, rounds)
            row: dict[str, Any] = {"grid": name, "scale": scale}
            for label, grid in found.items():
                row[str(label)] = {
                    "cpu_seconds": seconds[str(label)],
                    "collisions": float(dr.mean(mi.Float(runs[str(label)](0)[1]))[0]),
                    "cells": [n - 2 for n in grid.flight_cells.shape],
                }
            one, auto, cells = row["False"], row["auto"], row["True"]
            row["speed_up"] = one["cpu_seconds"] / auto["cpu_seconds"]
            rows.append(row)
            print(
                f"{name:8} scale {scale:5g}  collisions {one['collisions']:6.2f} -> {auto['collisions']:6.2f}  cells "
                f"{auto['cells'][0]:2}  speed-up {row['speed_up']:5.2f}  "
                f"(cells forced: {one['cpu_seconds'] / cells['cpu_seconds']:5.2f})",
                flush=True,
            )
    return rows


# --------------------------------------------------- transmittance ---------------------------------------------------


def shadow_rays(grid: Any, rays: int) -> Any:
    sampler = new_sampler(7, rays * 64)
    at = dr.zeros(mi.MediumInteraction3f, rays * 64)
    at.p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    density = grid.get_scattering_coefficients(at)[2][0]
    chosen = dr.compress(sampler.next_1d() * grid.majorant < density)
    chosen = dr.gather(mi.UInt32, chosen, dr.arange(mi.UInt32, rays) % dr.width(chosen))
    d = mi.warp.square_to_uniform_sphere(new_sampler(8, rays).next_2d())
    ray = mi.Ray3f(dr.gather(mi.Point3f, at.p, chosen), d)
    dr.eval(ray)
    return ray


def quadrature(grid: Any, ray: Any, points: int = 1000) -> np.ndarray:
    a, b = cellwalk.clip(grid.box, ray)
    h = dr.maximum(b - a, 0) / points

    def body(i: Any, depth: Any) -> tuple[Any, Any]:
        mei = dr.zeros(mi.MediumInteraction3f)
        mei.p = ray(a + h * (i + 0.5))
        return i + 1, depth + h * grid.get_scattering_coefficients(mei)[2][0]

    _, depth = dr.while_loop((mi.UInt32(0), mi.Float(0)), lambda i, _: i < points, body)
    return np.array(dr.exp(-depth))


def candidates(grid: Any) -> dict[str, Any]:
    """Cells with control densities and rates: name to Cells. None is what the medium itself chose."""
    scale = grid.scale

    def with_control(bounds: Bounds, c: Any, denser: float) -> Any:
        low, high = bounds.lowest * scale, bounds.highest * scale
        return cellwalk.make_cells(bounds, [c, denser * dr.maximum(high - c, c - low)])

    fine = next(level for level in grid.levels if level.shape == (8, 8, 8))
    found = {
        "ratio, one majorant": with_control(grid.levels[-1], mi.Float(0), 1),
        "ratio, by cell": with_control(fine, fine.lowest * 0, 1),
        "lowest as control": with_control(fine, fine.lowest * scale, 1),
        "lowest, x 2": with_control(fine, fine.lowest * scale, 2),
        "mean as control": with_control(fine, fine.mean * scale, 1),
        "mean, x 2": with_control(fine, fine.mean * scale, 2),
    }
    for denser in (1, 2, 4):
        c, _ = cellwalk.control(fine, scale)
        found[f"bounded, x {denser}"] = with_control(fine, c, denser)
    found["gridmedium"] = grid.shadow_cells
    return found


def transmittances(rays: int, rounds: int, scales: list[float]) -> list[dict[str, Any]]:
    rows = []
    for name, values in grids().items():
        for scale in scales:
            grid = medium(values, scale, "auto")
            ray = shadow_rays(grid, rays)
            truth = quadrature(grid, ray)
            estimates = candidates(grid)

            def estimate(cells: Any, seed: int, grid: Any = grid, ray: Any = ray) -> Any:
                grid.shadow_cells = cells
                return grid.transmittance(ray, new_sampler(seed, rays))

            runs = {label: lambda seed, c=cells, run=estimate: run(c, seed) for label, cells in estimates.items()}
            seconds = cpu_seconds(runs, rounds)
            base = None
            for label, run in runs.items():
                errors = np.array([np.array(run(100 + seed))[0] - truth for seed in range(rounds)], dtype=np.float64)
                error = float((errors**2).mean())
                base = base or error * seconds[label]
                row = {
                    "grid": name,
                    "scale": scale,
                    "estimate": label,
                    "cells": [n - 2 for n in estimates[label].shape],
                    "cpu_seconds": seconds[label],
                    "squared_error": error,
                    "relative_cost": error * seconds[label] / base,
                    "largest_error": float(np.abs(errors).max()),
                    "z": float(errors.mean() / (errors.std() / np.sqrt(errors.size) + 1e-7)),
                }
                rows.append(row)
                print(
                    f"{name:8} scale {scale:5g}  {label:20}  {seconds[label] * 1e3:7.1f} ms  squared error {error:8.2e}"
                    f"  largest {row['largest_error']:7.2f}  cost {row['relative_cost']:7.3f}  z {row['z']:5.1f}",
                    flush=True,
                )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer rays and scales: to see that it works")
    parser.add_argument("--json", type=Path, help="write every figure there")
    args = parser.parse_args()
    set_variant("llvm_ad_rgb")
    rays, rounds = (2**14, 3) if args.quick else (2**17, 16)
    results = {
        "flights": flights(rays, rounds, [40] if args.quick else [1, 4, 10, 40, 100]),
        "transmittance": transmittances(rays, rounds, [10] if args.quick else [4, 20, 100]),
    }
    ratios = [row["speed_up"] for row in results["flights"]]
    print(f"speed-up of flights: median {statistics.median(ratios):.2f}, least {min(ratios):.2f}")
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
