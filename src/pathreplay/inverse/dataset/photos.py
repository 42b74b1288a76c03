"""A photo of a capture with its camera, independent of the format of the capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pathreplay.inverse.dataset.undistortion import Lens


@dataclass(frozen=True)
class Photo:
    """A photo of a capture."""

    where: str
    """Description of the photo in messages."""
    name: str
    """Name of the image in the capture."""
    image: Path
    mask: Path | None
    lens: Lens
    place: np.ndarray
    """4 x 4 camera-to-world matrix in the OpenGL convention (x right, y up, looking along -z)."""
