"""Tables of a job that describe its images: targets, captures with their cameras, and exposures."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pathreplay.inverse.config.parameter_options import Value
from pathreplay.inverse.config.tables import Argument, Count, Plugin, Positive, Switch, Table, Whole

NOTHING = "target: no target images; give 'images', or 'values' and/or 'scene' to render them"


class Target(Table):
    """Target images: image files, one per sensor, or a scene to render."""

    images: list[str] | str | None = None
    """Image files, one per sensor in the order of the sensors, or a pattern such as 'photos/*.png'."""
    masks: list[str] | str | None = None
    """Mask files, one per sensor, whose values weight the pixels: black pixels are ignored."""
    alpha: Literal["black", "mask", "scene", "compare"] = "black"
    """Treatment of the alpha channel of images. 'black' composites them over black, 'scene' over the environment of the
    scene. 'mask' uses alpha as pixel weights. 'compare' compares alpha as a further channel."""
    scene: str | None = None
    """Scene from which targets are rendered; default: the scene of the job."""
    scene_parameters: dict[str, Argument] | None = None
    """Arguments of the target scene; default: the scene_parameters of the job."""
    values: dict[str, Value] = Field(default_factory=dict)
    """Values of parameters of the target scene, in place of the values in its file."""
    integrator: Plugin | None = None
    """Integrator that renders the targets. Default: path (volpath if the target scene has media), with max_depth,
    rr_depth and hide_emitters of the job's integrator; the job's integrator itself if it traces light paths."""
    spp: Count = 512
    """Samples per pixel of the targets."""

    @model_validator(mode="after")
    def _one_source(self) -> Target:
        if self.images is not None:
            extra = sorted(self.model_fields_set - {"images", "masks", "alpha"})
            if extra:
                raise ValueError(f"target: 'images' excludes '{extra[0]}'; give image files or a scene to render")
            if not self.images:
                raise ValueError("target: 'images' is empty; name one image file per sensor")
            if self.masks is not None and self.alpha == "mask":
                raise ValueError("target: 'masks' and alpha = 'mask' both define a mask; remove one of them")
        elif self.model_fields_set <= {"alpha"}:
            return self  # `Config` checks that a capture provides the images
        elif self.alpha != "black":
            raise ValueError(f"target: alpha = '{self.alpha}' applies to 'images' only; remove it, or give 'images'")
        elif not self.values and self.scene is None:
            raise ValueError(NOTHING)
        light_paths = self.integrator is not None and (self.integrator.model_extra or {}).get("caustics") == "particles"
        if self.integrator is not None and self.integrator.type == "pathreplay" and not light_paths:
            raise ValueError(
                "target: integrator 'pathreplay' would be compared with itself; render targets with another "
                "integrator, such as 'path', or with caustics = 'particles'"
            )
        return self


class Capture(Table):
    """Images with camera poses, from a transforms.json or a COLMAP model."""

    transforms: str | None = None
    """A transforms.json of NeRF, instant-ngp or Nerfstudio."""
    colmap: str | None = None
    """Folder of a COLMAP model."""
    images: str | None = None
    """Folder of the images of a COLMAP model; default: ../../images relative to the model."""
    masks: str | None = None
    """Folder of masks, each named as its image with '.png' appended."""
    width: Count | None = None
    """Width of rendered images in pixels; default: the width of the images of the capture."""
    near_clip: Positive = 1e-3
    """Distance from a camera, along its axis, from which objects are visible, in scene units."""
    medium: str | None = None
    """Id of the medium of the scene that contains the cameras; default: none."""
    test_every: Annotated[Whole, Field(ge=2, le=2**31 - 1)] | None = None
    """Number n: the first view and every n-th view after it are test views."""

    @property
    def source(self) -> str:
        """Path of the transforms.json or the COLMAP model, as the job gives it."""
        return self.transforms or self.colmap or ""

    @model_validator(mode="after")
    def _one_source(self) -> Capture:
        if (self.transforms is None) == (self.colmap is None):
            raise ValueError("capture: give either 'transforms' (a transforms.json) or 'colmap' (a COLMAP model)")
        if self.images is not None and self.colmap is None:
            raise ValueError("capture: 'images' applies to 'colmap' only; remove it")
        return self


class Response(Table):
    """The response curve of the camera, shared by all views, which is recovered along with the parameters."""

    kind: Literal["gamma", "curve"] = "curve"
    """'gamma' is a power of the stored values, after their decoding from sRGB. 'curve' is monotone and piecewise linear
    in the sRGB encoding of both sides."""
    segments: Annotated[Whole, Field(ge=2, le=256, multiple_of=2)] = 16
    """Number of segments of a curve."""
    fix_exponent: Switch = False
    """Fix the middle knot of a curve. Images determine the curve only up to a power if exposures and all emitted
    radiance are free."""
    learning_rate: Positive | None = None
    """Learning rate of the logarithms of the exponent or of the slopes; default: the learning rate of the job."""

    @model_validator(mode="after")
    def _of_one_kind(self) -> Response:
        given = {"segments", "fix_exponent"} & self.model_fields_set
        if self.kind == "gamma" and given:
            raise ValueError(f"response: '{min(given)}' applies to kind = 'curve' only; remove it")
        return self


class Exposure(Table):
    """Scale factors on the rendered image of each view, which are recovered along with the parameters."""

    white_balance: Switch = False
    """Recover one factor per colour channel instead of one per view."""
    reference: Whole | str | None = None
    """View whose factor is fixed at 1. Default: fix the geometric mean of the training views' factors at 1."""
    fix_scale: Switch = True
    """Fix the common scale of the factors. Set it to false if the brightness of the emitters is known: the images then
    determine this scale."""
    learning_rate: Positive | None = None
    """Learning rate of the logarithm of each factor; default: the learning rate of the job."""

    @model_validator(mode="after")
    def _one_scale(self) -> Exposure:
        if not self.fix_scale and self.reference is not None:
            raise ValueError("exposure: fix_scale = false and 'reference' exclude each other; remove one of them")
        return self
