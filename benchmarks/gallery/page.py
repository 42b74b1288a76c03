"""Writes the gallery: an image for each run, the record of all runs, and the page that is made from it."""

from __future__ import annotations

import json
from dataclasses import asdict
from io import BytesIO
from pathlib import Path

from PIL import Image
from pydantic import TypeAdapter, ValidationError

from pathreplay.errors import PathreplayError

from ..drafts import ROOT
from .entries import ENTRIES, Entry
from .runs import Run

RECORD = Path(__file__).parent / "record.json"
PAGE = ROOT / "docs" / "gallery.md"
IMAGES = ROOT / "docs" / "images" / "gallery"
KINDS = "start", "result", "target"
HEIGHT = 240
"""Height of an image in pixels. Smaller images are enlarged by a whole number."""
GAP = 8
MOST_BYTES = 150_000

_RECORD = TypeAdapter(dict[str, Run])

# ------------------------------ Images ------------------------------


def image_of(entry: Entry, folder: Path) -> bytes:
    """Return a PNG with start, result and target of a view, side by side, of at most `MOST_BYTES`."""
    names = sorted(path.stem.removeprefix("target-") for path in (folder / "images").glob("target-*.png"))
    if not names or (entry.view and entry.view not in names):
        raise PathreplayError(f"{folder} has no image of view '{entry.view}'; it has {', '.join(names) or 'none'}")
    view = entry.view or names[0]
    parts = [resized(Image.open(folder / "images" / f"{kind}-{view}.png").convert("RGB")) for kind in KINDS]
    width, height = parts[0].size
    joined = Image.new("RGB", (3 * width + 2 * GAP, height), "white")
    for n, part in enumerate(parts):
        joined.paste(part, (n * (width + GAP), 0))
    return png_of(joined)


def resized(image: Image.Image) -> Image.Image:
    """Return the image with a height of about `HEIGHT`: enlarged pixel by pixel, or reduced."""
    width, height = image.size
    if height <= HEIGHT:
        factor = max(1, HEIGHT // height)
        return image.resize((factor * width, factor * height), Image.Resampling.NEAREST)
    return image.resize((round(width * HEIGHT / height), HEIGHT), Image.Resampling.LANCZOS)


def png_of(image: Image.Image) -> bytes:
    """Return a PNG of at most `MOST_BYTES`: with all colours if possible, else with 256, else smaller."""
    for candidate in (image, image.quantize(256)):
        if len(data := _png(candidate)) <= MOST_BYTES:
            return data
    width, height = image.size
    return png_of(image.resize((width * 4 // 5, height * 4 // 5), Image.Resampling.LANCZOS))


def _png(image: Image.Image) -> bytes:
    file = BytesIO()
    image.save(file, "png", optimize=True)
    return file.getvalue()


# ------------------------------ Record and page ------------------------------


def read_record() -> dict[str, Run]:
    """Return the runs of the record by name. Raises PathreplayError if the file is damaged."""
    if not RECORD.exists():
        return {}
    try:
        return _RECORD.validate_json(RECORD.read_bytes())
    except ValidationError as error:
        raise PathreplayError(f"{RECORD} is not a record ({error.error_count()} errors); remove it") from None


def write_record(record: dict[str, Run]) -> None:
    """Write the record, in the order of the gallery."""
    ordered = {entry.name: asdict(record[entry.name]) for entry in ENTRIES if entry.name in record}
    RECORD.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")


def page(record: dict[str, Run]) -> str:
    """Return docs/gallery.md."""
    parts = [
        "# Gallery",
        "This page shows what the jobs in `examples/` recover. Each row shows the image at the start, the image of the "
        "result, and the target. `python -m benchmarks.gallery` makes the runs, the images and this page. The time of "
        "a run is the time of all its iterations, on an otherwise idle machine.",
        *(section(entry, record.get(entry.name)) for entry in ENTRIES),
    ]
    return "\n\n".join(parts) + "\n"


def section(entry: Entry, found: Run | None) -> str:
    """Return the section of an entry."""
    commands = "\n".join(f"    {command}" for command in entry.commands)
    parts = [f"## {entry.title}", entry.text]
    if found is None:
        return "\n\n".join([*parts, commands, "*Not run yet.*"])
    picture = f"![Start, recovered and target](images/gallery/{entry.name}.png)"
    loss = f"The loss falls from {found.losses[0]:.2g} to {found.losses[1]:.2g} in {found.iterations} iterations"
    when = f"{found.processor}, {found.processors} cores, {found.date[:10]}"
    timed = f", which take {lasts(found.seconds)}" if found.idle else ""
    note = "" if found.idle else " The time is not known, because the machine was busy."
    return "\n\n".join([*parts, picture, commands, f"{loss}{timed} ({when}).{note}"])


def lasts(seconds: float) -> str:
    """Return a duration in words."""
    return f"{seconds:.0f} seconds" if seconds < 100 else f"{seconds / 60:.1f} minutes"
