"""The rule by which a case is judged: what it may print, how it may end, and what it may leave behind."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePath

from .case import Action, Recipe
from .server import MEMORY_LIMIT_MB
from .snapshot import State, difference

#: `bench` hands over to a program of its own.
ERRORS = ("pathreplay: error: ", "benchmarks: error: ")
LONGEST = 2000

# All but the ends of lines and tabs: what could move a terminal's cursor or rename its window.
CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")

# Mitsuba's warnings are coloured, whatever they are written to.
COLOUR = re.compile(r"\x1b\[[0-9;]*m")

ENDINGS = {0: "finished", 1: "finished, not liked", 2: "refused"}


@dataclass(frozen=True)
class Ended:
    """How the process of a case ended, and what it printed."""

    status: int
    """Negative: minus the signal that killed it."""
    killed: str
    """'timeout' or 'memory' where we had to end it."""
    seconds: float
    peak_mb: int
    stdout: str
    stderr: str


@dataclass(frozen=True)
class Verdict:
    """What came of a case; with findings it was not what it should be."""

    outcome: str
    findings: tuple[str, ...]


def judge(recipe: Recipe, action: Action, ended: Ended, before: State, after: State) -> Verdict:
    """Hold an ending to the rule. The states are those of the room and of the folder beside it."""
    findings = [*_of_the_end(recipe, action, ended), *_of_the_words(action, ended)]
    findings += _of_the_files(action, ended, before, after)
    return Verdict(ENDINGS.get(ended.status, "ended by a signal"), tuple(dict.fromkeys(findings)))


def _of_the_end(recipe: Recipe, action: Action, ended: Ended) -> list[str]:
    if ended.killed == "timeout":
        return ["hang"]
    if ended.killed == "memory" or ended.peak_mb > MEMORY_LIMIT_MB:
        return [f"more than {MEMORY_LIMIT_MB} MB"]
    if ended.status not in action.statuses:
        # A shell tells of a signal by 128 + its number.
        return [f"signal {-ended.status if ended.status < 0 else ended.status - 128}" if not 0 <= ended.status < 128
                else f"status {ended.status}"]  # fmt: skip
    return ["was not refused"] if recipe.refused and ended.status != 2 else []


def _of_the_words(action: Action, ended: Ended) -> list[str]:
    stderr = COLOUR.sub("", ended.stderr)
    found, words = [], COLOUR.sub("", ended.stdout) + "\n" + stderr
    if "Traceback (most recent call last)" in words:
        found.append("traceback")
    if CONTROL.search(words):
        found.append("control characters")
    errors = [line for line in words.splitlines() if line.startswith(ERRORS)]
    if ended.status == 2 and ended.killed == "" and not _nobody_reads(action):
        lines = stderr.strip().split("\n")
        if len(errors) != 1 or not lines[-1].startswith(ERRORS):
            found.append("no line that tells what is wrong" if not errors else "more than one line")
        elif len(errors[0]) > LONGEST:
            found.append("a message too long")
        elif len(errors[0]) <= len(ERRORS[0]) + 3:
            found.append("a message that says nothing")
    elif ended.status in (0, 1) and errors:
        found.append("an error, and yet no status 2")
    return found


def _nobody_reads(action: Action) -> bool:
    """Whether a shell line sends errors elsewhere, or the command line is empty, which shows the help."""
    return "2>" in action.shell or action == Action()


def _of_the_files(action: Action, ended: Ended, before: State, after: State) -> list[str]:
    changed = difference(before, after)
    found = []
    inside = {path for path in changed if PurePath(path).parts[0] == "room"}
    if outside := changed - inside - {str(PurePath("room") / name) for name in action.writes} - _beside(action):
        found.append(f"wrote outside: {min(outside)}")
    allowed = {f"room/{name}" for name in action.writes} | _run_folders(before, after)
    left = {path for path in inside if not _within(path, allowed)}
    # The folders that a run folder was made in.
    left -= {path for path in left if path not in before and any(f.startswith(path + "/") for f in allowed)}
    if left:
        found.append(f"changed or left behind: {min(left)}")
    if parts := {path for path in changed if path.endswith(".part") and path in after and path not in before}:
        found.append(f"left half-written: {min(parts)}")
    if ended.status == 2 and (made := allowed & (after.keys() - before.keys())):
        if not any(f"{folder}/checkpoint.safetensors" in after for folder in made):
            found.append(f"left behind: {min(made)}")
    return found


def _beside(action: Action) -> set[str]:
    return {name.removeprefix("../") for name in action.writes if name.startswith("../")}


def _run_folders(before: State, after: State) -> set[str]:
    """Folders that are one run's: those with a run.json in them, before or after."""
    return {path.rsplit("/", 1)[0] for path in before.keys() | after.keys() if path.endswith("/run.json")}


def _within(path: str, folders: set[str]) -> bool:
    return any(path == folder or path.startswith(folder + "/") for folder in folders)
