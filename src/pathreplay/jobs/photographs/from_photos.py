"""`from_photos` writes a job that recovers a scene from photographs.

It resamples the photographs to pinhole cameras, and chooses the region of the scene, initial values and stages.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.images.io import exr_bytes, notes_on_metadata
from pathreplay.jobs.photographs.job_text import Choices, field_scene, job_text, mesh_scene
from pathreplay.jobs.photographs.mesh import GREY, Proxy, read_proxy
from pathreplay.jobs.photographs.pictures import Prepared, frames_of, prepare
from pathreplay.jobs.photographs.plan import StagePlan, plan_stages
from pathreplay.jobs.photographs.reading import TRANSFORMS, find_photos
from pathreplay.jobs.photographs.region import Box, find_region, near_clip, sky_rows
from pathreplay.jobs.photographs.timing import measure, measure_poses
from pathreplay.platform import backend
from pathreplay.platform.atomic_files import whole_folder

JOB = "job.toml"
OPTICAL_DEPTH = 1.5
"""Optical depth of the initial medium along the longest side of the region."""
OPAQUE = 5.0
"""Upper bound of the optical depth of a voxel of the finest grid. The cost of a path grows with the largest density."""
COARSE = 32
"""Voxels along the longest side of the initial grids; stages resample them."""
NO_CLIP = 1e-3
HEADROOM = 1.3
"""Upper bound of the radiance, relative to the brightest pixel."""


@dataclass(frozen=True)
class PhotoJob:
    """A job that `from_photos` has written."""

    folder: Path
    notes: list[str]
    """Lines for the user about choices and omissions."""

    @property
    def job(self) -> Path:
        """The job file, for `pathreplay.optimize`."""
        return self.folder / JOB


def from_photos(
    folder: str | Path,
    output: str | Path,
    *,
    mesh: str | Path | None = None,
    minutes: float = 30.0,
    test_every: int = 5,
    width: int | None = None,
    refine_poses: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> PhotoJob:
    """Write a job that recovers a scene from photographs with poses. Activates a Mitsuba variant if none is active.

    Args:
        folder: folder with a transforms.json or a COLMAP model and its images.
        output: new folder for the job, its scene and the prepared images.
        mesh: PLY or OBJ file of the scene's geometry in the coordinates of the capture. Default: a density grid.
        minutes: time limit of the run on this machine, from which the number of iterations follows.
        test_every: the first photo and every n-th photo after it are test views.
        width: width in pixels to which the photographs are resampled, rounded to a multiple of 8. By default, the
            resampled photographs have about 46 000 pixels each.
        refine_poses: also optimise the poses of the photographs.
        tell: receives lines about the progress.

    Returns:
        The job; run it with ``pathreplay.optimize(result.job)``.

    Raises:
        PathreplayError: the capture or the mesh cannot be read, or an option is out of range.
    """
    _require_options(minutes, test_every, width)
    backend.set_variant(None)
    output, found = Path(output), find_photos(Path(folder))
    notes = found.notes() + notes_on_metadata("photo", {photo.name: photo.image for photo in found.photos})
    trained = len(found.photos) - len(range(0, len(found.photos), test_every))
    frames = frames_of(found.photos, width)
    tell(f"{len(frames)} photos of {found.source}: {trained} to train, {len(frames) - trained} test views")
    region = find_region(frames)
    proxy = None if mesh is None else read_proxy(Path(mesh))
    with whole_folder(output, "--output") as part:
        prepared, entries = _Summary(), []
        for photo, frame in zip(found.photos, frames, strict=True):
            picture = prepare(photo, frame)
            _write(part, picture.files())
            entries.append(picture.entry())
            prepared.add(picture)
        _write(
            part, {TRANSFORMS: (json.dumps({"camera_model": "PINHOLE", "frames": entries}, indent=1) + "\n").encode()}
        )
        has_sky = not prepared.transparent
        _write_start(part, region, prepared.mean, sky_rows(frames), proxy)
        text = field_scene(region, has_sky) if proxy is None else mesh_scene(proxy.stored, proxy.kind, proxy.textured)
        _write(part, {"scene.xml": text.encode()})
        size = max(frame.width for frame in frames), max(frame.height for frame in frames)
        near = near_clip(frames) if proxy is None else NO_CLIP
        speed = measure(part / "scene.xml", frames, near)
        tell(f"this machine renders {speed.samples / 1e6:.2g} million samples per second")
        posed = measure_poses(part / "scene.xml", frames, near) if refine_poses else None
        stages = plan_stages(speed, minutes, trained, *size, posed)
        densest = OPAQUE * stages[-1].resolution / float(region.size.max())
        choices = Choices(has_sky or proxy is not None, refine_poses, near, HEADROOM * prepared.peak, densest)
        key = None if proxy is None else proxy.key
        text = job_text(str(folder), str(output / JOB), stages, choices, test_every, key)
        _write(part, {JOB: text.encode()})
    corners = " to ".join("(" + ", ".join(f"{x:.3g}" for x in corner) + ")" for corner in (region.low, region.high))
    notes.append(f"region: {corners}" if proxy is None else f"geometry: {mesh}")
    notes.append(_stages_note(stages, *size))
    return PhotoJob(output, notes)


def _stages_note(stages: Sequence[StagePlan], width: int, height: int) -> str:
    parts = [f"{s.iterations} iterations at {width // s.downscale} x {height // s.downscale} pixels" for s in stages]
    return "stages: " + ", ".join(parts)


def _require_options(minutes: float, test_every: int, width: int | None) -> None:
    if not 0 < minutes < 1e5:
        raise PathreplayError(f"minutes is {shown(minutes)}; give a positive number of minutes")
    if not isinstance(test_every, Integral) or test_every < 2:
        raise PathreplayError(f"test_every is {shown(test_every)}; give a whole number of at least 2")
    if width is not None and not 16 <= width <= 8192:
        raise PathreplayError(f"width is {shown(width)}; give the width of the compared images, 16 to 8192 pixels")


class _Summary:
    """Mean colour and largest value of the prepared images, and whether some of them are transparent."""

    def __init__(self) -> None:
        self._sum, self._count, self.peak, self.transparent = np.zeros(3), 0.0, 0.0, False

    def add(self, picture: Prepared) -> None:
        weight = np.ones((*picture.image.shape[:2], 1)) if picture.weight is None else picture.weight
        self._sum += (picture.image * weight).sum(axis=(0, 1))
        self._count += float(weight.sum())
        self.peak = max(self.peak, float(picture.image.max()))
        self.transparent |= picture.transparent

    @property
    def mean(self) -> np.ndarray:
        """Mean colour of the images, with components of at least 0.01."""
        return np.maximum(self._sum / self._count, 0.01)


def _write(folder: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def _write_start(folder: Path, region: Box, mean: np.ndarray, rows: int, proxy: Proxy | None) -> None:
    """Write the initial values: a faint medium or a grey mesh, and a sky with ``rows`` rows, in the mean colour."""
    start = folder / "start"
    start.mkdir()
    sky = np.broadcast_to(mean, (rows, 2 * rows, 3)).astype(np.float32)
    _write(folder, {"start/sky.exr": exr_bytes(sky)})
    if proxy is not None:
        proxy.write(start)
        if proxy.textured:
            _write(folder, {"start/texture.exr": exr_bytes(np.full((256, 256, 3), GREY, np.float32))})
        return
    longest = float(region.size.max())
    shape = tuple(max(2, round(COARSE * side / longest)) for side in region.size[::-1])
    density = np.full((*shape, 1), OPTICAL_DEPTH / longest, np.float32)
    radiance = np.broadcast_to(mean, (*shape, 3)).astype(np.float32)
    mi.VolumeGrid(density).write(str(start / "density.vol"))
    mi.VolumeGrid(np.ascontiguousarray(radiance)).write(str(start / "radiance.vol"))
