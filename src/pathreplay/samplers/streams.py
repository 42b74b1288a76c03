"""Streams: named, disjoint sequences of the counter-based samplers, one per purpose.

Each stream has an integer value. The value is used in one of six ways, as the comments in `Stream` state:

- The stream has the seed ``seed ^ value``, or the key ``key ^ value`` (`Stream.of`).
- The seed or key of the stream is a hash of the value and a seed.
- The seed of the stream is a hash of the value plus an index, and a seed.
- The value is the first index of the stream in the sequence of a key (`CounterSampler.stream`). The lowest indices,
  from 0 on, belong to the path itself, with six indices per vertex (see `CounterSampler.at_vertex`).
- The value is added to the initial state of a generator.
- The value is the index of a set of Sobol samples (`Pass.sobol_sampler`).
"""

from __future__ import annotations

from enum import IntEnum

import mitsuba as mi


class Stream(IntEnum):
    """The streams of random numbers, by purpose. The comments state how the value of a stream is used."""

    # The seed of the stream is the seed of the pass ^ the value.
    BOUNDARY = 0x5EED  # the boundary term; the interior term uses the seed itself
    PILOT = 0x7F4A7C15  # pilot segments, whose results determine where later segments are sampled
    CAST_SHADOWS = 0x2C1B3C6D
    PARTICLE_EDGES = 0x4B1D5E77  # the boundary term of light paths
    PRIMARY_KEYS = 0x51ED270B
    SECONDARY_KEYS = 0x2545F491
    VOLUMETRIC_KEYS = 0x3C6EF372
    VOLUMETRIC_CENTRES = 0x1F83D9AB
    SCATTERED_KEYS = 0x5BE0CD19
    SCATTERED_CENTRES = 0x6A09E667
    CHAIN_KEYS = 0x510E527F
    CHAIN_CENTRES = 0x3243F6A9
    # The key of the stream is a hash of the value and the seed of the pass.
    PARTICLES = 0x68E31DA4
    # The seed of the stream is a hash of the value plus the index of a part, and the seed of the pass.
    PARTS = 0x6F4C21B0  # parts of a pass; `mi.render` hashes 1 and the seed of an image to the seed of its gradient
    # The key of the stream is the key of the path ^ the value.
    EMITTER_SEGMENTS = 0x1B873593
    ARCS = 0x38B34AE5  # with several arcs around a vertex: a hash of this key and the number of the arc
    CHAINS = 0x243F6A88  # chains of delta lobes that start at a vertex
    # The value is the first index of the stream in the sequence of a key.
    ARC = 0x100
    BEYOND_EDGE = 0x20000  # radiance that arrives from behind an edge
    BEAM = 0x30000
    BEAM_EMITTER = 0x30010
    CAMERA = 0x40000
    TRANSMITTANCE_OF_CHAIN = 0x50000
    TRANSMITTANCE_PAST_EDGE = 0x60000
    TRANSMITTANCE_TO_EDGE = 0x70000
    TRANSMITTANCE_OF_BEAM = 0x80000
    EMITTER = 0x90000  # first ray of a light path to an edge
    # The value is added to the initial state of the generator that selects one of the edges on a segment.
    BISECT_PRIMARY = 0
    BISECT_SECONDARY = 1
    BISECT_VOLUMETRIC = 2
    BISECT_SCATTERED = 3
    BISECT_CHAINS = 4
    # The value is the index of an independent set of Sobol samples of a pixel (`Pass.sobol_sampler`). The interior term
    # uses set 0. The function `pixel_sweep` uses the first `pixel_samples.SETS` sets.
    FLOW = 0x10  # paths for the gradient term `FilmMotion` (`integrators.film.motion`)
    FLOW_MEAN = 0x11  # paths that estimate a typical radiance, which `FilmMotion` subtracts
    # The seed of the stream is a hash of the value and the seed of the image.
    SECOND_IMAGE = 0x2B5AD2C7  # a second, independent image of one view
    SECOND_HALF = 0x5E1C93A7  # the second half of the samples of one view

    def of(self, seed: mi.UInt32) -> mi.UInt32:
        """Derive the seed or key of this stream from a shared seed or key."""
        return seed ^ int(self)
