"""The pages of docs/: links lead somewhere, every page is on the site, and generated parts are up to date."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import fields
from fnmatch import fnmatch
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.platform.registration import BASELINES, PLUGINS
from places import ROOT

sys.path.insert(0, str(ROOT / "docs"))  # generate.py belongs to the pages and is not installed

import generate

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
READ_WITH_THEM = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")]
READ_WITH_THEM += sorted((ROOT / "examples").rglob("*.md"))
FENCE = re.compile(r"^( *)(```+|:::+|~~~+)([^\n]*)\n(.*?)^\1\2 *$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(<?([^)\s>]+)>?(?: \"[^\"]*\")?\)|<img[^>]* src=\"([^\"]+)\"")
SHOWN = re.compile(r"\{(?:image|figure)\} *(\S+)")
TOCTREE = "{toctree}"


def without_code(text: str) -> str:
    """The text of a page without code, whose brackets are no links; a container keeps its text."""
    text = FENCE.sub(lambda match: match[4] if match[2].startswith(":") else "", text)
    return re.sub(r"`+[^`\n]+`+", "code", text)


def anchors(path: Path) -> set[str]:
    """The anchors of the headings of a page, as a code host and MyST make them."""
    found: set[str] = set()
    for heading in re.findall(r"^#{1,6} +(.+?) *$", FENCE.sub("", path.read_text(encoding="utf-8")), re.MULTILINE):
        shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")
        same = [slug, *(f"{slug}-{k}" for k in range(1, 99))]
        found.add(next(name for name in same if name not in found))
    return found


def references(path: Path) -> Iterator[str]:
    """The targets of links and images of a page that are in the repository."""
    text = path.read_text(encoding="utf-8")
    targets = [first or second for first, second in LINK.findall(without_code(text))]
    for target in [*targets, *SHOWN.findall(text)]:
        if not re.match(r"\w+:", target):
            yield target


def broken(path: Path) -> list[str]:
    """The references of a page that lead nowhere."""
    wrong = []
    for target in references(path):
        name, _, anchor = target.partition("#")
        file = (path.parent / name).resolve() if name else path
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            wrong.append(target)
    return wrong


@pytest.mark.parametrize("page", [*PAGES, *READ_WITH_THEM], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_images_lead_somewhere(page: Path) -> None:
    assert broken(page) == []


def test_a_broken_link_image_and_anchor_are_found(tmp_path: Path) -> None:
    page, other = tmp_path / "page.md", tmp_path / "other.md"
    other.write_text("# One\n## The `code` of it\n")
    page.write_text(
        "[a](other.md#the-code-of-it) [b](gone.md) [c](other.md#two) ![d](gone.png) [e](#f) [g](https://h.invalid)\n"
        "```{image} none.webp\n```\n    \n```python\nx = [1](gone)\n```\n`[i](gone)`\n"
    )
    assert broken(page) == ["gone.md", "other.md#two", "gone.png", "#f", "none.webp"]


def listed(path: Path) -> Iterator[Path]:
    """The pages that the sections of a page list."""
    every = [*PAGES, *READ_WITH_THEM]
    for _, _, kind, body in FENCE.findall(without_containers(path.read_text(encoding="utf-8"))):
        entries = body.split() if kind.strip() == TOCTREE else []
        for entry in entries:
            pattern = str((path.parent / entry).resolve()) + ".md"
            yield from (page for page in every if fnmatch(str(page), pattern))


def without_containers(text: str) -> str:
    return re.sub(r"^:::.*$", "", text, flags=re.MULTILINE)


def test_every_page_is_reached_from_the_index() -> None:
    reached, ahead = set(), [DOCS / "index.md"]
    while ahead:
        page = ahead.pop()
        if page not in reached:
            reached.add(page)
            ahead += listed(page)
    assert {str(page.relative_to(ROOT)) for page in {*PAGES} - reached} == set()


@pytest.mark.parametrize("page", generate.pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_generated_parts_are_up_to_date(page: Path) -> None:
    assert generate.written(page) == page.read_text(encoding="utf-8"), "write them with: python docs/generate.py"


def test_every_plugin_and_command_is_in_the_reference() -> None:
    plugins = (DOCS / "reference/plugins.md").read_text(encoding="utf-8")
    for name in (*PLUGINS, *BASELINES):
        assert f"<!-- begin properties-{name} -->\n|" in plugins, name
    commands = (DOCS / "reference/commands.md").read_text(encoding="utf-8")
    told = re.findall(r"^    pathreplay (\w+)", commands, re.MULTILINE)
    assert {"doctor", "check", "optimize", "schema"} <= set(told) and len(told) == commands.count("\n## ")


@pytest.mark.parametrize("name", [*PLUGINS, *BASELINES])
def test_declared_properties_are_those_that_a_plugin_reads(name: str) -> None:
    """Mitsuba refuses a property that nothing reads."""
    if name in BASELINES:
        pathreplay.baselines.register()
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((8, 8, 8, 1), np.float32))}
    needed = {"sigma_t": grid} if name == "gridmedium" else {}  # a coarse grid needs voxels
    plugin = mi.load_dict({"type": name, **needed})
    for one in plugin.properties:
        for value in (*one.choices, *({one.default} - {None})):
            mi.load_dict({"type": name, **needed, one.name: value})
    with pytest.raises(RuntimeError, match="undeclared"):
        mi.load_dict({"type": name, "undeclared": 1})


@pytest.mark.parametrize("name", ["pathreplay", "pathreplay_particles"])
def test_options_of_integrators_are_declared(name: str) -> None:
    integrator = mi.load_dict({"type": name})
    declared = {one.name: one.default for one in integrator.properties}
    options = integrator.options()
    assert {key for key, value in options.items() if declared.get(key) not in (None, value)} == set()
    assert options.keys() - declared.keys() == ({"caustics"} if name == "pathreplay_particles" else set())


def test_the_keys_of_a_line_of_the_history_are_those_on_the_page() -> None:
    page = (DOCS / "optimize.md").read_text(encoding="utf-8")
    (told,) = re.findall(r"^\| `history\.jsonl` \| (.*) \|$", page, re.MULTILINE)
    assert set(re.findall(r"`([a-z_]+)`", told)) == {each.name for each in fields(Entry)}


def test_every_public_name_is_in_the_reference() -> None:
    text = (DOCS / "reference/api.md").read_text(encoding="utf-8")
    documented = set(re.findall(r"^\.\. auto\w+:: pathreplay\.(\S+)$", text, re.MULTILINE))
    modules = {name for name in pathreplay.__all__ if inspect.ismodule(getattr(pathreplay, name))}
    named = {*pathreplay.__all__} - modules - {"__version__"}
    losses = {f"losses.{loss.__name__}" for loss in pathreplay.losses.LOSSES.values()}
    terms = {f"regularizers.{name}" for name in ("total_variation", "l2_to", "laplacian")}
    bridges = {f"{name}.RenderFunction" for name in ("torch", "jax")}
    assert documented == named | losses | terms | bridges | {"baselines.register"}
    assert "`pathreplay.__version__`" in text
