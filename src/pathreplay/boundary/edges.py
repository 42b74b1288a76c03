"""Edges: what their motion adds to a gradient, carried from where they were found back to parameters and camera.

Two searches find edges along camera paths: `primary` finds those that a path slides over, `secondary` those that a
scattering vertex sees. Both give the motion of the edge at their vertex as a function of the ray that arrives there.
The rest is the same for both: reverse mode takes the adjoint of that ray back along the records of the path, forward
mode brings its tangent from the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass
class Edges:
    """An edge for each lane, at the end of a path of ``k`` vertices and the ray from the last."""

    s: mi.Point2f  # where the path begins
    key: mi.UInt32
    k: mi.UInt32  # zero where nothing was found
    ray: mi.Ray3f
    layout: Layout
    records: Any  # of the path, and one more: of the vertex that sees the edge
    motion: Callable[[mi.Ray3f], mi.Spectrum]  # zero where nothing was found


def edges_backward(
    trace: TraceConfig, places: FilmDomain, found: Edges, W: mi.Spectrum, lost: NonFiniteCounter
) -> None:
    """Back-propagate W·motion into the parameters; ``W`` is the adjoint of radiance that arrives at the places."""
    q = backward_ray(found.ray, lambda ray: dr.sum(W * found.motion(ray)))
    q = ray_to_camera(trace, places, found, q, lost)
    with dr.resume_grad():
        ray, _ = places.ray(found.s, found.key)
        if dr.grad_enabled(ray.o, ray.d):
            # Every parameter of the camera sums over these apart, which would search as often.
            dr.eval(q, found.s, found.key)
            backward(dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d))


@dr.syntax
def edges_forward(trace: TraceConfig, places: FilmDomain, found: Edges) -> mi.Spectrum:
    """The tangent of the motion, which is that of the radiance at the places. Parameters carry their tangents."""
    with dr.resume_grad():
        ray = places.ray(found.s, found.key)[0]
        δo, δd = tangents(ray.o, ray.d)
    δ = RayDerivative(mi.Point3f(δo), mi.Vector3f(δd), mi.Float(0))
    layout, records, k, ray0 = found.layout, found.records, found.k, dr.detach(ray)
    i = mi.UInt32(0)
    while dr.hint(i < k, exclude=[trace, layout, ray0], label="pathreplay: towards an edge"):
        v = read_back(layout, records, i, k, ray0)
        δ = forward_step(trace, v, True, δ, mi.Bool(True))[3].finite_part()[0]
        i += 1
    return forward_ray(found.ray, δ, found.motion)


def ray_to_camera(
    trace: TraceConfig,
    places: FilmDomain,
    found: Edges,
    q: RayDerivative,
    lost: NonFiniteCounter,
    rays_only: bool = False,
) -> RayDerivative:
    """The adjoint of the camera ray, from that of the ray that sees the edge; ``rays_only``: reaching no parameter."""
    k, none = found.k, mi.Spectrum(0)
    ray0 = dr.detach(places.ray(found.s, found.key)[0])
    path = RecordedPath(found.layout, found.records, mi.UInt32(0), mi.UInt32(k), mi.UInt32(k), ray0)
    return walk_back(trace, path, PathAdjoint(none, none, q), lost, rays_only=rays_only).q
