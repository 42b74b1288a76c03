"""Directive that shows a section of another page, so that the section is written once.

    ```{section} media.md Limitations
    ```

Links of the section hold on the page that shows it.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx

LINK = re.compile(r"(\]\()(?!\w+:)([^)#\s]*)")


def section(text: str, heading: str) -> tuple[int, list[str]]:
    """Return the lines below a heading of the second level, up to the next one, and the number of the first line."""
    lines = text.splitlines()
    start = lines.index(f"## {heading}") + 1
    ends = [i for i in range(start, len(lines)) if lines[i].startswith("## ")]
    return start, lines[start : ends[0] if ends else len(lines)]


class Section(Directive):
    """Shows a section of the page that the first argument names."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        env = self.state.document.settings.env
        name, _, heading = self.arguments[0].partition(" ")
        here = Path(env.doc2path(env.docname)).parent
        page = (here / name).resolve()
        env.note_dependency(str(page))
        try:
            first, lines = section(page.read_text(encoding="utf-8"), heading)
        except (OSError, ValueError):
            raise self.error(f"there is no section '{heading}' in {page}") from None

        def moved(match: re.Match[str]) -> str:
            target = (page.parent / match[2]) if match[2] else page
            return match[1] + os.path.relpath(target, here)

        shown = [LINK.sub(moved, line) for line in lines]
        box = nodes.container()
        self.state.nested_parse(StringList(shown, source=str(page)), first, box)
        return box.children


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive with Sphinx."""
    app.add_directive("section", Section)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
