"""Writes the history of a run for TensorBoard: loss, errors and gradient norms by iteration and time."""

from __future__ import annotations

import itertools
from pathlib import Path

from pathreplay.errors import PathreplayError
from pathreplay.platform.atomic_files import whole_folder
from pathreplay.report.watch.past import Past


def write_events(run: Past, folder: Path) -> int:
    """Write event files into a new folder; return the number of iterations.

    Raises PathreplayError if the package tensorboard is missing, or the folder exists or cannot be written.
    """
    try:
        from tensorboard.summary import Writer
    except ImportError:
        raise PathreplayError(
            "TensorBoard is not installed; pip install 'pathreplay[tensorboard]', or tensorboard alone"
        ) from None
    history = run.history
    if folder.exists():
        raise PathreplayError(f"{folder} exists; remove it, or give another --output")
    began = (run.folder / "run.json").stat().st_mtime
    times = itertools.accumulate((entry.seconds for entry in history), initial=began)
    next(times)
    with whole_folder(folder, "--output") as part:
        writer = Writer(str(part))
        for entry, time in zip(history, times, strict=True):
            scalars = {"loss": entry.loss, "penalty": entry.penalty, "picture_error": entry.picture_error}
            scalars |= {f"error/{key}": value for key, value in entry.errors.items()}
            scalars |= {f"gradient_norm/{key}": value for key, value in entry.gradient_norms.items()}
            for tag, value in scalars.items():
                if value is not None:
                    writer.add_scalar(tag, value, entry.iteration, wall_time=time)
        writer.close()
    return len(history)
