"""The measured scenes. All are generated here or by Mitsuba; none is read from a file."""

from __future__ import annotations

from collections.abc import Callable

from .caustics import CAUSTIC_SCENES
from .edges import EDGE_SCENES
from .media import MEDIA_SCENES
from .movers import MOVING_SCENES
from .parts import SceneDict
from .sheets import SHEET_SCENES
from .surfaces import METAL_SCENES, SURFACE_SCENES
from .wide import WIDE_SCENES

#: Scene by name: resolution -> dictionary for mi.load_dict (with optimize=False, to keep the keys).
SCENES: dict[str, Callable[[int], SceneDict]] = (
    SURFACE_SCENES
    | METAL_SCENES
    | MEDIA_SCENES
    | SHEET_SCENES
    | EDGE_SCENES
    | MOVING_SCENES
    | WIDE_SCENES
    | CAUSTIC_SCENES
)
