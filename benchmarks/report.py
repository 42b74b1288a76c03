"""Fills docs/evidence.md: pictures and tables between markers are made from the records under benchmarks/results/."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from . import records
from .drafts import ROOT
from .job import Record
from .tables import footnote

EVIDENCE = ROOT / "docs" / "evidence.md"
MARKED = re.compile(r"(<!-- begin (?P<task>[\w-]+) -->\n).*?(<!-- end (?P=task) -->)", re.DOTALL)
NOT_MEASURED = "*Not measured yet.*"

#: By task: the pictures above its table, as name of the file and what it shows.
PICTURES = {
    "depth": {
        "depth-time": "Seconds of a gradient pass against path length",
        "depth-memory": "Peak memory against path length",
    },
    "media": {"media-efficiency": "Efficiency of gradients of media, relative to prbvolpath"},
    "noise": {"replay-noise": "Error of attached replay against the noise in its Jacobians"},
}


def fill(tables: Mapping[str, Callable[[Record], str]]) -> tuple[Path, list[str]]:
    """Rewrite the marked parts for which there is a table; returns the page, and the tasks that have no record yet."""
    missing: list[str] = []

    def replacement(match: re.Match[str]) -> str:
        task = match["task"]
        if task not in tables:
            return match[0]
        record = records.load(task)
        if record is None:
            missing.append(task)
            return f"{match[1]}{NOT_MEASURED}\n{match[3]}"
        pictures = [f"![{told}](images/{name}.svg)" for name, told in PICTURES.get(task, {}).items()]
        parts = "\n\n".join([*pictures, tables[task](record), footnote(record)])
        return f"{match[1]}{parts}\n{match[3]}"

    EVIDENCE.write_text(MARKED.sub(replacement, EVIDENCE.read_text()))
    return EVIDENCE, missing
