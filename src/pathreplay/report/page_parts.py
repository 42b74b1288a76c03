"""Parts shared by the report and the live page of a run: curves, tables, and notes."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence

import numpy as np

from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.images.io import Image, encoded, exposure_for, levels
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.report.outcome import Recovered, RecoveredPose
from pathreplay.report.pages.page import Plot, Row, Series, thinned

# Approximate number of pixels from which the common exposure is computed, which suffices for an accurate exposure.
MOST_LEVELS = 1_000_000

THINNED = "Of {} iterations, every {}th is drawn."


def uri(kind: str, data: bytes) -> str:
    """Encode a file as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def common_exposure(views: Iterable[tuple[Image, Image | None]]) -> float:
    """Return one display exposure for all views, at which 98 % of the target pixels are darker than white.

    Each view is given as target and weights; pixels of weight zero are not counted. If there are many target pixels, a
    subset of them is used.
    """
    parts = [levels(target, weight) for target, weight in views]
    step = max(1, sum(part.size for part in parts) // MOST_LEVELS)
    return exposure_for(np.concatenate([part[::step] for part in parts])) if parts else 1.0


def lead(config: Config, parameters: int, learned: int, test_views: int) -> tuple[str, str, str]:
    """Return the sentence at the top of a page in three parts.

    The parts contain the number of parameters, the name of the scene, and the number of images.
    """
    test = f", {test_views} test view{'s' if test_views != 1 else ''}" if test_views else ""
    images = f" recovered from {learned} image{'s' if learned != 1 else ''}{test}"
    return f"{parameters} parameter{'s' if parameters != 1 else ''} of ", config.scene, images


def dropped_notice(history: Sequence[Entry]) -> tuple[str, ...]:
    """Return a notice if some gradient entries were not finite, otherwise an empty tuple."""
    dropped = sum(entry.dropped for entry in history)
    return (f"{dropped} gradient entries were NaN or infinite and were set to zero.",) if dropped else ()


def facts(config: Config, history: Sequence[Entry]) -> tuple[tuple[str, str], ...]:
    """Return the key figures at the top of a page, each as value and label."""
    figures = [(f"{len(history)}", "iterations")]
    if history:
        seconds = sum(entry.seconds for entry in history)
        figures += [
            (f"{history[0].loss:.3g} → {history[-1].loss:.3g}", f"loss ({config.loss_name})"),
            (f"{seconds:.0f} s", f"{seconds / len(history):.2f} s per iteration"),
        ]
    spp = sorted({entry.spp for entry in history if entry.spp})
    samples = f"{spp[0]} to {spp[-1]}" if len(spp) > 1 else f"{spp[0] if spp else config.spp}"
    return (*figures, (samples, "samples per pixel and step"), (f"{config.seed}", "seed"))


def plots(history: Sequence[Entry]) -> tuple[Plot, ...]:
    """Return plots over the iterations.

    One plot shows the loss. Each parameter has a plot of its error (if the truth is known), and a plot of the norms of
    its gradient and of the noise of its gradient. There is a plot of regularizers if the job has any, and a plot of the
    samples per pixel if their number varies.
    """
    entries = [history[i] for i in thinned(len(history))]
    x = tuple(float(entry.iteration) for entry in entries)

    def plot(title: str, code: str, **lines: Iterable[float | None]) -> Plot:
        """Make a plot of ``lines`` over the iterations; a legend names the lines if there are several."""
        series = (Series(name * (len(lines) > 1), x, tuple(rounded(v) for v in y)) for name, y in lines.items())
        return Plot(title, tuple(series), code=code)

    drawn = [plot("loss", "", loss=(entry.loss for entry in entries))]
    if any(entry.penalty for entry in entries):
        drawn.append(plot("penalty", "", penalty=(entry.penalty for entry in entries)))
    if len({entry.spp for entry in entries}) > 1:
        drawn.append(plot("samples per pixel", "", spp=(entry.spp for entry in entries)))
    # A stage can freeze parameters, so that the last entry lacks the norms of their gradients.
    errors = dict.fromkeys(key for entry in history for key in entry.errors)
    norms = dict.fromkeys(key for entry in history for key in entry.gradient_norms)
    for key in norms | errors:  # a pose has different keys for its errors and for its gradients
        if key in errors:
            drawn.append(plot("error of", key, error=(entry.errors.get(key) for entry in entries)))
        if key in norms:
            lines = {"gradient": (entry.gradient_norms.get(key) for entry in entries)}
            if any(key in entry.noise_norms for entry in entries):
                lines["noise"] = (entry.noise_norms.get(key) for entry in entries)
            drawn.append(plot("gradient norm of", key, **lines))
    return tuple(drawn)


def plots_note(history: Sequence[Entry]) -> str:
    """Return a note if the curves omit iterations, otherwise ""."""
    taken = thinned(len(history))
    return THINNED.format(len(history), taken[1] - taken[0]) if len(taken) < len(history) else ""


def rounded(value: float | None) -> float | None:
    """Round to six digits, which suffice for a curve. Values that are not finite become None, and are not drawn."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.6g}")


def numbers(item: Recovered) -> tuple[Row, ...]:
    """Return the table rows of a small parameter: initial value, result, truth and relative error."""
    rows = []
    for kind, values in item.numbers().items():
        text = ", ".join(f"{value:.4g}" for value in values)
        name = "recovered" if kind == "result" else kind
        rows.append(Row(name, (text,), swatch(values) if len(values) == 3 else ""))
    if rows and (error := item.relative_error()) is not None:
        rows.append(Row("error", (f"{100 * error:.2f} % of the truth",)))
    return tuple(rows)


def about(item: Recovered, baseline: str = "") -> str:
    """Return a sentence about the size and the error of a large parameter. ``baseline`` is the baseline's name."""
    shape, result = item.result.shape, item.result
    words = {3: " x ".join(map(str, shape[1::-1])) + " texels", 4: " x ".join(map(str, shape[2::-1])) + " voxels"}
    if item.textures():
        text = words[3]
    elif item.volumes():
        text = f"Middle slices along z, y and x. {words[4]}"
    else:
        text = f"{result.size} numbers, {result.min():.4g} to {result.max():.4g}"
    if item.error() is None:
        return f"{text}."
    text += f", RMS error {item.error('start'):.4g} initially, {item.error():.4g} recovered"
    if item.volumes() and (relative := item.relative_error()) is not None:
        text += f" ({100 * relative:.0f} % of the truth)"
    if item.error("baseline") is not None:
        text += f", {item.error('baseline'):.4g} by {baseline}"
    return f"{text}."


def pose_rows(item: RecoveredPose) -> tuple[Row, ...]:
    """Return the table rows of a pose: its parts and errors."""
    table: dict[str, str] = {}
    for kind, parts in (("start", item.start), ("recovered", item.result)):
        for part, array in parts.items():
            unit = "°" if part == "rotation" else ""
            table[f"{kind}, {part}"] = ", ".join(f"{v:.4g}{unit}" for v in array)
    table |= {kind.replace("_at_", " at the "): str(error) for kind, error in reversed(item.errors().items())}
    return tuple(Row(name, (text,)) for name, text in table.items())


def pose_note(item: RecoveredPose) -> str:
    """Return a note about the reference frame and the units of a pose."""
    pose = item.pose
    compared = "" if pose.distance is None else f"; distances are compared with {pose.distance:.4g}"
    pivot = ", ".join(f"{x:.4g}" for x in pose.pivot)
    relative = f"Pose ({pose.kind}) relative to the scene file, about the pivot {pivot}"
    return f"{relative}; rotations are rotation vectors{compared}."


def swatch(values: list[float]) -> str:
    """Return the CSS colour of linear RGB values. Colours brighter than white are scaled down, with the same hue."""
    colour = np.array(values, dtype=np.float32).clip(min=0)
    return "#" + "".join(f"{round(float(c) * 255):02x}" for c in encoded(colour / max(1.0, float(colour.max()))))


def integrator_row(config: Config) -> Row:
    """Return the table row of the integrator and its properties."""
    return Row("integrator", (", ".join(f"{k} = {v}" for k, v in config.integrator.model_dump().items()),))


def target_row(config: Config) -> Row:
    """Return the table row about the source of the target images."""
    target = config.target
    if config.capture is not None:
        return Row("targets", (config.capture.source,))
    if target.images is not None:
        return Row("targets", (target.images if isinstance(target.images, str) else ", ".join(target.images),))
    options = {} if target.integrator is None else target.integrator.model_dump()
    renderer = ", ".join(str(value) if name == "type" else f"{name} = {value}" for name, value in options.items())
    return Row("targets", (f"rendered by {renderer}, {target.spp} samples per pixel",))
