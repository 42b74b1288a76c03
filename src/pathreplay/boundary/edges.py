"""Edges: what their motion adds to a gradient, carried from where they were found back to parameters and camera.

An edge is where B(ray, π) = 0, and moves by dB/dπ; what it adds to the radiance at the place s of the film is

    - Σ K dB/dπ,

over its crossings: `primary` and `volumetric` find one of each edge, `secondary` up to three. Reverse mode takes the
adjoint of the ray that sees the edge back along the records of the path, forward mode brings its tangent from the
camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any, Protocol

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
from pathreplay.adjoint.two_passes import PathAdjoint, RecordedPath, walk_back
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.transport.vertex import TraceConfig


class FilmDomain(Protocol):
    """Where on a film paths may begin: places (Point2f, in pixels) from its corner to ``size``."""

    @property
    def size(self) -> mi.ScalarVector2f: ...

    def ray(self, s: mi.Point2f, key: mi.UInt32) -> tuple[mi.Ray3f, mi.Spectrum]:
        """The camera ray through a place and its weight; attached to the camera and ``s``, if those have gradients.

        What else is random about it (time, wavelengths, aperture) comes from the ``key``.
        """

    def flows(self, s: mi.Point2f) -> mi.Bool:
        """Whether what stands still may slide under a place."""

    def of_point(self, p: mi.Point3f) -> tuple[mi.Point2f, mi.Bool]:
        """The place where a point of space would be seen, and whether there is one that the sensor knows."""


class Crossing(Protocol):
    """A crossing of an edge."""

    weight: mi.Spectrum  # K, zero where nothing was found

    def gap(self, at: Any) -> mi.Float:
        """B: zero on the edge. Differentiable in the shapes and in ``at``, that which sees it.

        It is the ray that slides over the edge or, if there is one, the observer (`ObserverVertex.moved`).
        """


@dataclass
class EdgePath:
    """The path from the camera that sees an edge: ``k`` vertices, and the ray from the last."""

    s: mi.Point2f  # where it begins
    key: mi.UInt32  # of its random numbers
    k: mi.UInt32  # zero where nothing was found
    ray: mi.Ray3f
    layout: Layout
    records: Any  # of its vertices, and one more: of that which sees the edge


@dataclass
class Edges:
    """An edge for each lane."""

    path: EdgePath
    crossings: Sequence[Crossing]
    observer: ObserverVertex | None  # the vertex that sees it; None: the path slides over it

    def motion(self, ray: mi.Ray3f) -> mi.Spectrum:
        """- Σ K B, with the ``ray`` that arrives: differentiable in it, and in what moves."""
        at = ray if self.observer is None else self.observer.moved(ray)
        return -reduce(add, [crossing.weight * crossing.gap(at) for crossing in self.crossings])


def edges_backward(trace: TraceConfig, film: FilmDomain, edges: Edges, W: mi.Spectrum, lost: NonFiniteCounter) -> None:
    """Back-propagate W·motion into the parameters; ``W`` is the adjoint of radiance that arrives at the places."""
    path = edges.path
    q = backward_ray(path.ray, lambda ray: dr.sum(W * edges.motion(ray)))
    q = ray_to_camera(trace, film, path, q, lost)
    with dr.resume_grad():
        ray, _ = film.ray(path.s, path.key)
        if dr.grad_enabled(ray.o, ray.d):
            # Every parameter of the camera sums over these apart, which would search as often.
            dr.eval(q, path.s, path.key)
            backward(dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d))


@dr.syntax
def edges_forward(trace: TraceConfig, film: FilmDomain, edges: Edges) -> mi.Spectrum:
    """The tangent of the motion, which is that of the radiance at the places. Parameters carry their tangents."""
    path = edges.path
    with dr.resume_grad():
        ray = film.ray(path.s, path.key)[0]
        δo, δd = tangents(ray.o, ray.d)
    δ = RayDerivative(mi.Point3f(δo), mi.Vector3f(δd), mi.Float(0))
    layout, records, k, ray0 = path.layout, path.records, path.k, dr.detach(ray)
    i = mi.UInt32(0)
    while dr.hint(i < k, exclude=[trace, layout, ray0], label="pathreplay: towards an edge"):
        v = read_back(layout, records, i, k, ray0)
        δ = forward_step(trace, v, True, δ, mi.Bool(True))[3].finite_part()[0]
        i += 1
    return forward_ray(path.ray, δ, edges.motion)


def ray_to_camera(
    trace: TraceConfig,
    film: FilmDomain,
    path: EdgePath,
    q: RayDerivative,
    lost: NonFiniteCounter,
    rays_only: bool = False,
) -> RayDerivative:
    """The adjoint of the camera ray, from that of the ray that sees the edge; ``rays_only``: reaching no parameter."""
    k, none = path.k, mi.Spectrum(0)
    ray0 = dr.detach(film.ray(path.s, path.key)[0])
    recorded = RecordedPath(path.layout, path.records, mi.UInt32(0), mi.UInt32(k), mi.UInt32(k), ray0)
    return walk_back(trace, recorded, PathAdjoint(none, none, q), lost, rays_only=rays_only).q
