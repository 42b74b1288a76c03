"""docs/architecture.md: the three paths through the code are short, and are those that the code takes."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from types import FrameType
from typing import Any

import drjit as dr
import mitsuba as mi

from places import ROOT
from profiled import calls_noted

SRC = ROOT / "src/pathreplay"
SECTION = re.search(
    r"^## Three paths through the code$(.*?)^## ",
    (ROOT / "docs/architecture.md").read_text(encoding="utf-8"),
    re.M | re.S,
)
assert SECTION is not None
TEXTS = dict(re.findall(r"^### (.*?)$\n(.*?)(?=^### |\Z)", SECTION[1], re.M | re.S))
PATHS = {name: re.findall(r"^\d+\. `([\w/.]+)`: `(\w+)`$", text, re.M) for name, text in TEXTS.items()}
CONFIG, GRADIENT, EDGE = "A job's config", "A gradient request", "A boundary edge"
MOST = {CONFIG: 12, GRADIENT: 18, EDGE: 14}
"""Maximum number of modules on a path."""


def called(action: Callable[[], Any]) -> list[tuple[str, str]]:
    """Functions of the package by module and name, in the order of their first call."""
    calls: dict[tuple[str, str], None] = {}

    def note(frame: FrameType) -> None:
        if frame.f_code.co_filename.startswith(f"{SRC}/"):
            calls.setdefault((frame.f_code.co_filename.removeprefix(f"{SRC}/"), frame.f_code.co_name))

    with calls_noted(note):
        action()
    return list(calls)


def request(key: str, boundary: str) -> list[tuple[str, str]]:
    """The calls of one gradient of a small image."""
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": 4, "height": 4}
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3, "boundary": boundary})
    scene = mi.load_dict(box)
    params = mi.traverse(scene)
    if key.endswith("to_world"):
        x = mi.Float(0)
        dr.enable_grad(x)
        params[key] = params[key] @ mi.Transform4f().translate([x, 0, 0])
        params.update()
    else:
        dr.enable_grad(params[key])
    image = mi.render(scene, params, integrator=integrator, spp=2)
    return called(lambda: dr.backward(dr.mean(image)))


def in_order(listed: list[tuple[str, str]], calls: list[tuple[str, str]]) -> None:
    assert [stop for stop in calls if stop in listed] == listed


def test_paths_are_short() -> None:
    assert PATHS.keys() == MOST.keys() and all(PATHS.values())
    assert {name: len(listed) for name, listed in PATHS.items() if len(listed) > MOST[name]} == {}
    # Actors are a part of the path where a job has them.
    assert len(PATHS[CONFIG]) + len(set(re.findall(r"`(distributed/\w+\.py)`", TEXTS[CONFIG]))) <= MOST[CONFIG]


def test_a_gradient_takes_the_path_of_the_page() -> None:
    in_order(PATHS[GRADIENT], request("red.reflectance.value", "none"))


def test_an_edge_takes_the_path_of_the_page() -> None:
    in_order(PATHS[EDGE], request("sensor.to_world", "all"))


def test_no_other_module_follows_the_config() -> None:
    """All modules that name the class, or take the config from an object, stand on the page."""
    follow = {"inverse/config/schema.py"}
    for room in ("jobs", "library", "inverse", "distributed", "runs"):
        for path in set((SRC / room).rglob("*.py")) - set((SRC / "inverse/config").iterdir()):
            nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
            names = {node.id for node in nodes if isinstance(node, ast.Name)}
            taken = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
            if "Config" in names or "config" in taken:
                follow.add(str(path.relative_to(SRC)))
    said = set(re.findall(r"`([\w/]+\.py)`", TEXTS[CONFIG]))
    assert follow <= said, follow - said
    assert said <= follow | {module for module, _ in PATHS[CONFIG]}, said - follow
