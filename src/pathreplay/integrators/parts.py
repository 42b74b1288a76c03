"""Split a pass of many samples into parts with their own seeds, and average the parts, weighted by their samples.

Dr.Jit counts the samples of a kernel in 32 bits, but single precision limits the accuracy of sums at much smaller
counts. A sum of n equal numbers, added one by one, has a relative error of up to n 2^-25, and stops growing at n =
2^24. Dr.Jit first sums packets of 16 samples. The packets are then added one by one, both to a pixel and to the
gradient of a scalar.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Seed
from pathreplay.integrators.film.image import MOST_SAMPLES, film_size
from pathreplay.platform.traversal import known_values
from pathreplay.samplers.streams import Stream
from pathreplay.scenes.parameters import SceneValue, is_transform

# Largest number of samples of a pass that is not split. If all samples contribute equally, the relative rounding error
# of a scalar's gradient is then below 1e-2. If the contributions differ, this error is far below the noise of the
# gradient.
MOST_AT_ONCE = 2**24
# Number of samples of a part, if a pass is split. At this number, the relative rounding error of a scalar's gradient is
# 1.3e-3. A part takes a few tenths of a second. The time to trace the kernel again for the part is negligible in
# comparison.
A_PART = 2**22
# Largest number of samples per pixel in one pass or part. At this number, a pixel of constant colour has a relative
# rounding error of 7e-4.
MOST_A_PIXEL = 2**16
# Smallest number of samples per pixel in a part with many pixels. Every part repeats the work on the film. With fewer
# samples per part, this work would take a noticeable fraction of the time.
LEAST_A_PIXEL = 4
# Largest number of samples of one call. A call of this size can take more than an hour. Calls show no progress and
# cannot be interrupted.
MOST_IN_ALL = 2**36


def parts(view: Pass) -> list[Pass]:
    """Split a pass of many samples into parts with weights ``share``; the first part keeps the seed.

    Returns the pass itself if it needs no split. Raises PathreplayError for films with more than `MOST_SAMPLES` pixels,
    and for more than `MOST_IN_ALL` samples.
    """
    width, height = film_size(view.sensor)
    pixels = width * height
    if pixels > MOST_SAMPLES:
        raise PathreplayError(
            f"The film of sensor '{view.sensor.id()}' has {width} x {height} pixels, more than the {MOST_SAMPLES} "
            "samples that Dr.Jit can process at once; make it smaller, or give it a crop window"
        )
    if pixels * view.spp > MOST_IN_ALL:
        raise PathreplayError(
            f"spp = {view.spp} with a film of {width} x {height} pixels are more samples than the limit of one "
            f"call, {MOST_IN_ALL}; take spp up to {MOST_IN_ALL // pixels}, and average calls with different seeds"
        )
    if pixels * view.spp <= MOST_AT_ONCE and view.spp <= MOST_A_PIXEL:
        return [view]
    sampler = view.sensor.sampler()
    counts = split(sampler, view.spp, min(max(A_PART // pixels, LEAST_A_PIXEL), MOST_A_PIXEL, MOST_SAMPLES // pixels))
    if len(counts) == 1:
        return [view]
    taken = [rounded(sampler, count) for count in counts]
    return [
        replace(view, seed=_seed(view.seed, k), spp=counts[k], share=taken[k] / sum(taken)) for k in range(len(counts))
    ]


class Sums:
    """Sums of parameter gradients over parts. Gradients are reset after each part to limit rounding errors."""

    def __init__(self, scene: mi.Scene) -> None:
        params = mi.traverse(scene)
        with dr.resume_grad():
            self._values = [
                part for _, value in known_values(params) for part in _arrays(value) if dr.grad_enabled(part)
            ]
        self._sums: list[dr.ArrayBase | None] = [None] * len(self._values)
        self.take()

    def take(self) -> None:
        """Add the current gradients of the parameters to the sums, and reset the gradients to zero."""
        for n, value in enumerate(self._values):
            gradient = dr.grad(value)
            self._sums[n] = gradient if self._sums[n] is None else self._sums[n] + gradient
            dr.set_grad(value, 0)
        dr.eval(self._sums)

    def give(self) -> None:
        """Set the gradients of the parameters to the sums."""
        for value, total in zip(self._values, self._sums, strict=True):
            dr.set_grad(value, total)


@contextmanager
def summed(scene: mi.Scene, passes: Sequence[Pass]) -> Iterator[Callable[[], None]]:
    """Context that sums the gradients of back-propagated parts; yields a function to call after each part."""
    sums = Sums(scene) if len(passes) > 1 else None
    try:
        yield (lambda: None) if sums is None else sums.take
    finally:
        if sums is not None:  # even after an error, because the sums include the gradients of earlier passes
            sums.give()


def _arrays(value: SceneValue) -> list[dr.ArrayBase]:
    return [value.matrix, value.inverse_transpose] if is_transform(value) else [value]


def split(sampler: mi.Sampler, spp: int, most: int) -> list[int]:
    """Return the number of samples per pixel of each part. No part has more than ``most``.

    For an `independent` sampler, the numbers add up to ``spp``. Other samplers stratify the samples of a pixel. If the
    pass is split, their numbers are powers of four, which every sampler accepts. The sum of these numbers may exceed
    ``spp``.
    """
    if spp <= most:
        return [spp]
    if sampler.class_name() == "IndependentSampler":
        count = math.ceil(spp / most)
        return [spp // count + (i < spp % count) for i in range(count)]
    size = 4 ** int(math.log(most, 4))
    return [size] * math.ceil(spp / size)


def rounded(sampler: mi.Sampler, count: int) -> int:
    """Return the number of samples per pixel to which a sampler rounds ``count``."""
    copy = sampler.clone()  # The count of the sensor's own sampler must not change here.
    copy.set_sample_count(count)
    return int(copy.sample_count())


def _seed(seed: Seed, part: int) -> Seed:
    return seed if part == 0 else mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(int(Stream.PARTS) + part))[0]
