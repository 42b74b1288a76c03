"""Preview images of some views, rendered at intervals during a run for a limited fraction of the run time."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping

import numpy as np
import PIL.Image

from pathreplay.errors import plain_line
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.images.io import Image, displayed, exposure_for, levels
from pathreplay.inverse.images.metrics import Likeness
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.events import Event, Stepped
from pathreplay.inverse.loop.loop import best_values, pictures_of
from pathreplay.inverse.parameters import grids
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.interrupts import Stop
from pathreplay.report.outcome import DIFFERENCE_GAIN, ViewPictures
from pathreplay.report.page_parts import common_exposure, uri
from pathreplay.report.pages import page as pages
from pathreplay.report.pages.page import Picture

# Largest side of the images in a notebook, in pixels.
SMALL_SIDE = 192
# Minimum number of samples per pixel, unless ``eval_spp`` is smaller.
LEAST_SPP = 16

CAPTIONS = {"target": "target", "result": "now", "difference": f"difference ×{DIFFERENCE_GAIN:g}"}


class LivePictures:
    """The most recently rendered images of some views of a run.

    ``before`` contains the images at the initial values by view name. By default, the constructor renders these images.
    """

    def __init__(self, problem: Problem, run: Run, stop: Stop, before: Mapping[str, Image] | None = None) -> None:
        self._problem, self._run, self._stop = problem, run, stop
        preview = problem.config.preview
        self.share = preview.share
        self.exposure = common_exposure((view.target, view.weight) for view in problem.views)
        self.views = _chosen(problem, preview.views) if self.share else []
        start = self._rendered() if before is None else before
        self.before = {view.name: start[view.name] for view in self.views}
        self._set(0, self.before)
        self._began = time.perf_counter()
        self.spent = self._cost = 0.0
        self.why_none = ""
        """Error that ended the rendering of images, or ""."""

    def _set(self, done: int, images: Mapping[str, Image]) -> None:
        self.now = {view.name: _pictures_of(view, self.before[view.name], images[view.name]) for view in self.views}
        self.likenesses = {
            name: Likeness.of(it.result, it.target, it.exposure, it.weight) for name, it in self.now.items()
        }
        self.shown_at = done
        """Number of completed iterations when the latest images were rendered."""

    def observe(self, event: Event) -> None:
        """Render images if they are due.

        `Previews` does not use this method, but calls `is_due`, `look` and `paid` itself.
        """
        if isinstance(event, Stepped) and self.is_due(event.entry.seconds):
            begin = time.perf_counter()
            with self._problem.computing():
                self.look(event.entry.iteration + 1)
            self.paid(time.perf_counter() - begin)

    def is_due(self, seconds: float) -> bool:
        """Return whether images are due after an iteration that took ``seconds``."""
        # Before the first images, their rendering time is unknown. The time of an iteration serves as an estimate.
        allowed = self.share * (time.perf_counter() - self._began)
        return self.share > 0 and self.spent + (self._cost or seconds) <= allowed

    def paid(self, seconds: float) -> None:
        """Record that rendering the latest images took ``seconds``."""
        self._cost = seconds
        self.spent += seconds

    def look(self, done: int) -> dict[str, Image]:
        """Render images after ``done`` iterations, and return them by view name.

        If Mitsuba fails, no more images are rendered, and the result is empty.
        """
        try:
            images = self._rendered()
        except RuntimeError as error:
            if self._stop.aborted:
                raise
            self.share = 0.0
            self.why_none = plain_line(str(error))
            return {}
        self._set(done, images)
        return images

    def _rendered(self) -> dict[str, Image]:
        config = self._problem.config
        spp = max(config.most_spp, min(LEAST_SPP, config.eval_spp))
        values = best_values(self._problem, self._run)
        return dict(pictures_of(self._problem, values, self.views, spp))

    def small(self) -> tuple[pages.View, ...]:
        """Return target, current image and difference of each view as thumbnails (data URIs)."""
        found = []
        for view in self.views:
            shown, stored = self.now[view.name].pictures(), self.stored(view)
            small = {kind: encoded_picture(shown[kind], stored, SMALL_SIDE, "webp") for kind in CAPTIONS}
            pictures = tuple(Picture(kind, CAPTIONS[kind], uri("image/webp", data)) for kind, data in small.items())
            found.append(pages.View(view.name, pictures))
        return tuple(found)

    def losses(self) -> tuple[float, ...]:
        return tuple(entry.loss for entry in self._run.history)

    def stored(self, view: View) -> float:
        """Return the exposure at which images of a view are encoded."""
        return min(self.exposure, exposure_for(levels(view.target, view.weight)))


def _chosen(problem: Problem, count: int) -> list[View]:
    """Choose ``count`` evenly spaced views; up to half of them are test views."""
    test = [view for view in problem.views if view.is_test]
    trained = [view for view in problem.views if not view.is_test]
    test_count = min(len(test), count // 2)
    chosen = {view.name for view in (*_evenly(trained, max(1, count - test_count)), *_evenly(test, test_count))}
    return [view for view in problem.views if view.name in chosen]


def _evenly(views: list[View], count: int) -> list[View]:
    return views if len(views) <= count else [views[i * len(views) // count] for i in range(count)]


def _pictures_of(view: View, before: Image, now: Image) -> ViewPictures:
    exposure = exposure_for(levels(view.target, view.weight))
    return ViewPictures(view.name, view.target, before, now, exposure, None, view.weight, view.is_test)


def encoded_picture(image: Image, exposure: float, side: int, kind: str) -> bytes:
    """Tone-map an image, reduce it to at most ``side`` x ``side`` pixels, and encode it as PNG or lossy WebP."""
    # Downscale before tone mapping, which would convert a large texture to double precision and need much memory.
    pixels = np.round(255 * displayed(grids.shown(image, 2 * side), exposure)).astype(np.uint8)
    picture = PIL.Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels).convert("RGB")
    if max(picture.size) > side:
        factor = side / max(picture.size)
        picture = picture.resize([max(1, round(n * factor)) for n in picture.size], PIL.Image.Resampling.BOX)
    buffer = io.BytesIO()
    picture.save(buffer, kind, **({"quality": 88, "method": 2} if kind == "webp" else {}))
    return buffer.getvalue()
