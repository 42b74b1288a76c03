"""Runs an entry of the gallery, and measures how busy the machine is with other processes."""

from __future__ import annotations

import json
import os
import platform
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import psutil
from pydantic import TypeAdapter, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.platform.threads import processor_name, usable_cores

from ..drafts import ROOT
from ..records import commit
from .entries import Entry

QUIET = 0.1
"""Mean number of cores that other processes may use on an idle machine."""
LISTENS_S = 2.0
"""Seconds for which the other processes are observed before a run."""


@dataclass(frozen=True)
class Run:
    """The circumstances of a finished run."""

    date: str
    commit: str
    processor: str
    processors: int
    system: str
    iterations: int
    seconds: float
    """Time of all iterations of the job, without those of a baseline."""
    command_seconds: float
    """Time of the whole command, with loading, rendering of targets, baseline, and report."""
    others: float
    """Mean number of cores that other processes used."""
    losses: tuple[float, float]
    """Loss before the first and before the last step."""

    @property
    def idle(self) -> bool:
        """Return whether the machine was idle apart from the run."""
        return self.others <= QUIET


_RUN = TypeAdapter(Run)


def busy_seconds() -> float:
    """Return the processor time that all processes of the machine have used, including that of other guests."""
    times = psutil.cpu_times()._asdict()
    # The time of guests is a part of the user time.
    return sum(seconds for kind, seconds in times.items() if kind not in ("idle", "iowait", "guest", "guest_nice"))


def own_seconds() -> float:
    """Return the processor time of this process and of its finished children."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


class Listener:
    """Measures how many cores other processes use from its creation on."""

    def __init__(self) -> None:
        self.begin, self.busy, self.own = time.perf_counter(), busy_seconds(), own_seconds()

    def others(self) -> float:
        """Return the mean number of cores so far."""
        seconds = time.perf_counter() - self.begin
        return max(0.0, (busy_seconds() - self.busy - own_seconds() + self.own) / seconds)


def require_idle(name: str) -> None:
    """Raise PathreplayError if other processes are busy."""
    listener = Listener()
    time.sleep(LISTENS_S)
    if (others := listener.others()) > QUIET:
        raise PathreplayError(
            f"{name} is not run: other processes use {others:.1f} cores, and at most {QUIET} are allowed; end them, or "
            "add --busy to run without a time"
        )


def run(entry: Entry, runs: Path, checkouts: Sequence[Path] = ()) -> Run:
    """Run the commands of an entry; the run folder is runs/NAME, which must not exist.

    The kernel cache is empty, so that the times are those of a first run.
    ``checkouts`` are the arguments of the script that writes the files of the job.
    """
    folder = runs / entry.name
    if entry.prepare:
        _call([sys.executable, f"examples/{entry.prepare}", *map(str, checkouts)])
    listener = Listener()
    job = [sys.executable, "-m", "pathreplay.cli", "optimize", f"examples/{entry.config}"]
    with tempfile.TemporaryDirectory() as cache:
        _call([*job, "--output", str(folder)], DRJIT_CACHE_DIR=cache)
    seconds, others = time.perf_counter() - listener.begin, listener.others()
    history = history_of(folder)
    found = Run(
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        commit=commit(),
        processor=processor_name(),
        processors=usable_cores(),
        system=f"{platform.system()} {platform.machine()}",
        iterations=len(history),
        seconds=round(sum(line["seconds"] for line in history), 2),
        command_seconds=round(seconds, 2),
        others=round(others, 3),
        losses=(history[0]["loss"], history[-1]["loss"]),
    )
    (folder / "gallery.json").write_bytes(_RUN.dump_json(found, indent=1) + b"\n")
    return found


def _call(command: Sequence[str], **environment: str) -> None:
    done = subprocess.run(command, cwd=ROOT, env=os.environ | environment)
    if done.returncode != 0:
        raise PathreplayError(f"{shlex.join(command)} ended with status {done.returncode}; its message is above")


def history_of(folder: Path) -> list[dict[str, float]]:
    """Return the history of a run. Raises PathreplayError if the folder has none."""
    path = folder / "history.jsonl"
    if not path.is_file():
        raise PathreplayError(f"{folder} has no history.jsonl: it is not the folder of a finished run; omit --reuse")
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def reused(entry: Entry, runs: Path) -> Run:
    """Return the circumstances of the last run of an entry. Raises PathreplayError if there is none."""
    history_of(runs / entry.name)
    path = runs / entry.name / "gallery.json"
    try:
        return _RUN.validate_json(path.read_bytes())
    except (OSError, ValidationError):
        raise PathreplayError(f"{path} is not the record of a run of this command; omit --reuse") from None
