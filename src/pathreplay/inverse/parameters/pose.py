"""Poses: rigid motions of transforms and meshes as variables, and errors of poses.

With the transform M₀ of the scene, the pivot c, the translation t and the rotation vector r (axis times angle),

    M(t, r) = T(c + t) · R(r) · T(-c) · M₀,      R(r) = I + a K + b K²,   K x = r × x,   θ = |r|,
                                                 a = sin θ / θ,   b = (1 - cos θ) / θ²      (Rodrigues)

t and r are in world coordinates. The vertices of meshes, which have no transform, are moved in the same way. Optimising
the sixteen entries of a matrix instead would also shear and scale the object.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import PARTS, PoseKind
from pathreplay.platform import compat
from pathreplay.scenes.parameters import SceneValue, get_array, is_transform

PART_NAMES = (":translation", ":rotation")
"""Suffixes of the keys of the variables of a pose."""

# For smaller θ², a and b are evaluated by series. The omitted terms, θ⁴ / 120 and θ⁴ / 720, are then below the rounding
# error of single precision.
_SMALL = 1e-3


@dataclass(frozen=True)
class Pose:
    """Rigid motion of one scene parameter: ``…to_world`` (a transform) or the vertices of a mesh (3 n floats)."""

    key: str
    kind: PoseKind
    base: SceneValue
    """M₀ or the vertex positions in the scene, detached."""
    pivot: tuple[float, float, float]
    distance: float | None
    """Length relative to which position errors are reported."""
    truth: NDArray[np.float32] | None
    """The transform or the vertex positions in the target scene."""

    def parts(self) -> dict[str, str]:
        """Return the keys of the variables of the pose, indexed by 'translation' and 'rotation'."""
        return {part: f"{self.key}:{part}" for part in PARTS[self.kind]}

    @property
    def of(self) -> tuple[str, ...]:
        """Keys of the variables that the pose is computed from."""
        return tuple(self.parts().values())

    def value(self, variables: Mapping[str, Any]) -> SceneValue:
        """Compute the value of the scene parameter. Derivatives propagate to the variables.

        Args:
            variables: translation (scene units) and rotation vector (radians) by key, as ``mi.Vector3f`` of width 1.
        """
        moves = {part: variables[name] for part, name in self.parts().items()}
        zero = mi.Vector3f(0)
        c = mi.Vector3f(*self.pivot)
        shift = c + moves.get("translation", zero)
        R = rotation_matrix(moves.get("rotation", zero))
        if is_transform(self.base):
            A = mi.Matrix4f(R)
            for row, entry in enumerate(shift - R @ c):
                A[row, 3] = entry
            # A single product with an affine matrix keeps the last row exact. Cameras need this, because they divide by
            # the homogeneous coordinate.
            return type(self.base)(type(self.base.matrix)(A @ mi.Matrix4f(self.base.matrix)))
        return compat.positions_like(self.base, R @ (compat.points_of(self.base) - c) + shift)

    def error(self, value: NDArray[np.float32]) -> PoseError | None:
        """Compare ``value`` (from `get_array`) with the true pose. Returns None if the true pose is unknown."""
        if self.truth is None:
            return None
        a, b = value.astype(np.float64), self.truth.astype(np.float64)
        if a.shape == (4, 4):
            shift, turn = a[:3, 3] - b[:3, 3], a[:3, :3] @ np.linalg.inv(b[:3, :3])
        else:
            a, b = a.reshape(-1, 3), b.reshape(-1, 3)
            shift = a.mean(axis=0) - b.mean(axis=0)
            turn = (a - a.mean(axis=0)).T @ (b - b.mean(axis=0))
        position = float(np.linalg.norm(shift))
        nearest, _ = Rotation.align_vectors(turn.T, np.eye(3))
        angle = float(np.degrees(nearest.magnitude()))
        return PoseError(position, None if self.distance is None else position / self.distance, angle)


@dataclass(frozen=True)
class PoseError:
    """Difference between two poses: distance between origins (centres of meshes), and rotation angle."""

    position: float
    """Distance in scene units."""
    relative: float | None
    """Distance as a fraction of `Pose.distance`."""
    degrees: float

    def of(self, key: str) -> dict[str, float]:
        """Return the errors by name: 'KEY:position' (scene units) and 'KEY:degrees'."""
        return dict(zip(error_names(key), (self.position, self.degrees), strict=True))

    def __str__(self) -> str:
        fraction = "" if self.relative is None else f" ({100 * self.relative:.3g} % of its distance)"
        return f"{self.position:.3g}{fraction} and {self.degrees:.3g}° off"


def error_names(key: str) -> tuple[str, str]:
    """Return the names of the two errors of a pose."""
    return f"{key}:position", f"{key}:degrees"


def make_pose(key: str, value: SceneValue, kind: PoseKind, pivot: list[float] | None, distance: float | None) -> Pose:
    """Make a pose for the parameter ``key``.

    Args:
        key: key of the parameter.
        value: value of the parameter in the scene.
        kind: which parts of the motion are variables.
        pivot: centre of rotation; default: the origin of the transform, or the mean of the vertices.
        distance: length relative to which position errors are reported.

    Raises:
        PathreplayError: the parameter is neither a transform nor the vertex positions of a mesh.
    """
    array = get_array(value)
    if is_transform(value):
        origin = array[:3, 3]
    elif compat.is_positions(key):
        origin = array.reshape(-1, 3).mean(axis=0)
    else:
        raise PathreplayError(
            f"Parameter '{key}' is a {type(value).__name__} and has no pose; remove 'pose', or name a 'to_world' or "
            f"'{compat.positions_name()}' parameter"
        )
    x, y, z = (float(v) for v in (origin if pivot is None else pivot))
    # A copy, because `value` refers to the scene's value, which changes during the run.
    return Pose(key, kind, type(value)(dr.detach(value)), (x, y, z), distance, None)


def rotation_matrix(r: mi.Vector3f) -> mi.Matrix3f:
    """Compute R(r) for a rotation vector in radians. The derivative is finite even at r = 0."""
    θ2 = dr.squared_norm(r)
    small = θ2 < _SMALL
    safe = dr.select(small, _SMALL, θ2)
    θ = dr.sqrt(safe)
    a = dr.select(small, 1 - θ2 / 6, dr.sin(θ) / θ)
    b = dr.select(small, 0.5 - θ2 / 24, (1 - dr.cos(θ)) / safe)
    zero = mi.Float(0)
    K = mi.Matrix3f([[zero, -r.z, r.y], [r.z, zero, -r.x], [-r.y, r.x, zero]])
    return mi.Matrix3f(1) + a * K + b * (K @ K)
