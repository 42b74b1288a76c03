"""Film flow: the motion of a camera, expressed as motion of film positions. The latter needs no boundary term.

When a camera rotates, the same radiance arrives at other film positions. Let π be the parameters, s a film
position, c(s, π) its camera ray, and T(s, π) the image of s under a chosen flow, with T(s, π₀) = s and the velocity
v = ∂T/∂π. An integral over the film D with weights W does not depend on the parametrisation of the positions:

    ∫ W(s) L(c(s, π)) ds = ∫ W(T) L(c(T, π)) |∂T/∂s| ds.

The derivative of the integral with respect to π therefore has two parts. The first part is the derivative of the
weights, where n is the normal of the border of D (see `FilmMotion`):

    ∫_D div(W v) L ds - ∮_∂D W L v·n dl.

The second part is the derivative of L that the motion of the ray c(T, π) causes. The derivative of this ray is
∂c/∂π + ∂c/∂s v, the *rest* of the motion. The sum of both parts is correct for any smooth v.

`CameraFlow` chooses v such that each ray keeps passing through the point p = o + r d: v = -(∂p/∂s)⁺ ∂p/∂π. The distance
r is a mean over surfaces that are visible nearby. The rest is then zero for a rotation and for a change of the field of
view. For a translation, the rest is the parallax. For a static camera, `SurfaceFlow` chooses v such that film positions
follow the visible surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.film.grid import NODES, Cell, NodeSums, interpolated
from pathreplay.integrators.film.lights import SeenLights
from pathreplay.integrators.film.sample import (
    CAMERAS,
    ORTHOGRAPHIC,
    PINHOLE,
    STEP,
    RayDerivatives,
    Sample,
    film_velocity,
    move_with_position,
    probes_of,
    ray_derivatives,
)
from pathreplay.transport.facts.nodes import with_gradients
from pathreplay.transport.vertex import TraceConfig

ONLY_POSITIONS = "x_fov", "principal_point_offset_x", "principal_point_offset_y"
"""Camera parameters that only move rays to other film positions. The film flow contains all motion of such rays."""
OTHERS = "to_world", "focus_distance", "aperture_radius"
K_0 = 1e3
"""Weight of the mean closeness of all visible surfaces, at each node."""


class FilmFlow(Protocol):
    """A velocity field of positions on the film."""

    @property
    def is_all(self) -> bool:
        """Whether the term `FilmMotion` of this flow is the whole derivative of the image."""

    @property
    def samples(self) -> int:
        """Number of samples per pixel that one group of paths in `FilmMotion` replaces."""

    def ray(self, sample: Sample) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Return the sensor's ray and its weight.

        If the sample's position has gradients, the ray is differentiable in this position. Otherwise the derivative of
        the ray is ∂c/∂π + ∂c/∂s v, the motion that the flow does not contain (see the module).
        """

    def velocity(self, sample: Sample) -> mi.Vector2f:
        """Return an AD variable of value zero, whose derivative with respect to the parameters is the velocity v."""

    def divergence(self, sample: Sample) -> mi.Float:
        """Return an AD variable of value zero, whose derivative is the divergence ∂v_x/∂x + ∂v_y/∂y."""

    def moves_at(self, position: mi.Point2f) -> mi.Bool:
        """Return whether the velocity at a film position may be non-zero."""

    def leaves_rest_at(self, position: mi.Point2f) -> mi.Bool:
        """Return whether the ray through a film position may have motion that the flow does not contain."""

    def carry_tangents(self) -> None:
        """Propagate tangents from the parameters to the arrays of the flow, once for all terms of a pass."""


@dataclass(frozen=True)
class CameraFlow:
    """The flow of a moving sensor: see `FilmFlow`."""

    sensor: mi.Sensor
    closeness: mi.Float  # at the nodes of a grid (see `grid`), the reciprocal of the distance r (see the module)
    mean_closeness: mi.Float  # the mean over the nodes, which is positive
    leaves_rest: bool  # whether rays have motion that the flow does not contain
    is_all: bool
    samples: int = 2

    @staticmethod
    def of(trace: TraceConfig, sensor: mi.Sensor) -> CameraFlow | None:
        """Create the flow of a sensor. None if the sensor has no gradients or its class is not one of `CAMERAS`."""
        if sensor.class_name() not in CAMERAS or not with_gradients(sensor, *ONLY_POSITIONS, *OTHERS):
            return None
        rest = _is_carried(sensor) or bool(with_gradients(sensor, *OTHERS[1:]))
        others = any(with_gradients(node) for node in (*trace.scene.shapes(), *trace.scene.emitters()))
        alone = not (rest or others or with_gradients(sensor, "medium"))
        if not rest:  # the flow does not depend on the distance
            return CameraFlow(sensor, dr.full(mi.Float, 1, NODES * NODES), mi.Float(1), rest, alone)
        closeness = _closeness(trace, sensor)
        mean = dr.mean(closeness)
        mean = dr.select(mean > 0, mean, 1)
        dr.eval(mean)
        return CameraFlow(sensor, closeness, mean, rest, alone)

    def ray(self, sample: Sample) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        ray, weight = sample.ray(self.sensor)
        if dr.grad_enabled(sample.position) or not dr.grad_enabled(ray.o, ray.d):
            return ray, weight
        if not self.leaves_rest:
            return dr.detach(ray), weight
        derivatives = ray_derivatives(self.sensor, sample)
        move_with_position(ray, derivatives, self._velocity(ray, derivatives, self._closeness_at(sample.position)))
        return ray, weight

    def velocity(self, sample: Sample) -> mi.Vector2f:
        return self._velocity_of(sample, self._closeness_at(sample.position))

    def divergence(self, sample: Sample) -> mi.Float:
        """Compute the divergence by central differences.

        It is the sum of the divergence at constant closeness, and of the derivative of the velocity with respect to the
        closeness times the gradient of the closeness.
        """
        cell, total = Cell.at(sample.position), mi.Float(0)
        corners = cell.corners(self.closeness)
        closeness = interpolated(corners, cell.f)
        for axis, step in enumerate((mi.Vector2f(STEP, 0), mi.Vector2f(0, STEP))):
            samples = (sample.at(sample.position + side * step) for side in (-1, 1))
            before, after = (self._velocity_of(other, closeness)[axis] for other in samples)
            total += (after - before) / (2 * STEP)
        ray, derivatives = sample.ray(self.sensor)[0], ray_derivatives(self.sensor, sample)
        h = STEP * dr.maximum(closeness, self.mean_closeness)
        less, more = (self._velocity(ray, derivatives, closeness + side * h) for side in (-1, 1))
        return total + dr.dot(more - less, mi.Vector2f(*cell.slopes(corners))) / (2 * h)

    def moves_at(self, position: mi.Point2f) -> mi.Bool:
        """Return True: the velocity may be non-zero everywhere."""
        return mi.Bool(True)

    def leaves_rest_at(self, position: mi.Point2f) -> mi.Bool:
        """Return `leaves_rest`, which applies to all film positions."""
        return mi.Bool(self.leaves_rest)

    def carry_tangents(self) -> None:
        """Do nothing: the terms differentiate the sensor itself, so this flow has no arrays with tangents."""

    def _closeness_at(self, position: mi.Point2f) -> mi.Float:
        cell = Cell.at(position)
        return interpolated(cell.corners(self.closeness), cell.f)

    def _velocity_of(self, sample: Sample, closeness: mi.Float) -> mi.Vector2f:
        return self._velocity(sample.ray(self.sensor)[0], ray_derivatives(self.sensor, sample), closeness)

    def _velocity(self, ray: mi.Ray3f, derivatives: RayDerivatives, closeness: mi.Float) -> mi.Vector2f:
        """Compute the `velocity` at which an attached ray keeps passing through the point of a given closeness.

        ``derivatives`` are those of the ray along the film's axes.
        """
        motion = closeness * (ray.o - dr.detach(ray.o)) + (ray.d - dr.detach(ray.d))
        return -film_velocity(motion, derivatives, closeness)


def _is_carried(sensor: mi.Sensor) -> bool:
    """Return whether gradients of the camera's pose may leave motion of rays that the film flow does not contain.

    The film flow contains the whole motion of rays if a pinhole camera rotates, but does not contain parallax. The
    result is therefore True for a pinhole camera whose translation has gradients, and for any other camera whose pose
    has gradients.
    """
    poses = with_gradients(sensor, "to_world")
    if sensor.class_name() != PINHOLE:
        return bool(poses)
    with dr.resume_grad():
        return any(dr.grad_enabled(pose.matrix[row, 3]) for pose in poses for row in range(3))


def _closeness(trace: TraceConfig, sensor: mi.Sensor) -> mi.Float:
    """Return the mean of the reciprocal distances of the surfaces that are visible near each node (see `grid`).

    Parallax is proportional to reciprocal distances. Rays that miss all surfaces do not count: edges move with the
    surfaces in front of a background, and a background has no edges of its own. Bright parts of the sky have no
    parallax (see `lights`): their closeness is zero.
    """
    seen = SeenLights.of(trace, sensor)
    with dr.suspend_grad():
        ray, _ = probes_of(sensor).ray(sensor)
        hit = trace.scene.ray_intersect_preliminary(ray, coherent=True)
        visible = hit.is_valid()
        closeness = dr.select(visible, dr.rcp(hit.t), 0)
        mean = dr.sum(closeness) / dr.maximum(dr.count(visible), 1)
        dr.eval(closeness, visible, mean)
        sums = NodeSums.of(dr.select(visible, mi.Float(1), 0))
        nodes = (K_0 * mean + sums.of_values(closeness)) / (K_0 + sums.total())
        if sensor.class_name() == ORTHOGRAPHIC:  # any closeness but zero gives the same flow
            nodes = dr.select(nodes > 0, nodes, 1)
        else:
            nodes *= seen.share_kept(seen.sky)
        dr.eval(nodes)
        return nodes
