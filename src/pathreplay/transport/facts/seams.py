"""Textures with discontinuities: checkerboards, bitmaps with nearest-neighbour lookup, face attributes of meshes.

Boundary terms do not cover these discontinuities. With `SurfaceFlow`, the film positions of camera rays move with the
visible surfaces. A camera ray that moves would cross the discontinuities of textures on static surfaces. Film positions
therefore do not move in a scene with such a texture.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

CHECKERBOARD, BITMAP, ATTRIBUTE = "Checkerboard", "BitmapTextureImpl", "MeshAttribute"
"""Class names. The class name of a bitmap begins with BITMAP and ends with the texel type."""
WAVELENGTHS = 440.0, 510.0, 580.0, 650.0


def has_seams(textures: Iterable[mi.Texture]) -> bool:
    """Return whether a texture is discontinuous. Bitmaps are evaluated, because they do not expose their filter."""
    return any(map(_has_seams, textures))


def _has_seams(texture: mi.Texture) -> bool:
    kind = texture.class_name()
    if kind.startswith(BITMAP):
        return _is_nearest(texture)
    return kind == CHECKERBOARD or (kind == ATTRIBUTE and 'name = "face_' in str(texture))


def _is_nearest(texture: mi.Texture) -> bool:
    """Return whether a bitmap uses nearest-neighbour lookup, for any values of its texels.

    Interpolated values depend on the position differentiably. The index of the nearest texel does not.
    """
    raw = texture.eval_3 if mi.traverse(texture)["data"].shape[2] == 3 else texture.eval_1
    values = raw if "raw = 1" in str(texture) else texture.eval
    si = dr.zeros(mi.SurfaceInteraction3f)
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(*WAVELENGTHS)
    with dr.resume_grad():
        dr.enable_grad(si.uv)
    with dr.suspend_grad(), dr.resume_grad(si.uv):  # the texels may have gradients, too
        return not dr.grad_enabled(values(si))
