"""How many samples a job takes, where it says so itself by the signal to noise of its gradients."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Tag, model_validator

from pathreplay.inverse.config.tables import Count, Positive, Table

AUTO = "auto"

# By a discriminator, so that what is neither is judged as a number.
Spp = Annotated[
    Annotated[Count, Tag("count")] | Annotated[Literal["auto"], Tag("auto")],
    Discriminator(lambda value: "auto" if isinstance(value, str) and value == AUTO else "count"),
]


class AdaptiveSpp(Table):
    """With ``spp = "auto"``: the signal to noise that every gradient shall have, and between which samples per pixel.

    These are powers of two, and so are all between them: passes are recorded anew for each.
    """

    target_snr: Positive = 1.0
    """Signal-to-noise ratio that every gradient should have."""
    min: Count = 8
    """Samples per pixel at first and at least; a power of two."""
    max: Count = 256
    """Samples per pixel at most; a power of two."""

    @model_validator(mode="after")
    def _in_order(self) -> AdaptiveSpp:
        for name in ("min", "max"):
            value = getattr(self, name)
            if value < 2 or value & (value - 1):
                near = max(2, 1 << (value.bit_length() - 1))
                raise ValueError(f"adaptive_spp: {name} = {value} is no power of two from 2 on; take {near}")
        if self.min > self.max:
            raise ValueError(f"adaptive_spp: min = {self.min} is above max = {self.max}; swap them")
        return self
