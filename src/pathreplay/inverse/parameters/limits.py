"""What a parameter may be: grids and values that fit the memory, and learning rates and poses of a sensible size."""

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

# A value: old and new, as Dr.Jit holds it; its gradient and their sum; Adam's two moments; once more on the way.
_A_VALUE = 32
# A step of Adam's is about the learning rate: nothing is found by steps a million times the value.
_LONGEST_STEP = 1e6
_FARTHEST = 1e4


def require_grid(key: str, shape: Sequence[int], resolutions: Sequence[int]) -> None:
    """Raise PathreplayError unless a grid of ``shape`` (axes, then channels) fits the memory in every resolution."""
    *axes, channels = (int(n) for n in shape)
    largest = max(axes)

    def cells(size: int) -> int:
        # In whole numbers, which do not overflow: what is asked for may be anything.
        return channels * prod(max(min(n, 2), (n * size + largest // 2) // largest) for n in axes)

    wanted = max(resolutions)
    most = min(memory.available() // _A_VALUE, MOST_SAMPLES)
    if cells(wanted) <= most:
        return
    # A resolution has at least as many cells.
    fits = bisect.bisect_right(range(min(wanted, most + 1)), most, key=cells) - 1
    way_out = f"take up to {fits}" if fits > 0 else "free some memory"
    raise PathreplayError(
        f"Parameter '{key}' has the resolution {wanted}: {cells(wanted)} values, of which {most} fit the memory "
        f"that is left; {way_out}"
    )


def require_values(sizes: Mapping[str, int]) -> None:
    """Raise PathreplayError unless parameters of these ``sizes`` (numbers, by key) fit the memory, and their steps."""
    largest = max(sizes, key=lambda key: sizes[key])
    thing = f"Optimising {sum(sizes.values())} numbers ('{largest}' has {sizes[largest]})"
    memory.require(sum(sizes.values()) * _A_VALUE, thing, "take fewer, or coarser textures and grids")


def require_learning_rate(key: str, rate: float, start: np.ndarray, bounds: Sequence[float | None] = ()) -> None:
    """Raise PathreplayError if a step of ``rate`` is a million times the largest value and bound of the parameter."""
    scale = max(1.0, float(np.abs(start).max(initial=0.0)), *(abs(bound) for bound in bounds if bound is not None))
    if rate > _LONGEST_STEP * scale:
        raise PathreplayError(
            f"Parameter '{key}' has the learning rate {rate:g}, about the step that it takes per iteration, and values "
            f"up to {scale:g}; lower 'learning_rate' (a hundredth of the values is a good start)"
        )


def require_near(scene: mi.Scene, key: str, value: Array, entry: Parameter) -> None:
    """Raise PathreplayError if pivot or start of a pose (of ``value``) lie ten thousand times as far as the scene goes.

    Beyond, the rounding of single precision (1e-7 of the number) is a thousandth of the scene and grows from there.
    Starts that are turned by more than once around are refused, too.
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
                f"Parameter '{key}': '{name}' goes to {largest:g}, and the scene to {extent:.3g}; give "
                f"numbers up to {_FARTHEST * extent:.3g}"
            )
    if (turn := start.rotation) and max(map(abs, turn)) > 360:
        raise PathreplayError(f"Parameter '{key}' starts turned by {turn} degrees; give angles between -360 and 360")
