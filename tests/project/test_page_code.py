"""Pages of docs/start, docs/understand, docs/do and docs/reference: their code runs, and their links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main

from page_code import Block, blocks, broken_links, jobs, missing_parts, quick
from pathreplay import cli
from pathreplay.jobs import make_config, optimize
from places import ROOT
from variant import VARIANT

PAGES = sorted(path for room in ("start", "understand", "do") for path in (ROOT / "docs" / room).glob("*.md"))
PAGES += [ROOT / "docs/reference/compatibility.md"]
NAMES = [f"{path.parent.name}/{path.name}" for path in PAGES]
TEXTS = {name: path.read_text(encoding="utf-8") for name, path in zip(NAMES, PAGES, strict=True)}
COMMAND = re.compile(r"^(?: {4}|\$ |[+-])pathreplay ([a-z][\w-]*)(.*)$", re.M)


def scripts(name: str) -> list[Block]:
    """Python of a page, without quotations."""
    return [block for block in blocks(TEXTS[name], "python") if block.quoted is None]


def run(code: str, names: dict[str, Any]) -> None:
    if "torch" in code:
        pytest.importorskip("torch")
    exec(code.replace('"llvm_ad_rgb"', repr(VARIANT)), names)


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    assert not list(broken_links(page))


#: Pages with optimisations of a few seconds.
LONG = {"start/ten-minutes.md", "do/lights.md", "do/materials.md"}
SCRIPTS = [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in NAMES if scripts(n)]


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_of_a_page_run(name: str) -> None:
    names: dict[str, Any] = {}
    for block in scripts(name):
        run(block.code, names)


JOBS = {f"{name}-{k}": job for name in NAMES for k, job in enumerate(jobs(TEXTS[name]))}


def test_jobs_of_the_pages_are_valid() -> None:
    assert len(JOBS) > 8
    for name, job in JOBS.items():
        assert make_config(job).scene == job["scene"], name
        make_config(quick(job))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, job in JOBS.items() if not Path(job["scene"]).suffix])
def test_jobs_of_the_pages_run(name: str) -> None:
    """With few samples and iterations, in one process."""
    result = optimize(make_config({**quick(JOBS[name]), "executor": "local"}), output="run", progress=False)
    assert np.isfinite([entry.loss for entry in result.history]).all()


QUOTES = [(name, block) for name in NAMES for block in blocks(TEXTS[name]) if block.quoted is not None]


@pytest.mark.parametrize(("name", "block"), QUOTES, ids=[f"{name}: {block.mark}" for name, block in QUOTES])
def test_quoted_lines_stand_in_the_source(name: str, block: Block) -> None:
    assert block.quoted is not None and block.quoted.is_file() and block.code.strip()
    assert not missing_parts(block)


@pytest.mark.parametrize("code", ["no such line\n", "import re\nclass PathreplayError(Exception):\n"])
def test_a_quotation_that_differs_is_found(code: str) -> None:
    assert missing_parts(Block("python", "quote src/pathreplay/errors.py", code)) == [code]


DIFFS = [(name, k) for name in NAMES for k, block in enumerate(blocks(TEXTS[name], "diff")) if "import" in block.code]
OF_MITSUBA = ("prb", "prbvolpath", "prb_projective", "ptracer")


@pytest.mark.parametrize(("name", "k"), DIFFS, ids=[f"{name}-{k}" for name, k in DIFFS])
def test_the_new_side_of_a_diff_runs(name: str, k: int) -> None:
    block, names = blocks(TEXTS[name], "diff")[k], dict[str, Any]()
    if any(f'"type": "{plugin}"' in block.code for plugin in OF_MITSUBA):
        return  # below, both sides run
    run(block.side("+"), names)
    for key in {"gradient", "derivative"} & set(names):
        assert np.any(np.array(names[key])) and np.isfinite(np.array(names[key])).all()


@pytest.mark.parametrize("plugin", OF_MITSUBA)
def test_both_sides_of_a_diff_of_mitsubas_integrators_agree(plugin: str) -> None:
    (block,) = [block for block in blocks(TEXTS["start/coming-from.md"], "diff") if f'"type": "{plugin}"' in block.code]
    ours, theirs = {}, {}
    run(block.side("+"), ours)
    run(block.side("-"), theirs)
    assert "pathreplay" not in block.side("-") and "pathreplay" in str(ours["integrator"]).lower() + block.side("+")
    for key in ("image", "target"):
        if key in theirs:
            a, b = (np.array(names[key]).mean() for names in (ours, theirs))
            assert abs(a - b) < 0.1 * abs(b)
    if "gradient" in theirs:
        a, b = (np.array(names["gradient"]).sum() for names in (ours, theirs))
        assert a * b > 0


def test_commands_of_the_pages_exist() -> None:
    group: Any = typer.main.get_command(cli.app)
    found = [(name, *match.groups()) for name in NAMES for match in COMMAND.finditer(TEXTS[name])]
    assert len(found) > 10
    for name, command, rest in found:
        assert command in group.commands, f"{name}: {command}"
        known = {option for param in group.commands[command].params for option in param.opts} | {"--help"}
        used = set(re.findall(r"(?<=\s)(--?[a-zA-Z][\w-]*)", rest.split("#")[0]))
        assert used <= known, f"{name}: {command} {used - known}"
