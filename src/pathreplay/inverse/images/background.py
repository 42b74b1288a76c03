"""What a camera sees where nothing of the scene is before it: its environment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image

SAMPLES = 256
"""Per pixel; the picture is as noisy as the environment is rough within a pixel."""


def background(scene: mi.Scene, sensor: int) -> Image:
    """The environment as the sensor's film takes it (height x width x channels); black where there is none."""

    class Sky(mi.SamplingIntegrator):  # here, since it belongs to the variant
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
            si.wi, si.wavelengths = -ray.d, ray.wavelengths
            environment = scene.environment()
            light = mi.Spectrum(0) if environment is None else environment.eval(si, active)
            return light, mi.Bool(True), []

    with dr.suspend_grad():
        image = mi.render(scene, sensor=sensor, integrator=Sky(mi.Properties()), spp=SAMPLES, seed=0)
    return np.array(image, dtype=np.float32)


def require_known(scene: mi.Scene, params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """Raise PathreplayError if one of the keys belongs to the environment, which is then no fixed background."""
    if (environment := scene.environment()) is None:
        return
    parts = {owner[2] for owner in mi.traverse(environment).properties.values()}
    for key in keys:
        if params.properties[key][2] in parts:
            raise PathreplayError(
                f"target: alpha = 'scene' puts the scene's environment behind the pictures, and '{key}' is to be "
                "found; take alpha = 'mask', or 'compare'"
            )
