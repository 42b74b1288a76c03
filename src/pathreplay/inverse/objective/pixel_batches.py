"""Batches of pixels: how an iteration draws them, and whether the pixels of a view can be rendered one by one."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.stateful import StatefulIntegrator
from pathreplay.inverse.config.schema import BATCH
from pathreplay.inverse.losses.pixelwise import QUADRATIC
from pathreplay.inverse.parameters.values import Array
from pathreplay.inverse.problem.problem import Problem


@dataclass
class Batch:
    """Pixels of a view, chosen at random among those that count."""

    pixels: mi.UInt32
    share: float
    """Of the picture, that these stand for: the pixels that count."""

    @staticmethod
    def of(weight: Array | None, size: tuple[int, int], most: int, seed: int) -> Batch | None:
        """Draw at most ``most`` pixels of an image of ``size`` (height, width); None if the image has no more."""
        height, width = size
        n = height * width
        if most >= n:
            return None
        among = None if weight is None else np.flatnonzero(weight)
        count = n if among is None else len(among)
        numbers = np.random.default_rng([BATCH, seed]).choice(count, min(most, count), replace=False)
        chosen = np.sort(numbers if among is None else among[numbers]).astype(np.uint32)
        pixels = mi.UInt32(chosen) + dr.opaque(mi.UInt32, 0)  # in memory of Dr.Jit's own: see `variables_of`
        dr.eval(pixels)
        return Batch(pixels, count / n)

    def rows(self, picture: Array) -> Array:
        """A row of a picture for each of these pixels."""
        return picture.reshape(-1, 1, picture.shape[2])[np.array(self.pixels)]


def obstacle(problem: Problem, integrator: StatefulIntegrator, sensor: int, spp: int, some: bool) -> str:
    """Why paths cannot be walked once for picture and gradient, of all pixels or of ``some``; "" where they can."""
    if problem.loss not in QUADRATIC:
        return "its loss is none of l2 and relative-l2; take one of these"
    return integrator.why_no_pixel_sweep(problem.scene, problem.scene.sensors()[sensor], spp, some)


def refused(view: str, why: str) -> PathreplayError:
    """The error where single pixels of a view cannot be rendered."""
    return PathreplayError(
        f"pixel_batch_size: view '{view}' cannot be rendered pixel by pixel, since {why}, "
        "or leave 'pixel_batch_size' out"
    )
