"""The report: what was asked, what came out, how far it is from the truth, as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import io
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import jinja2
import mitsuba as mi
import numpy as np
import PIL.Image
from matplotlib.figure import Figure

from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.images import displayed, encoded, png_bytes
from pathreplay.inverse.outcome import Contestant, Outcome
from pathreplay.inverse.pose import error_names

# Colours that read on light and dark ground alike.
OURS, RIVAL, GREY = "#3b82f6", "#e07b39", "#808080"

# So many parameters get a panel of their own beside that of the pictures.
PANELS = 2


def report_files(outcome: Outcome) -> dict[str, bytes]:
    """report.html, the curves (SVG, PNG) and summary.png, as file name -> content."""
    curves = {"loss": loss_figure(outcome.run.history)}
    contestants = outcome.comparison()
    if contestants:
        curves["comparison"] = comparison_figure(contestants)
    drawings = {f"{name}.{kind}": drawn(curve, kind) for name, curve in curves.items() for kind in ("svg", "png")}
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pathreplay.inverse", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["swatch"] = swatch
    html = environment.get_template("report.html.j2").render(
        outcome=outcome,
        data_uri=lambda image, exposure=1.0: _uri("image/png", png_bytes(image, exposure)),
        curves={name: _uri("image/svg+xml", drawings[f"{name}.svg"]) for name in curves},
        contestants=contestants,
        versions=versions(),
    )
    return {"report.html": html.encode(), **drawings, "summary.png": summary(outcome)}


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


def summary(outcome: Outcome) -> bytes:
    """One PNG with everything side by side: a row per view (target, start, result, difference), texture and volume."""
    rows = [(v.name, v.pictures(), v.exposure) for v in outcome.views[:SUMMARY_ROWS]]
    shown = [(r.key, r.textures() or r.volumes()) for r in outcome.recovered]
    rows += [(key, images, 1.0) for key, images in [row for row in shown if row[1]][:SUMMARY_ROWS]]
    columns = max(len(images) for _, images, _ in rows)
    # As high as its picture, which is 2.1 wide, and 0.2 for the title.
    heights = [0.2 + 2.1 * image.shape[0] / image.shape[1] for _, images, _ in rows for image in [images["start"]]]
    figure = Figure(figsize=(2.1 * columns, sum(heights)), layout="constrained", dpi=100)
    grid = figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights)
    for line, (name, pictures, exposure) in zip(grid, rows, strict=True):
        for axes in line:
            axes.axis("off")
        for column, (kind, image) in enumerate(pictures.items()):
            line[column].imshow(displayed(image, exposure), interpolation="nearest", vmin=0, vmax=1, cmap="gray")
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


def swatch(values: list[float]) -> str:
    """A CSS colour for linear RGB; brighter than white is scaled to full brightness, hue kept."""
    colour = np.array(values, dtype=np.float32).clip(min=0)
    return "#" + "".join(f"{round(float(c) * 255):02x}" for c in encoded(colour / max(1.0, float(colour.max()))))


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
