"""Text notebooks of the documentation (MyST), read without Jupyter: header, sections, and code cells as one script."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from places import ROOT

FOLDER = ROOT / "docs/notebooks"
NAMES = (
    "a-walls-texture", "is-your-gradient-right", "glass-and-its-index", "a-cloud", "a-shape-with-edges",
    "inside-the-sweep",
)  # fmt: skip
_HEADER = re.compile(r"---\n(.*?\n)---\n", re.S)
_CELL = re.compile(r"^```\{code-cell\} (\S*)\n((?::[\w-]+:.*\n)*)(.*?)^```$", re.M | re.S)


@dataclass(frozen=True)
class Notebook:
    """A notebook: its header as a table, its prose, and the language and code of each cell with its line."""

    path: Path
    header: dict[str, Any]
    prose: str
    cells: tuple[tuple[int, str, str], ...]

    def script(self) -> str:
        """Return all cells as one script, whose lines are those of the file."""
        lines = [""] * (self.path.read_text(encoding="utf-8").count("\n") + 1)
        for begin, _, code in self.cells:
            for n, line in enumerate(code.splitlines()):
                lines[begin + n] = line
        return "\n".join(lines) + "\n"


def read(path: Path) -> Notebook:
    """Read a notebook."""
    text = path.read_text(encoding="utf-8")
    head = _HEADER.match(text)
    assert head is not None, f"{path.name} has no header"
    cells = [(text[: match.start(3)].count("\n"), match[1], match[3]) for match in _CELL.finditer(text)]
    return Notebook(path, yaml.safe_load(head[1]), _CELL.sub("", text[head.end() :]), tuple(cells))


if __name__ == "__main__":
    import sys

    print(read(FOLDER / f"{sys.argv[1]}.md").script())
