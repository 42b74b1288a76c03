"""Plans the stages of a job, coarse to fine, for a machine's speed and a time limit."""

from __future__ import annotations

from dataclasses import dataclass, replace

EVAL_SPP = 128
VIEWS = 8
"""Training views per iteration, half as many at full resolution."""
SAMPLES, MOST_SPP = 160_000, 4
"""Samples per iteration, with at most `MOST_SPP` per pixel: many noisy steps go further than a few exact ones."""
CHEAP, MOST_CHEAP_SPP = 0.25, 64
"""On a fast machine more samples are rendered, with at most `MOST_CHEAP_SPP` per pixel: as many per view as take
`CHEAP` times `A_VIEW`."""
SHARES = {8: 0.1, 4: 0.2, 2: 0.3, 1: 0.4}
"""Fraction of the time for each stage, by the factor by which images are reduced."""
RESOLUTION = 0.75
"""Voxels along the longest side of the region, per pixel along the longer side of an image."""
FINEST = 128
COARSEST = 16
LEAST, MOST = 40, 1500
"""Smallest and largest number of iterations of a stage."""
PASSES = 5.0
"""Time of an iteration per sample, relative to rendering an image: image, record, reverse sweep, second image."""
A_VIEW = 0.03
"""Seconds per view and iteration that do not depend on the number of samples."""
VALUES = 4
"""Numbers per voxel."""
A_VALUE, A_VALUE_OF_VIEW = 40e-9, 6e-9
"""Seconds per number of the grids and iteration, and in addition per view."""
TRACED = 4.0
"""Time to trace and compile an iteration, relative to an image. In each stage, each view is traced twice."""
USED = 0.75
"""Fraction of the time limit that the plan uses, without rendering of test views and writing."""


@dataclass(frozen=True)
class StagePlan:
    """A stage: iterations, downscale factor, resolution of grids, views per iteration, and samples per pixel."""

    iterations: int
    downscale: int
    resolution: int
    views: int
    spp: int
    first: bool


@dataclass(frozen=True)
class Speed:
    """Speed of a machine on a scene."""

    samples: float
    """Samples of an image per second."""
    tracing: float
    """Seconds to trace an image."""
    compiling: float
    """Seconds to compile the kernels of an image, once per stage."""


def plan_stages(
    speed: Speed, minutes: float, trained: int, width: int, height: int, posed: Speed | None = None
) -> list[StagePlan]:
    """Choose the stages that fit into a time limit.

    If the last stage would have less than `LEAST` iterations, it is left out, and the other stages share its time. This
    is repeated until the last stage has enough iterations or only the first stage is left.

    Args:
        speed: speed of the machine.
        minutes: time limit.
        trained: number of training views.
        width: width of the images in pixels.
        height: height of the images in pixels.
        posed: speed in the stages that refine poses, which are all but the first of several; None without poses.
    """
    seconds, shares = 60 * minutes * USED, dict(SHARES)
    while True:
        first = [k == 0 and len(shares) > 1 for k in range(len(shares))]
        speeds = [speed if posed is None or alone else posed for alone in first]
        overhead = TRACED * sum(2 * trained * each.tracing + each.compiling for each in speeds)
        left = max(seconds - overhead, 0.0)
        stages = []
        for own, alone, (factor, share) in zip(speeds, first, shares.items(), strict=True):
            pixels = (width // factor) * (height // factor)
            views = min(VIEWS if factor > 1 else VIEWS // 2, trained)
            wanted = min(round(SAMPLES / (views * pixels)), MOST_SPP)
            cheap = min(int(CHEAP * A_VIEW * own.samples / (PASSES * pixels)), MOST_CHEAP_SPP)
            spp = max(1, wanted, cheap)
            step = views * (A_VIEW + spp * PASSES * pixels / own.samples)
            size = min(max(round(RESOLUTION * max(width, height) / factor), COARSEST), FINEST)
            step += VALUES * size**3 * (A_VALUE + views * A_VALUE_OF_VIEW)
            count = int(left * share / sum(shares.values()) / step)
            stages.append(StagePlan(count, factor, size, views, spp, alone))
        if stages[-1].iterations >= LEAST or len(shares) == 1:
            break
        del shares[stages[-1].downscale]
    return [replace(s, iterations=min(max(s.iterations, LEAST), MOST)) for s in stages]
