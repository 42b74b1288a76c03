"""Lenses that bend what a pinhole sees: OpenCV's and the fisheye, undone by resampling their pictures.

In the plane at distance 1 in front of the camera, x to the right, y down, r² = x² + y², OpenCV's lens takes (x, y) to

    x' = x f(r) + 2 p1 x y + p2 (r² + 2 x²)         f = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    y' = y f(r) + 2 p2 x y + p1 (r² + 2 y²)

and a fisheye both to themselves times θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) / r, with θ = arctan r. The pixel is
(fx x' + cx, fy y' + cy), from the upper left corner of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.ndimage

from pathreplay.inverse.images.io import Image

OFF = 0.5
"""Pixels by which a picture's border may be off because its pixels are taken for squares."""
_STEPS = 2048
"""Radii at which it is looked for where a lens folds back."""


@dataclass(frozen=True)
class Lens:
    """Focal lengths and principal point in pixels of a picture of ``w`` x ``h``, and how it bends what it sees."""

    w: float
    h: float
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 to k6; of a fisheye k1 to k4."""
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False

    @property
    def is_pinhole(self) -> bool:
        """Whether pictures can be taken as they are: nothing is bent, and pixels are squares."""
        bends = self.fisheye or any(self.radial) or any(self.tangential)
        return not bends and abs(self.fy / self.fx - 1) * self.h / 2 <= OFF

    def told(self) -> str:
        """What is undone, in words."""
        if self.fisheye:
            return "a fisheye lens"
        return "a distorting lens" if any(self.radial) or any(self.tangential) else "pixels that are no squares"

    def bent(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Where the lens takes points of the plane, and which of them come before it folds back."""
        r = np.hypot(x, y)
        radii = np.linspace(0, max(float(r.max(initial=0.0)), 1e-6), _STEPS)
        grows = np.diff(radii * self._stretch(radii)) > 0
        unfolded = r <= (np.inf if grows.all() else radii[int(np.argmin(grows))])
        f, (p1, p2) = self._stretch(r), self.tangential
        x_bent = x * f + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
        return x_bent, y * f + 2 * p2 * x * y + p1 * (r**2 + 2 * y**2), unfolded

    def _stretch(self, r: Any) -> Any:
        k = self.radial
        with np.errstate(all="ignore"):  # what is not finite is folded
            if self.fisheye:
                θ = np.arctan(r)
                θ2 = θ * θ
                bent = θ * (1 + θ2 * (k[0] + θ2 * (k[1] + θ2 * (k[2] + θ2 * k[3]))))
                return np.divide(bent, r, out=np.ones_like(r), where=r > 0)
            r2 = r * r
            above = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
            return above / (1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))

    def undone(self, image: Image) -> tuple[Image, Image]:
        """The picture that a pinhole of the same fx and principal point would have taken, in the same size.

        And which of its pixels the picture has (height x width x 1; 1 or 0). Interpolated linearly, in linear radiance.
        """
        height, width, _ = image.shape
        u, v = np.meshgrid((np.arange(width) + 0.5) * self.w / width, (np.arange(height) + 0.5) * self.h / height)
        x, y, there = self.bent((u - self.cx) / self.fx, (v - self.cy) / self.fx)
        column = (self.fx * x + self.cx) * width / self.w - 0.5
        row = (self.fy * y + self.cy) * height / self.h - 0.5
        with np.errstate(invalid="ignore"):
            there &= (column >= -0.5) & (column <= width - 0.5) & (row >= -0.5) & (row <= height - 0.5)
        places = np.where(there, row, 0.0), np.where(there, column, 0.0)
        planes = [
            scipy.ndimage.map_coordinates(image[:, :, i], places, order=1, mode="nearest", output=np.float32)
            for i in range(image.shape[2])
        ]
        seen = there[:, :, None].astype(np.float32)
        return np.stack(planes, axis=2) * seen, seen
