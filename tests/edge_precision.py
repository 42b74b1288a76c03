"""How exact gradients with edges are: cells of truth, each with as many seeds as make the difference sure to 0.4 %.

    python tests/edge_precision.py [--seconds 240] [CELL ...]

prints a line for each cell, and then what all of them say together: by how much gradients differ from finite
differences, on average, and how their z are spread. A cell that is still noisy after so many seconds says so by its ±.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field

import numpy as np

from pathreplay import backend
from pathreplay.check.statistics import gap

backend.set_variant("llvm_ad_rgb")

from edge_scenes import ALL_MOVE, BY_NAME  # noqa: E402
from edge_truth import backwards, loaded  # noqa: E402
from truth import Bench, Case  # noqa: E402

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


def precise(case: Case, seconds: float) -> Samples:
    """Take samples until the difference is sure, or so many seconds of the processor are over."""
    samples, begin = Samples(), time.process_time()
    with loaded(case) as bench:
        while samples.relative()[1] > SURE and time.process_time() - begin < seconds:
            samples.more(bench)
    return samples


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
    asked = parser.parse_args()
    cells = {**BY_NAME, ALL_MOVE.name: ALL_MOVE}
    if unknown := [name for name in asked.cells if name not in cells]:
        parser.error(f"no cell is called {unknown[0]!r}; there are {', '.join(cells)}")
    found = []
    for name in asked.cells or cells:
        begin = time.process_time()
        samples = precise(cells[name], asked.seconds)
        found.append(samples.relative())
        off, error, z = found[-1]
        counts = f"{len(samples.gradients):5d} gradients, {len(samples.differences):5d} differences"
        value, spent = np.mean(samples.differences), time.process_time() - begin
        print(f"{name:18s} {value:+.5f}  {off:+7.2%} ± {error:.2%}  z {z:+.2f}  {counts}, {spent:4.0f} s", flush=True)
    print(together(found))


if __name__ == "__main__":
    main()
