"""What an interrupted run has measured so far: kept on disk job by job, so that the next run goes on from there."""

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
    """A job that came to an end, and which of its equals it was: a task may run the same job several times, in turn."""

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
    """The jobs of one task that are done. They count only for the code, and the machine, that they were taken with."""

    path: Path
    contents: _Contents = field(init=False)

    def __post_init__(self) -> None:
        fresh = _Contents(stamp(), datetime.now(timezone.utc).isoformat(timespec="seconds"), 1, ())
        try:
            found = _JSON.validate_json(self.path.read_bytes())
        except (FileNotFoundError, ValidationError):
            found = fresh
        if found.stamp != fresh.stamp or not found.done:
            found = fresh
        else:
            found = replace(found, sittings=found.sittings + 1)
        self.contents = found

    @property
    def begun(self) -> str:
        """When the first of the jobs was begun, ISO 8601."""
        return self.contents.begun

    @property
    def sittings(self) -> int:
        """Runs that it took, this one included."""
        return self.contents.sittings

    @property
    def stale(self) -> bool:
        """Whether the code has changed since the jobs were begun: they are then not all of one kind."""
        return stamp() != self.contents.stamp

    def find(self, job: Job, turn: int) -> Done | None:
        """The job, if it is done."""
        return next((done for done in self.contents.done if (done.job, done.turn) == (job, turn)), None)

    def add(self, done: Done) -> None:
        """Keep a job, on disk and at once."""
        self.contents = replace(self.contents, done=(*self.contents.done, done))
        self.path.parent.mkdir(parents=True, exist_ok=True)
        draft = self.path.with_suffix(".tmp")
        draft.write_bytes(_JSON.dump_json(self.contents))
        draft.replace(self.path)

    def discard(self) -> None:
        """The run is over: nothing is left to go on with."""
        self.path.unlink(missing_ok=True)


def draft_of(task: str, quick: bool) -> Draft:
    """The draft of a task, as far as an earlier run came."""
    return Draft(DRAFTS / f"{task}{'-quick' if quick else ''}.json")


def stamp() -> str:
    """A word that changes with the code of the package or of the benchmarks, and with the machine."""
    words = hashlib.sha256(f"{os.uname().nodename} {os.cpu_count()}".encode())
    for path in sorted([*(ROOT / "src").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]):
        words.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return words.hexdigest()[:16]
