"""Streams: names of the random numbers that counter-based samplers give, one for each purpose.

A stream is set apart in one of three ways: its value is the index of its first number among those of a key
(`CounterSampler.stream`), it is mixed into a seed or key by exclusive or, or it is added to the state of a generator.
Index 0 of a key belongs to the path itself, six numbers a vertex (see `CounterSampler.at_vertex`).
"""

from __future__ import annotations

from enum import IntEnum

import mitsuba as mi


class Stream(IntEnum):
    """What random numbers are for."""

    # Mixed into the seed of a pass.
    BOUNDARY = 0x5EED  # the boundary term, beside the interior
    FIRST_LOOK = 0x7F4A7C15  # segments that tell where segments are drawn
    CAST_SHADOWS = 0x2C1B3C6D
    PRIMARY_KEYS = 0x51ED270B
    SECONDARY_KEYS = 0x2545F491
    VOLUMETRIC_KEYS = 0x3C6EF372
    VOLUMETRIC_CENTRES = 0x1F83D9AB
    # Mixed into the key of a path.
    EMITTER_SEGMENTS = 0x1B873593
    ARCS = 0x38B34AE5
    # Index of the first number of a key.
    ARC = 0x100
    BEYOND_EDGE = 0x20000  # what comes from there
    BEAM = 0x30000
    BEAM_EMITTER = 0x30010
    CAMERA = 0x40000
    TRANSMITTANCE_OF_CHAIN = 0x50000
    TRANSMITTANCE_PAST_EDGE = 0x60000
    TRANSMITTANCE_TO_EDGE = 0x70000
    TRANSMITTANCE_OF_BEAM = 0x80000
    # Added to the state of the generator that chooses among the crossings of a segment.
    BISECT_PRIMARY = 0
    BISECT_SECONDARY = 1
    BISECT_VOLUMETRIC = 2
    # Mixed into the seed of an image.
    SECOND_IMAGE = 0x2B5AD2C7  # of one view, independent of the first

    def of(self, seed: mi.UInt32) -> mi.UInt32:
        """The seed, or the key, that this stream has in place of one that others share."""
        return seed ^ int(self)
