"""The boundary term: what edges do to an image when they move, as far as one asks for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..gradient.adjoint import LostPaths
from ..gradient.baseline import Baseline
from ..gradient.beam_edges import beam_edges
from ..gradient.counted import Counted
from ..gradient.edges import Edges, edges_backward, edges_forward
from ..gradient.film_edges import film_edges
from ..gradient.inner_edges import inner_edges
from ..transport.motion import path_moves
from ..transport.path import PathState
from ..transport.start import CameraStart
from ..transport.vertex import Walk
from .camera_pass import Pass
from .places import FilmPlaces
from .term import Found

LINES = 4
"""Lines that a lane looks at, of each kind: it keeps one with an edge."""
FILM_LENGTH = 0.5  # pixels
INNER_LENGTHS = 0.25, 0.1  # in the square of emitter samples; radians


@dataclass(frozen=True)
class Boundary:
    """A term: edges that the camera sees, directly or by mirrors and glass, and those that surfaces and particles see.

    Not differentiated: hard shadows beyond the first vertex that scatters; edges of textures and of masks; alpha.
    """

    inner: bool  # also those that surfaces see
    spp: int  # lines per pixel, of each kind; 0: samples of the pass

    def forward(self, view: Pass, walk: Walk, learned: Baseline | None) -> Found:
        """Tangent of the image: see `Term`."""
        places = FilmPlaces.of(view)
        if not _moves(walk, places):
            return Found()
        image = None
        for edges in self._searches(view, walk, places, lambda s, ray: mi.Spectrum(1)):
            δL = edges_forward(walk, places, edges)
            part = places.image(edges.s, δL, edges.ray.wavelengths)
            image = part if image is None else image + part
        return Found(image)

    def backward(self, view: Pass, walk: Walk, grad_in: mi.TensorXf, learned: Baseline | None) -> Found:
        """Back-propagate the adjoint of the image: see `Term`."""
        places = FilmPlaces.of(view)
        if not _moves(walk, places):
            return Found()
        wanted = places.undeveloped(grad_in)

        def importance(s: mi.Point2f, ray: mi.Ray3f) -> mi.Spectrum:
            return places.importance(wanted, s, ray.wavelengths)

        lost, paths = LostPaths(), 0
        for edges in self._searches(view, walk, places, importance):
            edges_backward(walk, places, edges, importance(edges.s, edges.ray), lost)
            paths += dr.width(edges.s)
        dr.eval()
        return Found(lost=lost.count, paths=paths, moves=True)

    def _searches(
        self, view: Pass, walk: Walk, places: FilmPlaces, importance: Callable[..., mi.Spectrum]
    ) -> Iterator[Edges]:
        """The edges of each search."""
        size = int(places.size.x) * int(places.size.y)
        lane = dr.arange(mi.UInt32, max(size * (self.spp or view.spp) // LINES, 1))
        seed = dr.opaque(mi.UInt32, view.seed) if isinstance(view.seed, int) else mi.UInt32(view.seed)
        yield film_edges(walk, places, lane, seed ^ 0x5EED, LINES, FILM_LENGTH)
        if walk.media is not None and walk.traits.hard_lights:
            yield beam_edges(walk, places, lane, seed ^ 0x5EED, LINES, FILM_LENGTH)
        if self.inner:
            yield inner_edges(walk, places, lane, seed ^ 0x5EED, LINES, INNER_LENGTHS, importance)


def _moves(walk: Walk, places: FilmPlaces) -> bool:
    """Whether paths move with the parameters: if not, edges do not either."""
    key = mi.UInt32(0)
    with dr.resume_grad():
        ray, _ = places.ray(mi.Point2f(0.5), key)
    start = CameraStart(ray, Counted.of(key), mi.Bool(True))
    return path_moves(walk, start, PathState.begin(walk, start).at)
