"""The curves of the report: loss against iteration, and errors against seconds next to a rival."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.outcome import Contestant

# Colours that read on light and dark ground alike.
OURS, RIVAL, GREY = "#3b82f6", "#e07b39", "#808080"

# So many parameters get a panel of their own beside that of the pictures.
PANELS = 2


def loss_figure(history: Sequence[Entry]) -> Figure:
    """Loss against iteration, logarithmic."""
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([entry.iteration for entry in history], [entry.loss for entry in history], color=OURS, linewidth=1.5)
    if any(entry.loss > 0 for entry in history):
        axes.set_yscale("log")
    axes.set_xlabel("iteration")
    axes.set_ylabel("loss")
    _plain(axes)
    return figure


def comparison_figure(contestants: Sequence[Contestant]) -> Figure:
    """Errors against seconds of two runs: of the pictures, and of the first keys."""
    panels = [None, *list(contestants[0].errors)[:PANELS]]
    figure = Figure(figsize=(4.4 * len(panels), 3.0), layout="constrained")
    for axes, key in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for contestant, colour in zip(contestants, (OURS, RIVAL), strict=True):
            history = contestant.run.history
            seconds = np.cumsum([entry.seconds for entry in history])
            if key is None:
                found = [(s, e.picture_error) for s, e in zip(seconds, history, strict=True) if e.picture_error]
            else:
                found = [(s, e.errors[key]) for s, e in zip(seconds, history, strict=True)]
            marker = "o" if key is None else None
            points = zip(*found, strict=True)
            axes.plot(*points, color=colour, linewidth=1.5, marker=marker, markersize=3, label=contestant.name)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("seconds")
        axes.set_title("error of the pictures" if key is None else f"error of {key}", fontsize=9, color=GREY)
        _plain(axes)
    axes.legend(frameon=False, labelcolor=GREY)
    return figure


def drawn(figure: Figure, kind: str) -> bytes:
    """The figure as the bytes of an image file ('svg', with a transparent ground, or 'png')."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    # No date in the file: the same run gives the same bytes.
    metadata = {"Date": None} if kind == "svg" else None
    figure.savefig(buffer, format=kind, transparent=kind == "svg", metadata=metadata)
    return buffer.getvalue()


def _plain(axes: Any) -> None:
    axes.grid(True, color=GREY, alpha=0.25, linewidth=0.5)
    axes.tick_params(which="both", colors=GREY)
    for part in (axes.xaxis.label, axes.yaxis.label):
        part.set_color(GREY)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
