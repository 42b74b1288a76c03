"""Streams of random numbers: no two purposes share a value, nor the numbers of a key."""

from __future__ import annotations

from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream

OF_A_KEY = [stream for stream in Stream if 0x100 <= stream <= 0x80000 and stream != Stream.BOUNDARY]
DRAWN = 16
"""Numbers that a stream of a key draws at least, beside those of vertices."""


def test_streams_have_values_of_their_own() -> None:
    values = [stream.value for stream in Stream.__members__.values()]  # also those that would be other names of one
    assert len(values) > 15 and len(set(values)) == len(values)


def test_streams_of_a_key_share_no_numbers() -> None:
    assert len(OF_A_KEY) == 9
    assert all(b - a >= DRAWN for a, b in pairwise(sorted(OF_A_KEY)))
    key = dr.full(mi.UInt32, 7, 1)
    samplers = [CounterSampler.of(key), *(CounterSampler.stream(key, stream) for stream in OF_A_KEY)]
    drawn = np.array([sampler.next_1d()[0] for sampler in samplers for _ in range(DRAWN)])
    assert len(np.unique(drawn)) == len(drawn)


def test_streams_of_a_seed_have_seeds_of_their_own() -> None:
    seed = mi.UInt32([1, 2, 3])
    assert len({tuple(np.array(stream.of(seed))) for stream in Stream}) == len(Stream)
