"""Writes the generated parts of pages: tables of plugin properties, and the options of commands.

    python docs/generate.py

A part stands between `<!-- begin NAME -->` and `<!-- end NAME -->`. The part `properties-PLUGIN` lists the properties
that the code of the plugin declares. The part `commands` lists all commands and their options. Parts with other names
belong to `benchmarks/pages.py`. A test compares the pages with what this script writes.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

DOCS = Path(__file__).resolve().parent
MARKED = re.compile(r"(<!-- begin (?P<name>[\w-]+) -->\n).*?(<!-- end (?P=name) -->)", re.DOTALL)


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def shown(value: object) -> str:
    """Return a default as it is written in XML and TOML; "" for None."""
    if value is None:
        return ""
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def properties(plugin: str, page: Path) -> str:
    """Return the table of properties of a plugin, with links that hold on a page."""
    from pathreplay.platform.registration import BASELINES, PLUGINS

    _, module, template = {**PLUGINS, **BASELINES}[plugin]
    declared = getattr(importlib.import_module(module), template).properties
    differentiable = any(one.differentiable for one in declared)
    rows = []
    for one in declared:
        link, _, heading = one.see.partition("#")
        target = os.path.relpath(DOCS / link, page.parent) if link and page != DOCS / link else ""
        more = f" ([more]({target}{'#' if heading else ''}{heading}))" if one.see else ""
        key = [f"`{one.differentiable}`" if one.differentiable else ""] * differentiable
        rows.append([f"`{one.name}`", one.kind, shown(one.default), one.meaning + more, *key])
    columns = ["property", "type", "default", "meaning", *["differentiable key"] * differentiable]
    return table(columns, rows)


def commands() -> Iterator[str]:
    """Yield a section for each command: what it does, how it is called, and its options."""
    import typer

    from pathreplay.cli import app

    group = typer.main.get_command(app)
    with group.make_context("pathreplay", ["doctor"], resilient_parsing=True) as context:
        for name, command in group.commands.items():
            own = type(context)(command, parent=context, info_name=name)
            usage = command.get_usage(own).removeprefix("Usage: ")
            records = filter(None, (parameter.get_help_record(own) for parameter in command.params))
            rows = [[f"`{first}`", " ".join(meaning.split())] for first, meaning in records]
            options = ["", table(["argument or option", "meaning"], rows)] * bool(rows)
            yield "\n".join([f"## `{name}`", "", " ".join(command.help.split()), "", f"    {usage}", *options, ""])


def written(page: Path) -> str:
    """Return the text of a page with its generated parts as they should be."""

    def part(match: re.Match[str]) -> str:
        kind, _, plugin = match["name"].partition("-")
        makers: dict[str, Callable[[], str]] = {
            "properties": lambda: properties(plugin, page),
            "commands": lambda: "\n".join(commands()),
        }
        return f"{match[1]}{makers[kind]()}\n{match[3]}" if kind in makers else match[0]

    return MARKED.sub(part, page.read_text(encoding="utf-8"))


def pages() -> list[Path]:
    """Return all pages that may have generated parts."""
    return sorted(DOCS.rglob("*.md"))


if __name__ == "__main__":
    for page in pages():
        text = written(page)
        if text != page.read_text(encoding="utf-8"):
            page.write_text(text, encoding="utf-8")
            print(f"{page.relative_to(DOCS.parent)} was out of date")
