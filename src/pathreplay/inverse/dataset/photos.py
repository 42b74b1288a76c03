"""One photo of a capture, whichever format lists it: its file, and the lens and place of the camera that took it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pathreplay.inverse.dataset.undistortion import Lens


@dataclass(frozen=True)
class Photo:
    """``where`` stands in messages, ``name`` is the picture's in the file or model that lists it.

    ``place`` takes the camera's axes (x right, y up, looking along -z, as OpenGL has them) to the world: 4 x 4.
    """

    where: str
    name: str
    image: Path
    mask: Path | None
    lens: Lens
    place: np.ndarray
