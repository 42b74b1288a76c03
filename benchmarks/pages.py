"""Updates figures and tables between the markers of pages, from the records in benchmarks/results/."""

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

#: Figures above the table of a task: caption by file name.
PICTURES = {
    "depth": {
        "depth-time": "Seconds of a gradient pass against path length",
        "depth-memory": "Peak memory against path length",
    },
    "media": {"media-efficiency": "Efficiency of gradients of media, relative to prbvolpath"},
    "quality": {"quality-curves": "Held-out error against time"},
    "noise": {"replay-noise": "Error of attached replay against the noise in its Jacobians"},
}


def pages() -> list[Path]:
    """Pages that are searched for marked parts."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def fill(tables: Mapping[str, Callable[[Record], str]], among: Sequence[Path]) -> list[str]:
    """Rewrite the marked parts of these pages; returns the sorted names of tasks without a record.

    The marker of a part names a task, for its table and figures, or a summary.
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
