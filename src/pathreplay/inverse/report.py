"""The report: what was asked, what came out, how far it is from the truth, as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import io
import os
import platform
import re
import shlex
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.config import Config
from pathreplay.inverse.images import Image, difference, png_bytes
from pathreplay.inverse.pose import Pose, PoseError
from pathreplay.inverse.values import Array

# Differences are shown brighter than the pictures: a converged one would be black otherwise.
DIFFERENCE_GAIN = 4.0


@dataclass(frozen=True)
class ViewPictures:
    """One view: target, start and result (linear), and the exposure under which all of them are shown."""

    name: str
    target: Image
    start: Image
    result: Image
    exposure: float

    def pictures(self) -> dict[str, Image]:
        """The pictures to show; the difference is result - target, red above and blue below, DIFFERENCE_GAIN times."""
        gap = difference(self.result, self.target) * DIFFERENCE_GAIN
        return {"target": self.target, "start": self.start, "result": self.result, "difference": gap}

    def error(self) -> float:
        """Root mean square difference of result and target; includes the noise of both."""
        return _rmse(self.result, self.target)

    def error_at_start(self) -> float:
        return _rmse(self.start, self.target)


@dataclass(frozen=True)
class Recovered:
    """One parameter: start, result, and truth where it is known."""

    key: str
    start: Array
    result: Array
    truth: Array | None

    def textures(self) -> dict[str, Image]:
        """Start, result and truth as images; empty for what is no texture of one to four channels."""
        if self.result.ndim != 3 or self.result.shape[2] > 4:
            return {}
        images = {"start": self.start, "result": self.result}
        return images if self.truth is None else {**images, "truth": self.truth}

    def numbers(self) -> dict[str, list[float]]:
        """Start, result and truth as numbers; empty for what has more of them than one reads (over 16)."""
        if self.result.ndim > 1 or self.result.size > 16:
            return {}
        rows = {"start": self.start.tolist(), "result": self.result.tolist()}
        return rows if self.truth is None else {**rows, "truth": self.truth.tolist()}

    def error(self) -> float | None:
        """Root mean square error against the truth."""
        return None if self.truth is None else _rmse(self.result, self.truth)

    def error_at_start(self) -> float | None:
        return None if self.truth is None else _rmse(self.start, self.truth)

    def relative_error(self) -> float | None:
        """|result - truth| / |truth| (L2 norms); None where the truth is unknown or zero."""
        if self.truth is None or not self.truth.any():
            return None
        return float(np.linalg.norm(self.result - self.truth) / np.linalg.norm(self.truth))

    def file_name(self) -> str:
        return re.sub(r"[^\w.-]", "_", self.key)


@dataclass(frozen=True)
class RecoveredPose:
    """One pose: translation and rotation vector (radians) at the start and in the result, by part, and their errors."""

    pose: Pose
    start: dict[str, Array]
    result: dict[str, Array]
    value: Array
    """The transform (4 x 4) or the vertices in the result."""
    error: PoseError | None
    error_at_start: PoseError | None

    def rows(self) -> dict[str, str]:
        """Readable rows: what was moved by how much, and how far it is from the truth."""
        table: dict[str, str] = {}
        for kind, parts in (("start", self.start), ("recovered", self.result)):
            for part, array in parts.items():
                unit = "°" if part == "rotation" else ""
                numbers = np.degrees(array) if part == "rotation" else array
                table[f"{kind}, {part}"] = ", ".join(f"{v:.4g}{unit}" for v in numbers)
        if self.error is not None and self.error_at_start is not None:
            table["error at the start"] = str(self.error_at_start)
            table["error"] = str(self.error)
        return table

    def as_dict(self) -> dict[str, Any]:
        """Everything for parameters.json; rotations in degrees."""
        table: dict[str, Any] = {"pose": self.pose.kind, "pivot": list(self.pose.pivot)}
        for kind, parts in (("start", self.start), ("result", self.result)):
            table[kind] = {p: (np.degrees(a) if p == "rotation" else a).tolist() for p, a in parts.items()}
        if self.value.shape == (4, 4):
            table["value"] = self.value.tolist()
            if self.pose.truth is not None:
                table["truth"] = self.pose.truth.tolist()
        for kind, error in (("error", self.error), ("error_at_start", self.error_at_start)):
            if error is not None:
                table[kind] = asdict(error)
        if self.pose.distance is not None:
            table["distance"] = self.pose.distance
        return table


@dataclass(frozen=True)
class Outcome:
    """Everything that the report tells."""

    config: Config
    source: Path | None
    folder: Path
    views: tuple[ViewPictures, ...]
    recovered: tuple[Recovered, ...]
    poses: tuple[RecoveredPose, ...]
    history: tuple[Entry, ...]
    variant: str
    notes: tuple[str, ...]

    def command(self) -> str:
        """The command line that makes this run again, or goes on with it where it was stopped."""
        if len(self.history) < self.config.iterations:
            return f"pathreplay optimize --resume {shlex.quote(str(self.folder))}"
        job = self.folder / "config.json" if self.source is None else self.source
        return f"pathreplay optimize {shlex.quote(str(job))}"

    def seconds(self) -> float:
        return sum(entry.seconds for entry in self.history)

    def dropped(self) -> int:
        return sum(entry.dropped for entry in self.history)


def report_files(outcome: Outcome) -> dict[str, bytes]:
    """report.html, the loss curve (SVG, PNG) and summary.png, as file name -> content."""
    curve = loss_figure(outcome.history)
    svg = _drawn(curve, "svg")
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
        data_uri=_data_uri,
        loss_svg=_uri("image/svg+xml", svg),
        gain=DIFFERENCE_GAIN,
        versions=versions(outcome.variant),
    )
    return {
        "report.html": html.encode(),
        "loss.svg": svg,
        "loss.png": _drawn(curve, "png"),
        "summary.png": summary(outcome),
    }


def loss_figure(history: tuple[Entry, ...]) -> Figure:
    """Loss against iteration, logarithmic, in grey and one colour that read on light and dark ground alike."""
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([entry.iteration for entry in history], [entry.loss for entry in history], color="#3b82f6", linewidth=1.5)
    if any(entry.loss > 0 for entry in history):
        axes.set_yscale("log")
    axes.set_xlabel("iteration")
    axes.set_ylabel("loss")
    grey = "#808080"
    axes.grid(True, color=grey, alpha=0.25, linewidth=0.5)
    axes.tick_params(which="both", colors=grey)
    for part in (axes.xaxis.label, axes.yaxis.label):
        part.set_color(grey)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(grey)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure


# At most so many views and textures in summary.png: it is an overview, the report has them all.
SUMMARY_ROWS = 3


def summary(outcome: Outcome) -> bytes:
    """One PNG with everything side by side: a row per view (target, start, result, difference), a row per texture."""
    rows = [(v.name, v.pictures(), v.exposure) for v in outcome.views[:SUMMARY_ROWS]]
    rows += [(r.key, r.textures(), 1.0) for r in [r for r in outcome.recovered if r.textures()][:SUMMARY_ROWS]]
    figure = Figure(figsize=(8.4, 2.25 * len(rows)), layout="constrained", dpi=100)
    grid = figure.subplots(len(rows), 4, squeeze=False)
    for line, (name, pictures, exposure) in zip(grid, rows, strict=True):
        for axes in line:
            axes.axis("off")
        for column, (kind, image) in enumerate(pictures.items()):
            line[column].imshow(_shown(image, exposure), interpolation="nearest", vmin=0, vmax=1, cmap="gray")
            label = f"{kind} ×{DIFFERENCE_GAIN:g}" if kind == "difference" else kind
            line[column].set_title(label if column else f"{name}: {label}", fontsize=8)
    return _with_palette(_drawn(figure, "png"))


def versions(variant: str) -> dict[str, str]:
    """What a run depends on besides its config."""
    return {
        "pathreplay": version("pathreplay"),
        "Mitsuba": version("mitsuba"),
        "Dr.Jit": version("drjit"),
        "variant": variant,
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def swatch(values: list[float]) -> str:
    """A CSS colour for linear RGB; brighter than white is scaled to full brightness, hue kept."""
    colour = np.array(values, dtype=np.float32).clip(min=0)
    colour = colour / max(1.0, float(colour.max()))
    encoded = np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * np.maximum(colour, 1e-8) ** (1 / 2.4) - 0.055)
    return "#" + "".join(f"{round(float(c) * 255):02x}" for c in encoded)


def _shown(image: Image, exposure: float) -> Image:
    linear = np.clip(image[:, :, :3] * exposure, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055)
    return encoded[:, :, 0] if image.shape[2] < 3 else encoded


def _rmse(a: Array, b: Array) -> float:
    return float(np.sqrt(np.mean(np.square(a.astype(np.float64) - b))))


def _drawn(figure: Figure, kind: str) -> bytes:
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    # No date in the file: the same run gives the same bytes.
    metadata = {"Date": None} if kind == "svg" else None
    figure.savefig(buffer, format=kind, transparent=kind == "svg", metadata=metadata)
    return buffer.getvalue()


def _with_palette(png: bytes) -> bytes:
    """The PNG in 256 colours: fewer bytes for noisy pictures, fit for a README or a mail."""
    picture = PIL.Image.open(io.BytesIO(png)).convert("RGB")
    palette = picture.quantize(256)
    buffer = io.BytesIO()
    picture.quantize(palette=palette).save(buffer, "png", optimize=True)  # with a palette given, Pillow dithers
    return buffer.getvalue()


def _data_uri(image: Image, exposure: float = 1.0) -> str:
    return _uri("image/png", png_bytes(image, exposure))


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
