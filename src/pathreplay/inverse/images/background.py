"""Background image of a view: the environment emitter, as the camera would see it if there were no geometry."""

from __future__ import annotations

import math
from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image

SAMPLES = 256
"""Samples per pixel. The only source of noise is the variation of the environment within a pixel."""
_MOST = 2**31
"""Largest number of samples of an image. Dr.Jit counts up to 2^32 in one kernel; a film may also sample its border."""


def background(scene: mi.Scene, sensor: int) -> Image:
    """Render the environment emitter of a scene as if the scene had no geometry.

    Args:
        scene: the scene.
        sensor: index of the sensor.

    Returns:
        The image on the film of the sensor, shape (height, width, channels). It is black if the scene has no
        environment emitter. Films of more than 8 megapixels get fewer than `SAMPLES` samples per pixel.
    """

    class Sky(mi.SamplingIntegrator):  # defined here, because the base class depends on the variant
        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool | bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
            si.wi, si.wavelengths = -ray.d, ray.wavelengths
            environment = scene.environment()
            light = mi.Spectrum(0) if environment is None else environment.eval(si, active)
            return light, mi.Bool(True), []

    pixels, spp = math.prod(int(n) for n in scene.sensors()[sensor].film().crop_size()), SAMPLES
    while spp > 1 and pixels * spp > _MOST:
        spp //= 4  # every sampler accepts powers of four
    with dr.suspend_grad():
        image = mi.render(scene, sensor=sensor, integrator=Sky(mi.Properties()), spp=spp, seed=0)
    return np.array(image, dtype=np.float32)


def require_known(scene: mi.Scene, params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """Raise PathreplayError if the job recovers the environment, over which the targets are composited beforehand."""
    if (environment := scene.environment()) is None:
        return
    parts = {owner[2] for owner in mi.traverse(environment).properties.values()}
    for key in keys:
        if params.properties[key][2] in parts:
            raise PathreplayError(
                f"target: alpha = 'scene' composites the images over the scene's environment, but '{key}' is to be "
                "recovered; use alpha = 'mask' or 'compare'"
            )
