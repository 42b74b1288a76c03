"""Samples per pixel of a job: a fixed number, or adapted to the signal-to-noise ratio of its gradients."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Tag, model_validator

from pathreplay.inverse.config.tables import Count, Positive, Table

AUTO = "auto"

# All values except "auto" are validated as integers. An error message then describes the integer that is expected.
Spp = Annotated[
    Annotated[Count, Tag("count")] | Annotated[Literal["auto"], Tag("auto")],
    Discriminator(lambda value: "auto" if isinstance(value, str) and value == AUTO else "count"),
]


class AdaptiveSpp(Table):
    """Target signal-to-noise ratio and bounds of the samples per pixel, for ``spp = "auto"``.

    The number of samples is always a power of two, because kernels must be recorded again for each new number.
    """

    target_snr: Positive = 1.0
    """Signal-to-noise ratio that the gradient of every parameter should reach."""
    min: Count = 8
    """Initial and smallest number of samples per pixel; a power of two."""
    max: Count = 256
    """Largest number of samples per pixel; a power of two."""

    @model_validator(mode="after")
    def _in_order(self) -> AdaptiveSpp:
        for name in ("min", "max"):
            value = getattr(self, name)
            if value < 2 or value & (value - 1):
                near = max(2, 1 << (value.bit_length() - 1))
                raise ValueError(f"adaptive_spp: {name} = {value} is not a power of two (2, 4, ...); use {near}")
        if self.min > self.max:
            raise ValueError(f"adaptive_spp: min = {self.min} is above max = {self.max}; swap them")
        return self
