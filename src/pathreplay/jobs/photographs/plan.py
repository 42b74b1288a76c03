"""Plans the stages of a job, coarse to fine, for a machine's speed and a time limit."""

from __future__ import annotations

from dataclasses import dataclass

SPP = 4
EVAL_SPP = 16
VIEWS = 8
"""Training views per iteration."""
SHARES = {8: 0.1, 4: 0.2, 2: 0.3, 1: 0.4}
"""Fraction of the time for each stage, by the factor by which images are reduced."""
RESOLUTION = 0.75
"""Voxels along the longest side of the region, per pixel along the longer side of an image."""
FINEST = 160
COARSEST = 16
LEAST, MOST = 40, 1500
"""Smallest and largest number of iterations of a stage."""
PASSES = 5.0
"""Time of an iteration per sample, relative to rendering an image: image, record, reverse sweep, second image."""
USED = 0.75
"""Fraction of the time limit that the plan uses, without rendering of test views and writing."""


@dataclass(frozen=True)
class StagePlan:
    """A stage: iterations, reduction of the images, resolution of grids, factor on learning rates."""

    iterations: int
    downscale: int
    resolution: int
    first: bool
    rate: float = 1.0


@dataclass(frozen=True)
class Plan:
    """The stages of a job, and its numbers of samples and views."""

    stages: list[StagePlan]
    views: int
    name: str
    spp: int = SPP
    eval_spp: int = EVAL_SPP


@dataclass(frozen=True)
class Speed:
    """Speed of a machine on a scene."""

    samples: float
    """Samples of an image per second."""
    tracing: float
    """Seconds to trace the kernels of a view once."""


def plan_stages(speed: Speed, minutes: float, trained: int, width: int, height: int, name: str) -> Plan:
    """Choose the stages that fit into a time limit.

    A stage with less than `LEAST` iterations is left out, and its time goes to the others; the first stage stays.

    Args:
        speed: speed of the machine.
        minutes: time limit.
        trained: number of training views.
        width: width of the images in pixels.
        height: height of the images in pixels.
        name: path of the job.
    """
    views = min(VIEWS, trained)
    seconds = 60 * minutes * USED
    shares = dict(SHARES)
    while True:
        left = seconds - len(shares) * 2 * trained * speed.tracing
        total = sum(shares.values())
        counts = {}
        for factor, share in shares.items():
            step = views * SPP * PASSES * (width // factor) * (height // factor) / speed.samples
            counts[factor] = int(max(left, 0) * share / total / step)
        finest = min(shares)
        if counts[finest] >= LEAST or len(shares) == 1:
            break
        del shares[finest]
    stages = []
    for k, (factor, count) in enumerate(counts.items()):
        size = round(RESOLUTION * max(width, height) / factor)
        stages.append(
            StagePlan(
                min(max(count, LEAST), MOST), factor, min(max(size, COARSEST), FINEST), k == 0 and len(counts) > 1
            )
        )
    return Plan(stages, views, name)
