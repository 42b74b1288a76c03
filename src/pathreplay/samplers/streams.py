"""Streams: named, disjoint sequences of the counter-based samplers, one per purpose.

A stream is separated from the others in one of three ways. Its value is the first index that it uses in a key
(`CounterSampler.stream`), it is combined with a seed or key by exclusive or, or it is added to the state of a
generator. Index 0 of a key belongs to the path itself, with six samples per vertex (see `CounterSampler.at_vertex`).
"""

from __future__ import annotations

from enum import IntEnum

import mitsuba as mi


class Stream(IntEnum):
    """The purposes of random streams."""

    # Combined with the seed of a pass.
    BOUNDARY = 0x5EED  # the boundary term, beside the interior
    FIRST_LOOK = 0x7F4A7C15  # segments whose results determine where later segments are sampled
    CAST_SHADOWS = 0x2C1B3C6D
    PRIMARY_KEYS = 0x51ED270B
    SECONDARY_KEYS = 0x2545F491
    VOLUMETRIC_KEYS = 0x3C6EF372
    VOLUMETRIC_CENTRES = 0x1F83D9AB
    # Combined with the key of a path.
    EMITTER_SEGMENTS = 0x1B873593
    ARCS = 0x38B34AE5
    # First index in a key.
    ARC = 0x100
    BEYOND_EDGE = 0x20000  # radiance arriving from beyond an edge
    BEAM = 0x30000
    BEAM_EMITTER = 0x30010
    CAMERA = 0x40000
    TRANSMITTANCE_OF_CHAIN = 0x50000
    TRANSMITTANCE_PAST_EDGE = 0x60000
    TRANSMITTANCE_TO_EDGE = 0x70000
    TRANSMITTANCE_OF_BEAM = 0x80000
    # Added to the state of the generator that chooses among the edges crossed by a segment.
    BISECT_PRIMARY = 0
    BISECT_SECONDARY = 1
    BISECT_VOLUMETRIC = 2
    # Combined with the seed of an image.
    SECOND_IMAGE = 0x2B5AD2C7  # a second, independent image of one view

    def of(self, seed: mi.UInt32) -> mi.UInt32:
        """The seed or key of this stream, derived from a shared one."""
        return seed ^ int(self)
