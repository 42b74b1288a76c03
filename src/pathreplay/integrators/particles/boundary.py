"""The boundary term of light paths: derivative of an image due to moving edges (see `boundary.searches.emission`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter
from pathreplay.adjoint.baseline import Baseline
from pathreplay.boundary.edges import Edges, edges_backward, edges_forward
from pathreplay.boundary.searches.emission import EmissionBeamSearch, EmissionSearch
from pathreplay.boundary.searches.primary import FilmCrossing
from pathreplay.boundary.searches.volumetric import BeamCrossing
from pathreplay.integrators.boundary_term import Boundary, segments_of
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.integrators.particles.domain import CELLS, EmissionDomain, has_jumps
from pathreplay.integrators.particles.term import ParticleTerm
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.term import Term, TermResult
from pathreplay.particles.film import colour
from pathreplay.particles.paths import Particles, splat_path, with_adjoint
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.motion import edges_move
from pathreplay.transport.path import PathState
from pathreplay.transport.vertex import TraceConfig

CLOSER = 10
"""Number of segments per bisected segment."""
LENGTH = 0.5  # length of segments, in cells of `EmissionDomain`


@dataclass(frozen=True)
class ParticleBoundary(Term):
    """The boundary term of light paths.

    It contains the edges between an emitter and the first vertex with a smooth lobe, directly or through chains of
    delta lobes, and the edges between this vertex and the sensor. In media, it also contains the edges between the
    points of the first ray and the sensor. All other visibility is not differentiated, and neither is the light of
    emitters with `has_jumps`.
    """

    particles: ParticleTerm
    spp: int = 0  # segments per pixel; 0 means the samples per pixel of the pass

    def move(self, view: Pass, trace: TraceConfig) -> bool:
        """Return whether edges depend on parameters with gradients. Nothing is evaluated."""
        work = self.particles.work(view, trace)
        if work is None:
            return False
        link, particles, _ = work
        assert link.to_sensor is not None
        start = particles.start(link, dr.arange(mi.UInt32, 1))
        return link.to_sensor.moves() or edges_move(link, start, PathState.begin(link, start).at)

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        work, lost = self.particles.work(view, trace), NonFiniteCounter()
        assert work is not None
        link, particles, film = work
        paths = 0
        sums = dr.zeros(mi.Float, 4 * film.pixels)
        for search, edges in self._searches(view, link, particles):
            (crossing,), key = edges.crossings, edges.path.key
            δ = edges_forward(search.along, search.film, edges, lost)
            paths += dr.width(edges.path.s)
            if isinstance(search, EmissionSearch):
                assert isinstance(crossing, FilmCrossing)
                sides, shadow = crossing.sides, crossing.sides.shadow
                assert shadow is not None
                for path, weight in zip(sides.paths(), (δ, -δ), strict=True):
                    splat_path(search.onward, CounterSampler.at_vertex(key, sides.k), path, weight, film, sums)
                δ *= sides.shadow_jump(search.onward, key)
            else:
                assert isinstance(crossing, BeamCrossing)
                shadow = crossing.shadow
            at = film.footprint(shadow.lit.uv)
            film.add(sums, at, at.x, at.y, colour(δ, edges.path.ray.wavelengths), shadow.exists)
        image = film.develop(sums * (film.scale(1) / CELLS**2))
        dr.eval(image)
        return TermResult(image, lost=lost.count, paths=paths, moves=True)

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        work, lost = self.particles.work(view, trace), NonFiniteCounter()
        assert work is not None
        link, particles, film = work
        link = with_adjoint(link, film, film.adjoint(grad_in) * (film.scale(1) / CELLS**2))
        paths = 0
        for search, edges in self._searches(view, link, particles):
            edges_backward(search.along, search.film, edges, mi.Spectrum(1), lost)
            paths += dr.width(edges.path.s)
        dr.eval()
        return TermResult(lost=lost.count, paths=paths, moves=True)

    def notes(self, trace: TraceConfig) -> Iterator[str]:
        """Yield what the term leaves out in a scene."""
        if trace.media is not None and self.particles.max_depth > 2:
            yield "edges that light meets after its first rough surface or collision"
            yield "edges between the sensor and points of a medium behind a mirror or glass"
        elif self.particles.max_depth > 2 + self.particles.caustics:
            yield "edges that light meets after its first rough surface"
        yield from (
            f"edges in the light of emitter '{each.id()}'" for each in trace.scene.emitters() if has_jumps(each)
        )

    def _searches(
        self, view: Pass, trace: TraceConfig, particles: Particles
    ) -> Iterator[tuple[EmissionSearch | EmissionBeamSearch, Edges]]:
        """Run the edge searches that the scene requires, and yield the edges of each part, with their search."""
        tables = facts_of(view.scene).recorded_tables(trace.traits.tables, edges=True)
        trace = Boundary.informed(replace(view, flow=None), replace(trace, traits=replace(trace.traits, tables=tables)))
        if any(shape.is_emitter() for shape in trace.traits.moving or ()):  # every edge moves relative to such light
            trace = replace(trace, traits=replace(trace.traits, moving=None))
        domain, n = EmissionDomain(trace, particles.emission), segments_of(view, FilmPlaces.of(view), self.spp)
        kinds: list[type[EmissionSearch | EmissionBeamSearch]] = [EmissionSearch]
        if trace.media is not None and not self.particles.caustics:
            kinds.append(EmissionBeamSearch)
        for kind in kinds:
            search = kind.of(trace, domain, LENGTH)
            for edges in search.find(n, CLOSER, Stream.PARTICLE_EDGES.of(view.opaque_seed)):
                yield search, edges
