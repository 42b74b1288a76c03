"""Random batches of pixels, and the check whether a view supports such batches."""

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
from pathreplay.platform.owned_arrays import with_space


@dataclass
class Batch:
    """Random pixels of a view, among those with a nonzero weight."""

    pixels: mi.UInt32
    share: float
    """Fraction of the image's pixels that have a nonzero weight. The batch is drawn from these pixels."""

    @staticmethod
    def of(weight: Array | None, size: tuple[int, int], most: int, seed: int) -> Batch | None:
        """Draw ``most`` random pixels of an image of ``size`` (height, width); None if the image has no more pixels."""
        height, width = size
        n = height * width
        if most >= n:
            return None
        among = None if weight is None else np.flatnonzero(weight)
        count = n if among is None else len(among)
        numbers = np.random.default_rng([BATCH, seed]).choice(count, min(most, count), replace=False)
        chosen = np.sort(numbers if among is None else among[numbers]).astype(np.uint32)
        pixels = mi.UInt32(with_space(chosen)) + dr.opaque(mi.UInt32, 0)  # copied as by `owned`
        dr.eval(pixels)
        return Batch(pixels, count / n)

    def rows(self, picture: Array) -> Array:
        """Return the values of an image at the pixels of the batch, one pixel per row."""
        return picture.reshape(-1, 1, picture.shape[2])[np.array(self.pixels)]


def obstacle(problem: Problem, integrator: StatefulIntegrator, sensor: int, spp: int, some: bool) -> str:
    """Return the reason why one pass cannot compute both image and gradient of a view, or "" if one pass suffices.

    With ``some``, the pass renders a batch of pixels. Otherwise it renders all pixels.
    """
    if problem.loss not in QUADRATIC:
        return "its loss is none of l2, relative-l2 and display-l2; use one of these"
    return integrator.why_no_pixel_sweep(problem.scene, problem.scene.sensors()[sensor], spp, some)


def refused(view: str, why: str) -> PathreplayError:
    """Return the error for a view that does not support pixel batches."""
    return PathreplayError(
        f"pixel_batch_size: view '{view}' cannot be rendered pixel by pixel, since {why}, "
        "or leave 'pixel_batch_size' out"
    )
