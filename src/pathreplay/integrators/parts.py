"""Split a pass of many samples into passes with their own seeds; the result is their mean, weighted by samples.

Dr.Jit counts the samples of a kernel in 32 bits. Long before, single precision ends what sums can hold: one to which
n equal numbers are added, one by one, is off by up to n 2^-25 of itself, and stands still at n = 2^24. Packets of 16
samples are added up before that, and no more: neither the sum of a pixel nor the gradient of a number is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Seed
from pathreplay.integrators.film.image import MOST_SAMPLES, film_size
from pathreplay.platform.traversal import known_values
from pathreplay.scenes.parameters import is_transform

# Up to so many samples a pass is one. The gradient of a number is then off by less than 1e-2 of itself, where all
# samples add the same to it, and by far less than its noise, where they do not.
MOST_AT_ONCE = 2**24
# Samples of a part of a larger one: off by 1.3e-3, and some tenths of a second of work, beside which tracing it once
# more does not count.
A_PART = 2**22
# Samples of a pixel, of a pass and of a part: a pixel of one colour is off by 7e-4 of it.
MOST_A_PIXEL = 2**16
# Of a part of many pixels: beside fewer, the work on the film would count.
LEAST_A_PIXEL = 4
# Samples of one call, which cannot be stopped or seen: minutes on the machines of today.
MOST_IN_ALL = 2**36


def parts(view: Pass) -> list[Pass]:
    """Yield the pass, or the passes that it is split into with their ``share``; the first has its seed.

    Raises PathreplayError where one sample for each pixel is beyond what Dr.Jit can count, or all of them would take
    hours.
    """
    width, height = film_size(view.sensor)
    pixels = width * height
    if pixels > MOST_SAMPLES:
        raise PathreplayError(
            f"The film of sensor '{view.sensor.id()}' has {width} x {height} pixels, beyond the {MOST_SAMPLES} samples "
            "that Dr.Jit takes at once; make it smaller, or give it a crop window"
        )
    if pixels * view.spp > MOST_IN_ALL:
        raise PathreplayError(
            f"spp = {view.spp} with a film of {width} x {height} pixels are more samples than one call takes, "
            f"{MOST_IN_ALL}; take spp up to {MOST_IN_ALL // pixels}, and the mean of calls with other seeds"
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
    """Gradients of a scene's parameters over parts: each begins at zero, or kernels would add to what there is."""

    def __init__(self, scene: mi.Scene) -> None:
        params = mi.traverse(scene)
        with dr.resume_grad():
            self._values = [
                part for _, value in known_values(params) for part in _arrays(value) if dr.grad_enabled(part)
            ]
        self._sums: list[Any] = [None] * len(self._values)
        self.take()

    def take(self) -> None:
        """Add the gradients since the last call."""
        for n, value in enumerate(self._values):
            found = dr.grad(value)
            self._sums[n] = found if self._sums[n] is None else self._sums[n] + found
            dr.set_grad(value, 0)
        dr.eval(self._sums)

    def give(self) -> None:
        """Write the sums to the parameters."""
        for value, total in zip(self._values, self._sums, strict=True):
            dr.set_grad(value, total)


@contextmanager
def summed(scene: mi.Scene, of_parts: Sequence[Pass]) -> Iterator[Callable[[], None]]:
    """Add up the gradients of parts that are back-propagated one by one; yields a function to call after each."""
    sums = Sums(scene) if len(of_parts) > 1 else None
    try:
        yield (lambda: None) if sums is None else sums.take
    finally:
        if sums is not None:  # also if no parameter reaches this view: gradients of others stay
            sums.give()


def _arrays(value: Any) -> list[Any]:
    return [value.matrix, value.inverse_transpose] if is_transform(value) else [value]


def split(sampler: mi.Sampler, spp: int, most: int) -> list[int]:
    """Samples per pixel of each part, about ``most``. They add up to ``spp``, or more if the sampler rounds up.

    Samplers other than `independent` stratify the samples of a pixel. Their parts are powers of four, which all of them
    accept.
    """
    if spp <= most:
        return [spp]
    if sampler.class_name() == "IndependentSampler":
        count = math.ceil(spp / most)
        return [spp // count + (i < spp % count) for i in range(count)]
    each = 4 ** int(math.log(most, 4))
    return [each] * math.ceil(spp / each)


def rounded(sampler: mi.Sampler, count: int) -> int:
    """Samples per pixel to which a sampler rounds a requested number."""
    copy = sampler.clone()  # integrators differ in whether they tell the sensor's own
    copy.set_sample_count(count)
    return int(copy.sample_count())


def _seed(seed: Seed, part: int) -> Seed:
    return seed if part == 0 else mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(part))[0]
