"""Compares gradients of extinction in media: ours, `prbvolpath`, differential ratio tracking and sample matching.

    python -m benchmarks.volume_peers [ROW ...] [--drt CHECKOUT] [--matching CHECKOUT] [--record FILE]

The checkouts are those of the repositories `rgl-epfl/unbiased-inverse-volume-rendering` (differential ratio tracking,
2022) and `AuroraRyan0301/SampleMatching` (2026), whose integrators `old_integrators` runs under the installed Mitsuba.

The objective is a weighted mean of an image of 32 x 32 pixels. All methods take turns, pass by pass, in one process.
Time is processor time of all threads (`time.process_time`), because other processes may run at the same time. What an
integrator has learned is dropped after each RUN passes, so that the cost of learning is included. A noise is the
variance of one pass: summed over all voxels, or of one number, the derivative by a common factor of the grid. Values of
variance x time are relative to ours, with 95 % intervals. Above 1, the method needs so many times longer for equal
noise. Methods that take more than PATIENCE seconds have fewer passes.

The references are central differences of `volpath` along two directions, with the same random numbers for all terms of
a difference. (One-sided differences for voxels that are zero.) A result is called wrong beyond four standard errors.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pathreplay.platform.backend import set_variant

set_variant("llvm_ad_rgb")

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from pathreplay.errors import PathreplayError  # noqa: E402
from pathreplay.testing.objective import Objective, smooth_weights  # noqa: E402
from pathreplay.testing.statistics import gap, mean_and_error  # noqa: E402
from pathreplay.testing.stencil import UPWARD, WIDE, Stencil  # noqa: E402
from pathreplay.testing.verdict import Z_LIMIT  # noqa: E402

from . import old_integrators  # noqa: E402
from .measures.estimates import Estimate, interval  # noqa: E402
from .scenes.media import ALBEDO, DENSITY, MEDIA_SCENES  # noqa: E402

RESOLUTION, SPP = 32, 16
WARMUP, RUN = 3, 50
PATIENCE = 60.0
"""Processor time in seconds after which a method has no more passes."""
REFERENCE_SEEDS = 8
OURS = "pathreplay"


@dataclass(frozen=True)
class Row:
    """A scene, the grid that has gradients, and the length of paths."""

    scene: str
    key: str = DENSITY
    max_depth: int = 64
    rr_depth: int = 5
    rounds: int = 120
    reference_spp: int = 256

    def directions(self, grid: np.ndarray) -> dict[str, tuple[np.ndarray, Stencil, float]]:
        """Return directions in the space of voxels, with the stencil and step of their differences."""
        empty = (grid == 0).astype(np.float32)
        if self.key == ALBEDO:
            # The albedo may not exceed 1.
            step = 0.45 * float((1 / grid).min() - 1)
            return {"factor": (grid, WIDE, step), "all voxels": (np.ones_like(grid), WIDE, step * float(grid.max()))}
        factor = (grid, WIDE, 0.15)
        if empty.any():
            return {"factor": factor, "empty voxels": (empty, UPWARD, 0.005)}
        return {"factor": factor, "all voxels": (np.ones_like(grid), WIDE, 0.2 * float(grid.min()))}


ROWS = {
    "cloud": Row("cloud", rounds=150, reference_spp=1024),
    "dense core": Row("dense-core", max_depth=96, rr_depth=97, rounds=24, reference_spp=96),
    "room with cloud": Row("room-with-cloud", max_depth=32),
    "empty voxels": Row("empty-voxels"),
    "albedo": Row("cloud-of-albedos", key=ALBEDO, rounds=60),
}


def methods(drt: Path | None, matching: Path | None) -> dict[str, Callable[[dict[str, Any]], mi.Integrator]]:
    """Return functions that create each integrator with the given limits of path length."""
    found: dict[str, Callable[[dict[str, Any]], mi.Integrator]] = {
        name: lambda limits, name=name: mi.load_dict({"type": name} | limits) for name in (OURS, "prbvolpath")
    }

    def add(name: str, root: Path | None, file: str, **options: Any) -> None:
        if root is None:
            return
        (factory,) = old_integrators.load(root / "python" / "integrators" / f"{file}.py").values()
        found[name] = lambda limits: old_integrators.integrator(factory, **limits, **options)

    # The options are those that the README of sample matching names: `volpathsimple-drt-mis-linear` and
    # `volpathsimple-drt-mis-n4`, `volpathfm-linear-drt-sd-n4` and `volpathfm-drt-sd-n4`.
    add("ratio tracking, linear", drt, "volpathsimple")
    add("ratio tracking, quadratic", drt, "volpathsimple", use_drt_subsampling=False)
    four = {"n_samples_transmittance": 4, "use_drt_mis": False}
    add("sample matching, linear", matching, "volpathfm_linear_sd", **four)
    add("sample matching, quadratic", matching, "volpathfm_sd", use_drt_subsampling=False, **four)
    return found


# ------------------------------ Measurement ------------------------------


class Passes(NamedTuple):
    """All passes of a method."""

    seconds: np.ndarray  # (n,)
    squares: np.ndarray  # (n,): squared errors, summed over voxels
    along: dict[str, np.ndarray]  # (n,) by direction: derivatives


class Problem:
    """A scene and its objective."""

    def __init__(self, row: Row) -> None:
        gc.collect()
        self.row = row
        self.scene = mi.load_dict(MEDIA_SCENES[row.scene](RESOLUTION))
        self.params = mi.traverse(self.scene)
        self.grid = np.array(self.params[row.key])
        self.weights = smooth_weights((RESOLUTION, RESOLUTION, 3), alpha=False)
        self.limits = {"max_depth": row.max_depth, "rr_depth": row.rr_depth}

    def references(self) -> dict[str, np.ndarray]:
        """Compute differences along each direction, one for each seed."""
        plain = mi.load_dict({"type": "volpath"} | self.limits)
        found = {}
        for name, (along, stencil, step) in self.row.directions(self.grid).items():
            ray = mi.TensorXf(along)
            objective = Objective(
                self.scene, self.params, self.row.key, lambda value, t, ray=ray: mi.TensorXf(value) + t * ray
            )
            objective.weigh(self.weights)
            seeds = range(1000, 1000 + REFERENCE_SEEDS)
            images = (objective.difference(plain, stencil, step, seed, self.row.reference_spp) for seed in seeds)
            found[name] = np.array([objective.dot(image) for image in images])
            objective.put(mi.Float(0))
        return found

    def gradient(self, integrator: mi.Integrator, seed: int) -> tuple[float, np.ndarray]:
        """Run one pass; return its processor time in seconds, and the gradient."""
        key, adjoint = self.row.key, mi.TensorXf(self.weights.astype(np.float32))
        dr.enable_grad(self.params[key])
        self.params.update()
        before = time.process_time()
        integrator.render_backward(self.scene, self.params, adjoint, self.scene.sensors()[0], seed=seed, spp=SPP)
        dr.enqueue(dr.ADMode.Backward, self.params[key])
        dr.traverse(dr.ADMode.Backward)
        gradient = np.array(dr.grad(self.params[key]), np.float64)
        seconds = time.process_time() - before
        dr.disable_grad(self.params[key])
        return seconds, gradient

    def passes(self, create: dict[str, Callable[[dict[str, Any]], mi.Integrator]]) -> Iterator[tuple[str, Any]]:
        """Run all methods in turn, and return the passes of each, or its error message."""
        integrators = {name: new(self.limits) for name, new in create.items()}
        kept: dict[str, list[tuple[float, np.ndarray]]] = {name: [] for name in create}
        errors: dict[str, str] = {}
        for k in range(-WARMUP, self.row.rounds):
            for name in kept:
                if name in errors or sum(seconds for seconds, _ in kept[name]) > PATIENCE:
                    continue
                if k % RUN == 0 and name == OURS:
                    integrators[name] = create[name](self.limits)
                try:
                    sample = self.gradient(integrators[name], seed=k % 2**32)
                except (RuntimeError, PathreplayError) as error:
                    errors[name] = str(error.__cause__ or error).splitlines()[0]
                    continue
                if k >= 0:
                    kept[name].append(sample)
        for name, samples in kept.items():
            yield name, errors[name] if name in errors else self._statistics(samples)

    def _statistics(self, samples: list[tuple[float, np.ndarray]]) -> Passes:
        gradients = np.array([gradient for _, gradient in samples])
        n = len(gradients)
        deviations = (gradients - gradients.mean(axis=0)).reshape(n, -1)
        along = {
            name: (gradients * direction).reshape(n, -1).sum(axis=1)
            for name, (direction, _, _) in self.row.directions(self.grid).items()
        }
        squares = np.square(deviations).sum(axis=1) * n / (n - 1)
        return Passes(np.array([seconds for seconds, _ in samples]), squares, along)


# ------------------------------ Table ------------------------------


def cost(theirs: Passes, ours: Passes, errors: Callable[[Passes], np.ndarray]) -> Estimate:
    """Return variance x time of a method relative to ours, with an interval from resampled rounds."""

    def ratio(t: np.ndarray, a: np.ndarray, u: np.ndarray, b: np.ndarray, axis: int) -> np.ndarray:
        return t.mean(axis) * a.mean(axis) / (u.mean(axis) * b.mean(axis))

    samples = theirs.seconds, errors(theirs), ours.seconds, errors(ours)
    common = min(map(len, samples))
    return interval(ratio, *(values[:common] for values in samples), paired=True)


def squared_errors(passes: Passes, direction: str) -> np.ndarray:
    samples = passes.along[direction]
    return np.square(samples - samples.mean()) * len(samples) / (len(samples) - 1)


def cells(theirs: Passes, ours: Passes, references: dict[str, np.ndarray]) -> list[str]:
    own = theirs is ours
    found = [f"{theirs.seconds.mean():.3f}"]
    found.append("1" if own else str(cost(theirs, ours, lambda passes: passes.squares)))
    found.append("1" if own else str(cost(theirs, ours, lambda passes: squared_errors(passes, "factor"))))
    for name, reference in references.items():
        z, (value, _) = gap(theirs.along[name], reference).z, mean_and_error(theirs.along[name])
        text = f"{name}: {value / reference.mean():.3f} (z {z:+.1f})"
        found.append(f"{text} **wrong**" if abs(z) > Z_LIMIT else text)
    return found


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.volume_peers")
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []], default=[])
    parser.add_argument("--drt", type=Path, help="checkout of rgl-epfl/unbiased-inverse-volume-rendering")
    parser.add_argument("--matching", type=Path, help="checkout of AuroraRyan0301/SampleMatching")
    parser.add_argument("--record", type=Path, help="append times and derivatives to a file of JSON lines")
    given = parser.parse_args()
    mi.set_log_level(mi.LogLevel.Error)
    titles = ["scene", "method", "processor s", "variance x time, voxels", "variance x time, factor"]
    titles += ["relative to differences", "relative to differences"]
    print(f"| {' | '.join(titles)} |\n|{' --- |' * len(titles)}")
    create = methods(given.drt, given.matching)
    for name in given.rows or ROWS:
        problem = Problem(ROWS[name])
        references = problem.references()
        results = dict(problem.passes(create))
        for method, passes in results.items():
            told = [passes, *[""] * 4] if isinstance(passes, str) else cells(passes, results[OURS], references)
            print(f"| {' | '.join([name, method, *told])} |", flush=True)
        if given.record:
            with given.record.open("a") as file:
                for method, passes in results.items():
                    facts = {"error": passes} if isinstance(passes, str) else numbers(passes)
                    file.write(json.dumps({"row": name, "method": method} | facts) + "\n")


def numbers(passes: Passes) -> dict[str, Any]:
    """Return all samples as numbers of JSON."""
    along = {name: samples.tolist() for name, samples in passes.along.items()}
    return {"seconds": passes.seconds.tolist(), "squares": passes.squares.tolist(), "along": along}


if __name__ == "__main__":
    main()
