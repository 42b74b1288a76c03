"""Parts of the page about a run that its report and the page that follows it share: curves, numbers, words."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence

import numpy as np

from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.images.io import Image, encoded, exposure_for
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.report.outcome import Recovered, RecoveredPose
from pathreplay.report.pages.page import Plot, Row, Series, thinned

# Pixels whose brightness is looked at for the exposure of all views: more do not change it.
MOST_LEVELS = 1_000_000

THINNED = "Of {} iterations every {}th is drawn."


def uri(kind: str, data: bytes) -> str:
    """A file as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def common_exposure(targets: Sequence[Image]) -> float:
    """The exposure under which all targets are shown: 98 % of their pixels (of every so many) stay below white."""
    step = max(1, sum(target.shape[0] * target.shape[1] for target in targets) // MOST_LEVELS)
    levels = [target[..., :3].max(axis=2).reshape(1, -1, 1)[:, ::step] for target in targets]
    return exposure_for(np.concatenate(levels, axis=1)) if levels else 1.0


def lead(config: Config, parameters: int, learned: int, test_views: int) -> tuple[str, str, str]:
    """What was recovered from what, around the name of the scene."""
    out = f", {test_views} held out" if test_views else ""
    pictures = f" recovered from {learned} picture{'s' if learned != 1 else ''}{out}"
    return f"{parameters} parameter{'s' if parameters != 1 else ''} of ", config.scene, pictures


def dropped_notice(history: Sequence[Entry]) -> tuple[str, ...]:
    """A line on gradient entries that were not finite, if there were any."""
    dropped = sum(entry.dropped for entry in history)
    return (f"{dropped} gradient entries were NaN or infinite and were taken as zero.",) if dropped else ()


def facts(config: Config, history: Sequence[Entry]) -> tuple[tuple[str, str], ...]:
    """The figures at the top."""
    found = [(f"{len(history)}", "iterations")]
    if history:
        seconds = sum(entry.seconds for entry in history)
        found += [
            (f"{history[0].loss:.3g} → {history[-1].loss:.3g}", f"loss ({config.loss})"),
            (f"{seconds:.0f} s", f"{seconds / len(history):.2f} s per iteration"),
        ]
    return (*found, (f"{config.spp}", "samples per pixel and step"), (f"{config.seed}", "seed"))


def plots(history: Sequence[Entry]) -> tuple[Plot, ...]:
    """Loss and, of every parameter, error (where the truth is known), norm of the gradient and of its noise."""
    taken = [history[i] for i in thinned(len(history))]
    x = tuple(float(entry.iteration) for entry in taken)

    def plot(title: str, code: str, **lines: Iterable[float | None]) -> Plot:
        """Lines are named where there are several."""
        series = (Series(name * (len(lines) > 1), x, tuple(_rounded(v) for v in y)) for name, y in lines.items())
        return Plot(title, tuple(series), code=code)

    found = [plot("loss", "", loss=(entry.loss for entry in taken))]
    if any(entry.penalty for entry in taken):
        found.append(plot("penalty", "", penalty=(entry.penalty for entry in taken)))
    if len({entry.spp for entry in taken}) > 1:
        found.append(plot("samples per pixel", "", spp=(entry.spp for entry in taken)))
    if not history:
        return tuple(found)
    errors, norms = history[-1].errors, history[-1].gradient_norms
    for key in dict.fromkeys([*norms, *errors]):  # of a pose errors have other names than gradients
        if key in errors:
            found.append(plot("error of", key, error=(entry.errors.get(key) for entry in taken)))
        if key in norms:
            lines = {"gradient": (entry.gradient_norms.get(key) for entry in taken)}
            if any(key in entry.noise_norms for entry in taken):
                lines["noise"] = (entry.noise_norms.get(key) for entry in taken)
            found.append(plot("gradient norm of", key, **lines))
    return tuple(found)


def plots_note(history: Sequence[Entry]) -> str:
    """What is to be said of curves that leave iterations out."""
    taken = thinned(len(history))
    return THINNED.format(len(history), taken[1] - taken[0]) if len(taken) < len(history) else ""


def _rounded(value: float | None) -> float | None:
    """Six digits are more than a curve shows; what is no number is not drawn."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.6g}")


def numbers(item: Recovered) -> tuple[Row, ...]:
    """Start, result and truth of a parameter of few numbers, as rows of a table."""
    found = []
    for kind, values in item.numbers().items():
        text = ", ".join(f"{value:.4g}" for value in values)
        name = "recovered" if kind == "result" else kind
        found.append(Row(name, (text,), swatch(values) if len(values) == 3 else ""))
    if found and (error := item.relative_error()) is not None:
        found.append(Row("error", (f"{100 * error:.2f} % of the truth",)))
    return tuple(found)


def about(item: Recovered, baseline: str = "") -> str:
    """A line on the size and the error of a parameter of many numbers."""
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
    text += f", root mean square error {item.error('start'):.4g} at the start, {item.error():.4g} recovered"
    if item.volumes() and (relative := item.relative_error()) is not None:
        text += f" ({100 * relative:.0f} % of the truth)"
    if item.error("baseline") is not None:
        text += f", {item.error('baseline'):.4g} by {baseline}"
    return f"{text}."


def pose_rows(item: RecoveredPose) -> tuple[Row, ...]:
    """A pose as rows of a table."""
    return tuple(Row(name, (text,)) for name, text in item.rows().items())


def pose_note(item: RecoveredPose) -> str:
    """What the numbers of a pose are relative to."""
    pose = item.pose
    compared = "" if pose.distance is None else f"; distances are compared with {pose.distance:.4g}"
    pivot = ", ".join(f"{x:.4g}" for x in pose.pivot)
    relative = f"Pose ({pose.kind}) relative to the scene file's, about the pivot {pivot}"
    return f"{relative}; rotations as vectors along the axis{compared}."


def swatch(values: list[float]) -> str:
    """A CSS colour for linear RGB; brighter than white is scaled to full brightness, hue kept."""
    colour = np.array(values, dtype=np.float32).clip(min=0)
    return "#" + "".join(f"{round(float(c) * 255):02x}" for c in encoded(colour / max(1.0, float(colour.max()))))


def integrator_row(config: Config) -> Row:
    """The integrator of the job and its options."""
    return Row("integrator", (", ".join(f"{k} = {v}" for k, v in config.integrator.model_dump().items()),))


def target_row(config: Config) -> Row:
    """Where the targets came from."""
    target = config.target
    if config.capture is not None:
        return Row("targets", (config.capture.source,))
    if target.images is not None:
        return Row("targets", (target.images if isinstance(target.images, str) else ", ".join(target.images),))
    options = {} if target.integrator is None else target.integrator.model_dump()
    renderer = ", ".join(str(value) if name == "type" else f"{name} = {value}" for name, value in options.items())
    return Row("targets", (f"rendered by {renderer}, {target.spp} samples per pixel",))
