"""Limits on parameters: sizes that fit into memory, and plausible learning rates and poses."""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from math import prod

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.film.image import MOST_SAMPLES
from pathreplay.inverse.config.parameter_options import Parameter
from pathreplay.inverse.parameters.values import Array
from pathreplay.platform import memory

# Bytes per optimised number, for eight floats: the old value, the new value, the copy in Dr.Jit, the gradient, the sum
# of gradients, Adam's two moments and a temporary. The two means of iterate averaging are not counted: variables of
# more than 2^24 entries are not averaged, so the means of a variable take at most 128 MB.
_A_VALUE = 32
# Largest ratio of a learning rate to the values. The learning rate is about the length of Adam's steps.
_LONGEST_STEP = 1e6
# Largest ratio of a pivot or displacement to the extent of the scene.
_FARTHEST = 1e4


def require_grid(key: str, shape: Sequence[int], resolutions: Sequence[int]) -> None:
    """Raise PathreplayError unless a grid of ``shape`` (axes, then channels) fits into memory in every resolution."""
    *axes, channels = (int(n) for n in shape)
    largest = max(axes)

    def cells(size: int) -> int:
        # This uses Python integers, which never overflow.
        return channels * prod(max(min(n, 2), (n * size + largest // 2) // largest) for n in axes)

    wanted = max(resolutions)
    most = min(memory.available() // _A_VALUE, MOST_SAMPLES)
    if cells(wanted) <= most:
        return
    # A resolution n has at least n cells, so resolutions above `most` need not be searched.
    fits = bisect.bisect_right(range(min(wanted, most + 1)), most, key=cells) - 1
    remedy = f"use a resolution up to {fits}" if fits > 0 else "free some memory"
    raise PathreplayError(
        f"Parameter '{key}' has {cells(wanted)} values at the resolution {wanted}, but only {most} fit into the "
        f"available memory; {remedy}"
    )


def require_values(sizes: Mapping[str, int]) -> None:
    """Raise PathreplayError unless variables of these ``sizes``, by key, and their optimiser state fit into memory."""
    largest = max(sizes, key=lambda key: sizes[key])
    thing = f"Optimising {sum(sizes.values())} numbers ('{largest}' has {sizes[largest]})"
    memory.require(sum(sizes.values()) * _A_VALUE, thing, "use fewer parameters, or coarser textures and volumes")


def require_learning_rate(key: str, rate: float, start: np.ndarray, bounds: Sequence[float | None] = ()) -> None:
    """Raise PathreplayError if ``rate`` exceeds a million times the largest magnitude of the values and bounds."""
    scale = max(1.0, float(np.abs(start).max(initial=0.0)), *(abs(bound) for bound in bounds if bound is not None))
    if rate > _LONGEST_STEP * scale:
        raise PathreplayError(
            f"Parameter '{key}' has the learning rate {rate:g}, which is about the length of a step, and values up to "
            f"{scale:g}; lower 'learning_rate' (a hundredth of the values is a good start)"
        )


def require_near(scene: mi.Scene, key: str, value: Array, entry: Parameter) -> None:
    """Raise PathreplayError if the pivot or initial displacement of a pose is implausibly large.

    Coordinates are limited to ten thousand times the extent of the scene. Beyond this limit, rounding errors of single
    precision (1e-7, relative) exceed a thousandth of the extent. Rotations are limited to one full turn.

    Args:
        scene: the scene.
        key: key of the parameter.
        value: value of the parameter, a 4 x 4 matrix or vertex positions.
        entry: table of the parameter in the job.
    """
    box = scene.bbox()
    corners = [np.array(box.min), np.array(box.max)] if box.valid() else []
    points = [*corners, value[:3, 3] if value.shape == (4, 4) else value]
    extent = max(float(np.abs(point).max(initial=0.0)) for point in points) or 1.0
    start = entry.displacement
    for name, vector in (("pivot", entry.pivot), ("initial.translation", start.translation)):
        largest = max(map(abs, vector or [0.0]))
        if largest > _FARTHEST * extent:
            raise PathreplayError(
                f"Parameter '{key}': '{name}' has coordinates up to {largest:g}, but the scene extends to "
                f"{extent:.3g}; give coordinates up to {_FARTHEST * extent:.3g}"
            )
    if (turn := start.rotation) and max(map(abs, turn)) > 360:
        raise PathreplayError(
            f"Parameter '{key}': 'initial.rotation' is {turn} degrees; give angles between -360 and 360"
        )
