"""Makes a film of a run as WebP or MP4. Each frame shows the target beside the image of one iteration."""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont

from pathreplay.errors import PathreplayError
from pathreplay.platform.atomic_files import write_whole
from pathreplay.report.live_page import FOLDER, frames
from pathreplay.report.watch.past import pasts
from pathreplay.report.watch.run_files import read_own

# Height of the images, and of the line of text below the images, in pixels.
HEIGHT, TEXT = 288, 24
# Maximum number of textures and volumes that are shown beside the view.
MOST_BESIDE = 2
KINDS = (".webp", ".mp4")


def film(run: Path, output: Path, view: str | None = None, seconds: float = 6.0) -> int:
    """Write a film of a run.

    Args:
        run: run folder.
        output: file to write: .webp or .mp4.
        view: name of the view; default: the first view with frames.
        seconds: duration of the film.

    Returns:
        The number of frames.

    Raises:
        PathreplayError: the folder is not a run folder or has no frames, the file cannot be written, its type is
            unknown, or MP4 is requested without ffmpeg.
    """
    if output.suffix.lower() not in KINDS:
        raise PathreplayError(f"--output {output} is neither .webp nor .mp4; give a name with one of these endings")
    pasts([run])
    pictures = _pictures(run, view)
    pause = max(20, round(1000 * seconds / len(pictures)))
    data = _webp(pictures, pause) if output.suffix.lower() == ".webp" else _mp4(pictures, 1000 / pause)
    write_whole(output, data, "--output")
    return len(pictures)


def _pictures(run: Path, view: str | None) -> list[PIL.Image.Image]:
    by_what: dict[str, dict[int, Path]] = {}
    for iteration, what, path in frames(run):
        by_what.setdefault(what, {})[iteration] = path
    views = [what.removeprefix("view-") for what in by_what if what.startswith("view-")]
    if not views:
        raise PathreplayError(f"Run {run} has no frames in {FOLDER}; run the job with preview.share above 0")
    if view is not None and view not in views:
        raise PathreplayError(f"Run {run} has no frames of view '{view}'; name a view with frames: {', '.join(views)}")
    chosen = view or views[0]
    beside = [what for what in by_what if not what.startswith("view-")][:MOST_BESIDE]
    target = _opened(run / FOLDER / f"target-{chosen}.png")
    whole = [i for i in by_what[f"view-{chosen}"] if all(i in by_what[what] for what in beside)]
    if not whole:
        raise PathreplayError(f"Run {run} has no iteration with frames of '{chosen}' and its textures; start a new run")
    sheets = []
    for i in whole:
        now = {"target": target, f"after {i} iterations": _opened(by_what[f"view-{chosen}"][i])}
        now |= {what.split("-", 1)[1]: _opened(by_what[what][i]) for what in beside}
        sheets.append(now)
    # If a texture or volume was refined during the run, the resolution of its images varies. The sizes of the images in
    # the last frame are used for all frames. Images of few rows are drawn narrower than they are: encoders have a
    # maximum width.
    sizes = [(min(max(2, round(p.width * HEIGHT / p.height)), 4 * HEIGHT), HEIGHT) for p in sheets[-1].values()]
    return [_side_by_side(now, sizes) for now in sheets]


def _side_by_side(pictures: Mapping[str, PIL.Image.Image], sizes: list[tuple[int, int]]) -> PIL.Image.Image:
    """Draw images side by side into one frame, scaled to ``sizes``, with a label below each image.

    The frame's width and height are even, as video encoders require.
    """
    width = sum(w for w, _ in sizes) + 4 * (len(sizes) - 1)
    sheet = PIL.Image.new("RGB", (width + width % 2, HEIGHT + TEXT), (20, 23, 27))
    draw, font, x = PIL.ImageDraw.Draw(sheet), PIL.ImageFont.load_default(14), 0
    for (name, picture), size in zip(pictures.items(), sizes, strict=True):
        # Small images are enlarged without interpolation, so that texels stay square. Large images are reduced by
        # averaging.
        kind = PIL.Image.Resampling.NEAREST if picture.height <= HEIGHT else PIL.Image.Resampling.BOX
        sheet.paste(picture.resize(size, kind), (x, 0))
        draw.text((x + 4, HEIGHT + 3), name[: max(4, size[0] // 8)], fill=(231, 234, 238), font=font)
        x += size[0] + 4
    return sheet


def _opened(path: Path) -> PIL.Image.Image:
    try:
        return PIL.Image.open(io.BytesIO(read_own(path) or b"")).convert("RGB")
    except (OSError, ValueError, PIL.Image.DecompressionBombError):
        raise PathreplayError(f"Image {path} is missing or damaged; start a new run") from None


def _webp(pictures: list[PIL.Image.Image], pause: int) -> bytes:
    """Encode frames that last ``pause`` milliseconds, the last one 1.5 seconds longer."""
    buffer, durations = io.BytesIO(), [pause] * (len(pictures) - 1) + [pause + 1500]
    pictures[0].save(buffer, "webp", save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=85)
    return buffer.getvalue()


def _mp4(pictures: list[PIL.Image.Image], rate: float) -> bytes:
    """Encode frames as a video of ``rate`` frames per second."""
    tool = shutil.which("ffmpeg")
    if tool is None:
        raise PathreplayError(
            "MP4 needs ffmpeg, which is not installed; install it, or give an --output that ends in .webp"
        )
    width, height = pictures[0].size
    data = b"".join(picture.tobytes() for picture in pictures)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "film.mp4")
        command = [
            tool, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
            "-r", f"{rate:.4f}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path),
        ]  # fmt: skip
        done = subprocess.run(command, input=data, capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise PathreplayError(
                f"ffmpeg failed ({said[-1] if said else done.returncode}); use an --output that ends in .webp"
            )
        return path.read_bytes()
