"""The tables of a job about its pictures: the capture that they come from, and the exposure at which each was taken."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from pathreplay.inverse.config.tables import Count, Positive, Switch, Table, Whole


class Capture(Table):
    """Pictures and their cameras, by the file or model that lists them; ``width`` in pixels is that of renderings."""

    transforms: str | None = None
    """A transforms.json of NeRF, instant-ngp or Nerfstudio."""
    colmap: str | None = None
    """Folder of a COLMAP model."""
    images: str | None = None
    """Folder of the images of a COLMAP model; default: ../../images."""
    masks: str | None = None
    """Folder of masks, named as the images with .png behind."""
    width: Count | None = None
    """Width of renderings in pixels; default: that of the images."""
    test_every: Annotated[Whole, Field(ge=2, le=2**31 - 1)] | None = None
    """Hold out the first view and every n-th after it."""

    @property
    def source(self) -> str:
        """What lists the pictures: the path that the job gives."""
        return self.transforms or self.colmap or ""

    @model_validator(mode="after")
    def _one_source(self) -> Capture:
        if (self.transforms is None) == (self.colmap is None):
            raise ValueError("capture: give 'transforms' (a transforms.json) or 'colmap' (the folder of a model)")
        if self.images is not None and self.colmap is None:
            raise ValueError("capture: 'images' is the folder of a COLMAP model's pictures; leave it out")
        return self


class Exposure(Table):
    """Factors on the rendered picture of each view, which are recovered, too."""

    white_balance: Switch = False
    """Recover a factor for each colour."""
    reference: Whole | str | None = None
    """View whose factor stays 1; default: the geometric mean of all stays 1."""
    fix_scale: Switch = True
    """Fix the common scale of all factors; false where the light is known."""
    learning_rate: Positive | None = None
    """Learning rate of the logarithm of a factor; default: that of the job."""

    @model_validator(mode="after")
    def _one_scale(self) -> Exposure:
        if not self.fix_scale and self.reference is not None:
            raise ValueError("exposure: fix_scale = false and 'reference' exclude each other; leave one out")
        return self
