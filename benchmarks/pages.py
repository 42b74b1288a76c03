"""Fills the pages: pictures and tables between markers are made from the records under benchmarks/results/."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from . import records
from .drafts import ROOT
from .measures.job import Record
from .summaries import SUMMARIES
from .tables import brief_footnote, footnote

MARKED = re.compile(r"(<!-- begin (?P<name>[\w-]+) -->\n).*?(<!-- end (?P=name) -->)", re.DOTALL)
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


def pages() -> list[Path]:
    """Where marked parts are looked for."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def fill(tables: Mapping[str, Callable[[Record], str]], among: Sequence[Path]) -> list[str]:
    """Rewrite the marked parts of these pages; returns the tasks, in alphabetical order, that have no record yet.

    A part is marked by the name of a task, for its table and pictures, or of a summary.
    """
    missing: set[str] = set()

    def replacement(match: re.Match[str]) -> str:
        name = match["name"]
        task, table = SUMMARIES.get(name, (name, tables.get(name)))
        if table is None:
            return match[0]
        record = records.load(task)
        if record is None:
            missing.add(task)
            return f"{match[1]}{NOT_MEASURED}\n{match[3]}"
        pictures = [f"![{told}](images/{file}.svg)" for file, told in PICTURES.get(name, {}).items()]
        parts = "\n\n".join([*pictures, table(record), (brief_footnote if name in SUMMARIES else footnote)(record)])
        return f"{match[1]}{parts}\n{match[3]}"

    for page in among:
        before = page.read_text(encoding="utf-8")
        after = MARKED.sub(replacement, before)
        if after != before:
            page.write_text(after, encoding="utf-8")
    return sorted(missing)
