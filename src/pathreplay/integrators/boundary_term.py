"""The boundary term: derivative of an image due to moving edges."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter
from pathreplay.adjoint.baseline import Baseline
from pathreplay.boundary.edges import Edges, edges_backward, edges_forward
from pathreplay.boundary.searches.primary import PrimarySearch
from pathreplay.boundary.searches.secondary import SecondarySearch
from pathreplay.boundary.searches.secondary_chains import SecondaryChainSearch
from pathreplay.boundary.searches.volumetric import ScatteredBeamSearch, VolumetricSearch
from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.integrators.film.image import MOST_SAMPLES
from pathreplay.integrators.term import Term, TermResult
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.facts.nodes import with_gradients
from pathreplay.transport.motion import edges_move, moving_shapes
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig

FILM_CLOSER, INNER_CLOSER, NARROW_CLOSER = 5, 16, 4
"""Number of segments on the film, and of paths in secondary searches, per bisected segment. If vertices have several
arcs, `NARROW_CLOSER` replaces `INNER_CLOSER`."""
GRID = "SDFGrid"
"""Class of shapes whose silhouettes cannot be sampled. Rays miss them near the outline, and points on them cannot be
kept at fixed surface coordinates."""
DETACHED = {"Ellipsoids": "put 'ellipsoidsmesh' in its place", "LinearCurve": "put 'bsplinecurve' in its place"}
"""Classes of shapes that Mitsuba 3.9 does not attach to their parameters, with the remedy."""
BATCH = "BatchSensor"
"""Class of sensors whose rays cannot be differentiated with respect to film position: Dr.Jit terminates the process."""
FILM_LENGTH = 0.5  # length of segments on the film, in pixels; shorter for some sensors: see `FilmPlaces.detail`
INNER_LENGTHS = 0.25, 0.1  # length of segments in the unit square of emitter samples; length of arcs in radians
CHAIN_LENGTH = 0.05  # length of arcs in radians, if they lead through delta lobes: curved glass shows small images


@dataclass(frozen=True)
class Boundary(Term):
    """The boundary term, for edges visible from the camera, from surfaces or from points in media.

    Camera and surfaces may see an edge directly, in mirrors or through glass. Edges in textures and masks are not
    differentiated, and neither is the alpha channel.
    """

    film: bool = True  # edges visible from the camera
    inner: bool = True  # edges visible from surfaces and points in media
    spp: int = 0  # segments per pixel of each search; 0 means the samples per pixel of the pass

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        if not self.move(view, trace):
            return TermResult()
        places = FilmPlaces.of(view)
        image, lost, paths = None, NonFiniteCounter(), 0
        for edges in self._searches(view, trace, places):
            δL = edges_forward(trace, places, edges, lost)
            part = places.image(edges.path.s, δL, edges.path.ray.wavelengths)
            image = part if image is None else image + part
            paths += dr.width(edges.path.s)
        dr.eval(image)
        return TermResult(image, lost=lost.count, paths=paths, moves=True)

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        if not self.move(view, trace):
            return TermResult()
        places = FilmPlaces.of(view)
        block_grad = places.undeveloped(grad_in)

        lost, paths = NonFiniteCounter(), 0
        for edges in self._searches(view, trace, places):
            W = places.importance(block_grad, edges.path.s, edges.path.ray.wavelengths)
            edges_backward(trace, places, edges, W, lost)
            paths += dr.width(edges.path.s)
        dr.eval()
        return TermResult(lost=lost.count, paths=paths, moves=True)

    @staticmethod
    def move(view: Pass, trace: TraceConfig) -> bool:
        """Return whether edges depend on parameters with gradients. Dr.Jit traces the test, but evaluates nothing."""
        key = mi.UInt32(0)
        with dr.resume_grad():
            ray, _ = FilmPlaces.of(view).ray(mi.Point2f(0.5), key)
        start = CameraStart(ray, CounterSampler.of(key), mi.Bool(True))
        return edges_move(trace, start, PathState.begin(trace, start).at)

    @staticmethod
    def informed(view: Pass, trace: TraceConfig) -> TraceConfig:
        """Return ``trace`` with the moving shapes added.

        In a scene with media, ``trace`` is returned unchanged. All shapes then count as moving, because paths cross
        null boundaries that may move.
        """
        if trace.media is not None or trace.traits.moving is not None:
            return trace
        meter = view.sensor.get_shape()
        if meter is not None and with_gradients(meter):
            return trace  # rays start on a moving shape: all surfaces move relative to these rays
        # With a film flow, the sensor of the pass counts as static, too: `FilmDomain.flows` marks the rays that move.
        static = [sensor for sensor in view.scene.sensors() if sensor != view.sensor or view.flow is not None]
        moving, turning = moving_shapes(trace.scene, static)
        return replace(trace, traits=replace(trace.traits, moving=moving, turning=turning))

    @staticmethod
    def obstacle(view: Pass) -> str:
        """Return why boundary terms cannot be computed, with the remedy; "" if they can."""
        if view.sensor.class_name() == BATCH:
            return (
                f"edges of sensor '{view.sensor.id()}' of type 'batch' cannot be differentiated: "
                "put its sensors into the scene one by one"
            )
        for shape in view.scene.shapes():
            if shape.class_name() == GRID:
                return (
                    f"edges of shape '{shape.id()}' of type 'sdfgrid' cannot be differentiated: put a mesh in its place"
                )
            if (remedy := DETACHED.get(shape.class_name(), "")) and with_gradients(shape, "data", "control_points"):
                return (
                    f"edges of shape '{shape.id()}' of class {shape.class_name()} do not follow its parameters, and "
                    f"neither do its points: {remedy}"
                )
        return ""

    @staticmethod
    def require(view: Pass, spp: int) -> None:
        """Raise PathreplayError if the edges of a pass cannot be searched with ``spp`` segments per pixel."""
        if why := Boundary.obstacle(view):
            raise PathreplayError(f"{why}, or use boundary = 'none'")
        segments_of(view, FilmPlaces.of(view), spp)

    def _searches(self, view: Pass, trace: TraceConfig, places: FilmPlaces) -> Iterator[Edges]:
        """Run the edge searches that the scene and the options require, and yield the edges of each of their parts."""
        trace = self.informed(view, trace)
        n, seed = segments_of(view, places, self.spp), Stream.BOUNDARY.of(view.opaque_seed)
        length = FILM_LENGTH * places.detail
        if self.film and places.is_extended:
            yield from PrimarySearch.of(trace, places, length).find(n, FILM_CLOSER, seed)
            if trace.media is not None and trace.traits.hard_lights:
                yield from VolumetricSearch.of(trace, places, length).find(n, FILM_CLOSER, seed)
        if self.inner and trace.max_depth > 1:
            search = SecondarySearch.of(trace, places, INNER_LENGTHS)
            yield from search.find(n, NARROW_CLOSER if search.most_arcs > 1 else INNER_CLOSER, seed)
            if SecondaryChainSearch.applies_to(trace):
                yield from SecondaryChainSearch.of(trace, places, CHAIN_LENGTH).find(n, INNER_CLOSER, seed)
            if trace.media is not None and trace.traits.hard_lights and trace.max_depth > 2:
                yield from ScatteredBeamSearch.of(trace, places, INNER_LENGTHS[1]).find(n, INNER_CLOSER, seed)


def segments_of(view: Pass, places: FilmPlaces, spp: int) -> int:
    """Return the number of boundary segments of a pass: ``spp`` per pixel.

    If ``spp`` is 0, there are as many segments per pixel as samples per pixel.
    """
    pixels = int(places.size.x) * int(places.size.y)
    n = pixels * (math.ceil(spp * view.share) if spp else view.spp)
    if n > MOST_SAMPLES:
        raise PathreplayError(
            f"boundary_spp = {spp} with a film of {pixels} pixels are {n} segments, more than the {MOST_SAMPLES} that "
            f"Dr.Jit can process at once; take boundary_spp up to {MOST_SAMPLES // pixels}, or 0"
        )
    return max(n, 1)
