"""Arrangement of a light, a lens or mirror, and a receiver: where light comes from, and the normal that directs it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.caustics.monge_ampere import Field


@dataclass(frozen=True)
class Optics:
    """Arrangement of a light, a surface to be designed, and a receiver. Lengths are in scene units.

    The surface is the exit surface of a slab of glass (``eta``) or a mirror (``mirror_angle``). Where it is flat, it is
    the plane z = 0, centred at the origin. The receiver is a parallel plane at positive z.

    Light reaches a slab along the z axis, and the receiver is centred on this axis. Light reaches a mirror along
    (sin α, 0, -cos α), where α is the angle of the mirror. The centre of the receiver is the point to which a flat
    mirror reflects the light that arrives at the centre of the mirror.

    Args:
        width: width of the height map, whose cells are square. The surface ends at the centres of the outer cells.
        distance: distance from the flat surface to the receiver.
        eta: index of refraction of the slab relative to its surroundings.
        receiver_width: width of the image on the receiver; default: the width of the map.
        source_distance: distance from a point light to the flat entry surface of the slab, or to the centre of the
            mirror; default: collimated light.
        thickness: distance from the entry surface to the flat exit surface. It only matters for a point light.
        mirror_angle: angle between the light and the normal of the flat mirror in degrees.
    """

    width: float
    distance: float
    eta: float | None = None
    receiver_width: float | None = None
    source_distance: float | None = None
    thickness: float = 0.0
    mirror_angle: float | None = None

    def __post_init__(self) -> None:
        for name in ("width", "distance", "receiver_width", "source_distance"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise PathreplayError(f"{name} is {value:g}; give a positive length")
        if not 0 <= self.thickness < np.inf:
            raise PathreplayError(f"thickness is {self.thickness:g}; give a length of 0 or more")
        if (self.eta is None) == (self.mirror_angle is None):
            given = "neither eta nor mirror_angle" if self.eta is None else "both eta and mirror_angle"
            raise PathreplayError(
                f"The optics have {given}; give eta for a slab of glass, or mirror_angle for a mirror"
            )
        if self.eta is not None and not 1 < self.eta < np.inf:
            raise PathreplayError(f"eta is {self.eta:g}; give an index of refraction above 1, such as 1.5 for glass")
        if self.mirror_angle is not None and not 0 <= self.mirror_angle < 90:
            raise PathreplayError(
                f"mirror_angle is {self.mirror_angle:g}; give an angle of at least 0, below 90 degrees"
            )
        if self.mirror_angle is not None and self.thickness:
            raise PathreplayError(f"thickness is {self.thickness:g}, but a mirror has none; remove it")

    @property
    def centre(self) -> float:
        """Coordinate x of the centre of the receiver."""
        return self.distance * float(np.tan(np.radians(self.mirror_angle or 0)))

    @property
    def foreshortening(self) -> float:
        """Apparent width of the surface along x, seen from the light, relative to its width: cos α.

        Small slopes (h_x, h_y) of a mirror shift the light on the receiver by -2 (h_x / cos² α, h_y) times the
        distance.
        """
        return float(np.cos(np.radians(self.mirror_angle or 0)))

    @property
    def depends_on_heights(self) -> bool:
        """Whether the light that a point of the surface receives depends on the heights."""
        return self.source_distance is not None or bool(self.mirror_angle)

    def incidence(self, x: Field, y: Field, z: Field) -> tuple[Field, Field]:
        """Return the direction of incident light (..., 3) at points, and its flux per area of a plane z = const.

        In a slab, the direction is the direction after refraction at the entry surface. The flux has an arbitrary
        scale.
        """
        if self.eta is not None and self.source_distance is not None:
            return self._refracted(x, y, z, self.eta, self.source_distance)
        α = np.radians(self.mirror_angle or 0)
        along = np.array([0.0, 0.0, 1.0]) if self.mirror_angle is None else np.array([np.sin(α), 0.0, -np.cos(α)])
        if self.source_distance is None:
            return np.broadcast_to(along, (*x.shape, 3)), np.ones_like(x)
        ray = np.stack([x, y, z], axis=-1) + self.source_distance * along
        length = np.linalg.norm(ray, axis=-1, keepdims=True)
        return ray / length, abs(ray[..., 2]) / length[..., 0] ** 3

    def normal(self, incoming: Field, outgoing: Field) -> Field:
        """Return normals (..., 3) of a surface that directs light from ``incoming`` to ``outgoing``. Not normalized.

        ``incoming`` and ``outgoing`` are unit vectors in the direction of propagation. By Snell's law, the normal of a
        slab is parallel to eta · ``incoming`` - ``outgoing``. By the law of reflection, the normal of a mirror is
        parallel to ``outgoing`` - ``incoming``.

        Raises:
            PathreplayError: the required deflection of a ray exceeds the deflection at the critical angle.
        """
        if self.eta is None:
            return outgoing - incoming
        cosine = np.einsum("...i,...i", incoming, outgoing).min()
        if cosine <= 1 / self.eta:
            turn, most = (np.degrees(np.arccos(np.clip(c, -1, 1))) for c in (cosine, 1 / self.eta))
            raise PathreplayError(
                f"The image requires that light turns by {turn:.0f} degrees, but eta = {self.eta:g} turns it by less "
                f"than {most:.0f}; enlarge the distance, or reduce the image"
            )
        return self.eta * incoming - outgoing

    def _refracted(self, x: Field, y: Field, z: Field, eta: float, s: float) -> tuple[Field, Field]:
        """Return direction and flux of light from a point at the distance ``s`` from the entry surface of the slab."""
        depth, r = self.thickness + z, np.hypot(x, y)
        # Newton's method for q = sin θ', where θ' is the angle to the axis in the slab and θ the angle outside:
        # r = s tan θ + depth tan θ', sin θ = eta q. Both tangents are convex in q, so q decreases to the solution.
        q = r / np.hypot(r, s) / eta
        for _ in range(20):
            outside, inside = np.sqrt(1 - np.square(eta * q)), np.sqrt(1 - np.square(q))
            slope = s * eta / outside**3 + depth / inside**3
            q = q - (s * eta * q / outside + depth * q / inside - r) / slope
        # dΩ / dA = sin θ dθ / (r dr) with cos θ dθ = eta dq and dr = slope dq. On the axis, sin θ / r has a limit.
        on_axis = 1 / (s + depth / eta)
        ratio = np.where(r > 1e-6 * s, eta * q / np.maximum(r, 1e-300), on_axis)
        flux = ratio * eta / (outside * slope)
        radial = np.where(r > 0, q / np.maximum(r, 1e-300), 0)
        return np.stack([radial * x, radial * y, inside], axis=-1), flux
