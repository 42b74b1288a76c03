"""Compares runs. A table shows the results of the runs and the differences between their jobs.

A page shows this table, curves and images.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Iterable

import numpy as np
import PIL.Image

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.images.io import Image, alike, read_image
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.platform.files import file_names
from pathreplay.report.page_parts import rounded, uri
from pathreplay.report.pages.page import Head, Page, Parameter, Picture, Plot, Row, Series, Table, View, thinned
from pathreplay.report.report import MOST_PIXELS, MOST_VIEWS
from pathreplay.report.watch.past import Past
from pathreplay.report.watch.run_files import read_own


def table(runs: list[Past]) -> Table:
    """Return a table with one column per run.

    Rows: iterations, seconds, loss, image metrics, errors, and the job keys whose values differ.
    """
    rows = [
        Row("iterations", tuple(f"{len(run.history)} of {run.config.iterations}" for run in runs)),
        Row("seconds", tuple(f"{sum(entry.seconds for entry in run.history):.1f}" for run in runs)),
        Row("loss", tuple(_loss(run) for run in runs)),
    ]
    for kind, unit in (("psnr", " dB"), ("ssim", "")):
        for name, views in (("training views", _learned), ("test views", Past.test_views)):
            cells = tuple(_mean([run.likeness(view, kind) for view in views(run)], unit) for run in runs)
            if any(cells):
                rows.append(Row(f"{kind.upper()}, {name}", cells))
    for key in _keys(run.errors for run in runs):
        rows.append(Row(f"error of {key}", tuple(_number(run.errors.get(key)) for run in runs)))
    return Table((Head(""), *(Head(run.name) for run in runs)), (*rows, *_differences(runs)))


def page(runs: list[Past]) -> Page:
    """Return a page with the table, curves, and images of the views that all runs have."""
    kinds = {run.config.loss for run in runs}
    notices = [] if len(kinds) == 1 else [f"The runs minimize different losses ({', '.join(sorted(kinds))})."]
    views = _views(runs)
    if other := _with_other_targets(runs, [view.name for view in views]):
        notices.append(
            f"The runs have different targets in {', '.join(other)}. The targets shown are those of {runs[0].name}."
        )
    return Page(
        title=" and ".join(run.name for run in runs) if len(runs) < 4 else f"{len(runs)} runs",
        lead=(f"{len(runs)} runs side by side: ", ", ".join(run.config.scene for run in runs[:1]), ""),
        notices=tuple(notices),
        views=views,
        likeness=table(runs),
        likeness_note="PSNR and SSIM are means over views, each at its own exposure, including render noise.",
        left=runs[0].name,
        right=runs[1].name,
        plots=_plots(runs),
        parameters=_parameters(runs),
        titles={"views": "Side by side", "plots": "Curves", "parameters": "Textures and volumes"},
    )


def _loss(run: Past) -> str:
    if not run.history:
        return ""
    return f"{run.history[0].loss:.4g} → {run.history[-1].loss:.4g} ({run.config.loss_name})"


def _learned(run: Past) -> list[str]:
    return [view for view in run.views if view not in run.test_views()]


def _mean(values: list[float | None], unit: str) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.4g}{unit}" if known else ""


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _keys(tables: Iterable[Iterable[str]]) -> list[str]:
    """Return the distinct keys of all tables or lists, in order of first occurrence."""
    return list(dict.fromkeys(itertools.chain.from_iterable(tables)))


def _differences(runs: list[Past]) -> list[Row]:
    """Return a row for each job key whose values differ, except ``output``."""
    jobs = [dict(_flattened("", run.config.model_dump())) for run in runs]
    for job in jobs:
        job.pop("output", None)
    rows = []
    for key in _keys(jobs):
        values = [job.get(key) for job in jobs]
        if any(value != values[0] for value in values):
            rows.append(Row(f"job: {key}", tuple("" if value is None else shown(value, 60) for value in values)))
    return rows


def _flattened(name: str, value: object) -> Iterable[tuple[str, object]]:
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _flattened(f"{name}.{key}" if name else str(key), entry)
    elif isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        for i, entry in enumerate(value):
            yield from _flattened(f"{name}.{i}", entry)
    else:
        yield name, value


def _plots(runs: list[Past]) -> tuple[Plot, ...]:
    def plot(title: str, code: str, value: Callable[[Entry], float | None], seconds: bool = False) -> Plot:
        series = []
        for run in runs:
            taken = thinned(len(run.history))
            times = np.cumsum([entry.seconds for entry in run.history])
            x = tuple(float(f"{times[i]:.4g}") if seconds else float(i) for i in taken)
            y = tuple(rounded(value(run.history[i])) for i in taken)
            series.append(Series(run.name, x, y))
        return Plot(title, tuple(series), code=code, along="second" if seconds else "iteration")

    plots = [plot("loss by iterations", "", _loss_of), plot("loss by seconds", "", _loss_of, seconds=True)]
    entries = [entry for run in runs for entry in run.history]
    norms, errors = _keys(entry.gradient_norms for entry in entries), _keys(entry.errors for entry in entries)
    for key in _keys([norms, errors]):
        if key in errors:
            plots.append(plot("error of", key, lambda entry, key=key: entry.errors.get(key)))  # type: ignore[misc]
        if key in norms:
            norm = lambda entry, key=key: entry.gradient_norms.get(key)  # noqa: E731
            plots.append(plot("gradient norm of", key, norm))
    return tuple(plots)


def _loss_of(entry: Entry) -> float:
    return entry.loss


def _views(runs: list[Past]) -> tuple[View, ...]:
    names = [name for name in runs[0].views if all(name in run.views for run in runs)][:MOST_VIEWS]
    most_pixels = MOST_PIXELS / max(1, len(names) * (len(runs) + 1))
    sections = []
    for name in names:
        pictures = [_picture(runs[0], "target", "target", f"target-{name}", most_pixels)]
        for run in runs:
            psnr = run.likeness(name, "psnr")
            caption = run.name if psnr is None else f"{run.name}, {psnr:.2f} dB"
            pictures.append(_picture(run, run.name, caption, f"result-{name}", most_pixels))
        is_test = any(name in run.test_views() for run in runs)
        shown = tuple(picture for picture in pictures if picture is not None)
        if len(shown) > 1:
            sections.append(View(name, shown, is_test=is_test))
    return tuple(sections)


def _with_other_targets(runs: list[Past], views: list[str]) -> list[str]:
    """Return the views whose targets differ between runs."""

    def target(run: Past, view: str) -> Image | None:
        path = run.folder / "images" / f"target-{view}.exr"
        return read_image(path) if path.is_file() and not path.is_symlink() else None

    names = []
    for view in views:
        first, *others = (target(run, view) for run in runs)
        if first is not None and any(other is not None and not alike(first, other) for other in others):
            names.append(view)
    return names


def _parameters(runs: list[Past]) -> tuple[Parameter, ...]:
    names_of = [file_names(_keys(entry.gradient_norms for entry in run.history)) for run in runs]
    sections = []
    for key in _keys(names_of):
        for what, columns in (("texture", 3), ("volume", 2)):
            pictures = []
            for run, names in zip(runs, names_of, strict=True):
                if key in names:
                    file = f"{what}-{{}}-{names[key]}"
                    pictures += [_picture(run, run.name, run.name, file.format("result"), MOST_PIXELS / 16)]
            truth = [_picture(runs[0], "truth", "truth", f"{what}-truth-{file_names([key])[key]}", MOST_PIXELS / 16)]
            shown = tuple(picture for picture in (*pictures, *truth) if picture is not None)
            if shown:
                sections.append(Parameter(key, shown, columns))
    return tuple(sections)


def _picture(run: Past, kind: str, caption: str, file: str, most_pixels: float) -> Picture | None:
    """Read an image of a run, and reduce it to ``most_pixels``; None if the image does not exist."""
    data = read_own(run.folder / "images" / f"{file}.png")
    if data is None:
        return None
    try:
        with PIL.Image.open(io.BytesIO(data), formats=("PNG",)) as picture:
            factor = (most_pixels / (picture.width * picture.height)) ** 0.5
            if factor < 1:
                small = picture.convert("RGB").resize(
                    (max(1, round(picture.width * factor)), max(1, round(picture.height * factor))),
                    PIL.Image.Resampling.BOX,
                )
                buffer = io.BytesIO()
                small.save(buffer, "png")
                data = buffer.getvalue()
    except (OSError, ValueError, PIL.Image.DecompressionBombError) as error:
        path = run.folder / "images" / f"{file}.png"
        raise PathreplayError(f"Image {path} cannot be read ({error}); give the folder of a complete run") from None
    return Picture(kind, caption, uri("image/png", data))


def print_table(it: Table) -> None:
    """Print a table on the terminal, without interpreting its texts as markup."""
    from rich.console import Console
    from rich.table import Table as Drawn
    from rich.text import Text

    drawn = Drawn(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for head in it.heads:
        drawn.add_column(Text(head.text), overflow="fold")
    for row in it.rows:
        drawn.add_row(*(Text(cell) for cell in (row.name, *row.cells)))
    Console().print(drawn)
