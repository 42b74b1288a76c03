"""Poses as variables: a shift and a turn of what the scene holds, and how far a pose is from the true one.

With M₀ the transform of the scene file, c the pivot, t the translation and r the rotation vector (axis times angle),

    M(t, r) = T(c + t) · R(r) · T(-c) · M₀,      R(r) = I + a K + b K²,   K x = r × x,   θ = |r|,
                                                 a = sin θ / θ,   b = (1 - cos θ) / θ²      (Rodrigues)

t and r are in the axes of the world. Meshes, which keep no transform, get the same motion on their vertices. Sixteen
free numbers would shear and scale instead, which no rigid thing does.
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
from pathreplay.scenes.parameters import get_array, is_transform

PART_NAMES = (":translation", ":rotation")
"""How names of the variables of a pose end."""

# θ² below which series stand in for a and b: their next terms, θ⁴ / 120 and θ⁴ / 720, are below float32 rounding there.
_SMALL = 1e-3


@dataclass(frozen=True)
class Pose:
    """The moving thing behind one key: ``…to_world`` (a transform) or ``…vertex_positions`` (3 n floats)."""

    key: str
    kind: PoseKind
    base: Any
    """M₀ or the vertices, as the scene file has them; detached."""
    pivot: tuple[float, float, float]
    distance: float | None
    """Length that translation errors are compared with."""
    truth: NDArray[np.float32] | None
    """The transform or the vertices of the target scene."""

    def parts(self) -> dict[str, str]:
        """'translation' and/or 'rotation' -> name of that variable in the optimiser."""
        return {part: f"{self.key}:{part}" for part in PARTS[self.kind]}

    @property
    def of(self) -> tuple[str, ...]:
        """Names of the variables that make it."""
        return tuple(self.parts().values())

    def value(self, variables: Mapping[str, Any]) -> Any:
        """The parameter's value for the optimiser's variables; derivatives flow to them.

        Translations are in scene units, rotation vectors in radians (both ``mi.Vector3f`` of size 1).
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
            # Rounding of the product may not touch the last row: cameras divide by what it makes.
            return type(self.base)(type(self.base.matrix)(A @ mi.Matrix4f(self.base.matrix)))
        return dr.ravel(R @ (dr.unravel(mi.Vector3f, self.base) - c) + shift)

    def error(self, value: NDArray[np.float32]) -> PoseError | None:
        """How far ``value`` (of :func:`get_array`) is from the truth; None where that is not known."""
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
    """Between two poses of a thing: distance of its origins (a mesh: centres), also as a share of a length; angle."""

    position: float
    relative: float | None
    degrees: float

    def of(self, key: str) -> dict[str, float]:
        """By names that say of which pose: 'KEY:position' (scene units) and 'KEY:degrees'."""
        return dict(zip(error_names(key), (self.position, self.degrees), strict=True))

    def __str__(self) -> str:
        share = "" if self.relative is None else f" ({100 * self.relative:.3g} % of its distance)"
        return f"{self.position:.3g}{share} and {self.degrees:.3g}° off"


def error_names(key: str) -> tuple[str, str]:
    """What the two errors of a pose are called."""
    return f"{key}:position", f"{key}:degrees"


def make_pose(key: str, value: Any, kind: PoseKind, pivot: list[float] | None, distance: float | None) -> Pose:
    """A pose for the parameter ``key``; the default pivot is the origin of the object's own frame (a mesh: its centre).

    Raises PathreplayError where the parameter is neither a transform nor a mesh's vertices.
    """
    array = get_array(value)
    if is_transform(value):
        origin = array[:3, 3]
    elif key.rsplit(".", 1)[-1] == "vertex_positions":
        origin = array.reshape(-1, 3).mean(axis=0)
    else:
        raise PathreplayError(
            f"Parameter '{key}' is a {type(value).__name__} and has no pose; leave 'pose' out, or name a 'to_world' "
            "or a 'vertex_positions'"
        )
    x, y, z = (float(v) for v in (origin if pivot is None else pivot))
    # A copy: the map hands out a reference to what the scene holds, and the scene is about to change.
    return Pose(key, kind, type(value)(dr.detach(value)), (x, y, z), distance, None)


def rotation_matrix(r: Any) -> Any:
    """R(r) for a rotation vector in radians, differentiable at r = 0 too."""
    θ2 = dr.squared_norm(r)
    small = θ2 < _SMALL
    safe = dr.select(small, _SMALL, θ2)
    θ = dr.sqrt(safe)
    a = dr.select(small, 1 - θ2 / 6, dr.sin(θ) / θ)
    b = dr.select(small, 0.5 - θ2 / 24, (1 - dr.cos(θ)) / safe)
    zero = mi.Float(0)
    K = mi.Matrix3f([[zero, -r.z, r.y], [r.z, zero, -r.x], [-r.y, r.x, zero]])
    return mi.Matrix3f(1) + a * K + b * (K @ K)
