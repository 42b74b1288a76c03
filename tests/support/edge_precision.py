"""How exact gradients with edges are: cells of truth, each with as many seeds as make the difference sure to 0.4 %.

    python tests/support/edge_precision.py [--seconds 240] [--times N] [--processes N] [--length PIXELS] [CELL ...]

prints a line for each cell, and then what all of them say together: by how much gradients differ from finite
differences, on average, and how their z are spread. A cell that is still noisy after so many seconds says so by its ±.
On a GPU (PATHREPLAY_TEST_VARIANT=cuda_ad_rgb) take more samples at a time: --times 32.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from pathreplay.integrators import boundary_term as boundary
from pathreplay.platform import backend
from pathreplay.testing.statistics import gap
from variant import VARIANT

backend.set_variant(VARIANT)

from edge_scenes import ALL_MOVE, BY_NAME  # noqa: E402
from edge_truth import backwards, loaded  # noqa: E402
from truth import Bench  # noqa: E402

SURE = 0.004
"""Standard error of the difference, relative to the gradient, at which a cell is done."""
BATCH = 16
FIRST = 100_000
"""These seeds are no test's."""


@dataclass
class Samples:
    """Of one cell: gradients and finite differences so far, by seed."""

    gradients: list[float] = field(default_factory=list)
    differences: list[float] = field(default_factory=list)

    def more(self, bench: Bench) -> None:
        """A batch of those that are less sure."""
        if self._noise(self.gradients) >= self._noise(self.differences):
            self.gradients += list(backwards(bench, BATCH, FIRST + len(self.gradients)))
        else:
            self.differences += list(bench.reference(BATCH, first=FIRST + len(self.differences)))

    @staticmethod
    def _noise(samples: list[float]) -> float:
        return float(np.std(samples, ddof=1)) / len(samples) ** 0.5 if samples else np.inf

    def relative(self) -> tuple[float, float, float]:
        """Difference and its standard error in units of the finite difference, and z."""
        if not self.differences:
            return np.nan, np.inf, np.nan
        found, unit = gap(self.gradients, self.differences), abs(np.mean(self.differences))
        return found.value / unit, found.error / unit, found.z


@dataclass(frozen=True)
class Cell:
    """What is measured, for how long, with how many times its samples, and by how long lines on the film."""

    name: str
    seconds: float
    times: int
    length: float


def precise(cell: Cell) -> tuple[Samples, float]:
    """Samples until the difference is sure, or so many seconds of the processor are over; the seconds."""
    case = {**BY_NAME, ALL_MOVE.name: ALL_MOVE}[cell.name]
    more = replace(case, spp=cell.times * case.spp, reference_spp=cell.times * (case.reference_spp or case.spp))
    boundary.FILM_LENGTH = cell.length
    samples, begin = Samples(), time.process_time()
    with loaded(more) as bench:
        while not samples.differences or (samples.relative()[1] > SURE and time.process_time() - begin < cell.seconds):
            samples.more(bench)
    return samples, time.process_time() - begin


def measured(cells: list[Cell], processes: int) -> Iterator[tuple[Samples, float]]:
    """Of all cells, in their order, each in a process of its own if there are several."""
    if processes == 1:
        yield from map(precise, cells)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, max_tasks_per_child=1) as pool:
        yield from pool.map(precise, cells)


def together(found: list[tuple[float, float, float]]) -> str:
    """What all cells say."""
    off, error, z = np.array(found).T
    weight = 1 / np.square(error)
    mean, σ = (off * weight).sum() / weight.sum(), weight.sum() ** -0.5
    return (
        f"all {len(found)}: gradients are off by {mean:+.2%} ± {σ:.2%} on average, median of |difference| "
        f"{np.median(np.abs(off)):.2%}; mean of z² {np.mean(z**2):.2f}, largest |z| {np.abs(z).max():.2f}; "
        f"{(np.abs(off) < 0.015).sum()} within 1.5 %, {(np.abs(off) - 2 * error > 0.015).sum()} for certain not"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", nargs="*", metavar="CELL", help="names of cells (default: all)")
    parser.add_argument("--seconds", type=float, default=240, help="of the processor, for a cell")
    parser.add_argument("--times", type=int, default=1, help="how many times a cell's samples are taken at once")
    parser.add_argument("--processes", type=int, default=1, help="that measure side by side")
    parser.add_argument("--length", type=float, default=boundary.FILM_LENGTH, help="of lines on the film, in pixels")
    asked = parser.parse_args()
    known = [*BY_NAME, ALL_MOVE.name]
    if unknown := [name for name in asked.cells if name not in known]:
        parser.error(f"no cell is called {unknown[0]!r}; there are {', '.join(known)}")
    cells = [Cell(name, asked.seconds, asked.times, asked.length) for name in asked.cells or known]
    found = []
    for cell, (samples, spent) in zip(cells, measured(cells, asked.processes), strict=True):
        found.append(samples.relative())
        off, error, z = found[-1]
        counts = f"{len(samples.gradients):5d} gradients, {len(samples.differences):5d} differences, {spent:4.0f} s"
        value = np.mean(samples.differences)
        print(f"{cell.name:18s} {value:+.5f}  {off:+7.2%} ± {error:.2%}  z {z:+.2f}  {counts}", flush=True)
    print(together(found))


if __name__ == "__main__":
    main()
