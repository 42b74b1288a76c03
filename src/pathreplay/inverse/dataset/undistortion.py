"""Undistortion of images with the OpenCV and OpenCV fisheye lens models, by resampling.

Let (x, y) be a point of the plane z = 1 in front of the camera, with x to the right, y down and r² = x² + y². The
OpenCV model maps (x, y) to

    x' = x f(r) + 2 p1 x y + p2 (r² + 2 x²)         f = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    y' = y f(r) + 2 p2 x y + p1 (r² + 2 y²)

The fisheye model multiplies x and y by θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) / r, with θ = arctan r. Both models map
(x', y') to the pixel coordinates (fx x' + cx, fy y' + cy), measured from the upper left corner of the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from pathreplay.inverse.images.io import Image

Plane = NDArray[np.float64]

OFF = 0.5
"""Tolerance in pixels. Pixels count as square if replacing fy by fx moves the image border by at most this distance."""
_STEPS = 2048
"""Number of radii at which `Lens.bent` tests whether the distorted radius still increases."""


@dataclass(frozen=True)
class Lens:
    """Camera intrinsics in pixels of an image of size ``w`` x ``h``, with distortion coefficients."""

    w: float
    h: float
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 to k6; k1 to k4 for a fisheye lens."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1 and p2."""
    fisheye: bool = False

    @property
    def is_pinhole(self) -> bool:
        """Whether images need no resampling, because there is no distortion and pixels are square."""
        bends = self.fisheye or any(self.radial) or any(self.tangential)
        return not bends and abs(self.fy / self.fx - 1) * self.h / 2 <= OFF

    def describe(self) -> str:
        if self.fisheye:
            return "a fisheye lens"
        return "a distorting lens" if any(self.radial) or any(self.tangential) else "pixels that are not square"

    def bent(self, x: Plane, y: Plane) -> tuple[Plane, Plane, NDArray[np.bool_]]:
        """Distort points of the plane z = 1.

        Returns:
            The distorted x' and y', and a mask. The mask selects the points up to the radius at which the distorted
            radius stops increasing.
        """
        r = np.hypot(x, y)
        radii = np.linspace(0, max(float(r.max(initial=0.0)), 1e-6), _STEPS)
        grows = np.diff(radii * self._stretch(radii)) > 0
        unfolded = r <= (np.inf if grows.all() else radii[int(np.argmin(grows))])
        f, (p1, p2) = self._stretch(r), self.tangential
        x_bent = x * f + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
        return x_bent, y * f + 2 * p2 * x * y + p1 * (r**2 + 2 * y**2), unfolded

    def _stretch(self, r: Plane) -> Plane:
        k = self.radial
        with np.errstate(all="ignore"):  # `bent` treats non-finite values as not increasing
            if self.fisheye:
                θ = np.arctan(r)
                θ2 = θ * θ
                bent = θ * (1 + θ2 * (k[0] + θ2 * (k[1] + θ2 * (k[2] + θ2 * k[3]))))
                return np.divide(bent, r, out=np.ones_like(r), where=r > 0)
            r2 = r * r
            above = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
            return above / (1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))

    def undone(self, image: Image) -> tuple[Image, Image]:
        """Resample an image to a pinhole camera with the fx, the principal point and the size of this lens.

        The interpolation is bilinear, in linear radiance.

        Args:
            image: the distorted image, shape (height, width, channels).

        Returns:
            The undistorted image, and a mask that is 1 where the distorted image has data, shape (height, width, 1).
        """
        height, width, _ = image.shape
        u, v = np.meshgrid((np.arange(width) + 0.5) * self.w / width, (np.arange(height) + 0.5) * self.h / height)
        sampled, mask = self.sampled(image, (u - self.cx) / self.fx, (v - self.cy) / self.fx, (width, height))
        return sampled * mask, mask

    def sampled(self, image: Image, x: np.ndarray, y: np.ndarray, extent: tuple[float, float]) -> tuple[Image, Image]:
        """Interpolate a distorted image at the pixels in which the lens shows the directions (x, y, 1).

        Args:
            image: the distorted image, shape (height, width, channels).
            x: horizontal components of the directions, an array of shape (rows, columns).
            y: vertical components of the directions, an array of shape (rows, columns).
            extent: ``w`` and ``h`` of the lens, converted to pixels of ``image``.

        Returns:
            The values, and a mask that is 1 where the image has data, shape (rows, columns, 1).
        """
        height, width, _ = image.shape
        x, y, valid = self.bent(x, y)
        column = (self.fx * x + self.cx) * extent[0] / self.w - 0.5
        row = (self.fy * y + self.cy) * extent[1] / self.h - 0.5
        with np.errstate(invalid="ignore"):
            valid &= (column >= -0.5) & (column <= width - 0.5) & (row >= -0.5) & (row <= height - 0.5)
        coordinates = np.where(valid, row, 0.0), np.where(valid, column, 0.0)
        planes = [
            scipy.ndimage.map_coordinates(image[:, :, i], coordinates, order=1, mode="nearest", output=np.float32)
            for i in range(image.shape[2])
        ]
        return np.stack(planes, axis=2), valid[:, :, None].astype(np.float32)
