"""Textures and volumes with discontinuities.

These are checkerboards, bitmaps and grids with nearest-neighbour lookup, and face attributes of meshes. Boundary terms
do not cover these discontinuities. With `SurfaceFlow`, the film positions of camera rays move with the visible
surfaces. A camera ray that moves would cross the discontinuities of static textures and volumes. Film positions
therefore do not move in a scene with such a texture or volume.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

CHECKERBOARD, BITMAP, ATTRIBUTE, GRID = "Checkerboard", "BitmapTextureImpl", "MeshAttribute", "GridVolume"
"""Class names. The class name of a bitmap begins with BITMAP and ends with the texel type."""
WAVELENGTHS = 440.0, 510.0, 580.0, 650.0


def has_seams(textures: Iterable[mi.Texture]) -> bool:
    """Return whether a texture is discontinuous. Bitmaps are evaluated, because they do not expose their filter."""
    return any(map(_has_seams, textures))


def has_steps(volumes: Iterable[mi.Volume]) -> bool:
    """Return whether a grid uses nearest-neighbour lookup. Grids do not expose their filter, so they are evaluated."""
    return any(volume.class_name() == GRID and _has_steps(volume) for volume in volumes)


def _has_steps(grid: mi.Volume) -> bool:
    it = dr.zeros(mi.Interaction3f)
    if mi.is_spectral:
        it.wavelengths = type(it.wavelengths)(*WAVELENGTHS)
    with dr.resume_grad():
        dr.enable_grad(it.p)
    with dr.suspend_grad(), dr.resume_grad(it.p):  # the voxels may have gradients, too
        channels = mi.traverse(grid)["data"].shape[3]
        if channels == 3 and mi.is_spectral:  # a raw grid, since Mitsuba converts colours to spectra of 4 channels
            return not dr.grad_enabled(grid.eval_3(it))
        return not dr.grad_enabled(grid.eval(it) if channels in (1, 3, 4) else grid.eval_n(it))


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
