"""Preview images of a job: number of views, number of frames and time budget."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pathreplay.inverse.config.tables import Finite, Table, Whole


class Preview(Table):
    """Images that are rendered during a run, for its live page and its report."""

    share: Annotated[Finite, Field(ge=0, le=0.5)] = 0.03
    """Fraction of the run's time spent on previews; 0 disables them."""
    views: Annotated[Whole, Field(ge=1, le=64)] = 4
    """Number of views to render."""
    frames: Annotated[Whole, Field(ge=1, le=1000)] = 48
    """Maximum number of images per view."""
