"""The notebooks of the documentation: they parse, every name in them exists, each cell serves, and they run."""

from __future__ import annotations

import ast
import builtins
import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import notebook_cells
from notebook_cells import FOLDER, NAMES, Notebook
from places import ROOT

#: A notebook that hangs must not hang the tests.
TIMEOUT_S = 1800
EFFECTS = {"print", "show"}


@pytest.fixture(params=NAMES)
def notebook(request: pytest.FixtureRequest) -> Notebook:
    return notebook_cells.read(FOLDER / f"{request.param}.md")


def trees(notebook: Notebook) -> list[ast.Module]:
    """The cells, parsed. A cell that does not compile fails here, with its line in the file."""
    script = notebook.script().splitlines()
    parts = [("\n" * begin + code) for begin, _, code in notebook.cells]
    assert all(part.splitlines()[-1] in script for part in parts)
    return [compile(part, str(notebook.path), "exec", ast.PyCF_ONLY_AST) for part in parts]


def test_there_are_six() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.md")) == sorted(NAMES)


def test_the_header_names_the_format_and_a_kernel(notebook: Notebook) -> None:
    form = notebook.header["jupytext"]["text_representation"]
    assert (form["extension"], form["format_name"]) == (".md", "myst")
    assert notebook.header["kernelspec"] == {"display_name": "Python 3", "language": "python", "name": "python3"}
    assert notebook.prose.lstrip().startswith("# ") and "```" not in notebook.prose, "every fence is a code cell"
    assert {language for _, language, _ in notebook.cells} == {"ipython3"}


def test_a_variant_is_set_after_our_import(notebook: Notebook) -> None:
    """Dr.Jit looks for libLLVM while it is imported, and our import says where."""
    lines = notebook.cells[0][2].splitlines()
    (ours,) = (n for n, line in enumerate(lines) if line.startswith("import pathreplay"))
    theirs = [n for n, line in enumerate(lines) if line.startswith(("import mitsuba", "import drjit"))]
    assert theirs and ours < min(theirs) and 'mi.set_variant("llvm_ad_rgb")' in lines


def test_every_name_exists(notebook: Notebook) -> None:
    """Attributes of modules, and variables of this notebook."""
    known: dict[str, Any] = {}
    defined = set(vars(builtins))
    for tree in trees(notebook):
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for name in node.names:
                    known[name.asname or name.name] = importlib.import_module(name.name)
            elif isinstance(node, ast.ImportFrom):
                for name in node.names:
                    known[name.asname or name.name] = getattr(importlib.import_module(str(node.module)), name.name)
    defined |= known.keys()
    for tree in trees(notebook):
        nodes = list(ast.walk(tree))
        defined |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
        defined |= {node.name for node in nodes if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
        arguments = {node.arg for node in nodes if isinstance(node, ast.arg)}
        for node in nodes:
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                assert node.id in defined | arguments, f"{notebook.path.name}:{node.lineno}: {node.id} is not defined"
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in known:
                owner = known[node.value.id]
                assert hasattr(owner, node.attr), f"{notebook.path.name}:{node.lineno}: {node.value.id}.{node.attr}"


def test_every_cell_serves(notebook: Notebook) -> None:
    """It shows, prints or asserts something, or defines what a later cell uses; and the notebook asserts."""
    cells = trees(notebook)
    names = [[node for node in ast.walk(tree) if isinstance(node, ast.Name)] for tree in cells]
    used = [{node.id for node in nodes if isinstance(node.ctx, ast.Load)} for nodes in names]
    for n, tree in enumerate(cells[1:], 1):
        effects = [node for node in ast.walk(tree) if isinstance(node, ast.Assert) or _called(node) in EFFECTS]
        made = {node.id for node in names[n] if isinstance(node.ctx, ast.Store)}
        made |= {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert effects or made & set().union(*used[n + 1 :]), f"{notebook.path.name}: cell {n + 1} has no effect"
    assert any(isinstance(node, ast.Assert) for tree in cells for node in ast.walk(tree))


def _called(node: ast.AST) -> str | None:
    if not isinstance(node, ast.Call):
        return None
    return node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", None)


@pytest.mark.slow
def test_it_runs_and_its_assertions_hold(notebook: Notebook, tmp_path: Path) -> None:
    """All cells in one namespace, in a Python of its own, as a kernel runs them."""
    script = tmp_path / f"{notebook.path.stem}.py"
    script.write_text(notebook.script(), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        timeout=TIMEOUT_S, check=False, env={**os.environ, "MPLBACKEND": "agg", "PYTHONPATH": str(ROOT / "src")},
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
