"""Stores the finished jobs of an interrupted run on disk, so that the next run continues from there."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from .measures.job import Job, Machine, Point

ROOT = Path(__file__).resolve().parents[1]
DRAFTS = ROOT / "benchmarks" / "results" / ".partial"


@dataclass(frozen=True)
class Done:
    """A finished job. A task may repeat a job; ``turn`` is the index among equal jobs."""

    job: Job
    turn: int
    points: tuple[Point, ...]
    machines: tuple[Machine, ...]


@dataclass(frozen=True)
class _Contents:
    stamp: str
    begun: str
    sittings: int
    done: tuple[Done, ...]


_JSON = TypeAdapter(_Contents)


@dataclass
class Draft:
    """The finished jobs of one task; only valid for the same code and the same machine."""

    path: Path
    contents: _Contents = field(init=False)

    def __post_init__(self) -> None:
        fresh = _Contents(stamp(), datetime.now(timezone.utc).isoformat(timespec="seconds"), 1, ())
        try:
            saved = _JSON.validate_json(self.path.read_bytes())
        except (FileNotFoundError, ValidationError):
            saved = fresh
        if saved.stamp != fresh.stamp or not saved.done:
            self.contents = fresh
        else:
            self.contents = replace(saved, sittings=saved.sittings + 1)

    @property
    def begun(self) -> str:
        """Start of the first job, ISO 8601."""
        return self.contents.begun

    @property
    def sittings(self) -> int:
        """Number of runs so far, including this one."""
        return self.contents.sittings

    @property
    def stale(self) -> bool:
        """Whether the code has changed since the start, so that the jobs are not comparable."""
        return stamp() != self.contents.stamp

    def find(self, job: Job, turn: int) -> Done | None:
        """The finished job, or None."""
        return next((done for done in self.contents.done if (done.job, done.turn) == (job, turn)), None)

    def add(self, done: Done) -> None:
        """Save a finished job to disk atomically."""
        self.contents = replace(self.contents, done=(*self.contents.done, done))
        self.path.parent.mkdir(parents=True, exist_ok=True)
        draft = self.path.with_suffix(".tmp")
        draft.write_bytes(_JSON.dump_json(self.contents))
        draft.replace(self.path)

    def discard(self) -> None:
        """Remove the draft at the end of the run."""
        self.path.unlink(missing_ok=True)


def draft_of(task: str, quick: bool) -> Draft:
    """The draft of a task, with the finished jobs of an interrupted run if there are any."""
    return Draft(DRAFTS / f"{task}{'-quick' if quick else ''}.json")


def stamp() -> str:
    """Hash of the code of the package and the benchmarks, and of the machine."""
    words = hashlib.sha256(f"{os.uname().nodename} {os.cpu_count()}".encode())
    for path in sorted([*(ROOT / "src").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]):
        words.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return words.hexdigest()[:16]
