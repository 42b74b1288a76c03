"""Types: how often annotations say nothing, whether mypy sees mistakes, and whether our stubs are true."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
import tokenize
from functools import reduce
from pathlib import Path
from types import ModuleType

import drjit.opt  # noqa: F401  # makes it an attribute of drjit
import mitsuba as mi
import pytest

from places import ROOT

STUBS = ROOT / "stubs"
#: Lines of src/ with `Any`, imports included: values of which nobody knows more, and packages that mypy does not read.
MOST = 80


def test_annotations_seldom_say_any() -> None:
    found = set()
    for path in (ROOT / "src").rglob("*.py"):
        with path.open("rb") as file:
            found |= {(path, token.start[0]) for token in tokenize.tokenize(file.readline) if token.string == "Any"}
    assert len(found) <= MOST, len(found)


BODY = """from __future__ import annotations
import drjit as dr
import mitsuba as mi
def view(sensor: mi.Sensor) -> None: ...
def f(scene: mi.Scene, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, film: mi.Film, sensor: mi.Sensor) -> None:
    x: mi.Float
"""
RIGHT = (
    "scene.sensors()", "x = dr.norm(si.p)", "ray.maxt = dr.inf", "film.crop_size()", "sensor.film()", "view(sensor)",
    "si.p += ray.d * si.t", "x = dr.select(si.is_valid(), si.t, 0)", "x = dr.sum(dr.abs(ray.o - si.p))",
)  # fmt: skip
WRONG = (
    "scene.sensor_list()", "si.pp", "ray.maxtt", "film.crop_sizes()", "sensor.films()", "view(scene)", "dr.nrm(si.p)",
    "mi.Sene", "x = dr.select(si.is_valid(), si.p, 0)", "x = dr.sum(ray, 3)()", "mi.RayFlags.Alll",
)  # fmt: skip


def test_mypy_sees_what_is_misspelt_or_of_another_type(tmp_path: Path) -> None:
    first = len(BODY.splitlines()) + 1
    (tmp_path / "lines.py").write_text(BODY + "".join(f"    {line}\n" for line in (*RIGHT, *WRONG)))
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path), str(tmp_path / "lines.py")]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    lines = {int(line.split(":")[1]) for line in told.splitlines() if ": error:" in line}
    assert lines == {first + len(RIGHT) + i for i in range(len(WRONG))}, told


#: Attributes that only objects have, not their classes.
OF_OBJECTS = {
    "SceneParameters": {"properties", "hierarchy", "get_property"},
    "Optimizer": {"state"},
}


def missing(module: ModuleType | type, body: list[ast.stmt], inside: str) -> list[str]:
    """The public names of a stub that the module or class does not have, nor a class that is derived from it."""
    found = []
    for node in body:
        names = [node.name] if isinstance(node, (ast.ClassDef, ast.FunctionDef)) else []
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names = [node.target.id]
        if isinstance(node, ast.Assign):
            names = [target.id for target in node.targets if isinstance(target, ast.Name)]
        for name in names:
            if name.startswith("_") and not name.endswith("__"):
                continue
            classes = [module, *(module.__subclasses__() if isinstance(module, type) else [])]
            if not any(hasattr(one, name) for one in classes) and name not in OF_OBJECTS.get(inside, ()):
                found.append(f"{inside}.{name}")
            elif isinstance(node, ast.ClassDef):
                found += missing(getattr(module, name), node.body, name)
    return found


@pytest.mark.parametrize("path", sorted(STUBS.rglob("*.pyi")), ids=lambda path: str(path.relative_to(STUBS)))
def test_what_stubs_name_exists(path: Path) -> None:
    assert mi.variant() == "llvm_ad_rgb"
    top, *parts = [part for part in path.relative_to(STUBS).with_suffix("").parts if part != "__init__"]
    module = reduce(getattr, parts, importlib.import_module(top))
    assert missing(module, ast.parse(path.read_text()).body, path.stem) == []
