"""Records of complete runs: created with their circumstances, saved as JSON in benchmarks/results/, and read back."""

from __future__ import annotations

import os
import subprocess
from datetime import datetime, timezone
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.platform.files import file_problem

from .drafts import ROOT, Draft
from .measures.job import Record
from .runner import Measured

RESULTS = ROOT / "benchmarks" / "results"
_LONGEST = 2**28  # bytes, a hundred times the largest record
_JSON = TypeAdapter(Record)


def load_average() -> float:
    """Load average of the last minute."""
    return round(os.getloadavg()[0], 2)


def _git(*arguments: str) -> str:
    result = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)
    return result.stdout.strip() if result.returncode == 0 else ""


def commit(changed: bool = False) -> str:
    """Return the short hash of the current commit, followed by '+' if the code has ``changed`` since."""
    modified = _git("status", "--porcelain", "--untracked-files=no", "--", "src", "benchmarks/*.py")
    return _git("rev-parse", "--short=12", "HEAD") + ("+" if modified or changed else "")


def make_record(task: str, command: str, load_before: float, measured: Measured, draft: Draft) -> Record:
    """The record of a run that has just ended."""
    return Record(
        task=task,
        command=command,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        commit=commit(draft.stale),
        load=(load_before, load_average()),
        machines=tuple(measured.machines),
        points=tuple(measured.points),
        sittings=draft.sittings,
    )


def save(record: Record, folder: Path) -> Path:
    """Write TASK.json in the folder atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{record.task}.json"
    draft = path.with_suffix(".json.tmp")
    draft.write_bytes(_JSON.dump_json(record, indent=1) + b"\n")
    draft.replace(path)
    return path


def load(task: str) -> Record | None:
    """The saved record of a task, or None."""
    path = RESULTS / f"{task}.json"
    return read(path) if path.exists() else None


def read(path: Path) -> Record:
    """Read a record from a file.

    Raises:
        PathreplayError: the file does not exist, or is not a record.
    """
    if problem := file_problem(path, _LONGEST):
        raise PathreplayError(f"{path} cannot be read: it {problem}; give a file that --save wrote")
    try:
        return _JSON.validate_json(path.read_bytes())
    except OSError as error:
        raise PathreplayError(f"{path} cannot be read: {error.strerror}; give a file that --save wrote") from None
    except ValidationError as error:
        raise PathreplayError(
            f"{path} is not a benchmark record ({error.error_count()} errors); give a file that --save wrote"
        ) from None
