"""Reads the job, history and results of a finished or active run from its folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import safetensors
from pydantic import ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.loop.checkpoint import HISTORY, Entry, history_of
from pathreplay.inverse.parameters.pose import error_names
from pathreplay.report.watch.run_files import read_own
from pathreplay.runs.run_folder import CHECKPOINT, read_job
from pathreplay.types import Json


@dataclass(frozen=True)
class Past:
    """A run in a folder. ``name`` is unique among the runs that a command inspects."""

    folder: Path
    name: str

    @cached_property
    def config(self) -> Config:
        """The config of the job. Raises PathreplayError if the config cannot be read."""
        return read_job(self.folder).config

    @cached_property
    def history(self) -> list[Entry]:
        """The iterations up to the last checkpoint.

        Raises PathreplayError if the checkpoint is missing or damaged.
        """
        path = self.folder / CHECKPOINT
        try:
            with safetensors.safe_open(str(path), framework="numpy") as file:
                tensor = file.get_tensor(HISTORY) if HISTORY in file.keys() else None
                return history_of(file.metadata(), tensor)
        except (OSError, safetensors.SafetensorError, ValidationError) as error:
            why = "its history is damaged" if isinstance(error, ValidationError) else str(error)
            raise PathreplayError(
                f"Checkpoint {path} cannot be read ({why}); give the folder of a complete run"
            ) from None

    @cached_property
    def views(self) -> dict[str, Json]:
        """The entries of views.json by view name. The dictionary is empty before the end of the run."""
        table = self._json("views.json")
        return table if all(isinstance(view, dict) for view in table.values()) else {}

    @cached_property
    def errors(self) -> dict[str, float]:
        """Errors of the result by name, as in `Entry.errors`. Without a result, errors after the last iteration.

        The result may be an average of iterates, whose errors differ from the errors of an iterate. While a finished
        run goes on, these are the errors of its previous result, like `likeness`.
        """
        errors = dict(self.history[-1].errors) if self.history else {}
        for key, entry in self._json("parameters.json").items():
            if not isinstance(entry, dict):
                continue
            pose = entry.get("error")
            of_pose = (pose.get("position"), pose.get("degrees")) if isinstance(pose, dict) else (None, None)
            for name, value in zip((key, *error_names(key)), (entry.get("rmse"), *of_pose), strict=True):
                if isinstance(value, (int, float)):
                    errors[name] = float(value)
        return errors

    def likeness(self, view: str, kind: str) -> float | None:
        """Return an image metric ('psnr' or 'ssim') of the result of a view; None if unknown."""
        result = self.views.get(view, {}).get("result")
        value = result.get(kind) if isinstance(result, dict) else None
        return float(value) if isinstance(value, (int, float)) else None

    def test_views(self) -> list[str]:
        return [name for name, view in self.views.items() if view.get("is_test") is True]

    def _json(self, name: str) -> Json:
        try:
            table = json.loads(read_own(self.folder / name) or b"{}")
        except (ValueError, RecursionError):
            raise PathreplayError(f"{self.folder / name} is not JSON; give the folder of a complete run") from None
        return table if isinstance(table, dict) else {}


def pasts(folders: list[Path]) -> list[Past]:
    """Return the runs in these folders, with distinct names.

    Raises PathreplayError if a folder is not a run folder, or is given twice.
    """
    names = [folder.resolve().name for folder in folders]
    runs = []
    for folder, name in zip(folders, names, strict=True):
        if not (folder / "run.json").is_file():
            raise PathreplayError(
                f"{folder} is not a run folder (no run.json); give a folder that optimize has created"
            )
        runs.append(Past(folder, name if names.count(name) == 1 else str(folder)))
    if len({run.folder.resolve() for run in runs}) < len(runs):
        raise PathreplayError("A run is given twice; give different runs")
    return runs
