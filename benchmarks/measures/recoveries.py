"""Other ways to recover ray adjoints, for comparison with the method of the replay driver."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.ray_jacobian import Recovery


@dataclass(frozen=True)
class OtherRecovery(Recovery):
    """Regularisation A + ε X of ray Jacobians A, where X depends on ``place``.

    For ``everywhere``, X is the identity at all vertices, as published. For ``smooth``, X is the identity where a
    smooth lobe was sampled. ``directions`` is the driver's own regularisation. Adjoints are recovered in float64 if
    ``double``, otherwise in float32.
    """

    place: str = "directions"
    double: bool = True

    def real(self, kind: type) -> type:
        return super().real(kind) if self.double else kind

    def regularised(self, A: mi.Matrix4f, sign: mi.Float, smooth: mi.Bool) -> mi.Matrix4f:
        if self.place == "directions":
            return super().regularised(A, sign, smooth)
        ε = self.noise * sign
        return A + type(A)(type(A[0, 0])(ε if self.place == "everywhere" else dr.select(smooth, ε, 0)))
