"""Other ways to recover ray adjoints than the replay driver's, which experiments compare it with."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.ray_jacobian import Recovery


@dataclass(frozen=True)
class OtherRecovery(Recovery):
    """A + ε X with X the identity at all vertices (``everywhere``), as published, or where a smooth lobe was sampled
    (``smooth``); ``directions`` is the driver's own. ``double`` keeps the books in float64, else in float32."""

    place: str = "directions"
    double: bool = True

    def real(self, kind: type) -> type:
        return super().real(kind) if self.double else kind

    def regularised(self, A: mi.Matrix4f, sign: mi.Float, smooth: mi.Bool) -> mi.Matrix4f:
        if self.place == "directions":
            return super().regularised(A, sign, smooth)
        ε = self.noise * sign
        return A + type(A)(type(A[0, 0])(ε if self.place == "everywhere" else dr.select(smooth, ε, 0)))
