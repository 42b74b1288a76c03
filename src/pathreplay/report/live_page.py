"""Writes the live page of a run and its preview images, and reacts to the file that requests a stop.

The folder ``previews`` contains the content of the page (``page.json``), the images of the page, and the frames of
time-lapse films. The names of the frames have the form ITERATION-WHAT-NAME.webp, where WHAT is view, texture or volume.
A run can be resumed without these files. A preview that cannot be rendered or written is omitted, and the run goes on.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from pydantic import TypeAdapter

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.events import Event, Notes, Started, Stepped, Stopped
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.interrupts import Stop
from pathreplay.report.live_pictures import CAPTIONS, LivePictures, encoded_picture
from pathreplay.report.outcome import Recovered, number_of
from pathreplay.report.page_parts import (
    about,
    dropped_notice,
    facts,
    integrator_row,
    lead,
    numbers,
    plots,
    plots_note,
    pose_note,
    pose_rows,
    target_row,
    uri,
)
from pathreplay.report.pages import page as pages
from pathreplay.report.pages.page import Page, Parameter, Picture, Still
from pathreplay.report.recovered import poses_of, recovered_of
from pathreplay.runs.run_folder import RunFolder

FOLDER, PAGE, STOP = "previews", "previews/page.json", "stop"
BUTTON = "the stop button"
FRAME = re.compile(r"(\d{6,})-((?:view|texture|volume)-.+)\.webp")

# Minimum seconds between two updates of the page, and minimum ratio of this pause to the duration of an update.
PAUSE_S, PAUSE = 1.0, 100
# Largest side in pixels of images on the page, and of time-lapse frames.
LARGEST, FRAME_SIDE = 1024, 384
# Limit for the total size of the time-lapse frames in a report, in bytes, which keeps the report small.
MOST_FILM_BYTES = 2_000_000

PAGES = TypeAdapter(Page)


class Previews:
    """Observer that updates the page of a run, and sets ``stop`` when the file `STOP` appears in the run folder."""

    def __init__(
        self, folder: RunFolder, config: Config, problem: Problem, run: Run, before: Mapping[str, Image], stop: Stop
    ) -> None:
        self.folder, self.config, self.problem, self.run, self.stop = folder, config, problem, run, stop
        self.pictures = LivePictures(problem, run, stop, before)
        self._began = self._written = time.perf_counter()
        self._pause = PAUSE_S
        self._resumed, self._stride = 0, 1.0
        self._kept = [0]
        self._stale = (folder.path / STOP).exists()  # whether a stop request remains from an earlier part of the run
        self._log: list[str] = list(problem.notes)
        self._notes = Notes()

    def observe(self, event: Event) -> None:
        """Update the page after an event. Errors of rendering and writing do not end the run."""
        if note := self._notes.of(event):
            self._log.append(note)
        if isinstance(event, Started):
            self._log.append(f"iterations {event.done} to {event.wanted}")
            self._resumed = event.done
            if event.done == 0:
                shown = self.pictures
                self._write(self._begun() | (self._frames(0, shown.before) if shown.share else {}))
        elif isinstance(event, Stepped):
            if event.entry.iteration == self._resumed:
                self._continued()
            if self.stop.by is None and (self.folder.path / STOP).exists():
                self.stop.by = BUTTON
            self._stepped(event.entry.iteration + 1, event.entry.seconds)
        elif isinstance(event, Stopped):
            self.folder.discard([STOP])
            by, took = f" by {self.stop.by}" if self.stop.by else "", time.perf_counter() - self._began
            self._log.append(f"ended after {event.done} iterations{by}")
            self._log.append(f"previews took {self.pictures.spent:.1f} of {took:.1f} s")
            self._write({})

    def finished(self, after: Mapping[str, Image]) -> dict[str, tuple[Still, ...]]:
        """Add a last frame with the result to each time-lapse film, and return the frames for the report, by subject.

        Subjects are view-NAME, texture-NAME and volume-NAME. ``after`` contains the final image of each view, by name.
        """
        if self.pictures.share:
            with contextlib.suppress(PathreplayError):
                shown = {name: after[name] for name in self.pictures.before}
                self.folder.write(self._frames(len(self.run.history), shown))
        return films(self.folder.path, MOST_FILM_BYTES)

    def _stepped(self, done: int, seconds: float) -> None:
        now = time.perf_counter()
        if self.pictures.is_due(seconds):
            files = self._render_previews(done)
            dropped = self._dropped_frames(done)
            self._write(files, dropped)
            self.pictures.paid(time.perf_counter() - now)
        elif now - self._written >= self._pause:
            self._write({})

    def _dropped_frames(self, done: int) -> set[int]:
        """Record that iteration ``done`` has frames, and return the iterations whose frames must be removed.

        The first and the latest frames stay. The frames in between are thinned to about equal intervals.
        """
        kept = self._kept
        dropped = {kept.pop()} if len(kept) > 1 and kept[-1] - kept[-2] < self._stride else set()
        kept.append(done)
        if len(kept) > self.config.preview.frames + 1:
            dropped |= set(kept[1:-1:2])
            kept[:] = [i for i in kept if i not in dropped]
            self._stride = (kept[-1] - kept[0]) / max(1, len(kept) - 1)
        return dropped

    def _remove_frames(self, dropped: Callable[[int], bool]) -> None:
        names = (f"{FOLDER}/{path.name}" for iteration, _, path in frames(self.folder.path) if dropped(iteration))
        self.folder.discard(names)

    def _render_previews(self, done: int) -> dict[str, bytes]:
        """Render the views with the current values, and return the preview files by name."""
        images = self.pictures.look(done)
        if self.pictures.why_none:
            self._log.append(f"no more previews: {self.pictures.why_none}")
            return {}
        return self._frames(done, images) | self._of_views("result", "difference")

    def _of_views(self, *kinds: str) -> dict[str, bytes]:
        """Encode the images of each view, and return the encoded images by file name.

        If ``kinds`` are given, only images of these kinds are encoded.
        """
        files, shown = {}, self.pictures
        for view in shown.views:
            for kind, image in shown.now[view.name].pictures().items():
                if not kinds or kind in kinds:
                    name = f"{FOLDER}/{kind}-{view.name}.png"
                    files[name] = encoded_picture(image, shown.stored(view), LARGEST, "png")
        return files

    def _begun(self) -> dict[str, bytes]:
        """Return the first preview files by name.

        The files contain images of the views, and the initial and true values of textures and volumes.
        """
        files = self._of_views()
        for item in recovered_of(self.problem, self.run):
            for kind, image in _grids(item).items():
                files[_address(kind, item)] = encoded_picture(image, 1.0, LARGEST, "png")
        return files

    def _frames(self, done: int, images: Mapping[str, Image]) -> dict[str, bytes]:
        shown = {}
        for view in self.pictures.views:
            shown[f"view-{view.name}"] = (images[view.name], self.pictures.stored(view))
        for item in recovered_of(self.problem, self.run):
            for what, images_by_kind in (("texture", item.textures()), ("volume", item.volumes())):
                if images_by_kind:
                    shown[f"{what}-{item.file_name}"] = (images_by_kind["result"], 1.0)
        return {
            f"{FOLDER}/{done:06d}-{name}.webp": encoded_picture(image, exposure, FRAME_SIDE, "webp")
            for name, (image, exposure) in shown.items()
        }

    def _continued(self) -> None:
        """Clean up files of an earlier part of the run. Called after the first step, when resuming has succeeded.

        A killed run may have written frames after its last checkpoint. These frames are removed, because the resumed
        run repeats the iterations after the checkpoint.
        """
        self._remove_frames(lambda iteration: iteration > self._resumed)
        self._kept = sorted({0, *(iteration for iteration, _, _ in frames(self.folder.path))})
        if self._stale:
            self.folder.discard([STOP])
        if self._resumed:
            self._write(self._begun())

    def _write(self, files: Mapping[str, bytes], dropped: Collection[int] = ()) -> None:
        """Write images, remove the frames of the ``dropped`` iterations, and write the page."""
        begin = time.perf_counter()
        with contextlib.suppress(PathreplayError):  # if the disk is full, the next checkpoint reports the error
            if files:
                self.folder.write(files)
            if dropped:
                self._remove_frames(dropped.__contains__)
            self.folder.write({PAGE: PAGES.dump_json(self._page())})
        self._written = time.perf_counter()
        self._pause = max(PAUSE_S, PAUSE * (self._written - begin))

    def _page(self) -> Page:
        config, history = self.config, self.run.history
        learned = len(self.problem.trained())
        done, wanted = len(history), config.iterations
        (_, first), *others = facts(config, history)
        stopping = (f"Stop requested by {self.stop.by}.",) if self.stop.by else ()
        shown = films(self.folder.path)
        return Page(
            title=self.folder.path.name,
            lead=lead(config, self._count(), learned, len(self.problem.views) - learned),
            notices=stopping + dropped_notice(history),
            facts=((f"{done} of {wanted}", first), *others),
            views=tuple(self._view(view, shown) for view in self.pictures.views),
            views_note=f"{len(self.pictures.views)} of {len(self.problem.views)} views, last rendered after "
            f"{self.pictures.shown_at} iterations. Difference: red where brighter than the target, blue where darker.",
            exposure=self.pictures.exposure,
            plots=plots(history),
            plots_note=plots_note(history),
            parameters=self._parameters(shown),
            command=self.folder.resume_command(),
            how=(integrator_row(config), target_row(config)),
            log=tuple(self._log),
            titles={"plots": "Curves", "parameters": "Parameters", "how": "How to resume"},
        )

    def _view(self, view: View, shown: Mapping[str, tuple[Still, ...]]) -> pages.View:
        it, stored = self.pictures.now[view.name], self.pictures.stored(view)
        pictures = tuple(
            Picture(kind, CAPTIONS.get(kind, kind), f"{FOLDER}/{kind}-{view.name}.png?{self.pictures.shown_at}")
            for kind in it.pictures()
        )
        likeness = self.pictures.likenesses[view.name]
        note = (
            f"RMS difference from the target {it.error(it.result):.4g}, PSNR {likeness.psnr:.2f} dB, "
            f"SSIM {likeness.ssim:.4f}, including render noise."
        )
        film = shown.get(f"view-{view.name}", ())
        return pages.View(view.name, pictures, stored, it.exposure, view.is_test, note, film)

    def _count(self) -> int:
        items = recovered_of(self.problem, self.run)
        return number_of(items) + len(self.problem.poses)

    def _parameters(self, shown: Mapping[str, tuple[Still, ...]]) -> tuple[Parameter, ...]:
        parameters = []
        for item in recovered_of(self.problem, self.run):
            film = shown.get(f"texture-{item.file_name}") or shown.get(f"volume-{item.file_name}") or ()
            pictures = [
                Picture(kind, kind, _address(kind, item)) for kind in ("start", "truth") if kind in _grids(item)
            ]
            if film:
                pictures.insert(1, Picture("now", f"after {film[-1].iteration} iterations", film[-1].src))
            rows = numbers(item)
            note = "" if rows else about(item)
            parameters.append(Parameter(item.key, tuple(pictures), rows=rows, note=note, film=film))
        for pose in poses_of(self.problem, self.run):
            parameters.append(Parameter(pose.pose.key, rows=pose_rows(pose), note=pose_note(pose)))
        return tuple(parameters)


def _grids(item: Recovered) -> dict[str, Image]:
    """Return the initial and the true value (if known) of a texture or volume as images, by kind.

    The dictionary is empty for other parameters.
    """
    return {kind: image for kind, image in (item.textures() or item.volumes()).items() if kind in ("start", "truth")}


def _address(kind: str, item: Recovered) -> str:
    return f"{FOLDER}/{kind}-of-{item.file_name}.png"


def frames(run: Path) -> Iterator[tuple[int, str, Path]]:
    """Yield iteration, subject and file of each time-lapse frame in a run folder, in order of the iterations.

    The subject names the view, texture or volume that the frame shows, for example 'view-front'.
    """
    matches = [(FRAME.fullmatch(path.name), path) for path in (run / FOLDER).glob("*.webp") if not path.is_symlink()]
    yield from sorted((int(match[1]), match[2], path) for match, path in matches if match)


def films(run: Path, most_bytes: int | None = None) -> dict[str, tuple[Still, ...]]:
    """Return the time-lapse frames of a run by subject; see `frames`.

    With ``most_bytes``, frames are embedded as data URIs. Only every n-th frame is then returned, so that the total
    size of the frames is about ``most_bytes``. Without ``most_bytes``, all frames are returned, with addresses relative
    to the run folder.
    """
    stills_of: dict[str, list[tuple[int, Path]]] = {}
    for iteration, what, path in frames(run):
        stills_of.setdefault(what, []).append((iteration, path))
    if most_bytes is None:
        return {
            what: tuple(Still(iteration, f"{FOLDER}/{path.name}") for iteration, path in stills)
            for what, stills in stills_of.items()
        }
    sizes = sum(path.stat().st_size for stills in stills_of.values() for _, path in stills)
    step = max(1, -(-sizes // most_bytes))
    kept = {
        what: [s for i, s in enumerate(reversed(stills)) if i % step == 0][::-1] for what, stills in stills_of.items()
    }
    return {
        what: tuple(Still(iteration, uri("image/webp", path.read_bytes())) for iteration, path in stills)
        for what, stills in kept.items()
        if len(stills) > 1
    }
