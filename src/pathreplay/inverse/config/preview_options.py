"""What a job says of the pictures that are rendered while it runs: of how many views, how often, at what price."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pathreplay.inverse.config.tables import Finite, Table, Whole


class Preview(Table):
    """A ``share`` of the run's time goes to pictures of some ``views``, at most ``frames`` times; 0: to none."""

    share: Annotated[Finite, Field(ge=0, le=0.5)] = 0.03
    """Fraction of the run's time that goes to previews; 0: none."""
    views: Annotated[Whole, Field(ge=1, le=64)] = 4
    """Views that are rendered."""
    frames: Annotated[Whole, Field(ge=1, le=1000)] = 48
    """Images of each view at most."""
