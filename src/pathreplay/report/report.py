"""The report about a job, its results and their errors, as one self-contained HTML file."""

from __future__ import annotations

import base64
import io
import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version

import mitsuba as mi
import numpy as np
import PIL.Image

from pathreplay import __version__
from pathreplay.inverse.images.io import Image, displayed, png_bytes, resized
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.parameters.grids import shown
from pathreplay.inverse.parameters.pose import error_names
from pathreplay.report.drawing import Axes, Figure, own_settings
from pathreplay.report.outcome import Contestant, Outcome, Recovered, ViewPictures, number_of
from pathreplay.report.page_parts import (
    about,
    common_exposure,
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
from pathreplay.report.pages.document import document
from pathreplay.report.pages.page import Comparison, Head, Mesh, Page, Parameter, Picture, Row, Still, Table, View

# Colours that are readable on light and dark backgrounds.
JOB, BASELINE, GREY = "#3b82f6", "#e07b39", "#808080"

# Largest number of views, and largest total number of pixels in their images. The limits keep the report small enough
# for mail: a noisy pixel takes about four bytes. The run folder contains all views at full resolution.
MOST_VIEWS, MOST_PIXELS = 24, 6_000_000
# Largest number of faces of an interactive mesh, which then takes about 3 MB of the page.
MOST_FACES = 50_000

Film = tuple[Still, ...]

# Largest number of parameters whose errors are plotted in the comparison. The image error is always plotted.
PANELS = 2


def report_files(outcome: Outcome, films: Mapping[str, Film] | None = None) -> dict[str, bytes]:
    """Return the content of report.html, of the files with curves (SVG, PNG) and of summary.png, by file name.

    ``films`` are time-lapse frames by subject; see `live_page.films`.
    """
    contestants = outcome.comparison()
    with own_settings():
        curves = {"loss": loss_figure(outcome.run.history)}
        if contestants:
            curves["comparison"] = comparison_figure(contestants)
        drawings = {f"{name}.{kind}": drawn(curve, kind) for name, curve in curves.items() for kind in ("svg", "png")}
        sheet = summary(outcome)
    sources = {name: uri("image/svg+xml", drawings[f"{name}.svg"]) for name in curves}
    page = report_page(outcome, contestants, sources, films or {})
    return {"report.html": document(page), **drawings, "summary.png": sheet}


def report_page(
    outcome: Outcome, contestants: Sequence[Contestant], drawings: Mapping[str, str], films: Mapping[str, Film]
) -> Page:
    """Return the content of the report. ``drawings`` are the data URIs of the curves by name."""
    config, history = outcome.config, outcome.run.history
    ended = f"Stopped after {len(history)} of {config.iterations} iterations."
    if why := outcome.run.optimiser.finished:
        ended = f"Terminated after {len(history)} of {config.iterations} iterations: {why}."
    test_views, count = len(outcome.test_views()), number_of(outcome.recovered) + len(outcome.poses)
    exposure = common_exposure((view.target, view.weight) for view in outcome.views)
    return Page(
        title=outcome.folder.name,
        lead=lead(config, count, len(outcome.views) - test_views, test_views),
        notices=((ended,) if len(history) < config.iterations else ()) + dropped_notice(history) + _verdict(outcome),
        facts=facts(config, history),
        comparison=_comparison(outcome, contestants, drawings["comparison"]) if contestants else None,
        views=_views(outcome, exposure, films),
        likeness=_likeness(outcome),
        likeness_note=_likeness_note(outcome),
        views_note="Difference: red where the result is brighter than the target, blue where darker."
        + _left_out(outcome),
        exposure=exposure,
        plots=plots(history),
        plots_note=plots_note(history),
        drawing=drawings["loss"],
        parameters=_parameters(outcome, films),
        command=outcome.command(),
        how=(
            *(Row(name, (version,)) for name, version in versions().items()),
            *(Row("note", (note,)) for note in outcome.notes),
            integrator_row(config),
            target_row(config),
        ),
    )


def _verdict(outcome: Outcome) -> tuple[str, ...]:
    verdict = str(outcome.verdict)
    return (f"{verdict[0].upper()}{verdict[1:]}.",)


def _comparison(outcome: Outcome, contestants: Sequence[Contestant], drawing: str) -> Comparison:
    judge = (outcome.config.target.integrator or outcome.config.integrator).type
    heads = [Head(text) for text in ("", "iterations", "seconds", "image error")]
    heads += [Head("error of", key) for key in contestants[0].errors]
    rows = []
    for contestant in contestants:
        run, errors = contestant.run, (contestant.run.picture_error(), *contestant.errors.values())
        cells = (str(len(run.history)), f"{run.seconds():.0f}", *(f"{error:.4g}" for error in errors))
        rows.append(Row(contestant.name, cells))
    note = (
        "Root mean square errors. Image errors exclude render noise; "
        f"{judge} rendered the images of both. The baseline started from the same values, with the same samples per "
        "step and the same seeds. The two runs alternated: after each step of the job, the baseline took steps until "
        "it had used the same time, with the job's learning rate and resolution. The time includes compilation, but "
        "not the evaluation of the errors."
    )
    title = f"Comparison with {contestants[1].name} at equal time"
    return Comparison(title, drawing, Table(tuple(heads), tuple(rows)), note)


def _likeness(outcome: Outcome) -> Table:
    heads = ["", "PSNR, initial", "PSNR, result", "SSIM, initial", "SSIM, result"]
    flips, exposed = outcome.has_flip(), any(view.factors for view in outcome.views)
    heads += ["FLIP, initial", "FLIP, result"] * flips + ["recovered exposure"] * exposed
    rows = []
    for view in outcome.views:
        before, after = view.likenesses["start"], view.likenesses["result"]
        cells = [f"{before.psnr:.2f} dB", f"{after.psnr:.2f} dB", f"{before.ssim:.4f}", f"{after.ssim:.4f}"]
        if flips:
            cells += ["" if likeness.flip is None else f"{likeness.flip:.4f}" for likeness in (before, after)]
        if exposed:
            cells.append("× " + ", ".join(f"{factor:.3f}" for factor in view.factors))
        rows.append(Row(view.name + " (test view)" * view.is_test, tuple(cells)))
    return Table(tuple(Head(text) for text in heads), tuple(rows))


def _likeness_note(outcome: Outcome) -> str:
    note = "Metrics of the displayed image of each view at its own exposure, including render noise."
    if outcome.test_views():
        note += " Test views are excluded from the optimization"
        note += "; their exposures are fitted to their targets at the end." if outcome.config.exposure else "."
        note += "" if outcome.has_flip() else " FLIP of test views needs: pip install 'pathreplay[flip]'."
    return note


def _shown(outcome: Outcome) -> tuple[list[ViewPictures], float]:
    """Return the views whose images are in the report, and the factor for the width and height of these images."""
    views = list(outcome.views)
    if len(views) > MOST_VIEWS:
        views = [views[i * len(views) // MOST_VIEWS] for i in range(MOST_VIEWS)]
    pixels = sum(view.target[..., 0].size * len(view.pictures()) for view in views)
    return views, min(1.0, (MOST_PIXELS / pixels) ** 0.5)


def _left_out(outcome: Outcome) -> str:
    views, scale = _shown(outcome)
    note = ""
    if len(views) < len(outcome.views):
        note += f" {len(views)} of the {len(outcome.views)} views are shown; images/ has all of them."
    if scale < 1:
        note += f" Images are scaled to {100 * scale:.0f} % of the width and height of those in images/."
    return note


def _views(outcome: Outcome, exposure: float, films: Mapping[str, Film]) -> tuple[View, ...]:
    sections = []
    views, scale = _shown(outcome)
    for view in views:
        stored = min(exposure, view.exposure)
        pictures = tuple(
            Picture(kind, outcome.caption(kind), uri("image/png", png_bytes(_smaller(image, scale), stored)))
            for kind, image in view.pictures().items()
        )
        mask = " and weighted by the mask" if view.weight is not None else ""
        note = (
            f"RMS difference from the target: {view.error(view.start):.4g} initially, "
            f"{view.error(view.result):.4g} in the result, including render noise{mask}. Shown at exposure "
            f"{stored:.3g}."
        )
        film = films.get(f"view-{view.name}", ())
        sections.append(View(view.name, pictures, stored, view.exposure, view.is_test, note, film))
    return tuple(sections)


def _mesh(item: Recovered) -> Mesh | None:
    """Return an interactive mesh with the initial value, the result and the truth of a parameter.

    The result is None if the parameter has no faces or too many.
    """
    if item.faces is None or item.faces.size > 3 * MOST_FACES:
        return None
    known = {
        kind: value for kind, value in item.known("start", "result", "truth").items() if value.size == item.result.size
    }
    packed = {kind: base64.b64encode(value.astype("<f4").tobytes()).decode() for kind, value in known.items()}
    return Mesh(packed, base64.b64encode(item.faces.astype("<u4").tobytes()).decode())


def _smaller(image: Image, scale: float) -> Image:
    if scale == 1:
        return image
    return resized(image, max(1, round(image.shape[0] * scale)), max(1, round(image.shape[1] * scale)))


def _parameters(outcome: Outcome, films: Mapping[str, Film]) -> tuple[Parameter, ...]:
    """Return the sections about textures, volumes, numbers, poses and other parameters, in this order."""

    def pictures(images: Mapping[str, Image]) -> tuple[Picture, ...]:
        return tuple(
            Picture(kind, outcome.caption(kind), uri("image/png", png_bytes(image))) for kind, image in images.items()
        )

    baseline = outcome.names()[1]
    kinds: list[list[Parameter]] = [[], [], [], []]
    for item in outcome.recovered:
        if images := item.textures():
            film = films.get(f"texture-{item.file_name}", ())
            kinds[0].append(Parameter(item.key, pictures(images), note=about(item), film=film))
        elif images := item.volumes():
            film = films.get(f"volume-{item.file_name}", ())
            kinds[1].append(Parameter(item.key, pictures(images), 2, note=about(item, baseline), film=film))
        elif rows := numbers(item):
            kinds[2].append(Parameter(item.key, rows=rows))
        else:
            kinds[3].append(Parameter(item.key, note=about(item), mesh=_mesh(item)))
    poses = [Parameter(item.pose.key, rows=pose_rows(item), note=pose_note(item)) for item in outcome.poses]
    return (*kinds[0], *kinds[1], *kinds[2], *poses, *kinds[3])


def loss_figure(history: Sequence[Entry]) -> Figure:
    """Plot the loss against the iteration, on a logarithmic scale if any loss is positive."""
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([entry.iteration for entry in history], [entry.loss for entry in history], color=JOB, linewidth=1.5)
    if any(entry.loss > 0 for entry in history):
        axes.set_yscale("log")
    axes.set_ylabel("loss")
    _plain(axes, "iteration")
    return figure


def comparison_figure(contestants: Sequence[Contestant]) -> Figure:
    """Plot the errors of two runs against time, in one panel per error.

    The panels show the error of the images, and the errors of the first `PANELS` parameters or poses. The errors of
    poses are drawn on a logarithmic scale, and all other errors on a linear scale.
    """
    panels = [None, *list(contestants[0].errors)[:PANELS]]
    figure = Figure(figsize=(4.4 * len(panels), 3.0), layout="constrained")
    for axes, key in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for contestant, colour in zip(contestants, (JOB, BASELINE), strict=True):
            history = contestant.run.history
            seconds = np.cumsum([entry.seconds for entry in history])
            errors = [entry.picture_error if key is None else entry.errors.get(key) for entry in history]
            points = [(s, error) for s, error in zip(seconds, errors, strict=True) if error is not None]
            marker = "o" if key is None else None
            x, y = [s for s, _ in points], [error for _, error in points]
            axes.plot(x, y, color=colour, linewidth=1.5, marker=marker, markersize=3, label=contestant.name)
        if key is not None and key.endswith(error_names("")):
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        axes.set_title("image error" if key is None else f"error of {key}", fontsize=9, color=GREY)
        _plain(axes, "seconds")
    axes.legend(frameon=False, labelcolor=GREY)
    return figure


def drawn(figure: Figure, kind: str) -> bytes:
    """Encode the figure as 'svg' with a transparent background, or as 'png'."""
    buffer = io.BytesIO()
    # Omit the date, so that the same run gives the same bytes.
    metadata = {"Date": None} if kind == "svg" else None
    figure.savefig(buffer, format=kind, transparent=kind == "svg", metadata=metadata)
    return buffer.getvalue()


def _plain(axes: Axes, along: str) -> None:
    axes.set_xlabel(along)
    axes.grid(True, color=GREY, alpha=0.25, linewidth=0.5)
    axes.tick_params(which="both", colors=GREY)
    for part in (axes.xaxis.label, axes.yaxis.label):
        part.set_color(GREY)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


# Largest number of views in summary.png. It is also the largest total number of textures and volumes.
SUMMARY_ROWS = 3
SUMMARY_SIDE = 512
"""Side in pixels to which larger images are downscaled, to save memory. Images are drawn with a width of 210 pixels."""
SUMMARY_ASPECT = 8.0
"""Largest ratio of the sides of a drawn image. Longer images, such as a texture with one column, are distorted."""


def summary(outcome: Outcome) -> bytes:
    """Draw summary.png, with a row of images for each view, texture and volume.

    The row of a view shows target, initial image, result and difference.
    """
    rows = [(v.name, v.pictures(), v.exposure) for v in outcome.views[:SUMMARY_ROWS]]
    grids = [(r.key, r.textures() or r.volumes()) for r in outcome.recovered]
    rows += [(key, images, 1.0) for key, images in [row for row in grids if row[1]][:SUMMARY_ROWS]]
    columns = max(len(images) for _, images, _ in rows)
    # Row heights in inches: images are 2.1 inches wide, and titles are 0.2 inches high.
    ratios = [image.shape[0] / image.shape[1] for _, images, _ in rows for image in [images["start"]]]
    heights = [0.2 + 2.1 * min(max(ratio, 1 / SUMMARY_ASPECT), SUMMARY_ASPECT) for ratio in ratios]
    figure = Figure(figsize=(2.1 * columns, sum(heights)), layout="constrained", dpi=100)
    grid = figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights)
    for line, (name, pictures, exposure), ratio in zip(grid, rows, ratios, strict=True):
        undistorted = 1 / SUMMARY_ASPECT <= ratio <= SUMMARY_ASPECT
        for axes in line:
            axes.axis("off")
        for column, (kind, image) in enumerate(pictures.items()):
            pixels = displayed(shown(image, SUMMARY_SIDE), exposure)
            line[column].imshow(pixels, interpolation="nearest", vmin=0, vmax=1, cmap="gray")
            line[column].set_aspect("equal" if undistorted else "auto")
            label = outcome.caption(kind)
            short = name if len(name) <= 24 else f"…{name[-23:]}"  # a longer title is wider than an image
            line[column].set_title(label if column else f"{short}: {label}", fontsize=8)
    # Reduce the image to 256 colours, so that noisy images are small enough for a README or a mail. The palette is an
    # argument, because Pillow does not dither if it chooses the palette itself.
    picture = PIL.Image.open(io.BytesIO(drawn(figure, "png"))).convert("RGB")
    buffer = io.BytesIO()
    picture.quantize(palette=picture.quantize(256)).save(buffer, "png", optimize=True)
    return buffer.getvalue()


def versions() -> dict[str, str]:
    """Return the versions of packages and the properties of the system that affect the results of a run, by name."""
    return {
        "pathreplay": __version__,
        "Mitsuba": version("mitsuba"),
        "Dr.Jit": version("drjit"),
        "variant": mi.variant(),
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }
