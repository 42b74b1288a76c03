"""Edges: derivatives due to the motion of edges, propagated along the paths that see or meet the edges.

An edge is the zero set of a function B(ray, π) of a ray and the parameters π. Its motion follows from dB/dπ. The
contribution of the edge to the derivative of the radiance at film position s is

    - Σ K dB/dπ,

summed over the crossings of boundary segments with the edge. K is the weight of a crossing (`Crossing.weight`). A lane
has up to three crossings in `secondary`, and one in all other searches. The last ray of the path leads to the
edge. Reverse mode computes the adjoint of this ray, and propagates the adjoint along the records of the path to the
camera ray. Forward mode propagates the tangent of the camera ray to the last ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any, ClassVar, Protocol

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import (
    NonFiniteCounter,
    RayDerivative,
    backward,
    backward_ray,
    forward_ray,
    forward_step,
    tangents,
)
from pathreplay.adjoint.record import Layout, read_back
from pathreplay.adjoint.two_passes import PathAdjoint, RecordedPath, sweep_path
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.transport.vertex import TraceConfig


class FilmDomain(Protocol):
    """The part of the film on which paths start.

    Positions (Point2f, pixels) range from 0 at a corner to ``size``. On light paths, two random numbers of the first
    ray take the place of the film position.
    """

    reflects: ClassVar[bool]
    """Whether positions beyond the border are reflected at the border. Otherwise, segments also start in a margin."""

    @property
    def size(self) -> mi.ScalarVector2f: ...

    def ray(self, s: mi.Point2f, key: mi.UInt32) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Return the camera ray through a film position, and its weight (Spectrum).

        Ray and weight are attached to the camera and to ``s`` if these have gradients. ``key`` determines all other
        random properties of the ray (time, wavelengths, aperture).
        """

    def flows(self, s: mi.Point2f) -> mi.Bool:
        """Return whether the camera ray through a film position may move under the film flow.

        The film flow is a velocity field of film positions. If the ray moves, the edges of static surfaces move
        relative to the ray.
        """

    def medium(self, trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool) -> mi.MediumPtr:
        """Return the medium at the origin of a ray. Only called in scenes with media."""

    def of_point(self, p: mi.Point3f) -> tuple[mi.Point2f, mi.Bool]:
        """Project a point onto the film; return the film position, and whether the sensor can project and see it."""


class Crossing(Protocol):
    """A crossing of a boundary segment with an edge."""

    weight: mi.Spectrum  # K, zero without an edge

    def gap(self, at: Any) -> mi.Float:
        """Evaluate B, which is zero on the edge. B is differentiable in the shapes and in ``at``.

        ``at`` is the vertex that sees the edge (`ObserverVertex.moved`). For edges on the film, which have no observer,
        and for edges behind delta lobes, ``at`` is the last ray of the path.
        """


@dataclass
class EdgePath:
    """The path that sees or meets an edge: ``k`` vertices, and the ray from the last vertex to the edge."""

    s: mi.Point2f  # film position
    key: mi.UInt32  # seed of the path's random numbers
    k: mi.UInt32  # number of vertices; zero without an edge
    ray: mi.Ray3f
    layout: Layout
    records: Any  # records of the k vertices, and of the arrival at the observer or edge; None if all k are 0


@dataclass
class Edges:
    """One edge per lane."""

    path: EdgePath
    crossings: Sequence[Crossing]
    observer: ObserverVertex | None  # the vertex that sees the edge; None for edges on the film and behind chains

    def motion(self, ray: mi.Ray3f) -> mi.Spectrum:
        """Evaluate - Σ K B over all crossings (Spectrum), differentiable in the path's last ``ray`` and the shapes."""
        at = ray if self.observer is None else self.observer.moved(ray)
        return -reduce(add, [crossing.weight * crossing.gap(at) for crossing in self.crossings])


def edges_backward(trace: TraceConfig, film: FilmDomain, edges: Edges, W: mi.Spectrum, lost: NonFiniteCounter) -> None:
    """Back-propagate W·`Edges.motion` into the parameters; ``W`` is the adjoint of radiance at the film positions."""
    path = edges.path
    q, dropped = backward_ray(path.ray, lambda ray: dr.sum(W * edges.motion(ray)))
    lost.add(dropped)
    q = ray_to_camera(trace, film, path, q, lost)
    with dr.resume_grad():
        ray, _ = film.ray(path.s, path.key)
        if dr.grad_enabled(ray.o, ray.d):
            # The gradient of each camera parameter is a separate sum over q. Without this evaluation, each sum would
            # repeat the edge search.
            dr.eval(q, path.s, path.key)
            backward(dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d))


def edges_forward(trace: TraceConfig, film: FilmDomain, edges: Edges, lost: NonFiniteCounter) -> mi.Spectrum:
    """Return what the edges contribute to the tangent of the radiance at the film positions.

    The parameters must carry tangents. ``lost`` counts the paths on which the tangent of a ray was not finite and was
    dropped.
    """
    path = edges.path
    with dr.resume_grad():
        ray = film.ray(path.s, path.key)[0]
        δo, δd = tangents(ray.o, ray.d)
    δ = RayDerivative(mi.Point3f(δo), mi.Vector3f(δd), mi.Float(0))
    if path.records is not None:
        δ = _ray_to_edge(trace, path, dr.detach(ray), δ, lost)
    return forward_ray(path.ray, δ, edges.motion)


@dr.syntax
def _ray_to_edge(
    trace: TraceConfig, path: EdgePath, ray0: mi.Ray3f, δ: RayDerivative, lost: NonFiniteCounter
) -> RayDerivative:
    """Return the tangent of the path's last ray, given the tangent of the camera ray ``ray0``."""
    layout, records, k = path.layout, path.records, path.k
    i, broken = mi.UInt32(0), mi.Bool(False)
    while dr.hint(i < k, exclude=[trace, layout, ray0, lost], label="pathreplay: towards an edge"):
        v = read_back(layout, records, i, k, ray0)
        δ, finite = forward_step(trace, v, True, δ, mi.Bool(True))[3].finite_part()
        lost.add(~finite & ~broken)
        broken |= ~finite
        i += 1
    return δ


def ray_to_camera(
    trace: TraceConfig,
    film: FilmDomain,
    path: EdgePath,
    q: RayDerivative,
    lost: NonFiniteCounter,
    rays_only: bool = False,
) -> RayDerivative:
    """Return the adjoint of the camera ray, given the adjoint ``q`` of the path's last ray, which leads to the edge.

    With ``rays_only``, no parameter receives a gradient.
    """
    if path.records is None:
        return q
    k, none = path.k, mi.Spectrum(0)
    ray0 = dr.detach(film.ray(path.s, path.key)[0])
    recorded = RecordedPath(path.layout, path.records, mi.UInt32(0), mi.UInt32(k), mi.UInt32(k), ray0)
    return sweep_path(trace, recorded, PathAdjoint(none, none, q), lost, rays_only=rays_only).q
