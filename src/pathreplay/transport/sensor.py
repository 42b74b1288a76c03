"""Connections of light paths to a sensor: direction, film position and importance, as seen from a vertex.

The importance W of a connection is defined so that the image of a scene is the integral of f W over light paths and
points of the aperture, with f the radiance throughput of the path. W is the area element on the film, whose total area
is 1, divided by the corresponding area element at the vertex, perpendicular to the connection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError

PROJECTIVE = ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera")
METER = "IrradianceMeter"


@dataclass
class Sighting:
    """A connection from a point to the sensor."""

    d: mi.Vector3f  # unit direction to the sensor
    end: mi.Point3f  # point up to which occlusion is tested: on the near plane of a camera, or on the irradiance meter
    s: mi.Point2f  # film position in pixels, relative to the crop window
    W: mi.Float  # importance divided by the density of the aperture sample
    valid: mi.Bool  # without occluders, the sensor sees the point; ``s`` may be up to ``reach`` pixels off the film


@dataclass(frozen=True)
class SensorLink:
    """The sensor to which the vertices of light paths are connected. Constant in a recorded kernel.

    Film positions up to ``reach`` pixels outside of the film are valid, because the reconstruction filter spreads them
    onto the film.
    """

    sensor: mi.Sensor
    reach: float
    adjoint: Callable[[mi.Point2f, mi.Spectrum, mi.Bool], mi.Spectrum] | None = None
    """Maps (film position, wavelengths, active) to the adjoint of the radiance there. None if there is no adjoint."""
    caustics: bool = False
    """Whether only caustics are estimated: paths whose first vertex scatters with a delta lobe. The sensor is then
    connected to later vertices only."""

    @staticmethod
    def of(sensor: mi.Sensor) -> SensorLink:
        """Create the link to a sensor. Raises PathreplayError if its class or film is not supported."""
        if sensor.class_name() not in (*PROJECTIVE, METER):
            raise PathreplayError(
                f"light paths cannot be connected to sensor '{sensor.id()}' of class {sensor.class_name()}: take "
                "perspective, thinlens, orthographic or irradiancemeter, or trace all paths from the sensor"
            )
        size = [int(n) for n in sensor.film().crop_size()]
        if sensor.class_name() == METER and size != [1, 1]:
            raise PathreplayError(
                f"the irradiance meter '{sensor.id()}' has a film of {size[0]} x {size[1]} pixels, which all have the "
                "same value: give it a film of one pixel"
            )
        return SensorLink(sensor, float(sensor.film().rfilter().radius()))

    def size(self) -> mi.ScalarVector2f:
        """Return width and height of the film's crop window in pixels."""
        return mi.ScalarVector2f(self.sensor.film().crop_size())

    def moves(self) -> bool:
        """Return whether connections depend on sensor parameters that have gradients."""
        with dr.resume_grad():
            origin = dr.zeros(mi.Interaction3f)
            origin.p = mi.Point3f(0.1, 0.2, 3)
            to = self.sight(origin, mi.Point2f(0.4), mi.Bool(True))
            return dr.grad_enabled(to.d, to.s, to.W, to.end)

    def sight(self, origin: mi.Interaction3f, u: mi.Point2f, active: mi.Bool) -> Sighting:
        """Connect a point to the sensor, differentiably in the point and the sensor. Occlusion is not tested.

        The random numbers ``u`` select a point on the aperture of a thin lens or on an irradiance meter. This point
        has fixed coordinates on the aperture or meter, and moves with the sensor.
        """
        if self.sensor.class_name() == METER:
            return self._meter(origin, u, active)
        return self._camera(mi.Point3f(origin.p), u, active)

    def _camera(self, p: mi.Point3f, u: mi.Point2f, active: mi.Bool) -> Sighting:
        sensor, kind = self.sensor, self.sensor.class_name()
        to_world, project = sensor.world_transform(), sensor.projection_transform()
        p = to_world.inverse() @ p
        scale = dr.abs(project.matrix[0, 0] * project.matrix[1, 1])  # film area per area of the plane at depth 1
        near, far = sensor.near_clip(), sensor.far_clip()
        inside = active & (p.z >= near) & (p.z <= far)
        z = dr.select(inside, p.z, 1)
        p = mi.Point3f(dr.select(inside, p.x, 0), dr.select(inside, p.y, 0), z)
        if kind == "OrthographicCamera":
            lens, through = mi.Point3f(p.x, p.y, 0), p
            axes = to_world @ mi.Vector3f(1, 0, 0), to_world @ mi.Vector3f(0, 1, 0), to_world @ mi.Vector3f(0, 0, 1)
            W = scale / dr.abs(dr.dot(dr.cross(axes[0], axes[1]), dr.normalize(axes[2])))
            towards = -axes[2]
        else:
            lens = mi.Point3f(0)
            if kind == "ThinLensCamera":
                params = mi.traverse(sensor)
                disk = mi.warp.square_to_uniform_disk_concentric(u) * params["aperture_radius"]
                lens = mi.Point3f(disk.x, disk.y, 0)
            d = mi.Vector3f(p - lens)
            through = lens + d * (params["focus_distance"] / z) if kind == "ThinLensCamera" else p
            # The area element on the plane at depth 1 is dω / cos³, and dω = dA / |d|². The camera's transform must not
            # scale its axes, which Mitsuba's camera rays do not support either.
            W = scale * dr.sqrt(dr.squared_norm(d)) / (z * z * z) / dr.square(project.matrix[3, 2])
            towards = to_world @ -d
        screen = project @ mi.Point3f(through)
        s = (mi.Point2f(screen.x, screen.y) - self._principal_point()) * mi.Point2f(self.size())
        on_film = dr.all((s > -self.reach) & (s < self.size() + self.reach))
        end = to_world @ (lens + (p - lens) * (near / z))
        return Sighting(dr.normalize(towards), end, s, dr.select(inside, W, 0), inside & on_film)

    def _principal_point(self) -> mi.Point2f:
        """Return the offset of the principal point relative to the crop window."""
        if self.sensor.class_name() != "PerspectiveCamera":
            return mi.Point2f(0)
        params, film = mi.traverse(self.sensor), self.sensor.film()
        ratio = mi.ScalarVector2f(film.size()) / mi.ScalarVector2f(film.crop_size())
        offset = params["principal_point_offset_x"], params["principal_point_offset_y"]
        return mi.Point2f(offset[0] * ratio.x, offset[1] * ratio.y)

    def _meter(self, origin: mi.Interaction3f, u: mi.Point2f, active: mi.Bool) -> Sighting:
        shape = self.sensor.get_shape()
        to = shape.sample_direction(origin, u, active)
        sees = active & (to.pdf > 0) & (dr.dot(to.n, to.d) < 0)
        W = dr.select(sees, dr.rcp(dr.select(sees, to.pdf, 1) * shape.surface_area()), 0)
        return Sighting(to.d, to.p, mi.Point2f(0.5), W, sees)


def require_no_response(sensor: mi.Sensor) -> None:
    """Raise PathreplayError if a sensor has a spectral response (``srf``), which Mitsuba does not expose.

    Such a sensor samples other wavelengths than a sensor without response. For spectral variants.
    """
    u, si = mi.Float(0.5), dr.zeros(mi.SurfaceInteraction3f)
    apart = sensor.sample_wavelengths(si, u)[0][0] - mi.sample_rgb_spectrum(u)[0]
    if abs(apart[0]) > 1e-3:  # nm
        raise PathreplayError(
            f"light paths cannot be weighted by the spectral response of sensor '{sensor.id()}': remove its 'srf', or "
            "trace all paths from the sensor"
        )
