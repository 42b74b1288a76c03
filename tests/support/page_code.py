"""Code on pages of the documentation: fenced blocks, quotations of source files, both sides of diffs, and links."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

from places import ROOT

BLOCK = re.compile(r"^(?:<!-- (?P<mark>.*?) -->\n)?```(?P<language>\w*)\n(?P<code>.*?)^```$", re.M | re.S)
LINK = re.compile(r"\]\((?P<target>[^)\s]+)\)")
QUOTE = "quote "
"""Begins the mark of a block that stands in a source file: `<!-- quote src/... -->` in the line above the block."""


@dataclass(frozen=True)
class Block:
    """A fenced block of code."""

    language: str
    mark: str  # text of the comment above the block; empty without a comment
    code: str

    @property
    def quoted(self) -> Path | None:
        """The source file that a quotation names."""
        return ROOT / self.mark.removeprefix(QUOTE) if self.mark.startswith(QUOTE) else None

    def side(self, sign: str) -> str:
        """Return the lines of one side of a diff ("-" or "+"), and those of both."""
        lines = self.code.splitlines()
        return "".join(line[1:] + "\n" for line in lines if not line or line[0] in f" {sign}")


def blocks(text: str, language: str | None = None) -> list[Block]:
    """Return the fenced blocks of a page, of one language or of all."""
    found = [Block(m["language"], m["mark"] or "", m["code"]) for m in BLOCK.finditer(text)]
    return [block for block in found if language in (None, block.language)]


def missing_parts(block: Block) -> list[str]:
    """Return the parts of a quotation that do not stand in its file; `...` on a line by itself separates parts.

    The lines of a part have to follow each other. Blank lines and indentation do not count.
    """
    assert block.quoted is not None
    source = _lines(block.quoted.read_text(encoding="utf-8"))
    parts = re.split(r"^ *\.\.\.$\n", block.code, flags=re.M)
    return [part for part in parts if f"\n{_lines(part)}\n" not in f"\n{source}\n"]


def _lines(code: str) -> str:
    return "\n".join(line.strip() for line in code.splitlines() if line.strip())


def jobs(text: str) -> list[dict[str, Any]]:
    """Return the jobs of a page. A block of TOML without a `scene` is an addition to the job before it."""
    found: list[dict[str, Any]] = []
    for block in blocks(text, "toml"):
        table = tomllib.loads(block.code)
        if "scene" in table:
            found.append(table)
        else:
            assert found, f"no job before this table: {sorted(table)}"
            found.append({**found[-1], **table})
    return found


def quick(job: Mapping[str, Any]) -> dict[str, Any]:
    """Return a job with few iterations and samples, which keeps all that its tables ask for."""
    small = dict(job)
    grids = [len(each["resolutions"]) for each in job["parameters"] if "refine_at" in each]
    small["iterations"] = max(grids, default=1) + 1
    if grids:
        small["parameters"] = [_refined_soon(table) if "refine_at" in table else table for table in job["parameters"]]
    if "stages" in job:
        small["stages"] = [{**stage, "iterations": 1} for stage in job["stages"]]
        del small["iterations"]
    small.pop("warmup_steps", None)
    spp = job.get("spp", 16)
    small |= {"spp": spp if spp == "auto" else min(spp, 2), "eval_spp": 2}
    if "images" not in job.get("target", {}) and "capture" not in job:
        small["target"] = {**job.get("target", {}), "spp": 2}
    return small


def _refined_soon(table: Mapping[str, Any]) -> dict[str, Any]:
    return {**table, "refine_at": [*range(1, len(table["resolutions"]))]}


def anchors(text: str) -> set[str]:
    """Return the anchors that a code host gives to the headings of a page."""
    plain = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
    names = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in re.findall(r"^#+ (.*)$", plain, re.M)]
    return {re.sub(r"[^\w\- ]", "", name.strip().lower()).replace(" ", "-") for name in names}


def broken_links(page: Path) -> Iterator[str]:
    """Yield the relative links of a page that lead to no file or to no heading."""
    text = page.read_text(encoding="utf-8")
    for match in LINK.finditer(re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)):
        name, _, anchor = match["target"].partition("#")
        if ":" in name:
            continue
        to = page if not name else (page.parent / name).resolve()
        if not to.exists():
            yield match["target"]
        elif anchor and anchor not in anchors(to.read_text(encoding="utf-8")):
            yield match["target"]
