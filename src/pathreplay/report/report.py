"""The report: what was asked, what came out, how far it is from the truth, as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import io
import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import mitsuba as mi
import numpy as np
import PIL.Image

from pathreplay.inverse.images.io import Image, displayed, png_bytes, resized
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.parameters.grids import shown
from pathreplay.inverse.parameters.pose import error_names
from pathreplay.report.drawing import Figure, own_settings
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

# Colours that read on light and dark ground alike.
OURS, RIVAL, GREY = "#3b82f6", "#e07b39", "#808080"

# A report is opened in a mail, too: pictures of so many views, of so many pixels in all (a noisy one takes about four
# bytes of the page). The others, and the whole ones, are files in the run folder.
MOST_VIEWS, MOST_PIXELS = 24, 6_000_000
# Of a mesh that can be turned about: some 3 MB of the page.
MOST_FACES = 50_000

Film = tuple[Still, ...]

# So many parameters get a panel of their own beside that of the pictures.
PANELS = 2


def report_files(outcome: Outcome, films: Mapping[str, Film] | None = None) -> dict[str, bytes]:
    """report.html, the curves (SVG, PNG) and summary.png, as file name -> content; ``films`` are by view and key."""
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
    """What the report says; ``drawings`` are the addresses of the curves by name."""
    config, history = outcome.config, outcome.run.history
    ended = f"Stopped after {len(history)} of {config.iterations} iterations."
    if why := outcome.run.optimiser.finished:
        ended = f"No more steps after {len(history)} of {config.iterations} iterations: {why}."
    test_views, count = len(outcome.test_views()), number_of(outcome.recovered) + len(outcome.poses)
    exposure = common_exposure([view.target for view in outcome.views])
    return Page(
        title=outcome.folder.name,
        lead=lead(config, count, len(outcome.views) - test_views, test_views),
        notices=((ended,) if len(history) < config.iterations else ()) + dropped_notice(history) + _verdict(outcome),
        facts=facts(config, history),
        comparison=_comparison(outcome, contestants, drawings["comparison"]) if contestants else None,
        views=_views(outcome, exposure, films),
        likeness=_likeness(outcome),
        likeness_note=_likeness_note(outcome),
        views_note="Difference: red where the result is brighter than the target, blue where it is darker."
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
    said = str(outcome.verdict)
    return (f"{said[0].upper()}{said[1:]}.",)


def _comparison(outcome: Outcome, contestants: Sequence[Contestant], drawing: str) -> Comparison:
    judge = (outcome.config.target.integrator or outcome.config.integrator).type
    heads = [Head(text) for text in ("", "iterations", "seconds", "error of the pictures")]
    heads += [Head("error of", key) for key in contestants[0].errors]
    rows = []
    for each in contestants:
        measured = (each.run.picture_error(), *each.errors.values())
        cells = (str(len(each.run.history)), f"{each.run.seconds():.0f}", *(f"{error:.4g}" for error in measured))
        rows.append(Row(each.name, cells))
    note = (
        "Root mean square errors. Those of the pictures are without the noise of rendering them; "
        f"{judge} rendered them for both. The baseline started from the same values and had the same samples per step "
        "and seeds. Both took turns: after each step the baseline took as many as brought it to the same time, with "
        "the learning rate and resolution of the other. Compiling counts, judging does not."
    )
    title = f"Next to {contestants[1].name}, in the same time"
    return Comparison(title, drawing, Table(tuple(heads), tuple(rows)), note)


def _likeness(outcome: Outcome) -> Table:
    heads = ["", "PSNR at the start", "in the result", "SSIM at the start", "in the result"]
    flips, exposed = outcome.has_flip(), any(view.factors for view in outcome.views)
    heads += ["FLIP at the start", "in the result"] * flips + ["exposure found"] * exposed
    rows = []
    for view in outcome.views:
        before, after = view.likenesses["start"], view.likenesses["result"]
        cells = [f"{before.psnr:.2f} dB", f"{after.psnr:.2f} dB", f"{before.ssim:.4f}", f"{after.ssim:.4f}"]
        if flips:
            cells += ["" if each.flip is None else f"{each.flip:.4f}" for each in (before, after)]
        if exposed:
            cells.append("× " + ", ".join(f"{factor:.3f}" for factor in view.factors))
        rows.append(Row(view.name + " (held out)" * view.is_test, tuple(cells)))
    return Table(tuple(Head(text) for text in heads), tuple(rows))


def _likeness_note(outcome: Outcome) -> str:
    said = "Of what a display shows of each view at an exposure of its own, noise included."
    if outcome.test_views():
        said += " Nothing was learned from views that are held out"
        said += "; their exposures are fitted to their pictures at the end." if outcome.config.exposure else "."
        said += "" if outcome.has_flip() else " FLIP of them comes with: pip install 'pathreplay[flip]'."
    return said


def _shown(outcome: Outcome) -> tuple[list[ViewPictures], float]:
    """The views whose pictures are in the report, and by how much these are made smaller, for it to stay a page."""
    views = list(outcome.views)
    if len(views) > MOST_VIEWS:
        views = [views[i * len(views) // MOST_VIEWS] for i in range(MOST_VIEWS)]
    pixels = sum(view.target[..., 0].size * len(view.pictures()) for view in views)
    return views, min(1.0, (MOST_PIXELS / pixels) ** 0.5)


def _left_out(outcome: Outcome) -> str:
    views, scale = _shown(outcome)
    said = ""
    if len(views) < len(outcome.views):
        said += f" Pictures of {len(views)} of the {len(outcome.views)} views are here, of all of them in images/."
    if scale < 1:
        said += f" Pictures are {100 * scale:.0f} % as wide and high as those in images/."
    return said


def _views(outcome: Outcome, exposure: float, films: Mapping[str, Film]) -> tuple[View, ...]:
    found = []
    views, scale = _shown(outcome)
    for view in views:
        stored = min(exposure, view.exposure)
        pictures = tuple(
            Picture(kind, outcome.caption(kind), uri("image/png", png_bytes(_smaller(image, scale), stored)))
            for kind, image in view.pictures().items()
        )
        mask = ", where its mask is" if view.weight is not None else ""
        note = (
            f"Root mean square difference from the target: {view.error(view.start):.4g} at the start, "
            f"{view.error(view.result):.4g} in the result, noise included{mask}. Shown at exposure {stored:.3g}."
        )
        film = films.get(f"view-{view.name}", ())
        found.append(View(view.name, pictures, stored, view.exposure, view.is_test, note, film))
    return tuple(found)


def _mesh(item: Recovered) -> Mesh | None:
    """The meshes of start, result and truth to turn about, where there are not too many faces for a page."""
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
    """Textures, volumes, numbers, poses, and what is none of these."""

    def pictures(images: Mapping[str, Image]) -> tuple[Picture, ...]:
        made = {kind: uri("image/png", png_bytes(image)) for kind, image in images.items()}
        return tuple(Picture(kind, outcome.caption(kind), source) for kind, source in made.items())

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
    """Loss against iteration, logarithmic."""
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([entry.iteration for entry in history], [entry.loss for entry in history], color=OURS, linewidth=1.5)
    if any(entry.loss > 0 for entry in history):
        axes.set_yscale("log")
    axes.set_ylabel("loss")
    _plain(axes, "iteration")
    return figure


def comparison_figure(contestants: Sequence[Contestant]) -> Figure:
    """Errors against seconds of two runs: of the pictures, and of the first keys; of poses on a logarithmic scale."""
    panels = [None, *list(contestants[0].errors)[:PANELS]]
    figure = Figure(figsize=(4.4 * len(panels), 3.0), layout="constrained")
    for axes, key in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for contestant, colour in zip(contestants, (OURS, RIVAL), strict=True):
            history = contestant.run.history
            seconds = np.cumsum([entry.seconds for entry in history])
            errors = [entry.picture_error if key is None else entry.errors.get(key) for entry in history]
            found = [(s, error) for s, error in zip(seconds, errors, strict=True) if error is not None]
            marker = "o" if key is None else None
            points = zip(*found, strict=True)
            axes.plot(*points, color=colour, linewidth=1.5, marker=marker, markersize=3, label=contestant.name)
        if key is not None and key.endswith(error_names("")):
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        axes.set_title("error of the pictures" if key is None else f"error of {key}", fontsize=9, color=GREY)
        _plain(axes, "seconds")
    axes.legend(frameon=False, labelcolor=GREY)
    return figure


def drawn(figure: Figure, kind: str) -> bytes:
    """The figure as the bytes of an image file ('svg', with a transparent ground, or 'png')."""
    buffer = io.BytesIO()
    # No date in the file: the same run gives the same bytes.
    metadata = {"Date": None} if kind == "svg" else None
    figure.savefig(buffer, format=kind, transparent=kind == "svg", metadata=metadata)
    return buffer.getvalue()


def _plain(axes: Any, along: str) -> None:
    axes.set_xlabel(along)
    axes.grid(True, color=GREY, alpha=0.25, linewidth=0.5)
    axes.tick_params(which="both", colors=GREY)
    for part in (axes.xaxis.label, axes.yaxis.label):
        part.set_color(GREY)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


# At most so many views and textures in summary.png: it is an overview, the report has them all.
SUMMARY_ROWS = 3
SUMMARY_SIDE = 512
"""Pixels along a side of one of them, which is 210 wide: more would only take memory."""


def summary(outcome: Outcome) -> bytes:
    """One PNG with everything side by side: a row per view (target, start, result, difference), texture and volume."""
    rows = [(v.name, v.pictures(), v.exposure) for v in outcome.views[:SUMMARY_ROWS]]
    grids = [(r.key, r.textures() or r.volumes()) for r in outcome.recovered]
    rows += [(key, images, 1.0) for key, images in [row for row in grids if row[1]][:SUMMARY_ROWS]]
    columns = max(len(images) for _, images, _ in rows)
    # As high as its picture, which is 2.1 wide, and 0.2 for the title.
    heights = [0.2 + 2.1 * image.shape[0] / image.shape[1] for _, images, _ in rows for image in [images["start"]]]
    figure = Figure(figsize=(2.1 * columns, sum(heights)), layout="constrained", dpi=100)
    grid = figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights)
    for line, (name, pictures, exposure) in zip(grid, rows, strict=True):
        for axes in line:
            axes.axis("off")
        for column, (kind, image) in enumerate(pictures.items()):
            pixels = displayed(shown(image, SUMMARY_SIDE), exposure)
            line[column].imshow(pixels, interpolation="nearest", vmin=0, vmax=1, cmap="gray")
            label = outcome.caption(kind)
            short = name if len(name) <= 24 else f"…{name[-23:]}"  # what fits over a picture
            line[column].set_title(label if column else f"{short}: {label}", fontsize=8)
    # 256 colours: fewer bytes for noisy pictures, fit for a README or a mail. With a palette given, Pillow dithers.
    picture = PIL.Image.open(io.BytesIO(drawn(figure, "png"))).convert("RGB")
    buffer = io.BytesIO()
    picture.quantize(palette=picture.quantize(256)).save(buffer, "png", optimize=True)
    return buffer.getvalue()


def versions() -> dict[str, str]:
    """What a run depends on besides its config."""
    return {
        "pathreplay": version("pathreplay"),
        "Mitsuba": version("mitsuba"),
        "Dr.Jit": version("drjit"),
        "variant": mi.variant(),
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }
