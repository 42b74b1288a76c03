"""Finds the capture in a folder: a `transforms.json`, or a COLMAP model with its images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.dataset.colmap import photos_of_colmap
from pathreplay.inverse.dataset.photos import Photo
from pathreplay.inverse.dataset.transforms_json import photos_of_json
from pathreplay.inverse.images.io import picture_size
from pathreplay.platform.files import file_problem

TRANSFORMS = "transforms.json"
MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0", "undistorted/sparse")
"""Folders of a COLMAP model, relative to the folder of the capture."""
FEWEST = 3
"""Smallest number of photos from which a scene is recovered."""
_NAMED = 5


@dataclass(frozen=True)
class Found:
    """The photos of a capture."""

    photos: list[Photo]
    source: Path
    """The transforms.json, or the folder of the COLMAP model."""
    missing: list[str]
    """Names of images of the capture that do not exist, whose frames are left out."""

    def notes(self) -> list[str]:
        """Return a list with a line for the user if photos are left out, because their image files do not exist."""
        if not self.missing:
            return []
        names = ", ".join(self.missing[:_NAMED]) + (", ..." if len(self.missing) > _NAMED else "")
        return [
            f"{self.source} names {len(self.missing)} images that do not exist ({names}): these frames are left out, "
            f"{len(self.photos)} remain"
        ]


def find_photos(folder: Path) -> Found:
    """Read the photos of a capture, without those whose image file does not exist.

    Args:
        folder: folder with a transforms.json or a COLMAP model, or the path of a transforms.json.

    Raises:
        PathreplayError: there is no capture, it cannot be read, or fewer than three of its images exist.
    """
    missing: list[str] = []
    source = folder if folder.suffix == ".json" else folder / TRANSFORMS
    images = source.parent
    if not file_problem(source):
        photos = photos_of_json(source, picture_size, missing)
    elif (model := _model(folder)) is not None:
        source, images = model, _images(folder, model)
        photos = photos_of_colmap(model, images, None, picture_size, missing)
    elif folder.is_dir():
        raise PathreplayError(
            f"{folder} has neither {TRANSFORMS} nor a COLMAP model (cameras.bin in {', '.join(MODELS)}); recover the "
            "poses first, for example with: colmap automatic_reconstructor --workspace_path . --image_path images"
        )
    else:
        raise PathreplayError(f"No folder {shown(str(folder))}; give the folder of a capture, with its {TRANSFORMS}")
    if len(photos) < FEWEST:
        raise PathreplayError(
            f"{source}: {len(photos)} of {len(photos) + len(missing)} images exist in {images}; add the image files, "
            f"at least {FEWEST}"
        )
    return Found(photos, source, missing)


def _model(folder: Path) -> Path | None:
    named = (folder / name for name in MODELS)
    return next((path for path in named for e in (".bin", ".txt") if not file_problem(path / f"cameras{e}")), None)


def _images(folder: Path, model: Path) -> Path:
    places = [folder / "images", model / "images", model.parent / "images", model / ".." / ".." / "images"]
    return next((path for path in places if path.is_dir()), folder)
