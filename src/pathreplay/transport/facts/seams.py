"""Textures with discontinuities: checkerboards, bitmaps with nearest-neighbour lookup, face attributes of meshes.

Boundary terms do not cover these discontinuities. With `SurfaceFlow`, the film positions of camera rays move with the
visible surfaces. A camera ray that moves would cross the discontinuities of textures on static surfaces. Film positions
therefore do not move in a scene with such a texture.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

CHECKERBOARD, BITMAP, ATTRIBUTE = "Checkerboard", "BitmapTextureImpl", "MeshAttribute"
"""Class names. The class name of a bitmap begins with BITMAP and ends with the texel type."""
PROBES, BESIDE = 64, 1e-3
"""Number of texel borders that are probed, and the distance of the probes from the borders, in texels."""
WAVELENGTHS = 440.0, 510.0, 580.0, 650.0
JUMPS = 0.5
"""A bitmap is discontinuous at a texel border if its values on both sides differ by more than this fraction of the
difference between the two texels."""


def has_seams(textures: Iterable[mi.Texture]) -> bool:
    """Return whether a texture is discontinuous. Bitmaps are evaluated, because they do not expose their filter."""
    return any(map(_jumps, textures))


def _jumps(texture: mi.Texture) -> bool:
    kind = texture.class_name()
    if kind.startswith(BITMAP):
        return _is_nearest(texture)
    return kind == CHECKERBOARD or (kind == ATTRIBUTE and 'name = "face_' in str(texture))


def _is_nearest(texture: mi.Texture) -> bool:
    """Return whether a bitmap uses nearest-neighbour lookup: whether its values jump at texel borders (see `JUMPS`)."""
    params = mi.traverse(texture)
    height, width, channels = params["data"].shape
    raw = texture.eval_3 if channels == 3 else texture.eval_1
    values = raw if "raw = 1" in str(texture) else texture.eval
    along, across = (width, height) if width >= height else (height, width)
    if along < 2:
        return False
    random = np.random.default_rng(1)
    border, middle = random.integers(1, along, PROBES), (random.integers(0, across, PROBES) + 0.5) / across
    from_texels = np.linalg.inv(np.array(params["to_uv"].matrix, np.float64))

    def differences(beside: float) -> np.ndarray:
        """Return the difference between the values on both sides of each border, ``beside`` texels from the border."""
        sides = []
        for side in (-1, 1):
            at = (border + side * beside) / along, middle
            x, y, _ = from_texels @ (*(at if width >= height else at[::-1]), np.ones(PROBES))
            si = dr.zeros(mi.SurfaceInteraction3f, PROBES)
            si.uv = mi.Point2f(x, y)
            if mi.is_spectral:
                si.wavelengths = type(si.wavelengths)(*WAVELENGTHS)
            sides.append(np.array(values(si)))
        return np.abs(sides[1] - sides[0])

    with dr.suspend_grad():
        close, apart = differences(BESIDE), differences(0.5)
    return bool(np.any(close > JUMPS * apart, where=apart > 0))
