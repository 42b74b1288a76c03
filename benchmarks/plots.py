"""Draws the figures of docs/evidence.md from the saved records: log-log plots with error bars and labelled lines.

Colours are those of Okabe and Ito, which colour-blind readers can distinguish; markers differ as well, for print.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from scipy.stats import gmean

from . import records
from .drafts import ROOT
from .measures.estimates import Estimate, Versus, bias_share
from .measures.job import Point, Record
from .pages import PICTURES
from .tables import groups
from .tasks import depth, media, noise, quality

IMAGES = ROOT / "docs" / "images"

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, RED, PINK, GREY = "#0072B2", "#D55E00", "#CC79A7", "#888888"

#: Colour and marker by method.
LOOKS = {
    "sweep": (BLUE, "o"),
    "score": (BLUE, "o"),
    "replay": (SKY, "s"),
    "no branch": (SKY, "s"),
    "listing": (GREEN, "D"),
    "prb": (RED, "^"),
    "prbvolpath": (RED, "^"),
    "prb_basic": (ORANGE, "v"),
    "naive AD": (PINK, "P"),
    "RB": (BLACK, "X"),
    "linear RB": (GREY, "d"),
}
TITLES = {depth.SURFACES: "surfaces: a closed box", depth.MEDIA: "media: a sealed room of fog"}
LABEL_SIZE = 9
# Fraction of a pass's variance above which |bias|² is reported: it exceeds the noise of a mean over twenty passes.
BIASED = 0.05
# Minimum distance of two labels, as a fraction of the height of the axes.
APART = 0.055


def draw_all(folder: Path = IMAGES, load: Callable[[str], Record | None] = records.load) -> list[Path]:
    """Draw every figure that has a record; returns the SVG and PNG files."""
    drawn: list[Path] = []
    for task, pictures in PICTURES.items():
        record = load(task)
        if record is not None:
            # A fixed hash salt and no date make the file a function of the record.
            with mpl.rc_context({"svg.hashsalt": "pathreplay", "font.size": 10}):
                for name in pictures:
                    drawn += _write(DRAW[name](record), folder / name)
    return drawn


def _write(figure: Figure, stem: Path) -> list[Path]:
    stem.parent.mkdir(parents=True, exist_ok=True)
    svg, png = stem.with_suffix(".svg"), stem.with_suffix(".png")
    figure.savefig(svg, metadata={"Date": None})
    figure.savefig(png, dpi=120)
    return [svg, png]


# ------------------------------ Depth ------------------------------


def _depth_time(record: Record) -> Figure:
    """Seconds of the fastest round, with an error bar up to the slowest."""

    def seconds(point: Point) -> tuple[float, float, float]:
        return min(point.seconds), 0.0, max(point.seconds) - min(point.seconds)

    return _against_depth(record, seconds, "seconds of a gradient pass")


def _depth_memory(record: Record) -> Figure:
    return _against_depth(record, lambda point: (point.peak_mib or np.nan, 0.0, 0.0), "peak memory of the process, MiB")


def _against_depth(record: Record, value: Callable[[Point], tuple[float, float, float]], name: str) -> Figure:
    """Plot ``value`` (with the lengths of its error bar down and up) against depth, one panel per scene."""
    scenes = list(dict.fromkeys(point.scene for point in record.points))
    figure, panels = _panels(len(scenes), width=5.0)
    for axes, scene in zip(panels, scenes, strict=True):
        part = depth.of_scene(record, scene)
        labels: list[tuple[float, float, str, str]] = []
        for method in dict.fromkeys(point.method for point in part.points):
            points = depth.alive(part, method)
            if not points:
                continue
            x = [point.max_depth for point in points]
            y, down, up = np.transpose([value(point) for point in points])
            colour, marker = LOOKS[method]
            axes.errorbar(x, y, yerr=[down, up], color=colour, marker=marker, markersize=4, linewidth=1.3, capsize=2)
            labels.append((x[-1], y[-1], method, colour))
        axes.set(xscale="log", yscale="log", xlabel="path length (max_depth)", title=TITLES.get(scene, scene))
        low, high = axes.get_ylim()
        if high < 100 * low:  # too small a range for powers of ten, and flat lines need space below
            axes.set_ylim(low / 2, max(1.2 * high, 4 * low))
            axes.set_yticks(ticks := _powers(2, *axes.get_ylim()), [f"{n}" for n in ticks])
        axes.set_xticks(ticks := _powers(4, *axes.get_xlim()), [f"{n}" for n in ticks])
        axes.minorticks_off()
        _label_ends(axes, labels)
    panels[0].set_ylabel(name)
    return figure


def _powers(base: int, low: float, high: float) -> list[int]:
    return [base**k for k in range(1, 24) if low <= base**k <= high]


# ------------------------------ Media ------------------------------


def _media_efficiency(record: Record) -> Figure:
    """Bars of efficiency relative to prbvolpath, grouped by scene and parameter."""
    figure, (axes,) = _panels(1, width=7.5, height=4.6)
    names: list[str] = []
    at = 0.0
    found = [(key, methods) for key, methods in groups(record.points).items() if _efficiencies(methods)]
    ticks = []
    for (scene, parameters, *_), methods in reversed(found):
        bars = _efficiencies(methods)
        ticks.append(at + (len(bars) - 1) / 2)
        names.append(f"{scene}, {media.WHAT[parameters[0]]}")
        for method, gain in reversed(bars.items()):
            error = [[gain.value - gain.low], [gain.high - gain.value]]
            colour, far = LOOKS[method][0], max(1.0, gain.high)
            axes.barh(at, gain.value - 1, 0.8, left=1, color=colour, xerr=error, error_kw={"capsize": 2, "lw": 1})
            told = f"{method}  {gain.value:.2g}x{', biased' if _is_biased(methods[method]) else ''}"
            axes.annotate(told, (far, at), va="center", fontsize=8, **_beside("right"))
            at += 1
        at += 0.8
    axes.axvline(1, color=RED, linewidth=1.2)
    axes.annotate("prbvolpath", (1, at - 0.8), color=RED, va="bottom", fontsize=LABEL_SIZE, **_beside("right"))
    axes.set(xscale="log", xlabel="time x variance of prbvolpath over that of the method (more is better)")
    axes.set_yticks(ticks, names)
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, 0.7), high * 2.5)  # room for the labels
    axes.set_ylim(-0.8, at + 0.1)
    axes.grid(False, axis="y")
    axes.minorticks_off()
    return figure


def _is_biased(point: Point) -> bool:
    if point.method == media.REFERENCE or not point.bias_products:
        return False
    return bias_share(point.bias_products, point.squared_errors).low > BIASED


def _efficiencies(methods: dict[str, Point]) -> dict[str, Estimate]:
    baseline = methods.get(media.RIVAL)
    if baseline is None or not baseline.squared_errors:
        return {}
    return {
        name: Versus(point, baseline).efficiency()
        for name, point in methods.items()
        if point is not baseline and point.squared_errors
    }


# ------------------------------ Noise of replay ------------------------------


def _replay_noise(record: Record) -> Figure:
    """Plot the error against the noise level: a panel per kind of bookkeeping, a line per number of bounces."""
    scene = "diffuse sheets"
    points = [point for point in record.points if point.scene == scene and not point.error]
    depths = sorted({point.max_depth for point in points})
    kinds = [kind for kind in noise.KINDS if any(point.method.startswith(kind) for point in points)]
    figure, panels = _panels(len(kinds), width=3.6, share=True)
    colours = [SKY, GREEN, ORANGE, RED, BLACK]
    ends: list[list[tuple[float, float, str, str]]] = []
    for axes, kind in zip(panels, kinds, strict=True):
        labels: list[tuple[float, float, str, str]] = []
        ends.append(labels)
        for max_depth, colour in zip(depths, colours, strict=False):
            cells = {p.method: p for p in points if p.max_depth == max_depth}
            told = [(level, cells.get(f"{kind}, {level:g}")) for level in noise.NOISES]
            line = [(level, point.values) for level, point in told if point is not None and _finite(point)]
            if not line:
                continue
            x = [level for level, _ in line]
            y = [gmean(values) for _, values in line]
            bars = [[a - min(v) for a, (_, v) in zip(y, line, strict=True)]]
            bars.append([max(v) - a for a, (_, v) in zip(y, line, strict=True)])
            axes.errorbar(x, y, yerr=bars, color=colour, marker="o", markersize=4, linewidth=1.3, capsize=2)
            labels.append((x[-1], y[-1], f"{max_depth - 1} bounces", colour))
        sweeps = [v for p in points if p.method == noise.SWEEP and _finite(p) for v in p.values]
        if sweeps:
            typical = gmean(sweeps)
            axes.axhline(typical, color=GREY, linewidth=1.3, linestyle="--")
            if kind == kinds[-1]:
                monte_carlo = axes.annotate(
                    "Monte Carlo error of one pass",
                    (noise.NOISES[0], typical),
                    xytext=(8, 3),
                    textcoords="offset points",
                    color="#555555",
                    ha="right",
                    fontsize=8,
                )
                monte_carlo.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
        axes.set(xscale="log", yscale="log", title=kind, xlabel="noise put into the Jacobians")
    # The shared axis limits are only known after all lines are drawn.
    for axes, labels in zip(panels, ends, strict=True):
        _label_ends(axes, labels, "left")
    panels[0].set_ylabel("error of the gradient, relative to the sweep")
    return figure


def _finite(point: Point) -> bool:
    return len(point.values) > 0 and bool(np.isfinite(point.values).all())


# ------------------------------ Held-out error ------------------------------


def _quality_curves(record: Record) -> Figure:
    """A panel for each problem: three seeds of each loop, and the marks."""
    problems = {scene: points for (scene, *_), points in groups(record.points).items()}
    rows = -(-len(problems) // 4)
    figure = Figure(figsize=(3.6 * min(len(problems), 4), 3.1 * rows), layout="constrained")
    panels = figure.subplots(rows, min(len(problems), 4), squeeze=False).ravel()
    for axes in panels[len(problems) :]:
        axes.set_axis_off()
    for axes, (scene, points) in zip(panels, problems.items(), strict=False):
        stock = iter((RED, ORANGE, PINK, BLACK))
        own = iter((BLUE, SKY, GREEN, GREY))
        for method, point in points.items():
            colour, label = next(stock if quality.is_stock(point) else own), method
            for curve in quality.runs(point):
                relative = np.array(curve.errors) / curve.errors[0]
                axes.plot(curve.seconds[1:], relative[1:], color=colour, linewidth=1.1, label=label)
                label = None
        for mark in quality.MARKS:
            axes.axhline(mark, color="#bbbbbb", linewidth=0.7, linestyle="--", zorder=0)
        axes.set(xscale="log", yscale="log")
        axes.set_title(scene, fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=7, frameon=False, loc="lower left")
    figure.supxlabel("seconds", fontsize=9)
    figure.supylabel("held-out error / initial", fontsize=9)
    return figure


# ------------------------------ Parts ------------------------------


def _panels(count: int, width: float, height: float = 3.8, share: bool = False) -> tuple[Figure, Sequence[Axes]]:
    figure = Figure(figsize=(width * count, height), layout="constrained")
    panels: Any = figure.subplots(1, count, squeeze=False, sharey=share)[0]
    for axes in panels:
        axes.grid(True, color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.title.set_fontsize(10)
    return figure, panels


def _label_ends(axes: Axes, labels: Sequence[tuple[float, float, str, str]], side: str = "right") -> None:
    """Write labels (x, y, name, colour) beside the ends of their lines, moved apart where they would overlap."""
    low, high = np.log(axes.get_ylim())
    left, right = axes.get_xlim()
    room = (right / left) ** (0.28 if side == "right" else 0.5)
    axes.set_xlim((left, right * room) if side == "right" else (left / room, right))
    for end in dict.fromkeys(x for x, *_ in labels):
        group = sorted((label for label in labels if label[0] == end), key=lambda label: label[1])
        heights = (np.log([y for _, y, _, _ in group]) - low) / (high - low)
        for (x, _, name, colour), height in zip(group, _spread(heights), strict=True):
            at = (x, float(np.exp(low + height * (high - low))))
            text = axes.annotate(name, at, color=colour, va="center", fontsize=LABEL_SIZE, **_beside(side))
            text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
    axes.set_ylim(*np.exp((low, high)))


def _spread(heights: np.ndarray) -> np.ndarray:
    """Move increasing heights as little as possible to a distance of at least APART; each cluster keeps its mean."""
    clusters = [[height] for height in heights]
    k = 1
    while k < len(clusters):
        lower, upper = clusters[k - 1], clusters[k]
        reach = APART * (len(lower) + len(upper)) / 2
        if np.mean(upper) - np.mean(lower) < reach:
            clusters[k - 1 : k + 1] = [lower + upper]
            k = max(1, k - 1)
        else:
            k += 1
    middles = [np.mean(cluster) + APART * (np.arange(len(cluster)) - (len(cluster) - 1) / 2) for cluster in clusters]
    return np.concatenate(middles)


def _beside(side: str) -> dict[str, Any]:
    """Arguments of `annotate` that place the text on this side of the point."""
    sign, align = (1, "left") if side == "right" else (-1, "right")
    return {"xytext": (7 * sign, 0), "textcoords": "offset points", "ha": align}


DRAW: dict[str, Callable[[Record], Figure]] = {
    "depth-time": _depth_time,
    "depth-memory": _depth_memory,
    "media-efficiency": _media_efficiency,
    "replay-noise": _replay_noise,
    "quality-curves": _quality_curves,
}
